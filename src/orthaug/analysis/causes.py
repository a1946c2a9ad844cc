"""Causes that explain a learner: one term, or one of each learned equation, and what they leave.

Of all terms that are considered the one is named that explains most of ‖P⊥F‖², F the learner under
the measure; a member of a family (`catalogue`), whose width is fitted too, only where it explains
clearly more. Where one term is not sure to be all of it, one term of each learned equation may
explain it together. The same choice serves difference equations and motions: `Considered` says what
is different, and why.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Vector
from orthaug.analysis.bias import SuspectedBias, TermPhysics, table_beside

LEAST_SHARE = 0.5  # of the learner's energy that a cause must explain to be named
AS_MUCH = 0.98  # of what the cause explains: a rival is as good
SURE_SHARE = 0.9  # from which on a cause is named without a doubt
AS_CLOSE = 2.0  # times what a cause leaves of the learner: a rival leaves no more
CLOSE = 0.005  # of the learner: what leaves no more is as good as any
ELSEWHERE = 0.5  # of a bias, from which that of a rival is another one
_NEAR = 0.5  # of what the cause explains: a term that is listed beside it
_MOST_NEAR = 3
_SURE_T = 3.3  # standard errors of a coefficient: one in a thousand is so large by chance
_ROUNDING = 1e-9  # of a share
_SAME = 1e-6  # of a term's squares: what others leave of it is none
MOST_POINTS = 20_000  # over which terms of each equation are chosen


@dataclass(frozen=True, eq=False)
class Considered:
    """Terms that are looked at together for causes, as tables of their biases."""

    plain: Sequence[SuspectedBias]
    soft: Sequence[SuspectedBias] = ()
    """Smooth forms of plain ones that jump, named where they explain clearly more."""
    families: Sequence[SuspectedBias] = ()
    """Members of families, named where they explain clearly more."""
    beside: Sequence[SuspectedBias] | None = None
    """Terms that may explain what a cause leaves; None for plain and soft ones."""
    alike: Sequence[SuspectedBias] = ()
    """Terms that no one names, but that explain the same with another bias."""
    enough: float = LEAST_SHARE
    """Share from which on a cause among them is named."""
    close: tuple[float, float] = (1.0, 0.0)
    """What a plain term may leave and still be as good as one of a family: times what that leaves,
    and share of the learner. The learner of a motion is trained through its free run, which blurs
    it: there a form is better only by more than that.
    """
    joint: bool = False
    """True if terms of several equations explain the learner together. A term of a motion, such as
    a force between two masses, acts in several equations and moves parameters that they share;
    outputs of difference equations are looked at one by one instead.
    """
    seen_only: bool = False
    """True if only terms that the learner sees can be compared. What a learner holds of another is
    a regression on its features for difference equations; of a motion it would take a fit.
    """

    @property
    def every(self) -> tuple[SuspectedBias, ...]:
        """All but members of families."""
        return (*self.plain, *self.soft) if self.beside is None else (*self.beside,)

    @property
    def comparable(self) -> list[SuspectedBias]:
        """All that the hull of biases may be made of."""
        listed = (*self.every, *self.families, *self.alike)
        return [entry for entry in listed if self.can_compare([entry])]

    def can_compare(self, entries: Sequence[SuspectedBias]) -> bool:
        """Return whether what the learner holds of terms is known without another fit."""
        return not self.seen_only or all(entry.seen for entry in entries)


@dataclass(frozen=True, eq=False)
class Causes:
    """Terms that explain a learner together, or its part in one output.

    `moved` (nθ,) is the bias by all of them; `unsure` (k, nθ) are standard deviations of what they
    leave open, each of one unknown size.
    """

    entries: tuple[SuspectedBias, ...]
    share: float
    moved: Vector
    unsure: Float[np.ndarray, "k nt"]
    rivals: tuple[SuspectedBias, ...] = ()
    """Terms that explain about as much, and imply other values."""
    near: tuple[SuspectedBias, ...] = ()
    """The next best terms, for causes that nobody declared and that are not sure."""
    comparable: tuple[SuspectedBias, ...] = ()
    terms: TermPhysics | None = None
    """The fit that they explain the learner of."""
    output: str | None = None
    """Where they explain one output's part."""

    @property
    def name(self) -> str:
        """Their names."""
        return " and ".join(entry.suspect.name for entry in self.entries)


def explain_learner(
    terms: TermPhysics, considered: Considered, declared: Container[object] = ()
) -> Causes | None:
    """Return the term that explains most of the learner, or one of each equation.

    One of each is taken where these leave much less of it. None where nothing explains enough.

    Args:
        declared: suspects that someone named.
    """
    best, every = best_of(considered), considered.every
    each = [] if best is None else [[best, *(entry for entry in every if entry is not best)]]
    share = 0.0 if best is None else best.share
    if considered.joint and share < SURE_SHARE:
        tables = (considered.plain, every) if considered.soft else (considered.plain,)
        found = [(one[0][0].share, one) for table in tables if (one := one_of_each(terms, table))]
        joint, those = next(
            (pair for pair in found if pair[0] >= AS_MUCH * found[-1][0]), (0.0, [])
        )
        # As much of what the others leave as one must explain of all
        enough = 1 - (1 - LEAST_SHARE) ** len(those)
        if joint >= enough and (share < LEAST_SHARE or 1 - share >= AS_CLOSE * (1 - joint)):
            each, share = those, joint
    if share < considered.enough:
        return None
    return _weigh_causes(terms, considered, each, share, declared)


