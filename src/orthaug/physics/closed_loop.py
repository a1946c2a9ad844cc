"""Equations of motion with a controller around them: a motion whose inputs are the references.

The states are those of the plant, then those of the controller, then those of a learner. At a
sample k the outputs are y_k = h(x_k), by which the controller sets the plant's input u_k; the plant
goes on to the next sample under it, and the controller's states take their next values. So u is
simulated, and what is measured of it does not enter; it can be an output, which is fitted as well.

Equations, features of a learner and measures are over the plant's states and inputs. The plant does
not know the controller: p of a controller moves no equation at a point. No JAX.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from graphlib import CycleError, TopologicalSorter
from typing import Any, TypeVar

from orthaug._base.checks import Matrix, Vector, check_type, nearest
from orthaug._base.errors import InputError
from orthaug._base.jax import ArrayModule
from orthaug.data.expressions import SAMPLING_TIME, Expression, parse_named
from orthaug.physics.controller import Controller
from orthaug.physics.motion import Motion
from orthaug.physics.states import Output

_AT_REST = "0"  # the equation of a controller's state between samples


@dataclass(frozen=True)
class ClosedLoop(Motion):
    """A motion in the loop of a controller; `close_loop` makes it."""

    controller: Controller = Controller(())  # noqa: RUF009  (frozen)

    @property
    def held(self) -> tuple[str, ...]:
        return self.controller.held

    @property
    def discrete_states(self) -> tuple[str, ...]:
        return tuple(state.name for state in self.controller.states)

    @cached_property
    def visible(self) -> tuple[str, ...]:
        own = self._plant_names
        plant = (name for name in self.inputs if name in own or name in self.held)
        return (*self.visible_states, *plant)

    @cached_property
    def _plant_names(self) -> set[str]:
        """All names in the plant's equations and outputs."""
        plant = [e for name, e in self.equations.items() if name not in self.discrete_states]
        measured = zip(self.outputs, self.observations, strict=True)
        seen = [e for output, e in measured if output.name not in self.held]
        return self.names_in(*plant, *seen)

    @property
    def plant(self) -> Motion:
        """The motion without the controller, its inputs as they are set from outside."""
        return Motion(
            **self.declaration
            | {
                "states": tuple(s for s in self.states if s.name not in self.discrete_states),
                "outputs": tuple(o for o in self.outputs if o.name not in self.held),
                "inputs": tuple(name for name in self.visible if name in self.inputs),
                "parameters": tuple(
                    p for p in self.parameters if p.name not in self.controller.names
                ),
            }
        )

    def around(self, plant: Motion) -> ClosedLoop:
        return close_loop(plant, self.controller, self.external, [o.name for o in self.outputs])

    @property
    def unread(self) -> tuple[str, ...]:
        read = {name for e in (*dict(self._law[0]).values(), *self._law[1]) for name in e.names}
        return tuple(name for name in super().unread if name not in read)

    @cached_property
    def _readable(self) -> dict[str, float]:
        """Names that the controller's expressions may use, beside definitions and outputs."""
        outputs = (output.name for output in self.outputs)
        names = (*self.external, *outputs, *self.discrete_states, *self.names)
        known = dict.fromkeys((n for n in names if n not in self.held), 1.0)
        return {SAMPLING_TIME: 1.0} | dict(self.constants) | known

    @cached_property
    def _law(self) -> tuple[tuple[tuple[str, Expression], ...], tuple[Expression, ...]]:
        """Definitions and outputs of the controller in an order to compute them; next states."""
        given = (*self.controller.definitions, *self.controller.outputs)
        known = self._readable | dict.fromkeys((name for name, _ in given), 1.0)
        parsed = {name: parse_named(text, known, f"controller: '{name}'") for name, text in given}
        uses = {n: [o for o in e.names if o in parsed] for n, e in parsed.items()}
        try:
            order = list(TopologicalSorter(uses).static_order())
        except CycleError as error:
            loop = " → ".join(reversed(error.args[1]))
            raise InputError(
                f"controller: an algebraic loop, {loop}; let one of them be a state, which has "
                "its value one sample later."
            ) from None
        following = tuple(
            parse_named(state.derivative, known, f"controller: the next '{state.name}'")
            for state in self.controller.states
        )
        return tuple((name, parsed[name]) for name in order), following

    def _signals(self, y: Matrix, x: Matrix, u: Matrix, p: Vector) -> dict[str, Any]:
        """Return the values that the controller's expressions read, and those it computes."""
        values: dict[str, object] = dict(self.constants)
        values |= dict(zip(self.names, p, strict=True))
        sampled = set(self.discrete_states)
        states = zip(self.names_of_states, x, strict=True)
        values |= {name: value for name, value in states if name in sampled}
        values |= dict(zip(self.external, u, strict=True))
        values |= dict(zip((o.name for o in self.outputs), y, strict=True))
        return values

    def _law_values(self, y: Any, x: Any, u: Any, p: Any, xp: ArrayModule) -> dict[str, Any]:
        """Return the signals with what the controller computes of them."""
        values = self._signals(y, x, u, p)
        for name, expression in self._law[0]:
            values[name] = expression.value(values, xp)
        return values

    def control(self, y: Matrix, x: Matrix, u: Matrix, p: Vector, xp: ArrayModule) -> Matrix:
        values = self._law_values(y, x, u, p, xp)
        return xp.stack(
            [xp.broadcast_to(xp.asarray(values[n], dtype=float), x.shape[1:]) for n in self.held]
        )

    def after_sample(self, following: Any, y: Any, x: Any, u: Any, p: Any, xp: ArrayModule) -> Any:
        if not self.discrete_states:
            return following
        values = self._law_values(y, x, u[len(self.held) :], p, xp)
        new = dict(zip(self.discrete_states, self._law[1], strict=True))
        rows = [
            new[name].value(values, xp) if name in new else following[i]
            for i, name in enumerate(self.names_of_states)
        ]
        return xp.stack([xp.broadcast_to(xp.asarray(r, dtype=float), x.shape[1:]) for r in rows])

    @cached_property
    def read_at_once(self) -> frozenset[str]:
        """Names of the measured outputs that set the plant's input at their own sample."""
        needed = set(self.held)
        for name, expression in reversed(self._law[0]):
            if name in needed:
                needed |= set(expression.names)
        return frozenset(needed & {o.name for o in self.outputs} - set(self.held))

    def check_loop(self) -> None:
        """Raise InputError for a controller that this motion cannot have.

        These are unknown names, and an output that follows the input at its own sample.
        """
        order, following = self._law
        used = {name for _, e in order for name in e.names} | {
            n for e in following for n in e.names
        }
        for name in self.controller.names:
            if name not in used and name not in self._plant_names:
                raise InputError(
                    f"controller: the parameter '{name}' is in no equation; use or remove it."
                )
        if not self._readable.keys() & used & {o.name for o in self.outputs}:
            raise InputError(
                f"controller: it reads no measured output; expected one of "
                f"{', '.join(o.name for o in self.outputs if o.name not in self.held)} in it. "
                "An input that follows from references alone is an input of the data."
            )
        for output, expression in zip(self.outputs, self.observations, strict=True):
            through = self.names_in(expression) & set(self.held)
            if through and output.name in self.read_at_once:
                raise _algebraic(output.name, min(through))


