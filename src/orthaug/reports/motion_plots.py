"""Figures of fitted motions: the free run with and without learner, states, what acts in it, and what was learned."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from orthaug.data.record import Record
from orthaug.models.motion_field import parts_at
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
    grid,
    headline,
    label,
    legend,
    panels,
    plain,
    window,
)
from orthaug.reports.learned_part import LearnedPart, curve_limits, labels_with_units, trajectory_of

if TYPE_CHECKING:
    from orthaug.models.motion_model import MotionModel

_COLUMNS = 3  # panels beside each other


@plain
def run_figure(response: Response, title: str, *, learns: bool) -> Figure:
    """Measured output, model and, where something was learned, the model without its learner; below, differences."""
    trajectory = response.trajectories[0]
    time, rows = window(response)
    figure, axes = panels(response, f"{title}: {extent(response, rows)}", heights=(2, 1))
    drawn = [("model", trajectory.model, BLACK, "-")]
    drawn = [("model without its learner", trajectory.baseline, ORANGE, "--"), *drawn] if learns else drawn
    for i, channel in enumerate(response.outputs):
        upper, lower = axes[2 * i], axes[2 * i + 1]
        if trajectory.measured is not None:
            upper.plot(time, trajectory.measured[rows, i], color=GREY, linewidth=2.6, label="measured")
        for name, values, color, style in drawn:
            upper.plot(time, values[rows, i], style, color=color, linewidth=0.9, label=name)
            if trajectory.measured is not None:
                error = trajectory.measured[rows, i] - values[rows, i]
                lower.plot(time, error, style, color=BLUE if name == "model" else color, linewidth=0.9)
        label(upper, y=channel.label)
        label(lower, y="difference" + (f" [{channel.unit}]" if channel.unit else ""))
        legend(upper)
    label(axes[-1], x="time [s]")
    return figure


@plain
def states_figure(model: MotionModel, record: Record, title: str) -> Figure:
    """Every state along the free run of the first experiment."""
    states, _ = trajectory_of(model, record)
    motion = model.form.motion
    rows = slice(0, min(len(states), 250))
    time = np.arange(rows.stop) * model.sampling_time
    figure, axes = _stacked(len(motion.states), f"{title}: samples 0 to {rows.stop - 1}")
    for axis, state, values in zip(axes, motion.states, states.T, strict=True):
        axis.plot(time, values[rows], color=BLUE, linewidth=1.1)
        label(axis, y=_with_unit(state.name, state.unit))
    label(axes[-1], x="time [s]")
    return figure


@plain
def parts_figure(model: MotionModel, record: Record, title: str) -> Figure:
    """Of each learned equation and output what the physics gives, and what is learned beside it, along the free run."""
    states, inputs = trajectory_of(model, record)
    rows = slice(0, min(len(states), 250))
    physics, learner = parts_at(model.form, model.numbers, states[rows], inputs[rows])
    names = labels_with_units(model)
    time = np.arange(rows.stop) * model.sampling_time
    figure, axes = _stacked(2 * len(names), f"{title}: samples 0 to {rows.stop - 1}")
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
    """What was learned over each input of the learner: along the training run, and as a curve where that is one.

    The curve of a state or input is drawn with all others at their medians, dashed beyond the reach of the data.
    """
    values, names, seen = part.values, part.names, part.features
    columns = min(len(seen), _COLUMNS)
    rows = len(names) * -(-len(seen) // columns)
    figure = Figure(figsize=(SIZE[0] * (1 if columns == 1 else 1.3), TOP + 2.4 * rows))
    axes = grid(figure, rows, columns, gap=(0.75, 0.85))
    headline(figure, title)
    curves = [part.curve(feature) for feature in seen]
    for k, name in enumerate(names):
        for j, feature in enumerate(seen):
            row, column = divmod(j, columns)
            axis = axes[k * (rows // len(names)) + row, column]
            axis.plot(part.seen[:, j], values[:, k], ".", color=GREY, markersize=6, label="training run")
            curve = curves[j]
            if curve is not None:
                along, inside, learned = curve.along, curve.inside, curve.learned[:, k]
                if curve.half is not None:
                    half = curve.half[:, k]
                    band = learned - half, learned + half
                    axis.fill_between(along, *band, color=GREEN, alpha=0.2, linewidth=0, label="95 % interval")
                axis.set_ylim(*curve_limits(curve, k, values[:, k]))
                axis.axvspan(along[inside][0], along[inside][-1], color=GREY, alpha=0.15, linewidth=0, zorder=0)
                axis.plot(along, learned, "--", color=GREEN, linewidth=1.0)
                axis.plot(along[inside], learned[inside], color=GREEN, linewidth=1.2, label="learner")
            label(axis, x=_with_unit(feature, part.units[j]), y=None if column else name)
    for axis in axes.flat:
        axis.set_visible(bool(axis.lines))
    told = max(axes[0], key=lambda axis: len(axis.get_legend_handles_labels()[1]))
    legend(axes[0, -1] if axes[0, -1].lines else told, *told.get_legend_handles_labels())
    return figure


def _with_unit(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


def _stacked(count: int, title: str) -> tuple[Figure, list]:
    """Panels below each other."""
    figure = Figure(figsize=(SIZE[0], TOP + 1.6 * count))
    axes = grid(figure, count, 1, sharex=True)[:, 0]
    headline(figure, title)
    return figure, list(axes)
