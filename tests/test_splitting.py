"""Splits of fitted functions under measures: naive least squares, the paper's data sets, and what no split changes."""

from __future__ import annotations

import json
from functools import partial

import numpy as np
import pytest
from test_cli import run

from orthaug import (
    MLP,
    Additive,
    Baseline,
    InputError,
    Lags,
    LevenbergMarquardt,
    Orthogonal,
    RankError,
    Record,
    Samples,
    Simulation,
    Symmetrized,
    Term,
    Training,
    Uniform,
    Weighted,
    estimate,
    load,
    orthogonalize,
    save,
    synthetic,
)

estimate = partial(estimate, standard_errors="plain")  # robust ones are asked for here

QUICK = LevenbergMarquardt()
WIDE = Uniform({"u[k]": (-0.6, 0.6)})
RNG = np.random.default_rng(2)
ROWS = 300
NET = MLP((4,))


@pytest.fixture
def coarser(monkeypatch):
    """The uniform measure's rule has 2¹² of its 2²⁰ nodes, which integrate smooth functions to rounding as well."""
    monkeypatch.setattr("orthaug.inference.measures._NODES", (1 << 12, 512, 64))


def plant() -> Record:
    """Two inputs and two outputs, coupled, with squares that the physics below does not know."""
    u, y = RNG.uniform(-1, 1, (ROWS, 2)), np.zeros((ROWS, 2))
    for k in range(2, ROWS):
        y[k, 0] = 0.5 * y[k - 1, 0] - 0.2 * y[k - 2, 0] + u[k - 1, 0] + 0.3 * u[k - 1, 1] ** 2
        y[k, 1] = 0.4 * y[k - 1, 1] + 20 * u[k - 1, 1] - 3 * y[k - 1, 0] ** 2
    return Record.from_arrays(u, y + RNG.normal(size=y.shape) * [0.01, 0.2])


TERMS = [
    Term("a", "y1[k-1]", output="y1"),
    Term("b", "u1[k-1]", output="y1"),
    Term("known", "y1[k-2]", initial=-0.2, fixed=True, output="y1"),
    Term("c", "y2[k-1]", output="y2"),
    Term("gain", "u2[k-1]", output="y2"),
    Term("a", "u2[k-1]**2", output="y2"),
]
FIXED = {"y1": lambda x: -0.2 * x["y1[k-2]"], "y2": lambda x: 0.0}


@pytest.fixture(scope="module")
def two():
    """Several outputs, a shared parameter, a fixed term."""
    return estimate(
        plant(), Baseline.from_terms(TERMS), learner=MLP((4,), beyond="free"), solver=QUICK
    )


@pytest.fixture(scope="module")
def curve():
    """The paper's static set 1 with 30 dB noise, briefly trained."""
    example = synthetic.static(1, noise=True)
    return estimate(example.train, example.baseline, learner=NET, solver=QUICK, regularization=1e-4)


def naive(model, x, weight) -> np.ndarray:
    """Φ_μ⁺G_μ at the points x {lag: values}: the model's own prediction of one row at a time, and NumPy."""
    lags = [str(lag) for lag in model.form.layout]
    start, rows, target = model.form.first_row, [], []
    names = [channel.name for channel in (*model.outputs, *model.inputs)]
    many = len(weight)
    signals = {name: np.zeros((many, start + 1)) for name in names}
    for lag, text in zip(model.form.layout, lags, strict=True):
        signals[lag.channel][:, start - lag.lag] = x[text]
    pieces = [
        Record.from_arrays(
            np.stack([signals[c.name][i] for c in model.inputs], axis=1),
            np.stack([signals[c.name][i] for c in model.outputs], axis=1),
            inputs=[c.name for c in model.inputs],
            outputs=[c.name for c in model.outputs],
        )
        for i in range(many)
    ]
    values = model.predict(Record.join(pieces)).model.reshape(many, start + 1, -1)[:, -1]
    columns = {lag.replace("[k-", "_").replace("[k]", "_0").rstrip("]"): x[lag] for lag in lags}
    for j, channel in enumerate(model.outputs):
        block = np.zeros((many, len(model.form.baseline.names)))
        known = np.zeros(many)
        for term in model.form.baseline.terms:
            text = term.regressor.replace("[k-", "_").replace("[k]", "_0").replace("]", "")
            value = eval(text, {}, columns) * np.ones(many)
            if term.output not in (None, channel.name):
                continue
            if term.fixed:
                known += term.initial * value
            else:
                block[:, model.form.baseline.names.index(term.parameter)] += value
        gain = np.sqrt(weight) * model.weight[j, j]
        rows.append(block * gain[:, None])
        target.append((values[:, j] - known) * gain)
    phi, g = np.concatenate(rows), np.concatenate(target)
    size = np.linalg.norm(phi, axis=0)
    return np.linalg.lstsq(phi / size, g, rcond=None)[0] / size


