"""Is a signal white, and normal? Ljung-Box, Jarque-Bera, and the autoregression that stands for its colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.special

from orthaug._base.checks import Vector
from orthaug.analysis.correlation import CONSTANT, Pieces, autocorrelation, pieces_of, standardised

ROWS_PER_LAG = 20  # with fewer, Ljung-Box rejects too often (3 % instead of 1 % at 4) and AIC overfits


@dataclass(frozen=True)
class LjungBox:
    """Statistic Q, degrees of freedom, and the probability of a larger Q where the residual is white."""

    statistic: float
    freedom: int
    p: float


@dataclass(frozen=True)
class Normality:
    """Jarque-Bera statistic (χ² with 2 degrees of freedom) and p-value; skewness and excess kurtosis."""

    statistic: float
    p: float
    skewness: float
    kurtosis: float


def ljung_box(signal: Pieces, lags: int = 25, fitted: int = 0) -> LjungBox | None:
    """Whiteness: `Q = N (N + 2) Σ_τ r_e(τ)² / n_τ` ~ χ²(lags − fitted), τ = 1…lags (Ljung and Box 1978).

    n_τ is the number of pairs of samples τ apart within experiments; for one experiment N − τ. At most a lag for every
    20 rows; None for a residual that is constant, not finite, or shorter than that.
    """
    lengths = np.array([len(one) for one in pieces_of(signal)])
    n = int(lengths.sum())
    acf = autocorrelation(signal, min(lags, n // ROWS_PER_LAG))
    if acf is None or len(acf) < 2:
        return None
    pairs = np.maximum(lengths[:, None] - np.arange(1, len(acf)), 0).sum(axis=0)
    return ljung_box_of(acf, pairs, n, fitted)


def ljung_box_of(acf: Vector, pairs: Vector, n: int, fitted: int = 0) -> LjungBox:
    """The same from `acf` (M + 1,) of n samples, of which n_τ = `pairs` (M,) are τ apart."""
    statistic = float(n * (n + 2.0) * np.sum(acf[1:] ** 2 / pairs))
    freedom = max(len(pairs) - fitted, 1)
    return LjungBox(statistic, freedom, float(scipy.special.chdtrc(freedom, statistic)))


def normality(signal: Pieces) -> Normality | None:
    """Jarque-Bera, `N/6 (S² + K²/4)` ~ χ²(2), of skewness S and excess kurtosis K (population moments).

    For independent samples. The distribution is approached slowly: below some 2000 rows the p-value is rough.
    """
    e = standardised(signal)
    if e is None:
        return None
    n, whole = sum(map(len, e)), np.concatenate(e)
    skewness, kurtosis = float(n**0.5 * np.sum(whole**3)), float(n * np.sum(whole**4)) - 3
    statistic = n / 6 * (skewness**2 + kurtosis**2 / 4)
    return Normality(statistic, float(scipy.special.chdtrc(2, statistic)), skewness, kurtosis)


def whitening(signal: Pieces, largest: int = 25) -> Vector | None:
    """The coefficients (1, a_1, …, a_p) of `A(q) e_k = ε_k`, ε white: Burg's recursion over all experiments, p by AIC.

    None for a signal that is constant or not finite. Burg's A is stable and, unlike that of Yule and Walker, hardly
    biased near the unit circle.
    """
    forward = backward = standardised(signal)
    if forward is None or backward is None:
        return None
    a = best = np.ones(1)
    criterion = lowest = 0.0
    for order in range(1, largest + 1):
        forward, backward = [f[1:] for f in forward], [b[:-1] for b in backward]
        rows = sum(map(len, forward))
        energy = sum(f @ f + b @ b for f, b in zip(forward, backward, strict=True))
        product = sum(f @ b for f, b in zip(forward, backward, strict=True))
        k = -2 * product / energy if energy > rows * CONSTANT**2 else 1.0
        if rows < ROWS_PER_LAG * order or 1 - k**2 < CONSTANT:  # too few rows, or nothing is left to predict
            break
        both = list(zip(forward, backward, strict=True))
        forward, backward = [f + k * b for f, b in both], [b + k * f for f, b in both]
        a = np.append(a, 0.0) + k * np.append(a, 0.0)[::-1]
        criterion += rows * np.log(1 - k**2) + 2
        if criterion < lowest:
            best, lowest = a, criterion
    return best
