"""Sect. 5.1 without noise: errors of θ and of the test output, both structures, three data sets, ten starts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug.fitting.estimation import estimate
from orthaug.inference.measures import Uniform
from orthaug.studies import references
from orthaug.studies.common import (
    COLOURS,
    LABELS,
    MARKERS,
    STRUCTURES,
    agreement,
    legend,
    panels,
    pick,
    scripts_bars,
    solver,
    span,
)
from orthaug.studies.entry import Drawing, Finding, Reproduction
from orthaug.studies.study import Study
from orthaug.studies.synthetic import static

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

UNIFORM = Uniform({"u[k]": (-0.6, 0.6)})
FLOOR = 1e-9  # errors below are rounding: drawn here, so that they do not stretch the axis
NUMERICAL = 1e-6  # what "near numerical tolerance" is taken to mean
GRID = np.linspace(-1.0, 1.0, 81)  # inputs at which the learner is drawn


def one(data_set: int, structure: str, seed: int, pipeline: str) -> dict[str, Any]:
    """One start: θ, its error, the test RMSE; θ under the uniform measure; the learner on a grid of inputs."""
    example = static(data_set)
    options = {"structure": STRUCTURES[structure], "solver": solver(pipeline, "static"), "seed": seed}
    fit = estimate(example.train, example.baseline, **options)
    uniform = fit.split(UNIFORM)
    x = GRID[:, None]
    physics = np.stack([GRID, GRID**3], axis=-1)
    learner = fit.model.learner_at(x)[:, 0] - physics @ fit.model.theta_aux
    return {
        "theta": fit.theta,
        "theta_error": float(np.linalg.norm(fit.theta - example.theta)),
        "theta_uniform": uniform.theta,
        "uniform_error": float(np.linalg.norm(uniform.theta - example.theta)),
        "test_rmse": float(fit.model.simulate(example.test).scores().rmse[0]),
        "learner": learner,
    }


def study(pipeline: str, small: bool) -> Study:
    """Data sets × structures × starts."""
    seeds = range(2) if small else range(10)
    grid = {"data_set": (1, 2, 3), "structure": tuple(STRUCTURES), "seed": tuple(seeds), "pipeline": (pipeline,)}
    return Study("static_errors", one, grid)


def figures(table: pd.DataFrame) -> Mapping[str, Drawing]:
    """Figures "sigma0_errors", the estimated θ and the learner's outputs."""
    starts = table.seed.nunique()
    return {
        "sigma0_errors": Drawing(
            _errors(table),
            f"Test error (left) and error of θ (right) of {starts} initial weights on each data set, additive and "
            "orthogonal structure beside what the scripts gave.",
            "Filled marks are single starts; a cross with a bar is the mean of the scripts, from their smallest to "
            "their largest run. Errors of θ below 10⁻⁹ are rounding, and drawn in the grey band at 10⁻⁹.",
        ),
        "theta": Drawing(
            _theta(table),
            f"The estimated θ of {starts} initial weights on each data set, with the true θ where the dashed lines "
            "cross.",
            "All panels have the same scale, which is finer for θ₃ than for θ₁. The starts of the orthogonal structure "
            "lie on each other.",
        ),
        "learner": Drawing(
            _learner(table),
            f"The learner's part of the output on data set 1 for {starts} initial weights, beside what the physics "
            "lacks (dashed).",
            "Of the orthogonal structure (left) it is what remains after projection. Both panels have the same scale.",
        ),
    }


def _errors(table: pd.DataFrame) -> Figure:
    figure, axes = panels(2, height=3.6)
    columns = (("test_rmse", "test RMSE of y"), ("theta_error", "‖θ* − θ̂‖"))
    for axis, (column, label) in zip(axes, columns, strict=True):
        for i, structure in enumerate(("additive", "orthogonal")):
            rows = table[table.structure == structure]
            place = rows.data_set - 0.3 + 0.32 * i
            style = {"color": COLOURS[structure], "alpha": 0.6, "markersize": 4.5, "label": LABELS[structure]}
            axis.plot(place, np.maximum(rows[column], FLOOR), MARKERS[structure], **style)
            spreads = [references.static(data_set, structure, column) for data_set in (1, 2, 3)]
            scripts_bars(axis, np.arange(1, 4) - 0.18 + 0.32 * i, spreads, structure)
        if column == "theta_error":
            rows = table[table.structure == "orthogonal"]
            style = {"color": COLOURS["uniform"], "alpha": 0.6, "markersize": 4.5, "label": LABELS["uniform"]}
            axis.plot(rows.data_set + 0.32, np.maximum(rows.uniform_error, FLOOR), MARKERS["uniform"], **style)
            if table.theta_error.min() <= FLOOR:
                axis.axhspan(FLOOR / 4, FLOOR * 4, color="#B8B8B8", alpha=0.4, linewidth=0)
                axis.text(3.45, FLOOR, "rounding", fontsize=8, ha="right", va="center")
        axis.set_yscale("log")
        axis.set_xticks((1, 2, 3))
        axis.set_xlim(0.5, 3.5)
        axis.grid(visible=False, axis="x")
        axis.set_xlabel("data set")
        axis.set_ylabel(label)
    legend(figure, axes[1], ncols=3)
    return figure


