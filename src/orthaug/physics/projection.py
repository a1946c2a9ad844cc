"""The projection onto the physics: a scaled QR of Φ, made once and used for θ̂, θ_aux and P⊥.

Everything here is orthogonal factorisation; `ΦᵀΦ` is never formed, let alone inverted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from jaxtyping import Float

from orthaug._base.checks import Vector


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
        scale = np.where(
            largest > 0, 2.0 ** np.clip(-np.round(np.log2(np.where(largest > 0, largest, 1.0))), -1000, 1000), 1.0
        )
        q, r = scipy.linalg.qr(  # pyright: ignore[reportAssignmentType]  (its stubs do not know `mode`)
            stacked * scale, mode="economic", overwrite_a=True, check_finite=False
        )
        return cls(phi, np.ascontiguousarray(q).reshape(rows, ny, -1), r, scale)

    def coordinates(self, values: Float[np.ndarray, "N ny"]) -> Vector:
        """Qᵀv, (nθ,): the part of stacked outputs that the physics can express."""
        return np.tensordot(self.q, values, axes=([0, 1], [0, 1]))

    def solve(self, values: Float[np.ndarray, "N ny"]) -> Vector:
        """Φ⁺v, (nθ,), refined once: θ̂ for outputs (F1), θ_aux for a learner's values (eq:theta_aux)."""
        theta = self.from_coordinates(self.coordinates(values))
        return theta + self.from_coordinates(self.coordinates(values - self.phi @ theta))

    def from_coordinates(self, coordinates: Float[np.ndarray, "nt *m"]) -> Float[np.ndarray, "nt *m"]:
        """θ of coordinates in the basis Q: `R⁻¹q`, one vector or several as columns."""
        if not coordinates.size:
            return coordinates
        return (self.scale * scipy.linalg.solve_triangular(self.r, coordinates, check_finite=False).T).T

    def orthogonal_part(self, values: Float[np.ndarray, "N ny"]) -> Float[np.ndarray, "N ny"]:
        """P⊥v = v − QQᵀv, projected twice so that what is left is orthogonal to rounding."""
        for _ in range(2):
            values = values - self.q @ self.coordinates(values)
        return values

    def covariance_factor(self, free: Sequence[int] | None = None) -> Float[np.ndarray, "nf nt"]:
        """A factor L with `L Lᵀ = (Φ_fᵀΦ_f)⁻¹` for the free columns, all by default; `L = Φ_f⁺Q`."""
        chosen = list(range(len(self.scale))) if free is None else list(free)
        basis, r = np.linalg.qr(self.r[:, chosen])
        return self.scale[chosen, None] * scipy.linalg.solve_triangular(r, basis.T) if chosen else basis.T
