"""The state before a row of a record: past outputs, or an estimate from rows that were measured.

The past outputs of a lagged model are measured. A motion's state is not: it is estimated from the
first rows of the record or, for a prediction, from a window of rows before it, as the state from
which a free run over the window follows the measured outputs best.

In a free run of a loop the controller reads the model's outputs. A prediction starts from measured
rows, and until then the controller has read these, their noise included. So its states at a row
follow from the record, but for those at the first row, which the inputs it set determine where
they were measured.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from orthaug._base.checks import Matrix, Vector, as_signal
from orthaug._base.errors import InputError
from orthaug._base.jax import Array, jax, jnp
from orthaug._base.lines import plural
from orthaug.data.record import Experiment, Record
from orthaug.data.regressors import lag_rows
from orthaug.models.dynamics import Dynamics, Numbers, Parts, in_batches, last_outputs
from orthaug.models.filters import LaggedFilter, MotionFilter
from orthaug.models.kalman import Filter
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.moving import MotionDynamics
from orthaug.models.on_records import RecordModel
from orthaug.models.predictor import predictor_of
from orthaug.models.settling import LOOSE, MOST_LANES, Windows, padded_steps, settle
from orthaug.models.stepping import Memory, checked_row, step_inputs, with_scheme
from orthaug.physics.innovations import InnovationsModel
from orthaug.physics.noise import NoiseModel

_ITERATIONS = 5  # Gauss-Newton; a controller without limits ends after one
_PRIOR = 1e-9  # of a state at the first row that the inputs do not show, beside its own column

FIRST_ROWS = 64  # from which the start of a free run is estimated
_SIDE_BY_SIDE = 256  # windows of predictions
_BLOCKS = 20  # of a long record, of which not every row is predicted
_WINDOW_CELLS = 8_000_000  # input cells of a batch of multi-step predictions
_GUESS_ITERATIONS = 30
# Iterations of a window, and the decrease that ends it: within 0.0003 of the state's own noise
_UNTIL = (6, 1e-7)
_LOST = 4.0  # times the usual misfit: the start of a window may be wrong
_KNOWN = 1e-9  # times how far a state may be from its guess, where that is known


class Predicted(NamedTuple):
    """Outputs from a row on: of the model, and of physics alone where that is a run of its own."""

    first: int
    parts: Parts
    physics: Matrix | None = None
    forecast: Matrix | None = None
    """Errors that a noise model expects there."""
    chosen: Bool[np.ndarray, "m"] | None = None
    """The rows with a prediction, where some are left out to save time; NaN elsewhere."""


@runtime_checkable
class Starts(Protocol):
    """Origin of the state of a run."""

    def rows(self, form: Any) -> int:
        """Return how many rows of measured outputs determine a state."""
        ...

    def filtering(self, model: RecordModel) -> tuple[Filter, Numbers, Vector]:
        """Return the model a sample at a time, its numbers, and the size of an unknown state."""
        ...

    def step_inputs(self, model: RecordModel) -> tuple[str, ...]:
        """Return the names of a step's inputs.

        Raises:
            InputError: a hold that needs the whole record.
        """
        ...

    def check_initial(self, model: RecordModel, initial: Any) -> Matrix:
        """Return outputs that determine the start of a free run, (rows, ny).

        Raises:
            InputError: too few rows, or not one column per output.
        """
        ...

    def first(
        self, model: RecordModel, experiment: Experiment, record: Record, initial: str | Any
    ) -> Vector:
        """Return the state at the first row of a free run.

        Raises:
            InputError: initial values that are not there.
        """
        ...

    def at(
        self, model: RecordModel, experiment: Experiment, record: Record, row: int | None
    ) -> Vector:
        """Return the state before a row, as a filter has it.

        Raises:
            InputError: a row that is not there.
        """
        ...

    def predict(
        self, model: RecordModel, experiment: Experiment, record: Record, horizon: int
    ) -> Predicted:
        """Return the outputs `horizon` samples after the last measured ones.

        Raises:
            InputError: too few rows.
        """
        ...

    def points(self, model: RecordModel, record: Record) -> Matrix:
        """Return where the physics is evaluated on a record, (N, nx)."""
        ...


def _check_outputs(initial: Any, outputs: int) -> Matrix:
    """Return given outputs, (rows, ny).

    Raises:
        InputError: another word, or not one column per output.
    """
    if isinstance(initial, str):
        raise InputError(f"`initial` must be 'measured', 'zero' or an array; got '{initial}'.")
    rows = as_signal(initial, "initial")
    if rows.shape[1] != outputs:
        raise InputError(
            f"`initial` has {rows.shape[1]} columns; expected one per output, {outputs}."
        )
    return rows


def _outputs_of(
    starts: Starts, model: RecordModel, experiment: Experiment, record: Record, initial: Any
) -> Matrix | None:
    """Return the outputs that determine the start of a free run; None for a state of zeros."""
    if isinstance(initial, str) and initial == "zero":
        return None
    if not (isinstance(initial, str) and initial == "measured"):
        return starts.check_initial(model, initial)
    if not record.outputs:
        raise InputError(
            "the record has no measured outputs to start from; use initial='zero' or give the "
            "values."
        )
    return experiment.outputs


@dataclass(frozen=True)
class PastOutputs:
    """The state is past outputs, as they were measured: `Starts` of a lagged model."""

    def rows(self, form: LaggedDynamics) -> int:
        return form.first_row

    def filtering(self, model: RecordModel[LaggedDynamics]) -> tuple[Filter, Numbers, Vector]:
        return LaggedFilter(model.form, self.memory(model)), model.numbers, model.deviation

    def step_inputs(self, model: RecordModel[LaggedDynamics]) -> tuple[str, ...]:
        return self.memory(model).inputs

    def memory(self, model: RecordModel[LaggedDynamics]) -> Memory:
        """Return the past samples that a step remembers."""
        return Memory.of(model.form.layout, model.form.outputs, [c.name for c in model.inputs])

    def check_initial(self, model: RecordModel[LaggedDynamics], initial: Any) -> Matrix:
        """Return outputs before the first usable row, (rows, ny).

        Raises:
            InputError: too few rows, or not one column per output.
        """
        rows = _check_outputs(initial, len(model.outputs))
        if len(rows) < model.form.memory:
            raise InputError(
                f"`initial` has {plural(len(rows), 'row')}; expected the outputs of the "
                f"{plural(model.form.first_row, 'row')} before the first usable one, or of at "
                f"least the last {model.form.memory} of them."
            )
        return rows

    def first(
        self,
        model: RecordModel[LaggedDynamics],
        experiment: Experiment,
        record: Record,
        initial: str | Any,
    ) -> Vector:
        outputs = _outputs_of(self, model, experiment, record, initial)
        if outputs is None:
            return np.zeros(model.form.states)
        rows = outputs[: model.form.first_row]
        return model.form.start(rows, [len(rows)])[0]

    def at(
        self,
        model: RecordModel[LaggedDynamics],
        experiment: Experiment,
        record: Record,
        row: int | None,
    ) -> Vector:
        row = checked_row(row, model.form.first_row, len(experiment))
        return self.memory(model).at(experiment, record, row)

    def predict(
        self,
        model: RecordModel[LaggedDynamics],
        experiment: Experiment,
        record: Record,
        horizon: int,
    ) -> Predicted:
        form = model.form
        first = form.first_row + horizon - 1
        model.check_rows(experiment, first)
        expected = self._forecast(model, experiment, record, horizon)
        last = None if expected is None else expected[:, -1]
        if horizon == 1 or not form.states:
            x = form.regressors(experiment, record, first)
            return Predicted(first, form.parts_at(model.numbers, x), None, last)
        inputs = form.inputs(experiment, record)
        windows = np.lib.stride_tricks.sliding_window_view(inputs, horizon, axis=0)  # (m, nu, T)
        states = form.start(experiment.outputs, form.first_row + np.arange(len(windows)))
        added = () if expected is None else (expected,)
        parts = _last_of(form, model.numbers, states, windows, *added)
        return Predicted(first, parts, None, last)

    @staticmethod
    def _forecast(
        model: RecordModel[LaggedDynamics], experiment: Experiment, record: Record, horizon: int
    ) -> Float[np.ndarray, "m h ny"] | None:
        """Return the noise model's forecasts on the way to every row; None for white noise."""
        if not model.coloured or not isinstance(model.noise, NoiseModel):
            return None
        measured = experiment.outputs[model.form.first_row :]
        x = model.form.regressors(experiment, record)
        errors = measured - model.form.parts_at(model.numbers, x).total
        return model.noise.forecast_ahead(errors, horizon)

    def points(self, model: RecordModel[LaggedDynamics], record: Record) -> Matrix:
        """Return the measured regressors of all rows that have one."""
        return lag_rows(record, model.form.layout)


