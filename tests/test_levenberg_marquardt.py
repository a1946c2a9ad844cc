"""Levenberg-Marquardt: where it ends, how it says so, and that a run can be repeated and paused."""

from __future__ import annotations

import time

import numpy as np
import pytest
from helpers import linear_columns, problem

from orthaug import MLP, Function, LevenbergMarquardt
from orthaug._base.jax import jax, jnp, training_clock
from orthaug.fitting.normal_equations import Normal, linearise
from orthaug.fitting.solvers import compiled
from orthaug.fitting.solvers import minimize as minimizer
from orthaug.fitting.solvers.damped_step import IDENTITY
from orthaug.fitting.status import Ending
from orthaug.models.rows import Overlap

ROWS = 150
SAMPLES = ROWS - 2  # less the physics' own two parameters


def regression(learner=MLP(hidden=()), ny=1, noise=0.1):  # noqa: B008
    """Two physics columns, four features, outputs that are a curve in the features."""
    rng = np.random.default_rng(0)
    z, phi = rng.uniform(-1, 1, (ROWS, 4)), rng.normal(size=(ROWS, ny, 2))
    y = (
        np.sin(z @ rng.normal(size=(4, ny)))
        + phi @ [1.0, -2.0]
        + noise * rng.normal(size=(ROWS, ny))
    )
    return problem(learner, z, y, phi)


def minimize(given, w=None, solver=LevenbergMarquardt(), **options):  # noqa: B008
    w = given.bound.init(jax.random.key(3)) if w is None else w
    return solver.minimize(
        given.criterion, w, given.arguments, given.nothing, samples=SAMPLES, **options
    )


@pytest.mark.parametrize("ny", [1, 2])
def test_linear_learner_ends_at_least_squares(ny):
    given = regression(ny=ny)
    run = minimize(given)
    expected = np.linalg.lstsq(linear_columns(given), given.e.ravel(), rcond=None)[0]
    assert run.ending is Ending.CONVERGED and run.iterations < 50
    np.testing.assert_allclose(run.w, expected, atol=1e-8)
    np.testing.assert_allclose(run.effective, len(expected), rtol=1e-9)


@pytest.mark.parametrize("ridge", [1e-3, 1.0, 100.0])
def test_linear_learner_ends_at_ridge_regression(ridge):
    given = regression()
    columns = linear_columns(given)
    hessian = columns.T @ columns
    run = minimize(given, ridge=ridge)
    expected = np.linalg.solve(hessian + ridge * np.eye(len(hessian)), columns.T @ given.e.ravel())
    assert run.ending is Ending.CONVERGED and run.ridge == ridge
    np.testing.assert_allclose(run.w, expected, atol=1e-8)
    np.testing.assert_allclose(
        run.effective, np.trace(np.linalg.solve(hessian + ridge * np.eye(5), hessian))
    )


@pytest.mark.parametrize("ridge", [0.0, 1.0])
def test_effective_weights_are_those_of_the_end(ridge):
    given = regression(MLP(hidden=(5,)))
    run = minimize(given, ridge=ridge)
    values = np.maximum(np.linalg.eigvalsh(run.normal.hessian), 0.0)
    values = values[values > 1e-13 * values[-1]]
    np.testing.assert_allclose(run.effective, np.sum(values / (values + ridge)), rtol=1e-3)


def mackay(columns, target, samples):
    """MacKay's fixed point for a linear model, iterated to the end."""
    values, vectors = np.linalg.eigh(columns.T @ columns)
    projected, alpha = vectors.T @ (columns.T @ target), 1.0
    for _ in range(2000):
        w = projected / (values + alpha)
        gamma = np.sum(values / (values + alpha))
        loss = target @ target - 2 * w @ projected + w @ (values * w)
        alpha = gamma * loss / (samples - gamma) / (w @ w)
    return vectors @ w, alpha, gamma


def test_evidence_of_a_linear_learner():
    given = regression(noise=1.0)
    run = minimize(given, solver=LevenbergMarquardt(tolerance=1e-12), ridge=1.0, evidence=True)
    w, alpha, gamma = mackay(linear_columns(given), given.e.ravel(), SAMPLES)
    assert run.ending is Ending.CONVERGED
    np.testing.assert_allclose(run.ridge, alpha, rtol=1e-4)
    np.testing.assert_allclose(run.effective, gamma, rtol=1e-4)
    np.testing.assert_allclose(run.w, w, atol=1e-5)


def test_evidence_reaches_its_fixed_point_equations():
    given = regression(MLP(hidden=(5,)), noise=0.3)
    run = minimize(
        given, solver=LevenbergMarquardt(iterations=3000, tolerance=1e-13), ridge=1.0, evidence=True
    )
    w, values = np.asarray(run.w), np.linalg.eigvalsh(run.normal.hessian)
    gamma = np.sum(values / (values + run.ridge))
    variance = float(run.normal.loss) / (SAMPLES - gamma)
    assert run.ending is Ending.CONVERGED
    np.testing.assert_allclose(run.effective, gamma, rtol=1e-4)
    np.testing.assert_allclose(run.ridge, gamma * variance / (w @ w), rtol=1e-4)
    assert np.linalg.norm(run.normal.gradient - run.ridge * w) < 1e-4 * np.linalg.norm(
        run.ridge * w
    )


