"""Which run is kept: starts from physics alone, held-out free runs that choose, and the fallback to physics alone."""

from __future__ import annotations

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_free_run import FREE, LM, NETWORK, PHYSICS, record

from orthaug import (
    MLP,
    Additive,
    Baseline,
    BaselinePenalty,
    EquinoxModule,
    Function,
    Orthogonal,
    OrthogonalPenalty,
    Record,
    Term,
    estimate,
)
from orthaug._base import progress
from orthaug.fitting.free_run import FreeRunTask
from orthaug.fitting.held_out import HeldOutErrors, Ratio, mean_square
from orthaug.fitting.status import Ending
from orthaug.fitting.training import _physics_fails
from orthaug.models.learners import Bound

OPTIONS = {"learner": NETWORK, "criterion": FREE, "solver": LM}


def linear(seed=0, rows=300):
    """Nothing for a learner to find."""
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=rows), np.zeros(rows)
    for k in range(2, rows):
        y[k] = 0.9 * y[k - 1] - 0.3 * y[k - 2] + 0.5 * u[k - 1]
    return Record.from_arrays(u, y + 0.2 * rng.normal(size=rows))


@cache
def chosen():
    return estimate(record(), PHYSICS, restarts=3, **OPTIONS)


def test_the_lowest_error_on_held_out_blocks_is_chosen():
    found = chosen()
    errors = [mean_square(run) for run in found.held_out.runs]
    assert [run.validation for run in found.restarts] == errors and len(errors) == 3
    assert [run.chosen for run in found.restarts] == [error == min(errors) for error in errors]
    assert found.held_out.ratio.code == "helps" and found.held_out.ratio.high < 1
    assert found.learns


def test_a_run_shows_its_model_while_it_lasts_and_ends_as_without(monkeypatch):
    shown = []
    monkeypatch.setattr(progress, "_SHOWN_EVERY", 0.0)
    progress.follow_training(lambda stage: None, lambda *one: shown.append(one))
    try:
        followed = estimate(record(), PHYSICS, restarts=1, blocks=0, **OPTIONS)
    finally:
        progress.stop_following()
    alone = estimate(record(), PHYSICS, restarts=1, blocks=0, **OPTIONS)
    names = [name for name, *_ in shown]
    assert names[0] == "physics alone" and set(names[1:]) == {"orthogonal"} and len(names) > 4
    losses = [fit.status.loss for _, fit, _ in shown[1:]]
    assert losses[-1] < losses[0] and np.isfinite(losses).all()
    assert followed.theta == pytest.approx(alone.theta, rel=1e-12)


def test_the_lowest_generalised_cross_validation_is_chosen_one_step_ahead_and_reported():
    found = estimate(
        record(), PHYSICS, learner=NETWORK, solver=LM, regularization="auto", restarts=3
    )
    scores = [run.score for run in found.restarts]
    assert [run.chosen for run in found.restarts] == [score == min(scores) for score in scores]
    assert all(run.score > run.loss and run.validation is None for run in found.restarts)
    assert all(run.score is None for run in chosen().restarts)


@pytest.mark.parametrize("seed", range(2))
def test_where_no_learner_is_better_the_result_is_physics_alone(seed):
    found = estimate(linear(seed), PHYSICS, **OPTIONS)
    alone = estimate(linear(seed), PHYSICS, **{**OPTIONS, "learner": None})
    assert not found.learns and "physics_alone" in [w.code for w in found.warnings]
    np.testing.assert_allclose(found.theta, alone.theta, rtol=1e-9)
    np.testing.assert_allclose(found.std, alone.std, rtol=1e-6)
    assert found.status.loss == found.status.start_loss and not any(
        run.chosen for run in found.restarts
    )


@pytest.mark.parametrize(
    ("spread", "own", "fails"),
    [
        (80, 0.31, True),  # the end of one block is an extrapolation
        (80, 0.51, False),  # not clearly lower than physics on all rows
        (0, 0.31, False),  # surely worse
    ],
)
def test_physics_alone_that_fails_on_its_own_data_replaces_no_undecided_learner(spread, own, fails):
    """As of an oscillation: on a short block physics errs by 0.1, on all rows by 1."""
    far, alone = np.where(np.arange(100) < spread, 0.01, 6.0), np.full(100, 0.1)
    near = far if spread == 0 else np.full(100, 0.01)
    held_out = HeldOutErrors("blocks", tuple("1234"), [alone] * 4, ([far, near, near, near],))
    assert held_out.ratio.value > 1
    assert _physics_fails(held_out, own, alone=1.0) == fails
    assert not _physics_fails(held_out, own, alone=None)


def test_the_fallback_can_be_declined():
    found = estimate(linear(), PHYSICS, fallback=False, **OPTIONS)
    assert found.learns and found.held_out.ratio.code != "helps"
    assert found.status.loss <= found.status.start_loss and found.restarts[0].chosen


