"""The engine of several devices: rows sharded over them, sums by all-reduce.

It serves the GPUs of a machine, forced CPU devices, and the processes of a multi-host run, of which
each makes its own shards.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix
from orthaug._base.jax import AnyArray, Array, jax
from orthaug._base.memory import available
from orthaug._base.parallel import Given, Heard, Item, Result, nobody
from orthaug.data.sources import Partition, Source
from orthaug.models.rows import (
    CHUNK_ROWS,
    Chunk,
    LocalEngine,
    Room,
    RowArrays,
    all_chunks,
    build_chunk,
    chunk_shape,
    read_all_rows,
    row_fold,
)

_ROWS = "rows"
# Devices that wait for each other in two programs would wait for ever
_ONE_AT_A_TIME = threading.Lock()
_MATRICES = 3  # the sum so far, what a chunk adds, and what all devices have


@dataclass(frozen=True)
class Devices(LocalEngine):
    """All rows in the memory of the devices, in equal shares.

    Args:
        count: devices; None for all there are.
        limit: rows of a chunk.
    """

    count: int | None = None
    limit: int = CHUNK_ROWS
    resident: bool = False

    def build_rows(
        self, z: Matrix, q: np.ndarray, e: Matrix, gain: Float[np.ndarray, "N ny ny"]
    ) -> Chunk:
        # Of the chunks of one share
        count, size = chunk_shape(-(-len(z) // self.shares), self.limit)
        return self.place(build_chunk(z, q, e, gain, (count * self.shares, size)))

    def draw(
        self, source: Source, row_builder: Callable[[Partition], Iterator[RowArrays]]
    ) -> Chunk:
        return self.build_rows(*read_all_rows(source, row_builder))

    def sum(self, function: Callable[..., Result], rows: Chunk, *arguments: object) -> Result:
        return self._run(function, rows, arguments, keeps=False)[1]

    @property
    def shares(self) -> int:
        return _mesh(self.count)[1]

    def place(self, chunks: Result, like: object = None) -> Result:
        sharding = jax.sharding.NamedSharding(
            _mesh(self.count)[0], jax.sharding.PartitionSpec(_ROWS)
        )

        def shard(values: AnyArray) -> Array:
            held = np.asarray(values)
            return jax.make_array_from_callback(held.shape, sharding, lambda index: held[index])

        return jax.tree.map(shard, chunks)

    def read(
        self,
        function: Callable[[Item], Iterable[object]],
        partitions: Sequence[Item],
        counts: Sequence[int],
    ) -> Any:
        def pad_shares(part: np.ndarray) -> np.ndarray:
            return np.concatenate(
                [part, np.zeros((-len(part) % self.shares, *part.shape[1:]), part.dtype)]
            )

        return self.place(jax.tree.map(pad_shares, all_chunks(function, partitions)))

    def keep(
        self, function: Callable[..., tuple[object, Result]], rows: Any, *arguments: object
    ) -> tuple[Any, Result]:
        return self._run(function, rows, arguments, keeps=True)

    def _run(
        self,
        function: Callable[..., object],
        rows: Any,
        arguments: tuple[object, ...],
        *,
        keeps: bool,
    ) -> tuple[Any, Any]:
        with _ONE_AT_A_TIME:
            return jax.block_until_ready(
                _compile_sum(function, self.count, len(arguments), keeps)(rows, *arguments)
            )

    def map(
        self,
        function: Callable[[Given, Item, Callable[..., None]], Result],
        given: Given,
        items: Sequence[Item],
        heard: Heard = nobody,
    ) -> Iterator[Result]:
        """Yield the results one after another.

        Programs that share devices wait for each other, on all hosts in the same order.
        """
        for i, item in enumerate(items):
            yield function(given, item, partial(heard, i))

    def room(self) -> Room:
        """Return the room of a device: its own memory, or a share of this machine's."""
        own_process = jax.process_index()
        devices = [
            device for device in jax.devices()[: self.count] if device.process_index == own_process
        ]
        own = [
            (device.memory_stats() or {}).get("bytes_limit", available() / len(devices))
            for device in devices
        ]
        smallest = min(range(len(devices)), key=lambda i: own[i])
        return Room(own[smallest], f"the device {devices[smallest]}", _MATRICES)


@cache
def _mesh(count: int | None) -> tuple[jax.sharding.Mesh, int]:
    devices = jax.devices()[:count]
    return jax.sharding.Mesh(np.array(devices), (_ROWS,)), len(devices)


@cache
def _compile_sum(
    function: Callable[..., Any], count: int | None, arguments: int, keeps: bool
) -> Callable[..., Any]:
    """Compile a sum: each device adds up its own chunks, then all of them have the total.

    With `keeps` each device also returns what it keeps.
    """
    spec = jax.sharding.PartitionSpec

    def share(chunks: object, *given: object) -> tuple[object, object]:
        def pair(chunk: object) -> tuple[Any, Any]:
            found = function(chunk, *given)
            return found if keeps else (None, found)

        kept, total = row_fold(pair, chunks)
        return kept, jax.lax.psum(total, _ROWS)

    split = {"in_specs": (spec(_ROWS), *[spec()] * arguments), "out_specs": (spec(_ROWS), spec())}
    return jax.jit(jax.shard_map(share, mesh=_mesh(count)[0], **split, check_vma=False))
