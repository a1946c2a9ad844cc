"""What a fit says of causes that it cannot know: found by trials on systems that no example has."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.signal
from test_cli import run

import orthaug as oa
from orthaug.analysis.doubts import _movement_text, _names_of_experiments
from orthaug.analysis.input_timing import LateInput, try_holds
from orthaug.analysis.missing_terms import missing_terms

TS = 0.1


def tanh_friction(rows: int = 800) -> oa.Record:
    """y = 1.5 y₁ − 0.7 y₂ + u₁ + 0.6 tanh(2 (y₁ − y₂)) + e: no memory beside the lags."""
    rng = np.random.default_rng(3)
    u, y = rng.normal(size=rows), np.zeros(rows)
    for k in range(2, rows):
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + u[k - 1]
        y[k] += 0.6 * np.tanh(2 * (y[k - 1] - y[k - 2])) + 0.1 * rng.normal()
    return oa.Record.from_arrays(u, y, sampling_time=TS)


PHYSICS = [oa.Term("a1", "y[k-1]"), oa.Term("a2", "y[k-2]"), oa.Term("b", "u[k-1]")]


def test_a_selected_term_of_the_wrong_form_is_no_learner():
    """The sentence on intervals that are withheld spoke of a learner where there was none."""
    selected = oa.Term("r", "(y[k-1] - y[k-2])**3", selected=True)
    physics = oa.Baseline.from_terms([*PHYSICS, selected])
    fit = oa.estimate(tanh_friction(), physics, learner=None, criterion=oa.Prediction())
    found = {warning.code: warning.text for warning in fit.diagnose().warnings}
    assert "The learner holds" not in found["unexplained"]
    assert "lacks something whose bias is not known, so no interval" in found["unexplained"]


def test_a_learner_of_the_wrong_form_gives_no_interval_with_bias():
    """It explains itself wholly, and nothing of what it cannot hold."""
    learner = oa.Terms(terms=("(y[k-1]-y[k-2])**3",))
    fit = oa.estimate(
        tanh_friction(),
        oa.Baseline.from_terms(PHYSICS),
        learner=learner,
        criterion=oa.Prediction(),
    )
    found = fit.diagnose()
    codes = {warning.code: warning.text for warning in found.warnings}
    assert "functions of the regressors predict" in codes["unexplained"]
    assert "no interval with its bias is given for a1, a2, b" in codes["unexplained"]
    assert "hidden_state" not in codes
    assert found.unexplained is None or not found.unexplained.hidden_state
    for row in found.parameters:
        assert row.ci95_counts == "noise only"
        assert row.ci95_with_bias is None and not row.bias.determined


def held_wrongly() -> tuple[oa.Record, oa.Motion]:
    """A mass on a spring whose input runs straight between samples, declared as held."""
    t = 0.2 * np.arange(500)
    u = np.sin(1.3 * t) + 0.7 * np.sin(2.9 * t + 1) + 0.5 * np.sin(4.7 * t)
    state, y = np.zeros(2), []
    for k in range(500):
        y.append(state[0])
        if k == 499:
            break
        for i in range(40):
            force = u[k] + (u[k + 1] - u[k]) * (i + 0.5) / 40
            rate = np.array([state[1], (force - 0.8 * state[1] - 6 * state[0]) / 1.2])
            middle = state + 0.0025 * rate
            rate = np.array([middle[1], (force - 0.8 * middle[1] - 6 * middle[0]) / 1.2])
            state = state + 0.005 * rate
    noisy = np.array(y) + 1e-3 * np.random.default_rng(0).normal(size=500)
    motion = oa.Motion.from_equations(
        states=[
            oa.State("x", "v", start="y"),
            oa.State("v", "(u - c*v - k*x)/m", start="derivative of y"),
        ],
        outputs=[oa.Output("y", "x")],
        inputs=["u"],
        parameters=[oa.PhysicalParameter(n, i, min=0) for n, i in (("m", 1), ("c", 1), ("k", 5))],
    )
    return oa.Record.from_arrays(u, noisy, sampling_time=0.2), motion


def test_a_held_input_is_not_named_as_missing_where_the_physics_has_it():
    """(u − c v − k x)/m + βu is the same family: βu can explain nothing."""
    record, motion = held_wrongly()
    test = missing_terms(oa.estimate(record, motion, learner=None))
    assert test is not None
    assert not any(term.variable == "u" and term.shape == "linear" for term in test.terms)


@pytest.mark.parametrize(
    ("right", "wrong", "message"),
    [
        (
            "regressor",
            "regresor",
            "unknown key 'baseline.terms[0].regresor', did you mean 'regressor'",
        ),
        ("train", "trian", "unknown key 'data.trian', did you mean 'train'"),
    ],
)
def test_a_misspelt_key_that_is_required_is_named(tmp_path, right, wrong, message):
    spec = '[data]\nsampling_time = 0.1\ninputs = ["u"]\noutputs = ["y"]\ntrain = { files = ["a.csv"] }\n'
    spec += '[[baseline.terms]]\nparameter = "a"\nregressor = "y[k-1]"\n'
    (tmp_path / "spec.toml").write_text(spec.replace(right, wrong))
    done = run("check", tmp_path / "spec.toml")
    assert done.code == 2 and message in done.err


def test_another_hold_is_not_advised_for_an_input_that_is_held():
    """Quadratic drag is missing, and the force steps: a first-order hold would only fit better by chance."""
    record, motion = held_wrongly()
    assert "first-order" in {one.hold for one in holds_tried(record, motion)}
    steps = np.repeat(record.experiments[0].inputs[::10], 10, axis=0)
    held = oa.Record.from_arrays(steps, record.experiments[0].outputs, sampling_time=0.2)
    assert [one.hold for one in holds_tried(held, motion)] == ["zero-order"]


def holds_tried(record, motion):
    problem = oa.estimate(record, motion, learner=None).problem
    return try_holds(problem, oa.Simulation(), oa.LevenbergMarquardt(), oa.Orthogonal()).holds


def two_lags(outputs: int) -> tuple[oa.Record, oa.Motion]:
    """Two lags in series, of 0.3 s and 1.5 s, of which the last or both are measured."""
    rng = np.random.default_rng(4)
    u = np.repeat(rng.uniform(-5, 5, 40), 15)
    first, last, y = 0.0, 0.0, []
    for value in u:
        y.append((last, first)[:outputs])
        for _ in range(20):
            first, last = (
                first + 0.005 * (value - first) / 0.3,
                last + 0.005 * (3 * first - last) / 1.5,
            )
    noisy = np.array(y) + 0.02 * rng.normal(size=(len(u), outputs))
    motion = oa.Motion.from_equations(
        states=[
            oa.State("x", "(K*v - x)/T2", start="y"),
            oa.State("v", "(u - v)/T1", start="z" if outputs == 2 else 0.0),
        ],
        outputs=[oa.Output("y", "x"), oa.Output("z", "v")][:outputs],
        inputs=["u"],
        parameters=[
            oa.PhysicalParameter(n, i, min=0) for n, i in (("K", 2), ("T1", 0.2), ("T2", 1))
        ],
    )
    names = ["y", "z"][:outputs]
    record = oa.Record.from_arrays(u, noisy, sampling_time=0.1, inputs=["u"], outputs=names)
    return record, motion


@pytest.mark.parametrize("outputs", [1, 2])
def test_time_constants_that_may_change_places_are_named(outputs):
    """Only where the state between them is not measured."""
    record, motion = two_lags(outputs)
    found = oa.estimate(record, motion, learner=None).diagnose()
    texts = [w.text for w in found.warnings if w.code == "several_solutions"]
    if outputs == 2:
        assert not texts
    else:
        (text,) = texts
        values = dict(
            part.split(" = ") for part in text.split("with ")[1].split(". ")[0].split(", ")
        )
        assert float(values["T1"]) == pytest.approx(1.5, rel=0.05)
        assert "the fitted values of T1 and T2 in another order" in text
        assert float(values["T2"]) == pytest.approx(0.3, rel=0.05)


@pytest.mark.parametrize("k", [90.0, 9.5])
def test_initial_values_that_lead_nowhere_are_replaced(k):
    """A spring whose stiffness starts ten times too high follows another frequency."""
    t = 0.05 * np.arange(1200)
    force = np.where(t < 1, 5.0, 0.0)
    noisy = ringing(force) + 1e-3 * np.random.default_rng(1).normal(size=len(t))
    motion = oa.Motion.from_equations(
        states=[oa.State("x", "v", start=0.0), oa.State("v", "u - c*v - k*x", start=0.0)],
        outputs=[oa.Output("y", "x")],
        inputs=["u"],
        parameters=[
            oa.PhysicalParameter("c", 0.05, min=0),
            oa.PhysicalParameter("k", k, min=0),
        ],
    )
    record = oa.Record.from_arrays(force, noisy, sampling_time=0.05)
    fit = oa.estimate(record, motion, learner=None, criterion=oa.Simulation())
    np.testing.assert_allclose(fit.values, [0.05, 9], rtol=0.02)
    texts = [w.text for w in fit.diagnose().warnings if w.code == "other_start"]
    assert len(texts) == (k == 90) and all("the fit begins there" in text for text in texts)


def ringing(force):
    """A mass of 1 kg on a spring of 9 N/m that hardly loses energy."""
    x, v, y = 0.0, 0.0, []
    for u in force:
        y.append(x)
        for _ in range(50):
            v += 0.001 * (u - 0.05 * v - 9 * x)
            x += 0.001 * v
    return np.array(y)


def second_order(disturbance, **options):
    """The findings of complete physics, y = 1.5 y₁ − 0.7 y₂ + 0.5 u₁ + e, with a disturbance."""
    rng = np.random.default_rng(11)
    rows = len(disturbance)
    u, y = rng.normal(size=rows), np.zeros(rows)
    for k in range(2, rows):
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + 0.5 * u[k - 1] + disturbance[k]
    record = oa.Record.from_arrays(u, y + options.pop("added", 0.0), sampling_time=TS)
    terms = oa.Baseline.from_terms(PHYSICS)
    return oa.estimate(record, terms, learner=None, **options).diagnose()


def test_a_disturbance_with_memory_is_distinguished_from_missing_physics():
    """Nothing but its own past predicts it: a noise model is the remedy, not a further term."""
    rng = np.random.default_rng(5)
    noise = np.zeros(1500)
    for k in range(1, 1500):
        noise[k] = 0.8 * noise[k - 1] + 0.05 * rng.normal()
    found = second_order(noise, criterion=oa.Simulation())
    text = dict((w.code, w.text) for w in found.warnings)["unexplained"]
    assert "a disturbance with a memory of its own is likely" in text and '"auto"' in text
    modelled = second_order(noise, criterion=oa.Prediction(), noise="auto")
    assert "unexplained" not in {w.code for w in modelled.warnings}
    for row, true in zip(modelled.parameters, (1.5, -0.7, 0.5), strict=True):
        assert row.ci95[0] < true < row.ci95[1]


@pytest.mark.parametrize("iterations", [1, 100])
@pytest.mark.parametrize("physics", ["complete", "lacking"])
def test_what_intervals_count_is_reported_only_where_there_are_some(iterations, physics):
    rng, noise = np.random.default_rng(5), np.zeros(1500)
    for k in range(1, 1500):
        noise[k] = 0.8 * noise[k - 1] + 0.05 * rng.normal()
    how = {"criterion": oa.Simulation(), "solver": oa.LevenbergMarquardt(iterations=iterations)}
    if physics == "complete":
        found = second_order(noise, **how)
    else:
        terms = oa.Baseline.from_terms(PHYSICS)
        found = oa.estimate(tanh_friction(), terms, learner=None, **how).diagnose()
    text = dict((w.code, w.text) for w in found.warnings)["unexplained"]
    given = any(row.ci95 is not None for row in found.parameters)
    assert given == (iterations == 100)
    assert ("The 95 % intervals count noise only" in text) == given


@pytest.mark.parametrize("slope", [0.0, 1.0])
def test_a_drift_is_named(slope):
    rng = np.random.default_rng(6)
    ramp = slope * np.linspace(-1, 1, 1500)
    found = second_order(0.05 * rng.normal(size=1500), added=ramp, criterion=oa.Simulation())
    texts = [w.text for w in found.warnings if w.code == "drift"]
    assert len(texts) == (slope > 0)
    assert all("drifts: a straight line over time makes up" in text for text in texts)


def test_a_gap_between_two_angles_is_missing_physics():
    """No single term explains it, and all of those in the twist of the shaft do together."""
    rng = np.random.default_rng(1)
    torque = np.repeat(rng.uniform(-2, 2, 50), 40)
    a1 = w1 = a2 = w2 = 0.0
    angles = []
    for u in torque:
        angles.append((a1, a2))
        for _ in range(10):
            twist = a1 - a2
            shaft = 40 * np.sign(twist) * max(abs(twist) - 0.02, 0)
            shaft += 0.05 * (w1 - w2) * (abs(twist) > 0.02)
            w1 += 2e-4 * (u - shaft - 0.02 * w1) / 0.01
            w2 += 2e-4 * (shaft - 0.1 * w2) / 0.05
            a1, a2 = a1 + 2e-4 * w1, a2 + 2e-4 * w2
    motion = oa.Motion.from_equations(
        states=[
            oa.State("a1", "w1", start="motor"),
            oa.State("w1", "(u - shaft - d1*w1)/J1", start="derivative of motor"),
            oa.State("a2", "w2", start="load"),
            oa.State("w2", "(shaft - d2*w2)/J2", start="derivative of load"),
        ],
        outputs=[oa.Output("motor", "a1"), oa.Output("load", "a2")],
        inputs=["u"],
        define={"shaft": "k*(a1 - a2) + c*(w1 - w2)"},
        parameters=[
            oa.PhysicalParameter(name, value, min=0)
            for name, value in dict(J1=0.012, J2=0.04, k=30, c=0.1, d1=0.03, d2=0.05).items()
        ],
    )
    assert {("a1", "a2"), ("w1", "w2")} <= set(motion.differences)
    noisy = np.array(angles) + 2e-4 * rng.normal(size=(len(torque), 2))
    record = oa.Record.from_arrays(
        torque, noisy, sampling_time=0.002, inputs=["u"], outputs=["motor", "load"]
    )
    found = oa.estimate(record, motion, learner=None).diagnose()
    assert found.residuals.verdict == "unmodelled"
    assert all(row.ci95_counts == "noise only" for row in found.parameters if row.ci95)


def stepped(rows: int, seed: int, held: int = 12) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).uniform(-1, 1, rows // held + 1), held)[:rows]


def coil() -> oa.Motion:
    """A coil of constant resistance."""
    return oa.Motion.from_equations(
        [oa.State("i", "(u - R*i)/L", start="y")],
        [oa.Output("y", "i")],
        [oa.PhysicalParameter("R", 1.0, min=0), oa.PhysicalParameter("L", 0.4, min=0)],
        ["u"],
        hold="zero-order",
    )


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["sensor", "equation"])
@pytest.mark.parametrize("heats", [0.5, 0.0])
def test_a_resistance_that_follows_the_heat_of_its_current_is_a_hidden_state(noise, heats):
    """A coil at bursts of unequal size; the state of its heat is in no catalogue of terms."""
    random = np.random.default_rng([7, noise == "sensor"])
    u = stepped(2000, 5, 8) * np.repeat(random.uniform(0.2, 2, 10), 200)
    i, heat, y, resistance = 0.0, 0.5, [], []
    for value in u:
        y.append(i)
        resistance.append(0.8 + heats * heat)
        heat += 0.05 * (i**2 - heat) / 4
        shock = 0.02 * random.normal() if noise == "equation" else 0.0
        i += 0.05 * (value - (0.8 + heats * heat) * i) / 0.5 + shock
    motion = coil()
    measured = np.array(y) + (5e-3 if noise == "sensor" else 0.0) * random.normal(size=2000)
    record = oa.Record.from_arrays(u, measured, sampling_time=0.05)
    found = oa.estimate(record, motion, learner=None).diagnose()
    said = {w.code: w.text for w in found.warnings}
    if not heats:
        assert not {"hidden_state", "parameter_drift", "unexplained"} & said.keys()
        return
    text = said["hidden_state"]
    assert text.startswith("a state is missing that changes R") and "**2" in text
    low, high = (float(text.split(f" {word} ")[1].split(" ")[0]) for word in ("from", "to"))
    # to first order, and about a mean: between the ends, and over half of the way
    assert 0.95 * min(resistance) < low < high < 1.05 * max(resistance)
    assert high - low > np.ptp(resistance) / 2
    assert [row.ci95_counts for row in found.parameters] == ["noise only", "noise only"]


def test_a_gain_that_depends_on_the_stroke_follows_no_past():
    """The past of a slow stroke's square was called a part that heats up."""
    random = np.random.default_rng(2)
    u, x, v, y = np.repeat(random.normal(size=60), 25), 0.0, 0.0, []
    for value in u:
        y.append(x)
        for _ in range(10):
            v += 0.002 * (4 * value / (1 + 2 * x**2) - 1.5 * v - 9 * x)
            x += 0.002 * v
    noisy = np.array(y) + 0.003 * random.normal(size=1500)
    record = oa.Record.from_arrays(u, noisy, sampling_time=0.02)
    terms = [oa.Term("a1", "y[k-1]"), oa.Term("a2", "y[k-2]"), oa.Term("b", "u[k-1]")]
    physics = oa.Baseline.from_terms(terms)
    fit = oa.estimate(record, physics, learner=None, criterion=oa.Simulation())
    said = {w.code: w.text for w in fit.diagnose().warnings}
    assert "hidden_state" not in said
    assert said["parameter_depends"].startswith("b seems to depend on y[k-1]")


