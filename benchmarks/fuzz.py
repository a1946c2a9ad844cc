"""3,000 seeded hostile trials over readers, specs, commands, models, states, folders and exports: how they end.

Trials run in a process of their own, so that a crash or a hang of a library is seen and counted. "refused": an
InputError of one line; "equal": what a plain reading of the same bytes gives, or what was saved. Anything else is a
fault, told with its seed, and the exit code is then 1. Run: python benchmarks/fuzz.py [FACTOR] [ONLY…]
"""

from __future__ import annotations

import json
import os
import resource
import select
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from machine import describe

FILES = ("csv", "semicolons.csv", "tsv", "xlsx", "parquet", "npz", "v5.mat", "v73.mat", "h5")
TRIALS = {
    **dict.fromkeys(FILES, 150),
    **{
        "specs": 400,
        "commands": 350,
        "models": 250,
        "forged": 150,
        "states": 150,
        "folders": 250,
        "exports": 100,
    },
}
LONGEST, MEMORY = 30.0, 16 * 2**30  # s and bytes of one trial


def child(kind: str, start: int, stop: int) -> None:
    """Run the trials and tell the end of each in a line."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        trial = _trial(kind, folder)
        print(json.dumps("ready"), flush=True)
        for seed in range(start, stop):
            print(json.dumps(trial(seed)), flush=True)


def _trial(kind: str, folder: Path) -> Callable[[int], str]:
    """The trial of a kind by its seed, with what it needs made in the folder."""
    # imported here: under `--guided` what is imported before atheris instruments it is not seen
    from fuzzing import SPEC, TYPES, try_file, try_model, try_spec, write_original
    from fuzzing_runs import model_of, try_command, try_export, try_folder, try_forged, try_state

    write_original("csv", folder / "run.csv")
    if kind in TYPES:
        write_original(kind, folder / f"original.{kind}")
        original = (folder / f"original.{kind}").read_bytes()
        return lambda seed: try_file(kind, seed, original, folder)
    if kind == "specs":
        try_spec(1, SPEC, folder)  # imports what is slow to import
        return lambda seed: try_spec(seed, SPEC, folder)
    if kind == "states":
        return lambda seed: try_state(seed, folder)
    if kind == "folders":
        return lambda seed: try_folder(seed, folder)
    content, model = model_of(folder / "model")
    if kind == "commands":
        (folder / "spec.toml").write_text(SPEC, encoding="utf-8")
        return lambda seed: try_command(seed, folder)
    if kind == "exports":
        return lambda seed: try_export(seed, model, folder)
    trial = try_forged if kind == "forged" else try_model
    return lambda seed: trial(seed, content, folder / "model")


def run(kind: str, count: int) -> tuple[Counter, float]:
    """How the trials of a kind end, and the longest of them in seconds; faults are printed with their seeds."""
    ends, longest, seed = Counter(), 0.0, 0
    while seed < count:
        command = [sys.executable, __file__, "--child", kind, str(seed), str(count)]
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env={**os.environ}
        )
        assert process.stdout is not None and process.stderr is not None
        process.stdout.readline()
        while seed < count:
            began = time.monotonic()
            ready = select.select([process.stdout], [], [], LONGEST)[0]
            line = process.stdout.readline() if ready else b""
            longest = max(longest, time.monotonic() - began)
            end = json.loads(line) if line else ("crashes" if ready else "hangs")
            end = end if end in ("refused", "equal") else f"fault: {end}"
            if end.startswith("fault"):
                print(f"{kind}, seed {seed}: {end}", flush=True)
            ends[end.partition(":")[0]] += 1
            seed += 1
            if not line:
                break
        process.kill()
        process.communicate()
    return ends, longest


def guided(target: str, arguments: list[str]) -> None:
    """Let atheris look for inputs that reach new code; the rest of the arguments is its own.

    A corpus, the first of them, gets valid inputs to begin from.
    """
    import atheris

    with atheris.instrument_imports(include=["orthaug"]):
        from fuzzing_bytes import TARGETS, write_seeds
    corpus = Path(arguments[0]) if arguments and not arguments[0].startswith("-") else None
    if corpus is not None:
        corpus.mkdir(parents=True, exist_ok=True)
        write_seeds(target, corpus)
    atheris.Setup([sys.argv[0], *arguments], TARGETS[target])
    atheris.Fuzz()


def main() -> int:
    """Print a row for each kind; return 1 where a trial failed."""
    factor = float(sys.argv[1]) if len(sys.argv) > 1 else 1.0
    print(describe())
    print(
        "| what | held | trials | refused | equal | faults | longest "
        "|\n|---|---|---|---|---|---|---|"
    )
    whole = Counter()
    for kind in sys.argv[2:] or TRIALS:
        ends, longest = run(kind, round(factor * TRIALS[kind]))
        counts = " | ".join(str(ends[end]) for end in ("refused", "equal", "fault"))
        whole += ends
        print(
            f"| {kind} | {ends.total() - ends['fault']} | {ends.total()} | {counts} | "
            f"{longest:.1f} s |",
            flush=True,
        )
    print(f"\n{whole.total() - whole['fault']} of {whole.total()} trials held.")
    return 1 if whole["fault"] else 0


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        child(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
    elif sys.argv[1:2] == ["--guided"]:
        guided(sys.argv[2], sys.argv[3:])
    else:
        sys.exit(main())
