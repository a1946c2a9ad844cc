"""The commands at their edges: Ctrl-C of a real process, files that must be kept, time columns, rows and lines."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from test_cli import MAIN, SPEC, make_project, one_line, run, signals, write_csv
from test_cli import MLP as NETWORK

from orthaug import load, save

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")


@pytest.fixture
def project(tmp_path, monkeypatch) -> Path:
    """The spec of a project in a folder of its own, which is the current one."""
    monkeypatch.chdir(tmp_path)
    return make_project(tmp_path)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> Path:
    """A project with its fit of the physics alone; tests leave it as it is."""
    folder = tmp_path_factory.mktemp("fitted")
    assert run("fit", make_project(folder), "--out", folder / "out").code == 0
    return folder


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def refused(*arguments: object) -> str:
    """Standard error of a command that ends with exit code 2, one line, and leaves all files as they were."""
    before = contents(Path())
    done = run(*arguments)
    assert (done.code, done.out) == (2, ""), done
    assert one_line(done.err, "error: ")
    assert contents(Path()) == before
    return done.err


# --- Ctrl-C


def test_ctrl_c_of_a_real_process(tmp_path, tmp_path_factory):
    u, y = signals(20_000, 1)
    write_csv(tmp_path / "run.csv", u=u, y=y)
    long = 'kind = "mlp"\nhidden = [30, 10]\n[training]\niterations = 100000\nrestarts = 2\nregularization = "none"\n'
    tests = '[data.tests.steps]\nfiles = ["steps.csv"]\nskip = 5\n'
    (tmp_path / "plant.toml").write_text(SPEC.replace('kind = "none"\n', long).replace(tests, ""))
    cache = tmp_path_factory.mktemp("cache")
    before = contents(tmp_path)
    process = subprocess.Popen(
        [sys.executable, "-c", MAIN, "fit", "plant.toml", "--out", "deep/out"],
        cwd=tmp_path,
        env={**os.environ, "JAX_COMPILATION_CACHE_DIR": str(cache)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        patience = time.monotonic() + 60
        while (
            not list(cache.glob("*_advance*"))
            and time.monotonic() < patience
            and process.poll() is None
        ):
            time.sleep(0.1)
        time.sleep(3)  # compiled: iterations follow
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        began = time.monotonic()
        out, err = process.communicate(timeout=30)
        assert time.monotonic() - began < 5
    finally:
        process.kill()
    assert (process.returncode, out) == (130, "")
    assert one_line(
        err, "interrupted during run ", " of 2, iteration ", "loss ", "; nothing is written"
    )
    assert contents(tmp_path) == before
    assert not (tmp_path / "deep").exists()


# --- files that are read are kept


@pytest.mark.parametrize("command", ["fit", "compare"])
@pytest.mark.parametrize("inside", ["plant.toml", "run.csv", "steps.csv"])
def test_the_result_never_replaces_what_is_read(project, command, inside):
    assert run("fit", project, "--out", "out").code == 0
    for name in ("plant.toml", "run.csv", "steps.csv"):
        if name == inside or inside == "plant.toml":
            Path(name).rename(f"out/{name}")
            if inside != "plant.toml":
                project.write_text(SPEC.replace(f'"{name}"', f'"out/{name}"'))
    spec = "out/plant.toml" if inside == "plant.toml" else project
    Path("link").symlink_to("out")
    assert inside in refused(command, spec, "--out", "out") and inside in refused(
        command, spec, "--out", "link"
    )
    words = refused(command, spec, "--out", "out", "--force")
    assert f"out: holds {inside}, which this fit reads; give another folder" in words
    assert inside in refused(command, spec, "--out", "link", "--force")


@pytest.mark.parametrize("command", ["simulate", "predict"])
def test_the_output_never_replaces_what_is_read(fitted, tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    u, y = signals(60, 2)
    write_csv(Path("data.csv"), u=u, y=y)
    write_csv(Path("init.csv"), y=y[:2])
    Path("link.csv").symlink_to("data.csv")
    for out in ("data.csv", "./data.csv", tmp_path / "data.csv", "link.csv"):
        assert "is read by this run; give another name" in refused(
            command, fitted / "out", "data.csv", "--out", out
        )
    message = refused(
        command, fitted / "out", "data.csv", "--initial", "init.csv", "--out", "init.csv"
    )
    assert "init.csv: is read by this run" in message
    assert (
        run(command, fitted / "out", "data.csv", "--initial", "init.csv", "--out", "other.csv").code
        == 0
    )


@pytest.mark.parametrize("command", ["simulate", "predict"])
def test_an_output_column_that_stands_twice_is_not_taken_as_absent(
    fitted, tmp_path, monkeypatch, command
):
    monkeypatch.chdir(tmp_path)
    Path("twice.csv").write_text("u,y,y\n" + "1,2,3\n4,5,7\n" * 5)
    assert "twice.csv: the header has the column 'y' 2 times; names must differ" in refused(
        command, fitted / "out", "twice.csv"
    )


# --- time columns


def timed(path: str, step: float, start: float = 0.0, seed: int = 2) -> np.ndarray:
    u, y = signals(60, seed)
    t = start + step * np.arange(60)
    write_csv(Path(path), t=t, u=u, y=y)
    return t


@pytest.fixture
def timed_model(project):
    timed("run.csv", 0.1, start=3.0, seed=1)
    timed("steps.csv", 0.10005, start=100.0)  # the same to 0.1 %
    project.write_text(SPEC.replace("sampling_time = 0.5", 'time = "t"'))
    done = run("fit", project, "--out", "out")
    assert (done.code, done.err) == (0, "")
    return "out"


def test_the_instants_of_the_file_are_written(timed_model):
    t = timed("new.csv", 0.1, start=7.5)
    for command in ("simulate", "predict"):
        done = run(command, timed_model, "new.csv")
        assert done.code == 0 and "FIT %" in done.err  # the CSV is on standard output
        np.testing.assert_allclose(pd.read_csv(io.StringIO(done.out))["time"], t, rtol=0, atol=1e-9)


def test_the_step_of_the_time_column_is_checked(project, timed_model):
    for step in (0.1002, 0.2, 0.05):
        timed("new.csv", step)
        for command in ("simulate", "predict"):
            message = refused(command, timed_model, "new.csv")
            assert "sampled every" in message and f"{step:g} s" in message and "0.1 s" in message
    u, y = signals(60, 2)
    write_csv(Path("new.csv"), u=u, y=y)
    assert "new.csv: no column 't'" in refused("simulate", timed_model, "new.csv")
    timed("steps.csv", 0.1002)
    assert "tests.steps: sampled every 0.1002 s, the training data every 0.1 s" in refused(
        "fit", project
    )


# --- --initial of predict


def test_initial_of_predict(fitted, tmp_path):
    u, y = signals(60, 2)
    theta, data = load(fitted / "out").theta, fitted / "steps.csv"
    write_csv(tmp_path / "same.csv", y=y[:2])
    write_csv(tmp_path / "other.csv", y=np.array([7.0, -3.0]))

    def predicted(*options: object) -> pd.DataFrame:
        done = run("predict", fitted / "out", data, *options)
        assert done.code == 0 and done.err.startswith("1 step ahead")
        return pd.read_csv(io.StringIO(done.out))

    measured = predicted()["y_model"]
    for options in (("--initial", "measured"), ("--initial", tmp_path / "same.csv")):
        np.testing.assert_array_equal(predicted(*options)["y_model"], measured)
    for options, first in ((("zero",), (0.0, 0.0)), ((tmp_path / "other.csv",), (7.0, -3.0))):
        model = predicted("--initial", *options)["y_model"]
        np.testing.assert_allclose(model[2], theta @ [first[1], first[0], u[1]], rtol=1e-12)
        np.testing.assert_allclose(model[3], theta @ [y[2], first[1], u[2]], rtol=1e-12)
        np.testing.assert_array_equal(model[4:], measured[4:])  # measured from there on
    assert "measured" in run("predict", fitted / "out", data, "--initial", "mesured").err


# --- rows and lines


def with_a_negative_input(path: str, row: int, rows: int, seed: int) -> None:
    """An input above 0 everywhere but in one data row."""
    u, y = signals(rows, seed)
    u = np.abs(u) + 0.1
    u[row] = -2.0
    write_csv(Path(path), u=u, y=y)


def test_a_test_part_on_which_an_expression_has_no_value(project):
    with_a_negative_input("run.csv", 0, 120, 1)  # before the first row that is used
    project.write_text(
        SPEC.replace('"u[k-1]"', '"log(u[k-1])"').replace(
            '["run.csv"]', '["run.csv"], rows = [1, 120]'
        )
    )
    with_a_negative_input("steps.csv", 59, 60, 2)  # the last row is no regressor of any
    assert run("fit", project, "--out", "out").code == 0
    with_a_negative_input("steps.csv", 10, 60, 2)
    message = refused("fit", project)
    assert (
        "steps.csv: line 13 (row 11): the regressor of c (log(u[k-1])) is not finite there"
        in message
    )
    learner = 'kind = "mlp"\nhidden = [4]\ninputs = ["log(u[k-1])"]\n'
    project.write_text(
        SPEC.replace('kind = "none"\n', learner).replace(
            '["run.csv"]', '["run.csv"], rows = [1, 120]'
        )
    )
    message = refused("fit", project)
    assert (
        "steps.csv: line 13 (row 11): the learner input log(u[k-1]) is not finite there" in message
    )


@pytest.mark.parametrize("part", ["train", "test"])
def test_lines_where_only_some_rows_are_kept(project, part):
    """Row 31 is the seventh that `every = 3` keeps of `rows = [10, 100]`; the row after it, 34, lacks a value."""
    spec = SPEC.replace('"u[k-1]"', '"log(u[k-1])"').replace(
        '["run.csv"] }', '["run.csv"], rows = [10, 100], every = 3 }'
    )
    project.write_text(spec.replace("skip = 5", "rows = [10, 100]\nevery = 3"))
    with_a_negative_input("run.csv", 31 if part == "train" else 32, 120, 1)
    with_a_negative_input("steps.csv", 31 if part == "test" else 32, 120, 2)
    name = "run.csv" if part == "train" else "steps.csv"
    assert f"{name}: line 36 (row 34): the regressor of c" in refused("check", project)
    lines = Path(name).read_text().splitlines()
    lines[35] = lines[35].partition(",")[0] + ",high"
    Path(name).write_text("\n".join(lines))
    with_a_negative_input("steps.csv" if part == "train" else "run.csv", 32, 120, 3)
    assert f"{name}: line 36 (row 34), column 'y': found 'high'" in refused("check", project)


# --- strange numbers and names


def test_seeds(project):
    for seed, word in ((2**63, "less than"), (10**30, "less than"), (2**63 - 1, "below 2**63")):
        project.write_text(SPEC.replace('kind = "none"\n', NETWORK + f"seed = {seed}\n"))
        message = refused("fit", project)
        assert "plant.toml" in message and "seed" in message and word in message
    project.write_text(SPEC.replace('kind = "none"\n', NETWORK + f"seed = {2**63 - 2}\n"))
    assert run("fit", project).code == 0


def extreme(project: Path, column: str, size: float, learner: str) -> None:
    u, y = signals(120, 1)
    for name in ("run", "steps"):
        write_csv(Path(f"{name}.csv"), **{"u": u, "y": y, column: {"u": u, "y": y}[column] * size})
    project.write_text(SPEC.replace('kind = "none"\n', learner))


@pytest.mark.parametrize("learner", ['kind = "none"\n', NETWORK], ids=["none", "mlp"])
@pytest.mark.parametrize(
    ("column", "size"), [("u", 1e-320), ("y", 1e-320), ("y", 1e-200), ("y", 1e200), ("y", 1e307)]
)
def test_columns_too_large_or_too_small(project, column, size, learner):
    extreme(project, column, size, learner)
    assert "scale" in refused("fit", project)


@pytest.mark.parametrize("learner", ['kind = "none"\n', NETWORK], ids=["none", "mlp"])
@pytest.mark.parametrize("size", [1e-200, 1e200, 1e307])
def test_inputs_of_extreme_size_are_refused_or_right(project, size, learner):
    """A warning of NumPy's is an error in this suite, and lines on standard error for a user."""
    extreme(project, "u", size, learner)
    done = run("fit", project, "--json")
    if done.code == 2:
        assert one_line(done.err, "scale")
        return
    assert (done.code, done.err) == (0, "")
    u, y = signals(120, 1)
    theta = np.linalg.lstsq(np.stack([y[1:-1], y[:-2], u[1:-1]], axis=1), y[2:], rcond=None)[0]
    parameters = json.loads(done.out)["parameters"]
    np.testing.assert_allclose(
        [p["value"] for p in parameters] / np.array([1, 1, 1 / size]), theta, rtol=1e-8
    )
    assert all(p["std"] > 0 for p in parameters)


