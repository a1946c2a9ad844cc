"""The fitted motion ẋ = f(x, u; p) + learner, y = h(x, u; p): free runs and predictions.

A run starts from a state that was not measured. It is estimated from the first rows of the record
or, for a prediction, from a window of rows before it: the state from which a free run over the
window follows the measured outputs best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector, as_signal, check_count
from orthaug._base.errors import InputError
from orthaug._base.jax import Array, jax, padded_length
from orthaug._base.views import NotebookView
from orthaug.data.record import Channel, Experiment, Preparation, Record
from orthaug.models.dynamics import Numbers, Parts
from orthaug.models.filters import MotionFilter
from orthaug.models.learners import Scaling
from orthaug.models.motion_field import parts_at
from orthaug.models.moving import MotionDynamics
from orthaug.models.on_records import RUNAWAY, RecordModel, trajectory
from orthaug.models.response import Response, Trajectory
from orthaug.models.settling import LOOSE, Windows, padded_steps, settle
from orthaug.models.statistics import Statistics
from orthaug.models.stepping import (
    checked_row,
    one_experiment,
    step_arguments,
    step_inputs,
    with_scheme,
)
from orthaug.physics.parameters import PhysicalParameter

if TYPE_CHECKING:
    import pandas as pd

FIRST_ROWS = 64  # from which the start of a free run is estimated
_SIDE_BY_SIDE = 256  # windows of predictions
_GUESS_ITERATIONS, _WINDOW_ITERATIONS = 30, 6


@partial(jax.jit, static_argnames="form")
def _run(
    form: MotionDynamics, numbers: Numbers, state: Float[Array, "n0"], inputs: Float[Array, "T nu"]
) -> tuple[Float[Array, "T n0"], Float[Array, "T ny"]]:
    """Return states and outputs of a free run."""
    numbers = form.prepare(numbers)

    def step(state: Any, row: Any) -> tuple[Any, tuple[Any, Any]]:
        following, parts = form.step(numbers, state, row)
        return following, (state, parts.total)

    return jax.lax.scan(step, state, inputs)[1]


@partial(jax.jit, static_argnames="form")
def _last_output(
    form: MotionDynamics,
    numbers: Numbers,
    states: Float[Array, "n0 m"],
    inputs: Float[Array, "T nu m"],
    steps: Any,
) -> Float[Array, "ny m"]:
    """Return the last output of `steps` of runs side by side."""
    numbers = form.prepare(numbers)
    side_by_side = jax.vmap(lambda state, row: form.step(numbers, state, row), -1, -1)
    states = jax.lax.fori_loop(
        0, steps - 1, lambda i, states: side_by_side(states, inputs[i])[0], states
    )
    return side_by_side(states, inputs[steps - 1])[1].total


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
class MotionModel(RecordModel, NotebookView):
    """A fitted motion; `estimate` makes it, `orthaug.save` and `orthaug.load` keep it.

    `window` rows give a state to predict from. `weight` (ny, ny) is the inner product of the
    outputs; `loose` (nx,) how far a state may be from its guess. `deviation` (ny,) is that of the
    training outputs.
    """

    form: MotionDynamics
    numbers: Numbers
    """θ are the coordinates of the physical parameters, θ − θ_aux those beside the learner."""
    outputs: tuple[Channel, ...]
    inputs: tuple[Channel, ...]
    sampling_time: float
    structure: str
    largest_output: Vector
    deviation: Vector
    weight: Matrix
    loose: Vector
    window: int
    measure: str = field(default="training", kw_only=True)
    time_column: str | None = None
    trained: TrainedSegments | None = field(default=None, repr=False)
    seen: Matrix | None = field(default=None, kw_only=True, repr=False)
    """Least and largest (2, nz) of the learner's features over the fitted run of the training data.
    """
    statistics: Statistics = Statistics()  # noqa: RUF009  (frozen)
    prepared: tuple[Preparation, ...] = field(default=(), kw_only=True, repr=False)
    """Preparation of the training data."""

    def __repr__(self) -> str:
        return (
            f"MotionModel({', '.join(f'{k} = {v:.5g}' for k, v in self.parameters.items())}, "
            f"learner: {self.form.bound.learner})"
        )

    @property
    def theta(self) -> Vector:
        """The coordinates of the physical parameters (np,)."""
        return np.asarray(self.numbers.theta)

    @property
    def parameters(self) -> dict[str, float]:
        """The physical parameters by name."""
        values = self.form.motion.coordinates.physical(self.theta)
        return {
            name: float(value) for name, value in zip(self.form.motion.names, values, strict=True)
        }

    @property
    def estimated(self) -> tuple[Sequence[PhysicalParameter], Vector]:
        """The physical parameters and their values, as results list them."""
        coordinates = self.form.motion.coordinates
        return coordinates.parameters, np.asarray(coordinates.physical(self.theta))

    @property
    def physics_only(self) -> MotionModel:
        """The model without its learner."""
        return replace(
            self,
            form=self.form.physics_only,
            numbers=self.numbers.physics_only._replace(gain=np.ones(0)),
        )

    alone = physics_only
    """Earlier name of `physics_only`."""

    def simulate(self, record: Record, initial: str | Any = "measured") -> Response:
        """Simulate the free run from the first row on.

        `baseline` is the output of the physics alone from the same start, `learner` the difference.

        Args:
            record: inputs, and outputs where they are measured.
            initial: "measured" (the state by which a free run follows the first rows of the record
                best), "zero", or an array (rows, ny) of outputs to follow instead.

        Raises:
            InputError: other channels, no rows, or initial values that are not there.
        """
        record = self.fitting(record, need_outputs=False)
        trajectories = [
            self._free_run(experiment, record, initial) for experiment in record.experiments
        ]
        return Response(tuple(trajectories), None, self.outputs, record.sampling_time)

    def predict(self, record: Record, horizon: int = 1) -> Response:
        """Predict each row from a state estimated over earlier rows.

        The state is estimated over the `window` rows up to `horizon` samples before the row.

        Where an experiment is shorter than that, over fewer.

        Raises:
            InputError: a record without outputs, other channels, a horizon below 1, too few rows.
        """
        horizon = check_count(horizon, "horizon", of="steps")
        record = self.fitting(record, need_outputs=True)
        trajectories = [
            self._predict_ahead(experiment, record, horizon) for experiment in record.experiments
        ]
        return Response(tuple(trajectories), horizon, self.outputs, record.sampling_time)

    def components(self, record: Record) -> Response:
        """Return the free run in its parts."""
        return self.simulate(record)

    def states(self, record: Record, initial: str | Any = "measured") -> pd.DataFrame:
        """Return the states of a free run.

        The table also has the rate of each learned equation by the physics, and by the learner.

        Learned outputs have the same columns.
        """
        import pandas as pd

        record = self.fitting(record, need_outputs=False)
        motion, frames = self.form.motion, []
        for experiment in record.experiments:
            start = self._start(experiment, initial, record)
            inputs = self.form.inputs(experiment, record)
            states, _ = self._follow(self.form, self.numbers, start, inputs)
            physics, learner = parts_at(self.form, self.numbers, states, experiment.inputs)
            time = experiment.start_time + np.arange(len(states)) * self.sampling_time
            columns = {"time": time} | {
                name: states[:, i] for i, name in enumerate(motion.names_of_states)
            }
            learned = [motion.names_of_states[i] for i in motion.learned[0]]
            learned += [motion.outputs[i].name for i in motion.learned[1]]
            for i, name in enumerate(learned):
                columns |= {f"{name}_physics": physics[:, i], f"{name}_learner": learner[:, i]}
            frames.append(pd.DataFrame(columns))
        return pd.concat(frames, ignore_index=True)

    @property
    def state_names(self) -> tuple[str, ...]:
        """The entries of a step's state."""
        return self.form.motion.names_of_states

    @property
    def step_inputs(self) -> tuple[str, ...]:
        """Inputs of a step: those at its sample.

        Under a first-order hold those at the next sample follow behind them.
        """
        return step_inputs(self.form)

    @cached_property
    def _stepping(self) -> Numbers:
        return with_scheme(self.form, self.numbers)

    def start(self, record: Record, row: int | None = None) -> Vector:
        """Return the state at a row of the free run on a record of one experiment.

        By default it is the first row.

        Raises:
            InputError: other channels, several experiments, a row that is not there.
        """
        record = self.fitting(record, need_outputs=False)
        experiment = one_experiment(record)
        row = checked_row(row, 0, len(experiment) - 1)
        state = self._start(experiment, "measured", record)
        if not row:
            return state
        return self._follow(self.form, self.numbers, state, self.form.inputs(experiment, record))[
            0
        ][row]

    def step(self, state: Any, inputs: Any) -> tuple[Array, Array]:
        """Return one sample: the next state (nx,) and the outputs (ny,) at this one.

        It starts from a state and `step_inputs`.

        A pure function of JAX arrays, so that `jax.jit`, `jax.vmap` and `jax.grad` take it.

        Raises:
            InputError: a spline hold, which needs the whole record.
        """
        arguments = step_arguments(state, inputs, self.form.states, len(self.step_inputs))
        following, parts = self.form.step(self._stepping, *arguments)
        return following, parts.total

    @property
    def filtering(self) -> tuple[MotionFilter, Numbers, Vector]:
        """The model as a filter: its dynamics, its numbers, and the size of an unknown state."""
        return MotionFilter(self.form), self._stepping, np.asarray(self.loose) / LOOSE

    @property
    def reached(self) -> Scaling:
        """Range of the learner's features in training.

        For a model saved without it, it is the range of physics alone.
        """
        return super().reached if self.seen is None else Scaling.fit(self.seen)

    def reach(self, record: Record) -> Matrix:
        """Return the finite states and inputs (N, nx + nu) of the free run on a record."""
        states = self.states(record)[list(self.form.motion.names_of_states)].to_numpy()
        inputs = [e.inputs for e in self.fitting(record, need_outputs=False).experiments]
        points = np.concatenate([states, np.concatenate(inputs)], axis=1)
        return points[np.isfinite(points).all(axis=1)]

    def check_initial(self, initial: Any) -> Matrix:
        """Return outputs of the first rows (rows, ny).

        Raises:
            InputError: no rows, or not one column per output.
        """
        if isinstance(initial, str):
            raise InputError(f"`initial` must be 'measured', 'zero' or an array; got '{initial}'.")
        rows = as_signal(initial, "initial")
        if rows.shape[1] != len(self.outputs):
            raise InputError(
                f"`initial` has {rows.shape[1]} columns; expected one per output, "
                f"{len(self.outputs)}."
            )
        return rows

    def _free_run(self, experiment: Experiment, record: Record, initial: str | Any) -> Trajectory:
        start = self._start(experiment, initial, record)
        inputs = self.form.inputs(experiment, record)
        states, whole = self._follow(self.form, self.numbers, start, inputs)
        measured = experiment.outputs if record.outputs else None
        nothing = np.zeros_like(whole)
        bounded = self.bounded(Parts(whole, nothing, nothing), experiment, measured)
        if not self.form.learns:
            return bounded
        alone = self.physics_only
        run = self._with_physics(bounded, self._follow(alone.form, alone.numbers, start, inputs)[1])
        return (
            run
            if run.diverged
            else replace(run, outside=self._outside(states, self.form.now(inputs)))
        )

    def _with_physics(self, run: Trajectory, physics: Matrix) -> Trajectory:
        """Return a run of the whole model with the output of the physics alone.

        There is no value from where that output left all bounds.
        """
        with np.errstate(all="ignore"):
            wild = ~(np.abs(physics) <= RUNAWAY * self.largest_output).all(axis=1)
        known = np.where(
            np.logical_or.accumulate(wild)[:, None] | np.isnan(run.model), np.nan, physics
        )
        learner = run.model - known
        return replace(
            run, baseline=known, learner=learner, learner_before=learner, whole=run.model
        )

    def _follow(
        self, form: MotionDynamics, numbers: Numbers, start: Vector, inputs: Matrix
    ) -> tuple[Matrix, Matrix]:
        rows = len(inputs)
        padded = np.concatenate(
            [inputs, np.repeat(inputs[-1:], padded_length(rows) - rows, axis=0)]
        )
        states, outputs = _run(form, numbers, start, padded)
        return np.asarray(states)[:rows], np.asarray(outputs)[:rows]

    def _outside(self, states: Matrix, inputs: Matrix) -> Any:
        """Return where the learner's features are outside those of training, (N,)."""
        with np.errstate(all="ignore"):
            return self.beyond(np.asarray(self.form.seen(states.T, inputs.T, np)).T)

    def first_state(self, experiment: Experiment, record: Record) -> Vector:
        """Return the state at the first row of the free run from the measured outputs."""
        return self._start(experiment, "measured", record)

    def _start(self, experiment: Experiment, initial: str | Any, record: Record) -> Vector:
        """Return the state at the first row."""
        if isinstance(initial, str) and initial == "zero":
            return np.zeros(self.form.states)
        if isinstance(initial, str) and initial == "measured":
            if not record.outputs:
                raise InputError(
                    "the record has no measured outputs to start from; use initial='zero' or "
                    "give the values."
                )
            rows = experiment.outputs
        else:
            rows = self.check_initial(initial)
        rows = rows[: max(FIRST_ROWS, self.window)]
        inputs = self.form.inputs(experiment, record)[: len(rows)]
        rows = rows[: len(inputs)]
        size = max(FIRST_ROWS, self.window)
        windows = Windows(
            _pad(inputs, size), _pad(rows, size), (np.arange(size) < len(rows))[:, None]
        )
        guess = self.form.start(rows, [0]).T
        settled = settle(
            self.form, self.numbers, guess, windows, self.weight, self.loose, _GUESS_ITERATIONS
        )[0]
        return settled[:, 0]

    def _predict_ahead(self, experiment: Experiment, record: Record, horizon: int) -> Trajectory:
        self.check_rows(experiment, horizon)
        # Short recordings have at least one prediction
        window = min(self.window, len(experiment) - horizon)
        first = window + horizon - 1
        outputs, physics = self._predict_windows(experiment, record, horizon, window)
        nothing = np.zeros_like(outputs)
        ahead = trajectory(Parts(outputs, nothing, nothing), experiment, experiment.outputs, first)
        known = np.full(experiment.outputs.shape, np.nan)
        known[first:] = np.where(np.isfinite(physics), physics, np.nan)
        learner = ahead.model - known
        return replace(
            ahead, baseline=known, learner=learner, learner_before=learner, whole=ahead.model
        )

    def _predict_windows(
        self, experiment: Experiment, record: Record, horizon: int, window: int
    ) -> tuple[Float[np.ndarray, "r ny"], Float[np.ndarray, "r ny"]]:
        """Return the outputs `horizon` steps after each window, of the model and by physics alone.

        The first row is `window + horizon - 1`.
        """
        steps = window + horizon
        inputs = self.form.inputs(experiment, record)
        run = self._follow(
            self.form, self.numbers, self._start(experiment, "measured", record), inputs
        )[0]
        begins = np.arange(len(inputs) - steps + 1)
        states = self.form.start(experiment.outputs, begins)
        hidden = [i for i, state in enumerate(self.form.motion.states) if state.from_output is None]
        with np.errstate(all="ignore"):
            known = np.isfinite(run[begins]).all(axis=1, keepdims=True)
        states[:, hidden] = np.where(known, run[begins], states)[:, hidden]
        length, pieces = padded_steps(steps), []  # few horizons have programs of their own
        for begin in range(0, len(begins), _SIDE_BY_SIDE):
            chosen = begins[begin : begin + _SIDE_BY_SIDE]
            padded = np.concatenate([chosen, np.repeat(chosen[-1:], _SIDE_BY_SIDE - len(chosen))])
            rows = np.minimum(padded[None, :] + np.arange(length)[:, None], len(inputs) - 1)
            following = np.moveaxis(inputs[rows], -1, 1)
            target = np.moveaxis(experiment.outputs[rows[:window]], -1, 1)
            windows = Windows(
                following[:window], target, np.ones((window, len(padded)), dtype=bool)
            )
            settled = settle(
                self.form,
                self.numbers,
                states[padded].T,
                windows,
                self.weight,
                self.loose,
                _WINDOW_ITERATIONS,
            )[0]
            ends = [(self.form, self.numbers)]
            ends += (
                [(self.physics_only.form, self.physics_only.numbers)] if self.form.learns else []
            )
            pieces.append(
                [
                    np.asarray(_last_output(*end, settled, following, steps)).T[: len(chosen)]
                    for end in ends
                ]
            )
        outputs, physics = (np.concatenate([piece[i] for piece in pieces]) for i in (0, -1))
        return outputs, physics


def _pad(rows: Matrix, size: int) -> Float[np.ndarray, "T n 1"]:
    return np.concatenate([rows, np.repeat(rows[-1:], size - len(rows), axis=0)])[..., None]
