"""Surroundings in which the program must hold: places it may not write, signals, streams, settings, altered stores.

Each trial is a shell script of its own. A fault is a traceback, a raw warning, a wrong exit code, more than one line
for an error, anything partial that is left, or a missing sentence. `python benchmarks/surroundings.py [WORD…]` runs
all trials, or those whose name holds a word.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

MAIN = "import sys; sys.argv[0] = 'orthaug'; from orthaug.commands.entry import main; main()"
SPEC = """[data]
sampling_time = 0.5
inputs = ["u"]
outputs = ["y"]
train = { files = ["run.csv"] }
[data.channels.y]
unit = "$m$"
[[baseline.terms]]
parameter = "a"
regressor = "y[k-1]"
initial = 0.5
[[baseline.terms]]
parameter = "c"
regressor = "u[k-1]"
initial = 0.5
[[suspects]]
name = "$square"
on = "u[k-1]**2"
coefficient = 0.2
[design]
samples = 40
amplitude = 1.0
[learner]
"""
RAW = re.compile(
    r"Traceback|Exception ignored|Warning|^\w*Error\b|Bad key|terminate called|core dumped",
    re.MULTILINE,
)
PRELUDE = r"""set -u
O() { "$PYTHON" -c "$MAIN" "$@"; }
four() { for i in 1 2 3 4; do O "$@" >/dev/null & p="${p-} $!"; done; for i in $p; do wait $i || return; done; }
ended() { "$PYTHON" -c "$MAIN" fit long.toml --out deep/out & p=$!; sleep $2; kill -$1 $p; wait $p; }
cached() { JAX_COMPILATION_CACHE_DIR=$PWD/c O fit net.toml --out out; }
"""


class Trial(NamedTuple):
    """A script, the exit code of its last command, and words of standard error; `say` that of standard output."""

    name: str
    script: str
    code: int = 0
    words: str = ""
    say: str = ""


TRIALS = [
    # what is there is kept
    Trial("folder unchanged", "cp -r fit out; O fit plant.toml --out out"),
    Trial(
        "folder with notes",
        "cp -r fit out; echo > out/note; O fit plant.toml --out out",
        2,
        "note.*--force",
    ),
    Trial(
        "folder with a changed file",
        "cp -r fit out; echo >> out/report.html; O fit plant.toml --out out",
        2,
        "--force",
    ),
    Trial(
        "folder by force",
        "cp -r fit out; echo > out/note; O fit plant.toml --out out --force && test ! -e out/note",
    ),
    Trial(
        "foreign result.json",
        'mkdir out; echo \'{"schema":1,"orthaug":1}\' >out/result.json; echo >out/thesis; '
        "O fit plant.toml --out out; c=$?; test -e out/thesis && exit $c",
        2,
        "thesis",
    ),
    Trial(
        "folder without manifest",
        "cp -r fit out; rm out/manifest.json; O fit plant.toml --out out",
        2,
        "manifest.json.*--force",
    ),
    Trial(
        "folder without manifest, with notes",
        "cp -r fit out; rm out/manifest.json; echo >out/a; O fit plant.toml --out out",
        2,
        "--force",
    ),
    Trial("working folder by force", "O fit plant.toml --out . --force", 2, "working folder"),
    Trial(
        "home by force",
        "mkdir -p h/x; cd h/x; HOME=.. O fit ../../plant.toml --out .. --force",
        2,
        "working folder",
    ),
    Trial(
        "compare onto its model",
        "cp -r fit out; O compare plant.toml --model out --out out --force",
        2,
        "reads",
    ),
    Trial(
        "link to a folder",
        "cp -r fit out; ln -s out link; O fit plant.toml --out link && test -L link",
    ),
    Trial("link to nowhere", "ln -s nowhere link; O fit plant.toml --out link", 2, "not a folder"),
    Trial(
        "simulate onto a file",
        "echo >s; chmod 444 s; O simulate fit run.csv --out s",
        2,
        "s: exists.*--force",
    ),
    Trial(
        "simulate by force",
        "echo >s; O simulate fit run.csv --out s --force && test $(wc -l <s) = 121",
    ),
    Trial(
        "simulate onto its model",
        "cp -r fit out; O simulate out run.csv --out out/model/model.json --force",
        2,
        "read by",
    ),
    Trial(
        "simulate onto a link by force",
        "echo >s; ln -s s l; O simulate fit run.csv --out l --force && test -L l -a $(wc -l "
        "<s) = 121",
    ),
    Trial(
        "simulate into a pipe",
        "O simulate fit run.csv --out /dev/stdout | cat && test -c /dev/null",
        say="y_model",
    ),
    Trial("predict onto a file", "echo >s; O predict fit run.csv --out s", 2, "--force"),
    Trial("design onto a file", "echo >s; O design plant.toml --out s", 2, "--force"),
    Trial("check onto a figure", "echo >s.png; O check plant.toml --figure s.png", 2, "--force"),
    Trial("figure of no format", "O check plant.toml --figure x.xyz", 2, r"\.png"),
    Trial("figure with dollars", "O check plant.toml --figure x.png && test -s x.png"),
    Trial(
        "four at once",
        "four simulate fit run.csv --out s",
    ),
    Trial(
        "four fits at once",
        "four fit plant.toml --out out && test -d out/model",
    ),
    Trial(
        "what a dead process left",
        "mkdir .orthaug-partial-$HOST-999999999-0; O fit plant.toml --out out",
    ),
    # signals
    *(
        Trial(
            f"{name} after {after} s",
            f"ended {name} {after}; c=$?; test ! -e deep && exit $c",
            code,
            "nothing is written",
        )
        for name, code in (("TERM", 143), ("HUP", 129))
        for after in (0.5, 1.5, 12)
    ),
    # places and limits
    Trial("name of 240 letters", "O fit plant.toml --out $(printf 'x%.0s' $(seq 240))"),
    Trial(
        "name of 300 letters",
        "O simulate fit run.csv --out $(printf 'x%.0s' $(seq 300))",
        2,
        "too long",
    ),
    Trial(
        "file size limit of a fit",
        "ulimit -f 20; O fit plant.toml --out out; c=$?; test ! -e out && exit $c",
        2,
        "out: cannot be written.*too large",
    ),
    Trial(
        "file size limit of a response",
        "ulimit -f 1; O simulate fit run.csv --out s; c=$?; test ! -e s && exit $c",
        2,
        "s: cannot be written.*too large",
    ),
    Trial(
        "working folder gone", "mkdir w; cd w; rmdir ../w; O fit ../plant.toml", 2, "working folder"
    ),
    Trial("memory limit", "ulimit -v 1500000; O fit net.toml", 2, "memory"),
    Trial(
        "larger memory limit",
        "ulimit -v 3000000; O fit net.toml --out out; c=$?; test $c = 0 -o $c = 2",
    ),
    # streams
    *(
        Trial(
            f"encoding {name}", f"PYTHONIOENCODING={name} O fit greek.toml --out out", say="theta"
        )
        for name in ("latin-1", "cp437", "ascii")
    ),
    Trial(
        "JSON in latin-1",
        'PYTHONIOENCODING=latin-1 O fit greek.toml --out out --json | "$PYTHON" -c '
        '\'import json, sys; print(json.load(sys.stdin)["parameters"][0]["name"] == "\\u03b8")\'',
        say="True",
    ),
    Trial("C locale", "LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0 O fit greek.toml --out out"),
    Trial(
        "standard output full",
        "O fit plant.toml --out out >/dev/full; c=$?; test -d out && exit $c",
        2,
        "standard output.*space",
    ),
    Trial(
        "response to a full output",
        "O simulate fit run.csv >/dev/full",
        2,
        "standard output.*space",
    ),
    Trial("help to a full output", "O --help >/dev/full", 2, "standard output"),
    Trial("standard output closed", "O simulate fit run.csv >&-", 2, "standard output"),
    Trial("standard error closed", "O fit absent.toml 2>&-", 2),
    Trial("standard error full", "O fit absent.toml 2>/dev/full", 2),
    Trial("all closed", "O simulate fit run.csv --out s <&- >&- 2>&-; test $(wc -l <s) = 121"),
    # settings
    Trial(
        "matplotlib usetex", "echo 'text.usetex: true' >matplotlibrc; O fit plant.toml --out out"
    ),
    Trial(
        "matplotlib broken",
        "printf 'banana: 1\\nlines.linewidth: x\\nno colon\\n' >matplotlibrc; O fit plant.toml "
        "--out out",
    ),
    Trial(
        "matplotlib no UTF-8",
        "printf '\\377\\376' >matplotlibrc; O fit plant.toml --out out",
        2,
        "matplotlibrc",
    ),
    Trial("MPLBACKEND", "MPLBACKEND=banana O fit plant.toml --out out"),
    Trial("JAX_PLATFORMS", "JAX_PLATFORMS=cuda O fit net.toml --out out", 2, "JAX_PLATFORMS=cuda"),
    Trial(
        "JAX strict",
        "JAX_NUMPY_DTYPE_PROMOTION=strict JAX_NUMPY_RANK_PROMOTION=raise JAX_DEBUG_NANS=1 O "
        "fit net.toml --out out",
    ),
    Trial(
        "JAX_ENABLE_X64",
        "JAX_ENABLE_X64=banana O fit net.toml --out out",
        2,
        "JAX_ENABLE_X64=banana",
    ),
    Trial("PYTHONWARNINGS", "PYTHONWARNINGS=error O fit net.toml --out out"),
    Trial("home is a file", "echo >h; HOME=$PWD/h XDG_CACHE_HOME= O fit net.toml --out out"),
    Trial("cache is a file", "echo >h; JAX_COMPILATION_CACHE_DIR=$PWD/h O fit net.toml --out out"),
    Trial(
        "cache cannot be made", "JAX_COMPILATION_CACHE_DIR=/proc/nowhere O fit net.toml --out out"
    ),
    # stores
    Trial(
        "cache of swapped programs",
        'cp -r cache c; "$PYTHON" swap.py c; cached && "$PYTHON" same.py out net',
    ),
    Trial(
        "cache of rubbish",
        "cp -r cache c; for f in c/*-cache; do echo rubbish >$f; done; cached",
    ),
    Trial(
        "cache of empty files",
        "cp -r cache c; for f in c/*-cache; do : >$f; done; cached",
    ),
]
SAME = """import json, sys
first, second = (json.load(open(f"{name}/result.json"))["parameters"] for name in sys.argv[1:])
assert first == second
"""
SWAP = """import pathlib, sys
files = sorted(pathlib.Path(sys.argv[1]).glob("*-cache"))
contents = [file.read_bytes() for file in files]
for file, content in zip(files, contents[1:] + contents[:1]):
    file.write_bytes(content)
