"""Records of the examples whose data are generated: run this once, then fit the specs beside it.

    python examples/generate.py [folder]        writes generated/*.csv beside this file, or into the folder

Each record is the fine integration of equations that the spec knows in part, with noise on the measured outputs and a
seed of its own. The true parameters are here, so that the estimates can be held against it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

FINE = 20  # steps of the integrator in a sample


class System(NamedTuple):
    """A plant: ẋ = rate(x, u) from rest, which states are measured, its inputs, and the noise that its outputs get."""

    rate: Callable[[np.ndarray, np.ndarray], np.ndarray]
    states: int
    measured: tuple[int, ...]
    names: tuple[str, ...]
    """Of inputs, then outputs."""
    sampling_time: float
    levels: tuple[float, ...]
    """Largest input of each kind."""
    held: int
    """Samples between two steps of an input."""
    noise: float
    """Standard deviation of the noise over that of the output."""

    def steps(self, rows: int, seed: int) -> np.ndarray:
        """Inputs (N, nu) that step at random."""
        random, count = np.random.default_rng(seed), -(-rows // self.held)
        drawn = [
            np.repeat(random.uniform(-level, level, count), self.held)[:rows]
            for level in self.levels
        ]
        return np.stack(drawn, axis=1)

    def run(self, inputs: np.ndarray) -> np.ndarray:
        """States (N, nx) from rest, by Runge-Kutta steps under inputs that are held."""
        x, found, h = np.zeros(self.states), [], self.sampling_time / FINE
        for u in inputs:
            found.append(x)
            for _ in range(FINE):
                first = self.rate(x, u)
                second = self.rate(x + h / 2 * first, u)
                third = self.rate(x + h / 2 * second, u)
                x = x + h / 6 * (first + 2 * second + 2 * third + self.rate(x + h * third, u))
        return np.array(found)

    def record(self, rows: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Inputs and outputs, and the states without noise."""
        inputs = self.steps(rows, seed)
        states = self.run(inputs)
        outputs = states[:, self.measured]
        noise = (
            np.random.default_rng([seed, 1]).normal(size=outputs.shape)
            * self.noise
            * outputs.std(axis=0)
        )
        return np.concatenate([inputs, outputs + noise], axis=1), states


FRICTION = {"m": 1.0, "c": 2.0, "k": 100.0, "coulomb": 1.5}


def friction(v: np.ndarray) -> np.ndarray:
    """Friction force [N] of the mass, which the spec does not know."""
    return FRICTION["coulomb"] * np.tanh(v / 0.1)


def mass(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    p = FRICTION
    return np.array([x[1], (u[0] - p["c"] * x[1] - p["k"] * x[0] - friction(x[1])) / p["m"]])


MOTOR = {"R": 2.0, "L": 0.02, "K": 0.1, "J": 2e-4, "b": 1e-4}


def drag(w: np.ndarray) -> np.ndarray:
    """Friction torque [N m] of the motor with its Stribeck peak, which the spec does not know."""
    return (0.03 + 0.03 * np.exp(-((w / 15) ** 2))) * np.tanh(w / 3)


def motor(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    p, (i, w) = MOTOR, x
    return np.array(
        [(u[0] - p["R"] * i - p["K"] * w) / p["L"], (p["K"] * i - p["b"] * w - drag(w)) / p["J"]]
    )


ARM = {"a1": 0.425, "a2": 0.06, "b1": 1.0, "b2": 0.2, "d1": 0.3, "d2": 0.05, "l1": 0.5, "g": 9.81}


def joints(w: np.ndarray) -> np.ndarray:
    """Friction torques [N m] of both joints, which the spec does not know."""
    return np.array([0.5, 0.08]) * np.tanh(w / 0.2)


def arm(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    p, q, w = ARM, x[:2], x[2:]
    a3 = p["l1"] * p["b2"]
    m12 = p["a2"] + a3 * np.cos(q[1])
    matrix = np.array([[p["a1"] + p["a2"] + 2 * a3 * np.cos(q[1]), m12], [m12, p["a2"]]])
    turning = a3 * np.sin(q[1]) * np.array([-w[1] * (2 * w[0] + w[1]), w[0] ** 2])
    second = p["g"] * p["b2"] * np.sin(q[0] + q[1])
    gravity = np.array([p["g"] * p["b1"] * np.sin(q[0]) + second, second])
    torque = u - turning - gravity - np.array([p["d1"], p["d2"]]) * w - joints(w)
    return np.concatenate([w, np.linalg.solve(matrix, torque)])


SYSTEMS = {
    "motion_friction": System(mass, 2, (0,), ("force", "position"), 0.01, (20.0,), 25, 10**-1.5),
    "dc_motor": System(motor, 2, (1,), ("voltage", "speed"), 0.002, (12.0,), 40, 0.01),
    "two_link_arm": System(
        arm, 4, (0, 1), ("torque1", "torque2", "angle1", "angle2"), 0.02, (5.0, 1.0), 20, 0.01
    ),
}
SEEDS = {"train": 1, "test": 2}
TRAINED = {"motion_friction": 1000, "dc_motor": 1000, "two_link_arm": 2000}
TESTED = 500


def write(folder: Path) -> list[Path]:
    """Every record as a file of comma-separated values."""
    folder.mkdir(exist_ok=True)
    written = []
    for name, system in SYSTEMS.items():
        for part, seed in SEEDS.items():
            rows = TRAINED[name] if part == "train" else TESTED
            written.append(folder / f"{name}_{part}.csv")
            header = ",".join(system.names)
            np.savetxt(
                written[-1],
                system.record(rows, seed)[0],
                delimiter=",",
                header=header,
                comments="",
                fmt="%.9g",
            )
    return written


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path(__file__).parent / "generated")
    for path in write(parser.parse_args().folder):
        print(path)
