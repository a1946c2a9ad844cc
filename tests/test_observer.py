"""The observer: its gain against Riccati's equation, its bands and innovations by simulation, and what is missing."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from test_cli import finite_json, one_line, run
from test_export import lagged, moving
from test_missing import SPEC, write

import orthaug as oa
from orthaug._base.lines import percent
from orthaug.analysis.observer_noise import by_verdict, to_keep

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")

PHYSICS = oa.Baseline.from_terms(
    [oa.Term("a", "y[k-1]"), oa.Term("b", "y[k-2]"), oa.Term("g", "u[k-1]")]
)
TWO = [
    oa.Term("a", "y[k-1]", output="y"),
    oa.Term("b", "z[k-2]", output="y"),
    oa.Term("c", "u[k]", output="y"),
    oa.Term("d", "0.5*z[k-1] - y[k-3]", output="z"),
    oa.Term("e", "u[k-2]", output="z"),
]


def of(covariance) -> np.ndarray:
    return np.asarray(covariance, dtype=float)


def linear_lagged():
    model = lagged(TWO, (), None, ("y", "z"), ("u",))
    numbers = model.numbers._replace(
        theta=np.array([0.7, 0.1, 1.0, 0.3, 0.5]), theta_aux=np.zeros(5)
    )
    return replace(model, numbers=numbers), oa.Noise(
        of([[0.02, 0.01], [0.01, 0.05]]), of([[0.1, 0.02], [0.02, 0.3]])
    )


def linear_motion(hold="zero-order", features=(), learner=None, integrator="exact"):
    motion = oa.Motion.from_equations(
        states=[
            oa.State("x", "v", start="y"),
            oa.State("v", "(u - 0.4*v - k*x)/m", learned=learner is not None),
        ],
        outputs=[oa.Output("y", "x")],
        inputs=["u"],
        parameters=[oa.PhysicalParameter("m", 1.3), oa.PhysicalParameter("k", 9.0)],
        hold=hold,
        integrator=integrator,
        substeps=1,
    )
    model = moving(motion, features, learner, substeps=1)
    numbers = model.numbers._replace(theta_aux=np.zeros(2), gain=0 * model.numbers.gain + 2.0)
    return replace(model, numbers=numbers), oa.Noise(of([[1e-4, 0], [0, 0.02]]), of([[0.01]]))


def matrices(model):
    """A, C, where the disturbance enters the state, and the output, by differences of `step`."""
    n, nu = len(model.state_names), len(model.step_inputs)
    base = model.step(np.zeros(n), np.zeros(nu))
    columns = [
        [np.asarray(b - a) for a, b in zip(base, model.step(e, np.zeros(nu)), strict=True)]
        for e in np.eye(n)
    ]
    a, c = (np.stack([column[i] for column in columns], axis=1) for i in (0, 1))
    if model.form.memory == 0:
        return a, c, np.eye(n), np.zeros((len(c), n))
    newest = [
        [float(name == f"{output.name}[k-1]") for output in model.outputs]
        for name in model.state_names
    ]
    return a, c, np.array(newest), np.eye(len(c))


@pytest.mark.parametrize("make", [linear_lagged, linear_motion], ids=["lagged", "motion"])
def test_the_steady_gain_is_that_of_riccatis_equation(make):
    model, noise = make()
    a, c, enters, direct = matrices(model)
    q, cross = enters @ noise.state @ enters.T, enters @ noise.state @ direct.T
    r = direct @ noise.state @ direct.T + noise.output
    p = scipy.linalg.solve_discrete_are(a.T, c.T, q, r, s=cross)
    gain = (a @ p @ c.T + cross) @ np.linalg.inv(c @ p @ c.T + r)
    zeros, ny = np.zeros(len(model.step_inputs)), len(model.outputs)
    record = oa.Record.from_arrays(np.zeros(10), np.zeros((10, ny)), sampling_time=0.1, inputs=["u"],
                                   outputs=[o.name for o in model.outputs])  # fmt: skip
    now = oa.Observer(model, noise).start(record)
    for _ in range(400):
        now = now.update(zeros, np.zeros(ny))
    np.testing.assert_allclose(now.belief.covariance, p, rtol=0, atol=1e-8 * np.abs(p).max())
    found = now.update(zeros, np.zeros(ny))
    np.testing.assert_allclose(found.latest.spread, c @ p @ c.T + r, rtol=1e-8)
    for i, unit in enumerate(np.eye(ny)):
        moved = np.asarray(now.update(zeros, unit).belief.state) - np.asarray(found.belief.state)
        np.testing.assert_allclose(moved, gain[:, i], rtol=0, atol=1e-8 * np.abs(gain).max())


# --- by simulation


def simulated(model, noise, rows, seed, force=1.0):
    """A record of a model with its noises, and its outputs and states without the sensors'."""
    rng = np.random.default_rng(seed)
    n, ny = len(model.state_names), len(model.outputs)
    u = force * rng.normal(size=(rows, 1))
    roots = [np.linalg.cholesky(part + 1e-300 * np.eye(len(part))) for part in noise]
    state, states, truth = np.zeros(n), [], []
    step = oa.numpy_step(model)
    for row in u:
        w = roots[0] @ rng.normal(size=len(roots[0]))
        states.append(state)
        state, y = step(state, row)
        if model.form.memory:  # the disturbance goes on in the lags
            y = y + w
            newest = [model.state_names.index(f"{o.name}[k-1]") for o in model.outputs]
            state = np.array(state)
            state[newest] = y
        else:
            state = state + w
        truth.append(y)
    measured = np.array(truth) + rng.normal(size=(rows, ny)) @ roots[1].T
    return measured, np.array(truth), np.array(states), u


