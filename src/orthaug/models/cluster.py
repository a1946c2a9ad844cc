"""The engine of a Dask cluster: partitions stay on the workers, which sum over them.

N_w² numbers come back from a sum.

Each partition is built once, on the worker that keeps it. A pass is a task for each, and a tree
of sums in the order of the partitions: whoever computes them, and however often after a worker was
lost, the sum has the same bits.
"""

from __future__ import annotations

import atexit
import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from orthaug import __version__
from orthaug._base.checks import Matrix
from orthaug._base.errors import InputError
from orthaug._base.jax import jax
from orthaug._base.parallel import Item, Result, Threads
from orthaug.data.sources import Partition, Source
from orthaug.models.rows import (
    CHUNK_ROWS,
    Chunk,
    Kept,
    Room,
    RowArrays,
    build_chunk,
    chunk_shape,
    join_chunks,
)
from orthaug.models.streaming import chunks_of, fold_rows, split_chunks, sum_rows

if TYPE_CHECKING:
    from distributed import Future

_SINGLE_THREADED = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}
"""Threads of a worker of a local cluster, which has a worker for each core."""
_BRANCHES = 8  # partial sums that one task adds up
_PATIENCE = "20 s"  # to reach a scheduler


@dataclass(frozen=True, eq=False)
class ClusterChunks:
    """Futures of groups of chunks, or tuples of futures whose chunks belong together.

    `counts` are the chunks of each group.
    """

    futures: Sequence[Future | tuple[Future, ...]]
    counts: tuple[int, ...]

    def __iter__(self) -> Iterator[Future | tuple[Future, ...]]:
        return iter(self.futures)


