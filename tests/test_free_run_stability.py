"""Evidence on the free run: Jacobians against differences, known poles, known divergence; the predictor apart."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from orthaug import (
    MLP,
    Baseline,
    Function,
    InputError,
    Lags,
    LevenbergMarquardt,
    Model,
    Record,
    Term,
    estimate,
    load,
    orthogonalize,
    save,
    stability,
)
from orthaug.analysis import feedback as radii
from orthaug.analysis import free_run_stability as metrics
from orthaug.analysis import lipschitz as gradients
from orthaug.analysis.feedback import feedback
from orthaug.analysis.findings import StabilityResult
from orthaug.data.regressors import stack_rows
from orthaug.models.dynamics import AutodiffDynamics, Dynamics, Parts

FEW = LevenbergMarquardt(iterations=5)


def model_of(
    terms: list[Term], theta, outputs=("y",), largest: float = 10.0, inputs=("u",)
) -> Model:
    """Physics alone with a given θ; `largest` is its largest training output."""
    rng = np.random.default_rng(0)
    y = 20 * rng.normal(size=(500, len(outputs)))
    record = Record.from_arrays(
        rng.normal(size=(500, len(inputs))), y, inputs=list(inputs), outputs=list(outputs)
    )
    model = estimate(record, Baseline.from_terms(terms), learner=None).model
    numbers = model.numbers._replace(theta=np.asarray(theta, dtype=float))
    return replace(model, numbers=numbers, largest_output=np.full(len(outputs), largest))


def driven(model: Model, u, initial: float = 0.0) -> Record:
    """The model's own response to u: what it would have been fitted to."""
    names = [c.name for c in model.outputs]
    rows = np.full((len(u), len(names)), initial)
    y = model.simulate(Record.from_arrays(u, rows, outputs=names)).model
    return Record.from_arrays(u, np.where(np.isfinite(y), y, rows), outputs=names)


def linear(poles) -> Model:
    """y_k = Σ a_i y_{k−i} + u_{k−1} with these poles."""
    a = -np.poly(poles)[1:].real
    terms = [Term(f"a{i}", f"y[k-{i + 1}]") for i in range(len(a))]
    return model_of([*terms, Term("b", "u[k-1]")], [*a, 1.0])


def content(found) -> dict:
    """What result.json tells of it."""
    return StabilityResult.model_validate(found).content()


def noise(rows: int, seed: int = 1):
    return np.random.default_rng(seed).normal(size=rows)


DUFFING = [Term("a", "y[k-1]"), Term("b", "y[k-2]"), Term("c", "y[k-1]**3"), Term("d", "u[k-1]")]
BOTH = [
    Term("a", "p[k-1]", output="p"),
    Term("b", "q[k-1]", output="p"),
    Term("c", "p[k-1]", output="q"),
    Term("d", "q[k-1]", output="q"),
    Term("e", "u[k-1]", output="q"),
]


@pytest.fixture(scope="module")
def duffing():
    """A hardening oscillator that diverges where its inputs are large, with its response to noise."""
    model = model_of(DUFFING, [1.6, -0.8, -0.05, 0.2], largest=3.0)
    return model, driven(model, noise(3000))


@pytest.fixture(scope="module")
def network():
    """Two outputs, unequal lags and a network, shortly trained."""
    rng = np.random.default_rng(3)
    u, y = rng.normal(size=150), np.zeros((150, 2))
    for k in range(3, 150):
        y[k, 0] = 0.5 * y[k - 1, 0] - 0.2 * y[k - 3, 0] + u[k - 1] + 0.3 * np.tanh(y[k - 1, 1])
        y[k, 1] = 0.3 * y[k - 1, 1] + 0.4 * np.sin(y[k - 2, 0]) + 0.1 * rng.normal()
    record = Record.from_arrays(u, y, outputs=["p", "q"])
    terms = [Term("a", "p[k-1]", output="p"), Term("b", "q[k-1]*p[k-2]", output="q")]
    lags = Lags(na=[3, 1], nb=2)
    fit = estimate(
        record,
        Baseline.from_terms(terms),
        lags=lags,
        learner=MLP((4,)),
        solver=FEW,
        regularization=1.0,
    )
    return fit.model, record


