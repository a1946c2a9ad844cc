"""Figures of results. They show what a result holds, and compute nothing else."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import wraps
from pathlib import Path
from typing import ParamSpec

import numpy as np

from orthaug._base.errors import InputError
from orthaug.models.response import Response
from orthaug.reports.findings import ResidualTestResult, SuspectResult
from orthaug.reports.result import RowResult

try:
    from matplotlib import rc_context, rcParamsDefault
    from matplotlib.figure import Figure
    from matplotlib.text import Text
except UnicodeDecodeError:
    raise InputError("matplotlibrc: found letters that are not UTF-8; mend that file, or remove it.") from None

# Okabe-Ito: told apart by every reader
_BLACK, _GREY, _BLUE, _ORANGE, _GREEN = "#000000", "#B8B8B8", "#0072B2", "#E69F00", "#009E73"
_CYCLE = (_BLUE, _ORANGE, _GREEN, _BLACK)
_KINDS = ("prediction", "simulation")
_WINDOW = 250  # samples of a long record that are shown, so that single swings can be seen
Drawn = ParamSpec("Drawn")
_SIZE = (7.0, 2.4)  # inches per panel


def _own_style() -> AbstractContextManager[None]:
    """Figures look the same whatever the user's own settings of matplotlib are."""
    return rc_context({key: value for key, value in rcParamsDefault.items() if not key.startswith("backend")})


def _plain(draw: Callable[Drawn, Figure]) -> Callable[Drawn, Figure]:
    """Figures whose text is shown as it is: a `$` in a unit or name begins no formula."""

    @wraps(draw)
    def drawn(*arguments: Drawn.args, **options: Drawn.kwargs) -> Figure:
        with _own_style():
            figure = draw(*arguments, **options)
        for text in figure.findobj(Text):
            text.set_parse_math(False)  # type: ignore[attr-defined]
        return figure

    return drawn


@_plain
def output_figure(response: Response, title: str) -> Figure:
    """Measured output against the model, and below it their difference, from the first value on."""
    trajectory = response.trajectories[0]
    time, rows = _window(response)
    figure, axes = _panels(response, f"{title}: {_extent(response, rows)}", heights=(2, 1))
    for i, channel in enumerate(response.outputs):
        upper, lower = axes[2 * i], axes[2 * i + 1]
        if trajectory.measured is not None:
            upper.plot(time, trajectory.measured[rows, i], color=_GREY, linewidth=2.6, label="measured")
            error = trajectory.measured[rows, i] - trajectory.model[rows, i]
            lower.plot(time, error, color=_BLUE, linewidth=0.9)
        upper.plot(time, trajectory.model[rows, i], color=_BLACK, linewidth=0.9, label="model")
        upper.set_ylabel(channel.label)
        lower.set_ylabel("difference" + (f" [{channel.unit}]" if channel.unit else ""))
        _legend(upper)
    axes[-1].set_xlabel("time [s]")
    figure.align_ylabels()
    return figure


@_plain
def residual_figure(response: Response, title: str) -> Figure:
    """Measured minus model over the whole record, one panel per output."""
    trajectory = response.trajectories[0]
    figure, axes = _panels(response, f"{title}: {_extent(response, slice(trajectory.start, len(trajectory.model)))}")
    assert trajectory.measured is not None
    time = np.arange(len(trajectory.model)) * response.sampling_time
    for i, (axis, channel) in enumerate(zip(axes, response.outputs, strict=True)):
        residual = trajectory.measured[:, i] - trajectory.model[:, i]
        axis.plot(time, residual, color=_BLUE, linewidth=0.6, rasterized=len(time) > 5000)
        axis.axhline(0.0, color=_BLACK, linewidth=0.6)
        axis.set_ylabel(f"residual of {channel.label}")
    axes[-1].set_xlabel("time [s]")
    return figure


