"""Equations of motion `ẋ = f(x, u; p)`, `y = h(x, u; p)`, with parameters anywhere in them.

A learner may be added to some of the equations and outputs. `derivative` is that of a state in
time; of a `discrete` motion it is the state one sample later. No JAX.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from orthaug._base.checks import (
    Matrix,
    Vector,
    check_all,
    check_choice,
    check_label,
    check_unique,
    is_number,
    nearest,
)
from orthaug._base.errors import InputError, show
from orthaug._base.jax import ArrayModule
from orthaug._base.views import NotebookView
from orthaug.data.expressions import (
    FUNCTIONS,
    SAMPLING_TIME,
    Expression,
    in_order,
    is_name,
    parse_named,
)
from orthaug.data.record import Record
from orthaug.physics.baseline import check_sampling_constant
from orthaug.physics.differences import Difference, differences_in
from orthaug.physics.integrators import INTEGRATORS, Integrator
from orthaug.physics.mass_matrix import NO_MASS, MassMatrix
from orthaug.physics.parameters import (
    Coordinates,
    PhysicalParameter,
    check_not_sampling_time,
    check_parameters,
)
from orthaug.physics.states import Origin, Output, State, check_given

HOLDS = ("zero-order", "first-order", "spline")
MOST_SUBSTEPS = 256


@dataclass(frozen=True)
class Motion(NotebookView):
    """Equations of motion; make one with `from_equations` or `from_functions`.

    Hashable.

    Examples:
        >>> motion = Motion.from_equations(
        ...     states=[State("v", "(force - c*v)/m", start=0.0)],
        ...     outputs=[Output("speed", "v")], inputs=["force"],
        ...     parameters=[
        ...         PhysicalParameter("m", 2.0, "kg", min=0), PhysicalParameter("c", 1.0, "N s/m")
        ...     ],
        ... )
        >>> motion.rates(np.array([3.0]), np.array([1.0]), motion.initial, np)
        array([-1.])
    """

    states: tuple[State, ...]
    outputs: tuple[Output, ...]
    inputs: tuple[str, ...]
    parameters: tuple[PhysicalParameter, ...]
    constants: tuple[tuple[str, float], ...] = ()
    definitions: tuple[tuple[str, Expression], ...] = ()
    """Names for longer expressions, each after those that it uses."""
    integrator: str = "auto"
    # Not compared: a compiled program has the number that was chosen, declared or not
    substeps: int | None = field(default=None, compare=False)
    """Steps of the integrator in a sample; None to choose them by the data."""
    hold: str = "zero-order"
    functions: tuple[Callable[..., Any], Callable[..., Any]] | None = None
    """f(x, u, p) and h(x, u, p) on JAX arrays, instead of expressions."""
    source: Origin | None = field(default=None, compare=False, repr=False)
    """Where the functions come from, so that a saved model finds them again."""
    mass: MassMatrix = NO_MASS
    """Where what is added to the equations are forces."""

    @property
    def scheme(self) -> Integrator:
        """The integrator."""
        return INTEGRATORS[self.integrator]()

    @property
    def equation_key(self) -> str:
        """The key of a state's equation in a declaration."""
        return "next" if self.scheme.discrete else "derivative"

    @property
    def declaration(self) -> dict[str, Any]:
        """The fields of a motion by name, without those of its kind."""
        return {field.name: getattr(self, field.name) for field in fields(Motion)}

    @classmethod
    def from_equations(
        cls,
        states: Sequence[State],
        outputs: Sequence[Output],
        parameters: Sequence[PhysicalParameter],
        inputs: Sequence[str] = (),
        *,
        constants: Mapping[str, float] | None = None,
        define: Mapping[str, str] | None = None,
        integrator: str = "auto",
        substeps: int | None = None,
        hold: str = "zero-order",
    ) -> Motion:
        """Return a motion of expressions.

        They use the names of states, inputs, parameters, constants and definitions.

        Args:
            inputs: names of the input channels, in the record's order.
            define: names for longer expressions.
            integrator: "rk4" (Runge-Kutta of order 4), "exact" (the linear part by matrix
                exponential), "auto" ("exact" where "rk4" needs many more substeps), "discrete", or
                another of `INTEGRATORS`.
            substeps: steps of the integrator in a sample, 1 to 256; None to choose them by the
                data.
            hold: inputs between samples: "zero-order" (a value is held), "first-order" (straight)
                or "spline".

        Raises:
            InputError: names or expressions that cannot be, definitions that need each other,
                parameters that no equation uses, an output that no state enters.
        """
        constants, define = dict(constants or {}), dict(define or {})
        check_all(states, State, "states", 'State("x", "u - a*x")')
        check_all(outputs, Output, "outputs", 'Output("y", "x")')
        check_all(parameters, PhysicalParameter, "parameters", 'PhysicalParameter("a", 1.0)')
        check_all(inputs, str, "inputs", '"u"')
        plain = cls._from_declared(
            states,
            outputs,
            inputs,
            parameters,
            constants,
            integrator,
            substeps,
            hold,
            tuple(define),
        )
        known = (
            dict.fromkeys((*plain.names_of_states, *plain.inputs, *plain.names), 1.0) | constants
        )
        known.setdefault(SAMPLING_TIME, 1.0)
        everything = known | dict.fromkeys(define, 1.0)
        parsed = {
            name: parse_named(text, everything, f"motion.define '{name}'")
            for name, text in define.items()
        }
        motion = replace(
            plain, definitions=tuple((name, parsed[name]) for name in in_order(parsed))
        )
        for state in plain.states:
            if state.derivative is None:
                raise InputError(
                    f"the state '{state.name}' has no `{plain.equation_key}`; give its equation."
                )
            parse_named(state.derivative, everything, f"the equation of '{state.name}'")
        for output in plain.outputs:
            if output.expression is None:
                raise InputError(
                    f"the output '{output.name}' has no expression; give it in terms of the states."
                )
            parse_named(output.expression, everything, f"the output '{output.name}'")
        motion._check_used()
        return motion

    @classmethod
    def from_functions(
        cls,
        f: Callable[..., object],
        h: Callable[..., object],
        states: Sequence[State | str],
        outputs: Sequence[Output | str],
        parameters: Sequence[PhysicalParameter],
        inputs: Sequence[str] = (),
        *,
        integrator: str = "auto",
        substeps: int | None = None,
        hold: str = "zero-order",
        mass: MassMatrix = NO_MASS,
    ) -> Motion:
        """Return a motion of JAX functions f(x, u, p) → (nx,) and h(x, u, p) → (ny,).

        The vectors are states, inputs and parameters.

        Args:
            mass: where a learner adds forces rather than rates.

        Raises:
            InputError: names that cannot be, or what is no function; a discrete motion with a mass
                matrix.
        """
        for name, function in (("f", f), ("h", h)):
            if not callable(function):
                raise InputError(
                    f"`{name}` must be a function {name}(x, u, p); got {show(function)}."
                )
        states = [State(state) if isinstance(state, str) else state for state in states]
        outputs = [Output(output) if isinstance(output, str) else output for output in outputs]
        plain = cls._from_declared(
            states, outputs, inputs, parameters, {}, integrator, substeps, hold
        )
        mass.check(len(plain.states), plain.scheme.discrete)
        return replace(plain, functions=(f, h), mass=mass)

    @classmethod
    def _from_declared(
        cls,
        states: Sequence[State],
        outputs: Sequence[Output],
        inputs: Sequence[str],
        parameters: Sequence[PhysicalParameter],
        constants: Mapping[str, float],
        integrator: str,
        substeps: int | None,
        hold: str,
        defined: Sequence[str] = (),
    ) -> Motion:
        if integrator not in INTEGRATORS:
            INTEGRATORS.discover()
        check_choice(integrator, INTEGRATORS, "`integrator`")
        check_choice(hold, HOLDS, "`hold`")
        whole = isinstance(substeps, int | np.integer) and not isinstance(substeps, bool)
        if substeps is not None and not (whole and 1 <= substeps <= MOST_SUBSTEPS):
            raise InputError(
                f"`substeps` must be a whole number from 1 to {MOST_SUBSTEPS}; got "
                f"{show(substeps)}."
            )
        if INTEGRATORS[integrator].discrete and hold != "zero-order":
            raise InputError("a discrete motion has no input between samples; leave `hold` out.")
        if not states:
            raise InputError("the motion has no states; give at least one with its equation.")
        if not outputs:
            raise InputError(
                "the motion has no outputs; give an expression of the states for each measured "
                "channel."
            )
        check_parameters(parameters, constants, FUNCTIONS)
        motion = cls(
            states=tuple(states),
            outputs=tuple(outputs),
            inputs=tuple(inputs),
            parameters=tuple(parameters),
            constants=tuple(sorted((name, float(value)) for name, value in constants.items())),
            integrator=integrator,
            substeps=None if substeps is None else int(substeps),
            hold=hold,
        )
        motion._check_names(defined)
        for state in motion.states:
            motion._check_start(state)
        return motion

    def _check_names(self, defined: Sequence[str]) -> None:
        groups = {
            "a state": self.names_of_states,
            "an input": self.inputs,
            "a parameter": self.names,
            "a constant": tuple(name for name, _ in self.constants),
            "a definition": tuple(defined),
        }
        owner: dict[str, str] = {}
        for what, names in groups.items():
            check_unique(names, what.split()[-1])
            for name in names:
                if what != "a constant":  # one of the sampling time's own value does no harm
                    check_not_sampling_time(name, what)
                if not is_name(name, FUNCTIONS):
                    raise InputError(
                        f"{show(name)} cannot name {what}; use letters, digits and "
                        "underscores, not starting with a digit, and none of "
                        f"{', '.join(sorted(FUNCTIONS))}."
                    )
                if name in owner:
                    raise InputError(
                        f"'{name}' is {owner[name]} and {what}; give one of them another name."
                    )
                owner[name] = what
        check_unique((output.name for output in self.outputs), "output")

    def _check_start(self, state: State) -> None:
        check_label(state.unit, f"the unit of '{state.name}'")
        start, source = state.start, state.from_output
        if source is not None:
            known = [output.name for output in self.outputs]
            if source[0] not in known:
                hint = nearest(source[0], known) or ";"
                raise InputError(
                    f"the state '{state.name}' starts from '{start}'{hint} expected a number, "
                    f"an output ({', '.join(known)}), or 'derivative of' one."
                )
        elif start is not None and not is_number(start):
            raise InputError(
                f"the start of '{state.name}' must be a finite number or an output; got "
                f"{show(start)}."
            )

    def _check_used(self) -> None:
        """Raise InputError unless every parameter is used and every output depends on a state."""
        used: set[str] = set()
        for state in self.states:
            used |= self.names_in(self.equations[state.name])
        for output, expression in zip(self.outputs, self.observations, strict=True):
            there = self.names_in(expression)
            used |= there
            if not there & set(self.names_of_states):
                raise InputError(
                    f"the output '{output.name}' = {expression} contains no state; expected "
                    f"one of {', '.join(self.names_of_states)} in it."
                )
        for name in self.names:
            if name not in used:
                raise InputError(
                    f"the parameter '{name}' is in no equation and no output; use or remove it."
                )

    def names_in(self, *expressions: Expression) -> set[str]:
        """Return the names of expressions, and those of the definitions that they use."""
        found = {name for expression in expressions for name in expression.names}
        for name, given in reversed(self.definitions):  # each after those that it uses
            if name in found:
                found |= set(given.names)
        return found

    def parameters_in(self, state: str) -> tuple[str, ...]:
        """Return the parameters in a state's equation, for a motion with expressions."""
        there = self.names_in(self.equations[state])
        return tuple(name for name in self.names if name in there)

    def parameters_of_output(self, i: int) -> tuple[str, ...]:
        """Return the parameters in output i's expression, for a motion with expressions."""
        there = self.names_in(self.observations[i])
        return tuple(name for name in self.names if name in there)

    @property
    def names_of_states(self) -> tuple[str, ...]:
        """Names of x in order."""
        return tuple(state.name for state in self.states)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of p in order."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def learned(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """The numbers of the states and of the outputs that a learner is added to."""
        states = tuple(i for i, state in enumerate(self.states) if state.learned)
        return states, tuple(i for i, output in enumerate(self.outputs) if output.learned)

    @property
    def memory(self) -> tuple[str, ...]:
        """Names of the learner's own states, which follow those of the physics."""
        return tuple(state.name for state in self.states if state.memory)

    @property
    def without_memory(self) -> Motion:
        """The motion without the learner's own states."""
        if not self.memory:
            return self
        return replace(self, states=tuple(s for s in self.states if not s.memory))

    @property
    def predicts(self) -> bool:
        """True if its states follow the measured outputs: a predictor."""
        return False

    @property
    def held(self) -> tuple[str, ...]:
        """Names of the inputs that a controller sets: the first ones, held over a sample."""
        return ()

    @property
    def external(self) -> tuple[str, ...]:
        """Names of the inputs that a record gives."""
        return self.inputs[len(self.held) :]

    @property
    def discrete_states(self) -> tuple[str, ...]:
        """Names of states that change at samples only: those of a controller."""
        return ()

    @property
    def expressions(self) -> tuple[Expression, ...]:
        """Every expression of the physics; none of a motion with functions."""
        if self.functions is not None:
            return ()
        defined = (one for _, one in self.definitions)
        return (*self.equations.values(), *defined, *self.observations)

    @property
    def state_units(self) -> dict[str, str]:
        """The declared unit of each state."""
        return {state.name: state.unit for state in self.states}

    @property
    def measured_states(self) -> dict[str, str]:
        """The state that each output is, where its expression is the state alone."""
        texts = {output.name: (output.expression or "").strip() for output in self.outputs}
        return {name: text for name, text in texts.items() if text in self.names_of_states}

    @property
    def differences(self) -> tuple[Difference, ...]:
        """Differences of two visible states or inputs that occur in an expression, each once.

        Empty for a motion with functions.
        """
        if self.functions is not None:
            return ()
        every = (*self.equations.values(), *(one for _, one in self.definitions))
        found = differences_in(every, dict(self.constants))
        return tuple(one for one in found if one.names <= {*self.visible})

    @property
    def visible(self) -> tuple[str, ...]:
        """Names of states and inputs that a learner may see."""
        return (*self.visible_states, *self.inputs)

    @property
    def visible_states(self) -> tuple[str, ...]:
        """Names of states that a learner may see: all but a controller's."""
        return tuple(name for name in self.names_of_states if name not in self.discrete_states)

    def around(self, plant: Motion) -> Motion:
        """Return another plant with the same controller around it, if there is one."""
        return plant

    @property
    def driving(self) -> tuple[str, ...]:
        """Names of the record's inputs that drive the equations between samples."""
        return tuple(name for name in self.external if name in self.visible)

    @property
    def unread(self) -> tuple[str, ...]:
        """Names of the record's inputs that no expression reads; none where there is none."""
        read = set().union(*self._read) if self.functions is None else set(self.external)
        return tuple(name for name in self.external if name not in read)

    @property
    def plant(self) -> Motion:
        """The motion without a controller around it."""
        return self

    def control(self, y: Any, x: Any, u: Any, p: Any, xp: ArrayModule) -> Any:
        """Return the inputs (held, …) that a controller sets at a sample.

        From outputs y (ny, …), states x (nx, …), and inputs u (external, …) of the record.
        """
        return u[:0]

    def after_sample(self, following: Any, y: Any, x: Any, u: Any, p: Any, xp: ArrayModule) -> Any:
        """Return the next states (nx, …), with those that change at samples.

        `following` are the integrated ones, `u` (nu, …) all inputs at the sample before.
        """
        return following

    def inputs_at(self, x: Matrix, u: Matrix, p: Vector, xp: ArrayModule) -> Matrix:
        """Return all inputs (nu, …) at samples with states x (nx, …), from the record's."""
        if not self.held:
            return u
        nothing = xp.zeros((len(self.held), *u.shape[1:]))
        y = self.observed(x, xp.concatenate([nothing, u]), p, xp)
        return xp.concatenate([self.control(y, x, u, p, xp), u])

    @property
    def names_taken(self) -> list[str]:
        """Names that a further parameter cannot have."""
        return list(self.known)

    @property
    def known(self) -> dict[str, float]:
        """Every name that expressions may use."""
        named = dict.fromkeys((*self.names_of_states, *self.inputs, *self.names), 1.0) | dict(
            self.constants
        )
        return (
            {SAMPLING_TIME: 1.0}
            | named
            | dict.fromkeys((name for name, _ in self.definitions), 1.0)
        )

    def sampled(self, sampling_time: float) -> Motion:
        """Return the motion with this value [s] of `Ts`.

        Raises:
            InputError: a constant `Ts` of another value.
        """
        check_sampling_constant(self.constants, sampling_time)
        if SAMPLING_TIME in dict(self.constants):
            return self
        step = float(sampling_time)
        constants = tuple(sorted((*self.constants, (SAMPLING_TIME, step))))
        if self.functions is None:
            return replace(self, constants=constants)
        f, h = self.functions
        return replace(self, constants=constants, functions=(_sampled(f, step), _sampled(h, step)))

    def check_paced(self, record: Record) -> None:
        """Raise InputError unless the motion can step between uneven instants."""
        if self.scheme.splits_linear_part or self.scheme.discrete:
            record.check_even(f'`integrator = "{self.integrator}"`')
        if self.held:
            record.check_even("a controller, which acts at every sample,")
        texts = (*self.equations.values(), *(given for _, given in self.definitions))
        if any(SAMPLING_TIME in expression.names for expression in texts):
            record.check_even(f"an equation with the sampling time {SAMPLING_TIME}")

    @cached_property
    def equations(self) -> dict[str, Expression]:
        """The parsed equation of each state."""
        return {
            s.name: parse_named(s.derivative, self.known, f"the equation of '{s.name}'")
            for s in self.states
        }

    @cached_property
    def observations(self) -> tuple[Expression, ...]:
        """The parsed expression of each output."""
        return tuple(
            parse_named(o.expression, self.known, f"the output '{o.name}'") for o in self.outputs
        )

    @cached_property
    def size(self) -> int:
        """Return how many operations its expressions have; of a function what it says of itself."""
        if self.functions is not None:
            return getattr(self.functions[0], "operations", 0)
        every = (
            *self.equations.values(),
            *self.observations,
            *(given for _, given in self.definitions),
        )
        return sum(
            isinstance(node, ast.BinOp | ast.UnaryOp | ast.Call)
            for e in every
            for node in ast.walk(e.tree)
        )

    @cached_property
    def _read(self) -> tuple[set[str], set[str]]:
        """Return what the equations need of the names, and what the outputs do."""
        return self.names_in(*self.equations.values()), self.names_in(*self.observations)

    def values(
        self, x: Any, u: Any, p: Any, xp: Any, needed: Collection[str] | None = None
    ) -> dict[str, Any]:
        """Return the value of every name; x (nx, …), u (nu, …), p (np,).

        Of the definitions only those that are needed.
        """
        values = dict(self.constants)
        values |= dict(zip(self.names, p, strict=True))
        values |= dict(zip(self.names_of_states, x, strict=True))
        values |= dict(zip(self.inputs, u, strict=True))
        for name, expression in self.definitions:
            if needed is None or name in needed:
                values[name] = expression.value(values, xp)
        return values

    def rates(self, x: Any, u: Any, p: Any, xp: Any) -> Any:
        """Return f(x, u; p) (nx, …) by `xp` (numpy or jax.numpy).

        Of a discrete motion this is the next state.
        """
        if self.functions is not None:
            return xp.asarray(self.functions[0](x, u, p))
        equations = [self.equations[state.name] for state in self.states]
        return _stack(equations, self.values(x, u, p, xp, self._read[0]), x, xp)

    def observed(self, x: Any, u: Any, p: Any, xp: Any) -> Any:
        """Return h(x, u; p) (ny, …)."""
        if self.functions is not None:
            return xp.asarray(self.functions[1](x, u, p))
        return _stack(self.observations, self.values(x, u, p, xp, self._read[1]), x, xp)

    def term_without_value(self, i: int, x: Vector, u: Vector) -> str:
        """Return the name and value of a term of equation i that is not finite, or nothing.

        Outputs are counted after states; the point is (nx,) and (nu,).
        """
        if self.functions is not None:
            return ""
        with np.errstate(all="ignore"):
            values = self.values(x, u, self.initial, np)
        definitions = dict(self.definitions)
        term, names = (*self.equations.values(), *self.observations)[i].term_without_value(values)
        while len(names) == 1 and term in definitions:  # a name for what has no value
            term, names = definitions[term].term_without_value(values)
        at = ", ".join(f"{name} = {float(values[name]):.4g}" for name in dict.fromkeys(names))
        return f"{term} at {at}" if at else term

    @property
    def initial(self) -> Vector:
        """p⁰ (np,)."""
        return np.array([parameter.initial for parameter in self.parameters], dtype=float)

    @property
    def coordinates(self) -> Coordinates:
        """The map from p to the coordinates that are estimated."""
        return Coordinates(self.parameters)

    def check_channels(self, inputs: Sequence[str], outputs: Sequence[str]) -> None:
        """Raise InputError unless these are the record's channels."""
        given = [output.name for output in self.outputs]
        for name in outputs:
            if name not in given:
                raise InputError(
                    f"the output '{name}' has no expression in the motion; it gives "
                    f"{', '.join(given)}."
                )
        check_given(given, outputs)
        if tuple(inputs) != self.external or [*outputs] != given:
            raise InputError(
                f"the motion has the inputs {', '.join(self.external) or 'none'} and the outputs "
                f"{', '.join(given)}; the record has {', '.join(inputs) or 'none'} and "
                f"{', '.join(outputs)}. Give them in one order."
            )


def _sampled(function: Any, step: float) -> Callable[..., Any]:
    """Return a function with the time [s] between samples, if it has a use for it."""
    return function.sampled(step) if hasattr(function, "sampled") else function


def _stack(equations: Sequence[Expression], values: Mapping[str, Any], x: Any, xp: Any) -> Any:
    """Return the values of equations, (n, …), at states (nx, …)."""
    found = [xp.asarray(one.value(values, xp), dtype=float) for one in equations]
    return xp.stack([xp.broadcast_to(value, x.shape[1:]) for value in found])