def test_a_parameter_that_changes_over_the_record_is_named_with_both_ends():
    """A coil that warms up: its resistance rises by a half; under a constant one nothing is said."""
    said = {}
    for rise in (0.4, 0.0):
        u, i, y = stepped(1500, 5), 0.0, []
        for k, value in enumerate(u):
            y.append(i)
            i += 0.05 * (value - (0.8 + rise * k / 1500) * i) / 0.5
        noisy = np.array(y) + 2e-3 * np.random.default_rng(6).normal(size=1500)
        motion = coil()
        record = oa.Record.from_arrays(u, noisy, sampling_time=0.05)
        found = oa.estimate(record, motion, learner=None).diagnose()
        said[rise] = {w.code: w.text for w in found.warnings}
        if rise:
            counts = [row.ci95_counts for row in found.parameters]
            assert counts == ["noise only", "noise only"]
    assert "parameter_drift" not in said[0.0]
    text = said[0.4]["parameter_drift"]
    begin, end = (float(text.split(word)[1].split(" at its")[0]) for word in ("from ", "begin to "))
    assert text.startswith("R seems to change")
    assert begin == pytest.approx(0.8, abs=0.06) and end == pytest.approx(1.2, abs=0.06)


def trolley(masses: tuple[float, ...], slow: float = 0.0):
    """A trolley's runs with loads, and an AR(0.9) disturbance of its speed."""
    rng, records = np.random.default_rng(20), []
    for i, mass in enumerate(masses):
        speed, rows = 0.0, []
        force = np.repeat(rng.uniform(-40, 40, 30), 15)
        for value in force:
            rows.append(speed)
            speed += 0.05 * (value - 6 * speed) / mass
        white = rng.normal(size=(2, len(rows)))
        noise = 0.05 * white[0] + slow * scipy.signal.lfilter([1.0], [1, -0.9], white[1])
        one = oa.Record.from_arrays(
            force, np.array(rows) + noise, sampling_time=0.05, inputs=["force"], outputs=["speed"]
        )
        file = replace(one.experiments[0], source=f"runs/trolley{i + 1}.csv")
        records.append(replace(one, experiments=(file,)))
    motion = oa.Motion.from_equations(
        [oa.State("v", "v + 0.05*(force - c*v)/m", start="speed")],
        [oa.Output("speed", "v")],
        [oa.PhysicalParameter("c", 3.0, min=0), oa.PhysicalParameter("m", 5.0, min=0)],
        ["force"],
        integrator="discrete",
    )
    found = oa.estimate(oa.Record.join(records), motion, learner=None).diagnose(blocks=0)
    return {one.code: one.text for one in found.warnings}