@_plain
def components_figure(response: Response, title: str) -> Figure:
    """The baseline's and the learner's part of the model's output, each on its own scale; two panels per output."""
    time, rows = _window(response)
    trajectory = response.trajectories[0]
    figure, axes = _panels(response, f"{title}: {_extent(response, rows)}", heights=(1, 1))
    for i, channel in enumerate(response.outputs):
        unit = f" [{channel.unit}]" if channel.unit else ""
        for axis, values, color, part, formula in (
            (axes[2 * i], trajectory.baseline, _BLUE, "baseline", "φ θ"),
            (axes[2 * i + 1], trajectory.learner, _GREEN, "learner", "f − φ θ_aux"),
        ):
            axis.plot(
                time, values[rows, i], color=color, linewidth=1.1, label=f"{part} part of {channel.name}, {formula}"
            )
            axis.set_ylabel(part + unit)
            _legend(axis)
    axes[-1].set_xlabel("time [s]")
    figure.align_ylabels()
    return figure


@_plain
def residual_analysis_figure(tests: Sequence[ResidualTestResult], title: str) -> Figure:
    """Of each residual: autocorrelation, correlation with the inputs, means over its most telling regressor."""
    figure = Figure(figsize=(_SIZE[0] * 1.3, 0.5 + 2.6 * len(tests)), layout="constrained")
    axes = figure.subplots(len(tests), 3, squeeze=False)
    figure.suptitle(f"{title}: 99 % bands", fontsize=10)
    for row, test in zip(axes, tests, strict=True):
        if test.acf is not None and test.acf_band is not None:
            row[0].bar(np.arange(1, len(test.acf)), _floats(test.acf[1:]), color=_BLUE, width=0.6)
            row[0].axhspan(-test.acf_band, test.acf_band, color=_GREY, alpha=0.5)
        row[0].set_ylabel(f"residual of {test.name}")
        row[0].set_xlabel("lag")
        row[0].set_title("autocorrelation", fontsize=9)
        shown = [(name, cross) for name, cross in test.cross.items() if cross is not None]
        for (name, cross), color in zip(shown, _CYCLE, strict=False):
            reach = len(cross.values) // 2
            row[1].plot(
                np.arange(-reach, reach + 1), _floats(cross.values), ".-", color=color, linewidth=0.8, label=name
            )
        if shown:
            band = max(cross.band or 0.0 for _, cross in shown)
            row[1].axhspan(-band, band, color=_GREY, alpha=0.5)
            row[1].legend(fontsize=8, frameon=False)
        row[1].set_xlabel("lag behind the input")
        row[1].set_title("correlation with the inputs", fontsize=9)
        curves = {name: (curve.share or 0.0, curve) for name, curve in test.regressors.items() if curve is not None}
        if curves:
            name = max(curves, key=lambda key: curves[key][0])
            share, curve = curves[name]
            centres, means, errors = (_floats(values) for values in (curve.centres, curve.means, curve.errors))
            row[2].errorbar(centres, means, 2.576 * errors, fmt="o", color=_GREEN, markersize=3)
            row[2].axhline(0.0, color=_BLACK, linewidth=0.6)
            row[2].set_xlabel(name)
            row[2].set_title(f"mean over {name}, {100 * share:.2g} % explained", fontsize=9)
        for axis in row:
            axis.grid(alpha=0.25)
            axis.spines[["top", "right"]].set_visible(False)
    return figure


@_plain
def bias_figure(suspects: Sequence[SuspectResult]) -> Figure:
    """Heat map of the bias of each parameter by each suspect, in per cent."""
    names, labels = list(suspects[0].percent), [suspect.name for suspect in suspects]
    shares = np.array([_floats([suspect.percent[name] for name in names]) for suspect in suspects])
    width, height = 2.6 + 0.8 * len(names) + 0.05 * max(map(len, labels)), 1.2 + 0.28 * len(suspects)
    figure = Figure(figsize=(max(width, _SIZE[0]), height), layout="constrained")
    axis = figure.subplots()
    signed = np.sign(shares) * np.log10(1 + np.abs(shares))  # biases of 0.1 % and of 100 % both show
    reach = max(float(np.nanmax(np.abs(signed), initial=0.0)), 1e-12)
    axis.imshow(signed, cmap="PuOr", vmin=-reach, vmax=reach, aspect="auto")
    for i, j in np.ndindex(*shares.shape):
        if np.isfinite(shares[i, j]):
            dark = abs(signed[i, j]) > 0.6 * reach
            color = "white" if dark else _BLACK
            axis.text(j, i, f"{shares[i, j]:+.2g}", ha="center", va="center", fontsize=7, color=color)
    axis.set_xticks(range(len(names)), names)
    axis.set_yticks(range(len(suspects)), labels, fontsize=8)
    axis.tick_params(length=0)
    axis.spines[:].set_visible(False)
    title = "bias of each parameter [%] by terms that may be missing (without a guess: of 1 % of the output)"
    figure.suptitle(title, fontsize=10)
    return figure


