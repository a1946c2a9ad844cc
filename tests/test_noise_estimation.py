"""Noise models of lagged physics: against whole costs minimised by SciPy, exact formulas, and draws."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lfilter
from test_cli import run

import orthaug as oa
from orthaug.physics.noise import NoiseModel, RowFilter

TERMS = {"a1": "y[k-1]", "a2": "y[k-2]", "b1": "u[k-1]", "b2": "u[k-2]"}
PHYSICS = oa.Baseline.from_terms([oa.Term(name, text) for name, text in TERMS.items()])
A, B, C = [1.0, -1.5, 0.7], [0.0, 1.0, 0.5], [1.0, -0.9, 0.2]


def signals(seed: int, rows: int = 600, c: Any = C, d: Any = (1.0,)) -> tuple[Any, Any]:
    rng = np.random.default_rng(seed)
    u, e = rng.normal(size=rows), 0.5 * rng.normal(size=rows)
    return u, lfilter(B, A, u) + lfilter([1.0], A, lfilter(c, d, e))


def record(seed: int, **options: Any) -> oa.Record:
    return oa.Record.from_arrays(*signals(seed, **options))


def innovations(v: np.ndarray, d: Any, c: Any) -> np.ndarray:
    """D/C of one stretch, its first rows past only: the formula, by SciPy."""
    moved = lfilter([1.0, *d], [1.0], v)
    moved[: len(d)] = 0.0
    return np.asarray(lfilter([1.0], [1.0, *c], moved))


def regressors(u: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.column_stack([y[1:-1], y[:-2], u[1:-1], u[:-2]])


@pytest.mark.parametrize(("ar", "ma"), [(0, 2), (1, 2), (2, 0)])
def test_without_a_learner_the_fit_is_the_minimum_of_the_whole_cost(ar: int, ma: int) -> None:
    u, y = signals(0)
    fit = oa.estimate(
        oa.Record.from_arrays(u, y), PHYSICS, learner=None, noise=oa.ARMA(ar=ar, ma=ma)
    )
    noise = fit.model.noise
    assert noise is not None and noise.covariance is not None

    def cost(p: np.ndarray) -> np.ndarray:
        v = y[2:] - regressors(u, y) @ p[:4]
        return innovations(v, p[4 : 4 + ar], p[4 + ar :])

    found = np.concatenate([fit.theta, noise.values])
    tight = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    there = least_squares(cost, found + 0.01, jac="3-point", **tight)
    np.testing.assert_allclose(found, there.x, rtol=1e-6, atol=1e-7)
    variance = 2 * there.cost / (len(y) - 2 - ar - 4 - ar - ma)
    std = np.sqrt(np.diag(np.linalg.inv(there.jac.T @ there.jac)) * variance)
    np.testing.assert_allclose(fit.std, std[:4], rtol=1e-4)
    np.testing.assert_allclose(np.sqrt(np.diag(noise.covariance)), std[4:], rtol=1e-4)
    errors = fit.model.predict(fit.problem.record).errors[:, 0]
    np.testing.assert_allclose(errors[ar:], cost(found)[ar:], atol=1e-10)


def test_it_agrees_with_the_exact_likelihood_of_statsmodels() -> None:
    """statsmodels 0.15.0, SARIMAX(y, exog=u, order=(1, 0, 1)): its values and standard errors."""
    rng = np.random.default_rng(11)
    u, e = rng.normal(size=(4000, 2)), 0.3 * rng.normal(size=4000)
    e[0] = 0.0
    v = lfilter([1.0, 0.5], [1.0, -0.6], e)
    own = oa.Record.from_arrays(u, u @ [1.0, -0.4] + v, inputs=["p", "q"], outputs=["y"])
    physics = oa.Baseline.from_terms([oa.Term("a", "p[k]"), oa.Term("b", "q[k]")])
    fit = oa.estimate(own, physics, learner=None, noise=oa.ARMA(ar=1, ma=1))
    assert fit.model.noise is not None and fit.model.noise.covariance is not None
    np.testing.assert_allclose(fit.theta, [1.0034886, -0.3998449], rtol=1e-4)
    np.testing.assert_allclose(fit.model.noise.values, [-0.61190745, 0.51111622], rtol=1e-3)
    std = np.r_[np.asarray(fit.std), np.sqrt(np.diag(fit.model.noise.covariance))]
    np.testing.assert_allclose(std, [0.00283222, 0.00290687, 0.01463694, 0.01589705], rtol=0.03)


def test_several_stretches_each_begin_by_their_own_conditions() -> None:
    pieces = [signals(seed, rows) for seed, rows in ((1, 300), (2, 61), (3, 200))]
    experiments = tuple(oa.Record.from_arrays(u, y).experiments[0] for u, y in pieces)
    joined = replace(oa.Record.from_arrays(*pieces[0]), experiments=experiments)
    fit = oa.estimate(joined, PHYSICS, learner=None, noise=oa.ARMA(ar=1, ma=1))
    assert fit.model.noise is not None

    def cost(p: np.ndarray) -> np.ndarray:
        left = [(y[2:] - regressors(u, y) @ p[:4]) for u, y in pieces]
        return np.concatenate([innovations(v, p[4:5], p[5:]) for v in left])

    found = np.concatenate([fit.theta, fit.model.noise.values])
    there = least_squares(cost, found + 0.01, jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    np.testing.assert_allclose(found, there.x, rtol=1e-6, atol=1e-7)
    assert fit.problem.samples == sum(len(y) - 3 for _, y in pieces)


def test_two_outputs_have_a_model_each() -> None:
    rng = np.random.default_rng(5)
    u, e = rng.normal(size=500), rng.normal(size=(500, 2)) @ [[0.4, 0.1], [0.0, 0.2]]
    y = lfilter([0.0, 1.0], [1.0, -0.8], u) + lfilter([1.0, 0.6], [1.0, -0.8], e[:, 0])
    z = lfilter([0.0, 0.5], [1.0, -0.5], u) + lfilter(
        [1.0], np.convolve([1, -0.5], [1, -0.7]), e[:, 1]
    )
    two = oa.Record.from_arrays(u, np.column_stack([y, z]), inputs=["u"], outputs=["y", "z"])
    physics = oa.Baseline.from_terms(
        [
            oa.Term("a", "y[k-1]", output="y"),
            oa.Term("b", "u[k-1]", output="y"),
            oa.Term("c", "z[k-1]", output="z"),
            oa.Term("d", "u[k-1]", output="z"),
        ]
    )
    fit = oa.estimate(two, physics, learner=None, noise=oa.ARMA(ar=1, ma=1), output_weights="std")
    assert fit.model.noise is not None

    def cost(p: np.ndarray) -> np.ndarray:
        left = y[1:] - p[0] * y[:-1] - p[1] * u[:-1], z[1:] - p[2] * z[:-1] - p[3] * u[:-1]
        sizes = y[1:].std(), z[1:].std()
        own = [
            innovations(v, p[i : i + 1], p[i + 1 : i + 2])
            for v, i in zip(left, (4, 6), strict=True)
        ]
        return np.concatenate([v / size for v, size in zip(own, sizes, strict=True)])

    found = np.concatenate([fit.theta, fit.model.noise.values])
    there = least_squares(cost, found + 0.01, jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    np.testing.assert_allclose(found, there.x, rtol=1e-6, atol=1e-7)
    assert [one.output for one in fit.noise] == ["y", "z"]
    auto = oa.estimate(two, physics, learner=None, noise="auto")
    assert auto.model.noise is not None and auto.model.noise.orders == ((0, 1), (1, 0))
    assert np.all(np.abs(auto.theta - [0.8, 1.0, 0.5, 0.5]) < 4 * np.asarray(auto.std))


def test_an_autoregression_of_the_errors_is_least_squares_with_more_lags() -> None:
    rng = np.random.default_rng(3)
    y = lfilter([1.0], np.convolve([1, -0.9], [1, 0.4]), rng.normal(size=400))
    own = oa.Record.from_arrays(None, y)
    one = oa.Baseline.from_terms([oa.Term("a", "y[k-1]")])
    fit = oa.estimate(own, one, learner=None, noise=oa.ARMA(ar=1, ma=0))
    two = oa.Baseline.from_terms([oa.Term("a1", "y[k-1]"), oa.Term("a2", "y[k-2]")])
    more = oa.estimate(own, two, learner=None)
    assert fit.model.noise is not None
    a, d = fit.theta[0], fit.model.noise.ar[0, 0]
    np.testing.assert_allclose([a - d, a * d], more.theta, rtol=1e-8)
    np.testing.assert_allclose(
        fit.model.predict(own).model[2:], more.model.predict(own).model[2:], atol=1e-7
    )
    noise = fit.model.statistics.noise, more.model.statistics.noise
    np.testing.assert_allclose(*noise, rtol=1e-8)


def test_white_noise_is_least_squares_bit_by_bit() -> None:
    plain = oa.estimate(record(0), PHYSICS, learner=None)
    white = oa.estimate(record(0), PHYSICS, learner=None, noise="white")
    zero = oa.estimate(record(0), PHYSICS, learner=None, noise=oa.ARMA(ar=0, ma=0))
    for fit in (white, zero):
        np.testing.assert_array_equal(fit.theta, plain.theta)
        np.testing.assert_array_equal(fit.covariance, plain.covariance)
    chosen = oa.estimate(record(1, c=[1.0]), PHYSICS, learner=None, noise="auto")
    assert chosen.model.noise is not None and chosen.model.noise.white
    np.testing.assert_array_equal(
        chosen.theta, oa.estimate(record(1, c=[1.0]), PHYSICS, learner=None).theta
    )
    assert [one.model for one in chosen.noise] == ["white"] and "white" in chosen.summary()


def rig(seed: int, rows: int = 800) -> oa.Record:
    """Physics with friction that it lacks, and coloured noise."""
    rng = np.random.default_rng(seed)
    u, v = rng.normal(size=rows), lfilter(C, [1.0], 0.3 * rng.normal(size=rows))
    y = np.zeros(rows)
    for k in range(2, rows):
        friction = np.tanh(2 * (y[k - 1] - y[k - 2]))
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + u[k - 1] + 0.5 * u[k - 2] - friction + v[k]
    return oa.Record.from_arrays(u, y)


LEARNER = oa.MLP(hidden=(6,), inputs=("y[k-1] - y[k-2]",))


@pytest.fixture(scope="module")
def learned() -> Any:
    return oa.estimate(rig(0), PHYSICS, learner=LEARNER, noise=oa.ARMA(ar=0, ma=2))


def test_the_split_is_orthogonal_in_the_filtered_inner_product(learned: Any) -> None:
    whole = oa.estimate(
        rig(0), PHYSICS, learner=LEARNER, noise=oa.ARMA(ar=0, ma=2),
        structure=oa.Orthogonal(shared="all"),
    )  # fmt: skip
    for fit in (learned, whole):
        problem, model = fit.problem, fit.model
        through = RowFilter(model.noise, problem.lengths)
        phi = through.rows(problem.baseline.on(problem.rows.x, problem.layout, problem.outputs)[0])
        along = phi[:, 0] if model.shared is None else phi[:, 0] @ model.shared
        f = model.learner_at(problem.rows.x)
        rest = through.rows(f)[:, 0] - phi[:, 0] @ model.theta_aux
        sizes = np.linalg.norm(along, axis=0) * np.linalg.norm(through.rows(f))
        assert np.abs(along.T @ rest / sizes).max() < 1e-10
        assert fit.defect < 1e-10
    problem = whole.problem
    through = RowFilter(whole.model.noise, problem.lengths)
    phi = through.rows(problem.baseline.on(problem.rows.x, problem.layout, problem.outputs)[0])[
        :, 0
    ]
    there = np.linalg.lstsq(phi, through.rows(problem.target)[:, 0], rcond=None)[0]
    np.testing.assert_allclose(whole.theta, there, rtol=1e-8)  # generalised least squares


def test_with_a_learner_the_coefficients_are_at_a_stationary_point(learned: Any) -> None:
    problem, model = learned.problem, learned.model
    v = replace(model, noise=None).predict(problem.record).errors
    e, slopes = (
        RowFilter(model.noise, problem.lengths).rows(v),
        RowFilter(model.noise, problem.lengths).slopes(v),
    )
    cosine = slopes[:, 0].T @ e[:, 0] / np.linalg.norm(slopes[:, 0], axis=0) / np.linalg.norm(e)
    assert np.abs(cosine).max() < 1e-4
    raw = np.array([1.5, -0.7, 1.0, 0.5])
    identified = np.array([[1.0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]])
    off = identified @ (learned.theta - raw)
    std = np.sqrt(np.diag(identified @ learned.covariance @ identified.T))
    assert np.all(np.abs(off) < 4 * std)
    white = oa.estimate(rig(0), PHYSICS, learner=LEARNER)
    assert np.abs(identified @ (white.theta - raw))[0] > 4 * std[0]


def test_a_learner_of_terms_is_fitted_with_the_noise_model_exactly() -> None:
    own = rig(2)
    u, y = own.experiments[0].inputs[:, 0], own.experiments[0].outputs[:, 0]
    terms = ("(y[k-1]-y[k-2])**3", "(y[k-1]-y[k-2])**5")
    learner = oa.Terms(terms=terms)
    fit = oa.estimate(
        own, PHYSICS, learner=learner, noise=oa.ARMA(ar=1, ma=1), structure=oa.Additive()
    )
    assert fit.model.noise is not None
    d = y[1:-1] - y[:-2]
    columns = np.column_stack([regressors(u, y), d**3 / 10, d**5 / 100])

    def cost(p: np.ndarray) -> np.ndarray:
        return innovations(y[2:] - columns @ p[:6], p[6:7], p[7:])

    found = fit.model.noise.values
    first = np.concatenate([fit.theta, [-0.3, 0.0], found])
    there = least_squares(cost, first, jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    np.testing.assert_allclose(found, there.x[6:], rtol=1e-5)
    np.testing.assert_allclose(fit.model.predict(own).errors[1:, 0], there.fun[1:], atol=1e-6)


def test_predictions_use_the_noise_model_and_free_runs_do_not() -> None:
    u, y = signals(4, 120, d=(1.0, -0.6))
    own = oa.Record.from_arrays(u, y)
    model = oa.estimate(own, PHYSICS, learner=None, noise=oa.ARMA(ar=1, ma=1)).model
    assert model.noise is not None
    d, c, theta = model.noise.ar[0, 0], model.noise.ma[0, 0], model.theta
    v = y[2:] - regressors(u, y) @ theta
    e = innovations(v, [d], [c])
    for horizon in (1, 3):
        predicted = model.predict(own, horizon).trajectories[0].model[:, 0]
        for k in range(10, 110):
            past, errors, shock = list(y[:k]), list(v[: k - 2]), e[k - 3]
            for j in range(horizon):  # row k + j
                forecast = -d * errors[-1] + (c * shock if j == 0 else 0.0)
                row = np.array([past[-1], past[-2], u[k + j - 1], u[k + j - 2]])
                past.append(row @ theta + forecast)
                errors.append(forecast)
            assert predicted[k + horizon - 1] == pytest.approx(past[-1], abs=1e-10)
    free = replace(model, noise=None)
    np.testing.assert_array_equal(model.simulate(own).model, free.simulate(own).model)


def test_saved_models_keep_it(tmp_path: Path, learned: Any) -> None:
    oa.save(learned.model, tmp_path / "model")
    loaded: Any = oa.load(tmp_path / "model")
    assert loaded.noise.orders == learned.model.noise.orders
    np.testing.assert_array_equal(loaded.noise.values, learned.model.noise.values)
    np.testing.assert_array_equal(loaded.noise.covariance, learned.model.noise.covariance)
    own = learned.problem.record
    np.testing.assert_array_equal(loaded.predict(own).model, learned.model.predict(own).model)


def test_other_measures_split_the_same_function(learned: Any) -> None:
    again = learned.split(oa.Training())
    np.testing.assert_allclose(again.theta, learned.theta, rtol=1e-8)
    np.testing.assert_allclose(again.std, learned.std, rtol=0.05)  # but for η in the inner product
    other = learned.split(oa.Uniform())
    assert other.std is not None and np.isfinite(other.std).all()
    own = learned.problem.record
    np.testing.assert_allclose(
        other.model.predict(own).model, learned.model.predict(own).model, atol=1e-9
    )
    std = np.concatenate(oa.prediction_std(learned.model, own))
    assert np.isfinite(std[2:]).all() and np.median(std[2:]) < 0.3


def test_a_parameter_at_a_bound_is_a_known_term() -> None:
    bounded = oa.Baseline.from_terms(
        [oa.Term(n, t, max=0.9 if n == "b1" else None) for n, t in TERMS.items()]
    )
    fit = oa.estimate(record(0), bounded, learner=None, noise=oa.ARMA(ar=0, ma=2))
    known = oa.Baseline.from_terms(
        [
            oa.Term(n, t, initial=0.9 if n == "b1" else 0.0, fixed=n == "b1")
            for n, t in TERMS.items()
        ]
    )
    fixed = oa.estimate(record(0), known, learner=None, noise=oa.ARMA(ar=0, ma=2))
    assert fit.at_bound == {"b1": 0.9} and np.isnan(np.asarray(fit.std)[2])
    np.testing.assert_allclose(np.delete(fit.theta, 2), fixed.theta, rtol=1e-4)
    np.testing.assert_allclose(np.delete(fit.std, 2), fixed.std, rtol=1e-3)


def test_warnings_speak_of_what_the_noise_model_leaves() -> None:
    own = record(6, rows=1500)
    white = oa.estimate(own, PHYSICS, learner=None)
    found = oa.diagnose(white)
    texts = " ".join(w.text for w in found.warnings)
    assert '[noise] model = "auto"' in texts
    modelled = oa.diagnose(oa.estimate(own, PHYSICS, learner=None, noise="auto"))
    assert not modelled.warnings and modelled.verdict == "equation_noise"
    short = oa.diagnose(oa.estimate(own, PHYSICS, learner=None, noise=oa.ARMA(ar=1, ma=0)))
    left = [w for w in short.warnings if w.code == "coloured_residual"]
    assert left and "noise model leaves" in left[0].text


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"noise": "innovations"}, "is for motions"),
        ({"noise": "pink"}, "must be white, arma, auto"),
        ({"noise": "auto", "criterion": oa.Simulation()}, "one step ahead"),
        ({"noise": "auto", "criterion": oa.Prediction(3)}, "one step ahead"),
        ({"noise": "auto", "solver": oa.AdamLBFGS()}, "levenberg-marquardt"),
        ({"noise": "auto", "restarts": 2, "ensemble": True, "learner": LEARNER}, "ensemble"),
        ({"noise": "auto", "engine": oa.Stream()}, "memory"),
    ],
)
def test_what_a_noise_model_is_not_for_is_refused(options: Any, words: str) -> None:
    given: Any = {"learner": None, **options}
    with pytest.raises(oa.InputError, match=words):
        oa.estimate(record(0), PHYSICS, **given)


def test_orders_beyond_the_rows_are_refused_or_not_tried() -> None:
    few, fixed = record(0)[:60], oa.ARMA(ar=40, ma=0)
    with pytest.raises(oa.InputError, match=r"ar = 40 and ma = 0 leave 18 of 58 rows for 4. unkn"):
        oa.estimate(few, PHYSICS, learner=None, noise=fixed)
    chosen = oa.ARMA(ar="auto", ma=0, largest=80)
    fit = oa.estimate(few, PHYSICS, learner=None, noise=chosen)
    assert fit.status.ok and len(fit.noise[0].coefficients) < 10


def test_coefficients_of_a_model_are_named_and_reflected() -> None:
    noise = NoiseModel.of(((1, 0), (0, 2)), [-0.5, -2.5, 1.0])
    assert noise.names(["y", "z"]) == [("y", "ar1"), ("z", "ma1"), ("z", "ma2")]
    assert str(noise) == "AR(1), MA(2)" and not noise.invertible
    mirrored = noise.reflected()
    assert mirrored.invertible
    np.testing.assert_allclose(mirrored.ma[1], [-1.0, 0.25])  # roots 2 and 0.5: both at 0.5


SPEC = """
[data]
sampling_time = 0.1
inputs = ["u"]
outputs = ["y"]
train = { files = ["run.csv"] }
[[baseline.terms]]
parameter = "a1"
regressor = "y[k-1]"
[[baseline.terms]]
parameter = "a2"
regressor = "y[k-2]"
[[baseline.terms]]
parameter = "b1"
regressor = "u[k-1]"
[[baseline.terms]]
parameter = "b2"
regressor = "u[k-2]"
[learner]
kind = "none"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("noise")
    np.savetxt(
        place / "run.csv", np.column_stack(signals(7)), delimiter=",", header="u,y", comments=""
    )
    return place


