"""`orthaug init`: what stands in a file is seen, and the spec that is written runs."""

from __future__ import annotations

import io
import json
import re
import sys
import tomllib

import numpy as np
import pandas as pd
import pytest
import scipy.io
import scipy.signal
from helpers import unfolded
from test_cli import run
from test_closed_loop import vessel
from test_first_orders import crane

import orthaug as oa
from orthaug import load_spec
from orthaug.commands import cli
from orthaug.commands import init as commands_init
from orthaug.commands.init import as_seen
from orthaug.data.headers import header_with_unit
from orthaug.data.survey import channel_name, split_header, survey
from orthaug.data.tables import read_titles
from orthaug.selection import first_orders

pytestmark = pytest.mark.usefixtures("without_figures")


def plant(rows: int = 600) -> tuple[np.ndarray, np.ndarray]:
    """y_k = 1.5 y_{k-1} − 0.7 y_{k-2} + 0.4 u_{k-3}, with noise on the sensor."""
    rng = np.random.default_rng(4)
    u = rng.normal(size=rows)
    return u, scipy.signal.lfilter([0, 0, 0, 0.4], [1, -1.5, 0.7], u) + 1e-3 * rng.normal(size=rows)


@pytest.fixture
def csv(tmp_path):
    u, y = plant()
    frame = pd.DataFrame(
        {"time [ms]": 10.0 * np.arange(len(u)), "force [N]": np.clip(u, -1.5, 1.5)}
    )
    frame["force [N]"] = u.clip(-1.5, None)
    frame["position_mm"], frame["gain"], frame["note"] = y, 2.0, "ok"
    frame.loc[40:43, "position_mm"] = np.nan
    path = tmp_path / "run 1.csv"
    frame.to_csv(path, index=False)
    return path


@pytest.mark.parametrize(
    ("header", "parts"),
    [
        ("force [N]", ("force", "N")),
        ("force (N)", ("force", "N")),
        ("force_N", ("force", "N")),
        ("speed_rad_s", ("speed", "rad/s")),
        ("U[2]", ("U[2]", "")),
        ("U[2,:]", ("U[2,:]", "")),
        ("grade [1]", ("grade", "1")),
        ("grade[1]", ("grade[1]", "")),
        ("force [2]", ("force [2]", "")),
        ("motor_left", ("motor_left", "")),
        ("[N]", ("[N]", "")),
    ],
)
def test_units_of_headers(header, parts):
    assert split_header(header) == parts


def test_names_of_channels_are_identifiers():
    texts = ["Kraft 1", "2nd", "sin", "lambda", "time", "Ts", "U[2]", "…", "Kraft-1"]
    names: list[str] = []
    for text in texts:
        names.append(channel_name(text, names))
    assert names == [
        "Kraft_1",
        "x2nd",
        "sin_",
        "lambda_",
        "time_",
        "Ts_",
        "U_2",
        "channel",
        "Kraft_1_2",
    ]


def test_columns_of_every_kind_of_file(tmp_path):
    frame = pd.DataFrame({"u": np.arange(4.0), "y": np.ones(4)})
    frame.to_parquet(tmp_path / "a.parquet")
    frame.to_excel(tmp_path / "a.xlsx", index=False)
    (tmp_path / "a.csv").write_text("u;y;\n1,5;2;\n")
    assert [read_titles(tmp_path / f"a.{end}").names for end in ("parquet", "xlsx", "csv")] == [
        ["u", "y"]
    ] * 3
    wide = {
        "U": np.ones((9, 2)),
        "W": np.ones((2, 9)),
        "v": np.ones(9),
        "one": 3.0,
        "cube": np.ones((2, 2, 2)),
    }
    np.savez(tmp_path / "a.npz", **wide)
    assert read_titles(tmp_path / "a.npz").names == ["U[0]", "U[1]", "W[0,:]", "W[1,:]", "v"]
    scipy.io.savemat(tmp_path / "a.mat", {"data": {"u": np.ones(5)}, "v": np.ones(9), "name": "x"})
    assert read_titles(tmp_path / "a.mat").names == ["data.u", "v"]


def test_a_file_is_seen_and_its_spec_runs(csv, tmp_path):
    out = tmp_path / "spec.toml"
    done = run("init", csv, "--inputs", "force", "--outputs", "position_mm", "--out", out)
    assert done.code == 0, done.err
    for told in (
        "sampling time: 0.01 s, from column 'time [ms]'",
        "rows at -1.5, perhaps a limit",
        "position = column 'position_mm'",
        "4 cells missing",
        "left out: gain (constant)",
        "left out: note (no numbers)",
        "significant at lag 3",
        "na 2, nb 1, nk 3",
        "test: rows 450 to 600",
    ):
        assert told in done.out, told
    assert "rows at 1.5" not in done.out
    spec = tomllib.loads(out.read_text())
    assert spec["data"]["missing"] == "skip" and spec["data"]["time"] == "time [ms]"
    assert spec["data"]["channels"]["position"] == {"column": "position_mm", "unit": "mm"}
    assert [t["regressor"] for t in spec["baseline"]["terms"]] == [
        "position[k-1]",
        "position[k-2]",
        "force[k-3]",
    ]
    assert run("check", out).code == 0
    assert run("init", csv, "--inputs", "force", "--outputs", "position", "--out", out).code == 2
    assert (
        run("init", csv, "--inputs", "force", "--outputs", "position", "--out", out, "--force").code
        == 0
    )


REFUSED = [
    (("--inputs", "force"), "Give both"),
    (
        ("--inputs", "force", "--outputs", "speed"),
        "no column 'speed'; the file has time [ms], force [N]",
    ),
    (
        ("--inputs", "gain", "--outputs", "position"),
        "column 'gain' is 2 in every row; leave it out",
    ),
    (
        ("--inputs", "note", "--outputs", "position"),
        "column 'note' cannot be a channel: no numbers",
    ),
    (("--inputs", "force", "--outputs", "force_,force"), "no column 'force_'"),
    (("--inputs", "force", "--outputs", "force [N]"), "'force [N]' is named twice"),
    (("--inputs", "time [ms]", "--outputs", "position"), "is the time; it is no channel"),
    (("--inputs", "force", "--outputs", ","), "no output is named"),
    (
        ("--inputs", "force", "--outputs", "position", "--sampling-time", "0"),
        "the sampling time must be a positive",
    ),
]


@pytest.mark.parametrize(("options", "message"), REFUSED, ids=range(len(REFUSED)))
def test_what_cannot_be_written_is_said(csv, tmp_path, monkeypatch, options, message):
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    done = run("init", csv, *options, "--out", tmp_path / "spec.toml")
    assert done.code == 2 and message in done.err
    assert not (tmp_path / "spec.toml").exists()


def test_on_a_terminal_it_asks(tmp_path, monkeypatch):
    u, y = plant(300)
    pd.DataFrame({"force": u, "position": y}).to_csv(tmp_path / "a.csv", index=False)
    terminal = io.StringIO("force\nposition\n0.02\n")
    terminal.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setattr(sys, "stdin", terminal)
    done = run("init", tmp_path / "a.csv", "--out", tmp_path / "spec.toml")
    assert done.code == 0, done.err
    assert "columns: force, position" in done.err and "0.02 s, as given" in done.out


def test_names_that_say_it_are_enough_and_few_rows_are_refused(tmp_path):
    u, y = plant(300)
    pd.DataFrame({"t": 0.5 * np.arange(300), "u": u, "y": y}).to_csv(
        tmp_path / "a.csv", index=False
    )
    assert run("init", tmp_path / "a.csv", "--out", tmp_path / "spec.toml").code == 0
    data = tomllib.loads((tmp_path / "spec.toml").read_text())["data"]
    assert (data["time"], data["inputs"], data["outputs"]) == ("t", ["u"], ["y"])
    pd.DataFrame({"u": u[:3], "y": y[:3]}).to_csv(tmp_path / "b.csv", index=False)
    done = run("init", tmp_path / "b.csv", "--out", tmp_path / "b.toml")
    assert (
        done.code == 2
        and "3 usable rows are too few" in done.err
        and not (tmp_path / "b.toml").exists()
    )


