"""What the program shows: lines that fit, nothing but text in pipes, a closed pipe, colours, the log."""

from __future__ import annotations

import io
import logging
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from rich.progress import TimeElapsedColumn, TimeRemainingColumn
from test_cli import SPEC, make_project, run
from typer.main import get_command

from orthaug._base.lines import (
    WIDTH,
    continued,
    estimate_cells,
    fit_screen,
    fold,
    narrow_screen,
    table,
)
from orthaug._base.progress import LOG, show_log
from orthaug.commands import bars, program, streams
from orthaug.inference.kinds import MEASURES

pytestmark = pytest.mark.usefixtures("without_figures")

COMMAND = [sys.executable, "-m", "orthaug"]
LEARNER = """kind = "mlp"
hidden = [3]
[training]
focus = "prediction"
iterations = 3
restarts = 2
[validation]
blocks = 0"""
LEARNS = SPEC.replace('kind = "none"', LEARNER)


@pytest.fixture(scope="module")
def project(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("project")
    make_project(folder, LEARNS)
    return folder


def fits(text: str) -> bool:
    return all(len(line) <= WIDTH for line in text.splitlines())


def test_every_summary_fits(project, monkeypatch):
    monkeypatch.chdir(project)
    for command in ("check", "fit"):
        options = [] if command == "check" else ["--out", f"out-{command}", "--force"]
        done = run(command, "plant.toml", *options)
        assert done.code == 0 and fits(done.out), command


def test_help_fits():
    names = ("fit", "predict", "track", "linearize", "reproduce")
    for arguments in (("--help",), *((name, "--help") for name in names)):
        assert fits(run(*arguments).out)


def test_help_names_arguments_as_one_types_them():
    for name in (name for names in program.GROUPS.values() for name in names):
        shown = run(name, "--help").out
        assert not re.search(r"[{}]|\[\[[A-Z]|<\w+|\.\.\.\]\.\.\.", shown), name
    assert "MODEL DATA...\n" in run("split", "--help").out
    for kind in MEASURES:
        assert kind in run("split", "--help").out


def test_help_cuts_no_line_of_a_command(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    output = run("--help").out.partition("Commands:")[2]
    assert "..." not in output and len(output.splitlines()) > 15


def test_every_command_is_in_one_group_and_has_an_example_that_it_accepts():
    group = get_command(program.app)
    assert sorted(name for names in program.GROUPS.values() for name in names) == sorted(
        group.commands  # type: ignore[attr-defined]
    )
    for name, command in group.commands.items():  # type: ignore[attr-defined]
        head, _, example = str(command.epilog).partition(": ")
        words = shlex.split(example)
        assert (head, words[:2]) == ("Example", ["orthaug", name])
        command.make_context(name, words[2:])  # an option or argument that is not there raises


def test_help_says_the_default_of_every_option_with_a_value():
    group = get_command(program.app)
    for name, command in group.commands.items():  # type: ignore[attr-defined]
        shown = " ".join(run(name, "--help").out.split())
        for option in command.params:
            if option.opts[0].startswith("--") and not (option.is_flag or option.required):
                entry = re.split(rf" {option.opts[0]} ", shown)[1]
                entry = re.split(r" --[a-z]", entry)[0]
                assert "default:" in entry, f"{name} {option.opts[0]}"


@pytest.mark.parametrize(("columns", "most"), [(80, 80), (200, 100), (0, 100), (20, 40)])
def test_lines_fit_a_terminal_that_is_narrower(columns, most, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    screen = io.StringIO()
    screen.isatty, screen.fileno = lambda: True, lambda: 1  # type: ignore[method-assign]
    monkeypatch.setattr(os, "get_terminal_size", lambda number: os.terminal_size((columns, 24)))
    monkeypatch.setattr(sys, "stdout", screen)
    words = " ".join(["word"] * 60)
    try:
        streams.prepare()
        folded = fold([words])
        assert most - len("word ") < max(map(len, folded)) <= most
    finally:
        fit_screen(0)
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    streams.prepare()
    assert fold([words]) == fold([words], WIDTH)


@pytest.mark.parametrize(("columns", "most"), [("80", 80), ("60", 60), ("none", WIDTH)])
def test_columns_hold_in_pipes(columns, most, project, monkeypatch):
    monkeypatch.setenv("COLUMNS", columns)
    try:
        streams.prepare()
        folded = fold([" ".join(["word"] * 60)])
        assert most - len("word ") < max(map(len, folded)) <= most
        for command in (
            ["check", "plant.toml"],
            ["compare", "plant.toml", "--out", "c", "--force"],
        ):
            monkeypatch.chdir(project)
            done = run(*command)
            wide = [line for line in done.out.splitlines() if len(line) > most]
            assert done.code == 0 and not wide, wide
    finally:
        fit_screen(0)


def test_tables_leave_columns_out_by_rank():
    rows = [["name", "value", "initial", "unit"], ["stiffness", "1.5", "2", "N/m"]]
    assert table(rows, 40, drop=["initial", "unit"])[0] == "name       value  initial  unit"
    assert table(rows, 24, drop=["initial", "unit"]) == [
        "name       value  unit",
        "stiffness    1.5  N/m",
    ]
    assert table(rows, 17, drop=["initial", "unit"])[0] == "name       value"


def test_long_products_go_on_in_a_row_below():
    rows = [["", "error", "s", "model"], ["→", "0.5", "1.0", "+ speed[k-1]*level[k-2]**2"]]
    with narrow_screen(30):
        assert table(continued(rows, drop=["s"])) == [
            "   error  model",
            "→    0.5  + speed[k-1]*",
            "          level[k-2]**2",
        ]


@pytest.mark.parametrize(
    ("value", "std", "ends"),
    [(1.0, 0.1, (0.8, 1.2)), (9.3e-5, 1e-6, (9.1e-5, 9.5e-5)), (1e9, 1e4, (0.99e9, 1.01e9))],
)
def test_value_and_interval_have_equal_decimals_that_show_the_standard_error(value, std, ends):
    shown, spread, *limits = estimate_cells(value, std, ends)
    decimals = {text.partition("e")[0].partition(".")[2] for text in (shown, *limits)}
    assert len({len(part) for part in decimals}) == 1
    assert abs(float(shown) - value) < 0.06 * std and float(spread) == pytest.approx(std, rel=0.06)
    assert [float(text) for text in limits] == pytest.approx(ends, abs=0.06 * std)


def test_sentences_and_cells_go_on_in_the_next_line():
    words = " ".join(["word"] * 40)
    folded = fold([f"warning: {words}", f"label       {words}", "x" * 150, "-1.5  " * 30])
    assert all(len(line) <= WIDTH for line in folded if "word" in line)
    assert folded[1].startswith("  word") and folded[-4].startswith(" " * 12 + "word")
    assert folded[-2:] == ["x" * 150, "-1.5  " * 30]
    assert " ".join(" ".join(folded[:3]).split()) == f"warning: {words}"


def test_wide_tables_stand_one_below_the_other():
    head = ["name", *(f"column {i}" for i in range(12)), "95 % interval"]
    lines = table([head, [f"cell {i}" for i in range(14)]])
    assert fits("\n".join(lines)) and "" in lines
    assert [line.split("  ")[0] for line in lines if line] == ["name", "cell 0"] * (
        len(lines) // 3 + 1
    )
    last = lines[lines.index("") + 1 :]
    assert "column 11" in last[0] and "95 % interval" in last[0]


def test_a_reader_that_leaves_is_no_error(project):
    reader, writer = os.pipe()
    os.close(reader)
    command = [*COMMAND, "schema", "fit"]
    try:
        done = subprocess.run(
            command, stdout=writer, stderr=subprocess.PIPE, cwd=project, timeout=60, check=False
        )
    finally:
        os.close(writer)
    assert (done.returncode, done.stderr) == (0, b"")


def test_pipes_hold_text_only(monkeypatch):
    """FORCE_COLOR, which build servers set, makes no terminal of a pipe."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert not bars.on_terminal() and bars.drawn_bar().disable


def test_bars_have_no_colours_where_none_are_wanted(monkeypatch):
    monkeypatch.setattr(bars, "on_terminal", lambda: True)
    monkeypatch.setenv("NO_COLOR", "1")
    assert bars.drawn_bar().live.console.no_color and not bars.drawn_bar().disable
    monkeypatch.delenv("NO_COLOR")
    assert not bars.drawn_bar().live.console.no_color


@pytest.fixture
def no_log():
    before = LOG.handlers[:]
    yield
    LOG.handlers[:], LOG.propagate = before, True
    LOG.setLevel(logging.NOTSET)


def test_the_log_says_the_stages_of_a_fit(project, monkeypatch, caplog, no_log):
    monkeypatch.chdir(project)
    monkeypatch.setattr(
        "orthaug.commands.fit.with_advice", lambda fitted: fitted
    )  # which fits other specs
    with caplog.at_level(logging.DEBUG, logger="orthaug"):
        assert run("fit", "plant.toml", "--out", "logged", "--force").code == 0
    found = [record.getMessage() for record in caplog.records if record.name == "orthaug"]
    assert found[0].startswith("training: 4 runs of LevenbergMarquardt, orthogonal")
    assert sum(
        "seed" in line and "iterations" in line for line in found
    ) == 4 and "run 1 of 4 is chosen" in " ".join(found)


def test_the_log_is_silent_until_somebody_listens(capsys, no_log):
    LOG.warning("unheard")
    assert capsys.readouterr() == ("", "")
    show_log("info")
    show_log("debug")  # once is enough
    LOG.info("heard")
    LOG.debug("unheard")
    assert capsys.readouterr().err.endswith("INFO heard\n") and len(LOG.handlers) == 2


def test_verbose(no_log):
    assert run("-v", "schema", "fit").code == 0 and LOG.level == logging.INFO


def test_what_the_log_may_be(monkeypatch, no_log):
    monkeypatch.setenv("ORTHAUG_LOG", "loud")
    done = run("schema", "fit")
    assert (done.code, done.out, done.err) == (
        2,
        "",
        "error: ORTHAUG_LOG must be one of info, debug; got 'loud'.\n",
    )


def test_a_number_and_its_per_cent_stay_on_one_line() -> None:
    assert fold(["The intervals of 95 % count noise"], width=19) == [
        "The intervals of",
        "  95 % count noise",
    ]


def test_a_bar_shows_brackets_and_fits_the_terminal(monkeypatch):
    text = "trials of advice: the term max(min(u[k-1], 1.514), -1.514) in the equation of v"
    monkeypatch.setattr(bars, "on_terminal", lambda: True)
    monkeypatch.setenv("COLUMNS", "80")
    bar = bars.drawn_bar(TimeElapsedColumn(), TimeRemainingColumn())
    bar.add_task(text, total=10, completed=3)
    with bar.console.capture() as shown:
        bar.console.print(bar.get_renderable())
    (line,) = shown.get().splitlines()
    assert line.startswith("trials of advice: the term max(min(u[k-1], ") and len(line) <= 80
