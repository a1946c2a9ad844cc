"""Physical parameters p̂ from θ̂, with their statistics: the inverse of θ = h(p).

p̂ minimises ‖θ̂ − h(p)‖² under W = Cov(θ̂)⁻¹. With as many θ as p it solves θ̂ = h(p); with more θ
the rest tests the physics. Cov p̂ = (HᵀWH)⁻¹, H = dh/dp (delta method).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import scipy.special
from jaxtyping import Bool

from orthaug._base.checks import Matrix, Vector, nearest
from orthaug._base.errors import InputError, Warning
from orthaug.inference.covariance import interval
from orthaug.physics.excitation import excitation
from orthaug.physics.parameters import PhysicsMap, magnitude, tied_text

CONTRADICTION = 0.05  # p-value below which θ̂ contradicts the physics, to match the 95 % intervals
_EVALUATIONS = 1000  # from one start, at most: near a singular solution the search creeps
_STEP = 1e-14  # relative to p, each in its size: a shorter one is rounding
_ROUNDING = 1e-14  # smallest eigenvalue of a correlation matrix that is not rounding
_SOLVED = {
    True: 1e-6,
    False: 1e-18,
}  # ‖residual‖² that counts as none: in variances of θ̂; without them relative to θ̂²


@dataclass(frozen=True)
class Consistency:
    """Test of θ̂ against the relations that the physics imposes on θ.

    χ² = rᵀCov⁻¹r, its degrees of freedom, its p-value, and a sentence.
    """

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
    """Cov p̂ (np, np), NaN at parameters at a bound; None where there are no standard
    errors.
    """
    consistency: Consistency | None
    """None where θ̂ has no covariance or nothing is left over to test."""
    sensitivities: Matrix | None
    """∂ln p̂ / ∂ln θ̂ (np, nθ): 10 says that 1 % in θ moves p by 10 %. NaN for p̂ = 0, 0 for one at
    a bound.
    """
    warnings: tuple[Warning, ...] = ()

    def __repr__(self) -> str:
        rows = zip(self.names, self.value, self.std, self.units, strict=True)
        parts = (
            f"{n} = {v:.6g}{'' if s is None else f' ± {s:.2g}'} {unit}".rstrip()
            for n, v, s, unit in rows
        )
        return f"PhysicalEstimate({', '.join(parts)})"


@dataclass(frozen=True, eq=False)
class _Fit:
    """min ‖K(h(p) − θ̂)‖² within the bounds, KᵀK = Cov⁻¹, over the entries `free` of p."""

    physics: PhysicsMap
    target: Vector
    whiten: Matrix
    known: bool
    """True if K comes from a covariance; otherwise from |θ̂|."""
    free: tuple[int, ...]

    @classmethod
    def of(cls, physics: PhysicsMap, theta_hat: Vector, covariance: Matrix | None) -> _Fit:
        target, names = np.asarray(theta_hat, dtype=float), physics.theta_names
        if target.shape != (len(names),):
            raise InputError(
                f"`theta_hat` has shape {target.shape}; expected one number for each of "
                f"{', '.join(names)}."
            )
        for name, value in zip(names, target, strict=True):
            if not np.isfinite(value):
                raise InputError(f"`theta_hat` is {value} for {name}; expected a finite estimate.")
        whiten = (
            None if covariance is None else _whitener(target, np.asarray(covariance, dtype=float))
        )
        default = np.diag(1 / magnitude(target))
        free = tuple(range(len(physics.parameters)))
        return cls(physics, target, default if whiten is None else whiten, whiten is not None, free)

    def at(self, p: Vector) -> tuple[Vector, Matrix]:
        """Return the whitened residual (nθ,) and its derivative (nθ, np)."""
        theta, jacobian = self.physics.linearised(p)
        with np.errstate(all="ignore"):
            return self.whiten @ (theta - self.target), self.whiten @ jacobian

    @np.errstate(all="ignore")  # where there is no solution p goes to infinity
    def descend(self, p: Vector) -> tuple[float, Vector]:
        """Return cost and p of the minimum that SciPy's dog-leg search finds from p.

        Cost inf where θ has no value at p. The search goes from bound to bound, so p ends on one or
        away from it.
        """
        from scipy.optimize import least_squares  # slow to import

        cost, free = _cost(*self.at(p)), list(self.free)
        if not free or not np.isfinite(cost):
            return cost, p
        scale = self.physics.size[free]
        low, high = (bound[free] for bound in self.physics.bounds)

        def rows(z: Vector) -> Vector:
            residual, jacobian = self.at(moved(z))
            return residual if np.isfinite(jacobian).all() else np.full_like(residual, np.inf)

        def moved(z: Vector) -> Vector:
            new = p.copy()
            new[free] = np.clip(z * scale, low, high)
            return new

        end = least_squares(
            rows,
            np.clip(p[free] / scale, low / scale, high / scale),
            lambda z: self.at(moved(z))[1][:, free] * scale,  # pyright: ignore[reportArgumentType]
            bounds=(low / scale, high / scale),
            method="dogbox",
            xtol=_STEP,
            ftol=None,  # pyright: ignore[reportArgumentType]
            gtol=None,  # pyright: ignore[reportArgumentType]
            max_nfev=_EVALUATIONS,
        )
        new = moved(end.x)
        new[free] = np.where(
            end.active_mask < 0, low, np.where(end.active_mask > 0, high, new[free])
        )
        return _cost(*self.at(new)), new

    def solutions(self, starts: int) -> list[Vector]:
        """Return the best p first, then others that explain θ̂ equally well.

        From p⁰ and `starts` points about it.
        """
        points = (self.physics.initial, *self.physics.around(starts, 4.0))
        minima = [self.descend(p) for p in points]
        least = min(cost for cost, _ in minima)
        distinct: list[Vector] = []
        for cost, p in minima:
            near = [
                np.all(np.abs(p - q) <= 1e-3 * np.maximum(np.abs(q), 1e-3 * self.physics.size))
                for q in distinct
            ]
            if cost <= least * (1 + 1e-9) + _SOLVED[self.known] and not any(near):
                distinct.append(p)
        return distinct


def _cost(residual: Vector, jacobian: Matrix) -> float:
    """Return ‖residual‖², infinite where it or the derivative is not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        cost = float(residual @ residual)
    return cost if np.isfinite(cost) and np.isfinite(jacobian).all() else math.inf