def differences(model: Model, record: Record, row: int, along) -> np.ndarray:
    """A_k (na ny, na ny) at a row of one experiment by differences of the prediction from past outputs `along`."""
    (e,), names = record.experiments, [c.name for c in record.outputs]
    n, ny, h = model.form.memory * len(names), len(names), 1e-6
    found = np.eye(n, k=-ny)  # the other past outputs move up
    for i in range(1, model.form.memory + 1):
        for j in range(len(names)):
            sides = []
            for sign in (1, -1):
                y = along.copy()
                y[row - i, j] += sign * h
                moved = Record.from_arrays(e.inputs, y, outputs=names)
                sides.append(model.predict(moved).model[row])
            found[:ny, (i - 1) * ny + j] = (sides[0] - sides[1]) / (2 * h)
    return found


def test_transitions_are_differences(network):
    model, record = network
    found = feedback(model, record)
    measured = record.experiments[0].outputs
    run = model.simulate(record).model
    past = np.where(np.isfinite(run), run, measured)
    assert found.transition.shape == (147, 6, 6) and found.steps == 147 and found.skipped == 0
    for place in (0, 1, 60, 146):
        expected = differences(model, record, int(found.points.where.row[place]), past)
        np.testing.assert_allclose(found.transition[place], expected, atol=1e-7)


def test_companion_moves_the_state(network):
    model, record = network
    found = feedback(model, record)
    whole, state, inputs = found.transition[10], found.points.states[10], found.points.inputs[10]
    a = [whole[:2, 2 * i : 2 * i + 2] for i in range(3)]
    past = np.random.default_rng(0).normal(size=(3, 2))
    expected = [sum(a[i] @ past[i] for i in range(3)), past[0], past[1]]
    np.testing.assert_allclose(whole @ past.ravel(), np.ravel(expected), atol=1e-12)
    ends = [
        model.form.step(model.numbers, state + h * past.ravel(), inputs)[0] for h in (1e-6, -1e-6)
    ]
    np.testing.assert_allclose(whole @ past.ravel(), (ends[0] - ends[1]) / 2e-6, atol=1e-7)


@pytest.mark.parametrize(
    "poles",
    [
        [0.9],
        [0.9, 0.5],
        [0.99 * np.exp(0.3j), 0.99 * np.exp(-0.3j)],
        [0.9, 0.9],
        [0.9999 * np.exp(0.01j), 0.9999 * np.exp(-0.01j)],
        [
            0.98 * np.exp(0.5j),
            0.98 * np.exp(-0.5j),
            0.9 * np.exp(1j),
            0.9 * np.exp(-1j),
            0.9,
            0.8,
            0.5,
            -0.6,
        ],
        [0.9 * np.exp(0.4j * k) for k in range(-7, 8)],
    ],
)
def test_poles_of_linear_models(poles):
    """No norm has a rate below the radius; the one that is found comes close and forgets the start as it says."""
    model = linear(poles)
    record = driven(model, noise(400))
    whole = stability(model, record)
    found, contracts = whole.feedback, whole.contraction
    radius = max(np.abs(poles))
    assert found.largest == pytest.approx(radius, abs=1e-6) and found.median == pytest.approx(
        radius, abs=1e-6
    )
    assert found.share_above_one == 0
    assert radius - 1e-6 <= contracts.rate <= radius**0.93 < 1
    assert contracts.share == 1 and contracts.bound == pytest.approx(radius, abs=1e-6)
    a, t = found.transition[0], np.linalg.cholesky(contracts.metric).T
    assert np.linalg.norm(t @ a @ np.linalg.inv(t), 2) == pytest.approx(contracts.rate, rel=1e-4)
    for steps in (1, 10, 50):
        power = np.linalg.norm(np.linalg.matrix_power(a, steps), 2)
        assert power <= 1.001 * contracts.overshoot * contracts.rate**steps


def test_a_normal_matrix_needs_no_other_norm():
    """A rotation, shrunk by 0.9: its norm is its spectral radius."""
    model = model_of(
        BOTH, [0.9 * np.cos(1), -0.9 * np.sin(1), 0.9 * np.sin(1), 0.9 * np.cos(1), 1.0], ("p", "q")
    )
    record = driven(model, noise(300))
    contracts = stability(model, record).contraction
    assert contracts.bound == pytest.approx(0.9) and 0.9 - 1e-9 <= contracts.rate < 0.905


def test_an_unstable_linear_model():
    model = linear([1.02, 0.5])
    record = driven(model, noise(60))
    found = stability(model, record)
    assert found.feedback.largest == pytest.approx(1.02) and found.feedback.share_above_one == 1
    assert found.contraction.rate >= 1.02 - 1e-6 and found.contraction.share == 0
    assert len(found.warnings) == 1
    assert (
        "radius is above 1 at 100 %" in found.warnings[0].text
        and "At 100 % of the 58" in found.text
    )


