"""The verb: what it takes, what it refuses, how it ends, and what it says."""

from __future__ import annotations

import dataclasses
import re

import jax
import jax.numpy as jnp
import naive
import numpy as np
import pytest
from helpers import unfolded

import orthaug as oa
from orthaug import (
    MLP,
    AdamLBFGS,
    Additive,
    Auto,
    Baseline,
    Channel,
    Function,
    InputError,
    Lags,
    LevenbergMarquardt,
    Orthogonal,
    Parameter,
    RankError,
    Record,
    Simulation,
    Term,
    estimate,
    orthogonalize,
)
from orthaug._base.progress import StopTraining

LINEAR = MLP(hidden=())
NETWORK = MLP(hidden=(4,))
PHYSICS = Baseline.from_terms(
    [Term("a", "y[k-1]", initial=0.5), Term("b", "u[k]", initial=1.0, unit="m/N")]
)


def record_of(seed: int = 0, rows: int = 121, noise: float = 0.05) -> Record:
    """A first-order system with a quadratic of the input that the physics lacks."""
    rng = np.random.default_rng(seed)
    u, e = rng.uniform(-1, 1, (2, rows))
    y = np.zeros(rows)
    for k in range(1, rows):
        y[k] = 0.6 * y[k - 1] + 0.8 * u[k] + 0.5 * u[k] ** 2 - 0.2 * u[k - 1] + noise * e[k]
    return Record.from_arrays(u, y)


def columns(record: Record, start: int, *functions) -> np.ndarray:
    """Columns (N − start, n) of functions of (y, u, k), over all experiments."""
    pieces = []
    for e in record.experiments:
        y, u = e.outputs[:, 0], e.inputs[:, 0]
        pieces.append([[f(y, u, k) for f in functions] for k in range(start, len(e))])
    return np.concatenate(pieces).astype(float)


def least_squares(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.lstsq(a, b, rcond=None)[0]


def target(record: Record, start: int) -> np.ndarray:
    return columns(record, start, lambda y, u, k: y[k])[:, 0]


PHI = (lambda y, u, k: y[k - 1], lambda y, u, k: u[k])


@pytest.fixture(scope="module")
def record():
    return record_of()


@pytest.fixture(scope="module")
def fit(record):
    return estimate(
        record,
        PHYSICS,
        learner=NETWORK,
        solver=LevenbergMarquardt(iterations=60),
        restarts=3,
        seed=4,
        regularization="none",
    )


@pytest.fixture(scope="module")
def short(record):
    return estimate(
        record,
        PHYSICS,
        learner=NETWORK,
        solver=LevenbergMarquardt(iterations=6),
        regularization="none",
    )


# what is refused


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"regularization": "ridge"},
            "`regularization` must be one of none, evidence, ard; got 'ridge'",
        ),
        ({"regularization": -0.1}, "`regularization` must be 0 or more; got -0.1"),
        ({"regularization": float("nan")}, "`regularization` must be 0 or more; got nan"),
        ({"regularization": float("inf")}, "`regularization` must be 0 or more; got inf"),
        ({"regularization": None}, "`regularization` must be"),
        ({"restarts": 0}, "`restarts` must be a whole number, 1 or more; got 0"),
        ({"restarts": 1.5}, "`restarts` must be a whole number, 1 or more; got 1.5"),
        ({"restarts": True}, "`restarts` must be a whole number"),
        ({"seed": 1.5}, "`seed` must be a whole number"),
        ({"seed": "a"}, "`seed` must be a whole number"),
        ({"lags": (2, 1)}, "`lags` must be"),
        ({"learner": "mlp"}, "`learner` must be"),
        ({"learner": MLP}, "`learner` must be"),
        ({"structure": "orthogonl"}, "unknown structure 'orthogonl', did you mean 'orthogonal'"),
        ({"criterion": "simulate"}, "unknown criterion 'simulate', did you mean 'simulation'"),
        ({"criterion": 5}, r"`criterion` must be Prediction\(…\), Simulation\(…\) or Auto"),
        ({"structure": Additive}, "`structure` must be"),
        ({"solver": "adam"}, "unknown solver 'adam', did you mean 'adam-lbfgs'"),
        ({"solver": 3}, "`solver` must be"),
        ({"initial": np.zeros(2)}, "`initial` must be"),
    ],
)
def test_arguments_refused(record, arguments, message):
    with pytest.raises(InputError, match=message):
        estimate(record, PHYSICS, **arguments)


