"""The outputs before each segment as unknowns of their own, eliminated from the normal equations.

They were measured with the same errors as all other outputs and are scored like them, `‖W (y − p)‖²`; each touches its
own segment only, so a Schur complement per segment removes them. Without this, noise in a segment's measured lags would
be a disturbance that the model has to explain.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug.fitting.segments import Sensitivity


@dataclass(eq=False)
class Pasts:
    """The pasts of all segments, (k, na, ny, m): `measured`, and `values` as estimated so far where they are `free`."""

    measured: Float[np.ndarray, "k na ny m"]
    values: Float[np.ndarray, "k na ny m"]
    free: bool
    offset: np.ndarray | None = field(default=None)
    slope: np.ndarray | None = field(default=None)

    def loss(self, values: Float[np.ndarray, "k na ny m"], weight: Matrix) -> float:
        """‖W (y − p)‖²."""
        with np.errstate(all="ignore"):
            return float(np.sum(np.einsum("oi,knim->knom", weight, self.measured - values) ** 2))

    def eliminate(self, found: Sensitivity, weight: Matrix) -> tuple[Matrix, Vector]:
        """Normal matrix and right-hand side of (c, w) with the pasts at their best, which `after` then follows."""
        shared = np.asarray(found.shared)
        if not self.free:
            return shared[:-1, :-1], shared[:-1, -1]
        own = np.moveaxis(np.asarray(found.own), -1, 1)  # (k, m, n0, n0+n+1)
        na, ny = self.measured.shape[1:3]
        n0 = na * ny
        prior = np.kron(np.eye(na), weight.T @ weight)
        missed = np.moveaxis(self.measured - self.values, -1, 1).reshape(*own.shape[:2], n0)
        inner = own[..., :n0] + prior
        across, right = own[..., n0:-1], own[..., -1] + missed @ prior
        solved = np.linalg.solve(inner, np.concatenate([across, right[..., None]], axis=-1))
        self.slope, self.offset = solved[..., :-1], solved[..., -1]
        hessian = shared[:-1, :-1] - np.tensordot(across, self.slope, axes=([0, 1, 2], [0, 1, 2]))
        gradient = shared[:-1, -1] - np.tensordot(across, self.offset, axes=([0, 1, 2], [0, 1, 2]))
        return (hessian + hessian.T) / 2, gradient

    def after(self, step: Vector) -> Float[np.ndarray, "k na ny m"]:
        """The best pasts to first order, when (c, w) moves by `step` from where it was linearised."""
        if self.offset is None or self.slope is None:
            return self.values
        moved = self.offset - self.slope @ step
        return self.values + np.moveaxis(moved.reshape(*moved.shape[:2], *self.measured.shape[1:3]), 1, -1)
