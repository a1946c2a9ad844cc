"""States of the segments as unknowns: against the dense normal equations of all unknowns together."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from test_segments import CASES, OUTPUTS, assert_close, case, dense, found_of

from orthaug.fitting.initial_states import InitialStates, Start

FED_BACK = [name for name in CASES if name != "no feedback"]


def states_of(name, free=True):
    return InitialStates(np.asarray(case(name).segments.start), free)


def start_rows(name):
    """What a state that differs from the measured one costs."""
    return case(name).form.start_rows(case(name).weight)


def eliminated(name, free=True):
    return states_of(name, free).eliminate(found_of(name), case(name).states, start_rows(name))


def followed(name, step, free=True):
    """The states after a step of (c, w) from where they were eliminated."""
    *_, offset, slope = eliminated(name, free)
    here = np.random.default_rng(1).normal(size=len(step))
    return Start(case(name).states, 0.0, here, offset, slope).at(here + step)


@cache
def rows(name):
    """Matrix over (all states, c, w) and right-hand side of the scored errors and of `W (y − p)` of past outputs p."""
    given, exact = case(name), dense(name)
    measured = np.asarray(given.segments.start)
    n, ny = exact.shared.shape[-1], OUTPUTS[name]
    past = (measured.shape[0], given.form.memory, ny, measured.shape[-1])
    scored = np.hstack([exact.start.reshape(exact.error.size, -1), exact.shared.reshape(-1, n)])
    positions = np.eye(measured.size).reshape(*past, -1)  # (k, na, ny, m, all states)
    prior = np.einsum("oi,knimp->knomp", given.weight, positions).reshape(-1, measured.size)
    miss = np.einsum("oi,knim->knom", given.weight, (measured - given.states).reshape(past))
    assert prior.shape[0] == measured.size and ny == given.weight.shape[0]
    matrix = np.vstack([scored, np.hstack([prior, np.zeros((measured.size, n))])])
    return matrix, np.concatenate([exact.error.ravel(), miss.ravel()])


@pytest.mark.parametrize("name", FED_BACK)
def test_elimination_is_the_schur_complement_of_the_dense_normal_matrix(name):
    matrix, right = rows(name)
    normal, side, n0 = matrix.T @ matrix, matrix.T @ right, case(name).states.size
    inverse = np.linalg.inv(normal[:n0, :n0])
    hessian, gradient, *_ = eliminated(name)
    assert_close(hessian, normal[n0:, n0:] - normal[n0:, :n0] @ inverse @ normal[:n0, n0:], 1e-9)
    assert_close(gradient, side[n0:] - normal[n0:, :n0] @ inverse @ side[:n0], 1e-9)
    np.testing.assert_array_equal(hessian, hessian.T)


@pytest.mark.parametrize("name", FED_BACK)
def test_after_a_step_the_states_are_those_of_dense_least_squares(name):
    matrix, right = rows(name)
    n0 = case(name).states.size
    step = 0.1 * np.random.default_rng(0).normal(size=matrix.shape[1] - n0)
    best = np.linalg.lstsq(matrix[:, :n0], right - matrix[:, n0:] @ step, rcond=None)[0]
    assert_close(
        followed(name, step) - case(name).states, best.reshape(case(name).states.shape), 1e-9
    )


@pytest.mark.parametrize("name", ["no learner", "two outputs, no learner"])
def test_the_step_of_the_eliminated_equations_is_the_dense_one(name):
    matrix, right = rows(name)
    expected = np.linalg.lstsq(matrix, right, rcond=None)[0]
    n0 = case(name).states.size
    step = np.linalg.solve(*eliminated(name)[:2])
    np.testing.assert_allclose(step, expected[n0:], rtol=1e-8)
    assert_close(
        followed(name, step) - case(name).states,
        expected[:n0].reshape(case(name).states.shape),
        1e-8,
    )


def test_loss_of_the_states_by_a_loop():
    name = "two outputs share theta"
    states, weight, values = states_of(name), case(name).weight, case(name).states
    shape = (len(values), case(name).form.memory, 2, values.shape[-1])
    miss = np.moveaxis((states.measured - values).reshape(shape), 2, -1).reshape(-1, 2)
    assert states.loss(values, start_rows(name)) == pytest.approx(
        sum(np.sum((weight @ row) ** 2) for row in miss)
    )
    assert states.loss(states.measured, start_rows(name)) == 0


def test_states_that_are_not_free_stay():
    name = "two outputs share theta"
    shared = np.asarray(found_of(name).shared)
    hessian, gradient, offset, slope = eliminated(name, free=False)
    np.testing.assert_array_equal(hessian, shared[:-1, :-1])
    np.testing.assert_array_equal(gradient, shared[:-1, -1])
    assert offset is None and slope is None
    assert followed(name, np.ones(len(gradient)), free=False) is None  # a trial then takes `values`


def test_states_stay_before_they_are_eliminated():
    start = Start(case("one output").states)
    assert start.at(np.ones(3)) is None and start.misfit == np.inf
    np.testing.assert_array_equal(start.values, case("one output").states)


def test_elimination_leaves_nothing_behind():
    """What was measured and where the states stood are not written to."""
    states, given = states_of("one output"), case("one output")
    measured, values = states.measured.copy(), given.states.copy()
    first = states.eliminate(found_of("one output"), given.states, start_rows("one output"))
    again = states.eliminate(found_of("one output"), given.states, start_rows("one output"))
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(states.measured, measured)
    np.testing.assert_array_equal(given.states, values)
