"""Bias budget of a motion: the term that explains the learner or the free run, and its bias.

With a learner it is computed as for difference equations (`budget`), over the points of the
measure. Without one only declared suspects are tried; their size follows from the free run's
residual by one Gauss-Newton step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import Warning
from orthaug._base.lines import percent
from orthaug.analysis.bias_hull import (
    MOST_PHYSICS,
    Candidate,
    NamedCause,
    compatible,
    hull,
    undetermined_warning,
)
from orthaug.analysis.budget import (
    AS_MUCH,
    LEAST_SHARE,
    SURE_SHARE,
    ParameterBias,
    explains,
    list_biases,
    parameter_biases,
)
from orthaug.analysis.catalogue import motion_catalogue
from orthaug.analysis.learned_part import learned_reach
from orthaug.analysis.motion_bias import (
    CERTIFIED_POINTS,
    MotionLinearization,
    TermBias,
    linearize_fit,
    softened_bias,
    usual_biases,
)
from orthaug.analysis.motion_suspects import MotionSuspect
from orthaug.fitting.motion_estimates import MotionEstimate
from orthaug.inference.covariance import reach

_AS_CLOSE = 2.0  # times what a cause leaves of the learner: a rival leaves no more
_CLOSE = 0.005  # of the learner: what leaves no more is as good as any
_SURE = 3.3  # standard errors of a coefficient: one in a thousand is so large by chance
_ELSEWHERE = 0.5  # of a bias, from which that of a rival is another one
# Of the learned equations: a learner that is smaller, and biases nothing, found nothing
_NOTHING = 0.01
_SAME = 1e-6  # of a term's squares: what others leave of it is none
_UNMOVED = 0.1  # standard errors of every parameter


@dataclass(frozen=True, eq=False)
class MotionBudget:
    """Bias of every parameter by the terms that explain the learner or the free run's errors."""

    causes: tuple[TermBias, ...]
    """One, or one of each learned equation that explain `share` together."""
    share: float
    parameters: tuple[ParameterBias, ...]
    warnings: tuple[Warning, ...]

    @property
    def cause(self) -> TermBias:
        """The first of them."""
        return self.causes[0]

    @property
    def coefficient(self) -> float:
        """Its size."""
        return _size(self.cause)

    def of(self, name: str) -> ParameterBias | None:
        """Return the bias of a parameter."""
        return next((entry for entry in self.parameters if entry.name == name), None)


def declared_budget(
    fit: MotionEstimate, declared: Sequence[MotionSuspect], table: Sequence[TermBias]
) -> MotionBudget | None:
    """Return the budget by the declared suspects.

    Where these are not sure to be it, by the usual ones too that the learner sees.

    Args:
        table: what every declared suspect does to the fit.
    """
    smooth = softened_bias(fit, declared)
    linearization = linearize_fit(fit)
    families = [] if linearization is None else families_of(linearization)
    budget = motion_budget(fit, table, smooth, families)
    if budget is not None and budget.share >= SURE_SHARE and table:
        return budget
    usual, softer = usual_biases(fit)
    return (
        motion_budget(fit, (*table, *usual), (*smooth, *softer), families, declared)
        if usual
        else budget
    )


def families_of(linearization: MotionLinearization) -> list[TermBias]:
    """Return the biases by every member of the catalogue that the learner sees.

    Nothing where it could imitate no parameter.
    """
    if linearization.learned is None or not linearization.shared.basis.shape[1]:
        return []
    motion, field = linearization.motion, linearization.field
    on = [entry.text for entry in linearization.place.segmented.problem.features]
    terms = motion_catalogue(
        motion, motion.coordinates.physical(linearization.q), field.x, field.u, on
    )
    entries = [linearization.entry_without_run(term) for term in terms if linearization.sees(term)]
    return [
        entry for entry in entries if linearization.physics_cosine(entry.suspect) <= MOST_PHYSICS
    ]


