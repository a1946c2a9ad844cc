"""Tests of a residual from running sums are those of all rows at once."""

from __future__ import annotations

import numpy as np
import pytest

from orthaug.analysis.residuals import RunningResidual, analyse


def signals(rows, seed):
    """A coloured residual that follows the first input, far from zero."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(rows, 2)) + [50.0, 0.0]
    e = np.convolve(rng.normal(size=rows + 2), [1.0, 0.6, 0.3], "valid")
    e[3:] += 0.4 * (u[:-3, 0] - 50)
    return e[:, None] + 1000.0, u


@pytest.mark.parametrize("cuts", [(), (7, 20, 21, 400), tuple(range(3, 600, 3))])
def test_pieces_give_the_tests_of_the_whole(cuts):
    experiments = [signals(600, 1), signals(90, 2)]
    running = RunningResidual(["y"], ["u", "v"])
    for e, u in experiments:
        for i, piece in enumerate(zip(np.split(e, cuts), np.split(u, cuts), strict=True)):
            running.add(*piece, begins=i == 0)
    (found,) = running.tests()
    residuals, inputs = ([pair[i] for pair in experiments] for i in (0, 1))
    (wanted,) = analyse(residuals, inputs, inputs, ["y"], ["u", "v"], ["u", "v"])
    assert (found.n, found.name) == (wanted.n, "y")
    assert (found.mean, found.rms) == pytest.approx((wanted.mean, wanted.rms), rel=1e-12)
    np.testing.assert_allclose(found.acf, wanted.acf, atol=1e-10)
    assert found.ljung_box.statistic == pytest.approx(wanted.ljung_box.statistic, rel=1e-8)
    assert found.ljung_box.freedom == wanted.ljung_box.freedom and found.acf_band == wanted.acf_band
    for name in ("u", "v"):
        np.testing.assert_allclose(found.cross[name].values, wanted.cross[name].values, atol=1e-10)
        assert found.cross[name].lag == wanted.cross[name].lag
    assert found.cross["u"].lag == 3 and found.cross["u"].largest > 3 * found.cross["u"].band


def test_the_band_of_a_cross_correlation_holds_its_level():
    """Residual and input coloured, but independent: 99 % of the values at lag 0 are inside."""
    inside = 0
    for seed in range(300):
        rng = np.random.default_rng(seed)
        e, u = (
            np.convolve(rng.normal(size=1010), 0.6 ** np.arange(11), "valid")[:, None]
            for _ in range(2)
        )
        running = RunningResidual(["y"], ["u"], lags=15)
        running.add(e, u, begins=True)
        cross = running.tests()[0].cross["u"]
        inside += abs(cross.values[15]) < cross.band
    assert 0.975 <= inside / 300 <= 1.0


def test_what_does_not_move_or_is_not_finite_has_no_test():
    u = np.random.default_rng(0).normal(size=(100, 1))
    for e in (np.full((100, 1), 3.7), np.full((100, 1), np.nan), np.full((100, 1), 1e200)):
        running = RunningResidual(["y"], ["u"])
        running.add(e, u, begins=True)
        assert running.tests() == ()
    still = RunningResidual(["y"], ["u"])
    still.add(u, np.full((100, 1), 2.0), begins=True)
    assert still.tests()[0].cross == {"u": None}
