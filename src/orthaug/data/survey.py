"""What a data file seems to hold: its columns one by one, their units, and what could be time."""

from __future__ import annotations

import keyword
import re
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from orthaug._base.checks import Vector, nearest
from orthaug._base.errors import LONGEST, InputError, shown
from orthaug.data.expressions import SAMPLING_TIME, is_name
from orthaug.data.readers import JITTER
from orthaug.data.steps import Outliers, Run
from orthaug.data.tables import column_names, read_table, reading_note
from orthaug.data.text_files import numbers_only

_UNITS = re.compile(
    r"A|mA|V|mV|kV|W|kW|N|kN|mN|Nm|m|mm|cm|km|um|s|ms|us|rad|mrad|deg|rpm|Hz|kHz|Pa|kPa|MPa|bar|mbar|K|degC|degF|kg|J|"
    r"kJ|ohm|percent|m_s2?|rad_s2?|l_min|kg_s"
)
_BRACKETS = re.compile(r"^(.*?)\s*[\[(]\s*([^\[\]()]+?)\s*[\])]$")
_TIME = re.compile(r"^(t|time|times|timestamp|time_?stamp|zeit|sec|seconds)$", re.IGNORECASE)
_STEP = re.compile(r"^(ts|dt|t_s|sampling_?time|sample_?time)$", re.IGNORECASE)
_INPUT = re.compile(r"^(u|u_?\d+|in|input|input_?\d+)$", re.IGNORECASE)
_OUTPUT = re.compile(r"^(y|y_?\d+|out|output|output_?\d+)$", re.IGNORECASE)
_SECONDS = {"": 1.0, "s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
_HELD = 6  # rows at the largest or smallest value from which on it is suspected to be a limit
_OFTEN = 5.0  # times the rows that a value usually has
_LONGER = 3.0  # times the rows for which other values are usually held
_LEVELS = 20  # of a signal at least, for one with fewer stands at its extremes anyway
_COARSE = 0.02  # steps of a signal over its standard deviation that are told
SPIKE = 15.0
"""Deviations from its neighbours that a sample is a spike from on."""
_LOWER = (SPIKE, 10.0, 7.0, 5.0, 4.0)  # tried where a sample stands far outside the range of all others
_BEYOND = 0.5  # of that range
_OUTSIDE = 2.5  # interquartile ranges from the middle
_FEW = 0.01  # share of samples that spikes are at most
_SAME = 1e-6  # relative


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
        run = Run(x[:, None], np.arange(float(len(x))), (self.name,), 0, 1.0)
        usual = np.quantile(self.finite, [0.25, 0.75])
        far = np.abs(x - usual.mean()) > _OUTSIDE * np.ptp(usual)
        wild = {}
        for threshold in _LOWER:
            marked = np.isfinite(x) & ~np.isfinite(Outliers(threshold=threshold).apply(run).values[:, 0])
            wild[threshold] = marked & far
        rest = x[np.isfinite(x) & ~wild[_LOWER[-1]]]
        beyond = _BEYOND * np.ptp(rest)
        alone = wild[_LOWER[-1]] & ((x > rest.max() + beyond) | (x < rest.min() - beyond))
        threshold = next(threshold for threshold in _LOWER if not (alone & ~wild[threshold]).any())
        count = int(wild[threshold].sum())
        return (threshold, count) if count <= max(1.0, _FEW * len(x)) else (SPIKE, 0)

    @property
    def quantum(self) -> float | None:
        """The step of which all values are multiples, where it is coarse beside the standard deviation."""
        levels = np.unique(self.finite)
        if len(levels) < 3 or np.ptp(levels) == 0:
            return None
        step = float(np.diff(levels).min())
        multiples = (levels - levels[0]) / step
        even = np.abs(multiples - np.round(multiples)).max() < _SAME * max(float(multiples.max()), 1e3)
        coarse = step > _COARSE * float(self.finite.std())
        return step if even and coarse and len(levels) < len(self.finite) / 2 else None

    @property
    def kind(self) -> str:
        """'input' or 'output' where the name says so, otherwise ''."""
        return "input" if _INPUT.match(self.name) else "output" if _OUTPUT.match(self.name) else ""


@dataclass(frozen=True, eq=False)
class Clock:
    """How a file tells its sampling time: by a column of instants, by a cell, or not at all (`column` None)."""

    step: float | None = None
    """In s."""
    column: Column | None = None
    instants: bool = False
    """Whether the column holds instants in seconds, as the spec's `time` takes them."""
    even: bool = True

    def __str__(self) -> str:
        if self.column is None or self.step is None:
            return "no column tells it"
        if not self.even:
            return f"{self.step:g} s is usual in column '{self.column.header}', but the steps are uneven"
        return f"{self.step:g} s, from column '{self.column.header}'"


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
        except InputError:  # text, complex numbers, or not known which
            values, unusable = np.empty(0), "no numbers" if every.count(header) == 1 else "its name stands twice"
        name = channel_name(base, [c.name for c in columns])
        columns.append(Column(header, name, unit, values, unusable))
    if all(c.unusable for c in columns):
        raise InputError(
            f"{path}: no column holds numbers; expected one for each signal, under a header. The names that were found "
            f"are {shown(', '.join(every))}; a line above the header must begin with # or %."
        )
    return Survey(path, tuple(columns), _clock(columns), reading_note(path))


def split_header(header: str) -> tuple[str, str]:
    """Name and unit of a header: `force [N]`, `force (N)`, `force_N`; an index, as in `U[2]`, is no unit.

    The number that tells columns of one name apart stays with the name: `force [N].1` is `force.1` in N.
    """
    numbered = re.fullmatch(r"(.*)(\.\d+)", header)
    if numbered:
        base, unit = split_header(numbered[1])
        return (base + numbered[2], unit) if unit else (header, "")
    found = _BRACKETS.match(header)
    if found and found[1] and not re.fullmatch(r"[\d:,\s]+", found[2]):
        return found[1].strip(), found[2].strip()
    for cut in (i for i, letter in enumerate(header) if letter == "_" and i):
        if _UNITS.fullmatch(header[cut + 1 :]):
            return header[:cut], header[cut + 1 :].replace("_s", "/s").replace("_min", "/min").replace("s2", "s^2")
    return header, ""


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
    for column in columns:
        base = split_header(column.header)[0]
        values, scale = column.finite, _SECONDS.get(column.unit.lower())
        if column.unusable or scale is None:
            continue
        if _TIME.match(base) and len(values) > 1 and column.filled == rows and (np.diff(values) > 0).all():
            steps = np.diff(values)
            usual = float(np.median(steps))
            even = column.missing > 0 or bool((np.abs(steps - usual) <= JITTER * usual).all())
            step = float(steps.mean()) if even and not column.missing else usual
            return Clock(float(f"{scale * step:.9g}"), column, instants=scale == 1, even=even)
        if _STEP.match(base) and column.constant and values[0] > 0:
            return Clock(scale * float(values[0]), column)
    return Clock()
