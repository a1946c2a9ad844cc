"""The engine of rows that do not fit into memory.

They are read, built and summed chunk by chunk, at every pass.

A thread reads ahead while the chunk before it is summed. All chunks have one shape, so one compiled
program serves.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix
from orthaug._base.jax import jax
from orthaug._base.parallel import Item, Result
from orthaug.data.sources import Partition, Source, rows_of
from orthaug.models.rows import (
    CHUNK_ROWS,
    Chunk,
    Kept,
    LocalEngine,
    RowArrays,
    build_chunk,
    chunk_shape,
    join_chunks,
)

_AHEAD = 3  # chunks that wait to be summed


@dataclass(frozen=True, eq=False)
class SourceRows:
    """Rows of a source: its place, the function that builds them, and the rows in a chunk."""

    source: Source
    row_builder: Callable[[Partition], Iterator[RowArrays]]
    size: int

    def __iter__(self) -> Iterator[Chunk]:
        return chunks_of(
            (
                arrays
                for partition in self.source.partitions
                for arrays in self.row_builder(partition)
            ),
            self.size,
        )


@dataclass(frozen=True)
class Stream(LocalEngine):
    """Rows stay in their files; memory holds a few chunks of them, of `limit` rows."""

    limit: int = CHUNK_ROWS
    resident: bool = False

    def build_rows(
        self, z: Matrix, q: np.ndarray, e: Matrix, gain: Float[np.ndarray, "N ny ny"]
    ) -> list[Chunk]:
        """Keep rows that are in memory as chunks."""
        return split_chunks(build_chunk(z, q, e, gain, chunk_shape(len(z), self.limit)))

    def draw(
        self, source: Source, row_builder: Callable[[Partition], Iterator[RowArrays]]
    ) -> SourceRows:
        return SourceRows(source, row_builder, chunk_shape(rows_of(source), self.limit)[1])

    def sum(
        self, function: Callable[..., Result], rows: Iterable[Chunk], *arguments: object
    ) -> Result:
        return sum_rows(function, rows, arguments)

    @property
    def shares(self) -> int:
        return 1

    def place(self, chunks: Result, like: object = None) -> list[Result]:
        return split_chunks(chunks)

    def read(
        self,
        function: Callable[[Item], Iterable[object]],
        partitions: Sequence[Item],
        counts: Sequence[int],
    ) -> PartitionChunks:
        return PartitionChunks(function, partitions)

    def beside(self, *rows: Iterable[object]) -> PairedChunks:
        return PairedChunks(rows)

    def keep(
        self,
        function: Callable[..., tuple[Kept, Result]],
        rows: Iterable[object],
        *arguments: object,
    ) -> tuple[list[Kept], Result]:
        return fold_rows(function, rows, arguments)

    def fetch(self, rows: Iterable[Result]) -> Result:
        return join_chunks(list(rows))

    def room(self) -> None:
        """Return None, since all sums are made here."""


@dataclass(frozen=True, eq=False)
class PartitionChunks:
    """Chunks of partitions, read at every pass."""

    function: Callable[[Any], Iterable[object]]
    partitions: Sequence[object]

    def __iter__(self) -> Iterator[object]:
        return (chunk for partition in self.partitions for chunk in self.function(partition))


@dataclass(frozen=True, eq=False)
class PairedChunks:
    """Chunks of several rows, as tuples."""

    rows: tuple[Iterable[object], ...]

    def __iter__(self) -> Iterator[tuple[object, ...]]:
        return zip(*self.rows, strict=True)


def split_chunks(chunks: Result) -> list[Result]:
    """Return the rows of each: the inverse of `join_chunks`."""
    leaves, form = jax.tree.flatten(jax.tree.map(np.asarray, chunks))
    return [jax.tree.unflatten(form, parts) for parts in zip(*leaves, strict=True)]


def fold_rows(
    function: Callable[..., tuple[Kept, Result]],
    rows: Iterable[object],
    arguments: tuple[object, ...],
) -> tuple[list[Kept], Result]:
    """Return the first results of function(chunk, *arguments) on the host, and the second's sum."""
    arguments = jax.tree.map(jax.numpy.asarray, arguments)
    first, _ = _compile_sum(function)
    kept: list[Kept] = []
    total: Any = None
    for chunk in read_ahead(rows):
        own, share = jax.tree.map(np.asarray, first(chunk, *arguments))
        kept.append(own)
        total = share if total is None else jax.tree.map(np.add, total, share)
    return kept, total


def sum_rows(
    function: Callable[..., Result], rows: Iterable[object], arguments: tuple[object, ...]
) -> Result:
    """Return Σ function(chunk, *arguments), in the order of the rows."""
    arguments = jax.tree.map(jax.numpy.asarray, arguments)
    first, more = _compile_sum(function)
    total: Any = None
    for chunk in read_ahead(rows):
        total = first(chunk, *arguments) if total is None else more(total, chunk, *arguments)
        jax.block_until_ready(total)  # no more than one waits; memory stays flat
    return total


@cache
def _compile_sum(function: Callable[..., object]) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Compile the function, and the addition of its result to a sum."""

    def more(total: object, chunk: object, *arguments: object) -> object:
        return jax.tree.map(jax.numpy.add, total, function(chunk, *arguments))

    return jax.jit(function), jax.jit(more, donate_argnums=0)


def chunks_of(pieces: Iterable[RowArrays], size: int) -> Iterator[Chunk]:
    """Return rows in chunks of one size, the row index last.

    The last one is padded with rows that count for nothing.
    """
    parts: list[Any] = []
    held = 0
    for piece in pieces:
        rows, begin = len(piece[0]), 0
        while begin < rows:
            parts = parts or [np.zeros((*part.shape[1:], size)) for part in piece]
            count = min(size - held, rows - begin)
            for part, room in zip(piece, parts, strict=True):
                room[..., held : held + count] = np.moveaxis(part[begin : begin + count], 0, -1)
            held, begin = held + count, begin + count
            if held == size:
                yield Chunk(*parts)
                parts, held = [], 0
    if parts:
        # Zeros may be where the learner has no value
        parts[0][..., held:] = parts[0][..., held - 1 : held]
        yield Chunk(*parts)


def read_ahead(items: Iterable[Result]) -> Iterator[Result]:
    """Yield the items in order, made by a thread of their own while the caller works.

    Its errors are raised here.
    """
    ready: queue.Queue[tuple[bool, Any]] = queue.Queue(_AHEAD)
    given_up = threading.Event()

    def put(item: tuple[bool, Any]) -> bool:
        while not given_up.is_set():
            try:
                ready.put(item, timeout=0.1)
            except queue.Full:
                continue
            return True
        return False

    def fill() -> None:
        try:
            for item in items:
                if not put((True, item)):
                    return
            put((False, None))
        except BaseException as error:
            put((False, error))

    worker = threading.Thread(target=fill, name="orthaug-read-ahead", daemon=True)
    worker.start()
    try:
        while True:
            more, item = ready.get()
            if more:
                yield item
            elif item is None:
                return
            else:
                raise item
    finally:
        given_up.set()
        worker.join()
