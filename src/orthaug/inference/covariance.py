"""Statistics of θ: noise covariance, standard errors and intervals under the training measure.

The calibrated form `(Σψᵀψ)⁻¹(ΣψᵀΣ_eψ)(Σψᵀψ)⁻¹` for the criterion `1/N Σ‖ε‖²` (Ljung 1999, ch. 9): the
factor 2 of the paper's eq:cov_approx cancels against the second derivative of the criterion.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import scipy.special
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug.models.statistics import column_units
from orthaug.physics.projection import Factor


def degrees_of_freedom(rows: int, physics: Vector, effective: float) -> Vector:
    """Degrees of freedom of each output (ny,): its rows less what the fit has used up.

    The physics uses `Σ_k ‖Q_ki‖²` of output i (its share of nθ), the learner its effective weights.
    """
    return rows - physics - effective / len(physics)


def noise_covariance(squares: Matrix, freedom: Vector) -> Matrix | None:
    """Σ_e (ny, ny) in the outputs' units from Σ e eᵀ; None where the fit leaves no degree of freedom."""
    if np.any(freedom < 0.5):
        return None
    return squares / np.sqrt(np.outer(freedom, freedom))


def whitening(noise: Matrix) -> Matrix | None:
    """W with `W Σ Wᵀ = I` (ny, ny); None for a covariance that is singular, as of outputs without errors."""
    values = np.linalg.eigvalsh(noise)
    return np.linalg.inv(np.linalg.cholesky(noise)) if values[0] > 1e-12 * values[-1] else None


def mixing(noise: Matrix) -> Matrix:
    """M with `MᵀM = Σ` (ny, ny), also of a singular covariance."""
    values, vectors = np.linalg.eigh(noise)
    return (vectors * np.sqrt(np.maximum(values, 0.0))).T


def theta_covariance(factor: Factor, middle: Matrix, fixed: Collection[int] = ()) -> Matrix:
    """Cov θ̂ (nθ, nθ) of θ̂ = Φ⁺Y. For one output this is the textbook s²(ΦᵀΦ)⁻¹.

    Args:
        middle: ΣqᵀΣ_eq (nθ, nθ) over the rows q of Q, in whitened outputs; for one output s² I.
        fixed: entries that stand at a bound. They have NaN; the others' covariance holds with them fixed there.
    """
    nt = len(factor.scale)
    free = [i for i in range(nt) if i not in fixed]
    root = factor.covariance_factor(free)
    covariance = np.full((nt, nt), np.nan)
    covariance[np.ix_(free, free)] = root @ middle @ root.T
    return covariance


def theta_block(information: Matrix, ridge: float, nt: int, fixed: Collection[int] = ()) -> Matrix:
    """Cov θ̂ (nθ, nθ) per unit of noise variance, from the information `[S_θ S_w]ᵀ[S_θ S_w]` of θ and weights.

    The weights are eliminated: `(H_θθ − H_θw (H_ww + αI)⁺ H_wθ)⁻¹`. Directions of the weights that the data do not see
    count as absent. Entries at a bound (`fixed`) are NaN. All are NaN where θ is not determined beside the weights.
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
        inverse = (vectors / values) @ vectors.T
        covariance[np.ix_(free, free)] = inverse * np.outer(unit[free], unit[free])
    return covariance


def interval(value: Vector, std: Vector, freedom: float, level: float = 0.95) -> Float[np.ndarray, "n 2"]:
    """Student-t interval of each entry, (n, 2)."""
    reach = scipy.special.stdtrit(max(freedom, 1.0), 0.5 + level / 2) * std
    return np.stack([value - reach, value + reach], axis=-1)