@pytest.mark.usefixtures("without_figures", "without_trials")
def test_a_spec_declares_it_and_the_result_has_it(folder: Path) -> None:
    (folder / "spec.toml").write_text(SPEC + '[noise]\nmodel = "auto"\nlargest = 2\n')
    done = run("fit", folder / "spec.toml", "--out", folder / "out")
    assert done.code == 0, done.err
    assert "noise       y: MA(2), ma1 = " in done.out
    result = json.loads((folder / "out" / "result.json").read_text())
    (noise,) = result["noise"]
    assert (noise["model"], noise["ar"], noise["ma"]) == ("MA(2)", 0, 2)
    first = noise["coefficients"][0]
    assert first["name"] == "ma1" and first["ci95"][0] < -0.9 < first["ci95"][1]
    assert noise["innovations_std"] == pytest.approx(0.5, rel=0.1) and noise["white_p"] > 0.01
    assert result["status"]["loss"] <= result["status"]["start_loss"]
    values = [one["value"] for one in result["parameters"]]
    fit = oa.estimate(record(7), PHYSICS, learner=None, noise=oa.ARMA(ar=0, ma=2))
    np.testing.assert_allclose(values, fit.theta, rtol=1e-6)
    assert "MA(2)" in (folder / "out" / "report.html").read_text()


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ('[noise]\nmodel = "innovations"\n', "is for motions"),
        ('[noise]\nmodel = "pink"\n', "noise.model"),
        ('[noise]\nmodel = "arma"\nar = -1\n', "noise.ar"),
        ('[noise]\nmodel = "auto"\n[training]\nfocus = "simulation"\n', "one step ahead"),
        ('[noise]\nmodel = "auto"\n[training]\nsolver = "adam-lbfgs"\n', "levenberg-marquardt"),
        ('[noise]\nmodel = "auto"\n[engine]\nkind = "stream"\n', "expected memory"),
        ('[noise]\nmodel = "auto"\n[training]\nensemble = true\nrestarts = 2\n', "ensemble"),
    ],
)
def test_a_spec_that_cannot_have_it_is_bad_input(folder: Path, section: str, words: str) -> None:
    (folder / "bad.toml").write_text(SPEC + section)
    done = run("fit", folder / "bad.toml", "--out", folder / "bad")
    assert done.code == 2 and words in " ".join(done.err.split()), done.err


