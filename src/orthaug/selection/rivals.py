"""Rivals of a chosen term: candidates beside which it is not significant.

The products of lagged signals are like each other. Where the wrong one of two is chosen its
coefficient is not zero: it is the best in the model without the other, and its interval holds that.
So of each term all candidates are asked that encompass it, in the sense of Mizon and Richard
(1986): with one of them in the model the term has nothing left to do.
"""

from __future__ import annotations

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug.inference.covariance import reach
from orthaug.selection.forward import DEPENDENT
from orthaug.selection.kept_physics import standard_errors
from orthaug.selection.term_runs import Point, TermRuns

_LISTED = 3


def rivals(runs: TermRuns, point: Point) -> dict[str, tuple[str, ...]]:
    """Return, best first, the candidates beside which a term significant at 5 % is not so."""
    nt, texts = len(point.c), runs.library.texts
    equations = runs.equations(point)
    known = [*range(nt), *(nt + i for i in point.chosen)]
    own = equations.of(known)
    stds, freedom = standard_errors(runs, point, own)
    size = np.sqrt(np.maximum(np.diag(equations.hessian), 1e-300))
    hessian, right = equations.hessian / np.outer(size, size), equations.right / size
    variance = (
        max(own.miss(own.solve()), 0.0)
        / max(own.rows - len(known), 1)
        / runs.independent_share(point)
    )
    least = reach(freedom) ** 2 * variance
    found = {}
    for place, i in enumerate(point.chosen):
        std = stds[nt + place]
        if std is None or abs(point.w[place]) < reach(freedom) * std:
            continue
        others = [column for column in known if column != nt + i]
        gram, left = _project_out(hessian, right, others)
        gains, kept = _gains_with_each(gram, left, nt + i)
        able = [k for k in np.flatnonzero(kept < least) if k not in known]
        able.sort(key=lambda k: -gains[k])
        if able:
            found[texts[i]] = tuple(texts[k - nt] for k in able[:_LISTED])
    return found


def _project_out(hessian: Matrix, right: Vector, known: list[int]) -> tuple[Matrix, Vector]:
    """Return the equations with some columns projected out."""
    across = hessian[:, known] @ np.linalg.pinv(
        hessian[np.ix_(known, known)], rcond=1e-12, hermitian=True
    )
    return hessian - across @ hessian[known], right - across @ right[known]


def _gains_with_each(gram: Matrix, right: Vector, column: int) -> tuple[Vector, Vector]:
    """Return the fall of the squared error by each column, and by a given one beside each."""
    size = np.diag(gram)
    able = size > DEPENDENT  # of columns of norm 1
    safe = np.where(able, size, 1.0)
    left = size[column] - gram[column] ** 2 / safe
    error = right[column] - gram[column] * right / safe
    gains = np.where(left > DEPENDENT, error**2 / np.where(left > DEPENDENT, left, 1.0), 0.0)
    return np.where(able, right**2 / safe, 0.0), np.where(able, gains, np.inf)
