"""Sect. 5.1: asymptotic covariance matrix of θ and the weights, zeros black (thm:zero_cov)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug.inference.covariance import joint_covariance
from orthaug.studies.common import Drawing, Finding, Reproduction, panels, train
from orthaug.studies.study import Study
from orthaug.studies.synthetic import static

if TYPE_CHECKING:
    import pandas as pd

ZERO = 1e-6  # what is shown in black; in the paper in absolute value


def one(seed: int, pipeline: str) -> dict[str, Any]:
    """Return P̂ of eq:cov_approx for one start, unchanged and as correlations.

    Θ's standard errors in both conventions.

    "pseudo" is P̂ with the pseudo-inverse of the weights' block, which is singular to rounding.
    """
    fit = train(static(1, noise=True), "static", pipeline, seed=seed)
    matrix = fit.joint_covariance("paper") * len(fit.problem.rows)
    pseudo = np.abs(joint_covariance(fit.problem, fit.model, "paper", own_units=True)) * len(
        fit.problem.rows
    )
    nt, deviation = len(fit.theta), np.sqrt(np.maximum(np.diag(matrix), 0.0))
    product = np.outer(deviation, deviation)  # 0 for a weight that the data do not see
    correlation = np.abs(matrix) / np.where(product > 0, product, np.inf)
    return {
        "covariance": np.abs(matrix),
        "correlation": correlation,
        "largest_across": np.abs(matrix[:nt, nt:]).max(),
        "largest_correlation_across": correlation[:nt, nt:].max(),
        "zeros_across": float(np.mean(np.abs(matrix[:nt, nt:]) < ZERO)),
        "pseudo": pseudo,
        "std": np.sqrt(np.diag(fit.joint_covariance("calibrated"))[:nt]),
        "std_paper": deviation[:nt] / np.sqrt(len(fit.problem.rows)),
    }


def study(pipeline: str, small: bool) -> Study:
    """Return the study over starts."""
    return Study("covariance", one, {"seed": range(1 if small else 10), "pipeline": (pipeline,)})


def figures(table: pd.DataFrame) -> Mapping[str, Drawing]:
    """Return the figure "covariance": entries of the first start.

    They are drawn as correlations and, as in the paper, in absolute value.
    """
    figure, axes = panels(2, height=3.3)
    row = table.iloc[0]
    titles = {"correlation": "entries over √(Pᵢᵢ Pⱼⱼ)", "pseudo": "entries in absolute value"}
    for axis, (column, title) in zip(axes, titles.items(), strict=True):
        values = np.array(row[column], dtype=float)
        shown = np.log10(np.where(values < ZERO, np.nan, values))
        axis.set_facecolor("black")
        axis.grid(visible=False)
        edges = np.arange(len(values) + 1) + 0.5
        image = axis.pcolormesh(edges, edges, shown, cmap="viridis", rasterized=True)
        axis.invert_yaxis()
        axis.set_aspect("equal")
        axis.set_title(title, fontsize=9)
        axis.set_xlabel("entry: θ₁, θ₃, then the weights", fontsize=9)
        figure.colorbar(image, ax=axis, shrink=0.7, label="log₁₀").ax.tick_params(labelsize=8)
    return {
        "covariance": Drawing(
            figure,
            "The asymptotic covariance matrix of θ and the weights for the first initial "
            "weights, each entry over the geometric mean of its two diagonal entries (left) "
            "and in absolute value as in the paper (right).",
            "Entries below 10⁻⁶ are black. The first two rows and columns are θ. On the right "
            "the weights' block is inverted by a pseudo-inverse, since it is singular to "
            "rounding.",
        )
    }


def findings(table: pd.DataFrame) -> list[Finding]:
    """Return the share of zeros in the blocks, and the factor 2."""
    across = []
    for deviation, matrix in zip(table["std"], table.correlation, strict=True):
        nt = len(deviation)
        across.append(np.array(matrix, dtype=float)[:nt, nt:])
    pseudo = np.array([np.array(matrix, dtype=float) for matrix in table.pseudo])
    blocks = pseudo[:, :nt, nt:]
    relative, absolute = (100 * float(np.mean(np.array(part) < ZERO)) for part in (across, blocks))
    largest = table.largest_across
    ratio = np.array(
        [np.array(p) / np.array(c) for p, c in zip(table.std_paper, table["std"], strict=True)]
    )
    share = "share of entries below 10⁻⁶"
    between = f"P̂ between θ and the weights: {share}"
    return [
        Finding(
            f"{between} of the geometric mean of their diagonal entries",
            f"{relative:.4g} %",
            f"the largest, over all {len(table)} starts, is {np.max(across):.1e} of that mean",
            "zero, by a theorem",
            as_published=bool(relative == 100),
        ),
        Finding(
            f"{between} in absolute value",
            f"{absolute:.4g} %",
            f"the largest, over all {len(table)} starts, is {blocks.max():.1e}; by the "
            "pseudo-inverse of the weights' block, whose variances reach "
            f"{_largest_variance(table.pseudo):.1e}",
            "all, in a figure",
            as_published=bool(absolute == 100),
        ),
        Finding(
            "P̂ between θ and the weights, with every direction that unit columns see: "
            f"{share} in absolute value",
            f"{100 * float(table.zeros_across.mean()):.4g} %",
            f"the variances of the weights reach {_largest_variance(table.covariance):.1e}, "
            f"which rounding is multiplied by: the largest entry is {largest.median():.1e} in "
            f"the median, {largest.max():.1e} at worst",
        ),
        Finding(
            "standard error of θ, the paper's convention over the calibrated one",
            f"{ratio.mean():.4f}",
            f"{ratio.mean() / np.sqrt(2):.4f} times √2, the root of the factor 2 in eq:cov_approx",
        ),
    ]


def _largest_variance(matrices: pd.Series) -> float:
    return max(float(np.max(np.diagonal(np.array(matrix, dtype=float)))) for matrix in matrices)


REPRODUCTION = Reproduction(
    "covariance",
    "The asymptotic covariance matrix",
    "eq:cov_approx of the orthogonal structure on data set 1 with 30 dB of noise, for 2 + 49 "
    "parameters. The first two rows and columns are θ.",
    study,
    figures,
    findings,
)