def test_a_pole_at_one_is_not_above():
    model = linear([1.0, 1.0])
    found = feedback(model, driven(model, noise(60)))
    assert found.share_above_one == 0


def test_scalar_nonlinear():
    """y = 0.9 tanh(y) + u: |A| = 0.9/cosh², at most 0.9, and its largest where y is closest to 0."""
    model = model_of([Term("a", "tanh(y[k-1])"), Term("b", "u[k-1]")], [0.9, 1.0])
    record = driven(model, noise(500))
    y = record.experiments[0].outputs[:-1, 0]
    whole = stability(model, record, box=100)
    found, contracts = whole.feedback, whole.contraction
    np.testing.assert_allclose(found.radius, 0.9 / np.cosh(y) ** 2, rtol=1e-9, atol=1e-12)
    assert found.worst.row == np.argmin(np.abs(y)) + 1
    assert found.worst.regressor["y[k-1]"] == y[found.worst.row - 1]
    assert contracts.rate == pytest.approx(0.9) and contracts.samples == 599
    assert contracts.overshoot == 1


def test_a_steep_scalar():
    """2 tanh(y) is steep near 0 only: the share of points that contract is that of |y| > arcosh √2."""
    model = model_of([Term("a", "tanh(y[k-1])"), Term("b", "u[k-1]")], [2.0, 1.0])
    record = driven(model, noise(500))
    y = record.experiments[0].outputs[:-1, 0]
    found = stability(model, record)
    expected = np.mean(np.abs(y) > np.arccosh(np.sqrt(2)))
    assert found.contraction.share == pytest.approx(expected) and 0 < expected < 1
    assert found.feedback.share_above_one == pytest.approx(1 - expected)
    assert found.contraction.rate == pytest.approx(found.feedback.largest)
    assert found.contraction.worst.row == found.feedback.worst.row
    assert found.diverges_at is None
    assert f"At {100 * (1 - expected):.3g} % of the 499 sampled points" in found.text


@pytest.mark.parametrize("n", [2, 4, 8])
def test_one_metric_for_several_matrices(n):
    """Switching between matrices that share a norm by construction: S⁻¹ A S with ‖A‖ = 0.95."""
    rng = np.random.default_rng(4)
    turns = [np.linalg.qr(rng.normal(size=(n, n)))[0] for _ in range(2)]
    s = turns[0] @ np.diag(np.geomspace(1, 30, n)) @ turns[1]
    a = rng.normal(size=(300, n, n))
    a = np.linalg.inv(s) @ (0.95 * a / np.linalg.norm(a, 2, axis=(1, 2))[:, None, None]) @ s
    assert np.linalg.norm(a, 2, axis=(1, 2)).max() > 3
    assert metrics._sizes(metrics._best_metric(a), a).max() < 0.97


def test_the_least_rate_of_two_states():
    """Against a search over all norms of two states, P = [[1, b], [b, c]], from many starts."""
    a = np.zeros((200, 2, 2))
    a[:, 0, 0], a[:, 0, 1], a[:, 1, 0] = np.random.default_rng(7).uniform(1.2, 1.6, 200), -0.8, 1.0

    def rate(v):
        return metrics._sizes(np.array([[1.0, v[0]], [0.0, np.exp(v[1])]]), a).max()

    starts = [(b, c) for b in (-1.5, -0.5, 0.5) for c in (-2.0, -1.0, 0.0)]
    least = min(minimize(rate, start, method="Nelder-Mead").fun for start in starts)
    assert least - 1e-6 <= metrics._sizes(metrics._metric(a), a).max() <= 1.01 * least


def test_some_matrices_that_cannot_contract_do_not_spoil_the_rest():
    rng = np.random.default_rng(5)
    s = np.diag([1.0, 4.0, 20.0])
    a = rng.normal(size=(400, 3, 3))
    a = 0.9 * a / np.linalg.norm(a, 2, axis=(1, 2))[:, None, None]
    a[:8] *= 3.0
    a = np.linalg.inv(s) @ a @ s
    unstable = np.mean(np.abs(np.linalg.eigvals(a)).max(axis=1) > 1)
    assert np.mean(metrics._sizes(metrics._best_metric(a), a) < 1) >= 0.98 and unstable > 0


