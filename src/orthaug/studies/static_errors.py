"""Sect. 5.1 without noise: errors of θ and of the test output.

Both structures are compared on three data sets, with ten starts.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug.fitting.structures import Additive, Structure
from orthaug.inference.measures import Uniform
from orthaug.studies import common, references
from orthaug.studies.common import (
    COLOURS,
    LABELS,
    MARKERS,
    Drawing,
    Finding,
    Reproduction,
    agreement,
    legend,
    panels,
    rows_of,
    scripts_bars,
    span,
    train,
)
from orthaug.studies.study import Study
from orthaug.studies.synthetic import static

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

STRUCTURES: dict[str, Structure] = {
    **common.STRUCTURES,
    "additive-initial": Additive(from_initial=True),
}
UNIFORM = Uniform({"u[k]": (-0.6, 0.6)})
FLOOR = 1e-9  # errors below are rounding: drawn here, so that they do not stretch the axis
NUMERICAL = 1e-6  # what "near numerical tolerance" is taken to mean
GRID = np.linspace(-1.0, 1.0, 81)  # inputs at which the learner is drawn


def one(data_set: int, structure: str, seed: int, pipeline: str) -> dict[str, Any]:
    """Return one start: θ, its error, the test RMSE.

    θ under the uniform measure and the learner on a grid of inputs are added.
    """
    example = static(data_set)
    fit = train(example, "static", pipeline, structure=STRUCTURES[structure], seed=seed)
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
    """Return data sets × structures × starts.

    The gradient pipelines train θ of the additive structure from θ⁰ anyway.
    """
    seeds = range(2) if small else range(10)
    structures = tuple(STRUCTURES if pipeline == "ours" else common.STRUCTURES)
    grid = {
        "data_set": (1, 2, 3),
        "structure": structures,
        "seed": tuple(seeds),
        "pipeline": (pipeline,),
    }
    return Study("static_errors", one, grid)


def figures(table: pd.DataFrame) -> Mapping[str, Drawing]:
    """Draw "sigma0_errors", the estimated θ and the learner's outputs."""
    starts = table.seed.nunique()
    return {
        "sigma0_errors": Drawing(
            _errors(table),
            f"Test error (left) and error of θ (right) of {starts} initial weights on each "
            "data set, for both structures, with the results of the scripts.",
            "Filled marks are single starts; a cross with a bar is the mean of the scripts, "
            "from their smallest to their largest run. The scripts train the additive "
            "structure from θ⁰, never with θ eliminated. Errors of θ below 10⁻⁹ are rounding, "
            "and drawn in the grey band at 10⁻⁹.",
        ),
        "theta": Drawing(
            _theta(table),
            f"The estimated θ of {starts} initial weights on each data set, with the true θ "
            "where the dashed lines cross, and θ⁰ as a small cross.",
            "All panels have the same scale, which is finer for θ₃ than for θ₁. The starts of "
            "the orthogonal structure coincide.",
        ),
        "learner": Drawing(
            _learner(table),
            f"The learner's part of the output on data set 1 for {starts} initial weights, "
            "beside what the physics lacks (dashed).",
            "Of the orthogonal structure (left) it is what remains after projection. All "
            "panels have the same scale.",
        ),
    }


def _shown_structures(table: pd.DataFrame) -> list[str]:
    """Return the structures of the table, in the order in which they are drawn."""
    return [
        name
        for name in ("additive", "additive-initial", "orthogonal")
        if (table.structure == name).any()
    ]


def _has_both(table: pd.DataFrame) -> bool:
    return "additive-initial" in _shown_structures(table)


def _label(structure: str, table: pd.DataFrame) -> str:
    """Return the label of a structure; the additive one is qualified where there are both."""
    return (
        "additive, θ eliminated"
        if structure == "additive" and _has_both(table)
        else LABELS[structure]
    )


