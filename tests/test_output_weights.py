"""Output weights: the inner product of criterion and measure, against generalised least squares written out."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from test_cli import finite_json, run

from orthaug import (
    MLP,
    Additive,
    Baseline,
    InputError,
    LevenbergMarquardt,
    OrthogonalPenalty,
    Record,
    Simulation,
    Term,
    Uniform,
    estimate,
    load,
    save,
)
from orthaug.fitting.fit_plans import reweight
from orthaug.inference.covariance import joint_covariance

ROWS = 300
LEARNER, SOLVER = MLP((3,)), LevenbergMarquardt(200)
BASELINE = Baseline.from_terms(
    [
        Term("a", "u[k]", output="y1"),
        Term("a", "40*u[k]", output="y2"),
        Term("b", "20*u[k]**3", output="y2"),
    ]
)
CHOICES = ("none", "std", "covariance", (1.0, 0.01))


@cache
def two_outputs(unit: float = 20.0) -> Record:
    """Two outputs that share a parameter, the second in another unit, with correlated errors."""
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, (ROWS, 1))
    e = rng.normal(size=(ROWS, 2)) @ np.array([[0.1, 0.25], [0.0, 0.1]])
    y = np.hstack([u + 0.3 * u**2, 2 * u + u**3 + 0.15 * u**2]) + e
    return Record.from_arrays(u, y * [1.0, unit])


@cache
def fitted(choice):
    return estimate(two_outputs(), BASELINE, learner=LEARNER, solver=SOLVER, output_weights=choice)


def physics() -> tuple[np.ndarray, np.ndarray]:
    """Φ (N, 2, 2) and Y (N, 2) in the outputs' units, from the data alone."""
    experiment = two_outputs().experiments[0]
    u = experiment.inputs[:, 0]
    phi = np.zeros((ROWS, 2, 2))
    phi[:, 0, 0], phi[:, 1, 0], phi[:, 1, 1] = u, 40 * u, 20 * u**3
    return phi, experiment.outputs


def weighted_least_squares(matrix: np.ndarray) -> np.ndarray:
    phi, y = physics()
    rows, target = np.einsum("oi,kit->kot", matrix, phi), y @ matrix.T
    return np.linalg.lstsq(rows.reshape(-1, 2), target.ravel(), rcond=None)[0]


def weight_of(choice):
    """The weight of the outputs in a fit of physics alone."""
    return estimate(two_outputs(), BASELINE, learner=None, output_weights=choice).problem.weight


def learner_values(fit) -> np.ndarray:
    """F̃ (N, 2), the learner's part of the prediction."""
    return fit.model.components(fit.problem.record).trajectories[0].learner


@pytest.mark.parametrize("choice", CHOICES, ids=str)
def test_theta_is_weighted_least_squares_whatever_the_learner_does(choice):
    fit = fitted(choice)
    np.testing.assert_allclose(
        fit.theta, weighted_least_squares(fit.problem.weight.matrix), rtol=1e-10
    )
    assert fit.defect is not None and fit.defect <= 1e-12


@pytest.mark.parametrize(
    ("choice", "matrix"),
    [
        ("none", np.eye(2)),
        ((1.0, 0.01), np.diag([1.0, 0.1])),
        ("std", np.diag(1 / two_outputs().experiments[0].outputs.std(axis=0))),
    ],
    ids=["none", "numbers", "std"],
)
def test_what_is_chosen(choice, matrix):
    weight = weight_of(choice)
    np.testing.assert_allclose(
        weight.matrix / weight.matrix[0, 0], matrix / matrix[0, 0], atol=1e-15
    )
    whitened = two_outputs().experiments[0].outputs @ weight.matrix.T
    assert np.mean(whitened.var(axis=0)) == pytest.approx(1.0)


def test_none_is_the_papers_inner_product():
    """The paper's own ΦᵀF̃ in the outputs' units vanishes under "none" alone."""
    phi, _ = physics()

    def defect(fit) -> float:
        values = learner_values(fit)
        return float(
            np.linalg.norm(np.einsum("kot,ko->t", phi, values))
            / np.linalg.norm(phi)
            / np.linalg.norm(values)
        )

    assert defect(fitted("none")) <= 1e-14
    assert defect(fitted("std")) > 1e-3


def test_covariance_is_iterated_to_consistency():
    fit = fitted("covariance")
    matrix = fit.problem.weight.matrix
    whitened = matrix @ fit.model.statistics.noise @ matrix.T
    np.testing.assert_allclose(whitened / whitened[0, 0], np.eye(2), atol=1e-5)
    assert fit.problem.weight.kind == "covariance" and not fit.warnings


