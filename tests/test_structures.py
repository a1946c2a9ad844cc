"""Structures: their penalty rows, θ taken out of the criterion, and the unit of λ."""

from __future__ import annotations

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from orthaug import (
    Additive,
    Baseline,
    BaselinePenalty,
    Function,
    InputError,
    LevenbergMarquardt,
    Orthogonal,
    OrthogonalPenalty,
    Record,
    Term,
    estimate,
)
from orthaug.fitting.elimination import Elimination, eliminate
from orthaug.fitting.structures import PenaltyRows, Structure

ALL = (Orthogonal(), Additive(), OrthogonalPenalty(0.3), BaselinePenalty(0.3))
NAMES, INITIAL = ("a", "b", "c"), np.array([0.5, -2.0, 4.0])
NO_BOUNDS = (np.full(3, -np.inf), np.full(3, np.inf))


# --- rows


@pytest.mark.parametrize("structure", ALL, ids=lambda s: s.name)
def test_every_structure_keeps_the_contract(structure):
    assert isinstance(structure, Structure)
    theta, learner, target = structure.penalty(NAMES, INITIAL, 2.0)
    assert theta.shape == learner.shape == (len(target), 3)


@pytest.mark.parametrize("structure", [Orthogonal(), Additive()], ids=lambda s: s.name)
def test_no_penalty_no_rows(structure):
    assert structure.penalty(NAMES, INITIAL, 2.0).target.size == 0


def test_rows_of_the_orthogonal_penalty():
    theta, f = np.array([1.0, 2.0, 3.0]), np.array([0.1, -0.2, 0.4])
    rows = OrthogonalPenalty(0.3).penalty(NAMES, INITIAL, 2.0)
    rest = rows.target - rows.theta @ theta - rows.learner @ f
    np.testing.assert_allclose(rest @ rest, 0.3 * f @ f)


def test_rows_of_the_baseline_penalty():
    theta, f = np.array([1.0, 2.0, 3.0]), np.array([0.1, -0.2, 0.4])
    rows = BaselinePenalty(0.3).penalty(NAMES, INITIAL, 2.0)
    rest = rows.target - rows.theta @ theta - rows.learner @ f
    np.testing.assert_allclose(
        rest @ rest, 0.3 * 2.0**2 * np.sum(((theta - INITIAL) / INITIAL) ** 2)
    )


def test_the_baseline_penalty_needs_initial_values():
    with pytest.raises(InputError, match=r"a, c start at 0.*`initial`.*orthogonal structure"):
        BaselinePenalty().penalty(NAMES, np.array([0.0, 1.0, 0.0]), 1.0)


def test_an_initial_value_of_zero_is_refused_before_training():
    record, baseline = (
        Record.from_arrays(np.arange(9.0), np.arange(9.0) ** 2),
        Baseline.from_terms([Term("b", "u[k]")]),
    )
    with pytest.raises(InputError, match="but b starts at 0"):
        estimate(record, baseline, structure=BaselinePenalty())


# --- θ taken out of the criterion

ROWS = {"none": 0, "fewer than entries": 2, "as many": 3, "more": 6}
FIXED = ({}, {1: 0.7}, {2: -0.3, 0: 1.2}, {0: 0.1, 1: 0.2, 2: 0.3})


def elimination(rows=0, bounds=NO_BOUNDS, seed=0):
    """Random coordinates, outputs and rows for three entries of θ; one direction of the learner is moved to θ."""
    rng = np.random.default_rng(seed)
    penalty = PenaltyRows(
        rng.normal(size=(rows, 3)), rng.normal(size=(rows, 3)), rng.normal(size=rows)
    )
    coordinates, outputs, direction = (
        rng.normal(size=(3, 3)),
        3 * rng.normal(size=3),
        rng.normal(size=3),
    )
    taken = np.outer(direction, direction) / (direction @ direction)
    return Elimination(coordinates, outputs, taken, penalty, *bounds)