def test_slope_of_the_search():
    rng = np.random.default_rng(6)
    a = rng.normal(size=(20, 3, 3))
    before = np.log(np.linalg.norm(a, 2, axis=(1, 2)).max())
    y = metrics._descend(a, 20.0)
    assert np.log(metrics._sizes(y, a).max()) < before


def test_duffing_diverges_at_a_known_factor(duffing):
    model, record = duffing
    factor = stability(model, record).diverges_at
    (e,) = record.experiments
    mean = e.inputs.mean()

    def diverges(s):
        scaled = Record.from_arrays(mean + s * (e.inputs - mean), e.outputs)
        return model.simulate(scaled).trajectories[0].diverged is not None

    assert diverges(factor) and not diverges(factor / 1.05)
    assert 1.5 < factor < 10
    assert stability(model, record, largest=1.2).diverges_at is None


def test_a_threshold_that_is_known():
    """y = 0.5 y + 10 max(y − 10, 0) + u settles at 2 u up to 10; u = 3 ± 1 may be scaled to 3 ± 2, and no farther."""
    model = model_of(
        [Term("c", "y[k-1]"), Term("a", "max(y[k-1] - 10, 0)"), Term("b", "u[k-1]")],
        [0.5, 10.0, 1.0],
    )
    u = 3 + np.tile(np.repeat([1.0, -1.0], 50), 4)
    assert 2 < stability(model, driven(model, u)).diverges_at <= 2.1


def test_a_root_of_a_negative_number_is_no_growth():
    """A level y = y − 0.2 √(y + 100) + u, u = 1 ± 0.5, ends at −100 where u is scaled to below 0."""
    model = model_of(
        [Term("a", "y[k-1]"), Term("c", "sqrt(y[k-1] + 100)"), Term("b", "u[k-1]")],
        [1.0, -0.2, 1.0],
        largest=100.0,
    )
    u = 1 + np.tile(np.repeat([0.5, -0.5], 50), 4)
    found = stability(model, driven(model, u, -75.0))
    assert 2 < found.diverges_at < 8
    assert "meets a term that has no value" in found.text and "max(x, 0)" in found.text
    assert "a million times" not in found.text


def test_a_model_without_inputs_has_none_to_scale():
    """y[k] = a y[k-1] decays or explodes from where it starts."""
    for a, says in (
        (0.5, "remains bounded; it has no inputs"),
        (3.0, "diverges without inputs"),
    ):
        model = model_of([Term("a", "y[k-1]")], [a], inputs=[])
        found = stability(model, Record.from_arrays(None, np.ones(60)))
        assert says in found.text and "deviations from their means" not in found.text
        assert ("small_margin" in dict(found.warnings)) == (a > 1)


def test_small_margin_warns(duffing):
    model, record = duffing
    factor = stability(model, record).diverges_at
    (e,) = record.experiments
    hot = Record.from_arrays((e.inputs - e.inputs.mean()) * factor / 1.3, e.outputs)
    found = stability(model, hot)
    assert 1 < found.diverges_at < 1.5
    assert "exceeds the training outputs a million times" in dict(found.warnings)["small_margin"]


def test_a_run_that_diverges(duffing):
    model, record = duffing
    (e,) = record.experiments
    wild = Record.from_arrays(20 * e.inputs, e.outputs)
    (trajectory,) = model.simulate(wild).trajectories
    row = trajectory.diverged[0]
    found = stability(model, wild)
    assert found.feedback.steps == row - 2 + 1 and found.feedback.points.where.row[-1] == row
    assert found.feedback.diverged == (f"y at experiment 0, row {row}",)
    assert 0 < found.diverges_at < 1
    assert found.text.count("diverges") == 1 and f"row {row}" in found.warnings[0].text
    json.dumps(content(found), allow_nan=False)


def test_a_run_that_overflows():
    """Squares leave double precision within a few steps, and with the input at rest too."""
    model = model_of([Term("a", "y[k-1]**2")], [1.0], largest=1.0)
    record = Record.from_arrays(np.zeros(40), np.full(40, 10.0))
    found = stability(model, record)
    assert found.diverges_at == 0.0 and found.feedback.steps == 3
    np.testing.assert_allclose(found.feedback.radius, [20.0, 200.0, 20000.0])
    json.dumps(content(found), allow_nan=False)