@pytest.mark.parametrize(
    ("names", "declared"),
    [
        (
            {"structure": "additive", "criterion": "simulation"},
            {"structure": Additive(), "criterion": Simulation()},
        ),
        ({"criterion": "auto", "structure": "orthogonal"}, {"criterion": Auto()}),
        ({"solver": "levenberg-marquardt"}, {"solver": LevenbergMarquardt()}),
    ],
)
def test_names_of_a_spec_stand_for_declarations(record, names, declared):
    few = {"learner": NETWORK, "solver": LevenbergMarquardt(iterations=3)}
    by_name, by_object = (estimate(record, PHYSICS, **(few | given)) for given in (names, declared))
    assert by_name.criterion == by_object.criterion
    assert by_name.model.structure == by_object.model.structure
    np.testing.assert_array_equal(by_name.theta, by_object.theta)


@pytest.mark.parametrize("arguments", [(np.ones((9, 2)), PHYSICS), (record_of(rows=9), ["y[k-1]"])])
def test_record_and_baseline_refused(arguments):
    with pytest.raises(InputError, match="`record` must be|`baseline` must be"):
        estimate(*arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"iterations": -1}, "`iterations` must be a whole number"),
        ({"iterations": 2.5}, "`iterations` must be a whole number"),
        ({"tolerance": -1e-8}, "`tolerance` must be"),
        ({"tolerance": float("nan")}, "`tolerance` must be"),
    ],
)
def test_solver_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        LevenbergMarquardt(**arguments)


def test_initial_refused(record, short):
    alone = estimate(record, PHYSICS, learner=None)
    with pytest.raises(
        InputError, match="`initial` is physics alone and has nothing to start from; leave it out"
    ):
        estimate(record, PHYSICS, initial=alone)
    (e,) = record.experiments
    twice = Record.from_arrays(e.inputs, np.hstack([e.outputs, 2 * e.outputs]), outputs=["y", "z"])
    physics = Baseline.from_terms([Term("a", "y[k-1]", output="y"), Term("b", "u[k]", output="z")])
    with pytest.raises(InputError, match="`initial` has 1 output, the record 2; fit anew"):
        estimate(twice, physics, initial=short)


def test_numbers_from_numpy_are_taken(record):
    solver = LevenbergMarquardt(iterations=2)
    arguments = {"restarts": np.int64(2), "seed": np.int64(3), "regularization": np.float64(0.5)}
    found = estimate(record, PHYSICS, learner=NETWORK, solver=solver, **arguments)
    assert [run.seed for run in found.restarts] == [3, 4]


# learners, lags, terms: against least squares written out


@pytest.mark.parametrize("structure", ["orthogonal", "additive"])
def test_linear_learner_on_expressions_is_least_squares(record, structure):
    learner = MLP(hidden=(), inputs=("u[k]**2", "sin(3*u[k-1])"))
    chosen = {"additive": Additive(), "orthogonal": Orthogonal(shared="all")}[structure]
    found = estimate(record, PHYSICS, learner=learner, structure=chosen, regularization="none")
    more = (lambda y, u, k: u[k] ** 2, lambda y, u, k: np.sin(3 * u[k - 1]), lambda y, u, k: 1.0)
    a = columns(record, 1, *PHI, *more)
    b = target(record, 1)
    assert found.status.code == "converged"
    np.testing.assert_allclose(
        found.model.predict(record).model[1:, 0], a @ least_squares(a, b), atol=1e-9
    )
    if structure == "orthogonal":
        np.testing.assert_allclose(found.theta, least_squares(a[:, :2], b), rtol=1e-12)
        # It cannot imitate the physics: a joint regression
        beside = estimate(record, PHYSICS, learner=learner, regularization="none").theta
        np.testing.assert_allclose(beside, least_squares(a, b)[:2], rtol=1e-6)