@dataclass(frozen=True, eq=False)
class Dask(Threads):
    """Rows on the workers of a cluster.

    `client` is a `distributed.Client`; `orthaug[dask]` brings it. `limit` is the rows of a chunk.
    """

    client: Any
    limit: int = CHUNK_ROWS
    resident: bool = False

    def build_rows(
        self, z: Matrix, q: np.ndarray, e: Matrix, gain: Float[np.ndarray, "N ny ny"]
    ) -> list[Future]:
        """Send rows that are in memory here to the workers."""
        workers = self.shares
        shape = chunk_shape(len(z), min(self.limit, -(-len(z) // workers)))
        chunks = split_chunks(build_chunk(z, q, e, gain, shape))
        each = -(-len(chunks) // workers)
        with cluster_errors():
            groups = [chunks[i : i + each] for i in range(0, len(chunks), each)]
            return [self.client.submit(keep_on_worker, group, pure=False) for group in groups]

    def draw(
        self, source: Source, row_builder: Callable[[Partition], Iterator[RowArrays]]
    ) -> list[Future]:
        """Return the partitions of a source, built where they will be summed."""
        with cluster_errors():
            # Not scattered: what is lost can be made again
            task = partial(_build_chunks, row_builder=row_builder, size=self.limit)
            return [self._task_on(task, partition) for partition in source.partitions]

    def sum(
        self, function: Callable[..., Result], rows: Sequence[object], *arguments: object
    ) -> Result:
        given = jax.tree.map(np.asarray, arguments)
        with cluster_errors():
            return self._add_sums(
                [
                    self.client.submit(_partial_sum, function, part, given, pure=False)
                    for part in rows
                ]
            )

    def _add_sums(self, parts: list[Future]) -> Any:
        """Return the sum of partial sums, in their order."""
        while len(parts) > 1:
            groups = [parts[i : i + _BRANCHES] for i in range(0, len(parts), _BRANCHES)]
            parts = [self.client.submit(_add_parts, group, pure=False) for group in groups]
        return self.client.gather(parts[0])

    @property
    def shares(self) -> int:
        return max(len(self.client.nthreads()), 1)

    def place(self, chunks: object, like: object = None) -> ClusterChunks:
        pieces = split_chunks(chunks)
        each = -(-len(pieces) // min(self.shares, len(pieces)))
        whole, rest = divmod(len(pieces), each)
        counts = (
            like.counts
            if isinstance(like, ClusterChunks)
            else (*[each] * whole, *([rest] if rest else []))
        )
        ends = np.cumsum(counts).tolist()
        with cluster_errors():
            groups = [pieces[end - count : end] for end, count in zip(ends, counts, strict=True)]
            return ClusterChunks(
                [self.client.submit(keep_on_worker, group, pure=False) for group in groups],
                tuple(counts),
            )

    def read(
        self,
        function: Callable[[Item], Iterable[object]],
        partitions: Sequence[Item],
        counts: Sequence[int],
    ) -> ClusterChunks:
        with cluster_errors():
            return ClusterChunks(
                [
                    self._task_on(partial(_chunk_list, function), partition)
                    for partition in partitions
                ],
                tuple(counts),
            )

    def along(
        self, function: Callable[[Any, Result], Result], partitions: Sequence[Any], carry: Result
    ) -> Result:
        with cluster_errors():
            for partition in partitions:
                held = getattr(partition, "held", ())
                bare = replace(partition, held=()) if held else partition
                carry = self.client.submit(_carry_on, function, bare, carry, *held, pure=False)
            return self.client.gather(carry)

    def beside(self, *rows: ClusterChunks) -> ClusterChunks:
        return ClusterChunks(list(zip(*rows, strict=True)), rows[0].counts)

    def keep(
        self,
        function: Callable[..., tuple[object, Result]],
        rows: ClusterChunks,
        *arguments: object,
    ) -> tuple[ClusterChunks, Result]:
        given = jax.tree.map(np.asarray, arguments)
        with cluster_errors():
            both = [
                self.client.submit(_fold_partition, function, part, given, pure=False)
                for part in rows
            ]
            kept, parts = (
                [self.client.submit(itemgetter(i), one, pure=False) for one in both] for i in (0, 1)
            )
            return ClusterChunks(kept, rows.counts), self._add_sums(parts)

    def fetch(self, rows: ClusterChunks) -> Any:
        with cluster_errors():
            return join_chunks(
                [chunk for group in self.client.gather(list(rows)) for chunk in group]
            )

    def passes(
        self, function: Callable[[Item], Result], partitions: Sequence[Item]
    ) -> list[Result]:
        """Return a function of every partition, where the workers are."""
        with cluster_errors():
            return self.client.gather(
                [self._task_on(function, partition) for partition in partitions]
            )

    def room(self) -> Room:
        """Return the room of the smallest worker, which may add up a whole branch of the tree."""
        return smallest_worker(self.client, _BRANCHES + 1)

    def _task_on(self, function: Callable[[Any], object], partition: Any) -> Future:
        """Return a task; rows that the cluster holds already go to it by their futures."""
        held = getattr(partition, "held", ())
        if not held:
            return self.client.submit(function, partition, pure=False)
        return self.client.submit(
            _where_held, function, replace(partition, held=()), *held, pure=False
        )


def _build_chunks(
    partition: Partition, row_builder: Callable[[Partition], Iterator[RowArrays]], size: int
) -> list[Chunk]:
    """Return the chunks of a partition."""
    return list(chunks_of(row_builder(partition), chunk_shape(partition.rows, size)[1]))


def _where_held(function: Callable[[Any], Result], partition: Any, *held: object) -> Result:
    return function(partition.on(*held))


def _chunk_list(function: Callable[[Item], Iterable[Result]], partition: Item) -> list[Result]:
    return list(function(partition))


def _carry_on(
    function: Callable[[Any, Result], Result], partition: Any, carry: Result, *held: object
) -> Result:
    return function(partition.on(*held) if held else partition, carry)


def keep_on_worker(value: Result) -> Result:
    """Return the value that a worker keeps.

    The scheduler makes it again where that worker is lost.
    """
    return value


def _pair_chunks(groups: Any) -> list[object]:
    """Return the chunks of a group; of a tuple of groups, tuples of their chunks."""
    return (
        list(zip(*map(_pair_chunks, groups), strict=True)) if isinstance(groups, tuple) else groups
    )


def _fold_partition(
    function: Callable[..., tuple[Kept, Result]],
    chunks: Sequence[object],
    arguments: tuple[object, ...],
) -> tuple[list[Kept], Result]:
    """Return the part of a partition that is kept, and its share of a sum."""
    return fold_rows(function, _pair_chunks(chunks), arguments)


def _partial_sum(
    function: Callable[..., Result], chunks: Sequence[object], arguments: tuple[object, ...]
) -> Result:
    """Return one partition's share of a sum, as NumPy arrays."""
    return jax.tree.map(np.asarray, sum_rows(function, _pair_chunks(chunks), arguments))


def _add_parts(parts: Sequence[Result]) -> Result:
    total = parts[0]
    for part in parts[1:]:
        total = jax.tree.map(np.add, total, part)
    return total


def smallest_worker(client: Any, matrices: int) -> Room:
    """Return the worker with the least memory; without a limit it is infinite."""
    with cluster_errors():
        workers = client.scheduler_info(n_workers=-1)["workers"]
    limits = {
        address: float(worker["memory_limit"] or math.inf) for address, worker in workers.items()
    }
    smallest = min(limits, key=lambda address: limits[address], default="")
    return Room(limits.get(smallest, math.inf), f"the worker {smallest}", matrices)


@contextmanager
def cluster_errors() -> Iterator[None]:
    """Turn errors of the cluster into messages for the user."""
    from distributed import CancelledError, KilledWorker
    from distributed.comm.core import CommClosedError

    try:
        yield
    except KilledWorker as error:
        raise InputError(
            "the cluster gave up on a partition: its workers died "
            f"{error.allowed_failures + 1} times, most often for lack of memory. Take smaller "
            "partitions (engine.partition_rows) or larger workers."
        ) from None
    except (CancelledError, CommClosedError, OSError, TimeoutError) as error:
        text = (
            f"the cluster is lost ({type(error).__name__}); start it again, and fit with --resume."
        )
        raise InputError(text) from None


def connect(scheduler: str | None, workers: int | None) -> Any:
    """Return a client of the scheduler at an address, or of a local cluster.

    A local cluster has a process for each core.

    Raises:
        InputError: without Dask, where no scheduler answers, and for workers with other versions.
    """
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise InputError("the engine dask needs distributed; install orthaug[dask].") from None
    from dask import config

    if scheduler is None:
        count = workers or os.cpu_count() or 1
        own = f"{os.environ.get('XLA_FLAGS', '')} {_SINGLE_THREADED['XLA_FLAGS']}".strip()
        with config.set(
            {"distributed.nanny.pre-spawn-environ": _SINGLE_THREADED | {"XLA_FLAGS": own}}
        ):
            options: dict[str, Any] = {
                "n_workers": count,
                "threads_per_worker": 1,
                "dashboard_address": ":0",
            }
            client = Client(LocalCluster(**options))
    else:
        try:
            client = Client(scheduler, timeout=_PATIENCE)
        except (OSError, TimeoutError, ValueError) as error:
            raise InputError(
                f"no Dask scheduler answers at {scheduler} ({type(error).__name__})."
            ) from None
    atexit.register(
        _close_client, client, own=scheduler is None
    )  # before distributed's own, which logs what it cancels
    check_versions(client)
    return client


def _close_client(client: Any, *, own: bool) -> None:
    cluster = client.cluster
    client.close()
    if own:
        cluster.close()


def check_versions(client: Any) -> None:
    """Raise InputError for workers with another orthaug or JAX: sums would not be the same."""
    own = versions()
    for worker, found in client.run(versions, on_error="return").items():
        if isinstance(
            found, OSError
        ):  # it died while it was asked; its scheduler rebuilds its rows elsewhere
            continue
        if found != own:
            others = (
                ", ".join(f"{name} {found.get(name)}" for name in own)
                if isinstance(found, dict)
                else found
            )
            here = ", ".join(f"{name} {version}" for name, version in own.items())
            raise InputError(
                f"the worker {worker} has {others}; here is {here}. Install the same versions "
                "on both."
            )


def versions() -> dict[str, str]:
    """Return the versions of orthaug and JAX in this process."""
    import jax

    return {"orthaug": __version__, "jax": jax.__version__}