def _of_scripts(structure: str, table: pd.DataFrame) -> str | None:
    """Return the scripts' name of a structure.

    Their additive structure is the one from θ⁰; with θ eliminated they have none.
    """
    if structure == "orthogonal":
        return structure
    return None if structure == "additive" and _has_both(table) else "additive"


def _errors(table: pd.DataFrame) -> Figure:
    figure, axes = panels(2, height=3.8)
    sets = np.arange(1, 4)
    columns = (("test_rmse", "test RMSE of y"), ("theta_error", "‖θ* − θ̂‖"))
    for axis, (column, label) in zip(axes, columns, strict=True):
        kinds = [
            (structure, _of_scripts(structure, table)) for structure in _shown_structures(table)
        ]
        places = iter(np.linspace(-0.36, 0.36, 1 + sum(1 + (of is not None) for _, of in kinds)))
        for structure, of in kinds:
            rows = rows_of(table, structure=structure)
            style = {
                "color": COLOURS[structure],
                "alpha": 0.6,
                "markersize": 4.5,
                "label": _label(structure, table),
            }
            axis.plot(
                rows.data_set + next(places),
                np.maximum(rows[column], FLOOR),
                MARKERS[structure],
                **style,
            )
            if of is not None:
                spreads = [references.static(data_set, of, column) for data_set in (1, 2, 3)]
                scripts_bars(axis, sets + next(places), spreads, structure)
        if column == "theta_error":
            rows = rows_of(table, structure="orthogonal")
            style = {
                "color": COLOURS["uniform"],
                "alpha": 0.6,
                "markersize": 4.5,
                "label": LABELS["uniform"],
            }
            axis.plot(
                rows.data_set + next(places),
                np.maximum(rows.uniform_error, FLOOR),
                MARKERS["uniform"],
                **style,
            )
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
    for axis, data_set in zip(axes, (1, 2, 3), strict=True):
        rows = rows_of(table, data_set=data_set)
        for place, truth in ((axis.axvline, 1.0), (axis.axhline, 0.1)):
            place(truth, linestyle="--", linewidth=0.8, color=COLOURS["truth"], label="true θ")
        axis.plot(
            *static(data_set).baseline.initial,
            "x",
            color=COLOURS["truth"],
            label="initial θ⁰",
            zorder=5,
        )
        for structure in _shown_structures(table):
            theta = np.array(rows_of(rows, structure=structure).theta.tolist())
            style = {
                "color": COLOURS[structure],
                "alpha": 0.7,
                "markersize": 5,
                "label": _label(structure, table),
            }
            axis.plot(*theta.T, MARKERS[structure], **style)
        uniform = np.array(rows_of(rows, structure="orthogonal").theta_uniform.tolist())
        axis.plot(
            *uniform.T,
            MARKERS["uniform"],
            color=COLOURS["uniform"],
            markersize=4,
            label=LABELS["uniform"],
        )
        axis.set_title(f"data set {data_set}", fontsize=9)
        axis.set_xlabel("θ₁")
    axes[0].set_ylabel("θ₃")
    legend(figure, axes[0])
    return figure


def _learner(table: pd.DataFrame) -> Figure:
    shown = list(reversed(_shown_structures(table)))
    figure, axes = panels(len(shown), sharey=True)
    for axis, structure in zip(axes, shown, strict=True):
        rows = rows_of(table, data_set=1, structure=structure)
        style = {"color": COLOURS[structure], "alpha": 0.6, "linewidth": 1.0}
        for values in rows.learner:
            axis.plot(GRID, values, label=f"{_label(structure, table)}, each start", **style)
        axis.plot(
            GRID, 0.01 - 0.5 * GRID**2, "--", color=COLOURS["truth"], label="what the physics lacks"
        )
        axis.set_xlabel("u")
        axis.set_xticks((-1.0, -0.5, 0.0, 0.5, 1.0))
        axis.set_title(_label(structure, table), fontsize=9)
    axes[0].set_ylabel("learner's part of y")
    legend(figure, axes, ncols=2)
    return figure


