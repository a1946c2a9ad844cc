"""Figures of results: they draw the numbers of a result, and compute nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.lines import with_unit
from orthaug.data.record import Record, instants_of
from orthaug.models.model import Model
from orthaug.models.motion_field import parts_at
from orthaug.models.moving import MotionDynamics
from orthaug.models.response import Response
from orthaug.reports.drawing import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    SIZE,
    TOP,
    Figure,
    extent,
    floats,
    grid,
    headline,
    label,
    legend,
    outline,
    panels,
    plain,
    rule_axes,
    save,
    window,
)
from orthaug.reports.learned_part import LearnedPart, curve_limits, labels_with_units, trajectory_of
from orthaug.reports.page_blocks import parameter_label
from orthaug.reports.result import RowResult
from orthaug.reports.selection import SelectResult

if TYPE_CHECKING:
    import pandas as pd


__all__ = ["save"]

_KINDS = ("prediction", "simulation")
_BESIDE = 3  # panels beside each other
_SIZES = {
    "orders": "linear lags",
    "terms": "terms beside the physics",
    "learner": "weights of the network",
}
_WIDE = 5.0  # ratio of scores from which their axis is logarithmic
_OVER_TIME = "parameters over time with 95 % bands; vertical lines: the residual left its band"


@plain
def output_figure(response: Response, title: str, *, learns: bool = False) -> Figure:
    """Draw measured output and model, and below them their difference, from the first value on.

    Args:
        learns: draw the free run of a motion without its learner, too.
    """
    trajectory = response.trajectories[0]
    time, rows = window(response)
    figure, axes = panels(response, f"{title}: {extent(response, rows)}", heights=(2, 1))
    drawn = (
        [("model without its learner", trajectory.baseline, ORANGE, ORANGE, "--")] if learns else []
    )
    drawn.append(("model", trajectory.model, BLACK, BLUE, "-"))
    for i, channel in enumerate(response.outputs):
        upper, lower = axes[2 * i], axes[2 * i + 1]
        if trajectory.measured is not None:
            measured = outline(time, trajectory.measured[rows, i])
            upper.plot(*measured, color=GREY, linewidth=2.6, label="measured")
        for name, values, color, of_error, style in drawn:
            upper.plot(time, values[rows, i], style, color=color, linewidth=0.9, label=name)
            if trajectory.measured is not None:
                error = trajectory.measured[rows, i] - values[rows, i]
                lower.plot(*outline(time, error), style, color=of_error, linewidth=0.9)
        label(upper, y=channel.label)
        label(lower, y=with_unit("difference", channel.unit))
        legend(upper)
    label(axes[-1], x="time [s]")
    return figure


@plain
def residual_figure(response: Response, title: str) -> Figure:
    """Draw measured minus model over the whole record, one panel per output."""
    trajectory = response.trajectories[0]
    figure, axes = panels(
        response, f"{title}: {extent(response, slice(trajectory.start, len(trajectory.model)))}"
    )
    assert trajectory.measured is not None
    time = trajectory.time(response.sampling_time)
    for i, (axis, channel) in enumerate(zip(axes, response.outputs, strict=True)):
        residual = trajectory.measured[:, i] - trajectory.model[:, i]
        axis.plot(*outline(time, residual), color=BLUE, linewidth=0.6)
        axis.axhline(0.0, color=BLACK, linewidth=0.6)
        label(axis, y=f"residual of {channel.label}")
    label(axes[-1], x="time [s]")
    return figure


@plain
def components_figure(response: Response, title: str) -> Figure:
    """Draw the baseline's and the learner's part of the output, each on its own scale.

    Two panels per output.
    """
    time, rows = window(response)
    trajectory = response.trajectories[0]
    figure, axes = panels(response, f"{title}: {extent(response, rows)}", heights=(1, 1))
    for i, channel in enumerate(response.outputs):
        for axis, values, color, part, formula in (
            (axes[2 * i], trajectory.baseline, BLUE, "baseline", "φ θ"),
            (axes[2 * i + 1], trajectory.learner, GREEN, "learner", "f − φ θ_aux"),
        ):
            axis.plot(
                time,
                values[rows, i],
                color=color,
                linewidth=1.1,
                label=f"{part} part of {channel.name}, {formula}",
            )
            label(axis, y=with_unit(part, channel.unit))
            legend(axis)
    label(axes[-1], x="time [s]")
    return figure


@plain
def states_figure(model: Model[MotionDynamics], record: Record, title: str) -> Figure:
    """Draw every state along the free run of the first experiment."""
    states, _ = trajectory_of(model, record)
    motion = model.form.motion
    rows = slice(0, min(len(states), 250))
    time = instants_of(len(states), model.sampling_time, record.experiments[0].steps)[rows]
    figure, axes = _stack_panels(len(motion.states), f"{title}: samples 0 to {rows.stop - 1}")
    for axis, state, values in zip(axes, motion.states, states.T, strict=True):
        axis.plot(time, values[rows], color=BLUE, linewidth=1.1)
        label(axis, y=with_unit(state.name, state.unit))
    label(axes[-1], x="time [s]")
    return figure


@plain
def parts_figure(model: Model[MotionDynamics], record: Record, title: str) -> Figure:
    """Draw physics and learned part of each learned equation and output, along the free run."""
    states, inputs = trajectory_of(model, record)
    rows = slice(0, min(len(states), 250))
    physics, learner = parts_at(model.form, model.numbers, states[rows], inputs[rows])
    names = labels_with_units(model)
    time = instants_of(len(states), model.sampling_time, record.experiments[0].steps)[rows]
    figure, axes = _stack_panels(2 * len(names), f"{title}: samples 0 to {rows.stop - 1}")
    for i, name in enumerate(names):
        axes[2 * i].plot(time, physics[:, i], color=BLUE, linewidth=1.1, label="physics")
        axes[2 * i + 1].plot(time, learner[:, i], color=GREEN, linewidth=1.1, label="learner")
        for axis in axes[2 * i : 2 * i + 2]:
            label(axis, y=name)
            legend(axis)
    label(axes[-1], x="time [s]")
    return figure


@plain
def learner_figure(part: LearnedPart, title: str) -> Figure:
    """Draw the learned part over each input of the learner: along the training run, and as a curve.

    The curve is drawn where the input is a variable.

    The curve of a state or input is drawn with all others at their medians, dashed outside of the
    range of the data.
    """
    values, names, seen = part.values, part.names, part.features
    columns = min(len(seen), _BESIDE)
    rows = len(names) * -(-len(seen) // columns)
    figure = Figure(figsize=(SIZE[0] * (1 if columns == 1 else 1.3), TOP + 2.4 * rows))
    axes = grid(figure, rows, columns, gap=(0.75, 0.85))
    headline(figure, title)
    curves = [part.curve(feature) for feature in seen]
    for k, name in enumerate(names):
        for j, feature in enumerate(seen):
            row, column = divmod(j, columns)
            axis = axes[k * (rows // len(names)) + row, column]
            axis.plot(
                part.seen[:, j], values[:, k], ".", color=GREY, markersize=6, label="training run"
            )
            curve = curves[j]
            if curve is not None:
                along, inside, learned = curve.along, curve.inside, curve.learned[:, k]
                if curve.half is not None:
                    half = curve.half[:, k]
                    band = learned - half, learned + half
                    axis.fill_between(
                        along, *band, color=GREEN, alpha=0.2, linewidth=0, label="95 % interval"
                    )
                axis.set_ylim(*curve_limits(curve, k, values[:, k]))
                axis.axvspan(
                    along[inside][0],
                    along[inside][-1],
                    color=GREY,
                    alpha=0.15,
                    linewidth=0,
                    zorder=0,
                )
                axis.plot(along, learned, "--", color=GREEN, linewidth=1.0)
                axis.plot(
                    along[inside], learned[inside], color=GREEN, linewidth=1.2, label="learner"
                )
            label(axis, x=with_unit(feature, part.units[j]), y=None if column else name)
    for axis in axes.flat:
        axis.set_visible(bool(axis.lines))
    main = max(axes[0], key=lambda axis: len(axis.get_legend_handles_labels()[1]))
    legend(axes[0, -1] if axes[0, -1].lines else main, *main.get_legend_handles_labels())
    return figure


@plain
def comparison_figure(rows: Sequence[RowResult]) -> Figure:
    """Draw scores and parameters of several models, from the rows of a comparison.

    Upper panel: free-run and one-step NRMSE on the last part. Below, a panel per parameter with 95
    % intervals.
    """
    names = [Path(row.name).name for row in rows]
    parameters = rows[0].parameters
    figure = Figure(figsize=(SIZE[0], 2.2 + 1.3 * len(parameters)), layout="constrained")
    axes = figure.subplots(1 + len(parameters), 1, sharex=True, squeeze=False)[:, 0]
    place = np.arange(len(rows))
    for kind, marker, color in zip(_KINDS, "os", (BLUE, ORANGE), strict=True):
        label = "one step" if kind == "prediction" else "free run"
        axes[0].plot(
            place, [_mean_nrmse(row, kind) for row in rows], marker, color=color, label=label
        )
    part = list(rows[0].scores)[-1] if rows[0].scores else ""
    axes[0].set_title(
        f"NRMSE on {part}, and parameters with their 95 % intervals (hollow: none)",
        fontsize=10,
        pad=20,
    )
    axes[0].set_ylabel("NRMSE")
    axes[0].set_ylim(
        0,
        1.15 * np.nanmax([0.0, *(_mean_nrmse(row, kind) for row in rows for kind in _KINDS)])
        or 1.0,
    )
    legend(axes[0])
    for axis, parameter in zip(axes[1:], parameters, strict=True):
        for i, row in enumerate(rows):
            entry = next((p for p in row.parameters if p.name == parameter.name), None)
            if entry is None or entry.value is None:
                continue
            interval = entry.ci95 if entry.ci95 and None not in entry.ci95 else None
            if interval:
                axis.plot([i, i], interval, "_-", color=GREEN, markersize=14)
            axis.plot(
                [i], [entry.value], "o", color=GREEN, markerfacecolor=GREEN if interval else "white"
            )
        axis.set_ylabel(parameter_label(parameter))
    for axis in axes:
        rule_axes(axis).margins(y=0.15)
    axes[-1].set_xticks(place, names, rotation=15, ha="right")
    axes[-1].set_xlim(-0.5, len(rows) - 0.5)
    figure.align_ylabels()
    return figure


@plain
def selection_figure(result: SelectResult, unit: str) -> Figure:
    """Draw score against size, a panel for each stage, with the choice marked."""
    stages = list(dict.fromkeys(row.stage for row in result.models))
    figure = Figure(figsize=(SIZE[0], TOP + SIZE[1] * len(stages)))
    axes = grid(figure, len(stages), 1, gap=(0.55, 0.0))[:, 0]
    headline(figure, "error of free runs on blocks that were held out")
    for axis, stage in zip(axes, stages, strict=True):
        rows = [row for row in result.models if row.stage == stage and row.score is not None]
        size, score = (
            np.array([getattr(row, name) for row in rows], dtype=float)
            for name in ("size", "score")
        )
        error = np.array([row.standard_error or 0.0 for row in rows])
        within, chosen = (
            np.array([getattr(row, name) for row in rows], dtype=bool)
            for name in ("within", "chosen")
        )
        axis.errorbar(size, score, error, fmt="none", ecolor=GREY, elinewidth=0.8)
        axis.plot(size[~within], score[~within], "o", ms=4, color=BLACK, mfc="white", label="worse")
        axis.plot(size[within], score[within], "o", ms=4, color=BLUE, label="as good as the best")
        axis.plot(
            size[chosen],
            score[chosen],
            "s",
            ms=9,
            color=ORANGE,
            mfc="none",
            mew=1.6,
            label="chosen",
        )
        if len(score) and score.max() > _WIDE * score.min() > 0:
            axis.set_yscale("log", subs=(2, 5))
            axis.yaxis.set_major_formatter("{x:g}")
            axis.yaxis.set_minor_formatter("{x:g}")
        label(axis, x=_SIZES[stage], y=with_unit("RMS error", unit))
    legend(axes[0])
    return figure


@plain
def tracking_figure(
    history: pd.DataFrame,
    parameters: Sequence[object],
    alarms: Sequence[float],
    title: str | None = None,
    physical: pd.DataFrame | None = None,
    physical_parameters: Sequence[Any] = (),
) -> Figure:
    """Draw a panel for each parameter with its 95 % band, and the alarm below.

    Vertical lines mark when it was raised.

    Args:
        history: `Recursive.history`.
        parameters: θ, each with name and unit.
        alarms: instants [s].
        physical: `Recursive.physical_history`, drawn above θ, of the `physical_parameters`.
    """
    panels = [(physical, p) for p in physical_parameters if physical is not None]
    panels += [(history, p) for p in parameters]
    figure = Figure(figsize=(SIZE[0], TOP + 1.25 * (len(panels) + 1)))
    axes = grid(figure, len(panels) + 1, 1, sharex=True, gap=(0.16, 0.0))[:, 0]
    headline(figure, _OVER_TIME if title is None else title)
    for axis, (frame, parameter) in zip(axes, panels, strict=False):
        _band(axis, frame, parameter.name)
        label(axis, y=with_unit(parameter.name, parameter.unit))
    level = history["alarm"].to_numpy(dtype=float)
    axes[-1].plot(*outline(history["time"].to_numpy(), level), color=BLACK, linewidth=0.8)
    axes[-1].axhline(1.0, color=ORANGE, linewidth=0.9, linestyle="--")
    axes[-1].set_ylim(0, max(1.2, 1.05 * level.max(initial=0.0)))
    label(axes[-1], x="time [s]", y="alarm (limit 1)")
    for axis in axes:
        for instant in alarms:
            axis.axvline(instant, color=ORANGE, linewidth=0.9)
    return figure


def _band(axis: Any, frame: pd.DataFrame, name: str) -> None:
    """Draw a parameter over time, with limits from most of it: the first rows vary wildly."""
    time, value, low, high = (
        frame[key].to_numpy() for key in ("time", name, f"{name}_low", f"{name}_high")
    )
    axis.fill_between(time, low, high, color=GREY, alpha=0.6, linewidth=0)
    axis.plot(time, value, color=BLUE, linewidth=1.1)
    seen = np.concatenate([part[np.isfinite(part)] for part in (value, low, high)])
    if len(seen):
        bottom, top = np.percentile(seen, [0.5, 99.5])
        margin = 0.1 * (top - bottom) or 0.1 * abs(top) or 1.0
        axis.set_ylim(bottom - margin, top + margin)


def _mean_nrmse(row: RowResult, kind: str) -> float:
    """Return the RMS over outputs of the last part's NRMSE; NaN where there is none."""
    if not row.scores:
        return float("nan")
    nrmse = list(row.scores.values())[-1].kinds[kind].nrmse
    return (
        float("nan")
        if nrmse is None or None in nrmse
        else float(np.sqrt(np.mean(np.square(floats(nrmse)))))
    )


def _stack_panels(count: int, title: str) -> tuple[Figure, list]:
    """Return panels below each other."""
    figure = Figure(figsize=(SIZE[0], TOP + 1.6 * count))
    axes = grid(figure, count, 1, sharex=True)[:, 0]
    headline(figure, title)
    return figure, list(axes)
