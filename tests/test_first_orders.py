"""Orders of a first linear model."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from orthaug import Record
from orthaug.selection.first_orders import first_model, first_significant_lag
from orthaug.selection.linear_runs import OutputRows, in_turn
from orthaug.selection.orders import Orders


def tank(seed: int, rows: int = 600) -> Record:
    """A level that the pump moves one sample later, and that runs out by its root."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(1, 10, rows // 20), 20) + 0.3 * rng.normal(size=rows)
    x, level = 5.0, []
    for pump in u:
        level.append(x)
        x = max(x + 0.2 * (pump - 2.2 * np.sqrt(x)), 0.0)
    return Record.from_arrays(u, np.array(level) + 0.05 * rng.normal(size=rows))


@pytest.mark.parametrize("seed", [0, 7, 8, 9])
def test_a_tie_on_held_out_rows_does_not_outdo_the_lag_that_is_significant(seed):
    """What no linear model follows is a matter of luck: lag 0 comes out ahead by a few per cent."""
    model = first_model(tank(seed))
    assert model is not None and model.delays == (1,) and model.orders.nk == (1,)


def test_lag_0_is_taken_where_it_is_clearly_better():
    rng = np.random.default_rng(0)
    u = rng.normal(size=400)
    model = first_model(
        Record.from_arrays(u, u + 0.5 * np.roll(u, 1) + 0.01 * rng.normal(size=400))
    )
    assert model is not None and model.delays == (0,) and model.orders.nk == (0,)


@pytest.mark.parametrize("seed", range(3))
def test_the_level_of_an_output_is_no_delay(seed):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=600)
    y = 5 + lfilter([0, 0, 0, 1.0], [1, -0.8], u) + 0.05 * rng.normal(size=600)
    model = first_model(Record.from_arrays(u, y))
    assert (
        model is not None
        and model.offset
        and (model.orders.na, model.orders.nb, model.orders.nk) == (1, (1,), (3,))
    )


@pytest.mark.parametrize("seed", range(3))
def test_the_delay_of_an_input_that_acts_by_its_square_is_found(seed):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=600)
    model = first_model(
        Record.from_arrays(u, lfilter([0, 0, 1.0], [1, -0.8], u**2) + 0.05 * rng.normal(size=600))
    )
    assert model is not None and model.delays == (2,) and model.orders.nk == (2,)


@pytest.mark.parametrize("seed", range(3))
def test_noise_on_the_output_of_a_slow_system_takes_no_further_lags(seed):
    """Two slow modes: least squares needs four lags against the noise, and its run is poor."""
    rng = np.random.default_rng(seed)
    u = np.repeat(60.0 * rng.integers(0, 2, size=60), 25)
    a = np.convolve([1, -0.99], [1, -0.85])
    y = lfilter([0, 0.033, -0.0315], a, u)
    model = first_model(Record.from_arrays(u, y + 0.01 * y.std() * rng.normal(size=1500)))
    assert model is not None and model.orders.na == 2
    assert model.free_run[0] < 0.03


