"""Advice that was tried: changes of a spec, each refitted, and what it does to the free run where nothing was fitted.

The model as it is and every change of it are fitted to the same rows and run over the same others: the validation part,
or the last third of the training rows as one long run. A change is advised where it lowers the error there surely, by
the rule that all models are compared by (`Ratio`). A few changes are tried, the same on every machine; the rest is
counted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

from orthaug._base.errors import InputError
from orthaug._base.lines import counted
from orthaug._base.progress import LOG
from orthaug.commands.job import ALONE, Job, Variant
from orthaug.commands.proposals import Proposal, proposals
from orthaug.commands.spec import spec_model
from orthaug.data.record import Record
from orthaug.fitting.held_out import Pieces, Ratio, blocked, mean_square, squared_errors
from orthaug.reports.findings import AdviceResult, AdviceTrialsResult
from orthaug.reports.result import FitResult

_PIECES = 3  # of the training rows, the last of which is held out where there is no validation part
_MOST, _MOST_OF_A_MOTION = 3, 2  # changes that are tried: together they take about as long as the fit
_SAME = 1e-6  # relative: two terms of one error span the same beside the physics, as a dead zone and a limit
_LISTED = 3  # changes without gain that the text names


@dataclass(frozen=True, eq=False)
class ValidationRows:
    """The rows that models are fitted to, and those that they run over."""

    training: Record
    held: Record
    skips: Any
    where: str
    which: str

    @classmethod
    def of(cls, job: Job) -> ValidationRows:
        """Return the validation part of a job, or the last third of its training rows.

        Raises:
            InputError: too few rows.
        """
        if job.validation is not None:
            return cls(job.train.record, job.validation.record, job.validation.skips, "the validation part", "")
        training, held = blocked(job.train.record, _PIECES, job.first_row)[-1]
        return cls(training, held, 0, "rows held out", " (the last third of the training data)")


@dataclass(frozen=True, eq=False)
class ProposalErrors:
    """A proposal with the errors of its free run; `pieces` is None where it could not be fitted."""

    proposal: Proposal
    pieces: Pieces | None
    physics_only: bool = False

    @property
    def error(self) -> float:
        """RMS error in standard deviations of the training output."""
        return math.inf if self.pieces is None else math.sqrt(mean_square(self.pieces))


@dataclass(frozen=True, eq=False)
class Trials:
    """Fits of changed specs."""

    job: Job
    rows: ValidationRows
    variant: Variant
    unit: Any
    substeps: int | None = None
    """Of a motion that is integrated."""

    def changed(self, change: dict[str, Any]) -> Job:
        """Return the job of a changed spec, with the substeps of the fit: looking for them would cost most.

        Raises:
            InputError: the change is not possible; ValueError likewise.
        """
        fixed = {} if self.substeps is None else {"motion.substeps": self.substeps}
        return self.job.changed(spec_model().model_validate(changed(self.job.declaration, change | fixed)))

    def run(self, job: Job, variant: Variant, accepts: Callable[[Any], bool] = lambda fit: True) -> Pieces | None:
        """Squared errors of the free run of a job's model; None where there is none, or it is not accepted."""
        try:
            fit = job.fold_fit(variant)(self.rows.training)
            if not fit.status.ok or not accepts(fit):
                return None
            return squared_errors(fit.model.simulate(self.rows.held), self.unit, self.rows.skips)
        except InputError as error:
            LOG.info("a change was not tried: %s", error)
            return None

    def of(self, proposal: Proposal, *, physics_only: bool) -> ProposalErrors:
        """The trial of a proposal."""
        try:
            job = self.changed(proposal.change)
        except (InputError, ValueError) as error:
            LOG.info("%s was not tried: %s", proposal.words, error)
            return ProposalErrors(proposal, None)
        criterion = job.spec.declared_criterion() if proposal.refocuses else self.variant.criterion
        kind = ALONE if physics_only else None if proposal.learns else self.variant.kind
        pieces = self.run(job, Variant(kind, criterion=criterion), proposal.accepts)
        return ProposalErrors(proposal, pieces, physics_only)


