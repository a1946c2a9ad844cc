"""Bias by unmodelled terms against regressions that it must explain exactly, and certificates against theory."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from orthaug import InputError, RankError, Record, Suspect, estimate, synthetic
from orthaug.analysis.bias import TermResponse, bias_table
from orthaug.analysis.measure_bias import LaggedTerms
from orthaug.analysis.suspects import data_width, suspect_columns
from orthaug.inference.linearization import Certificate, Linearization, find_certificate
from orthaug.inference.measures import Samples, weigh_problem
from orthaug.physics.output_weights import times
from orthaug.physics.projection import Projection

TS = {"Ts": 0.01}
VELOCITY = "(position[k-1] - position[k-2])/Ts"
SYSTEM = synthetic.MassSpringDamper()
THETA = SYSTEM.paper_theta()
FRICTION = Suspect(
    "friction",
    f"sign({VELOCITY})*(coulomb + (static - coulomb)*exp(-abs({VELOCITY})/vs))",
    coefficient=-THETA[2],
    constants={**TS, "coulomb": SYSTEM.coulomb, "static": SYSTEM.static, "vs": SYSTEM.stribeck},
)
ANY = Suspect("any", "1")


@pytest.fixture(scope="module")
def machine():
    """The problem of the paper's record."""
    example = synthetic.mass_spring_damper()
    return estimate(example.train, example.baseline, learner=None).problem


class ArrayTerms:
    """Terms that are given by their rows (M, ny): the smallest physics that a table is made of."""

    physical, certifies = None, True

    def __init__(self, projection, names, deltas, gain, theta=None, learned=None, physical=None):
        learner = None if learned is None else times(gain, learned)
        self.linearization = Linearization(projection, None, learner)
        self.names, self.deltas, self.gain = tuple(names), deltas, gain
        self.value = np.ones(len(self.names)) if theta is None else theta
        self.slopes = np.ones(len(self.names))
        if physical is not None:
            self.physical = physical, np.ones(len(physical))

    def equation(self, suspect):
        return None

    def values(self, suspect):
        return times(self.gain, self.deltas[suspect.name])

    def respond(self, suspects, *, run):
        rows = map(self.values, suspects)
        return [TermResponse(np.zeros(len(self.names)), each, None, each) for each in rows]

    def expected_shifts(self, bias):
        return None


def table_of(projection, names, suspects, deltas, gain=None, certify=True, **more) -> Any:
    """The table of terms with values (ns, N, ny)."""
    gain = np.eye(np.shape(deltas)[2]) if gain is None else gain
    named = {one.name: rows for one, rows in zip(suspects, deltas, strict=True)}
    physics: Any = ArrayTerms(projection, names, named, gain, **more)
    return bias_table(physics, suspects, certify=certify)


def table(problem, suspects, **more) -> Any:
    """The table on the training rows of a problem."""
    deltas = suspect_columns(suspects, problem.rows.x, problem.layout, problem.outputs)
    names, gain = problem.baseline.names, problem.weight.matrix
    return table_of(problem.projection, names, suspects, deltas, gain, **more)


def single(phi, delta) -> Any:
    """Certificate of one output's columns."""
    return find_certificate(
        Projection.factor(np.stack(phi, axis=1)[:, None]), np.asarray(delta)[:, None]
    )


def simulated(noise=None, friction=True):
    """The paper's training record with or without noise and friction, and the rows that it gives."""
    example = synthetic.mass_spring_damper()
    force = example.train.experiments[0].inputs[:, 0]
    system = SYSTEM if friction else synthetic.MassSpringDamper(coulomb=0.0, static=0.0)
    record = Record.from_arrays(
        force,
        system.simulate(force, THETA, noise),
        sampling_time=0.01,
        inputs=["force"],
        outputs=["position"],
    )
    return estimate(record, example.baseline, learner=None).problem


def paper_noise():
    """The noise of the paper's record: its generator draws the force first."""
    rng = np.random.RandomState(12345)
    rng.normal(0.0, 100.0, 5000)
    return rng.normal(scale=0.00018, size=9998)


def test_friction_explains_the_whole_error_without_noise():
    problem = simulated()
    (found,) = table(problem, [FRICTION])
    error = problem.projection.solve(problem.whitened_target) - THETA
    np.testing.assert_allclose(found.expected, error, rtol=1e-7)
    assert np.abs(error / THETA).max() > 0.009  # there is something to explain
    without = simulated(friction=False)
    np.testing.assert_allclose(without.projection.solve(without.whitened_target), THETA, rtol=1e-10)


