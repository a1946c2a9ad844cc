"""The colour of a free run's errors: coloured errors say less than their number, and remember each other."""

from __future__ import annotations

import numpy as np

from orthaug._base.checks import Matrix, Vector

_NO_CORRELATION = 0.05  # below it a correlation of the errors does not count
_ROWS_PER_LAG = 20
_NOISE = 1.5  # deviations of a correlation: what is below it on average is noise


def autocorrelation(residuals: Matrix) -> Vector | None:
    """Return the correlations ρ_1, ρ_2, … of stretches (s, T); None of fewer than 3 steps, and of zeros."""
    return _correlations(_spectrum(residuals), residuals.shape[1])


def independent_share(residuals: Matrix) -> float:
    """1 / (1 + 2 Σ ρ_i), the inverse autocorrelation time, summed up to the first correlation that is noise.

    Args:
        residuals: stretches (s, T), 0 where there is no residual; lags never reach from one into the next.
    """
    longest = residuals.shape[1]
    return share_of(_spectrum(residuals), longest, int(np.count_nonzero(residuals)))


def share_of(spectrum: Vector, longest: int, count: int) -> float:
    """The same of a spectrum, `Σ |DFT|²` over stretches of `longest` steps that have `count` residuals.

    The DFT has `spectrum_size(longest)` points.
    """
    rho = _correlations(spectrum, longest)
    if rho is None:
        return 1.0
    noise = max(_NO_CORRELATION, 2 / np.sqrt(count))
    end = int(np.argmax(np.append(rho < noise, True)))
    return float(1 / (1 + 2 * np.sum(rho[:end])))


def spectrum_size(longest: int) -> int:
    """Points of a DFT in which products of lags do not wrap around."""
    return 1 << (2 * longest - 1).bit_length()


def correlation_length(residuals: Matrix) -> int | None:
    """The lag τ from which to twice it correlations are noise, so that a resonance is not cut where it is 0.

    Their root mean square there is that of correlations of coloured noise, `√((1 + 2 Σ_{j<τ} ρ_j²) / N)` (Bartlett
    1946), or hardly more; or it is too small to count. None where there is no such lag among the first N / 20, or in
    the first half of the stretches.

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
    """ρ_1, ρ_2, …; None where there are none."""
    if longest < 3:
        return None
    covariance = _autocovariances(spectrum, longest)
    return covariance[1:] / covariance[0] if covariance[0] > 0 else None


def _autocovariances(spectrum: Vector, longest: int) -> Vector:
    """`Σ e_k e_{k−τ}` over all stretches, from τ = 0 on."""
    return np.fft.irfft(spectrum, spectrum_size(longest))[:longest]


def _spectrum(residuals: Matrix) -> Vector:
    return np.sum(np.abs(np.fft.rfft(residuals, spectrum_size(residuals.shape[1]), axis=1)) ** 2, axis=0)