def relevance(columns, target, samples, groups):
    """MacKay's fixed point with an α of each group, for a linear model, iterated to the end."""
    hessian, alpha = columns.T @ columns, np.ones(len(groups))
    for _ in range(2000):
        inverse = np.linalg.inv(hessian + np.diag(alpha))
        w, used = inverse @ columns.T @ target, 1 - alpha * np.diag(inverse)
        variance = np.sum((target - columns @ w) ** 2) / (samples - used.sum())
        for group in np.unique(groups):
            of = groups == group
            alpha[of] = used[of].sum() * variance / (w[of] @ w[of])
    return w, alpha, used.sum()


def test_relevance_of_a_linear_learner():
    given, groups = regression(noise=1.0), np.array([0, 1, 0, 1, 2])
    options = {"ridge": 1.0, "evidence": True, "groups": groups}
    run = minimize(given, solver=LevenbergMarquardt(tolerance=1e-14), **options)
    w, alpha, gamma = relevance(linear_columns(given), given.e.ravel(), SAMPLES, groups)
    assert len(set(alpha.tolist())) == 3
    np.testing.assert_allclose(run.ridge, alpha, rtol=1e-3)
    np.testing.assert_allclose(run.effective, gamma, rtol=1e-4)
    np.testing.assert_allclose(run.w, w, atol=1e-4)


def test_a_weight_that_nothing_needs_falls_silent():
    noise = np.random.default_rng(1).normal(size=(2, ROWS, 1))
    z, phi = np.random.default_rng(0).uniform(-1, 1, (ROWS, 2)), noise[:1].reshape(ROWS, 1, 1)
    given = problem(MLP(hidden=()), z, z[:, :1] + 0.1 * noise[1], phi)
    run = minimize(given, ridge=1.0, evidence=True, groups=np.arange(3))
    columns = linear_columns(given)
    least_squares = np.linalg.lstsq(columns, given.e.ravel(), rcond=None)[0]
    for i in (1, 2):  # Mackay's condition: an estimate within its standard error is pruned
        deviation = np.sqrt(
            np.linalg.inv(columns.T @ columns)[i, i] * float(run.normal.loss) / SAMPLES
        )
        assert (run.ridge[i] > 1e6) == (abs(least_squares[i]) < deviation)
    assert run.ridge[0] < 1 and run.w[0] == pytest.approx(least_squares[0], rel=0.01)


def test_start_that_is_not_finite():
    given = regression(MLP(hidden=(5,)))
    run = minimize(given, w=jnp.full(given.bound.size, jnp.nan))
    assert (run.ending, run.iterations) == (Ending.NON_FINITE, 0)


IN_THE_SPAN = Function(lambda w, z: (w @ z[:2])[None], lambda key: jax.random.normal(key, (2,)))


def in_the_span(noise):
    """A learner that is linear in the physics' own regressors, the paper's Example 1."""
    rng = np.random.default_rng(0)
    z = rng.normal(size=(ROWS, 2))
    return problem(
        IN_THE_SPAN, z, (z @ [1.0, -2.0] + noise * rng.normal(size=ROWS))[:, None], z[:, None]
    )


@pytest.mark.parametrize("options", [{}, {"ridge": 1.0}, {"ridge": 1.0, "evidence": True}])
@pytest.mark.parametrize("noise", [0.1, 0.0])
def test_learner_in_the_span_of_the_physics(noise, options):
    run = minimize(in_the_span(noise), **options)
    assert (run.ending, run.iterations) == (Ending.SPANNED, 0)
    assert np.isfinite(run.w).all() and np.isfinite(run.effective) and np.isfinite(run.normal.loss)


@pytest.mark.parametrize("noise", [0.1, 0.0])
def test_loss_is_a_sum_of_squares(noise):
    assert minimize(in_the_span(noise)).normal.loss >= 0.0


@pytest.mark.parametrize("seed", range(4))
def test_start_at_the_minimum(seed):
    """A warm start on the same data has converged, although no step descends further."""
    given = regression()
    w = minimize(given, w=given.bound.init(jax.random.key(seed))).w
    again = minimize(given, w=w)
    assert again.ending is Ending.CONVERGED
    np.testing.assert_allclose(again.w, w, atol=1e-10)


def test_start_at_a_perfect_fit():
    given = regression()
    given = problem(MLP(hidden=()), given.z, 0.0 * given.e, given.q)
    assert minimize(given, w=jnp.zeros(given.bound.size)).ending is Ending.CONVERGED


def uphill(w, overlap):
    """‖w‖² with its gradient turned round: no step descends."""
    return Normal(jnp.eye(2), w, w @ w, overlap)


def test_no_step_descends():
    run = LevenbergMarquardt().minimize(
        uphill, jnp.ones(2), (), Overlap(jnp.zeros((0, 2)), jnp.zeros(0)), samples=1
    )
    assert run.ending is Ending.NO_DESCENT
    np.testing.assert_array_equal(run.w, 1.0)


