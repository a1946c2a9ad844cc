"""Rows prepared for an engine, and the learner trained on them by sums over rows (F4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import AnyArray, Array
from orthaug.fitting.learned import TrainedLearner
from orthaug.fitting.normal_equations import Blocks
from orthaug.inference.covariance import mixing_matrix
from orthaug.models.learners import Bound, Scaling, nothing_learned
from orthaug.models.rows import (
    Engine,
    LearnerSums,
    MixedGram,
    Overlap,
    ResidualGram,
    from_chunks,
    row_values,
)
from orthaug.physics.problem import Problem
from orthaug.physics.streamed import StreamedProblem


class Share(NamedTuple):
    """The learner's values F over the rows: QᵀF (nθ,), its part in the physics, and ‖F‖².

    In whitened outputs.
    """

    coordinates: Vector
    square: float


@dataclass(frozen=True, eq=False)
class TrainingRows:
    """A problem with its learner, scaled for training.

    `unit` (ny,) is the learner's output unit in the outputs' units. `rms` is the RMS of the
    baseline's whitened residual, the unit of the criterion's rows. The engine keeps these rows.
    """

    problem: Problem
    bound: Bound
    scaling: Scaling
    unit: Vector
    rms: float
    engine: Engine
    rows: Any

    @property
    def _no_overlap(self) -> Overlap:
        """The overlap before any pass."""
        nt, size = len(self.problem.baseline.names), self.bound.size
        return Overlap(np.zeros((nt, size)), np.zeros(nt))

    def mean_square(self, loss: Array | float) -> float:
        """Return the criterion's `‖r‖²` as a mean of squared errors.

        Each output counts in its standard deviation.
        """
        return float(loss) * self.rms**2 / self.problem.samples

    def share(self, learned: TrainedLearner) -> Share:
        """Return QᵀF, refined once, and ‖F‖²; not finite where the learner is not."""
        f = np.zeros(len(self.problem.baseline.names))
        if not learned.bound.learns:
            return Share(f, 0.0)
        for _ in range(2):
            rest, square = self._sums(learned, f)
            f = f + rest
        return Share(f, square)

    def left_share(self, learned: TrainedLearner, theta: Vector) -> Vector:
        """Return Qᵀ(F − Φθ) (nθ,), in whitened outputs."""
        return self._sums(learned, self.problem.projection.to_coordinates @ theta)[0]

    def residual_gram(self, learned: TrainedLearner, c: Vector) -> Matrix:
        """Return Σ r rᵀ (ny, ny) of the residual r = Y − F − Φc, in whitened outputs."""
        problem = self.problem
        physics = problem.target_coordinates - problem.projection.to_coordinates @ c
        total = self.engine.sum(
            ResidualGram(learned.bound), self.rows, *self._weights(learned), physics / self.rms
        )
        return np.asarray(total) * self.rms**2

    def _sums(self, learned: TrainedLearner, shift: Vector) -> tuple[Vector, float]:
        summed = LearnerSums(learned.bound)
        rest, square = self.engine.sum(summed, self.rows, *self._weights(learned), shift / self.rms)
        return np.asarray(rest) * self.rms, float(square) * self.rms**2

    def values(self, w: Vector) -> Float[np.ndarray, "N ny"]:
        """Return f at the training rows in memory, in the outputs' units."""
        if not self.bound.learns:  # nothing to compile
            return np.zeros_like(self.problem.target)
        return (
            from_chunks(row_values(self.bound, w, self.rows.z), len(self.problem.rows)) * self.unit
        )

    def share_of(self, w: Vector) -> Vector:
        """Return QᵀF (nθ,) of the learner with the weights w, in whitened outputs."""
        if not self.engine.resident or isinstance(self.problem, StreamedProblem):
            sums = self.engine.sum(
                LearnerSums(self.bound), self.rows, w, None, self._no_overlap.values
            )
            return np.asarray(sums[0]) * self.rms
        values, problem = self.values(w), self.problem
        values = values if problem.noise is None else problem.noise.rows(values)
        return problem.projection.coordinates(problem.weight.rows(values))

    def share_slope(self, w: Vector) -> Matrix:
        """Return QᵀJ (nθ, nw) of the learner with the weights w, in whitened outputs."""
        nt = len(self.problem.baseline.names)
        total = self.engine.sum(Blocks(self.bound), self.rows, w, self._no_overlap)
        return np.asarray(total[:nt, nt + 1 :]) * self.rms

    def _weights(self, learned: TrainedLearner) -> tuple[np.ndarray, np.ndarray | None]:
        """Return weights and tilt of a learned function, the tilt in the rows' coordinates."""
        if learned.tilt is None:
            return learned.weights, None
        return learned.weights, learned.tilt @ self.problem.projection.to_coordinates.T / self.rms

    def middle(self, w: AnyArray, noise: Matrix) -> Matrix:
        """Return ΣψᵀΣ_eψ of `[Φ J]` for the noise covariance of whitened outputs.

        One pass over the rows.
        """
        mix = mixing_matrix(noise)
        total = np.asarray(self.engine.sum(MixedGram(self.bound), self.rows, w, mix))
        to_phi = self.problem.projection.to_coordinates
        nt = len(to_phi)
        change = np.eye(len(total)) * self.rms
        change[:nt, :nt] = to_phi
        return change.T @ total @ change

    def physics_middle(self, noise: Matrix) -> Matrix:
        """Return ΣqᵀΣ_eq (nθ, nθ) of the rows q of Q, for whitened noise covariance."""
        return np.asarray(
            self.engine.sum(
                MixedGram(nothing_learned(len(noise))), self.rows, np.zeros(0), mixing_matrix(noise)
            )
        )
