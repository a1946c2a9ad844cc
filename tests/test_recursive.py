"""θ followed online: the batch fit again whatever the structure, gaps, forgetting, intervals, saved states."""

from __future__ import annotations

import importlib.util
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from test_surface import tried

import orthaug as oa
from orthaug.data.regressors import stack_rows
from orthaug.fitting.recursive_rows import whitened_rows

estimate = partial(oa.estimate, standard_errors="plain")  # robust ones are asked for here

ROOT = Path(__file__).resolve().parents[1]
TERMS = [oa.Term("a", "y[k-1]"), oa.Term("b", "y[k-2]"), oa.Term("g", "u[k-1]")]
QUICK = {"regularization": "none"}


def system(seed: int, rows: int = 400, gain: float = 1.0, noise: float = 0.02) -> oa.Record:
    rng = np.random.default_rng(seed)
    u, y = rng.uniform(-1, 1, rows), np.zeros(rows)
    for k in range(2, rows):
        y[k] = (
            0.6 * y[k - 1]
            - 0.2 * y[k - 2]
            + gain * u[k - 1]
            - 0.2 * y[k - 1] ** 3
            + noise * rng.normal()
        )
    return oa.Record.from_arrays(u, y, sampling_time=0.1)


def two_outputs(seed: int) -> oa.Record:
    one, other = system(seed).experiments[0], system(seed + 100).experiments[0]
    y = np.column_stack([one.outputs, 10 * other.outputs + one.outputs])
    return oa.Record.from_arrays(np.column_stack([one.inputs, other.inputs]), y, sampling_time=0.1)


def fitted(record: oa.Record | None = None, **options) -> oa.Estimate:
    given = {"learner": oa.MLP((4,)), **QUICK, **options}
    return estimate(system(0) if record is None else record, oa.Baseline.from_terms(TERMS), **given)


@pytest.fixture(scope="module")
def fit() -> oa.Estimate:
    return fitted()


def shared_gain() -> oa.Estimate:
    terms = [oa.Term("a", "y1[k-1]", output="y1"), oa.Term("a", "y2[k-1]", output="y2")]
    terms += [oa.Term("g", "u1[k-1]", output="y1"), oa.Term("h", "u2[k-1]", output="y2")]
    return estimate(two_outputs(0), oa.Baseline.from_terms(terms), learner=oa.MLP((4,)), **QUICK)


FITS = {
    "orthogonal": fitted,
    "physics alone": lambda: fitted(learner=None),
    "additive": lambda: fitted(structure=oa.Additive()),
    "another measure": lambda: fitted().split(oa.Uniform()),
    "some features": lambda: fitted(learner=oa.MLP((4,), inputs=("y[k-1]",))),
    "ensemble": lambda: fitted(restarts=2, ensemble=True),
    "two outputs": shared_gain,
}


def batch(fit: oa.Estimate, *records: oa.Record) -> np.ndarray:
    """θ of least squares on rows of several records, the learner fixed; by LAPACK on all of them."""
    rows = stack_rows(oa.Record.join(records), fit.model.form.layout)
    phi, target, _ = whitened_rows(fit.model, rows.x, rows.y)
    return np.linalg.lstsq(phi.reshape(target.size, -1), target.ravel(), rcond=None)[0]


@pytest.mark.parametrize("name", FITS)
def test_without_forgetting_it_is_the_batch_fit(name):
    fit = FITS[name]()
    more = two_outputs(1) if name == "two outputs" else system(1)
    online, again = oa.Recursive(fit), oa.Recursive(fit, start="empty")
    online.update(more)
    again.update(fit.problem.record)
    np.testing.assert_allclose(online.theta, batch(fit, fit.problem.record, more), rtol=1e-10)
    np.testing.assert_allclose(again.theta, fit.theta, rtol=1e-10)
    if fit.std is None:
        assert online.std is None and "intervals   none" in online.summary()
    else:  # of coloured errors the robust ones
        result = fit.robust() if len(online._watch.reference.colour) else fit
        found, atol = oa.Recursive(result).covariance, 1e-12 * result.std.max() ** 2
        np.testing.assert_allclose(found, result.covariance, rtol=1e-9, atol=atol)