def wall(w, overlap):
    """(w − 2)² with no value beyond 1: the trial steps over the edge must be taken back."""
    loss = jnp.where(w[0] > 1.0, jnp.nan, (w[0] - 2.0) ** 2)
    return Normal(jnp.eye(1), 2.0 - w, loss, overlap)


def test_trial_without_a_value_is_taken_back():
    run = LevenbergMarquardt().minimize(
        wall, jnp.zeros(1), (), Overlap(jnp.zeros((0, 1)), jnp.zeros(0)), samples=1
    )
    assert 0.0 < run.w[0] <= 1.0 and np.isfinite(run.normal.loss)


def test_iteration_limit():
    run = minimize(regression(MLP(hidden=(5,))), solver=LevenbergMarquardt(iterations=4))
    assert (run.ending, run.iterations) == (Ending.RUNNING, 4)


def test_a_run_goes_on_past_its_limit_while_the_loss_falls():
    """By the same steps as under a longer limit, and for no longer than it falls noticeably."""
    given = regression(MLP(hidden=(5,)))
    short, long, longest = (
        minimize(given, solver=LevenbergMarquardt(*limits, longest=last))
        for limits, last in (((8, 0.0), 8), ((8, 0.0), 40), ((40, 0.0), 40))
    )
    assert (
        (short.iterations, long.iterations) == (8, 40)
        and long.tail.prolonged
        and not short.tail.prolonged
    )
    np.testing.assert_array_equal(long.w, longest.w)
    assert short.tail.noticeable and short.tail.fall > 0 and short.tail.window == 5
    once = minimize(given, solver=LevenbergMarquardt(8, 0.0, longest=40), noticeable=1e6)
    assert once.iterations == 8 and not once.tail.noticeable


def test_only_the_default_limit_is_passed():
    assert LevenbergMarquardt().limit()[:2] == (300, 3000)
    assert (
        LevenbergMarquardt(200).limit()[:2]
        == LevenbergMarquardt().at_most(200).limit()[:2]
        == (200, 200)
    )
    assert LevenbergMarquardt().within_limit.limit()[:2] == (300, 300)
    assert LevenbergMarquardt().after(120).limit()[:2] == (180, 2880)


def test_loss_and_overlap_belong_to_the_weights():
    given = regression(MLP(hidden=(5,)))
    run = minimize(given, solver=LevenbergMarquardt(iterations=15))
    normal = given.criterion(run.w, *given.arguments, run.normal.overlap)
    for found, expected in zip(jax.tree.leaves(run.normal), jax.tree.leaves(normal), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_same_start_same_run():
    given = regression(MLP(hidden=(5,)))
    first, second = (minimize(given, ridge=0.1, evidence=True) for _ in range(2))
    np.testing.assert_array_equal(first.w, second.w)
    assert first[2:6] == second[2:6]


@pytest.mark.parametrize("seconds", [0.0, 1e9], ids=["every step", "longer and longer"])
def test_pauses_change_nothing(monkeypatch, seconds):
    given, found = regression(MLP(hidden=(5,))), []
    solver = LevenbergMarquardt(iterations=40)
    w = given.bound.init(jax.random.key(3))
    options = compiled.Options(
        jnp.asarray(solver.tolerance), jnp.asarray(True), jnp.asarray(float(SAMPLES))
    )
    start = compiled._first_state(
        w, linearise(given.criterion, w, given.arguments, given.nothing), jnp.asarray(0.1), IDENTITY
    )
    whole = compiled._advance(
        given.criterion, IDENTITY, start, given.arguments, options, jnp.asarray(solver.iterations)
    )

    monkeypatch.setattr(minimizer, "_SECONDS_PER_BURST", seconds)
    run = minimize(
        given, w, solver, ridge=0.1, evidence=True, progress=lambda i, loss: found.append((i, loss))
    )
    np.testing.assert_array_equal(run.w, whole.w)
    assert (run.ridge, run.iterations, run.ending) == (
        float(whole.ridge),
        int(whole.iteration),
        Ending(int(whole.control.code)),
    )
    assert found[-1] == (run.iterations, float(run.normal.loss))
    assert len(found) == (run.iterations if seconds == 0 else 5)  # one where the last window begins


def test_the_training_clock_stands_still_while_programs_are_made():
    """Tracing sleeps here, in a program and in one that it calls, so that what is nested would count twice."""

    @jax.jit
    def inner(x):
        time.sleep(0.1)
        return 2 * x

    @jax.jit
    def outer(x):
        time.sleep(0.1)
        return jax.lax.fori_loop(0, 3, lambda i, s: s + inner(s), x)

    began, wall = training_clock(), time.perf_counter()
    jax.block_until_ready(outer(jnp.asarray(1.0)))
    trained, spent = training_clock() - began, time.perf_counter() - wall
    assert 0 <= trained < spent - 0.2
    began, wall = training_clock(), time.perf_counter()
    time.sleep(0.02)
    assert training_clock() - began == pytest.approx(time.perf_counter() - wall, abs=0.005)
