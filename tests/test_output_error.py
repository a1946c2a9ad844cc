"""The solver's loop with the free run's damping on explicit least squares, and the evidence of coloured residuals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import pytest
import scipy.optimize
import scipy.signal

from orthaug.fitting.colour import independent_share
from orthaug.fitting.solvers.damped_step import MARQUARDT
from orthaug.fitting.solvers.limit import Limit
from orthaug.fitting.solvers.minimize import SquaredResiduals, minimize


@dataclass
class LeastSquares:
    """`‖r(p)‖²` with the Jacobian of r; `independent` is what it says of its residuals."""

    residual: Callable
    jacobian: Callable
    independent: tuple[float, float] = (100.0, 1.0)
    trials: list = field(default_factory=list)
    sign: float = -1.0
    physics: int = 0

    def loss(self, p):
        return float(np.sum(self.residual(p) ** 2))

    def evaluate(self, p, start):
        self.trials.append(p.copy())
        return TrialPoint(p, self.loss(p))

    def normal(self, p):
        j = self.jacobian(p)
        return j.T @ j, self.sign * j.T @ self.residual(p)

    def linearise(self, point):
        return Linear(*self.normal(point.p), None)

    def samples(self, point):
        return self.independent


class TrialPoint(NamedTuple):
    p: np.ndarray
    loss: float


class Linear(NamedTuple):
    hessian: np.ndarray
    gradient: np.ndarray
    start: None


class Outcome(NamedTuple):
    """Where a run ended."""

    p: np.ndarray
    hessian: np.ndarray | None
    loss: float
    ridge: float
    effective: float
    iterations: int
    code: str


def run(objective, p, *, physics=None, iterations=200, **options):
    options = {
        "limit": Limit(iterations, iterations),
        "tolerance": 1e-14,
        "damping": MARQUARDT,
    } | options
    objective.physics = len(p) if physics is None else physics
    end = minimize(objective, np.array(p, dtype=float), None, **options)
    hessian = None if end.linear is None else end.linear.hessian
    return Outcome(
        end.point.p,
        hessian,
        end.point.loss,
        end.ridge,
        end.effective,
        end.iterations,
        end.ending.code,
    )


def linear(rows=30, columns=4, seed=0, **options):
    """(matrix, right-hand side, objective) of a linear problem whose columns differ in size."""
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(rows, columns)) * 10.0 ** np.arange(columns)
    right = rng.normal(size=rows)
    return matrix, right, LeastSquares(lambda p: matrix @ p - right, lambda p: matrix, **options)


def rosenbrock():
    return LeastSquares(
        lambda p: np.array([10 * (p[1] - p[0] ** 2), 1 - p[0]]),
        lambda p: np.array([[-20 * p[0], 10.0], [-1.0, 0.0]]),
    )


def decay(seed=1):
    """y = a exp(−b t) + c and noise."""
    t = np.linspace(0, 4, 40)
    y = 2 * np.exp(-1.3 * t) + 0.5 + 0.05 * np.random.default_rng(seed).normal(size=40)
    return LeastSquares(
        lambda p: p[0] * np.exp(-p[1] * t) + p[2] - y,
        lambda p: np.stack([np.exp(-p[1] * t), -p[0] * t * np.exp(-p[1] * t), np.ones(40)], axis=1),
    )


def test_the_tests_have_an_objective():
    assert isinstance(rosenbrock(), SquaredResiduals)


def test_linear_least_squares():
    matrix, right, objective = linear()
    found = run(objective, np.ones(4))
    expected = np.linalg.lstsq(matrix, right, rcond=None)[0]
    np.testing.assert_allclose(found.p, expected, rtol=1e-8)
    assert found.loss == pytest.approx(np.sum((matrix @ expected - right) ** 2), rel=1e-12)
    assert found.code == "converged" and found.effective == 0
    np.testing.assert_array_equal(found.hessian, matrix.T @ matrix)


def test_rosenbrock():
    found = run(rosenbrock(), [-1.2, 1.0])
    np.testing.assert_allclose(found.p, [1, 1], rtol=1e-8)
    assert found.code == "converged" and found.iterations < 60


def test_the_limit_of_iterations_is_reported():
    found = run(rosenbrock(), [-1.2, 1.0], iterations=3)
    assert found.code == "iteration_limit" and found.iterations == 3
    assert found.loss < rosenbrock().loss(np.array([-1.2, 1.0]))


BOXES = [
    ((0, 0, 0), (1.5, 5, 5)),
    ((0, 1.6, 0.6), (9, 9, 9)),
    ((0, 0, 0), (1.5, 1.0, 9)),
    ((-9, -9, -9), (9, 9, 9)),
]


def by_scipy(objective, box):
    start, exact = np.clip(np.ones(3), *box), {"ftol": 1e-15, "xtol": 1e-15, "gtol": 1e-15}
    return scipy.optimize.least_squares(
        objective.residual, start, objective.jacobian, box, **exact
    ).x


@pytest.mark.parametrize("box", BOXES, ids=str)
def test_bounds_as_scipy_has_them(box):
    expected = by_scipy(decay(), box)
    found = run(decay(), [1.0, 1.0, 1.0], bounds=np.array(box, dtype=float))
    np.testing.assert_allclose(found.p, expected, rtol=1e-6)
    for value, other, low, high in zip(found.p, expected, *box, strict=True):
        for side in (low, high):
            assert (value == side) == bool(np.isclose(other, side, rtol=1e-6))


def test_no_trial_leaves_the_bounds():
    low, high = np.array(BOXES[1], dtype=float)
    objective = decay()
    run(objective, [50.0, -7.0, 0.0], bounds=(low, high))
    assert len(objective.trials) > 3
    assert all(np.all((low <= p) & (p <= high)) for p in objective.trials)


def test_bounds_are_those_of_the_physics_alone():
    found = run(decay(), [1.0, 1.0, 1.0], physics=1, bounds=(np.array([0.0]), np.array([1.5])))
    box = ([0, -np.inf, -np.inf], [1.5, np.inf, np.inf])
    np.testing.assert_allclose(found.p, by_scipy(decay(), box), rtol=1e-6)


def test_a_start_at_a_bounded_minimum_has_converged():
    """Nothing is left to do: the gradient points out of the box, and the others are at their best."""
    at = run(decay(), [1.0, 1.0, 1.0], bounds=np.array(BOXES[0], dtype=float))
    again = run(decay(), at.p, bounds=np.array(BOXES[0], dtype=float))
    np.testing.assert_allclose(again.loss, at.loss, rtol=2e-14)  # the run's tolerance
    np.testing.assert_allclose(
        again.p, at.p, rtol=1e-7
    )  # its root: what a loss that is flat there tells of p
    assert at.p[0] == 1.5 and again.code == "converged"


def test_everything_at_a_bound_from_the_start_has_converged():
    _, _, objective = linear(columns=1)
    best = run(objective, [0.0]).p
    found = run(objective, best - 1, bounds=(best - 2, best - 1))
    np.testing.assert_array_equal(found.p, best - 1)
    assert found.code == "converged"


@pytest.mark.parametrize("wild", [np.nan, np.inf])
def test_trials_that_are_not_finite_are_rejected(wild):
    """arctan p from p = 1.3: the Gauss-Newton step leads far to the other side, where there is no value."""
    objective = LeastSquares(
        lambda p: np.where(p > -0.5, np.arctan(p), wild),
        lambda p: np.array([[1 / (1 + p[0] ** 2)]]),
    )
    found = run(objective, [1.3])
    assert min(p[0] for p in objective.trials) < -0.5
    assert abs(found.p[0]) < 1e-6 and found.code == "converged"


def test_a_start_that_is_not_finite():
    objective = LeastSquares(lambda p: np.log(p), lambda p: np.diag(1 / p))
    with np.errstate(invalid="ignore"):
        found = run(objective, [-1.0])
    assert found.code == "non_finite" and found.iterations == 0
    np.testing.assert_array_equal(found.p, [-1.0])
    assert found.hessian is None


def test_a_start_whose_jacobian_is_not_finite():
    objective = LeastSquares(lambda p: np.sqrt(p) - 1, lambda p: np.array([[np.inf]]))
    assert run(objective, [0.0]).code == "non_finite"


def test_a_trial_whose_jacobian_is_not_finite_is_rejected():
    """The minimum itself is refused; the run ends beside it."""
    objective = LeastSquares(
        lambda p: p - 1, lambda p: np.array([[1.0 if p[0] < 0.99 else np.nan]])
    )
    found = run(objective, [0.0])
    assert 0.5 < found.p[0] < 0.99 and np.isfinite(found.hessian).all()


def test_a_wrong_gradient_has_no_descent():
    _, _, objective = linear()
    objective.sign = 1.0
    found = run(objective, np.ones(4))
    assert found.code == "no_descent"
    np.testing.assert_array_equal(found.p, np.ones(4))


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_start_at_a_minimum_has_converged(noise):
    matrix = np.random.default_rng(2).normal(size=(20, 3))
    right = matrix @ [1.0, 2.0, 3.0] + noise * np.random.default_rng(3).normal(size=20)
    best = np.linalg.lstsq(matrix, right, rcond=None)[0]
    found = run(LeastSquares(lambda p: matrix @ p - right, lambda p: matrix), best)
    assert found.code == "converged"
    np.testing.assert_allclose(found.p, best, rtol=1e-10)


def test_curvature_lost_to_rounding_is_mended_by_damping():
    """The normal matrix is not positive definite by more than the first damping: Cholesky fails until it grows."""
    matrix, right, objective = linear(columns=2)
    unit = 1 / np.linalg.norm(matrix, axis=0)
    wrong = np.array([[1.0, 1.01], [1.01, 1.0]]) / np.outer(unit, unit)
    objective.normal = lambda p: (wrong, matrix.T @ (right - matrix @ p))
    start = objective.loss(np.ones(2))
    found = run(objective, np.ones(2))
    assert found.iterations > 1 and found.loss < 0.9 * start


def test_columns_that_do_nothing_are_left_alone():
    matrix, right, objective = linear(columns=3)
    matrix[:, 1] = 0
    found = run(objective, np.ones(3))
    expected = np.linalg.lstsq(matrix, right, rcond=None)[0]
    np.testing.assert_allclose(found.p, np.where(np.arange(3) == 1, 1.0, expected), rtol=1e-6)


def test_twin_columns_end_at_the_least_loss():
    matrix, right, objective = linear(columns=3)
    matrix[:, 1] = matrix[:, 0]
    found = run(objective, np.ones(3))
    expected = np.linalg.lstsq(matrix, right, rcond=None)[0]
    assert found.loss == pytest.approx(np.sum((matrix @ expected - right) ** 2), rel=1e-10)


@pytest.mark.parametrize("physics", [0, 2, 4])
def test_the_ridge_acts_on_the_weights_alone(physics):
    matrix, right, objective = linear()
    found = run(objective, np.ones(4), physics=physics, ridge=30.0)
    penalty = 30.0 * np.diag(np.arange(4) >= physics)
    np.testing.assert_allclose(
        found.p, np.linalg.solve(matrix.T @ matrix + penalty, matrix.T @ right), rtol=1e-8
    )
    assert (
        found.loss == pytest.approx(np.sum((matrix @ found.p - right) ** 2)) and found.ridge == 30.0
    )


def test_effective_weights_are_the_trace():
    """tr(H (H + αI)⁻¹) with H of the weights after projection on what the physics cannot express."""
    matrix, _, objective = linear()
    found = run(objective, np.ones(4), physics=2, ridge=30.0)
    rest = (
        matrix[:, 2:] - matrix[:, :2] @ np.linalg.lstsq(matrix[:, :2], matrix[:, 2:], rcond=None)[0]
    )
    h = rest.T @ rest
    assert found.effective == pytest.approx(
        np.trace(h @ np.linalg.inv(h + 30 * np.eye(2))), rel=1e-10
    )


def mackay(matrix, right, physics, samples, share, steps=5000):
    """α of the linear-Gaussian problem by plain iteration of `α = γσ²/(κ‖w‖²)`."""
    penalty = np.diag(np.arange(matrix.shape[1]) >= physics).astype(float)
    basis = np.linalg.qr(matrix[:, :physics])[0]
    rest = matrix[:, physics:] - basis @ (basis.T @ matrix[:, physics:])
    values, alpha = np.linalg.eigvalsh(rest.T @ rest), 1.0
    for _ in range(steps):
        p = np.linalg.solve(matrix.T @ matrix + alpha * penalty, matrix.T @ right)
        gamma = np.sum(values / (values + alpha))
        variance = np.sum((right - matrix @ p) ** 2) / (samples - gamma / share)
        alpha = gamma * variance / (share * np.sum(p[physics:] ** 2))
    return alpha, gamma, p


@pytest.mark.parametrize(("physics", "share"), [(0, 1.0), (2, 1.0), (2, 0.3)])
def test_evidence_ends_at_mackays_fixed_point(physics, share):
    rng = np.random.default_rng(5)
    matrix = rng.normal(size=(120, 8))
    right = matrix @ (0.4 * rng.normal(size=8)) + rng.normal(size=120)
    independent = (120.0 - physics, share)
    objective = LeastSquares(lambda p: matrix @ p - right, lambda p: matrix, independent)
    found = run(objective, np.ones(8), physics=physics, ridge=1.0, evidence=True)
    alpha, gamma, p = mackay(matrix, right, physics, *independent)
    assert 0.5 < gamma < 8 - physics - 0.2
    assert found.ridge == pytest.approx(alpha, rel=1e-5)
    assert found.effective == pytest.approx(gamma, rel=1e-5)
    np.testing.assert_allclose(found.p, p, rtol=1e-5, atol=1e-6)


def test_evidence_of_coloured_residuals_is_weaker():
    rng = np.random.default_rng(5)
    matrix = rng.normal(size=(120, 8))
    right = matrix @ (0.4 * rng.normal(size=8)) + rng.normal(size=120)
    ridges = [
        run(LeastSquares(lambda p: matrix @ p - right, lambda p: matrix, (120.0, share)), np.ones(8), physics=0,
            ridge=1.0, evidence=True).ridge
        for share in (1.0, 0.5)
    ]  # fmt: skip
    assert ridges[1] > 1.5 * ridges[0]


def test_progress_is_called_at_every_iteration():
    entries = []
    found = run(rosenbrock(), [-1.2, 1.0], progress=lambda i, loss: entries.append((i, loss)))
    assert [i for i, _ in entries] == list(range(1, found.iterations + 1))
    losses = [loss for _, loss in entries]
    assert (
        all(b <= a for a, b in zip(losses, losses[1:], strict=False)) and losses[-1] == found.loss
    )


# --- how many of the residuals are independent


def naive_share(stretches):
    """1 / (1 + 2 Σ ρ_i) up to the first correlation that is noise, by loops."""
    longest, count = stretches.shape[1], np.count_nonzero(stretches)
    covariance = [sum(sum(row[t] * row[t + lag] for t in range(longest - lag)) for row in stretches)
                  for lag in range(longest)]  # fmt: skip
    total = 0.0
    for value in covariance[1:]:
        if value / covariance[0] < max(0.05, 2 / np.sqrt(count)):
            break
        total += value / covariance[0]
    return 1 / (1 + 2 * total)


def autoregression(rho, shape, seed=0):
    """AR(1) of the given shape, at rest far before its beginning."""
    white = np.random.default_rng(seed).normal(size=(shape[0], shape[1] + 200))
    return scipy.signal.lfilter([1.0], [1.0, -rho], white, axis=1)[:, 200:]


@pytest.mark.parametrize("shape", [(1, 200), (5, 31), (20, 3), (3, 64)], ids=str)
@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_independent_share_by_loops(rho, shape):
    residuals = autoregression(rho, shape)
    residuals[:, : shape[1] // 4] = 0.0  # a washout
    assert independent_share(residuals) == pytest.approx(naive_share(residuals), rel=1e-9)


@pytest.mark.parametrize("rho", [0.3, 0.6, 0.9])
def test_independent_share_of_a_first_order_process(rho):
    found = independent_share(autoregression(rho, (4, 20_000)))
    assert found == pytest.approx((1 - rho) / (1 + rho), rel=0.12)


def test_white_residuals_are_independent():
    assert independent_share(autoregression(0.0, (4, 5_000))) == pytest.approx(1, abs=0.02)


def test_stretches_are_never_mixed():
    """Each stretch is a constant, every other one negative: what is in one says nothing of the next."""
    residuals = np.where(np.arange(40) % 2, 1.0, -1.0)[:, None] * np.ones(50)
    assert independent_share(residuals) == independent_share(np.abs(residuals))
    assert independent_share(residuals) < 0.6 * independent_share(residuals.reshape(1, -1))


@pytest.mark.parametrize(
    "residuals", [np.zeros((3, 20)), np.ones((5, 2)), np.zeros((0, 9))], ids=lambda r: str(r.shape)
)
def test_residuals_that_say_nothing_count_as_independent(residuals):
    assert independent_share(residuals) == 1.0


def test_a_weight_that_does_nothing_is_not_effective():
    matrix, right, _ = linear(columns=3)
    matrix = matrix * [1.0, 1.0, 0.0]
    end = run(LeastSquares(lambda p: matrix @ p - right, lambda p: matrix), np.zeros(3), physics=1)
    assert end.effective == pytest.approx(1.0) and end.code == "converged" and end.p[2] == 0.0
