"""Initial states of segments: unknowns that are eliminated from the normal equations.

A state is scored against the measured one, `‖L (x − measured)‖²`, because past outputs have errors
like all others. A state acts on its own segment only, so a Schur complement per segment removes it.
If the states were not unknowns, noise in a segment's measured lags would be a disturbance that the
model has to explain.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import AnyArray, ArrayModule
from orthaug.fitting.segments import Sensitivity

_UNSEEN = 1e-12  # of the largest curvature: a combination of states that no output shows
_LED = 0.1  # of what the best states are off: a step that moves them less follows, they lead


class Start(NamedTuple):
    """Start states of a trial (k, n0, m), and their derivative by (c, w)."""

    values: Float[np.ndarray, "k n0 m"]
    misfit: float = np.inf
    """`‖r‖²` with the best states. A trial is compared with it."""
    unknowns: Vector | None = None
    """(c, w) there; None before anything was linearised."""
    offset: Float[np.ndarray, "k m n0"] | None = None
    slope: Float[np.ndarray, "k m n0 n"] | None = None
    there: Any = None
    """`Best` of the segments of an engine that keeps them, instead of `offset` and `slope`."""

    @property
    def follows(self) -> bool:
        """True where the derivative of the best states by (c, w) is known."""
        return self.slope is not None or self.there is not None

    def at(self, unknowns: Vector, share: float = 1.0) -> Float[np.ndarray, "k n0 m"] | None:
        """Return the best states to first order where (c, w) is `unknowns`.

        None where that is not known.

        Args:
            share: of the way to them.
        """
        if self.offset is None or self.slope is None or self.unknowns is None:
            return None
        moved = self.offset - self.slope @ (unknowns - self.unknowns)
        return self.values + share * np.moveaxis(moved, 1, -1)

    def is_led_by_states(self, unknowns: Vector) -> bool:
        """Return whether a step of (c, w) moves the best states by less than they are off."""
        if self.offset is None or self.slope is None or self.unknowns is None:
            return False
        followed = np.linalg.norm(self.slope @ (unknowns - self.unknowns), axis=-1)
        return bool(np.all(followed <= _LED * np.linalg.norm(self.offset, axis=-1)))


@dataclass(frozen=True, eq=False)
class InitialStates:
    """The states before training: `measured` (k, n0, m), and whether they are `free` unknowns."""

    measured: Float[np.ndarray, "k n0 m"]
    free: bool

    def loss(self, values: Float[np.ndarray, "k n0 m"], rows: Matrix) -> float:
        """Return `‖L (measured − x)‖²`, L = `rows` (n0, n0)."""
        with np.errstate(all="ignore"):
            return float(np.sum(np.einsum("oi,kim->kom", rows, self.measured - values) ** 2))

    def eliminate(
        self, sensitivity: Sensitivity, values: Float[np.ndarray, "k n0 m"], rows: Matrix
    ) -> tuple[
        Matrix, Vector, Float[np.ndarray, "k m n0"] | None, Float[np.ndarray, "k m n0 n"] | None
    ]:
        """Return the normal equations of (c, w) with the states at their best.

        And the derivative of these states by (c, w).

        The best states are `values + offset − slope · step` for a small step of (c, w).
        """
        shared = np.asarray(sensitivity.shared)
        if not self.free:
            return shared[:-1, :-1], shared[:-1, -1], None, None
        own = np.moveaxis(np.asarray(sensitivity.own), -1, 1)  # (k, m, n0, n0+n+1)
        missed = np.moveaxis(self.measured - values, -1, 1)
        try:
            return without_states(shared, own, missed, rows.T @ rows, np)
        except np.linalg.LinAlgError:  # a combination of states that no output shows
            pass
        try:
            return without_states(shared, own, missed, rows.T @ rows, np, _solve_shown)
        except np.linalg.LinAlgError:  # no numbers: the trial is rejected
            nothing = np.full_like(shared[:-1, :-1], np.nan)
            return nothing, nothing[0], None, None


def _solve_shown(inner: Any, right: Any) -> Any:
    """Return the least solution of each block, which does not move what no output shows."""
    size = np.sqrt(np.maximum(np.diagonal(inner, axis1=-2, axis2=-1), 0.0))
    scale = 1 / np.where(size > 0, size, 1.0)
    even = inner * scale[..., :, None] * scale[..., None, :]
    inverse = np.linalg.pinv(even, rcond=_UNSEEN, hermitian=True)
    return scale[..., None] * (inverse @ (scale[..., None] * right))


def without_states(
    shared: Any, own: Any, missed: AnyArray, prior: AnyArray, xp: ArrayModule, solve: Any = None
) -> tuple[Any, Any, Any, Any]:
    """Return the normal equations of (c, w), and offset and slope of the states.

    By a Schur complement per segment.

    Args:
        own: (…, n0, n0 + n + 1), of the segments in front.
        missed: (…, n0), measured states less those that were run from.
        prior: (n0, n0), LᵀL.
        xp: NumPy, which raises where a block is singular, or JAX, which gives no finite numbers.
        solve: of the blocks, where it is not that of `xp`.
    """
    n0, segments = own.shape[-2], tuple(range(own.ndim - 1))
    inner = own[..., :n0] + prior
    across, right = own[..., n0:-1], own[..., -1] + missed @ prior
    solve = xp.linalg.solve if solve is None else solve
    solved = solve(inner, xp.concatenate([across, right[..., None]], axis=-1))
    slope, offset = solved[..., :-1], solved[..., -1]
    hessian = shared[:-1, :-1] - xp.tensordot(across, slope, axes=(segments, segments))
    gradient = shared[:-1, -1] - xp.tensordot(across, offset, axes=(segments, segments))
    return (hessian + hessian.T) / 2, gradient, offset, slope