def record_of(model, u, y):
    names = {"inputs": [c.name for c in model.inputs], "outputs": [c.name for c in model.outputs]}
    return oa.Record.from_arrays(u, y, sampling_time=0.1, missing="keep", **names)


def nonlinear_lagged():
    terms = [
        oa.Term("a", "y[k-1]"),
        oa.Term("b", "y[k-2]"),
        oa.Term("g", "tanh(u[k-1]) - 0.1*y[k-1]**3"),
    ]
    model = lagged(terms, ("y[k-1]",), oa.MLP((3,)), ("y",), ("u",))
    numbers = model.numbers._replace(theta=np.array([1.4, -0.6, 0.4]), theta_aux=np.zeros(3))
    return replace(model, numbers=numbers), oa.Noise(of([[0.01]]), of([[0.04]]))


def nonlinear_motion():
    return linear_motion(features=("v",), learner=oa.MLP((4,)), integrator="rk4")


@cache
def tracked(make):
    model, noise = make()
    measured, truth, states, u = simulated(model, noise, 4000, seed=1)
    return oa.Observer(model, noise).run(record_of(model, u, measured)), truth, states


@pytest.mark.parametrize("make", [nonlinear_lagged, nonlinear_motion, linear_lagged])
def test_innovations_are_white_and_as_large_as_expected(make):
    found = tracked(make)[0].consistency()
    assert found.consistent and 0.9 < found.expected[0] < found.nis < found.expected[1] < 1.1
    assert all(test.p > 0.01 for test in found.whiteness)


@pytest.mark.parametrize("make", [nonlinear_lagged, nonlinear_motion, linear_lagged])
def test_bands_hold_95_percent(make):
    run, truth, states = tracked(make)
    (one,) = run.experiments
    rows = slice(one.start + 50, None)
    pairs = [
        (one.outputs, one.outputs_std, truth),
        (one.predicted, one.predicted_std, one.measured),
    ]
    pairs += [(one.states, one.states_std, states)] if run.state_names else []
    for found, std, true in pairs:
        covered = np.mean(np.abs(found - true)[rows] <= 1.96 * std[rows], axis=0)
        assert (covered > 0.925).all() and (covered < 0.975).all()


def test_the_table_has_bands(make=nonlinear_motion):
    run, _, _ = tracked(make)
    table = run.to_frame()
    assert list(table)[:5] == ["time", "y", "y_model", "y_model_low", "y_model_high"]
    for name in ("y_model", "state:x", "state:v"):
        assert (table[f"{name}_low"] < table[name]).all() and (
            table[name] < table[f"{name}_high"]
        ).all()
    assert table["time"][3] == pytest.approx(0.3)


def test_wrong_noises_are_reported():
    model, noise = nonlinear_lagged()
    measured, _, _, u = simulated(model, noise, 1000, seed=2)
    found = oa.Observer(model, oa.Noise(0.3 * noise.state, 0.3 * noise.output)).run(
        record_of(model, u, measured)
    )
    assert not found.consistency().consistent and found.consistency().nis > 2


