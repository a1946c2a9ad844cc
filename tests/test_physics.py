"""The map between physical parameters and θ: derivatives, inverse, statistics, and what is refused in which words."""

from __future__ import annotations

import json
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from orthaug import Baseline, InputError, PhysicalParameter, PhysicsMap, Term
from orthaug.analysis.fit_findings import physical_rows
from orthaug.data.expressions import FUNCTIONS, Expression
from orthaug.inference.physical import profile, solve
from orthaug.physics.parameters import check_baseline, with_initial

GAMMA = "(m + cd*Ts + ks*Ts**2)"
EULER = {
    "theta1": f"(2*m + cd*Ts) / {GAMMA}",
    "theta2": f"-m / {GAMMA}",
    "theta3": f"Ts**2 / {GAMMA}",
}
PAPER = EULER | {"theta1": f"(2*m - cd*Ts) / {GAMMA}"}
TRUTH = np.array([1.0, 100.0, 1000.0])
P = PhysicalParameter


def texts(found):
    """What the warnings say."""
    return tuple(warning.text for warning in found.warnings)


def spring(theta=EULER, start=(1.1, 90.0, 1100.0), ts=0.01):
    """The mass-spring-damper of Sect. 5.2, p = (m, cd, ks)."""
    units, names = ("kg", "Ns/m", "N/m"), ("m", "cd", "ks")
    return PhysicsMap.of(
        [P(*row, min=0.0) for row in zip(names, start, units, strict=True)], theta, {"Ts": ts}
    )


def one(text, initial=1.0, **bounds):
    """θ of a single physical parameter m."""
    return PhysicsMap.of([P("m", initial, **bounds)], {"a": text})


def two(*texts, initial=(1.0, 2.0), **bounds):
    """θ = (a, b, …) of m, which has the bounds, and q."""
    names = ("a", "b", "c")[: len(texts)]
    return PhysicsMap.of(
        [P("m", initial[0], **bounds), P("q", initial[1])], dict(zip(names, texts, strict=True))
    )


def relative(theta, level=1e-4, correlation=0.6):
    """A covariance of θ with standard errors of `level` and one correlation."""
    std = level * np.abs(theta)
    return np.outer(std, std) * (correlation + (1 - correlation) * np.eye(len(theta)))


# the map and its derivative


def test_the_paper_s_numbers():
    np.testing.assert_allclose(
        spring(PAPER).initial_theta(), [0.6161, -0.5213, 4.739e-5], rtol=1e-4
    )
    np.testing.assert_allclose(
        spring(PAPER).theta(TRUTH), np.array([1.0, -1.0, 1e-4]) / 2.1, rtol=1e-15
    )
    np.testing.assert_allclose(spring().theta(TRUTH), np.array([3.0, -1.0, 1e-4]) / 2.1, rtol=1e-15)


def test_jacobian_of_the_mass_spring_damper():
    m, c, k, ts = 1.3, 80.0, 1500.0, 0.01
    g = m + c * ts + k * ts**2
    slope = np.array([1.0, ts, ts**2])  # of g
    top, dtop = np.array([2 * m + c * ts, -m, ts**2]), np.array([[2, ts, 0], [-1, 0, 0], [0, 0, 0]])
    expected = dtop / g - np.outer(top, slope) / g**2
    np.testing.assert_allclose(
        spring().jacobian(np.array([m, c, k])), expected, rtol=1e-13, atol=1e-22
    )


SMOOTH = [
    "sin(m)*cos(q) + tan(m/3)",
    "exp(-m*q) + log(m) - sqrt(q)",
    "atan(m*q) + atan2(m - 1.1, q) + atan2(-m, -q) + atan2(2, m) + m*floor(3*q)",
    "tanh(m - q)*abs(m - q) + sign(m - q)*q",
    "min(m, q, m*q)*max(m**2, q, 0.1)",
    "m**q + q**m + m**-2 + q**0.5 + m**(1 + 1) + 2**m",
    "(m - q)**2 / (1 + m*q)**3",
    "(m - q)**3 + (q - 5)**2",
    "-m**0 + q*1e3 - +m",
    "abs(-m)*1e-8 + 1e8/q",
    "m**150/q**151 + min(q, 1.5)",
]