LONG = "x" * 300


@pytest.mark.parametrize(
    "arguments",
    [
        ("fit", f"{LONG}.toml"),
        ("check", f"{LONG}.toml"),
        ("compare", f"{LONG}.toml"),
        ("fit", "plant.toml", "--out", LONG),
        ("fit", "plant.toml", "--out", f"{LONG}/out"),
        ("compare", "plant.toml", "--out", LONG),
        ("compare", "plant.toml", "--model", LONG),
        ("demo", "--out", LONG),
        ("simulate", LONG, "run.csv"),
        ("simulate", "M", f"{LONG}.csv"),
        ("simulate", "M", "run.csv", "--out", f"{LONG}.csv"),
        ("simulate", "M", "run.csv", "--out", f"{LONG}/out.csv"),
        ("simulate", "M", "run.csv", "--initial", LONG),
        ("predict", "M", "run.csv", "--initial", f"{LONG}.csv"),
    ],
    ids=lambda arguments: " ".join(a.replace(LONG, "x…") for a in arguments),
)
def test_names_of_300_characters(project, fitted, arguments):
    assert "xxx" in refused(*(fitted / "out" if a == "M" else a for a in arguments))


def test_data_files_of_300_characters(project):
    project.write_text(SPEC.replace("run.csv", f"{LONG}.csv"))
    assert "cannot be read" in refused("fit", project)


