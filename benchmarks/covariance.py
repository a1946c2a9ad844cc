"""The joint covariance in one pass over the rows against one full Jacobian per row, as the published scripts take it.

Run: python benchmarks/covariance.py [rows of the loop that are timed, default 64]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from machine import describe, median_seconds

import orthaug as oa

ROWS, NEURONS = 1024, 16


def one_row(fit: oa.Estimate) -> Callable[[int], jax.Array]:
    """ψ of a row, from one `jacrev` of the whole training prediction: θ_aux depends on all rows."""
    problem, model = fit.problem, fit.model
    bound, numbers = model.form.bound, model.numbers
    z = jnp.asarray((problem.feature_rows() - numbers.centre) / numbers.halfwidth)
    phi = jnp.asarray(problem.projection.phi[:, 0]) * problem.deviation  # one output
    pseudo = jnp.asarray(np.linalg.pinv(phi))

    def row(parameters: jax.Array, k: int) -> jax.Array:
        theta, w = parameters[: phi.shape[1]], parameters[phi.shape[1] :]
        learner = jax.vmap(lambda one: bound.values(w, one)[0] * numbers.gain[0])(z)
        return phi[k] @ (theta - pseudo @ learner) + learner[k]

    parameters = jnp.concatenate([jnp.asarray(fit.theta), jnp.asarray(numbers.weights)])
    return lambda k: jax.jacrev(row)(parameters, k)


def per_row(fit: oa.Estimate) -> np.ndarray:
    """`Σψψᵀ` inverted times σ², from the ψ of every row."""
    psi = np.asarray(jax.lax.map(one_row(fit), jnp.arange(len(fit.problem.rows))))
    scale = 1 / np.linalg.norm(psi, axis=0)
    inverse = np.linalg.pinv(
        (psi * scale).T @ (psi * scale), rcond=psi.shape[1] * np.finfo(float).eps, hermitian=True
    )
    return fit.model.statistics.noise[0, 0] * inverse * np.outer(scale, scale)


def seconds_per_row(fit: oa.Estimate, timed: int) -> float:
    """Seconds for all rows in a loop that is not compiled, like that of the scripts; the first ones are timed."""
    gradient = one_row(fit)
    gradient(0).block_until_ready()
    began = time.perf_counter()
    for k in range(timed):
        gradient(k).block_until_ready()
    return (time.perf_counter() - began) * len(fit.problem.rows) / timed


def fitted() -> oa.Estimate:
    example = oa.synthetic.static(1, noise=True, samples=ROWS)
    return oa.estimate(
        example.train, example.baseline, learner=oa.MLP((NEURONS,)), regularization="none"
    )


def theta_block(fit: oa.Estimate | None = None) -> float:
    """The largest relative difference of both in the θ block, for benchmarks/README.md."""
    fit = fit or fitted()
    nt = len(fit.theta)
    return float(np.abs(fit.joint_covariance()[:nt, :nt] / per_row(fit)[:nt, :nt] - 1).max())


def main(timed: int) -> None:
    print(describe())
    fit = fitted()
    fast = median_seconds(fit.joint_covariance, 20)
    slow, worst = seconds_per_row(fit, min(timed, ROWS)), theta_block(fit)
    found, nt = fit.joint_covariance(), len(fit.theta)
    across = np.abs(found[:nt, nt:]).max() / np.sqrt(
        found[:nt, :nt].max() * np.diag(found)[nt:].max()
    )
    print(
        "| rows | weights | one pass | a Jacobian per row | ratio | allowed | θ block, largest "
        "relative difference |"
    )
    print("|---|---|---|---|---|---|---|")
    print(
        f"| {ROWS} | {fit.model.form.bound.size} | {1e3 * fast:.2f} ms | {slow:.1f} s | "
        f"{slow / fast:.0f} | >= 100 | {worst:.1e} (allowed 1e-10) |"
    )
    print(f"\nLargest correlation of θ with a weight (thm:zero_cov has 0): {across:.1e}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 64)
