"""The tests that take long, which `make test` leaves out: `make proofs` runs the slow ones, `make long` the others.

They are listed in `slow.txt` and `long.txt` by what they took; a new one is in the suite until the lists are written
anew, here on a machine that takes 1.5 times as long as that of `LONG` and `LONGEST`:

    python -m pytest -q -m "" -n auto --dist loadfile --no-loadscope-reorder --durations=0 > log
    python tests/slow.py log 1.5

Tests that the log does not have stay on their list, so the log may be that of the suite alone.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

LISTS = {name: Path(__file__).with_name(f"{name}.txt") for name in ("slow", "long")}
LONG, LONGEST = 0.8, 16.0  # s of its own, with one worker more than cores
# Fixtures of a module that take longer than a quarter of a minute: each test that uses one is slow, or long
FIXTURES = {
    ("test_advice", "moved"),
    ("test_controller", "beside_a_learner"),
    ("test_innovations", "learned"),
    ("test_motion_cli", "printed"),
    ("test_motion_fit", "fitted"),
    ("test_motion_without_inputs", "fitted"),
    ("test_paper", "additive"),
    ("test_report_browser", "folder"),
    ("test_reproduction", "found"),
    ("test_saved_results", "fits"),
    ("test_selection", "selected"),
}
LONG_FIXTURES = {("test_learner_states", "fit")}
# The main paths, and one test of each concept whose tests all take long: CI shows them however long they take
KEPT = {
    "tests/test_documents.py::test_the_page_runs[README.md]",
    "tests/test_documents.py::test_the_page_runs[docs/commands.md]",
    "tests/test_golden_motion.py::test_equations_of_motion[motion_default]",
    "tests/test_app.py::test_from_a_file_to_code_with_the_numbers_of_the_command_line",
    "tests/test_benchmark_command.py::test_sets_without_files_are_named_and_all_without_is_refused",
    "tests/test_closed_loop.py::test_check_and_fit_name_it",
    "tests/test_compare.py::test_every_structure",
    "tests/test_controller.py::test_a_loop_without_a_delay_is_refused",
    "tests/test_doubts_of_fits.py::test_a_disturbance_with_memory_is_distinguished_from_missing_physics",
    "tests/test_examination.py::test_a_fit_in_python_is_judged_as_the_command_judges_it[lagged_suspects]",
    "tests/test_examination.py::test_a_fit_in_python_is_judged_as_the_command_judges_it[motion_physics]",
    "tests/test_explain.py::test_the_physics_with_the_term_leaves_the_learner_nothing",
    "tests/test_init.py::test_a_file_without_a_header_is_begun_with_and_runs[txt- -.]",
    "tests/test_init.py::test_the_stated_error_is_what_a_fit_gives_on_the_same_rows[5.0]",
    "tests/test_messages.py::test_the_page_has_every_message_of_the_source",
    "tests/test_missing_outputs.py::test_the_command_fits_and_reads_further_data",
    "tests/test_motion_without_inputs.py::test_starts_that_settle_slowly_are_no_poor_minimum",
    "tests/test_noise_estimation.py::test_a_learner_of_terms_is_fitted_with_the_noise_model_exactly",
    "tests/test_once.py::test_the_counts_of_a_fit",
    "tests/test_programs.py::test_programs_go_where_they_take_too_many_maps",
    "tests/test_registry.py::test_a_measure_from_outside",
    "tests/test_selection.py::test_two_inputs_have_their_own_delays",
    "tests/test_settled_starts.py::test_two_initial_values_lead_to_one_solution",
    "tests/test_terms.py::test_a_term_of_a_motion_has_its_coefficient",
    "tests/test_validation.py::test_the_table_of_a_fit",
}
_LINE = re.compile(r"\s*([\d.]+)s call\s+(\S.*?)\s*$")


def listed(name: str) -> frozenset[str]:
    """Return the names of the tests on a list."""
    return frozenset(LISTS[name].read_text(encoding="utf-8").splitlines())


def write(log: Path, factor: float = 1.0) -> None:
    """Write the lists from the durations that pytest has printed on a machine slower by a factor."""
    found = filter(None, map(_LINE.match, log.read_text(encoding="utf-8").splitlines()))
    took = {line[2]: float(line[1]) / factor for line in found}
    kept = {name: {test for test in listed(name) if test not in took} for name in LISTS}
    longest = {name for name, seconds in took.items() if seconds >= LONGEST} - KEPT
    slow = {name for name, seconds in took.items() if seconds >= LONG} - longest
    longest, slow = longest | kept["long"], slow | kept["slow"]
    for name, tests in (("slow", slow), ("long", longest)):
        LISTS[name].write_text("\n".join(sorted(tests)) + "\n", encoding="utf-8")
        print(f"{name}: {len(tests)} tests")


if __name__ == "__main__":
    write(Path(sys.argv[1]), *map(float, sys.argv[2:]))
