"""Scores of a free run in blocks: against autodiff and a loop, and the intervals that come of them."""

from __future__ import annotations

from functools import cache, partial

import numpy as np
import pytest
from scipy.signal import lfilter
from test_initial_states import FED_BACK, eliminated, start_rows, states_of
from test_segments import CASES, assert_close, case, dense, found_of

from orthaug import (
    Baseline,
    InputError,
    Record,
    Simulation,
    Symmetrized,
    Term,
    Training,
    estimate,
    prediction_std,
)
from orthaug.analysis.robustness import robust_where_asked
from orthaug.fitting.block_scores import FreeRunScores
from orthaug.fitting.colour import correlation_length

estimate = partial(estimate, standard_errors="plain")  # robust ones are asked for here

THETA = np.array([1.5, -0.7, 0.3, 0.2])
PHYSICS = Baseline.from_terms(
    [Term("a", "y[k-1]"), Term("b", "y[k-2]"), Term("g", "u[k-1]"), Term("o", "1")]
)


def scores_of(name, free):
    """Of the numbers of a case, whose first chunk of segments is padded."""
    given = case(name)
    states = states_of(name, free)
    slope = eliminated(name, free)[3]
    prior = start_rows(name).T @ start_rows(name)
    pull = np.moveaxis(states.measured - given.states, -1, 1) @ prior if free else None
    return FreeRunScores(
        given.form, given.numbers, given.segments, given.states, given.weight, 1.0, slope, pull
    )


@pytest.mark.parametrize("steps", [1, 2, 3, 50])
@pytest.mark.parametrize("name", ["one output", "two outputs share theta", "no feedback"])
def test_blocks_are_sums_of_products_of_autodiff(name, steps):
    """Four steps of each segment are scored; the last segment of an experiment may have fewer."""
    exact, scored = dense(name), np.asarray(case(name).segments.scored)
    products = np.sum(exact.shared * exact.error[..., None], axis=2)  # (k, T, m, n)
    size = {1: 1, 2: 2, 3: 4, 50: 4}[steps]
    expected = [
        products[k, first : first + size, m].sum(axis=0)
        for k, m in np.ndindex(scored.shape[0], scored.shape[2])
        for first in range(3, scored.shape[1], size)
        if scored[k, first : first + size, m].any()
    ]
    assert_close(scores_of(name, free=False).blocks(steps), np.array(expected), 1e-8)


@pytest.mark.parametrize("name", FED_BACK)
def test_with_the_states_eliminated_all_blocks_add_up_to_the_eliminated_gradient(name):
    assert_close(scores_of(name, free=True).blocks(2).sum(axis=0), eliminated(name)[1], 1e-8)


@pytest.mark.parametrize("name", CASES)
def test_without_their_elimination_they_add_up_to_the_gradient(name):
    assert_close(
        scores_of(name, free=False).blocks(2).sum(axis=0),
        np.asarray(found_of(name).shared)[:-1, -1],
        1e-8,
    )


# --- how long errors remember


@pytest.mark.parametrize(
    ("poles", "least", "most"), [((0.0,), 1, 3), ((0.9,), 12, 45), ((0.98,), 60, 250)]
)
def test_the_correlation_length(poles, least, most):
    e = lfilter([1.0], np.poly(poles), np.random.default_rng(0).normal(size=20000))
    assert least <= correlation_length(e[None]) <= most


def test_a_resonance_is_not_cut_where_its_correlation_is_zero():
    """Of period 40 and a decay by e in 50: the correlation is zero at 10 already."""
    pole = np.exp(-1 / 50 + 2j * np.pi / 40)
    e = lfilter(
        [1.0], np.poly([pole, pole.conj()]).real, np.random.default_rng(1).normal(size=20000)
    )
    assert correlation_length(e[None]) > 60


def test_errors_that_remember_for_long_have_no_length():
    assert (
        correlation_length(np.cumsum(np.random.default_rng(2).normal(size=(1, 400)))[None]) is None
    )
    assert correlation_length(np.zeros((1, 400))) is None


# --- the intervals


def record(seed, pole, samples=2000, uneven=False):
    """A slow input, noise of deviation 0.5 on the sensor."""
    rng = np.random.default_rng([seed, 12])
    u = lfilter([1.0], [1.0, -0.8], rng.normal(size=samples + 200))
    y = lfilter([0.0, THETA[2]], [1.0, -THETA[0], -THETA[1]], u) + THETA[3] / (
        1 - THETA[0] - THETA[1]
    )
    e = lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], rng.normal(size=samples + 200))
    e = e * np.abs(u) / u.std() if uneven else e
    return Record.from_arrays(u[200:], (y + 0.5 * e)[200:])


@cache
def flown(seed, pole=0.9, segment=0, samples=2000, uneven=False):
    return estimate(
        record(seed, pole, samples, uneven),
        PHYSICS,
        learner=None,
        criterion=Simulation(segment, 40),
    )


def test_blocks_cover_where_plain_intervals_do_not():
    """AR(1) noise with coefficient 0.9, 60 draws; all four parameters together."""
    inside = np.zeros(2)
    for seed in range(60):
        for i, fit in enumerate((flown(seed), flown(seed).robust(90))):
            inside[i] += np.mean((fit.interval[:, 0] <= THETA) & (fit.interval[:, 1] >= THETA)) / 60
    assert inside[0] < 0.75 and 0.90 < inside[1] < 0.99


def default(fit):
    return robust_where_asked(fit, fit.model.predict(fit.problem.record))