def stacked(given, f):
    """Matrix and right-hand side of the whole quadratic in θ, written out."""
    matrix = np.vstack([given.to_coordinates, given.rows.theta])
    return matrix, np.concatenate(
        [given.outputs - f + given.taken @ f, given.rows.target - given.rows.learner @ f]
    )


def least(given, f, fixed):
    """Minimum and minimising θ with some entries held, by plain least squares."""
    matrix, right = stacked(given, f)
    free = [i for i in range(3) if i not in fixed]
    theta = np.array([fixed.get(i, 0.0) for i in range(3)])
    if free:
        theta[free] = np.linalg.lstsq(matrix[:, free], right - matrix @ theta, rcond=None)[0]
    return np.sum((right - matrix @ theta) ** 2), theta


@pytest.mark.parametrize("fixed", FIXED, ids=str)
@pytest.mark.parametrize("rows", ROWS.values(), ids=ROWS.keys())
def test_what_remains_is_the_minimum_over_theta(rows, fixed):
    given = elimination(rows)
    matrix, target = given.hold(fixed)
    assert matrix.shape == (3, 3) and target.shape == (3,)
    many = (
        np.random.default_rng(1).normal(size=(8, 3))
        * np.array([0.01, 0.1, 1, 1, 1, 10, 10, 100])[:, None]
    )
    minima = np.array([least(given, f, fixed)[0] for f in many])
    constants = minima - np.sum((target - many @ matrix.T) ** 2, axis=1)
    np.testing.assert_allclose(constants, constants[0], atol=1e-12 * np.sum(many**2))
    assert constants[0] >= -1e-9


def test_a_theta_that_can_follow_leaves_nothing():
    matrix, target = elimination(0).hold({})
    assert not matrix.any() and not target.any()


