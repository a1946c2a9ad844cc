"""Small problems that several tests share."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from orthaug.fitting.normal_equations import Hold, OneStep
from orthaug.models.learners import Bound, Learner
from orthaug.models.rows import Chunk, Overlap, chunk_shape, in_chunks


class Problem(NamedTuple):
    """A prediction problem whose rows are chosen directly, not read from a record."""

    criterion: OneStep
    z: np.ndarray
    """Features (N, nz)."""
    q: np.ndarray
    """Orthonormal basis of the physics (N, ny, nt)."""
    e: np.ndarray
    """P⊥Y (N, ny)."""
    gain: np.ndarray
    """(N, ny), of each output its own."""
    rows: Chunk
    hold: Hold

    @property
    def bound(self) -> Bound:
        return self.criterion.bound

    @property
    def arguments(self) -> tuple[Chunk, Hold]:
        """What the solver hands to the criterion."""
        return self.rows, self.hold

    @property
    def nothing(self) -> Overlap:
        """No overlap known yet."""
        nt = self.q.shape[2]
        return Overlap(jnp.zeros((nt, self.bound.size)), jnp.zeros(nt))


def problem(
    learner: Learner,
    z: np.ndarray,
    y: np.ndarray,
    phi: np.ndarray,
    gain: np.ndarray | None = None,
    limit: int = 64,
) -> Problem:
    """Rows in chunks of at most about `limit`, padded; no share of the learner is held."""
    rows, ny, nt = phi.shape
    q = np.linalg.qr(phi.reshape(rows * ny, nt))[0].reshape(rows, ny, nt)
    e = y
    for _ in range(2):
        e = e - q @ np.tensordot(q, e, axes=([0, 1], [0, 1]))
    gain = np.ones_like(y) if gain is None else gain
    shape = chunk_shape(rows, limit)
    laid = Chunk(
        *(
            jnp.asarray(in_chunks(values, shape))
            for values in (z, q, e, gain[..., None] * np.eye(ny))
        )
    )
    hold = Hold(jnp.zeros((nt, nt)), jnp.zeros(nt))
    return Problem(OneStep(Bound(learner, z.shape[1], ny)), z, q, e, gain, laid, hold)


def linear_columns(given: Problem) -> np.ndarray:
    """P⊥J (N ny, nw) of a learner that is linear in its weights, by automatic differentiation at zero."""
    w = jnp.zeros(given.bound.size)
    slope = jax.jacrev(
        lambda w: given.gain * jax.vmap(lambda row: given.bound.values(w, row))(given.z)
    )
    jacobian = jax.jit(slope)(w)
    columns = np.asarray(jacobian).reshape(given.e.size, -1)
    q = given.q.reshape(given.e.size, -1)
    for _ in range(2):
        columns = columns - q @ (q.T @ columns)
    return columns


def unfolded(text: str) -> str:
    """Printed text on one line."""
    return " ".join(text.split())
