"""The page of `orthaug app`: who may use it, and the whole path from a data file to a model in a real browser."""

from __future__ import annotations

import asyncio
import errno
import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tomllib
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from test_cli import run, signals, write_csv

from orthaug import InputError, load_spec
from orthaug._base.progress import ReachedStage, Stage
from orthaug.commands import demo
from orthaug.commands.app import spec_text, worker
from orthaug.commands.app.gate import Gate
from orthaug.commands.app.kept_results import keep_result, kept_results
from orthaug.commands.app.processes import Command, Run, WorkerPool
from orthaug.commands.app.session import Session, Sessions
from orthaug.commands.app.uploads import begin_file, keep_file, place_for
from orthaug.commands.app.worker import thin_curve
from orthaug.commands.bars import training_bar
from orthaug.commands.job import AS_DECLARED, PHYSICS_ONLY, Variant
from orthaug.commands.signals import WATCH

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
CHROMIUM = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, BROWSERS)), None)
HAS_PAGE = importlib.util.find_spec("nicegui") is not None
if HAS_PAGE:
    from orthaug.commands.app import routes
HAS_BROWSER = importlib.util.find_spec("playwright") is not None and CHROMIUM is not None
served = pytest.mark.skipif(not HAS_PAGE or os.name != "posix", reason="no NiceGUI, or no SIGINT")
browsed = pytest.mark.skipif(
    not (HAS_PAGE and HAS_BROWSER) or os.name != "posix",
    reason="no NiceGUI, Playwright or Chromium, or no SIGINT",
)
MAIN = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # a process in the background may have inherited none
import runpy
runpy.run_module("orthaug", run_name="__main__")
"""
LATE = 90_000  # ms
SPEC = """# kept
[data]
inputs = ["u"]
outputs = ["y"]
train = { files = ["run.csv", "/there/b.csv"] } # kept too
tests.one = { files = ["../c.csv"] }
[[baseline.terms]]
parameter = "a"
regressor = "y[k-1]"
[learner]
kind = "none"
"""


def answer(gate: Gate, kind: str = "http", **given: Any) -> tuple[int, dict[str, str], bool]:
    """Status or closing code, headers, and whether the application behind the gate was reached."""
    sent: list[dict[str, Any]] = []
    reached: list[str] = []

    async def behind(scope, receive, send):
        reached.append(scope["path"])
        if scope["type"] == "http":
            await send({"type": "http.response.start", "status": 200, "headers": []})
            await send({"type": "http.response.body", "body": b""})

    async def send(message):
        sent.append(message)

    gate.app = behind
    headers = {"host": f"127.0.0.1:{gate.port}", **given.get("headers", {})}
    scope = {
        "type": kind,
        "path": given.get("path", "/"),
        "query_string": given.get("query", "").encode(),
    }
    scope |= {
        "headers": [(k.encode(), v.encode()) for k, v in headers.items()],
        "method": given.get("method", "GET"),
    }
    asyncio.run(gate(scope, None, send))  # type: ignore[arg-type]
    first = sent[0] if sent else {}
    found = {k.decode(): v.decode() for k, v in first.get("headers", [])}
    return first.get("status", first.get("code", 0)), found, bool(reached)


def test_only_the_token_opens_the_gate():
    gate = Gate(None, 8123, token="sesame")  # type: ignore[arg-type]
    kept = {
        "cookie": f"a=b; {answer(gate, query='token=sesame')[1]['set-cookie'].partition(';')[0]}"
    }
    assert "sesame" not in kept["cookie"]
    assert gate.url == "http://127.0.0.1:8123/?token=sesame"
    for kind, refusal in (("http", 403), ("websocket", 1008)):
        for query, cookie in (
            ("", ""),
            ("token=", ""),
            ("token=sesam", ""),
            ("", "orthaug-8123=x"),
            ("", "orthaug-1=sesame"),
        ):
            assert answer(gate, kind, query=query, headers={"cookie": cookie})[::2] == (
                refusal,
                False,
            )
        assert answer(gate, kind, headers=kept)[2]
        for header in (
            {"host": "evil.example:8123"},
            {"host": "127.0.0.1:1"},
            {"origin": "http://evil.example"},
        ):
            assert answer(gate, kind, headers=kept | header)[::2] == (refusal, False)
        assert answer(
            gate, kind, headers=kept | {"host": "localhost:8123", "origin": "http://localhost:8123"}
        )[2]
    code, found, reached = answer(gate, query="token=sesame&show=true", path="//evil.example/x")
    assert (code, found["location"], reached) == (303, "/evil.example/x?show=true", False)
    _, found, _ = answer(gate, query="token=sesame", path="/\\evil.example/\r\nx: y")
    assert found["location"] == "/%5Cevil.example/%0D%0Ax%3A%20y"
    assert "HttpOnly" in found["set-cookie"] and "SameSite=Strict" in found["set-cookie"]
    assert "frame-ancestors 'self'" in answer(gate, headers=kept)[1]["content-security-policy"]
    assert len(Gate(None, 1).token) > 40 and Gate(None, 1).token != Gate(None, 1).token  # type: ignore[arg-type]


def test_forms_change_a_spec_and_nothing_else(tmp_path):
    steps = ("data", "prepare")
    spec = spec_text.with_row(SPEC, steps, {"step": "detrend"})
    spec = spec_text.with_row(spec, steps, {"step": "lowpass", "cutoff": 2.0})
    spec = spec_text.with_field(spec, steps, 1, "order", "2")
    assert spec_text.rows_of(spec, steps) == [
        {"step": "detrend"},
        {"step": "lowpass", "cutoff": 2.0, "order": 2},
    ]
    spec = spec_text.without_row(spec_text.without_row(spec, steps, 0), steps, 0)
    assert tomllib.loads(spec) == tomllib.loads(SPEC) and "# kept too" in spec
    spec = spec_text.with_value(spec, ("training", "restarts"), 3)
    assert tomllib.loads(spec)["training"] == {"restarts": 3}
    inline = spec_text.with_row(
        '[baseline]\nterms = [{ parameter = "a", regressor = "1" }]',
        ("baseline", "terms"),
        {"x": 1},
    )
    assert spec_text.rows_of(inline, ("baseline", "terms"))[1] == {"x": 1}
    data = tomllib.loads(spec_text.absolute(SPEC, tmp_path / "in"))["data"]
    assert data["train"]["files"] == [(tmp_path / "in/run.csv").as_posix(), "/there/b.csv"]
    assert data["tests"]["one"]["files"] == [(tmp_path / "c.csv").as_posix()]
    tested = spec_text.with_value(spec, ("data", "tests", "new"), {"files": ["d.csv"]})
    assert tomllib.loads(tested)["data"]["tests"] == {
        "one": {"files": ["../c.csv"]},
        "new": {"files": ["d.csv"]},
    }
    moving = tomllib.loads(spec_text.with_physics(SPEC, "motion", {}))
    assert moving["motion"]["outputs"] == {"y": "x"} and "baseline" not in moving
    with pytest.raises(InputError, match="broken TOML"):
        spec_text.plain("[data\n")


def test_equations_of_motion_take_the_units_of_the_channels_and_leave_no_stale_comment(tmp_path):
    u, y = signals(200, 1)
    write_csv(tmp_path / "run.csv", **{"Force (N)": u, "Position (mm)": y})
    assert run("init", tmp_path / "run.csv", "--inputs", "Force (N)", "--outputs", "Position (mm)",
               "--out", tmp_path / "spec.toml").code == 0  # fmt: skip
    moving = spec_text.with_physics((tmp_path / "spec.toml").read_text(), "motion", {})
    motion = tomllib.loads(moving)["motion"]
    assert {name: row["unit"] for name, row in motion["parameters"].items()} == {
        **{"m": "N s²/mm", "c": "N s/mm", "k": "N/mm"}
    }
    assert {name: row["unit"] for name, row in motion["states"].items()} == {"x": "mm", "v": "mm/s"}
    for stale in ("difference equations", "lags", "trains on the free run"):
        assert stale not in moving
    assert "# Every key" in moving  # what is still true stays
    written = (tmp_path / "spec.toml").read_text().replace('"mm"', '"m"')
    metres = spec_text.with_physics(written, "motion", {})
    assert tomllib.loads(metres)["motion"]["parameters"]["m"]["unit"] == "kg"
    assert "unit" not in spec_text.with_physics(SPEC, "motion", {})


def test_the_other_kind_of_physics_is_kept_and_comes_back():
    shelf: spec_text.Shelf = {}
    moving = spec_text.with_physics(SPEC, "motion", shelf)
    heavy = spec_text.with_value(moving, ("motion", "parameters", "m", "initial"), 7.0)
    back = spec_text.with_physics(heavy, "terms", shelf)
    assert tomllib.loads(back) == tomllib.loads(SPEC)
    again = spec_text.with_physics(back, "motion", shelf)
    assert tomllib.loads(again) == tomllib.loads(heavy)
    fresh = tomllib.loads(spec_text.with_physics(moving, "terms", {}))  # a spec of motions alone
    regressors = [term["regressor"] for term in fresh["baseline"]["terms"]]
    assert regressors == ["y[k-1]", "u[k-1]"] and "motion" not in fresh


def test_every_change_of_the_spec_is_undone_and_redone(started):
    async def worked() -> None:
        session = started()
        for text in ("a = 1", "a = 2"):
            session.write(text, "form")
        session.write("a = 23", "editor")
        session.write("a = 234", "editor")  # typed in one go
        session.undo()
        assert session.spec == "a = 2"
        session.undo()
        session.undo()  # the first spec stays
        assert session.spec == "a = 1" and session.earlier == []
        session.redo()
        session.redo()
        assert session.spec == "a = 234"
        session.undo()
        session.write("a = 5", "form")
        session.redo()
        assert session.spec == "a = 5"
        await session.close()

    asyncio.run(worked())


def trained_on(folder: Path, pattern: str) -> list[str]:
    """The files, from the folder of the spec, that a spec with this in the place of a file reads."""
    spec = folder / "spec.toml"
    spec.write_text(SPEC[: SPEC.index("tests.one")].replace('"run.csv", "/there/b.csv"', f'"{pattern}"')
                    + SPEC[SPEC.index("[[baseline") :])  # fmt: skip
    return [file.file for file in load_spec(spec).train.files]


def test_a_file_whose_name_looks_like_a_pattern_is_found(tmp_path):
    write_csv(tmp_path / "run [1].csv", **dict(zip("uy", signals(20, 1), strict=True)))
    assert trained_on(tmp_path, "run [1].csv") == ["run [1].csv"]


def test_a_text_beside_tables_is_a_note(tmp_path):
    columns = dict(zip("uy", signals(20, 1), strict=True))
    (tmp_path / "plain").mkdir()
    for name in ("a.csv", "b.csv", "notes.txt", "c.dat", "plain/a.txt", "plain/b.dat"):
        write_csv(tmp_path / name, **columns)
    (tmp_path / "plot.png").touch()
    assert trained_on(tmp_path, ".") == ["./a.csv", "./b.csv"]
    assert trained_on(tmp_path, "plain") == ["plain/a.txt", "plain/b.dat"]


def test_a_curve_is_thinned_to_what_is_seen():
    x = np.arange(100_000.0)
    y = np.sin(x / 1e4)
    y[31_234], y[77:90] = 5.0, np.nan
    drawn = thin_curve(x, y)
    assert len(drawn["x"]) <= 3000 and max(v for v in drawn["y"] if v is not None) == 5.0
    assert drawn["x"] == sorted(drawn["x"])  # type: ignore[type-var]
    assert thin_curve(x[77:200], y[77:200])["y"][:13] == [None] * 13


def test_the_address_in_the_browsers_arguments_opens_the_page_once():
    """Every user of the machine reads the arguments of a process: what stands there is worth nothing afterwards."""
    gate = Gate(None, 8123, token="sesame")  # type: ignore[arg-type]
    query = gate.ticket().partition("?")[2]
    assert "sesame" not in query and answer(gate, "websocket", query=query)[0] == 1008
    code, headers, _ = answer(gate, query=query)
    assert code == 303 and query.partition("=")[2] not in headers["set-cookie"]
    assert "HttpOnly" in headers["set-cookie"] and "SameSite=Strict" in headers["set-cookie"]
    assert answer(gate, headers={"cookie": headers["set-cookie"].partition(";")[0]})[2]
    assert answer(gate, query=query)[::2] == (403, False)


def test_each_dropped_file_keeps_its_content(tmp_path):
    def drop(name: str, content: str) -> tuple[str, str]:
        partial = begin_file(tmp_path, name)
        partial.write_text(content)
        place, note = keep_file(partial, name)
        assert place.read_text() == content and not partial.exists()
        return place.name, note

    assert drop("day1/run.csv", "first") == ("run.csv", "")
    name, note = drop("day2/run.csv", "second")
    assert name == "run-2.csv" and "another file called run.csv is here" in note
    assert drop("day1/run.csv", "first") == ("run.csv", "")
    assert drop("day2/run.csv", "second")[0] == "run-2.csv"
    assert drop("day3/run.csv", "third")[0] == "run-3.csv"
    assert drop("?.csv", "a")[0] == "_.csv" and drop("*.csv", "b")[0] == "_-2.csv"
    assert (tmp_path / "run.csv").read_text() == "first"


@served
def test_a_file_beyond_the_limit_is_refused_before_it_comes(tmp_path, monkeypatch):
    from starlette.requests import Request

    monkeypatch.setattr(routes, "LARGEST", 10)
    sessions = Sessions(tmp_path)
    session = sessions.new()

    def dropped(content: bytes, **declared: str) -> tuple[int, str]:
        pieces = [content[i : i + 4] for i in range(0, len(content), 4)]

        async def receive() -> dict[str, Any]:
            return {"type": "http.request", "body": pieces.pop(0), "more_body": bool(pieces)}

        headers = [(name.encode(), value.encode()) for name, value in declared.items()]
        scope = {
            "type": "http",
            "method": "PUT",
            "headers": headers,
            "path": "/",
            "query_string": b"",
        }
        reply = asyncio.run(
            routes._keep_upload(sessions, session.key, "run.csv", Request(scope, receive))
        )  # type: ignore
        return reply.status_code, bytes(reply.body).decode()

    for code, text in (dropped(b"x" * 40), dropped(b"", **{"content-length": "11"})):
        assert code == 413 and "larger than 10 bytes" in text and "give its path" in text
    assert list(session.folder.iterdir()) == []


def test_a_session_keeps_to_its_folder(tmp_path):
    session = Session("key", tmp_path, WorkerPool())
    assert place_for(tmp_path, "../../etc/run one.csv") == tmp_path / "run one.csv"
    assert place_for(tmp_path, "C:\\data\\<b>.CSV").parent == tmp_path
    for name in ("run.exe", ".csv", "", "spec.toml"):
        with pytest.raises(InputError, match="unknown type of data file"):
            place_for(tmp_path, name)
    for name in ("../x", "spec.toml", "model.zip", "c.zip", "/etc/passwd"):
        with pytest.raises(InputError, match="there is nothing of that name yet"):
            session.download(name)


def test_a_command_that_cannot_start_has_failed(monkeypatch):
    monkeypatch.setattr(sys, "executable", "/absent")
    command = Command(["fit"], lambda: None)
    asyncio.run(command.run())
    assert (command.running, command.complaint) == (
        False,
        "the command cannot start (No such file or directory).",
    )


def test_lines_of_progress_say_what_each_run_is(csv, tmp_path, monkeypatch, capsys):
    (tmp_path / "spec.toml").write_text(
        f'[data]\ninputs = ["u"]\noutputs = ["y"]\ntrain = {{ files = ["{csv.as_posix()}"] }}\n'
        '[[baseline.terms]]\nparameter = "a"\nregressor = "y[k-1]"\ninitial = 0.5\n'
        "[learner]\nhidden = [4]\n[training]\nrestarts = 2\n"
    )
    job = load_spec(tmp_path / "spec.toml")
    runs = job.plan_of(AS_DECLARED)
    assert [tuple(run.values()) for run in runs] == [
        *(
            ("orthogonal", 1, "none"),
            ("orthogonal", 2, "none"),
            ("orthogonal", 1, "ard"),
            ("orthogonal", 2, "ard"),
        )
    ]
    assert len(runs) == job.run_count and job.plan_of(Variant(PHYSICS_ONLY)) == (
        {"structure": PHYSICS_ONLY},
    )
    penalised = job.plan_of(Variant("baseline-penalty"))
    assert {run["structure"] for run in penalised} == {"baseline-penalty"} and len(penalised) == 4
    monkeypatch.setenv("ORTHAUG_PROGRESS", "json")
    monkeypatch.setattr("orthaug.commands.bars._OFTEN", 0.0)
    with training_bar(8, 10) as progress:
        for first, plan in ((0, runs), (4, penalised)):
            own = progress.after(runs=first)
            own.planned(plan)
            own(1, 3, 0.5)
        own(4, 3, 0.5)  # made again: nothing was planned of it
    lines = [
        json.loads(line) for line in capsys.readouterr().err.splitlines() if line.startswith("{")
    ]
    found = [Run.of(line) for line in lines]
    assert found == [Run(2, "orthogonal", 2, "none"), Run(6, "baseline-penalty", 2, "none"), Run(9)]


def test_lines_of_progress_name_the_stages_after_the_runs(monkeypatch, capsys):
    monkeypatch.setenv("ORTHAUG_PROGRESS", "json")
    with training_bar(1, 10):
        Stage.CHOICE.enter("run 2 of 5 on held-out blocks")
        Stage.SCORES.enter()
    Stage.REPORT.enter()  # the result is written after the bar has ended
    lines = capsys.readouterr().err.splitlines()
    stages = [json.loads(line)["stage"] for line in lines if line.startswith("{")]
    choice = "choosing between the runs: run 2 of 5 on held-out blocks"
    assert stages == [choice, "scores", "report"]
    reached = ReachedStage.of(choice, None)
    assert reached == (Stage.CHOICE, choice)
    reached = ReachedStage.of("trials of advice", reached)
    assert reached == (Stage.ADVICE, "trials of advice")
    assert ReachedStage.of(choice, reached) is reached  # of a trial


def test_an_early_end_names_the_stage_after_the_runs():
    with training_bar(2, 10) as progress:
        progress(1, 3, 0.5)
        assert WATCH._during() == "run 2 of 2, iteration 3, loss 0.5"
        Stage.ADVICE.enter()
        Stage.SCORES.enter()  # of a trial
        assert WATCH._during() == "trials of advice"
    assert WATCH._during() == ""


def test_a_proposal_is_no_spec_yet(tmp_path):
    draw = np.random.default_rng(4)
    names = ("valve", "level")
    write_csv(tmp_path / "noise.csv", **{name: draw.normal(size=60) for name in names})
    found = worker.look(str(tmp_path / "noise.csv"), str(tmp_path / "s.toml"), None, None, None)
    assert [column["kind"] for column in found["columns"]] == ["input", "output"]
    assert found["guess"] == "" and found["spec"] is None
    u, y = signals(400, 3)
    write_csv(tmp_path / "rig.csv", left=u, right=y)
    found = worker.look(str(tmp_path / "rig.csv"), str(tmp_path / "s.toml"), None, None, None)
    assert (found["inputs"], found["outputs"], found["spec"]) == (["left"], ["right"], None)
    assert found["guess"].startswith("past values of 'left' help to predict 'right'")


@pytest.mark.proof
def test_start_values_come_from_short_segments_of_the_data(tmp_path):
    worker.example(str(tmp_path))
    spec = (tmp_path / "spec.toml", spec_text.with_physics(demo.SPEC, "motion", {}))
    spec[0].write_text(spec[1])
    found = worker.starts(str(spec[0]))["values"]
    assert 15_000 < found["k"] < 19_000 and 50 < found["c"] < 110  # from 1


def test_the_last_results_of_a_spec_are_kept_with_what_had_changed(tmp_path):
    made, place = tmp_path / "fit", tmp_path / "kept"
    made.mkdir()
    scores = {"train": {"simulation": {"nrmse": [0.5]}}, "tests.a": {"simulation": {"nrmse": None}}}
    for i in range(12):
        scores["tests.a"]["simulation"]["nrmse"] = [i / 100] if i < 11 else None
        (made / "result.json").write_text(json.dumps({"scores": scores}))
        keep_result(place, "fit", made, f"[learner]\nhidden = [{i}]\n")
    (place / "0007-fit" / "result.json").write_text("{")  # damaged
    kept = kept_results(place)
    assert [one.number for one in kept] == [3, 4, 5, 6, 8, 9, 10, 11, 12]
    assert kept[0].change == "the first one kept"
    assert kept[-1].change == "learner.hidden: [10] → [11]"
    assert [one.score for one in kept[-2:]] == ["NRMSE 0.1 on tests.a", "no free run"]
    assert all((one.folder / "result.json").is_file() for one in kept)


@served
def test_names_in_messages_are_code_and_markup_is_text():
    from orthaug.commands.app.widgets import marked

    assert marked("set `[data] a` to <b>") == "set <code>[data] a</code> to &lt;b&gt;"


@served
def test_curves_of_the_loss_are_named_by_start_or_by_structure():
    from orthaug.commands.app.view_training import _runs_caption
    from orthaug.commands.app.widgets import loss_figure

    def drawn(runs: list[Run]) -> tuple[list[str], list[str], dict[str, Any]]:
        figure = loss_figure([(run, i, 0.5**i) for i in range(3) for run in runs])
        legend = [trace["name"] for trace in figure["data"] if trace["showlegend"]]
        return (
            legend,
            [trace["hovertemplate"].partition("<br>")[0] for trace in figure["data"]],
            figure["layout"],
        )

    plan = [(start, kind) for kind in ("none", "ard") for start in (1, 2, 3)]
    fit = [Run(i, "orthogonal", *own) for i, own in enumerate(plan, 1)]
    legend, names, layout = drawn(fit)
    assert legend == names == [f"start {start}, {kind}" for start, kind in plan]
    assert (
        layout["legend"]["yanchor"] == "bottom" and layout["margin"]["b"] >= 40 + 6 * 19
    )  # below the axis
    assert drawn(fit[:3])[0] == ["start 1", "start 2", "start 3"]
    kinds = ("orthogonal", "additive", "<i>own</i>")
    compared = [Run(0, "physics alone")]
    compared += [
        Run(6 * i + run.number, kind, *run[2:]) for i, kind in enumerate(kinds) for run in fit
    ]
    legend, names, _ = drawn(compared)
    assert legend == ["physics alone", "orthogonal", "additive", "&lt;i&gt;own&lt;/i&gt;"]
    assert (
        names[0] == "physics alone"
        and names[1] == "orthogonal, start 1, none"
        and len(set(names)) == 19
    )
    assert (
        drawn([Run(1), Run(2)])[0] == ["run 1", "run 2"]
        and drawn([Run(1, "orthogonal", 1, "ard")])[0] == []
    )
    assert "(ard, none)" in _runs_caption(set(fit)) and "The colour shows" in _runs_caption(
        set(compared)
    )
    assert _runs_caption({Run(1)}) == "Each curve is a run: one training."


@served
def test_a_run_that_begins_again_breaks_its_curve_of_the_loss():
    from orthaug.commands.app.widgets import loss_figure

    run = Run(1, "orthogonal", 1, "none")
    figure = loss_figure([(run, 1, 4.0), (run, 9, 1.0), (run, 1, 0.5), (run, 2, 0.4)])
    (trace,) = figure["data"]
    assert trace["x"] == [1, 9, None, 1, 2] and trace["y"] == [4.0, 1.0, None, 0.5, 0.4]


@served
def test_a_table_of_parameters_has_the_interval_with_the_bias(monkeypatch):
    from orthaug.commands.app import view_training
    from orthaug.commands.app.widgets import interval_figure

    shown = []
    monkeypatch.setattr(view_training, "table", lambda *given: shown.append(given))
    row = {"name": "c", "value": 4.5, "std": 0.01, "ci95": [4.4, 4.6], "unit": "N s/m"}
    bias = {"value": 2.5, "determined": True}
    biased = row | {"bias": bias, "ci95_with_bias": [0.9, 2.3]}
    lost = row | {"bias": bias | {"determined": False}, "ci95_with_bias": None}
    view_training._parameters("Parameters", [("", [biased, lost])], {})
    ((head, (first, second), _),) = shown
    assert head[4:6] == ("bias", "95 % interval with the bias")
    assert first[3:6] == ("4.4 … 4.6", "2.5", "0.9 … 2.3")
    assert second[5] == "not determined by these data"
    view_training._parameters("Parameters", [("", [row])], {})
    assert "bias" not in shown[1][0]
    thin, _ = interval_figure([("fit", [biased])], {})["data"]
    assert thin["x"] == [0.9, 2.3] and thin["name"] == "95 % interval with the bias"


@served
def test_the_form_shows_the_focus_that_training_takes():
    from orthaug.commands.app.view_model import _FOCUS, _focus_of

    cases = (({}, False), ({"horizon": 3}, False), ({}, True), ({"focus": "prediction"}, True))
    found = [_focus_of(training, moves=moves) for training, moves in cases]
    assert found == ["auto", "prediction", "simulation", "prediction"]
    assert _FOCUS["auto"] == "automatic"


@served
def test_a_part_of_the_page_that_fails_keeps_no_other_from_what_is_new(tmp_path, monkeypatch):
    session = Session("key", tmp_path, WorkerPool())
    page, found, seen = routes.Page(session), [], []
    monkeypatch.setattr(page, "_complain", found.append)
    monkeypatch.setattr(page, "_name", lambda: None)
    monkeypatch.setattr(page.data, "follow_data", lambda: 1 / 0)
    monkeypatch.setattr(page.model, "follow_data", lambda: seen.append("model"))
    monkeypatch.setattr(page.training, "follow_work", lambda: seen.append("training"))
    session.mark_changed("data")
    page.follow()
    assert [type(error) for error in found] == [ZeroDivisionError] and seen == ["model", "training"]
    page.follow()
    assert len(found) == 1


def test_a_process_that_cannot_start_is_reported(tmp_path, monkeypatch):
    async def refused():
        raise OSError(errno.EAGAIN, "Resource temporarily unavailable")

    async def looked() -> str:
        session = Session("key", tmp_path, WorkerPool())
        session.desk.prepare()
        session.open_file(tmp_path / "run.csv")
        await session._look
        await session.desk.close()
        return session.trouble

    monkeypatch.setattr("orthaug.commands.app.processes._start_worker", refused)
    assert asyncio.run(looked()) == "no process can be started (Resource temporarily unavailable)."
    monkeypatch.setattr("orthaug.commands.app.session.Session.reword", lambda *_: 1 / 0)
    assert asyncio.run(failed(tmp_path)) == "this did not work (ZeroDivisionError)."


async def failed(tmp_path) -> str:
    """What is told of a task that fails with what nobody expected."""
    session = Session("key", tmp_path, WorkerPool())
    session.open_file(tmp_path / "run.csv")
    with pytest.raises(ZeroDivisionError):
        await session._look
    await asyncio.sleep(0)
    return session.trouble


def test_a_question_that_is_taken_back_leaves_its_process_to_the_next(tmp_path, monkeypatch):
    started = []

    async def counted():
        started.append(1)
        await asyncio.sleep(0.05)
        raise OSError(errno.EAGAIN, "later")

    async def twice() -> None:
        desk = WorkerPool()
        desk.prepare()
        first = asyncio.ensure_future(desk.ask("look"))
        await asyncio.sleep(0.01)
        first.cancel()
        await asyncio.sleep(0)
        assert desk._coming is not None and started == [1]
        for starts in ([1], [1, 1]):  # the one that is on its way, then another
            with pytest.raises(InputError, match="no process can be started"):
                await desk.ask("look")
            assert started == starts

    monkeypatch.setattr("orthaug.commands.app.processes._start_worker", counted)
    asyncio.run(twice())


def test_sessions_that_nobody_used_make_room(tmp_path):
    sessions = Sessions(tmp_path)
    first, second = sessions.new(), sessions.new()
    first.data = tmp_path / "run.csv"
    keys = {sessions.new().key for _ in range(48 + 20)}
    assert (
        sessions.find(first.key) is first and sessions.find(second.key) is None and len(keys) == 68
    )
    for key in keys:
        if (session := sessions.find(key)) is not None:
            session.data = first.data
    with pytest.raises(InputError, match="50 sessions are open"):
        sessions.new()


def looked(**given: Any) -> dict[str, Any]:
    """What a look at a file with the columns left and right gives."""
    columns = [
        {"header": head, "kind": "", "usable": True, "timed": False, "description": ""}
        for head in ("left", "right")
    ]
    curves = {head: {"x": [0.0, 1.0], "y": [0.0, 1.0]} for head in ("left", "right")}
    plain = {
        "columns": columns,
        "curves": curves,
        "rows": 2,
        "timed": "",
        "step": None,
        "account": "",
        "open": "",
        "guess": "",
    }
    return plain | {"spec": None} | given


class Answers:
    """In place of a desk: a spec for what is chosen, or for every file where `tells`; nothing of specs."""

    def __init__(self, tells: bool = False) -> None:
        self.tells = tells

    async def ask(self, question: str, **given: Any) -> dict[str, Any]:
        if question == "examine":
            raise InputError("nothing is checked here.")
        chosen = given["inputs"] is not None
        if not (chosen or self.tells):
            return looked()
        inputs, outputs = given["inputs"] or "left", given["outputs"] or "right"
        file = given["path"].name
        channels = f'inputs = ["{inputs}"]\noutputs = ["{outputs}"]'
        spec = f'[data]\n{channels}\ntrain = {{ files = ["{file}"], rows = [0, 2] }}\n'
        return looked(spec=spec, inputs=[inputs], outputs=[outputs])


@pytest.fixture
def started(tmp_path, monkeypatch) -> Iterator[Callable[..., Session]]:
    """Sessions whose desk answers at once."""
    monkeypatch.setattr("platformdirs.user_state_path", lambda name: tmp_path / "state" / name)
    (tmp_path / "work").mkdir()

    def begin(*, tells: bool = False) -> Session:
        return Session("secret-key", tmp_path / "work", Answers(tells))  # type: ignore[arg-type]

    yield begin


async def look(session: Session, name: str) -> None:
    session.open_file(place_for(session.folder, name))
    assert session._look is not None
    await session._look


@pytest.mark.parametrize("tells", [False, True])
def test_a_further_file_leaves_the_spec_and_may_be_a_test_of_it(started, tells):
    async def worked() -> None:
        session = started(tells=tells)
        await look(session, "motor_train.csv")
        assert (
            session.title == "motor_train.csv" and bool(session.spec) == tells and not session.apart
        )
        if not tells:
            session.choose(["left"], ["right"], None)
            await session._look
        begun = session.spec
        await look(session, "motor_test.csv")
        assert (session.spec, session.title, session.apart) == (begun, "motor_train.csv", True)
        assert {path.name for path in session.raw} == {"motor_train.csv", "motor_test.csv"}
        session.add_test()
        assert not session.apart
        await look(session, "motor_test.csv")
        await look(session, "motor_train.csv")  # the spec was worked on, and names both
        assert not session.apart and tomllib.loads(session.spec)["data"]["tests"] == {
            "motor_test": {"files": ["motor_test.csv"]}
        }
        await look(session, "other.csv")
        session.choose(["right"], ["left"], None)
        await session._look
        assert (
            tomllib.loads(session.spec)["data"]["train"]["files"] == ["other.csv"]
            and not session.apart
        )
        assert session.title == "other.csv" and {path.name for path in session.raw} >= {"other.csv"}
        await session.close()

    asyncio.run(worked())
    assert sorted(map(spec_text.kept_title, spec_text.earlier())) == [
        "motor_train.csv",
        "other.csv",
    ]


def test_a_file_that_is_dropped_again_begins_a_spec_that_nobody_worked_on_anew(started):
    async def worked() -> None:
        session = started(tells=True)
        await look(session, "a.csv")
        session.authors.clear()
        session.spec = session.spec.replace("rows", "every")
        await look(session, "a.csv")
        assert "rows" in session.spec
        session.write(session.spec.replace("rows", "every"), "editor")
        await look(session, "a.csv")
        assert "every" in session.spec and not session.apart
        session.add_test()
        session.add_test()  # no test takes the place of another
        assert list(session.content()["data"]["tests"]) == ["a", "a_"]
        await session.close()

    asyncio.run(worked())


def test_a_spec_says_its_files_and_columns():
    content = tomllib.loads(SPEC + '[structure]\nmeasure = { kind = "file", files = ["m.csv"] }\n')
    assert spec_text.files(content) == ["run.csv", "/there/b.csv", "../c.csv", "m.csv"]
    content["data"]["channels"] = {"u": {"column": "Force (N)"}, "y": {"unit": "m"}}
    assert spec_text.columns(content) == {"Force (N)": "input", "y": "output"}
    assert spec_text.files({}) == [] and spec_text.columns({}) == {}


@served
def test_the_channels_and_the_grey_curves_are_those_of_the_spec(started):
    from orthaug.commands.app.view_data import DataView
    from orthaug.commands.app.view_results import ExportView

    async def worked() -> Session:
        session = started()
        await look(session, "motor_train.csv")
        session.choose(["left"], ["right"], None)
        await session._look
        await look(session, "motor_test.csv")
        await session.close()
        return session

    session = asyncio.run(worked())
    view, export = DataView(session), ExportView(session)
    assert session.found is not None and session.data is not None
    assert view._whole_file()[0] == "motor_test.csv"  # nothing was checked yet
    view._take_uses(session.found)
    assert (
        view.uses == {"left": "input", "right": "output"}
        and view._missing_columns(session.found) == []
    )
    session.checked = {"files": [str(session.folder / "motor_train.csv")]}
    assert view._whole_file() == (
        "motor_train.csv",
        session.raw[session.folder / "motor_train.csv"],
    )
    session.raw.clear()
    assert view._whole_file() == ("", {})
    assert export._uploaded_files() == ["motor_train.csv"]
    session.spec = spec_text.with_value(
        session.spec, ("data", "tests", "a"), {"files": ["motor_test.csv", "/b.csv"]}
    )
    assert export._uploaded_files() == ["motor_train.csv", "motor_test.csv"]
    session.spec = session.spec.replace('"left"', '"up"')
    assert view._missing_columns(session.found) == ["up"]
    view._drawn = (None, None, False)
    view._take_uses(session.found)
    assert view.uses == {"left": "", "right": ""}


def test_what_cannot_be_served_is_said(tmp_path, monkeypatch):
    (tmp_path / "bad.toml").write_text("[data\n")
    for arguments, told in (
        (["absent.toml"], "absent.toml: no such file"),
        ([str(tmp_path / "bad.toml")], "bad.toml: broken TOML"),
        (["--port", "70000"], "--port: cannot listen on port 70000"),
    ):
        done = run("app", "--no-browser", *arguments)
        assert (done.code, done.out) == (2, "") and told in done.err, done
    monkeypatch.setitem(sys.modules, "nicegui", None)
    assert "pip install 'orthaug[app]'" in run("app", "--no-browser").err


class Server:
    """`orthaug app` in a process of its own."""

    def __init__(self, folder: Path, *arguments: object) -> None:
        setting = {k: v for k, v in os.environ.items() if k != "PYTEST_CURRENT_TEST"} | {
            "TMPDIR": str(folder)
        }
        setting |= {"XDG_STATE_HOME": str(folder / "state")}
        program = [sys.executable, "-c", MAIN, "app", "--no-browser", *map(str, arguments)]
        pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        self.process = subprocess.Popen(program, cwd=folder, env=setting, **pipes)
        assert self.process.stdout is not None
        self.url = self.process.stdout.readline().strip()
        self.base = self.url.partition("?")[0]

    def children(self) -> list[int]:
        """All processes below it."""
        found, parents = [], [self.process.pid]
        while parents:
            for task in Path(f"/proc/{parents.pop()}/task").glob("*/children"):
                below = [int(number) for number in task.read_text().split()]
                found, parents = found + below, parents + below
        return found

    def end(self) -> str:
        """What it said on standard error, after Ctrl-C."""
        self.process.send_signal(signal.SIGINT)
        _, found = self.process.communicate(timeout=20)
        return found


@pytest.fixture(scope="module")
def server(tmp_path_factory) -> Iterator[Server]:
    started = Server(tmp_path_factory.mktemp("app"))
    yield started
    if started.process.poll() is None:
        started.end()


@pytest.fixture
def serve() -> Iterator[Callable[..., Server]]:
    """Starts servers that do not outlive the test."""
    started: list[Server] = []

    def begin(*arguments: Any) -> Server:
        started.append(Server(*arguments))
        return started[-1]

    yield begin
    for server in started:
        if server.process.poll() is None:
            server.process.kill()
            server.process.communicate()


@pytest.fixture(scope="module")
def browser():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        browser = started.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"]
        )
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def csv(tmp_path_factory) -> Path:
    u, y = signals(400, 3)
    path = tmp_path_factory.mktemp("data") / "plant.csv"
    write_csv(path, u=u, y=y)
    return path


class Tab:
    """A tab of a browser of its own, with what it complained of and asked for."""

    open: ClassVar[list[Tab]] = []

    def __init__(self, browser, server: Server, width: int = 1280, scheme: str = "light") -> None:
        self.context = browser.new_context(
            viewport={"width": width, "height": 844}, color_scheme=scheme, reduced_motion="reduce"
        )
        self.page, self.told, self.server = self.context.new_page(), [], server
        self.page.set_default_timeout(LATE)
        self.asked: set[str] = set()
        self.page.on(
            "console",
            lambda m: self.told.append(m.text) if m.type in ("error", "warning") else None,
        )
        self.page.on("pageerror", lambda error: self.told.append(str(error)))
        self.page.on("request", lambda r: self.asked.add(r.url))
        self.page.on("websocket", lambda w: self.asked.add(w.url.replace("ws://", "http://")))
        self.open.append(self)
        self.page.goto(server.url)
        self.page.wait_for_selector("#drop")

    def go(self, name: str) -> None:
        self.page.get_by_role("tab", name=name).click()
        self.page.wait_for_selector(f"[role=tab][aria-selected=true]:has-text('{name}')")

    def drop(self, file: Path) -> None:
        self.page.set_input_files("#dropped", file)
        self.page.wait_for_selector(f"text={file.name}: ")

    def write(self, change) -> str:
        """Change the spec in the editor, and wait until it was checked."""
        editor = self.page.get_by_label("spec in TOML")
        self.page.wait_for_function("document.querySelector('.editor textarea')?.value")
        spec = change(editor.input_value())
        self.page.evaluate(
            "document.querySelectorAll('.note').forEach(note => note.dataset.old = '1')"
        )
        editor.fill(spec)  # "Checking …" may be gone before it is seen
        self.page.wait_for_selector(".note.good:not([data-old]), .note.bad:not([data-old])")
        return spec

    def get(self, name: str) -> Any:
        """The answer to a request for a file."""
        return self.context.request.get(f"{self.page.url.partition('#')[0]}/get/{name}")

    def fetch(self, name: str) -> bytes:
        return self.get(name).body()

    def check(self, *names: str) -> None:
        """axe finds nothing, and nothing is wider than the page."""
        from axe_playwright_python.sync_playwright import Axe

        for name in names:
            self.go(name)
            self.page.wait_for_timeout(250)
            found = Axe().run(self.page)
            assert found.violations_count == 0, found.generate_report()
            width = self.page.viewport_size["width"]
            assert self.page.evaluate("document.documentElement.scrollWidth") <= width, name

    def leave(self) -> None:
        self.open.remove(self)
        self.context.close()

    def close(self) -> None:
        self.leave()
        assert self.told == []
        assert {
            url for url in self.asked if not url.startswith((self.server.base, "data:", "blob:"))
        } == set()


@pytest.fixture(autouse=True)
def _tell_of_tabs_left_open() -> Iterator[None]:
    """What a tab shows where its test has failed."""
    yield
    for tab in list(Tab.open):
        print(tab.page.url, tab.told, tab.page.inner_text("body"), sep="\n")
        tab.leave()


@served
def test_the_server_listens_on_this_machine_alone_and_asks_for_the_token(server):
    def status(url: str, **headers: str) -> int:
        try:
            with urllib.request.urlopen(
                urllib.request.Request(url, headers=headers), timeout=10
            ) as told:
                return told.status
        except urllib.error.HTTPError as error:
            return error.code

    assert server.base.startswith("http://127.0.0.1:")
    places = (
        "",
        "session/x",
        "session/x/get/spec.toml",
        "_nicegui_ws/socket.io/?EIO=4&transport=polling",
    )
    assert [status(server.base + place) for place in places] == [403] * 4
    assert status(server.url + "x") == 403 and status(server.url, Host="evil.example") == 403
    port = server.base.rstrip("/").rpartition(":")[2]
    listening = (
        Path("/proc/net/tcp").read_text().splitlines() if os.path.exists("/proc/net/tcp") else []
    )
    own = [
        line.split()[1]
        for line in listening
        if line.split()[1].endswith(f":{int(port):04X}") and " 0A " in line
    ]
    assert set(own) <= {f"0100007F:{int(port):04X}"}


@browsed
def test_from_a_file_to_code_with_the_numbers_of_the_command_line(
    server, browser, csv, tmp_path, without_figures
):
    tab, other = Tab(browser, server), Tab(browser, server, 390, "dark")
    page = tab.page
    tab.drop(csv)
    page.wait_for_selector(".plot .main-svg")
    page.get_by_role("tab", name="Data").focus()
    page.keyboard.press("ArrowRight")
    assert page.evaluate("document.activeElement.innerText.trim()") == "Model"
    page.get_by_label("step to add").select_option("detrend")
    page.get_by_role("button", name="Add", exact=True).click()
    page.wait_for_selector("text=Done: detrend")
    tab.check("Model")
    assert page.get_by_text("Unit of").count() == 0
    page.get_by_label("unit").first.fill("m")
    page.get_by_label("unit").first.press("Tab")
    page.wait_for_function(
        "document.querySelector('.editor textarea').value.includes('unit = \"m\"')"
    )
    spec = tab.write(
        lambda text: text.replace(
            "restarts = 3", "restarts = 200\niterations = 4000\nregularization = 0.0"
        )
    )
    assert 'unit = "m"' in spec and '[[data.prepare]]\nstep = "detrend"' in spec

    # while it trains another one works on another file, and sees nothing of it
    tab.go("Training")
    page.get_by_role("button", name="Train").click()
    second = csv.with_name("second.csv")
    write_csv(second, left=np.arange(40.0) % 7, right=np.arange(40.0) % 5)
    other.page.set_input_files("#dropped", second)
    other.page.wait_for_selector("text=The names of the columns do not show")
    assert other.page.url != page.url and "plant.csv" not in other.page.inner_text("body")

    # a reload in the middle finds it again, and it can be stopped
    page.wait_for_selector("text=iteration")
    page.wait_for_selector("text=Free run on the training data, so far")
    shown = page.locator("[aria-label^='Free run on the training data'] .legendtext")
    assert shown.all_text_contents()[:2] == ["measured", "physics alone"]
    page.reload()
    page.wait_for_selector("text=iteration")
    assert page.get_by_role("tab", name="Training").get_attribute("aria-selected") == "true"
    page.get_by_role("button", name="Stop", exact=True).click()
    page.wait_for_selector("text=Training was stopped")

    # or ended with what it has
    page.get_by_role("button", name="Train").click()
    page.wait_for_selector("text=iteration")
    page.get_by_role("button", name="Stop and keep").click()
    page.wait_for_selector("text=the best so far is kept")
    kept = json.loads(tab.fetch("result.json"))
    assert "stopped" in [warning["code"] for warning in kept["warnings"]]

    tab.go("Model")
    tab.write(
        lambda text: text.replace(
            "restarts = 200\niterations = 4000", "restarts = 1\niterations = 20"
        )
    )
    tab.go("Training")
    page.get_by_role("button", name="Train").click()
    page.wait_for_selector("text=Training is done")
    tab.go("Report")
    report = page.frame_locator("iframe")
    assert report.locator("h1").inner_text() == "Model of y from u"
    page.wait_for_function("document.querySelector('iframe').clientHeight > 2 * innerHeight")
    whole, seen = report.locator("html").evaluate("html => [html.scrollHeight, innerHeight]")
    assert whole <= seen  # it scrolls with the page alone
    report.locator("nav a").last.click()
    page.wait_for_function("scrollY > innerHeight")
    tab.check("Export")
    page.get_by_role("button", name="Write numpy").click()
    page.wait_for_selector("text=numpy.zip")

    (tmp_path / "spec.toml").write_bytes(tab.fetch("spec.toml"))
    shutil.copy(csv, tmp_path)
    assert run("fit", tmp_path / "spec.toml", "--out", tmp_path / "result").code == 0
    own = json.loads((tmp_path / "result" / "result.json").read_text())
    shown = json.loads(tab.fetch("result.json"))
    for told in (own, shown):
        for restart in told["restarts"]:
            restart.pop("seconds", None)
    assert [p["value"] for p in shown["parameters"]] == [p["value"] for p in own["parameters"]]
    assert shown["scores"] == own["scores"] and shown["restarts"] == own["restarts"]
    for name, file in (("model.zip", "model/arrays.safetensors"), ("numpy.zip", "numpy/model.py")):
        (tmp_path / name).write_bytes(tab.fetch(name))
        assert file in zipfile.ZipFile(tmp_path / name).namelist()
    arrays = zipfile.ZipFile(tmp_path / "model.zip").read("model/arrays.safetensors")
    assert arrays == (tmp_path / "result" / "model" / "arrays.safetensors").read_bytes()

    phone = other.page
    phone.goto(page.url)
    phone.wait_for_selector("[role=tab]")
    other.check("Data", "Model", "Training", "Report", "Export")
    other.close()
    tab.close()


@browsed
def test_example_data_lead_on_and_every_change_is_taken_back(server, browser):
    tab = Tab(browser, server)
    page = tab.page
    assert page.get_by_role("button", name="Continue to Model").is_disabled()
    assert "Start with a data file" in page.inner_text(".onward:visible")
    page.get_by_role("button", name="Try it with a mass, spring and damper").click()
    page.wait_for_selector("text=tests.uniform")
    page.get_by_role("button", name="Continue to Model").click()
    page.wait_for_selector("[role=tab][aria-selected=true]:has-text('Model')")
    page.wait_for_selector(".note.good:has-text('can be trained')")
    editor = page.get_by_label("spec in TOML")
    terms = tomllib.loads(editor.input_value())

    # both kinds of physics are kept
    page.get_by_label("written as").select_option("motion")
    page.wait_for_selector("[aria-label='parameter k']")
    page.get_by_label("initial").first.fill("7")
    page.get_by_label("initial").first.press("Enter")
    heavy = "() => document.querySelector('.editor textarea').value.includes('initial = 7')"
    page.wait_for_function(heavy)
    page.get_by_label("written as").select_option("terms")
    page.wait_for_selector("[aria-label='term 3']")
    assert tomllib.loads(editor.input_value()) == terms
    page.get_by_label("written as").select_option("motion")
    page.wait_for_function(heavy)

    # undo and redo, by button and by key
    page.get_by_role("button", name="Undo").click()
    page.wait_for_selector("[aria-label='term 3']")
    page.keyboard.press("Control+z")
    page.wait_for_function(heavy)
    page.keyboard.press("Control+Shift+z")
    page.wait_for_selector("[aria-label='term 3']")
    page.get_by_role("button", name="Undo").click()
    page.wait_for_function(heavy)

    # a reload keeps the part, the place, and what was typed
    page.get_by_label("unit").first.fill("stone")
    page.evaluate("scrollTo(0, 400)")
    page.wait_for_timeout(600)
    page.reload()
    page.wait_for_function("[...document.querySelectorAll('input')].some(i => i.value === 'stone')")
    page.wait_for_function("Math.abs(scrollY - 400) < 3")
    assert page.evaluate("location.hash") == "#Model"
    assert "stone" not in page.get_by_label("spec in TOML").input_value()
    page.wait_for_timeout(1000)  # the place is held for half a second after it was reached
    tab.go("Data")
    page.wait_for_function("scrollY === 0")
    tab.check("Model")
    tab.close()


@browsed
def test_a_motion_is_edited_in_its_form_and_checked_as_it_is_written(server, browser):
    tab = Tab(browser, server)
    page = tab.page
    page.get_by_role("button", name="Try it with").click()
    page.wait_for_selector("text=tests.uniform")
    tab.go("Model")
    page.get_by_label("written as").select_option("motion")

    def enter(label: str, value: str, group: str) -> None:
        made = page.locator(f"[aria-label='{group}']").get_by_label(label, exact=True)
        made.fill(value)
        made.press("Enter")

    def motion() -> dict[str, Any]:
        return tomllib.loads(tab.fetch("spec.toml").decode())["motion"]

    enter("dv/dt", "(force - c*v - k*q)/m", "state v")
    page.wait_for_selector("[aria-label='state v'] .wrong:has-text(\"unknown name 'q'\")")
    assert page.locator("[aria-label='state x'] .wrong").count() == 0
    enter("dv/dt", "(force - c*v - k*x)/m", "state v")
    page.wait_for_selector(".wrong", state="detached")
    enter("name", "mass", "parameter m")
    page.wait_for_selector("[aria-label='parameter mass']")
    assert motion()["states"]["v"]["derivative"] == "(force - c*v - k*x)/mass"
    page.get_by_role("button", name="Add a state").click()
    enter("name", "lag", "state s1")
    enter("dlag/dt", "v - lag", "state lag")
    page.locator("[aria-label='state lag']").get_by_label("learner added").click()
    page.get_by_role("button", name="Add a parameter").click()
    enter("max", "3", "parameter p1")
    page.wait_for_function(
        "() => document.querySelector('.editor textarea').value.includes('max = 3')"
    )
    found = motion()
    assert found["states"]["lag"] == {"derivative": "v - lag", "learned": True}
    assert found["parameters"]["p1"] == {"initial": 1.0, "max": 3}
    assert list(found["parameters"]) == ["mass", "c", "k", "p1"]
    page.get_by_label("Remove parameter p1").click()
    page.wait_for_selector("[aria-label='parameter p1']", state="detached")
    tab.close()


@browsed
def test_results_stand_side_by_side_and_outlive_the_server(serve, browser, csv, tmp_path):
    server = serve(tmp_path)
    tab = Tab(browser, server)
    page = tab.page
    tab.page.get_by_label("or its path").fill(str(csv))
    tab.page.get_by_label("or its path").press("Enter")
    page.wait_for_selector("text=first physics")

    def train(neurons: int, number: int) -> None:
        tab.go("Model")
        tab.write(
            lambda text: re.sub(r"hidden = \[\d+\]", f"hidden = [{neurons}]", text).replace(
                "restarts = 3", "restarts = 1\niterations = 20"
            )
        )
        tab.go("Training")
        page.get_by_role("button", name="Train", exact=True).click()
        page.wait_for_selector("text=after the runs")  # its stages are named
        page.wait_for_selector(f"[aria-label='result {number}']")
        page.wait_for_selector("text=Free run on train")

    train(3, 1)
    train(2, 2)
    assert "hidden: [3] → [2]" in page.inner_text("[aria-label='result 2']")
    assert "NRMSE" in page.inner_text("[aria-label='result 1']")
    for number in (1, 2):
        page.get_by_label(f"compare result {number}").click()
    page.wait_for_selector("text=rows where result 1 errs most")
    page.wait_for_selector("[aria-label='Parameters with 95 % intervals of result 1, result 2.']")
    tab.check("Training")
    second = tab.fetch("result.json")
    page.get_by_label("Open result 1").click()
    page.wait_for_function("document.querySelector('.editor') || true")
    page.wait_for_selector("[aria-label='result 1'] button[disabled]")
    assert b"hidden = [3]" in tab.fetch("spec.toml") and tab.fetch("result.json") != second
    tab.leave()
    server.process.kill()
    server.process.communicate()

    server = serve(tmp_path)
    tab = Tab(browser, server)
    tab.page.get_by_role("button", name="plant.csv, 20").click()
    tab.go("Training")
    tab.page.wait_for_selector("[aria-label='result 2']")
    tab.page.wait_for_selector("text=Free run on train")
    assert tab.fetch("result.json") == second
    tab.go("Report")
    heading = tab.page.frame_locator("iframe").locator("h1")
    assert heading.inner_text() == "Model of y from u"
    tab.close()
    server.end()


class Keys:
    """A person at the keyboard: goes from control to control by Tab, and sees where the focus is."""

    NOW = """() => {
      const now = document.activeElement, box = now.getBoundingClientRect(), style = getComputedStyle(now);
      const top = document.querySelector(".tabs").getBoundingClientRect().bottom;
      const frame = now.closest(".q-field__control");
      return {
        name: now.ariaLabel ?? (now.closest(".card") === now ? now.querySelector("h2").innerText : now.innerText),
        group: now.closest("[role=group]")?.ariaLabel ?? "",
        lost: now === document.body,
        seen: now.closest(".tabs, .drop") || (box.bottom > top && box.top < innerHeight),
        marked: now.id === "dropped" || style.outlineStyle === "solid" || style.boxShadow !== "none" ||
          (frame && getComputedStyle(frame, "::after").borderTopWidth === "2px"),
      };
    }"""

    def __init__(self, page) -> None:
        self.page, self.press = page, page.keyboard.press

    def to(self, name: str, group: str = "", back: bool = False) -> None:
        """Until the control has the focus; on the way each one is seen, and shows that it has it."""
        for _ in range(60):
            self.press("Shift+Tab" if back else "Tab")
            now = self.page.evaluate(self.NOW)
            if now["name"] == name and now["group"] == group:
                assert now["seen"], now
                self.page.wait_for_function(
                    f"({self.NOW})().marked"
                )  # a frame takes its colour in a moment
                return
        raise AssertionError(f"{name} is not reached by Tab")

    def part(self, name: str, steps: str) -> None:
        """Shift+Tab to the tabs, arrows, Enter."""
        while self.page.evaluate("document.activeElement.role") != "tab":
            self.press("Shift+Tab")
        for step in steps.split():
            self.press(step)
        self.press("Enter")
        self.page.wait_for_selector(f"[role=tab][aria-selected=true]:has-text('{name}')")

    def write(self, text: str, first: str = "Control+a") -> None:
        self.page.evaluate(
            "document.querySelectorAll('.note').forEach(note => note.dataset.old = '1')"
        )
        self.press(first)
        self.page.keyboard.type(text)
        self.press("Enter")

    def act(self, key: str, then: str) -> None:
        """Press a key, after which this has the focus: another control, or the same drawn anew."""
        self.page.evaluate("document.activeElement.dataset.left = '1'")
        self.press(key)
        there = f"(name) => ({self.NOW})().name === name && !document.activeElement.dataset.left"
        self.page.wait_for_function(there, arg=then)

    def checked(self, told: str) -> None:
        """Until this stands in the spec, and the spec was checked."""
        self.page.wait_for_function(
            "(told) => document.querySelector('.editor textarea').value.includes(told)", arg=told
        )
        self.page.wait_for_selector(".note.good:not([data-old])")


@browsed
@pytest.mark.proof
def test_the_whole_path_by_keyboard_alone(server, browser, csv, tmp_path):
    (tmp_path / "rig.csv").write_text(csv.read_text().replace("u,y", "left,right"))
    tab = Tab(browser, server)
    page, keys = tab.page, Keys(tab.page)
    page.keyboard.press("Tab")
    keys.to("or its path on this machine")
    keys.write(str(tmp_path / "rig.csv"))
    page.wait_for_selector("text=use of left")
    keys.to("use of left")  # proposed as an input
    keys.to("use of right")
    page.keyboard.type("output")
    keys.to("Begin with these channels")
    keys.act("Enter", "Begin anew with these channels")  # its label has changed, its place has not
    page.wait_for_selector("text=Rows that are used")

    # a choice by arrows adds nothing yet
    keys.to("step to add")
    page.keyboard.type("fill")
    keys.to("Add")
    keys.act("Enter", "Add")
    page.wait_for_selector("text=Done: fill")
    keys.to("rows at most", "step 1", back=True)
    keys.write("2")
    page.wait_for_selector("text=Done: fill (most 2")
    keys.to("Remove step 1", "step 1")
    keys.act("Space", "Preparation")  # the step has gone, so its card has the focus

    keys.part("Model", "ArrowRight")
    keys.to("Remove term 1", "term 1")
    keys.act("Enter", "Remove term 1")  # of the next one
    keys.to("Add a term")
    keys.act("Enter", "Add a term")
    last = f"term {page.locator('.term').count()}"
    for key, told in (("unit", "1"), ("regressor", "left[k-1]*right[k-1]"), ("parameter", "own")):
        keys.to(key, last, back=True)
        keys.write(told)
    keys.checked('regressor = "left[k-1]*right[k-1]"')
    keys.to("learner")
    keys.act("ArrowDown", "learner")
    page.wait_for_selector("text=highest degree")
    keys.act("ArrowUp", "learner")
    keys.to("starts")
    keys.write("200")
    keys.to("iterations")
    keys.write("4000")
    keys.checked("iterations = 4000")
    keys.to("spec in TOML")
    keys.write("# by hand", "Control+End")
    keys.checked("# by hand")

    keys.part("Training", "ArrowRight")
    keys.to("Train")
    keys.act("Enter", "Train")  # the card: the button is off now
    page.wait_for_selector("text=iteration")
    keys.to("Stop")
    keys.act("Enter", "Train")
    page.wait_for_selector("text=Training was stopped")
    keys.part("Model", "ArrowLeft")
    for key, told in (("starts", "1"), ("iterations", "3")):
        keys.to(key)
        keys.write(told)
    keys.checked("iterations = 3")
    keys.part("Training", "ArrowRight")
    for name, told in (("Train", "Training is done"), ("Compare structures", "Comparison is done")):
        keys.to(name)
        keys.act("Enter", "Train")
        page.wait_for_selector(f"text={told}")

    keys.part("Report", "ArrowRight")
    frame = page.frame_locator("iframe")
    frame.locator("h1").wait_for()
    keys.to("report")
    keys.act("ArrowDown", "report")
    frame.locator("a:has-text('Models')").wait_for()
    keys.to("Download")
    keys.press("Tab")
    page.wait_for_function("document.activeElement.tagName === 'IFRAME'")
    while page.evaluate("document.activeElement.tagName") == "IFRAME":
        keys.press("Tab")  # and out of it again
    keys.part("Export", "ArrowRight")
    for target in ("c", "casadi"):
        keys.to(f"Write {target}")
        keys.act("Enter", f"{target}.zip")
        with page.expect_download() as came:
            keys.press("Enter")
        assert f"{target}/README.md" in zipfile.ZipFile(came.value.path()).namelist()
    tab.close()


@browsed
def test_what_is_wrong_is_reported_on_the_page(server, browser, csv, tmp_path):
    tab = Tab(browser, server)
    page = tab.page
    page.get_by_label("or its path").fill(str(tmp_path / "absent.csv"))
    page.get_by_role("button", name="Open").click()
    page.wait_for_selector("text=no such file")
    (tmp_path / "run.docx").write_text("no data")
    page.set_input_files("#dropped", tmp_path / "run.docx")
    page.wait_for_selector("text=unknown type of data file")
    tab.told.clear()  # the browser tells of the 422
    (tmp_path / "own.csv").write_text(csv.read_text().replace("u,y", "force,<i>way</i>"))
    page.get_by_label("or its path").fill(str(tmp_path / "own.csv"))
    page.get_by_label("or its path").press("Enter")
    page.get_by_label("use of force").select_option("input")
    page.get_by_label("use of <i>way</i>").select_option("output")
    page.get_by_role("button", name="Begin with these").click()
    page.wait_for_selector("text=first physics")
    tab.go("Model")
    tab.write(lambda text: text.replace("[learner]", "[learner"))
    assert "Broken TOML" in page.inner_text(".note.bad")
    broken = page.get_by_label("spec in TOML").input_value()
    tab.write(
        lambda _: (
            "learner = 3\nbaseline = 4\n[data]\ninputs = 1\noutputs = [2]\n[motion]\nstates = 5\n"
        )
    )
    assert page.locator(".q-notification").count() == 0  # forms read what they can
    tab.go("Training")
    assert page.get_by_role("button", name="Train").is_disabled()
    tab.go("Model")
    kept = tab.write(lambda _: broken.replace("[learner", "[learner]"))
    tab.go("Data")
    page.get_by_label("step to add").select_option("lowpass")
    page.get_by_role("button", name="Add", exact=True).click()
    page.wait_for_selector("text=Done: lowpass (cutoff 0.1")
    page.get_by_label("cutoff").fill("2")
    page.get_by_label("cutoff").press("Enter")
    page.wait_for_selector("text=2 Hz is not below")
    page.get_by_role("button", name="Remove step 1").click()
    own = page.inner_text(".head .hint")
    tab.drop(tmp_path / "own.csv")
    page.wait_for_selector("text=own.csv is not among them")
    assert (
        page.inner_text(".head .hint") == own
        and page.get_by_text("The names of the columns").count() == 0
    )
    assert [
        page.get_by_label(f"use of {name}").input_value() for name in ("force", "<i>way</i>")
    ] == [*("input", "output")]
    page.get_by_role("button", name="Use it as a test").click()
    page.wait_for_selector("text=tests.own")
    tab.go("Export")
    page.wait_for_selector("text=The spec names own.csv: keep the two in one folder")
    added = tab.fetch("spec.toml").decode()
    assert (
        tomllib.loads(added)["data"]["tests"].pop("own") == {"files": ["own.csv"]}
        and kept.splitlines()[0] in added
    )
    assert tab.get("spec.toml?show=true").headers["content-disposition"][:10] == "attachment"
    assert tab.fetch("../x") and tab.get("result.zip").status == 404
    gone = tab.context.request.get(f"{server.base}session/absent")
    assert gone.status == 404 and "This session has ended" in gone.text()
    tab.close()


@browsed
def test_a_wrong_sampling_time_is_reported_under_it_and_takes_nothing_away(
    server, browser, csv, tmp_path
):
    tab = Tab(browser, server)
    page = tab.page
    (tmp_path / "rig.csv").write_text(csv.read_text().replace("u,y", "left,right"))
    tab.drop(tmp_path / "rig.csv")
    tab.go("Model")
    page.wait_for_selector("text=Choose the channels in Data first")
    tab.go("Data")
    page.wait_for_selector("text=Proposed, since past values of 'left' help to predict 'right'")
    uses = [page.get_by_label(f"use of {name}").input_value() for name in ("left", "right")]
    assert uses == ["input", "output"] and page.locator(".editor textarea").count() == 0
    page.get_by_label("use of left").select_option("input")
    page.get_by_label("use of right").select_option("output")
    for wrong, told in (
        ("-1", "must be a positive number of seconds"),
        ("ten", "a number of seconds, such as 0.01"),
    ):
        page.get_by_label("sampling time").fill(wrong)
        page.get_by_role("button", name="Begin with these").click()
        page.wait_for_selector(f".q-field__messages:has-text('{told}')")
    page.get_by_label("sampling time").fill("0.5")
    page.get_by_role("button", name="Begin with these").click()
    page.wait_for_selector("text=first physics")
    assert [page.get_by_label(f"use of {name}").input_value() for name in ("left", "right")] == [
        "input",
        "output",
    ]
    assert page.get_by_label("sampling time").input_value() == "0.5"
    assert tomllib.loads(tab.fetch("spec.toml").decode())["data"]["sampling_time"] == 0.5

    # the parts stand in the history of the browser
    tab.go("Model")
    page.wait_for_function("location.hash === '#Model'")
    page.get_by_label("written as").select_option("motion")
    page.wait_for_selector("text=No unit is given for m, c, k")
    page.go_back()
    page.wait_for_selector("[role=tab][aria-selected=true]:has-text('Data')")
    page.go_forward()
    page.wait_for_selector("[role=tab][aria-selected=true]:has-text('Model')")
    tab.close()


def test_the_latest_specs_are_kept_whole(tmp_path, monkeypatch):
    monkeypatch.setattr("platformdirs.user_state_path", lambda name: tmp_path / name)
    for i in range(25):
        spec_text.keep(spec_text.kept_name("rig.csv", f"{i:012d}"[::-1]), f"restarts = {i}")
        os.utime(spec_text.earlier()[0], (i, i))
    spec_text.keep(spec_text.kept_name("rig.csv", f"{24:012d}"[::-1]), "restarts = 99")
    kept = spec_text.earlier()
    assert len(kept) == 20 and kept[0].read_text() == "restarts = 99"
    assert {spec_text.kept_title(place) for place in kept} == {"rig.csv"}
    assert [file.suffix for file in kept[0].parent.iterdir()] == [".toml"] * 20
    monkeypatch.setattr("platformdirs.user_state_path", lambda name: kept[0])  # no folder
    spec_text.keep("rig.csv-key", "restarts = 1")
    assert spec_text.earlier() == []


@browsed
def test_the_spec_of_a_server_that_was_killed_is_offered_by_the_next(serve, browser, csv, tmp_path):
    killed = serve(tmp_path)
    tab = Tab(browser, killed)
    assert "earlier work" not in tab.page.inner_text("body")
    tab.drop(csv)
    tab.page.wait_for_selector(".account")
    tab.go("Model")
    spec = tab.write(
        lambda text: text.replace("restarts = 3", "restarts = 7").replace("[learner]", "[learner")
    )
    assert '"plant.csv"' in spec and "Broken TOML" in tab.page.inner_text(".note.bad")
    killed.process.kill()
    killed.process.communicate()
    tab.leave()
    assert [p.stat().st_mode & 0o77 for p in (tmp_path / "state").rglob("*")] == [0, 0, 0]

    server = serve(tmp_path)
    tab = Tab(browser, server)
    tab.page.get_by_role("button", name="plant.csv, 20").click()
    tab.page.wait_for_selector(".head .hint:has-text('plant.csv')")
    tab.go("Model")
    tab.page.wait_for_selector("text=Broken TOML")
    assert tab.page.get_by_label("spec in TOML").input_value() == spec
    tab.write(lambda text: text.replace("[learner", "[learner]"))
    assert "plant.csv: no such file" in tab.page.inner_text(
        ".note.bad"
    )  # what was dropped is dropped again
    tab.go("Data")
    tab.drop(csv)
    tab.go("Model")
    tab.page.wait_for_selector(".note.good")
    tab.close()
    server.end()


@browsed
@pytest.mark.skipif(not os.path.exists("/proc/self/task"), reason="children are read from /proc")
def test_ctrl_c_leaves_nothing(serve, browser, csv, tmp_path):
    (tmp_path / "plant.toml").write_text(
        f'[data]\ninputs = ["u"]\noutputs = ["y"]\ntrain = {{ files = ["{csv.as_posix()}"] }}\n'
        '[[baseline.terms]]\nparameter = "a"\nregressor = "y[k-1]"\n[learner]\nhidden = [8]\n'
        "[training]\nrestarts = 200\niterations = 4000\nregularization = 0.0\n"
    )
    server = serve(tmp_path, tmp_path / "plant.toml")
    tab = Tab(browser, server)
    tab.go("Model")
    tab.page.wait_for_selector(".note.good")
    tab.go("Training")
    tab.page.get_by_role("button", name="Train").click()
    tab.page.wait_for_selector("text=reading and compiling")
    children = server.children()
    assert len(children) >= 2
    found = server.end()
    assert (server.process.returncode, found) == (0, "ended\n")
    assert [number for number in children if Path(f"/proc/{number}").exists()] == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["plant.toml"]
    tab.leave()
