"""Noise-free simulation of physics and suspects for many inputs side by side.

Difference equations run by a tape: it records once what NumPy does with the expressions and then
repeats it, each common part once. Motions run by one compiled scan with their sensitivities.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Vector, check_choice, check_unique
from orthaug._base.errors import InputError
from orthaug._base.jax import Array, jax, quick_jit
from orthaug.analysis.suspects import MotionSuspect, Suspect
from orthaug.data.expressions import Expression, Lag
from orthaug.data.regressors import in_order, largest_lag
from orthaug.models.dynamics import Numbers
from orthaug.models.learners import nothing_learned
from orthaug.models.moving import MotionDynamics
from orthaug.physics.baseline import Baseline
from orthaug.physics.integrators import inputs_at_points
from orthaug.physics.motion import Motion
from orthaug.physics.suspected_motion import SuspectedMotion

RUNS_AWAY = 1e4  # largest output of the second half of a record over that of the first
_WIDTH = 64  # motions that run side by side: every number of them by the same program


def choose_channel(channel: str | None, inputs: Sequence[str]) -> str:
    """Return the input to design: the one that is asked for, or the only one.

    Raises:
        InputError: another name, or none where there are several.
    """
    if channel is not None:
        return check_choice(channel, inputs, "`channel`")
    if len(inputs) != 1:
        names = ", ".join(inputs) or "none"
        raise InputError(f"`channel` is missing: the input to design, one of the inputs ({names}).")
    return inputs[0]


def check_guesses(suspects: Sequence[Any]) -> None:
    """Raise InputError for suspects without a coefficient, or with memory."""
    check_unique((suspect.name for suspect in suspects), "suspect")
    for suspect in suspects:
        if suspect.memory is not None:
            raise InputError(
                f"suspect '{suspect.name}' has memory, which a design does not count. Leave it out "
                "of the spec of the design."
            )
        if suspect.coefficient is None:
            raise InputError(
                f"suspect '{suspect.name}' has no `coefficient`; a design needs a guess of its "
                "size."
            )


class Node(np.lib.mixins.NDArrayOperatorsMixin):
    """A value on a tape; what NumPy does with it is recorded."""

    def __init__(self, tape: Tape, slot: int):
        self.tape, self.slot = tape, slot

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *arguments: object) -> Node:
        return self.tape.record(ufunc, *arguments)


class Tape:
    """Tape of the NumPy operations of expressions, recorded once and repeated, each part once."""

    def __init__(self) -> None:
        self.values: list[object] = []
        self.known: dict[object, Node] = {}
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

    def _node(self, key: object, value: object = None) -> Node:
        if key not in self.known:
            self.known[key] = Node(self, len(self.values))
            self.values.append(value)
        return self.known[key]

    def replay(self, columns: Iterable[object], wanted: Sequence[int]) -> list[Any]:
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
        self.channel = choose_channel(channel, inputs)
        baseline.check_channels(outputs, inputs)
        check_guesses(suspects)
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


class MotionPlant:
    """A motion at p (np,) for a design: rows of sensitivities of its outputs, without the start.

    A run starts from the declared numbers, and from zero where none is declared.
    """

    start = 0

    def __init__(
        self,
        motion: Motion,
        suspects: Sequence[MotionSuspect],
        p: Vector,
        sampling_time: float,
        substeps: int,
        channel: str | None = None,
    ) -> None:
        self.channel = choose_channel(channel, motion.external)
        check_guesses(suspects)
        self.names, self.theta, self.motion = motion.names, np.asarray(p, dtype=float), motion
        self.outputs: Sequence[str] = tuple(output.name for output in motion.outputs)
        self.others = {name: np.zeros((1, 1)) for name in motion.external if name != self.channel}
        starts = [state.start for state in motion.states]
        self.before = np.array(
            [start if isinstance(start, float | int) else 0.0 for start in starts], dtype=float
        )
        suspected = SuspectedMotion.of(motion, [suspect.term(motion) for suspect in suspects])
        self._form = MotionDynamics(suspected, (), nothing_learned(), sampling_time, substeps)
        self._coefficients = np.array([suspect.coefficient for suspect in suspects], dtype=float)
        coordinates = motion.coordinates
        q = coordinates.of(self.theta)
        self._slopes = coordinates.slopes(q)
        c = np.concatenate([q, self._coefficients])
        self._numbers = Numbers(
            c, np.zeros_like(c), np.zeros(0), np.zeros(0), np.ones(0), np.ones(0)
        )

    def rows(
        self, u: Float[np.ndarray, "N M"]
    ) -> tuple[Float[np.ndarray, "M N ny np+1"], np.ndarray]:
        """Return rows `[∂y/∂p Δ]` without the start's effect; zero where the run runs away.

        The weights of the outputs (M, 1, ny, 1) come with them.
        """
        pieces = [
            self._piece(u[:, first : first + _WIDTH]) for first in range(0, u.shape[1], _WIDTH)
        ]
        rows, deviation = (np.concatenate(part) for part in zip(*pieces, strict=True))
        ny = rows.shape[2]
        return rows, 1 / np.where((deviation > 0) & (ny > 1), deviation, 1.0)[:, None, :, None]

    def _piece(
        self, u: Float[np.ndarray, "N m"]
    ) -> tuple[Float[np.ndarray, "m N ny np+1"], Float[np.ndarray, "m ny"]]:
        (length, count), motion = u.shape, self.motion
        padded = np.concatenate([u, np.repeat(u[:, -1:], _WIDTH - count, axis=1)], axis=1)
        signals = {
            name: np.broadcast_to(np.resize(v, (length, 1)), padded.shape)
            for name, v in self.others.items()
        }
        together = np.stack(
            [{self.channel: padded, **signals}[name] for name in motion.external], axis=1
        )
        read = np.stack(
            [
                inputs_at_points(one, motion.hold, self._form.substeps)
                for one in np.moveaxis(together, -1, 0)
            ],
            axis=-1,
        )
        start = np.repeat(self.before[:, None], _WIDTH, axis=1)
        values, slopes = (
            np.asarray(part)[..., :count] for part in _run(self._form, self._numbers, start, read)
        )
        with np.errstate(all="ignore"):
            size, half = np.abs(values), length // 2
            early, late = size[:half].max(axis=0), size[half:].max(axis=0)
            sound = (late <= RUNS_AWAY * np.where(early > 0, early, late)).all(axis=0)
        sound &= np.isfinite(slopes).all(axis=(0, 1, 2)) & np.isfinite(values).all(axis=(0, 1))
        slopes = np.moveaxis(np.where(sound, slopes, 0.0), -1, 0)  # (m, N, ny, nx + np + ns)
        nx, nt = self._form.states, len(self.theta)
        missing = slopes[..., nx + nt :] @ self._coefficients
        rows = np.concatenate(
            [slopes[..., nx : nx + nt] / self._slopes, missing[..., None]], axis=-1
        )
        deviation = np.where(sound, np.where(sound, values, 0.0).std(axis=0), 1.0).T
        return _remove_starts(slopes[..., :nx], rows), deviation


def _remove_starts(start: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return rows (m, N, ny, k) less the effect of unknown starts (m, N, ny, nx)."""
    shape, flat = rows.shape, start.reshape(len(start), -1, start.shape[-1])
    size = np.linalg.norm(flat, axis=1, keepdims=True)
    basis = np.linalg.svd(flat / np.where(size > 0, size, 1.0), full_matrices=False)
    kept = np.where(basis[1] > 1e-10, 1.0, 0.0)[:, None, :]
    q = basis[0] * kept
    own = rows.reshape(len(rows), -1, shape[-1])
    return (own - q @ (np.swapaxes(q, 1, 2) @ own)).reshape(shape)


@partial(quick_jit, static_argnames="form")
def _run(
    form: MotionDynamics,
    numbers: Numbers,
    start: Float[Array, "nx m"],
    inputs: Float[Array, "T nu m"],
) -> tuple[Float[Array, "T ny m"], Float[Array, "T ny n m"]]:
    """Return outputs of every run, and their sensitivities to start and coordinates."""
    numbers = form.prepare(numbers)

    def step(carry: Any, row: Any) -> Any:
        state, slopes = carry
        state, slopes, value, slope = form.tangents(numbers, state, slopes, row)
        return (state, slopes), (value, slope)

    return jax.lax.scan(step, (start, form.first_slopes(start.shape[1])), inputs)[1]
