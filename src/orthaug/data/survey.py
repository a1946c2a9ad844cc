"""Survey of a data file: its columns one by one, their units, and its sampling time."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from orthaug._base.checks import Vector, nearest
from orthaug._base.errors import InputError, SurplusCellsError, show
from orthaug._base.lines import join_words
from orthaug.data.clock import DATES, Clock, RefusedColumn, by_single_number, find_clock
from orthaug.data.columns import Column, channel_name
from orthaug.data.headers import header_with_unit, split_header
from orthaug.data.layouts import STATES, numbers_only
from orthaug.data.tables import read_table, read_titles, reading_note
from orthaug.data.variables import ENDINGS

_MOST_EXPERIMENTS = 50  # that a column of the file may number
_SHORTEST_EXPERIMENT = 20  # rows
_LOOKED_AT = 1000  # rows in which the words of a column are looked for
# Names of a column that numbers the experiments
_NUMBERING = frozenset(
    ("id", "experiment", "exp", "run", "run_id", "trial", "test", "batch", "cycle", "session")
    + ("versuch", "lauf", "messung", "nr", "no")
)


@dataclass(frozen=True, eq=False)
class Survey:
    """All columns of a file, and its clock."""

    path: Path
    columns: tuple[Column, ...]
    clock: Clock
    note: str = ""
    """Note on how the file was read."""

    @property
    def signals(self) -> tuple[Column, ...]:
        """Columns that could be channels: their numbers vary and are not time."""
        apart = [self.clock.column, *(one.column for one in self.clock.refused if not one.signal)]
        number = self.experiment_column(())
        if number is not None and self._says_so(number):
            apart.append(number)
        found = [c for c in self.columns if not c.unusable and not c.constant]
        return tuple(c for c in found if not any(c is one for one in apart))

    def looks_like_time(self, column: Column) -> RefusedColumn | None:
        """Return the reason why a column of varying numbers is no channel: it rises as time."""
        return next(
            (one for one in self.clock.refused if one.column is column and not one.signal), None
        )

    def why_not(self, column: Column) -> str:
        """Return the reason why a column is no channel."""
        if column is self.clock.faulty and self.clock.restarts:
            return "the time, which begins anew with each experiment"
        number, refused = self.experiment_column(()), self.looks_like_time(column)
        if column is number and self._says_so(column):
            return "numbers the experiments"
        return column.unusable or (
            "constant" if column.constant else refused.reason if refused else "not named"
        )

    def experiment_column(self, used: Sequence[Column]) -> Column | None:
        """Return the column that numbers the experiments: whole numbers, each in one block of rows.

        None where there is none beside the `used` ones.
        """
        for column in self.columns:
            if any(column is one for one in (*used, self.clock.column)) or column.unusable:
                continue
            values = column.values[: column.filled]
            if not np.isfinite(values).all() or (values != np.round(values)).any():
                continue
            blocks = np.split(values, np.flatnonzero(np.diff(values)) + 1)
            several = 1 < len(blocks) <= _MOST_EXPERIMENTS
            apart = len(np.unique(values)) == len(blocks)
            if several and apart and min(map(len, blocks)) >= _SHORTEST_EXPERIMENT:
                return column
        return None

    def _says_so(self, number: Column) -> bool:
        """Return whether a column numbers experiments by its name, or by where the time restarts.

        An input may rise in steps of whole numbers, too.
        """
        begins = (np.flatnonzero(np.diff(number.values[: number.filled])) + 1).tolist()
        return number.name.lower() in _NUMBERING or begins == list(self.clock.restarts)

    def same_lengths(self, columns: Sequence[Column]) -> bool:
        """Return whether columns belong to one run.

        Those of a table do, arrays if they have as many rows.
        """
        return (
            self.path.suffix.lower() not in ENDINGS
            or len({len(column.values) for column in columns}) < 2
        )

    def beside(self, channels: Sequence[Column]) -> Survey:
        """Return the survey with the clock of these channels.

        Files may have columns of several lengths.
        """
        rows = max(column.filled for column in channels)
        if (
            all(column.filled == rows for column in self.columns)
            or not self.clock.instants
            and self.clock.column
        ):
            return self
        clock = find_clock(
            [c for c in self.columns if c.filled == rows and c not in channels], channels[0].header
        )
        return replace(self, clock=clock if clock.column else self.clock)

    def find(self, name: str) -> Column:
        """Return a column by its header, or by the name of its channel.

        Raises:
            InputError: no such column, one without numbers, or one that never changes.
        """
        twice = [c.header for c in self.columns if c.header in (f"{name}.0", f"{name}.1")]
        if len(twice) == 2 and not any(c.header == name for c in self.columns):
            raise InputError(
                f"{self.path}: several columns are called '{name}'; from the left: "
                f"{', '.join(twice)}."
            )
        named = [c for c in self.columns if c.header == name] or [
            c for c in self.columns if c.name == name
        ]
        if not named:
            known = [c.header for c in self.columns]
            raise InputError(
                f"{self.path}: no column '{name}'{nearest(name, known)}; the file has "
                f"{', '.join(known)}."
            )
        column = named[0]
        if column.unusable:
            raise InputError(
                f"{self.path}: column '{name}' cannot be a channel: {column.unusable}."
                f"{self._remedy(column)}"
            )
        if column.constant:
            raise InputError(
                f"{self.path}: column '{name}' is {column.finite[0]:g} in every row; leave it out."
            )
        return column

    def _remedy(self, column: Column) -> str:
        """Return what to do about a column of words; empty where it holds something else."""
        words: list[str] = []
        with suppress(InputError):  # columns of text that no reader takes
            table = read_table(self.path, [column.header])
            rows = range(min(table.filled[column.header], _LOOKED_AT))
            words = sorted({text for row in rows if (text := table.cell(column.header, row))})
        if not words or {word.strip().lower() for word in words} - STATES:
            return ""
        return f" Its cells hold {join_words(words)}: write 0 and 1 for them."

    @property
    def contradicted(self) -> bool:
        """True if a column's name says one thing and its values another."""
        clock = self.clock
        return any(one.column.kind for one in clock.refused if not one.signal) or bool(
            clock.column is not None and clock.column.kind and not clock.by_name
        )

    def roles(self) -> tuple[list[Column], list[Column]] | None:
        """Return inputs and outputs, or None where a signal's name does not show its role.

        There must also be an output.
        """
        kinds = [c.kind for c in self.signals]
        if self.contradicted:
            return None
        if "output" not in kinds or "" in kinds or not self.same_lengths(self.signals):
            return None
        if "input" not in kinds and any(not one.signal for one in self.clock.refused):
            return None  # what is left out may be the input
        by = {kind: [c for c in self.signals if c.kind == kind] for kind in ("input", "output")}
        return by["input"], by["output"]