@pytest.mark.parametrize(
    "column",
    ["u[²]", "u[-1]", "u[]", "u[1.0]", "u[9]", "u[99999999999999999999]", "u[0][0]", "[0]"],
)
def test_columns_of_matrices(project, column):
    u, y = signals(120, 1)
    np.savez("run.npz", u=np.stack([u, u], 1), y=y)
    extra = f'[data.channels.u]\ncolumn = "{column}"\n'
    project.write_text(SPEC.replace('"run.csv"', '"run.npz"') + extra)
    message = refused("fit", project)
    assert "run.npz" in message and ("counted from 0" in message or "no variable" in message)


def test_a_table_of_many_lags_fits_the_screen(tmp_path):
    rng = np.random.default_rng(1)
    inputs = [f"valve_{j}" for j in range(3)]
    columns = {name: rng.normal(size=300) for name in [*inputs, "y"]}
    pd.DataFrame(columns).to_csv(tmp_path / "run.csv", index=False)
    lags = [f"{name}[k-{i}]" for name in ["y", *inputs] for i in range(1, 5)]
    terms = [
        f'[[baseline.terms]]\nparameter = "p{n}"\nregressor = "{lag}"' for n, lag in enumerate(lags)
    ]
    data = f'inputs = {json.dumps(inputs)}\noutputs = ["y"]\ntrain.files = ["run.csv"]'
    learner = '[learner]\nkind = "mlp"\nhidden = [4]'
    text = "\n".join(["[data]", "sampling_time = 1", data, *terms, learner])
    (tmp_path / "spec.toml").write_text(text, encoding="utf-8")
    shown = run("check", tmp_path / "spec.toml").out.splitlines()
    assert max(map(len, shown)) <= 100
    begin = next(i for i, line in enumerate(shown) if "with learner.inputs" in line)
    end = shown.index("", begin)
    for head, listed in (("with learner.inputs", lags[4:]), ("determined beside it", ["p4", "p5"])):
        at = shown[begin].index(head)
        cells = [line[at : at + 30].split("  ")[0].strip() for line in shown[begin + 1 : end]]
        assert ", ".join(listed) in " ".join(cells)


