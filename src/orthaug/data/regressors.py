"""Regressors: lags of channels, their matrix over a record, and the learner's features.

Order, everywhere: outputs in order, each k-1 … k-na; then inputs in order, each k-nk … k-nk-nb+1.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix
from orthaug._base.errors import InputError, show
from orthaug._base.lines import plural
from orthaug.data.expressions import LARGEST_LAG, Expression, Lag
from orthaug.data.record import Experiment, Record

Layout = tuple[Lag, ...]


@dataclass(frozen=True)
class Lags:
    """Lags as orders in MATLAB: `y[k-1..k-na]` and `u[k-nk..k-nk-nb+1]`.

    One number, or one per channel.

    The paper's `u_k … u_{k-n_b}` is `nk = 0, nb = n_b + 1`.

    Examples:
        >>> [str(lag) for lag in Lags(na=2, nb=1, nk=1).layout(["y"], ["u"])]
        ['y[k-1]', 'y[k-2]', 'u[k-1]']
    """

    na: int | Sequence[int] = 0
    nb: int | Sequence[int] = 0
    nk: int | Sequence[int] = 1

    def layout(self, outputs: Sequence[str], inputs: Sequence[str]) -> Layout:
        """Return the raw lags in regressor order.

        Raises:
            InputError: negative orders, or a list whose length is not the number of channels.
        """
        na = _per_channel(self.na, outputs, "na", "output")
        nb = _per_channel(self.nb, inputs, "nb", "input")
        nk = _per_channel(self.nk, inputs, "nk", "input")
        past_outputs = [
            Lag(name, i) for name, n in zip(outputs, na, strict=True) for i in range(1, n + 1)
        ]
        past_inputs = [
            Lag(name, i) for name, n, d in zip(inputs, nb, nk, strict=True) for i in range(d, d + n)
        ]
        return (*past_outputs, *past_inputs)


def _per_channel(
    value: int | Sequence[int], names: Sequence[str], key: str, kind: str
) -> list[int]:
    given: Any = value
    several = isinstance(given, Sequence) or (isinstance(given, np.ndarray) and given.ndim > 0)
    values: list[Any] = list(given) if several else [given] * len(names)
    if len(values) != len(names):
        raise InputError(
            f"`{key}` has {plural(len(values), 'number')} for {plural(len(names), kind)}; give "
            f"one number, or one per {kind}."
        )
    if any(isinstance(v, bool) or not isinstance(v, int | np.integer) or v < 0 for v in values):
        raise InputError(f"`{key}` must be whole numbers, 0 or more; got {show(value)}.")
    if any(v > LARGEST_LAG for v in values):
        raise InputError(f"`{key}` must be at most {LARGEST_LAG}; got {show(value)}.")
    return [int(v) for v in values]


def in_order(lags: Iterable[Lag], outputs: Sequence[str], inputs: Sequence[str]) -> Layout:
    """Return the distinct lags in regressor order.

    Raises:
        InputError: an unknown channel, or an output at lag 0 (the model would look at what it
            predicts).
    """
    place = {name: i for i, name in enumerate((*outputs, *inputs))}
    for lag in lags:
        if lag.channel not in place:
            raise InputError(
                f"'{lag}' uses the unknown channel '{lag.channel}'; known are {', '.join(place)}."
            )
        if lag.lag == 0 and lag.channel in outputs:
            raise InputError(
                f"'{lag}' is the output that is to be predicted; outputs are used from lag 1, "
                f"{lag.channel}[k-1]."
            )
    return tuple(sorted(set(lags), key=lambda lag: (place[lag.channel], lag.lag)))


def largest_lag(layout: Layout) -> int:
    """Return the first row of an experiment at which every lag of the layout exists."""
    return max((lag.lag for lag in layout), default=0)


def lag_matrix(experiment: Experiment, layout: Layout, record: Record, start: int) -> Matrix:
    """Return rows `start … N-1` of the regressor, (N - start, len(layout)).

    The matrix is column by column in memory.

    Never reaches before the experiment.
    """
    column = {channel.name: experiment.outputs[:, i] for i, channel in enumerate(record.outputs)}
    column |= {channel.name: experiment.inputs[:, i] for i, channel in enumerate(record.inputs)}
    matrix = np.empty((max(len(experiment) - start, 0), len(layout)), order="F")
    for j, lag in enumerate(layout):
        matrix[:, j] = column[lag.channel][start - lag.lag : start - lag.lag + len(matrix)]
    return matrix


def lag_rows(record: Record, layout: Layout) -> Matrix:
    """Return the regressors of all rows from the largest lag on, (N, len(layout)).

    The rows of all experiments follow each other.
    """
    start = largest_lag(layout)
    return np.concatenate(
        [lag_matrix(experiment, layout, record, start) for experiment in record.experiments]
    )


@dataclass(frozen=True, eq=False)
class UsableRows:
    """The usable rows of a record: regressors `x` (N, nx), outputs `y` (N, ny).

    The rows of all experiments follow each other.
    """

    x: Matrix
    y: Matrix
    layout: Layout
    start: int

    def __len__(self) -> int:
        return len(self.x)


def stack_rows(record: Record, layout: Layout) -> UsableRows:
    """Return all rows from the largest lag on, experiment after experiment.

    Raises:
        InputError: an experiment with too few rows for a single prediction.
    """
    start = largest_lag(layout)
    for i, experiment in enumerate(record.experiments):
        if len(experiment) <= start:
            name = experiment.source or f"experiment {i}"
            raise InputError(
                f"{name} has {plural(len(experiment), 'row')}, too few: the largest lag is "
                f"{start}, so at least {start + 1} are needed."
            )
    x = lag_rows(record, layout)
    y = [experiment.outputs[start:] for experiment in record.experiments]
    return UsableRows(x, np.concatenate(y), layout, start)


@dataclass(frozen=True)
class Features:
    """Features of the learner: expressions of the regressor, most often single raw lags.

    With `linear` the learner can be their linear combinations only.
    """

    entries: tuple[Expression, ...]
    linear: bool = False

    @classmethod
    def of(cls, layout: Layout) -> Features:
        """Return all raw lags of a layout."""
        return cls(tuple(Expression(str(lag)) for lag in layout))

    @property
    def lags(self) -> tuple[Lag, ...]:
        """The raw lags that the features read."""
        return tuple(dict.fromkeys(lag for entry in self.entries for lag in entry.lags))

    def sampled(self, sampling_time: float) -> Features:
        """Return the features with this value [s] of `Ts`, where they read it."""
        return Features(tuple(entry.sampled(sampling_time) for entry in self.entries), self.linear)

    def evaluate(self, x: Any, layout: Layout, xp: Any) -> Any:
        """Return features (…, nz) of regressors (…, nx), computed by `xp` (numpy or jax.numpy)."""
        if not self.entries:
            return xp.zeros((*x.shape[:-1], 0))
        columns = {lag: x[..., j] for j, lag in enumerate(layout)}
        values = [xp.asarray(entry.evaluate(columns, xp), dtype=float) for entry in self.entries]
        return xp.moveaxis(
            xp.stack([xp.broadcast_to(v, x.shape[:-1]) for v in values]), 0, -1
        )  # a column in one piece
