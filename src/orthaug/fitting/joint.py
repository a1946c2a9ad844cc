"""The paper's own problem, over θ and the learner's weights together, for gradient solvers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from jaxtyping import Float

from orthaug._base.jax import Array, jax, jnp
from orthaug.models.learners import Bound
from orthaug.models.rows import Chunks, row_sum


class Physics(NamedTuple):
    """θ as an unknown beside w: coordinates `q = start + basis v` in whitened rows, and the structure's rows."""

    start: Float[Array, "nt"]
    basis: Float[Array, "nt nt"]
    outputs: Float[Array, "nt"]
    """QᵀY."""
    rows_v: Float[Array, "nt nt"]
    rows_f: Float[Array, "nt nt"]
    rows_target: Float[Array, "nt"]
    samples: Float[Array, ""]
    ridge: Float[Array, ""]


@dataclass(frozen=True)
class Joint:
    """The paper's own problem, for gradient solvers: mean square of `Y − Φθ − F` over θ and w together.

    In the orthogonal structure the learner enters as P⊥F, which decouples the two (F1).
    """

    bound: Bound
    orthogonal: bool

    def __call__(
        self, unknowns: tuple[Float[Array, "nt"], Float[Array, "nw"]], chunks: Chunks, physics: Physics
    ) -> Float[Array, ""]:
        v, w = unknowns
        miss = physics.outputs - physics.start - physics.basis @ v  # QᵀY − Rθ
        square, share = row_sum(lambda chunk: self._sums(w, chunk), chunks)
        if self.orthogonal:
            total = square - share @ share + miss @ miss
        else:
            total = square - share @ share + jnp.sum((miss - share) ** 2)
            rows = physics.rows_target - physics.rows_v @ v - physics.rows_f @ share
            total = total + rows @ rows
        return (total + physics.ridge * (w @ w)) / physics.samples

    def _sums(self, w: Float[Array, "nw"], chunk: Chunks) -> tuple[Float[Array, ""], Float[Array, "nt"]]:
        """‖P⊥Y − F‖² and QᵀF of one chunk."""
        one = jax.vmap(self.bound.values, in_axes=(None, -1), out_axes=-1)
        values = chunk.gain * one(w, chunk.z)
        return jnp.sum((chunk.e - values) ** 2), jnp.einsum("ytm,ym->t", chunk.q, values)
