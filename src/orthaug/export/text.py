"""Nodes as text in languages that write sums and products as C and Python do."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from orthaug.export.nodes import Apply, Entry, Name, Node, Number

_INFIX = {"add": (1, "+"), "sub": (1, "-"), "mul": (2, "*"), "div": (2, "/")}
_ATOM = 9


@dataclass(frozen=True)
class Language:
    """How a language writes what is no sum or product.

    Args:
        functions: the function's name by ours.
        number: a number.
        whole_power: of the text of an atom and a whole number.
        entry: an entry of a vector.
        name: a constant or an intermediate result.
    """

    functions: Mapping[str, str]
    number: Callable[[float], str]
    whole_power: Callable[[str, int], str]
    entry: Callable[[str, int], str] = lambda vector, index: f"{vector}[{index}]"
    name: Callable[[str], str] = lambda name: name

    def write(self, node: Node) -> str:
        """An expression."""
        return self._level(node)[1]

    def _level(self, node: Node) -> tuple[int, str]:
        """How strongly the text binds, and the text."""
        if isinstance(node, Number):
            return (0 if node.value < 0 else _ATOM), self.number(node.value)
        if isinstance(node, Name):
            return _ATOM, self.name(node.name)
        if isinstance(node, Entry):
            return _ATOM, self.entry(node.vector, node.index)
        assert isinstance(node, Apply)
        if node.function in _INFIX:
            level, sign = _INFIX[node.function]
            left, right = node.arguments
            tight = sign if level == 2 else f" {sign} "
            return level, f"{self._within(left, level)}{tight}{self._within(right, level + 1)}"
        if node.function == "neg":
            return 0, f"-{self._within(node.arguments[0], 3)}"
        if node.function == "whole_power":
            base, exponent = node.arguments
            assert isinstance(exponent, Number)
            return 4, self.whole_power(self._within(base, 5), int(exponent.value))
        inner = ", ".join(self.write(argument) for argument in node.arguments)
        return _ATOM, f"{self.functions[node.function]}({inner})"

    def _within(self, node: Node, least: int) -> str:
        level, text = self._level(node)
        return text if level >= least else f"({text})"


def decimal(value: float) -> str:
    """A number that reads back exactly, with a point or an exponent."""
    return repr(float(value))


def wrapped(items: list[str], indent: str, width: int = 110) -> str:
    """Items with commas, in lines."""
    lines, line = [], ""
    for item in items:
        piece = f"{item}, "
        if line and len(indent) + len(line) + len(piece) > width:
            lines.append(indent + line.rstrip())
            line = ""
        line += piece
    return "\n".join([*lines, indent + line.rstrip(" ,")])
