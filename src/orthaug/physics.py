"""Physical parameters p (m, ks, cd …) and the baseline's θ: the map between them, and p̂ with its statistics.

θ = h(p) is given as expressions. p̂ minimises ‖θ̂ − h(p)‖² under W = Cov(θ̂)⁻¹; with as many θ as p that
solves θ̂ = h(p), with more θ the leftover tests the physics. Cov p̂ = (HᵀWH)⁻¹, H = dh/dp (delta method).
"""

from __future__ import annotations

import keyword
import math
import re
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize
import scipy.special
from jaxtyping import Bool

from orthaug._arrays import Matrix, Vector, check_unique, nearest
from orthaug.baseline import Baseline
from orthaug.covariance import interval
from orthaug.errors import InputError
from orthaug.excitation import Excitation, excitation
from orthaug.expressions import FUNCTIONS, RESERVED, Expression, is_name, parse

AGREEMENT = 1e-6  # relative difference up to which a term's `initial` is what the physics gives
CONTRADICTION = 0.05  # p-value below which θ̂ contradicts the physics, to match the 95 % intervals
ITERATIONS = 200  # Levenberg-Marquardt steps from one start
_ROUNDING = 1e-14  # smallest eigenvalue of a correlation matrix that is not rounding
_SOLVED = {True: 1e-6, False: 1e-18}  # ‖residual‖² that counts as none: in variances of θ̂; without them relative to θ̂²


# What `Expression.evaluate` asks of numpy, on p + ih: Im θ / h is dθ/dp by the complex step (Squire & Trapp 1998),
# exact up to rounding whatever the scales of p are. numpy's own functions are analytic; these five are not and take
# the branch of the real part, which gives the slope of one side at a kink.
_COMPLEX = SimpleNamespace(
    asarray=lambda x, dtype=None: np.asarray(x, dtype=complex),
    abs=lambda x: np.where(np.real(x) < 0, -1.0, 1.0) * x,
    sign=lambda x: np.sign(np.real(x)),
    minimum=lambda a, b: np.where(np.real(a) <= np.real(b), a, b),
    maximum=lambda a, b: np.where(np.real(a) >= np.real(b), a, b),
    **{name: getattr(np, name) for name in FUNCTIONS if name not in ("abs", "sign", "min", "max")},
)
_STEP = 1e-100  # h² vanishes beside 1, and h times a parameter is far from underflow


@dataclass(frozen=True)
class PhysicalParameter:
    """One entry of p: name, initial value, unit and bounds."""

    name: str
    initial: float
    unit: str = ""
    min: float = -math.inf
    max: float = math.inf


