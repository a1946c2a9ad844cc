"""Beyond the paper: time and final loss of every solver from the same start, on both examples."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.jax import jax
from orthaug.fitting.one_step import OneStepTask
from orthaug.fitting.solvers.adam_lbfgs import AdamLBFGS
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.structures import Orthogonal
from orthaug.models.learners import MLP
from orthaug.physics.problem import pose
from orthaug.studies.common import PIPELINES, legend, panels, pick
from orthaug.studies.entry import Finding, Reproduction
from orthaug.studies.study import Study
from orthaug.studies.synthetic import mass_spring_damper, static

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

EXAMPLES = {"static": "static, set 1", "mass_spring_damper": "mass-spring-damper"}
SOLVERS = {  # label, colour, marker
    "levenberg-marquardt": ("Levenberg-Marquardt", "#0072B2", "o"),
    "adam-lbfgs": ("Adam, then L-BFGS (the paper's)", "#E69F00", "s"),
    "adam": ("Adam alone", "#CC79A7", "v"),
    "lbfgs": ("L-BFGS alone", "#009E73", "^"),
}
SCRIPTS = {"static": "2 to 3", "mass_spring_damper": "10 to 23"}  # seconds of a run, compilation included


def declared(name: str, example: str, share: float) -> Any:
    """A solver with a share of its iterations: the paper's numbers for gradient solvers, 300 for ours."""
    adam, lbfgs = PIPELINES[example]
    total = adam + lbfgs
    if name == "levenberg-marquardt":
        return LevenbergMarquardt(max(round(300 * share), 1), tolerance=0.0)
    counts = {"adam-lbfgs": (adam, lbfgs), "adam": (total, 0), "lbfgs": (0, total)}[name]
    return AdamLBFGS(*(round(count * share) for count in counts))


def one(example: str, solver: str, share: float, seed: int) -> dict[str, Any]:
    """A run's seconds and mean squared error; run once before, so that nothing is compiled in it."""
    given = static(1) if example == "static" else mass_spring_damper()
    task = OneStepTask.of(pose(given.train, given.baseline), MLP())
    assert task.bound is not None
    start, chosen = task.bound.init(jax.random.key(seed)), declared(solver, example, share)
    task.run(declared(solver, example, 0.01), start, Orthogonal())
    run = task.run(chosen, start, Orthogonal())
    return {"seconds": run.seconds, "loss": task.loss(run), "iterations": run.iterations}


def study(pipeline: str, small: bool) -> Study:
    """Examples × solvers × shares of the iterations × starts, one after the other; the same under every pipeline."""
    grid = {
        "example": ("static",) if small else tuple(EXAMPLES),
        "solver": tuple(SOLVERS)[:2] if small else tuple(SOLVERS),
        "share": (0.02,) if small else (0.03, 0.1, 0.3, 1.0),
        "seed": range(1 if small else 3),
    }
    return Study("solver_times", one, grid, workers=1)


def figures(table: pd.DataFrame) -> Mapping[str, Figure]:
    """Figure "loss": training error over seconds, a line per start."""
    examples = table.example.unique()
    figure, axes = panels(len(examples), height=3.2)
    for axis, example in zip(axes, examples, strict=True):
        for solver in table.solver.unique():
            label, colour, marker = SOLVERS[solver]
            rows = pick(table, (table.example == example) & (table.solver == solver))
            for seed in rows.seed.unique():
                run = pick(rows, rows.seed == seed)
                style = {"color": colour, "linewidth": 0.9, "markersize": 4, "alpha": 0.8, "label": label}
                axis.plot(run.seconds, np.sqrt(run.loss), f"{marker}-", **style)
        axis.set_xscale("log")
        axis.set_yscale("log" if example == "static" else "linear")
        axis.set_title(EXAMPLES[example], fontsize=9)
        axis.set_xlabel("seconds, compiled before")
    axes[0].set_ylabel("training error / standard deviation of y")
    legend(figure, axes, ncols=2)
    return {"loss": figure}


def findings(table: pd.DataFrame) -> list[Finding]:
    """Each solver at its full length, medians over starts."""
    compared = []
    full = pick(table, table.share == table.share.max())
    for example in table.example.unique():
        rows = pick(full, full.example == example).groupby("solver")[["seconds", "loss"]].median()
        best = float(np.sqrt(rows.loss["levenberg-marquardt"]))
        for solver in table.solver.unique():
            seconds, error = float(rows.seconds[solver]), float(np.sqrt(rows.loss[solver]))
            scripts = f"{SCRIPTS[example]} s, compilation included" if solver == "adam-lbfgs" else "–"
            met, why = solver == "levenberg-marquardt" or best <= 1.02 * error, "ends higher"
            if solver == "levenberg-marquardt":
                why = "the lowest loss" if best <= 1.02 * np.sqrt(rows.loss.min()) else "not the lowest loss"
            elif error < 1.02 * best:
                why = "ends as low, within 2 %" if error >= best / 1.02 else "ends lower"
            text = f"{seconds:.3g} s, relative training error {error:.3g}"
            compared.append(Finding(f"{EXAMPLES[example]}, {SOLVERS[solver][0]}", "–", scripts, text, bool(met), why))
    return compared


REPRODUCTION = Reproduction(
    "solver_times",
    "Time and loss of the solvers",
    "The same normalised problem and initial weights for every solver, the orthogonal structure, stopped at 3, 10, 30 "
    "and 100 % of its iterations: the paper's numbers for gradient solvers, 300 for Levenberg-Marquardt. Times are of "
    "this machine when the run was made, one run at a time, compiled before.",
    study,
    figures,
    findings,
)