def columns_of(fit, rows=slice(None)):
    """The training regressors by name."""
    x = fit.problem.rows.x[rows]
    return {str(lag): x[:, j] for j, lag in enumerate(fit.problem.layout)}


def grid(fit, count=80):
    """Weighted points of the regressor, keyed."""
    rng = np.random.default_rng(5)
    spread = fit.problem.rows.x.std(axis=0)
    x = rng.normal(size=(count, len(spread))) * spread
    return {str(lag): x[:, j] for j, lag in enumerate(fit.problem.layout)}, rng.uniform(
        0.1, 1, count
    )


@pytest.fixture(params=["two", "curve"])
def fit(request):
    return request.getfixturevalue(request.param)


# --- what a split is


@pytest.mark.parametrize("measure", [Training(), Training(rows=(40, 90)), Symmetrized(), Uniform()])
def test_no_split_changes_a_prediction(fit, measure, coarser):
    found = fit.split(measure).model.predict(fit.problem.record).model
    before = fit.model.predict(fit.problem.record).model
    assert np.nanmax(np.abs(found - before) / np.nanmax(np.abs(before), axis=0)) <= 1e-12


def test_a_free_run_stays_what_it_is(two):
    before = two.model.simulate(two.problem.record).model
    after = two.split(Uniform()).model.simulate(two.problem.record).model
    np.testing.assert_allclose(after, before, rtol=0, atol=1e-11 * np.nanmax(np.abs(before)))


def test_theta_is_least_squares_on_samples(fit):
    points, weights = grid(fit)
    found = fit.split(Samples(points, weights))
    np.testing.assert_allclose(found.theta, naive(fit.model, points, weights), rtol=1e-8)
    assert np.abs(found.theta / fit.theta - 1).max() > 1e-3


def test_theta_is_least_squares_on_weighted_and_mirrored_rows(fit):
    weights = np.random.default_rng(6).uniform(size=len(fit.problem.rows))
    rows = columns_of(fit)
    np.testing.assert_allclose(
        fit.split(Weighted(weights)).theta, naive(fit.model, rows, weights), rtol=1e-8
    )
    both = {lag: np.concatenate([values, -values]) for lag, values in rows.items()}
    ones = np.ones(2 * len(weights))
    np.testing.assert_allclose(
        fit.split(Symmetrized()).theta, naive(fit.model, both, ones), rtol=1e-8
    )


def test_theta_on_a_part_of_the_rows(curve):
    x = columns_of(curve, slice(100, 300))
    found = curve.split(Training(rows=(100, 300)))
    np.testing.assert_allclose(found.theta, naive(curve.model, x, np.ones(200)), rtol=1e-8)
    assert found.measure.points == 200


@pytest.mark.parametrize("measure", [Training(), Symmetrized(), Uniform()])
def test_the_rest_is_orthogonal_under_the_measure(fit, measure, coarser):
    assert 0 < fit.split(measure).defect <= 1e-12


def test_under_the_training_measure_nothing_changes(fit):
    again = fit.split(Training())
    np.testing.assert_allclose(again.theta, fit.theta, rtol=1e-12)
    np.testing.assert_allclose(again.covariance, fit.covariance, rtol=1e-6)
    np.testing.assert_allclose(
        fit.split(Symmetrized()).split(Training()).theta, fit.theta, rtol=1e-12
    )


def test_an_additive_fit_splits_to_least_squares():
    example = synthetic.static(1, noise=True)
    additive = estimate(
        example.train, example.baseline, learner=NET, solver=QUICK, structure=Additive()
    )
    u, y = (getattr(example.train.experiments[0], name)[:, 0] for name in ("inputs", "outputs"))
    exact = np.linalg.lstsq(np.stack([u, u**3], axis=1), y, rcond=None)[0]
    found = additive.split(Training())
    np.testing.assert_allclose(found.theta, exact, rtol=1e-10)
    assert np.abs(additive.theta / exact - 1).max() > 1e-3
    assert additive.std is None and found.std is not None
    assert not any("not unique" in str(text) for text in found.warnings)


