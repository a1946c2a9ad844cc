"""The engine of rows that do not fit into memory: they are read, laid out and summed chunk by chunk, at every pass.

A thread reads ahead while the chunk before it is summed. All chunks have one shape, so one compiled program serves.
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
from orthaug._base.parallel import Threads, in_threads
from orthaug.data.sources import Source, rows_of
from orthaug.models.rows import CHUNK_ROWS, Chunk, chunk_shape, in_chunks

_AHEAD = 3  # chunks that wait to be summed

Laid = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Features (m, nz), Q (m, ny, nθ), P⊥Y (m, ny) and gain (m, ny, ny) of some rows."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """Rows of a source: where they are, how they are laid out, and in chunks of how many."""

    source: Source
    laying: Callable[[Any], Iterator[Laid]]
    size: int

    def __iter__(self) -> Iterator[Chunk]:
        return chunks_of((laid for partition in self.source.partitions for laid in self.laying(partition)), self.size)


@dataclass(frozen=True)
class Stream(Threads):
    """Rows stay in their files; memory holds a few chunks of them."""

    limit: int = CHUNK_ROWS
    resident: bool = False

    def lay(self, z: Matrix, q: Any, e: Matrix, gain: Float[np.ndarray, "N ny ny"]) -> list[Chunk]:
        """Rows that are in memory, in chunks."""
        shape = chunk_shape(len(z), self.limit)
        pieces = (in_chunks(z, shape, repeat=True), *(in_chunks(piece, shape) for piece in (q, e, gain)))
        return [Chunk(*parts) for parts in zip(*pieces, strict=True)]

    def draw(self, source: Source, laying: Callable[[Any], Iterator[Laid]]) -> Drawn:
        return Drawn(source, laying, chunk_shape(rows_of(source), self.limit)[1])

    def sum(self, function: Callable[..., Any], rows: Iterable[Chunk], *arguments: Any) -> Any:
        return summed(function, rows, arguments)

    def passes(self, function: Callable[[Any], Any], partitions: Sequence[Any]) -> list[Any]:
        """A function of every partition, as many at a time as there are cores."""
        return in_threads(function, partitions)

    def room(self) -> None:
        """None: all sums are made here."""


def summed(function: Callable[..., Any], rows: Iterable[Chunk], arguments: tuple[Any, ...]) -> Any:
    """Σ function(chunk, *arguments), in the order of the rows."""
    arguments = jax.tree.map(jax.numpy.asarray, arguments)
    first, more = _compiled(function)
    total = None
    for chunk in read_ahead(rows):
        total = first(chunk, *arguments) if total is None else more(total, chunk, *arguments)
        jax.block_until_ready(total)  # no more than one waits; memory stays flat
    return total


@cache
def _compiled(function: Callable[..., Any]) -> tuple[Any, Any]:
    """The function, and what adds it to a sum."""

    def more(total: Any, chunk: Chunk, *arguments: Any) -> Any:
        return jax.tree.map(jax.numpy.add, total, function(chunk, *arguments))

    return jax.jit(function), jax.jit(more, donate_argnums=0)


def chunks_of(pieces: Iterable[Laid], size: int) -> Iterator[Chunk]:
    """Rows in chunks of one size, the row index last; the last one is padded with rows that count for nothing."""
    waiting: list[Laid] = []
    held = 0
    for piece in pieces:
        waiting.append(piece)
        held += len(piece[0])
        if held < size:
            continue
        laid = _joined(waiting)
        for begin in range(0, held - size + 1, size):
            yield _chunk(tuple(part[begin : begin + size] for part in laid), size)
        left = held % size
        waiting, held = [tuple(part[len(part) - left :] for part in laid)] if left else [], left  # type: ignore[list-item]
    if waiting:
        yield _chunk(_joined(waiting), size)


def _joined(pieces: Sequence[Laid]) -> Any:
    return pieces[0] if len(pieces) == 1 else tuple(map(np.concatenate, zip(*pieces, strict=True)))


def _chunk(laid: Any, size: int) -> Chunk:
    return Chunk(*(in_chunks(np.asarray(part), (1, size), repeat=j == 0)[0] for j, part in enumerate(laid)))


def read_ahead(items: Iterable[Any], ahead: int = _AHEAD) -> Iterator[Any]:
    """The items in order, made by a thread of their own while the caller works; its errors are raised here."""
    ready: queue.Queue[tuple[bool, Any]] = queue.Queue(ahead)
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
