"""Levenberg-Marquardt where a linearisation is dear and a trial cheap: the free run.

The step solves `(H + αE + μ diag H) d = g − αE p`: Marquardt's scaling and Nielsen's update of μ (Madsen, Nielsen
and Tingleff 2004, algorithm 3.16). Trials cost one free run; the sensitivities follow only where a trial is accepted,
and a trial that is not finite is rejected like one that does not descend. The ridge α acts on the weights alone (E).
"""

from __future__ import annotations

import time
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import scipy.linalg
from jaxtyping import Bool

from orthaug._base.checks import Matrix, Vector
from orthaug.fitting.solvers.levenberg_marquardt import CONVERGED, NO_DESCENT, NON_FINITE, RUNNING, Progress

_FIRST_DAMPING = 1e-3
_LARGEST_DAMPING = 1e16
_SETTLED = 0.1  # of the objective: a step that lowers it by less belongs to the end of a run
_NO_CORRELATION = 0.05  # below it a correlation of the errors does not count
_SMALLEST_CURVATURE = 1e-14  # of the largest: what a direction that does nothing is damped with


@runtime_checkable
class Objective(Protocol):
    """`‖r(p)‖²` of p = (θ, w), θ in front."""

    def loss(self, p: Vector) -> float:
        """‖r‖²; not finite where the free run diverges."""
        ...

    def normal(self, p: Vector) -> tuple[Matrix, Vector]:
        """JᵀJ and Jᵀr (downhill)."""
        ...

    def samples(self) -> tuple[float, float]:
        """Number of residuals at the last loss, and the share of them that is independent."""
        ...


class Outcome(NamedTuple):
    """Where a run ended."""

    p: Vector
    hessian: Matrix
    loss: float
    ridge: float
    effective: float
    iterations: int
    code: int
    seconds: float


def minimise(
    objective: Objective,
    p: Vector,
    *,
    physics: int,
    iterations: int,
    tolerance: float,
    ridge: float = 0.0,
    evidence: bool = False,
    bounds: tuple[Vector, Vector] | None = None,
    progress: Progress | None = None,
) -> Outcome:
    """Minimise `‖r‖² + α‖w‖²` from p.

    Args:
        physics: how many leading entries of p are θ: they have bounds and no ridge.
        ridge: α; with `evidence` where it starts.
        bounds: of θ, each (physics,); the start is moved inside.
    """
    began = time.perf_counter()
    lower, upper = (np.full(len(p), side) for side in (-np.inf, np.inf))
    if bounds is not None:
        lower[:physics], upper[:physics] = bounds
    p = np.clip(p, lower, upper)
    penalty = np.concatenate([np.zeros(physics), np.ones(len(p) - physics)])
    loss = objective.loss(p)
    if not np.isfinite(loss):
        return Outcome(p, np.eye(len(p)), loss, ridge, 0.0, 0, NON_FINITE, time.perf_counter() - began)
    hessian, gradient = objective.normal(p)
    if not np.isfinite(hessian).all():
        return Outcome(p, np.eye(len(p)), loss, ridge, 0.0, 0, NON_FINITE, time.perf_counter() - began)
    coloured = False  # the colour of the errors counts once they no longer fall fast: before, it is that of the misfit
    if evidence:
        ridge = _evidence(objective, p, hessian, loss, ridge, physics, coloured)
    damping, growth, small, accepted, code, done = _FIRST_DAMPING, 2.0, 0, 0, RUNNING, 0
    while code == RUNNING and done < iterations:
        downhill = gradient - ridge * penalty * p
        step, expected = _step(hessian + ridge * np.diag(penalty), downhill, damping, p, lower, upper)
        trial = objective.loss(p + step) if np.isfinite(step).all() and step.any() else np.nan
        done += 1
        before = loss + ridge * float(penalty @ p**2)
        after = trial + ridge * float(penalty @ (p + step) ** 2)
        moved = objective.normal(p + step) if np.isfinite(after) and after < before else None
        if moved is not None and np.isfinite(moved[0]).all():
            p, loss, accepted = p + step, trial, accepted + 1
            hessian, gradient = moved
            gain = (before - after) / expected if expected > 0 else 1.0
            damping, growth = damping * max(1 / 3, 1 - (2 * gain - 1) ** 3), 2.0
            small = small + 1 if before - after < tolerance * before else 0
            coloured = coloured or before - after < _SETTLED * before
            if evidence:
                ridge = _evidence(objective, p, hessian, loss, ridge, physics, coloured)
            code = CONVERGED if small >= 2 else RUNNING
        else:
            damping, growth = damping * growth, 2 * growth
            if damping > _LARGEST_DAMPING or not step.any():
                level = _level(hessian, downhill, before, _held(p, downhill, lower, upper))
                code = CONVERGED if accepted or level else NO_DESCENT
        if progress is not None:
            progress(done, loss)
    seconds = time.perf_counter() - began
    return Outcome(p, hessian, loss, ridge, effective_weights(hessian, ridge, physics), done, code, seconds)