def test_one_wrong_sample_of_a_signal_that_moves_fast_is_seen_and_replaced(tmp_path):
    u, y = np.random.default_rng(2).normal(size=600), np.sin(np.arange(600) / 1.5)
    pd.DataFrame({"u": u, "y": y}).to_csv(tmp_path / "a.csv", index=False)
    assert survey(tmp_path / "a.csv").find("y").spikes == 0
    y[350] += 2.5 * np.ptp(y)
    pd.DataFrame({"u": u, "y": y}).to_csv(tmp_path / "a.csv", index=False)
    done = run(
        "init", tmp_path / "a.csv", "--sampling-time", "0.1", "--out", tmp_path / "spec.toml"
    )
    assert (
        done.code == 0 and "; 1 sample far from all neighbours, which the spec replaces" in done.out
    )
    job = load_spec(tmp_path / "spec.toml")
    assert job.train.record.prepared[0].samples == 1


@pytest.mark.parametrize("held", [1, 20])
def test_a_delay_is_seen_where_the_response_sets_in_slowly(tmp_path, held):
    """An inertia, sampled often: the response grows from nothing at lag 4; the cross-correlation sees it far later."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.normal(size=2000 // held), held)
    y = scipy.signal.lfilter([0, 0, 0, 0, 0.002], [1, -1.98, 0.985], u) + 1e-4 * rng.normal(
        size=2000
    )
    pd.DataFrame({"u": u, "y": y}).to_csv(tmp_path / "a.csv", index=False)
    done = run(
        "init", tmp_path / "a.csv", "--sampling-time", "0.01", "--out", tmp_path / "spec.toml"
    )
    assert "it is first significant at lag 4" in done.out and ", nk 4;" in done.out


def test_the_turning_points_of_an_encoder_are_no_limit(tmp_path):
    t = np.arange(4000.0)
    counts = np.round(600 * np.sin(0.004 * t) * np.exp(-t / 4000))
    clipped = np.clip(counts, None, counts.max() - 100)
    frame = pd.DataFrame(
        {"counts": counts, "clipped": clipped, "both": np.tile(counts[:1500], 3)[:4000]}
    )
    frame.to_csv(tmp_path / "a.csv", index=False)
    found = survey(tmp_path / "a.csv")
    assert np.sum(counts == counts.max()) >= 6
    assert found.find("counts").limits == () and found.find("both").limits == ()
    assert found.find("clipped").limits == ((clipped.max(), int(np.sum(clipped == clipped.max()))),)


def test_all_nights_are_rows_without_sun(tmp_path):
    """They are longer than the days, so that the row as far before a night is in the last one."""
    t = np.arange(2000)
    day = 800 + 100 * np.sin(t)
    sun = np.round(np.maximum(0, -day * (np.sin(2 * np.pi * t / 100) + 0.1)), 2)
    pd.DataFrame({"sun": sun}).to_csv(tmp_path / "a.csv", index=False)
    assert survey(tmp_path / "a.csv").find("sun").limits == ((0.0, int(np.sum(sun == 0))),)


@pytest.mark.parametrize("decimals", [2, 4, None])
def test_the_rounding_of_a_slow_sine_excites_nothing(decimals):
    u = 20 + 4 * np.sin(2 * np.pi * np.arange(1500) / 287)
    u = u if decimals is None else np.round(u, decimals)
    y = scipy.signal.lfilter([0, 0.2], [1, -0.8], u)
    record = oa.Record.from_arrays(u, y + 0.01 * np.random.default_rng(0).normal(size=1500))
    assert first_orders.first_model(record).persistence[0] <= 3


def test_what_is_seen_of_a_column(tmp_path):
    rng = np.random.default_rng(0)
    square, coarse = np.sign(rng.normal(size=400)), np.round(rng.normal(size=400), 1)
    frame = pd.DataFrame(
        {"t": np.arange(400.0) + (np.arange(400) > 200), "square": square, "coarse": coarse}
    )
    frame.to_csv(tmp_path / "a.csv", index=False)
    found = survey(tmp_path / "a.csv")
    assert not found.clock.even and found.clock.step == 1.0 and "uneven" in str(found.clock)
    held = np.repeat(rng.normal(size=40), 10)
    pd.DataFrame({"held": np.convolve(held, [0.5, 0.5], "same")}).to_csv(
        tmp_path / "b.csv", index=False
    )
    assert (
        survey(tmp_path / "b.csv").find("held").limits == ()
    )  # an input between its steps is at no limit
    assert found.find("square").limits == () and found.find("square").quantum is None
    assert found.find("coarse").quantum == pytest.approx(0.1)
    # An encoder: fine beside the range, coarse beside a sample
    slow = 100 * np.sin(np.arange(4000) / 400)
    noisy = np.round(slow + 2 * rng.normal(size=4000))
    frame = pd.DataFrame({"encoder": np.round(slow), "fine": np.round(slow, 2), "noisy": noisy})
    frame.to_csv(tmp_path / "c.csv", index=False)
    assert [survey(tmp_path / "c.csv").find(name).quantum for name in frame] == [1.0, None, None]
    assert as_seen(survey(tmp_path / "c.csv").find("encoder"), spikes=False).endswith(
        "; in steps of 1, while it moves by 0.16 from row to row"
    )


def test_uneven_instants_are_resampled(tmp_path):
    u, y = plant(300)
    t = 0.1 * np.arange(300.0)
    t[200:] += 0.06
    y[77] += 50.0
    pd.DataFrame({"t": t, "u": u, "y": y}).to_csv(tmp_path / "a.csv", index=False)
    done = run("init", tmp_path / "a.csv", "--out", tmp_path / "spec.toml")
    assert done.code == 0 and "but the steps are uneven" in done.out, done.err
    data = tomllib.loads((tmp_path / "spec.toml").read_text())["data"]
    assert [step["step"] for step in data["prepare"]] == ["outliers", "fill", "resample"] and data[
        "time"
    ] == "t"
    assert (
        data["prepare"][-1]["sampling_time"] == 0.1
        and "1 sample far from all neighbours" in done.out
    )


def test_an_output_without_inputs_and_level_gets_its_own_past(tmp_path):
    y = scipy.signal.lfilter([1.0], [1, -1.5, 0.8], np.random.default_rng(0).normal(size=400))
    pd.DataFrame({"y": y - y.mean()}).to_csv(tmp_path / "a.csv", index=False)
    done = run(
        "init",
        tmp_path / "a.csv",
        "--inputs",
        "",
        "--outputs",
        "y",
        "--out",
        tmp_path / "spec.toml",
    )
    assert done.code == 0 and 'regressor = "y[k-2]"' in (tmp_path / "spec.toml").read_text(), (
        done.err
    )


def test_columns_of_one_name_are_distinguished(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    u, y = plant(300)
    rows = "".join(f"{a},{b},{c}\n" for a, b, c in zip(u, y, np.roll(u, 7), strict=True))
    (tmp_path / "a.csv").write_text("y,T [K],T [K]\n" + rows)
    out = tmp_path / "spec.toml"
    done = run("init", tmp_path / "a.csv", "--inputs", "y", "--outputs", "T [K]", "--out", out)
    assert (
        done.code == 2
        and "several columns are called 'T [K]'; from the left: T [K].0, T [K].1" in done.err
    )
    assert (
        run("init", tmp_path / "a.csv", "--inputs", "y", "--outputs", "T [K].0", "--out", out).code
        == 0
    )
    assert tomllib.loads(out.read_text())["data"]["channels"] == {
        "T_0": {"column": "T [K].0", "unit": "K"}
    }


NOTHING = [
    ("u,y\n1,2\n", (), "no column can be a channel, 1 row: u (constant), y (constant). A first model needs"),
    ("u,y\n1,\n2,\n3,\n", (), "only u varies, so there is no pair of an input and an output. No channels: "
     "y (no numbers)."),
    ("u,y\n1,\n2,\n3,\n", ("--inputs", "u"), "already an input (u), so no column is left for an output; left out: y (no"),
    ("a,b,c\n1,2,4\n2,1,7\n", ("--outputs", "b"), "only outputs are named: a, b, c. Give both, "
                                                  'separated by commas, such as --inputs "a,c" '
                                                  '--outputs "b" (--inputs "" for none)'),
    ("a,b,c\n1,2,4\n2,1,7\n", ("--inputs", "c"), '--inputs "c" --outputs "b"; columns'),
    ("a,b,c\n1,2,4\n2,1,7\n", ("--inputs", "A"), "no column 'A', did you mean 'a'?"),
    ("-1.5,2\n1,2\n2,3\n", (), "which outputs: x1, x2. Give both, separated by commas, such as "
                               '--inputs "x1"'),
    ("bench 3, May\nu\nnone\n", (), "expected one for each signal, under a header. The names that were found are "
     "'bench 3, May'; a line above the header must begin with #"),
]  # fmt: skip


@pytest.mark.parametrize(("content", "options", "message"), NOTHING, ids=range(len(NOTHING)))
def test_a_proposal_respects_what_was_given_and_is_never_empty(
    tmp_path, monkeypatch, content, options, message
):
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    (tmp_path / "a.csv").write_text(content)
    done = run("init", tmp_path / "a.csv", *options, "--out", tmp_path / "spec.toml")
    assert done.code == 2 and message in " ".join(done.err.split()), done.err


def test_an_encoding_that_was_guessed_is_reported(tmp_path):
    u, y = plant(300)
    rows = "".join(f"{a},{b}\n" for a, b in zip(u, y, strict=True))
    (tmp_path / "a.csv").write_bytes(("u,y [µm]\n" + rows).encode("cp1252"))
    done = run("init", tmp_path / "a.csv", "--out", tmp_path / "spec.toml")
    assert (
        done.code == 0
        and "a.csv: 300 rows, 2 columns; not UTF-8, so read as Windows-1252" in done.out
    )
    warning = "line 1 of a.csv is no UTF-8, so the file is read as Windows-1252; save it as UTF-8."
    assert warning in unfolded(run("check", tmp_path / "spec.toml").out)
    done = run("fit", tmp_path / "spec.toml", "--out", tmp_path / "out", "--json")
    warnings = [
        w["text"] for w in json.loads(done.out)["warnings"] if w["code"] == "encoding_guessed"
    ]
    assert warnings[0] == f"train: {warning}"


def test_a_damaged_byte_in_a_column_that_is_not_used_is_reported_with_its_line(tmp_path):
    """Found by the fuzzer (.tsv, seed 110): the file was read as Windows-1252 without a word."""
    u, y = plant(300)
    rows = "".join(f"{a},{b},n{i}\n" for i, (a, b) in enumerate(zip(u, y, strict=True))).encode()
    (tmp_path / "a.csv").write_bytes(b"u,y,note\n" + rows.replace(b"n7\n", b"n7\x7f\xff\n"))
    spec = '[data]\nsampling_time = 0.1\ninputs = ["u"]\noutputs = ["y"]\ntrain = { files = ["a.csv"] }\n'
    (tmp_path / "spec.toml").write_text(
        spec + '[baseline]\nterms = [{ parameter = "b", regressor = "u[k-1]" }]\n'
    )
    done = run("check", tmp_path / "spec.toml")
    assert done.code == 0 and "line 9 of a.csv is no UTF-8" in unfolded(done.out)


def test_on_a_terminal_it_asks_again(tmp_path, monkeypatch):
    u, y = plant(300)
    pd.DataFrame({"force": u, "position": y}).to_csv(tmp_path / "a.csv", index=False)
    terminal = io.StringIO("Forze\nforce\nforce\nposition\n0.02\n")
    terminal.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setattr(sys, "stdin", terminal)
    done = run("init", tmp_path / "a.csv", "--out", tmp_path / "spec.toml")
    assert done.code == 0, done.err
    assert (
        "no column 'Forze', did you mean 'force'?" in done.err
        and "'force' is named twice" in done.err
    )


def batches(path, header: str = "") -> None:
    """Ten batches of a slow first-order system, each from cold, with its own time."""
    rng, rows = np.random.default_rng(5), []
    for batch in range(1, 11):
        x = 15.0
        for k in range(90):
            u = rng.uniform(20, 80) if k % 15 == 0 else u
            x = 0.97 * x + 0.03 * u
            rows.append((batch, 30 * k, u, x + 0.05 * rng.normal()))
    frame = pd.DataFrame(rows, columns=["Batch", header or "t", "valve", "temp"])
    (frame if header else frame.drop(columns="t")).to_csv(path, index=False)


def test_the_error_of_the_first_physics_is_of_runs_within_experiments(tmp_path):
    batches(tmp_path / "run.csv")
    spec = tmp_path / "spec.toml"
    done = run(
        "init", tmp_path / "run.csv", "--inputs", "valve", "--outputs", "temp", "--out", spec
    )
    output = unfolded(done.out)
    assert "Batch numbers 10 experiments" in output
    error = re.search(r"error in free run is ([\d.]+) %", output)
    assert error is not None and float(error[1]) < 5


@pytest.mark.parametrize("header", ["time [s]", "Time in batch [s]", "Zeit seit Beginn [s]"])
def test_a_time_that_begins_anew_gives_the_step_and_is_not_listed_as_left_out(tmp_path, header):
    batches(tmp_path / "run.csv", header)
    spec = tmp_path / "spec.toml"
    done = run(
        "init", tmp_path / "run.csv", "--inputs", "valve", "--outputs", "temp", "--out", spec
    )
    output = unfolded(done.out)
    assert f"30 s is usual in column '{header}', which begins anew with each experiment" in output
    assert "left out" not in output
    assert load_spec(spec).train.record.sampling_time == 30


def test_states_in_words_and_further_files_are_refused_with_a_remedy(tmp_path):
    u, y = plant(100)
    words = np.where(u > 0, "ON", "OFF")
    pd.DataFrame({"pump": words, "flow": y}).to_csv(tmp_path / "run.csv", index=False)
    options = ["--inputs", "pump", "--outputs", "flow", "--out", tmp_path / "spec.toml"]
    done = run("init", tmp_path / "run.csv", *options)
    assert done.code == 2
    assert "no numbers. Its cells hold OFF and ON: write 0 and 1 for them" in unfolded(done.err)
    done = run("init", tmp_path / "run.csv", "run2.csv", "run3.csv", *options)
    assert done.code == 2 and "'run2.csv, run3.csv' besides" in done.err
    assert "add the others to `files` of `train`" in unfolded(done.err)


def test_a_row_of_units_is_right_where_the_header_has_a_remark_in_parentheses():
    assert split_header(header_with_unit("Kraft (Antrieb)", "N")) == ("Kraft (Antrieb)", "N")
    assert split_header(header_with_unit("Kraft (N)", "N")) == ("Kraft", "N")
    assert split_header(header_with_unit("Kraft (N)", "")) == ("Kraft", "N")
    assert split_header(header_with_unit("Kraft [N]", "kN")) == ("Kraft", "N")


def test_units_in_the_row_under_the_header(tmp_path):
    u, y = plant()
    rows = "".join(f"{10 * k},{a:.6f},{b:.6f}\n" for k, (a, b) in enumerate(zip(u, y, strict=True)))
    (tmp_path / "run.csv").write_text(f"Zeit,valve,flow\nms,%,l/s\n{rows}", encoding="utf-8")
    spec = tmp_path / "spec.toml"
    done = run(
        "init", tmp_path / "run.csv", "--out", spec, "--inputs", "valve", "--outputs", "flow"
    )
    output = unfolded(done.out)
    assert f"{len(u)} rows, 3 columns; units are in the row under the header" in output
    assert "sampling time: 0.01 s, from column 'Zeit'" in output
    data = tomllib.loads(spec.read_text(encoding="utf-8"))["data"]
    assert data["channels"] == {"valve": {"unit": "%"}, "flow": {"unit": "l/s"}}
    assert data["time"] == "Zeit"
    job = load_spec(spec)
    assert job.train.record.sampling_time == pytest.approx(0.01)


def test_dates_are_the_clock(tmp_path):
    u, y = plant(300)
    frame = pd.DataFrame(
        {"logged": pd.date_range("2024-02-28", periods=300, freq="20ms"), "u": u, "y": y}
    )
    for ending, write in (
        ("csv", frame.to_csv),
        ("parquet", frame.to_parquet),
        ("xlsx", frame.to_excel),
    ):
        write(tmp_path / f"a.{ending}", index=False)
        done = run("init", tmp_path / f"a.{ending}", "--out", tmp_path / "spec.toml", "--force")
        assert "sampling time: 0.02 s, from column 'logged'" in done.out, done.err
        assert "left out" not in done.out
        assert load_spec(tmp_path / "spec.toml").train.record.sampling_time == pytest.approx(0.02)


def test_uneven_milliseconds_are_resampled_and_their_steps_reported(tmp_path):
    u, y = plant(300)
    t = 20.0 * np.arange(300.0)
    t[1::2] += 3.0
    pd.DataFrame({"t [ms]": t, "u": u, "y": y}).to_csv(tmp_path / "a.csv", index=False)
    assert "from column 't [ms]'; single steps are 0.017 to 0.023 s" in str(
        survey(tmp_path / "a.csv").clock
    )
    t[200:] += 8.0  # the parts of the spec differ by 0.3 % in their mean step
    pd.DataFrame({"t [ms]": t, "u": u, "y": y}).to_csv(tmp_path / "a.csv", index=False)
    assert run("init", tmp_path / "a.csv", "--out", tmp_path / "spec.toml").code == 0
    assert "sampling_time" in tomllib.loads((tmp_path / "spec.toml").read_text())["data"]
    assert not [
        w for w in load_spec(tmp_path / "spec.toml").warnings if w.code == "other_sampling_time"
    ]
    t[200:] += 20.0
    pd.DataFrame({"t [ms]": t, "u": u, "y": y}).to_csv(tmp_path / "a.csv", index=False)
    done = run("init", tmp_path / "a.csv", "--out", tmp_path / "spec.toml", "--force")
    output = " ".join(done.out.split())
    assert "but the steps are uneven; single steps are 0.017 to 0.045 s" in output, done.err
    job = load_spec(tmp_path / "spec.toml")
    assert job.train.record.prepared[0].step == "resample"
    assert job.train.record.sampling_time == pytest.approx(0.02, rel=0.3)


STEPS = [
    (
        "t [ms]",
        20.0,
        "sampling_time = 1.0",
        "`sampling_time` is 1 s, but column 't [ms]' of a.csv gives 0.02 s",
    ),
    (
        "time",
        0.1,
        "",
        "so 1 s is used, but column 'time' of a.csv gives 0.1 s; perhaps time = \"time\" is meant",
    ),
    ("time", 0.1, "sampling_time = 0.1", ""),
    ("other", 0.1, "sampling_time = 1.0", ""),
]


@pytest.mark.parametrize(("header", "every", "given", "told"), STEPS)
def test_a_column_that_says_another_step_is_a_warning(tmp_path, header, every, given, told):
    u, y = plant(100)
    pd.DataFrame({header: every * np.arange(100), "u": u, "y": y}).to_csv(
        tmp_path / "a.csv", index=False
    )
    spec = f'[data]\n{given}\ninputs = ["u"]\noutputs = ["y"]\ntrain = {{files = ["a.csv"]}}\n'
    spec += '[[baseline.terms]]\nparameter = "a"\nregressor = "y[k-1]"\n'
    (tmp_path / "spec.toml").write_text(spec)
    warnings = [
        w for w in load_spec(tmp_path / "spec.toml").warnings if w.code == "other_sampling_time"
    ]
    assert len(warnings) == bool(told) and all(told in w.text for w in warnings)


@pytest.mark.parametrize("fault", ["lost rows", "varying steps", "late stamps"])
def test_a_column_of_uneven_instants_is_a_warning(tmp_path, fault):
    u, y = plant(100)
    k, rng = np.arange(100.0), np.random.default_rng(0)
    stamps = {
        "lost rows": k + 3 * (k >= 60),
        "varying steps": np.cumsum(rng.uniform(0.6, 1.4, 100)),
        "late stamps": k + rng.uniform(0, 0.2, 100),
    }
    table = pd.DataFrame({"time": 0.1 * stamps[fault], "u": u, "y": y})
    table.to_csv(tmp_path / "a.csv", index=False)
    (tmp_path / "spec.toml").write_text(
        '[data]\nsampling_time = 0.1\ninputs = ["u"]\noutputs = ["y"]\n'
        'train = {files = ["a.csv"]}\n'
        '[[baseline.terms]]\nparameter = "a"\nregressor = "y[k-1]"\n'
    )
    found = [
        w.text
        for w in load_spec(tmp_path / "spec.toml").warnings
        if w.code == "other_sampling_time"
    ]
    assert len(found) == (fault != "late stamps")
    assert all('taken as evenly spaced; perhaps time = "time" is meant' in w for w in found)


THINNED = [
    (
        "time",
        0.05,
        5,
        'Give sampling_time = 0.01, that of the file\'s rows, or time = "time" instead.',
    ),
    (
        "aika",
        0.05,
        5,
        "the rows of a.csv are 0.01 s apart by column 'aika', and the rows that are kept 0.05 s",
    ),
    ("Ts", 0.05, 5, "Give sampling_time = 0.01, that of the file's rows.\n"),
    ("time", 0.01, 5, ""),
    ("time", 0.05, 1, ""),
    ("time", 0.03, 5, ""),
    ("row", 0.05, 5, ""),
]


@pytest.mark.parametrize(("header", "given", "every", "told"), THINNED)
def test_a_sampling_time_that_is_thinned_already_is_refused(tmp_path, header, given, every, told):
    u, y = plant(300)
    clock = {"Ts": np.full(300, 0.01), "row": np.arange(300)}.get(header, 0.01 * np.arange(300))
    pd.DataFrame({"u": u, "y": y, "note": "warm", header: clock}).to_csv(
        tmp_path / "a.csv", index=False
    )
    spec = f'[data]\nsampling_time = {given}\ninputs = ["u"]\noutputs = ["y"]\n'
    spec += f'train = {{files = ["a.csv"], every = {every}}}\n'
    spec += '[[baseline.terms]]\nparameter = "a"\nregressor = "y[k-1]"\n'
    (tmp_path / "spec.toml").write_text(spec)
    done = run("check", tmp_path / "spec.toml")
    assert done.code == (2 if told else 0) and told in done.err, done.err
    multiplied = (
        f"data.train: every = {every} multiplies the sampling time {given:g} s to "
        f"{every * given:g} s. But the rows of"
    )
    assert (multiplied in done.err) == bool(told)
    if not told and every > 1:
        apart = (
            f"without a filter, so that rows are {every * given:g} s apart instead of {given:g} s"
        )
        assert any(apart in warning.text for warning in load_spec(tmp_path / "spec.toml").warnings)


SINGLE = [
    ({"data": {"Ts": 2.0}}, 2.0),
    ({"Ts": 0.5}, 0.5),
    ({"data": {"fs": 50.0}}, 0.02),
    ({"Fs": 50.0, "Ts": 0.02}, 0.02),
    ({"Fs": 50.0, "Ts": 0.1}, None),
    ({"Ts": 0.0}, None),
    ({"gain": 3.0}, None),
]


@pytest.mark.parametrize(("beside", "step"), SINGLE)
def test_a_single_number_in_a_file_of_matlab_is_the_sampling_time(tmp_path, beside, step):
    u, y = plant(300)
    data = {"u": u, "y": y} | beside.pop("data", {})
    scipy.io.savemat(tmp_path / "a.mat", {"data": data} | beside)
    # Data.u and data.y are known as u and y
    done = run("init", tmp_path / "a.mat", "--out", tmp_path / "spec.toml")
    assert done.code == 0, done.err
    data = tomllib.loads((tmp_path / "spec.toml").read_text())["data"]
    assert (data["inputs"], data["outputs"], data["sampling_time"]) == (
        ["data_u"],
        ["data_y"],
        step or 1.0,
    )
    assert ("no column states it" in done.out) == (step is None)
    np.savez(tmp_path / "a.npz", u=u, y=y, **beside)
    assert survey(tmp_path / "a.npz").clock.step == (step if beside else None)


def test_a_lag_that_is_a_guess_is_reported_in_the_spec(tmp_path):
    rng = np.random.default_rng(0)
    pd.DataFrame({"u": rng.normal(size=30), "y": rng.normal(size=30)}).to_csv(
        tmp_path / "a.csv", index=False
    )
    done = run("init", tmp_path / "a.csv", "--out", tmp_path / "spec.toml")
    assert done.code == 0 and "no lag of it is significant" in done.out
    assert (
        "# no lag of it is significant, so this is a guess" in (tmp_path / "spec.toml").read_text()
    )


def test_a_dead_time_that_the_data_do_not_determine_is_a_guess_in_the_spec(tmp_path):
    record = crane(0, rows=1600)
    (one,) = record.experiments
    columns = {
        "t": 0.05 * np.arange(1600),
        "F": one.inputs[:, 0],
        "pos": one.outputs[:, 0],
        "swing": one.outputs[:, 1],
    }
    pd.DataFrame(columns).to_csv(tmp_path / "a.csv", index=False)
    roles = ("--inputs", "F", "--outputs", "pos", "swing")
    done = run("init", tmp_path / "a.csv", *roles, "--out", tmp_path / "spec.toml")
    assert "several lags of it act together, and the data do not determine" in unfolded(done.out)
    written = (tmp_path / "spec.toml").read_text(encoding="utf-8")
    assert "# the data do not determine its first lag, so this is a guess" in written


def test_a_free_run_that_diverges_says_so(csv, tmp_path, monkeypatch):
    monkeypatch.setattr(commands_init, "_LOST", 1e-9)
    roles = ("--inputs", "force [N]", "--outputs", "position_mm")
    done = run("init", csv, *roles, "--out", tmp_path / "spec.toml")
    wanted = "its free run diverges: the error is over 1e-09 times the output's standard deviation"
    assert f"{wanted} on the test rows 450 to 600" in unfolded(done.out)


def test_the_focus_is_left_to_the_data(tmp_path):
    u, y = plant(400)
    pd.DataFrame({"u": u, "y1": y, "y2": np.gradient(y)}).to_csv(tmp_path / "a.csv", index=False)
    assert run("init", tmp_path / "a.csv", "--out", tmp_path / "spec.toml").code == 0
    assert "focus" not in (tmp_path / "spec.toml").read_text()


def test_a_long_file_is_looked_at_in_windows_and_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(first_orders, "LOOKED_AT", 500)
    monkeypatch.setattr(commands_init, "LOOKED_AT", 500)
    monkeypatch.setattr(cli, "_LARGE", 10.0)
    monkeypatch.setattr(cli, "on_terminal", lambda: True)
    u, y = plant(2000)
    u[:500], y[:500] = 0.0, 0.0  # the first rows tell nothing
    pd.DataFrame({"u": u, "y": y}).to_csv(tmp_path / "a.csv", index=False)
    done = run("init", tmp_path / "a.csv", "--out", tmp_path / "spec.toml")
    assert done.code == 0 and "reading a.csv" in done.err and "looking at signals" in done.err
    assert (
        "delays and orders are estimated from 500 of these rows" in done.out and "nk 3;" in done.out
    )


def frame_with(**columns) -> pd.DataFrame:
    """The plant's signals behind other columns."""
    u, y = plant(300)
    return pd.DataFrame({**columns, "u": u, "y": y})