@pytest.mark.parametrize(
    "text", ["[" * 100_000, "[" * 100_000 + "]" * 100_000, '{"a":' * 100_000 + "1" + "}" * 100_000]
)
def test_a_declaration_nested_too_deeply(tmp_path, monkeypatch, text):
    monkeypatch.chdir(tmp_path)
    Path("model").mkdir()
    Path("model/model.json").write_text(text)
    Path("model/arrays.safetensors").write_bytes(b"")
    Path("data.csv").write_text("u,y\n1,2\n3,4\n")
    assert "model.json: the file is cut or altered" in refused("simulate", "model", "data.csv")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (('outputs = ["y"]', 'outputs = ["y", "time"]'), "an output cannot be called 'time'"),
        (('outputs = ["y"]', 'outputs = ["y", "y_model"]'), "an output cannot be called 'y_model'"),
        (
            ("[learner]", "[baseline.constants]\nu = 2.0\n[learner]"),
            "'u' is a constant and a channel",
        ),
        (
            ("[learner]", "[baseline.constants]\ny = 2.0\n[learner]"),
            "'y' is a constant and a channel",
        ),
        (
            ('parameter = "c"', 'parameter = "c\\nd"'),
            "cannot name a parameter; use letters, digits",
        ),
        (('parameter = "c"', 'parameter = "  "'), "cannot name a parameter"),
        (
            ('["run.csv"] }', '["run.csv"], rows = [[0, 60], [50, 120]] }'),
            "the row ranges [0, 60] and [50, 120] overlap",
        ),
        (('"u[k-1]"', '"u[k-1] # + 1"'), "'#' is not allowed in an expression"),
        (('"u[k-1]"', '"u[k-100001]"'), "lags up to 100000 are read"),
        (('kind = "none"', "[lags]\nna = 100001"), "`na` must be at most 100000; got 100001"),
    ],
)
def test_more_refusals(project, change, words):
    u, y = signals(120, 1)
    write_csv(Path("run.csv"), u=u, y=y, time=y**2, y_model=y**2)
    assert change[0] in SPEC
    project.write_text(SPEC.replace(*change).replace("regressor", 'output = "y"\nregressor'))
    message = refused("check", project)
    assert words in message
    assert "plant.toml" in message or "run.csv" in message


