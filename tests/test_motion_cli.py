"""Equations of motion from the shell: spec, check, fit, compare, simulate, predict, split, and saved models."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import scipy.signal
from helpers import unfolded
from test_cli import run
from test_export import moving

import orthaug as oa
from orthaug import InputError, read_record
from orthaug.analysis.motion_modes import motion_stability

pytestmark = pytest.mark.usefixtures("without_trials")

SPEC = """
[data]
sampling_time = 0.01
inputs = ["force"]
outputs = ["position"]
train = { files = ["run.csv"] }
tests.steps = { files = ["steps.csv"] }
channels.position = { unit = "m" }
[motion.states]
x = { derivative = "v", start = "position", unit = "m" }
v = { derivative = "(force - c*v - k*x)/m", start = "derivative of position", learned = true, unit = "m/s" }
[motion.outputs]
position = "x"
[motion.parameters]
m = { initial = 1.2, unit = "kg", min = 0 }
c = { initial = 1.2, unit = "N s/m", min = 0 }
k = { initial = 120.0, unit = "N/m", min = 0 }
[learner]
hidden = [3]
inputs = ["v"]
[training]
restarts = 1
iterations = 40
segment = 150
[validation]
blocks = 0
"""
M, C, K = 1.0, 2.0, 100.0


@pytest.fixture
def small(tmp_path, monkeypatch) -> Path:
    """A mass without a learner, on 60 rows in the current folder."""
    monkeypatch.chdir(tmp_path)
    pd.DataFrame(friction(60, 1), columns=["force", "position"]).to_csv("run.csv", index=False)
    text = SPEC.replace('tests.steps = { files = ["steps.csv"] }\n', "")
    text = text.replace('hidden = [3]\ninputs = ["v"]', 'kind = "none"')
    Path("plant.toml").write_text(
        text.replace("learned = true, ", "").replace("segment = 150\n", "")
    )
    return Path("plant.toml")


def test_a_start_beyond_all_numbers_ends_in_a_line(small):
    small.write_text(small.read_text().replace('"derivative of position"', "1e300"))
    code, _, err = orthaug("fit", small, "--out", "out")
    assert code == 1 and "training failed: physics alone has no finite free run" in err


@pytest.mark.parametrize(
    ("change", "words"),
    [("position = { scale = 1e-12", "position varies by"), ("position = { offset = 1e9", "about 1e+09"),
     ("force = { scale = 1e12", "force varies by")],
)  # fmt: skip
def test_a_channel_of_an_unlikely_size_is_named_where_the_free_run_fails(small, change, words):
    line = change if "position" in change else f'{change} }}\nchannels.position = {{ unit = "m"'
    text = small.read_text().replace('channels.position = { unit = "m" }', f"channels.{line} }}")
    small.write_text(text)
    code, _, err = orthaug("fit", small, "--out", "out")
    if code:
        assert words in err and "check `scale`, `offset` and `unit`" in err
    else:
        assert "training failed" not in err


@pytest.mark.parametrize(
    ("equation", "words"),
    [
        (
            "(force - c*v - 1e7*k*x)/m",
            "oscillates with 3.16e+04 rad/s, 50.3 periods in a sample of 0.01 s",
        ),
        (
            "(force - 1e6*c*v - k*x)/m",
            '1e+06 1/s, also of `integrator = "exact"`: 1e+04 in a substep, at most 4096',
        ),
    ],
    ids=["turns", "decays"],
)
def test_modes_beyond_what_samples_show_are_refused_of_an_exact_integrator(small, equation, words):
    text = small.read_text().replace("(force - c*v - k*x)/m", equation)
    small.write_text(
        text.replace("[motion.states]", '[motion]\nintegrator = "exact"\n[motion.states]')
    )
    code, _, err = orthaug("fit", small, "--out", "out")
    assert code == 2 and words in err and "leave the fast mode out" in err
    small.write_text(small.read_text().replace('"exact"', '"exact"\nsubsteps = 8'))
    assert orthaug("check", small)[0] == (2 if "1e7" in equation else 0)


@pytest.mark.parametrize("substeps", [1, 3])
def test_a_long_chain_of_definitions_is_what_it_stands_for(small, substeps):
    """200 operations: such a motion has its stages in a loop; the short one has them one by one."""
    text = small.read_text().replace(
        "[motion.states]", f"[motion]\nsubsteps = {substeps}\n[motion.states]"
    )
    small.write_text(text)
    assert orthaug("fit", small, "--out", "short")[0] == 0
    chain = 'd1 = "x + 1"\n' + "".join(f'd{i} = "d{i - 1} + 1"\n' for i in range(2, 201))
    text = text.replace("k*x)/m", "k*(d200 - 200))/m").replace(
        "[motion.parameters]", f"[motion.define]\n{chain}[motion.parameters]"
    )
    small.write_text(text)
    assert orthaug("fit", small, "--out", "long")[0] == 0
    short, long = (
        strict(Path(out, "result.json").read_text())["parameters"] for out in ("short", "long")
    )
    for one, other in zip(short, long, strict=True):
        assert other["value"] == pytest.approx(one["value"], rel=1e-6)
        assert other["std"] == pytest.approx(one["std"], rel=1e-4)


def friction(rows: int, seed: int) -> np.ndarray:
    """Force and position of a mass with viscous and Coulomb friction under steps, 40 dB of noise."""
    random = np.random.default_rng(seed)
    force = np.repeat(random.uniform(-20, 20, rows // 20 + 1), 20)[:rows]
    x, found, h = np.zeros(2), [], 0.002

    def rate(x: np.ndarray, u: float) -> np.ndarray:
        return np.array([x[1], (u - C * x[1] - K * x[0] - 1.5 * np.tanh(x[1] / 0.2)) / M])

    for u in force:
        found.append(x[0])
        for _ in range(5):
            k1 = rate(x, u)
            k2 = rate(x + h / 2 * k1, u)
            k3 = rate(x + h / 2 * k2, u)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3, u))
    position = np.array(found)
    return np.column_stack([force, position + 0.01 * position.std() * random.normal(size=rows)])


def ramps(rows: int) -> np.ndarray:
    """Force and position of a linear oscillator whose input runs straight between samples, 60 dB of noise."""
    random = np.random.default_rng(5)
    force = random.uniform(-20, 20, rows)
    system = tuple(map(np.array, ([[0, 1], [-K / M, -C / M]], [[0], [1 / M]], [[1, 0]], [[0]])))
    exact = scipy.signal.cont2discrete(system, 0.01, "foh")
    position = scipy.signal.dlsim((*exact[:4], 0.01), force)[1][:, 0]
    return np.column_stack([force, position + 0.001 * position.std() * random.normal(size=rows)])


def put(folder: Path, text: str = SPEC) -> Path:
    spec = folder / "msd.toml"
    spec.write_text(text)
    for name, rows, seed in (("run", 300, 1), ("steps", 120, 2)):
        if not (folder / f"{name}.csv").exists():
            table = friction(rows, seed)
            np.savetxt(
                folder / f"{name}.csv", table, delimiter=",", header="force,position", comments=""
            )
    return spec


def orthaug(*arguments: object) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a command, run in this process."""
    done = run(*arguments)
    return int(done.code or 0), done.out, done.err


