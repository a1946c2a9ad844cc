"""Free runs in segments: their layout against a double loop, their sensitivities against autodiff and differences."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import naive
import numpy as np
import pytest

import orthaug.fitting.segments
from orthaug import MLP, Baseline, Lags, LevenbergMarquardt, Record, Term, estimate
from orthaug.fitting.segments import Segments, build_segments, respond, sensitivity
from orthaug.models.dynamics import Numbers
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.learners import Bound
from orthaug.physics.problem import pose

SEGMENT, WASHOUT, LENGTHS = 7, 3, (23, 9, 30)
NETWORK = MLP(hidden=(2,))

# name → (terms, lags, learner)
ONE = [Term("a", "y1[k-1]"), Term("b", "y1[k-2]"), Term("g", "u[k-1]")]
SHARED = [
    Term("a", "y1[k-1]", output="y1"),
    Term("a", "y2[k-1]", output="y2"),
    Term("b", "y1[k-2]", output="y2"),
    Term("g", "u[k]", output="y1"),
]
CASES = {
    "one output": (ONE, Lags(2, 2, 0), NETWORK),
    "gaps between lags": (
        [Term("a", "y1[k-1]"), Term("b", "y1[k-3]"), Term("g", "u[k]")],
        None,
        NETWORK,
    ),
    "expressions": (ONE, None, MLP(hidden=(2,), inputs=("sin(y1[k-1])", "y1[k-3]*u[k]"))),
    "nonlinear physics and a fixed term": (
        [
            Term("a", "y1[k-1] - 0.1*y1[k-1]**3"),
            Term("g", "u[k]"),
            Term("d", "y1[k-2]", 0.2, fixed=True),
        ],
        None,
        NETWORK,
    ),
    "two outputs share theta": (SHARED, None, NETWORK),
    "two outputs, no learner": (SHARED, None, None),
    "no learner": (ONE, None, None),
    "no feedback": ([Term("g", "u[k]"), Term("h", "u[k-1]**2")], None, NETWORK),
}
OUTPUTS = {name: 2 if "two outputs" in name else 1 for name in CASES}


def record_of(ny, lengths=LENGTHS):
    rng = np.random.default_rng(ny)
    names = {"inputs": ["u"], "outputs": ["y1", "y2"][:ny]}
    return Record.join(Record.from_arrays(*rng.normal(size=(2, n, 1)), **names) if ny == 1
                       else Record.from_arrays(rng.normal(size=n), rng.normal(size=(n, 2)), **names)
                       for n in lengths)  # fmt: skip


class Case(NamedTuple):
    """A model with arbitrary numbers, its record in two chunks of segments, and states that are not the measured."""

    record: Record
    form: LaggedDynamics
    numbers: Numbers
    segments: Segments
    states: np.ndarray
    weight: np.ndarray


@cache
def case(name):
    terms, lags, learner = CASES[name]
    ny = OUTPUTS[name]
    rng = np.random.default_rng(len(name))
    posed = pose(
        record_of(ny), Baseline.from_terms(terms), lags, None if learner is None else learner.inputs
    )
    nz = posed.feature_rows().shape[1]
    bound = Bound.of(learner, nz, ny)
    features, nz = replace(posed.features, entries=posed.features.entries[: bound.nz]), bound.nz
    form = LaggedDynamics(posed.baseline, features, posed.layout, posed.outputs, bound)
    w = np.asarray(bound.init(jax.random.key(1))) + 0.1
    c = 0.4 * rng.normal(size=len(posed.baseline.names))
    scaling = (np.zeros(0), np.zeros(0), np.zeros(ny))
    if bound.learns:
        scaling = (rng.normal(size=nz), 1 + rng.random(nz), 0.5 * (1 + rng.random(ny)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(orthaug.fitting.segments, "CHUNK", 9)
        segments = build_segments(posed.record, form, SEGMENT, WASHOUT)
    states = np.asarray(segments.start) + 0.3 * rng.normal(size=segments.start.shape)
    return Case(
        posed.record,
        form,
        Numbers(c, 0 * c, w, *scaling),
        segments,
        states,
        rng.normal(size=(ny, ny)),
    )


def spread_out(part):
    """(k, …, m) as (segments, …)."""
    return np.concatenate(np.moveaxis(np.asarray(part), -1, 1))


# --- layout


def build_chunk(record, start, memory, segment, washout):
    """[(experiment, first row, scored rows)] of all segments, by counting."""
    longest = max(len(e) - start for e in record.experiments)
    steps = min(segment, longest) if segment else longest
    washout = min(washout, steps - 1)
    found = []
    for i, experiment in enumerate(record.experiments):
        first = start
        while first == start or first + washout < len(experiment):
            found.append(
                (
                    i,
                    first,
                    [k for k in range(first + washout, first + steps) if k < len(experiment)],
                )
            )
            first += steps - washout
    return found, steps, washout


SIZES = [(0, 0), (1, 0), (5, 0), (7, 0), (500, 0), (0, 3), (5, 3), (7, 3), (7, 6), (500, 3)]


@pytest.mark.parametrize(("segment", "washout"), SIZES)
@pytest.mark.parametrize("name", ["gaps between lags", "two outputs share theta", "no feedback"])
def test_layout_by_a_double_loop(name, segment, washout):
    record, form = case(name).record, case(name).form
    found = build_segments(record, form, segment, washout)
    expected, steps, _ = build_chunk(record, form.first_row, form.memory, segment, washout)
    start, inputs, target, scored = map(spread_out, found)
    assert inputs.shape[1] == target.shape[1] == scored.shape[1] == steps
    assert start.shape[1:] == (form.states,) == (form.memory * OUTPUTS[name],)
    past = start.reshape(len(start), form.memory, OUTPUTS[name])
    for s, (i, first, rows) in enumerate(expected):
        experiment = record.experiments[i]
        for lag in range(1, form.memory + 1):
            np.testing.assert_array_equal(past[s, lag - 1], experiment.outputs[first - lag])
        assert [first + t for t in np.flatnonzero(scored[s])] == rows
        for t in range(min(steps, len(experiment) - first)):
            np.testing.assert_array_equal(target[s, t], experiment.outputs[first + t])
            lagged = [experiment.inputs[first + t - lag.lag, 0] for lag in form.input_layout]
            np.testing.assert_array_equal(inputs[s, t], lagged)
    assert not scored[len(expected) :].any() and found.count == sum(
        len(rows) for *_, rows in expected
    )


@pytest.mark.parametrize(("segment", "washout"), [(0, 0), (0, 4), (7, 3), (7, 0), (9, 8)])
def test_every_usable_row_is_scored_once_but_the_first_washout(segment, washout):
    record, form = case("one output").record, case("one output").form
    layout, _, washout = build_chunk(record, form.first_row, form.memory, segment, washout)
    rows = [(i, k) for i, _, scored in layout for k in scored]
    usable = [
        (i, k)
        for i, e in enumerate(record.experiments)
        for k in range(form.first_row + washout, len(e))
    ]
    assert sorted(rows) == usable
    assert build_segments(record, form, segment, washout).count == len(usable)


def test_segments_stand_in_chunks_of_one_width(monkeypatch):
    record, form = case("one output").record, case("one output").form
    monkeypatch.setattr(orthaug.fitting.segments, "CHUNK", 4)
    chunked = build_segments(record, form, SEGMENT, WASHOUT)
    monkeypatch.undo()
    one = build_segments(record, form, SEGMENT, WASHOUT)
    assert one.start.shape[0] == 1 and chunked.start.shape[0] == 4 and chunked.start.shape[-1] <= 4
    assert {part.shape[0] for part in chunked} == {4} and {part.shape[-1] for part in one} == {
        one.start.shape[-1]
    }
    count = len(build_chunk(record, form.first_row, form.memory, SEGMENT, WASHOUT)[0])
    for found, expected in zip(chunked, one, strict=True):
        np.testing.assert_array_equal(spread_out(found)[:count], spread_out(expected)[:count])


def test_an_experiment_shorter_than_the_washout_is_not_scored():
    form = case("one output").form
    record = record_of(1, (30, 5))
    found = build_segments(record, form, 7, 4)
    assert found.count == 30 - form.first_row - 4


# --- free run


@pytest.mark.parametrize("name", CASES)
def test_respond_is_a_loop_over_time(name):
    given = case(name)
    found = spread_out(respond(given.form, given.numbers, given.segments, given.states))
    model, start = SimpleNamespace(form=given.form, numbers=given.numbers), given.form.first_row
    layout, steps, _ = build_chunk(given.record, start, given.form.memory, SEGMENT, WASHOUT)
    past = spread_out(given.states)
    past = past.reshape(len(past), given.form.memory, OUTPUTS[name])
    for s, (i, first, _) in enumerate(layout):
        experiment = given.record.experiments[i]
        signals = naive.signals_of(experiment, given.record)
        for lag in range(1, given.form.memory + 1):
            for j, output in enumerate(given.form.outputs):
                signals[output][first - lag] = past[s, lag - 1, j]
        for t in range(min(steps, len(experiment) - first)):
            value = sum(naive.row(model, signals, first + t)[:2])
            np.testing.assert_allclose(found[s, t], value, rtol=1e-11, atol=1e-12)
            for j, output in enumerate(given.form.outputs):
                signals[output][first + t] = value[j]


@pytest.mark.parametrize("ny", [1, 2])
def test_respond_over_whole_experiments_is_simulate(ny):
    name = "two outputs share theta" if ny == 2 else "one output"
    terms, lags, learner = CASES[name]
    record = record_of(ny)
    options = {
        "lags": lags,
        "learner": learner,
        "solver": LevenbergMarquardt(5),
        "regularization": 1.0,
    }
    model = estimate(record, Baseline.from_terms(terms), **options).model
    assert np.abs(model.theta_aux).max() > 1e-3
    whole = build_segments(record, model.form, 0, 0)
    found = spread_out(respond(model.form, model.numbers, whole, whole.start))
    for s, trajectory in enumerate(model.simulate(record).trajectories):
        expected = trajectory.model[model.form.first_row :]
        np.testing.assert_allclose(found[s, : len(expected)], expected, rtol=1e-10, atol=1e-12)


# --- sensitivities


class Dense(NamedTuple):
    """The scored rows' errors and Jacobian, weighted: columns are the states of all segments, then (c, w)."""

    error: np.ndarray
    start: np.ndarray
    shared: np.ndarray


