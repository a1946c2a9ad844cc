"""The estimators for scikit-learn: its own checks, its tools, and the numbers of `estimate`."""

from __future__ import annotations

import pickle
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

import orthaug as oa

sklearn = pytest.importorskip("sklearn")

from sklearn.base import clone  # noqa: E402
from sklearn.exceptions import NotFittedError  # noqa: E402
from sklearn.linear_model import LinearRegression  # noqa: E402
from sklearn.metrics import r2_score  # noqa: E402
from sklearn.model_selection import GridSearchCV, GroupKFold, cross_val_score  # noqa: E402
from sklearn.pipeline import make_pipeline  # noqa: E402
from sklearn.preprocessing import StandardScaler  # noqa: E402
from sklearn.utils.estimator_checks import check_estimator  # noqa: E402

SMALL = oa.MLP(hidden=(3,))
NARX_CANNOT = {  # by what it is: predict(X, y) looks back from each row at measured outputs
    "check_estimators_unfitted", "check_n_features_in_after_fitting", "check_estimators_dtypes", "check_dtype_object",
    "check_estimators_nan_inf", "check_estimators_pickle", "check_f_contiguous_array_estimator",
    "check_regressors_train", "check_regressor_data_not_an_array", "check_regressors_int", "check_supervised_y_2d",
    "check_methods_sample_order_invariance", "check_methods_subset_invariance", "check_dict_unchanged",
    "check_fit_idempotent", "check_fit2d_predict1d",
    # more parameters than rows, and y equal to a column of X: lags that depend on each other
    "check_regressor_multioutput", "check_regressors_no_decision_function",
}  # fmt: skip


def statuses(estimator, **options):
    with np.errstate(all="ignore"):
        found = check_estimator(estimator, on_skip=None, **options)
    return {
        kind: {one["check_name"] for one in found if one["status"] == kind}
        for kind in ("passed", "skipped")
    }


def static(rows=80):
    rng = np.random.default_rng(0)
    X = pd.DataFrame({"speed": rng.uniform(1, 3, rows), "angle": rng.uniform(-1, 1, rows)})
    return X, 0.4 * X["speed"] ** 2 + np.sin(3 * X["angle"]) + 0.01 * rng.normal(size=rows)


def experiment(rows, seed):
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=rows), np.zeros(rows)
    for k in range(1, rows):
        y[k] = 0.8 * y[k - 1] + 0.5 * u[k - 1] - 0.1 * y[k - 1] ** 3 + 0.01 * rng.normal()
    return u, y


@pytest.fixture(scope="module")
def records():
    """Arrays, groups, and the same as a Record."""
    runs = [experiment(60, seed) for seed in range(4)]
    X, y = np.concatenate([u for u, _ in runs])[:, None], np.concatenate([y for _, y in runs])
    record = oa.Record.join([oa.Record.from_arrays(u, y, inputs=["x0"]) for u, y in runs])
    return X, y, np.repeat(["d", "a", "c", "b"], 60), record


@pytest.fixture(scope="module")
def narx(records):
    X, y, groups, _ = records
    return oa.AugmentedNARX({"pole": "y[k-1]", "gain": "x0[k-1]"}, learner=SMALL).fit(X, y, groups)


def test_the_checks_of_scikit_learn_pass_and_none_is_skipped_but_its_own():
    found = statuses(oa.AugmentedRegressor(), on_fail="raise")
    assert found["skipped"] == statuses(LinearRegression(), on_fail="raise")["skipped"]
    assert len(found["passed"]) > 35


def test_the_checks_that_a_narx_can_pass():
    expected = dict.fromkeys(NARX_CANNOT, "predict needs y")
    found = statuses(
        oa.AugmentedNARX(learner=None), on_fail="raise", expected_failed_checks=expected
    )
    assert len(found["passed"]) > 20 and not found["passed"] & NARX_CANNOT


