"""Physics that is written elsewhere: a source returns a `Motion` for the channels of a record.

A source is a declaration, found by its kind. Packages add kinds by entry points of the group
`orthaug.systems`. `FileSource` reads one file, whose quantities have names: parameters, states,
inputs and outputs are chosen by them. Such a motion is one of functions. It is estimated, split
from a learner, saved and reported as any other.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from orthaug._base.checks import check_type, is_number, nearest
from orthaug._base.errors import InputError, show
from orthaug._base.registry import LIBRARY_ONLY
from orthaug.data.record import Record
from orthaug.physics.mass_matrix import NO_MASS, MassMatrix
from orthaug.physics.motion import Motion
from orthaug.physics.parameters import PhysicalParameter
from orthaug.physics.states import Output, State

_SHOWN = 12  # names in a message
_OF_PARAMETER = {"initial": float, "min": float, "max": float, "unit": str}
Changes = Mapping[str, Mapping[str, float | str]]
"""What a spec says of parameters beside their names: `initial`, `min`, `max`, `unit`."""
Functions = tuple[Callable[..., Any], Callable[..., Any]]


@dataclass(frozen=True, kw_only=True)
class PhysicsSource:
    """Physics from elsewhere: a subclass has fields, which are its keys, and `motion_of`.

    Args:
        integrator, substeps, hold: of the motion; a spec has them in `[motion]`.
    """

    integrator: str = field(default="auto", metadata=LIBRARY_ONLY)
    substeps: int | None = field(default=None, metadata=LIBRARY_ONLY)
    hold: str = field(default="zero-order", metadata=LIBRARY_ONLY)

    def motion_of(self, inputs: Sequence[str], outputs: Sequence[str]) -> Motion:
        """Return the motion for the names of input and output channels, in their order.

        Raises:
            InputError: what the source cannot give.
        """
        raise NotImplementedError

    def motion(self, record: Record) -> Motion:
        """Return the motion for the channels of a record: `estimate(record, source)`."""
        return self.build(*([c.name for c in group] for group in (record.inputs, record.outputs)))

    def build(self, inputs: Sequence[str], outputs: Sequence[str]) -> Motion:
        """Return the motion for channels; one of functions knows its source, so it can be saved."""
        motion = self.motion_of(inputs, outputs)
        return motion if motion.functions is None else replace(motion, source=self)

    def in_folder(self, folder: Path) -> PhysicsSource:
        """Return the source with its file as named from a folder."""
        return self

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that it reads."""
        return ()

    @property
    def compiled(self) -> bool:
        """True if its functions are JAX's; others are calls of the host at every point."""
        return True

    @property
    def learns(self) -> bool:
        """True if a learner is added to any equation or output."""
        return bool(getattr(self, "learned", ()))

    @property
    def options(self) -> dict[str, Any]:
        """Options of the motion, as `Motion.from_functions` takes them."""
        return {"integrator": self.integrator, "substeps": self.substeps, "hold": self.hold}

    def keys(self) -> dict[str, Any]:
        """Return the keys, as a saved model has them."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self)}


@dataclass(frozen=True)
class Quantity:
    """A named number of a file: a parameter, a state, an input or an output."""

    name: str
    unit: str = ""
    value: float | None = None
    low: float | None = None
    high: float | None = None

    @property
    def identifier(self) -> str:
        """The name as expressions take it: `mass_m` for `mass.m`."""
        plain = re.sub(r"\W+", "_", self.name).strip("_")
        return f"_{plain}" if plain[:1].isdigit() else plain


@dataclass(frozen=True)
class Description:
    """The quantities of a file. An output may be whatever the file can compute."""

    states: tuple[Quantity, ...]
    parameters: tuple[Quantity, ...]
    inputs: tuple[Quantity, ...]
    outputs: tuple[Quantity, ...]
    forces: tuple[tuple[str, Quantity], ...] = ()
    """What a learner may be instead of a state's rate, beside the name of the state."""


@dataclass(frozen=True)
class Seen:
    """h(x, u, p) of outputs that are states, by their numbers."""

    states: tuple[int, ...]

    def __call__(self, x: Any, u: Any, p: Any) -> Any:
        return x[np.array(self.states)]


