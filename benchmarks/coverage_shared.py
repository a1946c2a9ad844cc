"""Coverage where a column of the physics is a function of what the learner sees, on the data if not by its name.

Each row is a system, and what is asked is the parameter of that column: how often its interval holds the truth, how
often it does not and nothing is said (a silent miss), and how wide it is. Run: python benchmarks/coverage_shared.py 10
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import scipy.signal
from draws import seeds

import orthaug as oa
from orthaug.inference.nearly_shared import shared_warnings

STEP = 0.01  # s
ROWS = 800
TRUTH = 1.5
SEES = "speed and place"


class Row(NamedTuple):
    """A row of the table: `width` is the median over the draws of the interval's length over the true value."""

    system: str
    noise: str
    sees: str
    draws: int
    held: int
    warned: int
    silent: int
    width: float


def _speed(rng: np.random.Generator) -> np.ndarray:
    """A speed that passes through zero often: a sum of sines (ROWS,)."""
    t = STEP * np.arange(ROWS)
    waves = [
        rng.uniform(0.3, 1) * np.sin(2 * np.pi * rng.uniform(0.2, 3) * t + rng.uniform(0, 6.28))
        for _ in range(6)
    ]
    return np.sum(waves, axis=0)


def _noisy_sign(v: np.ndarray, p: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.sign(v + 0.1 * v.std() * rng.normal(size=len(v)))


COLUMNS: dict[str, Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]] = {
    "sign of the speed": lambda v, p, rng: np.sign(v),
    "speed times place": lambda v, p, rng: v * p,
    "speed times its size": lambda v, p, rng: v * np.abs(v),
    "sign of a noisy speed": _noisy_sign,
    "speed 20 samples ago": lambda v, p, rng: np.roll(v, 20),
    "low-pass of the speed": lambda v, p, rng: np.asarray(
        scipy.signal.lfilter([0.05], [1, -0.95], v)
    ),
    "independent noise": lambda v, p, rng: rng.normal(size=len(v)),
    "independent steps": lambda v, p, rng: np.repeat(rng.normal(size=len(v) // 20), 20),
}


def lagged(column: str, noise: float, seed: int) -> tuple[float, tuple[float, float], bool]:
    """The force on a stage whose friction is a function of speed and place: estimate, interval, whether warned."""
    rng = np.random.default_rng(seed)
    v = _speed(rng)
    p, a = np.cumsum(v) * STEP, np.gradient(v, STEP)
    extra = COLUMNS[column](v, p, rng)
    force = (
        2.0 * v
        + TRUTH * extra
        + 0.8 * a
        + 0.3
        + 0.4 * np.sin(3 * p)
        + 0.3 * np.exp(-np.abs(v) / 0.1) * np.sign(v)
    )
    force = force + noise * np.std(force) * rng.normal(size=ROWS)
    names = ["speed", "place", "acceleration", "extra"]
    signals = np.column_stack([v, p, a, extra])
    record = oa.Record.from_arrays(
        signals, force, sampling_time=STEP, inputs=names, outputs=["force"]
    )
    terms = [("c", "speed[k]"), ("e", "extra[k]"), ("m", "acceleration[k]"), ("offset", "1")]
    baseline = oa.Baseline.from_terms([oa.Term(*term) for term in terms])
    inputs = ("speed[k]", "place[k]")
    fit = oa.estimate(record, baseline, learner=oa.MLP(hidden=(8,), inputs=inputs), seed=seed)
    return _judged(fit, "e", fit.theta[1], fit.interval, 1, fit.problem.shared, inputs)


def motion(column: str, noise: float, seed: int) -> tuple[float, tuple[float, float], bool]:
    """A mass with friction of its speed, beside a column that acts on it."""
    rng = np.random.default_rng(seed)
    drive, x, v = (
        np.repeat(rng.normal(size=ROWS // 10 + 1), 10)[:ROWS] * 6,
        np.zeros(ROWS),
        np.zeros(ROWS),
    )
    extra = (
        COLUMNS[column](np.zeros(ROWS), np.zeros(ROWS), rng)
        if column.startswith("independent")
        else np.zeros(ROWS)
    )
    for k in range(ROWS - 1):
        if column == "sign of the speed":
            extra[k] = np.sign(v[k])
        elif column == "speed times its size":
            extra[k] = v[k] * abs(v[k])
        x[k + 1], v[k + 1] = _next_sample(x[k], v[k], drive[k] - TRUTH * extra[k])
    y = x + noise * x.std() * rng.normal(size=ROWS)
    names = ["drive", "extra"]
    signals = np.column_stack([drive, extra])
    record = oa.Record.from_arrays(signals, y, sampling_time=STEP, inputs=names, outputs=["place"])
    physics = oa.Motion.from_equations(
        states=[
            oa.State("x", "v", start="place"),
            oa.State(
                "v", "(drive - c*v - k*x - e*extra)/m", start="derivative of place", learned=True
            ),
        ],
        outputs=[oa.Output("place", "x")],
        parameters=[
            oa.PhysicalParameter(n, s) for n, s in (("m", 1.2), ("c", 2.0), ("k", 7.0), ("e", 1.0))
        ],
        inputs=names,
    )
    fit = oa.estimate(record, physics, learner=oa.MLP(hidden=(5,), inputs=("v",)), seed=seed)
    value, held, warned = _judged(fit, "e", fit.values[3], fit.interval, 3, fit.shared, ("v",))
    # As the command says it: a fall-back to physics alone has doubts, which widen the intervals
    row = fit.diagnose().parameters[3]
    held = held if row.ci95 is None else tuple(row.ci95)
    return value, held, warned or row.ci95_counts == "noise only"


def _next_sample(x: float, v: float, held: float) -> np.ndarray:
    """Place and speed a sample later, by small Runge-Kutta steps: the truth is not that of coarse ones."""

    def rates(state: np.ndarray) -> np.ndarray:
        x, v = state
        return np.array([v, held - 3.0 * v - 8.0 * x - 0.5 * np.tanh(v / 0.1)])

    state, h = np.array([x, v]), STEP / 5
    for _ in range(5):
        first = rates(state)
        second = rates(state + h / 2 * first)
        third = rates(state + h / 2 * second)
        fourth = rates(state + h * third)
        state = state + h / 6 * (first + 2 * second + 2 * third + fourth)
    return state


def _judged(
    fit: Any, name: str, value: float, interval: Any, i: int, shared: Any, inputs: Any
) -> Any:
    warned = any(
        re.search(rf"\b{name}\b", warning.text) for warning in shared_warnings(shared, inputs)
    )
    held = (np.nan, np.nan) if interval is None else tuple(np.asarray(interval)[i])
    return float(value), held, warned


def rows(draws: int = 10) -> Iterator[Row]:
    """Yield the table: every column with noise of 1 and 5 %, as lagged physics, and some as a motion."""
    cases = [("lagged", lagged, column, noise) for column in COLUMNS for noise in (0.01, 0.05)]
    moved = ("sign of the speed", "speed times its size", "independent noise", "independent steps")
    cases += [("motion", motion, column, 0.01) for column in moved]
    for kind, run, column, noise in cases:
        held = warned = silent = 0
        widths = []
        for seed in seeds(max(draws // (3 if kind == "motion" else 1), 3), kind, column, noise):
            _, (low, high), said = run(column, noise, seed)
            holds = bool(low <= TRUTH <= high)
            held, warned = held + holds, warned + said
            silent += not holds and not said and np.isfinite(low)
            widths.append((high - low) / TRUTH)
        sees = SEES if kind == "lagged" else "v"
        yield Row(
            f"{kind}: {column}",
            f"{noise:.0%}",
            sees,
            len(widths),
            held,
            warned,
            silent,
            float(np.nanmedian(widths)),
        )


def main() -> None:
    """Print the table."""
    print(
        "| system | noise | learner sees | draws | held | warned | silent misses | median width |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for row in rows(int(sys.argv[1]) if len(sys.argv) > 1 else 10):
        print(
            "| " + " | ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in row) + " |",
            flush=True,
        )


if __name__ == "__main__":
    main()
