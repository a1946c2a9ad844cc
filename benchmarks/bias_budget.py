"""Is the bias that a fit tells of its parameters the true one, and does an interval with it cover the truth?

Generated mass-spring-dampers of random mass, damping and stiffness with one unmodelled term of random kind and size,
under random inputs, with noise in the equation. Two of the kinds are none that a fit tries by itself. The true bias is
`Φ⁺Δ`, known exactly. Every second system has no term that is missing. "Declared": the missing term is the only suspect
that is declared; "found": none is.
Run: python benchmarks/bias_budget.py [systems, default 400]
"""

from __future__ import annotations

import sys
import time
from functools import cache
from typing import NamedTuple

import numpy as np
from machine import describe

import orthaug as oa
from orthaug.analysis.budget import LEAST_SHARE, ground_of, named_cause, with_bias
from orthaug.analysis.suspects import Suspect

SAMPLES, TS = 2000, 0.01
VELOCITY = "y[k-1] - y[k-2]"
BASELINE = oa.Baseline.from_terms(
    [oa.Term("theta1", "y[k-1]"), oa.Term("theta2", "y[k-2]"), oa.Term("theta3", "u[k-1]")]
)
KINDS = (
    ("coulomb", VELOCITY),
    ("stribeck", VELOCITY),
    ("quadratic_drag", VELOCITY),
    ("cubic", VELOCITY),
    ("cubic", "y[k-1]"),
    ("dead_zone", "y[k-1]"),
    ("cubic", "u[k-1]"),
    ("expression", "y[k-1]**2"),
    ("expression", "u[k-1]**2"),
    ("expression", "u[k-1]*y[k-1]"),
    ("expression", "abs(u[k-1])"),  # this and the next one are none that a fit tries by itself
    ("expression", f"({VELOCITY})**2"),
)


class System(NamedTuple):
    """A record, its true θ, and the term that is missing with its coefficient; None where none is."""

    record: oa.Record
    theta: np.ndarray
    cause: Suspect | None
    coefficient: float