def noise_share(fit: MotionEstimate, linearization: MotionLinearization) -> float:
    """Return ν, the share of noise in what the learner holds, by the band of the learned curve."""
    half = learned_reach(fit, linearization.field.x, linearization.field.u)
    if half is None or not np.isfinite(half).all():
        return 0.0
    own = np.sum(linearization.unshared_learner() ** 2)
    return float(
        np.sum(linearization.weigh(half / reach(fit.freedom)) ** 2) / max(own, np.finfo(float).tiny)
    )


def motion_budget(
    fit: MotionEstimate,
    table: Sequence[TermBias],
    smooth: Sequence[TermBias] = (),
    families: Sequence[TermBias] = (),
    declared: Sequence[MotionSuspect] | None = None,
) -> MotionBudget | None:
    """Return the budget by the suspect that explains most, or by one in each learned equation.

    None where none explains enough.

    Args:
        table: what every suspect does to the fit.
        smooth: the same of terms that go with those of the table (`softened_bias`), named
            where they explain clearly more of a learner.
        families: the same of members of the catalogue (`families_of`).
        declared: the suspects that were declared; by default those of the table.
    """
    learns = fit.learns
    found = _of_learner(fit, table, smooth, families) if learns else _of_residual(table)
    if found is None:
        return None
    value, bias, causes = fit.values, found.moved, found.causes
    std = np.full(len(value), np.nan) if fit.std is None else fit.std
    if (
        learns
        and (fit.split_by.share or 0.0) < _NOTHING
        and not np.any(np.abs(bias) > _UNMOVED * std)
    ):
        return None
    own = {entry.suspect for entry in table} if declared is None else set(declared)
    name = " and ".join(cause.suspect.name for cause in causes)
    candidates = [NamedCause(name, found.share, bias, rest=np.linalg.norm(found.unsure, axis=0))]
    candidates += (
        _rival_candidates(fit, (*table, *smooth, *families), own)
        if learns and len(causes) == 1
        else []
    )
    ends = hull(value, std, fit.freedom, candidates)
    parameters = fit.problem.motion.parameters
    ends = np.clip(ends, [[p.min] for p in parameters], [[p.max] for p in parameters])
    rows = parameter_biases(
        causes[0].names, value, std, bias, ends, [(name, found.share)] * len(bias), fit.freedom
    )
    warning = _motion_warning(found, rows, learns=learns)
    warnings = [] if warning is None else [warning]
    open_ones = [row.name for row in rows if not row.determined]
    warnings += [undetermined_warning(open_ones, candidates, ())] if open_ones else []
    return MotionBudget(causes, found.share, rows, tuple(warnings))


def _rival_candidates(
    fit: MotionEstimate, table: Sequence[TermBias], declared: set[MotionSuspect]
) -> list[Candidate]:
    """Return the rivals of the named cause."""
    linearization = linearize_fit(fit)
    assert linearization is not None
    likely = [
        Candidate(
            entry.suspect.name, explains(entry), _parameter_shift(entry), entry.suspect in declared
        )
        for entry in table
        if entry.seen
        and entry.explained
        and (
            entry.suspect in declared or linearization.physics_cosine(entry.suspect) <= MOST_PHYSICS
        )
    ]
    return compatible(likely, noise_share(fit, linearization))


@dataclass(frozen=True, eq=False)
class _Causes:
    """Causes, their shifts of the parameters (np,), rivals, and what the causes leave open.

    The last are standard deviations (k, np).
    """

    causes: tuple[TermBias, ...]
    share: float
    moved: Vector
    unsure: Matrix
    rivals: tuple[TermBias, ...] = ()


def _is_clearly_less(share: float, other: float) -> bool:
    """Return whether a plain term gives way to a member of a family, which also fits a width."""
    return share < AS_MUCH * other and 1 - share > max(_AS_CLOSE * (1 - other), _CLOSE)


def _size(cause: TermBias) -> float:
    """Return the coefficient by the learner, else by what the free run leaves."""
    if cause.explained is None and cause.residual is not None:
        return cause.residual.coefficient
    return cause.coefficient_found or 0.0


