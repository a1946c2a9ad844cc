"""Outputs weighted by the covariance of their errors, one step ahead: fit and weights in turn until they agree.

Weights, criterion and measure stay one inner product at every turn, so θ is solved exactly in each (F1). For physics
alone this is iterated feasible generalised least squares.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from orthaug._base.errors import Warning
from orthaug.fitting.estimates import Estimate
from orthaug.inference.covariance import whitening
from orthaug.physics.output_weights import by_covariance
from orthaug.physics.problem import Problem

_TURNS = 30
_SETTLED = 1e-6  # relative change of W


def reweighted(first: Estimate, again: Callable[[Problem, Estimate], Estimate]) -> Estimate:
    """The fit whose outputs are weighted by the covariance of its own errors.

    Args:
        first: a fit with any output weights.
        again: the fit of a problem with other weights, begun from an earlier estimate.

    Returns:
        The last fit, with the restarts of the first one. It stays at the weights it has where the errors' covariance is
        singular; a warning tells that the turns did not settle.
    """
    estimate, problem = first, first.problem
    covariance = problem.target_covariance
    for _ in range(_TURNS):
        noise = estimate.model.statistics.noise if estimate.status.ok else None
        white = None if noise is None else whitening(noise)
        if white is None:
            return replace(estimate, restarts=first.restarts)
        weight = by_covariance(white, covariance)
        change = np.linalg.norm(weight.matrix - problem.weight.matrix) / np.linalg.norm(weight.matrix)
        if change <= _SETTLED:
            return replace(estimate, restarts=first.restarts)
        problem = problem.weighed(weight)
        estimate = again(problem, estimate)
    text = (
        f"the weights of the outputs still change by {change:.1g} after {_TURNS} fits; θ depends on where they stopped."
    )
    told = (*estimate.warnings, Warning("output_weights_unsettled", text))
    return replace(estimate, restarts=first.restarts, warnings=told)
