"""What a data file seems to hold: its columns one by one, their units, and what could be time."""

from __future__ import annotations

import keyword
import re
import unicodedata
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from orthaug._base.checks import Vector, nearest
from orthaug._base.errors import LONGEST, InputError, shown
from orthaug.data.expressions import SAMPLING_TIME, is_name
from orthaug.data.headers import in_seconds, is_time, last_part, split_header, step_of
from orthaug.data.layouts import numbers_only
from orthaug.data.readers import JITTER
from orthaug.data.record import same_step
from orthaug.data.steps import Outliers
from orthaug.data.tables import column_names, read_table, reading_note
from orthaug.data.variables import ENDINGS, scalars

_INPUT = re.compile(r"^(u|u_?\d+|in|input|input_?\d+)$", re.IGNORECASE)
_OUTPUT = re.compile(r"^(y|y_?\d+|out|output|output_?\d+)$", re.IGNORECASE)
_HELD = 6  # rows at the largest or smallest value from which on it is suspected to be a limit
_OFTEN = 5.0  # times the rows that a value usually has
_LONGER = 3.0  # times the rows for which other values are usually held
_LEVELS = 20  # of a signal at least, for one with fewer stands at its extremes anyway
_FINEST = 1e5  # steps within the range from which on rounding of the numbers could make them
_COARSE = 0.02  # steps of a signal over its standard deviation that are told
SPIKE = 15.0
"""Deviations from its neighbours that a sample is a spike from on."""
_LOWER = (SPIKE, 10.0, 7.0, 5.0, 4.0)  # tried where a sample stands far outside the range of all others
_BEYOND = 0.5  # of that range
_OUTSIDE = 2.5  # interquartile ranges from the middle
_FEW = 0.01  # share of samples that spikes are at most
_SAME = 1e-6  # relative
_JITTERS = 0.02  # largest deviation of a step that is not told, relative
_HEAD = 10_000  # rows of a text file that tell its step well enough
_DATES = "dates"  # what a column of them is, no signal


@dataclass(frozen=True, eq=False)
class Column:
    """A column of a file: its values as floats, and the channel it would be."""

    header: str
    name: str
    unit: str
    values: Vector
    unusable: str = ""
    """Why it can be no channel, in words."""

    @property
    def finite(self) -> Vector:
        """The values that are there."""
        return self.values[np.isfinite(self.values)]

    @property
    def filled(self) -> int:
        """Rows up to the last value."""
        there = np.flatnonzero(np.isfinite(self.values))
        return int(there[-1]) + 1 if len(there) else 0

    @property
    def missing(self) -> int:
        """Cells without a number before the last value."""
        return self.filled - len(self.finite)

    @property
    def constant(self) -> bool:
        """Whether all values are the same."""
        return len(self.finite) > 0 and bool(np.ptp(self.finite) == 0)

    @property
    def limits(self) -> tuple[tuple[float, int], ...]:
        """Extreme values where the signal stands much more often than elsewhere, with the rows; perhaps saturated."""
        levels, counts = np.unique(self.finite, return_counts=True)
        if len(levels) < _LEVELS:
            return ()
        x = self.finite
        edges = np.concatenate([[0], np.flatnonzero(np.diff(x)) + 1, [len(x)]])
        held = np.diff(edges)
        held = held[(held > 1) & ~np.isin(x[edges[:-1]], levels[[0, -1]])]  # as inputs are, between their steps
        least = max(_HELD, _OFTEN * float(np.median(counts)), _LONGER * float(np.median(held)) if len(held) else 0.0)
        return tuple((float(levels[i]), int(counts[i])) for i in (0, -1) if counts[i] >= least)

    @property
    def spikes(self) -> int:
        """Samples far from all their neighbours and from what the signal usually is, where they are few."""
        return self._spiky[1]

    @property
    def threshold(self) -> float:
        """The step `outliers` takes the spikes away with it: `SPIKE`, lower where they need it."""
        return self._spiky[0]

    @cached_property
    def _spiky(self) -> tuple[float, int]:
        x = self.values[: self.filled]
        distance, deviation = Outliers().distances(x)
        usual = np.quantile(self.finite, [0.25, 0.75])
        far = np.abs(x - usual.mean()) > _OUTSIDE * np.ptp(usual)
        wild = {}
        for threshold in _LOWER:
            wild[threshold] = (distance > threshold * deviation) & far
        rest = x[np.isfinite(x) & ~wild[_LOWER[-1]]]
        beyond = _BEYOND * np.ptp(rest)
        alone = wild[_LOWER[-1]] & ((x > rest.max() + beyond) | (x < rest.min() - beyond))
        threshold = next(threshold for threshold in _LOWER if not (alone & ~wild[threshold]).any())
        count = int(wild[threshold].sum())
        return (threshold, count) if count <= max(1.0, _FEW * len(x)) else (SPIKE, 0)

    @property
    def quantum(self) -> float | None:
        """The step of which all values are multiples, where it is coarse beside deviation or movement of a sample."""
        step = quantum_of(self.finite)
        if step is None or step <= min(_COARSE * float(self.finite.std()), self.movement):
            return None
        return step if len(np.unique(self.finite)) < len(self.finite) / 2 else None

    @property
    def movement(self) -> float:
        """By how much the signal moves between two rows, on the average."""
        return float(np.abs(np.diff(self.finite)).mean()) if len(self.finite) > 1 else 0.0

    @property
    def kind(self) -> str:
        """'input' or 'output' where the name says so, otherwise ''."""
        name = channel_name(last_part(split_header(self.header)[0]))
        return "input" if _INPUT.match(name) else "output" if _OUTPUT.match(name) else ""


