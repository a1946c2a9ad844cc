"""Learners silenced by their regularization: the warning, and runs with weaker ones.

Evidence starts from a learner that does nothing yet. A learner that first finds a constant, since
the physics has no offset, lowers the loss by that, and evidence may then find that one weight is
all it needs: dry friction is lost so. Such a run is made again without regularization, and with the
ridge that evidence finds where that ended; held-out rows choose. Ard is for training one step
ahead, where "auto" has compared it already.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix
from orthaug._base.errors import Warning
from orthaug.fitting.held_out import HeldOutErrors, mean_square
from orthaug.fitting.learned import FinishedRun, PlannedRun, Task, TrainedLearner
from orthaug.fitting.solvers.minimize import evidence_ridge
from orthaug.fitting.status import Ending

_SILENT = 0.5  # effective weights: fewer do nothing
_CONSTANT = 1.5  # effective weights for each output of the learner: one is a constant
_LOOK = 100  # iterations that show whether a learner without regularization explains more
# Relative: runs that end so close to each other left the same
_SAME_LOSS, _SAME_WEIGHTS = 1e-4, 0.02
_FLAT = 0.01  # of the learner's RMS: a smaller standard deviation is that of a constant


def is_silenced(effective: float, outputs: int) -> bool:
    """Return whether a regularization left at most a constant of each output of the learner."""
    return effective < _CONSTANT * outputs


def add_retries(
    starts: list[PlannedRun],
    runs: list[FinishedRun],
    task: Task,
    make: Callable[[list[PlannedRun], int | None], tuple[list[PlannedRun], list[Any]]],
) -> tuple[list[PlannedRun], list[FinishedRun]]:
    """Return the planned runs with their ends, and runs that were added.

    The latter have weaker regularizations, where evidence silenced all others. A short run without
    regularization from every seed comes first. Where none lowers the loss by more than so many
    weights take from noise, evidence was right, and nothing is added. Otherwise the lowest is
    made again without that limit, and with the ridge that evidence finds there: held-out rows then
    choose between regularizations, where a run from every seed on every block would take most of
    the time.

    Args:
        starts, runs: planned runs and how they ended.
        task: which they trained.
        make: makes planned runs of at most so many iterations, or of as many as the solver allows;
            one that fails is planned anew.
    """
    outputs = task.bound.ny
    by_evidence = all(start.regularization == "evidence" for start in starts)
    ended = all(run.ending.usable and run.ending is not Ending.STOPPED for run in runs)
    if not (by_evidence and ended and all(is_silenced(run.effective, outputs) for run in runs)):
        return starts, runs
    free, looks = make([start._replace(regularization="none") for start in starts], _LOOK)
    usable = [i for i, look in enumerate(looks) if look.ending.usable]
    if not usable:
        return starts, runs
    lowest = min(usable, key=lambda i: task.loss(looks[i]))
    start, end = free[lowest], looks[lowest]
    silent = min(map(task.loss, runs))
    if silent - task.loss(end) <= _chance(end) * silent:
        return starts, runs
    if end.ending is Ending.RUNNING:
        (start, *_), (end, *_) = make([start], None)
    more, others = make([start._replace(regularization=found_ridge(end))], None)
    return [*starts, start, *more], [*runs, end, *others]


def _chance(run: Any) -> float:
    """Return the share of the loss by which the weights of a run lower that of noise.

    γ free parameters lower a sum of N squares by χ²(γ)/N of it; coloured residuals count as fewer.
    """
    count, share = run.objective.samples(run.end.point)
    explained = run.effective + 2 * np.sqrt(2 * run.effective)
    return float(explained / max(count * share, 1.0))


def stand_ins(
    starts: Sequence[PlannedRun],
    runs: Sequence[FinishedRun],
    losses: Sequence[float],
    outputs: int,
) -> list[int]:
    """Return for each run the one that is made on held-out blocks in its place.

    Runs that evidence silenced left the same, and so did those of one regularization that ended
    with one loss and as many effective weights. Of these the one of the fewest iterations, which
    its start leads to most directly, is enough.

    Args:
        starts, runs: planned runs and how they ended.
        losses: of the runs.
        outputs: of the learner.
    """

    def are_alike(i: int, j: int) -> bool:
        one, other = runs[i], runs[j]
        if i == j or starts[i].regularization != starts[j].regularization:
            return i == j
        if not (one.ending.usable and other.ending.usable):
            return False
        if starts[i].regularization == "evidence" and is_silenced(one.effective, outputs):
            return is_silenced(other.effective, outputs)
        return math.isclose(losses[i], losses[j], rel_tol=_SAME_LOSS) and math.isclose(
            one.effective, other.effective, rel_tol=_SAME_WEIGHTS
        )

    alike = [[j for j in range(len(runs)) if are_alike(i, j)] for i in range(len(runs))]
    return [min(group, key=lambda j: runs[j].iterations) for group in alike]


def found_ridge(run: Any) -> float:
    """Return the ridge that evidence finds where a run ended, to three digits."""
    return float(f"{evidence_ridge(run.objective, run.end.point, run.effective):.3g}")


def fold_ridges(
    starts: Sequence[PlannedRun], runs: Sequence[Any], outputs: int
) -> list[float | None]:
    """Return for each run the ridge with which a fold makes it again where evidence silences it.

    Evidence may silence the learner on three of four folds and not on all rows. Such folds say
    nothing on the learner; the ridge of all rows takes their place. None where all rows have none.
    """
    return [
        found_ridge(run)
        if start.regularization == "evidence"
        and run.ending.usable
        and run.ending is not Ending.STOPPED
        and not is_silenced(run.effective, outputs)
        else None
        for start, run in zip(starts, runs, strict=True)
    ]


def retry_warnings(
    planned: int,
    starts: Sequence[PlannedRun],
    runs: Sequence[FinishedRun],
    held_out: HeldOutErrors | None,
    best: int,
) -> list[Warning]:
    """Return the warning that evidence silenced the learner, and the retries.

    None where nothing was.

    Args:
        planned: number of the runs before any were added.
        starts, runs: all runs and how they ended, those by evidence first.
        held_out: their errors.
        best: number of the run that is kept; negative for physics alone.
    """
    choices = list(dict.fromkeys(start.regularization for start in starts))
    if held_out is None or len(runs) == planned:
        return []
    errors = {
        choice: min(
            np.sqrt(mean_square(pieces))
            for start, pieces in zip(starts, held_out.runs, strict=True)
            if start.regularization == choice
        )
        for choice in choices
    }
    found = ", ".join(f"{_name(choice)} {_error(error)}" for choice, error in errors.items())
    kept = "physics alone" if best < 0 else _name(starts[best].regularization)
    effective = max(run.effective for run in runs[:planned])
    tried = " and ".join(_name(choice) for choice in choices[1:])
    text = (
        f"regularization by evidence left {counted_weights(effective)} of the learner, no more "
        f"than a constant. Training was therefore repeated with {tried}. Errors in "
        f"{held_out.where}, in standard deviations of the output: {found}, physics alone "
        f"{_error(np.sqrt(mean_square(held_out.alone)))}. The result is {kept}."
    )
    return [Warning("evidence_retried", text)]


def learner_silent(learned: TrainedLearner, values: Matrix | None = None) -> list[Warning]:
    """Return the warning that a learner is zero or constant; none otherwise.

    Args:
        learned: a trained learner.
        values: of the learner (N, ny) over the training rows, where they are known.
    """
    bound = learned.bound
    if not learned.ending.usable or learned.ending is Ending.SPANNED or not bound.size:
        return []
    if learned.effective < _SILENT or (values is not None and not values.any()):
        does = "the learner contributes nothing: the fit is that of physics alone"
    elif values is not None and is_silenced(learned.effective, bound.ny) and _is_flat(values):
        does = "the learner contributes only a constant"
    else:
        return []
    left = f"training left {counted_weights(learned.effective)} of {bound.size}"
    text = (
        f"{does} ({left}). Either its inputs explain nothing more, and it can be left out, or "
        'its regularization was too strong. Compare `regularization = "none"` and a small '
        "ridge such as 0.01 on held-out data. Write a missing constant as a term of the "
        "physics."
    )
    return [Warning("learner_silent", text)]


def counted_weights(effective: float) -> str:
    """Return a number of effective weights in words."""
    return f"{effective:.1f} effective weights"


def _is_flat(values: Matrix) -> bool:
    """Return whether every output of the learner is a constant."""
    size = np.sqrt(np.mean(values**2, axis=0))
    return bool(np.all(np.std(values, axis=0) <= _FLAT * size))


def _name(choice: str | float) -> str:
    if isinstance(choice, str):
        return "no regularization" if choice == "none" else choice
    return f"a ridge of {choice:g}"


def _error(error: float) -> str:
    return f"{error:.3g}" if np.isfinite(error) else "infinite (a run diverges)"
