"""`focus = "auto"`: one step ahead where its free run holds, the free run where not; physics alone stays beside it."""

import json
from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
from test_cli import run

import orthaug as oa

pytestmark = pytest.mark.usefixtures("without_figures")

PHYSICS = oa.Baseline.from_terms(
    [oa.Term("a1", "y[k-1]"), oa.Term("a2", "y[k-2]"), oa.Term("b", "u[k-1]")]
)
LEARNER = oa.MLP(hidden=(4,))


def signals(rows=500, seed=0, equation=0.0, sensor=0.0, friction=0.02):
    """A second-order plant with dry friction."""
    rng = np.random.default_rng(seed)
    u, y = np.repeat(rng.normal(size=rows // 5), 5), np.zeros(rows)
    for k in range(2, rows):
        v = y[k - 1] - y[k - 2]
        y[k] = 1.6 * y[k - 1] - 0.68 * y[k - 2] + 0.08 * u[k - 1] - friction * np.tanh(v / 0.02)
        y[k] += equation * rng.normal()
    return u, y + sensor * rng.normal(size=rows)


def record(**options) -> oa.Record:
    u, y = signals(**options)
    return oa.Record.from_arrays(u=u, y=y)


def free_run_error(model, data) -> float:
    return float(model.simulate(data).scores().nrmse[0])


def test_noise_of_the_equation_changes_nothing():
    data = record(equation=0.003)
    found, one_step = (
        oa.estimate(data, PHYSICS, learner=LEARNER, criterion=c)
        for c in (oa.Auto(), oa.Prediction())
    )
    assert (
        found.focus is not None
        and found.focus.chosen == "prediction"
        and not found.focus.candidates
    )
    np.testing.assert_array_equal(found.theta, one_step.theta)
    np.testing.assert_allclose(found.theta, found.problem.least_squares, rtol=1e-12)
    np.testing.assert_array_equal(found.model.numbers.weights, one_step.model.numbers.weights)


def test_noise_on_the_sensor_asks_for_the_free_run():
    data, test = record(sensor=0.02), record(seed=7)
    found, one_step = (
        oa.estimate(data, PHYSICS, learner=LEARNER, criterion=c)
        for c in (oa.Auto(), oa.Prediction())
    )
    assert found.focus.chosen == "simulation" and len(found.focus.candidates) == 4
    assert (
        "trained one step ahead and, because its residual" in found.focus.text
        and "trained on the free run" in found.focus.text
    )
    assert free_run_error(found.model, test) < 0.7 * free_run_error(one_step.model, test)
    assert not found.physics_alone.learns
    assert free_run_error(found.model, test) < free_run_error(found.physics_alone.model, test)


def test_physics_alone_is_trained_on_the_free_run_too():
    """Linear physics without a learner: output error instead of least squares where the sensor is noisy."""
    data, test = record(sensor=0.05, friction=0.0), record(seed=7, friction=0.0)
    found, one_step = (
        oa.estimate(data, PHYSICS, learner=None, criterion=c) for c in (oa.Auto(), oa.Prediction())
    )
    assert found.focus.chosen == "simulation" and found.physics_alone is None
    assert free_run_error(found.model, test) < 0.5 * free_run_error(one_step.model, test)


def test_a_learner_that_finds_noise_is_left_out():
    """Nothing is missing, and few rows: what a network learns is noise."""
    data = record(rows=120, sensor=0.1, friction=0.0)
    found = oa.estimate(
        data, PHYSICS, learner=oa.MLP(hidden=(24,)), criterion=oa.Auto(), regularization="none"
    )
    assert not found.learns
    assert "physics_alone" in [warning.code for warning in found.warnings]
    errors = {(c.focus, c.learner): c.error for c in found.focus.candidates}
    assert min(errors, key=errors.get)[1] is False


@pytest.mark.parametrize("seed", [0, 4])
def test_why_a_learner_is_left_out_agrees_with_the_errors(seed):
    """Of errors that are nearly the same the simpler model is taken, so a learner's may be less."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(1, 5, 12), 5)
    y = scipy.signal.lfilter([0, 0.4], [1, -0.8], u) + 0.05 * rng.normal(size=60)
    physics = oa.Baseline.from_terms(
        [oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]"), oa.Term("c", "1")]
    )
    data = oa.Record.from_arrays(u, y, sampling_time=1)
    found = oa.estimate(data, physics, learner=LEARNER, criterion=oa.Auto())
    text = dict((w.code, w.text) for w in found.warnings)["physics_alone"]
    least = min(c.error for c in found.focus.candidates if c.learner)
    own = next(
        c.error
        for c in found.focus.candidates
        if (c.focus, c.learner) == (found.focus.chosen, False)
    )
    assert text.startswith("the gain of a learner" if least < own else "no learner is better")
    assert ("is not sure" in text) == (least < own)
    one_step = next(c.error for c in found.focus.candidates if c.focus == "prediction")
    preferred = found.focus.chosen == "simulation" and one_step < own
    assert ("taken unless its error there is clearly larger" in found.focus.text) == preferred


def test_a_learner_that_is_wanted_is_kept():
    """Few rows and noise: physics alone is better where nothing was fitted, and `fallback` says to keep the learner."""
    data = record(rows=120, sensor=0.1, friction=0.0)
    options = {"criterion": oa.Auto(), "regularization": "none", "fallback": False}
    found = oa.estimate(data, PHYSICS, learner=oa.MLP(hidden=(24,)), **options)
    errors = {(c.focus, c.learner): c.error for c in found.focus.candidates}
    assert min(errors, key=errors.get)[1] is False
    assert found.learns and "one_step_only" not in [w.code for w in found.warnings]


def test_a_validation_part_chooses():
    data, validation = record(sensor=0.02), record(seed=3, sensor=0.02)
    found = oa.estimate(data, PHYSICS, learner=LEARNER, criterion=oa.Auto(), validation=validation)
    errors = {(c.focus, c.learner): c.error for c in found.focus.candidates}
    unit = found.problem.deviation
    own = (
        validation.experiments[0].outputs[2:]
        - found.model.simulate(validation).trajectories[0].model[2:]
    )
    key = (found.focus.chosen, found.learns)
    assert errors[key] == pytest.approx(float(np.sqrt(np.mean((own / unit) ** 2))), rel=1e-9)


def test_a_static_model_has_no_free_run():
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, 200)
    data = oa.Record.from_arrays(u=u, y=2 * u + u**2)
    found = oa.estimate(
        data, oa.Baseline.from_terms([oa.Term("g", "u[k]")]), learner=LEARNER, criterion=oa.Auto()
    )
    assert found.focus.chosen == "prediction"


def test_segments_follow_from_the_record():
    short = oa.Simulation().on(record(rows=500), 2)
    assert short.segment == 0  # 512 steps are more than it has
    rows = 6000
    quick, slow = (oa.Record.from_arrays(y=filtered(rows, pole)) for pole in (0.5, 0.97))
    assert oa.Simulation().on(quick, 2).segment == 512
    assert 512 < oa.Simulation().on(slow, 2).segment <= 2000
    assert oa.Simulation(100).on(slow, 2).segment == 100
    with pytest.raises(oa.InputError, match="segment"):
        oa.Simulation(-1)


def filtered(rows, pole):
    rng, y = np.random.default_rng(2), np.zeros(rows)
    for k in range(1, rows):
        y[k] = pole * y[k - 1] + rng.normal()
    return y


SPEC = """
[data]
sampling_time = 0.01
inputs = ["u"]
outputs = ["y"]
train = { files = ["run.csv"] }
[data.tests.last]
files = ["last.csv"]
[[baseline.terms]]
parameter = "a1"
regressor = "y[k-1]"
[[baseline.terms]]
parameter = "a2"
regressor = "y[k-2]"
[[baseline.terms]]
parameter = "b"
regressor = "u[k-1]"
[learner]
hidden = [4]
"""


def write(folder, spec=SPEC, **options):
    for name, seed in (("run", 0), ("last", 1)):
        u, y = signals(seed=seed, **options)
        np.savetxt(
            folder / f"{name}.csv",
            np.column_stack([u, y]),
            delimiter=",",
            header="u,y",
            comments="",
        )
    (folder / "spec.toml").write_text(spec)


def test_both_models_are_kept_and_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path, sensor=0.02)
    done = run("fit", "spec.toml", "--out", "out")
    assert done.code == 0 and "Trained one step ahead and, because" in done.out.replace("\n  ", " ")
    result = json.loads((tmp_path / "out/result.json").read_text())
    assert result["focus"]["chosen"] == "simulation" and len(result["focus"]["candidates"]) == 4
    scores = {}
    for which in ("fitted", "physics"):
        assert (
            run("simulate", "out", "last.csv", "--model", which, "--out", f"{which}.csv").code == 0
        )
        table = np.genfromtxt(f"{which}.csv", delimiter=",", names=True)
        errors = (table["y"] - table["y_model"])[2:]
        scores[which] = float(np.sqrt(np.mean(errors**2)))
    alone = result["physics_alone"]["scores"]["tests.last"]["simulation"]["rmse"][0]
    assert scores["physics"] == pytest.approx(alone, rel=1e-6)
    assert scores["fitted"] == pytest.approx(
        result["scores"]["tests.last"]["simulation"]["rmse"][0], rel=1e-6
    )
    assert run("export", "out", "--to", "numpy", "--out", "code", "--model", "physics").code == 0
    assert run("predict", "out/model", "last.csv", "--model", "physics", "--out", "p.csv").code == 0
    refused = run("simulate", "out", "last.csv", "--model", "other")
    assert refused.code == 2 and "--model" in refused.err
    refused = run("simulate", "out/model-physics", "last.csv", "--model", "physics")
    assert refused.code == 2 and "model-physics" in refused.err


def test_physics_is_there_where_the_learner_was_left_out(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path, SPEC.replace("hidden = [4]", "hidden = [24]") + NOISY.replace('focus = "prediction"\n', ""),
          rows=120, sensor=0.1, friction=0.0)  # fmt: skip
    assert run("fit", "spec.toml", "--out", "out").code == 0
    assert not oa.load(tmp_path / "out").learns
    assert run("simulate", "out", "last.csv", "--model", "physics", "--out", "p.csv").code == 0


def test_one_step_by_hand_is_kept_and_named(tmp_path, monkeypatch):
    """A learner that is fitted to noise one step ahead runs worse than physics alone: the first line says so."""
    monkeypatch.chdir(tmp_path)
    write(
        tmp_path,
        SPEC.replace("hidden = [4]", "hidden = [30]") + NOISY,
        rows=150,
        sensor=0.3,
        friction=0.0,
    )
    done = run("fit", "spec.toml", "--out", "out")
    assert done.code == 0
    result = json.loads((tmp_path / "out/result.json").read_text())
    assert "one_step_only" in [warning["code"] for warning in result["warnings"]]
    assert result["focus"] is None
    assert done.out.startswith("The model is for one-step prediction only")
    page = (tmp_path / "out/report.html").read_text()
    assert "one-step prediction only" in page


NOISY = """
[training]
focus = "prediction"
regularization = "none"
[validation]
blocks = 0
"""


def test_auto_needs_what_can_be_trained_on_the_free_run():
    """The paper's solver trains one step ahead alone."""
    found = oa.estimate(record(), PHYSICS, learner=LEARNER, criterion=oa.Auto(), solver=oa.AdamLBFGS(
        adam_iterations=50, lbfgs_iterations=20))  # fmt: skip
    assert found.focus is None and found.criterion == oa.Prediction()


def test_a_motion_is_trained_on_its_free_run():
    found = replace(oa.Auto(), segment=100)
    assert found.simulation == oa.Simulation(100) and found.free_run is None


def heater(seed=5, rows=1125):
    """Two masses, one of them heated; a sensor of 0.1 K and four lags in the physics."""
    rng = np.random.default_rng(seed)
    u = np.repeat(30.0 * rng.integers(0, 2, size=rows // 25 + 1) * 2, 25)[:rows]
    temperature = np.full((rows, 2), 20.0)
    for k in range(1, rows):
        one, two = temperature[k - 1]
        lost = 0.8 * (one - 20) + 5e-9 * ((one + 273) ** 4 - 293**4)
        flow = 2 * (one - two)
        temperature[k] = (
            one + 5 / 150 * (u[k - 1] - lost - flow),
            two + 5 / 400 * (flow - 0.3 * (two - 20)),
        )
    terms = [oa.Term(f"a{i}", f"y[k-{i}]") for i in range(1, 5)]
    terms += [oa.Term(f"b{i}", f"u[k-{i}]") for i in range(1, 5)]
    return (
        oa.Record.from_arrays(u, temperature[:, 0] + 0.1 * rng.standard_normal(rows)),
        oa.Baseline.from_terms([*terms, oa.Term("offset", "1")]),
    )


def test_lags_that_whiten_sensor_noise_do_not_hide_it():
    """Four lags leave a residual that is nearly white; θ is inconsistent, its free run poor."""
    data, physics = heater()
    found = oa.estimate(data, physics, learner=None, criterion=oa.Auto())
    one_step = oa.estimate(data, physics, learner=None, criterion=oa.Prediction())
    assert found.focus.chosen == "simulation", found.focus.text
    assert "inconsistent" in dict(oa.diagnose(one_step).warnings)
    assert free_run_error(found.model, data) < free_run_error(one_step.model, data) / 4


@pytest.mark.parametrize("seed", range(4))
def test_a_mode_that_no_input_excites_does_not_spoil_a_free_run(seed):
    """With estimated starts it costs nothing; from measured lags the run must be as good."""
    data, physics = heater(seed)
    (one,) = data.experiments
    rows = replace(data, experiments=(one.rows(0, 560), one.rows(845, len(one))))
    one_step, free_run = (
        oa.estimate(rows, physics, learner=None, criterion=c)
        for c in (oa.Prediction(), oa.Simulation())
    )
    assert free_run_error(free_run.model, rows) < free_run_error(one_step.model, rows) / 3


def test_a_free_run_of_few_rows_is_trained_to_its_end():
    """Three hundred iterations do not suffice; there are intervals, and no advice to go on."""
    rng = np.random.default_rng(1)
    u, y = np.repeat(rng.normal(size=160), 5), np.zeros(800)
    for k in range(1, 800):
        y[k] = y[k - 1] + 0.125 * (
            0.5 * u[k - 1] - 0.25 * y[k - 1] - 0.4 * np.tanh(y[k - 1] / 0.05)
        )
    data = oa.Record.from_arrays(u, y + 0.02 * rng.standard_normal(800))
    physics = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]")])
    solver = oa.LevenbergMarquardt(iterations=300)
    found = oa.estimate(data, physics, learner=oa.MLP((8,)), criterion=oa.Auto(), solver=solver)
    assert found.focus.chosen == "simulation", found.focus.text
    assert found.std is not None and "not_converged" not in dict(found.warnings)
