"""The model: prediction and free run against plain loops, initial values, divergence, channels by name."""

from __future__ import annotations

from dataclasses import replace

import naive
import numpy as np
import pytest

import orthaug as oa
from orthaug import (
    MLP,
    Baseline,
    Channel,
    InputError,
    Lags,
    LevenbergMarquardt,
    Record,
    Term,
    estimate,
)

FEW = LevenbergMarquardt(iterations=5)
NETWORK = MLP(hidden=(3,))
ONE = [
    Term("a", "y[k-1]"),
    Term("b", "gain*sin(u[k-1])"),
    Term("c", "u[k-1]", initial=0.2, fixed=True),
]
TWO = [
    Term("a", "y1[k-1]", output="y1"),
    Term("b", "v[k]", output="y1"),
    Term("b", "tanh(y2[k-1])", output="y2"),
    Term("c", "v[k]*w[k-3]", output="y2"),
]


def two_signals(rng, rows: int, sampling_time: float = 0.5) -> Record:
    """Two inputs and two outputs that hang together loosely and stay bounded."""
    u = rng.normal(size=(rows, 2))
    y = np.zeros((rows, 2))
    for k in range(3, rows):
        y[k, 0] = 0.5 * y[k - 1, 0] + u[k, 0] + 0.1 * np.sin(y[k - 2, 0])
        y[k, 1] = 0.3 * np.tanh(y[k - 1, 1]) + 20 * u[k - 3, 1] * u[k, 0] + 0.1 * rng.normal()
    channels = {
        "inputs": [Channel("v"), Channel("w", "V")],
        "outputs": [Channel("y1", "m"), Channel("y2")],
    }
    return Record.from_arrays(u, y, sampling_time=sampling_time, **channels)


def one_signal(rng, rows: int) -> Record:
    u = rng.normal(size=rows)
    y = np.zeros(rows)
    for k in range(2, rows):
        y[k] = (
            0.6 * y[k - 1] + 0.5 * np.sin(u[k - 1]) + 0.2 * np.cos(u[k - 2]) + 0.05 * rng.normal()
        )
    return Record.from_arrays(u, y)


def alone(rng, rows: int) -> Record:
    """A swinging output without inputs."""
    y = np.ones(rows)
    for k in range(2, rows):
        y[k] = 1.6 * y[k - 1] - 0.8 * y[k - 2] + rng.normal()
    return Record.from_arrays(y=y)


CASES = {
    "fixed term": (
        one_signal,
        Baseline.from_terms(ONE, {"gain": 2.0}),
        Lags(na=2, nb=1, nk=1),
        NETWORK,
    ),
    "no feedback": (
        one_signal,
        Baseline.from_terms([Term("b", "sin(u[k])")]),
        Lags(na=0, nb=2, nk=0),
        NETWORK,
    ),
    "input lags longer": (
        one_signal,
        Baseline.from_terms(ONE[:1]),
        Lags(na=1, nb=3, nk=2),
        NETWORK,
    ),
    "physics alone": (one_signal, Baseline.from_terms([*ONE[:1], Term("b", "u[k-4]")]), None, None),
    "two outputs": (
        two_signals,
        Baseline.from_terms(TWO),
        Lags(na=[2, 1], nb=[1, 2], nk=[0, 3]),
        NETWORK,
    ),
    "no inputs": (
        alone,
        Baseline.from_terms([Term("a", "y[k-1]"), Term("b", "y[k-2]")]),
        Lags(na=3),
        NETWORK,
    ),
    "learner inputs": (
        one_signal,
        Baseline.from_terms(ONE[:1]),
        None,
        MLP((3,), inputs=("y[k-2]*u[k-1]", "u[k]")),
    ),
}


@pytest.fixture(scope="module", params=CASES)
def case(request):
    """A model that was fitted shortly, and a new record of 40 rows."""
    make, baseline, lags, learner = CASES[request.param]
    rng = np.random.default_rng(1)
    fit = estimate(
        make(rng, 80), baseline, lags=lags, learner=learner, solver=FEW, regularization=1.0
    )
    return fit.model, make(rng, 40)


