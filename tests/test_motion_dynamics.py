"""Motions as dynamics: integrators, holds, sensitivities, starts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import jax
import numpy as np
import pytest
import scipy.integrate
import scipy.signal

import orthaug as oa
import orthaug.fitting.segments as laid
from orthaug.data.expressions import parse_named
from orthaug.fitting.segments import build_segments, respond, sensitivity
from orthaug.models.dynamics import AutodiffDynamics, Numbers
from orthaug.models.learners import Bound, nothing_learned
from orthaug.models.moving import MotionDynamics
from orthaug.models.settling import Windows, settle
from orthaug.physics.guessed_motion import guess
from orthaug.physics.integrators import inputs_at_points

TS = 0.05
PARAMETERS = [oa.PhysicalParameter(n, v, min=0) for n, v in (("m", 1.3), ("c", 0.7), ("k", 9.0))]


def spring(**options) -> oa.Motion:
    learned = options.pop("learned", False)
    return oa.Motion.from_equations(
        states=[
            oa.State("x", "v", start="y"),
            oa.State("v", "(u - c*v - k*x)/m", start="derivative of y", learned=learned),
        ],
        outputs=[oa.Output("y", "x", learned=learned)],
        inputs=["u"],
        parameters=PARAMETERS,
        **options,
    )


def numbers(motion: oa.Motion, weights=()) -> Numbers:
    q = motion.coordinates.initial
    return Numbers(
        q, np.zeros_like(q), np.asarray(weights), np.zeros(2), np.ones(2), np.array([0.5, 0.1])
    )


@dataclass(frozen=True)
class Cubic:
    """A learner that is no network."""

    inputs = None

    def init(self, key, nz, ny):
        return {"linear": np.zeros((ny, nz)), "cubic": np.zeros((ny, nz))}

    def apply(self, tree, z):
        return tree["linear"] @ z + tree["cubic"] @ z**3


def with_learner(
    motion: oa.Motion, substeps: int, learner: oa.Learner | None = None
) -> tuple[MotionDynamics, Numbers]:
    features = tuple(parse_named(text, motion.known, "feature") for text in ("v", "x*u"))
    bound = Bound(learner or oa.MLP((3,)), 2, 2)
    weights = 0.3 * np.random.default_rng(0).normal(size=bound.size)
    return MotionDynamics(motion, features, bound, TS, substeps), numbers(motion, weights)


def record(rows: int = 60) -> oa.Record:
    rng = np.random.default_rng(1)
    return oa.Record.from_arrays(
        u=rng.normal(size=rows), y=0.1 * rng.normal(size=rows), sampling_time=TS
    )


def run(form: MotionDynamics, made: Numbers, data: oa.Record, start) -> np.ndarray:
    inputs = form.inputs(data.experiments[0], data)

    @jax.jit
    def states(made: Numbers, start, inputs):
        made = form.prepare(made)
        return jax.lax.scan(lambda x, row: (form.step(made, x, row)[0], x), start, inputs)[1]

    return np.asarray(states(made, np.asarray(start), inputs))


@pytest.mark.parametrize("hold", ["zero-order", "first-order"])
def test_an_exact_step_is_that_of_the_matrix_exponential(hold: str) -> None:
    motion, method = (
        spring(integrator="exact", hold=hold),
        {"zero-order": "zoh", "first-order": "foh"}[hold],
    )
    m, c, k = motion.initial
    a, b = np.array([[0, 1], [-k / m, -c / m]]), np.array([[0], [1 / m]])
    data = record()
    u = data.experiments[0].inputs[:, 0]
    ours = run(
        MotionDynamics(motion, (), nothing_learned(), TS, 1), numbers(motion), data, [0.3, -0.2]
    )
    if method == "zoh":
        ad, bd, *_ = scipy.signal.cont2discrete((a, b, np.eye(2), np.zeros((2, 1))), TS, "zoh")
        x = np.array([0.3, -0.2])
        for i in range(len(u)):
            np.testing.assert_allclose(ours[i], x, rtol=0, atol=1e-12)
            x = ad @ x + bd[:, 0] * u[i]
        return
    _, _, x = scipy.signal.lsim(
        (a, b, np.eye(2), np.zeros((2, 1))), u, TS * np.arange(len(u)), [0.3, -0.2]
    )
    np.testing.assert_allclose(ours, x, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("integrator", "substeps"), [("rk4", 6), ("exact", 3)])
def test_a_nonlinear_motion_under_a_spline_is_that_of_an_adaptive_integrator(
    integrator: str, substeps: int
) -> None:
    motion = oa.Motion.from_equations(
        states=[oa.State("x", "v"), oa.State("v", "u - 0.4*v - k*x - 3*x**3")],
        outputs=[oa.Output("y", "x")],
        inputs=["u"],
        parameters=[oa.PhysicalParameter("k", 4.0)],
        integrator=integrator,
        hold="spline",
    )
    time = TS * np.arange(80)
    data = oa.Record.from_arrays(u=np.sin(3 * time), y=np.zeros(80), sampling_time=TS)
    ours = run(
        MotionDynamics(motion, (), nothing_learned(), TS, substeps),
        numbers(motion),
        data,
        [0.5, 0.0],
    )

    def rates(t, x):
        return [x[1], np.sin(3 * t) - 0.4 * x[1] - 4 * x[0] - 3 * x[0] ** 3]

    exact = scipy.integrate.solve_ivp(
        rates, (0, time[-1]), [0.5, 0.0], t_eval=time, rtol=1e-11, atol=1e-12
    ).y.T
    np.testing.assert_allclose(ours, exact, rtol=0, atol=1e-5)


def test_inputs_between_samples() -> None:
    u = np.cumsum(np.random.default_rng(2).normal(size=(7, 2)), axis=0)
    assert np.array_equal(inputs_at_points(u, "zero-order", 3), u)
    np.testing.assert_array_equal(inputs_at_points(u, "first-order", 3)[2], [*u[2], *u[3]])
    spline = inputs_at_points(u, "spline", 2).reshape(7, 5, 2)
    np.testing.assert_allclose(spline[:, 0], u, atol=1e-12)
    np.testing.assert_allclose(spline[:-1, -1], u[1:], atol=1e-12)


@pytest.mark.parametrize(
    ("substeps", "hold", "learner"),
    [
        (1, "zero-order", oa.MLP((3,))),
        (2, "spline", oa.MLP((3,))),
        (5, "first-order", oa.MLP((3,))),
        (1, "zero-order", oa.MLP((16, 16), "relu")),  # so many slopes that stages are a loop
        (3, "spline", oa.MLP(())),
        (2, "zero-order", Cubic()),
    ],
)
def test_the_adjoint_of_the_stages_gives_the_derivatives(
    substeps: int, hold: str, learner: oa.Learner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one expression, and as a loop where the learner is large."""
    form, made = with_learner(spring(integrator="rk4", hold=hold, learned=True), substeps, learner)
    rng = np.random.default_rng(3)
    points = {"zero-order": 1, "first-order": 2, "spline": 2 * substeps + 1}[hold]
    state, inputs = rng.normal(size=(2, 5)), rng.normal(size=(points, 5))
    given = (made, state, inputs)
    plain = jax.jit(partial(AutodiffDynamics.local, form))(*given)
    for largest in (1000, 0):
        monkeypatch.setattr("orthaug.models.motion_field._LARGE", largest)
        ours = jax.jit(partial(type(form).local, form))(*given)
        for one, other in zip(ours, plain, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("integrator", ["rk4", "exact", "discrete"])
def test_sensitivities_over_segments_are_those_of_forward_differentiation(integrator: str) -> None:
    motion = spring(integrator=integrator, learned=True)
    if integrator == "discrete":
        states = [replace(motion.states[0], derivative="x + 0.05*v")]
        states.append(replace(motion.states[1], derivative="v + 0.05*(u - c*v - k*x)/m"))
        motion = replace(motion, states=tuple(states))
    form, made = with_learner(motion, 1)
    data = record(40)
    segments = build_segments(data, form, 20, 0)
    states = np.asarray(segments.start) + 0.1
    gram = np.asarray(sensitivity(form, made, segments, states, np.eye(1)).shared)

    def errors(unknowns):
        own = made._replace(theta=unknowns[:3], weights=unknowns[3:])
        left = segments.target - respond(form, own, segments, states)
        return jax.numpy.where(segments.scored[:, :, None], left, 0.0).ravel()

    unknowns = np.concatenate([made.theta, made.weights])
    jacobian = -np.asarray(jax.jacfwd(errors)(unknowns))
    columns = np.column_stack([jacobian, np.asarray(errors(unknowns))])
    np.testing.assert_allclose(gram, columns.T @ columns, rtol=1e-8, atol=1e-10)


def test_sensitivities_of_steps_at_once_are_those_step_by_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    form, made = with_learner(spring(learned=True), 1)
    segments = build_segments(record(40), form, 19, 3)
    given = (form, made, segments, segments.start, np.array([[2.0]]))
    entries = []
    for block, fewest in (
        (1 << 15, 1),
        (8 * 3 * (2 + form.unknowns) * segments.scored.shape[2], 8),
        (1, 8),
    ):
        monkeypatch.setattr(
            laid, "_BLOCK", block
        )  # one block; three, the last of which is not full; no blocks
        monkeypatch.setattr(laid, "_FEWEST", fewest)
        entries.append(sensitivity.__wrapped__(*given))
    for other in entries[1:]:
        np.testing.assert_allclose(other.shared, entries[0].shared, rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(other.own, entries[0].own, rtol=1e-11, atol=1e-12)


def test_a_start_is_guessed_and_then_settled() -> None:
    motion = spring()
    form, made = MotionDynamics(motion, (), nothing_learned(), TS, 1), numbers(motion)
    data = record(64)
    truth = run(form, made, data, [0.4, -1.0])
    guessed = guess(motion, truth[:, :1], [0, 30], TS)
    assert np.abs(guessed[1] - truth[30]).max() < 0.1
    inputs = form.inputs(data.experiments[0], data)
    windows = Windows(inputs[..., None], truth[:, :1, None], np.ones((64, 1), dtype=bool))
    settled, misfit = settle(form, made, guessed[:1].T, windows, np.eye(1), np.full(2, 1e3))
    np.testing.assert_allclose(settled[:, 0], [0.4, -1.0], atol=1e-6)
    assert misfit[0] < 1e-7  # what the distance from the guess costs


def test_a_start_that_no_row_shows_stays_where_it_was_guessed() -> None:
    motion = oa.Motion.from_equations(
        states=[oa.State("x", "-a*x + u", start="y"), oa.State("z", "-z", start=2.0)],
        outputs=[oa.Output("y", "x")],
        inputs=["u"],
        parameters=[oa.PhysicalParameter("a", 1.0)],
    )
    form, data = MotionDynamics(motion, (), nothing_learned(), TS, 1), record(20)
    made = numbers(motion)
    inputs, outputs = form.inputs(data.experiments[0], data), data.experiments[0].outputs
    windows = Windows(inputs[..., None], outputs[..., None], np.ones((20, 1), dtype=bool))
    settled, _ = settle(form, made, np.array([[0.0], [2.0]]), windows, np.eye(1), np.full(2, 1e3))
    assert settled[1, 0] == pytest.approx(2.0, abs=1e-12)
