"""The physics of a motion alone, over segments that lengthen: where every learner starts, and what it has to beat.

First the starts of short segments are found, then the parameters over them, then over longer ones, which begin at the
states that the shorter ones went through. Every length may also begin anew from the initial parameters.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.progress import RunTell, quiet
from orthaug.fitting.course import Flight
from orthaug.fitting.initial_states import Start
from orthaug.fitting.motion_course import MotionCourse
from orthaug.fitting.segments import respond
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.models.settling import LOOSE
from orthaug.physics.motion import MOST_SUBSTEPS

_SHORTEST = 15  # steps of a segment
_LONGER = 8  # times, from one length of the segments to the next; every length compiles its own programs
_POOR = 0.5  # of the output's deviation: what is left above it may not be the best minimum
_SHORT_ITERATIONS = 15  # over segments that are not the last
_SETTLING = 200  # steps at most by which starts follow the outputs: a descent damps no step of theirs
_FINE = 0.01  # of the residual: how much the outputs may move when the substeps are doubled


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