def _step(
    hessian: Matrix, downhill: Vector, damping: float, p: Vector, lower: Vector, upper: Vector
) -> tuple[Vector, float]:
    """The damped step inside the bounds, and the decrease that the quadratic model expects of it."""
    free = np.flatnonzero(~_held(p, downhill, lower, upper))
    curvature = np.diag(hessian)[free]
    scale = np.maximum(curvature, _SMALLEST_CURVATURE * curvature.max(initial=0.0))
    scale = np.where(scale > 0, scale, 1.0)
    unit = 1 / np.sqrt(scale)  # solved with a unit diagonal: columns of very different size keep their digits
    matrix = hessian[np.ix_(free, free)] * np.outer(unit, unit) + damping * np.eye(len(free))
    step = np.zeros(len(p))
    if not len(free):
        return step, 0.0
    try:
        factor = scipy.linalg.cho_factor(matrix, check_finite=False)
        step[free] = unit * scipy.linalg.cho_solve(factor, unit * downhill[free], check_finite=False)
    except np.linalg.LinAlgError:  # curvature lost to rounding: more damping mends it
        return np.full(len(p), np.nan), 0.0
    step = np.clip(p + step, lower, upper) - p
    return step, float(2 * step @ downhill - step @ hessian @ step)


def _held(p: Vector, downhill: Vector, lower: Vector, upper: Vector) -> Bool[np.ndarray, "n"]:
    """Which entries stand at a bound that the descent would leave."""
    return ((p <= lower) & (downhill < 0)) | ((p >= upper) & (downhill > 0))


def _level(hessian: Matrix, downhill: Vector, objective: float, held: Bool[np.ndarray, "n"]) -> bool:
    """Residual and Jacobian are orthogonal to rounding in every free entry: the start is a minimum."""
    flat = np.abs(downhill) <= 1e-7 * np.sqrt(np.maximum(np.diag(hessian), 0.0) * objective)
    return bool(np.all(flat | held))


def weights_hessian(hessian: Matrix, physics: int) -> Matrix:
    """The Hessian of the weights with θ eliminated, (nw, nw)."""
    h_tt, h_tw, h_ww = hessian[:physics, :physics], hessian[:physics, physics:], hessian[physics:, physics:]
    unit = np.sqrt(np.maximum(np.diag(h_tt), np.finfo(float).tiny))
    inner = np.linalg.lstsq(h_tt / np.outer(unit, unit), h_tw / unit[:, None], rcond=1e-14)[0]
    found = h_ww - (h_tw / unit[:, None]).T @ inner
    return (found + found.T) / 2


def effective_weights(hessian: Matrix, ridge: float, physics: int) -> float:
    """tr(H (H + αI)⁻¹) of the weights, with directions that are rounding counted as absent."""
    if len(hessian) == physics:
        return 0.0
    values = np.linalg.eigvalsh(weights_hessian(hessian, physics))
    floor = len(hessian) * np.finfo(float).eps * np.max(np.diag(hessian)[physics:])
    return float(np.sum(np.where(values > floor, values / (np.abs(values) + ridge), 0.0)))


def _evidence(
    objective: Objective, p: Vector, hessian: Matrix, loss: float, ridge: float, physics: int, coloured: bool
) -> float:
    """MacKay's fixed point `α = γσ²/(κ‖w‖²)`, κ the share of the residuals that is independent.

    Residuals of a free run are coloured: N of them say as much as κN independent ones, which divides the weight
    of the data against the prior.
    """
    samples, share = objective.samples()
    share = share if coloured else 1.0
    effective = effective_weights(hessian, ridge, physics)
    variance = loss / max(samples - effective / share, 1.0)
    size = float(np.sum(p[physics:] ** 2))
    return float(np.clip(effective * variance / (share * max(size, 1e-300)), 1e-12, 1e12))


def independent_share(residuals: Matrix) -> float:
    """1 / (1 + 2 Σ ρ_i), the inverse autocorrelation time, summed up to the first correlation that is noise.

    Args:
        residuals: stretches (s, T), 0 where there is no residual; lags never reach from one into the next.
    """
    longest = residuals.shape[1]
    if longest < 3:
        return 1.0
    size = 1 << (2 * longest - 1).bit_length()
    spectrum = np.sum(np.abs(np.fft.rfft(residuals, size, axis=1)) ** 2, axis=0)
    covariance = np.fft.irfft(spectrum, size)[:longest]
    if not covariance[0] > 0:
        return 1.0
    rho = covariance[1:] / covariance[0]
    noise = max(_NO_CORRELATION, 2 / np.sqrt(np.count_nonzero(residuals)))
    end = int(np.argmax(np.append(rho < noise, True)))
    return float(1 / (1 + 2 * np.sum(rho[:end])))
