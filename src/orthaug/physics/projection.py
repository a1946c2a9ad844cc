"""The projection onto the physics: a scaled QR of Φ, made once and used for θ̂, θ_aux and P⊥.

Everything here is orthogonal factorisation. `ΦᵀΦ` is never formed, let alone inverted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector

_ROUNDING = 1e-13  # of the size of what is summed: below it a direction moves nothing


@dataclass(frozen=True, eq=False)
class Projection:
    """The QR of Φ with its rows weighted per output: `Φ scale = q r` with orthonormal q.

    `r` (nθ, nθ) is upper triangular. `scale` (nθ,) multiplies the columns; its entries are powers
    of two, which is exact. `phi` and `q` are (N, ny, nθ).
    """

    r: Float[np.ndarray, "nt nt"]
    scale: Vector
    phi: Float[np.ndarray, "N ny nt"]
    q: Float[np.ndarray, "N ny nt"]

    @classmethod
    def factor(cls, phi: Float[np.ndarray, "N ny nt"]) -> Projection:
        """Return the projection by Householder QR of the stacked (N·ny, nθ) matrix."""
        rows, ny, nt = phi.shape
        if nt == 0:
            return cls(np.zeros((0, 0)), np.zeros(0), phi, phi)
        stacked = phi.reshape(rows * ny, nt)
        scale = powers_of_two(np.abs(stacked).max(axis=0, initial=0.0))
        q, r = scipy.linalg.qr(  # pyright: ignore[reportAssignmentType]  (its stubs do not know `mode`)
            stacked * scale, mode="economic", overwrite_a=True, check_finite=False
        )
        return cls(r, scale, phi, np.ascontiguousarray(q).reshape(rows, ny, len(r)))

    @property
    def to_coordinates(self) -> Matrix:
        """The matrix that takes θ to its coordinates in the basis Q, `R / scale` (nθ, nθ)."""
        return self.r / self.scale if self.scale.size else self.r

    def from_coordinates(
        self, coordinates: Float[np.ndarray, "nt *m"]
    ) -> Float[np.ndarray, "nt *m"]:
        """Return θ of coordinates in the basis Q: `R⁻¹q`, one vector or several as columns."""
        if not coordinates.size:
            return coordinates
        return (
            self.scale * scipy.linalg.solve_triangular(self.r, coordinates, check_finite=False).T
        ).T

    def along(self, directions: Float[np.ndarray, "nt s"] | None) -> Matrix:
        """Return the projector (nθ, nθ) onto some directions of θ, in coordinates of Q.

        None for all of them.
        """
        if directions is None:
            return np.eye(len(self.r))
        basis = np.linalg.qr(self.to_coordinates @ directions)[0]
        return basis @ basis.T

    def without_null(self, directions: Float[np.ndarray, "nt s"]) -> Float[np.ndarray, "nt r"]:
        """Return a basis of some directions of θ without those that Φ takes to zero.

        Without such directions, they are returned unchanged. A parameter that appears in none of
        the rows has a column of zeros.
        """
        moved = self.to_coordinates @ directions
        size = np.linalg.norm(moved, axis=0)
        seen = size > _ROUNDING * np.linalg.norm(
            np.abs(self.to_coordinates) @ np.abs(directions), axis=0
        )
        unit = directions[:, seen] / size[seen]
        _, sigma, vt = np.linalg.svd(self.to_coordinates @ unit)
        rank = int(np.sum(sigma > _ROUNDING * sigma.max(initial=0.0)))
        return directions if rank == directions.shape[1] else unit @ vt[:rank].T

    def covariance_factor(self, free: Sequence[int] | None = None) -> Float[np.ndarray, "nf nt"]:
        """Return a factor L with `L Lᵀ = (Φ_fᵀΦ_f)⁻¹` for the free columns, all by default.

        `L = Φ_f⁺Q`.
        """
        chosen = list(range(len(self.scale))) if free is None else list(free)
        basis, r = np.linalg.qr(self.r[:, chosen])
        return (
            self.scale[chosen, None] * scipy.linalg.solve_triangular(r, basis.T)
            if chosen
            else basis.T
        )

    def coordinates(self, values: Float[np.ndarray, "N ny"]) -> Vector:
        """Return Qᵀv, (nθ,): the part of stacked outputs that the physics can express."""
        return np.tensordot(self.q, values, axes=([0, 1], [0, 1]))

    def solve(self, values: Float[np.ndarray, "N ny"]) -> Vector:
        """Return Φ⁺v, (nθ,), refined once.

        This is θ̂ for outputs (F1), and θ_aux for a learner's values (eq:theta_aux).
        """
        theta = self.from_coordinates(self.coordinates(values))
        return theta + self.from_coordinates(self.coordinates(values - self.phi @ theta))

    def solve_along(
        self, values: Float[np.ndarray, "N ny"], directions: Float[np.ndarray, "nt s"] | None
    ) -> Vector:
        """Return B(ΦB)⁺v, (nθ,): least squares along some directions only, refined once.

        None for all of them.

        Φ itself need not have full rank: what no row determines stays zero.
        """
        if directions is None:
            return self.solve(values)
        directions = self.without_null(directions)
        if not directions.shape[1]:
            return np.zeros(len(directions))
        basis, r = np.linalg.qr(self.to_coordinates @ directions)

        def along(rest: Float[np.ndarray, "N ny"]) -> Vector:
            return directions @ scipy.linalg.solve_triangular(
                r, basis.T @ self.coordinates(rest), check_finite=False
            )

        theta = along(values)
        return theta + along(values - self.phi @ theta)

    def orthogonal_part(self, values: Float[np.ndarray, "N ny"]) -> Float[np.ndarray, "N ny"]:
        """Return P⊥v = v − QQᵀv, projected twice to be orthogonal to rounding."""
        for _ in range(2):
            values = values - self.q @ self.coordinates(values)
        return values


def powers_of_two(largest: Vector) -> Vector:
    """Return the powers of two that bring the largest entry of each column (nθ,) near 1.

    1 for a column of zeros.
    """
    moves = largest > 0
    return np.where(
        moves, 2.0 ** np.clip(-np.round(np.log2(np.where(moves, largest, 1.0))), -1000, 1000), 1.0
    )