@pytest.mark.parametrize("masses", [(8.0, 14.0, 8.0), (8.0, 11.0)])
def test_a_load_that_differs_between_files_is_named_with_its_values(masses):
    """A heat that changes m was claimed, and nowhere stood in which file it is another."""
    said = trolley(masses)
    text = said["parameter_by_experiment"]
    assert text.startswith("m seems to differ between experiments: m is about ")
    for i, mass in enumerate(masses):
        value = float(text.split(f" in trolley{i + 1}.csv")[0].split(" ")[-1])
        assert value == pytest.approx(mass, rel=0.1)
    assert "constant input column" in text
    assert not {"hidden_state", "parameter_drift"} & said.keys()


@pytest.mark.parametrize("slow", [0.0, 0.1])
def test_equal_loads_do_not_differ(slow):
    said = trolley((8.0, 8.0, 8.0), slow)
    assert not {"parameter_by_experiment", "hidden_state", "parameter_drift"} & said.keys()


def test_experiments_of_one_file_have_numbers():
    record = oa.Record.from_arrays(np.zeros(9), np.zeros(9))
    one = record.experiments[0]
    several = [replace(one, source=name) for name in ("a.csv", "a.csv")]
    several[1] = replace(several[1], first_row=40)
    assert _names_of_experiments(replace(record, experiments=tuple(several))) == [
        "experiment 1",
        "experiment 2",
    ]
    torn = replace(several[0], offset=5, first_row=5)
    files = (several[0], torn, replace(one, source="runs/b.csv"))
    assert _names_of_experiments(replace(record, experiments=files)) == ["a.csv", "b.csv"]


