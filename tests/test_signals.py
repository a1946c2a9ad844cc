"""Excitation signals: the property that each is used for."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal

from orthaug import InputError
from orthaug.analysis.signals import (
    limit_rate,
    multisine,
    prbs,
    sign_symmetric,
    square,
    swept_square,
    white_binary,
    white_gaussian,
    white_uniform,
)


def crest_factor(u):
    """Largest magnitude over root mean square: 1 of a binary signal, 1.41 of a sine."""
    return np.abs(u).max() / np.sqrt(np.mean(u**2))


BAND = (0.01, 0.2)
ALL = {
    "multisine": lambda n: multisine(n, BAND),
    "odd multisine": lambda n: multisine(n, BAND, odd=True),
    "prbs": lambda n: prbs(n, 3),
    "swept square": lambda n: swept_square(n, BAND),
    "square": lambda n: square(n, 14),
    "gaussian": lambda n: white_gaussian(n, 1),
    "uniform": lambda n: white_uniform(n, 1),
    "binary": lambda n: white_binary(n, 1, 4),
}
TWO_LEVELS = ("prbs", "swept square", "square", "binary")


@pytest.mark.parametrize("samples", [100, 1000, 1024])
@pytest.mark.parametrize("name", ALL)
def test_length_limit_and_repeatability(name, samples):
    u = ALL[name](samples)
    assert u.shape == (samples,) and u.dtype == np.float64
    assert 0.7 < np.abs(u).max() <= 1.0
    np.testing.assert_array_equal(u, ALL[name](samples))
    if name in TWO_LEVELS:
        assert set(u) == {-1.0, 1.0}


@pytest.mark.parametrize("odd", [False, True])
def test_multisine_has_equal_lines_in_its_band_and_nothing_else(odd):
    u = multisine(1000, BAND, odd=odd)
    lines = np.abs(np.fft.rfft(u))
    wanted = np.zeros(501, dtype=bool)
    wanted[10:201] = True
    if odd:
        wanted[::2] = False
    np.testing.assert_allclose(lines[wanted], lines[wanted].mean(), rtol=1e-10)
    assert lines[~wanted].max() < 1e-10 * lines[wanted].mean()
    assert np.abs(u).max() == pytest.approx(1.0, rel=1e-15)


def test_schroeders_phases_keep_the_crest_factor_low():
    u = multisine(1000, (0.0, 0.5))
    rng = np.random.default_rng(0)
    spectrum = np.r_[0.0, np.exp(2j * np.pi * rng.uniform(size=499)), 0.0]
    assert crest_factor(u) < 1.6 < 2.5 < crest_factor(np.fft.irfft(spectrum))
    assert crest_factor(multisine(1000, (0.0, 0.5), odd=True)) < 1.6
    assert crest_factor(multisine(1000, (0.01, 0.01))) == pytest.approx(np.sqrt(2))


def test_an_odd_multisine_is_orthogonal_to_even_terms():
    u = multisine(1000, (0.0, 0.5), odd=True)
    np.testing.assert_array_equal(u[:500], -u[500:])
    assert abs(np.vdot(u, u**2)) < 1e-12 * np.linalg.norm(u) * np.linalg.norm(u**2)


def test_prbs_is_white_over_its_period():
    u = prbs(127)
    correlation = np.fft.ifft(np.abs(np.fft.fft(u)) ** 2).real
    np.testing.assert_allclose(correlation, [127.0] + [-1.0] * 126, atol=1e-9)
    np.testing.assert_array_equal(prbs(380, 3), np.repeat(u, 3)[:380])


@pytest.mark.parametrize("samples", [1, 2, 3, 4, 7, 8, 1023, 1024])
def test_prbs_does_not_repeat(samples):
    bits = max(2, int(np.ceil(np.log2(samples + 1))))
    whole = 2.0 * scipy.signal.max_len_seq(bits)[0] - 1
    np.testing.assert_array_equal(prbs(samples), whole[:samples])
    assert 2**bits - 1 >= samples and (bits == 2 or 2 ** (bits - 1) - 1 < samples)


def test_a_sweep_runs_through_its_band():
    u = swept_square(10_000, (0.002, 0.05))
    assert u[0] == u[1] == 1.0
    crossings = np.r_[0, np.flatnonzero(np.diff(u))]
    frequency = 0.5 / np.diff(crossings)
    assert frequency[0] == pytest.approx(0.0021, rel=0.01)  # the mean of its first half wave
    assert frequency[-1] == pytest.approx(0.05, rel=0.03)
    middle = frequency[np.searchsorted(crossings, 5000)]
    assert middle == pytest.approx(0.01, rel=0.03)


def test_square():
    np.testing.assert_array_equal(square(7, 4), [1, 1, -1, -1, 1, 1, -1])


def test_statistics_of_white_signals():
    n = 20_000
    gaussian, uniform = white_gaussian(n, 2), white_uniform(n, 2)
    assert gaussian.std() == pytest.approx(1 / 3, abs=0.01)
    assert np.mean(np.abs(gaussian) == 1.0) == pytest.approx(0.0027, abs=0.001)
    assert uniform.std() == pytest.approx(1 / np.sqrt(3), rel=0.01)
    for u in (gaussian, uniform, white_binary(n, 2)):
        assert abs(u.mean()) < 0.03 and abs(np.mean(u[1:] * u[:-1])) < 0.03
    assert np.any(white_uniform(9, 0) != white_uniform(9, 1))
    held = white_binary(999, 3, 10)
    np.testing.assert_array_equal(held[:990].reshape(-1, 10), held[:990:10, None] * np.ones(10))


def test_sign_symmetric_satisfies_the_papers_condition():
    u = sign_symmetric(white_gaussian(500, 4))
    assert u.shape == (1000,)
    for power in (1, 3, 5):
        assert abs(np.vdot(u**power, u**2)) < 1e-12


def test_rate_limit():
    u = np.array([0.0, 5.0, 5.0, 5.0, -5.0, -5.0])
    np.testing.assert_array_equal(limit_rate(u, 2.0, 0.0), [0, 2, 4, 5, 3, 1])
    np.testing.assert_array_equal(limit_rate(u, 2.0, -10), [-8, -6, -4, -2, -4, -5])
    np.testing.assert_array_equal(limit_rate(u, 10.0, 0.0), u)
    wild = white_uniform(1000, 5)
    limited = limit_rate(wild, 0.1, wild[0])
    assert np.abs(np.diff(limited)).max() <= 0.1 + 1e-15 and np.abs(limited).max() <= 1.0
    np.testing.assert_array_equal(limit_rate(-wild, 0.1, -wild[0]), -limited)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (np.ones((3, 2)), r"`u` must be one channel of at least one sample, \(N,\); got shape"),
        (np.array([]), r"got shape \(0,\)"),
        (np.array([1.0, np.nan]), "`u` is not finite at row 1, channel 0"),
    ],
)
def test_refusals_of_a_given_signal(given, message):
    with pytest.raises(InputError, match=message):
        sign_symmetric(given)