@pytest.mark.parametrize("segment", [0, 512])
def test_coloured_errors_have_robust_intervals_by_default(segment):
    plain = flown(0, segment=segment)
    fit = default(plain)
    np.testing.assert_array_equal(fit.plain_covariance, plain.covariance)
    np.testing.assert_array_equal(fit.theta, plain.theta)
    assert (fit.std > 1.2 * plain.std).any() and 19 <= fit.freedom < 100
    assert "std         robust (batch means), for coloured errors of the free run" in fit.summary()
    assert default(fit).freedom == fit.freedom  # robust errors of robust errors are the same
    np.testing.assert_array_equal(fit.robust(90).plain_covariance, plain.covariance)


def test_their_predictions_and_splits_are_robust_too():
    plain, fit = flown(0), flown(0).robust(90)
    assert prediction_std(fit.model, fit.problem.record)[0][50:].mean() > 1.2 * (
        prediction_std(plain.model, plain.problem.record)[0][50:].mean()
    )
    split = fit.split(Training())
    np.testing.assert_allclose(split.covariance, fit.covariance, rtol=1e-8)
    np.testing.assert_allclose(split.plain_covariance, plain.covariance, rtol=1e-8)
    assert plain.split(Symmetrized()).plain_covariance is None


def test_white_errors_keep_plain_intervals():
    fit = default(flown(0, 0.0))
    assert fit.plain_covariance is None and fit.std_kind == "plain"


def test_a_record_that_is_too_short_for_blocks_has_the_errors_of_its_colour():
    """An autoregressive model of the errors, 40 draws of 300 rows; where segments are short, too."""
    inside = np.zeros(2)
    for seed in range(40):
        plain = flown(seed, 0.9, 0, 300)
        for i, fit in enumerate((plain, plain.robust(kind="autoregressive"))):
            inside[i] += np.mean((fit.interval[:, 0] <= THETA) & (fit.interval[:, 1] >= THETA)) / 40
    assert inside[0] < 0.75 and 0.88 < inside[1] <= 0.99
    fit = default(flown(0, 0.9, 50))
    assert fit.std_kind == "autoregressive" and "robust (autoregressive errors)" in fit.summary()


def test_errors_that_remember_for_too_long_have_no_interval():
    """Plain intervals held 40 to 75 % there; no number is called one of 95 %."""
    plain = flown(0, 0.9, 0, 180)
    fit = default(plain)
    assert fit.std is None and fit.interval is None and fit.std_kind == "none"
    np.testing.assert_array_equal(fit.plain_covariance, plain.covariance)
    text = dict(fit.warnings)["too_long_memory"]
    assert "no standard errors and no intervals" in text and text.endswith(
        "Use a longer record, or physics with smaller errors."  # segments are whole experiments
    )
    segmented = dict(default(flown(0, 0.9, 90, 180)).warnings).get("too_long_memory", "")
    assert "Use longer segments, a longer record" in segmented
    assert "std         none" in fit.summary()
    split = fit.split(Symmetrized())
    assert split.std is None and split.interval is None
    np.testing.assert_allclose(split.plain_std, plain.split(Symmetrized()).std, rtol=1e-12)
    assert default(fit) is fit


def test_white_errors_of_uneven_size_have_batch_means_by_default():
    fit = default(flown(0, 0.0, uneven=True))
    assert (
        fit.std_kind == "batch-means-uneven"
        and (fit.std > 1.15 * flown(0, 0.0, uneven=True).std).any()
    )


def test_the_sensitivities_of_every_step_make_the_scores():
    scores = flown(0, 0.9, segment=512).scores
    rows = np.einsum("kon,ko->n", scores.slopes(), scores.whitened())
    every = scores.unit * scores.blocks(1).sum(axis=0)
    np.testing.assert_allclose(
        rows, every, atol=1e-6 * np.abs(scores.slopes()).sum(axis=(0, 1)).max()
    )


def test_for_white_errors_they_are_the_plain_ones():
    np.testing.assert_allclose(flown(1, 0.0).robust(10).std, flown(1, 0.0).std, rtol=0.2)


def test_errors_that_never_forget_are_refused():
    fit = flown(0, 0.97, 0, 200)
    with pytest.raises(InputError, match="correlated over too many steps"):
        fit.robust()
    with pytest.raises(InputError, match="`lags`"):
        fit.robust(0)


def test_a_block_is_judged_by_the_fit_without_it():
    """Of physics that is linear on the free run too, this is the jackknife, by refits in NumPy."""
    rng = np.random.default_rng(5)
    u = np.repeat(rng.uniform(-1, 1, 31), 10)[:301]
    slow = np.cumsum(rng.normal(size=301)) * 0.1
    phi = np.column_stack([u[:-1], np.arange(1, 301) / 300, np.ones(300)])
    y = np.append(0.0, phi @ [2.0, 0.5, 1.0]) + slow
    record = Record.from_arrays(
        np.column_stack([u, np.arange(1, 302) / 300]),
        y,
        sampling_time=1.0,
        inputs=["u", "t"],
        outputs=["y"],
    )
    terms = [Term("b", "u[k-1]"), Term("drift", "t[k-1]"), Term("offset", "1")]
    fit = estimate(
        record,
        Baseline.from_terms(terms),
        learner=None,
        criterion=Simulation(0, 0),
    ).robust(60)
    whole = np.linalg.lstsq(phi, y[1:], rcond=None)[0]
    without = []
    for j in range(5):
        kept = np.arange(300) // 60 != j
        without.append(np.linalg.lstsq(phi[kept], y[1:][kept], rcond=None)[0] - whole)
    np.testing.assert_allclose(fit.theta, whole, rtol=1e-6)
    np.testing.assert_allclose(
        fit.std, np.sqrt(0.8 * np.sum(np.square(without), axis=0)), rtol=1e-6
    )