EVEN = 0.02 * np.arange(300)
TIMES = {
    "another language": ("aika", EVEN, 0.02),
    "no name of time": ("X.Data", EVEN + 7.0, 0.02),
    "a unit of time": ("Messung [ms]", 1e3 * EVEN, 0.02),
    "jitter of a clock": ("aika", EVEN + 0.004 * np.sin(np.arange(300)), 0.02),
    "rounded instants": ("aika", np.round(0.025 * np.arange(300), 2), 0.025),
    "a cell that is missing": ("aika", np.where(np.arange(300) == 7, np.nan, EVEN), 0.02),
    "the last column": (None, EVEN, 0.02),
    "a unit as its name": ("min", EVEN / 60, 0.02),
}


@pytest.mark.parametrize(("header", "instants", "step"), TIMES.values(), ids=TIMES.keys())
def test_the_time_is_known_by_rising_evenly_and_is_no_channel(tmp_path, header, instants, step):
    frame = frame_with(**{header or "aika": instants})
    frame = frame[["u", "y", "aika"]] if header is None else frame
    frame.to_csv(tmp_path / "a.csv", index=False)
    done = run("init", tmp_path / "a.csv", "--out", tmp_path / "spec.toml")
    assert done.code == 0, done.err
    data = tomllib.loads((tmp_path / "spec.toml").read_text())["data"]
    assert (data["inputs"], data["outputs"]) == (["u"], ["y"])
    assert f"from column '{header or 'aika'}', which rises as time does" in done.out
    assert load_spec(tmp_path / "spec.toml").train.record.sampling_time == pytest.approx(
        step, rel=1e-3
    )
    done = run(
        "init",
        tmp_path / "a.csv",
        "--inputs",
        "u",
        "--outputs",
        "y",
        header or "aika",
        "--out",
        tmp_path / "b",
    )
    assert done.code == 2 and "in each row, as time does; it is no output" in done.err


