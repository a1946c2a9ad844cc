"""Sect. 5.1 without noise: errors of θ and of the test output, both structures, three data sets, ten starts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug.fitting.structures import Additive, Structure
from orthaug.inference.measures import Uniform
from orthaug.studies import common
from orthaug.studies.common import COLOURS, LABELS, MARKERS, legend, panels, pick, span, trained
from orthaug.studies.entry import Finding, Reproduction
from orthaug.studies.study import Study
from orthaug.studies.synthetic import static

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

SCRIPTS = {  # mean test RMSE and mean ‖θ* − θ̂‖ of the published scripts
    (1, "orthogonal"): (1.47e-4, 3.8e-6),
    (1, "additive"): (2.64e-4, 0.191),
    (2, "orthogonal"): (2.05e-4, 0.07956),
    (2, "additive"): (2.94e-4, 0.198),
    (3, "orthogonal"): (2.03e-4, 0.14333),
    (3, "additive"): (2.47e-4, 0.176),
}
LOTTERY = {1: (0.052, 0.318), 2: (0.020, 0.375), 3: (0.026, 0.398)}  # range of the scripts' additive ‖θ* − θ̂‖
STRUCTURES: dict[str, Structure] = {**common.STRUCTURES, "additive-initial": Additive(from_initial=True)}
UNIFORM = Uniform({"u[k]": (-0.6, 0.6)})
GRID = np.linspace(-1.0, 1.0, 81)  # inputs at which the learner is drawn


def one(data_set: int, structure: str, seed: int, pipeline: str) -> dict[str, Any]:
    """One start: θ, its error, the test RMSE; θ under the uniform measure; the learner on a grid of inputs."""
    example = static(data_set)
    fit = trained(example, "static", pipeline, structure=STRUCTURES[structure], seed=seed)
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
    """Data sets × structures × starts; the gradient pipelines train θ of the additive structure from θ⁰ anyway."""
    seeds = range(2) if small else range(10)
    structures = tuple(STRUCTURES if pipeline == "ours" else common.STRUCTURES)
    grid = {"data_set": (1, 2, 3), "structure": structures, "seed": tuple(seeds), "pipeline": (pipeline,)}
    return Study("static_errors", one, grid)


def figures(table: pd.DataFrame) -> Mapping[str, Figure]:
    """Figures "sigma0_errors", the estimated θ and the learner's outputs."""
    return {"sigma0_errors": _errors(table), "theta": _theta(table), "learner": _learner(table)}


def _label(structure: str, table: pd.DataFrame) -> str:
    """Which additive structure it is, where there are both."""
    both = structure == "additive" and "additive-initial" in set(table.structure)
    return "additive, θ eliminated" if both else LABELS[structure]


def _errors(table: pd.DataFrame) -> Figure:
    figure, axes = panels(2)
    shown = list(dict.fromkeys(table.structure))
    columns = (("test_rmse", "test RMSE of y"), ("theta_error", "‖θ* − θ̂‖"))
    for axis, (column, label) in zip(axes, columns, strict=True):
        for i, structure in enumerate(shown):
            rows = table[table.structure == structure]
            style = {"color": COLOURS[structure], "alpha": 0.6, "label": _label(structure, table)}
            axis.plot(rows.data_set + 0.18 * (i - 1), rows[column], MARKERS[structure], **style)
        if column == "theta_error":
            rows = table[table.structure == "orthogonal"]
            style = {"color": COLOURS["uniform"], "alpha": 0.6, "label": LABELS["uniform"]}
            axis.plot(rows.data_set + 0.36, rows.uniform_error, MARKERS["uniform"], **style)
        for i, structure in enumerate(common.STRUCTURES):
            means = [SCRIPTS[data_set, structure][column == "theta_error"] for data_set in (1, 2, 3)]
            style = {"color": COLOURS[structure], "markersize": 13, "label": f"scripts' mean, {LABELS[structure]}"}
            axis.plot(np.arange(1, 4) + 0.18 * (i - 1), means, "_", **style)
        axis.set_yscale("log")
        axis.set_xticks((1, 2, 3))
        axis.set_xlim(0.5, 3.5)
        axis.set_xlabel("data set")
        axis.set_ylabel(label)
    legend(figure, axes[1], ncols=3)
    return figure


