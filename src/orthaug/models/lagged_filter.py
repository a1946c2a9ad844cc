"""The filter of a lagged model: its state is what its regressor remembers, its disturbance the noise in its equation.

`y_k = g(x_k) + e_k` with Cov e = Q goes on in the lags, and `y_k + v_k` with Cov v = R is measured. With R = 0 the
estimate of a measured output is what was measured, and the prediction that of `predict`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import jax, jnp
from orthaug.data.record import Experiment, Record
from orthaug.models.dynamics import Numbers, Parts
from orthaug.models.kalman import Belief, Noise, Told, corrected, slope, without_gaps
from orthaug.models.lagged import Lagged
from orthaug.models.stepping import Memory


@dataclass(frozen=True)
class LaggedFilter:
    """A lagged model without its numbers as a filter: `Filter`."""

    form: Lagged
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

    def start(self, experiment: Experiment, record: Record, row: int, noise: Noise, size: Vector) -> Belief:
        """The lags before a row: outputs with the sensors' noise, or unknown by their `size` (ny,) where missing."""
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
                    there = np.isfinite(experiment.outputs[row - lag.lag, outputs.index(other.channel)])
                    variance[i, j] = noise.output[own, outputs.index(other.channel)] if there else 0.0
        return Belief(mean, variance)

    def step(self, numbers: Numbers, state: Any, inputs: Any) -> tuple[Any, Parts]:
        parts = self.form.at(numbers, jnp.concatenate([state, inputs])[self.memory.read])
        return jnp.concatenate([parts.total, inputs, state])[self.memory.following], parts

    def row(self, numbers: Numbers, noise: Noise, belief: Belief, inputs: Any, measured: Any) -> tuple[Belief, Told]:
        n, ny = len(self.memory.lags), len(self.form.outputs)

        def both(state: Any) -> Any:
            following, parts = self.step(numbers, state, inputs)
            return jnp.concatenate([following, parts.total])

        value, derivative = slope(both, belief.state)
        enters = jnp.concatenate([jnp.asarray(self._newest), jnp.eye(ny)])
        covariance = derivative @ belief.covariance @ derivative.T + enters @ noise.state @ enters.T
        mean, after, spread, square, likelihood = corrected(value, covariance, noise.output, measured)
        told = Told(value[n:], spread, mean[n:], after[n:, n:], mean[:n], after[:n, :n], square, likelihood)
        return Belief(told.state, told.state_covariance), told

    @property
    def _newest(self) -> Matrix:
        """Where an output goes in the next state, (n, ny)."""
        place = np.zeros((len(self.memory.lags), len(self.form.outputs)))
        for i, lag in enumerate(self.memory.lags):
            if lag.channel in self.form.outputs and lag.lag == 1:
                place[i, self.form.outputs.index(lag.channel)] = 1.0
        return place

    def unit(self, noise: Matrix, size: Vector) -> Matrix:
        """A disturbance (ny, ny) in proportion to the error of the outputs."""
        return noise

    def linearised(self, numbers: Numbers) -> tuple[Matrix, Matrix, Matrix, Matrix]:
        """A (n, n), C (ny, n) at the origin, and how a disturbance enters state (n, ny) and outputs (ny, ny)."""
        n = len(self.memory.lags)
        inputs = np.zeros(len(self.memory.inputs))

        def both(state: Any) -> Any:
            following, parts = self.step(numbers, state, inputs)
            return jnp.concatenate([following, parts.total])

        derivative = np.asarray(jax.jit(lambda x: slope(both, x)[1])(np.zeros(n)))
        return derivative[:n], derivative[n:], self._newest, np.eye(len(self.form.outputs))
