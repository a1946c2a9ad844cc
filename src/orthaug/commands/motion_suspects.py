"""Suspects of a motion as a spec declares them, and what they do to its parameters before a fit and after it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from orthaug.analysis.motion_suspects import (
    MotionSuspect,
    check_motion_suspects,
    motion_width,
    usual_motion_suspects,
)
from orthaug.analysis.suspects import WIDTHS
from orthaug.commands.spec import SuspectSection
from orthaug.physics.motion_problem import MotionProblem

if TYPE_CHECKING:
    from orthaug.fitting.motion_task import MotionTask
    from orthaug.fitting.structures import Structure


def declared_terms(sections: Sequence[SuspectSection], problem: MotionProblem) -> tuple[MotionSuspect, ...]:
    """The suspects of a spec. A width that is not given is the median size of what the term acts on.

    Raises:
        InputError: an unknown kind, equation or name, an expression that cannot be read or has no value.
    """
    suspects = []
    for section in sections:
        width = section.width
        if width is None and section.kind in WIDTHS and section.on is not None:
            width = motion_width(section.on, problem)
        kept = ("factor", "equation", "coefficient", "unit", "name")
        options = {key: getattr(section, key) for key in kept}
        suspects.append(MotionSuspect.of(section.kind, section.on, width=width, **options))
    check_motion_suspects(suspects, problem)
    return tuple(suspects)


def bias_before(
    suspects: Sequence[MotionSuspect], problem: MotionProblem, structure: Structure, task: MotionTask
) -> list[dict[str, Any]] | None:
    """What every suspect would do, about physics alone; of the usual ones those that do anything, where none is named.

    None where physics alone has no run.
    """
    from orthaug.analysis.motion_bias import ground_before

    ground = ground_before(task, structure)
    if ground is None:
        return None
    table = ground.table(suspects or usual_motion_suspects(problem))
    return [entry.as_dict() for entry in table if suspects or entry.size]
