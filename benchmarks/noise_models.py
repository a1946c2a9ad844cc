"""Noise models of lagged physics beside plain least squares: bias in standard errors, and coverage.

Systems of the second order in the equation error form, alone and with friction that a learner of the
velocity takes up. The truth of a parameter that the learner could imitate is the split of the true
system in the same inner product on the same rows.
Run: python benchmarks/noise_models.py [draws, default 200] [systems, default all] [none | learner]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from machine import describe
from scipy.signal import lfilter

import orthaug as oa
from orthaug.physics.noise import NoiseModel, RowFilter

ROWS, TS = 1000, 0.1
A = np.array([1.0, -1.5, 0.7])
B = np.array([0.0, 1.0, 0.5])


class System(NamedTuple):
    """`A y = B u + C/D e`: C and D, and the deviation of e."""

    c: tuple[float, ...]
    d: tuple[float, ...]
    size: float


SYSTEMS = {
    "white": System((1.0,), (1.0,), 0.5),
    "ARMAX": System((1.0, -0.9, 0.2), (1.0,), 0.5),
    "ARARX": System((1.0,), (1.0, -0.7), 0.5),
    "output error": System(tuple(A), (1.0,), 0.5),
    "Box-Jenkins": System(tuple(np.convolve(A, [1.0, 0.5])), (1.0, -0.8), 0.5),
}
FRICTION = 1.0
SEES = "y[k-1] - y[k-2]"
ALONE = oa.Baseline.from_terms(
    [
        oa.Term("a1", "y[k-1]"),
        oa.Term("a2", "y[k-2]"),
        oa.Term("b1", "u[k-1]"),
        oa.Term("b2", "u[k-2]"),
    ]
)
BESIDE = oa.Baseline.from_terms(
    [
        oa.Term("damping", SEES),
        oa.Term("stiffness", "y[k-2]"),
        oa.Term("b1", "u[k-1]"),
        oa.Term("b2", "u[k-2]"),
    ]
)


class Row(NamedTuple):
    """A line of the table; biases are means over draws in standard errors of the fit."""

    system: str
    learner: bool
    model: str
    draws: int
    bias: np.ndarray
    """Mean of (θ̂ − θ*) / std of each parameter."""
    covered: np.ndarray
    """Share of the 95 % intervals that hold, of each parameter."""
    width: float
    """Median standard error over that of the same noise model with known orders."""
    orders: str
    """The orders that were chosen most often."""
    seconds: float

    @property
    def named(self) -> str:
        bias, held = np.abs(self.bias).max(), 100 * self.covered
        return (
            f"| {self.system} | {'learner(v)' if self.learner else 'none'} | {self.model} | {self.draws} "
            f"| {bias:.2f} | {held.min():.1f} to {held.max():.1f} | {100 * self.covered.mean():.1f} "
            f"| {self.orders} | {self.seconds:.1f} |"
        )


def record_of(system: System, seed: int, friction: float) -> tuple[Any, np.ndarray]:
    """Return a record of the true system, and what the physics lacks on its rows."""
    rng = np.random.default_rng(seed)
    u, e = rng.normal(size=ROWS), system.size * rng.normal(size=ROWS)
    colour = lfilter(system.c, system.d, e)
    if not friction:
        y = lfilter(B, A, u) + lfilter([1.0], A, colour)
        return oa.Record.from_arrays(u, y, sampling_time=TS), np.zeros(ROWS)
    y, lacking = np.zeros(ROWS), np.zeros(ROWS)
    for k in range(2, ROWS):
        lacking[k] = -friction * np.tanh((y[k - 1] - y[k - 2]) / 0.5)
        known = -A[1] * y[k - 1] - A[2] * y[k - 2] + B[1] * u[k - 1] + B[2] * u[k - 2]
        y[k] = known + lacking[k] + colour[k]
    return oa.Record.from_arrays(u, y, sampling_time=TS), lacking


def truth_of(fit: Any, lacking: np.ndarray) -> np.ndarray:
    """Return θ of the true system, split from what the physics lacks as the fit splits it."""
    if not lacking.any():
        return np.array([-A[1], -A[2], B[1], B[2]])
    own = np.array([-A[1], -A[1] - A[2], B[1], B[2]])
    problem, moved = fit.problem, lacking[2:, None]
    if problem.noise is not None:
        moved = problem.noise.rows(moved)
    return own + problem.projection.solve_along(problem.weight.rows(moved), fit.model.shared)


def filtered_truth(fit: Any, lacking: np.ndarray, system: System) -> np.ndarray:
    """Return the truth in the inner product of the true noise, for a fit that models noise."""
    if fit.problem.noise is None:
        return truth_of(fit, lacking)
    orders = ((len(system.d) - 1, len(system.c) - 1),)
    noise = NoiseModel.of(orders, [*system.d[1:], *system.c[1:]])
    problem = fit.problem.filtered(RowFilter(noise, fit.problem.lengths))
    from dataclasses import replace

    return truth_of(replace(fit, problem=problem), lacking)


def measure(name: str, learner: bool, models: Sequence[str], draws: int) -> list[Row]:
    """Return the lines of one system."""
    system, friction = SYSTEMS[name], FRICTION * learner
    physics = BESIDE if learner else ALONE
    net = oa.MLP(hidden=(8,), inputs=(SEES,)) if learner else None
    found = []
    for model in models:
        errors, chosen, began = [], [], time.perf_counter()
        for seed in range(draws):
            record, lacking = record_of(system, 1000 + seed, friction)
            noise: Any = (
                oa.ARMA(len(system.d) - 1, len(system.c) - 1) if model == "orders given" else model
            )
            fit = oa.estimate(record, physics, learner=net, noise=noise)
            if fit.std is None:
                continue
            apart = fit.theta - filtered_truth(fit, lacking, system)
            held = (fit.interval[:, 0] <= fit.theta - apart) & (
                fit.theta - apart <= fit.interval[:, 1]
            )
            errors.append((apart / fit.std, held, fit.std))
            chosen.append("white" if fit.model.noise is None else str(fit.model.noise))
        bias, held, std = (np.array(one) for one in zip(*errors, strict=True))
        common = max(set(chosen), key=chosen.count)
        share = f"{common} {100 * chosen.count(common) / len(chosen):.0f} %"
        seconds = (time.perf_counter() - began) / draws
        found.append(
            Row(
                name,
                learner,
                model,
                len(errors),
                bias.mean(axis=0),
                held.mean(axis=0),
                float(np.median(std)),
                share,
                seconds,
            )
        )
        print(found[-1].named, flush=True)
    return found


def main() -> None:
    given = sys.argv[1:]
    draws = int(given[0]) if given else 200
    names = given[1].split(",") if len(given) > 1 and given[1] != "all" else list(SYSTEMS)
    kinds = [False, True] if len(given) < 3 else [given[2] == "learner"]
    print(describe())
    print(
        "| system | learner | noise model | draws | largest bias (standard errors) "
        "| coverage of the parameters (%) | mean (%) | orders, mostly | s a fit |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for learner in kinds:
        for name in names:
            measure(name, learner, ("white", "orders given", "auto"), draws)


if __name__ == "__main__":
    main()
