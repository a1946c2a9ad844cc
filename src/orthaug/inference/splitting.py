"""θ of a fitted function under any measure, without new training: `θ_μ = c + Φ_μ⁺F_μ` (F2).

With `Cov(c, w)` from training, `Cov θ_μ = K Cov(c, w) Kᵀ` with `K = [I, Φ_μ⁺J_μ]`. Under another
measure θ depends on the learner, and shares its variance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError, Warning
from orthaug.data.sources import Partition
from orthaug.inference.measures import Measure, Points, Support, weigh
from orthaug.models.learners import Bound
from orthaug.models.model import Model
from orthaug.models.rows import InMemory, Overlaps, chunk_shape, learner_rows
from orthaug.models.statistics import JointCovariance
from orthaug.models.streaming import chunks_of, sum_rows
from orthaug.physics.excitation import require_rank
from orthaug.physics.noise import RowFilter
from orthaug.physics.projection import Projection
from orthaug.physics.streamed import RowBuilder, StreamedProblem

_SUPPORTED = 0.9  # share of a measure within reach of the data, below which it is warned of


@dataclass(frozen=True, eq=False)
class MeasureSplit:
    """θ, θ_aux and Cov θ under a measure, and the share of it that the data support.

    Cov θ is None without statistics.
    """

    name: str
    theta: Vector
    theta_aux: Vector
    covariance: Matrix | None
    defect: float | None
    support: float
    points: int
    condition: float | None
    warnings: tuple[Warning, ...]
    price: Vector | None = None
    """Standard error of each θ over that under the training measure (nθ,)."""
    slope: Matrix | None = None
    """∂θ_aux/∂w (nθ, nw)."""
    measure: Measure | None = None
    """What it was split under."""

    def __str__(self) -> str:
        text = (
            f"{self.name}, {self.points} points, {100 * self.support:.0f} % of it within reach "
            "of the data"
        )
        if self.price is None or not np.isfinite(self.price).all():
            return text
        return (
            f"{text}; standard errors {', '.join(f'{r:.3g}' for r in self.price)} times the "
            "training measure's"
        )


def split_by_measure(
    measure: Measure, model: Model, support: Support, joint: JointCovariance | None
) -> MeasureSplit:
    """Split a model under a measure.

    Args:
        model: any, however it was trained. Its c = θ − θ_aux and its prediction stay what they are.
        support: the training data.
        joint: Cov(c, w) from training; None for no intervals.

    Raises:
        InputError: a measure that does not fit the model, or under which the physics is
            rank-deficient.
    """
    physics = (model.form.baseline, model.form.outputs, model.weight, model.noise)
    weighed = weigh(measure, support, *physics)
    points, unit, projection = weighed.points, weighed.unit, weighed.projection
    form, numbers = model.form, model.numbers
    try:
        require_rank(weighed.excitation, len(points.x) * unit.shape[-1])
    except InputError as error:
        raise type(error)(f"under the {measure.name} measure {error}") from None
    raw = model.learner_at(points.x)
    if not np.isfinite(raw).all():
        raise InputError(
            f"the learner is not finite on all points of the {measure.name} measure; narrow it."
        )
    values = weighed.times(raw)
    aux = projection.solve_along(values, model.shared)
    theta = model.theta - model.theta_aux + aux
    covariance = slope = None
    if joint is not None and numbers.tilt is None:
        slope = learner_slope(model, points, projection, unit, weighed.noise)
        covariance = joint.of(np.column_stack([np.eye(len(theta)), slope]))
    size = np.linalg.norm(values)
    rest = values - projection.phi @ aux
    left = projection.along(model.shared) @ projection.coordinates(rest)
    defect = float(np.linalg.norm(left) / size) if 0 < size < np.inf else None
    share = support.share(points)
    warnings = beyond_data(measure, share) if form.learns else ()
    condition = weighed.excitation.condition
    of_measure = (share, len(points.x), condition, warnings)
    return MeasureSplit(
        measure.name, theta, aux, covariance, defect, *of_measure, slope=slope, measure=measure
    )


def beyond_data(measure: Measure, share: float) -> tuple[Warning, ...]:
    """Return a warning where the data support too small a `share` of a measure."""
    if share >= _SUPPORTED:
        return ()
    text = (
        f"only {100 * share:.0f} % of the {measure.name} measure lies within reach of the "
        "training data: elsewhere the parameters depend on the learner's extrapolation."
    )
    return (Warning("measure_beyond_data", text),)


@dataclass(frozen=True, eq=False)
class _PartitionOverlap:
    """QᵀJ over the rows of a partition; picklable if the learner is."""

    row_builder: RowBuilder
    bound: Bound
    weights: Vector

    def __call__(self, partition: Partition) -> Matrix | None:
        chunks = chunks_of(self.row_builder(partition), chunk_shape(partition.rows)[1])
        found = sum_rows(Overlaps(self.bound), chunks, (self.weights,))
        return None if found is None else np.asarray(found.jacobian)


def streamed_slope(model: Model, problem: StreamedProblem) -> Matrix:
    """Return ∂θ_aux/∂w under the training measure, in one pass over all rows of a source."""
    bound, numbers = model.form.bound, model.numbers
    nt = len(model.theta)
    if not bound.size:
        return np.zeros((nt, 0))
    gain = problem.weight.matrix * np.asarray(numbers.gain)
    row_builder = problem.row_builder(
        np.asarray(numbers.centre), np.asarray(numbers.halfwidth), 1.0, gain
    )
    parts = problem.passes(
        _PartitionOverlap(row_builder, bound, np.asarray(numbers.weights)),
        problem.source.partitions,
    )
    overlap = sum(part for part in parts if part is not None)
    return problem.projection.from_coordinates(problem.projection.along(model.shared) @ overlap)


def learner_slope(
    model: Model,
    points: Points,
    projection: Projection,
    unit: np.ndarray,
    noise: RowFilter | None = None,
) -> Matrix:
    """Return ∂θ_aux/∂w (nθ, nw), in one pass over the points.

    It is `Φ_μ⁺J_μ`, or `B(Φ_μB)⁺J_μ` along some directions. Under a noise model, whose points are
    rows in their order, all weights `unit` are the same.
    """
    bound, numbers = model.form.bound, model.numbers
    nt = len(model.theta)
    if not bound.size:
        return np.zeros((nt, 0))
    engine = InMemory()
    weight = unit if noise is None else unit[0]
    rows = learner_rows(engine, model.form, numbers, points.x, projection.q, weight, noise)
    overlap = engine.sum(Overlaps(bound), rows, np.asarray(numbers.weights))
    return projection.from_coordinates(
        projection.along(model.shared) @ np.asarray(overlap.jacobian)
    )