def test_static_numbers_are_those_of_estimate():
    X, y = static()
    model = oa.AugmentedRegressor(
        {"drag": "speed**2"},
        learner=oa.MLP(hidden=(3,), inputs=("angle",)),
        restarts=2,
        random_state=3,
    ).fit(X, y)
    record = oa.Record.from_arrays(X, y, inputs=["speed", "angle"])
    baseline = oa.Baseline.from_terms([oa.Term("drag", "speed[k]**2")])
    learner = oa.MLP(hidden=(3,), inputs=("angle[k]",))
    fit = oa.estimate(
        record, baseline, lags=oa.Lags(nb=1, nk=0), learner=learner, restarts=2, seed=3
    )
    np.testing.assert_array_equal(model.theta_, fit.theta)
    np.testing.assert_array_equal(model.theta_interval_, fit.interval)
    pd.testing.assert_frame_equal(model.coef_table_, fit.parameters)
    values, std = model.predict(X, return_std=True)
    np.testing.assert_array_equal(values, fit.model.predict(record).model[:, 0])
    np.testing.assert_array_equal(std, oa.prediction_std(fit.model, record)[0][:, 0])
    assert model.score(X, y) == r2_score(y, values) > 0.999
    assert 0.008 < model.noise_std_[0] < 0.012
    assert list(model.feature_names_in_) == ["speed", "angle"] and model.n_features_in_ == 2
    again = pickle.loads(pickle.dumps(model))
    np.testing.assert_array_equal(again.predict(X), values)
    assert not hasattr(clone(model), "theta_")


def test_the_default_physics_is_least_squares():
    X, y = static()
    model = oa.AugmentedRegressor(learner=None).fit(X, y)
    line = LinearRegression().fit(X, y)
    np.testing.assert_allclose(model.theta_, [line.intercept_, *line.coef_], rtol=1e-10)
    np.testing.assert_allclose(model.predict(X), line.predict(X), rtol=1e-10)
    assert list(model.coef_table_.index) == ["intercept", "speed", "angle"]


@pytest.mark.parametrize(
    ("physics", "names"),
    [
        (["x0**2", "x1"], ["theta1", "theta2"]),
        ([oa.Term("a", "x0**2", unit="N"), oa.Term("b", "x1[k]")], ["a", "b"]),
        (
            oa.Baseline.from_terms([oa.Term("a", "c*x0[k]**2"), oa.Term("b", "x1[k]")], {"c": 1.0}),
            ["a", "b"],
        ),
        (lambda x: oa._base.jax.jnp.stack([x[0] ** 2, x[1]])[None], ["theta1", "theta2"]),
    ],
    ids=["expressions", "terms", "baseline", "function"],
)
def test_ways_to_write_the_physics(physics, names):
    X, y = static()
    model = oa.AugmentedRegressor(physics, learner=None).fit(X.to_numpy(), y)
    phi = np.column_stack([X["speed"] ** 2, X["angle"]])
    np.testing.assert_allclose(model.theta_, np.linalg.lstsq(phi, y, rcond=None)[0], rtol=1e-10)
    assert list(model.coef_table_.index) == names


def test_columns_of_any_name():
    X, y = static()
    X = X.rename(columns={"speed": "speed (m/s)", "angle": "sin"})
    model = oa.AugmentedRegressor(["x0**2", "sin(x1)"], learner=None).fit(X, y.rename("force"))
    phi = np.column_stack([X.iloc[:, 0] ** 2, np.sin(X.iloc[:, 1])])
    np.testing.assert_allclose(model.theta_, np.linalg.lstsq(phi, y, rcond=None)[0], rtol=1e-10)
    assert model.output_names_ == ("force",)
    taken = oa.AugmentedRegressor(learner=None).fit(pd.DataFrame({"y": X["sin"]}), y.rename("y"))
    assert taken.output_names_ == ("y_",)


