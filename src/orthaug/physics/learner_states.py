"""States of the learner's own: what it remembers of the past, written as equations of the motion.

A learner with N states sees `z₁ … z_N` beside its other inputs, and is added to their equations as
it is to those of the physics:

    ż_j = (s_j − z_j) / τ_j + g_j(s, z),    learned = g(s, z)

Each begins as a first-order lag of one input s_j with the time constant τ_j, so that the learner
has a past to look at from the first step of training. What g_j adds to it moves its pole, or makes
it a hysteresis. The physics of these equations has no parameter, and no output depends on them but
through the learner, so physics alone is not changed by them. Beyond the range of training g_j fades
or is held, therefore z stays bounded whatever the weights are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from orthaug._base.checks import Vector, is_number
from orthaug._base.errors import InputError, show
from orthaug.data.record import Record
from orthaug.physics.motion import Motion
from orthaug.physics.states import State

MOST_STATES = 8
_SHORTEST = 5.0  # samples: a shorter lag is hardly one
_LONGEST = 0.1  # of the longest experiment: a slower lag is seen too few times


@dataclass(frozen=True)
class LearnerStates:
    """The states of a learner: how many, and the time constants [s] that training begins with.

    None for time constants spread over those that the record can show.
    """

    states: int = 0
    time_constants: tuple[float, ...] | None = None

    @classmethod
    def of(cls, learner: object) -> LearnerStates:
        """Return the memory that a learner declares; none of one that declares nothing."""
        return cls(getattr(learner, "states", 0), getattr(learner, "time_constants", None))


def check_time_constants(given: object, states: int) -> tuple[float, ...] | None:
    """Return the time constants as a tuple.

    Raises:
        InputError: not one positive number for each state.
    """
    if given is None:
        return None
    if not states:
        raise InputError(
            f"`time_constants` are those of the learner's `states`, which it has not; got "
            f"{show(given)}. Set `states`, or leave `time_constants` out."
        )
    listed = tuple(given) if isinstance(given, list | tuple) else ()
    if not listed or len(listed) != states or not all(is_number(t) and t > 0 for t in listed):
        raise InputError(
            "`time_constants` must be one positive number in s for each state of the learner, "
            f"{states} in all; got {show(given)}."
        )
    return tuple(float(t) for t in listed)


def names_of_memory(motion: Motion, states: int) -> tuple[str, ...]:
    """Return names of a learner's states that the motion does not use, such as z1 and z2."""
    taken = {*motion.known, *(output.name for output in motion.outputs)}
    prefix = "z"
    while any(f"{prefix}{i}" in taken for i in range(1, states + 1)):
        prefix = "learner_z" if prefix == "z" else f"{prefix}_"
    return tuple(f"{prefix}{i}" for i in range(1, states + 1))


def add_memory(
    motion: Motion, inputs: Sequence[str] | None, memory: LearnerStates, record: Record
) -> tuple[Motion, tuple[str, ...] | None]:
    """Return the motion with a learner's states, and the inputs of the learner with them.

    Each state is a lag of one of the inputs in turn; where the learner sees everything, of the
    states that it is added to.

    Raises:
        InputError: a motion of functions, to which no equation can be added.
    """
    if not memory.states:
        return motion, None if inputs is None else tuple(inputs)
    if motion.functions is not None:
        raise InputError(
            "a learner with `states` adds equations, and this motion consists of Python "
            "functions. Write the motion with `Motion.from_equations`, or leave `states` out."
        )
    names = names_of_memory(motion, memory.states)
    learned = [motion.names_of_states[i] for i in motion.learned[0]]
    sources = tuple(inputs or ()) or (*learned, *motion.visible_states)
    constants = memory.time_constants or tuple(_spread(record, memory.states))
    added = [
        State(
            name,
            _lag(sources[i % len(sources)], name, tau, record.sampling_time, motion),
            0.0,
            learned=True,
            memory=True,
        )
        for i, (name, tau) in enumerate(zip(names, constants, strict=True))
    ]
    longer = replace(motion, states=(*motion.states, *added))
    return longer, None if inputs is None else (*inputs, *names)


def _lag(source: str, name: str, tau: float, sampling_time: float, motion: Motion) -> str:
    """Return the equation of a first-order lag of a source."""
    source = source if source.isidentifier() else f"({source})"
    if motion.scheme.discrete:
        kept = float(np.exp(-sampling_time / tau))
        return f"{name} + {1 - kept:.6g}*({source} - {name})"
    return f"({source} - {name})/{tau:.6g}"


def _spread(record: Record, count: int) -> Vector:
    """Return time constants [s] at the middles of `count` equal parts, on a logarithmic scale."""
    longest = max(len(experiment) for experiment in record.experiments)
    low, high = _SHORTEST, max(_LONGEST * longest, 2 * _SHORTEST)
    parts = (np.arange(count) + 0.5) / count
    return record.sampling_time * low * (high / low) ** parts
