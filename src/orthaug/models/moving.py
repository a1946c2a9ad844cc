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
    Exponentials,
    advance,
    input_at,
    inputs_at_points,
)
from orthaug.physics.motion import Motion
from orthaug.physics.parameters import Coordinates

_FEW = 8  # states and parameters; programs of more are slow to compile
_FEW = 2  # substeps that are one piece; more are loops, which compile in half the time
_MOST_KEPT = 32  # substeps whose stages are kept in memory until their slopes are multiplied
_FUSED = 250  # slopes of a state up to which the stages of a step are one piece


class Slopes(NamedTuple):
    """Value of a map from (x, c, w) at m points, and ∂/∂x, ∂/∂c, ∂/∂w.

    Points are the last axis everywhere: arithmetic on small matrices then runs along it.
    """

    value: Any
    to_x: Any
    to_c: Any
    to_w: Any


class FieldSlopes(NamedTuple):
    """Value of F at m points, ∂F/∂x, ∂F/∂c, and what `Bound.backward` needs for ∂F/∂w.

    `to_g` is ∂F/∂g by the learner's values under a mass matrix, and None where they are rates.
    """

    value: Any
    to_x: Any
    to_c: Any
    kept: Any
    to_g: Any


def sample_slopes(
    form: MotionField, numbers: Numbers, states: Float[Array, "nx m"], rows: Float[Array, "r m"]
) -> Slopes:
    """Return x one sample later with its slopes, of m states and input rows, under `rk4`.

    The stages are run first; then the slopes of where the sample ends go back through them, with
    one pass through the learner for each state, and never one for each weight.
    """
    halves, nu = 2 * form.substeps, len(form.motion.inputs)

    def at_points(row: Array) -> tuple[Array, Any]:
        row, pace = form.split_pace(row)
        at = input_at(row, nu)
        return jnp.stack([at(i, halves) for i in range(halves + 1)]), jnp.asarray(pace)

    points, pace = jax.vmap(at_points, -1, -1)(rows)
    h = pace * form.sampling_time / form.substeps
    # Fused, XLA computes what a stage finds anew for each use of it, of which large slopes have
    # many; and a large field is written once into a program
    few = form.substeps <= (1 if form.large else _FEW)
    over_substeps = _unrolled if few else jax.lax.scan
    small = few and form.states * form.unknowns <= _FUSED and not form.large
    given = form, numbers, h, _unrolled if small else jax.lax.scan
    end, stages = over_substeps(
        partial(_substep, *given), states, (points[:-2:2], points[1:-1:2], points[2::2])
    )
    n, m = states.shape
    nothing = (jnp.zeros((n, count, m)) for count in (len(numbers.c), form.bound.size))
    slopes = Slopes(end, _identity(n, m), *nothing)
    return over_substeps(partial(_back, *given), slopes, stages, reverse=True)[0]


def _substep(
    form: MotionField, numbers: Numbers, h: Array, over_stages: Any, x: Array, u: Any
) -> tuple[Array, FieldSlopes]:
    """Return x⁺ = x + h (F₁ + 2 F₂ + 2 F₃ + F₄)/6, and the four stages with their slopes.

    F_s is F at x + a_s h F_{s−1}, a = (0, ½, ½, 1); `u` are inputs at begin, middle and end.
    """

    def stage(rates: Array, given: tuple[Array, Array]) -> tuple[Array, FieldSlopes]:
        ahead, u = given
        slopes = field_slopes(form, numbers, x + ahead * h * rates, u)
        return slopes.value, slopes

    first, middle, last = u
    given = jnp.array([0.0, 0.5, 0.5, 1.0]), jnp.stack([first, middle, middle, last])
    stages = over_stages(stage, jnp.zeros_like(x), given)[1]
    rates = stages.value
    return x + h / 6 * (rates[0] + 2 * (rates[1] + rates[2]) + rates[3]), stages


def _back(
    form: MotionField,
    numbers: Numbers,
    h: Array,
    over_stages: Any,
    after: Slopes,
    stages: FieldSlopes,
) -> tuple[Slopes, None]:
    """Return the slopes of where the sample ends, from those by x⁺ to those by x.

    With A = ∂x_end/∂x⁺ and b = (1, 2, 2, 1)/6 the adjoints are
    ψ_s = ∂x_end/∂F_s = h (b_s A + a_{s+1} ψ_{s+1} ∂F_{s+1}/∂x). Then ∂x_end/∂x = A + Σ ψ_s ∂F_s/∂x,
    and the slopes by c and w grow by Σ ψ_s ∂F_s/∂c and Σ ψ_s ∂F_s/∂w.
    """
    learned = form.corrected[0]
    each = range(len(learned))

    def before(sums: tuple[Array, ...], given: tuple[Any, ...]) -> tuple[Any, Array]:
        (adjoint, to_x, to_c), (own, ahead, next_to_x, stage_to_x, stage_to_c, to_g) = sums, given
        adjoint = h * (own * after.to_x + ahead * _product(adjoint, next_to_x))
        sums = adjoint, to_x + _product(adjoint, stage_to_x), to_c + _product(adjoint, stage_to_c)
        if not learned:
            return sums, adjoint
        rows, places = (adjoint, learned) if to_g is None else (_product(adjoint, to_g), each)
        return sums, _learner_rows(form, numbers, rows, places, 0)

    weights = jnp.array([1.0, 2.0, 2.0, 1.0]) / 6, jnp.array([0.5, 0.5, 1.0, 0.0])
    given = (*weights, jnp.roll(stages.to_x, -1, axis=0), *stages[1:3], stages.to_g)
    begun = after.to_x, after.to_x, after.to_c
    (_, to_x, to_c), rows = over_stages(before, begun, given, reverse=True)
    to_w = after.to_w
    if learned:
        to_w = to_w + _through_learner(form, numbers, rows, stages.kept)
    return Slopes(after.value, to_x, to_c, to_w), None


