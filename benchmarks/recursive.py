"""Recursive least squares: the batch fit again, drift, steps of friction, false alarms, coverage, wind-up, time.

Run: python benchmarks/recursive.py [NAME] (equal, drift, friction, quiet, coverage, windup, or times; all without it)
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from functools import cache

import numpy as np
from machine import describe
from recursive_problems import FRICTION, MASS, ROWS, TS, Plant, fitted, physics

import orthaug as oa
from orthaug.fitting.recursive_rows import whitened_rows
from orthaug.physics.projection import Projection

DRAWS = 200
MEMORY = 2.0  # s
CASES = {"white": {}, "AR(1), 0.9": {"colour": 0.9}, "Student's t, 4": {"tails": 4.0}}
"""The unknown force."""
BEFORE = 1500  # rows before a step


@cache
def fit_of(draw: int, case: str = "white") -> oa.Estimate:
    """The fit of a draw, of a record of its own."""
    return fitted(draw, Plant(**CASES[case]))


def batch(fit: oa.Estimate, record: oa.Record) -> np.ndarray:
    """θ of least squares on the training rows and others, the learner fixed."""
    layout = fit.model.form.layout
    rows = oa.data.regressors.stack_rows(oa.Record.join([fit.problem.record, record]), layout)
    return Projection.factor((pair := whitened_rows(fit.model, rows.x, rows.y))[0]).solve(pair[1])


def equal() -> list[float]:
    """Largest relative difference to the batch fit after 3000 new rows, and to the fit itself when fed its own rows."""
    fit, new = fit_of(0), Plant().record(10_000)
    more, again = oa.Recursive(fit), oa.Recursive(fit, start="empty")
    more.update(new)
    again.update(fit.problem.record)
    one, other = (
        np.abs(more.theta / batch(fit, new) - 1).max(),
        np.abs(again.theta / fit.theta - 1).max(),
    )
    print(
        f"forgetting 1: {one:.1e} of the batch fit after {ROWS} rows; empty, fed the training "
        f"rows: {other:.1e}"
    )
    return [float(one), float(other)]


def drift(draws: int = 20) -> list[float]:
    """Mass grows by 20 %: per memory [s] median and largest error of m along it, share with an alarm; per cent."""
    mass = np.linspace(MASS, 1.2 * MASS, ROWS)
    entries = []
    for memory in (0.5, 1.0, 2.0, 5.0):
        errors, alarms = [], 0
        for draw in range(draws):
            online = oa.Recursive(fit_of(draw), memory=memory)
            alarms += bool(online.update(Plant(m=mass).record(20_000 + draw)))
            course = online.physical_history(physics(), points=60)
            errors.append(100 * np.abs(course.m / mass[course.index] - 1))
        entries += [memory, float(np.median(errors)), float(np.max(errors)), 100 * alarms / draws]
        print(
            f"memory {memory} s: error of m {entries[-3]:.2f} % median, {entries[-2]:.2f} % largest; "
            f"alarms {entries[-1]:.0f} %"
        )
    return entries


def friction(draws: int = DRAWS) -> list[float]:
    """Friction steps up: share detected, median and largest delay [s], share detected within 2 s, in per cent."""
    entries = []
    for step in (1.2, 1.5, 2.0):
        for memory in (None, MEMORY):
            delays = []
            for draw in range(draws):
                level = np.where(np.arange(ROWS) < BEFORE, FRICTION, step * FRICTION)
                online = oa.Recursive(fit_of(draw), memory=memory)
                alarms = online.update(Plant(f=level).record(30_000 + draw))
                after = [alarm.time - BEFORE * TS for alarm in alarms if alarm.row >= BEFORE]
                delays.append(after[0] if after else np.inf)
            seen, soon = (100 * np.mean(np.array(delays) <= end) for end in (1e9, 2.0))
            found = [d for d in delays if np.isfinite(d)] or [np.nan]
            entries += [float(np.median(found)), float(np.max(found)), float(soon), float(seen)]
            which = "forgets nothing" if memory is None else f"memory {memory} s"
            print(f"friction +{100 * (step - 1):.0f} %, {which}: {entries[-4]:.2f} s median, "
                f"{entries[-3]:.2f} s largest, {soon:.1f} % within 2 s, {seen:.1f} % at all")  # fmt: skip
    return entries


def quiet(draws: int = DRAWS) -> list[float]:
    """Records without a change that raise an alarm, in per cent."""
    entries = []
    for case, options in CASES.items():
        for memory in (None, MEMORY):
            raised = 0
            for draw in range(draws):
                online = oa.Recursive(fit_of(draw, case), memory=memory)
                raised += bool(online.update(Plant(**options).record(40_000 + draw)))
            entries.append(100 * raised / draws)
            print(
                f"no change, noise {case}, memory {memory}: {entries[-1]:.1f} % of {draws} "
                "records raise an alarm"
            )
    return entries


def coverage(draws: int = DRAWS) -> list[float]:
    """95 % intervals of m and k that hold the truth at the end of a record without a change, in per cent."""
    entries = []
    for case, options in CASES.items():
        for memory in (None, MEMORY):
            hits = []
            for draw in range(draws):
                online = oa.Recursive(fit_of(draw, case), memory=memory)
                online.update(Plant(**options).record(50_000 + draw))
                told_now = dict(zip(("m", "c", "ks"), online.physical(physics()).ci95, strict=True))
                hits.append([low <= truth <= high for truth, (low, high) in
                             ((MASS, told_now["m"]), (100.0, told_now["ks"]))])  # fmt: skip
            entries += (100 * np.mean(hits, axis=0)).tolist()
            print(
                f"noise {case}, memory {memory}: intervals of m hold it in {entries[-2]:.1f} %, "
                f"of k in {entries[-1]:.1f} %"
            )
    return entries


def directional(
    phi: np.ndarray, target: np.ndarray, theta: np.ndarray, r: np.ndarray, factor: float
) -> np.ndarray:
    """θ after every row with directional forgetting (Cao and Schwartz 2000): only along the new row."""
    course = []
    for row, y in zip(phi, target, strict=True):
        v = r @ row
        if (size := v @ v) > 0:
            r = r - (1 - np.sqrt(factor)) * np.outer(v, v @ r) / size
        z = r @ theta
        stacked = np.linalg.qr(np.vstack([np.column_stack([r, z]), np.append(row, y)]), mode="r")
        r = stacked[: len(theta), : len(theta)]
        theta = np.linalg.solve(r, stacked[: len(theta), -1])
        course.append(theta)
    return np.array(course)


def windup(draws: int = 20) -> list[float]:
    """Error of 1/θ3 (the mass) in per cent: largest through 30 s without force and 1 s after; median under a drift."""
    rows = 5000
    mass = np.linspace(MASS, 1.2 * MASS, rows)
    rest = np.where((np.arange(rows) >= 1000) & (np.arange(rows) < 4000), 0.0, 1.0)
    entries = []
    for name, floor in (
        ("none", 0.0),
        ("0.01", 0.01),
        ("0.1", 0.1),
        ("0.3", 0.3),
        ("directional", None),
    ):
        idle, slow = [], []
        for draw in range(draws):
            fit = fit_of(draw)
            for scale, truth, kept in ((rest, np.full(rows, MASS), idle), (1.0, mass, slow)):
                record = Plant(m=truth).record(60_000 + draw, rows, scale)
                online = oa.Recursive(fit, memory=MEMORY)
                start = online.theta
                inner = online._recursion
                if floor is None:
                    x = oa.data.regressors.stack_rows(record, fit.model.form.layout)
                    phi, target, _ = whitened_rows(fit.model, x.x, x.y)
                    course = directional(
                        phi[:, 0], target[:, 0], start, inner.factor_now.copy(), inner.forgetting
                    )
                else:
                    inner.floor = np.sqrt(floor / 0.1) * inner.floor if floor else None
                    online.update(record)
                    course = online.history[["theta1", "theta2", "theta3"]].to_numpy()
                error = 100 * np.abs(TS**2 / course[:, 2] / truth[-len(course) :] - 1)
                kept.append(error[1000:4100].max() if kept is idle else np.median(error))
        entries += [float(np.median(idle)), float(np.max(idle)), float(np.median(slow))]
        print(
            f"floor {name}: without force {entries[-3]:.2f} % median, {entries[-2]:.2f} % largest; "
            f"drift {entries[-1]:.2f} %"
        )
    return entries


def times() -> list[float]:
    """Time of a row over that of a bare NumPy update of the same size: in a block of rows, and one row a call."""
    fit, record = fit_of(0), Plant().record(1)
    rows = oa.data.regressors.stack_rows(record, fit.model.form.layout)
    phi, target, _ = whitened_rows(fit.model, rows.x, rows.y)
    experiment = record.experiments[0]
    online = oa.Recursive(fit, memory=MEMORY)
    online.update(record)
    online.update(u=experiment.inputs[0], y=experiment.outputs[0])
    seconds: dict[str, list[float]] = {"bare": [], "block": [], "single": []}
    for _ in range(7):
        theta, p, began = fit.theta, np.eye(3), time.perf_counter()
        for row, y in zip(phi[:, 0], target[:, 0], strict=True):
            v = p @ row
            gain = v / (0.99 + row @ v)
            theta, p = theta + gain * (y - row @ theta), (p - np.outer(gain, v)) / 0.99
        seconds["bare"].append((time.perf_counter() - began) / len(phi))
        began = time.perf_counter()
        online.update(record)
        seconds["block"].append((time.perf_counter() - began) / len(record))
        began = time.perf_counter()
        for k in range(500):
            online.update(u=experiment.inputs[k], y=experiment.outputs[k])
        seconds["single"].append((time.perf_counter() - began) / 500)
    bare, block, single = (float(np.median(seconds[name])) for name in ("bare", "block", "single"))
    print(f"a row: bare NumPy {1e6 * bare:.1f} us; in a block {1e6 * block:.0f} us "
        f"({block / bare:.0f} times); one a call {1e6 * single:.0f} us ({single / bare:.0f} "
        "times)")  # fmt: skip
    return [block / bare, single / bare]


PARTS = {f.__name__: f for f in (equal, drift, friction, quiet, coverage, windup, times)}


def main(names: Sequence[str]) -> None:
    print(describe())
    for name in names or PARTS:
        PARTS[name]()


if __name__ == "__main__":
    main(sys.argv[1:])
