"""What `--json` prints: one document that its published schema describes, for results and for errors."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import jsonschema
import pytest
from test_cli import MLP, SPEC, finite_json, make_project, run, small_run

from orthaug._base import errors
from orthaug.commands.schema import RESULTS
from orthaug.fitting.status import Ending

pytestmark = pytest.mark.usefixtures("without_figures")
RANK = SPEC.replace('regressor = "u[k-1]"', 'regressor = "2*y[k-1]"')
DESIGN = "[design]\nsamples = 60\namplitude = 1.0\n"


@cache
def schema(command: str) -> dict:
    return finite_json(run("schema", command).out)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A project with a fit, beside the specs that the commands take."""
    folder = tmp_path_factory.mktemp("json")
    make_project(folder, SPEC.replace('kind = "none"\n', MLP))
    text = (folder / "plant.toml").read_text()
    (folder / "design.toml").write_text(text + DESIGN)
    terms = SPEC.replace('kind = "none"', 'kind = "terms"\ndegree = 2')
    (folder / "terms.toml").write_text(f"{terms}[selection]\nblocks = 2\nna = 2\nnb = 1\n")
    assert run("fit", folder / "plant.toml", "--out", folder / "out").code == 0
    return folder


COMMANDS = {
    "check": ("plant.toml",),
    "fit": ("plant.toml", "--out", "fit"),
    "compare": ("plant.toml", "--out", "compare"),
    "design": ("design.toml", "--out", "u.csv"),
    "recover": ("plant.toml", "--out", "recovery", "--draws", "2", "--choices", "1"),
    "select": ("terms.toml", "--out", "selected"),
    "split": ("out", "run.csv", "--measure", "symmetrized"),
    "explain": ("out", "run.csv"),
    "linearize": ("out", "--at", "u = 0.1"),
    "track": ("out", "--data", "steps.csv", "--training", "run.csv", "--out", "track"),
}


def test_every_command_with_json_is_here():
    # `benchmark` needs a set of data: tests/test_benchmark_command.py
    assert COMMANDS.keys() | {"error", "benchmark"} == RESULTS.keys()


@pytest.mark.parametrize("command", COMMANDS)
def test_a_result_is_what_its_schema_says(folder, monkeypatch, command):
    monkeypatch.chdir(folder)
    done = run(command, *COMMANDS[command], "--json")
    assert done.code == 0, done.err
    jsonschema.validate(finite_json(done.out), schema(command))


@pytest.mark.parametrize("command", COMMANDS)
def test_a_missing_file_is_json_in_every_command(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    rest = ["absent" if Path(word).suffix or word == "out" else word for word in COMMANDS[command]]
    done = run(command, *rest, "--json")
    found = finite_json(done.out)
    jsonschema.validate(found, schema("error"))
    assert done.code == 2
    assert found["error"]["code"] == "file_not_found"
    assert found["error"]["where"]["file"] == "absent"
    assert done.err == f"error: {found['error']['text']}\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "arguments", "code", "where"),
    [
        (("[learner]", "[learnr]"), (), "spec_invalid", ("plant.toml", "learnr")),
        (('kind = "none"', "kind = "), (), "spec_invalid", ("plant.toml", None)),
        (('"u[k-1]"', '"v[k-1]"'), (), "input_invalid", ("plant.toml", None)),
        (('"run.csv"', '"absent.csv"'), (), "file_not_found", ("absent.csv", None)),
        (('inputs = ["u"]', 'inputs = ["q"]'), (), "input_invalid", None),
        ((), ("--out", "theirs"), "output_refused", ("theirs", None)),
        ((), ("--outt", "theirs"), "usage", None),
        (('"u[k-1]"', '"2*y[k-1]"'), (), "rank_deficient", ("plant.toml", None)),
    ],
)
def test_an_error_has_a_code_and_a_place(tmp_path, monkeypatch, change, arguments, code, where):
    monkeypatch.chdir(tmp_path)
    spec = make_project(tmp_path, SPEC.replace(*change) if change else SPEC)
    Path("theirs").mkdir()
    Path("theirs/notes.txt").write_text("mine")
    done = run("fit", spec.name, *(arguments or ("--out", "new")), "--json")
    found = finite_json(done.out)
    jsonschema.validate(found, schema("error"))
    assert done.code == 2 and found.keys() == {"error"}
    assert found["error"]["code"] == code
    if where is not None:
        assert tuple(found["error"]["where"].values()) == where
    without = run("fit", spec.name, *(arguments or ("--out", "new")))
    assert (without.code, without.out) == (2, "")
    assert without.err == done.err


def test_a_report_that_is_followed_by_a_refusal_holds_it(tmp_path, monkeypatch):
    """`check` prints its report, then refuses: with --json that is one document."""
    monkeypatch.chdir(tmp_path)
    spec = make_project(tmp_path, RANK)
    done = run("check", spec.name, "--json")
    found = finite_json(done.out)
    jsonschema.validate(found, schema("check"))
    assert done.code == 2
    assert found["excitation"]["rank"] < found["excitation"]["columns"]
    assert found["error"]["code"] == "rank_deficient"
    assert done.err == f"error: {found['error']['text']}\n"


def test_a_failed_training_is_in_the_result(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    spec = make_project(tmp_path, SPEC.replace('kind = "none"\n', MLP))
    small_run(monkeypatch, lambda go, _: go()._replace(ending=Ending.NON_FINITE))
    done = run("fit", spec.name, "--out", "new", "--json")
    found = finite_json(done.out)
    jsonschema.validate(found, schema("fit"))
    assert done.code == 1
    assert (found["status"]["code"], found["error"]["code"]) == ("non_finite", "training_failed")
    assert "error" not in finite_json(Path("new/result.json").read_text())


def test_codes_are_one_for_each_kind_of_error():
    kinds = [
        kind
        for kind in vars(errors).values()
        if isinstance(kind, type) and issubclass(kind, errors.InputError | errors.TrainingError)
    ]
    codes = [kind.code for kind in kinds]
    assert len(set(codes)) == len(codes) > 5
    assert all(code.replace("_", "").isalpha() and code.islower() for code in codes)
