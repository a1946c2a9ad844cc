"""The estimation problem: a record with its physics, checked against each other.

Everything that can be wrong with data and physics together is found here, without JAX. Lagged
physics has rows, a physics matrix and its projection; a motion has its equations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug._base.parallel import one_blas_thread
from orthaug.data.expressions import Expression, Lag, parse_named
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
from orthaug.physics.baseline import Baseline, Parameter, derived_units, regressor_of
from orthaug.physics.excitation import Excitation, excitation, require_rank
from orthaug.physics.guessed_motion import GuessedMotion, SignalName, check_start, layout_of
from orthaug.physics.learner_states import LearnerStates, add_memory
from orthaug.physics.moments import Extent, Moments
from orthaug.physics.motion import Motion
from orthaug.physics.noise import RowFilter
from orthaug.physics.output_weights import OutputWeights, check_output_weights, weigh_outputs
from orthaug.physics.parameters import PhysicalParameter, check_time_units
from orthaug.physics.projection import Projection
from orthaug.physics.row_checks import check_moving, check_physics, check_sizes, feature_rows
from orthaug.physics.shared import SharedDirections, shared_directions

_SMALLEST_RESIDUAL = 1e-10  # of an output's deviation: the physics leaves at least rounding


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedProblem:
    """A record posed with physics of any kind: what training, splits and findings ask of both.

    `deviation` (ny,) is the standard deviation of the outputs. `weight` weighs them against each
    other, for criterion and measure alike.
    """

    record: Record
    deviation: Vector
    weight: OutputWeights

    new_state: ClassVar[str]
    """Remedy for a state that the physics lacks, in words."""
    streamed: ClassVar[bool] = False
    """True where the rows stay in a source, and `rows` are a subsample of them."""

    @property
    def physics(self) -> Baseline | Motion:
        """The physics that the record is fitted with."""
        raise NotImplementedError

    @property
    def physics_in_words(self) -> str:
        """The physics in a few words."""
        return repr(self.physics)

    @property
    def parameters(self) -> tuple[Parameter | PhysicalParameter, ...]:
        """The parameters of the physics, as declared."""
        return self.physics.parameters

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.physics.names

    @property
    def linear(self) -> bool:
        """True if the physics is linear in its parameters."""
        return False

    @property
    def unread(self) -> tuple[str, ...]:
        """Names of inputs that neither the physics nor a learner reads; none where unknown."""
        return ()

    @property
    def set_by_controller(self) -> tuple[str, ...]:
        """Names of the signals that a declared controller sets."""
        return ()

    @property
    def other_time_units(self) -> tuple[str, ...]:
        """Parameters in equations whose units have another time than the instants."""
        return ()

    @property
    def derived_units(self) -> dict[str, str]:
        """Units of parameters that follow from those of the channels."""
        return {}

    def values_at(self, theta: Vector) -> Vector:
        """Return the values of the parameters at θ̂, or at their coordinates."""
        return theta

    @property
    def outputs(self) -> tuple[str, ...]:
        return tuple(channel.name for channel in self.record.outputs)

    @property
    def feature_count(self) -> int:
        """Number of inputs of a learner."""
        raise NotImplementedError

    @property
    def learner_outputs(self) -> int:
        """Number of outputs of a learner."""
        return len(self.outputs)

    @property
    def first_row(self) -> int:
        """The first row of an experiment that the physics is evaluated at."""
        return 0

    @property
    def count(self) -> int:
        """Number of rows."""
        return len(self.record)

    @property
    def rows_in_memory(self) -> int:
        """Number of rows that are in memory."""
        return self.count

    @property
    def largest_output(self) -> Vector:
        """The largest size of each output (ny,)."""
        return np.array([np.abs(samples).max() for samples in self.record.measured])

    def physics_alone(self) -> PosedProblem:
        """Return the problem without a learner."""
        raise NotImplementedError

    def on(self, record: Record) -> PosedProblem:
        """Return the problem with the same physics and features on another record."""
        raise NotImplementedError

    @property
    def poser(self) -> Callable[[Record], PosedProblem]:
        """Function that poses the problem on another record; it can be sent to a process."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False, kw_only=True)
