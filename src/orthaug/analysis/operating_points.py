"""Points of rest of a model: its equilibria under constant inputs, found or given and checked.

Inputs that nobody fixes are 0, or their means over a record. Where outputs or states are fixed,
inputs that nobody fixes are looked for with the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from orthaug._base.checks import Matrix, Vector, is_number, nearest
from orthaug._base.errors import InputError, Warning, show
from orthaug.analysis.linear_steps import Step, at_rest, difference_widths, sizes_of
from orthaug.models.dynamics import Numbers
from orthaug.models.model import Model

_STARTS = 32  # points of a Halton sequence in the box of the training data, beside the middle
_SOLVED = 1e-9  # of what is zero at rest over the starts
_SAME = 1e-6  # of sizes: points that are as near are one
_SINGULAR = 1e-10  # of singular values: directions along which rest does not end
_FAR = 2.0  # times the training range: an equilibrium beyond is given only if there is no other
_NOTHING = 1e-13  # of sizes: rounding of 0
_POLISH = 5  # Newton steps


@dataclass(frozen=True, eq=False)
class Slopes:
    """Slopes of a point's equations by (rest, inputs), (m, ne + nu), and the `free` unknowns.

    `value` holds the unknowns.
    """

    matrix: Matrix
    free: Bool[np.ndarray, "k"]
    outputs: tuple[int, ...]
    """Numbers of the outputs whose values are equations too."""

    def follow(self, change: Float[np.ndarray, "m r"]) -> Float[np.ndarray, "k r"]:
        """Return the change of (rest, inputs) by changed equations (implicit function theorem)."""
        moved = np.zeros((len(self.free), change.shape[1]))
        if self.free.any():
            moved[self.free] = -np.linalg.pinv(self.matrix[:, self.free], rcond=_SINGULAR) @ change
        return moved


@dataclass(frozen=True, eq=False)
class OperatingPoint:
    """A point of rest: `values` of states or outputs and inputs by name, `outputs` likewise.

    `outside` is whether it lies beyond what training reached, or the learner's features do;
    `line` whether it is one of a continuum.
    """

    rest: Vector
    inputs: Vector
    values: dict[str, float]
    outputs: dict[str, float]
    outside: bool
    line: bool
    slopes: Slopes = field(repr=False)

    def __str__(self) -> str:
        named = self.outputs | self.values
        return ", ".join(f"{name} = {value:.6g}" for name, value in named.items())


def parse_point(at: str | Mapping[str, float] | None) -> dict[str, float]:
    """Return `"force=0, position=1"` as a mapping.

    Raises:
        InputError: no pairs of names and finite numbers, or a name twice.
    """
    if at is None:
        return {}
    if isinstance(at, str):
        pairs = [part.partition("=") for part in at.split(",") if part.strip()]
        given: dict[str, Any] = {}
        for name, _, value in pairs:
            name = name.strip()
            if name in given:
                raise InputError(f"the operating point gives '{name}' twice.")
            given[name] = _number(value)
        at = given
    wanted = 'names with finite numbers, such as "force=0, position=1"'
    if not isinstance(at, Mapping):
        raise InputError(f"the operating point must be {wanted}; got {show(at)}.")
    for name, value in at.items():
        if not isinstance(name, str) or not name or not is_number(value):
            raise InputError(
                f"the operating point must be {wanted}; got {show(name)} = {show(value)}."
            )
    return {name: float(value) for name, value in at.items()}


def _number(text: str) -> Any:
    try:
        return float(text)
    except ValueError:
        return text.strip()


@dataclass(frozen=True, eq=False)
class Search:
    """Search for a point of rest: `given` values of rest and inputs, NaN where free, and outputs.

    `outputs` are by their number.
    """

    step: Step
    numbers: Numbers
    size: Vector
    """Of the rest."""
    given: Vector
    wanted: dict[int, float]
    middle: Vector
    """Where the search starts, of rest and inputs."""
    beyond: Callable[[Matrix], Any]
    """Where features (N, nz) lie outside of what training reached."""

    @classmethod
    def of(
        cls,
        step: Step,
        model: Model,
        outputs: Sequence[str],
        at: Mapping[str, float],
        held: Vector,
    ) -> Search:
        """Return the search; `held` (nu,) are the inputs that nobody fixes.

        Raises:
            InputError: a name that the model does not have.
        """
        places = {name: i for i, name in enumerate((*step.rest, *step.inputs))}
        given = np.full(len(places), np.nan)
        wanted: dict[int, float] = {}
        for name, value in at.items():
            if name in places:
                given[places[name]] = value
            elif name in outputs:
                wanted[list(outputs).index(name)] = value
            else:
                known = list(dict.fromkeys((*step.inputs, *step.rest, *outputs)))
                hint = nearest(name, known)
                raise InputError(
                    f"the model has no '{show(name)[1:-1]}'{hint}; known are {', '.join(known)}."
                )
        ne = len(step.rest)
        trims = bool(wanted) or bool(np.isfinite(given[:ne]).any())
        if not trims:
            given[ne:] = np.where(np.isnan(given[ne:]), held, given[ne:])
        middle = np.concatenate([np.zeros(ne), held])
        middle = np.where(np.isnan(given), middle, given)
        return cls(step, model.numbers, sizes_of(model), given, wanted, middle, model.beyond)

    @property
    def free(self) -> Bool[np.ndarray, "k"]:
        """Mask of the unknowns among rest and inputs."""
        return np.isnan(self.given)

    @property
    def scale(self) -> Vector:
        """Scale of rest and inputs."""
        return np.concatenate([self.size, np.maximum(np.abs(self.middle[len(self.size) :]), 1.0)])

    def equations(self, point: Vector) -> tuple[Vector, Matrix, Vector]:
        """Return the residuals (m,), their slopes by rest and inputs (m, k), and the outputs."""
        ne = len(self.step.rest)
        width = difference_widths(self.size, point[ne:])
        value, outputs, slope = map(
            np.asarray, at_rest(self.step, self.numbers, point[:ne], point[ne:], width)
        )
        rows = list(self.wanted)
        value = np.concatenate([value, outputs[rows] - np.array([self.wanted[i] for i in rows])])
        slope = np.concatenate([slope[:ne], slope[ne:][rows]])
        return value, np.where(np.isfinite(slope), slope, 0.0), outputs

    def starts(self) -> Float[np.ndarray, "s k"]:
        """Return the middle, then points of the box that training reached."""
        from scipy.stats import qmc  # slow to import

        free = self.free
        if not free.any():
            return self.middle[None]
        spread = 2 * qmc.Halton(int(free.sum()), scramble=False).random(_STARTS + 1)[1:] - 1
        points = np.tile(self.middle, (_STARTS + 1, 1))
        points[1:, free] += spread * self.scale[free]
        return points


def operating_points(search: Search) -> tuple[list[OperatingPoint], list[Warning]]:
    """Return all that were found, the nearest to the middle first.

    Raises:
        InputError: none.
    """
    starts = search.starts()
    with np.errstate(all="ignore"):
        sizes = np.abs([search.equations(start)[0] for start in starts])
        unit = np.max(np.where(np.isfinite(sizes), sizes, 0.0), axis=0)
    unit = np.where(unit > 0, unit, 1.0)
    found: list[OperatingPoint] = []
    for start in starts:
        point = _solve_rest(search, start, unit)
        if point is None:
            continue
        one = _point(search, point)
        near = [
            np.abs((_join_unknowns(other) - point) / search.scale).max(initial=0.0) < _SAME
            for other in found
        ]
        if any(near) or (one.line and any(other.line for other in found)):
            continue
        found.append(one)
    if not found:
        raise InputError(_reason_for_none(search, starts))
    found.sort(
        key=lambda one: float(np.linalg.norm((_join_unknowns(one) - search.middle) / search.scale))
    )
    return _within_reach(search, found)


def _within_reach(
    search: Search, found: list[OperatingPoint]
) -> tuple[list[OperatingPoint], list[Warning]]:
    """Return those that training came near to, if there are any, and what is to be said."""
    warnings = []
    ne = len(search.size)
    near = [one for one in found if np.all(np.abs(one.rest) <= _FAR * search.size[:ne])] or found[
        :1
    ]
    if len(near) < len(found):
        text = (
            f"{len(found) - len(near)} more equilibria lie far outside of the training data "
            "and are left out."
        )
        warnings.append(Warning("equilibria_left_out", text))
    if len(near) > 1:
        text = f"{len(near)} equilibria belong to these inputs; fix an output to choose one."
        warnings.append(Warning("several_equilibria", text))
    if any(one.line for one in near):
        text = (
            "the equilibrium is one of a continuum (the model integrates, or too little is "
            "fixed); one is taken."
        )
        warnings.append(Warning("continuum_of_equilibria", text))
    if any(one.outside for one in near):
        where = "the operating point lies" if len(near) == 1 else "operating points so marked lie"
        text = f"{where} outside of the training data, where the model is not validated."
        warnings.append(Warning("outside_training", text))
    return near, warnings


def _join_unknowns(point: OperatingPoint) -> Vector:
    return np.concatenate([point.rest, point.inputs])


def _solve_rest(search: Search, start: Vector, unit: Vector) -> Vector | None:
    """Return the point of rest that a start leads to; None where it leads nowhere."""
    from scipy.optimize import least_squares  # slow to import

    free, point = search.free, start.copy()

    def at(values: Vector) -> tuple[Any, Any]:
        point[free] = start[free] + values * search.scale[free]
        value, slope, _ = search.equations(point)
        return value / unit, slope[:, free] / unit[:, None] * search.scale[free]

    with np.errstate(all="ignore"):
        begin = np.zeros(int(free.sum()))
        if not np.isfinite(at(begin)[0]).all():
            return None
        if free.any():
            try:
                jacobian: Any = lambda v: at(v)[1]  # noqa: E731
                begin = least_squares(lambda v: at(v)[0], begin, jacobian, xtol=1e-14, ftol=1e-14).x
            except ValueError:  # a residual that is not finite on the way
                return None
            for _ in range(_POLISH):
                value, slope = at(begin)
                begin = begin - np.linalg.pinv(slope, rcond=_SINGULAR) @ value
        value = at(begin)[0]
    if not np.all(np.abs(value) <= _SOLVED):
        return None
    return np.where(free & (np.abs(point) < _NOTHING * search.scale), 0.0, point)


def _point(search: Search, point: Vector) -> OperatingPoint:
    ne, step = len(search.step.rest), search.step
    rest, inputs = point[:ne], point[ne:]
    _, slope, y = search.equations(point)
    outputs = dict(zip(step.form.outputs, map(float, y), strict=True))
    values = dict(zip((*step.rest, *step.inputs), map(float, point), strict=True))
    seen = step.seen(search.numbers, rest, inputs)
    beyond = seen is not None and bool(search.beyond(seen[None])[0])
    outside = beyond or bool(np.any(np.abs(rest) > search.size))
    free = search.free
    scaled = slope[:, free] * search.scale[free]
    sizes = np.linalg.svd(scaled, compute_uv=False) if scaled.size else np.ones(1)
    line = bool(free.any()) and (
        free.sum() > len(scaled) or sizes[-1] <= _SINGULAR * max(sizes[0], 1e-300)
    )
    return OperatingPoint(
        rest, inputs, values, outputs, outside, line, Slopes(slope, free, tuple(search.wanted))
    )


def _reason_for_none(search: Search, starts: Matrix) -> str:
    """Return the reason why there is no point."""
    names = (*search.step.rest, *search.step.inputs)
    fixed = [
        f"{name} = {value:.6g}"
        for name, value in zip(names, search.given, strict=True)
        if np.isfinite(value)
    ]
    fixed += [f"{search.step.form.outputs[i]} = {value:.6g}" for i, value in search.wanted.items()]
    at = f" at {', '.join(fixed)}" if fixed else ""
    if not search.free.any():
        moves = ", ".join(search.step.rest)
        return (
            f"the model does not rest{at}: {moves} would move. Fix less, so that the rest can "
            "be found."
        )
    found = f"no equilibrium was found{at}, from {len(starts)} starts: either the model"
    if not search.step.inputs:
        return f"{found} never rests, or these values exclude each other. Give others, or fix less."
    return (
        f"{found} integrates (it rests at other inputs only), or these values exclude each "
        "other. Give other inputs, or data whose mean inputs are held, or fix an output and "
        "leave inputs open."
    )
