"""Models that simulate: training on the free run, from the split of θ to its standard errors."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.signal

from orthaug import (
    MLP,
    AdamLBFGS,
    Additive,
    Baseline,
    BaselinePenalty,
    InputError,
    LevenbergMarquardt,
    Orthogonal,
    OrthogonalPenalty,
    Prediction,
    Record,
    Simulation,
    Term,
)
from orthaug import estimate as choosing
from orthaug._base.progress import StopTraining
from orthaug.fitting.one_step import OneStepTask
from orthaug.fitting.segmented_lagged import SegmentedLagged
from orthaug.fitting.segments import respond

STRUCTURES = (Orthogonal(), Additive(), OrthogonalPenalty(1.0), BaselinePenalty(1.0))
LM, FREE, NETWORK = LevenbergMarquardt(150), Simulation(64, 8, 10), MLP(hidden=(3,))
TERMS = [Term("a", "y[k-1]", 0.8), Term("b", "y[k-2]", -0.2), Term("g", "u[k-1]", 0.4)]
PHYSICS = Baseline.from_terms(TERMS)


def nonlinear(seed=1, lengths=(300,), noise=0.05):
    """A second-order system with a saturating restoring force, and noise of the sensor."""
    pieces = []
    for i, length in enumerate(lengths):
        rng = np.random.default_rng([seed, i])
        u, y = rng.normal(size=length), np.zeros(length)
        for k in range(2, length):
            y[k] = 0.9 * y[k - 1] - 0.3 * y[k - 2] + 0.5 * u[k - 1] + 0.3 * np.tanh(2 * y[k - 1])
        pieces.append(Record.from_arrays(u, y + noise * rng.normal(size=length)))
    return Record.join(pieces)


def estimate(*given, **options):
    """The run of the lowest loss, whatever it is worth on what was held out."""
    return choosing(*given, **{"blocks": 0, "fallback": False, **options})


@cache
def record(seed=1, lengths=(300,)):
    return nonlinear(seed, lengths)


@cache
def fit(structure=Orthogonal(), criterion=FREE, lengths=(300,), seed=0):  # noqa: B008  (frozen)
    options = {
        "learner": NETWORK,
        "solver": LM,
        "structure": structure,
        "criterion": criterion,
        "seed": seed,
    }
    return estimate(record(1, lengths), PHYSICS, **options)


def free_run_loss(found, given, washout):
    """Mean square of `Model.simulate` over whole experiments, each output in its training deviation."""
    squares = []
    for trajectory in found.model.simulate(given).trajectories:
        first = found.model.form.first_row + washout
        squares.append(
            ((trajectory.measured - trajectory.model)[first:] / found.problem.deviation) ** 2
        )
    return np.mean(np.concatenate(squares))


# --- loss and split


def test_the_free_run_is_better_than_that_of_the_one_step_solution():
    assert fit().status.ok
    assert fit().status.loss < 0.95 * free_run_loss(fit(criterion=Prediction()), record(), 8)


@pytest.mark.parametrize("structure", STRUCTURES, ids=lambda s: s.name)
def test_every_structure_trains_on_the_free_run_and_predicts(structure):
    found = fit(structure)
    assert found.status.ok and found.status.iterations > 10 and np.isfinite(found.theta).all()
    assert free_run_loss(found, record(), 8) < 0.9 * free_run_loss(
        fit(structure, Prediction()), record(), 8
    )
    assert found.model.predict(record()).scores().fit[0] > 85
    assert (found.std is None) == (structure.name != "orthogonal")


@pytest.mark.parametrize("lengths", [(300,), (150, 60, 94)], ids=str)
def test_loss_is_the_mean_square_of_simulate(lengths):
    assert fit(lengths=lengths).status.loss == pytest.approx(
        free_run_loss(fit(lengths=lengths), record(1, lengths), 8)
    )


@pytest.mark.parametrize("lengths", [(300,), (150, 60, 94)], ids=str)
def test_theta_is_the_share_of_the_model_in_the_physics(lengths):
    """θ = Φ⁺G with G the model's one-step values at the measured regressors."""
    found, given = fit(lengths=lengths), record(1, lengths)
    start = found.model.form.first_row
    values = np.concatenate([t.model[start:] for t in found.model.predict(given).trajectories])
    rows = found.problem.rows
    phi = found.problem.baseline.phi(rows.x, rows.layout, ("y",), np)[:, 0]
    np.testing.assert_allclose(
        found.theta, np.linalg.lstsq(phi, values[:, 0], rcond=None)[0], rtol=1e-10
    )
    assert found.defect <= 1e-12 and np.abs(found.model.theta_aux).max() > 1e-3


