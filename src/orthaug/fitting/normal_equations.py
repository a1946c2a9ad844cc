"""Normal equations of the one-step criterion over the weights, in one pass over rows (F1, F4).

Rows are whitened: each output is divided by its standard deviation, and all rows by the RMS of the
baseline's residual. So a residual of 1 is as large as the baseline's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.jax import AnyArray, Array, jax, jnp
from orthaug.models.learners import Bound
from orthaug.models.rows import Chunk, Engine, Overlap, gram, row_sum


class Hold(NamedTuple):
    """`‖target − matrix QᵀF‖²`: the structure's term on the learner's share in the physics."""

    matrix: Float[Array | np.ndarray, "nt nt"]
    target: Float[Array | np.ndarray, "nt"]


class Normal(NamedTuple):
    """Gauss-Newton quantities of `‖r‖²`: `hessian` JᵀJ, `gradient` Jᵀr (downhill), `loss` ‖r‖²."""

    hessian: Float[Array, "nw nw"]
    gradient: Float[Array, "nw"]
    loss: Float[Array, ""]
    overlap: Overlap


@dataclass(frozen=True)
class Blocks:
    """Gram matrix of the columns `[Q r J]` of one chunk: its share of the sum.

    Where J lies almost in the span of Q, `JᵀJ − (QᵀJ)ᵀ(QᵀJ)` cancels. So the overlap of the
    previous pass is subtracted first.
    """

    bound: Bound

    def __call__(self, chunk: Chunk, w: Float[Array, "nw"], before: Overlap) -> Float[Array, "n n"]:
        values, jacobian = chunk.derivatives(self.bound, w)
        nt, cells = chunk.q.shape[1], chunk.e.size  # outputs and rows as one axis of ny·m cells
        q = jnp.moveaxis(chunk.q, 1, 0).reshape(nt, cells)
        residual, jacobian = (chunk.e - values).reshape(cells), jacobian.reshape(-1, cells)
        for i in range(nt):  # unrolled, so that it fuses with the derivative
            residual = residual + before.values[i] * q[i]
            jacobian = jacobian - before.jacobian[i][:, None] * q[i]
        return gram(jnp.concatenate([q, residual[None], jacobian]))


def collect(total: Float[Array, "n n"], hold: Hold, before: Overlap) -> Normal:
    """Return the normal equations from the sum of all `Blocks`, plus the structure's `Hold`.

    `JᵀP⊥J = JᵀJ − (QᵀJ)ᵀ(QᵀJ)`.
    """
    nt = before.values.shape[0]
    g_qr, g_qj = total[:nt, nt], total[:nt, nt + 1 :]
    g_rr, g_jr, g_jj = total[nt, nt], total[nt + 1 :, nt], total[nt + 1 :, nt + 1 :]
    overlap = Overlap(before.jacobian + g_qj, before.values - g_qr)
    held = hold.matrix @ overlap.jacobian
    miss = hold.target - hold.matrix @ overlap.values
    return Normal(
        hessian=g_jj - g_qj.T @ g_qj + held.T @ held,
        gradient=g_jr - g_qj.T @ g_qr + held.T @ miss,
        loss=jnp.maximum(g_rr - g_qr @ g_qr, 0.0)
        + miss @ miss,  # a difference may round below zero
        overlap=overlap,
    )


@dataclass(frozen=True)
class OneStep:
    """One-step prediction error with θ eliminated (F1): `‖P⊥(Y − F)‖²` plus the structure's `Hold`.

    θ minimises the rest exactly for any w, so it is not an unknown here; rows are in memory.
    """

    bound: Bound

    def __call__(self, w: Float[Array, "nw"], rows: Chunk, hold: Hold, before: Overlap) -> Normal:
        blocks = Blocks(self.bound)
        return collect(row_sum(lambda chunk: blocks(chunk, w, before), rows), hold, before)


@partial(jax.jit, static_argnames="criterion")
def one_pass(
    criterion: Callable[..., Normal],
    w: Float[Array, "nw"],
    arguments: tuple[object, ...],
    overlap: Overlap,
) -> Normal:
    """Return the criterion at w.

    The programs around it trace it once, together.
    """
    return criterion(w, *arguments, overlap)


def linearise(
    criterion: Callable[..., Normal],
    w: Float[Array, "nw"],
    arguments: tuple[object, ...],
    overlap: Overlap,
) -> Normal:
    """Return the criterion at w, in two passes: the second subtracts the overlap of the first."""
    first = one_pass(criterion, w, arguments, overlap)
    return one_pass(criterion, w, arguments, first.overlap)


@dataclass(frozen=True, eq=False)
class SummedOneStep:
    """The criterion `OneStep` over rows that an engine sums over, wherever they are."""

    engine: Engine
    bound: Bound
    rows: Any
    hold: Hold

    def __call__(self, w: AnyArray, before: Overlap) -> Normal:
        """Return the normal equations at w; `before` is the overlap from the previous pass."""
        return _collect(
            self.engine.sum(Blocks(self.bound), self.rows, w, before), self.hold, before
        )


_collect = jax.jit(collect)
