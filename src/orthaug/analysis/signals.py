"""Excitation signals: functions that return (N,) samples within ±1.

Which one to use is the paper's remark after `cond:special_PE`: one under which physics and
suspected terms are orthogonal. `odd=True` and `sign_symmetric` serve that; the others are the usual
ones (Pintelon and Schoukens 2012, ch. 5; Ljung 1999, ch. 13). Anything random
needs its `seed`, and the same seed gives the same samples.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import scipy.signal

from orthaug._base.checks import Vector, as_signal
from orthaug._base.errors import InputError


def multisine(samples: int, band: tuple[float, float], *, odd: bool = False) -> Vector:
    """Return equal cosines at all harmonics in a band, with Schroeder's phases `−π i(i−1)/n`.

    Such phases give a low crest factor.

    `u_k = A Σ_i cos(2π h_i k/N + φ_i)` over harmonics h_i of the period of N samples, scaled so
    that the largest sample is 1 (Schroeder 1970). With `odd` the second half of a period
    is the first with its sign turned, so that u is orthogonal to every even function of u.

    Args:
        samples: N, even where `odd`.
        band: lowest and highest frequency, in cycles a sample, both included; it holds a harmonic.
        odd: odd harmonics only.
    """
    harmonics = np.arange(1, (samples - 1) // 2 + 1)
    if odd:
        harmonics = harmonics[::2]
    resolution, (low, high) = 1.0 / samples, band
    slack = 1e-9  # of a harmonic: a limit that is meant to lie on one does
    harmonics = harmonics[
        (harmonics >= low / resolution - slack) & (harmonics <= high / resolution + slack)
    ]
    i = np.arange(1, len(harmonics) + 1)
    spectrum = np.zeros(samples // 2 + 1, dtype=complex)
    spectrum[harmonics] = np.exp(-1j * np.pi * i * (i - 1) / len(harmonics))
    wave = np.fft.irfft(spectrum, samples)
    if odd:
        wave[samples // 2 :] = -wave[: samples // 2]  # exactly, not to rounding
    return wave * (1 / np.abs(wave).max())


def prbs(samples: int, hold: int = 1) -> Vector:
    """Return a maximum-length pseudo-random binary sequence, `hold` samples a bit.

    It is flat up to about 0.4/(hold · Ts) Hz. Its register is the shortest whose period, (2^bits −
    1) · hold samples, does not repeat within N.
    """
    length = -(-samples // hold)
    sequence = scipy.signal.max_len_seq(max(2, math.ceil(math.log2(length + 1))))[0]
    return _hold_bits(np.resize(sequence, length), hold, samples)


def swept_square(samples: int, band: tuple[float, float]) -> Vector:
    """Return the sign of a sine whose frequency sweeps through `band` once in N samples.

    It sweeps logarithmically, in cycles a sample, from the first frequency to the second. The
    positive level is where the sine is zero, as at its begin.
    """
    time, method = np.arange(samples) * 1.0, "logarithmic"
    wave = scipy.signal.chirp(time, band[0], float(samples), band[1], method=method, phi=-90)
    wave[0] = 0.0  # cos(−90°) is 6e-17
    return np.where(wave >= 0, 1.0, -1.0)


def square(samples: int, period: int) -> Vector:
    """Return 1 for half a period, −1 for the other; `period` is an even number of samples."""
    hold = period // 2
    return _hold_bits(np.resize([1, 0], -(-samples // hold)), hold, samples)


def white_gaussian(samples: int, seed: int) -> Vector:
    """Return independent normal samples with a standard deviation of 1/3, clipped to ±1."""
    return np.clip(np.random.default_rng(seed).normal(0.0, 1 / 3, samples), -1.0, 1.0)


def white_uniform(samples: int, seed: int) -> Vector:
    """Return independent samples, uniform on [−1, 1]."""
    return np.random.default_rng(seed).uniform(-1.0, 1.0, samples)


def white_binary(samples: int, seed: int, hold: int = 1) -> Vector:
    """Return independent ±1 with equal chances, each held for `hold` samples."""
    bits = np.random.default_rng(seed).integers(0, 2, -(-samples // hold))
    return _hold_bits(bits, hold, samples)


def sign_symmetric(u: Vector) -> Vector:
    """Return u followed by −u, (2N,): the paper's symmetric data (Sect. 5.1 and 5.2).

    On a static model with odd physics it makes every even unmodelled term orthogonal exactly
    (`cond:special_PE`); with lags it does so up to the rows that reach across the seam, and up to
    the memory of the outputs.

    Raises:
        InputError: a signal that is empty or not finite.
    """
    column = as_signal(u, "u")
    if column.shape[1] != 1 or not len(column):
        raise InputError(
            f"`u` must be one channel of at least one sample, (N,); got shape {np.shape(u)}."
        )
    return np.concatenate([column[:, 0], -column[:, 0]])


def limit_rate(u: Vector, largest_step: float, start: float) -> Vector:
    """Return u with steps limited to `largest_step` a sample, (N,), as by a slow actuator.

    `v_k = v_{k−1} + clip(u_k − v_{k−1}, ±largest_step)`; it stays within the range of u and
    `start`.

    Args:
        u: the wanted signal (N,).
        largest_step: in the unit of u, per sample (rate limit times the sampling time).
        start: the value before the first sample. Symmetries of u survive only up to the run-in, so
            limit the rate of a signal before `sign_symmetric`, not after, where the seam may jump.
    """
    value, limited = float(start), np.empty(len(u))
    for k, wanted in enumerate(u.tolist()):
        value = (
            wanted
            if abs(wanted - value) <= largest_step
            else value + math.copysign(largest_step, wanted - value)
        )
        limited[k] = value
    return limited


def _hold_bits(bits: Any, hold: int, samples: int) -> Vector:
    """Return the samples of held bits, 0 as -1 and 1 as 1."""
    return np.repeat(2.0 * bits - 1.0, hold)[:samples]