def test_covariance_of_physics_alone_is_iterated_generalised_least_squares():
    phi, y = physics()
    matrix = np.diag(1 / y.std(axis=0))
    for _ in range(60):
        theta = weighted_least_squares(matrix)
        residual = y - phi @ theta
        matrix = np.linalg.inv(np.linalg.cholesky(residual.T @ residual / ROWS))
    fit = estimate(
        two_outputs(), BASELINE, learner=None, output_weights="covariance", standard_errors="plain"
    )
    np.testing.assert_allclose(
        fit.theta, theta, rtol=1e-3
    )  # degrees of freedom differ between the outputs
    rows = np.einsum(
        "oi,kit->kot", np.linalg.inv(np.linalg.cholesky(fit.model.statistics.noise)), phi
    ).reshape(-1, 2)
    np.testing.assert_allclose(fit.std, np.sqrt(np.diag(np.linalg.inv(rows.T @ rows))), rtol=1e-5)
    plain = estimate(two_outputs(), BASELINE, learner=None)
    assert np.all(fit.std < plain.std)


def test_covariance_does_not_depend_on_the_outputs_units():
    """What every other choice but "std" does."""
    own = Baseline.from_terms([Term("a", "u[k]", output="y1"), Term("b", "u[k]**3", output="y2")])
    options = {"learner": None, "output_weights": "covariance"}
    fits = [estimate(two_outputs(unit), own, **options) for unit in (1.0, 1000.0)]
    np.testing.assert_allclose(fits[1].theta, fits[0].theta * [1, 1000.0], rtol=1e-5)


def test_numbers_weigh_squared_errors():
    """Equal numbers are "none"; a hundred times the first one's leaves θ to the first output."""
    np.testing.assert_allclose(
        *(weight_of(c).matrix for c in ("none", [3, 3])),
        rtol=1e-14,
    )
    many = estimate(two_outputs(), BASELINE, learner=None, output_weights=[1e6, 1e-3])
    phi, y = physics()
    assert many.theta[0] == pytest.approx(
        float(phi[:, 0, 0] @ y[:, 0] / (phi[:, 0, 0] @ phi[:, 0, 0])), rel=1e-4
    )


def test_penalties_count_in_the_units_of_the_sum_that_is_asked_for():
    """λ against the plain sum of squares under "none", as in the published scripts."""
    weight = weight_of("none")
    np.testing.assert_allclose(weight.matrix, weight.unit * np.eye(2))
    structure = OrthogonalPenalty(weight=3.0)
    fit = estimate(
        two_outputs(),
        BASELINE,
        learner=LEARNER,
        structure=structure,
        solver=SOLVER,
        output_weights="none",
    )
    phi, y = physics()
    q = np.linalg.qr(phi.reshape(-1, 2))[0]
    values = learner_values(fit)
    residual = y - phi @ fit.theta - values
    penalised = np.sum(residual**2) + 3.0 * np.sum((q.T @ values.ravel()) ** 2)
    # Along the physics, θ moved against it
    moved = values + 1e-4 * (q @ (q.T @ values.ravel())).reshape(values.shape)
    theta = np.linalg.lstsq(phi.reshape(-1, 2), (y - moved).ravel(), rcond=None)[0]
    other = np.sum((y - phi @ theta - moved) ** 2) + 3.0 * np.sum((q.T @ moved.ravel()) ** 2)
    assert penalised <= other * (1 + 1e-9)


def test_one_output_has_nothing_to_weigh():
    record = Record.from_arrays(np.linspace(-1, 1, 50), np.linspace(-1, 1, 50) ** 3)
    baseline = Baseline.from_terms([Term("a", "u[k]")])
    plain = estimate(record, baseline, learner=None)
    for choice in ("none", "std", "covariance", [7.0]):
        fit = estimate(record, baseline, learner=None, output_weights=choice)
        assert fit.theta == plain.theta and fit.std == plain.std
    assert "standard deviation" not in plain.summary()


def test_the_defect_says_in_which_inner_product():
    assert "outputs weighted by the covariance of their errors" in fitted("covariance").summary()
    assert "every output in its own unit" in fitted("none").summary()


def test_splits_and_saved_models_keep_the_inner_product(tmp_path):
    fit = fitted("covariance")
    save(fit.model, tmp_path / "model")
    again = load(tmp_path / "model")
    np.testing.assert_array_equal(again.weight, fit.problem.weight.matrix)
    measure = Uniform({"u[k]": (-1, 1)})
    one, two = (f.split(measure) for f in (fit, fitted("none")))
    assert one.defect <= 1e-12 and two.defect <= 1e-12
    assert np.abs(one.theta - two.theta).max() > 1e-6


