"""Samples that are missing: left out on request with every window that touches them, and told; errors otherwise."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import unfolded
from test_cli import finite_json, one_line, run

from orthaug import Baseline, InputError, Term, estimate, load, read_record

PHYSICS = Baseline.from_terms([Term("a", "y[k-1]"), Term("b", "y[k-2]"), Term("g", "u[k-1]")])
GAPS = {
    8: "",
    20: "NaN",
    21: "NA",
    23: "",
    50: "null",
    60: "",
    61: "",
    62: "",
}  # of y; 22 and 24…49 stay
U_GAPS = {35: "", 70: "n/a"}
SPEC = """
[data]
sampling_time = 0.5
missing = "skip"
inputs = ["u"]
outputs = ["y"]
train = { files = ["run.csv"] }
[[baseline.terms]]
parameter = "a"
regressor = "y[k-1]"
[[baseline.terms]]
parameter = "b"
regressor = "y[k-2]"
[[baseline.terms]]
parameter = "g"
regressor = "u[k-1]"
[learner]
kind = "none"
"""


def signals(rows=100, seed=0):
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=rows).round(3), np.zeros(rows)
    for k in range(2, rows):
        y[k] = 1.2 * y[k - 1] - 0.5 * y[k - 2] + u[k - 1] + 0.1 * rng.normal()
    return u, y.round(4)


def write(path, y_cells=GAPS, u_cells=U_GAPS, rows=100, seed=0, time=None) -> Path:
    """A CSV of the signals with cells replaced; returns its path."""
    u, y = signals(rows, seed)
    lines = ["t,u,y" if time is not None else "u,y"]
    for k in range(rows):
        cells = [u_cells.get(k, u[k]), y_cells.get(k, y[k])]
        lines.append(
            ",".join(str(cell) for cell in ([time[k]] if time is not None else []) + cells)
        )
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def read(path, **options):
    return read_record(path, **{"inputs": ["u"], "outputs": ["y"], "missing": "skip", **options})


def windows(rows=range(100), gaps=(*GAPS, *U_GAPS), seed=0):
    """Naive: (φ, y, k) of every row whose samples at k, k−1 and k−2 of `rows` are all there."""
    u, y = signals(seed=seed)
    found = []
    for i, k in enumerate(rows):
        needed = rows[i - 2 : i + 1]
        if i >= 2 and not set(needed) & set(gaps):
            found.append(([y[needed[1]], y[needed[0]], u[needed[1]]], y[k], k))
    return [np.array(part) for part in zip(*found, strict=True)]


def long_enough(record):
    """The record without stretches that are too short for two lags."""
    return replace(record, experiments=tuple(e for e in record.experiments if len(e) > 2))


def rows_of(record):
    """φ and y of the usable rows, without stretches that are too short."""
    problem = estimate(long_enough(record), PHYSICS, learner=None).problem
    return np.asarray(problem.baseline.phi(problem.rows.x, problem.layout, ("y",), np))[
        :, 0
    ], problem.rows.y[:, 0]


# --- reading


@pytest.mark.parametrize(
    "options", [{}, {"rows": [5, 64]}, {"every": 2}, {"rows": [1, 90], "every": 3}], ids=str
)
def test_windows_that_touch_a_gap_are_left_out(tmp_path, options):
    phi, y = rows_of(read(write(tmp_path / "run.csv"), **options))
    begin, end = options.get("rows", (0, 100))
    expected = windows(range(begin, end, options.get("every", 1)))
    assert len(phi) == len(expected[0]) > 10
    np.testing.assert_array_equal(phi, expected[0])
    np.testing.assert_array_equal(y, expected[1])


def test_several_ranges_are_read_apart(tmp_path):
    phi, _ = rows_of(read(write(tmp_path / "run.csv"), rows=[[0, 30], [30, 55]]))
    expected = np.concatenate([windows(range(0, 30))[0], windows(range(30, 55))[0]])
    np.testing.assert_array_equal(phi, expected)


def test_theta_is_that_of_the_naive_rows(tmp_path):
    record = long_enough(read(write(tmp_path / "run.csv")))
    phi, y, _ = windows()
    expected = np.linalg.lstsq(phi, y, rcond=None)[0]
    np.testing.assert_allclose(estimate(record, PHYSICS, learner=None).theta, expected, rtol=1e-10)


def test_rows_that_are_left_out_are_counted_and_stretches_know_their_place(tmp_path):
    record = read(write(tmp_path / "run.csv"))
    assert record.missing == 10 and len(record) == 90
    assert [(e.first_row, len(e)) for e in record.experiments][:4] == [
        (0, 8),
        (9, 11),
        (22, 1),
        (24, 11),
    ]
    assert [e.offset for e in record.experiments][:3] == [0, 9, 22]
    assert record.experiments[1].where(0).endswith("run.csv: line 11 (row 9)")


def test_a_file_without_gaps_is_read_alike(tmp_path):
    path = write(tmp_path / "run.csv", {}, {})
    one, other = read(path), read(path, missing="error")
    assert one.missing == 0 and len(one.experiments) == 1
    np.testing.assert_array_equal(one.experiments[0].outputs, other.experiments[0].outputs)


@pytest.mark.parametrize("word", ["", " ", "NaN", "nan", "NA", "N/A", "n.v.", "null", "None", "-"])
def test_how_a_missing_sample_is_written(tmp_path, word):
    record = read(write(tmp_path / "run.csv", {5: word}, {}))
    assert [len(e) for e in record.experiments] == [5, 94]


@pytest.mark.parametrize("word", ["abc", "inf", "-inf", "1,5", "?"])
@pytest.mark.parametrize("missing", ["skip", "error"])
def test_other_text_is_refused_with_line_and_column(tmp_path, word, missing):
    path = write(tmp_path / "run.csv", {40: f'"{word}"'}, {})
    with pytest.raises(
        InputError,
        match=rf"run\.csv: line 42 \(row 40\), column 'y': found '{word}'".replace("?", "."),
    ):
        read(path, missing=missing)


def test_missing_cells_are_errors_by_default(tmp_path):
    path = write(tmp_path / "run.csv", u_cells={})
    with pytest.raises(
        InputError, match=r"line 10 \(row 8\), column 'y': the cell is empty; expected a finite"
    ):
        read_record(path, inputs=["u"], outputs=["y"])


def test_other_ways_are_unknown(tmp_path):
    with pytest.raises(InputError, match="`missing` must be one of error, skip, keep; got 'drop'"):
        read(write(tmp_path / "run.csv"), missing="drop")


def test_cells_that_are_not_read_do_not_matter(tmp_path):
    path = write(tmp_path / "run.csv", {5: "abc", 7: ""}, {})
    record = read(path, every=2)
    assert record.missing == 0 and len(record.experiments) == 1
    assert read(path, rows=[8, 30]).missing == 0


@pytest.mark.parametrize(
    "cells", [{0: "", 1: ""}, {98: "NaN", 99: "NaN"}, {98: "", 99: ""}], ids=str
)
def test_gaps_at_the_ends(tmp_path, cells):
    record = read(write(tmp_path / "run.csv", cells, {}))
    assert (record.missing, len(record), len(record.experiments)) == (2, 98, 1)
    assert record.experiments[0].first_row == (2 if 0 in cells else 0)


def test_a_range_of_missing_rows_only(tmp_path):
    with pytest.raises(
        InputError, match="every row from 60 to 62 has a missing cell; nothing is left"
    ):
        read(write(tmp_path / "run.csv"), rows=[60, 63])


@pytest.mark.parametrize("word", ["NaN", ""])
def test_a_column_without_a_sample_is_refused(tmp_path, word):
    path = write(tmp_path / "run.csv", dict.fromkeys(range(100), word), {})
    with pytest.raises(
        InputError, match=r"run\.csv: (every row|there are no data rows|column 'y'|.*missing)"
    ):
        read(path)


# --- a column of time


def test_time_goes_on_across_a_gap(tmp_path):
    record = read(write(tmp_path / "run.csv", time=np.round(0.1 * np.arange(100) + 3, 6)), time="t")
    assert record.sampling_time == pytest.approx(0.1)
    for experiment in record.experiments:
        assert experiment.start_time == pytest.approx(3 + 0.1 * experiment.first_row)


def test_a_time_that_is_missing_is_a_gap(tmp_path):
    time = [k if k != 40 else "" for k in range(100)]
    record = read(write(tmp_path / "run.csv", {}, {}, time=time), time="t")
    assert (record.missing, [len(e) for e in record.experiments]) == (1, [40, 59])


def test_single_rows_have_the_sampling_time_of_the_whole_column(tmp_path):
    time = [0.5 * k for k in range(100)]
    path = write(tmp_path / "run.csv", {k: "" for k in range(0, 100, 2)}, {}, time=time)
    record = read(path, time="t")
    assert (record.sampling_time, record.missing) == (0.5, 50)
    assert [len(e) for e in record.experiments] == [1] * 50
    late = [t + (k > 30) for k, t in enumerate(time)]
    path = write(tmp_path / "late.csv", {k: "" for k in range(0, 100, 2)}, {}, time=late)
    with pytest.raises(InputError, match="column 't': a step of 1.5 s where 0.5 s is usual"):
        read(path, time="t")
    path = write(tmp_path / "gap.csv", {k: "" for k in range(0, 100, 2)}, {}, time=["", *time[1:]])
    with pytest.raises(InputError, match="no two rows without missing cells follow each other"):
        read(path, time="t")


def test_stretches_of_another_step_are_refused(tmp_path):
    time = [k if k < 50 else 50 + 2 * (k - 50) for k in range(100)]
    with pytest.raises(
        InputError, match="column 't' steps by 1 s in one row range and by 2 s in another"
    ):
        read(write(tmp_path / "run.csv", {50: ""}, {}, time=time), time="t")


def test_npz(tmp_path):
    u, y = signals()
    y[[8, 20]] = np.nan
    np.savez(tmp_path / "run.npz", u=u, y=y)
    assert [len(e) for e in read(tmp_path / "run.npz").experiments] == [8, 11, 79]


# --- through the spec


pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")


@pytest.fixture
def project(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "run.csv")
    (tmp_path / "plant.toml").write_text(SPEC, encoding="utf-8")
    return tmp_path / "plant.toml"


def fit(spec) -> dict:
    done = run("fit", spec, "--out", "out", "--json")
    assert (done.code, done.err) == (0, "")
    return finite_json(done.out)


def test_the_fit_is_that_of_the_naive_rows(project):
    phi, y, _ = windows()
    theta = np.linalg.lstsq(phi, y, rcond=None)[0]
    result = fit(project)
    np.testing.assert_allclose([p["value"] for p in result["parameters"]], theta, rtol=1e-10)
    assert result["scores"]["train"]["prediction"]["rmse"][0] == pytest.approx(
        np.sqrt(np.mean((y - phi @ theta) ** 2))
    )
    assert result["scores"]["train"]["simulation"]["rmse"][0] > 0


def test_the_warning_counts_what_is_left_out(project):
    expected = (
        "train: 10 rows have missing cells and are left out with all windows that touch them; "
        f"{len(windows()[0])} "
    )
    (warning,) = [w["text"] for w in fit(project)["warnings"] if w["code"] == "missing_rows"]
    assert warning.startswith(expected + "usable rows remain, in 7 stretches")
    assert expected in unfolded(run("check", project).out)


@pytest.mark.parametrize("cells", [{30: ""}, {0: ""}], ids=str)
def test_the_warning_knows_the_singular(project, cells):
    write(project.parent / "run.csv", cells, {})
    (warning,) = [w["text"] for w in fit(project)["warnings"] if w["code"] == "missing_rows"]
    assert "1 row has" in warning and "1 stretches" not in warning


def test_the_default_is_an_error(project):
    write(project.parent / "run.csv", u_cells={})
    project.write_text(SPEC.replace('missing = "skip"\n', ""), encoding="utf-8")
    done = run("fit", project)
    assert (done.code, done.out) == (2, "")
    assert one_line(done.err, "error: ", "run.csv: line 10 (row 8), column 'y': the cell is empty")


def test_text_is_an_error(project):
    write(project.parent / "run.csv", {8: "", 30: "abc"})
    done = run("fit", project)
    assert done.code == 2
    assert one_line(done.err, "error: ", "run.csv: line 32 (row 30), column 'y': found 'abc'")


def test_an_unknown_way_is_an_error(project):
    project.write_text(SPEC.replace('"skip"', '"drop"'), encoding="utf-8")
    done = run("fit", project)
    assert done.code == 2 and one_line(
        done.err, "error: ", "'data.missing': found \"drop\"", "'error', 'skip' or 'keep'"
    )


def test_no_stretch_is_long_enough(project):
    write(project.parent / "run.csv", {k: "" for k in range(0, 100, 2)}, {})
    done = run("fit", project)
    assert done.code == 2 and one_line(done.err, "error: ", "run.csv", "too few", "the first 2")


TEST_PART = '[data.tests.other]\nfiles = ["other.csv"]\n{more}[[baseline.terms]]'


def with_test_part(project, more="") -> None:
    write(project.parent / "other.csv", seed=1)
    text = SPEC.replace("[[baseline.terms]]", TEST_PART.format(more=more), 1)
    project.write_text(text, encoding="utf-8")


@pytest.mark.parametrize("skip", [0, 5, 15, 40])
def test_a_test_part_is_scored_on_its_naive_rows(project, skip):
    """`skip` counts from the part's first row, also where that is in a later stretch."""
    with_test_part(project, f"skip = {skip}\n")
    result = fit(project)
    theta = np.array([p["value"] for p in result["parameters"]])
    phi, y, k = windows(seed=1)
    e = (y - phi @ theta)[k >= skip]
    assert result["scores"]["tests.other"]["prediction"]["rmse"][0] == pytest.approx(
        np.sqrt(np.mean(e**2))
    )
    assert any(
        w["text"].startswith("tests.other: 10 rows have missing cells") for w in result["warnings"]
    )


