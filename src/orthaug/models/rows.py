"""Sums over rows, and the engine that makes them.

Training and its statistics need no more of the data (F4).

Chunks hold the rows, with the row index last, padded with zero weights to one shape. So one
compiled program serves any number of rows, and nothing of size N × nw ever exists. What is summed
is a function of one chunk. The function does not know where the rows are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import AnyArray, Array, jax, jnp
from orthaug._base.parallel import Given, Heard, Item, Result, Threads, in_threads, nobody
from orthaug.data.sources import Partition, Source
from orthaug.models.dynamics import Numbers
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.learners import Bound
from orthaug.physics.noise import FilterRows, RowFilter

CHUNK_ROWS = 5000  # fastest of 500 … 10000 at 10⁴×81 and 10⁵×257, see benchmarks/
RowArrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Features (m, nz), Q (m, ny, nθ), P⊥Y (m, ny) and gain (m, ny, ny) of some rows."""
Kept = TypeVar("Kept")  # beside a sum
# Rows: so few take less time than to compile for their number, or for that of a fold
_FEW, _SHARED = (1024, 512)


class Chunk(NamedTuple):
    """Some rows (…, m), or in memory all of them (k, …, m).

    Zero gain and zero entries are padding.
    """

    z: Float[Array, "*k nz m"]
    """Scaled features of the learner."""
    q: Float[Array, "*k ny nt m"]
    """Orthonormal basis of the physics."""
    e: Float[Array, "*k ny m"]
    """P⊥Y, what the physics cannot express."""
    gain: Float[Array, "*k ny ny m"]
    """Matrices that turn the learner's outputs into whitened rows."""
    noise: FilterRows | None = None
    """The filter of a noise model, after the gain; then all rows are one chunk."""

    def learned(self, values: Float[Array, "ny m"]) -> Float[Array, "ny m"]:
        """Return the learner's outputs as whitened rows."""
        rows = jnp.sum(self.gain * values, axis=1)
        return rows if self.noise is None else self.noise.apply(rows)

    def derivatives(
        self, bound: Bound, w: Array
    ) -> tuple[Float[Array, "ny m"], Float[Array, "nw ny m"]]:
        """Return F and J, the learner's values and their derivatives by the weights."""
        values, jacobian = bound.jacobian(w, self.z, self.gain)
        if self.noise is None:
            return values, jacobian
        return self.noise.apply(values), self.noise.apply(jacobian)


class Overlap(NamedTuple):
    """The learner's share in the span of the physics, as an earlier pass gave it."""

    jacobian: Float[Array | np.ndarray, "nt nw"]
    """QᵀJ."""
    values: Float[Array | np.ndarray, "nt"]
    """QᵀF."""


class Room(NamedTuple):
    """The smallest of the places that add up apart from this process."""

    size: float
    """Its memory in bytes."""
    place: str
    """Name in messages: "the worker tcp://…"."""
    matrices: int
    """Gram matrices that it holds at once, where sums are made and added."""


@runtime_checkable
class Engine(Protocol):
    """Sums over rows, wherever the rows are."""

    @property
    def resident(self) -> bool:
        """True if all rows are one `Chunk` on the device.

        A whole training run can then be compiled around a sum.
        """
        ...

    def build_rows(
        self, z: Matrix, q: np.ndarray, e: Matrix, gain: Float[np.ndarray, "N ny ny"]
    ) -> Any:
        """Keep rows (N, …) in the engine's memory."""
        ...

    def draw(self, source: Source, row_builder: Callable[[Partition], Iterator[RowArrays]]) -> Any:
        """Return rows of a `data.sources.Source`, which `row_builder` makes of each partition."""
        ...

    def passes(
        self, function: Callable[[Item], Result], partitions: Sequence[Item]
    ) -> list[Result]:
        """Return `[function(p) for p in partitions]`, where the partitions are read."""
        ...

    def sum(self, function: Callable[..., Result], rows: Any, *arguments: object) -> Result:
        """Return Σ function(chunk, *arguments) over all chunks.

        `function` is hashable, its result any pytree of arrays.
        """
        ...

    @property
    def shares(self) -> int:
        """Number of simultaneous sums; the number of placed chunks should be a multiple of it."""
        ...

    def place(self, chunks: Any, like: Any = None) -> Any:
        """Place chunks of any pytree, (k, …) each, as rows.

        They go where those of `like` are, which are as many.
        """
        ...

    def read(
        self,
        function: Callable[[Item], Iterable[object]],
        partitions: Sequence[Item],
        counts: Sequence[int],
    ) -> Any:
        """Return rows from the chunks that `function(partition)` yields, `counts` of each."""
        ...

    def along(
        self, function: Callable[[Item, Result], Result], partitions: Sequence[Item], carry: Result
    ) -> Result:
        """Compute `carry = function(partition, carry)` over all partitions in their order."""
        ...

    def beside(self, *rows: Any) -> Any:
        """Return rows whose chunks are tuples of the chunks of others."""
        ...

    def keep(
        self, function: Callable[..., tuple[object, Result]], rows: Any, *arguments: object
    ) -> tuple[Any, Result]:
        """Return two results of `function(chunk, *arguments)`: kept rows, and a sum.

        The first of each pair stays where it is, the second is summed.
        """
        ...

    def fetch(self, rows: Any) -> Any:
        """Return placed or kept rows, (k, …) each, in NumPy."""
        ...

    def map(
        self,
        function: Callable[[Given, Item, Callable[..., None]], Result],
        given: Given,
        items: Sequence[Item],
        heard: Heard = nobody,
    ) -> Iterator[Result]:
        """Yield results of independent runs, `function(given, item, report)`; as `Threads.map`."""
        ...

    def room(self) -> Room | None:
        """Return the smallest memory outside this process; None where all sums are made here."""
        ...