@pytest.fixture(scope="module")
def first_order():
    """y[k-1], u[k-1] and a small network: the first usable row is row 1."""
    rng = np.random.default_rng(2)
    baseline = Baseline.from_terms([Term("a", "y[k-1]"), Term("b", "u[k-1]")])
    return estimate(one_signal(rng, 80), baseline, learner=MLP(hidden=(2,)), solver=FEW).model


@pytest.fixture(scope="module")
def pair():
    make, baseline, lags, learner = CASES["two outputs"]
    rng = np.random.default_rng(3)
    return estimate(make(rng, 80), baseline, lags=lags, learner=learner, solver=FEW).model, make(
        rng, 30
    )


def close(found, expected):
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("horizon", [1, 2, 7])
def test_predict_is_a_loop(case, horizon):
    model, record = case
    response = model.predict(record, horizon=horizon)
    assert response.horizon == horizon
    close(response.model, naive.predicted(model, record, horizon))
    assert np.isfinite(response.model).all(axis=1).sum() == 40 - model.form.first_row - horizon + 1


def test_simulate_is_a_loop(case):
    model, record = case
    start, measured = model.form.first_row, record.experiments[0].outputs
    zero = np.zeros((start, measured.shape[1]))
    given = np.random.default_rng(5).normal(size=zero.shape)
    close(model.simulate(record).model, naive.simulated(model, record, measured[:start]))
    close(model.simulate(record, "zero").model, naive.simulated(model, record, zero))
    close(model.simulate(record, given).model, naive.simulated(model, record, given))
    assert model.simulate(record).horizon is None


def test_parts_are_the_loop_s(case):
    model, record = case
    (trajectory,) = model.components(record).trajectories
    start = model.form.first_row
    signals = naive.signals_of(record.experiments[0], record)
    rows = [naive.row(model, signals, k) for k in range(start, len(record))]
    for i, found in enumerate((trajectory.baseline, trajectory.learner, trajectory.learner_before)):
        close(found[start:], [parts[i] for parts in rows])
        assert np.isnan(found[:start]).all()
    close(trajectory.baseline + trajectory.learner, trajectory.model)


def test_simulated_parts_add_up(case):
    model, record = case
    (trajectory,) = model.simulate(record).trajectories
    close(trajectory.baseline + trajectory.learner, trajectory.model)
    assert trajectory.start == model.form.first_row and trajectory.diverged is None


def test_lengths_around_the_padding(first_order):
    whole = one_signal(np.random.default_rng(4), 4098)
    (experiment,) = whole.experiments
    ahead, two_ahead = (naive.predicted(first_order, whole, horizon) for horizon in (1, 2))
    free = naive.simulated(first_order, whole, np.zeros((1, 1)))
    for usable in (1, 255, 256, 257, 4096, 4097):
        n = usable + 1
        record = replace(whole, experiments=(experiment.rows(0, n),))
        close(first_order.predict(record).model, ahead[:n])
        close(first_order.simulate(record, "zero").model, free[:n])
        if usable > 1:
            close(first_order.predict(record, horizon=2).model, two_ahead[:n])


def test_experiments_do_not_meet(first_order):
    rng = np.random.default_rng(6)
    pieces = [one_signal(rng, rows) for rows in (30, 20)]
    both = Record.join(pieces)
    for run in (
        first_order.predict,
        first_order.simulate,
        lambda record: first_order.predict(record, horizon=2),
    ):
        whole = run(both)
        np.testing.assert_array_equal(
            whole.model, np.concatenate([run(piece).model for piece in pieces])
        )
        assert [len(t.model) for t in whole.trajectories] == [30, 20]