"""


def make_project(folder: Path) -> None:
    """Specs with their data: physics alone, a small network, one that trains for long, a parameter in Greek."""
    rng = np.random.default_rng(1)
    u, y = rng.uniform(-1, 1, 120), np.zeros(120)
    for k in range(1, 120):
        y[k] = 0.6 * y[k - 1] + 0.5 * u[k - 1] + 0.2 * u[k - 1] ** 2
    table = np.column_stack([u, y + 0.001 * rng.normal(size=120)])
    np.savetxt(folder / "run.csv", table, delimiter=",", header="u,y", comments="")
    network = "hidden = [4]\n[training]\niterations = 5\n"
    texts = {"plant": SPEC + 'kind = "none"\n', "net": SPEC + network}
    texts["long"] = SPEC + "hidden = [20, 10]\n[training]\niterations = 1000000\nrestarts = 50\n"
    texts["greek"] = texts["plant"].replace('"a"', '"θ"')
    for name, text in texts.items():
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    (folder / "swap.py").write_text(SWAP)
    (folder / "same.py").write_text(SAME)


def settings(base: Path) -> dict[str, str]:
    from orthaug._base.folders import _HOST

    kept = {key: value for key, value in os.environ.items() if not key.startswith("JAX_")}
    mine = {
        "PYTHON": sys.executable,
        "MAIN": MAIN,
        "HOST": _HOST,
        "JAX_COMPILATION_CACHE_DIR": str(base / "cache"),
    }
    return kept | mine


def shell(
    script: str, folder: Path, environment: dict[str, str]
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["bash", "-c", PRELUDE + script], cwd=folder, env=environment, capture_output=True, text=True, errors="replace",
        timeout=300, check=False,
    )  # fmt: skip


def faults(trial: Trial, base: Path, environment: dict[str, str]) -> list[str]:
    """What does not hold in one trial, in words."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_project(folder)
        for there in ("fit", "net", "cache"):
            (folder / there).symlink_to(base / there)
        for there in ("fit", "net"):
            (folder / there).unlink()
            subprocess.run(["cp", "-r", base / there, folder / there], check=True)
        done = shell(trial.script, folder, environment)
        found = []
        if done.returncode != trial.code:
            found.append(f"exit code {done.returncode} instead of {trial.code}")
        if RAW.search(done.stderr) or RAW.search(done.stdout):
            found.append("a raw message")
        if not re.search(trial.words, done.stderr):
            found.append(f"'{trial.words}' is missing")
        if len(done.stderr.splitlines()) > 1:
            found.append(f"{len(done.stderr.splitlines())} lines on standard error")
        if trial.say not in done.stdout:
            found.append(f"'{trial.say}' is missing on standard output")
        left = [path.name for path in folder.rglob(".orthaug-*")]
        if left:
            found.append(f"left behind: {', '.join(left)}")
        return [*found, done.stderr[:1500]] if found else []