def test_without_feedback():
    model = model_of([Term("a", "sin(u[k])"), Term("b", "u[k-2]")], [1.0, 2.0])
    record = Record.from_arrays(noise(50), noise(50, 2))
    found = stability(model, record)
    assert found.feedback is None and found.contraction is None and found.diverges_at is None
    assert (
        "uses no past outputs: its free run cannot diverge" in found.text and found.warnings == ()
    )
    assert found.lipschitz.gradient == pytest.approx(np.hypot(1, 2), rel=1e-2)
    json.dumps(content(found), allow_nan=False)


def test_two_experiments(duffing):
    model, record = duffing
    (e,) = record.experiments
    quiet = Record.from_arrays(0.01 * e.inputs[:100], 0.01 * e.outputs[:100])
    both = Record.join([quiet, record])
    found, alone = feedback(model, both), feedback(model, record)
    assert found.steps == 98 + 2998
    np.testing.assert_array_equal(found.transition[98:], alone.transition)
    np.testing.assert_array_equal(found.points.where.experiment, np.repeat([0, 1], [98, 2998]))
    worst = stability(model, both).contraction.worst
    assert worst.experiment == 1 and worst.where == f"experiment 1, row {worst.row}"
    wild = Record.join([record, Record.from_arrays(20 * e.inputs, e.outputs)])
    assert feedback(model, wild).diverged[0].startswith("y at experiment 1, row ")


def test_samples_are_bounded_and_the_same(duffing, monkeypatch):
    model, record = duffing
    first, again = (stability(model, record, box=50).contraction for _ in range(2))
    assert first.rate == again.rate and (first.metric == again.metric).all()
    assert 2000 <= first.samples <= 2050
    monkeypatch.setattr(radii, "MOST_STEPS", 500)
    found = feedback(model, record)
    assert len(found.radius) == 500 and found.steps == 2998
    assert found.points.where.row[0] == 2 and found.points.where.row[-1] == 2999


def test_a_long_past_is_not_looked_at():
    model = model_of([Term("a", "y[k-201]"), Term("b", "u[k-1]")], [0.5, 1.0])
    record = Record.from_arrays(noise(300), noise(300, 2))
    with pytest.raises(InputError, match="too few"):
        stability(model, Record.from_arrays(noise(100), noise(100)))
    found = stability(model, record)
    assert (
        found.contraction is None and found.feedback.largest is None and found.feedback.skipped == 0
    )
    assert "more than 200 past outputs" in dict(found.warnings)["contraction_not_checked"]
    json.dumps(content(found), allow_nan=False)


def test_points_without_a_derivative():
    """√|y| has none at y = 0, where this run stays for its first steps."""
    model = model_of([Term("a", "sqrt(abs(y[k-1]))"), Term("b", "u[k-1]")], [0.1, 1.0])
    u = np.concatenate([np.zeros(5), 2 + 0.1 * noise(100)])
    found = stability(model, driven(model, u))
    assert found.feedback.skipped == 6 and len(found.feedback.radius) == 98
    assert "no finite derivative" in dict(found.warnings)["derivative_not_finite"]
    json.dumps(content(found), allow_nan=False)


def test_lipschitz_of_known_gradients():
    """g = a y₁ y₂ + b u: ∂g/∂x = (a y₂, a y₁, b); ∂φ/∂x = [[y₂, y₁, 0], [0, 0, 1]]."""
    model = model_of([Term("a", "y[k-1]*y[k-2]"), Term("b", "u[k-1]")], [0.5, 3.0])
    u, y = noise(200), 5 * noise(200, 2)
    found = stability(model, Record.from_arrays(u, y)).lipschitz
    y1, y2, u1 = y[1:-1], y[:-2], u[1:-1]
    size = np.sqrt(0.25 * (y1**2 + y2**2) + 9)
    assert found.gradient == pytest.approx(size.max()) and found.rows == 198
    scaled = (
        np.sqrt(0.25 * ((y2 * y1.std()) ** 2 + (y1 * y2.std()) ** 2) + (3 * u1.std()) ** 2)
        / y.std()
    )
    assert (
        found.gradient_scaled == pytest.approx(scaled.max())
        and found.worst.row == scaled.argmax() + 2
    )
    assert found.phi == pytest.approx(np.sqrt(y1**2 + y2**2 + 1).max())
    rms = [np.sqrt(np.mean((y1 * y2) ** 2)), np.sqrt(np.mean(u1**2))]
    phi = np.sqrt(
        ((y2 * y1.std()) ** 2 + (y1 * y2.std()) ** 2) / rms[0] ** 2 + (u1.std() / rms[1]) ** 2
    )
    assert found.phi_scaled == pytest.approx(phi.max()) and found.phi_worst.row == phi.argmax() + 2


