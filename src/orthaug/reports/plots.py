"""Figures of results. They show what a result holds, and compute nothing else."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec

import numpy as np

from orthaug._base.errors import InputError
from orthaug.models.response import Response
from orthaug.reports.findings import ResidualTestResult, SuspectResult
from orthaug.reports.result import RowResult

try:
    from matplotlib import rc_context, rcParams, rcParamsDefault
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
except UnicodeDecodeError:
    raise InputError("matplotlibrc: found letters that are not UTF-8; mend that file, or remove it.") from None

# Okabe-Ito: told apart by every reader
_BLACK, _GREY, _BLUE, _ORANGE, _GREEN = "#000000", "#B8B8B8", "#0072B2", "#E69F00", "#009E73"
_CYCLE = (_BLUE, _ORANGE, _GREEN, _BLACK)
_KINDS = ("prediction", "simulation")
_MOST_NUMBERS = 200  # in a heat map: of more the colours alone are shown
_WINDOW = 250  # samples of a long record that are shown, so that single swings can be seen
Drawn = ParamSpec("Drawn")
_SIZE = (7.0, 2.4)  # inches per panel
_LEFT, _RIGHT, _TOP, _BOTTOM, _GAP = 0.95, 0.15, 0.6, 0.5, 0.32  # inches around panels and between them
_TITLE, _YLABEL, _XLABEL = 0.1, 0.72, 0.26  # inches from the figure's edge or the panel's
_SHARPNESS = 160  # pixels per inch
_COLUMNS = round(_SIZE[0] * _SHARPNESS)  # more points than these cannot be told apart


def _own_style() -> AbstractContextManager[None]:
    """Figures look the same whatever the user's own settings of matplotlib are; a `$` in a unit begins no formula."""
    own: dict[Any, Any] = {key: value for key, value in rcParamsDefault.items() if not key.startswith("backend")}
    own |= {"text.parse_math": False}
    return rc_context({key: value for key, value in own.items() if rcParams[key] != value})


def _plain(draw: Callable[Drawn, Figure]) -> Callable[Drawn, Figure]:
    """Figures in our own style."""

    @wraps(draw)
    def drawn(*arguments: Drawn.args, **options: Drawn.kwargs) -> Figure:
        with _own_style():
            return draw(*arguments, **options)

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
        _label(upper, y=channel.label)
        _label(lower, y="difference" + (f" [{channel.unit}]" if channel.unit else ""))
        _legend(upper)
    _label(axes[-1], x="time [s]")
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
        axis.plot(*_outline(time, residual), color=_BLUE, linewidth=0.6)
        axis.axhline(0.0, color=_BLACK, linewidth=0.6)
        _label(axis, y=f"residual of {channel.label}")
    _label(axes[-1], x="time [s]")
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
            _label(axis, y=part + unit)
            _legend(axis)
    _label(axes[-1], x="time [s]")
    return figure


@_plain
def residual_analysis_figure(tests: Sequence[ResidualTestResult], title: str) -> Figure:
    """Of each residual: autocorrelation, correlation with the inputs, means over its most telling regressor."""
    figure = Figure(figsize=(_SIZE[0] * 1.3, _TOP + 2.6 * len(tests)))
    axes = _grid(figure, len(tests), 3, gap=(_BOTTOM + 0.3, 0.7))
    _headline(figure, f"{title}: 99 % bands")
    for row, test in zip(axes, tests, strict=True):
        if test.acf is not None and test.acf_band is not None:
            row[0].bar(np.arange(1, len(test.acf)), _floats(test.acf[1:]), color=_BLUE, width=0.6)
            row[0].axhspan(-test.acf_band, test.acf_band, color=_GREY, alpha=0.5)
        _label(row[0], x="lag", y=f"residual of {test.name}", title="autocorrelation")
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
        _label(row[1], x="lag behind the input", title="correlation with the inputs")
        curves = {name: (curve.share or 0.0, curve) for name, curve in test.regressors.items() if curve is not None}
        if curves:
            name = max(curves, key=lambda key: curves[key][0])
            share, curve = curves[name]
            centres, means, errors = (_floats(values) for values in (curve.centres, curve.means, curve.errors))
            row[2].errorbar(centres, means, 2.576 * errors, fmt="o", color=_GREEN, markersize=3)
            row[2].axhline(0.0, color=_BLACK, linewidth=0.6)
            _label(row[2], x=name, title=f"mean over {name}, {100 * share:.2g} % explained")
    return figure