def _whitener(target: Vector, covariance: Matrix) -> Matrix | None:
    """Return K (nθ, nθ) with KᵀK = Cov⁻¹.

    None where an entry of θ has no variance, as at a bound.
    """
    if not np.isfinite(covariance).all():
        return None
    # θ̂ is rounded itself: a variance of zero becomes that of its last digit
    rounded = (np.finfo(float).eps * magnitude(target)) ** 2 + np.finfo(float).tiny
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0) + rounded)
    correlation = (covariance + np.diag(rounded)) / np.outer(std, std)
    eigenvalues, vectors = np.linalg.eigh(correlation)
    if not np.allclose(correlation, correlation.T, rtol=0, atol=1e-8) or eigenvalues[0] < -1e-8:
        raise InputError(
            "`covariance` must be symmetric with no negative eigenvalue; expected that of "
            "theta_hat."
        )
    # a combination of θ without variance is known as well as double precision can show, not unknown
    return (vectors / np.sqrt(np.maximum(eigenvalues, _ROUNDING))).T / std


def solve(
    physics: PhysicsMap,
    theta_hat: Vector,
    covariance: Matrix | None,
    *,
    freedom: float,
    starts: int = 4,
) -> PhysicalEstimate:
    """Return p̂ = argmin (θ̂ − h(p))ᵀ Cov⁻¹ (θ̂ − h(p)) within its bounds, with its statistics.

    Args:
        physics: h.
        theta_hat: θ̂ (nθ,) in the order of `physics.theta_names`.
        covariance: Cov θ̂ (nθ, nθ); None, or one that is not finite, gives relative weights and no
            statistics.
        freedom: degrees of freedom of the noise variance within it; inf where that is known.
        starts: points about p⁰ from which the solution is sought besides p⁰ itself.

    Raises:
        InputError: θ̂ of another shape, or what is no estimate or covariance.
    """
    fit = _Fit.of(physics, theta_hat, covariance)
    value, *others = fit.solutions(starts)
    residual, jacobian = fit.at(value)
    held = _bound_mask(physics, value, jacobian.T @ residual)
    chi2, df = float(residual @ residual), len(residual) - int(np.sum(~held))
    outside = df == 0 and chi2 > _SOLVED[fit.known]
    sensitivity = excitation(
        jacobian[:, ~held],
        [name for name, at_bound in zip(physics.names, held, strict=True) if not at_bound],
    )
    spread, sensitivities = (
        _linear(fit, value, jacobian, held)
        if sensitivity.full_rank and not outside
        else (None, None)
    )
    consistency = (
        _consistency(chi2, df, freedom, bool(held.any())) if fit.known and df > 0 else None
    )
    warnings = [*_at_bounds(physics, value, held), *_other_minima(physics, others)]
    if outside:
        warnings.append(_outside(fit, value))
    elif not sensitivity.full_rank:
        text = (
            f"At the solution {tied_text(sensitivity)}; "
            "the physical parameters have no standard errors."
        )
        warnings.append(Warning("physical_parameters_tied", text))
    if not fit.known:
        text = "theta has no finite covariance, so the physical parameters have no standard errors."
        warnings.append(Warning("no_standard_errors", text))
    if consistency is not None and consistency.p < CONTRADICTION:
        warnings.append(Warning("physics_contradicted", consistency.text))
    std = np.full(len(value), np.nan) if spread is None else np.sqrt(np.diag(spread))
    return PhysicalEstimate(
        names=physics.names,
        units=tuple(p.unit for p in physics.parameters),
        initial=physics.initial,
        value=value,
        std=tuple(float(s) if np.isfinite(s) else None for s in std),
        ci95=tuple(
            (float(a), float(b)) if np.isfinite(b - a) else None
            for a, b in interval(value, std, freedom)
        ),
        covariance=spread,
        consistency=consistency,
        sensitivities=sensitivities,
        warnings=tuple(warnings),
    )


