"""Residual analysis: its numbers by other ways, the levels of its tests, their power, and what does not exist."""

from __future__ import annotations

import json

import numpy as np
import pytest
import scipy.stats
from scipy.signal import lfilter

from orthaug.analysis.residual_tests import ResidualTestResult
from orthaug.analysis.residuals import against_input, against_regressor, analyse
from orthaug.fitting.whiteness import (
    autocorrelation,
    cross_correlation,
    ljung_box,
    normality,
    whitening_filter,
)

RECORDS, ROWS, WARM_UP = 2000, 1000, 300
# Of 2000 records that a test at 1 % may reject; ± 0.0022 is one standard deviation
BETWEEN = (0.005, 0.016)


def coloured(white, *a):
    return lfilter([1.0], [1.0, *a], white)


def report(e, u=None, x=None, **settings):
    """The test of one output, from signals of one experiment."""
    u, x = ({} if signals is None else signals for signals in (u, x))
    columns = [np.stack(list(s.values()), axis=1) if s else np.zeros((len(e), 0)) for s in (u, x)]
    (found,) = analyse(
        [e[:, None]], [columns[0]], [columns[1]], ["y"], list(u), list(x), **settings
    )
    return found


def naive_correlation(e, u, lags):
    """r_eu(τ) by two loops over experiments and rows."""
    e_mean, u_mean = np.concatenate(e).mean(), np.concatenate(u).mean()
    sums = np.zeros(2 * lags + 1)
    for one, other in zip(e, u, strict=True):
        for k in range(len(one)):
            for lag in range(-lags, lags + 1):
                if 0 <= k - lag < len(one):
                    sums[lag + lags] += (one[k] - e_mean) * (other[k - lag] - u_mean)
    norms = [
        sum(np.sum((part - mean) ** 2) for part in s) for s, mean in ((e, e_mean), (u, u_mean))
    ]
    return sums / np.sqrt(norms[0] * norms[1])


def test_correlations_are_those_of_two_loops():
    rng = np.random.default_rng(0)
    e, u = ([rng.normal(3.0, 1e3, n) for n in (40, 7, 1, 60)] for _ in range(2))
    np.testing.assert_allclose(cross_correlation(e, u, 10), naive_correlation(e, u, 10), atol=1e-14)
    np.testing.assert_allclose(autocorrelation(e, 10), naive_correlation(e, e, 10)[10:], atol=1e-14)


def test_many_lags_are_those_of_two_loops():
    rng = np.random.default_rng(3)
    e, u = ([rng.normal(3.0, 1e3, n) for n in (300, 7, 1, 260)] for _ in range(2))
    np.testing.assert_allclose(
        cross_correlation(e, u, 280), naive_correlation(e, u, 280), atol=1e-14
    )
    np.testing.assert_allclose(
        autocorrelation([*e, np.zeros(0)], 280), naive_correlation(e, e, 280)[280:], atol=1e-14
    )


def test_no_product_crosses_a_boundary():
    first, second = np.zeros(50), np.zeros(50)
    first[-1], second[0] = 1.0, -1.0  # neighbours in a record that is stacked; the mean is zero
    np.testing.assert_allclose(autocorrelation([first, second])[1:], 0.0, atol=1e-16)
    assert autocorrelation(np.concatenate([first, second]))[1] == pytest.approx(-0.5)
    np.testing.assert_allclose(cross_correlation([first, second], [second, first]), 0.0, atol=0.1)


def test_the_order_of_experiments_does_not_matter():
    rng = np.random.default_rng(1)
    e, u, x = ([rng.normal(size=n) for n in (300, 200, 31)] for _ in range(3))
    e = [coloured(one, -0.5) for one in e]
    for test in (against_input, against_regressor):
        there, back = (
            test(e, u if test is against_input else x),
            test(e[::-1], (u if test is against_input else x)[::-1]),
        )
        assert there.p == pytest.approx(back.p, rel=1e-8)


def test_the_input_leads_at_positive_lags():
    rng = np.random.default_rng(2)
    u = rng.normal(size=500)
    values = cross_correlation(np.roll(u, 4), u)
    assert np.argmax(values) - 25 == 4


def test_lags_are_cut_where_no_experiment_is_longer():
    rng = np.random.default_rng(3)
    e = [rng.normal(size=n) for n in (6, 4)]
    assert len(autocorrelation(e)) == 6 and len(cross_correlation(e, e)) == 11
    found = report(rng.normal(size=12), {"u": rng.normal(size=12)}, {"x": rng.normal(size=12)})
    assert len(found.acf) == 12 and found.ljung_box is None and found.cross["u"].p is None
    assert report(rng.normal(size=70)).ljung_box.freedom == 3


