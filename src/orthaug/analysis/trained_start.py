"""The free run from the start that training found, where the measured one is far worse.

A model that remembers its start for long is scored from what the first rows give. Its training on
the free run chose another start: what it is judged by is the run from there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import singledispatch

import numpy as np

from orthaug._base.checks import Matrix
from orthaug._base.errors import Warning
from orthaug.analysis.output_response import from_fitted_start
from orthaug.analysis.residuals import rms_errors
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.fitting.motion_estimate import MotionEstimate
from orthaug.models.response import Response

_BY_START = 0.5  # of the error's squares: less is left where the measured start made most


@dataclass(frozen=True, eq=False)
class TrainedRun:
    """A free run over the training data from the start that training found.

    `begin` says what the other run starts from, `states` are the run's (N, nx) of each experiment
    where they are not outputs.
    """

    response: Response
    begin: str
    remedy: str
    states: list[Matrix] | None = None


def from_trained_start(fit: Estimate, free_run: Response) -> tuple[TrainedRun, Warning] | None:
    """Return the free run from the start of training, and a warning.

    None where the measured start does nearly as well, or the fit was not trained on the free run.

    Args:
        free_run: over the training data, from the measured start.
    """
    if not fit.criterion.simulates or any(run.diverged for run in free_run.trajectories):
        return None
    other = _trained_run(fit, free_run)
    if other is None:
        return None
    before, after = rms_errors(free_run), rms_errors(other.response)
    unit = fit.problem.deviation
    if not np.sum((after / unit) ** 2) <= _BY_START * np.sum((before / unit) ** 2):
        return None
    worst = int(np.argmax(before / unit))
    output = free_run.outputs[worst]
    of = f"{output.name}{' [' + output.unit + ']' if output.unit else ''}"
    text = (
        f"the free run begins at {other.begin} for long: from "
        f"the start that training found, its error of {of} is {after[worst]:.3g} instead of "
        f"{before[worst]:.3g}. Scores are from the measured start, the tests of the residual from "
        f"the better one. Judge the model by the latter, or give `simulate` {other.remedy}."
    )
    return other, Warning("noisy_start", text)


@singledispatch
def _trained_run(fit: Estimate, free_run: Response) -> TrainedRun | None:
    """Return the run of a kind of physics; None where there is none."""
    raise NotImplementedError


@_trained_run.register(LaggedEstimate)
def _from_better_lags(fit: LaggedEstimate, free_run: Response) -> TrainedRun | None:
    """Return the run from the lags that follow the outputs best, to first order."""
    other = from_fitted_start(fit.model, fit.problem.record, free_run)
    begin = "measured rows, and the model remembers their noise"
    remedy = "rows to start from that are smoothed (--initial)"
    return None if other is None else TrainedRun(other, begin, remedy)


@_trained_run.register(MotionEstimate)
def _from_trained_state(fit: MotionEstimate, free_run: Response) -> TrainedRun | None:
    """Return the run from the states that training found; None of a predictor."""
    model, record = fit.model, fit.problem.record
    if model.coloured or fit.segmented.record is not record:
        return None
    numbers = model.numbers
    rows = fit.segmented.states_by_row(np.asarray(numbers.c), numbers.weights, fit.states)
    trajectories, states = [], []
    for experiment, own in zip(record.experiments, rows, strict=True):
        inputs = model.form.inputs(experiment, record)
        run = model.form.run(numbers, own[0], inputs)
        trajectories.append(model.as_trajectory(run, inputs, experiment, record))
        states.append(np.asarray(run.states))
    if any(one.diverged for one in trajectories):
        return None
    begin = "the state that its first rows give, and the model remembers the error of that"
    remedy = "more rows to start from (--initial)"
    return TrainedRun(replace(free_run, trajectories=tuple(trajectories)), begin, remedy, states)
