"""Sampling time of a data file: the column that is the time, and those that only resemble it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.errors import InputError
from orthaug.data.columns import Column
from orthaug.data.headers import (
    header_with_unit,
    in_seconds,
    is_time,
    split_header,
    step_of,
    unit_of_time,
)
from orthaug.data.record import same_step
from orthaug.data.tables import read_table, read_titles
from orthaug.data.variables import ENDINGS, scalars

# Largest deviation of a step from the usual one, relative: one lost sample deviates by 1 or ½.
JITTER = 0.45
# Largest change of the mean step over the record, relative; it must also displace half a sample.
DRIFT = 0.02
DATES = "dates"
"""Type of a column of dates, which is no signal."""
_JITTERS = 0.02  # largest deviation of a step that is not reported, relative
_HEAD = 10_000  # rows of a text file that are enough to determine its step
_FEWEST = 10  # rows from which on rising evenly is no chance
# Share of the steps of a time that are as usual at least; the others are lost samples
_MOSTLY = 0.98
# Share of rising steps from which on a column named as the time is a time with a fault.
_RISES = 0.9
_SHORTEST = 10  # rows of an experiment, where a time that falls begins anew
_COUNTING = (0.0, 1.0)  # where counters of rows begin


@dataclass(frozen=True, eq=False)
class RefusedColumn:
    """A column that could be the time and is not, with the reason.

    `signal` says whether it may be a channel.
    """

    column: Column
    reason: str
    signal: bool
    fault: str = ""
    """Of a column named as the time that rises in most rows: what is wrong with it."""


@dataclass(frozen=True, eq=False)
class Clock:
    """Source of the sampling time: a column of instants, a single number, or neither.

    `column` is None where the file has neither.
    """

    step: float | None = None
    """Sampling time in s; without a column, that of most steps of one that is refused."""
    column: Column | None = None
    seconds: Vector | None = None
    """The instants in s, where the column holds them: it can be the spec's `time`."""
    even: bool = True
    refused: tuple[RefusedColumn, ...] = ()
    """Columns that could be taken for the time."""

    @property
    def instants(self) -> bool:
        """True if the column holds instants."""
        return self.seconds is not None

    @property
    def faulty(self) -> Column | None:
        """The column named as the time that has a fault, where the step is that of most its rows.

        None where the step is from elsewhere.
        """
        if self.step is None or self.column is not None:
            return None
        return next((one.column for one in self.refused if one.fault), None)

    @property
    def restarts(self) -> tuple[int, ...]:
        """Rows at which a column named as the time begins anew: those of further experiments."""
        for one in self.refused:
            values = one.column.values
            falls = (np.flatnonzero(np.diff(values) < 0) + 1).tolist() if one.fault else []
            if not falls or np.diff([0, *falls, one.column.filled]).min() < _SHORTEST:
                continue
            first = float(values[0] + abs(values[1] - values[0]))
            if all(values[row] <= first for row in falls):
                return tuple(falls)
        return ()

    @property
    def steady(self) -> bool:
        """True if the instants of all parts of the file have the same sampling time."""
        seconds = np.zeros(0) if self.seconds is None else self.seconds[np.isfinite(self.seconds)]
        means = [part.mean() for part in np.array_split(np.diff(seconds), 4) if len(part)]
        return bool(means) and same_step(min(means), max(means))

    @property
    def uneven(self) -> tuple[float, float] | None:
        """Shortest and longest step in s, where rows are lost or were taken at uneven instants."""
        if self.seconds is None or self.step is None:
            return None
        instants = self.seconds[np.isfinite(self.seconds)]
        steps = np.diff(instants)
        if not len(steps) or not (
            np.abs(steps - self.step).max() > JITTER * self.step or steps_accumulate(instants)
        ):
            return None
        return float(steps.min()), float(steps.max())

    @property
    def by_name(self) -> bool:
        """True if the name or the dates of the column show that it is the time.

        Otherwise only its values do.
        """
        return self.column is not None and (
            not self.instants or bool(self.column.unusable) or is_time(self.column.titled)
        )

    def __str__(self) -> str:
        if self.step is None:
            return "no column states it"
        if self.column is None:
            one = next(one for one in self.refused if one.fault)
            if (held := _rows_of_each(one.column.finite)) > 1:
                named = f"column '{one.column.header}'"
                return f"{self.step:g} s, because {named} has each instant in {held} rows"
            fault = "begins anew with each experiment" if self.restarts else one.fault
            sort = "; if rows were exchanged, sort the file by it" if "falls" in fault else ""
            return f"{self.step:g} s is usual in column '{one.column.header}', which {fault}{sort}"
        header, known = self.column.header, ""
        if not self.by_name:
            known = ", which rises as time does"
            known += (
                ""
                if split_header(self.column.titled)[1] or unit_of_time(self.column.titled)[1] != 1
                else " and whose header has no unit; s is assumed"
            )
        if not self.even:
            text = f"{self.step:g} s is usual in column '{header}'{known}, but the steps are uneven"
        else:
            text = f"{self.step:g} s, from column '{header}'{known}"
        steps = (
            np.diff(self.seconds[np.isfinite(self.seconds)])
            if self.seconds is not None
            else np.zeros(0)
        )
        if len(steps) and np.abs(steps - self.step).max() > _JITTERS * self.step:
            text += f"; single steps are {steps.min():.3g} to {steps.max():.3g} s"
        return text