def test_a_column_called_intercept_keeps_the_other_one():
    X, y = static()
    model = oa.AugmentedRegressor(learner=None).fit(X.rename(columns={"angle": "intercept"}), y)
    assert list(model.coef_table_.index) == ["intercept_", "speed", "intercept"]
    np.testing.assert_allclose(
        model.predict(X.rename(columns={"angle": "intercept"})),
        LinearRegression().fit(X, y).predict(X),
    )


def test_several_outputs():
    X, y = static()
    both = np.column_stack([y, 2 * y + X["angle"]])
    model = oa.AugmentedRegressor({"drag": "speed**2", "turn": "angle"}, learner=None).fit(X, both)
    assert list(model.coef_table_.index) == ["drag_y0", "drag_y1", "turn_y0", "turn_y1"]
    values, std = model.predict(X, return_std=True)
    assert values.shape == std.shape == both.shape
    for j in range(2):
        alone = oa.AugmentedRegressor({"drag": "speed**2", "turn": "angle"}, learner=None).fit(
            X, both[:, j]
        )
        np.testing.assert_allclose(values[:, j], alone.predict(X), rtol=1e-9)
        np.testing.assert_allclose(model.noise_std_[j], alone.noise_std_[0], rtol=0.05)
    shared = [oa.Term("drag", "speed**2", output="a"), oa.Term("drag", "2*speed**2", output="b")]
    fitted = oa.AugmentedRegressor(shared, learner=None).fit(
        X, pd.DataFrame(both, columns=["a", "b"])
    )
    assert fitted.theta_.shape == (1,)


def test_tools_of_scikit_learn():
    X, y = static()
    pipe = make_pipeline(StandardScaler(), oa.AugmentedRegressor(learner=None))
    grid = {"augmentedregressor__learner": [None, oa.Terms(["x1**3", "x0**2"])]}
    search = GridSearchCV(pipe, grid, cv=3, error_score="raise").fit(X, y)
    assert search.best_params_ == {"augmentedregressor__learner": oa.Terms(["x1**3", "x0**2"])}
    assert search.score(X, y) > 0.96 > cross_val_score(pipe, X, y, cv=3).max()
    model = oa.AugmentedRegressor(learner=SMALL).set_params(learner=None, structure=oa.Additive())
    assert clone(model).get_params() == model.get_params()


def test_what_is_refused_and_how():
    X, y = static()
    wrong = [
        (
            oa.AugmentedRegressor("speed"),
            X,
            "`physics` must be 'linear', a list of expressions or Terms",
        ),
        (oa.AugmentedRegressor(3), X, "`physics` must be 'linear'.*got 3"),
        (oa.AugmentedRegressor(["speed[k-1]"], learner=None), X, "the rows of X have no order"),
        (
            oa.AugmentedRegressor(["mass*speed"]),
            X,
            "unknown column 'mass'; the columns are speed, angle",
        ),
        (
            oa.AugmentedRegressor({"drag": "sped**2 + 1e3"}),
            X,
            "unknown column 'sped', did you mean",
        ),
        (
            oa.AugmentedRegressor(learner=None),
            X.assign(angle=1.0),
            r"constant \(1\).* PolynomialFeatures .*include_bias",
        ),
        (
            oa.AugmentedRegressor(lambda x: x),
            X,
            r"returned shape \(2,\) for one row; expected \(n_outputs, n_param",
        ),
        (oa.AugmentedRegressor(), X.assign(angle=1.0), "channel 'angle' is constant"),
        (oa.AugmentedRegressor(["speed", "2*speed"]), X, "rank-deficient"),
        (oa.AugmentedRegressor(learner="mlp"), X, "`learner` must be"),
        (oa.AugmentedRegressor(random_state="a"), X, "`random_state` must be a whole number"),
    ]
    for model, x, words in wrong:
        with pytest.raises(oa.InputError, match=words):
            model.fit(x, y)
        with pytest.raises(NotFittedError):
            model.predict(x)
    fitted = oa.AugmentedRegressor(["log(speed)"], learner=None).fit(X, y)
    with pytest.raises(oa.InputError, match="no finite value at row 1 of X"):
        fitted.predict(X.iloc[:2].assign(speed=[1.0, -1.0]))


