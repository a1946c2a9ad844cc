"""The paper's pipeline: where it ends, what it minimises, and what it refuses."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from orthaug import (
    MLP,
    AdamLBFGS,
    Additive,
    Baseline,
    BaselinePenalty,
    Function,
    InputError,
    Orthogonal,
    OrthogonalPenalty,
    Record,
    Term,
    estimate,
)
from orthaug.fitting.one_step import OneStepTask
from orthaug.fitting.solvers import adam_lbfgs
from orthaug.physics.problem import pose

STRUCTURES = (Orthogonal(), Additive(), OrthogonalPenalty(0.5), BaselinePenalty(0.5))
LINEAR = Function(
    lambda w, z: w @ jnp.stack([z[0] ** 2, z[1] ** 2]), lambda key: 0.1 * jnp.ones((1, 2))
)
BROKEN = Function(lambda w, z: w * jnp.log(z[:1] - 5), lambda key: jnp.ones(1))
NET = MLP(hidden=(3,))
INITIAL = np.array([0.8, -0.3])
BASELINE = Baseline.from_terms([Term("a", "u1[k]", INITIAL[0]), Term("b", "u2[k]", INITIAL[1])])


def signals():
    rng = np.random.default_rng(0)
    u = rng.uniform(-0.5, 1.0, (80, 2))
    return u, u @ [1.0, -0.5] + 0.4 * u[:, 0] ** 2 - 0.2 * u[:, 1] ** 2 + 0.02 * rng.normal(size=80)


RECORD = Record.from_arrays(*signals())


def fit(structure, solver, learner=NET, **options):
    return estimate(
        RECORD, BASELINE, learner=learner, structure=structure, solver=solver, **options
    )


def least_squares(structure):
    """θ and the fitted values of the linear learner's problem, in one least squares over (θ, w)."""
    u, y = signals()
    z = 2 * (u - u.min(axis=0)) / np.ptp(u, axis=0) - 1
    psi = z**2
    moved = (
        psi - u @ np.linalg.lstsq(u, psi, rcond=None)[0]
        if isinstance(structure, Orthogonal)
        else psi
    )
    rows, right = [np.hstack([u, moved])], [y]
    if isinstance(structure, OrthogonalPenalty):
        rows.append(
            np.sqrt(structure.weight) * np.hstack([np.zeros((2, 2)), np.linalg.qr(u)[0].T @ psi])
        )
        right.append(np.zeros(2))
    if isinstance(structure, BaselinePenalty):
        rows.append(np.sqrt(structure.weight) * np.hstack([np.diag(1 / INITIAL), np.zeros((2, 2))]))
        right.append(np.sqrt(structure.weight) * np.ones(2))
    found = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    return found[:2], rows[0] @ found


@pytest.mark.parametrize("structure", STRUCTURES, ids=lambda s: s.name)
def test_linear_learner_ends_at_least_squares(structure):
    found = fit(structure, AdamLBFGS(20, 300), LINEAR)
    theta, fitted = least_squares(structure)
    assert found.status.code == "converged" and found.status.iterations < 320
    np.testing.assert_allclose(found.theta, theta, rtol=1e-6)
    np.testing.assert_allclose(
        found.model.predict(RECORD).trajectories[0].model[:, 0], fitted, atol=1e-6
    )


@pytest.fixture
def seen(monkeypatch):
    """What the solver is called with."""
    calls, original = [], AdamLBFGS.minimize

    def minimize(solver, criterion, w, rows, physics, *, progress=None):
        calls.append((criterion, w, rows, physics))
        return original(solver, criterion, w, rows, physics, progress=progress)

    monkeypatch.setattr(AdamLBFGS, "minimize", minimize)
    return calls


def raw_criterion(structure, task, theta, w):
    """The mean of squares in the output's units, from raw rows."""
    u, y = signals()
    z = 2 * (u - u.min(axis=0)) / np.ptp(u, axis=0) - 1
    f = task.unit[0] * np.array([task.bound.values(w, row)[0] for row in jnp.asarray(z)])
    if isinstance(structure, Orthogonal):
        return np.mean((y - u @ (theta - np.linalg.lstsq(u, f, rcond=None)[0]) - f) ** 2)
    extra = 0.0
    if isinstance(structure, OrthogonalPenalty):
        extra = structure.weight * np.sum((np.linalg.qr(u)[0].T @ f) ** 2)
    if isinstance(structure, BaselinePenalty):
        extra = structure.weight * np.sum(((theta - INITIAL) / INITIAL) ** 2)
    return (np.sum((y - u @ theta - f) ** 2) + extra) / len(y)


@pytest.mark.parametrize("structure", STRUCTURES, ids=lambda s: s.name)
def test_the_joint_criterion_is_the_plain_formula(structure, seen):
    task = OneStepTask.of(pose(RECORD, BASELINE), NET)
    task.run(AdamLBFGS(0, 1), task.bound.init(jax.random.key(0)), structure)
    ((criterion, w, rows, physics),) = seen
    y = signals()[1]
    for v in (np.zeros(2), np.array([0.3, -2.0])):
        coordinates = np.asarray(physics.start + physics.basis @ v) * task.rms
        theta = task.problem.projection.from_coordinates(coordinates)
        found = float(criterion((jnp.asarray(v), w), rows, physics)) * (task.rms * y.std()) ** 2
        assert found == pytest.approx(raw_criterion(structure, task, theta, w), rel=1e-10)
        if isinstance(structure, Orthogonal):  # θ is solved, not an unknown (F1)
            np.testing.assert_allclose(
                theta, task.problem.projection.solve(task.problem.whitened_target), rtol=1e-10
            )
        elif not v.any():
            np.testing.assert_allclose(theta, INITIAL, rtol=1e-12)


