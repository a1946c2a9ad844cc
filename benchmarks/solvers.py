"""The paper's pipeline (Adam, then L-BFGS) against Levenberg-Marquardt to the same training loss, both warm.

Same normalised problem, same start, same process. Run: python benchmarks/solvers.py
"""

from __future__ import annotations

import numpy as np
from machine import alternate, describe

from orthaug import MLP, AdamLBFGS, LevenbergMarquardt, Orthogonal
from orthaug._base.jax import jax
from orthaug._base.parallel import one_blas_thread
from orthaug.fitting.one_step import OneStepTask
from orthaug.physics.problem import pose
from orthaug.studies import synthetic

SEEDS = range(3)
CASES = (
    ("static, set 1, no noise", synthetic.static(1), AdamLBFGS(500, 1000)),
    ("static, set 1, 30 dB", synthetic.static(1, noise=True), AdamLBFGS(500, 1000)),
    ("mass-spring-damper", synthetic.mass_spring_damper(), AdamLBFGS(2500, 500)),
)


def iterations_to(task: OneStepTask, w: object, loss: float) -> int | None:
    """The fewest Levenberg-Marquardt iterations that end at or below a loss."""
    low, high = 0, 1
    while task.run(LevenbergMarquardt(high, tolerance=0.0, longest=high), w).normal.loss > loss:
        low, high = high, 2 * high
        if high > 4096:
            return None
    while high - low > 1:
        middle = (low + high) // 2
        if (
            task.run(LevenbergMarquardt(middle, tolerance=0.0, longest=middle), w).normal.loss
            > loss
        ):
            low = middle
        else:
            high = middle
    return high


def main() -> None:
    print(describe())
    with one_blas_thread():  # as `estimate` trains
        table()


def table() -> None:
    """Measure every case."""
    print("| example | seed | adam-lbfgs | its loss | LM to that loss | iterations | ratio |")
    print("|---|---|---|---|---|---|---|")
    for name, example, pipeline in CASES:
        task = OneStepTask.of(pose(example.train, example.baseline), MLP())
        ratios = []
        for seed in SEEDS:
            w = task.bound.init(jax.random.key(seed))
            target = float(task.run(pipeline, w, Orthogonal()).normal.loss)
            count = iterations_to(task, w, target)
            if count is None:
                print(
                    f"| {name} | {seed} | LM does not reach the loss within 4096 iterations | "
                    "| | | |"
                )
                continue
            slow, fast = alternate(
                lambda t=task, w=w, p=pipeline: t.run(p, w, Orthogonal()),
                lambda t=task, w=w, n=count: t.run(
                    LevenbergMarquardt(n, tolerance=0.0, longest=n), w
                ),
                3,
            )
            ratios.append(slow / fast)
            loss, ratio = task.mean_square(target), slow / fast
            print(
                f"| {name} | {seed} | {slow:.3f} s | {loss:.4g} | {1e3 * fast:.1f} ms | "
                f"{count} | {ratio:.0f} |"
            )
        print(f"| {name} | median | | | | | {np.median(ratios):.0f} |", flush=True)


if __name__ == "__main__":
    main()