def test_without_scikit_learn_the_names_are_there_and_say_what_to_install():
    code = (
        "import sys; sys.modules['sklearn'] = None\n"
        "import orthaug as oa\n"
        "for name in ('AugmentedRegressor', 'AugmentedNARX'):\n"
        "    try: getattr(oa, name)()\n"
        "    except oa.InputError as error: print(error)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True
    )
    assert done.stdout.splitlines() == [
        f"{name} needs scikit-learn; install orthaug[sklearn]."
        for name in ("AugmentedRegressor", "AugmentedNARX")
    ]


def test_narx_numbers_are_those_of_estimate(narx, records):
    X, y, groups, record = records
    baseline = oa.Baseline.from_terms([oa.Term("pole", "y[k-1]"), oa.Term("gain", "x0[k-1]")])
    fit = oa.estimate(record, baseline, learner=SMALL)
    np.testing.assert_array_equal(narx.theta_, fit.theta)
    np.testing.assert_array_equal(narx.theta_interval_, fit.interval)
    ahead, free = fit.model.predict(record).model[:, 0], fit.model.simulate(record).model[:, 0]
    np.testing.assert_array_equal(narx.predict(X, y, groups), ahead)
    np.testing.assert_array_equal(narx.simulate(X, y, groups), free)
    there = ~np.isnan(free)
    assert there.sum() == 4 * (60 - narx.first_row_)
    assert narx.score(X, y, groups) == r2_score(y[there], free[there]) > 0.99
    one_step = clone(narx).set_params(score_on="prediction").fit(X, y, groups)
    assert one_step.score(X, y, groups) == r2_score(y[there], ahead[there])


def test_rows_of_a_group_need_not_stand_together(narx, records):
    X, y, groups, _ = records
    # Row 0 of every experiment, row 1 of every one, …
    order = np.argsort(np.tile(np.arange(60), 4), kind="stable")
    mixed = clone(narx).fit(X[order], y[order], groups[order])
    np.testing.assert_array_equal(mixed.theta_, narx.theta_)
    back = np.empty(len(y))
    back[order] = mixed.simulate(X[order], y[order], groups[order])
    np.testing.assert_array_equal(back, narx.simulate(X, y, groups))


def test_where_a_free_run_starts(narx, records):
    X, y, groups, _ = records
    first = narx.simulate(X, y[:1], groups)
    np.testing.assert_array_equal(first[:60], narx.simulate(X[:60], y[:60]))
    np.testing.assert_array_equal(narx.simulate(X[:60]), narx.simulate(X[:60], np.zeros(1)))
    assert narx.simulate(X[:60], [0.5])[1] != first[1]


def test_a_free_run_that_runs_away_scores_less_than_any():
    u, y = experiment(60, 0)
    grown = 1.6 ** np.arange(60.0) + np.random.default_rng(1).normal(size=60)
    narx = oa.AugmentedNARX({"pole": "y[k-1]", "gain": "x0[k-1]"}, learner=None).fit(
        u[:, None], grown
    )
    longer = np.tile(u, 3)[:, None]
    assert narx.score(longer, np.tile(y, 3) + 1) == -np.inf


