"""Designed inputs against regressions on simulated records, known figures of usual inputs, and limits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from orthaug import Baseline, InputError, Suspect, Term, design_input, synthetic
from orthaug.analysis import signals
from orthaug.analysis.input_search import Design
from orthaug.reports.result import DesignResult

SYSTEM = synthetic.MassSpringDamper()
THETA = SYSTEM.paper_theta()
SAMPLES, NOISE, AMPLITUDE = 10_000, 0.00018, 100.0
VELOCITY = "(position[k-1] - position[k-2])/Ts"
FRICTION = Suspect(
    "friction",
    f"sign({VELOCITY})*(coulomb + (static - coulomb)*exp(-abs({VELOCITY})/vs))",
    coefficient=-THETA[2],
    constants={
        "Ts": 0.01,
        "coulomb": SYSTEM.coulomb,
        "static": SYSTEM.static,
        "vs": SYSTEM.stribeck,
    },
)
MACHINE = synthetic.mass_spring_damper().baseline
FIRST = Baseline.from_terms([Term("a", "y[k-1]", initial=0.9), Term("b", "u[k-1]", initial=0.1)])


def machine(**changes: Any) -> Design:
    given = {
        "outputs": ["position"],
        "inputs": ["force"],
        "sampling_time": 0.01,
        "samples": SAMPLES,
    }
    given |= {"amplitude": AMPLITUDE, "suspects": [FRICTION], "noise": NOISE, "theta": THETA}
    return design_input(MACHINE, **(given | changes))


def first(baseline: Baseline = FIRST, **changes: Any) -> Design:
    given = {
        "outputs": ["y"],
        "inputs": ["u"],
        "sampling_time": 1.0,
        "samples": 400,
        "amplitude": 1.0,
        "noise": 0.1,
    }
    return design_input(baseline, **(given | changes))


def errors(force: np.ndarray, draws: int = 20) -> np.ndarray:
    """‖(θ̂ − θ*)/θ*‖ of least squares on simulated records, (draws,)."""
    found = []
    for draw in range(draws):
        y = SYSTEM.simulate(
            force, THETA, np.random.default_rng(1000 + draw).normal(0, NOISE, len(force) - 2)
        )
        phi = np.stack([y[1:-1], y[:-2], force[1:-1]], axis=1)
        size = np.linalg.norm(phi, axis=0)
        theta = np.linalg.lstsq(phi / size, y[2:], rcond=None)[0] / size
        found.append(np.linalg.norm((theta - THETA) / THETA))
    return np.array(found)


@pytest.fixture(scope="module")
def designed() -> Design:
    return machine()


def test_it_beats_every_usual_input_on_the_paper_machine(designed: Design) -> None:
    found = errors(designed.signal)
    assert np.median(found) <= 0.0072
    assert np.sqrt(np.mean(found**2)) == pytest.approx(designed.relative_error, rel=0.05)
    assert designed.relative_error < 0.0068
    assert designed.condition < 5
    assert np.abs(designed.signal).max() <= AMPLITUDE


@pytest.mark.parametrize(
    ("name", "wave", "known"),
    [
        (
            "white Gaussian",
            np.clip(np.random.default_rng(0).normal(0.0, 33, SAMPLES), -AMPLITUDE, AMPLITUDE),
            0.041,
        ),
        ("white uniform", AMPLITUDE * signals.white_uniform(SAMPLES, 0), 0.024),
        ("white binary, hold 1", AMPLITUDE * signals.white_binary(SAMPLES, 0), 0.0142),
        ("square, period 6", AMPLITUDE * signals.square(SAMPLES, 6), 0.0084),
    ],
)
def test_predicted_and_measured_errors_of_usual_inputs(
    designed: Design, name: str, wave: np.ndarray, known: float
) -> None:
    candidate = next(row for row in designed.candidates if row.name == name)
    assert np.sqrt(candidate.cost) == pytest.approx(known, rel=0.05)
    assert np.median(errors(wave)) == pytest.approx(known, rel=0.08)


def test_the_prediction_is_what_least_squares_says(designed: Design) -> None:
    """Φ⁺Δ and σ²(ΦᵀΦ)⁻¹ on an independent simulation of the same input."""
    u, y = designed.signal, SYSTEM.simulate(designed.signal, THETA)
    x = np.stack([y[1:-1], y[:-2], u[1:-1]], axis=1)
    layout = Suspect("all", "position[k-1] + position[k-2] + force[k-1]").lags
    delta = FRICTION.coefficient * FRICTION.values(x, layout, ["position"])[:, 0]
    size = np.linalg.norm(x, axis=0)
    bias = np.linalg.lstsq(x / size, delta, rcond=None)[0] / size
    assert designed.bias == pytest.approx(bias, rel=1e-9)
    unit = np.sqrt(np.diag(np.linalg.inv((x / size).T @ (x / size)))) / size
    assert designed.std == pytest.approx(NOISE * unit, rel=1e-9)
    assert designed.condition == pytest.approx(np.linalg.cond(x / size), rel=1e-9)
    assert designed.cost == pytest.approx(
        np.sum((designed.bias**2 + designed.std**2) / THETA**2), rel=1e-12
    )


def test_the_same_seed_gives_the_same_signal(designed: Design) -> None:
    again = machine()
    assert np.array_equal(designed.signal, again.signal)
    assert designed.candidates == again.candidates
    DesignResult.of(designed).to_json()


@pytest.mark.parametrize("rate", [5000.0, 700.0])
def test_limits_hold_to_the_last_bit(rate: float) -> None:
    found = machine(samples=2000, rate=rate, iterations=5).signal
    assert np.abs(found).max() <= AMPLITUDE
    assert np.abs(np.diff(found, prepend=0.0)).max() <= rate * 0.01
    assert np.abs(np.diff(found)).max() >= 0.99 * rate * 0.01


def test_limits_may_be_apart() -> None:
    """A propeller's command is not negative; ±A is the same as A."""
    found = machine(
        samples=1000, amplitude=None, minimum=20, maximum=90, rate=5000.0, iterations=0
    ).signal
    assert found.min() >= 20 and found.max() <= 90 and np.ptp(found) > 60
    assert np.abs(np.diff(found, prepend=20.0)).max() <= 50
    one = machine(samples=300, iterations=0)
    other = machine(
        samples=300, iterations=0, amplitude=None, minimum=-AMPLITUDE, maximum=AMPLITUDE
    )
    assert np.array_equal(one.signal, other.signal) and one.cost == other.cost


