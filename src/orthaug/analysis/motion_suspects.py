"""Suspected terms of a motion's equations, as expressions of states, inputs and parameters.

A suspect adds `coefficient * expression` to the derivative of a state, or to an output. With a
`factor` such as -1/m the coefficient is a force in N though the equation is one of m/s².
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from orthaug._base.checks import Matrix, Vector, check_label, check_unique, nearest
from orthaug._base.errors import InputError
from orthaug.analysis.suspects import (
    ODD_JUMPS,
    WIDTHS,
    changes_sign,
    check_coefficient,
    check_name,
    memory_of,
    suspect_text,
)
from orthaug.data.expressions import Expression, parse_named
from orthaug.physics.motion import Motion
from orthaug.physics.motion_problem import MotionProblem
from orthaug.physics.suspected_motion import Signal, SuspectedTerm

if TYPE_CHECKING:
    from orthaug.analysis.memory import MemoryTerm

_OF_STATES = ("coulomb", "quadratic_drag", "cubic")
# Of friction that turns round smoothly, in median sizes of what it acts on
_WIDTHS = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0)
_OF_INPUTS = ("cubic", "dead_zone", "saturation")
_OF_FEATURES = (*_OF_STATES, "dead_zone")


@dataclass(frozen=True)
class MotionSuspect:
    """A term `coefficient * expression` of a state's equation, or of an output.

    Make one of a known kind with `of`.

    `coefficient` is a guess of its size, None where there is none; `unit` is its unit. `equation`
    may be left out where one state is learned, or only one equation has parameters.

    Examples:
        >>> force = {"factor": "-1/m", "equation": "v", "coefficient": 1.5, "unit": "N"}
        >>> MotionSuspect.of("coulomb", "v", **force).expression
        '(-1/m)*(sign(v))'
    """

    name: str
    expression: str
    equation: str | None = None
    coefficient: float | None = None
    unit: str = ""
    jump: str | None = None
    """What changes its sign where the expression jumps, of the kind `coulomb`."""
    memory: MemoryTerm | None = None
    """What the expression drives along the run; the term is `factor` times its internal state."""
    factor: str | None = None
    """Of a term with memory; of another it is part of the expression."""

    output = None  # in the words of lagged suspects

    def __post_init__(self) -> None:
        check_name(self.name)
        check_coefficient(self.name, self.coefficient)
        check_label(self.unit, f"the unit of suspect '{self.name}'")

    @classmethod
    def of(
        cls,
        kind: str,
        on: str | None = None,
        *,
        width: float | None = None,
        time_constant: float | None = None,
        factor: str | None = None,
        equation: str | None = None,
        coefficient: float | None = None,
        unit: str = "",
        name: str | None = None,
    ) -> MotionSuspect:
        """Return a suspect of a known kind (those of `Suspect.of`), times a factor.

        Args:
            on: an expression of states, inputs, parameters and definitions, such as `"v"`.
            width: in the unit of `on`.
            time_constant: of a lag, in s.
            factor: an expression that multiplies the kind's.

        Raises:
            InputError: an unknown kind, an argument that is missing, or that the kind does not
                take.
        """
        text, label, _ = suspect_text(kind, on, width, _check_parentheses, "v", time_constant)
        memory = memory_of(kind, on, width, time_constant)
        if factor is not None:
            _check_parentheses(factor)
            label = f"{factor} * {label}"
            text = text if memory is not None else f"({factor})*({text})"
        if memory is not None:
            own = (label if name is None else name, text, equation, coefficient, unit)
            return cls(*own, memory=memory, factor=factor)
        jump = " ".join(on.split()) if kind == "coulomb" and on is not None else None
        return cls(label if name is None else name, text, equation, coefficient, unit, jump)

    def parsed(self, motion: Motion) -> Expression:
        """Return the expression on the motion's names.

        Raises:
            InputError: names that the motion does not have, what is no arithmetic.
        """
        return parse_named(self.expression, motion.known, f"suspect '{self.name}'")

    def place(self, motion: Motion) -> int:
        """Return the number of its equation, outputs after states.

        Raises:
            InputError: an unknown equation, or none where there are several.
        """
        known = equations_of(motion)
        if self.equation is not None:
            if self.equation not in known:
                hint = nearest(self.equation, known) or f"; known are {', '.join(known)}"
                raise InputError(
                    f"suspect '{self.name}': no equation is that of '{self.equation}'{hint}."
                )
            return known.index(self.equation)
        likely = usual_places(motion)
        if len(likely) != 1:
            raise InputError(
                f"suspect '{self.name}': `equation` is missing; one of {', '.join(known)}."
            )
        return likely[0]

    def term(self, motion: Motion) -> SuspectedTerm:
        """Return the suspect as a term of the motion.

        Raises:
            InputError: as `parsed` and `place`.
        """
        parsed = self.parsed(motion)
        if self.memory is None:
            return SuspectedTerm(self.name, self.place(motion), parsed)
        factor = parse_named(self.factor or "1", motion.known, f"suspect '{self.name}'")
        return SuspectedTerm(self.name, self.place(motion), factor, Signal(parsed, self.memory))

    def values(self, motion: Motion, p: Vector, x: Matrix, u: Matrix) -> Vector:
        """Return the expression (M,) at states (M, nx) and inputs (M, nu), finite or not.

        Of a term with memory it is what drives the memory.
        """
        with np.errstate(all="ignore"):
            found = self.parsed(motion).value(motion.values(x.T, u.T, p, np), np)
        return np.broadcast_to(np.asarray(found, dtype=float), (len(x),))


def equations_of(motion: Motion) -> tuple[str, ...]:
    """Return the names of all equations, outputs after states."""
    return (*motion.names_of_states, *(output.name for output in motion.outputs))


def usual_places(motion: Motion) -> tuple[int, ...]:
    """Return the state equations likely to lack a term: learned ones, else with parameters."""
    if motion.learned[0]:
        return motion.learned[0]
    if motion.functions is not None:
        return tuple(range(len(motion.states)))
    return tuple(i for i, state in enumerate(motion.states) if motion.parameters_in(state.name))


def check_motion_suspects(suspects: Sequence[MotionSuspect], problem: MotionProblem) -> None:
    """Raise InputError for suspects that the motion cannot have, or without a value somewhere."""
    motion, (x, u) = problem.motion, problem.guessed_points
    check_unique((suspect.name for suspect in suspects), "suspect")
    for suspect in suspects:
        suspect.place(motion)
        values = suspect.values(motion, motion.initial, x.T, u.T)
        if not np.isfinite(values).all():
            k = int(np.argmax(~np.isfinite(values)))
            at = zip((*motion.names_of_states, *motion.inputs), (*x[:, k], *u[:, k]), strict=True)
            where = ", ".join(f"{name} = {value:.4g}" for name, value in at)
            raise InputError(
                f"suspect '{suspect.name}' = {suspect.expression} is not finite at {where}."
            )


def motion_width(on: str, motion: Motion, x: Matrix, u: Matrix) -> float:
    """Return a width from states x (M, nx) and inputs u (M, nu): the median of nonzero |on|.

    It is rounded to six digits.

    Raises:
        InputError: an expression that cannot be read, that is not finite, or zero everywhere.
    """
    size = np.abs(MotionSuspect(on, on).values(motion, motion.initial, x, u))
    if not np.isfinite(size).all() or not np.any(size > 0):
        raise InputError(
            f"'{on}' is zero or not finite over the guessed states; give a `width`, or its "
            "state a `start`."
        )
    return float(f"{np.median(size[size > 0]):.6g}")


def _check_parentheses(text: str) -> None:
    """Raise InputError where parentheses are no pairs: names are checked with the motion."""
    depth = 0
    for letter in text:
        depth += (letter == "(") - (letter == ")")
        if depth < 0:
            break
    if depth or not text.strip():
        raise InputError(
            f"'{text}' is no expression: its parentheses do not match, or it is empty."
        )


def soften_jumps(
    suspects: Sequence[MotionSuspect], motion: Motion, p: Vector, x: Matrix, u: Matrix
) -> tuple[MotionSuspect, ...]:
    """Return smooth forms of friction: each suspect that jumps as tanh(v/width), of several widths.

    Args:
        p: parameters (np,); with states x (M, nx) and inputs u (M, nu) they give the widths, in
            median sizes.
    """
    found = []
    for suspect in suspects:
        if suspect.jump is None:
            continue
        size = np.abs(MotionSuspect(suspect.jump, suspect.jump).values(motion, p, x, u))
        size = size[np.isfinite(size) & (size > 0)]
        on = suspect.jump if suspect.jump.isidentifier() else f"({suspect.jump})"
        for share in _WIDTHS if len(size) else ():
            width = float(f"{share * np.median(size):.3g}")
            soft = f"tanh({on}/{width!r})"
            text = suspect.expression.replace(f"sign({suspect.jump})", soft)
            found.append(
                replace(suspect, name=f"{suspect.name} as {soft}", expression=text, jump=None)
            )
    return tuple(found)


def usual_motion_suspects(
    motion: Motion, x: Matrix, u: Matrix, on: Sequence[str] = ()
) -> tuple[MotionSuspect, ...]:
    """Return the usual suspects: friction, drag, hardening, bent inputs, an offset.

    Args:
        x: states (M, nx) that it is about; with inputs u (M, nu) they give the widths.
        on: expressions that the learner sees, such as the distance of two masses.
    """
    names, inputs = motion.names_of_states, motion.inputs
    features = [text for text in dict.fromkeys(on) if text not in (*names, *inputs)]
    seen = [MotionSuspect(text, text).values(motion, motion.initial, x, u) for text in features]
    moving = [
        (name, kinds, row)
        for of, rows, kinds in (
            (names, x.T, _OF_STATES),
            (inputs, u.T, _OF_INPUTS),
            (features, seen, _OF_FEATURES),
        )
        for name, row in zip(of, rows, strict=True)
        if np.ptp(row) > 0
    ]
    places = usual_places(motion)
    found = []
    for place in places:
        equation = motion.states[place].name
        where = f" in {equation}" if len(places) > 1 else ""
        for name, kinds, row in moving:
            for kind in kinds:
                if kind in ODD_JUMPS and not changes_sign(row):
                    continue
                width = motion_width(name, motion, x, u) if kind in WIDTHS else None
                label = f"{kind} of {name}{where}"
                found.append(
                    MotionSuspect.of(kind, name, width=width, equation=equation, name=label)
                )
        found.append(MotionSuspect.of("offset", equation=equation, name=f"offset{where}"))
    return tuple(found)
