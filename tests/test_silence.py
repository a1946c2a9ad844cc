"""Folds that evidence silences are made again with the ridge of all rows, and only these."""

from types import SimpleNamespace

import numpy as np
import pytest

import orthaug as oa
from orthaug.fitting import silence
from orthaug.fitting.status import Ending


@pytest.fixture(autouse=True)
def _a_ridge(monkeypatch):
    monkeypatch.setattr(silence, "evidence_ridge", lambda objective, point, effective: 0.123456)


def _run(effective, ending=Ending.CONVERGED, iterations=10):
    end = SimpleNamespace(point=None)
    return SimpleNamespace(
        effective=effective, ending=ending, objective=None, end=end, iterations=iterations
    )


def _start(regularization):
    return SimpleNamespace(regularization=regularization)


def test_a_learner_that_lives_on_all_rows_has_a_ridge_for_its_folds():
    assert silence.fold_ridges([_start("evidence")], [_run(8.8)], 1) == [0.123]


@pytest.mark.parametrize(
    ("regularization", "run"),
    [
        ("none", _run(8.8)),
        (0.01, _run(8.8)),
        ("evidence", _run(0.9)),
        ("evidence", _run(2.5)),
        ("evidence", _run(8.8, Ending.STOPPED)),
    ],
)
def test_no_other_has_one(regularization, run):
    """Neither what is no evidence, nor what is silent on all rows: there `add_retries` has weaker ones."""
    assert silence.fold_ridges([_start(regularization)], [run], 2) == [None]


def test_runs_that_left_the_same_are_made_on_blocks_once():
    runs = [_run(3.0, iterations=124), _run(3.01, iterations=33), _run(3.0), _run(9.0), _run(3.0)]
    runs += [_run(0.4), _run(0.9, iterations=2), _run(np.nan), _run(3.0, Ending.NON_FINITE)]
    starts = [_start("evidence")] * 4 + [_start("none")] + [_start("evidence")] * 4
    losses = [0.0468295, 0.0468293, 0.0336, 0.0468294, 0.0468294, 0.06, 0.061, 0.0468, 0.0468295]
    assert silence.stand_ins(starts, runs, losses, 1) == [1, 1, 2, 3, 4, 6, 6, 7, 8]


def self_excited(seed: int) -> oa.Record:
    """Van der Pol's oscillator with dry friction, and noise of 1 % on its sensor."""
    rng, x, found = np.random.default_rng(seed), np.array([1.0, 0.0]), []
    inputs = np.repeat(rng.uniform(-1.5, 1.5, 20), 10)

    def rates(x: np.ndarray, u: float) -> np.ndarray:
        friction = 0.4 * np.tanh(x[1] / 0.2)
        return np.array([x[1], 0.8 * (1 - x[0] ** 2) * x[1] - x[0] + u - friction])

    for now in inputs:
        found.append(x[0])
        for _ in range(10):
            x = x + 0.01 * rates(x + 0.005 * rates(x, now), now)
    y = np.array(found)
    noise = 0.01 * y.std() * rng.normal(size=len(y))
    return oa.Record.from_arrays(u=inputs, y=y + noise, sampling_time=0.1)


@pytest.mark.parametrize("seed", [1, 7])
def test_evidence_that_settles_with_few_weights_is_begun_where_training_without_it_ends(seed):
    """From a silent learner it ended at 4 to 5 times the noise, and mu at 0.56 to 0.83 for 0.8."""
    motion = oa.Motion.from_equations(
        [
            oa.State("x", "v", start="y"),
            oa.State("v", "mu*(1 - x*x)*v - k*x + u", start=0.0, learned=True),
        ],
        [oa.Output("y", "x")],
        [oa.PhysicalParameter("mu", 0.5), oa.PhysicalParameter("k", 1.2, min=0)],
        ["u"],
    )
    record = self_excited(seed)
    fit = oa.estimate(record, motion, learner=oa.MLP((3,), inputs=("v",)), seed=0, blocks=0)
    run = fit.model.simulate(record).trajectories[0]
    noise = 0.01 * run.measured.std()
    assert np.sqrt(np.mean((run.measured - run.model) ** 2)) < 1.1 * noise
    assert abs(fit.theta[0] - 0.8) < 0.02
