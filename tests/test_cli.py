"""The commands as their users rely on them: output, files, exit codes, and one worded line for every bad input."""

from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest

import orthaug
from orthaug import load, read_record
from orthaug.commands import cli
from orthaug.fitting.solvers import compiled
from orthaug.fitting.status import Ending

SPEC = """
[data]
sampling_time = 0.5
inputs = ["u"]
outputs = ["y"]
train = { files = ["run.csv"] }
[data.tests.steps]
files = ["steps.csv"]
skip = 5
[data.channels.y]
unit = "m"
[[baseline.terms]]
parameter = "a"
regressor = "y[k-1]"
initial = 0.5
unit = "1"
[[baseline.terms]]
parameter = "b"
regressor = "y[k-2]"
[[baseline.terms]]
parameter = "c"
regressor = "u[k-1]"
[learner]
kind = "none"
"""
MAIN = "from orthaug.commands.cli import main; main()"
MLP = 'kind = "mlp"\nhidden = [4]\n[training]\niterations = 5\n'
RESULT_KEYS = {
    *(
        "schema",
        "orthaug",
        "spec",
        "data",
        "status",
        "restarts",
        "parameters",
        "physical_parameters",
        "structure",
    ),
    *(
        "measure",
        "orthogonality_defect",
        "excitation",
        "scores",
        "bias",
        "residuals",
        "validation",
        "warnings",
    ),
}


class Done(NamedTuple):
    """How a command ended."""

    code: int
    out: str
    err: str


def run(*arguments: object) -> Done:
    """The command in this process, with standard output and error caught."""
    out, err = io.StringIO(), io.StringIO()
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        patch.setattr(sys, "argv", ["orthaug", *map(str, arguments)])
        patch.setattr(
            "orthaug._base.jax.keep_programs", lambda: None
        )  # the cache on disk is tested by subprocesses
        with pytest.raises(SystemExit) as stop:
            cli.main()
    return Done(stop.value.code, out.getvalue(), err.getvalue())  # type: ignore[arg-type]


def listing(folder: Path) -> list[str]:
    """Everything below a folder, hidden files too."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def signals(rows: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A damped system with a square that the physics does not know."""
    rng = np.random.default_rng(seed)
    u, y = rng.uniform(-1, 1, rows), np.zeros(rows)
    for k in range(2, rows):
        y[k] = 0.6 * y[k - 1] - 0.2 * y[k - 2] + 0.5 * u[k - 1] + 0.2 * u[k - 1] ** 2
    return u, y + 0.001 * rng.normal(size=rows)


def write_csv(path: Path, **columns: np.ndarray) -> None:
    pd.DataFrame(columns).to_csv(path, index=False)


def make_project(folder: Path, spec: str = SPEC) -> Path:
    """A spec with its two data files; returns the spec's path."""
    for name, rows, seed in (("run", 120, 1), ("steps", 60, 2)):
        u, y = signals(rows, seed)
        write_csv(folder / f"{name}.csv", u=u, y=y)
    (folder / "plant.toml").write_text(spec)
    return folder / "plant.toml"


pytestmark = pytest.mark.usefixtures("without_trials")


@pytest.fixture(autouse=True)
def _only_what_tests_share_is_drawn(monkeypatch):
    monkeypatch.setattr("orthaug.commands.fit._draw", lambda *_: None)


@pytest.fixture
def project(tmp_path, monkeypatch) -> Path:
    """The spec of a project in a folder of its own, which is the current one."""
    monkeypatch.chdir(tmp_path)
    return make_project(tmp_path)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> Path:
    """The folder of a project whose fits lie in `physics` and `mlp`; tests leave it as it is."""
    folder = tmp_path_factory.mktemp("fitted")
    spec = make_project(folder)
    assert run("fit", spec, "--out", folder / "physics").code == 0
    (folder / "net.toml").write_text(SPEC.replace('kind = "none"\n', MLP))
    assert run("fit", folder / "net.toml", "--out", folder / "mlp").code == 0
    return folder


@pytest.fixture(scope="module")
def demo(tmp_path_factory) -> tuple[Done, Path]:
    """The demo with one restart of each structure, for θ of the orthogonal one is that of all.

    The additive one, of which only a line is printed, is trained for a few iterations.
    """
    from orthaug.commands import demo as command

    folder = tmp_path_factory.mktemp("demo")
    with pytest.MonkeyPatch.context() as patch:
        several = f"restarts = {command.RESTARTS}\n"
        assert command.RESTARTS > 1 and several in command.SPEC
        patch.setattr(command, "SPEC", command.SPEC.replace(several, "restarts = 1\n"))
        patch.setattr(command, "RESTARTS", 1)
        few = orthaug.LevenbergMarquardt(10)
        patch.setattr(command, "estimate", partial(orthaug.estimate, solver=few))
        return run("demo", "--out", folder / "out"), folder / "out"


def finite_json(text: str):
    """JSON that holds neither NaN nor Infinity."""

    def refuse(name: str):
        raise AssertionError(f"{name} in JSON")

    return json.loads(text, parse_constant=refuse)


