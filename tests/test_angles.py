"""Angles that wrap: named in a record, and unwrapped by a step of the preparation."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
from test_cli import run

import orthaug as oa
from orthaug.data.angles import find_resets, find_wrap, reset_warnings, wrapped_angles


def turning(rows: int = 600) -> np.ndarray:
    """An angle in degrees that turns forth and back by more than a turn, with noise."""
    t = 0.02 * np.arange(rows)
    return 500 * np.sin(0.8 * t) + 0.2 * np.random.default_rng(1).normal(size=rows)


def wrapped(angle: np.ndarray, period: float, low: float) -> np.ndarray:
    return (angle * period / 360 - low) % period + low


@pytest.mark.parametrize("period", [360.0, 2 * np.pi, 4096.0])
@pytest.mark.parametrize("share", [-0.5, 0.0])
def test_an_angle_that_wraps_is_named_and_unwrapped(period, share):
    angle = turning()
    y = wrapped(angle, period, share * period)
    record = oa.Record.from_arrays(np.zeros(len(y)), y, sampling_time=0.02, outputs=["angle"])
    (found,) = wrapped_angles(record)
    assert found.warning.code == "wrapped_angle"
    assert f"period = {period:.10g}`" in found.warning.text
    assert found.step["period"] == pytest.approx(period) and found.step["channels"] == ["angle"]
    right = oa.prepare(record, oa.Unwrap(period, ("angle",)))
    moved = right.experiments[0].outputs.ravel() - angle * period / 360
    assert np.ptp(moved) < 1e-9 * period
    assert not wrapped_angles(right)


@pytest.mark.parametrize(
    "samples",
    [
        np.where(np.arange(400) % 40 < 20, 180.0, -180.0),  # a switch
        360 * np.sin(0.05 * np.arange(400)),
        np.random.default_rng(2).uniform(-180, 180, 400),
        np.r_[np.zeros(200), 360 * np.ones(200)] + 0.01 * np.random.default_rng(3).normal(size=400),
        (0.9 * np.arange(400)) % 100.0,  # a ramp that begins anew
        np.where(np.arange(400) == 77, 3 + 2 * np.pi, 3 * np.sin(0.1 * np.arange(400))),
        np.full(400, 3.0),
        np.full(400, np.nan),
    ],
    ids=["switch", "sine", "noise", "step", "ramp", "spike", "constant", "missing"],
)
def test_other_signals_do_not_wrap(samples):
    assert find_wrap(samples) is None


def test_gaps_are_unwrapped_across():
    y = wrapped(turning(), 360.0, -180.0)
    y[[40, 41, 300]] = np.nan
    record = oa.Record.from_arrays(np.zeros(len(y)), y, sampling_time=0.02, missing="keep")
    assert wrapped_angles(record)
    right = oa.prepare(record, oa.Unwrap(360.0, ("y",)), missing="keep")
    values = right.experiments[0].outputs.ravel()
    assert np.isnan(values).sum() == 3 and not np.isnan(np.unwrap(values[45:290], period=360)).any()
    assert np.nanmax(np.abs(np.diff(values))) < 30


def test_unwrap_needs_its_channels():
    with pytest.raises(oa.InputError, match="needs `channels`"):
        oa.Unwrap(360.0)
    with pytest.raises(oa.InputError, match="positive"):
        oa.Unwrap(-1.0, ("y",))
    with pytest.raises(oa.InputError, match="no channel 'z'"):
        oa.prepare(oa.Record.from_arrays([0.0] * 4, [0.0] * 4), oa.Unwrap(360.0, ("z",)))


@pytest.mark.slow
def test_init_unwraps_before_it_looks_for_orders(tmp_path):
    rng = np.random.default_rng(6)
    u = np.repeat(rng.uniform(-1, 1.4, 40), 30)
    speed, angle, y = 0.0, 0.0, []
    for value in u:
        y.append(angle % 360)
        speed += 0.05 * (value - 0.2 * speed) / 0.5
        angle += 0.05 * 60 * speed
    rows = "\n".join(f"{a:.4f},{b + 0.05 * rng.normal():.2f}" for a, b in zip(u, y, strict=True))
    (tmp_path / "run.csv").write_text(f"torque [Nm],angle [deg]\n{rows}\n")
    made = tmp_path / "spec.toml"
    named = ("--inputs", "torque [Nm]", "--outputs", "angle [deg]")
    done = run("init", tmp_path / "run.csv", *named, "--out", made)
    assert done.code == 0 and "an angle that wraps at 360" in done.out
    steps = tomllib.loads(made.read_text(encoding="utf-8"))["data"]["prepare"]
    assert steps[0] == {"step": "unwrap", "period": 360.0, "channels": ["angle"]}
    fitted = oa.fit_spec(made).result
    assert fitted.scores["train"].simulation.nrmse[0] < 0.1


def travelled(rows: int = 800, noise: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """A force and the way that a mass has gone, with noise."""
    rng = np.random.default_rng(5)
    force, way, speed = np.repeat(rng.uniform(0, 1, rows // 20), 20), np.zeros(rows), 0.0
    for k in range(1, rows):
        speed += 0.1 * (force[k - 1] - speed)
        way[k] = way[k - 1] + speed
    return force, way + noise * rng.normal(size=rows)


def test_a_counter_that_is_reset_is_named_with_the_ranges_of_its_pieces():
    force, way = travelled()
    way[300:] -= way[300]
    way[550:] -= way[550]
    way[[40, 299, 411]] = np.nan
    record = oa.Record.from_arrays(force, way, outputs=["way"], missing="keep")
    (found,) = reset_warnings(record)
    assert found.code == "reset_output"
    assert "at 2 rows, the first behind row 298" in found.text
    assert "`rows = [[0, 299], [299, 550], [550, 800]]`" in found.text
    whole = oa.Record.from_arrays(*travelled(), outputs=["way"])
    assert not reset_warnings(whole) and found in warnings_of(record)


def warnings_of(record):
    from orthaug.data.wild import data_warnings

    return data_warnings(record)


@pytest.mark.parametrize("case", ["answer", "spike", "noise", "switch", "heavy"])
def test_other_jumps_are_no_resets(case):
    force, way = travelled()
    rng = np.random.default_rng(6)
    if case == "answer":  # an impulse of the force throws the mass
        force[400] += 300.0
        way[401:] += 300.0
    elif case == "spike":
        way[400] += 300.0
    elif case == "noise":
        way = rng.normal(size=800)
    elif case == "switch":
        way = np.where(np.arange(800) // 50 % 2, 1.0, 0.0)
    else:
        way = way + 0.3 * rng.standard_t(2, size=800)
    assert not find_resets(way, force[:, None])


def test_a_step_beside_others_of_rounding_size_overflows_nothing():
    """A sensor at rest whose noise is below any number: the ratio of its steps is no number."""
    samples = np.zeros(400)
    samples[::2] = 5e-324
    samples[200:] += 100.0
    with np.errstate(over="raise"):
        assert find_resets(samples, np.zeros((400, 1))) == [199]
