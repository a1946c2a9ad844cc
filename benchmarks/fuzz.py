"""Seeded mutations of data files (2,000 over nine types), specs (500) and saved models (500): how they end.

Trials run in a process of their own, so that a crash or a hang of a library is seen and counted. "refused": an
InputError of one line; "equal": what a plain reading of the same bytes gives, or what was saved. Anything else is a
fault, told with its seed. Run: python benchmarks/fuzz.py [FACTOR] [ONLY…]
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
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from fuzzing import SPEC, TYPES, model_files, try_file, try_model, try_spec, write_original
from machine import describe

TRIALS = {**{kind: 223 if i < 2 else 222 for i, kind in enumerate(TYPES)}, "specs": 500, "models": 500}
LONGEST, MEMORY = 10.0, 16 * 2**30  # s and bytes of one trial


def child(kind: str, start: int, stop: int) -> None:
    """Run the trials and tell the end of each in a line."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if kind == "models":
            content = model_files(folder / "model")
        else:
            write_original("csv", folder / "run.csv")
            if kind != "specs":
                write_original(kind, folder / f"original.{kind}")
                original = (folder / f"original.{kind}").read_bytes()
        print(json.dumps("ready"), flush=True)
        for seed in range(start, stop):
            if kind == "models":
                end = try_model(seed, content, folder / "model")
            else:
                end = try_spec(seed, SPEC, folder) if kind == "specs" else try_file(kind, seed, original, folder)
            print(json.dumps(end), flush=True)


def run(kind: str, count: int) -> tuple[Counter, float]:
    """How the trials of a kind end, and the longest of them in seconds; faults are printed with their seeds."""
    ends, longest, seed = Counter(), 0.0, 0
    while seed < count:
        command = [sys.executable, __file__, "--child", kind, str(seed), str(count)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env={**os.environ})
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


def main() -> None:
    """Print a row for each kind."""
    factor = float(sys.argv[1]) if len(sys.argv) > 1 else 1.0
    print(describe())
    print("| what | trials | refused | equal | faults | longest |\n|---|---|---|---|---|---|")
    for kind in sys.argv[2:] or TRIALS:
        ends, longest = run(kind, round(factor * TRIALS[kind]))
        counts = " | ".join(str(ends[end]) for end in ("refused", "equal", "fault"))
        print(f"| {kind} | {ends.total()} | {counts} | {longest:.1f} s |", flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        child(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
    else:
        main()
