"""Expressions of lagged signals, such as `"sign(v[k-1])*v[k-1]**2"`, parsed without `eval`.

Python's own grammar reads the text into a syntax tree. A node that is not on the list below is
refused by name, so an expression can only do arithmetic. NumPy evaluates the tree on whole records,
JAX inside a compiled free run.
"""

from __future__ import annotations

import ast
import keyword
import math
import re
import unicodedata
import warnings
from collections.abc import Container, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from graphlib import CycleError, TopologicalSorter
from typing import Any, NamedTuple

import numpy as np

from orthaug._base.checks import nearest
from orthaug._base.errors import LONGEST, InputError, show


class Lag(NamedTuple):
    """One raw entry of the regressor: a channel and how many samples back, `force[k-1]`."""

    channel: str
    lag: int

    def __str__(self) -> str:
        return f"{self.channel}[k-{self.lag}]" if self.lag else f"{self.channel}[k]"


_OF_ONE = ("sin", "cos", "tan", "atan", "exp", "log", "sqrt", "abs", "sign", "floor", "tanh")
_OF_MANY = ("min", "max")
FUNCTIONS = (*_OF_ONE, "atan2", *_OF_MANY)
_ELSEWHERE = {
    "atan": "arctan",
    "atan2": "arctan2",
}  # as NumPy and JAX call them, where that is another name
RESERVED = frozenset((*FUNCTIONS, "k"))
SAMPLING_TIME = "Ts"  # a name that need not be declared: it is the record's sampling time
LARGEST_LAG = 100_000  # more is a mistake, and would fill the memory
_MAX_LENGTH = 500  # characters; a longer expression is a mistake, and messages stay readable
_TRIES = 20  # one in a hundred fails where two threads do nothing but parse
_BINARY = {
    ast.Add: lambda a, b: a + b,
    ast.Sub: lambda a, b: a - b,
    ast.Mult: lambda a, b: a * b,
    ast.Div: lambda a, b: a / b,
    ast.Pow: lambda a, b: a**b,
}
_ALLOWED = "channels at a lag such as y[k-1], numbers, constants, + - * / ** ( ) and " + ", ".join(
    FUNCTIONS
)
_POWER, _ELEMENTWISE = re.compile(r"\.?\^"), re.compile(r"\.([*/])")
_LAGGED = re.compile(
    r"\b([^\W\d]\w*)\s*[({]\s*[kt]\s*([-+]\s*\d+)?\s*[)}]|\b([^\W\d]\w*)\[\s*t\s*([-+]\s*\d+)?\s*\]"
)


