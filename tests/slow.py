"""The tests that take long, which `make test` leaves out: `make proofs` runs the slow ones, `make long` the others.

They are listed in `slow.txt` and `long.txt` by what they took; a new one is in the suite until the lists are written
anew, here on a machine that takes 3 times as long as that of `LONG` and `LONGEST`:

    python -m pytest -q -m "" -n auto --dist loadfile --no-loadscope-reorder --durations=0 > log
    python tests/slow.py log 3
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

LISTS = {name: Path(__file__).with_name(f"{name}.txt") for name in ("slow", "long")}
LONG, LONGEST = 4.0, 16.0  # s of its own, with one worker more than cores
# Fixtures of a module that take longer than a quarter of a minute: each test that uses one is slow, or long
FIXTURES = {
    ("test_motion_without_inputs", "fitted"),
    ("test_reproduction", "found"),
}
LONG_FIXTURES = {("test_learner_states", "fit")}
# The main paths, which CI shows however long they take
KEPT = {
    "tests/test_documents.py::test_the_page_runs[README.md]",
    "tests/test_documents.py::test_the_page_runs[docs/commands.md]",
    "tests/test_golden_motion.py::test_equations_of_motion[motion_default]",
    "tests/test_app.py::test_from_a_file_to_code_with_the_numbers_of_the_command_line",
}
_LINE = re.compile(r"\s*([\d.]+)s call\s+(\S.*?)\s*$")


def listed(name: str) -> frozenset[str]:
    """Return the names of the tests on a list."""
    return frozenset(LISTS[name].read_text(encoding="utf-8").splitlines())


def write(log: Path, factor: float = 1.0) -> None:
    """Write the lists from the durations that pytest has printed on a machine slower by a factor."""
    found = filter(None, map(_LINE.match, log.read_text(encoding="utf-8").splitlines()))
    took = {line[2]: float(line[1]) / factor for line in found}
    longest = {name for name, seconds in took.items() if seconds >= LONGEST} - KEPT
    slow = {name for name, seconds in took.items() if seconds >= LONG} - longest
    for name, tests in (("slow", slow), ("long", longest)):
        LISTS[name].write_text("\n".join(sorted(tests)) + "\n", encoding="utf-8")
        print(f"{name}: {len(tests)} tests")


if __name__ == "__main__":
    write(Path(sys.argv[1]), *map(float, sys.argv[2:]))
