"""Samples of a record that are no measurements: wild samples, doubled rows, a frozen sensor.

A sample is wild if it is many times farther from the median than all others of its channel, and
nothing answers for it: an input's has no response in an output, an output's no cause in an input.
So heavy tails, steps, and the impulses of a hammer are none. One rule for the data of every
physics.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import Warning
from orthaug._base.lines import first_words, percent, plural
from orthaug.data.angles import reset_warnings, wrapped_angles
from orthaug.data.gaps import (
    Mending,
    complete_record,
    filled_record,
    held_outputs,
    saturated_outputs,
)
from orthaug.data.record import Record
from orthaug.data.steps import Outliers

# Times the distance of the farthest other sample: 1 in 4000 of Student's t, 4 degrees of freedom.
_APART = 8.0
# Share of a channel's samples that are wild at most, and the number that is always few
_FEW, _LEAST = (0.005, 1)
_RESPONSE = 50  # rows within which an output answers an input
_ANSWERS = 3.0  # times what it was before
_FIRST = 10  # rows before which nothing was seen to compare with
_NAMED = 3
_FEWEST = 20  # samples of a channel
_FROZEN, _FROZEN_SHARE = 20, 0.02  # rows for which a frozen sensor does not move, at least
_STILL = 0.02  # share of equal neighbours elsewhere, at most
# Times an output's usual step, or those beside, up to which it comes to a limit and leaves it
_GRADUAL, _BESIDE = 3.0, 4
_REPEATS = 2  # single rows that repeat the one before, at least
_MOVING = 0.01  # of the deviation of its steps: by less an output rests
_BY_CHANCE = 0.2  # of their number: more of them are expected of an output in coarse steps
_TWICE = 0.98  # share of rows that equal the one before, of those that should
_BELOW = 0.97  # of a sample's distance: a threshold that marks it for sure
_SAME = 3e-3  # of an output's deviation: what is left of it beside another one


@dataclass(frozen=True)
class WildSample:
    """A sample of the record: experiment, row and channel."""

    experiment: int
    row: int
    column: int
    """Column among the inputs, then the outputs."""
    name: str
    value: float
    apart: float
    """Its distance from the median, over that of the farthest other sample."""


def wild_samples(record: Record) -> tuple[WildSample, ...]:
    """Return the samples that no other channel explains, channel by channel."""
    values = [np.hstack([e.inputs, e.outputs]) for e in record.experiments]
    names = [c.name for c in (*record.inputs, *record.outputs)]
    inputs = len(record.inputs)
    starts = np.cumsum([0, *map(len, values)])
    whole = np.concatenate(values)
    distance = np.stack([_distance(column) for column in whole.T], axis=1)
    found = []
    for j, name in enumerate(names):
        rows, apart = _far_samples(distance[:, j])
        if len(rows) and not _is_explained(distance, rows, j, inputs, starts):
            owner = np.searchsorted(starts, rows, side="right") - 1
            at = [(int(i), int(k - starts[i])) for i, k in zip(owner, rows, strict=True)]
            found += [
                WildSample(*p, j, name, float(whole[k, j]), apart)
                for p, k in zip(at, rows, strict=True)
            ]
    return tuple(found)


def _distance(column: Vector) -> Vector:
    there = np.isfinite(column)
    middle = np.median(column[there]) if there.any() else 0.0
    return np.where(there, np.abs(column - middle), 0.0)


def _far_samples(distance: Vector) -> tuple[list[int], float]:
    """Return the few samples that are many times farther than all others, and how many times."""
    if len(distance) < _FEWEST:
        return [], 0.0
    most = max(_LEAST, int(_FEW * len(distance)))
    order = np.argsort(-distance)[: most + 1]
    for count in range(most, 0, -1):
        nearest, other = distance[order[count - 1]], distance[order[count]]
        if nearest > _APART * other and nearest > 0:
            return sorted(int(k) for k in order[:count]), float(
                nearest / other
            ) if other > 0 else np.inf
    return [], 0.0


def _is_explained(
    distance: Matrix, rows: list[int], j: int, inputs: int, starts: np.ndarray
) -> bool:
    """Return whether other channels explain these samples.

    Outputs do by a response, an input as the cause.
    """
    first = rows[0]
    if j < inputs:
        if first - starts[np.searchsorted(starts, first, side="right") - 1] < _FIRST:
            return True
        return any(
            _is_farther(distance[:, i], first, first + _RESPONSE)
            for i in range(inputs, distance.shape[1])
        )
    return any(_is_farther(distance[:, i], first - _RESPONSE, first + 1) for i in range(inputs))


def _is_farther(distance: Vector, begin: int, end: int) -> bool:
    """Return whether a channel is farther out in these rows than before them, or elsewhere."""
    begin = max(begin, 0)
    within = float(distance[begin:end].max(initial=0.0))
    before = (
        float(distance[:begin].max(initial=0.0))
        if begin >= _FIRST
        else float(distance[end:].max(initial=0.0))
    )
    return within > _ANSWERS * before


def threshold_for(record: Record, samples: tuple[WildSample, ...]) -> float:
    """Return the threshold with which `outliers` marks these samples and hardly another."""
    least, others = np.inf, 0.0
    for i, experiment in enumerate(record.experiments):
        values = np.hstack([experiment.inputs, experiment.outputs])
        for j in {sample.column for sample in samples}:
            distance, deviation = Outliers().distances(values[:, j])
            ratio = distance / np.where(deviation > 0, deviation, np.inf)
            rows = [
                sample.row for sample in samples if (sample.experiment, sample.column) == (i, j)
            ]
            least = min([least, *ratio[rows]])
            others = max(others, float(np.delete(ratio, rows).max(initial=0.0)))
    if not np.isfinite(least) or least <= 0:
        return Outliers().threshold
    return float(f"{min(max(np.sqrt(max(others, 1.0) * least), 4.0), 0.9 * least):.2g}")


@dataclass(frozen=True)
class Marked:
    """Numbers of rows that a threshold of `outliers` marks: some of given ones, and `others`."""

    threshold: float
    rows: int
    others: int

    @property
    def gain(self) -> int:
        """Rows that are marked, less the others."""
        return self.rows - self.others


def marked_by(
    record: Record, output: int, rows: Sequence[tuple[int, int]], step: Outliers
) -> tuple[Marked, Marked]:
    """Return what a step marks of an output, and what the threshold does that marks rows best.

    Args:
        record: data to which the step is applied.
        output: place among the outputs.
        rows: experiment and row of the samples that are to be marked.
        step: its window is kept.
    """
    wrong, others = [], []
    for i, experiment in enumerate(record.experiments):
        distance, deviation = step.distances(experiment.outputs[:, output])
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.nan_to_num(distance / deviation, nan=0.0, posinf=np.inf)
        own = [row for at, row in rows if at == i]
        wrong.append(ratio[own])
        others.append(np.delete(ratio, own))
    far, near = np.concatenate(wrong), np.concatenate(others)

    def marked(threshold: float) -> Marked:
        return Marked(threshold, int((far > threshold).sum()), int((near > threshold).sum()))

    finite = far[np.isfinite(far) & (far > 0)]
    tried = {float(f"{_BELOW * value:.2g}") for value in finite} | {step.threshold}
    return marked(step.threshold), max(map(marked, sorted(tried)), key=lambda one: one.gain)


def data_warnings(
    record: Record,
    effect: Callable[[tuple[WildSample, ...]], str] | None = None,
    limited: Sequence[str] = (),
) -> list[Warning]:
    """Return warnings of samples that are wrong: wild, doubled, frozen, wrapped or reset ones.

    Args:
        effect: says in a sentence what a fit without some samples gives.
        limited: names of outputs whose limits are known, as of what a controller sets.
    """
    found, complete, record = reset_warnings(record), complete_record(record), filled_record(record)
    samples = wild_samples(record)
    for name in dict.fromkeys(sample.name for sample in samples):
        own = tuple(sample for sample in samples if sample.name == name)
        found.append(
            Warning("wild_samples", _wild_text(record, own, effect(samples) if effect else ""))
        )
    if complete is None:
        return found
    held, wrapped, limits = _mendings_of(complete, limited)
    found += _repeat_warnings(complete) or [one.warning for one in held]
    found += [one.warning for one in wrapped] + _same_signal_warnings(complete)
    return [*found, *_frozen_warnings(complete), *(one.warning for one in limits)]


def mendings(record: Record) -> list[Mending]:
    """Return the warnings on a record whose remedy is a step of preparation."""
    complete = complete_record(record)
    return [] if complete is None else [one for kind in _mendings_of(complete) for one in kind]


def _mendings_of(record: Record, limited: Sequence[str] = ()) -> tuple[list[Mending], ...]:
    limits = saturated_outputs(record, limited=limited)
    return held_outputs(record), wrapped_angles(record), limits


def _same_signal_warnings(record: Record) -> list[Warning]:
    """Return a warning of each output that is another one in another unit."""
    found, outputs = [], np.concatenate([one.outputs for one in record.experiments])
    centred = outputs - outputs.mean(axis=0)
    size = np.linalg.norm(centred, axis=0)
    for j in range(1, len(record.outputs)):
        for i in range(j):
            if not size[i] * size[j] > 0:
                continue
            alike = float(centred[:, i] @ centred[:, j]) / (size[i] * size[j])
            if alike * alike < 1 - _SAME**2:
                continue
            first, second = record.outputs[i].name, record.outputs[j].name
            slope = alike * size[j] / size[i]
            offset = float(outputs[:, j].mean() - slope * outputs[:, i].mean())
            line = f"{slope:.4g}*{first}" + (f" + {offset:.4g}" if abs(offset) > _SAME else "")
            text = (
                f"{second} is {line} to {percent(np.sqrt(max(1 - alike * alike, 0.0)), 2)}: one "
                "signal in two columns. Two models are fitted to it, and intervals of common "
                "parameters count it twice. Leave one of the two out."
            )
            found.append(Warning("same_signal", text))
            break
    return found


def _wild_text(record: Record, own: tuple[WildSample, ...], effect: str) -> str:
    name = own[0].name
    where = [
        f"{record.experiments[s.experiment].where(s.row)}: {name} = {s.value:.6g}" for s in own
    ]
    column = next(c.file_column for c in (*record.inputs, *record.outputs) if c.name == name)
    of = f" (column '{column}')" if column != name else ""
    answer = "no output responds" if own[0].column < len(record.inputs) else "no input causes it"
    if own[0].column >= len(record.inputs) and not record.inputs:
        answer = "no neighbour is near it"
    effect = f" {effect}" if effect else ""
    far = (
        f"{own[0].apart:.3g} times farther from the median than"
        if np.isfinite(own[0].apart)
        else "apart from"
    )
    return (
        f"{first_words(where, _NAMED, '; ')}{of}, {far} every other sample, and {answer}. It is a "
        f"wild sample with {percent(_share_of(record, own), 3)} of the squares of {name}.{effect} "
        f'Mark it by [[data.prepare]], step = "outliers", channels = ["{name}"], threshold = '
        f'{threshold_for(record, own):g}. Add missing = "skip" in [data], or a step "fill" '
        "behind it."
    )


def _share_of(record: Record, own: tuple[WildSample, ...]) -> float:
    """Return the share of a channel's squares about its median that these samples make up."""
    column = np.concatenate(
        [np.hstack([e.inputs, e.outputs])[:, own[0].column] for e in record.experiments]
    )
    middle, scale = np.median(column), max(abs(s.value) for s in own)
    squares = float(np.sum(((column - middle) / scale) ** 2))
    return min(
        float(np.sum([((s.value - middle) / scale) ** 2 for s in own])) / max(squares, 1e-300), 1.0
    )