def test_learner_with_other_lags_than_the_baseline(record):
    found = estimate(
        record,
        PHYSICS,
        lags=Lags(na=0, nb=2, nk=2),
        learner=LINEAR,
        structure=Orthogonal(shared="all"),
        regularization="none",
    )
    a = columns(
        record, 3, *PHI, lambda y, u, k: u[k - 2], lambda y, u, k: u[k - 3], lambda y, u, k: 1.0
    )
    b = target(record, 3)
    assert (found.model.form.first_row, len(found.problem.rows)) == (3, 118)
    np.testing.assert_allclose(
        found.model.predict(record).model[3:, 0], a @ least_squares(a, b), atol=1e-9
    )
    np.testing.assert_allclose(found.theta, least_squares(a[:, :2], b), rtol=1e-12)


@pytest.mark.parametrize("learner", [None, MLP(hidden=(), inputs=("u[k]**2",))])
def test_experiments_given_twice_weigh_twice(learner):
    one, other = record_of(1, 61), record_of(2, 61)
    structure = Orthogonal(shared="all")
    found = estimate(
        Record.join([one, other, one]),
        PHYSICS,
        learner=learner,
        structure=structure,
        regularization="none",
    )
    functions = (
        [*PHI] if learner is None else [*PHI, lambda y, u, k: u[k] ** 2, lambda y, u, k: 1.0]
    )
    both = Record.join([one, other])
    a, b = columns(both, 1, *functions), target(both, 1)
    weight = np.repeat([np.sqrt(2.0), 1.0], 60)
    np.testing.assert_allclose(
        found.theta, least_squares(a[:, :2] * weight[:, None], b * weight), rtol=1e-12
    )
    expected = a @ least_squares(a * weight[:, None], b * weight)
    predicted = np.concatenate([t.model[1:, 0] for t in found.model.predict(both).trajectories])
    np.testing.assert_allclose(predicted, expected, atol=1e-9)


def test_fixed_terms_are_subtracted_first(record):
    fixed = Baseline.from_terms(
        [
            Term("a", "y[k-1]", initial=0.6, fixed=True),
            Term("b", "u[k]"),
            Term("c", "u[k-1]", initial=9.0),
        ]
    )
    found = estimate(record, fixed, learner=None)
    a = columns(record, 1, lambda y, u, k: u[k], lambda y, u, k: u[k - 1])
    rest = target(record, 1) - 0.6 * columns(record, 1, PHI[0])[:, 0]
    np.testing.assert_allclose(found.theta, least_squares(a, rest), rtol=1e-12)
    assert list(found.parameters.index) == ["b", "c"]
    np.testing.assert_allclose(
        found.model.predict(record).model, naive.predicted(found.model, record), atol=1e-12
    )


def test_nothing_but_fixed_terms(record):
    fixed = Baseline.from_terms([Term("a", "y[k-1]", initial=0.6, fixed=True)])
    found = estimate(
        record, fixed, learner=MLP(hidden=(), inputs=("u[k]", "u[k]**2")), regularization="none"
    )
    a = columns(record, 1, lambda y, u, k: u[k], lambda y, u, k: u[k] ** 2, lambda y, u, k: 1.0)
    known = 0.6 * columns(record, 1, PHI[0])[:, 0]
    expected = known + a @ least_squares(a, target(record, 1) - known)
    np.testing.assert_allclose(found.model.predict(record).model[1:, 0], expected, atol=1e-9)
    assert found.theta.shape == (0,) and "rank 0 of 0" in found.summary()