class LocalEngine(Threads):
    """Engine that reads partitions in this process and keeps the chunks of rows in one array."""

    def passes(
        self, function: Callable[[Item], Result], partitions: Sequence[Item]
    ) -> list[Result]:
        return in_threads(function, partitions)

    def along(
        self, function: Callable[[Item, Result], Result], partitions: Sequence[Item], carry: Result
    ) -> Result:
        return reduce(lambda carry, partition: function(partition, carry), partitions, carry)

    def beside(self, *rows: Result) -> tuple[Result, ...]:
        return rows

    def fetch(self, rows: Any) -> Any:
        return jax.tree.map(np.asarray, rows)


@dataclass(frozen=True)
class InMemory(LocalEngine):
    """All rows on the device, summed by one compiled loop over chunks."""

    limit: int = CHUNK_ROWS
    resident: bool = True

    def build_rows(
        self, z: Matrix, q: np.ndarray, e: Matrix, gain: Float[np.ndarray, "N ny ny"]
    ) -> Chunk:
        return self.place(build_chunk(z, q, e, gain, chunk_shape(len(z), self.limit)))

    def draw(
        self, source: Source, row_builder: Callable[[Partition], Iterator[RowArrays]]
    ) -> Chunk:
        return self.build_rows(*read_all_rows(source, row_builder))

    def sum(self, function: Callable[..., Result], rows: Chunk, *arguments: object) -> Result:
        return _compiled_sum(function, rows, arguments)

    @property
    def shares(self) -> int:
        return 1

    def place(self, chunks: Result, like: object = None) -> Result:
        return jax.tree.map(jax.device_put, chunks)

    def read(
        self,
        function: Callable[[Item], Iterable[object]],
        partitions: Sequence[Item],
        counts: Sequence[int],
    ) -> Any:
        return self.place(all_chunks(function, partitions))

    def keep(
        self, function: Callable[..., tuple[object, Result]], rows: Any, *arguments: object
    ) -> tuple[Any, Result]:
        return _compiled_fold(function, rows, arguments)

    def room(self) -> Room | None:
        return None


@partial(jax.jit, static_argnames="function")
def _compiled_fold(
    function: Callable[..., tuple[Kept, Result]], rows: Any, arguments: tuple[object, ...]
) -> tuple[Kept, Result]:
    return row_fold(lambda chunk: function(chunk, *arguments), rows)


@partial(jax.jit, static_argnames="function")
def _compiled_sum(
    function: Callable[..., Result], rows: Chunk, arguments: tuple[object, ...]
) -> Result:
    return row_sum(lambda chunk: function(chunk, *arguments), rows)


def all_chunks(function: Callable[[Item], Iterable[Result]], partitions: Sequence[Item]) -> Result:
    """Return the chunks that a function makes of every partition, (k, …) each."""
    return join_chunks([chunk for partition in partitions for chunk in function(partition)])


def join_chunks(chunks: Sequence[Result]) -> Result:
    """Join chunks of any pytree into one, (k, …) each."""
    return jax.tree.map(lambda *parts: np.stack(parts), *chunks)


def read_all_rows(
    source: Source, row_builder: Callable[[Partition], Iterator[RowArrays]]
) -> tuple[np.ndarray, ...]:
    """Return all rows of a source: features, Q, P⊥Y and gain, (N, …) each."""
    pieces = [arrays for partition in source.partitions for arrays in row_builder(partition)]
    return tuple(np.concatenate(parts) for parts in zip(*pieces, strict=True))


