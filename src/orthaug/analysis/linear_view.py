"""Linear view of a model at a point of rest: matrices, poles, gain and response with intervals.

All intervals are 95 % by the delta method from Cov(c, w), the joint covariance of parameters and
learner weights that training left, with the quantile of Student's t. The point of rest moves with
them. Of positive quantities (magnitudes, frequencies) the logarithm is taken as normal.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from orthaug._base.checks import Matrix, Vector, check_choice
from orthaug._base.errors import InputError, Warning
from orthaug._base.lines import plural
from orthaug.analysis.linear_system import Continuous, System
from orthaug.analysis.measured_response import MeasuredResponse
from orthaug.analysis.operating_points import OperatingPoint
from orthaug.inference.covariance import interval, reach

if TYPE_CHECKING:
    import control

Interval = tuple[float, float] | None
COHERENT = 0.5  # coherence from which a measured response is looked at
_REAL = 1e-9  # imaginary part beside the magnitude: a real pole


@dataclass(frozen=True)
class Pole:
    """A pole z of the sampled system and `s` [1/s] in continuous time, with 95 % intervals.

    `s` is that of a motion's equations, or else ln(z)/Ts; None for a real z below 0, which is that
    of no real system under a hold. Then and for s = 0 there are neither frequency nor damping.
    `time_constant` −1/s [s] is that of real poles that decay.
    """

    z: complex
    s: complex | None
    magnitude: float
    magnitude_ci95: Interval
    natural_frequency: float | None
    """|s| [1/s]."""
    natural_frequency_ci95: Interval
    damping: float | None
    damping_ci95: Interval
    """None for real poles, whose damping is 1 or −1."""

    @property
    def hertz(self) -> float | None:
        """The natural frequency [Hz]."""
        return None if self.natural_frequency is None else self.natural_frequency / (2 * np.pi)

    @property
    def hertz_ci95(self) -> Interval:
        """Its interval [Hz]."""
        found = self.natural_frequency_ci95
        return None if found is None else (found[0] / (2 * np.pi), found[1] / (2 * np.pi))

    @property
    def time_constant(self) -> float | None:
        """−1/s [s] of a real pole that decays; None otherwise."""
        if self.s is None or abs(self.s.imag) > _REAL * abs(self.s) or self.s.real >= 0:
            return None
        return -1 / self.s.real


@dataclass(frozen=True, eq=False)
class Bode:
    """Frequency response at `frequency` [Hz], (m, ny, nu), with intervals of magnitude and phase.

    Phases are in degrees.

    Phases are unwrapped along the frequency. None where there is no covariance.
    """

    frequency: Vector
    value: Complex[np.ndarray, "m ny nu"]
    magnitude_ci95: Float[np.ndarray, "m ny nu 2"] | None
    phase_ci95: Float[np.ndarray, "m ny nu 2"] | None

    @property
    def magnitude(self) -> Float[np.ndarray, "m ny nu"]:
        """|G|."""
        return np.abs(self.value)

    @property
    def phase(self) -> Float[np.ndarray, "m ny nu"]:
        """arg G [deg]."""
        return phase_of(self.value)


def phase_of(value: Complex[np.ndarray, "m ny nu"]) -> Float[np.ndarray, "m ny nu"]:
    """Return arg G [deg], unwrapped over what is finite."""
    found = np.full(value.shape, np.nan)
    for i in np.ndindex(value.shape[1:]):
        there = np.isfinite(value[:, *i])
        found[there, *i] = np.degrees(np.unwrap(np.angle(value[there, *i])))
    return found


@dataclass(frozen=True, eq=False)
class LinearView:
    """Linear model about a point of rest: `δx⁺ = A δx + B δu`, `δy = C δx + D δu`.

    All are in physical units.

    `continuous` is the same in continuous time, or the sentence why there is none. `gain` (ny, nu)
    is ∂y/∂u at rest, None for a system that integrates. `freedom` are the degrees of freedom of the
    intervals.
    """

    point: OperatingPoint
    system: System
    continuous: Continuous | str
    poles: tuple[Pole, ...]
    at_zero: int
    """Poles at 0: dead time and what the memory of inputs adds."""
    gain: Matrix | None
    gain_ci95: Float[np.ndarray, "ny nu 2"] | None
    bode: Bode | None
    """None without inputs."""
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: dict[str, str]
    freedom: float
    warnings: tuple[Warning, ...]
    smooth: bool = False
    """True if inputs run smoothly between samples (a spline), so that `bode` is the response of the
    equations.
    """
    time_unit: str = "s"
    """Of the sampling time, and of all rates and frequencies: another where the equations are."""

    @property
    def frequency_unit(self) -> str:
        """Unit of `Pole.hertz` and of the frequencies of `bode`."""
        return "Hz" if self.time_unit == "s" else f"1/{self.time_unit}"

    @property
    def responding(self) -> System:
        """System whose response is `bode`: sampled, or under smooth inputs in continuous time."""
        return (
            self.continuous.system
            if self.smooth and isinstance(self.continuous, Continuous)
            else self.system
        )

    @property
    def a(self) -> Matrix:
        """A (n, n)."""
        return self.system.a

    @property
    def b(self) -> Matrix:
        """B (n, nu)."""
        return self.system.b

    @property
    def c(self) -> Matrix:
        """C (ny, n)."""
        return self.system.c

    @property
    def d(self) -> Matrix:
        """D (ny, nu)."""
        return self.system.d

    @property
    def sampling_time(self) -> float:
        """Ts [s]."""
        assert self.system.step is not None
        return self.system.step

    @property
    def stable(self) -> bool:
        """True if all poles lie inside the unit circle."""
        return all(pole.magnitude < 1 for pole in self.poles)

    @cached_property
    def matrix_ci95(self) -> Float[np.ndarray, "m k 2"] | None:
        """Intervals of [[A, B], [C, D]].

        Both ends of an entry that is no estimate are the entry.
        """
        std = self.system.std
        return None if std is None else interval(self.system.matrix, std, self.freedom)

    def to_control(self, time: str = "discrete") -> control.StateSpace:
        """Return the system for python-control, with the names of states, inputs and outputs.

        Args:
            time: "discrete" at the sampling time, or "continuous". Dead time is no part of a
                continuous system.

        Raises:
            InputError: python-control is not installed, another `time`, or no system in continuous
                time.
        """
        check_choice(time, ("discrete", "continuous"), "`time`")
        try:
            import control
        except ImportError:
            raise InputError(
                "python-control is not installed; pip install control, or orthaug with its "
                "extra 'control'."
            ) from None
        if time == "discrete":
            system, states = self.system, self.states
        elif isinstance(self.continuous, str):
            raise InputError(self.continuous)
        else:
            system, states = self.continuous.system, self.continuous.states
        labels = {
            "states": list(states),
            "inputs": list(self.inputs),
            "outputs": list(self.outputs),
        }
        dt = 0 if system.step is None else system.step
        return control.StateSpace(system.a, system.b, system.c, system.d, dt, **labels)

    def __repr__(self) -> str:
        n, (ny, nu) = self.system.states, self.d.shape
        sizes = {"state": n, "input": nu, "output": ny, "pole": len(self.poles)}
        return f"LinearView({self.point}: {', '.join(plural(k, w) for w, k in sizes.items())})"


def log_intervals(
    value: np.ndarray | float, relative: np.ndarray | float, freedom: float
) -> np.ndarray:
    """Return intervals (…, 2) of positive values whose logarithms are normal."""
    with np.errstate(all="ignore"):
        times = np.exp(reach(freedom) * relative)
        return np.stack([value / times, value * times], axis=-1)


def bode_of(system: System, frequency: Vector, freedom: float) -> Bode:
    """Return the response on a grid, with bands of `ln G`.

    They follow from `δ ln|G| = Re(δG/G)` and `δ arg G = Im(δG/G)`.
    """
    found = system.at(frequency)
    if found.moved is None:
        return Bode(frequency, found.value, None, None)
    with np.errstate(all="ignore"):
        relative = found.moved / found.value[:, None]
    gain, turn = (np.sqrt(np.sum(part**2, axis=1)) for part in (relative.real, relative.imag))
    phases = interval(phase_of(found.value), np.degrees(turn), freedom)
    return Bode(frequency, found.value, log_intervals(np.abs(found.value), gain, freedom), phases)


def gain_of(system: System, freedom: float) -> tuple[Matrix | None, Any]:
    """Return the static gain (ny, nu) and its intervals."""
    found = system.gain()
    if found is None:
        return None, None
    value = found.value[0]
    if found.moved is None:
        return value, None
    return value, interval(value, np.sqrt(np.sum(found.moved[0] ** 2, axis=0)), freedom)


def poles_of(system: System, own: System | None, freedom: float) -> tuple[Pole, ...]:
    """Return the poles of a sampled system.

    `own` are a motion's equations, whose poles are matched to these.
    """
    modes, step = system.modes, system.step
    assert step is not None
    with np.errstate(all="ignore"):
        found = [
            (z, None if d is None else d / z)
            for z, d in zip(modes.values, modes.moved, strict=True)
        ]
    if own is None:
        logs = [(np.log(z) / step, None if r is None else r / step) for z, r in found]
    else:
        logs = _match_poles(modes.values, own, step)
    return tuple(
        _pole(z, r, s, d, own is not None, freedom)
        for (z, r), (s, d) in zip(found, logs, strict=True)
    )


def _match_poles(z: Any, own: System, step: float) -> list[tuple[complex, Any]]:
    """Return the equations' poles in the order of the sampled ones, each with how it moves."""
    from scipy.optimize import linear_sum_assignment

    modes = own.modes
    values = np.concatenate([modes.values, np.zeros(modes.at_zero)])
    moved = [*modes.moved, *([None] * modes.at_zero)]
    apart = np.abs(np.exp(values[None] * step) - z[:, None]) + 1e-9 * np.abs(
        np.sign(values.imag) - np.sign(z.imag)[:, None]
    )
    rows, columns = linear_sum_assignment(apart)
    return [(complex(values[j]), moved[j]) for _, j in sorted(zip(rows, columns, strict=True))]


