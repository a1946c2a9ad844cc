"""Are the outputs before a segment unknowns? m, c, k of a mass-spring-damper whose position has 30 dB of sensor noise.

The record of examples/sensor_noise.py, trained on the free run. Run: python benchmarks/initial_states.py
"""

from __future__ import annotations

import sys

import numpy as np
from machine import ROOT, describe

import orthaug as oa

sys.path.append(str(ROOT / "examples"))
import sensor_noise

TRUE, DRAWS = np.array([1.0, 100.0, 1000.0]), 20


def deviations(draws: int, exact_start: bool) -> np.ndarray:
    """Errors of m, c, k in their standard errors, (draws, 3)."""
    found = []
    for seed in range(draws):
        criterion = oa.Simulation(exact_start=exact_start)
        fit = oa.estimate(
            sensor_noise.record(seed), sensor_noise.BASELINE, learner=None, criterion=criterion
        )
        physical = fit.physical(sensor_noise.PHYSICS)
        found.append((physical.value - TRUE) / physical.std)
    return np.array(found)


def compare(draws: int = DRAWS) -> list[float]:
    """Median error of m with measured starts; draws with all three within 3 where starts are unknown; all draws."""
    measured, unknown = (np.abs(deviations(draws, exact)) for exact in (True, False))
    return [float(np.median(measured[:, 0])), float(np.sum(unknown.max(axis=1) < 3)), float(draws)]


def main() -> None:
    print(describe())
    off, held, draws = compare()
    print(
        f"Measured starts: m is off by {off:.1f} standard errors. Unknown: {held:.0f} of "
        f"{draws:.0f} within 3."
    )


if __name__ == "__main__":
    main()
