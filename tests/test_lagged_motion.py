"""Lagged physics as the discrete motion of its lags, for a learner with states."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from test_cli import run

import orthaug as oa
from orthaug.commands.opening import open_job
from orthaug.commands.spec import load_spec
from orthaug.data.regressors import Lags
from orthaug.fitting.estimation import fit as fit_problem
from orthaug.physics.lags_as_states import motion_of_lags
from orthaug.physics.parameters import PhysicalParameter, PhysicsMap
from orthaug.physics.problem import pose

PLANT = oa.Baseline.from_terms(
    [oa.Term("a1", "y[k-1]"), oa.Term("a2", "y[k-2]"), oa.Term("b", "u[k-1]", min=0)]
)
SPEC = """
[data]
sampling_time = 0.1
inputs = ["u"]
outputs = ["y"]
train = {files = ["run.csv"]}

[lags]
na = 2
nb = 2

[[baseline.terms]]
parameter = "a1"
regressor = "y[k-1]"
[[baseline.terms]]
parameter = "a2"
regressor = "y[k-2]"
[[baseline.terms]]
parameter = "b"
regressor = "gain*u[k-1]"
[baseline.constants]
gain = 2.0

[learner]
hidden = [4]
states = 1

[[suspects]]
kind = "coulomb"
on = "y[k-1]-y[k-2]"
output = "y"
"""


def plant(rows: int = 500, seed: int = 0) -> oa.Record:
    """Return a second-order plant with a brake that follows its speed with a lag of 20 samples."""
    rng = np.random.default_rng(seed)
    u, y, brake = np.repeat(rng.uniform(-1, 1, rows // 5), 5), np.zeros(rows), 0.0
    for k in range(2, rows):
        brake += 0.05 * (4 * (y[k - 1] - y[k - 2]) - brake)
        y[k] = 1.6 * y[k - 1] - 0.7 * y[k - 2] + 0.2 * u[k - 1] - 0.3 * np.tanh(brake)
    y = y + 0.003 * rng.standard_normal(rows)
    return oa.Record.from_arrays(u=u, y=y, sampling_time=0.1)


def write_run(folder: Path, rows: int, *, present: bool = False) -> None:
    """Write `run.csv` of the plant; with `present` the input acts on the row that it is in."""
    (experiment,) = plant(rows).experiments
    u, y = experiment.inputs[:, 0], experiment.outputs[:, 0]
    pairs = zip(u[:-1], y[1:], strict=True) if present else zip(u, y, strict=True)
    (folder / "run.csv").write_text("u,y\n" + "".join(f"{u},{y}\n" for u, y in pairs))


def test_states_are_the_lags():
    terms = [
        *PLANT.terms,
        oa.Term("d", "u[k-3]*abs(y[k-2])"),
        oa.Term("known", "1.0", 0.5, fixed=True),
    ]
    found = motion_of_lags(oa.Baseline.from_terms(terms), Lags(1, 1, 2), None, ["y"], ["u"])
    states = {state.name: (state.derivative, state.start) for state in found.motion.states}
    assert states == {
        "y": ("a1*y + a2*y_1 + b*u + d*(u_2 * abs(y_1)) + 0.5*(1.0)", "y"),
        "y_1": ("y", "y"),
        "u_1": ("u", None),
        "u_2": ("u_1", None),
    }
    assert [state.name for state in found.motion.states if state.learned] == ["y"]
    assert found.motion.parameters[2].min == 0 and found.learner_inputs == ("y", "u_1")
    assert found.named("y[k-2] - u[k-2]") == "y_1 - u_1"


def test_a_state_takes_no_name_that_is_there():
    baseline = oa.Baseline.from_terms([oa.Term("y_1", "y[k-1]"), oa.Term("c", "y[k-2]")])
    found = motion_of_lags(baseline, None, None, ["y"], [])
    assert found.motion.names_of_states == ("y", "y_1_") and found.motion.names == ("y_1", "c")


def test_physical_parameters_stay_parameters_and_theta_becomes_definitions():
    mass = PhysicalParameter("m", 2.0, "kg", min=0)
    physics = PhysicsMap.of([mass], {"g": "Ts/m"}, {"Ts": 0.1})
    baseline = oa.Baseline.from_terms([oa.Term("g", "u[k-1]")])
    motion = motion_of_lags(baseline, None, None, ["y"], ["u"], physics=physics).motion
    assert motion.parameters == (mass,)
    assert [(name, str(text)) for name, text in motion.definitions] == [("g", "Ts/m")]


def test_theta_that_is_a_physical_parameter_itself_is_no_definition():
    own = [PhysicalParameter("a", 0.5), PhysicalParameter("m", 2.0, min=0)]
    physics = PhysicsMap.of(own, {"a": "a", "m_": "a/m"}, {})
    baseline = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("m_", "u[k-1]")])
    motion = motion_of_lags(baseline, None, None, ["y"], ["u"], physics=physics).motion
    assert motion.names == ("a", "m") and [name for name, _ in motion.definitions] == ["m_"]
    with pytest.raises(oa.InputError, match="gives no 'a'"):
        wrong = PhysicsMap.of(own[1:], {"m_": "1/m"}, {})
        motion_of_lags(baseline, None, None, ["y"], ["u"], physics=wrong)


def test_two_outputs_have_terms_of_their_own():
    terms = [oa.Term("a", "y1[k-1]", output="y1"), oa.Term("b", "y1[k-1]", output="y2")]
    found = motion_of_lags(oa.Baseline.from_terms(terms), None, None, ["y1", "y2"], [])
    assert [state.derivative for state in found.motion.states] == ["a*y1", "b*y1"]
    unnamed = oa.Baseline.from_terms([oa.Term("a", "y1[k-1]"), *terms[1:]])
    with pytest.raises(oa.InputError, match="`output` is missing"):
        motion_of_lags(unnamed, None, None, ["y1", "y2"], [])


def test_many_terms_are_a_sum_of_sums():
    terms = [oa.Term(f"parameter_{i}", f"sin({i + 1}*y[k-1])*u[k-1]") for i in range(30)]
    motion = motion_of_lags(oa.Baseline.from_terms(terms), None, None, ["y"], ["u"]).motion
    assert motion.states[0].derivative.startswith("y_part1 + y_part2")
    assert motion.names == tuple(term.parameter for term in terms)


def test_what_a_motion_cannot_be_is_refused_in_words():
    deep = oa.Baseline.from_terms([oa.Term("b", "u[k-3000]")])
    with pytest.raises(oa.InputError, match="at most 64 are possible"):
        motion_of_lags(deep, None, None, ["y"], ["u"])
    clash = oa.Baseline.from_terms([oa.Term("u", "u[k-1]")])
    with pytest.raises(oa.InputError, match="is written as a motion"):
        motion_of_lags(clash, None, None, ["y"], ["u"])


def test_its_free_run_is_that_of_the_lagged_model():
    record = plant()
    lagged = oa.estimate(record, PLANT, learner=None, criterion="simulation")
    motion = motion_of_lags(PLANT, None, None, ["y"], ["u"]).motion
    fit = oa.estimate(record, motion, learner=None)
    assert fit.values == pytest.approx(lagged.values, abs=0.3 * lagged.std.min())


def test_present_samples_and_functions_are_refused():
    present = oa.Baseline.from_terms([oa.Term("b", "u[k]")])
    with pytest.raises(oa.InputError, match=r"u\[k\] is a present one. Advance the input"):
        oa.estimate(plant(), present, learner=oa.MLP((4,), states=1))
    function = oa.Baseline.from_function(lambda x: x, ["a"])
    with pytest.raises(oa.InputError, match="is no motion"):
        motion_of_lags(function, Lags(1, 1), None, ["y"], ["u"])


def test_a_problem_of_lagged_physics_is_refused():
    problem = pose(plant(), PLANT)
    with pytest.raises(oa.InputError, match="posed with lagged physics"):
        fit_problem(problem, learner=oa.MLP((4,), states=1))


def test_a_spec_with_a_learner_that_remembers_is_one_of_a_motion(tmp_path):
    write_run(tmp_path, 60)
    path = tmp_path / "spec.toml"
    path.write_text(SPEC)
    spec = load_spec(path)
    assert spec.baseline is None and spec.lags is None
    assert spec.learner_inputs() == ("y", "y_1", "u", "u_1")
    assert spec.suspects[0].on == "y - y_1" and spec.suspects[0].equation == "y"
    assert spec.declared_motion().states[0].derivative == "a1*y + a2*y_1 + b*(gain * u)"
    assert spec.moved_lags
    path.write_text(SPEC.replace("hidden = [4]", 'kind = "none"'))
    assert load_spec(path).motion is None  # keys of another kind have no effect
    path.write_text(SPEC.replace('output = "y"', 'output = "y"\nequation = "y"'))
    done = run("check", path)
    assert done.code == 2 and "suspects[0].equation" in " ".join(done.err.split())
    path.write_text(SPEC.replace("[[suspects]]", "[suspects]"))
    done = run("check", path)
    assert done.code == 2 and "'suspects'" in " ".join(done.err.split())
    path.write_text(SPEC.replace("u[k-1]", "u[k]"))
    spec = load_spec(path)
    assert spec.declared_motion().states[0].derivative == "a1*y + a2*y_1 + b*(gain * u)"
    assert spec.learner_inputs() == ("y", "y_1", "u_1", "u_2")
    (step,) = spec.data.prepare
    assert (step.step, step.channel, step.samples) == ("shift", "u", -1)
    path.write_text(SPEC.replace('y[k-2]"\n[[', 'z[k-2]"\n[['))
    done = run("check", path)
    assert done.code == 2 and "unknown channel 'z'" in " ".join(done.err.split())


def test_a_brake_that_lags_is_learned_to_the_noise():
    record = plant()
    learner = oa.MLP((6,), inputs=("y[k-1] - y[k-2]",), states=1)
    fit = oa.estimate(record, PLANT, learner=learner)
    (run_,) = fit.simulate(plant(seed=1)).trajectories
    assert np.sqrt(np.mean(run_.errors**2)) < 1.5 * 0.003
    assert abs(fit.values[2] - 0.2) < 4 * fit.std[2]


@pytest.mark.parametrize("present", [False, True])
def test_a_learner_that_remembers_is_the_first_advice_where_a_state_is_missing(tmp_path, present):
    write_run(tmp_path, 900, present=present)
    path, spec = tmp_path / "spec.toml", SPEC.replace("states = 1\n", "")
    spec = spec.replace("u[k-1]", "u[k]").replace("nb = 2", "nb = 2\nnk = 0") if present else spec
    path.write_text(spec)
    done = run("fit", path, "--out", tmp_path / "result")
    assert done.code == 0
    result = json.loads((tmp_path / "result" / "result.json").read_text())
    best = result["advice"][0]
    assert best["change"] == {"learner.states": 1}
    assert best["after"] < 0.3 * best["before"]
    assert "hidden_state" in {warning["code"] for warning in result["warnings"]}


def test_a_term_is_added_to_the_state_where_an_output_has_its_name(tmp_path):
    write_run(tmp_path, 60)
    path = tmp_path / "spec.toml"
    path.write_text(SPEC)
    job = open_job(path)
    change, where = job.physics.with_term(job, "s", "y*abs(y)", "y", 0.0)
    assert where == "in the equation of y"
    assert change["motion.states.y.next"].endswith("+ s*(y*abs(y))")
    # A state of the learner is none of the physics
    assert job.physics.with_term(job, "s", "atan(z1/2)", "y", 0.0) is None
