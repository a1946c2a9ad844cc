"""The fitted model: prediction, free run and step of its dynamics, and the parts of the output.

A lagged model is ŷ_k = φ(x_k)θ + (f(x_k) − φ(x_k)θ_aux), a motion ẋ = f(x, u; p) + learner,
y = h(x, u; p). What differs is in the `form` (`models.dynamics`), and in where the state of a run
comes from (`models.starts`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from orthaug._base.checks import Matrix, Vector, check_count
from orthaug._base.errors import InputError, show
from orthaug._base.jax import Array
from orthaug._base.views import NotebookView
from orthaug.data.channels import Channel
from orthaug.data.record import Experiment, Preparation, Record
from orthaug.models.dynamics import Numbers, Parts, Run
from orthaug.models.kalman import Filter
from orthaug.models.learners import Scaling
from orthaug.models.on_records import RUNAWAY, Form, RecordModel, trajectory
from orthaug.models.response import Response, Trajectory
from orthaug.models.starts import PastOutputs, Starts
from orthaug.models.statistics import Statistics
from orthaug.models.stepping import one_experiment, step_arguments
from orthaug.physics.baseline import Parameter
from orthaug.physics.innovations import InnovationsModel
from orthaug.physics.noise import NoiseModel
from orthaug.physics.parameters import PhysicalParameter

if TYPE_CHECKING:
    import pandas as pd

    from orthaug.models.moving import MotionDynamics


class TrainedSegments(NamedTuple):
    """Training segments and their initial states, for a later split under a measure.

    `rows` counts the rows that were scored, `alone` (np,) are the coordinates of physics alone;
    `slope` (k, m, nx, n) is how the starts `states` (k, nx, m) follow the unknowns, less its sign;
    None where that is not known.
    """

    segment: int
    washout: int
    rows: int
    states: Any
    slope: Any
    alone: Vector


@dataclass(frozen=True, eq=False)
class Model(RecordModel[Form], NotebookView):
    """A fitted model; `estimate` makes it, `orthaug.save` and `orthaug.load` keep it.

    `weight` (ny, ny) is the inner product of criterion and measure: rows multiplied by it are
    whitened. `deviation` (ny,) is that of the training outputs. From the `statistics` every
    function of the model has an interval.

    Examples:
        >>> import orthaug as oa
        >>> u = [1.0, 2.0, 0.0, 3.0, 1.0, 0.0]
        >>> y = [0.0, 0.5, 1.25, 0.625, 1.8125, 1.40625]  # 0.5 (y[k-1] + u[k-1])
        >>> record = oa.Record.from_arrays(u=u, y=y)
        >>> physics = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]")])
        >>> model = oa.estimate(record, physics, learner=None).model
        >>> other = oa.Record.from_arrays(u=[1.0, 1.0, 1.0], y=[4.0, 0.0, 0.0])
        >>> model.simulate(other).trajectories[0].model.T.round(6)  # from the first output
        array([[ nan, 2.5 , 1.75]])
        >>> model.predict(other).trajectories[0].model.T.round(6)  # from the measured ones
        array([[nan, 2.5, 0.5]])
    """

    form: Form
    numbers: Numbers
    """Of a motion θ are the coordinates of the physical parameters, θ − θ_aux those beside the
    learner.
    """
    outputs: tuple[Channel, ...]
    inputs: tuple[Channel, ...]
    sampling_time: float
    structure: str
    measure: str = field(default="training", kw_only=True)
    largest_output: Vector
    deviation: Vector
    weight: Matrix
    shared: Matrix | None = None
    """Directions of θ (nθ, s) along which a split makes the learner orthogonal; None for all."""
    time_column: str | None = None
    statistics: Statistics = Statistics()  # noqa: RUF009  (frozen)
    noise: NoiseModel | InnovationsModel | None = field(default=None, kw_only=True)
    """The model of the errors' colour, for predictions; None where nobody asked for one."""
    prepared: tuple[Preparation, ...] = field(default=(), kw_only=True, repr=False)
    """Preparation of the training data."""
    experiment_column: str | None = field(default=None, kw_only=True, repr=False)
    """The column that labelled the experiments of the training data; None where none did."""
    starts: Starts = field(default=PastOutputs(), kw_only=True, repr=False)  # noqa: RUF009
    """Origin of the state of a run."""
    trained: TrainedSegments | None = field(default=None, kw_only=True, repr=False)
    """Of a motion: how it was trained."""
    seen: Matrix | None = field(default=None, kw_only=True, repr=False)
    """Least and largest (2, nz) of the learner's features over the fitted run of the training data,
    where that is not the range by which they are scaled.
    """

    def __repr__(self) -> str:
        values = ", ".join(f"{name} = {value:.5g}" for name, value in self.parameters.items())
        return f"Model({self.structure}, {values or 'no θ'}, learner: {self.form.bound.learner})"

    @property
    def theta(self) -> Vector:
        """θ̂ (nθ,); of a motion the coordinates of the physical parameters (np,)."""
        return np.asarray(self.numbers.theta)

    @property
    def theta_aux(self) -> Vector:
        """θ_aux (nθ,), fixed after training."""
        return np.asarray(self.numbers.theta_aux)

    @property
    def units(self) -> dict[str, str]:
        """Units of the channels by their names."""
        return {channel.name: channel.unit for channel in (*self.outputs, *self.inputs)}

    @property
    def estimated(self) -> tuple[Sequence[Parameter | PhysicalParameter], Vector]:
        """The parameters and their values, as results list them."""
        coordinates = self.form.coordinates
        return coordinates.parameters, np.asarray(coordinates.physical(self.theta))

    @property
    def parameters(self) -> dict[str, float]:
        """The values of the parameters by name."""
        return {p.name: float(value) for p, value in zip(*self.estimated, strict=True)}

    @property
    def reached(self) -> Scaling:
        """Range of the learner's features in training.

        For a motion saved without it, it is the range of physics alone.
        """
        return super().reached if self.seen is None else Scaling.fit(self.seen)

    def learner_at(self: Model[Any], x: Matrix) -> Matrix:
        """Return f (M, ny), before any split, at regressors (M, nx), in the outputs' units.

        It is the learner itself, also beyond the range of its training, where the model holds the
        correction.
        """
        return self.form.learner_at(self.numbers, x)

    def parts_at(self: Model[Any], x: Matrix) -> Parts:
        """Return the prediction at measured regressors (T, nx), in parts."""
        return self.form.parts_at(self.numbers, x)

    def reach(self, record: Record) -> Matrix:
        """Return the points of a record at which the physics is evaluated, (N, nx).

        Of a lagged model they are the measured regressors, of a motion the finite states and inputs
        of the free run.
        """
        return self.starts.points(self, record)

    def components(self, record: Record) -> Response:
        """Return the response in its parts, before and after projection.

        It is one step ahead where a step has parts; of a motion it is the free run.
        """
        return self.predict(record) if self.form.separates else self.simulate(record)

    def predict(self, record: Record, horizon: int = 1) -> Response:
        """Predict each row from outputs measured up to `horizon` samples before it.

        A motion's state is estimated over the `window` rows up to there; where an experiment is
        shorter than that, over fewer.

        With a noise model the measured errors before it say what those on the way are likely to
        be: then the response is the sum of physics, learner and that forecast.

        Args:
            record: inputs and outputs, measured.
            horizon: samples ahead, 1 or more.

        Raises:
            InputError: a record without outputs, other channels, a horizon below 1, too few rows.
        """
        horizon = check_count(horizon, "horizon", of="steps")
        record = self.fitting(record, need_outputs=True)
        trajectories = []
        for experiment in record.experiments:
            first, parts, physics, forecast, chosen = self.starts.predict(
                self, experiment, record, horizon
            )
            ahead = trajectory(parts, experiment, experiment.outputs, first)
            if physics is not None:
                known = np.full(experiment.outputs.shape, np.nan)
                known[first:] = np.where(np.isfinite(physics), physics, np.nan)
                ahead = _with_physics(ahead, known)
            if forecast is not None:
                ahead = replace(ahead, whole=ahead.model.copy())
                ahead.model[first:] += forecast
            if chosen is not None:
                ahead = replace(ahead, chosen=np.r_[np.zeros(first, dtype=bool), chosen])
            trajectories.append(ahead)
        return Response(tuple(trajectories), horizon, self.outputs, record.sampling_time)

    def simulate(self, record: Record, initial: str | Any = "measured") -> Response:
        """Simulate the free run from the first usable row on.

        Past outputs in the regressor are the model's own. Of a motion `baseline` is the output of
        the physics alone from the same start, `learner` the difference.

        Args:
            record: inputs, and outputs where they are measured.
            initial: the outputs that determine the start: "measured" (from the record), "zero" for
                a state of zeros, or an array (rows, ny). Of a lagged model they are those before
                the first usable row; of a motion those that a free run from the start follows.

        Raises:
            InputError: other channels, too few rows, or initial values that are not there.
        """
        record = self.fitting(record, need_outputs=False)
        trajectories = [
            self.as_trajectory(*self.free_run(experiment, record, initial), experiment, record)
            for experiment in record.experiments
        ]
        return Response(tuple(trajectories), None, self.outputs, record.sampling_time)

    def free_run(
        self, experiment: Experiment, record: Record, initial: str | Any = "measured"
    ) -> tuple[Run, Matrix]:
        """Return the free run along an experiment, and the inputs (T, nu) as its steps read them.

        Raises:
            InputError: too few rows, or initial values that are not there.
        """
        self.check_rows(experiment, self.form.first_row)
        start = self.starts.first(self, experiment, record, initial)
        inputs = self.form.inputs(experiment, record)
        return self.form.run(self.numbers, start, inputs), inputs

    def as_trajectory(
        self, run: Run, inputs: Matrix, experiment: Experiment, record: Record
    ) -> Trajectory:
        """Return a free run, cut where it left all bounds, with the part of the physics."""
        measured = experiment.outputs if record.outputs else None
        found = self.bounded(run.parts, experiment, measured)
        if not self.learns:
            return found
        if not self.form.separates:
            physics = self.physics_only.form.run(
                self.physics_only.numbers, run.states[0], inputs
            ).parts.total
            with np.errstate(all="ignore"):
                wild = ~(np.abs(physics) <= RUNAWAY * self.largest_output).all(axis=1)
            lost = np.logical_or.accumulate(wild)[:, None] | np.isnan(found.model)
            found = _with_physics(found, np.where(lost, np.nan, physics))
        if not self.form.has_range:
            return found
        outside = self.beyond(self.features_along(run, inputs))
        return replace(
            found, outside=np.concatenate([np.zeros(self.form.first_row, dtype=bool), outside])
        )

    def features_along(self, run: Run, inputs: Matrix) -> Matrix:
        """Return the learner's features (T, nz) along a free run and its inputs (T, nu)."""
        with np.errstate(all="ignore"):
            read = self.form.at_samples(self.numbers, run.states, inputs)
            return self.form.features_at(run.states, read)

    def states(self, record: Record, initial: str | Any = "measured") -> pd.DataFrame:
        """Return the states of a free run.

        The table also has the physics and the learner of each learned equation or output: the rates
        of a motion, the outputs of a lagged model.
        """
        import pandas as pd

        record = self.fitting(record, need_outputs=False)
        frames = []
        for experiment in record.experiments:
            run, inputs = self.free_run(experiment, record, initial)
            rows = self.form.first_row + np.arange(len(run.states))
            columns = {"time": experiment.instants(self.sampling_time)[rows]}
            columns |= dict(zip(self.form.state_names, run.states.T, strict=True))
            for name, physics, learner in self.form.learned_along(self.numbers, run, inputs):
                columns |= {f"{name}_physics": physics, f"{name}_learner": learner}
            frames.append(pd.DataFrame(columns))
        return pd.concat(frames, ignore_index=True)

    @property
    def window(self) -> int:
        """Rows of measured outputs that determine a state."""
        return self.starts.rows(self.form)

    @cached_property
    def filtering(self) -> tuple[Filter, Numbers, Vector]:
        """The model as a filter: its dynamics, its numbers, and the size of an unknown state."""
        return self.starts.filtering(self)

    @property
    def plant(self: Model[Any]) -> Model[Any]:
        """The model without the controller around it, its inputs given from outside.

        Of a model without a controller it is the model itself. It keeps no statistics.
        """
        loop = getattr(self.form, "motion", None)
        return self if loop is None or not loop.held else plant_of(self)

    @property
    def state_names(self) -> tuple[str, ...]:
        """The entries of a step's state.

        Of a lagged model they are past outputs, then past inputs, `y[k-1]`.
        """
        return self.filtering[0].names

    @property
    def step_inputs(self) -> tuple[str, ...]:
        """Inputs of a step: those at its sample.

        Under the first-order hold of a motion those at the next sample follow behind them.
        """
        return self.starts.step_inputs(self)

    def start(self, record: Record, row: int | None = None) -> Vector:
        """Return the state before a row of a record of one experiment.

        By default it is the first row that has a prediction.

        Raises:
            InputError: other channels, several experiments, a row that is not there.
        """
        record = self.fitting(record, need_outputs=False)
        return self.starts.at(self, one_experiment(record), record, row)

    def step(self, state: Any, inputs: Any) -> tuple[Array, Array]:
        """Return one sample of a free run: the next state (n,) and the outputs (ny,).

        It starts from a state and the `step_inputs`.

        A pure function of JAX arrays, so that `jax.jit`, `jax.vmap` and `jax.grad` take it; to go
        on from a measured output, put that in the place of a lagged model's own.

        Raises:
            InputError: a spline hold, which needs the whole record.
        """
        form, numbers, _ = self.filtering
        arguments = step_arguments(state, inputs, len(form.names), len(self.step_inputs))
        following, parts = form.step(numbers, *arguments)
        return following, parts.total

    def check_initial(self, initial: Any) -> Matrix:
        """Return outputs (rows, ny) from which a free run starts.

        Raises:
            InputError: too few rows, or not one column per output.
        """
        return self.starts.check_initial(self, initial)

    def first_state(self, experiment: Experiment, record: Record) -> Vector:
        """Return the state at the first row of the free run from the measured outputs."""
        return self.starts.first(self, experiment, record, "measured")


