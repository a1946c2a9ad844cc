"""Tests of a residual: independent of the inputs, and flat over the regressors.

A coloured residual is `e = H ε` with the autoregression `H = 1/A`. The tests filter residual and
regressors by A, for `e = Z β + H ε` is `A e = (A Z) β + ε`. The F-test of β then keeps its level,
also where Z holds past outputs. What Z β adds to the colour costs some power, most with a sine.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import scipy.special
from jaxtyping import Int

from orthaug._base.checks import Matrix, Vector
from orthaug.fitting.whiteness import (
    LARGEST,
    Pieces,
    cross_correlation,
    pieces_of,
    split_like,
    standardise,
    whitening_filter,
)

# Rows of a regressor matrix that exist at a time: 26 columns of them stay in the cache
_ROWS = 4096
_BINS = 20  # at most
_ROWS_PER_BIN = 5  # fewer would make bins of chance
_RANK = 1e-10  # eigenvalues of a unit-diagonal Gram matrix below this, of the largest, are rounding


@dataclass(frozen=True, eq=False)
class CrossTest:
    """Residual against an input: `values` (2M + 1,) are r_eu(τ), τ = −M…M, each with a `band`."""

    values: Vector
    band: float
    p: float | None
    """Of the joint test of the lags 0…M; None where there are too few rows for it."""
    lag: int
    """The causal lag, 0…M, with the largest |r_eu|, and that value: `largest`."""
    largest: float


@dataclass(frozen=True, eq=False)
class RegressorTest:
    """Residual against a regressor, by bins: p-value of no relation, explained share of variance.

    Per bin: `centres` (mean of the regressor, in its unit), `means` of the residual and their
    standard `errors` (in the residual's unit), and `counts` of rows. The means are those that the
    test looks at: of a coloured residual by generalised least squares, less the mean of all rows
    where the test is centred. Where the rows do not separate them they are plain means, with
    errors that take the residual as white.
    """

    p: float | None
    share: float
    centres: Vector
    means: Vector
    errors: Vector
    counts: Int[np.ndarray, "_"]


def against_input(
    residual: Pieces,
    inputs: Pieces,
    lags: int = 25,
    *,
    level: float = 0.01,
    a: Vector | None = None,
) -> CrossTest | None:
    """Test the residual's independence of an input: band of r_eu(τ), joint test of the causal lags.

    Ljung (1999), sect. 16.6.

    Band of one value: `Var r_eu(τ) = P/N` with `P = Σ_m r_e(m) r_u(m)` over all m, which is 1 for a
    white residual whatever the input. r_e is that of 1/A: a sum over two sample functions would not
    settle as N grows.
    Joint test: `ζ = N r_euᵀ P⁻¹ r_eu` ~ χ²(M + 1) of A e and A u, for which P is the correlation
    matrix of A u, taken from the record; as ζ/(M + 1) with the variance left over it has an
    F-distribution. Directions of the lags that the input does not excite (a sine excites two) are
    left out. None where either signal is constant.

    Args:
        residual, inputs: per experiment (N_i,).
        lags: M.
        level: the band holds one value of r_eu with probability 1 − level.
        a: `whitening(residual)`, where it is known already.
    """
    values = cross_correlation(residual, inputs, lags)
    e, u = standardise(residual), standardise(inputs)
    a = whitening_filter(residual, lags) if a is None else a
    if values is None or e is None or u is None or a is None:
        return None
    band = float(
        -scipy.special.ndtri(level / 2) * np.sqrt(_spectral_product(a, u) / sum(map(len, e)))
    )
    found = _relation(_lag_blocks(e, u, a, len(values) // 2), intercept=True)
    causal = np.abs(values[len(values) // 2 :])
    return CrossTest(
        values, band, None if found is None else found.p, int(causal.argmax()), float(causal.max())
    )


def against_regressor(
    residual: Pieces,
    regressor: Pieces,
    *,
    centred: bool = False,
    a: Vector | None = None,
) -> RegressorTest | None:
    """Test whether the mean residual is zero over the regressor, by an F-test over equal bins.

    A white residual is tested by the one-way analysis of variance against zero, `F = Σ n_b m_b² / B
    : Σ (e − m_b)² / (N − B)`; for a coloured one the same hypothesis on A e with filtered
    indicators of the bins. Equal values share a bin. None for a regressor or residual that is
    constant or not finite, or fewer than 10 rows.

    Args:
        residual, regressor: per experiment (N_i,).
        centred: test against the mean of the residual instead of zero, with B − 1 degrees of
            freedom.
        a: `whitening(residual)`, where it is known already.
    """
    e, x = pieces_of(residual), np.concatenate(pieces_of(regressor))
    a = whitening_filter(e) if a is None else a
    placed = _bins(x)
    if a is None or placed is None:
        return None
    size = np.abs(np.concatenate(e)).max()
    whole = np.concatenate(e) / size
    whole = whole - centred * whole.mean()
    counts = np.bincount(placed)
    means = np.bincount(placed, whole) / counts
    total, explained = float(whole @ whole), float(counts @ means**2)
    within = np.sqrt(max(total - explained, 0.0) / (len(whole) - len(counts)))
    found = _relation(
        _bin_blocks(split_like(whole, e), split_like(placed, e), a, len(counts)), intercept=centred
    )
    errors = within / np.sqrt(counts)
    if found is not None and found.rank == len(counts) - centred:
        contrast = np.eye(len(counts)) - centred * counts / len(whole)  # to the mean of all rows
        means = contrast @ found.coefficients
        errors = np.sqrt(np.maximum(np.diag(contrast @ found.covariance @ contrast.T), 0.0))
    centres, p = np.bincount(placed, x) / counts, None if found is None else found.p
    return RegressorTest(
        p, min(explained / total, 1.0), centres, size * means, size * errors, counts
    )


def _spectral_product(a: Vector, u: list[Vector]) -> float:
    """Return Σ_m r_e(m) r_u(m) as the integral of the product of their spectra.

    r_e is that of 1/A, r_u that of the record.
    """
    if len(a) == 1:
        return 1.0
    product = 0.0
    for one in u:
        # Zeros behind the record, so that it does not meet its start
        size = 1 << max(2 * len(one), 2048).bit_length()
        gain = (
            1 / np.maximum(np.abs(np.fft.fft(a, size)), np.finfo(float).eps * np.abs(a).sum()) ** 2
        )
        product += float(np.mean(np.abs(np.fft.fft(one, size)) ** 2 * gain) / np.mean(gain))
    return product


def _lag_blocks(e: list[Vector], u: list[Vector], a: Vector, lags: int) -> Iterator[Matrix]:
    """Yield rows of `(1, A u_k, …, A u_{k−lags}, A e_k)`.

    If rows are few also the first, with lags at the input's mean.
    """
    # A start from rest would excite all directions
    known = lags if 2 * lags * len(e) < sum(map(len, e)) else 0
    for one, other in zip(e, u, strict=True):
        if len(one) >= len(a):
            target = np.convolve(one, a, "valid")
            padded = np.concatenate([np.zeros(lags), np.convolve(other, a, "valid")])
            windows = np.lib.stride_tricks.sliding_window_view(padded, lags + 1)
            for i in range(known, len(target), _ROWS):
                part = target[i : i + _ROWS]
                yield np.column_stack([np.ones(len(part)), windows[i : i + _ROWS], part])


def _bin_blocks(
    e: list[Vector], placed: list[np.ndarray], a: Vector, bins: int
) -> Iterator[Matrix]:
    """Yield rows of the indicators of all bins, filtered by A, between 1 and `A e_k`."""
    memory = len(a) - 1
    for one, bin_of in zip(e, placed, strict=True):
        for i in range(memory, len(one), _ROWS):
            rows = slice(i - memory, i + _ROWS)
            member = (bin_of[rows, None] == np.arange(bins)).astype(float)
            filtered = sum(c * member[memory - j : len(member) - j] for j, c in enumerate(a))
            target = np.convolve(one[rows], a, "valid")
            yield np.column_stack([np.ones(len(target)), np.asarray(filtered), target])


def _bins(x: Vector) -> Int[np.ndarray, "_"] | None:
    """Return the bin of each sample, from 0; equal values share the bin of their middle rank."""
    bins = min(_BINS, len(x) // _ROWS_PER_BIN)
    if bins < 2 or not np.abs(x).max() < LARGEST:  # true for NaN, too
        return None
    _, place, counts = np.unique(x, return_inverse=True, return_counts=True)
    middle = np.cumsum(counts) - counts / 2
    _, number = np.unique(np.floor(middle * bins / len(x)), return_inverse=True)
    return number[place] if number[-1] > 0 else None


@dataclass(frozen=True, eq=False)
class _Relation:
    """Least squares `target = Z β + ε`: p-value of `β = 0`, and β with its covariance.

    Both are in the directions of Z's rank.
    """

    p: float
    rank: int
    coefficients: Vector
    covariance: Matrix


def _relation(blocks: Iterable[Matrix], intercept: bool) -> _Relation | None:
    """Return β of `target = Z β + ε`, or `+ constant`, from blocks of rows (1, Z, target).

    P by F(rank, rest).

    A Gram matrix suffices: only the part of the target that Z explains is needed, and directions
    that it cannot resolve are dropped. They depend on Z alone, so the level stays.
    """
    gram = np.asarray(sum(block.T @ block for block in blocks))
    if not gram.ndim:
        return None
    rows = gram[0, 0]
    gram = gram - intercept * np.outer(gram[0], gram[0]) / rows
    inner, moment, total = gram[1:-1, 1:-1], gram[1:-1, -1], gram[-1, -1]
    unit = 1 / np.sqrt(np.where(np.diag(inner) > 0, np.diag(inner), np.inf))
    values, vectors = np.linalg.eigh(inner * np.outer(unit, unit))
    kept = values > _RANK * max(values[-1], 1.0)
    rank, freedom = int(kept.sum()), rows - kept.sum() - intercept
    if rank == 0 or freedom < 1 or total <= 0:
        return None
    # Of the inverse of the inner products
    root = unit[:, None] * vectors[:, kept] / np.sqrt(values[kept])
    explained = np.sum((root.T @ moment) ** 2)
    left = max(total - explained, np.finfo(float).eps * total) / freedom
    p = float(scipy.special.fdtrc(rank, freedom, explained / rank / left))
    return _Relation(p, rank, root @ (root.T @ moment), left * root @ root.T)