def quantum_of(values: Vector) -> float | None:
    """The step of which all differences between values are multiples, up to rounding; None where there is none."""
    levels = np.unique(values)
    if len(levels) < 3 or not np.isfinite(levels[[0, -1]]).all():
        return None
    step = float(np.diff(levels).min())
    multiples = (levels - levels[0]) / step
    even = np.abs(multiples - np.round(multiples)).max() < _SAME * max(float(multiples.max()), 1e3)
    return step if even and multiples.max() < _FINEST else None


@dataclass(frozen=True, eq=False)
class Clock:
    """How a file tells its sampling time: by a column of instants, by a cell, or not at all (`column` None)."""

    step: float | None = None
    """In s."""
    column: Column | None = None
    seconds: Vector | None = None
    """The instants in s, where the column holds them: it can be the spec's `time`."""
    even: bool = True

    @property
    def instants(self) -> bool:
        """Whether the column holds instants."""
        return self.seconds is not None

    @property
    def steady(self) -> bool:
        """Whether parts of the file tell the same sampling time from their instants."""
        seconds = np.zeros(0) if self.seconds is None else self.seconds[np.isfinite(self.seconds)]
        means = [part.mean() for part in np.array_split(np.diff(seconds), 4) if len(part)]
        return bool(means) and same_step(min(means), max(means))

    def __str__(self) -> str:
        if self.column is None or self.step is None:
            return "no column tells it"
        if not self.even:
            text = f"{self.step:g} s is usual in column '{self.column.header}', but the steps are uneven"
        else:
            text = f"{self.step:g} s, from column '{self.column.header}'"
        steps = np.diff(self.seconds[np.isfinite(self.seconds)]) if self.seconds is not None else np.zeros(0)
        if len(steps) and np.abs(steps - self.step).max() > _JITTERS * self.step:
            text += f"; single steps are {steps.min():.3g} to {steps.max():.3g} s"
        return text


@dataclass(frozen=True, eq=False)
class Survey:
    """All columns of a file, and its clock."""

    path: Path
    columns: tuple[Column, ...]
    clock: Clock
    note: str = ""
    """What to know of how the file was read."""

    @property
    def signals(self) -> tuple[Column, ...]:
        """Columns that could be channels: numbers that vary and are not time."""
        found = [c for c in self.columns if not c.unusable and not c.constant]
        return tuple(c for c in found if c is not self.clock.column)

    def find(self, name: str) -> Column:
        """A column by its header, or by the name of its channel.

        Raises:
            InputError: no such column, one without numbers, or one that never changes.
        """
        twice = [c.header for c in self.columns if c.header in (f"{name}.0", f"{name}.1")]
        if len(twice) == 2 and not any(c.header == name for c in self.columns):
            raise InputError(f"{self.path}: the name '{name}' stands twice; from the left: {', '.join(twice)}.")
        named = [c for c in self.columns if c.header == name] or [c for c in self.columns if c.name == name]
        if not named:
            known = [c.header for c in self.columns]
            raise InputError(f"{self.path}: no column '{name}'{nearest(name, known)}; the file has {', '.join(known)}.")
        column = named[0]
        if column.unusable:
            raise InputError(f"{self.path}: column '{name}' cannot be a channel: {column.unusable}.")
        if column.constant:
            raise InputError(f"{self.path}: column '{name}' is {column.finite[0]:g} in every row; leave it out.")
        return column

    def roles(self) -> tuple[list[Column], list[Column]] | None:
        """Inputs and outputs where every signal's name says what it is and there is an output, otherwise None."""
        kinds = [c.kind for c in self.signals]
        if "output" not in kinds or "" in kinds:
            return None
        by = {kind: [c for c in self.signals if c.kind == kind] for kind in ("input", "output")}
        return by["input"], by["output"]


