"""`orthaug compare A B`: results that were saved, side by side; nothing is trained."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import jsonschema
import pytest
from test_cli import MLP, SPEC, listing, make_project, one_line, run, signals, write_csv

import orthaug as oa
from orthaug import InputError

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")

HELD_OUT = SPEC.replace("[data.tests", '[data.validation]\nfiles = ["valid.csv"]\n[data.tests')
NETWORK = HELD_OUT.replace('kind = "none"\n', MLP)


@pytest.fixture(scope="module")
def fits(tmp_path_factory) -> Path:
    """A folder with the results of two specs, and of two on other data; tests leave it as it is."""
    folder = tmp_path_factory.mktemp("fits")
    make_project(folder, NETWORK)
    for name, rows, seed in (("valid", 80, 3), ("other", 120, 4)):
        u, y = signals(rows, seed)
        write_csv(folder / f"{name}.csv", u=u, y=y, z=y)
    of_z = HELD_OUT.replace('["y"]', '["z"]').replace("y[k", "z[k").replace("nels.y", "nels.z")
    specs = {
        "network": NETWORK,
        "physics": HELD_OUT,
        "other": HELD_OUT.replace("run.csv", "other.csv"),
        "apart": SPEC.replace("run.csv", "other.csv").replace("steps.csv", "valid.csv"),
        "z": of_z.replace("run.csv", "other.csv").replace("steps.csv", "valid.csv"),
        "prepared": HELD_OUT.replace("inputs =", 'prepare = [{ step = "detrend" }]\ninputs ='),
    }
    for name, spec in specs.items():
        (folder / f"{name}.toml").write_text(spec)
        done = run("fit", folder / f"{name}.toml", "--out", folder / "out" / name)
        assert done.code == 0, done.err
    return folder


@pytest.fixture
def results(fits, monkeypatch) -> Path:
    monkeypatch.chdir(fits)
    return Path("out")


def result_of(folder: Path) -> dict:
    return json.loads((folder / "result.json").read_text(encoding="utf-8"))


def test_two_results_in_one_table(results, tmp_path):
    first, other = results / "physics", results / "network"
    done = run("compare", first, other, "--out", tmp_path / "out", "--json")
    assert (done.code, done.err) == (0, "")
    found = json.loads(done.out)
    assert found == result_of(tmp_path / "out")
    jsonschema.validate(found, json.loads(run("schema", "compare").out))
    kept = [result_of(first), result_of(other)]
    for row, own in zip(found["comparison"], kept, strict=True):
        assert (row["parameters"], row["scores"]) == (own["parameters"], own["scores"])
        assert (row["validation"], row["residuals"]) == (own["validation"], own["residuals"])
    assert [row["name"] for row in found["comparison"]] == [str(first), str(other)]
    pairs = list(zip(*(own["parameters"] for own in kept), strict=True))
    assert [(one["name"], one["result"]) for one in found["differences"]] == [
        (name, str(other)) for name in "abc"
    ]
    for (before, after), one in zip(pairs, found["differences"], strict=True):
        apart = after["value"] - before["value"]
        assert one["value"] == pytest.approx(apart, rel=1e-12)
        std = max(before["std"] or 0.0, after["std"] or 0.0)
        assert one["of_std"] == (pytest.approx(apart / std, rel=1e-12) if std else None)
    settings = {one["key"]: list(one["values"].values()) for one in found["settings"]}
    assert settings["learner.kind"] == ["none", "mlp"]
    assert settings["learner.hidden"] == [None, [4]]
    assert settings["training.iterations"] == [None, 5]
    assert not [key for key in settings if key.startswith("data")]


def test_the_model_of_the_lowest_validation_error_is_chosen(results, tmp_path):
    done = run("compare", results / "physics", results / "network", "--out", tmp_path / "out")
    errors = {
        name: result_of(results / name)["scores"]["validation"]["simulation"]["nrmse"][0]
        for name in ("physics", "network")
    }
    best = min(errors, key=errors.__getitem__)
    assert result_of(tmp_path / "out")["chosen"] == str(results / best)
    assert f"{results / best} *" in done.out


def test_the_table_has_intervals_and_differences(results, tmp_path, monkeypatch):
    monkeypatch.chdir(results)
    done = run("compare", "physics", "network", "--out", tmp_path / "out")
    assert done.code == 0 and max(map(len, done.out.splitlines())) <= 100
    head, first, other = done.out.splitlines()[:3]
    assert re.split("  +", head) == [
        *("parameter", "result", "value", "std", "95 % interval"),
        *("less physics", "of std", "unit"),
    ]
    assert first.startswith("a ") and other.split()[0] == "network"
    sign = "-" if result_of(tmp_path / "out")["differences"][0]["value"] < 0 else "+"
    assert sign not in first and other.count(f" {sign}") == 1 + (" –" not in other)
    assert "learner.kind" in done.out and '"mlp"' in done.out


def test_the_page_draws_the_free_runs_of_both(results, tmp_path):
    done = run("compare", results / "physics", results / "network", "--out", tmp_path / "out")
    assert done.code == 0, done.err
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    for part in ("train", "validation", "tests.steps"):
        assert f"The free runs of {results / 'physics'}, {results / 'network'} on {part}" in page
    assert "Settings that differ" in page and "learner.iterations" not in page
    assert "The parameters" in page and "standard errors" in page
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        *("figures", "manifest.json", "report.html", "result.json"),
    ]


def test_where_data_are_not_found_the_rest_is_compared(results, tmp_path, monkeypatch):
    for name in ("physics", "network"):
        shutil.copytree(results / name, tmp_path / "kept" / name)
    monkeypatch.chdir(tmp_path)
    done = run("compare", "kept/physics", "kept/network", "--out", "out")
    assert done.code == 0
    assert "no free run is drawn, because the data of kept/physics (run.csv)" in " ".join(
        done.out.split()
    )
    assert [w["code"] for w in result_of(Path("out"))["warnings"]] == ["data_not_found"]
    page = Path("out/report.html").read_text(encoding="utf-8")
    assert "2 models of y from u" in page and page.count('data-label="horizon">free run<') >= 2
    assert "The free runs of" not in Path("out/report.html").read_text(encoding="utf-8")


def test_results_of_training_data_differ_are_compared_on_what_they_share(results, tmp_path):
    done = run("compare", results / "physics", results / "other", "--out", tmp_path / "out")
    found = result_of(tmp_path / "out")
    assert done.code == 0 and found["data"]["train"] == []
    assert all(set(row["scores"]) == {"validation", "tests.steps"} for row in found["comparison"])
    assert [w["code"] for w in found["warnings"]] == ["training_data_differ"]


def test_a_model_in_a_result_stands_for_it(results, tmp_path):
    done = run(
        "compare", results / "physics" / "model", results / "network", "--out", tmp_path / "o"
    )
    assert done.code == 0, done.err
    own = result_of(results / "physics")["parameters"]
    assert result_of(tmp_path / "o")["comparison"][0]["parameters"] == own


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["out/physics"], "out/physics: is one folder; expected a spec, or two result folders"),
        (["out/physics", "out/physics"], "out/physics: is given twice"),
        (["out/physics", "network.toml"], "network.toml: is a file; expected the result folders"),
        (["out/physics", "nowhere"], "nowhere: there is no such folder"),
        (["out/physics", "x" * 300], "… there is no such folder"),
        (["out/physics", "empty"], "empty: has no result.json that can be read"),
        (["out/physics", "broken"], "broken: has no result.json that can be read"),
        (["out/physics", "of_check"], "of_check: its result.json is no result of `orthaug fit`"),
        (["out/physics", "no_spec"], "no_spec: its result.json is no result of `orthaug fit`"),
        (["out/physics", "no_model"], "no_model: no saved model there"),
        (["out/physics", "out/z"], "out/z: its outputs are z, those of out/physics are y"),
        (["out/physics", "out/apart"], "out/apart: has no part of the data in common with"),
        (["out/physics", "out/prepared"], "out/prepared: its data were prepared in another way"),
        (["out/physics", "out/network", "--model", "out/z"], "--model: belongs to a spec"),
        (["out/physics", "out/z", "--out", "out/z"], "out/z: holds out/z, which is read"),
    ],
)
def test_what_cannot_be_compared_is_refused(fits, tmp_path, monkeypatch, given, words):
    shutil.copytree(fits, tmp_path / "own")
    monkeypatch.chdir(tmp_path / "own")
    content = result_of(Path("out/network"))
    for name, kept in {
        "broken": "{",
        "of_check": json.dumps({"schema": 2, "parameters": ["a"]}),
        "no_spec": json.dumps(content | {"spec": {"data": 3}}),
        "no_model": json.dumps(content),
    }.items():
        Path(name).mkdir()
        Path(name, "result.json").write_text(kept)
    Path("empty").mkdir()
    before = listing(Path())
    options = given if "--out" in given else [*given, "--out", "new"]
    done = run("compare", *options)
    assert (done.code, done.out) == (2, "")
    assert one_line(done.err, words)
    assert listing(Path()) == before


def test_from_python(results, tmp_path):
    folders = [str(results / "physics"), str(results / "network")]
    found = oa.compare(folders, out=tmp_path / "out")
    assert found.result.content() == result_of(tmp_path / "out")
    assert found.summary() in run("compare", *folders, "--out", tmp_path / "again").out
    assert repr(found) == f"SavedComparison({', '.join(folders)})"
    for name, folder in zip(found.responses, folders, strict=True):
        own = result_of(Path(folder))["scores"]
        for part, free in found.responses[name].items():
            scored = free.scores((5,) if part == "tests.steps" else (0,))
            assert list(scored.rmse) == pytest.approx(own[part]["simulation"]["rmse"], rel=1e-9)
    assert oa.plot(found.result) is not None


@pytest.mark.parametrize(
    ("given", "models", "words"),
    [
        ([], (), "no folder is given; expected a spec, or two result folders"),
        (["out/physics", 3], (), "`spec` must be a spec, or a list of result folders"),
        (["out/physics", "out/z"], ["out/z"], "`models` belong to a spec"),
    ],
)
def test_what_python_cannot_compare(results, given, models, words):
    with pytest.raises(InputError, match=words):
        oa.compare(given, models)  # type: ignore[call-overload]