def rivals_of(cause: TermBias, table: Sequence[TermBias]) -> list[TermBias]:
    """Return the terms that explain about as much of the learner as a cause does."""
    most = min(max(_AS_CLOSE * (1 - explains(cause)), _CLOSE), 1 - LEAST_SHARE)
    return [entry for entry in table if entry is not cause and 1 - explains(entry) <= most]


def _parameter_shift(entry: TermBias) -> Vector:
    """Return the parameters moved by a term of the size found."""
    return (entry.coefficient_found or 0.0) * entry.per_unit


def _of_learner(
    fit: MotionEstimate,
    table: Sequence[TermBias],
    smooth: Sequence[TermBias],
    families: Sequence[TermBias] = (),
) -> _Causes | None:
    """Return the term that explains most of the learner, or one of each equation.

    One of each is taken where these leave much less of it.
    """
    best, other = (
        max(table, key=explains, default=None),
        max((*smooth, *families), key=explains, default=None),
    )
    if other is not None and (best is None or _is_clearly_less(explains(best), explains(other))):
        best = other
    linearization, every = linearize_fit(fit), (*table, *smooth)
    alone = [] if best is None else [[best, *(entry for entry in every if entry is not best)]]
    share = 0.0 if best is None else explains(best)
    if linearization is not None and share < SURE_SHARE:
        tables = (table, every) if smooth else (table,)
        found = [
            (explains(each[0][0]), each)
            for terms in tables
            if (each := one_of_each(linearization, terms))
        ]
        joint, each = next((pair for pair in found if pair[0] >= AS_MUCH * found[-1][0]), (0.0, []))
        # As much of what the others leave as one must explain of all
        enough = 1 - (1 - LEAST_SHARE) ** len(each)
        if joint >= enough and (share < LEAST_SHARE or 1 - share >= _AS_CLOSE * (1 - joint)):
            alone, share = each, joint
    return None if share < LEAST_SHARE else _weigh_causes(linearization, alone, share, every)


