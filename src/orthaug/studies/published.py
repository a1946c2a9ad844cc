"""The published scripts' own pipeline: no normalisation, θ iterated from θ⁰ with the weights.

Adam and SciPy's L-BFGS-B run as jax-sysid 1.0.1 runs them: Adam with β₂ = 0.99 whose best iterate
is kept, then L-BFGS-B with at most as many evaluations as iterations. Initial weights are NumPy's,
seed for seed. In the orthogonal structure θ_aux = Φ⁺F is inside the criterion; here it is
formed by the QR factors instead of `pinv(ΦᵀΦ)`.

On the mass-spring-damper this follows the scripts' runs start by start. On the static example it
trains farther than they do, to a fifth of their test error without noise, so there the same start
ends at another θ of the additive structure. jax-sysid 1.0.1 itself, with the iterations, the
criterion and the initial weights that are on record, ends where this does: a setting of those
scripts is not on record. benchmarks/README.md has what was tried.
"""

from __future__ import annotations

import math
import time
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Float

from orthaug._base.checks import Vector
from orthaug._base.jax import Array, jax, jnp
from orthaug.fitting.conclusion import conclude
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.fitting.normal_equations import Hold, OneStep, linearise
from orthaug.fitting.one_step import OneStepTask
from orthaug.fitting.solvers.compiled import TrainingRun, effective_weights
from orthaug.fitting.status import Ending
from orthaug.fitting.structures import Structure
from orthaug.models.learners import MLP, Bound, Scaling
from orthaug.models.rows import Overlap
from orthaug.physics.problem import Problem, pose
from orthaug.studies.synthetic import Example

NEURONS = 16
LEARNING_RATE, SECOND_MOMENT = 1e-3, 0.99
LBFGS = {"maxls": 20, "maxcor": 10, "ftol": 1e-16, "gtol": 1e-16}


class Data(NamedTuple):
    """The rows as measured, an orthonormal basis of the physics, and the penalty rows."""

    z: Float[Array, "N nz"]
    phi: Float[Array, "N nt"]
    y: Float[Array, "N"]
    q: Float[Array, "N nt"]
    penalty_theta: Float[Array, "m nt"]
    penalty_learner: Float[Array, "m nt"]
    penalty_target: Float[Array, "m"]

    @classmethod
    def of(cls, problem: Problem, structure: Structure) -> Data:
        """Return the data of a problem with one output."""
        baseline = problem.baseline
        q = np.asarray(problem.projection.q).reshape(len(problem.rows), -1)
        phi = q @ problem.projection.to_coordinates / problem.weight.matrix[0, 0]
        penalty = structure.penalty(baseline.names, baseline.initial, 1.0)
        arrays = (
            problem.feature_rows(),
            phi,
            problem.target[:, 0],
            q,
            penalty.theta,
            penalty.learner,
            penalty.target,
        )
        return cls(*(jnp.asarray(array, dtype=float) for array in arrays))


def initial_weights(seed: int, nz: int) -> Vector:
    """Return Xavier's uniform weights of 16 tanh neurons from NumPy's `RandomState`.

    Hidden weights come first.

    Biases are zero.
    """
    rng = np.random.RandomState(seed)
    hidden, output = (
        gain * math.sqrt(6 / (size + NEURONS)) for gain, size in ((5 / 3, nz), (1.0, 1))
    )
    first = rng.uniform(-hidden, hidden, NEURONS * nz)
    return np.concatenate(
        [first, np.zeros(NEURONS), rng.uniform(-output, output, NEURONS), np.zeros(1)]
    )


def loss(unknowns: Float[Array, "n"], data: Data, bound: Bound, projects: bool) -> Float[Array, ""]:
    """Return `‖Y − Φ(θ − θ_aux) − F‖²` plus the penalty rows, a sum of squares.

    θ_aux = 0 unless the structure projects.
    """
    theta, w = jnp.split(unknowns, [data.phi.shape[1]])
    f = jax.vmap(bound.values, in_axes=(None, 0))(w, data.z)[:, 0]
    share = data.q.T @ f
    miss = data.y - data.phi @ theta - (f - data.q @ share if projects else f)
    penalty = data.penalty_target - data.penalty_theta @ theta - data.penalty_learner @ share
    return miss @ miss + penalty @ penalty


_value_and_gradient = jax.jit(jax.value_and_grad(loss), static_argnames=("bound", "projects"))


@partial(jax.jit, static_argnames=("bound", "projects", "iterations"))
def _adam(start: Any, data: Data, bound: Bound, projects: bool, iterations: int) -> Any:
    import optax

    optimizer = optax.adam(LEARNING_RATE, b2=SECOND_MOMENT)

    def step(carry: Any, _: Any) -> tuple[Any, None]:
        unknowns, state, best, lowest = carry
        value, gradient = jax.value_and_grad(loss)(unknowns, data, bound, projects)
        best, lowest = jnp.where(value < lowest, unknowns, best), jnp.minimum(value, lowest)
        update, state = optimizer.update(gradient, state)
        return (unknowns + update, state, best, lowest), None

    carry = (start, optimizer.init(start), start, jnp.asarray(jnp.inf))
    return jax.lax.scan(step, carry, length=iterations)[0][2]


def train(
    example: Example, structure: Structure, iterations: tuple[int, int], seed: int
) -> LaggedEstimate:
    """Return one run of the published scripts on one of their examples.

    Args:
        iterations: of Adam, and evaluations of L-BFGS-B.
        seed: of the initial weights.
    """
    began = time.perf_counter()
    problem = pose(example.train, example.baseline)
    nz, nt = len(problem.features.entries), len(problem.baseline.names)
    task = OneStepTask.of(problem, MLP((NEURONS,)), Scaling(np.zeros(nz), np.ones(nz)), np.ones(1))
    data, kind = Data.of(problem, structure), (task.bound, structure.projects)
    start = jnp.asarray(np.concatenate([problem.baseline.initial, initial_weights(seed, nz)]))
    start = _adam(start, data, *kind, iterations[0])

    def criterion(unknowns: Vector) -> tuple[float, Vector]:
        value, gradient = _value_and_gradient(unknowns, data, *kind)
        return float(value), np.asarray(gradient)

    options = {**LBFGS, "maxiter": iterations[1], "maxfun": iterations[1]}
    end = scipy.optimize.minimize(
        criterion, np.asarray(start), jac=True, method="L-BFGS-B", options=options
    )
    theta, w = np.split(end.x, [nt])
    run = _run(
        task,
        jnp.asarray(w),
        iterations[0] + int(end.nit),
        bool(end.success),
        time.perf_counter() - began,
    )
    aux = problem.projection.from_coordinates(task.coordinates(run)) if structure.projects else 0.0
    return conclude(task, structure, task.learned(run._replace(coefficients=theta - aux)))


def _run(
    task: OneStepTask, w: Any, iterations: int, converged: bool, seconds: float
) -> TrainingRun:
    """Return the statistics' input from a run that ended at `w`."""
    nt = len(task.problem.baseline.names)
    hold = Hold(jnp.zeros((nt, nt)), jnp.zeros(nt))
    nothing = Overlap(jnp.zeros((nt, task.bound.size)), jnp.zeros(nt))
    normal = linearise(OneStep(task.bound), w, (task.rows, hold), nothing)
    ending = Ending.CONVERGED if converged else Ending.RUNNING
    return TrainingRun(
        w,
        normal,
        0.0,
        float(effective_weights(normal, jnp.asarray(0.0))),
        iterations,
        ending,
        seconds,
    )
