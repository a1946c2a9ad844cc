"""Forward orthogonal least squares on normal equations.

Each pick is the column that lowers the error most beside those chosen before.

Chen, Billings and Luo (1989), on Gram matrices: each pick is projected out of all others, so what a
column would lower the squared error by is its right-hand side squared over what is left of its norm
(the error-reduction ratio).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from orthaug._base.checks import Matrix, Vector

DEPENDENT = 1e-9
"""Share of a column's squared norm: where less of it is left beside the others, it is a combination
of them.
"""


COLLINEAR = 0.05
"""Share of a column's deviation: where less is left beside the others, it lies within their span,
near enough.

One column widens the standard error of another by at most one over what is left of it, here twenty
times. On records of a slow plant with a persistent input (`benchmarks/selection.py collinear`)
terms widened a standard error up to 46 times without a limit, 28 with this one and 11 with twice as
much, at 0.78, 0.79 and 0.80 of the error of physics alone on the blocks; but with twice as much the
free run on Silverbox's arrow errs by a sixth more.
"""


class Equations(NamedTuple):
    """Normal equations `H p = b` of `‖y − S p‖²`: `H = SᵀS`, `b = Sᵀy`, `square = ‖y‖²`."""

    hessian: Matrix
    right: Vector
    square: float
    rows: int

    @classmethod
    def sum_of(cls, parts: Iterable[Equations]) -> Equations:
        """Return the equations over the rows of all parts."""
        hessian, right, square, rows = (sum(part) for part in zip(*parts, strict=True))
        return cls(np.asarray(hessian), np.asarray(right), float(square), int(rows))

    def of(self, columns: Sequence[int]) -> Equations:
        """Return the equations of some of the columns, in that order."""
        picked = np.asarray(columns, dtype=int)
        return self._replace(hessian=self.hessian[np.ix_(picked, picked)], right=self.right[picked])

    def among(self, columns: Sequence[int], count: int) -> Equations:
        """Return the equations as these of `count` columns, of which the others are zero."""
        picked, hessian, right = (
            np.asarray(columns, dtype=int),
            np.zeros((count, count)),
            np.zeros(count),
        )
        hessian[np.ix_(picked, picked)], right[picked] = self.hessian, self.right
        return self._replace(hessian=hessian, right=right)

    @property
    def _unit(self) -> Vector:
        """Factors that give columns of unit norm."""
        size = np.sqrt(np.maximum(np.diag(self.hessian), 0.0))
        return 1 / np.where(size > 0, size, 1.0)

    def scaled(self) -> Equations:
        """Return the equations with columns of unit norm."""
        unit = self._unit
        return self._replace(hessian=self.hessian * np.outer(unit, unit), right=self.right * unit)

    def solve(self) -> Vector:
        """Return p, the shortest where columns depend on each other."""
        scaled = self.scaled()
        return self._unit * np.linalg.lstsq(scaled.hessian, scaled.right, rcond=1e-14)[0]

    def miss(self, p: Vector) -> float:
        """Return `‖y − S p‖²`."""
        return float(self.square - 2 * p @ self.right + p @ self.hessian @ p)


class ForwardStep(NamedTuple):
    """A column that was picked, and the share of the squared error left that it takes away."""

    column: int
    share: float


def forward(
    equations: Equations,
    known: Collection[int],
    most: int,
    *,
    least: float = 0.0,
    within: float = 0.0,
    constant: int | None = None,
) -> list[ForwardStep]:
    """Pick up to `most` columns, one after another, beside those that are `known`.

    Args:
        least: share of the squared error left that a column must take away.
        within: share of a column's deviation; one of which less is left lies within the span of
            those that are in.
        constant: the column of a constant, beside which a column's deviation is what is left; None
            for its norm.
    """
    gram, right, square, _ = equations.scaled()
    gram, right, square = gram.copy(), right.copy(), float(square)
    size = np.diag(gram).copy()
    deviation = within**2 * _deviations(gram, constant)
    out = np.zeros(len(gram), dtype=bool)

    def project_out(column: int) -> float:
        nonlocal gram, right, square
        out[column] = True
        left = gram[column, column]
        if left <= DEPENDENT * size[column] or left <= 0:
            return 0.0
        slope, gain = gram[:, column] / left, right[column] ** 2 / left
        right = right - slope * right[column]
        gram = gram - np.outer(slope, gram[column])
        square -= gain
        return float(gain)

    for column in known:
        project_out(column)
    picks: list[ForwardStep] = []
    while len(picks) < most:
        left = np.diag(gram)
        able = (left > np.maximum(DEPENDENT * size, deviation)) & (left > 0) & ~out
        gains = np.where(able, right**2 / np.where(able, left, 1.0), 0.0)
        best, before = int(np.argmax(gains)), max(square, 1e-300)
        if not able.any() or gains[best] <= least * before or gains[best] <= 0:
            break
        picks.append(ForwardStep(best, float(min(project_out(best) / before, 1.0))))
    return picks


def _deviations(gram: Matrix, constant: int | None) -> Vector:
    """Return the squared norms of columns beside a constant; of the constant itself its own."""
    size = np.diag(gram).copy()
    if constant is None or size[constant] <= 0:
        return size
    beside = np.maximum(size - gram[constant] ** 2 / size[constant], 0.0)
    beside[constant] = size[constant]
    return beside


def spanned_columns(
    equations: Equations, known: Sequence[int], within: float, constant: int | None
) -> list[int]:
    """Return the columns with less than `within` of their deviation outside the `known` ones."""
    gram = equations.scaled().hessian
    size, known = np.diag(gram), list(known)
    across = gram[known]
    left = size - np.einsum(
        "ij,ij->j", across, np.linalg.pinv(gram[np.ix_(known, known)], hermitian=True) @ across
    )
    inside = (left < within**2 * _deviations(gram, constant)) & (size > 0)
    return [i for i in np.flatnonzero(inside).tolist() if i not in set(known)]
