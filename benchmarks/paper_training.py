"""How far the paper's noisy static example is trained, and what that makes of θ and of the test error.

Ten initial weights on data set 1 with 30 dB of noise. Sums of squares are over the 1024 test samples, as the paper
prints them: 5.86e-4 additive, 5.35e-4 orthogonal, and ‖θ* − θ̂‖ of the additive structure 0.1952.

Run: python benchmarks/paper_training.py
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from unittest.mock import patch

import numpy as np
from machine import describe

from orthaug import Estimate
from orthaug.fitting.structures import Additive, Structure
from orthaug.studies import published
from orthaug.studies.common import ORTHOGONAL, STRUCTURES, train
from orthaug.studies.synthetic import static

STARTS = 10
EXAMPLE = static(1, noise=True)
SCRIPTS = {  # Adam iterations, evaluations of L-BFGS, its tolerances, in the order of the table
    "as the paper says": (500, 1000, 1e-16),
    "50 evaluations": (500, 50, 1e-16),
    "100 evaluations": (500, 100, 1e-16),
    "200 evaluations": (500, 200, 1e-16),
    "500 evaluations": (500, 500, 1e-16),
    "tolerance 1e-8": (500, 1000, 1e-8),
    "2500 of Adam": (2500, 1000, 1e-16),
}
ITERATIONS = (20, 30, 50, 100, 300)  # of Levenberg-Marquardt


def errors(fit: Estimate) -> tuple[float, float, float]:
    """‖θ* − θ̂‖, the sum of squared test errors, effective weights."""
    rmse = float(fit.model.simulate(EXAMPLE.test).scores().rmse[0])
    return (
        float(np.linalg.norm(fit.theta - EXAMPLE.theta)),
        1024 * rmse**2,
        float(fit.effective_weights),
    )


def over_starts(fit_of: Callable[[int], Estimate]) -> np.ndarray:
    return np.array([errors(fit_of(seed)) for seed in range(STARTS)])


@contextmanager
def tolerance(value: float) -> Iterator[None]:
    with patch.dict(published.LBFGS, ftol=value, gtol=value):
        yield


def by_scripts(adam: int, evaluations: int, tol: float, structure: Structure) -> np.ndarray:
    with tolerance(tol):
        return over_starts(
            lambda seed: published.train(EXAMPLE, structure, (adam, evaluations), seed)
        )


def scripts() -> list[list[float]]:
    """Per row: ‖θ* − θ̂‖ of the additive structure, mean, smallest, largest; both sums of squares, additive first."""
    rows = []
    for settings in SCRIPTS.values():
        additive, orthogonal = (
            by_scripts(*settings, STRUCTURES[name]) for name in ("additive", "orthogonal")
        )
        theta = additive[:, 0]
        rows.append(
            [theta.mean(), theta.min(), theta.max(), additive[:, 1].mean(), orthogonal[:, 1].mean()]
        )
    return rows


def levenberg() -> list[list[float]]:
    """Per number of iterations: sum of squares and weights, orthogonal; sum of squares and error of θ, additive."""
    rows = []
    for iterations in ITERATIONS:
        orthogonal, additive = (
            over_starts(
                lambda seed, s=structure, i=iterations: train(
                    EXAMPLE, "static", "ours", structure=s, seed=seed, iterations=i
                )
            ).mean(axis=0)
            for structure in (ORTHOGONAL, Additive(from_initial=True))
        )
        rows.append([orthogonal[1], orthogonal[2], additive[1], additive[0]])
    return rows


def main() -> None:
    print(describe())
    for name, row in zip(SCRIPTS, scripts(), strict=True):
        print(f"| {name} | " + " | ".join(f"{value:.3g}" for value in row) + " |")
    for iterations, row in zip(ITERATIONS, levenberg(), strict=True):
        print(f"| {iterations} | " + " | ".join(f"{value:.3g}" for value in row) + " |")


if __name__ == "__main__":
    main()