@dataclass(frozen=True)
class PhysicsMap:
    """θ = h(p); make one with `of`.

    Examples:
        >>> physics = PhysicsMap.of([PhysicalParameter("m", 2.0, "kg")], {"theta1": "Ts / m"}, {"Ts": 0.1})
        >>> physics.initial_theta(), physics.jacobian(np.array([2.0]))
        (array([0.05]), array([[-0.025]]))
    """

    parameters: tuple[PhysicalParameter, ...]
    theta_names: tuple[str, ...]
    expressions: tuple[Expression, ...]
    constants: tuple[tuple[str, float], ...] = ()

    @classmethod
    def of(
        cls,
        parameters: Sequence[PhysicalParameter],
        theta: Mapping[str, str],
        constants: Mapping[str, float] | None = None,
    ) -> PhysicsMap:
        """`theta[name]` is an expression of the parameters' names and the `constants`.

        Raises:
            InputError: a name, value or bound that cannot be; an expression that is not arithmetic on
                parameters and constants, uses no parameter, or is not finite at the initial values;
                parameters that θ does not determine, at any point near the initial values.
        """
        constants = dict(constants or {})
        _check_parameters(parameters, constants)
        if not theta:
            raise InputError("the physics gives no theta; give one expression for each parameter of the baseline.")
        names = [p.name for p in parameters]
        known = constants | {p.name: float(p.initial) for p in parameters}
        expressions = tuple(_parsed(name, text, known, names) for name, text in theta.items())
        used = {name for expression in expressions for name, _ in expression.constants}
        for name in names:
            if name not in used:
                raise InputError(f"the physical parameter '{name}' is in no expression of theta; use or remove it.")
        physics = cls(tuple(parameters), tuple(theta), expressions, tuple(sorted(constants.items())))
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
        return np.array([p.min for p in self.parameters], float), np.array([p.max for p in self.parameters], float)

    def theta(self, p: Vector) -> Vector:
        """h(p), (nθ,) in the order of `theta_names`; not finite where an expression has no value."""
        return self.linearised(p)[0]

    def jacobian(self, p: Vector) -> Matrix:
        """dh/dp, (nθ, np)."""
        return self.linearised(p)[1]

    def initial_theta(self) -> Vector:
        """θ⁰ = h(p⁰), (nθ,)."""
        return self.theta(self.initial)

    def linearised(self, p: Vector) -> tuple[Vector, Matrix]:
        """h(p) (nθ,) and dh/dp (nθ, np) in one pass.

        Raises:
            InputError: p has not one entry for each parameter.
        """
        p = np.asarray(p, dtype=float)
        if p.shape != (len(self.parameters),):
            raise InputError(f"`p` has shape {p.shape}; expected one value for each of {', '.join(self.names)}.")
        step = _STEP * np.eye(len(p))
        reals = {**dict(self.constants), **dict(zip(self.names, p, strict=True))}
        lifted: dict[str, Any] = reals | dict(zip(self.names, p[:, None] + 1j * step, strict=True))
        theta, jacobian = np.empty(len(self.expressions)), np.empty((len(self.expressions), len(p)))
        with np.errstate(all="ignore"):  # what has no value is told by the caller
            for i, expression in enumerate(self.expressions):
                theta[i] = _at(expression, reals).evaluate({}, np)
                jacobian[i] = np.imag(_at(expression, lifted).evaluate({}, _COMPLEX)) / _STEP
        return theta, np.where(np.abs(jacobian) < 1e40, jacobian, np.inf)  # the slope of a root at 0 is about h^-1/2

    def size(self) -> Vector:
        """The magnitude of each p, (np,), for scaling: |p⁰|, and where p⁰ = 0 its bounds' or what changes θ."""
        theta, jacobian = self.linearised(self.initial)
        change = np.max(np.abs(jacobian) / _magnitude(theta)[:, None], axis=0)
        reach = np.max(np.abs(self.bounds), axis=0)
        moving = 1 / np.where((change > 0) & np.isfinite(change), change, 1.0)
        return np.where(self.initial != 0, np.abs(self.initial), np.where(np.isfinite(reach), reach, moving))

    def around(self, count: int, factor: float) -> Matrix:
        """`count` points within the bounds, (count, np), p⁰ times 1/`factor` to `factor`; always the same."""
        exponent = np.random.default_rng(0).uniform(-1, 1, (count, len(self.parameters)))
        points = np.where(self.initial != 0, self.initial * factor**exponent, self.size() * exponent)
        return np.clip(points, *self.bounds)

    def _check_start(self) -> None:
        for name, expression, value, slope in zip(
            self.theta_names, self.expressions, *self.linearised(self.initial), strict=True
        ):
            if not (np.isfinite(value) and np.isfinite(slope).all()):
                what = f"is {value}" if not np.isfinite(value) else "has no finite derivative"
                raise InputError(
                    f"physics.theta '{name}' = {expression} {what} at the initial values of "
                    f"{', '.join(self.names)}; expected a finite one: start elsewhere."
                )


def _magnitude(values: Vector) -> Vector:
    """|values|, where zero the largest of them, where all are zero 1."""
    size = np.abs(values)
    return np.where(size > 0, size, size.max(initial=0.0) or 1.0)


def _at(expression: Expression, values: Mapping[str, Any]) -> Expression:
    """The expression with other values of the names that it uses."""
    return Expression(expression.text, tuple((name, values[name]) for name, _ in expression.constants))


def _is_finite(value: Any) -> bool:
    return not isinstance(value, bool) and isinstance(value, int | float | np.number) and math.isfinite(value)


