"""Are the innovations of an observer white and of the expected size, and do its bands hold 95 %? By simulation.

A Duffing oscillator with a disturbance and a noisy sensor, as lagged physics and as a motion. With the noises known and
the model exact, the filter itself is asked; with the noises that the residual of a fit tells, all of it is: θ, the
learned part (the cube is not in the physics) and the noises come from one record, the observer runs on another.
Run: python benchmarks/observer.py [draws, default 10]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from machine import describe

import orthaug as oa
from orthaug.analysis.observer_noise import with_share

ROWS, TS = 1000, 0.1
SPRING = [oa.Term("a", "y[k-1]"), oa.Term("b", "y[k-2]"), oa.Term("g", "u[k-1]")]
TRUE = {"a": 1.6, "b": -0.8, "g": 0.2, "h": -0.05}
SHARES = (0.01, 0.03, 0.1)
LEVELS = {"equation": (0.1, 0.0), "sensor": (0.0, 0.1), "both": (0.1, 0.1)}


def lagged(baseline: list[oa.Term], learner: Any, record: oa.Record, sensor: bool) -> Any:
    """A fit of lagged physics, on the free run where the sensor is noisy."""
    criterion = oa.Simulation(segment=0, washout=0) if sensor else oa.Prediction()
    return oa.estimate(
        record, oa.Baseline.from_terms(baseline), learner=learner, criterion=criterion
    )


def motion(*, cube: bool) -> oa.Motion:
    """The oscillator with its cube, or without."""
    force = "u - c*v - k*x - h*x**3" if cube else "u - c*v - k*x"
    given = (("c", 0.6), ("k", 4.0), *((("h", 2.0),) if cube else ()))
    return oa.Motion.from_equations(
        states=[
            oa.State("x", "v", start="y"),
            oa.State("v", force, start="derivative of y", learned=not cube),
        ],
        outputs=[oa.Output("y", "x")],
        parameters=[oa.PhysicalParameter(name, value) for name, value in given],
        inputs=["u"],
    )


class Draw(NamedTuple):
    """A record, and what is true along it: outputs without the sensor's noise, states of a motion."""

    record: oa.Record
    outputs: np.ndarray
    states: np.ndarray


