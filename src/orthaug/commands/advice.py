"""Tested advice: changes of a spec, each refitted and judged by its free run on data not fitted.

The present model and every change of it are fitted to the same rows and run over the same others:
the validation part, or the last third of the training rows as one long run. A change is advised
where it lowers the error there significantly, by the rule that compares all models (`Ratio`). A few
changes are tried, the same on every machine; the others are only counted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from orthaug._base.checks import Vector
from orthaug._base.errors import InputError
from orthaug._base.lines import first_words, join_words, plural
from orthaug._base.parallel import iterate_results, run_all
from orthaug._base.progress import LOG, Stage
from orthaug.analysis.findings import AdviceResult, AdviceTrialsResult
from orthaug.commands.job import PHYSICS_ONLY, Job, Variant
from orthaug.commands.proposals import (
    IN_PLACE,
    Proposal,
    changed_job,
    mending_proposals,
    noise_model_proposals,
    proposals,
)
from orthaug.data.preparation import prepare
from orthaug.data.record import Record
from orthaug.fitting.held_out import (
    WORTH,
    Pieces,
    Ratio,
    held_out_blocks,
    mean_square,
    squared_errors,
)
from orthaug.reports.page_verdict import is_biased_by_feedback
from orthaug.reports.result import FitResult

if TYPE_CHECKING:
    from orthaug.fitting.estimates import Estimate

# Errors over the output's deviation: of a run that says nothing, and of one that leaves the output
_FOLLOWS = (
    0.5  # of the deviation: the parameters of a fit with a larger error are no start of others
)
_NO_BETTER, _RUNS_AWAY = (0.95, 3.0)
_MUCH_LOWER = 0.9  # of the present error: a gain that asks why it is not sure
_TAMED = 0.1  # of the error of a run that runs away, above which one still runs away
_PIECES = 3  # of the training rows, the last of which is held out where there is no validation part
_SAME = 1e-6  # relative: two terms of one error span the same, as a dead zone and a limit
_FAR_OFF = 8.0  # times the fit's own error: what a refit does not reach is no basis for trials
_LARGE_GAIN = 3.0  # times the error: what lowers it by more may only have led to other values
_HALVED = 0.5  # of the error: a gain that slow errors do not give
_ALIKE = 0.95  # of an error: a change that makes a model no larger is named first above
_AS_GOOD = 1.05  # of the error: up to here a term takes the place of a learner
_LOOP_FIRST = (
    "First mend the feedback, as its warning says: disturbances that are fed back leave errors "
    "like those of a missing term. "
)
_IF_LEFT = "If errors remain without it"
_CHANCE = (
    " It may be chance: the errors remember each other over much of the record, so that few are "
    "independent."
)
_NONE_TRIED = AdviceTrialsResult(text="No change of the spec was tried.", tried=0, not_tried=0)
_LISTED = 3  # changes without gain that the text names
_NOT_TO_BE_MADE = "Do not make a change that is surely worse, even where a text above advises it."


@dataclass(frozen=True, eq=False)
class ValidationRows:
    """The rows that models are fitted to, and those on which their free runs are judged."""

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
            return cls(
                job.train.record,
                job.validation.record,
                job.validation.skips,
                "the validation part",
                "",
            )
        training, held = held_out_blocks(job.train.record, _PIECES, job.first_row)[-1]
        return cls(training, held, 0, "rows held out", " (the last third of the training data)")

    def prepared(self, step: Any, missing: str) -> ValidationRows:
        """Return the rows after a further step of preparation; what is `missing` as in a spec.

        Raises:
            InputError: it cannot be done with these rows.
        """
        kept = "keep" if missing == "keep" else "skip"
        training, held = (
            prepare(record, step, missing=kept) for record in (self.training, self.held)
        )
        return replace(self, training=training, held=held)


@dataclass(frozen=True, eq=False)
class ProposalErrors:
    """A proposal with the errors of its free run; `pieces` is None where its fit failed."""

    proposal: Proposal
    pieces: Pieces | None
    base: Pieces | None = None
    """The present model's errors on the same samples, where the proposal leaves some out."""
    initials: dict[str, Any] = field(default_factory=dict)
    """The change of the unchanged spec by which its parameters begin where this fit ended."""

    @property
    def error(self) -> float:
        """RMS error in standard deviations of the training output."""
        return math.inf if self.pieces is None else math.sqrt(mean_square(self.pieces))


