"""Generated records: the paper's two examples, seed for seed as the published scripts draw them.

The order of the draws from NumPy's legacy `RandomState` is part of the data; it must not change.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.errors import InputError
from orthaug.data.channels import Channel
from orthaug.data.record import Record
from orthaug.physics.baseline import Baseline, Term

NOISE_30_DB = 0.009  # standard deviation of the static example's noise


@dataclass(frozen=True, eq=False)
class Example:
    """Training and noise-free test record, the baseline with its initial values, and the true θ."""

    train: Record
    test: Record
    baseline: Baseline
    theta: Vector


def static(data_set: int = 1, *, noise: bool = False, samples: int = 1024) -> Example:
    """Return the example of Sect. 5.1: `y = 0.01 + u − 0.5u² + 0.1u³ + e`, baseline `θ₁u + θ₃u³`.

    Args:
        data_set: 1 symmetric (`u` and `−u`), 2 drawn at random, 3 drawn with mean −0.01.
        noise: add 30 dB of white noise to the training output.
        samples: training samples N (1024 in the paper).
    """
    if data_set not in (1, 2, 3):
        raise InputError(f"`data_set` must be 1, 2 or 3; got {data_set}.")
    rng = np.random.RandomState(10)
    if data_set == 1:
        half = 0.3 * rng.randn(samples // 2, 1)
        u = np.vstack([half, -half])
    else:
        u = 0.3 * rng.randn(samples, 1) - (0.01 if data_set == 3 else 0.0)
    u_test = 0.3 * rng.randn(1024, 1)
    y = _static_map(u)
    if noise:
        y = y + rng.normal(0.0, NOISE_30_DB, y.shape)
    baseline = Baseline.from_terms(
        [Term("theta1", "u[k]", initial=0.8), Term("theta3", "u[k]**3", initial=0.03)]
    )
    return Example(
        Record.from_arrays(u, y),
        Record.from_arrays(u_test, _static_map(u_test)),
        baseline,
        np.array([1.0, 0.1]),
    )


def _static_map(u: np.ndarray) -> np.ndarray:
    return 0.01 + u - 0.5 * u**2 + 0.1 * u**3


@dataclass(frozen=True)
class MassSpringDamper:
    """The mass-spring-damper of Sect. 5.2.

    Mass [kg], damping [Ns/m], stiffness [N/m], Stribeck friction [N, N, m/s], sampling time [s].
    """

    m: float = 1.0
    cd: float = 100.0
    ks: float = 1000.0
    coulomb: float = 0.8
    static: float = 1.2
    stribeck: float = 0.02
    sampling_time: float = 0.01

    def paper_theta(self) -> Vector:
        """Return θ as printed in the paper and its scripts.

        Backward Euler has `2m + cd Ts` in the first entry.
        """
        ts = self.sampling_time
        gamma = self.m + self.cd * ts + self.ks * ts**2
        return np.array([2 * self.m - self.cd * ts, -self.m, ts**2]) / gamma

    def friction(self, velocity: np.ndarray | float) -> np.ndarray | float:
        """Return the Stribeck curve [N] of a velocity [m/s]."""
        decay = np.exp(-np.abs(velocity) / self.stribeck)
        return (self.coulomb + (self.static - self.coulomb) * decay) * np.sign(velocity)

    def simulate(self, force: Vector, theta: Vector, noise: Vector | None = None) -> Vector:
        """Return the position [m] under `force` [N] from rest; `noise` enters the equation."""
        y = np.zeros(len(force))
        e = np.zeros(len(force)) if noise is None else np.concatenate([[0.0, 0.0], noise])
        for k in range(2, len(force)):
            velocity = (y[k - 1] - y[k - 2]) / self.sampling_time
            y[k] = (
                theta[0] * y[k - 1]
                + theta[1] * y[k - 2]
                + theta[2] * (force[k - 1] - self.friction(velocity))
                + e[k]
            )
        return y


def mass_spring_damper() -> Example:
    """Return the paper's record of Sect. 5.2.

    It has 10⁴ noisy training samples and 1000 noise-free test samples.
    """
    system = MassSpringDamper()
    theta = system.paper_theta()
    rng = np.random.RandomState(12345)
    half = rng.normal(0.0, 100.0, 5000)
    force = np.concatenate([half, -half])
    position = system.simulate(force, theta, rng.normal(scale=0.00018, size=len(force) - 2))
    force_test = rng.uniform(-100.0, 100.0, 1000)
    names = {
        "inputs": [Channel("force", "N")],
        "outputs": [Channel("position", "m")],
        "sampling_time": 0.01,
    }
    baseline = Baseline.from_terms(
        [
            Term("theta1", "position[k-1]", initial=0.61),
            Term("theta2", "position[k-2]", initial=-0.52),
            Term("theta3", "force[k-1]", initial=4.7e-5, unit="m/N"),
        ]
    )
    train = Record.from_arrays(force, position, **names)
    test = Record.from_arrays(force_test, system.simulate(force_test, theta), **names)
    return Example(train, test, baseline, theta)
