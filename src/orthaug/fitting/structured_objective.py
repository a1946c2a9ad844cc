"""The free-run criterion of a structure: rows of its penalty beside the errors, and how c follows θ.

Without bounds or penalties the unknown θ is `c = θ − θ_aux`, split at the end (F2). Where an orthogonal θ has bounds,
it is the unknown itself and `c = θ − θ_aux(w)` follows, so that the split cannot leave them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug.fitting.elimination import Elimination
from orthaug.fitting.initial_states import Start
from orthaug.fitting.objective import Flown, FreeRunObjective, LinearisedFreeRun
from orthaug.fitting.one_step import OneStepTask


@dataclass(frozen=True, eq=False, kw_only=True)
class StructuredObjective(FreeRunObjective):
    """`‖r‖²` of the free run and of the structure's rows."""

    task: OneStepTask
    elimination: Elimination

    @property
    def follows(self) -> bool:
        """Whether c follows θ, `c = θ − θ_aux(w)`."""
        return self.elimination.projects and self.elimination.bounded and self.task.bound is not None

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
        """A trial at p, with the structure's rows."""
        flown = super().fly(p, start)
        rows = self.elimination.rows
        if not len(rows.target):
            return flown
        miss = rows.target - rows.theta @ flown.theta - rows.learner @ self.task.share_of(flown.w)
        return flown._replace(loss=flown.loss + float(miss @ miss) / self.rms**2)

    def linearise(self, flown: Flown) -> LinearisedFreeRun:
        """Normal equations about a trial, of the unknown θ and with the structure's rows."""
        linear = super().linearise(flown)
        hessian, gradient = linear.hessian, linear.gradient
        rows, rms = self.elimination.rows, self.rms
        if self.follows:
            change = self.change(flown.w)
            hessian, gradient = change.T @ hessian @ change, change.T @ gradient
        if len(rows.target):
            by_rows = np.column_stack([rows.theta, rows.learner @ self.task.share_slope(flown.w)]) / rms
            miss = (rows.target - rows.theta @ flown.theta - rows.learner @ self.task.share_of(flown.w)) / rms
            hessian, gradient = hessian + by_rows.T @ by_rows, gradient + by_rows.T @ miss
        return linear._replace(hessian=hessian, gradient=gradient)

    def theta_information(self, linear: LinearisedFreeRun, w: Vector) -> Matrix:
        """The information of (θ, w): of an orthogonal θ that the learner's share was taken from."""
        if not (self.elimination.projects and self.task.bound is not None):
            return linear.information
        change = self.change(w)
        return change.T @ linear.information @ change

    def change(self, w: Vector) -> Matrix:
        """∂(c, w)/∂(θ, w) for `c = θ − θ_aux(w)`."""
        slope = self._taken(self.task.share_slope(w))
        nt, nw = slope.shape
        return np.block([[np.eye(nt), -slope], [np.zeros((nw, nt)), np.eye(nw)]])

    def _taken(self, share: Any) -> Any:
        """θ_aux of the learner's share QᵀF, or of its slope."""
        return self.task.problem.projection.from_coordinates(self.elimination.taken @ share)
