"""Step of a model as a function to linearise: of its state and inputs, and their rest.

The state of a lagged model is its memory of outputs and inputs, that of a motion its states. At
rest the first is made of the outputs, so that these are what is looked for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Vector, positive
from orthaug._base.jax import Array, jax, jnp, quick_jit
from orthaug.analysis.feedback import by_differences
from orthaug.models.dynamics import Numbers
from orthaug.models.filters import LaggedFilter
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.model import Model
from orthaug.models.moving import MotionDynamics
from orthaug.models.stepping import Memory, step_inputs

_WIDTH = 1e-3  # of differences, in sizes: bears a learner in single precision


@dataclass(frozen=True)
class LaggedStep:
    """The step of a lagged model; it rests where an output repeats itself."""

    form: LaggedDynamics
    memory: Memory

    ends = 1  # how many instants' inputs a step reads
    continuous = False  # whether there are derivatives in time
    smooth = False  # whether inputs run on a spline between samples

    @classmethod
    def of(cls, model: Model[LaggedDynamics]) -> LaggedStep:
        """Return the step of a lagged model."""
        return cls(model.form, Memory.of(model.form.layout, model.form.outputs, model.step_inputs))

    @property
    def units(self) -> dict[str, str]:
        """Units of states that are no channels."""
        return {}

    def sizes(self, model: Model[LaggedDynamics]) -> Vector:
        """Return the sizes of the unknowns of rest over the training data."""
        return np.asarray(model.largest_output, dtype=float)

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the state's entries."""
        return self.memory.names

    @property
    def rest(self) -> tuple[str, ...]:
        """Names of what is looked for at rest."""
        return self.form.outputs

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return self.memory.inputs

    def state_at(self, rest: Array, inputs: Array) -> Array:
        """Return the state that keeps outputs `rest` and inputs for long."""
        now = dict(zip((*self.rest, *self.inputs), (*rest, *inputs), strict=True))
        return jnp.stack([now[lag.channel] for lag in self.memory.lags] or [jnp.zeros(())])[
            : len(self.memory.lags)
        ]

    def advance(self, numbers: Numbers, state: Array, inputs: Array) -> tuple[Any, Any]:
        """Return the next state and the outputs."""
        following, parts = LaggedFilter(self.form, self.memory).step(numbers, state, inputs)
        return following, parts.total

    field = advance  # there are no equations in time

    def unrest(self, numbers: Numbers, rest: Array, inputs: Array) -> tuple[Any, Any]:
        """Return the residual of rest, zero at rest, and the outputs."""
        y = self.advance(numbers, self.state_at(rest, inputs), inputs)[1]
        return y - rest, y

    def seen(self, numbers: Numbers, rest: Vector, inputs: Vector) -> Vector | None:
        """Return the learner's features at rest.

        None where it is unknown which of them training reached.
        """
        if not self.form.differentiable:
            return None
        now = dict(zip((*self.rest, *self.inputs), (*rest, *inputs), strict=True))
        x = np.array([[now[lag.channel] for lag in self.form.layout]])
        return self.form.features_of(x)[0]


