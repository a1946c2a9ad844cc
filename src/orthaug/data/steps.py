"""Steps of preparation, each within one experiment.

They are trends, sampling, outliers, gaps and delays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Protocol, runtime_checkable

import numpy as np
from annotated_types import Ge, Gt

from orthaug._base.checks import Matrix, Vector, check_finite, check_number, check_type, nearest
from orthaug._base.errors import InputError, show
from orthaug._base.registry import OneOf, check_fields

_MAD = 1.4826  # standard deviations of a normal variable in its median absolute deviation
_FLOOR = 0.1  # of the usual local deviation: the least that a window is taken to have
_APART = 3.0  # steps between instants from which on nothing is interpolated
_SAME = 1e-6  # of a step: instants that lie nearer are one, up to rounding
_CHUNK = 100_000  # rows of windows at once

Channels = tuple[str, ...] | None
Method = Annotated[str, OneOf(("linear", "pchip"))]


@dataclass(frozen=True, eq=False)
class Run:
    """An experiment between two steps: `values` (N, n) at `instants` [s]; NaN is missing."""

    values: Matrix
    instants: Vector
    names: tuple[str, ...]
    inputs: int
    """Number of inputs, which are the first channels."""
    step: float
    """Sampling time [s]; of uneven instants the usual one."""
    even: bool = True
    first: int = 0
    """Rows that were cut off at the begin."""
    stride: int = 1
    moved: bool = False
    """True if the samples are no rows of the file any more."""

    def columns(self, channels: Channels, usual: range | None = None) -> list[int]:
        """Return indices of channels.

        Without names they are those given as usual, by default all.
        """
        if channels is None:
            return list(range(len(self.names)) if usual is None else usual)
        check_type(channels, tuple | list, "channels", "a list of channel names")
        for name in channels:
            if name not in self.names:
                known = ", ".join(self.names)
                raise InputError(
                    f"`channels`: no channel '{name}'{nearest(name, self.names)}; there are "
                    f"{known}."
                )
        return [self.names.index(name) for name in channels]

    def outputs_or(self, channels: Channels) -> tuple[list[int], Matrix]:
        """Return indices of channels, of the outputs without names, and a copy of their values."""
        columns = self.columns(channels, range(self.inputs, len(self.names)))
        return columns, self.values[:, columns].copy()

    def with_values(self, columns: list[int], values: Matrix) -> Run:
        """Return the experiment with other values in some columns."""
        changed = self.values.copy()
        changed[:, columns] = values
        return replace(self, values=changed)

    def check_even(self, what: str) -> None:
        """Raise InputError where the instants are uneven."""
        if not self.even:
            raise InputError(f"{what} needs even sampling; put a step `resample` before it.")


@runtime_checkable
class Step(Protocol):
    """A step of preparation: a frozen declaration."""

    def apply(self, run: Run) -> Run:
        """Return the experiment after the step.

        Raises:
            InputError: what cannot be done with these samples.
        """
        ...


@dataclass(frozen=True)
class Detrend:
    """Step that removes the mean or the straight line of each channel, per experiment.

    Args:
        degree: 0 for the mean, 1 for a straight line.
        channels: names; None for all, inputs and outputs.

    Examples:
        >>> from orthaug.data import Record, prepare
        >>> record = Record.from_arrays(u=[1.0, 3.0], y=[5.0, 6.0], sampling_time=0.1)
        >>> prepare(record, Detrend()).experiments[0].inputs.T
        array([[-1.,  1.]])
    """

    degree: Annotated[int, Ge(0)] = 0
    channels: Channels = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.degree > 1:
            raise InputError(
                f"`degree` must be 0, the mean, or 1, a straight line; got {show(self.degree)}."
            )

    def apply(self, run: Run) -> Run:
        columns, t = run.columns(self.channels), run.instants - run.instants[0]
        values = run.values[:, columns].copy()
        for j in range(values.shape[1]):
            there = np.isfinite(values[:, j])
            if there.sum() > self.degree:
                values[:, j] -= np.polyval(np.polyfit(t[there], values[there, j], self.degree), t)
        return run.with_values(columns, values)


@dataclass(frozen=True)
class Resample:
    """Step that interpolates samples at uneven instants onto an even grid.

    The grid begins at the first instant.

    Nothing across more than three steps.

    Args:
        sampling_time: s; None for the median of the steps.
        method: "linear" between neighbours, or "pchip", a smooth cubic without overshoot. Both look
            at the next sample, and neither removes what is faster than the new grid: put a
            `Lowpass` before it where that matters.
    """

    sampling_time: float | None = None
    """Sampling time in s; None for the median of the steps."""
    method: Method = "linear"

    def __post_init__(self) -> None:
        check_fields(self)
        if self.sampling_time is not None:
            check_number(self.sampling_time, "sampling_time", positive=True)

    def apply(self, run: Run) -> Run:
        step, t = self.sampling_time or run.step, run.instants
        if len(t) < 2 or not (np.diff(t) > 0).all():
            raise InputError(
                "`resample` needs at least two instants, each later than the one before it."
            )
        count = np.floor((t[-1] - t[0]) / step + _SAME) + 1
        if count > 100 * len(t):
            raise InputError(
                f"`resample`: {step:g} s would make {count:.3g} samples of {len(t)}; take a "
                "longer one."
            )
        grid = t[0] + step * np.arange(int(count))
        most = _APART * max(step, run.step)
        at = _snap_to_instants(t, grid, _SAME * step)
        values = np.column_stack(
            [_interpolate(t, column, at, self.method, most) for column in run.values.T]
        )
        return replace(
            run, values=values, instants=grid, step=step, even=True, first=0, stride=1, moved=True
        )


def _snap_to_instants(t: Vector, grid: Vector, near: float) -> Vector:
    """Return the grid, with a measured instant in place of one that is near it.

    Then no sample is lost by rounding.
    """
    after = np.clip(np.searchsorted(t, grid), 1, len(t) - 1)
    closest = np.where(grid - t[after - 1] < t[after] - grid, t[after - 1], t[after])
    return np.where(np.abs(closest - grid) <= near, closest, grid)


def _interpolate(t: Vector, column: Vector, grid: Vector, method: str, most: float) -> Vector:
    """Return a channel at other instants.

    NaN outside of it, and between neighbours more than `most` apart.
    """
    there = np.isfinite(column)
    known, values = t[there], column[there]
    if len(known) < 2:
        return np.full(len(grid), np.nan)
    if method == "pchip":
        from scipy.interpolate import PchipInterpolator

        result = np.asarray(PchipInterpolator(known, values, extrapolate=False)(grid))
    else:
        result = np.interp(grid, known, values, left=np.nan, right=np.nan)
    after = np.clip(np.searchsorted(known, grid, side="left"), 1, len(known) - 1)
    apart = (
        (known[after] - known[after - 1] > most)
        & (known[after] != grid)
        & (known[after - 1] != grid)
    )
    result[apart] = np.nan
    return result


@dataclass(frozen=True)
class Outliers:
    """Step that marks samples far from the median of their window as missing (Hampel).

    They are over `threshold` deviations off the median of `window` rows on either side.

    The deviation is 1.4826 times the median absolute one.

    Args:
        window: rows on either side, 1 or more.
        threshold: deviations from which on a sample is missing.
        channels: names; None for the outputs, for inputs jump on purpose.

    Examples:
        >>> from orthaug.data import Record, prepare
        >>> y = [0.0, 0.1, 0.0, 0.1, 50.0, 0.1, 0.0, 0.1, 0.0]
        >>> record = Record.from_arrays(u=[0.0] * 9, y=y)
        >>> prepare(record, Outliers(), Fill()).experiments[0].outputs[4]
        array([0.1])
    """

    window: Annotated[int, Ge(1)] = 5
    threshold: Annotated[float, Gt(0)] = 4.0
    channels: Channels = None

    def __post_init__(self) -> None:
        check_fields(self)

    def apply(self, run: Run) -> Run:
        columns, values = run.outputs_or(self.channels)
        for x in values.T:
            distance, deviation = self.distances(x)
            x[distance > self.threshold * deviation] = np.nan
        return run.with_values(columns, values)

    def distances(self, x: Vector) -> tuple[Vector, Vector]:
        """Return the distance of each sample from the median of its window, and the deviation.

        NaN where one is missing.
        """
        if len(x) < 2:
            return np.zeros(len(x)), np.zeros(len(x))
        width = min(self.window, len(x) - 1)
        rows = np.lib.stride_tricks.sliding_window_view(
            np.pad(x, width, mode="reflect"), 2 * width + 1
        )
        middle, spread = np.full(len(x), np.nan), np.full(len(x), np.nan)
        for begin in range(0, len(x), _CHUNK):
            part = slice(begin, begin + _CHUNK)
            some = np.isfinite(rows[part]).any(axis=1)
            near = rows[part][some]
            median = np.median if np.isfinite(near).all() else np.nanmedian  # the same, but faster
            middle[part][some] = median(near, axis=1)
            spread[part][some] = median(np.abs(near - middle[part][some, None]), axis=1)
        usual = spread[spread > 0]
        least = _FLOOR * float(np.median(usual)) if len(usual) else 0.0
        return np.abs(x - middle), _MAD * np.maximum(spread, least)


@dataclass(frozen=True)
class Repeats:
    """Step that marks samples equal to the one before as missing.

    A sensor that is slower than the rows, and whose last value is held, was sampled at the others.

    Args:
        channels: names; None for the outputs.

    Examples:
        >>> from orthaug.data import Record, prepare
        >>> record = Record.from_arrays(u=[0.0] * 4, y=[1.0, 1.0, 3.0, 3.0])
        >>> prepare(record, Repeats(), missing="keep").experiments[0].outputs.ravel()
        array([ 1., nan,  3., nan])
    """

    channels: Channels = None

    def __post_init__(self) -> None:
        check_fields(self)

    def apply(self, run: Run) -> Run:
        columns, values = run.outputs_or(self.channels)
        values[1:][values[1:] == values[:-1]] = np.nan
        return run.with_values(columns, values)


@dataclass(frozen=True)
class Limits:
    """Step that marks samples at the end of a sensor's range, and beyond, as missing.

    Args:
        low: samples at most as large are missing; None for none.
        high: samples at least as large are missing.
        channels: names; None for the outputs.

    Examples:
        >>> from orthaug.data import Record, prepare
        >>> record = Record.from_arrays(u=[0.0] * 4, y=[1.0, 8.0, 10.0, 10.0])
        >>> prepare(record, Limits(high=10.0), missing="keep").experiments[0].outputs.ravel()
        array([ 1.,  8., nan, nan])
    """

    low: float | None = None
    high: float | None = None
    channels: Channels = None

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("low", "high"):
            value = getattr(self, name)
            if value is not None:
                check_finite(value, f"`{name}`")
        if self.low is None and self.high is None:
            raise InputError("`limits` has neither `low` nor `high`; give one of them.")

    def apply(self, run: Run) -> Run:
        columns, values = run.outputs_or(self.channels)
        with np.errstate(invalid="ignore"):
            beyond = np.zeros(values.shape, dtype=bool)
            beyond |= False if self.low is None else values <= self.low
            beyond |= False if self.high is None else values >= self.high
        values[beyond] = np.nan
        return run.with_values(columns, values)


@dataclass(frozen=True)
class Fill:
    """Step that reconstructs gaps of at most `most` samples between measured ones.

    Longer ones stay.

    Args:
        most: samples of a gap that is filled.
        method: "linear" between the neighbours, or "pchip", a smooth cubic without overshoot.
        channels: names; None for all, inputs and outputs.
    """

    most: Annotated[int, Ge(1)] = 3
    method: Method = "linear"
    channels: Channels = None

    def __post_init__(self) -> None:
        check_fields(self)

    def apply(self, run: Run) -> Run:
        columns, t = run.columns(self.channels), run.instants
        values = run.values[:, columns].copy()
        for x in values.T:
            there = np.flatnonzero(np.isfinite(x))
            if not len(there):
                continue
            guess = _interpolate(t, x, t, self.method, np.inf)
            for a, b in zip(there[:-1], there[1:], strict=True):
                if 1 < b - a <= self.most + 1:
                    x[a + 1 : b] = guess[a + 1 : b]
        return run.with_values(columns, values)


@dataclass(frozen=True)
class Unwrap:
    """Step that takes the jumps of an angle out, by multiples of its `period`.

    Args:
        period: in the channel's unit after its scale, such as 360 or 2π.
        channels: names of the angles.

    Examples:
        >>> from orthaug.data import Record, prepare
        >>> record = Record.from_arrays(u=[0.0] * 4, y=[170.0, 178.0, -174.0, -166.0])
        >>> prepare(record, Unwrap(360.0, ("y",))).experiments[0].outputs.ravel()
        array([170., 178., 186., 194.])
    """

    period: Annotated[float, Gt(0)]
    channels: Channels = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.channels is None:
            raise InputError("`unwrap` needs `channels`: the angles that wrap.")

    def apply(self, run: Run) -> Run:
        columns = run.columns(self.channels)
        values = run.values[:, columns].copy()
        for column in values.T:
            there = np.isfinite(column)
            column[there] = np.unwrap(column[there], period=self.period)
        return run.with_values(columns, values)


@dataclass(frozen=True)
class Shift:
    """Step that delays an input by `samples`: row k gets the value of row k − samples.

    Between two rows that is on the straight line from one to the other. The rows without one are
    cut off.

    Args:
        channel: an input's name.
        samples: a number of rows, such as 2 or 2.4; negative to let the input come earlier.

    Examples:
        >>> from orthaug.data import Record, prepare
        >>> record = Record.from_arrays(u=[1.0, 2.0, 3.0], y=[4.0, 5.0, 6.0])
        >>> moved = prepare(record, Shift("u", 1)).experiments[0]
        >>> moved.inputs.T, moved.outputs.T
        (array([[1., 2.]]), array([[5., 6.]]))
    """

    channel: str
    samples: float

    def __post_init__(self) -> None:
        check_type(self.channel, str, "channel", "an input's name")
        check_finite(self.samples, "`samples`")
        if self.samples == int(self.samples):
            object.__setattr__(self, "samples", int(self.samples))

    def apply(self, run: Run) -> Run:
        if self.channel not in run.names[: run.inputs]:
            raise InputError(
                f"`channel`: '{self.channel}' is no input; the inputs are "
                f"{', '.join(run.names[: run.inputs])}."
            )
        run.check_even("`shift`")
        j, n, late = run.names.index(self.channel), len(run.values), self.samples
        if abs(late) >= n:
            raise InputError(
                f"`samples`: an experiment has {n} rows, too few to be shifted by {late}."
            )
        whole = math.floor(late)
        kept = slice(max(math.ceil(late), 0), n + min(whole, 0))
        values, column = run.values[kept].copy(), run.values[:, j]
        values[:, j] = column[kept.start - whole : kept.stop - whole]
        if part := late - whole:
            before = column[kept.start - whole - 1 : kept.stop - whole - 1]
            values[:, j] = (1 - part) * values[:, j] + part * before
        first = run.first + run.stride * kept.start
        return replace(run, values=values, instants=run.instants[kept], first=first)
