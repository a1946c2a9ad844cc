"""Motions in innovations form: a gain K by which a predictor's states follow measured outputs.

With process noise the states of a rig are not those of a free run. The predictor in its steady
state is

    x̂_{k+1} = F(x̂_k, u_k) + K (y_k − h(x̂_k, u_k)),

with white innovations `e_k = y_k − h(x̂_k, u_k)`. K has an entry for each state and output and is
estimated with the parameters. It is in no equation at a point. No JAX.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug._base.jax import ArrayModule
from orthaug.physics.motion import Motion
from orthaug.physics.parameters import PhysicalParameter

_GAIN = "gain of {} by {}"  # no name of a parameter, which is an identifier


@dataclass(frozen=True)
class InnovationsForm(Motion):
    """A motion whose last parameters are K, row by row; `innovations_form` makes it."""

    @property
    def predicts(self) -> bool:
        return True

    @property
    def gains(self) -> int:
        """Number of entries of K."""
        return len(self.states) * len(self.outputs)

    @property
    def own(self) -> int:
        """Number of parameters of the motion itself."""
        return len(self.parameters) - self.gains

    @cached_property
    def _plant(self) -> Motion:
        return Motion(**{**self.declaration, "parameters": self.parameters[: self.own]})

    @property
    def plant(self) -> Motion:
        """The motion without K."""
        return self._plant

    def around(self, plant: Motion) -> Motion:
        return innovations_form(plant)

    def rates(self, x: Matrix, u: Matrix, p: Vector, xp: ArrayModule) -> Matrix:
        return self._plant.rates(x, u, p[: self.own], xp)

    def observed(self, x: Any, u: Any, p: Any, xp: ArrayModule) -> Any:
        return self._plant.observed(x, u, p[: self.own], xp)


def innovations_form(motion: Motion) -> InnovationsForm:
    """Return the motion with the gain of its predictor, 0 at first.

    Raises:
        InputError: a motion with a controller, or a learner with states of its own.
    """
    if motion.held:
        raise InputError(
            "noise of innovations has no controller: the predictor follows the measured outputs, "
            "in a loop as well. Leave `controller` out, and give the plant's own input."
        )
    if motion.memory:
        raise InputError(
            "noise of innovations has no learner with states of its own; give the learner "
            "`states` = 0, or write the state into the motion."
        )
    gains = tuple(
        PhysicalParameter(_GAIN.format(state.name, output.name), 0.0)
        for state in motion.states
        for output in motion.outputs
    )
    return InnovationsForm(**{**motion.declaration, "parameters": (*motion.parameters, *gains)})


@dataclass(frozen=True, eq=False)
class InnovationsModel:
    """The noise model of a motion: the gain K (nx, ny) of its predictor.

    `covariance` is that of K row by row, (nx ny, nx ny).
    """

    gain: Float[Any, "nx ny"]
    covariance: Matrix | None = None

    @property
    def white(self) -> bool:
        """True if the states follow no output: white noise on the sensor."""
        return not np.any(self.gain)

    @property
    def values(self) -> Vector:
        """K row by row (nx ny,)."""
        return np.ravel(self.gain)
