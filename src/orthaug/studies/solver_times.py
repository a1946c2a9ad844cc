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
from orthaug.studies import references
from orthaug.studies.common import (
    PIPELINES,
    Drawing,
    Finding,
    Reproduction,
    extremes,
    legend,
    panels,
    rows_of,
)
from orthaug.studies.study import Study
from orthaug.studies.synthetic import mass_spring_damper, static

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

EXAMPLES = {"static": "static example", "mass_spring_damper": "mass-spring-damper"}
SOLVERS = {  # label, colour, marker
    "levenberg-marquardt": ("Levenberg-Marquardt", "#0072B2", "o"),
    "adam-lbfgs": ("Adam, then L-BFGS (the paper's)", "#E69F00", "s"),
    "adam": ("Adam alone", "#CC79A7", "v"),
    "lbfgs": ("L-BFGS alone", "#009E73", "^"),
}
NOISY = 1.25  # the slowest over the fastest start, per iteration, from which a time is no result


def declare_solver(name: str, example: str, share: float) -> Any:
    """Return a solver with a share of its iterations.

    Gradient solvers have the paper's numbers, ours 300.
    """
    adam, lbfgs = PIPELINES[example]
    total = adam + lbfgs
    if name == "levenberg-marquardt":
        return LevenbergMarquardt(max(round(300 * share), 1), tolerance=0.0)
    counts = {"adam-lbfgs": (adam, lbfgs), "adam": (total, 0), "lbfgs": (0, total)}[name]
    return AdamLBFGS(*(round(count * share) for count in counts))


def one(example: str, solver: str, share: float, seed: int) -> dict[str, Any]:
    """Return a run's seconds and mean squared error.

    Run once before, so that nothing is compiled in it.
    """
    given = static(1) if example == "static" else mass_spring_damper()
    task = OneStepTask.of(pose(given.train, given.baseline), MLP())
    start, chosen = task.bound.init(jax.random.key(seed)), declare_solver(solver, example, share)
    task.run(declare_solver(solver, example, 0.01), start, Orthogonal())
    run = task.run(chosen, start, Orthogonal())
    return {"seconds": run.seconds, "loss": task.loss(run), "iterations": run.iterations}


def study(pipeline: str, small: bool) -> Study:
    """Return examples × solvers × shares of the iterations × starts, one after the other.

    The same under every pipeline.
    """
    grid = {
        "example": ("static",) if small else tuple(EXAMPLES),
        "solver": tuple(SOLVERS)[:2] if small else tuple(SOLVERS),
        "share": (0.02,) if small else (0.03, 0.1, 0.3, 1.0),
        "seed": range(1 if small else 3),
    }
    return Study("solver_times", one, grid, workers=1)


def figures(table: pd.DataFrame) -> Mapping[str, Drawing]:
    """Draw "loss": training error over seconds."""
    examples = table.example.unique()
    figure, axes = panels(len(examples), height=3.6)
    for axis, example in zip(axes, examples, strict=True):
        for solver in table.solver.unique():
            rows = rows_of(table, example=example, solver=solver)
            _line(axis, rows.assign(error=np.sqrt(rows.loss)), *SOLVERS[solver])
        axis.set_xscale("log")
        # a factor of a hundredth and one of a millionth need other axes
        axis.set_yscale("log" if example == "static" else "linear")
        axis.set_title(EXAMPLES[example], fontsize=9)
        axis.set_xlabel("seconds, compiled before")
    axes[0].set_ylabel("training error / std of y")
    legend(figure, axes, ncols=2)
    return {
        "loss": Drawing(
            figure,
            "Training error of each solver against its seconds, when stopped at a share of its "
            f"iterations: {' and '.join(EXAMPLES[example] for example in examples)}.",
            f"Marks are medians over {table.seed.nunique()} initial weights; bars go from the "
            "smallest to the largest, sideways for seconds. The axis of errors is logarithmic "
            "for the static example and linear for the mass-spring-damper, whose errors lie "
            "close together. Times that the table marks as noisy are no results.",
        )
    }


def _line(axis: Axes, rows: pd.DataFrame, label: str, colour: str, marker: str) -> None:
    seconds, error = (extremes(rows, "share", column) for column in ("seconds", "error"))
    sideways, upwards = (
        np.stack([of["median"] - of["min"], of["max"] - of["median"]]) for of in (seconds, error)
    )
    style = {
        "color": colour,
        "marker": marker,
        "linewidth": 1.0,
        "elinewidth": 0.7,
        "markersize": 4,
        "label": label,
    }
    axis.errorbar(seconds["median"], error["median"], xerr=sideways, yerr=upwards, **style)


def findings(table: pd.DataFrame) -> list[Finding]:
    """Return each solver at its full length, medians over starts.

    A time that differs from start to start is marked.
    """
    compared = []
    full = rows_of(table, share=table.share.max())
    full = full.assign(error=np.sqrt(full.loss), each=full.seconds / full.iterations)
    for example in table.example.unique():
        rows = rows_of(full, example=example)
        best = float(rows_of(rows, solver="levenberg-marquardt").error.median())
        shortest, longest = references.seconds(example)
        for solver in table.solver.unique():
            own = rows_of(rows, solver=solver)
            error, ratio = float(own.error.median()), float(own.each.max() / own.each.min())
            text = f"{own.seconds.median():.3g} s, relative training error {error:.3g}"
            why = f"{error / best:.4g} times the error of Levenberg-Marquardt"
            if solver == "levenberg-marquardt":
                least = float(rows.groupby("solver").error.median().min())
                why = (
                    "the smallest error"
                    if best == least
                    else f"{best / least:.4g} times the smallest error"
                )
            if ratio > NOISY:
                text += " (time noisy)"
                why += (
                    f"; no result in time: an iteration takes up to {ratio:.2g} times as long "
                    "from start to start"
                )
            scripts = (
                f"{shortest:.2g} to {longest:.2g} s, compilation included"
                if solver == "adam-lbfgs"
                else ""
            )
            compared.append(
                Finding(f"{EXAMPLES[example]}, {SOLVERS[solver][0]}", text, why, scripts=scripts)
            )
    return compared


REPRODUCTION = Reproduction(
    "solver_times",
    "Time and loss of the solvers",
    "Every solver has the same normalised problem, the same initial weights and the orthogonal "
    "structure. It is stopped at 3, 10, 30 and 100 % of its iterations. Gradient solvers have "
    "the paper's number of iterations, Levenberg-Marquardt 300. Times are of this machine when "
    "the run was made, one run at a time, compiled before.",
    study,
    figures,
    findings,
)
