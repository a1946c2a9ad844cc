"""How wide a network, and what it should see: judged by free runs on blocks that were held out."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from orthaug._base.errors import InputError
from orthaug.data.regressors import Lags
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.estimation import estimate
from orthaug.fitting.held_out import blocked, mean_square, squared_errors
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.models.learners import MLP
from orthaug.physics.problem import Problem
from orthaug.selection.nonlinearity import Nonlinearity
from orthaug.selection.term_path import PathModel, Search, Told
from orthaug.selection.term_runs import Point

_ITERATIONS = 40  # of a network on a fold


@dataclass(frozen=True, eq=False)
class LearnerSearch(Search):
    """Networks, physics alone first."""

    learners: tuple[MLP | None, ...]

    @property
    def chosen(self) -> MLP | None:
        """That of the choice; None for physics alone."""
        return self.learners[self.place]


def search_learners(
    problem: Problem,
    lags: Lags,
    tested: Nonlinearity | None,
    learner: MLP,
    widths: Sequence[int],
    criterion: Criterion,
    blocks: int,
    told: Told,
    runner: Any,
) -> LearnerSearch:
    """Judge every width on all lags, and on those whose functions matter by themselves.

    Raises:
        InputError: too few rows for so many blocks.
    """
    record, baseline = problem.record, problem.baseline
    seen: list[tuple[str, ...] | None] = [learner.inputs]
    if tested is not None and tested.matter and learner.inputs is None:
        seen.append(tested.matter)
    tried: list[MLP | None] = [None]
    tried += [replace(learner, hidden=(width,), inputs=inputs) for inputs in seen for width in widths]
    folds = blocked(record, blocks, max(problem.first_row, _largest(lags)))
    names = tuple(channel.name for channel in record.outputs), tuple(channel.name for channel in record.inputs)
    given, rungs = (baseline, lags, criterion, folds), []
    found = runner.map(_on_fold, given, [(one, i) for one in tried for i in range(len(folds))])
    for one in tried:
        held, seconds = zip(*islice(found, len(folds)), strict=True)
        nz = 0 if one is None else len(one.inputs if one.inputs is not None else lags.layout(*names))
        size = 0 if one is None else one.weights(nz, 1)
        words = () if one is None else (f"{one.hidden[0]} neurons of {', '.join(one.inputs or ('all lags',))}",)
        rungs.append(PathModel(Point((), np.zeros(0), np.zeros(0)), words, np.array(held), sum(seconds), size))
        try:
            told(rungs[-1])
        except KeyboardInterrupt:
            break
    return LearnerSearch(tuple(rungs), tuple(tried[: len(rungs)]))


def _largest(lags: Lags) -> int:
    nb, nk = (np.atleast_1d(part) for part in (lags.nb, lags.nk))
    return int(max(np.max(lags.na, initial=0), np.max(nb + nk - 1, initial=0)))


def _on_fold(given: Any, item: tuple[MLP | None, int], tell: Callable[..., None]) -> tuple[float, float]:
    """Mean squared error of free runs on a block of a fit without it, infinite without a model; and seconds."""
    began, (learner, number), (baseline, lags, criterion, folds) = time.monotonic(), item, given
    kept, held = folds[number]
    options = {"solver": LevenbergMarquardt(_ITERATIONS), "blocks": 0, "fallback": False, "criterion": criterion}
    if learner is not None:
        options |= {"lags": lags, "regularization": "evidence"}
    error = np.inf
    with suppress(InputError):  # the block took away what the physics needs
        fit = estimate(kept, baseline, learner=learner, **options)
        error = mean_square(squared_errors(fit.model.simulate(held), 1.0)) if fit.status.ok else np.inf
    return error, time.monotonic() - began
