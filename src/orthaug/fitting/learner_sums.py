"""Sums over rows of a learner whose weights are given: its share in the physics, its size, the residual it leaves."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

from jaxtyping import Float

from orthaug._base.jax import Array, jax, jnp
from orthaug.models.learners import Bound
from orthaug.models.rows import Chunk


@partial(jax.jit, static_argnames="bound")
def row_values(bound: Bound, w: Float[Array, "nw"], z: Float[Array, "k nz m"]) -> Float[Array, "k ny m"]:
    """f at every row, in the learner's unit."""
    one_chunk = jax.vmap(lambda row: bound.values(w, row), in_axes=-1, out_axes=-1)
    return jax.lax.map(one_chunk, z)


def _values(bound: Bound | None, chunk: Chunk, w: Any, tilt: Any) -> Float[Array, "ny m"]:
    """F of one chunk; of an ensemble the median of its members, each with the physics that it adds."""
    if bound is None:
        return jnp.zeros_like(chunk.e)

    def member_values(w: Any) -> Any:
        values = jax.vmap(lambda z: bound.values(w, z), in_axes=-1, out_axes=-1)(chunk.z)
        return jnp.sum(chunk.gain * values, axis=1)

    if tilt is None:
        return member_values(w)
    return jnp.median(jax.vmap(member_values)(w) + jnp.einsum("otm,it->iom", chunk.q, tilt), axis=0)


@dataclass(frozen=True)
class LearnerSums:
    """Qᵀ(F − Q shift) and ‖F‖² of one chunk."""

    bound: Bound | None

    def __call__(self, chunk: Chunk, w: Any, tilt: Any, shift: Any) -> tuple[Any, Any]:
        values = _values(self.bound, chunk, w, tilt)
        rest = values - jnp.einsum("otm,t->om", chunk.q, shift)
        return jnp.einsum("otm,om->t", chunk.q, rest), jnp.sum(values**2)


@dataclass(frozen=True)
class ResidualGram:
    """Σ r rᵀ of one chunk, `r = P⊥Y − F + Q physics`."""

    bound: Bound | None

    def __call__(self, chunk: Chunk, w: Any, tilt: Any, physics: Any) -> Any:
        residual = chunk.e - _values(self.bound, chunk, w, tilt) + jnp.einsum("otm,t->om", chunk.q, physics)
        return residual @ residual.T