def test_baseline_function_is_its_terms(record):
    function = Baseline.from_function(
        lambda x: jnp.stack([x[:1], x[1:2]], axis=1), [Parameter("a"), "b"]
    )
    lags, solver = Lags(na=1, nb=1, nk=0), LevenbergMarquardt(iterations=6)
    found = estimate(record, function, lags=lags, learner=NETWORK, solver=solver)
    same = estimate(record, PHYSICS, lags=lags, learner=NETWORK, solver=solver)
    np.testing.assert_allclose(found.theta, same.theta, rtol=1e-13)
    for run in ("predict", "simulate"):
        np.testing.assert_allclose(
            getattr(found.model, run)(record).model,
            getattr(same.model, run)(record).model,
            atol=1e-10,
        )
    with pytest.raises(InputError, match="a baseline function needs `lags`"):
        estimate(record, function, learner=NETWORK)


# regularisation


@pytest.mark.parametrize("ridge", [1e-3, 1.0, 30.0])
def test_ridge_in_normalised_units(record, ridge):
    """`‖r‖² + α‖w‖²` with r in units of the baseline's RMS residual and features scaled to [-1, 1]."""
    learner = MLP(hidden=(), inputs=("u[k]**2", "u[k-1]"))
    found = estimate(record, PHYSICS, learner=learner, regularization=ridge)
    phi, y = columns(record, 1, *PHI), target(record, 1)
    e = y - phi @ least_squares(phi, y)
    raw = columns(record, 1, lambda y, u, k: u[k] ** 2, lambda y, u, k: u[k - 1])
    low, high = raw.min(axis=0), raw.max(axis=0)
    unit = found.model.numbers.gain[0] / e.std()
    j = unit * np.column_stack([(2 * raw - low - high) / (high - low), np.ones(len(raw))])
    j = j - phi @ least_squares(phi, j)
    w = np.linalg.solve(j.T @ j + ridge * np.eye(3), j.T @ e / e.std())
    np.testing.assert_allclose(found.model.numbers.weights, w, atol=1e-7 * np.abs(w).max())
    effective = np.trace(np.linalg.solve(j.T @ j + ridge * np.eye(3), j.T @ j))
    assert found.effective_weights == pytest.approx(effective, rel=1e-6)


def test_ridge_of_nothing_is_none(record, short):
    again = estimate(
        record, PHYSICS, learner=NETWORK, solver=LevenbergMarquardt(iterations=6), regularization=0
    )
    np.testing.assert_array_equal(again.model.numbers.weights, short.model.numbers.weights)


def test_much_ridge_leaves_physics_alone(record):
    found = estimate(record, PHYSICS, learner=NETWORK, regularization=1e9)
    alone = estimate(record, PHYSICS, learner=None)
    np.testing.assert_allclose(
        found.model.predict(record).model, alone.model.predict(record).model, atol=1e-5
    )
    assert found.effective_weights < 1e-3
    np.testing.assert_allclose(found.std, alone.std, rtol=1e-4)


# restarts, warm start, progress


def test_restarts_are_reported_and_the_best_is_kept(fit):
    assert [run.seed for run in fit.restarts] == [4, 5, 6]
    losses = [run.loss for run in fit.restarts]
    assert [run.chosen for run in fit.restarts] == [loss == min(losses) for loss in losses]
    assert fit.status.loss == pytest.approx(min(losses), rel=1e-6)
    assert len(set(losses)) == 3


def test_a_seed_from_the_table_gives_its_run_again(record, fit):
    (chosen,) = [run for run in fit.restarts if run.chosen]
    again = estimate(
        record,
        PHYSICS,
        learner=NETWORK,
        solver=LevenbergMarquardt(iterations=60),
        seed=chosen.seed,
        regularization="none",
    )
    np.testing.assert_array_equal(again.model.numbers.weights, fit.model.numbers.weights)
    assert again.restarts == (chosen,)


