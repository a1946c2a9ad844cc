"""What the studies of the paper share: its pipeline, its structures, colours and axes."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from orthaug.solvers import AdamLBFGS, LevenbergMarquardt
from orthaug.structures import Additive, Orthogonal

# Okabe-Ito, told apart by every reader; each structure keeps its colour and marker in all figures
COLOURS = {"orthogonal": "#0072B2", "additive": "#E69F00", "uniform": "#009E73", "truth": "#000000"}
MARKERS = {"orthogonal": "o", "additive": "s", "uniform": "^"}
LABELS = {"orthogonal": "orthogonal", "additive": "additive", "uniform": "orthogonal, uniform measure"}
STRUCTURES = {"orthogonal": Orthogonal(), "additive": Additive()}
PIPELINES = {"static": (500, 1000), "mass_spring_damper": (2500, 500)}  # the paper's Adam and L-BFGS iterations


def solver(pipeline: str, example: str, iterations: int = 300) -> Any:
    """Our solver, or the paper's pipeline with its iterations for an example."""
    return AdamLBFGS(*PIPELINES[example]) if pipeline == "paper" else LevenbergMarquardt(iterations)


def panels(count: int, *, width: float = 7.0, height: float = 2.8, sharex: bool = False) -> tuple[Figure, list[Axes]]:
    """Axes side by side at column width."""
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = list(np.atleast_1d(figure.subplots(1, count, sharex=sharex)))
    for axis in axes:
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def legend(figure: Figure, axis: Axes) -> None:
    """One legend for all panels, above them."""
    handles, labels = axis.get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    figure.legend(
        unique.values(), unique.keys(), loc="outside upper center", ncols=len(unique), frameon=False, fontsize=8
    )


def span(values: Any) -> str:
    """`mean (smallest … largest)` in three digits."""
    values = np.asarray(values, dtype=float)
    return f"{values.mean():.3g} ({values.min():.3g} … {values.max():.3g})"
