"""Parquet files as a source: a partition is a run of row groups, read batch by batch.

A file is an experiment, or several where a column distinguishes them. Lags are exact at the borders
of batches, row groups and partitions: each reads the rows before it too.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from orthaug._base.errors import InputError
from orthaug.data.channels import Channel, as_channels, check_channels
from orthaug.data.clock import DRIFT, JITTER
from orthaug.data.headers import in_seconds
from orthaug.data.record import Experiment, check_step, same_step
from orthaug.data.sources import join_pieces, read_pieces
from orthaug.data.tables import check_present, check_readable, parquet_file

BATCH_ROWS = 32_768  # rows that are built at once: several such blocks are in memory
_FEWEST_STEPS = 1000  # from which the rate of a batch is determined
PARTITION_ROWS = 1_000_000
"""Least number of rows of a partition, where the file has as many: row groups are never cut."""


class Stamp(NamedTuple):
    """Size [B], time [ns] and checksum of the footer, which change if a file is written again."""

    size: int
    modified: int
    footer: int


class Runs(NamedTuple):
    """Half-open row ranges of a file's experiments, and the instants [s] they begin at."""

    ranges: tuple[tuple[int, int], ...]
    began: tuple[float, ...]

    def within(self, start: int, stop: int) -> Runs:
        """Return the ranges with a row in `[start, stop)`."""
        kept = [i for i, (a, b) in enumerate(self.ranges) if a < stop and b > start]
        return Runs(tuple(self.ranges[i] for i in kept), tuple(self.began[i] for i in kept))


@dataclass(frozen=True)
class ChannelColumns:
    """Columns of the channels in the files."""

    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    columns: tuple[str, ...]
    """File columns of the outputs, then of the inputs."""
    missing: str

    @property
    def distinct(self) -> list[str]:
        return list(dict.fromkeys(self.columns))


@dataclass(frozen=True)
class RowGroups:
    """Rows `[start, stop)` of a Parquet file, whole row groups."""

    path: str
    start: int
    stop: int
    runs: Runs
    reading: ChannelColumns
    stamp: Stamp

    @property
    def name(self) -> str:
        return f"{self.path}, rows {self.start} to {self.stop - 1}"

    @property
    def rows(self) -> int:
        return self.stop - self.start

    def pieces(self, lead: int) -> Iterator[Experiment]:
        yield from self.between(self.start, self.stop, lead)

    def between(self, start: int, stop: int, lead: int) -> Iterator[Experiment]:
        """Yield the pieces of the rows `[start, stop)`; see `Partition.pieces`."""
        self.check_unchanged()
        runs = self.runs.within(start, stop)
        if not runs.ranges:
            return
        held = np.zeros((0, len(self.reading.columns)))
        for position, batch in _batches(
            Path(self.path), max(start - lead, runs.ranges[0][0]), stop, self.reading
        ):
            buffer = np.concatenate([held, batch]) if len(held) else batch
            begin, end = position - len(held), position + len(batch)
            for (a, b), began in zip(runs.ranges, runs.began, strict=True):
                first = max(a, position, start)
                if first < min(b, end):
                    row = max(a, first - lead)
                    yield from read_pieces(
                        buffer[row - begin : min(b, end) - begin],
                        (self.reading.outputs, self.reading.inputs),
                        lead,
                        missing=self.reading.missing,
                        columns=self.reading.columns,
                        name=self.path,
                        source=self.path,
                        first_row=row,
                        start_time=began,
                        offset=row - a,
                    )
            held = buffer[max(len(buffer) - lead, 0) :]

    def check_unchanged(self) -> None:
        """Raise InputError where the file is not the one that was opened."""
        if stamp_of(Path(self.path)) != self.stamp:
            raise InputError(
                f"{self.path}: the file has changed since it was opened (size, time or "
                "footer); start again."
            )


@dataclass(frozen=True, eq=False)
class ParquetSource:
    """Parquet files, in order."""

    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    sampling_time: float
    time_column: str | None
    partitions: tuple[RowGroups, ...]
    experiment_column: str | None = None

    @cached_property
    def _ends(self) -> Any:
        return np.cumsum([partition.rows for partition in self.partitions])

    def window(self, start: int, stop: int) -> list[Experiment]:
        found = []
        for partition, end in zip(self.partitions, self._ends.tolist(), strict=True):
            before = end - partition.rows
            a, b = max(start, before), min(stop, end)
            if a < b:
                shift = partition.start - before
                found += partition.between(a + shift, b + shift, 0)
        step = self.sampling_time
        return [replace(e, start_time=e.start_time + step * e.offset) for e in join_pieces(found)]

    def check_unchanged(self) -> None:
        """Raise InputError where a file is not the one that was opened."""
        for partition in {partition.path: partition for partition in self.partitions}.values():
            partition.check_unchanged()


