"""The estimation problem: rows, physics matrix and projection of a record, checked.

Everything that can be wrong with data and physics together is found here, without JAX.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug._base.parallel import one_blas_thread
from orthaug.data.expressions import Lag, parse
from orthaug.data.record import Record
from orthaug.data.regressors import (
    Features,
    Lags,
    Layout,
    UsableRows,
    in_order,
    lag_matrix,
    stack_rows,
)
from orthaug.physics.baseline import Baseline, Parameter, derived_units
from orthaug.physics.excitation import Excitation, excitation, require_rank
from orthaug.physics.noise import RowFilter
from orthaug.physics.output_weights import OutputWeights, check_output_weights, weigh_outputs
from orthaug.physics.projection import Projection
from orthaug.physics.shared import SharedDirections, shared_directions

# Size of outputs and regressors whose squares still add up; 1 / _LARGEST is the smallest
_LARGEST = 1e120

_SMALLEST_RESIDUAL = 1e-10  # of an output's deviation: the physics leaves at least rounding


class Extent(NamedTuple):
    """Smallest and largest value of some columns, (n,) each; `|` joins those of two parts."""

    low: Vector
    high: Vector

    @classmethod
    def of(cls, values: Matrix) -> Extent:
        return cls(values.min(axis=0, initial=np.inf), values.max(axis=0, initial=-np.inf))

    def __or__(self, other: Extent) -> Extent:
        return Extent(np.minimum(self.low, other.low), np.maximum(self.high, other.high))


class Moments(NamedTuple):
    """Count, mean and scatter `Σ (v − v̄)(v − v̄)ᵀ` of columns; `|` joins those of two parts."""

    count: int
    mean: Vector
    scatter: Matrix

    @classmethod
    def of(cls, values: Matrix) -> Moments:
        mean = values.mean(axis=0) if len(values) else np.zeros(values.shape[1])
        return cls(len(values), mean, (values - mean).T @ (values - mean))

    def __or__(self, other: Moments) -> Moments:
        """Return the moments of both together (Chan, Golub and LeVeque 1983)."""
        count = self.count + other.count
        if not count:
            return self
        apart = other.mean - self.mean
        scatter = (
            self.scatter
            + other.scatter
            + np.outer(apart, apart) * (self.count * other.count / count)
        )
        return Moments(count, self.mean + apart * (other.count / count), scatter)

    @property
    def covariance(self) -> Matrix:
        return self.scatter / max(self.count, 1)

    @property
    def square(self) -> float:
        """Sum of all squares."""
        return float(np.trace(self.scatter) + self.count * self.mean @ self.mean)


@dataclass(frozen=True, eq=False)
class Problem:
    """Usable rows of a record, and all quantities that do not depend on the learner's weights.

    `weight` weighs the outputs, for criterion and measure alike: so F1 holds for several outputs
    too. Rows multiplied by it are called whitened. `target` is the outputs without the fixed terms,
    `deviation` (ny,) the standard deviation of the outputs themselves.
    """

    record: Record
    baseline: Baseline
    features: Features
    layout: Layout
    rows: UsableRows
    target: Float[np.ndarray, "N ny"]
    deviation: Vector
    weight: OutputWeights
    projection: Projection
    excitation: Excitation
    noise: RowFilter | None = field(default=None, kw_only=True)
    """The filter L of a noise model: Φ and Y of projection and criterion are LΦ and LY."""

    def __repr__(self) -> str:
        lags = ", ".join(str(lag) for lag in self.layout)
        return (
            f"Problem({len(self.rows)} rows of {', '.join(self.outputs)}, x: {lags}, "
            f"{self.baseline!r})"
        )

    @property
    def new_state(self) -> str:
        """Remedy for a state that the physics lacks, in words."""
        return (
            "add lags of outputs and inputs to the physics, or write the system as a motion with "
            "that state"
        )

    @property
    def physics(self) -> Baseline:
        """The physics that the record is fitted with."""
        return self.baseline

    @property
    def physics_in_words(self) -> str:
        """The physics in a few words."""
        return repr(self.baseline)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters of the physics, as declared."""
        return self.baseline.parameters

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.baseline.names

    @property
    def linear(self) -> bool:
        """True if the physics is linear in θ."""
        return self.baseline.linear

    @property
    def derived_units(self) -> dict[str, str]:
        """Units of parameters that follow from those of the channels."""
        return derived_units(self.baseline, self.record.outputs, self.record.inputs)

    def values_at(self, theta: Vector) -> Vector:
        """Return the values of the parameters at θ, which they are."""
        return theta

    @property
    def rows_in_memory(self) -> int:
        """Number of rows that are in memory."""
        return len(self.rows)

    @property
    def feature_count(self) -> int:
        """Number of inputs of a learner."""
        return len(self.features.entries)

    @property
    def learner_outputs(self) -> int:
        """Number of outputs of a learner."""
        return len(self.outputs)

    @property
    def lengths(self) -> tuple[int, ...]:
        """Rows of each experiment."""
        return tuple(len(part) - self.rows.start for part in self.record.experiments)

    @property
    def outputs(self) -> tuple[str, ...]:
        return tuple(channel.name for channel in self.record.outputs)

    @property
    def first_row(self) -> int:
        """The first row of an experiment that has a regressor."""
        return self.rows.start

    @property
    def count(self) -> int:
        """Number of rows."""
        return len(self.rows)

    @property
    def samples(self) -> int:
        """Rows that the criterion counts times outputs."""
        return self.counted * len(self.outputs)

    @property
    def counted(self) -> int:
        """Number of rows that the criterion counts."""
        return self.count if self.noise is None else self.noise.counted

    def filtered(self, noise: RowFilter | None) -> Problem:
        """Return the problem under a noise model; None for white errors."""
        phi = self.baseline.on(self.rows.x, self.layout, self.outputs)[0]
        phi = phi if noise is None else noise.rows(phi)
        projection = Projection.factor(self.weight.rows(phi))
        excited = excitation(projection.r, self.baseline.names)
        return replace(self, noise=noise, projection=projection, excitation=excited)

    @property
    def unfiltered(self) -> Problem:
        """The problem without its noise model."""
        return self if self.noise is None else self.filtered(None)

    @property
    def used(self) -> tuple[Lag, ...]:
        """The raw lags that the physics or the learner reads."""
        read = {*self.baseline.lags, *self.features.lags}
        return tuple(lag for lag in self.layout if lag in read)

    @property
    def whitened_target(self) -> Float[np.ndarray, "N ny"]:
        return self.weight.rows(self.target if self.noise is None else self.noise.rows(self.target))

    @cached_property
    def least_squares(self) -> Vector:
        """Φ⁺Y (nθ,): θ̂ of physics alone, and of the orthogonal structure with any learner (F1)."""
        return self.projection.solve(self.whitened_target)

    @cached_property
    def target_coordinates(self) -> Vector:
        """QᵀY (nθ,)."""
        return self.projection.coordinates(self.whitened_target)

    @cached_property
    def unexplained(self) -> Float[np.ndarray, "N ny"]:
        """P⊥Y, the part of the whitened outputs that the physics cannot express."""
        return self.projection.orthogonal_part(self.whitened_target)

    @cached_property
    def unexplained_moments(self) -> Moments:
        """Moments of `unexplained`."""
        return Moments.of(self.unexplained)

    def unexplained_sizes(self, *, centred: bool) -> tuple[Vector, Vector]:
        """Return the size (ny,) of the residual of the physics, whitened and not.

        The size is its deviation, or its RMS.
        """
        moments, back = self.unexplained_moments, np.linalg.inv(self.weight.matrix)
        found = []
        for change, least in ((np.eye(len(back)), np.ones(len(back))), (back, self.deviation)):
            square = np.diag(change @ moments.covariance @ change.T)
            square = square if centred else square + (change @ moments.mean) ** 2
            found.append(np.maximum(np.sqrt(square), _SMALLEST_RESIDUAL * least))
        return found[0], found[1]

    @property
    def target_covariance(self) -> Matrix:
        return Moments.of(self.target).covariance

    @property
    def largest_output(self) -> Vector:
        """The largest size of each output (ny,)."""
        return np.max([np.abs(e.outputs).max(axis=0) for e in self.record.experiments], axis=0)

    @cached_property
    def shared(self) -> SharedDirections:
        """The directions of θ that a learner on these features could imitate."""
        return shared_directions(
            self.baseline, self.features, self.layout, self.outputs, self.rows.x
        )

    @cached_property
    def freedom_used(self) -> Vector:
        """Degrees of freedom (ny,) that the physics uses up in each output.

        An output has the share `Σ_k ‖Q_ki‖²` of nθ, and the coefficients of its noise model.
        """
        used = np.sum(self.projection.q**2, axis=(0, 2))
        return used if self.noise is None else used + self.noise.used

    def for_linear_learner(self) -> Problem:
        """Return the problem for a learner that is a linear combination of its features."""
        return (
            self
            if self.features.linear
            else replace(self, features=replace(self.features, linear=True))
        )

    def physics_alone(self) -> Problem:
        """Return the problem without a learner.

        It is posed anew where the learner's lags took rows from the physics.
        """
        outputs, inputs = self.outputs, tuple(channel.name for channel in self.record.inputs)
        if (
            self.baseline.function is not None
            or in_order(self.baseline.lags, outputs, inputs) == self.layout
        ):
            return replace(self, features=Features(()))
        return pose(self.record, self.baseline, output_weights=self.weight.choice)

    def on(self, record: Record) -> Problem:
        """Return the problem with the same physics and features on another record."""
        posed = _pose(record, self.baseline, self.layout, self.features, self.weight.choice)
        if self.noise is None:
            return posed
        return posed.filtered(replace(self.noise, lengths=posed.lengths))

    def weigh(self, weight: OutputWeights) -> Problem:
        """Return the problem with other output weights."""
        if weight is self.weight:
            return self
        projection = Projection.factor(weight.rows(self.weight.outputs(self.projection.phi)))
        excited = excitation(projection.r, self.baseline.names)
        return replace(self, weight=weight, projection=projection, excitation=excited)

    def feature_rows(self) -> Matrix:
        """Return the learner's features (N, nz).

        Raises:
            InputError: a feature that is not finite on some row.
        """
        return feature_rows(self.features, self.rows, self.layout, self.record)

    @cached_property
    def feature_range(self) -> Float[np.ndarray, "2 nz"]:
        """Least and largest value of each of the learner's features over the rows."""
        z = self.feature_rows()
        return np.stack([z.min(axis=0), z.max(axis=0)])


