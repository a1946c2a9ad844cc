"""A wrong sample that gets into training is named."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal

import orthaug as oa


def warned(wrong: float, at: int = 150) -> list[str]:
    rng = np.random.default_rng(1)
    u = rng.normal(size=400)
    y = scipy.signal.lfilter([0, 0.2], [1, -0.8], u) + scipy.signal.lfilter(
        [1], [1, -0.8], 0.01 * rng.standard_t(5, 400)
    )
    y[at] += wrong
    record = oa.Record.from_arrays(u, y, sampling_time=0.1)
    baseline = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]")])
    found = oa.diagnose(oa.estimate(record, baseline, learner=None))
    assert found is not None
    return [warning.text for warning in found.warnings if warning.code == "wild_rows"]


@pytest.mark.parametrize("at", [150, 399])
def test_a_wrong_sample_in_training_is_named(at):
    (text,) = warned(5.0, at)
    assert f"row {at}" in text and 'step = "outliers"' in text


def test_heavy_tails_alone_are_none():
    assert warned(0.0) == []
