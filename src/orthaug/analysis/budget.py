"""Bias budget: the cause that explains the learner, and the bias of every parameter by it.

With F the learner's values under the measure and Δ a cause's, the coefficient is that of P⊥F on P⊥Δ
and the bias, estimate less truth, `Φ_μ⁺Δ` times it (`bias`, `causes`). The interval is the hull
over all causes that noise cannot separate from it (`bias_hull`). A free run without a learner has
no F: there only declared terms are tried, and their size follows from its residual by one
Gauss-Newton step.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import singledispatch
from typing import Any, Protocol, cast

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector, check_type
from orthaug._base.errors import InputError, Warning
from orthaug._base.lines import first_words, join_words, percent, plain_number
from orthaug.analysis.bias import SuspectedBias, bias_table
from orthaug.analysis.bias_hull import (
    LEAST,
    MOST_PHYSICS,
    Candidate,
    NamedCause,
    compatible,
    hull,
    most_mixed,
    undetermined_warning,
)
from orthaug.analysis.causes import (
    SURE_SHARE,
    Causes,
    Considered,
    explain_learner,
    explain_residual,
)
from orthaug.analysis.free_run_bias import linearize_fit
from orthaug.analysis.measure_bias import linearization_of
from orthaug.analysis.parameter_bias import (
    ParameterBias,
    owners_of,
    parameter_biases,
    physical_biases,
)
from orthaug.analysis.rival_forms import SelectedTerms
from orthaug.analysis.suspects import (
    ODD_JUMPS,
    MotionSuspect,
    Suspect,
    check_motion_suspects,
)
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.fitting.motion_estimate import MotionEstimate
from orthaug.inference.measures import Measure, Training
from orthaug.physics.parameters import PhysicsMap

_ROUNDING = 1e-9  # of a parameter: a bias that no one can speak of
_ALIKE_SHIFT = 0.05  # of it: terms that move the parameters alike
_SAME = 1e-3  # of a share: terms that differ less are one term by two names
_WHOLE = 0.95  # of what the learner found: a cause that may replace it
_LISTED = 4  # parameters that a warning lists at most
_FEWEST_LEFT = 5  # rows beyond what was fitted: where fewer are left any term explains the learner


@dataclass(frozen=True, eq=False)
class Budget:
    """Bias of every parameter by the causes that explain the learner, the largest part first.

    Without a learner they explain the free run's errors.
    """

    causes: tuple[SuspectedBias, ...]
    share: float
    """Share of the learner that the first causes explain: one, or one of each learned equation.

    Where each output has a cause, of what is learned of its own.
    """
    parameters: tuple[ParameterBias, ...]
    physical: tuple[ParameterBias, ...]
    warnings: tuple[Warning, ...]

    @property
    def cause(self) -> SuspectedBias:
        """Cause that explains most."""
        return self.causes[0]

    @property
    def coefficient(self) -> float:
        """Its size, by the learner, else by what the free run leaves."""
        return self.cause.coefficient

    def of(self, name: str) -> ParameterBias | None:
        """Return the bias of a parameter or physical parameter."""
        return next(
            (entry for entry in (*self.parameters, *self.physical) if entry.name == name), None
        )


class BudgetTerms(SelectedTerms, Protocol):
    """A fit whose learner is to be explained: what a budget needs beside the table of biases."""

    @property
    def learned(self) -> Matrix | None:
        """The learner at the measure's points; None without one."""
        ...

    @property
    def bounds(self) -> Matrix:
        """Bounds (nθ, 2) of the parameters."""
        ...

    def considered(
        self, declared: Sequence[Any], named: Sequence[SuspectedBias] | None = None
    ) -> Iterator[Considered]:
        """Yield terms in the order in which they are looked at, until some explain enough.

        Args:
            named: the biases by the declared suspects, where they are known.
        """
        ...

    def parts(self) -> Sequence[tuple[str | None, BudgetTerms]]:
        """Return the outputs of which something is learned, each with the fit of its part.

        None for an output where the learner has no parts.
        """
        ...

    def is_negligible(self, bias: Vector) -> bool:
        """Return whether the learner found nothing that could bias so."""
        ...

    def noise_share(self) -> float:
        """Return the share of noise in what the learner holds beside the physics."""
        ...

    def remedies(self, cause: SuspectedBias, biased: Sequence[str]) -> list[str]:
        """Return what would remove the bias of the named parameters, the easiest first."""
        ...


