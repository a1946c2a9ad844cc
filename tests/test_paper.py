"""What the paper claims and what its examples must give: theorems, numbers, and the additive structure's scatter."""

from __future__ import annotations

import numpy as np
import pytest

from orthaug import (
    MLP,
    Additive,
    Baseline,
    LevenbergMarquardt,
    Record,
    Term,
    estimate,
    orthogonalize,
    synthetic,
)
from orthaug.physics.projection import Projection

SEEDS = range(2)
LEARNERS = [
    None,
    MLP(hidden=()),
    MLP(hidden=(3,)),
    MLP(hidden=(8, 4), activation="relu"),
    MLP(hidden=(5,), activation="gelu"),
    MLP(hidden=(16,), activation="sigmoid"),
]
NAMES = ["none", "linear", "3", "8-4-relu", "5-gelu", "16-sigmoid"]


def matrix(fit) -> tuple[np.ndarray, np.ndarray]:
    """Φ (N, nθ) and the learner's part before projection, F (N,), of an estimate with one output."""
    rows = fit.problem.rows
    phi = fit.problem.baseline.phi(rows.x, rows.layout, fit.problem.outputs, np)[:, 0]
    (trajectory,) = fit.model.components(fit.problem.record).trajectories
    return phi, trajectory.learner_before[rows.start :, 0]


def rmse(fit, record: Record) -> float:
    return float(fit.model.predict(record).scores().rmse[0])


@pytest.fixture(
    scope="module", params=[1, *(pytest.param(which, marks=pytest.mark.proof) for which in (2, 3))]
)
def noiseless(request):
    example = synthetic.static(request.param)
    options = {"regularization": "none"}
    return (
        request.param,
        example,
        [estimate(example.train, example.baseline, seed=s, **options) for s in SEEDS],
    )


@pytest.fixture(scope="module")
def noisy():
    example = synthetic.static(1, noise=True)
    fits = [estimate(example.train, example.baseline, seed=seed) for seed in SEEDS]
    return example, fits


@pytest.fixture(scope="module")
def additive():
    example = synthetic.static(1)
    return example, [
        estimate(
            example.train, example.baseline, structure=Additive(), regularization="none", seed=s
        )
        for s in SEEDS
    ]


@pytest.fixture(scope="module")
def spring():
    example = synthetic.mass_spring_damper()
    solver = LevenbergMarquardt(iterations=100)
    return example, [
        estimate(example.train, example.baseline, solver=solver, seed=seed) for seed in range(2)
    ]


ERROR = {1: (0.0, 1e-12), 2: (0.0795547, 5e-8), 3: (0.1433322, 5e-8)}  # ‖θ* − θ̂‖ without noise


def test_theta_on_the_static_sets(noiseless):
    data_set, example, fits = noiseless
    expected, within = ERROR[data_set]
    for fit in fits:
        assert np.linalg.norm(fit.theta - example.theta) == pytest.approx(expected, abs=within)
        np.testing.assert_allclose(fit.theta, fits[0].theta, rtol=0, atol=1e-10)
        assert fit.defect <= 1e-12


@pytest.mark.parametrize("learner", LEARNERS, ids=NAMES)
def test_theta_is_the_same_for_every_learner(noiseless, learner):
    _, example, fits = noiseless
    fit = estimate(
        example.train,
        example.baseline,
        learner=learner,
        solver=LevenbergMarquardt(20),
        regularization="none",
    )
    np.testing.assert_allclose(fit.theta, fits[0].theta, rtol=0, atol=1e-10)
    assert fit.defect is None if learner is None else fit.defect <= 1e-12


def test_static_sets_are_learned_without_noise(noiseless):
    _, example, fits = noiseless
    assert (
        np.median([rmse(fit, example.test) for fit in fits]) <= 5e-6
    )  # the published scripts: 6e-5 to 6e-4


def test_static_set_with_noise(noisy):
    example, fits = noisy
    for fit in fits:
        assert np.linalg.norm(fit.theta - example.theta) == pytest.approx(0.0089013, abs=5e-8)
        assert fit.defect <= 1e-12
    errors = [rmse(fit, example.test) for fit in fits]
    assert (
        np.median(errors) <= 7.1e-4 and max(errors) <= 8e-4
    )  # the published scripts: 6.9e-4 to 7.2e-4


def test_the_default_leaves_few_weights(noisy):
    assert all(3 < fit.effective_weights < 15 for fit in noisy[1])


@pytest.mark.parametrize("learner", LEARNERS, ids=NAMES)
def test_theta_with_noise_is_the_same_for_every_learner(noisy, learner):
    example, fits = noisy
    fit = estimate(
        example.train,
        example.baseline,
        learner=learner,
        solver=LevenbergMarquardt(20),
        regularization="none",
    )
    np.testing.assert_allclose(fit.theta, fits[0].theta, rtol=0, atol=1e-10)