def survey(path: Path) -> Survey:
    """Look at every column of a file.

    Raises:
        InputError: no such file, an unknown ending, a file that cannot be read or has no column of numbers.
    """
    columns: list[Column] = []
    every = list(column_names(path))
    if numbers_only(every):
        raise InputError(f"{path}: the first line holds numbers; a header with names is expected there. Write one.")
    headers = list(dict.fromkeys(every))
    try:
        table = read_table(path, headers).columns
    except InputError:  # one of them cannot be read: each by itself
        table = {}
    for header in headers:
        base, unit = split_header(header)
        try:
            values = table[header] if table else read_table(path, [header]).columns[header]
            unusable = "" if np.isfinite(values).any() else "no numbers"
            if unusable and len(values):
                values, unusable = _as_dates(path, header)
        except InputError:  # text, complex numbers, or not known which
            values, unusable = np.empty(0), "its name stands twice"
            if every.count(header) == 1:
                values, unusable = _as_dates(path, header)
        name = channel_name(base, [c.name for c in columns])
        columns.append(Column(header, name, unit, values, unusable))
    if all(c.unusable for c in columns):
        raise InputError(
            f"{path}: no column holds numbers; expected one for each signal, under a header. The names that were found "
            f"are {shown(', '.join(every))}; a line above the header must begin with # or %."
        )
    clock = _clock(columns)
    return Survey(path, tuple(columns), clock if clock.column else _by_single_number(path), reading_note(path))


def told_clock(path: Path, apart: Collection[str] = ()) -> Clock:
    """What a file tells of its sampling time by the names of its columns and their first rows.

    Args:
        apart: columns that are channels, whatever they are called.
    """
    columns = []
    for header in column_names(path):
        if header not in apart and (is_time(header) or step_of(header, 1.0)):
            with suppress(InputError):
                table = read_table(path, [header], header if is_time(header) else None, most=_HEAD)
                columns.append(Column(header, header, "", table.columns[header], _DATES))  # in s, as dates are
    clock = _clock(columns) if columns else Clock()
    return clock if clock.column else _by_single_number(path)


def _as_dates(path: Path, header: str) -> tuple[Vector, str]:
    """Seconds since the first of them, and what a column holds that is not of numbers."""
    with suppress(InputError):
        table = read_table(path, [header], header)
        if table.dated and np.isfinite(table.columns[header]).any():
            return table.columns[header], _DATES
    return np.empty(0), "no numbers"


def channel_name(text: str, taken: Iterable[str] = ()) -> str:
    """An identifier for a column: other letters become underscores; a name that is taken gets a number."""
    name = re.sub(r"\W+", "_", unicodedata.normalize("NFKC", text)).strip("_")[: LONGEST - 4] or "channel"
    name = f"x{name}" if name[0].isdigit() else name
    if not is_name(name) or keyword.iskeyword(name) or name in (SAMPLING_TIME, "time"):
        name += "_"
    taken, unique, number = set(taken), name, 2
    while unique in taken:
        unique, number = f"{name}_{number}", number + 1
    return unique


def _clock(columns: Sequence[Column]) -> Clock:
    rows = max(column.filled for column in columns)
    for column in sorted(columns, key=lambda c: not is_time(c.header)):  # dates without a name of time come last
        values, dates = column.finite, column.unusable == _DATES
        if column.unusable and not dates:
            continue
        step = step_of(column.header, float(values[0])) if column.constant else None
        if step is not None:
            return Clock(step, column)
        rising = len(values) > 1 and column.filled == rows and bool((np.diff(values) > 0).all())
        if rising and (dates or is_time(column.header)):
            return _ticking(column, column.values if dates else in_seconds(column.values, column.header))
    return Clock()


def _by_single_number(path: Path) -> Clock:
    """A clock of single numbers called `Ts` or `fs` beside the channels, where all that there are agree."""
    if path.suffix.lower() not in ENDINGS:
        return Clock()
    found = scalars(path, lambda name: step_of(name, 1.0) is not None)
    steps = {name: step_of(name, value) for name, value in found.items()}
    told = {name: step for name, step in steps.items() if step is not None and np.isfinite(step)}
    if not told or not same_step(min(told.values()), max(told.values())):
        return Clock()
    name, step = next(iter(told.items()))
    return Clock(step, Column(name, name, "", np.array([found[name]])))


def _ticking(column: Column, seconds: Vector) -> Clock:
    steps = np.diff(seconds[np.isfinite(seconds)])
    usual = float(np.median(steps))
    even = column.missing > 0 or bool((np.abs(steps - usual) <= JITTER * usual).all())
    step = float(steps.mean()) if even and not column.missing else usual
    return Clock(float(f"{step:.9g}"), column, seconds, even=even)