def one_of_each(
    linearization: MotionLinearization, table: Sequence[TermBias]
) -> list[list[TermBias]]:
    """Return terms of each learned equation, ordered by their joint share of the learner.

    The share of a term is that beside the first of the other equations.

    The first ones explain most together, over 20,000 points at most. Nothing where terms of one
    equation alone explain any of it.
    """
    seen = [entry for entry in table if entry.seen and entry.explained]
    places = [entry.suspect.place(linearization.motion) for entry in seen]
    groups = [np.flatnonzero(np.equal(places, place)) for place in dict.fromkeys(places)]
    if len(groups) < 2:
        return []
    values = (
        *(linearization.beside(linearization.held(entry.suspect)) for entry in seen),
        linearization.unshared_learner(),
    )
    rows = np.stack([row[:: 1 + len(row) // CERTIFIED_POINTS].ravel() for row in values])
    sizes = np.linalg.norm(rows, axis=1)
    cosines = (rows @ rows.T) / np.outer(sizes, sizes)

    def explain_beside(others: list[int]) -> tuple[Vector, Vector]:
        """Return the share of the learner that others explain with each term, and coefficients."""
        rest = (
            cosines
            - cosines[:, others] @ np.linalg.pinv(cosines[np.ix_(others, others)]) @ cosines[others]
        )
        own, product = rest.diagonal()[:-1], rest[:-1, -1]
        fitted = np.where(own > _SAME, product / np.where(own > _SAME, own, 1.0), 0.0)
        return 1 - rest[-1, -1] + fitted * product, fitted * sizes[-1] / sizes[:-1]

    def best_from(first: int) -> tuple[float, list[int]]:
        """Return the best term of each equation beside the others, iterated from a first term."""
        now, share = [first], 0.0
        for k in (*range(1, len(groups)), *range(len(groups)), *range(len(groups))):
            shares = explain_beside(now[:k] + now[k + 1 :])[0][groups[k]]
            now[k : k + 1], share = [int(groups[k][np.argmax(shares)])], float(np.max(shares))
        return share, now

    chosen, found = max(best_from(first) for first in groups[0].tolist())[1], []
    for k, group in enumerate(groups):
        shares, fitted = explain_beside(chosen[:k] + chosen[k + 1 :])
        members = [
            replace(seen[i], explained=float(shares[i]), coefficient_found=float(fitted[i]))
            for i in group
        ]
        found.append(sorted(members, key=explains, reverse=True))
    return found


def _weigh_causes(
    linearization: MotionLinearization | None,
    each: Sequence[Sequence[TermBias]],
    share: float,
    table: Sequence[TermBias],
) -> _Causes:
    """Return causes with the uncertainty of their sizes, and with their rivals.

    Args:
        each: of an equation, or of all, its cause and then what may be it instead.
    """
    causes = tuple(entries[0] for entries in each)
    bias, rivals = np.sum([_parameter_shift(cause) for cause in causes], axis=0), []
    unsure = [np.sqrt((1 - share) / share) * bias]
    for cause, *others in each:
        near = rivals_of(cause, others)
        apart = [np.abs(_parameter_shift(rival) - _parameter_shift(cause)) for rival in near]
        if len(each) > 1:  # of a single cause they are in the hull
            unsure.append(np.max([np.zeros(len(bias)), *apart], axis=0))
        rivals += [
            rival
            for rival, by in zip(near, apart, strict=True)
            if np.any(by > _ELSEWHERE * np.abs(bias))
        ]
    after = [] if linearization is None else linearization.after(causes, table)
    unsure += [_parameter_shift(max(after, key=explains))] if after else []
    return _Causes(causes, share, bias, np.array(unsure), tuple(rivals))


def _of_residual(table: Sequence[TermBias]) -> _Causes | None:
    """Return the term that lowers the residual most, if it is significant and explains most of it.

    Most is of the part that is no white noise.

    The rest beyond white noise is assumed to be as biased for its size, with unknown sign.
    """
    sure = [
        entry
        for entry in table
        if entry.residual is not None and abs(entry.residual.t or 0.0) >= _SURE
    ]
    best = max(
        sure, key=lambda entry: entry.residual.share if entry.residual else 0.0, default=None
    )
    if best is None or best.residual is None or best.residual.std is None:
        return None
    step, std = best.residual, best.residual.std
    if step.share < LEAST_SHARE * (step.share + step.left):
        return None
    unsure = np.hypot(std, step.coefficient * np.sqrt(step.left / step.share))
    return _Causes(
        (best,), step.share, step.coefficient * best.per_unit, np.array([unsure * best.per_unit])
    )


def _motion_warning(
    found: _Causes, rows: Sequence[ParameterBias], *, learns: bool
) -> Warning | None:
    """Return one sentence on biases above the standard error: causes and their sizes."""
    large = [entry for entry in rows if (entry.errors or 0.0) > 1]
    if not large:
        return None
    several, first = len(found.causes) > 1, sorted(found.rivals, key=explains, reverse=True)[:2]
    named = " and ".join(f"{rival.suspect.name}, {percent(explains(rival))}" for rival in first)
    other = f" (close to it: {named}, which would imply other values)" if first else ""
    what = "the learner" if learns else "the free run's squared error"
    listed = " and ".join(
        f"{c.suspect.name} of size {_size(c):.3g} {c.suspect.unit}".rstrip()
        + f" in the equation of {c.equation}"
        for c in found.causes
    )
    if learns and found.share < SURE_SHARE:
        return Warning(
            "biased",
            f"what the learner found looks most like {listed} ({percent(found.share)} of it). "
            f"This would move {list_biases(large)}; the standard errors do not cover this "
            f"bias{other}.",
        )
    return Warning(
        "biased",
        f"{listed} explain{'' if several else 's'} {100 * found.share:.0f} % of {what} and "
        f"move{'' if several else 's'} {list_biases(large)}. The standard errors do not cover "
        f"this bias{other}.",
    )
