"""Figures of fitted motions: the free run beside physics alone, states, what acts in it, and what was learned."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug.data.record import Record
from orthaug.models.motion_parts import labels_of, parts_at
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

if TYPE_CHECKING:
    from orthaug.models.motion_model import MotionModel

_MOST_POINTS = 2000  # of a cloud
_CURVE = 200  # points of a curve
_BEYOND = 0.2  # of the data's reach, drawn at each side of it
_COLUMNS = 3  # panels beside each other


@plain
def run_figure(response: Response, title: str, *, learns: bool) -> Figure:
    """Measured output, model and, where something was learned, physics alone; below it their differences."""
    trajectory = response.trajectories[0]
    time, rows = window(response)
    figure, axes = panels(response, f"{title}: {extent(response, rows)}", heights=(2, 1))
    drawn = [("model", trajectory.model, BLACK, "-")]
    drawn = [("physics alone", trajectory.baseline, ORANGE, "--"), *drawn] if learns else drawn
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
    states, _ = _trajectory(model, record)
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
    states, inputs = _trajectory(model, record)
    rows = slice(0, min(len(states), 250))
    physics, learner = parts_at(model.form, model.numbers, states[rows], inputs[rows])
    names = _labels(model)
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
def learner_figure(
    model: MotionModel, record: Record, title: str, reach: Callable[[Matrix, Matrix], Matrix | None] | None = None
) -> Figure:
    """What was learned over each input of the learner: along the training run, and as a curve where that is one.

    The curve of a state or input is drawn with all others at their medians, dashed beyond the reach of the data.

    Args:
        reach: half the length of its 95 % intervals (M, nl) at states and inputs; None where there are none.
    """
    states, inputs = _trajectory(model, record)
    chosen = np.linspace(0, len(states) - 1, min(len(states), _MOST_POINTS)).astype(int)
    states, inputs = states[chosen], inputs[chosen]
    with np.errstate(all="ignore"):
        features = np.asarray(model.form.seen(states.T, inputs.T, np))
    values = parts_at(model.form, model.numbers, states, inputs)[1]
    names, seen = _labels(model), [str(entry) for entry in model.form.features]
    columns = min(len(seen), _COLUMNS)
    rows = len(names) * -(-len(seen) // columns)
    figure = Figure(figsize=(SIZE[0] * (1 if columns == 1 else 1.3), TOP + 2.4 * rows))
    axes = grid(figure, rows, columns, gap=(0.75, 0.85))
    headline(figure, f"{title}, by the {model.measure} measure")
    for k, name in enumerate(names):
        for j, feature in enumerate(seen):
            row, column = divmod(j, columns)
            axis = axes[k * (rows // len(names)) + row, column]
            axis.plot(features[j], values[:, k], ".", color=GREY, markersize=6, label="training run")
            curve = _curve(model, states, inputs, feature)
            if curve is not None:
                along, inside, learned, (x, u) = curve
                half = None if reach is None else reach(x, u)
                low, high = _limits(learned[:, k], values[:, k])
                if half is not None:
                    band = learned[:, k] - half[:, k], learned[:, k] + half[:, k]
                    axis.fill_between(along, *band, color=GREEN, alpha=0.2, linewidth=0, label="95 % interval")
                    axis.set_ylim(low, high)
                axis.axvspan(along[inside][0], along[inside][-1], color=GREY, alpha=0.15, linewidth=0, zorder=0)
                axis.plot(along, learned[:, k], "--", color=GREEN, linewidth=1.0)
                axis.plot(along[inside], learned[inside, k], color=GREEN, linewidth=1.2, label="learner")
            label(axis, x=_with_unit(feature, _units(model).get(feature, "")), y=None if column else name)
    for axis in axes.flat:
        axis.set_visible(bool(axis.lines))
    told = max(axes[0], key=lambda axis: len(axis.get_legend_handles_labels()[1]))
    legend(axes[0, -1] if axes[0, -1].lines else told, *told.get_legend_handles_labels())
    return figure


def _limits(curve: Vector, cloud: Vector) -> tuple[float, float]:
    """What a panel shows: the curve and the cloud, not all of a band that widens where there are no data."""
    both = np.concatenate([curve, cloud])
    low, high = float(np.nanmin(both)), float(np.nanmax(both))
    margin = 0.15 * max(high - low, 1e-12)
    return low - margin, high + margin


def _curve(model: MotionModel, states: Matrix, inputs: Matrix, feature: str) -> tuple[Any, Any, Any, Any] | None:
    """Values of a state or input, which of them the data reach, what is learned there, and states and inputs there.

    None of an expression.
    """
    motion = model.form.motion
    names = (*motion.names_of_states, *motion.inputs)
    if feature not in names:
        return None
    points, place = np.concatenate([states, inputs], axis=1), names.index(feature)
    low, high = points[:, place].min(), points[:, place].max()
    beyond = _BEYOND * (high - low)
    along = np.linspace(low - beyond, high + beyond, _CURVE)
    rows = np.tile(np.median(points, axis=0), (_CURVE, 1))
    rows[:, place] = along
    x, u = np.split(rows, [states.shape[1]], axis=1)
    return along, (along >= low) & (along <= high), parts_at(model.form, model.numbers, x, u)[1], (x, u)


def _trajectory(model: MotionModel, record: Record) -> tuple[Matrix, Matrix]:
    """States and inputs of the free run of the first experiment, as far as it is finite."""
    record = model.fitting(record, need_outputs=False)
    frame = model.states(record)
    first = record.experiments[0]
    states = frame[list(model.form.motion.names_of_states)].to_numpy()[: len(first)]
    finite = np.isfinite(states).all(axis=1)
    end = len(states) if finite.all() else max(int(np.argmin(finite)), 1)
    return states[:end], np.asarray(first.inputs)[:end]


def _labels(model: MotionModel) -> list[str]:
    units = {channel.name: channel.unit for channel in model.outputs}
    return [_with_unit(name, unit or units.get(name, "")) for name, unit in labels_of(model.form)]


def _units(model: MotionModel) -> dict[str, str]:
    """Of states and inputs by name."""
    return {s.name: s.unit for s in model.form.motion.states} | {c.name: c.unit for c in model.inputs}


def _with_unit(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


def _stacked(count: int, title: str) -> tuple[Figure, list]:
    """Panels below each other."""
    figure = Figure(figsize=(SIZE[0], TOP + 1.6 * count))
    axes = grid(figure, count, 1, sharex=True)[:, 0]
    headline(figure, title)
    return figure, list(axes)