def test_orthogonal_and_additive_train_the_same_function():
    """Without penalty or bounds every structure trains the same (c, w) (F2)."""
    orthogonal, additive = fit(Orthogonal()), fit(Additive())
    np.testing.assert_allclose(
        orthogonal.model.simulate(record()).model[2:],
        additive.model.simulate(record()).model[2:],
        rtol=1e-6,
        atol=1e-8,
    )
    assert not np.allclose(orthogonal.theta, additive.theta, rtol=1e-2)


def test_a_large_orthogonal_penalty_gives_the_orthogonal_theta():
    np.testing.assert_allclose(fit(OrthogonalPenalty(1e3)).theta, fit().theta, rtol=2e-2)
    assert (
        fit(OrthogonalPenalty(1e3)).defect
        < fit(OrthogonalPenalty(1.0)).defect
        < 0.1
        < fit(Additive()).defect
    )


def test_a_large_baseline_penalty_gives_the_initial_values():
    np.testing.assert_allclose(fit(BaselinePenalty(1e4)).theta, PHYSICS.initial, rtol=1e-3)
    assert fit(BaselinePenalty(1e4)).status.loss < 0.01


def test_whole_experiments():
    found = fit(criterion=Simulation(0, 8, 10))
    assert found.status.loss == pytest.approx(free_run_loss(found, record(), 8))
    assert found.status.loss < 1.05 * fit().status.loss and found.defect <= 1e-12


def test_a_warm_start_goes_on():
    again = estimate(
        record(), PHYSICS, initial=fit(), criterion=FREE, solver=LevenbergMarquardt(10)
    )
    assert again.status.loss < 1.02 * fit().status.loss
    stopped = estimate(
        record(),
        PHYSICS,
        initial=fit(),
        criterion=Simulation(64, 8, 0),
        solver=LevenbergMarquardt(0),
    )
    np.testing.assert_array_equal(stopped.model.numbers.weights, fit().model.numbers.weights)


# --- physics alone: output error


def by_scipy(given, extra=0.0):
    """θ = (a, b, g) of `y = a y₁ + b y₂ + extra y₂ + g u₁` with all outputs before a run as unknowns, by scipy."""
    size = given.experiments[0].outputs.std()

    def residual(p):
        (a, b, g), initial, found = p[:3], p[3:].reshape(-1, 2), []
        for experiment, first in zip(given.experiments, initial, strict=True):
            y, u = np.empty(len(experiment)), experiment.inputs[:, 0]
            y[:2] = first
            for k in range(2, len(y)):
                y[k] = a * y[k - 1] + (b + extra) * y[k - 2] + g * u[k - 1]
            found.append((y - experiment.outputs[:, 0]) / size)
        return np.concatenate(found)

    start = np.concatenate(
        [[0.8, -0.2 - extra, 0.4], *(e.outputs[:2, 0] for e in given.experiments)]
    )
    return scipy.optimize.least_squares(
        residual, start, x_scale="jac", xtol=1e-13, ftol=1e-13, gtol=1e-13
    ).x[:3]


@pytest.mark.parametrize("extra", [0.0, 0.15])
def test_physics_alone_is_output_error_as_scipy_has_it(extra):
    """Over whole experiments; a fixed term stays what it is."""
    given = record(2, (60, 40))
    terms = [*TERMS, Term("d", "y[k-2]", extra, fixed=True)] if extra else TERMS
    found = estimate(given, Baseline.from_terms(terms), learner=None, criterion=Simulation(0, 0))
    np.testing.assert_allclose(found.theta, by_scipy(given, extra), rtol=1e-5)
    assert found.model.form.baseline.names == ("a", "b", "g") and found.status.code == "converged"