def errors(given, p, states):
    nt = len(given.form.baseline.names)
    numbers = given.numbers._replace(theta=p[:nt], weights=p[nt:])
    miss = jnp.where(
        given.segments.scored[:, :, None], respond(given.form, numbers, given.segments, states), 0.0
    )
    return jnp.einsum("oi,ktim->ktom", given.weight, miss)


@cache
def dense(name):
    """Everything by `jax.jacfwd` through the scan."""
    given = case(name)
    p = jnp.concatenate([jnp.asarray(given.numbers.theta), jnp.asarray(given.numbers.weights)])
    states = jnp.asarray(given.states)
    jacobian = jax.jit(jax.jacfwd(partial(errors, given), argnums=(0, 1)))(p, states)
    target = jnp.where(given.segments.scored[:, :, None], given.segments.target, 0.0)
    error = jnp.einsum("oi,ktim->ktom", given.weight, target) - errors(given, p, states)
    return Dense(np.asarray(error), np.asarray(jacobian[1]), np.asarray(jacobian[0]))


def assert_close(found, expected, relative):
    assert found.shape == expected.shape
    assert np.max(np.abs(found - expected), initial=0.0) <= relative * np.max(
        np.abs(expected), initial=1e-300
    )


@cache
def found_of(name):
    given = case(name)
    return sensitivity(
        given.form,
        given.numbers,
        given.segments,
        jnp.asarray(given.states),
        jnp.asarray(given.weight),
    )


