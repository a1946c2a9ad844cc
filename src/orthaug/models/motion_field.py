"""The field of a motion with a learner: ẋ = f(x, u; c) + E g(z; w), y = h(x, u; c) + g(z; w).

g is the learner on features z of states and inputs. Its values go to the learned equations first,
then to the learned outputs. The unknowns are the coordinates c of the physical parameters, and the
weights. `parts_at` returns what physics and learner add at many points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix
from orthaug._base.jax import AnyArray, Array, jax, jnp, padded_length
from orthaug.data.expressions import Expression
from orthaug.models.beyond import beyond_of, clip_to_range, remaining_factor
from orthaug.models.dynamics import Numbers
from orthaug.models.learners import Bound
from orthaug.physics.integrators import split_pace
from orthaug.physics.motion import Motion

_LARGE = 150  # operations in the expressions of a motion


@dataclass(frozen=True, eq=False)
class MotionField:
    """A motion with a learner at a point, without its numbers.

    `features` are expressions of states and inputs; `substeps` the integrator's in a sample of
    `sampling_time` s. Two are equal where one compiled program serves both.
    """

    motion: Motion
    features: tuple[Expression, ...]
    bound: Bound
    sampling_time: float
    substeps: int

    @cached_property
    def computation(self) -> tuple[Any, ...]:
        """What its computations depend on.

        Initial values, bounds and units are not among it: who changes them waits for no compiler.
        """
        motion, seen = self.motion, {name for entry in self.features for name in entry.names}
        given = {own.name: getattr(motion, own.name) for own in fields(motion) if own.compare}
        given["states"] = tuple(replace(state, unit="") for state in motion.states)
        given["parameters"] = motion.names, tuple(motion.coordinates.positive.tolist())
        if not seen <= set(motion.visible):  # features of parameters are those of the initial ones
            given["initial"] = tuple(motion.initial.tolist())
        own = self.features, self.bound, self.sampling_time, self.substeps
        return type(self), *own, type(motion), *given.items()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, MotionField) and self.computation == other.computation

    def __hash__(self) -> int:
        return hash(self.computation)

    @property
    def states(self) -> int:
        return len(self.motion.states)

    @property
    def large(self) -> bool:
        """True if its stages are compiled in a loop; one by one they take a minute."""
        return self.motion.size > _LARGE

    @property
    def learns(self) -> bool:
        """False where the physics is alone."""
        return self.bound.learns

    @property
    def corrected(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """States and outputs whose equations the learner is added to."""
        return self.motion.learned if self.learns else ((), ())

    @property
    def unknowns(self) -> int:
        return len(self.motion.parameters) + self.bound.size

    def now(self, inputs: AnyArray) -> AnyArray:
        """Return the record's inputs (…, external) at the sample, of the rows that steps read."""
        return inputs[..., : len(self.motion.external)]

    def split_pace(self, row: AnyArray) -> tuple[Any, Any]:
        """Return what a step reads of the inputs, and its length over the sampling time."""
        return split_pace(row, self.motion.hold, self.substeps, len(self.motion.external))

    def external(self, u: AnyArray) -> Any:
        """Return the record's inputs (external,) of all inputs u (nu,) at a point."""
        return u[len(self.motion.held) :]

    def inputs_at(self, numbers: Numbers, x: Array, row: Array) -> Any:
        """Return all inputs u (nu,) of a sample, those of a controller first, at one point."""
        motion, given = self.motion, self.now(row)
        if not motion.held:
            return given
        y = self.observed(numbers, x, jnp.concatenate([jnp.zeros(len(motion.held)), given]))
        control = motion.control(y, x, given, self.parameters(numbers), jnp)
        return jnp.concatenate([control, given])

    def seen(self, x: Any, u: Any, xp: Any = jnp) -> Any:
        """Return the learner's features z (nz, …) of states (nx, …) and inputs (nu, …)."""
        values: Mapping[str, Any] = self.motion.values(x, u, self.motion.initial, xp)
        columns = [xp.asarray(entry.value(values, xp), dtype=float) for entry in self.features]
        rows = [xp.broadcast_to(column, (1, *x.shape[1:])) for column in columns]
        return xp.concatenate([xp.zeros((0, *x.shape[1:])), *rows])

    def learned(self, numbers: Numbers, x: Array, u: Array) -> Array:
        """Return g (learned equations and outputs,) in their units, at one point.

        The point may be beyond the range of training.
        """
        return self._values(numbers, self.seen(x, u))

    def _values(self, numbers: Numbers, z: Any) -> Any:
        return numbers.gain * self.bound.values(
            numbers.weights, (z - numbers.centre) / numbers.halfwidth
        )

    @property
    def beyond(self) -> str:
        """Behaviour of the learner's correction beyond its training range."""
        return beyond_of(self.bound.learner, "fade")

    def addition(self, numbers: Numbers, x: Array, u: Array) -> Array:
        """Return the learner's addition to the physics at c, at one point.

        Learned equations come first, then outputs.

        Within the range of training it is g. Beyond it the physics at p̂ goes on, and what it left
        there at x̄ is held or fades: `f(x; p̂) − f(x; c) + a (f(x̄; c) − f(x̄; p̂) + g(z̄))`.
        """
        if numbers.limits is None:
            return self.learned(numbers, x, u)
        z = self.seen(x, u)
        inside = clip_to_range(numbers.limits, z)
        moved = numbers.pull @ (inside - z)
        share = remaining_factor(self.beyond, numbers.limits, z)
        x_in, u_in = x + moved[: len(x)], u + moved[len(x) :]
        split, own = (self.motion.coordinates.physical(q, jnp) for q in (numbers.theta, numbers.c))
        held_own, held_split, beyond_split, beyond_own = self._rows_at(
            (own, split, split, own), (x_in, x_in, x, x), (u_in, u_in, u, u), own
        )
        held = held_own - held_split + self._values(numbers, inside)
        beyond = beyond_split - beyond_own + share * held
        return jnp.where(jnp.all(inside == z), self._values(numbers, inside), beyond)

    def _rows_at(self, p: Any, x: Any, u: Any, own: Array) -> Any:
        """Return `learned_rows` at several parameters and points.

        The field of a source is in the program once, which takes half the time to compile.
        """
        if self.motion.source is not None:
            every = (jnp.stack(part) for part in (p, x, u))
            return jax.vmap(lambda p, x, u: self.learned_rows(p, x, u, own))(*every)
        return [self.learned_rows(*one, own) for one in zip(p, x, u, strict=True)]

    def learned_rows(self, p: Array, x: Array, u: Array, own: Array) -> Array:
        """Return the physics of the learned equations (nl,), then of the learned outputs.

        p are the parameters; `own` those of the mass matrix, if there is one.
        """
        states, outputs = (np.array(rows, dtype=int) for rows in self.motion.learned)
        rates = self.motion.mass.balance(self.motion.rates(x, u, p, jnp), x, own)
        return jnp.concatenate([rates[states], self.motion.observed(x, u, p, jnp)[outputs]])

    def rates(self, numbers: Numbers, x: Array, u: Array) -> tuple[Any, Any]:
        """Return the equations' right-hand sides of physics and learner, each (nx,)."""
        p = self.parameters(numbers)
        physics = self.motion.rates(x, u, p, jnp)
        states, _ = self.corrected
        if not states:
            return physics, jnp.zeros(self.states)
        return physics, self.rates_of(self.addition(numbers, x, u)[: len(states)], x, p)

    def rates_of(self, learned: Array, x: Array, p: Array) -> Any:
        """Return what ẋ (nx,) grows by where `learned` (nl,) is added to the learned equations."""
        rows = jnp.zeros(self.states).at[np.array(self.corrected[0])].set(learned)
        return self.motion.mass.rates(rows, x, p)

    def observed(self, numbers: Numbers, x: Array, u: Array) -> Array:
        """Return y (ny,)."""
        y = self.motion.observed(x, u, self.parameters(numbers), jnp)
        states, outputs = self.corrected
        if outputs:
            y = y.at[np.array(outputs)].add(self.addition(numbers, x, u)[len(states) :])
        return y

    def parameters(self, numbers: Numbers) -> Any:
        """Return the physical parameters (np,) beside the learner, before any split."""
        return self.motion.coordinates.physical(numbers.c, jnp)

    def linear_part(self, numbers: Numbers) -> Array:
        """Return ∂f/∂x of the physics at the origin; 0 where it has none."""
        p, rest = self.parameters(numbers), jnp.zeros(len(self.motion.inputs))
        slope = jax.jacfwd(lambda x: self.motion.rates(x, rest, p, jnp))(jnp.zeros(self.states))
        return jnp.where(jnp.isfinite(slope), slope, 0.0)