def test_the_cap_on_the_condition_number_is_kept() -> None:
    free, capped = (
        machine(samples=2000, iterations=5),
        machine(samples=2000, iterations=5, condition=2.0),
    )
    assert capped.condition <= 2 < free.condition
    assert capped.cost > free.cost
    assert np.all(np.diff([row.cost for row in capped.candidates if row.condition <= 2]) >= 0)
    with pytest.raises(
        InputError,
        match=r"^no candidate has a condition number of Φ of 1\.01 or less; the best has",
    ):
        machine(samples=2000, iterations=0, condition=1.01)


def test_without_suspects_the_variance_is_least() -> None:
    found = machine(samples=2000, suspects=(), noise=0.0)
    best = min(
        row.std for row in found.candidates if row.name.startswith(("white", "PRBS", "square"))
    )
    assert found.relative_error < 0.95 * best
    assert np.all(found.bias == 0)
    noisy = machine(samples=2000, suspects=(), noise=3.0)  # noise only scales
    assert np.array_equal(noisy.signal, found.signal)
    assert noisy.std == pytest.approx(3 * found.std)


def test_an_even_suspect_leads_to_an_odd_signal() -> None:
    baseline = Baseline.from_terms(
        [Term("b1", "u[k]", initial=1.0), Term("b3", "u[k]**3", initial=0.1)]
    )
    suspect = Suspect.of("expression", "u[k]**2", coefficient=-0.5)
    found = first(baseline, suspects=[suspect], noise=0.001)
    assert np.abs(found.bias).max() < 1e-3
    assert found.relative_error < 1.2 * np.linalg.norm(found.std / [1.0, 0.1])


def test_weights_say_what_counts() -> None:
    own = first(weights=[0.0, 1.0])
    assert own.cost == pytest.approx(own.bias[1] ** 2 + own.std[1] ** 2)
    assert own.std[1] < first(weights=[1.0, 0.0]).std[1]
    gain = np.array([0.1 / 0.1**2, 1 / 0.1])  # derivative of the static gain b/(1 − a)
    found, y = first(weights=gain[None]), np.zeros(400)
    for k in range(1, 400):
        y[k] = 0.9 * y[k - 1] + 0.1 * found.signal[k - 1]
    phi = np.stack([y[:-1], found.signal[:-1]], axis=1)
    assert found.cost == pytest.approx(0.1**2 * gain @ np.linalg.inv(phi.T @ phi) @ gain)


