"""Figures of linear views: frequency responses with bands, and poles in the unit circle."""

from __future__ import annotations

from typing import Any

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.lines import with_unit
from orthaug.analysis.linear_view import COHERENT, Linearization, LinearView
from orthaug.reports.drawing import (
    BLACK,
    BLUE,
    BOTTOM,
    GREEN,
    GREY,
    ORANGE,
    SIZE,
    TOP,
    Figure,
    grid,
    headline,
    label,
    legend,
    plain,
)
from orthaug.reports.linear import gain_unit

_COLOURS = (BLUE, ORANGE, GREEN, BLACK)
_DECADES = 50.0  # an axis that reaches further has labels at powers of ten alone
_NEAR = 10.0  # times beyond the curves: gains from data alone that are drawn
_DEEP = 1e-6  # of the largest gain: what is drawn
_WIDE = 4.2  # inches of a column of several


@plain
def bode_figure(found: Linearization) -> Figure:
    """Draw magnitude and phase from every input to every output, with 95 % bands; grey: from data.

    Points of rest outside of the training data are drawn where there is no other.
    """
    first = found[0]
    views = {i + 1: view for i, view in enumerate(found) if not view.point.outside} or {1: first}
    ny, nu = first.d.shape
    figure = Figure(figsize=(max(SIZE[0], _WIDE * nu), TOP + BOTTOM + 1.9 * 2 * ny))
    axes: Any = grid(figure, 2 * ny, nu, sharex=True, gap=(0.3, 0.95))
    for i, j in np.ndindex(ny, nu):
        upper, lower = axes[2 * i, j], axes[2 * i + 1, j]
        upper.set_xscale("log")
        upper.set_yscale("log")
        unit = gain_unit(first, i, j)
        _draw_pair(found, views, upper, lower, (i, j))
        label(upper, y=with_unit("gain", unit))
        label(
            lower, y="phase [°]", x=f"frequency [{first.frequency_unit}]" if i == ny - 1 else None
        )
        if ny * nu > 1:
            upper.set_title(
                f"{first.outputs[i]} / {first.inputs[j]}", fontsize=9, loc="left", y=1.0
            )
        if (i, j) == (0, 0) and ny * nu > 1:
            upper.legend(loc="lower left", fontsize=8, frameon=False)
        elif (i, j) == (0, 0):
            legend(upper)
    pair = f" from {first.inputs[0]} to {first.outputs[0]}" if ny * nu == 1 else ""
    banded = (
        ", 95 % bands" if first.bode is not None and first.bode.magnitude_ci95 is not None else ""
    )
    headline(figure, f"frequency response{pair}{banded}")
    return figure


def _draw_pair(
    found: Linearization,
    views: dict[int, LinearView],
    upper: Any,
    lower: Any,
    pair: tuple[int, int],
) -> None:
    """Draw one input and output; bands that leave all bounds do not hide the curves."""
    place = (slice(None), *pair)
    curves, turns = [], []
    for number, view in views.items():
        bode, colour = view.bode, _COLOURS[(number - 1) % len(_COLOURS)]
        assert bode is not None
        size, phase = bode.magnitude[place], bode.phase[place]
        turn = (
            360 * np.round((turns[0][0] - phase[0]) / 360)
            if turns and np.isfinite(phase[0])
            else 0.0
        )
        phase = phase + turn
        upper.plot(
            bode.frequency,
            size,
            color=colour,
            linewidth=1.2,
            label=f"model{_point_label(found, number)}",
        )
        lower.plot(bode.frequency, phase, color=colour, linewidth=1.2)
        if bode.magnitude_ci95 is not None and bode.phase_ci95 is not None:
            for axis, band in (
                (upper, bode.magnitude_ci95[place]),
                (lower, bode.phase_ci95[place] + turn),
            ):
                axis.fill_between(bode.frequency, *band.T, color=colour, alpha=0.3, linewidth=0)
        curves.append(size)
        turns.append(phase)
    size, phase = np.concatenate(curves), np.concatenate(turns)
    size, phase = size[np.isfinite(size) & (size > 0)], phase[np.isfinite(phase)]
    own, turned = _draw_measured(found, upper, lower, pair, turns[0])
    if len(size):
        own = own[(own > size.min() / _NEAR) & (own < size.max() * _NEAR)]
        low, high = (end([*own, end(size)]) for end in (min, max))
        low = max(low, high * _DEEP) / 1.3
        upper.set_ylim(low, high * 1.6)
        _log_labels(upper.yaxis, sparse=high / low > _DECADES)
    if len(phase):
        lower.set_ylim(
            *(end([*turned, end(phase)]) + more for end, more in ((min, -15), (max, 15)))
        )
    _log_labels(lower.xaxis, sparse=True)


