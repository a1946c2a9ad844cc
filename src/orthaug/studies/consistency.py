"""Sect. 5.1, panel (c) of the last static figure: error of θ against the number of samples, 30 dB of noise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug.fitting.estimation import estimate
from orthaug.studies.common import (
    LARGEST_TRAINED,
    STRUCTURES,
    UNIFORM,
    bars,
    drawn,
    legend,
    panels,
    slope,
    span,
    trained,
)
from orthaug.studies.data_length import limit
from orthaug.studies.entry import Finding, Reproduction
from orthaug.studies.study import Study

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

SIZES = (1_000_000, 262_144, 65_536, 16_384, 4096, 1024, 256)


def one(data_set: int, samples: int, curve: str, run: int, pipeline: str) -> dict[str, Any]:
    """θ's error and, under the uniform measure, its price in standard error; each run has its record and start."""
    example = drawn(data_set, samples=samples, draw=run, noise=True)
    price = None
    if curve == "orthogonal":
        fit = estimate(example.train, example.baseline, learner=None)
    else:
        # evidence for the uniform measure, which looks at the learner; the additive structure as published
        prior = "evidence" if curve == "uniform" and pipeline == "ours" else "none"
        structure = STRUCTURES["additive" if curve == "additive" else "orthogonal"]
        options = {"structure": structure, "iterations": 100 if samples < 10_000 else 50, "regularization": prior}
        fit = trained(example, "static", pipeline, seed=run, **options)
        if curve == "uniform":
            fit = fit.split(UNIFORM)
            price = fit.measure.price if fit.measure is not None else None
    return {"theta": fit.theta, "theta_error": float(np.linalg.norm(fit.theta - example.theta)), "price": price}


def _runs(data_set: int, samples: int, curve: str, run: int, pipeline: str) -> bool:
    if curve == "additive":
        return data_set == 1 and samples <= LARGEST_TRAINED[pipeline]
    return curve == "orthogonal" or samples <= LARGEST_TRAINED[pipeline]


def study(pipeline: str, small: bool) -> Study:
    """Lengths × data sets × curves × runs; run 0 is the paper's own record."""
    grid = {
        "data_set": (1, 3),
        "samples": (1024, 256) if small else SIZES,
        "curve": ("additive", "uniform", "orthogonal"),
        "run": range(2 if small else 10),
        "pipeline": (pipeline,),
    }
    return Study("consistency", one, grid, where=_runs)


def _means(table: pd.DataFrame, data_set: int, curve: str) -> pd.DataFrame:
    rows = table[(table.data_set == data_set) & (table.curve == curve)]
    return rows.groupby("samples").theta_error.agg(["mean", "std"]).reset_index()


def figures(table: pd.DataFrame) -> Mapping[str, Figure]:
    """Figure "theta_error": sets 1 and 3, all curves; bars of two standard deviations."""
    figure, axes = panels(2, sharey=True, height=3.2)
    for axis, data_set in zip(axes, (1, 3), strict=True):
        for curve in ("additive", "orthogonal", "uniform"):
            means = _means(table, data_set, curve)
            if len(means):
                label = "orthogonal, training measure" if curve == "orthogonal" else ""
                bars(axis, means.samples, means["mean"], 2 * means["std"], curve, label=label)
        if data_set == 3:
            axis.axhline(limit(3), linestyle="--", linewidth=0.9, color="black", label="limit of set 3, N → ∞")
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_xlabel("samples N")
        axis.set_title(f"data set {data_set}, 30 dB", fontsize=9)
    axes[0].set_ylabel("‖θ* − θ̂‖")
    legend(figure, axes)
    return {"theta_error": figure}


def findings(table: pd.DataFrame) -> list[Finding]:
    """Consistent or not, and the uniform measure's price."""
    compared = []
    for data_set, curve, published, low, high, why in (
        (1, "orthogonal", "converges to 0", -0.65, -0.35, "consistent at the rate 1/√N (thm:consistency)"),
        (1, "additive", "does not converge", -0.25, 9.0, "no consistency: more data do not tell θ from the learner"),
        (3, "uniform", "–", -9.0, -0.3, "consistent where the training measure is not"),
        (1, "uniform", "–", -9.0, -0.3, "consistent too"),
    ):
        means = _means(table, data_set, curve)
        rate = slope(means.samples, means["mean"])
        quantity = f"set {data_set}, 30 dB, {curve}: exponent of ‖θ* − θ̂‖ in N"
        text = f"{rate:.2f}; {means['mean'].iloc[-1]:.2g} at N = {int(means.samples.iloc[-1])}"
        compared.append(Finding(quantity, published, "–", text, bool(low < rate < high), why))
    last = _means(table, 3, "orthogonal").iloc[-1]
    quantity = f"set 3, 30 dB, orthogonal: ‖θ* − θ̂‖ at N = {int(last.samples)}"
    text, met = f"{last['mean']:.4g}; limit {limit(3):.4g}", bool(abs(last["mean"] / limit(3) - 1) < 0.25)
    compared.append(Finding(quantity, "–", "–", text, met, "tends to the bias of set 3, not to 0"))
    own = table[(table.data_set == 1) & (table.curve == "orthogonal") & (table.run == 0) & (table.samples == 1024)]
    error = float(own.theta_error.iloc[0])
    quantity = "set 1, 30 dB, the paper's record of 1024: ‖θ* − θ̂‖"
    met = bool(abs(error - 0.0089013) < 5e-8)
    compared.append(Finding(quantity, "0.0089", "0.0089019", f"{error:.5g}", met, "least squares"))
    rows = table[(table.data_set == 1) & (table.curve == "uniform") & (table.samples == 1024)]
    prices = np.array([price for price in rows.price if price is not None], dtype=float)
    text = f"θ₁ {span(prices[:, 0])}, θ₃ {span(prices[:, 1])}"
    quantity = "set 1, N = 1024, uniform measure: standard error over the training measure's"
    met = bool((prices > 1).all())
    why = "the price: θ shares the learner's variance, and the box reaches where data are few"
    compared.append(Finding(quantity, "–", "–", text, met, why))
    return compared


REPRODUCTION = Reproduction(
    "consistency",
    "Error of θ against N, with noise",
    "Ten runs for each N, each with its own record and initial weights (run 0 has the paper's record), bars of two "
    "standard deviations. The paper varies the initial weights only, which moves the additive structure alone. θ under "
    "the training measure is least squares and needs no learner; trained curves end at N = "
    f"{LARGEST_TRAINED['ours']}, {LARGEST_TRAINED['paper']} by the paper's pipeline and {LARGEST_TRAINED['scripts']} "
    "by the scripts'. Under the uniform measure our solver trains with evidence regularization, the others with none.",
    study,
    figures,
    findings,
)
