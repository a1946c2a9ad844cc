"""What a job leaves: scores, verdicts, the content of result.json and the folder that holds it."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug import __version__
from orthaug._base.errors import InputError
from orthaug._base.folders import check_replaceable, whole_folder
from orthaug.analysis.measure_bias import bias_under, weigh
from orthaug.commands.jobs import Job, LoadedPart, Progress, run_fit
from orthaug.commands.suspects import declared
from orthaug.inference.measures import Support
from orthaug.physics.excitation import Excitation, identifiability
from orthaug.reports.suspects import shares

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from orthaug.analysis.diagnosis import Diagnosis
    from orthaug.analysis.validation import Trial, Verdict
    from orthaug.data.record import Record
    from orthaug.fitting.estimates import Estimate
    from orthaug.inference.physical import PhysicalEstimate
    from orthaug.models.model import Model
    from orthaug.models.response import Response

SCHEMA = 1
DEFAULT_BLOCKS = 4


def check_report(job: Job) -> dict[str, Any]:
    """What `orthaug check` tells: excitation on the data, identifiability of the physics; nothing is trained."""
    problem = job.problem
    found = identifiability(problem.baseline, problem.layout, problem.outputs, problem.rows.x)
    return {
        "schema": SCHEMA,
        "orthaug": __version__,
        "data": data_of(job),
        "parameters": list(problem.baseline.names),
        "regressor": [str(lag) for lag in problem.layout],
        "rows": len(problem.rows),
        "excitation": _excitation(problem.excitation) | {"collinear": [list(g) for g in problem.excitation.collinear]},
        "identifiability": {
            "identifiable": found.full_rank,
            "rank": found.rank,
            "columns": found.columns,
            "inseparable": [list(group) for group in found.collinear],
        },
        "bias": _bias(job) if problem.excitation.full_rank else None,
        "warnings": list(job.warnings),
    }


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fit with its scores on every part, and the content of result.json."""

    job: Job
    fit: Estimate
    result: dict[str, Any]
    responses: tuple[Response, Response] | None
    """One-step prediction and free run of the last part."""
    diagnosis: Diagnosis | None
    verdict: Verdict | None


def fit_job(
    job: Job, progress: Progress | None = None, *, kind: str | None = None, alone: bool = False, judged: bool = True
) -> Fitted:
    """Train, score every part, and put the result together; the arguments as in `run_fit`.

    Args:
        judged: whether to ask if the learner earns its place; `compare` asks for all structures together.
    """
    from orthaug.analysis.diagnosis import diagnose
    from orthaug.analysis.free_run_stability import stability

    fit = run_fit(job, progress, kind=kind, alone=alone)
    warnings = [*job.warnings, *fit.warnings]
    scores, responses, diagnosis, verdict, physical, bias, steady = {}, None, None, None, None, None, None
    answers: dict[str, tuple[Response, Response]] = {}
    if fit.status.ok:
        physical = _physical(job, fit)
        warnings += physical.warnings if physical is not None else ()
        bias = _bias(job, fit)
        for part in job.parts:
            scores[part.name], responses = score_part(fit.model, part, warnings)
            answers[part.name] = responses
        one_step, free_run = answers[job.train.name]
        diagnosis = diagnose(fit, one_step=one_step, free_run=free_run)
        steady = stability(fit.model, job.train.record, response=free_run, x=fit.problem.rows.x)
        warnings += [warning.text for warning in steady.warnings]
        if diagnosis is None:
            warnings.append("the residual is not analysed: there are too few rows for that, or it is rounding only.")
        warnings += [warning.text for warning in diagnosis.warnings] if diagnosis is not None else []
        if judged and not alone and fit.model.form.bound is not None:
            verdict = judge_fit(job, fit)
            if verdict is None and job.spec.validation.blocks != 0:
                warnings.append(
                    "whether the learner helps is not judged: no part is held out, and the training data have too few "
                    "rows for cross-validation in so many blocks."
                )
            warnings += [warning.text for warning in verdict.warnings] if verdict is not None else []
    spec = job.spec.model_dump(mode="json", exclude_unset=True)
    status = fit.status
    result = {
        "schema": SCHEMA,
        "orthaug": __version__,
        "spec": spec,
        "data": data_of(job),
        "status": {
            "code": status.code,
            "message": status.message,
            "iterations": status.iterations,
            "seconds": status.seconds,
            "loss": status.loss,
        },
        "restarts": [asdict(restart) for restart in fit.restarts],
        "parameters": _parameters(fit),
        "physical_parameters": None if physical is None else _physical_rows(job, physical, fit),
        "physical_consistency": None
        if physical is None or physical.consistency is None
        else physical.consistency._asdict(),
        "sensitivities": None if physical is None or physical.sensitivities is None else _sensitivities(job, physical),
        "structure": fit.model.structure,
        "measure": fit.model.measure if fit.model.structure == "orthogonal" else None,
        "measure_detail": None if fit.measure is None else fit.measure.as_dict(),
        "orthogonality_defect": fit.defect,
        "excitation": _excitation(fit.excitation),
        "scores": scores,
        "bias": bias,
        "residuals": None if diagnosis is None else diagnosis.as_dict(),
        "stability": None if steady is None else steady.as_dict(),
        "validation": None if verdict is None else verdict.as_dict(),
        "warnings": warnings,
    }
    return Fitted(job, fit, plain(result), responses, diagnosis, verdict)


