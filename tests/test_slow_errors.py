"""Slow errors of a free run look like functions of what is slow: that is no missing physics."""

import numpy as np

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
    fit = oa.estimate(kiln(), oa.Baseline.from_terms(terms), learner=None, criterion=oa.Simulation())
    found = fit.diagnose()
    texts = [one.text for one in found.warnings if one.code == "unexplained"]
    assert all("noise.model" in text and "learner" not in text for text in texts)
