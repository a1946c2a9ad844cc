"""Studies: the order of their cases, what a stored result is found by, and that interrupted ones go on."""

from __future__ import annotations

import json
import math
import os
import runpy
import signal
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from orthaug import InputError
from orthaug.studies import study as study_module
from orthaug.studies.study import Study, as_table, run, runs

GRID = {"level": [0.1, 0.3], "seed": range(3)}


def one(level: float, seed: int) -> dict[str, float]:
    return {"value": level * seed}


def other(level: float, seed: int) -> dict[str, float]:
    return {"value": level + seed}


def counted(calls: list):
    def one(level: float, seed: int) -> dict[str, float]:
        calls.append((level, seed))
        return {"value": level * seed}

    return one


def test_the_last_axis_is_the_fastest():
    cases = Study("s", one, GRID).cases()
    assert [(c["level"], c["seed"]) for c in cases] == [
        (0.1, 0),
        (0.1, 1),
        (0.1, 2),
        (0.3, 0),
        (0.3, 1),
        (0.3, 2),
    ]


def test_where_leaves_combinations_out():
    study = Study("s", one, GRID, where=lambda level, seed: level < 0.2 or seed == 2)
    assert [(c["level"], c["seed"]) for c in study.cases()] == [
        (0.1, 0),
        (0.1, 1),
        (0.1, 2),
        (0.3, 2),
    ]
    assert len(run(study)) == 4


def test_numpy_axes_are_plain():
    study = Study("s", one, {"level": np.array([0.1, 0.3]), "seed": np.arange(3)})
    assert [study.key(case) for case in study.cases()] == [
        Study("s", one, GRID).key(c) for c in study.cases()
    ]
    assert run(study).value.tolist() == run(Study("s", one, GRID)).value.tolist()


def test_a_row_per_case_axes_first():
    table = run(Study("s", one, GRID))
    assert list(table.columns) == ["level", "seed", "value"]
    np.testing.assert_array_equal(table.value, table.level * table.seed)


def test_the_key_changes_with_everything_that_a_result_depends_on():
    case = {"level": 0.1, "seed": 0}
    keys = {
        Study("s", one, GRID).key(case),
        Study("t", one, GRID).key(case),
        Study("s", one, GRID, version=2).key(case),
        Study("s", other, GRID).key(case),
        Study("s", one, GRID).key(case | {"seed": 1}),
    }
    assert len(keys) == 5


def test_the_key_does_not_change_with_what_it_does_not_depend_on():
    case = {"level": 0.1, "seed": 0}
    key = Study("s", one, GRID).key(case)
    assert key == Study("s", one, {"level": [0.1], "seed": [0]}, workers=1).key(case)
    assert key == Study("s", one, GRID).key(dict(reversed(case.items())))


def test_the_key_counts_the_code_of_every_room(monkeypatch):
    read, read_bytes = [], Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: read.append(path) or read_bytes(path))
    study_module._sources.__wrapped__()
    assert {"_base", "data", "physics", "models", "fitting", "solvers", "studies"} <= {
        path.parent.name for path in read
    }


def test_a_function_without_a_text_has_a_key(tmp_path):
    study = Study("s", dict, {"a": [1, 2]})
    assert run(study, store=tmp_path).a.tolist() == [1, 2]


def test_only_what_is_missing_runs(tmp_path):
    calls = []
    study = Study("s", counted(calls), GRID)
    first = run(study, store=tmp_path)
    assert len(calls) == 6
    pd.testing.assert_frame_equal(run(study, store=tmp_path), first)
    assert len(calls) == 6
    next((tmp_path / "s").glob("*.json")).unlink()
    pd.testing.assert_frame_equal(run(study, store=tmp_path), first)
    assert len(calls) == 7


def test_a_larger_grid_runs_only_what_is_new(tmp_path):
    calls = []
    one = counted(calls)
    run(Study("s", one, GRID), store=tmp_path)
    run(Study("s", one, {"level": [0.1, 0.3], "seed": range(4)}), store=tmp_path)
    assert sorted(calls[6:]) == [(0.1, 3), (0.3, 3)]


