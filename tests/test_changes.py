"""What could be predicted, and which change would do it: against loops, differences, systems of known cause."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import lfilter

from orthaug import MLP, Baseline, Lags, LevenbergMarquardt, Record, Simulation, Term, estimate
from orthaug.analysis.changes import Candidates, Change, model_changes
from orthaug.analysis.predictability import BlockSums, from_lags, from_own_past, predictable

PHYSICS = Baseline.from_terms([Term("a", "y[k-1]"), Term("b", "y[k-2]"), Term("g", "u[k-1]")])
CUBIC = Baseline.from_terms([*PHYSICS.terms, Term("c", "y[k-1]**3")])


# --- shares


def test_a_share_is_that_of_cross_validation_by_a_loop():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(203, 4))
    y = x @ [1.0, 0.5, 0.0, 0.3] + rng.normal(size=203)
    missed = np.zeros((2, 8))
    blocks = np.split(np.arange(203), np.linspace(0, 203, 9).astype(int)[1:-1])
    for b, held in enumerate(blocks):
        kept = np.setdiff1d(np.arange(203), held)
        for i, columns in enumerate(([0], [0, 1, 3])):
            found = np.linalg.lstsq(x[np.ix_(kept, columns)], y[kept], rcond=None)[0]
            missed[i, b] = np.sum((y[held] - x[np.ix_(held, columns)] @ found) ** 2)
    share = BlockSums.of(x, y).share([1, 3], [0])
    assert share.value == pytest.approx(1 - missed[1].sum() / missed[0].sum(), rel=1e-3)
    off = missed[0] - missed[1] - share.value * missed[0]
    assert share.error == pytest.approx(np.sqrt(8) * off.std(ddof=1) / missed[0].sum(), rel=1e-2)


def test_blocks_of_uneven_size_that_gain_alike_are_sure():
    rng = np.random.default_rng(3)
    x = rng.normal(size=(800, 1)) * np.repeat([1, 1, 1, 1, 1, 1, 1, 30], 100)[:, None]
    share = BlockSums.of(x, x[:, 0] * (1 + 0.5 * rng.normal(size=800))).share([0])
    assert share.value == pytest.approx(0.8, abs=0.06) and share.error < 0.1


def test_the_share_from_the_own_past_is_that_of_the_process():
    e = np.random.default_rng(1).normal(size=20000)
    assert from_own_past(lfilter([1.0], [1.0, -0.6], e), 5).value == pytest.approx(0.36, abs=0.02)
    assert from_own_past(e, 5).sure == 0 and abs(from_own_past(e, 5).value) < 0.002


def test_lags_do_not_reach_across_experiments():
    e, u = np.random.default_rng(2).normal(size=(2, 4000))
    driven = np.roll(u, 3) + e
    assert from_lags(driven, [u], range(4)).value == pytest.approx(0.5, abs=0.04)
    cuts = list(range(4, 4000, 4))
    assert from_lags(np.split(driven, cuts), [np.split(u, cuts)], range(3)).sure == 0
    assert from_lags(driven, [], range(4)).value == from_lags(e[:20], [u[:20]], range(6)).value == 0


# --- columns


def system(seed, rows=1200, noise=0.0, sensor=0.2, further=0.0, cubic=0.0):
    rng = np.random.default_rng([5, seed])
    u, e, v = rng.normal(size=(3, rows))
    y = np.zeros(rows)
    for k in range(3, rows):
        y[k] = (
            1.5 * y[k - 1]
            - 0.7 * y[k - 2]
            + 0.5 * u[k - 1]
            + further * u[k - 3]
            + cubic * y[k - 1] ** 3
        )
        y[k] += noise * e[k]
    return Record.from_arrays(u, y + sensor * v)


def flown(theta, u, start, further):
    """A free run of the cubic physics with so much of u[k-3]."""
    y = start.copy()
    for k in range(3, len(y)):
        y[k] = theta @ [y[k - 1], y[k - 2], u[k - 1], y[k - 1] ** 3] + further * u[k - 3]
    return y


def test_columns_of_a_free_run_are_its_derivatives():
    record = system(0, 300, cubic=-0.01)
    fit = estimate(record, CUBIC, lags=Lags(3, 3, 1), learner=None)
    run = fit.model.simulate(record)
    found = Candidates(fit, run, True, 0)
    column = found.base + [str(lag) for lag in found.lags].index("u[k-3]")
    (columns, _), first = found._rows(*found.stretches[0]), found.first
    u, start = record.experiments[0].inputs[:, 0], run.trajectories[0].model[:, 0].copy()
    start[:3] = record.experiments[0].outputs[:3, 0]
    later = [np.concatenate([start[:first], flown(fit.theta, u[first - 3 :], start[first - 3 :], h)[3:]])
             for h in (1e-4, -1e-4)]  # fmt: skip
    exact = (later[0] - later[1])[first:] / 2e-4 / fit.problem.deviation
    centre = u.mean() / fit.problem.deviation  # a constant is among the columns of the physics
    offset = columns[:, len(fit.theta)] * fit.problem.deviation
    np.testing.assert_allclose(columns[:, column] + centre * offset, exact, rtol=1e-5, atol=1e-7)


@cache
def fitted(criterion=None, learner=None, **system_options):
    record = system(0, **system_options)
    given = {"criterion": criterion} if criterion else {}
    return estimate(
        record, PHYSICS, learner=learner, blocks=0, solver=LevenbergMarquardt(40), **given
    )


def changes_of(fit):
    simulated = fit.criterion.simulates
    one_step, free_run = (
        fit.model.predict(fit.problem.record),
        fit.model.simulate(fit.problem.record),
    )
    skip = fit.criterion.washout
    return model_changes(
        fit, free_run if simulated else one_step, simulates=simulated, skip=skip, one_step=one_step
    )


@pytest.mark.parametrize("criterion", [None, Simulation(0, 40)], ids=["one step", "free run"])
def test_the_missing_lag_is_named(criterion):
    noise = {"sensor": 0.1} if criterion else {"sensor": 0.0, "noise": 0.1}
    change = changes_of(fitted(criterion, further=0.2, **noise))[0]
    assert (change.kind, change.what) == ("input_lag", "u[k-3]") and change.fall > 0.2


def test_a_learner_is_named_with_what_it_does_not_see():
    blind = fitted(learner=MLP((3,), inputs=("u[k-1]",)), cubic=-0.01, noise=0.1, sensor=0.0)
    (change,) = (one for one in changes_of(blind) if one.kind == "learner")
    assert change.what == "a learner that also sees y[k-1], y[k-2]"
    assert str(change).startswith(
        "with a learner that also sees y[k-1], y[k-2] its error one step ahead is"
    )


def test_a_learner_that_was_tried_in_vain_is_not_proposed_as_if_none_had_been():
    alone = fitted(cubic=-0.01, noise=0.1, sensor=0.0)
    asked = replace(alone.setup, options={**alone.setup.options, "learner": MLP((3,))})
    named = [
        next(one.what for one in changes_of(fit) if one.kind == "learner")
        for fit in (alone, replace(alone, setup=asked))
    ]
    assert named == ["a learner", "another learner than the one that was tried"]


@pytest.mark.parametrize("criterion", [None, Simulation(0, 40)], ids=["one step", "free run"])
def test_where_nothing_is_missing_no_change_is_named(criterion):
    noise = {"sensor": 0.2} if criterion else {"sensor": 0.0, "noise": 0.1}
    assert changes_of(fitted(criterion, **noise)) == ()


def test_the_output_that_lacks_a_term_is_reported():
    rng = np.random.default_rng(4)
    u, y = rng.normal(size=(900, 2)), np.zeros((900, 2))
    for k in range(2, 900):
        y[k] = [
            0.8 * y[k - 1, 0] + u[k - 1, 0],
            0.5 * y[k - 1, 1] + u[k - 1, 1] + 0.4 * u[k - 2, 0],
        ]
        y[k] += 0.1 * rng.normal(size=2)
    terms = [Term("a", "y1[k-1]", output="y1"), Term("b", "u1[k-1]", output="y1"), Term("c", "y2[k-1]", output="y2"),
             Term("d", "u2[k-1]", output="y2")]  # fmt: skip
    change = changes_of(
        estimate(Record.from_arrays(u, y), Baseline.from_terms(terms), learner=None)
    )[0]
    assert (change.what, change.output) == ("u1[k-2]", "y2")
    assert "the further input lag u1[k-2] in the physics of y2 (or the learner)" in str(change)


def test_long_records_are_looked_at_in_stretches():
    fit = fitted(rows=60_000, further=0.2, noise=0.1, sensor=0.0)
    found = Candidates(fit, fit.model.predict(fit.problem.record), False, 0)
    assert len(found.stretches) == 8 and len(found._rows(*found.stretches[3])[0]) == pytest.approx(
        2500, abs=3
    )
    assert changes_of(fit)[0].what == "u[k-3]"


def test_what_could_be_predicted_is_reported_per_output():
    fit = fitted(further=0.2, noise=0.1, sensor=0.0)
    (one,) = predictable(fit.problem, fit.model.predict(fit.problem.record))
    assert one.name == "y" and one.rms == pytest.approx(
        fit.model.statistics.noise[0, 0] ** 0.5, rel=0.01
    )
    assert one.inputs > 0.5 and one.functions == 0 and one.largest() == one.inputs


@pytest.mark.parametrize("rows", [40, 60])
def test_too_few_rows_name_nothing(rows):
    assert changes_of(fitted(rows=rows, further=0.5, noise=0.1)) == ()


def test_a_change_in_words():
    criterion = Change("criterion", "simulation", 0.123, "simulation")
    assert (
        str(criterion)
        == 'with focus = "simulation" the error of its free run is predicted to fall by 12 %'
    )
    text = str(Change("criterion", "simulation", 0.0, "simulation"))
    assert (
        text.startswith('with focus = "simulation" the parameters would not have this bias')
        and "%" not in text
    )
    assert "not predicted to fall" in text
    assert Change("offset", "1", 0.2, "prediction", "y2").name == "an offset in the physics of y2"
