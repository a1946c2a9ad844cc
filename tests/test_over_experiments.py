"""Intervals for experiments like those fitted: what leaving each experiment out would change."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_cli import run

import orthaug as oa
from orthaug import Record

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")

PHYSICS = oa.Baseline.from_terms(
    [oa.Term("a", "y[k-1]", initial=0.5), oa.Term("b", "u[k-1]", initial=0.3)]
)
GAIN = 0.1  # of the cube that the physics lacks; how large it is beside b depends on the input


def response(rng: np.random.Generator, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return input and output of one experiment, whose input has a size of its own."""
    u, y = rng.uniform(0.5, 1.5) * rng.standard_normal(rows), np.zeros(rows)
    for k in range(1, rows):
        cube = GAIN * u[k - 1] ** 3
        y[k] = 0.8 * y[k - 1] + 0.5 * u[k - 1] + cube + 0.05 * rng.standard_normal()
    return u, y


def record_of(seed: int, experiments: int, rows: int = 200) -> Record:
    rng = np.random.default_rng(seed)
    made = [response(rng, rows) for _ in range(experiments)]
    return Record.join([Record.from_arrays(u=u, y=y) for u, y in made])


def without(record: Record, left_out: int) -> Record:
    kept = [e for i, e in enumerate(record.experiments) if i != left_out]
    columns = ({"u": e.inputs[:, 0], "y": e.outputs[:, 0]} for e in kept)
    return Record.join([Record.from_arrays(**own) for own in columns])


