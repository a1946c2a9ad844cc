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
from orthaug.physics.projection import Factor, Projection

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


# --- a factor of rows that come in blocks


def blocks_of(phi, sizes):
    """Rows in blocks of the given sizes, one after another and over again."""
    begin, i = 0, 0
    while begin < len(phi):
        yield phi[begin : begin + sizes[i % len(sizes)]]
        begin, i = begin + sizes[i % len(sizes)], i + 1


def upper(factor):
    """R of the columns as they are, its diagonal not negative: then it is unique."""
    r = factor.to_coordinates
    return r * np.where(np.diag(r) < 0, -1.0, 1.0)[:, None]


def assert_same_columns(found, expected, relative=1e-13):
    """Each column (of R, of θ) to the digits of its own size."""
    size = np.linalg.norm(expected, axis=0)
    assert np.max(np.abs(found - expected) / np.where(size > 0, size, 1.0), initial=0.0) <= relative


@given(SHAPES, st.lists(st.integers(1, 12), min_size=1, max_size=4))
def test_factor_of_blocks_is_that_of_the_whole(shape, sizes):
    phi, _ = draw(shape)
    whole, found = Projection.factor(phi), Factor.of_blocks(blocks_of(phi, sizes))
    assert found.r.shape == whole.r.shape == (phi.shape[2],) * 2
    assert np.all(np.log2(found.scale) == np.round(np.log2(found.scale)))
    np.testing.assert_array_equal(np.tril(found.r, -1), 0.0)
    assert_same_columns(upper(found), upper(whole))
    np.testing.assert_allclose(
        found.covariance_factor() @ found.covariance_factor().T,
        whole.covariance_factor() @ whole.covariance_factor().T,
        rtol=1e-10, atol=1e-12 * np.max(np.outer(whole.scale, whole.scale), initial=0.0),
    )  # fmt: skip


@pytest.mark.parametrize("size", [1, 2, 3, 7, 50, 199, 200, 1000])
def test_factor_of_blocks_of_any_size(size):
    """Of fewer rows than columns too, as the first ones of one row are."""
    phi = np.random.default_rng(0).normal(size=(200, 1, 5)) * [1e-6, 1e-3, 1.0, 1e3, 1e6]
    assert_same_columns(
        upper(Factor.of_blocks(blocks_of(phi, [size]))), upper(Projection.factor(phi))
    )


def test_blocks_without_rows_add_nothing():
    phi = np.random.default_rng(0).normal(size=(20, 2, 3))
    found = Factor.of_blocks([phi[:0], phi[:12], phi[:0], phi[12:], phi[:0]])
    assert_same_columns(upper(found), upper(Projection.factor(phi)))


@pytest.mark.parametrize("zeros", [[0], [2], [1, 3], [0, 1, 2, 3]])
@pytest.mark.parametrize("where", ["everywhere", "first block", "all but the last block"])
def test_blocks_with_columns_of_zeros(zeros, where):
    """A signal at rest, at first or throughout: the scale of a block is not that of the next."""
    phi = np.random.default_rng(1).normal(size=(60, 1, 4)) * [1.0, 1e-5, 1e5, 1.0]
    last = {"everywhere": 60, "first block": 20, "all but the last block": 40}[where]
    phi[:last, :, zeros] = 0.0
    found, whole = Factor.of_blocks(blocks_of(phi, [20])), Projection.factor(phi)
    assert np.isfinite(found.r).all() and np.isfinite(found.scale).all()
    if where == "everywhere":  # rank-deficient: R is not unique, RᵀR is
        assert not found.r[:, zeros].any()
        unit = 1 / np.where(phi.any(axis=(0, 1)), np.linalg.norm(phi[:, 0], axis=0), 1.0)
        grams = [r.T @ r for r in (found.to_coordinates * unit, whole.to_coordinates * unit)]
        np.testing.assert_allclose(grams[0], grams[1], rtol=0, atol=1e-14)
    else:
        assert_same_columns(upper(found), upper(whole), 1e-12)