def test_the_likelihood_finds_the_noises():
    model, noise = nonlinear_motion()
    measured, _, _, u = simulated(model, noise, 3000, seed=3)
    begun = oa.Observer(model, oa.Noise(10 * noise.state, 0.2 * noise.output))
    found = begun.tuned(record_of(model, u, measured)).noise
    np.testing.assert_allclose(found.state, noise.state, rtol=0.3)
    np.testing.assert_allclose(found.output, noise.output, rtol=0.1)


# --- predictions and gaps


@pytest.mark.parametrize("horizon", [1, 4])
def test_without_sensor_noise_it_is_the_prediction_from_measured_lags(horizon):
    model, noise = nonlinear_lagged()
    measured, _, _, u = simulated(model, noise, 300, seed=4)
    record = record_of(model, u, measured)
    observer = oa.Observer(model, oa.Noise(noise.state, 0 * noise.output))
    (ours,), (plain,) = (
        observer.predict(record, horizon).trajectories,
        model.predict(record, horizon).trajectories,
    )
    np.testing.assert_allclose(ours.model, plain.model, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(ours.learner, plain.learner, rtol=1e-9, atol=1e-12)
    assert ours.start == plain.start and np.isfinite(ours.std[ours.start :]).all()


def test_a_motion_from_an_estimated_state():
    model, noise = nonlinear_motion()
    measured, _, _, u = simulated(model, noise, 2000, seed=5)
    record = record_of(model, u, measured)
    observer = oa.Observer(model, noise)
    ours, plain = observer.predict(record, 5), model.predict(record, 5)
    (one,) = ours.trajectories
    assert one.start == plain.trajectories[0].start
    assert ours.scores().rmse[0] < 1.02 * plain.scores().rmse[0]
    rows = slice(one.start + 50, None)
    assert 0.925 < np.mean(np.abs(one.model - measured)[rows] <= 1.96 * one.std[rows]) < 0.975
    np.testing.assert_allclose(one.baseline + one.learner, one.model)


def test_it_runs_free_where_nothing_is_measured():
    model, noise = nonlinear_lagged()
    measured, _, _, u = simulated(model, noise, 60, seed=6)
    gap = slice(30, 40)
    lost = measured.copy()
    lost[gap] = np.nan
    observer = oa.Observer(model, oa.Noise(noise.state, 0 * noise.output))
    (one,) = observer.run(record_of(model, u, lost)).experiments
    free = model.simulate(record_of(model, u[28:40], measured[28:40])).trajectories[0].model
    np.testing.assert_allclose(one.predicted[gap], free[2:], rtol=1e-9)
    assert (np.diff(one.predicted_std[30:34, 0]) > 0).all() and one.count[gap].sum() == 0
    response = observer.predict(record_of(model, u, lost))
    assert response.scores().samples == 60 - 10 - 2 and np.isfinite(response.scores().rmse).all()


def test_one_of_two_outputs_may_be_missing():
    model, noise = linear_lagged()
    measured, truth, _, u = simulated(model, noise, 600, seed=7)
    lost = measured.copy()
    lost[::2, 0] = np.nan
    lost[:3, 1] = np.nan  # where it starts, too
    (one,) = (found := oa.Observer(model, noise).run(record_of(model, u, lost))).experiments
    assert np.isfinite(one.outputs[3:]).all() and found.consistency().consistent
    assert (one.outputs_std[100:200:2, 0] > one.outputs_std[101:201:2, 0]).all()
    assert np.mean(np.abs(one.outputs - truth)[10:] <= 1.96 * one.outputs_std[10:]) > 0.92


@pytest.mark.parametrize("make", [nonlinear_lagged, nonlinear_motion])
def test_update_is_a_row_of_run(make):
    model, noise = make()
    measured, _, _, u = simulated(model, noise, 20, seed=8)
    measured[10] = np.nan
    record = record_of(model, u, measured)
    observer = oa.Observer(model, noise)
    (one,) = observer.run(record).experiments
    now = observer.start(record)
    for k in range(one.start, 20):
        now = now.update(u[k], measured[k])
        np.testing.assert_allclose(now.outputs, one.outputs[k], rtol=1e-9)
        np.testing.assert_allclose(now.state, one.states[k], rtol=1e-9)
        np.testing.assert_allclose(
            (now.outputs_band[1] - now.outputs) / 1.959963984540054, one.outputs_std[k]
        )
        np.testing.assert_allclose(
            (now.state_band[1] - now.state) / 1.959963984540054, one.states_std[k], atol=1e-12
        )
        assert now.square == pytest.approx(one.square[k])
        assert (now.predicted_band[0] < now.predicted).all()


def test_a_first_order_hold_takes_the_next_inputs_too():
    model, noise = linear_motion(hold="first-order")
    record = record_of(model, np.arange(9.0), np.zeros(9))
    observer = oa.Observer(model, noise)
    now = observer.start(record)
    for k in range(8):
        now = now.update([k, k + 1], [0.0])
    np.testing.assert_allclose(now.state, observer.run(record).experiments[0].states[7], rtol=1e-9)


# --- the noise of a fit


def system(q, r, seed=0, rows=1500):
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=rows), np.zeros(rows)
    for k in range(2, rows):
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + u[k - 1] + q * rng.normal()
    return oa.Record.from_arrays(u, y + r * rng.normal(size=rows))


