"""Outputs recorded in coarse steps: the way is named, and what it does to the parameters."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import scipy.integrate

import orthaug as oa

TRUTH = np.array([1.2, 25.0, 40.0])
TS, STEP = 0.02, 2.0
WAYS = {
    "rounded to the nearest": np.round,
    "rounded down": np.floor,
    "rounded up": np.ceil,
    "cut off toward zero": np.trunc,
}


@cache
def spin(seed: int, rows: int = 1000) -> tuple[np.ndarray, np.ndarray]:
    """Voltage and speed of a motor with friction, by SciPy."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-3, 3, rows // 40), 40)
    a1, a2, b = TRUTH
    w, at = [0.0], 0.0
    for level in u[:-1]:
        run = scipy.integrate.solve_ivp(
            lambda _, x, level=level: -a1 * x - a2 * np.tanh(x / 0.3) + b * level,
            (0, TS),
            [at],
            method="LSODA",
            rtol=1e-9,
            atol=1e-9,
        )
        at = float(run.y[0, -1])
        w.append(at)
    return u, np.array(w)


def fitted(u: np.ndarray, w: np.ndarray) -> oa.Estimate:
    record = oa.Record.from_arrays(u, w, sampling_time=TS, inputs=["volt"], outputs=["w"])
    motion = oa.Motion.from_equations(
        states=[oa.State("w1", "-a1*w1 - a2*tanh(w1/0.3) + b*volt", start=0.0)],
        outputs=[oa.Output("w", "w1")],
        inputs=["volt"],
        parameters=[
            oa.PhysicalParameter("a1", 1.0),
            oa.PhysicalParameter("a2", 10.0),
            oa.PhysicalParameter("b", 30.0),
        ],
        substeps=4,
    )
    return oa.estimate(record, motion, learner=None, criterion=oa.Simulation())


@pytest.mark.parametrize("way", WAYS)
def test_the_way_of_recording_is_named_and_what_it_moves(way):
    u, w = spin(1)
    fit = fitted(u, STEP * WAYS[way](w / STEP))
    found = oa.diagnose(fit)
    assert found is not None and found.steps == pytest.approx({"w": STEP})
    text = "".join(one.text for one in found.warnings if one.code == "quantised_output")
    assert f"w in steps of 2, {way}" in text or way == "rounded to the nearest"
    moved = np.zeros(3)  # as the text gives it
    for i, name in enumerate(("a1", "a2", "b")):
        if f"{name} by " in text:
            moved[i] = float(text.split(f"{name} by ")[1].split()[0])
    assert fit.std is not None
    left = np.abs(np.array(fit.values) - moved - TRUTH)
    assert np.all(left < 2 * fit.std + 0.1 * np.abs(moved))
    if way != "rounded to the nearest":  # then it is no small matter
        assert np.max(np.abs(np.array(fit.values) - TRUTH) / fit.std) > 2.5


@pytest.mark.parametrize("size", [0.0, 3.0])
def test_steps_that_are_not_the_error_are_not_named(size):
    """Finer ones than the noise, or none: this is noise."""
    u, w = spin(1)
    w = w + (size or 0.5) * np.random.default_rng(3).normal(size=len(w))
    found = oa.diagnose(fitted(u, STEP * np.round(w / STEP) if size else w))
    assert found is not None and found.verdict == "white" and not found.steps
    assert "quantised_output" not in [one.code for one in found.warnings]