@pytest.mark.parametrize(
    "structure", [Orthogonal(), Additive(), OrthogonalPenalty(1.0), BaselinePenalty(1.0)]
)
def test_no_start_ends_above_physics_alone(structure):
    """Not even where iterations are few."""
    options = {**OPTIONS, "solver": type(LM)(4), "structure": structure, "restarts": 4, "blocks": 0}
    found = estimate(record(), PHYSICS, **options)
    alone = estimate(record(), PHYSICS, **{**options, "learner": None})
    assert found.status.start_loss == pytest.approx(alone.status.loss, rel=1e-9)
    assert all(run.loss <= found.status.start_loss for run in found.restarts)


def test_one_step_does_not_end_above_physics_alone_either():
    found = estimate(
        linear(), PHYSICS, learner=NETWORK, solver=type(LM)(1), restarts=4, regularization="none"
    )
    assert all(run.loss <= found.status.start_loss for run in found.restarts)


def test_physics_alone_has_the_same_bounds():
    terms = [Term("a", "y[k-1]", 0.5, max=0.6), Term("b", "y[k-2]", -0.2), Term("g", "u[k-1]", 0.4)]
    physics = Baseline.from_terms(terms)
    found = estimate(record(), physics, learner=NETWORK, solver=LM)
    alone = estimate(record(), physics, learner=None)
    assert found.at_bound and found.status.start_loss == pytest.approx(alone.status.loss, rel=1e-9)
    assert found.status.loss <= found.status.start_loss


def test_a_start_that_fails_is_reported_and_replaced(monkeypatch):
    run = FreeRunTask.run

    def failing(self, solver, w, *rest):
        free_fit = run(self, solver, w, *rest)
        first = np.array_equal(np.asarray(w), np.asarray(self.bound.init(jax.random.key(1))))
        return (
            free_fit._replace(end=free_fit.end._replace(ending=Ending.NON_FINITE))
            if first
            else free_fit
        )

    monkeypatch.setattr(FreeRunTask, "run", failing)
    found = estimate(record(), PHYSICS, restarts=2, seed=1, blocks=0, **OPTIONS)
    assert [(r.seed, r.code == "non_finite") for r in found.restarts] == [
        (1, True),
        (2, False),
        (3, False),
    ]
    assert "start_replaced" in [w.code for w in found.warnings] and found.status.ok


# --- silent learners

SILENCED = {
    "mlp": MLP((4, 3)),
    "function": Function(
        lambda w, z: w["out"] @ jnp.tanh(w["in"] @ z),
        lambda key: {"in": jax.random.normal(key, (3, 2)), "out": jnp.ones((1, 3))},
    ),
    "module": EquinoxModule(lambda key: eqx.nn.MLP(2, 1, 4, 1, key=key)),
}


@pytest.mark.parametrize("kind", SILENCED)
def test_a_silenced_learner_is_zero_and_can_be_trained(kind):
    bound = Bound(SILENCED[kind], 2, 1)
    w = np.asarray(bound.init(jax.random.key(0)))
    silent = bound.silent(w)
    z = jnp.asarray(np.random.default_rng(1).normal(size=(2, 9)))
    values, slopes = jax.jit(bound.jacobian)(jnp.asarray(silent), z, jnp.ones((1, 1, 9)))
    assert not np.any(values) and np.any(slopes) and np.any(silent)
    kept = silent != 0
    np.testing.assert_array_equal(silent[kept], w[kept])


def test_what_cannot_be_silenced_is_said_so():
    bound = Bound(Function(lambda w, z: jnp.exp(w * z[:1]), lambda key: jnp.ones(1)), 2, 1)
    assert bound.silent(np.ones(1)) is None


# --- the one rule


def coloured(rng, rows=400):
    e = np.zeros(rows)
    for k in range(1, rows):
        e[k] = 0.8 * e[k - 1] + rng.normal()
    return e**2


def test_the_ratio_of_errors():
    errors = coloured(np.random.default_rng(0))
    assert Ratio.of([errors], [errors]) == Ratio(1.0, 1.0, 1.0)
    half = Ratio.of([errors / 4], [errors])
    assert (half.value, half.low, half.high) == pytest.approx(
        (0.5, 0.5, 0.5)
    ) and half.code == "helps"
    assert Ratio.of([errors * 1.01], [errors]).code == "no_help"
    assert Ratio.of([None, errors], [errors, errors]).code == "hurts"
    assert Ratio.of([errors], [None]).code == "helps"
    assert Ratio.of([None], [None]).code == "no_help"
    assert (
        Ratio.of([errors], [0 * errors]).code == "hurts"
        and Ratio.of([0 * errors], [0 * errors]).code == "no_help"
    )


def test_equal_models_are_rarely_distinguished():
    """Coloured errors of equal size: the 95 % interval holds 1 in at least 90 % of the draws."""
    rng = np.random.default_rng(3)
    codes = [Ratio.of([coloured(rng)], [coloured(rng)]).code for _ in range(200)]
    assert codes.count("no_help") >= 180
