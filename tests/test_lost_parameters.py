"""Positive parameters that a descent threw so far off that it cannot bring them back."""

from __future__ import annotations

import numpy as np
import pytest

import orthaug as oa

STEP = 0.2
TRUE = {"CL0": 0.6, "CLa": 5.0, "CD0": 0.02, "K": 0.05}


def flight(rng: np.random.Generator, speed: float, path: float) -> oa.Record:
    """Return speed and height of a glider whose elevator moves; 0.1 m/s and 0.5 m of noise."""
    u = np.repeat(rng.uniform(-0.03, 0.03, 12), 25)

    def rates(x: np.ndarray, elevator: float) -> np.ndarray:
        lift = TRUE["CL0"] + TRUE["CLa"] * elevator
        drag = TRUE["CD0"] + TRUE["K"] * lift**2
        v, g = x[:2]
        return np.array(
            [
                -0.245 * v**2 * drag - 9.81 * np.sin(g),
                0.245 * v * lift - 9.81 * np.cos(g) / v,
                v * np.sin(g),
            ]
        )

    x, rows, h = np.array([speed, path, 500.0]), [], STEP / 4
    for value in u:
        rows.append(x[[0, 2]])
        for _ in range(4):
            a = rates(x, value)
            b = rates(x + h / 2 * a, value)
            c = rates(x + h / 2 * b, value)
            x = x + h / 6 * (a + 2 * b + 2 * c + rates(x + h * c, value))
    y = np.array(rows) + rng.normal(size=(300, 2)) * (0.1, 0.5)
    return oa.Record.from_arrays(u, y, sampling_time=STEP, inputs=["de"], outputs=["V", "h"])


def glider() -> oa.Motion:
    initial = zip(TRUE, (0.3, 4.0, 0.03, 0.08), strict=True)
    return oa.Motion.from_equations(
        [
            oa.State("v", "-0.245*v**2*CD - 9.81*sin(g)", "V"),
            oa.State("g", "0.245*v*CL - 9.81*cos(g)/v", 0.0),
            oa.State("x", "v*sin(g)", "h"),
        ],
        [oa.Output("V", "v"), oa.Output("h", "x")],
        [oa.PhysicalParameter(name, value, min=0) for name, value in initial],
        ["de"],
        define={"CL": "CL0 + CLa*de", "CD": "CD0 + K*CL**2"},
    )


@pytest.fixture(scope="module")
def record() -> oa.Record:
    """Two flights whose training throws the induced drag K to 2e-8."""
    rng = np.random.default_rng(7)
    return oa.Record.join([flight(rng, 9.0, -0.1), flight(rng, 11.0, 0.05)])


def test_a_parameter_thrown_towards_zero_comes_back(record):
    """K was 'not identified', CD0 off by many standard errors, and physics said to be missing."""
    fit = oa.estimate(record, glider(), learner=None)
    assert not fit.warnings
    low, high = fit.parameters["ci95_low"], fit.parameters["ci95_high"]
    assert all(low[name] < value < high[name] for name, value in TRUE.items())
    diagnosis = oa.diagnose(fit)
    assert diagnosis is not None and diagnosis.verdict == "white"


def test_a_parameter_that_is_zero_stays_there():
    """A descent from its initial value, where it does not act, is not kept."""
    rng, x, rows = np.random.default_rng(2), 0.0, []
    u = np.repeat(rng.uniform(-1, 1, 30), 10)
    for value in u:
        rows.append(x + 0.01 * rng.normal())
        x += 0.1 * (value - 0.5 * x)
    record = oa.Record.from_arrays(u, np.array(rows), sampling_time=0.1)
    motion = oa.Motion.from_equations(
        [oa.State("x", "x + 0.1*(u - a*x + 0.4*q*x**3)", "y")],
        [oa.Output("y", "x")],
        [oa.PhysicalParameter("a", 0.8, min=0), oa.PhysicalParameter("q", 0.5, min=0)],
        ["u"],
        integrator="discrete",
    )
    fit = oa.estimate(record, motion, learner=None)
    a, q = fit.values
    assert abs(a - 0.5) < 0.02
    assert q < 0.05