def _check_parameters(parameters: Sequence[PhysicalParameter], constants: Mapping[str, float]) -> None:
    if not parameters:
        raise InputError("the physics has no parameters; give at least one, such as m.")
    check_unique((p.name for p in parameters), "physical parameter")
    for name in (*constants, *(p.name for p in parameters)):
        if not is_name(name):
            raise InputError(
                f"'{name}' cannot name a physical parameter or constant; use letters, digits and underscores, not "
                f"starting with a digit, and no keyword; {', '.join(sorted(RESERVED))} are taken (k is the time index)."
            )
    for name, value in constants.items():
        if not _is_finite(value):
            raise InputError(f"the constant '{name}' must be a finite number; got {value!r}.")
    for p in parameters:
        if p.name in constants:
            raise InputError(f"'{p.name}' is a physical parameter and a constant; give one of them another name.")
        if not _is_finite(p.initial):
            raise InputError(f"the initial value of '{p.name}' must be a finite number; got {p.initial!r}.")
        if any(isinstance(b, bool) or not isinstance(b, int | float | np.number) for b in (p.min, p.max)):
            raise InputError(f"the bounds of '{p.name}' must be numbers; got min = {p.min!r}, max = {p.max!r}.")
        if not p.min < p.max:
            raise InputError(f"the bounds of '{p.name}' are empty or reversed: min = {p.min:g}, max = {p.max:g}.")
        if not p.min <= p.initial <= p.max:
            raise InputError(
                f"the initial value of '{p.name}' is {p.initial:g}; its bounds are {p.min:g} and {p.max:g}."
            )


def _parsed(name: str, text: str, known: Mapping[str, float], parameters: Sequence[str]) -> Expression:
    """The expression of one θ, its names checked before `parse` takes an unknown one for a channel."""
    where = f"physics.theta '{name}'"
    if not isinstance(text, str):
        raise InputError(f"{where} must be an expression in text such as 'Ts**2 / m'; got {text!r}.")
    if "[" in text:
        raise InputError(f"{where} = {text}: a signal such as y[k-1] is no part of it; use parameters and constants.")
    for word in re.findall(r"\b[^\W\d]\w*", unicodedata.normalize("NFKC", text)):
        if word not in known and word not in FUNCTIONS and not keyword.iskeyword(word):
            hint = nearest(word, known) or f"; known are {', '.join(known)}"
            raise InputError(f"{where} = {text}: unknown name '{word}'{hint}.")
    try:
        expression = parse(text, known)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    if not any(used in parameters for used, _ in expression.constants):
        raise InputError(
            f"{where} = {text} depends on no physical parameter; use one of {', '.join(parameters)}, "
            "or make it a fixed term of the baseline."
        )
    return expression


def _check_identifiable(physics: PhysicsMap) -> None:
    """Raise InputError where θ does not determine p at p⁰ nor at any of twenty points within a factor 2 of it."""
    best: Excitation | None = None
    for p in (physics.initial, *physics.around(20, 2.0)):
        jacobian = physics.jacobian(p) * physics.size()
        if not np.isfinite(jacobian).all():
            continue
        row = np.abs(jacobian).max(axis=1, keepdims=True)
        found = excitation(jacobian / np.where(row > 0, row, 1.0), physics.names)
        if best is None or found.rank > best.rank:
            best = found
    if best is not None and not best.full_rank:
        raise InputError(
            f"theta does not determine the physical parameters: {_tied(best)} ({len(physics.theta_names)} theta, "
            f"rank {best.rank} of {best.columns}). Make one of them a constant, or add a term that tells them apart."
        )


def _tied(found: Excitation) -> str:
    return "; ".join(
        f"{group[0]} has no effect" if len(group) == 1 else f"{', '.join(group)} cannot be told apart"
        for group in found.collinear
    )


def check_baseline(physics: PhysicsMap, baseline: Baseline) -> None:
    """Raise InputError unless the map gives exactly the baseline's θ, and no term's `initial` differs from it."""
    fixed = {term.parameter for term in baseline.terms if term.fixed}
    for name in physics.theta_names:
        if name in fixed:
            raise InputError(
                f"physics.theta '{name}' is a fixed term of the baseline; leave out the expression, or `fixed`."
            )
        if name not in baseline.names:
            hint = nearest(name, baseline.names) or f"; its parameters are {', '.join(baseline.names)}"
            raise InputError(f"physics.theta '{name}' is no parameter of the baseline{hint}.")
    given = dict(zip(physics.theta_names, physics.initial_theta(), strict=True))
    for name in baseline.names:
        if name not in given:
            raise InputError(f"the physics gives no '{name}'; expected an expression for every theta of the baseline.")
    for term in baseline.terms:
        if not term.fixed and term.initial is not None:
            value = given[term.parameter]
            if not math.isclose(term.initial, value, rel_tol=AGREEMENT):
                raise InputError(
                    f"{term.parameter}: initial {term.initial:.7g} but the physics gives {value:.7g}; leave one out."
                )


