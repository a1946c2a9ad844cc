"""Inputs that act later than in the equations are found beside slow disturbances, too."""

import numpy as np
import pytest

import orthaug as oa


def chamber(delay, seed=0, rows=1200):
    """A heated chamber whose surroundings drift slowly, which no equation has."""
    rng = np.random.default_rng(seed)
    power = np.repeat(rng.uniform(0, 400, rows // 60), 60)
    acting = np.concatenate([np.full(delay, power[0]), power])[:rows]
    around = 20 + 2 * np.sin(2 * np.pi * np.arange(rows) / 900 + seed)
    kept, temperature = np.exp(-10 * 8 / 5000), np.full(rows, 30.0)
    for k in range(rows - 1):
        rest = around[k] + acting[k] / 8
        temperature[k + 1] = rest + kept * (temperature[k] - rest)
    return oa.Record.from_arrays(
        u=power,
        y=temperature + 0.02 * rng.normal(size=rows),
        sampling_time=10.0,
        inputs=["power"],
        outputs=["T"],
    )


MOTION = oa.Motion.from_equations(
    states=[oa.State("x", "(power - h*(x - 20))/C", start="T")],
    outputs=[oa.Output("T", "x")],
    inputs=["power"],
    parameters=[oa.PhysicalParameter("h", 6.0, min=0), oa.PhysicalParameter("C", 4000.0, min=0)],
)


@pytest.mark.parametrize("delay", [0, 3])
def test_a_delay_is_found_beside_a_slow_disturbance(delay):
    fit = oa.estimate(chamber(delay), MOTION, learner=None)
    late = fit.diagnose().residuals.late
    if not delay:
        assert late == []
        return
    (found,) = late
    assert found.ahead
    assert (found.input, found.delay, found.by_lag, found.alike) == ("power", 3, False, False)
    assert found.delayed < 0.6 * found.declared