@pytest.mark.parametrize("name", CASES)
def test_gram_matrix_of_the_sensitivities_is_that_of_autodiff(name):
    exact = dense(name)
    columns = np.concatenate([exact.shared, exact.error[..., None]], axis=-1)
    columns = columns.reshape(-1, columns.shape[-1])
    assert_close(np.asarray(found_of(name).shared), columns.T @ columns, 1e-8)


@pytest.mark.parametrize("name", CASES)
def test_gram_matrices_of_the_states_are_those_of_autodiff(name):
    exact = dense(name)
    (chunks, _, ny, width), n0 = exact.error.shape, case(name).segments.start.shape[1]
    own = np.zeros((chunks, n0, n0 + exact.shared.shape[-1] + 1, width))
    for k in range(chunks):
        for m in range(width):
            others = exact.start[k, :, :, m].copy()  # (T, ny, k, n0, m)
            start = others[:, :, k, :, m].copy().reshape(others.shape[0] * ny, n0)
            others[:, :, k, :, m] = 0
            assert not others.any()  # a state touches its own segment only
            rows = np.column_stack(
                [
                    start,
                    exact.shared[k, :, :, m].reshape(len(start), -1),
                    exact.error[k, :, :, m].ravel(),
                ]
            )
            own[k, :, :, m] = start.T @ rows
    assert_close(np.asarray(found_of(name).own), own, 1e-8)


@pytest.mark.parametrize("name", ["expressions", "two outputs share theta"])
def test_gram_matrix_of_the_sensitivities_is_that_of_differences(name):
    given, nt = case(name), len(case(name).form.baseline.names)
    p = np.concatenate([given.numbers.theta, given.numbers.weights])
    scored = np.asarray(given.segments.scored)[:, :, None]

    def run(p):
        numbers = given.numbers._replace(theta=p[:nt], weights=p[nt:])
        response = np.where(scored, respond(given.form, numbers, given.segments, given.states), 0.0)
        return np.einsum("oi,ktim->ktom", given.weight, response).ravel()

    steps = 1e-5 * np.eye(len(p))
    jacobian = np.stack([(run(p + d) - run(p - d)) / 2e-5 for d in steps], axis=-1)
    assert_close(np.asarray(found_of(name).shared)[:-1, :-1], jacobian.T @ jacobian, 1e-7)


def test_a_kink_without_a_derivative_counts_as_flat():
    record = Record.from_arrays(np.arange(9.0), np.r_[0.0, np.arange(8.0)], outputs=["y1"])
    form = replace(case("no learner").form, baseline=Baseline.from_terms([Term("a", "sqrt(max(y1[k-1], 0))")]),
                   layout=case("gaps between lags").form.layout[:1])  # fmt: skip
    segments = build_segments(record, form, 0, 0)
    numbers = case("no learner").numbers._replace(theta=np.ones(1), theta_aux=np.zeros(1))
    found = sensitivity(form, numbers, segments, segments.start, jnp.eye(1))
    assert np.isfinite(found.shared).all() and np.isfinite(found.own).all()
