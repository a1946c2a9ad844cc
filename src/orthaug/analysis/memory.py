"""Terms with memory: first-order lag, backlash, LuGre friction, Bouc-Wen hysteresis of a signal.

Each has one internal state, computed by filtering the signal; its time constant or width is
profiled over a small grid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.filters import autoregression

KINDS = ("lag", "backlash", "lugre", "bouc_wen")
WORDS = {
    "lag": "first-order lag",
    "backlash": "backlash (play)",
    "lugre": "friction-like hysteresis (LuGre)",
    "bouc_wen": "Bouc-Wen hysteresis",
}
TIME_CONSTANTS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)  # samples
WIDTHS = (0.1, 0.3, 0.6, 1.0, 1.5)  # deviations of the signal
_LONGEST = 0.1  # of the rows: a slower lag is a trend that no record shows


@dataclass(frozen=True)
class MemoryTerm:
    """A term with memory of the signal `on`.

    `scale` is the time constant [s] of a lag, else the width in the unit of the signal.
    """

    kind: str
    on: str
    scale: float

    @property
    def name(self) -> str:
        """The term as results name it."""
        symbol, unit = ("time constant", " s") if self.kind == "lag" else ("width", "")
        return f"{WORDS[self.kind]} of {self.on}, {symbol} {self.scale:.3g}{unit}"

    def along(self, values: Vector, sampling_time: float) -> Vector:
        """Compute the internal state of a term along a signal (N,), from rest at its first value.

        A lag is exact for a held input. The others are driven by the increments d of the signal:
        play `z = min(max(z, x − w), x + w)`, LuGre `z⁺ = z + d − |d| z/w`, and Bouc-Wen
        `z⁺ = z + d − (|d| |z| z + d z²)/(2w²)`.
        """
        if self.kind == "lag":
            pole = float(np.exp(-sampling_time / self.scale))
            driven = np.append(values[0], (1 - pole) * values[:-1])
            return autoregression(np.array([1.0, -pole]), driven)
        width, state = self.scale, 0.0
        if self.kind == "backlash":
            state, found = float(values[0]), []
            for x in values.tolist():
                state = min(max(state, x - width), x + width)
                found.append(state)
            return np.array(found)
        found, steps = [0.0], np.diff(values).tolist()
        for d in steps:
            if self.kind == "lugre":
                state += d - abs(d) * state / width
            else:
                state += d - (abs(d) * abs(state) * state + d * state * state) / (2 * width * width)
            state = min(max(state, -width), width)
            found.append(state)
        return np.array(found)


def derivative_of(kind: str, on: str, rate: str | None, state: str, scale: str) -> str | None:
    """Return the derivative of a term's internal state as an expression; None where it has none.

    A lag follows its signal, `(x - z)/T`; hysteresis follows the rate of its signal, by the limits
    of `MemoryTerm.along` for short samples. Backlash jumps.

    Args:
        rate: the derivative of the signal `on`; None where that is not known.
        state: the name of the state z.
        scale: the name of the time constant or width.
    """
    if kind == "lag":
        return f"({on} - {state})/{scale}"
    if rate is None:
        return None
    d = rate if rate.isidentifier() else f"({rate})"
    return {
        "lugre": f"{d} - abs({d})*{state}/{scale}",
        "bouc_wen": f"{d} - (abs({d})*abs({state})*{state} + {d}*{state}**2)/(2*{scale}**2)",
    }.get(kind)


def next_of(kind: str, on: str, following: str | None, state: str, scale: str) -> str | None:
    """Return a term's internal state after a sample as an expression; None where it has none.

    A lag follows a signal that is held, by the share `1 - exp(-Ts/T)` of what is left; hysteresis
    follows the change of its signal, as in `derivative_of`.

    Args:
        following: the signal `on` after the sample; None where that is not known.
        state, scale: as in `derivative_of`.
    """
    if kind == "lag":
        return f"{state} + (1 - exp(-Ts/{scale}))*({on} - {state})"
    change = None if following is None else f"({following}) - {on}"
    moves = derivative_of(kind, on, change, state, scale)
    return None if moves is None else f"{state} + {moves}"


def memory_terms(on: str, values: Vector, sampling_time: float) -> list[MemoryTerm]:
    """Return the terms of every kind on a signal, with their grids of time constants and widths."""
    size = float(np.std(values))
    lags = [step for step in TIME_CONSTANTS if step <= _LONGEST * len(values)]
    terms = [MemoryTerm("lag", on, step * sampling_time) for step in lags]
    return terms + [MemoryTerm(kind, on, share * size) for kind in KINDS[1:] for share in WIDTHS]