def _pole(
    z: complex, relative: Any, s: complex, moved: np.ndarray | None, exact: bool, freedom: float
) -> Pole:
    """Return a pole with `relative` = δz/z and `moved` = δs along the covariance."""
    size = lambda part: float(np.sqrt(np.sum(part**2)))  # noqa: E731
    magnitude = float(abs(z))
    radius = (
        None if relative is None else _pair(log_intervals(magnitude, size(relative.real), freedom))
    )
    alternates = z.real < 0 and abs(z.imag) <= _REAL * magnitude and not exact
    if alternates or abs(s) <= 1e-12:
        return Pole(
            complex(z), None if alternates else 0j, magnitude, radius, None, None, None, None
        )
    frequency, damping, real = abs(s), -s.real / abs(s), abs(s.imag) <= _REAL * abs(s)
    if real:
        damping = float(np.sign(damping))
    spans: tuple[Interval, Interval] = (None, None)
    if moved is not None:
        change = moved / s
        sine = abs(s.imag) / abs(s)
        turn = (
            None
            if real
            else _pair(np.clip(interval(damping, sine * size(change.imag), freedom), -1.0, 1.0))
        )
        spans = (_pair(log_intervals(frequency, size(change.real), freedom)), turn)
    return Pole(
        complex(z),
        complex(s),
        magnitude,
        radius,
        float(frequency),
        spans[0],
        float(damping),
        spans[1],
    )