def test_ljung_box_is_its_formula():
    rng = np.random.default_rng(4)
    e = rng.normal(size=800)
    acf = naive_correlation([e], [e], 25)[26:]
    q = 800 * 802 * sum(acf[lag - 1] ** 2 / (800 - lag) for lag in range(1, 26))
    found = ljung_box(e)
    assert found.statistic == pytest.approx(q, rel=1e-10) and found.freedom == 25
    assert found.p == pytest.approx(scipy.stats.chi2.sf(q, 25), rel=1e-10)
    assert ljung_box(e, fitted=4).p == pytest.approx(scipy.stats.chi2.sf(q, 21), rel=1e-10)
    assert ljung_box(e, fitted=99).freedom == 1


def test_normality_is_that_of_scipy():
    e = np.random.default_rng(5).gamma(30.0, size=700)
    found, other = normality([e[:100], e[100:]]), scipy.stats.jarque_bera(e)
    np.testing.assert_allclose(
        [found.statistic, found.p], [other.statistic, other.pvalue], rtol=1e-9
    )
    np.testing.assert_allclose(
        [found.skewness, found.kurtosis], [scipy.stats.skew(e), scipy.stats.kurtosis(e)]
    )


def test_normality_is_asked_of_what_is_left_when_the_colour_is_gone():
    rng = np.random.default_rng(6)
    rejected = sum(
        report(coloured(rng.normal(size=ROWS), -0.95)).normality.p < 0.01 for _ in range(200)
    )
    assert rejected <= 8  # 54 % on the residual itself


def test_against_a_white_residual_the_joint_test_is_a_regression():
    rng = np.random.default_rng(7)
    e, u = rng.normal(size=400), coloured(rng.normal(size=400), -0.9)
    found = against_input(e, u, a=np.ones(1))
    rows, e = np.stack([u[25 - lag : 400 - lag] for lag in range(26)], axis=1), e[25:]
    rows, e = rows - rows.mean(axis=0), e - e.mean()
    left = e - rows @ np.linalg.lstsq(rows, e)[0]
    statistic = (e @ e - left @ left) / 26 / (left @ left / (375 - 27))
    assert found.p == pytest.approx(scipy.stats.f.sf(statistic, 26, 375 - 27), rel=1e-8)


def test_against_a_white_residual_bins_are_an_analysis_of_variance():
    rng = np.random.default_rng(8)
    e, x = rng.normal(size=(2, 1000))
    groups = np.split(e[np.argsort(x)], 20)
    found = against_regressor(e, x, a=np.ones(1))
    assert found.p == pytest.approx(scipy.stats.f_oneway(*groups).pvalue, rel=1e-8)
    np.testing.assert_allclose(found.means + e.mean(), [group.mean() for group in groups])
    within = sum(np.sum((group - group.mean()) ** 2) for group in groups)
    np.testing.assert_allclose(
        found.errors, np.sqrt(within / 980 * (1 / 50 - 1 / 1000))
    )  # of the distance to the mean
    assert found.share == pytest.approx(1 - within / np.sum((e - e.mean()) ** 2))


def test_many_experiments_shorter_than_the_lags_are_tested_from_rest():
    rng = np.random.default_rng(28)
    e, u = ([rng.normal(size=20) for _ in range(50)] for _ in range(2))
    assert against_input(e, u).p > 0.01
    driven = [
        one + 0.5 * np.concatenate([[0.0, 0.0], other[:-2]])
        for one, other in zip(e, u, strict=True)
    ]
    found = against_input(driven, u)
    assert found.p < 1e-10 and found.lag == 2 and len(found.values) == 39


def test_an_offset_is_no_curve():
    rng = np.random.default_rng(9)
    e, x = rng.normal(0.5, 1.0, 2000), rng.normal(size=2000)
    found = report(e, x={"x": x})
    assert found.curved_regressors == () and found.mean == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("values", [[-1.0, 1.0], [-1.0, 0.0, 1.0]])
def test_equal_values_share_a_bin(values):
    rng = np.random.default_rng(10)
    x = rng.choice(values, size=3000, p=[0.02, 0.98] if len(values) == 2 else [0.02, 0.96, 0.02])
    found = against_regressor(rng.normal(size=3000) + (x < 0), x)
    np.testing.assert_array_equal(found.centres, values)
    np.testing.assert_array_equal(found.counts, [np.sum(x == value) for value in values])
    assert found.p < 1e-10 and found.means[0] == pytest.approx(1.0, abs=0.4)


