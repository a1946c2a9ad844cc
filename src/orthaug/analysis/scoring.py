"""Scores of a model on a part of the data: one step ahead, and on the free run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from orthaug._base.checks import positive
from orthaug._base.errors import Warning
from orthaug.analysis.fit_findings import PartScores, ScoreResult
from orthaug.analysis.residuals import RunningResidual
from orthaug.data.part import Part
from orthaug.data.sources import rows_of
from orthaug.fitting.colour import correlation_length
from orthaug.models.long_runs import scores_along
from orthaug.models.model import Model
from orthaug.models.response import Response
from orthaug.models.starts import EstimatedStates

_MEMORIES = 3  # times as long a block as the differences of squared errors are correlated
_FEWEST = 8  # blocks for a standard error
# Rows of an experiment: so many give the score of its prediction to about a percent
_MOST_PREDICTED = 10_000
_SURE = 2.0  # standard errors


def score_part(
    model: Model, part: Part, warnings: list[Warning], *, whole: bool = False
) -> tuple[PartScores, tuple[Response, Response]]:
    """Return the scores of a part, and the responses that they come from.

    A missing score adds a warning.

    Args:
        whole: predict every row one step ahead, also where each has a state of its own to estimate
            and they are many.
    """
    starts = model.starts
    ahead = model
    if isinstance(starts, EstimatedStates) and not whole:
        ahead = replace(model, starts=replace(starts, most=_MOST_PREDICTED))
    responses = ahead.predict(part.record), model.simulate(part.record)
    if part.source is not None:
        return _score_along(model, part, warnings), responses
    scores = {}
    for kind, response in zip(("prediction", "simulation"), responses, strict=True):
        runaway = next((t.diverged for t in response.trajectories if t.diverged), None)
        scored = response.scores(part.skips)
        scores[kind] = ScoreResult() if runaway is not None else scored
        if runaway is not None:
            step, output = runaway
            text = (
                f"{part.name}: the free run diverged in output '{output}' at step {step}; no "
                "simulation scores."
            )
            warnings.append(Warning("free_run_diverged", text))
        elif np.isnan(scored.rmse).any():
            warnings.append(
                Warning(
                    "not_finite", f"{part.name}: the {kind} is not finite on some rows; no scores."
                )
            )
        elif np.isnan(scored.nrmse).any():
            text = (
                f"{part.name}: an output is constant over the scored samples; no NRMSE and FIT "
                f"of its {kind}."
            )
            warnings.append(Warning("constant_output", text))
    return PartScores.model_validate(scores), responses


def equal_within_noise(one: Response, other: Response, skips: Sequence[int]) -> bool:
    """Return whether the mean squared errors of two responses to one part differ by chance alone.

    The differences of the squares, of all outputs in their deviations, have a standard error from
    means of blocks that are three times as long as their correlation (batch means). Where it lasts
    too long for blocks, nothing is known: then the answer is no.

    Args:
        one, other: responses of two models.
        skips: leading rows of each experiment that are not scored.
    """
    measured = [t.measured for t in one.trajectories if t.measured is not None]
    if len(measured) < len(one.trajectories) or len(measured) != len(other.trajectories):
        return False
    deviation = positive(np.nanstd(np.concatenate(measured), axis=0))
    apart = []
    for a, b, y, skip in zip(one.trajectories, other.trajectories, measured, skips, strict=True):
        first = max(a.start, b.start, skip)
        squares = [np.nansum(((y - run.model) / deviation)[first:] ** 2, axis=1) for run in (a, b)]
        apart.append(squares[0] - squares[1])
    if not all(np.isfinite(own).all() for own in apart) or not any(map(len, apart)):
        return False
    longest = max(map(len, apart))
    stacked = np.array([np.pad(own, (0, longest - len(own))) for own in apart])
    if not stacked.any():
        return True
    length = correlation_length(stacked)
    if length is None:
        return False
    means = [
        block.mean()
        for own in apart
        for block in np.array_split(own, max(len(own) // (_MEMORIES * length), 1))
        if len(block)
    ]
    if len(means) < _FEWEST:
        return False
    error = np.std(means, ddof=1) / np.sqrt(len(means))
    return bool(abs(np.mean(np.concatenate(apart))) <= _SURE * error)


def _score_along(model: Model, part: Part, warnings: list[Warning]) -> PartScores:
    """Return scores and residual tests over all rows of a part that is kept as a subsample."""
    assert part.source is not None
    whole = len(part.record) == rows_of(part.source)  # its tests are those of the result
    residual = RunningResidual([c.name for c in model.outputs], [c.name for c in model.inputs])
    found = scores_along(model, part.source, part.skip, None if whole else residual.watch)
    if found.diverged is not None:
        file, row, output = found.diverged
        text = (
            f"{part.name}: the free run diverged in output '{output}' at row {row} of {file}; "
            "no simulation scores."
        )
        warnings.append(Warning("free_run_diverged", text))
    simulation = ScoreResult() if found.diverged is not None else found.simulation
    tests = residual.tests() or None
    return PartScores.model_validate(
        {"prediction": found.prediction, "simulation": simulation, "residual": tests}
    )
