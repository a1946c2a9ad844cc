"""Criteria: what is minimised over the learner's weights, as normal equations from one pass over rows.

Rows are whitened: each output is divided by its standard deviation, and all rows by the RMS of what the
physics leaves unexplained, so a residual of 1 is as large as the baseline's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

from jaxtyping import Array, Float

from orthaug._arrays import check_count
from orthaug._jax import jax, jnp
from orthaug.errors import InputError
from orthaug.gram import gram, row_sum
from orthaug.learners import Bound


@dataclass(frozen=True)
class Prediction:
    """Declaration: the error of the prediction `horizon` steps ahead; 1 is the paper's criterion (eq:cost_fun)."""

    horizon: int = 1

    def __post_init__(self) -> None:
        check_count(self.horizon, "horizon")

    @property
    def flown(self) -> Simulation | None:
        """The free run that gives it: segments of `horizon` steps whose last one is scored; None for one step."""
        return Simulation(self.horizon, self.horizon - 1, exact_start=True) if self.horizon > 1 else None


@dataclass(frozen=True)
class Simulation:
    """Declaration: the error of a free run over segments that start from measured lags.

    With a washout, or over whole experiments, the outputs before a segment are taken for as noisy as all others: they
    are unknowns too (`Pasts`). Segments without a washout start exactly from what was measured.

    Args:
        segment: steps of a segment; 0 for whole experiments.
        washout: leading steps of a segment that are not scored, until its start is forgotten.
        start_iterations: one-step iterations that training starts from.
        exact_start: whether a segment starts exactly from what was measured; None for the rule above.
    """

    segment: int = 512
    washout: int = 40
    start_iterations: int = 20
    exact_start: bool | None = None

    def __post_init__(self) -> None:
        for name in ("segment", "washout", "start_iterations"):
            check_count(getattr(self, name), name, least=0)
        if self.segment and self.washout >= self.segment:
            raise InputError(
                f"`washout` must be shorter than `segment`; got {self.washout} and {self.segment}: nothing is scored."
            )

    @property
    def flown(self) -> Simulation:
        """Itself: the free run that training makes."""
        return self

    @property
    def estimates_pasts(self) -> bool:
        """Whether the outputs before a segment are unknowns."""
        if self.exact_start is not None:
            return not self.exact_start
        return self.washout > 0 or self.segment == 0


Criterion = Prediction | Simulation


class Chunks(NamedTuple):
    """Rows of the prediction criterion in chunks of m rows; zero gain and zero entries are padding."""

    z: Float[Array, "k nz m"]
    """Scaled learner features."""
    q: Float[Array, "k ny nt m"]
    """Orthonormal basis of the physics."""
    e: Float[Array, "k ny m"]
    """P⊥Y, what the physics cannot express."""
    gain: Float[Array, "k ny m"]
    """Unit of the learner's output in whitened rows."""


class Hold(NamedTuple):
    """`‖target − matrix QᵀF‖²`: how a structure holds the learner's share in the span of the physics."""

    matrix: Float[Array, "nt nt"]
    target: Float[Array, "nt"]


class Overlap(NamedTuple):
    """What an earlier pass found of the learner in the span of the physics."""

    jacobian: Float[Array, "nt nw"]
    """QᵀJ."""
    values: Float[Array, "nt"]
    """QᵀF."""


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


@partial(jax.jit, static_argnames="bound")
def share_of(bound: Bound, w: Float[Array, "nw"], chunks: Chunks) -> Overlap:
    """QᵀJ and QᵀF of the learner in one pass."""
    one = OneStep(bound)
    nt = chunks.q.shape[2]
    nothing = Overlap(jnp.zeros((nt, w.shape[0])), jnp.zeros(nt))
    return one(w, chunks, Hold(jnp.zeros((nt, nt)), jnp.zeros(nt)), nothing).overlap


@partial(jax.jit, static_argnames="bound")
def mixed_gram(bound: Bound, w: Float[Array, "nw"], chunks: Chunks, mix: Float[Array, "ny ny"]) -> Float[Array, "n n"]:
    """Gram matrix of `[Q J]` with the outputs of every row multiplied by `mix`: `ΣψᵀΣ_eψ` for `Σ_e = mixᵀ mix`."""

    def one_chunk(chunk: Chunks) -> Float[Array, "n n"]:
        jacobian = bound.jacobian(w, chunk.z, chunk.gain)[1]
        columns = jnp.concatenate([jnp.moveaxis(chunk.q, 1, 0), jacobian])
        return gram(jnp.einsum("oi,nim->nom", mix, columns).reshape(len(columns), -1))

    return row_sum(one_chunk, chunks)


@partial(jax.jit, static_argnames="bound")
def projected_gram(
    bound: Bound, w: Float[Array, "nw"], chunks: Chunks, mix: Float[Array, "ny ny"]
) -> Float[Array, "n n"]:
    """Gram matrix of `[Q P⊥J]`, outputs multiplied by `mix`; J is projected twice, so that Q and it are orthogonal."""

    def projected(chunk: Chunks, overlaps: tuple[Any, ...]) -> tuple[Any, Any]:
        q = jnp.moveaxis(chunk.q, 1, 0)  # (nt, ny, m)
        jacobian = bound.jacobian(w, chunk.z, chunk.gain)[1]
        for overlap in overlaps:
            jacobian = jacobian - jnp.einsum("tw,tom->wom", overlap, q)
        return q, jacobian

    def columns(chunk: Chunks) -> Float[Array, "n n"]:
        mixed = jnp.einsum("oi,nim->nom", mix, jnp.concatenate(projected(chunk, overlaps)))
        return gram(mixed.reshape(len(mixed), -1))

    overlaps: tuple[Any, ...] = ()
    for _ in range(2):
        before = overlaps
        overlaps = (*before, row_sum(lambda chunk, o=before: jnp.einsum("tom,wom->tw", *projected(chunk, o)), chunks))
    return row_sum(columns, chunks)


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
