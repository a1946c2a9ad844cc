"""Records: what is kept of arrays, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from orthaug import Channel, Experiment, InputError, Record
from orthaug.data.record import same_step

STEPS = np.arange(6.0)


def test_from_arrays():
    record = Record.from_arrays(u=STEPS, y=np.stack([STEPS, -STEPS], axis=1), sampling_time=0.5)
    assert [c.name for c in record.inputs] == ["u"]
    assert [c.name for c in record.outputs] == ["y1", "y2"]
    assert [c.name for c in record.channels] == ["y1", "y2", "u"]
    assert record.experiments[0].inputs.shape == (6, 1)
    assert record.experiments[0].outputs.shape == (6, 2)
    assert len(record) == 6


def test_names_and_units():
    record = Record.from_arrays(STEPS, STEPS, inputs=[Channel("force", "N")], outputs=["position"])
    assert record.inputs[0].label == "force [N]"
    assert record.outputs[0].label == "position"
    assert (
        repr(record)
        == "Record(1 experiment, 6 samples, Ts = 1 s, inputs: force; outputs: position)"
    )


def test_without_inputs_or_without_outputs():
    autonomous = Record.from_arrays(y=STEPS)
    assert autonomous.experiments[0].inputs.shape == (6, 0)
    assert "inputs: none; outputs: y" in repr(autonomous)
    to_simulate = Record.from_arrays(u=STEPS)
    assert to_simulate.experiments[0].outputs.shape == (6, 0)


def test_arrays_are_copied_and_made_float():
    y = np.arange(4)
    record = Record.from_arrays(y=y)
    y[0] = 100
    np.testing.assert_array_equal(record.experiments[0].outputs[:, 0], [0.0, 1.0, 2.0, 3.0])
    assert record.experiments[0].outputs.dtype == float


def test_rows_and_split():
    record = Record.from_arrays(y=STEPS, source="run.csv")
    part = record.rows(2, 5)
    np.testing.assert_array_equal(part.experiments[0].outputs[:, 0], [2, 3, 4])
    assert part.experiments[0].source == "run.csv"
    assert part.experiments[0].first_row == 2
    assert part.rows(1).experiments[0].first_row == 3
    first, rest = record.split(0.5)
    assert (len(first), len(rest)) == (3, 3)
    assert rest.experiments[0].first_row == 3
    timed = Record.from_arrays(y=STEPS, sampling_time=0.1).split(0.5)[1].rows(1)
    assert timed.experiments[0].start_time == pytest.approx(0.4)


def test_slices():
    record = Record.from_arrays(u=-STEPS, y=STEPS, sampling_time=0.1, source="run.csv")
    for part, rows in (
        (record[2:5], [2, 3, 4]),
        (record[:2], [0, 1]),
        (record[-2:], [4, 5]),
        (record[1:99], STEPS[1:]),
    ):
        np.testing.assert_array_equal(part.experiments[0].outputs[:, 0], rows)
        np.testing.assert_array_equal(part.experiments[0].inputs[:, 0], -np.asarray(rows))
        assert part.experiments[0].where(0) == f"run.csv: row {rows[0]:g}"
        assert part.experiments[0].start_time == pytest.approx(0.1 * rows[0])
    assert record[np.int64(1) : -1 : 1][1:].experiments[0].first_row == 2
    assert len(record[:]) == 6


def test_a_slice_of_several_experiments_keeps_them_apart():
    joined = Record.join(Record.from_arrays(y=np.arange(n), source=str(n)) for n in (10, 20, 5))
    for part, lengths in (
        (joined[5:32], [5, 20, 2]),
        (joined[10:30], [20]),
        (joined[-7:], [2, 5]),
        (joined[:3], [3]),
    ):
        assert [len(e) for e in part.experiments] == lengths
    assert (
        joined[5:32].experiments[0].first_row == 5
        and joined[-7:].experiments[0].where(0) == "20: row 18"
    )


NO_SLICES = [
    (
        slice(None, None, 5),
        r"record\[start:stop:5\]: a step would leave out rows .* with `every`, or take `prepare",
    ),
    (slice(None, None, -1), "a step would leave out rows"),
    (slice(4, 2), r"record\[4:2\] holds no row; the record has 6"),
    (slice(6, None), r"record\[6:\] holds no row; the record has 6"),
    (slice(0.5, 2), "`the range of rows` must be record.start:stop. with whole numbers"),
    (3, r"cut by a range of rows, such as record\[100:500\]; got record\[3\]"),
    ("y", r"cut by a range of rows, such as record\[100:500\]; got record\['y'\]"),
]


@pytest.mark.parametrize(("rows", "message"), NO_SLICES, ids=range(len(NO_SLICES)))
def test_what_is_no_slice(rows, message):
    with pytest.raises(InputError, match=message):
        Record.from_arrays(y=STEPS)[rows]


def test_a_record_is_not_iterated_by_rows():
    with pytest.raises(TypeError, match="not iterable"):
        list(Record.from_arrays(y=STEPS))  # type: ignore[arg-type]


def test_several_experiments_are_split_each_or_as_a_whole():
    joined = Record.join(Record.from_arrays(y=np.arange(n), source=str(n)) for n in (10, 20, 5))
    first, rest = joined.split(0.8)
    assert [len(e) for e in first.experiments] == [8, 16, 4] and [
        len(e) for e in rest.experiments
    ] == [2, 4, 1]
    np.testing.assert_array_equal(rest.experiments[1].outputs[:, 0], [16, 17, 18, 19])
    first, rest = joined.split(2 / 3, by="experiments")
    assert [e.source for e in first.experiments] == ["10", "20"] and [
        e.source for e in rest.experiments
    ] == ["5"]
    with pytest.raises(
        InputError, match="the split at 0.09 would be empty: an experiment has 5 rows"
    ):
        joined.split(0.09)
    with pytest.raises(InputError, match="would be empty: there are 3 experiments"):
        joined.split(0.1, by="experiments")
    with pytest.raises(InputError, match="`by` must be one of rows, experiments; got 'files'"):
        joined.split(0.5, by="files")


def test_join_keeps_experiments_apart():
    record = Record.join(
        Record.from_arrays(y=STEPS, sampling_time=0.1, source=str(i)) for i in range(3)
    )
    assert [e.source for e in record.experiments] == ["0", "1", "2"]
    assert len(record) == 18
    assert repr(record).startswith("Record(3 experiments, 18 samples, Ts = 0.1 s")
    with pytest.raises(InputError, match="`rows` needs a record of one experiment; this one has 3"):
        record.rows(0, 1)


def test_join_refuses_what_does_not_fit():
    record = Record.from_arrays(y=STEPS)
    with pytest.raises(
        InputError, match=r"other channels cannot be joined: .*outputs: y\).*outputs: z\)"
    ):
        Record.join([record, Record.from_arrays(y=STEPS, outputs=["z"])])
    with pytest.raises(
        InputError, match="a record: sampled every 2 s, another every 1 s; resample one of them"
    ):
        Record.join([record, Record.from_arrays(y=STEPS, sampling_time=2.0)])
    with pytest.raises(InputError, match="at least one"):
        Record.join([])


@pytest.mark.parametrize("fraction", [0.0, 1.0, -0.5, float("nan")])
def test_split_fraction(fraction):
    with pytest.raises(InputError, match="`fraction` must lie between 0 and 1"):
        Record.from_arrays(y=STEPS).split(fraction)


REFUSED = [
    ({}, "needs `u`, `y` or both; got neither"),
    (
        {"u": STEPS[1:], "y": STEPS},
        "`y` has 6 rows but `u` has 5. Give both the same length, or drop the last rows",
    ),
    (
        {"y": [1.0, float("nan")]},
        "`y` is not finite at row 1, channel 0: found nan. Remove the row or split",
    ),
    ({"u": [[1.0, 2.0], [3.0, float("inf")]]}, "`u` is not finite at row 1, channel 1: found inf"),
    ({"y": ["a", "b"]}, "`y` is not an array of numbers: could not convert"),
    ({"y": [[1.0], [2.0, 3.0]]}, "`y` is not an array of numbers"),
    ({"y": [1j, 2.0]}, "`y` is complex; expected real numbers"),
    ({"y": np.zeros((2, 2, 2))}, r"`y` has 3 axes; expected \(samples,\) or \(samples, channels\)"),
    ({"y": 1.0}, "`y` has 0 axes"),
    (
        {"y": STEPS, "sampling_time": 0.0},
        r"sampling time must be a positive number of seconds, at most 1e\+12; got 0.0",
    ),
    ({"y": STEPS, "sampling_time": -1.0}, "sampling time must be a positive number"),
    ({"y": STEPS, "sampling_time": float("nan")}, "sampling time must be a positive number"),
    ({"y": STEPS, "sampling_time": 1.1e12}, r"at most 1e\+12; got 1.1e\+?12|got 1100000000000.0"),
    ({"y": STEPS, "outputs": ["time"]}, "an output cannot be called 'time': results have a column"),
    (
        {"y": np.stack([STEPS, STEPS], 1), "outputs": ["X", "X_model"]},
        "an output cannot be called 'X_model': results have a column of that name",
    ),
    (
        {"y": np.stack([STEPS, STEPS], 1), "outputs": ["X_learner", "X"]},
        "an output cannot be called 'X_learner'",
    ),
    (
        {"y": np.stack([STEPS, STEPS], 1), "outputs": ["X_baseline", "X"]},
        "an output cannot be called 'X_baseline'",
    ),
    (
        {"y": STEPS, "outputs": ["a", "b"]},
        "2 names for 1 channels of `y`; give one name for each column",
    ),
    (
        {"u": STEPS, "y": STEPS, "inputs": ["a"], "outputs": ["a"]},
        "channel 'a' is given twice; names must differ",
    ),
    (
        {"y": STEPS, "outputs": ["position (mm)"]},
        r"'position \(mm\)' cannot name a channel",
    ),
    ({"y": STEPS, "outputs": ["2nd"]}, "'2nd' cannot name a channel"),
    ({"y": STEPS, "outputs": [""]}, "'' cannot name a channel"),
    ({"y": STEPS, "outputs": ["k"]}, "'k' cannot name a channel"),
    ({"y": STEPS, "outputs": ["sin"]}, "'sin' cannot name a channel"),
    # expressions cannot use these: a word of Python's own, and the micro sign, which Python reads as the Greek letter
    ({"y": STEPS, "outputs": ["in"]}, "'in' cannot name a channel"),
    ({"y": STEPS, "outputs": ["\N{MICRO SIGN}"]}, "'\N{MICRO SIGN}' cannot name a channel"),
]


@pytest.mark.parametrize(("arguments", "message"), REFUSED, ids=range(len(REFUSED)))
def test_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        Record.from_arrays(**arguments)


def test_a_record_needs_an_experiment():
    with pytest.raises(InputError, match="at least one experiment; got none"):
        Record((), (Channel("y"),), 1.0, ())


def test_experiment_length():
    assert len(Experiment(np.zeros((3, 0)), np.zeros((3, 1)))) == 3


def test_sampling_times_are_compared_to_a_thousandth():
    assert same_step(0.1, 0.10009) and same_step(1e-6, 1.0009e-6)
    assert not same_step(0.1, 0.1002) and not same_step(1e-9, 1.1e-9)
    joined = Record.join([Record.from_arrays(y=STEPS, sampling_time=t) for t in (0.1, 0.10005)])
    assert (joined.sampling_time, len(joined.experiments)) == (0.1, 2)
    with pytest.raises(
        InputError, match="b.csv: sampled every 0.1002 s, a.csv every 0.1 s; resample one of them"
    ):
        Record.join(
            Record.from_arrays(y=STEPS, sampling_time=t, source=s)
            for t, s in ((0.1, "a.csv"), (0.1002, "b.csv"))
        )


def test_names_that_only_look_like_columns_of_results_are_fine():
    """`y_model` beside no output `y`, and inputs, whose columns results do not repeat."""
    record = Record.from_arrays(u=STEPS, y=STEPS, inputs=["time"], outputs=["y_model"])
    assert [c.name for c in record.channels] == ["y_model", "time"]


def test_where_a_row_came_from():
    nothing, full = np.zeros((9, 0)), np.arange(9.0)[:, None]
    assert Experiment(nothing, full).where(3) == "row 3"
    assert Experiment(nothing, full, "run.csv", first_row=10).where(3) == "run.csv: row 13"
    assert Experiment(nothing, full, "run.csv", 10, 4, 2).where(3) == "run.csv: line 24 (row 22)"
    part = Experiment(nothing, full, "run.csv", 10, 4, 2).rows(2, None)
    assert (part.first_row, part.where(1)) == (18, "run.csv: line 24 (row 22)")


def test_exchanged_axes_are_named():
    u, y = np.arange(500.0), np.arange(500.0)
    with pytest.raises(InputError, match=r"`u` has 1 row and 500 columns; rows are samples"):
        Record.from_arrays(u[None], y[None])
    with pytest.raises(InputError, match=r"`y` has 2 rows and 250 columns.*Give y\.T\."):
        Record.from_arrays(None, y.reshape(2, 250))
    assert len(Record.from_arrays(None, np.ones((25, 24)))) == 25