def strict(text: str) -> dict:
    """JSON without NaN and Infinity."""

    def refuse(name: str) -> float:
        raise AssertionError(f"{name} in JSON")

    return json.loads(text, parse_constant=refuse)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("motion")


@pytest.fixture(scope="module")
def printed(folder):
    code, out, err = orthaug("fit", put(folder), "--out", folder / "out")
    assert code == 0, err
    return out


@pytest.fixture(scope="module")
def result(folder, printed):
    return strict((folder / "out" / "result.json").read_text())


@pytest.fixture(scope="module")
def model(folder, printed):
    return oa.load(folder / "out")


def test_a_fit_finds_mass_and_stiffness_beside_the_friction(result):
    rows = {row["name"]: row for row in result["parameters"]}
    assert [(name, row["unit"], row["shared"]) for name, row in rows.items()] == [
        ("m", "kg", False),
        ("c", "N s/m", True),
        ("k", "N/m", False),
    ]
    for name, truth in (("m", M), ("k", K)):
        assert abs(rows[name]["value"] - truth) < 4 * rows[name]["std"]
        assert rows[name]["ci95"][0] < rows[name]["value"] < rows[name]["ci95"][1]
    assert (
        rows["c"]["value"] > C + 5 * rows["c"]["std"]
    )  # the nearest viscous friction has a share of Coulomb's


def test_what_a_learner_that_helps_may_hold_of_a_parameter_is_reported_where_no_suspect_is_declared(
    printed, result
):
    rows = {row["name"]: row for row in result["parameters"]}
    assert result["validation"]["verdict"] == "helps" and [
        name for name in rows if rows[name]["shared"]
    ] == ["c"]
    (cause,) = result["bias"]  # a usual one that nobody declared
    assert rows["c"]["bias"]["cause"] == cause["name"] and cause["equation"] == "v"
    assert cause["name"].startswith(
        ("coulomb of v", "tanh(v", "saturation(v")
    )  # friction that ends at a force
    assert cause["coefficient_found"] * cause["bias"]["c"] == pytest.approx(
        rows["c"]["bias"]["value"]
    )
    # Of so short a training the causes that noise cannot tell apart may disagree
    limits = rows["c"]["ci95_with_bias"]
    assert limits[0] < C < limits[1] if rows["c"]["bias"]["determined"] else limits is None
    assert ("not_determined" in {w["code"] for w in result["warnings"]}) == (limits is None)
    assert cause["name"] in " ".join(printed.split())


