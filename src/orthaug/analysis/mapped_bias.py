"""Biases of physical parameters that a map gives from θ, to first order and beyond."""

from __future__ import annotations

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug.inference.covariance import reach
from orthaug.inference.physical import PhysicalEstimate, solve
from orthaug.physics.parameters import PhysicsMap
from orthaug.physics.problem import Problem

_ROUNDING = 1e-9  # of a parameter: an end of its interval that lies so little on the wrong side


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


def physical_of(physics: PhysicsMap, problem: Problem, theta: Vector) -> Vector:
    """Return p of θ."""
    return _solve_physical(physics, problem, theta, None).value


def _solve_physical(
    physics: PhysicsMap, problem: Problem, theta: Vector, covariance: Matrix | None
) -> PhysicalEstimate:
    order = _order(physics, problem)
    covariance = None if covariance is None else covariance[np.ix_(order, order)]
    return solve(physics, theta[order], covariance, freedom=np.inf)


def physical_with_bias(
    physics: PhysicsMap,
    problem: Problem,
    theta: Vector,
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
    centre, order = theta - bias, _order(physics, problem)
    now, free = (_solve_physical(physics, problem, one, covariance) for one in (theta, centre))
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
