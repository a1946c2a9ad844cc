"""Where biases of a motion are computed: about physics alone before a fit, about the fitted motion after it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from orthaug._base.checks import check_type
from orthaug.analysis.motion_bias import MotionGround, TermBias
from orthaug.analysis.motion_response import Place
from orthaug.analysis.motion_suspects import MotionSuspect, check_motion_suspects, softened
from orthaug.analysis.robustness import block_of
from orthaug.fitting.motion_estimates import MotionEstimate
from orthaug.fitting.motion_measures import field_under
from orthaug.fitting.motion_task import MotionTask
from orthaug.fitting.structures import Structure
from orthaug.inference.motion_split import MotionSplit, shared_of_motion
from orthaug.models.motion_field import parts_at
from orthaug.physics.shared import Shared


def suspected_bias(fit: MotionEstimate, suspects: Sequence[MotionSuspect]) -> list[TermBias]:
    """What terms that the equations of a fitted motion may lack do to its parameters, and what tells of them.

    Raises:
        InputError: suspects that the motion cannot have, or a fit of difference equations.
    """
    check_type(
        fit, MotionEstimate, "fit", "a fit of equations of motion (of difference equations `bias_budget` tells it)"
    )
    check_motion_suspects(suspects, fit.problem)
    ground = ground_after(fit)
    if ground is None or not suspects:
        return []
    steps = block_of(fit) if fit.plain_covariance is not None else None
    return ground.table(suspects, fit.effective_weights, steps)


def softened_bias(fit: MotionEstimate, suspects: Sequence[MotionSuspect]) -> list[TermBias]:
    """What friction among the suspects does that turns round smoothly, of widths by the size of what it acts on.

    Nothing without a learner: it alone shows the shape of what is missing.
    """
    if fit.model.form.bound is None:
        return []
    field = fit.split_by.field
    smooth = softened(suspects, fit.problem.motion, fit.values, field.x, field.u)
    return suspected_bias(fit, smooth) if smooth else []


def ground_after(fit: MotionEstimate) -> MotionGround | None:
    """Of a fitted motion under the measure that it was split under; None where it has no normal equations."""
    if not fit.status.ok or fit.scores is None:
        return None
    numbers, field, learned = fit.model.numbers, fit.split_by.field, None
    ridge = fit.model.statistics.ridge / fit.scores.unit
    c, w = np.asarray(numbers.theta - numbers.theta_aux), np.asarray(numbers.weights)
    place = Place(fit.course, c, w, fit.states, fit.scores.weight, ridge)
    if fit.model.form.bound is not None:
        learned = parts_at(fit.model.form, fit.model.numbers, field.x, field.u)[1]
        learned = np.where(np.isfinite(learned), learned, 0.0)
    unknown = (*fit.unidentified, *fit.at_bound)
    return MotionGround(place, fit.theta, fit.shared, field, learned, unknown, fit.split_by.slope)


def ground_before(task: MotionTask, structure: Structure) -> MotionGround | None:
    """Of physics alone, with what a learner of the task's features could hold; None where it has no run."""
    if task.physics is None:
        return None
    course, flown = task.plan, task.physics.end.flown
    form, names = course.dynamics, course.problem.motion.names
    weights = np.zeros(0)
    place = Place(course, flown.theta, weights, flown.states, task.physics.objective.weight)
    none = MotionSplit.none("training", form, flown.theta)
    if course.bound is None:
        return MotionGround(place, flown.theta, none.shared, none.field)
    field = field_under(structure.measure, course.alone, course.alone.numbers(flown.theta, weights), flown.states)[0]
    if structure.shared == "all":
        return MotionGround(place, flown.theta, Shared(names, np.eye(len(names))), field)
    return MotionGround(place, flown.theta, shared_of_motion(form, flown.theta, field.x, field.u), field)