def _algebraic(output: str, name: str) -> InputError:
    """Return the error of an output that needs the input that it sets."""
    return InputError(
        f"an algebraic loop: the output '{output}' contains the input '{name}', which the "
        f"controller sets from '{output}' at the same sample. Give the controller a state, so "
        "that it acts one sample later, or the plant an actuator with an equation of its own."
    )


def close_loop(
    motion: Motion, controller: Controller, inputs: Sequence[str], outputs: Sequence[str]
) -> ClosedLoop:
    """Return a motion in the loop of a controller.

    Args:
        motion: the plant; an input of it is set by the controller, or by the record.
        controller: sets at least one of its inputs.
        inputs: names of the record's inputs, in order: references, and other inputs of the plant.
        outputs: names of the record's outputs; one that the controller sets is fitted as well.

    Raises:
        InputError: names that do not fit together, an algebraic loop, or a motion of functions.
    """
    if motion.functions is not None:
        raise InputError(
            "a controller needs the plant's equations, and this motion consists of Python "
            "functions. Write the motion with `Motion.from_equations`."
        )
    if motion.held:
        raise InputError("the motion is in the loop of a controller already; give its plant.")
    _check_channels(motion, controller, inputs)
    measured = {output.name: output for output in motion.outputs}
    for name in controller.held:
        measured.setdefault(name, Output(name, name))
        if name not in outputs:
            del measured[name]
    order = [*(n for n in outputs if n in measured), *(n for n in measured if n not in outputs)]
    _check_names(motion, controller, inputs)
    own = motion.declaration
    own |= {
        "states": (
            *motion.without_memory.states,
            *(replace(state, derivative=_AT_REST) for state in controller.states),
            *(state for state in motion.states if state.memory),
        ),
        "outputs": tuple(measured[name] for name in order),
        "inputs": (*controller.held, *inputs),
        "parameters": (*motion.parameters, *controller.parameters),
        "constants": tuple(sorted((dict(motion.constants) | dict(controller.constants)).items())),
    }
    loop = ClosedLoop(**own, controller=controller)
    for state in controller.states:
        loop._check_start(state)
    loop.check_loop()
    return loop