def test_a_ridge_is_the_same_as_for_levenberg_marquardt(seen):
    """α counts against squared errors in units of the baseline's RMS residual."""
    task, values = OneStepTask.of(pose(RECORD, BASELINE), NET), []
    w = task.bound.init(jax.random.key(0))
    for ridge in (0.0, 0.7):
        task.run(AdamLBFGS(0, 1), w, Additive(), ridge)
        criterion, _, rows, physics = seen.pop()
        assert not seen
        values.append(float(criterion((jnp.zeros(2), w), rows, physics)))
    assert values[1] - values[0] == pytest.approx(0.7 * float(w @ w) / 80, rel=1e-10)


@pytest.mark.parametrize("structure", [Orthogonal(), Additive()], ids=lambda s: s.name)
def test_lbfgs_goes_on_from_adam(structure):
    start, adam, both = (
        fit(structure, AdamLBFGS(*steps)).status for steps in ((1, 0), (40, 0), (40, 40))
    )
    assert both.loss < adam.loss < start.loss
    assert adam.iterations == 40 and both.iterations <= 80


def test_the_loss_never_rises_under_lbfgs(monkeypatch):
    monkeypatch.setattr(adam_lbfgs, "burst_length", lambda burst, spent: 1)
    entries = []
    fit(
        Additive(),
        AdamLBFGS(0, 40),
        progress=lambda run, iteration, loss: entries.append((iteration, loss)),
    )
    iterations, losses = zip(*entries, strict=True)
    assert iterations == tuple(range(1, len(entries) + 1))
    assert np.all(np.diff(losses) <= 0)


@pytest.mark.parametrize("structure", [Orthogonal(), Additive()], ids=lambda s: s.name)
@pytest.mark.parametrize("burst", [1, 7])
def test_bursts_change_nothing(monkeypatch, structure, burst):
    found = []
    for length in (burst, 10**6):
        monkeypatch.setattr(adam_lbfgs, "burst_length", lambda b, spent, length=length: length)
        found.append(fit(structure, AdamLBFGS(20, 20)))
    np.testing.assert_array_equal(found[0].model.numbers.weights, found[1].model.numbers.weights)
    np.testing.assert_array_equal(found[0].theta, found[1].theta)
    assert found[0].status.iterations == found[1].status.iterations


def test_a_loss_that_is_not_finite_is_said():
    found = fit(Additive(), AdamLBFGS(3, 3), BROKEN)
    assert found.status.code == "non_finite" and not found.status.ok
    assert "not finite" in found.status.message


def test_a_loss_that_is_not_finite_ends_the_run():
    assert fit(Additive(), AdamLBFGS(1000, 1000), BROKEN).status.iterations < 1000


def test_theta_starts_at_the_initial_values():
    found = fit(Additive(), AdamLBFGS(0, 0))
    assert found.status.code == "iteration_limit" and found.status.iterations == 0
    np.testing.assert_allclose(found.theta, INITIAL, rtol=1e-14)


def test_theta_of_the_orthogonal_structure_is_least_squares_from_the_start():
    found = fit(Orthogonal(), AdamLBFGS(1, 0))
    np.testing.assert_allclose(found.theta, np.linalg.lstsq(*signals(), rcond=None)[0], rtol=1e-12)


def test_a_step_of_adam_moves_theta_by_the_rate_in_its_own_unit():
    """An unknown of size 1 is a column as large as a row of the criterion: a step moves φθ by `rate` RMS residuals."""
    moved = np.abs(fit(Additive(), AdamLBFGS(1, 0, 0.01)).theta - INITIAL)
    u, y = signals()
    residual = y - u @ np.linalg.lstsq(u, y, rcond=None)[0]
    unit = residual.std() * np.sqrt(len(y)) / np.linalg.norm(u, axis=0)
    np.testing.assert_allclose(moved, 0.01 * unit, rtol=1e-3)


def test_evidence_is_refused_in_words():
    with pytest.raises(InputError, match="evidence regularization needs .*levenberg-marquardt"):
        fit(Additive(), AdamLBFGS(1, 1), regularization="evidence")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"adam_iterations": -1}, "adam_iterations"),
        ({"adam_iterations": 1.5}, "adam_iterations"),
        ({"lbfgs_iterations": -1}, "lbfgs_iterations"),
        ({"lbfgs_iterations": "many"}, "lbfgs_iterations"),
        ({"learning_rate": 0.0}, "learning_rate.*positive"),
        ({"learning_rate": -1e-3}, "learning_rate.*positive"),
        ({"learning_rate": float("nan")}, "learning_rate.*positive"),
        ({"learning_rate": float("inf")}, "learning_rate.*positive"),
        ({"learning_rate": "fast"}, "learning_rate"),
    ],
    ids=str,
)
def test_arguments_are_checked_in_words(arguments, words):
    with pytest.raises(InputError, match=words):
        AdamLBFGS(**arguments)


def test_steps_at_most():
    assert AdamLBFGS(3, 4).iterations == 7