def test_lipschitz_of_the_weights_of_a_known_learner(monkeypatch):
    """f = w₁ z₁ z₂ + w₂ z₁²: ∂²f/∂w∂z = [[z₂, z₁], [2 z₁, 0]], z scaled and f in its unit."""
    learner = Function(
        lambda w, z: w[:1] * z[0] * z[1] + w[1:] * z[0] ** 2,
        lambda key: jnp.zeros(2),
        ("u[k]", "u[k-1]"),
    )
    u, y = 1 + 0.5 * noise(200), 3 * noise(200, 2)
    record = Record.from_arrays(u, y)
    model = estimate(
        record, Baseline.from_terms([Term("a", "u[k]")]), learner=learner, solver=FEW
    ).model
    numbers, x = model.numbers, np.stack([u[1:], u[:-1]], axis=1)
    z = (x - numbers.centre) / numbers.halfwidth
    columns = [
        z[:, 1] ** 2 + 4 * z[:, 0] ** 2,
        z[:, 0] ** 2,
    ]  # Σ over the weights, for each entry of x
    squares = np.stack(columns, axis=1) * (numbers.gain / numbers.halfwidth) ** 2
    found = stability(model, record).lipschitz
    assert (
        found.weights == pytest.approx(np.sqrt(squares.sum(axis=1)).max())
        and found.weights_rows == 199
    )
    scaled = np.sqrt((squares * x.std(axis=0) ** 2).sum(axis=1)) / y.std()
    assert (
        found.weights_scaled == pytest.approx(scaled.max())
        and found.weights_worst.row == scaled.argmax() + 1
    )
    monkeypatch.setattr(gradients, "_MOST_CELLS", 4 * 50)
    few, some = stability(model, record).lipschitz, np.linspace(0, 198, 50).round().astype(int)
    assert few.weights_rows == 50 and few.weights == pytest.approx(
        np.sqrt(squares[some].sum(axis=1)).max()
    )
    assert few.weights_worst.row == some[scaled[some].argmax()] + 1 and few.rows == 199


def test_lipschitz_of_the_weights_of_a_network(network):
    """Two outputs and a network: the largest over rows of what JAX differentiates one row at a time."""
    model, record = network
    x, form, numbers = stack_rows(record, model.form.layout).x, model.form, model.numbers

    def size(row):
        slope = jax.jacfwd(lambda w, x: form.at(numbers._replace(weights=w), x).total)
        return jnp.linalg.norm(jax.jacfwd(slope, 1)(numbers.weights, row).ravel())

    assert stability(model, record).lipschitz.weights == pytest.approx(
        float(jax.jit(jax.vmap(size))(x).max())
    )


def test_lipschitz_of_no_weights(duffing):
    """Physics alone, and a learner from elsewhere, have none."""
    model, record = duffing
    split = orthogonalize(
        record, Baseline.from_terms([DUFFING[0]]), lambda x: x[:, 0], lags=Lags(na=2, nb=1)
    ).model
    for one in (model, split):
        found = stability(one, record.rows(None, 300)).lipschitz
        assert (found.weights, found.weights_scaled, found.weights_worst, found.weights_rows) == (
            None,
            None,
            None,
            0,
        )
        assert found.gradient > 0 and found.rows == 298


def test_lipschitz_says_nothing_about_the_free_run():
    """y_k = 2 y_{k−1} has a bounded gradient, and its free run diverges."""
    model = model_of([Term("a", "y[k-1]")], [2.0])
    record = Record.from_arrays(noise(100), noise(100))
    found = stability(model, record)
    assert found.lipschitz.gradient == pytest.approx(2) and found.feedback.diverged
    assert "the free run is judged apart from that" in found.text


def test_scales_do_not_depend_on_units(duffing):
    """Output and input in thousandths: radii, rate, share and the scaled gradient stay."""
    model, record = duffing
    (e,) = record.experiments
    small = model_of(DUFFING, [1.6, -0.8, -0.05e6, 0.2], largest=3e-3)
    other = Record.from_arrays(1e-3 * e.inputs, 1e-3 * e.outputs)
    one, two = stability(model, record), stability(small, other)
    assert two.feedback.largest == pytest.approx(one.feedback.largest)
    assert two.contraction.share == pytest.approx(one.contraction.share, abs=0.02)
    assert two.diverges_at == pytest.approx(one.diverges_at)
    assert two.lipschitz.gradient_scaled == pytest.approx(one.lipschitz.gradient_scaled)
    assert two.lipschitz.phi_scaled == pytest.approx(one.lipschitz.phi_scaled)