def jackknife(values: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Return standard errors from fits that each lack one experiment."""
    count = len(values)
    return np.sqrt((count - 1) / count * np.sum((values - whole) ** 2, axis=0))


def over(fit: Any) -> Any:
    assert fit.over_experiments is not None
    return fit.over_experiments


@pytest.mark.parametrize("learner", [None, oa.MLP(hidden=(4,))])
def test_one_step_ahead_it_is_the_jackknife_of_refits(learner: Any) -> None:
    record = record_of(1, 6)
    fit = oa.estimate(record, PHYSICS, learner=learner)
    refits = [oa.estimate(without(record, e), PHYSICS, learner=None).theta for e in range(6)]
    expected = jackknife(np.array(refits), fit.theta)
    np.testing.assert_allclose(over(fit).std, expected, rtol=1e-9)
    assert over(fit).freedom == 5 and over(fit).experiments == 6
    half = (over(fit).interval[:, 1] - over(fit).interval[:, 0]) / 2
    np.testing.assert_allclose(half, 2.570582 * expected, rtol=1e-6)  # Student's t, 5 degrees


def test_a_learner_that_sees_the_input_shares_only_its_gain() -> None:
    record = record_of(2, 6)
    learner = oa.MLP(hidden=(6,), inputs=("u[k-1]",))
    fit = oa.estimate(record, PHYSICS, learner=learner)
    refits = [oa.estimate(without(record, e), PHYSICS, learner=learner).theta for e in range(6)]
    expected = jackknife(np.array(refits), fit.theta)
    np.testing.assert_allclose(over(fit).std[1], expected[1], rtol=0.05)
    assert 0.5 < over(fit).std[0] / expected[0] < 2, (
        "by the noise, and by what a network makes of it"
    )
    assert over(fit).larger == (1,), "the cube moves b with the size of the input, and a hardly"


@pytest.mark.parametrize("physics_only", [True, False])
def test_on_the_free_run_it_follows_refits(physics_only: bool) -> None:
    record = record_of(3, 5, 150)
    learner = None if physics_only else oa.MLP(hidden=(4,), inputs=("u[k-1]",))
    options: dict[str, Any] = {"criterion": oa.Simulation(), "learner": learner, "blocks": 0}
    fit = oa.estimate(record, PHYSICS, **options)
    refits = [oa.estimate(without(record, e), PHYSICS, **options).theta for e in range(5)]
    expected = jackknife(np.array(refits), fit.theta)
    np.testing.assert_allclose(over(fit).std, expected, rtol=0.35)


def motion_record(seed: int, experiments: int) -> Record:
    """Return steps of a mass on a spring that hardens, with forces of several sizes."""
    rng = np.random.default_rng(seed)
    records = []
    for _ in range(experiments):
        size = rng.uniform(1.0, 4.0)
        force = np.repeat(size * rng.standard_normal(15), 10)
        x, v, seen = 0.0, 0.0, []
        for f in force:
            seen.append(x)
            for _ in range(10):
                v += 0.005 * (f - 0.6 * v - 4.0 * x - 0.8 * x**3)
                x += 0.005 * v
        seen = np.array(seen) + 0.005 * rng.standard_normal(len(seen))
        records.append(Record.from_arrays(u=force, y=seen, sampling_time=0.05))
    return Record.join(records)


MASS = """
[data]
sampling_time = 0.05
inputs = ["force"]
outputs = ["position"]
train = { files = ["run0.csv", "run1.csv", "run2.csv", "run3.csv"] }
[motion.states]
x = { derivative = "v", start = "position" }
v = { derivative = "force - c*v - k*x", start = "derivative of position"LEARNED }
[motion.parameters]
c = { initial = 1.0, min = 0 }
k = { initial = 3.0, min = 0 }
[motion.outputs]
position = "x"
[validation]
blocks = 0
"""
LEARNER = """
[learner]
kind = "mlp"
hidden = [4]
inputs = ["x"]
"""


def write(folder: Path, record: Record, names: tuple[str, str]) -> None:
    for i, experiment in enumerate(record.experiments):
        table = np.column_stack([experiment.inputs, experiment.outputs])
        np.savetxt(
            folder / f"run{i}.csv", table, delimiter=",", header=",".join(names), comments=""
        )


@pytest.mark.parametrize("learned", [False, True])
def test_of_a_motion_it_follows_refits(tmp_path: Path, learned: bool) -> None:
    write(tmp_path, motion_record(4, 4), ("force", "position"))
    text = MASS.replace("LEARNED", ", learned = true" if learned else "")
    text += LEARNER if learned else ""
    (tmp_path / "spec.toml").write_text(text)
    assert run("fit", tmp_path / "spec.toml", "--out", tmp_path / "all").code == 0
    whole = json.loads((tmp_path / "all" / "result.json").read_text())
    refits = []
    for e in range(4):
        files = ", ".join(f'"run{i}.csv"' for i in range(4) if i != e)
        start = text.index("train = "), text.index("\n", text.index("train = "))
        (tmp_path / "part.toml").write_text(
            f"{text[: start[0]]}train = {{ files = [{files}] }}{text[start[1] :]}"
        )
        assert run("fit", tmp_path / "part.toml", "--out", tmp_path / f"without{e}").code == 0
        part = json.loads((tmp_path / f"without{e}" / "result.json").read_text())
        refits.append([row["value"] for row in part["parameters"]])
    values = np.array([row["value"] for row in whole["parameters"]])
    found = whole["over_experiments"]
    assert found["experiments"] == 4
    expected = jackknife(np.array(refits), values)
    np.testing.assert_allclose([row["std"] for row in found["parameters"]], expected, rtol=0.4)
    for row, value in zip(found["parameters"], values, strict=True):
        assert 0 < row["ci95"][0] < value < row["ci95"][1], "of positive parameters"


LAGGED = """
[data]
inputs = ["u"]
outputs = ["y"]
train = { files = [FILES] }
[[baseline.terms]]
parameter = "a"
regressor = "y[k-1]"
[[baseline.terms]]
parameter = "b"
regressor = "u[k-1]"
[physics.parameters]
tau = { initial = 5, unit = "s", min = 0 }
gain = { initial = 2, min = 0 }
[physics.theta]
a = "exp(-Ts/tau)"
b = "gain*(1 - exp(-Ts/tau))"
"""


def fit_files(folder: Path, count: int) -> dict[str, Any]:
    files = ", ".join(f'"run{i}.csv"' for i in range(count))
    (folder / "spec.toml").write_text(LAGGED.replace("FILES", files))
    shown = run("fit", folder / "spec.toml", "--out", folder / f"out{count}")
    assert shown.code == 0, shown.stderr
    return json.loads((folder / f"out{count}" / "result.json").read_text())


def test_the_result_says_where_experiments_differ(tmp_path: Path) -> None:
    write(tmp_path, record_of(5, 6), ("u", "y"))
    result = fit_files(tmp_path, 6)
    found = result["over_experiments"]
    assert [row["name"] for row in found["parameters"]] == ["a", "b"]
    assert [row["name"] for row in found["physical_parameters"]] == ["tau", "gain"]
    b = found["parameters"][1]
    assert b["ratio"] == pytest.approx(b["std"] / result["parameters"][1]["std"])
    assert b["ratio"] > 3
    (warning,) = [w for w in result["warnings"] if w["code"] == "differs_between_experiments"]
    assert f"b by {b['ratio']:.2g} times" in warning["text"]
    assert "For experiments like these 6" in (tmp_path / "out6" / "report.html").read_text()
    assert "over_experiments" not in fit_files(tmp_path, 2), "two are too few"


def test_experiments_of_one_kind_do_not_differ() -> None:
    """Where the physics lacks nothing the interval of the fit is that over experiments."""
    rng, records = np.random.default_rng(6), []
    for _ in range(12):
        u, y = rng.uniform(0.5, 1.5) * rng.standard_normal(150), np.zeros(150)
        for k in range(1, 150):
            y[k] = 0.8 * y[k - 1] + 0.5 * u[k - 1] + 0.05 * rng.standard_normal()
        records.append(Record.from_arrays(u=u, y=y))
    found = over(oa.estimate(Record.join(records), PHYSICS, learner=None))
    assert np.all((found.ratio > 0.4) & (found.ratio < 1.8)) and found.larger == ()


def test_what_has_none(tmp_path: Path) -> None:
    record = record_of(7, 4, 60)
    assert oa.estimate(record_of(7, 2), PHYSICS, learner=None).over_experiments is None
    u, y = response(np.random.default_rng(9), 120)
    y[[30, 60, 90]] = np.nan
    table = np.column_stack([u, y])
    np.savetxt(tmp_path / "torn.csv", table, delimiter=",", header="u,y", comments="")
    torn = oa.read_record(tmp_path / "torn.csv", inputs=["u"], outputs=["y"], missing="skip")
    assert len(torn.experiments) == 4 and torn.recordings == (0, 0, 0, 0)
    assert oa.estimate(torn, PHYSICS, learner=None).over_experiments is None, "one recording, torn"
    additive = oa.estimate(record, PHYSICS, learner=oa.MLP(hidden=(2,)), structure=oa.Additive())
    assert additive.over_experiments is None, "its θ is not unique"
    lone = [Record.from_arrays(u=np.zeros(50), y=np.zeros(50)) for _ in range(3)]
    u, y = response(np.random.default_rng(8), 50)
    alone = oa.estimate(Record.join([*lone, Record.from_arrays(u=u, y=y)]), PHYSICS, learner=None)
    assert alone.over_experiments is None, "without the one that moves nothing determines θ"


@pytest.mark.proof
def test_intervals_over_experiments_hold(record_property: Any) -> None:
    """Count how often the intervals hold the θ that the physics has over all such experiments."""
    truth = oa.estimate(record_of(0, 400, 300), PHYSICS, learner=None).theta
    held, conditional = np.zeros(2), np.zeros(2)
    for seed in range(100):
        fit = oa.estimate(record_of(1000 + seed, 8), PHYSICS, learner=None, standard_errors="plain")
        low, high = over(fit).interval.T
        held += (low <= truth) & (truth <= high)
        low, high = np.asarray(fit.interval).T
        conditional += (low <= truth) & (truth <= high)
    record_property("covered by 95 % [%], a and b", held.tolist())
    record_property("covered by the interval of the fit [%]", conditional.tolist())
    assert np.all(held >= 86) and conditional[1] < 40
