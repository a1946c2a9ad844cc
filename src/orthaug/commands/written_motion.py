"""Sections of a spec for a motion: `[motion]`, and `[learner]` where it has one."""

from __future__ import annotations

import math
import tomllib
from typing import Any

import tomlkit

from orthaug._base.errors import InputError, KeyedError
from orthaug.physics.motion import Motion
from orthaug.physics.systems import SYSTEMS, System


def system_of(text: str) -> System:
    """Return the system that a text declares: a kind, and its keys, `kind,order=3,learned=input`.

    Raises:
        InputError: an unknown kind or key, and what the system refuses.
    """
    kind, *options = text.split(",")
    keys: dict[str, object] = {}
    for option in options:
        name, found, value = (part.strip() for part in option.partition("="))
        if not found or not name:
            raise InputError(f"--system: '{option}' is no key and value, such as order=3.")
        try:
            keys[name] = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            keys[name] = value  # a word without quotes
    known = SYSTEMS.section_keys()
    unknown = [name for name in keys if name not in known]
    if unknown:
        raise InputError(f"--system: unknown key '{unknown[0]}'; known are {', '.join(known)}.")
    try:
        return SYSTEMS.declare(kind.strip(), keys)
    except KeyedError as error:
        raise InputError(f"--system: {error}") from None
    except InputError as error:
        raise type(error)(f"--system: {error}") from None


def motion_section(motion: Motion) -> Any:
    """Return `[motion]` of a motion of expressions, with its parameters' initial values."""
    section = tomlkit.table()
    section.add("integrator", motion.integrator)
    if not motion.scheme.discrete:
        section.add("hold", motion.hold)
    states, parameters = tomlkit.table(), tomlkit.table()
    for state in motion.states:
        own = tomlkit.inline_table()
        own.update({motion.equation_key: state.derivative})
        own.update({} if state.start is None else {"start": state.start})
        own.update({"learned": True} if state.learned else {})
        own.update({"unit": state.unit} if state.unit else {})
        states.add(state.name, own)
    for parameter in motion.parameters:
        own = tomlkit.inline_table()
        own.update({"initial": parameter.initial})
        own.update({"unit": parameter.unit} if parameter.unit else {})
        bounds = {"min": parameter.min, "max": parameter.max}
        own.update({key: bound for key, bound in bounds.items() if math.isfinite(bound)})
        parameters.add(parameter.name, own)
    outputs = tomlkit.table()
    for output in motion.outputs:
        own = tomlkit.inline_table()
        own.update({"expression": output.expression, "learned": True})
        outputs.add(output.name, own if output.learned else output.expression)
    section.add("states", states)
    if motion.definitions:
        define = tomlkit.table()
        for name, expression in motion.definitions:
            define.add(name, str(expression))
        section.add("define", define)
    section.add("outputs", outputs)
    section.add("parameters", parameters)
    if motion.constants:
        constants = tomlkit.table()
        constants.update(dict(motion.constants))
        section.add("constants", constants)
    return section
