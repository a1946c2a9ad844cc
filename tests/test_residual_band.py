"""The alarm: quiet on what training was like, coloured and heavy-tailed too; loud where the residual leaves it."""

from __future__ import annotations

import numpy as np
import pytest

from orthaug.fitting.residual_band import SCALES, Reference, ResidualMonitor

ROWS = 2000
QUIET = 1e5


def residuals(kind: str, seed: int, rows: int = ROWS) -> np.ndarray:
    rng = np.random.default_rng(seed)
    e = rng.standard_t(3, (rows, 2)) / np.sqrt(3) if kind == "heavy" else rng.normal(size=(rows, 2))
    if kind == "coloured":
        for k in range(2, rows):
            e[k] += 1.2 * e[k - 1] - 0.5 * e[k - 2]
    return e @ np.array([[1.0, 0.4], [0.0, 0.5]])


def watched(kind: str, seed: int = 0, used: float = 0.0) -> tuple[Reference, np.ndarray]:
    training = residuals(kind, seed)
    white = np.linalg.inv(np.linalg.cholesky(np.cov(training.T)))
    return Reference.of([training[:900], training[900:]], white, used, QUIET), white


def loudest(reference: Reference, rows: np.ndarray) -> float:
    return max(levels(ResidualMonitor(reference), rows))


def levels(watch: ResidualMonitor, rows: np.ndarray) -> list[float]:
    return [watch.level for row in rows if watch.step(row, 1.0) in (True, False)]


@pytest.mark.parametrize("kind", ["white", "coloured", "heavy"])
def test_records_like_those_of_training_are_quiet(kind):
    reference, _ = watched(kind)
    assert len(reference.colour) == (2 if kind == "coloured" else 0)
    assert [loudest(reference, residuals(kind, seed)) > 1 for seed in range(1, 16)].count(True) == 0


@pytest.mark.parametrize("kind", ["white", "coloured", "heavy"])
def test_a_larger_residual_and_a_slow_one_are_found(kind):
    reference, _ = watched(kind)
    rows = residuals(kind, 50, 400)
    assert loudest(reference, 2.5 * rows) > 1
    slow = np.where(np.arange(400)[:, None] // 40 % 2, 1.0, -1.0) * residuals(kind, 0).std(axis=0)
    assert loudest(reference, rows + 2.0 * slow) > 1


def test_limits_are_those_of_the_mean_time_between_false_alarms():
    """Sums of log-likelihood ratios exceed h once in e^h blocks; four scales share one alarm in QUIET rows."""
    limit, scale = watched("white")[0].limit, np.array(SCALES)
    least = np.log(4 * QUIET / scale)
    assert np.sum(np.exp(-least) / scale) == pytest.approx(1 / QUIET)
    assert limit[0] == pytest.approx(least[0])
    assert (limit >= least - 1e-9).all() and (limit < 1.5 * least).all()


def test_tails_raise_the_limits_and_uncertain_parameters_widen_slow_scales():
    assert watched("heavy")[0].limit[0] > 1.1 * watched("white")[0].limit[0]
    wide, narrow = watched("white", used=0.02)[0].variance, watched("white")[0].variance
    np.testing.assert_allclose(wide / narrow, 1 + 0.02 * np.array([1, 4, 16, 64]))


def test_one_outlier_is_no_alarm_and_a_gap_begins_anew():
    reference, _ = watched("coloured")
    rows = residuals("coloured", 3, 300)
    rows[150] += 1e6
    watch = ResidualMonitor(reference)
    assert max(levels(watch, rows)) < 1
    watch.gap()
    assert np.isnan(watch.past).all() and not any(watch.counts)
    assert not watch.step(rows[0], 1.0)


def test_an_alarm_is_raised_once_stands_and_ends():
    reference, _ = watched("white")
    watch, rows = ResidualMonitor(reference), residuals("white", 60, 6000)
    rows[500:900] *= 2.0
    raised = [k for k, row in enumerate(rows) if watch.step(row, 1.0)]
    assert len(raised) == 1 and 500 < raised[0] < 560
    assert watch.level < 1


def test_few_rows_take_fewer_scales():
    short = np.random.default_rng(0).normal(size=(15, 1))
    reference = Reference.of([short], np.eye(1), 0.0, QUIET)
    assert reference.scales == (1,) and not len(reference.colour)
