"""Motions in innovations form: against predictors in NumPy minimised by SciPy, and draws."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from scipy.optimize import least_squares
from test_cli import run

import orthaug as oa

estimate = partial(oa.estimate, standard_errors="plain")  # robust ones are asked for here

TS, TRUE = 0.1, np.array([1.2, 4.0])  # damping and stiffness of a mass of 1 kg


def simulate(
    seed: int, rows: int = 500, process: float = 0.15, sensor: float = 0.02, friction: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """A mass with process noise in its velocity and sensor noise, one Euler step a sample."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-10, 10, rows // 5 + 1), 5)[:rows]
    w, e = process * rng.normal(size=rows), sensor * rng.normal(size=rows)
    x = v = 0.0
    y = np.zeros(rows)
    for t in range(rows):
        y[t] = x + e[t]
        force = u[t] - TRUE[0] * v - TRUE[1] * x - friction * np.tanh(v / 0.3)
        x, v = x + TS * v, v + TS * force + w[t]
    return u, y


def record_of(*pieces: tuple[np.ndarray, np.ndarray]) -> oa.Record:
    made = [
        oa.Record.from_arrays(u, y, inputs=["u"], outputs=["y"], sampling_time=TS)
        for u, y in pieces
    ]
    return replace(made[0], experiments=tuple(one.experiments[0] for one in made))


def motion(learned: bool = False, **options: Any) -> oa.Motion:
    return oa.Motion.from_equations(
        [
            oa.State("x", "x + Ts*v", start="y"),
            oa.State("v", "v + Ts*(u - c*v - k*x)", start="derivative of y", learned=learned),
        ],
        [oa.Output("y", "x")],
        [oa.PhysicalParameter("c", 1.0), oa.PhysicalParameter("k", 3.0)],
        ["u"],
        integrator="discrete",
        **options,
    )


WHOLE = oa.Simulation(segment=0, washout=0)
EXACT = oa.LevenbergMarquardt(tolerance=1e-12)


def fitted(own: oa.Record, **options: Any) -> Any:
    given: dict[str, Any] = {
        "learner": None,
        "criterion": WHOLE,
        "noise": "innovations",
        "solver": EXACT,
    }
    return estimate(own, motion(), **given | options)


def matrices(c: float, k: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    a = np.array([[1.0, TS], [-TS * k, 1 - TS * c]])
    return a, np.array([0.0, TS]), np.array([1.0, 0.0])


def innovations(p: np.ndarray, pieces: Any) -> np.ndarray:
    """y − ŷ of the predictor, p = (c, k, K, a start for each piece); missing outputs are NaN."""
    (a, b, h), gain = matrices(*p[:2]), p[2:4]
    found = []
    for i, (u, y) in enumerate(pieces):
        x = p[4 + 2 * i : 6 + 2 * i]
        for now, measured in zip(u, y, strict=True):
            e = 0.0 if np.isnan(measured) else measured - h @ x
            found.append(e)
            x = a @ x + b * now + gain * e
    return np.array(found)


def oracle(first: np.ndarray, pieces: Any) -> Any:
    """The minimum of the squared innovations, by SciPy."""
    p = np.concatenate([first, *([y[0], 0.0] for _, y in pieces)])
    tight: dict[str, Any] = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    return least_squares(innovations, p, jac="3-point", x_scale="jac", args=(pieces,), **tight)


@pytest.fixture(scope="module")
def alone() -> Any:
    return fitted(record_of(simulate(0)))


def test_the_fit_is_the_minimum_over_parameters_gain_and_start(alone: Any) -> None:
    pieces = [simulate(0)]
    gain, covariance = alone.model.noise.gain, alone.model.noise.covariance
    found = np.concatenate([alone.values, gain[:, 0]])
    there = oracle(found * 1.02, pieces)
    np.testing.assert_allclose(found, there.x[:4], rtol=1e-6)
    variance = 2 * there.cost / (len(pieces[0][1]) - 4)
    std = np.sqrt(np.diag(np.linalg.inv(there.jac.T @ there.jac)) * variance)
    np.testing.assert_allclose(alone.std, std[:2], rtol=1e-4)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), std[2:4], rtol=1e-4)
    assert np.all(np.abs(alone.values - TRUE) < 4 * alone.std)


