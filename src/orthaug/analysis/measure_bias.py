"""Bias of θ and of physical parameters by each suspect, under the measure of a spec."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug.analysis.absorbed import term_effects
from orthaug.analysis.bias import TermResponse, bias_table
from orthaug.analysis.catalogue import Catalogue
from orthaug.analysis.suspects import Suspect
from orthaug.inference.covariance import reach
from orthaug.inference.linearization import Linearization
from orthaug.inference.measures import WeighedPhysics
from orthaug.inference.physical import PhysicalEstimate, solve
from orthaug.physics.excitation import excitation, require_rank
from orthaug.physics.output_weights import times
from orthaug.physics.parameters import PhysicsMap
from orthaug.physics.problem import Problem
from orthaug.physics.shared import seen_columns

# Of a measure at most, over which certificates are sought for suspects that no one named
CERTIFIED_ROWS = 200_000
_ROUNDING = 1e-9  # of a parameter: an end of its interval that lies so little on the wrong side


@dataclass(frozen=True, eq=False)
class LaggedTerms:
    """Terms that physics on lagged signals may lack, under a measure (`TermPhysics`).

    Args:
        weighed: the measure's points and the physics there, of one parameter or more.
        theta: θ̂ for relative biases and for dp/dθ.
        map: from physical parameters to θ.
        learned: f at the measure's points (M, ny) after a fit, to find how much of it a suspect
            explains.
        directions: (nθ, s) along which θ is split; None for all.
    """

    weighed: WeighedPhysics
    problem: Problem
    theta: Vector
    map: PhysicsMap | None = None
    learned: Matrix | None = None
    directions: Matrix | None = None

    @property
    def names(self) -> tuple[str, ...]:
        return self.problem.baseline.names

    @property
    def value(self) -> Vector:
        return self.theta

    @property
    def slopes(self) -> Vector:
        return np.ones(len(self.theta))

    @property
    def physical(self) -> tuple[dict[str, Vector], Vector] | None:
        return self._physical

    @cached_property
    def _physical(self) -> tuple[dict[str, Vector], Vector] | None:
        return physical_slopes(self.map, self.problem, self.theta)

    @cached_property
    def catalogue(self) -> Catalogue:
        """The terms that no one named."""
        return Catalogue.of_problem(self.problem)

    @property
    def certifies(self) -> bool:
        return len(self.weighed.points.x) <= CERTIFIED_ROWS

    @property
    def linearization(self) -> Linearization:
        return self._linearization

    @cached_property
    def _linearization(self) -> Linearization:
        projection = self.weighed.projection
        count = projection.q.shape[0] * projection.q.shape[1]
        require_rank(excitation(projection.r, self.names), count)
        learner = None if self.learned is None else self._weigh(self.learned)
        return Linearization(projection, self.directions, learner)

    def equation(self, suspect: Suspect) -> None:
        return None

    def values(self, suspect: Suspect) -> Matrix:
        problem, x = self.problem, self.weighed.points.x
        lengths = problem.lengths if x is problem.rows.x else None  # else they are no record
        found = self._sampled(suspect).values(x, problem.layout, problem.outputs, lengths)
        return self._weigh(found)

    def sees(self, suspects: Sequence[Suspect]) -> list[bool | None]:
        """Return None where the learner could imitate every change of θ: then all is the split."""
        if self.directions is None:
            return [None] * len(suspects)
        problem, layout = self.problem, self.problem.layout
        static = [suspect for suspect in suspects if suspect.memory is None]

        def forms(x: Matrix) -> Matrix:
            return np.stack([self._sampled(one).form(x, layout) for one in static], axis=-1)

        seen = iter(seen_columns(problem.features, layout, problem.rows.x, forms) if static else ())
        # A function of the past is none of one row
        return [suspect.memory is None and bool(next(seen)) for suspect in suspects]

    def respond(self, suspects: Sequence[Suspect], *, run: bool) -> list[TermResponse]:
        if self.directions is None:
            held = [self.values(suspect) for suspect in suspects]
            return [TermResponse(np.zeros(len(self.theta)), one, None, one) for one in held]
        visible = [bool(seen) for seen in self.sees(suspects)]
        terms = map(self._term, suspects)
        effects = term_effects(self.problem, terms, visible, self.weighed.points.x)
        weighed = ((effect, self._weigh(effect.held)) for effect in effects)
        return [TermResponse(effect.moved, held, effect.seen, held) for effect, held in weighed]

    def expected_shifts(self, bias: Vector) -> dict[str, dict[str, float | None]] | None:
        """Return p of θ̂ less p without the bias."""
        if self.map is None:
            return None
        biased, true = (
            physical_of(self.map, self.problem, t) for t in (self.theta, self.theta - bias)
        )
        return {
            name: {"bias": float(b - t), "relative": float((b - t) / t) if t else None}
            for name, b, t in zip(self.map.names, biased, true, strict=True)
        }

    def _weigh(self, rows: Matrix) -> Matrix:
        return times(self.weighed.unit, np.asarray(rows))

    def _sampled(self, suspect: Suspect) -> Suspect:
        return suspect.sampled(self.problem.record.sampling_time)

    def _term(self, suspect: Suspect) -> Callable[[Matrix], Matrix]:
        """Return the values (N, ny) of a term on rows of the regressor, or on every so many."""
        problem, suspect = self.problem, self._sampled(suspect)
        layout, outputs = problem.layout, problem.outputs
        if suspect.memory is None:
            return lambda x: suspect.values(x, layout, outputs)
        along = suspect.values(problem.rows.x, layout, outputs, problem.lengths)
        return lambda x: along[:: -(-len(along) // len(x))]


def bias_under(
    terms: LaggedTerms, suspects: Sequence[Suspect] = (), *, certify_usual: bool = True
) -> list[dict[str, Any]]:
    """Return the bias by every suspect under a measure, as plain data for JSON.

    Args:
        suspects: those that were named; without any, the usual ones that have an effect.
        certify_usual: seek certificates, a linear program each, for suspects that no one named,
            too.
    """
    named = bool(suspects)
    certify = named or (certify_usual and terms.certifies)
    table = bias_table(terms, suspects or terms.catalogue.usual(), certify=certify, every=named)
    return [entry.as_dict() for entry in table]


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
    terms: LaggedTerms,
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
    physics, problem = terms.map, terms.problem
    assert physics is not None
    centre, order = terms.theta - bias, _order(physics, problem)
    now, free = (
        _solve_physical(physics, problem, theta, covariance) for theta in (terms.theta, centre)
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