def test_a_fixed_term_stays_beside_a_learner():
    """Moving a known share of b into a fixed term changes b by it and nothing else."""
    terms = [*TERMS, Term("d", "y[k-2]", 0.15, fixed=True)]
    shifted = estimate(
        record(), Baseline.from_terms(terms), learner=NETWORK, solver=LM, criterion=FREE
    )
    rows = shifted.problem.rows
    start = shifted.model.form.first_row
    known = 0.15 * record().experiments[0].outputs[start - 2 : -2, 0]
    values = shifted.model.predict(record()).model[start:, 0] - known
    phi = shifted.problem.baseline.phi(rows.x, rows.layout, ("y",), np)[:, 0]
    np.testing.assert_allclose(
        shifted.theta, np.linalg.lstsq(phi, values, rcond=None)[0], rtol=1e-10
    )
    np.testing.assert_allclose(shifted.theta[1], fit().theta[1] - 0.15, atol=3 * fit().std[1])


# --- bounds


SMALL, EXACT = Simulation(30, 0, 10), LevenbergMarquardt(200, tolerance=1e-10)
BOX = {"a": (0.0, 0.9), "g": (0.0, 5.0)}


def bounded_physics(box=BOX):
    terms = []
    for term in TERMS:
        low, high = box.get(term.parameter, (None, None))
        initial = term.initial if low is None else float(np.clip(term.initial, low, high))
        terms.append(Term(term.parameter, term.regressor, initial, min=low, max=high))
    return Baseline.from_terms(terms)


@cache
def bounded(structure):
    return estimate(
        record(3, (150,)),
        bounded_physics(),
        learner=MLP((2,)),
        criterion=SMALL,
        solver=EXACT,
        structure=structure,
    )


def reparametrised(found, orthogonal):
    """(residual, Jacobian) of the segments' errors over (θ, w), with `c = θ − Φ⁺F(w)` where θ is orthogonal."""
    problem = found.problem
    flown = SegmentedLagged.of(OneStepTask.of(problem, MLP((2,))), SMALL)
    phi = problem.baseline.phi(problem.rows.x, problem.layout, ("y",), np)[:, 0]
    pseudo, z = np.linalg.pinv(phi), jnp.asarray(flown.task.scaling(problem.feature_rows()))

    def residual(p):
        theta, w = p[:3], p[3:]
        share = (
            pseudo @ (flown.task.unit * jax.vmap(lambda row: flown.bound.values(w, row))(z))[:, 0]
        )
        numbers = flown.numbers(0.0 * phi[0], 0.0)._replace(
            theta=theta - orthogonal * share, weights=w
        )
        run = respond(flown.dynamics, numbers, flown.segments, flown.segments.start)
        return jnp.where(
            flown.segments.scored[:, :, None], flown.segments.target - run, 0.0
        ).ravel()

    jacobian = jax.jit(jax.jacfwd(residual))
    compiled = jax.jit(residual)
    return lambda p: np.asarray(compiled(p)), lambda p: np.asarray(jacobian(p))


@pytest.mark.parametrize("structure", [Orthogonal(), Additive()], ids=lambda s: s.name)
def test_bounds_on_the_free_run(structure):
    """θ ends exactly at its bound, and scipy on the same unknowns finds nothing better, from here or from the start."""
    found, orthogonal = bounded(structure), structure.name == "orthogonal"
    residual, jacobian = reparametrised(found, orthogonal)
    w = np.asarray(found.model.numbers.weights)
    at = np.concatenate([found.theta, w])
    one_step = estimate(
        record(3, (150,)),
        bounded_physics(),
        learner=MLP((2,)),
        solver=LevenbergMarquardt(10),
        structure=structure,
        regularization="none",
    )
    start = np.concatenate([one_step.theta, np.asarray(one_step.model.numbers.weights)])
    low, high = (np.concatenate([side, np.full(len(w), end)]) for side, end in
                 zip(found.problem.baseline.bounds, (-np.inf, np.inf), strict=True))  # fmt: skip
    mine = np.sum(residual(at) ** 2)
    for begin in (at, start):
        other = scipy.optimize.least_squares(
            residual,
            np.clip(begin, low + 1e-9, high - 1e-9),
            jacobian,
            (low, high),
            x_scale="jac",
            max_nfev=300,
        )
        assert mine <= 1.01 * 2 * other.cost
    assert np.all((low[:3] <= found.theta) & (found.theta <= high[:3]))
    if orthogonal:
        assert dict(found.at_bound) == {"a": 0.9} and found.theta[0] == 0.9
        assert found.defect <= 1e-12 and np.isnan(found.std[0]) and np.isfinite(found.std[1:]).all()


