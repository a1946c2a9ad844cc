"""Linear views against python-control, finite differences and systems that are known, and what is refused."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import control
import numpy as np
import pytest
import scipy.linalg
from scipy.signal import lfilter
from test_cli import one_line, run
from test_surface import WRONG, tried

import orthaug as oa
from orthaug import InputError
from orthaug.analysis.linear_system import System, convert_to_continuous, modes_of, observer_form
from orthaug.analysis.measured_response import measured_response
from orthaug.data.expressions import Lag
from orthaug.models.stepping import Memory
from orthaug.reports.linear_text import linear_text

estimate = partial(oa.estimate, standard_errors="plain")  # robust ones are asked for here

STEP = 0.05
EXACT = {"rtol": 1e-10, "atol": 1e-12}


def two_by_two(rows: int = 400) -> oa.Record:
    """Two inputs, two outputs that feel each other; the second input comes late."""
    rng = np.random.default_rng(3)
    u, y = rng.normal(size=(rows, 2)), np.zeros((rows, 2))
    for k in range(4, rows):
        y[k, 0] = (
            1.4 * y[k - 1, 0]
            - 0.6 * y[k - 2, 0]
            + 0.1 * y[k - 1, 1]
            + 0.5 * u[k, 0]
            + 0.2 * u[k - 4, 1]
        )
        y[k, 1] = 0.7 * y[k - 1, 1] - 0.2 * y[k - 1, 0] + 0.3 * u[k - 3, 1]
    y += 0.01 * rng.normal(size=y.shape)
    channels = {
        "inputs": [oa.Channel("u", "V"), oa.Channel("w", "N")],
        "outputs": [oa.Channel("y", "m"), oa.Channel("q", "m")],
    }
    return oa.Record.from_arrays(u, y, sampling_time=STEP, **channels)


@pytest.fixture(scope="module")
def linear() -> oa.Estimate:
    rows = [
        ("y", ("y[k-1]", "y[k-2]", "q[k-1]", "u[k]", "w[k-4]")),
        ("q", ("q[k-1]", "y[k-1]", "w[k-3]")),
    ]
    terms = [
        oa.Term(f"{out}{i}", r, output=out)
        for out, regressors in rows
        for i, r in enumerate(regressors)
    ]
    return estimate(two_by_two(), oa.Baseline.from_terms(terms), learner=None)


@pytest.fixture(scope="module")
def cubic() -> oa.Estimate:
    """A cubic term that a learner of terms holds: rests at three points without input."""
    rng = np.random.default_rng(0)
    u, y = 0.5 * rng.normal(size=800), np.zeros(800)
    for k in range(1, 800):
        y[k] = 1.2 * y[k - 1] - 0.2 * y[k - 1] ** 3 + 0.3 * u[k - 1] + 0.02 * rng.normal()
    baseline = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]")])
    record = oa.Record.from_arrays(u, y, sampling_time=STEP, inputs=["u"], outputs=["y"])
    return estimate(record, baseline, learner=oa.Terms(["y[k-1]**3"]))


@pytest.fixture(scope="module")
def pendulum() -> oa.MotionEstimate:
    """A pendulum under a torque, fitted without a learner."""
    motion = oa.Motion.from_equations(
        states=[
            oa.State("angle", "rate", start="q", unit="rad"),
            oa.State("rate", PENDULUM, start=0.0, unit="rad/s"),
        ],
        outputs=[oa.Output("q", "angle")],
        inputs=["torque"],
        parameters=[
            oa.PhysicalParameter(n, v, min=0) for n, v in (("J", 1.0), ("d", 0.5), ("g", 9.0))
        ],
        integrator="rk4",
        substeps=1,
    )
    rng = np.random.default_rng(1)
    torque = np.repeat(rng.normal(0, 1.5, 40), 10)
    x, q = np.array([0.1, 0.0]), np.zeros(400)
    for k, u in enumerate(torque):
        q[k] = x[0]
        x = _runge_kutta(
            lambda x, u=u: np.array([x[1], u - 0.5 * x[1] - 9 * np.sin(x[0])]), x, STEP
        )
    record = oa.Record.from_arrays(
        torque,
        q + 0.01 * rng.normal(size=400),
        sampling_time=STEP,
        inputs=["torque"],
        outputs=["q"],
    )
    return estimate(record, motion, learner=None)


PENDULUM = "(torque - d*rate - g*sin(angle))/J"


def _runge_kutta(field, x, h):
    k1 = field(x)
    k2 = field(x + h / 2 * k1)
    k3 = field(x + h / 2 * k2)
    return x + h / 6 * (k1 + 2 * (k2 + k3) + field(x + h * k3))


def test_linear_physics_is_the_system_of_python_control(linear):
    view = oa.linearize(linear.model)[0]
    theta = dict(zip(linear.problem.baseline.names, linear.theta, strict=True))
    z = control.tf([1.0, 0.0], [1.0], STEP)
    lag = 1 / z
    a11, a12 = theta["y0"] * lag + theta["y1"] * lag**2, theta["y2"] * lag
    a21, a22 = theta["q1"] * lag, theta["q0"] * lag
    b = [[theta["y3"], theta["y4"] * lag**4], [0, theta["q2"] * lag**3]]
    frequency = view.bode.frequency[::40]
    ours = view.system.response(np.exp(2j * np.pi * frequency * STEP)).value
    for found, w in zip(ours, np.exp(2j * np.pi * frequency * STEP), strict=True):
        left = np.eye(2) - np.array([[a11(w), a12(w)], [a21(w), a22(w)]])
        right = np.array([[x if np.isscalar(x) else x(w) for x in line] for line in b])
        np.testing.assert_allclose(found, np.linalg.solve(left, right), **EXACT)
    theirs = view.to_control()
    assert theirs.state_labels == list(linear.model.state_names) and theirs.dt == STEP
    np.testing.assert_allclose(view.gain, theirs.dcgain(), **EXACT)
    with np.errstate(all="ignore"):
        rates, dampings, poles = theirs.damp()
    assert view.at_zero == np.sum(np.abs(poles) < 1e-9) == 4  # w is remembered for four samples
    assert len(view.poles) == 3 and len({pole.z for pole in view.poles}) == 3
    for pole in view.poles:
        i = int(np.argmin(np.abs(poles - pole.z)))
        assert pole.z == pytest.approx(poles[i], rel=1e-10)
        assert pole.natural_frequency == pytest.approx(rates[i], rel=1e-10)
        assert pole.damping == pytest.approx(dampings[i], rel=1e-10)


def test_a_view_counts_its_parts_in_words(pendulum):
    shown = repr(oa.linearize(pendulum)[0])
    assert ": 2 states, 1 input, 1 output, 2 poles)" in shown


def test_the_entries_of_physics_alone_have_the_intervals_of_theta(linear):
    view = oa.linearize(linear.model)[0]
    columns = {name: i for i, name in enumerate((*view.states, "u", "w"))}
    band = view.matrix_ci95[columns["q[k-1]"]]
    table = linear.parameters
    for name, lag in (("q0", "q[k-1]"), ("q1", "y[k-1]"), ("q2", "w[k-3]")):
        expected = table.loc[name, ["ci95_low", "ci95_high"]].to_numpy(dtype=float)
        np.testing.assert_allclose(band[columns[lag]], expected, rtol=1e-8)
    shifts = view.matrix_ci95[columns["w[k-2]"], columns["w[k-1]"]]
    assert list(shifts) == [1.0, 1.0]


def test_robust_intervals_of_physics_alone_are_those_of_its_entries(linear):
    robust = linear.robust()
    view = oa.linearize(robust)[0]
    columns = {name: i for i, name in enumerate((*view.states, "u", "w"))}
    expected = robust.parameters.loc["q0", ["ci95_low", "ci95_high"]].to_numpy(dtype=float)
    band = view.matrix_ci95[columns["q[k-1]"], columns["q[k-1]"]]
    np.testing.assert_allclose(band, expected, rtol=1e-8)


def test_a_fit_without_standard_errors_has_no_bands(linear):
    found = oa.linearize(replace(linear, covariance=None, std_kind="none"))
    assert found[0].matrix_ci95 is None
    assert [one.code for one in found.warnings] == ["no_intervals"]


def test_derivatives_are_those_of_finite_differences(cubic):
    """Everything is computed again with θ and weights moved, the equilibrium with them."""
    model, at = cubic.model, {"u": 0.4}
    frequency = np.array([0.5, 3.0])
    view = oa.linearize(model, at, frequencies=frequency)[0]
    root = model.statistics.joint(len(model.theta)).root()
    found = view.system.response(np.exp(2j * np.pi * frequency * STEP))
    gain = view.system.gain()
    for j in range(root.shape[1]):
        sides = []
        for sign in (-1, 1):
            p = np.concatenate([model.theta, model.numbers.weights]) + sign * 1e-3 * root[:, j]
            numbers = model.numbers._replace(
                theta=p[: len(model.theta)], weights=p[len(model.theta) :]
            )
            sides.append(
                oa.linearize(replace(model, numbers=numbers), at, frequencies=frequency)[0]
            )
        low, high = sides
        moved = (high.system.matrix - low.system.matrix) / 2e-3
        np.testing.assert_allclose(view.system.moved[j], moved, rtol=1e-4, atol=1e-9)
        np.testing.assert_allclose(
            found.moved[:, j], (high.bode.value - low.bode.value) / 2e-3, rtol=1e-4, atol=1e-9
        )
        np.testing.assert_allclose(
            gain.moved[0, j], (high.gain - low.gain) / 2e-3, rtol=1e-4, atol=1e-9
        )
        pole = (high.poles[0].z - low.poles[0].z) / 2e-3
        assert view.system.modes.moved[0][j] == pytest.approx(pole, rel=1e-4, abs=1e-9)


def test_all_equilibria_are_found_and_reported(cubic):
    found = oa.linearize(cubic.model)
    rests = sorted(view.point.values["y"] for view in found)
    a, c = (
        1 - oa.linearize(cubic.model, "y = 0, u = 0")[0].a[0, 0],
        float(cubic.terms["coefficient"].iloc[0]),
    )
    np.testing.assert_allclose(rests, [-np.sqrt(a / c), 0.0, np.sqrt(a / c)], rtol=1e-6, atol=1e-9)
    assert [view.stable for view in found] == [False, True, True]
    assert found[0].poles[0].damping == -1 and found[0].poles[0].time_constant is None
    assert [warning.code for warning in found.warnings] == ["several_equilibria"]
    with pytest.raises(InputError, match="there are 3 operating points; take one"):
        found.to_control()
    assert "operating point 1 of 3: u = 0, y = 0 (not stable)" in linear_text(found)


def test_an_output_may_be_fixed_and_its_input_found(cubic):
    view = oa.linearize(cubic.model, "y = 0.5")[0]
    model = cubic.model
    state, y = model.step([0.5, view.point.inputs[0]], [0.0])
    assert float(y[0]) == pytest.approx(0.5, abs=1e-9)
    with pytest.raises(InputError, match="the model does not rest at y = 0.5, u = 0: y would move"):
        oa.linearize(model, {"y": 0.5, "u": 0})


def test_a_motion_has_the_matrices_of_its_equations(pendulum):
    values = pendulum.model.parameters
    found = oa.linearize(pendulum.model, "torque = 0")
    view = next(view for view in found if abs(view.point.values["angle"]) < 1e-9)
    a = np.array([[0.0, 1.0], [-values["g"] / values["J"], -values["d"] / values["J"]]])
    b = np.array([[0.0], [1 / values["J"]]])
    np.testing.assert_allclose(view.continuous.system.a, a, **EXACT)
    np.testing.assert_allclose(view.continuous.system.b, b, **EXACT)
    s = max(np.linalg.eigvals(a), key=lambda value: value.imag)
    pole = view.poles[0]
    assert pole.natural_frequency == pytest.approx(abs(s), rel=1e-10)
    assert pole.damping == pytest.approx(-s.real / abs(s), rel=1e-10)
    h = STEP  # one step of Runge and Kutta is the exponential's series to the fourth power
    series = sum(np.linalg.matrix_power(a * h, i) / np.prod(range(1, i + 1)) for i in range(5))
    np.testing.assert_allclose(view.a, series, **EXACT)
    low, high = view.gain_ci95[0, 0]
    assert low < view.gain[0, 0] < high and view.gain[0, 0] == pytest.approx(
        1 / values["g"], rel=1e-9
    )
    upright = oa.linearize(pendulum.model, {"angle": np.pi})
    assert not upright[0].stable and abs(upright[0].point.inputs[0]) < 1e-9


def test_holds_and_discrete_motions_give_the_same_response(pendulum):
    """A first-order hold rewrites the step, whose response is that of its own sines."""
    model = pendulum.model
    form = replace(model.form, motion=replace(model.form.motion, hold="first-order"))
    held = replace(model, form=form)
    view = oa.linearize(held, "angle = 0", frequencies=[1.0])[0]
    assert [warning.code for warning in view.warnings] == ["shifted_states"]
    a = view.continuous.system.a
    w = 2 * np.pi
    n, z = 2, np.exp(1j * w * STEP)
    block = np.zeros((4, 4))
    block[:2, :2], block[:2, 2:3], block[2, 3] = a * STEP, view.continuous.system.b * STEP, 1.0
    whole = scipy.linalg.expm(block)
    now, ramp = whole[:n, 2], whole[:n, 3]
    x = np.linalg.solve(z * np.eye(n) - whole[:n, :n], now + ramp * (z - 1))
    assert view.bode.value[0, 0, 0] == pytest.approx(
        x[0], rel=1e-4
    )  # Runge-Kutta against the exponential
    spline = replace(model, form=replace(form, motion=replace(form.motion, hold="spline")))
    found = oa.linearize(spline, "angle = 0", frequencies=[1.0])
    assert [warning.code for warning in found.warnings] == ["hold_replaced"]
    np.testing.assert_array_equal(found[0].a, view.a)
    exact = view.to_control("continuous")(1j * w)
    assert (
        found[0].bode.value[0, 0, 0] == pytest.approx(exact, rel=1e-10)
        and view.bode.value[0, 0, 0] != exact
    )


def test_continuous_time_gives_the_sampled_system_back(linear):
    view = oa.linearize(linear.model)[0]
    assert list(view.continuous.dead_time) == pytest.approx([0.0, 2 * STEP])
    small, dead = observer_form(view.system, linear.model.filtering[0].memory)
    assert small.states < view.system.states and list(dead) == [0, 2]
    z = np.exp(2j * np.pi * view.bode.frequency[::50] * STEP)
    late = np.stack([z**-count for count in dead], axis=-1)[:, None]
    np.testing.assert_allclose(
        small.response(z).value * late, view.system.response(z).value, **EXACT
    )
    back = control.c2d(view.to_control("continuous"), STEP, "zoh")
    np.testing.assert_allclose(np.hstack([back.A, back.B]), small.matrix[: small.states], atol=1e-9)
    tustin = oa.linearize(linear.model, continuous="tustin")[0].continuous
    s = 2 / STEP * (z - 1) / (z + 1)
    response = tustin.system.response(s).value * late
    np.testing.assert_allclose(response, view.system.response(z).value, rtol=1e-9, atol=1e-12)


def test_a_hold_is_undone_with_its_dead_time():
    plant = control.ss([[0.0, 1.0], [-40.0, -3.0]], [[0.0], [40.0]], [[1.0, 0.0]], [[0.0]])
    sampled = control.ss2tf(control.c2d(plant, STEP, "zoh"))
    b, a = sampled.num[0][0], sampled.den[0][0]
    memory = Memory.of((Lag("y", 1), Lag("y", 2), Lag("u", 4), Lag("u", 5)), ["y"], ["u"])
    n = len(memory.lags)
    matrix = np.zeros((n + 1, n + 1))
    row = {"y[k-1]": -a[1], "y[k-2]": -a[2], "u[k-4]": b[-2], "u[k-5]": b[-1]}
    for i, target in enumerate(memory.following):
        if target >= 2:
            matrix[i, target - 2] = 1.0
        elif target == 1:
            matrix[i, n] = 1.0
    matrix[n, :n] = [row.get(name, 0.0) for name in memory.names]
    matrix[0] = matrix[n]
    found = convert_to_continuous(System(matrix, n, STEP), "zoh", memory, memory.names)
    assert not isinstance(found, str) and list(found.dead_time) == pytest.approx([3 * STEP])
    s = 2j * np.pi * np.array([0.1, 1.0, 5.0])
    np.testing.assert_allclose(found.system.response(s).value[:, 0, 0], plant(s), rtol=1e-8)
    matrix[0, :2] = matrix[n, :2] = -0.3, 0.1
    result = convert_to_continuous(System(matrix, n, STEP), "zoh", memory, memory.names)
    assert isinstance(result, str) and "a real pole below 0 (-0.5)" in result


def test_poles_of_a_shift_register_are_zero_exactly_and_double_poles_have_no_derivative():
    chain = np.diag(np.ones(9), -1)
    chain[0, 0] = 0.5
    found = modes_of(chain, None)
    assert found.at_zero == 9 and found.values == pytest.approx([0.5], abs=1e-13)
    double = np.array([[0.5, 1.0], [0.0, 0.5]])
    assert modes_of(double, np.ones((1, 2, 2))).moved == (None, None)


def test_data_alone_tell_the_response_by_windows_and_by_periods(linear):
    record = two_by_two(20_000)
    measured = measured_response(record)
    model = oa.linearize(linear.model, frequencies=measured.frequency)[0]
    ratio = measured.value / model.bode.value
    assert measured.method == "Welch" and np.median(np.abs(ratio - 1)) < 0.02
    assert oa.linearize(linear.model, record=record).agreement(model).decibel < 0.2
    rng = np.random.default_rng(0)
    u = np.tile(rng.normal(size=300), 5)
    y = lfilter([0.0, 0.4], [1.0, -0.8], u)
    periodic = measured_response(oa.Record.from_arrays(u, y, sampling_time=STEP))
    z = np.exp(2j * np.pi * periodic.frequency * STEP)
    assert periodic.method == "periods" and periodic.averages == 4
    np.testing.assert_allclose(periodic.value[:, 0, 0], 0.4 / (z - 0.8), rtol=1e-9)


def test_what_has_no_linear_view_is_said(linear, cubic):
    steps = np.repeat(np.random.default_rng(0).normal(size=40), 10)
    position = np.cumsum(steps)
    record = oa.Record.from_arrays(steps, position, inputs=["u"], outputs=["y"])
    terms = [oa.Term("b", "u[k]")]
    integrator = oa.Baseline.from_terms([oa.Term("one", "y[k-1]", fixed=True, initial=1.0), *terms])
    model = estimate(record, integrator, learner=None).model
    view = oa.linearize(model)
    assert view[0].gain is None and view.warnings[0].code == "continuum_of_equilibria"
    assert "a pole at 1 integrates" in linear_text(view)
    with pytest.raises(
        InputError,
        match="no equilibrium was found at u = 1, from 33 starts: either the model integra",
    ):
        oa.linearize(model, "u = 1")
    for at, message in (
        ("fource = 1", "the model has no 'fource'; known are u, w, y, q"),
        ("uu = 1", "the model has no 'uu', did you mean 'u'"),
        ("u", "must be names with finite numbers, such as"),
        ("u = x", "must be names with finite numbers, .*got 'u' = 'x'"),
        ("u = 1, u = 2", "gives 'u' twice"),
        ({"u": np.nan}, "must be names with finite numbers"),
        (3, "must be names with finite numbers"),
    ):
        with pytest.raises(InputError, match=message):
            oa.linearize(linear.model, at)
    for options, message in (
        (
            {"frequencies": [0.0]},
            r"`frequencies` must be numbers above 0 up to half the sampling rate, 10 Hz",
        ),
        ({"continuous": "foh"}, "`continuous` must be one of zoh, tustin; got 'foh'"),
        ({"record": two_by_two().rows}, "`record` must be a Record"),
    ):
        with pytest.raises(InputError, match=message):
            oa.linearize(linear.model, **options)
    with pytest.raises(InputError, match="`model` must be a fitted model"):
        oa.linearize("model")
    view = oa.linearize(cubic.model, "y = 9")
    assert view[0].point.outside and view.warnings[0].code == "outside_training"


def test_dry_friction_at_rest_is_no_line():
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=300), np.zeros(300)
    for k in range(1, 300):
        y[k] = 0.8 * y[k - 1] - 0.2 * np.sign(y[k - 1]) + u[k - 1]
    baseline = oa.Baseline.from_terms(
        [oa.Term(n, r) for n, r in (("a", "y[k-1]"), ("f", "sign(y[k-1])"), ("b", "u[k-1]"))]
    )
    model = estimate(oa.Record.from_arrays(u, y), baseline, learner=None).model
    assert [warning.code for warning in oa.linearize(model, "u = 0, y = 0")[0].warnings] == ["kink"]
    assert not oa.linearize(model, "y = 2")[0].warnings


def test_steep_friction_depends_on_the_amplitude_and_is_said_with_figures():
    rng = np.random.default_rng(0)
    force, speed = rng.normal(size=600), np.zeros(600)
    for k in range(1, 600):
        speed[k] = 0.9 * speed[k - 1] - 0.02 * np.tanh(speed[k - 1] / 0.05) + force[k - 1]
    terms = (("a", "y[k-1]"), ("f", "tanh(y[k-1]/0.05)"), ("b", "u[k-1]"))
    physics = oa.Baseline.from_terms([oa.Term(name, text) for name, text in terms])
    record = oa.Record.from_arrays(force, speed + 1e-3 * rng.normal(size=600), sampling_time=STEP)
    model = estimate(record, physics, learner=None).model
    (warning,) = oa.linearize(model, "u = 0, y = 0")[0].warnings
    assert warning.code == "amplitude_dependent"
    a, f, _ = model.theta
    slope = {"rest": a + f / 0.05, "data": a + f * np.sqrt(2 / np.pi) / speed.std()}
    poles = {where: np.log(value) / STEP for where, value in slope.items()}
    found = re.search(
        "it has a real pole at ([^ ]+) 1/s, at the operating point a real pole at ([^ ]+) 1/s",
        warning.text,
    )
    assert float(found[1]) == pytest.approx(poles["data"], rel=0.02)
    assert float(found[2]) == pytest.approx(poles["rest"], rel=0.02)
    assert not oa.linearize(model, "y = 2")[0].warnings


def test_the_damping_of_a_motion_with_steep_friction_is_that_of_small_movements_only():
    def motion(friction: str) -> oa.Motion:
        return oa.Motion.from_equations(
            states=[
                oa.State("x", "v", start="y"),
                oa.State("v", f"u - c*v - 60*x - {friction}", start=0.0),
            ],
            outputs=[oa.Output("y", "x")],
            inputs=["u"],
            parameters=[oa.PhysicalParameter("c", 1.1), oa.PhysicalParameter("F", 0.3)],
            integrator="rk4",
            substeps=4,
        )

    force, x = np.repeat(np.random.default_rng(0).normal(0, 4, 40), 10), np.zeros(2)
    moved = np.zeros(len(force))
    for k, u in enumerate(force):
        moved[k] = x[0]
        for _ in range(4):
            x = _runge_kutta(
                lambda x, u=u: np.array(
                    [x[1], u - 1.1 * x[1] - 60 * x[0] - 0.3 * np.tanh(x[1] / 0.02)]
                ),
                x,
                STEP / 4,
            )
    record = oa.Record.from_arrays(force, moved, sampling_time=STEP)
    steps = oa.LevenbergMarquardt(2)  # from the true values
    model = estimate(record, motion("F*tanh(v/0.02)"), learner=None, solver=steps).model
    (warning,) = oa.linearize(model, "u = 0")[0].warnings
    speed = np.sqrt(60) * moved.std()
    damping = (1.1 + 0.3 * np.sqrt(2 / np.pi) / speed) / (2 * np.sqrt(60))
    found = re.search("it has damping ([^ ]+) at 1.23 Hz", warning.text)
    assert float(found[1]) == pytest.approx(damping, rel=0.05)
    mild = replace(model, form=replace(model.form, motion=motion("F*tanh(v/50)")))
    assert not oa.linearize(mild, "u = 0")[0].warnings


def test_without_a_joint_covariance_the_learner_is_frozen_or_nothing_is_reported(linear, cubic):
    ensemble = replace(cubic, model=replace(cubic.model, statistics=type(cubic.model.statistics)()))
    frozen = oa.linearize(ensemble, "y = 0")
    assert [warning.code for warning in frozen.warnings] == ["learner_frozen"] and frozen[
        0
    ].gain_ci95 is not None
    bare = oa.linearize(ensemble.model, "y = 0")
    assert [warning.code for warning in bare.warnings] == ["no_intervals"]
    assert bare[0].gain_ci95 is None and bare[0].bode.magnitude_ci95 is None
    outer = oa.orthogonalize(
        linear.problem.record, linear.problem.baseline, lambda x: x @ np.full((x.shape[1], 2), 0.1)
    )
    by_differences = oa.linearize(outer.model, "u = 0, w = 0")
    assert [warning.code for warning in by_differences.warnings] == ["no_intervals"]
    assert by_differences[0].d[0, 0] == pytest.approx(0.1, rel=1e-6)


def test_the_command_writes_numbers_a_page_and_figures(cubic, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    oa.save(cubic.model, "model")
    (experiment,) = cubic.problem.record.experiments
    rows = np.hstack([experiment.inputs, experiment.outputs])
    np.savetxt("run.csv", rows, delimiter=",", header="u,y", comments="")
    done = run("linearize", "model", "--at", "y = 0.5", "--data", "run.csv", "--out", "linear")
    assert (
        done.code == 0
        and "against data alone (Welch's spectra" in done.out
        and "written to linear" in done.out
    )
    result = json.loads((tmp_path / "linear/result.json").read_text())
    assert result["points"][0]["outputs"]["y"] == pytest.approx(0.5)
    assert result["held"] == "found" and len(result["points"][0]["frequency"]) == 400
    assert (tmp_path / "linear/linear.txt").read_text().strip() in done.out
    for name in ("bode", "poles"):
        assert (tmp_path / f"linear/figures/{name}.png").stat().st_size > 5000
    assert run("linearize", "model", "--out", "bode.svg").code == 0
    assert (tmp_path / "bode.svg").read_text().startswith("<?xml")
    again = run("linearize", "model", "--json")
    assert json.loads(again.out)["points"][0]["at"]["u"] == 0


def test_bad_arguments_end_in_words_and_nothing_is_written(cubic, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    oa.save(cubic.model, "model")
    changed = json.loads((tmp_path / "model/model.json").read_text()) | {
        "format": 99,
        "orthaug": "9.0",
    }
    oa.save(cubic.model, "newer")
    (tmp_path / "newer/model.json").write_text(json.dumps(changed))
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs/mine.txt").write_text("x")
    before = sorted(map(str, tmp_path.rglob("*")))
    for arguments, words in (
        (["model", "--at", "forse=0"], ["the model has no 'forse'"]),
        (["model", "--at", "y=0.5, u=0"], ["does not rest at"]),
        (["model", "--continuous", "foh"], ["must be one of zoh, tustin"]),
        (["newer"], ["written by orthaug 9.0 in format 99", "Update orthaug"]),
        (["absent"], ["no saved model there"]),
        (["model", "--out", "theirs"], ["theirs", "mine.txt", "--force"]),
        (["model", "--out", "theirs/mine.txt"], ["found the ending '.txt'"]),
        (["model", "--out", "model/bode.png"], ["is inside of", "model"]),
        (["model", "--out", "gone/bode.png"], ["cannot be written", "no folder gone"]),
        (["model", "--out", "."], ["holds"]),
        (["model", "--data", "absent.csv"], ["absent.csv", "no such file"]),
    ):
        done = run("linearize", *arguments)
        assert (done.code, done.out) == (2, ""), arguments
        assert one_line(done.err, "error: ", *words), (arguments, done.err)
        assert sorted(map(str, tmp_path.rglob("*"))) == before


def test_the_example_of_silverbox_gives_its_resonance(data_folder, tmp_path, monkeypatch):
    monkeypatch.setenv("ORTHAUG_DATA", str(data_folder))
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "examples"))
    import silverbox_bode

    found = silverbox_bode.main(tmp_path)
    resonance = found[0].poles[0]
    low, high = resonance.hertz_ci95
    assert 67.8 < low < resonance.hertz < high < 68.8 and high - low < 0.2
    assert 0.04 < resonance.damping < 0.055
    assert found.measured.method == "Welch" and found.agreement(found[0]).decibel < 0.5
    assert (tmp_path / "silverbox_bode.png").stat().st_size > 10_000


def test_whatever_is_given_ends_in_words(cubic):
    model = cubic.model
    for name, least in (("at", 20), ("record", 20), ("frequencies", 14), ("continuous", 20)):
        assert (
            tried(lambda value, name=name: oa.linearize(model, **{"at": {"y": 0.5}, name: value}))
            >= least
        ), name
    assert tried(oa.linearize) == len(WRONG)
    view = oa.linearize(model, "y = 0.5", frequencies=[1.0])
    assert tried(view.to_control) == len(WRONG)
    with pytest.raises(InputError, match="`kind` must be one of bode, poles; got 'residual'"):
        oa.plot(view, "residual")


def test_a_static_gain_that_is_rounding_is_zero():
    """A capacitor in the loop: no current flows at rest."""
    rng = np.random.default_rng(3)
    u, x, y = np.repeat(rng.uniform(-5, 5, 60), 20), np.zeros(2), []
    for value in u:
        y.append(x)
        for _ in range(10):
            i, v = x
            x = x + 2e-6 * np.array([(value - v - 2 * i) / 4e-3, i / 22e-6])
    motion = oa.Motion.from_equations(
        [oa.State("i", "(u - v - R*i)/L", start="il"), oa.State("v", "i/22e-6", start="uc")],
        [oa.Output("uc", "v"), oa.Output("il", "i")],
        [oa.PhysicalParameter("R", 1.0, min=0), oa.PhysicalParameter("L", 3e-3, min=0)],
        ["u"],
    )
    noisy = np.array(y) * (1 + 1e-2 * rng.normal(size=(1200, 2)))
    record = oa.Record.from_arrays(u, noisy, sampling_time=2e-5, outputs=["uc", "il"])
    gain = oa.linearize(estimate(record, motion, learner=None).model)[0].gain
    assert gain[0, 0] == pytest.approx(1, abs=1e-9) and gain[1, 0] == 0
