"""`orthaug benchmark`: a small set in a file of its own, refusals, --list, JSON, and the measured sets where they are."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import jsonschema
import numpy as np
import pytest
from test_cli import finite_json, listing, one_line, run

import orthaug as oa
from orthaug.commands.opening import open_spec
from orthaug.commands.spec import spec_model
from orthaug.studies import public_sets as declared

SETS = (
    "bouc_wen",
    "cascaded_tanks",
    "f16",
    "f1tenth",
    "mr_damper",
    "silverbox",
    "wh_process_noise",
    "wiener_hammerstein",
)
TINY = """
title = "Tiny tank"
source = "generated"
protocol = "uEst, yEst train; uVal, yVal test, of which the first 5 samples are not scored."
unit = "mV"
scale = 1000.0
[[published]]
model = "a good one"
source = "a paper"
errors = { official = GOOD }
[[published]]
model = "a bad one"
source = "another paper"
errors = { official = 1e6 }
[data]
inputs = ["pump"]
outputs = ["level"]
train = { files = ["tiny/data.csv"], columns = { pump = "uEst", level = "yEst" } }
[data.channels]
level = { unit = "V" }
[data.tests.official]
files = ["tiny/data.csv"]
columns = { pump = "uVal", level = "yVal" }
skip = 5
[beside.sysidentpy]
outputs = 1
inputs = 1
degree = 2
terms = 4
[[models]]
name = "lagged"
[models.baseline]
terms = [
    { parameter = "a", regressor = "level[k-1]" },
    { parameter = "b", regressor = "pump[k-1]" },
]
[models.learner]
kind = "terms"
terms = ["pump[k-1]**2"]
[models.training]
focus = "prediction"
[[models]]
name = "motion"
[models.motion]
integrator = "discrete"
[models.motion.states]
x = { next = "a*x + b*pump", start = "level" }
[models.motion.outputs]
level = "x"
[models.motion.parameters]
a = { initial = 0.5 }
b = { initial = 0.4 }
[models.learner]
kind = "none"
"""


def level(u: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """y_k = 0.8 y_{k-1} + 0.5 u_{k-1} + 0.2 u_{k-1}², measured with noise."""
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        y[k] = 0.8 * y[k - 1] + 0.5 * u[k - 1] + 0.2 * u[k - 1] ** 2
    return y + noise


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A folder with the file of the tiny set, in the layout of the cascaded tanks."""
    rng = np.random.default_rng(4)
    columns = []
    for _ in range(2):
        u = rng.uniform(-1, 1, 200)
        columns += [u, level(u, 1e-3 * rng.normal(size=200))]
    order = [columns[i] for i in (0, 2, 1, 3)]
    (tmp_path / "data" / "tiny").mkdir(parents=True)
    np.savetxt(
        tmp_path / "data" / "tiny" / "data.csv",
        np.column_stack(order),
        delimiter=",",
        header="uEst,uVal,yEst,yVal",
        comments="",
    )
    return tmp_path / "data"


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Declare one set, in one file, instead of those of the package: a set needs no code."""
    place = tmp_path / "package" / "sets"
    place.mkdir(parents=True)
    (place / "tiny.toml").write_text(TINY.replace("GOOD", "0.01"), encoding="utf-8")
    monkeypatch.setattr(declared, "files", lambda _: tmp_path / "package")
    declared.public_sets.cache_clear()
    yield place / "tiny.toml"
    declared.public_sets.cache_clear()


def test_a_set_is_measured_beside_what_was_published(tiny, data, tmp_path):
    out = tmp_path / "out"
    done = run(
        "benchmark", "--data", data, "--out", out, "--beside", "jax-sysid", "--defaults", "--json"
    )
    assert done.code == 0, done.err
    found = finite_json(done.out)
    jsonschema.validate(found, finite_json(run("schema", "benchmark").out))
    assert found == finite_json((out / "benchmark.json").read_text(encoding="utf-8"))
    assert {"figures/benchmark.png", "specs/tiny-lagged.toml", "specs/tiny-motion.toml"} <= set(
        listing(out)
    )
    (one,) = found["sets"]
    errors = {(model["model"], model["fit"]): model["errors"][0]["rmse"] for model in one["models"]}
    assert list(errors) == [
        ("lagged", "physics alone"),
        ("lagged", "default"),
        ("lagged", "declared"),
        ("motion", "declared"),  # no learner is declared, so that this is physics alone
    ]
    # the term is right, so that noise of 1 mV is left of its free run, and 100 times that of physics
    assert errors["lagged", "declared"] < 2.0 < 30 < errors["lagged", "physics alone"]
    assert errors["motion", "declared"] > 30
    assert {error["unit"] for model in one["models"] for error in model["errors"]} == {"mV"}
    assert [model["unknowns"] for model in one["models"]][2:] == [3, 2]
    motion = one["models"][-1]["parameters"]
    assert [row["name"] for row in motion] == ["a", "b"]
    assert one["models"][2]["parameters"] == [], "coefficients of lags have no meaning"
    assert one["verdict"] == "behind", "the published figure is below the noise"
    (verdict,) = one["verdicts"]
    assert (verdict["by"], verdict["published"]) == ("a good one", 0.01)
    assert verdict["ours"] == errors["lagged", "declared"], "the first that is declared is entered"
    said = done.err.splitlines()
    assert said[2] == "tiny: lagged, default, 200 rows"
    assert said[3].startswith("tiny: lagged, default, done: official level ")


def test_the_table_has_80_columns_and_a_written_spec_fits(tiny, data, tmp_path):
    tiny.write_text(TINY.replace("GOOD", "50.0"), encoding="utf-8")
    declared.public_sets.cache_clear()
    out = tmp_path / "out"
    done = run("benchmark", "tiny", "--data", data, "--out", out, "--beside", "none")
    assert done.code == 0, done.err
    assert max(map(len, done.out.splitlines()[:-1])) <= 80
    for words in ("lagged: declared *", "published: a good one", "verdict: ahead on official"):
        assert words in done.out
    assert "ahead: tiny" in done.out.splitlines()
    again = oa.fit_spec(oa.load_spec(out / "specs" / "tiny-motion.toml"))
    result = finite_json((out / "benchmark.json").read_text(encoding="utf-8"))
    rmse = again.result.scores["tests.official"].simulation.rmse[0]
    (error,) = result["sets"][0]["models"][-1]["errors"]
    assert 1000 * rmse == pytest.approx(error["rmse"], rel=1e-9)


def test_a_package_that_is_not_installed_is_named(tiny, data, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "orthaug.studies.other_packages.importlib.util.find_spec", lambda name: None
    )
    done = run("benchmark", "--data", data, "--out", tmp_path / "out")
    assert "sysidentpy: not installed" in done.out
    assert "jax-sysid: not installed" in done.out


def test_a_package_that_fails_does_not_end_the_run(tiny, data, tmp_path, monkeypatch):
    broken = ModuleType("sysidentpy")
    monkeypatch.setitem(sys.modules, "sysidentpy", broken)
    monkeypatch.setattr(
        "orthaug.studies.other_packages.importlib.util.find_spec", lambda name: broken
    )
    monkeypatch.setattr(
        "orthaug.studies.other_packages.importlib.metadata.version", lambda name: "9"
    )
    args = ("benchmark", "--data", data, "--out", tmp_path / "out", "--beside", "sysidentpy")
    done = run(*args, "--json")
    assert done.code == 0
    (beside,) = finite_json(done.out)["sets"][0]["beside"]
    assert beside["text"].startswith("failed: ModuleNotFoundError")
    assert beside["errors"] == []


def test_sets_without_files_are_named_and_all_without_is_refused(tiny, data, tmp_path):
    one_model = tiny.read_text(encoding="utf-8").partition('[[models]]\nname = "motion"')[0]
    tiny.write_text(one_model, encoding="utf-8")
    other = TINY.replace("tiny/data.csv", "other/data.csv").replace("GOOD", "1.0")
    (tiny.parent / "other.toml").write_text(other, encoding="utf-8")
    declared.public_sets.cache_clear()
    done = run("benchmark", "--data", data, "--out", tmp_path / "out", "--beside", "none", "--json")
    first, second = finite_json(done.out)["sets"]
    assert first["text"] == f"no data: other/data.csv not found in {data}"
    assert (first["models"], first["verdict"], second["text"]) == ([], None, "")
    assert all(one["ours"] is one["verdict"] is None for one in first["verdicts"])
    refused = run("benchmark", "other", "--data", data, "--out", tmp_path / "none")
    assert refused.code == 2
    assert one_line(refused.err, "other/data.csv was not found")
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), ("--data DIR", "ORTHAUG_DATA", "silverbox", "cascaded_tanks")),
        (("silverbx", "--data", "."), ("'silverbx', did you mean 'silverbox'?", "f1tenth")),
        (("--data", "nowhere"), ("nowhere: there is no such folder",)),
        (("--data", ".", "--beside", "matlab"), ("--beside", "'matlab'", "jax-sysid")),
        (("--beside", "none", "--beside", "sysidentpy"), ("none", "sysidentpy")),
        (("--data", "full", "--out", "full"), ("full",)),
    ],
)
def test_refusals_are_one_line(arguments, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ORTHAUG_DATA", raising=False)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("kept", encoding="utf-8")
    done = run("benchmark", *arguments)
    assert done.code == 2
    assert one_line(done.err, *words)
    assert listing(tmp_path) == ["full", "full/mine.txt"]


def test_the_list_has_every_set_with_its_protocol_and_published_figures(monkeypatch):
    monkeypatch.delenv("ORTHAUG_DATA", raising=False)
    done = run("benchmark", "--list")
    assert done.code == 0
    assert max(map(len, done.out.splitlines())) <= 80
    heads = [line.split(":")[0] for line in done.out.splitlines() if line and line[0] != " "]
    assert tuple(heads) == SETS
    assert "0.301 mV" in done.out
    assert "The first 50 samples" in done.out
    assert "10.4121/12960104" in done.out
    refused = run("benchmark", "--list", "--json")
    assert refused.code == 2
    assert one_line(refused.err, "--json: found beside --list")
    assert finite_json(refused.out)["error"]["code"] == "input_invalid"


@pytest.mark.parametrize("name", SETS)
def test_a_declaration_is_a_spec_with_published_figures_of_its_tests(name):
    (one,) = declared.choose_sets([name])
    tests = set(one.content["data"]["tests"])
    assert one.content["source"]
    assert one.content["protocol"]
    for entry in one.published:
        assert set(entry.errors) <= tests, entry.model
    for model in one.models:
        spec_model().model_validate(one.spec(model))
        spec_model().model_validate(one.spec(model, default=True))


@pytest.mark.parametrize("name", SETS)
def test_a_measured_set_opens(name, data_folder):
    (one,) = declared.choose_sets([name])
    if one.missing(data_folder):
        pytest.skip(f"no data: {one.missing(data_folder)}")
    for model in one.models:
        spec = spec_model().model_validate(one.spec(model), context={"folder": data_folder})
        job = open_spec(data_folder / f"{name}.toml", spec)
        assert [part.name.removeprefix("tests.") for part in job.tests] == list(
            one.content["data"]["tests"]
        )


@pytest.mark.proof
def test_the_tanks_are_ahead_of_all_but_the_grey_box(data_folder, tmp_path):
    args = ("--data", data_folder, "--out", tmp_path / "out", "--beside", "none", "--json")
    done = run("benchmark", "cascaded_tanks", *args)
    (one,) = finite_json(done.out)["sets"]
    (error,) = [e for e in one["models"][-1]["errors"] if e["test"] == "official"]
    assert 0.191 < error["rmse"] < 0.25
