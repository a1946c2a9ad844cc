"""The joint covariance in one pass over the rows against one full Jacobian per row, as the published scripts take it.

Run: python benchmarks/covariance.py [rows of the loop that are timed, default 64]
"""

from __future__ import annotations

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from machine import describe, median_seconds

import orthaug as oa

ROWS, NEURONS = 1024, 16


def per_row(fit: oa.Estimate, timed: int) -> tuple[np.ndarray, float]:
    """`Σψψᵀ` inverted times σ², ψ from one `jacrev` of the whole training prediction per row; and seconds for all rows.

    Every row's θ_aux depends on all rows, so that each derivative passes over the whole record; this loop is not
    compiled, like that of the scripts. All rows are needed for the covariance, but only the first ones are timed.
    """
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
    gradient = jax.jacrev(row)
    gradient(parameters, 0).block_until_ready()
    began = time.perf_counter()
    for k in range(timed):
        gradient(parameters, k).block_until_ready()
    seconds = (time.perf_counter() - began) * len(phi) / timed
    psi = np.asarray(jax.lax.map(lambda k: gradient(parameters, k), jnp.arange(len(phi))))
    scale = 1 / np.linalg.norm(psi, axis=0)
    inverse = np.linalg.pinv((psi * scale).T @ (psi * scale), rcond=psi.shape[1] * np.finfo(float).eps, hermitian=True)
    return model.statistics.noise[0, 0] * inverse * np.outer(scale, scale), seconds


def main(timed: int) -> None:
    print(describe())
    example = oa.synthetic.static(1, noise=True, samples=ROWS)
    fit = oa.estimate(example.train, example.baseline, learner=oa.MLP((NEURONS,)))
    fast = median_seconds(fit.joint_covariance, 20)
    reference, slow = per_row(fit, min(timed, ROWS))
    found, nt = fit.joint_covariance(), len(fit.theta)
    theta = [matrix[:nt, :nt] for matrix in (found, reference)]
    worst = np.abs(theta[0] / theta[1] - 1).max()
    across = np.abs(found[:nt, nt:]).max() / np.sqrt(theta[0].max() * np.diag(found)[nt:].max())
    print("| rows | weights | one pass | a Jacobian per row | ratio | allowed | θ block, largest relative difference |")
    print("|---|---|---|---|---|---|---|")
    print(
        f"| {ROWS} | {fit.model.form.bound.size} | {1e3 * fast:.2f} ms | {slow:.1f} s | {slow / fast:.0f} | >= 100 | "
        f"{worst:.1e} (allowed 1e-10) |"
    )
    print(f"\nLargest correlation of θ with a weight (thm:zero_cov has 0): {across:.1e}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 64)