class Problem(PosedProblem):
    """Usable rows of a record, and all quantities that do not depend on the learner's weights.

    `weight` weighs the outputs, for criterion and measure alike: so F1 holds for several outputs
    too. Rows multiplied by it are called whitened. `target` is the outputs without the fixed terms,
    `deviation` (ny,) the standard deviation of the outputs themselves.
    """

    baseline: Baseline
    features: Features
    layout: Layout
    rows: UsableRows
    target: Float[np.ndarray, "N ny"]
    projection: Projection
    excitation: Excitation
    noise: RowFilter | None = None
    """The filter L of a noise model: Φ and Y of projection and criterion are LΦ and LY."""

    new_state: ClassVar[str] = (
        "give the learner states of its own (learner.states), add lags of outputs and inputs to "
        "the physics, or write the system as a motion with that state"
    )

    def __repr__(self) -> str:
        lags = ", ".join(str(lag) for lag in self.layout)
        return (
            f"Problem({len(self.rows)} rows of {', '.join(self.outputs)}, x: {lags}, "
            f"{self.baseline!r})"
        )

    @property
    def physics(self) -> Baseline:
        """The physics that the record is fitted with."""
        return self.baseline

    @property
    def linear(self) -> bool:
        """True if the physics is linear in θ."""
        return self.baseline.linear

    @property
    def derived_units(self) -> dict[str, str]:
        """Units of parameters that follow from those of the channels."""
        return derived_units(self.baseline, self.record.outputs, self.record.inputs)

    @property
    def rows_in_memory(self) -> int:
        """Number of rows that are in memory."""
        return len(self.rows)

    @property
    def feature_count(self) -> int:
        """Number of inputs of a learner."""
        return len(self.features.entries)

    @property
    def lengths(self) -> tuple[int, ...]:
        """Rows of each experiment."""
        return tuple(len(part) - self.rows.start for part in self.record.experiments)

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

    def phi(self, x: Matrix) -> Float[np.ndarray, "M ny nt"]:
        """Return φ(x) of regressors (M, nx)."""
        return np.asarray(self.baseline.phi(x, self.layout, self.outputs, np))

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
    def unread(self) -> tuple[str, ...]:
        if self.baseline.function is not None:
            return ()
        read = {lag.channel for lag in self.used}
        return tuple(c.name for c in self.record.inputs if c.name not in read)

    @property
    def unread_lags(self) -> Layout:
        """The inputs that nothing reads, at the smallest lag of the others."""
        inputs = [c.name for c in self.record.inputs]
        delays = [lag.lag for lag in self.layout if lag.channel in inputs]
        return tuple(Lag(name, min(delays, default=0)) for name in self.unread)

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
        return self.poser(record)

    @property
    def poser(self) -> Callable[[Record], Problem]:
        """Function that poses the problem on another record, without these rows: it can be sent."""
        return _Poser(self.baseline, self.layout, self.features, self.weight.choice, self.noise)

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


@dataclass(frozen=True)
class _Poser:
    """Ingredients of a problem, without its rows."""

    baseline: Baseline
    layout: Layout
    features: Features
    output_weights: str | Sequence[float]
    noise: RowFilter | None

    def __call__(self, record: Record) -> Problem:
        posed = _pose(record, self.baseline, self.layout, self.features, self.output_weights)
        if self.noise is None:
            return posed
        return posed.filtered(replace(self.noise, lengths=posed.lengths))


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
    record.check_even("physics in lagged values")
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
        record=record,
        baseline=baseline,
        features=features,
        layout=layout,
        rows=rows,
        target=target,
        deviation=deviation,
        weight=weight,
        projection=projection,
        excitation=excited,
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


