"""Excitation: rank, condition, and the names of what cannot be told apart."""

from __future__ import annotations

import numpy as np
import pytest

from orthaug import Baseline, InputError, RankError, Record, Term, identifiability
from orthaug.physics.excitation import excitation, require_rank
from orthaug.physics.problem import pose
from orthaug.physics.projection import Projection

A, B, C, D = np.random.default_rng(5).normal(size=(4, 30))


def of(*columns, names="abcdefg"):
    """Excitation of the R factor of these columns."""
    phi = np.stack(columns, axis=1)[:, None]
    return excitation(Projection.factor(phi).r, list(names[: len(columns)]))


def test_full_rank():
    found = of(A, 1e9 * B, 1e-9 * C)
    assert (found.rank, found.columns, found.collinear) == (3, 3, ())
    assert found.full_rank
    require_rank(found, 30)
    unit = np.stack([v / np.linalg.norm(v) for v in (A, B, C)], axis=1)
    np.testing.assert_allclose(found.condition, np.linalg.cond(unit), rtol=1e-12)


def test_condition_of_nearly_parallel_columns():
    found = of(A, A + 1e-6 * B)
    assert found.full_rank and 1e5 < found.condition < 1e8
    assert of(A, A + 1e-11 * B).full_rank  # ill-conditioned, not deficient
    assert not of(A, A + 1e-15 * B).full_rank


def test_collinear_columns_are_named():
    found = of(A, B, 2 * A - B, C)
    assert (found.rank, found.condition, found.collinear) == (3, None, (("a", "b", "c"),))
    message = r"rank-deficient on the data \(rank 3 of 4\): the columns of a, b, c are linearly dependent. Remove"
    with pytest.raises(RankError, match=message):
        require_rank(found, 30)
    assert issubclass(RankError, InputError)


def test_groups_are_kept_apart():
    found = of(A, B, 3 * A, C, -B, 5 * A)
    assert found.rank == 3
    assert found.collinear == (("a", "c", "f"), ("b", "e"))
    with pytest.raises(
        RankError, match="the columns of a, c, f are linearly dependent; the columns of b, e are"
    ):
        require_rank(found, 30)


def test_zero_column():
    found = of(A, 0 * A, B)
    assert (found.rank, found.collinear) == (2, (("b",),))
    with pytest.raises(RankError, match="rank 2 of 3.: the column of b is zero"):
        require_rank(found, 30)


def test_zero_and_collinear():
    found = of(A, 0 * A, 2 * A)
    assert (found.rank, found.collinear) == (1, (("a", "c"), ("b",)))


def test_all_zero():
    found = of(0 * A, 0 * A)
    assert (found.rank, found.condition, found.collinear) == (0, None, (("a",), ("b",)))


def test_no_parameters():
    found = excitation(np.zeros((0, 0)), [])
    assert (found.rank, found.columns, found.condition, found.collinear) == (0, 0, None, ())
    assert found.full_rank
    require_rank(found, 0)


def test_more_columns_than_rows():
    found = of(A[:2], B[:2], C[:2])
    assert (found.rank, found.columns, found.condition) == (2, 3, None)
    assert found.collinear == (("a", "b", "c"),)
    with pytest.raises(
        RankError, match="2 usable rows for 3 parameters; give at least as many rows as parameters"
    ):
        require_rank(found, 2)


LAYOUT = Baseline.from_terms([Term("a", "y[k-1]"), Term("b", "u[k]")]).lags


def test_identifiable_but_not_excited():
    baseline = Baseline.from_terms([Term("a", "y[k-1]"), Term("b", "u[k]")])
    x = np.stack([A, 2 * A], axis=1)
    assert identifiability(baseline, LAYOUT, ("y",), x).full_rank
    assert not excitation(
        Projection.factor(baseline.phi(x, LAYOUT, ("y",), np)).r, baseline.names
    ).full_rank