def with_initial(physics: PhysicsMap, baseline: Baseline) -> Baseline:
    """The baseline with θ⁰ = h(p⁰), after `check_baseline`."""
    check_baseline(physics, baseline)
    given = {name: float(v) for name, v in zip(physics.theta_names, physics.initial_theta(), strict=True)}
    return replace(
        baseline,
        parameters=tuple(replace(p, initial=given[p.name]) for p in baseline.parameters),
        terms=tuple(t if t.fixed else replace(t, initial=given[t.parameter]) for t in baseline.terms),
    )


class Consistency(NamedTuple):
    """Whether θ̂ obeys what the physics fixes among θ: χ² = rᵀCov⁻¹r, its degrees of freedom, p-value, a sentence."""

    chi2: float
    df: int
    p: float
    text: str


@dataclass(frozen=True, eq=False)
class PhysicalEstimate:
    """p̂ and its statistics, in the order and units of the physical parameters."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    initial: Vector
    value: Vector
    std: tuple[float | None, ...]
    ci95: tuple[tuple[float, float] | None, ...]
    covariance: Matrix | None
    """Cov p̂ (np, np), NaN at parameters that stand at a bound; None where there are no standard errors."""
    consistency: Consistency | None
    """None where θ̂ has no covariance or nothing is left over to test."""
    sensitivities: Matrix | None
    """∂ln p̂ / ∂ln θ̂ (np, nθ): 10 says that 1 % in θ moves p by 10 %. NaN for p̂ = 0, 0 for one at a bound."""
    warnings: tuple[str, ...] = ()

    def as_rows(self) -> list[dict[str, Any]]:
        """A row for each parameter, as `result.json` has them; None for what does not exist."""
        columns = (self.names, self.units, self.initial.tolist(), self.value.tolist(), self.std, self.ci95)
        keys = ("name", "unit", "initial", "value", "std", "ci95")
        rows = [dict(zip(keys, row, strict=True)) for row in zip(*columns, strict=True)]
        return [row | {"ci95": list(row["ci95"]) if row["ci95"] else None} for row in rows]


@dataclass(frozen=True, eq=False)
class _Fit:
    """min ‖K(h(p) − θ̂)‖² within the bounds, KᵀK = Cov⁻¹, over the entries `free` of p."""

    physics: PhysicsMap
    target: Vector
    whiten: Matrix
    known: bool
    """Whether K comes from a covariance; otherwise from |θ̂|."""
    free: tuple[int, ...]

    @classmethod
    def of(cls, physics: PhysicsMap, theta_hat: Vector, covariance: Matrix | None) -> _Fit:
        target, names = np.asarray(theta_hat, dtype=float), physics.theta_names
        if target.shape != (len(names),):
            raise InputError(
                f"`theta_hat` has shape {target.shape}; expected one number for each of {', '.join(names)}."
            )
        for name, value in zip(names, target, strict=True):
            if not np.isfinite(value):
                raise InputError(f"`theta_hat` is {value} for {name}; expected a finite estimate.")
        whiten = None if covariance is None else _whitener(target, np.asarray(covariance, dtype=float))
        default = np.diag(1 / _magnitude(target))
        free = tuple(range(len(physics.parameters)))
        return cls(physics, target, default if whiten is None else whiten, whiten is not None, free)

    @cached_property
    def size(self) -> Vector:
        return self.physics.size()

    def at(self, p: Vector) -> tuple[Vector, Matrix]:
        """Whitened residual (nθ,) and its derivative (nθ, np)."""
        theta, jacobian = self.physics.linearised(p)
        with np.errstate(all="ignore"):
            return self.whiten @ (theta - self.target), self.whiten @ jacobian

    def descend(self, p: Vector) -> tuple[float, Vector]:
        """Cost and p of the minimum that Levenberg-Marquardt finds from p; cost inf where θ has no value at p.

        Every step solves its linear problem within the bounds exactly, so that p ends on a bound or off it, not near.
        """
        free = list(self.free)
        low, high = (bound[free] for bound in self.physics.bounds)
        residual, jacobian = self.at(p)
        cost, damping = _cost(residual, jacobian), 0.0
        for _ in range(ITERATIONS if free and np.isfinite(cost) else 0):
            scale = self.size[free]
            columns = jacobian[:, free] * scale
            rows = np.vstack([columns, np.diag(np.sqrt(damping) * np.linalg.norm(columns, axis=0))])
            right = np.concatenate([-residual, np.zeros(len(free))])
            limits = ((low - p[free]) / scale, (high - p[free]) / scale)
            step = scipy.optimize.lsq_linear(rows, right, limits, method="bvls")
            new = p.copy()
            moved = np.clip(p[free] + scale * step.x, low, high)
            new[free] = np.where(step.active_mask < 0, low, np.where(step.active_mask > 0, high, moved))
            small = np.max(np.abs(new - p) / np.maximum(np.abs(p), 1e-3 * self.size)) < 1e-11
            at_new = self.at(new)
            lower = _cost(*at_new)
            if lower <= cost * (1 + 1e-9 * small):
                p, cost, (residual, jacobian) = new, lower, at_new
                damping = damping / 10 if damping > 1e-6 else 0.0
            elif not small:
                damping = max(10 * damping, 1e-3)
            if small or damping > 1e12:
                break
        return cost, p

    def solutions(self, starts: int) -> list[Vector]:
        """The best p, first, and others that explain θ̂ as well, from p⁰ and `starts` points about it."""
        points = (self.physics.initial, *self.physics.around(starts, 4.0))
        found = [self.descend(p) for p in points]
        least = min(cost for cost, _ in found)
        distinct: list[Vector] = []
        for cost, p in found:
            near = [np.all(np.abs(p - q) <= 1e-3 * np.maximum(np.abs(q), 1e-3 * self.size)) for q in distinct]
            if cost <= least * (1 + 1e-9) + _SOLVED[self.known] and not any(near):
                distinct.append(p)
        return distinct


def _cost(residual: Vector, jacobian: Matrix) -> float:
    """‖residual‖², infinite where it or the derivative is not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        cost = float(residual @ residual)
    return cost if np.isfinite(cost) and np.isfinite(jacobian).all() else math.inf


