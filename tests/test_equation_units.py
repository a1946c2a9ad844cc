"""Units of equations against those of the data: states that outputs measure, and sines of degrees."""

from __future__ import annotations

import json

import numpy as np
import pytest
from test_cli import run, write_csv

import orthaug as oa
from orthaug.analysis.equation_units import equation_units
from orthaug.commands.opening import open_job

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")

SPEC = """
[data]
sampling_time = 0.05
inputs = ["moment"]
outputs = ["roll"]
train = "run.csv"
[data.channels]
roll = { unit = "deg" }
[motion.states]
phi = { derivative = "p", start = "roll" }
p = { derivative = "g*moment - d*p - w2*sin(phi)", start = "derivative of roll" }
[motion.outputs]
roll = "phi"
[motion.parameters]
d = { initial = 0.3, min = 0 }
w2 = { initial = 0.8, min = 0 }
g = { initial = 0.8, min = 0 }
"""
RADIANS = 'roll = { unit = "rad", scale = 0.0174533 }'


@pytest.fixture
def ship(tmp_path):
    rng = np.random.default_rng(3)
    moment = np.repeat(rng.uniform(-0.6, 0.6, 20), 10)
    phi, p, rows = 0.2, 0.0, []
    for u in moment:
        rows.append(phi)
        for _ in range(5):
            p += 0.01 * (u - 0.4 * p - np.sin(phi))
            phi += 0.01 * p
    roll = np.degrees(rows) + 0.05 * rng.normal(size=200)
    write_csv(tmp_path / "run.csv", moment=moment, roll=roll)
    return tmp_path / "spec.toml"


def said(spec, text):
    spec.write_text(text, encoding="utf-8")
    job = open_job(spec)
    return [one.text for one in equation_units(job.train.record, job.problem.physics)]


def test_a_sine_of_degrees_is_named_with_the_scale_that_makes_radians(ship):
    (text,) = said(ship, SPEC)
    done = run("check", ship, "--json")
    assert done.code == 0, done.err
    assert text in [one["text"] for one in json.loads(done.out)["warnings"]]
    assert text.startswith("sin(phi) takes radians, and roll is in deg.")
    assert "`scale = 0.0174533`" in text and "sin(0.0174533*(phi))" in text


@pytest.mark.parametrize(
    "right",
    [
        SPEC.replace('roll = { unit = "deg" }', RADIANS),
        SPEC.replace(
            'roll = { unit = "deg" }', RADIANS.replace("rad", "deg")
        ),  # in rad, all the same
        SPEC.replace("sin(phi)", "sin(phi/57.2958)"),
        SPEC.replace("sin(phi)", "phi"),
        SPEC.replace('roll = "phi"', 'roll = "57.2958*phi"'),
        SPEC.replace('roll = { unit = "deg" }', ""),
    ],
)
def test_what_converts_or_needs_no_radians_is_not_named(ship, right):
    assert said(ship, right) == []


@pytest.mark.parametrize(
    ("unit", "state", "factor"),
    [("deg", "rad", "0.0174533"), ("mm", "m", "0.001"), ("m", "s", None), ("rad", "1", "")],
)
def test_an_output_that_is_a_state_of_another_unit_is_named(ship, unit, state, factor):
    text = SPEC.replace('"deg"', f'"{unit}"').replace("sin(phi)", "phi")
    found = said(ship, text.replace('start = "roll" }', f'start = "roll", unit = "{state}" }}'))
    if factor == "":
        assert not found
    elif factor is None:
        assert "units of different kinds" in found[0]
    else:
        assert f'`unit = "{state}"` and `scale = {factor}`' in found[0]


def test_a_fit_whose_output_is_a_state_of_another_unit_reads_no_parameters(ship, tmp_path):
    text = SPEC.replace("sin(phi)", "phi").replace('"roll" }', '"roll", unit = "rad" }')
    ship.write_text(text, encoding="utf-8")
    done = run("fit", ship, "--out", tmp_path / "result")
    assert done.code == 0, done.err
    text = " ".join(done.out.split())
    assert "and to read" not in text
    assert "its equations and its data are in different units" in text


def test_lagged_physics_with_a_sine_of_degrees_is_named(tmp_path):
    rng = np.random.default_rng(0)
    y = np.cumsum(rng.normal(size=300))
    record = oa.Record.from_arrays(
        rng.normal(size=300),
        y,
        sampling_time=0.1,
        inputs=["u"],
        outputs=[oa.Channel("angle", "deg")],
    )
    terms = [oa.Term("a", "angle[k-1]"), oa.Term("g", "sin(angle[k-1])"), oa.Term("b", "u[k-1]")]
    fit = oa.estimate(record, oa.Baseline.from_terms(terms), learner=None)
    codes = [one.code for one in fit.diagnose().warnings]
    assert "equation_units" in codes


TANK = """
[data]
time = "t [min]"
inputs = ["u"]
outputs = ["y"]
train = "tank.csv"
[motion.states]
x = { derivative = "b*u - a*x", start = "y" }
[motion.outputs]
y = "x"
[motion.parameters]
a = { initial = 0.2, unit = "1/min", min = 0 }
b = { initial = 0.5, min = 0 }
"""


def test_a_motion_too_fast_for_its_sampling_names_rates_of_another_time(tmp_path):
    rows = "\n".join(f"{k % 7},{k % 5}" for k in range(60))
    (tmp_path / "tank.csv").write_text(f"u,y\n{rows}\n", encoding="utf-8")
    text = TANK.replace('time = "t [min]"', "sampling_time = 1800")
    text = text.replace("1/min", "1/h").replace("0.2", "5.0")
    (tmp_path / "spec.toml").write_text(text, encoding="utf-8")
    done = run("check", tmp_path / "spec.toml")
    assert done.code == 2 and "Parameters are in 1/h" in done.err


TURN = """
[data]
sampling_time = 0.05
inputs = ["rudder"]
outputs = ["rate"]
train = "run.csv"
[data.channels]
rudder = { unit = "deg" }
rate = { unit = "rad/s" }
[motion.states]
r = { derivative = "N_d*rudder - N_r*r", start = "rate", unit = "rad/s" }
[motion.outputs]
rate = "r"
[motion.parameters]
N_d = { initial = 0.8, unit = "1/s2" }
N_r = { initial = 0.8, unit = "1/s", min = 0 }
"""


def test_degrees_that_a_parameter_without_them_turns_into_radians_are_named(tmp_path):
    rng = np.random.default_rng(3)
    rudder, rate = np.repeat(rng.uniform(-6, 6, 20), 10), [0.0]
    for u in rudder[:-1]:
        rate.append(rate[-1] + 0.05 * (0.02 * u - 0.9 * rate[-1]))
    write_csv(tmp_path / "run.csv", rudder=rudder, rate=np.array(rate))
    spec = tmp_path / "spec.toml"
    (text,) = said(spec, TURN)
    assert "'rudder' is in deg, and N_d times it, N_d in 1/s2" in text
    assert "`scale = 0.0174533`" in text
    assert said(spec, TURN.replace('{ unit = "deg" }', '{ unit = "rad", scale = 0.0174533 }')) == []
    assert said(spec, TURN.replace("1/s2", "rad/(s2 deg)")) == []
    assert said(spec, TURN.replace(', unit = "1/s2"', "")) == []  # never guessed
    assert said(spec, TURN.replace("N_d*rudder", "N_d*0.0174533*rudder")) == []
    assert said(spec, TURN.replace("N_d*rudder", "N_d*(rudder + 1)")) == [text]
