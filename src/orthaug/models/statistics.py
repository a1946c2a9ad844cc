"""Statistics of training for intervals: Gram matrix of the derivatives, Cov(c, w) from it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from orthaug._base.checks import Matrix, Vector

# Of the largest eigenvalue of a Gram matrix with unit columns: what is below is rounding
_ROUNDING = 1e-13


def column_units(gram: Matrix, nt: int) -> Vector:
    """Return one over the norm of each column, θ first.

    Learner columns that are rounding beside the largest stay small.
    """
    size = np.sqrt(np.maximum(np.diag(gram), 0.0))
    size[nt:] = np.maximum(size[nt:], np.sqrt(np.finfo(float).eps) * size[nt:].max(initial=0.0))
    return 1 / np.where(size > 1e-150, size, 1.0)


def prior_of(gram: Matrix, ridge: float | Vector, nt: int) -> Vector:
    """Return the precisions (n,) that the prior adds to M: 0 for θ, the ridge for weights."""
    return np.concatenate([np.zeros(nt), ridge * np.ones(len(gram) - nt)])


def half_inverse(gram: Matrix, nt: int, *, own_units: bool = False) -> Float[np.ndarray, "n r"]:
    """Return H, with `H Hᵀ` the inverse of a Gram matrix on the directions that the data see.

    The Gram matrix is that of `[S_c S_w]`.
    Products with the inverse are formed from H on both sides: the inverse itself has entries up to
    1e13.

    Args:
        gram: of the columns.
        nt: number of θ, the leading columns.
        own_units: ask which directions the data see in the units of the columns, as a
            pseudo-inverse does; otherwise after each column was divided by its norm, so that units
            do not matter.
    """
    unit = np.ones(len(gram)) if own_units else column_units(gram, nt)
    values, vectors = np.linalg.eigh(gram * np.outer(unit, unit))
    kept = values > _ROUNDING * values.max(initial=0.0)
    return unit[:, None] * vectors[:, kept] / np.sqrt(values[kept])


@dataclass(frozen=True, eq=False)
class JointCovariance:
    """Cov of all that training estimated, p = (c, w): `σ² M⁻¹` with `M = G + ridge` on the weights.

    G is the Gram matrix of ∂ŷ/∂p in whitened outputs. Only functions of the fitted model have a
    variance. A direction of p that changes no prediction on the training rows counts as absent.
    """

    gram: Matrix
    ridge: float | Vector
    """Ridge of all weights, or of each (nw,)."""
    middle: Matrix
    """ΣψᵀΣ_eψ in whitened outputs, `σ² G` for one output."""
    nt: int

    def root(self) -> Float[np.ndarray, "n r"]:
        """Return S with `Cov p = S Sᵀ = M⁻¹ (ΣψᵀΣ_eψ + σ² ridge) M⁻¹`.

        The ridge is counted as the prior that it is.

        Variances are then sums of squares, which no rounding makes negative.
        """
        prior = prior_of(self.gram, self.ridge, self.nt)
        half = half_inverse(self.gram + np.diag(prior), self.nt)
        variance = float(np.trace(self.middle) / max(np.trace(self.gram), 1e-300))
        values, vectors = np.linalg.eigh(half.T @ (self.middle + variance * np.diag(prior)) @ half)
        return half @ (vectors * np.sqrt(np.maximum(values, 0.0)))

    def of(self, k: Float[np.ndarray, "m n"]) -> Matrix:
        """Return Cov of `K p`, (m, m)."""
        reach = k @ self.root()
        return reach @ reach.T


@dataclass(frozen=True, eq=False)
class Statistics:
    """Statistics of training; None where it has none.

    `gram` (nθ + nw)² is the Gram matrix of ∂ŷ/∂(c, w) over the training rows in whitened outputs,
    `[Φ J]` one step ahead; `ridge` the weights' prior precision beside it, of all or of each (nw,);
    `middle` = ΣψᵀΣ_eψ; `noise` (ny, ny) the noise covariance in the outputs' units; `freedom` its
    degrees of freedom.
    """

    gram: Matrix | None = None
    middle: Matrix | None = None
    noise: Matrix | None = None
    ridge: float | Vector = 0.0
    freedom: float = np.inf
    simulated: bool = False
    """True if `noise` is of a free run's errors, and not of those one step ahead."""
    verdict: str = ""
    """Diagnosis of the residual (`analysis.Diagnosis`); empty where none was asked for."""
    disturbance: Matrix | None = None
    """Q of an observer by the likelihood of the training data, and with it R, `sensor`; where
    nobody tuned it.
    """
    sensor: Matrix | None = None

    def information(self, nt: int) -> Matrix:
        """Return M, the Gram matrix with the precisions of the weights' prior."""
        assert self.gram is not None
        return self.gram + np.diag(prior_of(self.gram, self.ridge, nt))

    def among(self, moves: Bool[np.ndarray, "n"], nt: int) -> Statistics:
        """Return the statistics of those entries of (c, w) that move, where others are constants.

        Args:
            nt: number of θ, the leading entries.
        """
        kept = np.ix_(moves, moves)
        return replace(
            self,
            gram=None if self.gram is None else self.gram[kept],
            middle=None if self.middle is None else self.middle[kept],
            ridge=np.broadcast_to(self.ridge, len(moves) - nt)[moves[nt:]],
        )

    def joint(self, nt: int) -> JointCovariance | None:
        """Return Cov(c, w), the nt entries of θ first."""
        if self.gram is None or self.middle is None:
            return None
        return JointCovariance(self.gram, self.ridge, self.middle, nt)
