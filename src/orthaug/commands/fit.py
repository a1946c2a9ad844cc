"""Fit of a spec: train a job, score and judge it, and write the folder with the result."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.errors import InputError, Warning
from orthaug._base.folders import whole_folder
from orthaug._base.parallel import one_blas_thread
from orthaug._base.progress import SILENT, Progress
from orthaug._base.views import MAKERS
from orthaug.commands import job_result
from orthaug.commands.attempt import attempt
from orthaug.commands.chosen_rows import after_choice
from orthaug.commands.doubts import with_doubts
from orthaug.commands.folder import PHYSICS
from orthaug.commands.job import AS_DECLARED, DEFAULT_BLOCKS, PHYSICS_ONLY, Job, Variant, origin_of
from orthaug.commands.parts import Part
from orthaug.commands.scales import describe_scales
from orthaug.inference.learned_terms import equation, learned_terms
from orthaug.reports.fields import WarningResult
from orthaug.reports.result import FitResult, PartScores, ScoreResult

if TYPE_CHECKING:
    from orthaug.analysis.validation import Trial, Verdict
    from orthaug.models.response import Response
    from orthaug.reports.page_fit import Origin


@dataclass(frozen=True, eq=False)
class FitReport:
    """A fit with the content of result.json: parameters, scores on every part, findings."""

    job: Job
    fit: Any
    """The fit: `Estimate`, or `MotionEstimate` for a motion."""
    result: FitResult
    responses: Mapping[str, tuple[Response, Response]]
    """One-step prediction and free run of every part, by its name; none where training failed."""
    alone: Mapping[str, tuple[Response, Response]] = field(default_factory=dict)
    """The responses of physics alone, where that was fitted too."""

    def __repr__(self) -> str:
        return f"Fitted({self.job.path.name}: {self.fit!r})"

    def summary(self) -> str:
        """Return what `orthaug fit` prints."""
        from orthaug.reports.text import fit_text

        return fit_text(self.fit, self.result) or self.fit.status.message

    def report(self, path: Any = None) -> Any:
        """Return the page that `orthaug fit` writes; see `Estimate.report`."""
        return MAKERS["report"](self, path, None)

    @property
    def plot(self) -> Any:
        """Figures of the fit on matplotlib axes; see `Estimate.plot`."""
        return self.fit.plot

    def _repr_html_(self) -> str:
        from orthaug.reports.html import card_of_result, html_of

        return html_of(card_of_result(self.fit, self.result))


@one_blas_thread()
def fit_job(job: Job, progress: Progress = SILENT) -> FitReport:
    """Train as the spec says, score every part, judge the learner, and try improvements."""
    return with_advice(with_doubts(with_verdict(fit_variant(job, AS_DECLARED, progress))))


def with_advice(fitted: FitReport) -> FitReport:
    """Return a fit with the changes of its spec that were tried."""
    from orthaug.commands.advice import advise

    if not fitted.fit.status.ok or _was_stopped(fitted.fit):
        return fitted
    failed: list[Any] = []
    found = attempt(
        "the trial of advice", lambda: advise(fitted.job, fitted.fit, fitted.result), failed, None
    )
    warnings = [
        *fitted.result.warnings,
        *(WarningResult.model_validate(warning) for warning in failed),
    ]
    trials = (
        {"warnings": warnings} if found is None else {"advice": found[0], "advice_trials": found[1]}
    )
    return replace(fitted, result=FitResult.model_validate({**dict(fitted.result), **trials}))


def with_verdict(fitted: FitReport) -> FitReport:
    """Return a fit with the verdict on its learner."""
    job, fit, warnings = fitted.job, fitted.fit, list(fitted.result.warnings)
    learns = fit.learns
    if not fit.status.ok or not (learns or fit.held_out is not None):
        return fitted
    failed: list[Any] = []
    physics = cache(partial(_physics_alone, fitted))
    alone = fitted.alone or None
    verdict = attempt(
        "the judgement of the learner",
        lambda: judge_fit(fitted, physics, alone=alone),
        failed,
        None,
    )
    warnings += failed
    asked = learns and job.spec.validation.blocks != 0
    if verdict is None and asked and not failed:
        short = "the training data have too few rows for cross-validation in so many blocks"
        why = "training was stopped too early for cross-validation" if _was_stopped(fit) else short
        text = f"whether the learner helps is not judged: no part is held out, and {why}."
        warnings.append(WarningResult(code="not_judged", text=text))
    if verdict is not None and learns:
        text = (
            *verdict.warnings,
            *_unexplained_warnings(fitted, None if verdict.code == "helps" else physics),
        )
        warnings += [WarningResult.model_validate(warning) for warning in text]
    result = FitResult.model_validate(
        {**dict(fitted.result), "validation": verdict, "warnings": warnings}
    )
    return replace(fitted, result=result)


def _physics_alone(fitted: FitReport) -> Any:
    """Return the fit of physics alone that the learner is compared to.

    It is the one that was made already, or one by the same criterion.
    """
    made = fitted.fit.physics_alone
    return (
        made
        if made is not None
        else fitted.job.run(Variant(PHYSICS_ONLY, criterion=fitted.fit.criterion))
    )


def _unexplained_warnings(fitted: FitReport, physics: Callable[[], Any] | None) -> list[Warning]:
    """Return a warning where the learner may have taken an unknown share of a parameter.

    It could imitate these parameters, and no suspect explains what it found.

    Args:
        physics: the fit without the learner, where that does not help: it may still take up what
            physics alone leaves.
    """
    from orthaug.analysis.diagnosis import diagnose

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


def keep_states(job: Job, folder: Path, *, resume: bool = False) -> Job:
    """Return the job, with its states of training kept beside the result folder.

    With `resume` training continues from them.

    Raises:
        InputError: states of another fit; hosts that do not run the same one.
    """
    from orthaug.fitting.checkpoints import Checkpoints
    from orthaug.models import hosts

    if job.spec.engine.kind == "devices" and hosts.several():
        hosts.check_alike(job.fingerprint)
        if resume:
            raise InputError(
                "--resume: a fit over several hosts keeps no states to continue from; leave it out."
            )
        return job
    place = folder.with_name(f"{folder.name}.training")
    kept = Checkpoints(place, job.fingerprint, job.spec.engine.checkpoint)
    return replace(job, checkpoints=kept.opened(resume=resume))


def fit_variant(job: Job, variant: Variant, progress: Progress = SILENT) -> FitReport:
    """Train a variant of a job and score every part; `judge_fit` judges the learner."""
    progress.planned(job.plan_of(variant))
    return report_of(job, job.run(variant, progress))


def report_of(job: Job, fit: Any) -> FitReport:
    """Score a fit on every part of its job, and fill its result up to the verdict."""
    fit, intervals = after_choice(job, fit)
    warnings: list[Any] = [*job.warnings, *fit.warnings]
    if job.checkpoints is not None and job.checkpoints.lost:
        warnings.append(
            Warning(
                "checkpoint_lost",
                f"the last state of training was not kept: {job.checkpoints.lost}.",
            )
        )
    if job.checkpoints is not None and job.checkpoints.spoilt:
        text = (
            "a kept state of training is damaged "
            f"({job.checkpoints.folder.name}/{job.checkpoints.spoilt[0]}), so that run began "
            "anew; the result is complete."
        )
        warnings.append(Warning("checkpoint_spoilt", text))
    scores, responses = {}, {}
    if fit.status.ok:
        for part in job.parts:
            scores[part.name], responses[part.name] = score_part(fit.model, part, warnings)
    physics, alone, ran = fit.physics_alone, {}, {}
    if physics is not None and physics.status.ok:
        ran = {part.name: score_part(physics.model, part, []) for part in job.parts}
        alone = {name: scored for name, (scored, _) in ran.items()}
    declared = job.spec.training.chosen_focus() == "prediction"
    one_step = declared or getattr(fit.model, "coloured", False)  # a noise model decides, too
    if fit.status.ok and one_step and fit.learns:
        warnings += _one_step_only(
            scores, alone, [part.name for part in job.parts if part not in job.tests]
        )
    fit, fields = job_result.content(job, fit, responses, warnings)
    if fit.status.ok and fields["residuals"] is not None:
        fit = _for_observers(fit, fields["residuals"].verdict, warnings)
    content = fields | {
        "spec": job.declaration,
        "data": job.data,
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
        "intervals": intervals,
        "warnings": warnings,
    }
    if fit.status.ok:
        over = attempt(
            "the errors over experiments",
            lambda: _over_experiments(job, fit, warnings),
            warnings,
            None,
        )
        content |= {"over_experiments": over} if over else {}
    terms = learned_terms(fit.model) if fit.status.ok else ()
    if terms:
        written = {writing: equation(fit.model, writing) for writing in ("text", "latex")}
        content |= {"terms": terms, "equation": written}
    return FitReport(
        job,
        fit,
        FitResult.model_validate(content),
        responses,
        {name: both for name, (_, both) in ran.items()},
    )


def _over_experiments(job: Job, fit: Any, warnings: list[Any]) -> dict[str, Any] | None:
    """Return intervals for experiments like those fitted; None where these are too few.

    A warning is added where they differ by more than the fit's own intervals allow.
    """
    from orthaug.inference.over_experiments import differing_warning

    found = fit.over_experiments
    if found is None:
        return None
    names = fit.problem.names
    doubt = differing_warning(found, names, fit.values)
    warnings.extend([] if doubt is None else [doubt])

    def rows(names: Sequence[str], std: Any, ci95: Any, ratio: Any) -> list[dict[str, Any]]:
        keys = ("name", "std", "ci95", "ratio")
        return [
            dict(zip(keys, row, strict=True)) for row in zip(names, std, ci95, ratio, strict=True)
        ]

    content = {
        "experiments": found.experiments,
        "parameters": rows(names, found.std, found.interval, found.ratio),
    }
    physics = job.physics.map
    if physics is not None:
        own = fit.physical(physics)
        over = replace(fit, covariance=found.covariance, freedom=found.freedom).physical(physics)
        ratio = np.array(over.std, dtype=float) / np.array(own.std, dtype=float)
        content["physical_parameters"] = rows(over.names, over.std, over.ci95, ratio)
    return content


def _status(fit: Any, warnings: Sequence[Any]) -> Any:
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


def _for_observers(fit: Any, verdict: str, warnings: list[Any]) -> Any:
    """Return the fit with a model that keeps what observers need.

    These are the verdict on the residual, and the two noises.
    """
    from orthaug.analysis.observer_noise import to_keep

    kept = replace(fit.model.statistics, verdict=verdict)
    noise = attempt("the noise of an observer", lambda: to_keep(fit, verdict), warnings, None)
    if noise is not None:
        kept = replace(kept, disturbance=np.asarray(noise.state), sensor=np.asarray(noise.output))
    return replace(fit, model=replace(fit.model, statistics=kept))


def judge_fit(
    fitted: FitReport,
    physics: Callable[[], Any],
    blocks: Sequence[Trial] | None = None,
    alone: Mapping[str, tuple[Response, Response]] | None = None,
) -> Verdict | None:
    """Return whether the learner is useful: its free run against physics alone on data not fitted.

    Where the fit fell back to physics alone, the trials behind that choice decide.

    Args:
        physics: gives the fit of physics alone, where a part is held out.
        blocks: trials of blocked cross-validation; None for those by which the fit was chosen, or
            to make them, where there is no validation or test part or where the spec asks for them.
        alone: the responses of physics alone by part, where they are there already.
    """
    from orthaug.analysis.validation import extrapolation, judge, score_trial, trials_of

    job, model, chosen_by = fitted.job, fitted.fit.model, fitted.fit.held_out
    held_out = job.parts[1:]
    simulated = fitted.fit.criterion.simulates
    if chosen_by is not None and not model.learns:
        return judge(trials_of(chosen_by)) if simulated else None
    if blocks is None:
        wanted = wanted_blocks(job)
        if wanted and simulated and chosen_by is not None and job.validation is None:
            blocks = trials_of(chosen_by)
        else:
            blocks = (
                cross_validated(job, wanted, [Variant(criterion=fitted.fit.criterion)])[0]
                if wanted and not _was_stopped(fitted.fit)
                else ()
            )
    trials, beyond = list(blocks), []
    for part in held_out:
        ran = None if alone is None else alone[part.name][1]
        response = fitted.responses[part.name][1]
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
            part.name,
            fitted.fit.reach(part.record),
            fitted.fit.reach(job.train.record),
            fitted.fit.layout,
        )
    return judge(trials, beyond)


def _was_stopped(fit: Any) -> bool:
    """Return whether training was asked to end early: then cross-validation is omitted too."""
    return any(warning.code == "stopped" for warning in fit.warnings)


def wanted_blocks(job: Job) -> int:
    """Return the number of blocks of cross-validation: by default none beside held-out parts."""
    asked = job.spec.validation.blocks
    return (0 if job.parts[1:] else DEFAULT_BLOCKS) if asked is None else asked


def cross_validated(job: Job, blocks: int, variants: Sequence[Variant]) -> list[list[Trial]]:
    """Return the trials of every variant on every block; none where the record is too short."""
    from orthaug.analysis.validation import block_trials, cross_validate

    fits = [
        job.fold_fit(variant)
        for variant in (Variant(PHYSICS_ONLY, criterion=variants[0].criterion), *variants)
    ]
    try:
        options: dict[str, Any] = {"start": job.first_row, "runner": job.runner}
        errors = cross_validate(job.train.record, fits, blocks=blocks, **options)
    except InputError:
        return [[] for _ in variants]
    return [block_trials(errors, 1 + j) for j in range(len(variants))]


def score_part(
    model: Any, part: Part, warnings: list[Any]
) -> tuple[PartScores, tuple[Response, Response]]:
    """Return the scores of a part, and the responses that they come from.

    A missing score adds a warning.
    """
    responses = model.predict(part.record), model.simulate(part.record)
    if part.source is not None:
        return _score_along(model, part, warnings), responses
    scores = {}
    for kind, response in zip(("prediction", "simulation"), responses, strict=True):
        runaway = next((t.diverged for t in response.trajectories if t.diverged), None)
        scored = response.scores(part.skips)
        scores[kind] = ScoreResult() if runaway is not None else scored
        if runaway is not None:
            step, output = runaway
            text = (
                f"{part.name}: the free run diverged in output '{output}' at step {step}; no "
                "simulation scores."
            )
            warnings.append(Warning("free_run_diverged", text))
        elif np.isnan(scored.rmse).any():
            warnings.append(
                Warning(
                    "not_finite", f"{part.name}: the {kind} is not finite on some rows; no scores."
                )
            )
        elif np.isnan(scored.nrmse).any():
            text = (
                f"{part.name}: an output is constant over the scored samples; no NRMSE and FIT "
                f"of its {kind}."
            )
            warnings.append(Warning("constant_output", text))
    return PartScores.model_validate(scores), responses


def _score_along(model: Any, part: Part, warnings: list[Any]) -> PartScores:
    """Return scores and residual tests over all rows of a part that is kept as a subsample."""
    from orthaug.analysis.residuals import RunningResidual
    from orthaug.data.sources import rows_of
    from orthaug.models.long_runs import scores_along

    assert part.source is not None
    whole = len(part.record) == rows_of(part.source)  # its tests are those of the result
    residual = RunningResidual([c.name for c in model.outputs], [c.name for c in model.inputs])
    found = scores_along(model, part.source, part.skip, None if whole else residual.watch)
    if found.diverged is not None:
        file, row, output = found.diverged
        text = (
            f"{part.name}: the free run diverged in output '{output}' at row {row} of {file}; "
            "no simulation scores."
        )
        warnings.append(Warning("free_run_diverged", text))
    simulation = ScoreResult() if found.diverged is not None else found.simulation
    tests = residual.tests() or None
    return PartScores.model_validate(
        {"prediction": found.prediction, "simulation": simulation, "residual": tests}
    )


def write_result(fitted: FitReport, folder: Path, *, force: bool = False) -> None:
    """Write result.json, model/ and figures/, whole or not at all.

    Without a model where training failed.
    """
    with whole_folder(folder, force=force) as partial:
        fill_result(fitted, partial)
    if fitted.job.checkpoints is not None:
        fitted.job.checkpoints.discard()


def fill_result(fitted: FitReport, folder: Path) -> None:
    """Write the files of a result into an existing folder."""
    from orthaug.models import storage

    (folder / "result.json").write_text(fitted.result.to_json() + "\n", encoding="utf-8")
    if not fitted.fit.status.ok:
        return
    (folder / "model").mkdir()
    storage.write(fitted.fit.model, folder / "model")
    physics = fitted.fit.physics_alone
    if physics is None and not fitted.fit.learns and fitted.job.spec.declared_learner() is not None:
        physics = fitted.fit  # the learner was left out
    if physics is not None and physics.status.ok:
        (folder / PHYSICS).mkdir()
        storage.write(physics.model, folder / PHYSICS)
    (folder / "figures").mkdir()
    _draw(fitted, folder / "figures")
    (folder / "report.html").write_text(fit_report(fitted), encoding="utf-8")


def _draw(fitted: FitReport, folder: Path) -> None:
    from orthaug.reports import plots

    drawn = job_result.figures(fitted.job, fitted.fit, fitted.result, fitted.responses)
    for name, figure in drawn.items():
        plots.save(figure, folder / f"{name}.png")


def fit_report(fitted: FitReport, origin: Origin | None = None) -> str:
    """Return the page of a fit that has a model.

    `origin` is None for the origin given by its spec.
    """
    from orthaug.reports.learned_part import learned_of
    from orthaug.reports.page import fit_page
    from orthaug.reports.page_fit import FitPage

    job, fit, responses = fitted.job, fitted.fit, fitted.responses
    alone = job_result.physics_alone(job, fit, responses) if fit.learns else {}
    learned = learned_of(fit, job.train.record)
    return fit_page(
        FitPage(origin or origin_of(job, "fit"), fitted.result, responses, alone, learned)
    )
