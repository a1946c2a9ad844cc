"""The free-run criterion as a function of p = (θ, w): a trial, and its linearisation. Both are pure.

Without bounds or penalties the unknown θ is `c = θ − θ_aux`, split at the end (F2). Where an orthogonal θ has bounds,
it is the unknown itself and `c = θ − θ_aux(w)` follows, so that the split cannot leave them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug.fitting.colour import independent_share
from orthaug.fitting.elimination import Elimination
from orthaug.fitting.initial_states import InitialStates, Start
from orthaug.fitting.one_step import OneStepTask
from orthaug.fitting.segments import Segments, respond, sensitivity
from orthaug.models.dynamics import Dynamics, Numbers

RUNAWAY = 1e6  # mean square in deviations of the output: a free run beyond it has diverged
_LARGEST_ERROR = 1e120


class Flown(NamedTuple):
    """A trial at p: the unknown θ, c and w, the states that its segments started from, and the errors (k, T, ny, m)."""

    p: Vector
    theta: Vector
    c: Vector
    w: Vector
    states: Float[np.ndarray, "k n0 m"]
    errors: Float[np.ndarray, "k T ny m"]
    misfit: float
    """`‖r‖²` of the errors and the states; infinite where a free run diverges."""
    loss: float
    """The same with the structure's rows."""


class LinearisedFreeRun(NamedTuple):
    """A trial linearised: normal equations of p, and what the next trial starts from."""

    hessian: Matrix
    gradient: Vector
    information: Matrix
    """SᵀS of (c, w), rows times `weight`, the states eliminated, (nθ + nw)²."""
    start: Start


