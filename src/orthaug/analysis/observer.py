"""Observer: the state of a fitted model from measurements, by an extended Kalman filter."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector, check_count, check_type
from orthaug._base.errors import InputError, show
from orthaug.analysis.observed import Observations, ObserverRun
from orthaug.analysis.observer_noise import by_verdict, most_likely, of_fit
from orthaug.data.record import Experiment, Record
from orthaug.fitting.estimates import Estimate
from orthaug.models.dynamics import Parts
from orthaug.models.kalman import (
    FilterRow,
    Noise,
    StateEstimate,
    one_row,
    predict_outputs,
    run_filter,
    spread_of,
)
from orthaug.models.model import Model
from orthaug.models.on_records import trajectory
from orthaug.models.response import BAND, Response, Trajectory
from orthaug.models.stepping import checked_row, one_experiment


@dataclass(frozen=True, eq=False)
class Observer:
    """An extended Kalman filter of a fitted model, lagged or a motion.

    Args:
        model: the model, or the fit: of a fit the residual determines how large the noises are
            (`diagnose`), and where both are there the likelihood of its data does; a model that
            `orthaug fit` saved carries them.
        noise: the covariances, where they are known better: of the disturbances in a sample, of the
            sensors.

    Raises:
        InputError: a model whose learner cannot be differentiated, or that has no estimate of its
            noise; covariances that are none, or of other sizes.
    """

    model: Any
    noise: Noise = field(default=None)  # type: ignore[assignment]  (made of the model)

    def __post_init__(self) -> None:
        check_type(
            self.model,
            Model | Estimate,
            "model",
            "a fitted model or a fit",
        )
        given, noise = self.model, self.noise
        fit = given if isinstance(given, Estimate) else None
        model: Any = given if fit is None else fit.model
        if not model.form.differentiable:
            raise InputError(
                "the learner is a function without derivatives; an observer needs them."
            )
        if noise is None:
            noise = by_verdict(model) if fit is None else of_fit(fit)
        object.__setattr__(self, "model", model)
        object.__setattr__(
            self, "noise", _check_noise(noise, model.filtering[0].disturbances, len(model.outputs))
        )

    def __repr__(self) -> str:
        return f"Observer({self.model!r})"

    def tuned(self, record: Record) -> Observer:
        """Return the observer with its noises scaled to be the most likely ones for a record.

        A noise that is zero stays so.

        Raises:
            InputError: other channels.
        """
        return replace(self, noise=most_likely(self.model, self.noise, record))

    def start(self, record: Record, row: int | None = None) -> ObserverState:
        """Return the state before a row of a record of one experiment.

        By default that is the first row that is estimated.

        A motion's state is guessed from the outputs about the row, and unknown by the size of the
        states.

        Raises:
            InputError: other channels, several experiments, a row that is not there.
        """
        form, _, size = self.model.filtering
        record = self._record(record)
        experiment = one_experiment(record)
        last = len(experiment) - form.hidden
        row = checked_row(row, form.first_row, last)
        return ObserverState(self, form.start(experiment, record, row, self.noise, size))

    def run(self, record: Record) -> Observations:
        """Return outputs and states along a record, each row estimated from measurements up to it.

        Raises:
            InputError: other channels, too few rows, or an estimate that leaves all bounds.
        """
        record = self._record(record)
        runs = tuple(self._run_along(experiment, record)[0] for experiment in record.experiments)
        form = self.model.filtering[0]
        names = form.names if form.hidden else ()
        return Observations(runs, self.model.outputs, names, record.sampling_time, self._start_rows)

    def predict(self, record: Record, horizon: int = 1) -> Response:
        """Return the prediction of each row from `horizon` samples before it, with its deviation.

        A motion's first rows, which determine its state, have no value, as in its `predict`.

        Raises:
            InputError: other channels, a horizon below 1, too few rows, or an estimate that leaves
                all bounds.
        """
        horizon = check_count(horizon, "horizon", of="steps")
        record = self._record(record)
        trajectories = [
            self._predict_ahead(experiment, record, horizon) for experiment in record.experiments
        ]
        return Response(tuple(trajectories), horizon, self.model.outputs, record.sampling_time)

    @property
    def _start_rows(self) -> int:
        """Rows that determine the start of an experiment."""
        form = self.model.filtering[0]
        return self.model.window if form.hidden else form.first_row

    def _record(self, record: Record) -> Record:
        return self.model.fitting(record, need_outputs=True, gaps=True)

    def _run_along(
        self, experiment: Experiment, record: Record
    ) -> tuple[ObserverRun, StateEstimate, Matrix]:
        """Return the observed run of an experiment, the predicted states, and the steps' inputs."""
        form, numbers, size = self.model.filtering
        first = form.first_row
        self.model.check_rows(experiment, first)
        begun = form.start(experiment, record, first, self.noise, size)
        inputs = form.inputs(experiment, record)
        before, rows = run_filter(
            form, numbers, self.noise, begun, inputs, experiment.outputs[first:]
        )
        finite = np.isfinite(rows.predicted).all(axis=1) & np.isfinite(before.state).all(axis=1)
        if not finite.all():
            raise InputError(
                f"{experiment.where(first + int(np.argmin(finite)))}: the estimate diverges "
                "there; the model does not fit this record, or the noise of the observer is "
                "wrong."
            )
        return _fill_unestimated(rows, experiment, first), before, inputs

    def _predict_ahead(self, experiment: Experiment, record: Record, horizon: int) -> Trajectory:
        form, numbers, _ = self.model.filtering
        first = max(form.first_row, min(self._start_rows, len(experiment) - horizon)) + horizon - 1
        self.model.check_rows(experiment, first)
        _, before, inputs = self._run_along(experiment, record)
        parts, std = predict_outputs(form, numbers, self.noise, before, inputs, horizon)
        if form.hidden:
            alone = self.model.physics_only.filtering
            known = parts
            if self.model.learns:
                known = predict_outputs(alone[0], alone[1], self.noise, before, inputs, horizon)[0]
            parts = Parts(known.total, parts.total - known.total, parts.total - known.total)
        skip = first - form.first_row - horizon + 1
        predicted = trajectory(
            Parts(*(part[skip:] for part in parts)), experiment, experiment.outputs, first
        )
        whole = np.full(experiment.outputs.shape, np.nan)
        whole[first:] = std[skip:]
        return replace(predicted, std=whole)


