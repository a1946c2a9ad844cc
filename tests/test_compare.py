"""`orthaug compare`: every structure on the same data and seeds, beside models that were saved earlier."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from test_cli import MLP, SPEC, listing, make_project, one_line, run, signals, write_csv

import orthaug as oa
from orthaug.analysis.scoring import equal_within_noise
from orthaug.reports.result import CompareResult
from orthaug.reports.text import _parameter_cells

pytestmark = pytest.mark.usefixtures("without_figures")

NETWORK = SPEC.replace('kind = "none"\n', MLP)
STARTED = NETWORK.replace('"b"', '"b"\ninitial = -0.1').replace('"c"', '"c"\ninitial = 0.4')


@pytest.fixture
def project(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return make_project(tmp_path, STARTED)


def test_every_structure(project):
    assert run("fit", project, "--out", "fit").code == 0
    done = run("compare", project, "--out", "out", "--model", "fit", "--json")
    assert (done.code, done.err) == (0, "")
    result = json.loads(done.out)
    assert result == json.loads(Path("out/result.json").read_text(encoding="utf-8"))
    rows = {row["name"]: row for row in result["comparison"]}
    kinds = ["physics alone", "additive", "orthogonal", "orthogonal-penalty", "baseline-penalty"]
    assert list(rows) == [*kinds, "fit"]
    assert (result["left_out"], result["chosen"]) == ({}, None)
    values = {name: [p["value"] for p in row["parameters"]] for name, row in rows.items()}
    assert values["orthogonal"] == pytest.approx(values["physics alone"], rel=1e-10)
    assert values["fit"] == values["orthogonal"]
    assert values["additive"] != pytest.approx(values["orthogonal"], rel=1e-3)
    assert rows["orthogonal"]["orthogonality_defect"] <= 1e-12
    assert rows["physics alone"]["weights"] == 0 < rows["additive"]["weights"]
    assert rows["fit"]["scores"] == rows["orthogonal"]["scores"]
    assert set(rows["additive"]["scores"]) == {"train", "tests.steps"}
    assert Path("out/figures/comparison.png").read_bytes().startswith(b"\x89PNG")
    saved = [path.name for path in Path("out/models").iterdir()]
    assert sorted(saved) == sorted(kind.replace(" ", "-") for kind in kinds)
    assert run("simulate", "out/models/additive", "steps.csv").code == 0


def test_the_table(project):
    project.write_text(NETWORK)  # θ⁰ = 0 of two parameters: nothing to hold them to
    done = run("compare", project)
    assert (done.code, done.err) == (0, "")
    for words in (
        "physics alone",
        "orthogonal-penalty",
        "tests.steps",
        "free-run NRMSE",
        "left out: baseline-penalty",
    ):
        assert words in done.out
    assert (project.parent / "orthaug-out" / "plant" / "result.json").is_file()


def test_with_a_validation_part_the_lowest_error_there_is_marked(project):
    u, y = signals(80, 3)
    write_csv(Path("valid.csv"), u=u, y=y)
    project.write_text(
        STARTED.replace(
            "[data.channels.y]", '[data.validation]\nfiles = ["valid.csv"]\n[data.channels.y]'
        )
    )
    result = json.loads(run("compare", project, "--json").out)
    errors = {
        r["name"]: r["scores"]["validation"]["prediction"]["rmse"][0] for r in result["comparison"]
    }
    assert result["chosen"] == min(errors, key=errors.__getitem__)
    assert run("fit", project, "--out", "fit").code == 0
    done = run("compare", project, "--out", "again", "--force", "--model", "fit")
    (equal,) = re.findall("equal to (.*) within noise: (.*)\n", done.out)
    assert equal[0] == result["chosen"] and "fit" in equal[1].split(", ")
    assert "physics alone" not in equal[1]
    words = " ".join(done.out.split())
    assert "equal to it within noise" in words[words.index("Take “") :]


def test_errors_that_differ_by_chance_are_equal_within_noise():
    """Two models of one system, fitted to other rows; a third with another parameter."""
    rng = np.random.default_rng(2)
    u, y = rng.normal(size=3000), np.zeros(3000)
    for k in range(1, 3000):
        y[k] = 0.8 * y[k - 1] + u[k - 1]
    y += 0.3 * rng.normal(size=3000)
    pieces = [oa.Record.from_arrays(u[i : i + 1000], y[i : i + 1000]) for i in (0, 1000, 2000)]
    physics = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]")])
    ahead = oa.Simulation()
    one, other = (
        oa.estimate(piece, physics, learner=None, criterion=ahead).model for piece in pieces[:2]
    )
    worse = oa.estimate(pieces[0], physics, learner=None).model  # noise in lags moves θ
    runs = [model.simulate(pieces[2]) for model in (one, other, worse)]
    errors = [run.scores().nrmse[0] for run in runs]
    assert errors[0] != errors[1] and errors[2] > 1.01 * errors[0]
    assert equal_within_noise(runs[0], runs[1], [0])
    assert not equal_within_noise(runs[0], runs[2], [0])


def test_without_a_learner_there_is_only_the_physics(project):
    project.write_text(SPEC)
    result = json.loads(run("compare", project, "--json").out)
    assert [row["name"] for row in result["comparison"]] == ["physics alone"]


def test_a_saved_model_of_other_outputs_is_refused(project):
    assert run("fit", project, "--out", "fit").code == 0
    for name in ("run", "steps"):
        u, y = signals(120, 1)
        write_csv(Path(f"{name}.csv"), u=u, z=y)
    project.write_text(
        STARTED.replace('["y"]', '["z"]').replace("y[k", "z[k").replace("channels.y", "channels.z")
    )
    before = listing(Path())
    done = run("compare", project, "--model", "fit")
    assert (done.code, done.out) == (2, "")
    assert one_line(done.err, "fit: its outputs are y; expected z")
    assert listing(Path()) == before


# --- the rows are what the single fits are, and everything written can be used


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """A folder whose comparison, with a validation part, lies in `out`; tests leave it as it is."""
    folder = tmp_path_factory.mktemp("compared")
    spec = make_project(
        folder,
        STARTED.replace("[data.tests", '[data.validation]\nfiles = ["valid.csv"]\n[data.tests'),
    )
    u, y = signals(80, 3)
    write_csv(folder / "valid.csv", u=u, y=y)
    done = run("compare", spec, "--out", folder / "out")
    assert (done.code, done.err) == (0, "")
    return folder


def rows_of(folder: Path) -> dict:
    result = json.loads((folder / "out" / "result.json").read_text(encoding="utf-8"))
    return {row["name"]: row for row in result["comparison"]}


@pytest.mark.usefixtures("without_trials")  # whose outcome is in the warnings of a fit
@pytest.mark.parametrize(
    "kind", ["orthogonal", "additive", "orthogonal-penalty", "baseline-penalty"]
)
def test_a_row_is_what_the_single_fit_gives(compared, tmp_path, kind):
    spec = (compared / "plant.toml").read_text(encoding="utf-8")
    (compared / f"{kind}.toml").write_text(
        spec + f'[structure]\nkind = "{kind}"\n', encoding="utf-8"
    )
    assert run("fit", compared / f"{kind}.toml", "--out", tmp_path / "fit").code == 0
    single = json.loads((tmp_path / "fit" / "result.json").read_text(encoding="utf-8"))
    row = rows_of(compared)[kind]
    for key in ("parameters", "scores", "orthogonality_defect", "warnings"):
        assert row[key] == single[key]
    assert row["status"] == single["status"]["code"]


def test_every_part_is_scored_in_every_row(compared):
    for row in rows_of(compared).values():
        assert set(row["scores"]) == {"train", "validation", "tests.steps"}
        for scores in row["scores"].values():
            assert scores["prediction"]["rmse"][0] > 0 and scores["simulation"]["rmse"][0] > 0


def test_the_chosen_row_has_the_lowest_validation_error(compared):
    errors = {
        n: row["scores"]["validation"]["prediction"]["nrmse"][0]
        for n, row in rows_of(compared).items()
    }
    result = json.loads((compared / "out" / "result.json").read_text(encoding="utf-8"))
    assert result["chosen"] == min(errors, key=errors.__getitem__)


def test_the_models_can_join_the_next_comparison(compared, tmp_path):
    models = [compared / "out" / "models" / name for name in ("physics-alone", "additive")]
    joined = [word for model in models for word in ("--model", model)]
    assert run("compare", compared / "plant.toml", "--out", tmp_path / "out", *joined).code == 0
    rows, before = rows_of(tmp_path), rows_of(compared)
    for model, name in zip(models, ("physics alone", "additive"), strict=True):
        row = rows[str(model)]
        assert row["status"] == "saved" and row["scores"] == before[name]["scores"]
        assert [p["value"] for p in row["parameters"]] == [
            p["value"] for p in before[name]["parameters"]
        ]
        assert all(p["std"] is None for p in row["parameters"])


def test_a_row_with_other_parameters_has_its_own_columns(compared):
    content = json.loads((compared / "out" / "result.json").read_text(encoding="utf-8"))
    last = content["comparison"][-1]
    last["parameters"].pop(1)
    last["parameters"][0] |= {"name": "gain", "value": 0.25, "std": None}
    result = CompareResult.model_validate(content)
    head, *rows = _parameter_cells(result)
    assert head[1:5] == ["a", "b", "c", "gain"] and {len(row) for row in rows} == {len(head)}
    found = dict(zip(head, rows[-1], strict=True))
    assert (found["a"], found["b"], found["gain"], found["weights"]) == (
        "–",
        "–",
        "0.25",
        str(last["weights"]),
    )


@pytest.mark.parametrize("model", ["nowhere", "run.csv", "empty"])
def test_what_is_no_saved_model_is_refused(compared, tmp_path, model):
    (compared / "empty").mkdir(exist_ok=True)
    done = run(
        "compare", compared / "plant.toml", "--out", tmp_path / "out", "--model", compared / model
    )
    assert done.code == 2 and model in done.err and done.err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_saved_model_of_other_inputs_is_refused_before_training(compared, tmp_path):
    spec = STARTED.replace('"u"', '"force"').replace("u[k-1]", "force[k-1]")
    other = make_project(
        tmp_path,
        spec.replace("[data.channels.y]", '[data.channels.force]\ncolumn = "u"\n[data.channels.y]'),
    )
    model = compared / "out" / "models" / "additive"
    done = run("compare", other, "--out", tmp_path / "out", "--model", model)
    assert done.code == 2 and done.err.count("\n") == 1
    assert str(model) in done.err and "force" in done.err
    assert not (tmp_path / "out").exists()


def test_by_default_a_comparison_stands_beside_the_fit(project):
    """It has no model, and would take that of the fit away."""
    fit, beside = Path("orthaug-out") / project.stem, f"{project.stem}-comparison"
    assert run("fit", project).code == 0
    model = listing(fit / "model")
    done = run("compare", project)
    assert done.code == 0 and f"written to {Path('orthaug-out') / beside}" in done.out
    assert listing(fit / "model") == model
    assert (fit.with_name(beside) / "result.json").is_file()