@pytest.mark.parametrize("text", SMOOTH)
def test_value_and_derivative_are_those_of_automatic_differentiation(text):
    physics = PhysicsMap.of([P("m", 1.7), P("q", 0.8)], {"a": text, "b": "m", "c": "q"})
    for point in ([1.7, 0.8], [0.3, 2.9], [1.01, 1.0]):

        def value(p):
            return Expression(text, (("m", p[0]), ("q", p[1]))).evaluate({}, jnp)

        theta, jacobian = physics.linearised(np.array(point))
        p = jnp.asarray(point)
        np.testing.assert_allclose(theta[0], value(p), rtol=1e-13)
        np.testing.assert_allclose(
            jacobian[0], jax.jacfwd(value)(p), rtol=1e-12, atol=1e-13 * np.abs(jacobian[0]).max()
        )


def test_every_function_has_a_derivative():
    assert {f for text in SMOOTH for f in re.findall(r"[a-z]{2,}\d?", text)} >= set(FUNCTIONS)


def test_a_kink_has_the_slope_of_a_side():
    kinks = two("abs(m) + min(q, 2)", "max(q, 2) + sign(m)", "m + q", initial=(0.0, 2.0))
    np.testing.assert_array_equal(kinks.jacobian(np.array([0.0, 2.0])), [[1, 1], [0, 1], [1, 1]])


def test_where_there_is_no_value_nothing_is_raised():
    assert math.isinf(
        two("sqrt(m - q) + m", "q", initial=(3.0, 2.0)).jacobian(np.array([2.0, 2.0]))[0, 0]
    )
    assert math.isnan(one("log(m)").theta(np.array([-1.0]))[0])
    assert math.isinf(one("sqrt(m)").jacobian(np.array([0.0]))[0, 0])
    assert not np.isfinite(one("1/m").jacobian(np.array([0.0]))).any()


@pytest.mark.parametrize(
    ("parameter", "text", "size"),
    [
        (P("m", -3.0), "m", 3.0),
        (P("m", 0.0, min=-2.0, max=5.0), "m", 5.0),
        (P("m", 0.0, min=0.0), "4 + m/10", 40.0),
        (P("m", 0.0), "m/10", 10.0),
        (P("m", 0.0), "m**2", 1.0),
    ],
)
def test_the_size_of_a_parameter(parameter, text, size):
    physics = PhysicsMap.of([parameter], {"a": text})
    np.testing.assert_allclose(physics.size, [size])
    points = physics.around(50, 4.0)
    assert (points >= parameter.min).all() and (points <= parameter.max).all()
    np.testing.assert_array_equal(points, physics.around(50, 4.0))


# p̂


def test_a_round_trip_to_the_last_digits():
    for theta in (EULER, PAPER):
        physics = spring(theta)
        found = solve(physics, physics.theta(TRUTH), None, freedom=10)
        np.testing.assert_allclose(found.value, TRUTH, rtol=1e-13)
        assert found.std == (None, None, None) and found.ci95 == (None, None, None)
        assert found.covariance is None and found.consistency is None
        assert texts(found) == (
            "theta has no finite covariance, so the physical parameters have no standard errors.",
        )


factors = st.floats(-1.5, 1.5).map(math.exp)


@given(
    factors, factors, factors, st.sampled_from([1e-3, 0.01, 0.1]), st.sampled_from([EULER, PAPER])
)
def test_round_trips_from_a_distant_start(a, b, c, ts, theta):
    physics, p = spring(theta, start=(1.0, 100.0, 1000.0), ts=ts), TRUTH * [a, b, c]
    target = physics.theta(p)
    found = solve(physics, target, relative(target), freedom=50)
    condition = np.abs(found.sensitivities).max()  # how much the last digit of θ moves p
    np.testing.assert_allclose(found.value, p, rtol=1e-14 * max(condition, 10.0))
    assert texts(found) == ()


@given(st.integers(0, 10**6))
def test_random_invertible_maps(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 5))
    root = rng.normal(size=(n, n))
    # With the cubes below the gradient of a strictly convex function: one-to-one
    a = root @ root.T + np.eye(n)
    scale = 10.0 ** rng.integers(-4, 5, n)
    texts = {
        f"t{i}": " + ".join(f"{float(a[i, j])!r}*(p{j}/{float(scale[j])!r})" for j in range(n))
        + f" + 0.3*(p{i}/{float(scale[i])!r})**3"
        for i in range(n)
    }
    physics = PhysicsMap.of([P(f"p{j}", float(scale[j])) for j in range(n)], texts)
    p = scale * rng.uniform(-3, 3, n)
    found = solve(physics, physics.theta(p), None, freedom=10)
    np.testing.assert_allclose(found.value, p, atol=1e-12 * np.abs(scale).max(), rtol=1e-10)
    slope = np.diag(1 / p) @ np.linalg.inv(physics.jacobian(p)) @ np.diag(physics.theta(p))
    np.testing.assert_allclose(
        found.sensitivities, slope, rtol=1e-7, atol=1e-9 * np.abs(slope).max()
    )