@one_blas_thread()
def pose(
    record: Record,
    baseline: Baseline,
    lags: Lags | None = None,
    learner_inputs: tuple[str, ...] | None = None,
    *,
    output_weights: str | Sequence[float] = "auto",
    require_full_rank: bool = True,
) -> Problem:
    """Check record and physics against each other and factorise.

    Args:
        lags: the learner's regressor; None for what the baseline's expressions use.
        learner_inputs: expressions or raw lags that the learner sees instead of all lags.
        output_weights: as in `estimate`; "covariance" and "auto" begin with standard deviations.
        require_full_rank: raise where the data do not determine θ; `check` reports it instead.

    Raises:
        InputError: unknown channels, outputs at lag 0, constant channels, values that are not
            finite, too few rows, initial values beyond their bounds, a constant `Ts` that is not
            the sampling time; RankError for linearly dependent physics.
    """
    outputs, inputs = (tuple(c.name for c in group) for group in (record.outputs, record.inputs))
    if not outputs:
        raise InputError("the record has no outputs; there is nothing to fit.")
    record.check_measured()
    check_output_weights(output_weights, len(outputs))
    baseline.check_initial()
    baseline = baseline.sampled(record.sampling_time)
    baseline.check_channels(outputs, inputs)
    layout, features = regressor_of(baseline, lags, learner_inputs, outputs, inputs)
    features = features.sampled(record.sampling_time)
    return _pose(
        record, baseline, layout, features, output_weights, require_full_rank=require_full_rank
    )


