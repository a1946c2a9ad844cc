"""Physics alone and every structure on the same data and seeds: what `orthaug compare` does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.errors import InputError
from orthaug._base.folders import whole_folder
from orthaug._base.progress import SILENT, Progress, Stage
from orthaug.analysis.doubts import doubt
from orthaug.analysis.examination import cross_validated, judge_fit
from orthaug.analysis.fit_findings import parameter_rows
from orthaug.analysis.scoring import equal_within_noise, score_part
from orthaug.analysis.validation import Verdict, dominance
from orthaug.commands.fit import FitReport, fit_variant
from orthaug.commands.folder import save_json
from orthaug.commands.job import PHYSICS_ONLY, Job, Variant, origin_of
from orthaug.data.record import same_step
from orthaug.fitting.criteria import Criterion, Prediction
from orthaug.models import storage
from orthaug.models.model import Model
from orthaug.models.response import Response
from orthaug.reports import plots
from orthaug.reports.page_verdict import best_row
from orthaug.reports.result import CompareResult, RowResult

if TYPE_CHECKING:
    from orthaug.reports.page_compare import ComparePage


@dataclass(frozen=True, eq=False)
class Comparison:
    """A comparison: one entry per model, fitted now or saved earlier."""

    job: Job
    fitted: dict[str, FitReport]
    verdicts: dict[str, Verdict]
    result: CompareResult

    def __repr__(self) -> str:
        codes = {
            kind: self.verdicts[kind].code if kind in self.verdicts else "–" for kind in self.fitted
        }
        return f"Comparison({', '.join(f'{kind}: {code}' for kind, code in codes.items())})"

    def summary(self) -> str:
        """Return what `orthaug compare` prints."""
        from orthaug.reports.text import compare_text

        return compare_text(self.result, self.verdicts)


def compare(job: Job, saved: Sequence[Path] = (), progress: Progress = SILENT) -> Comparison:
    """Fit every structure as the spec trains, and score each and every saved model on every part.

    A structure that the spec does not allow (a baseline penalty with an initial value of 0) is left
    out with the reason. With a validation part the row of the lowest error there is marked as
    chosen.
    """
    models = {str(path): _load_matching(path, job) for path in saved}
    fitted, left_out = {}, {}
    criterion, decided = _criterion(job, progress)
    for number, kind in enumerate(job.compared):
        variant = Variant(kind, criterion=criterion)
        refusal = job.refusal(variant)
        if refusal is not None:
            left_out[kind] = refusal
            continue
        if decided is not None and kind == job.spec.structure.kind and decided.fit.learns:
            fitted[kind] = decided
            continue
        fitted[kind] = doubt(fit_variant(job, variant, progress.after(runs=number * job.run_count)))
    verdicts = _verdicts(job, fitted)
    rows = [_row(kind, fit, verdicts.get(kind)) for kind, fit in fitted.items()]
    responses = {name: one.responses for name, one in fitted.items()}
    for name, model in models.items():
        row, responses[name] = _saved_row(name, model, job)
        rows.append(row)
    content = {
        "spec": job.declaration,
        "data": job.data,
        "comparison": rows,
        "chosen": choose_row(rows, criterion.simulates) if job.validation else None,
        "left_out": left_out,
        "warnings": job.warnings,
    }
    which = int(criterion.simulates or not job.validation)
    chosen_by = {
        name: {part: both[which] for part, both in (own or {}).items()}
        for name, own in responses.items()
    }
    skips = {part.name: part.skips for part in job.parts}
    result = with_equal_rows(CompareResult.model_validate(content), chosen_by, skips)
    return Comparison(job, fitted, verdicts, result)


def with_equal_rows(
    result: CompareResult,
    responses: Mapping[str, Mapping[str, Response]],
    skips: Mapping[str, Sequence[int]],
) -> CompareResult:
    """Return a comparison that says which rows differ from the best one by chance alone.

    Args:
        result: the comparison.
        responses: of every part, by the name of the row: those that the choice is made by.
        skips: of every part, leading rows of each experiment that are not scored.
    """
    best, part = best_row(result)
    own = responses.get(best, {}).get(part)
    if own is None:
        return result
    others = {name: runs[part] for name, runs in responses.items() if name != best and part in runs}
    equal = [
        name
        for name, other in others.items()
        if equal_within_noise(own, other, skips.get(part, [0] * len(own.trajectories)))
    ]
    return result.model_copy(update={"equal": [best, *equal] if equal else None})


def _criterion(job: Job, progress: Progress) -> tuple[Criterion, FitReport | None]:
    """Return the criterion that trains every structure, and the fit that chose it, if any."""
    declared = job.spec.declared_criterion()
    if not declared.automatic:
        return declared, None
    kind = job.spec.structure.kind if job.spec.structure.kind in job.compared else PHYSICS_ONLY
    fitted = doubt(fit_variant(job, Variant(kind), progress))
    return (fitted.fit.criterion if fitted.fit.status.ok else Prediction()), fitted


def _verdicts(job: Job, fitted: dict[str, FitReport]) -> dict[str, Verdict]:
    """Return whether each structure's learner helps, by cross-validation and held-out parts."""
    alone = fitted[PHYSICS_ONLY].fit
    kinds = [kind for kind, tried in fitted.items() if kind != PHYSICS_ONLY and tried.fit.status.ok]
    if not kinds or not alone.status.ok:
        return {}
    criterion = alone.criterion
    blocks, simulates = job.evidence.wanted_blocks, criterion.simulates
    if simulates or not blocks:  # free runs were chosen by the same trials
        trials = [None] * len(kinds)
    else:
        trials = cross_validated(job.evidence, blocks, [fitted[kind].fit for kind in kinds])
    ran = fitted[PHYSICS_ONLY].responses
    verdicts = {
        k: judge_fit(fitted[k], lambda: alone, own, ran)
        for k, own in zip(kinds, trials, strict=True)
    }
    return {kind: verdict for kind, verdict in verdicts.items() if verdict is not None}


