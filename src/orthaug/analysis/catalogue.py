"""Families of terms that a physics may lack, with width or power profiled, for both kinds.

A family is one line of `FAMILIES`. Of every family each member is tried on everything that the
learner sees.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug.analysis.motion_suspects import MotionSuspect, usual_places
from orthaug.analysis.suspects import Suspect, usual_suspects
from orthaug.physics.motion import Motion
from orthaug.physics.problem import Problem

_WIDTHS = (0.06, 0.125, 0.25, 0.5, 1.0, 2.0, 4.0)  # in median sizes of what a term acts on
_KINKS = (0.25, 0.5, 1.0, 1.5, 2.0)  # the same: beyond these hardly a row is on the other side
_POWERS = (0.3, 0.4, 0.5, 0.65, 0.8, 1.2, 1.5, 2.0, 2.5, 3.0)
_MOST_ARGUMENTS = 8  # expressions that the families are tried on


class Family(NamedTuple):
    """Terms of one form: `text(x, w)` writes one from what it acts on and its width or power.

    `members` are the widths in median sizes of x, or the powers themselves where the family is not
    `scaled`.
    """

    name: str
    text: Callable[[str, str], str]
    members: tuple[float, ...]
    scaled: bool = True


FAMILIES = (
    Family("tanh", lambda x, w: f"tanh({x}/{w})", _WIDTHS),
    Family("atan", lambda x, w: f"atan({x}/{w})", _WIDTHS),
    Family("stribeck", lambda x, w: f"sign({x})*exp(-abs({x})/{w})", _WIDTHS),
    Family("power", lambda x, p: f"sign({x})*abs({x})**{p}", _POWERS, scaled=False),
    Family("dead_zone", lambda x, w: f"{x} - max(min({x}, {w}), -{w})", _KINKS),
    Family("saturation", lambda x, w: f"max(min({x}, {w}), -{w})", _KINKS),
)


def family_members(on: str, values: Vector) -> Iterator[tuple[str, str]]:
    """Yield name and expression of every member of every family for an expression `on`."""
    size = np.abs(values[np.isfinite(values)])
    if not np.any(size > 0):
        return
    median, x = float(np.median(size[size > 0])), f"({on})"
    for family in FAMILIES:
        for member in family.members:
            w = f"{member * (median if family.scaled else 1.0):.4g}"
            yield f"{family.name}({on}, {w})", family.text(x, w)


def catalogue(problem: Problem) -> tuple[Suspect, ...]:
    """Return every member for the learner's declared inputs and the variables of usual suspects."""
    constants = dict(problem.baseline.constants)
    texts = [*map(str, problem.features.entries), *(s.on for s in usual_suspects(problem) if s.on)]
    arguments = list({text.replace(" ", ""): text for text in texts}.values())[:_MOST_ARGUMENTS]
    found = []
    for on in arguments:
        try:
            values = Suspect(on, on, constants=constants).form(problem.rows.x, problem.layout)
        except InputError:
            continue
        for name, text in family_members(on, values):
            found += [
                Suspect(
                    name if len(problem.outputs) == 1 else f"{name} in {output}",
                    text,
                    output,
                    None,
                    constants,
                    on,
                )
                for output in problem.outputs
            ]
    return tuple(found)


def motion_catalogue(
    motion: Motion, p: Vector, x: Matrix, u: Matrix, features: Sequence[str]
) -> tuple[MotionSuspect, ...]:
    """Return every member for the learner's declared inputs, in each equation that may lack a term.

    Args:
        p: parameters (np,); states x (M, nx) and inputs u (M, nu) give the widths.
        features: what the learner sees.
    """
    places, found = usual_places(motion), []
    for on in list(dict.fromkeys(features))[:_MOST_ARGUMENTS]:
        values = MotionSuspect(on, on).values(motion, p, x, u)
        for place in places:
            equation = motion.states[place].name
            where = f" in {equation}" if len(places) > 1 else ""
            found += [
                MotionSuspect(f"{name}{where}", text, equation)
                for name, text in family_members(on, values)
            ]
    return tuple(found)