def _point_label(found: Linearization, number: int) -> str:
    return "" if len(found) == 1 else f" at point {number}"


def _draw_measured(
    found: Linearization, upper: Any, lower: Any, pair: tuple[int, int], model: Vector
) -> tuple[Vector, Vector]:
    """Draw gain and phase from the data, on the turn that the model's phase is on; return both."""
    measured, bode = found.measured, found[0].bode
    if measured is None or bode is None:
        return np.zeros(0), np.zeros(0)
    i, j = pair
    shown = (measured.coherence[:, i] >= COHERENT) & np.isfinite(measured.value[:, i, j])
    frequency, value = measured.frequency[shown], measured.value[shown, i, j]
    how = "periods" if measured.method == "periods" else "Welch"
    upper.plot(
        frequency, np.abs(value), ".", color=GREY, markersize=3, zorder=1, label=f"data ({how})"
    )
    phase, near = (
        np.degrees(np.angle(value)),
        np.interp(frequency, bode.frequency, np.nan_to_num(model)),
    )
    phase = phase + 360 * np.round((near - phase) / 360)
    lower.plot(frequency, phase, ".", color=GREY, markersize=3, zorder=1)
    return np.abs(value), phase


def _log_labels(axis: Any, *, sparse: bool) -> None:
    """Write numbers as in text; on a short axis also those between powers of ten."""
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_formatter(
        lambda value, _: "" if sparse or f"{value:.0e}"[0] not in "235" else f"{value:g}"
    )


@plain
def poles_figure(found: Linearization) -> Figure:
    """Draw the poles of all operating points in the unit circle, with 95 % intervals."""
    figure = Figure(figsize=(5.2, 5.2 + TOP - 0.3))
    ((axis,),) = grid(figure, 1, 1)
    turn = np.linspace(0, 2 * np.pi, 400)
    axis.plot(np.cos(turn), np.sin(turn), color=GREY, linewidth=1.0)
    axis.axhline(0.0, color=GREY, linewidth=0.6)
    axis.axvline(0.0, color=GREY, linewidth=0.6)
    for number, view in enumerate(found):
        colour = _COLOURS[number % len(_COLOURS)]
        for pole in view.poles:
            if pole.magnitude_ci95 is not None and pole.magnitude > 0:
                ends = np.array(pole.magnitude_ci95) * pole.z / pole.magnitude
                axis.plot(
                    ends.real,
                    ends.imag,
                    color=colour,
                    linewidth=2.5,
                    alpha=0.4,
                    solid_capstyle="butt",
                )
        z: Any = np.array([pole.z for pole in view.poles], dtype=complex)
        name = "poles" if len(found) == 1 else f"point {number + 1}"
        axis.plot(z.real, z.imag, "x", color=colour, markersize=7, label=name)
        if view.at_zero:
            axis.plot([0.0], [0.0], "x", color=colour, markersize=7)
            axis.annotate(
                f"{view.at_zero} at 0", (0.0, 0.0), (4, 4), textcoords="offset points", fontsize=8
            )
    reach = max([1.08, *(1.08 * pole.magnitude for view in found for pole in view.poles)])
    axis.set_xlim(-reach, reach)
    axis.set_ylim(-reach, reach)
    axis.set_aspect("equal")
    label(axis, x="real part", y="imaginary part")
    legend(axis)
    headline(figure, "poles z of the sampled system")
    return figure