def bias_budget(
    fit: Estimate,
    suspects: Sequence[Suspect | MotionSuspect] = (),
    *,
    physics: PhysicsMap | None = None,
    measure: Measure | None = None,
) -> Budget | None:
    """Return the bias that what the learner found implies.

    None where no cause explains enough of it.

    Args:
        fit: with a learner and the orthogonal structure; of others there is no budget. Of lagged
            physics or a motion.
        suspects: terms that may be missing, looked at first; of a motion `MotionSuspect`.
        physics: the map from physical parameters to θ, for their biases; a motion has none.
        measure: what θ was split under, where that is not the training measure; a motion's fit
            knows its own.

    Returns:
        The `cause`, the `share` of the learner that it explains, and the bias of each of
        `parameters` and `physical`, estimate less truth, with an interval that covers bias and
        noise together: the hull over all causes that noise cannot separate. Where `determined` is
        False that is wider than the value itself, and there is none.

    Raises:
        InputError: arguments that the kind of physics does not take; another measure than that of
            the fit; a suspect on channels or lags that the data do not have.

    Examples:
        >>> import numpy as np
        >>> import orthaug as oa
        >>> u = np.random.default_rng(0).uniform(-1, 1, 300)
        >>> noise = 0.05 * np.random.default_rng(1).normal(size=300)
        >>> record = oa.Record.from_arrays(u, 2 * u + u**3 + noise)
        >>> gain = oa.Baseline.from_terms([oa.Term("gain", "u[k]")])
        >>> cubic, structure = oa.Terms(("u[k]**3",)), oa.Orthogonal(shared="all")
        >>> fit = oa.estimate(record, gain, learner=cubic, structure=structure)
        >>> budget = bias_budget(fit, [oa.Suspect("cubic", "u[k]**3")])
        >>> budget.cause.suspect.name, round(budget.of("gain").value, 1)  # θ took 0.6 of the cubic
        ('cubic', 0.6)
    """
    check_type(fit, Estimate, "fit", "what estimate returns")
    return _budget(fit, suspects, physics, measure)


@singledispatch
def _budget(
    fit: Estimate,
    suspects: Sequence[Any],
    physics: PhysicsMap | None,
    measure: Measure | None,
) -> Budget | None:
    """Return `bias_budget` of a kind of physics."""
    raise NotImplementedError


@_budget.register(MotionEstimate)
def _of_motion(
    fit: MotionEstimate,
    suspects: Sequence[Any],
    physics: PhysicsMap | None,
    measure: Measure | None,
) -> Budget | None:
    _check_suspects(suspects, MotionSuspect)
    for name, given in (("physics", physics), ("measure", measure)):
        if given is not None:
            raise InputError(
                f"`{name}` does not apply to a fit of equations of motion; leave it out."
            )
    check_motion_suspects(suspects, fit.problem)
    terms = linearize_fit(fit)
    return None if terms is None else budget_on(terms, suspects)


@_budget.register(LaggedEstimate)
def _of_lagged(
    fit: LaggedEstimate,
    suspects: Sequence[Any],
    physics: PhysicsMap | None,
    measure: Measure | None,
) -> Budget | None:
    _check_suspects(suspects, Suspect)
    if not fit.status.ok or fit.model.structure != "orthogonal" or not fit.learns:
        return None
    measure = Training() if measure is None else measure
    name = "training" if fit.measure is None else fit.measure.name
    if measure.name != name:
        raise InputError(
            f"`measure` is the {measure.name} measure, but θ was split under the {name} measure."
        )
    return budget_on(linearization_of(fit, measure, physics), suspects)