def test_ljung_box_keeps_its_level():
    e = np.random.default_rng(11).normal(size=(RECORDS, ROWS))
    assert BETWEEN[0] < np.mean([ljung_box(one).p < 0.01 for one in e]) < BETWEEN[1]


@pytest.mark.parametrize("period", [25, 250, 1000])
def test_ljung_box_keeps_its_level_where_sizes_go_together(period, record_property):
    """Of a sensor whose noise is a share of its reading 3 to 70 % of white errors were coloured."""
    sizes = np.exp(1.2 * np.sin(2 * np.pi * np.arange(ROWS) / period))
    e = np.random.default_rng(11).normal(size=(600, ROWS)) * sizes
    rejected = np.mean([ljung_box(one).p < 0.01 for one in e])
    record_property("rejected", float(rejected))
    assert rejected < 0.022


def test_uneven_sizes_hide_no_colour():
    sizes = np.exp(1.2 * np.sin(2 * np.pi * np.arange(ROWS) / 250))
    e = coloured(np.random.default_rng(12).normal(size=(100, ROWS)), -0.3) * sizes
    assert np.mean([ljung_box(one).p < 0.01 for one in e]) > 0.85


def test_ljung_box_of_uneven_errors_is_its_formula():
    e = np.random.default_rng(13).normal(size=400) * np.linspace(0.2, 2, 400)
    centred = e - e.mean()
    q = 0.0
    for lag in range(1, 21):
        a, b = centred[lag:], centred[:-lag]
        q += 400 * 402 * (a @ b) ** 2 / (400**2 * np.sum(a**2 * b**2))
    assert ljung_box(e, 20).statistic == pytest.approx(q, rel=1e-9)


