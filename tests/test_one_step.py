"""A training task: scaling of features and outputs, and the Gram matrix it leaves."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from orthaug import (
    MLP,
    Baseline,
    Lags,
    LevenbergMarquardt,
    Orthogonal,
    OrthogonalPenalty,
    Record,
    Term,
    synthetic,
)
from orthaug.fitting.one_step import OUTPUT_UNIT, OneStepTask
from orthaug.models.learners import Scaling
from orthaug.models.rows import from_chunks
from orthaug.physics.problem import pose

TERMS = [
    Term("a", "y1[k-1]", output="y1"),
    Term("b", "u[k]", output="y2"),
    Term("a", "u[k-1]", output="y2"),
]


@pytest.fixture(scope="module", params=[1, 2])
def task(request):
    """Outputs of very different size; one or two of them."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=90)
    y = np.stack([np.tanh(u), 1e-4 * u**2], axis=1) + [[0.1, 1e-5]] * rng.normal(size=(90, 2))
    if request.param == 1:
        terms = [Term("a", "y1[k-1]"), Term("b", "u[k-1]")]
        record = Record.from_arrays(100 * u, y[:, :1], outputs=["y1"])
    else:
        terms, record = TERMS, Record.from_arrays(100 * u, y)
    problem = pose(record, Baseline.from_terms(terms), Lags(na=1, nb=2, nk=0))
    return OneStepTask.of(problem, MLP(hidden=(3,)))


@pytest.fixture(scope="module")
def run(task):
    return task.run(LevenbergMarquardt(iterations=5), task.bound.init(jax.random.key(0)))


def test_features_fill_the_unit_box(task):
    z = from_chunks(task.rows.z, len(task.problem.rows))
    np.testing.assert_allclose(z.min(axis=0), -1.0, atol=1e-12)
    np.testing.assert_allclose(z.max(axis=0), 1.0, atol=1e-12)
    np.testing.assert_allclose(z, task.scaling(task.problem.feature_rows()), atol=1e-12)


def test_output_unit_is_a_multiple_of_the_baseline_s_residual(task):
    problem = task.problem
    phi = problem.projection.phi.reshape(problem.target.size, -1)
    y = problem.whitened_target.ravel()
    e = (y - phi @ np.linalg.lstsq(phi, y, rcond=None)[0]).reshape(problem.target.shape)
    np.testing.assert_allclose(
        task.unit, OUTPUT_UNIT * e.std(axis=0) * problem.deviation, rtol=1e-9
    )
    assert task.rms == pytest.approx(np.sqrt(np.mean(e.var(axis=0))), rel=1e-9)
    rows = from_chunks(task.rows.e, len(problem.rows))
    np.testing.assert_allclose(rows, e / task.rms, atol=1e-10)
    assert np.mean(rows.var(axis=0)) == pytest.approx(1.0)


def test_padding_has_no_weight(task):
    count, _, size = task.rows.z.shape
    rows = len(task.problem.rows)
    assert count * size >= rows
    for name in ("q", "e", "gain"):
        assert not from_chunks(getattr(task.rows, name), count * size)[rows:].any()


def test_a_given_scaling_is_kept(task):
    scaling, unit = (
        Scaling(np.zeros(task.bound.nz), np.full(task.bound.nz, 2.0)),
        np.full(task.bound.ny, 3.0),
    )
    again = OneStepTask.of(task.problem, task.bound.learner, scaling, unit)
    np.testing.assert_array_equal(again.unit, unit)
    np.testing.assert_allclose(
        from_chunks(again.rows.z, len(task.problem.rows)), task.problem.feature_rows() / 2
    )


def whitened(task, w):
    """f at the training rows in whitened outputs (N·ny,), straight from the learner."""
    z = jnp.asarray(task.scaling(task.problem.feature_rows()))
    values = jax.vmap(lambda row: task.bound.values(w, row))(z)
    return (values * task.unit / task.problem.deviation).ravel()


def test_values(task, run):
    expected = whitened(task, run.w).reshape(task.problem.target.shape) * task.problem.deviation
    np.testing.assert_allclose(task.values(run.w), expected, rtol=1e-12)


def test_gram_is_that_of_physics_and_jacobian(task, run):
    phi = task.problem.projection.phi.reshape(task.problem.target.size, -1)
    both = np.hstack([phi, jax.jit(jax.jacrev(lambda w: whitened(task, w)))(run.w)])
    found, expected = task.gram(run), both.T @ both
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        found / np.outer(size, size), expected / np.outer(size, size), atol=1e-11
    )
    np.testing.assert_array_equal(found.shape, (len(size),) * 2)


def test_mean_square_is_that_of_the_projected_residual(task, run):
    problem = task.problem
    phi = problem.projection.phi.reshape(problem.target.size, -1)
    rest = problem.whitened_target.ravel() - np.asarray(whitened(task, run.w))
    rest = rest - phi @ np.linalg.lstsq(phi, rest, rcond=None)[0]
    assert task.mean_square(run.normal.loss) == pytest.approx(np.mean(rest**2), rel=1e-9)


def test_gram_has_no_rows_of_a_penalty():
    example = synthetic.mass_spring_damper()
    task = OneStepTask.of(pose(example.train.rows(0, 400), example.baseline), MLP(hidden=(3,)))
    w = task.bound.init(jax.random.key(0))
    free, held = (
        task.run(LevenbergMarquardt(0), w, s) for s in (Orthogonal(), OrthogonalPenalty(100.0))
    )
    assert held.held and not free.held
    np.testing.assert_allclose(task.gram(held), task.gram(free), rtol=1e-9, atol=1e-9)
