"""What a motion's learner found, or its free run leaves, explained by a term, and the bias that follows from it.

With a learner as of difference equations (`budget`), over the points of the measure. Without one only terms that
someone suspects are looked at; their size is what the free run's residual tells: one Gauss-Newton step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.lines import percent
from orthaug._base.warning import Warning
from orthaug.analysis.budget import (
    AS_MUCH,
    LEAST_SHARE,
    SURE_SHARE,
    ParameterBias,
    explains,
    parameter_biases,
    told_biases,
    with_bias,
)
from orthaug.analysis.motion_bias import TermBias, ground_after, softened_bias, usual_biases
from orthaug.analysis.motion_suspects import MotionSuspect
from orthaug.fitting.motion_estimates import MotionEstimate

_AS_CLOSE = 2.0  # times what a cause leaves of the learner: a rival that leaves no more cannot be told from it
_CLOSE = 0.005  # of the learner: what leaves no more is as good as any
_SURE = 3.3  # standard errors of a coefficient that the residual tells: one in a thousand is so large by chance
_ELSEWHERE = 0.5  # of a bias, from which that of a rival is another one
_NOTHING = 0.01  # of the learned equations: a learner that is smaller, and biases nothing, found nothing
_UNMOVED = 0.1  # standard errors of every parameter


@dataclass(frozen=True, eq=False)
class MotionBudget:
    """The bias of every parameter by the term that explains `share` of the learner, or of what the free run leaves."""

    cause: TermBias
    coefficient: float
    share: float
    parameters: tuple[ParameterBias, ...]
    warnings: tuple[Warning, ...]

    def of(self, name: str) -> ParameterBias | None:
        """The bias of a parameter."""
        return next((entry for entry in self.parameters if entry.name == name), None)


def told_budget(
    fit: MotionEstimate, declared: Sequence[MotionSuspect], table: Sequence[TermBias]
) -> MotionBudget | None:
    """By the declared suspects; where these are not sure to be it, by the usual ones too that the learner sees.

    Args:
        table: what every declared suspect does to the fit.
    """
    smooth = softened_bias(fit, declared)
    budget = motion_budget(fit, table, smooth)
    if budget is not None and budget.share >= SURE_SHARE:
        return budget
    usual, softer = usual_biases(fit)
    return motion_budget(fit, (*table, *usual), (*smooth, *softer)) if usual else budget


def motion_budget(
    fit: MotionEstimate, table: Sequence[TermBias], smooth: Sequence[TermBias] = ()
) -> MotionBudget | None:
    """By the suspect that explains most; None where none explains enough.

    Args:
        table: what every suspect does to the fit.
        smooth: the same of terms that stand beside those of the table (`softened_bias`), named where they explain
            clearly more of a learner.
    """
    learns = fit.model.form.bound is not None
    named = _of_learner(table, smooth) if learns else _of_residual(table)
    if named is None:
        return None
    cause, coefficient, share, spread = named
    rivals = rivals_of(cause, (*table, *smooth)) if learns else []
    bias, value = coefficient * cause.per_unit, fit.values
    std, none = np.full(len(value), np.nan) if fit.std is None else fit.std, np.zeros(len(value))
    if learns and (fit.split_by.share or 0.0) < _NOTHING and not np.any(np.abs(bias) > _UNMOVED * std):
        return None
    apart = [np.abs(_moved(rival) - bias) for rival in rivals]
    after = _next_after(fit, cause, (*table, *smooth)) if learns else None
    beside = none if after is None else _moved(after)
    rest = np.linalg.norm([spread * cause.per_unit, beside, np.max([none, *apart], axis=0)], axis=0)
    ends = with_bias(value, std, fit.freedom, bias, rest)
    parameters = fit.problem.motion.parameters
    ends = np.clip(ends, [[p.min] for p in parameters], [[p.max] for p in parameters])
    rows = parameter_biases(cause.names, value, std, bias, ends, cause.suspect.name, share)
    found = MotionBudget(cause, coefficient, share, rows, ())
    far = [rival for rival, by in zip(rivals, apart, strict=True) if np.any(by > _ELSEWHERE * np.abs(bias))]
    warning = _motion_warning(found, far, learns=learns)
    return found if warning is None else replace(found, warnings=(warning,))


def rivals_of(cause: TermBias, table: Sequence[TermBias]) -> list[TermBias]:
    """Terms that explain about as much of the learner as a cause, which cannot be told from it."""
    most = min(max(_AS_CLOSE * (1 - explains(cause)), _CLOSE), 1 - LEAST_SHARE)
    return [entry for entry in table if entry is not cause and 1 - explains(entry) <= most]


def _next_after(fit: MotionEstimate, cause: TermBias, table: Sequence[TermBias]) -> TermBias | None:
    """The term that explains most of what a cause leaves of the learner."""
    ground = ground_after(fit)
    return None if ground is None else max(ground.after(cause, table), key=explains, default=None)


def _moved(entry: TermBias) -> Vector:
    """What a term of the size found makes of the parameters."""
    return (entry.coefficient_found or 0.0) * entry.per_unit


def _of_learner(table: Sequence[TermBias], smooth: Sequence[TermBias]) -> tuple[TermBias, float, float, float] | None:
    """The term that explains most of the learner: its coefficient, share, and how unsure the coefficient is."""
    best, other = max(table, key=explains, default=None), max(smooth, key=explains, default=None)
    if best is not None and other is not None and explains(best) < AS_MUCH * explains(other):
        best = other
    if best is None or best.explained is None or best.explained < LEAST_SHARE or best.coefficient_found is None:
        return None
    unsure = abs(best.coefficient_found) * np.sqrt((1 - best.explained) / best.explained)
    return best, best.coefficient_found, best.explained, float(unsure)


def _of_residual(table: Sequence[TermBias]) -> tuple[TermBias, float, float, float] | None:
    """The term that lowers the residual most, where that is no chance and most of what is no white noise.

    What stays beyond white noise counts as biased by as much for its size, of unknown sign.
    """
    sure = [entry for entry in table if entry.residual is not None and abs(entry.residual.t or 0.0) >= _SURE]
    best = max(sure, key=lambda entry: entry.residual.share if entry.residual else 0.0, default=None)
    if best is None or best.residual is None or best.residual.std is None:
        return None
    told, std = best.residual, best.residual.std
    if told.share < LEAST_SHARE * (told.share + told.left):
        return None
    unsure = np.hypot(std, told.coefficient * np.sqrt(told.left / told.share))
    return best, told.coefficient, told.share, float(unsure)


def _motion_warning(budget: MotionBudget, rivals: Sequence[TermBias], *, learns: bool) -> Warning | None:
    """One sentence on what is biased by more than its standard error: cause, size, remedy."""
    large = [entry for entry in budget.parameters if (entry.errors or 0.0) > 1]
    if not large:
        return None
    cause, first = budget.cause, sorted(rivals, key=explains, reverse=True)[:2]
    named = " and ".join(f"{rival.suspect.name}, {percent(explains(rival))}" for rival in first)
    other = f" (near it: {named}, and would move them elsewhere)" if rivals else ""
    cure = f"add it to the equation of {cause.equation}, with its size as a parameter"
    what = "the learner" if learns else "the squares that the free run leaves"
    size = f"{budget.coefficient:.3g} {cause.suspect.unit}".rstrip()
    if learns and budget.share < SURE_SHARE:
        return Warning(
            "biased",
            f"what the learner found looks most like {cause.suspect.name} of size {size} ({percent(budget.share)} of "
            f"it), which would move {told_biases(large)}, and the standard errors do not cover that{other}: if it is "
            f"that term, {cure}.",
        )
    return Warning(
        "biased",
        f"{cause.suspect.name} of size {size} explains {100 * budget.share:.0f} % of {what} and moves "
        f"{told_biases(large)}, which the standard errors do not cover{other}: {cure}.",
    )