def test_a_result_has_what_a_motion_has_and_null_for_the_rest(result):
    status = result["status"]
    assert status["loss"] < 0.5 * status["start_loss"]
    scores = result["scores"]
    assert scores["tests.steps"]["simulation"]["nrmse"][0] < 0.05
    assert scores["tests.steps"]["prediction"]["nrmse"][0] < 0.05
    assert result["validation"]["verdict"] == "helps"
    assert result["excitation"]["rank"] == result["excitation"]["columns"] == 3
    assert result["orthogonality_defect"] < 1e-10
    assert status["code"] == "iteration_limit"  # so that nothing counts as determined by the fit
    assert result["shared"]["inputs"] == ["v"] and result["shared"]["determined"] == []
    assert result["shared"]["withdrawn"] == ["m", "k"] and result["shared"]["doubt"].startswith(
        "training ended at its limit of iterations"
    )
    own = {"states": ["x", "v"], "integrator": "rk4", "substeps": 1, "hold": "zero-order"}
    assert {key: result["motion"][key] for key in own} == own
    assert set(result["motion"]) == {*own, "window", "parts", "substep_bias"}
    for key in ("physical_parameters", "physical_consistency", "sensitivities", "missing_lags"):
        assert result[key] is None
    found = result["residuals"]
    assert found["verdict"] == "white" and "white" in found["text"] and found["one_step"] == []
    assert [test["name"] for test in found["free_run"]] == ["position"]


def test_the_folder_has_figures_and_a_page(folder, printed, result):
    figures = {path.stem for path in (folder / "out" / "figures").iterdir()}
    assert figures == {
        "simulation",
        "prediction",
        "residual",
        "states",
        "components",
        "learner",
        "bias",
        "residuals_free_run",
    }
    page = (folder / "out" / "report.html").read_text()
    assert ">(force - c*v - k*x)/m</td>" in page and ">dv/dt</th>" in page
    (part,) = result["motion"]["parts"]
    assert (part["equation"], part["unit"]) == ("dv/dt", "m/s²") and 0.01 < part["share"] < 0.2
    assert part["share"] == pytest.approx(part["learner"] / part["physics"], rel=0.2)
    assert set(result["motion"]["substep_bias"]) == set("mck")
    assert result["shared"]["text"] in unfolded(printed)


def test_a_saved_motion_is_the_fitted_one(folder, model, result):
    values = [row["value"] for row in result["parameters"]]
    assert list(model.parameters.values()) == pytest.approx(values, rel=1e-14)
    kept = folder / "again"
    oa.save(model, kept)
    again, record = oa.load(kept), read(folder / "steps.csv")
    assert np.array_equal(again.simulate(record).model, model.simulate(record).model)
    assert "pickle" not in (kept / "model.json").read_text()
    altered = (kept / "model.json").read_text().replace("c*v", "m*v")
    (kept / "model.json").write_text(altered)
    with pytest.raises(InputError, match="altered"):
        oa.load(kept)


def read(path: Path) -> oa.Record:
    return read_record(path, inputs=["force"], outputs=["position"], sampling_time=0.01)


def test_functions_are_asked_for_again(folder, model):
    def f(x, u, p):
        return jnp.stack([x[1], (u[0] - p[1] * x[1] - p[2] * x[0]) / p[0]])

    given = model.form.motion
    motion = oa.Motion.from_functions(
        f, lambda x, u, p: x[:1], given.states, ["position"], given.parameters, given.inputs
    )
    own = replace(model, form=replace(model.form, motion=motion))
    oa.save(own, folder / "functions")
    with pytest.raises(InputError, match="two Python functions; give them again"):
        oa.load(folder / "functions")
    other = replace(motion, states=motion.states[:1])
    with pytest.raises(InputError, match="the saved motion has the states x, v"):
        oa.load(folder / "functions", baseline=other)
    again, record = oa.load(folder / "functions", baseline=motion), read(folder / "steps.csv")
    assert again.simulate(record).model == pytest.approx(model.simulate(record).model, abs=1e-9)


def test_an_input_is_designed_for_the_motion(folder):
    spec = put(folder).with_name("design.toml")
    spec.write_text(
        SPEC.replace("[training]", "[design]\nsamples = 300\namplitude = 20\nseed = 3\n[training]")
    )
    code, out, err = orthaug("design", spec, "--out", folder / "u.csv", "--json")
    assert code == 0, err
    found, table = strict(out), pd.read_csv(folder / "u.csv")
    assert list(table) == ["time", "force"] and len(table) == 300 and table.force.abs().max() <= 20
    assert set(found["std"]) == {"m", "c", "k"} and found["relative_error"] ** 2 == pytest.approx(
        found["cost"]
    )
    errors = {row["name"]: row["std"] for row in found["candidates"]}
    assert found["relative_error"] < 0.5 * errors["white binary, hold 1"]
    spec.write_text(spec.read_text().replace("samples = 300", "samples = 9"))
    code, _, err = orthaug("design", spec, "--out", folder / "v.csv")
    assert code == 2 and "design: `samples` must be" in err and not (folder / "v.csv").exists()


def test_a_split_is_the_fits_own_under_its_measure(folder, result):
    code, out, _ = orthaug("split", folder / "out", folder / "run.csv", "--json")
    assert code == 0
    for own, row in zip(result["parameters"], strict(out)["parameters"], strict=True):
        assert [row["value"], row["std"]] == pytest.approx([own["value"], own["std"]], rel=1e-9)