def changed(declaration: dict[str, Any], change: dict[str, Any]) -> dict[str, Any]:
    """Return a declaration with the values of a change at their keys, dots between the parts of a key."""
    found = deepcopy(declaration)
    for key, value in change.items():
        *path, last = key.split(".")
        place = found
        for part in path:
            place = place.setdefault(part, {})
            if not isinstance(place, dict):
                raise InputError(f"'{key}': '{part}' is no table.")
        place[last] = value
    return found


def advise(job: Job, fit: Any, result: FitResult) -> tuple[list[AdviceResult], AdviceTrialsResult] | None:
    """Return the changes that better the free run where nothing was fitted, and an account of all trials.

    None where nothing is proposed, or nothing can be tried.
    """
    found = proposals(job, result, fit)
    if not found or job.train.source is not None or job.spec.engine.kind not in ("auto", "memory"):
        return None
    try:
        rows = ValidationRows.of(job)
    except InputError:
        return None
    learns = fit.model.form.bound is not None
    variant = Variant(None if learns else ALONE, criterion=fit.criterion)
    motion = result.motion
    substeps = None if motion is None or motion.integrator == "discrete" else motion.substeps
    trials = Trials(job, rows, variant, fit.problem.deviation, substeps)
    base = trials.run(trials.changed({}), variant)
    if base is None:
        return None
    chosen = found[: _MOST if motion is None else _MOST_OF_A_MOTION]
    tried = [trials.of(proposal, physics_only=False) for proposal in chosen]
    return _concluded(base, tried, rows, len(found) - len(tried), learns)


def _concluded(
    base: Pieces, tried: Sequence[ProposalErrors], rows: ValidationRows, left: int, learns: bool
) -> tuple[list[AdviceResult], AdviceTrialsResult]:
    before = math.sqrt(mean_square(base))
    helps = [one for one in tried if one.pieces is not None and _ratio(one.pieces, base).code == "helps"]
    better: list[ProposalErrors] = []
    for one in sorted(helps, key=lambda one: one.error):
        if not any(math.isclose(one.error, other.error, rel_tol=_SAME) for other in better):
            better.append(one)
    advice = [
        AdviceResult(change=one.proposal.change, text=_advice_text(one, before, rows), before=before, after=one.error)
        for one in better
    ]
    worse = [one for one in tried if one not in helps]
    text = f"Tried by a refit of {'physics and learner' if learns else 'the physics'} and a free run over {rows.where}"
    text += f"{rows.which}: {counted(len(tried), 'change')} of the spec, {_which(len(helps), len(tried))}."
    if worse:
        named = "; ".join(f"{one.proposal.words} ({_after(one)})" for one in worse[:_LISTED])
        more = f" and {len(worse) - _LISTED} more" if len(worse) > _LISTED else ""
        text += f" No gain from {_error(before)}: {named}{more}."
    if left:
        text += f" {counted(left, 'change')} {'was' if left == 1 else 'were'} not tried, to spare time."
    return advice, AdviceTrialsResult(text=text, tried=len(tried), not_tried=left)


def _which(better: int, tried: int) -> str:
    if tried == 1:
        return "which betters it" if better else "which does not better it"
    return f"of which {'none betters' if not better else 'one betters' if better == 1 else f'{better} better'} it"


def _ratio(pieces: Pieces, base: Pieces) -> Ratio:
    """Errors against those of the model as it is, on the rows that both have: more lags begin later."""
    cut = [
        (a, b) if a is None or b is None else (a[-min(len(a), len(b)) :], b[-min(len(a), len(b)) :])
        for a, b in zip(pieces, base, strict=True)
    ]
    return Ratio.of([a for a, _ in cut], [b for _, b in cut])


def _advice_text(one: ProposalErrors, before: float, rows: ValidationRows) -> str:
    alone = " of physics alone" if one.physics_only else ""
    text = f"With {one.proposal.words} the free run{alone} on {rows.where}"
    if math.isinf(before):
        return f"{text} no longer diverges: its error is {_error(one.error)} of the output's deviation."
    return f"{text} improves from {_error(before)} to {_error(one.error)} of the output's deviation."


def _after(one: ProposalErrors) -> str:
    return "no fit" if one.pieces is None else "diverges" if math.isinf(one.error) else _error(one.error)


def _error(value: float) -> str:
    return "a run that diverges" if math.isinf(value) else f"{value:.3g}"