def test_not_identifiable():
    baseline = Baseline.from_terms(
        [Term("a", "y[k-1]"), Term("b", "u[k]"), Term("c", "y[k-1] - 2*u[k]")]
    )
    found = identifiability(baseline, LAYOUT, ("y",), np.stack([A, B], axis=1))
    assert (found.rank, found.collinear) == (2, (("a", "b", "c"),))


def test_identifiability_leaves_out_points_without_a_value():
    baseline = Baseline.from_terms([Term("a", "sqrt(y[k-1])"), Term("b", "1")])
    assert identifiability(baseline, LAYOUT, ("y",), np.stack([A, B], axis=1)).full_rank
    fixed = Baseline.from_terms([Term("a", "1", initial=1.0, fixed=True)])
    assert identifiability(fixed, LAYOUT, ("y",), np.stack([A, B], axis=1)).full_rank


def both(record, *texts):
    """(identifiability, excitation) of terms a, b, c, … on a record."""
    baseline = Baseline.from_terms([Term("abc"[i], text) for i, text in enumerate(texts)])
    problem = pose(record, baseline, require_full_rank=False)
    return identifiability(
        baseline, problem.layout, problem.outputs, problem.rows.x
    ), problem.excitation


DECAY = 0.5 ** np.arange(20.0)  # a free decay: y[k-2] is twice y[k-1]
RECORDS = {
    "random": Record.from_arrays(A[:20], B[:20]),
    "decay": Record.from_arrays(A[:20], DECAY),
    "two levels": Record.from_arrays(np.sign(A), B),
    "slow": Record.from_arrays(np.repeat([0.0, 1.0], 15), np.arange(30.0)),
}


@pytest.mark.parametrize(
    ("name", "texts", "identifiable", "excited"),
    [
        ("random", ["y[k-1]", "y[k-2]"], (), ()),
        ("random", ["u[k]", "2*u[k]"], (("a", "b"),), (("a", "b"),)),
        ("random", ["u[k]", "y[k-1]", "2*u[k] - y[k-1]"], (("a", "b", "c"),), (("a", "b", "c"),)),
        ("random", ["sin(u[k])**2", "cos(u[k])**2", "1"], (("a", "b", "c"),), (("a", "b", "c"),)),
        ("random", ["u[k] - u[k]", "u[k]"], (("a",),), (("a",),)),
        ("decay", ["y[k-1]", "y[k-2]"], (), (("a", "b"),)),
        ("decay", ["y[k-1]", "y[k-2]", "u[k]"], (), (("a", "b"),)),
        ("two levels", ["u[k]", "u[k]**3"], (), (("a", "b"),)),
        ("two levels", ["u[k]", "sign(u[k])", "y[k-1]"], (), (("a", "b"),)),
        ("slow", ["y[k-1]", "y[k-2]", "1"], (), (("a", "b", "c"),)),
    ],
)
def test_identifiability_against_excitation(name, texts, identifiable, excited):
    """What no data could tell apart, and what only these data cannot."""
    anywhere, here = both(RECORDS[name], *texts)
    assert (anywhere.collinear, here.collinear) == (identifiable, excited)
    assert anywhere.full_rank == (not identifiable) and here.full_rank == (not excited)
    assert (anywhere.condition is None) == bool(identifiable)


def test_identifiability_of_shared_parameters():
    """One parameter in two outputs is found from either; two parameters that only meet as a sum are not."""
    record = Record.from_arrays(A, np.stack([B, C], axis=1))
    shared = Baseline.from_terms([Term("a", "u[k]", output="y1"), Term("a", "2*u[k]", output="y2")])
    summed = Baseline.from_terms([Term(n, "u[k]", output=o) for n in "ab" for o in ("y1", "y2")])
    for baseline, groups in ((shared, ()), (summed, (("a", "b"),))):
        problem = pose(record, baseline, require_full_rank=False)
        found = identifiability(baseline, problem.layout, problem.outputs, problem.rows.x)
        assert found.collinear == problem.excitation.collinear == groups


def test_identifiability_is_the_same_every_time():
    anywhere = [both(RECORDS["random"], "u[k]", "u[k]**3", "y[k-1]")[0] for _ in range(2)]
    assert anywhere[0].condition == anywhere[1].condition
