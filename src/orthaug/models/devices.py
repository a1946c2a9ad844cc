"""The engine of several devices: rows sharded over them, sums by all-reduce.

It serves the GPUs of a machine, forced CPU devices, and the processes of a multi-host run, of which each makes its own
shards.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix
from orthaug._base.jax import jax
from orthaug._base.memory import available
from orthaug._base.parallel import Heard, Threads, in_threads, nobody
from orthaug.models.rows import CHUNK_ROWS, Chunk, Room, brought, chunk_shape, in_chunks, row_sum

_ROWS = "rows"
_MATRICES = 3  # the sum so far, what a chunk adds, and what all devices have


@dataclass(frozen=True)
class Devices(Threads):
    """All rows in the memory of the devices, in equal shares; `count` of them, None for all there are."""

    count: int | None = None
    limit: int = CHUNK_ROWS
    resident: bool = False

    def lay(self, z: Matrix, q: Any, e: Matrix, gain: Float[np.ndarray, "N ny ny"]) -> Chunk:
        mesh, shares = _mesh(self.count)
        shape = _even(chunk_shape(-(-len(z) // shares), self.limit), shares)
        sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec(_ROWS))

        def sharded(values: Any, repeat: bool = False) -> Any:
            chunks = in_chunks(np.asarray(values), shape, repeat=repeat)
            return jax.make_array_from_callback(chunks.shape, sharding, lambda index: chunks[index])

        return Chunk(sharded(z, repeat=True), *map(sharded, (q, e, gain)))

    def draw(self, source: Any, laying: Callable[[Any], Any]) -> Chunk:
        return self.lay(*brought(source, laying))

    def passes(self, function: Callable[[Any], Any], partitions: Sequence[Any]) -> list[Any]:
        return in_threads(function, partitions)

    def sum(self, function: Callable[..., Any], rows: Chunk, *arguments: Any) -> Any:
        return _compiled(function, self.count, len(arguments))(rows, *arguments)

    def map(self, function: Any, given: Any, items: Sequence[Any], heard: Heard = nobody) -> Iterator[Any]:
        """One after another: programs that share devices wait for each other, on all hosts in the same order."""
        for i, item in enumerate(items):
            yield function(given, item, partial(heard, i))

    def room(self) -> Room:
        """Of a device: its own memory, or a share of this machine's."""
        own_process = jax.process_index()
        devices = [device for device in jax.devices()[: self.count] if device.process_index == own_process]
        own = [(device.memory_stats() or {}).get("bytes_limit", available() / len(devices)) for device in devices]
        smallest = min(range(len(devices)), key=lambda i: own[i])
        return Room(own[smallest], f"the device {devices[smallest]}", _MATRICES)


def _even(shape: tuple[int, int], shares: int) -> tuple[int, int]:
    """Chunks for all shares of chunks for one."""
    return shape[0] * shares, shape[1]


@cache
def _mesh(count: int | None) -> tuple[Any, int]:
    devices = jax.devices()[:count]
    return jax.sharding.Mesh(np.array(devices), (_ROWS,)), len(devices)


@cache
def _compiled(function: Callable[..., Any], count: int | None, arguments: int) -> Any:
    """Each device sums over its own chunks; then all of them have the sum."""
    spec = jax.sharding.PartitionSpec
    mesh, _ = _mesh(count)

    def share(chunks: Chunk, *given: Any) -> Any:
        return jax.lax.psum(row_sum(lambda chunk: function(chunk, *given), chunks), _ROWS)

    specs = (spec(_ROWS), *(spec() for _ in range(arguments)))
    return jax.jit(jax.shard_map(share, mesh=mesh, in_specs=specs, out_specs=spec(), check_vma=False))