def test_physics_alone_at_a_bound():
    found = estimate(
        record(3, (150,)), bounded_physics({"g": (0.6, 1.0)}), learner=None, criterion=SMALL
    )
    assert found.at_bound["g"] == found.theta[2] == 0.6 and found.status.code == "converged"


def test_a_start_at_the_bounded_minimum_has_converged():
    """All parameters at bounds that the gradient points out of."""
    box = {"a": (0.0, 0.5), "b": (-0.8, -0.5), "g": (0.1, 0.2)}
    found = estimate(record(3, (150,)), bounded_physics(box), learner=None, criterion=SMALL)
    assert len(found.at_bound) == 3 and found.status.code == "converged"


# --- several outputs


SEPARATE = Baseline.from_terms(
    [Term("a", "y1[k-1]", 0.5, output="y1"), Term("b", "y2[k-1]", 0.5, output="y2"),
     Term("g", "u1[k]", 1.0, output="y1"), Term("h", "u2[k]", 1.0, output="y2")]
)  # fmt: skip
SHARED = Baseline.from_terms(
    [Term("a", "y1[k-1]", 0.5, output="y1"), Term("a", "y2[k-1]", output="y2"),
     Term("g", "u1[k]", 1.0, output="y1"), Term("h", "u2[k]", 1.0, output="y2")]
)  # fmt: skip


@cache
def two_outputs(seed, noise=(0.02, 1.0), bend=0.0):
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=(200, 2)), np.zeros((200, 2))
    for k in range(1, 200):
        y[k] = 0.7 * y[k - 1] + [1.0, 0.8] * u[k] + bend * np.tanh(2 * y[k - 1])
    return Record.from_arrays(u, y + np.array(noise) * rng.normal(size=y.shape))


def unweighted(given):
    """(a, g, h) with every output in its own deviation, by scipy."""
    (experiment,) = given.experiments
    weight = 1 / experiment.outputs.std(axis=0)

    def residual(p):
        inputs = experiment.inputs * p[1:3]
        inputs[0] = p[3:]
        return (
            weight * (scipy.signal.lfilter([1], [1, -p[0]], inputs, axis=0) - experiment.outputs)
        ).ravel()

    return scipy.optimize.least_squares(residual, [0.5, 1, 1, *experiment.outputs[0]]).x[:3]


def test_outputs_are_weighted_by_their_noise():
    """The quiet output says more about the shared parameter: fifty times less noise."""
    errors = []
    for seed in range(6):
        found = estimate(two_outputs(seed), SHARED, learner=None, criterion=Simulation(0, 0))
        errors.append([abs(found.theta[0] - 0.7), abs(unweighted(two_outputs(seed))[0] - 0.7)])
    mine, other = np.sqrt(np.mean(np.square(errors), axis=0))
    assert mine < 0.2 * other and mine < 0.002


def test_outputs_without_common_parameters_are_those_fitted_alone():
    given = two_outputs(0, (0.05, 0.3))
    both = estimate(given, SEPARATE, learner=None, criterion=Simulation(0, 0))
    (experiment,) = given.experiments
    for i, places in enumerate(([0, 2], [1, 3])):
        alone = estimate(
            Record.from_arrays(experiment.inputs[:, i], experiment.outputs[:, i]),
            Baseline.from_terms([Term("a", "y[k-1]", 0.5), Term("g", "u[k]", 1.0)]),
            learner=None,
            criterion=Simulation(0, 0),
        )
        assert np.all(np.abs(both.theta[places] - alone.theta) < 0.3 * alone.std)
        np.testing.assert_allclose(both.std[places], alone.std, rtol=0.05)


