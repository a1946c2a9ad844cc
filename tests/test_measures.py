"""Measures: their points and weights, quadrature against SciPy, the reach of the data, every refusal in its words."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.integrate

from orthaug import InputError, Lags, Record, Samples, Symmetrized, Training, Uniform, Weighted
from orthaug.data.regressors import largest_lag
from orthaug.inference.measures import Measure, Support

RNG = np.random.default_rng(0)
U = 0.3 * RNG.normal(size=400)
Y = RNG.normal(size=400)


def support(na=0, nb=1, nk=0, used=None, u=U) -> Support:
    """A record of one input and one output; the model reads the lags numbered `used` of the layout, all by default."""
    layout = Lags(na, nb, nk).layout(["y"], ["u"])
    return Support(
        Record.from_arrays(u, Y[: len(u)]),
        layout,
        layout if used is None else tuple(layout[i] for i in used),
    )


ONE = support()
TWO = support(na=1, nk=1)


def mean(function, points) -> float:
    """∫ function dμ."""
    return float(points.weight @ function(*points.x.T))


@pytest.mark.parametrize("kind", [Training, Symmetrized, Uniform])
def test_a_measure_has_a_name_and_weights_that_add_up_to_one(kind):
    points = kind().points(TWO)
    assert isinstance(kind(), Measure) and kind().name == kind.__name__.lower()
    assert points.x.shape == (len(points.weight), 2) and (points.weight >= 0).all()
    assert points.weight.sum() == pytest.approx(1, abs=1e-12)


# --- the training rows


def two_experiments() -> Support:
    record = Record.join(
        [Record.from_arrays(U[:10], Y[:10]), Record.from_arrays(U[10:17], Y[10:17])]
    )
    layout = Lags(na=2, nb=1, nk=0).layout(["y"], ["u"])
    return Support(record, layout, layout)


def test_training_is_every_usable_row_of_every_experiment():
    points = Training().points(two_experiments())
    rows = [(Y[k - 1], Y[k - 2], U[k]) for k in (*range(2, 10), *range(12, 17))]
    np.testing.assert_array_equal(points.x, rows)
    np.testing.assert_allclose(points.weight, 1 / 13)


def test_rows_are_a_half_open_part_of_every_experiment():
    points = Training(rows=(1, 4)).points(two_experiments())
    np.testing.assert_array_equal(points.x, [(Y[k - 1], Y[k - 2], U[k]) for k in (2, 3, 12, 13)])
    assert Training(rows=(0, 100)).points(two_experiments()).x.shape == (13, 3)


def test_rows_without_a_usable_one_are_refused():
    with pytest.raises(InputError, match=r"rows 0:2 hold no usable row; the first is at row 2"):
        Training(rows=(0, 2)).points(two_experiments())


def test_training_measures_of_the_same_rows_are_equal():
    assert Training() == Training() != Training(rows=(0, 5))


def test_symmetrized_adds_the_mirror_images():
    points = Symmetrized().points(TWO)
    np.testing.assert_array_equal(points.x, np.concatenate([TWO.x, -TWO.x]))
    assert mean(lambda y, u: y**3 + y * u**2, points) == pytest.approx(0, abs=1e-15)


def test_weighted_scales_its_weights():
    weights = np.arange(400.0)
    points = Weighted(weights).points(ONE)
    np.testing.assert_allclose(points.weight, weights / weights.sum(), rtol=1e-15)
    np.testing.assert_array_equal(points.x, ONE.x)


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (np.ones(3), r"there are \(3,\) weights for 400 usable rows; give one for each"),
        (np.ones((400, 1)), r"there are \(400, 1\) weights for 400 usable rows"),
        (
            np.where(np.arange(400) == 3, -1.5, 1.0),
            "weight 3 of the usable rows, counted from 0, is -1.5; expected a finite number, 0 or",
        ),
        (np.zeros(400), "the weights of the usable rows are all 0; expected one above"),
        (np.full(400, np.nan), "weight 0 of the usable rows, counted from 0, is nan; expected a"),
        (["a"] * 400, "the weights must be numbers"),
    ],
)
def test_bad_weights(weights, message):
    with pytest.raises(InputError, match=message):
        Weighted(weights).points(ONE)


# --- samples


def test_samples_are_named_and_unread_lags_stay_zero():
    given = {" u[ k ] ": [1.0, 2.0], "y[k-2]": [3, 4]}
    points = Samples(given, weights=[1, 3]).points(support(na=2, used=(1, 2)))
    np.testing.assert_array_equal(points.x, [[0, 3, 1], [0, 4, 2]])
    np.testing.assert_array_equal(points.weight, [0.25, 0.75])


def test_lag_zero_may_be_written_out():
    np.testing.assert_array_equal(Samples({"u[k-0]": [1.0, 5.0]}).points(ONE).x[:, 0], [1, 5])


@pytest.mark.parametrize(
    ("columns", "weights", "message"),
    [
        ({"u[k-1]": [1.0]}, None, r"the samples lack y\[k-1\]; give a column for every raw lag"),
        (
            {"u[k-1]": [1.0], "y[k-3]": [1.0]},
            None,
            r"'y\[k-3\]' is no raw lag .* did you mean 'y\[k-1\]'",
        ),
        (
            {"u[k-1]": [1.0, 2.0], "y[k-1]": [1.0]},
            None,
            "columns differ in shape: .*; give one vector of a length",
        ),
        ({"u[k-1]": np.ones((2, 2)), "y[k-1]": np.ones((2, 2))}, None, "columns differ in shape"),
        ({"u[k-1]": [], "y[k-1]": []}, None, "the samples have no rows"),
        (
            {"u[k-1]": [np.inf], "y[k-1]": [1.0]},
            None,
            r"column u\[k-1\] holds a value that is not finite",
        ),
        (
            {"u[k-1]": [np.nan], "y[k-1]": [1.0]},
            None,
            r"column u\[k-1\] holds a value that is not finite",
        ),
        ({"u[k-1]": [1.0], "y[k-1]": [1.0]}, [1.0, 2.0], r"there are \(2,\) weights for 1 samples"),
        ({"u[k-1]": [1.0, 2.0], "y[k-1]": [1.0, 2.0]}, [2.0, -1.0], "counted from 0, is -1"),
        ({"u[k-1]": ["a"], "y[k-1]": [1.0]}, None, r"column u\[k-1\]"),
        ({"u[k-1]": [1.0], "u[ k-1]": [2.0], "y[k-1]": [1.0]}, None, r"u\[k-1\].* twice"),
    ],
)
def test_bad_samples(columns, weights, message):
    with pytest.raises(InputError, match=message):
        Samples(columns, weights).points(TWO)


# --- uniform

BOX = {"u[k]": (-0.5, 1.5)}
SMOOTH = {
    "exp": lambda x: np.exp(3 * x),
    "rational": lambda x: 1 / (1 + 25 * x**2),
    "one": lambda x: 0 * x + 1,
}
KINKED = {"kink": (lambda x: np.abs(x - 0.3), 0.3), "root": (lambda x: np.sqrt(np.abs(x)), 0.0)}
JUMPS = {"of the centre": 0.5, "elsewhere": 0.3}


@pytest.mark.parametrize("name", SMOOTH)
def test_one_coordinate_is_exact_for_smooth_functions(name):
    expected = scipy.integrate.quad(SMOOTH[name], -0.5, 1.5, epsabs=1e-13)[0] / 2
    assert mean(SMOOTH[name], Uniform(BOX).points(ONE)) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("name", KINKED)
def test_one_coordinate_is_exact_to_1e_6_for_kinks(name):
    function, at = KINKED[name]
    expected = scipy.integrate.quad(function, -0.5, 1.5, points=[at], epsabs=1e-12)[0] / 2
    assert mean(function, Uniform(BOX).points(ONE)) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("name", JUMPS)
def test_one_coordinate_is_exact_to_1e_6_for_jumps(name):
    at = JUMPS[name]
    assert mean(lambda x: np.sign(x - at), Uniform(BOX).points(ONE)) == pytest.approx(
        0.5 - at, abs=1e-6
    )


@pytest.mark.parametrize("coordinates", [2, 3])
def test_a_tensor_rule_integrates_polynomials(coordinates):
    given = support(nb=coordinates)
    box = {f"u[k-{i}]": (-0.5, 1.5) for i in range(coordinates)}
    one = [(1.5 ** (n + 1) - (-0.5) ** (n + 1)) / (2 * (n + 1)) for n in range(8)]
    found = mean(lambda *x: x[0] ** 7 * x[1] ** 2 * x[-1] ** 3, Uniform(box).points(given))
    expected = one[7] * (one[5] if coordinates == 2 else one[2] * one[3])
    assert found == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("coordinates", [1, 2, 3, 4])
def test_the_rule_is_symmetric_about_the_centre_of_the_box(coordinates):
    given = support(nb=coordinates)
    box = {f"u[k-{i}]": (1.0 - i, 3.0 + i) for i in range(coordinates)}
    points = Uniform(box).points(given)
    away = points.x - np.array([2.0] * coordinates)
    assert np.abs(points.weight @ away**3).max() < 1e-12
    assert np.abs(away.max(axis=0) + away.min(axis=0)).max() < 1e-12
    assert points.weight.sum() == pytest.approx(1, abs=1e-12)


def test_four_coordinates_are_quasi_random_and_always_the_same():
    given = support(nb=4)
    box = {f"u[k-{i}]": (-1.0, 1.0) for i in range(4)}
    points, again = Uniform(box).points(given), Uniform(box).points(given)
    np.testing.assert_array_equal(points.x, again.x)
    assert mean(lambda *x: x[0] ** 2 * x[1] ** 2 + x[2] * x[3], points) == pytest.approx(
        1 / 9, abs=2e-5
    )


def test_the_box_is_the_range_of_the_data_where_none_is_given():
    low, high = Uniform({"u[k-1]": (-7, 7)}).limits(TWO)
    np.testing.assert_array_equal([low, high], [[TWO.x[:, 0].min(), -7], [TWO.x[:, 0].max(), 7]])


def test_lags_that_the_model_does_not_read_take_no_part():
    points = Uniform({"u[k-1]": (-1, 1)}).points(support(na=2, nb=3, used=(3,)))
    alone = Uniform({"u[k]": (-1, 1)}).points(ONE)
    np.testing.assert_array_equal(points.x[:, 3], alone.x[:, 0])
    assert np.ptp(points.x, axis=0)[[0, 1, 2, 4]].max() == 0


def test_a_model_that_reads_no_lag_has_one_point():
    points = Uniform().points(support(used=()))
    assert points.x.shape == (1, 1) and points.weight == [1.0]


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ({"u[k]": (1.0, 1.0)}, r"the box of u\[k\] is empty or reversed: 1 to 1"),
        ({"u[k]": (2.0, -1.0)}, r"empty or reversed: 2 to -1"),
        ({"u[k]": (-1.0, float("inf"))}, r"the box of u\[k\]"),
        ({"u[k]": (float("nan"), 1.0)}, r"the box of u\[k\]"),
        ({"u[k]": (1.0, 2.0, 3.0)}, r"must be two numbers, lower and upper; got \(1.0, 2.0, 3.0\)"),
        ({"u[k]": 1.0}, "must be two numbers, lower and upper; got 1.0"),
        ({"u[k]": ("a", "b")}, "must be two numbers, lower and upper"),
        (
            {"u[k-1]": (-1.0, 1.0)},
            r"'u\[k-1\]' is no raw lag that this model reads.* It reads u\[k\]",
        ),
        ({"v[k]": (-1.0, 1.0)}, r"'v\[k\]' is no raw lag that this model reads"),
        ({"u": (-1.0, 1.0)}, "'u' is no raw lag that this model reads"),
    ],
)
def test_bad_boxes(box, message):
    with pytest.raises(InputError, match=message):
        Uniform(box).points(ONE)


def test_a_lag_that_is_not_read_has_no_limits():
    with pytest.raises(InputError, match=r"'y\[k-1\]' is no raw lag that this model reads"):
        Uniform({"y[k-1]": (-1, 1)}).points(support(na=1, used=(1,)))


# --- how far the data reach


def test_the_data_support_their_own_rows_wholly():
    assert TWO.share(Training().points(TWO)) == pytest.approx(1, abs=1e-12)


def test_the_data_support_a_box_beyond_them_in_part():
    """Evenly spaced data on ±0.9 reach twice their spacing beyond it."""
    even = support(u=np.linspace(-0.9, 0.9, 361))
    assert even.share(Uniform({"u[k]": (-3, 3)}).points(even)) == pytest.approx(
        (1.8 + 4 * 0.005) / 6, abs=1e-4
    )
    assert even.share(Uniform({"u[k]": (-0.9, 0.9)}).points(even)) == pytest.approx(1, abs=1e-12)


def test_support_is_reported_of_the_mirror_images_of_data_on_one_side():
    given = support(u=np.abs(U) + 1)
    assert given.share(Symmetrized().points(given)) == pytest.approx(0.5)


def test_support_counts_correlation_not_only_ranges():
    """Along a line in two coordinates the data reach a small part of their own box."""
    walk = support(nb=2, u=np.sin(2 * np.pi * 0.003 * np.arange(400)))
    assert walk.share(Uniform().points(walk)) < 0.2
    assert (
        support(nb=2).share(
            Uniform({"u[k]": (-0.3, 0.3), "u[k-1]": (-0.3, 0.3)}).points(support(nb=2))
        )
        > 0.95
    )


def test_lags_that_are_not_read_do_not_count_for_support():
    both = support(na=1, used=(1,))
    assert both.share(Uniform({"u[k]": (-0.5, 0.5)}).points(both)) == pytest.approx(1)


def test_the_first_row_is_the_largest_lag_of_the_whole_regressor():
    given = support(na=3, used=(0,))
    assert len(Training().points(given).x) == 400 - largest_lag(given.layout)