@dataclass(frozen=True)
class MotionStep:
    """As `LaggedStep`, of a motion; it rests where no state changes."""

    form: MotionDynamics
    smooth: bool = False

    memory = None

    @classmethod
    def of(cls, model: Model[MotionDynamics]) -> MotionStep:
        """Return the step of a motion, with a spline through the record as straight lines."""
        form, smooth = model.form, False
        if form.motion.hold == "spline":
            smooth = bool(model.inputs) and not form.motion.scheme.discrete
            form = replace(form, motion=replace(form.motion, hold="first-order"))
        step_inputs(form)  # whatever else has no step is refused there
        return cls(form, smooth)

    @property
    def units(self) -> dict[str, str]:
        return {state.name: state.unit for state in self.form.motion.states}

    def sizes(self, model: Model[MotionDynamics]) -> Vector:
        return np.asarray(model.filtering[2], dtype=float)

    @property
    def continuous(self) -> bool:
        return not (self.form.motion.scheme.discrete or self.form.motion.held)

    @property
    def ends(self) -> int:
        return 2 if self.form.motion.hold == "first-order" and self.inputs else 1

    @property
    def states(self) -> tuple[str, ...]:
        return self.form.motion.names_of_states

    @property
    def rest(self) -> tuple[str, ...]:
        return self.states

    @property
    def inputs(self) -> tuple[str, ...]:
        return self.form.motion.external

    def state_at(self, rest: Array, inputs: Array) -> Array:
        """Return the state itself."""
        return jnp.asarray(rest)

    def advance(self, numbers: Numbers, state: Array, inputs: Array) -> tuple[Any, Any]:
        following, parts = self.form.step(numbers, state, inputs)
        return following, parts.total

    def field(self, numbers: Numbers, state: Array, inputs: Array) -> tuple[Any, Any]:
        """Return the derivatives in time, or a discrete motion's next state, and the outputs.

        With a controller the motion is known at samples only.
        """
        if self.form.motion.held:
            return self.advance(numbers, state, jnp.concatenate([inputs] * self.ends))
        return sum(self.form.rates(numbers, state, inputs)), self.form.observed(
            numbers, state, inputs
        )

    def unrest(self, numbers: Numbers, rest: Array, inputs: Array) -> tuple[Any, Any]:
        rates, y = self.field(numbers, rest, inputs)
        return (rates if self.continuous else rates - rest), y

    def seen(self, numbers: Numbers, rest: Vector, inputs: Vector) -> Vector | None:
        if not self.form.differentiable:
            return None
        read = self.form.at_samples(numbers, rest[None], inputs[None])
        return self.form.features_at(rest[None], read)[0]


Step = LaggedStep | MotionStep
_STEPS: dict[type, Callable[[Any], Step]] = {
    LaggedDynamics: LaggedStep.of,
    MotionDynamics: MotionStep.of,
}


def step_of(model: Model) -> Step:
    """Return the step to linearise.

    A spline through the record is replaced by straight lines between samples.
    """
    return _STEPS[type(model.form)](model)


def sizes_of(model: Model) -> Vector:
    """Return the sizes of the unknowns of rest over the training data."""
    return positive(step_of(model).sizes(model))


@partial(quick_jit, static_argnames="step")
def at_rest(
    step: Step, numbers: Numbers, rest: Array, inputs: Array, width: Array
) -> tuple[Any, Any, Any]:
    """Return residual of rest (ne,), outputs (ny,), and slopes of both (ne + ny, ne + nu).

    The slopes are those by rest and inputs.
    """
    both, point = partial(_unrest, step, numbers), jnp.concatenate([rest, inputs])
    value = both(point)
    slope = (
        jax.jacfwd(both)(point) if step.form.differentiable else by_differences(both, point, width)
    )
    ne = len(step.rest)
    return value[:ne], value[ne:], slope


def _unrest(step: Step, numbers: Numbers, point: Array) -> Array:
    rest, inputs = point[: len(step.rest)], point[len(step.rest) :]
    return jnp.concatenate(step.unrest(numbers, rest, inputs))


def _replace_unknowns(numbers: Numbers, unknowns: Array) -> Numbers:
    """Return the numbers with others for (θ, weights), or for θ alone."""
    nt = len(numbers.theta)
    weights = unknowns[nt:] if len(unknowns) > nt else numbers.weights
    return numbers._replace(theta=unknowns[:nt], weights=weights)


@partial(quick_jit, static_argnames="step")
def unrest_along(
    step: Step, numbers: Numbers, rest: Array, inputs: Array, unknowns: Array, root: Array
) -> Float[Array, "m r"]:
    """Return the change of rest's residual and of the outputs along columns of `root` (n, r)."""

    def of(p: Array) -> Any:
        return _unrest(step, _replace_unknowns(numbers, p), jnp.concatenate([rest, inputs]))

    return jax.vmap(lambda d: jax.jvp(of, (unknowns,), (d,))[1], -1, -1)(root)


def _of_point(step: Step, field: bool, numbers: Numbers) -> Callable[[Any], Any]:
    """Return a step, or the field, as a function of state and inputs in one vector."""
    n = len(step.states)
    function = step.field if field else step.advance
    return lambda point: jnp.concatenate(function(numbers, point[:n], point[n:]))


