"""Pasts of the segments as unknowns: against the dense normal equations of all unknowns together."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from test_segments import CASES, OUTPUTS, assert_close, case, dense, found_of

from orthaug.fitting.pasts import Pasts

FED_BACK = [name for name in CASES if name != "no feedback"]


def pasts_of(name, free=True):
    given = case(name)
    return Pasts(np.asarray(given.segments.past), given.past, free)


@cache
def rows(name):
    """Matrix over (all pasts, c, w) and right-hand side of the scored errors and of `W (y − p)`."""
    given, exact = case(name), dense(name)
    measured = np.asarray(given.segments.past)
    n, ny = exact.shared.shape[-1], OUTPUTS[name]
    scored = np.hstack([exact.past.reshape(exact.error.size, -1), exact.shared.reshape(-1, n)])
    positions = np.eye(measured.size).reshape(*measured.shape, -1)  # (k, na, ny, m, all pasts)
    prior = np.einsum("oi,knimp->knomp", given.weight, positions).reshape(-1, measured.size)
    miss = np.einsum("oi,knim->knom", given.weight, measured - given.past)
    assert prior.shape[0] == measured.size and ny == given.weight.shape[0]
    matrix = np.vstack([scored, np.hstack([prior, np.zeros((measured.size, n))])])
    return matrix, np.concatenate([exact.error.ravel(), miss.ravel()])


@pytest.mark.parametrize("name", FED_BACK)
def test_elimination_is_the_schur_complement_of_the_dense_normal_matrix(name):
    matrix, right = rows(name)
    normal, side, n0 = matrix.T @ matrix, matrix.T @ right, case(name).past.size
    inverse = np.linalg.inv(normal[:n0, :n0])
    hessian, gradient = pasts_of(name).eliminate(found_of(name), case(name).weight)
    assert_close(hessian, normal[n0:, n0:] - normal[n0:, :n0] @ inverse @ normal[:n0, n0:], 1e-9)
    assert_close(gradient, side[n0:] - normal[n0:, :n0] @ inverse @ side[:n0], 1e-9)
    np.testing.assert_array_equal(hessian, hessian.T)


@pytest.mark.parametrize("name", FED_BACK)
def test_after_a_step_the_pasts_are_those_of_dense_least_squares(name):
    matrix, right = rows(name)
    n0 = case(name).past.size
    step = 0.1 * np.random.default_rng(0).normal(size=matrix.shape[1] - n0)
    best = np.linalg.lstsq(matrix[:, :n0], right - matrix[:, n0:] @ step, rcond=None)[0]
    pasts = pasts_of(name)
    pasts.eliminate(found_of(name), case(name).weight)
    assert_close(pasts.after(step) - pasts.values, best.reshape(case(name).past.shape), 1e-9)


@pytest.mark.parametrize("name", ["no learner", "two outputs, no learner"])
def test_the_step_of_the_eliminated_equations_is_the_dense_one(name):
    matrix, right = rows(name)
    expected = np.linalg.lstsq(matrix, right, rcond=None)[0]
    n0, pasts = case(name).past.size, pasts_of(name)
    step = np.linalg.solve(*pasts.eliminate(found_of(name), case(name).weight))
    np.testing.assert_allclose(step, expected[n0:], rtol=1e-8)
    assert_close(pasts.after(step) - pasts.values, expected[:n0].reshape(case(name).past.shape), 1e-8)


def test_loss_of_the_pasts_by_a_loop():
    name = "two outputs share theta"
    pasts, weight = pasts_of(name), case(name).weight
    miss = np.moveaxis(pasts.measured - pasts.values, 2, -1).reshape(-1, 2)
    assert pasts.loss(pasts.values, weight) == pytest.approx(sum(np.sum((weight @ row) ** 2) for row in miss))
    assert pasts.loss(pasts.measured, weight) == 0


def test_pasts_that_are_not_free_stay():
    name = "two outputs share theta"
    pasts, shared = pasts_of(name, free=False), np.asarray(found_of(name).shared)
    hessian, gradient = pasts.eliminate(found_of(name), case(name).weight)
    np.testing.assert_array_equal(hessian, shared[:-1, :-1])
    np.testing.assert_array_equal(gradient, shared[:-1, -1])
    np.testing.assert_array_equal(pasts.after(np.ones(len(gradient))), case(name).past)


def test_pasts_stay_before_they_are_eliminated():
    np.testing.assert_array_equal(pasts_of("one output").after(np.ones(3)), case("one output").past)
