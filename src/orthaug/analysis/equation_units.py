"""Units of equations against those of the data: states that outputs measure, and angles."""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Iterator
from typing import Protocol

from orthaug._base.errors import Warning
from orthaug.data.channels import Channel
from orthaug.data.expressions import Expression
from orthaug.data.record import Record
from orthaug.data.units import conversion
from orthaug.physics.motion import Motion

_OF_ANGLES = ("sin", "cos", "tan")
_NEAR = 0.01  # relative error of a factor that was rounded


class Written(Protocol):
    """Physics as its expressions; without any where it is a function."""

    @property
    def expressions(self) -> tuple[Expression, ...]:
        """Every expression of the physics."""
        ...

    @property
    def state_units(self) -> dict[str, str]:
        """Unit of each state; of lagged physics, which has none, empty."""
        ...

    @property
    def measured_states(self) -> dict[str, str]:
        """The state that each output is, where its expression is the state alone."""
        ...


def equation_units(record: Record, physics: Written) -> list[Warning]:
    """Return a warning for each quantity whose unit in the data is not that of the equations.

    Three cases are certain: an output that is a state of another declared unit, the sine, cosine or
    tangent of a quantity in degrees, and degrees times a parameter without them in the equation of
    a state in radians. A unit that is not declared is never guessed.
    """
    channels = {channel.name: channel for channel in record.channels}
    measured = {state: channels[out] for out, state in physics.measured_states.items()}
    found = list(_other_than_states(measured, physics.state_units))
    doubted = {name for name, _ in found}
    angles = {
        name: channel
        for name, channel in (channels | measured).items()
        if channel.name not in doubted and _degrees(channel)
    }
    found += _sines_of_degrees(physics.expressions, angles)
    if isinstance(physics, Motion) and physics.functions is None and physics.source is None:
        doubted = {name for name, _ in found}
        found += _degrees_among_radians(
            physics, {name: angle for name, angle in angles.items() if angle.name not in doubted}
        )
    return [Warning("equation_units", text) for _, text in found]


def _other_than_states(
    measured: dict[str, Channel], units: dict[str, str]
) -> Iterator[tuple[str, str]]:
    """Yield the outputs that are states of another unit: their names, and what to do."""
    for state, channel in measured.items():
        unit = units.get(state, "")
        if not unit or not channel.unit or unit == channel.unit:
            continue
        both = f"the output '{channel.name}' is in {channel.unit}, and its expression, the state "
        both += f"'{state}', is in {unit}"
        try:
            right = conversion(channel.unit, unit)
        except ValueError:
            text = f"{both}: units of different kinds. Correct the unit, or the expression."
            yield channel.name, text
            continue
        if right is None or math.isclose(right.scale, 1.0, rel_tol=1e-6):
            continue
        yield (
            channel.name,
            f"{both}. The parameters absorb such a factor. Give `data.channels.{channel.name}` "
            f'`unit = "{unit}"` and `scale = {channel.scale * right.scale:.6g}`, or write '
            f'`{channel.name} = "{1 / right.scale:.6g}*{state}"`. If only the unit is wrong, '
            "correct it.",
        )


def _degrees(channel: Channel) -> bool:
    """Return whether a channel is in degrees; not with a scale that makes radians of them."""
    plain = channel.unit.strip().lower() in ("deg", "°", "degree", "degrees")
    return plain and not math.isclose(abs(channel.scale), math.pi / 180, rel_tol=_NEAR)


def _in_radians(channel: Channel) -> str:
    """Return how the spec makes radians of a channel in degrees."""
    scale = channel.scale * math.pi / 180
    return f'Give `data.channels.{channel.name}` `unit = "rad"` and `scale = {scale:.6g}`'


def _sines_of_degrees(
    expressions: tuple[Expression, ...], angles: dict[str, Channel]
) -> Iterator[tuple[str, str]]:
    """Yield each channel in degrees of which a sine is taken, unconverted, and what to do."""
    said = set()
    for expression in expressions:
        for node in ast.walk(expression.tree):
            match node:
                case ast.Call(ast.Name(function), [argument]) if function in _OF_ANGLES:
                    for name in _unconverted(argument):
                        channel = angles.get(name)
                        if channel is None or channel.name in said:
                            continue
                        said.add(channel.name)
                        yield (
                            channel.name,
                            f"{ast.unparse(node)} takes radians, and {channel.name} is in "
                            f"{channel.unit}. The physics is then another one. "
                            f"{_in_radians(channel)}, or write "
                            f"{function}({math.pi / 180:.6g}*({ast.unparse(argument)})).",
                        )


def _degrees_among_radians(motion: Motion, angles: dict[str, Channel]) -> Iterator[tuple[str, str]]:
    """Yield each channel in degrees that makes radians by a parameter without degrees."""
    units = {one.name: one.unit for one in motion.parameters if one.unit}
    said = set()
    for state, unit in motion.state_units.items():
        if not re.match(r"rad\b", unit):
            continue
        for factors in _products(motion.equations[state].tree):
            # Another number or constant among them may convert
            names = [name for factor in factors for name in _unconverted(factor)]
            if len(names) < len(factors) or not set(names) <= units.keys() | angles.keys():
                continue
            channel = next((angles[name] for name in names if name in angles), None)
            other = next((name for name in names if name in units), None)
            if channel is None or other is None or channel.name in said:
                continue
            if any(re.search("deg|°", units.get(name, "")) for name in names):
                continue
            said.add(channel.name)
            yield (
                channel.name,
                f"'{channel.name}' is in {channel.unit}, and {other} times it, {other} in "
                f"{units[other]}, is in the equation of '{state}' in {unit}. The parameters absorb "
                f"such a factor. {_in_radians(channel)}, or give {other} a unit with "
                f"{channel.unit}.",
            )


def _products(node: ast.AST) -> Iterator[list[ast.expr]]:
    """Yield the factors of each product in an expression."""
    match node:
        case ast.BinOp(_, ast.Mult(), _):
            yield _factors(node)
        case _:
            for child in ast.iter_child_nodes(node):
                yield from _products(child)


def _factors(node: ast.expr) -> list[ast.expr]:
    match node:
        case ast.BinOp(left, ast.Mult(), right):
            return [*_factors(left), *_factors(right)]
        case ast.UnaryOp(_, operand):
            return _factors(operand)
        case _:
            return [node]


def _unconverted(node: ast.expr) -> Iterator[str]:
    """Yield the names of which an argument is a sum: a product or a quotient may convert units."""
    match node:
        case ast.Name(name) | ast.Subscript(ast.Name(name)):
            yield name
        case ast.UnaryOp(_, operand):
            yield from _unconverted(operand)
        case ast.BinOp(left, ast.Add() | ast.Sub(), right):
            yield from _unconverted(left)
            yield from _unconverted(right)