def findings(table: pd.DataFrame) -> list[Finding]:
    """Return both errors of every data set and structure, with those of scripts and paper."""
    compared = []
    for data_set in (1, 2, 3):
        for structure in reversed(_shown_structures(table)):
            compared.append(_rmse_finding(table, data_set, structure))
            compared.append(_theta_finding(table, data_set, structure))
    for data_set in (2, 3):
        rows = rows_of(table, data_set=data_set, structure="orthogonal")
        ratio = float(rows.uniform_error.max() / rows.theta_error.mean())
        why = (
            f"the largest is {ratio:.1g} times the error of the same fits under the training "
            "measure"
        )
        quantity = f"set {data_set}, no noise, uniform measure: ‖θ* − θ̂‖"
        compared.append(Finding(quantity, span(rows.uniform_error), why))
    return compared


def _rmse_finding(table: pd.DataFrame, data_set: int, structure: str) -> Finding:
    of_set = rows_of(table, data_set=data_set)
    errors = rows_of(of_set, structure=structure).test_rmse
    quantity, of = (
        f"set {data_set}, no noise, {_label(structure, table)}: test RMSE",
        _of_scripts(structure, table),
    )
    if of is None:
        other = float(rows_of(of_set, structure="orthogonal").test_rmse.mean())
        return Finding(
            quantity,
            span(errors),
            f"mean {errors.mean() / other:.3g} times the orthogonal structure's",
        )
    scripts = references.static(data_set, of, "test_rmse")
    met, why = scripts.beside(errors, smaller_is_better=True)
    return Finding(quantity, span(errors), why, scripts=str(scripts), as_scripts=met)


def _theta_finding(table: pd.DataFrame, data_set: int, structure: str) -> Finding:
    of_set = rows_of(table, data_set=data_set)
    errors = rows_of(of_set, structure=structure).theta_error
    quantity, of = (
        f"set {data_set}, no noise, {_label(structure, table)}: ‖θ* − θ̂‖",
        _of_scripts(structure, table),
    )
    apart = f"differs by up to {errors.max() - errors.min():.3g} from start to start"
    if of is None:
        return Finding(quantity, span(errors), apart)
    scripts = references.static(data_set, of, "theta_error")
    # of the orthogonal structure on set 1 the true value is 0, so that less is better
    met, beside = scripts.beside(
        errors, smaller_is_better=(structure, data_set) == ("orthogonal", 1)
    )
    if structure != "orthogonal":
        other = float(rows_of(of_set, structure="orthogonal").theta_error.mean())
        published, as_published = (
            "on average larger than of the orthogonal one",
            bool(errors.mean() > other),
        )
        example = static(data_set)
        why = f"{apart}, of θ⁰ it is {np.linalg.norm(example.baseline.initial - example.theta):.3g}"
    elif data_set == 1:
        published, as_published = "zero within numerical error", bool(errors.max() <= NUMERICAL)
        why = f"the largest is {errors.max():.1g}"
    else:
        theta = np.array(rows_of(of_set, structure=structure).theta.tolist())
        published = "the same for every start, but not zero"
        as_published = bool(np.ptp(theta, axis=0).max() <= NUMERICAL < errors.min())
        why = agreement(theta)
    return Finding(
        quantity, span(errors), f"{why}; {beside}", published, str(scripts), as_published, met
    )


REPRODUCTION = Reproduction(
    "static_errors",
    "Static example without noise",
    "Ten initial weights on each of the three data sets: 1 symmetric, 2 drawn at random, 3 "
    "drawn about a mean of −0.01. Our solver trains the additive structure twice: with θ "
    "eliminated, that is solved for any weights, so that θ⁰ is never seen; and from θ⁰, θ and "
    "the weights together, which is what the scripts do and all that the other pipelines "
    "train. The fits of the orthogonal structure are also split under the uniform measure on "
    "[−0.6, 0.6].",
    study,
    figures,
    findings,
)
