"""A fitted model one sample at a time: `state, outputs = model.step(state, inputs)`.

The state of a lagged model is what its regressor remembers of outputs and inputs, so that a step
takes the inputs of its own sample alone; that of a motion is its state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Int

from orthaug._base.checks import Vector
from orthaug._base.errors import InputError, show
from orthaug._base.jax import AnyArray, Array, jax, jnp
from orthaug.data.expressions import Lag
from orthaug.data.record import Experiment, Record
from orthaug.data.regressors import Layout
from orthaug.models.dynamics import Numbers
from orthaug.models.moving import MotionDynamics


@dataclass(frozen=True)
class Memory:
    """Past samples that a lagged model remembers: outputs first, newest first.

    Examples:
        >>> memory = Memory.of((Lag("y", 2), Lag("u", 0), Lag("u", 1)), ["y"], ["u"])
        >>> memory.names
        ('y[k-1]', 'y[k-2]', 'u[k-1]')
    """

    depths: tuple[tuple[str, int], ...]
    layout: Layout
    inputs: tuple[str, ...]

    @classmethod
    def of(cls, layout: Layout, outputs: Sequence[str], inputs: Sequence[str]) -> Memory:
        """Return the memory of a regressor's layout."""
        names = dict.fromkeys((*outputs, *inputs))
        deepest = (
            (name, max((lag.lag for lag in layout if lag.channel == name), default=0))
            for name in names
        )
        return cls(tuple(deepest), layout, tuple(inputs))

    @cached_property
    def lags(self) -> Layout:
        """The entries of the state."""
        return tuple(Lag(name, i) for name, depth in self.depths for i in range(1, depth + 1))

    @property
    def names(self) -> tuple[str, ...]:
        """The entries of the state as expressions write them."""
        return tuple(map(str, self.lags))

    @cached_property
    def read(self) -> Int[np.ndarray, "nx"]:
        """Positions of the regressor's entries among state and inputs."""
        place = {
            lag: i for i, lag in enumerate((*self.lags, *(Lag(name, 0) for name in self.inputs)))
        }
        return np.array([place[lag] for lag in self.layout], dtype=int)

    @cached_property
    def following(self) -> Int[np.ndarray, "n"]:
        """Positions of the next state's entries among outputs, inputs and state."""
        now = [Lag(name, 0) for name, _ in self.depths]  # outputs, then inputs
        place = {lag: i for i, lag in enumerate((*now, *self.lags))}
        return np.array([place[Lag(lag.channel, lag.lag - 1)] for lag in self.lags], dtype=int)

    def at(self, experiment: Experiment, record: Record, row: int) -> Vector:
        """Return the state before a row of an experiment."""
        column = {c.name: experiment.outputs[:, i] for i, c in enumerate(record.outputs)}
        column |= {c.name: experiment.inputs[:, i] for i, c in enumerate(record.inputs)}
        return np.array([column[lag.channel][row - lag.lag] for lag in self.lags], dtype=float)


def step_arguments(
    state: AnyArray, inputs: AnyArray, states: int, count: int
) -> tuple[Array, Array]:
    """Return a step's arguments as arrays of JAX, which takes wrong lengths in silence.

    Raises:
        InputError: vectors of other lengths, or no numbers.
    """
    try:
        state, inputs = jnp.asarray(state, dtype=float), jnp.asarray(inputs, dtype=float)
    except (TypeError, ValueError):
        raise InputError(
            f"a step takes two vectors of numbers; got {show(state)} and {show(inputs)}."
        ) from None
    if state.shape != (states,) or inputs.shape != (count,):
        raise InputError(
            f"a step takes a state of {states} and inputs of {count} numbers; got the shapes "
            f"{state.shape} and {inputs.shape}."
        )
    return state, inputs


def step_inputs(form: MotionDynamics) -> tuple[str, ...]:
    """Return the input vector of a step of a motion.

    Under a first-order hold the inputs of the next sample follow behind those of this one.

    Raises:
        InputError: a hold that needs the whole record.
    """
    motion = form.motion
    if motion.hold == "spline" and motion.external:
        raise InputError(
            "a step cannot interpolate by a spline over the whole record; fit the motion with "
            "hold = 'zero-order' or 'first-order' to step or export it."
        )
    names = motion.external
    after = tuple(f"{name}[k+1]" for name in names) if motion.hold == "first-order" else ()
    return (*names, *after)


def with_scheme(form: MotionDynamics, numbers: Numbers) -> Numbers:
    """Return the numbers with the exponentials of an exact integrator.

    A step does not need their derivatives.
    """
    with jax.ensure_compile_time_eval():
        scheme = form.exponentials(numbers)
    return numbers if scheme is None else numbers._replace(scheme=(scheme, None))


def checked_row(row: Any, first: int, rows: int) -> int:
    """Return `row` if a state can be determined there; by default the first such row.

    Raises:
        InputError: no whole number, or outside of the record.
    """
    if row is None:
        row = first
    if isinstance(row, bool) or not isinstance(row, int | np.integer) or not first <= row <= rows:
        raise InputError(
            f"`row` must be a whole number from {first} to {rows} in this record; got {show(row)}."
        )
    return int(row)


def one_experiment(record: Record) -> Experiment:
    """Return the record's only experiment, with outputs.

    Raises:
        InputError: several experiments, or no outputs to start from.
    """
    if len(record.experiments) != 1:
        raise InputError(
            f"the record has {len(record.experiments)} experiments; give "
            "a record of one, in which the state starts."
        )
    if not record.outputs:
        raise InputError(
            "the record has no measured outputs to start from; give some, or a state of your "
            "own: one number for each of `state_names`."
        )
    return record.experiments[0]
