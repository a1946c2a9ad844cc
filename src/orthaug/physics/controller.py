"""A discrete controller: what it makes of references and measured outputs, once a sample.

At sample k it reads the references r_k, the outputs y_k and its states z_k. Its outputs are inputs
of the plant and are held until the next sample:

    u_k = K(r_k, y_k, z_k),    z_{k+1} = L(r_k, y_k, z_k, u_k)

`close_loop` (`physics.closed_loop`) joins it with equations of motion. No JAX.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from orthaug._base.checks import check_finite, check_unique, is_number
from orthaug._base.errors import InputError, show
from orthaug.data.expressions import FUNCTIONS, is_name
from orthaug.physics.parameters import PhysicalParameter, check_parameters
from orthaug.physics.states import State

_ERROR, _STATE = "controller_error", "controller_{}"
_INTEGRAL, _FILTERED = "controller_integral", "controller_filtered"


@dataclass(frozen=True)
class Controller:
    """A discrete controller; make one with `from_equations`, `from_transfer_function` or `pid`.

    `outputs` are the plant's inputs that it sets with their expressions. The `derivative` of a
    state is its value one sample later. `parameters` are estimated, `constants` are known.

    Examples:
        >>> controller = Controller.pid("force", "reference", "angle", Kp=20.0, Kd=2.0)
        >>> controller.outputs[0][1]
        '(20.0)*controller_error + (2.0)*(controller_error - controller_filtered)/(0.0 + Ts)'
    """

    outputs: tuple[tuple[str, str], ...]
    states: tuple[State, ...] = ()
    parameters: tuple[PhysicalParameter, ...] = ()
    constants: tuple[tuple[str, float], ...] = ()
    definitions: tuple[tuple[str, str], ...] = ()
    """Names for longer expressions."""

    @classmethod
    def from_equations(
        cls,
        outputs: Mapping[str, str],
        states: Sequence[State] = (),
        parameters: Sequence[PhysicalParameter] = (),
        *,
        constants: Mapping[str, float] | None = None,
        define: Mapping[str, str] | None = None,
    ) -> Controller:
        """Return a controller of expressions.

        They use the names of the record's inputs, of measured outputs, of the controller's states,
        definitions, parameters and constants, of the motion's parameters and constants, and `Ts`.
        Equations of states may use the controller's outputs as well.

        Args:
            outputs: an expression for each input of the plant that it sets.
            states: with their value one sample later; `start` is a first guess.
            parameters: what is estimated.
            constants: what is known.
            define: names for longer expressions.

        Raises:
            InputError: no outputs, states without an equation, or names that cannot be.
        """
        constants, define = dict(constants or {}), dict(define or {})
        if not isinstance(outputs, Mapping) or not outputs:
            raise InputError(
                "the controller has no outputs; give an expression for each input of the plant "
                "that it sets."
            )
        check_unique((state.name for state in states), "state of the controller")
        for name in (*outputs, *(state.name for state in states), *define):
            if not is_name(name, FUNCTIONS):
                raise InputError(
                    f"{show(name)} cannot be a name in the controller; use letters, digits and "
                    "underscores, not starting with a digit."
                )
        for state in states:
            if state.derivative is None:
                raise InputError(
                    f"the controller's state '{state.name}' has no `next`; give its value one "
                    "sample later."
                )
            if state.learned:
                raise InputError(
                    f"the controller's state '{state.name}' is learned; a learner belongs to the "
                    "plant: leave `learned` out."
                )
        if parameters:
            check_parameters(parameters, constants, FUNCTIONS)
        for name, value in constants.items():
            check_finite(value, f"the controller's constant '{name}'")
        return cls(
            outputs=tuple((name, str(text)) for name, text in outputs.items()),
            states=tuple(states),
            parameters=tuple(parameters),
            constants=tuple(sorted((name, float(value)) for name, value in constants.items())),
            definitions=tuple((name, str(text)) for name, text in define.items()),
        )

    @classmethod
    def from_transfer_function(
        cls,
        output: str,
        reference: str,
        measured: str,
        numerator: Sequence[float | str],
        denominator: Sequence[float | str],
        parameters: Sequence[PhysicalParameter] = (),
        *,
        constants: Mapping[str, float] | None = None,
    ) -> Controller:
        """Return `u = B(z)/A(z) (r − y)`.

        Args:
            output: the plant's input that it sets.
            reference: an input of the record.
            measured: the output that is fed back.
            numerator: coefficients of falling powers of z; numbers, or expressions of parameters
                and constants.
            denominator: likewise.
            parameters: what is estimated.
            constants: what is known.

        Raises:
            InputError: coefficients that cannot be, or more powers above than below.
        """
        above, below = (
            _coefficients(numerator, "numerator"),
            _coefficients(denominator, "denominator"),
        )
        if len(above) > len(below):
            raise InputError(
                f"the controller's transfer function is improper: its numerator has degree "
                f"{len(above) - 1}, its denominator {len(below) - 1}. It would need later errors; "
                "give a denominator of the numerator's degree at least."
            )
        above = ["0.0"] * (len(below) - len(above)) + above
        lead = below[0]
        above, below = ([f"({one})/({lead})" for one in side] for side in (above, below))
        names = [_STATE.format(i) for i in range(1, len(below))]
        states = []
        for i, name in enumerate(names):
            following = f" + {names[i + 1]}" if i + 1 < len(names) else ""
            text = f"{above[i + 1]}*{_ERROR} - {below[i + 1]}*{output}{following}"
            states.append(State(name, text, 0.0))
        first = f" + {names[0]}" if names else ""
        return cls.from_equations(
            {output: f"{above[0]}*{_ERROR}{first}"},
            states,
            parameters,
            constants=constants,
            define={_ERROR: f"{reference} - {measured}"},
        )

    @classmethod
    def pid(
        cls,
        output: str,
        reference: str,
        measured: str,
        *,
        Kp: float | str = 0.0,  # noqa: N803  (the names of the field)
        Ki: float | str = 0.0,  # noqa: N803
        Kd: float | str = 0.0,  # noqa: N803
        filter: float | str = 0.0,
        parameters: Sequence[PhysicalParameter] = (),
        constants: Mapping[str, float] | None = None,
    ) -> Controller:
        """Return `u = (Kp + Ki Ts z/(z − 1) + Kd / (filter + Ts z/(z − 1))) (r − y)`.

        Integral and derivative are by backward differences.

        Args:
            output: the plant's input that it sets.
            reference: an input of the record.
            measured: the output that is fed back.
            Kp: gain of the error; as all, a number or an expression of parameters and constants.
            Ki: gain of its integral, 1/s.
            Kd: gain of its derivative, s.
            filter: time constant [s] of the derivative's filter.
            parameters: what is estimated.
            constants: what is known.

        Raises:
            InputError: no gain, or values that are neither numbers nor expressions.
        """
        given = {"Kp": Kp, "Ki": Ki, "Kd": Kd, "filter": filter}
        texts = {name: _coefficient(value, f"`{name}`") for name, value in given.items()}
        used = {name for name, value in given.items() if isinstance(value, str) or value != 0}
        if not used & {"Kp", "Ki", "Kd"}:
            raise InputError("the controller has no gain; give at least one of Kp, Ki and Kd.")
        if is_number(filter) and float(filter) < 0:
            raise InputError(
                f"`filter` must be a time constant in s, 0 or more; got {show(filter)}."
            )
        states, terms = [], []
        if "Kp" in used:
            terms.append(f"({texts['Kp']})*{_ERROR}")
        if "Ki" in used:
            following = f"{_INTEGRAL} + Ts*{_ERROR}"
            states.append(State(_INTEGRAL, following, 0.0))
            terms.append(f"({texts['Ki']})*({following})")
        if "Kd" in used:
            within, moved = f"({texts['filter']} + Ts)", f"({_ERROR} - {_FILTERED})"
            states.append(State(_FILTERED, f"{_FILTERED} + Ts*{moved}/{within}", 0.0))
            terms.append(f"({texts['Kd']})*{moved}/{within}")
        return cls.from_equations(
            {output: " + ".join(terms)},
            states,
            parameters,
            constants=constants,
            define={_ERROR: f"{reference} - {measured}"},
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def held(self) -> tuple[str, ...]:
        """Names of the plant's inputs that it sets."""
        return tuple(name for name, _ in self.outputs)


def _coefficients(given: object, what: str) -> list[str]:
    """Return coefficients as text, without zeros in front.

    Raises:
        InputError: none, or other than numbers and expressions.
    """
    if isinstance(given, str) or not isinstance(given, Sequence) or not len(given):
        raise InputError(
            f"the controller's `{what}` must be a list of coefficients of falling powers of z; "
            f"got {show(given)}."
        )
    listed = list(given)
    while listed and is_number(listed[0]) and float(listed[0]) == 0.0:
        del listed[0]
    if not listed:
        raise InputError(f"the controller's `{what}` is zero; give a coefficient that is not.")
    return [_coefficient(one, f"the controller's `{what}`") for one in listed]


def _coefficient(value: Any, what: str) -> str:
    """Return a number or an expression as text.

    Raises:
        InputError: anything else.
    """
    if isinstance(value, str) and value.strip():
        return value
    if not is_number(value):
        raise InputError(
            f"{what} must be a number, or an expression of parameters and constants; got "
            f"{show(value)}."
        )
    return repr(float(value))