@dataclass(frozen=True, eq=False)
class ObserverState:
    """An observer at a sample; `update` gives that at the next one.

    Examples:
        >>> import numpy as np, orthaug as oa
        >>> u = np.sin(np.arange(200.0))
        >>> noise = 0.01 * np.random.default_rng(0).normal(size=200)
        >>> y = np.convolve(u, 0.5 ** np.arange(20))[:200] + noise
        >>> record = oa.Record.from_arrays(u, y)
        >>> baseline = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("b", "u[k]")])
        >>> now = oa.Observer(oa.estimate(record, baseline, learner=None)).start(record)
        >>> now = now.update([0.3], [np.nan])  # nothing was measured
        >>> low, high = now.outputs_band
        >>> bool((low < now.outputs).all() and (now.outputs < high).all())
        True
    """

    observer: Observer
    belief: StateEstimate
    """The state before the next sample and its covariance."""
    latest: FilterRow | None = None
    """The filter's row of the last sample; None before the first."""

    @property
    def state_names(self) -> tuple[str, ...]:
        return self.observer.model.state_names

    @property
    def state(self) -> Vector:
        """The state (n,) at the last sample of a motion.

        For a lagged model it is the state that the next step starts from.
        """
        return np.asarray(self.belief.state if self.latest is None else self.latest.state)

    @property
    def state_band(self) -> Matrix:
        """Its 95 % limits (2, n)."""
        covariance = self.belief.covariance if self.latest is None else self.latest.state_covariance
        return _band(self.state, covariance)

    @property
    def predicted(self) -> Vector:
        """Outputs (ny,) at the last sample, predicted from those before it."""
        return np.asarray(self._update.predicted)

    @property
    def predicted_band(self) -> Matrix:
        """The limits (2, ny) within which 95 % of measurements lie."""
        return _band(self.predicted, self._update.spread)

    @property
    def outputs(self) -> Vector:
        """The outputs (ny,) at the last sample, without the sensors' noise."""
        return np.asarray(self._update.outputs)

    @property
    def outputs_band(self) -> Matrix:
        """Their 95 % limits (2, ny)."""
        return _band(self.outputs, self._update.outputs_covariance)

    @property
    def square(self) -> float:
        """`νᵀS⁻¹ν` of the last sample: χ² with one degree of freedom per measured output."""
        return float(self._update.square)

    @property
    def _update(self) -> FilterRow:
        if self.latest is None:
            raise InputError("no sample has been measured yet; `update` first.")
        return self.latest

    def update(self, inputs: Any, outputs: Any) -> ObserverState:
        """Return one sample later.

        Args:
            inputs: those of the sample, as `model.step_inputs` lists them.
            outputs: what was measured (ny,); NaN where nothing was.

        Raises:
            InputError: other lengths, inputs that are not finite, infinite outputs, a spline hold.
        """
        model = self.observer.model
        row = _row(inputs, "inputs", len(model.step_inputs))
        measured = _row(outputs, "outputs", len(model.outputs), gaps=True)
        form, numbers, _ = model.filtering
        belief, latest = one_row(form, numbers, self.observer.noise, self.belief, row, measured)
        if not (np.isfinite(latest.predicted).all() and np.isfinite(belief.state).all()):
            raise InputError("the estimate diverges; the model does not fit here.")
        return replace(self, belief=belief, latest=latest)


