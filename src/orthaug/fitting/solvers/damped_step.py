"""One step of damped Gauss-Newton: the rules of every loop, written once for NumPy and JAX.

For the objective `‖r(w)‖² + wᵀA w` with a ridge A the step solves `(H + A + μ D) d = g − A w`. μ
follows Nielsen's update (Madsen, Nielsen and Tingleff 2004, algorithm 3.16). D is the identity,
which converges from Xavier starts on normalised data, or the diagonal of H + A (Marquardt's
scaling).

Functions take `xp`, NumPy or JAX's: loops that the host drives (`minimize`) and loops that are
compiled whole (`compiled`) take the same steps.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from orthaug._base.jax import AnyArray, Array, ArrayModule, jax
from orthaug.fitting.status import Ending

_SMALLEST_CURVATURE = 1e-14  # of the largest: it damps a direction that does nothing
_LEVEL = 1e-7  # cosine between residual and a column of the Jacobian that is rounding
_UNUSED = 1e-12  # effective weights of a group at least, so that one that does nothing stays so
_RIDGES = (1e-12, 1e12)


class Damping(NamedTuple):
    """The first μ and the largest, in units of the largest curvature.

    With Marquardt's scaling in units of 1.
    """

    first: float
    largest: float
    diagonal: bool

    def unit(self, hessian: AnyArray, xp: ArrayModule) -> AnyArray | float:
        """Return the unit of μ."""
        return 1.0 if self.diagonal else xp.max(xp.diag(hessian), initial=1e-300)


# docs/decisions/damping.md has the comparison of first dampings
IDENTITY = Damping(1e-5, 1e12, diagonal=False)
MARQUARDT = Damping(1e-3, 1e16, diagonal=True)


class StepControl(NamedTuple):
    """The state of the damping and of the stopping rule."""

    damping: AnyArray | float
    """μ of the next step."""
    growth: AnyArray
    """The factor that raises μ if the next step is rejected."""
    small: AnyArray
    """Accepted steps in a row that lowered the objective by less than the tolerance."""
    accepted: AnyArray
    code: AnyArray
    """An `Ending`."""

    @classmethod
    def begin(
        cls, damping: Damping, hessian: AnyArray, code: AnyArray, xp: ArrayModule
    ) -> StepControl:
        """Return the control before the first step."""
        first, none = damping.first * damping.unit(hessian, xp), xp.asarray(0)
        return cls(first, xp.asarray(2.0), none, none, code)


def propose(
    hessian: AnyArray,
    ridge: AnyArray,
    downhill: AnyArray,
    mu: AnyArray | float,
    damping: Damping,
    xp: ArrayModule,
) -> AnyArray:
    """Return the damped step; not finite where rounding leaves no Cholesky factor.

    Args:
        hessian: H.
        ridge: diagonal of A, or one number.
        downhill: g − A w.
        mu: μ.
    """
    unity = xp.eye(hessian.shape[0])
    if not damping.diagonal:
        return _solve(hessian + (ridge + mu) * unity, downhill, xp)
    hessian = hessian + ridge * unity
    curvature = xp.diag(hessian)
    scale = xp.maximum(curvature, _SMALLEST_CURVATURE * xp.max(curvature, initial=0.0))
    # Solved with a unit diagonal: columns of very different size keep their digits
    unit = 1 / xp.sqrt(xp.where(scale > 0, scale, 1.0))
    return unit * _solve(hessian * xp.outer(unit, unit) + mu * unity, unit * downhill, xp)


def _solve(matrix: AnyArray, right: AnyArray, xp: ArrayModule) -> AnyArray:
    if xp is not np:
        return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix), right)
    try:
        factor = scipy.linalg.cho_factor(matrix, check_finite=False)
        return scipy.linalg.cho_solve(factor, right, check_finite=False)
    except np.linalg.LinAlgError:  # curvature lost to rounding: more damping mends it
        return np.full(len(right), np.nan)


def predicted_decrease(step: Any, downhill: Any, *, hessian: Any = None, mu: Any = None) -> Any:
    """Return by how much the quadratic model of the objective falls along a step.

    Args:
        step: s.
        downhill: d = g − A w.
        hessian: H + A, for any step: `2 sᵀd − sᵀ(H + A) s`.
        mu: μ, for a whole step that is damped with the identity: `sᵀ(μ s + d)`, the same.
    """
    if hessian is None:
        return step @ (mu * step + downhill)
    return 2 * step @ downhill - step @ hessian @ step


def judge(
    control: StepControl,
    damping: Damping,
    *,
    decrease: AnyArray | float,
    predicted: AnyArray | float,
    before: AnyArray | float,
    accepted: AnyArray,
    stuck: AnyArray | bool,
    level: AnyArray | bool,
    unit: AnyArray | float,
    tolerance: AnyArray | float,
    xp: ArrayModule,
) -> StepControl:
    """Return the control after a tried step.

    A run has converged after two steps in a row that gain less than the tolerance, or where no
    damping gives a step that descends, if one did before or there is none at a minimum.

    Args:
        decrease: of the objective, which is `before` where the step begins.
        predicted: the decrease of the quadratic model.
        accepted: whether the step is taken.
        stuck: whether there is no step to take with any damping.
        level: whether the step begins at a minimum, to rounding.
        unit: of μ.
    """
    gain = xp.where(predicted > 0, decrease / predicted, 1.0)
    factor = xp.maximum(1 / 3, 1 - (2 * gain - 1) ** 3)
    mu = control.damping * xp.where(accepted, factor, control.growth)
    small = xp.where(decrease < tolerance * before, control.small + 1, 0)
    small = xp.where(accepted, small, control.small)
    count = control.accepted + accepted
    stuck = ~accepted & (stuck | (mu > damping.largest * unit))
    code = xp.where(small >= 2, int(Ending.CONVERGED), int(Ending.RUNNING))
    end = xp.where((count > 0) | level, int(Ending.CONVERGED), int(Ending.NO_DESCENT))
    growth = xp.where(accepted, 2.0, 2 * control.growth)
    return StepControl(mu, growth, small, count, xp.where(stuck, end, code))


def level_entries(
    hessian: AnyArray, downhill: AnyArray, objective: AnyArray | float, xp: ArrayModule
) -> AnyArray:
    """Return a mask of the entries along which no step can descend.

    There, residual and Jacobian are orthogonal to rounding (MINPACK's gtol).
    """
    size = xp.sqrt(xp.maximum(xp.diag(hessian), 0.0) * objective)
    return xp.abs(downhill) <= _LEVEL * size


def effective_weights(
    hessian: AnyArray, ridge: AnyArray | float, floor: AnyArray | float, xp: ArrayModule
) -> AnyArray | float:
    """Return γ = tr(H (H + αI)⁻¹). Directions of a curvature up to `floor` count as absent."""
    values = xp.linalg.eigvalsh(xp.where(xp.isfinite(hessian), hessian, 0.0))
    seen = values > floor
    return xp.sum(xp.where(seen, values, 0.0) / xp.where(seen, values + ridge, 1.0))


def effective_of_each(hessian: Array, ridge: Array, xp: ArrayModule) -> Array:
    """Return the diagonal of `H (H + A)⁻¹` for a ridge of each weight.

    From the eigenvalues of `A^-½ H A^-½`.
    """
    unit = 1 / xp.sqrt(ridge)
    scaled = hessian * unit[:, None] * unit
    values, vectors = xp.linalg.eigh(xp.where(xp.isfinite(scaled), scaled, 0.0))
    values = xp.maximum(values, 0.0)
    return vectors**2 @ (values / (1 + values))


def evidence_ridge(
    loss: AnyArray | float,
    effective: Any,
    size: AnyArray | float,
    samples: AnyArray | float,
    xp: Any,
    *,
    total: AnyArray | None = None,
    share: Any = 1.0,
) -> AnyArray | float:
    """Return MacKay's fixed point `α = γσ²/(κ‖w‖²)` with `σ² = ‖r‖² / (N − γ/κ)`.

    κ is the share of the residuals that is independent. With groups γ and ‖w‖² are those of each
    group (automatic relevance determination).

    Args:
        effective: γ.
        size: ‖w‖².
        samples: N.
        total: γ of all groups; None where there is one.
        share: κ.
    """
    if total is None:
        total = effective
    else:
        effective = xp.maximum(effective, _UNUSED)
    variance = loss / xp.maximum(samples - total / share, 1.0)
    return xp.clip(effective * variance / (share * xp.maximum(size, 1e-300)), *_RIDGES)