def test_sensitivities_of_the_stiffness():
    """Paper: k = (1 + θ1 + 3 θ2)/θ3, where 1 + 0.476 − 1.43 leaves 0.048; backward Euler: (1 − θ1 − θ2)/θ3."""
    p = np.random.default_rng(3).uniform(0.5, 2, (20, 3)) * TRUTH
    theta = np.stack([spring(PAPER).theta(row) for row in p], axis=1)
    np.testing.assert_allclose((1 + theta[0] + 3 * theta[1]) / theta[2], p[:, 2], rtol=1e-12)
    theta = np.stack([spring().theta(row) for row in p], axis=1)
    np.testing.assert_allclose((1 - theta[0] - theta[1]) / theta[2], p[:, 2], rtol=1e-12)
    for mapping, expected in (
        (PAPER, [[0, 1, -1], [-1, 2, -1], [10, -30, -1]]),
        (EULER, [[0, 1, -1], [3, -2, -1], [-30, 10, -1]]),
    ):
        found = solve(spring(mapping), spring(mapping).theta(TRUTH), None, freedom=10)
        np.testing.assert_allclose(found.sensitivities, expected, atol=1e-10)


def test_sensitivity_of_a_parameter_that_is_zero_does_not_exist():
    found = solve(two("m", "q", initial=(0.5, 1.0)), np.array([0.0, 3.0]), None, freedom=10)
    assert np.isnan(found.sensitivities[0]).all()
    np.testing.assert_allclose(found.sensitivities[1], [0, 1], atol=1e-14)


def test_two_solutions_are_reported():
    found = solve(one("(m - 2)**2", initial=3.5), np.array([1.0]), None, freedom=10)
    np.testing.assert_allclose(found.value, [3.0], rtol=1e-12)
    assert texts(found)[0] == (
        "theta is explained equally well by m = 1; give bounds or better initial values to "
        "choose a solution."
    )
    alone = solve(one("(m - 2)**2", initial=3.5, min=2.0), np.array([1.0]), None, freedom=10)
    assert not any("as well" in text for text in texts(alone))


def test_theta_that_no_parameters_give():
    physics = two("1 + (m - q)**2", "m + q")
    found = solve(
        physics, np.array([0.5, 4.0]), relative(np.array([0.5, 4.0]), correlation=0.0), freedom=10
    )
    np.testing.assert_allclose(found.value, [2.0, 2.0], rtol=1e-5)
    assert found.std == (None, None) and found.sensitivities is None and found.consistency is None
    assert texts(found) == (
        "No physical parameters give the estimated theta: nearest is a = 1 instead of 0.5. "
        "They have no standard errors; check the expressions of theta, and whether theta is "
        "biased.",
    )


def test_a_singular_solution_has_no_standard_errors():
    physics = two("m + q", "(m - q)**2", "(m - q)**2 + m + q", initial=(1.0, 1.0))
    found = solve(physics, np.array([2.0, 0.0, 2.0]), np.eye(3), freedom=10)
    assert found.std == (None, None) and found.sensitivities is None
    assert (
        "At the solution m, q cannot be distinguished; the physical parameters have no standard "
        "errors." in texts(found)
    )


def test_rows_are_json():
    physics = spring()
    theta = physics.theta(TRUTH)
    found = solve(physics, theta, relative(theta), freedom=50)
    rows = [row.content() for row in physical_rows(found)]
    assert [row["name"] for row in rows] == ["m", "cd", "ks"]
    assert rows[2] == {
        "name": "ks",
        "unit": "N/m",
        "initial": 1100.0,
        "value": pytest.approx(1000.0),
        "std": found.std[2],
        "ci95": list(found.ci95[2]),
        "bias": None,
        "ci95_with_bias": None,
    }
    assert json.loads(json.dumps(rows, allow_nan=False)) == rows
    missing = physical_rows(solve(physics, theta, None, freedom=50))[0].content()
    assert missing["std"] is None and missing["ci95"] is None


