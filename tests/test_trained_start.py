"""The free run from the start that training found, judged output by output."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import orthaug as oa
from orthaug.analysis import trained_start
from orthaug.analysis.fit_findings import PartScores, ScoreResult
from orthaug.analysis.residuals import rms_errors
from orthaug.analysis.trained_start import (
    TrainedRun,
    from_trained_start,
    local_minimum_of_start,
)


def response(errors: np.ndarray) -> Any:
    """A response of two outputs with the given errors (N, 2)."""
    run = SimpleNamespace(
        start=0, diverged=False, measured=errors, model=np.zeros_like(errors), y=errors
    )
    return SimpleNamespace(trajectories=[run], outputs=[oa.Channel("a", "m"), oa.Channel("b", "")])


@pytest.mark.parametrize(
    ("before", "after", "taken", "named"),
    [
        # a's noise hides nothing
        ((1.0, 0.05), (1.0, 0.002), True, "b is 0.002 instead of 0.05"),
        ((1.0, 0.05), (0.4, 0.04), True, "a [m] is 0.4 instead of 1"),
        ((1.0, 0.05), (0.9, 0.04), True, None),  # neither is far better
        ((1.0, 0.05), (0.995, 0.05), False, None),  # the start hardly matters
        ((1.0, 0.05), (1.0, 0.051), False, None),
        ((1.0, 0.05), (2.0, 0.002), False, None),  # one is clearly worse
        ((1.0, 0.05), (0.1, 0.1), False, None),
        ((1.0, 0.0), (1.0, 0.0), False, None),
    ],
)
def test_outputs_are_judged_by_themselves(monkeypatch, before, after, taken, named):
    """A noisy output hid that the run of another began off, and the output named had no gain."""
    fit: Any = SimpleNamespace(
        criterion=SimpleNamespace(simulates=True),
        problem=SimpleNamespace(deviation=np.array([4.0, 4.0])),
    )
    signs = np.array([[1.0], [-1.0]])
    runs = [response(signs * np.array(sizes)) for sizes in (before, after)]
    monkeypatch.setattr(trained_start, "rms_errors", lambda run: np.abs(run.trajectories[0].y[0]))
    other = TrainedRun(runs[1], "a poor start", "more rows")
    monkeypatch.setattr(trained_start, "_trained_run", lambda *given: other)
    found = from_trained_start(fit, runs[0])
    assert (found is not None) == taken
    assert found is None or found[0] is other
    warning = found[1] if found is not None else None
    assert (warning is not None) == (named is not None)
    assert warning is None or f"error of {named}" in warning.text


def predation(seed: int, share: float = 0.0, size: float = 0.0) -> Any:
    """The fit of prey and predators, counted with noise of a `share`, or of a fixed `size`."""
    rng, step = np.random.default_rng(seed), 0.1
    u, x, rows = np.repeat(rng.uniform(0, 0.3, 15), 20), np.array([10.0, 5.0]), []

    def rates(x: np.ndarray, harvest: float) -> np.ndarray:
        a, b = x
        return np.array([1.1 * a - 0.4 * a * b - harvest * a, 0.1 * a * b - 0.4 * b])

    for value in u:
        rows.append(x)
        for _ in range(2):
            mid = x + step / 4 * rates(x, value)
            x = x + step / 2 * rates(mid, value)
    exact, noise = np.array(rows), rng.normal(size=(300, 2))
    y = exact * (1 + share * noise) + size * noise * (2.5, 1.0)
    record = oa.Record.from_arrays(u, y, sampling_time=step, inputs=["h"], outputs=["prey", "pred"])
    motion = oa.Motion.from_equations(
        [oa.State("x", "a*x - b*x*y - h*x", "prey"), oa.State("y", "d*x*y - g*y", "pred")],
        [oa.Output("prey", "x"), oa.Output("pred", "y")],
        [
            oa.PhysicalParameter(name, value, min=0)
            for name, value in zip("abdg", (0.8, 0.3, 0.07, 0.6), strict=True)
        ],
        ["h"],
    )
    return oa.estimate(record, motion, learner=None)


@pytest.mark.parametrize("noise", [{"size": 0.1}, {"share": 0.03}])
def test_a_start_that_is_never_forgotten_colours_no_errors(noise):
    """A third of such fits, and with noise in per cent nearly all, were said to lack physics."""
    found = [oa.diagnose(predation(seed, **noise)) for seed in (1, 4, 7, 9)]
    verdicts = [one.verdict for one in found if one is not None]
    assert len(verdicts) == 4 and verdicts.count("white") >= 3
    assert all(one is None or not one.text.count("Physics is missing") for one in found)


def test_a_noisy_speed_makes_no_colour_of_a_precise_angle():
    """The start's speed is off by its noise, so the run of the angle is off by a constant after."""
    rng, step = np.random.default_rng(5), 0.02
    u, x, rows = np.repeat(rng.uniform(-1, 1, 60), 10), np.zeros(2), []
    for force in u:
        rows.append(x)
        x = x + step * np.array([x[1], (force - 0.1 * x[1]) / 0.05])
    noise = rng.normal(size=(600, 2)) * (0.01, 1.5)
    record = oa.Record.from_arrays(
        u, np.array(rows) + noise, sampling_time=step, outputs=["angle", "speed"]
    )
    motion = oa.Motion.from_equations(
        [
            oa.State("p", "p + 0.02*w", start="angle"),
            oa.State("w", "w + 0.02*(u - b*w)/J", start="speed"),
        ],
        [oa.Output("angle", "p"), oa.Output("speed", "w")],
        [oa.PhysicalParameter(name, 0.2, min=0) for name in "bJ"],
        ["u"],
        integrator="discrete",
    )
    found = oa.estimate(record, motion, learner=None).diagnose(blocks=0)
    texts = {warning.code: warning.text for warning in found.warnings}
    assert found.residuals.verdict == "white" and "coloured_residual" not in texts
    assert "its error of angle is" in texts["noisy_start"]