def judge_fit(
    job: Job, fit: Estimate, blocks: Sequence[Trial] | None = None, alone: Model | None = None
) -> Verdict | None:
    """Whether the learner earns its place: free runs against physics alone on what was not fitted.

    Args:
        blocks: trials of blocked cross-validation; None to make them where there is no validation or test part, or
            where the spec asks for them.
        alone: the physics alone; None to fit it.
    """
    from orthaug.analysis.validation import extrapolation, judge, trial_on
    from orthaug.data.regressors import stack_rows

    held_out, wanted = job.parts[1:], job.spec.validation.blocks
    if blocks is None:
        wanted = (0 if held_out else DEFAULT_BLOCKS) if wanted is None else wanted
        blocks = cross_validated(job, wanted, (None,))[None] if wanted else ()
    alone = run_fit(job, alone=True).model if alone is None else alone
    trials, beyond = list(blocks), []
    for part in held_out:
        trials.append(trial_on(part.name, part.record, part.skips, alone, fit.model))
        x = stack_rows(part.record, job.problem.layout).x
        beyond += extrapolation(part.name, x, job.problem.rows.x, job.problem.layout)
    return judge(trials, beyond)


def cross_validated(job: Job, blocks: int, kinds: Sequence[str | None]) -> dict[str | None, list[Trial]]:
    """Trials of every kind of structure on every block; none where the record is too short for that."""
    from orthaug.analysis.validation import Trial, cross_validate

    start = job.problem.rows.start
    fits = [partial(_fold_fit, job, None, True), *(partial(_fold_fit, job, kind, False) for kind in kinds)]
    try:
        errors = cross_validate(job.train.record, fits, blocks=blocks, start=start)
    except InputError:
        return {kind: [] for kind in kinds}
    return {
        kind: [Trial(f"block {i + 1} of {blocks}", fold[0], fold[1 + j], block=True) for i, fold in enumerate(errors)]
        for j, kind in enumerate(kinds)
    }


def _fold_fit(job: Job, kind: str | None, alone: bool, fold: Record) -> Estimate:
    return run_fit(job, kind=kind, alone=alone, fold=fold)


def _physical(job: Job, fit: Estimate) -> PhysicalEstimate | None:
    """p̂ of θ̂, where the spec has a map."""
    if job.physics is None:
        return None
    return fit.physical(job.physics)


def _physical_rows(job: Job, found: PhysicalEstimate, fit: Estimate) -> list[dict[str, Any]]:
    """The physical parameters as result.json lists them, with profile intervals where the spec asks for them."""
    rows = found.as_rows()
    if job.physics is None or job.spec.physics is None or not job.spec.physics.profile or found.covariance is None:
        return rows
    for row in rows:
        low, high = fit.physical_profile(job.physics, row["name"])
        row["profile95"] = [_finite(low), _finite(high)]
    return rows


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _sensitivities(job: Job, found: PhysicalEstimate) -> dict[str, dict[str, float]]:
    """∂ln p / ∂ln θ by name."""
    assert job.physics is not None and found.sensitivities is not None
    return {
        name: dict(zip(job.physics.theta_names, map(float, row), strict=True))
        for name, row in zip(found.names, found.sensitivities, strict=True)
    }


def _bias(job: Job, fit: Estimate | None = None) -> list[dict[str, Any]]:
    """The table of suspects under the spec's measure, before a fit or after it."""
    problem = job.problem
    if not problem.baseline.names:
        return []
    weighed = weigh(problem, job.measure.points(Support(job.train.record, problem.layout, job.used)))
    suspects = declared(job.spec.suspects, problem)
    if fit is None:
        return bias_under(weighed, problem, suspects, physics=job.physics)
    learned = None if fit.model.form.bound is None else fit.model.learner_at(weighed.points.x)
    return bias_under(weighed, problem, suspects, physics=job.physics, theta=fit.theta, learned=learned)


def is_result(folder: Path) -> bool:
    """Whether a folder holds a result that orthaug wrote."""
    try:
        content = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and "schema" in content and "orthaug" in content


def check_output(folder: Path) -> None:
    """Raise InputError early where the result could not be written."""
    check_replaceable(folder, is_result)


def check_inputs_kept(job: Job, folder: Path) -> None:
    """Raise InputError where the result would take the place of a file that the job reads."""
    for file in job.files:
        if file.resolve().is_relative_to(folder.resolve()):
            raise InputError(f"{folder}: holds {file.name}, which this fit reads; give another folder.")


