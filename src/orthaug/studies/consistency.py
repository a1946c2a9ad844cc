"""Sect. 5.1, last static figure, panel (c): error of θ over the samples, 30 dB of noise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.lines import percent
from orthaug.fitting.estimation import estimate
from orthaug.studies.common import (
    LARGEST_TRAINED,
    STRUCTURES,
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
    span,
    train,
    whiskers,
)
from orthaug.studies.data_length import SIZES, limit
from orthaug.studies.study import Study

if TYPE_CHECKING:
    import pandas as pd


def one(data_set: int, samples: int, curve: str, run: int, pipeline: str) -> dict[str, Any]:
    """Return θ's error and, under the uniform measure, its price in standard error.

    Each run has its record and start.
    """
    example = draw_record(data_set, samples=samples, draw=run, noise=True)
    price = None
    if curve == "orthogonal":
        fit = estimate(example.train, example.baseline, learner=None)
    else:
        # evidence for the uniform measure, which looks at the learner;
        # the additive structure as published
        prior = "evidence" if curve == "uniform" and pipeline == "ours" else "none"
        structure = STRUCTURES["additive" if curve == "additive" else "orthogonal"]
        options = {
            "structure": structure,
            "iterations": 100 if samples < 10_000 else 50,
            "regularization": prior,
        }
        fit = train(example, "static", pipeline, seed=run, **options)
        if curve == "uniform":
            fit = fit.split(UNIFORM)
            price = fit.measure.price if fit.measure is not None else None
    return {
        "theta": fit.theta,
        "theta_error": float(np.linalg.norm(fit.theta - example.theta)),
        "price": price,
    }


def _runs(data_set: int, samples: int, curve: str, run: int, pipeline: str) -> bool:
    if curve == "additive":
        return data_set == 1 and samples <= LARGEST_TRAINED[pipeline]
    return curve == "orthogonal" or samples <= LARGEST_TRAINED[pipeline]


def study(pipeline: str, small: bool) -> Study:
    """Return lengths × data sets × curves × runs; run 0 is the paper's own record."""
    grid = {
        "data_set": (1, 3),
        "samples": (1024, 256) if small else SIZES,
        "curve": ("additive", "uniform", "orthogonal"),
        "run": range(2 if small else 10),
        "pipeline": (pipeline,),
    }
    return Study("consistency", one, grid, where=_runs)


def figures(table: pd.DataFrame) -> Mapping[str, Drawing]:
    """Draw "theta_error": sets 1 and 3, all curves."""
    figure, axes = panels(2, sharey=True, height=3.4)
    for axis, data_set in zip(axes, (1, 3), strict=True):
        for i, curve in enumerate(("additive", "orthogonal", "uniform")):
            errors = extremes(
                rows_of(table, data_set=data_set, curve=curve), "samples", "theta_error"
            )
            if len(errors):
                label = "orthogonal, training measure" if curve == "orthogonal" else ""
                whiskers(axis, errors.samples * 1.08 ** (i - 1), errors, curve, label=label)
        if data_set == 3:
            axis.axhline(
                limit(3),
                linestyle="--",
                linewidth=0.9,
                color="black",
                label="limit of set 3, N → ∞",
            )
        against_samples(axis, f"data set {data_set}, 30 dB")
    axes[0].set_ylabel("‖θ* − θ̂‖")
    legend(figure, axes)
    return {
        "theta_error": Drawing(
            figure,
            "Error of θ against the number of samples under 30 dB of noise, data set 1 (left) "
            "and 3 (right).",
            "The curves are the additive structure and the orthogonal one under two measures. "
            "Marks are medians over runs, bars go from the smallest to the largest of them; "
            "the curves are shifted sideways by a few per cent, so that the bars do not "
            "overlap.",
        )
    }


def findings(table: pd.DataFrame) -> list[Finding]:
    """Return whether θ is consistent, and the uniform measure's price.

    The paper's record of 1024 is in `static_noise`.
    """
    compared = []
    for data_set, curve, published in (
        (1, "orthogonal", "converges to 0"),
        (1, "additive", "does not converge"),
        (1, "uniform", ""),
        (3, "uniform", ""),
    ):
        means = mean_errors(rows_of(table, data_set=data_set, curve=curve))
        rate = slope(means.samples, means.theta_error)
        met = {"converges to 0": -0.65 < rate < -0.35, "does not converge": rate > -0.25}.get(
            published
        )
        first, last = (
            f"{means.theta_error.iloc[i]:.2g} at N = {means.samples.iloc[i]}" for i in (0, -1)
        )
        why = f"the mean goes from {first} to {last}; 1/√N is −0.5"
        quantity = f"set {data_set}, 30 dB, {curve}: exponent of ‖θ* − θ̂‖ in N"
        compared.append(Finding(quantity, signed_text(rate), why, published, as_published=met))
    last = mean_errors(rows_of(table, data_set=3, curve="orthogonal")).iloc[-1]
    quantity = f"set 3, 30 dB, orthogonal: ‖θ* − θ̂‖ at N = {int(last.samples)}"
    away = 100 * abs(last.theta_error / limit(3) - 1)
    why = f"{percent(away / 100)} from the limit without noise, {limit(3):.4g}: it does not go to 0"
    compared.append(Finding(quantity, f"{last.theta_error:.4g}", why))
    rows = rows_of(table, data_set=1, curve="uniform", samples=1024)
    prices = np.array([price for price in rows.price if price is not None], dtype=float)
    text = f"θ₁ {span(prices[:, 0])}, θ₃ {span(prices[:, 1])}"
    quantity = "set 1, 30 dB, N = 1024, uniform measure: standard error over the training measure's"
    above = int((prices > 1).all(axis=1).sum())
    compared.append(
        Finding(quantity, text, f"above 1 for both parameters in {above} of {len(prices)} runs")
    )
    return compared


REPRODUCTION = Reproduction(
    "consistency",
    "Error of θ against N, with noise",
    "Ten runs for each N, each with its own record and initial weights (run 0 has the paper's "
    "record). The paper varies the initial weights only, which moves the additive structure "
    "alone. θ under the training measure is least squares and needs no learner; trained curves "
    f"end at N = {LARGEST_TRAINED['ours']}, {LARGEST_TRAINED['paper']} by the paper's pipeline "
    f"and {LARGEST_TRAINED['scripts']} by the scripts'. Under the uniform measure our solver "
    "trains with evidence regularization, the others with none.",
    study,
    figures,
    findings,
)
