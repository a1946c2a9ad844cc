"""How much of a motion's parameters is an error of its integrator: what twice as many substeps would make of them.

With S the sensitivities of the free run, the starts eliminated, and Δy what the finer steps add to its outputs, a fit
with them ends at `(c, w) − (SᵀS + ridge)⁻¹SᵀΔy`: one Gauss-Newton step. S is that of the coarse steps; what finer ones
change in it acts on the residual, which hardly follows S, while Δy follows it as the outputs do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.lines import percent
from orthaug._base.warning import Warning
from orthaug.analysis.motion_response import LOOSER, solved
from orthaug.fitting.initial_states import InitialStates
from orthaug.fitting.motion_estimates import MotionEstimate
from orthaug.fitting.segments import respond, sensitivity
from orthaug.physics.motion import MOST_SUBSTEPS

_LARGE = 0.1  # standard errors
_LARGE_SHARE = 1e-3  # of a parameter that has no standard error


@dataclass(frozen=True, eq=False)
class SubstepBias:
    """p̂ less what a fit with twice the `substeps` gives, to first order (np,)."""

    names: tuple[str, ...]
    substeps: int
    value: Vector
    errors: Vector
    """Its size in standard errors (np,); NaN where there are none."""
    warnings: tuple[Warning, ...] = ()

    def as_dict(self) -> dict[str, float]:
        """By parameter."""
        return dict(zip(self.names, map(float, self.value), strict=True))


def substep_bias(fit: MotionEstimate) -> SubstepBias | None:
    """The part of p̂ that is the integrator's; None of a motion that is not integrated, or without normal equations.

    Args:
        fit: of a motion, from `estimate`.

    Returns:
        p̂ less what a fit with twice the substeps would give, to first order, in the units of p and in standard errors.
    """
    motion, course, numbers = fit.problem.motion, fit.course, fit.model.numbers
    slope, substeps = fit.split_by.slope, course.dynamics.substeps
    if motion.integrator == "discrete" or fit.scores is None or slope is None or 2 * substeps > MOST_SUBSTEPS:
        return None
    c, w = np.asarray(numbers.theta - numbers.theta_aux), np.asarray(numbers.weights)
    finer = course.refined(2 * substeps)
    outputs = respond(finer.dynamics, finer.numbers(c, w), finer.segments, fit.states)
    moved = course.segments._replace(target=outputs)  # whose errors are what the finer steps add
    slopes = sensitivity(course.dynamics, course.numbers(c, w), moved, fit.states, fit.scores.weight)
    rows = LOOSER * course.objective().start_rows
    at = np.asarray(fit.states)
    information, gradient = InitialStates(at, free=True).eliminate(slopes, at, rows)[:2]
    if not np.isfinite(information).all() or not np.isfinite(gradient).all():
        return None
    low, high = motion.coordinates.bounds
    free = np.concatenate([(low < c) & (c < high), np.ones(len(w), dtype=bool)])
    information = information + np.diag(np.concatenate([0 * c, fit.model.statistics.ridge / fit.scores.unit + 0 * w]))
    step = np.zeros(len(free))
    step[free] = solved(information[np.ix_(free, free)], gradient[free])
    value = motion.coordinates.slopes(fit.theta) * (slope @ step)
    std = np.full(len(c), np.nan) if fit.std is None else fit.std
    errors = np.abs(value) / np.where(std > 0, std, np.nan)
    found = SubstepBias(motion.names, substeps, value, errors)
    return SubstepBias(motion.names, substeps, value, errors, _warnings(found, fit))


def _warnings(found: SubstepBias, fit: MotionEstimate) -> tuple[Warning, ...]:
    """One sentence on the parameters that finer steps would move."""
    told = []
    for name, moved, errors, value in zip(found.names, found.value, found.errors, fit.values, strict=True):
        share = f", {percent(moved / value, sign='+')}" if value else ""
        if np.isfinite(errors) and errors > _LARGE:
            told.append(f"{name} by {moved:+.2g} ({errors:.2g} standard errors{share})")
        elif np.isnan(errors) and name not in fit.unidentified and abs(moved) > _LARGE_SHARE * abs(value):
            told.append(f"{name} by {moved:+.2g}{share.replace(',', ' (', 1).replace('( ', '(')}{')' if share else ''}")
    if not told:
        return ()
    steps = f"{found.substeps} substep{'s' * (found.substeps > 1)} in a sample"
    text = (
        f"the integrator is too coarse for the parameters: with {steps} instead of {2 * found.substeps} it moves "
        f"{', '.join(told)}; give substeps = {2 * found.substeps} or more."
    )
    return (Warning("too_few_substeps", text),)