def steps_accumulate(instants: Vector) -> bool:
    """Return whether rising instants leave every even grid by more than half a sample.

    Stamps that are logged late scatter about a grid. Where each step varies by itself, deviations
    add up: the samples themselves were taken at uneven instants.
    """
    if len(instants) < 3:
        return False
    steps, rows = np.diff(instants), np.arange(float(len(instants)))
    mean = float(steps.mean())
    if float(steps.std()) <= _JITTERS * mean:
        return False
    slope, level = np.polyfit(rows, instants - instants[0], 1)
    return bool(np.abs(instants - instants[0] - level - slope * rows).max() > 0.5 * mean)


def find_clock(columns: Sequence[Column], near: str = "") -> Clock:
    """Return the clock among some columns.

    It is a column named as the time, dates, a constant `Ts`, or a column that rises as time does.

    Args:
        near: where the channels are, as in `run.y`; a time beside them comes before others.
    """
    rows = max((column.filled for column in columns), default=0)
    parent = _parent(near)
    clock, refused = Clock(), []
    for column in sorted(
        columns, key=lambda c: (not is_time(c.titled), bool(near) and _parent(c.header) != parent)
    ):
        values, dates = column.finite, column.unusable == DATES
        if column.unusable and not dates:
            continue
        step = step_of(column.titled, float(values[0])) if column.constant else None
        if step is not None and clock.column is None:
            clock = Clock(step, column)
        if not (dates or is_time(column.titled)):
            continue
        fault = _fault(column, rows)
        if fault is not None and not column.constant:
            refused.append(fault)
        elif fault is None and clock.column is None:
            clock = _column_clock(
                column, column.values if dates else in_seconds(column.values, column.titled)
            )
        elif fault is None and not dates:
            refused.append(
                RefusedColumn(column, "rises as a time does, and another column is the time", False)
            )
    for column in columns:
        if column.unusable or column is clock.column or is_time(column.titled):
            continue
        verdict = _resemblance(column)
        if verdict is None and clock.column is None and column.filled == rows:
            clock = _column_clock(column, in_seconds(column.values, column.titled))
        elif verdict is None:
            refused.append(
                RefusedColumn(
                    column, f"rises by {_mean_step(column):g} in each row, as a time does", False
                )
            )
        elif verdict:
            refused.append(verdict)
    faulty = next((one for one in refused if one.fault), None)
    if clock.step is None and faulty is not None:
        steps = np.diff(in_seconds(faulty.column.finite, faulty.column.titled))
        step = np.median(steps[steps > 0]) / _rows_of_each(faulty.column.finite)
        clock = Clock(float(f"{step:.6g}"))
    kept = tuple(
        one for one in refused if not clock.instants or not one.signal or is_time(one.column.titled)
    )
    return replace(clock, refused=kept)