def _through_learner(
    form: MotionField, numbers: Numbers, rows: Float[Array, "s nx ny m"], kept: Any
) -> Float[Array, "nx nw m"]:
    """Return the sum over stages of rows · ∂f/∂w."""
    pulled: list[list[Array]] = []
    for i, own in enumerate(rows):
        at_stage = jax.tree.map(lambda part, i=i: part[i], kept)
        pulled.append(form.bound.backward(numbers.weights, at_stage, own)[0])
    summed: list[Any] = [sum(parts) for parts in zip(*pulled, strict=True)]
    return form.bound.columns(summed, rows[0])


def _unrolled(function: Any, carry: Any, given: Any, *, reverse: bool = False) -> tuple[Any, Any]:
    """Return `jax.lax.scan` in one piece, which is faster for small slopes."""
    steps = len(jax.tree.leaves(given)[0])
    found: list[Any] = [None] * steps
    for i in reversed(range(steps)) if reverse else range(steps):
        carry, found[i] = function(carry, jax.tree.map(lambda part, i=i: part[i], given))
    return carry, jax.tree.map(lambda *parts: jnp.stack(parts), *found)


@partial(jax.jit, static_argnames="form")  # for the stages of all substeps it is traced once
def field_slopes(
    form: MotionField, numbers: Numbers, x: Float[Array, "nx m"], u: Float[Array, "nu m"]
) -> FieldSlopes:
    """Return F and its slopes at m points."""
    states, motion = form.corrected[0], form.motion
    if states and motion.mass.rows:
        kept, *learned = learner_slopes(form, numbers, x, u)
        g, g_to_x = (part[: len(states)] for part in learned)
        return _force_slopes(form, numbers, kept, g, g_to_x, x, u)
    value, to_x, to_c = _physics_slopes(form, motion.rates, numbers.c, x, u)
    to_x, to_c = _finite(to_x), _finite(to_c)
    if not states:
        return FieldSlopes(value, to_x, to_c, (), None)
    kept, g, g_to_x = learner_slopes(form, numbers, x, u)
    value, to_x = (_add_to_rows(a, states, b) for a, b in ((value, g), (to_x, g_to_x)))
    return FieldSlopes(value, to_x, to_c, kept, None)


def _force_slopes(
    form: MotionField, numbers: Numbers, kept: Any, g: Array, g_to_x: Array, x: Array, u: Array
) -> FieldSlopes:
    """Return f + M⁻¹ g and its slopes, of forces g (nl, m) and ∂g/∂x (nl, nx, m)."""
    motion, n = form.motion, form.states

    def at(x: Array, u: Array, g: Array) -> tuple[Any, Any, Any]:
        def values(point: Array, c: Array) -> Array:
            p = motion.coordinates.physical(c, jnp)
            rates = motion.rates(point[:n], u, p, jnp)
            return rates + form.rates_of(point[n:], point[:n], p)

        return _differentiate(values, jnp.concatenate([x, g]), numbers.c, motion)

    value, to_both, to_c = jax.vmap(at, -1, -1)(x, u, g)
    to_x, to_g = _finite(to_both[:, :n]), _finite(to_both[:, n:])
    return FieldSlopes(value, to_x + _product(to_g, g_to_x), _finite(to_c), kept, to_g)


def learner_slopes(
    form: MotionField, numbers: Numbers, x: Array, u: Array
) -> tuple[Any, Array, Array]:
    """Return what `Bound.backward` needs, g and ∂g/∂x at m points.

    Learned equations come first, then learned outputs.
    """

    def features(x: Array, u: Array) -> Any:
        return (form.seen(x, u) - numbers.centre) / numbers.halfwidth

    z = jax.vmap(features, -1, -1)(x, u)
    z_to_x = _finite(jax.vmap(jax.jacfwd(features), -1, -1)(x, u))
    value, kept = form.bound.forward(numbers.weights, z)
    ny, m = value.shape
    gain = jnp.broadcast_to(jnp.asarray(numbers.gain), (ny,))[:, None]
    to_z = form.bound.backward(numbers.weights, kept, _identity(ny, m) * gain)[1]
    return kept, gain * value, _finite(_product(to_z, z_to_x))