@pytest.mark.parametrize(
    ("q", "r", "criterion"),
    [(0.1, 0.0, oa.Prediction()), (0.0, 0.3, oa.Simulation()), (0.1, 0.3, oa.Simulation())],
    ids=["equation", "sensor", "both"],
)
def test_the_residual_says_where_the_noise_enters(q, r, criterion):
    fit = oa.estimate(system(q, r), PHYSICS, learner=None, criterion=criterion)
    noise = oa.Observer(fit).noise
    assert noise.state[0, 0] == pytest.approx(q**2, rel=0.15, abs=5e-3 * r**2)
    assert noise.output[0, 0] == pytest.approx(r**2, rel=0.1)
    found = oa.Observer(fit).run(system(q, r, seed=1)).consistency()
    assert found.consistent and found.whiteness[0].p > 0.01


def test_a_model_by_itself_goes_by_how_it_was_trained():
    """And by the verdict that a saved one carries."""
    model = oa.estimate(system(0.1, 0.3), PHYSICS, learner=None, criterion=oa.Simulation()).model
    sensor = by_verdict(model)
    both = by_verdict(
        replace(model, statistics=replace(model.statistics, verdict="equation_noise"))
    )
    assert both.state[0, 0] == pytest.approx(30 * sensor.state[0, 0])
    assert both.output[0, 0] == pytest.approx(sensor.output[0, 0] * 0.1 / 0.97)
    free = replace(model.statistics, simulated=False)
    assert by_verdict(replace(model, statistics=free)).output == 0


def test_a_fit_keeps_noises_by_the_likelihood_of_its_data(tmp_path):
    """Disturbances of a motion make its errors coloured; what share of them they make no rule knows."""
    model, _ = linear_motion(integrator="rk4")
    noise = oa.Noise(of([[0, 0], [0, 0.001]]), of([[0.01]]))
    records = [
        record_of(model, u, y)
        for y, _, _, u in (simulated(model, noise, 2000, seed) for seed in (11, 12))
    ]
    fit = oa.estimate(
        records[0], model.form.motion, learner=None, criterion=oa.Simulation(segment=0, washout=0)
    )
    kept = to_keep(fit, "equation_noise")
    assert kept is not None and to_keep(fit, "white") is None
    statistics = replace(fit.model.statistics, verdict="equation_noise")
    known = replace(statistics, disturbance=kept.state, sensor=kept.output)
    oa.save(replace(fit.model, statistics=known), tmp_path / "model")
    observers = [
        oa.Observer(oa.load(tmp_path / "model")),
        oa.Observer(replace(fit.model, statistics=statistics)),
    ]
    held = []
    for observer in observers:
        (one,) = observer.predict(records[1]).trajectories
        held.append(np.mean((np.abs(one.model - one.measured) <= 1.96 * one.std)[one.start :]))
    np.testing.assert_array_equal(observers[0].noise.output, kept.output)
    assert observers[0].run(records[1]).consistency().consistent
    assert not observers[1].run(records[1]).consistency().consistent
    assert abs(held[0] - 0.95) < 0.015 < 0.3 < abs(held[1] - 0.95)


