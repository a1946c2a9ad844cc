"""Sect. 5.1, panel (b) of the last static figure: error of θ against the number of samples, without noise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug.fitting.estimation import estimate
from orthaug.studies.common import COLOURS, LARGEST_TRAINED, UNIFORM, bars, drawn, legend, panels, slope, trained
from orthaug.studies.entry import Finding, Reproduction
from orthaug.studies.study import Study

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

SIZES = (1_000_000, 262_144, 65_536, 16_384, 4096, 1024, 256)
TRAINED_DRAWS = 3  # the uniform measure needs the learner; θ under the training measure does not


def one(data_set: int, samples: int, measure: str, draw: int, pipeline: str) -> dict[str, Any]:
    """θ's error on one record: Φ⁺Y for the training measure, the split of a trained model for the uniform one."""
    example = drawn(data_set, samples=samples, draw=draw)
    if measure == "training":
        fit = estimate(example.train, example.baseline, learner=None)
    else:
        fit = trained(example, "static", pipeline, iterations=100).split(UNIFORM)
    return {"theta": fit.theta, "theta_error": float(np.linalg.norm(fit.theta - example.theta))}


def _runs(data_set: int, samples: int, measure: str, draw: int, pipeline: str) -> bool:
    return measure == "training" or (samples <= LARGEST_TRAINED[pipeline] and draw < TRAINED_DRAWS)


def study(pipeline: str, small: bool) -> Study:
    """Lengths × data sets × measures × draws of the record, the paper's own draw first."""
    grid = {
        "data_set": (2, 3),
        "samples": (1024, 256) if small else SIZES,
        "measure": ("training", "uniform"),
        "draw": range(3 if small else 10),
        "pipeline": (pipeline,),
    }
    return Study("data_length", one, grid, where=_runs)


def limit(data_set: int) -> float:
    """‖E[φφᵀ]⁻¹ E[φδ]‖ of the inputs' distribution: what ‖θ* − θ̂‖ tends to as N → ∞."""
    mean, deviation = (0.0 if data_set == 2 else -0.01), 0.3
    node, weight = np.polynomial.hermite_e.hermegauss(20)
    u = mean + deviation * node
    phi = np.stack([u, u**3], axis=1) * np.sqrt(weight)[:, None]
    delta = (0.01 - 0.5 * u**2) * np.sqrt(weight)
    return float(np.linalg.norm(np.linalg.lstsq(phi, delta, rcond=None)[0]))


def _means(table: pd.DataFrame, data_set: int, measure: str) -> pd.DataFrame:
    rows = table[(table.data_set == data_set) & (table.measure == measure)]
    return rows.groupby("samples").theta_error.agg(["mean", "std"]).reset_index()


def figures(table: pd.DataFrame) -> Mapping[str, Figure]:
    """Figure "theta_error": a panel per data set, both measures."""
    figure, axes = panels(2, sharey=True, height=3.1)
    for axis, data_set in zip(axes, (2, 3), strict=True):
        for measure, name in (("training", "orthogonal"), ("uniform", "uniform")):
            means = _means(table, data_set, measure)
            label = "orthogonal, training measure" if measure == "training" else ""
            bars(axis, means.samples, means["mean"], 2 * means["std"], name, label=label)
        own = table[(table.data_set == data_set) & (table.measure == "training") & (table.draw == 0)]
        own = own.iloc[own.samples.argsort()]
        axis.plot(
            own.samples, own.theta_error, ":", color=COLOURS["orthogonal"], linewidth=1.0, label="the paper's record"
        )
        if data_set == 3:
            axis.axhline(limit(3), linestyle="--", linewidth=0.9, color=COLOURS["truth"], label="limit, N → ∞")
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_xlabel("samples N")
        axis.set_title(f"data set {data_set}, no noise", fontsize=9)
    axes[0].set_ylabel("‖θ* − θ̂‖")
    legend(figure, axes)
    return {"theta_error": figure}


def findings(table: pd.DataFrame) -> list[Finding]:
    """The two trends, and what the uniform measure makes of them."""
    compared = []
    two, three = (_means(table, data_set, "training") for data_set in (2, 3))
    rate = slope(two.samples, two["mean"])
    quantity = "set 2, no noise: exponent of ‖θ* − θ̂‖ in N"
    why = "falls as 1/√N: the sample's asymmetry averages out"
    compared.append(Finding(quantity, "converges towards 0", "–", f"{rate:.2f}", bool(-0.7 < rate < -0.3), why))
    last = float(three["mean"].iloc[-1])
    met = bool(abs(last / limit(3) - 1) < 0.25)
    quantity = f"set 3, no noise: ‖θ* − θ̂‖ at N = {int(three.samples.iloc[-1])}"
    text = f"{last:.4g}; limit by quadrature {limit(3):.4g}"
    why = "tends to the bias that the inputs' mean of −0.01 leaves"
    compared.append(Finding(quantity, "converges to a fixed number", "–", text, met, why))
    own = table[(table.measure == "training") & (table.draw == 0) & (table.samples == 1024)].set_index("data_set")
    for data_set, scripts in ((2, 0.07956), (3, 0.14333)):
        error = float(own.theta_error[data_set])
        met = bool(abs(error / scripts - 1) < 1e-3)
        quantity = f"set {data_set}, the paper's record of 1024: ‖θ* − θ̂‖"
        compared.append(Finding(quantity, "–", f"{scripts:.5g}", f"{error:.5g}", met, "the same"))
    for data_set in (2, 3):
        worst = float(table[(table.data_set == data_set) & (table.measure == "uniform")].theta_error.max())
        quantity = f"set {data_set}, uniform measure: largest ‖θ* − θ̂‖ over all N"
        met = bool(worst < 5e-3)
        why = "no bias at any N: under the uniform measure physics and unmodelled term are orthogonal"
        compared.append(Finding(quantity, "–", "–", f"{worst:.2g}", met, why))
    return compared


REPRODUCTION = Reproduction(
    "data_length",
    "Error of θ against N, without noise",
    "Ten records for each N (the paper shows one, dotted), bars of two standard deviations over them. θ under the "
    "training measure is least squares whatever the learner does, so those runs have no learner; only the uniform "
    f"measure needs training, on {TRAINED_DRAWS} records of up to {LARGEST_TRAINED['ours']} samples "
    f"({LARGEST_TRAINED['paper']} by the paper's pipeline, {LARGEST_TRAINED['scripts']} by the scripts').",
    study,
    figures,
    findings,
)
