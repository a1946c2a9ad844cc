"""The free run from the start that training found, where the measured one is worse.

A model that remembers its start for long is scored from what the first rows give. Its training on
the free run chose another start: what it is judged by is the run from there. Where that is far
better, a warning says so.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import singledispatch
from itertools import pairwise

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError, Warning
from orthaug.analysis.fit_findings import PartScores
from orthaug.analysis.output_response import from_fitted_start
from orthaug.analysis.residuals import rms_errors
from orthaug.data.record import Record
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.fitting.motion_estimate import MotionEstimate
from orthaug.models.dynamics import Parts, Run
from orthaug.models.response import Response

_FAR_WORSE = 3.0  # times the error of other runs
_PIECES = 4  # of an experiment, whose runs start anew
_BY_START = 0.5  # of the error's squares: less is left where the measured start made most
# Of the error's squares beyond what training left: a measured start that adds as little colours
# no test of the residual
_COLOURLESS = 0.02


@dataclass(frozen=True, eq=False)
class TrainedRun:
    """A free run over the training data from the start that training found.

    `begin` says what the other run starts from, `states` are the run's (N, nx) of each experiment
    where they are not outputs. The run of an unstable plant starts anew after every `segment`
    steps.
    """

    response: Response
    begin: str
    remedy: str
    states: list[Matrix] | None = None
    segment: int = 0


def from_trained_start(
    fit: Estimate, free_run: Response
) -> tuple[TrainedRun, Warning | None] | None:
    """Return the free run from the start of training, with a warning where it is far better.

    None where the measured start does as well, or clearly better for an output, or where the fit
    was not trained on the free run.

    Args:
        free_run: over the training data, from the measured start.
    """
    if not fit.criterion.simulates:
        return None
    other = _trained_run(fit, free_run)
    if other is None:
        return None
    if other.segment:
        return other, unstable_warning(other.segment, fit.problem.record.sampling_time)
    if any(run.diverged for run in free_run.trajectories):
        return None
    # Each output by itself: in a sum the noise of one hides what the start makes of another
    before, after = rms_errors(free_run), rms_errors(other.response)
    better, worse = after**2 < _BY_START * before**2, before**2 < _BY_START * after**2
    if worse.any() or not _adds(before, after):
        return None
    if not better.any():
        return other, None
    most = int(np.argmin(np.where(better, after, np.inf) / np.where(better, before, 1.0)))
    output = free_run.outputs[most]
    of = f"{output.name}{' [' + output.unit + ']' if output.unit else ''}"
    text = (
        f"the free run begins at {other.begin} for long: from "
        f"the start that training found, its error of {of} is {after[most]:.3g} instead of "
        f"{before[most]:.3g}. Scores are from the measured start, the tests of the residual from "
        f"the better one. Judge the model by the latter, or give `simulate` {other.remedy}."
    )
    return other, Warning("noisy_start", text)


def _adds(before: Vector, after: Vector) -> bool:
    """Return whether errors (ny,) have more squares before than after, all outputs together."""
    there = after > 0
    added = (before[there] / after[there]) ** 2 - 1
    return bool(np.any(before[~there] > 0) or (len(added) and np.mean(added) > _COLOURLESS))


def local_minimum_of_start(
    fit: Estimate, one_step: Response, free_run: Response, others: Mapping[str, PartScores]
) -> list[Warning]:
    """Return the warning that training ended beside the states that the data show.

    A free run that is far worse than predictions, than runs over parts that were not fitted, and
    than runs over the same rows that start anew, has good parameters and a poor start: what is
    missing in the physics or disturbs the plant would be there in these runs, too.

    Args:
        free_run: over the training data, from the better of both starts.
        others: scores of parts that were not fitted, by their names.
    """
    record = fit.problem.record
    if not fit.criterion.simulates or fit.model.coloured or not others:
        return []
    size, ahead = rms_errors(free_run), rms_errors(one_step)
    for name, scores in others.items():
        left, share = (
            np.array([np.nan if value is None else value for value in own or size * np.nan])
            for own in (scores.simulation.rmse, scores.simulation.nrmse)
        )
        limit = np.fmax(ahead, np.maximum(left, share * fit.problem.deviation))
        off = size > _FAR_WORSE * limit
        if not off.any():
            continue
        try:
            anew = rms_errors(fit.model.simulate(_in_pieces(record)))
        except InputError:  # too short, or without outputs to begin from
            return []
        off &= size > _FAR_WORSE * anew
        if not off.any():
            return []
        worst = int(np.argmax(np.where(off, size / left, -np.inf)))
        output = free_run.outputs[worst]
        of = f"{output.name}{' [' + output.unit + ']' if output.unit else ''}"
        text = (
            "training probably ended in a local minimum, at a start beside the data. The free "
            f"run's error of {of} is {size[worst]:.3g} over the training data, but "
            f"{left[worst]:.3g} over {name}. Where it starts anew {_PIECES - 1} times, it is "
            f"{anew[worst]:.3g} over the training data. Missing physics or disturbances would be "
            "there, too. Remedy: give the values found here as `initial`, and fit again."
        )
        return [Warning("poor_start", text)]
    return []


def _in_pieces(record: Record) -> Record:
    """Return a record whose experiments are cut into pieces."""
    pieces = []
    for one in record.experiments:
        edges = np.linspace(0, len(one), _PIECES + 1).astype(int)
        pieces += [one.rows(int(a), int(b)) for a, b in pairwise(edges)]
    return replace(record, experiments=tuple(pieces))


def unstable_warning(segment: int, step: float) -> Warning:
    """Return the warning on a plant in whose free runs errors grow twenty-fold in a segment."""
    text = (
        f"the plant is unstable: errors of a free run grow twenty-fold in about {segment} samples "
        f"({segment * step:.3g} s), so none follows the record. Training and the tests of the "
        "residual use runs of that length from estimated starts. Scores of whole free runs mean "
        "nothing: judge the model by its predictions. If a controller held the plant, give "
        "`controller` and the reference as input."
    )
    return Warning("unstable_plant", text)


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
    begins = fit.restarts_at
    each = [[0]] * len(rows) if begins is None else begins
    for experiment, own, first in zip(record.experiments, rows, each, strict=True):
        inputs = np.asarray(model.form.inputs(experiment, record))
        bounds = pairwise([*first, len(experiment)])
        pieces = [model.form.run(numbers, own[a], inputs[a:b]) for a, b in bounds]
        run = pieces[0] if len(pieces) == 1 else _joined(pieces)
        trajectories.append(model.as_trajectory(run, inputs, experiment, record))
        states.append(np.asarray(run.states))
    if any(one.diverged for one in trajectories):
        return None
    begin = "the state that its first rows give, and the model remembers the error of that"
    remedy = "more rows to start from (--initial)"
    response = replace(free_run, trajectories=tuple(trajectories))
    segment = 0 if begins is None else fit.segmented.segments.steps
    return TrainedRun(response, begin, remedy, states, segment)


def _joined(pieces: list[Run]) -> Run:
    """Return runs one after another as one."""
    parts = zip(*(piece.parts for piece in pieces), strict=True)
    states = np.concatenate([np.asarray(piece.states) for piece in pieces])
    return Run(states, Parts(*(np.concatenate([np.asarray(p) for p in part]) for part in parts)))
