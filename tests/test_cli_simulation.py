"""`fit` and `compare` on the free run: what result.json says of noise and learner, and what is refused."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from helpers import unfolded
from test_cli import RESULT_KEYS, finite_json, one_line, run, write_csv

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")

SPEC = """
[data]
sampling_time = 0.1
inputs = ["u"]
outputs = ["y"]
train = { files = ["run.csv"] }
[[baseline.terms]]
parameter = "a"
regressor = "y[k-1]"
initial = 1.4
[[baseline.terms]]
parameter = "b"
regressor = "y[k-2]"
initial = -0.6
[[baseline.terms]]
parameter = "g"
regressor = "u[k-1]"
initial = 0.9
"""
ALONE = '[learner]\nkind = "none"\n'
SMALL = "[learner]\nhidden = [4]\n"
GREEDY = "[learner]\nhidden = [30]\n"
UNBOUNDED = GREEDY + 'beyond = "free"\n'
FREE = '[training]\nfocus = "simulation"\nsegment = 64\nwashout = 8\nstart_iterations = 5\n'
QUICK = '[training]\nfocus = "prediction"\niterations = 40\nregularization = "none"\n'
FAR = '[data.tests.far]\nfiles = ["far.csv"]\n'


def system(seed, rows, *, square=0.0, equation=0.0, sensor=0.0, scale=1.0):
    rng = np.random.default_rng([5, seed])
    u, y, e = scale * rng.normal(size=rows), np.zeros(rows), rng.normal(size=(2, rows))
    for k in range(2, rows):
        y[k] = (
            1.5 * y[k - 1] - 0.7 * y[k - 2] + u[k - 1] + square * u[k - 1] ** 2 + equation * e[0, k]
        )
    return {"u": u, "y": y + sensor * e[1]}


def project(folder, *sections, **signals) -> Path:
    """A spec in `folder` with its training data; returns its path."""
    folder.mkdir(exist_ok=True)
    write_csv(folder / "run.csv", **(signals or system(0, 300, square=0.3, sensor=0.3)))
    (folder / "plant.toml").write_text(SPEC + "".join(sections), encoding="utf-8")
    return folder / "plant.toml"


def fit(spec) -> dict:
    """result.json of a fit that ends with exit code 0; it holds neither NaN nor Infinity."""
    out = spec.parent / "out"
    done = run("fit", spec, "--out", out, "--json")
    assert (done.code, done.err) == (0, "")
    assert finite_json(done.out) == finite_json((out / "result.json").read_text(encoding="utf-8"))
    return finite_json(done.out)


def printed_fit(spec) -> tuple[str, dict]:
    """What a fit prints, and its result.json."""
    done = run("fit", spec, "--out", spec.parent / "out")
    assert (done.code, done.err) == (0, "")
    return done.out, finite_json((spec.parent / "out" / "result.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def free(tmp_path_factory) -> dict:
    """The result of a learner trained on the free run, with evidence and restarts."""
    more = 'restarts = 2\nregularization = "evidence"\n'
    return fit(project(tmp_path_factory.mktemp("free") / "p", SMALL, FREE, more))


# --- what a fit on the free run leaves


def test_the_result_has_all_its_keys(free):
    assert set(free) >= RESULT_KEYS
    assert [(r["seed"], r["regularization"]) for r in free["restarts"]] == [
        (0, "evidence"),
        (1, "evidence"),
    ]
    assert sum(r["chosen"] for r in free["restarts"]) == 1
    assert free["orthogonality_defect"] < 1e-12


def test_theta_has_standard_errors(free):
    for parameter in free["parameters"]:
        assert parameter["std"] > 0
        low, high = parameter["ci95"]
        assert low < parameter["value"] < high
        assert parameter["one_step"] != pytest.approx(parameter["value"], rel=1e-3)


def test_the_noise_has_a_verdict_with_a_text(free):
    assert free["residuals"]["verdict"] in ("white", "equation_noise", "sensor_noise", "unmodelled")
    assert (
        free["residuals"]["text"].endswith(".") and "inconsistent" not in free["residuals"]["text"]
    )


def test_the_learner_has_a_verdict_from_blocks(free):
    """Without test parts, blocked cross-validation asks whether the learner earns its place."""
    assert free["validation"]["verdict"] == "helps"
    assert [trial["where"] for trial in free["validation"]["trials"]] == [
        f"block {i} of 4" for i in (1, 2, 3, 4)
    ]
    assert "4 blocks" in free["validation"]["text"]


def test_the_free_run_is_better_than_after_one_step_training(free, tmp_path):
    one_step = fit(project(tmp_path / "p", SMALL, QUICK, "[validation]\nblocks = 0\n"))
    error = [result["scores"]["train"]["simulation"]["rmse"][0] for result in (free, one_step)]
    assert error[0] < error[1]


WAYS = {
    "whole": FREE.replace("segment = 64", "segment = 0"),
    "exact": FREE.replace("washout = 8", "washout = 0").replace(
        "start_iterations = 5", "start_iterations = 0"
    ),
    "five steps": "[training]\nhorizon = 5\n",
    "ensemble": FREE + "ensemble = true\nrestarts = 2\n",
}


@pytest.mark.parametrize("training", WAYS.values(), ids=list(WAYS))
def test_ways_to_train_on_the_free_run(tmp_path, training):
    result = fit(project(tmp_path / "p", SMALL, training, "[validation]\nblocks = 0\n"))
    assert result["status"]["code"] in ("converged", "iteration_limit")
    assert all(parameter["std"] > 0 for parameter in result["parameters"])
    assert result["validation"] is None and result["residuals"]["verdict"]
    assert result["scores"]["train"]["simulation"]["nrmse"][0] < 0.3


def test_physics_alone_on_the_free_run(tmp_path):
    """Noise on the sensor is what the free run is for: it biases no parameter there."""
    spec = project(tmp_path / "p", ALONE, FREE, **system(0, 600, sensor=0.3))
    printed, result = printed_fit(spec)
    assert result["validation"] is None and result["residuals"]["verdict"] == "sensor_noise"
    assert result["warnings"] == []
    verdict = unfolded(printed).partition("Verdict:")[2]
    assert "as physics." in verdict and "Do not read" not in verdict
    assert "one-step estimates" not in verdict
    for parameter, truth in zip(result["parameters"], (1.5, -0.7, 1.0), strict=True):
        assert abs(parameter["value"] - truth) < 4 * parameter["std"]


def test_one_step_with_sensor_noise_is_reported(tmp_path):
    spec = project(tmp_path / "p", ALONE, QUICK, **system(0, 600, sensor=0.3))
    printed, result = printed_fit(spec)
    assert result["residuals"]["verdict"] == "sensor_noise"
    found = [w["text"] for w in result["warnings"]]
    assert any(
        "intervals do not cover" in text and 'focus = "simulation"' in text for text in found
    )
    assert result["residuals"]["text"] in unfolded(printed) and f"warning: {found[0]}" in unfolded(
        printed
    )


def test_the_verdicts_are_printed(tmp_path):
    spec = project(tmp_path / "p", SMALL, QUICK, FAR)
    write_csv(spec.parent / "far.csv", **system(1, 150, square=0.3, sensor=0.3))
    printed, result = printed_fit(spec)
    for key in ("residuals", "validation"):
        assert result[key]["text"] in unfolded(printed)


# --- what is refused

REFUSED = [
    (
        FREE.replace("washout = 8", "washout = 64"),
        ["`training.washout`: found 64; expected less than the segment, 64"],
    ),
    (FREE.replace("washout = 8", "washout = 99"), ["`training.washout`: found 99"]),
    (FREE + 'solver = "adam-lbfgs"\n', ["`training.solver`", "adam-lbfgs", "levenberg-marquardt"]),
    ("[training]\nhorizon = 0\n", ["'training.horizon': found 0", "1"]),
    (
        '[training]\nhorizon = 3\nsolver = "adam-lbfgs"\n',
        ["`training.solver`", "levenberg-marquardt"],
    ),
    (
        '[training]\nfocus = "free"\n',
        ["'training.focus': found \"free\"", "'prediction' or 'simulation'"],
    ),
    ("[training]\nsegments = 3\n", ["unknown key 'training.segments'", "did you mean 'segment'"]),
    ("[training]\nsegment = -1\n", ["'training.segment': found -1"]),
    ("[training]\nwashout = 2.5\n", ["'training.washout': found 2.5", "an integer"]),
    ("[validation]\nblocks = 1\n", ["`validation.blocks`: found 1; expected 2 or more, or 0"]),
    ("[validation]\nblocks = -2\n", ["'validation.blocks': found -2"]),
    ("[validation]\nblock = 4\n", ["unknown key 'validation.block'", "did you mean 'blocks'"]),
    (
        FREE.replace("segment = 64", "segment = 0").replace("washout = 8", "washout = 299"),
        ["washout"],
    ),
    (
        FREE.replace("segment = 64", "segment = 512").replace("washout = 8", "washout = 400"),
        ["washout"],
    ),
    ("[training]\nhorizon = 400\niterations = 5\n", ["horizon"]),
]


@pytest.mark.parametrize(("training", "words"), REFUSED, ids=range(len(REFUSED)))
def test_refused(tmp_path, training, words):
    """The last three leave nothing to score in 300 rows."""
    done = run("fit", project(tmp_path / "p", SMALL, training), "--out", tmp_path / "out")
    assert (done.code, done.out) == (2, "")
    assert one_line(done.err, "error: ", "plant.toml", *words)
    assert not (tmp_path / "out").exists()


def test_compare_refuses_the_same(tmp_path):
    done = run(
        "compare",
        project(tmp_path / "p", SMALL, "[validation]\nblocks = 1\n"),
        "--out",
        tmp_path / "out",
    )
    assert (done.code, done.out) == (2, "") and one_line(
        done.err, "error: ", "plant.toml", "`validation.blocks`"
    )


def test_a_question_ends_with_its_own_mark(tmp_path):
    done = run("fit", project(tmp_path / "p", SMALL, "[training]\nsegments = 3\n"))
    assert done.err.rstrip().endswith("did you mean 'segment'?")


# --- verdicts on the learner


@pytest.fixture(scope="module")
def overfitted(tmp_path_factory):
    """151 weights on 60 noisy rows of a linear system, tested far outside: the spec."""
    spec = project(
        tmp_path_factory.mktemp("over") / "p", UNBOUNDED, QUICK, FAR, **system(3, 60, equation=0.3)
    )
    write_csv(spec.parent / "far.csv", **system(4, 200, equation=0.3, scale=4.0))
    return spec


@pytest.fixture(scope="module")
def diverged(overfitted) -> dict:
    return fit(overfitted)


def test_a_free_run_that_diverges_is_null_with_a_warning(diverged):
    assert diverged["scores"]["tests.far"]["simulation"] == {
        "rmse": None,
        "nrmse": None,
        "fit": None,
    }
    assert diverged["scores"]["tests.far"]["prediction"]["rmse"][0] > 0
    warnings = [w["text"] for w in diverged["warnings"] if w["code"] == "free_run_diverged"]
    assert any(
        re.match(r"tests\.far: the free run diverged in output 'y' at step \d+", text)
        for text in warnings
    )


def test_it_hurts_in_extrapolation(diverged):
    verdict = diverged["validation"]
    assert (
        verdict["verdict"] == "hurts"
        and {"code": "learner_hurts", "text": verdict["text"]} in diverged["warnings"]
    )
    assert (
        verdict["text"].startswith("The learner hurts in extrapolation")
        and "tests.far leaves" in verdict["text"]
    )
    (trial,) = verdict["trials"]
    assert (
        trial["where"] == "tests.far" and trial["model"] is None and 0 < trial["physics_alone"] < 1
    )
    assert {entry["regressor"] for entry in verdict["extrapolation"]} == {"y[k-1]", "u[k-1]"}


@pytest.mark.parametrize("seed", range(2))
def test_what_is_worse_than_physics_alone_on_a_part_never_helps(seed, tmp_path):
    spec = project(tmp_path / "p", GREEDY, QUICK, FAR, **system(seed, 60, equation=0.3))
    write_csv(spec.parent / "far.csv", **system(seed + 9, 200, equation=0.3, scale=2.0))
    result = fit(spec)
    (trial,) = result["validation"]["trials"]
    model = result["scores"]["tests.far"]["simulation"]["nrmse"]
    assert (
        model is None or model[0] > trial["physics_alone"]
    )  # it leaves the training range and is worse there
    assert result["validation"]["verdict"] == "hurts"


def test_a_learner_that_finds_the_square_helps(tmp_path):
    spec = project(
        tmp_path / "p",
        SMALL,
        QUICK,
        FAR,
        "[validation]\nblocks = 4\n",
        **system(0, 300, square=0.3),
    )
    write_csv(spec.parent / "far.csv", **system(1, 150, square=0.3))
    verdict = fit(spec)["validation"]
    assert verdict["verdict"] == "helps"
    assert [t["where"] for t in verdict["trials"]] == [f"block {i} of 4" for i in (1, 2, 3, 4)] + [
        "tests.far"
    ]
    assert all(t["model"] < 0.5 * t["physics_alone"] for t in verdict["trials"])


@pytest.mark.parametrize(
    "blocks", ["", "[validation]\nblocks = 40\n"], ids=["few rows", "many blocks"]
)
def test_a_record_too_short_for_blocks_is_reported(tmp_path, blocks):
    """No verdict, and a sentence that says why."""
    rows, learner = (300, SMALL) if blocks else (60, GREEDY)
    result = fit(
        project(
            tmp_path / "p",
            learner,
            '[training]\nfocus = "prediction"\niterations = 5\n',
            blocks,
            **system(0, rows, equation=0.1),
        )
    )
    assert result["validation"] is None
    assert any("too few" in w["text"] and "blocks" in w["text"] for w in result["warnings"])


# --- compare


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """The spec, the printed text and the rows of a comparison on the free run with a test part."""
    spec = project(tmp_path_factory.mktemp("compare") / "p", SMALL, FREE + "iterations = 10\n", FAR)
    write_csv(spec.parent / "far.csv", **system(1, 150, square=0.3, sensor=0.3))
    done = run("compare", spec, "--out", spec.parent / "out")
    assert (done.code, done.err) == (0, "")
    result = finite_json((spec.parent / "out" / "result.json").read_text(encoding="utf-8"))
    return spec, done.out, {row["name"]: row for row in result["comparison"]}


def test_compare_shows_the_verdicts_of_every_row(compared):
    _, text, rows = compared
    assert len(rows) == 5
    for name, row in rows.items():
        assert f"{name}: {row['residuals']['text']}" in unfolded(text)
        if name == "physics alone":
            assert row["validation"] is None
        else:
            (output,) = (
                line for line in text.splitlines() if line.startswith(f"{name}: The learner")
            )
            assert row["validation"]["text"].startswith(output.removeprefix(f"{name}: "))
            wheres = [trial["where"] for trial in row["validation"]["trials"]]
            assert wheres == ["tests.far"]  # as in `fit`: blocks only where no part is held out


def test_compare_shows_how_the_learner_weighs_against_the_physics(compared):
    _, text, rows = compared
    assert "‖F̃‖/‖Φθ̂‖" in text
    assert rows["physics alone"]["learner_to_physics"] in (0, None)
    assert 0 < rows["orthogonal"]["learner_to_physics"] < 1
    assert f"{rows['orthogonal']['learner_to_physics']:.2g}" in text


def test_all_rows_are_judged_against_the_same_physics_alone(compared):
    _, _, rows = compared
    alone = rows["physics alone"]["scores"]["tests.far"]["simulation"]["nrmse"][0]
    for name, row in rows.items():
        if row["validation"] is not None:
            trial = row["validation"]["trials"][-1]
            assert trial["physics_alone"] == pytest.approx(alone)
            assert trial["model"] == pytest.approx(
                row["scores"]["tests.far"]["simulation"]["nrmse"][0]
            ), name


def test_no_blocks_switch_cross_validation_off(compared, tmp_path):
    spec, _, _ = compared
    quick = spec.read_text(encoding="utf-8").replace("iterations = 10", "iterations = 2")
    other = spec.parent / "off.toml"
    other.write_text(quick + "[validation]\nblocks = 0\n", encoding="utf-8")
    rows = json.loads(run("compare", other, "--out", tmp_path / "out", "--json").out)["comparison"]
    for row in rows[1:]:
        assert [trial["where"] for trial in row["validation"]["trials"]] == ["tests.far"]
    other.write_text(quick.replace(FAR, "") + "[validation]\nblocks = 0\n", encoding="utf-8")
    result = json.loads(run("fit", other, "--out", tmp_path / "fit", "--json").out)
    assert result["validation"] is None


@pytest.fixture(scope="module")
def labelled(tmp_path_factory):
    """A fit to three experiments of one file, which a column numbers; each begins far from where one ended."""
    folder = tmp_path_factory.mktemp("labelled")
    rng = np.random.default_rng(8)
    pieces = []
    for start in (0.0, 5.0, 10.0):
        u, y = rng.normal(size=60), np.full(60, start)
        for k in range(1, 60):
            y[k] = 0.9 * y[k - 1] + 0.3 * u[k - 1]
        pieces.append((u, y + 1e-3 * rng.normal(size=60)))
    u, y = map(np.concatenate, zip(*pieces, strict=True))
    signals = {"u": u, "y": y, "experiment": np.repeat([1, 2, 3], 60)}
    spec = project(folder, ALONE, **signals)
    text = SPEC.replace("[data]\n", '[data]\nexperiment = "experiment"\n').split(
        "[[baseline.terms]]"
    )
    spec.write_text(
        "[[baseline.terms]]".join((text[0], text[1], text[3])) + ALONE, encoding="utf-8"
    )
    done = run("fit", spec, "--out", folder / "result")
    assert done.code == 0, done.err
    return folder, signals


@pytest.mark.parametrize("lost", [None, 61, 119, slice(1, 60)])
def test_experiments_of_a_file_are_simulated_one_by_one(labelled, tmp_path, lost):
    folder, signals = labelled
    cells = {name: np.array(column, dtype=float) for name, column in signals.items()}
    if lost is not None:
        cells["y"][lost] = np.nan
    write_csv(tmp_path / "new.csv", **cells)
    options = [] if lost is None else ["--missing", "skip"]
    done = run(
        "simulate", folder / "result", tmp_path / "new.csv", "--out", tmp_path / "out.csv", *options
    )
    assert done.code == 0, done.err
    rows = np.genfromtxt(tmp_path / "out.csv", delimiter=",", names=True)
    assert len(rows) == 180
    begin = (
        60 if isinstance(lost, slice) else 0
    )  # of an experiment without a value no instant is known
    times = np.tile(0.1 * np.arange(60), 3)
    np.testing.assert_allclose(rows["time"][begin:], times[begin:], atol=1e-9)
    without = np.flatnonzero(np.isnan(rows["y_model"])).tolist()
    wanted = {0, 60, 120}
    if lost is not None:
        wanted |= set(np.atleast_1d(np.arange(180)[lost]).tolist()) | (
            {62} if lost == 61 else set()
        )
    assert without == sorted(wanted)
    known = ~np.isnan(rows["y_model"])
    np.testing.assert_allclose(rows["y_model"][known], signals["y"][known], atol=0.01)


def test_a_file_without_the_column_of_experiments_is_one(labelled, tmp_path):
    folder, signals = labelled
    write_csv(tmp_path / "new.csv", u=signals["u"][:60], y=signals["y"][:60])
    done = run("simulate", folder / "result", tmp_path / "new.csv", "--out", tmp_path / "out.csv")
    assert done.code == 0 and "has no column 'experiment'" in unfolded(done.err)
    assert "one experiment" in unfolded(done.err)
