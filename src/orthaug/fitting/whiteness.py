"""Whiteness and normality: correlations, Ljung-Box, Jarque-Bera, whitening autoregression.

Signals are those of one or several experiments: no product crosses the boundary of one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.special

from orthaug._base.checks import Vector
from orthaug.fitting.colour import burg

# A signal in one piece per experiment; a plain vector is one experiment
Pieces = Sequence[Vector] | Vector

# Rounding of the mean: a smaller deviation, against the largest value, is none
CONSTANT = 64 * np.finfo(float).eps
LARGEST = 1e150  # squares of larger values overflow: a model that left all bounds has no statistics
# Their products take half as long as the transforms at 10⁶ rows, twice as long at 10⁴
_FEW_LAGS = 100
# With fewer, Ljung-Box rejects too often (3 % instead of 1 % at 4) and AIC overfits
ROWS_PER_LAG = 20
_UNEVEN = 0.03  # level of the test whether large errors follow large ones


def autocorrelation(signal: Pieces, lags: int = 25) -> Vector | None:
    """Return r_e(τ) = Σ e_k e_{k−τ} / Σ e_k², e less its mean, for τ = 0…lags, (lags + 1,).

    The mean is that of all experiments. Lags as long as the longest experiment are cut; None for a
    constant signal.
    """
    values = cross_correlation(signal, signal, lags)
    return None if values is None else values[len(values) // 2 :]


def cross_correlation(residual: Pieces, inputs: Pieces, lags: int = 25) -> Vector | None:
    """Return r_eu(τ) = Σ e_k u_{k−τ} / √(Σ e_k² Σ u_k²), means removed, |τ| ≤ lags, (2 lags + 1,).

    At τ ≥ 0 the residual follows the input. Lags are cut as in `autocorrelation`; None where one
    signal is constant.
    """
    e, u = standardise(residual), standardise(inputs)
    if e is None or u is None:
        return None
    reach = min(lags, max(map(len, e)) - 1)
    return np.sum([_products(x, y, reach) for x, y in zip(e, u, strict=True)], axis=0)


def _products(x: Vector, y: Vector, reach: int) -> Vector:
    """Return Σ x_k y_{k−τ} for τ = −reach…reach: a product each, or all by two transforms."""
    if reach <= _FEW_LAGS or not len(x):
        own = max(min(reach, len(x) - 1), 0)
        lags = range(-own, own + 1)
        found = [
            x[max(t, 0) : len(x) + min(t, 0)] @ y[max(-t, 0) : len(y) - max(t, 0)] for t in lags
        ]
        return np.pad(found, reach - own)
    # Zeros behind the record, so that it does not meet its start
    size = 1 << (len(x) + reach).bit_length()
    products = np.fft.irfft(np.fft.rfft(x, size) * np.fft.rfft(y, size).conj(), size)
    return np.concatenate([products[size - reach :], products[: reach + 1]])


def pieces_of(signal: Pieces) -> list[Vector]:
    """Return one array per experiment."""
    parts = [signal] if isinstance(signal, np.ndarray) and signal.ndim == 1 else signal
    return [np.asarray(one, dtype=float) for one in parts]


def standardise(signal: Pieces) -> list[Vector] | None:
    """Return the signal less the mean of all samples, with a sum of squares of 1.

    None for a signal that is constant or not finite.
    """
    parts = pieces_of(signal)
    whole = np.concatenate(parts) if len(parts) else np.zeros(0)
    size = np.abs(whole).max(initial=0.0)
    if not 0 < size < LARGEST:
        return None
    whole = whole / size - np.mean(whole / size)  # so that no square underflows
    norm = np.linalg.norm(whole)
    return None if norm <= CONSTANT * np.sqrt(len(whole)) else split_like(whole / norm, parts)


def split_like(whole: np.ndarray, like: Sequence[Vector]) -> list[np.ndarray]:
    """Return a signal in experiments as long as those of another."""
    return np.split(whole, np.cumsum([len(one) for one in like])[:-1])


@dataclass(frozen=True)
class LjungBox:
    """Statistic Q, degrees of freedom, and the probability of a larger Q for a white residual."""

    statistic: float
    freedom: int
    p: float


@dataclass(frozen=True)
class Normality:
    """Jarque-Bera statistic (χ² with 2 degrees of freedom) and p-value.

    Skewness and excess kurtosis.
    """

    statistic: float
    p: float
    skewness: float
    kurtosis: float


def ljung_box(signal: Pieces, lags: int = 25, fitted: int = 0) -> LjungBox | None:
    """Return the whiteness test `Q = N (N + 2) Σ_τ r_e(τ)² / n_τ` ~ χ²(lags − fitted).

    τ = 1…lags (Ljung and Box 1978).

    n_τ is the number of pairs of samples τ apart within experiments; for one experiment N − τ. At
    most a lag for every 20 rows; None for a residual that is constant, not finite, or shorter than
    that.

    White errors of uneven size, such as those of a sensor in per cent of its reading, have larger
    correlations by chance. Where e² remembers itself by more than the colour of e gives, at 3 %,
    each r_e(τ)² is divided by `c_τ = mean e_k² e_{k−τ}² / (mean e_k²)²`, which is 1 of white errors
    of equal size (Lobato, Nankervis and Savin 2001).
    """
    lengths = np.array([len(one) for one in pieces_of(signal)])
    n = int(lengths.sum())
    acf = autocorrelation(signal, min(lags, n // ROWS_PER_LAG))
    if acf is None or len(acf) < 2:
        return None
    pairs = np.maximum(lengths[:, None] - np.arange(1, len(acf)), 0).sum(axis=0)
    return ljung_box_of(acf, pairs, n, fitted, _excess_of(signal, acf, pairs, n))


def _excess_of(signal: Pieces, own: Vector, pairs: Vector, n: int) -> Vector | None:
    """Return `excess_of_products` of a signal; None also of one that does not move."""
    e = standardise(signal)
    squares = None if e is None else [one**2 for one in e]
    acf = None if squares is None else autocorrelation(squares, len(pairs))
    if squares is None or acf is None:
        return None
    reach = len(pairs)
    products = np.sum([_products(one, one, reach)[reach + 1 :] for one in squares], axis=0)
    return excess_of_products(own, acf, products, pairs, n)


def excess_of_products(
    own: Vector, acf: Vector, products: Vector, pairs: Vector, n: int
) -> Vector | None:
    """Return c_τ, τ = 1…M, of `ljung_box`; None where large errors do not surely go together.

    The squares of normal errors have the correlations r_e(τ)² of their colour, which scatter by
    Bartlett's formula.

    Args:
        own: autocorrelation of the errors (M + 1,).
        acf: of their squares (M + 1,).
        products: Σ e_k² e_{k−τ}² (M,) of errors with Σ e_k² = 1, less their mean.
        pairs: as in `ljung_box_of`.
    """
    scatter = 1 + 2 * np.sum(own[1:] ** 4)
    if ljung_box_of((acf - own**2) / np.sqrt(scatter), pairs, n).p >= _UNEVEN:
        return None
    excess = n**2 * products / np.maximum(pairs, 1)
    return np.where(excess > 0, excess, 1.0)


def ljung_box_of(
    acf: Vector, pairs: Vector, n: int, fitted: int = 0, excess: Vector | None = None
) -> LjungBox:
    """Return the whiteness test from `acf` (M + 1,) of n samples.

    Of these n_τ = `pairs` (M,) are τ apart. `excess` is c_τ (M,) of errors of uneven size.
    """
    even = pairs if excess is None else pairs * excess
    statistic = float(n * (n + 2.0) * np.sum(acf[1:] ** 2 / even))
    freedom = max(len(pairs) - fitted, 1)
    return LjungBox(statistic, freedom, float(scipy.special.chdtrc(freedom, statistic)))


def normality(signal: Pieces) -> Normality | None:
    """Return the Jarque-Bera test, `N/6 (S² + K²/4)` ~ χ²(2), of skewness S and excess kurtosis K.

    S and K are of population moments.

    It assumes independent samples. The distribution is approached slowly: below some 2000 rows the
    p-value is rough.
    """
    e = standardise(signal)
    if e is None:
        return None
    n, whole = sum(map(len, e)), np.concatenate(e)
    skewness, kurtosis = float(n**0.5 * np.sum(whole**3)), float(n * np.sum(whole**4)) - 3
    statistic = n / 6 * (skewness**2 + kurtosis**2 / 4)
    return Normality(statistic, float(scipy.special.chdtrc(2, statistic)), skewness, kurtosis)


def whitening_filter(signal: Pieces, largest: int = 25) -> Vector | None:
    """Return the coefficients (1, a_1, …, a_p) of the whitening `A(q) e_k = ε_k`, by Burg.

    e is the signal less its mean, ε is white.

    None for a signal that is constant or not finite.
    """
    pieces = standardise(signal)
    return None if pieces is None else burg(pieces, largest)
