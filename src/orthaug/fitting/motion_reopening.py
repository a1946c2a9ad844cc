"""A saved motion with its training data again, as an estimate: to split it under another measure without training."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from orthaug._base.errors import InputError
from orthaug.data.record import Record
from orthaug.fitting.criteria import Simulation
from orthaug.fitting.motion_course import MotionCourse
from orthaug.fitting.motion_estimates import MotionEstimate
from orthaug.fitting.status import Ending, Status
from orthaug.inference.motion_split import MotionSplit
from orthaug.models.learners import Scaling
from orthaug.models.motion_model import MotionModel
from orthaug.physics.motion_problem import pose_motion


def reopened(model: MotionModel, record: Record) -> MotionEstimate:
    """The estimate of a saved model, less what was told of its training.

    Raises:
        InputError: other data than the model was trained on.
    """
    kept, form, numbers = model.trained, model.form, model.numbers
    if kept is None:
        raise InputError("the model was saved without what a split needs; fit it again.")
    record = model.fitting(record, need_outputs=True)
    problem = pose_motion(record, form.motion, [entry.text for entry in form.features] or None)
    problem = replace(problem, weight=replace(problem.weight, matrix=model.weight))
    criterion = Simulation(kept.segment, kept.washout)
    course = MotionCourse.of(problem, form.bound, criterion).refined(form.substeps)
    centre, half = (numbers.centre, numbers.halfwidth) if form.bound is not None else (np.zeros(0), np.ones(0))
    course = replace(course, scaling=Scaling(np.asarray(centre), np.asarray(half)), unit=np.asarray(numbers.gain))
    if np.asarray(course.segments.start).shape != np.shape(kept.states):
        raise InputError(
            f"the model was trained on other rows: these {len(record)} give other segments than those it keeps the "
            "starts of. Give the files, and --rows, that it was trained on."
        )
    c = np.asarray(numbers.theta - numbers.theta_aux)
    return MotionEstimate(
        model=model,
        status=Status(Ending.EXACT, 0, 0.0, np.nan),
        restarts=(),
        covariance=None,
        freedom=model.statistics.freedom,
        effective_weights=np.nan,
        defect=None,
        problem=problem,
        criterion=criterion,
        split_by=MotionSplit.none(model.measure, form, c),
        course=course,
        states=kept.states,
        slope=kept.slope,
        alone=np.asarray(kept.alone),
    )
