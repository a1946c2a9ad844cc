"""Rival forms of a term that was selected from the data: what they would make of the parameters.

A term that data have proposed, `r*T**3` for a radiation, is one of several forms that these data
can hardly tell apart, and each leaves another value to the parameters beside it. The standard
errors know of one form only. So each form of the catalogue takes the term's place, in the fit's own
equations to first order: with A their information and g their gradient over parameters and forms,
the term's coefficient p falls to 0, `δ_p = −p̂`, and all others follow,

    δ = A⁻¹(g − A_p δ_p),    while the squares rise by  A_pp δ_p² − 2 g_p δ_p − (g − A_p δ_p)ᵀδ.

A form that raises them by no more than 12 variances of the errors over the best may be the true
one, as for causes of a learner (`bias_hull`); by more where some form beside the term lowers them,
since then the term itself is not. Of motions those are tried that do nearly what the term does:
their change of the equations is small, whatever the size of the term, so that the first order is
enough. Of lagged physics others count, too, where they fit clearly better. The interval of a
parameter is the hull over them (`form_budget`).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from jaxtyping import Bool, Float

from orthaug._base.checks import Matrix, Vector
from orthaug.analysis.bias import TermPhysics
from orthaug.analysis.bias_hull import AS_LIKELY, LEAST
from orthaug.analysis.free_run_equations import solve_scaled

_MOST_FORMS = 24  # tried in equations of first order: those that are most alike
_BRACKETED = re.compile(r"(?<!\w)\((\w+(?:\[[^\]]*\])?)\)")  # one name in brackets of its own
_SAME = 1e-3  # of what two forms do: they are one by two names
_SPANNED = 1e-10  # of a term's squares: what is left of one that others express
_CONSTANT = 1e-6  # of a constant: what is left of it beside physics that has one
_BY_CHANCE = 9.0  # variances by which some form lowers the squares of a term that is true
_PLAIN = 0.3  # times the size of a term beside the physics: what leaves less of a form is physics
_UNLIKE = 0.1  # of a term's squares beside the physics: a form that leaves no more is tried
_MOST_UNLIKE = 0.5  # one that leaves more is not, whatever the noise


class Written(Protocol):
    """A form with its expression."""

    @property
    def expression(self) -> str: ...


T = TypeVar("T", bound=Written)


class Forms(NamedTuple, Generic[T]):
    """Other forms of a term, over points where the physics was."""

    forms: Sequence[T]
    values: Float[np.ndarray, "m k"]
    slopes: Float[np.ndarray, "m n"]
    """Of the equation by the other parameters."""
    own: Float[np.ndarray, "m"]
    """The term for a coefficient of 1."""
    linear: bool
    """True if the fit's equations are exact for any form: what fits clearly better counts then."""

    def most_alike(self, least: float) -> list[tuple[T, bool]]:
        """Return the forms that may take a term's place, the most alike first.

        With each is whether it does nearly what the term does beside the physics.

        Args:
            least: share of that which such a form explains at least.
        """
        lowest = 0.0 if self.linear else least
        with np.errstate(all="ignore"):
            there = np.isfinite(self.slopes).all(axis=1) & np.isfinite(self.own)
        values, own = self.values[there], self.own[there]
        usable = np.isfinite(values).all(axis=0)
        values = np.where(usable, values, 0.0)
        size = np.linalg.norm(self.slopes[there], axis=0)
        basis = np.linalg.qr(self.slopes[there] / np.where(size > 0, size, 1.0))[0]
        term, others = own - basis @ (basis.T @ own), values - basis @ (basis.T @ values)
        whole, squares = float(term @ term), np.sum(others**2, axis=0)
        if not whole > _SPANNED * float(own @ own):
            return []
        # What is nearly the physics itself fits anything with a huge size. A constant beside log(I)
        # does not make it so: that counts from a unit of I
        sizes, level = np.sum(values**2, axis=0), np.ones(len(own)) / np.sqrt(len(own))
        if np.linalg.norm(level - basis @ (basis.T @ level)) < _CONSTANT:
            by_unit = np.array([form.expression.startswith("log(") for form in self.forms])
            sizes = np.where(by_unit, sizes - (level @ values) ** 2, sizes)
        beside = whole / max(float(own @ own), np.finfo(float).tiny)
        usable &= squares > _PLAIN**2 * beside * sizes
        shares = np.where(usable, (term @ others) ** 2 / np.where(usable, squares, 1.0), 0.0)
        order = np.argsort(-shares, kind="stable")
        # What explains all of it is the term itself, by another name
        return [
            (self.forms[k], bool(shares[k] >= least * whole))
            for k in order
            if lowest * whole <= shares[k] <= (1 - _SPANNED) * whole and usable[k]
        ][: None if self.linear else _MOST_FORMS]


