"""The paper's own criterion over θ and weights together: value and normal equations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.jax import Array, jax, jnp
from orthaug.fitting.elimination import Elimination, Fixed
from orthaug.fitting.normal_equations import Blocks, Hold, Normal, collect
from orthaug.models.learners import Bound
from orthaug.models.rows import Chunk, Overlap, row_sum
from orthaug.physics.problem import Problem


class Physics(NamedTuple):
    """θ as an unknown beside w, by its coordinates, with the structure's rows.

    The coordinates are `q = start + basis v` in whitened rows.
    """

    start: Float[Array, "nt"]
    basis: Float[Array, "nt nt"]
    outputs: Float[Array, "nt"]
    """QᵀY."""
    rows_v: Float[Array, "nt nt"]
    rows_f: Float[Array, "nt nt"]
    rows_target: Float[Array, "nt"]
    samples: Float[Array, ""]
    ridge: Float[Array, ""]

    @classmethod
    def of(
        cls,
        problem: Problem,
        elimination: Elimination,
        fixed: Fixed,
        ridge: float,
        rms: float,
        *,
        solved: bool,
    ) -> Physics:
        """Return θ that starts at θ⁰; a free entry has a column, scaled to the size of a row.

        A fixed one has none.

        Where θ is `solved` (F1), it is at its end and has no columns: the learner's path does
        not depend on it.
        """
        to_rows = elimination.to_coordinates / rms
        initial = np.array(
            [fixed.get(i, value) for i, value in enumerate(problem.baseline.initial)]
        )
        free = np.array([float(i not in fixed) for i in range(len(initial))])
        nt = len(initial)
        scale = free * np.sqrt(problem.count) / np.linalg.norm(to_rows, axis=0) if nt else free

        def pad_matrix(matrix: np.ndarray) -> np.ndarray:
            return np.concatenate([matrix, np.zeros((nt - len(matrix), *matrix.shape[1:]))])

        penalty = elimination.rows
        held = elimination.hold(fixed) if solved else None
        pieces = (
            elimination.outputs / rms if solved else to_rows @ initial,
            to_rows * (0.0 if solved else scale),
            elimination.outputs / rms,
            pad_matrix(penalty.theta * scale) / rms,
            pad_matrix(penalty.learner) if held is None else held[0],
            (pad_matrix(penalty.target - penalty.theta @ initial) if held is None else held[1])
            / rms,
            problem.samples,
            ridge,
        )
        return cls(*(jnp.asarray(piece, dtype=float) for piece in pieces))


@dataclass(frozen=True)
class PaperCriterion:
    """Mean square of `Y − Φθ − F`, and the structure's rows, as a function of θ and w.

    In the orthogonal structure the learner enters as P⊥F, which decouples θ and w (F1).
    """

    bound: Bound
    orthogonal: bool

    def __call__(
        self,
        unknowns: tuple[Float[Array, "nt"], Float[Array, "nw"]],
        chunks: Chunk,
        physics: Physics,
    ) -> Float[Array, ""]:
        v, w = unknowns
        miss = physics.outputs - physics.start - physics.basis @ v  # QᵀY − Rθ
        square, share = row_sum(lambda chunk: self._sums(w, chunk), chunks)
        rows = physics.rows_target - physics.rows_v @ v - physics.rows_f @ share
        total = square - share @ share + rows @ rows
        total = total + (miss @ miss if self.orthogonal else jnp.sum((miss - share) ** 2))
        return (total + physics.ridge * (w @ w)) / physics.samples

    def _sums(
        self, w: Float[Array, "nw"], chunk: Chunk
    ) -> tuple[Float[Array, ""], Float[Array, "nt"]]:
        """Return ‖P⊥Y − F‖² and QᵀF of one chunk."""
        row_values = jax.vmap(self.bound.values, in_axes=(None, -1), out_axes=-1)
        values = jnp.sum(chunk.gain * row_values(w, chunk.z), axis=1)
        return jnp.sum((chunk.e - values) ** 2), jnp.einsum("ytm,ym->t", chunk.q, values)


@dataclass(frozen=True)
class JointOneStep:
    """Normal equations of the one-step error `‖Y − Φθ − F‖²` over p = (v, w).

    v are θ's unknowns, w the weights.
    """

    bound: Bound

    def __call__(
        self, p: Float[Array, "n"], rows: Chunk, physics: Physics, before: Overlap
    ) -> Normal:
        nt = len(physics.outputs)
        v, w = p[:nt], p[nt:]
        # Of QᵀJ and QᵀF, subtracted from the rows
        known = Overlap(before.jacobian[:, nt:], before.values)
        blocks, free = Blocks(self.bound), Hold(jnp.zeros((nt, nt)), jnp.zeros(nt))
        # What is orthogonal to Q
        rest = collect(row_sum(lambda chunk: blocks(chunk, w, known), rows), free, known)
        share = rest.overlap
        miss = physics.outputs - physics.start - physics.basis @ v - share.values  # Qᵀ(Y − Φθ − F)
        slope = jnp.concatenate([physics.basis, share.jacobian], axis=1)  # Qᵀ of all columns
        return Normal(
            hessian=jnp.pad(rest.hessian, ((nt, 0), (nt, 0))) + slope.T @ slope,
            gradient=jnp.pad(rest.gradient, (nt, 0)) + slope.T @ miss,
            loss=rest.loss + miss @ miss,
            overlap=Overlap(jnp.pad(share.jacobian, ((0, 0), (nt, 0))), share.values),
        )