@dataclass(frozen=True, kw_only=True)
class FileSource(PhysicsSource):
    """Physics from a file whose quantities have names; see `FMU`.

    Args:
        file: of the physics; in a spec relative to the spec's folder.
        parameters: names of those that are estimated, or a table of what is changed of each:
            `{"m": {"initial": 2.0, "min": 0.1}}`. The others keep their values.
        inputs: the file's input by the name of a channel, where they differ.
        outputs: the file's quantity by the name of a channel, where they differ.
        starts: of states: a number, an output channel, or "derivative of" one. By default an
            output that is the state, or else the file's own start.
        learned: states and outputs that a learner is added to; forces of a mechanism.
    """

    file: str
    parameters: tuple[str, ...] | Changes = ()
    inputs: Mapping[str, str] = field(default_factory=dict)
    outputs: Mapping[str, str] = field(default_factory=dict)
    starts: Mapping[str, float | str] = field(default_factory=dict)
    learned: tuple[str, ...] = ()

    ending: ClassVar[str] = ""
    """Of the file that a saved model keeps."""
    native: ClassVar[bool] = False
    """True if it holds code that runs with the user's rights."""
    target: ClassVar[str] = ""
    """The name after `orthaug export --to` under which `write_back` is found."""

    def __post_init__(self) -> None:
        check_type(self.file, str | Path, "file", "the name of a file")
        check_type(self.parameters, tuple | list | Mapping, "parameters", "names, or a table")
        if not self.parameters:
            raise InputError(f"{self.file}: no parameter is named; list those to estimate.")

    def describe(self) -> Description:
        """Return the quantities of the file.

        Raises:
            InputError: a file that cannot be read, or used.
        """
        raise NotImplementedError

    def functions(
        self, parameters: Sequence[str], inputs: Sequence[str], outputs: Sequence[str]
    ) -> Functions:
        """Return f(x, u, p) and h(x, u, p) for these quantities of the file, hashable."""
        raise NotImplementedError

    def mass(self, parameters: Sequence[str]) -> MassMatrix:
        """Return the mass matrix, for a learner that consists of forces."""
        return NO_MASS

    def write_back(self, values: Mapping[str, float], units: Mapping[str, str]) -> dict[str, str]:
        """Return what is written of estimated parameters, as the content of files by name.

        That is JSON with the names that the file has for them, and `written`.
        """
        there = self.describe().parameters
        named = {
            self.find(name, there, "parameter").name: (value, units[name])
            for name, value in values.items()
        }
        listed = {name: {"value": value, "unit": unit} for name, (value, unit) in named.items()}
        listing = json.dumps(listed, indent=1, ensure_ascii=False)
        return {"parameters.json": f"{listing}\n"} | self.written(
            {name: value for name, (value, _) in named.items()}
        )

    def written(self, values: Mapping[str, float]) -> dict[str, str]:
        """Return files with these values in the format of the source, as content by name."""
        raise NotImplementedError

    def in_folder(self, folder: Path) -> FileSource:
        return replace(self, file=str(folder / self.file))

    @property
    def files(self) -> tuple[Path, ...]:
        return (Path(self.file),)

    @property
    def kept(self) -> str:
        """Name of the copy that a saved model keeps."""
        return f"physics{self.ending}"

    @cached_property
    def content(self) -> bytes:
        """The content of the file.

        Raises:
            InputError: no such file.
        """
        try:
            return Path(self.file).read_bytes()
        except FileNotFoundError:
            raise InputError(f"{self.file}: no such file; check the name.") from None
        except (OSError, ValueError) as error:
            words = getattr(error, "strerror", None) or error
            raise InputError(f"{self.file}: cannot be read ({words}).") from None

    @cached_property
    def sha256(self) -> str:
        """The sha256 of the file."""
        return hashlib.sha256(self.content).hexdigest()

    def keys(self) -> dict[str, Any]:
        return super().keys() | {"file": self.kept, "sha256": self.sha256}

    def motion_of(self, inputs: Sequence[str], outputs: Sequence[str]) -> Motion:
        """Return the motion with functions of the file.

        Raises:
            InputError: names that the file does not have.
        """
        there = self.describe()
        chosen = self._parameters(there)
        for what, mapped, channels in (
            ("input", self.inputs, inputs),
            ("output", self.outputs, outputs),
        ):
            for name in mapped:
                if name not in channels:
                    hint = nearest(name, channels) or f"; there are {', '.join(channels)}."
                    raise InputError(f"{self.file}: no {what} channel '{name}'{hint}")
        entering = [self.find(self.inputs.get(n, n), there.inputs, "input") for n in inputs]
        measured = [self.find(self.outputs.get(n, n), there.outputs, "output") for n in outputs]
        learned, forced = self._learned(there, outputs)
        made = []
        for state in there.states:
            seen = next((n for n, q in zip(outputs, measured, strict=True) if q == state), None)
            start = self._starts(there).get(state.name, state.value if seen is None else seen)
            made.append(State(state.identifier, None, start, state.name in learned, state.unit))
        names = [[q.name for q in group] for group in (chosen, entering, measured)]
        return Motion.from_functions(
            *self.functions(*names),
            states=made,
            outputs=[Output(name, learned=name in learned) for name in outputs],
            parameters=[
                PhysicalParameter(
                    q.identifier,
                    self._number(q, "initial"),
                    q.unit,
                    float("-inf") if q.low is None else q.low,
                    float("inf") if q.high is None else q.high,
                )
                for q in chosen
            ],
            inputs=inputs,
            mass=self.mass(names[0]) if forced else NO_MASS,
            **self.options,
        )

    def find(self, name: str, known: Sequence[Quantity], what: str) -> Quantity:
        """Return a quantity by its name in the file, or as expressions take it.

        Raises:
            InputError: none of that name; the nearest is named.
        """
        found = {q.identifier: q for q in known} | {q.name: q for q in known}
        if name not in found:
            some = ", ".join(q.name for q in known[:_SHOWN]) or "none"
            more = ", …" if len(known) > _SHOWN else ""
            hint = nearest(str(name), found) or f"; it has {some}{more}."
            raise InputError(f"{self.file}: no {what} {show(name)}{hint}")
        return found[name]

    def _parameters(self, there: Description) -> list[Quantity]:
        """Return the chosen parameters, with what the declaration changes of them."""
        changes: Any = self.parameters
        if not isinstance(changes, Mapping):
            changes = dict.fromkeys(changes, {})
        chosen = []
        for name, change in changes.items():
            own = self.find(name, there.parameters, "parameter")
            for key, value in change.items():
                if key not in _OF_PARAMETER:
                    hint = nearest(key, _OF_PARAMETER) or f"; known are {', '.join(_OF_PARAMETER)}."
                    raise InputError(f"{self.file}: parameter '{name}' has no key '{key}'{hint}")
                if not (isinstance(value, str) if key == "unit" else is_number(value)):
                    raise InputError(f"{self.file}: '{name}.{key}' cannot be {show(value)}.")
            keys = {"initial": "value", "min": "low", "max": "high", "unit": "unit"}
            chosen.append(replace(own, **{keys[key]: value for key, value in change.items()}))
        return chosen

    def _number(self, parameter: Quantity, key: str) -> float:
        if parameter.value is None:
            raise InputError(
                f"{self.file}: the parameter '{parameter.name}' has no start value; give its "
                f"`{key}`."
            )
        return parameter.value

    def _starts(self, there: Description) -> dict[str, float | str]:
        return {
            self.find(name, there.states, "state").name: start
            for name, start in self.starts.items()
        }

    def _learned(self, there: Description, outputs: Sequence[str]) -> tuple[set[str], bool]:
        """Return the names of learned states, as in the file, and of learned outputs.

        And whether the learner is forces.
        """
        channels = [name for name in self.learned if name in outputs]
        states = {q.name: q.name for q in there.states}
        states |= {force.name: state for state, force in there.forces}
        known = (*there.states, *(force for _, force in there.forces))
        written = {q.identifier for q in known} | {q.name for q in known}
        own = [name for name in self.learned if name in written or name not in channels]
        found = [self.find(name, known, "state").name for name in own]
        forces = [name for name in found if name not in {q.name for q in there.states}]
        if forces and len(forces) < len(found):
            other = next(name for name in found if name not in forces)
            raise InputError(
                f"{self.file}: `learned` has {forces[0]}, a force, and {other}, whose rate is "
                "none; give forces alone, or states alone."
            )
        named = {states[name] for name in found}
        return named | {name for name in channels if name not in written}, bool(forces)
