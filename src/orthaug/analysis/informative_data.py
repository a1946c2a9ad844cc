"""Warnings on data that can hardly contradict the physics, or hardly show it.

A linear response to L frequencies has 2 L numbers for each output. Where the parameters are as
many, any such response is followed, and what a missing term adds at these frequencies goes into
them: a stiffness that grows with amplitude acts as a larger one (the describing function). And a
free run that explains no more of an output than a sine fitted to noise does says nothing on the
parameters that move it.
"""

from __future__ import annotations

import math

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.errors import Warning
from orthaug._base.lines import join_words
from orthaug.analysis.feedback import integrates
from orthaug.data.part import Part
from orthaug.data.record import Record
from orthaug.models.model import Model
from orthaug.models.response import Response

_FEWEST = 64  # rows of an experiment whose frequencies are counted
_POWER = 0.99  # of the input's differences, that the lines hold together
_WIDTH = 2  # bins on either side of a line under a Hann window
_LISTED = 4
# Of an output's variance: what a free run explains of noise by its best frequency, in units of
# log N / N
_BY_CHANCE = 4.0
# Runs that the rows are cut into where what an integrator lacks adds up, and steps of one at least
_PIECES, _SHORTEST = 10, 50


def few_frequencies(record: Record, parameters: int) -> tuple[Warning, ...]:
    """Return a warning where the inputs hold too few frequencies to test the physics, or none.

    No warning where an input moves otherwise, such as by steps: its differences are looked at.

    Args:
        parameters: number of those that are estimated.
    """
    if record.inputs and not any(np.ptp(e.inputs, axis=0).any() for e in record.experiments):
        return (_no_movement(record),)
    lines: dict[str, list[float]] = {}
    most = (parameters + 1) // (2 * len(record.outputs))
    for j, channel in enumerate(record.inputs):
        moving = [e.inputs[:, j] for e in record.experiments if np.ptp(e.inputs[:, j]) > 0]
        found: set[float] = set()
        for signal in moving:
            own = _lines(signal, record.sampling_time, most)
            if own is None:
                return ()
            resolution = 1 / (len(signal) * record.sampling_time)
            found |= {f for f in own if all(abs(f - g) > _WIDTH * resolution for g in found)}
        if found:
            lines[channel.name] = sorted(found)
    count = sum(map(len, lines.values()))
    if not 0 < count <= most:
        return ()
    each = [
        f"{name} ({', '.join(f'{f:.3g}' for f in held[:_LISTED])} Hz)"
        for name, held in lines.items()
    ]
    plural = "frequencies" if count > 1 else "frequency"
    text = (
        f"the input has only {count} {plural}: {join_words(each)}. A linear response there is "
        f"{2 * count * len(record.outputs)} numbers, which {parameters} parameters can follow "
        "whatever the physics lacks. A missing term, such as a stiffness that depends on the "
        "amplitude, then moves the parameters and leaves hardly a trace in the residual. Give "
        "other amplitudes and more frequencies, or steps (`orthaug design` makes an input)."
    )
    return (Warning("few_frequencies", text),)


def _no_movement(record: Record) -> Warning:
    """Return the warning that no input moves."""
    names = join_words([channel.name for channel in record.inputs])
    verb = "does" if len(record.inputs) == 1 else "do"
    text = (
        f"{names} {verb} not move within an experiment: the data show how the outputs settle from "
        "their start, and a static gain. Where they are at rest from the start, no other parameter "
        "is determined. Give data in which the inputs move."
    )
    return Warning("constant_input", text)


def _lines(signal: Vector, step: float, most: int) -> list[float] | None:
    """Return the frequencies [Hz] of a signal that consists of few sines; None of others."""
    change = np.diff(signal)
    n = len(change)
    if n < _FEWEST:
        return None
    power = np.abs(np.fft.rfft((change - change.mean()) * np.hanning(n))) ** 2
    whole, left, found = float(power.sum()), power.copy(), []
    if not whole > 0:
        return None
    for _ in range(most):
        at = int(np.argmax(left))
        found.append(at / (n * step))
        left[max(at - _WIDTH, 0) : at + _WIDTH + 1] = 0.0
        if left.sum() <= (1 - _POWER) * whole:
            return found
    return None


def explains_nothing(
    free_run: Response,
    part: Part,
    parameters: int,
    *,
    driven: bool,
    physics: Model,
    steps: int | None,
) -> tuple[Warning, ...]:
    """Return a warning where a free run explains no more of an output than of noise.

    Args:
        free_run: over the training data, on which it was trained, from the start of training.
        part: the training data.
        parameters: number of those that are estimated.
        driven: whether the error is more than noise: then the outputs move, but otherwise.
        physics: without a learner. Where it integrates, shorter runs are advised.
        steps: of a run in training; 0 for whole experiments, None where rows were trained on.
    """
    if any(run.diverged for run in free_run.trajectories):
        return ()
    scores, outputs = free_run.scores(part.skips), (c.name for c in part.record.outputs)
    rows = scores.samples
    if rows < _FEWEST:
        return ()
    share = (parameters + _BY_CHANCE * math.log(rows)) / rows
    none = [
        f"{name} (FIT {fit:.1f} %)"
        for name, nrmse, fit in zip(outputs, scores.nrmse, scores.fit, strict=True)
        if np.isfinite(nrmse) and 1 - nrmse**2 < share
    ]
    if not none:
        return ()
    inputs = bool(part.record.inputs)
    checked = "the sign and the unit of every input" if inputs else "the sign of every term"
    wanted = "in which the inputs move the outputs" if inputs else "that begin far from rest"
    meant = (
        f"The outputs do move, but not as the physics says. Check {checked}, the initial values "
        "and the bounds."
        if driven
        else "The parameters are those of the noise, but for what the mean determines, and their "
        f"intervals mean nothing. Give data {wanted}."
    )
    segment = max(rows // _PIECES, _SHORTEST)
    longer = steps is not None and not 0 < steps <= segment
    if inputs and driven and longer and integrates(physics, part.record):
        meant += (
            " The physics integrates: what it lacks adds up over the record and hides the rest. "
            f"Train on shorter runs (`segment` = {segment} in [training])."
        )
    text = (
        f"the free run explains no more of {join_words(none)} than it would of noise by chance. "
        f"{meant}"
    )
    return (Warning("explains_nothing", text),)
