"""Bias of θ and of physical parameters by each suspect, under the measure of a spec."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug.analysis.absorbed import TermAfterFit, term_effects
from orthaug.analysis.bias import SuspectedBias, bias_table
from orthaug.analysis.suspects import Suspect, suspect_columns, usual_suspects
from orthaug.inference.covariance import reach
from orthaug.inference.measures import WeighedPhysics
from orthaug.inference.physical import PhysicalEstimate, solve
from orthaug.physics.output_weights import times
from orthaug.physics.parameters import PhysicsMap
from orthaug.physics.problem import Problem
from orthaug.physics.shared import seen_columns

# Of a measure at most, over which certificates are sought for suspects that no one named
CERTIFIED_ROWS = 200_000
_ROUNDING = 1e-9  # of a parameter: an end of its interval that lies so little on the wrong side


@dataclass(frozen=True, eq=False)
class MeasureLinearization:
    """Linearization that biases under a measure are computed on.

    Args:
        weighed: the measure's points and the physics there, of one parameter or more.
        physics: the map from physical parameters to θ.
        theta: θ̂ for relative biases and for dp/dθ.
        learned: f at the measure's points (M, ny) after a fit, to find how much of it a suspect
            explains.
        directions: (nθ, s) along which θ is split; None for all.
    """

    weighed: WeighedPhysics
    problem: Problem
    theta: Vector
    physics: PhysicsMap | None = None
    learned: Matrix | None = None
    directions: Matrix | None = None

    @cached_property
    def slopes(self) -> tuple[dict[str, Vector], Vector] | None:
        """dp/dθ by name, and p."""
        return physical_slopes(self.physics, self.problem, self.theta)

    def table(
        self, suspects: Sequence[Suspect], *, certify: bool, every: bool = True
    ) -> tuple[SuspectedBias, ...]:
        """Return the bias by every suspect.

        Args:
            every: also what is zero on all points.
        """
        problem, x = self.problem, self.weighed.points.x
        suspects = [suspect.sampled(problem.record.sampling_time) for suspect in suspects]
        with np.errstate(all="ignore"):
            deltas = suspect_columns(suspects, x, problem.layout, problem.outputs, self.lengths)
        kept = [i for i in range(len(suspects)) if every or np.any(deltas[i])]
        chosen = [suspects[i] for i in kept]
        return bias_table(
            self.weighed.projection,
            problem.baseline.names,
            chosen,
            deltas[kept],
            gain=self.weighed.unit,
            theta=self.theta,
            physical=None if self.slopes is None else self.slopes[0],
            learned=self.learned,
            certify=certify,
            directions=self.directions,
            absorbed=None if self.directions is None else self._absorbed_effects(chosen),
        )

    @cached_property
    def lengths(self) -> tuple[int, ...] | None:
        """Rows of each experiment, where the points are the training rows; else None."""
        problem = self.problem
        return problem.lengths if self.weighed.points.x is problem.rows.x else None

    def values(self, suspect: Suspect) -> Matrix:
        """Return δ (M, ny) of a suspect at the measure's points."""
        problem = self.problem
        own = (self.weighed.points.x, problem.layout, problem.outputs, self.lengths)
        return suspect.sampled(problem.record.sampling_time).values(*own)

    def without(self, entry: SuspectedBias) -> MeasureLinearization:
        """Return the linearization less the part of the learner that a suspect explains."""
        held = (
            self.values(entry.suspect)
            if self.directions is None
            else self._absorbed_effects([entry.suspect])[0].held
        )
        return replace(
            self, learned=np.asarray(self.learned) - (entry.coefficient_found or 0.0) * held
        )

    def _absorbed_effects(self, suspects: Sequence[Suspect]) -> list[TermAfterFit]:
        problem = self.problem
        layout, outputs = problem.layout, problem.outputs

        static = [suspect for suspect in suspects if suspect.memory is None]

        def forms(x: Matrix) -> Matrix:
            return np.stack([suspect.form(x, layout) for suspect in static], axis=-1)

        def term(suspect: Suspect) -> Callable[[Matrix], Matrix]:
            if suspect.memory is None:
                return lambda x: suspect.values(x, layout, outputs)
            along = suspect.values(problem.rows.x, layout, outputs, problem.lengths)
            return lambda x: along[:: -(-len(along) // len(x))]  # on all rows, or every so many

        of_static = iter(
            seen_columns(problem.features, layout, problem.rows.x, forms) if static else ()
        )
        visible = [suspect.memory is None and bool(next(of_static)) for suspect in suspects]
        return term_effects(problem, map(term, suspects), visible, self.weighed.points.x)


def bias_under(
    linearization: MeasureLinearization,
    suspects: Sequence[Suspect] = (),
    *,
    certify_usual: bool = True,
) -> list[dict[str, Any]]:
    """Return the bias by every suspect under a measure, as plain data for JSON.

    It is that of θ and, to first order, of the physical parameters.

    Args:
        suspects: those that were named; without any, the usual ones that have an effect.
        certify_usual: seek certificates, a linear program each, for suspects that no one named,
            too.
    """
    named, problem, points = bool(suspects), linearization.problem, linearization.weighed.points
    table = linearization.table(
        suspects or usual_suspects(problem),
        certify=named or (certify_usual and len(points.x) <= CERTIFIED_ROWS),
        every=named,
    )
    found = []
    for entry in table:
        delta = linearization.values(entry.suspect)
        own = {
            "relative_physical_bias": _relative(entry, linearization.slopes),
            "size": float(np.linalg.norm(times(linearization.weighed.unit, delta))),
            "expected_physical_bias": _expected_shifts(
                entry, linearization.physics, problem, linearization.theta
            ),
        }
        found.append(entry.as_dict() | own)
    return found


def _expected_shifts(
    entry: SuspectedBias, physics: PhysicsMap | None, problem: Problem, theta: Vector
) -> dict[str, dict[str, float | None]] | None:
    """Return the shift of each physical parameter by the guessed coefficient.

    It is p of θ̂ less p without the bias.
    """
    if physics is None or entry.expected is None:
        return None
    biased, true = (
        physical_of(physics, problem, t) for t in (theta, theta - np.array(entry.expected))
    )
    return {
        name: {"bias": float(b - t), "relative": float((b - t) / t) if t else None}
        for name, b, t in zip(physics.names, biased, true, strict=True)
    }


def _relative(
    entry: SuspectedBias, slopes: tuple[dict[str, Vector], Vector] | None
) -> dict[str, float | None] | None:
    """Return the bias of each physical parameter over its value."""
    if slopes is None or entry.physical is None:
        return None
    return {
        name: bias / p if p else None
        for (name, bias), p in zip(entry.physical, slopes[1], strict=True)
    }


def physical_slopes(
    physics: PhysicsMap | None, problem: Problem, theta: Vector
) -> tuple[dict[str, Vector], Vector] | None:
    """Return dp/dθ, in the order of the baseline's θ, at the p that θ gives; and that p."""
    if physics is None:
        return None
    p = physical_of(physics, problem, theta)
    # Scales of θ and p, so that the pseudo-inverse sees numbers of one size
    of_theta = np.abs(physics.theta(p))
    of_theta, of_p = np.where(of_theta > 0, of_theta, 1.0), np.where(p != 0, np.abs(p), 1.0)
    inverse = np.linalg.pinv(physics.jacobian(p) / of_theta[:, None] * of_p)
    rows = np.zeros((len(p), len(problem.baseline.names)))
    rows[:, _order(physics, problem)] = inverse * of_p[:, None] / of_theta
    return dict(zip(physics.names, rows, strict=True)), p


def physical_of(
    physics: PhysicsMap, problem: Problem, theta: Vector, covariance: Matrix | None = None
) -> Vector:
    """Return p of θ, weighted by its covariance where that is given."""
    return _solve_physical(physics, problem, theta, covariance).value


def _solve_physical(
    physics: PhysicsMap, problem: Problem, theta: Vector, covariance: Matrix | None
) -> PhysicalEstimate:
    order = _order(physics, problem)
    covariance = None if covariance is None else covariance[np.ix_(order, order)]
    return solve(physics, theta[order], covariance, freedom=np.inf)


def physical_with_bias(
    linearization: MeasureLinearization,
    bias: Vector,
    covariance: Matrix | None,
    spread: Matrix,
    freedom: float,
) -> tuple[Vector, Matrix]:
    """Return biases of the physical parameters (np,), and ends (np, 2) of 95 % intervals.

    The intervals cover bias and noise.

    The interval of p is that of θ in the direction in which p moves most, mapped: p of both of its
    ends, or p's bound where an end has none. Biases are NaN where θ̂ less its bias has no p.

    Args:
        bias: of θ̂.
        covariance: of θ̂, by which p is weighted; `spread` counts also what is not known of the
            bias.
    """
    physics, problem = linearization.physics, linearization.problem
    assert physics is not None
    centre, order = linearization.theta - bias, _order(physics, problem)
    now, free = (
        _solve_physical(physics, problem, theta, covariance)
        for theta in (linearization.theta, centre)
    )
    ends = np.full((len(free.value), 2), np.nan)
    if not _is_met(free):
        return ends[:, 0], ends
    if free.sensitivities is None or covariance is None:
        return now.value - free.value, ends
    slopes, at_bounds = (
        np.zeros((len(free.value), len(centre))),
        physical_slopes(physics, problem, centre),
    )
    assert at_bounds is not None
    with np.errstate(all="ignore"):
        slopes[:, order] = free.sensitivities * free.value[:, None] / centre[order]
    for i, row in enumerate(slopes):
        row = row if np.isfinite(row).all() and row.any() else at_bounds[0][physics.names[i]]
        size = np.sqrt(row @ spread @ row)
        step = reach(freedom) * spread @ row / (size if size > 0 else 1.0)
        for side, sign in enumerate((-1.0, 1.0) if np.isfinite(step).all() else ()):
            end = _solve_physical(physics, problem, centre + sign * step, covariance)
            beyond = sign * (end.value[i] - free.value[i]) >= -_ROUNDING * abs(free.value[i])
            ends[i, side] = end.value[i] if _is_met(end) and beyond else physics.bounds[side][i]
    return now.value - free.value, ends


def _is_met(found: PhysicalEstimate) -> bool:
    """Return whether there is p that gives θ."""
    return all(warning.code != "physics_not_met" for warning in found.warnings)


def _order(physics: PhysicsMap, problem: Problem) -> list[int]:
    return [problem.baseline.names.index(name) for name in physics.theta_names]
