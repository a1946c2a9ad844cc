"""Physics alone on a criterion of several steps: where every learner starts, and what it has to beat.

A learner that starts from random weights often ends above physics alone, since its start runs away. From physics
alone, with a silent learner, a descent cannot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.progress import RunTell, quiet
from orthaug.fitting.course import Flight
from orthaug.fitting.flight_plan import FlightPlan
from orthaug.fitting.initial_states import Start
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.structures import Structure

_SHORTEST = 4  # steps of a segment
_LONGER = (4.0, 2.0, 1.4, 1.15)  # times, from one length of the segments to the next: the first that flies
_SHRUNK = (0.99, 0.9, 0.5, 0.0)  # of the one-step θ: less feedback flies longer


def fly_alone(
    plan: FlightPlan, solver: LevenbergMarquardt, structure: Structure, tell: RunTell = quiet
) -> Flight | None:
    """θ of physics alone under the plan's criterion and the structure's rows and bounds; None where none can fly.

    Training starts at the one-step solution, or at the initial values where these fly better. Where neither flies, or
    the end runs away over whole experiments, it goes over segments that lengthen. Of all ends the best over whole
    experiments is kept; where a start was better than them, whole experiments are trained on too.
    """
    plan = plan.alone
    objective = plan.objective(structure)
    least_squares, initial = objective.begin(np.zeros(0)), plan.problem.baseline.initial
    starts = [least_squares, *([initial] if initial.any() else []), *(share * least_squares for share in _SHRUNK)]
    losses = [objective.fly(p, Start(objective.initial.measured)).loss for p in starts]
    ends: list[Flight] = []
    if np.isfinite(losses).any():
        ends.append(plan.descend(objective, starts[int(np.argmin(losses))], solver, tell))
    if not np.isfinite(losses[0]) or not ends or not np.isfinite(ends[0].mean_square):
        ends += _lengthening(plan, solver, structure, starts)
    if plan.whole is not plan.segments and plan.lengthens:
        ends += _over_whole(plan, solver, structure, starts, ends)
    best = _best(ends)
    spent = {"iterations": sum(e.iterations for e in ends), "seconds": sum(e.seconds for e in ends)}
    return None if best is None else best._replace(**spent)


def _lengthening(
    plan: FlightPlan, solver: LevenbergMarquardt, structure: Structure, starts: Sequence[Vector]
) -> list[Flight]:
    """The end over the plan's own segments, reached over shorter ones, from the first start that flies over them."""
    p, segment, shortest = None, _SHORTEST, plan.over(_SHORTEST)
    for start in starts:
        end = shortest.descend(shortest.objective(structure), start, solver)
        if end.ending.usable:
            p = end.end.flown.p
            break
    while p is not None:
        for longer in _LONGER:
            steps = min(int(np.ceil(longer * segment)), plan.segments.steps)
            course = plan if steps == plan.segments.steps else plan.over(steps)
            end = course.descend(course.objective(structure), p, solver)
            if end.ending.usable:
                break
        else:
            return []
        p, segment = end.end.flown.p, steps
        if course is plan:
            return [end]
    return []


def _over_whole(
    plan: FlightPlan,
    solver: LevenbergMarquardt,
    structure: Structure,
    starts: Sequence[Vector],
    ends: Sequence[Flight],
) -> list[Flight]:
    """The end over whole experiments, where no end over segments is as good there as every start."""
    places = [(end.mean_square, end.end.flown.p) for end in ends]
    objective = plan.objective(structure)
    begun = [(plan.mean_square(objective.place(p)[1], np.zeros(0)), p) for p in starts]
    known = [place for place in (*places, *begun) if np.isfinite(place[0])]
    if not known:
        return []
    best = min(known, key=lambda place: place[0])
    if any(np.array_equal(best[1], p) for _, p in places):
        return []
    whole = replace(plan.over(0), segments=plan.whole)
    end = whole.descend(whole.objective(structure), best[1], solver)
    if not end.ending.usable:
        return []
    own = plan.descend(objective, end.end.flown.p, solver.at_most(0))  # its statistics are those of the plan's segments
    if not own.ending.usable:
        return []
    own = own._replace(end=own.end._replace(ending=end.ending))
    return [own._replace(iterations=end.iterations, seconds=end.seconds)]


def _best(ends: Sequence[Flight]) -> Flight | None:
    """The lowest over whole experiments; where all run away, the lowest over segments."""
    usable = [end for end in ends if end.ending.usable]
    flying = [end for end in usable if np.isfinite(end.mean_square)]
    if flying:
        return min(flying, key=lambda end: end.mean_square)
    return min(usable, key=lambda end: end.end.flown.loss, default=None)
