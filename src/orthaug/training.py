"""Training the learner of a problem: scaling, chunks, and one run of the solver (F5)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from orthaug._arrays import Matrix, Vector
from orthaug._jax import jax, jnp
from orthaug.criteria import Chunks, Hold, Overlap, Prediction
from orthaug.gram import chunk_shape, from_chunks, in_chunks
from orthaug.learners import Bound, Learner
from orthaug.problem import Problem
from orthaug.regressors import Scaling
from orthaug.solvers.levenberg_marquardt import LevenbergMarquardt, Progress, Run

OUTPUT_UNIT = 10.0
"""The learner's output unit in standard deviations of the baseline's residual: the table is in docs/design.md."""
_SMALLEST_RESIDUAL = 1e-10  # of an output's deviation: the physics leaves at least rounding


@dataclass(frozen=True, eq=False)
class Task:
    """A problem with its learner, scaled for training.

    `unit` (ny,) is the learner's output unit in the outputs' units; `rms` is the RMS of the baseline's
    whitened residual, the unit of the criterion's rows.
    """

    problem: Problem
    bound: Bound
    scaling: Scaling
    unit: Vector
    rms: float
    chunks: Chunks

    @classmethod
    def of(cls, problem: Problem, learner: Learner, scaling: Scaling | None = None, unit: Vector | None = None) -> Task:
        """Scale features to [-1, 1] and the learner's output to the baseline's residual, unless both are given."""
        z = problem.feature_rows()
        bound = Bound(learner, z.shape[1], len(problem.outputs))
        e = problem.projection.orthogonal_part(problem.whitened_target)
        spread = np.maximum(e.std(axis=0), _SMALLEST_RESIDUAL)
        rms = float(np.sqrt(np.mean(spread**2)))
        scaling = Scaling.fit(z) if scaling is None else scaling
        unit = np.asarray(OUTPUT_UNIT * spread / problem.weight if unit is None else unit)
        shape = chunk_shape(len(z))
        gain = np.broadcast_to(unit * problem.weight / rms, e.shape)
        padded = in_chunks(scaling(z), shape, repeat=True)  # zeros may be where the learner has no value
        pieces = (padded, *(in_chunks(p, shape) for p in (problem.projection.q, e / rms, gain)))
        return cls(problem, bound, scaling, unit, rms, Chunks(*map(jnp.asarray, pieces)))

    def run(self, solver: LevenbergMarquardt, w: Any, regularization: str | float, progress: Progress | None) -> Run:
        """One run from the weights `w`; `regularization` as in `estimate`."""
        nt = self.chunks.q.shape[2]
        evidence = regularization == "evidence"
        return solver.minimise(
            Prediction(self.bound),
            w,
            (self.chunks, Hold(jnp.zeros((nt, nt)), jnp.zeros(nt))),
            Overlap(jnp.zeros((nt, self.bound.size)), jnp.zeros(nt)),
            ridge=1.0 if evidence else 0.0 if regularization == "none" else float(regularization),
            evidence=evidence,
            samples=self.problem.target.size - nt,
            progress=progress,
        )

    def mean_square(self, loss: Any) -> float:
        """The criterion's `‖r‖²` as the mean of squared errors with each output in its standard deviation."""
        return float(loss) * self.rms**2 / self.problem.target.size

    def values(self, w: Any) -> Float[np.ndarray, "N ny"]:
        """f at the training rows, in the outputs' units."""
        chunks = np.asarray(_values(self.bound, w, self.chunks.z))
        return from_chunks(chunks, len(self.problem.rows)) * self.unit

    def gram(self, run: Run) -> Matrix:
        """Gram matrix of `[Φ J]` in whitened outputs, from the run's last pass."""
        projection, overlap = self.problem.projection, np.asarray(run.normal.overlap.jacobian) * self.rms
        to_phi = projection.r / projection.scale
        inner = np.asarray(run.normal.hessian) * self.rms**2 + overlap.T @ overlap
        cross = to_phi.T @ overlap
        return np.block([[to_phi.T @ to_phi, cross], [cross.T, inner]])


@partial(jax.jit, static_argnames="bound")
def _values(bound: Bound, w: Float[Array, "nw"], z: Float[Array, "k nz m"]) -> Float[Array, "k ny m"]:
    one_chunk = jax.vmap(lambda row: bound.values(w, row), in_axes=-1, out_axes=-1)
    return jax.lax.map(one_chunk, z)
