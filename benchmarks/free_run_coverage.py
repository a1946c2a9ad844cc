"""Do 95 % intervals of a free run cover, where the noise on the sensor is coloured? Plain and robust ones.

A resonant second-order system whose input moves slowly, and an offset; physics alone, trained on the free run. The
noise is an AR(1) process with coefficient 0.9, or white. Over whole experiments, and in segments.
Run: python benchmarks/free_run_coverage.py [draws, default 200]
"""

from __future__ import annotations

import sys
import time

import numpy as np
from machine import describe
from scipy.signal import lfilter

import orthaug as oa
from orthaug.analysis.robustness import robust_where_asked

SAMPLES, NOISE, WARM_UP = 3000, 0.5, 200
THETA = np.array([1.5, -0.7, 0.3, 0.2])
TERMS = zip("abgo", ("y[k-1]", "y[k-2]", "u[k-1]", "1"), strict=True)
BASELINE = oa.Baseline.from_terms([oa.Term(*term) for term in TERMS])
CASES = (("AR(1), 0.9", 0.9, 0), ("AR(1), 0.9", 0.9, 512), ("white", 0.0, 0), ("white", 0.0, 512))


def record(seed: int, pole: float, samples: int = SAMPLES) -> oa.Record:
    """One draw; the noise has the same deviation whatever its colour."""
    rng = np.random.default_rng([seed, 12])
    u = lfilter([1.0], [1.0, -0.8], rng.normal(size=samples + WARM_UP))
    y = lfilter([0.0, THETA[2]], [1.0, -THETA[0], -THETA[1]], u) + THETA[3] / (
        1 - THETA[0] - THETA[1]
    )
    e = lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], rng.normal(size=samples + WARM_UP))
    return oa.Record.from_arrays(u[WARM_UP:], (y + NOISE * e)[WARM_UP:])


def coverage(pole: float, segment: int, draws: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Shares of draws (4,) that plain and robust intervals cover, and the share where robust ones are the default."""
    inside, default = np.zeros((2, len(THETA))), 0
    criterion = oa.Simulation(segment, 40)
    for seed in range(draws):
        fit = oa.estimate(
            record(seed, pole),
            BASELINE,
            learner=None,
            criterion=criterion,
            standard_errors="plain",
        )
        default += (
            robust_where_asked(fit, fit.model.predict(fit.problem.record)).plain_covariance
            is not None
        )
        for i, found in enumerate((fit, fit.robust())):
            inside[i] += (found.interval[:, 0] <= THETA) & (found.interval[:, 1] >= THETA)
    return inside[0] / draws, inside[1] / draws, default / draws


def table(draws: int = 200) -> list[list[float]]:
    """Per case, in per cent: the least coverage of plain intervals, their mean, the same of robust ones, how often
    robust ones are the default."""
    found = []
    for _, pole, segment in CASES:
        plain, robust, default = coverage(pole, segment, draws)
        found.append(
            [100 * v for v in (plain.min(), plain.mean(), robust.min(), robust.mean(), default)]
        )
    return found


def main(draws: int) -> None:
    print(describe())
    began = time.perf_counter()
    print("| noise | segments | plain, least | mean | robust, least | mean | robust by default |")
    print("|---|---|---|---|---|---|---|")
    for (noise, _, segment), row in zip(CASES, table(draws), strict=True):
        print(
            f"| {noise} | {segment or 'whole'} | {' | '.join(f'{v:.1f} %' for v in row)} |",
            flush=True,
        )
    print(f"\n{draws} draws, {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
