"""The figure of parameters that were followed over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug.reports.drawing import BLACK, BLUE, GREY, ORANGE, SIZE, TOP, Figure, grid, headline, label, outline, plain

if TYPE_CHECKING:
    import pandas as pd

_HIGH = 1.25  # inches of a panel
THETA = "parameters over time with 95 % bands; vertical lines: the residual left its band"


def labels(parameters: Sequence[Any]) -> dict[str, str]:
    """`name [unit]` by the name of a parameter."""
    return {p.name: f"{p.name} [{p.unit}]" if p.unit else p.name for p in parameters}


@plain
def tracking_figure(
    course: pd.DataFrame,
    names: Mapping[str, str],
    alarms: Sequence[float],
    title: str,
    physical: pd.DataFrame | None = None,
    physical_names: Mapping[str, str] | None = None,
) -> Figure:
    """A panel for each parameter with its 95 % band, and the alarm below; vertical lines are where it was raised.

    Args:
        course: `Recursive.history`.
        names: labels by the names of θ.
        alarms: instants [s].
        physical: `Recursive.physical_history`, drawn above θ, with labels in `physical_names`.
    """
    panels = [(physical, name, text) for name, text in (physical_names or {}).items() if physical is not None]
    panels += [(course, name, text) for name, text in names.items()]
    figure = Figure(figsize=(SIZE[0], TOP + _HIGH * (len(panels) + 1)))
    axes = grid(figure, len(panels) + 1, 1, sharex=True, gap=(0.16, 0.0))[:, 0]
    headline(figure, title)
    for axis, (frame, name, text) in zip(axes, panels, strict=False):
        _band(axis, frame, name)
        label(axis, y=text)
    level = course["alarm"].to_numpy(dtype=float)
    axes[-1].plot(*outline(course["time"].to_numpy(), level), color=BLACK, linewidth=0.8)
    axes[-1].axhline(1.0, color=ORANGE, linewidth=0.9, linestyle="--")
    axes[-1].set_ylim(0, max(1.2, 1.05 * level.max(initial=0.0)))
    label(axes[-1], x="time [s]", y="alarm (limit 1)")
    for axis in axes:
        for instant in alarms:
            axis.axvline(instant, color=ORANGE, linewidth=0.9)
    return figure


def _band(axis: Any, frame: pd.DataFrame, name: str) -> None:
    """A parameter over time, as wide as what most of it needs: the first rows of an empty start are wild."""
    time, value, low, high = (frame[key].to_numpy() for key in ("time", name, f"{name}_low", f"{name}_high"))
    axis.fill_between(time, low, high, color=GREY, alpha=0.6, linewidth=0)
    axis.plot(time, value, color=BLUE, linewidth=1.1)
    seen = np.concatenate([part[np.isfinite(part)] for part in (value, low, high)])
    if len(seen):
        bottom, top = np.percentile(seen, [0.5, 99.5])
        margin = 0.1 * (top - bottom) or 0.1 * abs(top) or 1.0
        axis.set_ylim(bottom - margin, top + margin)