def test_two_outputs_with_other_noise_shared_parameters_and_a_known_input() -> None:
    """Against a Monte-Carlo regression of outputs divided by their standard deviations."""
    baseline = Baseline.from_terms(
        [
            Term("a", "y[k-1]", initial=0.5, output="y"),
            Term("b", "u[k-1] + w[k-1]", initial=1.0, output="y"),
            Term("b", "10*u[k-2]", output="z"),
            Term("f", "y[k-1]", initial=2.0, fixed=True, output="z"),
        ]
    )
    drag = Suspect("drag", "y[k-1]*abs(y[k-1])", output="y", coefficient=-0.05)
    names = {"outputs": ["y", "z"], "inputs": ["u", "w"]}
    w = np.random.default_rng(0).normal(size=300)
    given = {
        "sampling_time": 1.0,
        "samples": 300,
        "amplitude": 2.0,
        "noise": [0.1, 3.0],
        "initial_outputs": 0.2,
    }
    found = design_input(
        baseline,
        **names,
        **given,
        suspects=[drag],
        channel="u",
        known_inputs={"w": w},
        iterations=3,
    )
    rng, thetas = np.random.default_rng(1), []
    for _ in range(400):
        u, y, z = found.signal, np.full(300, 0.2), np.full(300, 0.2)
        e = rng.normal(size=(300, 2)) * [0.1, 3.0]
        for k in range(2, 300):
            y[k] = 0.5 * y[k - 1] + u[k - 1] + w[k - 1] - 0.05 * y[k - 1] * abs(y[k - 1]) + e[k, 0]
            z[k] = 10 * u[k - 2] + 2 * y[k - 1] + e[k, 1]
        sizes = np.std(y), np.std(z)
        phi = [[y[1:-1], u[1:-1] + w[1:-1]], [0 * y[1:-1], 10 * u[:-2]]]
        columns = np.concatenate([np.stack(p, 1) / s for p, s in zip(phi, sizes, strict=True)])
        target = np.concatenate([y[2:] / sizes[0], (z[2:] - 2 * y[1:-1]) / sizes[1]])
        thetas.append(np.linalg.lstsq(columns, target, rcond=None)[0])
    assert np.mean(thetas, axis=0) - [0.5, 1.0] == pytest.approx(found.bias, abs=3e-3)
    assert np.std(thetas, axis=0) == pytest.approx(found.std, rel=0.15)


def test_expressions_mean_what_they_mean_elsewhere() -> None:
    """Every function and operator, against `Suspect.values` on the rows of the designed record."""
    text = (
        "min(u[k-1], 0.3, y[k-1]) + max(y[k-1], -1)*tanh(y[k-2])**2 - sqrt(abs(y[k-1]))/(1 + "
        "exp(-u[k])) + 2**-1"
    )
    text += " + sin(y[k-1]) - cos(-u[k-1]) + tan(0.1*y[k-1])*log(2 + sign(y[k-2])) + c**2*(+y[k-1])"
    suspect = Suspect("all", text, coefficient=0.01, constants={"c": 0.3})
    found = first(suspects=[suspect], iterations=0, samples=200)
    u, y = found.signal, np.zeros(200)
    x = np.zeros((200, 4))
    layout: Any = None
    for k in range(2, 200):
        layout = suspect.lags
        x[k] = [{"y": y, "u": u}[lag.channel][k - lag.lag] for lag in layout]
        y[k] = (
            0.9 * y[k - 1]
            + 0.1 * u[k - 1]
            + 0.01 * suspect.values(x[k : k + 1], layout, ["y"])[0, 0]
        )
    phi = np.stack([y[1:-1], u[1:-1]], axis=1)
    bias = np.linalg.lstsq(phi, 0.01 * suspect.values(x[2:], layout, ["y"])[:, 0], rcond=None)[0]
    assert found.bias == pytest.approx(bias, rel=1e-8)


def test_the_pole_of_a_slow_system_needs_a_slow_input() -> None:
    slow = Baseline.from_terms(
        [Term("a", "y[k-1]", initial=0.99), Term("b", "u[k-1]", initial=0.01)]
    )
    found = first(slow, samples=4000, iterations=3, weights=[1.0, 0.0])
    assert np.sum(np.diff(found.signal) != 0) < 400
    assert found.condition < 1e3


