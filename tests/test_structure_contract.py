"""Every structure, number of outputs and solver: the criterion is the joint one with θ minimised exactly."""

from __future__ import annotations

from functools import lru_cache, partial

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
    Lags,
    LevenbergMarquardt,
    Orthogonal,
    OrthogonalPenalty,
    Record,
    Term,
    estimate,
)
from orthaug.fitting.one_step import OneStepTask
from orthaug.physics.problem import pose

STRUCTURES = (Orthogonal(), Additive(), OrthogonalPenalty(3.0), BaselinePenalty(20.0))
INITIAL = {"a": 0.5, "b": -0.8}
LAGS = Lags(na=1, nb=2, nk=0)
LEARNER = MLP(hidden=(3,))
ROWS = 60
NOTHING_DONE = LevenbergMarquardt(iterations=0)
SOLVERS = (LevenbergMarquardt(iterations=6), AdamLBFGS(adam_iterations=6, lbfgs_iterations=4))
RELATIVE = 1e-12

# one parameter per output, or both parameters in every output
TERMS = {
    (1, False): [("a", "y1[k-1]", "y1"), ("b", "u[k]", "y1")],
    (1, True): [("a", "y1[k-1]", "y1"), ("b", "u[k]", "y1"), ("b", "u[k-1]", "y1")],
    (2, False): [("a", "y1[k-1]", "y1"), ("b", "u[k]", "y2")],
    (2, True): [
        ("a", "y1[k-1]", "y1"),
        ("b", "u[k]", "y1"),
        ("a", "y2[k-1]", "y2"),
        ("b", "u[k-1]", "y2"),
    ],
}
CASES = [(structure, *key) for structure in STRUCTURES for key in TERMS]
IDS = [f"{s.name}, {ny} outputs{', θ shared' if shared else ''}" for s, ny, shared in CASES]


def signals(ny):
    """u (N,) and y (N, ny): linear lags and a square, the second output a thousand times the first."""
    rng = np.random.default_rng(ny)
    u, y = rng.uniform(-1, 1.5, ROWS), np.zeros((ROWS, ny))
    for k in range(1, ROWS):
        y[k] = 0.4 * y[k - 1] + (0.6 * u[k] + 0.3 * u[k - 1] ** 2) * np.array([1.0, 1000.0])[:ny]
    return u, y + 0.05 * y.std(axis=0) * rng.normal(size=y.shape)


def declared(ny, shared):
    u, y = signals(ny)
    outputs = ["y1", "y2"][:ny]
    terms = [Term(p, text, INITIAL[p], output=output) for p, text, output in TERMS[ny, shared]]
    return Record.from_arrays(u, y, outputs=outputs), Baseline.from_terms(terms)


def raw_physics(ny, shared):
    """Φ (N, ny, nθ) from the first usable row on, by hand."""
    u, y = signals(ny)
    values = {"u[k]": u[1:], "u[k-1]": u[:-1], "y1[k-1]": y[:-1, 0], "y2[k-1]": y[:-1, -1]}
    phi = np.zeros((ROWS - 1, ny, 2))
    for parameter, text, output in TERMS[ny, shared]:
        phi[:, ["y1", "y2"].index(output), "ab".index(parameter)] += values[text]
    return phi


@lru_cache
def posed(ny, shared):
    task = OneStepTask.of(pose(*declared(ny, shared), LAGS), LEARNER)
    phi, y = raw_physics(ny, shared), signals(ny)[1][1:]
    spread = y.std(axis=0)
    z = jnp.asarray(task.scaling(task.problem.feature_rows()))
    whitened = (phi / spread[:, None]).reshape(-1, 2)
    q = np.linalg.svd(whitened, full_matrices=False)[0].reshape(phi.shape)
    raw = {"phi": phi, "y": y, "z": z, "q": q, "pinv": np.linalg.pinv(whitened)}
    raw |= {"spread": spread, "unit": task.unit, "rms": task.rms}
    return task, jax.tree.map(jnp.asarray, raw)


def joint_residual(structure, bound, unknowns, raw):
    """All residual rows over (θ, w) in the outputs' units, from raw rows; several outputs in deviations.

    Divided at the end by what the criterion counts in: the outputs' deviation and the RMS of the baseline's residual.
    """
    theta, w = unknowns
    spread, ny = raw["spread"], raw["y"].shape[1]
    f = raw["unit"] * jax.vmap(lambda row: bound.values(w, row))(raw["z"])
    if isinstance(structure, Orthogonal):
        moved = raw["pinv"] @ (f / spread).ravel()
        rest = raw["y"] - raw["phi"] @ (theta - moved) - f
    else:
        rest = raw["y"] - raw["phi"] @ theta - f
    unit = spread[0] if ny == 1 else 1.0  # λ counts in the output's units, of several in deviations
    rows = [(rest / spread).ravel() * unit]
    if isinstance(structure, OrthogonalPenalty):
        inside = jnp.einsum("kyt,ky->t", raw["q"], f / spread) * unit
        rows.append(jnp.sqrt(structure.weight) * inside)
    if isinstance(structure, BaselinePenalty):
        initial = jnp.array(list(INITIAL.values()))
        rows.append(jnp.sqrt(structure.weight) * (theta - initial) / initial)
    return jnp.concatenate(rows) / unit / raw["rms"]