@dataclass(frozen=True)
class Expression:
    """A parsed expression; equal and hashable by its text and the constants it uses.

    Examples:
        >>> expression = parse("2*force[k-1] - offset", {"offset": 1.0})
        >>> [str(lag) for lag in expression.lags]
        ['force[k-1]']
        >>> import numpy as np
        >>> float(expression.evaluate({Lag("force", 1): 3.0}, np))
        5.0
    """

    text: str
    constants: tuple[tuple[str, float], ...] = ()

    def __str__(self) -> str:
        return self.text

    @cached_property
    def tree(self) -> ast.expr:
        """Its syntax, of whitelisted nodes only where `parse` made it."""
        return syntax_tree(self.text).body

    @cached_property
    def lags(self) -> tuple[Lag, ...]:
        """The raw lags that the expression reads, in order of first appearance."""
        nodes = [node for node in ast.walk(self.tree) if isinstance(node, ast.Subscript)]
        nodes.sort(key=lambda node: node.col_offset)  # `walk` goes level by level
        return tuple(dict.fromkeys(_lag(node, self.text) for node in nodes))

    @cached_property
    def unsampled(self) -> bool:
        """True if it reads `Ts`, and has no value for that yet."""
        named = any(
            isinstance(node, ast.Name) and node.id == SAMPLING_TIME
            for node in _free_names(self.tree)
        )
        return named and SAMPLING_TIME not in dict(self.constants)

    def sampled(self, sampling_time: float) -> Expression:
        """Return the expression with this value [s] of `Ts`.

        The same one where it does not wait for it.
        """
        if not self.unsampled:
            return self
        return replace(
            self, constants=tuple(sorted((*self.constants, (SAMPLING_TIME, float(sampling_time)))))
        )

    def evaluate(self, columns: Mapping[Lag, object], xp: Any) -> Any:
        """Return the value for `columns[lag]`, computed by `xp` (numpy or jax.numpy).

        The columns are scalars or arrays of one shape.

        Raises:
            InputError: the sampling time is asked for and not known here.
        """
        if self.unsampled:
            raise InputError(
                f"'{self.text}': {SAMPLING_TIME} has no value here; give it as a constant."
            )
        return _evaluate(self.tree, columns, dict(self.constants), xp, self.text)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of numbers in it."""
        return tuple(name for name, _ in self.constants)

    def value(self, values: Mapping[str, Any], xp: Any) -> Any:
        """Return its value for `values` of its names; of an expression without channels."""
        return _evaluate(self.tree, {}, values, xp, self.text)

    @cached_property
    def is_partial(self) -> bool:
        """True if it has no value for some numbers: a root, a logarithm, a power with a fraction.

        Division by zero is left out, for it is met at single points only.
        """
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("sqrt", "log"):
                return True
            if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
                power = node.right.operand if isinstance(node.right, ast.UnaryOp) else node.right
                whole = isinstance(power, ast.Constant) and float(power.value).is_integer()  # type: ignore[arg-type]
                if not whole:
                    return True
        return False

    def term_without_value(self, values: Mapping[str, Any]) -> tuple[str, tuple[str, ...]]:
        """Return the smallest term that is not finite although all in it is, and its names."""

        def finite(node: ast.expr) -> bool:
            with np.errstate(all="ignore"):
                return bool(np.isfinite(_evaluate(node, {}, values, np, self.text)))

        node = self.tree
        while True:
            inner = [
                child
                for child in ast.walk(node)
                if isinstance(child, ast.expr) and child is not node
            ]
            functions = [child.func for child in ast.walk(node) if isinstance(child, ast.Call)]
            worse = [child for child in inner if child not in functions and not finite(child)]
            if not worse:
                return ast.unparse(node), tuple(name.id for name in _free_names(node))
            node = min(worse, key=lambda child: len(ast.unparse(child)))


def is_name(name: str, taken: Container[str] = RESERVED) -> bool:
    """Return whether expressions can use `name`.

    Python reads an identifier in its normal form only.
    """
    return (
        is_identifier(name)
        and not keyword.iskeyword(name)
        and name not in taken
        and unicodedata.normalize("NFKC", name) == name
    )


def is_identifier(name: Any) -> bool:
    """Return whether `name` is an identifier: letters, digits and underscores.

    It does not start with a digit and is not too long.
    """
    return isinstance(name, str) and name.isidentifier() and len(name) <= LONGEST


def parse(text: str, constants: Mapping[str, float] | None = None) -> Expression:
    """Read `text`. Besides channels and functions it may use the names in `constants`.

    It may also use `Ts`, the sampling time of the record that it will be read on
    (`Expression.sampled`).

    Raises:
        InputError: anything that is not arithmetic on lagged channels, with the offending piece
            named.
    """
    constants = dict(constants or {})
    if not isinstance(text, str):
        raise InputError(f"an expression must be text such as 'y[k-1]'; got {show(text)}.")
    text = " ".join(text.split())
    if not text:
        raise InputError("An expression is empty; write for example y[k-1], or 1 for an offset.")
    if "#" in text:
        raise InputError(
            f"'{text[:_MAX_LENGTH]}': '#' is not allowed in an expression; allowed are {_ALLOWED}."
        )
    if len(text) > _MAX_LENGTH:
        raise InputError(
            f"An expression has {len(text)} characters; at most {_MAX_LENGTH} are read."
        )
    try:
        return _read(text, constants)
    except (SyntaxError, ValueError) as error:
        _suggest(text, constants)
        if isinstance(error, InputError):
            raise
        if any(mark in text for mark in ("&&", "||", "~=", "==")):
            raise InputError(
                f"'{text}': an expression has no logic; use sign, min or max to switch."
            ) from None
        reason = getattr(error, "msg", str(error))
        raise InputError(
            f"'{text}' is not an expression ({reason}); allowed are {_ALLOWED}."
        ) from None
    except (RecursionError, MemoryError):
        raise InputError(f"'{text[:40]}…' is nested too deeply; write it more simply.") from None


def parse_named(
    text: object, known: Mapping[str, float], where: str, hints: Mapping[str, str] | None = None
) -> Expression:
    """Read `text` as arithmetic on the names in `known`, without channels at a lag.

    Names are checked first: `parse` would take an unknown one for a channel.

    Args:
        where: what messages begin with.
        hints: what to say of some names that are not known.

    Raises:
        InputError: anything else.
    """
    if not isinstance(text, str):
        raise InputError(
            f"{where} must be an expression in text such as 'Ts**2 / m'; got {show(text)}."
        )
    if "[" in text:
        raise InputError(
            f"{where} = {text}: a signal such as y[k-1] is not allowed here; known are "
            f"{', '.join(known)}."
        )
    for word in re.findall(r"\b[^\W\d]\w*", unicodedata.normalize("NFKC", text)):
        if word not in known and word not in FUNCTIONS and not keyword.iskeyword(word):
            hint = nearest(word, known) or f"; known are {', '.join(known)}."
            if word == "pi":
                hint = "; write 3.141592653589793, or give a channel in degrees a `scale`."
            raise InputError(
                f"{where} = {text}: unknown name '{word}'{(hints or {}).get(word, hint)}"
            )
    try:
        return parse(text, known)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def syntax_tree(text: str) -> ast.Expression:
    """Return Python's syntax tree of an expression, whatever other threads parse meanwhile.

    CPython before 3.11.8 and 3.12.2 raises SystemError where the garbage collector lets another
    thread parse in between, as JAX's callback does (gh-106905). The text is not the cause.
    """
    for _ in range(_TRIES):
        with suppress(SystemError):
            return ast.parse(text, mode="eval")
    return ast.parse(text, mode="eval")


def _read(text: str, constants: Mapping[str, float]) -> Expression:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Python's own remarks about text that is refused below
        tree = syntax_tree(text).body
    used: set[str] = set()
    _check(tree, text, constants, used)
    return Expression(text, tuple((name, float(constants[name])) for name in sorted(used)))


def _suggest(text: str, constants: Mapping[str, float]) -> None:
    """Raise InputError with the correct text for one that is written as in MATLAB."""

    def lag_text(found: re.Match[str]) -> str:
        name, lag = found[1] or found[3], found[2] or found[4] or ""
        return found[0] if name in FUNCTIONS else f"{name}[k{lag.replace(' ', '')}]"

    said, ours = [], text
    for pattern, written, sentence in (
        (_POWER, "**", "a power is **"),
        (_ELEMENTWISE, r"\1", "products and quotients are * and /"),
        (_LAGGED, lag_text, "a channel at a lag has square brackets and the index k"),
    ):
        changed = pattern.sub(written, ours)
        said, ours = ([*said, sentence] if changed != ours else said), changed
    if not said:
        return
    try:
        _read(ours, constants)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return
    raise InputError(f"'{text}': here {', '.join(said)}; write {ours}.")


def _check(node: ast.AST, text: str, constants: Mapping[str, float], used: set[str]) -> None:
    """Walk the tree once; raise InputError at the first node that is not on the list."""
    if isinstance(node, ast.Constant):
        if isinstance(node.value, bool) or not isinstance(node.value, int | float):
            raise InputError(f"'{text}': {show(node.value)} is not a number.")
        try:
            finite = math.isfinite(float(node.value))
        except OverflowError:
            finite = False
        if not finite:
            raise InputError(f"'{text}' holds a number too large for double precision.")
    elif isinstance(node, ast.Name):
        if node.id in constants:
            used.add(node.id)
        elif node.id != SAMPLING_TIME:
            raise InputError(_unknown_name(node.id, text, constants))
    elif isinstance(node, ast.Subscript):
        _lag(node, text)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.UAdd | ast.USub):
        _check(node.operand, text, constants, used)
    elif isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
        _check(node.left, text, constants, used)
        _check(node.right, text, constants, used)
    elif isinstance(node, ast.Call):
        _check_call(node, text)
        for argument in node.args:
            _check(argument, text, constants, used)
    else:
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitXor):
            raise InputError(f"'{text}': '^' is not a power here; write **, as in y[k-1]**2.")
        if isinstance(node, ast.Compare | ast.BoolOp | ast.IfExp):
            raise InputError(
                f"'{text}': '{ast.unparse(node)}' is not allowed in an expression, which has "
                "no logic; sign, min and max can switch."
            )
        what = ast.unparse(node) if isinstance(node, ast.expr) else type(node).__name__
        raise InputError(
            f"'{text}': '{what}' is not allowed in an expression; allowed are {_ALLOWED}."
        )


def _check_call(node: ast.Call, text: str) -> None:
    name = node.func.id if isinstance(node.func, ast.Name) else None
    if name is None or node.keywords or any(isinstance(a, ast.Starred) for a in node.args):
        raise InputError(
            f"'{text}': '{ast.unparse(node)}' is not allowed; functions are {', '.join(FUNCTIONS)}."
        )
    if name not in FUNCTIONS:
        hint = ", did you mean 'log'?" if name == "ln" else nearest(name, FUNCTIONS)
        raise InputError(
            f"'{text}': unknown function '{name}'{hint}; known are {', '.join(FUNCTIONS)}."
        )
    many, exact = name in _OF_MANY, 1 if name in _OF_ONE else 2
    wanted = "two or more arguments" if many else "two arguments" if exact == 2 else "one argument"
    if (len(node.args) < 2) if many else (len(node.args) != exact):
        raise InputError(f"'{text}': {name} takes {wanted}, got {len(node.args)}.")


def _free_names(node: ast.AST) -> Iterator[ast.Name]:
    """Yield the names of numbers: neither channels nor functions."""
    if isinstance(node, ast.Name):
        yield node
    elif isinstance(node, ast.Call):
        for argument in node.args:
            yield from _free_names(argument)
    elif not isinstance(node, ast.Subscript):
        for child in ast.iter_child_nodes(node):
            yield from _free_names(child)


def _lag(node: ast.Subscript, text: str) -> Lag:
    """Return the raw lag that `name[k]` or `name[k-3]` denotes."""
    if not isinstance(node.value, ast.Name):
        raise InputError(
            f"'{text}': '{ast.unparse(node)}' is not a channel at a lag such as y[k-1]."
        )
    name, index = node.value.id, node.slice
    if isinstance(index, ast.Name) and index.id == "k":
        return Lag(name, 0)
    if (
        isinstance(index, ast.BinOp)
        and isinstance(index.left, ast.Name)
        and index.left.id == "k"
        and isinstance(index.op, ast.Sub | ast.Add)
        and isinstance(index.right, ast.Constant)
        and type(index.right.value) is int
    ):
        if isinstance(index.op, ast.Add) and index.right.value > 0:
            raise InputError(
                f"'{text}': '{ast.unparse(node)}' looks ahead; a regressor uses {name}[k] or "
                "earlier samples."
            )
        if index.right.value > LARGEST_LAG:
            raise InputError(
                f"'{text}': '{ast.unparse(node)}' reaches too far back; lags up to "
                f"{LARGEST_LAG} are read."
            )
        return Lag(name, index.right.value)
    raise InputError(
        f"'{text}': the index of '{ast.unparse(node)}' must be k or k-1, k-2, … with a whole "
        "number."
    )


def _evaluate(
    node: ast.expr,
    columns: Mapping[Lag, object],
    constants: Mapping[str, float],
    xp: Any,
    text: str,
) -> Any:
    if isinstance(node, ast.Constant):
        return float(node.value)  # type: ignore[arg-type]  (checked by `parse`)
    if isinstance(node, ast.Name):
        return constants[node.id]
    if isinstance(node, ast.Subscript):
        return columns[_lag(node, text)]
    if isinstance(node, ast.UnaryOp):
        value = _evaluate(node.operand, columns, constants, xp, text)
        return -value if isinstance(node.op, ast.USub) else value
    if isinstance(node, ast.BinOp):
        left = xp.asarray(_evaluate(node.left, columns, constants, xp, text), dtype=float)
        right = _evaluate(node.right, columns, constants, xp, text)
        if isinstance(node.op, ast.Pow) and isinstance(right, float) and right.is_integer():
            right = int(right)  # repeated multiplication, fast in a free run
        return _BINARY[type(node.op)](left, right)
    assert isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    arguments = [_evaluate(argument, columns, constants, xp, text) for argument in node.args]
    if node.func.id in ("min", "max"):
        pick = xp.minimum if node.func.id == "min" else xp.maximum
        value = arguments[0]
        for other in arguments[1:]:
            value = pick(value, other)
        return value
    return getattr(xp, _ELSEWHERE.get(node.func.id, node.func.id))(*arguments)


def with_names(expression: Expression, names: Mapping[Lag, str]) -> str:
    """Return the text of an expression with a name for every raw lag: `y[k-2]**2` as `y_1 ** 2`.

    Raises:
        InputError: a lag without a name.
    """

    class Named(ast.NodeTransformer):
        def visit_Subscript(self, node: ast.Subscript) -> ast.Name:  # noqa: N802  (as `ast` asks)
            return ast.Name(names[_lag(node, expression.text)], ast.Load())

    for lag in expression.lags:
        if lag not in names:
            raise InputError(
                f"'{expression.text}': {lag} is not among {', '.join(map(str, names))}."
            )
    return ast.unparse(Named().visit(syntax_tree(expression.text)))


def _unknown_name(name: str, text: str, constants: Mapping[str, float]) -> str:
    if name == "k":
        return f"'{text}': k is the time index and not a value; write a channel at a lag, y[k-1]."
    if name in FUNCTIONS:
        return f"'{text}': {name} is a function; write {name}(…)."
    hint = (
        nearest(name, constants)
        or f"; declare it with its value, or, for a channel, give its lag, {name}[k-1]."
    )
    return f"'{text}': unknown constant '{name}'{hint}"


def in_order(definitions: Mapping[str, Expression]) -> list[str]:
    """Return the names of definitions in an order in which each follows those that it uses.

    Raises:
        InputError: definitions that need each other.
    """
    uses = {
        name: [other for other in given.names if other in definitions]
        for name, given in definitions.items()
    }
    try:
        return list(TopologicalSorter(uses).static_order())
    except CycleError as error:
        loop = " → ".join(reversed(error.args[1]))
        raise InputError(
            f"motion.define: an algebraic loop, {loop}; no definition may need itself."
        ) from None
