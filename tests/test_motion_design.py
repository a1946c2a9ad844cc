"""Designed inputs for motions against fits of simulated records."""

from __future__ import annotations

import numpy as np
import pytest
from test_motion_fit import TS, WHOLE, spring

import orthaug as oa
from orthaug import InputError
from orthaug.analysis.input_search import Design

TRUTH = np.array([1.0, 0.8, 25.0])
NOISE, SAMPLES, AMPLITUDE = 0.02, 119, 8.0  # so short a record is flown in one piece
SPRING = spring(substeps=2)
FRICTION = oa.MotionSuspect.of(
    "expression", "tanh(v/0.1)", factor="-1/m", coefficient=0.05, name="friction"
)


def designed(**changes) -> Design:
    given = {
        "sampling_time": TS,
        "samples": SAMPLES,
        "amplitude": AMPLITUDE,
        "noise": NOISE,
        "parameters": TRUTH,
    }
    return oa.design_motion_input(SPRING, **(given | changes))


def outputs(u: np.ndarray, friction: float = 0.0) -> np.ndarray:
    """y of m = 1, c = 0.8, k = 25 from rest, finely integrated."""
    state, y, h = np.zeros(2), [], TS / 8

    def rates(x: np.ndarray, u: float) -> np.ndarray:
        return np.array([x[1], u - 0.8 * x[1] - 25 * x[0] - friction * np.tanh(x[1] / 0.1)])

    for value in u:
        y.append(state[0])
        for _ in range(8):
            k1 = rates(state, value)
            k2 = rates(state + h / 2 * k1, value)
            k3 = rates(state + h / 2 * k2, value)
            state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + rates(state + h * k3, value))
    return np.array(y)


def errors(u: np.ndarray, draws: int = 24) -> np.ndarray:
    """p̂ − p of physics fitted to simulated records, (draws, 3)."""
    clean, found = outputs(u), []
    for draw in range(draws):
        y = clean + NOISE * np.random.default_rng(draw).normal(size=len(u))
        record = oa.Record.from_arrays(u=u, y=y, sampling_time=TS)
        found.append(oa.estimate(record, SPRING, learner=None, criterion=WHOLE).values - TRUTH)
    return np.array(found)


@pytest.fixture(scope="module")
def best() -> Design:
    return designed()


@pytest.mark.proof
def test_the_prediction_is_the_scatter_of_fits_and_beats_a_random_input(
    best: Design, record_property
) -> None:
    assert np.abs(best.signal).max() <= AMPLITUDE and best.names == ("m", "c", "k")
    own = errors(best.signal)
    ratio = np.sqrt(np.mean(own**2, axis=0)) / best.std
    assert np.all((ratio > 0.65) & (ratio < 1.35))  # 24 draws tell a deviation to 15 %
    power = np.sqrt(np.mean(best.signal**2))
    random = power * np.sign(np.random.default_rng(7).normal(size=SAMPLES))  # of equal power
    relative = [
        np.sqrt(np.mean(np.sum((found / TRUTH) ** 2, axis=1))) for found in (own, errors(random))
    ]
    record_property("scatter over predicted", f"{ratio.min():.2f} to {ratio.max():.2f}")
    record_property("error over that of a random input", f"{relative[0] / relative[1]:.2f}")
    assert relative[0] == pytest.approx(best.relative_error, rel=0.3)
    assert relative[0] < 0.4 * relative[1]


def test_the_bias_of_a_suspect_is_weighed(best: Design) -> None:
    """Friction biases the damper; the design's prediction is what a fit of noiseless data with it errs by."""
    found = designed(suspects=[FRICTION], iterations=2)
    u = found.signal
    record = oa.Record.from_arrays(u=u, y=outputs(u, 0.05), sampling_time=TS)
    fit = oa.estimate(record, SPRING, learner=None, criterion=WHOLE)
    assert (fit.values - TRUTH)[1] == pytest.approx(found.bias[1], rel=0.05)
    assert best.bias == pytest.approx([0, 0, 0]) and found.bias[1] > found.std[1]


def test_what_cannot_be_designed_is_refused() -> None:
    with pytest.raises(InputError, match="suspect 'offset' has no `coefficient`"):
        designed(suspects=[oa.MotionSuspect.of("offset")])
    with pytest.raises(InputError, match="give `amplitude`, or `minimum` and `maximum`"):
        designed(amplitude=None)
    with pytest.raises(InputError, match="`parameters` are 2; expected 3: m, c, k"):
        designed(parameters=[1.0, 2.0])
    with pytest.raises(InputError, match="k is -200; its bounds are 0 and inf"):
        designed(parameters=[1.0, 0.8, -200.0])
    with pytest.raises(InputError, match="diverges under every input"):
        designed(parameters=[1.0, 0.8, 1e6])  # too fast for two substeps


def test_an_input_that_is_known_says_its_own_gain() -> None:
    """Held at zero it tells nothing of it."""
    states = [oa.State("x", "(b*u + g*w - x)/T")]
    values = [oa.PhysicalParameter(name, 1.0) for name in ("T", "b", "g")]
    motion = oa.Motion.from_equations(states, [oa.Output("y", "x")], values, ["u", "w"], substeps=1)
    given = {
        "sampling_time": 0.2,
        "samples": 80,
        "amplitude": 1.0,
        "noise": 0.01,
        "channel": "u",
        "iterations": 1,
    }
    with pytest.raises(InputError, match="no candidate has a condition number"):
        oa.design_motion_input(motion, **given)
    known = np.sin(np.arange(80) / 5)
    assert oa.design_motion_input(motion, **given, known_inputs={"w": known}).std[2] < 0.02
    with pytest.raises(InputError, match="a channel of `known_inputs`"):
        oa.design_motion_input(motion, **given, known_inputs={"z": known})