def test_a_product_of_state_and_input_is_tried_as_missing_physics():
    """The force factor of a loudspeaker falls with the square of its stroke."""
    u, x, v, y = stepped(1500, 7), 0.0, 0.0, []
    for value in u:
        y.append(x)
        for _ in range(10):
            x, v = x + 0.005 * v, v + 0.005 * ((3 - x**2) * value * 4 - 1.5 * v - 9 * x)
    noisy = np.array(y) + 1e-3 * np.random.default_rng(8).normal(size=1500)
    motion = oa.Motion.from_equations(
        [
            oa.State("x", "v", start="y"),
            oa.State("v", "b*u - c*v - k*x", start="derivative of y"),
        ],
        [oa.Output("y", "x")],
        [oa.PhysicalParameter(name, at, min=0) for name, at in (("b", 10), ("c", 1), ("k", 8))],
        ["u"],
        hold="zero-order",
    )
    record = oa.Record.from_arrays(u, noisy, sampling_time=0.05)
    found = missing_terms(oa.estimate(record, motion, learner=None))
    best = found.terms[0]
    assert (best.equation, best.variable, best.shape) == ("v", "x**2*u", "linear")
    assert best.variables == ("x", "u") and best.share > 0.8
    assert best.coefficient == pytest.approx(-4, rel=0.2)