def shell(*arguments: object, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own, its compilation cache below `cwd`."""
    settings = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(cwd / "cache"), **environment}
    command = [sys.executable, "-c", MAIN, *map(str, arguments)]
    return subprocess.run(
        command, cwd=cwd, env=settings, capture_output=True, text=True, timeout=120, check=False
    )


# --- help and version


def test_version():
    assert run("--version") == (0, f"orthaug {orthaug.__version__}\n", "")


def test_help_lists_the_commands():
    done = run("--help")
    assert (done.code, done.err) == (0, "")
    for command in ("demo", "check", "fit", "compare", "simulate", "predict"):
        assert f"\n  {command} " in done.out


def test_without_a_command_the_help_page_is_no_error_message():
    done = run()
    assert done.code in (0, 2)
    assert "Usage" in done.out + done.err
    assert "error:" not in done.err


@pytest.mark.parametrize("command", ["demo", "check", "fit", "compare", "simulate", "predict"])
def test_every_command_has_help(command):
    done = run(command, "--help")
    assert (done.code, done.err) == (0, "")
    assert "--help" in done.out


def test_help_and_bad_input_import_no_jax(project):
    program = """
import sys
import runpy
for arguments in (["--help"], ["fit", "absent.toml"], ["fit", "plant.toml"], ["check", "plant.toml"]):
    sys.argv[1:] = arguments
    try:
        runpy.run_module("orthaug", run_name="__main__")
    except SystemExit as stop:
        print("ended", stop.code, "jax" in sys.modules)
"""
    project.write_text(SPEC.replace("u[k-1]", "v[k-1]"))
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=project.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    ends = [line for line in done.stdout.splitlines() if line.startswith("ended ")]
    assert ends == ["ended 0 False", *["ended 2 False"] * 3], done.stderr


# --- demo


def test_demo_prints_the_comparison(demo):
    done, _ = demo
    assert (done.code, done.err) == (0, "")
    for words in (
        "true",
        "initial",
        "orthogonal",
        "additive",
        "theta1",
        "theta3",
        "relative error of θ",
        "RMSE",
    ):
        assert words in done.out
    assert "0.471698" in done.out
    assert done.out.rstrip().endswith("out")


def test_the_demo_keeps_files_that_only_look_like_a_result(tmp_path):
    """A `result.json` with two keys and known names beside it, but no manifest: an edited copy of someone's own."""
    for name, text in (
        ("result.json", '{"schema": 1, "orthaug": "0"}'),
        ("train.csv", "mine"),
        ("spec.toml", "mine"),
    ):
        (tmp_path / name).write_text(text)
    done = run("demo", "--out", tmp_path)
    assert done.code == 2 and one_line(
        done.err, "holds result.json and no manifest.json", "--force"
    )
    assert (tmp_path / "train.csv").read_text() == (tmp_path / "spec.toml").read_text() == "mine"


def test_demo_leaves_a_complete_result(demo):
    _, out = demo
    names = {path.name for path in out.iterdir()}
    assert {"result.json", "model", "figures", "spec.toml", "train.csv", "test.csv"} <= names
    assert len(list((out / "figures").glob("*.png"))) >= 3
    result = finite_json((out / "result.json").read_text(encoding="utf-8"))
    assert result["structure"] == "orthogonal"
    assert result["orthogonality_defect"] <= 1e-12
    assert result["status"]["code"] == "converged" and result["status"]["message"] == ""
    expected = [0.471697779, -0.471758489, 4.76104182e-5]
    np.testing.assert_allclose([p["value"] for p in result["parameters"]], expected, rtol=2e-9)
    assert result["scores"]["tests.uniform"]["prediction"]["rmse"][0] <= 2.0e-5
    assert load(out).structure == "orthogonal"
    assert listing(out.parent)[0] == "out"


def test_the_spec_of_the_demo_can_be_checked(demo):
    done = run("check", demo[1] / "spec.toml")
    assert (done.code, done.err) == (0, "")
    assert "theta1, theta2, theta3" in done.out


# --- check


def test_check(project):
    before = listing(project.parent)
    done = run("check", project)
    assert (done.code, done.err) == (0, "")
    assert "a, b, c" in done.out
    assert "y[k-1], y[k-2], u[k-1]" in done.out
    assert "118" in done.out
    assert "rank 3 of 3" in done.out
    assert "can be distinguished" in done.out
    assert listing(project.parent) == before


def test_check_json(project):
    report = finite_json(run("check", project, "--json").out)
    assert report["parameters"] == ["a", "b", "c"]
    assert report["excitation"]["rank"] == report["excitation"]["columns"] == 3
    assert report["excitation"]["condition"] > 1
    assert report["identifiability"]["identifiable"] is True
    assert report["data"]["train"][0]["rows"] == 120
    assert report["warnings"] == []


DEPENDENT = [  # a third regressor, whether its parameter can be identified by any data, and what is said
    ("2*y[k-1] - y[k-2]", False, "inseparable by any data: a, b, c"),
    ("0*u[k-1]", False, "inseparable by any data: c"),
    ("max(u[k-1] - 1.2, 0)", True, "not excited separately by these data: c"),
]


@pytest.mark.parametrize(("regressor", "identifiable", "words"), DEPENDENT)
def test_check_of_rank_deficient_physics_reports_and_exits_with_2(
    project, regressor, identifiable, words
):
    project.write_text(SPEC.replace('"u[k-1]"', f'"{regressor}"'))
    done = run("check", project)
    assert done.code == 2
    assert words in done.out
    assert "rank 2 of 3 on the data" in done.out
    assert one_line(done.err, "plant.toml", "rank-deficient")
    done = run("check", project, "--json")
    report = finite_json(done.out)
    assert done.code == 2
    assert report["excitation"] | {"collinear": []} == {
        "rank": 2,
        "columns": 3,
        "condition": None,
        "collinear": [],
    }
    assert report["identifiability"]["identifiable"] is identifiable
    project.write_text(
        project.read_text().replace('kind = "none"', 'hidden = [2]\ninputs = ["y[k-1]"]')
    )
    shared = finite_json(run("check", project, "--json").out)["shared"]
    assert "c" not in shared["determined"]  # it was, "with any learner of these inputs"


def test_check_warns_of_rows_left_out(project):
    project.write_text(SPEC.replace('["run.csv"] }', '["run.csv"], every = 2 }'))
    done = run("check", project)
    assert done.code == 2  # the tests are sampled otherwise
    assert one_line(done.err, "tests.steps", "sampled every 0.5 s")
    project.write_text(
        SPEC.replace('["run.csv"] }', '["run.csv"], every = 2 }').replace("skip = 5", "every = 2")
    )
    done = run("check", project)
    assert done.code == 0
    assert "warning: train: one row in 2 is kept without a filter" in done.out


# --- fit


def test_fit_writes_the_folder_of_the_contract(fitted):
    for name in ("physics", "mlp"):
        out = fitted / name
        assert {path.name for path in out.iterdir()} >= {"result.json", "model", "figures"}
        assert sorted(path.name for path in (out / "model").iterdir()) == [
            "arrays.safetensors",
            "model.json",
        ]
        assert all(path.read_bytes().startswith(b"\x89PNG") for path in (out / "figures").iterdir())
        assert list((out / "figures").iterdir())
    assert not [name for name in listing(fitted) if "partial" in name or "-old-" in name]


def test_result_of_physics_alone(fitted):
    result = finite_json((fitted / "physics" / "result.json").read_text(encoding="utf-8"))
    assert set(result) >= RESULT_KEYS
    assert (result["schema"], result["orthaug"]) == (2, orthaug.__version__)
    assert result["spec"]["data"]["outputs"] == ["y"]
    files = result["data"]["train"]
    assert [(f["file"], f["rows"], len(f["sha256"])) for f in files] == [("run.csv", 120, 64)]
    assert result["status"]["code"] == "exact"
    assert result["status"]["iterations"] == 0
    assert result["validation"] is None and result["bias"] and result["residuals"]["verdict"]
    assert [entry["certificate"] for entry in result["bias"]] == [None] * len(
        result["bias"]
    )  # of none that is named
    assert result["orthogonality_defect"] is None
    assert result["excitation"]["rank"] == 3
    assert [(p["name"], p["unit"], p["initial"]) for p in result["parameters"]] == [
        ("a", "1", 0.5),
        ("b", "", 0.0),
        ("c", "", 0.0),
    ]
    for p in result["parameters"]:
        assert p["ci95"][0] < p["value"] < p["ci95"][1]
        assert p["std"] > 0
    assert set(result["scores"]) == {"train", "tests.steps"}
    for kinds in result["scores"].values():
        for kind in ("prediction", "simulation"):
            (rmse,), (nrmse,), (percent,) = (kinds[kind][key] for key in ("rmse", "nrmse", "fit"))
            assert 0 < rmse < 1
            assert percent == pytest.approx(100 * (1 - nrmse))


def test_the_values_are_least_squares_and_its_textbook_errors(fitted):
    u, y = signals(120, 1)
    phi = np.stack([y[1:-1], y[:-2], u[1:-1]], axis=1)
    theta, rss, *_ = np.linalg.lstsq(phi, y[2:], rcond=None)
    std = np.sqrt(np.diag(rss[0] / (118 - 3) * np.linalg.inv(phi.T @ phi)))
    parameters = finite_json((fitted / "physics" / "result.json").read_text())["parameters"]
    np.testing.assert_allclose([p["value"] for p in parameters], theta, rtol=1e-10)
    # what this physics lacks makes its errors uneven: the robust errors stand there, the textbook's beside them
    np.testing.assert_allclose([p["plain_std"] for p in parameters], std, rtol=1e-8)


def test_result_of_a_network(fitted):
    result = finite_json((fitted / "mlp" / "result.json").read_text(encoding="utf-8"))
    alone = finite_json((fitted / "physics" / "result.json").read_text(encoding="utf-8"))
    assert (result["structure"], result["measure"]) == ("orthogonal", "training")
    assert result["status"]["code"] in ("converged", "iteration_limit")
    assert result["orthogonality_defect"] <= 1e-12
    (restart,) = result["restarts"]
    assert (restart["seed"], restart["chosen"]) == (0, True)
    assert restart["loss"] == pytest.approx(result["status"]["loss"])
    np.testing.assert_allclose(
        *[[p["value"] for p in r["parameters"]] for r in (result, alone)], rtol=1e-10
    )
    assert (
        result["scores"]["train"]["prediction"]["rmse"]
        < alone["scores"]["train"]["prediction"]["rmse"]
    )


def test_scores_are_the_library_s(fitted):
    model = load(fitted / "mlp")
    record = read_record(fitted / "steps.csv", inputs=["u"], outputs=["y"], sampling_time=0.5)
    scores = finite_json((fitted / "mlp" / "result.json").read_text())["scores"]["tests.steps"]
    for kind, response in (
        ("prediction", model.predict(record)),
        ("simulation", model.simulate(record)),
    ):
        found = response.scores(5)
        assert scores[kind] == {key: list(getattr(found, key)) for key in ("rmse", "nrmse", "fit")}
        error = response.model[5:, 0] - record.experiments[0].outputs[5:, 0]
        assert scores[kind]["rmse"][0] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-12)