def test_a_split_says_what_it_is(curve):
    found = curve.split(WIDE)
    assert (found.model.structure, found.model.measure, found.measure.name) == (
        "orthogonal",
        "uniform",
        "uniform",
    )
    assert "measure     uniform, 1048576 points, 100 % of it within reach" in found.summary()
    assert found.warnings == curve.warnings


def test_a_measure_beyond_the_data_is_warned_of(curve, coarser):
    found = curve.split(Uniform({"u[k]": (-3, 3)}))
    assert found.measure.support == pytest.approx(0.29, abs=0.02)
    assert any(
        "only 29 % of the uniform measure lies within reach of the training data" in str(w)
        for w in found.warnings
    )
    again = found.split(Training())
    assert [w for w in again.warnings if w.code == "measure_beyond_data"] == []


# --- the paper's data sets


@pytest.mark.parametrize("data_set", [2, 3])
def test_the_uniform_measure_finds_the_papers_parameters(data_set, coarser):
    """θ̂ errs by 0.0796 and 0.1433 under the training measure, however good the fit (F3)."""
    example = synthetic.static(data_set)
    for seed in range(2):
        fit = estimate(example.train, example.baseline, seed=seed, regularization="none", blocks=0)
        biased = {2: 0.0795547, 3: 0.1433322}[data_set]
        assert np.linalg.norm(fit.theta - example.theta) == pytest.approx(biased, abs=1e-7)
        assert np.linalg.norm(fit.split(WIDE).theta - example.theta) <= 5e-5


def test_estimate_under_a_measure_is_the_split(coarser):
    example = synthetic.static(3, noise=True)
    given = {"learner": NET, "solver": QUICK}
    direct = estimate(example.train, example.baseline, structure=Orthogonal(measure=WIDE), **given)
    split = estimate(example.train, example.baseline, **given).split(WIDE)
    np.testing.assert_array_equal(direct.theta, split.theta)
    np.testing.assert_array_equal(direct.covariance, split.covariance)
    assert direct.model.measure == "uniform"


# --- every kind of model


def test_a_model_trained_on_its_free_run():
    example = plant()
    given = {
        "learner": NET,
        "solver": LevenbergMarquardt(5),
        "criterion": Simulation(32, 4, 5),
        "blocks": 0,
    }
    fit = estimate(example, Baseline.from_terms(TERMS), **given)
    found = fit.split(Symmetrized())
    rows = columns_of(fit)
    both = {lag: np.concatenate([values, -values]) for lag, values in rows.items()}
    np.testing.assert_allclose(
        found.theta, naive(fit.model, both, np.ones(len(both["u1[k-1]"]))), rtol=1e-8
    )
    assert (found.std > 0).all()


def test_an_ensemble_has_no_standard_errors_and_says_so(coarser):
    example = synthetic.static(3)
    given = {"learner": NET, "solver": QUICK, "restarts": 3, "ensemble": True}
    fit = estimate(example.train, example.baseline, **given)
    found = fit.split(WIDE)
    x = np.linspace(-0.6, 0.6, 401)
    weight = np.r_[1, np.tile([4, 2], 199), 4, 1]  # Simpson's rule
    np.testing.assert_allclose(found.theta, naive(fit.model, {"u[k]": x}, weight), rtol=1e-5)
    before = fit.model.predict(example.test).model
    np.testing.assert_allclose(found.model.predict(example.test).model, before, rtol=0, atol=1e-13)
    assert found.std is None and found.parameters["std"].isna().all()
    assert any("no standard errors" in str(text) for text in found.warnings)


def test_physics_alone_keeps_theta_under_any_measure(coarser):
    example = synthetic.static(1, noise=True)
    fit = estimate(example.train, example.baseline, learner=None)
    found = fit.split(WIDE)
    np.testing.assert_allclose(found.theta, fit.theta, rtol=1e-13)
    np.testing.assert_allclose(found.covariance, fit.covariance, rtol=1e-10)
    np.testing.assert_allclose(found.measure.price, 1, rtol=1e-10)
    assert found.defect is None


def test_a_model_of_another_toolbox(coarser):
    example = synthetic.static(3)
    fit = orthogonalize(
        example.train, example.baseline, lambda x: 0.01 + x - 0.5 * x**2 + 0.1 * x**3
    )
    found = fit.split(WIDE)
    np.testing.assert_allclose(found.theta, [1, 0.1], atol=1e-12)
    assert found.std is None and any("trained elsewhere" in str(text) for text in found.warnings)


