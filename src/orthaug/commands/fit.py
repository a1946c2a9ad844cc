"""Fit of a spec: train a job, score and judge it, and write the folder with the result."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthaug._base.errors import InputError, Warning
from orthaug._base.folders import whole_folder
from orthaug._base.jax import release_programs
from orthaug._base.parallel import one_blas_thread
from orthaug._base.progress import SILENT, Progress, Stage
from orthaug._base.views import MAKERS
from orthaug.analysis.attempt import attempt
from orthaug.analysis.doubts import doubt, with_found_change
from orthaug.analysis.evidence import Evidence
from orthaug.analysis.examination import Examination, score_and_analyse, was_stopped, with_verdict
from orthaug.commands import job_result
from orthaug.commands.chosen_rows import after_choice
from orthaug.commands.folder import PHYSICS, save_json
from orthaug.commands.job import AS_DECLARED, MISSING_STATE, Job, Variant, origin_of
from orthaug.fitting.estimates import Estimate
from orthaug.reports.page_verdict import is_biased_by_feedback
from orthaug.reports.result import FitResult

if TYPE_CHECKING:
    from orthaug.analysis.findings import AdviceResult
    from orthaug.reports.page_fit import Origin

_HALF = 0.5  # of the error, to less than which a change of the spec lowers it: it explains most
_FIFTH = 0.2  # of it: the change explains nearly all


@dataclass(frozen=True, eq=False, kw_only=True)
class FitReport(Examination):
    """A fit with the content of result.json: parameters, scores on every part, findings."""

    job: Job
    result: FitResult

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
def fit_job(
    job: Job,
    progress: Progress = SILENT,
    finished: Callable[[FitReport], None] | None = None,
) -> FitReport:
    """Train as the spec says, score every part, judge the learner, and try improvements.

    Args:
        finished: called with the fit before improvements are tried, which may take long.
    """
    release_programs()
    fitted = doubt(with_verdict(fit_variant(job, AS_DECLARED, progress)))
    if finished is not None:
        finished(fitted)
    return with_advice(fitted)


def with_advice(fitted: FitReport) -> FitReport:
    """Return a fit with the changes of its spec that were tried."""
    from orthaug.commands.advice import advise

    if not fitted.fit.status.ok or was_stopped(fitted.fit):
        return fitted
    Stage.ADVICE.enter()
    failed: list[Any] = []
    found = attempt(
        "the trial of advice", lambda: advise(fitted.job, fitted.fit, fitted.result), failed, None
    )
    advice, tried = ([], None) if found is None else found
    result = fitted.result
    looped = is_biased_by_feedback(result)  # what explains most may then be the loop
    if advice and not looped and _explains_more_than(_HALF, advice[0]):
        nearly_all = _explains_more_than(_FIFTH, advice[0])
        change, causes = advice[0].change, set[str]()
        if "data.prepare" in change:
            causes.add("late_rows")
        if MISSING_STATE in advice[0].text:
            causes.add("hidden_state")
        result = with_found_change(
            fitted.fit, result, advice[0].text, nearly_all=nearly_all, causes=causes
        )
    trials = {"warnings": [*result.warnings, *failed], "advice": advice, "advice_trials": tried}
    return replace(fitted, result=result.changed(**trials))


def _explains_more_than(left: float, advice: AdviceResult) -> bool:
    """Return whether a change lowers the error to less than a share, or keeps a run bounded."""
    if advice.after is None:
        return False
    return advice.before is None or advice.after < left * advice.before


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


def report_of(job: Job, fit: Estimate, evidence: Evidence | None = None) -> FitReport:
    """Score a fit on every part of its job, and fill its result up to the verdict.

    Args:
        evidence: what it is judged by; None for what the job declares.
    """
    fit, intervals = after_choice(job, fit)
    fit = replace(fit, warnings=(*fit.warnings, *_checkpoint_warnings(job)))
    made = score_and_analyse(fit, job.evidence if evidence is None else evidence)
    result = FitResult.model_validate(
        {**dict(made.result), "spec": job.declaration, "data": job.data, "intervals": intervals}
    )
    return FitReport(
        fit=made.fit,
        evidence=made.evidence,
        result=result,
        responses=made.responses,
        alone=made.alone,
        job=job,
    )


def _checkpoint_warnings(job: Job) -> list[Warning]:
    """Return warnings on states of training that were not kept, or that were damaged."""
    states, found = job.checkpoints, []
    if states is not None and states.lost:
        text = f"the last state of training was not kept: {states.lost}."
        found.append(Warning("checkpoint_lost", text))
    if states is not None and states.spoilt:
        text = (
            "a kept state of training is damaged "
            f"({states.folder.name}/{states.spoilt[0]}), so that run began anew; the result is "
            "complete."
        )
        found.append(Warning("checkpoint_spoilt", text))
    return found


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

    save_json(fitted.result, folder)
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
    Stage.FIGURES.enter()
    (folder / "figures").mkdir()
    _draw(fitted, folder / "figures")
    Stage.REPORT.enter()
    (folder / "report.html").write_text(fit_report(fitted), encoding="utf-8")


def import_drawing() -> None:
    """Import what draws figures in a thread of its own, while compiled programs train."""
    threading.Thread(target=_import_drawing, daemon=True).start()


def _import_drawing() -> None:
    with suppress(Exception):  # it is raised where figures are drawn
        import orthaug.reports.drawing  # noqa: F401


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