def test_a_split_under_a_box_moves_what_is_shared(folder, result):
    code, out, _ = orthaug(
        *(
            "split",
            folder / "out",
            folder / "run.csv",
            "--measure",
            "uniform",
            "--box",
            "v=-1:1",
            "--json",
        )
    )
    assert code == 0
    before, after = (
        {r["name"]: r["value"] for r in rows}
        for rows in (result["parameters"], strict(out)["parameters"])
    )
    assert after["m"] == pytest.approx(before["m"], rel=1e-9) and after["k"] == pytest.approx(
        before["k"], rel=1e-9
    )
    assert (
        after["c"] > before["c"] + 0.5
    )  # Coulomb friction counts for more where velocities are small


def test_a_split_refuses_what_it_was_not_trained_on(folder, printed):
    code, _, err = orthaug("split", folder / "out", folder / "steps.csv")
    assert code == 2 and "the model was trained on other rows" in err
    code, _, err = orthaug(
        *("split", folder / "out", folder / "run.csv", "--measure", "uniform", "--box", "w=0:1")
    )
    assert (
        code == 2 and "'w' is no state or input that this model reads. It reads x, v, force" in err
    )


def test_the_learner_is_orthogonal_to_what_it_could_imitate(folder, model):
    states = model.states(read(folder / "run.csv"))
    x, u = states[["x", "v"]].to_numpy(), read(folder / "run.csv").experiments[0].inputs
    physics, learner = states[["v_physics"]].to_numpy(), states[["v_learner"]].to_numpy()
    m, c, k = model.parameters.values()
    assert physics[:, 0] == pytest.approx((u[:, 0] - c * x[:, 1] - k * x[:, 0]) / m, abs=1e-9)
    cosine = learner[:, 0] @ x[:, 1] / np.linalg.norm(learner) / np.linalg.norm(x[:, 1])
    assert (
        abs(cosine) < 0.02
    )  # zero over the runs of the training segments, which start a little elsewhere


def test_simulate_and_predict_write_what_physics_alone_gives(folder, model):
    assert (
        orthaug("simulate", folder / "out", folder / "steps.csv", "--out", folder / "sim.csv")[0]
        == 0
    )
    run = pd.read_csv(folder / "sim.csv")
    assert list(run) == [
        *("time", "position", "position_model", "position_baseline", "position_learner"),
        "extrapolates",
    ]
    assert np.abs(run.position_learner).max() > 1e-3
    assert run.position_model.to_numpy() == pytest.approx(
        (run.position_baseline + run.position_learner).to_numpy()
    )
    assert (
        orthaug(
            *(
                "predict",
                folder / "out",
                folder / "steps.csv",
                "--horizon",
                5,
                "--out",
                folder / "ahead.csv",
            )
        )[0]
        == 0
    )
    ahead = pd.read_csv(folder / "ahead.csv")
    first = model.window + 4
    assert ahead.position_model.isna().sum() == first
    errors = (ahead.position - ahead.position_model)[first:]
    assert np.sqrt(np.mean(errors**2)) < 0.03 * ahead.position.std()
    code, _, err = orthaug("predict", folder / "out", folder / "steps.csv", "--initial", "zero")
    assert code == 2 and "--initial: found with a motion" in err


def test_a_run_survives_physics_that_run_away(folder, model):
    """A split may leave physics that alone have no free run; the model has one all the same."""
    shift = np.array([-25.0, 0.0, 0.0])  # a mass of 1e-11 kg
    numbers = model.numbers
    moved = numbers._replace(theta=numbers.theta + shift, theta_aux=numbers.theta_aux + shift)
    record = read(folder / "steps.csv")
    run, usual = (
        one.simulate(record, "zero") for one in (replace(model, numbers=moved), model)
    )  # no start to search
    assert (
        run.model == pytest.approx(usual.model, abs=1e-12) and run.trajectories[0].diverged is None
    )
    assert (
        np.isnan(run.trajectories[0].baseline[-1]).all()
        and np.isfinite(usual.trajectories[0].baseline).all()
    )
    assert (usual.trajectories[0].baseline + usual.trajectories[0].learner) == pytest.approx(
        usual.model
    )


def test_a_short_recording_has_a_prediction(folder, model):
    record = read(folder / "steps.csv")
    short = oa.Record(
        record.inputs, record.outputs, record.sampling_time, (record.experiments[0].rows(0, 6),)
    )
    response = model.predict(short)
    assert np.isfinite(response.model[-1]).all() and np.isnan(response.model[:5]).all()


def test_modes_are_the_roots_of_the_characteristic_polynomial(model):
    m, c, k = model.parameters.values()
    stability = motion_stability(
        model.physics_only, np.array([[0.1, 0.0], [0.0, 1.0]]), np.zeros((2, 1))
    )
    found = stability.modes
    assert (found.rightmost, found.fastest) == pytest.approx((-c / (2 * m), np.sqrt(k / m)))
    assert found.growing == 0 and not stability.warnings


@pytest.mark.parametrize(("unit", "rate"), [("1/day", "1/day"), ("1/ s", "1/s"), ("N/m", "1/s")])
def test_modes_have_the_unit_of_the_rates_among_the_parameters(unit, rate):
    motion = oa.Motion.from_equations(
        [oa.State("i", "u - c*i")],
        [oa.Output("y", "i")],
        [oa.PhysicalParameter("c", 2.0, unit=unit)],
        inputs=["u"],
    )
    model = moving(motion)
    model = replace(model, numbers=model.numbers._replace(theta_aux=np.zeros(1)))
    text = motion_stability(model, np.ones((5, 1)), np.zeros((5, 1))).text
    assert f"has modes of 2 {rate} along" in text and f"real part is -2 {rate}." in text