class Plant(NamedTuple):
    """A model that is exact, and how it is disturbed: from a random input to a record."""

    model: Any
    enters: Callable[[np.ndarray, np.ndarray, float], tuple[np.ndarray, np.ndarray]]

    def draw(self, seed: int, disturbance: float, sensor: float) -> Draw:
        rng, step = np.random.default_rng([seed, 5]), oa.numpy_step(self.model)
        u = np.repeat(rng.normal(size=-(-ROWS // 4)), 4)[:ROWS]
        state, states, outputs = np.zeros(len(self.model.state_names)), [], []
        for value, w in zip(u, disturbance * rng.normal(size=ROWS), strict=True):
            states.append(state)
            state, y = self.enters(*map(np.array, step(state, np.array([value]))), w)
            outputs.append(y)
        measured = np.array(outputs) + sensor * rng.normal(size=(ROWS, 1))
        return Draw(
            oa.Record.from_arrays(u, measured, sampling_time=TS),
            np.array(outputs),
            np.array(states),
        )


def lagged_plant() -> Plant:
    """Of lagged physics with the cube; the disturbance goes on in the lags."""
    rng, y = np.random.default_rng(0), np.zeros(200)
    u = rng.normal(size=200)
    for k in range(2, 200):
        y[k] = (
            TRUE["a"] * y[k - 1]
            + TRUE["b"] * y[k - 2]
            + TRUE["g"] * u[k - 1]
            + TRUE["h"] * y[k - 1] ** 3
        )
    record = oa.Record.from_arrays(u, y, sampling_time=TS)

    def enters(state: np.ndarray, y: np.ndarray, w: float) -> tuple[np.ndarray, np.ndarray]:
        state[0] = y[0] + w
        return state, y + w

    return Plant(lagged([*SPRING, oa.Term("h", "y[k-1]**3")], None, record, False).model, enters)


def motion_plant() -> Plant:
    """Of the motion with the cube; the disturbance moves its velocity."""
    u = np.repeat(np.random.default_rng(0).normal(size=50), 4)
    exact = motion(cube=True)
    begun = oa.estimate(
        oa.Record.from_arrays(u, np.sin(np.arange(200.0)), sampling_time=TS), exact, learner=None
    ).model
    model = begun.__class__(
        **{**vars(begun), "numbers": begun.numbers._replace(theta=exact.coordinates.initial)}
    )

    def enters(state: np.ndarray, y: np.ndarray, w: float) -> tuple[np.ndarray, np.ndarray]:
        return state + [0.0, w], y

    return Plant(model, enters)


def judged(observer: oa.Observer, draw: Draw) -> list[float]:
    """NIS, whether it lies in its interval, whether white at 5 %, coverage of outputs, of measurements, of states."""
    found = observer.run(draw.record)
    result, (one,) = found.consistency(), found.experiments
    rows = slice(max(one.start, found.settled), None)

    def inside(true: np.ndarray, value: np.ndarray, std: np.ndarray) -> float:
        return float(np.mean(np.abs(true - value)[rows] <= 1.96 * std[rows] + 1e-12))

    white = result.whiteness[0]
    states = inside(draw.states, one.states, one.states_std) if found.state_names else np.nan
    return [
        result.nis,
        100.0 * result.consistent,
        100.0 * (white is not None and white.p > 0.05),
        100 * inside(draw.outputs, one.outputs, one.outputs_std),
        100 * inside(one.measured, one.predicted, one.predicted_std),
        100 * states,
    ]


def known(plant: Plant, draws: int) -> list[list[float]]:
    """With the model exact and the noises known."""
    q, r = LEVELS["both"]
    hidden = len(plant.model.state_names) == 2
    state = np.diag([0.0, q**2]) if hidden else np.array([[q**2]])
    observer = oa.Observer(plant.model, oa.Noise(state, np.array([[r**2]])))
    return [judged(observer, plant.draw(seed, q, r)) for seed in range(draws)]


def told_by_a_fit(plant: Plant, levels: tuple[float, float], draws: int) -> list[list[float]]:
    """With all that a fit of another record tells; the cube is learned."""
    records = (plant.draw(1000 + seed, *levels).record for seed in range(draws))
    observers = (oa.Observer(fitted(plant, record, levels[1] > 0)) for record in records)
    return [judged(observer, plant.draw(seed, *levels)) for seed, observer in enumerate(observers)]


def fitted(plant: Plant, record: oa.Record, sensor: bool) -> Any:
    """A fit of either kind of physics without the cube, which is learned."""
    if len(plant.model.state_names) == 2:
        return oa.estimate(record, motion(cube=False), learner=oa.MLP((6,), inputs=("x",)))
    return lagged(SPRING, oa.MLP((6,), inputs=("y[k-1]",)), record, sensor)


def shares(draws: int = 5) -> list[list[float]]:
    """Noise on the sensor alone, per share of its variance that is given to disturbances: of lagged physics, then of
    the motion, NIS, coverage in per cent of the outputs, and RMSE of the next measurement over its noise."""
    found, (_, sensor) = [], LEVELS["sensor"]
    for plant in (lagged_plant(), motion_plant()):
        rows = []
        for seed in range(draws):
            model = fitted(plant, plant.draw(1000 + seed, 0.0, sensor).record, True).model
            held = plant.draw(seed, 0.0, sensor)
            observers = [
                oa.Observer(model, with_share(model, model.statistics.noise, share))
                for share in SHARES
            ]
            rows.append(
                [
                    [*judged(o, held)[::3], o.predict(held.record).scores().rmse[0] / sensor]
                    for o in observers
                ]
            )
        found.append(np.mean(rows, axis=0))
    return np.concatenate(found, axis=1).tolist()


def rows(draws: int) -> Iterator[list[float]]:
    """A case after the other."""
    plants = {"lagged": lagged_plant(), "motion": motion_plant()}
    for kind, noises in CASES:
        count = draws if kind == "lagged" else draws // 2
        found = (
            known(plants[kind], 10 * draws)
            if noises == "known"
            else told_by_a_fit(plants[kind], LEVELS[noises], count)
        )
        yield [
            float(value) for value in np.mean(found, axis=0) if not np.isnan(value)
        ]  # lagged physics has no states


def table(draws: int = 10) -> list[list[float]]:
    """Per case: mean NIS, and in per cent draws whose NIS lies in its 95 % interval, draws that are white at 5 %, and
    coverage of the outputs, of the next measurement, and of the states of a motion."""
    return list(rows(draws))


CASES = (
    *(("lagged", "known"), ("motion", "known")),
    *(("lagged", level) for level in LEVELS),
    *(("motion", level) for level in ("sensor", "both")),
)


def main(draws: int) -> None:
    print(describe())
    began = time.perf_counter()
    print(
        "| case | NIS | in its interval | white | outputs | measurements | states "
        "|\n|---|---|---|---|---|---|---|"
    )
    for (kind, noises), row in zip(CASES, rows(draws), strict=True):
        cells = [f"{value:.1f} %" for value in row[1:]] + ["–"] * (6 - len(row))
        case = "exact, noises known" if noises == "known" else f"fitted, {noises}"
        print(f"| {kind}, {case} | {row[0]:.3f} | {' | '.join(cells)} |", flush=True)
    for share, row in zip(SHARES, shares(), strict=True):
        print(f"disturbances make {100 * share:.0f} %:", *(f"{value:.3f}" for value in row))
    print(f"{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
