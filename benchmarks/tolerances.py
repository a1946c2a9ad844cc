"""When to stop Levenberg-Marquardt, and how strongly to damp its first step: the choices of docs/decisions/damping.md.

Run: python benchmarks/tolerances.py
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from machine import describe

import orthaug as oa
from orthaug.fitting.solvers import levenberg_marquardt
from orthaug.studies import synthetic

TOLERANCES, SEEDS = (1e-8, 1e-7, 1e-6, 1e-5), range(4)
CASES = (
    ("static, no noise", "none"),
    ("static, 30 dB", "none"),
    ("static, 30 dB", "evidence"),
    ("MSD", "none"),
    ("MSD", "evidence"),
)
WEAK, STRONG = 1e-5, 1e-3  # first dampings


def example(name: str) -> synthetic.Example:
    return (
        synthetic.mass_spring_damper()
        if name == "MSD"
        else synthetic.static(1, noise="30 dB" in name)
    )


def median_run(name: str, regularization: str, tolerance: float) -> tuple[float, float]:
    """Medians over starts of the test RMSE and of the iterations."""
    given, runs = example(name), []
    for seed in SEEDS:
        solver = oa.LevenbergMarquardt(300, tolerance, longest=300)
        fit = oa.estimate(
            given.train, given.baseline, solver=solver, regularization=regularization, seed=seed
        )
        runs.append((fit.model.predict(given.test).scores().rmse[0], fit.status.iterations))
    rmse, iterations = np.median(runs, axis=0)
    return float(rmse), float(iterations)


def rows() -> Iterator[list[tuple[float, float]]]:
    """For each tolerance all cases."""
    for tolerance in TOLERANCES:
        yield [median_run(*case, tolerance) for case in CASES]


def table() -> list[list[tuple[float, float]]]:
    """The numbers of docs/decisions/damping.md."""
    return list(rows())


def first_damping() -> float:
    """How many per cent more iterations the strong first damping takes, over the cases that converge with the weak."""
    taken = {}
    for damping in (WEAK, STRONG):
        before = levenberg_marquardt.IDENTITY
        levenberg_marquardt.IDENTITY = before._replace(first=damping)
        taken[damping] = np.array([median_run(*case, 1e-6)[1] for case in CASES])
        levenberg_marquardt.IDENTITY = before
    converged = taken[WEAK] < 300
    return float(100 * (taken[STRONG][converged].sum() / taken[WEAK][converged].sum() - 1))


def main() -> None:
    print(describe())
    print(f"| tolerance | {' | '.join(f'{name}, {kind}' for name, kind in CASES)} |\n{6 * '|---'}|")
    for tolerance, cells in zip(TOLERANCES, rows(), strict=True):
        found = (f"{rmse:.3g}, {iterations:.0f}" for rmse, iterations in cells)
        print(f"| {tolerance:.0e} | {' | '.join(found)} |", flush=True)
    print(
        f"\nA first damping of {STRONG:.0e} takes {first_damping():.0f} % more iterations than "
        f"{WEAK:.0e}."
    )


if __name__ == "__main__":
    main()