def test_fit_prints_a_summary_and_writes_to_its_default_folder(project):
    done = run("fit", project)
    assert (done.code, done.err) == (0, "")
    for words in (
        "parameter",
        "95 % interval",
        "tests.steps",
        "simulation",
        "RMSE",
        "FIT %",
        "orthaug-out/plant",
    ):
        assert words in done.out
    assert (project.parent / "orthaug-out" / "plant" / "result.json").is_file()


def test_fit_json_prints_what_is_written(project):
    done = run("fit", project, "--json", "--out", "out")
    assert (done.code, done.err) == (0, "")
    assert finite_json(done.out) == finite_json(Path("out/result.json").read_text(encoding="utf-8"))


def test_a_result_is_replaced_whole(project):
    assert run("fit", project, "--out", "out").code == 0
    Path("out/stale.txt").write_text("from the run before")
    project.write_text(SPEC.replace('parameter = "c"', 'parameter = "gain"'))
    done = run("fit", project, "--out", "out")
    assert done.code == 2 and one_line(done.err, "error: out: holds stale.txt", "--force")
    assert run("fit", project, "--out", "out", "--force").code == 0
    assert not Path("out/stale.txt").exists()
    assert "gain" in Path("out/result.json").read_text()
    assert listing(project.parent)[:2] == ["out", "out/figures"]


