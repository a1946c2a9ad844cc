"""The share of a free run's errors that is independent: coloured errors say less than their number."""

from __future__ import annotations

import numpy as np

from orthaug._base.checks import Matrix

_NO_CORRELATION = 0.05  # below it a correlation of the errors does not count


def independent_share(residuals: Matrix) -> float:
    """1 / (1 + 2 Σ ρ_i), the inverse autocorrelation time, summed up to the first correlation that is noise.

    Args:
        residuals: stretches (s, T), 0 where there is no residual; lags never reach from one into the next.
    """
    longest = residuals.shape[1]
    if longest < 3:
        return 1.0
    size = 1 << (2 * longest - 1).bit_length()
    spectrum = np.sum(np.abs(np.fft.rfft(residuals, size, axis=1)) ** 2, axis=0)
    covariance = np.fft.irfft(spectrum, size)[:longest]
    if not covariance[0] > 0:
        return 1.0
    rho = covariance[1:] / covariance[0]
    noise = max(_NO_CORRELATION, 2 / np.sqrt(np.count_nonzero(residuals)))
    end = int(np.argmax(np.append(rho < noise, True)))
    return float(1 / (1 + 2 * np.sum(rho[:end])))
