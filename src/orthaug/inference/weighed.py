"""The physics over a measure's points, weighted and factorised. Splits, suspects and checks of a measure share it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix
from orthaug._base.errors import InputError
from orthaug.inference.measures import Measure, Points, Support, Training
from orthaug.physics.baseline import Baseline
from orthaug.physics.excitation import Excitation, excitation
from orthaug.physics.output_weights import times
from orthaug.physics.problem import Problem
from orthaug.physics.projection import Projection


@dataclass(frozen=True, eq=False)
class Weighed:
    """A measure's `points`, and the physics there with every row multiplied by `unit` (M, ny, ny).

    The unit is the square root of a point's weight times the matrix of the output weights.
    """

    measure: Measure
    points: Points
    unit: Float[np.ndarray, "M ny ny"]
    projection: Projection
    excitation: Excitation


def weigh(measure: Measure, support: Support, baseline: Baseline, outputs: tuple[str, ...], weight: Matrix) -> Weighed:
    """The physics over a measure's points.

    Args:
        weight: the matrix of the output weights, (ny, ny).

    Raises:
        InputError: a measure that does not fit the data, or on whose points the physics is not finite.
    """
    points = measure.points(support)
    with np.errstate(all="ignore"):
        phi = np.asarray(baseline.phi(points.x, support.layout, outputs, np))
    if not np.isfinite(phi).all():
        raise InputError(f"the physics is not finite on all points of the {measure.name} measure; narrow it.")
    unit = np.sqrt(points.weight)[:, None, None] * weight
    projection = Projection.factor(times(unit, phi))
    return Weighed(measure, points, unit, projection, excitation(projection.r, baseline.names))


def weigh_problem(measure: Measure, problem: Problem) -> Weighed:
    """The same for a posed problem. Under the training measure it takes the factor that the problem has."""
    if measure != Training():
        return weigh(measure, support_of(problem), problem.baseline, problem.outputs, problem.weight.matrix)
    rows, own = len(problem.rows), problem.projection
    even = np.full(rows, 1 / rows)
    size = np.sqrt(even[0])
    projection = replace(own, r=own.r * size, phi=own.phi * size)
    unit = np.sqrt(even)[:, None, None] * problem.weight.matrix
    return Weighed(measure, Points(problem.rows.x, even), unit, projection, problem.excitation)


def support_of(problem: Problem) -> Support:
    """What a measure may draw on where a problem is posed."""
    return Support(problem.record, problem.layout, problem.used, problem.rows.x)