def test_channels_are_matched_by_name(pair):
    model, record = pair
    (e,) = record.experiments
    turned = Record.from_arrays(
        np.column_stack([np.zeros(30), e.inputs[:, ::-1]]),
        e.outputs[:, ::-1],
        sampling_time=0.5,
        inputs=["unused", "w", "v"],
        outputs=["y2", "y1"],
    )
    for run in (model.predict, model.simulate, lambda r: model.predict(r, horizon=2)):
        np.testing.assert_array_equal(run(turned).model, run(record).model)
    np.testing.assert_array_equal(
        model.predict(turned).scores().rmse, model.predict(record).scores().rmse
    )


def test_simulate_without_measured_outputs(pair):
    model, record = pair
    (e,) = record.experiments
    only_inputs = Record.from_arrays(e.inputs, sampling_time=0.5, inputs=["v", "w"])
    response = model.simulate(only_inputs, e.outputs[:4])
    np.testing.assert_array_equal(response.model, model.simulate(record).model)
    assert response.trajectories[0].measured is None
    assert "y1" not in response.to_frame()
    with pytest.raises(InputError, match="no measured outputs to compare with"):
        response.scores()
    with pytest.raises(
        InputError, match="no measured outputs to start from; use initial='zero' or give the values"
    ):
        model.simulate(only_inputs)


def test_scores_skip(first_order):
    rng = np.random.default_rng(7)
    record = Record.join([one_signal(rng, 30), one_signal(rng, 20)])
    response = first_order.predict(record)
    measured = [e.outputs for e in record.experiments]
    model = [t.model for t in response.trajectories]

    def rmse(first, second):
        rows = [(m - f)[s:] for m, f, s in zip(measured, model, (first, second), strict=True)]
        return np.sqrt(np.mean(np.concatenate(rows) ** 2))

    assert response.scores().rmse[0] == pytest.approx(rmse(1, 1), rel=1e-12)
    assert response.scores(skip=1).rmse[0] == response.scores().rmse[0]
    assert response.scores(skip=12).rmse[0] == pytest.approx(rmse(12, 12), rel=1e-12)
    assert response.scores(skip=(0, 15)).rmse[0] == pytest.approx(rmse(1, 15), rel=1e-12)
    assert response.scores(skip=25).samples == 5
    assert response.scores(skip=np.int64(12)).samples == 26
    with pytest.raises(InputError, match="no samples are left to score after the first 30"):
        response.scores(skip=30)


def growing(factors, names):
    """Models y_i[k] = factor_i y_i[k-1], exactly."""
    y = np.array(factors) ** np.arange(10)[:, None]
    baseline = Baseline.from_terms(
        [Term(f"a{i}", f"{n}[k-1]", output=n) for i, n in enumerate(names)]
    )
    return estimate(Record.from_arrays(y=y, outputs=names), baseline, learner=None).model


def test_skip_refused(first_order):
    response = first_order.predict(one_signal(np.random.default_rng(7), 30))
    with pytest.raises(InputError, match="`skip`"):
        response.scores(skip=(1, 2))


@pytest.mark.parametrize(
    ("factors", "diverging"), [((2.0, 0.5), "p"), ((0.5, 2.0), "q"), ((1.5, 2.0), "q")]
)
def test_divergence_is_named(factors, diverging):
    """Beyond 10⁶ times the largest training output, 2⁹, there is no value: step 29."""
    model = growing(factors, ["p", "q"])
    (trajectory,) = model.simulate(
        Record.from_arrays(y=np.ones((60, 2)), outputs=["p", "q"])
    ).trajectories
    assert trajectory.diverged == (29, diverging)
    np.testing.assert_allclose(
        trajectory.model[1:29], np.array(factors) ** np.arange(1, 29)[:, None], rtol=1e-12
    )
    for part in (
        trajectory.model,
        trajectory.baseline,
        trajectory.learner,
        trajectory.learner_before,
    ):
        assert np.isnan(part[29:]).all()
    scores = model.simulate(Record.from_arrays(y=np.ones((60, 2)), outputs=["p", "q"])).scores()
    assert np.isnan([scores.rmse, scores.nrmse, scores.fit]).all()


