"""Sect. 5.1: the asymptotic covariance matrix of θ and the learner's weights, zeros in black (thm:zero_cov)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug.studies.common import panels, trained
from orthaug.studies.entry import Finding, Reproduction
from orthaug.studies.study import Study
from orthaug.studies.synthetic import static

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

ZERO = 1e-6  # in absolute value: what the paper's figure shows in black


def one(seed: int, pipeline: str) -> dict[str, Any]:
    """P̂ of eq:cov_approx for one start, as it stands and as correlations; θ's standard errors in both conventions."""
    fit = trained(static(1, noise=True), "static", pipeline, seed=seed)
    matrix = fit.joint_covariance("paper") * len(fit.problem.rows)
    nt, deviation = len(fit.theta), np.sqrt(np.maximum(np.diag(matrix), 0.0))
    product = np.outer(deviation, deviation)  # 0 for a weight that the data do not see
    correlation = np.abs(matrix) / np.where(product > 0, product, np.inf)
    return {
        "covariance": np.abs(matrix),
        "correlation": correlation,
        "largest_across": np.abs(matrix[:nt, nt:]).max(),
        "largest_correlation_across": correlation[:nt, nt:].max(),
        "zeros_across": float(np.mean(np.abs(matrix[:nt, nt:]) < ZERO)),
        "std": np.sqrt(np.diag(fit.joint_covariance("calibrated"))[:nt]),
        "std_paper": deviation[:nt] / np.sqrt(len(fit.problem.rows)),
    }


def study(pipeline: str, small: bool) -> Study:
    """Starts."""
    return Study("covariance", one, {"seed": range(1 if small else 10), "pipeline": (pipeline,)})


def figures(table: pd.DataFrame) -> Mapping[str, Figure]:
    """Figure "covariance": entries of the first start, absolute and as correlations."""
    figure, axes = panels(2, height=3.6)
    row = table.iloc[0]
    titles = {"covariance": "|P̂|, black below 10⁻⁶", "correlation": "|correlation|, black below 10⁻⁶"}
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
        axis.set_xlabel("entry: θ₁, θ₃, then the weights")
        figure.colorbar(image, ax=axis, shrink=0.8, label="log₁₀")
    return {"covariance": figure}


def findings(table: pd.DataFrame) -> list[Finding]:
    """Zero blocks, and the factor 2."""
    correlation, largest = table.largest_correlation_across.max(), table.largest_across.median()
    share = 100 * table.zeros_across.mean()
    across = "P̂ between θ and the weights"
    why = (
        "block-diagonal as published; what is left is rounding against the weights' own block, which is singular "
        "because the weights are over-parametrised"
    )
    ratio = np.array([np.array(p) / np.array(c) for p, c in zip(table.std_paper, table["std"], strict=True)])
    factor = "√2: the factor 2 of eq:cov_approx cancels in its source (Ljung 1999); the rest is degrees of freedom"
    return [
        Finding(f"{across}: largest correlation", "0", "–", f"{correlation:.1e}", bool(correlation < ZERO), why),
        Finding(
            f"{across}: share below 10⁻⁶ in absolute value",
            "all",
            "–",
            f"{share:.0f} % (largest entry, median over starts: {largest:.1e})",
            bool(share == 100),
            why,
        ),
        Finding(
            "standard error of θ, the paper's over the calibrated one",
            "–",
            "–",
            f"{ratio.mean():.4f}",
            bool(abs(ratio.mean() / np.sqrt(2) - 1) < 0.02),
            factor,
        ),
    ]


REPRODUCTION = Reproduction(
    "covariance",
    "The asymptotic covariance matrix",
    "eq:cov_approx of the orthogonal structure on data set 1 with 30 dB of noise, for 2 + 49 parameters. The first two "
    "rows and columns are θ: zero outside their own block.",
    study,
    figures,
    findings,
)