def _bound_mask(physics: PhysicsMap, value: Vector, gradient: Vector) -> Bool[np.ndarray, "n"]:
    """Return a mask (np,) of the parameters that the data press against a bound."""
    low, high = physics.bounds
    return ((value <= low) & (gradient > 0)) | ((value >= high) & (gradient < 0))


def _linear(
    fit: _Fit, value: Vector, jacobian: Matrix, held: Bool[np.ndarray, "n"]
) -> tuple[Matrix | None, Matrix]:
    """Return Cov p̂ = (HᵀWH)⁻¹ and ∂ln p̂ / ∂ln θ̂, by SVD of KH.

    The covariance is None without Cov θ̂; dp̂/dθ̂ = (HᵀWH)⁻¹HᵀW.
    """
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


def _consistency(chi2: float, df: int, freedom: float, held: bool) -> Consistency:
    """Return the test of θ̂ against h(p̂), with χ²/df compared to F(df, freedom).

    F, not χ², because the noise variance is estimated itself.

    Χ² itself where it is known.
    """
    p = (
        scipy.special.chdtrc(df, chi2)
        if math.isinf(freedom)
        else scipy.special.fdtrc(df, freedom, chi2 / df)
    )
    verb = "contradict" if p < CONTRADICTION else "agree with"
    what = ("constraint" if df == 1 else f"{df} constraints") + (
        ", bounds included" if held else ""
    )
    return Consistency(
        chi2,
        df,
        float(p),
        f"The data {verb} the physics' own {what} (chi2 = {chi2:.3g}, p = {p:.2g}).",
    )