def _driven(rate, substeps):
    """The stability of ẇ = `rate` on a square wave of its input, with steps of 0.1 s."""
    given = [oa.PhysicalParameter("c", 1.0)]
    motion = oa.Motion.from_equations(
        [oa.State("w", rate)], [oa.Output("y", "w")], given, inputs=["u"]
    )
    model = moving(motion, substeps=substeps)
    model = replace(model, numbers=model.numbers._replace(theta_aux=np.zeros(1)))
    u = np.tile(np.repeat([1.0, -1.0], 20), 3)
    record = oa.Record.from_arrays(u=u, y=np.zeros(120), sampling_time=0.1)
    return motion_stability(model, np.zeros((5, 1)), np.zeros((5, 1)), record)


def test_a_step_of_the_integrator_that_is_too_long_is_no_divergence():
    """ẇ = u − w³ is bounded for every input, a Runge-Kutta step of it only for small ones."""
    cubic = _driven("c*u - 10*w**3", 1)
    assert cubic.diverges_at is None and cubic.searched > 300
    assert "With 1 substep, as fitted, the integrator itself diverges from" in cubic.text
    assert "give `substeps` = " in cubic.text


def test_a_motion_that_diverges_does_so_with_finer_steps():
    found = _driven("c*u - w + w**3", 4)
    assert 0.385 < found.diverges_at < 1  # beyond the top of w − w³, for waves do not last
    assert "substep" not in found.text and "million times" in dict(found.warnings)["small_margin"]


def test_an_angle_integrates_and_does_not_decay():
    def told(*states):
        given = [oa.PhysicalParameter("c", 2.0)]
        model = moving(
            oa.Motion.from_equations(list(states), [oa.Output("y", "x")], given, inputs=["u"])
        )
        model = replace(model, numbers=model.numbers._replace(theta_aux=np.zeros(1)))
        return motion_stability(
            model, np.random.default_rng(0).normal(size=(5, len(states))), np.zeros((5, 1))
        )

    shaft = told(oa.State("x", "v"), oa.State("v", "u - c*v - 12*i"), oa.State("i", "u - 3*i"))
    assert shaft.text == (
        "The linearised motion has an integrator and modes of 2 to 3 1/s along the free run. "
        "All others decay everywhere: the largest real part is -2 1/s. The integrating mode "
        "neither decays nor grows: errors in it stay."
    )
    assert (shaft.modes.integrators, shaft.modes.rightmost, shaft.modes.slowest) == pytest.approx(
        (1, -2, 2)
    )
    mass = told(oa.State("x", "v"), oa.State("v", "c*u"))
    assert (
        "has 2 integrators and no other modes along" in mass.text
        and "decay everywhere" not in mass.text
    )
    swing = told(oa.State("x", "v"), oa.State("v", "c*u - 9*x"))
    assert "has modes of 3 1/s" in swing.text and "No mode grows, but not all decay" in swing.text
    runaway = told(oa.State("x", "v"), oa.State("v", "u + c*v"))
    assert (
        "has an integrator and modes of 2 1/s" in runaway.text
        and "grows, by up to 2 1/s" in runaway.text
    )
    assert not any("-0 " in found.text for found in (shaft, mass, swing, runaway))


def test_compare_puts_physics_alone_and_saved_models_beside(folder, printed, result):
    saved = folder / "out"
    code, out, err = orthaug(
        "compare", folder / "msd.toml", "--out", folder / "both", "--model", saved, "--json"
    )
    assert code == 0, err
    alone, learned, kept = strict(out)["comparison"]
    assert (alone["name"], learned["name"], kept["status"]) == (
        "physics alone",
        "orthogonal",
        "saved",
    )
    assert kept["scores"] == learned["scores"]
    values = [row["value"] for row in learned["parameters"]]
    assert values == pytest.approx([row["value"] for row in result["parameters"]], rel=1e-9)
    assert alone["weights"] == 0 and learned["validation"]["verdict"] == "helps"
    assert (
        learned["scores"]["train"]["simulation"]["nrmse"]
        < alone["scores"]["train"]["simulation"]["nrmse"]
    )