def test_a_run_that_overflows():
    """Squares grow beyond double precision within a few steps: NaN from there on, no warning."""
    y = np.array([0.5, 0.25, 0.0625, 0.00390625])
    model = estimate(
        Record.from_arrays(y=y), Baseline.from_terms([Term("a", "y[k-1]**2")]), learner=None
    ).model
    (trajectory,) = model.simulate(Record.from_arrays(y=np.full(40, 10.0))).trajectories
    assert trajectory.diverged == (3, "y")
    np.testing.assert_allclose(trajectory.model[1:3, 0], [1e2, 1e4], rtol=1e-9)
    assert np.isnan(trajectory.model[3:]).all()


def test_initial_of_a_diverging_run_is_not_scored():
    model = growing((0.5,), ["p"])
    (trajectory,) = model.simulate(
        Record.from_arrays(y=np.full(20, 3.0), outputs=["p"])
    ).trajectories
    assert trajectory.diverged is None and np.isnan(trajectory.model[0, 0])
    np.testing.assert_allclose(trajectory.model[1:, 0], 3.0 * 0.5 ** np.arange(1, 20))


def test_a_free_run_says_where_it_leaves_the_training_data(case):
    """The regressors of the run, made of its own outputs, against the ranges of the learner's features."""
    model, record = case
    (experiment,), start = record.experiments, model.form.first_row
    begun = 5 * experiment.outputs[:start]
    (run,) = model.simulate(record, begun).trajectories
    if not model.learns:
        assert run.outside is None
        return
    own = np.concatenate([begun, run.model[start:]])
    x = model.form.regressors(replace(experiment, outputs=own), record)
    z = np.asarray(model.form.features.evaluate(x, model.form.layout, np))
    z = np.abs((z - model.numbers.centre) / model.numbers.halfwidth)
    np.testing.assert_array_equal(
        run.outside, np.concatenate([np.zeros(start), ~np.all(z <= 1 + 1e-9, axis=1)])
    )
    assert model.components(record).trajectories[0].outside is None


def test_to_frame(pair):
    model, record = pair
    run = model.simulate(record)
    frame = run.to_frame()
    flags, start = frame.pop("extrapolates"), model.form.first_row
    assert (
        flags[:start].isna().all() and (flags[start:] == run.trajectories[0].outside[start:]).all()
    )
    names = [f"{y}{kind}" for y in ("y1", "y2") for kind in ("", "_model", "_baseline", "_learner")]
    assert list(frame.columns) == ["time", *names]
    np.testing.assert_allclose(frame["time"], 0.5 * np.arange(30))
    np.testing.assert_array_equal(frame["y1"], record.experiments[0].outputs[:, 0])
    np.testing.assert_allclose(frame["y2_baseline"] + frame["y2_learner"], frame["y2_model"])
    assert frame["y1_model"].isna().sum() == model.form.first_row == 4


def test_repr(pair):
    model, record = pair
    values = ", ".join(
        f"{name} = {value:.5g}" for name, value in zip("abc", model.theta, strict=True)
    )
    assert repr(model).startswith(f"Model(orthogonal, {values}, learner: MLP(hidden=(3,)")
    free = model.simulate(record)
    shown = repr(free)
    head = "Response(simulation of y1 [m], y2, 1 experiment, 30 samples; root mean squares: y1 physics "
    assert shown.startswith(head) and "; y2 physics " in shown
    assert f"error {free.scores().rmse[0]:.4g} m; y2" in shown and ", learner " in shown
    assert repr(model.simulate(record).trajectories[0]) == "Trajectory(30 samples of 2 outputs)"
    assert repr(model.simulate(record).scores()).startswith("Scores(rmse = ")
    assert repr(model.predict(record, 3)).startswith(
        "Response(3-step prediction of y1 [m], y2, 1 experiment, 30 samples; root mean squares: "
    )
    assert "y1 physics " in repr(model.components(record))
    none = CASES["physics alone"]
    fit = estimate(none[0](np.random.default_rng(0), 30), none[1], learner=None)
    a, b = fit.theta
    assert repr(fit.model) == f"Model(orthogonal, a = {a:.5g}, b = {b:.5g}, learner: none)"


