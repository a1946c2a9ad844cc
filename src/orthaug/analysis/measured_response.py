"""Frequency response from data: Welch's spectra with coherence, or periods of a periodic input.

Welch: `Ĝ = S_yu S_uu⁻¹` of Hann windows that overlap by half; the multiple coherence of an output
is the share of its spectrum that the inputs explain. Where an input repeats itself exactly, the
empirical transfer function estimate is the ratio of mean spectra over whole periods, at the lines
that the input excites (Pintelon and Schoukens 2012, ch. 2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float

from orthaug._base.checks import Vector
from orthaug.data.gaps import complete_record
from orthaug.data.record import Experiment, Record

_LONGEST, _SHORTEST, _SEGMENTS = 4096, 64, 8
_OVERLAP = 1.056  # of Hann windows by half: so many fewer of them are independent
_EXCITED = 1e-6  # of the largest power of an input
_LINES = 1e-3  # of the largest line of a periodic input
_REPEATS = 1e-9  # of the input's deviation: periods that differ by less are equal
_FEWEST_ROWS = 128


@dataclass(frozen=True, eq=False)
class MeasuredResponse:
    """Ĝ (m, ny, nu) at frequencies [Hz], NaN where an input does not act; `coherence` (m, ny).

    `std` are standard errors of ln|Ĝ| and of the phase [rad], from the coherence and `averages`,
    how many independent windows or periods there are.
    """

    frequency: Vector
    value: Complex[np.ndarray, "m ny nu"]
    coherence: Float[np.ndarray, "m ny"]
    averages: float
    method: str

    @property
    def std(self) -> Float[np.ndarray, "m ny"]:
        """`√((1 − γ²) / (2 γ² K))` (Bendat and Piersol 2010, ch. 9)."""
        with np.errstate(all="ignore"):
            return np.sqrt((1 - self.coherence) / (2 * self.coherence * self.averages))


def measured_response(record: Record) -> MeasuredResponse | None:
    """Return the response of a record with inputs and outputs; None where it is too short."""
    if not record.inputs or not record.outputs:
        return None
    complete = complete_record(record)
    if complete is None or max(map(len, complete.experiments)) < _FEWEST_ROWS:
        return None
    period = _period(complete)
    if period is not None:
        return _by_periods(complete, period)
    return _welch(complete)


def _welch(record: Record) -> MeasuredResponse:
    from scipy.signal import csd  # slow to import

    rows = sum(map(len, record.experiments))
    size = min(_LONGEST, 2 ** int(np.log2(max(rows / _SEGMENTS, _SHORTEST))))
    size = min(size, 2 ** int(np.log2(max(map(len, record.experiments)))))
    kept = [experiment for experiment in record.experiments if len(experiment) >= size]
    counts = [1 + (len(experiment) - size) // (size // 2) for experiment in kept]
    fs, nu = 1 / record.sampling_time, len(record.inputs)

    def spectra(experiment: Experiment) -> np.ndarray:
        signals = np.concatenate([experiment.inputs, experiment.outputs], axis=1).T
        return np.array(
            [[csd(one, other, fs, nperseg=size)[1] for one in signals] for other in signals]
        )

    total = sum(
        count * spectra(experiment) for count, experiment in zip(counts, kept, strict=True)
    ) / sum(counts)
    spectrum = np.moveaxis(np.asarray(total), -1, 0)[1:]  # the mean is taken out of every window
    su, sy, syu = spectrum[:, :nu, :nu], spectrum[:, nu:, nu:], spectrum[:, nu:, :nu]
    power = np.einsum("mii->mi", su).real
    acts = np.all(power > _EXCITED * power.max(axis=0), axis=1)
    acts &= np.linalg.cond(su) < 1e12
    safe = np.where(acts[:, None, None], su, np.eye(nu))
    value = np.swapaxes(np.linalg.solve(np.swapaxes(safe, 1, 2), np.swapaxes(syu, 1, 2)), 1, 2)
    explained = np.einsum("mij,mjk,mik->mi", value, su, value.conj()).real
    whole = np.einsum("mii->mi", sy).real
    with np.errstate(all="ignore"):
        coherence = np.clip(explained / whole, 0.0, 1.0)
    value, coherence = (
        np.where(acts[:, None, None], value, np.nan),
        np.where(acts[:, None], coherence, np.nan),
    )
    frequency = np.arange(1, size // 2 + 1) * fs / size
    return MeasuredResponse(frequency, value, coherence, sum(counts) / _OVERLAP, "Welch")


def _period(record: Record) -> int | None:
    """Return the period in rows of a record's only input; None without exact repetition."""
    if len(record.inputs) != 1 or len(record.experiments) != 1:
        return None
    u = record.experiments[0].inputs[:, 0] - record.experiments[0].inputs[:, 0].mean()
    n, size = len(u), u.std()
    if not size:
        return None
    spectrum = np.fft.rfft(u, 2 * n)
    products = np.fft.irfft(np.abs(spectrum) ** 2)[: n // 2 + 1]
    squares = np.concatenate([[0.0], np.cumsum(u**2)])
    lags = np.arange(len(products))
    apart = squares[n - lags] + squares[n] - squares[lags] - 2 * products  # Σ (u_k − u_{k−P})²
    candidates = np.flatnonzero(apart[8:] <= 1e-6 * size**2 * n) + 8
    for period in candidates:
        if np.abs(u[period:] - u[:-period]).max() <= _REPEATS * size:
            return int(period)
    return None


def _by_periods(record: Record, period: int) -> MeasuredResponse:
    experiment = record.experiments[0]
    count = len(experiment) // period
    skipped = 1 if count > 2 else 0  # the transient from where the record starts
    first = len(experiment) - (count - skipped) * period
    count -= skipped
    u = np.fft.rfft(experiment.inputs[first:, 0].reshape(count, period), axis=1)[:, 1:]
    y = np.fft.rfft(experiment.outputs[first:].reshape(count, period, -1), axis=1)[:, 1:]
    mean, strength = u.mean(axis=0), np.abs(u.mean(axis=0))
    lines = strength > _LINES * strength.max()
    value = y.mean(axis=0)[lines, :, None] / mean[lines, None, None]
    with np.errstate(all="ignore"):
        coherence = np.abs(y.mean(axis=0)) ** 2 / np.mean(np.abs(y) ** 2, axis=0)
    frequency = (np.flatnonzero(lines) + 1) / (period * record.sampling_time)
    return MeasuredResponse(frequency, value, coherence[lines], float(count), "periods")
