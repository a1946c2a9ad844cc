"""The fitted model ŷ_k = φ(x_k)θ + (f(x_k) − φ(x_k)θ_aux): prediction, free run, parts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector, as_signal, check_count
from orthaug._base.errors import InputError
from orthaug._base.jax import Array, jax, jnp
from orthaug._base.views import NotebookView
from orthaug.data.record import Channel, Experiment, Preparation, Record
from orthaug.models.beyond import outside
from orthaug.models.dynamics import Dynamics, Numbers, Parts
from orthaug.models.filters import LaggedFilter
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.on_records import WITHIN, RecordModel, trajectory
from orthaug.models.response import Response, Trajectory
from orthaug.models.statistics import Statistics
from orthaug.models.stepping import Memory, checked_row, one_experiment, step_lagged
from orthaug.physics.baseline import Parameter
from orthaug.physics.noise import NoiseModel

_BATCH = 1024  # rows per compiled call: longer records share the program, of a free run too
_WINDOW_CELLS = 8_000_000  # input cells of a batch of multi-step predictions


@partial(jax.jit, static_argnames="form")
def _predict_rows(form: LaggedDynamics, numbers: Numbers, x: Float[Array, "m nx"]) -> Parts:
    return jax.vmap(lambda row: form.at(numbers, row))(x)


@partial(jax.jit, static_argnames="form")
def _free_run(
    form: Dynamics, numbers: Numbers, state: Float[Array, "n0"], inputs: Float[Array, "T nu"]
) -> tuple[Float[Array, "n0"], Parts]:
    """Return one scan over the rows, from the state at the first one.

    The state after the last row is the second result.
    """
    return jax.lax.scan(lambda state, row: form.step(numbers, state, row), state, inputs)


@partial(jax.jit, static_argnames="form")
def _last_outputs(
    form: Dynamics,
    numbers: Numbers,
    states: Float[Array, "m n0"],
    inputs: Float[Array, "m T nu"],
    added: Float[Array, "m T ny"] | None,
    horizon: Any,
) -> Parts:
    """Return the last of `horizon` free-run steps from each of m starts.

    What is `added` to an output is in the past of the steps after it.
    """
    side_by_side = jax.vmap(lambda state, row: form.step(numbers, state, row))

    def step(i: Any, carry: tuple[Any, Parts]) -> tuple[Any, Parts]:
        following, parts = side_by_side(carry[0], inputs[:, i])
        if added is not None:
            following = following.at[:, : len(form.outputs)].add(added[:, i])
        return following, parts

    nothing = jnp.zeros((states.shape[0], len(form.outputs)))
    return jax.lax.fori_loop(0, horizon, step, (states, Parts(nothing, nothing, nothing)))[1]


@dataclass(frozen=True, eq=False)
class Model(RecordModel, NotebookView):
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

    form: LaggedDynamics
    numbers: Numbers
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
    noise: NoiseModel | None = field(default=None, kw_only=True)
    """The model of the errors' colour, for predictions; None where nobody asked for one."""
    prepared: tuple[Preparation, ...] = field(default=(), kw_only=True, repr=False)
    """Preparation of the training data."""

    def __repr__(self) -> str:
        return (
            f"Model({self.structure}, θ: {', '.join(self.form.baseline.names) or 'none'}, "
            f"learner: {self.form.bound.learner})"
        )

    @property
    def theta(self) -> Vector:
        """θ̂ (nθ,)."""
        return np.asarray(self.numbers.theta)

    @property
    def estimated(self) -> tuple[Sequence[Parameter], Vector]:
        """The parameters and their values, as results list them."""
        return self.form.baseline.parameters, self.theta

    @property
    def physics_only(self) -> Model:
        """The model without its learner."""
        return replace(self, form=self.form.physics_only, numbers=self.numbers.physics_only)

    alone = physics_only
    """Earlier name of `physics_only`."""

    def learner_at(self, x: Float[np.ndarray, "M nx"]) -> Float[np.ndarray, "M ny"]:
        """Return f, before any split, at regressors of the form's layout, in the outputs' units.

        It is the learner itself, also beyond the range of its training, where the model holds the
        correction.
        """
        limits = self.numbers.limits
        if (
            limits is not None
            and outside(limits, self.form.features.evaluate(x, self.form.layout, np)).any()
        ):
            return replace(self, numbers=self.numbers.free).parts_at(x).raw
        return self.parts_at(x).raw

    @property
    def coloured(self) -> bool:
        """Whether a noise model forecasts errors."""
        return self.noise is not None and not self.noise.white

    @property
    def theta_aux(self) -> Vector:
        """θ_aux (nθ,), fixed after training."""
        return np.asarray(self.numbers.theta_aux)

    def components(self, record: Record) -> Response:
        """Return one-step prediction of every row in its parts, before and after projection."""
        return self.predict(record, horizon=1)

    def predict(self, record: Record, horizon: int = 1) -> Response:
        """Predict each row from outputs measured up to `horizon` samples before it.

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
            first = self.form.first_row + horizon - 1
            self.check_rows(experiment, first)
            if horizon == 1 or not self.form.states:
                parts = self.parts_at(self.form.regressors(experiment, record, first))
            else:
                parts = self._predict_ahead(experiment, record, horizon)
            found = trajectory(parts, experiment, experiment.outputs, first)
            if self.coloured:
                forecast = self._forecast(experiment, record, horizon)[:, -1]
                found = replace(found, whole=found.model.copy())
                found.model[first:] += forecast
            trajectories.append(found)
        return Response(tuple(trajectories), horizon, self.outputs, record.sampling_time)

    def simulate(self, record: Record, initial: str | Any = "measured") -> Response:
        """Simulate the free run from the first usable row on.

        Past outputs in the regressor are the model's own.

        Args:
            record: inputs, and outputs where they are measured.
            initial: the outputs on the rows before the first usable one: "measured" (from the
                record), "zero", or an array (rows, ny) that holds them.

        Raises:
            InputError: other channels, too few rows, or initial values that are not there.
        """
        record = self.fitting(record, need_outputs=False)
        trajectories = []
        for experiment in record.experiments:
            self.check_rows(experiment, self.form.first_row)
            measured = experiment.outputs if record.outputs else None
            start = self._start(initial, measured)
            parts = self.run_parts(start, self.form.inputs(experiment, record))
            trajectories.append(self.as_trajectory(start, parts, experiment, record))
        return Response(tuple(trajectories), None, self.outputs, record.sampling_time)

    def as_trajectory(
        self, start: Vector, parts: Parts, experiment: Experiment, record: Record
    ) -> Trajectory:
        """Return a free run from a state, cut where it left all bounds."""
        outside = self._outside(start, parts, experiment, record)
        return replace(
            self.bounded(parts, experiment, experiment.outputs if record.outputs else None),
            outside=outside,
        )

    @cached_property
    def memory(self) -> Memory:
        """Past samples that a step remembers."""
        return Memory.of(
            self.form.layout, self.form.outputs, [channel.name for channel in self.inputs]
        )

    @property
    def state_names(self) -> tuple[str, ...]:
        """The entries of a step's state: past outputs, then past inputs, `y[k-1]`."""
        return self.memory.names

    @property
    def step_inputs(self) -> tuple[str, ...]:
        """Inputs of a step: those at its sample."""
        return self.memory.inputs

    def start(self, record: Record, row: int | None = None) -> Vector:
        """Return the state before a row of a record of one experiment.

        By default it is the first row that has a prediction.

        Raises:
            InputError: other channels, several experiments, a row that is not there.
        """
        record = self.fitting(record, need_outputs=False)
        experiment = one_experiment(record)
        return self.memory.at(
            experiment, record, checked_row(row, self.form.first_row, len(experiment))
        )

    def step(self, state: Any, inputs: Any) -> tuple[Array, Array]:
        """Return one sample of a free run: the next state (n,) and the outputs (ny,).

        It starts from a state and the inputs (nu,).

        A pure function of JAX arrays, so that `jax.jit`, `jax.vmap` and `jax.grad` take it; to go
        on from a measured output, put that in the place of the model's own.
        """
        return step_lagged(self.form, self.numbers, self.memory, state, inputs)

    @property
    def filtering(self) -> tuple[LaggedFilter, Numbers, Vector]:
        """The model as a filter: its dynamics, its numbers, and the size of an unknown output."""
        return LaggedFilter(self.form, self.memory), self.numbers, self.deviation

    def check_initial(self, initial: Any) -> Matrix:
        """Return outputs before the first usable row, (rows, ny).

        Raises:
            InputError: too few rows, or not one column per output.
        """
        if isinstance(initial, str):
            raise InputError(f"`initial` must be 'measured', 'zero' or an array; got '{initial}'.")
        rows, ny = as_signal(initial, "initial"), len(self.outputs)
        if rows.shape[1] != ny:
            raise InputError(
                f"`initial` has {rows.shape[1]} columns; expected one per output, {ny}."
            )
        if len(rows) < self.form.memory:
            raise InputError(
                f"`initial` has {len(rows)} rows; expected the first {self.form.first_row} "
                "outputs of the record."
            )
        return rows

    def run_parts(self, state: Vector, inputs: Matrix) -> Parts:
        """Return the free run from a state along lagged inputs (T, nu), in parts."""
        if not self.form.states:
            return self.parts_at(inputs)
        pieces = []
        for begin in range(0, len(inputs), _BATCH):
            steps = min(_BATCH, len(inputs) - begin)
            padded = np.zeros((_BATCH, inputs.shape[1]))
            padded[:steps] = inputs[begin : begin + steps]
            state, parts = _free_run(self.form, self.numbers, state, padded)
            pieces.append([np.asarray(part)[:steps] for part in parts])
        return Parts(*(np.concatenate(piece) for piece in zip(*pieces, strict=True)))

    def parts_at(self, x: Matrix) -> Parts:
        """Return the prediction at measured regressors (T, nx), in parts."""
        return _in_batches(lambda rows: _predict_rows(self.form, self.numbers, rows), (x,))

    def _predict_ahead(self, experiment: Experiment, record: Record, horizon: int) -> Parts:
        first = self.form.first_row
        inputs = self.form.inputs(experiment, record)
        windows = np.lib.stride_tricks.sliding_window_view(inputs, horizon, axis=0).swapaxes(1, 2)
        states = self.form.start(experiment.outputs, np.arange(first, first + len(windows)))
        arrays: tuple[np.ndarray, ...] = (states, windows)
        if self.coloured:
            arrays = (*arrays, self._forecast(experiment, record, horizon))
        # Windows overlap: they are copied batch by batch
        largest = max(1, _WINDOW_CELLS // max(1, windows[0].size))
        return _in_batches(
            lambda s, u, added=None: _last_outputs(self.form, self.numbers, s, u, added, horizon),
            arrays,
            largest,
        )

    def _forecast(
        self, experiment: Experiment, record: Record, horizon: int
    ) -> Float[np.ndarray, "m h ny"]:
        """Return the noise model's forecasts on the way to every row that is predicted."""
        assert self.noise is not None
        measured = experiment.outputs[self.form.first_row :]
        errors = measured - self.parts_at(self.form.regressors(experiment, record)).total
        return self.noise.forecast_ahead(errors, horizon)

    def first_state(self, experiment: Experiment, record: Record) -> Vector:
        """Return the state at the first row of the free run from the measured outputs."""
        return self._start("measured", experiment.outputs)

    def _start(self, initial: Any, measured: Matrix | None) -> Vector:
        """Return the state at the first row with an output."""
        if isinstance(initial, str) and initial == "zero":
            return np.zeros(self.form.states)
        if isinstance(initial, str) and initial == "measured":
            if measured is None:
                raise InputError(
                    "the record has no measured outputs to start from; use initial='zero' or "
                    "give the values."
                )
            rows = measured[: self.form.first_row]
        else:
            rows = self.check_initial(initial)[: self.form.first_row]
        return self.form.start(rows, [len(rows)])[0]

    def _outside(self, start: Vector, parts: Parts, experiment: Experiment, record: Record) -> Any:
        """Return the rows of a free run where a feature is outside its training range, (N,)."""
        inputs = self.form.inputs(experiment, record)
        with np.errstate(all="ignore"):
            z = self.form.scaled_features(self.numbers, start, np.asarray(parts.total), inputs)
            if z is None:
                return None
            beyond = ~(np.abs(z) <= 1 + WITHIN).all(axis=1)
        return np.concatenate([np.zeros(self.form.first_row, dtype=bool), beyond])


def _in_batches(
    function: Callable[..., Parts], rows: tuple[np.ndarray, ...], largest: int = _BATCH
) -> Parts:
    """Call `function` on batches of rows, padded to one shape, and concatenate its results."""
    count = len(rows[0])
    size, pieces = min(_BATCH, largest), []
    for begin in range(0, count, size):
        batch = [array[begin : begin + size] for array in rows]
        padding = size - len(batch[0])
        padded = [
            np.concatenate([b, np.repeat(b[-1:], padding, axis=0)]) if padding else b for b in batch
        ]
        parts = function(*padded)
        pieces.append([np.asarray(part)[: size - padding] for part in parts])
    return Parts(*(np.concatenate(piece) for piece in zip(*pieces, strict=True)))
