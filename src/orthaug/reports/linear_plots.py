"""Figures of linear views: frequency responses with bands, and poles in the unit circle."""

from __future__ import annotations

import numpy as np

from orthaug.analysis.linear_view import COHERENT, Linearization, phase_of
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
_WIDE = 4.2  # inches of a column of several


@plain
def bode_figure(found: Linearization) -> Figure:
    """Magnitude and phase from every input to every output, with 95 % bands; grey: data alone."""
    first = found[0]
    ny, nu = first.d.shape
    figure = Figure(figsize=(max(SIZE[0], _WIDE * nu), TOP + BOTTOM + 1.9 * 2 * ny))
    axes = grid(figure, 2 * ny, nu, sharex=True, gap=(0.3, 0.95))
    for i, j in np.ndindex(ny, nu):
        upper, lower = axes[2 * i, j], axes[2 * i + 1, j]
        _draw_measured(found, upper, lower, i, j)
        for number, view in enumerate(found):
            bode, colour = view.bode, _COLOURS[number % len(_COLOURS)]
            if bode is None:
                continue
            name = "model" if len(found) == 1 else f"model at point {number + 1}"
            upper.plot(bode.frequency, bode.magnitude[:, i, j], color=colour, linewidth=1.2, label=name)
            lower.plot(bode.frequency, bode.phase[:, i, j], color=colour, linewidth=1.2)
            for axis, band in ((upper, bode.magnitude_ci95), (lower, bode.phase_ci95)):
                if band is not None:
                    low, high = band[:, i, j, 0], band[:, i, j, 1]
                    axis.fill_between(bode.frequency, low, high, color=colour, alpha=0.3, linewidth=0)
            _limits(upper, lower, bode, i, j)
        unit = gain_unit(first, first.outputs[i], first.inputs[j])
        upper.set_xscale("log")
        upper.set_yscale("log")
        _log_labels(lower.xaxis, sparse=True)
        _log_labels(upper.yaxis, sparse=np.divide(*upper.get_ylim()[::-1]) > _DECADES)
        label(upper, y=f"gain [{unit}]" if unit else "gain")
        label(lower, y="phase [°]", x="frequency [Hz]" if i == ny - 1 else None)
        if ny * nu > 1:
            upper.set_title(f"{first.outputs[i]} / {first.inputs[j]}", fontsize=9, loc="left", y=1.0)
        if (i, j) == (0, nu - 1):
            legend(upper)
    pair = f" from {first.inputs[0]} to {first.outputs[0]}" if ny * nu == 1 else ""
    banded = ", 95 % bands" if first.bode is not None and first.bode.magnitude_ci95 is not None else ""
    headline(figure, f"frequency response{pair}{banded}")
    return figure


def _draw_measured(found: Linearization, upper, lower, i: int, j: int) -> None:
    if found.measured is None:
        return
    measured = found.measured
    shown = (measured.coherence[:, i] >= COHERENT) & np.isfinite(measured.value[:, i, j])
    value = np.where(shown[:, None, None], measured.value, np.nan)
    how = "whole periods" if measured.method == "periods" else "Welch"
    name = f"data ({how}, coherence ≥ {COHERENT})"
    upper.plot(measured.frequency, np.abs(value[:, i, j]), ".", color=GREY, markersize=3, label=name)
    phase = phase_of(value)[:, i, j]
    bode = found[0].bode
    if bode is not None and np.isfinite(phase).any():  # the turn that the model is on
        there = np.flatnonzero(np.isfinite(phase))
        near = np.interp(measured.frequency[there], bode.frequency, bode.phase[:, i, j])
        phase = phase.copy()
        phase[there] += 360 * np.round((near - phase[there]) / 360)
    lower.plot(measured.frequency, phase, ".", color=GREY, markersize=3)


def _log_labels(axis, *, sparse: bool) -> None:
    """Numbers as they are written in text; of a short axis those between powers of ten too."""
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_formatter(lambda value, _: "" if sparse or f"{value:.0e}"[0] not in "235" else f"{value:g}")


def _limits(upper, lower, bode, i: int, j: int) -> None:
    """Bands that leave all bounds do not hide the curve."""
    size = bode.magnitude[:, i, j]
    size = size[np.isfinite(size) & (size > 0)]
    if len(size):
        low, high = upper.get_ylim() if upper.get_ylim()[0] > 0 else (size.min(), size.max())
        upper.set_ylim(max(low, size.min() / 30), min(max(high, size.max() * 1.2), size.max() * 30))
    phase = bode.phase[:, i, j]
    phase = phase[np.isfinite(phase)]
    if len(phase):
        low, high = lower.get_ylim()
        lower.set_ylim(max(low, phase.min() - 200), min(high, phase.max() + 200))


@plain
def poles_figure(found: Linearization) -> Figure:
    """The poles of all points of rest beside the unit circle, with 95 % intervals of their magnitudes."""
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
                axis.plot(ends.real, ends.imag, color=colour, linewidth=2.5, alpha=0.4, solid_capstyle="butt")
        z = np.array([pole.z for pole in view.poles])
        name = "poles" if len(found) == 1 else f"point {number + 1}"
        axis.plot(z.real, z.imag, "x", color=colour, markersize=7, label=name)
        if view.at_zero:
            axis.plot([0.0], [0.0], "x", color=colour, markersize=7)
            axis.annotate(f"{view.at_zero} at 0", (0.0, 0.0), (4, 4), textcoords="offset points", fontsize=8)
    reach = max([1.08, *(1.08 * pole.magnitude for view in found for pole in view.poles)])
    axis.set_xlim(-reach, reach)
    axis.set_ylim(-reach, reach)
    axis.set_aspect("equal")
    label(axis, x="real part", y="imaginary part")
    legend(axis)
    headline(figure, "poles z of the sampled system")
    return figure