@pytest.mark.parametrize(
    ("variable", "size", "amplitude", "acceleration"),
    [
        ("u", 1.0, 1.2, lambda x, v, u: (np.clip(u, -1, 1) - 0.4 * v - 4 * x) / 0.8),
        (
            "x",
            0.5,
            3.0,
            lambda x, v, u: (u - 0.4 * v - 4 * x - 8 * (x - np.clip(x, -0.5, 0.5))) / 0.8,
        ),
    ],
    ids=["saturation", "end stop"],
)
def test_a_term_that_begins_beyond_a_size_is_named_with_that_size(
    variable, size, amplitude, acceleration
):
    """A saturating actuator was called odd and growing, "as a hardening spring": -0.1*u**3 at 81 %."""
    draw = np.random.default_rng(11)
    held = np.repeat(amplitude * draw.normal(size=60), 10)
    x, v, out, fine = 0.0, 0.0, [], 40
    for u in held:
        out.append(x)
        for _ in range(fine):
            v += 0.05 / fine * acceleration(x, v, u)
            x += 0.05 / fine * v
    y = np.array(out) + 0.002 * draw.normal(size=len(out))
    record = oa.Record.from_arrays(held, y, sampling_time=0.05)
    motion = oa.Motion.from_equations(
        [
            oa.State("x", "v", start="y"),
            oa.State("v", "(u - c*v - k*x)/m", start="derivative of y"),
        ],
        [oa.Output("y", "x")],
        [oa.PhysicalParameter(name, at, min=0) for name, at in (("m", 1), ("c", 0.5), ("k", 3))],
        ["u"],
        hold="zero-order",
    )
    found = missing_terms(oa.estimate(record, motion, learner=None))
    best = found.terms[0]
    assert (best.equation, best.variable, best.shape) == ("v", variable, "beyond")
    assert best.width == pytest.approx(size, rel=0.15) and best.share > 0.8
    assert best.coefficient < 0 and f"that begins at about |{variable}| = " in str(best)
    assert ("as where the input saturates at ±" in str(best)) == (variable == "u")