def _pair(ends: Vector) -> Interval:
    return (float(ends[0]), float(ends[1])) if np.isfinite(ends).all() else None


class Agreement(NamedTuple):
    """Medians of the differences in magnitude [dB] and phase [deg], over so many `points`.

    A point is a frequency of a pair of input and output.
    """

    decibel: float
    degrees: float
    points: int


@dataclass(frozen=True, eq=False)
class Linearization:
    """Result of `linearize`: a `LinearView` for each point of rest, and the measured response.

    It has a length and is indexed and iterated over as the tuple of its `views`.
    """

    views: tuple[LinearView, ...]
    measured: MeasuredResponse | None
    held: str
    """What inputs that nobody named are held at: "zero", "mean" (of the record), "found"; "given"
    if all are named.
    """
    warnings: tuple[Warning, ...]

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, index: int) -> LinearView:
        return self.views[index]

    def __iter__(self) -> Any:
        return iter(self.views)

    def agreement(self, view: LinearView) -> Agreement | None:
        """Return the differences of a view from the measured response, at coherence ≥ 0.5.

        None without any.
        """
        if self.measured is None:
            return None
        known = self.measured.coherence[:, :, None] >= COHERENT
        value = view.responding.at(self.measured.frequency).value
        with np.errstate(all="ignore"):
            ratio = value / self.measured.value
            ratio = ratio[known & np.isfinite(ratio) & (np.abs(ratio) > 0)]
        if not len(ratio):
            return None
        decibel = 20 * np.median(np.abs(np.log10(np.abs(ratio))))
        return Agreement(
            float(decibel), float(np.degrees(np.median(np.abs(np.angle(ratio))))), len(ratio)
        )

    def to_control(self, time: str = "discrete") -> control.StateSpace:
        """Return the state space of the only view.

        Raises:
            InputError: several points of rest; as `LinearView.to_control`.
        """
        if len(self.views) != 1:
            raise InputError(
                f"there are {len(self.views)} operating points; take one, such as linearization[0]."
            )
        return self.views[0].to_control(time)

    def __repr__(self) -> str:
        return f"Linearization({', '.join(map(repr, self.views))})"