def open_parquet(
    paths: Sequence[str | Path],
    *,
    inputs: Sequence[str | Channel] = (),
    outputs: Sequence[str | Channel] = (),
    sampling_time: float | None = None,
    time: str | None = None,
    experiment: str | None = None,
    columns: Mapping[str, str] | None = None,
    missing: str = "error",
    partition_rows: int = PARTITION_ROWS,
) -> ParquetSource:
    """Look at the files without reading their channels.

    Rows, columns and their types, experiments and the sampling time are read.

    Args:
        paths: the files, in order; none of them reaches into the next.
        inputs: channel names, or `Channel`s with column, unit, scale and offset.
        outputs: as `inputs`.
        sampling_time: seconds between rows.
        time: the column that holds the instants, instead of `sampling_time`.
        experiment: a column of whole numbers that labels the experiments within a file; None for
            one a file.
        columns: the files' column for a channel, `{"position": "yVal"}`.
        missing: "error", or "skip" to end a stretch at rows with a missing sample.
        partition_rows: rows of a partition at least; row groups are never cut.

    Raises:
        InputError: a file that cannot be read, has no rows, lacks a column or holds another type in
            it; experiments that are not in one piece; time that does not rise evenly within one.
    """
    given, groups = (
        dict(columns or {}),
        (as_channels(inputs, "inputs"), as_channels(outputs, "outputs")),
    )
    check_channels(*groups)
    own = tuple(given.get(c.name, c.file_column) for c in (*groups[1], *groups[0]))
    reading = ChannelColumns(*groups, own, missing)
    partitions, steps, types = [], [], {}
    for path in map(Path, paths):
        check_readable(path)
        stamp = stamp_of(path)
        with parquet_file(path) as file:
            wanted = [*reading.distinct, *(name for name in (time, experiment) if name)]
            check_present(path, wanted, file.schema_arrow.names)
            _check_types(path, file.schema_arrow, wanted, types, time)
            groups = [
                file.metadata.row_group(i).num_rows for i in range(file.metadata.num_row_groups)
            ]
            total = sum(groups)
            if not total:
                raise InputError(f"{path}: there are no data rows.")
            runs, step = _look(file, path, total, time, experiment)
        if step is not None:
            steps.append((path, step))
        for start, stop in _group_rows(groups, partition_rows):
            partitions.append(
                RowGroups(str(path), start, stop, runs.within(start, stop), reading, stamp)
            )
    step = steps[0][1] if steps else 1.0 if sampling_time is None else sampling_time
    for path, other in steps:
        if not same_step(other, step):
            raise InputError(
                f"{path}: sampled every {other:g} s, {steps[0][0]} every {step:g} s; resample "
                "one of them."
            )
    return ParquetSource(
        reading.inputs, reading.outputs, check_step(step), time, tuple(partitions), experiment
    )


def stamp_of(path: Path) -> Stamp:
    """Return size, time and footer of a Parquet file.

    Raises:
        InputError: a file that is gone or too short to be one.
    """
    try:
        seen = os.stat(path)
        with path.open("rb") as file:
            file.seek(-min(8, seen.st_size), os.SEEK_END)
            length = int.from_bytes(file.read(4), "little")
            file.seek(-min(length + 8, seen.st_size), os.SEEK_END)
            footer = file.read()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from None
    return Stamp(seen.st_size, seen.st_mtime_ns, zlib.crc32(footer))


def _check_types(
    path: Path,
    schema: Any,
    names: Sequence[str],
    types: dict[str, tuple[Any, Path]],
    time: str | None,
) -> None:
    """Raise InputError for a column without numbers, or with another type than before.

    The column of time may hold dates.
    """
    for name in names:
        found = schema.field(name).type
        known_kinds = ("int", "uint", "float", "double", "halffloat", "bool")
        if not str(found).startswith((*known_kinds, "timestamp") if name == time else known_kinds):
            raise InputError(f"{path}: column '{name}' holds {found} values; expected numbers.")
        known, first = types.setdefault(name, (found, path))
        if found != known:
            raise InputError(
                f"{path}: column '{name}' holds {found} values, in {first} {known}; give all "
                "files the same types."
            )


def _look(
    file: Any, path: Path, total: int, time: str | None, experiment: str | None
) -> tuple[Runs, float | None]:
    """Return the file's experiments and its sampling time [s], by a pass over two columns."""
    if time is None and experiment is None:
        return Runs(((0, total),), (0.0,)), None
    wanted = [name for name in (time, experiment) if name]
    found = _BatchScan(path, time, experiment)
    for batch in file.iter_batches(batch_size=BATCH_ROWS, columns=wanted):
        instants = (
            None
            if time is None
            else found.seconds(batch.column(time).to_numpy(zero_copy_only=False))
        )
        found.add(instants, None if experiment is None else _numbers(batch, experiment))
    return found.end_scan()


