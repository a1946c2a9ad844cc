"""`orthaug track`: what it writes, going on from a state, and what it refuses with nothing written."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from test_cli import finite_json, listing, make_project, one_line, run, signals, write_csv

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A fit of physics alone, new data in two files, and a first run over one of them."""
    folder = tmp_path_factory.mktemp("track")
    spec = make_project(folder)
    assert run("fit", spec, "--out", folder / "fit").code == 0
    for name, seed in (("new", 5), ("later", 6)):
        u, y = signals(300, seed)
        write_csv(folder / f"{name}.csv", u=u, y=y)
    arguments = ("--data", folder / "new.csv", "--training", folder / "run.csv", "--memory", 20)
    done = run("track", folder / "fit", *arguments, "--out", folder / "first")
    assert done.code == 0, done.err
    return folder, done


def test_result_figure_table_and_state_are_written(project):
    folder, done = project
    names = listing(folder / "first")
    assert {
        "result.json",
        "report.txt",
        "table.csv",
        "figures/parameters.png",
        "state/recursive.json",
    } <= set(names)
    result = finite_json((folder / "first" / "result.json").read_text())
    table = pd.read_csv(folder / "first" / "table.csv")
    assert result["rows"] == 300 and result["alarms"] == [] and not result["alarmed"]
    assert result["memory"] == pytest.approx(20) and 0 < result["forgetting"] < 1
    for row in result["parameters"]:
        assert row["value"] == pytest.approx(table[row["name"]].iloc[-1], rel=1e-9)
        assert row["ci95"][0] < row["value"] < row["ci95"][1]
    text = (folder / "first" / "report.txt").read_text()
    assert done.out.startswith(text) and "alarm       none" in text and "memory      20 s" in text


def test_a_later_run_goes_on_from_the_state(project, tmp_path):
    folder, _ = project
    step = ("--data", folder / "later.csv")
    done = run(
        "track",
        folder / "fit",
        *step,
        "--state",
        folder / "first",
        "--out",
        tmp_path / "second",
        "--json",
    )
    assert done.code == 0 and done.err == ""
    both = ("--data", folder / "new.csv", *step, "--training", folder / "run.csv", "--memory", 20)
    assert run("track", folder / "fit", *both, "--out", tmp_path / "both").code == 0
    second, whole = (
        finite_json(done.out),
        finite_json((tmp_path / "both" / "result.json").read_text()),
    )
    assert second["rows"] == whole["rows"] == 600
    for one, other in zip(second["parameters"], whole["parameters"], strict=True):
        assert one["value"] == pytest.approx(other["value"], rel=1e-12)
        assert one["std"] == pytest.approx(other["std"], rel=1e-9)


def test_a_changed_system_raises_the_alarm(project, tmp_path):
    folder, _ = project
    u, y = signals(300, 8)
    write_csv(
        tmp_path / "changed.csv",
        u=u,
        y=y + np.where(np.arange(300) < 200, 0.0, 3 * y.std() * np.sin(np.arange(300))),
    )
    data = ("--data", tmp_path / "changed.csv", "--training", folder / "run.csv")
    done = run("track", folder / "fit", *data, "--out", tmp_path / "out")
    assert done.code == 0 and "the residual left its band at" in done.out
    (alarm, *_) = finite_json((tmp_path / "out" / "result.json").read_text())["alarms"]
    assert 200 <= alarm["row"] < 230


