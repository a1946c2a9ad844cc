"""Beyond the paper: do 95 % intervals of θ hold the truth in 95 % of repetitions? Three kinds of interval, 30 dB."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug.data.record import Record
from orthaug.fitting.estimation import estimate
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.inference.covariance import interval
from orthaug.studies.common import COLOURS, UNIFORM, legend, panels
from orthaug.studies.entry import Finding, Reproduction
from orthaug.studies.study import Study
from orthaug.studies.synthetic import NOISE_30_DB, static

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from orthaug.fitting.estimates import Estimate

RIDGE = 1e-4
KINDS = {"training": "training measure", "paper": "the paper's convention", "uniform": "uniform measure"}
_COLOURS = {"training": COLOURS["orthogonal"], "paper": COLOURS["additive"], "uniform": COLOURS["uniform"]}


@lru_cache
def _noiseless(data_set: int) -> Estimate:
    example = static(data_set)
    return estimate(example.train, example.baseline, solver=LevenbergMarquardt(300))


def one(data_set: int, draw: int) -> dict[str, Any]:
    """One draw of the noise, trained on from the noiseless fit: does each interval hold the true θ?"""
    example, start = static(data_set), _noiseless(data_set)
    inputs, clean = example.train.experiments[0].inputs, example.train.experiments[0].outputs
    assert clean is not None
    record = Record.from_arrays(inputs, clean + np.random.default_rng([1, draw]).normal(0.0, NOISE_30_DB, clean.shape))
    options = {"initial": start, "regularization": RIDGE, "solver": LevenbergMarquardt(100)}
    fit = estimate(record, example.baseline, **options)
    uniform = fit.split(UNIFORM)
    deviation = np.sqrt(np.diag(fit.joint_covariance("paper"))[: len(fit.theta)])
    result: dict[str, Any] = {"theta": fit.theta, "theta_uniform": uniform.theta}
    intervals = {
        "training": fit.interval,
        "paper": interval(fit.theta, deviation, fit.freedom),
        "uniform": uniform.interval,
    }
    for kind, limits in intervals.items():
        assert limits is not None
        result[f"{kind}_holds"] = ((limits[:, 0] <= example.theta) & (example.theta <= limits[:, 1])).tolist()
        result[f"{kind}_width"] = limits[:, 1] - limits[:, 0]
    return result


def study(pipeline: str, small: bool) -> Study:
    """Data sets × draws of the noise; intervals belong to a converged fit, so all pipelines share these runs."""
    return Study("coverage", one, {"data_set": (1, 3), "draw": range(8 if small else 400)})


def _shares(table: pd.DataFrame, data_set: int, kind: str) -> np.ndarray:
    rows = table[table.data_set == data_set]
    return np.mean(np.array(rows[f"{kind}_holds"].tolist(), dtype=float), axis=0)


def figures(table: pd.DataFrame) -> Mapping[str, Figure]:
    """Figure "coverage": share of draws whose interval holds the truth, and widths of the intervals."""
    figure, axes = panels(2, height=3.0)
    width = 0.25
    for k, (kind, label) in enumerate(KINDS.items()):
        shares = np.concatenate([_shares(table, data_set, kind) for data_set in (1, 3)])
        widths = [np.mean(table[table.data_set == data_set][f"{kind}_width"].tolist(), axis=0) for data_set in (1, 3)]
        place = np.arange(4) + width * (k - 1)
        axes[0].bar(place, 100 * shares, width, color=_COLOURS[kind], label=label)
        axes[1].bar(place, np.concatenate(widths), width, color=_COLOURS[kind], label=label)
    axes[0].axhline(95, linestyle="--", color=COLOURS["truth"], linewidth=0.9, label="nominal, 95 %")
    axes[0].set_ylabel("intervals that hold the truth [%]")
    axes[1].set_ylabel("mean width of the interval")
    for axis in axes:
        axis.set_xticks(range(4), ["set 1\nθ₁", "set 1\nθ₃", "set 3\nθ₁", "set 3\nθ₃"])
        axis.grid(visible=False, axis="x")
    legend(figure, axes)
    return {"coverage": figure}


def findings(table: pd.DataFrame) -> list[Finding]:
    """Coverage of each kind, with the band that the number of draws allows."""
    draws = int((table.data_set == 1).sum())
    band = 4 * np.sqrt(0.95 * 0.05 / draws)
    expected = (
        (1, "training", lambda share: abs(share - 0.95) < band, "as promised, where the measure leaves no bias"),
        (1, "paper", lambda share: share > 0.95, "its factor 2 makes intervals √2 too wide"),
        (1, "uniform", lambda share: abs(share - 0.95) < band, "as promised"),
        (3, "training", lambda share: share.min() < 0.5, "precise about the wrong value: set 3 is biased (F3)"),
        (3, "paper", lambda share: share.min() < 0.5, "no wider interval mends a bias"),
        (3, "uniform", lambda share: abs(share - 0.95) < band, "as promised, where the training measure fails"),
    )
    compared = []
    for data_set, kind, check, why in expected:
        shares = _shares(table, data_set, kind)
        text = ", ".join(f"{100 * s:.1f} %" for s in shares)
        quantity = f"set {data_set}, {KINDS[kind]}: coverage of 95 % intervals, θ₁ and θ₃"
        compared.append(Finding(quantity, "–", "–", text, bool(np.all(check(shares))), f"{why} ({draws} draws)"))
    return compared


REPRODUCTION = Reproduction(
    "coverage",
    "Do the intervals hold?",
    "Repeated draws of 30 dB noise on the paper's inputs, trained on from the noiseless fit with a ridge of 1e-4, by "
    "Levenberg-Marquardt under every pipeline. An interval promises 95 %: θ's own under the training measure, the "
    "same with the paper's covariance, and θ's under the uniform measure.",
    study,
    figures,
    findings,
)
