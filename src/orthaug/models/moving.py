"""Equations of motion as dynamics: ẋ = f(x, u; c) + E g(z; w), y = h(x, u; c) + g(z; w), a sample at a time.

g is the learner on features z of states and inputs. Its values go to the learned equations first, then to the learned
outputs. The unknowns are the coordinates c of the physical parameters, and the weights.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import jax, jnp
from orthaug.data.expressions import Expression, Lag
from orthaug.data.record import Experiment, Record
from orthaug.models.dynamics import Differentiated, Numbers, Parts
from orthaug.models.integrators import advance, held
from orthaug.models.learners import Bound
from orthaug.physics.motion import Motion
from orthaug.physics.motion_layout import layout_of
from orthaug.physics.starts import guess


@dataclass(frozen=True)
class Moving(Differentiated):
    """What a motion with a learner computes, without its numbers: `Dynamics`.

    `features` are expressions of states and inputs; `substeps` the integrator's in a sample of `sampling_time` s.
    """

    motion: Motion
    features: tuple[Expression, ...]
    bound: Bound | None
    sampling_time: float
    substeps: int

    linear = False
    first_row = 0
    memory = 0

    @property
    def outputs(self) -> tuple[str, ...]:
        return tuple(output.name for output in self.motion.outputs)

    @property
    def differentiable(self) -> bool:
        return self.bound is None or self.bound.differentiable

    @property
    def states(self) -> int:
        return len(self.motion.states)

    @property
    def unknowns(self) -> int:
        return len(self.motion.parameters) + (self.bound.size if self.bound else 0)

    @property
    def used(self) -> tuple[Lag, ...]:
        """States and inputs, as measures name them."""
        return layout_of(self.motion)

    @property
    def alone(self) -> Moving:
        """The same motion without a learner."""
        return replace(self, features=(), bound=None)

    def start(self, outputs: Matrix, rows: Sequence[int] | Int[np.ndarray, "r"]) -> Float[np.ndarray, "r n0"]:
        """States as they are declared to start, by local polynomials through the measured outputs about the rows."""
        return guess(self.motion, outputs, rows, self.sampling_time)

    def start_rows(self, weight: Matrix) -> Matrix:
        """A start costs nothing: the outputs from there on tell it."""
        return np.zeros((self.states, self.states))

    def inputs(self, experiment: Experiment, record: Record) -> Matrix:
        return held(np.asarray(experiment.inputs), self.motion.hold, self.substeps)

    def now(self, inputs: Any) -> Any:
        """u (…, nu) at the sample itself, of the rows that steps read."""
        return inputs[..., : len(self.motion.inputs)]

    def describe(self, state: Vector, inputs: Vector) -> dict[str, float]:
        """States and inputs by name."""
        named = zip((*self.motion.names_of_states, *self.motion.inputs), (*state, *self.now(inputs)), strict=True)
        return {name: float(value) for name, value in named}

    def seen(self, x: Any, u: Any, xp: Any = jnp) -> Any:
        """The learner's features z (nz, …) of states (nx, …) and inputs (nu, …)."""
        values: Mapping[str, Any] = self.motion.values(x, u, self.motion.initial, xp)
        columns = [xp.asarray(entry.value(values, xp), dtype=float) for entry in self.features]
        return xp.stack([xp.broadcast_to(column, x.shape[1:]) for column in columns])

    def learned(self, numbers: Numbers, x: Any, u: Any) -> Any:
        """g (learned equations and outputs,) in their units, at one point."""
        assert self.bound is not None
        z = (self.seen(x, u) - numbers.centre) / numbers.halfwidth
        return numbers.gain * self.bound.values(numbers.weights, z)

    def rates(self, numbers: Numbers, x: Any, u: Any) -> tuple[Any, Any]:
        """The equations' right-hand sides of physics and learner, each (nx,)."""
        physics = self.motion.rates(x, u, self.parameters(numbers), jnp)
        learned = jnp.zeros(self.states)
        states, _ = self.motion.learned
        if self.bound is not None and states:
            learned = learned.at[np.array(states)].set(self.learned(numbers, x, u)[: len(states)])
        return physics, learned

    def observed(self, numbers: Numbers, x: Any, u: Any) -> Any:
        """y (ny,)."""
        y = self.motion.observed(x, u, self.parameters(numbers), jnp)
        states, outputs = self.motion.learned
        if self.bound is not None and outputs:
            y = y.at[np.array(outputs)].add(self.learned(numbers, x, u)[len(states) :])
        return y

    def parameters(self, numbers: Numbers) -> Any:
        """The physical parameters (np,) beside the learner, before any split."""
        return self.motion.coordinates.physical(numbers.theta - numbers.theta_aux, jnp)

    def step(self, numbers: Numbers, state: Any, inputs: Any) -> tuple[Any, Parts]:
        y = self.observed(numbers, state, self.now(inputs))
        parts = Parts(y, jnp.zeros_like(y), jnp.zeros_like(y))
        if self.motion.integrator == "discrete":
            return sum(self.rates(numbers, state, self.now(inputs))), parts

        def field(x: Any, u: Any) -> Any:
            physics, learned = self.rates(numbers, x, u)
            return physics + learned

        following = advance(
            field,
            self._linear_part(numbers) if self.motion.integrator == "exact" else None,
            state,
            inputs,
            len(self.motion.inputs),
            self.sampling_time,
            self.substeps,
            self.motion.integrator,
        )
        return following, parts

    def _linear_part(self, numbers: Numbers) -> Any:
        """∂f/∂x of the physics at the origin; 0 where it has none."""
        p, rest = self.parameters(numbers), jnp.zeros(len(self.motion.inputs))
        slope = jax.jacfwd(lambda x: self.motion.rates(x, rest, p, jnp))(jnp.zeros(self.states))
        return jnp.where(jnp.isfinite(slope), slope, 0.0)