def test_the_free_run_of_a_test_part_starts_anew_after_a_gap(project):
    with_test_part(project)
    result = fit(project)
    theta = np.array([p["value"] for p in result["parameters"]])
    u, y = signals(seed=1)
    errors, lost = [], {*GAPS, *U_GAPS}
    for k in range(100):
        if {k, k - 1, k - 2} & lost or k < 2:
            past = None
            continue
        past = [y[k - 1], y[k - 2]] if past is None else past
        value = theta @ [*past, u[k - 1]]
        errors.append(value - y[k])
        past = [value, past[0]]
    rmse = result["scores"]["tests.other"]["simulation"]["rmse"][0]
    assert rmse == pytest.approx(np.sqrt(np.mean(np.square(errors))))


def test_rows_and_every_of_a_part(project):
    with_test_part(project, "rows = [10, 90]\n")
    text = project.read_text(encoding="utf-8")
    project.write_text(
        text.replace('["run.csv"] }', '["run.csv"], rows = [0, 64] }'), encoding="utf-8"
    )
    result = fit(project)
    counts = [len(windows(range(64))[0]), len(windows(range(10, 90))[0])]
    warnings = [w["text"] for w in result["warnings"] if w["code"] == "missing_rows"]
    assert [
        f"{count} usable rows remain" in text for count, text in zip(counts, warnings, strict=True)
    ] == [True, True]


def test_a_learner_on_the_free_run(project):
    """Trained in segments, none of which reaches across a gap."""
    learner = '[learner]\nhidden = [3]\n[training]\nfocus = "simulation"\nsegment = 16\nwashout = 2\niterations = 5\n'
    project.write_text(SPEC.replace('[learner]\nkind = "none"\n', learner), encoding="utf-8")
    result = fit(project)
    assert (
        result["status"]["code"] in ("converged", "iteration_limit")
        and result["orthogonality_defect"] < 1e-12
    )
    assert result["scores"]["train"]["simulation"]["nrmse"][0] < 1
    assert np.isfinite(load("out").theta).all()


def test_the_result_lists_what_the_file_holds(project):
    result = fit(project)
    assert json.loads(Path("out/result.json").read_text(encoding="utf-8")) == result
    assert result["data"]["train"][0]["rows"] == 90