def survey(path: Path) -> Survey:
    """Look at every column of a file.

    Raises:
        InputError: no such file, an unknown ending, a file that cannot be read or has no column of
            numbers.
    """
    columns: list[Column] = []
    every, units = read_titles(path)
    if numbers_only(every):
        raise InputError(
            f"{path}: the first line holds numbers; a header with names is expected there. "
            "Write one."
        )
    headers = list(dict.fromkeys(every))
    table, refused = {}, None
    try:
        table = read_table(path, headers).columns
    except SurplusCellsError:
        raise
    except InputError as error:  # one of them cannot be read: each by itself
        refused = error
    for header in headers:
        base, unit = split_header(header_with_unit(header, units.get(header, "")))
        try:
            values = table[header] if table else read_table(path, [header]).columns[header]
            unusable = "" if np.isfinite(values).any() else "no numbers"
            if unusable and len(values):
                values, unusable = _as_dates(path, header)
        except InputError:  # text, complex numbers, or not known which
            values, unusable = np.empty(0), "its name is there twice"
            if every.count(header) == 1:
                values, unusable = _as_dates(path, header)
        name = channel_name(base, [c.name for c in columns])
        columns.append(Column(header, name, unit, values, unusable))
    if all(c.unusable for c in columns):
        if refused and path.suffix.lower() in ENDINGS:  # of variables, which have no header
            raise refused
        raise InputError(
            f"{path}: no column holds numbers; expected one for each signal, under a header. "
            f"The names that were found are {show(', '.join(every))}; a line above the header "
            "must begin with # or %."
        )
    clock = find_clock(columns)
    if clock.column is None and clock.step is None:
        clock = replace(by_single_number(path), refused=clock.refused)
    notes = [reading_note(path), "units are in the row under the header" if units else ""]
    return Survey(path, tuple(columns), clock, "; ".join(filter(None, notes)))


def _as_dates(path: Path, header: str) -> tuple[Vector, str]:
    """Return dates as seconds since the first of them, and the kind of other columns."""
    with suppress(InputError):
        table = read_table(path, [header], header)
        if table.dated and np.isfinite(table.columns[header]).any():
            return table.columns[header], DATES
    return np.empty(0), "no numbers"
