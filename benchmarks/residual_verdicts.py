"""Is the verdict on the residual right? The change that it predicts to help is made, and held-out errors are compared.

Measured sets and generated systems of benchmarks/free_run_problems.py, one step ahead and on the free run, with and
without a learner; and second-order systems with a known cause. Where a change is named, the verdict is right if the
error that it speaks of falls on held-out rows by 1 % or more. Where none is, it is right if no change that was tried
lowers the error that was trained on by 5 %: the other criterion, a further lag of each kind, an offset, a learner that
is larger or sees more.
Run: python benchmarks/residual_verdicts.py
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from free_run_problems import FreeRunProblem, problems
from machine import describe
from scipy.signal import lfilter

import orthaug as oa
from orthaug.analysis.changes import Change
from orthaug.analysis.diagnosis import diagnose
from orthaug.data.expressions import Lag

# Of the held-out error: a change that helps; one that a verdict of none must not miss
FELL, HELPED = (0.01, 0.05)
PREDICTION, SIMULATION = oa.Prediction(), oa.Simulation(512, 40)
SOLVER, SKIP, NEURONS = oa.LevenbergMarquardt(60), 40, 10


@dataclass(frozen=True)
class Case:
    """Records to fit and to hold out, and a model; `cause` is what is wrong with it, where that is known."""

    name: str
    train: oa.Record
    held_out: oa.Record
    baseline: oa.Baseline
    lags: oa.Lags
    learner: oa.MLP | None
    criterion: oa.Prediction | oa.Simulation
    cause: str = ""

    @property
    def of(self) -> str:
        return "simulation" if self.criterion.simulates else "prediction"

    def fit(self) -> oa.Estimate:
        options = {
            "lags": self.lags,
            "learner": self.learner,
            "criterion": self.criterion,
            "solver": SOLVER,
        }
        return oa.estimate(self.train, self.baseline, blocks=0, **options)

    def error(self, fit: oa.Estimate, of: str) -> float:
        """Held-out RMS error in the training outputs' deviations."""
        response = (
            fit.model.simulate(self.held_out)
            if of == "simulation"
            else fit.model.predict(self.held_out)
        )
        if not fit.status.ok or any(t.diverged for t in response.trajectories):
            return math.inf
        return float(np.sqrt(np.mean((response.scores(SKIP).rmse / fit.problem.deviation) ** 2)))

    def changed(self, change: Change) -> Case:
        """With the change made."""
        if change.kind == "criterion":
            return replace(
                self, criterion=SIMULATION if change.what == "simulation" else PREDICTION
            )
        if change.kind == "learner":
            return replace(self, learner=self._larger())
        term = oa.Term("further", change.what, output=change.output)
        terms = [*self.baseline.terms, term]
        return replace(self, baseline=oa.Baseline.from_terms(terms))

    def _larger(self) -> oa.MLP:
        if self.learner is None:
            return oa.MLP((NEURONS,))
        if self.learner.inputs is None:
            return oa.MLP(tuple(2 * width for width in self.learner.hidden))
        return oa.MLP(self.learner.hidden)

    def candidates(self, fit: oa.Estimate) -> Iterator[Change]:
        """What is tried where no change is named."""
        outputs, inputs = fit.problem.outputs, [c.name for c in self.train.inputs]
        other = "prediction" if self.criterion.simulates else "simulation"
        if fit.model.form.states:
            yield Change("criterion", other, 0.0, self.of)
        for output in outputs:
            own = output if len(outputs) > 1 else None
            if "1" not in [term.regressor for term in self.baseline.terms]:
                yield Change("offset", "1", 0.0, self.of, own)
            for name in (output, *inputs):
                there = [lag.lag for lag in fit.problem.layout if lag.channel == name]
                kind = "output_lag" if name == output else "input_lag"
                yield Change(kind, str(Lag(name, max(there, default=0) + 1)), 0.0, self.of, own)
                if kind == "input_lag" and there and min(there) > 0:
                    yield Change(kind, str(Lag(name, min(there) - 1)), 0.0, self.of, own)
        yield Change("learner", "a larger one", 0.0, self.of)


class Outcome(NamedTuple):
    """What the verdict predicts, and what came of it: the fall of the held-out error, or the best of all tried."""

    case: Case
    verdict: str
    change: Change | None
    fall: float
    tried: str
    right: bool
    text: str


def fall(case: Case, fit: oa.Estimate, change: Change) -> float:
    """By which share the held-out error falls when the change is made; 0 where both are unbounded."""
    try:
        after = case.error(case.changed(change).fit(), change.of)
    except oa.InputError:  # such as a lag that is there already
        return 0.0
    before = case.error(fit, change.of)
    return 0.0 if math.isinf(before) and math.isinf(after) else 1 - after / before


def outcome(case: Case) -> Outcome:
    """Fit, diagnose, make the change and measure."""
    fit = case.fit()
    found = diagnose(fit)
    assert found is not None
    if found.changes:
        change = found.changes[0]
        gained = fall(case, fit, change)
        return Outcome(case, found.verdict, change, gained, change.what, gained >= FELL, found.text)
    tried = {f"{c.kind} {c.what}": fall(case, fit, c) for c in case.candidates(fit)}
    best = max(tried, key=lambda name: tried[name])
    return Outcome(case, found.verdict, None, tried[best], best, tried[best] < HELPED, found.text)


# --- systems with a known cause

TERMS = {"a": "y[k-1]", "b": "y[k-2]", "g": "u[k-1]"}