@pytest.mark.parametrize("inside", ["plant.toml", "run.csv"])
def test_a_result_that_holds_the_spec_or_its_data_is_not_replaced(project, inside):
    """The demo's folder does: fitting its spec into it would remove what is being read."""
    assert run("fit", project, "--out", "out").code == 0
    Path(inside).rename(f"out/{inside}")
    if inside == "run.csv":
        project.write_text(SPEC.replace('"run.csv"', '"out/run.csv"'))
    else:
        for name in ("run", "steps"):
            Path(f"{name}.csv").rename(f"out/{name}.csv")
    done = run("fit", "out/plant.toml" if inside == "plant.toml" else project, "--out", "out")
    assert Path(f"out/{inside}").exists()
    assert done.code == 2
    assert one_line(done.err, "error: out", inside)


def test_several_files_ranges_and_parts(project):
    text = SPEC.replace(
        'files = ["run.csv"]', 'files = ["run.csv", "steps.csv"], rows = [[0, 30], [40, 60]]'
    )
    project.write_text(text + '[data.tests.late]\nfiles = ["run.csv"]\nrows = [60, 120]\n')
    result = finite_json(run("fit", project, "--json").out)
    assert [(f["file"], f["rows"]) for f in result["data"]["train"]] == [
        ("run.csv", 50),
        ("steps.csv", 50),
    ]
    assert set(result["scores"]) == {"train", "tests.steps", "tests.late"}


def test_a_relative_path_starts_at_the_spec(project, tmp_path_factory, monkeypatch):
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    assert run("fit", os.path.relpath(project), "--out", "out").code == 0
    assert Path("out/result.json").exists()


def test_a_constant_test_output_has_no_fit_but_a_sentence(project):
    write_csv(project.parent / "steps.csv", u=np.linspace(0, 1, 30), y=np.zeros(30))
    done = run("fit", project, "--json")
    result = finite_json(done.out)
    assert done.code == 0
    assert result["scores"]["tests.steps"]["prediction"]["nrmse"] is None
    assert any(
        w["code"] == "constant_output" and "tests.steps" in w["text"] for w in result["warnings"]
    )


def test_a_free_run_that_diverges_is_no_error(project):
    rng = np.random.default_rng(0)
    u = rng.normal(size=60)
    y = np.zeros(60)
    for k in range(1, 60):
        y[k] = 1.1 * y[k - 1] + u[k - 1]
    write_csv(project.parent / "run.csv", u=u, y=y)
    write_csv(project.parent / "steps.csv", u=rng.normal(size=400), y=rng.normal(size=400))
    project.write_text(
        SPEC.replace('[[baseline.terms]]\nparameter = "b"\nregressor = "y[k-2]"\n', "")
    )
    done = run("fit", project, "--out", "out")
    assert (done.code, done.err) == (0, "")
    result = finite_json(Path("out/result.json").read_text(encoding="utf-8"))
    assert result["parameters"][0]["value"] == pytest.approx(1.1)
    scores = result["scores"]["tests.steps"]
    assert scores["simulation"] == {"rmse": None, "nrmse": None, "fit": None}
    assert scores["prediction"]["rmse"][0] > 0
    assert result["scores"]["train"]["simulation"]["rmse"][0] >= 0
    (warning,) = (w["text"] for w in result["warnings"] if w["code"] == "free_run_diverged")
    for words in ("tests.steps", "diverged", "'y'", "step ", "no simulation scores"):
        assert words in warning
    assert "diverged" in done.out
    done = run("simulate", "out", "steps.csv", "--out", "free.csv")
    assert done.code == 0
    assert one_line(done.err, "warning", "diverged", "'y'", "step ")
    frame = pd.read_csv("free.csv")
    assert frame["y_model"].notna().any()
    assert np.isnan(frame["y_model"].iloc[-1])
    assert np.isfinite(frame["y_model"].dropna()).all()


def small_run(monkeypatch, ending):
    """The solver's compiled loop replaced by one that ends as told."""
    original = compiled.minimize_compiled

    def minimize(*args):
        return ending(lambda: original(*args), args[-1].progress)

    monkeypatch.setattr(compiled, "minimize_compiled", minimize)


@pytest.mark.parametrize("as_json", [True, False])
def test_training_that_fails_leaves_an_account_without_a_model(project, monkeypatch, as_json):
    project.write_text(SPEC.replace('kind = "none"\n', MLP))
    small_run(monkeypatch, lambda go, _: go()._replace(ending=Ending.NON_FINITE))
    done = run("fit", project, "--out", "out", *(["--json"] if as_json else []))
    assert done.code == 1
    assert one_line(
        done.err, "training failed", "not finite", "Rescale the channels", "result.json"
    )
    assert listing(Path("out")) == ["manifest.json", "result.json"]
    result = finite_json(Path("out/result.json").read_text(encoding="utf-8"))
    assert result["status"]["code"] == "non_finite"
    assert result["status"]["message"]
    assert [p["value"] for p in result["parameters"]] == [None] * 3
    assert set(result) >= RESULT_KEYS
    assert run("simulate", "out", "steps.csv").code == 2


def interrupt(_, progress):
    progress(3, 40.0)
    raise KeyboardInterrupt


@pytest.mark.parametrize("before", [False, True])
def test_ctrl_c_during_training_leaves_nothing(project, monkeypatch, before):
    if before:
        assert run("fit", project, "--out", "deep/out").code == 0
    project.write_text(SPEC.replace('kind = "none"\n', MLP + "restarts = 2\n"))
    small_run(monkeypatch, interrupt)
    kept = {path: path.read_bytes() for path in project.parent.rglob("*") if path.is_file()}
    done = run("fit", project, "--out", "deep/out")
    assert (done.code, done.out) == (130, "")
    assert one_line(
        done.err, "interrupted", " of 4", "iteration 3", "nothing is written"
    )  # whichever thread was first
    assert {path: path.read_bytes() for path in project.parent.rglob("*") if path.is_file()} == kept
    assert before or not Path("deep").exists()


