"""Several trained learners as one model: the median of their predictions, entry by entry.

Members differ in how they share a function between physics and learner (F2), so each is taken with its own `c_i`:
`g = φ c̄ + median_i(f_i + φ (c_i − c̄))`. The median is again one function of the regressor, split like any other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from orthaug.fitting.free_run import FreeRun
from orthaug.fitting.learned import Learned
from orthaug.fitting.one_step import Task


def combine(task: Task | FreeRun, members: Sequence[Learned], best: int) -> Learned:
    """The median of `members`; statistics that the median has none of its own of are those of the `best` member."""
    problem = task.problem
    projection, weight = problem.projection, problem.weight
    chosen = members[best]
    coefficients = []
    for member in members:
        solved = projection.solve(problem.whitened_target - member.values * weight)
        coefficients.append(solved if member.coefficients is None else member.coefficients)
    centre = np.mean(coefficients, axis=0)
    tilt = np.array(coefficients) - centre
    physics = np.einsum("kit,mt->mki", projection.phi / weight[:, None], tilt)
    weights = np.stack([member.weights for member in members])
    free = chosen.free
    if free is not None and isinstance(task, FreeRun):
        free = free._replace(mean_square=task.mean_square(centre, weights, tilt))
    return replace(
        chosen,
        weights=weights,
        tilt=tilt,
        values=np.median([member.values + own for member, own in zip(members, physics, strict=True)], axis=0),
        effective=float(np.mean([member.effective for member in members])),
        gram=None,
        coefficients=centre if chosen.coefficients is not None else None,
        free=free,
    )