def _parent(path: str) -> str:
    """Return the struct or group that a variable is in."""
    return path[: max(path.rfind("."), path.rfind("/"), 0)]


def _mean_step(column: Column) -> float:
    rows = np.flatnonzero(np.isfinite(column.values))
    return float((column.finite[-1] - column.finite[0]) / (rows[-1] - rows[0]))


def _fault(column: Column, rows: int) -> RefusedColumn | None:
    """Return why a column that is named as the time cannot be it; None where it can."""
    values = column.finite
    steps = np.diff(values)
    if len(steps) and (steps > 0).all() and column.filled == rows:
        return None
    if column.filled != rows:
        return RefusedColumn(
            column, f"ends after {column.filled} of {rows} rows, so it is not the time", False
        )
    if len(steps) and not ((steps > 0).mean() >= _RISES or (steps >= 0).all()):
        return RefusedColumn(column, "falls in many rows, so it is taken for a signal", True)
    held = _rows_of_each(values)
    if held > 1:
        fault = f"has each instant in {held} rows"
        return RefusedColumn(column, f"{fault}, so it is not the time", False, fault)
    at = int(np.flatnonzero(steps <= 0)[0]) + 1 if len(steps) else 0
    row = int(np.flatnonzero(np.isfinite(column.values))[at])
    went = f"stays at {values[at]:g}"
    if len(steps) and steps[at - 1] < 0:
        went = f"falls from {values[at - 1]:g} to {values[at]:g}"
    fault = f"{went} in row {row}" if len(steps) and (steps > 0).mean() >= _RISES else ""
    sort = "; if rows were exchanged, sort the file by it" if fault and "falls" in went else ""
    text = f"{went} in row {row}, so it is not the time{sort}"
    return RefusedColumn(column, text, False, fault)


def _rows_of_each(values: Vector) -> int:
    """Return in how many rows each instant is, as where seconds are left out; 1 where they vary."""
    steps = np.diff(values)
    begins = np.flatnonzero(steps > 0) + 1
    rows = np.diff(begins)  # of the first and the last instant there may be fewer
    if len(rows) < _FEWEST or (steps < 0).any():
        return 1
    usual, moved = int(np.median(rows)), steps[begins - 1]
    alike = (rows == usual).mean() >= _MOSTLY and np.isclose(
        moved, np.median(moved)
    ).mean() >= _MOSTLY
    return usual if alike and max(begins[0], len(values) - begins[-1]) <= usual else 1


def _resemblance(column: Column) -> RefusedColumn | bool | None:
    """Return whether the values of a column are those of time, whatever its name.

    The result is None where they are, False where nothing shows it.

    A column that rises and is not the time for another reason comes with the reason.
    """
    rows, values = np.flatnonzero(np.isfinite(column.values)), column.finite
    steps = np.diff(values) / np.diff(rows)
    if len(steps) < _FEWEST - 1 or not (steps > 0).all():
        return False
    header, usual = column.titled, float(np.median(steps))
    line = np.interp(rows, rows[[0, -1]], values[[0, -1]])
    on_line = bool(np.abs(values - line).max() < 0.5 * steps.mean())
    thirds = [float(np.median(part)) for part in np.array_split(steps, 3)]
    alike = (np.abs(steps - usual) <= JITTER * usual).mean() >= _MOSTLY and max(thirds) - min(
        thirds
    ) <= DRIFT * usual
    if not (on_line or alike):
        reason = (
            f"rises, but in steps of {steps.min():.3g} to {steps.max():.3g}, so it is taken "
            "for a signal"
        )
        return RefusedColumn(column, reason, True)
    unit = unit_of_time(header)[1]
    if unit is None:
        reason = (
            f"rises evenly, but its unit {split_header(header)[1]} is no unit of time, so it is "
            "taken for a signal"
        )
        return RefusedColumn(column, reason, True)
    if (steps == 1).all() and values[0] in _COUNTING and not split_header(header)[1]:
        return RefusedColumn(column, "counts the rows", False)
    return None