def test_two_outputs_with_a_learner():
    given = two_outputs(1, (0.05, 0.05), 0.2)
    found = estimate(given, SHARED, learner=NETWORK, criterion=FREE, solver=LM)
    rows, weight = found.problem.rows, 1 / found.problem.deviation[:, None]
    phi = (
        found.problem.baseline.phi(rows.x, rows.layout, found.problem.outputs, np) * weight
    ).reshape(rows.y.size, -1)
    values = (found.model.predict(given).model[1:] / found.problem.deviation).ravel()
    np.testing.assert_allclose(found.theta, np.linalg.lstsq(phi, values, rcond=None)[0], rtol=1e-10)
    assert found.defect <= 1e-12
    assert (
        found.status.loss == pytest.approx(free_run_loss(found, given, 8))
        and found.status.loss < 0.01
    )


# --- choice between restarts


def test_restarts_are_chosen_by_the_loss_of_the_free_run():
    options = {"learner": NETWORK, "solver": LevenbergMarquardt(5), "criterion": FREE}
    several = estimate(record(), PHYSICS, restarts=3, seed=4, **options)
    alone = [estimate(record(), PHYSICS, seed=s, **options) for s in (4, 5, 6)]
    assert [r.loss for r in several.restarts] == [f.status.loss for f in alone]
    best = int(np.argmin([f.status.loss for f in alone]))
    assert [r.chosen for r in several.restarts] == [i == best for i in range(3)]
    np.testing.assert_array_equal(several.theta, alone[best].theta)


def test_a_converged_run_is_chosen_where_one_at_its_limit_is_hardly_better():
    """Parameters of a run that stopped at its limit have no intervals."""
    options = {"learner": NETWORK, "criterion": FREE, "regularization": "evidence"}
    solver = LevenbergMarquardt(45)
    fit = estimate(
        record(), PHYSICS, restarts=4, seed=4, validation=record(9), solver=solver, **options
    )
    chosen = next(run for run in fit.restarts if run.chosen)
    least = min(fit.restarts, key=lambda run: run.validation)
    assert (least.code, chosen.code) == ("iteration_limit", "converged")
    assert 1 < chosen.validation / least.validation < 1.02**2
    assert fit.std is not None


def test_validation_chooses_by_the_free_run():
    options = {
        "learner": NETWORK,
        "solver": LevenbergMarquardt(3),
        "criterion": Simulation(64, 8, 3),
    }
    options["regularization"] = "none"
    other = record(9)
    several = estimate(record(), PHYSICS, restarts=3, seed=4, validation=other, **options)
    alone = [estimate(record(), PHYSICS, seed=s, **options) for s in (4, 5, 6)]
    expected = [
        np.mean((f.model.simulate(other).scores().rmse / f.problem.deviation) ** 2) for f in alone
    ]
    np.testing.assert_allclose([r.validation for r in several.restarts], expected, rtol=1e-12)
    assert int(np.argmin(expected)) == [r.chosen for r in several.restarts].index(True)


def test_one_and_two_threads_give_the_same(monkeypatch):
    found = []
    for cores in (1, 2):
        monkeypatch.setattr("os.cpu_count", lambda cores=cores: cores)
        found.append(estimate(record(), PHYSICS, learner=NETWORK, solver=LevenbergMarquardt(8), criterion=FREE,
                              restarts=3))  # fmt: skip
    assert found[0].restarts == found[1].restarts
    np.testing.assert_array_equal(found[0].theta, found[1].theta)
    np.testing.assert_array_equal(found[0].model.numbers.weights, found[1].model.numbers.weights)
    np.testing.assert_array_equal(found[0].covariance, found[1].covariance)


@pytest.mark.parametrize("ny", [1, 2])
def test_progress_ends_at_the_loss_of_the_segments(ny):
    """In deviations of the outputs, like the loss: over whole experiments both are the same sum."""
    entries = []
    given, baseline = (record(), PHYSICS) if ny == 1 else (two_outputs(1, (0.05, 0.2)), SEPARATE)
    found = estimate(
        given,
        baseline,
        learner=None,
        criterion=Simulation(0, 8),
        progress=lambda *a: entries.append(a),
    )
    assert [(i, n) for i, n, _ in entries] == [(0, n + 1) for n in range(found.status.iterations)]
    assert entries[-1][2] == pytest.approx(found.status.loss, rel=0.1)


# --- the error some steps ahead


def first_order(seed, rows=300, noise=0.3):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=rows)
    clean = scipy.signal.lfilter([0.5], [1, -0.9], u)
    return Record.from_arrays(u, clean + noise * clean.std() * rng.normal(size=rows))


