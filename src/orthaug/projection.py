"""The projection onto the physics: a scaled QR of Φ, made once and used for θ̂, θ_aux and P⊥.

Everything here is orthogonal factorisation; `ΦᵀΦ` is never formed, let alone inverted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from jaxtyping import Float

from orthaug._arrays import Matrix, Vector
from orthaug.errors import RankError

RANK_TOLERANCE = 1e-13  # σmin/σmax of the unit-norm columns below which Φ counts as rank-deficient


@dataclass(frozen=True, eq=False)
class Projection:
    """Φ = Q R with its columns scaled by powers of two (exact), over rows weighted per output.

    `q` (N, ny, nθ) has orthonormal columns, `r` (nθ, nθ) is upper triangular and `scale` (nθ,) holds
    the powers: `Φ scale = q r`.
    """

    phi: Float[np.ndarray, "N ny nt"]
    q: Float[np.ndarray, "N ny nt"]
    r: Float[np.ndarray, "nt nt"]
    scale: Vector

    @classmethod
    def factor(cls, phi: Float[np.ndarray, "N ny nt"]) -> Projection:
        """Householder QR of the stacked (N·ny, nθ) matrix."""
        rows, ny, nt = phi.shape
        if nt == 0:
            return cls(phi, phi, np.zeros((0, 0)), np.zeros(0))
        stacked = phi.reshape(rows * ny, nt)
        largest = np.abs(stacked).max(axis=0, initial=0.0)
        scale = np.where(largest > 0, 2.0 ** -np.round(np.log2(np.where(largest > 0, largest, 1.0))), 1.0)
        q, r = scipy.linalg.qr(stacked * scale, mode="economic", overwrite_a=True, check_finite=False)
        return cls(phi, np.ascontiguousarray(q).reshape(rows, ny, -1), r, scale)

    def coordinates(self, values: Float[np.ndarray, "N ny"]) -> Vector:
        """Qᵀv, (nθ,): the part of stacked outputs that the physics can express."""
        return np.tensordot(self.q, values, axes=([0, 1], [0, 1]))

    def solve(self, values: Float[np.ndarray, "N ny"]) -> Vector:
        """Φ⁺v, (nθ,), refined once: θ̂ for outputs (F1), θ_aux for a learner's values (eq:theta_aux)."""
        theta = self.from_coordinates(self.coordinates(values))
        return theta + self.from_coordinates(self.coordinates(values - self.phi @ theta))

    def from_coordinates(self, coordinates: Vector) -> Vector:
        """θ of coordinates in the basis Q: `R⁻¹q`."""
        if not coordinates.size:
            return coordinates
        return self.scale * scipy.linalg.solve_triangular(self.r, coordinates, check_finite=False)

    def orthogonal_part(self, values: Float[np.ndarray, "N ny"]) -> Float[np.ndarray, "N ny"]:
        """P⊥v = v − QQᵀv, projected twice so that what is left is orthogonal to rounding."""
        for _ in range(2):
            values = values - self.q @ self.coordinates(values)
        return values

    def covariance_factor(self) -> Float[np.ndarray, "nt nt"]:
        """`R⁻¹` with the scaling undone: a factor L with `L Lᵀ = (ΦᵀΦ)⁻¹`."""
        if not self.scale.size:
            return np.zeros((0, 0))
        inverse = scipy.linalg.solve_triangular(self.r, np.eye(len(self.r)), check_finite=False)
        return self.scale[:, None] * inverse


@dataclass(frozen=True, eq=False)
class Excitation:
    """How well rows of φ determine θ: rank, condition number and which columns depend on each other."""

    rank: int
    columns: int
    condition: float | None
    collinear: tuple[tuple[str, ...], ...]

    @property
    def full_rank(self) -> bool:
        return self.rank == self.columns


def excitation(r: Matrix, names: Sequence[str]) -> Excitation:
    """Rank and condition of a matrix from its R factor (or itself), columns scaled to unit norm.

    The condition number is σmax/σmin of the scaled columns, None where it is infinite. Columns that a
    null direction involves are grouped: nothing in the data can tell their parameters apart.
    """
    columns = len(names)
    if columns == 0:
        return Excitation(0, 0, None, ())
    norms = np.linalg.norm(r, axis=0)
    scaled = r / np.where(norms > 0, norms, 1.0)
    _, sigma, vt = np.linalg.svd(scaled, full_matrices=True)
    sigma = np.concatenate([sigma, np.zeros(columns - len(sigma))])
    rank = int(np.sum(sigma > RANK_TOLERANCE * sigma[0])) if sigma[0] > 0 else 0
    condition = float(sigma[0] / sigma[-1]) if rank == columns else None
    return Excitation(rank, columns, condition, _groups(vt[rank:], names))


def _groups(null_space: Matrix, names: Sequence[str]) -> tuple[tuple[str, ...], ...]:
    """Sets of columns tied by null directions: connected components of the null-space projector."""
    tied = np.abs(null_space.T @ null_space) > 1e-6
    groups, seen = [], set()
    for start in range(len(names)):
        if start in seen or not tied[start, start]:
            continue
        group, frontier = {start}, [start]
        while frontier:
            new = set(np.flatnonzero(tied[frontier.pop()])) - group
            group |= new
            frontier.extend(new)
        seen |= group
        groups.append(tuple(names[i] for i in sorted(group)))
    return tuple(groups)


def require_rank(found: Excitation, rows: int) -> None:
    """Raise RankError where θ is not determined, naming the parameters that cannot be told apart."""
    if rows < found.columns:
        raise RankError(f"{rows} usable rows for {found.columns} parameters; give at least as many rows as parameters.")
    if found.full_rank:
        return
    groups = "; ".join(
        f"the column of {group[0]} is zero" if len(group) == 1 else f"the columns of {', '.join(group)} are linearly dependent"
        for group in found.collinear
    )
    raise RankError(
        f"the physics is rank-deficient on the data (rank {found.rank} of {found.columns}): {groups}. "
        "Remove or fix one of them, or use data that excite them separately."
    )
