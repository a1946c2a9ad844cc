"""Records from files: rows, ranges, sampling time, and cells that are no numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from orthaug import Channel, InputError, open_parquet, read_record
from orthaug._base.errors import MissingSampleError

CONTENT = "t,u,y\n" + "".join(f"{k / 10},{k},{10 * k}\n" for k in range(10))


def put(folder: Path, content: str = CONTENT, name: str = "run.csv") -> Path:
    path = folder / name
    path.write_bytes(content.encode())
    return path


def read(path: Path, **options):
    return read_record(path, **{"inputs": ["u"], "outputs": ["y"], **options})


def test_one_experiment_of_all_rows(tmp_path):
    path = put(tmp_path)
    record = read(path, sampling_time=0.1)
    assert repr(record) == "Record(1 experiment, 10 samples, Ts = 0.1 s, inputs: u; outputs: y)"
    experiment = record.experiments[0]
    np.testing.assert_array_equal(experiment.inputs, np.arange(10.0)[:, None])
    np.testing.assert_array_equal(experiment.outputs, 10 * np.arange(10.0)[:, None])
    assert (experiment.source, experiment.first_row) == (str(path), 0)


def test_the_path_may_be_text_and_the_sampling_time_one(tmp_path):
    assert read(str(put(tmp_path))).sampling_time == 1.0


@pytest.mark.parametrize("rows", [[2, 5], (2, 5), [np.int64(2), np.int64(5)], [[2, 5]]])
def test_rows_are_half_open(tmp_path, rows):
    record = read(put(tmp_path), rows=rows)
    assert record.experiments[0].inputs[:, 0].tolist() == [2, 3, 4]
    assert record.experiments[0].first_row == 2


def test_several_ranges_are_experiments_of_their_own(tmp_path):
    record = read(put(tmp_path), rows=[[0, 3], [7, 10]])
    assert [e.inputs[:, 0].tolist() for e in record.experiments] == [[0, 1, 2], [7, 8, 9]]
    assert [e.first_row for e in record.experiments] == [0, 7]


def test_ranges_may_touch_and_come_in_any_order(tmp_path):
    record = read(put(tmp_path), rows=[[5, 8], [0, 5]])
    assert [e.inputs[0, 0] for e in record.experiments] == [5, 0]


def test_experiments_know_their_lines_and_instants(tmp_path):
    """Every n-th row of a range still names the file's own line, and starts at the file's own instant."""
    path = put(tmp_path, "\n" + CONTENT)
    first, second = read(path, rows=[[1, 4], [6, 10]], every=2, time="t").experiments
    assert (first.first_row, first.stride, first.first_line, first.start_time) == (1, 2, 3, 0.1)
    assert first.where(1) == f"{path}: line 6 (row 3)"
    assert second.where(1) == f"{path}: line 11 (row 8)"
    assert (second.start_time, path.read_text().splitlines()[10]) == (0.6, "0.8,8,80")


def test_every_keeps_one_row_in_n_and_multiplies_the_sampling_time(tmp_path):
    record = read(put(tmp_path), every=4, rows=[1, 10], sampling_time=0.1)
    assert record.experiments[0].outputs[:, 0].tolist() == [10, 50, 90]
    assert record.sampling_time == pytest.approx(0.4)


def test_another_column_for_a_channel_in_this_file(tmp_path):
    path = put(tmp_path, "uEst,yVal\n1,2\n3,4\n")
    record = read_record(
        path, inputs=[Channel("u", column="uEst")], outputs=["y"], columns={"y": "yVal"}
    )
    assert record.experiments[0].outputs[:, 0].tolist() == [2, 4]
    override = read_record(path, outputs=[Channel("y", column="uEst")], columns={"y": "yVal"})
    assert override.experiments[0].outputs[:, 0].tolist() == [2, 4]


def test_two_channels_of_one_column(tmp_path):
    record = read(
        put(tmp_path),
        outputs=["y"],
        inputs=[Channel("a", column="u"), Channel("b", column="u", scale=2)],
    )
    np.testing.assert_array_equal(record.experiments[0].inputs[:3], [[0, 0], [1, 2], [2, 4]])


def test_scale_and_offset(tmp_path):
    record = read(put(tmp_path), outputs=[Channel("y", "m", scale=0.001, offset=-1.0)])
    np.testing.assert_allclose(
        record.experiments[0].outputs[:, 0], 0.01 * np.arange(10) - 1, rtol=0, atol=1e-15
    )
    assert record.outputs[0].unit == "m"


def test_without_inputs_and_without_outputs(tmp_path):
    path = put(tmp_path)
    autonomous = read(path, inputs=[], rows=[[0, 4], [4, 6]], every=2)
    assert [e.inputs.shape for e in autonomous.experiments] == [(2, 0), (1, 0)]
    assert read(path, outputs=[]).experiments[0].outputs.shape == (10, 0)


def test_the_time_column_gives_the_sampling_time(tmp_path):
    path = put(tmp_path)
    assert read(path, time="t").sampling_time == pytest.approx(0.1)
    assert read(path, time="t", every=3).sampling_time == pytest.approx(0.3)
    assert read(path, time="t", rows=[[0, 4], [6, 10]]).sampling_time == pytest.approx(0.1)


def test_a_jittering_time_column_is_fine(tmp_path):
    instants = np.arange(50) * 0.1 + np.random.default_rng(0).uniform(-0.01, 0.01, 50)
    path = put(tmp_path, "t,u,y\n" + "".join(f"{t},1,2\n" for t in instants))
    assert read(path, time="t").sampling_time == pytest.approx(0.1, rel=0.01)


def test_other_file_types(tmp_path):
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    u, y = np.arange(4.0), np.arange(8.0).reshape(4, 2)
    np.savez(tmp_path / "run.npz", u=u[None], Y=y)
    record = read(tmp_path / "run.npz", outputs=[Channel("y", column="Y[1]")], rows=[1, 3])
    assert record.experiments[0].outputs[:, 0].tolist() == [3, 5]
    pandas.DataFrame({"u": u, "y": y[:, 0]}).to_parquet(tmp_path / "run.parquet")
    assert read(tmp_path / "run.parquet").experiments[0].outputs[:, 0].tolist() == [0, 2, 4, 6]
    put(tmp_path, "u\ty\n1\t2\n", "run.tsv")
    assert len(read(tmp_path / "run.tsv")) == 1


CELLS = [
    "abc",
    "NaN",
    "nan",
    "inf",
    "-inf",
    "NA",
    "null",
    "None",
    "0x10",
    "1 000",
    "True",
    "1e400",
    "--",
    "#N/A",
]


@pytest.mark.parametrize("cell", CELLS)
def test_a_cell_that_is_no_finite_number(tmp_path, cell):
    path = put(tmp_path, f"u,y\n1,2\n3,4\n5,{cell}\n7,8\n")
    with pytest.raises(
        InputError, match=rf"line 4 \(row 2\), column 'y': found '{cell}'; expected a finite number"
    ):
        read(path)
    assert len(read(path, rows=[0, 2])) == 2
    assert len(read(path, outputs=[])) == 4


@pytest.mark.parametrize(
    ("cell", "remedy"),
    [("Bad", "empty it where its sample is missing.$"), ("ON", "Write 0 and 1")],
)
def test_a_cell_of_words_is_refused_with_a_remedy(tmp_path, cell, remedy):
    with pytest.raises(InputError, match=f"found '{cell}'; .*{remedy}"):
        read(put(tmp_path, f"u,y\n1,2\n3,4\n5,{cell}\n7,8\n"))


def test_instants_in_milliseconds_since_1970_name_the_header_that_reads_them(tmp_path):
    rows = "".join(f"{1709294100000 + 1000 * k},{k % 3},{k % 5}\n" for k in range(20))
    path = put(tmp_path, f"stamp,u,y\n{rows}")
    with pytest.raises(InputError, match=r"the unit in the header, such as 'stamp \[ms\]'"):
        read(path, time="stamp", sampling_time=None)
    path = put(tmp_path, f"stamp [ms],u,y\n{rows}", "other.csv")
    assert read(path, time="stamp [ms]", sampling_time=None).sampling_time == 1


def test_an_empty_cell(tmp_path):
    for cells in (",6", '"",6', "  ,6"):
        with pytest.raises(
            InputError, match=r"run.csv: line 3 \(row 1\), column 'u': the cell is empty"
        ):
            read(put(tmp_path, f"u,y\n1,2\n{cells}\n5,6\n"))


def test_a_blank_line_among_the_rows_is_a_row_of_empty_cells(tmp_path):
    with pytest.raises(InputError, match=r"line 3 \(row 1\), column 'u': the cell is empty"):
        read(put(tmp_path, "u,y\n1,2\n\n5,6\n"))


def test_lines_are_the_file_s_own_also_behind_blank_ones(tmp_path):
    with pytest.raises(InputError, match=r"line 6 \(row 2\), column 'y': found 'x'"):
        read(put(tmp_path, "\r\n\r\nu,y\r\n1,2\r\n3,4\r\n5,x\r\n"))


def test_a_decimal_comma_cell_that_is_no_number(tmp_path):
    with pytest.raises(InputError, match=r"line 3 \(row 1\), column 'y': found '1.234,5'"):
        read(put(tmp_path, "u;y\n1,5;2\n3;1.234,5\n"))


def test_cells_of_binary_files_name_the_row(tmp_path):
    np.savez(tmp_path / "run.npz", u=[1.0, 2.0], y=[np.nan, 1.0])
    with pytest.raises(InputError, match="run.npz: row 0, column 'y': found 'nan'"):
        read(tmp_path / "run.npz")


def test_a_bad_cell_of_the_time_column(tmp_path):
    with pytest.raises(InputError, match=r"line 3 \(row 1\), column 't': found 'noon'"):
        read(put(tmp_path, "t,u,y\n0,1,2\nnoon,1,2\n2,1,2\n"), time="t")


@pytest.mark.parametrize("content", ["u,y\n1,2\n3,4\n5,\n", "u,y,z\n1,2,\n3,4,\n5,,1\n,,1\n"])
def test_used_columns_of_unequal_length(tmp_path, content):
    """In a table they end with empty cells, which rows may leave out; variables are refused."""
    wanted = (
        r"run.csv: line 4 \(row 2\), column 'y': the cell is empty, and so are all below it; 'u' "
        "goes on to row 2; expected a finite number."
    )
    with pytest.raises(MissingSampleError, match=wanted):
        read(put(tmp_path, content))
    assert len(read(put(tmp_path, content), rows=[0, 2])) == 2
    np.savez(tmp_path / "run.npz", u=np.ones(3), y=np.ones(2))
    with pytest.raises(InputError, match="unequal lengths: 'u' 3, 'y' 2 rows"):
        read(tmp_path / "run.npz")


@pytest.mark.parametrize("content", ["u,y\n", "u,y", "u,y\n\n\n", "u,y\n,\n", "\nu,y\n"])
def test_a_file_without_data_rows(tmp_path, content):
    with pytest.raises(InputError, match="run.csv: there are no data rows"):
        read(put(tmp_path, content))


ROWS = [
    ([0, 11], r"rows \[0, 11\] reaches past the end; the file has 10 data rows"),
    ([[0, 2], [9, 12]], r"rows \[9, 12\] reaches past the end"),
    ([10, 12], "reaches past the end"),
    ([5, 2], r"rows \[5, 2\] is not a half-open range \[start, stop\] with 0 ≤ start < stop"),
    ([3, 3], r"rows \[3, 3\] is not a half-open range"),
    ([-3, 5], r"rows \[-3, 5\] is not a half-open range"),
    ([1, 2, 3], r"rows \[1, 2, 3\] is not a half-open range"),
    ([4], r"rows \[4\] is not a half-open range"),
    ([], r"rows \[\] is not a half-open range"),
    ([[0, 5], [4, 8]], r"the row ranges \[0, 5\] and \[4, 8\] overlap; samples would count twice"),
    ([[6, 9], [0, 3], [2, 4]], r"the row ranges \[0, 3\] and \[2, 4\] overlap"),
    ([[0, 5], [0, 5]], r"the row ranges \[0, 5\] and \[0, 5\] overlap"),
]


@pytest.mark.parametrize(("rows", "message"), ROWS)
def test_refused_rows(tmp_path, rows, message):
    with pytest.raises(InputError, match=f"run.csv: .*{message}"):
        read(put(tmp_path), rows=rows)


TIMES = [
    (
        "0 0.1 0.2 0.5 0.6 0.7",
        r"line 5 \(row 3\), column 't': a step of 0.3 s .* expected evenly sampled, rising time",
    ),
    ("0.3 0.2 0.1 0.0", r"line 3 \(row 1\), column 't': a step of -0.1 s"),
    ("0 0 0", "a step of 0 s"),
    ("0 0.1 0.2 0.1 0.4 0.5", r"line 5 \(row 3\), column 't': a step of -0.1 s"),
    (
        "1.7e18 1.700000001e18 1.700000002e18",
        "instants of 1.7e.18 are not seconds; perhaps they are milli- or nano",
    ),
    ("0", "one row is too few for a sampling time from column 't'"),
]


@pytest.mark.parametrize(("instants", "message"), TIMES)
def test_refused_times(tmp_path, instants, message):
    path = put(tmp_path, "t,u,y\n" + "".join(f"{t},1,2\n" for t in instants.split()))
    with pytest.raises(InputError, match=f"run.csv: .*{message}"):
        read(path, time="t")


def test_ranges_of_different_sampling_time(tmp_path):
    path = put(tmp_path, "t,u,y\n" + "".join(f"{t},1,2\n" for t in (0, 0.1, 0.2, 1.0, 1.2, 1.4)))
    with pytest.raises(
        InputError,
        match="run.csv: column 't' steps by 0.1 s in one row range and by 0.2 s in another",
    ):
        read(path, time="t", rows=[[0, 3], [3, 6]])


REFUSED = [
    ({"sampling_time": 0.1, "time": "t"}, "give `sampling_time` or `time`, not both"),
    (
        {"sampling_time": 0.0},
        r"sampling time must be a positive number of seconds, at most 1e\+12; got 0.0",
    ),
    ({"sampling_time": -1.0}, "sampling time must be a positive number"),
    ({"time": "time"}, "no column 'time'"),
    ({"every": 0}, "`every` must be a whole number, 1 or more; got 0"),
    ({"every": -2}, "`every` must be a whole number"),
    ({"every": 1.5}, "`every` must be a whole number, 1 or more; got 1.5"),
    ({"every": True}, "`every` must be a whole number"),
    ({"inputs": [], "outputs": []}, "no channels are asked for; name inputs, outputs or both"),
    ({"inputs": ["y"]}, "channel 'y' is given twice; names must differ"),
    ({"inputs": ["force"]}, "no column 'force'; the file has 't', 'u', 'y'"),
    ({"columns": {"y": "yy"}}, "no column 'yy', did you mean 'y'"),
    ({"inputs": ["F (N)"]}, r"'F \(N\)' cannot name a channel"),
]


@pytest.mark.parametrize(("options", "message"), REFUSED, ids=range(len(REFUSED)))
def test_refused(tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        read(put(tmp_path), **options)


def test_refused_files(tmp_path):
    with pytest.raises(InputError, match="absent.csv: no such file"):
        read(tmp_path / "absent.csv")
    with pytest.raises(InputError, match="unknown file type '.log'"):
        read(put(tmp_path, name="run.log"))


def test_a_sampling_time_that_every_thins_twice(tmp_path):
    path = tmp_path / "run.txt"
    np.savetxt(path, np.column_stack([0.01 * np.arange(60), np.ones(60), np.arange(60) % 7]))
    options = {"inputs": ["x2"], "outputs": ["x3"], "every": 5}
    with pytest.raises(
        InputError,
        match=r"run.txt: every = 5 multiplies the sampling time 0.05 s to 0.25 s. But .* 'x1'",
    ):
        read_record(path, sampling_time=0.05, **options)
    assert read_record(path, sampling_time=0.01, **options).sampling_time == pytest.approx(0.05)
    assert read_record(path, time="x1", **options).sampling_time == pytest.approx(0.05)


def minutes(*instants: str) -> str:
    return "when,u,y\n" + "".join(f"{instant},{k},2\n" for k, instant in enumerate(instants))


DATES = [
    (("2024-03-01 12:00:00", "2024-03-01 12:00:01", "2024-03-01 12:00:02"), 1.0),
    (("2024-03-01T23:59:59.750", "2024-03-02T00:00:00", "2024-03-02T00:00:00.250"), 0.25),
    (("2024-03-01T12:00:00+01:00", "2024-03-01T11:00:02Z", "2024-03-01T11:00:04Z"), 2.0),
    (
        ("29.02.2024 23:59:58", "29.02.2024 23:59:59", "01.03.2024 00:00:00"),
        1.0,
    ),  # the day comes first
    (("01.03.2024 00:00", "02.03.2024 00:00", "03.03.2024 00:00"), 86400.0),
    (("12/31/2024 23:59:59.5", "12/31/2024 23:59:59.75", "01/01/2025 00:00:00"), 0.25),
    (("03/04/2024 10:00:00", "03/04/2024 10:00:01", "03/04/2024 10:00:02"), 1.0),  # either way
    (("12:00:00.5", "12:00:01.5", "12:00:02.5"), 1.0),
    (("2025-01-02 11:59:59 AM", "2025-01-02 12:00:00 PM", "2025-01-02 12:00:01 PM"), 1.0),
    (("01/13/2025 11:59:59 AM", "01/13/2025 12:00:00 PM", "01/13/2025 12:00:01 PM"), 1.0),
    (("2025-01-02 11:59 PM", "2025-01-03 12:00 AM", "2025-01-03 12:01 AM"), 60.0),
    (("2025-01-02 11:59:59.5 PM", "2025-01-02 11:59:59.75 PM", "2025-01-03 12:00:00.0 AM"), 0.25),
]


@pytest.mark.parametrize(("instants", "step"), DATES)
def test_dates_are_seconds_since_the_first_row(tmp_path, instants, step):
    (tmp_path / "run.csv").write_text(minutes(*instants))
    record = read_record(tmp_path / "run.csv", inputs=["u"], outputs=["y"], time="when")
    assert record.sampling_time == step
    later = read_record(tmp_path / "run.csv", inputs=["u"], outputs=["y"], time="when", rows=[1, 3])
    assert later.experiments[0].start_time == step


@pytest.mark.parametrize(
    ("instants", "message"),
    [
        (
            ("04/03/2024 10:00", "04/04/2024 10:00", "04/05/2024 10:00"),
            "'04/03/2024 10:00' may begin with the day",
        ),
        (("noon", "one", "two"), "line 2 .*'when': found 'noon'; expected a finite number"),
        (
            ("2024-03-01 12:00",) * 5 + ("-",) + ("2024-03-01 12:00",) * 5,
            r"line 7 \(row 5\), column 'when': found '-'; expected a date, as in other cells",
        ),
        (("2024-03-01", "2024-03-02", "2024-03-04"), "a step of 172800 s where 86400 s is usual"),
    ],
)
def test_dates_that_are_refused(tmp_path, instants, message):
    (tmp_path / "run.csv").write_text(minutes(*instants))
    with pytest.raises(InputError, match=message):
        read_record(tmp_path / "run.csv", inputs=["u"], outputs=["y"], time="when")


def test_dates_beside_decimal_commas_and_in_other_files(tmp_path):
    pandas = pytest.importorskip("pandas")
    options = {"inputs": ["u"], "outputs": ["y"], "time": "when"}
    lines = [f"01.03.2024 12:00:00,{k}00;{k},5;2\n" for k in range(4)]
    (tmp_path / "run.csv").write_text("when;u;y\n" + "".join(lines))
    assert read_record(tmp_path / "run.csv", **options).sampling_time == pytest.approx(0.1)
    frame = pandas.DataFrame(
        {"when": pandas.date_range("2024-03-01", periods=4, freq="20ms"), "u": 1.0, "y": 2.0}
    )
    for ending, write in (("parquet", frame.to_parquet), ("xlsx", frame.to_excel)):
        write(tmp_path / f"run.{ending}", index=False)
        record = read_record(tmp_path / f"run.{ending}", **options)
        assert (
            record.sampling_time == pytest.approx(0.02) and record.experiments[0].start_time == 0.0
        )
    source = open_parquet([tmp_path / "run.parquet"], **options)
    assert source.sampling_time == pytest.approx(0.02) and source.window(1, 3)[
        0
    ].start_time == pytest.approx(0.02)


UNITS = [("t [ms]", 20.0, 0.02), ("Zeit (us)", 20.0, 2e-5), ("time_ms", 1.0, 1e-3), ("t [min]", 0.5, 30.0),
         ("t_h", 2.0, 7200.0), ("t [s]", 0.1, 0.1), ("t", 0.1, 0.1), ("k [rows]", 3.0, 3.0)]  # fmt: skip


@pytest.mark.parametrize(("header", "every", "step"), UNITS)
def test_the_header_says_the_unit_of_the_time(tmp_path, header, every, step):
    rows = "".join(f"{k * every:g},{k},2\n" for k in range(5))
    (tmp_path / "run.csv").write_text(f"{header},u,y\n{rows}")
    record = read_record(
        tmp_path / "run.csv", inputs=["u"], outputs=["y"], time=header, rows=[1, 5]
    )
    assert record.sampling_time == pytest.approx(step, rel=1e-12)
    assert record.experiments[0].start_time == pytest.approx(step, rel=1e-12)
    pandas = pytest.importorskip("pandas")
    pandas.read_csv(tmp_path / "run.csv").to_parquet(tmp_path / "run.parquet")
    source = open_parquet([tmp_path / "run.parquet"], inputs=["u"], outputs=["y"], time=header)
    assert source.sampling_time == pytest.approx(step, rel=1e-12)