def force(rng: np.random.Generator) -> np.ndarray:
    """White noise, steps that are held, or slow noise; some with an offset."""
    kind, u = rng.integers(3), rng.normal(size=SAMPLES)
    if kind == 1:
        hold = int(rng.integers(5, 40))
        u = np.repeat(rng.uniform(-1, 1, size=SAMPLES // hold + 1), hold)[:SAMPLES]
    elif kind == 2:
        pole = rng.uniform(0.5, 0.95)
        for k in range(1, SAMPLES):
            u[k] = pole * u[k - 1] + (1 - pole) * u[k]
    return 100 * (u / u.std() + (rng.uniform(-1, 1) if rng.uniform() < 0.5 else 0.0))


def system(seed: int) -> System:
    """Backward Euler of `m ẍ + c ẋ + k x = u`, plus the missing term of a share of the output."""
    rng = np.random.default_rng([seed, 12])
    m, c, k = np.exp(rng.uniform(np.log([0.5, 5, 300]), np.log([2, 100, 3000])))
    theta = np.array([2 * m + c * TS, -m, TS**2]) / (m + c * TS + k * TS**2)
    u, missing = force(rng), seed % 2 == 0
    kind, on = KINDS[rng.integers(len(KINDS))]
    noise = rng.normal(size=SAMPLES) * np.exp(rng.uniform(np.log(1e-3), np.log(1e-2)))
    share = np.exp(rng.uniform(np.log(5e-4), np.log(1e-1)))
    linear = simulate(theta, u, 0 * u, None)
    size, speed = linear.std(), np.median(np.abs(np.diff(linear)))
    width = {"stribeck": speed * rng.uniform(0.3, 2), "dead_zone": size * rng.uniform(0.3, 1)}.get(kind)
    cause = Suspect.of(kind, on, width=width, name="missing") if missing else None
    coefficient = 0.0
    if cause is not None:
        x = np.column_stack([linear[1:-1], linear[:-2], u[1:-1]])
        values = cause.values(x, oa.Lags(2, 1, 1).layout(("y",), ("u",)), ["y"])
        coefficient = -share * np.diff(linear).std() / values.std()
    with np.errstate(all="ignore"):
        y = simulate(theta, u, noise * np.diff(linear).std(), form(kind, on, width), coefficient)
    if not np.all(np.abs(y) < 10 * np.abs(linear).max()):  # the term makes it unstable: another one
        return system(seed + 1_000_000)
    return System(oa.Record.from_arrays(u, y), theta, cause, coefficient)


def form(kind: str, on: str, width: float | None):
    """The missing term as a function of y[k-1], y[k-2], u[k-1]."""
    w = width or 1.0
    of = {
        "coulomb": np.sign,
        "stribeck": lambda v: np.sign(v) * np.exp(-abs(v) / w),
        "quadratic_drag": lambda v: v * abs(v),
        "cubic": lambda v: v**3,
        "dead_zone": lambda v: v - min(max(v, -w), w),
    }
    acts = {VELOCITY: lambda a, b, u: a - b, "y[k-1]": lambda a, b, u: a, "u[k-1]": lambda a, b, u: u}
    products = {"y[k-1]**2": lambda a, b, u: a * a, "u[k-1]**2": lambda a, b, u: u * u}
    products |= {"u[k-1]*y[k-1]": lambda a, b, u: u * a, "abs(u[k-1])": lambda a, b, u: abs(u)}
    products[f"({VELOCITY})**2"] = lambda a, b, u: (a - b) ** 2
    return products[on] if kind == "expression" else lambda a, b, u: of[kind](acts[on](a, b, u))


def simulate(theta: np.ndarray, u: np.ndarray, noise: np.ndarray, term, coefficient: float = 0.0) -> np.ndarray:
    """The output, at rest before."""
    y = np.zeros(len(u))
    for k in range(2, len(u)):
        a, b, last = y[k - 1], y[k - 2], u[k - 1]
        y[k] = theta[0] * a + theta[1] * b + theta[2] * last + noise[k]
        if coefficient:
            y[k] += coefficient * term(a, b, last)
    return y


class Seen(NamedTuple):
    """A fitted system: true bias, standard errors, and per way of naming the cause its share and bias."""

    true: np.ndarray
    std: np.ndarray
    error: np.ndarray
    freedom: float
    shape: np.ndarray
    causes: tuple[tuple[float, np.ndarray] | None, ...]


def look(seed: int) -> Seen:
    """Fit a system, and name causes whatever they explain."""
    made = system(seed)
    fit = oa.estimate(made.record, BASELINE, seed=0, solver=oa.LevenbergMarquardt(60))
    problem, ground = fit.problem, ground_of(fit, oa.Training())
    true = np.zeros(3)
    if made.cause is not None:
        values = made.coefficient * made.cause.values(problem.rows.x, problem.layout, problem.outputs)
        true = problem.projection.solve(problem.weight.rows(values))
    causes = []
    for declared in ((made.cause,) if made.cause else (), ()):
        cause = named_cause(ground, declared, 0.0)
        found = cause is not None and cause.explained is not None and cause.coefficient_found is not None
        causes.append((cause.explained, cause.coefficient_found * np.array(cause.bias)) if found else None)
    shape = problem.projection.to_coordinates
    return Seen(true, np.asarray(fit.std), fit.theta - made.theta, fit.freedom, shape, tuple(causes))


@cache
def looked(systems: int) -> tuple[Seen, ...]:
    """All systems."""
    return tuple(map(look, range(systems)))


def rates(systems: int, way: int, least: float = LEAST_SHARE) -> list[float]:
    """Per cent: false alarms, misses, misses of more than three standard errors; median error of the bias told.

    A system counts as biased where the true bias of some parameter exceeds its standard error. The median is over the
    biased systems with a warning, in the norm of the prediction.
    """
    alarms, misses, large, errors, named = [], [], [], [], []
    for one in looked(systems):
        cause = one.causes[way]
        told = cause is not None and cause[0] >= least
        bias = cause[1] if told and cause is not None else np.zeros(3)
        warned, biased = np.any(np.abs(bias) > one.std), np.abs(one.true / one.std).max()
        if biased <= 1:
            alarms.append(warned)
            continue
        misses.append(not warned)
        large += [not warned] if biased > 3 else []
        error = np.linalg.norm(one.shape @ (bias - one.true)) / np.linalg.norm(one.shape @ one.true)
        errors += [error] if warned else []
        named.append(error)
    return [*(100 * float(np.mean(v)) for v in (alarms, misses, large)), 100 * float(np.median(errors))]


def coverage(systems: int, way: int) -> list[list[float]]:
    """Per cent of θ that intervals cover, over the systems with a named cause: plain, hull, moved, with the rest."""
    hits = {name: [] for name in ("plain", "hull", "moved", "with the rest")}
    for one in looked(systems):
        cause = one.causes[way]
        if cause is None or cause[0] < LEAST_SHARE:
            continue
        share, bias = cause
        reach = 1.96 * one.std
        low, high = one.error - reach, one.error + reach
        rest = with_bias(one.error, one.std, one.freedom, bias, share)
        for name, a, b in (
            ("plain", low, high),
            ("hull", low - np.maximum(bias, 0), high - np.minimum(bias, 0)),
            ("moved", low - bias, high - bias),
            ("with the rest", rest[:, 0], rest[:, 1]),
        ):
            hits[name].append((a <= 0) & (b >= 0))
    return [[100 * float(np.mean(v))] for v in hits.values()]


def main(systems: int) -> None:
    print(describe())
    began = time.perf_counter()
    found = looked(systems)
    print(f"{len(found)} systems, {time.perf_counter() - began:.0f} s\n")
    for way, name in enumerate(("declared", "found")):
        for least in (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9):
            print(f"| {name}, share {least} | " + " | ".join(f"{v:.1f} %" for v in rates(systems, way, least)) + " |")
        print(f"{name}: coverage {[round(v[0], 1) for v in coverage(systems, way)]}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 400)
