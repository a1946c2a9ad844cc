"""Linear filters of whole signals; `scipy.signal` would take as long to import as many fits run."""

from __future__ import annotations

import numpy as np
from scipy.linalg import get_lapack_funcs

from orthaug._base.checks import Vector

_ROWS = 4096
"""Rows that are solved for at once: their bands stay in the cache."""


def moving_sum(b: Vector, x: np.ndarray) -> np.ndarray:
    """Return `y_k = b_0 x_k + … + b_p x_{k−p}` along the first axis of x, from rest."""
    y = b[0] * x
    for lag in range(1, min(len(b), len(x))):
        y[lag:] += b[lag] * x[:-lag]
    return y


def autoregression(a: Vector, x: np.ndarray) -> np.ndarray:
    """Return y of `a_0 y_k + … + a_p y_{k−p} = x_k` along the first axis of x, from rest.

    The equations of all samples are one triangular band, which LAPACK solves in blocks of rows.
    """
    memory = len(a) - 1
    y = np.array(x, dtype=float).reshape(len(x), -1)
    band = np.repeat(np.asarray(a, dtype=float)[:, None], min(_ROWS, len(y)), axis=1)
    (solve,) = get_lapack_funcs(("tbtrs",), (y,))
    for start in range(0, len(y), _ROWS):
        block = y[start : start + _ROWS]
        for lag in range(1, min(memory, start) + 1):  # what the samples before the block add
            reached = min(lag, len(block))
            block[:reached] -= a[lag] * y[start - lag : start - lag + reached]
        block[:] = solve(band[:, : len(block)], block, uplo="L")[0]
    return y.reshape(x.shape)
