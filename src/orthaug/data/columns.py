"""A column of a data file: its values, the channel that it would be, and its peculiarities."""

from __future__ import annotations

import itertools
import keyword
import re
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.errors import LONGEST
from orthaug.data.expressions import SAMPLING_TIME, is_name
from orthaug.data.headers import header_with_unit, last_part, split_header
from orthaug.data.steps import Outliers

_INPUT = re.compile(r"^(u|u_?\d+|in|input|input_?\d+)$", re.IGNORECASE)
_OUTPUT = re.compile(r"^(y|y_?\d+|out|output|output_?\d+)$", re.IGNORECASE)
# Quantities that are mostly applied, and mostly measured
_APPLIED = re.compile(
    r"force|torque|voltage|command|set_?point|valve|pump|heater|power|throttle|duty|pwm",
    re.IGNORECASE,
)
_MEASURED = re.compile(
    r"position|displacement|deflection|angle|speed|velocity|acceleration|level|height|temperature",
    re.IGNORECASE,
)
_HELD = 6  # rows at the largest or smallest value from which on it is suspected to be a limit
_OFTEN = 5.0  # times the rows that a value usually has
_LONGER = 3.0  # times the rows for which other values are usually held
_SWEPT = 0.5  # of the rows, in which a signal moves that runs through its range once
_LEVELS = 20  # of a signal at least, for one with fewer is often at its extremes anyway
_FINEST = 1e5  # steps within the range from which on rounding of the numbers could make them
_RANGE = 100.0  # steps within the range from which on a signal that turns looks rounded
_COARSE = 0.02  # steps of a signal over its standard deviation that are reported
SPIKE = 15.0
"""Deviations from its neighbours from which on a sample is a spike."""
# Tried where a sample is far outside the range of all others
_LOWER = (SPIKE, 10.0, 7.0, 5.0, 4.0)
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
    """Reason why it can be no channel."""

    @property
    def titled(self) -> str:
        """The header with its unit, which may be in a row of units under it."""
        return header_with_unit(self.header, self.unit)

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
        """True if all values are the same."""
        return len(self.finite) > 0 and bool(np.ptp(self.finite) == 0)

    @property
    def switched(self) -> bool:
        """True if it is switched between a few levels: their distance is no resolution."""
        return len(np.unique(self.finite)) <= _LEVELS

    @property
    def one_way(self) -> str:
        """Direction of a signal that runs through its range once, "rises" or "falls"; else ""."""
        steps = np.diff(self.finite)
        if np.count_nonzero(steps) < max(_SWEPT * len(steps), 1) or (steps.min() < 0 < steps.max()):
            return ""
        return "rises" if steps.sum() > 0 else "falls"

    @property
    def limits(self) -> tuple[tuple[float, int], ...]:
        """Extreme values that the signal has much more often than others, with the rows.

        Such a signal may be saturated. Rows in which a rounded signal turns are not counted.
        """
        levels, counts = np.unique(self.finite, return_counts=True)
        if len(levels) < _LEVELS:
            return ()
        x = self.finite
        edges = np.concatenate([[0], np.flatnonzero(np.diff(x)) + 1, [len(x)]])
        held = np.diff(edges)
        # As inputs are, between their steps
        held = held[(held > 1) & ~np.isin(x[edges[:-1]], levels[[0, -1]])]
        least = max(
            _HELD,
            _OFTEN * float(np.median(counts)),
            _LONGER * float(np.median(held)) if len(held) else 0.0,
        )
        found = []
        for i in (0, -1):
            rows = int(counts[i])
            if rows >= least:
                rows -= _turning_rows(x, edges, float(levels[i]))
            if rows >= least:
                found.append((float(levels[i]), rows))
        return tuple(found)

    @property
    def spikes(self) -> int:
        """Samples far from all their neighbours and from the usual values, where they are few."""
        return self._spiky[1]

    @property
    def threshold(self) -> float:
        """Threshold with which the step `outliers` takes the spikes away.

        It is `SPIKE`, or lower where the spikes need it.
        """
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
        """Step of which all values are multiples, where it is coarse.

        It is coarse if it is large beside the deviation or the movement of a sample.
        """
        step = quantum_of(self.finite)
        if step is None or step <= min(_COARSE * float(self.finite.std()), self.movement):
            return None
        return step if len(np.unique(self.finite)) < len(self.finite) / 2 else None

    @property
    def movement(self) -> float:
        """Mean absolute change of the signal between two rows."""
        return float(np.abs(np.diff(self.finite)).mean()) if len(self.finite) > 1 else 0.0

    @property
    def kind(self) -> str:
        """'input' or 'output' where the name shows it, otherwise ''."""
        name = channel_name(last_part(split_header(self.header)[0]))
        return "input" if _INPUT.match(name) else "output" if _OUTPUT.match(name) else ""

    @property
    def proposed(self) -> str:
        """'input' or 'output' where the name shows or suggests it, otherwise ''."""
        applied, measured = _APPLIED.search(self.header), _MEASURED.search(self.header)
        if self.kind or bool(applied) == bool(measured):
            return self.kind
        return "input" if applied else "output"


def _turning_rows(x: Vector, edges: Any, level: float) -> int:
    """Return the rows at an extreme value in which a signal that is rounded to steps q turns.

    A parabola that stays within q for n rows has moved by at most q ((3n − 1)/(n − 1))² n rows
    before and after. One that runs into a limit has moved farther.

    Args:
        edges: the rows at which runs of equal values begin, and the number of rows.
    """
    step = quantum_of(x)
    if step is None or np.ptp(x) < _RANGE * step:
        return 0
    found = 0
    for begin, end in itertools.pairwise(edges.tolist()):
        n = end - begin
        if n < 2 or x[begin] != level:
            continue
        most = step * ((3 * n - 1) / (n - 1)) ** 2
        # All of them: twelve hours before a night without sun is the night before
        around = x[max(begin - n, 0) : end + n]
        if (np.abs(around - level) <= most).all():
            found += n
    return found


def quantum_of(values: Vector) -> float | None:
    """Return the step of which all differences between values are multiples, up to rounding.

    None where there is none.
    """
    levels = np.unique(values)
    if len(levels) < 3 or not np.isfinite(levels[[0, -1]]).all():
        return None
    step = float(np.diff(levels).min())
    multiples = (levels - levels[0]) / step
    even = np.abs(multiples - np.round(multiples)).max() < _SAME * max(float(multiples.max()), 1e3)
    return step if even and multiples.max() < _FINEST else None


def channel_name(text: str, taken: Iterable[str] = ()) -> str:
    """Return an identifier for a column: other letters become underscores.

    A name that is taken gets a number.
    """
    name = (
        re.sub(r"\W+", "_", unicodedata.normalize("NFKC", text)).strip("_")[: LONGEST - 4]
        or "channel"
    )
    name = f"x{name}" if name[0].isdigit() else name
    if not is_name(name) or keyword.iskeyword(name) or name in (SAMPLING_TIME, "time"):
        name += "_"
    taken, unique, number = set(taken), name, 2
    while unique in taken:
        unique, number = f"{name}_{number}", number + 1
    return unique
