"""Contracts: facts F1 and F2 for random physics, learners and shapes; every combination that `estimate` takes.

Rows are drawn between 57 and 64, so that all examples of a shape share one compiled program.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from itertools import product
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orthaug import (
    MLP,
    Additive,
    Baseline,
    EquinoxModule,
    Function,
    Lags,
    LevenbergMarquardt,
    Orthogonal,
    Record,
    Term,
    estimate,
    orthogonalize,
)

REGRESSORS = {
    1: ("y[k-1]", "u[k]", "u[k-1]", "1", "y[k-1]**3", "sin(2*u[k])", "y[k-1]*u[k-1]", "abs(u[k])"),
    2: (
        "y1[k-1]",
        "y2[k-1]",
        "u[k]",
        "u[k-1]",
        "1",
        "y1[k-1]**2",
        "tanh(3*y2[k-1])",
        "y1[k-1]*u[k]",
        "abs(u[k-1])",
    ),
}
LAGS = Lags(na=1, nb=2, nk=0)


def quadratic(w, z):
    """Two weights and a bias for every output, not linear in the weights."""
    return w["gain"] * jnp.sum(z**2) + w["bias"] ** 2


QUADRATIC = {
    ny: Function(
        quadratic, lambda key, ny=ny: {"gain": jax.random.normal(key, (ny,)), "bias": jnp.ones(ny)}
    )
    for ny in (1, 2)
}
MODULE = {
    ny: EquinoxModule(lambda key, ny=ny: eqx.nn.MLP(2 + ny, ny, 3, 1, key=key)) for ny in (1, 2)
}
NETWORK = MLP(hidden=(3,))


def record_of(rng, ny: int, experiments: int = 1) -> Record:
    """A nonlinear system driven by noise, 57 to 64 usable rows in one or more experiments."""
    names = {"outputs": ["y"] if ny == 1 else ["y1", "y2"], "inputs": ["u"]}
    lengths = np.full(experiments, 64 // experiments + 1) - np.where(
        np.arange(experiments) == 0, rng.integers(0, 6), 0
    )
    pieces = []
    for length in lengths:
        u, e = rng.normal(size=length), 0.1 * rng.normal(size=(length, ny))
        y = np.zeros((length, ny))
        mix = rng.uniform(-0.4, 0.4, (ny, ny))
        for k in range(1, length):
            y[k] = (
                mix @ y[k - 1]
                + np.tanh(u[k] + u[k - 1]) * np.array([1.0, -30.0])[:ny]
                + 0.2 * np.abs(u[k])
                + e[k]
            )
        pieces.append(Record.from_arrays(u, y, **names))
    return Record.join(pieces)


def baseline_of(rng, ny: int, nt: int, shared: bool) -> Baseline:
    """`nt` random terms; with two outputs each in one of them, or each parameter in both (θ shared)."""
    texts = rng.permutation(REGRESSORS[ny])
    if ny == 1:
        return Baseline.from_terms([Term(f"t{j}", texts[j]) for j in range(nt)])
    outputs = ("y1", "y2")
    terms = [Term(f"t{j}", texts[j], output=outputs[(j + 1) % 2]) for j in range(nt)]
    if shared:
        terms += [Term(f"t{j}", texts[-1 - j], output=outputs[j % 2]) for j in range(nt)]
    return Baseline.from_terms(terms)


@cache
def learner_of(bound):
    """(weights, rows) -> the learner's values (N, ny)."""
    return jax.jit(jax.vmap(bound.values, (None, 0)))


class Stacked:
    """A fit's rows written out: whitened Φ (N·ny, nθ), Y and F (N·ny,)."""

    def __init__(self, fit):
        rows, bound, numbers = fit.problem.rows, fit.model.form.bound, fit.model.numbers
        self.weight = 1 / rows.y.std(axis=0)
        self.raw_phi = fit.problem.baseline.phi(rows.x, rows.layout, fit.problem.outputs, np)
        z = (fit.problem.feature_rows() - numbers.centre) / numbers.halfwidth
        # One shape, one compiled program
        padded = np.concatenate([z, np.repeat(z[:1], 64 - len(z), axis=0)])
        values = np.asarray(learner_of(bound)(jnp.asarray(numbers.weights), padded))[: len(z)]
        self.raw_f = numbers.gain * values
        self.phi = (self.raw_phi * self.weight[:, None]).reshape(rows.y.size, -1)
        self.y, self.f = (rows.y * self.weight).ravel(), (self.raw_f * self.weight).ravel()


CASES = st.tuples(
    st.sampled_from([(1, 1), (1, 3), (2, 3)]),  # (ny, nθ)
    st.booleans(),  # θ shared between outputs
    st.sampled_from(["network", "quadratic"]),
    st.integers(1, 3),  # experiments
    st.integers(0, 12),  # iterations
    st.integers(0, 2**32 - 1),
)


def fitted(case, structure):
    (ny, nt), shared, learner, experiments, iterations, seed = case
    rng = np.random.default_rng(seed)
    record, baseline = record_of(rng, ny, experiments), baseline_of(rng, ny, nt, shared)
    learner = NETWORK if learner == "network" else QUADRATIC[ny]
    solver = LevenbergMarquardt(iterations=iterations)
    return estimate(
        record,
        baseline,
        lags=LAGS,
        learner=learner,
        structure=structure,
        solver=solver,
        seed=seed % 1000,
        regularization="none",
    )


def close(found, expected, relative=1e-9):
    """Largest difference against the largest entry."""
    assert np.max(np.abs(found - expected)) <= relative * max(np.max(np.abs(expected)), 1e-12)