@pytest.mark.parametrize("structure", ALL, ids=lambda s: s.name)
@pytest.mark.parametrize("f", [np.zeros(3), np.array([1.0, -2.0, 3.0])], ids=["f = 0", "f"])
def test_hold_of_every_structure(structure, f):
    penalty = structure.penalty(NAMES, INITIAL, 2.0)
    given = Elimination(np.diag([3.0, 2.0, 1.0]), np.ones(3), np.zeros((3, 3)), penalty, *NO_BOUNDS)
    matrix, target = given.hold({})
    apart = least(given, f, {})[0] - least(given, np.ones(3), {})[0]
    held = np.sum((target - matrix @ f) ** 2) - np.sum((target - matrix @ np.ones(3)) ** 2)
    np.testing.assert_allclose(held, apart, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("fixed", FIXED, ids=str)
@pytest.mark.parametrize("rows", ROWS.values(), ids=ROWS.keys())
def test_theta_minimises(rows, fixed):
    given, f = elimination(rows), np.array([0.3, -1.0, 2.0])
    np.testing.assert_allclose(given.theta(f, fixed), least(given, f, fixed)[1], rtol=1e-11)


def enumerated(given, f):
    """The bounded minimum by trying every set of entries at a bound."""
    choices = [
        [None, *(b for b in (given.lower[i], given.upper[i]) if np.isfinite(b))]
        for i in range(len(given.lower))
    ]
    found = []
    for sides in itertools.product(*choices):
        value, theta = least(
            given, f, {i: side for i, side in enumerate(sides) if side is not None}
        )
        if np.all(theta >= given.lower - 1e-12) and np.all(theta <= given.upper + 1e-12):
            found.append((value, *theta))
    return np.array(min(found)[1:])


BOXES = [
    (np.full(3, -0.5), np.full(3, 0.5)),
    (np.array([-np.inf, 0.0, -np.inf]), np.array([0.0, np.inf, np.inf])),
    (np.array([-0.1, -np.inf, -0.1]), np.array([0.1, np.inf, 0.1])),
    (np.full(3, -1e3), np.full(3, 1e3)),
]


@pytest.mark.parametrize("box", BOXES, ids=["within", "signs", "two within", "wide"])
@pytest.mark.parametrize("rows", ROWS.values(), ids=ROWS.keys())
@pytest.mark.parametrize("seed", range(3))
def test_bounded_theta(box, rows, seed):
    given = elimination(rows, box, seed)
    f = np.random.default_rng(seed).normal(size=3)
    active = given.active(f)
    theta = given.theta(f, active)
    assert all(value in (given.lower[i], given.upper[i]) for i, value in active.items())
    np.testing.assert_allclose(theta, enumerated(given, f), rtol=1e-9, atol=1e-12)
    matrix, right = stacked(given, f)
    independent = scipy.optimize.minimize(
        lambda t: np.sum((right - matrix @ t) ** 2),
        np.clip(np.zeros(3), *box),
        jac=lambda t: -2 * matrix.T @ (right - matrix @ t),
        bounds=scipy.optimize.Bounds(*box),
        method="SLSQP",
        options={"ftol": 1e-15, "maxiter": 500},
    )
    assert np.sum((right - matrix @ theta) ** 2) <= independent.fun + 1e-9 * (right @ right)


def test_columns_of_very_different_size():
    """A column of 1e-8 beside one of 1e8, as metres beside newtons: the bounds are those of θ itself."""
    rng = np.random.default_rng(3)
    size = np.array([1e8, 1.0, 1e-8])
    box = np.array([-0.1, -1.0, -2.0]) / size, np.array([0.1, 1.0, 0.05]) / size
    square, outputs = rng.normal(size=(3, 3)), rng.normal(size=3)
    rows = PenaltyRows(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    nothing = np.zeros((3, 3))
    given = Elimination(square * size, outputs, nothing, rows, *box)
    plain = Elimination(square, outputs, nothing, rows, box[0] * size, box[1] * size)
    f = np.zeros(3)
    np.testing.assert_allclose(
        given.theta(f, given.active(f)) * size, enumerated(plain, f), rtol=1e-9
    )


def test_without_bounds_nothing_is_active():
    assert elimination().active(np.ones(3)) == {}


# --- the unit of λ

LEARNER = Function(
    lambda w, z: w @ jnp.stack([z[0] ** 2, z[0] * z[1], z[1] ** 2]), lambda key: jnp.zeros((1, 3))
)
TWO = Function(
    lambda w, z: w @ jnp.stack([z[0] ** 2, z[0] * z[1], z[1] ** 2]), lambda key: jnp.zeros((2, 3))
)
SOLVER = LevenbergMarquardt(200, tolerance=1e-14)


def measured(scale=(1.0,), shift=0.0):
    """Outputs in other units: each row of `scale` times the same noisy curve in u and v."""
    rng = np.random.default_rng(0)
    u = rng.uniform(0, 1, (60, 2))  # not centred, so that curve and physics are not orthogonal
    base = np.stack([u @ [1.0, 0.5] + u[:, 0] ** 2, u @ [-0.4, 2.0] + u[:, 0] * u[:, 1]], axis=1)
    y = (base + 0.1 * rng.normal(size=base.shape))[:, : len(scale)] * scale
    return u, y, Record.from_arrays(u, y)


def physics(ny, initial):
    names = ["y"] if ny == 1 else ["y1", "y2"]
    return Baseline.from_terms(
        [Term(f"{p}{i}", f"{p}[k]", initial[2 * i + j], output=y)
         for i, y in enumerate(names) for j, p in enumerate(("u1", "u2"))]
    )  # fmt: skip


def by_hand(structure, u, y, initial, spread):
    """θ and predictions of the linear-in-weights problem in the outputs' units, by one least squares."""
    n, ny = y.shape
    z = 2 * (u - u.min(axis=0)) / np.ptp(u, axis=0) - 1
    curve = np.stack([z[:, 0] ** 2, z[:, 0] * z[:, 1], z[:, 1] ** 2], axis=1)
    phi = np.kron(np.diag(1 / spread), u)
    psi = np.kron(np.diag(1 / spread), curve)
    right = (y / spread).T.ravel()
    root = np.sqrt(structure.weight)
    if isinstance(structure, OrthogonalPenalty):
        rows = np.hstack([np.zeros((2 * ny, 2 * ny)), root * np.linalg.qr(phi)[0].T @ psi])
        extra = np.zeros(2 * ny)
    else:
        rows = np.hstack([root * np.diag(1 / np.array(initial)), np.zeros((2 * ny, 3 * ny))])
        extra = root * np.ones(2 * ny)
    found = np.linalg.lstsq(
        np.vstack([np.hstack([phi, psi]), rows]), np.concatenate([right, extra]), rcond=None
    )[0]
    fitted = (np.hstack([phi, psi]) @ found).reshape(ny, n).T * spread
    return found[: 2 * ny], fitted


@pytest.mark.parametrize("scale", [(1.0,), (1000.0,), (1.0, 1.0), (1000.0, 0.01)], ids=str)
@pytest.mark.parametrize("kind", [OrthogonalPenalty, BaselinePenalty])
def test_lambda_counts_in_the_units_of_one_output_and_in_deviations_of_several(kind, scale):
    u, y, record = measured(scale)
    ny = len(scale)
    initial = [0.3, 0.7, -0.2, 1.1][: 2 * ny]
    structure = kind(5.0)
    fit = estimate(
        record,
        physics(ny, initial),
        learner=LEARNER if ny == 1 else TWO,
        structure=structure,
        solver=SOLVER,
        regularization="none",
    )
    spread = np.ones(1) if ny == 1 else y.std(axis=0)
    theta, fitted = by_hand(structure, u, y, initial, spread)
    np.testing.assert_allclose(fit.theta, theta, rtol=1e-7)
    np.testing.assert_allclose(fit.model.predict(record).trajectories[0].model, fitted, rtol=1e-7)


@pytest.mark.parametrize(("kind", "power"), [(OrthogonalPenalty, 0), (BaselinePenalty, 2)])
def test_another_unit_of_one_output_with_lambda_in_it(kind, power):
    """θ and the predictions are the same numbers in the other unit; λ‖QᵀF‖² has the unit of the sum already."""
    fits = []
    for scale in (1.0, 1000.0):
        record = measured((scale,))[2]
        baseline = physics(1, [0.3 * scale, 0.7 * scale])
        fits.append(
            estimate(
                record,
                baseline,
                learner=LEARNER,
                structure=kind(2.0 * scale**power),
                solver=SOLVER,
                regularization="none",
            )
        )
        values = fits[-1].model.predict(record).trajectories[0].model / scale
        fits[-1] = (fits[-1].theta / scale, values)
    np.testing.assert_allclose(fits[0][0], fits[1][0], rtol=1e-9)
    np.testing.assert_allclose(fits[0][1], fits[1][1], rtol=1e-9)


@pytest.mark.parametrize("kind", [OrthogonalPenalty, BaselinePenalty])
def test_the_unit_of_one_of_several_outputs_does_not_matter(kind):
    fits = []
    for scale in ((1.0, 1.0), (1000.0, 1.0)):
        record = measured(scale)[2]
        factor = np.repeat(scale, 2)
        fit = estimate(
            record,
            physics(2, [0.3, 0.7, -0.2, 1.1] * factor),
            learner=TWO,
            structure=kind(2.0),
            solver=SOLVER,
            regularization="none",
        )
        fits.append(fit.theta / factor)
    np.testing.assert_allclose(fits[0], fits[1], rtol=1e-9)


def test_the_elimination_of_a_problem_is_in_whitened_outputs():
    u, y, record = measured((1000.0,))
    fit = estimate(record, physics(1, [1.0, 1.0]), learner=None)
    given = eliminate(Additive(), fit.problem)
    np.testing.assert_allclose(
        given.theta(np.zeros(2), {}), np.linalg.lstsq(u, y[:, 0], rcond=None)[0], rtol=1e-10
    )
    np.testing.assert_allclose(
        np.linalg.norm(given.to_coordinates, axis=0), np.linalg.norm(u, axis=0) / y.std()
    )
