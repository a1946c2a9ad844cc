"""Excitation signals: the property that each is used for, and every refusal in its words."""

from __future__ import annotations

import numpy as np
import pytest

from orthaug import InputError
from orthaug.analysis.signals import (
    binary_pattern,
    limit_rate,
    multisine,
    prbs,
    sign_symmetric,
    square,
    swept_sine,
    swept_square,
    white_binary,
    white_gaussian,
    white_uniform,
)


def crest_factor(u):
    """Largest magnitude over root mean square: 1 of a binary signal, 1.41 of a sine."""
    return np.abs(u).max() / np.sqrt(np.mean(u**2))


BAND = {"sampling_time": 0.01, "band": (1.0, 20.0)}
ALL = {
    "multisine": lambda n: multisine(n, amplitude=3.0, **BAND),
    "odd multisine": lambda n: multisine(n, amplitude=3.0, odd=True, **BAND),
    "prbs": lambda n: prbs(n, amplitude=3.0, hold=3),
    "swept sine": lambda n: swept_sine(n, amplitude=3.0, **BAND),
    "logarithmic sweep": lambda n: swept_sine(n, amplitude=3.0, logarithmic=True, **BAND),
    "swept square": lambda n: swept_square(n, amplitude=3.0, **BAND),
    "square": lambda n: square(n, amplitude=3.0, period=14),
    "pattern": lambda n: binary_pattern(n, [1, 1, 0, 1, 0], amplitude=3.0, hold=2),
    "gaussian": lambda n: white_gaussian(n, amplitude=3.0, seed=1, deviation=2.0),
    "uniform": lambda n: white_uniform(n, amplitude=3.0, seed=1),
    "binary": lambda n: white_binary(n, amplitude=3.0, seed=1, hold=4),
}
TWO_LEVELS = ("prbs", "swept square", "square", "pattern", "binary")


@pytest.mark.parametrize("samples", [100, 1000, 1024])
@pytest.mark.parametrize("name", ALL)
def test_length_limit_and_repeatability(name, samples):
    u = ALL[name](samples)
    assert u.shape == (samples,) and u.dtype == np.float64
    assert 2.7 < np.abs(u).max() <= 3.0
    np.testing.assert_array_equal(u, ALL[name](samples))
    if name in TWO_LEVELS:
        assert set(u) == {-3.0, 3.0}


@pytest.mark.parametrize("odd", [False, True])
def test_multisine_has_equal_lines_in_its_band_and_nothing_else(odd):
    u = multisine(2000, amplitude=2.0, periods=2, odd=odd, **BAND)
    np.testing.assert_array_equal(u[:1000], u[1000:])
    lines = np.abs(np.fft.rfft(u[:1000]))
    wanted = np.zeros(501, dtype=bool)
    wanted[10:201] = True  # 1000 samples of 0.01 s: lines 0.1 Hz apart
    if odd:
        wanted[::2] = False
    np.testing.assert_allclose(lines[wanted], lines[wanted].mean(), rtol=1e-10)
    assert lines[~wanted].max() < 1e-10 * lines[wanted].mean()
    assert np.abs(u).max() == pytest.approx(2.0, rel=1e-15)


def test_schroeders_phases_keep_the_crest_factor_low():
    u = multisine(1000, amplitude=1.0)
    rng = np.random.default_rng(0)
    spectrum = np.r_[0.0, np.exp(2j * np.pi * rng.uniform(size=499)), 0.0]
    assert crest_factor(u) < 1.6 < 2.5 < crest_factor(np.fft.irfft(spectrum))
    assert crest_factor(multisine(1000, amplitude=1.0, odd=True)) < 1.6
    assert crest_factor(multisine(1000, amplitude=1.0, band=(0.01, 0.01))) == pytest.approx(
        np.sqrt(2)
    )


def test_an_odd_multisine_is_orthogonal_to_even_terms():
    u = multisine(1000, amplitude=2.0, odd=True)
    np.testing.assert_array_equal(u[:500], -u[500:])
    assert abs(np.vdot(u, u**2)) < 1e-12 * np.linalg.norm(u) * np.linalg.norm(u**2)


def test_prbs_is_white_over_its_period():
    u = prbs(127, amplitude=1.0, bits=7)
    correlation = np.fft.ifft(np.abs(np.fft.fft(u)) ** 2).real
    np.testing.assert_allclose(correlation, [127.0] + [-1.0] * 126, atol=1e-9)
    np.testing.assert_array_equal(prbs(300, amplitude=1.0, bits=7), np.resize(u, 300))
    np.testing.assert_array_equal(
        prbs(380, amplitude=2.0, bits=7, hold=3), np.repeat(2 * u, 3)[:380]
    )