def test_a_loss_to_surroundings_counts_from_their_temperature():
    """A term of an absolute temperature alone is mostly a constant: it was called a kink at its median."""
    power, jacket = 3 + stepped(900, 5, held=15), 310 + 8 * stepped(900, 6, held=40)
    at, out = 305.0, []
    for p, j in zip(power, jacket, strict=True):
        out.append(at)
        for _ in range(20):
            at += 5 / 20 * (0.05 * p + 0.012 * (j - at) - 0.002 * (at - 290))
    y = np.array(out) + 0.05 * np.random.default_rng(7).normal(size=900)
    inputs = ["power", "jacket"]
    record = oa.Record.from_arrays(
        np.column_stack([power, jacket]), y, sampling_time=5.0, inputs=inputs, outputs=["T"]
    )
    motion = oa.Motion.from_equations(
        [oa.State("at", "b*power + g*exp(-0.001*jacket)*(jacket - at)", start="T")],
        [oa.Output("T", "at")],
        [oa.PhysicalParameter("b", 0.04), oa.PhysicalParameter("g", 0.02)],
        inputs,
        hold="zero-order",
    )
    found = missing_terms(oa.estimate(record, motion, learner=None))
    best = found.terms[0]
    assert best.shape == "linear" and best.variable in ("at", "jacket") and best.share > 0.8
    assert best.reference == pytest.approx(290, abs=3)
    assert best.term == f"({best.variable} - {best.reference:.4g})" and best.term in str(best)


def test_no_other_solution_is_looked_for_where_every_run_takes_very_many_substeps():
    """A search of minutes, for a hint, would take longer than all the rest of the fit."""
    record, motion = two_lags(1)
    fit = oa.estimate(record, replace(motion, substeps=48), learner=None)
    assert "several_solutions" not in {w.code for w in fit.diagnose().warnings}


