"""θ and the weights as unknowns of one criterion: its normal equations, and the additive structure from θ⁰."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from orthaug import MLP, Additive, Baseline, InputError, LevenbergMarquardt, Record, Term, estimate
from orthaug.fitting.elimination import eliminate
from orthaug.fitting.normal_equations import one_pass
from orthaug.fitting.one_step import OneStepTask
from orthaug.fitting.paper_criterion import JointOneStep, Physics
from orthaug.models.rows import Overlap
from orthaug.physics.problem import pose

LEARNER, STRUCTURE = MLP((3,)), Additive(from_initial=True)
INITIAL = np.array([0.8, 0.03])


def example(**limits) -> tuple[Record, Baseline]:
    u = np.random.default_rng(5).normal(0.0, 0.3, 200)
    terms = [
        Term("a", "u[k]", initial=INITIAL[0], **limits),
        Term("b", "u[k]**3", initial=INITIAL[1]),
    ]
    return Record.from_arrays(u, 0.01 + u - 0.5 * u**2 + 0.1 * u**3), Baseline.from_terms(terms)


def fitted(iterations: int, structure=STRUCTURE, **options):
    record, baseline = example()
    return estimate(
        record,
        baseline,
        learner=LEARNER,
        structure=structure,
        solver=LevenbergMarquardt(iterations),
        **options,
    )


@pytest.mark.parametrize("known", [False, True], ids=["first pass", "second pass"])
def test_normal_equations_are_those_of_all_columns(known):
    problem = pose(*example())
    task = OneStepTask.of(problem, LEARNER)
    physics = Physics.of(problem, eliminate(STRUCTURE, problem), {}, 0.0, task.rms, solved=False)
    rng = np.random.default_rng(0)
    p = jnp.asarray(rng.normal(size=2 + task.bound.size))
    criterion = JointOneStep(task.bound)
    before = Overlap(jnp.zeros((2, len(p))), jnp.zeros(2))
    before = one_pass(criterion, p, (task.rows, physics), before).overlap if known else before
    normal = one_pass(criterion, p, (task.rows, physics), before)

    phi = np.stack([problem.feature_rows()[:, 0], problem.feature_rows()[:, 0] ** 3], axis=1)
    scale = np.sqrt(len(phi)) / np.linalg.norm(phi * problem.weight.matrix[0, 0] / task.rms, axis=0)

    def residual(p):
        values = jax.vmap(task.bound.values, in_axes=(None, 0))(
            p[2:], task.scaling(problem.feature_rows())
        )
        model = phi @ (INITIAL + scale * p[:2]) + task.unit * values[:, 0]
        return (problem.target[:, 0] - model) * problem.weight.matrix[0, 0] / task.rms

    r, columns = jax.jit(lambda p: (residual(p), -jax.jacobian(residual)(p)))(p)
    np.testing.assert_allclose(normal.loss, r @ r, rtol=1e-9)
    np.testing.assert_allclose(normal.gradient, columns.T @ r, rtol=1e-8, atol=1e-8 * float(r @ r))
    np.testing.assert_allclose(normal.hessian, columns.T @ columns, rtol=1e-8, atol=1e-9 * len(r))


def test_theta_starts_at_the_initial_values():
    np.testing.assert_allclose(fitted(0).theta, INITIAL, rtol=1e-12)
    assert np.abs(fitted(0, Additive()).theta - INITIAL).max() > 0.05


def test_it_ends_near_its_start_and_predicts_like_the_solved_one():
    found, solved = fitted(200), fitted(200, Additive())
    record, _ = example()
    errors = [fit.model.predict(record).scores().rmse[0] for fit in (found, solved)]
    assert max(errors) < 1e-4
    assert np.linalg.norm(found.theta - INITIAL) < np.linalg.norm(solved.theta - INITIAL)


def test_a_bound_holds():
    record, baseline = example(max=0.8)
    fit = estimate(
        record, baseline, learner=LEARNER, structure=STRUCTURE, solver=LevenbergMarquardt(30)
    )
    assert fit.theta[0] <= 0.8 and "a" in fit.at_bound


@pytest.mark.parametrize("regularization", ["evidence", 0.1])
def test_regularization_is_refused_in_words(regularization):
    with pytest.raises(
        InputError, match="regularization needs a solved θ; leave out `from_initial`"
    ):
        fitted(2, regularization=regularization)


def test_what_is_no_truth_value_is_refused():
    with pytest.raises(InputError, match="from_initial"):
        Additive(from_initial="yes")  # type: ignore[arg-type]