FIRST = Baseline.from_terms([Term("a", "y[k-1]", 0.8), Term("g", "u[k]", 0.4)])


@pytest.mark.parametrize("horizon", [2, 8])
def test_a_horizon_lowers_the_error_that_many_steps_ahead(horizon):
    given = first_order(0)
    errors = [
        estimate(given, FIRST, learner=None, criterion=Prediction(h))
        .model.predict(given, horizon)
        .scores()
        .rmse[0]
        for h in (1, horizon)
    ]
    assert errors[1] < errors[0]


def test_a_horizon_with_a_learner():
    errors = [
        fit(criterion=Prediction(h)).model.predict(record(), 5).scores().rmse[0] for h in (1, 5)
    ]
    assert errors[1] < 0.95 * errors[0]
    assert fit(criterion=Prediction(5)).defect <= 1e-12


@pytest.mark.parametrize("horizon", [2, 5])
def test_a_horizon_ends_at_the_least_error_that_many_steps_ahead(horizon):
    """From the measured outputs, as `Model.predict` has it: no other θ predicts better."""
    given = first_order(0)
    (experiment,) = given.experiments
    y, u = experiment.outputs[:, 0], experiment.inputs[:, 0]

    def residual(p):
        value = y[:-horizon]
        for i in range(1, horizon + 1):
            value = p[0] * value + p[1] * u[i : len(u) - horizon + i]
        return y[horizon:] - value

    best = scipy.optimize.least_squares(residual, [0.8, 0.4], xtol=1e-14, ftol=1e-14).x
    found = estimate(given, FIRST, learner=None, criterion=Prediction(horizon))
    rmse = found.model.predict(given, horizon).scores().rmse[0]
    assert rmse**2 == pytest.approx(np.mean(residual(found.theta) ** 2))
    np.testing.assert_allclose(found.theta, best, rtol=1e-4)


# --- refusals


@pytest.mark.parametrize(("segment", "washout"), [(40, 40), (5, 40), (1, 1)])
def test_a_washout_that_leaves_nothing_is_refused(segment, washout):
    with pytest.raises(
        InputError, match=rf"`washout` must be shorter than `segment`; got {washout} and {segment}"
    ):
        Simulation(segment, washout)


@pytest.mark.parametrize("name", ["segment", "washout", "start_iterations"])
def test_numbers_that_are_none_are_refused(name):
    with pytest.raises(InputError, match=f"`{name}`"):
        Simulation(**{name: -1})


@pytest.mark.parametrize("learner", [None, NETWORK], ids=["no learner", "learner"])
@pytest.mark.parametrize("criterion", [FREE, Prediction(5)], ids=["simulation", "horizon"])
def test_adam_is_refused(criterion, learner):
    with pytest.raises(InputError, match="LevenbergMarquardt|levenberg-marquardt"):
        estimate(record(), PHYSICS, learner=learner, criterion=criterion, solver=AdamLBFGS(5, 5))


# --- sensor noise (F7)


M, C, K, TS = 1.0, 100.0, 1000.0, 0.002
GAMMA = M + C * TS + K * TS**2
SPRING = np.array([2 * M + C * TS, -M, TS**2]) / GAMMA
SPRING_PHYSICS = Baseline.from_terms(
    [Term("t1", "y[k-1]"), Term("t2", "y[k-2]"), Term("t3", "u[k]")]
)


@cache
def springs():
    """20 draws of 10⁴ rows with 30 dB of output noise: (simulation, one-step) fits."""
    found = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        u = 100 * rng.normal(size=10_000)
        y = scipy.signal.lfilter([SPRING[2]], [1, -SPRING[0], -SPRING[1]], u)
        noisy = Record.from_arrays(
            u, y + 10**-1.5 * y.std() * rng.normal(size=len(y)), sampling_time=TS
        )
        found.append(
            [
                estimate(noisy, SPRING_PHYSICS, learner=None, criterion=c)
                for c in (Simulation(), Prediction())
            ]
        )
    return found


