"""Fits whose training ended while the loss still fell noticeably: no intervals of θ.

Under the training measure the orthogonal structure's `θ̂ = Φ⁺Y` one step ahead is the same after
every iteration (F1), and its intervals depend on training through the variance of the residual
alone. Everywhere else θ moves with the weights: split along some directions only, under another
measure, or trained on the free run.
"""

from __future__ import annotations

from dataclasses import replace

from orthaug._base.errors import Warning
from orthaug._base.lines import percent, plural
from orthaug.fitting.elimination import directions
from orthaug.fitting.learned import TrainedLearner
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.solvers.limit import Tail, noticeable_in
from orthaug.fitting.status import Ending
from orthaug.fitting.structures import Structure
from orthaug.inference.measures import Training
from orthaug.physics.problem import Problem

NOT_CONVERGED = "not_converged"
# of the loss: the standard errors of a θ that does not move change by half of that
_SETTLED_THETA = 1e-3


def noticeable_fall(structure: Structure, decoupled: bool, samples: int) -> float:
    """Return the smallest fall of the loss over a window that is worth more steps.

    Args:
        structure: with its measure.
        decoupled: whether θ under the training measure does not depend on the learner.
        samples: number of residuals.
    """
    return (
        _SETTLED_THETA if decoupled and structure.measure == Training() else noticeable_in(samples)
    )


def follows_training(structure: Structure, problem: Problem, learned: TrainedLearner) -> bool:
    """Return whether θ of a lagged model moves with the weights."""
    if learned.errors is not None or learned.coefficients is not None:
        return True
    whole = structure.projects and directions(structure, problem) is None
    return not whole or structure.measure != Training()


def is_unfinished(learned: TrainedLearner) -> bool:
    """Return whether training ended while the loss still fell noticeably."""
    return learned.ending.usable and learned.tail is not None and learned.tail.noticeable


def withheld(learned: TrainedLearner) -> TrainedLearner:
    """Return the result of a run without the parts that give intervals."""
    errors = None if learned.errors is None else learned.errors._replace(covariance=None)
    return replace(learned, gram=None, middle=None, errors=errors)


def not_converged(learned: TrainedLearner) -> Warning:
    """Return the warning that there are no intervals, with cause and remedy."""
    assert learned.tail is not None
    text = (
        f"no intervals: training ended after {plural(learned.tail.done, 'iteration')} while "
        f"the loss was still falling ({_fall(learned.tail)}). The parameters may still move by "
        "more than their standard errors. "
    )
    if learned.ending is Ending.STOPPED:
        return Warning(NOT_CONVERGED, f"{text}Train to the end.")
    if not learned.bound.learns:
        text += (
            "Give initial values nearer to the data, fix what the data do not determine, or "
            "allow more `iterations`"
        )
    else:
        text += (
            "Take a smaller learner or a stronger regularization, which converge sooner, or "
            "allow more `iterations`"
        )
    if not learned.tail.prolonged and learned.tail.limit != LevenbergMarquardt().iterations:
        text += (
            ". Without the key `iterations`, training continues while the loss falls, up to "
            "3000 iterations"
        )
    return Warning(NOT_CONVERGED, f"{text}.")


def ending_in_words(ending: Ending, tail: Tail | None) -> str:
    """Return the meaning of the limit for a run; empty where its ending says all."""
    if tail is None or not ending.usable:
        return ""
    words = ""
    if ending is Ending.RUNNING and tail.limit:
        words = f"training stopped at its limit of {plural(tail.done, 'iteration')}"
        words += f" while the loss was still falling ({_fall(tail)}); the model is usable, "
        words += "more iterations may improve it"
        if not tail.noticeable:
            words = (
                f"training stopped at its limit of {plural(tail.done, 'iteration')}, and the "
                f"loss hardly fell any more ({_fall(tail)})"
            )
    if tail.prolonged:
        past = (
            f"training continued past its limit of {plural(tail.limit, 'iteration')}, because "
            "the loss was still falling"
        )
        words = f"{past}; {words or ending.message}".rstrip("; ")
    return words


def _fall(tail: Tail) -> str:
    over = "the last one" if tail.window == 1 else f"the last {tail.window}"
    return f"by {percent(tail.fall)} over {over}"