def _at_bounds(physics: PhysicsMap, value: Vector, held: Bool[np.ndarray, "n"]) -> list[Warning]:
    text = (
        "{} is at its bound {:g} and has no standard error; those of the others hold for this "
        "value of it."
    )
    return [
        Warning("at_a_bound", text.format(name, v))
        for name, v, at_bound in zip(physics.names, value, held, strict=True)
        if at_bound
    ]


def _other_minima(physics: PhysicsMap, others: Sequence[Vector]) -> list[Warning]:
    if not others:
        return []
    listed = ", ".join(
        f"{name} = {v:.6g}" for name, v in zip(physics.names, others[0], strict=True)
    )
    text = (
        f"theta is explained equally well by {listed}; give bounds or better initial values to "
        "choose a solution."
    )
    return [Warning("several_solutions", text)]


def _outside(fit: _Fit, value: Vector) -> Warning:
    nearby = fit.physics.theta(value)
    worst = int(np.argmax(np.abs(nearby - fit.target) / magnitude(fit.target)))
    text = (
        "No physical parameters give the estimated theta: nearest is "
        f"{fit.physics.theta_names[worst]} = {nearby[worst]:.6g} instead of "
        f"{fit.target[worst]:.6g}. They have no standard errors; check the expressions of "
        "theta, and whether theta is biased."
    )
    return Warning("physics_not_met", text)


def profile(
    physics: PhysicsMap,
    theta_hat: Vector,
    covariance: Matrix,
    name: str,
    *,
    freedom: float,
    starts: int = 4,
) -> tuple[float, float]:
    """Return the 95 % profile-likelihood interval of one physical parameter.

    The interval is {pᵢ : min over the others χ² ≤ least χ² + F(1, freedom)}.

    Unlike p̂ ± reach·std it is asymmetric where h bends, and it ends at the parameter's bounds. A
    side without a limit from the data is ±inf.

    Raises:
        InputError: as for `solve`, an unknown name, or no covariance.
    """
    if name not in physics.names:
        hint = nearest(name, physics.names) or f"; known are {', '.join(physics.names)}."
        raise InputError(f"'{name}' is no physical parameter{hint}")
    fit = _Fit.of(physics, theta_hat, covariance)
    if not fit.known:
        raise InputError(
            "theta has no finite covariance, so there is no interval; expected that of theta_hat."
        )
    best, i = fit.solutions(starts)[0], physics.names.index(name)
    residual, jacobian = fit.at(best)
    others = replace(fit, free=tuple(j for j in fit.free if j != i))
    least, limit = float(residual @ residual), scipy.special.stdtrit(freedom, 0.975) ** 2
    path = [best]  # the others' last minimum is the next start

    @cache  # a bracket's end keeps its sign, however far the path has come since
    def excess(value: float) -> float:
        p = path[-1].copy()
        p[i] = value
        cost, p = others.descend(p)
        if np.isfinite(cost):
            path.append(p)
        return float(np.clip(cost - least - limit, -limit, 1e6 * limit))

    slope = np.linalg.norm(jacobian[:, i])
    # At most one standard deviation
    step = float(1 / slope) if slope > 0 else 1e-3 * physics.size[i]
    bounds = (physics.parameters[i].min, physics.parameters[i].max)
    low, high = (
        _find_crossing(excess, best[i], sign * step, bound)
        for sign, bound in zip((-1, 1), bounds, strict=True)
    )
    return low, high


def _find_crossing(
    excess: Callable[[float], float], start: float, step: float, bound: float
) -> float:
    """Return the point at which `excess`, negative at `start`, changes sign before `bound`.

    `bound` where it does not.
    """
    from scipy.optimize import brentq

    inner = start
    for doubling in range(60):  # 10¹⁸ standard deviations
        outer = start + step * 2.0**doubling
        outer = min(outer, bound) if step > 0 else max(outer, bound)
        if excess(outer) > 0:
            return brentq(excess, inner, outer, xtol=1e-10 * abs(step))  # pyright: ignore[reportReturnType]
        if outer == bound:
            return float(bound)
        inner = outer
    return math.copysign(math.inf, step)
