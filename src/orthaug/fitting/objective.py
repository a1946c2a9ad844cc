"""The free-run criterion as a function of p = (θ, w): a trial, and its linearisation.

Both are pure.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import AnyArray
from orthaug.fitting.colour import independent_share, share_of, spectrum_size
from orthaug.fitting.initial_states import InitialStates, Start
from orthaug.fitting.segment_sums import SegmentSums
from orthaug.fitting.segments import Segments, packed, respond, sensitivity
from orthaug.models.dynamics import Dynamics, Numbers

RUNAWAY = 1e6  # mean square in deviations of the output: a free run beyond it has diverged
# Of the way to the best states, where all of it leads too far
_SHARES = (0.25, 0.06, 0.015, 0.004, 0.001)
_LARGEST_ERROR = 1e120


class TrialPoint(NamedTuple):
    """A trial at p: the unknown θ, c and w, its initial states, and its errors (k, T, ny, m).

    Where an engine keeps the segments, their `squares` Σ e eᵀ (ny, ny) are known instead of the
    errors.
    """

    p: Vector
    theta: Vector
    c: Vector
    w: Vector
    states: Float[np.ndarray, "k n0 m"]
    errors: Float[np.ndarray, "k T ny m"] | None
    misfit: float
    """`‖r‖²` of the errors and the states; infinite where a free run diverges."""
    loss: float
    """The same with further rows, such as a structure's."""
    squares: Matrix | None = None


class LinearisedFreeRun(NamedTuple):
    """A linearised trial: normal equations of p, and the start of the next trial."""

    hessian: Matrix
    gradient: Vector
    information: Matrix
    """SᵀS of (c, w), rows times `weight`, the states eliminated, (nθ + nw)²."""
    start: Start