def test_friction_and_noise_explain_the_whole_error(machine):
    """θ̂ = θ* + Φ⁺(Δ + e) with Φ of the run with friction: the noise's part is subtracted, not estimated."""
    (found,) = table(machine, [FRICTION])
    theta = machine.projection.solve(machine.whitened_target)
    by_noise = machine.projection.solve(paper_noise()[:, None] / machine.deviation)
    np.testing.assert_allclose(found.expected, theta - THETA - by_noise, rtol=1e-6)
    # The same regression with friction's force put back into the target, noise untouched.
    delta = FRICTION.values(machine.rows.x, machine.layout, machine.outputs) * -THETA[2]
    without = machine.projection.solve((machine.target - delta) / machine.deviation)
    np.testing.assert_allclose(found.expected, theta - without, rtol=1e-9)


def test_the_error_of_the_papers_data_set_3_is_predicted():
    example = synthetic.static(3)
    problem = estimate(example.train, example.baseline, learner=None).problem
    (found,) = table(problem, [Suspect("rest", "0.01 - 0.5*u[k]**2", coefficient=1.0)])
    assert np.linalg.norm(found.expected) == pytest.approx(0.1433, abs=1e-4)
    np.testing.assert_allclose(
        found.bias, problem.projection.solve(problem.whitened_target) - example.theta, rtol=1e-9
    )


def test_an_even_term_biases_nothing_under_a_symmetric_measure():
    example = synthetic.static(1)
    problem = estimate(example.train, example.baseline, learner=None).problem
    (found,) = table(problem, [Suspect("square", "u[k]**2")])
    assert np.abs(found.bias).max() < 1e-14 and found.cosine < 1e-14
    assert found.certificate == Certificate("removable")


def test_weights_and_whitening_enter_through_gain():
    rng = np.random.default_rng(3)
    phi, delta = rng.normal(size=(40, 2, 3)), rng.normal(size=(1, 40, 2))
    gain = np.array([1.0, 20.0]) * np.sqrt(rng.uniform(size=(40, 1)))
    each = gain[..., None] * np.eye(2)
    projection = Projection.factor(phi * gain[..., None])
    (found,) = table_of(projection, "abc", [ANY], delta, gain=each, certify=False)
    stacked, target = (phi * gain[..., None]).reshape(80, 3), (delta[0] * gain).reshape(80)
    theta = np.linalg.lstsq(stacked, target, rcond=None)[0]
    np.testing.assert_allclose(found.bias, theta, rtol=1e-12)
    assert found.cosine == pytest.approx(
        np.linalg.norm(stacked @ theta) / np.linalg.norm(target), rel=1e-12
    )


def test_relative_physical_and_expected():
    rng = np.random.default_rng(4)
    projection, delta = Projection.factor(rng.normal(size=(30, 1, 2))), rng.normal(size=(1, 30, 1))
    jacobian = np.array([[1.0, 2.0], [0.0, -3.0]])
    physical: dict[str, Any] = dict(zip(("mass", "spring"), jacobian, strict=True))
    suspects = [Suspect("s", "1", coefficient=-2.0)]
    found: Any
    (found,) = table_of(
        projection, ["a", "b"], suspects, delta, theta=np.array([0.0, 5.0]), physical=physical
    )
    bias = np.array(found.bias)
    assert found.relative == (None, bias[1] / 5.0)
    np.testing.assert_allclose(found.expected, -2.0 * bias)
    assert [name for name, _ in found.physical] == ["mass", "spring"]
    np.testing.assert_allclose([value for _, value in found.physical], jacobian @ bias)


def test_what_of_the_learner_a_suspect_explains(machine):
    suspects = [
        FRICTION,
        Suspect.of("cubic", "force[k-1]"),
        Suspect.of("expression", "position[k-1]"),
    ]
    drag, cubic, _ = suspect_columns(suspects, machine.rows.x, machine.layout, machine.outputs)
    by_drag, by_cubic, in_span = table(machine, suspects, learned=-3.0 * drag, certify=False)
    assert by_drag.explained == pytest.approx(
        1.0, abs=1e-12
    ) and by_drag.coefficient_found == pytest.approx(-3.0)
    assert by_cubic.explained < 0.01
    assert (in_span.explained, in_span.coefficient_found) == (
        None,
        None,
    ) and in_span.cosine == pytest.approx(1.0)
    (mixed,) = table(machine, [FRICTION], learned=-3.0 * drag + 1e-7 * cubic, certify=False)
    rest = machine.projection.orthogonal_part
    f, d = rest((-3.0 * drag + 1e-7 * cubic) / machine.deviation), rest(drag / machine.deviation)
    assert mixed.explained == pytest.approx(
        np.vdot(f, d) ** 2 / np.vdot(f, f) / np.vdot(d, d), rel=1e-10
    )
    assert mixed.coefficient_found == pytest.approx(np.vdot(f, d) / np.vdot(d, d), rel=1e-10)
    (nothing,) = table(machine, [FRICTION], learned=np.zeros_like(drag), certify=False)
    assert nothing.explained is None