def test_a_mode_that_the_integrator_distorts_is_no_other_solution():
    """A fast mode far below a step is right under long steps alone: no warning names it."""
    u, x, wall, y = stepped(1200, 9, held=6), 0.0, 0.0, []
    for value in u:
        y.append(x)
        for _ in range(20):
            x, wall = (
                x + 0.05 * (value - x + 2 * (wall - x)) / 6,
                wall + 0.05 * (x - wall) / 50,
            )
    noisy = np.array(y) + 2e-3 * np.random.default_rng(10).normal(size=1200)
    motion = oa.Motion.from_equations(
        [
            oa.State("x", "(u - x + g*(z - x))/C", start="y"),
            oa.State("z", "(x - z)/W", start=0.0),
        ],
        [oa.Output("y", "x")],
        [oa.PhysicalParameter(n, at, min=0) for n, at in (("g", 1), ("C", 8), ("W", 40))],
        ["u"],
        hold="zero-order",
    )
    record = oa.Record.from_arrays(u, noisy, sampling_time=1.0)
    fit = oa.estimate(record, motion, learner=None)
    np.testing.assert_allclose(fit.values, [2, 6, 50], rtol=0.1)
    codes = {w.code for w in fit.diagnose().warnings}
    assert not codes & {"several_solutions", "local_minimum", "parameter_drift"}


def test_a_lag_that_a_delay_explains_nearly_as_well_leaves_both_open():
    late = LateInput("u", 0.05, 2, 0.122, 2, 0.115, 0.178)
    assert late.alike and late.warning.code == "slow_input"
    assert "hardly distinguish" in late.warning.text and 'step = "shift"' in late.warning.text
    sure = LateInput("u", 0.05, 2, 0.05, 2, 0.115, 0.178)
    assert not sure.alike and sure.warning.code == "dead_time"
    assert "hardly distinguish" not in sure.warning.text


@pytest.mark.proof
def test_disturbances_that_add_up_are_no_missing_physics():
    """An unstable pendulum in a loop with process noise: its free run is far off, and it is right."""
    rng, step = np.random.default_rng(4), 0.02
    angle, rate, rows = 0.0, 0.0, []
    reference = np.repeat(rng.uniform(-0.4, 0.4, 40), 30)
    for target in reference:
        seen = angle + 0.001 * rng.normal()
        torque = 12.0 * (target - seen) - 2.5 * rate
        rows.append((torque, seen))
        rate += 0.02 * rng.normal()
        for _ in range(4):
            rate += step / 4 * (9 * np.sin(angle) + 2 * torque - 0.8 * rate)
            angle += step / 4 * rate
    torque, seen = np.array(rows).T
    record = oa.Record.from_arrays(torque, seen, sampling_time=step, inputs=["tq"], outputs=["ang"])
    pendulum = oa.Motion.from_equations(
        [
            oa.State("th", "w", start="ang"),
            oa.State("w", "a*sin(th) + b*tq - d*w", start="derivative of ang"),
        ],
        [oa.Output("ang", "th")],
        [
            oa.PhysicalParameter(name, initial=value, min=0)
            for name, value in (("a", 7.0), ("b", 1.5), ("d", 0.5))
        ],
        inputs=["tq"],
        substeps=2,
    )
    fit = oa.estimate(record, pendulum, learner=None, noise="innovations")
    found = fit.diagnose()
    assert found.residuals.verdict == "white"
    assert "unexplained" not in {warning.code for warning in found.warnings}
    for row, true in zip(found.parameters, (9.0, 2.0, 0.8), strict=True):
        assert abs(row.value - true) < 3.5 * row.std


@pytest.mark.slow
def test_drag_of_a_pendulum_is_named_and_no_friction_that_pushes():
    """Beside its damper sign(om) of the wrong sign explains as much as drag: "dry friction" of +0.46."""
    step, rng = 0.02, np.random.default_rng(10)
    x, fine, angle = np.array([2.6, 0.0]), 10, []
    for _ in range(1100):
        angle.append(x[0])
        for _ in range(fine):
            rate = -21.8 * np.sin(x[0]) - 0.05 * x[1] - 0.06 * x[1] * abs(x[1])
            x = x + step / fine * np.array([x[1] + step / fine * rate, rate])
    record = oa.Record.from_arrays(
        None, np.array(angle) + 0.01 * rng.normal(size=1100), outputs=["phi"], sampling_time=step
    )
    motion = oa.Motion.from_equations(
        [
            oa.State("th", "om", start="phi"),
            oa.State("om", "-w2*sin(th) - d*om", start="derivative of phi"),
        ],
        [oa.Output("phi", "th")],
        [oa.PhysicalParameter(name, at, min=0) for name, at in (("w2", 20), ("d", 0.1))],
    )
    found = oa.diagnose(oa.estimate(record, motion, learner=None))
    assert found is not None and found.missing is not None
    best = found.missing.terms[0]
    assert (best.equation, best.term) == ("om", "om*abs(om)") and best.coefficient < 0
    assert "growing with its square, as quadratic drag: -" in found.text
    assert "dry friction" not in found.text


