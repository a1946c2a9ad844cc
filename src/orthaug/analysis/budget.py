"""Bias budget: the cause that explains the learner, and the bias of every parameter by it.

With F the learner's values under the measure and Δ a cause's, the coefficient is that of P⊥F on P⊥Δ
and the bias, estimate less truth, `Φ_μ⁺Δ` times it. One cause is named: the declared suspect that
explains most of ‖P⊥F‖² if that is enough, else the usual suspect or product of lags that does, or
the member of a family (`catalogue`) that explains clearly more; one of each output where none is
sure to be all of it. The interval is the hull over all causes that noise cannot separate
from it (`bias_hull`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError, Warning
from orthaug._base.lines import percent, plain_number
from orthaug.analysis.bias import SuspectedBias, orthogonal_part
from orthaug.analysis.bias_hull import (
    MOST_PHYSICS,
    Candidate,
    NamedCause,
    compatible,
    hull,
    is_determined,
    undetermined_warning,
)
from orthaug.analysis.catalogue import catalogue
from orthaug.analysis.imitation import other_inputs
from orthaug.analysis.measure_bias import MeasureLinearization, physical_with_bias
from orthaug.analysis.suspects import Suspect, saturations, usual_suspects, usual_terms
from orthaug.data.expressions import parse
from orthaug.data.regressors import Features
from orthaug.fitting.estimates import Estimate
from orthaug.inference.measures import Measure, Symmetrized, Training, Uniform, weigh_problem
from orthaug.physics.output_weights import times
from orthaug.physics.parameters import PhysicsMap
from orthaug.physics.shared import seen_columns, shared_directions

if TYPE_CHECKING:
    from orthaug.analysis.motion_bias import TermBias

_REMOVED = 0.1  # of the bias may remain
_MEASURED_ROWS = 50_000  # above which no other measure is tried


def remedies(
    linearization: MeasureLinearization, cause: SuspectedBias, biased: Sequence[str]
) -> list[str]:
    """Return sentences on how to remove the bias of the named parameters, the easiest first."""
    return [*_by_inputs(linearization, cause, biased), *_by_measure(linearization, cause, biased)]


def _by_inputs(
    linearization: MeasureLinearization, cause: SuspectedBias, biased: Sequence[str]
) -> Iterator[str]:
    """Yield the choice of learner inputs that frees most of the parameters."""
    problem, suspect = linearization.problem, cause.suspect
    if suspect.memory is not None:  # a function of the past is one of no inputs of one row
        return
    layout, x = problem.layout, problem.rows.x
    now = {str(entry) for entry in problem.features.entries}
    best: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
    for inputs in dict.fromkeys(
        (*(((suspect.on,),) if suspect.on else ()), *other_inputs(problem))
    ):
        if set(inputs) == now:
            continue
        features = Features(tuple(parse(text, dict(problem.baseline.constants)) for text in inputs))
        if not set(features.lags) <= set(layout):
            continue
        if not seen_columns(features, layout, x, lambda rows: suspect.form(rows, layout)[:, None])[
            0
        ]:
            continue
        shared = shared_directions(problem.baseline, features, layout, problem.outputs, x)
        if shared.all:
            continue
        left = _bias(replace(linearization, directions=shared.basis), suspect)
        freed = _freed_parameters(linearization, cause, left, biased)
        if len(freed) > len(best[1]):
            best = (inputs, freed)
    if best[1]:
        listed = ", ".join(f'"{text}"' for text in best[0])
        rest = "" if len(best[1]) == len(biased) else f" for {', '.join(best[1])}"
        yield f"set learner.inputs = [{listed}]{rest}"


def _by_measure(
    linearization: MeasureLinearization, cause: SuspectedBias, biased: Sequence[str]
) -> Iterator[str]:
    """Yield a measure that brings the bias of all of them near zero."""
    if cause.seen is False or len(linearization.problem.rows) > _MEASURED_ROWS:
        return
    for measure in (Symmetrized(), Uniform()):
        if measure.name == linearization.weighed.measure.name:
            continue
        try:
            other = replace(
                linearization, weighed=weigh_problem(measure, linearization.problem), learned=None
            )
            left = _bias(other, cause.suspect)
        except InputError:
            continue
        if len(_freed_parameters(linearization, cause, left, biased)) == len(biased):
            yield f"split under the {measure.name} measure"
            return


def _bias(linearization: MeasureLinearization, suspect: Suspect) -> Vector:
    """Return the bias per unit of a suspect that the learner sees."""
    values = suspect.values(
        linearization.weighed.points.x, linearization.problem.layout, linearization.problem.outputs
    )
    return linearization.weighed.projection.solve_along(
        times(linearization.weighed.unit, values), linearization.directions
    )


def _freed_parameters(
    linearization: MeasureLinearization, cause: SuspectedBias, left: Vector, biased: Sequence[str]
) -> tuple[str, ...]:
    """Return the parameters, physical ones by their slopes, whose bias shrinks to a small part."""
    names, before = linearization.problem.baseline.names, np.array(cause.bias)
    rows = dict(zip(names, np.eye(len(names)), strict=True)) | (
        linearization.slopes[0] if linearization.slopes else {}
    )
    return tuple(
        name for name in biased if abs(rows[name] @ left) <= _REMOVED * abs(rows[name] @ before)
    )


LEAST_SHARE = 0.5  # of the learner's energy that a cause must explain to be named
_NOTHING = 0.01  # of the noise: a learner that is smaller found nothing that could be explained
_FEWEST_LEFT = 5  # rows beyond what was fitted: where fewer are left any term explains the learner
AS_MUCH = 0.98  # of what the cause explains: a rival is as good
SURE_SHARE = 0.9  # from which on a cause is named without a doubt
_NEAR = 0.5  # of what the cause explains: a rival that is named beside it
_MOST_RIVALS = 3
_ROUNDING = 1e-9  # of a parameter: a bias that no one can speak of
_LISTED = 4  # parameters that a warning lists at most


@dataclass(frozen=True)
class ParameterBias:
    """Bias of a parameter, estimate less truth, with an interval that covers bias and noise."""

    name: str
    value: float
    cause: str
    share: float
    relative: float | None
    errors: float | None
    """Its size in standard errors; None where there are none."""
    ci95: tuple[float, float] | None
    """The hull over all causes that noise cannot separate; None where that determines nothing."""
    determined: bool = True
    """Whether the data determine the parameter beside this learner: the hull is no wider than the
    value itself.
    """


@dataclass(frozen=True, eq=False)
class Budget:
    """Bias of every parameter by the causes that explain the learner, the largest part first."""

    causes: tuple[SuspectedBias, ...]
    parameters: tuple[ParameterBias, ...]
    physical: tuple[ParameterBias, ...]
    warnings: tuple[Warning, ...]

    @property
    def cause(self) -> SuspectedBias:
        """Cause that explains most."""
        return self.causes[0]

    @property
    def share(self) -> float:
        """Share of the learner that the causes explain.

        Where each output has a cause, of what is learned of its own.
        """
        return explains(self.cause)

    def of(self, name: str) -> ParameterBias | None:
        """Return the bias of a parameter or physical parameter."""
        return next(
            (entry for entry in (*self.parameters, *self.physical) if entry.name == name), None
        )


def linearization_of(
    fit: Estimate, measure: Measure, physics: PhysicsMap | None = None
) -> MeasureLinearization:
    """Return the linearization of a fit for biases, under the measure that θ was split under."""
    weighed = weigh_problem(measure, fit.problem)
    learned = fit.model.learner_at(weighed.points.x) if fit.learns else None
    return MeasureLinearization(weighed, fit.problem, fit.theta, physics, learned, fit.model.shared)


def lagged_budget(
    fit: Estimate,
    suspects: Sequence[Suspect] = (),
    *,
    physics: PhysicsMap | None = None,
    measure: Measure | None = None,
) -> Budget | None:
    """Return `bias_budget` of a fit of difference equations."""
    if not fit.status.ok or fit.model.structure != "orthogonal":
        return None
    measure = Training() if measure is None else measure
    name = "training" if fit.measure is None else fit.measure.name
    if measure.name != name:
        raise InputError(
            f"`measure` is the {measure.name} measure, but θ was split under the {name} measure."
        )
    return budget_on(linearization_of(fit, measure, physics), fit, suspects)


def budget_on(
    linearization: MeasureLinearization, fit: Estimate, suspects: Sequence[Suspect]
) -> Budget | None:
    """Return the budget of a fit on a given linearization."""
    if (
        not linearization.problem.baseline.names
        or linearization.learned is None
        or not np.all(np.isfinite(linearization.learned))
    ):
        return None
    if fit.freedom < _FEWEST_LEFT:
        return None
    noise = fit.model.statistics.noise
    least = 0.0 if noise is None else _NOTHING**2 * np.diag(noise)
    something = np.mean(linearization.learned**2, axis=0) >= least
    found, nameless = _causes(linearization, suspects, something) if something.any() else ([], [])
    if not found:
        return None
    causes, moved = (
        tuple(cause for _, cause in found),
        np.array([_theta_shift(cause) for _, cause in found]),
    )
    bias, rest = (
        moved.sum(axis=0),
        [row for own, cause in found for row in left_over(own, cause, suspects)],
    )
    rest = np.array([*rest, *map(_theta_shift, nameless)])
    candidates = _candidates(found, bias, np.linalg.norm(rest, axis=0), suspects, fit)
    std = np.full(len(bias), np.nan) if fit.std is None else fit.std
    shifts = [_theta_shift(cause) for cause in nameless]
    other = np.linalg.norm(np.array(shifts), axis=0) if shifts else 0.0
    ends = hull(fit.theta, std, fit.freedom, candidates, other)
    names = linearization.problem.baseline.names
    parameters = parameter_biases(
        names, fit.theta, std, bias, ends, _owners(causes, moved), fit.freedom
    )
    rows, warnings = (), []
    if linearization.physics is not None:
        rows, warnings = _physical_rows(linearization, fit, candidates, moved, causes, other)
    raised = (
        _warning(own, cause, (*rows, *parameters), suspects, own is not linearization)
        for own, cause in found
    )
    raised = [warning for warning in raised if warning is not None]
    open_ones = [row.name for row in (*rows, *parameters) if not row.determined]
    if open_ones:
        own, cause = found[0]
        raised.append(undetermined_warning(open_ones, candidates, remedies(own, cause, open_ones)))
    return Budget(causes, parameters, rows, (*raised, *warnings))


def noise_share(linearization: MeasureLinearization, fit: Estimate) -> float:
    """Return ν, the share of noise in what the learner holds beside the physics.

    Noise takes σ² for each weight that the learner uses.
    """
    noise = fit.model.statistics.noise
    if noise is None:
        return 0.0
    unit = linearization.weighed.unit
    own = orthogonal_part(
        linearization.weighed.projection,
        times(unit, np.asarray(linearization.learned)),
        linearization.directions,
    )
    rows = np.ones((len(own), 1)) * np.sqrt(np.diag(noise))
    taken = (
        fit.effective_weights
        / linearization.problem.count
        * np.sum(times(unit, rows) ** 2)
        / own.shape[1]
    )
    return float(taken / max(np.sum(own**2), np.finfo(float).tiny))


def _candidates(
    found: Sequence[tuple[MeasureLinearization, SuspectedBias]],
    bias: Vector,
    rest: Vector,
    suspects: Sequence[Suspect],
    fit: Estimate,
) -> list[Candidate]:
    """Return the named causes and their rivals."""
    several = " and ".join(cause.suspect.name for _, cause in found)
    kept: list[Candidate] = [
        NamedCause(several, min(explains(cause) for _, cause in found), bias, rest=rest)
    ]
    for own, cause in found:
        others = (*_declared_causes(own, suspects), *_usual(own), *_families(own))
        others += own.table(
            saturations([entry.suspect for entry in others]), certify=False, every=False
        )
        likely = [
            Candidate(
                entry.suspect.name,
                explains(entry),
                _theta_shift(entry) + bias - _theta_shift(cause),
                entry.suspect in suspects,
            )
            for entry in others
            if entry.explained
            and (entry.suspect in suspects or (entry.cosine or 0.0) <= MOST_PHYSICS)
        ]  # fmt: skip
        kept += compatible(likely, noise_share(own, fit))
    return kept


def _physical_rows(
    linearization: MeasureLinearization,
    fit: Estimate,
    candidates: Sequence[Candidate],
    moved: Float[np.ndarray, "k n"],
    causes: Sequence[SuspectedBias],
    other: Vector | float,
) -> tuple[tuple[ParameterBias, ...], list[Warning]]:
    """Return the biases of the physical parameters: the hull over the causes that matter.

    Those are the causes that move any of them farthest.
    """
    assert linearization.physics is not None
    physical, slopes, bias = (
        fit.physical(linearization.physics),
        linearization.slopes,
        moved.sum(axis=0),
    )
    own = np.array([np.nan if s is None else s for s in physical.std])
    turned = (
        np.array([slopes[0][name] for name in physical.names])
        if slopes
        else np.zeros((0, len(bias)))
    )
    chosen = [candidates[0]]
    for row in turned:
        for sign in (-1.0, 1.0):
            wide = [
                sign * row @ c.moved + np.sqrt(np.sum((row * c.unsure) ** 2)) for c in candidates
            ]
            chosen.append(candidates[int(np.argmax(np.nan_to_num(wide, nan=-np.inf)))])
    ends, shifts = [], np.zeros(len(physical.names))
    for i, c in enumerate({id(c): c for c in chosen}.values()):
        spread = np.outer(c.unsure, c.unsure) + np.diag(np.zeros(len(bias)) + other) ** 2
        spread = spread + (0.0 if fit.covariance is None else fit.covariance)
        moves, limits = physical_with_bias(
            linearization, c.moved, fit.covariance, spread, fit.freedom
        )
        shifts = shifts if i else moves
        ends.append(limits)
    # NaN where one has none
    ends = np.stack([np.min(ends, axis=0)[:, 0], np.max(ends, axis=0)[:, 1]], axis=-1)
    owners = _owners(causes, moved @ turned.T) if slopes else []
    rows = parameter_biases(physical.names, physical.value, own, shifts, ends, owners, fit.freedom)
    return rows, _unbounded_warnings(physical.names, own, ends)


def _causes(
    linearization: MeasureLinearization,
    suspects: Sequence[Suspect],
    something: Bool[np.ndarray, "ny"],
) -> tuple[list[tuple[MeasureLinearization, SuspectedBias]], list[SuspectedBias]]:
    """Return the causes that explain the learner, each with its linearization.

    One cause explains all of it, or one cause each output's part.

    Args:
        something: whether anything is learned of an output.

    Returns:
        The causes; and of each output without one what explains most, where that is less than half.
    """
    whole, outputs = named_cause(linearization, suspects), linearization.problem.outputs
    found = [] if whole is None else [(linearization, whole)]
    if len(outputs) == 1 or (whole is not None and explains(whole) >= SURE_SHARE):
        return found, []
    each, nameless = [], []
    for i in np.flatnonzero(something):
        own = replace(
            linearization, learned=np.asarray(linearization.learned) * np.eye(len(outputs))[i]
        )
        cause = named_cause(own, suspects) or _most_likely_suspect(own, suspects)
        if cause is not None and explains(cause) < LEAST_SHARE:
            nameless.append(cause)
        elif cause is not None and cause.suspect.column_of(outputs) == i:
            each.append((own, cause))
    each.sort(
        key=lambda part: (
            -np.linalg.norm(times(linearization.weighed.unit, np.asarray(part[0].learned)))
        )
    )
    return each if len(each) > len(found) else found, nameless


def _owners(
    causes: Sequence[SuspectedBias], moved: Float[np.ndarray, "k n"]
) -> list[tuple[str, float]]:
    """Return for each parameter the cause that moves it most, and its share."""
    return [(causes[i].suspect.name, explains(causes[i])) for i in np.argmax(np.abs(moved), axis=0)]


def named_cause(
    linearization: MeasureLinearization, suspects: Sequence[Suspect], least: float = LEAST_SHARE
) -> SuspectedBias | None:
    """Return the cause that explains most of the learner, the declared ones first.

    None where that is less than `least`.

    Undeclared terms count only if the learner sees them: others are no likely cause.
    """
    for table, families in (
        (_declared_causes(linearization, suspects), ()),
        (_usual(linearization), _families(linearization)),
    ):
        best, other = (
            max(table, key=explains, default=None),
            max(families, key=explains, default=None),
        )
        if other is not None and (best is None or explains(best) < AS_MUCH * explains(other)):
            best = other
        if best is not None and explains(best) >= least:
            return best
    return None


def _most_likely_suspect(
    linearization: MeasureLinearization, suspects: Sequence[Suspect]
) -> SuspectedBias | None:
    """Return the suspect that explains most of the learner, however little, declared or not."""
    found = (*_declared_causes(linearization, suspects), *_usual(linearization))
    return max((entry for entry in found if entry.explained), key=explains, default=None)


def explains(entry: SuspectedBias | TermBias) -> float:
    """Return the share of the learner that an entry explains."""
    return entry.explained or 0.0


def _declared_causes(
    linearization: MeasureLinearization, suspects: Sequence[Suspect]
) -> tuple[SuspectedBias, ...]:
    return linearization.table(tuple(suspects), certify=False, every=False) if suspects else ()


def _usual(linearization: MeasureLinearization) -> tuple[SuspectedBias, ...]:
    terms = (*usual_suspects(linearization.problem), *usual_terms(linearization.problem))
    return tuple(
        entry
        for entry in linearization.table(terms, certify=False, every=False)
        if entry.seen is not False
    )


def _families(linearization: MeasureLinearization) -> tuple[SuspectedBias, ...]:
    """Return the biases by every member of the catalogue that the learner sees."""
    table = linearization.table(catalogue(linearization.problem), certify=False, every=False)
    return tuple(
        entry
        for entry in table
        if entry.seen is not False and (entry.cosine or 0.0) <= MOST_PHYSICS
    )


def rival_of(
    linearization: MeasureLinearization, cause: SuspectedBias, suspects: Sequence[Suspect]
) -> SuspectedBias | None:
    """Return a term that explains as much as a cause that no one declared, and moves θ elsewhere.

    None where there is none.

    An example is a dead zone and a saturation where the physics has a linear term: their sum is
    that term.
    """
    assert cause.explained
    if cause.suspect in suspects:
        return None
    usual = _usual(linearization)
    usual += linearization.table(
        saturations([entry.suspect for entry in usual]), certify=False, every=False
    )
    equal = [entry for entry in usual if explains(entry) >= AS_MUCH * cause.explained]
    to_coordinates, own = linearization.weighed.projection.to_coordinates, _theta_shift(cause)

    def separation(entry: SuspectedBias) -> float:
        return float(np.linalg.norm(to_coordinates @ (_theta_shift(entry) - own)))

    farthest = max(equal, key=separation, default=None)
    return (
        farthest
        if farthest and separation(farthest) > 0.5 * np.linalg.norm(to_coordinates @ own)
        else None
    )


def near_causes(
    linearization: MeasureLinearization, cause: SuspectedBias, suspects: Sequence[Suspect]
) -> list[SuspectedBias]:
    """Return the next best causes, one per variable, for a cause undeclared and unsure."""
    assert cause.explained
    if cause.suspect in suspects or cause.explained >= SURE_SHARE:
        return []
    others = [
        entry
        for entry in _usual(linearization)
        if entry.suspect != cause.suspect and entry.explained
    ]
    near = [entry for entry in others if explains(entry) >= _NEAR * cause.explained]
    best: dict[str, SuspectedBias] = {}
    for entry in sorted(near, key=explains, reverse=True):
        best.setdefault(entry.suspect.on or entry.suspect.expression, entry)
    return list(best.values())[:_MOST_RIVALS]


def left_over(
    linearization: MeasureLinearization, cause: SuspectedBias, suspects: Sequence[Suspect]
) -> Float[np.ndarray, "k nt"]:
    """Return the standard deviations of the bias of θ that the cause leaves open.

    They are k directions, each of one unknown size.

    The unexplained part of the learner is assumed to be as biased for its size as the cause, with
    unknown sign; the next best cause adds its own bias. Rivals of the cause are in the hull.
    """
    assert cause.explained
    after = _most_likely_suspect(
        linearization.without(cause), [suspect for suspect in suspects if suspect != cause.suspect]
    )
    rows = [_theta_shift(cause) * np.sqrt((1 - cause.explained) / cause.explained)]
    return np.array([*rows, *([] if after is None else [_theta_shift(after)])])


def _theta_shift(cause: SuspectedBias) -> Vector:
    """Return θ moved by a cause of the size found."""
    return (cause.coefficient_found or 0.0) * np.array(cause.bias)


def parameter_biases(
    names: Sequence[str],
    value: Vector,
    std: Vector,
    bias: Vector,
    ends: Matrix,
    causes: Sequence[tuple[str, float]],
    freedom: float,
) -> tuple[ParameterBias, ...]:
    """Return a row for each parameter whose bias is known.

    `ends` are those of its interval, `causes` names and shares.
    """
    found = []
    for name, v, s, b, ci, (cause, share) in zip(
        names, value, std, bias, ends, causes, strict=True
    ):
        if np.isfinite(b):
            errors, relative = float(abs(b) / s) if s > 0 else None, float(b / v) if v else None
            limits = (float(ci[0]), float(ci[1])) if np.isfinite(ci).all() else None
            determined = limits is None or is_determined(float(v), float(s), freedom, *limits)
            found.append(
                ParameterBias(
                    name,
                    float(b),
                    cause,
                    share,
                    relative,
                    errors,
                    limits if determined else None,
                    determined,
                )
            )
    return tuple(found)


def _unbounded_warnings(names: Sequence[str], std: Vector, ends: Matrix) -> list[Warning]:
    """Return a warning where physical parameters have an interval but no bounded bias."""
    none = [
        name
        for name, s, e in zip(names, std, ends, strict=True)
        if np.isfinite(s) and not np.isfinite(e).all()
    ]
    if not none:
        return []
    text = (
        f"no interval of {', '.join(none)} includes the bias: some values of theta within the "
        "wider intervals"
    )
    return [Warning("physics_not_met", f"{text} correspond to no physical parameters.")]


def _warning(
    linearization: MeasureLinearization,
    cause: SuspectedBias,
    rows: Sequence[ParameterBias],
    suspects: Sequence[Suspect],
    of_one: bool,
) -> Warning | None:
    """Return the warning on biases above the standard error: cause, size and remedies.

    The warning also says how sure the cause is.
    """
    own, name = [row for row in rows if row.cause == cause.suspect.name], cause.suspect.name
    large = [row for row in own if (row.errors or 0.0) > 1 and abs(row.relative or 1.0) > _ROUNDING]
    if not large:
        return None
    listed, share, there = (
        list_biases(large),
        explains(cause),
        f" in {cause.suspect.output}" if of_one else "",
    )
    rival, cure = (
        rival_of(linearization, cause, suspects),
        " or ".join(remedies(linearization, cause, [row.name for row in large])),
    )
    other = (
        ""
        if rival is None
        else f" ({rival.suspect.name} explains as much and would imply other values)"
    )
    if share < SURE_SHARE:
        near = near_causes(linearization, cause, suspects)
        close = ", ".join(f"{entry.suspect.name} {percent(explains(entry))}" for entry in near)
        beside = f"; next: {close}" if near else ""
        return Warning(
            "biased",
            f"what the learner found{there} looks most like {name} ({percent(share)} of "
            f"it{beside}). This term would move {listed}; the standard errors do not cover "
            f"this bias{other}{f'. If this term is the cause: {cure}' if cure else ''}.",
        )
    return Warning(
        "biased",
        f"{name} explains {100 * share:.0f} % of the learner{there} and moves {listed}. The "
        f"standard errors do not cover this bias{other}{f'. Remedy: {cure}' if cure else ''}.",
    )


def list_biases(large: Sequence[ParameterBias]) -> str:
    """Return the largest biases in words."""
    shown = sorted(large, key=lambda entry: -(entry.errors or 0.0))[:_LISTED]
    more = f" and {len(large) - len(shown)} more" if len(large) > len(shown) else ""
    return f"{', '.join(map(_describe_bias, shown))}{more}"


def _describe_bias(entry: ParameterBias) -> str:
    share = "" if entry.relative is None else f", {percent(entry.relative, sign='+')}"
    return (
        f"{entry.name} by {entry.value:+.2g} ({plain_number(entry.errors or 0.0)} standard "
        f"errors{share})"
    )
