"""The bias of a motion's parameters by a term that its equations lack: how large it is, and what tells of it.

Beside a learner the term's size is that by which it explains what was learned. Without one it is what the free run's
residual tells: one Gauss-Newton step. Only terms that someone suspects are looked at.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from orthaug._base.warning import Warning
from orthaug.analysis.budget import AS_MUCH, LEAST_SHARE, ParameterBias, parameter_biases, told_biases, with_bias
from orthaug.analysis.motion_bias import TermBias
from orthaug.fitting.motion_estimates import MotionEstimate

_SURE = 3.3  # standard errors of a coefficient that the residual tells: one in a thousand is so large by chance
_ELSEWHERE = 0.5  # of a bias, from which that of a rival is another one


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
    std = np.full(len(value), np.nan) if fit.std is None else fit.std
    apart = [np.abs((rival.coefficient_found or 0.0) * rival.per_unit - bias) for rival in rivals]
    rest = np.hypot(spread * cause.per_unit, np.max([np.zeros(len(value)), *apart], axis=0))
    ends = with_bias(value, std, fit.freedom, bias, rest)
    parameters = fit.problem.motion.parameters
    ends = np.clip(ends, [[p.min] for p in parameters], [[p.max] for p in parameters])
    rows = parameter_biases(cause.names, value, std, bias, ends, cause.suspect.name, share)
    found = MotionBudget(cause, coefficient, share, rows, ())
    far = [rival for rival, by in zip(rivals, apart, strict=True) if np.any(by > _ELSEWHERE * np.abs(bias))]
    warning = _warning(found, far, learns=learns)
    return found if warning is None else replace(found, warnings=(warning,))


def rivals_of(cause: TermBias, table: Sequence[TermBias]) -> list[TermBias]:
    """Terms that explain as much of the learner as a cause, which cannot be told from it."""
    least = AS_MUCH * (cause.explained or 0.0)
    return [entry for entry in table if entry is not cause and (entry.explained or 0.0) >= max(least, LEAST_SHARE)]


def _of_learner(table: Sequence[TermBias], smooth: Sequence[TermBias]) -> tuple[TermBias, float, float, float] | None:
    """The term that explains most of the learner: its coefficient, share, and how unsure the coefficient is."""

    def explains(entry: TermBias) -> float:
        return entry.explained or 0.0

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


def _warning(budget: MotionBudget, rivals: Sequence[TermBias], *, learns: bool) -> Warning | None:
    """One sentence on what is biased by more than its standard error: cause, size, remedy."""
    large = [entry for entry in budget.parameters if (entry.errors or 0.0) > 1]
    if not large:
        return None
    what = "the learner" if learns else "the squares that the free run leaves"
    unit = f" {budget.cause.suspect.unit}".rstrip()
    named = ", ".join(rival.suspect.name for rival in sorted(rivals, key=lambda rival: -(rival.explained or 0.0))[:2])
    explain = "explain" if len(rivals) > 1 else "explains"
    other = f" ({named} {explain} as much and would move them elsewhere)" if rivals else ""
    return Warning(
        "biased",
        f"{budget.cause.suspect.name} of size {budget.coefficient:.3g}{unit} explains {100 * budget.share:.0f} % of "
        f"{what} and moves {told_biases(large)}, which the standard errors do not "
        f"cover{other}: add it to the equation of {budget.cause.equation}, with its size as a parameter.",
    )