def _build_rows(step: Step, field: bool, rest: Array, inputs: Array) -> Array:
    """Return state and inputs of a step in one vector; of the field the inputs at one instant."""
    return jnp.concatenate([step.state_at(rest, inputs), *([inputs] * (1 if field else step.ends))])


def _slope(step: Step, field: bool, numbers: Numbers, rest: Any, inputs: Array, width: Any) -> Any:
    """Return `[[A, B], [C, D]]` of a step, or of the field."""
    both, point = _of_point(step, field, numbers), _build_rows(step, field, rest, inputs)
    if step.form.differentiable:
        return jax.jacfwd(both)(point)
    return by_differences(
        both, point, _build_rows(step, field, width[: len(rest)], width[len(rest) :])
    )


@partial(quick_jit, static_argnames="step")
def one_sided(
    step: Step, numbers: Numbers, rest: Array, inputs: Array, width: Array
) -> tuple[Any, Any]:
    """Return `[A B]` by differences to each side, (2, n, k), and their reach, (k,)."""
    both, point = _of_point(step, False, numbers), _build_rows(step, False, rest, inputs)
    full = _build_rows(step, False, width[: len(rest)], width[len(rest) :])
    each, middle, n = jax.vmap(both), both(point), len(step.states)
    sides = [
        (each(point + sign * jnp.diag(full)) - middle) / (sign * full[:, None]) for sign in (-1, 1)
    ]
    return jnp.stack([side.T[:n] for side in sides]), full


@partial(quick_jit, static_argnames=("step", "field"))
def remainder_at(
    step: Step,
    field: bool,
    numbers: Numbers,
    rest: Array,
    inputs: Array,
    moves: Array,
    shifts: Array,
) -> Float[Array, "m n"]:
    """Return what the slopes at a point of rest leave of the next state, or of the derivatives.

    Args:
        step: the step.
        field: whether the equations in time are meant.
        numbers: of the model.
        rest: the point.
        inputs: at the point.
        moves: of the state from there, (m, n).
        shifts: of the inputs, (m, nu).
    """
    both, point = _of_point(step, field, numbers), _build_rows(step, field, rest, inputs)
    ends, n = 1 if field else step.ends, len(step.states)
    apart = jnp.concatenate([moves, *([shifts] * ends)], axis=1)
    middle, slope = both(point), jax.jacfwd(both)(point)
    return (jax.vmap(lambda d: both(point + d) - middle - slope @ d)(apart))[:, :n]


def state_sizes(step: Step, size: Vector) -> Vector:
    """Return the sizes of a step's state from those of its rest, 1 for past inputs."""
    ones = np.ones(len(step.inputs))
    return positive(np.abs(np.asarray(step.state_at(jnp.asarray(size), jnp.asarray(ones)))))


@partial(quick_jit, static_argnames=("step", "field"))
def slope_at(
    step: Step, field: bool, numbers: Numbers, rest: Array, inputs: Array, width: Array
) -> Float[Array, "m n"]:
    """Return `[[A, B], [C, D]]` at a point of rest."""
    return _slope(step, field, numbers, rest, inputs, width)


@partial(quick_jit, static_argnames=("step", "field"))
def slope_along(
    step: Step,
    field: bool,
    numbers: Numbers,
    rest: Array,
    inputs: Array,
    unknowns: Array,
    along: tuple[Any, Any, Any],
) -> Float[Array, "r m n"]:
    """Return the change of `[[A, B], [C, D]]` along each column of `along`.

    The columns are directions of (rest, inputs, unknowns).
    """

    def of(rest: Array, inputs: Array, p: Array) -> Any:
        return _slope(step, field, _replace_unknowns(numbers, p), rest, inputs, None)

    point = (rest, inputs, unknowns)
    return jax.vmap(lambda *d: jax.jvp(of, point, d)[1], -1, 0)(*along)


def difference_widths(size: Vector, inputs: Vector) -> Vector:
    """Return the reach of differences, for rest and inputs."""
    return _WIDTH * np.concatenate([size, np.maximum(np.abs(inputs), 1.0)])
