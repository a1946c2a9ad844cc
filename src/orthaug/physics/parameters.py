"""Physical parameters p (m, ks, cd …), their coordinates, and θ = h(p) with dh/dp.

Estimated is p itself, or log p where p is positive: that keeps it so without a bound, and steps of
it are relative.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np
from jaxtyping import Bool

from orthaug._base.checks import Matrix, Vector, check_finite, check_label, check_unique, nearest
from orthaug._base.errors import InputError
from orthaug.data.expressions import RESERVED, SAMPLING_TIME, Expression, is_name, parse_named
from orthaug.data.headers import split_header, unit_of_time
from orthaug.physics.baseline import Baseline, Parameter, check_bounds
from orthaug.physics.excitation import Excitation, excitation

_RATE = re.compile(r"1/(ms|s|min|h|hr|hour|d|day|week|month|yr|year)")
# Times other than s in a unit, and factors by which an equation converts them
_OTHER_TIME = re.compile(r"(?<![A-Za-z])(min|h|hr|hour|d|day|week)(?![A-Za-z])")
_CONVERTS = re.compile(r"(?<![\w.])(60|1440|3600|86400|1000|1e3|0\.001|1e-3)(\.0*)?(?![\w.])")
_FACTORS = {60.0, 1440.0, 3600.0, 86400.0, 1000.0, 0.001, 1 / 60, 1 / 3600, 1 / 86400}
AGREEMENT = 1e-6  # relative difference up to which a term's `initial` is what the physics gives

_FAR = np.log(1e4)
_SMALLEST = math.exp(-30.0)  # of p⁰: a positive parameter that is smaller is zero
_STEP = 1e-100  # h relative to p: h² vanishes beside 1, and products with h are far from underflow


def _complex_arctan2(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    slope = np.real(b) * np.imag(a) - np.real(a) * np.imag(b)
    return np.arctan2(np.real(a), np.real(b)) + 1j * slope / (np.real(a) ** 2 + np.real(b) ** 2)


# The functions that `Expression.evaluate` uses of numpy, on p + ih: Im θ / h is dθ/dp by the
# complex step (Squire & Trapp 1998), exact up to rounding whatever the scales of p are. The
# functions of numpy are analytic, these seven are not. They take the branch of the real part: at a
# kink that is the slope of one side.
_COMPLEX = SimpleNamespace(
    asarray=lambda x, dtype=None: np.asarray(x, dtype=complex),
    abs=lambda x: np.where(np.real(x) < 0, -1.0, 1.0) * x,
    sign=lambda x: np.sign(np.real(x)),
    floor=lambda x: np.floor(np.real(x)),
    arctan=np.arctan,
    arctan2=_complex_arctan2,
    minimum=lambda a, b: np.where(np.real(a) <= np.real(b), a, b),
    maximum=lambda a, b: np.where(np.real(a) >= np.real(b), a, b),
    **{name: getattr(np, name) for name in ("sin", "cos", "tan", "exp", "log", "sqrt", "tanh")},
)


def time_unit(units: Iterable[str], column: str | None = None) -> str:
    """Return the unit of time of equations whose parameters have these units.

    Equations are in the time of the record, so that rates in 1/day mean that its steps are days.
    It is s where rates differ, and where the instants of a `column` were read in seconds.

    Examples:
        >>> time_unit(["1/day", "", "1/day"]), time_unit(["kg", "N/m"]), time_unit(["1/h", "1/s"])
        ('day', 's', 's')
        >>> time_unit(["1/min"], column="t [min]")
        's'
    """
    if _is_in_seconds(column):
        return "s"
    found = {unit.replace(" ", "") for unit in units if _RATE.fullmatch(unit.replace(" ", ""))}
    return found.pop()[2:] if len(found) == 1 else "s"


def _is_in_seconds(column: str | None) -> bool:
    """Return whether the instants of a column were surely read in seconds: it names their unit."""
    if column is None:
        return False
    unit = unit_of_time(column)[1]
    return unit is not None and (unit != 1.0 or bool(split_header(column)[1]))


def check_time_units(motion: Any, column: str | None) -> tuple[str, ...]:
    """Check that rates and times in equations of motion are in s where instants surely are.

    A column of instants whose header has a unit is read in seconds, and derivatives are per second.
    Equations with a factor that converts, such as 60, are left to the user.

    Args:
        motion: its states and parameters.
        column: of the instants; None where a sampling time was given, whose unit only the user
            knows.

    Returns:
        The parameters in these equations whose units have another time among others, such as
        K/min.

    Raises:
        InputError: a parameter in 1/min, or in min.
    """
    if not _is_in_seconds(column) or motion.scheme.discrete:
        return ()
    if motion.functions is not None or motion.source is not None:
        return ()
    texts = [*(e.text for e in motion.equations.values()), *(e.text for _, e in motion.definitions)]
    if any(_CONVERTS.search(text) for text in texts):
        return ()
    if any(float(value) in _FACTORS for _, value in motion.constants):
        return ()
    found = []
    read = {name for state in motion.equations for name in motion.parameters_in(state)}
    for one in (one for one in motion.parameters if one.name in read):
        unit = one.unit.replace(" ", "")
        rate = unit.startswith("1/")
        name = unit[2 * rate :]
        is_of_time = len(name) > 2 or name == name.lower()  # H is the henry, and h the hour
        factor = unit_of_time(f"x [{name}]")[1] if unit and is_of_time else None
        if factor is None and _OTHER_TIME.search(unit):
            found.append(one.name)
        elif factor is not None and factor != 1.0:
            value = one.initial / factor if rate else one.initial * factor
            raise InputError(
                f"parameter '{one.name}' has the unit {one.unit}, but equations are per second: "
                f"the instants of column '{column}' are read in seconds. Give its initial value "
                f"({value:.4g}), bounds and unit in {'1/' * rate}s, or convert it in the equation."
            )
    return tuple(found)


@dataclass(frozen=True)
class PhysicalParameter:
    """One entry of p: name, initial value, unit and bounds.

    A `min` of 0 says that it is positive: it is then estimated as a logarithm, and its interval is
    positive too. `selected` says that it is the coefficient of a term whose form was selected from
    the data: other forms that fit as well then count in the intervals of all parameters.

    Examples:
        >>> PhysicalParameter("m", 1.2, "kg", min=0)
        PhysicalParameter(name='m', initial=1.2, unit='kg', min=0, max=inf, selected=False)
    """

    name: str
    initial: float
    unit: str = ""
    min: float = -math.inf
    max: float = math.inf
    selected: bool = False


@dataclass(frozen=True)
class Coordinates:
    """The map between parameters p (np,) and their estimated coordinates q (np,)."""

    parameters: Sequence[Parameter | PhysicalParameter]
    logarithms: bool = True
    """True if positive parameters are estimated as logarithms; θ that is solved for is not."""

    @property
    def positive(self) -> Bool[np.ndarray, "np"]:
        """Mask of the parameters that are estimated as logarithms.

        These cannot be negative and start above zero.
        """
        return np.array(
            [self.logarithms and p.min >= 0 and p.initial > 0 for p in self.parameters], dtype=bool
        )

    @property
    def initial(self) -> Vector:
        """q⁰ (np,)."""
        return self.of(np.array([p.initial for p in self.parameters], dtype=float))

    def of(self, p: Any) -> Vector:
        """Return q of p; logarithms end at the smallest value that counts."""
        least = np.array([_SMALLEST * abs(parameter.initial) for parameter in self.parameters])
        p = np.asarray(p, dtype=float)
        return np.where(
            self.positive, np.log(np.maximum(np.where(self.positive, p, 1.0), least + 1e-300)), p
        )

    def physical(self, q: Any, xp: Any = np) -> Any:
        """Return p of q, by `xp` (numpy or jax.numpy)."""
        return xp.where(self.positive, xp.exp(xp.where(self.positive, q, 0.0)), q)

    def slopes(self, q: Vector) -> Vector:
        """Return ∂p/∂q (np,)."""
        return np.where(self.positive, self.physical(q), 1.0)

    @property
    def bounds(self) -> tuple[Vector, Vector]:
        """Lower and upper bounds of q, each (np,)."""
        return self.of([p.min for p in self.parameters]), self.of([p.max for p in self.parameters])

    def inside(self, q: Vector) -> Bool[np.ndarray, "np"]:
        """Return a mask of the entries of q that are not at a bound: one there is a constant."""
        low, high = self.bounds
        return (low < q) & (q < high)

    def lost(self, q: Vector) -> Bool[np.ndarray, "np"]:
        """Return a mask of the positive parameters that left the order of size of their start.

        Such a one is so near to zero, or so large, that no output depends on it any more.
        """
        return self.positive & (np.abs(q - self.initial) > _FAR)


@dataclass(frozen=True)
class PhysicsMap:
    """θ = h(p); make one with `of`.

    Examples:
        >>> mass = PhysicalParameter("m", 2.0, "kg")
        >>> physics = PhysicsMap.of([mass], {"theta1": "Ts / m"}, {"Ts": 0.1})
        >>> physics.initial_theta(), physics.jacobian(np.array([2.0]))
        (array([0.05]), array([[-0.025]]))
    """

    parameters: tuple[PhysicalParameter, ...]
    theta_names: tuple[str, ...]
    expressions: tuple[Expression, ...]
    constants: tuple[tuple[str, float], ...] = ()

    def __repr__(self) -> str:
        given = zip(self.theta_names, self.expressions, strict=True)
        return (
            f"PhysicsMap({'; '.join(f'{name} = {text}' for name, text in given)}; p: "
            f"{', '.join(self.names)})"
        )

    @classmethod
    def of(
        cls,
        parameters: Sequence[PhysicalParameter],
        theta: Mapping[str, str],
        constants: Mapping[str, float] | None = None,
    ) -> PhysicsMap:
        """Return the map in which `theta[name]` is an expression of parameters and `constants`.

        Raises:
            InputError: a name, value or bound that cannot be; an expression that is not arithmetic
                on parameters and constants, uses no parameter, or is not finite at the initial
                values; parameters that θ does not determine, at any point near the initial values.
        """
        constants = dict(constants or {})
        check_parameters(parameters, constants)
        if not theta:
            raise InputError(
                "the physics gives no theta; give one expression for each parameter of the "
                "baseline."
            )
        names = [p.name for p in parameters]
        known = constants | {p.name: float(p.initial) for p in parameters}
        expressions = tuple(_parse(name, text, known, names) for name, text in theta.items())
        used = {name for expression in expressions for name, _ in expression.constants}
        for name in names:
            if name not in used:
                raise InputError(
                    f"the physical parameter '{name}' is in no expression of theta; use or "
                    "remove it."
                )
        physics = cls(
            tuple(parameters), tuple(theta), expressions, tuple(sorted(constants.items()))
        )
        physics._check_start()
        _check_identifiable(physics)
        return physics

    @property
    def names(self) -> tuple[str, ...]:
        """Names of p in order."""
        return tuple(p.name for p in self.parameters)

    @property
    def initial(self) -> Vector:
        """p⁰, (np,)."""
        return np.array([p.initial for p in self.parameters], dtype=float)

    @property
    def bounds(self) -> tuple[Vector, Vector]:
        """Lower and upper bounds of p, each (np,); infinite where there are none."""
        return np.array([p.min for p in self.parameters], float), np.array(
            [p.max for p in self.parameters], float
        )

    def theta(self, p: Vector) -> Vector:
        """Return h(p), (nθ,) in the order of `theta_names`.

        Not finite where an expression has no value.
        """
        return self.linearised(p)[0]

    def jacobian(self, p: Vector) -> Matrix:
        """Return dh/dp, (nθ, np)."""
        return self.linearised(p)[1]

    def initial_theta(self) -> Vector:
        """Return θ⁰ = h(p⁰), (nθ,)."""
        return self.theta(self.initial)

    def linearised(self, p: Vector) -> tuple[Vector, Matrix]:
        """Return h(p) (nθ,) and dh/dp (nθ, np) in one pass.

        Raises:
            InputError: p has not one entry for each parameter.
        """
        p = np.asarray(p, dtype=float)
        if p.shape != (len(self.parameters),):
            raise InputError(
                f"`p` has shape {p.shape}; expected one value for each of {', '.join(self.names)}."
            )
        step = _STEP * np.where(p != 0, np.abs(p), 1.0)
        reals = {**dict(self.constants), **dict(zip(self.names, p, strict=True))}
        lifted: dict[str, object] = reals | dict(
            zip(self.names, p[:, None] + 1j * np.diag(step), strict=True)
        )
        theta, jacobian = np.empty(len(self.expressions)), np.empty((len(self.expressions), len(p)))
        with np.errstate(all="ignore"):  # the caller says what has no value
            for i, expression in enumerate(self.expressions):
                theta[i] = expression.value(reals, np)
                jacobian[i] = np.imag(expression.value(lifted, _COMPLEX))
            # a root at 0 gives h^½, not h, and has no slope; nor has what has no value
            none = (
                np.abs(jacobian) > 1e-60 * np.maximum(np.abs(theta), 1.0)[:, None]
            ) | ~np.isfinite(theta)[:, None]
            return theta, np.where(none, np.inf, jacobian / step)

    @cached_property
    def size(self) -> Vector:
        """The magnitude |p⁰| (np,) of each p, for scaling.

        Where p⁰ = 0, that of its bounds, or of a change that moves θ.
        """
        theta, jacobian = self.linearised(self.initial)
        change = np.max(np.abs(jacobian) / magnitude(theta)[:, None], axis=0)
        reach = np.max(np.abs(self.bounds), axis=0)
        moving = 1 / np.where((change > 0) & np.isfinite(change), change, 1.0)
        return np.where(
            self.initial != 0, np.abs(self.initial), np.where(np.isfinite(reach), reach, moving)
        )

    def around(self, count: int, factor: float) -> Matrix:
        """Return `count` points within the bounds, (count, np), the same at every call.

        They lie between p⁰ times 1/`factor` and p⁰ times `factor`.
        """
        exponent = np.random.default_rng(0).uniform(-1, 1, (count, len(self.parameters)))
        points = np.where(self.initial != 0, self.initial * factor**exponent, self.size * exponent)
        return np.clip(points, *self.bounds)

    def _check_start(self) -> None:
        for name, expression, value, slope in zip(
            self.theta_names, self.expressions, *self.linearised(self.initial), strict=True
        ):
            if not (np.isfinite(value) and np.isfinite(slope).all()):
                what = f"is {value}" if not np.isfinite(value) else "has no finite derivative"
                raise InputError(
                    f"physics.theta '{name}' = {expression} {what} at the initial values of "
                    f"{', '.join(self.names)}; expected a finite value: change the initial "
                    "values."
                )


def magnitude(values: Vector) -> Vector:
    """Return |values|.

    A zero takes the largest of them; where all are zero, each is 1.
    """
    size = np.abs(values)
    return np.where(size > 0, size, size.max(initial=0.0) or 1.0)


def check_parameters(
    parameters: Sequence[PhysicalParameter],
    constants: Mapping[str, float],
    taken: Collection[str] = RESERVED,
) -> None:
    """Raise InputError for invalid names, values, units or bounds of parameters and constants."""
    if not parameters:
        raise InputError("the physics has no parameters; give at least one, such as m.")
    check_unique((p.name for p in parameters), "physical parameter")
    for name in (*constants, *(p.name for p in parameters)):
        if not is_name(name, taken):
            index = " (k is the time index)" if "k" in taken else ""
            raise InputError(
                f"'{name}' cannot name a physical parameter or constant; use letters, digits "
                "and underscores, not starting with a digit, and no keyword; "
                f"{', '.join(sorted(taken))} are taken{index}."
            )
    for name, value in constants.items():
        check_finite(value, f"the constant '{name}'")
    for p in parameters:
        check_not_sampling_time(p.name, "a parameter")
        if p.name in constants:
            raise InputError(
                f"'{p.name}' is a physical parameter and a constant; give one of them another name."
            )
        check_finite(p.initial, f"the initial value of '{p.name}'")
        check_label(p.unit, f"the unit of '{p.name}'")
        check_bounds(p.name, p.min, p.max)
        if not p.min <= p.initial <= p.max:
            raise InputError(
                f"the initial value of '{p.name}' is {p.initial:g}; its bounds are {p.min:g} "
                f"and {p.max:g}."
            )


def check_not_sampling_time(name: str, what: str) -> None:
    """Raise InputError for a name that expressions read as the sampling time."""
    if name == SAMPLING_TIME:
        raise InputError(
            f"'{SAMPLING_TIME}' cannot name {what}: expressions read it as the sampling time "
            f"of the data, in s. Give {what[2:].strip()} another name."
        )


def _parse(
    name: str, text: str, known: Mapping[str, float], parameters: Sequence[str]
) -> Expression:
    where = f"physics.theta '{name}'"
    declare = {SAMPLING_TIME: "; give it in `constants`, {'Ts': record.sampling_time}."}
    expression = parse_named(text, known, where, declare)
    if not any(used in parameters for used in expression.names):
        raise InputError(
            f"{where} = {text} depends on no physical parameter; use one of "
            f"{', '.join(parameters)}, or make it a fixed term of the baseline."
        )
    return expression


def _check_identifiable(physics: PhysicsMap) -> None:
    """Raise InputError where θ does not determine p near p⁰.

    p⁰ itself and twenty points within a factor 2 of it are tried.
    """
    best: Excitation | None = None
    for p in (physics.initial, *physics.around(20, 2.0)):
        jacobian = physics.jacobian(p) * physics.size
        if not np.isfinite(jacobian).all():
            continue
        row = np.abs(jacobian).max(axis=1, keepdims=True)
        sensitivity = excitation(jacobian / np.where(row > 0, row, 1.0), physics.names)
        if best is None or sensitivity.rank > best.rank:
            best = sensitivity
    if best is not None and not best.full_rank:
        raise InputError(
            f"theta does not determine the physical parameters: {tied_text(best)} "
            f"({len(physics.theta_names)} theta, rank {best.rank} of {best.columns}). Make one "
            "of them a constant, or add a term that distinguishes them."
        )


def tied_text(sensitivity: Excitation) -> str:
    """Return the parameters that θ does not separate, in words."""
    return "; ".join(
        f"{group[0]} has no effect"
        if len(group) == 1
        else f"{', '.join(group)} cannot be distinguished"
        for group in sensitivity.collinear
    )


def check_baseline(physics: PhysicsMap, baseline: Baseline) -> None:
    """Raise InputError unless the map gives exactly the baseline's θ, with its initial values."""
    fixed = {term.parameter for term in baseline.terms if term.fixed}
    for name in physics.theta_names:
        if name in fixed:
            raise InputError(
                f"physics.theta '{name}' is a fixed term of the baseline; leave out the "
                "expression, or `fixed`."
            )
        if name not in baseline.names:
            hint = (
                nearest(name, baseline.names)
                or f"; its parameters are {', '.join(baseline.names)}."
            )
            raise InputError(f"physics.theta '{name}' is no parameter of the baseline{hint}")
    given = dict(zip(physics.theta_names, physics.initial_theta(), strict=True))
    for name in baseline.names:
        if name not in given:
            raise InputError(
                f"the physics gives no '{name}'; expected an expression for every theta of the "
                "baseline."
            )
    for term in baseline.terms:
        if not term.fixed and term.initial is not None:
            value = given[term.parameter]
            if not math.isclose(term.initial, value, rel_tol=AGREEMENT):
                raise InputError(
                    f"{term.parameter}: initial {term.initial:.7g} but the physics gives "
                    f"{value:.7g}; leave one out."
                )


def with_initial(physics: PhysicsMap, baseline: Baseline) -> Baseline:
    """Return the baseline with θ⁰ = h(p⁰), after `check_baseline`."""
    check_baseline(physics, baseline)
    given = {
        name: float(v) for name, v in zip(physics.theta_names, physics.initial_theta(), strict=True)
    }
    return replace(
        baseline,
        parameters=tuple(replace(p, initial=given[p.name]) for p in baseline.parameters),
        terms=tuple(
            t if t.fixed else replace(t, initial=given[t.parameter]) for t in baseline.terms
        ),
    )