@dataclass(frozen=True, eq=False)
class Trials:
    """Fits of changed specs, which begin where a fit ended that follows the record."""

    job: Job
    rows: ValidationRows
    variant: Variant
    unit: Any
    settled: dict[str, Any]
    """What the fit has found, as a change of the spec: a search would cost most."""

    def run(
        self,
        job: Job,
        variant: Variant,
        accepts: Callable[[Any], bool] = lambda fit: True,
        step: Any = None,
        *,
        mends: bool = False,
    ) -> tuple[Pieces, Any] | None:
        """Return the squared errors of the free run of a job's model, and its fit.

        None where training failed, or the fit is not accepted.

        Args:
            step: of preparation, which its rows still lack.
            mends: judge the model with the step, but train it without.
        """
        try:
            rows = self.rows if step is None else self.rows.prepared(step, job.spec.data.missing)
            training = self.rows.training if mends else rows.training
            fit = job.fold_fit(variant, briefly=True)(training)
            if not fit.status.ok or not accepts(fit):
                return None
            return squared_errors(fit.model.simulate(rows.held), self.unit, rows.skips), fit
        except InputError as error:
            LOG.info("a change was not tried: %s", error)
            return None

    def of(self, proposal: Proposal) -> ProposalErrors:
        """Return the trial of a proposal."""
        Stage.ADVICE.enter(proposal.words)
        try:
            job = changed_job(self.job, self.settled | proposal.change)
        except (InputError, ValueError) as error:
            LOG.info("%s was not tried: %s", proposal.words, error)
            return ProposalErrors(proposal, None)
        criterion = job.spec.declared_criterion() if proposal.refocuses else self.variant.criterion
        kind = None if proposal.learns else self.variant.kind
        made = self.run(job, Variant(kind, criterion=criterion), proposal.accepts, proposal.step)
        if made is None:
            return ProposalErrors(proposal, None)
        initials = self.job.physics.with_initials(self.job, made[1])
        base = None
        if proposal.mends:
            mended = self.run(job, self.variant, step=proposal.step, mends=True)
            base = mended and mended[0]
        return ProposalErrors(proposal, made[0], base, initials)

    def errors_of(self, proposal: Proposal, _: object) -> ProposalErrors:
        """Return the trial of a proposal, for a runner of several."""
        return self.of(proposal)

    def restarted(self, base: Pieces, tried: list[ProposalErrors]) -> list[ProposalErrors]:
        """Return the trials, less those that only led the unchanged spec to a better solution.

        A change with a large gain may owe it to other values of the parameters that both have: the
        unchanged spec is trained once more from these, and takes the place of what gains no more.
        """
        before = math.sqrt(mean_square(base))
        fitted = [one for one in tried if one.pieces and one.initials and one.proposal.step is None]
        best = min(fitted, key=lambda one: one.error, default=None)
        if best is None or not before > _LARGE_GAIN * best.error:
            return tried
        listed = join_words(
            [f"{key.split('.')[-2]} = {value:.4g}" for key, value in best.initials.items()]
        )
        words = f"the initial values {listed}"
        again = self.of(Proposal(words, best.initials, restarts=True))
        own = again.pieces
        if own is None or not again.error < (min(before, _NO_BETTER) + best.error) / 2:
            return tried
        if _ratio(again, base).code != "helps":
            return tried
        more = [one for one in tried if one.pieces and _ratio(one, own).code == "helps"]
        return [again, *more]


def advise(
    job: Job, fit: Estimate, result: FitResult
) -> tuple[list[AdviceResult], AdviceTrialsResult] | None:
    """Return the changes that lower the free run's validation error, and a count of all trials.

    None where nothing is proposed, or nothing can be tried.
    """
    if job.train.source is not None or job.spec.engine.kind not in ("auto", "memory"):
        return None
    mending, found = mending_proposals(job, result, fit), proposals(job, result, fit)
    untried = [proposal for proposal in mending if proposal.untried]
    first = untried or noise_model_proposals(fit, result)
    others = None if untried else _tried(job, fit, result, mending, found)
    if not first:
        return others
    advice, trials = others or ([], _NONE_TRIED)
    return [*map(_untried, first), *advice], trials


