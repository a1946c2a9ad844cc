"""Engines that share one result: the same spec in memory, streamed, on two devices and on a Dask cluster."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import orthaug as oa
from orthaug import Stream
from orthaug.commands.select import open_select, select_for
from orthaug.commands.spec import load_spec
from orthaug.data.sources import witness

pytest.importorskip("pyarrow")
ROWS, GROUP = 1200, 170

SPEC = """
[data]
sampling_time = 0.1
inputs = ["u"]
outputs = ["y"]
experiment = "run"
train = {{ files = ["runs/*.parquet"] }}
tests = {{ held = {{ files = ["held.parquet"], skip = 30 }} }}
[lags]
na = 2
nb = 2
[learner]
hidden = [3]
[training]
focus = "prediction"
iterations = 8
regularization = {regularization}
[structure]
kind = "{structure}"
[validation]
blocks = 0
[[baseline.terms]]
parameter = "a"
initial = 1.4
regressor = "y[k-1]"
[[baseline.terms]]
parameter = "b"
initial = -0.6
regressor = "y[k-2]"
[[baseline.terms]]
parameter = "c"
initial = 0.1
regressor = "u[k-1]"
[engine]
kind = "{kind}"
partition_rows = 400
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two files of two experiments each, and a third that is held out."""
    place = tmp_path_factory.mktemp("engines")
    rng = np.random.default_rng(0)
    u, y = rng.uniform(-1, 1, ROWS), np.zeros(ROWS)
    for k in range(2, ROWS):
        y[k] = (
            1.5 * y[k - 1]
            - 0.7 * y[k - 2]
            + 0.1 * u[k - 1]
            - 0.05 * math.tanh(8 * (y[k - 1] - y[k - 2]))
        )
        y[k] += 1e-3 * rng.normal()
    frame = pd.DataFrame({"u": u, "y": y, "run": np.repeat([1, 2, 3, 4], ROWS // 4)})
    (place / "runs").mkdir()
    frame[:500].to_parquet(place / "runs" / "a.parquet", row_group_size=GROUP)
    frame[500:1000].to_parquet(place / "runs" / "b.parquet", row_group_size=GROUP)
    frame[1000:].to_parquet(place / "held.parquet", row_group_size=GROUP)
    return place


def fitted(folder, kind, structure="orthogonal", regularization='"none"', more=""):
    path = folder / f"{kind}.toml"
    text = SPEC.format(kind=kind, structure=structure, regularization=regularization)
    path.write_text(text + more + "\n", encoding="utf-8")
    job = oa.load_spec(path)
    found = json.loads(oa.fit_spec(job).result.to_json())
    if kind == "dask":
        job.engine.client.close()
    return found


def differences(one, other, place=""):
    """Where two results differ by more than rounding."""
    if isinstance(one, dict) and isinstance(other, dict):
        keys = sorted({*one, *other})
        return [
            d for key in keys for d in differences(one.get(key), other.get(key), f"{place}/{key}")
        ]
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        return [
            d
            for i, pair in enumerate(zip(one, other, strict=True))
            for d in differences(*pair, f"{place}[{i}]")
        ]
    numbers = isinstance(one, float) and isinstance(other, float)
    same = np.isclose(one, other, rtol=1e-6, atol=1e-11) if numbers else one == other
    return [] if same else [f"{place}: {one} {other}"]


def check_same(found, expected):
    """But for the scores of physics alone and trials of advice, for which files are not read once more."""
    for parameter, other in zip(found["parameters"], expected["parameters"], strict=True):
        assert parameter["value"] == pytest.approx(other["value"], rel=1e-9)
    assert found["status"]["loss"] == pytest.approx(expected["status"]["loss"], rel=1e-8)
    left_out = ["/spec/engine", "/status/seconds", "/physics_alone", "/advice"]
    if "over_experiments" not in found:  # it needs the influence of every row
        left_out.append("/over_experiments")
    streamed = found["standard_errors"] == "plain"
    if (
        streamed and expected.get("standard_errors_by") == "hc3"
    ):  # it needs the derivative of every row at once
        for parameter, other in zip(found["parameters"], expected["parameters"], strict=True):
            assert parameter["std"] == pytest.approx(other["plain_std"], rel=1e-6)
            for key in ("std", "plain_std", "ci95", "ci95_with_bias"):
                parameter[key] = other.get(key)
        left_out += ["/standard_errors", "/warnings"]  # warnings count biases in standard errors
    result = [d for d in differences(found, expected) if not d.startswith(tuple(left_out))]
    assert result == [], "\n".join(result)


CASES = [("orthogonal", '"none"'), ("additive", "0.1"), ("orthogonal-penalty", '"evidence"'),
         ("baseline-penalty", '"none"')]  # fmt: skip


@pytest.mark.parametrize(("structure", "regularization"), CASES)
def test_streamed_files_give_the_result_of_rows_in_memory(folder, structure, regularization):
    check_same(*(fitted(folder, kind, structure, regularization) for kind in ("stream", "memory")))


def test_the_residual_of_all_rows_is_tested_where_a_witness_stands_for_them(folder, monkeypatch):
    whole = fitted(folder, "memory")
    assert whole["scores"]["train"]["residual"] is None
    monkeypatch.setattr("orthaug.commands.parts.witness", lambda source: witness(source, 300))
    found = fitted(folder, "stream")
    assert [w["code"] for w in found["warnings"]].count("witness") == 1
    (running,), (wanted,) = found["scores"]["train"]["residual"], whole["residuals"]["one_step"]
    assert running["n"] == wanted["n"] > found["residuals"]["one_step"][0]["n"]
    np.testing.assert_allclose(running["acf"], wanted["acf"], atol=1e-6)
    np.testing.assert_allclose(
        running["cross"]["u"]["values"], wanted["cross"]["u"]["values"], atol=1e-6
    )
    assert running["ljung_box"]["statistic"] == pytest.approx(
        wanted["ljung_box"]["statistic"], rel=1e-5
    )


@pytest.fixture(scope="module")
def cluster():
    pytest.importorskip("distributed")
    from orthaug.models.cluster import connect

    client = connect(None, 2)
    yield client
    client.close()
    client.cluster.close()


def on_cluster(folder, cluster, *choices):
    return fitted(folder, "dask", *choices, more=f'scheduler = "{cluster.scheduler.address}"')


@pytest.fixture(scope="module")
def undisturbed(folder, cluster):
    return on_cluster(folder, cluster)


def test_a_cluster_gives_the_result_of_rows_in_memory(folder, cluster, undisturbed):
    check_same(undisturbed, fitted(folder, "memory"))
    check_same(on_cluster(folder, cluster, *CASES[1]), fitted(folder, "memory", *CASES[1]))


BASELINE = oa.Baseline.from_terms(
    [oa.Term("a", "y[k-1]"), oa.Term("b", "y[k-2]"), oa.Term("c", "u[k-1]")]
)
OPTIONS = {"lags": oa.Lags(na=2, nb=2), "learner": oa.MLP(hidden=(3,)), "solver": oa.LevenbergMarquardt(20),
           "regularization": "none"}  # fmt: skip
COLUMNS = {"inputs": ["u"], "outputs": ["y"], "sampling_time": 0.1, "experiment": "run"}


def from_files(folder):
    files = sorted((folder / "runs").glob("*.parquet"))
    return oa.Record.join([oa.read_record(file, **COLUMNS) for file in files])


def test_files_as_a_record(folder):
    """From Python: what is handed in chooses the engine."""
    expected = oa.estimate(from_files(folder), BASELINE, **OPTIONS)
    source = oa.open_parquet(
        sorted((folder / "runs").glob("*.parquet")), partition_rows=300, **COLUMNS
    )
    found = oa.estimate(source, BASELINE, **OPTIONS)
    np.testing.assert_allclose(found.theta, expected.theta, rtol=1e-10)
    assert found.status.loss == pytest.approx(expected.status.loss, rel=1e-8)
    with pytest.raises(
        oa.InputError, match="`segment` is 0, whole experiments, which need their rows in memory"
    ):
        oa.estimate(source, BASELINE, criterion=oa.Simulation(0), **OPTIONS)
    with pytest.raises(oa.InputError, match="a motion needs its rows in memory"):
        flown_motion(source)


def test_a_frame_on_a_cluster_as_a_record(folder, cluster):
    """Partitions of another length than the experiments; the rows stay on the workers."""
    import dask.dataframe as dd

    frame = pd.concat(
        [pd.read_parquet(file) for file in sorted((folder / "runs").glob("*.parquet"))]
    )
    frame = frame.reset_index(drop=True)
    frame.to_parquet(folder / "whole.parquet")
    expected = oa.estimate(oa.read_record(folder / "whole.parquet", **COLUMNS), BASELINE, **OPTIONS)
    frame = dd.from_pandas(frame, chunksize=130)
    found = oa.estimate(oa.open_frame(frame, client=cluster, **COLUMNS), BASELINE, **OPTIONS)
    assert found.problem.count == expected.problem.count == 1000 - 4 * 2
    np.testing.assert_allclose(found.theta, expected.theta, rtol=1e-10)
    with pytest.raises(oa.InputError, match="the DataFrame has no column 'z'; it has u, y, run"):
        oa.open_frame(frame, client=cluster, inputs=["u"], outputs=["z"])
    emptied = dd.concat([frame, frame[frame["u"] > 9]])
    with pytest.raises(oa.InputError, match="partition .* of the DataFrame is empty"):
        oa.open_frame(emptied, client=cluster, **COLUMNS)


FLIGHT = {
    "regularization": "evidence",
    "blocks": 0,
    "fallback": False,
    "solver": oa.LevenbergMarquardt(),
    "standard_errors": "plain",
}


def flown_lagged(record, engine=None, **options):
    """A free run over segments that are too short for the colour of its noise."""
    criterion = oa.Simulation(40, 20, start_iterations=0)
    given = OPTIONS | FLIGHT | options
    return oa.estimate(record, BASELINE, **given, criterion=criterion, engine=engine)


def flown_motion(record, engine=None, **options):
    """A motion in discrete time, whose segments show that colour themselves."""
    states = [oa.State("x", "a*x + b*z + c*u", start="y", learned=True), oa.State("z", "x")]
    values = [
        oa.PhysicalParameter("a", 1.4),
        oa.PhysicalParameter("b", -0.6),
        oa.PhysicalParameter("c", 0.1),
    ]
    motion = oa.Motion.from_equations(
        states, [oa.Output("y", "x")], values, ["u"], integrator="discrete"
    )
    learner, criterion = oa.MLP((2,)), oa.Simulation(60, 0)
    given = FLIGHT | options
    return oa.estimate(record, motion, learner=learner, **given, criterion=criterion, engine=engine)


def told_of(fit):
    return {"theta": fit.theta.tolist(), "loss": fit.status.loss, "noise": np.ravel(fit.covariance).tolist(),
            "iterations": fit.status.iterations}  # fmt: skip


@pytest.fixture(scope="module")
def in_memory(folder):
    record = from_files(folder)
    return {"lagged": told_of(flown_lagged(record)), "motion": told_of(flown_motion(record))}


def check_flown(found, expected):
    # Rounding grows along a run without a prior and one by evidence from its end: it is compared
    # with the standard errors, of which it must be nothing.
    size = np.sqrt(np.diag(np.reshape(expected["noise"], (len(expected["theta"]), -1))))
    assert (np.abs(np.subtract(found["theta"], expected["theta"])) <= 1e-6 * size).all()
    assert found["loss"] == pytest.approx(expected["loss"], rel=1e-6)  # 1e-3 of −2 log L
    np.testing.assert_allclose(found["noise"], expected["noise"], rtol=1e-4)
    assert abs(found["iterations"] - expected["iterations"]) <= 1


def opened(folder):
    """Partitions that segments reach across."""
    return oa.open_parquet(
        sorted((folder / "runs").glob("*.parquet")), partition_rows=200, **COLUMNS
    )


def test_segments_of_files_give_the_free_run_of_rows_in_memory_to_rounding(folder):
    """With a fixed ridge and few steps: rounding has not grown yet."""
    record = from_files(folder)
    ridge = {"regularization": 0.01, "solver": oa.LevenbergMarquardt(5)}
    pairs = (
        (flown_lagged(opened(folder), **ridge), flown_lagged(record, **ridge)),
        (flown_motion(record, Stream(), **ridge), flown_motion(record, **ridge)),
    )
    for streamed, whole in pairs:
        np.testing.assert_allclose(streamed.theta, whole.theta, rtol=1e-10)
        weights = [fit.model.numbers.weights for fit in (streamed, whole)]
        np.testing.assert_allclose(*weights, rtol=1e-8)
        assert streamed.status.loss == pytest.approx(whole.status.loss, rel=1e-10)
        assert streamed.status.iterations == whole.status.iterations


def test_segments_of_files_give_the_free_run_of_rows_in_memory(folder, in_memory):
    check_flown(told_of(flown_lagged(opened(folder))), in_memory["lagged"])
    check_flown(told_of(flown_motion(from_files(folder), Stream())), in_memory["motion"])


def test_errors_of_a_streamed_free_run_are_those_of_all_rows(folder, monkeypatch):
    """Also where a witness stands for them: what the learner takes from θ is known from all, its scores are scaled."""
    whole = flown_lagged(from_files(folder))
    monkeypatch.setattr("orthaug.fitting.fit_plans.witness", lambda source: witness(source, 500))
    found = flown_lagged(opened(folder))
    assert len(found.problem.record) == 500 and found.problem.count == whole.problem.count
    moved = whole.moves_by()[0]
    np.testing.assert_allclose(found.moves_by()[0], moved, atol=1e-5 * np.abs(moved).max())
    ratio = found.robust(20).parameters["std"] / whole.robust(20).parameters["std"]
    assert ratio.between(0.7, 1.4).all()


@pytest.mark.proof
def test_segments_on_workers_give_the_free_run_of_rows_in_memory(folder, in_memory, cluster):
    from orthaug import Dask

    check_flown(told_of(flown_lagged(opened(folder), Dask(cluster))), in_memory["lagged"])
    check_flown(told_of(flown_motion(from_files(folder), Dask(cluster))), in_memory["motion"])


def test_a_study_on_a_cluster(cluster):
    """Its cases are tasks; the table is that of this process."""
    from orthaug.studies.study import Study, run

    study = Study("powers", pow_of, {"base": [1, 2, 3], "exp": [2, 3]})
    found, expected = run(study, client=cluster), run(study)
    pd.testing.assert_frame_equal(found.drop(columns="process"), expected.drop(columns="process"))
    assert os.getpid() not in set(found["process"]) and set(expected["process"]) == {os.getpid()}


def pow_of(base, exp):
    return {"value": base**exp, "process": os.getpid()}


def test_workers_that_are_killed_change_nothing(folder, cluster, undisturbed):
    """Their partitions are laid out again elsewhere; sums keep their order, so θ keeps its bits.

    Both are lost at once here; `test_a_selection_on_a_cluster_has_the_bits_of_one_here` loses one of two.
    """
    workers = cluster.run(os.getpid)
    timers = [killed_in(0.4, process) for process in workers.values()]
    after = on_cluster(folder, cluster)
    for timer in timers:
        timer.join()
    assert {*cluster.run(os.getpid).values()} & {*workers.values()} == set()
    assert [p["value"] for p in after["parameters"]] == [
        p["value"] for p in undisturbed["parameters"]
    ]
    assert after["status"]["loss"] == pytest.approx(undisturbed["status"]["loss"], rel=1e-12)


def killed_in(seconds, process):
    timer = threading.Timer(seconds, os.kill, (process, signal.SIGKILL))
    timer.start()
    return timer


def test_memory_for_the_matrices_of_a_learner_is_asked_of_the_workers(cluster, monkeypatch):
    """Told before anything is sent; the limits are those that the scheduler knows."""
    u = np.linspace(-1, 1, 300)
    record, physics = (
        oa.Record.from_arrays(u=u, y=u + u**3),
        oa.Baseline.from_terms([oa.Term("a", "u[k]")]),
    )
    wide = {
        "learner": oa.MLP(hidden=(3000,)),
        "regularization": "none",
    }  # 9001 weights, 0.6 GiB a matrix
    limits = {
        "workers": {"tcp://a:1": {"memory_limit": 8 << 30}, "tcp://b:1": {"memory_limit": 1 << 30}}
    }
    monkeypatch.setattr(cluster, "scheduler_info", lambda **_: limits)
    monkeypatch.setattr("orthaug._base.memory.available", lambda: math.inf)
    match = (
        "takes {} on each worker or device, for . matrices of its weights; the worker "
        "tcp://b:1 has 1 GiB"
    )
    for restarts, size in (
        (1, "5.43 GiB"),
        (2, "1.81 GiB"),
    ):  # sums over the workers; whole runs on them
        with pytest.raises(oa.InputError, match=match.format(size)):
            oa.estimate(record, physics, engine=oa.Dask(cluster), restarts=restarts, **wide)
    monkeypatch.setattr("orthaug.models.devices.available", lambda: 1 << 30)
    with pytest.raises(oa.InputError, match="the device cpu:0 has 1 GiB"):
        oa.estimate(record, physics, engine=oa.Devices(), **wide)


DEVICES = """
import sys
sys.path.insert(0, {tests!r})
import pathlib, json, test_engines as t
import orthaug as oa
folder = pathlib.Path({folder!r})
(folder / "devices.json").write_text(json.dumps(t.fitted(folder, "devices", more="devices = 3")))
for kind, fly in (("lagged", t.flown_lagged), ("motion", t.flown_motion)):
    (folder / f"{{kind}}.json").write_text(json.dumps(t.told_of(fly(t.from_files(folder), oa.Devices()))))
