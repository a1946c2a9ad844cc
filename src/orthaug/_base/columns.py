"""Columns of very different sizes: what they span, and what they express."""

from __future__ import annotations

import numpy as np

from orthaug._base.checks import Matrix


def span(columns: Matrix, rank: float = 1e-10) -> Matrix:
    """Return an orthonormal basis of what columns span, each taken as of size 1.

    Args:
        rank: singular values below this share of the largest count as 0.
    """
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 0] / size[size > 0]
    if not columns.size:
        return np.zeros((len(columns), 0))
    u, sigma, _ = np.linalg.svd(columns, full_matrices=False)
    return u[:, sigma > rank * sigma[0]]


def least_squares(columns: Matrix, target: np.ndarray) -> np.ndarray:
    """Return the coefficients of columns that express a target best, each taken as of size 1.

    Args:
        target: (N,), or several side by side (N, k), whose coefficients are then (columns, k).
    """
    size = np.linalg.norm(columns, axis=0)
    size = np.where(size > 0, size, 1.0)
    return (np.linalg.lstsq(columns / size, target, rcond=1e-10)[0].T / size).T