# --- what is refused


def test_what_it_cannot_observe_is_reported():
    model, noise = nonlinear_lagged()
    with pytest.raises(
        oa.InputError, match="no estimate of its noise .*; give the observer `noise=`"
    ):
        oa.Observer(model)
    with pytest.raises(oa.InputError, match="`model` must be a fitted model or a fit"):
        oa.Observer("model")
    wrong = [
        (
            oa.Noise(np.eye(2), noise.output),
            r"`noise.state` has the shape \(2, 2\); expected \(1, 1\)",
        ),
        (oa.Noise(noise.state, -noise.output), "`noise.output` is no covariance"),
        (oa.Noise(noise.state, of([[np.nan]])), "`noise.output` is no covariance"),
        (oa.Noise(noise.state, "x"), "`noise.output` is not a matrix of numbers"),
        (
            oa.Noise(0 * noise.state, 0 * noise.output),
            "the sensors' covariance must be positive definite",
        ),
        ((noise.state, noise.output), r"`noise` must be an oa.Noise\(state, output\)"),
    ]
    for given, message in wrong:
        with pytest.raises(oa.InputError, match=message):
            oa.Observer(model, given)


def test_what_is_no_sample_is_reported():
    model, noise = nonlinear_lagged()
    record = record_of(model, np.zeros(20), np.zeros(20))
    observer = oa.Observer(model, noise)
    now = observer.start(record)
    for inputs, outputs, message in (
        ([np.nan], [0.0], "`inputs` must be finite; got"),
        ([0.0], [np.inf], "`outputs` must be finite or NaN"),
        ([0.0, 1.0], [0.0], r"`inputs` must have 1 numbers; got the shape \(2,\)"),
        ([0.0], ["x"], "`outputs` must be a vector of numbers"),
    ):
        with pytest.raises(oa.InputError, match=message):
            now.update(inputs, outputs)
    with pytest.raises(oa.InputError, match="no sample has been measured yet"):
        _ = now.outputs
    with pytest.raises(oa.InputError, match="`row` must be a whole number from 2 to 20"):
        observer.start(record, 1)
    with pytest.raises(oa.InputError, match="`horizon` must be a whole number of steps"):
        observer.predict(record, 0)
    with pytest.raises(oa.InputError, match="has 2 rows, too few"):
        observer.run(record.rows(0, 2))


def test_an_estimate_without_bounds_is_reported():
    terms = [oa.Term("a", "y[k-1]**3"), oa.Term("g", "u[k-1]")]
    model = lagged(terms, (), None, ("y",), ("u",))
    model = replace(
        model, numbers=model.numbers._replace(theta=np.array([2.0, 1.0]), theta_aux=np.zeros(2))
    )
    y = np.full(40, np.nan)
    y[0] = 3.0
    record = record_of(model, np.ones(40), y)
    with pytest.raises(oa.InputError, match=r"row \d+: the estimate diverges there"):
        oa.Observer(model, oa.Noise(of([[1.0]]), of([[1.0]]))).run(record)


@pytest.mark.parametrize("verb", ["simulate", "predict", "components"])
def test_others_refuse_missing_outputs(verb):
    model, _ = nonlinear_lagged()
    y = np.zeros(20)
    y[7] = np.nan
    with pytest.raises(
        oa.InputError, match="row 7: an output is missing, which is accepted only by a motion"
    ):
        getattr(model, verb)(record_of(model, np.zeros(20), y))


def test_a_fit_refuses_missing_outputs():
    y = np.random.default_rng(0).normal(size=60)
    y[7] = np.nan
    record = oa.Record.from_arrays(np.arange(60.0), y, missing="keep")
    with pytest.raises(oa.InputError, match='row 7: an output is missing, .*`missing = "skip"`'):
        oa.estimate(record, PHYSICS, learner=None)
    with pytest.raises(oa.InputError, match="not finite at row 7"):
        oa.Record.from_arrays(np.arange(60.0), y)


# --- from the shell


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("observed")
    write(folder / "run.csv", rows=200, seed=3)
    (folder / "plant.toml").write_text(SPEC, encoding="utf-8")
    assert run("fit", folder / "plant.toml", "--out", folder / "out").code == 0
    return folder


def table(done) -> np.ndarray:
    assert done.code == 0, done.err
    return np.genfromtxt(done.out.splitlines(), delimiter=",", names=True)