def test_ctrl_c_while_the_demo_trains(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small_run(monkeypatch, interrupt)
    done = run("demo", "--out", "out")
    assert done.code == 130
    assert one_line(done.err, "interrupted", "nothing is written")
    assert listing(tmp_path) == []


def test_ctrl_c_while_the_result_is_written(project, monkeypatch):
    def fail(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("orthaug.commands.fit._draw", fail)
    before = listing(project.parent)
    done = run("fit", project, "--out", "out")
    assert done.code == 130
    assert one_line(done.err, "interrupted")
    assert listing(project.parent) == before


# --- simulate and predict


@pytest.mark.parametrize("model", ["mlp", "mlp/model"])
@pytest.mark.parametrize(
    ("command", "first"),
    [(["simulate"], 2), (["predict", "--horizon", "1"], 2), (["predict", "--horizon", "7"], 8)],
)
def test_responses_have_a_row_per_data_row_and_the_library_s_numbers(
    fitted, tmp_path, model, command, first
):
    done = run(*command, fitted / model, fitted / "steps.csv", "--out", tmp_path / "out.csv")
    assert (done.code, done.err) == (0, "")
    frame = pd.read_csv(tmp_path / "out.csv")
    flag = ["extrapolates"] if command == ["simulate"] else []
    assert list(frame.columns) == ["time", "y", "y_model", "y_baseline", "y_learner", *flag]
    assert len(frame) == 60
    np.testing.assert_allclose(frame["time"], 0.5 * np.arange(60))
    assert frame["y"].notna().all()
    for column in ("y_model", "y_baseline", "y_learner"):
        assert frame[column].isna().tolist() == [row < first for row in range(60)]
    record = read_record(fitted / "steps.csv", inputs=["u"], outputs=["y"], sampling_time=0.5)
    whole = load(fitted / "mlp")
    response = (
        whole.simulate(record)
        if command == ["simulate"]
        else whole.predict(record, int(command[-1]))
    )
    np.testing.assert_array_equal(frame["y_model"], response.model[:, 0])
    np.testing.assert_array_equal(frame["y_learner"], response.trajectories[0].learner[:, 0])
    np.testing.assert_array_equal(frame["y"], record.experiments[0].outputs[:, 0])
    assert (tmp_path / "out.csv").read_text().splitlines()[1].endswith(",,,")
    output, scored, scores = done.out.splitlines(), f"{60 - first} rows", response.scores()
    assert scored in output[0] and output[2] == f"written to {tmp_path / 'out.csv'}"
    rmse, nrmse, percent = (f"{v[0]:.6g}" for v in (scores.rmse, scores.nrmse, scores.fit))
    assert output[1].split() == ["y", rmse, "m", nrmse, percent]
    assert listing(tmp_path) == ["out.csv"]


def test_standard_output_without_a_file(fitted):
    done = run("simulate", fitted / "physics", fitted / "steps.csv")
    assert done.code == 0 and done.err.startswith(
        "free run, 58 rows"
    )  # the scores stay out of the CSV
    frame = pd.read_csv(io.StringIO(done.out))
    assert len(frame) == 60
    np.testing.assert_allclose(frame["y_learner"].dropna(), 0.0)


def test_predict_is_one_step_by_default(fitted):
    arguments = ("predict", fitted / "physics", fitted / "steps.csv")
    assert run(*arguments).out == run(*arguments, "--horizon", 1).out


def simulated(*arguments: object) -> np.ndarray:
    done = run("simulate", *arguments)
    assert done.code == 0
    return pd.read_csv(io.StringIO(done.out))["y_model"].to_numpy()


def test_initial_values(fitted, tmp_path):
    model, data = fitted / "physics", fitted / "steps.csv"
    u, y = signals(60, 2)
    write_csv(tmp_path / "u.csv", u=u)
    write_csv(tmp_path / "lags.csv", y=y[:2])
    measured, zero = simulated(model, data), simulated(model, data, "--initial", "zero")
    np.testing.assert_array_equal(simulated(model, data, "--initial", "measured"), measured)
    np.testing.assert_array_equal(
        simulated(model, data, "--initial", tmp_path / "lags.csv"), measured
    )
    np.testing.assert_array_equal(
        simulated(model, tmp_path / "u.csv", "--initial", tmp_path / "lags.csv"), measured
    )
    np.testing.assert_array_equal(simulated(model, tmp_path / "u.csv"), zero)
    assert not np.array_equal(measured[2:], zero[2:])
    theta = load(model).theta
    assert zero[2] == pytest.approx(theta[2] * u[1])
    assert measured[2] == pytest.approx(theta @ [y[1], y[0], u[1]])


def test_without_measured_outputs_there_is_no_measured_column(fitted, tmp_path):
    write_csv(tmp_path / "u.csv", u=np.ones(10))
    done = run("simulate", fitted / "mlp", tmp_path / "u.csv")
    assert (
        done.err
        == f"note: {tmp_path / 'u.csv'} has no y: the free run starts from 0; --initial CSV "
        "gives other outputs.\n"
    )
    frame = pd.read_csv(io.StringIO(done.out))
    assert list(frame.columns) == ["time", "y_model", "y_baseline", "y_learner", "extrapolates"]


def test_channels_keep_their_column_and_scale(project):
    u, y = signals(120, 1)
    for name in ("run", "steps"):
        write_csv(project.parent / f"{name}.csv", **{"u (mV)": 1000 * u, "y": y})
    project.write_text(SPEC + '[data.channels.u]\ncolumn = "u (mV)"\nscale = 0.001\n')
    assert run("fit", project, "--out", "out").code == 0
    write_csv(Path("plain.csv"), **{"u (mV)": 1000 * u})
    expected = load("out").theta[2] * u[1]
    assert simulated("out", "plain.csv")[2] == pytest.approx(expected)


# --- bad input: exit code 2, one line, nothing on disk


def one_line(text: str, *words: str) -> bool:
    """One line on standard error that holds all the words; no traceback."""
    assert text.count("\n") == 1, text
    assert text.endswith("\n")
    assert "Traceback" not in text
    assert "(None)" not in text
    for word in words:
        assert word in text
    return True


def data(rows: str, header: str = "u,y") -> dict[str, str]:
    return {"run.csv": f"{header}\n{rows}"}


ROWS = "".join(f"{(k * 7) % 5},{(k * 3) % 11}\n" for k in range(20))
BAD = {  # what is put in the place of files ("" replaces a piece of the spec), and words of the message
    "missing column": (data(ROWS, "u,position"), ["run.csv", "no column 'y'", "'position'"]),
    "unequal lengths": (
        data(ROWS + "1,\n"),
        [
            *("run.csv", "line 22 (row 20)", "'y': the cell is empty", "'u' goes on to row 20"),
            '`missing = "skip"` in [data] leaves such rows out.',
        ],
    ),
    "NaN cell": (
        data(ROWS + "1,NaN\n3,4\n"),
        ["run.csv", "line 22 (row 20)", "column 'y'", "'NaN'", "finite number"],
    ),
    "inf cell": (
        data(ROWS + "-inf,1\n3,4\n"),
        ["run.csv", "line 22 (row 20)", "column 'u'", "'-inf'"],
    ),
    "text in a number column": (
        data(ROWS + "1,high\n3,4\n"),
        ["line 22 (row 20)", "column 'y'", "'high'"],
    ),
    "empty cell": (data(ROWS + ",1\n3,4\n"), ["line 22 (row 20)", "column 'u'", "empty"]),
    "fewer rows than parameters": (
        data("1,2\n2,5\n3,3\n4,4\n"),
        ["plant.toml", "2 usable rows for 3 parameters"],
    ),
    "fewer rows than lags": (data("1,2\n2,5\n"), ["run.csv", "2 rows, too few", "3"]),
    "constant input": (data(ROWS.replace(",", ",7,"), "u0,u,y"), ["'u' is constant (7)"]),
    "constant output": (data("".join(f"{k % 3},5\n" for k in range(20))), ["'y' is constant (5)"]),
    "0-byte file": ({"run.csv": ""}, ["run.csv", "0 bytes"]),
    "blank file": ({"run.csv": "\n\n"}, ["run.csv", "blank lines"]),
    "header only": ({"run.csv": "u,y\n"}, ["run.csv", "no data rows"]),
    "binary file": ({"run.csv": "\0\x01\x02"}, ["run.csv", "UTF-8 text"]),
    "wrong file type": (
        {"": ('["run.csv"]', '["plant.toml"]')},
        ["plant.toml", "unknown file type '.toml'", ".csv"],
    ),
    "missing file": ({"": ('["run.csv"]', '["absent.csv"]')}, ["absent.csv", "no such file"]),
    "unknown channel": (
        {"": ("u[k-1]", "v[k-1]")},
        ["plant.toml", "'c'", "unknown channel 'v'", "y, u"],
    ),
    "unknown function": (
        {"": ("u[k-1]", "sgn(u[k-1])")},
        ["unknown function 'sgn'", "did you mean 'sign'"],
    ),
    "code": ({"": ("u[k-1]", "__import__('os').remove('run.csv')")}, ["'c'", "not allowed"]),
    "attribute": ({"": ("u[k-1]", "u[k-1].real")}, ["'c'", "not allowed"]),
    "look-ahead": ({"": ("u[k-1]", "u[k+1]")}, ["plant.toml", "'u[k+1]'", "looks ahead"]),
    "output at lag 0": (
        {"": ("y[k-2]", "y[k]")},
        ["'y[k]' is the output that is to be predicted", "y[k-1]"],
    ),
    "learner input at lag 0": (
        {"": ('kind = "none"', 'inputs = ["y[k]"]')},
        ["learner input", "'y[k]' is the output that is to be predicted"],
    ),
    "learner input unknown": (
        {"": ('kind = "none"', 'inputs = ["w[k]"]')},
        ["learner input", "channel 'w'"],
    ),
    "learner input missing": (
        {"": ('kind = "none"', "inputs = []")},
        ["the learner has no inputs; give `inputs` such as y[k-1]"],
    ),
    "lags for other channels": (
        {"": ('kind = "none"', "[lags]\nna = [1, 1]")},
        ["`na` has 2 numbers for 1 output;"],
    ),
    "unknown key": (
        {"": ("skip = 5", "skipp = 5")},
        ["plant.toml", "data.tests.steps.skipp", "did you mean 'skip'"],
    ),
    "missing key": ({"": ('outputs = ["y"]', "")}, ["plant.toml", "'data.outputs' is missing"]),
    "wrong value": (
        {"": ("skip = 5", 'skip = "5 s"')},
        ["plant.toml", "'data.tests.steps.skip'", '"5 s"', "integer"],
    ),
    "broken TOML": ({"": ("[data]", "[data")}, ["plant.toml", "broken TOML", "line 2"]),
    "channel twice": (
        {"": ('inputs = ["u"]', 'inputs = ["u", "y"]')},
        ["plant.toml", "channel 'y' is given twice"],
    ),
    "channel with a strange name": (
        {"": ('inputs = ["u"]', 'inputs = ["u 1"]')},
        ["plant.toml", "'u 1' cannot name"],
    ),
    "scale of zero": (
        {"": ('unit = "m"', "scale = 0")},
        ["plant.toml", "channel 'y'", "`scale` must be finite"],
    ),
    "rank-deficient": (
        {"": ("u[k-1]", "2*y[k-1]")},
        ["plant.toml", "rank-deficient", "a, c are linearly dependent"],
    ),
    "term without a value": (
        {"": ("u[k-1]", "log(u[k-1])")},
        ["run.csv: line 5 (row 3)", "the regressor of c", "not finite"],
    ),
    "rows beyond the end": (
        {"": ('["run.csv"]', '["run.csv"], rows = [0, 500]')},
        ["run.csv", "[0, 500]", "120 data"],
    ),
    "test part too short": (
        {"steps.csv": "u,y\n1,2\n1,3\n"},
        ["steps.csv", "data.tests.steps", "2 rows, too few"],
    ),
    "test part of one row": (
        {
            "steps.csv": "u,y\n1,2\n",
            "": ("skip = 5", "rows = [0, 1]"),
        },
        ["steps.csv", "has 1 row, too few; "],
    ),
    "skip longer than the part": (
        {"": ("skip = 5", "skip = 60")},
        ["steps.csv", "60 rows, too few", "first 60"],
    ),
    "columns of an unknown channel": (
        {"": ("skip = 5", 'columns = { z = "y" }')},
        ["plant.toml", "data.tests.steps.columns", "'z' is neither an input nor an output"],
    ),
    "lists of columns of different lengths": (
        {"": ("skip = 5", 'columns = { u = ["u", "u"], y = ["y"] }')},
        ["data.tests.steps", "u has 2, y has 1", "one column for all"],
    ),
    "an empty list of columns": (
        {"": ("skip = 5", "columns = { u = [] }")},
        ["data.tests.steps", "a list of `columns` is empty"],
    ),
}


def spoil(project: Path, changes: dict) -> None:
    for name, content in changes.items():
        if name:
            (project.parent / name).write_text(content)
        else:
            assert content[0] in SPEC
            project.write_text(SPEC.replace(*content))


@pytest.mark.parametrize("command", ["fit", "check"])
@pytest.mark.parametrize(("changes", "words"), BAD.values(), ids=BAD.keys())
def test_bad_input(project, command, changes, words):
    spoil(project, changes)
    before = listing(project.parent)
    done = run(command, project, *(["--out", "deep/out"] if command == "fit" else []))
    assert done.code == 2
    assert one_line(done.err, "error: ", *words)
    assert done.out == "" or "usable rows" in done.out  # `check` reports before it refuses
    assert listing(project.parent) == before


@pytest.mark.parametrize(
    "name", ["missing column", "broken TOML", "unknown channel", "0-byte file"]
)
def test_bad_input_of_a_spec_in_the_current_folder(project, name):
    """Relative paths: the message still names spec or data file."""
    changes, words = BAD[name]
    spoil(project, changes)
    assert one_line(run("fit", project.name).err, "error: ", *words)


ARGUMENTS = [
    (["fit"], ["Missing argument 'SPEC'"]),
    (["simulate", "out"], ["Missing argument 'DATA'"]),
    (["fit", "absent.toml"], ["absent.toml", "no such file"]),
    (["check", "absent.toml"], ["absent.toml", "no such file"]),
    (["fit", "."], ["not a file"]),
    (["fit", "run.csv"], ["run.csv: found a data file", "`orthaug init run.csv` writes"]),
    (["fit", "plant.toml", "--outt", "x"], ["No such option", "--outt"]),
    (["fit", "plant.toml", "more"], ["unexpected extra argument", "more"]),
    (["fit", "plant.toml", "--out"], ["--out", "requires an argument"]),
    (["fot"], ["No such command 'fot'", "fit"]),
    (["compare", "absent.toml"], ["absent.toml", "no such file"]),
    (["compare", "plant.toml", "--out", "theirs"], ["theirs", "no manifest.json"]),
    (
        ["compare", "plant.toml", "--out", "x", "--model", "theirs"],
        ["theirs", "no saved model there"],
    ),
    (["design", "plant.toml"], ["Missing option", "--out"]),
    (["export", "out", "--to", "c"], ["Missing option", "--out"]),
    (["reproduce", "static_eror"], ["no study", "static_errors"]),
    (["fit", "plant.toml", "--out", "run.csv"], ["run.csv", "not a folder"]),
    (
        ["fit", "plant.toml", "--out", "run.csv/out"],
        ["run.csv/out", "cannot be written", "is not a folder"],
    ),
    (["fit", "plant.toml", "--out", "theirs"], ["theirs", "no manifest.json"]),
    (["fit", "plant.toml", "--out", "."], ["no manifest.json"]),
    (["demo", "--out", "theirs"], ["theirs", "no manifest.json"]),
    (["demo", "--out", "run.csv/out"], ["run.csv/out", "cannot be written"]),
    (["simulate", "absent", "run.csv"], ["absent", "no saved model there"]),
    (["simulate", "theirs", "run.csv"], ["theirs", "no saved model there"]),
    (["predict", "absent", "run.csv", "--horizon", "2"], ["absent", "no saved model there"]),
]


@pytest.mark.parametrize(
    ("arguments", "words"), ARGUMENTS, ids=[" ".join(a) or "nothing" for a, _ in ARGUMENTS]
)
def test_bad_arguments(project, arguments, words):
    Path("theirs").mkdir()
    Path("theirs/result.json").write_text('{"schema": "of another tool"}')
    before = listing(project.parent)
    done = run(*arguments)
    assert (done.code, done.out) == (2, "")
    assert one_line(done.err, "error: ", *words)
    assert listing(project.parent) == before


RUNS = [
    (
        ["predict", "M", "D", "--horizon", "0"],
        ["`horizon` must be a whole number of steps, 1 or more; got 0"],
    ),
    (["predict", "M", "D", "--horizon", "-1"], ["1 or more; got -1"]),
    (
        ["predict", "M", "D", "--horizon", "two"],
        ["--horizon: found 'two'; expected a whole number, such as 3."],
    ),
    (["simulate", "M", "D", "--every", "2.5"], ["--every: found '2.5'; expected a whole number"]),
    (
        ["track", "M", "--data", "D", "--memory", "long"],
        ["--memory: found 'long'; expected a number, such as 0.5."],
    ),
    (["simulate", "M", "inf.csv"], ["found 'inf'", "where its sample is missing. --missing skip"]),
    (["init", "inf.csv"], ["found 'inf'", "empty it where its sample is missing."]),
    (["predict", "M", "D", "--horizon", "59"], ["steps.csv", "60 rows, too few"]),
    (["predict", "M", "u.csv", "--horizon", "1"], ["u.csv", "no column 'y'"]),
    (["simulate", "M", "y.csv"], ["y.csv", "no column 'u'"]),
    (["simulate", "M", "absent.csv"], ["absent.csv", "no such file"]),
    (["simulate", "M", "short.csv"], ["short.csv", "2 rows, too few"]),
    (["simulate", "M", "nan.csv"], ["nan.csv", "line 3 (row 1)", "column 'u'"]),
    (["simulate", "M", "nan_y.csv"], ["nan_y.csv", "line 3 (row 1)", "column 'y'"]),
    (["simulate", "M", "empty.csv"], ["empty.csv", "0 bytes"]),
    (
        ["simulate", "M", "u.csv", "--initial", "measured"],
        ["u.csv", "no measured outputs", "--initial zero"],
    ),
    (["simulate", "M", "u.csv", "--initial", "absent.csv"], ["absent.csv", "no such file"]),
    (["simulate", "M", "u.csv", "--initial", "mesured"], ["mesured", "measured, zero"]),
    (["simulate", "M", "u.csv", "--initial", "u.csv"], ["u.csv", "no column 'y'"]),
    (["simulate", "M", "u.csv", "--initial", "one.csv"], ["one.csv", "1 row", "2"]),
    (["simulate", "M", "D", "--out", "absent/out.csv"], ["absent/out.csv", "cannot be written"]),
    (["simulate", "M", "D", "--out", "u.csv/out.csv"], ["u.csv/out.csv", "cannot be written"]),
    (["simulate", "M", "D", "--out", "folder"], ["folder", "is a folder"]),
    (["simulate", "M", "D", "--out", "."], ["is a folder"]),
    (["simulate", "cut", "D"], ["cut", "model.json", "cut or altered"]),
]


@pytest.mark.parametrize(
    ("arguments", "words"), RUNS, ids=[" ".join(arguments) for arguments, _ in RUNS]
)
def test_bad_runs(fitted, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    contents = {
        "u.csv": "u\n" + "1\n2\n" * 10,
        "y.csv": "y\n" + "1\n2\n" * 10,
        "short.csv": "u,y\n1,2\n3,4\n",
        "nan.csv": "u,y\n1,2\nNaN,4\n5,6\n7,8\n",
        "inf.csv": "u,y\n1,2\n2,inf\n5,6\n7,8\n",
        "nan_y.csv": "u,y\n1,2\n1,NaN\n5,6\n7,8\n",
        "one.csv": "y\n1\n",
        "empty.csv": "",
    }
    for name, content in contents.items():
        Path(name).write_text(content)
    for folder in ("folder", "cut"):
        Path(folder).mkdir()
    Path("cut/model.json").write_text("{")
    Path("cut/arrays.safetensors").write_text("")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    places = {"M": fitted / "physics", "D": fitted / "steps.csv"}
    done = run(*(places.get(argument, argument) for argument in arguments))
    assert (done.code, done.out) == (2, "")
    assert one_line(done.err, "error: ", *words)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_file_with_some_of_the_outputs(project):
    u, y = signals(120, 1)
    for name in ("run", "steps"):
        write_csv(project.parent / f"{name}.csv", u=u, y=y, z=y**2)
    text = SPEC.replace('outputs = ["y"]', 'outputs = ["y", "z"]').replace(
        "regressor", 'output = "y"\nregressor'
    )
    project.write_text(
        text + '[[baseline.terms]]\nparameter = "d"\nregressor = "z[k-1]"\noutput = "z"\n'
    )
    assert run("fit", project, "--out", "out").code == 0
    write_csv(Path("some.csv"), u=u, y=y)
    done = run("simulate", "out", "some.csv")
    assert (done.code, done.out) == (2, "")
    assert one_line(done.err, "some.csv", "some of the model's outputs", "z", "all or none")
    done = run("simulate", "out", "run.csv")
    assert (
        done.out.splitlines()[0]
        == "time,y,y_model,y_baseline,y_learner,z,z_model,z_baseline,z_learner"
    )


def test_a_model_without_inputs_on_a_file_without_its_channels(project):
    text = SPEC.replace('inputs = ["u"]', "inputs = []").replace("u[k-1]", "1")
    project.write_text(text)
    assert run("fit", project, "--out", "out").code == 0
    assert run("simulate", "out", "run.csv").code == 0
    Path("other.csv").write_text("x\n1\n2\n3\n")
    done = run("simulate", "out", "other.csv")
    assert (done.code, done.out) == (2, "")
    assert one_line(done.err, "other.csv", "'y'")


# --- in a process of its own


def test_the_installed_command(fitted, tmp_path):
    done = shell("simulate", fitted / "mlp", fitted / "steps.csv", cwd=tmp_path)
    assert done.returncode == 0 and done.stderr.startswith("free run, 58 rows")
    assert len(done.stdout.splitlines()) == 61
    assert (tmp_path / "cache").is_dir()


def test_an_error_of_the_installed_command(tmp_path):
    done = shell("fit", "absent.toml", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert one_line(done.stderr, "error: absent.toml: no such file")


def test_single_precision_is_refused_in_words(fitted, tmp_path):
    done = shell("simulate", fitted / "mlp", fitted / "steps.csv", cwd=tmp_path, JAX_ENABLE_X64="0")
    assert done.returncode == 2
    assert one_line(done.stderr, "double precision", "JAX_ENABLE_X64=0", "Unset it")


def test_a_reader_that_goes_away_is_no_error(fitted, tmp_path):
    command = f"{sys.executable} -c '{MAIN}' simulate {fitted}/physics {fitted}/long.csv"
    u, y = signals(20000, 5)
    write_csv(fitted / "long.csv", u=u, y=y)
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache")}
    done = subprocess.run(
        f"{command} | head -n 2",
        shell=True,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.stderr == ""
    assert len(done.stdout.splitlines()) == 2
