"""Steps of preparing data: trends, filters, other sampling, outliers, gaps, delays. Each acts within one experiment."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Any, Protocol

import numpy as np
from annotated_types import Ge, Gt

from orthaug._base.checks import Matrix, Vector, check_number, check_type, nearest
from orthaug._base.errors import InputError, shown
from orthaug._base.registry import OneOf, Registry, check_fields

_MAD = 1.4826  # standard deviations of a normal variable in its median absolute deviation
_FLOOR = 0.1  # of the usual local deviation: the least that a window is taken to have
_APART = 3.0  # steps between instants from which on nothing is interpolated
_SAME = 1e-6  # of a step: instants that lie nearer are one, up to rounding
_ANTI_ALIAS, _RIPPLE, _CORNER = 8, 0.05, 0.8  # Chebyshev filter of decimation: order, dB, share of the new Nyquist
_CHUNK = 100_000  # rows of windows at once

Phase = Annotated[str, OneOf(("zero", "causal"))]
Method = Annotated[str, OneOf(("linear", "pchip"))]
Channels = tuple[str, ...] | None


@dataclass(frozen=True, eq=False)
class Run:
    """An experiment on its way through the steps: `values` (N, n), NaN where a sample is missing, at `instants` [s]."""

    values: Matrix
    instants: Vector
    names: tuple[str, ...]
    inputs: int
    """How many of the channels, the first ones, are inputs."""
    step: float
    """Sampling time [s]; of uneven instants the usual one."""
    even: bool = True
    first: int = 0
    """Rows that were cut off at the begin."""
    stride: int = 1
    moved: bool = False
    """Whether the samples are no rows of the file any more."""

    def columns(self, channels: Channels, usual: range | None = None) -> list[int]:
        """Indices of channels; without names the usual ones, which are all unless given."""
        if channels is None:
            return list(range(len(self.names)) if usual is None else usual)
        check_type(channels, tuple | list, "channels", "a list of channel names")
        for name in channels:
            if name not in self.names:
                known = ", ".join(self.names)
                raise InputError(f"`channels`: no channel '{name}'{nearest(name, self.names)}; there are {known}.")
        return [self.names.index(name) for name in channels]

    def holding(self, columns: list[int], values: Matrix) -> Run:
        """The same with other values in some columns."""
        changed = self.values.copy()
        changed[:, columns] = values
        return replace(self, values=changed)

    def check_even(self, what: str) -> None:
        """Raise InputError where the instants are uneven."""
        if not self.even:
            raise InputError(f"{what} needs even sampling; put a step `resample` before it.")


class Step(Protocol):
    """A step of preparation: a frozen declaration."""

    def apply(self, run: Run) -> Run:
        """The experiment after the step.

        Raises:
            InputError: what cannot be done with these samples.
        """
        ...


def stretches(values: Matrix) -> Iterator[slice]:
    """Half-open ranges of rows without a missing sample."""
    there = np.isfinite(values).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], there, [False]]).astype(int)))
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        yield slice(begin, end)


def _filtered(values: Matrix, sections: Matrix, phase: str, what: str) -> Matrix:
    """Every stretch without a gap through a filter; those too short for it are missing."""
    from scipy.signal import sosfilt, sosfilt_zi, sosfiltfilt

    result, pad = np.full_like(values, np.nan), 3 * (2 * len(sections) + 1)
    for part in stretches(values):
        piece = values[part]
        if phase == "causal":
            start = sosfilt_zi(sections)[:, :, None] * piece[0]
            result[part] = sosfilt(sections, piece, axis=0, zi=start)[0]
        elif len(piece) > pad:
            result[part] = sosfiltfilt(sections, piece, axis=0, padtype="odd", padlen=pad)
    if not np.isfinite(result).all(axis=1).any():
        longest = max((part.stop - part.start for part in stretches(values)), default=0)
        raise InputError(
            f"{what}: the longest stretch without a gap has {longest} rows, a filter of zero phase needs {pad + 1}: "
            'fill gaps before, take a lower order, or phase = "causal".'
        )
    return result


@dataclass(frozen=True)
class Detrend:
    """Takes the mean (`degree` 0) or the straight line (1) out of each channel, of each experiment its own."""

    degree: Annotated[int, Ge(0)] = 0
    channels: Channels = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.degree > 1:
            raise InputError(f"`degree` must be 0, the mean, or 1, a straight line; got {shown(self.degree)}.")

    def apply(self, run: Run) -> Run:
        columns, t = run.columns(self.channels), run.instants - run.instants[0]
        values = run.values[:, columns].copy()
        for j in range(values.shape[1]):
            there = np.isfinite(values[:, j])
            if there.sum() > self.degree:
                values[:, j] -= np.polyval(np.polyfit(t[there], values[there, j], self.degree), t)
        return run.holding(columns, values)


@dataclass(frozen=True)
class _Butterworth:
    """A Butterworth filter. Of zero phase it goes forth and back, which squares its gain: −6 dB at the cutoff."""

    cutoff: Annotated[float, Gt(0)]
    """Hz"""
    order: Annotated[int, Ge(1)] = 4
    phase: Phase = "zero"
    channels: Channels = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.order > 10:
            raise InputError(f"`order` must be at most 10; got {shown(self.order)}.")

    def _through(self, run: Run, kind: str) -> Run:
        from scipy.signal import butter

        run.check_even(f"`{kind}`")
        nyquist = 0.5 / run.step
        if self.cutoff >= nyquist:
            raise InputError(
                f"`cutoff`: {self.cutoff:g} Hz is not below {nyquist:g} Hz, half the sampling frequency at steps of "
                f"{run.step:g} s; take a lower one."
            )
        columns = run.columns(self.channels)
        sections = np.asarray(butter(self.order, self.cutoff / nyquist, kind, output="sos"))
        return run.holding(columns, _filtered(run.values[:, columns], sections, self.phase, f"`{kind}`"))


@dataclass(frozen=True)
class Lowpass(_Butterworth):
    """A Butterworth low-pass over all channels alike; `cutoff` in Hz."""

    def apply(self, run: Run) -> Run:
        return self._through(run, "lowpass")


@dataclass(frozen=True)
class Highpass(_Butterworth):
    """A Butterworth high-pass over all channels alike; `cutoff` in Hz."""

    def apply(self, run: Run) -> Run:
        return self._through(run, "highpass")


@dataclass(frozen=True)
class Decimate:
    """Keeps each `factor`-th row behind a Chebyshev low-pass of order 8 at 0.8 of the new Nyquist frequency."""

    factor: Annotated[int, Ge(2)]
    phase: Phase = "zero"

    def __post_init__(self) -> None:
        check_fields(self)

    def apply(self, run: Run) -> Run:
        from scipy.signal import cheby1

        run.check_even("`decimate`")
        sections = np.asarray(cheby1(_ANTI_ALIAS, _RIPPLE, _CORNER / self.factor, output="sos"))
        values = _filtered(run.values, sections, self.phase, "`decimate`")[:: self.factor]
        kept = replace(run, values=values, instants=run.instants[:: self.factor], step=run.step * self.factor)
        return replace(kept, stride=run.stride * self.factor)


@dataclass(frozen=True)
class Resample:
    """Uneven time stamps onto an even grid, from the first on; nothing across more than three steps."""

    sampling_time: float | None = None
    """s; None for the median of the steps."""
    method: Method = "linear"

    def __post_init__(self) -> None:
        check_fields(self)
        if self.sampling_time is not None:
            check_number(self.sampling_time, "sampling_time", positive=True)

    def apply(self, run: Run) -> Run:
        step, t = self.sampling_time or run.step, run.instants
        if len(t) < 2 or not (np.diff(t) > 0).all():
            raise InputError("`resample` needs at least two instants, each later than the one before it.")
        count = np.floor((t[-1] - t[0]) / step + _SAME) + 1
        if count > 100 * len(t):
            raise InputError(f"`resample`: {step:g} s would make {count:.3g} samples of {len(t)}; take a longer one.")
        grid = t[0] + step * np.arange(int(count))
        most = _APART * max(step, run.step)
        at = _measured(t, grid, _SAME * step)
        values = np.column_stack([_between(t, column, at, self.method, most) for column in run.values.T])
        return replace(run, values=values, instants=grid, step=step, even=True, first=0, stride=1, moved=True)


def _measured(t: Vector, grid: Vector, near: float) -> Vector:
    """The grid, with the measured instant itself where one lies that near: a sample is not lost by rounding."""
    after = np.clip(np.searchsorted(t, grid), 1, len(t) - 1)
    closest = np.where(grid - t[after - 1] < t[after] - grid, t[after - 1], t[after])
    return np.where(np.abs(closest - grid) <= near, closest, grid)


def _between(t: Vector, column: Vector, grid: Vector, method: str, most: float) -> Vector:
    """A channel at other instants; NaN outside of it, and between neighbours more than `most` apart."""
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
    apart = (known[after] - known[after - 1] > most) & (known[after] != grid) & (known[after - 1] != grid)
    result[apart] = np.nan
    return result


@dataclass(frozen=True)
class Outliers:
    """Hampel's: samples over `threshold` deviations off the median of `window` rows on either side are missing.

    The deviation is 1.4826 times the median absolute one. Without `channels` outputs are looked at, for inputs jump.
    """

    window: Annotated[int, Ge(1)] = 5
    threshold: Annotated[float, Gt(0)] = 4.0
    channels: Channels = None

    def __post_init__(self) -> None:
        check_fields(self)

    def apply(self, run: Run) -> Run:
        columns = run.columns(self.channels, range(run.inputs, len(run.names)))
        values = run.values[:, columns].copy()
        for x in values.T:
            x[self._wild(x)] = np.nan
        return run.holding(columns, values)

    def _wild(self, x: Vector) -> np.ndarray:
        if len(x) < 2:
            return np.zeros(len(x), dtype=bool)
        width = min(self.window, len(x) - 1)
        rows = np.lib.stride_tricks.sliding_window_view(np.pad(x, width, mode="reflect"), 2 * width + 1)
        middle, spread = np.full(len(x), np.nan), np.full(len(x), np.nan)
        for begin in range(0, len(x), _CHUNK):
            part = slice(begin, begin + _CHUNK)
            some = np.isfinite(rows[part]).any(axis=1)
            near = rows[part][some]
            middle[part][some] = np.nanmedian(near, axis=1)
            spread[part][some] = np.nanmedian(np.abs(near - middle[part][some, None]), axis=1)
        usual = spread[spread > 0]
        least = _FLOOR * float(np.median(usual)) if len(usual) else 0.0
        return np.abs(x - middle) > self.threshold * _MAD * np.maximum(spread, least)


@dataclass(frozen=True)
class Fill:
    """Reconstructs gaps of at most `most` samples between measured ones; longer ones stay."""

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
            guess = _between(t, x, t, self.method, np.inf)
            for a, b in zip(there[:-1], there[1:], strict=True):
                if 1 < b - a <= self.most + 1:
                    x[a + 1 : b] = guess[a + 1 : b]
        return run.holding(columns, values)


@dataclass(frozen=True)
class Shift:
    """Delays an input by `samples`: row k gets what was at row k − samples. The rows without one are cut off."""

    channel: str
    samples: int

    def __post_init__(self) -> None:
        check_type(self.channel, str, "channel", "an input's name")
        if isinstance(self.samples, bool) or not isinstance(self.samples, int):
            raise InputError(f"`samples` must be a whole number; got {shown(self.samples)}.")

    def apply(self, run: Run) -> Run:
        if self.channel not in run.names[: run.inputs]:
            raise InputError(
                f"`channel`: '{self.channel}' is no input; the inputs are {', '.join(run.names[: run.inputs])}."
            )
        run.check_even("`shift`")
        j, n, late = run.names.index(self.channel), len(run.values), self.samples
        if abs(late) >= n:
            raise InputError(f"`samples`: an experiment has {n} rows, too few to be shifted by {late}.")
        kept = slice(max(late, 0), n + min(late, 0))
        values = run.values[kept].copy()
        values[:, j] = run.values[kept.start - late : kept.stop - late, j]
        first = run.first + run.stride * kept.start
        return replace(run, values=values, instants=run.instants[kept], first=first)


STEPS = Registry(
    "step",
    {
        "detrend": Detrend,
        "lowpass": Lowpass,
        "highpass": Highpass,
        "decimate": Decimate,
        "resample": Resample,
        "outliers": Outliers,
        "fill": Fill,
        "shift": Shift,
    },
    reserved=("step",),
)


def options_of(step: Any) -> dict[str, Any]:
    """The fields of a step that have values."""
    found = {name: getattr(step, name) for name in type(step).__dataclass_fields__}
    plain = {name: list(value) if isinstance(value, tuple) else value for name, value in found.items()}
    return {name: value for name, value in plain.items() if value is not None}
