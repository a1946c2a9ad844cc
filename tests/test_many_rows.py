"""Runs over many rows begin where runs over some of them ended, whatever engine has the rows."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
import pytest
from test_free_run import PHYSICS, nonlinear

import orthaug as oa
from orthaug import Orthogonal, Stream
from orthaug._base.progress import StopTraining
from orthaug.fitting import one_step
from orthaug.fitting.one_step import OneStepTask
from orthaug.fitting.training import plan_runs
from orthaug.physics.problem import pose

ROWS, LM, NETWORK = 4000, oa.LevenbergMarquardt(100), oa.MLP(hidden=(3,))


@cache
def given():
    return nonlinear(1, (ROWS,))


@pytest.fixture
def many(monkeypatch):
    monkeypatch.setattr(one_step, "MANY_ROWS", ROWS // 2)
    monkeypatch.setattr(one_step, "FEW_ROWS", 800)


def fitted(record=None, **options):
    chosen = {"learner": NETWORK, "solver": LM, "regularization": "none", "blocks": 0} | options
    return oa.estimate(given() if record is None else record, PHYSICS, **chosen)


def test_a_run_ends_as_low_as_from_its_own_start(many, monkeypatch):
    found = fitted()
    monkeypatch.setattr(one_step, "MANY_ROWS", np.inf)
    expected = fitted()
    assert found.status.loss == pytest.approx(expected.status.loss, rel=1e-3)
    assert found.status.loss != expected.status.loss
    assert found.status.start_loss == expected.status.start_loss > found.status.loss
    assert found.restarts[0].iterations == found.status.iterations
    np.testing.assert_allclose(found.theta, expected.theta, rtol=1e-12)  # F1: no learner moves it


@pytest.mark.parametrize("regularization", ["none", "evidence", "ard"])
def test_it_begins_at_the_weights_where_the_run_over_some_rows_ended(many, regularization):
    task = OneStepTask.of(pose(given(), PHYSICS), NETWORK).prepare(LM, Orthogonal())
    few = task.few
    assert len(few.problem.record) == 800 and few.few is None
    np.testing.assert_array_equal(few.scaling.halfwidth, task.scaling.halfwidth)
    np.testing.assert_array_equal(few.unit, task.unit)
    (start,) = plan_runs(task.bound, range(1), [regularization])
    first = few.run(LM, start.weights, Orthogonal(), regularization)
    expected = replace(task, few=None).run(LM, first.w, Orthogonal(), regularization)
    found = fitted(regularization=regularization)
    np.testing.assert_array_equal(found.model.numbers.weights, expected.w)
    assert found.status.iterations == expected.iterations


def test_progress_counts_passes_over_all_rows_and_asks_for_an_end_in_both(many):
    entries, few = [], []
    fitted(
        progress=lambda run, iteration, loss: entries.append(iteration),
        solver=oa.LevenbergMarquardt(40),
    )
    assert entries[0] == 0 and entries == sorted(entries)

    def enough(run, iteration, loss):
        few.append(iteration)
        raise StopTraining

    found = fitted(progress=enough)
    assert (
        few[0] == 0 < few[-1] and len(few) <= 4
    )  # a run that is stopped above physics alone starts anew, silent
    assert found.status.code == "stopped" and "stopped" in [
        warning.code for warning in found.warnings
    ]


def test_fewer_rows_are_run_over_as_they_are():
    assert OneStepTask.of(pose(given(), PHYSICS), NETWORK).prepare(LM, Orthogonal()).few is None


def test_rows_that_lack_what_the_physics_needs_are_not_begun_with(many):
    u, y = np.zeros(ROWS), np.zeros(ROWS)
    rng = np.random.default_rng(0)
    u[100:300] = rng.normal(size=200)  # between the windows that stand for all rows
    for k in range(2, ROWS):
        y[k] = (
            0.9 * y[k - 1]
            - 0.3 * y[k - 2]
            + 0.5 * u[k - 1]
            + 0.3 * np.tanh(2 * y[k - 1])
            + 0.01 * rng.normal()
        )
    record = oa.Record.from_arrays(u, y)
    assert OneStepTask.of(pose(record, PHYSICS), NETWORK).prepare(LM, Orthogonal()).few is None
    assert fitted(record).status.ok


def test_streamed_rows_begin_where_those_in_memory_do(many, tmp_path):
    pytest.importorskip("pyarrow")
    one = given().experiments[0]
    frame = pd.DataFrame({"u": one.inputs[:, 0], "y": one.outputs[:, 0]})
    frame.to_parquet(tmp_path / "run.parquet", row_group_size=900)
    names = {"inputs": ["u"], "outputs": ["y"], "sampling_time": 1.0}
    source = oa.open_parquet([tmp_path / "run.parquet"], **names)
    frame = oa.Record.from_arrays(
        one.inputs, one.outputs, sampling_time=1.0, inputs=["u"], outputs=["y"]
    )
    short = {"solver": oa.LevenbergMarquardt(20)}
    here, there = fitted(frame, **short), fitted(source, engine=Stream(), **short)
    assert here.status.iterations == there.status.iterations
    assert there.status.loss == pytest.approx(here.status.loss, rel=1e-8)
    np.testing.assert_allclose(there.theta, here.theta, rtol=1e-9)
