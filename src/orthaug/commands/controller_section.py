"""The section [controller] of a spec: equations, a transfer function or the gains of a PID."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from pydantic import Field, model_validator

from orthaug._base.checks import nearest
from orthaug._base.errors import InputError
from orthaug.commands.sections import Finite, PhysicalSection, Section
from orthaug.physics.closed_loop import ClosedLoop, close_loop
from orthaug.physics.controller import Controller
from orthaug.physics.states import State

if TYPE_CHECKING:
    from orthaug.commands.data_sections import MotionSection

Text = Annotated[str, Field(min_length=1)]
Coefficients = Annotated[list[Finite | Text], Field(min_length=1)]


class ControllerStateSection(Section):
    """A state of the controller: its value one sample later, and where it starts."""

    next: Text | Finite
    start: Finite | Text | None = 0.0
    unit: str = ""


class ControllerSection(Section):
    """A discrete controller around a motion."""

    ways: ClassVar[dict[str, tuple[str, ...]]] = {
        "equations": ("outputs", "states", "define"),
        "a transfer function": ("numerator", "denominator"),
        "the gains of a PID": ("Kp", "Ki", "Kd", "filter"),
    }
    outputs: dict[str, Text | Finite] = {}
    states: dict[str, ControllerStateSection] = {}
    define: dict[str, Text] = {}
    output: Text | None = None
    reference: Text | None = None
    measured: Text | None = None
    numerator: Coefficients = []
    denominator: Coefficients = []
    Kp: Finite | Text = 0.0
    Ki: Finite | Text = 0.0
    Kd: Finite | Text = 0.0
    filter: Finite | Text = 0.0
    parameters: dict[str, PhysicalSection] = {}
    constants: dict[str, Finite] = {}

    @property
    def way(self) -> str:
        """Way in which the controller is given."""
        return next(way for way, keys in self.ways.items() if self.model_fields_set & {*keys})

    @model_validator(mode="after")
    def _one_way(self) -> ControllerSection:
        found = {
            way: [key for key in keys if key in self.model_fields_set]
            for way, keys in self.ways.items()
        }
        given = {way: keys for way, keys in found.items() if keys}
        if not given:
            raise ValueError(
                "no controller is given; expected `outputs` with equations, `numerator` and "
                "`denominator`, or gains such as `Kp`"
            )
        if len(given) > 1:
            listed = " and ".join(f"`{keys[0]}` ({way})" for way, keys in given.items())
            raise ValueError(f"found {listed}; expected one of them")
        way = self.way
        if way == "equations":
            self._check_equations()
        else:
            for key in ("numerator", "denominator") if way == "a transfer function" else ():
                if key not in self.model_fields_set:
                    raise ValueError(f"the key `{key}` is missing beside `{given[way][0]}`")
        return self

    def _check_equations(self) -> None:
        if not self.outputs:
            raise ValueError("`outputs` is missing; expected an expression for each of them")
        for key in ("output", "reference", "measured"):
            if key in self.model_fields_set:
                raise ValueError(f"`{key}`: found beside equations, which name their signals")

    def declared(self, inputs: Sequence[str], outputs: Sequence[str]) -> Controller:
        """Return the controller over the channels of the data.

        Raises:
            InputError: names, coefficients or gains that cannot be.
        """
        parameters = [section.declared(name) for name, section in self.parameters.items()]
        if self.way == "equations":
            return Controller.from_equations(
                {name: str(text) for name, text in self.outputs.items()},
                [State(n, str(s.next), s.start, unit=s.unit) for n, s in self.states.items()],
                parameters,
                constants=self.constants,
                define=self.define,
            )
        if self.output is None:
            raise InputError(
                "controller: the key `output` is missing; expected the plant's input that it sets."
            )
        measured = [name for name in outputs if name != self.output]
        signals = (
            self.output,
            _chosen(self.reference, inputs, "reference", "inputs"),
            _chosen(self.measured, measured, "measured", "outputs"),
        )
        if self.way == "a transfer function":
            return Controller.from_transfer_function(
                *signals, self.numerator, self.denominator, parameters, constants=self.constants
            )
        return Controller.pid(
            *signals,
            Kp=self.Kp,
            Ki=self.Ki,
            Kd=self.Kd,
            filter=self.filter,
            parameters=parameters,
            constants=self.constants,
        )

    def around(
        self, section: MotionSection, inputs: Sequence[str], outputs: Sequence[str], folder: Path
    ) -> ClosedLoop:
        """Return the motion of a section in the loop of the controller.

        Raises:
            InputError: a motion or a controller that cannot be, or that do not fit together.
        """
        try:
            controller = self.declared(inputs, outputs)
        except InputError as error:
            text = str(error)
            raise InputError(
                text if text.startswith("controller") else f"controller: {text}"
            ) from None
        _check_in_equations(controller, section, (*inputs, *outputs))
        held = controller.held
        given = (*(name for name in held if name not in inputs), *inputs)
        measured = [name for name in outputs if name not in held or name in section.outputs]
        plant = section.motion_of(given, measured, folder)
        return close_loop(plant, controller, inputs, outputs)


def _chosen(name: str | None, channels: Sequence[str], key: str, group: str) -> str:
    """Return a channel that a key names, or the only one there is."""
    if name is None:
        if len(channels) == 1:
            return channels[0]
        raise InputError(
            f"controller: the key `{key}` is missing; expected one of `data.{group}`: "
            f"{', '.join(channels) or 'none'}."
        )
    if name not in channels:
        hint = nearest(name, channels) or f"; its {group} are {', '.join(channels) or 'none'}."
        raise InputError(
            f"controller: `{key}` is '{name}', which is none of the {group} of the data{hint}"
        )
    return name


def _check_in_equations(
    controller: Controller, section: MotionSection, channels: Sequence[str]
) -> None:
    """Raise InputError for an output of the controller that no equation of the motion uses."""
    texts = [str(s.next if section.discrete else s.derivative) for s in section.states.values()]
    texts += [o if isinstance(o, str) else o.expression for o in section.outputs.values()]
    words = set(re.findall(r"[^\W\d]\w*", " ".join([*texts, *section.define.values()])))
    known = {*section.states, *section.parameters, *section.constants, *section.define, *channels}
    for name in controller.held:
        if name not in words:
            hint = nearest(name, sorted(words - known)) or "; expected an input of the motion."
            raise InputError(
                f"controller: its output '{name}' is in no equation of the motion{hint}"
            )