NO_TIMES = {
    "a quantity that rises": (
        "energy",
        np.arange(300.0) ** 1.5,
        "rises, but in steps of 1 to 25.9, so it is taken for a signal",
    ),
    "another unit": (
        "pos [mm]",
        EVEN,
        "rises evenly, but its unit mm is no unit of time, so it is taken for a signal",
    ),
    "a time that begins anew": (
        "time",
        EVEN % 4.0,
        "0.02 s is usual in column 'time', which begins anew with each experiment",
    ),
    "minutes that are each in six rows": (
        "time",
        np.arange(300) // 6 * 0.12,
        "0.02 s, because column 'time' has each instant in 6 rows",
    ),
    "instants that repeat": (
        "time",
        np.floor((EVEN * 10) ** 1.3),
        "stays at 0 in row 1, so it is not the time",
    ),
    "a temperature": ("t", np.cos(EVEN), "falls in many rows, so it is taken for a signal"),
    "a counter": ("row", np.arange(300), "counts the rows"),
}


@pytest.mark.parametrize(("header", "values", "reason"), NO_TIMES.values(), ids=NO_TIMES.keys())
def test_why_a_column_is_not_the_time_is_said(request, tmp_path, header, values, reason):
    frame_with(**{header: values}).to_csv(tmp_path / "a.csv", index=False)
    done = run(
        "init",
        tmp_path / "a.csv",
        "--inputs",
        "u",
        "--outputs",
        "y",
        "--out",
        tmp_path / "spec.toml",
    )
    known = "0.02 s, because" if "six rows" in request.node.name else "no column states it"
    known = "0.02 s is usual" if "begins" in request.node.name else known
    assert done.code == 0 and f"sampling time: {known}" in done.out, done.err
    output = done.out.replace("\n  ", " ").splitlines()  # folded lines go on indented
    assert any(header in line and reason in line for line in output), done.out
    signals = [column.header for column in survey(tmp_path / "a.csv").signals]
    assert signals == (["u", "y"] if "signal" not in reason else [header, "u", "y"])