def test_a_learner_that_reads_other_lags_than_the_physics():
    """The learner's own lags belong to the measure; those that nobody reads do not."""
    rng = np.random.default_rng(3)
    u = rng.uniform(-1, 1, (200, 1))
    y = u[:, 0] + 0.5 * np.roll(u[:, 0], 1) ** 2
    fit = estimate(
        Record.from_arrays(u, y),
        Baseline.from_terms([Term("gain", "u[k]")]),
        lags=Lags(nb=3, nk=0),
        learner=MLP((3,), inputs=("u[k-1]",)),
        solver=QUICK,
    )
    assert [str(lag) for lag in fit.model.form.used] == ["u[k]", "u[k-1]"]
    found = fit.split(Uniform({"u[k]": (-1, 1), "u[k-1]": (-1, 1)}))
    assert found.theta[0] == pytest.approx(1, abs=1e-3)
    with pytest.raises(InputError, match=r"'u\[k-2\]' is no raw lag that this model reads"):
        fit.split(Uniform({"u[k-2]": (-1, 1)}))


# --- refusals


def test_bounds_hold_under_the_training_measure_only(coarser):
    example = synthetic.static(3)
    bounded = Baseline.from_terms([Term("theta1", "u[k]", max=0.9), Term("theta3", "u[k]**3")])
    with pytest.raises(
        InputError,
        match="theta1 have bounds, which hold under the training measure only.* Drop the b",
    ):
        estimate(example.train, bounded, learner=NET, structure=Orthogonal(measure=WIDE))
    fit = estimate(example.train, bounded, learner=NET, solver=QUICK)
    assert fit.at_bound
    with pytest.raises(
        InputError,
        match="theta1 at a bound: a split under the uniform measure has no bounds",
    ):
        fit.split(WIDE)


@pytest.mark.parametrize(
    ("measure", "error", "message"),
    [
        ("uniform", InputError, r"`measure` must be a measure such as Uniform\(\); got 'uniform'"),
        (
            Uniform({"y[k-1]": (0, 1)}),
            InputError,
            r"'y\[k-1\]' is no raw lag that this model reads",
        ),
        (Samples({"u[k]": [0.3]}), RankError, "under the samples measure"),
        (Samples({"u[k]": [0.0, 0.0, 0.0]}), RankError, "under the samples measure"),
        (
            Samples({"u[k]": [1e200, 1.0]}),
            InputError,
            "the physics is not finite on all points of the samples measure",
        ),
    ],
)
def test_measures_that_do_not_fit(curve, measure, error, message):
    with pytest.raises(error, match=message):
        curve.split(measure)


# --- saved and loaded


@pytest.fixture(scope="module")
def saved(two, tmp_path_factory):
    """The model with several outputs on disk beside its training data."""
    folder = tmp_path_factory.mktemp("saved")
    save(two.model, folder / "model")
    experiment = two.problem.record.experiments[0]
    table = np.hstack([experiment.inputs, experiment.outputs])
    np.savetxt(
        folder / "run.csv", table, fmt="%.17g", delimiter=",", header="u1,u2,y1,y2", comments=""
    )
    return folder


@pytest.mark.parametrize(
    ("options", "measure"),
    [
        ([], Training()),
        (["--measure", "symmetrized"], Symmetrized()),
        (["--measure", "uniform", "--box", "u2[k-1]=-0.5:0.5"], Uniform({"u2[k-1]": (-0.5, 0.5)})),
        (["--rows", "10:200"], Training(rows=(12, 200))),
    ],
)
def test_a_saved_model_splits_the_same(two, saved, options, measure, coarser):
    done = run("split", saved / "model", saved / "run.csv", *options, "--json")
    assert (done.code, done.err) == (0, "")
    rows, expected = json.loads(done.out)["parameters"], two.split(measure)
    np.testing.assert_allclose([row["value"] for row in rows], expected.theta, rtol=1e-10)
    np.testing.assert_allclose([row["std"] for row in rows], expected.std, rtol=1e-8)
    np.testing.assert_allclose([row["ci95"] for row in rows], expected.interval, rtol=1e-8)


def test_a_split_model_is_saved_as_it_is(curve, tmp_path, coarser):
    found = curve.split(WIDE).model
    save(found, tmp_path / "model")
    again = load(tmp_path / "model")
    assert (again.structure, again.measure) == ("orthogonal", "uniform")
    np.testing.assert_array_equal([again.theta, again.theta_aux], [found.theta, found.theta_aux])
