"""Learners that add forces: what they move through the inverse of a mass matrix, and its slopes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import orthaug as oa
from orthaug import InputError, MassMatrix, Motion, PhysicalParameter, State
from orthaug._base.jax import jnp
from orthaug.data.expressions import parse_named
from orthaug.inference.splitting import slopes_at
from orthaug.models.dynamics import AutodiffDynamics, Numbers
from orthaug.models.learners import Bound
from orthaug.models.motion_field import labels_of, parts_at
from orthaug.models.moving import MotionDynamics
from orthaug.physics.suspected_motion import SuspectedMotion, SuspectedTerm

FORCES = (("first_torque", "N m"), ("second_torque", "N m"))


def inertia(x: Any, p: Any) -> Any:
    """Return M of two links that turn by x[0] and x[1]."""
    coupling = 0.4 * p[0] * jnp.cos(x[1])
    return jnp.array([[1.0 + 2 * coupling, coupling], [coupling, 0.3 * p[0]]])


def links(mass: MassMatrix | None = None) -> Motion:
    """Return two links with springs and one torque, by functions."""

    def rates(x: Any, u: Any, p: Any) -> Any:
        coupling = 0.4 * p[0] * jnp.cos(x[1])
        a, b, c = 1.0 + 2 * coupling, coupling, 0.3 * p[0]
        first, second = u[0] - 2.0 * x[0] - p[1] * x[2], -x[1] - 0.1 * x[3]
        det = a * c - b * b
        return jnp.stack(
            [x[2], x[3], (c * first - b * second) / det, (a * second - b * first) / det]
        )

    states = [State("q", None, "q"), State("s", None, "s")]
    states += [State("v", None, 0.0, learned=True), State("w", None, 0.0, learned=True)]
    own = {} if mass is None else {"mass": mass}
    return Motion.from_functions(
        rates,
        lambda x, u, p: x[:2],
        states,
        ["q", "s"],
        [PhysicalParameter("m", 0.8, min=0.0), PhysicalParameter("d", 0.2, min=0.0)],
        ["u"],
        substeps=2,
        **own,
    )


MASS = MassMatrix(inertia, (2, 3), FORCES)


def test_forces_and_rates_are_each_others_inverse() -> None:
    rng = np.random.default_rng(0)
    x, p, forces = rng.normal(size=(4, 5)), np.array([0.8, 0.2]), rng.normal(size=(4, 5))
    rates = np.asarray(MASS.rates(forces, x, p))
    by_hand = [
        np.linalg.solve(np.asarray(inertia(point, p)), row[2:])
        for point, row in zip(x.T, forces.T, strict=True)
    ]
    np.testing.assert_allclose(rates[2:].T, by_hand, rtol=1e-12)
    np.testing.assert_array_equal(rates[:2], forces[:2])
    np.testing.assert_allclose(MASS.balance(rates, x, p), forces, rtol=1e-12)
    entries = MASS.entries(x.T, p)
    np.testing.assert_allclose(np.einsum("mij,jm->im", entries, forces), rates, rtol=1e-12)
    assert MASS.label(2) == ("first_torque", "N m") and MASS.label(0) is None


def test_a_large_mass_matrix_is_solved_too() -> None:
    rng = np.random.default_rng(1)
    a = rng.normal(size=(9, 9))
    matrix = a @ a.T + np.eye(9)
    mass = MassMatrix(lambda x, p: jnp.asarray(matrix), tuple(range(9)), (("f", "N"),) * 9)
    force = rng.normal(size=9)
    found = mass.rates(force, np.zeros(9), np.zeros(0))
    np.testing.assert_allclose(found, np.linalg.solve(matrix, force), rtol=1e-10)


def with_learner(motion: Motion) -> tuple[MotionDynamics, Numbers]:
    """Return a motion with a learner of random weights that sees velocities and a place."""
    features = tuple(parse_named(text, motion.known, "feature") for text in ("v", "w", "s"))
    bound, rng = Bound(oa.MLP((3,)), 3, 2), np.random.default_rng(2)
    weights, q = rng.normal(size=bound.size), motion.coordinates.initial
    scale = np.array([0.2, -0.1, 0.0]), np.array([1.5, 2.0, 1.0])
    numbers = Numbers(q, np.zeros_like(q), weights, *scale, np.array([0.7, 0.3]))
    return MotionDynamics(motion, features, bound, 0.1, 2), numbers


def test_slopes_through_the_mass_matrix_are_those_of_automatic_differentiation() -> None:
    form, numbers = with_learner(links(MASS))
    rng = np.random.default_rng(3)
    states, inputs = rng.normal(size=(4, 7)), rng.normal(size=(1, 7))
    found = form.local(numbers, states, inputs)
    expected = AutodiffDynamics.local(form, numbers, states, inputs)
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-11)
    physics, learned = form.rates(numbers, states[:, 0], inputs[:, 0])
    force = form.learned(numbers, states[:, 0], inputs[:, 0])
    by_hand = np.linalg.solve(np.asarray(inertia(states[:, 0], form.motion.initial)), force)
    np.testing.assert_allclose(learned, [0, 0, *by_hand], rtol=1e-10, atol=1e-14)


def test_the_split_compares_forces() -> None:
    form, numbers = with_learner(links(MASS))
    rng = np.random.default_rng(4)
    x, u = rng.normal(size=(6, 4)), rng.normal(size=(6, 1))
    physics, learner = parts_at(form, numbers, x, u)
    p = form.motion.initial
    forces = MASS.balance(np.asarray(form.motion.rates(x.T, u.T, p, np)), x.T, p)
    np.testing.assert_allclose(physics.T, forces[2:], rtol=1e-10)
    expected = [np.asarray(form.learned(numbers, *row)) for row in zip(x, u, strict=True)]
    np.testing.assert_allclose(learner, expected, rtol=1e-8, atol=1e-10)
    assert labels_of(form) == FORCES
    # Slopes of forces by m: no derivative of M itself, whose forces they are
    slopes = np.asarray(slopes_at(form, form.motion.coordinates.initial, x, u))[:, 2:4]
    step = 1e-6

    def moved(by: float) -> np.ndarray:
        coordinates = form.motion.coordinates
        q = coordinates.initial + by * np.array([1.0, 0.0])
        rates = form.motion.rates(x.T, u.T, coordinates.physical(q), np)
        return np.asarray(MASS.balance(np.asarray(rates), x.T, p))[2:].T

    by_differences = (moved(step) - moved(-step)) / (2 * step)
    np.testing.assert_allclose(slopes[:, :, 0], by_differences, rtol=1e-6, atol=1e-8)


def test_a_suspected_term_is_a_force() -> None:
    plain = links(MASS)
    expression = parse_named("tanh(v/0.1)", plain.known, "term")
    suspected = SuspectedMotion.of(plain, [SuspectedTerm("rub", 2, expression)])
    x, u, p = np.array([0.3, -0.2, 0.5, 1.0]), np.array([0.4]), plain.initial
    added = suspected.rates(x, u, np.append(p, 0.7), jnp) - plain.rates(x, u, p, jnp)
    force = 0.7 * np.tanh(5.0)
    by_hand = np.linalg.solve(np.asarray(inertia(x, p)), [force, 0.0])
    np.testing.assert_allclose(added, [0, 0, *by_hand], rtol=1e-10, atol=1e-14)


def test_a_constant_mass_is_a_change_of_units() -> None:
    """Forces over a constant mass are rates: the runs are equal to rounding."""
    heavy = MassMatrix(lambda x, p: 4.0 * jnp.eye(2), (2, 3), FORCES)
    (form, numbers), (plain, _) = with_learner(links(heavy)), with_learner(links())
    x, u = np.array([0.3, -0.2, 0.5, 1.0]), np.array([0.4])
    of_forces = sum(form.rates(numbers, x, u))
    of_rates = sum(plain.rates(numbers._replace(gain=numbers.gain / 4), x, u))
    np.testing.assert_allclose(of_forces, of_rates, rtol=1e-12)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: MassMatrix(inertia, (2,), FORCES), "1 rows and 2 forces"),
        (lambda: links(MassMatrix(inertia, (3, 4), FORCES)), "has 4 states, numbered from 0"),
    ],
)
def test_rows_that_cannot_be_are_refused(make: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        make()