def test_theta_and_weights_are_uncorrelated_where_errors_are_white():
    """`thm:zero_cov` for outputs that share θ needs Σ_e = σ²I, which "covariance" makes of any Σ_e."""
    largest = {}
    for choice in ("std", "covariance"):
        covariance = joint_covariance(fitted(choice).problem, fitted(choice).model)
        deviation = np.sqrt(np.diag(covariance))
        across = covariance[:2, 2:] / np.outer(
            deviation[:2], np.where(deviation[2:] > 0, deviation[2:], np.inf)
        )
        largest[choice] = np.abs(across).max()
    assert largest["covariance"] < 1e-4 < 1e-3 < largest["std"]


def test_the_free_run_takes_them_too():
    options = {"learner": None, "criterion": Simulation(0, 0), "structure": Additive()}
    thetas = [
        estimate(two_outputs(), BASELINE, output_weights=choice, **options).theta
        for choice in ("none", "std", "auto")
    ]
    for choice, theta in zip(("none", "std"), thetas, strict=False):
        matrix = weight_of(choice).matrix
        np.testing.assert_allclose(theta, weighted_least_squares(matrix), rtol=1e-6)
    assert np.abs(thetas[2] - thetas[1]).max() > 1e-4  # by the covariance of the errors


def test_turns_that_do_not_settle_are_reported():
    first, second = (estimate(two_outputs(unit), BASELINE, learner=None) for unit in (20.0, 30.0))
    last = reweight(first, lambda problem, before: second if before is first else first)
    assert [w.code for w in last.warnings] == ["output_weights_unsettled"]


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ("sdt", "`output_weights` must be one of auto, none, std, covariance; got 'sdt'"),
        ([1.0], "expected one of auto, none, std, covariance, or 2 positive weights"),
        ([1.0, 0.0], "or 2 positive weights"),
        ([1.0, np.nan], "or 2 positive weights"),
        ([True, 1.0], "or 2 positive weights"),
        (3.0, "or 2 positive weights"),
        ([1.0, 1e13], "leave the output out instead"),
    ],
)
def test_refusals(choice, message):
    with pytest.raises(InputError) as error:
        estimate(two_outputs(), BASELINE, learner=None, output_weights=choice)
    assert message in str(error.value)


def test_an_ensemble_has_no_median_of_mixed_outputs():
    with pytest.raises(InputError, match="an ensemble takes the median of each output"):
        estimate(two_outputs(), BASELINE, ensemble=True, restarts=2, output_weights="covariance")


SPEC = """[data]
train = { files = ["run.csv"] }
inputs = ["u"]
outputs = ["y1", "y2"]
sampling_time = 1.0
[[baseline.terms]]
parameter = "a"
regressor = "u[k]"
output = "y1"
[[baseline.terms]]
parameter = "a"
regressor = "40*u[k]"
output = "y2"
[learner]
kind = "none"
[training]
output_weights = WEIGHTS
"""


@pytest.mark.usefixtures("without_figures", "without_trials")
@pytest.mark.parametrize(
    ("weights", "kind"),
    [('"none"', "none"), ('"covariance"', "covariance"), ("[1, 0.01]", "given")],
)
def test_from_the_spec(tmp_path, monkeypatch, weights, kind):
    monkeypatch.chdir(tmp_path)
    experiment = two_outputs().experiments[0]
    rows = np.hstack([experiment.inputs, experiment.outputs])
    np.savetxt("run.csv", rows, delimiter=",", header="u,y1,y2", comments="")
    (tmp_path / "spec.toml").write_text(SPEC.replace("WEIGHTS", weights), encoding="utf-8")
    result = finite_json(run("fit", "spec.toml", "--json", "--out", "out").out)
    assert result["output_weights"]["kind"] == kind and len(result["output_weights"]["matrix"]) == 2


def test_a_wrong_spec_is_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    experiment = two_outputs().experiments[0]
    rows = np.hstack([experiment.inputs, experiment.outputs])
    np.savetxt("run.csv", rows, delimiter=",", header="u,y1,y2", comments="")
    (tmp_path / "spec.toml").write_text(SPEC.replace("WEIGHTS", "[1, -1]"), encoding="utf-8")
    refused = run("check", "spec.toml")
    assert (
        refused.code == 2
        and "2 positive weights" in refused.err
        and len(refused.err.splitlines()) == 1
    )