def test_the_gain_is_that_of_the_kalman_filter(alone: Any) -> None:
    a, _, h = matrices(*TRUE)
    q = 0.15**2 * np.diag([0.0, 1.0])
    p = scipy.linalg.solve_discrete_are(a.T, h[:, None], q, np.array([[0.02**2]]))
    kalman = a @ p @ h / (h @ p @ h + 0.02**2)
    std = np.sqrt(np.diag(alone.model.noise.covariance))
    assert np.all(np.abs(alone.model.noise.gain[:, 0] - kalman) < 4 * std)
    (noise,) = alone.noise
    assert noise.std == pytest.approx(np.sqrt(h @ p @ h + 0.02**2), rel=0.1)
    assert noise.white_p > 0.01
    assert [one.name for one in noise.coefficients] == ["K[x]", "K[v]"]


def test_a_free_run_is_too_sure_where_process_noise_moves_the_states(alone: Any) -> None:
    white = fitted(record_of(simulate(0)), noise="white")
    assert np.all(np.asarray(white.std) < 0.6 * np.asarray(alone.std))
    assert alone.status.loss < 0.5 * white.status.loss


def test_several_records_each_begin_at_a_state_of_their_own() -> None:
    pieces = [simulate(seed, rows) for seed, rows in ((1, 300), (2, 61), (3, 200))]
    fit = fitted(record_of(*pieces))
    found = np.concatenate([fit.values, fit.model.noise.gain[:, 0]])
    there = oracle(found * 1.02, pieces)
    np.testing.assert_allclose(found, there.x[:4], rtol=1e-6)


def test_predictions_follow_the_predictor_and_free_runs_do_not(alone: Any) -> None:
    u, y = simulate(7, 120)
    own, model = record_of((u, y)), alone.model
    (a, b, h), gain = matrices(*alone.values), model.noise.gain[:, 0]
    window = model.window

    def first_errors(x: np.ndarray) -> np.ndarray:
        return innovations(np.concatenate([alone.values, gain, x]), [(u[:window], y[:window])])

    start = least_squares(first_errors, [y[0], 0.0], xtol=1e-15, ftol=1e-15).x
    for horizon in (1, 4):
        predicted = model.predict(own, horizon).trajectories[0].model[:, 0]
        assert np.isnan(predicted[: window + horizon - 1]).all()
        x = start
        for k in range(len(y) - horizon + 1):
            ahead = x
            for j in range(horizon - 1):
                ahead = a @ ahead + b * u[k + j]
            if k >= window:
                assert predicted[k + horizon - 1] == pytest.approx(h @ ahead, abs=1e-6)
            x = a @ x + b * u[k] + gain * (y[k] - h @ x)
    free = replace(model, noise=None)
    np.testing.assert_array_equal(model.simulate(own).model, free.simulate(own).model)
    better = model.predict(own).scores().rmse[0] < 0.8 * free.predict(own).scores().rmse[0]
    assert better


def test_saved_models_keep_the_gain(alone: Any, tmp_path: Path) -> None:
    oa.save(alone.model, tmp_path / "model")
    loaded: Any = oa.load(tmp_path / "model")
    own = record_of(simulate(0))
    np.testing.assert_array_equal(loaded.noise.gain, alone.model.noise.gain)
    np.testing.assert_array_equal(loaded.noise.covariance, alone.model.noise.covariance)
    np.testing.assert_array_equal(loaded.predict(own).model, alone.model.predict(own).model)


LEARNER = oa.MLP(hidden=(4,), inputs=("v",))


@pytest.fixture(scope="module")
def learned() -> Any:
    own = record_of(simulate(0, rows=800, friction=1.0))
    return estimate(
        own, motion(learned=True), learner=LEARNER, noise=oa.Innovations(), regularization=1e-3,
        fallback=False, blocks=0,
    )  # fmt: skip


