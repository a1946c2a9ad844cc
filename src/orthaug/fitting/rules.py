"""Rules between restarts, solver, criterion, regularization and data, for `estimate` and for the spec."""

from __future__ import annotations

from collections.abc import Sequence

from orthaug._base.errors import KeyedError, shown
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.kinds import SOLVERS
from orthaug.fitting.solvers.solver import Solver


def check_starts(restarts: int, seed: int, *, ensemble: bool) -> None:
    """Raise InputError for seeds that are too large, or an ensemble of one."""
    if seed + restarts >= 2**63:
        words = f": found {shown(seed)}; expected seeds below 2**63 for all restarts"
        raise KeyedError(f"`seed` must be below 2**63; got {shown(seed)}.", "seed", words)
    if ensemble and restarts < 2:
        words = f": found {shown(restarts)}; expected 2 or more for an ensemble"
        raise KeyedError("an ensemble needs `restarts` of 2 or more to be the median of.", "restarts", words)


def check_scored(criterion: Criterion, longest: int) -> None:
    """Raise InputError where nothing is scored: the longest experiment ends within the washout.

    Args:
        longest: usable rows of the longest experiment.
    """
    flown = criterion.flown
    if flown is None or flown.washout < longest:
        return
    text = (
        f"nothing is scored: the longest experiment has {longest} usable rows, and the first "
        f"{flown.washout} of a segment are washout; shorten it, or the horizon."
    )
    if criterion.simulates:
        rows = f"the {longest} usable rows of the longest experiment, or nothing is scored"
        raise KeyedError(text, "washout", f": found {flown.washout}; expected less than {rows}")
    rows = f"the longest experiment has {longest} usable rows"
    raise KeyedError(text, "horizon", f": found {flown.segment}; {rows}")


def check_solver(solver: Solver, criterion: Criterion, regularizations: Sequence[object]) -> None:
    """Raise InputError where a solver without normal equations is asked for what needs them."""
    if solver.gauss_newton:
        return
    name = SOLVERS.kind_of(solver)
    able = " or ".join(kind for kind, known in SOLVERS.items() if known.gauss_newton)
    if not criterion.one_step:
        raise KeyedError(
            "only `LevenbergMarquardt` trains on a free run or more than one step ahead; take that solver.",
            "solver",
            f" = {name} trains one step ahead; expected {able} here",
        )
    if "evidence" in regularizations:
        raise KeyedError(
            f"evidence regularization needs the Gauss-Newton matrix of the {able} solver.",
            "regularization",
            f" = evidence; expected solver {able} with it",
        )


def ridge_of(regularization: str | float) -> tuple[float, bool]:
    """The ridge α that a run starts with, and whether evidence re-estimates it."""
    evidence = regularization == "evidence"
    return (1.0 if evidence else 0.0 if regularization == "none" else float(regularization)), evidence
