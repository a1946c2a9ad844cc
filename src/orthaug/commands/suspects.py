"""Suspects as a spec declares them."""

from __future__ import annotations

from collections.abc import Sequence

from orthaug.analysis.suspects import WIDTHS, Suspect, data_width, suspect_columns
from orthaug.commands.spec import SuspectSection
from orthaug.data.expressions import SAMPLING_TIME
from orthaug.physics.problem import Problem


def declared(sections: Sequence[SuspectSection], problem: Problem) -> tuple[Suspect, ...]:
    """The suspects of a spec. A width that is not given is the median size of what the term acts on.

    Raises:
        InputError: an unknown kind, channel or lag, an expression that cannot be read.
    """
    constants = {SAMPLING_TIME: problem.record.sampling_time} | dict(problem.baseline.constants)
    suspects = []
    for section in sections:
        width = section.width
        if width is None and section.kind in WIDTHS and section.on is not None:
            width = data_width(section.on, problem.rows.x, problem.layout, constants)
        only = problem.outputs[0] if len(problem.outputs) == 1 else None
        output = section.output if section.output is not None else only
        options = {"width": width, "output": output, "coefficient": section.coefficient, "name": section.name}
        suspects.append(Suspect.of(section.kind, section.on, constants=constants, **options))
    return tuple(suspects)


def check_suspects(sections: Sequence[SuspectSection], problem: Problem) -> None:
    """Raise InputError for suspects that cannot be read, or have no value on some training row."""
    suspect_columns(declared(sections, problem), problem.rows.x, problem.layout, problem.outputs)