def _pose(
    record: Record,
    baseline: Baseline,
    layout: Layout,
    features: Features,
    output_weights: str | Sequence[float],
    *,
    require_full_rank: bool = True,
) -> Problem:
    """Return rows, physics matrix and factor of a record whose channels were checked."""
    outputs = tuple(channel.name for channel in record.outputs)
    rows = stack_rows(record, layout)
    signals = [np.concatenate([e.outputs, e.inputs], axis=1) for e in record.experiments]
    check_moving(Extent.of(np.concatenate(signals)), record, layout)
    phi, known = baseline.on(rows.x, layout, outputs)
    with np.errstate(all="ignore"):
        target = rows.y - known
        deviation = rows.y.std(axis=0)
    check_physics(phi, known, baseline, rows, record)
    check_sizes(deviation, np.ptp(target, axis=0))
    deviation = np.where(deviation > 0, deviation, 1.0)
    weight = weigh_outputs(output_weights, deviation)
    projection = Projection.factor(weight.rows(phi))
    excited = excitation(projection.r, baseline.names)
    if require_full_rank:
        require_rank(excited, rows.y.size)
    return Problem(
        record, baseline, features, layout, rows, target, deviation, weight, projection, excited
    )


def check_defined(problem: Problem, record: Record) -> None:
    """Raise InputError where physics or learner inputs are not finite on another record."""
    layout, outputs, start = problem.layout, problem.outputs, problem.rows.start
    for experiment in record.experiments:
        alone = replace(record, experiments=(experiment,))
        rows = UsableRows(
            lag_matrix(experiment, layout, record, start), experiment.outputs[start:], layout, start
        )
        phi, known = problem.baseline.on(rows.x, layout, outputs)
        check_physics(phi, known, problem.baseline, rows, alone)
        feature_rows(problem.features, rows, layout, alone)