@settings(max_examples=40)
@given(CASES, st.integers(0, 2**32 - 1))
def test_f1_it_decouples(case, seed):
    """‖Y − Ŷ‖² = ‖QᵀY − Rθ‖² + ‖P⊥(Y − F)‖² for any θ, and θ̂ = Φ⁺Y whatever the learner does."""
    fit = fitted(case, Orthogonal())
    rows = Stacked(fit)
    q, r = np.linalg.qr(rows.phi)
    close(fit.theta, np.linalg.lstsq(rows.phi, rows.y, rcond=None)[0])
    close(fit.model.theta_aux, np.linalg.lstsq(rows.phi, rows.f, rcond=None)[0])
    rest = rows.y - rows.f
    learner_alone = np.sum((rest - q @ (q.T @ rest)) ** 2)
    for theta in (fit.theta, fit.theta + np.random.default_rng(seed).normal(size=len(fit.theta))):
        prediction = rows.phi @ (theta - fit.model.theta_aux) + rows.f
        physics_alone = np.sum((q.T @ rows.y - r @ theta) ** 2)
        assert np.sum((rows.y - prediction) ** 2) == pytest.approx(
            physics_alone + learner_alone, rel=1e-9
        )
    assert fit.status.loss == pytest.approx(learner_alone / len(rows.y), rel=1e-9)
    assert fit.defect <= 1e-12


@settings(max_examples=25)
@given(CASES)
def test_f2_every_structure_spans_the_same_functions(case):
    """The same weights predict the same; an additive model split afterwards has the orthogonal one's θ."""
    orthogonal, additive = fitted(case, Orthogonal()), fitted(case, Additive())
    np.testing.assert_array_equal(additive.model.numbers.weights, orthogonal.model.numbers.weights)
    a, o = Stacked(additive), Stacked(orthogonal)
    predicted = a.raw_phi @ additive.theta + a.raw_f
    close(predicted, o.raw_phi @ (orthogonal.theta - orthogonal.model.theta_aux) + o.raw_f)
    assert additive.status.loss == pytest.approx(orthogonal.status.loss, rel=1e-9)

    def from_elsewhere(x):
        np.testing.assert_array_equal(x, additive.problem.rows.x)
        return predicted

    split = orthogonalize(
        additive.problem.record, additive.problem.baseline, from_elsewhere, lags=LAGS
    )
    close(split.theta, orthogonal.theta, 1e-8)
    assert split.defect <= 1e-12
    assert split.status.loss == pytest.approx(orthogonal.status.loss, rel=1e-9)


LEARNERS = {
    "network": lambda ny: NETWORK,
    "function": QUADRATIC.get,
    "equinox": MODULE.get,
    "none": lambda ny: None,
}


def combinations() -> Iterator[Any]:
    """Every combination; the suite has half of them, in which any three choices are together, and the proofs all."""
    structures, regularizations = (Orthogonal(), Additive()), ("none", "evidence", 0.5)
    choices = (structures, regularizations, (1, 2), tuple(LEARNERS))
    for places in product(*(range(len(several)) for several in choices)):
        one = [several[place] for several, place in zip(choices, places, strict=True)]
        marks = [pytest.mark.proof] if sum(places) % 2 else []
        yield pytest.param(*one, marks=marks, id="-".join([one[0].name, *map(str, one[1:])]))


@pytest.mark.parametrize(("structure", "regularization", "ny", "learner"), list(combinations()))
def test_every_combination(structure, regularization, ny, learner):
    rng = np.random.default_rng(3)
    record, baseline = record_of(rng, ny, 2), baseline_of(rng, ny, 3, shared=ny == 2)
    first, second = (
        estimate(
            record,
            baseline,
            lags=LAGS,
            learner=LEARNERS[learner](ny),
            structure=structure,
            regularization=regularization,
            solver=LevenbergMarquardt(iterations=40),
            seed=5,
        )
        for _ in range(2)
    )
    assert first.status.code in ("converged", "iteration_limit", "no_descent", "exact")
    assert (first.status.code == "exact") == (learner == "none")
    assert np.isfinite(first.status.loss) and 0 <= first.status.loss < 1
    assert np.isfinite(first.theta).all() and np.isfinite(first.model.numbers.weights).all()
    assert (first.std is None) == (structure.name == "additive" and learner != "none")
    if first.std is not None:
        assert np.isfinite(first.std).all() and (first.std > 0).all()

    np.testing.assert_array_equal(first.theta, second.theta)
    np.testing.assert_array_equal(first.model.numbers.weights, second.model.numbers.weights)
    assert (first.status.loss, first.status.iterations) == (
        second.status.loss,
        second.status.iterations,
    )

    components = first.model.components(record)
    np.testing.assert_array_equal(components.model, second.model.predict(record).model)
    residual = []
    for trajectory, experiment in zip(components.trajectories, record.experiments, strict=True):
        assert np.isnan(trajectory.model[:1]).all()
        assert np.isfinite(trajectory.model[1:]).all()
        np.testing.assert_array_equal(trajectory.model, trajectory.baseline + trajectory.learner)
        residual.append(((experiment.outputs - trajectory.model) / record_std(first))[1:])
    assert np.mean(np.concatenate(residual) ** 2) == pytest.approx(first.status.loss, rel=1e-9)

    phi = first.problem.baseline.phi(
        first.problem.rows.x, first.problem.layout, first.problem.outputs, np
    )
    baseline_part = np.concatenate([t.baseline[1:] for t in components.trajectories])
    np.testing.assert_allclose(baseline_part, phi @ first.theta, rtol=1e-10, atol=1e-12)
    moved = np.concatenate([(t.learner_before - t.learner)[1:] for t in components.trajectories])
    np.testing.assert_allclose(moved, phi @ first.model.theta_aux, rtol=1e-8, atol=1e-10)


def record_std(fit) -> np.ndarray:
    return fit.problem.rows.y.std(axis=0)