def test_another_version_runs_all(tmp_path):
    calls = []
    one = counted(calls)
    run(Study("s", one, GRID), store=tmp_path)
    run(Study("s", one, GRID, version=2), store=tmp_path)
    assert len(calls) == 12


@pytest.mark.parametrize(
    "content",
    [
        "",
        '{"value": 0.',
        "[1, 2]",
        "\x00\x00",
        "null",
        "[" * 100_000,
        '{"value": 0.1}',
        '{"made": "", "seconds": 1, "result": 3}',
    ],
)
def test_cut_files_are_as_good_as_none(tmp_path, content):
    calls = []
    study = Study("s", counted(calls), GRID)
    first = run(study, store=tmp_path)
    for path in (tmp_path / "s").glob("*.json"):
        path.write_text(content, encoding="utf-8")
    pd.testing.assert_frame_equal(run(study, store=tmp_path), first)
    assert len(calls) == 12


@pytest.mark.parametrize(
    "alter",
    [
        lambda content: content["result"].update(value=1 + content["result"]["value"]),
        lambda content: content["result"].clear(),
        lambda content: content["result"].update(value=None),
        lambda content: content.update(seconds="long"),
        lambda content: content.pop("sha256"),
        lambda content: content.update(made=[[["deep"]]]),
    ],
)
def test_altered_records_are_made_again(tmp_path, alter):
    calls = []
    study = Study("s", counted(calls), GRID)
    first = run(study, store=tmp_path)
    for path in (tmp_path / "s").glob("*.json"):
        content = json.loads(path.read_text())
        alter(content)
        path.write_text(json.dumps(content))
    pd.testing.assert_frame_equal(run(study, store=tmp_path), first)
    assert len(calls) == 12


def test_without_a_store_nothing_is_kept(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    calls = []
    study = Study("s", counted(calls), GRID)
    run(study)
    run(study)
    assert len(calls) == 12 and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "value",
    [object(), {"a": 1}, 1j, {1, 2}, [1, object()], lambda: 0],
    ids=lambda value: type(value).__name__,
)
def test_results_must_be_plain(tmp_path, value):
    with pytest.raises(
        InputError, match=r"study 's': 'bad' is a .*; expected numbers, texts or lists"
    ):
        run(Study("s", lambda: {"bad": value}, {}), store=tmp_path)
    assert not list(tmp_path.rglob("*.json"))


def test_what_is_plain():
    result = {
        "a": np.float64(1.5),
        "b": np.arange(3),
        "c": (1, "x"),
        "d": None,
        "e": True,
        "f": np.eye(2),
    }
    row = run(Study("s", lambda: result, {})).iloc[0]
    assert row.a == 1.5 and row.b == [0, 1, 2] and row.c == [1, "x"] and row.d is None and row.e
    assert row.f == [[1.0, 0.0], [0.0, 1.0]]


@pytest.mark.parametrize("store", [True, False])
def test_what_is_not_finite_is_none(tmp_path, store):
    values = {"a": math.nan, "b": [1.0, math.inf], "c": np.array([-np.inf, 2.0])}
    study = Study("s", lambda: values, {})
    for _ in range(2):  # as made, and as read again
        row = run(study, store=tmp_path if store else None).iloc[0]
        assert row.a is None and row.b == [1.0, None] and row.c == [None, 2.0]


def test_stored_results_are_json_that_others_can_read(tmp_path):
    run(Study("s", lambda: {"a": math.nan, "b": "θ"}, {}), store=tmp_path)
    (path,) = (tmp_path / "s").iterdir()
    content = json.loads(
        path.read_text(encoding="utf-8"), parse_constant=lambda text: pytest.fail(text)
    )
    assert content["result"] == {"a": None, "b": "θ"}


