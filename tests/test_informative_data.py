"""Data that can hardly contradict the physics, or hardly show it, are named."""

from __future__ import annotations

import numpy as np
import pytest

import orthaug as oa
from orthaug.analysis.informative_data import few_frequencies

N, TS = 1200, 0.02
T = TS * np.arange(N)


def multisine(lines: int) -> np.ndarray:
    phase = np.random.default_rng(0).uniform(0, 6.28, lines)
    waves = [np.sin(2 * np.pi * 0.25 * (i + 1) * T + p) for i, p in enumerate(phase)]
    return np.sum(waves, axis=0)


NOISE = np.random.default_rng(1).normal(size=N)
INPUTS = {  # and how many parameters are the fewest that such an input cannot test
    "a sine": (np.sin(2 * np.pi * 1.3 * T), 1),
    "a measured sine": (np.sin(2 * np.pi * 1.3 * T) + 0.003 * NOISE, 1),
    "two sines": (6 * np.sin(2 * np.pi * 0.31 * T) + 6 * np.sin(2 * np.pi * 1.37 * T + 1), 3),
    "five sines": (multisine(5), 9),
    "a step": ((T > 3).astype(float), None),
    "steps": (np.repeat(NOISE[:30], 40), None),
    "noise": (NOISE, None),
    "a square wave": (np.sign(np.sin(2 * np.pi * 0.3 * T)), None),
    "a sweep": (np.sin(2 * np.pi * (0.2 * T + 0.05 * T**2)), None),
    "a drift": (T + 0.001 * NOISE, None),
}


@pytest.mark.parametrize(("u", "fewest"), INPUTS.values(), ids=INPUTS)
def test_an_input_of_few_frequencies_tests_few_parameters(u, fewest):
    record = oa.Record.from_arrays(u, NOISE, sampling_time=TS)
    named = [count for count in range(1, 12) if few_frequencies(record, count)]
    assert named == ([] if fewest is None else list(range(fewest, 12)))


def test_inputs_that_do_not_move_are_named():
    still = oa.Record.from_arrays(np.ones(N), NOISE, sampling_time=TS, inputs=["force"])
    (warning,) = few_frequencies(still, 3)
    assert warning.code == "constant_input" and "force does not move" in warning.text
    levels = [np.ones(N), 2 * np.ones(N)]
    several = oa.Record.join([oa.Record.from_arrays(u, NOISE, sampling_time=TS) for u in levels])
    assert [one.code for one in few_frequencies(several, 3)] == ["constant_input"]
    assert not few_frequencies(oa.Record.from_arrays(None, NOISE, sampling_time=TS), 3)


def test_frequencies_of_several_inputs_and_experiments_count_together():
    slow, fast = np.sin(2 * np.pi * 0.3 * T), np.sin(2 * np.pi * 2.1 * T)
    one = oa.Record.from_arrays(np.column_stack([slow, fast]), NOISE, sampling_time=TS)
    assert not few_frequencies(one, 2) and few_frequencies(one, 3)
    (warning,) = few_frequencies(one, 3)
    assert "2 frequencies" in warning.text and "0.292 Hz" in warning.text
    pieces = [oa.Record.from_arrays(u, NOISE, sampling_time=TS) for u in (slow, fast)]
    several = oa.Record.join(pieces)
    assert not few_frequencies(several, 2) and few_frequencies(several, 3)
    two = oa.Record.from_arrays(slow, np.column_stack([NOISE, NOISE]), sampling_time=TS)
    assert not few_frequencies(two, 2) and few_frequencies(two, 3)


def rest(force: np.ndarray, noise: float, sign: float = 1.0) -> dict[str, str]:
    """Return the warnings on a mass and spring under a force, which is recorded with a sign."""
    m, c, k = 2.0, 3.0, 80.0
    x, v, y = force[0] / k, 0.0, []
    for f in force:
        y.append(x)
        for _ in range(20):
            v += TS / 20 * (f - c * v - k * x) / m
            x += TS / 20 * v
    record = oa.Record.from_arrays(
        sign * force,
        np.array(y) + noise * NOISE,
        sampling_time=TS,
        inputs=["force"],
        outputs=["place"],
    )
    motion = oa.Motion.from_equations(
        states=[oa.State("x", "v", start="place"), oa.State("v", "(force - c*v - k*x)/m")],
        outputs=[oa.Output("place", "x")],
        inputs=["force"],
        parameters=[
            oa.PhysicalParameter("m", 1.5, min=0),
            oa.PhysicalParameter("c", 2.0, min=0),
            oa.PhysicalParameter("k", 60.0, min=0),
        ],
    )
    fit = oa.estimate(record, motion, learner=None, criterion=oa.Simulation())
    return {one.code: one.text for one in fit.diagnose().warnings}


def test_a_record_at_rest_explains_nothing_and_one_that_moves_is_not_called_that():
    assert {"explains_nothing", "constant_input"} <= set(rest(np.full(N, 5.0), 0.002))
    moved = 5 + np.repeat(np.random.default_rng(2).uniform(-1, 1, 30), 40)
    assert "explains_nothing" not in rest(moved, 0.002)
    assert "sign and the unit of every input" in rest(moved - 5, 0.0005, -1.0)["explains_nothing"]


@pytest.mark.parametrize("segment", [0, 50])
def test_shorter_runs_are_advised_where_physics_that_lacks_something_integrates(segment):
    """A loop holds a cart on a slope: what its weight adds is integrated twice."""
    rng = np.random.default_rng(4)
    wanted, x, v, force, y = np.repeat(rng.normal(size=40), 10), 0.0, 0.0, [], []
    for place in wanted:
        force.append(0.8 + 4 * (place - x) - 3 * v + 0.2 * rng.normal())
        y.append(x)
        for _ in range(10):
            x, v = x + 0.01 * v, v + 0.01 * (force[-1] - 0.8)
    record = oa.Record.from_arrays(
        np.array(force), np.array(y), sampling_time=0.1, inputs=["force"], outputs=["place"]
    )
    motion = oa.Motion.from_equations(
        states=[oa.State("x", "v", start="place"), oa.State("v", "g*force")],
        outputs=[oa.Output("place", "x")],
        inputs=["force"],
        parameters=[oa.PhysicalParameter("g", 0.5)],
    )
    fit = oa.estimate(record, motion, learner=None, criterion=oa.Simulation(segment=segment))
    texts = {one.code: one.text for one in fit.diagnose().warnings}
    assert ("`segment` = 50" in texts.get("explains_nothing", "")) == (not segment)
