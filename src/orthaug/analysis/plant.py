"""Noise-free simulation of physics and suspects for many inputs side by side, by a tape.

The tape records once what NumPy does with the expressions and then repeats it, each common part
once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Vector, check_choice, check_unique
from orthaug._base.errors import InputError
from orthaug.analysis.suspects import Suspect
from orthaug.data.expressions import Expression, Lag
from orthaug.data.regressors import in_order, largest_lag
from orthaug.physics.baseline import Baseline

RUNS_AWAY = 1e4  # largest output of the second half of a record over that of the first


class Node(np.lib.mixins.NDArrayOperatorsMixin):
    """A value on a tape; what NumPy does with it is recorded."""

    def __init__(self, tape: Tape, slot: int):
        self.tape, self.slot = tape, slot

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *arguments: Any) -> Node:
        return self.tape.record(ufunc, *arguments)


class Tape:
    """Tape of the NumPy operations of expressions, recorded once and repeated, each part once."""

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
            self.steps.append(
                (function, slots[0], slots[1] if len(slots) > 1 else -1, len(self.values))
            )
        return self._node((function, *slots))

    def trace(self, expression: Expression, coefficient: float | None = None) -> Node:
        """Return the value of an expression, times a coefficient if given."""
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
        """Return values of the wanted slots from one column for each of `lags`, in their order."""
        values = self.values
        for slot, column in zip(self.lags.values(), columns, strict=True):
            values[slot] = column
        for function, a, b, out in self.steps:
            values[out] = function(values[a]) if b < 0 else function(values[a], values[b])
        return [values[slot] for slot in wanted]


class Plant:
    """The physics at θ with the suspected terms, simulated for many inputs side by side."""

    def __init__(
        self,
        baseline: Baseline,
        channels: Any,
        suspects: Sequence[Suspect],
        theta: Vector,
        channel: Any,
    ):
        outputs, inputs = channels
        if channel is None and len(inputs) != 1:
            raise InputError(
                "`channel` is missing: the input to design, one of the inputs "
                f"({', '.join(inputs)})."
            )
        self.channel = inputs[0] if channel is None else check_choice(channel, inputs, "`channel`")
        baseline.check_channels(outputs, inputs)
        check_unique((suspect.name for suspect in suspects), "suspect")
        self.names, self.theta = baseline.names, theta
        self.outputs: Sequence[str] = outputs
        self.others = {name: np.zeros((1, 1)) for name in inputs if name != self.channel}
        self.before = np.zeros((0, 0))
        self.tape, nt = Tape(), len(theta)
        parts: list[list[list[Node]]] = [
            [[] for _ in range(nt + 2)] for _ in outputs
        ]  # φ, then δ, then fixed terms
        for term, expression in zip(baseline.terms, baseline.expressions, strict=True):
            i = 0 if term.output is None else outputs.index(term.output)
            j = nt + 1 if term.fixed else self.names.index(term.parameter)
            parts[i][j].append(
                self.tape.trace(expression, (term.initial or 0.0) if term.fixed else None)
            )
        for suspect in suspects:
            in_order(suspect.lags, outputs, inputs)
            if suspect.coefficient is None:
                raise InputError(
                    f"suspect '{suspect.name}' has no `coefficient`; a design needs a guess of "
                    "its size."
                )
            parts[suspect.column_of(outputs)][nt].append(
                self.tape.trace(suspect.parsed, suspect.coefficient)
            )
        table = [[self.tape.total(entry) for entry in row] for row in parts]
        scaled = [
            [*(v * t for v, t in zip(row, theta.tolist(), strict=False)), *row[nt:]]
            for row in table
        ]
        if self.channel not in {lag.channel for lag in self.tape.lags}:
            raise InputError(
                f"no term reads the input '{self.channel}', so that it cannot be designed."
            )
        self.start = largest_lag(tuple(self.tape.lags))
        self._total = [self.tape.total(row).slot for row in scaled]
        self._table = [node.slot for row in table for node in row]

    def rows(
        self, u: Float[np.ndarray, "N M"]
    ) -> tuple[Float[np.ndarray, "M R ny nt+1"], np.ndarray]:
        """Return rows `[Φ Δ]`, zero where they run away, and outputs' weights (M, 1, ny, 1)."""
        (length, count), start, half = u.shape, self.start, len(u) // 2
        y = np.zeros((len(self.outputs), length, count))
        y[:, :start] = self.before.T[:, :, None]
        signals = {self.channel: u} | {
            name: np.resize(v, (length, 1)) for name, v in self.others.items()
        }
        signals |= dict(zip(self.outputs, y, strict=True))
        reads = [(signals[lag.channel], lag.lag) for lag in self.tape.lags]
        with np.errstate(all="ignore"):
            for k in range(start, length):
                for i, value in enumerate(
                    self.tape.replay([s[k - lag] for s, lag in reads], self._total)
                ):
                    y[i, k] = value
            columns = [
                signals[lag.channel][start - lag.lag : length - lag.lag] for lag in self.tape.lags
            ]
            rows = np.empty((count, length - start, len(self._table)))
            for j, value in enumerate(self.tape.replay(columns, self._table)):
                rows[:, :, j] = np.transpose(value)
            early, late = np.abs(y[:, :half]).max(axis=1), np.abs(y[:, half:]).max(axis=1)
            sound = np.isfinite(rows).all(axis=(1, 2)) & (
                late <= RUNS_AWAY * np.where(early > 0, early, late)
            ).all(0)
            rows = rows.reshape(count, length - start, len(self.outputs), -1)
            deviation = y[:, start:].transpose(2, 1, 0).std(axis=1)[:, None, :, None]
        rows[~sound], deviation[~sound] = 0.0, 1.0
        return rows[..., :-1], 1 / np.where((deviation > 0) & (len(y) > 1), deviation, 1.0)
