"""Catalogue of the terms that a physics may lack, for difference equations and for motions.

It has the usual suspects (friction, drag, hardening, bent inputs, an offset, a multiple of what an
equation does not read), products of two lags, and families: a line of `FAMILIES` is a form whose
width or power is profiled, and each member is tried on everything that the learner sees. What a
term can act on, and which outputs or equations may lack it, is all that differs between kinds of
physics.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug.analysis.suspects import (
    ODD_JUMPS,
    WIDTHS,
    MotionSuspect,
    Suspect,
    as_operand,
    changes_sign,
    evaluate_rows,
    is_level,
    median_size,
)
from orthaug.data.expressions import parse
from orthaug.physics.motion import Motion
from orthaug.physics.problem import Problem
from orthaug.physics.suspected_motion import usual_places

_VELOCITY = ("coulomb", "stribeck", "quadratic_drag", "cubic")
_POSITION = ("cubic", "dead_zone")
# Of an output read at one lag only, which may be a velocity
_SINGLE = (*_POSITION, "saturation", "coulomb")
_INPUT = ("cubic", "dead_zone", "saturation")
_STATE = ("coulomb", "quadratic_drag", "cubic")
_FEATURE = (*_STATE, "dead_zone")
_MULTIPLIED = 6  # lags at most, of which products are tried
_WIDTHS = (0.06, 0.125, 0.25, 0.5, 1.0, 2.0, 4.0)  # in median sizes of what a term acts on
_SOFT = _WIDTHS[1:]  # of friction that turns round smoothly
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
    level: Callable[[str, str], str] | None = None
    """Writes one that acts on what is never negative, where that is shorter."""
    positive: bool = False
    """True if it acts only on what is positive."""

    def expression(self, on: str, width: str, *, level: bool = False) -> str:
        """Return the member of a width, or power, that acts on an expression."""
        text = self.level if level and self.level else self.text
        return text(as_operand(on), width).replace(f"(({on}))", f"({on})")


def _odd_power(x: str, power: str) -> str:
    """Return a power with the sign of x; the square as quadratic drag is written."""
    return f"{x}*abs({x})" if power == "2" else f"sign({x})*abs({x})**{power}"


FAMILIES = (
    Family("tanh", lambda x, w: f"tanh({x}/{w})", _WIDTHS),
    Family("atan", lambda x, w: f"atan({x}/{w})", _WIDTHS),
    Family("stribeck", lambda x, w: f"sign({x})*exp(-abs({x})/{w})", _WIDTHS),
    Family("power", _odd_power, _POWERS, scaled=False),
    Family("dead_zone", lambda x, w: f"{x} - max(min({x}, {w}), -{w})", _KINKS),
    Family("saturation", lambda x, w: f"max(min({x}, {w}), -{w})", _KINKS),
)


_OF_LEVELS: dict[str, Callable[[str, str], str]] = {
    "stribeck": lambda x, w: f"exp(-{x}/{w})",
    "dead_zone": lambda x, w: f"max({x} - {w}, 0)",
    "saturation": lambda x, w: f"min({x}, {w})",
}
RIVALS = (
    *(one._replace(level=_OF_LEVELS.get(one.name)) for one in FAMILIES if one.name != "power"),
    Family("power", _odd_power, (*_POWERS, 3.5, 4.0, 5.0), False, lambda x, w: f"{x}**{w}"),
    Family("exp", lambda x, w: f"exp({x}/{w})", (0.5, 1.0, 2.0)),
    Family("decay", lambda x, w: f"exp(-{x}/{w})", (0.5, 1.0, 2.0)),
    Family("log", lambda x, w: f"log({x})", (1.0,), scaled=False, positive=True),
)
"""What may take the place of a term whose form was selected: a radiation is no cubic."""
SMOOTH_FRICTION = {family.name: family for family in FAMILIES if family.name in ("tanh", "atan")}
"""Families of friction that turns round smoothly."""


class Argument(NamedTuple):
    """An expression that terms may act on, its values in the data, and the usual kinds for it."""

    text: str
    values: Vector
    kinds: tuple[str, ...] = ()
    unread: tuple[str, ...] = ()
    """Places whose physics does not read it, where already a multiple of it may be missing."""


@dataclass(frozen=True, eq=False)
class Catalogue:
    """Candidate terms of one physics.

    Args:
        places: outputs or equations that may lack a term.
        arguments: what the usual suspects act on.
        seen: what the families act on, everything that the learner sees.
        products: expressions that are tried as they are.
        of_kind: makes a suspect of a known kind from kind, argument, width, place and name.
        of_text: makes one from an expression, what it acts on, place and name.
    """

    places: tuple[str, ...]
    arguments: tuple[Argument, ...]
    seen: tuple[Argument, ...]
    products: tuple[str, ...]
    of_kind: Callable[[str, str | None, float | None, str, str], Any]
    of_text: Callable[[str, str | None, str, str], Any]

    @classmethod
    def of_problem(cls, problem: Problem) -> Catalogue:
        """Return the catalogue for physics on lagged signals."""
        layout, outputs, x = problem.layout, problem.outputs, problem.rows.x
        constants, arguments = dict(problem.baseline.constants), []
        read: dict[str, set[str]] = {}  # channels, by output; of a function they are not known
        for term in problem.baseline.terms:
            lags = parse(term.regressor, constants).lags
            for name in outputs if term.output is None else (term.output,):
                read.setdefault(name, set()).update(lag.channel for lag in lags)

        def evaluate(text: str) -> Vector:
            return evaluate_rows(parse(text), x, layout, f"'{text}'")

        for channel in dict.fromkeys(lag.channel for lag in layout):
            lags = sorted(lag for lag in layout if lag.channel == channel)
            first, several = str(lags[0]), len(lags) > 1
            values = evaluate(first)
            unread = tuple(name for name in read if channel not in read[name])
            if channel not in outputs:
                arguments.append(Argument(first, values, _INPUT, unread))
                continue
            root = ("square_root",) if is_level(values) else ()
            kinds = (*(_POSITION if several else _SINGLE), *root)
            arguments.append(Argument(first, values, kinds, unread))
            if several:
                step = f"{first} - {lags[1]}"
                arguments.append(Argument(step, evaluate(step), _VELOCITY))
        texts = [*map(str, problem.features.entries), *(argument.text for argument in arguments)]
        seen = []
        for text in list({text.replace(" ", ""): text for text in texts}.values())[
            :_MOST_ARGUMENTS
        ]:
            try:
                seen.append(
                    Argument(text, Suspect(text, text, constants=constants).form(x, layout))
                )
            except InputError:
                continue
        used = problem.used[:_MULTIPLIED]
        pairs = [(one, other) for i, one in enumerate(used) for other in used[i:]]
        products = [f"{one}**2" if one == other else f"{one}*{other}" for one, other in pairs]

        def of_kind(
            kind: str, on: str | None, width: float | None, place: str, name: str
        ) -> Suspect:
            return Suspect.of(kind, on, width=width, output=place, name=name)

        def of_text(text: str, on: str | None, place: str, name: str) -> Suspect:
            own = constants if on is not None else {}
            return Suspect(name, text, place, None, own, on)

        return cls(outputs, (*arguments,), (*seen,), (*products,), of_kind, of_text)

    @classmethod
    def of_motion(
        cls, motion: Motion, p: Vector, x: Matrix, u: Matrix, features: Sequence[str] = ()
    ) -> Catalogue:
        """Return the catalogue for a motion.

        Args:
            p: parameters (np,); states x (M, nx) and inputs u (M, nu) give the widths.
            features: what the learner sees, such as the distance of two masses.
        """

        def evaluate(text: str) -> Vector:
            return MotionSuspect(text, text).values(motion, p, x, u)

        def of_kind(kind: str, on: str | None, width: float | None, place: str, name: str) -> Any:
            return MotionSuspect.of(kind, on, width=width, equation=place, name=name)

        def of_text(text: str, on: str | None, place: str, name: str) -> Any:
            return MotionSuspect(name, text, place)

        names, features = motion.names_of_states, list(dict.fromkeys(features))
        hidden = {*names, *motion.inputs} - {*motion.visible}
        more = [text for text in features if text not in (*names, *motion.inputs)]
        written = {text.replace(" ", "") for text in more}
        apart = map(str, motion.differences)
        more += [text for text in apart if text.replace(" ", "") not in written]
        places = tuple(motion.states[place].name for place in usual_places(motion))
        read = {
            place: motion.names_in(motion.equations[place])
            for place in places
            if motion.functions is None
        }

        def argument(name: str, values: Vector, kinds: tuple[str, ...]) -> Argument:
            unread = tuple(place for place in read if name not in read[place])
            return Argument(name, values, kinds, unread)

        arguments = [
            *(argument(name, row, _STATE) for name, row in zip(names, x.T, strict=True)),
            *(argument(name, row, _INPUT) for name, row in zip(motion.inputs, u.T, strict=True)),
            *(Argument(text, evaluate(text), _FEATURE) for text in more),
        ]
        return cls(
            places,
            tuple(a for a in arguments if np.ptp(a.values) > 0 and a.text not in hidden),
            tuple(Argument(text, evaluate(text)) for text in features[:_MOST_ARGUMENTS]),
            (),  # no products of states: a motion's families and usual terms have sufficed
            of_kind,
            of_text,
        )

    def usual(self) -> tuple[Any, ...]:
        """Return the usual suspects, with widths from the data."""
        found = []
        for place in self.places:
            label = self._label(place)
            for argument in self.arguments:
                on = argument.text
                if place in argument.unread:
                    found.append(self.of_text(on, on, place, f"multiple of {on}{label}"))
                for kind in argument.kinds:
                    width = median_size(argument.values) if kind in WIDTHS else None
                    if kind in ODD_JUMPS and not changes_sign(argument.values):
                        continue  # what jumps there is as good as a constant
                    if kind in WIDTHS and width is None:
                        continue
                    name = f"{kind} of {on}{label}"
                    found.append(self.of_kind(kind, on, width, place, name))
            found.append(self.of_kind("offset", None, None, place, f"offset{label}"))
        return tuple(found)

    def two_lags(self) -> tuple[Any, ...]:
        """Return products of two lags of physics or learner, for effects beyond the usual ones."""
        return tuple(
            self.of_text(text, None, place, f"{text}{self._label(place)}")
            for place in self.places
            for text in self.products
        )

    def products_of(self, names: Sequence[str]) -> tuple[Any, ...]:
        """Return products of two of these names, each linear or one squared; none of many names."""
        pairs = list(combinations(names, 2)) if len(names) <= _MULTIPLIED else []
        texts = [text for a, b in pairs for text in (f"{a}*{b}", f"{a}**2*{b}", f"{a}*{b}**2")]
        return tuple(
            self.of_text(text, None, place, f"{text}{self._label(place)}")
            for place in self.places
            for text in texts
        )

    def families(self, families: Sequence[Family] = FAMILIES) -> tuple[Any, ...]:
        """Return every member of every family, on everything that the learner sees."""
        return tuple(
            self.of_text(text, argument.text, place, f"{name}{self._label(place)}")
            for argument in self.seen
            for name, text in family_members(argument.text, argument.values, families)
            for place in self.places
        )

    def _label(self, place: str) -> str:
        return f" in {place}" if len(self.places) > 1 else ""


def family_members(
    on: str, values: Vector, families: Sequence[Family] = FAMILIES
) -> Iterator[tuple[str, str]]:
    """Yield name and expression of every member of every family for an expression `on`.

    Those that are not `scaled` are named by their expression: a power is no square of x.
    """
    size = np.abs(values[np.isfinite(values)])
    if not np.any(size > 0):
        return
    median = float(np.median(size[size > 0]))
    positive = bool(np.min(values, initial=np.inf) > 0)
    for family in families:
        if family.positive and not positive:
            continue
        for member in family.members:
            w = f"{member * (median if family.scaled else 1.0):.4g}"
            text = family.expression(on, w, level=bool(np.min(values, initial=0.0) >= 0))
            named = text.startswith(f"{family.name}(") or not family.scaled  # as tanh(v/0.5) is
            yield text if named else f"{family.name}({on}, {w})", text


def saturations(suspects: Sequence[Suspect]) -> list[Suspect]:
    """Return a saturation for each dead zone, the rest of its channel.

    Data of a physics with that channel cannot distinguish the two.
    """
    zones = [suspect for suspect in suspects if suspect.name.startswith("dead_zone")]
    return [
        replace(
            s,
            name=s.name.replace("dead_zone", "saturation"),
            expression=f"{s.on} - ({s.expression})",
        )
        for s in zones
    ]


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
        for share in _SOFT if len(size) else ():
            width = float(f"{share * np.median(size):.3g}")
            soft = f"tanh({on}/{width!r})"
            text = suspect.expression.replace(f"sign({suspect.jump})", soft)
            found.append(
                replace(suspect, name=f"{suspect.name} as {soft}", expression=text, jump=None)
            )
    return tuple(found)
