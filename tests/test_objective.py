"""The free-run criterion is a function of p and where it starts from: no call changes what another one gives."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import jax
import numpy as np
import pytest

from orthaug import (
    MLP,
    Additive,
    Baseline,
    BaselinePenalty,
    Orthogonal,
    OrthogonalPenalty,
    Record,
    Simulation,
    Term,
    synthetic,
)
from orthaug.fitting.initial_states import Start
from orthaug.fitting.one_step import OneStepTask
from orthaug.fitting.segmented_lagged import SegmentedLagged, StructuredObjective
from orthaug.fitting.solvers.damped_step import MARQUARDT
from orthaug.fitting.solvers.limit import Limit
from orthaug.fitting.solvers.minimize import SquaredResiduals, minimize
from orthaug.physics.problem import pose

ROWS, CRITERION = 600, Simulation(64, 16, 5)
KINDS = {
    "orthogonal": Orthogonal(),
    "additive": Additive(),
    "orthogonal penalty": OrthogonalPenalty(1.0),
    "baseline penalty": BaselinePenalty(1.0),
    "bounds": Orthogonal(),
}


@cache
def objective(kind="orthogonal") -> StructuredObjective:
    """On the noisy mass-spring-damper; segments have a washout, so their states are free."""
    example = synthetic.mass_spring_damper()
    (experiment,) = example.train.experiments
    y = experiment.outputs + 0.02 * experiment.outputs.std() * np.random.default_rng(0).normal(
        size=(10_000, 1)
    )
    names = {"inputs": ["force"], "outputs": ["position"], "sampling_time": 0.01}
    record = Record.from_arrays(experiment.inputs, y, **names).rows(0, ROWS)
    baseline = example.baseline
    if kind == "bounds":
        terms = [Term(t.parameter, t.regressor, t.initial, min=-5, max=5) for t in baseline.terms]
        baseline = Baseline.from_terms(terms)
    task = OneStepTask.of(pose(record, baseline), MLP(hidden=(3,)))
    found = SegmentedLagged.of(task, CRITERION).objective(KINDS[kind])
    assert found.initial.free and found.follows == (kind == "bounds")
    return found


def nowhere(given) -> Start:
    return Start(given.initial.measured)


def points(given) -> tuple[np.ndarray, np.ndarray]:
    """A start and another place near it."""
    p = given.begin(np.asarray(given.task.bound.init(jax.random.key(0))))
    return p, p * (1 + 0.01 * np.random.default_rng(1).normal(size=len(p)))


def assert_same(one, other):
    """Every array of two trials, or of two linearisations, bit for bit."""
    for a, b in zip(jax.tree.leaves(tuple(one)), jax.tree.leaves(tuple(other)), strict=True):
        np.testing.assert_array_equal(a, b)


def copied(found):
    return jax.tree.map(lambda a: np.array(a, copy=True), tuple(found))


def test_the_objective_is_what_the_solver_takes():
    assert isinstance(objective(), SquaredResiduals)


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_p_has_the_same_loss_in_any_order_of_calls(kind):
    given = objective(kind)
    p, q = points(given)
    start = nowhere(given)
    first = given.evaluate(p, start)
    kept = copied(first)
    there = given.evaluate(q, start)
    assert there.loss != first.loss and np.isfinite([first.loss, there.loss]).all()
    linear = given.linearise(there)
    assert_same(given.evaluate(p, start), kept)
    given.evaluate(p, linear.start), given.linearise(given.evaluate(p, linear.start))
    assert_same(given.evaluate(p, start), kept)
    assert_same(given.evaluate(q, start), copied(there))
    assert_same(first, kept)  # nothing is written to what was handed out


@pytest.mark.parametrize("kind", KINDS)
def test_a_linearisation_is_that_of_its_trial(kind):
    """Whatever was flown or linearised in between."""
    given = objective(kind)
    p, q = points(given)
    point = given.evaluate(p, nowhere(given))
    first = copied(given.linearise(point))
    other = given.linearise(given.evaluate(q, nowhere(given)))
    given.samples(given.evaluate(q, other.start))
    assert_same(given.linearise(point), first)
    assert_same(given.linearise(given.evaluate(p, nowhere(given))), first)


@pytest.mark.parametrize("kind", ["orthogonal", "bounds"])
def test_a_trial_with_followed_states_can_be_repeated(kind):
    given = objective(kind)
    p, q = points(given)
    linear = given.linearise(given.evaluate(p, nowhere(given)))
    first = copied(given.evaluate(q, linear.start))
    rejected = given.evaluate(p + 0.5 * (q - p), linear.start)
    given.evaluate(2 * q, linear.start), given.linearise(rejected)
    assert_same(given.evaluate(q, linear.start), first)


def test_states_follow_only_where_that_lowers_the_misfit():
    """They start as measured; after one linearisation a trial at the same p has better ones."""
    given = objective()
    p, _ = points(given)
    point = given.evaluate(p, nowhere(given))
    np.testing.assert_array_equal(point.states, given.initial.measured)
    linear = given.linearise(point)
    again = given.evaluate(p, linear.start)
    assert again.misfit < point.misfit and not np.array_equal(again.states, point.states)
    worse = linear.start._replace(offset=-1e3 * linear.start.offset)
    np.testing.assert_array_equal(given.evaluate(p, worse).states, point.states)


class Rejecting:
    """The objective, with a trial at somewhere far off, and its linearisation, before every call."""

    def __init__(self, given, far):
        self.given, self.far, self.physics = given, far, given.physics

    def disturb(self, start):
        rejected = self.given.evaluate(self.far, start)
        if np.isfinite(rejected.loss):
            self.given.samples(rejected), self.given.linearise(rejected)

    def evaluate(self, p, start):
        self.disturb(start)
        return self.given.evaluate(p, start)

    def linearise(self, point):
        self.disturb(nowhere(self.given))
        return self.given.linearise(point)

    def samples(self, point):
        self.disturb(nowhere(self.given))
        return self.given.samples(point)


@pytest.mark.parametrize("evidence", [False, True], ids=["plain", "evidence"])
def test_a_rejected_trial_leaves_nothing_behind(evidence):
    given = objective()
    p, q = points(given)
    options = {
        "limit": Limit(6, 6),
        "tolerance": 1e-9,
        "damping": MARQUARDT,
        "ridge": 1.0,
        "evidence": evidence,
    }
    plain = minimize(given, p, nowhere(given), **options)
    disturbed = minimize(Rejecting(given, q), p, nowhere(given), **options)
    assert (
        plain.ending.code == "iteration_limit"
        and plain.point.loss < given.evaluate(p, nowhere(given)).loss
    )
    assert_same(plain.point, disturbed.point)
    assert_same(plain.linear, disturbed.linear)
    assert (plain.ridge, plain.effective, plain.iterations) == (
        disturbed.ridge,
        disturbed.effective,
        disturbed.iterations,
    )


def test_two_objectives_share_nothing():
    given = objective()
    p, q = points(given)
    other = replace(given, weight=2 * given.weight)
    first = given.evaluate(p, nowhere(given)).loss
    other.linearise(other.evaluate(q, nowhere(other)))
    assert given.evaluate(p, nowhere(given)).loss == first
    assert other.evaluate(p, nowhere(other)).loss == pytest.approx(4 * first, rel=1e-12)