def test_ljung_box_keeps_its_level_over_many_short_experiments():
    e = np.random.default_rng(12).normal(size=(RECORDS // 2, 10, 30))
    assert BETWEEN[0] < np.mean([ljung_box(list(one)).p < 0.01 for one in e]) < 0.02


COLOURS = {"white": (), "AR(1)": (-0.9,), "resonance": (-1.9, 0.9409)}


@pytest.mark.proof
@pytest.mark.parametrize("colour", COLOURS)
def test_independence_keeps_its_level(colour, record_property):
    """White and strongly coloured inputs and regressors; band of one value, joint test, bins and sign-like values."""
    rng = np.random.default_rng(13)
    rejected = np.zeros(6)
    for _ in range(RECORDS // 2):
        e, white, slow = rng.normal(size=(3, ROWS + WARM_UP))
        e, slow = (s[WARM_UP:] for s in (coloured(e, *COLOURS[colour]), coloured(slow, -0.95)))
        white, a = white[WARM_UP:], whitening_filter(e)
        first, second = (against_input(e, u, a=a) for u in (white, slow))
        third, fourth = (against_regressor(e, x, a=a) for x in (white, slow))
        fifth = against_regressor(e, np.sign(slow), a=a)
        rejected += [test.p < 0.01 for test in (first, second, third, fourth, fifth)] + [
            abs(second.values[28]) > second.band
        ]
    share = rejected / (RECORDS // 2)  # ± 0.0031 is one standard deviation
    record_property("rejected at 0.01 [%]", f"{100 * share.min():.1f} to {100 * share.max():.1f}")
    assert (share > 0.003).all() and (share < 0.018).all(), share


def test_without_the_colour_of_the_residual_the_level_is_lost():
    """The reason for `whitening`: what the same test does where the residual is taken as white."""
    rng = np.random.default_rng(14)
    rejected = 0
    for _ in range(100):
        e, u = (coloured(one, -0.95)[WARM_UP:] for one in rng.normal(size=(2, ROWS + WARM_UP)))
        rejected += against_input(e, u, a=np.ones(1)).p < 0.01
    assert rejected > 30


def test_the_order_of_the_colour_is_found():
    rng = np.random.default_rng(15)
    e = [coloured(one, -1.2, 0.8)[WARM_UP:] for one in rng.normal(size=(4, 1500))]
    a = whitening_filter(e)
    np.testing.assert_allclose(a[:3], [1.0, -1.2, 0.8], atol=0.06)
    assert len(a) < 9 and np.abs(np.roots(a)).max() < 1
    assert len(whitening_filter(rng.normal(size=1000))) == 1


def test_a_slightly_coloured_residual_is_not_white():
    rng = np.random.default_rng(16)
    found = report(coloured(rng.normal(size=2000), -0.2))
    assert found.white is False and found.ljung_box.p < 1e-6
    assert found.largest_acf == pytest.approx(0.2, abs=0.05) and found.largest_acf > found.acf_band
    assert report(rng.normal(size=2000)).white is True


@pytest.mark.parametrize("colour", COLOURS)
def test_an_input_that_drives_the_residual_is_named_with_its_lag(colour):
    rng = np.random.default_rng(17)
    e, *inputs = rng.normal(size=(4, 2000))
    e = coloured(e, *COLOURS[colour])
    names = dict(zip(["valve", "pump", "heater"], inputs, strict=True))
    found = report(e / e.std() + 0.3 * np.roll(names["pump"], 3), names)
    assert found.correlated_inputs == ("pump",) and found.cross["pump"].lag == 3
    assert found.largest_cross == found.cross["pump"].largest == pytest.approx(0.3, abs=0.06)
    assert found.largest_cross > found.cross["pump"].band


def test_an_input_is_followed_beyond_the_widest_band_only():
    """On 20 000 rows a correlation of 0.04 is certain; a slow input beside a slow residual has a wide band."""
    rng = np.random.default_rng(18)
    e, u, slow = rng.normal(size=(3, 20000))
    found = report(e + 0.04 * u, {"u": u})
    assert (
        found.correlated_inputs == ("u",) and found.follows() == [] and found.follows(0.01) == ["u"]
    )
    found = report(
        coloured(e[:2000], -0.98) + 0.5 * u[:2000],
        {"u": u[:2000], "slow": coloured(slow[:2000], -0.98)},
    )
    assert found.correlated_inputs == ("u",) and found.cross["u"].largest > found.cross["u"].band
    assert found.follows() == []


@pytest.mark.parametrize("colour", COLOURS)
def test_a_curve_names_its_regressor(colour):
    rng = np.random.default_rng(18)
    e, *regressors = rng.normal(size=(4, 2000))
    e = coloured(e, *COLOURS[colour])
    names = dict(zip(["y[k-1]", "y[k-2]", "u[k-1]"], regressors, strict=True))
    found = report(e / e.std() + 0.3 * names["y[k-2]"] ** 2, x=names)
    assert found.curved_regressors == ("y[k-2]",)
    test = found.regressors["y[k-2]"]
    assert found.largest_share == test.share == pytest.approx(0.18 / 1.18, abs=0.05)
    assert test.means[0] > 0.3 and test.means[-1] > 0.3 and test.means[10] < -0.1


@pytest.mark.parametrize("amplitude", [0.3, 1.0, 10.0])
def test_a_slow_input_does_not_hide_behind_the_colour_that_it_gives(amplitude):
    rng = np.random.default_rng(27)
    slow = coloured(rng.normal(size=2000 + WARM_UP), -0.95)[WARM_UP:]
    slow /= slow.std()
    found = report(rng.normal(size=2000) + amplitude * np.roll(slow, 3), {"u": slow}, {"x": slow})
    assert found.order > 0 and found.correlated_inputs == ("u",) and found.cross["u"].lag == 3
    curved = report(rng.normal(size=2000) + amplitude * slow**2, x={"x": slow})
    assert curved.order > 0 and curved.curved_regressors == ("x",)


def test_flags_count_the_tests_of_their_family():
    rng = np.random.default_rng(19)
    e, *signals = rng.normal(size=(41, 500))
    names = {f"s{i}": signal for i, signal in enumerate(signals)}
    found = report(e, names, names, level=0.3)
    for tests, flags in (
        (found.cross, found.correlated_inputs),
        (found.regressors, found.curved_regressors),
    ):
        assert min(test.p for test in tests.values()) < 0.3
        assert flags == tuple(name for name, test in tests.items() if test.p < 0.3 / 40)


def test_an_input_with_few_frequencies_is_tested_where_it_has_any():
    rng = np.random.default_rng(20)
    u = np.sin(0.3 * np.arange(1000))
    p = [against_input(rng.normal(size=1000), u, a=np.ones(1)).p for _ in range(300)]
    assert scipy.stats.kstest(p, "uniform").pvalue > 0.01
    driven = rng.normal(size=(20, 1000)) + 0.3 * u
    assert max(against_input(e, u, a=np.ones(1)).p for e in driven) < 1e-4
    assert (
        np.median([against_input(e, u).p for e in driven]) < 0.01
    )  # the sine is taken for colour in part


@pytest.mark.parametrize("value", [0.0, 0.1, 1e-300, -7e8, np.nan, np.inf, 1e200])
def test_a_residual_that_is_constant_or_without_bounds_has_no_tests(value):
    rng = np.random.default_rng(21)
    e = np.full(1000, value)
    if not np.isfinite(value) or value == 1e200:
        e = np.where(np.arange(1000) < 900, rng.normal(size=1000), value)
    found = report(e, {"u": rng.normal(size=1000)}, {"x": rng.normal(size=1000)})
    assert (
        found.white
        is found.acf
        is found.ljung_box
        is found.normality
        is found.order
        is found.largest_acf
        is None
    )
    assert found.cross == {"u": None} and found.regressors == {"x": None}
    assert found.correlated_inputs == found.curved_regressors == ()
    assert (found.rms is None) == (not abs(value) < 1e100)
    ResidualTestResult.model_validate(found).to_json()


@pytest.mark.parametrize("value", [0.0, 0.1, np.nan, np.inf])
def test_a_signal_that_does_not_move_or_exist_has_no_test(value):
    rng = np.random.default_rng(22)
    still, moving = np.full(500, value), rng.normal(size=500)
    found = report(rng.normal(size=500), {"a": still, "b": moving}, {"a": still, "b": moving})
    assert found.cross["a"] is found.regressors["a"] is None
    assert found.cross["b"].p > 0 and found.regressors["b"].p > 0


@pytest.mark.parametrize("rows", [0, 1, 2, 3, 9, 10, 19, 20, 27, 41])
def test_short_records_have_what_they_can(rows):
    rng = np.random.default_rng(23)
    found = report(
        rng.normal(size=rows), {"u": rng.normal(size=rows)}, {"x": rng.normal(size=rows)}
    )
    ResidualTestResult.model_validate(found).to_json()
    assert found.n == rows and (found.white is None) == (rows < 20)
    assert (found.regressors["x"] is None) == (rows < 10)


@pytest.mark.parametrize(
    "e", [np.arange(400.0), np.sin(np.arange(400) / 9), np.tile([1.0, -1.0], 200), np.eye(400)[7]]
)
def test_residuals_without_noise_do_not_break_anything(e):
    rng = np.random.default_rng(24)
    tests = report(e, {"e": e, "u": rng.normal(size=400)}, {"e": e, "x": np.roll(e, 1)})
    ResidualTestResult.model_validate(tests).to_json()
    assert tests.n == 400 and tests.rms == pytest.approx(np.sqrt(np.mean(e**2)))
    assert tests.cross["e"].lag == 0 and tests.cross["e"].largest == pytest.approx(1)
    np.testing.assert_allclose(
        tests.cross["e"].values, np.concatenate([tests.acf[:0:-1], tests.acf]), atol=1e-12
    )
    assert 0 <= tests.ljung_box.p <= 1 and 0 < tests.regressors["e"].share <= 1


def test_results_do_not_depend_on_units():
    rng = np.random.default_rng(25)
    e, u, x = rng.normal(size=(3, 600))
    e = coloured(e, -0.7) + 0.1 * x**2
    plain, scaled = (
        report(e, {"u": u}, {"x": x}),
        report(1e-9 * e, {"u": 1e7 * u + 3e7}, {"x": 1e-5 * x}),
    )
    assert scaled.ljung_box.p == pytest.approx(plain.ljung_box.p)
    assert scaled.cross["u"].p == pytest.approx(plain.cross["u"].p, rel=1e-6)
    assert scaled.cross["u"].band == pytest.approx(plain.cross["u"].band)
    assert scaled.regressors["x"].p == pytest.approx(plain.regressors["x"].p)
    np.testing.assert_allclose(
        scaled.regressors["x"].means, 1e-9 * plain.regressors["x"].means, atol=1e-20
    )
    assert scaled.rms == pytest.approx(1e-9 * plain.rms)


def test_every_output_has_its_tests_as_plain_content():
    rng = np.random.default_rng(26)
    shapes = [(300, 200), (3, 2, 4)]
    e, u, x = ([rng.normal(size=(n, columns)) for n in shapes[0]] for columns in shapes[1])
    found = analyse(e, u, x, ["p", "q", "r"], ["a", "b"], ["s", "t", "v", "w"])
    assert [test.name for test in found] == ["p", "q", "r"]
    for i, test in enumerate(found):
        assert test.ljung_box == ljung_box([one[:, i] for one in e])
        assert test.acf_band == pytest.approx(2.5758 / np.sqrt(500), rel=1e-4)
        content = json.loads(ResidualTestResult.model_validate(test).to_json())
        assert list(content["cross"]) == ["a", "b"] and list(content["regressors"]) == [
            "s",
            "t",
            "v",
            "w",
        ]
        assert len(content["acf"]) == 26 and len(content["cross"]["b"]["values"]) == 51
        assert content["white"] is test.white and content["ljung_box"]["freedom"] == 25
        assert content["n"] == 500 and sum(content["regressors"]["w"]["counts"]) == 500
        assert content["correlated_inputs"] == list(test.correlated_inputs)
