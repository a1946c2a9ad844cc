"""Is a Gram matrix in single precision, with residual and gradient in double, faster at the same θ?

The matrix of a step only says how far to go; where a run ends is where the gradient vanishes. So the matrix may be
rough while the gradient is not: that is iterative refinement of the weights. θ is from the QR in double either way.

Run: python benchmarks/single_precision.py
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from machine import alternate, describe

import orthaug as oa
from orthaug._base.jax import jax, jnp
from orthaug._base.parallel import one_blas_thread
from orthaug.fitting.normal_equations import Blocks, Hold, SummedOneStep, collect
from orthaug.fitting.one_step import OneStepTask
from orthaug.models.learners import Bound
from orthaug.models.rows import Chunk, InMemory, Overlap
from orthaug.physics.problem import pose

SIZES = ((200_000, 10), (50_000, 64))  # rows, neurons
ROUNDS, ALPHA = 5, 1e-3


@dataclass(frozen=True)
class SingleBlocks:
    """As `Blocks`: everything with J in single precision, but Jᵀr, which a product with J from the left gives."""

    bound: Bound

    def __call__(self, chunk: Chunk, w: Any, before: Overlap) -> Any:
        def of_weights(w: Any) -> Any:
            values = jax.vmap(lambda z: self.bound.values(w, z), in_axes=-1, out_axes=-1)(chunk.z)
            return jnp.sum(chunk.gain * values, axis=1)

        values, pull = jax.vjp(of_weights, w)
        nt = chunk.q.shape[1]
        residual = chunk.e - values + jnp.einsum("t,otm->om", before.values, chunk.q)
        slope = pull(residual)[0] - before.jacobian.T @ jnp.einsum("otm,om->t", chunk.q, residual)
        rough = jax.tree.map(lambda a: a.astype(jnp.float32), (chunk, w, before))
        total = Blocks(self.bound)(*rough).astype(jnp.float64)
        exact = jnp.einsum("otm,om->t", chunk.q, residual)
        column = jnp.concatenate([exact, jnp.sum(residual**2)[None], slope])
        return total.at[nt].set(column).at[:, nt].set(column)


def task_of(rows: int, neurons: int) -> OneStepTask:
    """A plant whose physics is linear, with three past outputs and inputs."""
    rng = np.random.default_rng(0)
    u, y = rng.uniform(-1, 1, rows), np.zeros(rows)
    for k in range(3, rows):
        y[k] = (
            1.5 * y[k - 1]
            - 0.7 * y[k - 2]
            + 0.1 * u[k - 1]
            - 0.05 * np.tanh(8 * (y[k - 1] - y[k - 2]))
        )
    record = oa.Record.from_arrays(u=u, y=y + 1e-3 * rng.normal(size=rows))
    terms = [oa.Term("a", "y[k-1]"), oa.Term("b", "y[k-2]"), oa.Term("c", "u[k-1]")]
    problem = pose(record, oa.Baseline.from_terms(terms), oa.Lags(na=3, nb=3, nk=1))
    return OneStepTask.of(problem, oa.MLP(hidden=(neurons,)))


def passes(task: OneStepTask, rough: bool) -> Callable[[Any, Overlap], Any]:
    """The normal equations at some weights, in double or with a rough matrix."""
    nt = len(task.problem.baseline.names)
    hold = Hold(jnp.zeros((nt, nt)), jnp.zeros(nt))
    if not rough:
        return SummedOneStep(task.engine, task.bound, task.rows, hold)
    made = jax.jit(collect)
    return lambda w, before: made(
        InMemory().sum(SingleBlocks(task.bound), task.rows, w, before), hold, before
    )


def _once(way: Any, w: Any, nothing: Overlap) -> None:
    jax.block_until_ready(way(w, nothing))


def main() -> None:
    print(describe())
    print("| rows | weights | a pass, double | single | gain | iterations | loss apart | θ apart |")
    print("|---|---|---|---|---|---|---|---|")
    for rows, neurons in SIZES:
        task = task_of(rows, neurons)
        nt, size = len(task.problem.baseline.names), task.bound.size
        w = task.bound.init(jax.random.key(0))
        nothing = Overlap(np.zeros((nt, size)), np.zeros(nt))
        ways = [passes(task, rough) for rough in (False, True)]
        calls = [partial(_once, way, w, nothing) for way in ways]
        double, single = alternate(*calls, ROUNDS)
        solver = oa.LevenbergMarquardt(60, tolerance=1e-13)
        ends = [solver.drive(way, w, nothing, samples=rows - nt, ridge=ALPHA) for way in ways]
        factor = task.problem.projection
        thetas = [
            task.problem.least_squares - factor.from_coordinates(task.coordinates(end))
            for end in ends
        ]
        apart = np.max(np.abs(thetas[1] - thetas[0]) / np.abs(thetas[0]))
        losses = [float(end.normal.loss) for end in ends]
        steps = " / ".join(str(end.iterations) for end in ends)
        text = f"{1e3 * double:.0f} ms | {1e3 * single:.0f} ms | {double / single:.2f} | {steps}"
        print(f"| {rows} | {size} | {text} | {losses[1] / losses[0] - 1:.1e} | {apart:.1e} |")


if __name__ == "__main__":
    with one_blas_thread():
        main()
