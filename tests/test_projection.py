"""The projection: digits against exact arithmetic, orthogonality, covariance factor."""

from __future__ import annotations

import json
import math

import mpmath
import numpy as np
import pandas as pd
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

from orthaug import Baseline, Record, Term
from orthaug.data.regressors import in_order, stack_rows
from orthaug.physics.projection import Projection

POLYNOMIAL = ["1", "x[k]", "x[k]**2", "x[k]**3", "x[k]**4", "x[k]**5"]
NIST = {
    "norris": POLYNOMIAL[:2],
    "pontius": POLYNOMIAL[:3],
    "noint1": ["x[k]"],
    "noint2": ["x[k]"],
    "longley": ["1", *(f"x{i}[k]" for i in range(1, 7))],
    "wampler1": POLYNOMIAL,
    "wampler2": POLYNOMIAL,
    "wampler3": POLYNOMIAL,
}


def nist(folder, name):
    """φ (N, 1, nθ) and y (N, 1) by the path that estimates θ, and what was computed in exact fractions."""
    table = pd.read_csv(folder / "nist_linear" / f"{name}.csv", encoding="utf-8-sig")
    channels = [c for c in table.columns if c != "y"]
    record = Record.from_arrays(
        table[channels].to_numpy(), table["y"].to_numpy(), inputs=channels, outputs=["y"]
    )
    baseline = Baseline.from_terms([Term(f"b{i}", text) for i, text in enumerate(NIST[name])])
    rows = stack_rows(record, in_order(baseline.lags, ["y"], channels))
    phi = baseline.phi(rows.x, rows.layout, ("y",), np)
    return phi, rows.y, json.loads((folder / "nist_linear" / "certified.json").read_text())[name]


def digits(theta, certified) -> float:
    """Correct digits of the worst coefficient, at most 15."""
    with mpmath.workdps(40):
        errors = [
            abs(mpmath.mpf(float(t)) / mpmath.mpf(b) - 1)
            for t, b in zip(theta, certified, strict=True)
        ]
        return min(15.0, *(float(-mpmath.log10(e)) if e else 15.0 for e in errors))


def scaled_qr(phi, y):
    """Least squares by QR of the columns scaled to unit norm."""
    norms = np.linalg.norm(phi, axis=0)
    q, r = np.linalg.qr(phi / norms)
    return scipy.linalg.solve_triangular(r, q.T @ y) / norms


@pytest.mark.parametrize("name", NIST)
def test_nist_digits(data_folder, name):
    phi, y, certified = nist(data_folder, name)
    found = digits(Projection.factor(phi).solve(y), certified["beta"])
    reference = digits(scaled_qr(phi[:, 0], y[:, 0]), certified["beta"])
    least = {"norris": 12.2, "pontius": 12.2, "longley": 10.9, "wampler1": 9.3}.get(name, 0.0)
    assert found >= reference - 0.5
    assert found >= least - 0.5


@pytest.mark.parametrize("name", ["norris", "pontius", "noint1", "longley", "wampler3"])
def test_nist_standard_deviations(data_folder, name):
    phi, y, certified = nist(data_folder, name)
    factor = Projection.factor(phi).covariance_factor()
    found = math.sqrt(float(certified["rss"]) / (len(y) - len(factor))) * np.linalg.norm(
        factor, axis=1
    )
    assert digits(found, certified["sd"]) > 9


def test_normal_equations_lose_longley(data_folder):
    phi, y, certified = nist(data_folder, "longley")
    normal = np.linalg.pinv(phi[:, 0].T @ phi[:, 0]) @ phi[:, 0].T @ y[:, 0]
    assert digits(normal, certified["beta"]) < 1.0
    assert digits(Projection.factor(phi).solve(y), certified["beta"]) > 10.0


SHAPES = st.tuples(
    st.integers(8, 30), st.integers(1, 3), st.integers(0, 5), st.integers(0, 2**32 - 1)
)


def draw(shape):
    """φ with columns of very different size, and values to project."""
    rows, ny, nt, seed = shape
    rng = np.random.default_rng(seed)
    return rng.normal(size=(rows, ny, nt)) * 10.0 ** rng.integers(-6, 7, nt), rng.normal(
        size=(rows, ny)
    )