def best_of(considered: Considered) -> SuspectedBias | None:
    """Return the plain term that explains most, or one of a family that explains clearly more."""
    best = max(considered.plain, key=_rank, default=None)
    other = max((*considered.soft, *considered.families), key=_rank, default=None)
    if best is None or other is None:
        return best or other
    # A plain term gives way only where it explains clearly less: a family also fits a width
    times, least = considered.close
    less = best.share < AS_MUCH * other.share
    return other if less and 1 - best.share > max(times * (1 - other.share), least) else best


def _share(entry: SuspectedBias) -> float:
    return entry.share


def _rank(entry: SuspectedBias) -> float:
    """Return a share without its last digits: of two that say the same the first is named."""
    return round(_share(entry), 6)


def rivals_of(cause: SuspectedBias, table: Sequence[SuspectedBias]) -> list[SuspectedBias]:
    """Return the terms that explain about as much of the learner as a cause does."""
    most = min(max(AS_CLOSE * (1 - cause.share), CLOSE), 1 - LEAST_SHARE)
    return [entry for entry in table if entry is not cause and 1 - entry.share <= most]


def near_causes(
    cause: SuspectedBias, table: Sequence[SuspectedBias], declared: Container[object]
) -> tuple[SuspectedBias, ...]:
    """Return the next best causes, one per variable, for a cause undeclared and unsure."""
    if cause.suspect in declared or cause.share >= SURE_SHARE:
        return ()
    near = [
        entry
        for entry in table
        if entry.suspect != cause.suspect
        and entry.suspect not in declared
        and entry.share >= _NEAR * cause.share
    ]
    best: dict[str, SuspectedBias] = {}
    for entry in sorted(near, key=_share, reverse=True):
        best.setdefault(entry.suspect.on or entry.suspect.expression, entry)
    return tuple(best.values())[:_MOST_NEAR]


def one_of_each(terms: TermPhysics, table: Sequence[SuspectedBias]) -> list[list[SuspectedBias]]:
    """Return terms of each learned equation, ordered by their joint share of the learner.

    The share of a term is that beside the first of the other equations.

    The first ones explain most together, over `MOST_POINTS` at most. Nothing where terms of one
    equation alone explain any of it.
    """
    seen = [entry for entry in table if entry.seen and entry.explained]
    places = [entry.equation or "" for entry in seen]
    groups = [np.flatnonzero(np.equal(places, place)) for place in dict.fromkeys(places)]
    if len(groups) < 2:
        return []
    linearization = terms.linearization
    values = (
        *(linearization.residual(terms.values(entry.suspect)) for entry in seen),
        np.asarray(linearization.unshared_learner),
    )
    rows = np.stack([row[:: 1 + len(row) // MOST_POINTS].ravel() for row in values])
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
        found.append(sorted(members, key=_share, reverse=True))
    return found


def _weigh_causes(
    terms: TermPhysics,
    considered: Considered,
    each: Sequence[Sequence[SuspectedBias]],
    share: float,
    declared: Container[object],
) -> Causes:
    """Return causes with the uncertainty of their sizes, and with their rivals.

    The unexplained part of the learner is assumed to be as biased for its size as the causes, with
    unknown sign; the next best term adds its own bias.

    Args:
        each: of an equation, or of all, its cause and then what may be it instead.
    """
    causes = tuple(entries[0] for entries in each)
    bias = np.sum([cause.shift for cause in causes], axis=0)
    unsure, rivals = [np.sqrt(max(1 - share, 0.0) / share) * bias], []
    for cause, *others in each:
        close = rivals_of(cause, (*others, *considered.alike))
        apart = [np.abs(rival.shift - cause.shift) for rival in close]
        if len(each) > 1:  # of a single cause they are in the hull
            unsure.append(np.max([np.zeros(len(bias)), *apart], axis=0))
        rivals += [
            rival
            for rival, by in zip(close, apart, strict=True)
            if np.any(by > ELSEWHERE * np.abs(bias))
        ]
    beside: list[SuspectedBias] = []
    if considered.can_compare(causes):
        rest = [entry for entry in considered.every if considered.can_compare([entry])]
        beside = [entry for entry in table_beside(terms, causes, rest) if entry.explained]
    if beside:
        # A dead zone and a saturation whose sum is physics explain the same: rounding must not
        # choose between their biases
        most = (1 - _ROUNDING) * max(map(_share, beside))
        equal = [np.abs(entry.shift) for entry in beside if entry.share >= most]
        unsure.append(np.max(equal, axis=0))
    near = near_causes(causes[0], considered.every, declared) if len(causes) == 1 else ()
    comparable = (*considered.comparable,) if len(causes) == 1 else ()
    return Causes(causes, share, bias, np.array(unsure), (*rivals,), near, comparable, terms)


def explain_residual(table: Sequence[SuspectedBias]) -> Causes | None:
    """Return the term that lowers a free run's residual most, if it is significant.

    It must explain most of the part of the residual that is no white noise. The rest of that is
    assumed to be as biased for its size, with unknown sign.
    """
    sure = [(e, e.residual) for e in table if e.residual and abs(e.residual.t or 0.0) >= _SURE_T]
    best, step = max(sure, key=lambda pair: pair[1].share, default=(None, None))
    if best is None or step is None or step.std is None:
        return None
    if step.share < LEAST_SHARE * (step.share + step.left):
        return None
    unsure = np.hypot(step.std, step.coefficient * np.sqrt(step.left / step.share))
    bias = best.per_unit
    return Causes((best,), step.share, step.coefficient * bias, np.array([unsure * bias]))
