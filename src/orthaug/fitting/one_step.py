"""Training the learner of a problem: scaling, chunks, and one run of the solver (F5)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import jax, jnp
from orthaug.fitting.joint import Joint, Physics
from orthaug.fitting.learned import Learned
from orthaug.fitting.normal_equations import Hold, OneStep, linearise
from orthaug.fitting.solvers.levenberg_marquardt import NON_FINITE, Progress, Run, effective_weights
from orthaug.fitting.solvers.solver import Solver
from orthaug.fitting.structures import Elimination, Fixed, Orthogonal, Structure, eliminate
from orthaug.inference.covariance import mixing
from orthaug.models.learners import Bound, Learner, Scaling
from orthaug.models.rows import Chunks, Overlap, chunk_shape, from_chunks, in_chunks, mixed_gram, share_of
from orthaug.physics.problem import Problem

OUTPUT_UNIT = 10.0
"""The learner's output unit in standard deviations of the baseline's residual: the table is in docs/design.md."""
_ACTIVE_SETS = 10  # tries to find which bounds are active; each changes at least one entry
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

    def run(
        self,
        solver: Solver,
        w: Any,
        structure: Structure | None = None,
        regularization: str | float = "none",
        progress: Progress | None = None,
    ) -> Run:
        """One run from the weights `w`; the arguments as in `estimate`, `structure` None for no penalty.

        Bounds that reach into training (every structure but the orthogonal, F1) are met by an active set: what
        stands at a bound is held there, and training goes on until the same entries stand there.
        """
        structure = Orthogonal() if structure is None else structure

        def tell(iteration: int, loss: float) -> None:
            if progress is not None:
                progress(iteration, self.mean_square(loss))

        elimination = eliminate(structure, self.problem)
        fixed: Fixed = {}
        seconds = iterations = 0
        for _ in range(_ACTIVE_SETS):
            run = self._run_held(solver, w, structure, elimination, fixed, regularization, tell)
            seconds, iterations = seconds + run.seconds, iterations + run.iterations
            found = {} if structure.projects else elimination.active(self.coordinates(run))
            if found == fixed or run.code == NON_FINITE:
                break
            w, fixed = run.w, found
        held = bool(elimination.hold(fixed)[0].any())
        return run._replace(seconds=seconds, iterations=iterations, held=held)

    def coordinates(self, run: Run) -> Vector:
        """QᵀF (nθ,) in whitened outputs, at the end of a run."""
        return np.asarray(run.normal.overlap.values) * self.rms

    def _run_held(
        self,
        solver: Solver,
        w: Any,
        structure: Structure,
        elimination: Elimination,
        fixed: Fixed,
        regularization: str | float,
        progress: Progress | None,
    ) -> Run:
        nt = self.chunks.q.shape[2]
        matrix, target = elimination.hold(fixed)
        arguments = (self.chunks, Hold(jnp.asarray(matrix), jnp.asarray(target / self.rms)))
        nothing = Overlap(jnp.zeros((nt, self.bound.size)), jnp.zeros(nt))
        evidence = regularization == "evidence"
        ridge = 1.0 if evidence else 0.0 if regularization == "none" else float(regularization)
        criterion, samples = OneStep(self.bound), self.problem.target.size - nt
        if solver.gauss_newton:
            return solver.minimise(
                criterion, w, arguments, nothing, ridge=ridge, evidence=evidence, samples=samples, progress=progress
            )
        orthogonal = structure.projects
        physics = self._physics(elimination, fixed, ridge, solved=orthogonal)
        joint = Joint(self.bound, orthogonal)
        found = solver.minimise(joint, w, self.chunks, physics, progress=progress)
        normal = linearise(criterion, found.w, arguments, nothing)
        coordinates = np.asarray(physics.start + physics.basis @ found.v) * self.rms
        coefficients = None if orthogonal else self.problem.projection.from_coordinates(coordinates)
        return Run(
            found.w,
            normal,
            ridge,
            float(effective_weights(normal, jnp.asarray(ridge))),
            found.iterations,
            found.code,
            found.seconds,
            coefficients,
        )

    def _physics(self, elimination: Elimination, fixed: Fixed, ridge: float, *, solved: bool) -> Physics:
        """θ as an unknown from θ⁰ on: every free column scaled to the size of a row, fixed entries without a column.

        Where θ is `solved` (F1), it stands at its end and has no columns: the learner's path does not depend on it.
        """
        to_rows = elimination.to_coordinates / self.rms
        initial = np.clip(self.problem.baseline.initial, elimination.lower, elimination.upper)
        initial = np.array([fixed.get(i, value) for i, value in enumerate(initial)])
        free = np.array([float(i not in fixed) for i in range(len(initial))])
        rows, nt = len(self.problem.rows), len(initial)
        scale = free * np.sqrt(rows) / np.linalg.norm(to_rows, axis=0) if nt else free

        def padded(matrix: np.ndarray) -> np.ndarray:
            return np.concatenate([matrix, np.zeros((nt - len(matrix), *matrix.shape[1:]))])

        penalty = elimination.rows
        return Physics(
            *(
                jnp.asarray(a, dtype=float)
                for a in (
                    elimination.outputs / self.rms if solved else to_rows @ initial,
                    to_rows * (0.0 if solved else scale),
                    elimination.outputs / self.rms,
                    padded(penalty.theta * scale) / self.rms,
                    padded(penalty.learner),
                    padded(penalty.target - penalty.theta @ initial) / self.rms,
                    self.problem.target.size,
                    ridge,
                )
            )
        )

    def loss(self, run: Run) -> float:
        """Mean of squared errors of a run, with each output in its standard deviation."""
        return self.mean_square(run.normal.loss)

    def mean_square(self, loss: Any) -> float:
        """The criterion's `‖r‖²` as the mean of squared errors with each output in its standard deviation."""
        return float(loss) * self.rms**2 / self.problem.target.size

    def learned(self, run: Run) -> Learned:
        """What a run left."""
        return Learned(
            bound=self.bound,
            weights=np.asarray(run.w),
            scaling=self.scaling,
            unit=self.unit,
            values=self.values(run.w),
            effective=run.effective,
            gram=self.gram(run),
            ridge=run.ridge * self.rms**2,
            middle=lambda noise: self.middle(run.w, noise),
            code=run.code,
            iterations=run.iterations,
            seconds=run.seconds,
            coefficients=run.coefficients,
        )

    def overlap(self, w: Any) -> Matrix:
        """QᵀJ (nθ, nw) at the training rows, in whitened outputs."""
        return np.asarray(share_of(self.bound, w, self.chunks).jacobian) * self.rms

    def values(self, w: Any) -> Float[np.ndarray, "N ny"]:
        """f at the training rows, in the outputs' units."""
        chunks = np.asarray(_values(self.bound, w, self.chunks.z))
        return from_chunks(chunks, len(self.problem.rows)) * self.unit

    def gram(self, run: Run) -> Matrix:
        """Gram matrix of `[Φ J]` in whitened outputs, from the run's last pass; a held run's has rows of its own."""
        projection, normal = self.problem.projection, run.normal
        if run.held:
            nt = len(normal.overlap.values)
            free = Hold(jnp.zeros((nt, nt)), jnp.zeros(nt))
            normal = linearise(OneStep(self.bound), run.w, (self.chunks, free), normal.overlap)
        overlap = np.asarray(normal.overlap.jacobian) * self.rms
        to_phi = projection.r / projection.scale
        inner = np.asarray(normal.hessian) * self.rms**2 + overlap.T @ overlap
        cross = to_phi.T @ overlap
        return np.block([[to_phi.T @ to_phi, cross], [cross.T, inner]])

    def middle(self, w: Any, noise: Matrix) -> Matrix:
        """ΣψᵀΣ_eψ of `[Φ J]` for the noise covariance of whitened outputs; one pass over the rows."""
        projection = self.problem.projection
        found = np.asarray(mixed_gram(self.bound, jnp.asarray(w), self.chunks, jnp.asarray(mixing(noise))))
        nt = len(projection.scale)
        change = np.eye(len(found)) * self.rms
        change[:nt, :nt] = projection.r / projection.scale
        return change.T @ found @ change


@partial(jax.jit, static_argnames="bound")
def _values(bound: Bound, w: Float[Array, "nw"], z: Float[Array, "k nz m"]) -> Float[Array, "k ny m"]:
    one_chunk = jax.vmap(lambda row: bound.values(w, row), in_axes=-1, out_axes=-1)
    return jax.lax.map(one_chunk, z)