@cache
def records(
    delay: int = 1,
    further: float = 0.0,
    third: float = 0.0,
    friction: float = 0.0,
    offset: float = 0.0,
    equation: float = 0.0,
    sensor: float = 0.0,
    pole: float = 0.0,
    rows: int = 1500,
    seed: int = 17,
) -> tuple[oa.Record, oa.Record]:
    """A second-order system under white noise, twice; `friction` is a function of the velocity."""
    made = []
    for part in range(2):
        rng = np.random.default_rng([seed, part])
        u, e, v = rng.normal(size=(3, rows + 200))
        v = lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], v)
        y = np.zeros(rows + 200)
        for k in range(10, rows + 200):
            y[k] = (
                1.5 * y[k - 1]
                - 0.7 * y[k - 2]
                + u[k - delay]
                + further * u[k - delay - 1]
                + third * y[k - 3]
            )
            y[k] += offset + equation * e[k] - friction * np.tanh(2 * (y[k - 1] - y[k - 2]))
        made.append(oa.Record.from_arrays(u[200:], (y + sensor * v)[200:]))
    return made[0], made[1]


def known(seed: int = 17) -> Iterator[Case]:
    """Second-order systems whose physics is a, b, g, or lacks something of theirs."""
    baseline = oa.Baseline.from_terms([oa.Term(name, text) for name, text in TERMS.items()])
    network, blind = oa.MLP((8,)), oa.MLP((8,), inputs=("y[k-1]",))

    def case(cause: str, criterion: Any, learner: oa.MLP | None = None, **system: Any) -> Case:
        return Case(
            "generated",
            *records(seed=seed, **system),
            baseline,
            oa.Lags(2, 1, 1),
            learner,
            criterion,
            cause,
        )

    for criterion, noise in ((PREDICTION, {"equation": 0.1}), (SIMULATION, {"sensor": 0.3})):
        yield case("a further input lag", criterion, further=0.5, **noise)
        yield case("the delay is 3", criterion, delay=3, **noise)
        yield case("a further output lag", criterion, third=0.15, **noise)
        yield case("an offset", criterion, offset=1.0, **noise)
        yield case("velocity friction", criterion, friction=0.5, **noise)
        yield case("velocity friction, not seen", criterion, blind, friction=0.5, **noise)
        yield case("nothing: friction, seen", criterion, network, friction=0.5, **noise)
        yield case("nothing: the physics is right", criterion, **noise)
        yield case("nothing: a tiny further lag", criterion, further=0.01, rows=8000, **noise)
    yield case("sensor noise", PREDICTION, sensor=0.3)
    yield case("sensor noise, friction seen", PREDICTION, network, sensor=0.3, friction=0.5)
    yield case("equation noise", SIMULATION, equation=0.1)
    yield case("nothing: coloured sensor noise", SIMULATION, sensor=0.3, pole=0.9)


def of_problem(problem: FreeRunProblem) -> Iterator[Case]:
    """A problem under both criteria, with and without its learner."""
    for criterion in (PREDICTION, SIMULATION):
        for learner in (None, problem.learner):
            data = (problem.name, problem.train, problem.held_out, problem.baseline, problem.lags)
            yield Case(*data, learner, criterion)


def cases() -> Iterator[Case]:
    """All of them."""
    yield from known()
    for problem in problems():
        yield from of_problem(problem)


@cache
def outcomes() -> list[Outcome]:
    """Of all cases, told as they come."""
    found = []
    print("| set | model | criterion | cause | verdict | predicted to help | by | measured | |")
    print("|---|---|---|---|---|---|---|---|---|")
    for case in cases():
        one = outcome(case)
        found.append(one)
        learner = "physics" if case.learner is None else "learner"
        change = (
            f"{one.change.kind} {one.change.what}" if one.change else f"none (best: {one.tried})"
        )
        by = f"{100 * one.change.fall:.0f} %" if one.change else "–"
        cells = (
            case.name,
            learner,
            case.of,
            case.cause,
            one.verdict,
            change,
            by,
            f"{100 * one.fall:.0f} %",
        )
        print(f"| {' | '.join(cells)} | {'right' if one.right else 'wrong'} |", flush=True)
    return found


def summary() -> list[int]:
    """Right and all of the changes that were named, of the verdicts that none is needed, of both; and "unmodelled"."""
    named = [one.right for one in outcomes() if one.change]
    none = [one.right for one in outcomes() if not one.change]
    unmodelled = sum(one.verdict == "unmodelled" for one in outcomes())
    return [
        sum(named),
        len(named),
        sum(none),
        len(none),
        sum(named + none),
        len(named + none),
        unmodelled,
    ]


def kinds() -> list[int]:
    """Right and all of the measured sets, and of the systems with a known cause."""
    measured = [
        one.right
        for one in outcomes()
        if one.case.name.startswith(("silverbox", "MR damper", "tanks,"))
    ]
    causes = [one.right for one in outcomes() if one.case.cause]
    return [sum(measured), len(measured), sum(causes), len(causes)]


def fresh() -> list[int]:
    """Right and all of two further draws of the systems with a known cause: no limit was chosen on them."""
    right = [outcome(case).right for seed in (101, 102) for case in known(seed)]
    return [sum(right), len(right)]


def falls() -> list[list[float]]:
    """In per cent, of every case: the predicted fall, where there is one, and the measured one."""
    return [
        [100 * fall for fall in (*([one.change.fall] if one.change else []), one.fall)]
        for one in outcomes()
    ]


def main() -> None:
    print(describe())
    began = time.perf_counter()
    a, b, c, d, e, f, g = summary()
    print(
        f"\nA change is named: right {a} of {b}. None needed: right {c} of {d}. Together {e} "
        f"of {f}."
    )
    print(f"unmodelled {g} of {f}; {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