@partial(jax.jit, static_argnums=(0, 1))
def differentiated(structure, bound, unknowns, raw):
    function = partial(joint_residual, structure, bound)
    return function(unknowns, raw), jax.jacfwd(function)(unknowns, raw)


def eliminated(structure, task, raw, w):
    """Gauss-Newton matrix, downhill gradient and loss over w with θ at its minimum: the Schur complement."""
    theta = jnp.zeros(2)
    r, (by_theta, _) = differentiated(structure, task.bound, (theta, w), raw)
    best = jnp.asarray(np.linalg.lstsq(np.asarray(by_theta), -np.asarray(r), rcond=None)[0])
    r, (by_theta, by_w) = differentiated(structure, task.bound, (best, w), raw)
    basis = np.linalg.qr(np.asarray(by_theta))[0]
    j, r = np.asarray(by_w), np.asarray(r)
    for _ in range(2):
        j, r = j - basis @ (basis.T @ j), r - basis @ (basis.T @ r)
    return j.T @ j, -j.T @ r, r @ r


def weights(task, seed):
    return task.bound.init(jax.random.key(seed)) + 0.1 * (seed + 1)


def apart(found, expected):
    """Largest difference against the largest entry."""
    return np.max(np.abs(np.asarray(found) - expected)) / np.max(np.abs(expected))


@pytest.mark.parametrize(("structure", "ny", "shared"), CASES, ids=IDS)
def test_matrix_and_gradient_are_those_of_the_joint_criterion(structure, ny, shared):
    task, raw = posed(ny, shared)
    losses = []
    for seed in range(3):
        w = weights(task, seed)
        found = task.run(NOTHING_DONE, w, structure).normal
        hessian, gradient, loss = eliminated(structure, task, raw, w)
        assert apart(found.hessian, hessian) < RELATIVE
        assert apart(found.gradient, gradient) < RELATIVE
        losses.append((float(found.loss), loss))
    found, expected = np.array(losses).T
    np.testing.assert_allclose(
        found - found[0], expected - expected[0], atol=RELATIVE * expected.max()
    )


def fit(structure, ny, shared, solver):
    record, baseline = declared(ny, shared)
    return estimate(
        record, baseline, lags=LAGS, learner=LEARNER, structure=structure, solver=solver
    )


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: type(s).__name__)
@pytest.mark.parametrize(("structure", "ny", "shared"), CASES, ids=IDS)
def test_every_solver_fits_every_structure(structure, ny, shared, solver):
    found, again = fit(structure, ny, shared, solver), fit(structure, ny, shared, solver)
    assert found.status.code in ("converged", "iteration_limit", "no_descent") and found.status.ok
    assert np.isfinite(found.theta).all() and np.isfinite(found.status.loss)
    np.testing.assert_array_equal(again.theta, found.theta)
    np.testing.assert_array_equal(again.model.numbers.weights, found.model.numbers.weights)
    if isinstance(structure, Orthogonal):
        phi, y = raw_physics(ny, shared), signals(ny)[1][1:]
        spread = y.std(axis=0)
        least = np.linalg.lstsq(
            (phi / spread[:, None]).reshape(-1, 2), (y / spread).ravel(), rcond=None
        )[0]
        np.testing.assert_allclose(found.theta, least, rtol=1e-11)
        assert found.defect < 1e-12
    else:
        assert found.std is None


@pytest.mark.parametrize("ny", [1, 2])
@pytest.mark.parametrize("structure", STRUCTURES[1:], ids=lambda s: s.name)
def test_theta_at_the_end_minimises_the_joint_criterion(structure, ny):
    """No θ beside the one that Levenberg-Marquardt ends with is better for the weights found."""
    task, raw = posed(ny, False)
    found = fit(structure, ny, False, SOLVERS[0])
    w = jnp.asarray(found.model.numbers.weights)
    r, (by_theta, _) = differentiated(structure, task.bound, (jnp.asarray(found.theta), w), raw)
    step = np.linalg.lstsq(np.asarray(by_theta), -np.asarray(r), rcond=None)[0]
    np.testing.assert_allclose(step / found.theta, 0, atol=1e-11)


def test_both_solvers_end_with_one_criterion():
    """With a weight so large that the optimum is all but fixed, both solvers agree on θ."""
    thetas = [
        fit(BaselinePenalty(1e9), 1, False, solver).theta
        for solver in (SOLVERS[0], AdamLBFGS(6, 60))
    ]
    np.testing.assert_allclose(thetas[0], list(INITIAL.values()), rtol=1e-6)
    np.testing.assert_allclose(thetas[1], thetas[0], rtol=1e-6)
