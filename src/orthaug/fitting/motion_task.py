"""Training of a motion on its free run: the parameters' coordinates, the weights and the segments' starts together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.progress import RunTell
from orthaug.data.record import Record
from orthaug.fitting.course import Flight
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.flights import FlightTask, Place
from orthaug.fitting.initial_states import Start
from orthaug.fitting.learned import ErrorStatistics, Learned
from orthaug.fitting.motion_course import MotionCourse
from orthaug.fitting.motion_measures import sizes_learned
from orthaug.fitting.motion_physics import fly_motion
from orthaug.fitting.segment_sums import SegmentSums
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.status import Ending
from orthaug.fitting.structures import Structure
from orthaug.models.learners import Bound, Learner
from orthaug.models.rows import Engine
from orthaug.models.terms import scaling_of
from orthaug.physics.motion_problem import MotionProblem

_LOOSER = 1e-4  # times the weight of the guesses, where it is asked what the outputs tell


@dataclass(frozen=True, eq=False)
class MotionTask(FlightTask):
    """A motion's course, and what its physics alone does on it."""

    plan: MotionCourse

    @classmethod
    def of(
        cls, problem: MotionProblem, learner: Learner | None, criterion: Criterion, engine: Engine | None = None
    ) -> MotionTask:
        """Bind a learner to the equations and outputs that it is added to, and lay the record out.

        Raises:
            InputError: nothing would be scored.
        """
        states, outputs = problem.motion.learned
        bound = None if learner is None else Bound(learner, len(problem.features), len(states) + len(outputs))
        return cls(MotionCourse.of(problem, bound, criterion, sums=None if engine is None else SegmentSums.of(engine)))

    @property
    def rows_task(self) -> MotionTask:
        return self

    def on(self, record: Record) -> MotionTask:
        """The same motion on another record."""
        sums = None if self.plan.sums is None else SegmentSums.of(self.plan.sums.engine)
        course = MotionCourse.of(self.problem.on(record), self.bound, self.criterion, self.plan, sums)
        return MotionTask(course)

    def physics_alone(self) -> tuple[MotionTask, Learned]:
        """The task without a learner, and what physics alone leaves; without an end where it cannot fly."""
        alone = replace(self, plan=self.plan.alone)
        if self.physics is not None:
            return alone, alone.learned(self.physics)
        unknown = ErrorStatistics(None, None, 0.0, np.nan, {})
        initial = self.problem.motion.coordinates.initial
        nothing: dict[str, Any] = {"bound": None, "weights": np.zeros(0), "errors": unknown, "coefficients": initial}
        return alone, Learned(scaling=alone.plan.scaling, unit=alone.plan.unit, ending=Ending.NON_FINITE, **nothing)

    def median(self, members: list[Learned], best: int) -> Learned:
        """The best member: a motion has no ensemble, for medians of outputs follow no equations."""
        return members[best]

    def learned(self, run: Flight) -> Learned:
        """The learner as a run left it. The information counts what the outputs tell, hardly what the guesses do."""
        end, objective = run.end, run.objective
        if end.linear is None:
            return super().learned(run)
        information = objective.eliminated(end.flown, _LOOSER * objective.start_rows)[0]
        return super().learned(run._replace(end=end._replace(linear=end.linear._replace(information=information))))

    def flown_alone(
        self, solver: LevenbergMarquardt, structure: Structure, tell: RunTell
    ) -> tuple[MotionCourse, Flight | None]:
        return fly_motion(self.plan, solver, tell)

    def scaled(self, plan: MotionCourse, physics: Flight) -> MotionCourse:
        """The learner's features over the runs of physics alone, and the size of what it is added to."""
        if plan.bound is None:
            return plan
        flown = physics.end.flown
        x, u = (part.T for part in plan.alone.trajectory(flown.c, (), flown.states))
        with np.errstate(all="ignore"):
            features = np.asarray(plan.dynamics.seen(x, u, np)).T
        finite = features[np.isfinite(features).all(axis=1)]
        scaling = scaling_of(plan.bound.learner, finite if len(finite) else np.zeros((1, features.shape[1])))
        return replace(plan, scaling=scaling, unit=sizes_learned(plan, flown.c, x.T, u.T))

    def places(
        self,
        objective: Any,
        solver: LevenbergMarquardt,
        w: Vector,
        structure: Structure,
        regularization: str | float,
    ) -> list[Place]:
        """Physics alone with a silent learner; a learner that cannot be silenced starts as it is."""
        silenced = w if self.bound is None else self.bound.silent(w)  # no learner: physics alone did not fly
        q = self.problem.motion.coordinates.initial if self.physics is None else self.physics.end.flown.theta
        p = np.concatenate([q, w if silenced is None else silenced])
        states = objective.initial.measured
        loss = objective.fly(p, Start(states)).loss
        return [Place(p, states, loss if np.isfinite(loss) else np.inf, silenced is not None)]
