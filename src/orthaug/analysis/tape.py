"""Expressions as a tape: what NumPy does with them is recorded once and then repeated, each common part once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from orthaug.data.expressions import Expression, Lag


class Node(np.lib.mixins.NDArrayOperatorsMixin):
    """A value on a tape; what NumPy does with it is recorded."""

    def __init__(self, tape: Tape, slot: int):
        self.tape, self.slot = tape, slot

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *arguments: Any) -> Node:
        return self.tape.record(ufunc, *arguments)


class Tape:
    """Stands for NumPy while expressions are evaluated once, and then repeats what they did, each part once."""

    def __init__(self) -> None:
        self.values: list[Any] = []
        self.known: dict[Any, Node] = {}
        self.steps: list[tuple[Callable[..., Any], int, int, int]] = []
        self.lags: dict[Lag, int] = {}

    def __getattr__(self, name: str) -> Callable[..., Node]:
        return lambda *arguments: self.record(getattr(np, name), *arguments)

    def asarray(self, value: Any, dtype: Any = None) -> Node:
        return value if isinstance(value, Node) else self._node(float(value), np.float64(value))

    def record(self, function: Callable[..., Any], *arguments: Any) -> Node:
        slots = [self.asarray(argument).slot for argument in arguments]
        if (function, *slots) not in self.known:
            self.steps.append((function, slots[0], slots[1] if len(slots) > 1 else -1, len(self.values)))
        return self._node((function, *slots))

    def trace(self, expression: Expression, coefficient: float | None = None) -> Node:
        """The value of an expression, times a coefficient if given."""
        nodes = {lag: self._node(lag) for lag in expression.lags}
        self.lags |= {lag: node.slot for lag, node in nodes.items()}
        value = self.asarray(expression.evaluate(nodes, self))
        return value if coefficient is None else self.record(np.multiply, value, coefficient)

    def total(self, values: Sequence[Node]) -> Node:
        return sum(values[1:], values[0]) if values else self.asarray(0.0)

    def _node(self, key: Any, value: Any = None) -> Node:
        if key not in self.known:
            self.known[key] = Node(self, len(self.values))
            self.values.append(value)
        return self.known[key]

    def replay(self, columns: Iterable[Any], wanted: Sequence[int]) -> list[Any]:
        """Values of the wanted slots for one column for each of `lags`, in their order."""
        values = self.values
        for slot, column in zip(self.lags.values(), columns, strict=True):
            values[slot] = column
        for function, a, b, out in self.steps:
            values[out] = function(values[a]) if b < 0 else function(values[a], values[b])
        return [values[slot] for slot in wanted]
