"""A lagged model's problem in segments, and the criterion over them with its structure."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.elimination import Elimination, Fixed, eliminate
from orthaug.fitting.initial_states import InitialStates, Start
from orthaug.fitting.objective import FreeRunObjective, LinearisedFreeRun, TrialPoint
from orthaug.fitting.one_step import OneStepTask
from orthaug.fitting.segment_sums import SegmentSums
from orthaug.fitting.segmented_problem import Layout, SegmentedProblem
from orthaug.fitting.segments import build_segments
from orthaug.fitting.solvers.minimize import Descent
from orthaug.fitting.structures import Structure
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.learners import Bound
from orthaug.physics.problem import Problem

# steps: a run over more of them than are needed takes less time than to compile for their number
_SMALL = 4096


def lagged_dynamics(task: OneStepTask) -> LaggedDynamics:
    """Return the dynamics of a problem and its learner."""
    problem = task.problem
    return LaggedDynamics(
        problem.baseline, problem.features, problem.layout, problem.outputs, task.bound
    )


def declared_settings(task: OneStepTask, criterion: Criterion) -> dict[str, Any]:
    """Return the settings of a segmented problem that come from task and criterion.

    They are the same wherever the segments are.
    """
    problem = task.problem
    return {
        "record": problem.record,
        "criterion": criterion,
        "free_run": criterion.free_run,
        "rms": task.rms,
        "deviation": problem.deviation,
        "output_weights": problem.weight.choice,
        "scaling": task.scaling,
        "unit": task.unit,
        "task": task,
    }


@dataclass(frozen=True, eq=False, kw_only=True)
class SegmentedLagged(SegmentedProblem):
    """A problem in segments, beside its rows for one step."""

    dynamics: LaggedDynamics
    task: OneStepTask
    fixed: Fixed = field(default_factory=dict)
    """Entries of an orthogonal θ that are known to be at a bound beside the learner."""

    @classmethod
    def of(
        cls, task: OneStepTask, criterion: Criterion, like: SegmentedLagged | None = None
    ) -> SegmentedLagged:
        """Lay out the problem's record in segments as a criterion declares.

        In the shapes of a layout for fewer rows, if one is given.

        Raises:
            InputError: nothing would be scored.
        """
        dynamics, record, sums = (
            lagged_dynamics(task),
            task.problem.record,
            SegmentSums.of(task.engine),
        )
        small = like is not None and like.segments.scored.size <= _SMALL
        layout = Layout.of(record, dynamics, criterion, like if small else None, task.engine.shares)
        return cls(
            **layout._asdict(), **declared_settings(task, criterion), dynamics=dynamics, sums=sums
        )

    @property
    def problem(self) -> Problem:
        return self.task.problem

    @property
    def bound(self) -> Bound:
        return self.task.bound

    @cached_property
    def physics_only(self) -> SegmentedLagged:
        """The problem without a learner."""
        alone, task = self.dynamics.physics_only, self.task.physics_only
        return replace(
            self, task=task, dynamics=alone, scaling=task.scaling, unit=task.unit, fixed={}
        )

    @property
    def lengthens(self) -> bool:
        """True where whole experiments can be segments to train on."""
        return True

    def over(self, segment: int) -> SegmentedLagged:
        """Return the problem in segments of another length; 0 for whole experiments."""
        washout = min(self.free_run.washout, segment // 2) if segment else self.free_run.washout
        free_run = replace(self.free_run, segment=segment, washout=washout)
        return replace(self, segments=self._build_segments(segment, washout), free_run=free_run)

    def _build_segments(self, segment: int, washout: int) -> Any:
        like = self.whole if self.criterion.simulates and not segment else None
        return build_segments(self.record, self.dynamics, segment, washout, like, self.shares)

    def objective(self, structure: Structure) -> StructuredObjective:
        """Return the criterion as a function of θ and the weights."""
        start, elimination = np.asarray(self.segments.start), eliminate(structure, self.problem)
        # The unknown is c
        free = elimination.projects and not elimination.bounded
        bounds = elimination.lower.copy(), elimination.upper.copy()
        for i, value in self.fixed.items():
            bounds[0][i] = bounds[1][i] = value
        return StructuredObjective(
            dynamics=self.dynamics,
            numbers=self.numbers,
            segments=self.segments,
            initial=InitialStates(start, start.size > 0 and self.free_run.estimates_pasts),
            weight=self.problem.weight.matrix / self.rms,
            rms=self.rms,
            deviation=self.problem.deviation,
            physics=len(self.problem.baseline.names),
            bounds=None if free else bounds,
            colour=self.colour,
            sums=self.sums,
            task=self.task,
            elimination=elimination,
            fixed=self.fixed,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class StructuredObjective(FreeRunObjective):
    """`‖r‖²` of the free run and of the structure's rows.

    Without bounds or penalties the unknown θ is `c = θ − θ_aux`, split at the end (F2). Where an
    orthogonal θ has bounds, it is the unknown itself and `c = θ − θ_aux(w)` follows, so that the
    split cannot leave them. The entries that are `fixed` at a bound are known terms, to which
    nothing is split.
    """

    task: OneStepTask
    elimination: Elimination
    fixed: Fixed

    @property
    def splits(self) -> bool:
        """True where θ is split from a learner."""
        return self.elimination.projects and self.task.bound.learns

    @property
    def follows(self) -> bool:
        """True where c follows θ, `c = θ − θ_aux(w)`."""
        return self.splits and self.elimination.bounded

    @property
    def apart(self) -> bool:
        """True where entries at a bound become known terms beside the learner."""
        return self.follows and self.elimination.shared is not None

    def begin(self, w: Vector) -> Vector:
        """Return p of the one-step θ for the weights w."""
        f = self.task.share_of(w)
        theta = self.elimination.theta(f, self.fixed or self.elimination.active(f))
        return np.concatenate([theta if self.follows else theta - self._theta_taken(f), w])

    def place(self, p: Vector) -> tuple[Vector, Vector, Vector]:
        """Return (unknown θ, c, w) of p.

        Without bounds on an orthogonal θ the unknown is c itself.
        """
        theta, w = p[: self.physics], p[self.physics :]
        c = theta - self._theta_taken(self.task.share_of(w)) if self.follows else theta
        return theta, c, w

    def evaluate(self, p: Vector, start: Start) -> TrialPoint:
        """Return a trial at p, with the structure's rows."""
        point = super().evaluate(p, start)
        rows = self.elimination.rows
        if not len(rows.target):
            return point
        miss = rows.target - rows.theta @ point.theta - rows.learner @ self.task.share_of(point.w)
        return point._replace(loss=point.loss + float(miss @ miss) / self.rms**2)

    def linearise(self, point: TrialPoint) -> LinearisedFreeRun:
        """Return normal equations about a trial, of the unknown θ and with the structure's rows."""
        linear = super().linearise(point)
        hessian, gradient = linear.hessian, linear.gradient
        rows, rms = self.elimination.rows, self.rms
        if self.follows:
            change = self.change(point.w)
            hessian, gradient = change.T @ hessian @ change, change.T @ gradient
        if len(rows.target):
            by_rows = (
                np.column_stack([rows.theta, rows.learner @ self.task.share_slope(point.w)]) / rms
            )
            miss = (
                rows.target - rows.theta @ point.theta - rows.learner @ self.task.share_of(point.w)
            ) / rms
            hessian, gradient = hessian + by_rows.T @ by_rows, gradient + by_rows.T @ miss
        return linear._replace(hessian=hessian, gradient=gradient)

    def theta_information(self, linear: LinearisedFreeRun, w: Vector) -> Matrix:
        """Return the information of (θ, w).

        That of an orthogonal θ is without the learner's share.
        """
        if not self.splits:
            return linear.information
        change = self.change(w)
        return change.T @ linear.information @ change

    def change(self, w: Vector) -> Matrix:
        """Return ∂(c, w)/∂(θ, w) for `c = θ − θ_aux(w)`."""
        slope = self._theta_taken(self.task.share_slope(w))
        nt, nw = slope.shape
        return np.block([[np.eye(nt), -slope], [np.zeros((nw, nt)), np.eye(nw)]])

    def _theta_taken(self, share: np.ndarray) -> np.ndarray:
        """Return θ_aux of the learner's share QᵀF, or of its derivative."""
        return self.task.problem.projection.from_coordinates(self._projector @ share)

    @cached_property
    def _projector(self) -> Matrix:
        return self.elimination.taken_with_fixed(self.fixed)

    def held(self, end: Descent) -> Fixed:
        """Return the entries at a bound at the end of a run.

        Those that reached one, and the fixed ones that would stay.

        Those that the learner could imitate stay where the nearest θ in the bounds does, the others
        where descent would leave the bounds.
        """
        point, elimination = end.point, self.elimination
        ends = enumerate(zip(point.theta, elimination.lower, elimination.upper, strict=True))
        at = {i: float(value) for i, (value, *sides) in ends if value in sides}
        if not self.fixed or end.linear is None or elimination.shared is None:
            return at
        f = self.task.share_of(point.w)
        nearest = replace(elimination, outputs=elimination.to_coordinates @ point.c + f).active(f)
        downhill = np.where(
            point.theta == elimination.upper, end.linear.gradient[: self.physics], 0.0
        )
        downhill = np.where(
            point.theta == elimination.lower, -end.linear.gradient[: self.physics], downhill
        )
        imitated = [bool(row.any()) for row in elimination.shared.basis]
        return {
            i: v
            for i, v in at.items()
            if i not in self.fixed or (i in nearest if imitated[i] else downhill[i] > 0)
        }
