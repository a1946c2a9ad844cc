"""How often do records that mislead give a wrong interval without a word?

Each record has the right physics or all but one term of it, and a fault that no test of the residual shows: an output in
coarse steps, a plant at rest, an input of two frequencies, a learner that follows all but little of a regressor, or a
measured acceleration whose equation has no learner. A row: held, warned, silent misses of all draws and parameters, and
the median width relative to the value.
Run: python benchmarks/coverage_records.py [draws, default 10]
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from draws import seeds

import orthaug as oa

WARNINGS = {
    "quantised_output",
    "explains_nothing",
    "few_frequencies",
    "little_left",
    "output_without_learner",
}
DOUBTS = WARNINGS | {
    "unexplained",
    "hidden_state",
    "at_a_bound",
    "not_determined",
    "parameter_drift",
    "biased",
}
"""Warnings that say that an interval may not hold."""


class Row(NamedTuple):
    """A line of the table; held, warned and silent in per cent of draws."""

    system: str
    noise: str
    sees: str
    draws: int
    held: float
    warned: float
    silent: float
    width: float


class Case(NamedTuple):
    """A record, its physics, and the truth of the parameters that the data should show."""

    record: oa.Record
    motion: oa.Motion
    truth: dict[str, float]
    sees: tuple[str, ...] = ()


def _run(
    field: Callable[..., np.ndarray], start: list[float], inputs: np.ndarray, step: float
) -> np.ndarray:
    """Return the states (N, nx) at the samples, by Runge-Kutta in 20 steps a sample."""
    x, found, h = np.array(start, dtype=float), [], step / 20
    for u in inputs:
        found.append(x)
        for _ in range(20):
            a = field(x, u)
            b = field(x + h / 2 * a, u)
            c = field(x + h / 2 * b, u)
            x = x + h / 6 * (a + 2 * b + 2 * c + field(x + h * c, u))
    return np.array(found)


def _steps(rng: np.random.Generator, rows: int, held: int, size: float) -> np.ndarray:
    return np.repeat(size * rng.uniform(-1, 1, rows // held), held)


def coarse(seed: int, way: Callable[[np.ndarray], np.ndarray]) -> Case:
    """A motor with friction whose speed is recorded in steps of 2 rad/s."""
    rng = np.random.default_rng(seed)
    volt = _steps(rng, 1200, 40, 3.0)
    w = _run(
        lambda x, u: np.array([-1.2 * x[0] - 25 * np.tanh(x[0] / 0.3) + 40 * u]), [0.0], volt, 0.02
    )[:, 0]
    record = oa.Record.from_arrays(
        volt, 2 * way(w / 2), sampling_time=0.02, inputs=["volt"], outputs=["w"]
    )
    motion = oa.Motion.from_equations(
        [oa.State("w1", "-a*w1 - f*tanh(w1/0.3) + b*volt", start=0.0)],
        [oa.Output("w", "w1")],
        [oa.PhysicalParameter(name, at) for name, at in (("a", 1.0), ("f", 10.0), ("b", 30.0))],
        ["volt"],
        substeps=4,
    )
    return Case(record, motion, {"a": 1.2, "f": 25.0, "b": 40.0})


def _mass(
    force: np.ndarray, noise: float, rng: np.random.Generator, hardening: float = 0.0
) -> Case:
    field = lambda x, u: np.array([x[1], (u - 3 * x[1] - 80 * x[0] - hardening * x[0] ** 3) / 2])  # noqa: E731
    y = _run(field, [force[0] / 80, 0.0], force, 0.02)[:, 0]
    y = y + noise * rng.normal(size=len(y))
    record = oa.Record.from_arrays(
        force, y, sampling_time=0.02, inputs=["force"], outputs=["place"]
    )
    motion = oa.Motion.from_equations(
        [oa.State("x", "v", start="place"), oa.State("v", "(force - c*v - k*x)/m")],
        [oa.Output("place", "x")],
        [
            oa.PhysicalParameter(name, at, min=0)
            for name, at in (("m", 1.5), ("c", 2.0), ("k", 60.0))
        ],
        ["force"],
    )
    return Case(record, motion, {"m": 2.0, "c": 3.0, "k": 80.0})


def at_rest(seed: int) -> Case:
    """A mass and spring under a constant force, at rest."""
    return _mass(np.full(1500, 5.0), 0.002, np.random.default_rng(seed))


def two_tones(seed: int) -> Case:
    """A hardening spring, 9 % stiffer at the largest stroke, under two sines and noise of 15 %."""
    rng, t = np.random.default_rng(seed), 0.02 * np.arange(1500)
    force = 6 * np.sin(2 * np.pi * 0.31 * t) + 6 * np.sin(2 * np.pi * 1.37 * t + rng.uniform(0, 6))
    return _mass(force, 0.013, rng, hardening=200.0)


def loss(seed: int) -> Case:
    """A heated body that loses heat by conduction and radiation; the learner sees its temperature."""
    rng, rows = np.random.default_rng(seed), 900
    heat = np.repeat(rng.uniform(0, 120, rows // 30), 30)
    around = (
        293 + 3 * np.sin(np.arange(rows) / 120) + np.repeat(0.3 * rng.normal(size=rows // 60), 60)
    )
    field = lambda x, u: np.array(  # noqa: E731
        [(u[0] - (x[0] - u[1]) / 2 - 6.1e-9 * (x[0] ** 4 - u[1] ** 4)) / 400]
    )
    inputs = np.column_stack([heat, around])
    y = _run(field, [320.0], inputs, 20.0)[:, 0] + 0.1 * rng.normal(size=rows)
    names = ["heat", "around"]
    record = oa.Record.from_arrays(inputs, y, sampling_time=20.0, inputs=names, outputs=["T"])
    motion = oa.Motion.from_equations(
        [oa.State("x", "(heat - (x - around)/R)/C", start="T", learned=True)],
        [oa.Output("T", "x")],
        [oa.PhysicalParameter("C", 300.0), oa.PhysicalParameter("R", 2.5)],
        names,
    )
    return Case(record, motion, {"C": 400.0, "R": 2.0}, ("x",))


def acceleration(seed: int) -> Case:
    """A mass with a spring that yields, whose acceleration is measured, too; the learner sees the stroke."""
    rng = np.random.default_rng(seed)
    force = _steps(rng, 1200, 20, 25.0)
    spring = lambda x: 20 * np.tanh(80 * x / 20)  # noqa: E731
    field = lambda x, u: np.array([x[1], (u - 3 * x[1] - spring(x[0])) / 2])  # noqa: E731
    x = _run(field, [0.0, 0.0], force, 0.02)
    a = (force - 3 * x[:, 1] - spring(x[:, 0])) / 2
    y = np.column_stack([x[:, 0] + 0.002 * rng.normal(size=1200), a + 0.05 * rng.normal(size=1200)])
    record = oa.Record.from_arrays(
        force, y, sampling_time=0.02, inputs=["force"], outputs=["place", "a"]
    )
    motion = oa.Motion.from_equations(
        [
            oa.State("x", "v", start="place"),
            oa.State("v", "(force - c*v - k*x)/m", start=0.0, learned=True),
        ],
        [oa.Output("place", "x"), oa.Output("a", "(force - c*v - k*x)/m")],
        [
            oa.PhysicalParameter(name, at, min=0)
            for name, at in (("m", 1.5), ("c", 2.0), ("k", 60.0))
        ],
        ["force"],
        hold="zero-order",
    )
    return Case(record, motion, {"m": 2.0, "c": 3.0}, ("x",))


CASES: dict[str, tuple[Callable[[int], Case], str]] = {
    "speed in steps of 2, rounded": (lambda seed: coarse(seed, np.round), "none"),
    "speed in steps of 2, cut off": (lambda seed: coarse(seed, np.trunc), "none"),
    "speed in steps of 2, rounded down": (lambda seed: coarse(seed, np.floor), "none"),
    "a mass at rest": (at_rest, "2.5 %"),
    "a hardening spring, two tones": (two_tones, "15 %"),
    "radiation beside conduction": (loss, "0.1 K"),
    "a yielding spring, acceleration measured": (acceleration, "1 %"),
}


def row(system: str, draws: int) -> Row:
    """Return the row of a system."""
    make, noise = CASES[system]
    held = warned = silent = 0
    widths, sees = [], ()
    for seed in seeds(draws, system, noise):
        case = make(seed)
        sees = case.sees
        learner = oa.MLP(hidden=(6,), inputs=case.sees) if case.sees else None
        fit = oa.estimate(case.record, case.motion, learner=learner, criterion=oa.Simulation())
        found = fit.diagnose()
        rows = {one.name: one for one in found.parameters}
        inside = []
        for name, truth in case.truth.items():
            one = rows[name]
            low, high = one.ci95 or (-np.inf, np.inf)
            if one.bias is not None and one.bias.interval is not None:
                low, high = one.bias.interval
            if not np.isfinite([low, high]).all():
                continue
            inside.append(low <= truth <= high)
            widths.append((high - low) / abs(truth))
        doubted = bool({one.code for one in found.warnings} & DOUBTS)
        held += all(inside)
        warned += doubted
        silent += not all(inside) and not doubted
    share = 100 / draws
    width = float(np.median(widths)) if widths else float("nan")
    return Row(
        system,
        noise,
        ", ".join(sees) or "no learner",
        draws,
        share * held,
        share * warned,
        share * silent,
        100 * width,
    )


def rows(draws: int = 10) -> Iterator[Row]:
    """Yield all rows."""
    for system in CASES:
        yield row(system, draws)


def main() -> None:
    """Print the table."""
    print(
        "| system | noise | learner sees | draws | held | warned | silent misses | median width |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for one in rows(int(sys.argv[1]) if len(sys.argv) > 1 else 10):
        print(
            "| " + " | ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in one) + " |",
            flush=True,
        )


if __name__ == "__main__":
    main()