@pytest.mark.parametrize("of", ["estimate", "model"])
def test_warm_start_goes_on(record, short, of):
    initial = short if of == "estimate" else short.model
    same = estimate(record, PHYSICS, initial=initial, solver=LevenbergMarquardt(iterations=0))
    assert same.status.loss == pytest.approx(short.status.loss, rel=1e-12)
    np.testing.assert_array_equal(same.model.numbers.weights, short.model.numbers.weights)
    np.testing.assert_array_equal(
        same.model.predict(record).model, short.model.predict(record).model
    )
    further = estimate(record, PHYSICS, initial=initial)
    assert further.status.loss < 0.9 * short.status.loss
    np.testing.assert_allclose(further.theta, short.theta, rtol=1e-12)


def test_warm_start_on_new_data(fit):
    new = record_of(7)
    moved = estimate(new, PHYSICS, initial=fit, solver=LevenbergMarquardt(iterations=0))
    phi, y = columns(new, 1, *PHI), target(new, 1)
    np.testing.assert_allclose(moved.theta, least_squares(phi, y), rtol=1e-12)
    np.testing.assert_array_equal(moved.model.numbers.centre, fit.model.numbers.centre)
    assert moved.defect <= 1e-12
    assert moved.status.loss < 2 * fit.status.loss  # the same system: the learner fits it at once
    assert estimate(new, PHYSICS, initial=fit).status.loss <= moved.status.loss


def test_warm_start_with_other_physics(record, short):
    other = Baseline.from_terms([Term("a", "y[k-1]"), Term("b", "u[k]"), Term("c", "u[k-1]")])
    found = estimate(record, other, initial=short)
    assert found.theta.shape == (3,) and found.defect <= 1e-12
    assert found.model.form.features == short.model.form.features


def test_progress_is_reported(record):
    entries = []
    solver = LevenbergMarquardt(iterations=6)
    found = estimate(
        record,
        PHYSICS,
        learner=NETWORK,
        solver=solver,
        restarts=2,
        progress=lambda *what: entries.append(what),
    )
    assert {restart for restart, _, _ in entries} == {0, 1, 2, 3}  # none and ard from each start
    for i, run in enumerate(found.restarts):
        _, iteration, loss = [what for what in entries if what[0] == i][-1]
        assert iteration == run.iterations and loss == pytest.approx(run.loss, rel=1e-12)


# how it ends


def test_iteration_limit(short):
    assert (short.status.code, short.status.iterations) == ("iteration_limit", 6)
    assert short.status.ok and "more iterations may improve it" in short.status.message
    assert short.status.message in unfolded(short.summary())


def test_theta_keeps_its_intervals_where_training_does_not_move_it(short):
    """F1: under the training measure θ̂ = Φ⁺Y after every iteration; under another one it follows the weights."""
    assert short.std is not None and "not_converged" not in {
        warning.code for warning in short.warnings
    }
    solver = LevenbergMarquardt(iterations=6)
    moved = Orthogonal(measure=oa.Symmetrized())
    record, options = record_of(), {"learner": NETWORK, "solver": solver, "regularization": "none"}
    found = estimate(record, PHYSICS, structure=moved, **options)
    result = {warning.code: warning.text for warning in found.warnings}
    assert found.status.code == "iteration_limit" and found.std is None
    assert (
        "no intervals: training ended after 6 iterations while the loss was still falling"
        in result["not_converged"]
    )
    assert "Without the key `iterations`, training continues" in result["not_converged"]
    # Nobody gave the key where a run has the default limit and is not to pass it
    usual = options | {"learner": MLP(hidden=(16,)), "solver": LevenbergMarquardt().within_limit}
    found = estimate(record, PHYSICS, structure=moved, **usual)
    result = {warning.code: warning.text for warning in found.warnings}
    assert found.status.iterations == 300 and "Without the key" not in result["not_converged"]
    flown = estimate(record, PHYSICS, criterion=oa.Simulation(30, 0), **options | {"blocks": 0})
    assert flown.std is None and "not_converged" in {warning.code for warning in flown.warnings}


