"""Scores: RMSE, NRMSE and FIT, and what they say where a number does not exist."""

from __future__ import annotations

import numpy as np
import pytest

from orthaug import scores
from orthaug.analysis.fit_findings import ScoreResult


def test_scores_are_their_formulas():
    rng = np.random.default_rng(0)
    y, model = rng.normal(size=(2, 50, 2)) * [1.0, 1e-3]
    found = scores(y, model)
    rmse = np.sqrt(((y - model) ** 2).sum(axis=0) / 50)
    deviation = np.sqrt(((y - y.sum(axis=0) / 50) ** 2).sum(axis=0) / 50)
    np.testing.assert_allclose(found.rmse, rmse)
    np.testing.assert_allclose(found.nrmse, rmse / deviation)
    np.testing.assert_allclose(found.fit, 100 * (1 - rmse / deviation))
    assert found.samples == 50


@pytest.mark.parametrize(
    ("model", "fit"), [([1.0, 2.0, 3.0], 100.0), ([2.0, 2.0, 2.0], 0.0), ([3.0, 2.0, 1.0], -100.0)]
)
def test_fit_is_not_clipped(model, fit):
    found = scores(np.array([[1.0], [2.0], [3.0]]), np.array(model)[:, None])
    np.testing.assert_allclose(found.fit, fit, atol=1e-12)


def test_an_output_that_does_not_move_has_no_fit():
    found = scores(np.ones((4, 1)), np.zeros((4, 1)))
    assert found.rmse[0] == 1.0 and np.isnan(found.nrmse[0]) and np.isnan(found.fit[0])
    assert ScoreResult.model_validate(found).content() == {
        "rmse": [1.0],
        "nrmse": None,
        "fit": None,
    }


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
def test_a_run_that_left_all_bounds_has_no_score(value):
    y, model = np.arange(8.0).reshape(4, 2), np.zeros((4, 2))
    model[2, 1] = value
    found = scores(y, model)
    assert (
        np.isfinite(found.rmse[0]) and np.isnan([found.rmse[1], found.nrmse[1], found.fit[1]]).all()
    )
    content = ScoreResult.model_validate(found).content()
    assert content["rmse"] == [pytest.approx(np.sqrt(14.0)), None]
    model[:, 0] = value
    assert ScoreResult.model_validate(scores(y, model)).content() == {
        "rmse": None,
        "nrmse": None,
        "fit": None,
    }


def test_a_result_holds_plain_numbers():
    values = ScoreResult.model_validate(scores(np.arange(3.0)[:, None], np.zeros((3, 1)))).content()
    assert all(type(entry) is float for entries in values.values() for entry in entries)
