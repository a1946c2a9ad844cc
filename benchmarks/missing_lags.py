"""How often does the test of the learner's inputs reject, where they suffice and where a lag is missing?

Mass-spring-dampers as a lagged model, the learner on the velocity `y[k-1] - y[k-2]` alone. What the physics lacks is
friction, a function of that, or also a hardening of the position, which is not. Noise enters the equation: white, of a
size that grows with the force, or coloured by a moving average.
Run: python benchmarks/missing_lags.py [draws, default 200]
"""

from __future__ import annotations

import sys
import time

import numpy as np
from machine import describe

import orthaug as oa
from orthaug.analysis.missing_lags import missing_lags

SAMPLES, NOISE = 1000, 0.02
THETA = (1.5, -0.7, 0.3)
BASELINE = oa.Baseline.from_terms(
    [oa.Term(*term) for term in (("a", "y[k-1]"), ("b", "y[k-2]"), ("c", "u[k-1]"))]
)
CASES = (  # noise, coefficient of y³, coefficient of u²
    ("white", 0.0, 0.0),
    ("uneven", 0.0, 0.0),
    ("moving average", 0.0, 0.0),
    ("white", -0.005, 0.0),
    ("white", 0.0, 0.005),
)


def record(seed: int, noise: str, hardening: float, square: float) -> oa.Record:
    """One draw."""
    rng = np.random.default_rng([seed, 34])
    u, e, y = rng.normal(size=SAMPLES), NOISE * rng.normal(size=SAMPLES), np.zeros(SAMPLES)
    if noise == "uneven":
        e = e * np.abs(np.roll(u, 1))
    elif noise == "moving average":
        e[1:] += 0.5 * e[:-1]
    for k in range(2, SAMPLES):
        a, b = y[k - 1], y[k - 2]
        lacks = -0.1 * np.tanh(3 * (a - b)) + hardening * a**3 + square * u[k - 1] ** 2
        y[k] = THETA[0] * a + THETA[1] * b + THETA[2] * u[k - 1] + lacks + e[k]
    return oa.Record.from_arrays(u, y)


def p_values(case: tuple[str, float, float], draws: int) -> np.ndarray:
    """Of the tests of all draws, the least over the lags times their number."""
    learner, solver = oa.MLP((8,), inputs=("y[k-1]-y[k-2]",)), oa.LevenbergMarquardt(40)
    found = []
    for seed in range(draws):
        tests = missing_lags(
            oa.estimate(record(seed, *case), BASELINE, learner=learner, solver=solver, seed=0)
        )
        found.append(min(test.p for test in tests.tests) * len(tests.tests) if tests else 1.0)
    return np.array(found)


def table(draws: int = 200) -> list[list[float]]:
    """Per case the per cent of draws that reject at 5 % and at 1 %; a quarter of the draws where a lag is missing."""
    found = (p_values(case, draws if case[1:] == (0.0, 0.0) else draws // 4) for case in CASES)
    return [[100 * float(np.mean(p < level)) for level in (0.05, 0.01)] for p in found]


def main(draws: int) -> None:
    print(describe())
    began = time.perf_counter()
    print("| noise | y³ | u² | rejected at 5 % | at 1 % |\n|---|---|---|---|---|")
    for case, row in zip(CASES, table(draws), strict=True):
        print(
            f"| {' | '.join(map(str, case))} | {' | '.join(f'{v:.1f} %' for v in row)} |",
            flush=True,
        )
    print(f"\n{draws} draws, {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
