"""Linear filters of whole signals, against those of SciPy."""

import numpy as np
import pytest
from scipy.signal import lfilter

from orthaug._base.filters import autoregression, moving_sum


@pytest.mark.parametrize("rows", [1, 3, 100, 4096, 4097, 9000])
@pytest.mark.parametrize("order", [0, 1, 5, 30])
@pytest.mark.parametrize("columns", [(), (3,), (2, 2)])
def test_filters_are_those_of_scipy(rows, order, columns):
    rng = np.random.default_rng([rows, order])
    a = np.append(1.3, rng.normal(size=order) * 0.5 / (order + 1))
    x = rng.normal(size=(rows, *columns))
    np.testing.assert_allclose(autoregression(a, x), lfilter([1.0], a, x, axis=0), atol=1e-12)
    np.testing.assert_allclose(moving_sum(a, x), lfilter(a, [1.0], x, axis=0), atol=1e-12)


def test_signals_are_left_as_they_are():
    x = np.arange(5.0)
    autoregression(np.array([1.0, -0.5]), x)
    moving_sum(np.array([1.0, -0.5]), x)
    np.testing.assert_array_equal(x, np.arange(5.0))