def test_the_split_is_that_of_the_motion_and_the_gain_never_enters_it(learned: Any) -> None:
    assert [learned.shared.untouched, learned.parameters.shared.tolist()] == [("k",), [True, False]]
    model, segmented = learned.model, learned.segmented
    numbers = model.numbers
    c = np.asarray(numbers.theta - numbers.theta_aux)
    x, u = segmented.trajectory(c, numbers.weights, learned.states)
    rest = [float(model.form.learned(numbers, *point)[0]) for point in zip(x, u, strict=True)]
    v = x[:, 1]
    damping = c[0] - np.asarray(rest) @ v / (v @ v) / TS  # the nearest physics over the rows
    np.testing.assert_allclose(learned.values[0], damping, rtol=1e-8)
    np.testing.assert_allclose(learned.values[1], c[1], rtol=1e-12)
    assert learned.split_by.slope.shape == (2, 2 + model.form.bound.size)
    assert learned.defect < 1e-9


def test_a_learner_is_found_beside_process_noise(learned: Any) -> None:
    x = np.linspace(-2, 2, 9)
    model, c = learned.model, learned.values[0]
    added = [
        float(model.form.learned(model.numbers, np.array([0.0, v]), np.zeros(1))[0]) for v in x
    ]
    whole = np.asarray(added) / TS - (model.theta - model.theta_aux)[0] * x
    truth = -TRUE[0] * x - np.tanh(x / 0.3)
    assert np.sqrt(np.mean((whole - truth) ** 2)) < 0.25 * np.sqrt(np.mean(truth**2))
    assert abs(learned.values[1] - TRUE[1]) < 4 * learned.std[1] and np.isfinite(c)
    alone = learned.physics_alone
    assert alone.model.noise is not None
    own = learned.problem.record
    better = model.predict(own).scores().rmse[0] / alone.model.predict(own).scores().rmse[0]
    assert better < 0.97


def test_other_measures_and_robust_errors_are_there(learned: Any) -> None:
    other = learned.split(oa.Uniform({"v": (-1.0, 1.0)}))
    assert other.std is not None and np.isfinite(other.std).all()
    np.testing.assert_allclose(other.values[1], learned.values[1], rtol=1e-12)
    robust = learned.robust()
    np.testing.assert_allclose(robust.std, learned.std, rtol=0.5)
    found = oa.diagnose(learned)
    assert found is not None and found.verdict == "white"


def test_auto_takes_white_noise_where_there_is_no_process_noise() -> None:
    quiet = record_of(simulate(3, process=0.0))
    fit, plain = (fitted(quiet, noise=noise) for noise in ("auto", "white"))
    assert [one.model for one in fit.noise] == ["white"] and not fit.model.coloured
    np.testing.assert_array_equal(fit.values, plain.values)
    moved = fitted(record_of(simulate(0)), noise="auto")
    assert [one.model for one in moved.noise] == ["innovations"]