@dataclass(frozen=True, eq=False, kw_only=True)
class FreeRunObjective:
    """`‖r‖²` of the free run.

    `numbers` makes a model's numbers of (c, w). `weight` (ny, ny) multiplies the errors of a step;
    `rms` is their unit, in whitened outputs; `deviation` (ny,) is that of the measured outputs.
    `physics` is nθ, and `bounds` are θ's. `colour` holds longer segments, where the others are too
    short to show how long the errors remember. `sums` makes the sums where an engine keeps the
    segments.
    """

    dynamics: Dynamics
    numbers: Callable[[Vector, Vector], Numbers]
    segments: Segments
    initial: InitialStates
    weight: Matrix
    rms: float
    deviation: Vector
    physics: int
    bounds: tuple[Vector, Vector] | None = None
    colour: Segments | None = None
    sums: SegmentSums | None = None

    @property
    def start_rows(self) -> Matrix:
        """L (n0, n0): the states that segments start from cost `‖L (x − measured)‖²`."""
        return self.dynamics.start_rows(self.weight)

    def place(self, p: Vector) -> tuple[Vector, Vector, Vector]:
        """Return (unknown θ, c, w) of p."""
        return p[: self.physics], p[: self.physics], p[self.physics :]

    def evaluate(self, p: Vector, start: Start) -> TrialPoint:
        """Return a trial at p.

        The states follow p to first order. Where that does not lower the misfit, they stay. Where
        the step hardly moves them, and what they lack leads too far, they go a part of the way.
        """
        theta, c, w = self.place(p)
        trials: list[TrialPoint] = []
        for follows in (True, False) if self.initial.free and start.follows else (False,):
            total, states, errors, squares = self._try(c, w, start, follows)
            misfit = total if total < self._largest else np.inf
            trials.append(TrialPoint(p, theta, c, w, states, errors, misfit, misfit, squares))
            if total < start.misfit:
                break
        else:
            trials += self._part_of_the_way(p, start)
        best = min(trials, key=lambda trial: trial.misfit)
        if self.sums is not None and best is trials[0] and self.initial.free and start.follows:
            return best._replace(
                states=self.sums.moved(start, np.concatenate([c, w]) - start.unknowns)
            )
        return best

    def _part_of_the_way(self, p: Vector, start: Start) -> list[TrialPoint]:
        """Return the first trial at p that lowers the misfit with states a part of the way."""
        theta, c, w = self.place(p)
        unknowns = np.concatenate([c, w])
        if self.sums is not None or not self.initial.free or not start.is_led_by_states(unknowns):
            return []
        for share in _SHARES:
            states: Any = start.at(unknowns, share)
            total, errors = self._misfit(c, w, states)
            if total < min(start.misfit, self._largest):
                return [TrialPoint(p, theta, c, w, states, errors, total, total)]
        return []

    def _misfit(self, c: Vector, w: Vector, states: Any) -> tuple[float, Any]:
        """Return `‖r‖²` from states, and the errors."""
        errors = self.errors(c, w, states, self.segments)
        with np.errstate(all="ignore"):
            total = float(np.sum(np.einsum("oi,ktim->ktom", self.weight, errors) ** 2))
            return total + self.initial.loss(states, self.start_rows), errors

    def _try(
        self, c: Vector, w: Vector, start: Start, follows: bool
    ) -> tuple[float, np.ndarray, np.ndarray | None, np.ndarray | None]:
        """Return `‖r‖²`, states, errors and their squares from the start's states.

        Or from states that follow (c, w).

        An engine's states stay where they are: given are those of the start.
        """
        unknowns = np.concatenate([c, w])
        if self.sums is not None:
            step = unknowns - start.unknowns if follows and start.unknowns is not None else None
            made = (self.weight, self.start_rows)
            total, squares = self.sums.try_step(
                self.dynamics, self.numbers(c, w), self.segments, start, step, *made
            )
            return total, start.values, None, squares
        states: Any = start.at(unknowns) if follows else start.values
        total, errors = self._misfit(c, w, states)
        return total, states, errors, None

    def linearise(self, point: TrialPoint) -> LinearisedFreeRun:
        """Return normal equations about a trial, with its states at their best."""
        information, gradient, following = self.eliminate(point, self.start_rows)
        start = Start(point.states, point.misfit, np.concatenate([point.c, point.w]), **following)
        return LinearisedFreeRun(information, gradient, information, start)

    def values_of(
        self, point: TrialPoint
    ) -> tuple[np.ndarray, np.ndarray, float, float, np.ndarray]:
        """Return the values from which `trial_of` makes the trial, bit by bit."""
        squares = np.zeros((0, 0)) if point.squares is None else point.squares
        return point.p, np.asarray(point.states), point.misfit, point.loss, squares

    def trial_of(
        self, kept: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
    ) -> TrialPoint:
        """Return the trial of values that `values_of` returned."""
        p, states, misfit, loss, squares = kept
        theta, c, w = self.place(p)
        known = self.sums is not None
        errors = None if known else self.errors(c, w, states, self.segments)
        return TrialPoint(
            p, theta, c, w, states, errors, float(misfit), float(loss), squares if known else None
        )

    def eliminate(self, point: TrialPoint, rows: Matrix) -> tuple[Matrix, Vector, dict[str, Any]]:
        """Return the normal equations of (c, w), L = `rows`, and how the states follow.

        The latter in the form of `Start`.
        """
        numbers, states = self.numbers(point.c, point.w), point.states
        if self.sums is not None:
            made = (self.dynamics, numbers, self.segments, self.initial, states, self.weight, rows)
            information, gradient, there = self.sums.linearised(*made)
            return information, gradient, {"there": there}
        slopes = sensitivity(self.dynamics, numbers, self.segments, states, self.weight)
        information, gradient, offset, slope = self.initial.eliminate(slopes, states, rows)
        return information, gradient, {"offset": offset, "slope": slope}

    def slope(self, start: Start) -> Float[np.ndarray, "k m n0 n"] | None:
        """Return the derivative of the best states by (c, w)."""
        return (
            start.slope
            if self.sums is None or start.there is None
            else self.sums.slope(start.there)
        )

    def theta_information(self, linear: LinearisedFreeRun, w: Vector) -> Matrix:
        """Return the information of (θ, w), with θ as it is split from the learner."""
        return linear.information

    def errors(
        self, c: Vector, w: Vector, states: AnyArray, segments: Segments
    ) -> Float[np.ndarray, "k T ny m"]:
        """Return the errors of every segment from its state, in the outputs' units.

        0 where they are not scored.
        """
        return errors_of(self.dynamics, self.numbers(c, w), states, segments)

    def samples(self, point: TrialPoint) -> tuple[float, float]:
        """Return the number of residuals, and the share of them that is independent.

        The physics' own parameters are subtracted from the number.
        """
        ny, errors = len(self.weight), point.errors
        segments, states = self.segments, point.states
        if self.colour is not None:
            long = self._colour_errors(point)
            if long is None:
                segments, states = self.colour, self.colour.start
            else:
                if np.abs(long).max() < _LARGEST_ERROR:
                    errors, segments = long, self.colour
        if errors is not None:
            errors = packed(errors, segments)
            moved = np.moveaxis(errors, 1, -1).swapaxes(1, 2)  # (k, m, ny, T)
            shares = [
                independent_share(moved[:, :, i].reshape(-1, moved.shape[-1])) for i in range(ny)
            ]
        else:
            shares = self._shares(point, segments, states)
        return int(np.sum(self.segments.observations)) - self.physics, float(np.mean(shares))

    def _colour_errors(self, point: TrialPoint) -> Any:
        """Return the errors of the longer segments.

        None where they are not in memory, or the run is lost there.
        """
        if not isinstance(self.colour, Segments):
            return None
        return self.errors(point.c, point.w, self.colour.start, self.colour)

    def _shares(self, point: TrialPoint, segments: Any, states: Any) -> list[float]:
        """Return the independent shares of each output's errors, from sums.

        Of the own segments where a longer run is lost.
        """
        assert self.sums is not None
        numbers = self.numbers(point.c, point.w)
        for one, start in ((segments, states), (self.segments, point.states)):
            found = self.sums.spectra(self.dynamics, numbers, one, start, spectrum_size(one.steps))
            if np.all(found[0] < _LARGEST_ERROR**2):
                return [
                    share_of(spectrum, one.steps, n) for spectrum, n in zip(*found, strict=True)
                ]
        return [1.0] * len(self.weight)

    def squares(self, point: TrialPoint) -> Matrix | None:
        """Return Σ e eᵀ (ny, ny) of a trial's errors, in the outputs' units.

        None where they are too large to square.
        """
        if point.errors is None:
            found = point.squares
            return (
                found
                if found is not None and np.abs(found).max(initial=0.0) < _LARGEST_ERROR**2
                else None
            )
        errors = np.moveaxis(point.errors, 2, -1).reshape(-1, len(self.weight))
        return errors.T @ errors if np.abs(errors).max(initial=0.0) < _LARGEST_ERROR else None

    @property
    def _largest(self) -> float:
        """A misfit beyond which a free run has diverged."""
        return RUNAWAY * self.segments.count * float(np.sum((self.weight * self.deviation) ** 2))


def errors_of(
    dynamics: Dynamics, numbers: Numbers, states: AnyArray, segments: Segments
) -> Float[np.ndarray, "k T ny m"]:
    """Return the errors of every segment from its state, in the outputs' units.

    0 where they are not scored or not measured.
    """
    run = np.asarray(respond(dynamics, numbers, segments, states))
    with np.errstate(all="ignore"):
        return np.where(segments.measured, np.asarray(segments.target) - run, 0.0)