def test_simulate_and_predict_score_what_fit_scored(fitted):
    scores = finite_json((fitted / "out" / "result.json").read_text())["scores"]["train"]
    for verb, kind in (("simulate", "simulation"), ("predict", "prediction")):
        done = run(
            verb,
            fitted / "out",
            fitted / "run.csv",
            "--missing",
            "skip",
            "--out",
            fitted / f"{verb}.csv",
        )
        assert done.code == 0 and "10 rows have missing cells" in done.err and "note: " in done.err
        rows = np.genfromtxt(fitted / f"{verb}.csv", delimiter=",", names=True)
        assert len(rows) == 200 and np.isnan(rows["y_model"][[0, 8, 9, 10]]).all()
        np.testing.assert_allclose(rows["time"], 0.5 * np.arange(200))
        rmse = np.sqrt(np.nanmean((rows["y"] - rows["y_model"]) ** 2))
        assert rmse == pytest.approx(scores[kind]["rmse"][0])


def test_missing_samples_name_the_remedy(fitted):
    done = run("simulate", fitted / "out", fitted / "run.csv")
    assert (done.code, done.out) == (2, "")
    assert one_line(
        done.err,
        "error: ",
        "line 37 (row 35)",
        "the cell is empty",
        "--missing skip leaves such rows out",
    )


def test_an_observer_goes_on_where_outputs_are_missing(fitted):
    found = table(run("predict", fitted / "out", fitted / "run.csv", "--observer"))
    assert len(found) == 200 and found.dtype.names[:5] == (
        "time",
        "y",
        "y_model",
        "y_model_low",
        "y_model_high",
    )
    assert np.isnan(found["y"][8]) and np.isfinite(found["y_model"][[8, 9, 10, 61, 63]]).all()
    assert np.isnan(found["y_model"][[35, 36, 37]]).all()  # no input there, and two lags behind
    inside = (found["y_model_low"] < found["y"]) & (found["y"] < found["y_model_high"])
    there = np.isfinite(found["y"]) & np.isfinite(found["y_model"])
    assert 0.9 < inside[there].mean() <= 1.0


def test_rows_and_columns_are_chosen_as_in_a_spec(fitted):
    text = (fitted / "run.csv").read_text().replace("u,y", "force,pos", 1)
    (fitted / "named.csv").write_text(text)
    names = ("--column", "u=force", "--column", "y=pos", "--missing", "skip")
    whole = table(run("simulate", fitted / "out", fitted / "run.csv", "--missing", "skip"))
    part = table(run("simulate", fitted / "out", fitted / "named.csv", *names, "--rows", "80:150"))
    np.testing.assert_allclose(part["y"], whole["y"][80:150])
    thinned = table(
        run(
            "predict",
            fitted / "out",
            fitted / "named.csv",
            *names,
            "--rows",
            "80:150",
            "--every",
            "2",
        )
    )
    np.testing.assert_allclose(thinned["y"], whole["y"][80:150:2])
    # The file's own, at the model's sampling time
    assert thinned["time"][1] - thinned["time"][0] == 0.5
    assert thinned["time"][0] == 80 * 0.25


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--missing", "drop"], ["--missing must be one of error, skip, keep; got 'drop'"]),
        (["--every", "0"], ["--every: found 0; expected 1 or more"]),
        (["--rows", "9"], ["--rows: found '9'"]),
        (["--column", "y"], ["--column: found 'y'; expected NAME=COLUMN"]),
        (["--column", "w=u"], ["--column: 'w' is no channel of the model"]),
        (["--column", "y=other"], ["--column: found y=other, but ", "has no column 'other'"]),
        (["--column", "y=w"], ["no column 'w'"]),
        (
            ["--missing", "skip", "--initial", "zero"],
            ["each stretch starts from its own outputs", "leave --initial out"],
        ),
        (
            ["--missing", "skip", "--horizon", "190"],
            ["the longest stretch between missing samples has 129 rows"],
        ),
        (["--observer", "--initial", "zero"], ["--initial", "--observer"]),
        (
            ["--observer", "--horizon", "0"],
            ["`horizon` must be a whole number of steps, 1 or more; got 0"],
        ),
    ],
    ids=str,
)
def test_wrong_options_are_reported(fitted, options, words, tmp_path):
    done = run(
        "predict", fitted / "out", fitted / "run.csv", *options, "--out", tmp_path / "out.csv"
    )
    assert (done.code, done.out) == (2, "") and not (tmp_path / "out.csv").exists()
    assert one_line(done.err.splitlines()[-1] + "\n", "error: ", *words)