def test_experiments_are_left_out_by_their_groups(narx, records):
    X, y, groups, record = records
    with sklearn.config_context(enable_metadata_routing=True):
        routed = (
            clone(narx)
            .set_params(learner=None)
            .set_fit_request(groups=True)
            .set_score_request(groups=True)
        )
        found = cross_val_score(
            routed, X, y, cv=GroupKFold(4), params={"groups": groups}, error_score="raise"
        )
    baseline = oa.Baseline.from_terms([oa.Term("pole", "y[k-1]"), oa.Term("gain", "x0[k-1]")])
    expected = []
    for left in range(4):
        parts = [
            oa.Record.join([oa.Record.from_arrays(e.inputs, e.outputs, inputs=["x0"])])
            for e in record.experiments
        ]
        held = parts.pop(left)
        free = oa.estimate(oa.Record.join(parts), baseline, learner=None).model.simulate(held).model
        expected.append(r2_score(held.experiments[0].outputs[1:], free[1:]))
    np.testing.assert_allclose(sorted(found), sorted(expected), rtol=1e-12)


def test_narx_of_several_outputs_and_lags():
    u, y = experiment(80, 0)
    both = np.column_stack([y, np.tanh(2 * y) + 0.1 * np.roll(u, 3)])
    narx = oa.AugmentedNARX(lags=oa.Lags(na=1, nb=2), learner=None).fit(u[:, None], both)
    assert [str(i) for i in narx.coef_table_.index[:4]] == [
        "intercept_y0",
        "intercept_y1",
        "y0_1_y0",
        "y0_1_y1",
    ]
    assert narx.first_row_ == 2 and narx.predict(u[:, None], both).shape == both.shape


def test_of_the_outputs_only_the_first_rows_start_a_free_run(narx, records):
    X, y, groups, _ = records
    behind = np.array(y, dtype=float)
    behind[10:20] = np.nan
    np.testing.assert_array_equal(narx.simulate(X, behind, groups), narx.simulate(X, y, groups))
    behind[0] = np.nan
    with pytest.raises(oa.InputError, match="`initial` is not finite at row 0"):
        narx.simulate(X, behind, groups)


@pytest.mark.parametrize(
    ("label", "words"),
    [(None, "no label at row 3"), (np.nan, "no label at row 3"), (2, "int, str")],
)
def test_labels_of_experiments(narx, records, label, words):
    X, y, _, _ = records
    groups = np.array(["a"] * len(X), dtype=object)
    groups[3] = label
    with pytest.raises(oa.InputError, match=words):
        narx.predict(X, y, groups)


def test_what_sets_a_field_of_a_declaration_names_the_remedy():
    model = oa.AugmentedRegressor(learner=SMALL)
    with pytest.raises(
        oa.InputError,
        match=r'set `learner` itself, in a grid \{"learner": \[oa.MLP\(hidden=…\), …\]\}',
    ):
        model.set_params(learner__hidden=(3,))
    with pytest.raises(ValueError, match="Invalid parameter"):
        model.set_params(learned=None)


def test_what_a_narx_refuses_and_how(narx, records):
    X, y, groups, _ = records
    pole = {"pole": "y[k-1]"}
    wrong = [
        (
            lambda: clone(narx).fit(X, y, groups[:5]),
            r"`groups` has the shape \(5,\); expected one label",
        ),
        (lambda: clone(narx).fit(X, y, np.arange(240)), "group 0 has 1 row, too few"),
        (
            lambda: oa.AugmentedNARX(pole, score_on="both").fit(X, y),
            "`score_on` must be one of simulation, prediction",
        ),
        (lambda: oa.AugmentedNARX(["y[k]"]).fit(X, y), "output that is to be predicted"),
        (lambda: narx.predict(X, y[:5]), r"`y` has the shape \(5, 1\); expected \(240, 1\)"),
        (lambda: narx.simulate(X, np.ones((1, 2))), "`initial` has 2 columns"),
        (lambda: narx.simulate(X, "measured"), "`initial` is not an array of numbers"),
        (lambda: narx.predict(X, np.full(240, np.nan)), "`y` is not finite at row 0"),
    ]
    for call, words in wrong:
        with pytest.raises(oa.InputError, match=words):
            call()
    with pytest.raises(ValueError, match="X has 2 features, but AugmentedNARX is expecting 1"):
        narx.predict(np.column_stack([X, X]), y)