def room(seed: int, lasting: float, rows: int = 450) -> oa.Record:
    """A heated mass of 50 samples, its surroundings a first-order process of 120, white noise on the sensor."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([0.2, 0.5, 0.8, 1.0, 1.5], rows // 30 + 1), 30)[:rows]
    x, ambient, y = 0.0, lasting * rng.normal(), np.zeros(rows)
    for t in range(rows):
        y[t] = x + 0.1 * rng.normal()
        x += 0.02 * (10 * u[t] + ambient - x)
        ambient = 0.9917 * ambient + lasting * np.sqrt(1 - 0.9917**2) * rng.normal()
    return oa.Record.from_arrays(u, y, inputs=["u"], outputs=["y"], sampling_time=1.0)


def fit_room(own: oa.Record, noise: str) -> Any:
    heated = oa.Motion.from_equations(
        [oa.State("x", "x + b*u - a*x", start="y")],
        [oa.Output("y", "x")],
        [oa.PhysicalParameter("a", 0.05), oa.PhysicalParameter("b", 0.1)],
        ["u"],
        integrator="discrete",
    )
    return estimate(own, heated, learner=None, noise=noise)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_no_predictor_whose_errors_grow_is_taken(seed: int) -> None:
    """Under starts that are free, least squares prefers it: white noise on a slow system is the case."""
    own = room(seed, 0.0)
    plain = fit_room(own, "white")
    for noise in ("innovations", "auto"):
        fit = fit_room(own, noise)
        # Where K is found beside zero, its errors fade
        gain = 0.0 if not fit.model.coloured else float(fit.model.noise.gain[0, 0])
        assert abs(1 - fit.values[0] - gain) < 1
        np.testing.assert_allclose(fit.values, [0.02, 0.2], atol=4 * np.max(plain.std))
        assert np.isfinite(fit.std).all()


def test_a_short_record_cannot_tell_process_noise_from_what_lasts() -> None:
    codes = {w.code for w in fit_room(room(1, 0.8), "innovations").warnings}
    assert "short_for_noise" in codes
    known = {w.code for w in fit_room(room(1, 0.8, rows=3000), "innovations").warnings}
    assert "short_for_noise" not in known


def test_held_inputs_and_integrators_have_it() -> None:
    own = record_of(simulate(5, rows=300))
    physics = oa.Motion.from_equations(
        [
            oa.State("x", "v", start="y"),
            oa.State("v", "u - c*v - k*x", start="derivative of y"),
        ],
        [oa.Output("y", "x")],
        [oa.PhysicalParameter("c", 1.0), oa.PhysicalParameter("k", 3.0)],
        ["u"],
        integrator="exact",
        hold="first-order",
    )  # fmt: skip
    fit = estimate(own, physics, learner=None, noise="innovations")
    assert fit.status.ok and fit.noise[0].model == "innovations"
    assert np.all(np.abs(fit.values / TRUE - 1) < 0.6)


def test_functions_have_it(alone: Any) -> None:
    def f(x: Any, u: Any, p: Any) -> Any:
        return [x[0] + TS * x[1], x[1] + TS * (u[0] - p[0] * x[1] - p[-1] * x[0])]

    def stacked(x: Any, u: Any, p: Any) -> Any:
        import jax.numpy as jnp

        return jnp.stack(f(x, u, p))

    physics = oa.Motion.from_functions(
        stacked,
        lambda x, u, p: x[:1],
        [oa.State("x", start="y"), oa.State("v", start="derivative of y")],
        ["y"],
        [oa.PhysicalParameter("c", 1.0), oa.PhysicalParameter("k", 3.0)],
        ["u"],
        integrator="discrete",
    )
    own = record_of(simulate(0))
    fit = estimate(own, physics, learner=None, noise="innovations", criterion=WHOLE, solver=EXACT)
    np.testing.assert_allclose(fit.values, alone.values, rtol=1e-7)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"noise": "arma"}, "is for lagged physics"),
        ({"noise": oa.ARMA(1, 1)}, "is for lagged physics"),
        ({"noise": "pink"}, "must be white, innovations, auto"),
        ({"engine": oa.Devices()}, "engine memory"),
        ({"controller": oa.Controller.pid("u", "r", "y", Kp=1.0)}, "the plant's own input"),
    ],
)
def test_what_innovations_are_not_for_is_refused(options: Any, words: str) -> None:
    own = record_of(simulate(0, 60))
    if "controller" in options:
        own = replace(own, inputs=(replace(own.inputs[0], name="r"),))
    with pytest.raises(oa.InputError, match=words):
        fitted(own, **options)


def test_a_learner_with_states_and_a_warm_start_are_refused(learned: Any) -> None:
    own = learned.problem.record
    with pytest.raises(oa.InputError, match="states of its own"):
        memory = oa.MLP(hidden=(4,), inputs=("v",), states=1)
        estimate(own, motion(learned=True), learner=memory, noise="innovations")
    with pytest.raises(oa.InputError, match="leave out `initial`"):
        estimate(own, motion(learned=True), initial=learned, noise="innovations")


SPEC = """
[data]
sampling_time = 0.1
inputs = ["u"]
outputs = ["y"]
train = { files = ["run.csv"] }
[data.tests.other]
files = ["other.csv"]
[motion]
integrator = "discrete"
[motion.states]
x = { next = "x + Ts*v", start = "y" }
v = { next = "v + Ts*(u - c*v - k*x)", start = "derivative of y" }
[motion.outputs]
y = "x"
[motion.parameters]
c = { initial = 1.0 }
k = { initial = 3.0 }
[learner]
kind = "none"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("innovations")
    for name, seed in (("run", 0), ("other", 1)):
        table = np.column_stack(simulate(seed))
        np.savetxt(place / f"{name}.csv", table, delimiter=",", header="u,y", comments="")
    return place


