"""Behaviour of a learned correction beyond its training range: hold, fade, or continue.

A model predicts `φ(x)θ̂ + δ(x)` with the correction `δ = f − φθ_aux`. Within the limits, the range
of the training rows and half a half-width more on each side, nothing is changed. Beyond them the
features z are moved onto the limits, z̄, and the regressor with them as little as that takes, x̄:

    φ(x)θ̂ + a δ(x̄),    a = 1 where it is held,    a = exp(−(d/¼)²) where it fades,

d the distance ‖z − z̄‖ in half-widths of the limits. The physics with its θ̂ goes on alone. A held
correction is bounded, so that the free run is, too, wherever that of the physics is stable from
input to state.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import AnyArray, Array, jnp

BEYOND = ("auto", "hold", "fade", "free")
"""What `learner.beyond` may be; `auto` is hold for lagged physics, fade for motions, free for
terms.
"""
# Half-widths beyond the limits at which a fading correction is down to 1/e: benchmarks/defaults.py
FADED = 0.25
# Half-widths beyond the range of training in which a correction is not limited:
# benchmarks/defaults.py
MARGIN = 0.5
_WIDER = 1e-9  # of the range: rounding moves no training row
_AFFINE = 1e-9  # of a feature's size over the probes
_PROBES = 8  # more than the coefficients of an affine function


def beyond_of(learner: Any, usual: str) -> str:
    """Return how a learner's correction behaves beyond its training range.

    It is as declared, or `usual` for the physics where the declaration is `auto`.

    A learner that is linear in declared terms is an equation that a person reads: it goes on as it
    is.
    """
    declared = getattr(learner, "beyond", "auto")
    if declared != "auto":
        return declared
    return "free" if getattr(learner, "linear", False) else usual


def limits_of(features: Matrix) -> Matrix | None:
    """Return the limits (2, nz) of the features (N, nz) of training, `MARGIN` wide.

    None without a finite row.
    """
    finite = features[np.isfinite(features).all(axis=1)]
    if not finite.size:
        return None
    low, high = finite.min(axis=0), finite.max(axis=0)
    wider = np.maximum(MARGIN * (high - low) / 2, _WIDER * np.maximum(np.abs(low), np.abs(high)))
    return np.stack([low - wider, high + wider])


def pull_of(features: Callable[[Matrix], Matrix], points: Matrix) -> Matrix:
    """Return the matrix (nx, nz) by which x follows its features: `x̄ = x + pull (z̄ − z)`.

    x moves as little as it can, in half-widths of its own range. A feature that is no affine
    function of x moves nothing: beyond its range the physics beside the learner then goes on with
    its share of θ.

    Args:
        features: z (M, nz) of points x (M, nx).
        points: of training, which have the range of each entry of x.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    half = np.where(high > low, (high - low) / 2, np.maximum(np.abs(high), 1.0))
    n = len(half)
    scaled = np.random.default_rng(0).uniform(-1, 1, (n + 1 + _PROBES, n))
    with np.errstate(all="ignore"):
        z = features((low + high) / 2 + half * scaled)
    known = np.column_stack([scaled, np.ones(len(scaled))])
    finite = np.isfinite(z).all(axis=0)
    slope, *_ = np.linalg.lstsq(known, np.where(finite, z, 0.0), rcond=None)
    missed = np.abs(z - known @ slope).max(axis=0)
    affine = finite & (
        missed <= _AFFINE * np.abs(np.where(finite, z, 0.0)).max(axis=0, initial=0.0)
    )
    moves = np.linalg.pinv(slope[:n, affine].T, rcond=1e-9)
    moves[np.abs(moves) < 1e-9 * np.abs(moves).max(axis=0, initial=0.0)] = 0.0  # rounding
    pull = np.zeros((n, z.shape[1]))
    pull[:, affine] = half[:, None] * moves
    return pull


def clip_to_range(limits: AnyArray, z: Array) -> Array:
    """Return the features moved onto the range, z̄ (nz,)."""
    return jnp.clip(z, limits[0], limits[1])


def remaining_factor(beyond: str, limits: AnyArray, z: Array) -> Array | float:
    """Return the factor a of the correction at features z (nz,): 1 where it is held."""
    if beyond != "fade":
        return 1.0
    half = (limits[1] - limits[0]) / 2
    apart = (z - clip_to_range(limits, z)) / jnp.where(half > 0, half, 1.0)
    return jnp.exp(-jnp.sum(apart**2) / FADED**2)


def outside(limits: Matrix, features: Matrix) -> Vector:
    """Return where rows of features (N, nz) leave the range, (N,)."""
    with np.errstate(all="ignore"):
        return ~((features >= limits[0]) & (features <= limits[1])).all(axis=1)