# statistics


def test_the_delta_method():
    physics = spring()
    theta = physics.theta(TRUTH)
    cov = relative(theta)
    found = solve(physics, theta, cov, freedom=7)
    inverse = np.linalg.inv(physics.jacobian(TRUTH))
    np.testing.assert_allclose(found.covariance, inverse @ cov @ inverse.T, rtol=1e-9)
    std = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(found.std, std, rtol=1e-14)
    np.testing.assert_allclose(
        np.transpose(found.ci95), scipy.stats.t(7, found.value, std).interval(0.95), rtol=1e-12
    )


def test_weighted_least_squares_of_more_theta_than_parameters():
    rng = np.random.default_rng(2)
    columns = rng.normal(size=(3, 2))
    texts = [f"{float(row[0])!r}*m + {float(row[1])!r}*q" for row in columns]
    target, root = rng.normal(size=3), rng.normal(size=(3, 3))
    cov = root @ root.T
    found = solve(two(*texts), target, cov, freedom=9)
    weight = np.linalg.inv(cov)
    spread = np.linalg.inv(columns.T @ weight @ columns)
    np.testing.assert_allclose(found.covariance, spread, rtol=1e-9)
    np.testing.assert_allclose(found.value, spread @ columns.T @ weight @ target, rtol=1e-9)
    slope = spread @ columns.T @ weight * target / found.value[:, None]
    np.testing.assert_allclose(found.sensitivities, slope, rtol=1e-9)
    residual = target - columns @ found.value
    chi2 = residual @ weight @ residual
    assert found.consistency.chi2 == pytest.approx(chi2, rel=1e-9)
    assert found.consistency.df == 1
    assert found.consistency.p == pytest.approx(scipy.stats.f.sf(chi2, 1, 9), rel=1e-9)


def test_without_covariance_the_weights_are_relative():
    target = np.array([1.0, 1e3])
    physics = PhysicsMap.of([P("m", 2.0)], {"a": "m", "b": "1e3*m"})
    found = solve(physics, target * [1.1, 0.9], None, freedom=9)
    weight = 1 / (target * [1.1, 0.9]) ** 2
    expected = np.sum(weight * target * target * [1.1, 0.9]) / np.sum(weight * target**2)
    np.testing.assert_allclose(found.value, [expected], rtol=1e-10)
    assert found.consistency is None and found.std == (None,)


@pytest.mark.parametrize(("shift", "verb"), [(0.5, "agree with"), (5.0, "contradict")])
def test_a_constraint_of_the_physics_is_tested(shift, verb):
    physics = spring(EULER | {"theta4": f"2*Ts**2 / {GAMMA}"})
    theta = physics.theta(TRUTH)
    cov = relative(theta, correlation=0.0)
    target = theta + shift * np.sqrt(2) * np.sqrt(np.diag(cov)) * [0, 0, 0, 1]
    found = solve(physics, target, cov, freedom=math.inf)
    assert found.consistency.chi2 == pytest.approx(shift**2, rel=1e-3)
    p = scipy.stats.chi2.sf(found.consistency.chi2, 1)
    assert found.consistency.p == pytest.approx(p)
    assert found.consistency.text == (
        f"The data {verb} the physics' own constraint (chi2 = {shift**2:.3g}, p = {p:.2g})."
    )
    assert texts(found) == ((found.consistency.text,) if verb == "contradict" else ())


def test_several_constraints_are_counted():
    physics = PhysicsMap.of([P("m", 1.0)], {"a": "m", "b": "m", "c": "2*m"})
    found = solve(physics, np.array([1.0, 1.1, 2.0]), np.eye(3) * 0.01, freedom=20)
    assert found.consistency.df == 2
    assert "agree with the physics' own 2 constraints (chi2" in found.consistency.text


def test_intervals_cover_the_truth():
    physics = spring(start=tuple(TRUTH))
    theta = physics.theta(TRUTH)
    cov = relative(theta)
    draws = scipy.stats.qmc.MultivariateNormalQMC(theta, cov, seed=0).random(1024)
    inside = np.zeros(3)
    for draw in draws:
        ci = np.array(solve(physics, draw, cov, freedom=math.inf, starts=0).ci95)
        inside += (ci[:, 0] <= TRUTH) & (ci[:, 1] >= TRUTH)
    assert (np.abs(inside / len(draws) - 0.95) < 0.01).all(), inside


