"""The filter of a motion: disturbances in the rates of its states, noise on its outputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import jax, jnp
from orthaug.data.record import Experiment, Record
from orthaug.models.dynamics import Numbers, Parts
from orthaug.models.kalman import Belief, Noise, Told, corrected, slope, without_gaps
from orthaug.models.moving import Moving


@dataclass(frozen=True)
class MotionFilter:
    """A motion without its numbers as a filter: `Filter`."""

    form: Moving

    first_row = 0
    hidden = True

    @property
    def names(self) -> tuple[str, ...]:
        return self.form.motion.names_of_states

    @property
    def disturbances(self) -> int:
        return self.form.states

    @property
    def alone(self) -> MotionFilter:
        """That of the motion without its learner."""
        return MotionFilter(self.form.alone)

    def inputs(self, experiment: Experiment, record: Record) -> Matrix:
        return self.form.inputs(experiment, record)

    def start(self, experiment: Experiment, record: Record, row: int, noise: Noise, size: Vector) -> Belief:
        """The state as it is guessed from what is measured about a row, unknown by the `size` (nx,) of all."""
        return Belief(self.form.start(without_gaps(experiment.outputs), [row])[0], np.diag(size**2))

    def step(self, numbers: Numbers, state: Any, inputs: Any) -> tuple[Any, Parts]:
        return self.form.step(numbers, state, inputs)

    def row(self, numbers: Numbers, noise: Noise, belief: Belief, inputs: Any, measured: Any) -> tuple[Belief, Told]:
        n = self.form.states
        value, seen = slope(lambda x: self.step(numbers, x, inputs)[1].total, belief.state)
        both = jnp.concatenate([jnp.eye(n), seen])
        covariance = both @ belief.covariance @ both.T
        mean = jnp.concatenate([belief.state, value])
        mean, after, spread, square, likelihood = corrected(mean, covariance, noise.output, measured)
        following, moved = slope(lambda x: self.step(numbers, x, inputs)[0], mean[:n])
        own = after[:n, :n]
        told = Told(value, spread, mean[n:], after[n:, n:], mean[:n], own, square, likelihood)
        return Belief(following, moved @ own @ moved.T + noise.state), told

    def unit(self, noise: Matrix, size: Vector) -> Matrix:
        """A disturbance (nx, nx) as large as the states; none where a rate is another state: that is exact."""
        known = [state.derivative in self.names and not state.learned for state in self.form.motion.states]
        return np.diag(np.where(known, 0.0, size**2))

    def linearised(self, numbers: Numbers) -> tuple[Matrix, Matrix, Matrix, Matrix]:
        """A (nx, nx), C (ny, nx) at the origin, and how a disturbance enters state (nx, nx) and outputs (ny, nx)."""
        n = self.form.states
        inputs = np.zeros(self.form.inputs(_nothing(self.form), None).shape[1])  # type: ignore[arg-type]

        def both(state: Any) -> Any:
            following, parts = self.step(numbers, state, inputs)
            return jnp.concatenate([following, parts.total])

        derivative = np.asarray(jax.jit(lambda x: slope(both, x)[1])(np.zeros(n)))
        return derivative[:n], derivative[n:], np.eye(n), np.zeros((len(self.form.outputs), n))


def _nothing(form: Moving) -> Experiment:
    """Four rows of inputs that are zero."""
    return Experiment(np.zeros((4, len(form.motion.inputs))), np.zeros((4, len(form.outputs))))