def _theta(table: pd.DataFrame) -> Figure:
    figure, axes = panels(3)
    for axis, (data_set, rows) in zip(axes, table.groupby("data_set"), strict=True):
        for structure in reversed(dict.fromkeys(rows.structure)):
            theta = np.array(rows[rows.structure == structure].theta.tolist())
            axis.plot(*theta.T, MARKERS[structure], color=COLOURS[structure], alpha=0.7, label=_label(structure, table))
        uniform = np.array(rows[rows.structure == "orthogonal"].theta_uniform.tolist())
        axis.plot(*uniform.T, MARKERS["uniform"], color=COLOURS["uniform"], markersize=4, label=LABELS["uniform"])
        axis.plot(1.0, 0.1, "+", color=COLOURS["truth"], markersize=16, label="truth")
        axis.set_title(f"data set {data_set}", fontsize=9)
        axis.set_xlabel("θ₁")
    axes[0].set_ylabel("θ₃")
    legend(figure, axes[0])
    return figure


def _learner(table: pd.DataFrame) -> Figure:
    shown = list(dict.fromkeys(table.structure))
    figure, axes = panels(len(shown))
    for axis, structure in zip(axes, shown, strict=True):
        rows = table[(table.data_set == 1) & (table.structure == structure)]
        for values in rows.learner:
            axis.plot(
                GRID,
                values,
                color=COLOURS[structure],
                alpha=0.6,
                linewidth=1.0,
                label=f"{_label(structure, table)}, each start",
            )
        axis.plot(GRID, 0.01 - 0.5 * GRID**2, "--", color=COLOURS["truth"], label="what the physics lacks")
        axis.set_xlabel("u")
        axis.set_title(_label(structure, table), fontsize=9)
        axis.sharey(axes[-1])
    axes[0].set_ylabel("learner's part of y")
    legend(figure, axes)
    return figure


def findings(table: pd.DataFrame) -> list[Finding]:
    """Every mean of the reference beside ours."""
    compared = []
    from_initial = {(data_set, "additive-initial"): SCRIPTS[data_set, "additive"] for data_set in (1, 2, 3)}
    for (data_set, structure), (rmse, error) in (SCRIPTS | from_initial).items():
        rows = pick(table, (table.data_set == data_set) & (table.structure == structure))
        if not len(rows):
            continue
        where = f"set {data_set}, no noise, {_label(structure, table)}"
        better = bool(rows.test_rmse.mean() <= rmse)
        why = "better: trained to the end" if better else "not reached"
        compared.append(Finding(f"{where}: test RMSE", "–", f"{rmse:.3g}", span(rows.test_rmse), better, why))
        met = _same_error(structure, data_set, rows, error)
        why = _why(structure, data_set) if met else "a number of other starts or another record"
        compared.append(
            Finding(
                f"{where}: ‖θ* − θ̂‖", _published(structure, data_set), f"{error:.4g}", span(rows.theta_error), met, why
            )
        )
    for data_set in (2, 3):
        rows = table[(table.data_set == data_set) & (table.structure == "orthogonal")]
        met = bool(rows.uniform_error.max() <= 0.01 * rows.theta_error.min())
        text = span(rows.uniform_error)
        compared.append(
            Finding(
                f"set {data_set}, uniform measure: ‖θ* − θ̂‖",
                "–",
                "–",
                text,
                met,
                "the measure, not the fit, is what biases θ",
            )
        )
    return compared


def _same_error(structure: str, data_set: int, rows: pd.DataFrame, scripts: float) -> bool:
    if structure != "orthogonal":  # a lottery: the ranges over starts overlap
        low, high = LOTTERY[data_set]
        return bool(rows.theta_error.min() <= high and rows.theta_error.max() >= low)
    if data_set == 1:
        return bool(rows.theta_error.max() <= 1e-5)
    return bool(np.allclose(rows.theta_error, scripts, rtol=2e-4))


def _published(structure: str, data_set: int) -> str:
    return "near numerical tolerance" if (structure, data_set) == ("orthogonal", 1) else "–"


def _why(structure: str, data_set: int) -> str:
    if structure != "orthogonal":
        return "the same lottery over starts: the scripts' range and ours overlap"
    return "exact: θ is solved, not iterated" if data_set == 1 else "the same number for every start"


REPRODUCTION = Reproduction(
    "static_errors",
    "Static example without noise",
    "Ten initial weights on each of the three data sets. All structures predict alike; θ of the additive one depends "
    "on the initial weights. Our solver trains it twice: with θ eliminated, that is solved for any weights, so that it "
    "never sees θ⁰; and from θ⁰, θ and weights together, as everybody does: then θ stays about as far from the truth "
    "as θ⁰ is (0.212). The other pipelines train it from θ⁰ only. θ of the orthogonal one depends on no start, and on "
    "sets 2 and 3 it errs by what the measure leaves correlated: split under the uniform measure on [−0.6, 0.6], the "
    "same fits err by a thousandth of that.",
    study,
    figures,
    findings,
)