def _band(mean: Vector, covariance: Any) -> Matrix:
    reach = BAND * spread_of(np.asarray(covariance))
    return np.stack([mean - reach, mean + reach])


def _row(values: object, name: str, count: int, *, gaps: bool = False) -> Vector:
    try:
        row = np.array(values, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"`{name}` must be a vector of numbers; got {show(values)}.") from None
    if row.shape != (count,):
        raise InputError(f"`{name}` must have {count} numbers; got the shape {row.shape}.")
    if np.isinf(row).any() or (not gaps and np.isnan(row).any()):
        raise InputError(
            f"`{name}` must be finite{' or NaN, where nothing was measured' if gaps else ''}; "
            f"got {row}."
        )
    return row


def _fill_unestimated(rows: FilterRow, experiment: Experiment, first: int) -> ObserverRun:
    """Return the run, with NaN before the first row that is estimated."""

    def pad_rows(values: Any) -> Any:
        return np.concatenate([np.full((first, *values.shape[1:]), np.nan), values])

    return ObserverRun(
        measured=experiment.outputs,
        predicted=pad_rows(rows.predicted),
        spread=pad_rows(rows.spread),
        outputs=pad_rows(rows.outputs),
        outputs_std=pad_rows(spread_of(rows.outputs_covariance)),
        states=pad_rows(rows.state),
        states_std=pad_rows(spread_of(rows.state_covariance)),
        square=pad_rows(rows.square),
        start=first,
        start_time=experiment.start_time,
    )


def _check_noise(noise: Any, disturbances: int, outputs: int) -> Noise:
    """Return two covariances; raises InputError for anything else."""
    sizes = {"state": disturbances, "output": outputs}
    if not isinstance(noise, Noise):
        raise InputError(
            f"`noise` must be an oa.Noise(state, output) of two covariances; got {show(noise)}."
        )
    parts = []
    for (name, size), given in zip(sizes.items(), noise, strict=True):
        try:
            matrix = np.array(given, dtype=float)
        except (TypeError, ValueError, OverflowError):
            raise InputError(f"`noise.{name}` is not a matrix of numbers.") from None
        if matrix.shape != (size, size):
            raise InputError(
                f"`noise.{name}` has the shape {matrix.shape}; expected ({size}, {size})."
            )
        largest = np.abs(matrix).max(initial=0.0)
        sound = np.isfinite(matrix).all() and np.allclose(
            matrix, matrix.T, rtol=0, atol=1e-9 * largest
        )
        if not sound or np.linalg.eigvalsh(matrix).min(initial=0.0) < -1e-9 * largest:
            raise InputError(
                f"`noise.{name}` is no covariance: it must be finite, symmetric, and not negative."
            )
        parts.append(matrix)
    if not parts[0].any() and not np.linalg.eigvalsh(parts[1]).min(initial=1.0) > 0:
        raise InputError(
            "`noise`: with no disturbance the sensors' covariance must be positive definite."
        )
    return Noise(*parts)