@pytest.mark.parametrize("samples", [1, 2, 3, 4, 7, 8, 1023, 1024])
def test_prbs_does_not_repeat_unless_asked(samples):
    bits = max(2, int(np.ceil(np.log2(samples + 1))))
    np.testing.assert_array_equal(
        prbs(samples, amplitude=1.0), prbs(samples, amplitude=1.0, bits=bits)
    )
    assert 2**bits - 1 >= samples and (bits == 2 or 2 ** (bits - 1) - 1 < samples)


@pytest.mark.parametrize("logarithmic", [False, True])
def test_a_sweep_runs_through_its_band(logarithmic):
    u = swept_sine(
        10_000, amplitude=1.0, sampling_time=0.001, band=(2.0, 50.0), logarithmic=logarithmic
    )
    assert u[0] == 0.0 and u[1] > 0
    crossings = np.flatnonzero(np.diff(np.sign(u)) != 0) * 0.001
    frequency = 0.5 / np.diff(crossings)
    assert frequency[0] == pytest.approx(
        2.1 if logarithmic else 2.5, rel=0.01
    )  # the mean of its first half wave
    assert frequency[-1] == pytest.approx(50.0, rel=0.03)
    middle = frequency[np.searchsorted(crossings, 5.0)]
    assert middle == pytest.approx(10.0 if logarithmic else 26.0, rel=0.03)


def test_a_sweep_may_fall_and_has_a_square_companion():
    down = swept_sine(1000, amplitude=1.0, sampling_time=0.01, band=(20.0, 1.0))
    assert np.sum(np.diff(np.sign(down[:500])) != 0) > np.sum(np.diff(np.sign(down[500:])) != 0)
    wave = swept_square(1000, amplitude=2.0, sampling_time=0.01, band=(20.0, 1.0))
    np.testing.assert_array_equal(wave, np.where(down >= 0, 2.0, -2.0))


def test_square_and_pattern():
    np.testing.assert_array_equal(square(7, amplitude=2.0, period=4), [2, 2, -2, -2, 2, 2, -2])
    np.testing.assert_array_equal(
        binary_pattern(7, [0, 1, 1], amplitude=1.0, hold=2), [-1, -1, 1, 1, 1, 1, -1]
    )
    np.testing.assert_array_equal(
        binary_pattern(3, np.array([True, False]), amplitude=1.0), [1, -1, 1]
    )


def test_statistics_of_white_signals():
    n = 20_000
    gaussian = white_gaussian(n, amplitude=3.0, seed=2)
    assert gaussian.std() == pytest.approx(1.0, abs=0.03)  # amplitude / 3
    assert np.mean(
        np.abs(white_gaussian(n, amplitude=1.0, seed=2, deviation=1.0)) == 1.0
    ) == pytest.approx(0.317, abs=0.01)
    assert white_uniform(n, amplitude=3.0, seed=2).std() == pytest.approx(3 / np.sqrt(3), rel=0.01)
    for u in (
        gaussian,
        white_uniform(n, amplitude=1.0, seed=2),
        white_binary(n, amplitude=1.0, seed=2),
    ):
        assert abs(u.mean()) < 0.03 and abs(np.mean(u[1:] * u[:-1])) < 0.03
    assert np.any(
        white_uniform(9, amplitude=1.0, seed=0) != white_uniform(9, amplitude=1.0, seed=1)
    )
    held = white_binary(999, amplitude=1.0, seed=3, hold=10)
    np.testing.assert_array_equal(held[:990].reshape(-1, 10), held[:990:10, None] * np.ones(10))


def test_sign_symmetric_satisfies_the_papers_condition():
    u = sign_symmetric(white_gaussian(500, amplitude=1.0, seed=4))
    assert u.shape == (1000,)
    for power in (1, 3, 5):
        assert abs(np.vdot(u**power, u**2)) < 1e-12


def test_rate_limit():
    u = np.array([0.0, 5.0, 5.0, 5.0, -5.0, -5.0])
    np.testing.assert_array_equal(limit_rate(u, 2.0), [0, 2, 4, 5, 3, 1])
    np.testing.assert_array_equal(limit_rate(u, 2.0, start=-10), [-8, -6, -4, -2, -4, -5])
    np.testing.assert_array_equal(limit_rate(u, 10.0), u)
    wild = white_uniform(1000, amplitude=1.0, seed=5)
    limited = limit_rate(wild, 0.1)
    assert np.abs(np.diff(limited)).max() <= 0.1 + 1e-15 and np.abs(limited).max() <= 1.0
    np.testing.assert_array_equal(limit_rate(-wild, 0.1), -limited)


