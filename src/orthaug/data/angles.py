"""Outputs that jump: angles that wrap, as from 180 to −180 degrees, and counters that are reset."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import Warning
from orthaug._base.lines import plural
from orthaug.data.gaps import Mending
from orthaug.data.record import Record

_PERIODS = (2 * np.pi, 360.0, *(2.0**n for n in range(8, 25)))  # rad, degrees, an encoder's counts
_OFF = 3.0  # times the largest other step, by which a jump misses the period
_SMOOTH = 0.25  # of the period: the largest step of an angle that is sampled fast enough
_COVERED = 0.97  # of the period, which the samples cover
_RARELY = 0.2  # of the steps are jumps, at most
_SPIKE = 2  # rows, behind which a signal that jumped back was a wrong sample
_BETWEEN = 0.05  # of the samples, at least, in the middle half: no signal that switches
_APART = 20.0  # times the largest other step of a signal that is a jump
_FEW = 0.005  # of the steps are such jumps, at most
_BEFORE = 5  # rows before a jump, in which an input may cause it
_STEPS = 1.5  # times the largest step of an input elsewhere that causes a jump


@dataclass(frozen=True)
class Wrap:
    """An angle that jumps by a `period` at `count` places, the first behind `row`."""

    period: float
    count: int
    row: int


def find_wrap(samples: Vector) -> Wrap | None:
    """Return how a signal wraps; None for one that does not.

    All its steps of more than half a period are a period, as nearly as its other steps are small,
    and its samples cover a period and no more.
    """
    there = np.flatnonzero(np.isfinite(samples))
    values = samples[there]
    if len(values) < 3:
        return None
    covered, steps = float(np.ptp(values)), np.diff(values)
    jumps = np.abs(steps) > 0.5 * covered
    count, usual = int(jumps.sum()), float(np.abs(steps[~jumps]).max(initial=0.0))
    if not 0 < count <= _RARELY * len(steps) or not 0 < usual < _SMOOTH * covered:
        return None
    pairs = np.flatnonzero(jumps)[: count // 2 * 2].reshape(-1, 2)
    if count % 2 == 0 and all(b - a <= _SPIKE and steps[a] * steps[b] < 0 for a, b in pairs):
        return None  # wrong samples
    if np.mean(np.abs(values - (values.min() + values.max()) / 2) < covered / 4) < _BETWEEN:
        return None
    for period in _PERIODS:
        near = np.abs(np.abs(steps[jumps]) - period) <= _OFF * usual
        if near.all() and _COVERED * period <= covered <= period + usual:
            return Wrap(period, count, int(there[:-1][jumps][0]))
    return None


def wrapped_angles(record: Record) -> list[Mending]:
    """Return a warning of each output that is an angle and wraps."""
    found = []
    for j, output in enumerate(record.outputs):
        wraps = [(one, find_wrap(one.outputs[:, j])) for one in record.experiments]
        known = [(one, wrap) for one, wrap in wraps if wrap is not None]
        if not known:
            continue
        experiment, first = known[0]
        count, period = sum(wrap.count for _, wrap in known), f"{first.period:.10g}"
        text = (
            f"{output.name} jumps by about {period} at {plural(count, 'row')}, first behind "
            f"{experiment.where(first.row)}: it is an angle that wraps. A model's angle does not "
            "wrap, so that each jump counts as an error and moves the parameters. Give "
            f'`[[data.prepare]]` with `step = "unwrap"`, `period = {period}` and '
            f'`channels = ["{output.name}"]`.'
        )
        step = {"step": "unwrap", "period": float(period), "channels": [output.name]}
        found.append(Mending(Warning("wrapped_angle", text), output.name, step))
    return found


def find_resets(samples: Vector, inputs: Matrix) -> list[int]:
    """Return the rows behind which a signal goes on elsewhere, though no input causes it.

    Few steps are many times larger than all others, the signal does not come back, and no input
    (N, nu) has a step shortly before that is larger than all others.
    """
    there = np.flatnonzero(np.isfinite(samples))
    if len(there) < 3:
        return []
    steps = np.abs(np.diff(samples[there]))
    most = max(1, int(_FEW * len(steps)))
    order = np.argsort(-steps)
    sizes = steps[order[: most + 1]]
    with np.errstate(over="ignore"):  # steps that are 0 but for rounding
        ratios = sizes[:-1] / np.maximum(sizes[1:], np.finfo(float).tiny)
    count = int(np.argmax(ratios)) + 1
    if not sizes[count] > 0 or sizes[count - 1] < _APART * sizes[count]:
        return []
    rows = np.sort(order[:count])
    if (np.diff(rows) <= _SPIKE).any():
        return []  # wrong samples
    moved, before = np.abs(np.diff(inputs, axis=0)), np.zeros(len(inputs) - 1, dtype=bool)
    for row, end in zip(there[rows], there[rows + 1], strict=True):
        before[max(row - _BEFORE, 0) : end] = True
    causes = moved[before].max(axis=0, initial=0.0) > _STEPS * moved[~before].max(axis=0, initial=0)
    if causes.any():
        return []
    return [int(row) for row in there[rows]]


def reset_warnings(record: Record) -> list[Warning]:
    """Return a warning of each output that goes on elsewhere within an experiment."""
    found = []
    for j, output in enumerate(record.outputs):
        for experiment in record.experiments:
            signal = experiment.outputs[:, j]
            rows = [] if find_wrap(signal) else find_resets(signal, experiment.inputs)
            if not rows:
                continue
            known = np.flatnonzero(np.isfinite(signal))
            steps = np.abs(np.diff(signal[known]))
            jumps = np.isin(known[:-1], rows)
            edges = [0, *(row + 1 for row in rows), len(signal)]
            first, stride = experiment.first_row, experiment.stride
            ranges = ", ".join(
                f"[{first + stride * a}, {first + stride * b}]"
                for a, b in zip(edges[:-1], edges[1:], strict=True)
            )
            text = (
                f"{output.name} jumps by {steps[jumps].max():.3g} at {plural(len(rows), 'row')}, "
                f"the first behind {experiment.where(rows[0])}, and by "
                f"{steps[~jumps].max():.3g} at most elsewhere, and no input moves more there than "
                "elsewhere. A counter was reset, or the file holds several recordings. Make each "
                f"piece an experiment of its own: `rows = [{ranges}]`."
            )
            found.append(Warning("reset_output", text))
    return found