@pytest.mark.parametrize(
    ("cube", "friction", "words"),
    [
        ((0.0, -0.5), 0.0, "growing faster than it: -"),
        ((-40.0, 0.0), 0.0, "growing faster than it, as a hardening spring: -"),
        ((0.0, 0.0), -1.0, "with a jump at 0, as dry friction: -"),
    ],
    ids=["of an input", "spring", "friction"],
)
def test_a_spring_and_friction_are_named_where_they_act_against_a_state(cube, friction, words):
    """A cube of an input with a negative sign was a hardening spring, too."""
    rng = np.random.default_rng(7)
    force = np.repeat(rng.uniform(-2, 2, 60), 10)
    x, v, y, fine = 0.0, 0.0, [], 40
    for u in force:
        y.append(x)
        for _ in range(fine):
            spring = cube[0] * 25 * x**3 + cube[1] * u**3
            v += 0.05 / fine * (u - 0.8 * v - 10 * x + spring + 0.3 * friction * np.sign(v))
            x += 0.05 / fine * v
    record = oa.Record.from_arrays(
        u=force, y=np.array(y) + 0.01 * np.std(y) * rng.normal(size=600), sampling_time=0.05
    )
    motion = oa.Motion.from_equations(
        [
            oa.State("x", "v", start="y"),
            oa.State("v", "(u - c*v - k*x)/m", start="derivative of y"),
        ],
        [oa.Output("y", "x")],
        [oa.PhysicalParameter(name, at, min=0) for name, at in (("m", 1), ("c", 1), ("k", 12))],
        ["u"],
    )
    found = oa.diagnose(oa.estimate(record, motion, learner=None))
    assert found is not None and words in found.text


def test_no_interval_is_spoken_of_where_none_is_given():
    """Quadratic drag is missing, and the errors remember too long for standard errors."""
    rng, v, rows = np.random.default_rng(3), 10.0, []
    for target in np.repeat(rng.uniform(8, 33, 10), 60):
        force = 0.55 * (target - v)
        rows.append((force, v))
        v += 0.5 * (force - 0.0005 * v * v - 0.1)
    force, speed = np.array(rows).T
    record = oa.Record.from_arrays(
        u=force, y=speed + 0.05 * rng.normal(size=600), sampling_time=0.5
    )
    parameters = [oa.PhysicalParameter(name, at, min=0) for name, at in (("a", 0.8), ("r", 0.05))]
    motion = oa.Motion.from_equations(
        [oa.State("v", "a*u - r", start="y")], [oa.Output("y", "v")], parameters, ["u"]
    )
    found = oa.estimate(record, motion, learner=None).diagnose()
    texts = {warning.code: warning.text for warning in found.warnings}
    assert all(row.ci95 is None for row in found.parameters)
    assert texts["coloured_residual"].endswith("Missing physics may have moved the parameters.")
    assert texts.pop("too_long_memory").startswith("no standard errors and no intervals")
    assert not any("ntervals" in text for text in texts.values())


@pytest.mark.parametrize(
    ("moves", "text"),
    [
        ((0.1, -0.2), " With it the fit gives T 16.37 instead of 20, K 0.11 instead of 0.1."),
        ((0.1, -250.0), ""),
        ((0.1, 250.0), ""),
        ((0.1, 1e4), ""),
    ],
)
def test_a_step_of_a_logarithm_that_goes_too_far_gives_no_values(moves, text):
    """The values of a fit with a missing state were K 0 and T 5.571e-109."""
    problem = SimpleNamespace(
        names=("K", "T"), values_at=lambda theta: np.array([theta[0], np.exp(theta[1])])
    )
    values = np.array([0.1, 20.0])
    fit: Any = SimpleNamespace(problem=problem, values=values, theta=[0.1, np.log(20.0)])
    with_state: Any = SimpleNamespace(moves=(moves[0] / 10, moves[1]))
    assert _movement_text(fit, with_state) == text
