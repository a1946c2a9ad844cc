"""Differences in equations, as of two positions or temperatures, each by way of a gear or not.

What stretches a spring or drives heat is a difference of two states or inputs; behind a gear or a
pulley one of them is multiplied by a known ratio, as in `k*(motor/N - load)`.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from orthaug._base.checks import Vector
from orthaug.data.expressions import Expression


@dataclass(frozen=True)
class Side:
    """A name times a known number."""

    text: str
    name: str
    gain: float


@dataclass(frozen=True)
class Difference:
    """`first - second`."""

    first: Side
    second: Side

    def __str__(self) -> str:
        return f"{self.first.text} - {self.second.text}"

    @property
    def names(self) -> frozenset[str]:
        """The two names."""
        return frozenset((self.first.name, self.second.name))

    @property
    def sides(self) -> frozenset[Side]:
        """The two sides; the same either way round."""
        return frozenset((self.first, self.second))

    @property
    def scaled(self) -> bool:
        """True if a known number multiplies either side."""
        return any(side.text != side.name for side in self.sides)

    def row(self, names: tuple[str, ...]) -> Vector:
        """Return what it multiplies each of several names by, (len(names),)."""
        found = np.zeros(len(names))
        found[names.index(self.first.name)] = self.first.gain
        found[names.index(self.second.name)] = -self.second.gain
        return found


def difference_of(node: ast.AST, constants: Mapping[str, float]) -> Difference | None:
    """Return what a node is the difference of, None where it is no difference of two names."""
    if not (isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub)):
        return None
    first, second = _side(node.left, constants), _side(node.right, constants)
    if first is None or second is None or first.name == second.name:
        return None
    return Difference(first, second)


def differences_in(
    expressions: Iterable[Expression], constants: Mapping[str, float]
) -> Iterator[Difference]:
    """Yield the differences in expressions, each once, the way round that it has first.

    The beginning of a longer sum is one only without known numbers: `voltage - R*i - K*speed` has
    no difference of voltage and current.
    """
    seen: set[frozenset[Side]] = set()
    for expression in expressions:
        summands = {
            id(side)
            for node in ast.walk(expression.tree)
            if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub)
            for side in (node.left, node.right)
        }
        for node in ast.walk(expression.tree):
            found = difference_of(node, constants)
            if found is None or found.sides in seen or (found.scaled and id(node) in summands):
                continue
            seen.add(found.sides)
            yield found


def _side(node: ast.expr, constants: Mapping[str, float]) -> Side | None:
    """Return a name, or one times or over known numbers."""
    found = scaled_name(node, constants)
    if found is None or found.name in constants or not found.gain:
        return None
    return Side(plain(node), found.name, found.gain)


@dataclass(frozen=True)
class ScaledName:
    """A name times and over known numbers, whose texts end and begin with the operator."""

    name: str
    gain: float = 1.0
    times: str = ""
    over: str = ""

    def scaled(self, text: str) -> str:
        """Return a text times and over the same numbers."""
        return f"{self.times}({text}){self.over}" if self.times or self.over else text


def scaled_name(node: ast.expr, constants: Mapping[str, float]) -> ScaledName | None:
    """Return the name that a node is but for known numbers, None where there is no such name."""
    if isinstance(node, ast.Name):
        return ScaledName(node.id)
    if not (isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult | ast.Div)):
        return None
    divides = isinstance(node.op, ast.Div)
    behind = number_of(node.right, constants)
    if behind is not None and (found := scaled_name(node.left, constants)) is not None:
        text = plain(node.right)
        if not divides:
            return replace(found, gain=found.gain * behind, times=f"{text}*{found.times}")
        if isinstance(node.right, ast.BinOp):
            text = f"({text})"
        gain = found.gain / behind if behind else 0.0
        return replace(found, gain=gain, over=f"{found.over}/{text}")
    before = number_of(node.left, constants)
    if before is None or divides or (found := scaled_name(node.right, constants)) is None:
        return None
    return replace(found, gain=found.gain * before, times=f"{plain(node.left)}*{found.times}")


def number_of(node: ast.expr, constants: Mapping[str, float]) -> float | None:
    """Return the value of a number, a constant, or a product or quotient of these; else None."""
    match node:
        case ast.Constant(value):
            return float(value)  # type: ignore[arg-type]  (the parser takes numbers only)
        case ast.Name(name):
            return constants.get(name)
        case ast.BinOp(left, ast.Mult() | ast.Div() as by, right):
            a, b = number_of(left, constants), number_of(right, constants)
            if a is None or b is None or (isinstance(by, ast.Div) and not b):
                return None
            return a / b if isinstance(by, ast.Div) else a * b
    return None


def plain(node: ast.expr) -> str:
    """Return the text of a product or quotient, without spaces."""
    return ast.unparse(node).replace(" ", "")