def test_a_model_from_elsewhere_by_differences(duffing):
    """The same oscillator as a plain function that JAX cannot differentiate."""
    model, record = duffing

    def outside(x):
        return 1.6 * x[:, 0] - 0.8 * x[:, 1] - 0.05 * x[:, 0] ** 3 + 0.2 * x[:, 2]

    split = orthogonalize(
        record, Baseline.from_terms([DUFFING[0]]), outside, lags=Lags(na=2, nb=1)
    ).model
    short = record.rows(None, 300)
    found, expected = feedback(split, short), feedback(model, short)
    np.testing.assert_allclose(found.transition, expected.transition, atol=1e-5)


def test_saved_and_loaded(network, tmp_path):
    model, record = network
    save(model, tmp_path / "model")
    before, after = stability(model, record), stability(load(tmp_path / "model"), record)
    assert content(before) == content(after) and before.text == after.text


def test_the_result_is_plain(network):
    model, record = network
    found = stability(model, record)
    plain = json.loads(json.dumps(content(found), allow_nan=False))
    assert plain == content(found)
    assert (
        plain["feedback"]["largest"] == found.feedback.largest
        and "transition" not in plain["feedback"]
    )
    assert np.shape(plain["contraction"]["metric"]) == (6, 6)
    assert set(plain["lipschitz"]["worst"]["regressor"]) == {str(lag) for lag in model.form.layout}


def test_what_exists_is_not_computed_again(network, monkeypatch):
    model, record = network
    plain, response = stability(model, record), model.simulate(record)
    x = stack_rows(record, model.form.layout).x
    for verb in ("predict", "simulate"):
        monkeypatch.setattr(Model, verb, lambda *_: pytest.fail("computed again"))
    assert content(stability(model, record, response=response, x=x)) == content(plain)


@pytest.mark.parametrize("scale", [0.01, 0.5, 1.0, 3.0, 20.0, 1e3])
def test_the_search_tries_the_factors_of_a_plain_one(duffing, scale):
    """Doubling and bisecting one free run at a time, as the docstring says it, comes to the same number."""
    model, record = duffing
    (e,) = record.experiments
    record = Record.join(
        [Record.from_arrays(scale * e.inputs[k:], e.outputs[k:]) for k in (0, 2500)]
    )
    mean = np.concatenate([e.inputs for e in record.experiments]).mean(axis=0)

    def diverges(factor):
        scaled = [replace(e, inputs=mean + factor * (e.inputs - mean)) for e in record.experiments]
        return any(
            t.diverged
            for t in model.simulate(replace(record, experiments=tuple(scaled))).trajectories
        )

    low = high = 1.0
    while diverges(low):
        low, high = low / 2, low
    while not diverges(high):
        low, high = high, 2 * high
    while high > 1.05 * low:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if diverges(middle) else (middle, high)
    assert stability(model, record).diverges_at == high


def test_channels_by_name(network):
    model, record = network
    (e,) = record.experiments
    turned = Record.from_arrays(e.inputs, e.outputs[:, ::-1], outputs=["q", "p"])
    assert content(stability(model, turned)) == content(stability(model, record))


@dataclass(frozen=True)
class Oscillator(AutodiffDynamics):
    """x⁺ = A x + (0, u), y = x₁ + x₂³ of a state that nobody measures: no past outputs anywhere."""

    a: tuple[tuple[float, ...], ...]
    outputs: tuple[str, ...] = ("y",)
    linear: bool = False
    first_row: int = 0
    states: int = 2
    unknowns: int = 0
    memory: int = 0

    def start(self, outputs, rows):
        return np.ones((len(rows), 2))

    def start_rows(self, weight):
        return np.zeros((2, 2))

    def inputs(self, experiment, record):
        return experiment.inputs

    def describe(self, state, inputs):
        return {"x1": float(state[0]), "x2": float(state[1]), "u": float(inputs[0])}

    def step(self, numbers, state, inputs):
        y = state[:1] + state[1:] ** 3
        return jnp.asarray(self.a) @ state + jnp.append(jnp.zeros(1), inputs), Parts(
            y, 0 * y, 0 * y
        )


def oscillating(radius: float) -> tuple[Model, np.ndarray]:
    """A slow oscillation of this spectral radius as a model, seen through a lens that spoils its normality; and A."""
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    a = np.diag([1.0, 5.0]) @ (radius * turn) @ np.diag([1.0, 0.2])
    model = model_of([Term("a", "y[k-1]"), Term("b", "u[k-1]")], [0.5, 1.0], largest=1.0)
    return replace(model, form=Oscillator(tuple(map(tuple, a)))), a


