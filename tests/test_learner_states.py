"""A learner with states of its own follows what the physics has forgotten to remember."""

from __future__ import annotations

import json

import numpy as np
import pytest
from test_cli import run

import orthaug as oa

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")

STEP, ROWS, TRAIN = 0.02, 2400, 1600
TRUE = {"m": 1.0, "k": 4.0}


def maxwell(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return force and position of a mass on a spring and a Maxwell element (h, 0.25 s)."""
    rng = np.random.default_rng(seed)
    spectrum = np.fft.rfft(rng.standard_normal(ROWS))
    spectrum[np.fft.rfftfreq(ROWS, STEP) > 2.5] = 0
    force = np.fft.irfft(spectrum, ROWS)
    force *= 2 / force.std()
    a = np.array([[0, 1, 0], [-4.0, -0.6, -1.0], [0, 6.0, -4.0]])
    whole = np.zeros((4, 4))
    whole[:3, :3], whole[1, 3] = a, 1.0
    values, vectors = np.linalg.eig(whole * STEP)
    exact = (vectors * np.exp(values)) @ np.linalg.inv(vectors)
    state, position = np.zeros(4), np.zeros(ROWS)
    for i in range(ROWS):
        position[i], state[3] = state[0], force[i]
        state = (exact @ state).real
    return force, position


def spring(integrator: str = "rk4") -> oa.Motion:
    parameters = [
        oa.PhysicalParameter("m", 1.2, "kg", min=0),
        oa.PhysicalParameter("c", 0.5, "N s/m", min=0),
        oa.PhysicalParameter("k", 3.5, "N/m", min=0),
    ]
    rates = ["v", "(force - c*v - k*x)/m"]
    if integrator == "discrete":
        rates = [f"x + {STEP}*v", f"v + {STEP}*({rates[1]})"]
    states = [
        oa.State("x", rates[0], "position"),
        oa.State("v", rates[1], "derivative of position", learned=True),
    ]
    output = [oa.Output("position", "x")]
    return oa.Motion.from_equations(states, output, parameters, ["force"], integrator=integrator)


def record(force: np.ndarray, position: np.ndarray) -> oa.Record:
    channels = {"inputs": ["force"], "outputs": ["position"]}
    return oa.Record.from_arrays(force, position, sampling_time=STEP, **channels)


@pytest.fixture(scope="module")
def measured() -> tuple[oa.Record, oa.Record]:
    force, position = maxwell(1)
    noise = 0.01 * position.std() * np.random.default_rng(7).standard_normal(ROWS)
    whole = position + noise
    return record(force[:TRAIN], whole[:TRAIN]), record(force[TRAIN:], whole[TRAIN:])


@pytest.fixture(scope="module")
def fit(measured) -> oa.MotionEstimate:
    return oa.estimate(measured[0], spring(), learner=oa.MLP((6,), inputs=("v",), states=1))


def error(model, other: oa.Record) -> float:
    (run,) = model.simulate(other).trajectories
    return float(np.sqrt(np.mean(run.errors**2)) / other.experiments[0].outputs.std())


def test_its_parameters_hold_where_those_of_physics_alone_do_not(fit):
    table, alone = fit.parameters, fit.physics_alone.parameters
    assert fit.learns and fit.problem.motion.memory == ("z1",)
    for name, true in TRUE.items():
        row = table.loc[name]
        assert abs(row["value"] - true) < 4 * row["std"] < 0.02 * true
        other = alone.loc[name]
        assert abs(other["value"] - true) > 3 * other["std"]  # robust: its errors are coloured


def test_its_free_run_is_as_good_as_that_of_the_true_equations(fit, measured):
    written = spring()
    states = [
        *(oa.State(s.name, s.derivative, s.start) for s in written.states),
        oa.State("h", "(g*v - h)/tau", 0.0),
    ]
    states[1] = oa.State("v", "(force - c*v - k*x - h)/m", "derivative of position")
    parameters = [
        *written.parameters,
        oa.PhysicalParameter("g", 1.0, min=0),
        oa.PhysicalParameter("tau", 0.4, "s", min=0),
    ]
    true = oa.Motion.from_equations(states, written.outputs, parameters, ["force"])
    best = oa.estimate(measured[0], true, learner=None)
    assert error(fit.model, measured[1]) < 1.2 * error(best.model, measured[1])
    assert error(fit.physics_alone.model, measured[1]) > 4 * error(fit.model, measured[1])


def test_physics_alone_has_no_state_of_the_learner(fit, measured):
    alone = fit.physics_alone
    assert alone.model.state_names == ("x", "v")
    plain = oa.estimate(measured[0], spring(), learner=None)
    np.testing.assert_allclose(alone.values, plain.values, rtol=1e-5)
    assert alone.std_kind == plain.std_kind == "batch-means"
    np.testing.assert_allclose(alone.std, plain.std, rtol=1e-3)


def test_the_linear_view_and_explain_show_what_it_remembers(fit, measured):
    (view,) = oa.linearize(fit.model, "force = 0")
    assert len(view.poles) == 3
    true = np.linalg.eigvals(np.array([[0, 1, 0], [-4.0, -0.6, -1.0], [0, 6.0, -4.0]]))
    found = np.log(np.array([pole.z for pole in view.poles], dtype=complex)) / STEP
    for pole in true:
        assert np.abs(found - pole).min() < 0.1 * abs(pole)


def test_a_saved_model_runs_alike(fit, measured, tmp_path):
    oa.save(fit.model, tmp_path / "model")
    again = oa.load(tmp_path / "model")
    assert again.form.bound.learner == fit.model.form.bound.learner
    for one, other in zip(
        fit.model.simulate(measured[1]).trajectories,
        again.simulate(measured[1]).trajectories,
        strict=True,
    ):
        np.testing.assert_array_equal(one.model, other.model)


def test_a_step_without_jax_runs_alike(fit, measured, tmp_path):
    (run,) = fit.model.simulate(measured[1]).trajectories
    step, state = oa.numpy_step(fit.model), fit.model.start(measured[1])
    found = []
    for row in measured[1].experiments[0].inputs[:200]:
        state, y = step(state, row)
        found.append(y)
    np.testing.assert_allclose(found, run.model[:200], rtol=1e-9, atol=1e-12)
    oa.export(fit.model, tmp_path / "code", "c")
    assert (tmp_path / "code" / "model.c").is_file()


def test_a_free_run_far_beyond_the_data_stays_bounded(fit, measured):
    force = measured[1].experiments[0].inputs[:, 0]
    wild = oa.Record.from_arrays(1000 * force, sampling_time=STEP, inputs=["force"])
    (run,) = fit.model.simulate(wild, initial="zero").trajectories
    assert not run.diverged and np.isfinite(run.model).all()


def test_a_discrete_motion_remembers_too(measured):
    learner = oa.MLP((6,), inputs=("v",), states=1, time_constants=(0.3,))
    found = oa.estimate(measured[0], spring("discrete"), learner=learner)
    assert found.learns and error(found.model, measured[1]) < 0.02
    assert found.problem.motion.states[-1].derivative == "z1 + 0.064493*(v - z1)"


def test_names_that_are_taken_are_left_alone(measured):
    motion = spring()
    states = [oa.State("z1", "v", "position"), *motion.states[1:]]
    states[1] = oa.State("v", "(force - c*v - k*z1)/m", "derivative of position", learned=True)
    other = oa.Motion.from_equations(
        states, [oa.Output("position", "z1")], motion.parameters, ["force"]
    )
    posed = oa.estimate(
        measured[0],
        other,
        learner=oa.MLP((2,), inputs=("v",), states=2),
        solver=oa.LevenbergMarquardt(iterations=2),
        blocks=0,
    )
    assert posed.problem.motion.memory == ("learner_z1", "learner_z2")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"states": -1}, "`states`"),
        ({"states": 9}, "`states` must be 8 or less"),
        ({"states": 2, "time_constants": (1.0,)}, "one positive number in s for each"),
        ({"states": 1, "time_constants": (-1.0,)}, "one positive number in s for each"),
        ({"states": 1, "time_constants": 3.0}, "one positive number in s for each"),
        ({"time_constants": (1.0,)}, "Set `states`"),
    ],
)
def test_wrong_options_are_refused(options, words):
    with pytest.raises(oa.InputError, match=words):
        oa.MLP((4,), **options)


def test_functions_are_refused_with_a_remedy(measured):
    motion = oa.Motion.from_functions(
        lambda x, u, p: (u - p[0] * x) / 1.0,
        lambda x, u, p: x,
        [oa.State("position_", start="position", learned=True)],
        ["position"],
        [oa.PhysicalParameter("k", 1.0)],
        ["force"],
    )
    with pytest.raises(oa.InputError, match="Python functions"):
        oa.estimate(measured[0], motion, learner=oa.MLP((4,), states=1))


SPEC = """
[data]
sampling_time = 0.02
inputs = ["force"]
outputs = ["position"]
train = { files = ["run.csv"], rows = [0, 800] }
[motion.states]
x = { derivative = "v", start = "position" }
v = { derivative = "(force - c*v - k*x)/m", learned = true }
[motion.outputs]
position = "x"
[motion.parameters]
m = { initial = 1.2, unit = "kg", min = 0 }
c = { initial = 0.5, min = 0 }
k = { initial = 3.5, unit = "N/m", min = 0 }
[learner]
hidden = [4]
inputs = ["v"]
states = 1
time_constants = [0.3]
[training]
iterations = 40
[validation]
blocks = 0
"""


@pytest.fixture
def project(tmp_path, monkeypatch, measured):
    monkeypatch.chdir(tmp_path)
    part = measured[0].experiments[0]
    rows = np.column_stack([part.inputs, part.outputs])
    np.savetxt("run.csv", rows, delimiter=",", header="force,position", comments="")
    (tmp_path / "spec.toml").write_text(SPEC)
    return tmp_path


def test_a_spec_declares_states_of_a_learner(project):
    done = run("fit", "spec.toml", "--out", "out")
    assert done.code == 0, done.err
    result = json.loads((project / "out" / "result.json").read_text())
    assert result["shared"]["inputs"] == ["v", "z1"]
    assert result["spec"]["learner"]["states"] == 1
    done = run("simulate", "out", "run.csv", "--out", "sim.csv")
    assert done.code == 0, done.err


def test_check_says_what_a_state_could_imitate(project):
    text = " ".join(run("check", "spec.toml").out.split())
    assert "The data determine m with any learner of these inputs" in text
    assert "With its own state z1 it could also imitate k, by the past of its inputs" in text
    spec = (project / "spec.toml").read_text().replace('inputs = ["v"]', 'inputs = ["force"]')
    (project / "spec.toml").write_text(spec)
    assert "own state" not in run("check", "spec.toml").out
