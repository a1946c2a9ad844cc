"""What a first fit takes, when none of its programs is compiled yet: as it is, and with all of XLA's effort.

On small data programs are compiled with less effort (`_base/jax.py`). The example `motion_friction` is fitted by the
command line with an empty store of programs, then again with a full one; a run is the training alone.
Run: python examples/generate.py, then python benchmarks/compile_effort.py
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from machine import describe

SPEC = Path(__file__).parents[1] / "examples" / "motion_friction.toml"
PROGRAM = """
import sys
from orthaug._base import jax
if sys.argv[1] == "all":
    jax._SMALL = -1
sys.argv = ["orthaug", *sys.argv[2:]]
from orthaug.commands.entry import main
main()
"""


def fit(effort: str, store: Path) -> tuple[float, float, int]:
    """Seconds of the command and of its training, and the programs in the store after it."""
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(store)}
    command = [sys.executable, "-c", PROGRAM, effort, "fit", str(SPEC), "--force", "--out"]
    began = time.perf_counter()
    ended = subprocess.run(
        [*command, str(store.parent / "result")], capture_output=True, text=True, env=environment
    )
    seconds = time.perf_counter() - began
    found = re.search(r"iterations, ([0-9.]+) s", ended.stdout)
    if found is None:
        raise SystemExit(ended.stderr)
    return seconds, float(found[1]), len(list(store.glob("*-cache")))


def main() -> None:
    print(describe())
    print("\n| effort | programs | first fit | again | its training |\n" + 5 * "|---" + "|")
    for words, effort in (("less on small data", "less"), ("all", "all")):
        with tempfile.TemporaryDirectory() as folder:
            store = Path(folder) / "programs"
            first, _, programs = fit(effort, store)
            again, training, _ = fit(effort, store)
        print(f"| {words} | {programs} | {first:.1f} s | {again:.1f} s | {training:.2f} s |")


if __name__ == "__main__":
    main()