import jax
assert len(jax.devices()) == 4
"""


@pytest.mark.proof
def test_devices_give_the_result_of_rows_in_memory(folder, in_memory):
    """Three of four from a spec, all four from Python."""
    script = DEVICES.format(tests=os.path.dirname(__file__), folder=str(folder))
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=4"
    environment = os.environ | {"XLA_FLAGS": flags}
    run = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env=environment, check=False
    )
    assert run.returncode == 0, run.stderr
    check_same(json.loads((folder / "devices.json").read_text()), fitted(folder, "memory"))
    for kind, other in in_memory.items():
        check_flown(json.loads((folder / f"{kind}.json").read_text()), other)


def tables(folder, cluster, text, function):
    """What a function gives for a spec in memory, and on a cluster."""
    for kind, more in (("memory", ""), ("dask", f'scheduler = "{cluster.scheduler.address}"\n')):
        path = folder / f"runs-{kind}.toml"
        path.write_text(
            text.format(kind=kind, structure="orthogonal", regularization="[0.1, 1.0]") + more,
            "utf-8",
        )
        yield function(path)


@pytest.fixture(scope="module")
def held_here(folder):
    """A spec whose rows are in memory wherever it is fitted."""
    whole = pd.concat(
        [pd.read_parquet(file) for file in sorted((folder / "runs").glob("*.parquet"))]
    )
    whole[whole["run"] < 3].to_csv(folder / "rows.csv", index=False)
    return SPEC.replace("runs/*.parquet", "rows.csv").replace("blocks = 0", "blocks = 2")


def test_runs_on_a_cluster_have_the_bits_of_runs_here(folder, cluster, held_here):
    """Two regularizations, the blocks that choose between them, and those of the verdict: whole runs are tasks."""

    def fitted_to(path):
        return json.loads(oa.fit_spec(path).result.to_json())

    expected, found = tables(folder, cluster, held_here, fitted_to)
    for result in (expected, found):
        result["spec"].pop("engine"), result["status"].pop("seconds")
        result.pop("advice"), result.pop("advice_trials")  # rows in memory only
    assert found == expected
    assert len(found["restarts"]) == 2 and len(found["validation"]["trials"]) == 3


def test_a_selection_on_a_cluster_has_the_bits_of_one_here(folder, cluster, held_here):
    """Also where a worker is killed meanwhile."""

    def selected(path):
        timer = killed_in(0.5, workers[0]) if "dask" in path.name else threading.Timer(0, str)
        found = select_for(*open_select(path), folder / "selected", lambda *_: None)
        timer.cancel()
        return found.selection

    text = held_here.replace("hidden = [3]", 'kind = "terms"\ndegree = 2')
    workers = [*cluster.run(os.getpid).values()]
    expected, found = tables(folder, cluster, text, selected)
    here, there = (one.table.drop(columns="seconds") for one in (expected, found))
    pd.testing.assert_frame_equal(there, here, check_exact=True)
    assert found.learner == expected.learner and found.shares == expected.shares
    assert workers[0] not in cluster.run(os.getpid).values()
    streamed = text.format(kind="stream", structure="orthogonal", regularization="0.1")
    (folder / "streamed.toml").write_text(streamed, "utf-8")
    with pytest.raises(oa.InputError, match="found stream; expected memory, or dask, to select"):
        open_select(folder / "streamed.toml")


def bad(folder, match, frame=None, name="c.parquet", **changes):
    """A spec whose files are wrong is refused in words."""
    text = SPEC.format(kind="stream", structure="orthogonal", regularization='"none"')
    for old, new in changes.values():
        text = text.replace(old, new)
    extra = folder / "runs" / name
    if frame is not None:
        frame.to_parquet(extra)
    path = folder / "bad.toml"
    path.write_text(text, encoding="utf-8")
    try:
        with pytest.raises(oa.InputError, match=match):
            oa.load_spec(path)
    finally:
        extra.unlink(missing_ok=True)


def test_what_is_wrong_with_a_partition_is_named(folder):
    good = pd.read_parquet(folder / "held.parquet")
    bad(folder, r"c.parquet: no column 'y'", good.drop(columns="y"))
    bad(
        folder,
        r"c.parquet: column 'u' holds float values, in .*a.parquet double",
        good.astype({"u": "float32"}),
    )
    bad(
        folder,
        r"c.parquet: column 'u' holds .*string.* values; expected numbers",
        good.astype({"u": str}),
    )
    bad(folder, r"c.parquet: there are no data rows", good[:0])
    bad(folder, r"c.parquet: row 57, column 'y': the cell is empty; expected a finite number",
        good.assign(y=good["y"].where(np.arange(len(good)) != 57)))  # fmt: skip
    mixed = good.assign(
        run=np.where(np.arange(len(good)) < 100, 4, np.where(np.arange(len(good)) < 150, 5, 4))
    )
    bad(
        folder,
        r"c.parquet: row 150: experiment 4 goes on after another has begun; sort the rows by 'run'",
        mixed,
    )
    timed = ("sampling_time = 0.1", 'time = "t"')
    for file in ("runs/a.parquet", "runs/b.parquet"):
        frame = pd.read_parquet(folder / file)
        frame.assign(t=0.1 * np.arange(len(frame))).to_parquet(folder / file, row_group_size=GROUP)
    swapped = good.assign(t=np.where(np.arange(len(good)) == 33, 0.2, 0.1 * np.arange(len(good))))
    bad(
        folder,
        r"c.parquet: row 33, column 't': a step of .* s where 0.1 s is usual",
        swapped,
        timed=timed,
    )
    bad(folder, r"c.parquet: sampled every 0.2 s, .*a.parquet every 0.1 s", good.assign(t=0.2 * np.arange(len(good))),
        timed=timed)  # fmt: skip
    bad(folder, "no file matches 'nothing/", pattern=("runs/*", "nothing/*"))
    bad(
        folder,
        "`rows` and `every` need the rows in memory",
        rows=('*.parquet"]', '*.parquet"], every = 2'),
    )
    whole = 'focus = "simulation"\nsegment = 0'
    bad(
        folder,
        "found stream; expected memory, devices or dask: `training.segment` = 0",
        focus=('focus = "prediction"', whole),
    )


def test_a_file_that_changes_is_noticed(folder):
    path = folder / "changing.toml"
    path.write_text(
        SPEC.format(kind="stream", structure="orthogonal", regularization='"none"'),
        encoding="utf-8",
    )
    job = oa.load_spec(path)
    file = folder / "runs" / "b.parquet"
    content = file.read_bytes()
    try:
        file.write_bytes(content)  # the same bytes at another time
        with pytest.raises(
            oa.InputError, match=r"b.parquet: the file has changed since it was opened"
        ):
            job.run()
    finally:
        file.write_bytes(content)


def test_gaps_end_a_stretch_in_files_too(folder, tmp_path):
    frame = pd.read_parquet(folder / "runs" / "a.parquet")[["u", "y", "run"]]
    frame.loc[[3, 77, 78, 171, 340], "y"] = np.nan
    (tmp_path / "runs").mkdir()
    frame.to_parquet(tmp_path / "runs" / "a.parquet", row_group_size=GROUP)
    pd.read_parquet(folder / "held.parquet").to_parquet(tmp_path / "held.parquet")
    thetas = []
    for kind in ("memory", "stream"):
        text = SPEC.format(kind=kind, structure="orthogonal", regularization='"none"')
        text = text.replace("[data]", '[data]\nmissing = "skip"')
        (tmp_path / "spec.toml").write_text(text, encoding="utf-8")
        problem = oa.load_spec(tmp_path / "spec.toml").problem
        thetas.append((problem.count, problem.least_squares))
    assert thetas[0][0] == thetas[1][0]
    np.testing.assert_allclose(thetas[1][1], thetas[0][1], rtol=1e-12)


def test_files_for_clusters_say_what_the_program_takes(folder, monkeypatch):
    """They are not run here: what can be checked is that they parse, and that the spec that is made of them does."""
    import yaml

    place = Path(__file__).parents[1] / "examples" / "cluster"
    compose, operator = (
        yaml.safe_load((place / name).read_text()) for name in ("compose.yaml", "kubernetes.yaml")
    )
    threads = {"OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "XLA_FLAGS"}
    assert threads == set(compose["services"]["worker"]["environment"])
    (container,) = operator["spec"]["worker"]["spec"]["containers"]
    assert threads == {variable["name"] for variable in container["env"]}
    monkeypatch.syspath_prepend(place)
    import slurm

    path = folder / "plain.toml"
    path.write_text(
        SPEC.split("[engine]")[0].format(structure="orthogonal", regularization='"none"'),
        encoding="utf-8",
    )
    engine = load_spec(slurm.with_engine(path, "tcp://there:8786")).engine
    assert (engine.kind, engine.scheduler, engine.partition_rows) == (
        "dask",
        "tcp://there:8786",
        5_000_000,
    )


def test_no_cluster_in_reach_is_reported(folder, monkeypatch):
    monkeypatch.setattr("orthaug.models.cluster._PATIENCE", "1 s")
    with pytest.raises(oa.InputError, match=r"no Dask scheduler answers at tcp://127.0.0.1:9 "):
        fitted(folder, "dask", more='scheduler = "tcp://127.0.0.1:9"')


def test_workers_of_another_version_are_refused():
    from orthaug.models.cluster import check_versions, versions

    def client(*answers):
        return SimpleNamespace(
            run=lambda _, on_error: {f"tcp://there:{i}": found for i, found in enumerate(answers)}
        )

    same = versions()
    check_versions(
        client(same, OSError("killed"), same)
    )  # one that dies while it is asked takes no part
    with pytest.raises(
        oa.InputError, match=r"the worker tcp://there:1 has orthaug .*, jax 0.1; here is"
    ):
        check_versions(client(same, same | {"jax": "0.1"}))
    with pytest.raises(
        oa.InputError, match=r"the worker tcp://there:0 has No module named 'orthaug'; here is"
    ):
        check_versions(client(ModuleNotFoundError("No module named 'orthaug'")))
    assert set(versions()) == {"orthaug", "jax"}
