"""Equations of motion as dynamics, a sample at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import jax, jnp
from orthaug.data.expressions import Lag
from orthaug.data.record import Experiment, Record
from orthaug.models.dynamics import AutodiffDynamics, Local, Numbers, Parts
from orthaug.models.integrators import UNROLLED, Exponentials, advance, held
from orthaug.models.motion_field import MotionField
from orthaug.models.motion_tangents import output_slopes, sample_slopes
from orthaug.physics.motion_problem import guess, layout_of


@dataclass(frozen=True)
class MotionDynamics(MotionField, AutodiffDynamics):
    """A motion with a learner as dynamics, without its numbers: `Dynamics`."""

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
    def used(self) -> tuple[Lag, ...]:
        """States and inputs, as measures name them."""
        return layout_of(self.motion)

    @property
    def alone(self) -> MotionDynamics:
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

    def describe(self, state: Vector, inputs: Vector) -> dict[str, float]:
        """States and inputs by name."""
        named = zip((*self.motion.names_of_states, *self.motion.inputs), (*state, *self.now(inputs)), strict=True)
        return {name: float(value) for name, value in named}

    def step(self, numbers: Numbers, state: Any, inputs: Any) -> tuple[Any, Parts]:
        return _step(self, numbers, state, inputs)

    def _stepped(self, numbers: Numbers, state: Any, inputs: Any) -> tuple[Any, Parts]:
        y = self.observed(numbers, state, self.now(inputs))
        parts = Parts(y, jnp.zeros_like(y), jnp.zeros_like(y))
        if self.motion.integrator == "discrete":
            return sum(self.rates(numbers, state, self.now(inputs))), parts

        following = advance(
            partial(_field, self, numbers),
            self.exponentials(numbers) if numbers.scheme is None else numbers.scheme[0],
            state,
            inputs,
            len(self.motion.inputs),
            self.sampling_time,
            self.substeps,
            self.motion.integrator,
        )
        return following, parts

    def prepared(self, numbers: Numbers) -> Numbers:
        """With the exponentials of an exact integrator and their derivatives by the coordinates of p."""
        if self.motion.integrator != "exact":
            return numbers

        def of(theta: Any) -> Any:
            return self.exponentials(numbers._replace(theta=theta))

        theta = jnp.asarray(numbers.theta)
        return numbers._replace(scheme=(of(theta), jax.jacfwd(of)(theta)))

    def exponentials(self, numbers: Numbers) -> Exponentials | None:
        """Of the linear part over a substep; None where the integrator needs none."""
        if self.motion.integrator != "exact":
            return None
        return Exponentials.of(self.linear_part(numbers), self.sampling_time / self.substeps)

    @property
    def _by_stages(self) -> bool:
        return self.motion.integrator == "rk4" and self.substeps <= UNROLLED and self.differentiable

    def tangents(self, numbers: Numbers, state: Any, slopes: Any, inputs: Any) -> tuple[Any, Any, Any, Any]:
        return self.local(numbers, state, inputs).along(slopes, fused=self._by_stages)

    def local(self, numbers: Numbers, states: Any, inputs: Any) -> Local:
        """Of a few Runge-Kutta substeps by the adjoint of their stages; otherwise by automatic differentiation."""
        if numbers.scheme is not None:
            value, to_state, to_unknowns = super().local(numbers, states, inputs)
            return Local(value, to_state, to_unknowns + self._by_scheme(numbers, states, inputs))
        if not self._by_stages or numbers.limits is not None:
            return super().local(numbers, states, inputs)
        following = jax.vmap(partial(sample_slopes, self, numbers), -1, -1)(states, inputs)
        output = jax.vmap(lambda x, row: output_slopes(self, numbers, x, self.now(row)), -1, -1)(states, inputs)
        known = 4 if self.bound is not None else 3  # there are no weights otherwise
        value, to_x, *own = (jnp.concatenate(both) for both in zip(following[:known], output[:known], strict=True))
        return Local(value, to_x, jnp.concatenate(own, axis=1))

    def _by_scheme(self, numbers: Numbers, state: Any, inputs: Any) -> Any:
        """How states and outputs (n0 + ny, n, r) follow p through the exponentials, which a step takes as given."""
        scheme, by_theta = numbers.scheme

        def following(scheme: Any, state: Any, row: Any) -> Any:
            return self.step(numbers._replace(scheme=(scheme, None)), state, row)[0]

        def along(moved: Any) -> Any:
            return jax.vmap(lambda x, row: jax.jvp(lambda s: following(s, x, row), (scheme,), (moved,))[1], -1, -1)(
                state, inputs
            )

        moved = jax.vmap(along, -1, 1)(by_theta)  # a tangent for each parameter: (nx, np, m)
        after = self.unknowns - moved.shape[1]
        return jnp.pad(moved, ((0, len(self.outputs)), (0, after), (0, 0)))


@partial(jax.jit, static_argnames="form")
def _step(form: MotionDynamics, numbers: Numbers, state: Any, inputs: Any) -> tuple[Any, Parts]:
    """A step. It is traced once, whatever programs it stands in; so is the field in it."""
    return form._stepped(numbers, state, inputs)


@partial(jax.jit, static_argnames="form")
def _field(form: MotionDynamics, numbers: Numbers, x: Any, u: Any) -> Any:
    return sum(form.rates(numbers, x, u))