def test_a_learner_that_was_regularised_to_nothing_says_so():
    options = {"learner": NETWORK, "solver": LevenbergMarquardt(20)}
    silent = estimate(record_of(), PHYSICS, regularization=1e9, **options)
    found = {warning.code: warning.text for warning in silent.warnings}
    assert silent.effective_weights < 0.5
    assert re.search(
        r"the learner contributes nothing: the fit is that of physics alone .*Compare",
        found["learner_silent"],
    )
    heard = estimate(record_of(), PHYSICS, regularization="none", **options)
    assert "learner_silent" not in {warning.code for warning in heard.warnings}


@pytest.mark.parametrize(
    "solver", [LevenbergMarquardt(iterations=60), AdamLBFGS(40, 40)], ids=["lm", "paper"]
)
def test_who_was_warned_can_say_that_it_is_enough(record, solver):
    def enough(run, iteration, loss):
        raise StopTraining

    found = estimate(record, PHYSICS, learner=NETWORK, solver=solver, restarts=2, progress=enough)
    assert found.status.code == "stopped" and found.status.ok and found.status.iterations == 1
    assert found.status.loss <= found.status.start_loss or not solver.gauss_newton
    result = next(warning.text for warning in found.warnings if warning.code == "stopped")
    assert re.match(r"training was stopped on request: (\d) of \1 runs had not ended", result), (
        result
    )


def test_converged(record):
    found = estimate(record, PHYSICS, learner=MLP(hidden=(), inputs=("u[k]**2",)))
    assert (found.status.code, found.status.message, found.status.ok) == ("converged", "", True)


def test_exact(record):
    found = estimate(record, PHYSICS, learner=None)
    assert (found.status.code, found.status.iterations, found.restarts) == ("exact", 0, ())
    assert found.defect is None and found.effective_weights == 0.0


NEVER = Function(lambda w, z: w * jnp.nan, initial=lambda key: jnp.ones(1))
SOMEWHERE = Function(lambda w, z: w * jnp.log(z[:1]), initial=lambda key: jnp.ones(1))


@pytest.mark.parametrize("structure", ["orthogonal", "additive"])
@pytest.mark.parametrize("learner", [NEVER, SOMEWHERE], ids=["everywhere", "somewhere"])
def test_non_finite(record, learner, structure):
    arguments = {"structure": Additive()} if structure == "additive" else {}
    found = estimate(record, PHYSICS, learner=learner, restarts=2, **arguments)
    assert found.status.code == "non_finite" and not found.status.ok
    assert found.diagnose(blocks=0).verdict == f"Do not use the model: {found.status.message}"
    assert "the learner returns NaN" in found.status.message and found.status.message in unfolded(
        found.summary()
    )
    assert [run.loss for run in found.restarts] == [None, None]
    assert found.std is None and np.isfinite(found.theta).all()
    assert "nan" not in repr(found.theta)
    assert found.parameters["std"].isna().all()


def backwards(w, z):
    """A learner whose derivative has the wrong sign."""
    value = jnp.sum(w) * z[:1] ** 2
    return 2 * jax.lax.stop_gradient(value) - value


def test_no_descent(record):
    found = estimate(record, PHYSICS, learner=Function(backwards, initial=lambda key: jnp.ones(1)))
    assert found.status.code == "no_descent" and found.status.ok
    assert "gradient is wrong" in found.status.message
    assert np.isfinite(found.model.predict(record).model[1:]).all()


@pytest.mark.parametrize("regularization", ["none", "evidence", 0.1])
@pytest.mark.parametrize("learner", [LINEAR, NETWORK], ids=["linear", "network"])
def test_exact_physics_without_noise(learner, regularization):
    """There is nothing left to learn: θ is exact, the learner harmless, no number missing."""
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=121), np.zeros(121)
    for k in range(1, 121):
        y[k] = 0.5 * y[k - 1] + 2.0 * u[k]
    record = Record.from_arrays(u, y)
    found = estimate(record, PHYSICS, learner=learner, regularization=regularization)
    assert found.status.ok
    np.testing.assert_allclose(found.theta, [0.5, 2.0], rtol=1e-13)
    assert np.isfinite(found.std).all() and (found.std < 1e-10).all()
    for run in (found.model.predict, found.model.simulate):
        np.testing.assert_allclose(run(record).model[1:, 0], y[1:], atol=1e-9)
    assert found.defect is None or found.defect <= 1e-12