# --- files that are not read at once


@pytest.mark.parametrize("command", ["simulate", "predict"])
def test_a_long_file_is_written_piece_by_piece(fitted, tmp_path, monkeypatch, command):
    """The table and the scores are those of the file read at once; a run that leaves all bounds ends in both."""
    pytest.importorskip("pyarrow")
    rng = np.random.default_rng(3)
    pd.DataFrame({"u": rng.uniform(-1, 1, 500), "y": rng.normal(size=500)}).to_parquet(
        tmp_path / "long.parquet"
    )
    monkeypatch.chdir(tmp_path)
    whole = run(command, fitted / "out", "long.parquet", "--out", "whole.csv")
    monkeypatch.setattr("orthaug.commands.long_run.LONG", 100)
    monkeypatch.setattr("orthaug.data.parquet_source.BATCH_ROWS", 64)
    pieces = run(command, fitted / "out", "long.parquet", "--out", "pieces.csv")
    assert (whole.code, pieces.code, whole.err) == (0, 0, pieces.err)
    assert pieces.out == whole.out.replace("whole.csv", "pieces.csv")
    pd.testing.assert_frame_equal(
        pd.read_csv("pieces.csv"), pd.read_csv("whole.csv"), rtol=1e-9, atol=1e-12
    )
    streamed = run(command, fitted / "out", "long.parquet")
    assert streamed.out == Path("pieces.csv").read_text(encoding="utf-8")
    assert run(command, fitted / "out", "long.parquet", "--out", "long.parquet").code == 2


def test_a_long_run_that_leaves_all_bounds_has_no_more_values(fitted, tmp_path, monkeypatch):
    pytest.importorskip("pyarrow")
    model = load(fitted / "out")
    numbers = model.numbers._replace(
        theta=np.array([1.2, 0.0, 0.5]), theta_aux=np.zeros_like(model.theta)
    )
    save(replace(model, numbers=numbers), tmp_path / "wild")
    rng = np.random.default_rng(3)
    pd.DataFrame({"u": rng.uniform(-1, 1, 300), "y": rng.normal(size=300)}).to_parquet(
        tmp_path / "l.parquet"
    )
    monkeypatch.chdir(tmp_path)
    whole = run("simulate", "wild", "l.parquet", "--out", "whole.csv")
    monkeypatch.setattr("orthaug.commands.long_run.LONG", 100)
    monkeypatch.setattr("orthaug.data.parquet_source.BATCH_ROWS", 32)
    pieces = run("simulate", "wild", "l.parquet", "--out", "pieces.csv")
    assert "the free run diverged in output 'y' at step" in whole.err and pieces.err == whole.err
    pd.testing.assert_frame_equal(pd.read_csv("pieces.csv"), pd.read_csv("whole.csv"), rtol=1e-6)