def test_a_saved_model_carries_the_verdict(fitted, tmp_path):
    model = oa.load(fitted / "out")
    assert (
        model.statistics.verdict
        == finite_json((fitted / "out" / "result.json").read_text())["residuals"]["verdict"]
    )
    assert model.statistics.simulated is False
    oa.save(model, tmp_path / "model")
    assert oa.load(tmp_path / "model").statistics.verdict == model.statistics.verdict != ""


def test_the_band_of_an_observer_that_takes_coloured_errors_for_white_says_so(tmp_path):
    rng = np.random.default_rng(0)
    u = rng.normal(size=800)
    e = scipy.signal.lfilter([1], [1, -0.9], 0.1 * rng.normal(size=800))
    y = np.zeros(800)
    for k in range(1, 800):
        y[k] = 0.5 * y[k - 1] + u[k - 1] + e[k]
    lines = [f"{a:.6f},{b:.6f}" for a, b in zip(u, y, strict=True)]
    (tmp_path / "run.csv").write_text("\n".join(["u,y", *lines]), encoding="utf-8")
    (tmp_path / "plant.toml").write_text(
        '[data]\nsampling_time = 0.1\ninputs = ["u"]\noutputs = ["y"]\n'
        'train.files = ["run.csv"]\n'
        '[[baseline.terms]]\nparameter = "a"\nregressor = "y[k-1]"\n'
        '[[baseline.terms]]\nparameter = "b"\nregressor = "u[k-1]"\n'
        '[noise]\nmodel = "arma"\nar = 1\nma = 0\n',
        encoding="utf-8",
    )
    done = run("fit", tmp_path / "plant.toml", "--out", tmp_path / "out")
    assert done.code == 0, done.err
    given = ("predict", tmp_path / "out", tmp_path / "run.csv", "--observer")
    done = run(*given, "--out", tmp_path / "a.csv")
    wanted = "the observer takes errors for white that the fitted noise model says are coloured"
    assert f"as one of 95 %: {wanted}. Predictions without --observer use the noise" in done.err


def test_a_prediction_says_whether_its_band_is_one_of_95_percent(fitted, tmp_path):
    done = run(
        "predict",
        fitted / "out",
        fitted / "run.csv",
        "--observer",
        "--horizon",
        "2",
        "--out",
        tmp_path / "a.csv",
    )
    assert one_line(
        done.err.splitlines()[-1] + "\n",
        "note: one step ahead, the squared innovations are",
        "(NIS; ",
        "Its 95 % band 2 steps ahead contains 9",
    )
    model = oa.load(fitted / "out")
    small = replace(
        model.statistics,
        disturbance=0.2 * model.statistics.noise,
        sensor=0 * model.statistics.noise,
    )
    oa.save(replace(model, statistics=small), tmp_path / "model")
    done = run(
        "predict", tmp_path / "model", fitted / "run.csv", "--observer", "--out", tmp_path / "b.csv"
    )
    words = ("Do not use the band as one of 95 %: its noises are too small", ".tuned(record)")
    assert done.code == 0 and one_line(
        done.err.splitlines()[-1] + "\n", "warning: the squared innovations are", *words
    )
    rows = np.genfromtxt(tmp_path / "b.csv", delimiter=",", names=True)
    there = np.isfinite(rows["y"]) & np.isfinite(rows["y_model"])
    inside = (rows["y_model_low"] <= rows["y"]) & (rows["y"] <= rows["y_model_high"])
    assert (
        f"Its 95 % band contains {percent(inside[there].mean(), 3)} of the measured values"
        in done.err
    )
    given = ("predict", tmp_path / "model", fitted / "run.csv", "--observer", "--horizon", "4")
    done = run(*given, "--out", tmp_path / "c.csv")
    assert "warning: one step ahead, the squared innovations are" in done.err
    assert "Its 95 % band 4 steps ahead contains" in done.err
    assert "For one step, its noises are too small" in done.err
    assert "For 4 steps, the band is too narrow. oa.Observer" in done.err