def test_check_says_what_cannot_be_distinguished_and_which_hold_is_right(tmp_path):
    """A sensor gain scales mass, damper and spring; the input runs straight between samples."""
    text = SPEC.replace('position = "x"', 'position = "g*x"').replace(
        "[learner]", "g = { initial = 1.1, min = 0 }\n[motion]\nsubsteps = 1\n[learner]"
    )
    spec = put(tmp_path, text.replace("tests.steps", "# tests.steps"))
    np.savetxt(
        tmp_path / "run.csv", ramps(300), delimiter=",", header="force,position", comments=""
    )
    code, out, err = orthaug("check", spec, "--json")
    assert code == 2
    assert (
        "rank 3 of 4): m, c, k, g cannot be distinguished; give one of them as a constant." in err
    )
    found = strict(out)
    assert found["excitation"]["rank"] == found["identifiability"]["rank"] == 3
    assert found["identifiability"]["inseparable"] == [["m", "c", "k", "g"]]
    assert found["shared"]["determined"] == []  # they were, "with any learner of these inputs"
    assert "The data determine" not in found["shared"]["text"]
    assert found["motion"]["best_hold"] == "first-order"
    residuals = {held["hold"]: held["residual"] for held in found["motion"]["holds"]}
    assert residuals["first-order"] < 0.1 * residuals["zero-order"]
    assert [warning["code"] for warning in found["warnings"]] == ["other_hold"]
    others = {tuple(other["inputs"]): other["shared"] for other in found["shared"]["alternatives"]}
    assert others == {("x",): 1, ("x", "v"): 2, ("x", "v", "force"): 3}
    assert found["shared"]["directions"] == [{"c": 1.0}]


SUSPECTS = """
[[suspects]]
on = "tanh(v/0.2)"
factor = "-1/m"
coefficient = 1.5
unit = "N"
name = "friction"
[[suspects]]
kind = "dead_zone"
on = "force"
equation = "v"
[training]
"""


def test_suspects_are_weighed_before_a_fit_and_after_it(folder, result):
    """Friction of 1.5 N is there; the learner sees it, so that the damper alone is biased: by 0.73 N s/m of 2.73."""
    spec = put(folder).with_name("suspects.toml")
    spec.write_text(SPEC.replace("[training]", SUSPECTS))
    code, out, err = orthaug("check", spec, "--json")
    assert code == 0, err
    before = strict(out)["bias"]
    code, out, err = orthaug("fit", spec, "--out", folder / "suspects")
    assert code == 0, err
    outcome = strict((folder / "suspects" / "result.json").read_text())
    for table in (before, outcome["bias"]):
        friction, zone = table
        assert (friction["name"], friction["equation"], friction["unit"], friction["seen"]) == (
            "friction",
            "v",
            "N",
            True,
        )
        assert (
            friction["removed_by"] == "learner in part"
            and zone["removed_by"] == "nothing"
            and not zone["seen"]
        )
        assert friction["expected_bias"]["c"] == pytest.approx(0.73, rel=0.1)
        assert [friction["bias"][name] for name in "mk"] == pytest.approx([0, 0], abs=1e-9)
    found = outcome["bias"][0]
    assert found["coefficient_found"] == pytest.approx(1.5, rel=0.1) and found["explained"] > 0.9
    rows = {row["name"]: row for row in outcome["parameters"]}
    assert (
        rows["c"]["ci95_with_bias"][0] < C < rows["c"]["ci95_with_bias"][1] < rows["c"]["ci95"][0]
    )
    assert rows["c"]["bias"]["cause"] == "friction"
    assert rows["m"]["ci95_with_bias"] == pytest.approx(rows["m"]["ci95"], rel=1e-9)
    assert "no suspect explains" not in out
    assert "of what the learner found is friction" in out and "biased" in [
        w["code"] for w in outcome["warnings"]
    ]
    assert (folder / "suspects" / "figures" / "bias.png").exists()


MOTOR = """
[data]
sampling_time = 0.01
inputs = ["V"]
outputs = ["W", "I"]
train = { files = ["motor.csv"] }
[motion]
substeps = 1
[motion.states]
w = { derivative = "(K*i - b*w)/J", start = "W", learned = true }
i = { derivative = "(V - R*i - K*w)/L", start = "I" }
[motion.outputs]
W = "w"
I = "i"
[motion.parameters]
K = { initial = 0.5, min = 0 }
J = { initial = 0.05, min = 0 }
b = { initial = 0.1, min = 0 }
R = { initial = 1.0, min = 0 }
L = { initial = 0.05, min = 0 }
[learner]
hidden = [2]
inputs = ["w"]
[[suspects]]
name = "stiction"
kind = "coulomb"
on = "w"
equation = "w"
[[suspects]]
name = "wear"
kind = "cubic"
on = "i"
equation = "w"
[training]
iterations = 5
[validation]
blocks = 0
"""


@pytest.fixture(scope="module")
def motor(tmp_path_factory) -> Path:
    """A motor whose resistance and inductance stand in the equation that no learner is added to."""
    random, (w, i), rows = np.random.default_rng(3), (0.0, 0.0), []
    for volts in np.repeat(random.uniform(-5, 5, 15), 20):
        rows.append((volts, w, i))
        for _ in range(20):
            dw = (0.6 * i - 0.1 * w - 0.2 * np.tanh(w / 0.05)) / 0.04
            w, i = w + 5e-4 * dw, i + 5e-4 * (volts - 1.2 * i - 0.6 * w) / 0.06
    measured = np.array(rows) + np.array([0.0, 0.02, 0.02]) * random.normal(size=(300, 3))
    path = tmp_path_factory.mktemp("motor")
    pd.DataFrame(measured, columns=["V", "W", "I"]).to_csv(path / "motor.csv", index=False)
    (path / "spec.toml").write_text(MOTOR)
    return path / "spec.toml"