def _learner_rows(
    form: MotionField, numbers: Numbers, rows: Float[Array, "k l m"], places: Sequence[int], at: int
) -> Float[Array, "k ny m"]:
    """Return rows that multiply the learner's values, of rows that multiply g where it is added.

    Args:
        places: columns of `rows` that the learner is added to.
        at: number of the first of them among the learner's values.
    """
    ny = form.bound.ny
    gain = jnp.broadcast_to(jnp.asarray(numbers.gain), (ny,))[None, :, None]
    chosen = [rows[:, i] for i in places]
    none = [jnp.zeros_like(rows[:, 0])]
    return jnp.stack([*none * at, *chosen, *none * (ny - at - len(chosen))], axis=1) * gain


def output_slopes(form: MotionField, numbers: Numbers, x: Array, inputs: Array) -> Slopes:
    """Return y and its slopes at m points, of states and inputs."""
    states, outputs = form.corrected
    u: Any = jax.vmap(form.now, -1, -1)(inputs)
    value, to_x, to_c = _physics_slopes(form, form.motion.observed, numbers.c, x, u)
    to_w = jnp.zeros((len(value), form.unknowns - len(numbers.c), x.shape[1]))
    if outputs:
        kept, *learned = learner_slopes(form, numbers, x, u)
        g, g_to_x = (part[len(states) :] for part in learned)
        one = _identity(len(outputs), x.shape[1])
        rows = _learner_rows(form, numbers, one, range(len(outputs)), len(states))
        g_to_w = form.bound.columns(form.bound.backward(numbers.weights, kept, rows)[0], rows)
        own = ((value, g), (to_x, g_to_x), (to_w, g_to_w))
        value, to_x, to_w = (_add_to_rows(a, outputs, b) for a, b in own)
    return Slopes(value, _finite(to_x), _finite(to_c), to_w)


def _physics_slopes(
    form: MotionField, equations: Any, c: Any, x: Array, u: Array
) -> tuple[Any, Any, Any]:
    """Return the motion's rates or outputs at m points, and their slopes by x and c."""

    def at(x: Array, u: Array) -> tuple[Any, Any, Any]:
        def values(x: Array, c: Array) -> Array:
            return equations(x, u, form.motion.coordinates.physical(c, jnp), jnp)

        return _differentiate(values, x, c, form.motion)

    return jax.vmap(at, -1, -1)(x, u)


def _identity(n: int, m: int) -> Array:
    return jnp.broadcast_to(jnp.eye(n)[:, :, None], (n, n, m))


def _add_to_rows(a: Array, places: Sequence[int], b: Array) -> Array:
    """Return a with the first rows of b added at these places."""
    if list(places) == list(range(len(a))):
        return a + b[: len(a)]
    return a.at[np.array(places)].add(b[: len(places)])


def _product(a: Float[Array, "i k m"], b: Float[Array, "k j m"]) -> Any:
    """Return the matrix products at m points, as sums along the points where matrices are small."""
    if not 0 < a.shape[1] <= _FEW:
        return jnp.einsum("ikm,kjm->ijm", a, b)
    return sum(a[:, k, None] * b[None, k] for k in range(a.shape[1]))


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


@dataclass(frozen=True, eq=False)
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

    def features_of(self, points: Matrix) -> Float[np.ndarray, "N nz"]:
        """Return the learner's features at states and inputs (N, nx + nu)."""
        return self.features_at(*np.split(points, [self.states], axis=1))

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
        h = pace * self.sampling_time / self.substeps
        field = partial(_field, self, numbers)
        step = self.motion.scheme.step(field, h, exponentials)
        held, external = len(self.motion.held), len(self.motion.external)
        if held:
            points = inputs.reshape(-1, external) if external else inputs.reshape(1, 0)
            control = jnp.broadcast_to(now[:held], (len(points), held))
            inputs = jnp.concatenate([control, points], axis=1).ravel()
        return advance(step, state, inputs, held + external, self.substeps)

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
        plain = self.substeps <= _MOST_KEPT and not self.motion.held
        return self.motion.scheme.has_adjoint and plain and self.differentiable

    def tangents(
        self, numbers: Numbers, state: Array, slopes: Array, inputs: Array
    ) -> tuple[Array, Array, Array, Array]:
        return self.local(numbers, state, inputs).along(slopes, fused=self._by_stages)

    def local(self, numbers: Numbers, states: Array, inputs: Array) -> Local:
        """Return the slopes of Runge-Kutta substeps by the adjoint of their stages.

        Other schemes are differentiated automatically.
        """
        if numbers.scheme is not None:
            value, to_state, to_unknowns = super().local(numbers, states, inputs)
            return Local(value, to_state, to_unknowns + self._by_scheme(numbers, states, inputs))
        if not self._by_stages or numbers.limits is not None:
            return super().local(numbers, states, inputs)
        following = sample_slopes(self, numbers, states, inputs)
        output = output_slopes(self, numbers, states, inputs)
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
