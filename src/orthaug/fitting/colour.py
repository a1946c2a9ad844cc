"""The colour of a free run's errors, and their number of independent errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthaug._base.checks import Matrix, Vector

_NO_CORRELATION = 0.05  # below it a correlation of the errors does not count
_ROWS_PER_LAG = 20
_NOISE = 1.5  # deviations of a correlation: what is below it on average is noise
_MOST_ORDERS = 30  # of an autoregression
_ROUNDING = 64 * np.finfo(float).eps
_POINTS = 1 << 16  # at least, of the spectrum that autocovariances are made of


@dataclass(frozen=True)
class Autoregression:
    """Errors that follow `e_k = Σ a_i e_{k−i} + w_k`, w white of some variance."""

    coefficients: Vector
    variance: float

    def autocovariance(self, lags: int) -> Vector:
        """Return γ_0 … γ_{lags−1}, from the spectrum `variance / |A|²`."""
        points = max(1 << int(4 * lags).bit_length(), _POINTS)
        polynomial = np.fft.rfft(np.concatenate([[1.0], -self.coefficients]), points)
        return np.fft.irfft(self.variance / np.abs(polynomial) ** 2, points)[:lags]

    def independent(self, lengths: Sequence[int] | Vector) -> float:
        """Return the number of independent errors that give a mean square as precisely.

        For a normal process that is `N / Σ ρ_j²` over all lags j of both signs (Bartlett 1946).
        """
        rho = self.autocovariance(int(max(lengths)))
        rho = rho / rho[0]
        pairs = np.maximum(np.asarray(lengths)[:, None] - np.arange(len(rho)), 0).sum(axis=0)
        rows = float(sum(lengths))
        return rows**2 / float(rows + 2 * np.sum(pairs[1:] * rho[1:] ** 2))


def autoregression(pieces: Sequence[Vector]) -> Autoregression:
    """Return the autoregression of stretches of errors.

    Their mean is not subtracted: it counts as colour.
    """
    rows = sum(map(len, pieces))
    size = float(np.sqrt(sum(float(piece @ piece) for piece in pieces) / max(rows, 1))) or 1.0
    a = burg([piece / size for piece in pieces], _MOST_ORDERS)
    left = np.concatenate(
        [np.convolve(piece, a, mode="valid") for piece in pieces if len(piece) >= len(a)]
    )
    return Autoregression(-a[1:], float(np.mean(left**2)))


def burg(pieces: Sequence[Vector], largest: int) -> Vector:
    """Return (1, a_1, …, a_p) of `A(q) e_k = ε_k`, ε white, by Burg's recursion.

    It runs over all stretches; AIC chooses p.

    Burg's A is stable and, unlike that of Yule and Walker, hardly biased near the unit circle.

    Args:
        pieces: stretches of a signal of RMS 1.
        largest: order.
    """
    forward = backward = list(pieces)
    a = best = np.ones(1)
    criterion = lowest = 0.0
    for order in range(1, largest + 1):
        forward, backward = [f[1:] for f in forward], [b[:-1] for b in backward]
        rows = sum(map(len, forward))
        energy = sum(f @ f + b @ b for f, b in zip(forward, backward, strict=True))
        product = sum(f @ b for f, b in zip(forward, backward, strict=True))
        k = -2 * product / energy if energy > rows * _ROUNDING**2 else 1.0
        if (
            rows < _ROWS_PER_LAG * order or 1 - k**2 < _ROUNDING
        ):  # too few rows, or nothing is left to predict
            break
        both = list(zip(forward, backward, strict=True))
        forward, backward = [f + k * b for f, b in both], [b + k * f for f, b in both]
        a = np.append(a, 0.0) + k * np.append(a, 0.0)[::-1]
        criterion += rows * np.log(1 - k**2) + 2
        if criterion < lowest:
            best, lowest = a, criterion
    return best


def autocorrelation(residuals: Matrix) -> Vector | None:
    """Return the correlations ρ_1, ρ_2, … of stretches (s, T).

    None of fewer than 3 steps, and of zeros.
    """
    return _correlations(_spectrum(residuals), residuals.shape[1])


def independent_share(residuals: Matrix) -> float:
    """Return 1 / (1 + 2 Σ ρ_i), the inverse autocorrelation time.

    The sum ends at the first correlation that is noise.

    Args:
        residuals: stretches (s, T), 0 where there is no residual; lags never reach from one into
            the next.
    """
    longest = residuals.shape[1]
    return share_of(_spectrum(residuals), longest, int(np.count_nonzero(residuals)))


def share_of(spectrum: Vector, longest: int, count: int) -> float:
    """Return the independent share of errors with a spectrum `Σ |DFT|²`.

    The spectrum is that of stretches of `longest` steps with `count` residuals.

    The DFT has `spectrum_size(longest)` points.
    """
    rho = _correlations(spectrum, longest)
    if rho is None:
        return 1.0
    noise = max(_NO_CORRELATION, 2 / np.sqrt(count))
    end = int(np.argmax(np.append(rho < noise, True)))
    return float(1 / (1 + 2 * np.sum(rho[:end])))


def spectrum_size(longest: int) -> int:
    """Return the points of a DFT in which products of lags do not wrap around."""
    return 1 << (2 * longest - 1).bit_length()


def correlation_length(residuals: Matrix) -> int | None:
    """Return the lag τ from which to 2τ all correlations are noise.

    A resonance is thus not cut where its correlation crosses 0.

    Their root mean square there is that of correlations of coloured noise, `√((1 + 2 Σ_{j<τ} ρ_j²)
    / N)` (Bartlett 1946), or hardly more; or it is too small to count. None where there is no such
    lag among the first N / 20, or in the first half of the stretches.

    Args:
        residuals: as above.
    """
    there, rows = residuals != 0, np.count_nonzero(residuals)
    centred = np.where(there, residuals - residuals.sum() / max(rows, 1), 0.0)
    rho = _correlations(_spectrum(centred), centred.shape[1])
    if rho is None:
        return None
    pairs = np.maximum(np.rint(_autocovariances(_spectrum(there), there.shape[1])[1:]), 1.0)
    rho = rho * rows / pairs
    before = np.concatenate([[0.0], np.cumsum(rho**2)])
    for lag in range(1, min(int(there.sum(axis=1).max()) // 2, rows // _ROWS_PER_LAG) + 1):
        noise = _NOISE**2 * (1 + 2 * before[lag - 1]) / pairs[lag - 1]
        if np.mean(rho[lag - 1 : 2 * lag - 1] ** 2) < max(noise, _NO_CORRELATION**2):
            return lag
    return None


def _correlations(spectrum: Vector, longest: int) -> Vector | None:
    """Return ρ_1, ρ_2, …; None where there are none."""
    if longest < 3:
        return None
    covariance = _autocovariances(spectrum, longest)
    return covariance[1:] / covariance[0] if covariance[0] > 0 else None


def _autocovariances(spectrum: Vector, longest: int) -> Vector:
    """Return `Σ e_k e_{k−τ}` over all stretches, from τ = 0 on."""
    return np.fft.irfft(spectrum, spectrum_size(longest))[:longest]


def _spectrum(residuals: Matrix) -> Vector:
    return np.sum(
        np.abs(np.fft.rfft(residuals, spectrum_size(residuals.shape[1]), axis=1)) ** 2, axis=0
    )