def _whitener(target: Vector, covariance: Matrix) -> Matrix | None:
    """K (nθ, nθ) with KᵀK = Cov⁻¹; None where an entry of θ has no variance, as at a bound."""
    nt = len(target)
    if covariance.shape != (nt, nt):
        raise InputError(f"`covariance` has shape {covariance.shape}; expected ({nt}, {nt}), a row for each theta.")
    if not np.isfinite(covariance).all():
        return None
    # θ̂ is rounded itself: a variance of zero becomes that of its last digit
    rounded = (np.finfo(float).eps * _magnitude(target)) ** 2 + np.finfo(float).tiny
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0) + rounded)
    correlation = (covariance + np.diag(rounded)) / np.outer(std, std)
    eigenvalues, vectors = np.linalg.eigh(correlation)
    if not np.allclose(correlation, correlation.T, rtol=0, atol=1e-8) or eigenvalues[0] < -1e-8:
        raise InputError("`covariance` must be symmetric with no negative eigenvalue; expected that of theta_hat.")
    # a combination of θ without variance is known as well as double precision can tell, not unknown
    return (vectors / np.sqrt(np.maximum(eigenvalues, _ROUNDING))).T / std


def solve(
    physics: PhysicsMap, theta_hat: Vector, covariance: Matrix | None, *, freedom: float, starts: int = 4
) -> PhysicalEstimate:
    """p̂ = argmin (θ̂ − h(p))ᵀ Cov⁻¹ (θ̂ − h(p)) within the bounds of p, with its statistics.

    Args:
        physics: h.
        theta_hat: θ̂ (nθ,) in the order of `physics.theta_names`.
        covariance: Cov θ̂ (nθ, nθ); None, or one that is not finite, gives relative weights and no statistics.
        freedom: degrees of freedom of the noise variance within it; inf where that is known.
        starts: points about p⁰ from which the solution is sought besides p⁰ itself.

    Raises:
        InputError: arguments of another shape, or that are no estimate, covariance or degrees of freedom.
    """
    _check_freedom(freedom)
    fit = _Fit.of(physics, theta_hat, covariance)
    value, *others = fit.solutions(starts)
    residual, jacobian = fit.at(value)
    held = _held(physics, value, jacobian.T @ residual)
    chi2, df = float(residual @ residual), len(residual) - int(np.sum(~held))
    outside = df == 0 and chi2 > _SOLVED[fit.known]
    found = excitation(
        jacobian[:, ~held], [name for name, at_bound in zip(physics.names, held, strict=True) if not at_bound]
    )
    spread, sensitivities = _linear(fit, value, jacobian, held) if found.full_rank and not outside else (None, None)
    consistency = _consistency(chi2, df, freedom, bool(held.any())) if fit.known and df > 0 else None
    warnings = [*_at_bounds(physics, value, held), *_elsewhere(physics, others)]
    if outside:
        warnings.append(_outside(fit, value))
    elif not found.full_rank:
        warnings.append(f"At the solution {_tied(found)}; the physical parameters have no standard errors.")
    if not fit.known:
        warnings.append("theta has no finite covariance, so the physical parameters have no standard errors.")
    if consistency is not None and consistency.p < CONTRADICTION:
        warnings.append(consistency.text)
    std = np.full(len(value), np.nan) if spread is None else np.sqrt(np.diag(spread))
    return PhysicalEstimate(
        names=physics.names,
        units=tuple(p.unit for p in physics.parameters),
        initial=physics.initial,
        value=value,
        std=tuple(float(s) if np.isfinite(s) else None for s in std),
        ci95=tuple((float(a), float(b)) if np.isfinite(b - a) else None for a, b in interval(value, std, freedom)),
        covariance=spread,
        consistency=consistency,
        sensitivities=sensitivities,
        warnings=tuple(warnings),
    )