def test_a_stored_result_keeps_when_it_was_made_and_how_long_it_took(tmp_path):
    def slow(seed: int) -> dict[str, int]:
        time.sleep(0.02)
        return {"value": seed}

    before = datetime.now(UTC).replace(microsecond=0)
    first = runs(Study("s", slow, {"seed": range(2)}), store=tmp_path)
    second = runs(Study("s", slow, {"seed": range(3)}), store=tmp_path)
    assert [one.stored for one in first] == [False, False] and [one.stored for one in second] == [
        True,
        True,
        False,
    ]
    assert all(before <= datetime.fromisoformat(one.made) <= datetime.now(UTC) for one in second)
    assert all(one.seconds >= 0.02 for one in second)
    assert [(one.made, one.seconds) for one in second[:2]] == [
        (one.made, one.seconds) for one in first
    ]
    # the table is the same whether results are new or stored
    pd.testing.assert_frame_equal(as_table(first), as_table(second[:2]))


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_workers_give_the_same_table(tmp_path, workers):
    def slow_first(level: float, seed: int) -> dict[str, float]:
        time.sleep(0.02 / (1 + seed))
        return {"value": level * seed}

    table = run(Study("s", slow_first, GRID), store=tmp_path, workers=workers)
    pd.testing.assert_frame_equal(table, run(Study("s", one, GRID)))


def test_a_study_says_how_many_run_at_a_time():
    running, most = 0, 0

    def one(seed: int) -> dict[str, int]:
        nonlocal running, most
        running += 1
        most = max(most, running)
        time.sleep(0.01)
        running -= 1
        return {"value": seed}

    run(Study("s", one, {"seed": range(6)}, workers=1))
    assert most == 1
    run(Study("s", one, {"seed": range(6)}, workers=1), workers=3)
    assert most > 1


def test_progress_counts_what_was_there(tmp_path):
    entries = []
    study = Study("s", one, GRID)
    run(
        study, store=tmp_path, workers=1, progress=lambda done, total: entries.append((done, total))
    )
    run(study, store=tmp_path, progress=lambda done, total: entries.append((done, total)))
    assert entries == [*((i, 6) for i in range(7)), (6, 6)]


def test_a_run_that_fails_keeps_the_others(tmp_path):
    def fails(seed: int) -> dict[str, int]:
        if seed == 3:
            raise ZeroDivisionError("seed 3")
        return {"value": seed}

    with pytest.raises(ZeroDivisionError, match="seed 3"):
        run(Study("s", fails, {"seed": range(5)}), store=tmp_path, workers=1)
    assert len(list((tmp_path / "s").glob("*.json"))) == 3


def test_ctrl_c_in_progress_keeps_what_is_done(tmp_path):
    def stop(done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    calls = []
    study = Study("s", counted(calls), GRID)
    with pytest.raises(KeyboardInterrupt):
        run(study, store=tmp_path, workers=1, progress=stop)
    run(study, store=tmp_path)
    assert len(calls) == 6


def test_a_store_that_cannot_be_written(tmp_path):
    (tmp_path / "s").write_text("a file")
    with pytest.raises(InputError, match="cannot be written"):
        run(Study("s", one, GRID), store=tmp_path)


PROGRAM = """
import signal, sys, time
from pathlib import Path
from orthaug.studies.study import Study, as_table, run, runs

if __name__ == "__main__":  # a process in the background may have inherited none
    signal.signal(signal.SIGINT, signal.default_int_handler)

def one(seed):
    time.sleep(0.05)
    sys.stdout.write(f"{seed}\\n")
    sys.stdout.flush()
    return {"value": [seed] * 200}

table = run(Study("s", one, {"seed": range(30)}), store=Path(sys.argv[1]), workers=2)
assert table.value.tolist() == [[seed] * 200 for seed in range(30)]
"""


@pytest.mark.parametrize(
    "end", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM], ids=lambda s: s.name
)
def test_ended_at_any_point_the_next_run_goes_on(tmp_path, end, monkeypatch, capsys):
    program, store = tmp_path / "program.py", tmp_path / "store"
    program.write_text(PROGRAM)
    command = [sys.executable, str(program), str(store)]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=dict(os.environ)
    )
    assert process.stdout is not None
    for _ in range(6):
        process.stdout.readline()
    process.send_signal(end)
    process.communicate(timeout=60)
    assert process.returncode != 0
    kept = {path: path.stat().st_mtime_ns for path in store.rglob("*.json")}
    assert 4 <= len(kept) < 30
    monkeypatch.setattr(sys, "argv", command[1:])
    runpy.run_path(str(program))
    assert len(capsys.readouterr().out.split()) == 30 - len(kept)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert len(list(store.rglob("*.json"))) == 30
