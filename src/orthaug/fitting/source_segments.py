"""Segments of rows that stay in a source: cut anew at every pass, or once where the rows are.

They are those of the same rows in memory. A segment belongs to the partition in which the first row that it needs is,
and is read on from the partitions after it. Where experiments begin and end is asked of all partitions first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from orthaug._base.jax import jnp
from orthaug.data.record import Experiment, Record
from orthaug.data.sources import Span, follows
from orthaug.fitting.segments import CHUNK, Segments, begins_of, segment_of
from orthaug.models.dynamics import Dynamics
from orthaug.models.rows import Engine


@dataclass(frozen=True)
class Seen:
    """A piece of a partition without its rows: what `Experiment` has beside them."""

    source: str
    first_row: int
    offset: int
    rows: int

    def __len__(self) -> int:
        return self.rows


def look(partition: Any) -> list[Seen]:
    """The pieces of a partition."""
    return [Seen(piece.source, piece.first_row, piece.offset, len(piece)) for piece in partition.pieces(0)]


@dataclass(frozen=True, eq=False)
class Found:
    """Where the experiments of a source begin, counted over the rows of all partitions, and how many rows they have."""

    begins: tuple[int, ...]
    rows: tuple[int, ...]
    ends: Int[np.ndarray, "partitions"]
    """Where the partitions end."""

    @classmethod
    def of(cls, seen: Sequence[Sequence[Seen]]) -> Found:
        """From the pieces of all partitions."""
        begins, rows, total = [], [], 0
        last: Seen | None = None
        for piece in (piece for pieces in seen for piece in pieces):
            if last is not None and follows(last, piece):
                rows[-1] += piece.rows
            else:
                begins.append(total)
                rows.append(piece.rows)
            total, last = total + piece.rows, piece
        return cls(tuple(begins), tuple(rows), np.cumsum([sum(p.rows for p in pieces) for pieces in seen]))


@dataclass(frozen=True, eq=False)
class Part:
    """The segments that begin in a partition: rows `[first, last)` of its span, (n, 2)."""

    span: Span
    rows: Int[np.ndarray, "n 2"]
    held: tuple[Any, ...] = ()

    @classmethod
    def of(cls, span: Span, rows: Any) -> Part:
        return cls(span, np.asarray(rows), span.held)

    def on(self, *held: Any) -> Part:
        """The same where the rows are."""
        return Part(self.span.on(*held), self.rows)


@dataclass(frozen=True, eq=False)
class Cutting:
    """How rows become segments, in chunks of `width`; picklable if the physics is."""

    dynamics: Dynamics
    empty: Record
    """Channels and sampling time."""
    steps: int
    washout: int
    width: int

    def __call__(self, part: Part) -> Iterator[Segments]:
        waiting: list[Segments] = []
        for experiment in _slices(part):
            inputs = self.dynamics.inputs(experiment, self.empty)
            waiting.append(segment_of(experiment, inputs, 0, self.steps, self.washout, self.dynamics))
            if len(waiting) == self.width:
                yield self._chunk(waiting)
                waiting = []
        if waiting:
            yield self._chunk(waiting)

    def _chunk(self, segments: list[Segments]) -> Segments:
        nothing = Segments(*(np.zeros_like(part) for part in segments[0]))
        filled = segments + [nothing] * (self.width - len(segments))
        return Segments(*(np.stack(part, axis=-1) for part in zip(*filled, strict=True)))


def _slices(part: Part) -> Iterator[Experiment]:
    """The rows of each segment; those before the next one are let go."""
    pieces, begin = part.span.pieces(0), 0
    inputs, outputs = [], []
    for first, last in part.rows.tolist():
        while begin + sum(map(len, inputs)) < last:
            piece = next(pieces)
            inputs.append(piece.inputs)
            outputs.append(piece.outputs)
        while begin + len(inputs[0]) <= first:
            begin += len(inputs.pop(0))
            outputs.pop(0)
        inputs, outputs = ([np.concatenate(group)] if len(group) > 1 else group for group in (inputs, outputs))
        yield Experiment(inputs[0][first - begin : last - begin], outputs[0][first - begin : last - begin])


@dataclass(frozen=True)
class Starting:
    """The measured states of a chunk and which of its segments are any, and how many steps are scored."""

    def __call__(self, segments: Segments) -> tuple[Any, Any]:
        return (segments.start, jnp.any(segments.scored, axis=0)), jnp.sum(segments.scored)


@dataclass(frozen=True, eq=False)
class SourceSegments:
    """The segments of a source where an engine reads or keeps them; elsewhere they count as `Segments` do."""

    rows: Any
    """Of the engine, chunks of `Segments`."""
    steps: int
    count: int
    """Scored steps."""
    start: Float[np.ndarray, "k n0 m"]
    there: Any
    """(k, m), which are scored anywhere."""

    @classmethod
    def cut(
        cls,
        engine: Engine,
        source: Any,
        found: Found,
        dynamics: Dynamics,
        empty: Record,
        segment: int,
        washout: int,
        most: int | None = None,
    ) -> SourceSegments:
        """Segments of `segment` steps, 0 for whole experiments, of which the first `most` rows count."""
        lag = dynamics.first_row
        usable = [(rows if most is None else min(rows, most)) - lag for rows in found.rows]
        steps = min(segment, max(usable)) if segment else max(usable)
        washout = min(washout, steps - 1)
        places = [
            (begin + own, begin + own + lag + min(steps, rows - own))
            for begin, rows in zip(found.begins, usable, strict=True)
            for own in begins_of(rows, steps, washout)
        ]
        rows = np.array(places).reshape(-1, 2)
        owner = np.searchsorted(found.ends, rows[:, 0], side="right")
        reach = np.searchsorted(found.ends, rows[:, 1] - 1, side="right")
        parts, counts = [], []
        for i in np.unique(owner).tolist():
            own, last = rows[owner == i], int(reach[owner == i].max())
            before = int(found.ends[i - 1]) if i else 0
            into = int(rows[owner == i, 1].max() - (found.ends[last - 1] if last > i else 0))
            parts.append(Part.of(Span.of(source.partitions[i : last + 1], into), own - before))
            counts.append(len(own))
        width = max(-(-n // -(-n // CHUNK)) for n in counts)
        cutting = Cutting(dynamics, empty, steps, washout, width)
        read = engine.read(cutting, parts, [-(-n // width) for n in counts])
        kept, count = engine.keep(Starting(), read)
        start, there = engine.fetch(kept)
        return cls(read, steps, int(count), np.asarray(start), np.asarray(there))
