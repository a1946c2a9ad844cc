"""60 random motions with a learner: is any worse than its physics alone, and does the choice between them do well?

Springs with friction, some with a hardening spring, noise of any size and colour; three kinds of regularization,
learners of v or of (x, v). Every fit has to end at or below the training loss of physics alone, and what is returned
must not be worse on the held-out blocks. Free runs of 400 new rows tell whether learner or physics alone was the
right choice, for the rule of the fits (the learner is surely better on the blocks) and for a milder one (it is better
there by 2 %).
Run: python benchmarks/motion_problems.py [problems, default 60]
"""

from __future__ import annotations

import sys
from functools import cache
from typing import NamedTuple

import numpy as np
from machine import describe
from missing_terms import Case, motion, record

import orthaug as oa
from orthaug.fitting.held_out import WORTH, mean_square

PROBLEMS = 60
BLOCKS = 4
_ROUNDING = 1e-12


class Problem(NamedTuple):
    """What a problem came to."""

    above: bool
    """Whether the learner ended above the training loss of physics alone."""
    worse: bool
    """Whether what the rule returns is worse than physics alone on the held-out blocks."""
    surely: bool
    better: bool
    """Whether the learner is kept by the rule of the fits, and by the milder one."""
    ratio: float
    """Of the learner's error to that of physics alone, over the new rows."""


@cache
def problem(seed: int) -> Problem:
    random = np.random.default_rng([seed, 11])
    case = Case(
        "random",
        friction=float(random.uniform(0, 1) * (random.random() < 0.7)),
        cube=float(random.uniform(0, 40) * (random.random() < 0.5)),
        colour=float(random.uniform(0, 0.9) * (random.random() < 0.5)),
        noise=float(10 ** random.uniform(-3, -0.5)),
    )
    sees = [("v",), ("x", "v")][seed % 2]
    options = {
        "learner": oa.MLP((3,), inputs=sees),
        "criterion": oa.Simulation(0, 0),
        "solver": oa.LevenbergMarquardt(60),
        "regularization": ["none", "evidence", 1e-3][seed % 3],
        "seed": seed,
    }
    train = record(case, seed)
    returned = oa.estimate(train, motion(True), blocks=BLOCKS, **options)
    kept = returned.learns
    fit = (
        returned if kept else oa.estimate(train, motion(True), blocks=0, fallback=False, **options)
    )
    alone = oa.estimate(train, motion(False), learner=None, criterion=oa.Simulation(0, 0))
    held = returned.held_out
    assert held is not None
    squares = [mean_square(held.runs[held.chosen]), mean_square(held.alone)]
    new = record(case._replace(noise=0.0), seed + 10_000)
    errors = [
        float(np.sqrt(np.mean(one.model.simulate(new).scores().rmse ** 2))) for one in (fit, alone)
    ]
    start = fit.status.start_loss
    return Problem(
        above=start is None or not fit.status.loss <= start * (1 + _ROUNDING),
        worse=kept and not squares[0] <= squares[1],
        surely=kept,
        better=bool(held.ratio.value < 1 - WORTH),
        ratio=errors[0] / errors[1] if np.isfinite(errors[0]) else np.inf,
    )


def worse(problems: int = PROBLEMS) -> list[int]:
    """Of the problems: learners above physics alone, and returned starts worse than it on the blocks."""
    found = [problem(seed) for seed in range(problems)]
    return [sum(one.above for one in found), sum(one.worse for one in found)]


def table(problems: int = PROBLEMS) -> list[list[float]]:
    """Of each rule: learners kept, of them worse on new rows, dropped but better there, and the mean ratio."""
    found, rows = [problem(seed) for seed in range(problems)], []
    for rule in ("surely", "better"):
        kept = [one.ratio for one in found if getattr(one, rule)]
        left = [one.ratio for one in found if not getattr(one, rule)]
        mean = float(np.exp(np.log(kept).sum() / len(found)))  # physics alone counts 1
        rows.append([len(kept), sum(r > 1 for r in kept), sum(r < 1 - WORTH for r in left), mean])
    return rows


def main(problems: int) -> None:
    print(describe())
    above, below = worse(problems)
    print(
        f"\n{problems} problems: {above} ended above the training loss of physics alone, of "
        f"{below} the returned"
    )
    print("start is worse than physics alone on the held-out blocks.\n")
    print(
        "| rule | learner kept | kept, but worse on new rows | dropped, but better there | "
        "mean ratio |"
    )
    print(5 * "|---" + "|")
    for name, row in zip(("surely better", "better by 2 %"), table(problems), strict=True):
        print(f"| {name} | {row[0]} | {row[1]} | {row[2]} | {row[3]:.3f} |")
    for seed in range(problems):
        print(seed, problem(seed))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else PROBLEMS)
