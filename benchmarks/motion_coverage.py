"""Do 95 % intervals of a motion's parameters hold the truth? Mass-spring-damper with friction, learner on the velocity.

Steps of force, 1000 rows of 10 ms, 30 dB of noise on the position, equations by Runge-Kutta steps, evidence. The true
damper is the one nearest to all that depends on the velocity, over the noiseless run.
Run: python benchmarks/motion_coverage.py [draws, default 200]
"""

from __future__ import annotations

import sys
import time
from functools import cache
from typing import NamedTuple

import numpy as np
from machine import describe

import orthaug as oa
from orthaug.analysis.budget import budget_by
from orthaug.analysis.causes import Considered, explain_learner
from orthaug.analysis.free_run_bias import linearize_fit
from orthaug.analysis.learned_part import learned_reach
from orthaug.models.motion_field import parts_at

M, C, K, COULOMB = 1.0, 2.0, 100.0, 1.5
TS, ROWS, HELD, FINE = 0.01, 1000, 25, 10
NOISE = 10**-1.5  # over the output's deviation
NAMES = ("m", "c", "k")
DRAWS = 200
# M/s, nearly the reach of the data; friction turns over within 0.1 m/s of 0
SPEEDS = np.linspace(-4, 4, 17)


class Plant(NamedTuple):
    """Force and noiseless position (N,), and the true m, c, k."""

    force: np.ndarray
    position: np.ndarray
    true: np.ndarray

    def record(self, draw: int) -> oa.Record:
        noise = np.random.default_rng([draw, 1]).normal(size=ROWS) * NOISE * self.position.std()
        names = {"inputs": ["force"], "outputs": ["position"]}
        return oa.Record.from_arrays(self.force, self.position + noise, sampling_time=TS, **names)


def friction(v: np.ndarray) -> np.ndarray:
    return COULOMB * np.tanh(v / 0.1)


