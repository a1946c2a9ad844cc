"""`orthogonalize`: a model trained elsewhere, split into physics and an orthogonal rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from orthaug._base.checks import check_type
from orthaug.data.record import Record
from orthaug.data.regressors import Features, Lags
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.fitting.learned import TrainedLearner
from orthaug.fitting.one_step import OneStepTask
from orthaug.fitting.structures import Orthogonal
from orthaug.models.learners import Bound, External, Function, Scaling
from orthaug.physics.baseline import Baseline
from orthaug.physics.problem import pose


def orthogonalize(
    record: Record, baseline: Baseline, function: Callable[[Any], Any], lags: Lags | None = None
) -> LaggedEstimate:
    """Split a model trained elsewhere into physics and an orthogonal rest.

    Args:
        record: the rows over which the rest is made orthogonal, usually the training data.
        baseline: the physics.
        function: `g(x)` on NumPy regressors (N, nx) in `Lags` order, giving (N, ny); from any
            toolbox.
        lags: the regressor that `function` expects; None for the raw lags of the baseline.

    Returns:
        An estimate whose model predicts what `function` does: θ is the least-squares fit of the
        physics to it, and the learner what that leaves, `g − φθ`. There are no standard errors:
        they belong to how `function` was trained.
    """
    check_type(baseline, Baseline, "baseline", "physics in lagged values, a Baseline")
    problem = pose(record, baseline, lags)
    ny, nz = len(problem.outputs), len(problem.features.entries)
    external = External(function, ny=ny)
    values = external.values(problem.feature_rows())  # once; the sums below read what it gave
    scaling, unit = Scaling(np.zeros(nz), np.ones(nz)), np.ones(ny)
    task = OneStepTask.of(replace(problem, features=Features(())), None)
    gain = np.broadcast_to(problem.weight.matrix / task.rms, (*values.shape, ny))
    rows = task.engine.build_rows(
        values, problem.projection.q, problem.unexplained / task.rms, gain
    )
    task = replace(task, problem=problem, rows=rows, unit=unit, bound=Bound(_GIVEN, ny, ny))
    learned = TrainedLearner(task.bound, np.zeros(0), scaling, unit, elsewhere=True)
    concluded = task.conclude(Orthogonal(), learned)
    form = replace(concluded.model.form, bound=Bound(external, nz, ny))
    return replace(concluded, model=replace(concluded.model, form=form))


_GIVEN = Function(lambda w, z: z, lambda key: (), beyond="free")
"""The learner whose values are its features."""