class _BatchScan:
    """Begins of experiments and steps of time, batch by batch.

    Each batch is joined to the last row before it.
    """

    def __init__(self, path: Path, time: str | None, experiment: str | None) -> None:
        self.path, self.time, self.experiment = path, time, experiment
        self.rows, self.before = 0, (np.zeros(0), np.zeros(0))
        self.begins: list[int] = []
        self.began: list[float] = []
        self.labels: set[float] = set()
        self.usual, self.steps, self.counted = np.nan, 0.0, 0
        self.rates: list[float] = []
        self.origin: Any = None

    def seconds(self, instants: np.ndarray) -> np.ndarray:
        """Return a batch of the time column in s, dates since the first row of the file."""
        if instants.dtype.kind != "M":
            return in_seconds(np.asarray(instants, dtype=float), self.time or "")
        self.origin = instants[0] if self.origin is None else self.origin
        return (instants - self.origin) / np.timedelta64(1, "s")

    def add(self, instants: np.ndarray | None, labels: np.ndarray | None) -> None:
        instants, labels = (
            np.zeros(len(b if a is None else a)) if a is None else a  # type: ignore[arg-type]
            for a, b in ((instants, labels), (labels, instants))
        )
        for values, name in ((instants, self.time), (labels, self.experiment)):
            bad = np.flatnonzero(~np.isfinite(values))
            if len(bad):
                row = self.rows + int(bad[0])
                raise InputError(
                    f"{self.path}: row {row}, column '{name}': expected a finite number."
                )
        known = len(self.before[0])
        instants, labels = (
            np.concatenate(pair) for pair in zip(self.before, (instants, labels), strict=True)
        )
        fresh = np.diff(labels) != 0
        for i in [*([] if known else [0]), *(np.flatnonzero(fresh) + 1).tolist()]:
            if labels[i] in self.labels:
                raise InputError(
                    f"{self.path}: row {self.rows - known + i}: experiment {labels[i]:g} goes "
                    f"on after another has begun; sort the rows by '{self.experiment}', then "
                    "by time."
                )
            self.labels.add(labels[i])
            self.begins.append(self.rows - known + i)
            self.began.append(float(instants[i]))
        if self.time is not None:
            self._follow(np.where(fresh, np.nan, np.diff(instants)), self.rows - known + 1)
        self.rows += len(labels) - known
        self.before = instants[-1:], labels[-1:]

    def _follow(self, steps: np.ndarray, first: int) -> None:
        """Raise InputError for a step of time that is not the usual one of this file.

        Steps between experiments are NaN.
        """
        inside = np.isfinite(steps)
        if not inside.any():
            return
        if np.isnan(self.usual):
            self.usual = float(np.nanmedian(steps))
        odd = np.flatnonzero(inside & ~(np.abs(steps - self.usual) <= JITTER * self.usual))
        if len(odd):
            raise InputError(
                f"{self.path}: row {first + int(odd[0])}, column '{self.time}': a step of "
                f"{steps[odd[0]]:g} s where {self.usual:g} s is usual; expected evenly "
                "sampled, rising time within an experiment. Resample, sort, or name the column "
                "that labels the experiments."
            )
        self.steps, self.counted = (
            self.steps + float(np.nansum(steps)),
            self.counted + int(inside.sum()),
        )
        if inside.sum() >= _FEWEST_STEPS:
            self.rates.append(float(np.nanmean(steps)))

    def end_scan(self) -> tuple[Runs, float | None]:
        ranges = tuple(zip(self.begins, [*self.begins[1:], self.rows], strict=True))
        if self.time is None:
            return Runs(ranges, (0.0,) * len(ranges)), None
        if not self.counted:
            raise InputError(
                f"{self.path}: one row is too few for a sampling time from column '{self.time}'."
            )
        step = self.steps / self.counted
        if self.rates and max(self.rates) - min(self.rates) > DRIFT * step:
            drifts = f"the step drifts between {min(self.rates):g} s and {max(self.rates):g} s"
            raise InputError(
                f"{self.path}: column '{self.time}': {drifts}; resample, or take files at one rate."
            )
        return Runs(ranges, tuple(self.began)), step


def _group_rows(groups: Sequence[int], least: int) -> Iterator[tuple[int, int]]:
    """Return row ranges of partitions: row groups joined until there are `least` rows."""
    start = stop = 0
    for rows in groups:
        stop += rows
        if stop - start >= least:
            yield start, stop
            start = stop
    if stop > start:
        yield start, stop


def _batches(
    path: Path, start: int, stop: int, reading: ChannelColumns
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield rows `[start, stop)` of a file as (first row, matrix of its columns)."""
    with parquet_file(path) as file:
        ends = np.cumsum(
            [file.metadata.row_group(i).num_rows for i in range(file.metadata.num_row_groups)]
        )
        first, last = np.searchsorted(ends, [start, stop - 1], side="right").tolist()
        position = int(ends[first - 1]) if first else 0
        groups = list(range(first, last + 1))
        for batch in file.iter_batches(
            batch_size=BATCH_ROWS, row_groups=groups, columns=reading.distinct, use_threads=False
        ):
            begin, end = max(start - position, 0), min(stop - position, len(batch))
            if begin < end:
                values = {name: _numbers(batch, name)[begin:end] for name in reading.distinct}
                yield position + begin, np.stack([values[name] for name in reading.columns]).T
            position += len(batch)


def _numbers(batch: Any, name: str) -> np.ndarray:
    return np.asarray(batch.column(name).to_numpy(zero_copy_only=False), dtype=float)
