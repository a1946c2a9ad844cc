"""Equations of motion as dynamics, a sample at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import Array, jax, jnp
from orthaug.data.expressions import Expression, Lag
from orthaug.data.record import Experiment, Record
from orthaug.models.dynamics import (
    BATCH,
    AutodiffDynamics,
    Local,
    Numbers,
    Parts,
    Run,
    free_run,
)
from orthaug.models.learners import nothing_learned
from orthaug.models.motion_field import MotionField, inputs_along, parts_at
from orthaug.physics.guessed_motion import guess, layout_of
from orthaug.physics.integrators import (
    UNROLLED,
    Exponentials,
    advance,
    input_at,
    inputs_at_points,
)
from orthaug.physics.motion import Motion
from orthaug.physics.parameters import Coordinates

_FEW = 8  # states and parameters; programs of more are slow to compile


class Slopes(NamedTuple):
    """Value of a map from (x, c, w), and ∂/∂x, ∂/∂c, ∂/∂w."""

    value: Any
    to_x: Array
    to_c: Any
    to_w: Array


def sample_slopes(form: MotionField, numbers: Numbers, state: Array, row: Array) -> Slopes:
    """Return x one sample later with its slopes, at one state (nx,) and input row, under `rk4`."""
    row, pace = form.split_pace(row)
    at, halves = input_at(row, len(form.motion.inputs)), 2 * form.substeps
    h, identity = pace * form.sampling_time / form.substeps, jnp.eye(form.states)
    inputs = [[at(2 * j + i, halves) for i in (0, 1, 1, 2)] for j in range(form.substeps)]

    def substep(x: Array, u: Any) -> tuple[Array, list[tuple[Array, Slopes]]]:
        first, second, third, fourth = stages = _stage_slopes(form, numbers, x, u, h)
        x = x + h / 6 * (first.value + 2 * (second.value + third.value) + fourth.value)
        psi4 = h / 6 * identity
        psi3 = h / 3 * identity + h * psi4 @ fourth.to_x
        psi2 = h / 3 * identity + h / 2 * psi3 @ third.to_x
        psi1 = h / 6 * identity + h / 2 * psi2 @ second.to_x
        return x, list(zip((psi1, psi2, psi3, psi4), stages, strict=True))

    through, x = [], state
    if form.large and form.substeps > 1:
        x, every = jax.lax.scan(substep, x, jnp.array(inputs))
        through = [jax.tree.map(lambda part, j=j: part[j], every) for j in range(form.substeps)]
    else:
        for u in inputs:
            x, stages = substep(x, u)
            through.append(stages)
    to_x, to_c, to_w = identity, 0.0, jnp.zeros((form.states, form.bound.size))
    learned = np.array(form.corrected[0], dtype=int)
    for stages in reversed(through):  # `to_x` is what follows this substep
        to_c = to_c + to_x @ sum(psi @ stage.to_c for psi, stage in stages)
        if learned.size:
            to_w = to_w + sum((to_x @ psi)[:, learned] @ stage.to_w for psi, stage in stages)
        to_x = to_x @ (identity + sum(psi @ stage.to_x for psi, stage in stages))
    return Slopes(x, to_x, to_c, to_w)


def _stage_slopes(form: MotionField, numbers: Numbers, x: Array, u: Any, h: Any) -> list[Slopes]:
    """Return F and its slopes at the four stages of a substep, with their inputs.

    A large F is written once into a program.
    """
    shares = (0.0, h / 2, h / 2, h)
    if form.large:

        def stage(before: Array, given: tuple[Array, Array]) -> tuple[Array, Slopes]:
            share, inputs = given
            found = field_slopes(form, numbers, x + share * before, inputs)
            return found.value, found

        given = (jnp.stack([jnp.asarray(share, dtype=float) for share in shares]), jnp.stack(u))
        every = jax.lax.scan(stage, jnp.zeros_like(x), given)[1]
        return [jax.tree.map(lambda part, i=i: part[i], every) for i in range(4)]
    found: list[Slopes] = []
    for share, inputs in zip(shares, u, strict=True):
        moved = x + share * found[-1].value if found else x
        found.append(field_slopes(form, numbers, moved, inputs))
    return found


@partial(jax.jit, static_argnames="form")  # for the stages of all substeps it is traced once
def field_slopes(form: MotionField, numbers: Numbers, x: Array, u: Array) -> Slopes:
    """Return F and its slopes at one point.

    ∂/∂w is that of the learned equations only, (nl, nw).
    """
    c = numbers.c
    coordinates = form.motion.coordinates

    def physics(x: Array, c: Array) -> Array:
        return form.motion.rates(x, u, coordinates.physical(c, jnp), jnp)

    value, to_x, to_c = _differentiate(physics, x, c, form.motion)
    to_x, to_c = _finite(to_x), _finite(to_c)
    states, _ = form.corrected
    if not states:
        return Slopes(value, to_x, to_c, jnp.zeros((len(states), form.unknowns - len(c))))
    learner = learner_slopes(form, numbers, x, u)
    rows = np.array(states)
    count = len(states)
    value = value.at[rows].add(learner.value[:count])
    return Slopes(value, to_x.at[rows].add(learner.to_x[:count]), to_c, learner.to_w[:count])


def learner_slopes(form: MotionField, numbers: Numbers, x: Array, u: Array) -> Slopes:
    """Return g and its slopes at one point: learned equations first, then learned outputs."""
    bound = form.bound

    def features(x: Array) -> Any:
        return (form.seen(x, u) - numbers.centre) / numbers.halfwidth

    z, to_z = features(x), _finite(jax.jacfwd(features)(x))
    value, pull = jax.vjp(
        lambda leaves, z: bound.from_leaves(leaves, z), bound.leaves(numbers.weights), z
    )
    gain = jnp.broadcast_to(jnp.asarray(numbers.gain), (bound.ny,))
    pulled = [pull(row) for row in jnp.diag(gain)]
    to_w = jnp.stack(
        [jnp.concatenate([jnp.ravel(leaf) for leaf in leaves]) for leaves, _ in pulled]
    )
    to_x = jnp.stack([of_z @ to_z for _, of_z in pulled])
    return Slopes(gain * value, _finite(to_x), jnp.zeros((bound.ny, 0)), _finite(to_w))


def output_slopes(form: MotionField, numbers: Numbers, x: Array, u: Any) -> Slopes:
    """Return y and its slopes at one point."""
    c = numbers.c

    def physics(x: Array, c: Array) -> Array:
        return form.motion.observed(x, u, form.motion.coordinates.physical(c, jnp), jnp)

    value, to_x, to_c = _differentiate(physics, x, c, form.motion)
    to_w = jnp.zeros((len(value), form.unknowns - len(c)))
    states, outputs = form.corrected
    if outputs:
        learner, rows, count = learner_slopes(form, numbers, x, u), np.array(outputs), len(states)
        value = value.at[rows].add(learner.value[count:])
        to_x = to_x.at[rows].add(learner.to_x[count:])
        to_w = to_w.at[rows].set(learner.to_w[count:])
    return Slopes(value, _finite(to_x), _finite(to_c), to_w)


def _differentiate(function: Any, x: Array, c: Any, motion: Motion) -> tuple[Any, Any, Any]:
    """Return the value and its slopes by x and c.

    Few entries are differentiated one at a time, without what an entry does not touch. A source
    has all slopes at once.
    """
    if motion.source is not None:

        def twice(x: Array, c: Array) -> tuple[Array, Array]:
            value = function(x, c)
            return value, value

        (to_x, to_c), value = jax.jacfwd(twice, (0, 1), has_aux=True)(x, c)
        return value, to_x, to_c
    entries, n0 = [*x, *c], len(x)
    if len(entries) > _FEW:
        return function(x, c), *jax.jacfwd(function, (0, 1))(x, c)

    def along(i: int) -> Array:
        def of(entry: Array) -> Any:
            moved = [*entries[:i], entry, *entries[i + 1 :]]
            return function(jnp.stack(moved[:n0]), jnp.stack(moved[n0:]))

        return jax.jvp(of, (entries[i],), (jnp.ones_like(entries[i]),))[1]

    slopes = [along(i) for i in range(len(entries))]
    return function(x, c), jnp.stack(slopes[:n0], axis=-1), jnp.stack(slopes[n0:], axis=-1)


def _finite(slope: Array) -> Array:
    """Return slopes with 0 for a derivative that does not exist, as of sqrt(max(x, 0)) at 0."""
    return jnp.where(jnp.isfinite(slope), slope, 0.0)


_FEWER = 128  # rows per compiled call, where each calls the host


@dataclass(frozen=True)
class MotionDynamics(MotionField, AutodiffDynamics):
    """A motion with a learner as dynamics, without its numbers: `Dynamics`."""

    linear = False
    separates = False
    steps_unevenly = True
    takes_gaps = True
    first_row = 0
    memory = 0

    @property
    def entries(self) -> tuple[Expression, ...]:
        """Expressions that the learner sees."""
        return self.features

    @property
    def coordinates(self) -> Coordinates:
        """The parameters and the map from their coordinates."""
        return self.motion.coordinates

    @property
    def outputs(self) -> tuple[str, ...]:
        return tuple(output.name for output in self.motion.outputs)

    @property
    def differentiable(self) -> bool:
        return self.bound.differentiable

    @property
    def used(self) -> tuple[Lag, ...]:
        """States and inputs, as measures name them."""
        return layout_of(self.motion)

    @property
    def plain(self) -> MotionDynamics:
        """These dynamics as a free run, which no measured output corrects."""
        return self

    @property
    def physics_only(self) -> MotionDynamics:
        """These dynamics without the learner."""
        return replace(self, features=(), bound=nothing_learned())

    def start(
        self, outputs: Matrix, rows: Sequence[int] | Int[np.ndarray, "r"]
    ) -> Float[np.ndarray, "r n0"]:
        """Return the states as declared to start.

        Local polynomials through the measured outputs about the rows determine them.
        """
        return guess(self.motion, outputs, rows, self.sampling_time)

    def start_rows(self, weight: Matrix) -> Matrix:
        """Return zero weights: a start costs nothing, for the outputs after it determine it."""
        return np.zeros((self.states, self.states))

    def inputs(self, experiment: Experiment, record: Record) -> Matrix:
        inputs, motion = np.asarray(experiment.inputs), self.motion
        if record is None or record.even:
            return inputs_at_points(inputs, motion.hold, self.substeps)
        motion.check_paced(record)
        if experiment.steps is None:
            record.check_even("this analysis")
        steps = np.asarray(experiment.steps)
        return inputs_at_points(inputs, motion.hold, self.substeps, steps / self.sampling_time)

    def at_samples(self, numbers: Numbers, states: Matrix, inputs: Matrix) -> Matrix:
        return inputs_along(self, numbers, states, inputs)

    def features_at(self, states: Matrix, inputs: Matrix) -> Float[np.ndarray, "T nz"]:
        return np.asarray(self.seen(states.T, inputs.T, np)).T

    @property
    def state_names(self) -> tuple[str, ...]:
        return self.motion.names_of_states

    @property
    def calls_host(self) -> bool:
        source = self.motion.source
        return source is not None and not source.compiled

    def run(self, numbers: Numbers, start: Vector, inputs: Matrix) -> Run:
        return free_run(self, numbers, start, inputs, _FEWER if self.calls_host else BATCH)

    def learned_along(
        self, numbers: Numbers, run: Run, inputs: Matrix
    ) -> Iterator[tuple[str, Vector, Vector]]:
        """Yield the rates of learned equations, and learned outputs."""
        points = self.at_samples(numbers, run.states, inputs)
        parts = parts_at(self, numbers, run.states, points)
        states, outputs = self.motion.learned
        names = [self.state_names[i] for i in states] + [self.outputs[i] for i in outputs]
        yield from zip(names, *(part.T for part in parts), strict=True)

    def describe(self, state: Vector, inputs: Vector) -> dict[str, float]:
        """Return states and the record's inputs by name."""
        named = zip(
            (*self.motion.names_of_states, *self.motion.external),
            (*state, *self.now(inputs)),
            strict=True,
        )
        return {name: float(value) for name, value in named}

    def step(self, numbers: Numbers, state: Array, inputs: Any) -> tuple[Any, Parts]:
        return _step(self, numbers, state, inputs)

    def _step_once(self, numbers: Numbers, state: Array, inputs: Array) -> tuple[Array, Parts]:
        motion, now = self.motion, self.inputs_at(numbers, state, inputs)
        y = self.observed(numbers, state, now)
        following = self._to_next_sample(numbers, state, now, inputs)
        if motion.discrete_states:
            p = self.parameters(numbers)
            following = motion.after_sample(following, y, state, now, p, jnp)
        return following, Parts(y, jnp.zeros_like(y), jnp.zeros_like(y))

    def _to_next_sample(self, numbers: Numbers, state: Array, now: Array, inputs: Array) -> Any:
        """Return the states one sample later, with what a controller sets held until then."""
        if self.motion.scheme.discrete:
            return sum(self.rates(numbers, state, now))
        exponentials = self.exponentials(numbers) if numbers.scheme is None else numbers.scheme[0]
        inputs, pace = self.split_pace(inputs)
        h, large = pace * self.sampling_time / self.substeps, self.large
        field = partial(_field, self, numbers)
        step = self.motion.scheme.step(field, h, exponentials, looped=large)
        held, external = len(self.motion.held), len(self.motion.external)
        if held:
            points = inputs.reshape(-1, external) if external else inputs.reshape(1, 0)
            control = jnp.broadcast_to(now[:held], (len(points), held))
            inputs = jnp.concatenate([control, points], axis=1).ravel()
        return advance(step, state, inputs, held + external, self.substeps, looped=large)

    def prepare(self, numbers: Numbers) -> Numbers:
        """Return the numbers with the exponentials of an exact integrator.

        Their derivatives are by the coordinates of p.
        """
        if not self.motion.scheme.splits_linear_part:
            return numbers

        def of(theta: Array) -> Any:
            return self.exponentials(numbers._replace(theta=theta))

        theta = jnp.asarray(numbers.theta)
        return numbers._replace(scheme=(of(theta), jax.jacfwd(of)(theta)))

    def exponentials(self, numbers: Numbers) -> Exponentials | None:
        """Return the exponentials of the linear part over a substep.

        None where the integrator needs none.
        """
        if not self.motion.scheme.splits_linear_part:
            return None
        return Exponentials.of(self.linear_part(numbers), self.sampling_time / self.substeps)

    @property
    def _by_stages(self) -> bool:
        few = self.substeps <= UNROLLED and not self.motion.held
        return self.motion.scheme.has_adjoint and few and self.differentiable

    def tangents(
        self, numbers: Numbers, state: Array, slopes: Array, inputs: Array
    ) -> tuple[Array, Array, Array, Array]:
        return self.local(numbers, state, inputs).along(slopes, fused=self._by_stages)

    def local(self, numbers: Numbers, states: Array, inputs: Array) -> Local:
        """Return the slopes of a few Runge-Kutta substeps by the adjoint of their stages.

        Other schemes are differentiated automatically.
        """
        if numbers.scheme is not None:
            value, to_state, to_unknowns = super().local(numbers, states, inputs)
            return Local(value, to_state, to_unknowns + self._by_scheme(numbers, states, inputs))
        if not self._by_stages or numbers.limits is not None:
            return super().local(numbers, states, inputs)
        following = jax.vmap(partial(sample_slopes, self, numbers), -1, -1)(states, inputs)
        output = jax.vmap(lambda x, row: output_slopes(self, numbers, x, self.now(row)), -1, -1)(
            states, inputs
        )
        value, to_x, *own = (jnp.concatenate(both) for both in zip(following, output, strict=True))
        return Local(value, to_x, jnp.concatenate(own, axis=1))

    def _by_scheme(self, numbers: Numbers, state: Array, inputs: Array) -> Array:
        """Return the derivatives of states and outputs by p through the exponentials.

        They are (n0 + ny, n, r). A step takes the exponentials as given.
        """
        scheme, by_theta = numbers.scheme

        def next_state(scheme: Exponentials, state: Array, row: Array) -> Array:
            return self.step(numbers._replace(scheme=(scheme, None)), state, row)[0]

        def along(moved: Any) -> Array:
            return jax.vmap(
                lambda x, row: jax.jvp(lambda s: next_state(s, x, row), (scheme,), (moved,))[1],
                -1,
                -1,
            )(state, inputs)

        moved = jax.vmap(along, -1, 1)(by_theta)  # a tangent for each parameter: (nx, np, m)
        after = self.unknowns - moved.shape[1]
        return jnp.pad(moved, ((0, len(self.outputs)), (0, after), (0, 0)))


@partial(jax.jit, static_argnames="form")
def _step(
    form: MotionDynamics, numbers: Numbers, state: Array, inputs: Array
) -> tuple[Array, Parts]:
    """Return a step.

    It is traced once, whatever programs contain it; so is the field in it.
    """
    return form._step_once(numbers, state, inputs)


@partial(jax.jit, static_argnames="form")
def _field(form: MotionDynamics, numbers: Numbers, x: Array, u: Array) -> Any:
    return sum(form.rates(numbers, x, u))