def test_parameters_of_equations_without_a_learner_are_not_moved_by_what_it_sees(motor):
    code, out, err = orthaug("check", motor, "--json")
    assert code == 0, err
    stiction, wear = strict(out)["bias"]
    assert stiction["seen"] and not wear["seen"]
    assert [stiction["bias"][name] for name in "KJRL"] == pytest.approx([0, 0, 0, 0], abs=1e-9)
    assert stiction["bias"]["b"] < 0 and wear["bias"]["R"] != 0


def test_an_analysis_that_fails_numerically_loses_no_training(folder, result, monkeypatch):
    from orthaug.analysis import physics_findings

    def fails(*_, **__):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(physics_findings, "motion_stability", fails)
    monkeypatch.setattr(physics_findings, "linearize_fit", fails)
    spec = put(folder).with_name("fails.toml")
    spec.write_text(SPEC.replace("[training]", SUSPECTS))
    code, out, err = orthaug("fit", spec, "--out", folder / "fails")
    assert code == 0, err
    found = strict((folder / "fails" / "result.json").read_text())
    texts = [w["text"] for w in found["warnings"] if w["code"] == "analysis_failed"]
    assert texts == [
        "the analysis of the modes failed numerically (Singular matrix): the result is given "
        "without it.",
        "the bias by suspects failed numerically (Singular matrix): the result is given without it.",
    ]
    assert found["stability"] is None and found["bias"] is None and found["residuals"] is not None
    assert all(unfolded(text) in unfolded(out + err) for text in texts)
    assert (folder / "fails" / "model").is_dir() and (folder / "fails" / "report.html").exists()


def test_a_defect_of_an_analysis_loses_no_training_either(monkeypatch):
    from orthaug.analysis import attempt

    monkeypatch.setattr(attempt, "DEFECTS", (IndexError, ValueError))
    warnings = []

    def fails(error):
        raise error

    assert (
        attempt.attempt("the analysis", lambda: fails(IndexError("out of bounds")), warnings, 3)
        == 3
    )
    (warning,) = warnings
    assert (
        warning.code == "analysis_failed"
        and "a defect of orthaug (IndexError: out of bounds)" in warning.text
    )
    with pytest.raises(InputError, match="bad"):
        attempt.attempt("the analysis", lambda: fails(InputError("bad")), warnings, 3)


BAD = {
    "sampling time": (
        "[motion.parameters]",
        "[motion.constants]\nTs = 0.5\n[motion.parameters]",
        "the constant 'Ts' is 0.5",
    ),
    "parameter Ts": (
        "[motion.parameters]",
        "[motion.parameters]\nTs = { initial = 1.0 }",
        "'Ts' cannot name a parameter",
    ),
    "undefined": (
        "c*v",
        "cc*v",
        "the equation of 'v' = (force - cc*v - k*x)/m: unknown name 'cc', did you mean 'c'?",
    ),
    "lag": ("(force -", "(force[k] -", "a signal such as y[k-1] is not allowed here"),
    "no derivative": (
        'derivative = "v", ',
        "",
        "`states.x` has no `derivative`; expected its equation",
    ),
    "no state": (
        'position = "x"\n',
        'position = "3*k"\n',
        "'position' = 3*k contains no state",
    ),
    "loop": (
        "[motion.parameters]",
        '[motion.define]\na = "b + x"\nb = "a*2"\n[motion.parameters]',
        "an algebraic loop, a → b → a",
    ),
    "not finite": ("k*x)/m", "k*x)/m + log(-1 - x**2)", "'v' is not finite at the start"),
    "term": ("k*x)/m", "k*x)/m + log(-1 - x**2)", "log(-1 - x ** 2) at x = "),
    "unused": (
        "[motion.parameters]",
        "[motion.parameters]\nq = { initial = 1.0 }",
        "'q' is in no equation",
    ),
    "bounds": (
        'initial = 1.2, unit = "kg"',
        "initial = -1.2",
        "the initial value of 'm' is -1.2; its bounds are 0",
    ),
    "learned": (
        "[motion.outputs]",
        "w = { learned = true }\n[motion.outputs]",
        "`states.w` has no `derivative`",
    ),
    "start": ('start = "position"', 'start = "positon"', "did you mean 'position'?"),
    "too long": (
        "sampling_time = 0.01",
        "sampling_time = 100.0",
        "is too long for the fastest mode of the motion",
    ),
    "focus": (
        "[training]",
        '[training]\nfocus = "prediction"',
        "'training.focus' = prediction; expected simulation",
    ),
    "solver": ("[training]", '[training]\nsolver = "adam-lbfgs"', "'training.solver' = adam-lbfgs"),
    "ensemble": (
        "restarts = 1",
        "ensemble = true\nrestarts = 2",
        "`training.ensemble`: a motion, or a learner with `states`, has none",
    ),
    "structure": (
        "[training]",
        '[structure]\nkind = "additive"\n[training]',
        "'structure.kind' = additive; expected",
    ),
    "lags": ("[training]", "[lags]\nna = 2\n[training]", "`lags`: found beside [motion]"),
    "suspect": (
        "[training]",
        '[[suspects]]\nkind = "cubic"\non = "w"\n[training]',
        "suspect 'cubic(w)' = w**3: unknown name 'w'",
    ),
    "suspect's output": (
        "[training]",
        '[[suspects]]\nkind = "offset"\noutput = "position"\n[training]',
        "`suspects[0].output`: found beside [motion]; expected `equation`",
    ),
    "both": (
        "[training]",
        '[[baseline.terms]]\nparameter = "a"\nregressor = "position[k-1]"\n[training]',
        "`baseline`: found beside [motion]",
    ),
    "nothing learned": (
        ", learned = true",
        "",
        "'learner': no state and no output has `learned = true`",
    ),
    "learner input": ('inputs = ["v"]', 'inputs = ["w"]', "learner input = w: unknown name 'w'"),
    "box": (
        "[training]",
        '[structure.measure]\nkind = "uniform"\nbox = { "v[k]" = [0, 1] }\n[training]',
        "'v[k]' is no state or input that this model reads",
    ),
    "discrete": (
        "[motion.states]",
        '[motion]\nintegrator = "discrete"\n[motion.states]',
        "reads `next`",
    ),
    "output": (
        'position = "x"\n',
        'place = "x"\n',
        "the motion gives the output 'place', which the data do not have",
    ),
}


