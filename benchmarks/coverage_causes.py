"""Does the interval that counts the bias hold the truth, whatever the missing term is, in and outside the catalogue?

Lagged: y = 1.35 y₁ − .48 y₂ + .5 u + δ(v) + e with v = y₁ − y₂, 500 rows, learner on v. Motion: a mass-spring-damper
with friction δ(v), noise on the position, learner on v. `rows` gives a line for every system: how often every interval
with the bias holds its truth, how often a truth is outside of all intervals shown and no warning says that they are not
determined (a silent miss), the median width over the value, and how often a parameter is not determined.
Run: python benchmarks/coverage_causes.py [draws, default 20] [draws of motions, default 3]
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from draws import seeds
from machine import describe
from scipy.special import erf

import orthaug as oa

TRUE = np.array([1.35, -0.48, 0.5])
NOISES = (0.02, 0.05)
ROWS = 500
IN_CATALOGUE = {
    "none": lambda v: 0.0 * v,
    "-.15 sign(v)": lambda v: -0.15 * np.sign(v),
    "-.15 tanh(v/.3)": lambda v: -0.15 * np.tanh(v / 0.3),
    "-.15 tanh(v/.1)": lambda v: -0.15 * np.tanh(v / 0.1),
    "-.1 atan(v/.1)": lambda v: -0.1 * np.arctan(v / 0.1),
    "-.15 sqrt|v| sign(v)": lambda v: -0.15 * np.sqrt(abs(v)) * np.sign(v),
    "-.1 v|v|": lambda v: -0.1 * v * abs(v),
    "dead zone .3": lambda v: -0.3 * (v - np.clip(v, -0.3, 0.3)),
    "Stribeck": lambda v: -0.15 * np.sign(v) * np.exp(-abs(v) / 0.3),
}
OUTSIDE = {
    "-.15 sign(v) ln(1+|v|/.2)": lambda v: -0.15 * np.sign(v) * np.log(1 + abs(v) / 0.2),
    "-.4 v/(1+v²)": lambda v: -0.4 * v / (1 + v * v),
    "-.15 erf(v/.2)": lambda v: -0.15 * erf(v / 0.2),
    "two kinks": lambda v: -0.3 * np.clip(v, -0.2, 0.2) - 0.1 * np.clip(v, -0.6, 0.6),
    "asymmetric friction": lambda v: np.where(v > 0, -0.2, 0.1) * np.tanh(abs(v) / 0.05),
    "Stribeck, v²": lambda v: -np.sign(v) * (0.08 + 0.12 * np.exp(-((v / 0.25) ** 2))),
    "-.1 sin(4 v)": lambda v: -0.1 * np.sin(4 * v),
    "-.15 v/√(v²+.04)": lambda v: -0.15 * v / np.sqrt(v * v + 0.04),
}
BASELINE = oa.Baseline.from_terms(
    [oa.Term("a1", "y[k-1]"), oa.Term("a2", "y[k-2]"), oa.Term("b", "u[k-1]")]
)
MOTION_ROWS, HOLD, TS, FINE = 500, 20, 0.02, 4
MOTION_TRUE = np.array([1.0, 2.0, 100.0])  # m, c, k
MOTIONS = {
    "tanh(v/.3)": lambda v: 1.5 * np.tanh(v / 0.3),
    "√|v| sign(v)": lambda v: 1.5 * np.sqrt(abs(v)) * np.sign(v),
    "sign(v) ln(1+|v|/.2)": lambda v: 0.8 * np.sign(v) * np.log(1 + abs(v) / 0.2),
    "3 v/(1+v²)": lambda v: 3 * v / (1 + v * v),
}


class Row(NamedTuple):
    """A line of the table: shares of the draws in per cent, widths over the value."""

    system: str
    noise: float
    sees: str
    draws: int
    held: float
    silent: float
    width: float
    undetermined: float


def record(delta: Callable[[Any], Any], noise: float, seed: int) -> oa.Record:
    """A draw of the lagged system, from rest."""
    rng = np.random.default_rng([seed, 7])
    u, e, y = rng.normal(size=ROWS), noise * rng.normal(size=ROWS), np.zeros(ROWS)
    for k in range(2, ROWS):
        y[k] = TRUE @ [y[k - 1], y[k - 2], u[k - 1]] + delta(y[k - 1] - y[k - 2]) + e[k]
    return oa.Record.from_arrays(u, y)


def motion_record(friction: Callable[[Any], Any], noise: float, seed: int) -> oa.Record:
    """A draw of the mass-spring-damper, from rest; `noise` in deviations of the position."""
    m, c, k = MOTION_TRUE
    rng = np.random.default_rng([seed, 8])
    force = np.repeat(rng.uniform(-20, 20, MOTION_ROWS // HOLD), HOLD)
    state, positions, h = np.zeros(2), [], TS / FINE

    def rate(x: np.ndarray, u: float) -> np.ndarray:
        return np.array([x[1], (u - c * x[1] - k * x[0] - friction(x[1])) / m])

    for u in force:
        positions.append(state[0])
        for _ in range(FINE):
            first = rate(state, u)
            second = rate(state + h / 2 * first, u)
            third = rate(state + h / 2 * second, u)
            state = state + h / 6 * (first + 2 * second + 2 * third + rate(state + h * third, u))
    position = np.array(positions)
    position = position + noise * position.std() * rng.normal(size=MOTION_ROWS)
    return oa.Record.from_arrays(
        force, position, sampling_time=TS, inputs=["force"], outputs=["position"]
    )


def motion() -> oa.Motion:
    """The mass-spring-damper without its friction."""
    parameters = zip(("m", "c", "k"), (1.2, 1.2, 120.0), strict=True)
    return oa.Motion.from_equations(
        states=[
            oa.State("x", "v", start="position"),
            oa.State("v", "(force - c*v - k*x)/m", start="derivative of position", learned=True),
        ],
        outputs=[oa.Output("position", "x")],
        inputs=["force"],
        parameters=[oa.PhysicalParameter(name, value, min=0) for name, value in parameters],
    )


def judged(
    fit: Any, names: tuple[str, ...], true: np.ndarray
) -> tuple[float, float, list[float], list[bool]]:
    """Shares of the parameters that the intervals hold and that are missed silently, widths over values, what is open.

    Of the parameters that the learner could imitate: the others have no bias, and miss 5 % by chance.
    """
    if fit.interval is None:  # withheld: nothing is claimed
        return 1.0, 0.0, [], [True] * len(names)
    budget = oa.bias_budget(fit)
    held, silent, widths, open_ones = [], [], [], []
    for i, name in enumerate(names):
        found = None if budget is None else budget.of(name)
        plain = np.asarray(fit.interval[list(fit.parameters.index).index(name)])
        limits = plain if found is None else found.ci95
        open_ones.append(limits is None)
        if limits is None or not np.isfinite(limits).all():
            held, silent = [*held, True], [*silent, False]
            continue
        inside = bool(limits[0] <= true[i] <= limits[1])
        held.append(inside)
        silent.append(not inside and not plain[0] <= true[i] <= plain[1])
        widths.append(float((limits[1] - limits[0]) / abs(true[i])))
    return float(np.mean(held)), float(np.mean(silent)), widths, open_ones


def summed(
    system: str, noise: float, found: list[tuple[float, float, list[float], list[bool]]]
) -> Row:
    """A line of the table from its draws; the width is that of what the learner could imitate."""
    held, silent, widths, open_ones = zip(*found, strict=True)
    largest = [max(w, default=np.nan) for w in widths]
    undetermined = 100 * float(np.mean([any(row) for row in open_ones]))
    width = float(np.nanmedian(largest)) if np.isfinite(largest).any() else np.nan
    return Row(system, noise, "v", len(found), 100 * float(np.mean(held)), 100 * float(np.mean(silent)), width,
               undetermined)  # fmt: skip


def rows(draws: int = 20, motion_draws: int = 3) -> Iterator[Row]:
    """Yield the lines of the table, lagged physics first."""
    learner = oa.MLP((8,), inputs=("y[k-1] - y[k-2]",))
    for noise in NOISES:
        for name, delta in {**IN_CATALOGUE, **OUTSIDE}.items():
            fits = (
                oa.estimate(record(delta, noise, i), BASELINE, learner=learner, seed=i)
                for i in seeds(draws, name, noise)
            )
            yield summed(name, noise, [judged(fit, ("a1", "a2"), TRUE) for fit in fits])
    for name, friction in MOTIONS.items():
        fits = (
            oa.estimate(
                motion_record(friction, 0.01, i),
                motion(),
                learner=oa.MLP((6,), inputs=("v",)),
                blocks=0,
                seed=i,
            )
            for i in seeds(motion_draws, "motion", name)
        )
        found = [judged(fit, ("c",), MOTION_TRUE[1:2]) for fit in fits if fit.interval is not None]
        if found:
            yield summed(f"motion, {name}", 0.01, found)


def main(draws: int, motion_draws: int) -> None:
    print(describe())
    print(
        "\n| system | noise | learner on | draws | held | silent misses | median width | not "
        "determined |"
    )
    print(8 * "|---" + "|")
    for row in rows(draws, motion_draws):
        print(
            f"| {row.system} | {row.noise} | {row.sees} | {row.draws} | {row.held:.0f} % | "
            f"{row.silent:.0f} % | {row.width:.2g} | {row.undetermined:.0f} % |",
            flush=True,
        )


if __name__ == "__main__":
    given = [int(text) for text in sys.argv[1:]]
    main(*(given + [20, 3][len(given) :]))