def _theta(table: pd.DataFrame) -> Figure:
    figure, axes = panels(3, sharex=True, sharey=True, height=3.2)
    for axis, (data_set, rows) in zip(axes, table.groupby("data_set"), strict=True):
        for place, truth in ((axis.axvline, 1.0), (axis.axhline, 0.1)):
            place(truth, linestyle="--", linewidth=0.8, color=COLOURS["truth"], label="true θ")
        for structure in ("additive", "orthogonal"):
            theta = np.array(rows[rows.structure == structure].theta.tolist())
            style = {"color": COLOURS[structure], "alpha": 0.7, "markersize": 5, "label": LABELS[structure]}
            axis.plot(*theta.T, MARKERS[structure], **style)
        uniform = np.array(rows[rows.structure == "orthogonal"].theta_uniform.tolist())
        axis.plot(*uniform.T, MARKERS["uniform"], color=COLOURS["uniform"], markersize=4, label=LABELS["uniform"])
        axis.set_title(f"data set {data_set}", fontsize=9)
        axis.set_xlabel("θ₁")
    axes[0].set_ylabel("θ₃")
    legend(figure, axes[0])
    return figure


def _learner(table: pd.DataFrame) -> Figure:
    figure, axes = panels(2, sharey=True)
    for axis, structure in zip(axes, ("orthogonal", "additive"), strict=True):
        rows = table[(table.data_set == 1) & (table.structure == structure)]
        style = {"color": COLOURS[structure], "alpha": 0.6, "linewidth": 1.0}
        for values in rows.learner:
            axis.plot(GRID, values, label=f"{LABELS[structure]}, each start", **style)
        axis.plot(GRID, 0.01 - 0.5 * GRID**2, "--", color=COLOURS["truth"], label="what the physics lacks")
        axis.set_xlabel("u")
        axis.set_xticks((-1.0, -0.5, 0.0, 0.5, 1.0))
        axis.set_title(LABELS[structure], fontsize=9)
    axes[0].set_ylabel("learner's part of y")
    legend(figure, axes)
    return figure


def findings(table: pd.DataFrame) -> list[Finding]:
    """Both errors of every data set and structure beside the scripts', and what the paper says about them."""
    compared = []
    for data_set in (1, 2, 3):
        for structure in ("orthogonal", "additive"):
            rows = pick(table, (table.data_set == data_set) & (table.structure == structure))
            where = f"set {data_set}, no noise, {structure}"
            scripts = references.static(data_set, structure, "test_rmse")
            met, why = scripts.beside(rows.test_rmse, smaller_is_better=True)
            quantity = f"{where}: test RMSE"
            compared.append(
                Finding(quantity, span(rows.test_rmse), why, scripts=str(scripts), as_scripts=met),
            )
            compared.append(_theta_finding(table, data_set, structure))
    for data_set in (2, 3):
        rows = table[(table.data_set == data_set) & (table.structure == "orthogonal")]
        ratio = float(rows.uniform_error.max() / rows.theta_error.mean())
        why = f"the largest is {ratio:.1g} times the error of the same fits under the training measure"
        quantity = f"set {data_set}, no noise, uniform measure: ‖θ* − θ̂‖"
        compared.append(Finding(quantity, span(rows.uniform_error), why))
    return compared


def _theta_finding(table: pd.DataFrame, data_set: int, structure: str) -> Finding:
    of_set = table[table.data_set == data_set]
    errors = of_set[of_set.structure == structure].theta_error
    scripts = references.static(data_set, structure, "theta_error")
    # of the orthogonal structure on set 1 the true value is 0, so that less is better
    met, beside = scripts.beside(errors, smaller_is_better=(structure, data_set) == ("orthogonal", 1))
    if structure == "additive":
        other = float(of_set[of_set.structure == "orthogonal"].theta_error.mean())
        published, as_published = "on average larger than of the orthogonal one", bool(errors.mean() > other)
        why = f"differs by up to {errors.max() - errors.min():.3g} from start to start"
    elif data_set == 1:
        published, as_published = "zero within numerical error", bool(errors.max() <= NUMERICAL)
        why = f"the largest is {errors.max():.1g}"
    else:
        theta = np.array(of_set[of_set.structure == structure].theta.tolist())
        published = "the same for every start, but not zero"
        as_published = bool(np.ptp(theta, axis=0).max() <= NUMERICAL < errors.min())
        why = agreement(theta)
    quantity = f"set {data_set}, no noise, {structure}: ‖θ* − θ̂‖"
    return Finding(quantity, span(errors), f"{why}; {beside}", published, str(scripts), as_published, met)


REPRODUCTION = Reproduction(
    "static_errors",
    "Static example without noise",
    "Ten initial weights on each of the three data sets: 1 symmetric, 2 drawn at random, 3 drawn about a mean of "
    "−0.01. The fits of the orthogonal structure are also split under the uniform measure on [−0.6, 0.6].",
    study,
    figures,
    findings,
)