def _check_suspects(suspects: Sequence[Any], wanted: type) -> None:
    """Raise InputError for suspects of another kind of physics."""
    required = f"a sequence of {wanted.__name__}, as the fit's physics requires"
    for suspect in suspects:
        check_type(suspect, wanted, "suspects", required)


def budget_on(
    terms: BudgetTerms, declared: Sequence[Any], named: Sequence[SuspectedBias] | None = None
) -> Budget | None:
    """Return the budget of a fit; None where nothing explains enough of its learner.

    Args:
        declared: suspects that were named, looked at first.
        named: the biases by them, where they are known.
    """
    if not terms.names or terms.fit.freedom < _FEWEST_LEFT:
        return None
    if terms.learned is None:
        found = explain_residual(
            named if named is not None else bias_table(terms, declared, certify=False)
        )
        return None if found is None else budget_by(terms, [found], declared=declared)
    parts = terms.parts()
    whole = first_causes(terms, declared, named) if parts else None
    found = [] if whole is None else [whole]
    nameless: list[SuspectedBias] = []
    if whole is None or whole.share < SURE_SHARE:
        each: list[Causes] = []
        for output, own in parts:
            if output is None:
                continue
            causes = first_causes(own, declared)
            if causes is None:
                rest = [e for c in own.considered(declared) for e in c.every if e.explained]
                nameless += [max(rest, key=lambda entry: entry.share)] if rest else []
            elif causes.entries[0].suspect.output == output:
                each.append(replace(causes, output=output))
        each.sort(key=_learned_size, reverse=True)
        found = each if len(each) > len(found) else found
    return budget_by(terms, found, nameless, declared) if found else None


def first_causes(
    terms: BudgetTerms, declared: Sequence[Any], named: Sequence[SuspectedBias] | None = None
) -> Causes | None:
    """Return the causes among the first terms, in the order of `considered`, that are enough."""
    found = (explain_learner(terms, each, declared) for each in terms.considered(declared, named))
    return next((causes for causes in found if causes is not None), None)


def _learned_size(causes: Causes) -> float:
    learner = None if causes.terms is None else causes.terms.linearization.learner
    return 0.0 if learner is None else float(np.linalg.norm(learner))


def budget_by(
    terms: BudgetTerms,
    found: Sequence[Causes],
    nameless: Sequence[SuspectedBias] = (),
    declared: Sequence[Any] = (),
) -> Budget | None:
    """Return the budget by given causes; None for a learner that found nothing.

    Args:
        found: one for all of the learner, or one for each output's part.
        nameless: what explains most of each output that has no cause.
    """
    fit, value, bias = terms.fit, terms.value, np.sum([causes.moved for causes in found], axis=0)
    if terms.is_negligible(bias):
        return None
    shifts = np.array([entry.shift for entry in nameless]).reshape(-1, len(bias))
    other = np.linalg.norm(shifts, axis=0)
    candidates = _candidates(terms, found, shifts, declared)
    std = fit.known_std
    noise = np.full((len(value), 2), np.nan) if fit.interval is None else fit.interval
    ends = hull(value, noise, fit.freedom, candidates, other)
    ends = np.clip(ends, *terms.bounds.T[:, :, None])
    owners = owners_of(found, np.array([causes.moved for causes in found]))
    parameters = parameter_biases(terms.names, value, std, bias, ends, owners, fit.freedom)
    physical, unbounded = physical_biases(terms, found, candidates, other)
    rows, warnings = (*physical, *parameters), []
    for causes in found:
        large = [row for row in rows if row.cause == causes.name and _is_large(row)]
        if large:
            cure = terms_of(causes, terms).remedies(causes.entries[0], [row.name for row in large])
            warnings.append(_biased_warning(causes, large, cure, terms))
    open_ones = [row.name for row in rows if not row.determined]
    if open_ones:
        cure = terms_of(found[0], terms).remedies(found[0].entries[0], open_ones)
        seen = len(terms.fit.model.form.entries)
        count = len(terms.fit.model.outputs)
        warnings.append(
            undetermined_warning(open_ones, candidates, cure, entries=seen, outputs=count)
        )
    entries = tuple(entry for causes in found for entry in causes.entries)
    return Budget(entries, found[0].share, parameters, physical, (*warnings, *unbounded))


