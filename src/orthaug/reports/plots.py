"""Figures of results. They show what a result holds, and compute nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from orthaug._base.lines import percent
from orthaug.models.response import Response
from orthaug.reports.drawing import (
    BLACK,
    BLUE,
    BOTTOM,
    GREEN,
    GREY,
    ORANGE,
    RIGHT,
    SIZE,
    TOP,
    Figure,
    extent,
    grid,
    headline,
    label,
    legend,
    outline,
    panels,
    plain,
    save,
    window,
)
from orthaug.reports.findings import SuspectResult
from orthaug.reports.residual_tests import ResidualTestResult
from orthaug.reports.result import RowResult

__all__ = ["save"]

_CYCLE = (BLUE, ORANGE, GREEN, BLACK)
_KINDS = ("prediction", "simulation")
_MOST_NUMBERS = 200  # in a heat map: of more the colours alone are shown


@plain
def output_figure(response: Response, title: str) -> Figure:
    """Measured output against the model, and below it their difference, from the first value on."""
    trajectory = response.trajectories[0]
    time, rows = window(response)
    figure, axes = panels(response, f"{title}: {extent(response, rows)}", heights=(2, 1))
    for i, channel in enumerate(response.outputs):
        upper, lower = axes[2 * i], axes[2 * i + 1]
        if trajectory.measured is not None:
            upper.plot(time, trajectory.measured[rows, i], color=GREY, linewidth=2.6, label="measured")
            error = trajectory.measured[rows, i] - trajectory.model[rows, i]
            lower.plot(time, error, color=BLUE, linewidth=0.9)
        upper.plot(time, trajectory.model[rows, i], color=BLACK, linewidth=0.9, label="model")
        label(upper, y=channel.label)
        label(lower, y="difference" + (f" [{channel.unit}]" if channel.unit else ""))
        legend(upper)
    label(axes[-1], x="time [s]")
    return figure


@plain
def residual_figure(response: Response, title: str) -> Figure:
    """Measured minus model over the whole record, one panel per output."""
    trajectory = response.trajectories[0]
    figure, axes = panels(response, f"{title}: {extent(response, slice(trajectory.start, len(trajectory.model)))}")
    assert trajectory.measured is not None
    time = np.arange(len(trajectory.model)) * response.sampling_time
    for i, (axis, channel) in enumerate(zip(axes, response.outputs, strict=True)):
        residual = trajectory.measured[:, i] - trajectory.model[:, i]
        axis.plot(*outline(time, residual), color=BLUE, linewidth=0.6)
        axis.axhline(0.0, color=BLACK, linewidth=0.6)
        label(axis, y=f"residual of {channel.label}")
    label(axes[-1], x="time [s]")
    return figure


@plain
def components_figure(response: Response, title: str) -> Figure:
    """The baseline's and the learner's part of the model's output, each on its own scale; two panels per output."""
    time, rows = window(response)
    trajectory = response.trajectories[0]
    figure, axes = panels(response, f"{title}: {extent(response, rows)}", heights=(1, 1))
    for i, channel in enumerate(response.outputs):
        unit = f" [{channel.unit}]" if channel.unit else ""
        for axis, values, color, part, formula in (
            (axes[2 * i], trajectory.baseline, BLUE, "baseline", "φ θ"),
            (axes[2 * i + 1], trajectory.learner, GREEN, "learner", "f − φ θ_aux"),
        ):
            axis.plot(
                time, values[rows, i], color=color, linewidth=1.1, label=f"{part} part of {channel.name}, {formula}"
            )
            label(axis, y=part + unit)
            legend(axis)
    label(axes[-1], x="time [s]")
    return figure


@plain
def residual_analysis_figure(tests: Sequence[ResidualTestResult], title: str) -> Figure:
    """Of each residual: autocorrelation, correlation with the inputs, means over its most telling regressor."""
    figure = Figure(figsize=(SIZE[0] * 1.3, TOP + 2.6 * len(tests)))
    axes = grid(figure, len(tests), 3, gap=(BOTTOM + 0.3, 0.7))
    headline(figure, f"{title}: 99 % bands")
    for row, test in zip(axes, tests, strict=True):
        if test.acf is not None and test.acf_band is not None:
            row[0].bar(np.arange(1, len(test.acf)), _floats(test.acf[1:]), color=BLUE, width=0.6)
            row[0].axhspan(-test.acf_band, test.acf_band, color=GREY, alpha=0.5)
        label(row[0], x="lag", y=f"residual of {test.name}", title="autocorrelation")
        shown = [(name, cross) for name, cross in test.cross.items() if cross is not None]
        for (name, cross), color in zip(shown, _CYCLE, strict=False):
            reach = len(cross.values) // 2
            row[1].plot(
                np.arange(-reach, reach + 1), _floats(cross.values), ".-", color=color, linewidth=0.8, label=name
            )
        if shown:
            band = max(cross.band or 0.0 for _, cross in shown)
            row[1].axhspan(-band, band, color=GREY, alpha=0.5)
            row[1].legend(fontsize=8, frameon=False)
        label(row[1], x="lag behind the input", title="correlation with the inputs")
        curves = {name: (curve.share or 0.0, curve) for name, curve in test.regressors.items() if curve is not None}
        if curves:
            name = max(curves, key=lambda key: curves[key][0])
            share, curve = curves[name]
            centres, means, errors = (_floats(values) for values in (curve.centres, curve.means, curve.errors))
            row[2].errorbar(centres, means, 2.576 * errors, fmt="o", color=GREEN, markersize=3)
            row[2].axhline(0.0, color=BLACK, linewidth=0.6)
            label(row[2], x=name, title=f"mean over {name}, {percent(share)} explained")
    return figure


