"""The row-sum: chunks of any number of rows, padding that adds nothing."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthaug.models.rows import CHUNK_ROWS, chunk_shape, from_chunks, gram, in_chunks, row_sum

AWKWARD = [1, 7, 8, 9, 63, 64, 65, 127, 128, 129, 200]


@given(st.integers(1, 10**7), st.integers(8, 10**4))
def test_chunk_shape(rows, limit):
    count, size = chunk_shape(rows, limit)
    assert size % 8 == 0 and count * size >= rows
    assert size < limit + 8
    assert count == -(-rows // limit)
    assert count * size - rows < (256 if rows <= 1024 <= limit else 9 * count)  # hardly any padding


def test_default_chunks():
    assert chunk_shape(CHUNK_ROWS) == (1, CHUNK_ROWS)
    assert chunk_shape(CHUNK_ROWS + 1)[0] == 2


@pytest.mark.parametrize("rows", AWKWARD)
@pytest.mark.parametrize("trailing", [(), (3,), (2, 3)])
def test_round_trip(rows, trailing):
    values = np.random.default_rng(rows).normal(size=(rows, *trailing))
    shape = chunk_shape(rows, 64)
    chunks = in_chunks(values, shape)
    assert chunks.shape == (shape[0], *trailing, shape[1])
    np.testing.assert_array_equal(from_chunks(chunks, rows), values)
    assert not from_chunks(chunks, shape[0] * shape[1])[rows:].any()


@pytest.mark.parametrize("rows", AWKWARD)
def test_row_sum_is_the_plain_sum(rows):
    values = np.random.default_rng(rows).normal(size=(rows, 4))
    chunks = jnp.asarray(in_chunks(values, chunk_shape(rows, 64)))
    np.testing.assert_allclose(
        jax.jit(lambda c: row_sum(gram, c))(chunks), values.T @ values, rtol=1e-13, atol=1e-13
    )


def test_row_sum_takes_and_gives_trees():
    a, b = np.random.default_rng(0).normal(size=(2, 100))
    shape = chunk_shape(100, 32)
    chunks = {"a": in_chunks(a, shape), "b": in_chunks(b, shape)}
    total = row_sum(lambda c: {"ab": c["a"] @ c["b"], "a": (c["a"].sum(),)}, chunks)
    np.testing.assert_allclose(total["ab"], a @ b)
    np.testing.assert_allclose(total["a"][0], a.sum())


def test_chunking_does_not_change_the_sum():
    values = np.random.default_rng(0).normal(size=(1000, 3))
    sums = [
        row_sum(gram, jnp.asarray(in_chunks(values, chunk_shape(1000, limit))))
        for limit in (8, 100, 999, 5000)
    ]
    for other in sums[1:]:
        np.testing.assert_allclose(other, sums[0], rtol=1e-12, atol=1e-12)
