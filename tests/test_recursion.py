"""Least squares row by row: equal to least squares on all rows, stable on badly scaled columns, empty starts."""

from __future__ import annotations

import numpy as np
import pytest

from orthaug.fitting.recursion import start_recursion


def rows(seed: int, count: int, ny: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Columns of sizes from 1e-6 to 1e6, two of them nearly collinear."""
    rng = np.random.default_rng(seed)
    phi = rng.normal(size=(count, ny, 3))
    phi[..., 1] = phi[..., 0] + 1e-3 * phi[..., 1]
    return phi * np.array([1e6, 1e6, 1e-6]), rng.normal(size=(count, ny))


def least_squares(phi: np.ndarray, y: np.ndarray) -> np.ndarray:
    """θ of all rows at once, by LAPACK on columns of unit length."""
    columns = phi.reshape(y.size, -1)
    size = np.linalg.norm(columns, axis=0)
    return np.linalg.lstsq(columns / size, y.ravel(), rcond=None)[0] / size


@pytest.mark.parametrize("ny", [1, 2])
def test_it_is_least_squares_on_all_rows(ny):
    old, new = rows(0, 50, ny), rows(1, 3000, ny)
    theta = least_squares(old[0], old[1])
    recursion = start_recursion(*old, theta, np.eye(ny), 1.0, 50 * ny - 3.0, 1.0, empty=False)
    for row, y in zip(*new, strict=True):
        recursion.update(row, y)
    whole = [np.concatenate(pair) for pair in zip(old, new, strict=True)]
    np.testing.assert_allclose(recursion.theta, least_squares(whole[0], whole[1]), rtol=1e-10)
    assert recursion.rows == 3050 and recursion.effective_rows == pytest.approx(3050)


def test_the_noise_level_is_the_residual_sum_of_squares():
    old, new = rows(0, 50), rows(1, 100)
    theta = least_squares(old[0], old[1])
    squares = float(np.sum((old[1] - old[0] @ theta) ** 2))
    recursion = start_recursion(*old, theta, np.eye(1), squares / 47, 47.0, 1.0, empty=False)
    for row, y in zip(*new, strict=True):
        recursion.update(row, y)
    phi, y = (np.concatenate(pair) for pair in zip(old, new, strict=True))
    assert recursion.level == pytest.approx(
        np.sum((y - phi @ recursion.theta) ** 2) / 147, rel=1e-9
    )


def test_an_empty_start_moves_no_further_than_the_rows_ask():
    old, new = rows(0, 50), rows(1, 5)
    theta = least_squares(old[0], old[1])
    recursion = start_recursion(*old, theta, np.eye(1), 1.0, 47.0, 1.0, empty=True)
    np.testing.assert_array_equal(recursion.theta, theta)
    recursion.update(new[0][0], new[1][0])
    assert not recursion.determined
    np.testing.assert_allclose(new[0][0] @ recursion.theta, new[1][0], rtol=1e-8)
    for row, y in zip(new[0][1:], new[1][1:], strict=True):
        recursion.update(row, y)
    assert recursion.determined
    np.testing.assert_allclose(recursion.theta, least_squares(new[0], new[1]), rtol=1e-8)
