"""Integrators: one from outside is a class, and everything that a motion has goes with it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from test_cli import finite_json, run

import orthaug as oa
from orthaug.analysis.input_timing import rows_of_trials
from orthaug.physics.integrators import INTEGRATORS, Integrator

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")

STEP = 0.05  # s

SPEC = """
[data]
sampling_time = 0.05
inputs = ["force"]
outputs = ["x"]
train = {{ files = ["a.csv"] }}
tests.other = {{ files = ["b.csv"], skip = 5 }}
[motion]
integrator = "{integrator}"
{more}
[motion.states]
x = {{ derivative = "v", start = "x" }}
v = {{ derivative = "(force - c*v - k*x)/m", start = 0 }}
[motion.outputs]
x = "x"
[motion.parameters]
m = {{ initial = 1.2 }}
c = {{ initial = 0.8 }}
k = {{ initial = 8.0 }}
[training]
segment = 0
[validation]
blocks = 0
"""


@dataclass(frozen=True)
class SemiImplicitEuler(Integrator):
    """Each state goes on by the rate at the states after it, which have gone on already."""

    def step(self, field, h, scheme=None):
        def one(x, first, middle, last):
            for i in reversed(range(len(x))):
                unit = np.eye(len(x))[i]
                x = x + h * field(x, first) * unit
            return x

        return one


@dataclass(frozen=True)
class DormandPrince(Integrator):
    """The solution of order 5 of Dormand and Prince (1980), with fixed steps; inputs are held."""

    widest_angle = 0.6

    TABLEAU = (
        (),
        (1 / 5,),
        (3 / 40, 9 / 40),
        (44 / 45, -56 / 15, 32 / 9),
        (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
        (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    )
    WEIGHTS = (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84)

    def step(self, field, h, scheme=None):
        def one(x, first, middle, last):
            slopes = []
            for row in self.TABLEAU:
                at = sum((h * a * k for a, k in zip(row, slopes, strict=True)), x)
                slopes.append(field(at, first))
            return sum((h * b * k for b, k in zip(self.WEIGHTS, slopes, strict=True)), x)

        return one


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """The folder of two records of a mass on a spring, under a held force, exact."""
    monkeypatch.chdir(tmp_path)
    from scipy.linalg import expm

    a = np.array([[0, 1, 0], [-9, -1, 1], [0, 0, 0]]) * STEP
    following = expm(a)
    for name, seed in (("a", 1), ("b", 2)):
        force = np.repeat(5 * np.random.default_rng(seed).uniform(-1, 1, 10), 10)
        x, v, found = 0.0, 0.0, []
        for u in force:
            found.append(x)
            x, v, _ = following @ [x, v, u]
        pd.DataFrame({"force": force, "x": found}).to_csv(f"{name}.csv", index=False)
    return tmp_path


def estimated(integrator: str, substeps: int) -> np.ndarray:
    """Return the parameters of a fit with an integrator."""
    motion = oa.Motion.from_equations(
        states=[oa.State("x", "v", start="x"), oa.State("v", "(force - c*v - k*x)/m", start=0)],
        outputs=[oa.Output("x", "x")],
        inputs=["force"],
        parameters=[oa.PhysicalParameter(*pair) for pair in (("m", 1.2), ("c", 0.8), ("k", 8.0))],
        integrator=integrator,
        substeps=substeps,
    )
    table = pd.read_csv("a.csv")
    record = oa.Record.from_arrays(
        u=table["force"].to_numpy(),
        y=table["x"].to_numpy(),
        sampling_time=STEP,
        inputs=["force"],
        outputs=["x"],
    )
    return oa.estimate(record, motion, learner=None, criterion=oa.Simulation(segment=0)).values


def test_one_from_outside_has_all_that_a_motion_has(folder):
    """Check, fit, intervals, report, saved model, free run and step; code in C is refused."""
    with INTEGRATORS.with_kind("semi-implicit-euler", SemiImplicitEuler):
        spec = SPEC.format(integrator="semi-implicit-euler", more="substeps = 4")
        Path("spec.toml").write_text(spec)
        assert run("check", "spec.toml", "--json").code == 0
        done = run("fit", "spec.toml", "--out", "out", "--json")
        assert done.code == 0, done.err
        result = finite_json(done.out)
        assert result["motion"]["integrator"] == "semi-implicit-euler"
        assert [row["name"] for row in result["parameters"]] == ["m", "c", "k"]
        assert Path("out/report.html").exists()
        assert run("simulate", "out", "b.csv").code == 0
        model = oa.load("out")
        step = oa.numpy_step(model)
        state, inputs = np.array([0.1, -0.2]), np.array([1.5])
        np.testing.assert_allclose(step(state, inputs)[0], model.step(state, inputs)[0], rtol=1e-12)
        done = run("export", "out", "--to", "c", "--out", "c")
        assert done.code == 2 and "cannot be written as code" in done.err
        assert not Path("c").exists()
    done = run("simulate", "out", "b.csv")
    assert done.code == 2 and "semi-implicit-euler" in done.err and "Traceback" not in done.err


def test_each_errs_as_its_order_says(folder):
    """Beside the matrix exponential, which is exact here: half of the step, half of the error of order 1."""
    true = np.array([1.0, 1.0, 9.0])
    np.testing.assert_allclose(estimated("exact", 1), true, rtol=1e-6)
    with INTEGRATORS.with_kind("semi-implicit-euler", SemiImplicitEuler):
        errors = [np.abs(estimated("semi-implicit-euler", n) - true) for n in (6, 12)]
    np.testing.assert_allclose(errors[0] / errors[1], 2.0, rtol=0.2)
    with INTEGRATORS.with_kind("dormand-prince", DormandPrince):
        np.testing.assert_allclose(estimated("dormand-prince", 2), true, rtol=1e-6)


def test_an_unknown_one_is_refused_with_those_that_are_known(folder):
    Path("spec.toml").write_text(SPEC.format(integrator="semi-implicit-euler", more=""))
    done = run("check", "spec.toml")
    assert done.code == 2
    assert all(name in done.err for name in ("motion.integrator", "rk4", "exact", "discrete"))


MOTOR = """
[data]
sampling_time = 0.005
inputs = ["voltage"]
outputs = ["speed"]
train = {{ files = ["motor.csv"] }}
[motion]
{chosen}
[motion.states]
current = {{ derivative = "(voltage - R*current - K*speed)/0.0006", start = 0 }}
speed = {{ derivative = "(K*current - b*speed - {friction})/0.0002", start = "speed" }}
[motion.outputs]
speed = "speed"
[motion.parameters]
R = {{ initial = 1.0, min = 0 }}
K = {{ initial = 0.04, min = 0 }}
b = {{ initial = 2e-4, min = 0 }}
[training]
segment = 0
[validation]
blocks = 0
"""


@pytest.fixture
def motor(tmp_path, monkeypatch):
    """A motor whose current settles in half a millisecond, sampled every five."""
    from scipy.linalg import expm

    rng = np.random.default_rng(3)
    voltage = np.repeat(rng.uniform(-12, 12, 60), 10)
    rates = np.array(
        [[-1.2 / 6e-4, -0.05 / 6e-4, 1 / 6e-4], [0.05 / 2e-4, -1e-4 / 2e-4, 0], [0] * 3]
    )
    step, state, speeds = expm(0.005 * rates), np.zeros(3), []
    for state[2] in voltage:
        speeds.append(state[1])
        state = step @ state
    noisy = np.array(speeds) + 0.2 * rng.standard_normal(len(speeds))
    pd.DataFrame({"voltage": voltage, "speed": noisy}).to_csv(tmp_path / "motor.csv", index=False)
    monkeypatch.chdir(tmp_path)

    def write(chosen="", friction="0"):
        (tmp_path / "spec.toml").write_text(MOTOR.format(chosen=chosen, friction=friction))
        return tmp_path / "spec.toml"

    return write


@pytest.mark.parametrize(
    ("chosen", "friction", "expected"),
    [
        ("", "0", "exact"),
        ('integrator = "rk4"', "0", "rk4"),
        ("substeps = 64", "0", "rk4"),
        ("", "0.5*tanh(speed)", "rk4"),  # at most speeds the stiff part is not that at the origin
    ],
)
def test_a_linear_part_that_is_stiff_goes_by_its_exponential(motor, chosen, friction, expected):
    """The integrator that the data choose; 24 substeps of Runge-Kutta where that is declared."""
    problem = oa.load_spec(motor(chosen, friction)).problem
    assert problem.motion.integrator == expected
    if not friction.startswith("0.5") and "64" not in chosen:
        assert problem.substeps == (1 if expected == "exact" else 24)


def test_a_stiff_motor_is_fitted_and_the_remedy_of_many_substeps_is_right(motor):
    done = run("fit", str(motor()), "--out", "exact")
    assert done.code == 0, done.err
    result = finite_json((Path("exact") / "result.json").read_text())
    assert result["motion"]["integrator"] == "exact"
    for one, truth in zip(result["parameters"], (1.2, 0.05, 1e-4), strict=True):
        low, high = one["ci95"]
        assert low < truth < high and high - low < 1.5 * truth, one
    text = '`integrator = "exact"` needs far fewer.'
    done = run("check", str(motor('integrator = "rk4"')), "--json")
    assert text in warning_of("stiff", done)
    assert done.err.startswith("note: about 24 substeps in a sample make every run slow")
    assert "equilibrium" in warning_of(
        "stiff", run("check", str(motor(friction="0.5*tanh(speed)")), "--json")
    )


@pytest.mark.parametrize(
    ("chosen", "rows"), [("", 600), ("substeps = 70", 571), ("substeps = 99", 500)]
)
def test_where_a_sample_takes_many_substeps_fewer_rows_are_tried(motor, chosen, rows):
    assert rows_of_trials(oa.load_spec(motor(chosen)).problem) == rows


def warning_of(code, done):
    assert done.code == 0, done.err
    return next(one["text"] for one in json.loads(done.out)["warnings"] if one["code"] == code)