def _spread(rows: int, most: int | None) -> Bool[np.ndarray, "m"] | None:
    """Return which rows are in blocks spread over all; None where these are not too many."""
    if most is None or rows <= most:
        return None
    size = max(most // _BLOCKS, 1)
    chosen = np.zeros(rows, dtype=bool)
    for first in np.linspace(0, rows - size, most // size).round().astype(int):
        chosen[first : first + size] = True
    return chosen


def _unchosen_left_out(values: Matrix, chosen: Bool[np.ndarray, "m"]) -> Matrix:
    """Return values of chosen rows as values of all, NaN elsewhere."""
    found = np.full((len(chosen), values.shape[1]), np.nan)
    found[chosen] = values
    return found


@dataclass(frozen=True, eq=False)
class EstimatedStates:
    """The state is estimated over a window of measured rows: `Starts` of a motion.

    `window` rows give a state to predict from, `loose` (nx,) is how far one may be from its guess.
    """

    window: int
    loose: Vector
    most: int | None = None
    """Rows of an experiment that are predicted at most, in blocks spread over it; None for all."""

    def rows(self, form: MotionDynamics) -> int:
        return self.window

    def filtering(self, model: RecordModel[MotionDynamics]) -> tuple[Filter, Numbers, Vector]:
        numbers = with_scheme(model.form, model.numbers)
        return MotionFilter(model.form), numbers, np.asarray(self.loose) / LOOSE

    def step_inputs(self, model: RecordModel[MotionDynamics]) -> tuple[str, ...]:
        return step_inputs(model.form)

    def check_initial(self, model: RecordModel[MotionDynamics], initial: Any) -> Matrix:
        """Return outputs of the first rows (rows, ny).

        Raises:
            InputError: no rows, or not one column per output.
        """
        return _check_outputs(initial, len(model.outputs))

    def first(
        self,
        model: RecordModel[MotionDynamics],
        experiment: Experiment,
        record: Record,
        initial: str | Any,
    ) -> Vector:
        form, size = model.form, max(FIRST_ROWS, self.window)
        rows = _outputs_of(self, model, experiment, record, initial)
        if rows is None:
            return np.zeros(form.states)
        rows = rows[:size]
        inputs = form.inputs(experiment, record)[: len(rows)]
        return self._settled(model, form, model.numbers, inputs, rows[: len(inputs)])

    def at(
        self,
        model: RecordModel[MotionDynamics],
        experiment: Experiment,
        record: Record,
        row: int | None,
    ) -> Vector:
        row = checked_row(row, 0, len(experiment) - 1)
        state = self.first(model, experiment, record, "measured")
        if not row:
            return state
        return model.form.run(model.numbers, state, model.form.inputs(experiment, record)).states[
            row
        ]

    def predict(
        self,
        model: RecordModel[MotionDynamics],
        experiment: Experiment,
        record: Record,
        horizon: int,
    ) -> Predicted:
        model.check_rows(experiment, horizon)
        if model.coloured:
            return self._follow(model, experiment, record, horizon)
        # Short recordings have at least one prediction
        window = min(self.window, len(experiment) - horizon)
        begins = np.arange(len(experiment) - (window + horizon) + 1)
        ends: list[tuple[Any, Numbers]] = [(model.form, model.numbers)]
        if model.learns:
            alone = model.physics_only
            ends.append((alone.form, alone.numbers))
        first, chosen = window + horizon - 1, _spread(len(begins), self.most)
        if chosen is not None:
            begins = begins[chosen]
        outputs = self._ahead(model, experiment, record, (window, horizon), begins, ends)
        if chosen is not None:
            outputs = [_unchosen_left_out(own, chosen) for own in outputs]
        nothing = np.where(np.isnan(outputs[0]), np.nan, 0.0)
        return Predicted(first, Parts(outputs[0], nothing, nothing), outputs[-1], chosen=chosen)

    def errors(
        self,
        model: RecordModel[MotionDynamics],
        experiment: Experiment,
        record: Record,
        rows: Vector,
    ) -> Matrix:
        """Return the errors (m, ny) of one-step predictions of some rows, none before a window.

        They are NaN where no output was measured.
        """
        window, own = self.window, [(model.form, model.numbers)]
        (outputs,) = self._ahead(model, experiment, record, (window, 1), rows - window, own)
        return experiment.outputs[rows] - outputs

    def _ahead(
        self,
        model: RecordModel[MotionDynamics],
        experiment: Experiment,
        record: Record,
        rows: tuple[int, int],
        begins: Vector,
        ends: Sequence[tuple[Any, Numbers]],
    ) -> list[Matrix]:
        """Return predictions (m, ny) of the `ends` from the states of windows.

        Args:
            rows: of a window, and the horizon behind it.
            begins: the first rows of windows.
            ends: forms and numbers of models that run from there.
        """
        (window, horizon), form, numbers = rows, model.form, model.numbers
        steps = window + horizon
        inputs = form.inputs(experiment, record)
        states, free = self._begin(model, experiment, record, begins)
        sampled = form.motion.discrete_states  # a controller's states follow from the record
        known = np.array([name in sampled for name in form.motion.names_of_states])
        loose = np.where(known, self.loose * _KNOWN, self.loose)
        length = padded_steps(steps)  # few horizons have programs of their own

        def along(lanes: Vector) -> Vector:
            """Return the rows (T, m) of windows."""
            return np.minimum(begins[lanes] + np.arange(length)[:, None], len(inputs) - 1)

        def settle_from(guesses: Matrix, chosen: Vector) -> tuple[Matrix, Vector]:
            lanes = _fill(chosen, MOST_LANES)
            own, begin = along(lanes)[:window], guesses[lanes].T
            windows = Windows(
                np.moveaxis(inputs[own], -1, 1),
                np.moveaxis(experiment.outputs[own], -1, 1),
                np.ones(own.shape, dtype=bool),
            )
            found, misfit = settle(form, numbers, begin, windows, model.weight, loose, *_UNTIL)
            return found.T[: len(chosen)], misfit[: len(chosen)]

        every = np.arange(len(begins))
        settled, misfit = states.copy(), np.empty(len(begins))
        again: list[Vector] = []
        for chosen in _batches(every):
            settled[chosen], own = settle_from(states, chosen)
            misfit[chosen], usual = own, np.median(own)
            # A derivative of a noisy output can be so wrong that the run from it leaves. Where one
            # does, others end beside the best start, too
            again += [chosen[own > usual]] if (own > _LOST * usual).any() else []
        for chosen in _batches(np.concatenate(again)) if again else ():
            found, other = settle_from(free, chosen)
            better = other < misfit[chosen]
            settled[chosen[better]] = found[better]
        pieces = []
        for chosen in _batches(every):
            lanes = _fill(chosen, _SIDE_BY_SIDE)
            following, begin = np.moveaxis(inputs[along(lanes)], -1, 1), settled[lanes].T
            outputs = [last_outputs(*end, begin, following, steps).total for end in ends]
            pieces.append([np.asarray(own).T[: len(chosen)] for own in outputs])
        return [np.concatenate(piece) for piece in zip(*pieces, strict=True)]

    def _follow(
        self,
        model: RecordModel[MotionDynamics],
        experiment: Experiment,
        record: Record,
        horizon: int,
    ) -> Predicted:
        """Return predictions from the states of the one-step predictor, as `predict`."""
        window = min(self.window, len(experiment) - horizon)
        form = predictor_of(model.form)
        assert isinstance(model.noise, InnovationsModel)
        rows, numbers = form.inputs(experiment, record), model.numbers
        numbers = numbers._replace(correction=model.noise.gain)
        start = self._settled(model, form, numbers, rows, experiment.outputs[:window])
        ends: list[tuple[Any, Numbers]] = [(form, numbers)]
        if form.learns:
            alone = numbers.physics_only._replace(correction=model.noise.gain)
            ends.append((form.physics_only, alone))
        outputs = []
        for corrected, own in ends:
            states = corrected.run(own, start, rows).states[window : len(rows) - horizon + 1]
            plain, inputs = corrected.plain, corrected.plain.inputs(experiment, record)[window:]
            windows = np.lib.stride_tricks.sliding_window_view(inputs, horizon, axis=0)
            outputs.append(_last_of(plain, own, states, windows).total)
        nothing = np.zeros_like(outputs[0])
        return Predicted(window + horizon - 1, Parts(outputs[0], nothing, nothing), outputs[-1])

    def _settled(
        self,
        model: RecordModel[MotionDynamics],
        form: MotionDynamics,
        numbers: Numbers,
        inputs: Matrix,
        outputs: Matrix,
    ) -> Vector:
        """Return the state at the first row by which a run follows the first outputs best."""
        size = max(FIRST_ROWS, self.window)
        windows = Windows(
            _pad(inputs[: len(outputs)], size),
            _pad(outputs, size),
            (np.arange(size) < len(outputs))[:, None],
        )
        guess = form.start(outputs, [0]).T
        settled = settle(
            form, numbers, guess, windows, model.weight, self.loose, _GUESS_ITERATIONS
        )[0]
        return settled[:, 0]

    def _begin(
        self,
        model: RecordModel[MotionDynamics],
        experiment: Experiment,
        record: Record,
        rows: Vector,
    ) -> tuple[Matrix, Matrix]:
        """Return guesses of the states at some rows, and those of the free run.

        Hidden ones are the free run's; a controller's follow from the record.
        """
        form = model.form
        inputs = form.inputs(experiment, record)
        start = self.first(model, experiment, record, "measured")
        free = form.run(model.numbers, start, inputs).states
        if form.motion.discrete_states:
            free = along_measured(form, model.numbers, free, inputs, experiment.outputs)
        run, states = free[rows], form.start(experiment.outputs, rows)
        sampled = form.motion.discrete_states
        hidden = [
            i
            for i, state in enumerate(form.motion.states)
            if state.from_output is None or state.name in sampled
        ]
        with np.errstate(all="ignore"):
            known = np.isfinite(run).all(axis=1, keepdims=True)
        states[:, hidden] = np.where(known, run, states)[:, hidden]
        return states, np.where(known, run, states)

    def points(self, model: RecordModel[MotionDynamics], record: Record) -> Matrix:
        """Return the finite states and inputs (N, nx + nu) of the free run."""
        record = model.fitting(record, need_outputs=False)
        form, pieces = model.form, []
        for experiment in record.experiments:
            rows = form.inputs(experiment, record)
            start = self.first(model, experiment, record, "measured")
            states = form.run(model.numbers, start, rows).states
            pieces.append(
                np.concatenate([states, form.at_samples(model.numbers, states, rows)], axis=1)
            )
        points = np.concatenate(pieces)
        return points[np.isfinite(points).all(axis=1)]


def _fill(chosen: Vector, lanes: int) -> Vector:
    """Return the choice with its last one repeated to a multiple of `lanes`: few shapes occur."""
    return np.pad(chosen, (0, -len(chosen) % lanes), mode="edge")


def _batches(rows: Vector) -> Iterator[Vector]:
    for first in range(0, len(rows), _SIDE_BY_SIDE):
        yield rows[first : first + _SIDE_BY_SIDE]


def _last_of(
    form: Dynamics,
    numbers: Numbers,
    states: Matrix,
    windows: Float[np.ndarray, "m nu T"],
    *expected: Float[np.ndarray, "m T ny"],
) -> Parts:
    """Return the outputs (m, ny) at the ends of runs from states (m, n0) along windows.

    The errors `expected` on the way are added to the outputs.
    """

    def ahead(states: Matrix, windows: np.ndarray, added: np.ndarray | None = None) -> Parts:
        found = last_outputs(
            form,
            numbers,
            states.T,
            np.moveaxis(windows, (0, 2), (2, 0)),
            windows.shape[2],
            None if added is None else np.moveaxis(added, 0, -1),
        )
        return Parts(*(np.asarray(part).T for part in found))

    largest = max(1, _WINDOW_CELLS // max(1, windows[0].size))
    return in_batches(ahead, (states, windows, *expected), largest)


def _pad(rows: Matrix, size: int) -> Float[np.ndarray, "T n 1"]:
    return np.concatenate([rows, np.repeat(rows[-1:], size - len(rows), axis=0)])[..., None]


def along_measured(
    form: MotionDynamics, numbers: Numbers, run: Matrix, inputs: Matrix, outputs: Matrix
) -> Float[np.ndarray, "N nx"]:
    """Return states of a free run (N, nx) with the controller's along measured outputs (N, ny).

    Args:
        run: (N, nx) states of the free run, whose first row begins; where an output is missing,
            the controller has read the run's.
        inputs: (N, …) rows that steps read.
    """
    own = _positions(form)
    first = np.asarray(run[0])[own]
    held = [form.outputs.index(name) for name in form.motion.held if name in form.outputs]
    target = outputs[:, held]
    if held and np.isfinite(target).any():
        for _ in range(_ITERATIONS):
            _, found, slope = _follow(form, numbers, first, run, inputs, outputs)
            step = _least_squares(np.asarray(slope)[:, held], target - np.asarray(found)[:, held])
            first = first + step
            if np.all(np.abs(step) <= 1e-9 * (1 + np.abs(first))):
                break
    states = np.array(run)
    states[:, own] = np.asarray(_follow(form, numbers, first, run, inputs, outputs)[0])
    return states


def _positions(form: MotionDynamics) -> list[int]:
    names = form.motion.discrete_states
    return [i for i, name in enumerate(form.motion.names_of_states) if name in names]


def _least_squares(slope: Float[np.ndarray, "N m nd"], missed: Float[np.ndarray, "N m"]) -> Vector:
    """Return the step by which the inputs that were set follow, 0 along what they do not show."""
    rows, right = slope.reshape(-1, slope.shape[-1]), missed.ravel()
    sound = np.isfinite(rows).all(axis=1) & np.isfinite(right)
    rows, right = rows[sound], right[sound]
    matrix = rows.T @ rows
    weak = _PRIOR * np.trace(matrix) + np.finfo(float).tiny
    return np.linalg.solve(matrix + weak * np.eye(len(matrix)), rows.T @ right)


@partial(jax.jit, static_argnames="form")
def _follow(
    form: MotionDynamics,
    numbers: Numbers,
    first: Float[Array, "nd"],
    run: Float[Array, "N nx"],
    inputs: Float[Array, "N m"],
    outputs: Float[Array, "N ny"],
) -> tuple[Array, Array, Array]:
    """Return the states (N, nd), all outputs (N, ny) with the inputs set, and their slopes."""
    numbers, motion = form.prepare(numbers), form.motion
    own = np.array(_positions(form))
    p = form.parameters(numbers)

    def along(first: Array) -> tuple[Array, Array]:
        def step(state: Array, row: tuple[Array, Array, Array]) -> tuple[Any, Any]:
            x, given, measured = row
            x = x.at[own].set(state)
            now = form.inputs_at(numbers, x, given)
            model = form.observed(numbers, x, now)
            y = jnp.where(jnp.isfinite(measured), measured, model)
            u = form.now(given)
            control = motion.control(y, x, u, p, jnp)
            now = jnp.concatenate([control, u])
            following = motion.after_sample(x, y, x, now, p, jnp)
            return following[own], (state, form.observed(numbers, x, now))

        return jax.lax.scan(step, first, (run, inputs, outputs))[1]

    (states, set_inputs), slope = along(first), jax.jacfwd(lambda x: along(x)[1])(first)
    return states, set_inputs, slope