def test_a_second_time_is_no_signal_either(tmp_path):
    frame_with(n=np.arange(300), time=EVEN, aika=EVEN + 3.0).to_csv(tmp_path / "a.csv", index=False)
    done = run("init", tmp_path / "a.csv", "--out", tmp_path / "spec.toml")
    assert (
        "0.02 s, from column 'time'" in done.out and "left out: n (counts the rows)" in done.out
    ), done.err
    assert "left out: aika (rises by 0.02 in each row, as a time does)" in done.out


def write_columns(path, **columns):
    pd.DataFrame({"t": 0.01 * np.arange(len(next(iter(columns.values())))), **columns}).to_csv(
        path, index=False
    )
    return path


def test_what_follows_from_the_past_of_others_is_an_output(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    rng = np.random.default_rng(8)
    u, y = plant()
    w = np.repeat(rng.normal(size=60), 10)
    z = y + scipy.signal.lfilter([0, 0.3], [1, -0.9], w)
    file = write_columns(tmp_path / "a.csv", level=z, valve=u, wind=w, other=rng.normal(size=600))
    done = run("init", file, "--out", tmp_path / "a.toml")
    assert done.code == 0
    output = " ".join(done.out.split())
    assert (
        "past values of 'valve' and 'wind' help to predict 'level', but not the reverse" in output
    )
    assert "left out: other" in done.out
    spec = (tmp_path / "a.toml").read_text()
    assert 'inputs = ["valve", "wind"]' in spec and 'outputs = ["level"]' in spec
    assert "# Inputs and outputs are guessed" in spec


def in_a_loop(rng) -> dict[str, np.ndarray]:
    """A first-order plant under proportional control, with noise in both places."""
    u, y = np.zeros(600), np.zeros(600)
    for k in range(1, 600):
        y[k] = 0.9 * y[k - 1] + 0.5 * u[k - 1] + 0.1 * rng.normal()
        u[k] = -0.8 * y[k - 1] + 0.1 * rng.normal()
    return {"drive": u, "speed": y}


def side_by_side(rng) -> dict[str, np.ndarray]:
    """Two runs of one plant, four columns."""
    columns = {}
    for name in ("first", "second"):
        u = rng.normal(size=600)
        columns |= {
            f"{name}_drive": u,
            f"{name}_speed": scipy.signal.lfilter([0, 1], [1, -0.8], u)
            + 0.01 * rng.normal(size=600),
        }
    return columns


def unrelated(rng) -> dict[str, np.ndarray]:
    return {"left": rng.normal(size=600), "right": rng.normal(size=600)}


@pytest.mark.parametrize("columns", [in_a_loop, side_by_side, unrelated])
def test_roles_that_the_data_leave_open_are_asked_for(tmp_path, monkeypatch, columns):
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    file = write_columns(tmp_path / "a.csv", **columns(np.random.default_rng(5)))
    done = run("init", file, "--out", tmp_path / "a.toml")
    assert done.code == 2 and not (tmp_path / "a.toml").exists()
    assert "the names of the columns do not show which are inputs and which outputs" in done.err


def test_an_integrator_gets_the_orders_of_runs_that_start_again(tmp_path, monkeypatch):
    """Noise of the process: over a long run every linear model drifts away from the output."""
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    rng = np.random.default_rng(2)
    u = np.repeat(rng.normal(size=120), 10)
    speed = scipy.signal.lfilter([0, 0.02], [1, -0.98], u + rng.normal(size=1200))
    y = np.cumsum(speed) + 1e-3 * rng.normal(size=1200)
    file = write_columns(tmp_path / "a.csv", u=u, y=y)
    done = run("init", file, "--out", tmp_path / "a.toml")
    assert done.code == 0 and "the orders come from runs of" in done.out
    assert "y[k-2]" in (tmp_path / "a.toml").read_text()


def test_a_ramp_may_be_an_input_where_the_time_is_known(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    frame = frame_with()
    frame["u"] = 0.5 * np.arange(300) + 1.0
    frame.to_csv(tmp_path / "a.csv", index=False)
    out = tmp_path / "spec.toml"
    done = run("init", tmp_path / "a.csv", "--out", out)  # its name says input, its values time
    assert (
        done.code == 2
        and "only y varies, so there is no pair of an input and an output. u is taken for the time"
        in " ".join(done.err.split())
    )
    done = run("init", tmp_path / "a.csv", "--inputs", "u", "--outputs", "y", "--out", out)
    assert (
        done.code == 2
        and "column 'u' rises by 0.5 s in each row, as time does; if it is an input, give"
        in done.err
    )
    done = run(
        "init",
        tmp_path / "a.csv",
        "--inputs",
        "u",
        "--outputs",
        "y",
        "--sampling-time",
        "0.1",
        "--out",
        out,
    )
    assert done.code == 0 and "sampling time: 0.1 s, as given" in done.out, done.err
    assert tomllib.loads(out.read_text())["data"]["sampling_time"] == 0.1


LISTS = [
    "a.csv --inputs u v --outputs y",
    "a.csv --inputs u,v --outputs y",
    "a.csv --inputs u --inputs v --outputs y",
    "a.csv --inputs=u v --outputs y",
    "--inputs u v a.csv --outputs y",
    "--outputs y --inputs u v a.csv",
    "--outputs y a.csv --inputs u, v",
]


@pytest.mark.parametrize("line", LISTS)
def test_columns_are_listed_by_spaces_commas_or_repetition(tmp_path, monkeypatch, line):
    frame_with(v=np.random.default_rng(1).normal(size=300)).to_csv(tmp_path / "a.csv", index=False)
    monkeypatch.chdir(tmp_path)
    done = run("init", *line.split(), "--sampling-time", "0.1")
    assert done.code == 0, done.err
    assert tomllib.loads((tmp_path / "spec.toml").read_text())["data"]["inputs"] == ["u", "v"]


def test_a_column_may_have_a_comma_in_its_name(tmp_path):
    frame_with().rename(columns={"u": "Kraft, N"}).to_csv(tmp_path / "a.csv", index=False)
    done = run(
        "init",
        tmp_path / "a.csv",
        "--inputs",
        "Kraft, N",
        "--outputs",
        "y",
        "--out",
        tmp_path / "spec.toml",
    )
    assert done.code == 0, done.err
    assert tomllib.loads((tmp_path / "spec.toml").read_text())["data"]["channels"] == {
        "Kraft_N": {"column": "Kraft, N"}
    }


@pytest.mark.parametrize(
    ("ending", "separator", "comma"), [("txt", " ", "."), ("dat", ";", ","), ("csv", "\t", ",")]
)
def test_a_file_without_a_header_is_begun_with_and_runs(tmp_path, ending, separator, comma):
    frame_with(t=EVEN).to_csv(
        tmp_path / f"a.{ending}", index=False, header=False, sep=separator, decimal=comma
    )
    out = tmp_path / "spec.toml"
    done = run("init", tmp_path / f"a.{ending}", "--inputs", "x2", "--outputs", "x3", "--out", out)
    assert done.code == 0 and "no header, so the columns are called x1 to x3" in done.out, done.err
    data = tomllib.loads(out.read_text())["data"]
    assert data["time"] == "x1" and "nk 3;" in done.out
    out.write_text(out.read_text().replace("restarts = 3", "restarts = 1").replace('kind = "mlp"', 'kind = "none"')
                   .replace("hidden = [8]", ""))  # fmt: skip
    assert run("fit", out, "--out", tmp_path / "result").code == 0
    done = run("simulate", tmp_path / "result", tmp_path / f"a.{ending}", "--column", "x2=x2")
    assert done.code == 0 and len(done.out.splitlines()) > 250, done.err


def put_dspace(path, *, names=("Force", "Position"), rows=300):
    """A measurement as ControlDesk exports it in v7.3: X holds the time, Y an array of structs by references."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        refs, run_ = file.create_group("#refs#"), file.create_group("run")
        for group in (run_, run_.create_group("X"), run_.create_group("Y")):
            group.attrs["MATLAB_class"] = np.bytes_("struct")
        run_["X"].create_dataset("Data", data=EVEN[:rows, None])
        for field, values in (("Name", names), ("Data", plant(rows))):
            held = []
            for i, value in enumerate(values):
                text = isinstance(value, str)
                data = (
                    np.array([[ord(c)] for c in value], "u2")
                    if text
                    else np.asarray(value)[:, None]
                )
                made = refs.create_dataset(f"{field}{i}", data=data)
                made.attrs["MATLAB_class"] = np.bytes_("char" if text else "double")
                held.append([made.ref])
            run_["Y"].create_dataset(
                field, data=np.array(held, dtype=h5py.ref_dtype), dtype=h5py.ref_dtype
            )
    return path


def test_signals_of_dspace_are_known_by_their_names(tmp_path):
    path, out = put_dspace(tmp_path / "run.mat"), tmp_path / "spec.toml"
    assert read_titles(path).names == ["run.X.Data", "Force", "Position"]
    done = run("init", path, "--inputs", "Force", "--outputs", "Position", "--out", out)
    assert (
        done.code == 0 and "0.02 s, from column 'run.X.Data', which rises as time does" in done.out
    ), done.err
    assert tomllib.loads(out.read_text())["data"]["time"] == "run.X.Data" and "nk 3;" in done.out
    assert run("check", out).code == 0
    assert read_titles(put_dspace(tmp_path / "b.mat", names=("In", "In"))).names == [
        "run.X.Data", "run.Y[0].Data", "run.Y[1].Data"
    ]  # fmt: skip


MEASURED = [
    ("f16/f-16.txt", "x1 x2", "x3", 1.0),
    ("ball_and_beam/run.mat", "In2", "In1 In7", 0.001),
    ("servo/Training_Set.mat", "Training_set.Clock.PW_adj", "Training_set.Clock.motor_rpm", 1.0),
    ("mr_damper/damper.mat", "X", "y", 1.0),
]


@pytest.mark.parametrize(("file", "inputs", "outputs", "step"), MEASURED)
def test_measured_files_are_begun_with(data_folder, tmp_path, file, inputs, outputs, step):
    if not (data_folder / file).is_file():
        pytest.skip(f"no {file}; set ORTHAUG_DATA to the folder of the data sets")
    options = [
        "--inputs",
        *inputs.split(),
        "--outputs",
        *outputs.split(),
        "--out",
        tmp_path / "spec.toml",
    ]
    done = run("init", data_folder / file, *options)
    assert done.code == 0, done.err
    assert load_spec(tmp_path / "spec.toml").train.record.sampling_time == pytest.approx(
        step, rel=1e-4
    )


def test_runs_of_unequal_length_have_their_own_time(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    (u, y), (v, z) = plant(300), plant(200)
    runs = {"a": {"tid": EVEN, "u": u, "y": y}, "b": {"tid": 0.05 * np.arange(200), "u": v, "y": z}}
    scipy.io.savemat(tmp_path / "a.mat", runs)
    out = tmp_path / "spec.toml"
    assert run("init", tmp_path / "a.mat", "--out", out).code == 2  # u and y of two runs
    done = run("init", tmp_path / "a.mat", "--inputs", "a.u", "--outputs", "b.y", "--out", out)
    assert (
        done.code == 2 and "the columns have unequal lengths: 'a.u' 300, 'b.y' 200 rows" in done.err
    )
    done = run("init", tmp_path / "a.mat", "--inputs", "b.u", "--outputs", "b.y", "--out", out)
    assert done.code == 0 and "0.05 s, from column 'b.tid'" in done.out, done.err


def test_wild_samples_in_long_runs_are_left_out(tmp_path):
    u, y = plant(1200)
    y[100:104] = [60.0, -70.0, 80.0, -90.0]  # more than the step `fill` reconstructs
    pd.DataFrame({"u": u, "y": y}).to_csv(tmp_path / "a.csv", index=False)
    done = run(
        "init", tmp_path / "a.csv", "--sampling-time", "0.1", "--out", tmp_path / "spec.toml"
    )
    assert (
        done.code == 0
        and "4 training rows in longer gaps or runs of wild samples are left out" in done.out
    ), done.err
    assert tomllib.loads((tmp_path / "spec.toml").read_text())["data"]["missing"] == "skip"
    assert run("check", tmp_path / "spec.toml").code == 0


@pytest.mark.parametrize("level", [0.0, 5.0])
def test_the_stated_error_is_what_a_fit_gives_on_the_same_rows(tmp_path, monkeypatch, level):
    """Physics alone, trained one step ahead on the training rows, in free run over the test rows."""
    monkeypatch.chdir(tmp_path)
    u, y = plant()
    pd.DataFrame({"u": u, "y": y + level}).to_csv("run.csv", index=False)
    said = run(
        "init", "run.csv", "--inputs", "u", "--outputs", "y", "--sampling-time", 0.1
    ).out.replace("\n  ", " ")
    stated = re.search(
        r"its error in free run is ([\d.]+) % of the output's standard deviation on the test rows "
        r"(\d+) to (\d+), fitted to rows 0 to \2 one step ahead",
        said,
    )
    assert stated is not None, said
    place = tmp_path / "spec.toml"
    text = place.read_text(encoding="utf-8").partition("[learner]")[0]
    spec = tomllib.loads(text)
    assert spec["data"]["tests"]["last"]["rows"] == [int(stated[2]), int(stated[3])]
    alone = 'kind = "none"\n[training]\nfocus = "prediction"\n'
    place.write_text(f"{text}[learner]\n{alone}", encoding="utf-8")
    fitted = json.loads(run("fit", "spec.toml", "--json", "--out", "out").out)
    nrmse = fitted["scores"]["tests.last"]["simulation"]["nrmse"][0]
    assert float(f"{100 * nrmse:.3g}") == float(stated[1])


@pytest.mark.parametrize("order", [1, 5])
def test_the_error_after_a_fit_of_the_free_run_is_stated_where_it_is_clearly_less(tmp_path, order):
    """One step ahead lags that are too few follow the last output; a fit of the run does not."""
    rng = np.random.default_rng(2)
    u = np.repeat(rng.normal(size=200), 3)
    y = scipy.signal.lfilter([0.1**order], np.poly([0.9] * order), np.roll(u, 1))
    noise = 1e-3 * y.std() * rng.normal(size=600)
    pd.DataFrame({"u": u, "y": y + noise}).to_csv(tmp_path / "run.csv", index=False)
    options = ("--inputs", "u", "--outputs", "y", "--out", tmp_path / "spec.toml")
    said = " ".join(run("init", tmp_path / "run.csv", *options).out.split())
    one_step = re.search(r"its error in free run is ([\d.]+) %", said)
    whole = re.search(r"fitted to the free run, .*? its error is ([\d.]+) %", said)
    assert one_step is not None and (whole is None) == (order == 1), said
    if whole is not None:
        assert float(whole[1]) < 0.7 * float(one_step[1])


@pytest.mark.parametrize("order", ["rising", "falling", "shuffled"])
def test_a_static_characteristic_is_called_one(tmp_path, order):
    """Speeds over pulse widths, in the order of these."""
    rng = np.random.default_rng(3)
    pulse = np.sort(np.round(rng.uniform(1000, 2000, 300)))
    pulse = {"rising": pulse, "falling": pulse[::-1], "shuffled": rng.permutation(pulse)}[order]
    speed = 50 * np.tanh((1450 - pulse) / 200) + 0.5 * rng.normal(size=300)
    pd.DataFrame({"pulse": pulse, "speed": speed}).to_csv(tmp_path / "run.csv", index=False)
    options = ("--inputs", "pulse", "--outputs", "speed", "--out", tmp_path / "spec.toml")
    done = run("init", tmp_path / "run.csv", *options)
    assert done.code == 0, done.err
    said = " ".join(done.out.split())
    if order == "shuffled":
        assert "pulse excites up to order 20" in said and "from row to row" not in said
    else:
        way = "rises" if order == "rising" else "falls"
        assert f"pulse only {way} from row to row" in said
        assert "static relation" in said and "excites" not in said


def test_a_time_that_begins_anew_separates_experiments(tmp_path):
    u, y = plant(300)
    time = np.concatenate([0.5 * np.arange(120), 0.5 * np.arange(180)])
    frame = pd.DataFrame({"t": time, "u": u, "y": y})
    frame.to_csv(tmp_path / "a.csv", index=False)
    done = run("init", tmp_path / "a.csv", "--out", tmp_path / "spec.toml")
    assert done.code == 0, done.err
    assert "the time begins anew in row 120: the rows between are experiments" in done.out
    data = tomllib.loads((tmp_path / "spec.toml").read_text())["data"]
    assert (data["sampling_time"], data["train"]["rows"]) == (0.5, [[0, 120], [120, 225]])


def test_a_time_that_begins_anew_is_one_where_roles_are_asked_for(tmp_path):
    u, y = np.random.default_rng(0).normal(size=(2, 300))
    time = 0.5 * (np.arange(300) % 150)
    frame = pd.DataFrame({"part": np.repeat([1, 2], 150), "time": time, "flow": u, "dose": y})
    frame.to_csv(tmp_path / "a.csv", index=False)
    done = run("init", tmp_path / "a.csv", "--out", tmp_path / "spec.toml")
    assert done.code == 2
    assert "time (the time, which begins anew with each experiment)" in done.err
    assert "part (numbers the experiments)" in done.err


@pytest.mark.parametrize("name", ["part", "id"])
def test_a_column_that_numbers_the_experiments_is_no_input(tmp_path, name):
    """By its name, or since the time begins anew with it; it was taken for an input."""
    u, y = plant(300)
    half = 0.5 * np.arange(150)
    time = half if name == "part" else half + 75.0 * np.arange(2)[:, None]
    number = np.repeat([1, 2], 150)
    frame = pd.DataFrame({name: number, "t": np.broadcast_to(time, (2, 150)).ravel()})
    frame.assign(u=u, y=y).to_csv(tmp_path / "a.csv", index=False)
    done = run("init", tmp_path / "a.csv", "--out", tmp_path / "spec.toml")
    assert done.code == 0, done.err
    data = tomllib.loads((tmp_path / "spec.toml").read_text())["data"]
    assert (data["inputs"], data["outputs"], data["experiment"]) == (["u"], ["y"], name)


def test_an_input_that_rises_in_whole_steps_is_an_input(tmp_path):
    u = np.repeat(np.arange(1.0, 7.0), 50)
    y = np.zeros(300)
    for k in range(1, 300):
        y[k] = 0.9 * y[k - 1] + 0.1 * u[k - 1]
    y += 0.01 * np.random.default_rng(0).normal(size=300)
    frame = pd.DataFrame({"t": 0.5 * np.arange(300), "force": u, "position": y})
    frame.to_csv(tmp_path / "a.csv", index=False)
    assert [one.name for one in survey(tmp_path / "a.csv").signals] == ["force", "position"]


@pytest.mark.parametrize(("every", "thinned"), [(1, True), (40, False)])
def test_rows_far_too_close_are_thinned(tmp_path, every, thinned):
    """A second of a swinging mass at 1 kHz: its free run drifted, since neighbouring lags hardly differ."""
    rng = np.random.default_rng(1)
    force, x, v, out = np.repeat(rng.normal(size=20), 300), 0.0, 0.0, []
    for f in force:
        out.append(x)
        v += 1e-3 * (f - 1.5 * v - 40.0 * x)
        x += 1e-3 * v
    y = np.array(out) + 5e-4 * rng.normal(size=len(out))
    frame = pd.DataFrame({"t": 1e-3 * np.arange(len(y)), "force": force, "x": y})[::every]
    frame.to_csv(tmp_path / "a.csv", index=False)
    given = ("--inputs", "force", "--outputs", "x", "--out", tmp_path / "spec.toml")
    done = run("init", tmp_path / "a.csv", *given)
    assert done.code == 0, done.err
    data = tomllib.loads((tmp_path / "spec.toml").read_text())["data"]
    steps = [one["step"] for one in data.get("prepare", [])]
    assert steps == ["decimate"] * thinned
    assert ("rows are thinned by" in done.out) == thinned


def test_under_feedback_rows_are_not_thinned(tmp_path):
    """The low-pass looks ahead: inputs then answered disturbances that were still to come."""
    inflow, valve, level = vessel(np.random.default_rng(1))
    frame = pd.DataFrame({"t": np.arange(1000.0), "q": inflow, "v": valve, "level": level})
    frame.to_csv(tmp_path / "a.csv", index=False)
    given = ("--inputs", "q,v", "--outputs", "level", "--out", tmp_path / "spec.toml")
    done = run("init", tmp_path / "a.csv", *given)
    assert done.code == 0, done.err
    assert "past outputs predict v" in unfolded(done.out)
    assert "prepare" not in tomllib.loads((tmp_path / "spec.toml").read_text())["data"]


def test_under_feedback_no_input_acts_in_its_own_row(tmp_path):
    """The controller's own way from output to input was taken for the plant, without past outputs."""
    rng = np.random.default_rng(3)
    reference = np.repeat(rng.uniform(-1, 1, 30), 40)
    y, u = np.zeros(1200), np.zeros(1200)
    for k in range(1200):
        if k > 1:
            y[k] = 2.02 * y[k - 1] - 1.018 * y[k - 2] + 0.02 * u[k - 1] + 0.002 * rng.normal()
        u[k] = 6.0 * (reference[k] - y[k]) - 40.0 * (y[k] - y[k - 1] if k else 0.0)
    frame = pd.DataFrame({"t": 0.01 * np.arange(1200), "u": u, "y": y})
    frame.to_csv(tmp_path / "a.csv", index=False)
    done = run("init", tmp_path / "a.csv", "--out", tmp_path / "spec.toml")
    assert done.code == 0, done.err
    assert "past outputs predict u: the data were probably recorded under feedback" in unfolded(
        done.out
    )
    spec = (tmp_path / "spec.toml").read_text()
    regressors = re.findall(r'regressor = "(.*?)"', spec)
    assert "u[k]" not in regressors and "y[k-2]" in regressors
    assert '# output = "u"' in spec and '# reference = "reference"' in spec
    frame.assign(setpoint=reference).to_csv(tmp_path / "b.csv", index=False)
    columns = ("--inputs", "u", "--outputs", "y", "--out", tmp_path / "second.toml")
    assert run("init", tmp_path / "b.csv", *columns).code == 0
    assert '# reference = "setpoint"' in (tmp_path / "second.toml").read_text()