Physics = TypeVar("Physics")


def in_loop(physics: Physics, controller: Controller | None, record: Any) -> Physics:
    """Return a motion in the loop of a controller that a record shows; without one the physics.

    Raises:
        InputError: physics that are no motion, or a controller that the motion cannot have.
    """
    check_type(controller, Controller | None, "controller", "a Controller such as Controller.pid")
    if controller is None:
        return physics
    if not isinstance(physics, Motion):
        raise InputError(
            "`controller` needs equations of motion, and the physics are lagged terms. Write them "
            'as a Motion with integrator="discrete", or estimate one step ahead with noise="arma".'
        )
    channels = ([channel.name for channel in group] for group in (record.inputs, record.outputs))
    loop: Any = close_loop(physics, controller, *channels)
    return loop


def controller_of(motion: Motion) -> Controller | None:
    """Return the controller around a motion; None where there is none."""
    return getattr(motion, "controller", None)


def _check_channels(motion: Motion, controller: Controller, inputs: Sequence[str]) -> None:
    """Raise InputError unless each input of the plant is set, once."""
    for name in controller.held:
        if name not in motion.inputs:
            hint = nearest(name, motion.inputs) or (
                f"; its inputs are {', '.join(motion.inputs) or 'none'}."
            )
            raise InputError(f"controller: its output '{name}' is no input of the motion{hint}")
        if name in inputs:
            raise InputError(
                f"controller: '{name}' is its output and an input of the data. Leave it out of "
                "the inputs, for it is simulated; list it in the outputs to fit it as well."
            )
    for name in motion.inputs:
        if name not in (*controller.held, *inputs):
            hint = nearest(name, (*controller.held, *inputs)) or ";"
            raise InputError(
                f"controller: the motion's input '{name}' is set neither by it nor by the data"
                f"{hint} expected an output of the controller or an input of the data."
            )


def _check_names(motion: Motion, controller: Controller, inputs: Sequence[str]) -> None:
    """Raise InputError for a name of the controller that is one of something else."""
    taken: dict[str, str] = dict.fromkeys((name for name, _ in motion.constants), "a constant")
    taken |= dict.fromkeys(motion.names, "a parameter of the motion")
    taken |= dict.fromkeys((name for name, _ in motion.definitions), "a definition of the motion")
    taken |= dict.fromkeys(motion.names_of_states, "a state of the motion")
    taken |= dict.fromkeys((output.name for output in motion.outputs), "an output")
    taken |= dict.fromkeys(inputs, "an input of the data")
    taken |= dict.fromkeys(controller.held, "an output of the controller")
    groups: Mapping[str, Sequence[str]] = {
        "a state of the controller": [state.name for state in controller.states],
        "a parameter of the controller": controller.names,
        "a constant of the controller": [
            name
            for name, value in controller.constants
            if dict(motion.constants).get(name) != value
        ],
        "a definition of the controller": [name for name, _ in controller.definitions],
    }
    for what, names in groups.items():
        for name in names:
            if name in taken:
                raise InputError(
                    f"controller: '{name}' is {taken[name]} and {what}; give one of them another "
                    "name."
                )
            taken[name] = what
