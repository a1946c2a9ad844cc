"""A mass, spring and damper with friction, sampled: records in which mass or friction change."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

import orthaug as oa

TS = 0.01  # s
MASS, DAMPING, STIFFNESS, FRICTION = 1.0, 2.0, 100.0, 3.0  # kg, N s/m, N/m, N
NOISE = 1.0  # N, standard deviation of an unknown force
ROWS = 3000


@dataclass(frozen=True)
class Plant:
    """`m a = u − c v − k x − F tanh(v / 0.05) + w`; each may be a number or one for every row."""

    m: Any = MASS
    f: Any = FRICTION
    noise: float = NOISE
    colour: float = 0.0
    tails: float | None = None
    """Degrees of freedom of Student's t, for noise that is not normal."""

    def record(self, seed: int, rows: int = ROWS, scale: Any = 1.0) -> oa.Record:
        """A record under random steps of force, `scale` times."""
        rng = np.random.default_rng(seed)
        force = np.repeat(rng.normal(0, 20.0, rows // 10 + 1), 10)[:rows] * scale
        m, f = np.broadcast_to(self.m, rows), np.broadcast_to(self.f, rows)
        w = rng.normal(size=rows) if self.tails is None else rng.standard_t(self.tails, rows)
        w *= self.noise / (1.0 if self.tails is None else np.sqrt(self.tails / (self.tails - 2)))
        for k in range(1, rows):
            w[k] = self.colour * w[k - 1] + np.sqrt(1 - self.colour**2) * w[k]
        x = np.zeros(rows)
        for k in range(2, rows):
            v = (x[k - 1] - x[k - 2]) / TS
            push = (
                force[k - 1] - DAMPING * v - STIFFNESS * x[k - 1] - f[k] * np.tanh(v / 0.05) + w[k]
            )
            x[k] = 2 * x[k - 1] - x[k - 2] + TS**2 * push / m[k]
        channels = {"inputs": [oa.Channel("force", "N")], "outputs": [oa.Channel("position", "m")]}
        return oa.Record.from_arrays(force, x, sampling_time=TS, **channels)


def baseline() -> oa.Baseline:
    return oa.Baseline.from_terms(
        [
            oa.Term("theta1", "position[k-1]"),
            oa.Term("theta2", "position[k-2]"),
            oa.Term("theta3", "force[k-1]", unit="m/N"),
        ]
    )


def physics() -> oa.PhysicsMap:
    """θ of mass, damping and stiffness."""
    parameters = [
        oa.PhysicalParameter("m", 1.2, "kg", min=0),
        oa.PhysicalParameter("c", 1.0, "N s/m"),
        oa.PhysicalParameter("ks", 80.0, "N/m"),
    ]
    theta = {"theta1": "2 - c*Ts/m - ks*Ts**2/m", "theta2": "c*Ts/m - 1", "theta3": "Ts**2/m"}
    return oa.PhysicsMap.of(parameters, theta, {"Ts": TS})


def fitted(seed: int = 0, plant: Plant = Plant(), rows: int = ROWS, **options: Any) -> oa.Estimate:  # noqa: B008
    """The learner sees the velocity, and finds the friction."""
    learner = oa.MLP((8,), inputs=("(position[k-1] - position[k-2])/Ts",))
    return oa.estimate(plant.record(seed, rows), baseline(), learner=learner, **options)
