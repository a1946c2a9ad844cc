"""Rules between restarts, solver, criterion, regularization and data; limits of cost."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any

from orthaug._base.checks import check_count
from orthaug._base.errors import InputError, KeyedError, show
from orthaug._base.memory import check_limit, check_memory, in_words
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.kinds import SOLVERS, Solver
from orthaug.fitting.structures import Structure
from orthaug.models.learners import Learner, learns, remembers
from orthaug.models.rows import Room
from orthaug.physics.motion import Motion
from orthaug.physics.problem import PosedProblem

LONGEST_FIT = 30 * 86400.0  # s
_RATE, _STEP = 2e10, 2e-4  # products per second and core; seconds of an iteration at least
_MOST = 10**18  # weights or runs; more are as impossible, and would overflow
# Of regressors and outputs, in a fit with its scores and findings; measured on 10⁶ rows
_COPIES = 32
_FEWEST = 50  # iterations that are counted on where more are allowed: most runs converge


def checked_starts(restarts: int, seed: int, *, warm: bool, ensemble: bool) -> tuple[int, int]:
    """Return the number of starts and the first seed as whole numbers; `warm` means one start."""
    restarts, seed = check_count(restarts, "restarts"), check_count(seed, "seed", least=0)
    check_starts(1 if warm else restarts, seed, ensemble=ensemble)
    return restarts, seed


def check_starts(restarts: int, seed: int, *, ensemble: bool) -> None:
    """Raise InputError for seeds that are too large, or an ensemble of one."""
    if seed + restarts >= 2**63:
        words = f": found {show(seed)}; expected seeds below 2**63 for all restarts"
        raise KeyedError(f"`seed` must be below 2**63; got {show(seed)}.", "seed", words)
    if ensemble and restarts < 2:
        words = f": found {show(restarts)}; expected 2 or more for an ensemble"
        raise KeyedError(
            "an ensemble is the median of its restarts; give `restarts` of 2 or more.",
            "restarts",
            words,
        )


def check_scored(criterion: Criterion, longest: int) -> None:
    """Raise InputError where nothing is scored: the longest experiment ends within the washout.

    Args:
        longest: usable rows of the longest experiment.
    """
    free_run = criterion.free_run
    if free_run is None or free_run.washout < longest:
        return
    text = (
        f"nothing is scored: the longest experiment has {longest} usable rows, and the first "
        f"{free_run.washout} of a segment are washout; shorten it, or the horizon."
    )
    if criterion.simulates:
        rows = f"the {longest} usable rows of the longest experiment, or nothing is scored"
        raise KeyedError(text, "washout", f": found {free_run.washout}; expected less than {rows}")
    rows = f"the longest experiment has {longest} usable rows"
    raise KeyedError(text, "horizon", f": found {free_run.steps}; {rows}")


def check_solver(solver: Solver, criterion: Criterion, regularizations: Sequence[object]) -> None:
    """Raise InputError where a solver without normal equations cannot do what is asked."""
    if "ard" in regularizations and not criterion.one_step:
        raise KeyedError(
            "ard regularization is for training one step ahead; use evidence on the free run.",
            "regularization",
            " = ard; expected none, evidence or a number on the free run, or more than one "
            "step ahead",
        )
    if solver.gauss_newton:
        return
    name = SOLVERS.kind_of(solver)
    able = " or ".join(kind for kind, known in SOLVERS.items() if known.gauss_newton)
    if not criterion.one_step:
        raise KeyedError(
            "only `LevenbergMarquardt` trains on a free run or more than one step ahead; take "
            "that solver.",
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


def check_no_memory(learner: Learner | None) -> None:
    """Raise InputError for a learner with states of its own beside a problem of lagged physics."""
    if remembers(learner):
        raise InputError(
            "a learner with `states` is trained beside equations of motion, and this problem is "
            "posed with lagged physics. Call `estimate` with record and physics, which writes "
            "that as a motion of its lags."
        )


def choose_regularizations(
    given: object,
    solver: Solver,
    criterion: Criterion,
    structure: Structure,
    *,
    linear: bool,
    validated: bool,
    by_evidence: bool = False,
    learner: Learner | None = None,
) -> tuple[Any, ...]:
    """Return the regularizations of every start: those given, or those of "auto".

    docs/decisions/regularization.md has the table.

    Args:
        linear: whether the physics is linear in θ, which is then solved.
        validated: whether a validation part chooses.
        by_evidence: whether the kind of physics is regularized by evidence.
        learner: one that is linear in its weights needs none.
    """
    if not isinstance(given, str) or given != "auto":
        return tuple(given) if isinstance(given, list | tuple) else (given,)
    if getattr(learner, "linear", False):
        return ("none",)
    if by_evidence:
        return ("evidence",)
    if not solver.gauss_newton or structure.from_initial:
        return ("none",)
    if not (criterion.one_step and linear):
        return ("none", "evidence") if validated else ("none",)
    return ("none", "ard")


def ridge_of(regularization: str | float) -> tuple[float, bool]:
    """Return the ridge α that a run starts with, and whether evidence re-estimates it."""
    evidence = regularization in ("evidence", "ard")
    return (
        1.0 if evidence else 0.0 if regularization == "none" else float(regularization)
    ), evidence


def check_motion_choices(
    motion: Motion,
    learner: Learner | None,
    structure: Structure,
    criterion: Criterion,
    solver: Solver,
) -> None:
    """Raise InputError for choices that a motion cannot be trained with."""
    states, outputs = motion.learned
    if learns(learner) and not (states or outputs):
        raise KeyedError(
            "there is a learner, but no state and no output of the motion is learned. Set "
            "`learned` where it is added, or give `learner=None` for physics alone.",
            "learner",
            ": no state and no output has `learned = true`; expected one, or kind none",
        )
    if criterion.free_run is None or not criterion.simulates:
        raise KeyedError(
            "a motion is trained on its free run; take `Simulation(…)`: its states are not "
            "measured, so there is no error one step ahead.",
            "focus",
            " = prediction; expected simulation: states of a motion or learner are not measured",
        )
    if not structure.projects:
        raise KeyedError(
            "a motion has the orthogonal structure: its parameters are the nearest physics; "
            f"got {structure.name}.",
            "kind",
            f" = {structure.name}; expected orthogonal for a motion or beside learner.states",
        )
    if not solver.gauss_newton:
        raise KeyedError(
            "a motion is trained by `LevenbergMarquardt`; take that solver.",
            "solver",
            f" = {SOLVERS.kind_of(solver)}; expected levenberg-marquardt for a motion",
        )


def check_joint(solver: Solver, ridge: float, evidence: bool, *, resident: bool) -> None:
    """Raise InputError for options that need θ solved, or normal equations, one step ahead."""
    if solver.gauss_newton and (ridge or not resident):  # evidence starts with a ridge
        what = "regularization" if ridge else "training on rows that are not in memory"
        raise InputError(
            f"{what} needs a solved θ; leave out `from_initial`, which trains θ from θ⁰."
        )
    if evidence or not resident:
        what = "evidence regularization" if evidence else "training on rows that are not in memory"
        raise InputError(f"{what} needs the Gauss-Newton matrix of the levenberg-marquardt solver.")


def check_cost(
    learner: Any,
    *,
    rows: int,
    features: int,
    outputs: int,
    iterations: int,
    runs: int,
    held: int | None = None,
    room: Room | None = None,
) -> None:
    """Raise InputError for normal equations beyond memory, or more than a month of training.

    Args:
        learner: None for physics alone, which costs nothing; one without `weights` is accepted.
        rows: usable rows.
        features: of the learner.
        outputs: of the learner.
        iterations: of a run at most.
        runs: restarts times regularizations.
        held: rows that are in memory; None for all.
        room: of the workers or devices that add up; None where that is this process.
    """
    held = rows if held is None else held
    check_limit(8.0 * _COPIES * held * (features + outputs), f"a fit of {held} rows")
    if not hasattr(learner, "weights"):
        return
    weights, cores = min(learner.weights(features, outputs), _MOST), os.cpu_count() or 1
    runs = min(runs, _MOST)
    side_by_side = min(runs, cores)
    what = f"training a learner of {weights} weights" + (f" in {runs} runs" if runs > 1 else "")
    check_memory(
        8.0 * (3 * side_by_side * weights**2 + runs * weights + held * (features + outputs)), what
    )
    if room is not None and (size := 8.0 * room.matrices * weights**2) > room.size:
        raise InputError(
            f"{what} takes {in_words(size)} on each worker or device, for {room.matrices} "
            f"matrices of its weights; {room.place} has {in_words(room.size)}. Take a smaller "
            "learner, or larger workers."
        )
    products = rows * outputs * weights**2 + weights**3 / 3
    seconds = runs * min(iterations, _FEWEST) * max(products / _RATE, _STEP) / cores
    if seconds > LONGEST_FIT:
        raise InputError(
            f"{what} on {rows} rows would take {_days(seconds)} or more; {_days(LONGEST_FIT)} "
            "are the limit. Take fewer restarts, a smaller learner, or every n-th row."
        )


def check_sizes(
    problem: PosedProblem, learner: Learner | None, *, iterations: int, runs: int, room: Room | None
) -> None:
    """Raise InputError for a fit that would take more memory or time than there is.

    Args:
        problem: posed; the other arguments as of `check_cost`.
    """
    check_cost(
        learner,
        rows=problem.count,
        features=problem.feature_count,
        outputs=problem.learner_outputs,
        held=problem.rows_in_memory,
        iterations=iterations,
        runs=runs,
        room=room,
    )


def _days(seconds: float) -> str:
    days = seconds / 86400
    return (
        f"{days:.0f} days"
        if days < 1000
        else f"{days / 365.25:.3g} years"
        if math.isfinite(days)
        else "ages"
    )
