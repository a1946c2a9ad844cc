"""Training of a motion on its free run: the parameters' coordinates, the weights and the segments' starts together.

Physics alone is where every learner starts, and what it has to beat. It is trained over segments that lengthen: first
the starts of short ones are found, then the parameters over them, then over longer ones, which begin at the states that
the shorter ones went through. Every length may also begin anew from the initial parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.progress import RunTell, quiet
from orthaug.data.record import Record
from orthaug.fitting.course import Flight
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.flights import FlightTask, Place
from orthaug.fitting.initial_states import Start
from orthaug.fitting.learned import ErrorStatistics, Learned
from orthaug.fitting.motion_course import MotionCourse
from orthaug.fitting.motion_measures import sizes_learned
from orthaug.fitting.segment_sums import SegmentSums
from orthaug.fitting.segments import respond
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.status import Ending
from orthaug.fitting.structures import Structure
from orthaug.models.learners import Bound, Learner
from orthaug.models.rows import Engine
from orthaug.models.settling import LOOSE
from orthaug.models.terms import scaling_of
from orthaug.physics.motion import MOST_SUBSTEPS
from orthaug.physics.motion_problem import MotionProblem

_SHORTEST = 15  # steps of a segment
_LONGER = 8  # times, from one length of the segments to the next; every length compiles its own programs
_POOR = 0.5  # of the output's deviation: what is left above it may not be the best minimum
_SHORT_ITERATIONS = 15  # over segments that are not the last
_SETTLING = 200  # steps at most by which starts follow the outputs: a descent damps no step of theirs
_FINE = 0.01  # of the residual: how much the outputs may move when the substeps are doubled
_LOOSER = 1e-4  # times the weight of the guesses, where it is asked what the outputs tell


def fly_motion(
    course: MotionCourse, solver: LevenbergMarquardt, tell: RunTell = quiet
) -> tuple[MotionCourse, Flight | None]:
    """Parameters of the physics alone, and the course with segments that start where its runs do; None: none flies."""
    own, initial = course.alone, course.problem.motion.coordinates.initial
    steps = own.segments.steps
    lengths = [steps // _LONGER**i for i in range(20, 0, -1) if steps // _LONGER**i >= _SHORTEST]
    ends: list[Flight] = []
    iterations, seconds = 0, 0.0
    q, rows = initial, None
    for length in lengths:
        short = own.over(length)
        end = _descended(short, solver.at_most(_SHORT_ITERATIONS), [q, initial], rows)
        if end is None:
            q, rows = initial, None
            continue
        iterations, seconds = iterations + end.iterations, seconds + end.seconds
        q = end.end.flown.theta
        rows = short.states_by_row(q, (), end.end.flown.states)
    for start, known in ((q, rows), (initial, None)):
        if start is initial and ends and (q is initial or _follows(own, ends[0])):
            continue
        end = _descended(own, solver, [start], known, tell)
        if end is not None:
            ends.append(end)
            iterations, seconds = iterations + end.iterations, seconds + end.seconds
    if not ends:
        return course, None
    best = min(ends, key=lambda end: end.end.flown.misfit)
    course, best = _fine_enough(course, best, solver)
    flown = best.end.flown
    states = np.asarray(flown.states)
    x, _ = course.alone.trajectory(flown.theta, (), states)
    size = np.abs(x).max(axis=0, initial=0.0)
    course = replace(course.from_states(states), loose=LOOSE * np.where(size > 0, size, 1.0))
    mean_square = course.alone.mean_square(flown.theta, ())
    return course, best._replace(mean_square=mean_square, iterations=iterations, seconds=seconds)


def _descended(
    course: MotionCourse,
    solver: LevenbergMarquardt,
    starts: list[Vector],
    rows: list[np.ndarray] | None,
    tell: RunTell = quiet,
) -> Flight | None:
    """From the best of the starts, whose segments begin at states that follow the outputs; None where none flies."""
    if rows is not None:
        course = course.starting_from(rows)
    objective = course.objective()
    places = []
    for q in starts:
        states = course.settled(q, iterations=_SETTLING)
        places.append((objective.fly(q, Start(states)).loss, q, states))
    loss, q, states = min(places, key=lambda place: place[0])
    if not np.isfinite(loss):
        return None
    flight = course.descend(objective, q, solver, tell, states)
    return flight if flight.ending.usable else None


def _follows(course: MotionCourse, flight: Flight) -> bool:
    """Whether the runs follow most of what the outputs do."""
    return bool(_left(course, flight) < _POOR**2 * course.residuals)


def _left(course: MotionCourse, flight: Flight) -> float:
    """The sum of squared errors, each output in its deviation; infinite where they are too large to square."""
    squares = flight.objective.squares(flight.end.flown)
    return np.inf if squares is None else float(np.sum(np.diag(squares) / course.deviation**2))


def _fine_enough(course: MotionCourse, flight: Flight, solver: LevenbergMarquardt) -> tuple[MotionCourse, Flight]:
    """Twice the substeps until they move the outputs by less than 1 % of what the physics leaves."""
    motion = course.problem.motion
    while motion.substeps is None and motion.integrator != "discrete" and course.dynamics.substeps < MOST_SUBSTEPS:
        finer = course.refined(2 * course.dynamics.substeps)
        if moved_by(course.alone, finer.alone, flight) <= _FINE:
            break
        again = _descended_on(finer.alone, solver, flight)
        if again is None:
            break
        course, flight = finer, again
    return course, flight


def moved_by(course: MotionCourse, finer: MotionCourse, flight: Flight) -> float:
    """By how much of the residual the outputs move when the steps of the integrator are finer."""
    flown = flight.end.flown
    runs = []
    for one in (course, finer):
        runs.append(np.asarray(respond(one.dynamics, one.numbers(flown.c, flown.w), one.segments, flown.states)))
    scored = np.asarray(course.segments.scored)[:, :, None]
    with np.errstate(all="ignore"):
        moved = np.where(scored, runs[1] - runs[0], 0.0) / course.deviation[:, None]
        ratio = np.sqrt(np.sum(moved**2) / max(_left(course, flight), 1e-300))
    return float(ratio) if np.isfinite(ratio) else 0.0


def _descended_on(course: MotionCourse, solver: LevenbergMarquardt, flight: Flight) -> Flight | None:
    flown = flight.end.flown
    again = course.descend(course.objective(), flown.theta, solver, states=flown.states)
    return again if again.ending.usable else None


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
