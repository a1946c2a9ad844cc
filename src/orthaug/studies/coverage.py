"""Beyond the paper: do 95 % intervals of θ hold the truth in 95 % of repetitions?

Three kinds of interval are compared under 30 dB of noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug.data.record import Record
from orthaug.fitting.estimation import estimate
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.inference.covariance import interval
from orthaug.studies.common import (
    COLOURS,
    UNIFORM,
    Drawing,
    Finding,
    Reproduction,
    legend,
    panels,
    rows_of,
)
from orthaug.studies.study import Study
from orthaug.studies.synthetic import NOISE_30_DB, static

if TYPE_CHECKING:
    import pandas as pd

    from orthaug.fitting.lagged_estimate import LaggedEstimate

RIDGE = 1e-4
KINDS = {
    "training": "training measure",
    "paper": "the paper's convention",
    "uniform": "uniform measure",
}
_COLOURS = {
    "training": COLOURS["orthogonal"],
    "paper": COLOURS["additive"],
    "uniform": COLOURS["uniform"],
}
_MARKERS = {"training": "o", "paper": "s", "uniform": "^"}


@lru_cache
def _noiseless(data_set: int) -> LaggedEstimate:
    example = static(data_set)
    return estimate(
        example.train,
        example.baseline,
        solver=LevenbergMarquardt(300).within_limit,
        regularization="none",
    )


def one(data_set: int, draw: int) -> dict[str, Any]:
    """Return whether each interval holds the true θ, for one draw of the noise.

    Training goes on from the noiseless fit.
    """
    example, start = static(data_set), _noiseless(data_set)
    inputs, clean = example.train.experiments[0].inputs, example.train.experiments[0].outputs
    assert clean is not None
    record = Record.from_arrays(
        inputs, clean + np.random.default_rng([1, draw]).normal(0.0, NOISE_30_DB, clean.shape)
    )
    options = {"initial": start, "regularization": RIDGE, "solver": LevenbergMarquardt(100)}
    fit = estimate(record, example.baseline, **options)
    uniform = fit.split(UNIFORM)
    deviation = np.sqrt(np.diag(fit.joint_covariance("paper"))[: len(fit.theta)])
    result: dict[str, object] = {"theta": fit.theta, "theta_uniform": uniform.theta}
    intervals = {
        "training": fit.interval,
        "paper": interval(fit.theta, deviation, fit.freedom),
        "uniform": uniform.interval,
    }
    for kind, limits in intervals.items():
        assert limits is not None
        result[f"{kind}_holds"] = (
            (limits[:, 0] <= example.theta) & (example.theta <= limits[:, 1])
        ).tolist()
        result[f"{kind}_width"] = limits[:, 1] - limits[:, 0]
    return result


def study(pipeline: str, small: bool) -> Study:
    """Return data sets × draws of the noise.

    Intervals belong to a converged fit, so all pipelines share these runs.
    """
    return Study("coverage", one, {"data_set": (1, 3), "draw": range(8 if small else 400)})


def _shares(table: pd.DataFrame, data_set: int, kind: str) -> np.ndarray:
    return np.mean(
        np.array(rows_of(table, data_set=data_set)[f"{kind}_holds"].tolist(), dtype=float), axis=0
    )


def figures(table: pd.DataFrame) -> Mapping[str, Drawing]:
    """Draw "coverage": share of draws whose interval holds the truth, and interval widths."""
    figure, axes = panels(2, height=3.4)
    low, high = (100 * limit for limit in _band(table))
    for k, (kind, label) in enumerate(KINDS.items()):
        shares = np.concatenate([_shares(table, data_set, kind) for data_set in (1, 3)])
        widths = np.concatenate([_widths(table, data_set, kind) for data_set in (1, 3)])
        place = np.arange(4) + 0.22 * (k - 1)
        style = {"color": _COLOURS[kind], "linestyle": "none", "markersize": 6, "label": label}
        axes[0].plot(place, 100 * shares, marker=_MARKERS[kind], **style)
        axes[1].plot(place, widths, marker=_MARKERS[kind], **style)
    axes[0].axhspan(
        low,
        high,
        color="#B8B8B8",
        alpha=0.5,
        linewidth=0,
        label="95 %, as exact as the draws allow",
    )
    axes[0].set_ylabel("intervals that hold the truth [%]")
    axes[0].set_ylim(-4, 104)
    axes[1].set_ylabel("mean width of the interval")
    axes[1].set_ylim(bottom=0)
    for axis in axes:
        axis.set_xticks(range(4), ["set 1\nθ₁", "set 1\nθ₃", "set 3\nθ₁", "set 3\nθ₃"])
        axis.grid(visible=False, axis="x")
    legend(figure, axes, ncols=2)
    return {
        "coverage": Drawing(
            figure,
            f"Share of {_draws(table)} draws of the noise in which a 95 % interval of θ holds "
            "the true value (left), and the mean width of these intervals (right).",
            "There are three kinds of interval, on data sets 1 and 3. The grey band is 95 % "
            "plus and minus four binomial standard deviations.",
        )
    }


def _draws(table: pd.DataFrame) -> int:
    return len(rows_of(table, data_set=1))


def _band(table: pd.DataFrame) -> tuple[float, float]:
    """Return the limits of the share of an exact 95 % interval.

    They are four binomial standard deviations about 0.95.
    """
    reach = 4 * float(np.sqrt(0.95 * 0.05 / _draws(table)))
    return 0.95 - reach, min(0.95 + reach, 1.0)


def _widths(table: pd.DataFrame, data_set: int, kind: str) -> np.ndarray:
    return np.mean(rows_of(table, data_set=data_set)[f"{kind}_width"].tolist(), axis=0)


def findings(table: pd.DataFrame) -> list[Finding]:
    """Return the coverage of each kind, with the band that the number of draws allows."""
    low, high = _band(table)
    compared = []
    for data_set in (1, 3):
        for kind, name in KINDS.items():
            shares = _shares(table, data_set, kind)
            places = ["below" if s < low else "above" if s > high else "within" for s in shares]
            places = [f"{theta} {place}" for theta, place in zip(("θ₁", "θ₃"), places, strict=True)]
            why = (
                f"{' and '.join(places)} the band {100 * low:.1f} to {100 * high:.1f} % of "
                f"{_draws(table)} draws"
            )
            wider = _widths(table, data_set, kind) / _widths(table, data_set, "training")
            if kind != "training":
                why += (
                    f"; {wider[0]:.3g} and {wider[1]:.3g} times as wide as under the training "
                    "measure"
                )
            text = ", ".join(f"{100 * s:.1f} %" for s in shares)
            quantity = f"set {data_set}, 30 dB, {name}: coverage of 95 % intervals, θ₁ and θ₃"
            compared.append(Finding(quantity, text, why))
    return compared


REPRODUCTION = Reproduction(
    "coverage",
    "Do the intervals hold?",
    "Repeated draws of 30 dB noise on the paper's inputs, trained on from the noiseless fit "
    "with a ridge of 1e-4, by Levenberg-Marquardt under every pipeline. An interval promises "
    "95 %: θ's own under the training measure, the same with the paper's covariance, and θ's "
    "under the uniform measure.",
    study,
    figures,
    findings,
)