@pytest.mark.parametrize("freedom", [5, math.inf])
def test_p_values_are_uniform(freedom):
    physics = spring(EULER | {"theta4": f"2*Ts**2 / {GAMMA}"}, start=tuple(TRUTH))
    theta = physics.theta(TRUTH)
    cov = relative(theta)
    rng = np.random.default_rng(1)
    p = []
    for draw in rng.multivariate_normal(theta, cov, 400):
        estimated = cov * (1.0 if math.isinf(freedom) else rng.chisquare(freedom) / freedom)
        p.append(solve(physics, draw, estimated, freedom=freedom, starts=0).consistency.p)
    assert scipy.stats.kstest(p, "uniform").pvalue > 0.01


def test_a_singular_covariance_is_a_constraint():
    """Where a combination of θ has no variance, p obeys it; a θ without variance is exact."""
    physics = two("m", "q", "m + q")
    found = solve(
        physics,
        np.array([1.0, 2.0, 3.0]),
        np.array([[1, 1, 2], [1, 1, 2], [2, 2, 4]]) * 0.01,
        freedom=10,
    )
    np.testing.assert_allclose(found.value, [1.0, 2.0], rtol=1e-9)
    np.testing.assert_allclose(found.std, [0.1, 0.1], rtol=1e-5)
    exact = solve(two("m", "q"), np.array([1.0, 2.0]), np.diag([0.0, 0.04]), freedom=10)
    np.testing.assert_allclose(exact.std, [0.0, 0.2], atol=1e-15)


def test_theta_at_a_bound_gives_no_standard_errors():
    found = solve(
        two("m", "q"), np.array([3.0, 4.0]), np.array([[1.0, np.nan], [np.nan, np.nan]]), freedom=10
    )
    np.testing.assert_allclose(found.value, [3.0, 4.0])
    assert found.std == (None, None) and "no finite covariance" in texts(found)[0]


# bounds


def test_a_parameter_at_its_bound():
    physics = two("m + q", "q", min=0.0)
    target, cov = np.array([1.0, 1.5]), np.diag([0.01, 0.04])  # without the bound m = -0.5
    found = solve(physics, target, cov, freedom=10)
    mean = (1.0 / 0.01 + 1.5 / 0.04) / (1 / 0.01 + 1 / 0.04)
    assert found.value[0] == 0.0
    assert found.value[1] == pytest.approx(mean)
    assert found.std == (None, pytest.approx(math.sqrt(1 / (1 / 0.01 + 1 / 0.04))))
    assert found.ci95[0] is None and np.isnan(found.covariance[0]).all()
    np.testing.assert_array_equal(np.isnan(found.sensitivities), [[True, True], [False, False]])
    assert found.consistency.df == 1 and found.consistency.chi2 == pytest.approx(0.25 / 0.05)
    assert texts(found)[0] == (
        "m is at its bound 0 and has no standard error; those of the others hold for this value of it."
    )
    assert "own constraint, bounds included (chi2" in found.consistency.text
    json.dumps([row.content() for row in physical_rows(found)], allow_nan=False)


def test_upper_bounds_and_all_at_bounds():
    found = solve(one("m", initial=0.5, max=1.0), np.array([2.0]), np.eye(1), freedom=10)
    assert found.value.tolist() == [1.0] and found.std == (None,)
    np.testing.assert_array_equal(found.sensitivities, [[0.0]])


def test_bounded_solutions_are_those_of_scipy():
    physics, rng = spring(), np.random.default_rng(5)
    theta = physics.theta(TRUTH)
    cov = relative(theta, level=0.05, correlation=0.0)
    std, at_bound = np.sqrt(np.diag(cov)), 0
    for draw in rng.multivariate_normal(theta, cov, 12):
        found = solve(physics, draw, cov, freedom=10)

        def residual(z, draw=draw):
            return (physics.theta(TRUTH * z) - draw) / std

        other = scipy.optimize.least_squares(
            residual, np.ones(3), bounds=(0, np.inf), ftol=1e-14, xtol=1e-14, gtol=1e-14
        )
        np.testing.assert_allclose(found.value / TRUTH, other.x, atol=1e-5)
        assert np.sum(residual(found.value / TRUTH) ** 2) <= 2 * other.cost + 1e-9
        at_bound += found.std[2] is None
    assert 0 < at_bound < 12


# profile-likelihood intervals


