"""Sect. 5.1 with 30 dB of noise: the paper's table, test RMSE and error of θ, data set 1, ten starts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug.studies.common import COLOURS, LABELS, MARKERS, STRUCTURES, legend, panels, span, trained
from orthaug.studies.entry import Finding, Reproduction
from orthaug.studies.study import Study
from orthaug.studies.synthetic import static

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

TABLE = {  # published RMSE and error; RMSE and error of the scripts; sum of squared test errors of the scripts
    "additive": (5.86e-4, 0.1952, 7.56e-4, 0.19513, 5.87e-4),
    "orthogonal": (5.35e-4, 0.0089, 7.04e-4, 0.0089019, 5.07e-4),
}
LEAST_SQUARES = 0.0089013


def one(structure: str, regularization: str, seed: int, pipeline: str) -> dict[str, Any]:
    """One start: θ and its error, test RMSE, effective weights; "stopping" is after 50 iterations."""
    example, stopped = static(1, noise=True), regularization == "stopping"
    prior, iterations = ("none", 50) if stopped else (regularization, 300)
    options = {"structure": STRUCTURES[structure], "regularization": prior, "iterations": iterations}
    fit = trained(example, "static", pipeline, seed=seed, **options)
    return {
        "theta": fit.theta,
        "theta_error": float(np.linalg.norm(fit.theta - example.theta)),
        "test_rmse": float(fit.model.simulate(example.test).scores().rmse[0]),
        "effective_weights": fit.effective_weights,
    }


def study(pipeline: str, small: bool) -> Study:
    """Structures × regularizations × starts; the gradient pipelines have no evidence."""
    kinds = ("none",) if pipeline != "ours" else ("none", "stopping", "evidence")
    seeds = range(2) if small else range(10)
    grid = {"structure": tuple(STRUCTURES), "regularization": kinds, "seed": seeds, "pipeline": (pipeline,)}
    return Study("static_noise", one, grid)


def figures(table: pd.DataFrame) -> Mapping[str, Figure]:
    """Figure "errors": test RMSE and error of θ of every start."""
    figure, axes = panels(2)
    kinds = list(dict.fromkeys(table.regularization))
    for column, (axis, quantity) in enumerate(zip(axes, ("test_rmse", "theta_error"), strict=True)):
        for i, structure in enumerate(STRUCTURES):
            for j, kind in enumerate(kinds):
                rows = table[(table.structure == structure) & (table.regularization == kind)]
                place = np.full(len(rows), j + 0.24 * (i - 0.5))
                style = {"color": COLOURS[structure], "alpha": 0.6, "label": LABELS[structure]}
                axis.plot(place, rows[quantity], MARKERS[structure], **style)
        for structure in STRUCTURES:
            published = TABLE[structure][column]
            label = f"in the paper's table, {LABELS[structure]}"
            axis.axhline(published, linestyle="--", linewidth=0.9, color=COLOURS[structure], label=label)
        axis.set_yscale("log")
        axis.set_xticks(range(len(kinds)), kinds)
        axis.set_xlabel("regularization")
        axis.set_xlim(-0.6, len(kinds) - 0.4)
    axes[0].set_ylabel("test RMSE of y")
    axes[1].set_ylabel("‖θ* − θ̂‖")
    legend(figure, axes, ncols=2)
    return {"errors": figure}


def findings(table: pd.DataFrame) -> list[Finding]:
    """The table's four numbers, with and without regularization."""
    compared = []
    for kind in dict.fromkeys(table.regularization):
        for structure in ("additive", "orthogonal"):
            rows = table[(table.structure == structure) & (table.regularization == kind)]
            rmse, error, scripts_rmse, scripts_error, _ = TABLE[structure]
            where = f"set 1, 30 dB, {structure}, regularization {kind}"
            met = bool(rows.test_rmse.mean() < 1.1 * scripts_rmse)
            texts = (f"{rmse:.3g}", f"{scripts_rmse:.3g}", span(rows.test_rmse))
            paper = bool((rows.pipeline != "ours").any())
            compared.append(Finding(f"{where}: test RMSE", *texts, met, _why_rmse(kind, structure, paper)))
            if structure == "orthogonal":
                met = bool(np.allclose(rows.theta_error, LEAST_SQUARES, rtol=0, atol=5e-8))
                iterated = bool((rows.pipeline == "scripts").any())
                why = "exact least squares for every start; the scripts end within 1.1e-5 of it"
                why = "θ is iterated here, so it ends near least squares, not at it" if iterated else why
                texts = (f"{error:.2g}", f"{scripts_error:.5g}", f"{rows.theta_error.mean():.5g}")
            else:
                met = bool(rows.theta_error.min() <= error <= rows.theta_error.max())
                why = "a lottery over starts; where it is trained farther than published, θ wanders farther"
                texts = (f"{error:.4g}", f"{scripts_error:.5g}", span(rows.theta_error))
            compared.append(Finding(f"{where}: ‖θ* − θ̂‖", *texts, met, why))
    return compared


def _why_rmse(kind: str, structure: str, paper: bool) -> str:
    if kind == "stopping":
        return "stopped after 50 iterations, before the learner follows the noise, as the scripts are"
    if kind == "evidence":
        return "evidence leaves the learner few effective weights, so it follows the noise less than without"
    ours = "the scripts' as measured" if paper else "higher, because 300 iterations follow the noise (see stopping)"
    squares = TABLE[structure][4]
    return f"published is a sum of squares, which the scripts print ({squares:.3g} run again); as RMSE ours is {ours}"


REPRODUCTION = Reproduction(
    "static_noise",
    "Static example with 30 dB of noise",
    "The paper's table: data set 1 with noise, ten initial weights, the test record without noise. The scripts print "
    "sums of squared errors over 1024 test samples, not RMSE; the table's first column agrees with those sums.",
    study,
    figures,
    findings,
)
