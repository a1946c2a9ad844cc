"""Other values of a motion's parameters that explain the data as well, or better.

Physics alone is trained from random initial values around those that it was fitted with. Two time
constants in series may change places without a trace in the output; a fit may have ended in a local
minimum. No standard error shows either.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.errors import Warning
from orthaug._base.lines import join_words
from orthaug.analysis.input_timing import residual_of
from orthaug.analysis.motion_identifiability import information
from orthaug.fitting.motion_task import (
    RESTART_ITERATIONS,
    descend_by_lengths,
    descend_from,
    draw_starts,
    is_cheap,
    substep_shift,
)
from orthaug.fitting.segmented_motion import SegmentedMotion
from orthaug.fitting.segmented_problem import FreeRunFit
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt

_AS_GOOD = 1e-3  # of the residual: as good
_BETTER = 0.02  # of the residual: clearly better
_INTEGRATED = 0.1  # of the residual: how far half the step may move the outputs of another solution
_SAME_VALUE = 0.02  # of a parameter: as close are the ends of two descents along a flat direction
_APART = 10.0  # standard errors by the curvature of the fit: another minimum, not a flat one


@dataclass(frozen=True)
class OtherSolution:
    """Parameters of physics alone from another start, with its residual and that of the fit.

    Residuals are in deviations of the outputs.
    """

    parameters: dict[str, float]
    residual: float
    fitted: float
    exchanged: tuple[str, ...] = ()
    """Parameters whose values the two solutions have in another order; () for other values."""

    @property
    def better(self) -> bool:
        """True if it explains the data clearly better than the fit."""
        return self.residual < (1 - _BETTER) * self.fitted

    @property
    def warnings(self) -> tuple[Warning, ...]:
        """One, with the values and what to do."""
        values = ", ".join(f"{name} = {value:.4g}" for name, value in self.parameters.items())
        if self.better:
            text = (
                "from other initial values physics alone explains the data better: its error is "
                f"{self.residual:.3g} standard deviations of the output instead of "
                f"{self.fitted:.3g}, with {values}. Give these as initial values, or bounds that "
                "exclude them."
            )
            return (Warning("local_minimum", text),)
        which = ""
        if self.exchanged:
            which = (
                f" These are the fitted values of {join_words(self.exchanged)} in another order, "
                "as of parts that change places: the initial values decide which is which."
            )
        text = (
            f"physics alone explains the data equally well with {values}.{which} The result is the "
            "solution next to the initial values; give bounds or better initial values to choose "
            "one."
        )
        return (Warning("several_solutions", text),)


def find_other_solution(
    segmented: SegmentedMotion, solver: LevenbergMarquardt, q: Vector
) -> OtherSolution | None:
    """Return the best other minimum of physics alone that is as good as the one at `q`.

    None where no start leads to one, or so many trainings would take too long.

    Args:
        segmented: with physics, and perhaps a learner; it runs without.
        solver: its limits on iterations are kept where they are lower.
        q: coordinates of the parameters that physics alone was fitted with (np,).
    """
    own, coordinates = segmented.physics_only, segmented.problem.motion.coordinates
    if segmented.sums is not None or not is_cheap(segmented):
        return None
    solver = solver.at_most(RESTART_ITERATIONS)
    with np.errstate(all="ignore"):
        base = descend_from(own, solver, [q], None)
        if base is None:
            return None
        fitted = residual_of(own, base)
        found: list[tuple[float, FreeRunFit]] = []
        for start in draw_starts(coordinates, [base.end.point.theta, coordinates.initial]):
            other = descend_by_lengths(own, solver, start)
            residual = residual_of(own, other)
            if other is None or residual > (1 + _AS_GOOD) * fitted:
                continue
            if not np.isfinite(coordinates.physical(other.end.point.theta)).all():
                continue
            if _is_another(own, base, other.end.point.theta) and _is_of_the_equations(own, other):
                found.append((residual, other))
    if not found:
        return None
    residual, best = min(found, key=lambda one: one[0])
    p = coordinates.physical(best.end.point.theta)
    names = segmented.problem.motion.names
    exchanged = _exchanged(names, coordinates.physical(base.end.point.theta), p)
    return OtherSolution(dict(zip(names, map(float, p), strict=True)), residual, fitted, exchanged)


def _exchanged(names: Sequence[str], fitted: Vector, other: Vector) -> tuple[str, ...]:
    """Return the parameters that have each other's values, where all others have their own."""
    left, moved = list(range(len(names))), []
    for i, value in enumerate(other):
        alike = [j for j in left if abs(value - fitted[j]) <= _SAME_VALUE * abs(fitted[j])]
        if not alike:
            return ()
        taken = i if i in alike else alike[0]
        left.remove(taken)
        if taken != i:
            moved.append(names[i])
    return tuple(moved)


def _is_of_the_equations(own: SegmentedMotion, other: FreeRunFit) -> bool:
    """Return whether a solution is one of the equations, not of an integrator whose steps are long.

    A mode far faster than a step decays by another factor than in the equations, which another
    parameter can make the right one.
    """
    if own.problem.motion.scheme.discrete:
        return True
    finer = own.with_substeps(2 * own.dynamics.substeps)
    return substep_shift(own, finer, other) < _INTEGRATED


def _is_another(own: SegmentedMotion, base: FreeRunFit, q: Vector) -> bool:
    """Return whether q is far from the base where the base's curvature would forbid it."""
    point = base.end.point
    gram = information(own.from_states(point.states), point.theta)
    noise = own.noise(base.objective, base.end)
    if gram is None or noise is None:
        return False
    apart = np.asarray(q - point.theta)
    variance = float(np.trace(own.problem.weight.whitened(noise))) / len(noise)
    return bool(own.rms**2 * apart @ gram @ apart > _APART**2 * variance)
