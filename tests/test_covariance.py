"""Standard errors and intervals of θ: the textbook, certified values, a direct sandwich, and coverage."""

from __future__ import annotations

import json
from functools import partial

import numpy as np
import pandas as pd
import pytest
import scipy.stats

from orthaug import MLP, Baseline, LevenbergMarquardt, Record, Term, estimate, synthetic
from orthaug.inference.covariance import interval, noise_covariance

estimate = partial(estimate, standard_errors="plain")  # robust ones are asked for here

ROWS = 60
U = np.random.default_rng(0).normal(size=(ROWS, 3)) * [1.0, 1e-3, 50.0]
SOLVER = LevenbergMarquardt(iterations=40)
E = np.random.default_rng(1).normal(size=(ROWS, 2)) @ np.array([[1.0, 0.6], [0.0, 20.0]])


def textbook(phi, y, used=0.0):
    """√diag(s²(ΦᵀΦ)⁻¹) with s² = RSS / (N − nθ − used)."""
    theta = np.linalg.lstsq(phi, y, rcond=None)[0]
    variance = np.sum((y - phi @ theta) ** 2) / (len(y) - phi.shape[1] - used)
    return np.sqrt(np.diag(variance * np.linalg.inv(phi.T @ phi)))


@pytest.fixture(scope="module")
def single():
    record = Record.from_arrays(U, U @ [1.0, 500.0, -0.1] + E[:, 0])
    return estimate(
        record, Baseline.from_terms([Term(f"t{i}", f"u{i + 1}[k]") for i in range(3)]), learner=None
    )


@pytest.fixture(scope="module")
def network():
    example = synthetic.static(1, noise=True)
    return estimate(
        example.train,
        example.baseline,
        learner=MLP(hidden=(8,)),
        regularization="evidence",
        solver=SOLVER,
    )


def test_physics_alone_is_the_textbook(single):
    y = single.problem.record.experiments[0].outputs[:, 0]
    np.testing.assert_allclose(single.std, textbook(U, y), rtol=1e-10)
    np.testing.assert_allclose(single.covariance, single.covariance.T, rtol=1e-12)
    assert single.freedom == pytest.approx(ROWS - 3)
    np.testing.assert_allclose(
        single.model.statistics.noise, [[np.sum((y - U @ single.theta) ** 2) / (ROWS - 3)]]
    )


def test_interval_is_student_s(single):
    reach = scipy.stats.t.ppf(0.975, ROWS - 3) * single.std
    np.testing.assert_allclose(
        single.interval, np.stack([single.theta - reach, single.theta + reach], axis=1)
    )
    few = interval(np.array([1.0]), np.array([0.1]), freedom=2.0, level=0.9)
    np.testing.assert_allclose(few[0], 1.0 + 0.1 * scipy.stats.t.ppf([0.05, 0.95], 2))


def test_a_learner_uses_up_freedom(network):
    u, y = (
        getattr(network.problem.record.experiments[0], name)[:, 0] for name in ("inputs", "outputs")
    )
    phi = np.stack([u, u**3], axis=1)
    residual = y - network.model.predict(network.problem.record).model[:, 0]
    freedom = len(y) - 2 - network.effective_weights
    expected = np.sqrt(np.diag(np.sum(residual**2) / freedom * np.linalg.inv(phi.T @ phi)))
    np.testing.assert_allclose(network.std, expected, rtol=1e-9)
    assert network.freedom == pytest.approx(freedom) and network.effective_weights > 1
    assert np.sqrt(network.model.statistics.noise[0, 0]) == pytest.approx(
        synthetic.NOISE_30_DB, rel=0.05
    )


NIST = {
    "norris": ["1", "x[k]"],
    "pontius": ["1", "x[k]", "x[k]**2"],
    "noint1": ["x[k]"],
    "noint2": ["x[k]"],
    "longley": ["1", *(f"x{i}[k]" for i in range(1, 7))],
    "wampler3": ["1", "x[k]", "x[k]**2", "x[k]**3", "x[k]**4", "x[k]**5"],
}


@pytest.mark.parametrize("name", NIST)
def test_nist_standard_deviations(data_folder, name):
    table = pd.read_csv(data_folder / "nist_linear" / f"{name}.csv", encoding="utf-8-sig")
    certified = json.loads((data_folder / "nist_linear" / "certified.json").read_text())[name]
    channels = [column for column in table.columns if column != "y"]
    record = Record.from_arrays(table[channels].to_numpy(), table["y"].to_numpy(), inputs=channels)
    fit = estimate(
        record,
        Baseline.from_terms([Term(f"b{i}", t) for i, t in enumerate(NIST[name])]),
        learner=None,
    )
    np.testing.assert_allclose(fit.std, np.array(certified["sd"], dtype=float), rtol=1e-8)


def two_outputs(terms):
    y = np.stack([U @ [1.0, 500.0, 0.0], U @ [0.0, -300.0, 2.0]], axis=1) + E
    return estimate(Record.from_arrays(U, y), Baseline.from_terms(terms), learner=None), y


