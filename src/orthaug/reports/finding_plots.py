"""Figures of findings: tests of residuals, biases by suspected terms, and rehearsals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from orthaug._base.lines import cut, percent, with_unit
from orthaug.analysis.findings import SuspectResult
from orthaug.analysis.residual_tests import ResidualTestResult
from orthaug.reports.biases import bias_map
from orthaug.reports.drawing import (
    BLACK,
    BLUE,
    BOTTOM,
    CYCLE,
    GREEN,
    GREY,
    ORANGE,
    RIGHT,
    SIZE,
    TOP,
    Axes,
    Figure,
    floats,
    grid,
    headline,
    label,
    plain,
)
from orthaug.reports.page_blocks import regressor_label
from orthaug.reports.recovery import RecoverResult, relative_errors

_UPRIGHT = 11  # letters of a name that fit above one cell
_CELL, _LINE = 0.8, 0.17  # inches of a cell, and of a line of the title


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
            own.bar(np.arange(1, len(test.acf)), floats(test.acf[1:]), color=BLUE, width=0.6)
            own.axhspan(-test.acf_band, test.acf_band, color=GREY, alpha=0.5)
        label(own, x="lag [samples]", y="autocorrelation")
        _correlations(crossed, test)
        label(crossed, x="lag behind the input [samples]", y="correlation with the inputs")
        for name, curve in test.strongest.items():
            centres, means, errors = (
                floats(values) for values in (curve.centres, curve.means, curve.errors)
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
            floats(cross.values),
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
    title = "\n".join(
        [
            "bias of each parameter, % of its value, by each term that may be missing",
            *shown.sizes,
            f"Colours are logarithmic. {shown.left_out}".strip(),
        ]
    )
    width = max(
        left + _CELL * len(shown.parameters) + RIGHT,
        SIZE[0],
        0.08 * max(map(len, title.split("\n"))),
    )
    top = TOP + _LINE * max(title.count("\n") - 1, 0)
    figure = Figure(figsize=(width, top + bottom + 0.28 * len(shown.suspects)))
    ((axis,),) = grid(figure, 1, 1, left=left, bottom=bottom, top=top)
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


@plain
def recovery_figure(result: RecoverResult) -> Figure:
    """Draw each parameter's estimates and intervals over the draws, in errors of its true value.

    Draws with the same term are side by side.
    """
    names = [row.name for row in result.parameters]
    order = sorted(range(len(result.outcomes)), key=lambda i: (result.outcomes[i].term, i))
    figure = Figure(figsize=(SIZE[0] * 1.3, TOP + 1.7 * len(names) + 1.1))
    axes = grid(figure, len(names), 1, bottom=BOTTOM + 1.1, gap=(0.42, 0.5), sharex=True)
    headline(figure, f"rehearsal: {result.draws} draws with a known truth")
    place = np.arange(len(order))
    for axis, row in zip(axes[:, 0], result.parameters, strict=True):
        value, plain_limits, wide = (part[order] for part in relative_errors(result, row.name))
        axis.axhline(0.0, color=BLACK, linewidth=0.8)
        ends = 100 * wide
        axis.vlines(place, *ends.T, color=GREY, linewidth=5, label="with the bias")
        missed = ~((plain_limits[:, 0] <= 0) & (plain_limits[:, 1] >= 0))
        for own, colour, marker, words in (
            (~missed, BLUE, "o", "interval holds the truth"),
            (missed, ORANGE, "s", "interval misses it, or there is none"),
        ):
            ends = 100 * plain_limits[own]
            axis.vlines(place[own], ends[:, 0], ends[:, 1], color=colour, linewidth=1.6)
            at = place[own], 100 * value[own]
            axis.plot(*at, marker, color=colour, markersize=3.5, label=words)
        held = f"{row.held} of {row.shown} hold the truth, {row.held_with_bias} with the bias"
        axis.set_title(f"{row.name}: {held}", fontsize=9, loc="left", fontweight="bold")
        label(axis, y="error [%]")
    terms = [result.outcomes[i].term for i in order]
    first = [k for k, term in enumerate(terms) if k == 0 or term != terms[k - 1]]
    for axis in axes[:, 0]:
        for k in first[1:]:
            axis.axvline(k - 0.5, color=GREY, linewidth=0.5)
    short = [cut(terms[k], 26) for k in first]
    axes[-1, 0].set_xticks(first, short, rotation=30, ha="right", fontsize=7)
    drawn, words = axes[0, 0].get_legend_handles_labels()
    figure.legend(drawn, words, fontsize=7, ncols=3, frameon=False, loc="lower center")
    return figure