def terms_of(causes: Causes, terms: BudgetTerms) -> BudgetTerms:
    """Return the fit whose learner, or part of it, some causes explain."""
    return terms if causes.terms is None else cast("BudgetTerms", causes.terms)


def _candidates(
    terms: BudgetTerms,
    found: Sequence[Causes],
    nameless: Float[np.ndarray, "k nt"],
    declared: Sequence[Any],
) -> list[Candidate]:
    """Return the named causes and their rivals."""
    bias = np.sum([causes.moved for causes in found], axis=0)
    rest = np.concatenate([*(causes.unsure for causes in found), nameless])
    name, share = " and ".join(c.name for c in found), min(c.share for c in found)
    kept: list[Candidate] = [NamedCause(name, share, bias, rest=np.linalg.norm(rest, axis=0))]
    for causes in found:
        likely = [
            Candidate(
                entry.suspect.name,
                entry.share,
                entry.shift + bias - causes.moved,
                entry.suspect in declared,
            )
            for entry in causes.comparable
            if entry.explained
            and (entry.suspect in declared or (entry.physics_cosine or 0.0) <= MOST_PHYSICS)
        ]
        if likely:
            of = terms_of(causes, terms)
            close = compatible(likely, of.noise_share())
            kept += close
            if not any(c.declared for c in close):
                kept += _mixtures(of, causes, bias - causes.moved)
    return kept


def _mixtures(terms: BudgetTerms, causes: Causes, others: Vector) -> list[Candidate]:
    """Return the best cause with as much of each other one as noise may hide, where both jump.

    Of `(1 − t) f_best + t f_other`, each of the size that explains most of the learner alone, the
    largest t at which the two together leave no more than `most_mixed` of it.

    Args:
        others: the bias by causes of other outputs.
    """
    likely = [
        entry
        for entry in causes.comparable
        if entry.explained and (entry.physics_cosine or 0.0) <= MOST_PHYSICS
    ]
    table = [entry for entry in likely if entry.suspect.name.startswith(ODD_JUMPS)]
    best = max(table, key=lambda entry: entry.share, default=None)
    if best is None or best.share < max(entry.share for entry in likely):
        return []
    beside = [one for one in table if one is not best and one.share >= LEAST * best.share]
    linearization = terms.linearization
    responses = terms.respond([entry.suspect for entry in (best, *beside)], run=False)
    own = linearization.unshared_learner
    if responses is None or own is None or any(one.held is None for one in responses):
        return []
    whole = float(np.vdot(own, own))
    left = [
        own - entry.coefficient * linearization.residual(np.asarray(response.held))
        for entry, response in zip((best, *beside), responses, strict=True)
    ]
    most = most_mixed(best.share, terms.noise_share()) * whole
    found = []
    for entry, rest in zip(beside, left[1:], strict=True):
        apart = rest - left[0]
        a, b = float(np.vdot(apart, apart)), float(np.vdot(apart, left[0]))
        c = float(np.vdot(left[0], left[0])) - most
        if not a > 0 or c >= 0:
            continue
        t = min((np.sqrt(b * b - a * c) - b) / a, 1.0)
        share = 1 - (c + most + t * (2 * b + t * a)) / whole
        name = f"{best.suspect.name} and {entry.suspect.name}"
        moved = (1 - t) * best.shift + t * entry.shift
        found.append(Candidate(name, share, moved + others))
    return found


def _is_large(row: ParameterBias) -> bool:
    """Return whether a bias is above the standard error, and no rounding."""
    return (row.errors or 0.0) > 1 and abs(row.relative or 1.0) > _ROUNDING


