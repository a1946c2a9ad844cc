"""Sources of rows: files larger than memory, read in pieces with the rows that lags need.

A source is cut into partitions. Each can be read on its own, here or by another process, and gives
pieces: experiments whose first rows are history only.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np

from orthaug._base.errors import InputError
from orthaug.data.channels import Channel
from orthaug.data.record import Experiment, Record, unbroken

WITNESS_ROWS = 50_000
"""Rows kept in memory for tests of residuals, findings and figures."""
_WINDOWS = 10  # that they are taken from, where the source has more


@runtime_checkable
class Partition(Protocol):
    """Consecutive rows that one task reads; small and picklable."""

    @property
    def name(self) -> str:
        """Name in messages."""
        ...

    @property
    def rows(self) -> int:
        """Largest number of rows: missing samples are left out when it is read."""
        ...

    def pieces(self, lead: int) -> Iterator[Experiment]:
        """Yield its rows in order.

        The first `lead` rows of a piece are history, or the begin of an experiment.

        Raises:
            InputError: cells that are no finite numbers, a file that has changed.
        """
        ...


@runtime_checkable
class Source(Protocol):
    """Records whose rows are read when they are needed."""

    @property
    def inputs(self) -> tuple[Channel, ...]: ...

    @property
    def outputs(self) -> tuple[Channel, ...]: ...

    @property
    def sampling_time(self) -> float: ...

    @property
    def time_column(self) -> str | None: ...

    @property
    def experiment_column(self) -> str | None: ...

    @property
    def partitions(self) -> Sequence[Partition]:
        """Partitions in order; experiments may begin in one and go on in the next."""
        ...

    def window(self, start: int, stop: int) -> list[Experiment]:
        """Return rows `[start, stop)`, counted over all partitions."""
        ...


def rows_of(source: Source) -> int:
    """Return the number of rows of a source."""
    return sum(partition.rows for partition in source.partitions)


def as_record(source: Source, experiments: Sequence[Experiment]) -> Record:
    """Return some of its rows as a record in memory."""
    return Record(
        source.inputs,
        source.outputs,
        source.sampling_time,
        tuple(experiments),
        source.time_column,
        experiment_column=source.experiment_column,
    )


def witness(source: Source, limit: int = WITNESS_ROWS) -> Record:
    """Return a record in memory as a sample of the source.

    It is all of the source, or windows that are spread evenly over it.
    """
    total = rows_of(source)
    if total <= limit:
        return as_record(source, source.window(0, total))
    size = limit // _WINDOWS
    begins = np.linspace(0, total - size, _WINDOWS).astype(int)
    return as_record(
        source, [e for begin in begins for e in source.window(int(begin), int(begin) + size)]
    )


@dataclass(frozen=True, eq=False)
class RowPartition:
    """A partition that carries its rows."""

    experiment: Experiment
    start: int
    """The first row of its own; those before it are history."""

    @property
    def name(self) -> str:
        return self.experiment.where(self.start)

    @property
    def rows(self) -> int:
        return len(self.experiment) - self.start

    def pieces(self, lead: int) -> Iterator[Experiment]:
        yield _slice_experiment(self.experiment, max(self.start - lead, 0), None)


@dataclass(frozen=True, eq=False)
class Span:
    """A partition and those after it, from which its experiments are read to their end.

    `held` are the futures of those that have any, `counts` how many each.
    """

    partitions: tuple[Any, ...]
    held: tuple[Any, ...]
    counts: tuple[int, ...]

    @classmethod
    def of(cls, partitions: Sequence[Any], rows: int) -> Span:
        """Return a span of the first partition and the others.

        No more than the first `rows` are needed of the last one.
        """
        if len(partitions) > 1 and hasattr(partitions[-1], "head"):
            partitions = (*partitions[:-1], partitions[-1].head(rows))
        held = [getattr(partition, "held", ()) for partition in partitions]
        bare = (replace(p, held=()) if own else p for p, own in zip(partitions, held, strict=True))
        return cls(
            tuple(bare), tuple(future for own in held for future in own), tuple(map(len, held))
        )

    def on(self, *held: object) -> Span:
        """Return the span with the rows, on the worker that holds them."""
        ends = np.cumsum(self.counts).tolist()
        there = (
            p.on(*held[end - count : end]) if count else p
            for p, end, count in zip(self.partitions, ends, self.counts, strict=True)
        )
        return replace(self, partitions=tuple(there), held=(), counts=(0,) * len(self.counts))

    @property
    def name(self) -> str:
        return self.partitions[0].name

    @property
    def rows(self) -> int:
        """Number of rows of the first partition."""
        return self.partitions[0].rows

    def pieces(self, lead: int) -> Iterator[Experiment]:
        """Yield the pieces of all its partitions."""
        return (piece for partition in self.partitions for piece in partition.pieces(lead))


def _slice_experiment(experiment: Experiment, start: int, stop: int | None) -> Experiment:
    """Return rows of an experiment with their offset from the start of the recording."""
    return replace(experiment.rows(start, stop), offset=experiment.offset + start)


@dataclass(frozen=True, eq=False)
class RecordSource:
    """A record in memory as a source, in partitions of `size` rows.

    Each partition carries `lead` rows of history.
    """

    record: Record
    lead: int
    size: int = 100_000

    @property
    def inputs(self) -> tuple[Channel, ...]:
        return self.record.inputs

    @property
    def outputs(self) -> tuple[Channel, ...]:
        return self.record.outputs

    @property
    def sampling_time(self) -> float:
        return self.record.sampling_time

    @property
    def time_column(self) -> str | None:
        return self.record.time_column

    @property
    def experiment_column(self) -> str | None:
        return self.record.experiment_column

    @property
    def partitions(self) -> tuple[RowPartition, ...]:
        return self._held

    @cached_property
    def _held(self) -> tuple[RowPartition, ...]:
        held = []
        for experiment in self.record.experiments:
            for begin in range(0, len(experiment), self.size):
                first = max(begin - self.lead, 0)
                held.append(
                    RowPartition(
                        _slice_experiment(experiment, first, begin + self.size), begin - first
                    )
                )
        return tuple(held)

    def window(self, start: int, stop: int) -> list[Experiment]:
        found, before = [], 0
        for experiment in self.record.experiments:
            a, b = max(start - before, 0), min(stop - before, len(experiment))
            if a < b:
                found.append(_slice_experiment(experiment, a, b))
            before += len(experiment)
        return found


def stretches(experiment: Experiment, lead: int) -> Iterator[Experiment]:
    """Yield the stretches of a piece without missing samples.

    It is cut at the missing ones: no lag reaches across.
    """
    for begin, end in unbroken(np.hstack([experiment.inputs, experiment.outputs])):
        if end - begin == len(experiment):
            yield experiment
        elif end - begin > lead:
            yield _slice_experiment(experiment, begin, end)


def read_pieces(
    values: np.ndarray,
    channels: tuple[Sequence[Channel], Sequence[Channel]],
    lead: int,
    *,
    missing: str,
    columns: Sequence[str],
    name: object,
    **place: Any,
) -> Iterator[Experiment]:
    """Yield the pieces of rows that were read, in the units of their channels.

    Args:
        values: the rows, whose columns are those of the outputs, then of the inputs.
        channels: outputs and inputs.
        lead: rows of history before the first one.
        missing: "skip" to cut at missing samples; else they are refused.
        columns: names in the file.
        name: of the source, for messages.
        place: fields of an `Experiment` that say where the rows are.

    Raises:
        InputError: a missing sample that is not skipped.
    """
    count = len(channels[0])
    outputs, inputs = (
        values[:, part] * [c.scale for c in group] + [c.offset for c in group]
        for part, group in zip((slice(count), slice(count, None)), channels, strict=True)
    )
    experiment = Experiment(inputs, outputs, **place)
    if missing == "skip":
        yield from stretches(experiment, lead)
        return
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        row, column = bad[0]
        value = values[row, column]
        found = "the cell is empty" if np.isnan(value) else f"found '{value}'"
        where = f"row {experiment.first_row + row}, column '{columns[column]}'"
        raise InputError(f"{name}: {where}: {found}; expected a finite number.")
    yield experiment


def follows(one: Any, other: Any) -> bool:
    """Return whether the other experiment continues the recording where the one ends."""
    ends = (one.source, one.first_row + len(one), one.offset + len(one))
    return ends == (other.source, other.first_row, other.offset)


def join_pieces(pieces: Sequence[Experiment]) -> list[Experiment]:
    """Return the pieces of an experiment that follow one another as one."""
    joined: list[list[Experiment]] = []
    for piece in pieces:
        last = joined[-1][-1] if joined else None
        if last is not None and follows(last, piece):
            joined[-1].append(piece)
        else:
            joined.append([piece])
    return [
        replace(
            group[0],
            inputs=np.concatenate([piece.inputs for piece in group]),
            outputs=np.concatenate([piece.outputs for piece in group]),
        )
        for group in joined
    ]
