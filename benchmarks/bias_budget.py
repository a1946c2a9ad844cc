"""Is the bias that a fit tells of its parameters the true one, and does an interval with it cover the truth?

Generated mass-spring-dampers of random mass, damping and stiffness with unmodelled terms of random kind and size,
under random inputs, with noise in the equation. Two of the kinds are none that a fit tries by itself. The true bias is
`Φ⁺Δ`, known exactly. Every second system lacks nothing; of the others a third lacks two terms. "Declared": the first
missing term is the only suspect that is declared; "found": none is.
Run: python benchmarks/bias_budget.py [systems, default 400]
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from machine import describe

import orthaug as oa
from orthaug.analysis.causes import explain_learner
from orthaug.analysis.measure_bias import linearization_of
from orthaug.analysis.suspects import Suspect

SAMPLES, TS = 2000, 0.01
LITTLE = 1e-12  # of the learner: the best cause is looked at, however little it explains
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


_V = f"(({VELOCITY})/w)"
OUTSIDE = tuple(
    ("expression", text.replace("v", _V))
    for text in (
        "sign(v)*log(1 + 4*abs(v))",
        "v/(1 + v**2)",
        "v/sqrt(v**2 + 0.1)",
        "sin(3*v)",
        "max(min(v, 0.3), -0.3) + 0.3*max(min(v, 1.2), -1.2)",
        "max(sign(v), -0.4)",
        "tanh(20*max(v, 0)) - 0.5*tanh(20*max(-v, 0))",
        "sign(v)*(0.4 + exp(-(2*v)**2))",
        "v**5",
        "atan(4*v) + 0.3*abs(v)",
    )
)  # v in median speeds; with the last two of KINDS 12 of 22 are none that a fit tries by itself


class System(NamedTuple):
    """A record, its true θ, and the terms that are missing with their coefficients, none, one or two."""

    record: oa.Record
    theta: np.ndarray
    causes: tuple[tuple[Suspect, float], ...]


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


def system(seed: int, kinds: tuple[tuple[str, str], ...] = KINDS) -> System:
    """Backward Euler of `m ẍ + c ẋ + k x = u`, plus missing terms, each of a share of the output's change."""
    rng = np.random.default_rng([seed, 12])
    m, c, k = np.exp(rng.uniform(np.log([0.5, 5, 300]), np.log([2, 100, 3000])))
    theta = np.array([2 * m + c * TS, -m, TS**2]) / (m + c * TS + k * TS**2)
    u = force(rng)
    linear = simulate(theta, u, 0 * u, ())
    change = np.diff(linear).std()
    noise = rng.normal(size=SAMPLES) * change * np.exp(rng.uniform(np.log(1e-3), np.log(1e-2)))
    x = np.column_stack([linear[1:-1], linear[:-2], u[1:-1]])
    causes, terms = [], []
    for i in range(0 if seed % 2 else 2 if rng.uniform() < 1 / 3 else 1):
        kind, on = kinds[rng.integers(len(kinds))]
        on = on.replace("/w)", f"/{float(np.median(np.abs(np.diff(linear))))!r})")
        width = {
            "stribeck": np.median(np.abs(np.diff(linear))) * rng.uniform(0.3, 2),
            "dead_zone": linear.std() * rng.uniform(0.3, 1),
        }.get(kind)
        cause = Suspect.of(kind, on, width=width, name=f"missing {i}")
        share = np.exp(rng.uniform(np.log(5e-4), np.log(1e-1)))
        values = cause.values(x, oa.Lags(2, 1, 1).layout(("y",), ("u",)), ["y"])
        causes.append((cause, -share * change / values.std()))
        known = kind != "expression" or (kind, on) in KINDS
        terms.append((causes[-1][1], form(kind, on, width) if known else reading(cause)))
    with np.errstate(all="ignore"):
        y = simulate(theta, u, noise, tuple(terms))
    if not np.all(np.abs(y) < 10 * np.abs(linear).max()):  # a term makes it unstable: other ones
        return system(seed + 1_000_000, kinds)
    return System(oa.Record.from_arrays(u, y), theta, tuple(causes))


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
    acts = {
        VELOCITY: lambda a, b, u: a - b,
        "y[k-1]": lambda a, b, u: a,
        "u[k-1]": lambda a, b, u: u,
    }
    products = {"y[k-1]**2": lambda a, b, u: a * a, "u[k-1]**2": lambda a, b, u: u * u}
    products |= {"u[k-1]*y[k-1]": lambda a, b, u: u * a, "abs(u[k-1])": lambda a, b, u: abs(u)}
    products[f"({VELOCITY})**2"] = lambda a, b, u: (a - b) ** 2
    return products[on] if kind == "expression" else lambda a, b, u: of[kind](acts[on](a, b, u))


def reading(cause: Suspect):
    """The missing term as a function of y[k-1], y[k-2], u[k-1], by its expression."""
    lags = cause.lags

    def at(a: float, b: float, u: float) -> float:
        values = {"y[k-1]": a, "y[k-2]": b, "u[k-1]": u}
        return float(cause.parsed.evaluate({lag: values[str(lag)] for lag in lags}, np))

    return at


def simulate(theta: np.ndarray, u: np.ndarray, noise: np.ndarray, terms: tuple) -> np.ndarray:
    """The output, at rest before."""
    y = np.zeros(len(u))
    for k in range(2, len(u)):
        a, b, last = y[k - 1], y[k - 2], u[k - 1]
        y[k] = theta[0] * a + theta[1] * b + theta[2] * last + noise[k]
        for coefficient, term in terms:
            y[k] += coefficient * term(a, b, last)
    return y


