"""Statistics of θ: noise covariance, standard errors and intervals under the training measure.

The calibrated form `(Σψᵀψ)⁻¹(ΣψᵀΣ_eψ)(Σψᵀψ)⁻¹` for the criterion `1/N Σ‖ε‖²` (Ljung 1999, ch. 9): the
factor 2 of the paper's eq:cov_approx cancels against the second derivative of the criterion.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import scipy.special
from jaxtyping import Float

from orthaug._arrays import Matrix, Vector
from orthaug.projection import Projection


def degrees_of_freedom(projection: Projection, effective: float) -> Vector:
    """Rows of each output less what the fit has used up of them, (ny,).

    The physics uses `Σ_k ‖Q_ki‖²` of output i (its share of nθ), the learner its effective weights.
    """
    rows, ny, _ = projection.q.shape
    return rows - np.sum(projection.q**2, axis=(0, 2)) - effective / ny


def noise_covariance(residual: Float[np.ndarray, "N ny"], freedom: Vector) -> Matrix | None:
    """Σ_e (ny, ny) in the outputs' units; None where the fit leaves no degree of freedom."""
    if np.any(freedom < 0.5):
        return None
    return residual.T @ residual / np.sqrt(np.outer(freedom, freedom))


def whitening(noise: Matrix) -> Matrix | None:
    """W with `W Σ Wᵀ = I` (ny, ny); None for a covariance that is singular, as of outputs without errors."""
    values = np.linalg.eigvalsh(noise)
    return np.linalg.inv(np.linalg.cholesky(noise)) if values[0] > 1e-12 * values[-1] else None


def mixing(noise: Matrix) -> Matrix:
    """M with `MᵀM = Σ` (ny, ny), also of a singular covariance."""
    values, vectors = np.linalg.eigh(noise)
    return (vectors * np.sqrt(np.maximum(values, 0.0))).T


def theta_covariance(projection: Projection, weight: Vector, noise: Matrix, fixed: Collection[int] = ()) -> Matrix:
    """Cov θ̂ (nθ, nθ) of θ̂ = Φ⁺Y. For one output this is the textbook s²(ΦᵀΦ)⁻¹.

    Entries that stand at a bound (`fixed`) have NaN; the others' covariance holds with them fixed there.
    """
    whitened = noise * np.outer(weight, weight)
    nt = len(projection.scale)
    free = [i for i in range(nt) if i not in fixed]
    factor = projection.covariance_factor(free)
    if projection.q.shape[1] == 1:
        found = whitened[0, 0] * factor @ factor.T
    else:
        middle = np.einsum("kit,ij,kjs->ts", projection.q, whitened, projection.q, optimize=True)
        found = factor @ middle @ factor.T
    covariance = np.full((nt, nt), np.nan)
    covariance[np.ix_(free, free)] = found
    return covariance


_ROUNDING = 1e-13  # of the largest eigenvalue of a Gram matrix with unit columns: what is below is rounding


def column_units(gram: Matrix, nt: int) -> Vector:
    """One over the norm of each column, θ first; learner columns that are rounding beside the largest stay small."""
    size = np.sqrt(np.maximum(np.diag(gram), 0.0))
    size[nt:] = np.maximum(size[nt:], np.sqrt(np.finfo(float).eps) * size[nt:].max(initial=0.0))
    return 1 / np.where(size > 1e-150, size, 1.0)


def half_inverse(gram: Matrix, nt: int) -> Float[np.ndarray, "n r"]:
    """H with `H Hᵀ` the inverse of the Gram matrix of `[S_c S_w]` on the directions that the data see.

    Products with the inverse are formed from H on both sides: the inverse itself has entries up to 1e13.
    """
    unit = column_units(gram, nt)
    values, vectors = np.linalg.eigh(gram * np.outer(unit, unit))
    kept = values > _ROUNDING * values.max(initial=0.0)
    return unit[:, None] * vectors[:, kept] / np.sqrt(values[kept])


@dataclass(frozen=True, eq=False)
class Joint:
    """Cov of all that training estimated, p = (c, w): `σ² M⁻¹` with `M = G + ridge` on the weights.

    G is the Gram matrix of ∂ŷ/∂p in whitened outputs. Only functions of the fitted model have a variance: directions of
    p that change no prediction on the training rows count as absent.
    """

    gram: Matrix
    ridge: float
    middle: Matrix
    """ΣψᵀΣ_eψ in whitened outputs, `σ² G` for one output."""
    nt: int

    def root(self) -> Float[np.ndarray, "n r"]:
        """S with `Cov p = S Sᵀ = M⁻¹ (ΣψᵀΣ_eψ + σ² ridge) M⁻¹`, the ridge counted as the prior that it is.

        Variances are then sums of squares, which no rounding makes negative.
        """
        nw = len(self.gram) - self.nt
        prior = self.ridge * np.concatenate([np.zeros(self.nt), np.ones(nw)])
        half = half_inverse(self.gram + np.diag(prior), self.nt)
        variance = float(np.trace(self.middle) / max(np.trace(self.gram), 1e-300))
        values, vectors = np.linalg.eigh(half.T @ (self.middle + variance * np.diag(prior)) @ half)
        return half @ (vectors * np.sqrt(np.maximum(values, 0.0)))

    def of(self, k: Float[np.ndarray, "m n"]) -> Matrix:
        """Cov of `K p`, (m, m)."""
        reach = k @ self.root()
        return reach @ reach.T


def theta_block(information: Matrix, ridge: float, nt: int, fixed: Collection[int] = ()) -> Matrix:
    """Cov θ̂ (nθ, nθ) per unit of noise variance, from the information `[S_θ S_w]ᵀ[S_θ S_w]` of θ and weights.

    The weights are eliminated: `(H_θθ − H_θw (H_ww + αI)⁺ H_wθ)⁻¹`. Directions of the weights that the data do not see
    count as absent. NaN for entries at a bound (`fixed`), and for all where θ is not determined beside the weights.
    """
    free = [i for i in range(nt) if i not in fixed]
    covariance = np.full((nt, nt), np.nan)
    if not np.isfinite(information).all():
        return covariance
    unit = column_units(information, nt)
    scaled = information * np.outer(unit, unit)
    inner = scaled[nt:, nt:] + ridge * np.diag(unit[nt:] ** 2)
    values, vectors = np.linalg.eigh(inner)
    kept = values > len(information) * np.finfo(float).eps * values.max(initial=0.0)
    across = scaled[np.ix_(free, range(nt, len(information)))] @ vectors[:, kept]
    remaining = scaled[np.ix_(free, free)] - (across / values[kept]) @ across.T
    values, vectors = np.linalg.eigh(remaining)
    if free and values.min() > len(information) * np.finfo(float).eps:
        found = (vectors / values) @ vectors.T
        covariance[np.ix_(free, free)] = found * np.outer(unit[free], unit[free])
    return covariance


def interval(value: Vector, std: Vector, freedom: float, level: float = 0.95) -> Float[np.ndarray, "n 2"]:
    """Student-t interval of each entry, (n, 2)."""
    reach = scipy.special.stdtrit(max(freedom, 1.0), 0.5 + level / 2) * std
    return np.stack([value - reach, value + reach], axis=-1)
