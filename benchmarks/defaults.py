"""The collection that decides about defaults: what a new user gets, against physics alone and the best of all columns.

Ten measured records, 40 generated problems and a positioning axis, each fitted by the command line with nothing chosen
(`orthaug init`, `orthaug fit`; motions by hand), and with one thing chosen in each further column. A rule is judged by
its regret: the logarithm of the default's free-run error on new data over that of the better of physics and learner.
The program under test is the one that Python finds: choose it by PYTHONPATH. Measured data: ORTHAUG_DATA.
Run: python benchmarks/defaults.py [--only NAME ...] [--columns default,free] [--jobs N] [--out FILE] [--again]
--table prints the tables of what was run before, --fill takes columns that were not run from other programs, --again
runs anew, --warm times fits that have nothing to compile.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache, partial
from math import exp, isfinite, log
from pathlib import Path

import numpy as np
from collection import AXIS, GENERATED, LAGGED, MEASURED, MOTIONS, Problem
from default_runs import COLUMNS, Result, Store, latest, program, run, shown
from generated import axis, grey_box, oscillators
from machine import ROOT, data_folder, describe

CAP = 10.0  # NRMSE of what diverges
WORSE, REGRET, GREY = 1.02, 0.05, 1.1  # what a default may cost
UP, STAYED = 3.0, 1.1  # time over one step, where the free run was trained as well, and where not
PHYSICS, LEARNERS = ("physics", "physics-free"), ("simulation",)
Results = dict[str, dict[str, Result]]


def problems() -> dict[str, tuple[str, Callable[[], Problem]]]:
    """Group and maker of each problem by name; measured records whose data are absent are left out."""
    found: dict[str, tuple[str, Callable[[], Problem]]] = {}
    for name, make in LAGGED.items():
        if (data_folder() / name).is_dir():
            found[name] = (MEASURED, make)
            if name in MOTIONS:
                found[f"{name}_motion"] = (MEASURED, partial(_as_motion, name))
        else:
            print(f"{name} is left out: its data are not in ORTHAUG_DATA.", file=sys.stderr)
    found["axis"] = (AXIS, axis)
    found["axis_motion"] = (AXIS, partial(axis, True))
    return found | {name: (GENERATED, make) for name, make in oscillators().items()}


def _as_motion(name: str) -> Problem:
    return replace(LAGGED[name](), name=f"{name}_motion", motion=MOTIONS[name])


def error_of(results: dict[str, Result], columns: tuple[str, ...]) -> float | None:
    """The least error of some columns, what diverges at the cap; None where none of them was run."""
    errors = []
    for column in columns:
        result = results.get(column)
        if result is not None and not result.get("failed"):
            errors.append(CAP if result["diverged"] else min(result["error"], CAP))
    return min(errors, default=None)


def default_error(results: dict[str, Result], column: str = "default") -> float | None:
    """The error of one column; a fit that failed or was not done in time counts as one that diverged."""
    result = results.get(column)
    return CAP if result is not None and result.get("failed") else error_of(results, (column,))


def _ratio(upper: float | None, lower: float | None) -> float | None:
    return None if upper is None or lower is None else upper / lower


def regrets(
    results: Results, columns: tuple[str, ...], column: str = "default"
) -> dict[str, float]:
    """log(default / best of some columns) of each problem that has both."""
    ratios = {
        name: _ratio(default_error(one, column), error_of(one, columns))
        for name, one in results.items()
    }
    return {name: log(ratio) for name, ratio in ratios.items() if ratio is not None}


def table(results: Results) -> list[str]:
    """A row per problem: physics alone, default, best, their ratios, and every column."""
    heads = ["record", "physics alone", "default", "best", "which", "default / physics", *COLUMNS]
    lines = ["| " + " | ".join(heads) + " |", len(heads) * "|---" + "|"]
    for name, one in results.items():
        if not one:
            continue
        physics, best = error_of(one, PHYSICS), error_of(one, COLUMNS)
        ratio = _ratio(default_error(one), physics)
        which = next((c for c in COLUMNS if c in one and default_error(one, c) == best), "")
        cells = [
            _number(physics),
            shown(one.get("default")),
            _number(best),
            which,
            _number(ratio, ".2f"),
        ]
        lines.append(
            "| " + " | ".join([name, *cells, *(shown(one.get(c)) for c in COLUMNS)]) + " |"
        )
    return lines


def summary(results: Results) -> list[str]:
    """A row per column: how many diverge, and its regret, over all problems that it was run on."""
    heads = [
        "column",
        "problems",
        "diverge or fail",
        f"above {WORSE} × physics",
        "mean log-regret",
        "largest",
    ]
    lines = [
        "| " + " | ".join([*heads, "mean ratio to physics"]) + " |",
        (len(heads) + 1) * "|---" + "|",
    ]
    for column in COLUMNS:
        ran = {name: one for name, one in results.items() if column in one}
        if not ran:
            continue
        lost = sum(default_error(one, column) == CAP for one in ran.values())
        found = regrets(ran, (*PHYSICS, *LEARNERS), column)
        ratios = [
            r
            for one in ran.values()
            if (r := _ratio(default_error(one, column), error_of(one, PHYSICS)))
        ]
        worse, mean = (
            sum(ratio > WORSE for ratio in ratios),
            np.mean(list(found.values())) if found else np.nan,
        )
        largest = max(found, key=lambda name: found[name], default="")
        at = f"{found[largest]:.2f} ({largest})" if largest else ""
        geometric = exp(np.mean(np.log(ratios))) if ratios else np.nan
        lines.append(
            f"| {column} | {len(ran)} | {lost} | {worse} | {mean:.3f} | {at} | {geometric:.3f} |"
        )
    return lines


def checks(results: Results, groups: dict[str, str]) -> list[tuple[bool | None, str]]:
    """What the collection demands, each with the figure; None where the runs that it needs are not there."""
    measured = {name: one for name, one in results.items() if groups[name] == MEASURED}
    ratios = {
        name: _ratio(default_error(one), error_of(one, PHYSICS)) for name, one in measured.items()
    }
    known = {name: ratio for name, ratio in ratios.items() if ratio is not None}
    above = [f"{name} {ratio:.3g}" for name, ratio in known.items() if ratio > WORSE]
    lost = [name for name, one in results.items() if default_error(one) == CAP]
    found = regrets(results, (*PHYSICS, *LEARNERS))
    strict = regrets(results, COLUMNS)
    mean = float(np.mean(list(found.values()))) if found else np.nan
    strictly = float(np.mean(list(strict.values()))) if strict else np.nan
    worst = ", ".join(
        f"{name} {found[name]:.2f}" for name in sorted(found, key=lambda n: -found[n])[:5]
    )
    done = sum("default" in one for one in results.values())
    return [
        (
            None if not known else not above,
            f"defaults above {WORSE} × physics alone, of {len(known)} measured: {len(above)} "
            f"({', '.join(above)})",
        ),
        (
            None if not done else not lost,
            f"defaults that diverge or fail, of {done}: {len(lost)} ({', '.join(lost)})",
        ),
        (
            mean <= REGRET if isfinite(mean) else None,
            f"mean log-regret over {len(found)}: {mean:.3f}, allowed {REGRET}; against the "
            f"best of all columns {strictly:.3f}; largest: {worst}",
        ),
        _axis_check(results),
        *_time_checks(results),
    ]


@cache
def _grey() -> float:
    return grey_box()


def _axis_check(results: Results) -> tuple[bool | None, str]:
    error = default_error(results.get("axis_motion", {}))
    if error is None:
        return None, "the axis was not run"
    ratio = error / _grey()
    return (
        ratio <= GREY,
        f"axis, default over SciPy's grey box: {ratio:.3f} (NRMSE {error:.4f} over {_grey():.4f})",
    )


def went_up(result: Result) -> bool | None:
    """Whether the free run was trained as well, as far as the result says."""
    said = result.get("criterion")
    return bool(said.get("candidates")) if isinstance(said, dict) else None


def _time_checks(results: Results) -> list[tuple[bool | None, str]]:
    """Compute the time of `default` over `one-step`, with nothing to compile, by whether the free run was trained."""
    found: dict[bool | None, list[float]] = {True: [], False: [], None: []}
    for one in results.values():
        if all(one.get(column, {}).get("warm") for column in ("default", "one-step")):
            found[went_up(one["default"])].append(one["default"]["cpu"] / one["one-step"]["cpu"])
    lines: list[tuple[bool | None, str]] = []
    for up, what in (
        (True, "where the free run was trained"),
        (False, "where it was not"),
        (None, "unknown which"),
    ):
        if ratios := found[up]:
            limit = {True: UP, False: STAYED, None: np.inf}[up]
            middle, largest = float(np.median(ratios)), max(ratios)
            text = (
                f"time over one step, {what} ({len(ratios)}): median {middle:.2f}, largest "
                f"{largest:.2f}"
            )
            lines.append((None if up is None else middle <= limit, text))
    return lines or [(None, "time over one step: run columns default and one-step with --warm")]


def _number(value: float | None, form: str = ".4f") -> str:
    return "" if value is None else "div" if value == CAP else format(value, form)


def report(results: Results, groups: dict[str, str]) -> str:
    """The tables and checks as Markdown."""
    marks = {True: "PASS", False: "FAIL", None: "open"}
    lines = [f"{describe()}; orthaug {program()}", "", *table(results), "", *summary(results), ""]
    return "\n".join(
        [*lines, *(f"- {marks[held]}: {text}" for held, text in checks(results, groups))]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--only", nargs="+", help="names of problems, groups, or parts of names")
    parser.add_argument("--columns", default=",".join(COLUMNS), help=f"of {', '.join(COLUMNS)}")
    parser.add_argument("--jobs", type=int, default=1, help="fits at a time")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "build" / "defaults.json", help="where results are kept"
    )
    parser.add_argument("--again", action="store_true", help="run what is in the store already")
    parser.add_argument(
        "--warm", action="store_true", help="fit twice and time the second, for the checks of time"
    )
    parser.add_argument("--table", action="store_true", help="run nothing, print the tables")
    parser.add_argument(
        "--fill", action="store_true", help="take columns that were not run from other programs"
    )
    given = parser.parse_args()
    columns = tuple(given.columns.split(","))
    if unknown := set(columns) - set(COLUMNS):
        parser.error(
            f"there is no column {', '.join(sorted(unknown))}; columns are {', '.join(COLUMNS)}"
        )
    chosen = {
        name: one
        for name, one in problems().items()
        if not given.only or any(part in name or part == one[0] for part in given.only)
    }
    if not chosen:
        parser.error("--only names no problem of the collection")
    store = Store(given.out)
    if not given.table:
        print(
            f"orthaug {program()}: {len(chosen)} problems, columns {', '.join(columns)}", flush=True
        )
        with ThreadPoolExecutor(given.jobs) as pool:
            futures = [
                pool.submit(_run, make, columns, store, given.again, given.warm)
                for _, make in chosen.values()
            ]
            for future in futures:
                future.result()
    groups = {name: group for name, (group, _) in chosen.items()}
    print(report(latest(store, list(chosen), given.fill), groups))


def _run(
    make: Callable[[], Problem], columns: tuple[str, ...], store: Store, again: bool, warm: bool
) -> None:
    try:
        run(make(), columns, store, again, warm, partial(print, flush=True))
    except RuntimeError as error:  # no spec, so no fit: the others go on
        print(error, flush=True)


if __name__ == "__main__":
    main()