if TYPE_CHECKING:
    MotionModel = Model[MotionDynamics]
else:
    MotionModel = Model  # the earlier name of the model of a motion


def _with_physics(run: Trajectory, physics: Matrix) -> Trajectory:
    """Return a run of the whole model with the output of the physics alone, NaN where it has none.

    The learner's part is the difference.
    """
    learner = run.model - physics
    return replace(run, baseline=physics, learner=learner, learner_before=learner, whole=run.model)


@runtime_checkable
class HoldsModel(Protocol):
    """An object with a fitted model, such as an estimate."""

    @property
    def model(self) -> Model[Any]:
        """The fitted model."""
        ...


def model_of(given: Model[Any] | HoldsModel) -> Model[Any]:
    """Return a model itself, or that of a fit.

    Raises:
        InputError: neither of them.
    """
    model = given if isinstance(given, Model) else getattr(given, "model", None)
    if isinstance(given, type) or not isinstance(model, Model):
        raise InputError(
            f"`model` must be a fitted model, or what estimate returns; got {show(given)}."
        )
    return model


def plant_of(model: Model[Any]) -> Model[Any]:
    """Return the model without the controller, its inputs given from outside.

    It has no statistics: those of the fit are the loop's.
    """
    loop, plant, numbers = model.form.motion, model.form.motion.plant, model.numbers
    names = [channel.name for channel in model.outputs]
    outputs = [names.index(output.name) for output in plant.outputs]
    states = [loop.names_of_states.index(name) for name in plant.names_of_states]
    inputs = [len(loop.states) + loop.inputs.index(name) for name in plant.inputs]
    own = [loop.names.index(name) for name in plant.names]
    known = {channel.name: channel for channel in (*model.inputs, *model.outputs)}
    pull = None if numbers.pull is None else np.asarray(numbers.pull)[[*states, *inputs]]
    own_starts: Any = model.starts
    starts = replace(own_starts, loose=np.asarray(own_starts.loose)[states])
    return replace(
        model,
        form=replace(model.form, motion=plant),
        numbers=numbers._replace(
            theta=np.asarray(numbers.theta)[own],
            theta_aux=np.asarray(numbers.theta_aux)[own],
            pull=pull,
        ),
        outputs=tuple(model.outputs[i] for i in outputs),
        inputs=tuple(known.get(name, Channel(name)) for name in plant.inputs),
        largest_output=np.asarray(model.largest_output)[outputs],
        deviation=np.asarray(model.deviation)[outputs],
        weight=np.asarray(model.weight)[np.ix_(outputs, outputs)],
        statistics=Statistics(),
        starts=starts,
        trained=None,
    )