def test_profile_of_a_linear_map_is_the_delta_interval():
    physics = two("m + 2*q", "q - m/3", "m")
    target, cov = np.array([5.0, 1.5, 1.2]), relative(np.array([5.0, 1.5, 1.2]), 0.05)
    for freedom in (4, math.inf):
        found = solve(physics, target, cov, freedom=freedom)
        expected = np.transpose(scipy.stats.t(freedom, found.value, found.std).interval(0.95))
        for i, name in enumerate(physics.names):
            ends = profile(physics, target, cov, name, freedom=freedom)
            np.testing.assert_allclose(ends, expected[i], rtol=1e-8)


def test_profile_of_a_bent_map_is_asymmetric():
    physics, reach = one("1/m"), scipy.stats.t.ppf(0.975, 10)
    low, high = profile(physics, np.array([1.0]), np.array([[0.04]]), "m", freedom=10)
    np.testing.assert_allclose(
        [low, high], [1 / (1 + 0.2 * reach), 1 / (1 - 0.2 * reach)], rtol=1e-9
    )
    unlimited = profile(physics, np.array([1.0]), np.array([[1.0]]), "m", freedom=10)
    assert unlimited == (pytest.approx(1 / (1 + reach)), math.inf)


def test_profile_of_the_stiffness_agrees_with_the_closed_form():
    """k = (1 − θ1 − θ2)/θ3: Fieller's interval of a ratio."""
    physics = spring()
    theta = physics.theta(TRUTH)
    cov = relative(theta, level=0.005, correlation=0.3)
    low, high = profile(physics, theta, cov, "ks", freedom=math.inf)
    gradient = np.array([[-1.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
    (vn, vnd), (_, vd) = gradient @ cov @ gradient.T
    n, d, q = 1 - theta[0] - theta[1], theta[2], scipy.stats.chi2.ppf(0.95, 1)
    ends = np.sort(np.roots([d**2 - q * vd, -2 * (n * d - q * vnd), n**2 - q * vn]))
    np.testing.assert_allclose([low, high], ends, rtol=1e-8)


def test_profile_ends_at_a_bound():
    bounded = two("m + q", "q", min=0.0)
    target, cov = np.array([1.0, 1.5]), np.diag([0.01, 0.04])
    low, high = profile(bounded, target, cov, "m", freedom=math.inf)
    q = scipy.stats.chi2.ppf(0.95, 1)
    assert low == 0.0
    assert high == pytest.approx(
        -0.5 + math.sqrt(0.05 * (q + 0.25 / 0.05))
    )  # m̂ without the bound is −0.5, variance 0.05
    capped = profile(
        one("m", initial=0.5, min=-9.0, max=1.1), np.array([1.0]), np.eye(1), "m", freedom=math.inf
    )
    assert capped == (pytest.approx(1 - math.sqrt(q)), 1.1)


# with a baseline

TERMS = [
    Term("theta3", "force[k-1]", unit="m/N", max=1.0),
    Term("theta1", "position[k-1]"),
    Term("theta2", "position[k-2]"),
    Term("known", "1", initial=2.0, fixed=True),
]


def test_the_baseline_starts_from_the_physics():
    physics = spring(PAPER)
    baseline = with_initial(physics, Baseline.from_terms(TERMS))
    given = dict(zip(physics.theta_names, physics.initial_theta(), strict=True))
    assert baseline.names == ("theta3", "theta1", "theta2")
    np.testing.assert_array_equal(baseline.initial, [given[name] for name in baseline.names])
    assert [term.initial for term in baseline.terms] == [*(given[n] for n in baseline.names), 2.0]
    assert baseline.parameters[0].unit == "m/N" and baseline.parameters[0].max == 1.0
    assert with_initial(physics, baseline) == baseline  # what it gives agrees with itself


def test_a_function_s_parameters_start_from_the_physics():
    baseline = Baseline.from_function(lambda x: x[None, :], ["b", "a"])
    np.testing.assert_array_equal(with_initial(two("3*m", "5*q"), baseline).initial, [10.0, 3.0])


@pytest.mark.parametrize(
    ("theta", "terms", "message"),
    [
        (
            EULER,
            [Term("theta1", "y[k-1]")],
            "physics.theta 'theta2' is no parameter of the baseline, did you mean 'theta1'?",
        ),
        (
            {"a": "m", "b": "cd", "c": "ks"},
            [Term("x", "y[k-1]"), Term("z", "y[k-2]")],
            "physics.theta 'a' is no parameter of the baseline; its parameters are x, z.",
        ),
        (
            EULER,
            [*TERMS, Term("theta4", "1")],
            "the physics gives no 'theta4'; expected an expression for every theta of the "
            "baseline.",
        ),
        (
            EULER | {"known": "m"},
            TERMS,
            "physics.theta 'known' is a fixed term of the baseline; leave out the expression, "
            "or `fixed`.",
        ),
        (
            PAPER,
            [Term("theta1", "y[k-1]", initial=0.61), *TERMS[:1], *TERMS[2:]],
            "theta1: initial 0.61 but the physics gives 0.6161137; leave one out.",
        ),
    ],
)
def test_baselines_that_do_not_fit(theta, terms, message):
    with pytest.raises(InputError) as caught:
        check_baseline(spring(theta), Baseline.from_terms(terms))
    assert str(caught.value) == message


# what is refused

M, Q = P("m", 1.0), P("q", 2.0)
REFUSED = [
    ([], {"a": "m"}, {}, "the physics has no parameters; give at least one, such as m."),
    (
        [M],
        {},
        {},
        "the physics gives no theta; give one expression for each parameter of the baseline.",
    ),
    ([M, M], {"a": "m"}, {}, "physical parameter 'm' is given twice; names must differ."),
    (
        [P("k", 1.0)],
        {"a": "k"},
        {},
        "'k' cannot name a physical parameter or constant; .* (k is the time index).",
    ),
    ([M], {"a": "m"}, {"2x": 1.0}, "'2x' cannot name a physical parameter or constant; .*"),
    ([M], {"a": "m*c"}, {"c": math.inf}, "the constant 'c' must be a finite number; got inf."),
    (
        [M],
        {"a": "m"},
        {"m": 1.0},
        "'m' is a physical parameter and a constant; give one of them another name.",
    ),
    (
        [P("m", math.nan)],
        {"a": "m"},
        {},
        "the initial value of 'm' must be a finite number; got nan.",
    ),
    ([P("m", True)], {"a": "m"}, {}, "the initial value of 'm' must be a finite number; got True."),
    (
        [P("m", 1.0, min="0")],
        {"a": "m"},
        {},
        "the bounds of 'm' must be numbers; got min = '0', max = inf.",
    ),
    (
        [P("m", 1.0, min=2, max=1)],
        {"a": "m"},
        {},
        "the bounds of 'm' are empty or reversed: min = 2, max = 1.",
    ),
    (
        [P("m", 1.0, min=math.nan)],
        {"a": "m"},
        {},
        "the bounds of 'm' are empty or reversed: min = nan, max = inf.",
    ),
    (
        [P("m", 1.0, min=2)],
        {"a": "m"},
        {},
        "the initial value of 'm' is 1; its bounds are 2 and inf.",
    ),
    (
        [M],
        {"a": 1.0},
        {},
        "physics.theta 'a' must be an expression in text such as 'Ts**2 / m'; got 1.0.",
    ),
    (
        [M],
        {"a": "m*y[k-1]"},
        {},
        "physics.theta 'a' = m*y[k-1]: a signal such as y[k-1] is not allowed here; known are m.",
    ),
    (
        [P("mass", 1.0)],
        {"a": "mas"},
        {},
        "physics.theta 'a' = mas: unknown name 'mas', did you mean 'mass'?",
    ),
    (
        [M],
        {"a": "m*zeta"},
        {"Ts": 1.0},
        "physics.theta 'a' = m*zeta: unknown name 'zeta'; known are Ts, m.",
    ),
    (
        [M, P("Ts", 1.0)],
        {"a": "m*Ts"},
        {},
        "'Ts' cannot name a parameter: expressions read it as the sampling time .*",
    ),
    ([M], {"a": "m*k"}, {}, "physics.theta 'a' = m*k: unknown name 'k'; known are m."),
    (
        [M],
        {"a": "m if m else m"},
        {},
        "physics.theta 'a': 'm if m else m': 'm if m else m' is not allowed .*",
    ),
    ([M], {"a": "m +"}, {}, "physics.theta 'a': 'm +' is not an expression .*"),
    ([M], {"a": "sin(m, m)"}, {}, "physics.theta 'a': 'sin(m, m)': sin takes one argument, got 2."),
    ([M], {"a": ""}, {}, "physics.theta 'a': An expression is empty; .*"),
    (
        [M],
        {"a": "m", "b": "2*Ts"},
        {"Ts": 1.0},
        "physics.theta 'b' = 2*Ts depends on no physical parameter; "
        "use one of m, or make it a fixed term of the baseline.",
    ),
    (
        [M, Q],
        {"a": "m"},
        {},
        "the physical parameter 'q' is in no expression of theta; use or remove it.",
    ),
    (
        [P("m", 0.0)],
        {"a": "1/m"},
        {},
        "physics.theta 'a' = 1/m is inf at the initial values of m; expected a finite value: "
        "change the initial values.",
    ),
    (
        [P("m", 0.0), Q],
        {"a": "sqrt(m)", "b": "q"},
        {},
        "physics.theta 'a' = sqrt(m) has no finite derivative at the initial values of m, q; "
        "expected a finite value: change the initial values.",
    ),
    (
        [M, Q],
        {"a": "m*q"},
        {},
        "theta does not determine the physical parameters: m, q cannot be distinguished (1 theta, "
        "rank 1 of 2). Make one of them a constant, or add a term that distinguishes them.",
    ),
    (
        [M, Q, P("r", 1e3)],
        {"a": "m/q + r", "b": "(m/q)**2 - r", "c": "sin(r)*q/m"},
        {},
        "theta does not determine the physical parameters: m, q cannot be distinguished (3 theta, "
        "rank 2 of 3). .*",
    ),
    (
        [M, Q],
        {"a": "m + 0*q", "b": "m**2"},
        {},
        "theta does not determine the physical parameters: q has no effect (2 theta, rank 1 of "
        "2). .*",
    ),
]


@pytest.mark.parametrize(("parameters", "theta", "constants", "message"), REFUSED)
def test_maps_that_cannot_be(parameters, theta, constants, message):
    with pytest.raises(InputError) as caught:
        PhysicsMap.of(parameters, theta, constants)
    text = str(caught.value)
    assert "\n" not in text
    start, _, end = message.partition(".*")
    assert text.startswith(start) and text.endswith(end.strip())
    assert ".*" in message or text == message


def test_a_map_that_is_singular_only_at_the_start_is_let_pass():
    assert one("m**2", initial=0.0).initial_theta() == [0.0]
    assert one("abs(m - 1)", initial=1.0).names == ("m",)


THETA, COV = np.array([1.0, 2.0]), np.eye(2)
SOLVES = [
    (
        dict(theta_hat=np.ones(3)),
        "`theta_hat` has shape (3,); expected one number for each of a, b.",
    ),
    (
        dict(theta_hat=np.array([1, np.nan])),
        "`theta_hat` is nan for b; expected a finite estimate.",
    ),
    (
        dict(covariance=np.array([[1, 0.5], [0, 1]])),
        "`covariance` must be symmetric with no negative eigenvalue; expected that of theta_hat.",
    ),
    (
        dict(covariance=-np.eye(2)),
        "`covariance` must be symmetric with no negative eigenvalue; expected that of theta_hat.",
    ),
]
PROFILES = [
    (dict(name="mm"), "'mm' is no physical parameter, did you mean 'm'?"),
    (dict(name="stiffness"), "'stiffness' is no physical parameter; known are m, q."),
    (
        dict(covariance=np.full((2, 2), np.nan)),
        "theta has no finite covariance, so there is no interval; expected that of theta_hat.",
    ),
    (
        dict(covariance=None),
        "theta has no finite covariance, so there is no interval; expected that of theta_hat.",
    ),
]


@pytest.mark.parametrize(("changed", "message"), SOLVES)
def test_solve_refuses(changed, message):
    with pytest.raises(InputError) as caught:
        solve(two("m", "q"), **({"theta_hat": THETA, "covariance": COV, "freedom": 10} | changed))
    assert str(caught.value) == message


@pytest.mark.parametrize(("changed", "message"), SOLVES + PROFILES)
def test_profile_refuses(changed, message):
    with pytest.raises(InputError) as caught:
        profile(
            two("m", "q"),
            **({"theta_hat": THETA, "covariance": COV, "name": "m", "freedom": 10} | changed),
        )
    assert str(caught.value) == message


def test_a_point_of_another_length_is_refused():
    with pytest.raises(
        InputError, match=re.escape("`p` has shape (3,); expected one value for each of m, q.")
    ):
        two("m", "q").theta(np.ones(3))
