"""Shared by the studies of the paper: its pipeline, its structures and records, colours and axes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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

    from orthaug.studies.references import Spread

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


def panels(
    count: int,
    *,
    width: float = 7.0,
    height: float = 3.0,
    sharex: bool = False,
    sharey: bool = False,
    rows: bool = False,
) -> tuple[Figure, list[Axes]]:
    """Axes side by side at column width, or one above the other."""
    figure = Figure(figsize=(width, height), layout="constrained")
    shape = (count, 1) if rows else (1, count)
    axes = list(np.atleast_1d(figure.subplots(*shape, sharex=sharex, sharey=sharey)))
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


def extremes(rows: pd.DataFrame, by: str, column: str) -> pd.DataFrame:
    """Per value of `by` the median, the smallest and the largest of a column."""
    return rows.groupby(by)[column].agg(["median", "min", "max"]).reset_index()


def whiskers(axis: Axes, x: Any, of: pd.DataFrame, name: str, *, label: str = "", **style: Any) -> None:
    """Medians with bars from the smallest to the largest value, which a logarithmic axis shows whole."""
    reach = np.stack([of["median"] - of["min"], of["max"] - of["median"]])
    style = {
        "color": COLOURS[name],
        "marker": MARKERS[name],
        "markersize": 4.0,
        "linewidth": 1.0,
        "capsize": 2.5,
    } | style
    axis.errorbar(x, of["median"], reach, label=label or LABELS[name], **style)


def scripts_bars(axis: Axes, x: Any, spreads: Sequence[Spread], name: str, **style: Any) -> None:
    """What the scripts gave: a cross at each mean with a bar from the smallest to the largest run."""
    low, mean, high = (np.array([getattr(spread, part) for spread in spreads]) for part in ("low", "mean", "high"))
    style = {"marker": "x", "markersize": 5.0, "linewidth": 0.0, "elinewidth": 0.8, "capsize": 2.5} | style
    style["label"] = f"scripts, {LABELS[name]}"
    axis.errorbar(x, mean, np.stack([mean - low, high - mean]), color=COLOURS[name], alpha=0.6, **style)


def signed(exponent: float) -> str:
    """Two decimals with a true minus."""
    return f"{exponent:.2f}".replace("-", "−")


def agreement(values: Any) -> str:
    """How far rows of values, one per start, lie apart."""
    apart = float(np.ptp(np.asarray(values, dtype=float), axis=0).max())
    return f"starts agree within {apart:.1g}" if apart else "the same number for every start"


def span(values: Any) -> str:
    """`mean (smallest … largest)` in three digits, one number where they agree in all of them."""
    values = np.asarray(values, dtype=float)
    if np.ptp(values) <= 1e-6 * abs(values.mean()):
        return f"{values.mean():.5g}"
    return f"{values.mean():.3g} ({values.min():.3g} … {values.max():.3g})"