def test_statistics_are_those_of_physics_alone_on_all_rows():
    fit, more = fitted(learner=None), system(1)
    whole = fitted(oa.Record.join([fit.problem.record, more]), learner=None)
    online = oa.Recursive(fit)
    online.update(more)
    np.testing.assert_allclose(online.theta, whole.theta, rtol=1e-10)
    np.testing.assert_allclose(online.covariance, whole.covariance, rtol=1e-9)
    np.testing.assert_allclose(online.interval, whole.interval, rtol=1e-9)


def test_rows_may_come_one_at_a_time_and_be_saved_between(fit, tmp_path):
    experiment = system(2).experiments[0]
    u, y = experiment.inputs, experiment.outputs
    whole, single = oa.Recursive(fit, memory=2.0), oa.Recursive(fit, memory=2.0)
    whole.update(u=u, y=y)
    for k in range(150):
        single.update(u=u[k], y=y[k])
    single.save(tmp_path / "state")
    resumed = oa.Recursive.load(tmp_path / "state")
    assert repr(resumed) == repr(single)
    for k in range(150, len(u)):
        resumed.update(u=u[k, 0], y=float(y[k, 0]))
    np.testing.assert_allclose(resumed.theta, whole.theta, rtol=1e-13)
    np.testing.assert_allclose(resumed.covariance, whole.covariance, rtol=1e-10)
    np.testing.assert_allclose(resumed.history, whole.history, rtol=1e-9, atol=1e-12)
    assert resumed.alarms == whole.alarms and resumed.rows == len(u)
    np.testing.assert_allclose(resumed.model.theta, whole.theta, rtol=1e-13)


def test_gaps_and_missing_samples_leave_rows_out(fit):
    first, second = system(3, 100), system(4, 120)
    joined, apart, missing = (oa.Recursive(fit) for _ in range(3))
    joined.update(oa.Record.join([first, second]))
    apart.update(first)
    apart.update(second, gap=True)
    np.testing.assert_allclose(apart.theta, joined.theta, rtol=1e-13)
    np.testing.assert_allclose(
        apart.theta, batch(fit, fit.problem.record, first, second), rtol=1e-10
    )
    u, y = (
        np.concatenate([getattr(r.experiments[0], kind) for r in (first, second)])
        for kind in ("inputs", "outputs")
    )
    lost = np.concatenate([y[:100], [[np.nan]], y[100:]])
    missing.update(u=np.insert(u, 100, np.nan, axis=0), y=lost)
    np.testing.assert_allclose(missing.theta, joined.theta, rtol=1e-13)
    assert missing.rows == 221 and not set(missing.history.index) & {0, 1, 100, 101, 102}


def test_forgetting_is_weighted_least_squares(fit):
    """With rows that excite all directions nothing is held back: weights λ^(n−k), the training rows as one memory."""
    factor, more = 0.97, system(5)
    online = oa.Recursive(fit, forgetting=factor)
    online.update(more)
    rows = stack_rows(more, fit.model.form.layout)
    old = whitened_rows(fit.model, fit.problem.rows.x, fit.problem.rows.y)
    new = whitened_rows(fit.model, rows.x, rows.y)
    age = np.arange(len(rows))[::-1]
    share = min(1.0, 1 / (1 - factor) / len(fit.problem.rows)) * factor ** len(rows)
    root = np.sqrt(np.concatenate([np.full(len(fit.problem.rows), share), factor**age]))
    phi, target = (
        np.concatenate([one, other]) for one, other in zip(old[:2], new[:2], strict=True)
    )
    weighted = np.linalg.lstsq(phi[:, 0] * root[:, None], target[:, 0] * root, rcond=None)[0]
    np.testing.assert_allclose(online.theta, weighted, rtol=1e-10)
    assert online.effective_rows == pytest.approx((1 + factor) / (1 - factor), rel=1e-3)


