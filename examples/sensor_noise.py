"""Noise on the sensor: one-step least squares is wrong, the residual says so, and the free run mends it.

    python examples/sensor_noise.py

A mass-spring-damper (1 kg, 100 N s/m, 1000 N/m) by backward Euler at 2 ms, its position measured with 30 dB of noise.
"""

from __future__ import annotations

import numpy as np

import orthaug as oa

TS = 0.002
GAMMA = f"(m + cd*{TS} + ks*{TS}**2)"
PHYSICS = oa.PhysicsMap.of(
    [
        oa.PhysicalParameter(n, v, u)
        for n, v, u in (("m", 1.2, "kg"), ("cd", 80, "N s/m"), ("ks", 900, "N/m"))
    ],
    {"a1": f"(2*m + cd*{TS}) / {GAMMA}", "a2": f"-m / {GAMMA}", "b": f"{TS}**2 / {GAMMA}"},
)
BASELINE = oa.Baseline.from_terms(
    [oa.Term("a1", "position[k-1]"), oa.Term("a2", "position[k-2]"), oa.Term("b", "force[k-1]")]
)


def record(seed: int, samples: int = 10_000) -> oa.Record:
    """White force, position with 30 dB of white noise."""
    rng = np.random.default_rng(seed)
    theta = PHYSICS.theta(np.array([1.0, 100.0, 1000.0]))
    force, position = rng.normal(0, 100, samples), np.zeros(samples)
    for k in range(2, samples):
        position[k] = theta @ (position[k - 1], position[k - 2], force[k - 1])
    measured = position + rng.normal(0, position.std() * 10**-1.5, samples)
    return oa.Record.from_arrays(
        force, measured, sampling_time=TS, inputs=["force"], outputs=["position"]
    )


def main() -> dict[str, np.ndarray]:
    """Fit both ways and print m, cd, ks with their standard errors, and what the residual says."""
    data, found = record(seed=0), {}
    for name, criterion in (("one step", oa.Prediction()), ("free run", oa.Simulation())):
        fit = oa.estimate(data, BASELINE, learner=None, criterion=criterion)
        physical = fit.physical(PHYSICS)
        rows = zip(physical.names, physical.value, physical.std, strict=True)
        listed = ", ".join(
            f"{parameter} = {value:.5g} ± {std:.2g}" for parameter, value, std in rows
        )
        print(f"{name}: {listed}\n  {oa.diagnose(fit).text}")
        found[name] = physical.value
    return found


if __name__ == "__main__":
    main()