def physical(found):
    """(m, c, k) and their standard deviations, in closed form and by the delta method."""

    def solve(theta):
        gamma = TS**2 / theta[2]
        m = -theta[1] * gamma
        c = (theta[0] * gamma - 2 * m) / TS
        return np.array([m, c, (gamma - m - c * TS) / TS**2])

    steps = np.diag(1e-6 * np.abs(found.theta))
    slope = np.stack(
        [(solve(found.theta + d) - solve(found.theta - d)) / (2 * d.sum()) for d in steps], axis=1
    )
    return solve(found.theta), np.sqrt(np.diag(slope @ found.covariance @ slope.T))


def test_output_error_recovers_the_mass_spring_damper_from_noisy_sensors():
    inside = []
    for simulated, _ in springs():
        values, deviations = physical(simulated)
        inside.append(np.abs(values - [M, C, K]) < 3 * deviations)
        assert np.all(deviations < [0.01, 1.0, 10.0])
    assert np.all(np.sum(inside, axis=0) >= 19)


def test_one_step_is_far_off_where_the_sensor_is_noisy():
    for _, one_step in springs():
        values, deviations = physical(one_step)
        assert M - values[0] > 20 * deviations[0]


# --- runs that diverge


def test_a_free_run_that_diverges_over_whole_experiments_is_no_error():
    """A term of 1.3 y[k-1] is fixed; over eight steps the rest can still be trained."""
    unstable = Baseline.from_terms([Term("d", "y[k-1]", 1.3, fixed=True), Term("g", "u[k]", 1.0)])
    found = estimate(first_order(0), unstable, learner=None, criterion=Simulation(8, 0))
    assert found.status.ok and np.isfinite(found.parameters["value"]).all()
    assert found.status.loss == found.status.start_loss == found.restarts[0].loss and np.isfinite(
        found.status.loss
    )
    assert [w.code for w in found.warnings] == ["free_run_diverges"]


def test_a_slowly_growing_free_run_has_a_loss():
    growing = Baseline.from_terms([Term("d", "y[k-1]", 1.02, fixed=True), Term("g", "u[k]", 1.0)])
    found = estimate(first_order(0), growing, learner=None, criterion=Simulation(8, 0))
    assert found.status.ok and np.isfinite(found.status.loss) and found.status.loss > 1


@pytest.mark.parametrize("learner", [None, NETWORK], ids=["no learner", "learner"])
def test_a_free_run_that_nothing_can_save(learner):
    hopeless = Baseline.from_terms(
        [Term("d", "y[k-1]**3", 1e3, fixed=True), Term("g", "u[k]", 1.0)]
    )
    found = estimate(
        first_order(0), hopeless, learner=learner, criterion=Simulation(64, 8, 3), solver=LM
    )
    assert found.status.code == "non_finite" and not found.status.ok and found.status.message
    assert np.isfinite(found.parameters["value"]).all() and found.std is None
    assert "non_finite" in found.summary()


def runaway(seed):
    """A linear learner of y[k-1] alone, from weights that feed back far too much."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=300)
    y = scipy.signal.lfilter([0.5], [1, -0.9], u) + 0.01 * rng.normal(size=300)
    physics = Baseline.from_terms([Term("g", "u[k]", 0.4)])
    learner = MLP(hidden=(), inputs=("y[k-1]",))
    return estimate(Record.from_arrays(u, y), physics, learner=learner, criterion=Simulation(256, 8, 0), solver=LM,
                    seed=seed)  # fmt: skip


def test_a_start_that_would_run_away_is_silenced():
    found = runaway(0)
    assert found.status.code == "converged" and found.status.loss < 1e-3 and found.defect <= 1e-12


def unstable(rows=300):
    """`y = 1.2 y₁ + u` held by feedback: over 256 steps its one-step solution runs away."""
    rng, u, y = np.random.default_rng(0), np.zeros(rows), np.zeros(rows)
    for k in range(1, rows):
        y[k] = 1.2 * y[k - 1] + u[k - 1] + 0.05 * rng.normal()
        u[k] = rng.normal() - 0.6 * y[k]
    return Record.from_arrays(u, y)


def test_physics_alone_that_runs_away_trains_over_segments_that_lengthen(monkeypatch):
    steps, over = [], SegmentedLagged.over

    def counted(self, segment):
        steps.append(segment)
        return over(self, segment)

    monkeypatch.setattr(SegmentedLagged, "over", counted)
    physics = Baseline.from_terms([Term("a", "y[k-1]"), Term("b", "u[k-1]")])
    found = estimate(unstable(), physics, learner=None, criterion=Simulation(256, 8), solver=LM)
    assert (
        found.status.ok
        and found.status.loss == found.status.start_loss < 1
        and steps[0] == 4
        and len(steps) > 2
    )


@pytest.mark.parametrize("seed", range(2, 6))
def test_a_run_that_shorter_segments_do_not_save_ends_in_words(seed):
    """No exception and no warning of NumPy's, whatever size the errors have."""
    found = runaway(seed)
    assert found.status.ok == bool(np.isfinite(found.status.loss))
    assert np.isfinite(found.theta).all()