def test_rows_without_excitation_do_not_wind_the_covariance_up(fit):
    """200 memories of nothing: a tenth of a memory's information is left, and θ does not jump when rows speak again."""
    online = oa.Recursive(fit, memory=2.0)
    online.update(system(6))
    recursion, theta = online._recursion, online.theta
    online.update(u=np.zeros(4000), y=np.zeros(4000), gap=True)
    left = np.linalg.svd(recursion.factor_now @ np.linalg.inv(recursion.floor), compute_uv=False)
    assert 0.999 < left.min() < left.max() < 1.2
    np.testing.assert_allclose(online.theta, theta, atol=0.03)
    online.update(system(7, 60), gap=True)
    course = online.history.iloc[-58:]
    assert np.abs(course[["a", "b", "g"]] - theta).max().max() < 0.1
    assert np.isfinite(online.history.to_numpy()).all() and (online.std < 0.1).all()


def test_a_change_is_followed_and_what_no_parameter_explains_raises_the_alarm(tmp_path):
    """The example: m within 5 % after a drift of 20 %; friction doubles, the alarm comes within 2 s, none before."""
    place = importlib.util.spec_from_file_location("online", ROOT / "examples" / "online.py")
    assert place is not None and place.loader is not None
    example = importlib.util.module_from_spec(place)
    place.loader.exec_module(example)
    found = example.main(tmp_path)
    assert found["m"] == pytest.approx(1.2, rel=0.05)
    assert found["delay"] <= 2.0 and found["early"] == 0
    assert (tmp_path / "online.png").stat().st_size > 20_000


def test_physical_parameters_over_time(fit):
    physics = oa.PhysicsMap.of(
        [
            oa.PhysicalParameter("p", 1.0),
            oa.PhysicalParameter("q", 1.0),
            oa.PhysicalParameter("r", 1.0),
        ],
        {"a": "p", "b": "q - p", "g": "2*r"},
    )
    online = oa.Recursive(fit, memory=5.0)
    assert len(online.history) == 0 and len(online.physical_history(physics)) == 0
    online.update(system(7, gain=1.4))
    course, now = online.physical_history(physics, points=5), online.physical(physics)
    assert len(course) == 5 and list(course.columns[:4]) == ["time", "p", "p_low", "p_high"]
    assert course["r"].iloc[-1] == pytest.approx(now.value[2]) == pytest.approx(online.theta[2] / 2)
    assert (course["r_low"] < course["r"]).all() and abs(online.theta[2] - 1.4) < 0.1
    assert list(online.parameters.index) == ["a", "b", "g"]


def test_intervals_count_the_colour_of_the_errors():
    """As the robust errors of the fit do, of a saved model too."""
    rng = np.random.default_rng(3)
    u, e = np.repeat(rng.normal(size=200), 10), rng.normal(size=2000)
    for k in range(1, 2000):
        e[k] += 0.9 * e[k - 1]
    record = oa.Record.from_arrays(u, 2 * u + e)
    fit = estimate(record, oa.Baseline.from_terms([oa.Term("g", "u[k]")]), learner=None)
    robust = fit.robust(60)
    for online in (oa.Recursive(fit), oa.Recursive(fit.model, training=record)):
        assert online.std is not None and online.std[0] > 1.8 * fit.std[0]
        assert online.std[0] == pytest.approx(robust.std[0], rel=0.25)
    np.testing.assert_allclose(oa.Recursive(robust).std, robust.std, rtol=1e-9)