@_plain
def bias_figure(suspects: Sequence[SuspectResult]) -> Figure:
    """Heat map of the bias of each parameter by each suspect, in per cent."""
    names, labels = list(suspects[0].percent), [suspect.name for suspect in suspects]
    shares = np.array([_floats([suspect.percent[name] for name in names]) for suspect in suspects])
    written = shares.size <= _MOST_NUMBERS
    left, bottom = 0.3 + 0.075 * max(map(len, labels)), _BOTTOM if written else 0.3 + 0.09 * max(map(len, names))
    width, height = left + (0.8 if written else 0.18) * len(names), _TOP + bottom + 0.28 * len(suspects)
    figure = Figure(figsize=(max(width + _RIGHT, _SIZE[0]), height))
    ((axis,),) = _grid(figure, 1, 1, left=left, bottom=bottom)
    signed = np.sign(shares) * np.log10(1 + np.abs(shares))  # biases of 0.1 % and of 100 % both show
    reach = max(float(np.nanmax(np.abs(signed), initial=0.0)), 1e-12)
    axis.imshow(signed, cmap="PuOr", vmin=-reach, vmax=reach, aspect="auto")
    for i, j in np.ndindex(*shares.shape) if written else ():
        if np.isfinite(shares[i, j]):
            dark = abs(signed[i, j]) > 0.6 * reach
            color = "white" if dark else _BLACK
            axis.text(j, i, f"{shares[i, j]:+.2g}", ha="center", va="center", fontsize=7, color=color)
    axis.set_xticks(range(len(names)), names, rotation=0 if written else 90)
    axis.set_yticks(range(len(suspects)), labels, fontsize=8)
    axis.tick_params(length=0)
    axis.grid(visible=False)
    axis.spines[:].set_visible(False)
    _headline(figure, "bias of each parameter [%] by terms that may be missing (without a guess: of 1 % of the output)")
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
        figure.set_dpi(_SHARPNESS)
        if kind == "png":
            FigureCanvasAgg(figure).print_png(path, pil_kwargs={"compress_level": 2})  # `savefig` would draw it twice
        else:
            figure.savefig(path, format=kind)


def _panels(response: Response, title: str, heights: tuple[int, ...] = (1,)) -> tuple[Figure, list]:
    """Stacked axes, `len(heights)` per output."""
    ratios = heights * len(response.outputs)
    figure = Figure(figsize=(_SIZE[0], _TOP + _SIZE[1] * sum(ratios) / max(heights)))
    axes = _grid(figure, len(ratios), 1, sharex=True, height_ratios=ratios)[:, 0]
    _headline(figure, title)
    return figure, list(axes)


def _grid(
    figure: Figure,
    rows: int,
    columns: int,
    *,
    gap: tuple[float, float] = (_GAP, _GAP),
    left: float = _LEFT,
    bottom: float = _BOTTOM,
    **options: Any,
) -> np.ndarray:
    """Panels (rows, columns) at fixed places; a layout found from the sizes of all texts takes longer than drawing.

    Args:
        gap: inches between rows and columns; `left` and `bottom` those beside and below them.
    """
    width, height = figure.get_size_inches()
    high, wide = height - _TOP - bottom, width - left - _RIGHT
    place = {"left": left / width, "right": 1 - _RIGHT / width, "bottom": bottom / height, "top": 1 - _TOP / height}
    place["hspace"] = gap[0] * rows / max(high - gap[0] * (rows - 1), 0.1)
    place["wspace"] = gap[1] * columns / max(wide - gap[1] * (columns - 1), 0.1)
    axes = figure.subplots(rows, columns, squeeze=False, gridspec_kw=place, **options)
    for axis in axes.flat:
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    return axes


def _headline(figure: Figure, title: str) -> None:
    figure.suptitle(title, fontsize=10, y=1 - _TITLE / figure.get_size_inches()[1], va="top")


def _label(axis: Axes, *, x: str | None = None, y: str | None = None, title: str | None = None) -> None:
    """Labels at a fixed distance from the panel."""
    figure = axis.get_figure(root=True)
    assert figure is not None
    wide, high = axis.get_position().size * figure.get_size_inches()
    if x is not None:
        axis.set_xlabel(x)
        axis.xaxis.set_label_coords(0.5, -_XLABEL / high)
    if y is not None:
        axis.set_ylabel(y)
        axis.yaxis.set_label_coords(-_YLABEL / wide, 0.5)
    if title is not None:
        axis.set_title(title, fontsize=9, y=1.0)


def _outline(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A curve to draw: of a long one the least and the largest value in every column of pixels."""
    if len(values) <= 4 * _COLUMNS:
        return time, values
    starts = np.linspace(0, len(values), _COLUMNS, endpoint=False).astype(int)
    ends = np.stack([ufunc.reduceat(values, starts) for ufunc in (np.fmin, np.fmax)], axis=1)
    return np.repeat(time[starts], 2), ends.ravel()


def _extent(response: Response, rows: slice) -> str:
    """Which samples of the record are drawn, in words."""
    whole = len(response.trajectories[0].model)
    text = f"samples {rows.start} to {rows.stop - 1} of {whole}"
    return text + (f", first of {len(response.trajectories)} experiments" if len(response.trajectories) > 1 else "")


def _window(response: Response) -> tuple[np.ndarray, slice]:
    trajectory = response.trajectories[0]
    rows = slice(trajectory.start, min(trajectory.start + _WINDOW, len(trajectory.model)))
    return np.arange(rows.start, rows.stop) * response.sampling_time, rows


def _legend(axis: Axes) -> None:
    axis.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2, fontsize=8, frameon=False, ncols=2)
