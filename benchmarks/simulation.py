"""One iteration of free-run training (trial, sensitivities, step) against one plain free run of the same segments.

Rows, lags and neurons are Silverbox's; both in the same process. Run: python benchmarks/simulation.py
"""

from __future__ import annotations

import numpy as np
from machine import describe, median_seconds

from orthaug import MLP, Baseline, LevenbergMarquardt, Orthogonal, Record, Simulation, Term
from orthaug._base.jax import jax, jnp
from orthaug._base.parallel import one_blas_thread
from orthaug.fitting.free_run import FreeRunTask
from orthaug.fitting.one_step import OneStepTask
from orthaug.fitting.segments import respond
from orthaug.physics.problem import pose

ROWS, REPEATS, SHORT, LONG = 65_062, 9, 5, 25
TERMS = ("y[k-1]", "y[k-2]", "u[k]", "u[k-1]", "u[k-2]", "1")
ALLOWED = 0.5  # of the number of weights


def record() -> Record:
    """A hardening oscillator with noise, on which training does not end early."""
    rng = np.random.default_rng(0)
    u, y = 0.05 * rng.normal(size=ROWS), np.zeros(ROWS)
    for k in range(2, ROWS):
        y[k] = 1.46 * y[k - 1] - 0.93 * y[k - 2] + 0.37 * u[k - 1] - 0.5 * y[k - 1] ** 3
    return Record.from_arrays(u, y + 1e-3 * rng.normal(size=ROWS))


def main() -> None:
    baseline = Baseline.from_terms([Term(f"t{i}", text) for i, text in enumerate(TERMS)])
    problem = pose(record(), baseline, None, ("y[k-1]", "y[k-2]"))
    task = OneStepTask.of(problem, MLP((10,)))
    start = task.bound.init(jax.random.key(0))
    free_run = FreeRunTask.of(task, Simulation(segment=512, washout=40))
    plan = free_run.plan
    c = problem.projection.solve(problem.whitened_target - task.values(start) / problem.deviation)
    numbers, states = plan.numbers(c, start), jnp.asarray(plan.segments.start)

    def train(iterations: int) -> None:
        with one_blas_thread():  # as `estimate` trains
            run = free_run.run(
                LevenbergMarquardt(iterations, tolerance=0.0), start, Orthogonal(), "evidence"
            )
        assert run.end.iterations == iterations, "training ended early"

    plain = median_seconds(
        lambda: jax.block_until_ready(respond(plan.dynamics, numbers, plan.segments, states)),
        5 * REPEATS,
    )
    # a run's beginning (one-step training, the first linearisation) is paid once: take the difference of two lengths
    short, long = (
        median_seconds(lambda: train(SHORT), REPEATS),
        median_seconds(lambda: train(LONG), REPEATS),
    )
    one = (long - short) / (LONG - SHORT)
    print(describe())
    print("| rows | weights | iteration | free run | ratio | allowed |\n|---|---|---|---|---|---|")
    weights = task.bound.size
    print(
        f"| {ROWS} | {weights} | {1e3 * one:.1f} ms | {1e3 * plain:.2f} ms | {one / plain:.1f} "
        f"| {ALLOWED * weights} |"
    )


if __name__ == "__main__":
    main()
