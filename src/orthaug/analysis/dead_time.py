"""Whether an input acts later than the physics says: physics alone, fitted again with the input delayed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from orthaug._base.warning import Warning
from orthaug.analysis.holds import refitted, residual_of
from orthaug.data.record import Record
from orthaug.fitting.motion_task import MotionTask

_CLEARLY = 0.2  # lower, of the residual: a missing friction or lag gains less by a delay
_SHARE = 20  # of the rows that are the longest delay


@dataclass(frozen=True)
class DeadTime:
    """An input that acts `samples` later: what physics alone then leaves, and leaves without, in deviations."""

    input: str
    samples: int
    residual: float
    undelayed: float

    @property
    def gain(self) -> str:
        """What a delay explains, in words."""
        late = f"{self.samples} sample{'s' * (self.samples > 1)}"
        return (
            f"with a delay of {late} physics alone leaves {self.residual:.3g} deviations of the output instead of "
            f"{self.undelayed:.3g}"
        )

    @property
    def warning(self) -> Warning:
        """With what to write into the spec."""
        return Warning(
            "dead_time",
            f"{self.input} seems to act late: {self.gain}, and its parameters are others. If there is a dead time, "
            f'delay the input by [[data.prepare]] with step = "shift", channel = "{self.input}", samples = '
            f"{self.samples}; a lag of its drive belongs into the equations.",
        )


def dead_times(task: MotionTask, solver: Any) -> tuple[DeadTime, ...]:
    """The inputs that act clearly later than they do in the equations, and by how many samples.

    Each input is delayed in turn, by 1, 2, 4, … samples while that explains the data better, then by what lies
    between; physics alone is refitted each time from where the last one ended.

    Args:
        task: with physics alone trained; what it leaves is set against.
    """
    motion, record = task.problem.motion, task.problem.record
    first = task.physics
    if first is None:
        return ()
    found = []
    for number, name in enumerate(motion.inputs):
        tried = {0: (residual_of(task.plan, first), first)}

        def leaves(samples: int, number: int = number, tried: dict = tried) -> float:
            if samples not in tried:
                nearest = tried[min(tried, key=lambda known: (abs(known - samples), tried[known][0]))][1]
                course, flight = refitted(task, nearest, motion, _delayed(record, number, samples), solver)
                tried[samples] = (residual_of(course, flight), flight or first)
            return tried[samples][0]

        best = _least(leaves, len(record) // _SHARE)
        if leaves(best) < (1 - _CLEARLY) * leaves(0):
            found.append(DeadTime(name, best, leaves(best), leaves(0)))
    return tuple(found)


def _least(leaves: Callable[[int], float], most: int) -> int:
    """Where a function of whole numbers from 0 on that falls and rises is least."""
    best, step = 0, 1
    while step <= most and leaves(step) < leaves(best):
        best, step = step, 2 * step
    step = best // 2
    while step:
        best = min((best - step, best, best + step), key=leaves)
        step //= 2
    return best


def _delayed(record: Record, number: int, samples: int) -> Record:
    """An input later by so many samples; what it was before the record is its first value."""

    def moved(inputs: np.ndarray) -> np.ndarray:
        column = inputs[:, number]
        late = np.concatenate([np.full(min(samples, len(column)), column[0]), column])[: len(column)]
        return np.where(np.arange(inputs.shape[1]) == number, late[:, None], inputs)

    return replace(record, experiments=tuple(replace(e, inputs=moved(e.inputs)) for e in record.experiments))
