"""Slow errors of a free run look like functions of what is slow: that is no missing physics."""

import numpy as np
import pytest

import orthaug as oa


def kiln(rows=2000, seed=3):
    """A linear plant whose equation has a disturbance of long memory, and right physics."""
    rng = np.random.default_rng(seed)
    u, e = np.repeat(rng.normal(size=rows // 20), 20), np.zeros(rows)
    y = np.zeros(rows)
    for k in range(1, rows):
        e[k] = 0.9 * e[k - 1] + 0.05 * rng.normal()
        y[k] = 0.95 * y[k - 1] + 0.1 * u[k - 1] + e[k]
    return oa.Record.from_arrays(u=u, y=y, sampling_time=60.0)


def test_a_slow_disturbance_is_described_by_noise_and_not_by_a_learner():
    terms = [oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]"), oa.Term("q", "(y[k-1]/3)**2")]
    fit = oa.estimate(
        kiln(), oa.Baseline.from_terms(terms), learner=None, criterion=oa.Simulation()
    )
    found = fit.diagnose()
    texts = [one.text for one in found.warnings if one.code == "unexplained"]
    assert all("noise.model" in text and "learner" not in text for text in texts)


def test_standard_errors_suit_the_errors_unless_plain_ones_are_asked_for():
    rng = np.random.default_rng(0)
    u, e = rng.normal(size=1500), np.zeros(1500)
    for k in range(1, 1500):
        e[k] = 0.8 * e[k - 1] + 0.1 * rng.normal()
    u = np.convolve(u, np.ones(10) / 10, "same")
    record = oa.Record.from_arrays(u=u, y=2 * u + e, sampling_time=1.0)
    physics = oa.Baseline.from_terms([oa.Term("g", "u[k]")])
    fit = oa.estimate(record, physics, learner=None)
    plain = oa.estimate(record, physics, learner=None, standard_errors="plain")
    assert (fit.std_kind, plain.std_kind) == ("newey-west", "plain")
    assert fit.std[0] > 2 * plain.std[0]
    np.testing.assert_array_equal(fit.plain_std, plain.std)
    assert fit.diagnose().parameters[0].std == pytest.approx(fit.std[0], rel=1e-12)
    found = plain.diagnose()
    assert found.parameters[0].std == pytest.approx(plain.std[0], rel=1e-12)
    (text,) = [one.text for one in found.warnings if one.code == "plain_standard_errors"]
    assert "Newey" in text and f"{fit.std[0]:.2g} of " in text
    with pytest.raises(oa.InputError, match="standard_errors must be one of auto, plain"):
        oa.estimate(record, physics, learner=None, standard_errors="HC3")


def test_plain_standard_errors_of_coloured_errors_come_with_a_warning():
    rng = np.random.default_rng(2)
    e = np.zeros(90)
    for k in range(1, 90):
        e[k] = 0.8 * e[k - 1] + 0.1 * rng.normal()
    u = rng.normal(size=90)
    record = oa.Record.from_arrays(u=u, y=2 * u + e, sampling_time=1.0)
    fit = oa.estimate(record, oa.Baseline.from_terms([oa.Term("g", "u[k]")]), learner=None)
    assert fit.std_kind == "plain"
    (text,) = [one.text for one in fit.warnings if one.code == "coloured_residual"]
    assert "rough guide" in text and "rough guide" in fit.summary().replace("\n  ", " ")
    assert [one.code for one in fit.diagnose().warnings].count("coloured_residual") <= 1


def test_a_notebook_names_robust_standard_errors():
    rng = np.random.default_rng(0)
    u, e = rng.normal(size=1500), np.zeros(1500)
    for k in range(1, 1500):
        e[k] = 0.8 * e[k - 1] + 0.1 * rng.normal()
    record = oa.Record.from_arrays(u=u, y=2 * u + e, sampling_time=1.0)
    fit = oa.estimate(record, oa.Baseline.from_terms([oa.Term("g", "u[k]")]), learner=None)
    assert "Newey-West" in fit._repr_html_()
    assert fit.split(oa.Training()).std[0] == pytest.approx(fit.std[0], rel=1e-9)