@given(SHAPES)
def test_factor(shape):
    phi, values = draw(shape)
    projection = Projection.factor(phi)
    assert projection.q.shape == phi.shape
    assert np.all(np.log2(projection.scale) == np.round(np.log2(projection.scale)))
    np.testing.assert_array_equal(np.tril(projection.r, -1), 0.0)
    q = projection.q.reshape(values.size, -1)
    np.testing.assert_allclose(q.T @ q, np.eye(phi.shape[2]), atol=1e-14)
    np.testing.assert_allclose(projection.q @ projection.r, phi * projection.scale, atol=1e-14)


@given(SHAPES)
def test_solve_is_least_squares(shape):
    phi, values = draw(shape)
    theta = Projection.factor(phi).solve(values)
    size = np.abs(phi).max(axis=(0, 1), initial=0.0)
    expected = np.linalg.lstsq((phi / size).reshape(values.size, -1), values.ravel(), rcond=None)[0]
    np.testing.assert_allclose(theta * size, expected, rtol=1e-10, atol=1e-12)


@given(SHAPES)
def test_orthogonal_part_is_orthogonal(shape):
    phi, values = draw(shape)
    projection = Projection.factor(phi)
    rest = projection.orthogonal_part(values)
    assert np.linalg.norm(projection.coordinates(rest)) <= 1e-14 * np.linalg.norm(values)
    np.testing.assert_allclose(rest + phi @ projection.solve(values), values, atol=1e-12)
    np.testing.assert_allclose(projection.orthogonal_part(rest), rest, atol=1e-14)


def test_orthogonal_part_of_values_almost_in_the_span():
    rng = np.random.default_rng(0)
    projection = Projection.factor(rng.normal(size=(200, 2, 3)))
    values = projection.phi @ np.ones(3) + 1e-9 * rng.normal(size=(200, 2))
    rest = projection.orthogonal_part(values)
    assert np.linalg.norm(projection.coordinates(rest)) <= 1e-14 * np.linalg.norm(rest)


def test_no_physics():
    projection = Projection.factor(np.zeros((7, 2, 0)))
    values = np.random.default_rng(0).normal(size=(7, 2))
    assert projection.solve(values).shape == (0,)
    assert projection.covariance_factor().shape == (0, 0)
    np.testing.assert_array_equal(projection.orthogonal_part(values), values)


def test_covariance_factor_against_the_exact_inverse():
    rng = np.random.default_rng(3)
    phi = rng.normal(size=(6, 2, 3)) * [1e-5, 1.0, 1e4]
    factor = Projection.factor(phi).covariance_factor()
    stacked = phi.reshape(-1, 3)
    with mpmath.workdps(50):
        exact = mpmath.matrix(stacked.tolist())
        inverse = np.array((exact.T * exact) ** -1, dtype=float).reshape(3, 3)
    np.testing.assert_allclose(factor @ factor.T, inverse, rtol=1e-12)


def test_along_directions_that_the_rows_tell_phi_may_have_columns_of_zeros():
    rng = np.random.default_rng(4)
    phi, v = rng.normal(size=(30, 2, 5)), rng.normal(size=(30, 2))
    phi[..., 3:] = 0.0  # parameters of other equations
    projection, stacked = Projection.factor(phi), phi.reshape(60, 5)
    basis = np.array([[1.0, 0.0], [2.0, 0.0], [0.0, 1.0], [0.0, 0.0], [0.0, 0.0]])
    expected = basis @ np.linalg.lstsq(stacked @ basis, v.reshape(-1), rcond=None)[0]
    assert projection.solve_along(v, basis) == pytest.approx(expected, rel=1e-12)
    everything = projection.solve_along(v, np.eye(5))  # the shortest of all that are as near
    assert everything == pytest.approx(
        np.linalg.lstsq(stacked, v.reshape(-1), rcond=None)[0], rel=1e-12
    )
    assert not projection.solve_along(v, np.eye(5)[:, 3:]).any()


def test_directions_that_differ_in_what_no_row_says_are_one():
    phi = np.zeros((20, 1, 3))
    phi[:, 0, :2] = np.random.default_rng(1).normal(size=(20, 2))
    projection, basis = Projection.factor(phi), np.array([[1.0, 1.0], [0.5, 0.5], [0.0, 7.0]])
    found = projection.without_null(basis)
    assert found.shape == (3, 1) and np.linalg.matrix_rank(phi[:, 0] @ found) == 1
    assert np.array_equal(projection.without_null(basis[:, :1]), basis[:, :1])


def test_no_rows_have_rank_0():
    none = Projection.factor(np.zeros((0, 1, 2)))
    assert none.r.shape == (0, 2) and none.q.shape == (0, 1, 0)