Told = tuple[float, np.ndarray, np.ndarray]


class Looked(NamedTuple):
    """A fitted system: true bias, standard errors, error of θ, R, and what explains the learner.

    `told` are share, bias and what is left over of the best declared cause (None where none is), and of the best that
    is found.
    """

    true: np.ndarray
    std: np.ndarray
    error: np.ndarray
    freedom: float
    shape: np.ndarray
    told: tuple[Told | None, ...]


def look(seed: int) -> Looked:
    """Fit a system, and name causes whatever they explain."""
    made = system(seed)
    fit = oa.estimate(made.record, BASELINE, seed=0, solver=oa.LevenbergMarquardt(60))
    problem, true = fit.problem, np.zeros(3)
    for cause, coefficient in made.causes:
        values = coefficient * cause.values(problem.rows.x, problem.layout, problem.outputs)
        true = true + problem.projection.solve(problem.weight.rows(values))
    terms, result = linearization_of(fit, oa.Training()), []
    for declared in (tuple(cause for cause, _ in made.causes[:1]), ()):
        tried = (replace(each, enough=LITTLE) for each in terms.considered(declared))
        causes = (explain_learner(terms, each, declared) for each in tried)
        best = next((found for found in causes if found is not None), None)
        result.append(None if best is None else (best.share, best.moved, best.unsure))
    shape = problem.projection.to_coordinates
    return Looked(
        true, np.asarray(fit.std), fit.theta - made.theta, fit.freedom, shape, tuple(result)
    )


@cache
def looked(systems: int) -> tuple[Looked, ...]:
    """All systems."""
    return tuple(map(look, range(systems)))


def told(one: Looked, declared: bool, least: float) -> Told | None:
    """What a fit tells: of a declared cause if that explains enough, else of one that it finds."""
    for cause in one.told if declared else one.told[1:]:
        if cause is not None and cause[0] >= least:
            return cause
    return None


def rates(systems: int, declared: bool, least: float) -> list[float]:
    """Per cent: false alarms, misses, median error of the bias told, and warnings that err by more than half.

    A system counts as biased where the true bias of some parameter exceeds its standard error. Errors are in the norm
    of the prediction, over the biased systems with a warning.
    """
    alarms, misses, errors = [], [], []
    for one in looked(systems):
        cause = told(one, declared, least)
        bias = np.zeros(3) if cause is None else cause[1]
        warned = bool(np.any(np.abs(bias) > one.std))
        if not np.any(np.abs(one.true) > one.std):
            alarms.append(warned)
            continue
        misses.append(not warned)
        if warned:
            errors.append(
                np.linalg.norm(one.shape @ (bias - one.true)) / np.linalg.norm(one.shape @ one.true)
            )
    wrong = float(np.mean(np.array(errors) > 0.5))
    return [
        100 * v
        for v in (float(np.mean(alarms)), float(np.mean(misses)), float(np.median(errors)), wrong)
    ]


@cache
def shown(systems: int, declared: bool) -> tuple[tuple[float, ...], ...]:
    """Of each parameter of each system that lacks a term, where a cause is named: held by ci95, by the hull, open.

    Over the kinds of `KINDS` and of `OUTSIDE`, every system with a term missing.
    """
    found = []
    for seed in range(0, 2 * systems, 2):
        made = system(seed, (*KINDS, *OUTSIDE))
        fit = oa.estimate(made.record, BASELINE, seed=0, solver=oa.LevenbergMarquardt(60))
        budget = oa.bias_budget(fit, [cause for cause, _ in made.causes[:1]] if declared else ())
        if budget is None:
            continue
        for entry, truth, plain in zip(
            budget.parameters, made.theta, np.asarray(fit.interval), strict=True
        ):
            low, high = entry.ci95 or (-np.inf, np.inf)
            found.append(
                (
                    float(plain[0] <= truth <= plain[1]),
                    float(low <= truth <= high),
                    float(not entry.determined),
                )
            )
    return tuple(found)


def covered(systems: int, declared: bool) -> list[float]:
    """Per cent of θ covered where a cause is named: by ci95, by the interval shown with the bias; not determined."""
    return [100 * float(share) for share in np.mean(shown(systems, declared), axis=0)]


SHARES = (0.3, 0.5, 0.7)


def warned(systems: int = 440) -> list[list[float]]:
    """The rates, for a cause that is declared and one that is not, of each least share."""
    return [rates(systems, declared, least) for declared in (True, False) for least in SHARES]


def coverage(systems: int = 60) -> list[list[float]]:
    """The coverage, for a cause that is declared and one that is not."""
    return [covered(systems, declared) for declared in (True, False)]


def main(systems: int) -> None:
    print(describe())
    began = time.perf_counter()
    print(f"{len(looked(systems))} systems, {time.perf_counter() - began:.0f} s\n")
    print(
        "| cause | least share | false alarms | misses | median error | off by more than half |\n"
        + 6 * "|---"
        + "|"
    )
    kinds = [(kind, least) for kind in ("declared", "found") for least in SHARES]
    for (kind, least), row in zip(kinds, warned(systems), strict=True):
        print(f"| {kind} | {least} | " + " | ".join(f"{v:.1f} %" for v in row) + " |")
    print("\n| cause | ci95 | shown with the bias | not determined |\n" + 4 * "|---" + "|")
    for kind, row in zip(("declared", "found"), coverage(min(systems, 60)), strict=True):
        print(f"| {kind} | " + " | ".join(f"{v:.1f} %" for v in row) + " |")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 440)
