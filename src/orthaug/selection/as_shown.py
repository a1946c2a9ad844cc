"""Terms as a learner would show them: projected onto its tangent space, less what the physics expresses.

A learner is smooth, so what it makes of a jump is none; compared as they are, a steep saturation would explain it
better than the jump that is there. Where training ended its errors are orthogonal to Φ and to J = ∂f/∂w, up to the
ridge λ: `P⊥(δ + e − f) ⊥ J` for what is missing, δ, and noise e. So with `S = J (JᵀJ + λ)⁻¹ Jᵀ`, J less what Φ
expresses, `S δ = S f + J (JᵀJ + λ)⁻¹ λ w − S e`: regressing that on `S t` has no bias by the learner's shape. In
coordinates of J's singular vectors. Of a motion J, f and t stand for what they do to the outputs of its free run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.special
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug.selection.learned_linearization import LearnedLinearization

_RANK = 1e-9  # of the largest singular value
_ROUNDING = 1e-8  # of the largest variance


@dataclass(frozen=True, eq=False)
class LearnerTarget:
    """How a learner shows what is missing: `target` (r,) is what it shows, `covariance` (r, r) that of its errors.

    `view` (P, r) takes whitened values over all points to that; None where the learner tells no tangent space: then
    they are taken as they are, less the physics. `size` is the norm of the learner with all that physics expresses.
    """

    linearization: LearnedLinearization
    q: Float[np.ndarray, "R s"]
    view: Float[np.ndarray, "P r"] | None
    target: Vector
    covariance: Matrix | None
    size: float

    @classmethod
    def of(cls, linearization: LearnedLinearization) -> LearnerTarget:
        """By the learner's tangent space over the points, where it has one."""
        q = basis_of(linearization.physics_moves.T)
        raw = linearization.fitted(linearization.learner)
        rest, size, tangent = without(raw, q), float(np.linalg.norm(raw)), linearization.tangent
        if tangent is None:
            return cls(linearization, q, None, rest, None, size)
        ridge: Any = np.broadcast_to(np.asarray(tangent.ridge, dtype=float), tangent.weights.shape)
        u, sigma, vt = np.linalg.svd(without(tangent.jacobian, q), full_matrices=False)
        kept = sigma > _RANK * sigma.max(initial=0.0)
        u, sigma, v = u[:, kept], sigma[kept], vt[kept].T
        # with U, Σ, V of J: S = U Σ (Σ² + VᵀλV)⁻¹ Σ Uᵀ
        inner = np.linalg.inv(np.diag(sigma**2) + v.T @ (ridge[:, None] * v))
        smooth = sigma[:, None] * inner * sigma
        target = smooth @ (u.T @ rest) + sigma * (inner @ (v.T @ (ridge * tangent.weights)))
        covariance = None
        if tangent.joint is not None:
            k = sigma[:, None] * (inner @ (sigma[:, None] ** 2 * v.T + v.T * ridge))
            covariance = tangent.joint.of(np.concatenate([np.zeros((len(k), tangent.joint.nt)), k], axis=1))
        view = u @ smooth.T
        view = view if linearization.response is None else linearization.response.adjoint(view)
        return cls(linearization, q, view, target, covariance, size)

    @property
    def noise(self) -> float:
        """The variance of the learner's errors in a direction, on average; 0 where it is not known."""
        return 0.0 if self.covariance is None else float(np.trace(self.covariance)) / max(len(self.target), 1)

    @property
    def p(self) -> float | None:
        """Of the learner being nothing but its own errors, beside the physics (Wald's test); None if not known."""
        if self.covariance is None:
            return None
        values, vectors = np.linalg.eigh(self.covariance)
        kept = values > _ROUNDING * values.max(initial=0.0)
        square = float(np.sum((vectors[:, kept].T @ self.target) ** 2 / values[kept]))
        return float(scipy.special.chdtrc(max(int(kept.sum()), 1), square))

    def unit(self, column: Vector) -> Vector:
        """A column over the points (P,), taken as of size 1, as the learner would show it."""
        with np.errstate(all="ignore"):
            column = column / np.linalg.norm(column)
        if not np.isfinite(column).all():
            return np.full(len(self.target), np.nan)
        if self.view is None:
            return without(self.linearization.fitted(column), self.q)
        return self.view.T @ column


def without(values: np.ndarray, basis: Float[np.ndarray, "R k"]) -> np.ndarray:
    """Less what an orthonormal basis expresses, projected twice."""
    for _ in range(2 if basis.size else 0):
        values = values - basis @ (basis.T @ values)
    return values


def basis_of(columns: Sequence[Vector] | Matrix) -> Float[np.ndarray, "R k"]:
    """An orthonormal basis of columns, each taken as of size 1."""
    if not len(columns):
        return np.zeros((0, 0))
    table = np.asarray(columns, dtype=float)
    size = np.linalg.norm(table, axis=1)
    u, sigma, _ = np.linalg.svd((table[size > 0] / size[size > 0, None]).T, full_matrices=False)
    return u[:, sigma > 1e-10 * sigma.max(initial=0.0)]


def least_squares(table: Float[np.ndarray, "R s"], values: Vector) -> Vector:
    """(s,) of the columns that express values best, each taken as of size 1."""
    size = np.linalg.norm(table, axis=0)
    unit = 1 / np.where(size > 0, size, 1.0)
    return unit * np.linalg.lstsq(table * unit, values, rcond=1e-10)[0]