def _tried(
    job: Job, fit: Any, result: FitResult, mending: list[Proposal], found: list[Proposal]
) -> tuple[list[AdviceResult], AdviceTrialsResult] | None:
    """Return the changes that lower the error in a trial, and a count; as `advise`."""
    if not mending and not found:
        return None
    if any(warning.code == "unstable_plant" for warning in result.warnings):
        text = "No change of the spec was tried: no free run of an unstable plant follows a record."
        return [], AdviceTrialsResult(text=text, tried=0, not_tried=len(mending) + len(found))
    try:
        rows = ValidationRows.of(job)
    except InputError:
        return None
    learns = fit.learns
    variant = Variant(None if learns else PHYSICS_ONLY, criterion=fit.criterion)
    own = squared_errors(fit.model.simulate(rows.held), fit.problem.deviation, rows.skips)
    here, starts = math.sqrt(mean_square(own)), [job.physics.settled(fit)]
    if here < _FOLLOWS:
        starts.insert(0, starts[0] | job.physics.with_initials(job, fit))

    # Where samples are to be mended, what seems missing may come from these: it is tried after them
    narrow = [proposal for proposal in found if proposal.narrows]
    replacing = [proposal for proposal in found if proposal.replaces]
    others = [proposal for proposal in found if not (proposal.narrows or proposal.replaces)]
    chosen = [*narrow, *replacing, *others[: job.physics.most_trials]]
    listed = [Proposal("the spec as it is", {}), *(mending or chosen)]
    for settled in starts:  # values that a fit ended at may be none that a spec can begin at
        trials = Trials(job, rows, variant, fit.problem.deviation, settled)
        runs = iterate_results(trials.errors_of, listed)
        base = next(runs).pieces
        if base is not None:
            break
    else:
        return None
    before = math.sqrt(mean_square(base))
    far_off = before > _FAR_OFF * here
    if far_off:  # which a learner that sees less may mend
        narrow = [] if mending else narrow
        tried = [next(runs) for _ in narrow]
        if not any(one.error <= _FAR_OFF * here and _helps(one, base) for one in tried):
            share = f"has an error of {before:.3g} of the output's deviation"
            does = "diverges" if math.isinf(before) else share
            words = [f"{one.proposal.words} ({_error_text(one, base)})" for one in tried]
            text = f"No sure gain over {_error(before)}: {'; '.join(words)}. " if tried else ""
            text += (
                f"No {'further ' if tried else ''}change of the spec was tried: fitted to fewer "
                f"rows, the model {does} in free run over {rows.where}, where the error of this "
                f"one is {_error(here)}. The rows before do not determine it, so a comparison "
                "there would say little."
            )
            left = len(mending) + len(found) - len(tried)
            return [], AdviceTrialsResult(text=text, tried=len(tried), not_tried=left)
        chosen = narrow
    else:
        tried = list(runs)
    if mending and any(_helps(one, base) for one in tried):
        chosen = []
    elif mending:
        tried += run_all(trials.errors_of, chosen)
    tried = trials.restarted(base, tried)
    slow = result.standard_errors_by == "autoregressive" or any(
        warning.code == "too_long_memory" for warning in result.warnings
    )
    looped = is_biased_by_feedback(result)
    left = len(found) - len(chosen)
    shared = [row.name for row in result.parameters if row.shared]
    return _conclude_trials(base, tried, rows, left, learns, slow=slow, looped=looped, freed=shared)


def _untried(one: Proposal) -> AdviceResult:
    """Return a change that comes before all others but cannot be tried."""
    text = f"Fit with {one.words}. {one.untried}"
    return AdviceResult(change=one.change, text=text, before=None, after=None)


