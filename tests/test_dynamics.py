"""Dynamics of both kinds: the lagged form's own derivatives, and any state and step, here a linear state space."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from orthaug import MLP, Baseline, Lags, Record, Term
from orthaug.fitting.segments import build_segments, respond, sensitivity
from orthaug.models.dynamics import AutodiffDynamics, Dynamics, Numbers, Parts
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.learners import Bound
from orthaug.physics.problem import pose

# --- the lagged form


@dataclass(frozen=True)
class Generic(AutodiffDynamics, LaggedDynamics):
    """The lagged form by automatic differentiation of its step."""


ONE = [
    Term("a", "y1[k-1]"),
    Term("b", "y1[k-3]"),
    Term("g", "sin(u1[k-1])"),
    Term("d", "y1[k-2]", 0.2, fixed=True),
]
TWO = [
    Term("a", "y1[k-1]", output="y1"),
    Term("a", "y2[k-2]", output="y2"),
    Term("b", "y1[k-1]*u1[k]", output="y2"),
]
FORMS = {
    "one output": (1, ONE, None, MLP(hidden=(3,))),
    "two outputs": (2, TWO, Lags(2, 2, 0), MLP(hidden=(3,))),
    "no learner": (1, ONE, None, None),
    "no feedback": (1, [Term("g", "u1[k]"), Term("h", "u1[k-1]**2")], None, MLP(hidden=(2,))),
}
WIDTH = 4


@cache
def form_of(name):
    """A lagged form with arbitrary numbers."""
    ny, terms, lags, learner = FORMS[name]
    rng = np.random.default_rng(ny)
    record = Record.from_arrays(rng.normal(size=(60, 1)), rng.normal(size=(60, ny)), inputs=["u1"],
                                outputs=[f"y{i + 1}" for i in range(ny)])  # fmt: skip
    posed = pose(record, Baseline.from_terms(terms), lags)
    nz, nt = posed.feature_rows().shape[1], len(posed.baseline.names)
    bound = Bound.of(learner, nz, ny)
    features, nz = replace(posed.features, entries=posed.features.entries[: bound.nz]), bound.nz
    form = LaggedDynamics(posed.baseline, features, posed.layout, posed.outputs, bound)
    w = np.asarray(bound.init(jax.random.key(1))) + 0.1
    scaling = (rng.normal(size=nz), 1 + rng.random(nz), 0.5 * (1 + rng.random(ny)))
    return form, Numbers(0.4 * rng.normal(size=nt), 0.3 * rng.normal(size=nt), w, *scaling), record


def runs(dynamics, numbers, inputs, steps=6):
    """(states, slopes as (n0, n0 + n, m), outputs, their slopes) after every step of m runs side by side."""
    rng = np.random.default_rng(3)
    state, slopes = (
        jnp.asarray(rng.normal(size=(dynamics.states, WIDTH))),
        dynamics.first_slopes(WIDTH),
    )
    found, tangents = [], jax.jit(dynamics.tangents)
    for k in range(steps):
        row = jnp.stack([inputs[k + 7 * m] for m in range(WIDTH)], axis=-1)
        state, slopes, value, slope = tangents(numbers, state, slopes, row)
        found.append((state, flat(dynamics, slopes), value, slope))
    return found


def flat(dynamics, slopes):
    """Slopes of either layout as one array: the lagged form has one block for each past output."""
    if isinstance(slopes, tuple):
        nothing = jnp.zeros((0, dynamics.states + dynamics.unknowns, WIDTH))
        return jnp.concatenate(slopes) if slopes else nothing
    return slopes


@pytest.mark.parametrize("name", FORMS)
def test_tangents_of_the_lagged_form_are_those_of_its_step(name):
    form, numbers, record = form_of(name)
    generic = Generic(form.baseline, form.features, form.layout, form.outputs, form.bound)
    inputs = form.inputs(record.experiments[0], record)
    assert isinstance(form, Dynamics) and isinstance(generic, Dynamics)
    for own, other in zip(runs(form, numbers, inputs), runs(generic, numbers, inputs), strict=True):
        for one, two in zip(own, other, strict=True):
            assert one.shape == two.shape
            np.testing.assert_allclose(
                one, two, rtol=1e-12, atol=1e-12 * np.max(np.abs(two), initial=1.0)
            )
    assert own[3].shape == (len(form.outputs), form.states + form.unknowns, WIDTH)


@pytest.mark.parametrize("name", FORMS)
def test_first_slopes_are_the_identity(name):
    form, *_ = form_of(name)
    found = flat(form, form.first_slopes(WIDTH))
    identity = np.eye(form.states, form.states + form.unknowns)
    np.testing.assert_array_equal(found, np.repeat(identity[..., None], WIDTH, axis=2))


@pytest.mark.parametrize("name", ["one output", "two outputs"])
def test_sensitivities_are_those_of_the_generic_form(name):
    """The Gram matrices too, which the layout of the slopes must not change."""
    form, numbers, record = form_of(name)
    generic = Generic(form.baseline, form.features, form.layout, form.outputs, form.bound)
    segments = build_segments(record, form, 9, 3)
    weight = jnp.asarray(np.random.default_rng(0).normal(size=(len(form.outputs),) * 2))
    found, other = (
        sensitivity(d, numbers, segments, segments.start, weight) for d in (form, generic)
    )
    for one, two in zip(found, other, strict=True):
        np.testing.assert_allclose(one, two, rtol=0, atol=1e-11 * np.max(np.abs(two)))


# --- a model that is not lagged


@dataclass(frozen=True)
class StateSpace(AutodiffDynamics):
    """x⁺ = A x + B u, ŷ = C x, with all entries of A, B and C in θ; the state is not known from measured outputs."""

    outputs: tuple[str, ...]
    order: int
    inputs_count: int
    linear: bool = False
    first_row: int = 0
    memory: int = 0

    @property
    def states(self):
        return self.order

    @property
    def unknowns(self):
        return self.order * (self.order + self.inputs_count + len(self.outputs))

    def start(self, outputs, rows):
        return np.zeros((len(rows), self.order))

    def start_rows(self, weight):
        return np.zeros((self.order, self.order))

    def inputs(self, experiment, record):
        return experiment.inputs[self.first_row :]

    def describe(self, state, inputs):
        return {f"x{i}": float(value) for i, value in enumerate(state)}

    def matrices(self, theta):
        n, m = self.order, self.inputs_count
        a, b, c = theta[: n * n], theta[n * n : n * (n + m)], theta[n * (n + m) :]
        return a.reshape(n, n), b.reshape(n, m), c.reshape(-1, n)

    def step(self, numbers, state, inputs):
        a, b, c = self.matrices(numbers.theta)
        value = c @ state
        nothing = jnp.zeros_like(value)
        return a @ state + b @ inputs, Parts(value, nothing, nothing)


SEGMENT, WASHOUT = 8, 2
NO_LEARNER = (np.zeros(0), np.zeros(0), np.zeros(0))


@cache
def state_space(ny):
    """(dynamics, numbers, record, segments, states that differ from the start)."""
    rng = np.random.default_rng(ny)
    dynamics = StateSpace(tuple(f"y{i}" for i in range(ny)), 3, 2)
    pieces = [
        Record.from_arrays(rng.normal(size=(n, 2)), rng.normal(size=(n, ny))) for n in (19, 11)
    ]
    record = Record.join(pieces)
    theta = 0.4 * rng.normal(size=dynamics.unknowns)
    segments = build_segments(record, dynamics, SEGMENT, WASHOUT)
    states = rng.normal(size=segments.start.shape)
    numbers = Numbers(theta, 0 * theta, *NO_LEARNER, np.zeros(ny))
    return dynamics, numbers, record, segments, states


def by_a_loop(dynamics, theta, states, inputs):
    """Outputs (k, T, ny, m) by a plain loop over time."""
    a, b, c = dynamics.matrices(theta)
    chunks = []
    for state, signals in zip(states, inputs, strict=True):
        found = []
        for row in signals:
            found.append(c @ state)
            state = a @ state + b @ row
        chunks.append(jnp.stack(found))
    return jnp.stack(chunks)


def test_a_state_space_is_a_dynamics():
    assert isinstance(state_space(1)[0], Dynamics)


@pytest.mark.parametrize("ny", [1, 2])
def test_segments_of_a_state_space(ny):
    """From the first row on; a state that is not measured starts as `start` says."""
    dynamics, _, record, segments, _ = state_space(ny)
    assert segments.start.shape[1] == 3 and not np.asarray(segments.start).any()
    assert segments.steps == SEGMENT and segments.count == sum(
        len(e) - WASHOUT for e in record.experiments
    )
    first = np.asarray(segments.inputs)[0, :, :, 0]
    np.testing.assert_array_equal(first, record.experiments[0].inputs[:SEGMENT])
    np.testing.assert_array_equal(
        np.asarray(segments.target)[0, :, :, 0], record.experiments[0].outputs[:SEGMENT]
    )
    whole = build_segments(record, replace(dynamics, first_row=4), 0, 0)
    assert whole.count == sum(len(e) - 4 for e in record.experiments)


@pytest.mark.parametrize("ny", [1, 2])
def test_outputs_of_a_state_space_are_those_of_a_loop(ny):
    dynamics, numbers, _, segments, states = state_space(ny)
    found = respond(dynamics, numbers, segments, states)
    expected = jax.jit(partial(by_a_loop, dynamics))(numbers.theta, states, segments.inputs)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("ny", [1, 2])
def test_sensitivities_of_a_state_space_are_those_of_a_loop(ny):
    dynamics, numbers, _, segments, states = state_space(ny)
    weight = np.random.default_rng(5).normal(size=(ny, ny))
    found = sensitivity(dynamics, numbers, segments, jnp.asarray(states), jnp.asarray(weight))
    scored, target = np.asarray(segments.scored)[:, :, None], np.asarray(segments.target)

    @jax.jit
    def outputs(states, theta):
        run = jnp.where(scored, by_a_loop(dynamics, theta, states, segments.inputs), 0.0)
        return jnp.einsum("oi,ktim->ktom", weight, run)

    theta = jnp.asarray(numbers.theta)
    by_state, by_theta = jax.jit(jax.jacfwd(outputs, (0, 1)))(states, theta)
    error = np.einsum("oi,ktim->ktom", weight, np.where(scored, target, 0.0)) - outputs(
        states, theta
    )
    columns = np.concatenate([by_theta, error[..., None]], axis=-1)
    rows = columns.reshape(-1, columns.shape[-1])
    np.testing.assert_allclose(
        found.shared, rows.T @ rows, rtol=0, atol=1e-10 * np.max(np.abs(rows.T @ rows))
    )
    for k in range(states.shape[0]):
        for m in range(states.shape[2]):
            start = np.asarray(by_state)[k, :, :, m, k, :, m].reshape(-1, 3)
            own = np.concatenate([start, columns[k, :, :, m].reshape(len(start), -1)], axis=1)
            expected = start.T @ own
            size = np.max(np.abs(expected), initial=1e-300)
            np.testing.assert_allclose(found.own[k, :, :, m], expected, rtol=0, atol=1e-10 * size)


def test_a_longer_run_forgets_nothing():
    """Slopes of the last output to the first state: C A^(T−1), the product of all steps."""
    dynamics, numbers, *_ = state_space(2)
    a, _, c = dynamics.matrices(numbers.theta)
    state, slopes, tangents = np.zeros((3, 1)), dynamics.first_slopes(1), jax.jit(dynamics.tangents)
    for _ in range(12):
        state, slopes, _, slope = tangents(numbers, state, slopes, np.ones((2, 1)))
    np.testing.assert_allclose(
        slope[:, :3, 0], c @ np.linalg.matrix_power(a, 11), rtol=1e-10, atol=1e-14
    )