V = np.linspace(-1.0, 1.0, 201)


@pytest.mark.parametrize(
    ("delta", "verdict"),
    [
        (np.sign(V), "unremovable"),
        (V**3, "unremovable"),
        (-(V**3), "unremovable"),
        (V * np.abs(V), "unremovable"),
        (V - np.clip(V, -0.5, 0.5), "unremovable"),
        (V**2, "removable"),
        (np.ones(201), "removable"),
        (V**3 - 0.25 * V, "removable"),
        (np.zeros(201), "orthogonal"),
        (1e-200 * V**3, "unremovable"),
    ],
)
def test_certificates_of_one_parameter(delta, verdict):
    found = single([V], delta)
    assert found.verdict == verdict
    if verdict == "unremovable":
        product = V * found.direction[0] * delta
        assert product.min() >= 0
        assert found.positive == np.mean(np.abs(product) > 1e-12 * product.max())
        assert found.shares == (np.sign(found.direction[0]),)
        assert found.cosine == pytest.approx(abs(np.corrcoef(V, delta / np.abs(delta).max())[0, 1]))


def test_a_positive_range_makes_an_even_term_unremovable():
    assert single([V + 2], (V + 2) ** 2).verdict == "unremovable"


def test_unknown_sign_is_found_in_a_combination_of_parameters():
    """δ = sign(φ₁ − 3φ₂): the certificate is the velocity of sorts, whatever the units."""
    rng = np.random.default_rng(5)
    x = rng.normal(size=(20_000, 4))
    delta = np.sign(x[:, 0] - 3 * x[:, 1])
    found = single((x * [1.0, 1e6, 1e-6, 1.0]).T, delta)
    assert found.verdict == "unremovable"
    np.testing.assert_allclose(
        np.array(found.shares) * found.shares[1], [-1 / 3, 1, 0, 0], atol=2e-3
    )
    direction = np.array(found.direction)
    assert np.min((x * [1.0, 1e6, 1e-6, 1.0]) @ direction * delta) > -1e-8
    assert np.sqrt(np.mean(((x * [1.0, 1e6, 1e-6, 1.0]) @ direction) ** 2)) == pytest.approx(1.0)


@pytest.mark.parametrize("nearly", [1.0, 1e-4])
def test_a_hundred_thousand_rows(nearly):
    """Also where two columns almost agree, as positions do at a fast sampling rate."""
    x = np.random.default_rng(6).normal(size=(100_000, 6))
    x[:, 1] = x[:, 0] + nearly * x[:, 1]
    sign = np.sign(x[:, 1] - x[:, 0])
    assert single(x.T, sign).verdict == "unremovable"
    sign[777] *= -1  # one row of the other sign is enough for a measure, a very uneven one
    assert single(x.T, sign).verdict == "removable"
    assert single(x.T, x[:, 3] ** 2).verdict == "removable"


def test_a_numerical_failure_is_a_verdict(monkeypatch):
    monkeypatch.setattr("scipy.optimize.linprog", lambda *_, **__: SimpleNamespace(x=None))
    assert single([V], V**3).verdict == "undecided"
    # A program that keeps returning a direction that its own rows forbid must not go on for ever.
    monkeypatch.setattr("scipy.optimize.linprog", lambda *_, **__: SimpleNamespace(x=np.ones(1)))
    assert single([V], V**3 - 0.25 * V).verdict == "undecided"


def test_removable_means_that_such_weights_exist():
    """Stiemke's lemma, by the dual linear program: weights of 1 or more on every point with Σ μ φᵀδ = 0."""
    from scipy.optimize import linprog

    rng = np.random.default_rng(7)
    for trial in range(20):
        x = rng.normal(size=(12, 3))
        delta = rng.normal(size=12) if trial % 2 else np.sign(x[:, 0] + 0.3 * rng.normal(size=12))
        weights = linprog(
            np.ones(12), A_eq=(x * delta[:, None]).T, b_eq=np.zeros(3), bounds=(1, None)
        )
        assert single(x.T, delta).verdict == ("removable" if weights.status == 0 else "unremovable")


def test_rows_of_several_outputs_count_together():
    """One θ in two outputs: what one output adds the other can take away."""
    phi = np.stack([V, V], axis=1)[..., None]
    assert (
        find_certificate(Projection.factor(phi), np.stack([V**3, 0 * V], axis=1)).verdict
        == "unremovable"
    )
    assert (
        find_certificate(Projection.factor(phi), np.stack([V**3, -(V**3)], axis=1)).verdict
        == "orthogonal"
    )
    assert (
        find_certificate(Projection.factor(phi), np.stack([V**3, -0.5 * V], axis=1)).verdict
        == "removable"
    )


