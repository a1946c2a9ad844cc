"""Records whose outputs are missing on some rows: what tests can make of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import Warning
from orthaug._base.lines import percent
from orthaug.data.columns import Column
from orthaug.data.record import Experiment, Record, unbroken, without_gaps

_REGULAR = 0.8  # of the rows that lie in every n-th
_SHORTEST = 20  # rows of a stretch
SATURATED = 0.01  # of the rows, at an extreme value
_AT_LIMIT = 1e-3  # of the output's deviation: a model so close to an extreme value is there
_SAME_ROWS = 0.5  # of the rows where data or model are at a limit: both are


@dataclass(frozen=True)
class Mending:
    """A warning whose remedy is a step of preparation, with that as a spec declares it."""

    warning: Warning
    output: str
    step: dict[str, Any]
    rows: str = ""
    """Of samples at a limit: their values and shares of the rows."""


def regular_rows(there: Bool[np.ndarray, "N"]) -> slice | None:
    """Return the every n-th rows in which a slow sensor gives its values; None without such n."""
    at = np.flatnonzero(there)
    every = int(np.median(np.diff(at))) if len(at) > 2 else 1
    if every < 2:
        return None
    first = int(np.bincount(at % every).argmax())
    kept = there[first::every]
    if kept.mean() < _REGULAR or kept.sum() < _REGULAR * len(at):
        return None
    return slice(first, None, every)


def held_rows(samples: Vector) -> slice | None:
    """Return the every n-th rows at which a held signal is sampled anew; None without such n.

    Between them it repeats the row before. A sample that is by chance as the last one counts as
    sampled.
    """
    changed = np.concatenate([[False], samples[1:] != samples[:-1]])
    at = np.flatnonzero(changed)
    if len(at) < _SHORTEST or 2 * len(at) > len(samples):
        return None
    every = int(np.gcd.reduce(np.diff(at)))
    first = int(at[0]) % every
    if every < 2 or len(at) < _REGULAR * len(samples[first::every]):
        return None
    return slice(first, None, every)


def held_outputs(record: Record) -> list[Mending]:
    """Return a warning of each output that is sampled more slowly than the rows, and held."""
    found = []
    for j, output in enumerate(record.outputs):
        every = [held_rows(experiment.outputs[:, j]) for experiment in record.experiments]
        known = [rows for rows in every if rows is not None]
        if not known or len(known) < len(every) or len({rows.step for rows in known}) > 1:
            continue
        n, first = known[0].step, known[0].start
        place = record.experiments[0].where(first)
        late = (n - 1) / 2 * record.sampling_time
        text = (
            f"{output.name} changes in every {n}th row only ({place} and so on): its sensor is "
            f"slower than the rows, and its last value is held, {late:.3g} s old on average. A "
            "model then takes the age for a lag of the system, and parameters move. For a "
            f'[motion] mark repeats as missing (step = "repeats" in [[data.prepare]], `channels` '
            f'= ["{output.name}"]) and give `missing` = "keep". For lagged physics read these '
            f"rows only: `every` = {n}, `rows` from {first} on."
        )
        step = {"step": "repeats", "channels": [output.name]}
        found.append(Mending(Warning("held_output", text), output.name, step))
    return found


def saturated_outputs(
    record: Record, model: Matrix | None = None, limited: Sequence[str] = ()
) -> list[Mending]:
    """Return a warning of each output that stays at its largest or smallest value for many rows.

    Args:
        model: a free run's outputs (N, ny) on the rows of a complete record: a limit that it
            reaches on about the same rows is in the physics, and no warning is due.
        limited: names of outputs whose limits are known, as of what a controller sets.
    """
    found = []
    for j, output in enumerate(record.outputs):
        if output.name in limited:
            continue
        values = record.measured[j]
        limits = Column(output.name, output.name, output.unit, values).limits
        ends = [(value, rows) for value, rows in limits if rows >= SATURATED * len(values)]
        if model is not None:
            ends = [(end, rows) for end, rows in ends if not _has_limit(model[:, j], values, end)]
        if not ends:
            continue
        unit = f" {output.unit}" if output.unit else ""
        named = " and ".join(
            f"{value:.6g}{unit} on {percent(rows / len(values))}" for value, rows in ends
        )
        step = {
            "high" if value == values.max() else "low": float(f"{value:.6g}") for value, _ in ends
        }
        keys = ", ".join(f"`{key}` = {value:.6g}" for key, value in step.items())
        if len(record.outputs) > 1:
            keys += f', `channels` = ["{output.name}"]'
        text = (
            f"{output.name} is {named} of the rows, its largest or smallest value: the range of "
            "the sensor may end there. A model that follows these rows has wrong parameters. Mark "
            f'them as missing (step = "limits" in [[data.prepare]], {keys}), with `missing` = '
            '"keep" beside a [motion] and "skip" otherwise. If the plant itself ends there, '
            "write that into the physics."
        )
        step = {"step": "limits", **step, "channels": [output.name]}
        found.append(Mending(Warning("saturated_output", text), output.name, step, named))
    return found


def _has_limit(model: Vector, measured: Vector, value: float) -> bool:
    """Return whether a model stays at an extreme value of what was measured, on about its rows."""
    there, own = measured == value, np.abs(model - value) <= _AT_LIMIT * np.std(measured)
    return bool((there & own).sum() > _SAME_ROWS * (there | own).sum())


def complete_record(record: Record) -> Record | None:
    """Return the rows of a record on which all outputs were measured, as experiments of their own.

    They are at even steps: every n-th row, where the slowest sensor gives its values there, or
    the rows between gaps. None where no 20 rows are so. The record itself where nothing is missing.
    """
    if record.complete:
        return record
    complete = [np.isfinite(experiment.outputs).all(axis=1) for experiment in record.experiments]
    thinned = [regular_rows(np.asarray(there)) for there in complete]
    every = {rows.step for rows in thinned if rows is not None}
    step, found = record.sampling_time, []
    if len(every) == 1 and None not in thinned:
        step *= next(iter(every))
        for experiment, rows in zip(record.experiments, thinned, strict=True):
            found += _stretches(_every(experiment, rows))  # type: ignore[arg-type]
    else:
        for experiment in record.experiments:
            found += _stretches(experiment)
    found = [one for one in found if len(one) >= _SHORTEST]
    return replace(record, sampling_time=step, experiments=tuple(found)) if found else None


def filled_record(record: Record) -> Record:
    """Return a record whose missing outputs are interpolated between the measured ones."""
    if record.complete:
        return record
    filled = (replace(one, outputs=without_gaps(one.outputs)) for one in record.experiments)
    return replace(record, experiments=tuple(filled))


def _every(experiment: Experiment, rows: slice) -> Experiment:
    return replace(
        experiment,
        inputs=experiment.inputs[rows],
        outputs=experiment.outputs[rows],
        first_row=experiment.first_row + experiment.stride * rows.start,
        stride=experiment.stride * rows.step,
        steps=None,
    )


def _stretches(experiment: Experiment) -> list[Experiment]:
    return [experiment.rows(begin, end) for begin, end in unbroken(experiment.outputs)]
