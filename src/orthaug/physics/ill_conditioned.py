"""Parameters of which the data determine a combination only: nearly dependent columns.

Columns of a well-sampled record are nearly dependent as a rule (`y[k-1]` and `y[k-2]`, powers of
one signal), and harmless while the parameters are known. So a small singular value alone is no
finding, except where it takes half of the digits. It is one where few columns nearly cancel, and
where that costs what was to be estimated: of `β_i = ‖φ_i‖ θ_i`, which each column contributes to
the outputs, a combination is known to no more than the outputs themselves move, and at least two of
its parameters are not clearly different from 0.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import Warning
from orthaug.physics.excitation import GRAM_TOLERANCE, RANK_TOLERANCE, tied_columns
from orthaug.physics.problem import MotionProblem, Problem

_HALF_OF_THE_DIGITS = 1e-8  # σ/σmax of the unit-norm columns
_NEARLY = 1e-4  # σ/σmax from which on dependence alone may be what hides a parameter
_FEW = 2.5
# independent columns of a set that nearly cancels; polynomials spread over more, and want no term
# fixed
_CLEARLY = 4.0  # standard errors from zero
# Of the projector onto the nearly dependent directions: a column that takes part in one
_PART = 0.01


def of_physics(
    problem: Problem, theta: Vector | None = None, covariance: Matrix | None = None
) -> list[Warning]:
    """Return the warning `ill_conditioned` of lagged physics.

    By least squares without a learner where none is fitted.

    Args:
        problem: with Φ of full rank.
        theta: (nθ,) as it was fitted, with its `covariance`; NaN there counts as no error.
    """
    names = problem.baseline.names
    if not names or not problem.excitation.full_rank:
        return []
    if theta is None or covariance is None:
        left = problem.samples - len(names)
        variance = problem.unexplained_moments.square / left if left > 0 else 0.0
        factor = problem.projection.covariance_factor()
        theta, covariance = problem.least_squares, variance * factor @ factor.T
    moves = problem.count * np.trace(problem.weight.whitened(problem.target_covariance))
    return _warnings(
        problem.projection.to_coordinates, names, covariance, np.abs(theta), moves, RANK_TOLERANCE
    )


def of_motion(problem: MotionProblem, gram: Matrix, q: Vector, noise: Matrix) -> list[Warning]:
    """Return the warning `ill_conditioned` of a motion.

    Args:
        gram: of the sensitivities of the whitened outputs to the parameters' coordinates (np, np).
        q: the coordinates; a logarithm is not clear where its parameter is not known to a quarter.
        noise: covariance of the errors in the outputs' units (ny, ny).
    """
    motion, weight = problem.motion, problem.weight
    if not np.isfinite(gram).all() or not gram.any():
        return []
    size = np.sqrt(np.maximum(np.diag(gram), 0.0))
    unit = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(gram / np.outer(unit, unit))
    sigma = np.sqrt(np.maximum(values, 0.0))
    sigma = np.maximum(sigma, GRAM_TOLERANCE * sigma[-1])  # what is below is rounding
    root = sigma[:, None] * vectors.T * unit
    inverse = (vectors / sigma) / unit[:, None]
    outputs = np.concatenate([experiment.outputs for experiment in problem.record.experiments])
    moves = float(np.sum((weight.rows(outputs) - weight.rows(outputs).mean(axis=0)) ** 2))
    variance = float(np.trace(weight.whitened(noise))) / len(noise)
    scale = np.where(motion.coordinates.positive, 1.0, np.abs(q))
    return _warnings(
        root, motion.names, variance * inverse @ inverse.T, scale, moves, 1.01 * GRAM_TOLERANCE
    )


def _warnings(
    root: Matrix,
    names: Sequence[str],
    covariance: Matrix,
    scale: Vector,
    moves: float,
    finest: float,
) -> list[Warning]:
    """Return a warning for each set of columns that nearly cancel.

    Args:
        root: R with RᵀR the Gram matrix of the columns; columns of zeros take part in nothing.
        scale: what a standard error is compared with.
        moves: sum of squares of what the outputs move by.
        finest: smallest σ/σmax that `root` shows.
    """
    size = np.linalg.norm(root, axis=0)
    _, sigma, vt = np.linalg.svd(root / np.where(size > 0, size, 1.0))
    small = sigma / sigma[0]
    contributions = np.nan_to_num(covariance) * np.outer(size, size)
    spread = np.sum((vt @ contributions) * vt, axis=1)
    unclear = _CLEARLY * np.sqrt(np.diag(contributions)) > size * scale
    vague = vt[(small < _NEARLY) & (spread > moves)]
    groups: list[list[int]] = []
    for group in tied_columns(vague, _PART):
        independent = len(group) - np.sum(vague[:, group] ** 2)
        if independent < _FEW and np.sum(unclear[group]) > 1:
            groups.append(group)
    taken = {i for group in groups for i in group}
    groups += [
        g for g in tied_columns(vt[small < _HALF_OF_THE_DIGITS], _PART) if not taken & set(g)
    ]
    found = []
    for group in groups:
        inflation = np.sqrt(np.sum((vt[:, group] / sigma[:, None]) ** 2, axis=0)).max()
        listed = ", ".join(names[int(i)] for i in group)
        least = "at least " if small[-1] <= finest else ""
        text = (
            f"the physics is ill-conditioned on the data (condition {least}{1 / small[-1]:.1e} "
            f"of the scaled columns): the data hardly distinguish {listed}. The effect of one "
            f"is a combination of the effects of the others to {least}1 part in "
            f"{inflation:.1e}. Its standard error is larger by this factor. Fix one of them, "
            "merge them into one parameter, or use data that excite them separately."
        )
        found.append(Warning("ill_conditioned", text))
    return found