@cache
def plant() -> Plant:
    force = np.repeat(np.random.default_rng(1).uniform(-20, 20, ROWS // HELD), HELD)

    def rate(x: np.ndarray, u: float) -> np.ndarray:
        return np.array([x[1], (u - C * x[1] - K * x[0] - friction(x[1])) / M])

    x, found, h = np.zeros(2), [], TS / FINE
    for u in force:
        found.append(x)
        for _ in range(FINE):
            first = rate(x, u)
            second = rate(x + h / 2 * first, u)
            third = rate(x + h / 2 * second, u)
            x = x + h / 6 * (first + 2 * second + 2 * third + rate(x + h * third, u))
    position, v = np.array(found).T
    return Plant(force, position, np.array([M, C + v @ friction(v) / (v @ v), K]))


def motion() -> oa.Motion:
    return oa.Motion.from_equations(
        states=[
            oa.State("x", "v", start="position"),
            oa.State("v", "(force - c*v - k*x)/m", start="derivative of position", learned=True),
        ],
        outputs=[oa.Output("position", "x")],
        inputs=["force"],
        parameters=[
            oa.PhysicalParameter(*given, min=0)
            for given in zip(NAMES, (1.2, 1.2, 120.0), strict=True)
        ],
    )


class Draws(NamedTuple):
    """Of each draw that has intervals: estimates, standard errors and whether the intervals hold the truth (n, 3)."""

    values: np.ndarray
    std: np.ndarray
    inside: np.ndarray
    curve: np.ndarray
    """Whether the band of the learned curve holds the true one (n, speeds)."""
    named: np.ndarray
    """Of each draw whether dry friction is named, and the interval of the damper itself that counts it (n, 3)."""
    without: int
    """Draws without intervals."""

    @property
    def bias(self) -> np.ndarray:
        """Mean error over the mean standard error."""
        return (self.values.mean(axis=0) - plant().true) / self.std.mean(axis=0)

    @property
    def scatter(self) -> np.ndarray:
        """Scatter over the mean standard error."""
        return self.values.std(axis=0) / self.std.mean(axis=0)

    @property
    def coverage(self) -> np.ndarray:
        """In percent."""
        return 100 * self.inside.mean(axis=0)


def curve_inside(fit: oa.MotionEstimate) -> np.ndarray:
    """Whether the 95 % band of what is learned over the velocity holds friction less the nearest damper (speeds,)."""
    x, u = np.stack([0 * SPEEDS, SPEEDS], axis=1), np.zeros((len(SPEEDS), 1))
    true = ((plant().true[1] - C) * SPEEDS - friction(SPEEDS)) / M
    half = learned_reach(fit, x, u)
    assert half is not None
    return np.abs(parts_at(fit.model.form, fit.model.numbers, x, u)[1][:, 0] - true) <= half[:, 0]


def damper_alone(fit: oa.MotionEstimate) -> tuple[float, float, float]:
    """Whether the usual terms tell of dry friction, where none was declared, and the interval that counts it."""
    terms = linearize_fit(fit)
    assert terms is not None
    considered = Considered(*terms.usual_biases(), joint=True, seen_only=True)
    causes = explain_learner(terms, considered)
    budget = None if causes is None else budget_by(terms, [causes])
    found = None if budget is None else budget.of("c")
    if budget is None or found is None or found.ci95 is None:
        return 0.0, np.nan, np.nan
    return float(budget.cause.suspect.name.startswith("coulomb of v")), *found.ci95


@cache
def drawn(draws: int) -> Draws:
    found, without = [], 0
    for draw in range(draws):
        fit = oa.estimate(
            plant().record(draw), motion(), learner=oa.MLP((6,), inputs=("v",)), blocks=0, seed=draw
        )
        if fit.std is None or fit.interval is None or np.isnan(fit.std).any():
            without += 1
            continue
        low, high = fit.interval.T
        inside = (low <= plant().true) & (plant().true <= high)
        found.append((fit.values, fit.std, inside, curve_inside(fit), damper_alone(fit)))
    return Draws(*(np.array(part) for part in zip(*found, strict=True)), without)


def table() -> list[list[float]]:
    """Bias, scatter and coverage of each parameter, as in benchmarks/README.md."""
    found = drawn(DRAWS)
    return [
        [float(v) for v in row]
        for row in zip(found.bias, found.scatter, found.coverage, strict=True)
    ]


def band() -> list[float]:
    """Coverage of the learned curve's band in percent: where friction is smooth, and within 0.5 m/s of its turn."""
    curve, near = drawn(DRAWS).curve, np.abs(SPEEDS) <= 0.5
    return [float(100 * curve[:, part].mean()) for part in (~near, near)]


def damper() -> list[float]:
    """Percent of the draws that name dry friction, coverage of the damper itself, median width of its interval."""
    named, low, high = drawn(DRAWS).named.T
    inside = (low <= C) & (high >= C)
    return [float(100 * named.mean()), float(100 * inside.mean()), float(np.nanmedian(high - low))]


def main(draws: int) -> None:
    print(describe())
    began = time.perf_counter()
    found = drawn(draws)
    seconds = (time.perf_counter() - began) / draws
    print(
        f"\n{draws} draws, {found.without} without intervals, {seconds:.1f} s a draw; a "
        "coverage of 95 % is seen with"
    )
    print(f"a standard error of {100 * np.sqrt(0.0475 / draws):.1f} %.\n")
    print(
        "| parameter | true | bias / standard error | scatter / standard error | coverage |\n"
        + 5 * "|---"
        + "|"
    )
    rows = zip(NAMES, plant().true, found.bias, found.scatter, found.coverage, strict=True)
    for name, true, bias, scatter, coverage in rows:
        print(f"| {name} | {true:.3f} | {bias:.2f} | {scatter:.2f} | {coverage:.1f} % |")
    near = np.abs(SPEEDS) <= 0.5
    smooth, turn = (100 * found.curve[:, part].mean() for part in (~near, near))
    print(
        f"\nThe band of the learned curve holds the true one at {smooth:.0f} % of the speeds "
        "beyond 0.5 m/s, at ",
        end="",
    )
    print(f"{turn:.0f} % of those within.")
    named, low, high = found.named.T
    inside = 100 * ((low <= C) & (high >= C)).mean()
    print(
        f"Dry friction is named in {100 * named.mean():.0f} % of the draws; the interval of "
        "the damper itself that "
    )
    print(f"counts it holds {C} in {inside:.0f} %, median width {np.nanmedian(high - low):.2g}.")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else DRAWS)