def write(comparison: Comparison, folder: Path, *, force: bool = False) -> None:
    """Write result.json, models/, figures/ and report.html, whole or not at all."""
    with whole_folder(folder, force=force) as partial:
        for kind, fitted in comparison.fitted.items():
            if fitted.fit.status.ok:
                place = partial / "models" / kind.replace(" ", "-")
                place.mkdir(parents=True)
                storage.write(fitted.fit.model, place)
        write_report(page_of(comparison), partial)


def write_report(page: ComparePage, folder: Path) -> None:
    """Write result.json, figures/ and report.html of a comparison."""
    from orthaug.reports.page import compare_page

    save_json(page.result, folder)
    Stage.FIGURES.enter()
    (folder / "figures").mkdir()
    figure = plots.comparison_figure(page.result.comparison)
    plots.save(figure, folder / "figures" / "comparison.png")
    Stage.REPORT.enter()
    (folder / "report.html").write_text(compare_page(page), encoding="utf-8")


def page_of(comparison: Comparison) -> ComparePage:
    """Return what the page of a comparison shows."""
    from orthaug.reports.page_compare import ComparePage

    responses = {
        name: {part: free for part, (_, free) in fitted.responses.items()}
        for name, fitted in comparison.fitted.items()
        if fitted.responses
    }
    return ComparePage(origin_of(comparison.job, "compare"), comparison.result, responses)


def _load_matching(path: Path, job: Job) -> Model:
    """Return a saved model that fits the job's data."""
    model = storage.load(path)
    record = job.problem.record
    lacking = [c.name for c in model.inputs if c.name not in [own.name for own in record.inputs]]
    if lacking:
        known = ", ".join(c.name for c in record.inputs) or "none"
        raise InputError(f"{path}: uses the input {', '.join(lacking)}; the spec has {known}.")
    if not same_step(model.sampling_time, record.sampling_time):
        raise InputError(
            f"{path}: sampled every {model.sampling_time:g} s, the spec's data every "
            f"{record.sampling_time:g} s."
        )
    wanted = [c.name for c in record.outputs]
    if [c.name for c in model.outputs] != wanted:
        raise InputError(
            f"{path}: its outputs are {', '.join(c.name for c in model.outputs)}; expected "
            f"{', '.join(wanted)}."
        )
    return model


def _row(kind: str, fitted: FitReport, verdict: Verdict | None) -> RowResult:
    result, fit = fitted.result, fitted.fit
    own = {key: getattr(result, key) for key in ("parameters", "orthogonality_defect", "residuals")}
    own |= {"status": result.status.code, "seconds": result.status.seconds, "validation": verdict}
    share = dominance(fit) if fit.status.ok else None
    return row_of(kind, fit.model, result.scores, result.warnings, **own, learner_to_physics=share)


def _saved_row(
    name: str, model: Model, job: Job
) -> tuple[RowResult, dict[str, tuple[Response, Response]]]:
    warnings: list[Any] = []
    found = {part.name: score_part(model, part, warnings) for part in job.parts}
    scores = {part: scores for part, (scores, _) in found.items()}
    row = row_of(
        name, model, scores, warnings, status="saved", parameters=parameter_rows(*model.estimated)
    )
    return row, {part: responses for part, (_, responses) in found.items()}


def row_of(
    name: str, model: Model, scores: Any, warnings: Sequence[object], **content: object
) -> RowResult:
    """Return a row of the table; keys that `content` lacks are null."""
    own = {"name": name, "weights": model.form.bound.size}
    return RowResult.model_validate(
        dict.fromkeys(RowResult.model_fields)
        | own
        | {"scores": scores, "warnings": warnings}
        | content
    )


def choose_row(rows: Sequence[RowResult], simulates: bool) -> str | None:
    """Return the row with the lowest error on the validation part, by the criterion of training.

    Physics alone wins where the verdict is that the learner of that row does not help.
    """
    errors = {}
    for row in rows:
        scores = row.scores.get("validation")
        score = None if scores is None else scores.simulation if simulates else scores.prediction
        if score is not None and score.nrmse is not None and None not in score.nrmse:
            errors[row.name] = float(np.mean(np.square(np.array(score.nrmse, dtype=float))))
    best = min(errors, key=errors.__getitem__) if errors else None
    verdict = next((row.validation for row in rows if row.name == best), None)
    return (
        PHYSICS_ONLY
        if verdict is not None and verdict.verdict != "helps" and PHYSICS_ONLY in errors
        else best
    )
