"""Sect. 5.1, last static figure, panel (b): error of θ over the samples, without noise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.lines import percent
from orthaug.fitting.estimation import estimate
from orthaug.studies.common import (
    COLOURS,
    LARGEST_TRAINED,
    UNIFORM,
    Drawing,
    Finding,
    Reproduction,
    against_samples,
    draw_record,
    extremes,
    legend,
    mean_errors,
    panels,
    rows_of,
    signed_text,
    slope,
    train,
    whiskers,
)
from orthaug.studies.study import Study

if TYPE_CHECKING:
    import pandas as pd

SIZES = (1_000_000, 262_144, 65_536, 16_384, 4096, 1024, 256)
TRAINED_DRAWS = 3  # the uniform measure needs the learner; θ under the training measure does not


def one(data_set: int, samples: int, measure: str, draw: int, pipeline: str) -> dict[str, Any]:
    """Return θ's error on one record.

    θ is Φ⁺Y for the training measure, the split of a trained model for the uniform one.
    """
    example = draw_record(data_set, samples=samples, draw=draw)
    if measure == "training":
        fit = estimate(example.train, example.baseline, learner=None)
    else:
        fit = train(example, "static", pipeline, iterations=100).split(UNIFORM)
    return {"theta": fit.theta, "theta_error": float(np.linalg.norm(fit.theta - example.theta))}


def _runs(data_set: int, samples: int, measure: str, draw: int, pipeline: str) -> bool:
    return measure == "training" or (samples <= LARGEST_TRAINED[pipeline] and draw < TRAINED_DRAWS)


def study(pipeline: str, small: bool) -> Study:
    """Return lengths × data sets × measures × draws of the record.

    The paper's own draw comes first.
    """
    grid = {
        "data_set": (2, 3),
        "samples": (1024, 256) if small else SIZES,
        "measure": ("training", "uniform"),
        "draw": range(3 if small else 10),
        "pipeline": (pipeline,),
    }
    return Study("data_length", one, grid, where=_runs)


def limit(data_set: int) -> float:
    """Return ‖E[φφᵀ]⁻¹ E[φδ]‖ of the inputs' distribution, the limit of ‖θ* − θ̂‖ for N → ∞."""
    mean, deviation = (0.0 if data_set == 2 else -0.01), 0.3
    node, weight = np.polynomial.hermite_e.hermegauss(20)
    u = mean + deviation * node
    phi = np.stack([u, u**3], axis=1) * np.sqrt(weight)[:, None]
    delta = (0.01 - 0.5 * u**2) * np.sqrt(weight)
    return float(np.linalg.norm(np.linalg.lstsq(phi, delta, rcond=None)[0]))


def figures(table: pd.DataFrame) -> Mapping[str, Drawing]:
    """Draw "theta_error": a panel per data set, both measures."""
    figure, axes = panels(2, sharey=True, height=3.3)
    for axis, data_set in zip(axes, (2, 3), strict=True):
        for measure, name in (("training", "orthogonal"), ("uniform", "uniform")):
            errors = extremes(
                rows_of(table, data_set=data_set, measure=measure), "samples", "theta_error"
            )
            label = "orthogonal, training measure" if measure == "training" else ""
            whiskers(axis, errors.samples, errors, name, label=label)
        own = rows_of(table, data_set=data_set, measure="training")
        own = rows_of(own, draw=0).sort_values("samples")
        style = {"color": COLOURS["orthogonal"], "linewidth": 1.0, "label": "the paper's record"}
        axis.plot(own.samples, own.theta_error, ":", **style)
        if data_set == 3:
            axis.axhline(
                limit(3),
                linestyle="--",
                linewidth=0.9,
                color=COLOURS["truth"],
                label="limit, N → ∞",
            )
        against_samples(axis, f"data set {data_set}, no noise")
    axes[0].set_ylabel("‖θ* − θ̂‖")
    legend(figure, axes)
    return {
        "theta_error": Drawing(
            figure,
            "Error of θ against the number of samples without noise, data set 2 (left) and 3 "
            "(right), under the training and under the uniform measure.",
            "Marks are medians over records, bars go from the smallest to the largest of them.",
        )
    }


def findings(table: pd.DataFrame) -> list[Finding]:
    """Return the two trends, and the effect of the uniform measure on them.

    The paper's own record is in `static_errors`.
    """
    compared = []
    two, three = (
        mean_errors(rows_of(table, data_set=data_set, measure="training")) for data_set in (2, 3)
    )
    rate = slope(two.samples, two.theta_error)
    first, last = (float(two.theta_error.iloc[i]) for i in (0, -1))
    why = (
        f"the mean falls from {first:.2g} to {last:.2g} between N = {two.samples.iloc[0]} and "
        f"{two.samples.iloc[-1]}"
    )
    quantity, met = "set 2, no noise: exponent of ‖θ* − θ̂‖ in N", bool(-0.7 < rate < -0.3)
    compared.append(
        Finding(
            quantity, signed_text(rate), f"{why}; 1/√N is −0.5", "converges to 0", as_published=met
        )
    )
    last = float(three.theta_error.iloc[-1])
    away = last / limit(3) - 1
    quantity = f"set 3, no noise: ‖θ* − θ̂‖ at N = {int(three.samples.iloc[-1])}"
    why = (
        f"{percent(abs(away))} from the limit that quadrature over the inputs' distribution "
        f"gives, {limit(3):.4g}"
    )
    text, met = f"{last:.4g}", bool(abs(away) < 0.25)
    compared.append(Finding(quantity, text, why, "converges to a fixed number", as_published=met))
    for data_set in (2, 3):
        worst = float(rows_of(table, data_set=data_set, measure="uniform").theta_error.max())
        ratio = worst / float(
            rows_of(table, data_set=data_set, measure="training").theta_error.max()
        )
        quantity = f"set {data_set}, no noise, uniform measure: largest ‖θ* − θ̂‖ over all N"
        compared.append(
            Finding(
                quantity,
                f"{worst:.2g}",
                f"{ratio:.1g} times the largest under the training measure",
            )
        )
    return compared


REPRODUCTION = Reproduction(
    "data_length",
    "Error of θ against N, without noise",
    "Ten records for each N; the paper shows one, dotted in the figure. θ under the training "
    "measure is least squares whatever the learner does, so those runs have no learner; only "
    f"the uniform measure needs training, on {TRAINED_DRAWS} records of up to "
    f"{LARGEST_TRAINED['ours']} samples ({LARGEST_TRAINED['paper']} by the paper's pipeline, "
    f"{LARGEST_TRAINED['scripts']} by the scripts').",
    study,
    figures,
    findings,
)
