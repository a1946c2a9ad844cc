"""How far is θ from the truth under the training measure, and under the uniform one? Static example (F3).

Run: python benchmarks/measure.py [noise draws, default 40]
"""

from __future__ import annotations

import os
import sys
import time
from functools import cache

os.environ.setdefault(
    "OPENBLAS_NUM_THREADS", "1"
)  # the matrices are small, and its threads would wait for JAX's

import numpy as np
from machine import describe

import orthaug as oa

MEASURE = oa.Uniform({"u[k]": (-0.6, 0.6)})
NOISY = {
    1: ("0.0028", 0.006),
    2: ("0.081", 0.010),
    3: ("0.144", 0.010),
}  # data set: prototype's training, allowed
INITIALISATIONS, NOISELESS_LIMIT = 10, 5e-5


def errors(fit: oa.Estimate, theta: np.ndarray) -> tuple[float, float]:
    """‖θ̂ − θ*‖ under the training and under the uniform measure."""
    training, uniform = (
        float(np.linalg.norm(found - theta)) for found in (fit.theta, fit.split(MEASURE).theta)
    )
    return training, uniform


def noisy(data_set: int, draws: int) -> np.ndarray:
    """Errors (draws, 2) with 30 dB of noise and evidence regularisation, from an initialisation of each draw's own."""
    example, found = oa.synthetic.static(data_set), []
    clean = example.train.experiments[0]
    for seed in range(draws):
        noise = np.random.default_rng([seed, data_set]).normal(
            0.0, oa.synthetic.NOISE_30_DB, clean.outputs.shape
        )
        record = oa.Record.from_arrays(clean.inputs, clean.outputs + noise)
        fit = oa.estimate(record, example.baseline, regularization="evidence", seed=seed)
        found.append(errors(fit, example.theta))
    return np.array(found)


def noiseless(data_set: int, iterations: int) -> np.ndarray:
    """Errors (initialisations, 2) without noise or regularisation."""
    example = oa.synthetic.static(data_set)
    solver = oa.LevenbergMarquardt(iterations, longest=iterations)
    return np.array(
        [
            errors(
                oa.estimate(
                    example.train, example.baseline, solver=solver, regularization="none", seed=seed
                ),
                example.theta,
            )
            for seed in range(INITIALISATIONS)
        ]
    )


def with_noise() -> list[list[float]]:
    """The numbers of benchmarks/README.md: for each set the medians under both measures."""
    return [np.median(noisy(data_set, 40), axis=0).tolist() for data_set in NOISY]


@cache
def without_noise() -> list[list[float]]:
    """For each set the largest error under both measures."""
    return [noiseless(data_set, 300).max(axis=0).tolist() for data_set in NOISY]


def training() -> list[float]:
    """Largest errors without noise under the training measure."""
    return [largest[0] for largest in without_noise()]


def uniform() -> list[float]:
    """The same under the uniform measure, sets 2 and 3: where 300 iterations end depends on rounding."""
    return [largest[1] for largest in without_noise()[1:]]


def main(draws: int) -> None:
    print(describe())
    print(
        f"\n30 dB, medians over {draws} draws of noise and of the initial weights, evidence "
        "regularisation.\n"
    )
    print(
        "| data set | training | its prototype | uniform | 90 % of draws | allowed | a draw |\n"
        + 7 * "|---"
        + "|"
    )
    for data_set, (prototype, allowed) in NOISY.items():
        began = time.perf_counter()
        found = noisy(data_set, draws)
        (training, uniform), ninth = np.median(found, axis=0), np.quantile(found[:, 1], 0.9)
        seconds = (time.perf_counter() - began) / draws
        print(
            f"| {data_set} | {training:.4f} | {prototype} | {uniform:.4f} | {ninth:.4f} | "
            f"{allowed:.3f} | {seconds:.2f} s |",
            flush=True,
        )
    print(f"\nNo noise, largest of {INITIALISATIONS} initialisations.\n")
    print(
        "| data set | iterations | training | uniform | its median | allowed "
        "|\n|---|---|---|---|---|---|"
    )
    for iterations in (300, 1000):
        for data_set in (2, 3):
            found = noiseless(data_set, iterations)
            (training, uniform), middle = found.max(axis=0), np.median(found[:, 1])
            cells = (f"{training:.4f}", f"{uniform:.1e}", f"{middle:.1e}", f"{NOISELESS_LIMIT:.0e}")
            print(f"| {data_set} | {iterations} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 40)