def test_every_term_of_the_mass_spring_damper_has_a_certificate(machine):
    """DESIGN F3: Stribeck, v|v|, v³, y³, u³ and dead zones cannot be made orthogonal to the physics."""
    position, force = "position[k-1]", "force[k-1]"
    width = data_width(VELOCITY, machine.rows.x, machine.layout, TS)
    suspects = [
        FRICTION,
        Suspect.of("coulomb", VELOCITY, constants=TS),
        Suspect.of("stribeck", VELOCITY, width=0.02, constants=TS),
        Suspect.of("quadratic_drag", VELOCITY, constants=TS),
        Suspect.of("cubic", VELOCITY, constants=TS),
        Suspect.of("cubic", position),
        Suspect.of("cubic", force),
        Suspect.of("dead_zone", VELOCITY, width=width, constants=TS),
        Suspect.of(
            "dead_zone", position, width=data_width(position, machine.rows.x, machine.layout)
        ),
        Suspect.of("dead_zone", force, width=50.0),
    ]
    deltas = suspect_columns(suspects, machine.rows.x, machine.layout, machine.outputs)
    for found, delta in zip(table(machine, suspects), deltas, strict=True):
        assert found.certificate.verdict == "unremovable", found.sentence
        product = machine.projection.phi[:, 0] @ np.array(found.certificate.direction) * delta[:, 0]
        assert product.min() >= -1e-9 * product.max() and product.mean() > 0
    even = [
        Suspect.of("offset"),
        Suspect.of("expression", f"{position}**2"),
        Suspect("product", f"{position}*{force}"),
    ]
    assert [found.certificate.verdict for found in table(machine, even)] == ["removable"] * 3


def test_the_direction_of_friction_is_velocity(machine):
    (found,) = table(machine, [FRICTION])
    np.testing.assert_allclose(found.certificate.shares, [1.0, -1.0, 0.0], atol=5e-3)
    assert found.certificate.cosine == pytest.approx(0.7813, abs=1e-4)
    assert found.sentence.startswith("friction: no weighting that counts any of")
    assert "a = +1 theta1 -1 theta2 (columns scaled" in found.sentence


def test_sentences():
    phi = np.stack([V, V**3], axis=1)[:, None]
    deltas = np.stack([0 * V, V**2])[..., None]
    entries = table_of(
        Projection.factor(phi), "ab", [replace(ANY, name="z"), replace(ANY, name="e")], deltas
    )
    assert [entry.sentence for entry in entries] == [
        "z: φᵀδ is zero on all of these points, so this term biases nothing there.",
        "e: some weighting of these points leaves θ unbiased.",
    ]
    assert entries[0].cosine is None
    undecided = replace(entries[0], certificate=Certificate("undecided"))
    assert (
        undecided.sentence
        == "z: whether a weighting of these points leaves θ unbiased could not be decided."
    )
    assert replace(entries[0], certificate=None).sentence == ""


def test_as_dict_is_json_without_nan(machine):
    jacobian = {"mass": [1.0, 2.0, 3.0]}
    suspects = [FRICTION, Suspect("nothing", "0*force[k-1]"), Suspect.of("offset")]
    for found in table(machine, suspects, theta=THETA, physical=jacobian, learned=machine.target):
        text = json.dumps(found.as_dict(), allow_nan=False)
        assert json.loads(text)["bias"].keys() == {"theta1", "theta2", "theta3"}
    plain = table(machine, suspects, certify=False)[2].as_dict()
    unknown = (
        "coefficient",
        "expected_bias",
        "physical_bias",
        "explained",
        "certificate",
    )
    assert [plain[key] for key in unknown] == [None] * 5


def test_the_same_every_time(machine):
    assert table(machine, [FRICTION]) == table(machine, [FRICTION])


def test_a_suspect_is_given_once(machine):
    with pytest.raises(InputError, match="suspect 'friction' is given twice"):
        table(machine, [FRICTION, FRICTION])


def test_rank_deficient_physics_is_refused(machine):
    """On points where the positions of two samples agree no measure tells their parameters apart."""
    same = np.random.default_rng(8).normal(size=30)
    points = {str(lag): same for lag in machine.layout}
    weighed = weigh_problem(Samples(points), machine)
    with pytest.raises(RankError, match="are linearly dependent"):
        bias_table(LaggedTerms(weighed, machine, THETA), [FRICTION])
