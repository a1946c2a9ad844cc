"""`orthaug reproduce` killed at ten random instants and started again: do the runs end at the same bits?

At the reduced size, killed outright (SIGKILL) and started again on the same store. Compared with a run that nothing
interrupted: every runs.csv byte by byte, timings aside. Run: python benchmarks/resume.py
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from machine import describe

KILLS = 10
TIMED = "solver_times"  # its results are times


def command(folder: Path, name: str) -> subprocess.Popen[str]:
    """The studies at reduced size with a store of their own."""
    main = "import sys; from orthaug.commands.cli import main; sys.argv[0] = 'orthaug'; main()"
    arguments = ["reproduce", "--small", "--out", str(folder / "out")]
    environment = {**os.environ, "XDG_CACHE_HOME": str(folder / name)}
    options = {
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.DEVNULL,
        "text": True,
        "env": environment,
    }
    return subprocess.Popen([sys.executable, "-c", main, *arguments], **options)


def runs(folder: Path) -> dict[str, bytes]:
    """Every study's runs as they were written."""
    return {
        path.parent.name: path.read_bytes()
        for path in folder.glob("out/*/runs.csv")
        if path.parent.name != TIMED
    }


def main() -> int:
    with tempfile.TemporaryDirectory() as place:
        whole, broken = Path(place) / "whole", Path(place) / "broken"
        began = time.perf_counter()
        assert command(whole, "cache").wait() == 0
        seconds, draw = time.perf_counter() - began, random.Random(0)
        for _ in range(KILLS):
            process = command(broken, "cache")
            try:
                process.wait(draw.uniform(1, 1 + 3 * seconds / KILLS))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        assert command(broken, "cache").wait() == 0
        one, two = runs(whole), runs(broken)
        assert one.keys() == two.keys() and len(one) >= 6
        differ = [name for name in one if one[name] != two[name]]
    print(describe())
    print(f"{KILLS} kills: {len(one) - len(differ)} of {len(one)} studies end at the same bits")
    return 1 if differ else 0


if __name__ == "__main__":
    sys.exit(main())
