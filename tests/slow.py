"""The tests that take long, which `make test` leaves out and `make proofs` runs.

They are listed in `slow.txt` by what they took; a new one is in the suite until the list is written anew:

    python -m pytest -q -m "not proof" -n auto --dist loadfile --no-loadscope-reorder --durations=0 > log
    python tests/slow.py log
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

LIST = Path(__file__).with_name("slow.txt")
LONG = 4.0  # s of its own, with one worker more than cores
# Fixtures of a module that take longer than a quarter of a minute: each test that uses one is slow
FIXTURES = {
    ("test_learner_states", "fit"),
    ("test_motion_without_inputs", "fitted"),
    ("test_reproduction", "found"),
}
_LINE = re.compile(r"\s*([\d.]+)s call\s+(\S.*?)\s*$")


def listed() -> frozenset[str]:
    """Return the names of the tests that take long."""
    return frozenset(LIST.read_text(encoding="utf-8").splitlines())


def write(log: Path) -> int:
    """Write the list from the durations that pytest has printed, and return how many are on it."""
    found = filter(None, map(_LINE.match, log.read_text(encoding="utf-8").splitlines()))
    names = sorted({line[2] for line in found if float(line[1]) >= LONG})
    LIST.write_text("\n".join(names) + "\n", encoding="utf-8")
    return len(names)


if __name__ == "__main__":
    print(f"{write(Path(sys.argv[1]))} tests take {LONG:g} s or more")