def test_two_outputs_with_their_own_parameters_are_two_textbooks():
    fit, y = two_outputs(
        [
            Term("a", "u1[k]", output="y1"),
            Term("b", "u2[k]", output="y1"),
            Term("c", "u2[k]", output="y2"),
            Term("d", "u3[k]", output="y2"),
            Term("e", "1", output="y2"),
        ]
    )
    first = textbook(U[:, :2], y[:, 0])
    second = textbook(np.column_stack([U[:, 1:], np.ones(ROWS)]), y[:, 1])
    np.testing.assert_allclose(fit.std, [*first, *second], rtol=1e-9)
    assert fit.freedom == pytest.approx(ROWS - 3)


def test_two_outputs_that_share_parameters_are_a_sandwich():
    """(Σψᵀψ)⁻¹(ΣψᵀΣ_eψ)(Σψᵀψ)⁻¹ with each output in its standard deviation."""
    fit, y = two_outputs(
        [
            Term("a", "u1[k]", output="y1"),
            Term("b", "u2[k]", output="y1"),
            Term("b", "-0.6*u2[k]", output="y2"),
            Term("c", "u3[k]", output="y2"),
            Term("a", "u3[k]**2", output="y2"),
        ]
    )
    zero = np.zeros(ROWS)
    phi = np.stack(
        [
            np.stack([U[:, 0], U[:, 1], zero], axis=1),
            np.stack([U[:, 2] ** 2, -0.6 * U[:, 1], U[:, 2]], axis=1),
        ],
        axis=1,
    )
    deviation = y.std(axis=0)
    psi, target = phi / deviation[:, None], y / deviation
    bread = np.linalg.inv(np.einsum("kit,kis->ts", psi, psi))
    theta = bread @ np.einsum("kit,ki->t", psi, target)
    np.testing.assert_allclose(fit.theta, theta, rtol=1e-8)
    hat = np.einsum("kit,ts,kis->ki", psi, bread, psi)
    freedom = ROWS - hat.sum(axis=0)
    residual = target - psi @ theta
    sigma = residual.T @ residual / np.sqrt(np.outer(freedom, freedom))
    meat = sum(row.T @ sigma @ row for row in psi)
    np.testing.assert_allclose(fit.covariance, bread @ meat @ bread, rtol=1e-7)
    np.testing.assert_allclose(
        fit.model.statistics.noise, sigma * np.outer(deviation, deviation), rtol=1e-8
    )


@pytest.mark.parametrize("freedom", [0.0, -1.0, 0.4])
def test_no_freedom_no_noise(freedom):
    assert noise_covariance(np.ones((2, 2)), np.array([5.0, freedom])) is None


def test_no_degrees_of_freedom_is_said():
    record = Record.from_arrays(U[:8], E[:8, 0])
    physics = Baseline.from_terms([Term("a", "u1[k]"), Term("b", "u3[k]")])
    fit = estimate(
        record,
        physics,
        learner=MLP(hidden=(8,)),
        solver=LevenbergMarquardt(30),
        regularization="none",
    )
    assert fit.std is None and fit.interval is None and fit.model.statistics.noise is None
    assert any(
        "8 rows leave no degrees of freedom for 2 parameters and" in str(text)
        for text in fit.warnings
    )
    assert fit.parameters["std"].isna().all() and "–" in fit.summary()


@pytest.mark.proof
def test_coverage_of_the_intervals(network, record_property):
    """95 % intervals of θ over noise draws on static set 1, each trained on from one fit.

    θ̂ = θ + Φ⁺e, and the error is independent of the residual that the width is of: the width of each draw has a
    coverage, the share of N(0, σ²(ΦᵀΦ)⁻¹) in it. Its mean over 100 draws has a standard deviation of 0.05 %, that of
    the share counted 2.2 %.
    """
    example = synthetic.static(1)
    (clean,) = example.train.experiments
    rng = np.random.default_rng(0)
    phi = clean.inputs ** [1, 3]
    true = synthetic.NOISE_30_DB * np.sqrt(np.diag(np.linalg.inv(phi.T @ phi)))
    inside, covered, draws = np.zeros(2), np.zeros(2), 100
    for _ in range(draws):
        e = rng.normal(scale=synthetic.NOISE_30_DB, size=(1024, 1))
        record = Record.from_arrays(clean.inputs, clean.outputs + e)
        fit = estimate(
            record, example.baseline, initial=network, regularization="evidence", solver=SOLVER
        )
        np.testing.assert_allclose(
            fit.theta - example.theta, np.linalg.pinv(phi) @ e[:, 0], atol=1e-12
        )
        low, high = fit.interval.T
        inside += (low <= example.theta) & (example.theta <= high)
        covered += 2 * scipy.stats.norm.cdf((high - low) / 2 / true) - 1
    record_property(
        "covered by 95 % [%]", ", ".join(f"{100 * share:.2f}" for share in covered / draws)
    )
    assert (covered / draws >= 0.945).all() and (covered / draws <= 0.955).all()
    assert (inside / draws >= 0.9).all() and (inside < draws).any()
    np.testing.assert_allclose(network.std, true, rtol=0.1)
