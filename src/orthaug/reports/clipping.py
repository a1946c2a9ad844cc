"""Curves that are cut off at the edge of their panel: what it shows, and how it is told where they leave it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug.data.record import Channel
from orthaug.reports.page_blocks import number

_FAR = 3.0  # times the measured range: a curve that leaves it is cut off at the edge of the panel


def frame_of(measured: Matrix | None, curves: Sequence[Matrix], i: int) -> list[float] | None:
    """What the upper panel shows where a curve leaves what was measured by far; None for all of it."""
    if measured is None:
        return None
    low, high = float(np.nanmin(measured[:, i])), float(np.nanmax(measured[:, i]))
    width = max(high - low, 1e-300)
    for curve in curves:
        inside = curve[:, i][np.isfinite(curve[:, i])]
        if len(inside) and (inside.min() < low - _FAR * width or inside.max() > high + _FAR * width):
            return [low - width, high + width]
    return None


@dataclass(frozen=True)
class Left:
    """A curve that leaves its panel: the instant [s], the edge it leaves by, and the value farthest out."""

    name: str
    channel: Channel
    time: float
    edge: float
    above: bool
    farthest: float


def curves_left(
    curves: Mapping[str, Vector], limits: list[float] | None, channel: Channel, start: float, step: float
) -> list[Left]:
    """The curves that are cut off at the edge of a panel, in the order of the drawing."""
    found: list[Left] = []
    for name, curve in curves.items() if limits is not None else ():
        assert limits is not None
        with np.errstate(invalid="ignore"):
            outside = np.flatnonzero((curve < limits[0]) | (curve > limits[1]))
        if len(outside):
            row, above = int(outside[0]), bool(curve[outside[0]] > limits[1])
            farthest = curve[outside][np.argmax(np.abs(curve[outside] - np.mean(limits)))]
            time = start + step * row
            found.append(Left(name, channel, time, limits[above], above, float(farthest)))
    return found


def told_left(left: Sequence[Left]) -> str:
    """What a caption says of them."""
    told = ""
    for one in left:
        named = f"{one.channel.name} of {one.name}"
        reached = f"{number(one.farthest, 3)} {one.channel.unit}".strip()
        told += f" At {number(one.time, 4)} s {named} leaves the panel, at the triangle; it goes to {reached}."
    return told


def marker_of(left: Left, outputs: Sequence[Channel]) -> dict[str, Any]:
    """A triangle at the edge where a curve leaves its panel."""
    return {
        "x": [left.time],
        "y": [left.edge],
        "yaxis": f"y{2 * list(outputs).index(left.channel) + 1}",
        "type": "scatter",
        "mode": "markers",
        "name": f"{left.name} leaves the panel",
        "cliponaxis": False,
        "showlegend": False,
        "marker": {"color": "@bad", "size": 12, "symbol": "triangle-up" if left.above else "triangle-down"},
    }