UNSTABLE = Baseline.from_terms([Term("a", "y[k-1]", initial=1.2), Term("b", "u[k-1]", initial=0.1)])
AWAY = r"^the simulated output diverges under every input; give the `theta` of a stable model\.$"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"amplitude": None},
            r"^give `amplitude`, or `minimum` and `maximum`; got none of them\.$",
        ),
        ({"minimum": 0.0, "maximum": 1.0}, r"got amplitude and minimum and maximum\.$"),
        (
            {"amplitude": None, "maximum": 1.0},
            r"^give `amplitude`, or `minimum` and `maximum`; got maximum\.$",
        ),
        (
            {"amplitude": None, "minimum": 2.0, "maximum": 1.0},
            r"^`minimum` must be less than `maximum`; got 2 and 1\.$",
        ),
        (
            {"amplitude": None, "minimum": np.nan, "maximum": 1},
            r"^`minimum` must be a number between -1e\+100 and",
        ),
        ({"amplitude": 0}, r"^`amplitude` must be a positive number; got 0\.$"),
        ({"amplitude": -1.0}, r"^`amplitude` must be a positive number; got -1\.0\.$"),
        ({"rate": 0.0}, r"^`rate` must be a positive number; got 0\.0\.$"),
        ({"sampling_time": 0.0}, r"^`sampling_time` must be a positive number"),
        ({"samples": 20}, r"^`samples` must be a whole number, 25 or more; got 20\.$"),
        ({"noise": -0.1}, r"^`noise` must be a number, 0 or more"),
        (
            {"noise": [0.1, 0.1]},
            r"^`noise` must be finite numbers of shape \(1,\), or a single one\.$",
        ),
        (
            {"theta": [0.9, np.nan]},
            r"^`theta` must be finite numbers of shape \(2,\), or a single one\.$",
        ),
        (
            {"theta": [0.9, 0.0]},
            r"^θ of b is 0, so that its relative error has no meaning; give `weights`\.$",
        ),
        (
            {"weights": [0.0, 0.0]},
            r"^`weights` must be of shape \(2,\) or \(m, 2\), and not all 0\.$",
        ),
        ({"weights": np.ones((2, 3))}, r"^`weights` must be of shape \(2,\) or \(m, 2\)"),
        ({"condition": 0}, r"^`condition` must be a positive number"),
        ({"iterations": -1}, r"^`iterations` must be a whole number, 0 or more"),
        ({"channel": "v"}, r"^`channel` must be one of u; got 'v'\.$"),
        (
            {"inputs": ["u", "w"]},
            r"^`channel` is missing: the input to design, one of the inputs \(u, w\)\.$",
        ),
        (
            {"inputs": ["u", "w"], "channel": "w"},
            r"^no term reads the input 'w', so that it cannot be designed\.$",
        ),
        ({"inputs": []}, r"^`channel` is missing"),
        ({"known_inputs": {"u": 1.0}}, r"^a channel of `known_inputs` must be one of"),
        (
            {"initial_outputs": np.inf},
            r"^`initial_outputs` must be finite numbers of shape \(1, 1\)",
        ),
        (
            {"suspects": [Suspect("s", "y[k-1]**2")]},
            r"^suspect 's' has no `coefficient`; a design needs a guess",
        ),
        (
            {"suspects": [Suspect("s", "v[k-1]", coefficient=1.0)]},
            r"^'v\[k-1\]' uses the unknown channel 'v'",
        ),
        (
            {"suspects": [Suspect("s", "1", output="q", coefficient=1.0)]},
            r"^suspect 's': unknown output 'q'",
        ),
        ({"suspects": [Suspect("s", "1", coefficient=1.0)] * 2}, r"^suspect 's' is given twice"),
        ({"suspects": [Suspect("s", "y[k-1]**3", coefficient=1e6)]}, AWAY),
        ({"suspects": [Suspect("s", "log(y[k-1])", coefficient=0.1)]}, AWAY),
        ({"theta": [1.2, 0.1]}, AWAY),
    ],
)
def test_errors_in_words(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        first(**changes)
    assert "\n" not in str(caught.value)


def test_physics_that_cannot_be_designed_for() -> None:
    for baseline in (
        Baseline.from_function(lambda x: x, ["a"]),
        Baseline.from_terms([Term("a", "u[k]", 1.0, fixed=True)]),
    ):
        with pytest.raises(
            InputError, match=r"^a design needs physics that is made of terms, with one parameter"
        ):
            first(baseline)
    twins = Baseline.from_terms([Term("a", "u[k]", initial=1.0), Term("b", "2*u[k]", initial=1.0)])
    with pytest.raises(
        InputError, match=r"^no candidate has a condition number of Φ of 1000 or less"
    ):
        first(twins)


def test_an_input_that_drives_the_model_away_is_only_left_out() -> None:
    """A cubic that is unstable beyond |y| = 1/√0.1: large slow inputs run away, the others do not."""
    found = first(
        amplitude=2.0,
        theta=[0.9, 1.0],
        suspects=[Suspect("s", "y[k-1]**3", coefficient=0.02)],
        iterations=2,
    )
    assert any(row.cost == np.inf for row in found.candidates)
    assert np.isfinite(found.cost)
    assert any(row["cost"] is None for row in DesignResult.of(found).content()["candidates"])
