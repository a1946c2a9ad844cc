"""Learned part of a motion: its uncertainty at a point, and its share of each equation.

The learner's part `f(x, u; c) + g(x, u; w) − f(x, u; p̂)` follows (c, w) by itself and by p̂, which
the split makes of them: both count in its intervals.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix
from orthaug._base.jax import AnyArray, Array, jax, jnp, quick_jit
from orthaug.fitting.motion_estimate import MotionEstimate
from orthaug.inference.covariance import reach
from orthaug.inference.splitting import rest_of
from orthaug.models.dynamics import Numbers
from orthaug.models.motion_field import labels_of, parts_at
from orthaug.models.moving import MotionDynamics


@dataclass(frozen=True)
class EquationParts:
    """RMS of what physics and learner add to an equation or output along a run, in its `unit`."""

    equation: str
    unit: str
    physics: float
    learner: float
    share: float | None
    """‖learner‖ / ‖physics + learner‖; None where both are zero."""


def equation_parts(fit: MotionEstimate, x: Matrix, u: Matrix) -> tuple[EquationParts, ...]:
    """Return the parts of every learned equation and output, over x (M, nx) and u (M, nu)."""
    physics, learner = parts_at(fit.model.form, fit.model.numbers, x, u)
    units, found = {channel.name: channel.unit for channel in fit.model.outputs}, []
    for (name, unit), own, beside in zip(
        labels_of(fit.model.form), physics.T, learner.T, strict=True
    ):
        finite = np.isfinite(own) & np.isfinite(beside)
        if not finite.any():
            continue
        own, beside = own[finite], beside[finite]
        rms = [float(np.sqrt(np.mean(part**2))) for part in (own, beside, own + beside)]
        share = rms[1] / rms[2] if rms[2] > 0 else None
        found.append(EquationParts(name, unit or units.get(name, ""), rms[0], rms[1], share))
    return tuple(found)


def learned_reach(fit: MotionEstimate, x: Matrix, u: Matrix) -> Matrix | None:
    """Return half the length of 95 % intervals of the learner's part (M, nl), point by point.

    None without intervals, and where some parameter is not identified: the prior of the weights
    then holds both.
    """
    made, slope = fit.free_covariance(), fit.split_by.slope
    if made is None or slope is None or fit.unidentified:
        return None
    joint, moves = made
    by_q, beside = (np.asarray(part) for part in _slopes(fit.model.form, fit.model.numbers, x, u))
    follows = (beside + by_q @ slope)[..., moves] @ joint.root()
    return reach(fit.freedom) * np.linalg.norm(follows, axis=-1)


@partial(quick_jit, static_argnames="form")
def _slopes(
    form: MotionDynamics, numbers: Numbers, x: Float[Array, "m nx"], u: Float[Array, "m nu"]
) -> tuple[Float[Array, "m nl np"], Float[Array, "m nl n"]]:
    """Return the derivatives of the learner's part by p̂, and by (c, w)."""
    c = numbers.c

    def at(x: Array, u: Array) -> Any:
        def part(q: AnyArray, c: AnyArray, w: AnyArray) -> Any:
            return rest_of(form, numbers, q, c, w, x, u, 1.0)

        by_q, by_c, by_w = jax.jacrev(part, (0, 1, 2))(numbers.theta, c, numbers.weights)
        return by_q, jnp.concatenate([by_c, by_w], axis=1)

    return jax.vmap(at)(x, u)
