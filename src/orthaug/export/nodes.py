"""Scalar expressions in the intermediate form.

They are numbers, names, entries of vectors, functions of them, and activations.

Targets write them, those in languages that write sums and products as C and Python do by a
`Language`; nothing of Python's syntax tree, of NumPy or of JAX is left in them.
"""

from __future__ import annotations

import ast
import math
import unicodedata
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Union

import numpy as np

from orthaug.data.expressions import Expression, Lag

_WIDTH = 110  # columns of exported code
_BINARY = {ast.Add: "add", ast.Sub: "sub", ast.Mult: "mul", ast.Div: "div"}
ARITHMETIC: dict[str, Callable[..., float]] = {
    "neg": lambda a: -a,
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "power": lambda a, b: a**b,
    "whole_power": lambda a, b: a**b,
}
"""A node may also hold every function of expressions."""
SHARED_NAMES = ("sin", "cos", "tan", "exp", "log", "sqrt", "floor", "tanh", "expm1", "log1p")
"""Functions with this name in C, NumPy and CasADi."""


@dataclass(frozen=True)
class Number:
    """A number."""

    value: float


@dataclass(frozen=True)
class Name:
    """A named constant or an intermediate result."""

    name: str


@dataclass(frozen=True)
class Entry:
    """An entry of a vector, counted from 0."""

    vector: str
    index: int


@dataclass(frozen=True)
class Apply:
    """A function of nodes: of `ARITHMETIC` or of `FUNCTIONS` of expressions.

    `min` and `max` of two.

    The second argument of `whole_power` is a whole `Number`.
    """

    function: str
    arguments: tuple[Node, ...]


Node = Union[Number, Name, Entry, Apply]  # noqa: UP007  (refers to itself)


def apply(function: str, *arguments: Node) -> Node:
    """Return a function of nodes.

    Arithmetic on numbers is done here, by the rules of floating point.
    """
    numbers = [argument.value for argument in arguments if isinstance(argument, Number)]
    if function in ARITHMETIC and len(numbers) == len(arguments):
        with np.errstate(all="ignore"):
            return Number(float(ARITHMETIC[function](*map(np.float64, numbers))))
    return Apply(function, arguments)


def total(summands: list[Node]) -> Node:
    """Return the sum of nodes, from the left; 0 of none."""
    if not summands:
        return Number(0.0)
    value = summands[0]
    for summand in summands[1:]:
        value = apply("add", value, summand)
    return value


def node_of(
    expression: Expression,
    names: Mapping[str, Node],
    lags: Mapping[Lag, Node],
    numbers: Mapping[str, float],
) -> Node:
    """Return an expression as a node.

    Args:
        expression: from the parser.
        names, lags: nodes of its names and of its channels at a lag.
        numbers: names of constants, whose values show whether a power is a whole one.
    """
    return _node(expression.tree, names, lags, numbers)


def _node(
    tree: ast.expr,
    names: Mapping[str, Node],
    lags: Mapping[Lag, Node],
    numbers: Mapping[str, float],
) -> Node:
    if isinstance(tree, ast.Constant):
        return Number(float(tree.value))  # type: ignore[arg-type]  (checked by the parser)
    if isinstance(tree, ast.Name):
        return names[tree.id]
    if isinstance(tree, ast.Subscript):
        return lags[Expression(ast.unparse(tree)).lags[0]]
    if isinstance(tree, ast.UnaryOp):
        operand = _node(tree.operand, names, lags, numbers)
        return apply("neg", operand) if isinstance(tree.op, ast.USub) else operand
    if isinstance(tree, ast.BinOp) and isinstance(tree.op, ast.Pow):
        base, exponent = _node(tree.left, names, lags, numbers), _constant(tree.right, numbers)
        if exponent is not None and exponent.is_integer() and abs(exponent) <= 2**31 - 1:
            return apply("whole_power", base, Number(exponent))
        return apply("power", base, _node(tree.right, names, lags, numbers))
    if isinstance(tree, ast.BinOp):
        sides = (_node(side, names, lags, numbers) for side in (tree.left, tree.right))
        return apply(_BINARY[type(tree.op)], *sides)
    assert isinstance(tree, ast.Call) and isinstance(tree.func, ast.Name)
    arguments = [_node(argument, names, lags, numbers) for argument in tree.args]
    if tree.func.id in ("min", "max"):
        value = arguments[0]
        for other in arguments[1:]:
            value = Apply(tree.func.id, (value, other))
        return value
    return Apply(tree.func.id, tuple(arguments))