def test_rank_deficient_physics_is_refused(record):
    twice = Baseline.from_terms([Term("a", "u[k]"), Term("b", "2*u[k]"), Term("c", "y[k-1]")])
    with pytest.raises(RankError, match="the columns of a, b are linearly dependent"):
        estimate(record, twice, learner=None)


def test_ill_conditioned_physics_is_a_warning(record):
    close = Baseline.from_terms([Term("a", "u[k]"), Term("b", "u[k] + 1e-9*y[k-1]")])
    found = estimate(record, close, learner=None)
    assert any(
        "the physics is ill-conditioned on the data (condition" in str(text)
        for text in found.warnings
    )
    assert estimate(record, PHYSICS, learner=None).warnings == ()


def test_no_degree_of_freedom_is_a_warning():
    found = estimate(record_of(rows=3), PHYSICS, learner=None)
    assert found.std is None and found.interval is None
    (warning,) = found.warnings
    assert str(warning).startswith(
        "no standard errors: 2 rows leave no degrees of freedom for 2 parameters"
    )


# models from elsewhere


@pytest.mark.parametrize("name", ["matrix", "vector"])
def test_orthogonalize(record, name):
    """θ = Φ⁺G, and the split predicts and simulates what the function does."""

    def g(x):
        assert type(x) is np.ndarray and x.shape[1] == 2
        values = 0.6 * x[:, :1] + 0.8 * x[:, 1:] + 0.5 * x[:, 1:] ** 2 - 0.1 * np.tanh(x[:, :1])
        return values if name == "matrix" else values[:, 0]

    found = orthogonalize(record, PHYSICS, g)
    phi = columns(record, 1, *PHI)
    values = np.reshape(g(phi), -1)
    np.testing.assert_allclose(found.theta, least_squares(phi, values), rtol=1e-12)
    assert found.defect <= 1e-12 and found.std is None
    assert [str(w) for w in found.warnings] == [
        "no standard errors: the function was trained elsewhere."
    ]
    prediction = found.model.predict(record)
    np.testing.assert_allclose(prediction.model[1:, 0], values, atol=1e-12)
    learner = prediction.trajectories[0].learner[1:, 0]
    np.testing.assert_allclose(phi.T @ learner, 0.0, atol=1e-11)
    (e,) = record.experiments
    own = np.zeros(len(e))
    own[0] = e.outputs[0, 0]
    for k in range(1, len(e)):
        own[k] = np.reshape(g(np.array([[own[k - 1], e.inputs[k, 0]]])), ())
    np.testing.assert_allclose(found.model.simulate(record).model[1:, 0], own[1:], atol=1e-10)
    ahead = found.model.predict(record, horizon=2).model
    two = np.reshape(
        g(np.column_stack([np.r_[0.0, prediction.model[1:, 0]][1:-1], e.inputs[2:, 0]])), -1
    )
    np.testing.assert_allclose(ahead[2:, 0], two, atol=1e-10)


def test_orthogonalize_two_outputs():
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=60), rng.normal(size=(60, 2)) * [1.0, 50.0]
    record = Record.from_arrays(u, y)
    physics = Baseline.from_terms(
        [Term("a", "u[k]", output="y1"), Term("b", "y1[k-1]", output="y2")]
    )

    def g(x):
        return np.column_stack([x[:, 1] + np.cos(x[:, 0]), 30 * x[:, 0]])

    found = orthogonalize(record, physics, g, lags=Lags(na=[1, 0], nb=1, nk=0))
    x = np.column_stack([y[:-1, 0], u[1:]])
    expected = [least_squares(x[:, 1:], g(x)[:, 0])[0], 30.0]
    np.testing.assert_allclose(found.theta, expected, rtol=1e-12)
    np.testing.assert_allclose(found.model.predict(record).model[1:], g(x), atol=1e-10)
    assert np.isfinite(found.model.simulate(record).model[1:]).all()