def visited_states(a, u) -> np.ndarray:
    x = [np.ones(2)]
    for value in u[:-1]:
        x.append(a @ x[-1] + [0.0, value])
    return np.array(x)


def test_a_state_that_is_no_past_output():
    """Radius, contraction and growth of a linear state space, whose states are those that its steps come to."""
    model, a = oscillating(0.9)
    u = 0.1 * noise(400)
    record = Record.from_arrays(u, noise(400, 2))
    assert isinstance(model.form, Dynamics)
    whole = stability(model, record, box=50)
    found, contracts = whole.feedback, whole.contraction
    x = visited_states(a, u)
    np.testing.assert_allclose(found.points.states, x, atol=1e-12)
    np.testing.assert_array_equal(found.points.inputs, u[:, None])
    np.testing.assert_allclose(found.transition, np.broadcast_to(a, (400, 2, 2)), atol=1e-12)
    np.testing.assert_allclose(found.unit, x.std(axis=0), rtol=1e-9)
    assert found.largest == pytest.approx(0.9) and found.steps == 400 and found.diverged == ()
    row = found.worst.row
    assert found.worst.regressor == pytest.approx({"x1": x[row, 0], "x2": x[row, 1], "u": u[row]})
    assert np.linalg.norm(a, 2) > 1 and 0.9 - 1e-9 <= contracts.rate < 0.91
    assert contracts.share == 1 and contracts.samples == 450
    again = feedback(model, record, response=model.simulate(record))
    np.testing.assert_array_equal(again.points.states, found.points.states)
    whole = stability(model, record)
    assert whole.lipschitz is None and whole.warnings == () and "one-step" not in whole.text
    assert plainly(whole) == content(whole)


def test_a_state_that_is_no_past_output_grows_as_its_inputs():
    """y is of third degree in the inputs: it reaches 10⁶ times the largest at a factor known from a plain loop."""
    model, a = oscillating(0.9)
    u = 0.1 * noise(400)
    factor = stability(model, Record.from_arrays(u, noise(400, 2))).diverges_at

    def peak(s):
        x = visited_states(a, u.mean() + s * (u - u.mean()))
        return np.abs(x[:, 0] + x[:, 1] ** 3).max()

    assert peak(factor) > 1e6 >= peak(factor / 1.05)


def test_a_state_that_is_no_past_output_diverges():
    model, _ = oscillating(1.3)
    record = Record.from_arrays(0.1 * noise(400), noise(400, 2))
    found = stability(model, record)
    row = model.simulate(record).trajectories[0].diverged[0]
    assert (
        found.feedback.diverged == (f"y at experiment 0, row {row}",)
        and found.feedback.steps == row + 1 < 100
    )
    assert found.feedback.largest == pytest.approx(1.3) and found.contraction.rate >= 1.3 - 1e-9
    assert found.diverges_at == 0.0


def test_a_state_by_differences():
    """The same step told to have no derivative."""
    model, a = oscillating(0.9)
    blunt = replace(model, form=Blunt(model.form.a))
    found = feedback(blunt, Record.from_arrays(noise(300), noise(300, 2)))
    np.testing.assert_allclose(found.transition, np.broadcast_to(a, (300, 2, 2)), atol=1e-9)


class Blunt(Oscillator):
    differentiable = False


def plainly(found) -> dict:
    return json.loads(json.dumps(content(found), allow_nan=False))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"box": -1}, "`box` must be a whole number, 0 or more; got -1"),
        ({"largest": 1.0}, "`largest` must be a factor above 1 and at most 10000; got 1.0"),
        ({"largest": 1e5}, "`largest` must be a factor above 1"),
        ({"largest": float("nan")}, "`largest` must be a positive number"),
    ],
)
def test_arguments_refused(duffing, arguments, message):
    with pytest.raises(InputError, match=message):
        stability(*duffing, **arguments)


def test_records_refused(duffing):
    model, record = duffing
    with pytest.raises(InputError, match="lacks the output y"):
        stability(model, Record.from_arrays(noise(50)))
    with pytest.raises(
        InputError,
        match=r"`x` has shape \(2998, 2\); the usable regressors of the record have \(2998, 3",
    ):
        stability(model, record, x=stack_rows(record, model.form.layout).x[:, :2])
