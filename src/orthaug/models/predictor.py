"""The one-step predictor of a motion as dynamics: a step that its measured outputs correct.

A step reads a row of inputs with the measured outputs behind them, and adds `K (y − ŷ)` to the next
states. An output that is missing there, NaN, corrects nothing. K is among the unknowns, or it is
given with the numbers (`Numbers.correction`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix
from orthaug._base.jax import Array, jnp
from orthaug.data.record import Experiment, Record
from orthaug.models.dynamics import Local, Numbers, Parts
from orthaug.models.moving import MotionDynamics
from orthaug.physics.innovations import InnovationsForm
from orthaug.physics.motion import Motion


@dataclass(frozen=True, eq=False)
class PredictorDynamics(MotionDynamics):
    """The predictor of a motion, in innovations form or with a gain that is given."""

    @cached_property
    def plain(self) -> MotionDynamics:
        return MotionDynamics(
            self.motion.plant, self.features, self.bound, self.sampling_time, self.substeps
        )

    @property
    def _gains(self) -> int:
        """Entries of K among the unknowns."""
        return self.motion.gains if isinstance(self.motion, InnovationsForm) else 0

    def _own(self, numbers: Numbers) -> Numbers:
        """Return the numbers of the motion itself."""
        if not self._gains:
            return numbers
        own = len(self.motion.parameters) - self._gains
        return numbers._replace(theta=numbers.theta[:own], theta_aux=numbers.theta_aux[:own])

    def gain(self, numbers: Numbers) -> Float[Array, "nx ny"]:
        """Return K."""
        if not self._gains:
            return jnp.asarray(numbers.correction)
        c = numbers.c
        own = len(self.motion.parameters) - self._gains
        return jnp.reshape(c[own:], (self.states, len(self.outputs)))

    def inputs(self, experiment: Experiment, record: Record) -> Matrix:
        record.check_even("a noise model of a motion")
        return np.concatenate([super().inputs(experiment, record), experiment.outputs], axis=1)

    def prepare(self, numbers: Numbers) -> Numbers:
        return numbers._replace(scheme=self.plain.prepare(self._own(numbers)).scheme)

    def step(self, numbers: Numbers, state: Any, inputs: Any) -> tuple[Any, Parts]:
        ny = len(self.outputs)
        following, parts = self.plain.step(self._own(numbers), state, inputs[:-ny])
        missed = _missed(inputs[-ny:], parts.total)
        return following + _times(self.gain(numbers), missed), parts

    def local(self, numbers: Numbers, states: Array, inputs: Array) -> Local:
        """Return the slopes of the motion's own step, corrected: ∂x⁺ − K ∂ŷ, and e by K."""
        n0, ny = self.states, len(self.outputs)
        value, to_state, to_own = self.plain.local(self._own(numbers), states, inputs[:-ny])
        gain, measured = self.gain(numbers), inputs[-ny:]
        there = jnp.isfinite(measured)
        missed = _missed(measured, value[n0:])

        def corrected(slopes: Array) -> Array:
            moved = jnp.where(there[:, None], slopes[n0:], 0.0)
            own = slopes[:n0] - _times(gain, moved)
            return jnp.concatenate([own, slopes[n0:]])

        to_own = corrected(to_own)
        if self._gains:
            by_gain = jnp.eye(n0)[:, :, None, None] * missed[None, None]  # (n0, n0, ny, r)
            by_gain = by_gain.reshape(n0, n0 * ny, -1)
            by_gain = jnp.pad(by_gain, ((0, ny), (0, 0), (0, 0)))
            own = to_own.shape[1] - self.bound.size
            to_own = jnp.concatenate([to_own[:, :own], by_gain, to_own[:, own:]], axis=1)
        value = jnp.concatenate([value[:n0] + _times(gain, missed), value[n0:]])
        return Local(value, corrected(to_state), to_own)


def _times(gain: Any, outputs: Any) -> Any:
    """Return K times what outputs have, (ny, …), as sums: no small matrix product by lane."""
    beside = (None,) * (outputs.ndim - 1)
    return sum(gain[:, o][(slice(None), *beside)] * outputs[o] for o in range(len(outputs)))


def _missed(measured: Any, model: Any) -> Any:
    """Return the innovations, 0 where an output is missing."""
    return jnp.where(jnp.isfinite(measured), measured - model, 0.0)


def dynamics_of(motion: Motion, *args: Any) -> MotionDynamics:
    """Return the dynamics of a motion, or its predictor of one in innovations form."""
    kind = PredictorDynamics if isinstance(motion, InnovationsForm) else MotionDynamics
    return kind(motion, *args)


def predictor_of(form: MotionDynamics) -> PredictorDynamics:
    """Return the predictor of dynamics, with a gain that is given with the numbers."""
    own = (form.features, form.bound, form.sampling_time, form.substeps)
    return PredictorDynamics(form.motion.plant, *own)
