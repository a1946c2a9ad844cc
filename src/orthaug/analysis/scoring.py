"""Scores of a model on a part of the data: one step ahead, and on the free run."""

from __future__ import annotations

import numpy as np

from orthaug._base.errors import Warning
from orthaug.analysis.fit_findings import PartScores, ScoreResult
from orthaug.analysis.residuals import RunningResidual
from orthaug.data.part import Part
from orthaug.data.sources import rows_of
from orthaug.models.long_runs import scores_along
from orthaug.models.model import Model
from orthaug.models.response import Response


def score_part(
    model: Model, part: Part, warnings: list[Warning]
) -> tuple[PartScores, tuple[Response, Response]]:
    """Return the scores of a part, and the responses that they come from.

    A missing score adds a warning.
    """
    responses = model.predict(part.record), model.simulate(part.record)
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