def _conclude_trials(
    base: Pieces,
    tried: Sequence[ProposalErrors],
    rows: ValidationRows,
    left: int,
    learns: bool,
    *,
    slow: bool,
    looped: bool = False,
    freed: Sequence[str] = (),
) -> tuple[list[AdviceResult], AdviceTrialsResult]:
    """Return the changes that help, and a text on all that were tried.

    Args:
        freed: the parameters that no learner imitates where there is none.
        slow: whether errors remember each other for so long that few of them are independent.
        looped: whether feedback biases the fit, and what it seems to lack with it.
    """
    before = math.sqrt(mean_square(base))
    helps = [one for one in tried if _helps(one, base)]
    better: list[ProposalErrors] = []
    for one in _in_order(helps):
        if not any(math.isclose(one.error, other.error, rel_tol=_SAME) for other in better):
            better.append(one)
    advice = [
        AdviceResult(
            change=one.proposal.change,
            text=_advice_text(one, _before(one, base), rows, looped=looped)
            + (_freed_text(freed) if one.proposal.replaces else "")
            + (_CHANCE if slow and one is better[0] and _may_be_chance(one, before) else ""),
            before=_before(one, base),
            after=one.error,
        )
        for one in better
    ]
    worse = [one for one in tried if one not in helps]
    as_good = sum(_is_as_good(one, before) for one in helps)
    text = (
        f"Tried by a refit of {'physics and learner' if learns else 'the physics'} and a free "
        f"run over {rows.where}"
    )
    text += (
        f"{rows.which}: {plural(len(tried), 'change')} of the spec, "
        f"{_relative_clause(len(helps) - as_good, len(tried))}"
    )
    text += (
        f", and {'which ' if len(tried) == 1 else 'one '}is as good without the learner."
        if as_good
        else "."
    )
    if worse:
        replacing = [one.proposal.words for one in tried if one.proposal.replaces]
        words = [
            f"{one.proposal.words}"
            # The same term was tried in both ways
            f"{' beside the learner' if f'{one.proposal.words} {IN_PLACE}' in replacing else ''}"
            f" ({_error_text(one, base)})"
            for one in worse
        ]
        text += f" No sure gain over {_error(before)}: {first_words(words, _LISTED, '; ')}."
        if any(_hurts(one, base) for one in worse[:_LISTED]):
            text += f" {_NOT_TO_BE_MADE}"
    if left:
        text += (
            f" {plural(left, 'change')} {'was' if left == 1 else 'were'} not tried, to save time."
        )
    if looped and advice and advice[0].text.startswith(_IF_LEFT):
        first = advice[0].model_copy(update={"text": f"{_LOOP_FIRST}{advice[0].text}"})
        advice = [first, *advice[1:]]
    return advice, AdviceTrialsResult(text=text, tried=len(tried), not_tried=left)


def _relative_clause(better: int, tried: int) -> str:
    if tried == 1:
        return "which improves it" if better else "which does not surely improve it"
    return (
        "of which "
        f"{'none' if not better else 'one' if better == 1 else better} "
        f"{'improve' if better > 1 else 'improves' if better else 'surely improves'} it"
    )


def _is_as_good(one: ProposalErrors, before: float) -> bool:
    """Return whether a change that helps does not lower the error: it leaves out the learner."""
    return one.proposal.replaces and one.error >= before


def _before(one: ProposalErrors, base: Pieces) -> float:
    """Return the present model's error on the samples on which a change is judged."""
    return math.sqrt(mean_square(base if one.base is None else one.base))


def _helps(one: ProposalErrors, base: Pieces) -> bool:
    """Return whether a change surely lowers the error, to one that says something."""
    if one.pieces is None:
        return False
    before = _before(one, base)
    poor = before < _RUNS_AWAY  # then what stays no better than the mean is no remedy
    if one.error > _NO_BETTER and (poor or one.error > _TAMED * before):
        return False
    own = base if one.base is None else one.base
    if one.proposal.replaces and one.error <= _AS_GOOD * before:
        return _ratio(one, own).code != "hurts"
    return one.proposal.ahead is not None or _ratio(one, own).code == "helps"