@pytest.mark.parametrize("horizon", [0, -1, 1.5, True, "1", None])
def test_horizon_refused(first_order, horizon):
    with pytest.raises(
        InputError, match=rf"`horizon` must be a whole number of steps, 1 or more; got {horizon!r}"
    ):
        first_order.predict(Record.from_arrays(np.ones(9), np.ones(9)), horizon=horizon)


@pytest.mark.parametrize(
    ("verb", "arguments", "message"),
    [
        ("predict", {"u": np.ones(9)}, "the record lacks the output y of the model; it has none"),
        ("predict", {"y": np.ones(9)}, "the record lacks the input u of the model; it has none"),
        (
            "simulate",
            {"u": np.ones(9), "y": np.ones(9), "inputs": ["f"]},
            "lacks the input u of the model; it has f",
        ),
        (
            "predict",
            {"u": np.ones(9), "y": np.ones(9), "outputs": ["x"]},
            "lacks the output y of the model; it has x",
        ),
        (
            "simulate",
            {"u": np.ones(9), "y": np.ones(9), "sampling_time": 1.1},
            "sampled every 1.1 s, the model every 1 s; resample the record",
        ),
        (
            "predict",
            {"u": np.ones(1), "y": np.ones(1), "source": "a.csv"},
            "a.csv has 1 row, too few: the first value is at row 1",
        ),
        ("simulate", {"u": np.ones(1), "y": np.ones(1)}, "the record has 1 row, too few"),
    ],
)
def test_records_refused(first_order, verb, arguments, message):
    with pytest.raises(InputError, match=message):
        getattr(first_order, verb)(Record.from_arrays(**arguments))


def test_horizon_longer_than_the_record(first_order):
    with pytest.raises(InputError, match="has 9 rows, too few: the first value is at row 20"):
        first_order.predict(Record.from_arrays(np.ones(9), np.ones(9)), horizon=20)


@pytest.mark.parametrize(
    ("initial", "message"),
    [
        (np.zeros((4, 3)), "`initial` has 3 columns; expected one per output, 2"),
        (
            np.zeros((1, 2)),
            "`initial` has 1 row; expected the outputs of the 4 rows before the first usable one, "
            "or of at least the last 2 of them",
        ),
        ([[np.nan, 0.0]] * 4, "`initial` is not finite at row 0, channel 0"),
        ("mesured", "`initial` must be 'measured', 'zero' or an array"),
    ],
)
def test_initial_refused(pair, initial, message):
    model, record = pair
    with pytest.raises(InputError, match=message):
        model.simulate(record, initial)


def test_functions_of_a_model_take_a_fit(tmp_path):
    record = one_signal(np.random.default_rng(5), 80)
    fit = estimate(record, Baseline.from_terms(ONE, {"gain": 1.0}), learner=None)
    oa.save(fit, tmp_path / "model")
    assert oa.load(tmp_path / "model").parameters == fit.model.parameters
    assert oa.export(fit, tmp_path / "code", "c") is not None
    assert oa.numpy_step(fit).step_inputs == ("u",)
    assert oa.stability(fit, record).text == oa.stability(fit.model, record).text
    np.testing.assert_array_equal(
        oa.prediction_std(fit, record)[0], oa.prediction_std(fit.model, record)[0]
    )


def test_what_has_no_model_is_refused_in_one_line(tmp_path):
    record = one_signal(np.random.default_rng(5), 30)
    calls = (
        lambda: oa.save(record, tmp_path / "model"),
        lambda: oa.export(record, tmp_path / "code", "c"),
        lambda: oa.numpy_step(record),
        lambda: oa.stability(record, record),
        lambda: oa.prediction_std(record, record),
    )
    for call in calls:
        with pytest.raises(InputError, match="`model` must be a fitted model, or what estimate"):
            call()
    assert list(tmp_path.iterdir()) == []
