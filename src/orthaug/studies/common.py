"""Shared by the studies of the paper: its pipeline, its structures and records, colours and axes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from orthaug.data.record import Record
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.estimation import estimate
from orthaug.fitting.solvers.adam_lbfgs import AdamLBFGS
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.structures import Additive, Orthogonal, Structure
from orthaug.inference.measures import Samples
from orthaug.studies import published
from orthaug.studies.synthetic import NOISE_30_DB, Example, static

if TYPE_CHECKING:
    import pandas as pd

# Okabe-Ito, told apart by every reader; each structure keeps its colour and marker in all figures
COLOURS = {
    "orthogonal": "#0072B2",
    "additive": "#E69F00",
    "additive-initial": "#56B4E9",
    "uniform": "#009E73",
    "truth": "#000000",
    "orthogonal-penalty": "#CC79A7",
    "baseline-penalty": "#D55E00",
}
MARKERS = {
    "orthogonal": "o",
    "additive": "s",
    "additive-initial": "P",
    "uniform": "^",
    "orthogonal-penalty": "D",
    "baseline-penalty": "v",
}
LABELS = {
    "orthogonal": "orthogonal",
    "additive": "additive",
    "additive-initial": "additive from θ⁰",
    "uniform": "orthogonal, uniform measure",
    "orthogonal-penalty": "orthogonal penalty",
    "baseline-penalty": "baseline penalty",
}
ORTHOGONAL = Orthogonal()
STRUCTURES = {"orthogonal": ORTHOGONAL, "additive": Additive()}
PIPELINES = {"static": (500, 1000), "mass_spring_damper": (2500, 500)}  # the paper's Adam and L-BFGS iterations
LARGEST_TRAINED = {
    "ours": 65_536,
    "paper": 16_384,
    "scripts": 4096,
}  # samples up to which a learner is trained: the run is to end
_NODES = np.polynomial.legendre.leggauss(64)
UNIFORM = Samples({"u[k]": 0.6 * _NODES[0]}, weights=_NODES[1], name="uniform")
"""Uniform on [−0.6, 0.6]: `measures.Uniform` with fewer nodes, which changes no digit shown and is quicker."""


def trained(
    example: Example,
    which: str,
    pipeline: str,
    *,
    structure: Structure = ORTHOGONAL,
    seed: int = 0,
    iterations: int = 300,
    regularization: str = "none",
) -> Estimate:
    """One fit of an example by a pipeline; `which` names the paper's iterations.

    Args:
        pipeline: "ours", Levenberg-Marquardt with `iterations` and `regularization`; "paper", Adam and L-BFGS on
            normalised data; "scripts", the published scripts' own.
    """
    if pipeline == "scripts":
        return published.train(example, structure, PIPELINES[which], seed)
    solver = AdamLBFGS(*PIPELINES[which]) if pipeline == "paper" else LevenbergMarquardt(iterations)
    options: dict[str, Any] = {"structure": structure, "solver": solver, "regularization": regularization}
    return estimate(example.train, example.baseline, seed=seed, **options)


def drawn(data_set: int, *, samples: int = 1024, draw: int = 0, noise: bool = False) -> Example:
    """The static example's training record drawn anew; `draw` 0 is the paper's own, as `synthetic.static` has it."""
    example = static(data_set, noise=noise, samples=samples)
    if not draw:
        return example
    rng = np.random.default_rng([10, draw])
    half = 0.3 * rng.standard_normal(samples // 2 if data_set == 1 else samples)
    u = np.concatenate([half, -half]) if data_set == 1 else half - (0.01 if data_set == 3 else 0.0)
    y = 0.01 + u - 0.5 * u**2 + 0.1 * u**3 + (rng.normal(0.0, NOISE_30_DB, len(u)) if noise else 0.0)
    return Example(Record.from_arrays(u, y), example.test, example.baseline, example.theta)


def pick(table: pd.DataFrame, rows: Any) -> pd.DataFrame:
    """Rows of a table, in the table's order."""
    return table.loc[rows]


def slope(samples: Any, errors: Any) -> float:
    """The exponent p of errors ∝ Nᵖ, by least squares over logarithms."""
    return float(np.polyfit(np.log(np.asarray(samples, dtype=float)), np.log(np.asarray(errors, dtype=float)), 1)[0])


def panels(count: int, *, width: float = 7.0, height: float = 2.8, sharey: bool = False) -> tuple[Figure, list[Axes]]:
    """Axes side by side at column width."""
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = list(np.atleast_1d(figure.subplots(1, count, sharey=sharey)))
    for axis in axes:
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(which="both", labelsize=8)
    return figure, axes


def legend(figure: Figure, axes: Axes | Iterable[Axes], ncols: int = 4) -> None:
    """One legend for all panels, above them."""
    unique = {}
    for axis in [axes] if isinstance(axes, Axes) else axes:
        handles, labels = axis.get_legend_handles_labels()
        unique.update(dict(zip(labels, handles, strict=True)))
    ncols = min(ncols, len(unique))
    figure.legend(unique.values(), unique.keys(), loc="outside upper center", ncols=ncols, frameon=False, fontsize=8)


def bars(axis: Axes, x: Any, means: Any, reach: Any, name: str, *, label: str = "", **style: Any) -> None:
    """Means with bars of ± `reach` on a logarithmic axis; a bar that would reach zero ends at a tenth of its mean."""
    means, reach = np.asarray(means, dtype=float), np.asarray(reach, dtype=float)
    low = np.minimum(reach, 0.9 * means)
    style = {"color": COLOURS[name], "markersize": 4.0, "linewidth": 1.0, "capsize": 2.5} | style
    axis.errorbar(x, means, np.stack([low, reach]), marker=MARKERS[name], label=label or LABELS[name], **style)


def span(values: Any) -> str:
    """`mean (smallest … largest)` in three digits, one number where they agree in all of them."""
    values = np.asarray(values, dtype=float)
    if np.ptp(values) <= 1e-6 * abs(values.mean()):
        return f"{values.mean():.5g}"
    return f"{values.mean():.3g} ({values.min():.3g} … {values.max():.3g})"