def row_sum(function: Callable[[Any], Result], rows: object) -> Result:
    """Return Σ function(chunk) over the leading axis of every array in `rows`.

    Any pytree in, any pytree out.
    """
    return row_fold(lambda chunk: (None, function(chunk)), rows)[1]


def row_fold(function: Callable[[Any], tuple[Kept, Result]], rows: object) -> tuple[Kept, Result]:
    """Return the first results of function(chunk), (k, …), and the sum of the second."""
    function = jax.jit(function)  # traced once for its shape and the sum
    first = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), rows)
    zero = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(function, first)[1])

    def step(total: Result, chunk: object) -> tuple[Result, Kept]:
        kept, share = function(chunk)
        return jax.tree.map(jnp.add, total, share), kept

    total, kept = jax.lax.scan(step, zero, rows)
    return kept, total


def chunk_shape(rows: int, limit: int = CHUNK_ROWS) -> tuple[int, int]:
    """Return (number of chunks, rows in each) for `rows` rows in equal chunks of about `limit`.

    Few rows have few sizes, so that few programs are compiled.
    """
    count = max(1, -(-rows // limit))
    size = -(-rows // count)
    unit = _SHARED if rows <= _FEW <= limit else 8
    return count, -(-size // unit) * unit


def in_chunks(
    values: Float[np.ndarray, "N ..."], shape: tuple[int, int], *, repeat: bool = False
) -> Float[np.ndarray, "k ... m"]:
    """Return rows (N, …) as chunks (k, …, m), padded with zeros or `repeat`s of the last row."""
    count, size = shape
    padded = np.zeros((count, *values.shape[1:], size))
    for i in range(count):
        piece = values[i * size : (i + 1) * size]
        padded[i, ..., : len(piece)] = np.moveaxis(piece, 0, -1)
        if repeat and len(piece) < size:
            padded[i, ..., len(piece) :] = values[-1][..., None]
    return padded


def build_chunk(
    z: Matrix, q: np.ndarray, e: Matrix, gain: np.ndarray, shape: tuple[int, int]
) -> Chunk:
    """Return rows (N, …) as a chunk (k, …, m) of NumPy arrays."""
    padded = in_chunks(z, shape, repeat=True)  # zeros may be where the learner has no value
    pieces: Any = (padded, *(in_chunks(piece, shape) for piece in (q, e, gain)))
    return Chunk(*pieces)


def from_chunks(chunks: Float[np.ndarray, "k ... m"], rows: int) -> Float[np.ndarray, "N ..."]:
    """Return the rows of chunks: the inverse of `in_chunks`."""
    moved = np.moveaxis(np.asarray(chunks), -1, 1)
    return moved.reshape(moved.shape[0] * moved.shape[1], *moved.shape[2:])[:rows]


def gram(columns: Float[Array, "n rows"]) -> Float[Array, "n n"]:
    """Return A Aᵀ of named columns as the rows of A; one matrix product."""
    return columns @ columns.T


def filtered_rows(
    z: Matrix, q: np.ndarray, e: Matrix, unit: Vector, noise: RowFilter, weight: Matrix
) -> Chunk:
    """Return all rows as one chunk in memory, under a noise model.

    Args:
        unit: of the learner's outputs, (ny,).
        weight: matrix (ny, ny) of the filtered outputs.
    """
    gain = np.broadcast_to(np.diag(unit), (*e.shape, e.shape[1]))
    chunk = build_chunk(z, q, e, gain, chunk_shape(len(z), max(len(z), 1)))
    chunk = chunk._replace(noise=noise.for_engine(chunk.e.shape[-1], weight))
    return jax.tree.map(jax.device_put, chunk)


def learner_rows(
    engine: Engine,
    form: LaggedDynamics,
    numbers: Numbers,
    x: Matrix,
    q: np.ndarray,
    weight: np.ndarray,
    noise: RowFilter | None = None,
) -> Any:
    """Return regressors x (N, nx) as rows of the engine.

    Outputs are filtered by the noise model, and multiplied by `weight`, (ny, ny), or (N, ny, ny)
    without a noise model.
    """
    z = form.features_of(x)
    scaled = (z - np.asarray(numbers.centre)) / np.asarray(numbers.halfwidth)
    if noise is not None:
        e = np.zeros((len(x), len(form.outputs)))
        return filtered_rows(scaled, q, e, np.asarray(numbers.gain), noise, weight)
    gain = np.broadcast_to(weight * np.asarray(numbers.gain), (len(x), *2 * (len(form.outputs),)))
    return engine.build_rows(scaled, q, np.zeros(gain.shape[:2]), gain)


@dataclass(frozen=True)
class Overlaps:
    """QᵀJ and QᵀF of the learner: one chunk's share of `Overlap`."""

    bound: Bound

    def __call__(self, chunk: Chunk, w: Array) -> Overlap:
        values, jacobian = chunk.derivatives(self.bound, w)
        return Overlap(
            jnp.einsum("otm,wom->tw", chunk.q, jacobian), jnp.einsum("otm,om->t", chunk.q, values)
        )


@dataclass(frozen=True)
class MixedGram:
    """Gram matrix of `[Q J]` with the outputs of every row multiplied by `mix`.

    It is `ΣψᵀΣ_eψ` for `Σ_e = mixᵀ mix`.

    J is taken without its `overlaps` with Q, if any are given. Without a learner the matrix is that
    of Q.
    """

    bound: Bound

    def __call__(
        self, chunk: Chunk, w: Array, mix: Array, overlaps: tuple[Array, ...] = ()
    ) -> Array:
        columns = jnp.concatenate(_columns(self.bound, chunk, w, overlaps))
        return gram(jnp.einsum("oi,nim->nom", mix, columns).reshape(len(columns), -1))


@dataclass(frozen=True)
class _LeftOver:
    """QᵀJ, with J less its `overlaps`."""

    bound: Bound

    def __call__(self, chunk: Chunk, w: Array, overlaps: tuple[Array, ...]) -> Array:
        return jnp.einsum("tom,wom->tw", *_columns(self.bound, chunk, w, overlaps))


def _columns(
    bound: Bound, chunk: Chunk, w: Array, overlaps: tuple[Array, ...]
) -> tuple[Array, Array]:
    """Return Q (nt, ny, m) and J (nw, ny, m) of a chunk, J less its overlaps with Q."""
    q = jnp.moveaxis(chunk.q, 1, 0)
    jacobian = chunk.derivatives(bound, w)[1]
    for overlap in overlaps:
        jacobian = jacobian - jnp.einsum("tw,tom->wom", overlap, q)
    return q, jacobian


def projected_gram(engine: Engine, bound: Bound, w: AnyArray, rows: Any, mix: AnyArray) -> Matrix:
    """Return the Gram matrix of `[Q P⊥J]`, outputs multiplied by `mix`.

    J is projected twice, so that Q and it are orthogonal.
    """
    overlaps: tuple[Array, ...] = ()
    for _ in range(2):
        overlaps = (*overlaps, engine.sum(_LeftOver(bound), rows, w, overlaps))
    return np.asarray(engine.sum(MixedGram(bound), rows, w, mix, overlaps))


@partial(jax.jit, static_argnames="bound")
def row_values(
    bound: Bound, w: Float[Array, "nw"], z: Float[Array, "k nz m"]
) -> Float[Array, "k ny m"]:
    """Return f at every row, in the learner's unit."""
    return jax.lax.map(lambda chunk: bound.forward(w, chunk)[0], z)


def _values(bound: Bound, chunk: Chunk, w: Array, tilt: Array | None) -> Float[Array, "ny m"]:
    """Return F of one chunk.

    For an ensemble it is the median of the members, each with the physics that it adds.
    """

    def member_values(w: Array) -> Array:
        return chunk.learned(bound.forward(w, chunk.z)[0])

    if tilt is None:
        return member_values(w)
    return jnp.median(jax.vmap(member_values)(w) + jnp.einsum("otm,it->iom", chunk.q, tilt), axis=0)


@dataclass(frozen=True)
class LearnerSums:
    """Qᵀ(F − Q shift) and ‖F‖² of one chunk."""

    bound: Bound

    def __call__(
        self, chunk: Chunk, w: Array, tilt: Array | None, shift: Array
    ) -> tuple[Array, Array]:
        values = _values(self.bound, chunk, w, tilt)
        rest = values - jnp.einsum("otm,t->om", chunk.q, shift)
        return jnp.einsum("otm,om->t", chunk.q, rest), jnp.sum(values**2)


@dataclass(frozen=True)
class ResidualGram:
    """Σ r rᵀ of one chunk, `r = P⊥Y − F + Q physics`."""

    bound: Bound

    def __call__(self, chunk: Chunk, w: Array, tilt: Array | None, physics: Array) -> Array:
        residual = (
            chunk.e
            - _values(self.bound, chunk, w, tilt)
            + jnp.einsum("otm,t->om", chunk.q, physics)
        )
        return residual @ residual.T