# --- standard errors


def monte_carlo(draws, **options):
    """θ and its reported standard deviation over draws of the sensor's noise."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=300)
    y = scipy.signal.lfilter([0.5], [1, -0.9], u)
    fits = [
        estimate(
            Record.from_arrays(u, y + 0.3 * np.random.default_rng(100 + s).normal(size=300)),
            FIRST,
            **options,
        )
        for s in range(draws)
    ]
    return np.array([f.theta for f in fits]), np.array([f.std for f in fits])


@pytest.mark.parametrize(
    "criterion", [Simulation(64, 8), Simulation(0, 0)], ids=["segments", "whole"]
)
def test_standard_deviations_of_the_physics(criterion):
    theta, std = monte_carlo(60, learner=None, criterion=criterion)
    np.testing.assert_allclose(std.mean(axis=0), theta.std(axis=0, ddof=1), rtol=0.25)
    assert np.all(
        np.abs(theta.mean(axis=0) - [0.9, 0.5]) < 4 * theta.std(axis=0, ddof=1) / np.sqrt(60)
    )


@pytest.mark.proof
def test_standard_deviations_beside_a_regularised_learner(record_property):
    criterion, solver = Simulation(64, 8, 10), LevenbergMarquardt()
    theta, std = monte_carlo(
        60, learner=MLP((2,)), criterion=criterion, regularization="evidence", solver=solver
    )
    ratio = theta.std(axis=0, ddof=1) / std.mean(axis=0)
    record_property("scatter over std", ", ".join(f"{one:.2f}" for one in ratio))
    np.testing.assert_allclose(std.mean(axis=0), theta.std(axis=0, ddof=1), rtol=0.25)


def test_evidence_keeps_a_learner_that_the_data_need():
    """Coloured errors of an early iterate must not switch the learner off for good."""
    rng = np.random.default_rng(2)
    u, y = rng.normal(size=300), np.zeros(300)
    for k in range(1, 300):
        y[k] = 0.7 * y[k - 1] + u[k] + 0.5 * np.tanh(2 * y[k - 1])
    given = Record.from_arrays(u, y + 0.05 * rng.normal(size=300))
    options = {"learner": MLP((8,)), "criterion": Simulation(), "solver": LevenbergMarquardt(80)}
    found, ridge = (estimate(given, FIRST, regularization=r, **options) for r in ("evidence", 1.0))
    assert found.effective_weights > 3 and found.status.loss < 2 * ridge.status.loss


def test_a_run_that_is_stopped_is_kept_and_tried_on_no_block():
    def enough_after_physics(run, iteration, loss):
        if iteration > 12:
            raise StopTraining

    found = choosing(
        record(), PHYSICS, learner=NETWORK, solver=LM, criterion=FREE, progress=enough_after_physics
    )
    assert found.status.code == "stopped" and found.held_out is None
    assert found.status.loss < found.status.start_loss and found.learns
    assert any(
        "none was tried on held-out blocks" in w.text for w in found.warnings if w.code == "stopped"
    )


def test_a_theta_that_the_data_do_not_determine_beside_the_learner_has_a_sentence(monkeypatch):
    nothing = np.full((3, 3), np.nan)
    monkeypatch.setattr("orthaug.fitting.simulation_task.theta_block", lambda *_: nothing)
    fit = choosing(nonlinear(), PHYSICS, learner=NETWORK, criterion=FREE, blocks=0)
    assert np.isnan(fit.std).all()
    assert [w.text[:60] for w in fit.warnings if w.code == "no_standard_errors"] == [
        "no standard errors: together with the learner's weights, the"
    ]