def _repeat_warnings(record: Record) -> list[Warning]:
    for experiment in record.experiments:
        values = np.hstack([experiment.inputs, experiment.outputs])
        if len(values) < _FEWEST:
            continue
        same = (values[1:] == values[:-1]).all(axis=1)
        for first in (0, 1):
            pairs, between = same[first::2], same[1 - first :: 2]
            if pairs.mean() > _TWICE and between.mean() < 1 - _TWICE:
                where = experiment.where(first)
                text = (
                    f"{where}: from here on every row occurs twice, in all channels: the file "
                    "was written at twice the rate of the measurement. Standard errors then "
                    "count every sample twice, and half of the steps show no change. Give "
                    "`every = 2` for these files, with the sampling time of the measurement."
                )
                return [Warning("rows_twice", text)]
    return _single_repeats(record)


def _single_repeats(record: Record) -> list[Warning]:
    """Return a warning of single rows that repeat the row before in all channels.

    None where the outputs are recorded so coarsely that this happens by chance.
    """
    places, chance, every = [], 0.0, 0
    for experiment in record.experiments:
        outputs = experiment.outputs
        if len(outputs) < _FEWEST or not np.isfinite(outputs).all():
            continue
        held = (experiment.inputs[1:] == experiment.inputs[:-1]).all(axis=1)
        same = held & (outputs[1:] == outputs[:-1]).all(axis=1)
        spread = np.maximum(np.diff(outputs, axis=0).std(axis=0), 1e-300)
        # At rest a row repeats the one before, too
        moves = (np.abs(np.diff(outputs, axis=0)) > _MOVING * spread).any(axis=1)
        beside = np.concatenate([[False], moves, [False]])
        places += [
            experiment.where(int(row) + 1)
            for row in np.flatnonzero(same & beside[:-2] & beside[2:])
        ]
        every += int(same.sum())
        steps = np.array([_resolution(column) for column in outputs.T])
        chance += int(held.sum()) * float(np.prod(np.minimum(steps / spread, 1.0)))
    if len(places) < _REPEATS or chance > _BY_CHANCE * len(places) or len(places) < every / 2:
        return []
    text = (
        f"{first_words(places, _NAMED, '; ')}: the row repeats the one before in all channels. A "
        "logger wrote it twice, or it did not get a new sample: all later rows then come a step "
        "too late, which moves the parameters. Take these rows out of the file."
    )
    return [Warning("repeated_rows", text)]


