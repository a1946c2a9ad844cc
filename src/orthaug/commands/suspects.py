"""Suspects as a spec declares them, of lagged physics and of a motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from orthaug._base.checks import Matrix
from orthaug._base.errors import InputError
from orthaug.analysis.suspects import (
    WIDTHS,
    MotionSuspect,
    Suspect,
    check_motion_suspects,
    data_width,
    median_size,
    suspect_columns,
)
from orthaug.commands.spec import SuspectSection
from orthaug.data.expressions import SAMPLING_TIME
from orthaug.inference.measures import WeighedPhysics
from orthaug.physics.motion import Motion
from orthaug.physics.problem import MotionProblem, Problem


def declared_suspects(
    sections: Sequence[SuspectSection], problem: Problem, weighed: WeighedPhysics
) -> tuple[Suspect, ...]:
    """Return the suspects of a spec, as terms of lagged physics under a measure.

    A width that is not given is the median size of what the term acts on.

    Raises:
        InputError: an unknown kind, channel or lag, an expression that cannot be read, or without
            a value on some training row or, with memory, at the points of the measure.
    """
    constants = {SAMPLING_TIME: problem.record.sampling_time} | dict(problem.baseline.constants)
    only = problem.outputs[0] if len(problem.outputs) == 1 else None
    suspects = []
    for section in sections:
        width = _width(
            section, lambda on: data_width(on, problem.rows.x, problem.layout, constants)
        )
        output = section.output if section.output is not None else only
        options = {
            "width": width,
            "time_constant": section.time_constant,
            "output": output,
            "coefficient": section.coefficient,
            "name": section.name,
        }
        suspects.append(Suspect.of(section.kind, section.on, constants=constants, **options))
    suspect_columns(suspects, problem.rows.x, problem.layout, problem.outputs, problem.lengths)
    if weighed.points.x is not problem.rows.x:
        hidden = [suspect for suspect in suspects if suspect.memory is not None]
        suspect_columns(hidden, weighed.points.x[:1], problem.layout, problem.outputs)
    return tuple(suspects)


def declared_terms(
    sections: Sequence[SuspectSection], problem: MotionProblem
) -> tuple[MotionSuspect, ...]:
    """Return the suspects of a spec, as terms of a motion.

    Raises:
        InputError: an unknown kind, equation or name, an expression that cannot be read or has no
            value.
    """
    suspects, (x, u) = [], problem.guessed_points
    for section in sections:
        kept = ("time_constant", "factor", "equation", "coefficient", "unit", "name")
        options = {key: getattr(section, key) for key in kept}
        width = _width(section, lambda on: _motion_width(on, problem.motion, x.T, u.T))
        suspects.append(MotionSuspect.of(section.kind, section.on, width=width, **options))
    check_motion_suspects(suspects, problem)
    return tuple(suspects)


def _motion_width(on: str, motion: Motion, x: Matrix, u: Matrix) -> float:
    """Return a width from states x (M, nx) and inputs u (M, nu): the median of nonzero |on|.

    It is rounded to six digits.

    Raises:
        InputError: an expression that cannot be read, that is not finite, or zero everywhere.
    """
    width = median_size(MotionSuspect(on, on).values(motion, motion.initial, x, u))
    if width is None:
        raise InputError(
            f"'{on}' is zero or not finite over the guessed states; give a `width`, or its "
            "state a `start`."
        )
    return width


def _width(section: SuspectSection, found: Callable[[str], float]) -> float | None:
    asked = section.width is None and section.kind in WIDTHS
    return found(section.on) if asked and section.on is not None else section.width
