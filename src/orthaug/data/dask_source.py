"""A Dask DataFrame as a source: its partitions stay on the workers of a cluster."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from orthaug._base.errors import InputError
from orthaug.data.channels import Channel, as_channels, check_channels
from orthaug.data.record import Experiment, check_step
from orthaug.data.sources import join_pieces, read_pieces

_NAME = "the DataFrame"
_HISTORY = 10_000  # rows of the partition before that are kept beside each: no lag is larger


@dataclass(frozen=True, eq=False)
class FramePartition:
    """One partition of a DataFrame.

    `held` are futures of it and of the last rows of the one before.
    """

    name: str
    rows: int
    columns: tuple[str, ...]
    experiment: str | None
    channels: tuple[tuple[Channel, ...], tuple[Channel, ...]]
    first_row: int
    missing: str
    held: tuple[Any, ...]

    def on(self, frame: Any, before: Any) -> FramePartitionData:
        """Return the partition with its rows, on the worker that holds them."""
        return FramePartitionData(replace(self, held=()), frame, before)

    def head(self, rows: int) -> FramePartition:
        """Return its first rows, taken on the worker that holds them."""
        first = self.held[0].client.submit(_rows, self.held[0], 0, rows, pure=False)
        return replace(self, rows=min(rows, self.rows), held=(first, self.held[1]))

    def pieces(self, lead: int) -> Iterator[Experiment]:
        """Yield its rows, brought here; an engine of the cluster reads them on the workers."""
        frame, before = (future.result() for future in self.held)
        return self.on(frame, before).pieces(lead)


@dataclass(frozen=True, eq=False)
class FramePartitionData:
    """A partition with its rows."""

    of: FramePartition
    frame: Any
    before: Any

    @property
    def name(self) -> str:
        return self.of.name

    @property
    def rows(self) -> int:
        return self.of.rows

    def pieces(self, lead: int) -> Iterator[Experiment]:
        """Yield its rows; see `Partition.pieces`."""
        own = self.of
        known = 0 if self.before is None else len(self.before)
        if known < min(lead, own.first_row):
            raise InputError(
                f"{own.name}: the one before has {known} rows, fewer than the largest lag, "
                f"{lead}; repartition the DataFrame."
            )
        frames = [self.frame] if self.before is None else [self.before, self.frame]
        try:
            values = np.concatenate(
                [frame[list(own.columns)].to_numpy(dtype=float) for frame in frames]
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"{own.name}: {error}; expected the columns {', '.join(own.columns)}, numbers."
            ) from None
        labels = np.zeros(len(values))
        if own.experiment is not None:
            labels = np.concatenate(
                [frame[own.experiment].to_numpy(dtype=float) for frame in frames]
            )
        borders = [0, *(1 + np.flatnonzero(np.diff(labels))).tolist(), len(values)]
        for start, stop in zip(borders, borders[1:], strict=False):
            first = max(start, known - lead)
            if stop <= known or first >= stop:
                continue
            label = "" if own.experiment is None else f", experiment {labels[start]:g}"
            row = own.first_row - known + first
            yield from read_pieces(
                values[first:stop],
                own.channels,
                lead,
                missing=own.missing,
                columns=own.columns,
                name=self.name,
                source=f"{_NAME}{label}",
                first_row=row,
                offset=row,
            )


@dataclass(frozen=True, eq=False)
class FrameSource:
    """A Dask DataFrame, its partitions in order; make one with `open_frame`."""

    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    sampling_time: float
    partitions: tuple[FramePartition, ...]
    client: Any
    time_column: str | None = None
    experiment_column: str | None = None

    def window(self, start: int, stop: int) -> list[Experiment]:
        """Return rows `[start, stop)`, brought here."""
        found = []
        for partition in self.partitions:
            a, b = (
                max(start - partition.first_row, 0),
                min(stop - partition.first_row, partition.rows),
            )
            if a < b:
                frame = self.client.submit(_rows, partition.held[0], a, b, pure=False).result()
                shown = replace(partition, first_row=partition.first_row + a, rows=b - a, held=())
                found += FramePartitionData(shown, frame, None).pieces(0)
        return join_pieces(found)


def open_frame(
    frame: Any,
    *,
    inputs: Sequence[str | Channel] = (),
    outputs: Sequence[str | Channel] = (),
    sampling_time: float = 1.0,
    experiment: str | None = None,
    columns: Mapping[str, str] | None = None,
    missing: str = "error",
    client: Any = None,
) -> FrameSource:
    """Return a Dask DataFrame whose rows are in order; its partitions are kept on the workers.

    Args:
        frame: a `dask.dataframe.DataFrame`.
        inputs, outputs: channel names, or `Channel`s with column, unit, scale and offset.
        sampling_time: seconds between rows.
        experiment: the column of numbers that labels the experiments; each is in one piece.
        columns: the frame's column for a channel.
        missing: "error", or "skip" to end a stretch at rows with a missing sample.
        client: a `distributed.Client`; None for the one at hand.

    Raises:
        InputError: without a client, columns that are not there, an empty partition.
    """
    from distributed import default_client

    groups = as_channels(outputs, "outputs"), as_channels(inputs, "inputs")
    check_channels(groups[1], groups[0])
    given = dict(columns or {})
    own = tuple(given.get(c.name, c.file_column) for group in groups for c in group)
    absent = [
        name for name in (*own, *([experiment] if experiment else [])) if name not in frame.columns
    ]
    if absent:
        raise InputError(
            f"the DataFrame has no column '{absent[0]}'; it has "
            f"{', '.join(map(str, frame.columns))}."
        )
    if client is None:
        try:
            client = default_client()
        except ValueError:
            raise InputError(
                "there is no Dask client; make one, `distributed.Client()`, or give `client`."
            ) from None
    frames = client.compute(frame.to_delayed())
    tails = [None, *(client.submit(_tail, future, pure=False) for future in frames[:-1])]
    counts = client.gather(client.map(len, frames, pure=False))
    empty = [i for i, count in enumerate(counts) if not count]
    if empty:
        raise InputError(f"partition {empty[0]} of the DataFrame is empty; repartition it.")
    first = np.concatenate([[0], np.cumsum(counts)]).astype(int).tolist()
    partitions = tuple(
        FramePartition(
            f"{_NAME}, partition {i}",
            count,
            own,
            experiment,
            groups,
            first[i],
            missing,
            (frames[i], tails[i]),
        )
        for i, count in enumerate(counts)
    )
    return FrameSource(
        groups[1],
        groups[0],
        check_step(sampling_time),
        partitions,
        client,
        experiment_column=experiment,
    )


def _tail(frame: Any) -> Any:
    return frame.tail(_HISTORY)


def _rows(frame: Any, start: int, stop: int) -> Any:
    return frame.iloc[start:stop]