@_plain
def comparison_figure(rows: Sequence[RowResult]) -> Figure:
    """Scores and parameters of several ways of modelling, from the rows of a comparison.

    Upper panel: free-run and one-step NRMSE on the last part. Below, a panel per parameter with 95 % intervals.
    """
    names = [Path(row.name).name for row in rows]
    parameters = rows[0].parameters
    figure = Figure(figsize=(_SIZE[0], 2.2 + 1.3 * len(parameters)), layout="constrained")
    axes = figure.subplots(1 + len(parameters), 1, sharex=True, squeeze=False)[:, 0]
    place = np.arange(len(rows))
    for kind, marker, color in zip(_KINDS, "os", (_BLUE, _ORANGE), strict=True):
        label = "one step" if kind == "prediction" else "free run"
        axes[0].plot(place, [_mean_nrmse(row, kind) for row in rows], marker, color=color, label=label)
    part = list(rows[0].scores)[-1] if rows[0].scores else ""
    axes[0].set_title(f"NRMSE on {part}, and parameters with their 95 % intervals (hollow: none)", fontsize=10, pad=20)
    axes[0].set_ylabel("NRMSE")
    axes[0].set_ylim(0, 1.15 * np.nanmax([0.0, *(_mean_nrmse(row, kind) for row in rows for kind in _KINDS)]) or 1.0)
    _legend(axes[0])
    for axis, parameter in zip(axes[1:], parameters, strict=True):
        for i, row in enumerate(rows):
            entry = next((p for p in row.parameters if p.name == parameter.name), None)
            if entry is None or entry.value is None:
                continue
            interval = entry.ci95 if entry.ci95 and None not in entry.ci95 else None
            if interval:
                axis.plot([i, i], interval, "_-", color=_GREEN, markersize=14)
            axis.plot([i], [entry.value], "o", color=_GREEN, markerfacecolor=_GREEN if interval else "white")
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


def save(figure: Figure, path: Path, kind: str = "png") -> None:
    """Write a figure that is sharp at column width; `kind` is also pdf or svg."""
    with warnings.catch_warnings(), _own_style():
        warnings.simplefilter("ignore")  # such as a unit in letters that the font lacks
        figure.savefig(path, dpi=160, format=kind)


def _panels(response: Response, title: str, heights: tuple[int, ...] = (1,)) -> tuple[Figure, list]:
    """Stacked axes, `len(heights)` per output."""
    ratios = heights * len(response.outputs)
    figure = Figure(figsize=(_SIZE[0], 0.5 + _SIZE[1] * sum(ratios) / max(heights)), layout="constrained")
    axes = list(figure.subplots(len(ratios), 1, sharex=True, squeeze=False, height_ratios=ratios)[:, 0])
    for axis in axes:
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    figure.suptitle(title, fontsize=10)
    return figure, axes


def _extent(response: Response, rows: slice) -> str:
    """Which samples of the record are drawn, in words."""
    whole = len(response.trajectories[0].model)
    text = f"samples {rows.start} to {rows.stop - 1} of {whole}"
    return text + (f", first of {len(response.trajectories)} experiments" if len(response.trajectories) > 1 else "")


def _window(response: Response) -> tuple[np.ndarray, slice]:
    trajectory = response.trajectories[0]
    rows = slice(trajectory.start, min(trajectory.start + _WINDOW, len(trajectory.model)))
    return np.arange(rows.start, rows.stop) * response.sampling_time, rows


def _legend(axis) -> None:  # noqa: ANN001  (a matplotlib Axes)
    axis.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2, fontsize=8, frameon=False, ncols=2)
