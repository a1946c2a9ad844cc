"""The prediction criterion against the same thing written out: autodiff of the projected residual."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import problem

from orthaug import MLP, Baseline, Function, LevenbergMarquardt, Record, Term
from orthaug.fitting.normal_equations import Hold
from orthaug.fitting.one_step import OneStepTask
from orthaug.models.rows import Overlap
from orthaug.physics.problem import pose

CASES = [(ny, nt) for ny in (1, 2) for nt in (0, 1, 3)]


def case(ny, nt, rows=37):
    """Random rows, gains and a hold; chunks of 16 rows, the last one padded."""
    rng = np.random.default_rng(10 * ny + nt)
    z, y = rng.uniform(-1, 1, (rows, 2)), rng.normal(size=(rows, ny))
    given = problem(
        MLP(hidden=(3,)),
        z,
        y,
        rng.normal(size=(rows, ny, nt)),
        gain=rng.uniform(0.5, 2.0, (rows, ny)),
        limit=16,
    )
    hold = Hold(jnp.asarray(rng.normal(size=(nt, nt))), jnp.asarray(rng.normal(size=nt)))
    return given._replace(hold=hold), given.bound.init(jax.random.key(ny)) + 0.1


def written_out(given, w):
    """Hessian, gradient, loss and overlap of `[P⊥(e − a f); target − matrix Qᵀ(a f)]` by plain autodiff."""
    q = given.q.reshape(given.e.size, -1)

    def values(w):
        return (given.gain * jax.vmap(lambda row: given.bound.values(w, row))(given.z)).ravel()

    def residual(w):
        rest = given.e.ravel() - values(w)
        rest = rest - q @ (q.T @ rest)
        rest = rest - q @ (q.T @ rest)
        return jnp.concatenate([rest, given.hold.target - given.hold.matrix @ (q.T @ values(w))])

    r, jacobian = jax.jit(lambda w: (residual(w), jax.jacrev(residual)(w)))(w)
    overlap = Overlap(
        *jax.jit(lambda w: (jax.jacrev(lambda w: q.T @ values(w))(w), q.T @ values(w)))(w)
    )
    return jacobian.T @ jacobian, -jacobian.T @ r, r @ r, overlap


def assert_close(found, expected, relative):
    """Largest difference against the largest entry, for each array."""
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert a.shape == b.shape
        assert np.max(np.abs(a - b), initial=0.0) <= relative * np.max(np.abs(b), initial=1e-300)


@pytest.mark.parametrize(("ny", "nt"), CASES)
def test_prediction_is_the_projected_residual(ny, nt):
    given, w = case(ny, nt)
    found = jax.jit(given.criterion)(w, *given.arguments, given.nothing)
    assert_close(tuple(found), written_out(given, w), 1e-10)


@pytest.mark.parametrize(("ny", "nt"), CASES)
def test_any_earlier_overlap_gives_the_same(ny, nt):
    given, w = case(ny, nt)
    rng = np.random.default_rng(1)
    before = Overlap(
        jnp.asarray(rng.normal(size=(nt, given.bound.size))), jnp.asarray(rng.normal(size=nt))
    )
    found = jax.jit(given.criterion)(w, *given.arguments, before)
    assert_close(tuple(found), written_out(given, w), 1e-10)


def test_gradient_points_downhill():
    given, w = case(2, 3)
    criterion = jax.jit(given.criterion)
    start = criterion(w, *given.arguments, given.nothing)
    assert criterion(w + 1e-6 * start.gradient, *given.arguments, given.nothing).loss < start.loss


def test_learner_almost_in_the_span_of_the_physics():
    """The part of J outside the span is 1e-6 of it: JᵀJ − (QᵀJ)ᵀ(QᵀJ) loses it, a second pass does not."""
    rng = np.random.default_rng(4)
    phi, outside = rng.normal(size=(500, 1, 3)), rng.normal(size=(500, 4))
    q = np.linalg.qr(phi[:, 0])[0]
    for _ in range(2):
        outside = outside - q @ (q.T @ outside)
    outside /= np.linalg.norm(outside, axis=0)
    features = q @ rng.normal(size=(3, 4)) + 1e-6 * outside
    learner = Function(lambda w, z: (w @ z)[None], lambda key: jnp.ones(4))
    given = problem(learner, features, rng.normal(size=(500, 1)), phi)
    exact = 1e-12 * outside.T @ outside
    w = jnp.ones(4)
    criterion = jax.jit(given.criterion)
    first = criterion(w, *given.arguments, given.nothing)
    second = criterion(w, *given.arguments, first.overlap)
    unguarded, guarded = (
        np.abs(n.hessian - exact).max() / np.abs(exact).max() for n in (first, second)
    )
    assert guarded < 1e-6 < unguarded
    gradient = 1e-6 * outside.T @ given.e[:, 0] - exact @ w
    np.testing.assert_allclose(second.gradient, gradient, rtol=1e-6)


def test_padding_adds_nothing():
    given, w = case(2, 3)
    padded = [jax.tree.map(lambda a: jnp.concatenate([a, jnp.zeros_like(a[:2])]), given.rows)]
    padded += [
        jax.tree.map(
            lambda a: jnp.concatenate([a, jnp.zeros((*a.shape[:-1], 8))], axis=-1), given.rows
        )
    ]
    expected = jax.jit(given.criterion)(w, *given.arguments, given.nothing)
    for chunks in padded:
        found = jax.jit(given.criterion)(w, chunks, given.hold, given.nothing)
        assert_close(tuple(found), tuple(expected), 1e-13)


def test_padding_adds_nothing_of_a_learner_without_a_value_at_zero():
    logarithm = Function(lambda w, z: w * jnp.log(jnp.abs(z)), lambda key: jnp.ones(1))
    u, y = np.random.default_rng(0).normal(size=(2, 37))
    task = OneStepTask.of(
        pose(Record.from_arrays(u, y), Baseline.from_terms([Term("a", "u[k]")])), logarithm
    )
    assert task.rows.z.size > 37
    run = task.run(LevenbergMarquardt(), jnp.ones(1))
    assert run.ending.code == "converged" and np.isfinite(run.normal.hessian).all()