def interrupts(
    base: Path, environment: dict[str, str], waits: list[float]
) -> tuple[list[str], float]:
    """Ctrl-C after so many seconds, from imports to training: what does not hold, and the longest wait for the end."""
    found, longest = [], 0.0
    with tempfile.TemporaryDirectory() as name:
        make_project(Path(name))
        for wait in waits:
            process = subprocess.Popen(
                [sys.executable, "-c", MAIN, "fit", "long.toml", "--out", "deep/out"], cwd=name, env=environment,
                stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
            )  # fmt: skip
            time.sleep(wait)
            process.send_signal(signal.SIGINT)
            began = time.perf_counter()
            _, err = process.communicate(timeout=60)
            longest = max(longest, time.perf_counter() - began)
            lines = err.splitlines()
            if (
                process.returncode != 130
                or len(lines) != 1
                or "interrupted" not in err
                or (Path(name) / "deep").exists()
            ):
                found.append(
                    f"Ctrl-C after {wait:.2f} s: exit code {process.returncode}, {err[-300:]!r}"
                )
    return found, longest


def main() -> None:
    wanted = sys.argv[1:]
    trials = [trial for trial in TRIALS if not wanted or any(word in trial.name for word in wanted)]
    count = bad = 0
    with tempfile.TemporaryDirectory() as name:
        base = Path(name)
        make_project(base)
        environment = settings(base)
        for spec, out in (("plant", "fit"), ("net", "net")):
            made = shell(f"O fit {spec}.toml --out {out}", base, environment)
            assert made.returncode == 0, made.stderr
        for trial in trials:
            found = faults(trial, base, environment)
            count, bad = count + 1, bad + bool(found)
            if found:
                print(f"{trial.name}: " + "; ".join(found), flush=True)
        if not wanted or "Ctrl-C" in wanted:
            waits = [0.2 + 0.1 * i for i in range(10)] + [1.5 + 1.0 * i for i in range(10)]
            found, longest = interrupts(base, environment, waits)
            print("\n".join(found))
            print(f"longest time from Ctrl-C to the end: {longest:.2f} s")
            count, bad = count + len(waits), bad + len(found)
    print(f"faults found: {bad} of {count}")


if __name__ == "__main__":
    main()