def coil(curved: float = 0.0, slow: float = 0.0) -> tuple[Any, oa.Record, oa.Record]:
    """A fit of a linear coil, its record, and one of smaller currents."""
    rng, records = np.random.default_rng(3), []
    for size in (1.0, 0.2):
        x, e, rows = 0.0, 0.0, []
        u = size * np.repeat(rng.uniform(-1, 1, 40), 15)
        for value in u:
            e = 0.95 * e + slow * rng.normal()
            rows.append(x + e + 0.002 * rng.normal())
            x += 0.1 * (value - x - curved * x**3)
        records.append(oa.Record.from_arrays(u, np.array(rows), sampling_time=1.0))
    motion = oa.Motion.from_equations(
        [oa.State("x", "x + b*u - a*x", start="y")],
        [oa.Output("y", "x")],
        [oa.PhysicalParameter(name, 0.2, min=0) for name in "ab"],
        ["u"],
        integrator="discrete",
    )
    return oa.estimate(records[0], motion, learner=None), *records


def warned(fit: Any, record: oa.Record, held: oa.Record, off: float = 0.0) -> list[str]:
    """Texts on the start of a fit whose free run over its training data is off by a wave."""
    run, after = fit.model.simulate(record), fit.model.simulate(held)
    one = run.trajectories[0]
    wave = off * np.sin(np.arange(len(one.model)) / 50)[:, None]
    run = replace(run, trajectories=(replace(one, baseline=one.baseline + wave),))
    scores = [
        ScoreResult(rmse=size.tolist(), nrmse=(size / fit.problem.deviation).tolist())
        for size in (rms_errors(after),)
    ]
    others = {"tests.last": PartScores(prediction=scores[0], simulation=scores[0])}
    found = local_minimum_of_start(fit, fit.model.predict(record), run, others)
    assert all(one.code == "poor_start" for one in found)
    return [one.text for one in found]


def test_a_run_that_is_off_where_others_are_not_began_beside_the_data():
    """Training ended at 20 times the error that the tests had, and was called reliable."""
    (text,) = warned(*coil(), off=0.1)
    assert "a local minimum, at a start beside the data" in text and "over tests.last" in text
    assert "`initial`" in text


@pytest.mark.parametrize(("curved", "slow"), [(0.0, 0.0), (2.0, 0.0), (0.0, 0.01)])
def test_noise_missing_physics_and_disturbances_are_no_poor_start(curved, slow):
    """Missing physics shows at large currents, which the part that is held out does not have."""
    assert not warned(*coil(curved, slow))