def test_orthogonalize_refuses_a_wrong_shape(record):
    with pytest.raises(InputError, match=r"returned shape \(.*\); expected \(120, 1\)"):
        orthogonalize(record, PHYSICS, lambda x: np.ones((len(x), 3)))


def test_a_function_from_elsewhere_never_sees_a_run_that_diverged(record):
    """Other toolboxes refuse values that are not finite; the free run ends there instead."""

    def g(x):
        if not np.isfinite(x).all():
            raise ValueError("input contains infinity")
        with np.errstate(over="ignore"):
            return 1e100 * x[:, 0] + x[:, 1]

    (trajectory,) = orthogonalize(record, PHYSICS, g).model.simulate(record, [[1.0]]).trajectories
    assert trajectory.diverged == (1, "y")


# what it says


def test_summary(fit):
    text = fit.summary()
    for fact in (
        "structure   orthogonal",
        "MLP(hidden=(4,)",
        "17 weights",
        "Record(1 experiment, 121 samples",
        "120 usable rows",
        f"status      {fit.status.code}, {fit.status.iterations} iterations",
        "‖QᵀF̃‖/‖F‖",
        "rank 2 of 2, condition",
        "m/N",
    ):
        assert fact in text, fact
    for name, value, std in zip(fit.parameters.index, fit.theta, fit.std, strict=True):
        printed = re.search(rf"^{name} +(\S+) +(\S+)", text, re.M)
        assert printed is not None
        np.testing.assert_allclose(float(printed[1]), value, atol=std / 20)
        np.testing.assert_allclose(float(printed[2]), std, rtol=0.05)
    assert len(max(text.splitlines(), key=len)) < 170
    counted = "The intervals count noise only. `fit.diagnose()` tests whether something is missing"
    assert counted in unfolded(text) and callable(fit.diagnose)
    bare = dataclasses.replace(fit, covariance=None)
    assert "noise only" not in bare.summary()


def test_repr(record, fit):
    assert repr(fit).startswith(f"Estimate(orthogonal, {fit.status.code}, loss ")
    assert f"a = {fit.theta[0]:.6g}, b = {fit.theta[1]:.6g})" in repr(fit)
    assert "\n" not in repr(fit)


def test_parameters(fit):
    table = fit.parameters
    assert list(table.index) == ["a", "b"] and table.index.name == "parameter"
    assert list(table.columns) == ["unit", "initial", "value", "std", "ci95_low", "ci95_high"]
    assert list(table["unit"]) == ["", "m/N"] and list(table["initial"]) == [0.5, 1.0]
    np.testing.assert_array_equal(table["value"], fit.theta)
    np.testing.assert_array_equal(table["std"], fit.std)
    assert (table["ci95_low"] < table["value"]).all() and (
        table["value"] < table["ci95_high"]
    ).all()


def test_units_of_channels_stay_with_the_model():
    (e,) = record_of().experiments
    named = Record.from_arrays(
        e.inputs, e.outputs, inputs=[Channel("u", "N")], outputs=[Channel("y", "m")]
    )
    found = estimate(named, PHYSICS, learner=None)
    assert [c.label for c in (*found.model.outputs, *found.model.inputs)] == ["y [m]", "u [N]"]


def test_known_terms_alone_have_no_standard_errors():
    rng = np.random.default_rng(0)
    u = rng.normal(size=200)
    record = Record.from_arrays(u=u, y=2 * u + 0.3 * u**3 + 0.1 * rng.normal(size=200))
    known = Baseline.from_terms([Term("k", "u[k]", initial=2.0, fixed=True)])
    found = estimate(record, known, learner=MLP(hidden=(4,)))
    assert found.physics_alone is not None and found.physics_alone.std.shape == (0,)
