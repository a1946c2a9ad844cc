"""Rules between restarts, solver, criterion, regularization and data, for `estimate` and for the spec."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from orthaug._base.checks import check_count
from orthaug._base.errors import InputError, KeyedError, shown
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.kinds import SOLVERS
from orthaug.fitting.solvers.solver import Solver
from orthaug.fitting.structures import Structure
from orthaug.models.learners import Learner
from orthaug.physics.motion import Motion


def checked_starts(restarts: int, seed: int, *, warm: bool, ensemble: bool) -> tuple[int, int]:
    """How many starts and from which seed, as whole numbers; a `warm` start is one."""
    restarts, seed = check_count(restarts, "restarts"), check_count(seed, "seed", least=0)
    check_starts(1 if warm else restarts, seed, ensemble=ensemble)
    return restarts, seed


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
    if "ard" in regularizations and not criterion.one_step:
        raise KeyedError(
            "ard regularization is for training one step ahead; take evidence on the free run.",
            "regularization",
            " = ard; expected none, evidence or a number on the free run, or more than one step ahead",
        )
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
    for choice in ("evidence", "ard"):
        if choice in regularizations:
            raise KeyedError(
                f"{choice} regularization needs the Gauss-Newton matrix of the {able} solver.",
                "regularization",
                f" = {choice}; expected solver {able} with it",
            )


def tried(
    given: Any,
    solver: Solver,
    criterion: Criterion,
    structure: Any,
    *,
    linear: bool,
    validated: bool,
    motion: bool = False,
    learner: Learner | None = None,
) -> tuple[Any, ...]:
    """The regularizations of every start: those given, or what "auto" stands for (docs/design.md has the table).

    Args:
        linear: whether the physics is linear in θ, which is then solved.
        validated: whether a validation part chooses.
        motion: whether the physics are equations of motion.
        learner: one that is linear in its weights needs none.
    """
    if not isinstance(given, str) or given != "auto":
        return tuple(given) if isinstance(given, list | tuple) else (given,)
    if getattr(learner, "linear", False):
        return ("none",)
    if motion:
        return ("evidence",)
    if not solver.gauss_newton or structure.from_initial:
        return ("none",)
    if not (criterion.one_step and linear):
        return ("none", "evidence") if validated else ("none",)
    return ("none", "ard")


def ridge_of(regularization: str | float) -> tuple[float, bool]:
    """The ridge α that a run starts with, and whether evidence re-estimates it."""
    evidence = regularization in ("evidence", "ard")
    return (1.0 if evidence else 0.0 if regularization == "none" else float(regularization)), evidence


def check_motion_choices(
    motion: Motion, learner: Learner | None, structure: Structure, criterion: Criterion, solver: Solver
) -> None:
    """Raise InputError for choices that a motion cannot be trained with."""
    states, outputs = motion.learned
    if learner is not None and not (states or outputs):
        raise KeyedError(
            "there is a learner, but no state and no output of the motion is learned; set `learned` where it is added.",
            "learner",
            ": no state and no output has `learned = true`; expected one, or kind none",
        )
    if criterion.flown is None or not criterion.simulates:
        raise KeyedError(
            "a motion is trained on its free run; take `Simulation(…)`: its states are not measured, so there is no "
            "error one step ahead.",
            "focus",
            " = prediction; expected simulation for a motion, whose states are not measured",
        )
    if not structure.projects:
        raise KeyedError(
            f"a motion has the orthogonal structure: its parameters are the nearest physics; got {structure.name}.",
            "kind",
            f" = {structure.name}; expected orthogonal for a motion",
        )
    if not solver.gauss_newton:
        raise KeyedError(
            "a motion is trained by `LevenbergMarquardt`; take that solver.",
            "solver",
            f" = {SOLVERS.kind_of(solver)}; expected levenberg-marquardt for a motion",
        )


def check_joint(solver: Any, ridge: float, evidence: bool, *, resident: bool) -> None:
    """Raise InputError for what needs θ to be solved, or the solver to see normal equations, one step ahead."""
    if solver.gauss_newton and (ridge or not resident):  # evidence starts with a ridge
        what = "regularization" if ridge else "training on rows that are not in memory"
        raise InputError(f"{what} needs a solved θ; leave out `from_initial`, which trains θ from θ⁰.")
    if evidence or not resident:
        what = "evidence regularization" if evidence else "training on rows that are not in memory"
        raise InputError(f"{what} needs the Gauss-Newton matrix of the levenberg-marquardt solver.")