def _constant(tree: ast.expr, numbers: Mapping[str, float]) -> float | None:
    """Return the number that an exponent is, None where it is none."""
    if isinstance(tree, ast.Constant):
        return float(tree.value)  # type: ignore[arg-type]
    if isinstance(tree, ast.Name):
        return numbers.get(tree.id)
    if isinstance(tree, ast.UnaryOp):
        value = _constant(tree.operand, numbers)
        return -value if value is not None and isinstance(tree.op, ast.USub) else value
    return None


def functions_in(node: Node) -> set[str]:
    """Return the functions that a node is made of; a whole power of 2 counts as `square`."""
    if not isinstance(node, Apply):
        return set()
    square = node.function == "whole_power" and node.arguments[1] == Number(2.0)
    return {"square" if square else node.function}.union(*map(functions_in, node.arguments))


def names_in(node: Node) -> set[str]:
    """Return the names that a node reads."""
    if isinstance(node, Name):
        return {node.name}
    return set[str]().union(*map(names_in, node.arguments)) if isinstance(node, Apply) else set()


def identifier(name: str) -> str:
    """Return a name in ASCII: other letters by their code point, as `u03b8` for θ."""
    plain = unicodedata.normalize("NFKC", name)
    return "".join(
        c if c.isascii() and (c.isalnum() or c == "_") else f"u{ord(c):04x}" for c in plain
    )


def _apply(function: str, *arguments: Node) -> Node:
    return Apply(function, arguments)


_A, _ONE, _NULL = Name("a"), Number(1.0), Number(0.0)


_SIGMOID = _apply("div", _ONE, _apply("add", _ONE, _apply("exp", _apply("neg", _A))))
_CUBIC = _apply("add", _A, _apply("mul", Number(0.044715), _apply("whole_power", _A, Number(3.0))))
ACTIVATIONS: dict[str, Node] = {
    "tanh": _apply("tanh", _A),
    "relu": _apply("max", _A, _NULL),
    "gelu": _apply(
        "mul",
        _apply("mul", Number(0.5), _A),
        _apply("add", _ONE, _apply("tanh", _apply("mul", Number(math.sqrt(2 / math.pi)), _CUBIC))),
    ),
    "sigmoid": _SIGMOID,
    "silu": _apply("mul", _A, _SIGMOID),
    "elu": _apply("add", _apply("max", _A, _NULL), _apply("expm1", _apply("min", _A, _NULL))),
    "softplus": _apply(
        "add",
        _apply("max", _A, _NULL),
        _apply("log1p", _apply("exp", _apply("neg", _apply("abs", _A)))),
    ),
    "identity": _A,
}
"""The activations of networks as nodes of `a`, so that no target needs a table of them. Names are
those of `models.learners`.
"""


_INFIX = {"add": (1, "+"), "sub": (1, "-"), "mul": (2, "*"), "div": (2, "/")}
_ATOM = 9


@dataclass(frozen=True)
class Language:
    """Syntax of a language beyond sums and products.

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
        """Return an expression."""
        return self._level(node)[1]

    def _level(self, node: Node) -> tuple[int, str]:
        """Return the binding strength of the text, and the text."""
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
    """Return a number that reads back exactly, with a point or an exponent."""
    return repr(float(value))


def wrap_items(items: list[str], indent: str) -> str:
    """Return items with commas, in lines."""
    lines, line = [], ""
    for item in items:
        piece = f"{item}, "
        if line and len(indent) + len(line) + len(piece) > _WIDTH:
            lines.append(indent + line.rstrip())
            line = ""
        line += piece
    return "\n".join([*lines, indent + line.rstrip(" ,")])