@pytest.mark.usefixtures("without_figures", "without_trials")
def test_a_spec_declares_it_and_the_result_has_it(folder: Path, alone: Any) -> None:
    (folder / "spec.toml").write_text(SPEC + '[noise]\nmodel = "innovations"\n')
    done = run("fit", folder / "spec.toml", "--out", folder / "out")
    assert done.code == 0, done.err
    assert "noise       y: innovations, K[x] = " in done.out
    result = json.loads((folder / "out" / "result.json").read_text())
    (noise,) = result["noise"]
    assert (noise["model"], noise["ar"], noise["ma"]) == ("innovations", None, None)
    assert [one["name"] for one in noise["coefficients"]] == ["K[x]", "K[v]"]
    low, high = noise["coefficients"][0]["ci95"]
    assert low < noise["coefficients"][0]["value"] < high and noise["white_p"] > 0.01
    values = [one["value"] for one in result["parameters"]]
    np.testing.assert_allclose(values, alone.values, rtol=1e-3)
    assert result["residuals"]["verdict"] == "white"
    for part in ("train", "tests.other"):
        scores = result["scores"][part]
        assert scores["prediction"]["fit"][0] > scores["simulation"]["fit"][0]
    assert result["status"]["loss"] <= result["status"]["start_loss"]
    assert "K[v]" in (folder / "out" / "report.html").read_text()
    again = run("predict", folder / "out", folder / "other.csv", "--out", folder / "ahead.csv")
    assert again.code == 0, again.err


@pytest.mark.usefixtures("without_figures", "without_trials")
def test_a_spec_lets_the_data_choose_the_noise(folder: Path) -> None:
    (folder / "auto.toml").write_text(SPEC + '[noise]\nmodel = "auto"\n')
    done = run("fit", folder / "auto.toml", "--out", folder / "chosen")
    assert done.code == 0, done.err
    (noise,) = json.loads((folder / "chosen" / "result.json").read_text())["noise"]
    assert noise["model"] == "innovations"


def test_findings_in_memory_have_the_gain(alone: Any) -> None:
    found = alone.diagnose(blocks=0)
    assert [noise.model for noise in found.noise] == ["innovations"]
    assert found.residuals.verdict == "white" and "K[v]" in str(found)


def test_an_observer_has_the_noises_that_the_gain_stands_for(alone: Any) -> None:
    other = record_of(simulate(5))
    observer = oa.Observer(alone)
    assert observer.run(other).consistency().consistent
    (ahead,) = observer.predict(other, horizon=5).trajectories
    (wanted,) = alone.model.predict(other, 5).trajectories
    y = other.experiments[0].outputs
    settled = slice(50, None)  # both begin from states of their own
    rms = [np.sqrt(np.mean((y - one.model)[settled] ** 2)) for one in (ahead, wanted)]
    assert rms[0] < 1.02 * rms[1]
    within = np.abs((y - ahead.model) / ahead.std)[settled] < 1.96
    assert 0.9 < np.mean(within) < 0.99


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ('[noise]\nmodel = "arma"\n', "is for lagged physics"),
        ('[noise]\nmodel = "innovations"\nar = 2\n', "`largest` are of `arma`"),
        ('[noise]\nmodel = "innovations"\n[engine]\nkind = "devices"\n', "expected memory"),
    ],
)
def test_a_spec_that_cannot_have_it_is_bad_input(folder: Path, section: str, words: str) -> None:
    (folder / "bad.toml").write_text(SPEC + section)
    done = run("fit", folder / "bad.toml", "--out", folder / "bad")
    assert done.code == 2 and words in " ".join(done.err.split()), done.err


@pytest.mark.proof
def test_intervals_hold_beside_process_noise_and_those_of_a_free_run_do_not() -> None:
    held, off, plain = [], [], []
    for seed in range(100):
        own = record_of(simulate(100 + seed, rows=1000))
        fit, white = (fitted(own, noise=noise) for noise in ("innovations", "white"))
        low, high = np.asarray(fit.interval).T
        held.append((low <= TRUE) & (high >= TRUE))
        off.append((fit.values - TRUE) / fit.std)
        low, high = np.asarray(white.interval).T
        plain.append((low <= TRUE) & (high >= TRUE))
    assert 0.93 <= np.mean(held) <= 0.97
    assert np.abs(np.mean(off, axis=0)).max() < 0.2  # 1/√100 is 0.1
    assert np.mean(plain) < 0.7
