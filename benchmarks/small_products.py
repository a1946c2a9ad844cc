"""What the products `W z` of a learner cost in the runs of a motion: as sums, and as matrix products.

A pendulum with a learner of one or two hidden layers, runs of 600 steps side by side: the run alone, and with its
sensitivities. A ratio is the time with `MLP.apply` as it is over that with matrix products only, medians of 15 in turn.
Run: python benchmarks/small_products.py
"""

from __future__ import annotations

import statistics
import time
from dataclasses import replace
from typing import Any

import numpy as np
from machine import describe

import orthaug as oa
from orthaug._base.jax import jax
from orthaug.fitting.segments import Segments, respond, sensitivity
from orthaug.models.learners import ACTIVATIONS, MLP

STEPS, RUNS = 600, 15
LANES, HIDDEN = (1, 4, 16), ((8,), (32,), (16, 16))


class _ByMatrices(MLP):
    """The same learner by matrix products."""

    def apply(self, tree: Any, z: Any) -> Any:
        for weight, bias, activation in self.layers(tree):
            z = ACTIVATIONS[activation](weight @ z + bias)
        return z


def fit(hidden: tuple[int, ...]) -> Any:
    """A motion with a learner that is hardly trained."""
    random = np.random.default_rng(0)
    u = np.repeat(random.normal(size=STEPS // 20), 20)
    motion = oa.Motion.from_equations(
        states=[
            oa.State("q", "w", start="y"),
            oa.State("w", "(u - d*w - g*sin(q))/J", start="derivative of y", learned=True),
        ],
        outputs=[oa.Output("y", "q")],
        inputs=["u"],
        parameters=[oa.PhysicalParameter(*one, min=0) for one in (("J", 1), ("d", 0.5), ("g", 6))],
    )
    y = np.cumsum(0.01 * random.normal(size=STEPS))
    record = oa.Record.from_arrays(u, y, sampling_time=0.02)
    few = oa.LevenbergMarquardt(iterations=2)
    options = {"blocks": 0, "fallback": False, "solver": few}
    return oa.estimate(record, motion, learner=MLP(hidden), **options)


def ratio(found: Any, lanes: int, *, slopes: bool) -> tuple[float, float]:
    """Milliseconds with sums, and their ratio to those with matrix products, in turn."""
    own, numbers = found.segmented, found.model.numbers
    numbers = own.numbers(np.asarray(numbers.c), np.asarray(numbers.weights))
    chosen = np.zeros(lanes, dtype=int)
    segments = Segments(*(jax.device_put(np.asarray(part)[..., chosen]) for part in own.segments))
    bound = own.dynamics.bound
    slow = replace(bound, learner=_ByMatrices(bound.learner.hidden))
    spent: list[list[float]] = [[], []]
    for _ in range(RUNS + 1):  # the first one compiles
        for form, times in zip((bound, slow), spent, strict=True):
            dynamics = replace(own.dynamics, bound=form)
            given = (dynamics, numbers, segments, segments.start)
            began = time.perf_counter()
            jax.block_until_ready(sensitivity(*given, own.weight) if slopes else respond(*given))
            times.append(1e3 * (time.perf_counter() - began))
    sums, products = (statistics.median(times[1:]) for times in spent)
    return sums, sums / products


def main() -> None:
    print(describe())
    print("\n| neurons | what | " + " | ".join(f"{m} side by side" for m in LANES) + " |")
    print((len(LANES) + 2) * "|---" + "|")
    for hidden in HIDDEN:
        found = fit(hidden)
        for words, slopes in (("run", False), ("with sensitivities", True)):
            cells = (
                f"{ms:.2f} ms, {r:.2f}" for ms, r in (ratio(found, m, slopes=slopes) for m in LANES)
            )
            print(f"| {' + '.join(map(str, hidden))} | {words} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