def test_mass_spring_damper(spring):
    example, fits = spring
    for fit in fits:
        np.testing.assert_allclose(fit.theta, [0.471697779, -0.471758489, 4.76104182e-5], rtol=2e-9)
        assert np.linalg.norm(fit.theta / example.theta - 1) == pytest.approx(0.013254, abs=5e-7)
        assert fit.status.iterations <= 100 and fit.defect <= 1e-12
        assert rmse(fit, example.test) <= 1.5e-5  # the published scripts: 3.4e-5 to 1.8e-4


def test_additive_theta_scatters_while_predictions_agree(additive, noiseless):
    example, fits = additive
    scatter = np.ptp([fit.theta for fit in fits], axis=0)
    assert (scatter > 0.02).all()
    assert max(rmse(fit, example.test) for fit in fits) < 1e-5
    assert all("not unique" in " ".join(map(str, fit.warnings)) and fit.std is None for fit in fits)


def test_additive_has_no_orthogonality_to_report(additive):
    """Its model subtracts no θ_aux, so its learner does overlap with the physics."""
    fit = additive[1][0]
    phi, learner = matrix(fit)
    q = np.linalg.qr(phi)[0]
    assert np.linalg.norm(q.T @ learner) > 0.1 * np.linalg.norm(learner)
    assert fit.defect is None or fit.defect > 0.1


def test_lemma_1(noiseless, spring):
    """Φᵀ F̃ = 0 on the training rows (eq:orth_property), of the model's own output."""
    for fit in (noiseless[2][0], spring[1][0]):
        (trajectory,) = fit.model.components(fit.problem.record).trajectories
        phi, before = matrix(fit)
        projected = trajectory.learner[fit.problem.rows.start :, 0]
        overlap = (phi / np.linalg.norm(phi, axis=0)).T @ projected
        assert np.linalg.norm(overlap) <= 1e-12 * np.linalg.norm(before)


@pytest.mark.parametrize("data_set", [1, 2, 3])
@pytest.mark.parametrize("learner", LEARNERS[:3], ids=NAMES[:3])
def test_theorem_1(data_set, learner):
    """‖θ* − θ̂‖ = ‖Φ⁺Δ‖ (eq:error_val): without noise it holds however good the fit is."""
    example = synthetic.static(data_set)
    fit = estimate(
        example.train,
        example.baseline,
        learner=learner,
        solver=LevenbergMarquardt(20),
        regularization="none",
    )
    u = example.train.experiments[0].inputs[:, 0]
    delta = 0.01 - 0.5 * u**2
    error = np.linalg.lstsq(np.stack([u, u**3], axis=1), delta, rcond=None)[0]
    np.testing.assert_allclose(fit.theta - example.theta, error, rtol=0, atol=1e-12)


def test_error_of_the_additive_structure(additive):
    """‖θ* − θ̂‖ = ‖Φ⁺(F − Δ)‖ (eq:baseline_error_simple_augm) as far as the model fits, to 1e-5 here."""
    example, fits = additive
    u = example.train.experiments[0].inputs[:, 0]
    for fit in fits:
        phi, learner = matrix(fit)
        expected = np.linalg.lstsq(phi, learner - (0.01 - 0.5 * u**2), rcond=None)[0]
        np.testing.assert_allclose(example.theta - fit.theta, expected, atol=1e-10)
        assert np.linalg.norm(example.theta - fit.theta) == pytest.approx(
            np.linalg.norm(expected), abs=1e-10
        )


THETA = np.array([1.0, 1.0])
TWINS = Baseline.from_terms([Term("a", "u[k]"), Term("b", "v[k]")])


def twins() -> tuple[Record, np.ndarray, np.ndarray]:
    """Record, Φ and Δ of `y = u + v + δ`, u and v nearly the same signal and δ a function of what they differ in."""
    u, w = np.random.default_rng(4).normal(size=(2, 400))
    phi = np.stack([u, u + 1e-3 * w], axis=1)
    delta = missing(phi)
    return Record.from_arrays(phi, phi @ THETA + delta, inputs=["u", "v"]), phi, delta


def missing(x: np.ndarray) -> np.ndarray:
    """δ(x) (N,)."""
    w = 1e3 * (x[:, 1] - x[:, 0])
    return w + 0.5 * (w**2 - 1)


def test_a_dominant_physics_orders_the_errors_in_the_norm_of_phi_alone():
    """‖Φθ*‖ > ‖Δ‖, yet the member θ = 0 of the equivalence set is nearer to θ* than θ̂ = θ* + Φ⁺Δ."""
    record, phi, delta = twins()
    error = estimate(record, TWINS, learner=None).theta - THETA
    np.testing.assert_allclose(error, np.linalg.lstsq(phi, delta, rcond=None)[0], rtol=1e-9)
    assert np.linalg.norm(phi @ THETA) > 1.3 * np.linalg.norm(
        delta
    )  # the assumption, with room to spare
    assert np.linalg.norm(error) > 500 * np.linalg.norm(THETA)
    assert np.linalg.norm(phi @ THETA) > np.linalg.norm(delta) > np.linalg.norm(phi @ error)


