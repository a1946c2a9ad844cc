"""Filters among the steps of preparation: Butterworth, and the low-pass before decimation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt

from orthaug._base.checks import Matrix
from orthaug._base.errors import InputError, shown
from orthaug._base.registry import OneOf, check_fields
from orthaug.data.record import unbroken
from orthaug.data.steps import Channels, Run

_ANTI_ALIAS, _RIPPLE, _CORNER = 8, 0.05, 0.8  # Chebyshev filter of decimation: order, dB, share of the new Nyquist

Phase = Annotated[str, OneOf(("zero", "causal"))]


def _filtered(values: Matrix, sections: Matrix, phase: str, what: str) -> Matrix:
    """Every stretch without a gap through a filter; those too short for it are missing."""
    from scipy.signal import sosfilt, sosfilt_zi, sosfiltfilt

    result, pad = np.full_like(values, np.nan), 3 * (2 * len(sections) + 1)
    for a, b in unbroken(values):
        piece, part = values[a:b], slice(a, b)
        if phase == "causal":
            start = sosfilt_zi(sections)[:, :, None] * piece[0]
            result[part] = sosfilt(sections, piece, axis=0, zi=start)[0]
        elif len(piece) > pad:
            result[part] = sosfiltfilt(sections, piece, axis=0, padtype="odd", padlen=pad)
    if not np.isfinite(result).all(axis=1).any():
        longest = max((b - a for a, b in unbroken(values)), default=0)
        raise InputError(
            f"{what}: the longest stretch without a gap has {longest} rows, a filter of zero phase needs {pad + 1}: "
            'fill gaps before, take a lower order, or phase = "causal".'
        )
    return result


@dataclass(frozen=True)
class _Butterworth:
    """A Butterworth filter. Of zero phase it goes forth and back, which squares its gain: −6 dB at the cutoff."""

    cutoff: Annotated[float, Gt(0)]
    """Hz"""
    order: Annotated[int, Ge(1)] = 4
    phase: Phase = "zero"
    channels: Channels = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.order > 10:
            raise InputError(f"`order` must be at most 10; got {shown(self.order)}.")

    def _through(self, run: Run, kind: str) -> Run:
        from scipy.signal import butter

        run.check_even(f"`{kind}`")
        nyquist = 0.5 / run.step
        if self.cutoff >= nyquist:
            raise InputError(
                f"`cutoff`: {self.cutoff:g} Hz is not below {nyquist:g} Hz, half the sampling frequency at steps of "
                f"{run.step:g} s; take a lower one."
            )
        columns = run.columns(self.channels)
        sections = np.asarray(butter(self.order, self.cutoff / nyquist, kind, output="sos"))
        return run.holding(columns, _filtered(run.values[:, columns], sections, self.phase, f"`{kind}`"))


@dataclass(frozen=True)
class Lowpass(_Butterworth):
    """A Butterworth low-pass over all channels alike; `cutoff` in Hz.

    Args:
        cutoff: Hz, below half the sampling frequency.
        order: 1 to 10.
        phase: "zero" goes forth and back: nothing is delayed, the gain is squared (−6 dB at the cutoff), and a sample
            depends on later ones, which a loop does not have. "causal" goes forth once and delays what it filters.
        channels: names; None for all. Inputs and outputs that are filtered alike keep the linear relation between
            them; filter some alone, and the filter becomes part of the model.

    Examples:
        >>> Lowpass(cutoff=10.0, phase="causal")
        Lowpass(cutoff=10.0, order=4, phase='causal', channels=None)
    """

    def apply(self, run: Run) -> Run:
        return self._through(run, "lowpass")


@dataclass(frozen=True)
class Highpass(_Butterworth):
    """A Butterworth high-pass over all channels alike; `cutoff` in Hz.

    Args:
        cutoff: Hz, below half the sampling frequency.
        order: 1 to 10.
        phase: "zero" goes forth and back: nothing is delayed, the gain is squared (−6 dB at the cutoff), and a sample
            depends on later ones, which a loop does not have. "causal" goes forth once and delays what it filters.
        channels: names; None for all. Inputs and outputs that are filtered alike keep the linear relation between
            them; filter some alone, and the filter becomes part of the model.
    """

    def apply(self, run: Run) -> Run:
        return self._through(run, "highpass")


@dataclass(frozen=True)
class Decimate:
    """Keeps each `factor`-th row behind a Chebyshev low-pass of order 8 at 0.8 of the new Nyquist frequency.

    Args:
        factor: 2 or more; the sampling time is multiplied by it.
        phase: of the low-pass, over all channels: "zero" (forth and back, no delay, looks at later samples) or
            "causal" (delays all channels alike).

    Examples:
        >>> import numpy as np
        >>> from orthaug.data import Record, prepare
        >>> prepare(Record.from_arrays(u=np.ones(400), y=np.ones(400), sampling_time=0.01), Decimate(4))
        Record(1 experiment, 100 samples, Ts = 0.04 s, inputs: u; outputs: y)
    """

    factor: Annotated[int, Ge(2)]
    phase: Phase = "zero"

    def __post_init__(self) -> None:
        check_fields(self)

    def apply(self, run: Run) -> Run:
        from scipy.signal import cheby1

        run.check_even("`decimate`")
        sections = np.asarray(cheby1(_ANTI_ALIAS, _RIPPLE, _CORNER / self.factor, output="sos"))
        values = _filtered(run.values, sections, self.phase, "`decimate`")[:: self.factor]
        kept = replace(run, values=values, instants=run.instants[:: self.factor], step=run.step * self.factor)
        return replace(kept, stride=run.stride * self.factor)
