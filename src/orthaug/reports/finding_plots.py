"""Figures of findings: tests of residuals, and biases by suspected terms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from orthaug._base.lines import percent
from orthaug.reports.biases import bias_map
from orthaug.reports.drawing import (
    BLACK,
    BLUE,
    BOTTOM,
    CYCLE,
    GREEN,
    GREY,
    RIGHT,
    SIZE,
    TOP,
    Axes,
    Figure,
    grid,
    headline,
    label,
    plain,
)
from orthaug.reports.findings import SuspectResult
from orthaug.reports.page_blocks import regressor_label, with_unit
from orthaug.reports.residual_tests import ResidualTestResult

_UPRIGHT = 11  # letters of a name that fit above one cell
_CELL = 0.8  # inches


@plain
def residual_analysis_figure(
    tests: Sequence[ResidualTestResult], title: str, units: Mapping[str, str]
) -> Figure:
    """Draw each residual's autocorrelation, correlation with inputs, and means over a regressor.

    The regressor is the one that explains most.

    Args:
        units: by channel.
    """
    figure = Figure(figsize=(SIZE[0] * 1.45, TOP + 2.6 * len(tests)))
    axes = grid(figure, len(tests), 3, gap=(BOTTOM + 0.3, 0.95))
    headline(figure, f"{title}: 99 % bands")
    for (own, crossed, over), test in zip(axes, tests, strict=True):
        own.set_title(f"residual of {test.name}", fontsize=9, loc="left", fontweight="bold")
        if test.acf is not None and test.acf_band is not None:
            own.bar(np.arange(1, len(test.acf)), _floats(test.acf[1:]), color=BLUE, width=0.6)
            own.axhspan(-test.acf_band, test.acf_band, color=GREY, alpha=0.5)
        label(own, x="lag [samples]", y="autocorrelation")
        _correlations(crossed, test)
        label(crossed, x="lag behind the input [samples]", y="correlation with the inputs")
        for name, curve in test.strongest.items():
            centres, means, errors = (
                _floats(values) for values in (curve.centres, curve.means, curve.errors)
            )
            over.errorbar(centres, means, 2.576 * errors, fmt="o", color=GREEN, markersize=3)
            over.axhline(0.0, color=BLACK, linewidth=0.6)
            words, share = (
                with_unit("mean residual", units.get(test.name)),
                percent(curve.share or 0.0),
            )
            label(
                over,
                x=regressor_label(name, units),
                y=words,
                title=f"explains {share} of its variance",
            )
    return figure


def _correlations(axis: Axes, test: ResidualTestResult) -> None:
    """Draw the correlation of a residual with every input, in the band of noise."""
    for (name, cross), color in zip(test.crossed.items(), CYCLE * len(test.crossed), strict=False):
        reach = len(cross.values) // 2
        axis.plot(
            np.arange(-reach, reach + 1),
            _floats(cross.values),
            ".-",
            color=color,
            linewidth=0.8,
            label=name,
        )
    if test.crossed:
        axis.axhspan(-test.cross_band, test.cross_band, color=GREY, alpha=0.5)
        axis.legend(fontsize=8, frameon=False)


@plain
def bias_figure(suspects: Sequence[SuspectResult]) -> Figure:
    """Draw a heat map of the bias of each parameter by each suspect, in per cent."""
    shown = bias_map(suspects)
    longest = max(map(len, shown.parameters))
    upright = longest <= _UPRIGHT
    left, bottom = (
        0.3 + 0.075 * max(map(len, shown.suspects)),
        BOTTOM if upright else 0.3 + 0.075 * longest,
    )
    title = (
        "bias of each parameter [%] by terms that may be missing (without a guess: of 1 % of "
        "the output)"
    )
    title += (
        f"\ncolours are logarithmic{'; ' if shown.left_out else ''}{shown.left_out[:1].lower()}"
    )
    title += shown.left_out[1:].rstrip(".")
    width = max(
        left + _CELL * len(shown.parameters) + RIGHT,
        SIZE[0],
        0.08 * max(map(len, title.split("\n"))),
    )
    figure = Figure(figsize=(width, TOP + bottom + 0.28 * len(shown.suspects)))
    ((axis,),) = grid(figure, 1, 1, left=left, bottom=bottom)
    axis.imshow(shown.colours, cmap="PuOr", vmin=-shown.reach, vmax=shown.reach, aspect="auto")
    for i, j in np.ndindex(*shown.shares.shape):
        color = "white" if abs(shown.colours[i, j]) > 0.6 * shown.reach else BLACK
        axis.text(j, i, shown.cells[i][j], ha="center", va="center", fontsize=7, color=color)
    axis.set_xticks(
        range(len(shown.parameters)), shown.parameters, fontsize=8, rotation=0 if upright else 90
    )
    axis.set_yticks(range(len(shown.suspects)), shown.suspects, fontsize=8)
    axis.tick_params(length=0)
    axis.grid(visible=False)
    axis.spines[:].set_visible(False)
    headline(figure, title)
    return figure


def _floats(values: Sequence[Any]) -> np.ndarray:
    """Return the numbers of a result, NaN for None."""
    return np.array(values, dtype=float)