def feature_rows(features: Features, rows: UsableRows, layout: Layout, record: Record) -> Matrix:
    """Return the learner's features (N, nz) of some rows; InputError where one is not finite."""
    with np.errstate(all="ignore"):
        z = np.asarray(features.evaluate(rows.x, layout, np))
    for j, entry in enumerate(features.entries):
        _check_finite(z[:, j], f"the learner input {entry}", rows, record)
    return z


def regressor_of(
    baseline: Baseline,
    lags: Lags | None,
    learner_inputs: tuple[str, ...] | None,
    outputs: tuple[str, ...],
    inputs: tuple[str, ...],
) -> tuple[Layout, Features]:
    """Return the regressor of the whole model, and the learner's features of it.

    Raises:
        InputError: unknown channels, outputs at lag 0, learner inputs that cannot be read.
    """
    chosen = (
        in_order(baseline.lags, outputs, inputs) if lags is None else lags.layout(outputs, inputs)
    )
    features = Features.of(chosen)
    if learner_inputs is not None:
        constants = dict(baseline.constants)
        try:
            expressions = [parse(text, constants) for text in learner_inputs]
            for expression in expressions:
                in_order(expression.lags, outputs, inputs)
        except InputError as error:
            raise InputError(f"learner input: {error}") from None
        features = Features(tuple(expressions))
    if baseline.function is not None:  # it takes the regressor exactly as `lags` orders it
        if lags is None:
            raise InputError(
                "a baseline function needs `lags`: they define the regressor x that it is "
                "called with."
            )
        missing = set(features.lags) - set(chosen)
        if missing:
            raise InputError(
                f"the learner inputs use {', '.join(map(str, missing))}, which `lags` does not "
                "contain."
            )
        return chosen, features
    return in_order((*chosen, *features.lags, *baseline.lags), outputs, inputs), features


def check_moving(extent: Extent, record: Record, layout: Layout) -> None:
    """Raise InputError for a channel of the model that is constant.

    `extent` is that of outputs, then inputs.
    """
    used = {lag.channel for lag in layout} | {channel.name for channel in record.outputs}
    for channel, low, high in zip(record.channels, *extent, strict=True):
        if channel.name in used and low == high:
            raise InputError(
                f"channel '{channel.name}' is constant ({low:g}) over all training data; "
                "nothing can be learned from it. Remove it, or use data in which it moves."
            )


def check_sizes(deviation: Vector, moved: Vector) -> None:
    """Raise InputError for outputs whose squares double precision cannot represent.

    `moved` is the range of each output (ny,).
    """
    moves = moved > 0
    if not np.all(np.isfinite(deviation)) or np.any(
        moves & ((deviation > _LARGEST) | (deviation < 1 / _LARGEST))
    ):
        raise InputError(
            f"the outputs move by {np.max(moved):.3g}, too large or too small for double precision "
            "arithmetic; scale them (`scale` of the channel)."
        )


def check_physics(
    phi: np.ndarray, known: np.ndarray, baseline: Baseline, rows: UsableRows, record: Record
) -> None:
    """Raise InputError where Φ (N, ny, nθ), the fixed terms (N, ny) or their squares overflow."""
    for j, name in enumerate(baseline.names):
        texts = (
            ", ".join(t.regressor for t in baseline.terms if t.parameter == name)
            or "the baseline function"
        )
        _check_finite(phi[:, :, j], f"the regressor of {name} ({texts})", rows, record)
        size = np.abs(phi[:, :, j]).max()
        if size > _LARGEST or 0 < size < 1 / _LARGEST:
            raise InputError(
                f"the regressor of {name} ({texts}) is of size {size:.3g}, beyond double "
                "precision arithmetic; scale its channels (`scale`)."
            )
    _check_finite(known, "the sum of the fixed terms", rows, record)


def _check_finite(values: np.ndarray, what: str, rows: UsableRows, record: Record) -> None:
    bad = np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))
    if not bad.size:
        return
    row = int(bad[0])
    for experiment in record.experiments:
        usable = len(experiment) - rows.start
        if row < usable:
            raise InputError(f"{experiment.where(row + rows.start)}: {what} is not finite there.")
        row -= usable