SIZES = {"samples": 100, "amplitude": 1.0}
REFUSALS = [
    (multisine, {"samples": 3}, "`samples` must be a whole number, 4 or more; got 3"),
    (multisine, {"amplitude": 0.0}, "`amplitude` must be a positive number; got 0.0"),
    (multisine, {"sampling_time": -1.0}, "`sampling_time` must be a positive number; got -1.0"),
    (
        multisine,
        {"periods": 3},
        "100 samples do not divide into 3 periods of 4 or more whole samples",
    ),
    (multisine, {"periods": 50}, "100 samples do not divide into 50 periods"),
    (
        multisine,
        {"samples": 99, "odd": True},
        "needs an even number of samples in a period; got 99",
    ),
    (multisine, {"band": (0.011, 0.019)}, r"holds no harmonic: they are 0.01 Hz apart"),
    (multisine, {"band": (0.02, 0.02), "odd": True}, "holds no odd harmonic"),
    (
        multisine,
        {"band": (0.2, 0.1)},
        r"must run from the lower to the higher of two frequencies; got \(0.2, 0.1\)",
    ),
    (
        multisine,
        {"band": (0.2, 0.6)},
        r"`band` must lie between 0 and 0.5 Hz, half the sampling frequency; got \(0.2",
    ),
    (multisine, {"band": (-0.2, 0.1)}, "`band` must lie between 0 and 0.5 Hz"),
    (multisine, {"band": 0.1}, "`band` must be two frequencies in Hz; got 0.1"),
    (multisine, {"band": (0.1, float("nan"))}, "`band` must be two frequencies in Hz"),
    (multisine, {"band": "ab"}, "`band` must be two frequencies in Hz; got 'ab'"),
    (prbs, {"hold": 0}, "`hold` must be a whole number, 1 or more; got 0"),
    (prbs, {"bits": 1}, "`bits` must be a whole number, 2 or more; got 1"),
    (prbs, {"bits": 30}, "a register of 30 bits is too long; at most 24"),
    (swept_sine, {"band": (0.1, 0.1)}, "must run from the lower to the higher of two frequencies"),
    (
        swept_sine,
        {"band": (0.0, 0.1), "logarithmic": True},
        "a logarithmic sweep needs two frequencies above zero",
    ),
    (
        swept_square,
        {"band": (0.0, 0.1), "amplitude": -1.0},
        "`amplitude` must be a positive number; got -1.0",
    ),
    (
        square,
        {"period": 5},
        "`period` must be an even number of samples, half for each level; got 5",
    ),
    (binary_pattern, {"pattern": [0, 2]}, r"`pattern` must be a sequence of 0 and 1; got \[0, 2\]"),
    (binary_pattern, {"pattern": []}, "`pattern` must be a sequence of 0 and 1"),
    (binary_pattern, {"pattern": "0101"}, "`pattern` must be a sequence of 0 and 1; got '0101'"),
    (
        white_gaussian,
        {"seed": 0, "deviation": 0.0},
        "`deviation` must be a positive number; got 0.0",
    ),
    (white_gaussian, {"seed": -1}, "`seed` must be a whole number, 0 or more; got -1"),
    (white_uniform, {"seed": None}, "`seed` must be a whole number, 0 or more; got None"),
    (
        white_uniform,
        {"seed": 0, "samples": 1.5},
        "`samples` must be a whole number, 1 or more; got 1.5",
    ),
    (white_binary, {"seed": 0, "hold": -1}, "`hold` must be a whole number, 1 or more; got -1"),
]


@pytest.mark.parametrize(("signal", "change", "message"), REFUSALS)
def test_refusals(signal, change, message):
    with pytest.raises(InputError, match=message) as caught:
        signal(**(SIZES | change))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: sign_symmetric(np.ones((3, 2))),
            r"`u` must be one channel of at least one sample, \(N,\); got shape",
        ),
        (lambda: sign_symmetric(np.array([])), r"got shape \(0,\)"),
        (lambda: sign_symmetric(np.array([1.0, np.nan])), "`u` is not finite at row 1, channel 0"),
        (lambda: limit_rate(np.ones(3), 0.0), "`largest_step` must be a positive number; got 0.0"),
        (
            lambda: limit_rate(np.ones(3), 1.0, start=float("inf")),
            "`start` must be a finite number; got inf",
        ),
    ],
)
def test_refusals_of_given_signals(call, message):
    with pytest.raises(InputError, match=message):
        call()
