"""One Levenberg-Marquardt iteration (a pass over the rows, the step, the acceptance) against NumPy's bare `J.T @ J`.

Both in the same process. Run: python benchmarks/lm_iteration.py
"""

from __future__ import annotations

import numpy as np
from machine import describe, median_seconds

from orthaug import MLP, Baseline, LevenbergMarquardt, Record, Term
from orthaug._base.jax import jax
from orthaug._base.parallel import one_blas_thread
from orthaug.data.regressors import Lags
from orthaug.fitting.one_step import OneStepTask
from orthaug.physics.problem import pose

CASES = (  # rows, lags, neurons, weights, iterations per timing, repeats, allowed ratio
    (10_000, Lags(na=2, nb=1, nk=1), 16, 81, 20, 15, 1.5),
    (100_000, Lags(na=3, nb=3, nk=1), 32, 257, 3, 7, 2.0),
)


def task(rows: int, lags: Lags, neurons: int) -> OneStepTask:
    """A noisy nonlinear record on which training does not end early."""
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=rows + 3), np.zeros(rows + 3)
    for k in range(3, len(y)):
        y[k] = (
            0.5 * y[k - 1]
            - 0.3 * y[k - 2]
            + u[k - 1]
            + 0.3 * np.tanh(2 * u[k - 1] * y[k - 1])
            + 0.1 * rng.normal()
        )
    baseline = Baseline.from_terms(
        [Term(n, e) for n, e in (("a1", "y[k-1]"), ("a2", "y[k-2]"), ("b1", "u[k-1]"))]
    )
    record = Record.from_arrays(u, y).rows(0, rows + max(lags.na, lags.nb))  # type: ignore[type-var]
    return OneStepTask.of(pose(record, baseline, lags), MLP((neurons,)))


def main() -> None:
    print(describe())
    print(
        "| rows | weights | LM iteration | `J.T @ J` | ratio | allowed |\n|---|---|---|---|---|---|"
    )
    for rows, lags, neurons, weights, iterations, repeats, allowed in CASES:
        posed = task(rows, lags, neurons)
        assert posed.bound.size == weights and len(posed.problem.rows) == rows
        start = posed.bound.init(jax.random.key(0))
        jacobian = np.random.default_rng(1).normal(size=(rows, weights))

        def train(n: int, posed: OneStepTask = posed, start: object = start) -> None:
            with one_blas_thread():  # as `estimate` trains
                run = posed.run(LevenbergMarquardt(n, tolerance=0.0, longest=n), start)
            assert run.iterations == n, "training ended early"

        # in blocks, not in turn: the threads of BLAS and of XLA wait actively for a while after a call
        bare = median_seconds(lambda j=jacobian: j.T @ j, 2 * repeats)
        # the start (two passes, an eigenvalue problem) is paid once a run: take the difference of two lengths
        short = median_seconds(lambda n=iterations: train(n), repeats)
        long = median_seconds(lambda n=3 * iterations: train(n), repeats)
        one = (long - short) / (2 * iterations)
        print(
            f"| {rows} | {weights} | {1e3 * one:.2f} ms | {1e3 * bare:.2f} ms | "
            f"{one / bare:.2f} | {allowed} |"
        )


if __name__ == "__main__":
    main()
