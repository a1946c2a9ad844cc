"""An unstable plant under a controller that the spec does not have: free runs are cut short."""

from __future__ import annotations

import json

import numpy as np
import pytest
from test_cli import run

import orthaug as oa

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")

STEP = 0.01


SPEC = f"""
[data]
sampling_time = {STEP}
inputs = ["u"]
outputs = ["y"]
train = {{ files = ["run.csv"], rows = [0, 900] }}
tests.last = {{ files = ["run.csv"], rows = [900, 1200] }}
[motion.states]
angle = {{ derivative = "speed", start = "y" }}
speed = {{ derivative = "g*sin(angle) - d*speed + b*u", start = "derivative of y" }}
[motion.outputs]
y = "angle"
[motion.parameters]
g = {{ initial = 15, min = 0 }}
d = {{ initial = 1, min = 0 }}
b = {{ initial = 2, min = 0 }}
"""


def balanced(rows: int = 1200, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """A rod held upright: φ'' = 30 sin φ − 0.5 φ' + 4 u under feedback of angle and speed."""
    random = np.random.default_rng(seed)
    reference = np.repeat(random.uniform(-0.3, 0.3, rows // 60 + 1), 60)[:rows]
    state, inputs, outputs = np.zeros(2), [], []

    def rates(x: np.ndarray, u: float) -> np.ndarray:
        return np.array([x[1], 30 * np.sin(x[0]) - 0.5 * x[1] + 4 * u])

    for aim in reference:
        u = -30 * (state[0] - aim) - 4 * state[1] + 5 * random.normal()
        inputs.append(u)
        outputs.append(state[0])
        for _ in range(4):
            h = STEP / 4
            a = rates(state, u)
            b = rates(state + h / 2 * a, u)
            state = state + h * b
    return np.array(inputs), np.array(outputs) + 1e-3 * random.normal(size=rows)


def rod(**parameters: float) -> oa.Motion:
    given = {"g": 15.0, "d": 1.0, "b": 2.0} | parameters
    return oa.Motion.from_equations(
        [
            oa.State("angle", "speed", start="y"),
            oa.State("speed", "g*sin(angle) - d*speed + b*u", start="derivative of y"),
        ],
        [oa.Output("y", "angle")],
        [oa.PhysicalParameter(name, value, min=0) for name, value in given.items()],
        ["u"],
        hold="zero-order",
    )


@pytest.fixture(scope="module")
def fit():
    u, y = balanced()
    return oa.estimate(oa.Record.from_arrays(u, y, sampling_time=STEP), rod(), learner=None)


def test_its_parameters_are_found_from_values_of_half_their_size(fit):
    assert 8 <= fit.criterion.segment < 200
    true = np.array([30, 0.5, 4])
    assert np.all(
        np.abs(np.asarray(fit.problem.values_at(np.asarray(fit.theta))) / true - 1)
        < [0.05, 0.5, 0.05]
    )


def test_what_is_said_of_it_is_of_its_segments(fit):
    found = fit.diagnose()
    said = {warning.code: warning.text for warning in found.warnings}
    assert "twenty-fold" in said["unstable_plant"] and "`controller`" in said["unstable_plant"]
    unsaid = {"free_run_diverges", "growing_mode", "explains_nothing", "unexplained", "drift"}
    assert not unsaid & said.keys()
    assert "remains bounded" not in found.stability.text
    for row, true in zip(found.parameters, (30, 0.5, 4), strict=True):
        low, high = row.ci95
        assert low < true < high


def test_the_page_does_not_judge_it_by_free_runs_of_the_record(tmp_path):
    np.savetxt(
        tmp_path / "run.csv", np.column_stack(balanced()), delimiter=",", header="u,y", comments=""
    )
    (tmp_path / "spec.toml").write_text(SPEC)
    oa.fit_spec(tmp_path / "spec.toml", out=tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "the plant is unstable, so that no free run follows a whole record" in page
    assert "Do not use the model" not in page and "Use it to predict the next sample" in page


@pytest.mark.slow
def test_a_stable_plant_and_one_that_is_given_its_segments_are_left(fit):
    u, y = balanced()
    record = oa.Record.from_arrays(u, y, sampling_time=STEP)
    whole = oa.Simulation(segment=300, washout=0)
    assert oa.estimate(record, rod(), learner=None, criterion=whole).criterion.segment == 300
    hanging = oa.Motion.from_equations(
        [
            oa.State("angle", "speed", start="y"),
            oa.State("speed", "b*u - g*sin(angle) - d*speed", start="derivative of y"),
        ],
        [oa.Output("y", "angle")],
        [oa.PhysicalParameter(name, 4.0, min=0) for name in "gdb"],
        ["u"],
    )
    assert oa.estimate(record, hanging, learner=None).criterion.segment in (0, 512)


def test_check_fits_physics_to_runs_that_the_plant_can_follow(tmp_path):
    np.savetxt(
        tmp_path / "run.csv", np.column_stack(balanced()), delimiter=",", header="u,y", comments=""
    )
    (tmp_path / "spec.toml").write_text(SPEC)
    done = run("check", tmp_path / "spec.toml", "--json")
    found = json.loads(done.out)
    said = {warning["code"]: warning["text"] for warning in found["warnings"]}
    assert "twenty-fold" in said["unstable_plant"] and "other_start" not in said
    errors = [trial["residual"] for trial in found["motion"]["holds"]]
    assert 0 < min(errors) < 0.1
