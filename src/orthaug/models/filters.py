"""Fitted models as Kalman filters.

Noise disturbs the equation of a lagged model, and the rates of a motion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import AnyArray, Array, jax, jnp
from orthaug.data.record import Experiment, Record, without_gaps
from orthaug.models.dynamics import Numbers, Parts
from orthaug.models.kalman import (
    Filter,
    FilterRow,
    Noise,
    StateEstimate,
    correct,
    slope,
)
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.moving import MotionDynamics
from orthaug.models.stepping import Memory


@dataclass(frozen=True)
class LaggedFilter:
    """A lagged model without its numbers as a filter: `Filter`.

    Its state is what its regressor remembers.

    `y_k = g(x_k) + e_k` with Cov e = Q goes on in the lags, and `y_k + v_k` with Cov v = R is
    measured. With R = 0 the estimate of a measured output is what was measured, and the prediction
    that of `predict`.
    """

    form: LaggedDynamics
    memory: Memory

    hidden = False

    @property
    def first_row(self) -> int:
        return self.form.first_row

    @property
    def names(self) -> tuple[str, ...]:
        return self.memory.names

    @property
    def disturbances(self) -> int:
        return len(self.form.outputs)

    def inputs(self, experiment: Experiment, record: Record) -> Matrix:
        return experiment.inputs[self.first_row :]

    def start(
        self, experiment: Experiment, record: Record, row: int, noise: Noise, size: Vector
    ) -> StateEstimate:
        """Return the lags before a row and their covariance.

        Outputs have the sensors' noise, or are unknown by their `size` (ny,) where they are
        missing.
        """
        outputs, lags = list(self.form.outputs), self.memory.lags
        before = Experiment(experiment.inputs[:row], without_gaps(experiment.outputs[:row]))
        mean = self.memory.at(before, record, row)
        variance = np.zeros((len(lags), len(lags)))
        for i, lag in enumerate(lags):
            if lag.channel not in outputs:
                continue
            own = outputs.index(lag.channel)
            if not np.isfinite(experiment.outputs[row - lag.lag, own]):
                variance[i, i] = size[own] ** 2
                continue
            for j, other in enumerate(lags):
                if other.lag == lag.lag and other.channel in outputs:
                    there = np.isfinite(
                        experiment.outputs[row - lag.lag, outputs.index(other.channel)]
                    )
                    variance[i, j] = (
                        noise.output[own, outputs.index(other.channel)] if there else 0.0
                    )
        return StateEstimate(mean, variance)

    def step(self, numbers: Numbers, state: Array, inputs: Any) -> tuple[Any, Parts]:
        parts = self.form.at(numbers, jnp.concatenate([state, inputs])[self.memory.read])
        return jnp.concatenate([parts.total, inputs, state])[self.memory.following], parts

    def row(
        self, numbers: Numbers, noise: Noise, belief: StateEstimate, inputs: Array, measured: Array
    ) -> tuple[StateEstimate, FilterRow]:
        n, ny = len(self.memory.lags), len(self.form.outputs)
        value, derivative = slope(_joint_step(self, numbers, inputs), belief.state)
        enters = jnp.concatenate([jnp.asarray(self._newest), jnp.eye(ny)])
        covariance = derivative @ belief.covariance @ derivative.T + enters @ noise.state @ enters.T
        mean, after, spread, square, likelihood = correct(value, covariance, noise.output, measured)
        estimated = FilterRow(
            value[n:], spread, mean[n:], after[n:, n:], mean[:n], after[:n, :n], square, likelihood
        )
        return StateEstimate(estimated.state, estimated.state_covariance), estimated

    @property
    def _newest(self) -> Matrix:
        """Positions of the outputs in the next state, (n, ny)."""
        place = np.zeros((len(self.memory.lags), len(self.form.outputs)))
        for i, lag in enumerate(self.memory.lags):
            if lag.channel in self.form.outputs and lag.lag == 1:
                place[i, self.form.outputs.index(lag.channel)] = 1.0
        return place

    def unit(self, noise: Matrix, size: Vector) -> Matrix:
        """Return a disturbance (ny, ny) in proportion to the error of the outputs."""
        return noise

    def linearised(self, numbers: Numbers) -> tuple[Matrix, Matrix, Matrix, Matrix]:
        """Return A (n, n) and C (ny, n) at the origin, and the gains of a disturbance.

        The gains are those of the state (n, ny) and of the outputs (ny, ny).
        """
        slopes = _at_origin(self, numbers, np.zeros(len(self.memory.inputs)), len(self.memory.lags))
        return *slopes, self._newest, np.eye(len(self.form.outputs))


@dataclass(frozen=True)
class MotionFilter:
    """A motion without its numbers as a filter: `Filter`."""

    form: MotionDynamics

    first_row = 0
    hidden = True

    @property
    def names(self) -> tuple[str, ...]:
        return self.form.motion.names_of_states

    @property
    def disturbances(self) -> int:
        return self.form.states

    @property
    def physics_only(self) -> MotionFilter:
        """The filter of the motion without its learner."""
        return MotionFilter(self.form.physics_only)

    def inputs(self, experiment: Experiment, record: Record) -> Matrix:
        return self.form.inputs(experiment, record)

    def start(
        self, experiment: Experiment, record: Record, row: int, noise: Noise, size: Vector
    ) -> StateEstimate:
        """Return the state guessed from the samples about a row.

        It is unknown by the `size` (nx,) of all states.
        """
        return StateEstimate(
            self.form.start(without_gaps(experiment.outputs), [row])[0], np.diag(size**2)
        )

    def step(self, numbers: Numbers, state: Array, inputs: Any) -> tuple[Any, Parts]:
        return self.form.step(numbers, state, inputs)

    def row(
        self, numbers: Numbers, noise: Noise, belief: StateEstimate, inputs: Array, measured: Array
    ) -> tuple[StateEstimate, FilterRow]:
        n = self.form.states
        value, seen = slope(lambda x: self.step(numbers, x, inputs)[1].total, belief.state)
        both = jnp.concatenate([jnp.eye(n), seen])
        covariance = both @ belief.covariance @ both.T
        mean = jnp.concatenate([belief.state, value])
        mean, after, spread, square, likelihood = correct(mean, covariance, noise.output, measured)
        following, moved = slope(lambda x: self.step(numbers, x, inputs)[0], mean[:n])
        own = after[:n, :n]
        estimated = FilterRow(
            value, spread, mean[n:], after[n:, n:], mean[:n], own, square, likelihood
        )
        return StateEstimate(following, moved @ own @ moved.T + noise.state), estimated

    def unit(self, noise: Matrix, size: Vector) -> Matrix:
        """Return a disturbance (nx, nx) as large as the states.

        None where a rate is another state, or in a controller: that is exact.
        """
        motion, names = self.form.motion, self.names
        known = [
            state.name in motion.discrete_states
            or (state.derivative in names and not state.learned)
            for state in motion.states
        ]
        return np.diag(np.where(known, 0.0, size**2))

    def linearised(self, numbers: Numbers) -> tuple[Matrix, Matrix, Matrix, Matrix]:
        """Return A (nx, nx) and C (ny, nx) at the origin, and the gains of a disturbance.

        The gains are those of the state (nx, nx) and of the outputs (ny, nx).
        """
        n = self.form.states
        nothing = Experiment(
            np.zeros((4, len(self.form.motion.external))), np.zeros((4, len(self.form.outputs)))
        )
        inputs = np.zeros(self.form.inputs(nothing, None).shape[1])  # type: ignore[arg-type]
        return (
            *_at_origin(self, numbers, inputs, n),
            np.eye(n),
            np.zeros((len(self.form.outputs), n)),
        )


def _joint_step(form: Filter, numbers: Numbers, inputs: AnyArray) -> Callable[[Any], Any]:
    """Return the next state and the outputs as one function of the state."""

    def joint_step(state: Array) -> Array:
        following, parts = form.step(numbers, state, inputs)
        return jnp.concatenate([following, parts.total])

    return joint_step


def _at_origin(form: Filter, numbers: Numbers, inputs: Vector, n: int) -> tuple[Matrix, Matrix]:
    """Return A (n, n) and C (ny, n) at the origin."""
    both = _joint_step(form, numbers, inputs)
    derivative = np.asarray(jax.jit(lambda x: slope(both, x)[1])(np.zeros(n)))
    return derivative[:n], derivative[n:]
