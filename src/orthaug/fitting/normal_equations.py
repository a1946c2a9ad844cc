"""The prediction criterion over the learner's weights, as normal equations from one pass over rows (F1, F4).

Rows are whitened: each output is divided by its standard deviation, and all rows by the RMS of what the
physics leaves unexplained, so a residual of 1 is as large as the baseline's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

from jaxtyping import Float

from orthaug._base.jax import Array, jax, jnp
from orthaug.models.learners import Bound
from orthaug.models.rows import Chunks, Overlap, gram, row_sum


class Hold(NamedTuple):
    """`‖target − matrix QᵀF‖²`: how a structure holds the learner's share in the span of the physics."""

    matrix: Float[Array, "nt nt"]
    target: Float[Array, "nt"]


class Normal(NamedTuple):
    """Gauss-Newton quantities of `‖r‖²`: `hessian` = JᵀJ, `gradient` = Jᵀr (downhill), `loss` = ‖r‖²."""

    hessian: Float[Array, "nw nw"]
    gradient: Float[Array, "nw"]
    loss: Float[Array, ""]
    overlap: Overlap


@dataclass(frozen=True)
class OneStep:
    """One-step prediction error with θ eliminated (F1): `‖P⊥(Y − F)‖²` plus the structure's `Hold`.

    θ minimises the rest exactly for any w, so it is not an unknown here. The Gram matrix of `[Q r J]`
    gives everything: `JᵀP⊥J = JᵀJ − (QᵀJ)ᵀ(QᵀJ)` (F4). Where J lies almost in the span of Q that
    difference cancels, so each chunk first subtracts the share that the previous pass found.
    """

    bound: Bound

    def __call__(self, w: Float[Array, "nw"], chunks: Chunks, hold: Hold, before: Overlap) -> Normal:
        total = row_sum(lambda chunk: self._blocks(w, chunk, before), chunks)
        nt = before.values.shape[0]
        g_qr, g_qj = total[:nt, nt], total[:nt, nt + 1 :]
        g_rr, g_jr, g_jj = total[nt, nt], total[nt + 1 :, nt], total[nt + 1 :, nt + 1 :]
        overlap = Overlap(before.jacobian + g_qj, before.values - g_qr)
        held = hold.matrix @ overlap.jacobian
        miss = hold.target - hold.matrix @ overlap.values
        return Normal(
            hessian=g_jj - g_qj.T @ g_qj + held.T @ held,
            gradient=g_jr - g_qj.T @ g_qr + held.T @ miss,
            loss=jnp.maximum(g_rr - g_qr @ g_qr, 0.0) + miss @ miss,  # a difference may round below zero
            overlap=overlap,
        )

    def _blocks(self, w: Float[Array, "nw"], chunk: Chunks, before: Overlap) -> Float[Array, "n n"]:
        """Gram matrix of the columns `[Q r J]` of one chunk, each column a row of `columns`."""
        values, jacobian = self.bound.jacobian(w, chunk.z, chunk.gain)
        nt, cells = chunk.q.shape[1], chunk.e.size  # outputs and rows as one axis of ny·m cells
        q = jnp.moveaxis(chunk.q, 1, 0).reshape(nt, cells)
        residual, jacobian = (chunk.e - values).reshape(cells), jacobian.reshape(-1, cells)
        for i in range(nt):  # unrolled, so that it fuses with the derivative
            residual = residual + before.values[i] * q[i]
            jacobian = jacobian - before.jacobian[i][:, None] * q[i]
        return gram(jnp.concatenate([q, residual[None], jacobian]))


@partial(jax.jit, static_argnames="criterion")
def linearise(
    criterion: Callable[..., Normal], w: Float[Array, "nw"], arguments: tuple[Any, ...], overlap: Overlap
) -> Normal:
    """The criterion at w, in two passes: the second subtracts the overlap that the first one found."""
    first = criterion(w, *arguments, overlap)
    return criterion(w, *arguments, first.overlap)
