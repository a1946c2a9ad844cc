"""A motion at the states that its record suggests, before any training.

States are as they are declared, from what is measured about a row. An output and its derivative are
those of a local polynomial (Savitzky and Golay 1964), what nothing is said of starts at zero.
Training and simulation go on from there: a start is an unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
from jaxtyping import Complex, Float, Int

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug.data.expressions import Lag
from orthaug.data.record import Record, without_gaps
from orthaug.physics.motion import MOST_SUBSTEPS, Motion
from orthaug.physics.parameters import time_unit

_LOOKED_AT = 200  # rows at which the equations are looked at
# [rad] in a sample, of a mode that lasts: beyond, every start is in another minimum
_TURNED = 100.0
# Real part times the sampling time: of an oscillation less than 1 % is left at the next sample
_GONE = -5.0
_FASTEST = 4096  # |eigenvalue| times the substep: the exponential of a motion has no digits beyond
_GROWS = 10.0  # by a factor of e^10 over the record, a mode grows
# Growth of an error over the record, and over a segment, as logarithms, and steps of a segment
_LEAVES, _FOLLOWED, _SHORTEST = (12.0, 3.0, 8)
_STEP = 1e-6  # relative, of differences
# Substeps of Runge-Kutta from which, and by how many times fewer of which, `exact` is chosen
_STIFF, _FEWER = (8, 4)
_ROWS, _DEGREE = 9, 2  # of a local polynomial


@dataclass(frozen=True, eq=False)
class GuessedMotion:
    """A motion with a record: its equations and modes at guessed states."""

    record: Record
    motion: Motion

    @property
    def outputs(self) -> tuple[str, ...]:
        return tuple(channel.name for channel in self.record.outputs)

    @cached_property
    def guessed_points(self) -> tuple[Float[np.ndarray, "nx m"], Float[np.ndarray, "nu m"]]:
        """Guessed states and inputs at some rows of the record."""
        states, inputs = [], []
        share = max(1, _LOOKED_AT // len(self.record.experiments))
        for experiment in self.record.experiments:
            rows = np.unique(np.linspace(0, len(experiment) - 1, share).astype(int))
            states.append(guess(self.motion, experiment.outputs, rows, self.record.sampling_time))
            inputs.append(experiment.inputs[rows])
        x, u = np.concatenate(states).T, np.concatenate(inputs).T
        with np.errstate(all="ignore"):
            return x, np.asarray(self.motion.inputs_at(x, u, self.motion.initial, np))

    def without_value(self, over: Callable[[Any], Any]) -> str:
        """Return the first equation or output that is not finite at the start, as text.

        Either at all guessed states, or at any of them.

        Args:
            over: np.all or np.any.

        Raises:
            InputError: functions that return another shape.
        """
        motion, (x, u) = self.motion, self.guessed_points
        with np.errstate(all="ignore"):
            rates = np.asarray(motion.rates(x, u, motion.initial, np), dtype=float)
            outputs = np.asarray(motion.observed(x, u, motion.initial, np), dtype=float)
        for names, values, what, first in (
            (motion.names_of_states, rates, "the equation of", 0),
            (self.outputs, outputs, "the output", len(rates)),
        ):
            if values.shape != (len(names), x.shape[1]):
                raise InputError(
                    f"the motion's functions return shape {values.shape}; expected "
                    f"({len(names)}, …)."
                )
            for i, name in enumerate(names):
                lost = ~np.isfinite(values[i])
                if over(lost):
                    k = int(np.argmax(lost))
                    at = zip(
                        (*motion.names_of_states, *motion.inputs), (*x[:, k], *u[:, k]), strict=True
                    )
                    where = ", ".join(f"{n} = {v:.4g}" for n, v in at)
                    term = motion.term_without_value(first + i, x[:, k], u[:, k])
                    reason = f": {term}" if term else ""
                    return (
                        f"{what} '{name}' is not finite at the start ({where}, initial "
                        f"parameters){reason}"
                    )
        return ""

    @cached_property
    def modes(self) -> Complex[np.ndarray, "m nx"]:
        """Eigenvalues of ∂f/∂x [1/s] at the initial parameters and the finite guessed states."""
        return self._modes_at(self.motion.initial)

    def _modes_at(self, values: Vector) -> Complex[np.ndarray, "m nx"]:
        """Return `modes` at some values of the parameters."""
        return np.linalg.eigvals(self._slopes(values, *self.guessed_points)).astype(complex)

    def _slopes(self, values: Vector, x: Any, u: Any) -> Float[np.ndarray, "m nx nx"]:
        """Return ∂f/∂x at states x (nx, k) and inputs u (nu, k), where it is finite."""
        columns = []
        with np.errstate(all="ignore"):
            for i, h in enumerate(_STEP * self._sizes):
                moved = np.zeros_like(x)
                moved[i] = h
                ends = (
                    np.asarray(self.motion.rates(x + s * moved, u, values, np)) for s in (1, -1)
                )
                columns.append((next(ends) - next(ends)) / (2 * h))
        slopes = np.moveaxis(np.stack(columns, axis=1), -1, 0)
        return slopes[np.isfinite(slopes).all(axis=(1, 2))]

    @cached_property
    def _sizes(self) -> Float[np.ndarray, "nx"]:
        """Size of each state: the largest guess, and of one that is zero everywhere its first step.

        Differences about zero need the latter: a step far below it is lost in the rounding of
        what the inputs add. One pass reaches states that inputs drive, each further one the
        states that those drive.
        """
        motion, (x, u) = self.motion, self.guessed_points
        step = 1.0 if motion.scheme.discrete else self.record.sampling_time
        size = np.abs(x).max(axis=1, initial=0.0)
        silent = size[:, None] == 0
        for _ in size:
            still = size == 0
            if not still.any():
                break
            at = np.where(silent, size[:, None], x)
            with np.errstate(all="ignore"):
                moved = step * np.abs(np.asarray(motion.rates(at, u, motion.initial, np)))
            first = np.where(np.isfinite(moved), moved, 0.0).max(axis=1, initial=0.0)
            size = np.where(still, first, size)
        return np.maximum(size, 1e-6 * (size.max(initial=0.0) or 1.0))

    @property
    def fastest(self) -> float:
        """Largest |eigenvalue| of ∂f/∂x [1/s] at the initial parameters and guessed states."""
        return float(np.abs(self.modes).max(initial=0.0))

    @property
    def integrator(self) -> str:
        """The declared integrator; where that is "auto", the one for this record.

        That is Runge-Kutta, but "exact" where its linear part makes the motion stiff for the
        sampling: the rest, which goes by explicit stages, needs far fewer substeps. A sampling
        time too long for Runge-Kutta altogether may be a wrong unit, and is refused.
        """
        motion = self.motion
        if motion.integrator != "auto":
            return motion.integrator
        if motion.substeps is not None or motion.functions is not None or not self.record.even:
            return "rk4"
        if not _STIFF <= self.substeps <= MOST_SUBSTEPS:
            return "rk4"
        x, u = self.guessed_points
        linear = self._slopes(motion.initial, np.zeros((len(x), 1)), np.zeros((len(u), 1)))
        whole, needed = self._slopes(motion.initial, x, u), motion.scheme.first_substeps
        if not len(linear) or not len(whole):
            return "rk4"
        rest = np.linalg.eigvals(whole - linear)
        few = needed(float(np.abs(rest).max(initial=0.0)) * self.record.longest_step)
        exact = replace(self, motion=replace(motion, integrator="exact"))
        reachable = not exact.exponential_fault()
        return "exact" if reachable and _FEWER * few <= self.substeps else "rk4"

    def exponential_fault(self) -> str:
        """Return why `exact` cannot be used; empty where it can.

        Modes that samples do not show, or whose exponential has no digits.
        """
        modes: Any = self.modes
        sampling_time = self.record.sampling_time
        lasting = modes[modes.real * sampling_time > _GONE]
        turned = float(np.abs(lasting.imag).max(initial=0.0)) * sampling_time
        fast = self.fastest * sampling_time / self.substeps
        if turned > _TURNED:
            return (
                "at the initial parameters a mode of the motion oscillates with "
                f"{turned / sampling_time:.3g} rad/s, {turned / (2 * np.pi):.3g} periods in a "
                f"sample of {sampling_time:g} s: the data cannot determine it. Check units and "
                "initial values, sample faster, or leave the fast mode out."
            )
        if fast > _FASTEST:
            return (
                f"the sampling time of {sampling_time:g} s is too long for the fastest mode of "
                f'the motion, {self.fastest:.3g} 1/s, also of `integrator = "exact"`: {fast:.3g} '
                f"in a substep, at most {_FASTEST}. Give `substeps` (at most {MOST_SUBSTEPS}), "
                "check units and initial values, or leave the fast mode out."
                + _other_time(self.motion)
            )
        return ""

    def _growth(self, modes: Any) -> Vector:
        """Return the growth [1/s] of the fastest growing mode, at every guessed state."""
        if self.motion.scheme.discrete and modes.size:
            with np.errstate(all="ignore"):
                modes = np.log(modes) / self.record.sampling_time
        return modes.real.max(axis=1, initial=-np.inf)

    def steps_to_leave(self, values: Vector | None = None) -> int:
        """Return the steps in which errors of a free run grow twenty-fold; 0 of a stable plant.

        A plant is unstable where a mode grows at most of the guessed states, so that no run over
        the whole record follows the data. A loop that is simulated with its controller is not, nor
        a predictor.

        Args:
            values: of the parameters; None for the initial ones.
        """
        modes = self.modes if values is None else self._modes_at(values)
        growth, step = self._growth(modes), self.record.sampling_time
        usual = float(np.median(growth)) if growth.size else 0.0
        longest = step * max(len(one) for one in self.record.experiments)
        if self.motion.held or self.motion.predicts or not usual * longest > _LEAVES:
            return 0
        return max(int(_FOLLOWED / (usual * step)), _SHORTEST)

    @property
    def grows(self) -> str:
        """A clause on the fastest growing mode at the start, with a remedy; empty without one."""
        fastest = float(self._growth(self.modes).max(initial=0.0))
        if self.motion.held or not fastest > _GROWS / len(self.record) / self.record.sampling_time:
            return ""
        return (
            f"a mode of the motion grows by {fastest:.3g} 1/s at the initial parameters. If a "
            "controller held the plant, give `controller` and the reference as input"
        )

    @property
    def substeps(self) -> int:
        """Substeps per sample with which training begins."""
        motion = self.motion
        if motion.scheme.discrete:
            return 1
        if motion.substeps is not None:
            return motion.substeps
        return motion.scheme.first_substeps(self.fastest * self.record.longest_step)


def _other_time(motion: Motion) -> str:
    """Return a sentence on parameters that are rates, but not per second; empty without such."""
    unit = time_unit(parameter.unit for parameter in motion.parameters)
    if unit == "s":
        return ""
    return (
        f" Parameters are in 1/{unit}: that needs a `sampling_time` in {unit}. A column of `time` "
        "with a unit in its header is read in seconds."
    )


def check_start(problem: GuessedMotion) -> None:
    """Raise InputError where equations have no value at the start, or a mode is too fast."""
    motion, where = problem.motion, problem.without_value(np.all)
    if where:
        raise InputError(f"{where}; correct it, or change the initial values.")
    if motion.scheme.widest_angle is not None and problem.substeps > MOST_SUBSTEPS:
        raise InputError(
            f"the sampling time of {problem.record.longest_step:g} s is too long for the "
            f"fastest mode of the motion, {problem.fastest:.3g} 1/s: it needs "
            f"{problem.substeps} substeps, but at most {MOST_SUBSTEPS} are allowed. Use "
            '`integrator = "exact"`, check units and initial values, or leave the fast mode out.'
            + _other_time(motion)
        )
    fault = problem.exponential_fault() if motion.scheme.splits_linear_part else ""
    if fault:
        raise InputError(fault)


def guess(
    motion: Motion,
    outputs: Matrix,
    rows: Sequence[int] | Int[np.ndarray, "r"],
    sampling_time: float,
) -> Float[np.ndarray, "r n0"]:
    """Return states at some rows, estimated from the outputs (N, ny) measured about them."""
    rows = np.asarray(rows, dtype=int)
    width = min(_ROWS, len(outputs))
    begin = np.clip(rows - width // 2, 0, len(outputs) - width)
    level = np.zeros((2, len(rows), outputs.shape[1]))
    if width:
        windows = begin[:, None] + np.arange(width)
        there = outputs[windows]
        if np.isnan(there).any():
            there = without_gaps(outputs)[windows]
        fitted = _polynomials(width)[rows - begin] @ there  # (r, degree + 1, ny)
        level[: fitted.shape[1]] = np.moveaxis(fitted[:, :2], 1, 0)
    names = [output.name for output in motion.outputs]
    states = np.zeros((len(rows), len(motion.states)))
    for i, state in enumerate(motion.states):
        source = state.from_output
        if source is not None:
            states[:, i] = level[source[1], :, names.index(source[0])] / sampling_time ** source[1]
        elif state.start is not None:
            states[:, i] = float(state.start)
    return states


@cache
def _polynomials(width: int) -> Float[np.ndarray, "width degree+1 width"]:
    """Return a map from the values of all rows to a local polynomial about each row."""
    offset = np.arange(width)[None, :] - np.arange(width)[:, None]
    return np.linalg.pinv(offset[..., None] ** np.arange(min(_DEGREE, width - 1) + 1))


class SignalName(Lag):
    """A state or an input as a measure names it: at the present instant, without an index."""

    def __str__(self) -> str:
        return self.channel


def layout_of(motion: Motion) -> tuple[SignalName, ...]:
    """Return the names of states, then inputs."""
    return tuple(SignalName(name, 0) for name in (*motion.names_of_states, *motion.inputs))