def test_a_saved_model_needs_its_training_data(fit):
    with pytest.raises(
        oa.InputError, match="a saved model does not contain its training data; give them"
    ):
        oa.Recursive(fit.model)
    with pytest.raises(oa.InputError, match="is not the least-squares estimate of these 398 rows"):
        oa.Recursive(fit.model, training=system(8))
    online = oa.Recursive(fit.model, training=system(0))
    np.testing.assert_allclose(online.std, fit.std, rtol=1e-6)
    some = FITS["some features"]()
    np.testing.assert_allclose(
        oa.Recursive(some.model, training=system(0)).std, some.std, rtol=1e-6
    )


def test_what_cannot_be_followed_is_refused(fit):
    flown = fitted(learner=None, criterion=oa.Simulation(), structure=oa.Orthogonal())
    with pytest.raises(
        oa.InputError, match="the fit minimises the free run's error, but recursive least squares"
    ):
        oa.Recursive(flown)
    bounded = estimate(
        system(0),
        oa.Baseline.from_terms([*TERMS[:2], oa.Term("g", "u[k-1]", max=0.5)]),
        learner=None,
    )
    with pytest.raises(oa.InputError, match="g at a bound: new rows would move them across it"):
        oa.Recursive(bounded)
    with pytest.raises(oa.InputError, match=r"`fit` must be what `estimate` returned"):
        oa.Recursive(oa.Motion)  # type: ignore[arg-type]
    with pytest.raises(oa.InputError, match="give `forgetting` or `memory`, not both"):
        oa.Recursive(fit, forgetting=0.9, memory=2.0)
    with pytest.raises(
        oa.InputError, match="`memory` must be at least one sampling time, 0.1 s; got 0.01"
    ):
        oa.Recursive(fit, memory=0.01)
    online = oa.Recursive(fit)
    with pytest.raises(oa.InputError, match=r"`y` has 3 rows but `u` has 2"):
        online.update(u=[1.0, 2.0], y=[1.0, 2.0, 3.0])
    with pytest.raises(
        oa.InputError, match="`u` is missing; give the measured outputs `y` and inputs `u`"
    ):
        online.update(y=1.0)
    with pytest.raises(oa.InputError, match="`y` is not finite at row 0"):
        online.update(u=1.0, y=np.inf)
    with pytest.raises(
        oa.InputError, match="the record is sampled every 1 s, the model every 0.1 s"
    ):
        online.update(oa.Record.from_arrays(np.ones(9), np.ones(9)))
    assert online.rows == 0 and not len(online.history)


def test_arguments_of_every_kind(fit, tmp_path):
    for name in ("forgetting", "memory", "start", "quiet"):
        assert tried(lambda value, name=name: oa.Recursive(fit, **{name: value})) >= 15
    assert tried(oa.Recursive) >= 20 and tried(oa.Recursive.load) >= 20
    online = oa.Recursive(fit)
    assert tried(lambda value: online.update(value, u=1.0, y=1.0)) >= 20
    assert tried(lambda value: online.update(u=1.0, y=value)) >= 12
    assert tried(lambda value: online.physical_history(value)) >= 20  # type: ignore[arg-type]
    assert np.isfinite(online.theta).all()


def test_a_damaged_state_is_refused(fit, tmp_path):
    place = tmp_path / "state"
    oa.Recursive(fit).save(place)
    with pytest.raises(
        oa.InputError, match="no saved recursive estimate there; expected recursive.json"
    ):
        oa.Recursive.load(tmp_path)
    arrays = place / "recursive.safetensors"
    arrays.write_bytes(arrays.read_bytes()[:-8])
    with pytest.raises(oa.InputError, match="the file is cut or altered"):
        oa.Recursive.load(place)
    with pytest.raises(oa.InputError, match="which was changed since orthaug wrote it"):
        oa.Recursive(fit).save(place)
    oa.Recursive(fit).save(place, force=True)
    oa.save(fitted(learner=None).model, place / "model", force=True)
    with pytest.raises(oa.InputError, match="its model is not that of the recursive estimate"):
        oa.Recursive.load(place)
