"""Amplitude dependence of a linear view: the nearest linear system over movements of some size.

The best linear approximation of a nonlinear system depends on the amplitude (Pintelon and Schoukens
2012, ch. 3). Movements here are those of the view's own modes, normally distributed, as large as
the training outputs were.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from orthaug._base.checks import Matrix, Vector, positive
from orthaug._base.errors import Warning
from orthaug.analysis.linear_steps import remainder_at, state_sizes
from orthaug.analysis.linear_system import System, modes_of
from orthaug.analysis.linear_view import Pole
from orthaug.analysis.operating_points import OperatingPoint, Search

_POINTS = 2000  # of the movements
_MUCH = 0.25  # change of a frequency or a damping that is reported
_DAMPED = 0.005  # change of a damping ratio that is too small to be reported


class _Mode(NamedTuple):
    """A pole in continuous time by its frequency |s| and its damping ratio."""

    frequency: float
    damping: float

    def describe(self, time_unit: str) -> str:
        """Return the pole in words, its frequency in the unit of time."""
        if abs(self.damping) >= 1 - 1e-9:
            return f"a real pole at {-np.sign(self.damping) * self.frequency:.3g} 1/{time_unit}"
        unit = "Hz" if time_unit == "s" else f"1/{time_unit}"
        return f"damping {self.damping:.2g} at {self.frequency / (2 * np.pi):.3g} {unit}"


def amplitude_warnings(
    search: Search,
    point: OperatingPoint,
    sampled: System,
    own: System | None,
    poles: tuple[Pole, ...],
    deviation: Vector,
    moving: Vector,
    time_unit: str,
) -> list[Warning]:
    """Return a warning where the poles at the amplitude of the training data are others.

    Args:
        search: the step and its numbers.
        point: of rest.
        sampled: the system about it.
        own: the equations' system about it, None where there is none.
        poles: of the view.
        deviation: standard deviations of the training outputs (ny,).
        moving: those of the inputs (nu,), 0 where they are unknown.
        time_unit: of the sampling time.
    """
    step, system = search.step, sampled if own is None else own
    if not step.form.differentiable or not len(sampled.modes.values):
        return []
    sizes = state_sizes(step, search.size)
    if step.memory is None:
        seen, usual = system.c, deviation
    else:  # the state is the outputs themselves
        seen, usual = np.eye(len(sizes)), state_sizes(step, deviation)
    moves = _movements(system, sizes, seen, usual)
    rng = np.random.default_rng(1)
    shifts = rng.normal(size=(_POINTS, len(moving))) * moving
    rest = np.asarray(
        remainder_at(step, own is not None, search.numbers, point.rest, point.inputs, moves, shifts)
    )
    finite = np.isfinite(rest).all(axis=1)
    if finite.sum() < _POINTS // 2:
        return []
    columns = np.column_stack([moves / sizes, shifts, np.ones(_POINTS)])[finite]
    found = np.linalg.lstsq(columns, rest[finite], rcond=1e-9)[0]
    n = system.states
    a = system.a + found[:n, :n].T / sizes
    here, there = (_modes(matrix, system.step) for matrix in (system.a, a))
    if len(here) != len(there):
        return []
    changed = [
        (change, one, other)
        for one, other in zip(here, there, strict=True)
        if (change := _change(one, other, poles)) > _MUCH
    ]
    if not changed:
        return []
    _, *both = max(changed)
    one, other = (mode.describe(time_unit) for mode in both)
    text = (
        "the linear system depends on the amplitude: at the root-mean-square amplitude of the "
        f"training outputs it has {other}, at the operating point {one}. The system given holds "
        "for small movements only. For larger ones, simulate the model; for the slope at the "
        "point itself, give a fit data of small movements."
    )
    return [Warning("amplitude_dependent", text)]


def _movements(system: System, sizes: Vector, seen: Matrix, usual: Vector) -> Matrix:
    """Return movements (m, n) of the system's modes.

    What is `seen` of them (k, n) has the `usual` deviations (k,) at most.
    """
    values, vectors = np.linalg.eig(system.a / sizes[:, None] * sizes)
    if system.step is not None:  # the memory of a shift register moves nothing
        vectors = vectors[:, np.abs(values) > 1e-9 * np.abs(values).max(initial=0.0)]
    vectors = vectors / positive(np.abs(vectors).max(axis=0))
    rng = np.random.default_rng(0)
    phases = rng.normal(size=(2, _POINTS, vectors.shape[1]))
    moves = (phases[0] @ vectors.real.T - phases[1] @ vectors.imag.T) * sizes
    ratios = [
        *(np.sqrt(np.mean((moves @ seen.T) ** 2, axis=0)) / positive(usual)),
        *(np.sqrt(np.mean(moves**2, axis=0)) / sizes),
    ]
    return moves / max(max(ratios), 1e-300)


def _modes(a: Matrix, step: float | None) -> list[_Mode]:
    """Return the modes by increasing frequency, both of a conjugate pair."""
    values = modes_of(a, None).values
    if step is not None:
        values = np.log(values) / step
    return sorted(_mode_of(s) for s in values if abs(s) > 1e-12)


def _mode_of(s: complex) -> _Mode:
    return _Mode(float(abs(s)), float(-s.real / abs(s)))


def _change(one: _Mode, other: _Mode, poles: tuple[Pole, ...]) -> float:
    """Return the relative change of a mode, 0 within the intervals of the view's pole."""
    apart = abs(other.frequency - one.frequency) / max(one.frequency, other.frequency)
    turned = abs(other.damping - one.damping)
    if turned > _DAMPED:
        apart = max(apart, turned / max(abs(one.damping), abs(other.damping)))
    own = min(
        (pole for pole in poles if pole.s),
        key=lambda pole: (
            abs(_mode_of(pole.s or 0).frequency - one.frequency)
            + abs(_mode_of(pole.s or 0).damping - one.damping) * one.frequency
        ),
        default=None,
    )
    spans = (None, None) if own is None else (own.natural_frequency_ci95, own.damping_ci95)
    if all(
        span is not None and span[0] <= value <= span[1]
        for span, value in zip(spans, other, strict=True)
    ):
        return 0.0
    return apart
