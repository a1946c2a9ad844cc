"""Inputs that act later than in the equations are found beside slow disturbances, too."""

import json

import numpy as np
import pytest
from test_cli import run

import orthaug as oa
from orthaug.analysis.input_timing import sort_holds
from orthaug.physics.motion import HOLDS


def chamber(delay, seed=0, rows=1200):
    """A heated chamber whose surroundings drift slowly, which no equation has."""
    rng = np.random.default_rng(seed)
    power = np.repeat(rng.uniform(0, 400, rows // 60), 60)
    acting = np.concatenate([np.full(delay, power[0]), power])[:rows]
    around = 20 + 2 * np.sin(2 * np.pi * np.arange(rows) / 900 + seed)
    kept, temperature = np.exp(-10 * 8 / 5000), np.full(rows, 30.0)
    for k in range(rows - 1):
        rest = around[k] + acting[k] / 8
        temperature[k + 1] = rest + kept * (temperature[k] - rest)
    return oa.Record.from_arrays(
        u=power,
        y=temperature + 0.02 * rng.normal(size=rows),
        sampling_time=10.0,
        inputs=["power"],
        outputs=["T"],
    )


MOTION = oa.Motion.from_equations(
    states=[oa.State("x", "(power - h*(x - 20))/C", start="T")],
    outputs=[oa.Output("T", "x")],
    inputs=["power"],
    parameters=[oa.PhysicalParameter("h", 6.0, min=0), oa.PhysicalParameter("C", 4000.0, min=0)],
)


@pytest.mark.parametrize("delay", [0, 3])
def test_a_delay_is_found_beside_a_slow_disturbance(delay):
    fit = oa.estimate(chamber(delay), MOTION, learner=None)
    late = fit.diagnose().residuals.late
    if not delay:
        assert late == []
        return
    (found,) = late
    assert found.ahead
    assert (found.input, found.delay, found.by_lag, found.alike) == ("power", 3, False, False)
    assert found.delayed < 0.6 * found.declared


STEP, KEPT = 0.05, float(np.exp(-0.05 / 0.3 / 10))  # s; of the state, over a tenth of it
FIRST_ORDER = {
    "outputs": [oa.Output("y", "x")],
    "inputs": ["u"],
    "parameters": [oa.PhysicalParameter("K", 1.0, min=0), oa.PhysicalParameter("T", 1.0, min=0)],
}
LAG = oa.Motion.from_equations(
    states=[oa.State("x", "(K*u - x)/T", start="y")],
    **FIRST_ORDER,
)
STEPS = oa.Motion.from_equations(
    states=[oa.State("x", "x + (K*u - x)*0.05/T", start="y")], integrator="discrete", **FIRST_ORDER
)


def logged(delay=0.0, at_once=0.0, rows=800):
    """A lag of gain 2 on which u acts so many samples late, and `at_once` times u in its output."""
    rng, spare = np.random.default_rng(0), 5
    u = np.repeat(rng.uniform(0, 5, rows // 10 + 2), 10)[: rows + 2 * spare]
    tenths = np.arange(10 * len(u)) - round(10 * delay)
    acting = u[np.clip(tenths // 10, 0, len(u) - 1)]
    x = np.full(len(acting), 2 * u[0])
    for k in range(len(acting) - 1):
        x[k + 1] = KEPT * x[k] + (1 - KEPT) * 2 * acting[k]
    y = x[::10] + at_once * u + 0.05 * rng.normal(size=len(u))
    kept = slice(spare, spare + rows)
    return oa.Record.from_arrays(u[kept], y[kept], sampling_time=STEP, inputs=["u"], outputs=["y"])


@pytest.mark.parametrize("late", [1, 2])
def test_an_input_that_is_logged_late_is_moved_back(late):
    """A term u in the output has the same error, but its gain is wrong by 15 % (K 1.7 for 2)."""
    found = oa.estimate(logged(-late), LAG, learner=None).diagnose()
    (early,) = found.residuals.late
    assert (early.delay, early.by_lag, early.alike, early.time_constant) == (-late, False, False, 0)
    assert early.delayed < 0.03 < 0.1 < early.declared
    word = {1: "a sample", 2: "2 samples"}[late]
    assert f"u acts {word} earlier than recorded: with its values" in found.residuals.text
    (warned,) = [warning for warning in found.warnings if warning.code == "late_rows"]
    assert f"samples = {-late}." in warned.text and "logged late: advance" in warned.text


@pytest.mark.parametrize("delay", [2.4, 2])
def test_a_dead_time_is_found_to_a_tenth_of_a_sample(delay):
    """Of 2.4 samples 2 were found, and the rest was taken for a missing term."""
    found = oa.estimate(logged(delay), LAG, learner=None).diagnose()
    (late,) = found.residuals.late
    assert late.delay == pytest.approx(delay, abs=1e-9) and not late.by_lag
    assert f"a delay of {delay} samples the error" in found.residuals.text
    if delay != 2.4:
        return
    right = oa.prepare(logged(delay), oa.Shift("u", late.delay))
    fit = oa.estimate(right, LAG, learner=None)
    assert fit.parameters.loc["K", "value"] == pytest.approx(2, rel=2e-3)
    assert fit.parameters.loc["T", "value"] == pytest.approx(0.3, rel=2e-2)
    assert fit.diagnose().residuals.late == []


@pytest.mark.parametrize("at_once", [0.0, 0.6, -0.2])
def test_an_input_that_acts_at_once_is_not_moved(at_once):
    """An advance imitates 0.31 of u in the output alone; beside others it leaves a trace of u."""
    found = oa.estimate(logged(0, at_once), LAG, learner=None).diagnose().residuals
    assert [late for late in found.late if late.delay < 1] == []
    assert ("rows may be logged late" in found.text) == bool(at_once)


def test_an_input_that_moves_between_samples_is_not_moved():
    """It acts half a sample early beside its steps, which a whole sample half mends."""
    rng, fine = np.random.default_rng(0), 10
    u = np.zeros(400 * fine)
    for k in range(len(u) - 1):
        u[k + 1] = 0.97 * u[k] + 0.2 * rng.normal()
    x = np.zeros(len(u))
    for k in range(len(u) - 1):
        x[k + 1] = 0.7 * x[k] + 0.3 * 2 * u[k]
    y = x[::fine] + 0.01 * rng.normal(size=400)
    record = oa.Record.from_arrays(u[::fine], y, sampling_time=STEP, inputs=["u"], outputs=["y"])
    found = oa.estimate(record, LAG, learner=None).diagnose().residuals
    assert found.verdict == "unmodelled" and found.late == []


def test_a_discrete_plant_without_delay_is_not_moved():
    """Its equations have u act a sample later; that it acts at once is no fault of the logger."""
    found = oa.estimate(logged(-1), STEPS, learner=None).diagnose().residuals
    assert found.verdict == "unmodelled" and found.late == []


def test_a_run_in_the_wrong_phase_is_no_delay(tmp_path):
    """Its errors are the oscillation itself, which their own past predicts better than others."""
    rng, step, w = np.random.default_rng(0), 0.0016, 2 * np.pi * 70
    tones, phases = np.arange(40.0, 100.0, 3.0), rng.uniform(0, 2 * np.pi, 20)
    u = 0.3 * np.cos(2 * np.pi * tones * step * np.arange(300)[:, None] + phases).sum(axis=1)
    x, v, y = 0.0, 0.0, np.empty(300)
    for k in range(300):
        y[k] = x
        for _ in range(10):
            v += step / 10 * (w**2 * (u[k] - x) - 0.1 * w * v)
            x += step / 10 * v
    logged = u + 1.2 * rng.normal(size=300)  # by a noisy sensor
    table = np.column_stack([logged, y + 1e-3 * rng.normal(size=300)])
    np.savetxt(tmp_path / "run.csv", table, delimiter=",", header="u,y", comments="")
    (tmp_path / "spec.toml").write_text(OSCILLATOR)
    done = run("check", tmp_path / "spec.toml", "--json")
    assert done.code == 0, done.err
    codes = {warning["code"] for warning in json.loads(done.out)["warnings"]}
    assert not codes & {"dead_time", "slow_input", "late_rows"}


OSCILLATOR = """
[data]
sampling_time = 0.0016
inputs = ["u"]
outputs = ["y"]
train = { files = ["run.csv"] }
[motion.states]
x = { derivative = "v", start = "y" }
v = { derivative = "(u - c*v - k*x)/m", start = "derivative of y" }
[motion.outputs]
y = "x"
[motion.parameters]
m = { initial = 6e-6, min = 0 }
c = { initial = 2e-4, min = 0 }
k = { initial = 1.2, min = 0 }
[learner]
kind = "none"
"""


_K = np.arange(200)


@pytest.mark.parametrize(
    ("drive", "first"),
    [
        (np.sin(_K / 4), "spline"),
        (np.abs(_K % 40 - 20.0), "first-order"),
        (np.repeat(np.random.default_rng(0).normal(size=20), 10), "zero-order"),
        (np.ones(200), "zero-order"),
        (np.sin(_K[:7]), "zero-order"),
    ],
    ids=["smooth", "corners", "steps", "constant", "few rows"],
)
def test_the_hold_that_an_input_is_likely_to_follow_is_tried_first(drive, first):
    """A sensor's smooth record was advised straight lines, at three times a spline's error."""
    record = oa.Record.from_arrays(u=drive, y=drive)
    assert sort_holds(record, HOLDS)[0] == first
