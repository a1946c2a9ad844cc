"""Free runs of twelve problems from twelve starts each: none above physics alone, and none handed over worse than it.

Four problems are measured, eight generated, three of those unstable or marginally stable. Errors are RMS over whole
records. Run: python benchmarks/free_runs.py [starts]
"""

from __future__ import annotations

import math
import sys
from typing import NamedTuple

import numpy as np
from free_run_problems import FreeRunProblem, problems
from machine import describe

import orthaug as oa

STARTS = 12
SEGMENTATIONS = ((512, 40), (0, 40), (64, 0))


class Outcome(NamedTuple):
    """Of one problem under one segmentation."""

    problem: str
    segment: int
    above: int
    """Starts that ended above physics alone on the training data."""
    best: float
    """Held-out error of the chosen run over that of physics alone, whether it was handed over or not."""
    handed_over: float
    """The same of the result, which may be physics alone."""


def error(model: oa.Model, record: oa.Record, unit: np.ndarray) -> float:
    """RMS of the free run's error in `unit`; infinite where it diverges."""
    response = model.simulate(record)
    if any(trajectory.diverged for trajectory in response.trajectories):
        return math.inf
    return float(np.sqrt(np.mean((response.scores().rmse / unit) ** 2)))


def outcome(problem: FreeRunProblem, segment: int, washout: int, starts: int) -> Outcome:
    """Train from every start and look at what is handed over."""
    options = {
        "lags": problem.lags,
        "criterion": oa.Simulation(segment, washout),
        "solver": oa.LevenbergMarquardt(100),
    }
    unit = problem.train.experiments[0].outputs.std(axis=0)
    alone = oa.estimate(problem.train, problem.baseline, learner=None, **options)
    fit = oa.estimate(
        problem.train,
        problem.baseline,
        learner=problem.learner,
        restarts=starts,
        fallback=False,
        **options,
    )
    kept = fit.held_out is None or fit.held_out.ratio.code == "helps"
    ratio = error(fit.model, problem.held_out, unit) / error(alone.model, problem.held_out, unit)
    above = sum(run.loss is None or run.loss > fit.status.start_loss for run in fit.restarts)
    return Outcome(problem.name, segment, above, ratio, ratio if kept else 1.0)


def outcomes(starts: int = STARTS) -> list[Outcome]:
    """All problems under all segmentations, told as they come."""
    found = []
    print(
        "| problem | segment | starts above physics | held-out ratio of the chosen | handed over |"
    )
    print("|---|---|---|---|---|")
    for problem in problems():
        for segment, washout in SEGMENTATIONS:
            one = outcome(problem, segment, washout, starts)
            found.append(one)
            text = f"{one.above} of {starts} | {one.best:.3f} | {one.handed_over:.3f}"
            print(f"| {one.problem} | {one.segment or 'whole'} | {text} |", flush=True)
    return found


def summary(found: list[Outcome]) -> tuple[int, int, float]:
    """Starts above physics alone, results worse by more than 2 % on held-out rows, geometric mean of the ratio."""
    ratios = np.array([one.handed_over for one in found])
    return (
        sum(one.above for one in found),
        int(np.sum(ratios > 1.02)),
        float(np.exp(np.mean(np.log(ratios)))),
    )


def main() -> None:
    print(describe())
    found = outcomes(int(sys.argv[1]) if len(sys.argv) > 1 else STARTS)
    above, worse, mean = summary(found)
    print(
        f"{above} starts above physics alone; {worse} of {len(found)} results worse; geometric "
        f"mean {mean:.2f}"
    )


if __name__ == "__main__":
    main()