def _biased_warning(
    causes: Causes, large: Sequence[ParameterBias], remedies: Sequence[str], terms: BudgetTerms
) -> Warning:
    """Return the warning on large biases: causes, sizes, remedies, and how sure the causes are."""
    several, learns = len(causes.entries) > 1, terms.learned is not None
    cure = " or ".join([*(_as_physics(causes, terms.memory) if learns else ()), *remedies])
    where = "" if causes.output is None else f" in {causes.output}"
    listed, moves = " and ".join(map(_describe_cause, causes.entries)), list_biases(large)
    rivals = sorted(causes.rivals, key=lambda entry: entry.share, reverse=True)
    first = _drop_same(causes, rivals)[:2]
    named = " and ".join(f"{rival.suspect.name}, {percent(rival.share)}" for rival in first)
    other = f" (close to it: {named}, which would imply other values)" if first else ""
    if learns and causes.share < SURE_SHARE:
        near = ", ".join(
            f"{entry.suspect.name} {percent(entry.share)}"
            for entry in _drop_same(causes, causes.near)
        )
        beside = f"; next: {near}" if near else ""
        return Warning(
            "biased",
            f"what the learner found{where} looks most like {listed} ({percent(causes.share)} of "
            f"it{beside}). This would move {moves}; the standard errors do not cover this "
            f"bias{other}{f'. If this is the cause: {cure}' if cure else ''}.",
        )
    what = f"the learner{where}" if learns else "the free run's squared error"
    return Warning(
        "biased",
        f"{listed} explain{'' if several else 's'} {100 * causes.share:.0f} % of {what} and "
        f"move{'' if several else 's'} {moves}. The standard errors do not cover this "
        f"bias{other}{f'. Remedy: {cure}' if cure else ''}.",
    )


def _drop_same(causes: Causes, others: Sequence[SuspectedBias]) -> list[SuspectedBias]:
    """Return the terms without those that are a cause, or an earlier term, by another name."""
    found: list[SuspectedBias] = []
    for one in others:
        known = (*causes.entries, *found)
        if not any(_is_same(one, other) for other in known):
            found.append(one)
    return found


def _is_same(one: SuspectedBias, other: SuspectedBias) -> bool:
    """Return whether two terms of an equation explain as much, and move the parameters as much."""
    if one.equation != other.equation or abs(one.share - other.share) >= _SAME * other.share:
        return False
    apart = np.linalg.norm(one.shift - other.shift)
    return bool(apart <= _ALIKE_SHIFT * np.linalg.norm(other.shift))


def _as_physics(causes: Causes, memory: Sequence[str]) -> tuple[str, ...]:
    """Return the remedy to write causes that explain nearly all into the physics; else none.

    A term with memory is no expression of one row. One that reads a state of the learner, which
    `memory` names, needs that state's equation, too.
    """
    suspects = [entry.suspect for entry in causes.entries]
    if causes.share < _WHOLE or any(one.memory is not None for one in suspects):
        return ()
    named = " and ".join(
        one.expression + (f" in the equation of {entry.equation}" if entry.equation else "")
        for one, entry in zip(suspects, causes.entries, strict=True)
    )
    read = [name for name in memory if re.search(rf"\b{re.escape(name)}\b", named)]
    if read:
        return (f"let `orthaug explain` write {named} into the physics, with {join_words(read)}",)
    formed = ", `selected = true`" if any(one.expression != "1" for one in suspects) else ""
    return (f"write {named} into the physics with a coefficient as parameter{formed}",)


def _describe_cause(entry: SuspectedBias) -> str:
    """Return the name of a cause; of a motion with its size, for its coefficient is physical."""
    if entry.equation is None:
        return entry.suspect.name
    size = f"{entry.coefficient:.3g} {entry.suspect.unit}".rstrip()
    return f"{entry.suspect.name} of size {size} in the equation of {entry.equation}"


def list_biases(large: Sequence[ParameterBias]) -> str:
    """Return the largest biases in words."""
    ordered = sorted(large, key=lambda entry: -(entry.errors or 0.0))
    return first_words(list(map(_describe_bias, ordered)), _LISTED)


def _describe_bias(entry: ParameterBias) -> str:
    share = "" if entry.relative is None else f", {percent(entry.relative, sign='+')}"
    return (
        f"{entry.name} by {entry.value:+.2g} ({plain_number(entry.errors or 0.0)} standard "
        f"errors{share})"
    )
