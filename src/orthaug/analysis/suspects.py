"""Suspected unmodelled terms: friction, drag, hardening, of raw lags or of a motion's names.

They are the "suspected unmodeled terms" of the paper's remark after `cond:special_PE`: what the
physics leaves out by intention, known in form though not in size. A `Suspect` δ(x) adds to an
output; a `MotionSuspect` adds to the derivative of a state, or to an output. With a `factor` such
as -1/m its coefficient is a force in N though the equation is one of m/s².
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import (
    Matrix,
    Vector,
    check_label,
    check_number,
    check_unique,
    is_number,
    nearest,
)
from orthaug._base.errors import InputError
from orthaug.analysis.memory import MemoryTerm
from orthaug.data.expressions import SAMPLING_TIME, Expression, Lag, is_name, parse, parse_named
from orthaug.data.regressors import Layout
from orthaug.physics.motion import Motion
from orthaug.physics.problem import MotionProblem
from orthaug.physics.suspected_motion import (
    Signal,
    SuspectedTerm,
    equations_of,
    usual_places,
)


class _Kind(NamedTuple):
    """Expression of a kind: `text(x, w)` of the channel expression x and the width w."""

    text: Callable[[str, str], str]
    width: bool = False
    memory: bool = False


_WHOLE = re.compile(r"\w+(\[[^\]]*\])?")  # a name, or a lag of one


def as_operand(expression: str) -> str:
    """Return an expression as an operator takes it, in brackets where it needs them."""
    return expression if _WHOLE.fullmatch(expression) else f"({expression})"


def _clip(x: str, w: str) -> str:
    return f"max(min({x}, {w}), -{w})"


_KINDS = {
    "coulomb": _Kind(lambda x, w: f"sign({x})"),
    "stribeck": _Kind(lambda x, w: f"sign({x})*exp(-abs({x})/{w})", width=True),
    "stribeck_gauss": _Kind(lambda x, w: f"sign({x})*exp(-({as_operand(x)}/{w})**2)", width=True),
    "quadratic_drag": _Kind(lambda x, w: f"{as_operand(x)}*abs({x})"),
    "cubic": _Kind(lambda x, w: f"{as_operand(x)}**3"),
    "square_root": _Kind(lambda x, w: f"sign({x})*sqrt(abs({x}))"),
    "dead_zone": _Kind(lambda x, w: f"{as_operand(x)} - {_clip(x, w)}", width=True),
    "saturation": _Kind(_clip, width=True),
    "offset": _Kind(lambda x, w: "1"),
    "expression": _Kind(lambda x, w: x),
    "lag": _Kind(lambda x, w: x, memory=True),
    "backlash": _Kind(lambda x, w: x, width=True, memory=True),
    "lugre": _Kind(lambda x, w: x, width=True, memory=True),
    "bouc_wen": _Kind(lambda x, w: x, width=True, memory=True),
}
KINDS = tuple(_KINDS)
WITH_MEMORY = tuple(kind for kind, entry in _KINDS.items() if entry.memory)
WIDTHS = tuple(kind for kind, entry in _KINDS.items() if entry.width)  # the kinds that need a width
# The kinds that jump where their argument changes sign
ODD_JUMPS = ("coulomb", "stribeck", "stribeck_gauss")
_CLEARLY = 0.05  # of the largest value
# Of the largest value: what is only so far below 0 counts as positive, for it is noise
_BELOW = 0.05


@dataclass(frozen=True)
class Suspect:
    """A suspected term `coefficient * expression` of one output.

    Make one of a known kind with `of`.

    `expression` is in the language of `orthaug.data.expressions` and may use the names in
    `constants` (kept as sorted pairs), and `Ts` for the sampling time. `coefficient` is a guess of
    its size, in the output's unit per unit of the expression, None where there is none. `output`
    may be left out where there is only one. `on` is what a known kind acts on. With `memory` the
    term is the internal state of that memory, driven by the expression along the record.

    Raises:
        InputError: an expression that is not arithmetic on lagged channels, a name or a number that
            is none.

    Examples:
        >>> Suspect("drag", "v[k-1]*abs(v[k-1])", coefficient=-0.1).lags
        (Lag(channel='v', lag=1),)
        >>> Suspect.of("coulomb", "v[k-1]").expression
        'sign(v[k-1])'
    """

    name: str
    expression: str
    output: str | None = None
    coefficient: float | None = None
    constants: Mapping[str, float] | tuple[tuple[str, float], ...] = ()
    on: str | None = None
    memory: MemoryTerm | None = None

    equation = unit = None  # in the words of a motion's suspects

    def __post_init__(self) -> None:
        check_name(self.name)
        if not isinstance(self.output, str | None):
            raise InputError(
                f"suspect '{self.name}': `output` must be the name of a channel; got "
                f"{self.output!r}."
            )
        constants = _checked_constants(dict(self.constants), self.name)
        check_coefficient(self.name, self.coefficient)
        object.__setattr__(self, "constants", constants)
        _ = self.parsed

    @classmethod
    def of(
        cls,
        kind: str,
        on: str | None = None,
        *,
        width: float | None = None,
        time_constant: float | None = None,
        output: str | None = None,
        coefficient: float | None = None,
        name: str | None = None,
        constants: Mapping[str, float] | None = None,
    ) -> Suspect:
        """Return a suspect of a known kind, applied to the channel expression x = `on`.

        | kind | δ | width |
        |---|---|---|
        | `coulomb` | sign(x) | |
        | `stribeck` | sign(x) exp(−abs(x)/width), the paper's decay to Coulomb friction | v_S |
        | `stribeck_gauss` | sign(x) exp(−(x/width)²) | v_S |
        | `quadratic_drag` | x abs(x) | |
        | `cubic` | x³ | |
        | `square_root` | sign(x) √abs(x), as of an outflow | |
        | `dead_zone` | x − clip(x, −width, width) | half of the zone |
        | `saturation` | clip(x, −width, width) | the limit |
        | `offset` | 1, no `on` | |
        | `expression` | x itself | |
        | `lag` | x behind a first-order lag | |
        | `backlash` | play `z⁺ = min(max(z, x − width), x + width)` | half of the gap |
        | `lugre` | bristle `z⁺ = z + d − abs(d) z/width`, d the step of x | largest z |
        | `bouc_wen` | hysteresis `z⁺ = z + d − (abs(d) abs(z) z + d z²)/(2 width²)` | largest z |

        Args:
            kind: one of `KINDS`.
            on: any expression, such as `"v[k-1]"` or `"(y[k-1] - y[k-2])/Ts"`.
            width: in the unit of x, positive; the median of |x| where it is not zero is usual.
            time_constant: of a lag, in s, positive.
            output, coefficient, constants: as in `Suspect`.
            name: default the kind with its arguments, such as `coulomb(v[k-1])`.

        Raises:
            InputError: an unknown kind, an argument that is missing, that the kind does not take,
                or that does not parse.

        Examples:
            >>> Suspect.of("dead_zone", on="u[k-1]", width=0.5).expression
            'u[k-1] - max(min(u[k-1], 0.5), -0.5)'
        """
        text, label, on = suspect_text(
            kind, on, width, lambda text: parse(text, constants), "v[k-1]", time_constant
        )
        memory = memory_of(kind, on, width, time_constant)
        own = (label if name is None else name, text, output, coefficient)
        return cls(*own, constants or (), on, memory)

    @property
    def parsed(self) -> Expression:
        """The expression, parsed."""
        try:
            return parse(self.expression, dict(self.constants))
        except InputError as error:
            raise InputError(f"suspect '{self.name}': {error}") from None

    def sampled(self, sampling_time: float) -> Suspect:
        """Return the suspect with this value [s] of `Ts`, if it needs it and has none."""
        known = SAMPLING_TIME in dict(self.constants)
        if not self.parsed.unsampled and (self.memory is None or known):
            return self
        return replace(
            self, constants=(*dict(self.constants).items(), (SAMPLING_TIME, float(sampling_time)))
        )

    @property
    def lags(self) -> tuple[Lag, ...]:
        """The raw lags that it reads."""
        return self.parsed.lags

    def values(
        self,
        x: Matrix,
        layout: Layout,
        outputs: Sequence[str],
        lengths: Sequence[int] | None = None,
    ) -> Matrix:
        """Return δ(x) (N, ny) for a coefficient of 1: the expression in its output's column.

        Other columns are zero.

        Args:
            x: regressors (N, nx) in the order of `layout`.
            outputs: names of the ny outputs.
            lengths: rows of each experiment, where x are the rows of a record one after the other;
                a term with memory needs them.

        Raises:
            InputError: lags that the layout lacks, an output that is missing or unknown, a value
                that is not finite, a term with memory on points that are no record.
        """
        values, column = np.zeros((len(x), len(outputs))), self.form(x, layout, lengths)
        bad = np.flatnonzero(~np.isfinite(column))
        if bad.size:
            raise InputError(
                f"suspect '{self.name}' = {self.expression} is not finite at row {bad[0]} of "
                "the regressor."
            )
        values[:, self.column_of(outputs)] = column
        return values

    def form(self, x: Matrix, layout: Layout, lengths: Sequence[int] | None = None) -> Vector:
        """Return the term on rows of the regressor (N,), also where it is not finite.

        Args:
            x, layout, lengths: as `values`.

        Raises:
            InputError: lags that the layout lacks, a term with memory on points that are no record.
        """
        with np.errstate(all="ignore"):
            found = evaluate_rows(self.parsed, x, layout, f"suspect '{self.name}'")
        if self.memory is None:
            return found
        if lengths is None:
            raise InputError(
                f"suspect '{self.name}' has memory: it has values along a record only. Use the "
                "training measure, or leave it out."
            )
        step = dict(self.constants)[SAMPLING_TIME]
        parts = np.split(found, np.cumsum(lengths)[:-1])
        return np.concatenate([self.memory.along(part, step) for part in parts])

    def column_of(self, outputs: Sequence[str]) -> int:
        known = ", ".join(outputs)
        if self.output is None:
            if len(outputs) != 1:
                raise InputError(f"suspect '{self.name}': `output` is missing; one of {known}.")
            return 0
        if self.output not in outputs:
            hint = nearest(self.output, outputs)
            raise InputError(
                f"suspect '{self.name}': unknown output '{self.output}'{hint}; known are {known}."
            )
        return list(outputs).index(self.output)


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

    output = on = None  # in the words of lagged suspects

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
                hint = nearest(self.equation, known) or f"; known are {', '.join(known)}."
                raise InputError(
                    f"suspect '{self.name}': no equation is that of '{self.equation}'{hint}"
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


def check_name(name: Any) -> None:
    """Raise InputError for what cannot name a suspect."""
    if not isinstance(name, str) or not name.strip() or not name.isprintable():
        raise InputError(f"{name!r} cannot name a suspect; use visible characters on one line.")


def check_coefficient(suspect: str, coefficient: object) -> None:
    """Raise InputError for a coefficient that is no number."""
    if coefficient is not None and not is_number(coefficient):
        raise InputError(
            f"suspect '{suspect}': `coefficient` must be a finite number; got {coefficient!r}."
        )


def memory_of(
    kind: str, on: str | None, width: float | None, time_constant: float | None
) -> MemoryTerm | None:
    """Return the memory of a kind, None of a kind without one.

    Arguments are those of `suspect_text`.
    """
    if kind not in WITH_MEMORY:
        return None
    scale = time_constant if kind == "lag" else width
    assert on is not None and scale is not None, "`suspect_text` has checked them"
    return MemoryTerm(kind, on, float(scale))


def suspect_text(
    kind: str,
    on: str | None,
    width: float | None,
    read: Callable[[str], object],
    example: str,
    time_constant: float | None = None,
) -> tuple[str, str, str | None]:
    """Return expression and label of a known kind, and its variable in plain spaces.

    Args:
        read: raises for what is no expression.
        example: of what a kind may act on.
        time_constant: of a lag, in s.

    Raises:
        InputError: an unknown kind, an argument that is missing, or that the kind does not take.
    """
    if kind not in _KINDS:
        raise InputError(
            f"unknown kind of suspect '{kind}'{nearest(str(kind), KINDS)}; known are "
            f"{', '.join(KINDS)}."
        )
    if kind == "offset" and on is not None:
        raise InputError(f"an offset is the same everywhere and takes no `on`; got {on!r}.")
    if kind != "offset":
        if on is None:
            raise InputError(
                f"a suspect of kind {kind} needs `on`, an expression such as {example}."
            )
        read(on)  # alone, so that a stray parenthesis cannot change what the kind wraps around it
        on = " ".join(on.split())
    if _KINDS[kind].width and width is None:
        raise InputError(
            f"a suspect of kind {kind} needs `width`, in the unit of {on}. Usual is the median of "
            "its size where it is not zero."
        )
    if width is not None and not _KINDS[kind].width:
        raise InputError(f"a suspect of kind {kind} takes no `width`; got {width!r}.")
    if kind == "lag" and time_constant is None:
        raise InputError("a suspect of kind lag needs `time_constant`, in s.")
    if kind != "lag" and time_constant is not None:
        raise InputError(
            f"a suspect of kind {kind} takes no `time_constant`; got {time_constant!r}."
        )
    w = "" if width is None else repr(check_number(width, "width", positive=True))
    text = _KINDS[kind].text(on or "", w)
    if time_constant is not None:
        w = f"{check_number(time_constant, 'time_constant', positive=True)!r} s"
    arguments = ", ".join(part for part in (on, w) if part)
    return text, text if kind == "expression" else f"{kind}({arguments})" if arguments else kind, on


def suspect_columns(
    suspects: Sequence[Suspect],
    x: Matrix,
    layout: Layout,
    outputs: Sequence[str],
    lengths: Sequence[int] | None = None,
) -> Float[np.ndarray, "ns N ny"]:
    """Return δ(x) of every suspect for a coefficient of 1, (ns, N, ny).

    The unit is that of the output per unit of the coefficient. Arguments are those of
    `Suspect.values`.

    Raises:
        InputError: two suspects of one name; as `Suspect.values`.
    """
    check_unique((suspect.name for suspect in suspects), "suspect")
    columns = [suspect.values(x, layout, outputs, lengths) for suspect in suspects]
    return np.stack(columns) if columns else np.zeros((0, len(x), len(outputs)))


def data_width(
    on: str, x: Matrix, layout: Layout, constants: Mapping[str, float] | None = None
) -> float:
    """Return a width from the data: the median of nonzero |x|, to six digits, in the unit of `on`.

    Half of the moving samples then lie inside a dead zone, a saturation or a Stribeck peak, so that
    the data show both sides of it.

    Raises:
        InputError: an expression that does not parse, that is not finite, or that is zero on all
            rows.
    """
    with np.errstate(all="ignore"):
        size = np.abs(evaluate_rows(parse(on, constants), x, layout, f"'{on}'"))
    if not np.all(np.isfinite(size)):
        raise InputError(
            f"'{on}' is not finite at row {np.flatnonzero(~np.isfinite(size))[0]} of the regressor."
        )
    width = median_size(size)
    if width is None:
        raise InputError(f"'{on}' is zero on all rows; the data give no width. State one.")
    return width


def median_size(values: np.ndarray) -> float | None:
    """Return the median of nonzero |values| to six digits; None of zeros, or not finite ones."""
    size = np.abs(values)
    if not np.isfinite(size).all() or not np.any(size > 0):
        return None
    return float(f"{np.median(size[size > 0]):.6g}")


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


def changes_sign(values: Vector) -> bool:
    """Return whether values (N,) lie clearly on both sides of zero.

    Otherwise what jumps there is as good as a constant.
    """
    edge = _CLEARLY * np.abs(values).max(initial=0.0)
    return bool(np.min(values, initial=0.0) < -edge and np.max(values, initial=0.0) > edge)


def is_level(values: Vector) -> bool:
    """Return whether values (N,) are positive but for noise, so that their root may be missing."""
    return bool(np.min(values) >= -_BELOW * np.max(values))


def evaluate_rows(expression: Expression, x: Matrix, layout: Layout, what: str) -> np.ndarray:
    """Return an expression on rows of the regressor (N,), finite or not."""
    missing = [str(lag) for lag in expression.lags if lag not in layout]
    if missing:
        held = ", ".join(map(str, layout))
        raise InputError(
            f"{what} reads {', '.join(missing)}, which the regressor does not hold; it holds "
            f"{held}."
        )
    values = expression.evaluate({lag: x[:, j] for j, lag in enumerate(layout)}, np)
    return np.broadcast_to(np.asarray(values, dtype=float), (len(x),))


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


def _checked_constants(
    constants: Mapping[str, float], suspect: str
) -> tuple[tuple[str, float], ...]:
    for name, value in constants.items():
        if not isinstance(name, str) or not is_name(name):
            raise InputError(f"suspect '{suspect}': {name!r} cannot name a constant.")
        if not is_number(value):
            raise InputError(
                f"suspect '{suspect}': the constant '{name}' must be a finite number; got "
                f"{value!r}."
            )
    return tuple(sorted((name, float(value)) for name, value in constants.items()))