def _resolution(values: Vector) -> float:
    """Return the smallest difference between two values: the step in which they are recorded.

    In a long record even fine steps, such as those of four decimals, let rows repeat by chance.
    """
    levels = np.unique(values)
    return float(np.diff(levels).min()) if len(levels) > 1 else 0.0


def _frozen_warnings(record: Record) -> list[Warning]:
    """Return warnings of frozen outputs: constant for many rows while an input moves.

    Elsewhere hardly two neighbouring rows are equal.
    """
    found = []
    for j, output in enumerate(record.outputs):
        for experiment in record.experiments:
            y, n = experiment.outputs[:, j], len(experiment)
            same = y[1:] == y[:-1]
            begin, rows = _longest_stretch(same)
            rest = np.concatenate([same[:begin], same[begin + rows :]])
            if rows < max(_FROZEN, _FROZEN_SHARE * n) or not len(rest) or rest.mean() > _STILL:
                continue
            block = experiment.inputs[begin : begin + rows]
            moves = np.ptp(block, axis=0) > 0.1 * np.maximum(experiment.inputs.std(axis=0), 1e-300)
            if experiment.inputs.shape[1] and not moves.any():
                continue
            if _ends_at_limit(y, begin, rows):
                continue
            text = (
                f"{experiment.where(begin)}: {output.name} is {y[begin]:.6g} for "
                f"{plural(rows + 1, 'row')} from here on ({percent((rows + 1) / n)} of them), "
                "and changes from row to row elsewhere: the sensor or the recorder froze. "
                "Leave these rows out (`rows` of the data)."
            )
            found.append(Warning("frozen_output", text))
            break
    return found


def _ends_at_limit(y: Vector, begin: int, rows: int) -> bool:
    """Return whether a signal stays at its extreme value, which it reaches and leaves gradually.

    A limit of sensor or plant, which `saturated_output` is about; what freezes jumps at its end.
    """
    if y[begin] not in (y.min(), y.max()):
        return False
    steps = np.abs(np.diff(y))
    usual = float(np.sqrt(np.mean(steps[steps > 0] ** 2)))
    before, after = steps[:begin][::-1], steps[begin + rows :]
    return all(
        not len(side) or side[0] <= _GRADUAL * max(usual, side[1:_BESIDE].max(initial=0.0))
        for side in (before, after)
    )


def _longest_stretch(same: np.ndarray) -> tuple[int, int]:
    """Return where the longest stretch of true values begins, and how many there are."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(int)))
    if not len(edges):
        return 0, 0
    begins, ends = edges[::2], edges[1::2]
    longest = int(np.argmax(ends - begins))
    return int(begins[longest]), int(ends[longest] - begins[longest])
