"""Figures of results; results in, figures out, nothing is computed here that a result does not hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from orthaug.model import Response

# Okabe-Ito: told apart by every reader
_BLACK, _BLUE, _ORANGE, _GREEN = "#000000", "#0072B2", "#E69F00", "#009E73"
_WINDOW = 250  # samples of a long record that are shown, so that single swings can be seen
_SIZE = (7.0, 2.4)  # inches per panel


def output_figure(response: Response, title: str) -> Figure:
    """Measured output against the model, a window from the first value on, one panel per output."""
    figure, axes = _panels(response, title)
    time, rows = _window(response)
    trajectory = response.trajectories[0]
    for i, (axis, channel) in enumerate(zip(axes, response.outputs, strict=True)):
        if trajectory.measured is not None:
            axis.plot(time, trajectory.measured[rows, i], color=_BLACK, linewidth=1.8, label="measured")
        axis.plot(time, trajectory.model[rows, i], color=_ORANGE, linewidth=1.1, label="model")
        axis.set_ylabel(channel.label)
        _legend(axis)
    axes[-1].set_xlabel("time [s]")
    return figure


def residual_figure(response: Response, title: str) -> Figure:
    """Measured minus model over the whole record, one panel per output."""
    figure, axes = _panels(response, title)
    trajectory = response.trajectories[0]
    assert trajectory.measured is not None
    time = np.arange(len(trajectory.model)) * response.sampling_time
    for i, (axis, channel) in enumerate(zip(axes, response.outputs, strict=True)):
        residual = trajectory.measured[:, i] - trajectory.model[:, i]
        axis.plot(time, residual, color=_BLUE, linewidth=0.6, rasterized=len(time) > 5000)
        axis.axhline(0.0, color=_BLACK, linewidth=0.6)
        axis.set_ylabel(f"residual of {channel.label}")
    axes[-1].set_xlabel("time [s]")
    return figure


def components_figure(response: Response, title: str) -> Figure:
    """The baseline's and the learner's part of the model's output, over the same window; two panels per output."""
    figure, axes = _panels(response, title, per_output=2)
    time, rows = _window(response)
    trajectory = response.trajectories[0]
    for i, channel in enumerate(response.outputs):
        upper, lower = axes[2 * i], axes[2 * i + 1]
        upper.plot(time, trajectory.baseline[rows, i], color=_BLUE, linewidth=1.2, label="baseline φθ")
        lower.plot(time, trajectory.learner[rows, i], color=_GREEN, linewidth=1.2, label="learner f − φθ_aux")
        for axis in (upper, lower):
            axis.set_ylabel(channel.label)
            _legend(axis)
    axes[-1].set_xlabel("time [s]")
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write a PNG that is sharp at column width."""
    figure.savefig(path, dpi=160)


def _panels(response: Response, title: str, per_output: int = 1) -> tuple[Figure, list]:
    count = per_output * len(response.outputs)
    figure = Figure(figsize=(_SIZE[0], _SIZE[1] * count + 0.5), layout="constrained")
    axes = list(figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0])
    for axis in axes:
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    figure.suptitle(title, fontsize=10)
    return figure, axes


def _window(response: Response) -> tuple[np.ndarray, slice]:
    trajectory = response.trajectories[0]
    rows = slice(trajectory.start, min(trajectory.start + _WINDOW, len(trajectory.model)))
    return np.arange(rows.start, rows.stop) * response.sampling_time, rows


def _legend(axis) -> None:  # noqa: ANN001  (a matplotlib Axes)
    axis.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2, fontsize=8, frameon=False, ncols=2)