def _held(physics: PhysicsMap, value: Vector, gradient: Vector) -> Bool[np.ndarray, "n"]:
    """Which parameters the data press against a bound, (np,)."""
    low, high = physics.bounds
    return ((value <= low) & (gradient > 0)) | ((value >= high) & (gradient < 0))


def _linear(fit: _Fit, value: Vector, jacobian: Matrix, held: Bool[np.ndarray, "n"]) -> tuple[Matrix | None, Matrix]:
    """Cov p̂ = (HᵀWH)⁻¹, None without Cov θ̂, and ∂ln p̂ / ∂ln θ̂ from dp̂/dθ̂ = (HᵀWH)⁻¹HᵀW, by SVD of KH."""
    norms = np.linalg.norm(jacobian[:, ~held], axis=0)
    u, sigma, vt = np.linalg.svd(jacobian[:, ~held] / norms, full_matrices=False)
    root = vt.T / sigma / norms[:, None]
    inverse = np.zeros((len(value), len(fit.target)))
    inverse[~held] = root @ u.T @ fit.whiten
    with np.errstate(divide="ignore", invalid="ignore"):
        sensitivities = np.where(value[:, None] != 0, inverse * fit.target / value[:, None], np.nan)
    if not fit.known:
        return None, sensitivities
    spread = np.full((len(value), len(value)), np.nan)
    spread[np.ix_(~held, ~held)] = root @ root.T
    return spread, sensitivities


def _check_freedom(freedom: float) -> None:
    if isinstance(freedom, bool) or not isinstance(freedom, int | float | np.number) or not freedom > 0:
        raise InputError(f"`freedom` must be a positive number, the residual's degrees of freedom; got {freedom!r}.")


def _consistency(chi2: float, df: int, freedom: float, held: bool) -> Consistency:
    """The noise variance is estimated itself, so χ²/df is compared with F(df, freedom), for inf with χ²."""
    p = scipy.special.chdtrc(df, chi2) if math.isinf(freedom) else scipy.special.fdtrc(df, freedom, chi2 / df)
    verb = "contradict" if p < CONTRADICTION else "agree with"
    what = ("constraint" if df == 1 else f"{df} constraints") + (", bounds included" if held else "")
    return Consistency(chi2, df, float(p), f"The data {verb} the physics' own {what} (chi2 = {chi2:.3g}, p = {p:.2g}).")