@pytest.mark.parametrize(("old", "new", "words"), BAD.values(), ids=BAD)
def test_bad_input_is_one_worded_line(folder, old, new, words):
    assert old in SPEC
    put(folder)
    spec = folder / "bad.toml"
    spec.write_text(SPEC.replace(old, new, 1))
    with pytest.raises(InputError) as refused:
        oa.load_spec(spec)
    message = str(refused.value)
    assert words in message and message.startswith(str(spec)) and "\n" not in message


def test_bad_input_ends_with_code_2(folder):
    spec = folder / "neither.toml"
    spec.write_text(SPEC[: SPEC.index("[motion.states]")])
    code, _, err = orthaug("fit", spec)
    assert (
        code == 2
        and "the key 'baseline' is missing; expected [[baseline.terms]], or a [motion] instead"
        in err
    )


def test_what_a_motion_is_trained_with_unless_asked(folder):
    spec = put(folder).with_name("plain.toml")
    spec.write_text(
        SPEC.replace("segment = 150\n", "").replace('[learner]\nhidden = [3]\ninputs = ["v"]\n', "")
    )
    criterion = oa.load_spec(spec).spec.declared_criterion()
    assert (criterion, oa.load_spec(spec).spec.declared_learner()) == (
        oa.Simulation("auto", 0),
        oa.MLP(),
    )
    spec.write_text(spec.read_text().replace(", learned = true", ""))
    job = oa.load_spec(spec)
    assert job.spec.declared_learner() is None and job.compared == ("physics alone",)


def test_rows_of_a_motion_are_all_usable(folder):
    lines = put(folder).with_name("run.csv").read_text().splitlines()
    gaps = [
        line.split(",")[0] + "," if k in (50, 52, 120) else line for k, line in enumerate(lines)
    ]
    (folder / "gaps.csv").write_text("\n".join(gaps))
    spec = folder / "gaps.toml"
    spec.write_text(
        SPEC.replace("run.csv", "gaps.csv").replace("[data]\n", '[data]\nmissing = "skip"\n')
    )
    job = oa.load_spec(spec)
    assert [len(e) for e in job.train.record.experiments] == [
        49,
        67,
        180,
    ]  # one row alone tells no start
    assert (
        "3 rows have missing cells" in job.warnings[0].text
        and "296 usable rows remain" in job.warnings[0].text
    )
    (folder / "short.csv").write_text("\n".join(lines[:3]))
    spec.write_text(SPEC.replace("steps.csv", "short.csv"))
    with pytest.raises(
        InputError,
        match=r"short.csv: data.tests.steps has 2 rows, too few; at least 3 determine where",
    ):
        oa.load_spec(spec)


def test_opening_a_motion_loads_no_jax(folder):
    program = (
        "import sys\nimport orthaug as oa\n"
        f"oa.load_spec({str(put(folder))!r})\nassert 'jax' not in sys.modules\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr


def test_the_fastest_mode_is_found_where_all_guesses_are_zero(tmp_path):
    """The difference about zero was lost in the rounding of a large input: 0 1/s."""
    rng = np.random.default_rng(2)
    u = np.repeat(rng.uniform(-1, 1, 10), 6)
    v = np.zeros(60)
    for k in range(59):
        v[k + 1] = v[k] + 0.01 * (3e6 * u[k] - 5 * v[k])
    write = {"u": u, "y": v + 1e3 * rng.normal(size=60)}
    pd.DataFrame(write).to_csv(tmp_path / "run.csv", index=False)
    (tmp_path / "spec.toml").write_text(
        """
[data]
sampling_time = 0.01
inputs = ["u"]
outputs = ["y"]
train = "run.csv"
[motion.states]
v = { derivative = "3e6*u - c*v" }
x = { derivative = "v - x" }
[motion.outputs]
y = "v + 0*x"
[motion.parameters]
c = { initial = 4.0, min = 0 }
""",
        encoding="utf-8",
    )
    code, out, err = orthaug("check", tmp_path / "spec.toml", "--json")
    assert code == 0, err
    assert strict(out)["motion"]["fastest"] == pytest.approx(4.0)