def inputs_along(
    form: MotionField, numbers: Numbers, x: Matrix, rows: Matrix
) -> Float[np.ndarray, "M nu"]:
    """Return all inputs at states (M, nx), from the rows (M, …) that steps read there."""
    if not form.motion.held:
        return np.asarray(form.now(rows))
    count = len(x)
    x, rows = (
        np.pad(part, ((0, padded_length(count) - count), (0, 0)), mode="edge") for part in (x, rows)
    )
    return np.asarray(_inputs(form, numbers, x, rows))[:count]


@partial(jax.jit, static_argnames="form")
def _inputs(form: MotionField, numbers: Numbers, x: Any, rows: Any) -> Float[Array, "m nu"]:
    return jax.vmap(lambda x, row: form.inputs_at(numbers, x, row))(x, rows)


def parts_at(form: MotionField, numbers: Numbers, x: Matrix, u: Matrix) -> tuple[Matrix, Matrix]:
    """Return the physics f(x, u; p̂) and the learner, each (M, nl).

    Learned equations come first, then learned outputs.

    Args:
        x: states (M, nx); `u` inputs (M, nu) at the same instants.
    """
    count = len(x)
    x, u = (
        np.pad(part, ((0, padded_length(count) - count), (0, 0)), mode="edge") for part in (x, u)
    )
    physics, learner = _parts(form, numbers, x, u)
    return np.asarray(physics)[:count], np.asarray(learner)[:count]