@pytest.mark.proof
def test_intervals_hold_with_the_noise_model_and_not_without() -> None:
    held, off, plain = [], [], []
    for seed in range(200):
        own = record(100 + seed, rows=1000)
        fit = oa.estimate(own, PHYSICS, learner=None, noise=oa.ARMA(ar=0, ma=2))
        apart = fit.theta - [1.5, -0.7, 1.0, 0.5]
        off.append(apart / np.asarray(fit.std))
        low, high = np.asarray(fit.interval).T
        held.append((low <= fit.theta - apart) & (fit.theta - apart <= high))
        white = oa.estimate(own, PHYSICS, learner=None, standard_errors="plain")
        plain.append((white.theta - [1.5, -0.7, 1.0, 0.5]) / np.asarray(white.std))
    assert 0.93 <= np.mean(held) <= 0.97
    assert np.abs(np.mean(off, axis=0)).max() < 0.25  # 1/√200 is 0.07
    assert np.abs(np.mean(plain, axis=0)).max() > 3


def test_innovations_that_are_not_white_are_called_so() -> None:
    """A summary said "white with p = 5.7e-11"."""
    rng = np.random.default_rng(2)
    u, e, y = rng.normal(size=600), 0.3 * rng.normal(size=600), np.zeros(600)
    for k in range(2, 600):
        y[k] = 0.5 * y[k - 1] + u[k - 1] + e[k] + 0.9 * e[k - 2]
    record = oa.Record.from_arrays(u, y)
    physics = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]")])
    for ma, text in ((1, "not white (p = "), (2, "white with p = ")):
        fit = oa.estimate(record, physics, noise=oa.ARMA(ar=0, ma=ma))
        assert f", {text}" in fit.noise[0].text and text in fit.summary()