@dataclass(frozen=True, eq=False)
class FreeRunObjective:
    """`‖r‖²` of the free run and of the structure's rows.

    `numbers` makes a model's numbers of (c, w). `weight` (ny, ny) multiplies the errors of a step; `rms` is their unit,
    in whitened outputs. `colour` holds longer segments, where the others are too short to show how long the errors
    remember.
    """

    dynamics: Dynamics
    task: OneStepTask
    numbers: Callable[[Vector, Vector], Numbers]
    segments: Segments
    initial: InitialStates
    elimination: Elimination
    weight: Matrix
    rms: float
    colour: Segments | None = None

    @property
    def physics(self) -> int:
        """nθ."""
        return len(self.task.problem.baseline.names)

    @property
    def follows(self) -> bool:
        """Whether c follows θ, `c = θ − θ_aux(w)`."""
        return self.elimination.projects and self.elimination.bounded and self.task.bound is not None

    @property
    def bounds(self) -> tuple[Vector, Vector] | None:
        """Of θ; None where the unknown is c."""
        if self.elimination.projects and not self.follows and self.task.bound is not None:
            return None
        return self.elimination.lower, self.elimination.upper

    def begin(self, w: Vector) -> Vector:
        """p of the one-step θ for the weights w."""
        f = self.task.share_of(w)
        theta = self.elimination.theta(f, self.elimination.active(f))
        return np.concatenate([theta if self.follows else theta - self._taken(f), w])

    def place(self, p: Vector) -> tuple[Vector, Vector, Vector]:
        """(unknown θ, c, w) of p; without bounds on an orthogonal θ the unknown is c itself."""
        theta, w = p[: self.physics], p[self.physics :]
        c = theta - self._taken(self.task.share_of(w)) if self.follows else theta
        return theta, c, w

    def fly(self, p: Vector, start: Start) -> Flown:
        """A trial at p. The states follow p to first order. Where that does not lower the misfit, they stay."""
        theta, c, w = self.place(p)
        following = start.at(np.concatenate([c, w])) if self.initial.free else None
        trials = []
        for states in (start.values,) if following is None else (following, start.values):
            errors = self.errors(c, w, states, self.segments)
            with np.errstate(all="ignore"):
                total = float(np.sum(np.einsum("oi,ktim->ktom", self.weight, errors) ** 2))
                total += self.initial.loss(states, self.dynamics.start_rows(self.weight))
            trials.append((total if total < self._largest else np.inf, states, errors))
            if total < start.misfit:
                break
        misfit, states, errors = min(trials, key=lambda trial: trial[0])
        loss = misfit
        rows = self.elimination.rows
        if len(rows.target):
            miss = rows.target - rows.theta @ theta - rows.learner @ self.task.share_of(w)
            loss += float(miss @ miss) / self.rms**2
        return Flown(p, theta, c, w, states, errors, misfit, loss)

    def linearise(self, flown: Flown) -> LinearisedFreeRun:
        """Normal equations about a trial, with its states at their best."""
        numbers, states = self.numbers(flown.c, flown.w), flown.states
        slopes = sensitivity(self.dynamics, numbers, self.segments, states, self.weight)
        start_rows = self.dynamics.start_rows(self.weight)
        information, gradient, offset, slope = self.initial.eliminate(slopes, flown.states, start_rows)
        start = Start(flown.states, flown.misfit, np.concatenate([flown.c, flown.w]), offset, slope)
        hessian = information
        rows, rms = self.elimination.rows, self.rms
        if self.follows:
            change = self.change(flown.w)
            hessian, gradient = change.T @ hessian @ change, change.T @ gradient
        if len(rows.target):
            by_rows = np.column_stack([rows.theta, rows.learner @ self.task.share_slope(flown.w)]) / rms
            miss = (rows.target - rows.theta @ flown.theta - rows.learner @ self.task.share_of(flown.w)) / rms
            hessian, gradient = hessian + by_rows.T @ by_rows, gradient + by_rows.T @ miss
        return LinearisedFreeRun(hessian, gradient, information, start)

    def errors(self, c: Vector, w: Vector, states: Any, segments: Segments) -> Float[np.ndarray, "k T ny m"]:
        """Errors of every segment from its state, in the outputs' units; 0 where they are not scored."""
        return errors_of(self.dynamics, self.numbers(c, w), states, segments)

    def samples(self, flown: Flown) -> tuple[float, float]:
        """Number of residuals less the physics' own parameters, and the share of them that is independent."""
        errors = flown.errors
        if self.colour is not None:
            long = self.errors(flown.c, flown.w, self.colour.start, self.colour)
            errors = long if np.abs(long).max() < _LARGEST_ERROR else errors
        moved = np.moveaxis(errors, 1, -1).swapaxes(1, 2)  # (k, m, ny, T)
        ny = len(self.weight)
        shares = [independent_share(moved[:, :, i].reshape(-1, moved.shape[-1])) for i in range(ny)]
        return self.segments.count * ny - self.physics, float(np.mean(shares))

    def squares(self, flown: Flown) -> Matrix | None:
        """Σ e eᵀ (ny, ny) of a trial's errors, in the outputs' units; None where they are too large to square."""
        errors = np.moveaxis(flown.errors, 2, -1).reshape(-1, len(self.weight))
        return errors.T @ errors if np.abs(errors).max(initial=0.0) < _LARGEST_ERROR else None

    def change(self, w: Vector) -> Matrix:
        """∂(c, w)/∂(θ, w) for `c = θ − θ_aux(w)`."""
        slope = self._taken(self.task.share_slope(w))
        nt, nw = slope.shape
        return np.block([[np.eye(nt), -slope], [np.zeros((nw, nt)), np.eye(nw)]])

    def _taken(self, share: Any) -> Any:
        """θ_aux of the learner's share QᵀF, or of its slope."""
        return self.task.problem.projection.from_coordinates(self.elimination.taken @ share)

    @property
    def _largest(self) -> float:
        """A misfit beyond which a free run has diverged."""
        return RUNAWAY * self.segments.count * float(np.sum((self.weight * self.task.problem.deviation) ** 2))


def errors_of(dynamics: Dynamics, numbers: Numbers, states: Any, segments: Segments) -> Float[np.ndarray, "k T ny m"]:
    """Errors of every segment from its state, in the outputs' units; 0 where they are not scored."""
    run = np.asarray(respond(dynamics, numbers, segments, states))
    with np.errstate(all="ignore"):
        return np.where(np.asarray(segments.scored)[:, :, None], np.asarray(segments.target) - run, 0.0)
