"""θ of a fitted function under any measure, without new training: `θ_μ = c + Φ_μ⁺F_μ` (F2).

With `Cov(c, w)` from training, `Cov θ_μ = K Cov(c, w) Kᵀ` with `K = [I, Φ_μ⁺J_μ]`. Under another
measure θ depends on the learner, and shares its variance.

Of a motion it is the nearest physics, p̂ = argmin_p Σ_μ ‖G − f(·; p)‖².

p̂ moves only along directions that a learner could imitate.

G = f(·; c) + g is the fitted field over points of states and inputs; only learned equations and
outputs count. p̂ depends on G and the measure alone, not on how G was put together. For f linear in
p it is `θ = c + B (Φ_μ B)⁺ F_μ`.

Intervals come from the stationarity of p̂ by the implicit function theorem: with φ the sum and q
the coordinates of p, `B'φ_qq B ds = −B'(φ_qc + φ_qq) dc − B'φ_qw dw − B' Σ φ_qx dx`. The last term
counts that the points themselves are those of the fitted run. p̂ is unique near by only if B'φ_qq B
is positive definite.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError, Warning
from orthaug._base.jax import AnyArray, Array, jax, jnp, quick_jit
from orthaug.data.sources import Partition
from orthaug.inference.measures import OF_ROWS, Measure, Points, Support, weigh
from orthaug.models.dynamics import Numbers
from orthaug.models.learners import Bound
from orthaug.models.model import Model
from orthaug.models.motion_field import MotionField
from orthaug.models.moving import MotionDynamics
from orthaug.models.rows import InMemory, Overlaps, chunk_shape, learner_rows
from orthaug.models.streaming import chunks_of, sum_rows
from orthaug.physics.excitation import require_rank
from orthaug.physics.left_over import UnexplainedPhysics, left_over
from orthaug.physics.motion import Motion
from orthaug.physics.noise import NoiseModel, RowFilter
from orthaug.physics.projection import Projection
from orthaug.physics.shared import SharedDirections, agreeing_directions, moves, spanned_directions
from orthaug.physics.streamed import RowBuilder, StreamedProblem

_SUPPORTED = 0.9  # share of a measure within reach of the data, below which it is warned of
_BATCH = 4096  # points at a time
_ITERATIONS = 30
_SETTLED = 1e-12  # of a step, relative
_ROUNDING = 1e-13
_FLAT = 1e-12  # curvature of the distance along directions of unit length: below it is none
_ROWS = 2000  # at which the rows are asked what functions of the features leave
_POINTS = 400  # at which the slopes of the physics are looked at
_FEWEST = 4  # moves that succeed, for each parameter


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasureSplit:
    """θ and θ_aux under a measure, and the share of it that the data support, for any physics."""

    name: str
    """Name of the measure."""
    theta: Vector
    theta_aux: Vector
    defect: float | None
    """‖projection of the rest on the shared directions‖ / ‖learner‖ over the measure; None without
    a learner.
    """
    support: float = 1.0
    """Share of the measure within reach of the training data."""
    slope: Matrix | None = None
    """∂θ/∂(c, w) (nθ, nθ + nw); None where it is not known, or where θ is not unique."""
    points: int
    condition: float | None = None
    """Condition of Φ over the measure; None of a motion."""
    warnings: tuple[Warning, ...] = ()
    price: Vector | None = None
    """Standard error of each θ over that under the training measure (nθ,)."""
    measure: Measure | None = None
    """What it was split under."""

    @property
    def of_rows(self) -> bool:
        """True if its points are those of the training rows."""
        return isinstance(self.measure, OF_ROWS)

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


def split_by_measure(measure: Measure, model: Model, support: Support) -> MeasureSplit:
    """Split a model under a measure.

    Args:
        model: any, however it was trained. Its c = θ − θ_aux and its prediction stay what they are.
        support: the training data.

    Raises:
        InputError: a measure that does not fit the model, or under which the physics is
            rank-deficient.
    """
    noise = model.noise if isinstance(model.noise, NoiseModel) else None
    physics = (model.form.baseline, model.form.outputs, model.weight, noise)
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
    slope = None
    if numbers.tilt is None and model.statistics.joint(len(theta)) is not None:
        own = learner_slope(model, points, projection, unit, weighed.noise)
        slope = np.column_stack([np.eye(len(theta)), own])
    size = np.linalg.norm(values)
    rest = values - projection.phi @ aux
    left = projection.along(model.shared) @ projection.coordinates(rest)
    defect = float(np.linalg.norm(left) / size) if 0 < size < np.inf else None
    share = support.share(points)
    return MeasureSplit(
        name=measure.name,
        theta=theta,
        theta_aux=aux,
        defect=defect,
        support=share,
        points=len(points.x),
        condition=weighed.excitation.condition,
        warnings=beyond_data(measure, share) if form.learns else (),
        slope=slope,
        measure=measure,
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


class Field(NamedTuple):
    """Weighted points of states (M, nx) and inputs (M, nu), and the size of each learned equation.

    `weight` is (M,); `size` (nl,) counts learned equations and outputs.
    """

    x: Matrix
    u: Matrix
    weight: Vector
    size: Vector


@dataclass(frozen=True, eq=False, kw_only=True)
class MotionSplit(MeasureSplit):
    """q̂ (np,) of p̂ as its θ, its shared directions, and the points that it was split over."""

    shared: SharedDirections
    share: float | None = None
    """‖learner‖ / ‖field‖ of the learned equations over the measure, after the split."""
    field: Field

    @classmethod
    def empty(cls, name: str, form: MotionField, c: Vector) -> MotionSplit:
        """Return the split before any: c itself, nothing shared, over no points."""
        nothing = Field(
            np.zeros((0, form.states)),
            np.zeros((0, len(form.motion.inputs))),
            np.zeros(0),
            np.zeros(0),
        )
        shared = SharedDirections(form.motion.names, np.zeros((len(c), 0)))
        own = {"theta": c, "theta_aux": np.zeros(len(c)), "defect": None}
        return cls(name=name, shared=shared, points=0, field=nothing, **own)


def shared_of_motion(form: MotionDynamics, q: Vector, x: Matrix, u: Matrix) -> SharedDirections:
    """Return the directions of q that a learner on these features could imitate, at q.

    A direction is shared if it moves no equation and no output without a learner, and moves those
    with one by a function of the features alone.
    """
    names, motion = form.motion.names, form.motion
    if not learned_places(motion):
        return SharedDirections(names, np.zeros((len(names), 0)))
    if form.bound.linear:
        return _spanned_directions(form, q, x, u)
    nx = x.shape[1]
    points = np.concatenate([x, u], axis=1)
    points = points[np.isfinite(points).all(axis=1)]
    pairs = moves(form.features_of, points)
    some = points[:: max(1, len(points) // _POINTS)]
    for start, end in (
        pairs,
        (some, some),
    ):  # where hardly any move is not seen, the learner sees everything
        slopes = [
            np.asarray(slopes_at(form, q, rows[:, :nx], rows[:, nx:])) for rows in (start, end)
        ]
        kept = np.isfinite(slopes[0]).all(axis=(1, 2)) & np.isfinite(slopes[1]).all(axis=(1, 2))
        if kept.sum() >= _FEWEST * len(names):
            break
    before, after = (part[kept] for part in slopes)  # (M, nx + ny, np)
    # What has no learner must not move at all
    after = np.where(_has_learner(motion)[:, None], after, 0.0)
    size = np.sqrt(np.mean(before**2, axis=(0, 2), keepdims=True))
    size = np.where(size > 0, size, 1.0)
    before, after = (
        np.concatenate(list(np.moveaxis(part / size, 1, 0))) for part in (before, after)
    )
    return SharedDirections(names, agreeing_directions(before, after)).beside(
        _left_over(form, q, points, nx)
    )


def _left_over(
    form: MotionDynamics, q: Vector, points: Matrix, nx: int
) -> UnexplainedPhysics | None:
    """Return the part of the slopes at the points that no function of the features follows."""
    some = points[:: max(1, -(-len(points) // _ROWS))]
    slopes = np.asarray(slopes_at(form, q, some[:, :nx], some[:, nx:]))
    return left_over(slopes, form.features_of(some), _has_learner(form.motion))


def _spanned_directions(form: MotionDynamics, q: Vector, x: Matrix, u: Matrix) -> SharedDirections:
    """Return the directions that the learner's features span and that move no other equation."""
    some = slice(None, None, max(1, len(x) // _POINTS))
    slopes = np.moveaxis(np.asarray(slopes_at(form, q, x[some], u[some])), 1, 0)
    features = form.features_at(x[some], u[some])
    return spanned_directions(form.motion.names, slopes, features, _has_learner(form.motion))


def learned_places(motion: Motion) -> list[int]:
    """Return the numbers of the equations that have a learner, outputs after states."""
    states, outputs = motion.learned
    return [*states, *(len(motion.states) + i for i in outputs)]


def _has_learner(motion: Motion) -> Bool[np.ndarray, "r"]:
    return np.isin(np.arange(len(motion.states) + len(motion.outputs)), learned_places(motion))


def nearest(
    form: MotionDynamics,
    numbers: Numbers,
    start: Vector,
    field: Field,
    bounds: tuple[Vector, Vector],
    basis: Matrix | None = None,
) -> tuple[Vector, SharedDirections]:
    """Return q̂, which differs from c along shared directions only.

    The search begins at the point of that plane that is nearest to `start`. The plane turns with q
    where the physics is nonlinear, so no least squares of SciPy is the whole search.

    Args:
        start: coordinates of physics alone.
        basis: directions to search along; None for those that are shared.
    """
    c = np.asarray(numbers.c)
    q = c

    def directions(q: Vector) -> SharedDirections:
        if basis is not None:
            return SharedDirections(form.motion.names, basis)
        return shared_of_motion(form, q, field.x, field.u)

    shared = directions(q)
    if not shared.basis.size:
        return q, shared
    gauss = np.asarray(_sum_over(_gauss_newton, form, numbers, q, field)[1])
    b, size = _unit(shared.basis, gauss), np.sqrt(np.diag(gauss))
    along = np.linalg.lstsq(size[:, None] * b, size * (start - q), rcond=None)[0]
    candidates = [np.clip(q + b @ along, *bounds), q]
    q = min(candidates, key=lambda at: _distance(form, numbers, at, field))
    damping, value = 1e-6, _distance(form, numbers, q, field)
    for _ in range(_ITERATIONS):
        shared = directions(q)
        gradient, gauss = (
            np.asarray(part) for part in _sum_over(_gauss_newton, form, numbers, q, field)
        )
        b = _unit(shared.basis, gauss)
        inner, downhill = b.T @ gauss @ b, -b.T @ gradient
        along = np.linalg.lstsq(inner + damping * np.eye(len(inner)), downhill, rcond=None)[0]
        trial = np.clip(q + b @ along, *bounds)
        there = _distance(form, numbers, trial, field)
        if there <= value * (1 + _ROUNDING):  # near the end a step gains less than rounding
            stays = np.array_equal(trial, q)
            q, value, damping = trial, there, damping / 10
            if stays or np.abs(along).max() <= _SETTLED * np.sqrt(max(value, 1e-300)):
                break
        else:
            damping = max(damping * 100, 1e-6)
            if damping > 1e6:
                break
    return q, directions(q)


def _unit(basis: Matrix, gauss: Matrix) -> Matrix:
    """Return the directions scaled so that each moves the learned equations by one."""
    size = np.sqrt(np.maximum(np.einsum("ij,ik,kj->j", basis, gauss, basis), 0.0))
    return basis / np.where(size > 0, size, 1.0)


def split_motion(
    measure: Measure,
    form: MotionDynamics,
    numbers: Numbers,
    start: Vector,
    field: Field,
    bounds: tuple[Vector, Vector],
    *,
    everything: bool = False,
    wobble: Any = None,
    statistics: bool = True,
) -> MotionSplit:
    """Return p̂ of a fitted motion under a measure.

    Args:
        field: the points of the measure.
        start: coordinates of physics alone.
        everything: whether all directions count as shared (the paper's projection).
        wobble: (np, np + nw) from (q̂): `Σ φ_qx dx/d(c, w)` of points that are the fitted run's;
            None where they are fixed.
        statistics: how p̂ follows (c, w), and the measures of what is left; without, p̂ alone.
    """
    count = len(form.motion.parameters)
    basis = np.eye(count) if everything else None
    c = np.asarray(numbers.c)
    q, shared = c, SharedDirections(form.motion.names, np.zeros((count, 0)))
    if form.learns:
        q, shared = nearest(form, numbers, start, field, bounds, basis)
    split = MotionSplit(
        name=measure.name,
        theta=q,
        theta_aux=q - c,
        defect=None,
        points=len(field.x),
        measure=measure,
        shared=shared,
        field=field,
    )
    if not form.learns:
        return replace(split, slope=np.eye(count))
    if not statistics:
        return split
    whole = np.concatenate([np.eye(count), np.zeros((count, form.bound.size))], axis=1)
    second, to_c, to_w, gauss, gradient, learner, rest, size = (
        np.asarray(part) for part in _sum_over(_second, form, numbers, q, field)
    )
    with np.errstate(all="ignore"):
        share = float(np.sqrt(rest / size)) if size > 0 else None
    if not shared.basis.size:
        return replace(split, slope=whole, share=share)
    b = _unit(shared.basis, gauss)
    inner, left = b.T @ second @ b, b.T @ gradient
    along = float(left @ np.linalg.lstsq(b.T @ gauss @ b, left, rcond=None)[0])
    defect = float(np.sqrt(max(along, 0.0) / learner)) if learner > 0 else None
    slope = None
    if np.linalg.eigvalsh(inner).min() > _FLAT:
        cross = np.concatenate([to_c + second, to_w], axis=1) + (
            0.0 if wobble is None else wobble(q)
        )
        slope = whole - b @ np.linalg.solve(inner, b.T @ cross)
    return replace(split, slope=slope, defect=defect, share=share)


def _learned_rows(form: MotionDynamics, q: AnyArray, x: Array, u: Array, c: AnyArray) -> Array:
    """Return the physics of the learned equations and outputs (nl,) at one point.

    Forces are those of the mass matrix at c.
    """
    p, own = (form.motion.coordinates.physical(one, jnp) for one in (q, c))
    return form.learned_rows(p, x, u, own)


def rest_of(
    form: MotionDynamics,
    numbers: Numbers,
    q: AnyArray,
    c: AnyArray,
    w: AnyArray,
    x: Array,
    u: Array,
    size: Array | float,
) -> Array:
    """Return (G − f(q)) / size (nl,) at one point."""
    own = numbers._replace(weights=w)
    physics = _learned_rows(form, c, x, u, c) - _learned_rows(form, q, x, u, c)
    return (physics + form.learned(own, x, u)) / size


@partial(quick_jit, static_argnames="form")
def slopes_at(
    form: MotionDynamics, q: Array, x: Float[Array, "m nx"], u: Float[Array, "m nu"]
) -> Float[Array, "m r np"]:
    """Return ∂(f, h)/∂q at points."""

    def value_and_slope(q: Array, x: Array, u: Array) -> Array:
        p = form.motion.coordinates.physical(q, jnp)
        fixed = jax.lax.stop_gradient(p)
        rates = form.motion.mass.balance(form.motion.rates(x, u, p, jnp), x, fixed)
        return jnp.concatenate([rates, form.motion.observed(x, u, p, jnp)])

    return jax.vmap(lambda x, u: jax.jacfwd(value_and_slope)(q, x, u))(x, u)


def _distance(form: MotionDynamics, numbers: Numbers, q: Vector, field: Field) -> float:
    value = float(np.asarray(_sum_over(_square, form, numbers, q, field)))
    return value if np.isfinite(value) else np.inf


def _sum_over(
    function: Any, form: MotionDynamics, numbers: Numbers, q: Vector, field: Field
) -> Any:
    """Return the sum over the points, batch by batch."""
    total = None
    for begin in range(0, len(field.x), _BATCH):
        x, u, weight = (part[begin : begin + _BATCH] for part in field[:3])
        padding = min(_BATCH, 1 << (len(field.x) - 1).bit_length()) - len(x)
        if padding > 0:
            x, u = (
                np.concatenate([part, np.repeat(part[-1:], padding, axis=0)]) for part in (x, u)
            )
            weight = np.concatenate([weight, np.zeros(padding)])
        part = function(form, numbers, q, x, u, weight, field.size)
        total = part if total is None else jax.tree.map(jnp.add, total, part)
    return total


@partial(quick_jit, static_argnames="form")
def _square(
    form: MotionDynamics, numbers: Numbers, q: Array, x: Array, u: Array, weight: Array, size: Array
) -> Array:
    c, w = numbers.c, numbers.weights
    rest = jax.vmap(lambda x, u: rest_of(form, numbers, q, c, w, x, u, size))(x, u)
    return jnp.sum(jnp.where(weight[:, None] > 0, weight[:, None] * rest**2, 0.0)) / 2


@partial(quick_jit, static_argnames="form")
def _gauss_newton(
    form: MotionDynamics, numbers: Numbers, q: Array, x: Array, u: Array, weight: Array, size: Array
) -> tuple[Array, Array]:
    c, w = numbers.c, numbers.weights

    def one(x: Array, u: Array) -> Any:
        def rest(q: AnyArray) -> Any:
            return rest_of(form, numbers, q, c, w, x, u, size)

        return rest(q), jax.jacfwd(rest)(q)

    rest, slope = jax.vmap(one)(x, u)
    slope = jnp.where(jnp.isfinite(slope), slope, 0.0)
    gradient = jnp.einsum("m,mi,mij->j", weight, rest, slope)
    return gradient, jnp.einsum("m,mij,mik->jk", weight, slope, slope)


@partial(quick_jit, static_argnames="form")
def _second(
    form: MotionDynamics, numbers: Numbers, q: Array, x: Array, u: Array, weight: Array, size: Array
) -> tuple[Array, ...]:
    """Return the second derivatives of half the distance: in q, in q and c, in q and w.

    And what the rest is made of.
    """
    c, w = numbers.c, numbers.weights

    def one(x: Array, u: Array) -> Any:
        def half(q: Array, c: Array, w: Array) -> Any:
            return jnp.sum(rest_of(form, numbers, q, c, w, x, u, size) ** 2) / 2

        downhill = jax.grad(half)
        second = jax.jacfwd(downhill)(q, c, w)
        to_c, to_w = jax.jacrev(downhill, (1, 2))(q, c, w)
        slope = jax.jacfwd(lambda q: rest_of(form, numbers, q, c, w, x, u, size))(q)
        learner = jnp.sum((form.learned(numbers, x, u) / size) ** 2)
        rest = jnp.sum(rest_of(form, numbers, q, c, w, x, u, size) ** 2)
        fitted = _learned_rows(form, c, x, u, c) + form.learned(numbers, x, u)
        whole = jnp.sum((fitted / size) ** 2)
        return second, to_c, to_w, slope.T @ slope, downhill(q, c, w), learner, rest, whole

    found = jax.vmap(one)(x, u)
    return tuple(
        jnp.einsum("m,m...->...", weight, jnp.where(jnp.isfinite(part), part, 0.0))
        for part in found
    )