@dataclass(frozen=True, eq=False, kw_only=True)
class MotionProblem(GuessedMotion, PosedProblem):
    """A record with its motion; `features` are what a learner sees."""

    features: tuple[Expression, ...]

    @property
    def unread(self) -> tuple[str, ...]:
        seen = {name for feature in self.features for name in feature.names}
        return tuple(name for name in self.motion.unread if name not in seen)

    new_state: ClassVar[str] = (
        "write the state out as a state of the motion with its own equation, or give the learner "
        "states of its own (learner.states)"
    )

    def __repr__(self) -> str:
        motion = self.motion
        return (
            f"MotionProblem({len(self.record)} rows of {', '.join(self.outputs)}, states "
            f"{motion.names_of_states})"
        )

    @property
    def physics(self) -> Motion:
        return self.motion

    @property
    def physics_in_words(self) -> str:
        return f"motion of {', '.join(self.motion.names_of_states)}"

    @property
    def set_by_controller(self) -> tuple[str, ...]:
        return self.motion.held

    @property
    def other_time_units(self) -> tuple[str, ...]:
        return check_time_units(self.motion, self.record.time_column)

    def values_at(self, theta: Vector) -> Vector:
        return self.motion.coordinates.physical(theta)

    @property
    def feature_count(self) -> int:
        return len(self.features)

    @property
    def learner_outputs(self) -> int:
        return max(sum(map(len, self.motion.learned)), 1)

    @property
    def layout(self) -> tuple[SignalName, ...]:
        """Names of states, then inputs."""
        return layout_of(self.motion)

    used = layout

    def physics_alone(self) -> MotionProblem:
        """Return the problem without a learner, whose inputs take no rows from a motion."""
        return self

    def without_learner(self) -> MotionProblem:
        """Return the problem with no state and no output learned."""
        states = tuple(replace(state, learned=False) for state in self.motion.states)
        outputs = tuple(replace(output, learned=False) for output in self.motion.outputs)
        return replace(self, motion=replace(self.motion, states=states, outputs=outputs))

    def on(self, record: Record) -> MotionProblem:
        return replace(self, record=record)

    @property
    def poser(self) -> Callable[[Record], MotionProblem]:
        return self.on


def pose_motion(
    record: Record,
    motion: Motion,
    learner_inputs: Sequence[str] | None = None,
    output_weights: str | Sequence[float] = "auto",
    memory: LearnerStates = LearnerStates(),  # noqa: B008  (frozen)
) -> MotionProblem:
    """Check record and motion against each other.

    Args:
        learner_inputs: expressions of states and inputs that the learner sees; None for all of
            them.
        memory: states of the learner's own, which are added to the motion.

    Raises:
        InputError: other channels, outputs that do not move, learner inputs that cannot be,
            equations that have no value at the start, a sampling time too long for the fastest
            mode.
    """
    inputs, outputs = (tuple(c.name for c in group) for group in (record.inputs, record.outputs))
    motion = motion.sampled(record.sampling_time)
    motion.check_channels(inputs, outputs)
    check_time_units(motion, record.time_column)
    if not record.even:
        motion.check_paced(record)
    motion, learner_inputs = add_memory(motion, learner_inputs, memory, record)
    check_output_weights(output_weights, len(outputs))
    parts = [replace(record, experiments=(experiment,)) for experiment in record.experiments]
    for name, *samples in zip(outputs, *(part.measured for part in parts), strict=True):
        if not any(map(len, samples)):
            raise InputError(f"channel '{name}' has no measured sample; leave it out.")
        if all(np.ptp(own) == 0.0 for own in samples if len(own)):
            raise InputError(
                f"channel '{name}' is constant over all training data; nothing can be learned "
                "from it."
            )
    deviation = record.deviation
    deviation = np.where(deviation > 0, deviation, 1.0)
    problem = MotionProblem(
        record=record,
        motion=motion,
        features=_features(motion, learner_inputs),
        deviation=deviation,
        weight=weigh_outputs(output_weights, deviation),
    )
    problem = replace(problem, motion=replace(motion, integrator=problem.integrator))
    check_start(problem)
    return problem


def _features(motion: Motion, texts: Sequence[str] | None) -> tuple[Expression, ...]:
    signals = {*motion.names_of_states, *motion.inputs} - {*motion.visible}
    known = {
        name: value
        for name, value in motion.known.items()
        if name not in motion.names and name not in signals
    }
    reach = {
        name for name, expression in motion.definitions if set(expression.names) & set(motion.names)
    }
    texts = motion.visible if texts is None else tuple(texts)
    if not texts:
        raise InputError(
            "the learner has no inputs; give `inputs` such as a state's name, or leave the key "
            "out for all."
        )
    found = []
    for text in texts:
        expression = parse_named(text, known, "learner input")
        hidden = [name for name in expression.names if name in reach]
        if hidden:
            raise InputError(
                f"learner input = {text}: '{hidden[0]}' contains parameters; use states and inputs."
            )
        found.append(expression)
    return tuple(found)