def read_clock(path: Path, apart: Collection[str] = (), *, by_content: bool = False) -> Clock:
    """Return the clock in the names of a file's columns and in their first rows.

    Args:
        apart: columns that are channels, whatever they are called.
        by_content: look at columns of any name.
    """
    titles = read_titles(path)
    titled = {
        n: header_with_unit(n, titles.units.get(n, "")) for n in titles.names if n not in apart
    }
    wanted = [n for n, t in titled.items() if by_content or is_time(t) or step_of(t, 1.0)]
    columns, values = [], {}
    if by_content and wanted:
        with suppress(InputError):  # one of them holds no numbers: each by itself
            values = read_table(path, wanted, most=_HEAD).columns
    for header in wanted:
        with suppress(InputError):
            named = header if is_time(titled[header]) else None  # it comes in s, as dates do
            if named or header not in values:
                values = {
                    **values,
                    header: read_table(path, [header], named, most=_HEAD).columns[header],
                }
            unit = titles.units.get(header, "")
            columns.append(Column(header, header, unit, values[header], DATES if named else ""))
    clock = find_clock(columns) if columns else Clock()
    return clock if clock.column else by_single_number(path)


def thinned_fault(
    path: Path, sampling_time: float | None, every: int, apart: Collection[str]
) -> str:
    """Return the fault of a sampling time that is that of the kept rows, not of the file's rows.

    Empty where there is no fault.

    Args:
        sampling_time: as given, in s, to be multiplied by `every`.
        apart: columns that are channels.
    """
    if every == 1 or sampling_time is None:
        return ""
    clock = read_clock(path, apart, by_content=True)
    if clock.column is None or clock.step is None or same_step(clock.step, sampling_time):
        return ""
    if abs(clock.step * every - sampling_time) > DRIFT * sampling_time:
        return ""
    header, step = clock.column.header, clock.step
    other = f', or time = "{header}" instead' if clock.instants else ""
    return (
        f"every = {every} multiplies the sampling time {sampling_time:g} s to "
        f"{every * sampling_time:g} s. But the rows of {path.name} are {step:g} s apart by "
        f"column '{header}', and the rows that are kept {every * step:g} s. Give "
        f"sampling_time = {step:g}, that of the file's rows{other}."
    )


def by_single_number(path: Path) -> Clock:
    """Return a clock from single numbers called `Ts` or `fs`, where all of them agree."""
    if path.suffix.lower() not in ENDINGS:
        return Clock()
    found = scalars(path, lambda name: step_of(name, 1.0) is not None)
    steps = {name: step_of(name, value) for name, value in found.items()}
    known = {name: step for name, step in steps.items() if step is not None and np.isfinite(step)}
    if not known or not same_step(min(known.values()), max(known.values())):
        return Clock()
    name, step = next(iter(known.items()))
    return Clock(step, Column(name, name, "", np.array([found[name]])))


def _column_clock(column: Column, seconds: Vector) -> Clock:
    steps = np.diff(seconds[np.isfinite(seconds)])
    usual = float(np.median(steps))
    alike = bool((np.abs(steps - usual) <= JITTER * usual).all())
    even = column.missing > 0 or (alike and not steps_accumulate(seconds))
    step = float(steps.mean()) if even and not column.missing else usual
    return Clock(float(f"{step:.9g}"), column, seconds, even=even)
