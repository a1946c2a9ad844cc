"""The one row-sum that every solver and engine shares (F4): it knows blocks, not their meaning.

Rows are laid out in chunks with the row index last, padded with zero weights to one shape, so that one
compiled program serves any number of rows and nothing of size N × nw ever exists.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from orthaug._jax import jax, jnp

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
