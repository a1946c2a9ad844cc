"""Excitation signals: functions that return (N,) samples within ±amplitude, in channel units.

Which one to use is the paper's remark after `cond:special_PE`: one under which physics and
suspected terms are orthogonal. `odd=True` and `sign_symmetric` serve that; the others are the usual
ones (Pintelon and Schoukens 2012, ch. 5; Ljung 1999, ch. 13). Anything random
needs its `seed`, and the same seed gives the same samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.signal

from orthaug._base.checks import Vector, as_signal, check_count, check_number
from orthaug._base.errors import InputError

_MOST_BITS = 24  # of a shift register: 1.7e7 samples a period


def multisine(
    samples: int,
    *,
    amplitude: float,
    sampling_time: float = 1.0,
    band: tuple[float, float] | None = None,
    odd: bool = False,
    periods: int = 1,
) -> Vector:
    """Return equal cosines at all harmonics in a band, with Schroeder's phases `−π i(i−1)/n`.

    Such phases give a low crest factor.

    `u_k = A Σ_i cos(2π h_i k/P + φ_i)` over harmonics h_i of the period of P samples, scaled so
    that the largest sample is `amplitude` (Schroeder 1970). With `odd` the second half of a period
    is the first with its sign turned, so that u is orthogonal to every even function of u.

    Args:
        samples: N.
        sampling_time: s.
        band: lowest and highest frequency, Hz, both included; None for all below Nyquist's.
        odd: odd harmonics only.
        periods: of the signal in the N samples, which it must divide.

    Raises:
        InputError: numbers out of range, a band that holds no harmonic.
    """
    amplitude, sampling_time = (
        _amplitude(amplitude),
        check_number(sampling_time, "sampling_time", positive=True),
    )
    samples, periods = check_count(samples, "samples", 4), check_count(periods, "periods")
    if samples % periods or samples // periods < 4:
        raise InputError(
            f"{samples} samples do not divide into {periods} periods of 4 or more whole samples."
        )
    period = samples // periods
    if odd and period % 2:
        raise InputError(
            f"an odd multisine needs an even number of samples in a period; got {period}."
        )
    harmonics = np.arange(1, (period - 1) // 2 + 1)
    if odd:
        harmonics = harmonics[::2]
    resolution = 1.0 / (period * sampling_time)
    if band is not None:
        low, high = _band(band, sampling_time)
        slack = 1e-9  # of a harmonic: a limit that is meant to lie on one does
        harmonics = harmonics[
            (harmonics >= low / resolution - slack) & (harmonics <= high / resolution + slack)
        ]
    if not harmonics.size:
        raise InputError(
            f"`band` {band} Hz holds no {'odd ' if odd else ''}harmonic: they are "
            f"{resolution:g} Hz apart, and below half the sampling frequency; widen it or take "
            "more samples."
        )
    i = np.arange(1, len(harmonics) + 1)
    spectrum = np.zeros(period // 2 + 1, dtype=complex)
    spectrum[harmonics] = np.exp(-1j * np.pi * i * (i - 1) / len(harmonics))
    wave = np.fft.irfft(spectrum, period)
    if odd:
        wave[period // 2 :] = -wave[: period // 2]  # exactly, not to rounding
    return np.tile(wave * (amplitude / np.abs(wave).max()), periods)


def prbs(samples: int, *, amplitude: float, hold: int = 1, bits: int | None = None) -> Vector:
    """Return a maximum-length pseudo-random binary sequence ±amplitude, `hold` samples a bit.

    Args:
        samples: N.
        hold: samples a bit: the sequence is flat up to about 0.4/(hold · Ts) Hz.
        bits: of the shift register, whose period is (2^bits − 1) · hold samples; None for the
            shortest that does not repeat within N.

    Raises:
        InputError: numbers out of range, more samples than the longest register gives.
    """
    amplitude, samples, hold = (
        _amplitude(amplitude),
        check_count(samples, "samples"),
        check_count(hold, "hold"),
    )
    length = -(-samples // hold)
    if bits is None:
        bits = max(2, math.ceil(math.log2(length + 1)))
    check_count(bits, "bits", 2)
    if bits > _MOST_BITS:
        raise InputError(
            f"a register of {bits} bits is too long; at most {_MOST_BITS}. Use fewer samples "
            "or a hold."
        )
    sequence = scipy.signal.max_len_seq(bits)[0]
    return amplitude * _hold_bits(np.resize(sequence, length), hold, samples)


def swept_sine(
    samples: int,
    *,
    amplitude: float,
    band: tuple[float, float],
    sampling_time: float = 1.0,
    logarithmic: bool = False,
) -> Vector:
    """Return a sine whose frequency sweeps through `band` (Hz) once in N samples, from zero on.

    It sweeps from the first frequency to the second.

    Raises:
        InputError: numbers out of range, a frequency above half the sampling frequency.
    """
    amplitude, samples = _amplitude(amplitude), check_count(samples, "samples", 2)
    sampling_time = check_number(sampling_time, "sampling_time", positive=True)
    start, stop = _band(band, sampling_time, falling=True)
    if logarithmic and min(start, stop) == 0:
        raise InputError(f"a logarithmic sweep needs two frequencies above zero; got {band}.")
    time = np.arange(samples) * sampling_time
    method = "logarithmic" if logarithmic else "linear"
    wave = scipy.signal.chirp(time, start, samples * sampling_time, stop, method=method, phi=-90)
    wave[0] = 0.0  # cos(−90°) is 6e-17
    return amplitude * wave


def swept_square(
    samples: int,
    *,
    amplitude: float,
    band: tuple[float, float],
    sampling_time: float = 1.0,
    logarithmic: bool = False,
) -> Vector:
    """Return the sign of `swept_sine`, ±amplitude (the positive level where the sine is zero)."""
    wave = swept_sine(
        samples, amplitude=1.0, band=band, sampling_time=sampling_time, logarithmic=logarithmic
    )
    return _amplitude(amplitude) * np.where(wave >= 0, 1.0, -1.0)


def square(samples: int, *, amplitude: float, period: int) -> Vector:
    """Return +amplitude for half a period, −amplitude for the other.

    `period` is an even number of samples.

    Raises:
        InputError: numbers out of range, an odd period.
    """
    period = check_count(period, "period", 2)
    if period % 2:
        raise InputError(
            f"`period` must be an even number of samples, half for each level; got {period}."
        )
    return binary_pattern(samples, [1, 0], amplitude=amplitude, hold=period // 2)


def binary_pattern(
    samples: int, pattern: Sequence[int] | np.ndarray, *, amplitude: float, hold: int = 1
) -> Vector:
    """Return a pattern of 0 and 1 as ∓amplitude, each for `hold` samples, repeated to N samples.

    Raises:
        InputError: numbers out of range, a pattern that is empty or holds anything but 0 and 1.

    Examples:
        >>> binary_pattern(5, [1, 0, 0], amplitude=2.0)
        array([ 2., -2., -2.,  2., -2.])
    """
    amplitude, samples, hold = (
        _amplitude(amplitude),
        check_count(samples, "samples"),
        check_count(hold, "hold"),
    )
    levels = np.asarray(pattern)
    if (
        levels.ndim != 1
        or not levels.size
        or levels.dtype.kind not in "biuf"
        or not np.isin(levels, (0, 1)).all()
    ):
        raise InputError(f"`pattern` must be a sequence of 0 and 1; got {pattern!r}.")
    return amplitude * _hold_bits(np.resize(levels, -(-samples // hold)), hold, samples)


def white_gaussian(
    samples: int, *, amplitude: float, seed: int, deviation: float | None = None
) -> Vector:
    """Return independent normal samples of size `deviation`, clipped to ±amplitude.

    `deviation` is their standard deviation, amplitude/3 by default.

    Raises:
        InputError: numbers out of range.
    """
    amplitude, rng = _amplitude(amplitude), _generator(seed)
    deviation = (
        amplitude / 3 if deviation is None else check_number(deviation, "deviation", positive=True)
    )
    return np.clip(
        rng.normal(0.0, deviation, check_count(samples, "samples")), -amplitude, amplitude
    )


def white_uniform(samples: int, *, amplitude: float, seed: int) -> Vector:
    """Return independent samples, uniform on [−amplitude, amplitude].

    Raises:
        InputError: numbers out of range.
    """
    return _amplitude(amplitude) * _generator(seed).uniform(
        -1.0, 1.0, check_count(samples, "samples")
    )


def white_binary(samples: int, *, amplitude: float, seed: int, hold: int = 1) -> Vector:
    """Return independent ±amplitude with equal chances, each held for `hold` samples.

    Raises:
        InputError: numbers out of range.
    """
    amplitude, samples, hold = (
        _amplitude(amplitude),
        check_count(samples, "samples"),
        check_count(hold, "hold"),
    )
    return amplitude * _hold_bits(
        _generator(seed).integers(0, 2, -(-samples // hold)), hold, samples
    )


def sign_symmetric(u: Vector) -> Vector:
    """Return u followed by −u, (2N,): the paper's symmetric data (Sect. 5.1 and 5.2).

    On a static model with odd physics it makes every even unmodelled term orthogonal exactly
    (`cond:special_PE`); with lags it does so up to the rows that reach across the seam, and up to
    the memory of the outputs.

    Raises:
        InputError: a signal that is empty or not finite.
    """
    u = _signal(u)
    return np.concatenate([u, -u])


def limit_rate(u: Vector, largest_step: float, start: float | None = None) -> Vector:
    """Return u with steps limited to `largest_step` a sample, (N,), as by a slow actuator.

    `v_k = v_{k−1} + clip(u_k − v_{k−1}, ±largest_step)`; it stays within the range of u and
    `start`.

    Args:
        u: the wanted signal (N,).
        largest_step: in the unit of u, per sample (rate limit times the sampling time).
        start: the value before the first sample; None for `u[0]`. Symmetries of u survive only up
            to the run-in, so limit the rate of a signal before `sign_symmetric`, not after, where
            the seam may jump.

    Raises:
        InputError: a signal that is not finite, a step that is not positive.
    """
    u, step = _signal(u), check_number(largest_step, "largest_step", positive=True)
    if start is not None and not (
        isinstance(start, int | float | np.number) and math.isfinite(start)
    ):
        raise InputError(f"`start` must be a finite number; got {start!r}.")
    value = float(u[0] if start is None else start)
    limited = np.empty(len(u))
    for k, wanted in enumerate(u.tolist()):
        value = (
            wanted if abs(wanted - value) <= step else value + math.copysign(step, wanted - value)
        )
        limited[k] = value
    return limited


def _hold_bits(bits: Any, hold: int, samples: int) -> Vector:
    """Return the samples of held bits, 0 as -1 and 1 as 1."""
    return np.repeat(2.0 * bits - 1.0, hold)[:samples]


def _amplitude(amplitude: Any) -> float:
    return check_number(amplitude, "amplitude", positive=True)


def _generator(seed: Any) -> np.random.Generator:
    return np.random.default_rng(check_count(seed, "seed", 0))


def _signal(u: Any) -> Vector:
    column = as_signal(u, "u")
    if column.shape[1] != 1 or not len(column):
        raise InputError(
            f"`u` must be one channel of at least one sample, (N,); got shape {np.shape(u)}."
        )
    return column[:, 0]


def _band(band: Any, sampling_time: float, *, falling: bool = False) -> tuple[float, float]:
    """Return two frequencies, Hz, of 0 to Nyquist's.

    The second larger, or at least another one where `falling` is allowed.
    """
    highest = 0.5 / sampling_time
    numbers = (
        isinstance(band, Sequence | np.ndarray) and not isinstance(band, str) and len(band) == 2
    )
    if not numbers or not all(
        isinstance(f, int | float | np.number) and math.isfinite(f) for f in band
    ):
        raise InputError(f"`band` must be two frequencies in Hz; got {band!r}.")
    low, high = float(band[0]), float(band[1])
    if min(low, high) < 0 or max(low, high) > highest * (1 + 1e-12):
        raise InputError(
            f"`band` must lie between 0 and {highest:g} Hz, half the sampling frequency; got "
            f"{band!r}."
        )
    if low == high if falling else low > high:
        raise InputError(
            f"`band` must run from the lower to the higher of two frequencies; got {band!r}."
        )
    return low, high
