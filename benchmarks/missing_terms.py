"""How often is a term said to be missing from a motion where none is, and is the right one named where one is?

A mass on a spring and a damper under steps of force, 400 rows of 50 ms: the equations are right (white and coloured
noise; with a learner that is not needed), or lack Coulomb friction, a cubic spring, or that the force saturates.
Run: python benchmarks/missing_terms.py [draws, default 100]
"""

from __future__ import annotations

import sys
from functools import cache
from typing import NamedTuple

import numpy as np
import scipy.signal
from machine import describe

import orthaug as oa
from orthaug.analysis.missing_terms import missing_terms

TS, ROWS, FINE, HELD = 0.05, 400, 8, 10
M, C, K = 1.0, 0.8, 25.0
NOISE = 0.02  # of the output's deviation
DRAWS = 100
LEVELS = (0.05, 0.01)


class Case(NamedTuple):
    """What the plant has beside mass, spring and damper, its noise, and what the right answer is."""

    name: str
    friction: float = 0.0
    cube: float = 0.0
    limit: float = np.inf
    """Force at which the actuator saturates [N]."""
    colour: float = 0.0
    """Of the noise, as the coefficient of an autoregression of first order."""
    learner: bool = False
    noise: float = NOISE
    truth: tuple[str, str, str] | None = None


CASES = (
    Case("right equations, white noise"),
    Case("right equations, coloured noise", colour=0.9),
    Case("right equations, learner of v", learner=True),
    Case("friction, seen by a learner of v", friction=0.6, learner=True),
    Case("friction, small", friction=0.05, truth=("v", "v", "jump")),
    Case("friction", friction=0.6, truth=("v", "v", "jump")),
    Case("friction, coloured noise", friction=0.6, colour=0.9, truth=("v", "v", "jump")),
    Case("cubic spring", cube=40.0, truth=("v", "x", "cube")),
    Case("cubic spring, learner of v", cube=40.0, learner=True, truth=("v", "x", "cube")),
    Case("saturating actuator", limit=5.0, truth=("v", "u", "beyond")),
)


def record(case: Case, draw: int) -> oa.Record:
    """Steps of force and the position, finely integrated."""
    random = np.random.default_rng([draw, 7])
    force = np.repeat(random.uniform(-8, 8, ROWS // HELD), HELD)
    x, found, h = np.zeros(2), [], TS / FINE

    def rate(x: np.ndarray, u: float) -> np.ndarray:
        own = (
            np.clip(u, -case.limit, case.limit)
            - C * x[1]
            - K * x[0]
            - case.friction * np.tanh(x[1] / 0.05)
            - case.cube * x[0] ** 3
        )
        return np.array([x[1], own / M])

    for u in force:
        found.append(x[0])
        for _ in range(FINE):
            k1 = rate(x, u)
            k2 = rate(x + h / 2 * k1, u)
            k3 = rate(x + h / 2 * k2, u)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3, u))
    position = np.array(found)
    white = random.normal(size=ROWS)
    noise = np.sqrt(1 - case.colour**2) * scipy.signal.lfilter([1.0], [1.0, -case.colour], white)
    return oa.Record.from_arrays(
        u=force, y=position + case.noise * position.std() * noise, sampling_time=TS
    )


def motion(learned: bool) -> oa.Motion:
    return oa.Motion.from_equations(
        states=[
            oa.State("x", "v", start="y"),
            oa.State("v", "(u - c*v - k*x)/m", start="derivative of y", learned=learned),
        ],
        outputs=[oa.Output("y", "x")],
        inputs=["u"],
        parameters=[
            oa.PhysicalParameter(*given, min=0)
            for given in zip("mck", (1.2, 1.2, 30.0), strict=True)
        ],
    )


class Outcome(NamedTuple):
    """Shares of the draws, in percent: told at each level, then those told at the last with the right names."""

    told: tuple[float, ...]
    equation_and_variable: float
    shape: float
    share: float
    """Median of what the best term explains."""
    untested: int


@cache
def outcome(case: Case, draws: int) -> Outcome:
    entries, named, shaped, shares = [], 0, 0, []
    for draw in range(draws):
        learner = oa.MLP((4,), inputs=("v",)) if case.learner else None
        options = {"learner": learner, "blocks": 0, "fallback": False, "seed": draw}
        fit = oa.estimate(
            record(case, draw), motion(case.learner), criterion=oa.Simulation(0, 0), **options
        )
        found = missing_terms(fit)
        if found is None:  # the fit ended nowhere
            entries.append([False] * len(LEVELS))
            continue
        entries.append([found.p < level for level in LEVELS])
        best = found.terms[0]
        shares.append(best.share)
        if case.truth is not None and found.p < LEVELS[-1]:
            named += (best.equation, best.variable) == case.truth[:2]
            shaped += (best.equation, best.variable, best.shape) == case.truth
    parts = tuple(float(100 * share) for share in np.mean(entries, axis=0))
    return Outcome(
        parts,
        100 * named / draws,
        100 * shaped / draws,
        100 * float(np.median(shares)),
        draws - len(shares),
    )


def table(draws: int = DRAWS) -> list[list[float]]:
    """Of each case: told at 5 and 1 %, right equation and variable, right shape, share; as in benchmarks/README.md."""
    found = [outcome(case, draws) for case in CASES]
    return [[*one.told, one.equation_and_variable, one.shape, one.share] for one in found]


def main(draws: int) -> None:
    print(describe())
    print(
        f"\n{draws} draws\n\n| case | p < 5 % | p < 1 % | right equation and variable | right "
        "shape | share |"
    )
    print(6 * "|---" + "|")
    for case, row in zip(CASES, table(draws), strict=True):
        shown = " | ".join(f"{value:.1f} %" for value in row)
        print(f"| {case.name} | {shown} |")
    print(
        "not tested:", ", ".join(f"{case.name} {outcome(case, draws).untested}" for case in CASES)
    )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else DRAWS)