@pytest.mark.parametrize("seed", range(3))
def test_light_damping_behind_noise(seed):
    """Two resonances with poles near the unit circle: least squares loses them in the noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-5, 5, size=200), 15)
    y = np.zeros(3000)
    for radius, angle, gain in ((0.9987, 0.22, 1.0), (0.994, 0.6, 0.6)):
        a = np.array([1, -2 * radius * np.cos(angle), radius**2])
        y += gain * lfilter([0, a.sum() / 2, a.sum() / 2], a, u)
    model = first_model(Record.from_arrays(u, y + 0.05 * y.std() * rng.normal(size=3000)))
    assert model is not None and model.orders.na == 4 and model.restarted is None
    assert model.free_run[0] < 0.5  # from a measured start, whose noise it remembers for long


def room(seed: int, coupling: float, rows: int = 1500) -> Record:
    """Air and wall of a room, of which the wall is heated by the air alone."""
    rng = np.random.default_rng(seed)
    heat = np.repeat(rng.uniform(0, 3, rows // 30), 30)
    air, wall, y = 15.0, 14.0, np.empty((rows, 2))
    for k in range(rows):
        y[k] = air, wall
        air, wall = (
            air + 0.08 * heat[k] + 0.02 * (5 - air) + coupling * (wall - air),
            wall + 0.01 * (5 - wall) + 0.5 * coupling * (air - wall) + 0.01 * heat[k],
        )
    return Record.from_arrays(heat, y + 0.05 * rng.normal(size=y.shape))


@pytest.mark.parametrize("seed", range(3))
def test_an_output_has_the_past_of_another_where_that_drives_it(seed):
    """It had its own past only: a free run of the wall left half of its deviation."""
    model = first_model(room(seed, 0.05))
    assert model is not None and (1, 0) in model.across
    assert max(model.free_run) < 0.15


@pytest.mark.parametrize("seed", range(3))
def test_outputs_that_do_not_act_on_each_other_have_no_past_of_the_other(seed):
    model = first_model(room(seed, 0.0))
    assert model is not None and not model.across


def test_a_poor_run_does_not_correct_the_lag_that_a_test_found() -> None:
    """An arm with dry friction and two rows of dead time: linear runs miss half, best from lag 0."""
    rng = random.Random(7)
    levels = [round(rng.uniform(-2.5, 2.5), 2) for _ in range(150)]
    volts = np.repeat(levels, 10)[:1125]
    angle, speed, y = 0.0, 0.0, []
    for volt in [0.0, 0.0, *volts[:-2]]:
        y.append(math.degrees(angle) + rng.gauss(0, 0.01))
        for _ in range(20):
            speed += 0.001 * (
                9 * volt - 0.6 * speed - 40 * math.sin(angle) - 4 * math.tanh(speed / 0.05)
            )
            angle += 0.001 * speed
    model = first_model(Record.from_arrays(volts, np.array(y), sampling_time=0.02))
    assert model is not None
    assert model.orders.nk == (3,)
    assert min(model.free_run) > 0.3


def crane(seed: int, rows: int = 1200) -> Record:
    """A trolley with a swinging load, both measured: a force acts at once, weakly in each row."""
    rng = np.random.default_rng(seed)
    force = 30 * np.sin(np.outer(np.arange(rows), [0.021, 0.034, 0.083, 0.13]) + [0, 1, 2, 3])
    force = np.round(force.mean(axis=1))
    x = np.zeros(4)
    found = []
    for push in force:
        found.append(x.copy())
        for _ in range(10):
            swing = -9.81 * x[2] - 0.3 * x[3] - (push - 4 * x[1]) / 8
            x = x + 0.005 * np.array([x[1], (push - 4 * x[1]) / 8 + 3 * x[2], x[3], swing / 1.2])
    y = np.array(found)[:, [0, 2]]
    return Record.from_arrays(force, y + 0.02 * y.std(axis=0) * rng.normal(size=y.shape))


@pytest.mark.parametrize("seed", [0, 4])
def test_a_lag_before_which_others_act_is_no_dead_time(seed):
    model = first_model(crane(seed))
    assert model is not None and model.orders.nk[0] <= 1
    assert (model.delays, model.undetermined) == ((None,), (True,))


@pytest.mark.parametrize("acts", [True, False])
def test_lags_that_act_together_alone_are_not_called_insignificant(acts):
    """Neighbouring lags of a smooth input replace each other in a filter of high order."""
    rng = np.random.default_rng(1)
    u, other = (lfilter(*butter(3, 0.4), rng.normal(size=300)) for _ in range(2))
    y = lfilter(*butter(4, 0.1), u if acts else other)
    record = Record.from_arrays(u, y + 0.01 * y.std() * rng.normal(size=300))
    model = first_model(record)
    assert model is not None and (model.delays, model.undetermined) == ((None,), (acts,))


@pytest.mark.parametrize("delay", [2, 3, 5, 10])
@pytest.mark.parametrize("kind", ["white", "steps"])
def test_a_dead_time_is_found_beside_the_rows_before_it(delay, kind):
    rng = np.random.default_rng(delay)
    u = rng.normal(size=900) if kind == "white" else np.repeat(rng.normal(size=45), 20)
    y = lfilter([0] * delay + [1.0], [1, -0.8], u)
    record = Record.from_arrays(u, y + 0.05 * y.std() * rng.normal(size=900))
    assert first_significant_lag(record, 0) == delay


def test_pieces_of_one_length_run_side_by_side(monkeypatch):
    """One by one 600 pieces of 10 rows took `init` of a year of hours over five minutes."""
    import scipy.signal

    calls = []

    def counted(*args, **options):
        calls.append(args)
        return lfilter(*args, **options)

    monkeypatch.setattr(scipy.signal, "lfilter", counted)
    record = tank(0)
    short = OutputRows([record.experiments[0].rows(k, k + 12) for k in range(0, 588, 10)], 0, LAGS)
    runs = short.free_runs(THETA)
    assert len(calls) == len(runs) == 1
    single = [OutputRows([e], 0, LAGS).free_runs(THETA)[0] for e in short.experiments]
    np.testing.assert_allclose(in_turn(runs), in_turn(single), rtol=1e-12)
    filtered, alone = short.filtered(THETA, runs), OutputRows(short.experiments[3:4], 0, LAGS)
    own = alone.filtered(THETA, [single[3]])
    assert filtered is not None and own is not None
    for all_rows, its in zip(filtered, own, strict=True):
        np.testing.assert_allclose(all_rows[30:40], its, rtol=1e-12)


LAGS, THETA = Orders(2, (1,), (1,)), np.array([1.2, -0.3, 0.1, 0.05])
