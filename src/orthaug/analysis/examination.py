"""The examination of a fit: scored on every part of its data, and everything found on it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any, TypeVar

import numpy as np

from orthaug._base.errors import InputError, Warning
from orthaug._base.progress import Stage
from orthaug.analysis.attempt import attempt
from orthaug.analysis.budget import Budget
from orthaug.analysis.closed_loop import closed_loop, without_exchanged
from orthaug.analysis.diagnosis import diagnose
from orthaug.analysis.doubts import doubt
from orthaug.analysis.equation_units import equation_units
from orthaug.analysis.evidence import Evidence
from orthaug.analysis.fit_findings import Findings, ParameterResult, PartScores, parameter_rows
from orthaug.analysis.informative_data import explains_nothing, few_frequencies
from orthaug.analysis.physics_findings import analyse_physics, describe_physics, imitable
from orthaug.analysis.robustness import beside_plain, robust_where_asked
from orthaug.analysis.scoring import score_part
from orthaug.analysis.trained_start import from_trained_start, local_minimum_of_start
from orthaug.analysis.validation import (
    Trial,
    Verdict,
    block_trials,
    cross_validate,
    extrapolation,
    judge,
    score_trial,
    trials_of,
)
from orthaug.data.gaps import saturated_outputs
from orthaug.data.preparation import of_free_run
from orthaug.data.record import Record
from orthaug.data.scales import describe_scales
from orthaug.fitting.criteria import Prediction
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.estimation import fit as train
from orthaug.fitting.held_out import covered_folds
from orthaug.fitting.status import Status
from orthaug.inference.learned_terms import equation, learned_terms
from orthaug.inference.over_experiments import differing_warning
from orthaug.models.response import Response

_FINDINGS = (
    "physical_parameters",
    "physical_consistency",
    "sensitivities",
    "bias",
    "residuals",
    "missing_lags",
    "stability",
    "measure_detail",
)
_OF_UNSTABLE = ("free_run_diverges", "growing_mode")  # what `unstable_plant` says better
_NO_NOISE = 0.9  # of an error that follows from its own past: the output moves by more than noise


@dataclass(frozen=True, eq=False)
class Examination:
    """A fit with the standard errors that its residual calls for, and what was found on it."""

    fit: Estimate
    evidence: Evidence
    result: Findings
    responses: Mapping[str, tuple[Response, Response]]
    """One-step prediction and free run of every part, by its name; none where training failed."""
    alone: Mapping[str, tuple[Response, Response]] = field(default_factory=dict)
    """The responses of physics alone, where that was fitted too."""

    @property
    def findings(self) -> Findings:
        """The findings, which can show themselves with their fit."""
        return self.result.about(self.fit)


E = TypeVar("E", bound=Examination)


def examine(fit: Estimate, evidence: Evidence) -> Examination:
    """Return everything that is found on a fit: scores, verdict on the learner, doubts."""
    return doubt(with_verdict(score_and_analyse(fit, evidence)))


def score_and_analyse(fit: Estimate, evidence: Evidence) -> Examination:
    """Return a fit scored on every part, with the findings on it but verdict and doubts."""
    Stage.SCORES.enter()
    known, record = evidence.warnings, fit.problem.record
    if not fit.criterion.one_step:
        known = of_free_run(known, record.prepared, [channel.name for channel in record.channels])
    own = (warning for warning in fit.warnings if warning.code != "coloured_residual")
    warnings: list[Warning] = [*known, *own]
    scores, responses = {}, {}
    if fit.status.ok:
        for part in evidence.parts:
            scores[part.name], responses[part.name] = score_part(
                fit.model, part, warnings, whole=part is evidence.train
            )
    if fit.status.ok:
        described = _limits_described(evidence.train.record, responses[evidence.train.name][1])
        warnings = [warning for warning in warnings if warning not in described]
    physics, alone, ran = fit.physics_alone, {}, {}
    if physics is not None and physics.status.ok:
        ran = {
            part.name: score_part(physics.model, part, [], whole=part is evidence.train)
            for part in evidence.parts
        }
        alone = {name: scored for name, (scored, _) in ran.items()}
    one_step = isinstance(evidence.criterion, Prediction) or fit.model.coloured
    if fit.status.ok and one_step and fit.learns:
        chosen_by = [p.name for p in evidence.parts if not p.name.startswith("tests.")]
        warnings += _one_step_only(scores, alone, chosen_by)
    Stage.INTERVALS.enter()
    fit, fields = _analyse(fit, evidence, responses, warnings)
    if fit.status.ok and not one_step:
        run, estimated = responses[evidence.train.name][1], len(fit.problem.names)
        residuals = fields["residuals"]
        driven = residuals is not None and (
            residuals.verdict == "unmodelled"
            or any(one.own_past > _NO_NOISE for one in residuals.predictable)
        )
        alone_model = fit.model if physics is None else physics.model
        trained = fit.criterion.free_run
        judged = partial(
            explains_nothing,
            part=evidence.train,
            parameters=estimated,
            driven=driven,
            physics=alone_model,
            steps=None if trained is None else trained.steps,
        )
        other = from_trained_start(fit, run) if judged(run) else None
        warnings += judged(run if other is None else other[0].response)
        warnings += attempt(
            "the search for a poor start",
            lambda: _poor_start(fit, evidence, responses, scores),
            warnings,
            [],
        )
    if any(warning.code == "unstable_plant" for warning in warnings):
        warnings[:] = [warning for warning in warnings if warning.code not in _OF_UNSTABLE]
    if fit.status.ok and fields["residuals"] is not None:
        fit = _for_observers(fit, fields["residuals"].verdict, warnings)
    content = fields | {
        "status": _status(fit, warnings),
        "restarts": fit.restarts,
        "structure": fit.model.structure,
        "measure": fit.model.measure if fit.model.structure == "orthogonal" else None,
        "orthogonality_defect": fit.defect,
        "output_weights": None if fit.problem.weight.one_output else fit.problem.weight.as_dict(),
        "scores": scores,
        "focus": fit.focus,
        "physics_alone": {"scores": alone} if alone else None,
        "validation": None,
        "warnings": warnings,
    }
    content |= _of_learner(fit, evidence, warnings) if fit.status.ok else {}
    result = Findings.model_validate(content)
    return Examination(
        fit, evidence, result, responses, {name: both for name, (_, both) in ran.items()}
    )


def _poor_start(
    fit: Estimate,
    evidence: Evidence,
    responses: Mapping[str, tuple[Response, Response]],
    scores: Mapping[str, PartScores],
) -> list[Warning]:
    """Return the warning that training ended at a poor start; none without data held out."""
    held_out = {name: own for name, own in scores.items() if name != evidence.train.name}
    if evidence.train.source is not None or not held_out:
        return []
    ahead, run = responses[evidence.train.name]
    found = local_minimum_of_start(fit, ahead, run, held_out)
    other = from_trained_start(fit, run) if found else None  # a run more, for few fits
    return local_minimum_of_start(fit, ahead, other[0].response, held_out) if other else found


def _limits_described(record: Record, free_run: Response) -> list[Warning]:
    """Return the warnings on limits of outputs that the free run reaches as the data do."""
    if not record.complete or len(free_run.model) != len(record):
        return []
    left = saturated_outputs(record, free_run.model)
    return [one.warning for one in saturated_outputs(record) if one not in left]


def _analyse(
    fit: Estimate,
    evidence: Evidence,
    responses: Mapping[str, tuple[Response, Response]],
    warnings: list[Warning],
) -> tuple[Any, dict[str, Any]]:
    """Return the fit with its standard errors, and the findings of its analyses.

    Warnings are added.
    """
    fields: dict[str, Any] = dict.fromkeys(_FINDINGS) | describe_physics(fit)
    budget = None
    if fit.status.ok:
        plain, (one_step, free_run) = fit, responses[evidence.train.name]
        asked = "auto" if fit.setup is None else fit.setup.standard_errors
        fit = attempt(
            "the robust covariance",
            lambda: robust_where_asked(plain, one_step, ordered=asked != "unordered"),
            warnings,
            plain,
        )
        if asked == "plain":
            warnings += beside_plain(fit, plain)
            fit = plain
        # Wider errors may leave a parameter without an interval
        gone = [one for one in plain.warnings if one not in fit.warnings]
        warnings[:] = [one for one in warnings if one not in gone]
        warnings += [one for one in fit.warnings if one not in plain.warnings]
        if fit.std is not None:  # the robust ones need no covariance of the weights
            warnings[:] = [one for one in warnings if one.code != "no_standard_errors"]
        looped = closed_loop(evidence.train.record, evidence.method(fit.criterion))
        warnings[:] = [*without_exchanged(warnings, looped), *looped]
        warnings += equation_units(evidence.train.record, fit.problem.physics)
        warnings += few_frequencies(evidence.train.record, len(fit.problem.names))
        fields |= analyse_physics(fit, evidence, one_step, free_run, warnings)
        budget = fields.pop("budget")
    shared, of_shared = imitable(fit, evidence)
    warnings += of_shared
    split = fit.model.structure == "orthogonal" and fit.learns
    directions = shared if split else None  # of the others the split has no directions
    rows = _with_biases(
        _parameters(fit), directions and directions.determined, budget, held=fit.at_bound
    )
    physical = fields["physical_parameters"]
    if physical is not None:
        physical = _with_biases(physical, directions and directions.physical, budget)
    return fit, fields | {
        "parameters": rows,
        "physical_parameters": physical,
        "standard_errors": None
        if fit.std is None
        else "plain"
        if fit.plain_covariance is None
        else "robust",
        "standard_errors_by": None if fit.std_kind == "plain" else fit.std_kind,
        "excitation": fit.excitation,
        "shared": shared,
    }


def _parameters(fit: Estimate) -> list[ParameterResult]:
    """Return the parameters as results list them; without values where training failed."""
    problem = fit.problem
    values = fit.values if fit.status.ok else np.full(len(problem.names), np.nan)
    rows = parameter_rows(
        problem.parameters, values, fit.std, fit.interval, fit.one_step_theta, fit.plain_std
    )
    units = problem.derived_units
    return [
        row if row.unit else row.model_copy(update={"derived_unit": units.get(row.name)})
        for row in rows
    ]


def _with_biases(
    rows: Sequence[ParameterResult],
    determined: Sequence[str] | None,
    budget: Budget | None,
    held: Collection[str] = (),
) -> list[ParameterResult]:
    """Return the parameters, with whether the learner could imitate them and what biases them.

    Those `held` at a bound have none.
    """
    shared = [
        None if determined is None or row.name in held else row.name not in determined
        for row in rows
    ]
    biases = [budget.of(row.name) if budget and row.name not in held else None for row in rows]
    return [
        row.with_bias(imitated, bias)
        for row, imitated, bias in zip(rows, shared, biases, strict=True)
    ]


def _of_learner(fit: Estimate, evidence: Evidence, warnings: list[Warning]) -> dict[str, object]:
    """Return intervals over experiments, and the equations of a learner of terms."""
    over = attempt(
        "the errors over experiments",
        lambda: _over_experiments(fit, evidence, warnings),
        warnings,
        None,
    )
    content: dict[str, object] = {"over_experiments": over} if over else {}
    terms = learned_terms(fit.model)
    if terms:
        written = {writing: equation(fit.model, writing) for writing in ("text", "latex")}
        content |= {"terms": terms, "equation": written}
    return content


def _unexplained_warnings(fitted: Examination, physics: Callable[[], Any] | None) -> list[Warning]:
    """Return a warning where the learner may have taken an unknown share of a parameter.

    It could imitate these parameters, and no suspect explains what it found.

    Args:
        physics: the fit without the learner, where that does not help: it may still take up what
            physics alone leaves.
    """
    result = fitted.result
    rows = [*result.parameters, *(result.physical_parameters or ())]
    shared = [row.name for row in rows if row.shared]
    if not shared or any(row.bias for row in rows):
        return []
    text, failed = "no suspect explains half of what the learner found", []
    if physics is not None:
        if not result.residuals or result.residuals.verdict == "unmodelled":
            return []
        own = physics()
        alone = own.status.ok and attempt(
            "the residual of physics alone", lambda: diagnose(own), failed, None
        )
        if not alone or alone.verdict != "unmodelled":
            return failed
        text = (
            "physics alone leaves more than noise, which the learner takes up without "
            "improving the free run"
        )
    text += (
        f": a part of it may belong to {', '.join(shared)}, and no interval includes that "
        "part. Search for its terms with `orthaug explain`, or declare them in [[suspects]]. "
        "Another measure, or a learner with fewer inputs, may separate them."
    )
    return [Warning("unexplained", text)]


def _over_experiments(
    fit: Any, evidence: Evidence, warnings: list[Warning]
) -> dict[str, object] | None:
    """Return intervals for experiments like those fitted; None where these are too few.

    A warning is added where they differ by more than the fit's own intervals allow.
    """
    found = fit.over_experiments
    if found is None:
        return None
    names = fit.problem.names
    differing = differing_warning(found, names, fit.values)
    warnings.extend([] if differing is None else [differing])

    def rows(names: Sequence[str], std: Any, ci95: Any, ratio: Any) -> list[dict[str, Any]]:
        keys = ("name", "std", "ci95", "ratio")
        return [
            dict(zip(keys, row, strict=True)) for row in zip(names, std, ci95, ratio, strict=True)
        ]

    content = {
        "experiments": found.experiments,
        "parameters": rows(names, found.std, found.interval, found.ratio),
    }
    physics = evidence.map
    if physics is not None:
        own = fit.physical(physics)
        over = replace(fit, covariance=found.covariance, freedom=found.freedom).physical(physics)
        ratio = np.array(over.std, dtype=float) / np.array(own.std, dtype=float)
        content["physical_parameters"] = rows(over.names, over.std, over.ci95, ratio)
    return content


def _status(fit: Estimate, warnings: Sequence[Warning]) -> Status:
    """Return how training ended.

    For a model whose free run diverges, the message begins with that.
    """
    first = next((warning.text for warning in warnings if warning.code == "one_step_only"), "")
    last = "" if fit.status.ok else describe_scales(fit.problem.record)
    if not (first or last):
        return fit.status
    message = fit.status.message
    if last and message:
        last = f"{'' if message.endswith('.') else '.'} {last[0].upper()}{last[1:]}"
    return replace(fit.status, reason=f"{first} {message}{last}".strip())


def _one_step_only(
    scores: Mapping[str, PartScores], alone: Mapping[str, PartScores], parts: Sequence[str]
) -> list[Warning]:
    """Return a warning where a model trained one step ahead is of no use in free run.

    It diverges there, or physics alone is better; the user chose the criterion.
    """
    diverges = any(scores[part].simulation.nrmse is None for part in parts)
    worse = [
        bool(
            np.all(
                np.asarray(scores[part].simulation.nrmse) > np.asarray(alone[part].simulation.nrmse)
            )
        )
        for part in parts
        if part in alone
        and scores[part].simulation.nrmse is not None
        and alone[part].simulation.nrmse is not None
    ]
    if not diverges and not (worse and all(worse)):
        return []
    why = (
        "its free run diverges"
        if diverges
        else "physics alone follows the outputs better in free run"
    )
    text = (
        f'the model is for one-step prediction only: {why}. With `focus = "auto"`, the '
        "default, the free run is trained as well where one step ahead does not suffice."
    )
    return [Warning("one_step_only", text)]


def _for_observers(fit: Estimate, verdict: str, warnings: list[Warning]) -> Estimate:
    """Return the fit with a model that keeps what observers need.

    These are the verdict on the residual, and the two noises.
    """
    from orthaug.analysis.observer_noise import to_keep  # slow to import

    kept = replace(fit.model.statistics, verdict=verdict)
    noise = attempt("the noise of an observer", lambda: to_keep(fit, verdict), warnings, None)
    if noise is not None:
        kept = replace(kept, disturbance=np.asarray(noise.state), sensor=np.asarray(noise.output))
    return replace(fit, model=replace(fit.model, statistics=kept))


def with_verdict(made: E) -> E:
    """Return an examination with the verdict on the learner."""
    fit, evidence, warnings = made.fit, made.evidence, list(made.result.warnings)
    learns = fit.learns
    if not fit.status.ok or not (learns or fit.held_out is not None):
        return made
    Stage.VERDICT.enter()
    failed: list[Warning] = []
    physics = cache(partial(_physics_alone, fit))
    verdict = attempt(
        "the judgement of the learner",
        lambda: judge_fit(made, physics, alone=made.alone or None),
        failed,
        None,
    )
    warnings += failed
    asked = learns and evidence.blocks != 0
    if verdict is None and asked and not failed:
        short = "the training data have too few rows for cross-validation in so many blocks"
        why = "training was stopped too early for cross-validation" if was_stopped(fit) else short
        why = "nothing is known of how the model was trained" if fit.setup is None else why
        text = f"whether the learner helps is not judged: no part is held out, and {why}."
        warnings.append(Warning(code="not_judged", text=text))
    if verdict is not None and learns:
        text = (
            *verdict.warnings,
            *_unexplained_warnings(made, None if verdict.code == "helps" else physics),
        )
        warnings += text
    return replace(made, result=made.result.changed(validation=verdict, warnings=warnings))


def _physics_alone(fit: Estimate) -> Estimate:
    """Return the fit of physics alone that the learner is compared to.

    It is the one that was made already, or one by the same criterion.
    """
    if fit.physics_alone is not None:
        return fit.physics_alone
    if fit.setup is not None:
        return fit.setup.fit_physics(fit.criterion)
    return train(fit.problem.physics_alone(), learner=None, criterion=fit.criterion)


def judge_fit(
    made: Examination,
    physics: Callable[[], Any],
    blocks: Sequence[Trial] | None = None,
    alone: Mapping[str, tuple[Response, Response]] | None = None,
) -> Verdict | None:
    """Return whether the learner is useful: its free run against physics alone on data not fitted.

    Where the fit fell back to physics alone, the trials behind that choice decide.

    Args:
        physics: gives the fit of physics alone, where a part is held out.
        blocks: trials of blocked cross-validation; None for those by which the fit was chosen, or
            to make them, where there is no validation or test part or where they were asked for.
        alone: the responses of physics alone by part, where they are there already.
    """
    fit, evidence = made.fit, made.evidence
    model, chosen_by, simulated = fit.model, fit.held_out, fit.criterion.simulates
    if chosen_by is not None and not model.learns:
        return judge(trials_of(chosen_by)) if simulated else None
    validated = any(part.name == "validation" for part in evidence.parts)
    if blocks is None:
        wanted = evidence.wanted_blocks
        if wanted and simulated and chosen_by is not None and not validated:
            blocks = trials_of(chosen_by)
        else:
            blocks = (
                cross_validated(evidence, wanted, [fit])[0]
                if wanted and fit.setup is not None and not was_stopped(fit)
                else ()
            )
    trials, beyond = list(blocks), []
    for part in evidence.held_out:
        ran = None if alone is None else alone[part.name][1]
        response = made.responses[part.name][1]
        trials.append(
            score_trial(
                part.name,
                part.record,
                part.skips,
                physics().model,
                model,
                alone_response=ran,
                response=response,
            )
        )
        beyond += extrapolation(
            part.name, fit.reach(part.record), fit.reach(evidence.train.record), fit.layout
        )
    return judge(trials, beyond)


def was_stopped(fit: Estimate) -> bool:
    """Return whether training was asked to end early: then cross-validation is omitted too."""
    return any(warning.code == "stopped" for warning in fit.warnings)


def cross_validated(evidence: Evidence, blocks: int, fits: Sequence[Any]) -> list[list[Trial]]:
    """Return the trials of every fit on every block; none where the record is too short."""
    setup, criterion = fits[0].setup, fits[0].criterion
    folds = [
        setup.fold_fit(criterion, physics_only=True),
        *(fit.setup.fold_fit(fit.criterion) for fit in fits),
    ]
    record = evidence.train.record
    try:
        cut = covered_folds(record, blocks, evidence.problem.first_row, fits[0].model)
    except InputError:
        return [[] for _ in fits]
    errors = cross_validate(record, folds, folds=cut, runner=evidence.runner)
    return [block_trials(errors, 1 + j, cut.note) for j in range(len(fits))]