@pytest.mark.parametrize("seed", range(20))
def test_a_dominant_physics_errs_least_in_the_norm_of_phi(seed):
    """‖Φθ*‖ > ‖Δ‖ ≥ ‖ΦΦ⁺Δ‖ of any physics, however its columns depend on each other; by a thousandth here."""
    rng = np.random.default_rng(seed)
    phi = (
        rng.normal(size=(30, 4)) @ np.diag(10.0 ** rng.uniform(-4, 4, 4)) @ rng.normal(size=(4, 4))
    )
    theta, delta = rng.normal(size=4), phi @ rng.normal(size=4) + 0.1 * rng.normal(size=30)
    delta *= 0.999 * np.linalg.norm(phi @ theta) / np.linalg.norm(delta)
    assert np.linalg.norm(phi @ theta) > np.linalg.norm(
        Projection.factor(phi[:, None]).solve(delta[:, None]) @ phi.T
    )


@pytest.mark.parametrize("further", [0.0, 0.01, -0.5])
def test_the_orthogonal_solution_is_in_the_equivalence_set(further):
    """A member (θ, F) has Φθ + F = Φθ* + Δ (eq:eqivalence_set_std). With F = (I − ΦΦ⁺)Δ it is the orthogonal one.

    So the supremum of ‖θ* − θ‖ is no less than its error, and larger where the learner reaches a little further.
    """
    record, phi, delta = twins()
    exact = orthogonalize(record, TWINS, lambda x: x @ THETA + missing(x))  # fits without error
    error = exact.theta - THETA
    (orthogonal,) = exact.model.components(record).trajectories
    rest = delta - phi @ np.linalg.lstsq(phi, delta, rcond=None)[0]
    np.testing.assert_allclose(orthogonal.learner[:, 0], rest, atol=1e-9)
    np.testing.assert_allclose(orthogonal.model[:, 0], phi @ THETA + delta, atol=1e-9)
    theta = exact.theta + further * error
    values = orthogonal.learner[:, 0] - further * (phi @ error)
    np.testing.assert_allclose(phi @ theta + values, phi @ THETA + delta, atol=1e-9)
    # Eq:baseline_error_simple_augm
    shown = np.linalg.norm(np.linalg.lstsq(phi, values - delta, rcond=None)[0])
    assert shown == pytest.approx((1 + further) * np.linalg.norm(error), rel=1e-9)
    assert (shown > (1 + 1e-9) * np.linalg.norm(error)) == (further > 0)


LINEAR = Baseline.from_terms([Term("a", "y[k-1]"), Term("b", "u[k-1]"), Term("offset", "1")])


def first_order(noise: float) -> Record:
    """y[k] = 0.7 y[k-1] + 0.3 u[k-1] + 0.1, the physics of the paper's Example 1, with an offset."""
    rng = np.random.default_rng(0)
    u, e = rng.normal(size=(2, 300))
    y = np.zeros(300)
    for k in range(1, 300):
        y[k] = 0.7 * y[k - 1] + 0.3 * u[k - 1] + 0.1 + noise * e[k]
    return Record.from_arrays(u, y)


@pytest.mark.parametrize("regularization", ["none", "evidence", 1.0])
@pytest.mark.parametrize("noise", [0.1, 0.0])
def test_example_1(noise, regularization):
    """A linear learner on the physics' own regressors: P⊥J = 0, said in a sentence, θ least squares."""
    record = first_order(noise)
    fit = estimate(record, LINEAR, learner=MLP(hidden=()), regularization=regularization)
    alone = estimate(record, LINEAR, learner=None)
    assert (
        sum("the learner lies in the span of the physics" in str(text) for text in fit.warnings)
        == 1
    )
    assert fit.status.code == "converged" and np.isfinite(fit.status.loss)
    np.testing.assert_allclose(fit.theta, alone.theta, rtol=1e-12)
    np.testing.assert_allclose(fit.std, alone.std, rtol=1e-6, atol=1e-14)
    prediction = fit.model.predict(record)
    assert np.isfinite(prediction.model[1:]).all()
    np.testing.assert_allclose(prediction.model, alone.model.predict(record).model, atol=1e-12)
    if not noise:
        np.testing.assert_allclose(fit.theta, [0.7, 0.3, 0.1], rtol=1e-12)


def test_example_1_without_orthogonality():
    """Any (θ, W) with θ + W = θ* is a minimum of the additive structure: the sum is found, the parts are not."""
    record = first_order(0.1)
    thetas = [
        estimate(record, LINEAR, learner=MLP(hidden=()), structure=Additive(), seed=s).theta
        for s in range(3)
    ]
    assert np.ptp(thetas, axis=0).max() > 0.02