def labels_of(form: MotionField) -> tuple[tuple[str, str], ...]:
    """Return name and unit of each learned equation and output.

    For example `v` in m/s has a rate in m/s².
    """
    motion = form.motion
    states, outputs = motion.learned
    rates = []
    for i in states:
        state = motion.states[i]
        if force := motion.mass.label(i):
            rates.append(force)
            continue
        following = motion.scheme.discrete
        unit = state.unit if following else _rate(state.unit)
        rates.append((f"next {state.name}" if following else f"d{state.name}/dt", unit))
    return (*rates, *((motion.outputs[i].name, "") for i in outputs))


def _rate(unit: str) -> str:
    return unit and (f"{unit}²" if unit.endswith("/s") else f"{unit}/s")


@partial(jax.jit, static_argnames="form")
def _parts(
    form: MotionField, numbers: Numbers, x: Float[Array, "m nx"], u: Float[Array, "m nu"]
) -> tuple[Float[Array, "m nl"], Float[Array, "m nl"]]:
    own = form.motion.coordinates.physical(numbers.c, jnp)

    def physics(q: Any, x: Array, u: Array) -> Array:
        return form.learned_rows(form.motion.coordinates.physical(q, jnp), x, u, own)

    def at(x: Array, u: Array) -> tuple[Any, Any]:
        split = physics(numbers.theta, x, u)
        whole = physics(numbers.c, x, u)
        return split, whole - split + (form.addition(numbers, x, u) if form.learns else 0.0)

    return jax.vmap(at)(x, u)