class FormEquations(Protocol):
    """Normal equations of the coordinates c, of the coefficients of other forms, and of weights."""

    @property
    def information(self) -> Matrix: ...

    @property
    def gradient(self) -> Vector: ...

    @property
    def fitted(self) -> Bool[np.ndarray, "n"]:
        """Mask of what the fit has estimated."""
        ...


class SelectedTerms(TermPhysics, Protocol):
    """A fit with terms whose forms were selected: all that differs between kinds of physics."""

    def forms(self, selected: int) -> Forms[Any] | None:
        """Return other forms of a term; None where none can take its place.

        Args:
            selected: place of its coefficient among the parameters.
        """
        ...

    def with_forms(self, selected: int, forms: Sequence[Any]) -> FormEquations | None:
        """Return the fit's normal equations with further forms of a term; None without any."""
        ...

    def shapes(self, selected: int) -> Bool[np.ndarray, "nt"]:
        """Return a mask of the parameters that only shape a term, such as its width."""
        ...


@dataclass(frozen=True, eq=False)
class RivalForm:
    """Form that may be true in place of the one in the physics."""

    parameter: str
    """Coefficient of the term."""
    suspect: Any
    rise: float
    """By how much the squares rise with it, in variances of the errors; negative: they fall."""
    moved: Vector
    """The parameters (nθ,) less what they are with this form."""

    @property
    def name(self) -> str:
        """The form as an expression."""
        return _BRACKETED.sub(r"\1", self.suspect.expression)

    def is_same(self, other: RivalForm) -> bool:
        """Return whether another form is this one by another name."""
        apart = np.linalg.norm(self.moved - other.moved)
        close = abs(self.rise - other.rise) <= _SAME * max(1.0, abs(self.rise))
        return close and bool(apart <= _SAME * np.linalg.norm(self.moved))


def rival_forms(terms: SelectedTerms) -> tuple[list[RivalForm], list[str]]:
    """Return the forms that fit as well as those that were selected, the best first.

    With the coefficients of terms in whose place no other form can be tried. Of a coefficient
    without a standard error there is neither.
    """
    found: list[RivalForm] = []
    untried: list[str] = []
    for place, parameter in enumerate(terms.fit.problem.parameters):
        std = terms.fit.known_std[place]
        if not (parameter.selected and std > 0):
            continue
        forms = terms.forms(place)
        if forms is None:
            untried.append(parameter.name)
        elif terms.value[place] != 0:
            found += _rivals_among(forms, terms, place, float(abs(terms.value[place]) / std))
    found.sort(key=lambda rival: rival.rise)
    return [one for k, one in enumerate(found) if not any(map(one.is_same, found[:k]))], untried


def _rivals_among(forms: Forms[Any], terms: SelectedTerms, place: int, t: float) -> list[RivalForm]:
    """Return the rivals of one term, whose coefficient is `t` standard errors large."""
    # A form that differs by what noise hides in the fit's equations may differ by more at points
    least = 1 - max(_UNLIKE, min(4 * AS_LIKELY / t**2, _MOST_UNLIKE))
    likely = forms.most_alike(least)
    equations = terms.with_forms(place, [form for form, _ in likely]) if likely else None
    if equations is None:
        return []
    information, gradient, count = equations.information, equations.gradient, len(terms.value)
    if not np.isfinite(information).all() or not np.isfinite(gradient).all():
        return []
    others = equations.fitted.copy()
    others[:count] &= ~terms.shapes(place)
    others[place] = False
    across = information[others, place]
    own = information[place, place] - across @ solve_scaled(
        information[np.ix_(others, others)], across
    )
    if not own > 0:
        return []
    gone = -terms.value[place] / terms.slopes[place]
    variance = own * gone**2 / t**2

    def moved_by(free: Bool[np.ndarray, "n"], pull: Vector) -> tuple[Vector, float]:
        """Return the step (n,) of some unknowns, and by how much the squares fall with it."""
        step = np.zeros(len(free))
        step[free] = solve_scaled(information[np.ix_(free, free)], pull[free])
        return step, float(pull @ step)

    left = information[place, place] * gone**2 - 2 * gradient[place] * gone
    found, lacks = [], 0.0
    for k, (form, alike) in enumerate(likely):
        free = others.copy()
        free[count + k] = True
        step, falls = moved_by(free, gradient - information[:, place] * gone)
        rise = (left - falls) / variance
        shift = -(terms.slopes * step[:count])
        shift[place] = 0.0  # its coefficient is none of another form
        if alike or rise < -AS_LIKELY:
            found.append(RivalForm(terms.names[place], form, rise, shift))
        if alike:
            free[place] = True
            lacks = max(lacks, moved_by(free, gradient)[1] / variance)
    best = min([0.0, *(rival.rise for rival in found)])
    # No form may be the true one: what the best lacks, another may lack as well
    most = AS_LIKELY * (1 + max(lacks - _BY_CHANCE, 0.0))
    most = max(AS_LIKELY, min(most, (1 - LEAST) * t**2))
    return [rival for rival in found if rival.rise - best <= most]