def _in_order(helps: Sequence[ProposalErrors]) -> list[ProposalErrors]:
    """Return the changes that help, the best first.

    Where others are hardly worse, one that adds nothing to the model leads, and then the one that
    was proposed first: proposals are in the order of what the residual shows.
    """
    errors = [one.error * (_ALIKE if _adds_nothing(one) else 1.0) for one in helps]
    enough = (1 + WORTH) * min(errors, default=0.0)
    ranks = [
        (max(error, enough), not _adds_nothing(one))
        for one, error in zip(helps, errors, strict=True)
    ]
    return [helps[i] for i in sorted(range(len(helps)), key=ranks.__getitem__)]


def _adds_nothing(one: ProposalErrors) -> bool:
    """Return whether a change makes the model no larger."""
    return one.proposal.step is not None or one.proposal.replaces


def _ratio(one: ProposalErrors, base: Pieces) -> Ratio:
    """Return the ratio of errors to those of the present model, on the rows that both predict.

    With more lags the predictions begin later; with an input's values earlier they end earlier.
    """
    assert one.pieces is not None
    early = getattr(one.proposal.step, "samples", 0) < 0

    def cut(piece: Vector, rows: int) -> Vector:
        return piece[:rows] if early else piece[-rows:]

    both = [
        (a, b) if a is None or b is None else (cut(a, rows := min(len(a), len(b))), cut(b, rows))
        for a, b in zip(one.pieces, base, strict=True)
    ]
    return Ratio.of([a for a, _ in both], [b for _, b in both])


def _may_be_chance(one: ProposalErrors, before: float) -> bool:
    """Return whether a gain is so small that slow errors may give it."""
    gains = one.proposal.ahead is None and not _is_as_good(one, before)
    return gains and one.error > _HALVED * before


def _advice_text(one: ProposalErrors, before: float, rows: ValidationRows, *, looped: bool) -> str:
    begin = "Training ended beside a better solution. With" if one.proposal.restarts else "With"
    if looped and one.proposal.step is None and not one.proposal.restarts:
        begin = f"{_IF_LEFT}, with"
    text = f"{begin} {one.proposal.words} the free run on {rows.where}"
    if math.isinf(before):
        return (
            f"{text} no longer diverges: its error is {_error(one.error)} of the output's "
            "deviation."
        )
    if one.proposal.ahead is not None:
        declared, after = map(_error, one.proposal.ahead)
        return (
            f"With {one.proposal.words} what the past does not predict of the error of physics "
            f"alone falls from {declared} to {after} of the output's deviation. Beside slow "
            f"disturbances the free run hardly shows it: {_error(before)} before, "
            f"{_error(one.error)} after, on {rows.where}. Fit with it first: other causes show "
            "then."
        )
    if _is_as_good(one, before):
        return (
            f"{text} is as good: its error is {_error(one.error)} of the output's deviation, "
            f"before {_error(before)}."
        )
    return (
        f"{text} improves from {_error(before)} to {_error(one.error)} of the output's deviation."
    )


def _freed_text(names: Sequence[str]) -> str:
    """Return what a fit without a learner is good for, as a sentence."""
    if not names:
        return ""
    intervals = "its interval" if len(names) == 1 else "their intervals"
    return (
        f" No learner then imitates {join_words(names)}; other forms of a term that fit as well "
        f"count in {intervals}."
    )


def _hurts(one: ProposalErrors, base: Pieces) -> bool:
    """Return whether a change surely raises the error."""
    return one.pieces is not None and (
        _ratio(one, base if one.base is None else one.base).code == "hurts"
    )


def _error_text(one: ProposalErrors, base: Pieces) -> str:
    """Return the error of a change without sure gain, and why a much lower one is not sure."""
    if one.pieces is None:
        return "no fit"
    if math.isinf(one.error):
        return "diverges"
    if _hurts(one, base):
        return f"{_error(one.error)}, surely worse"
    lower = one.error < _MUCH_LOWER * _before(one, base) and one.error <= _NO_BETTER
    return _error(one.error) + (", lower, but not surely on other rows" if lower else "")


def _error(value: float) -> str:
    return "a run that diverges" if math.isinf(value) else f"{value:.3g}"
