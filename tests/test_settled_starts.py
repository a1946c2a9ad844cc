"""Starts by least squares on measured rows: of segments in training, and of predictions."""

from __future__ import annotations

import numpy as np
import pytest

import orthaug as oa
from orthaug.analysis import scoring
from orthaug.data.part import Part

STEP = 0.02


def decay(rows: int = 1100) -> np.ndarray:
    """Return angles of θ'' = −21.8 sin θ − 0.05 θ' − 0.06 θ'|θ'| from 2.6 rad at rest, in rad."""
    state, found = np.array([2.6, 0.0]), []

    def rates(x: np.ndarray) -> np.ndarray:
        return np.array([x[1], -21.8 * np.sin(x[0]) - x[1] * (0.05 + 0.06 * abs(x[1]))])

    for _ in range(rows):
        found.append(state[0])
        a = rates(state)
        b = rates(state + STEP / 2 * a)
        c = rates(state + STEP / 2 * b)
        state = state + STEP / 6 * (a + 2 * b + 2 * c + rates(state + STEP * c))
    return np.array(found) + 0.01 * np.random.default_rng(4).normal(size=rows)


def pendulum(w2: float, d1: float) -> oa.Motion:
    """The physics without the drag that grows with the square."""
    return oa.Motion.from_equations(
        [
            oa.State("th", "om", start="y"),
            oa.State("om", "-w2*sin(th) - d1*om", start="derivative of y", learned=True),
        ],
        [oa.Output("y", "th")],
        [oa.PhysicalParameter("w2", w2, min=0), oa.PhysicalParameter("d1", d1, min=0)],
        [],
    )


@pytest.fixture(scope="module")
def record() -> oa.Record:
    return oa.Record.from_arrays(np.zeros((1100, 0)), decay(), sampling_time=STEP)


def test_two_initial_values_lead_to_one_solution(record):
    far = oa.estimate(record, pendulum(20.0, 0.1), learner=None)
    near = oa.estimate(record, pendulum(22.0, 0.3), learner=None)
    assert far.status.loss <= 1.02 * near.status.loss
    assert np.allclose(np.asarray(far.theta), np.asarray(near.theta), rtol=0.02)


@pytest.mark.slow
def test_a_learner_beside_them_reaches_the_noise(record):
    fit = oa.estimate(
        record, pendulum(20.0, 0.1), learner=oa.MLP(hidden=(4,), inputs=("om",)), seed=0
    )
    assert np.sqrt(fit.status.loss) < 0.03  # of the deviation, where the noise is 0.016


def test_a_prediction_does_not_depend_on_how_many_others_are_made() -> None:
    """Windows run side by side in groups of one program: 150, 65 and 20 of them agree."""
    y = decay(170)
    fit = oa.estimate(
        oa.Record.from_arrays(np.zeros((170, 0)), y, sampling_time=STEP),
        pendulum(20.0, 0.1),
        learner=None,
        solver=oa.LevenbergMarquardt(3),
    )

    def predict(rows: int) -> np.ndarray:
        record = oa.Record.from_arrays(np.zeros((rows, 0)), y[:rows], sampling_time=STEP)
        return np.asarray(fit.model.predict(record).model)

    every = predict(170)
    for rows in (85, 40):
        np.testing.assert_allclose(predict(rows), every[: len(predict(rows))], atol=1e-9)


def test_long_records_are_predicted_in_blocks_that_give_the_score(record, monkeypatch):
    """Each predicted row is that of the whole prediction, and the others are not scored."""
    fit = oa.estimate(record, pendulum(22.0, 0.3), learner=None)
    part = Part("tests.long", record)
    whole, (every, _) = scoring.score_part(fit.model, part, [])
    monkeypatch.setattr(scoring, "_MOST_PREDICTED", 400)
    spread, (few, free) = scoring.score_part(fit.model, part, [])
    (one,), (other,) = every.trajectories, few.trajectories
    assert one.chosen is None and other.chosen.sum() == 400
    assert (np.isfinite(other.model[:, 0]) == other.chosen).all()
    np.testing.assert_allclose(other.model[other.chosen], one.model[other.chosen], rtol=1e-6)
    errors = (one.measured - one.model)[other.chosen]
    assert spread.prediction.rmse == pytest.approx(np.sqrt(np.mean(errors**2, axis=0)), rel=1e-6)
    assert spread.prediction.rmse == pytest.approx(whole.prediction.rmse, rel=0.1)
    assert spread.simulation == whole.simulation and free.trajectories[0].chosen is None
    complete, _ = scoring.score_part(fit.model, part, [], whole=True)
    assert complete == whole