def _at_bounds(physics: PhysicsMap, value: Vector, held: Bool[np.ndarray, "n"]) -> list[str]:
    return [
        f"{name} stands at its bound {v:g} and has no standard error; those of the others hold with it there."
        for name, v, at_bound in zip(physics.names, value, held, strict=True)
        if at_bound
    ]


def _elsewhere(physics: PhysicsMap, others: Sequence[Vector]) -> list[str]:
    return [
        "theta is explained as well by "
        + ", ".join(f"{name} = {v:.6g}" for name, v in zip(physics.names, p, strict=True))
        + "; bounds or better initial values choose between the solutions."
        for p in others[:1]
    ]


def _outside(fit: _Fit, value: Vector) -> str:
    nearby = fit.physics.theta(value)
    worst = int(np.argmax(np.abs(nearby - fit.target) / _magnitude(fit.target)))
    return (
        f"No physical parameters give the estimated theta: nearest is {fit.physics.theta_names[worst]} = "
        f"{nearby[worst]:.6g} instead of {fit.target[worst]:.6g}. They have no standard errors; check the expressions "
        "of theta, and whether theta is biased."
    )


def profile(
    physics: PhysicsMap,
    theta_hat: Vector,
    covariance: Matrix,
    name: str,
    *,
    freedom: float,
    level: float = 0.95,
    starts: int = 4,
) -> tuple[float, float]:
    """Profile-likelihood interval of one physical parameter: {pᵢ : min over the others χ² ≤ least χ² + F(1, freedom)}.

    Unlike p̂ ± reach·std it is asymmetric where h bends, and ends at the parameter's bounds; a side on which the
    data set no limit is ±inf.

    Raises:
        InputError: as for `solve`, an unknown name, a level outside (0, 1), or no covariance.
    """
    _check_freedom(freedom)
    if name not in physics.names:
        hint = nearest(name, physics.names) or f"; known are {', '.join(physics.names)}"
        raise InputError(f"'{name}' is no physical parameter{hint}.")
    if not 0 < level < 1:
        raise InputError(f"`level` must be between 0 and 1, such as 0.95; got {level!r}.")
    fit = _Fit.of(physics, theta_hat, covariance)
    if not fit.known:
        raise InputError("theta has no finite covariance, so there is no interval; expected that of theta_hat.")
    best, i = fit.solutions(starts)[0], physics.names.index(name)
    residual, jacobian = fit.at(best)
    others = replace(fit, free=tuple(j for j in fit.free if j != i))
    least, limit = float(residual @ residual), scipy.special.stdtrit(freedom, 0.5 + level / 2) ** 2
    path = [best]  # the others' last minimum is the next start

    @cache  # a bracket's end keeps its sign whatever the path has found since
    def excess(value: float) -> float:
        p = path[-1].copy()
        p[i] = value
        cost, p = others.descend(p)
        if np.isfinite(cost):
            path.append(p)
        return float(np.clip(cost - least - limit, -limit, 1e6 * limit))

    slope = np.linalg.norm(jacobian[:, i])
    step = float(1 / slope) if slope > 0 else 1e-3 * fit.size[i]  # at most one standard deviation
    bounds = (physics.parameters[i].min, physics.parameters[i].max)
    low, high = (_crossing(excess, best[i], sign * step, bound) for sign, bound in zip((-1, 1), bounds, strict=True))
    return low, high


def _crossing(excess: Callable[[float], float], start: float, step: float, bound: float) -> float:
    """Where `excess`, negative at `start`, changes its sign on the way to `bound`; `bound` where it does not."""
    inner = start
    for doubling in range(60):  # 10¹⁸ standard deviations
        outer = start + step * 2.0**doubling
        outer = min(outer, bound) if step > 0 else max(outer, bound)
        if excess(outer) > 0:
            return scipy.optimize.brentq(excess, inner, outer, xtol=1e-10 * abs(step))  # pyright: ignore[reportReturnType]
        if outer == bound:
            return float(bound)
        inner = outer
    return math.copysign(math.inf, step)