@plain
def bias_figure(suspects: Sequence[SuspectResult]) -> Figure:
    """Heat map of the bias of each parameter by each suspect, in per cent."""
    names, labels = list(suspects[0].percent), [suspect.name for suspect in suspects]
    shares = np.array([_floats([suspect.percent[name] for name in names]) for suspect in suspects])
    written = shares.size <= _MOST_NUMBERS
    left, bottom = 0.3 + 0.075 * max(map(len, labels)), BOTTOM if written else 0.3 + 0.09 * max(map(len, names))
    width, height = left + (0.8 if written else 0.18) * len(names), TOP + bottom + 0.28 * len(suspects)
    figure = Figure(figsize=(max(width + RIGHT, SIZE[0]), height))
    ((axis,),) = grid(figure, 1, 1, left=left, bottom=bottom)
    signed = np.sign(shares) * np.log10(1 + np.abs(shares))  # biases of 0.1 % and of 100 % both show
    reach = max(float(np.nanmax(np.abs(signed), initial=0.0)), 1e-12)
    axis.imshow(signed, cmap="PuOr", vmin=-reach, vmax=reach, aspect="auto")
    for i, j in np.ndindex(*shares.shape) if written else ():
        if np.isfinite(shares[i, j]):
            dark = abs(signed[i, j]) > 0.6 * reach
            color = "white" if dark else BLACK
            axis.text(j, i, f"{shares[i, j]:+.2g}", ha="center", va="center", fontsize=7, color=color)
    axis.set_xticks(range(len(names)), names, rotation=0 if written else 90)
    axis.set_yticks(range(len(suspects)), labels, fontsize=8)
    axis.tick_params(length=0)
    axis.grid(visible=False)
    axis.spines[:].set_visible(False)
    headline(figure, "bias of each parameter [%] by terms that may be missing (without a guess: of 1 % of the output)")
    return figure


@plain
def comparison_figure(rows: Sequence[RowResult]) -> Figure:
    """Scores and parameters of several ways of modelling, from the rows of a comparison.

    Upper panel: free-run and one-step NRMSE on the last part. Below, a panel per parameter with 95 % intervals.
    """
    names = [Path(row.name).name for row in rows]
    parameters = rows[0].parameters
    figure = Figure(figsize=(SIZE[0], 2.2 + 1.3 * len(parameters)), layout="constrained")
    axes = figure.subplots(1 + len(parameters), 1, sharex=True, squeeze=False)[:, 0]
    place = np.arange(len(rows))
    for kind, marker, color in zip(_KINDS, "os", (BLUE, ORANGE), strict=True):
        label = "one step" if kind == "prediction" else "free run"
        axes[0].plot(place, [_mean_nrmse(row, kind) for row in rows], marker, color=color, label=label)
    part = list(rows[0].scores)[-1] if rows[0].scores else ""
    axes[0].set_title(f"NRMSE on {part}, and parameters with their 95 % intervals (hollow: none)", fontsize=10, pad=20)
    axes[0].set_ylabel("NRMSE")
    axes[0].set_ylim(0, 1.15 * np.nanmax([0.0, *(_mean_nrmse(row, kind) for row in rows for kind in _KINDS)]) or 1.0)
    legend(axes[0])
    for axis, parameter in zip(axes[1:], parameters, strict=True):
        for i, row in enumerate(rows):
            entry = next((p for p in row.parameters if p.name == parameter.name), None)
            if entry is None or entry.value is None:
                continue
            interval = entry.ci95 if entry.ci95 and None not in entry.ci95 else None
            if interval:
                axis.plot([i, i], interval, "_-", color=GREEN, markersize=14)
            axis.plot([i], [entry.value], "o", color=GREEN, markerfacecolor=GREEN if interval else "white")
        axis.set_ylabel(f"{parameter.name} [{parameter.unit}]" if parameter.unit else parameter.name)
    for axis in axes:
        axis.margins(y=0.15)
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    axes[-1].set_xticks(place, names, rotation=15, ha="right")
    axes[-1].set_xlim(-0.5, len(rows) - 0.5)
    figure.align_ylabels()
    return figure


def _mean_nrmse(row: RowResult, kind: str) -> float:
    """RMS over outputs of the last part's NRMSE; NaN where there is none."""
    if not row.scores:
        return float("nan")
    nrmse = list(row.scores.values())[-1].kinds[kind].nrmse
    return float("nan") if nrmse is None or None in nrmse else float(np.sqrt(np.mean(np.square(_floats(nrmse)))))


def _floats(values: Sequence[float | None]) -> np.ndarray:
    """The numbers of a result, NaN for None."""
    return np.array(values, dtype=float)