def test_rows_with_missing_samples_count(project, tmp_path):
    folder, _ = project
    u, y = signals(300, 8)
    y = y + np.where(np.arange(300) < 200, 0.0, 3 * y.std() * np.sin(np.arange(300)))
    missing = (np.arange(300) < 4) | ((np.arange(300) >= 50) & (np.arange(300) < 130))
    write_csv(tmp_path / "holes.csv", u=u, y=np.where(missing, np.nan, y))
    data = ("--data", tmp_path / "holes.csv", "--training", folder / "run.csv")
    done = run("track", folder / "fit", *data, "--out", tmp_path / "out")
    assert done.code == 0, done.err
    result = finite_json((tmp_path / "out" / "result.json").read_text())
    assert result["rows"] == 300
    assert 200 <= result["alarms"][0]["row"] < 230
    rows = pd.read_csv(tmp_path / "out" / "table.csv")["row"]
    assert not set(rows) & set(np.flatnonzero(missing)) and {49, 299} <= set(rows)
    lost = (
        "holes.csv: 84 rows have missing cells and are left out with all windows that touch them; "
        "212 usable rows remain, in 2 stretches."
    )
    assert lost in " ".join(done.err.split())
    for command in (("split", folder / "fit"), ("linearize", folder / "fit", "--data")):
        assert lost in " ".join(run(*command, tmp_path / "holes.csv").err.split())


def test_rows_missing_at_the_end_of_a_file_count_before_the_next_one(project, tmp_path):
    folder, _ = project
    u, y = signals(300, 8)
    y[290:] = np.nan
    write_csv(tmp_path / "ends.csv", u=u, y=y)
    first = ("--data", tmp_path / "ends.csv", "--training", folder / "run.csv")
    later = ("--data", folder / "later.csv", "--state", tmp_path / "one", "--follows")
    for arguments, name in ((first, "one"), (later, "two")):
        done = run("track", folder / "fit", *arguments, "--out", tmp_path / name, "--json")
        assert done.code == 0, done.err
    assert finite_json((tmp_path / "one" / "result.json").read_text())["rows"] == 300
    assert finite_json(done.out)["rows"] == 600
    # Nothing reads across the missing rows: the first lags of the next file are history only
    rows = set(pd.read_csv(tmp_path / "two" / "table.csv")["row"])
    assert not rows & {*range(290, 302)} and {289, 302} <= rows


REFUSED = [
    ((), ("--training: is missing",)),
    (("--training", "run.csv", "--state", "first"), ("--training: found beside --state",)),
    (("--state", "fit"), ("no saved recursive estimate there",)),
    (("--state", "first", "--memory", "3"), ("--forgetting, --memory: found beside --state",)),
    (
        ("--training", "steps.csv"),
        ("is not the least-squares estimate of these", "Give the training data"),
    ),
    (
        ("--training", "run.csv", "--forgetting", "1.5"),
        ("`forgetting` must lie between 0.3 and 1; got 1.5",),
    ),
    (
        ("--training", "run.csv", "--forgetting", "0.9", "--memory", "3"),
        ("give `forgetting` or `memory`, not both",),
    ),
    (("--training", "nothing.csv"), ("nothing.csv",)),
    (("--training", "run.csv", "--out", "fit"), ("holds fit, which is read; give another folder",)),
]


@pytest.mark.parametrize(("options", "words"), REFUSED, ids=range(len(REFUSED)))
def test_bad_input_is_one_line_and_nothing_is_written(
    project, tmp_path, monkeypatch, options, words
):
    folder, _ = project
    monkeypatch.chdir(folder)
    before = listing(folder)
    done = run(
        "track",
        "fit",
        "--data",
        "new.csv",
        *(() if "--out" in options else ("--out", tmp_path / "out")),
        *options,
    )
    assert done.code == 2 and one_line(done.err, *words)
    assert listing(folder) == before and not (tmp_path / "out").exists()


def test_new_data_are_needed_and_checked(project, tmp_path):
    folder, _ = project
    done = run("track", folder / "fit", "--training", folder / "run.csv", "--out", tmp_path / "out")
    assert done.code == 2 and one_line(
        done.err, "--data: is missing; give at least one file of new data"
    )
    (tmp_path / "half.csv").write_text("u\n1\n2\n")
    data = ("--data", tmp_path / "half.csv", "--training", folder / "run.csv")
    done = run("track", folder / "fit", *data, "--out", tmp_path / "out")
    assert done.code == 2 and one_line(done.err, "half.csv", "y")
    assert not (tmp_path / "out").exists()
