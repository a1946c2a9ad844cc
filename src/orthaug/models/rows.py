"""The one row-sum that every solver and engine shares (F4): it knows blocks, not their meaning.

Rows are laid out in chunks with the row index last, padded with zero weights to one shape, so that one
compiled program serves any number of rows and nothing of size N × nw ever exists.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix
from orthaug._base.jax import Array, jax, jnp
from orthaug.models.learners import Bound
from orthaug.models.predictor import Form, Numbers

CHUNK_ROWS = 5000  # fastest of 500 … 10000 at 10⁴×81 and 10⁵×257, see benchmarks/


def chunk_shape(rows: int, limit: int = CHUNK_ROWS) -> tuple[int, int]:
    """(number of chunks, rows in each) for `rows` rows in equal chunks of about `limit`."""
    count = max(1, -(-rows // limit))
    size = -(-rows // count)
    return count, -(-size // 8) * 8


def in_chunks(
    values: Float[np.ndarray, "N ..."], shape: tuple[int, int], *, repeat: bool = False
) -> Float[np.ndarray, "k ... m"]:
    """Rows (N, …) as chunks (k, …, m) with zeros behind the last row, or `repeat`s of it."""
    count, size = shape
    padded = np.zeros((count, *values.shape[1:], size))
    for i in range(count):
        piece = values[i * size : (i + 1) * size]
        padded[i, ..., : len(piece)] = np.moveaxis(piece, 0, -1)
        if repeat and len(piece) < size:
            padded[i, ..., len(piece) :] = values[-1][..., None]
    return padded


def from_chunks(chunks: Float[np.ndarray, "k ... m"], rows: int) -> Float[np.ndarray, "N ..."]:
    """The inverse of `in_chunks`."""
    moved = np.moveaxis(np.asarray(chunks), -1, 1)
    return moved.reshape(-1, *moved.shape[2:])[:rows]


def row_sum(function: Callable[[Any], Any], chunks: Any) -> Any:
    """Σ function(chunk) over the leading axis of every array in `chunks`; any pytree in, any pytree out."""
    first = jax.tree.map(lambda a: a[0], chunks)
    zero = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(function, first))
    total, _ = jax.lax.scan(lambda acc, chunk: (jax.tree.map(jnp.add, acc, function(chunk)), None), zero, chunks)
    return total


def gram(columns: Float[Array, "n rows"]) -> Float[Array, "n n"]:
    """A Aᵀ of named columns laid out as rows of A; one matrix product."""
    return columns @ columns.T


class Chunks(NamedTuple):
    """Rows of the prediction criterion in chunks of m rows; zero gain and zero entries are padding."""

    z: Float[Array, "k nz m"]
    """Scaled learner features."""
    q: Float[Array, "k ny nt m"]
    """Orthonormal basis of the physics."""
    e: Float[Array, "k ny m"]
    """P⊥Y, what the physics cannot express."""
    gain: Float[Array, "k ny m"]
    """Unit of the learner's output in whitened rows."""


class Overlap(NamedTuple):
    """What an earlier pass found of the learner in the span of the physics."""

    jacobian: Float[Array, "nt nw"]
    """QᵀJ."""
    values: Float[Array, "nt"]
    """QᵀF."""


def learner_chunks(form: Form, numbers: Numbers, x: Matrix, q: Any, weight: Any) -> Chunks:
    """Rows of regressors x (N, nx) as chunks, rows multiplied by `weight`; the learner in whitened outputs."""
    shape = chunk_shape(len(x))
    z = np.asarray(form.features.evaluate(x, form.layout, np))
    scaled = (z - np.asarray(numbers.centre)) / np.asarray(numbers.halfwidth) if form.bound else np.zeros((len(x), 0))
    gain = np.broadcast_to(weight * np.asarray(numbers.gain), (len(x), len(form.outputs)))
    pieces = (in_chunks(scaled, shape, repeat=True), *(in_chunks(p, shape) for p in (q, 0 * gain, gain)))
    return Chunks(*map(jnp.asarray, pieces))


@partial(jax.jit, static_argnames="bound")
def share_of(bound: Bound, w: Float[Array, "nw"], chunks: Chunks) -> Overlap:
    """QᵀJ and QᵀF of the learner in one pass."""

    def one_chunk(chunk: Chunks) -> Overlap:
        values, jacobian = bound.jacobian(w, chunk.z, chunk.gain)
        return Overlap(jnp.einsum("otm,wom->tw", chunk.q, jacobian), jnp.einsum("otm,om->t", chunk.q, values))

    return row_sum(one_chunk, chunks)


@partial(jax.jit, static_argnames="bound")
def mixed_gram(bound: Bound, w: Float[Array, "nw"], chunks: Chunks, mix: Float[Array, "ny ny"]) -> Float[Array, "n n"]:
    """Gram matrix of `[Q J]` with the outputs of every row multiplied by `mix`: `ΣψᵀΣ_eψ` for `Σ_e = mixᵀ mix`."""

    def one_chunk(chunk: Chunks) -> Float[Array, "n n"]:
        jacobian = bound.jacobian(w, chunk.z, chunk.gain)[1]
        columns = jnp.concatenate([jnp.moveaxis(chunk.q, 1, 0), jacobian])
        return gram(jnp.einsum("oi,nim->nom", mix, columns).reshape(len(columns), -1))

    return row_sum(one_chunk, chunks)


@partial(jax.jit, static_argnames="bound")
def projected_gram(
    bound: Bound, w: Float[Array, "nw"], chunks: Chunks, mix: Float[Array, "ny ny"]
) -> Float[Array, "n n"]:
    """Gram matrix of `[Q P⊥J]`, outputs multiplied by `mix`; J is projected twice, so that Q and it are orthogonal."""

    def projected(chunk: Chunks, overlaps: tuple[Any, ...]) -> tuple[Any, Any]:
        q = jnp.moveaxis(chunk.q, 1, 0)  # (nt, ny, m)
        jacobian = bound.jacobian(w, chunk.z, chunk.gain)[1]
        for overlap in overlaps:
            jacobian = jacobian - jnp.einsum("tw,tom->wom", overlap, q)
        return q, jacobian

    def columns(chunk: Chunks) -> Float[Array, "n n"]:
        mixed = jnp.einsum("oi,nim->nom", mix, jnp.concatenate(projected(chunk, overlaps)))
        return gram(mixed.reshape(len(mixed), -1))

    overlaps: tuple[Any, ...] = ()
    for _ in range(2):
        before = overlaps
        overlaps = (*before, row_sum(lambda chunk, o=before: jnp.einsum("tom,wom->tw", *projected(chunk, o)), chunks))
    return row_sum(columns, chunks)