def write_result(fitted: Fitted, folder: Path) -> None:
    """result.json, model/ and figures/, whole or not at all; without a model where training failed."""
    with whole_folder(folder, is_result) as partial:
        fill_result(fitted, partial)


def fill_result(fitted: Fitted, folder: Path) -> None:
    """Write the files of a result into an existing folder."""
    from orthaug.models import storage
    from orthaug.reports import plots, report

    text = json.dumps(fitted.result, indent=1, ensure_ascii=False, allow_nan=False)
    (folder / "result.json").write_text(text + "\n", encoding="utf-8")
    if not fitted.fit.status.ok:
        return
    (folder / "model").mkdir()
    storage.write(fitted.fit.model, folder / "model")
    (folder / "figures").mkdir()
    assert fitted.responses is not None
    one_step, free = fitted.responses
    where = f"{fitted.job.parts[-1].name}, {fitted.fit.model.structure}"
    drawn = {
        "prediction": plots.output_figure(one_step, f"one-step prediction, {where}"),
        "simulation": plots.output_figure(free, f"free run, {where}"),
        "residual": plots.residual_figure(one_step, f"one-step residual, {where}"),
    }
    if fitted.diagnosis is not None:
        analysed = {"one-step": fitted.diagnosis.one_step, "free-run": fitted.diagnosis.free_run}
        for kind, tests in analysed.items():
            if tests is not None:
                title = f"{kind} residual on the training data, {fitted.fit.model.structure}"
                drawn[f"residuals_{kind.replace('-', '_')}"] = plots.residual_analysis_figure(tests, title)
    if fitted.result["bias"]:
        drawn["bias"] = bias_heat_map(fitted.result["bias"])
    if fitted.fit.model.form.bound is not None:
        drawn["components"] = plots.components_figure(one_step, f"parts of the one-step prediction, {where}")
    for name, figure in drawn.items():
        plots.save(figure, folder / "figures" / f"{name}.png")
    title = fitted.job.path.stem
    (folder / "report.html").write_text(report.page(title, fitted.result, folder / "figures"), encoding="utf-8")


def bias_heat_map(table: list[dict[str, Any]]) -> Figure:
    """The suspects' biases as a picture."""
    from orthaug.reports import plots

    biases = [shares(entry) for entry in table]
    names = list(biases[0])
    values = np.array([[np.nan if b[name] is None else b[name] for name in names] for b in biases], dtype=float)
    title = "bias of each parameter [%] by terms that may be missing (without a guess: of 1 % of the output)"
    return plots.bias_figure(names, [entry["name"] for entry in table], values, title)


def plain(value: Any) -> Any:
    """The same with None for every number that is not finite: JSON has no NaN."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value


def score_part(model: Model, part: LoadedPart, warnings: list[str]) -> tuple[dict[str, Any], tuple[Response, Response]]:
    """Scores of a part and the responses they come from; what does not exist is None, with a sentence in `warnings`."""
    responses = model.predict(part.record), model.simulate(part.record)
    found = {}
    for kind, response in zip(("prediction", "simulation"), responses, strict=True):
        runaway = next((t.diverged for t in response.trajectories if t.diverged), None)
        scored = response.scores(part.skips)
        found[kind] = scored.as_dict()
        if runaway is not None:
            step, output = runaway
            found[kind] = {"rmse": None, "nrmse": None, "fit": None}
            warnings.append(
                f"{part.name}: the free run diverged in output '{output}' at step {step}; no simulation scores."
            )
        elif np.isnan(scored.rmse).any():
            warnings.append(f"{part.name}: the {kind} is not finite on some rows; no scores.")
        elif np.isnan(scored.nrmse).any():
            warnings.append(
                f"{part.name}: an output is constant over the scored samples; no NRMSE and FIT of its {kind}."
            )
    return found, responses


def data_of(job: Job) -> dict[str, Any]:
    """The files of each part, as result.json lists them."""
    return {
        "train": list(job.train.files),
        **({"validation": list(job.validation.files)} if job.validation else {}),
        **({"tests": {part.name.removeprefix("tests."): list(part.files) for part in job.tests}} if job.tests else {}),
    }


def _excitation(found: Excitation) -> dict[str, Any]:
    return {"rank": found.rank, "columns": found.columns, "condition": found.condition}


def _parameters(fit: Estimate) -> list[dict[str, Any]]:
    std, ci, one_step = fit.std, fit.interval, fit.one_step_theta
    return [
        {
            "name": p.name,
            "unit": p.unit,
            "initial": p.initial,
            "value": float(fit.theta[i]) if fit.status.ok else None,
            **({} if one_step is None else {"one_step": float(one_step[i])}),
            "std": None if std is None else float(std[i]),
            "ci95": None if ci is None or np.isnan(ci[i]).any() else [float(v) for v in ci[i]],
        }
        for i, p in enumerate(fit.problem.baseline.parameters)
    ]