def test_blocks_without_physics():
    found = Factor.of_blocks([np.zeros((7, 2, 0)), np.zeros((3, 2, 0))])
    assert found.r.shape == (0, 0) and found.to_coordinates.shape == (0, 0)
    assert found.covariance_factor().shape == (0, 0)


def test_no_blocks_no_factor():
    with pytest.raises(ValueError, match="at least one block"):
        Factor.of_blocks([])


def through_blocks(phi, y, sizes):
    """Least squares from R of `[Φ y]` in blocks, all that stays where the rows do not."""
    both = Factor.of_blocks(blocks_of(np.concatenate([phi, y[..., None]], axis=2), sizes))
    nt = phi.shape[2]
    r = both.to_coordinates
    return Factor(both.r[:nt, :nt], both.scale[:nt]).from_coordinates(r[:nt, nt])


def ill_conditioned(name, rng):
    """Columns as NIST's are: Wampler's powers up to the fifth, or columns that differ in their last digits."""
    if name == "powers":
        phi, beta = (np.arange(21.0) + rng.uniform(size=21))[:, None] ** np.arange(6), np.ones(6)
    elif name == "a large mean":
        phi, beta = (
            np.stack([np.ones(40), 1e7 + rng.normal(size=40)], axis=1),
            np.array([-3e7, 3.0]),
        )
    else:
        phi = rng.normal(size=(50, 1)) + 1e-6 * rng.normal(size=(50, 4))
        beta = np.array([1.0, -2.0, 3.0, -4.0])
    return phi[:, None], beta


@pytest.mark.parametrize("sizes", [[1], [4, 9], [21], [1000]], ids=str)
@pytest.mark.parametrize("name", ["powers", "a large mean", "almost the same"])
def test_least_squares_through_blocks_has_the_digits_of_qr(name, sizes):
    """Within a digit on the average of ten draws, one of which is luck: many small blocks round more often."""
    rng, found, reference = np.random.default_rng(8), [], []
    for _ in range(10):
        phi, beta = ill_conditioned(name, rng)
        y = phi @ beta + 1e-3 * rng.normal(size=(len(phi), 1))
        with mpmath.workdps(50):
            exact = mpmath.matrix(phi[:, 0].tolist())
            certified = list((exact.T * exact) ** -1 * (exact.T * mpmath.matrix(y.tolist())))
        found.append(digits(through_blocks(phi, y, sizes), certified))
        reference.append(digits(scaled_qr(phi[:, 0], y[:, 0]), certified))
    assert np.mean(found) >= np.mean(reference) - 1.0


@pytest.mark.parametrize("name", NIST)
def test_nist_digits_through_blocks(data_folder, name):
    """On the average of ten orders of the rows: what one order gives is luck, and differs between kinds of BLAS."""
    phi, y, certified = nist(data_folder, name)
    rng, found, reference = np.random.default_rng(3), [], []
    for _ in range(10):
        order = rng.permutation(len(y))
        found.append(digits(through_blocks(phi[order], y[order], [5, 3]), certified["beta"]))
        reference.append(digits(scaled_qr(phi[order, 0], y[order, 0]), certified["beta"]))
    assert np.mean(found) >= np.mean(reference) - 1.0


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


def test_directions_that_differ_in_what_no_row_tells_are_one():
    phi = np.zeros((20, 1, 3))
    phi[:, 0, :2] = np.random.default_rng(1).normal(size=(20, 2))
    projection, basis = Projection.factor(phi), np.array([[1.0, 1.0], [0.5, 0.5], [0.0, 7.0]])
    found = projection.without_null(basis)
    assert found.shape == (3, 1) and np.linalg.matrix_rank(phi[:, 0] @ found) == 1
    assert np.array_equal(projection.without_null(basis[:, :1]), basis[:, :1])
