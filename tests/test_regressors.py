"""Regressors: order of lags, rows of each experiment, features and their scaling."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthaug import InputError, Lags, Record
from orthaug.data.expressions import Lag, parse
from orthaug.data.regressors import Features, in_order, lag_matrix, largest_lag, stack_rows
from orthaug.models.learners import Scaling


def names(layout) -> list[str]:
    return [str(lag) for lag in layout]


@pytest.mark.parametrize(
    ("lags", "expected"),
    [
        (Lags(na=2, nb=1, nk=1), "y[k-1] y[k-2] u[k-1]"),
        (Lags(na=1, nb=3, nk=0), "y[k-1] u[k] u[k-1] u[k-2]"),
        (Lags(na=0, nb=2, nk=5), "u[k-5] u[k-6]"),
        (Lags(na=2), "y[k-1] y[k-2]"),
        (Lags(na=1, nb=1), "y[k-1] u[k-1]"),
        (Lags(), ""),
    ],
)
def test_matlab_order(lags, expected):
    assert names(lags.layout(["y"], ["u"])) == expected.split()


def test_orders_per_channel():
    layout = Lags(na=[2, 0], nb=[1, 2], nk=[0, 3]).layout(["a", "b"], ["u", "v"])
    assert names(layout) == ["a[k-1]", "a[k-2]", "u[k]", "v[k-3]", "v[k-4]"]
    layout = Lags(na=1, nb=1, nk=2).layout(["a", "b"], ["u", "v"])
    assert names(layout) == ["a[k-1]", "b[k-1]", "u[k-2]", "v[k-2]"]
    assert names(Lags(na=2, nb=4, nk=1).layout(["y"], [])) == ["y[k-1]", "y[k-2]"]


def test_orders_may_be_numpy_integers():
    assert names(Lags(na=np.int64(1), nb=np.array([2]), nk=0).layout(["y"], ["u"])) == [
        "y[k-1]",
        "u[k]",
        "u[k-1]",
    ]


@pytest.mark.parametrize(
    ("lags", "message"),
    [
        (Lags(na=-1), "`na` must be whole numbers, 0 or more; got -1"),
        (Lags(nb=[1, -2]), r"`nb` must be whole numbers, 0 or more; got \[1, -2\]"),
        (Lags(na=True), "`na` must be whole numbers"),
        (Lags(nk=[0.5, 1]), "`nk` must be whole numbers"),
        (Lags(na=2.0), "`na` must be whole numbers"),
        (
            Lags(na=[1, 2]),
            "`na` has 2 numbers for 1 output; give one number, or one per output",
        ),
        (
            Lags(nk=[1]),
            "`nk` has 1 number for 2 inputs; give one number, or one per input",
        ),
    ],
)
def test_orders_refused(lags, message):
    with pytest.raises(InputError, match=message):
        lags.layout(["y"], ["u", "v"])


def test_in_order():
    lags = [Lag("u", 2), Lag("u", 0), Lag("y", 2), Lag("y", 1), Lag("u", 2)]
    assert names(in_order(lags, ["y"], ["u"])) == ["y[k-1]", "y[k-2]", "u[k]", "u[k-2]"]
    assert largest_lag(in_order(lags, ["y"], ["u"])) == 2
    assert largest_lag(()) == 0


def test_in_order_refuses():
    with pytest.raises(
        InputError, match=r"'w\[k-1\]' uses the unknown channel 'w'; known are y, u"
    ):
        in_order([Lag("w", 1)], ["y"], ["u"])
    with pytest.raises(
        InputError, match=r"'y\[k\]' is the output .* outputs are used from lag 1, y\[k-1\]"
    ):
        in_order([Lag("y", 0)], ["y"], ["u"])


CHANNELS = ("a", "b", "u", "v")


@given(
    st.lists(st.integers(5, 12), min_size=1, max_size=3),
    st.lists(st.builds(Lag, st.sampled_from(CHANNELS), st.integers(1, 4)), max_size=6, unique=True),
    st.integers(0, 2**32 - 1),
)
def test_lag_matrix_is_a_double_loop(lengths, lags, seed):
    draw = np.random.default_rng(seed)
    pieces = [{name: draw.normal(size=n) for name in CHANNELS} for n in lengths]
    record = Record.join(
        Record.from_arrays(
            u=np.stack([p["u"], p["v"]], 1),
            y=np.stack([p["a"], p["b"]], 1),
            inputs=["u", "v"],
            outputs=["a", "b"],
        )
        for p in pieces
    )
    layout = in_order(lags, ["a", "b"], ["u", "v"])
    rows = stack_rows(record, layout)
    start = max([lag.lag for lag in lags], default=0)
    expected = [
        [piece[lag.channel][k - lag.lag] for lag in layout]
        for piece in pieces
        for k in range(start, len(piece["a"]))
    ]
    outputs = [
        [piece["a"][k], piece["b"][k]] for piece in pieces for k in range(start, len(piece["a"]))
    ]
    assert rows.start == start and len(rows) == len(expected)
    np.testing.assert_array_equal(rows.x, np.array(expected).reshape(len(expected), len(layout)))
    np.testing.assert_array_equal(rows.y, outputs)


def test_never_across_experiments():
    record = Record.join(
        [Record.from_arrays(y=[1.0, 2.0, 3.0]), Record.from_arrays(y=[10.0, 20.0, 30.0])]
    )
    rows = stack_rows(record, (Lag("y", 2),))
    np.testing.assert_array_equal(rows.x[:, 0], [1.0, 10.0])
    np.testing.assert_array_equal(rows.y[:, 0], [3.0, 30.0])


def test_later_start():
    record = Record.from_arrays(y=np.arange(6.0))
    matrix = lag_matrix(record.experiments[0], (Lag("y", 1), Lag("y", 2)), record, 4)
    np.testing.assert_array_equal(matrix, [[3.0, 2.0], [4.0, 3.0]])


def test_too_few_rows():
    with pytest.raises(
        InputError,
        match="run.csv has 2 rows, too few: the largest lag is 2, so at least 3 are needed",
    ):
        stack_rows(Record.from_arrays(y=[1.0, 2.0], source="run.csv"), (Lag("y", 2),))
    record = Record.join([Record.from_arrays(y=np.arange(9.0)), Record.from_arrays(y=[1.0])])
    with pytest.raises(InputError, match="experiment 1 has 1 row, too few"):
        stack_rows(record, (Lag("y", 1),))
    assert len(stack_rows(Record.from_arrays(y=[1.0, 2.0, 3.0]), (Lag("y", 2),))) == 1


@pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "jax"])
def test_features(xp):
    layout = (Lag("y", 1), Lag("u", 0))
    features = Features((parse("u[k]"), parse("y[k-1]*u[k]"), parse("1"), parse("c", {"c": 2.0})))
    assert features.lags == (Lag("u", 0), Lag("y", 1))
    x = xp.asarray([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    expected = [[2.0, 2.0, 1.0, 2.0], [4.0, 12.0, 1.0, 2.0], [6.0, 30.0, 1.0, 2.0]]
    np.testing.assert_array_equal(features.evaluate(x, layout, xp), expected)
    np.testing.assert_array_equal(features.evaluate(x[1], layout, xp), expected[1])
    assert Features(()).evaluate(x, layout, xp).shape == (3, 0)
    np.testing.assert_array_equal(Features.of(layout).evaluate(x, layout, xp), x)
    assert Features.of(layout).lags == layout


@given(st.integers(0, 2**32 - 1), st.integers(2, 20))
def test_scaling_maps_the_training_data_onto_the_unit_box(seed, rows):
    draw = np.random.default_rng(seed)
    features = draw.normal(size=(rows, 3)) * 10.0 ** draw.integers(-3, 4, 3) + draw.normal(size=3)
    scaled = Scaling.fit(features)(features)
    np.testing.assert_allclose(scaled.min(axis=0), -1.0, atol=1e-11)
    np.testing.assert_allclose(scaled.max(axis=0), 1.0, atol=1e-11)


def test_scaling_leaves_a_feature_that_never_moves_in_its_unit():
    scaling = Scaling.fit(np.array([[7.0, 0.0], [7.0, 4.0]]))
    np.testing.assert_array_equal(
        scaling(np.array([[7.0, 2.0], [8.0, 6.0]])), [[0.0, 0.0], [1.0, 2.0]]
    )
