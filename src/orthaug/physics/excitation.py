"""Excitation and identifiability: do the data, and could any data, determine θ?

Identifiability is the rank of φ at random regressor points, a property of the physics alone;
excitation is the rank of φ on the measured rows (assumption `assum:phi_full_rank`). The first can
hold without the second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthaug._base.checks import Matrix
from orthaug._base.errors import RankError
from orthaug._base.lines import plural
from orthaug.data.regressors import Layout
from orthaug.physics.baseline import Baseline
from orthaug.physics.projection import Projection

RANK_TOLERANCE = 1e-13  # σmin/σmax of the unit-norm columns below which Φ counts as rank-deficient


@dataclass(frozen=True, eq=False)
class Excitation:
    """Rank and condition number of rows of φ, and the columns that depend on each other."""

    rank: int
    columns: int
    condition: float | None
    collinear: tuple[tuple[str, ...], ...]

    @property
    def full_rank(self) -> bool:
        return self.rank == self.columns


GRAM_TOLERANCE = 3e-6
"""`RANK_TOLERANCE` where only a Gram matrix is known: its rounding hides singular values below."""


def excitation(r: Matrix, names: Sequence[str], tolerance: float = RANK_TOLERANCE) -> Excitation:
    """Return rank and condition of a matrix from its R factor (or itself), columns scaled to 1.

    The condition number is σmax/σmin of the scaled columns, None where it is infinite. A group
    holds the columns that a null direction ties: nothing in the data can separate their
    parameters.
    """
    columns = len(names)
    if columns == 0:
        return Excitation(0, 0, None, ())
    norms = np.linalg.norm(r, axis=0)
    scaled = r / np.where(norms > 0, norms, 1.0)
    _, sigma, vt = np.linalg.svd(scaled, full_matrices=True)
    sigma = np.concatenate([sigma, np.zeros(columns - len(sigma))])
    rank = int(np.sum(sigma > tolerance * sigma[0])) if sigma[0] > 0 else 0
    condition = float(sigma[0] / sigma[-1]) if rank == columns else None
    return Excitation(
        rank,
        columns,
        condition,
        tuple(tuple(names[i] for i in group) for group in tied_columns(vt[rank:])),
    )


def of_gram(gram: Matrix, names: Sequence[str]) -> Excitation:
    """Return `excitation` from the Gram matrix of the columns."""
    norms = np.sqrt(np.maximum(np.diag(gram), 0.0))
    unit = np.where(norms > 0, norms, 1.0)
    values, vectors = np.linalg.eigh(gram / np.outer(unit, unit))
    return excitation(
        np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T * unit, names, GRAM_TOLERANCE
    )


def tied_columns(directions: Matrix, part: float = 1e-6) -> list[list[int]]:
    """Return sets of columns tied by some orthonormal directions.

    They are the connected components of the directions' projector.

    Args:
        directions: one a row.
        part: entry of the projector above which columns are tied.
    """
    tied = np.abs(directions.T @ directions) > part
    groups, seen = [], set()
    for start in range(len(tied)):
        if start in seen or not tied[start, start]:
            continue
        group, frontier = {start}, [start]
        while frontier:
            new = {int(i) for i in np.flatnonzero(tied[frontier.pop()])} - group
            group |= new
            frontier.extend(new)
        seen |= group
        groups.append(sorted(group))
    return groups


def require_rank(excited: Excitation, rows: int) -> None:
    """Raise RankError where θ is not determined, naming the parameters that no data separate."""
    if rows < excited.columns:
        raise RankError(
            f"{plural(rows, 'usable row')} for {excited.columns} parameters; give at least as "
            "many rows as parameters."
        )
    if excited.full_rank:
        return
    groups = "; ".join(
        f"the column of {group[0]} is zero"
        if len(group) == 1
        else f"the columns of {', '.join(group)} are linearly dependent"
        for group in excited.collinear
    )
    raise RankError(
        f"the physics is rank-deficient on the data (rank {excited.rank} of "
        f"{excited.columns}): {groups}. Remove or fix one of them, or use data that excite "
        "them separately."
    )


def identifiability(
    baseline: Baseline, layout: Layout, outputs: Sequence[str], x: Matrix
) -> Excitation:
    """Return the rank of φ at random points of a box twice as wide as the data's.

    Where the data do not move, the box has width 1.

    Args:
        baseline: φ and the names of θ.
        layout: what the columns of `x` are, `Lags(…).layout(outputs, inputs)`.
        outputs: names of the outputs, in order.
        x: regressors (N, nx), only for their ranges. The points are the same on every call.

    Examples:
        >>> from orthaug.data.regressors import Lags
        >>> from orthaug.physics.baseline import Term
        >>> twice = Baseline.from_terms([Term("a", "y[k-1]"), Term("b", "2*y[k-1]")])
        >>> layout = Lags(na=1).layout(["y"], [])
        >>> identifiability(twice, layout, ["y"], np.array([[0.0], [1.0]])).rank
        1
    """
    nt = len(baseline.names)
    if not nt:
        return excitation(np.zeros((0, 0)), ())
    low, high = x.min(axis=0), x.max(axis=0)
    halfwidth = np.where(high > low, high - low, 1.0)
    points = (low + high) / 2 + halfwidth * np.random.default_rng(0).uniform(
        -1, 1, (50 * nt + 200, len(layout))
    )
    with np.errstate(all="ignore"):
        phi = np.asarray(baseline.phi(points, layout, outputs, np))
    finite = np.isfinite(phi).all(axis=(1, 2))  # a logarithm or a root has no value at some of them
    if finite.sum() < nt:
        return excitation(np.zeros((1, nt)), baseline.names)
    return excitation(Projection.factor(phi[finite]).r, baseline.names)
