"""Outputs that are angles and wrap, such as from 180 to −180 degrees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from orthaug._base.checks import Vector
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
