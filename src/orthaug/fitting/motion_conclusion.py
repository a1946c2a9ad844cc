"""From a trained motion to an estimate: the model, the window it predicts from, p̂ under a measure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from orthaug._base.errors import InputError
from orthaug.data.record import Record
from orthaug.fitting.conclusion import without_loss
from orthaug.fitting.learned import Learned
from orthaug.fitting.motion_course import MotionCourse
from orthaug.fitting.motion_estimates import MotionEstimate
from orthaug.fitting.motion_task import MotionTask
from orthaug.fitting.status import Status
from orthaug.fitting.structures import Structure
from orthaug.inference.motion_split import MotionSplit
from orthaug.models.motion_model import MotionModel, Trained
from orthaug.models.statistics import Statistics

_WINDOWS = (4, 16)  # times (states + 1): rows of a window to predict from
_TRIED_ROWS = 1000  # on which windows are compared


def conclude_motion(task: MotionTask, structure: Structure, learned: Learned) -> MotionEstimate:
    """Split the fitted motion and attach statistics."""
    plan = task.plan
    assert learned.coefficients is not None and learned.errors is not None
    states = plan.segments.start if learned.scores is None else learned.scores.states
    slope = None if learned.scores is None else learned.scores.slope
    errors = learned.errors
    alone = np.asarray(learned.coefficients if task.physics is None else task.physics.end.flown.theta)
    trained = Trained(plan.flown.segment, plan.flown.washout, np.asarray(states), slope, alone)
    model = replace(_model(plan, structure, learned), trained=trained)
    fit = MotionEstimate(
        model=model,
        status=Status(learned.ending, learned.iterations, learned.seconds, errors.mean_square),
        restarts=(),
        covariance=None,
        freedom=errors.freedom,
        effective_weights=learned.effective,
        defect=None,
        problem=task.problem,
        criterion=task.criterion,
        split_by=MotionSplit.none("training", plan.dynamics, learned.coefficients),
        course=plan,
        states=states,
        slope=slope,
        alone=alone,
        scores=learned.scores,
        warnings=tuple(without_loss(errors.mean_square)),
    )
    return fit.split(structure.measure, getattr(structure, "shared", "auto")) if learned.ending.usable else fit


def _model(plan: MotionCourse, structure: Structure, learned: Learned) -> MotionModel:
    record = plan.record
    assert learned.coefficients is not None and learned.errors is not None
    noise = learned.errors.noise
    middle = None
    if noise is not None and learned.gram is not None and learned.middle is not None:
        middle = learned.middle(plan.problem.weight.whitened(noise))
    model = MotionModel(
        form=plan.dynamics,
        numbers=plan.numbers(learned.coefficients, learned.weights),
        outputs=record.outputs,
        inputs=record.inputs,
        sampling_time=record.sampling_time,
        structure=structure.name,
        largest_output=np.max([np.abs(e.outputs).max(axis=0) for e in record.experiments], axis=0),
        deviation=plan.deviation,
        weight=plan.weight,
        loose=plan.loose,
        window=_WINDOWS[0] * (plan.dynamics.states + 1),
        time_column=record.time_column,
        prepared=record.prepared,
        statistics=Statistics(learned.gram, middle, noise, learned.ridge, learned.errors.freedom, flown=True),
    )
    return replace(model, window=_best_window(model, record)) if learned.ending.usable else model


def _best_window(model: MotionModel, record: Record) -> int:
    """The rows to predict from that give the least error one step ahead, on some of the training data."""
    longest = max(record.experiments, key=len).rows(0, _TRIED_ROWS)
    tried = [n * (model.form.states + 1) for n in _WINDOWS]
    best, least = tried[0], np.inf
    for window in tried:
        if best != window and 4 * window > len(longest):
            break
        part = replace(record, experiments=(longest,))
        try:
            response = replace(model, window=window).predict(part)
        except InputError:  # not even one window fits
            break
        (trajectory,) = response.trajectories
        assert trajectory.measured is not None
        with np.errstate(all="ignore"):
            errors = (trajectory.model - trajectory.measured)[tried[-1] if len(longest) > 4 * tried[-1] else window :]
            square = float(np.mean(np.sum((errors @ model.weight.T) ** 2, axis=1)))
        if square < 0.98 * least:  # a longer one only where it is clearly better
            best, least = window, square
    return best
