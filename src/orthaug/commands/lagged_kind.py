"""What is told of jobs whose physics is linear in θ on lagged signals."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.errors import InputError
from orthaug._base.warning import Warning
from orthaug.analysis.closed_loop import closed_loop
from orthaug.commands.attempt import attempt
from orthaug.commands.bias import bias_of, budget_of, with_biases
from orthaug.commands.lagged_job import LaggedJob
from orthaug.commands.shared import shared_of
from orthaug.physics.baseline import derived_units
from orthaug.physics.excitation import identifiability, require_rank
from orthaug.reports.result import CheckResult, FitResult, ParameterResult, parameter_rows, physical_rows

if TYPE_CHECKING:
    from orthaug.fitting.estimates import Estimate
    from orthaug.inference.physical import PhysicalEstimate
    from orthaug.models.response import Response
    from orthaug.reports.drawing import Figure
    from orthaug.reports.learned_part import LearnedPart

_UNKNOWN = ("physical_parameters", "physical_consistency", "sensitivities", "bias")


def checked(job: LaggedJob) -> CheckResult:
    """Excitation on the data, identifiability of the physics, and what each suspect would do to θ."""
    problem = job.problem
    return CheckResult.model_validate(
        {
            "data": job.data,
            "parameters": problem.baseline.names,
            "regressor": [str(lag) for lag in problem.layout],
            "rows": problem.count,
            "excitation": problem.excitation,
            "identifiability": identifiability(problem.baseline, problem.layout, problem.outputs, problem.rows.x),
            "shared": shared_of(job),
            "bias": bias_of(job) if problem.excitation.full_rank else None,
            "warnings": [*job.warnings, *closed_loop(job.train.record)],
        }
    )


def refused(job: LaggedJob, result: CheckResult) -> InputError | None:
    """Why the job cannot be fitted, after the report."""
    try:
        require_rank(job.problem.excitation, job.problem.samples)
    except InputError as error:
        return error
    return None


def content(
    job: LaggedJob, fit: Estimate, responses: Mapping[str, tuple[Response, Response]], warnings: list[Any]
) -> tuple[Estimate, dict[str, Any]]:
    """The fit with the standard errors that its residual asks for, and what results tell of it; warnings are added."""
    from orthaug.analysis.robustness import robust_where_coloured

    told: dict[str, Any] = dict.fromkeys((*_UNKNOWN, "residuals", "missing_lags", "stability"))
    if fit.status.ok:
        one_step, free_run = responses[job.train.name]
        plain = fit
        fit = attempt("the robust covariance", lambda: robust_where_coloured(plain, one_step), warnings, plain)
        told |= _physical_content(job, fit, warnings)
        told["bias"] = attempt("the bias by suspects", partial(bias_of, job, fit), warnings, None)
        told |= _analysed(fit, one_step, free_run, warnings)
    shared = shared_of(job, fit.problem, others=False)
    rows = parameter_rows(
        fit.problem.baseline.parameters,
        fit.theta if fit.status.ok else np.full(len(fit.theta), np.nan),
        fit.std,
        fit.interval,
        fit.one_step_theta,
        None if fit.plain_covariance is None else np.sqrt(np.diag(fit.plain_covariance)),
    )
    units = derived_units(fit.problem.baseline, fit.problem.record.outputs, fit.problem.record.inputs)
    told |= {
        "parameters": [
            row if row.unit else row.model_copy(update={"derived_unit": units.get(row.name)}) for row in rows
        ],
        "standard_errors": None if fit.std is None else "plain" if fit.plain_covariance is None else "robust",
        "measure_detail": fit.measure,
        "excitation": fit.excitation,
        "shared": shared,
    }
    budget = None
    if fit.status.ok:
        budget = attempt("the bias that the learner implies", partial(budget_of, job, fit), warnings, None)
    found, biased = with_biases(fit, shared, told, budget)
    warnings += biased
    return fit, told | found


def figures(
    job: LaggedJob, fit: Estimate, result: FitResult, responses: Mapping[str, tuple[Response, Response]]
) -> dict[str, Figure]:
    """The figures of a result by their names."""
    from orthaug.reports import plots

    last, structure = job.parts[-1].name, fit.model.structure
    one_step, free = responses[last]
    where = f"{last}, {structure}"
    drawn = {
        "prediction": plots.output_figure(one_step, f"one-step prediction, {where}"),
        "simulation": plots.output_figure(free, f"free run, {where}"),
        "residual": plots.residual_figure(one_step, f"one-step residual, {where}"),
    }
    if result.residuals is not None:
        for kind, tests in (("one-step", result.residuals.one_step), ("free-run", result.residuals.free_run)):
            if tests is not None:
                title = f"{kind} residual on the training data, {structure}"
                drawn[f"residuals_{kind.replace('-', '_')}"] = plots.residual_analysis_figure(tests, title)
    if result.bias:
        drawn["bias"] = plots.bias_figure(result.bias)
    if fit.model.form.bound is not None:
        drawn["components"] = plots.components_figure(one_step, f"parts of the one-step prediction, {where}")
    return drawn


def physics_alone(
    job: LaggedJob, fit: Estimate, responses: Mapping[str, tuple[Response, Response]]
) -> Mapping[str, Response]:
    """The free run of every part by the physics without the learner; empty where nothing was learned."""
    if fit.model.form.bound is None:
        return {}
    alone = fit.model.alone
    return {part.name: alone.simulate(part.record) for part in job.parts}


def learned(job: LaggedJob, fit: Estimate) -> LearnedPart | None:
    """What was learned, as a function; None where nothing was."""
    from orthaug.reports.learned_part import learned_of

    return learned_of(fit, job.train.record)


def _physical_content(job: LaggedJob, fit: Estimate, warnings: list[Any]) -> dict[str, Any]:
    """The physical parameters of θ̂ and what belongs to them, where the spec has a map; warnings are added."""
    if job.physics is None:
        return {}
    physical = fit.physical(job.physics)
    warnings += physical.warnings
    return {
        "physical_parameters": _physical_rows(job, physical, fit),
        "physical_consistency": physical.consistency,
        "sensitivities": _sensitivities(job, physical),
    }


def _physical_rows(job: LaggedJob, physical: PhysicalEstimate, fit: Estimate) -> list[ParameterResult]:
    """The physical parameters, with profile intervals where the spec asks for them."""
    assert job.physics is not None and job.spec.physics is not None
    if not job.spec.physics.profile or physical.covariance is None:
        return physical_rows(physical)
    return physical_rows(physical, {name: fit.physical_profile(job.physics, name) for name in physical.names})


def _sensitivities(job: LaggedJob, physical: PhysicalEstimate) -> dict[str, dict[str, float]] | None:
    """∂ln p / ∂ln θ by name."""
    if job.physics is None or physical.sensitivities is None:
        return None
    return {
        name: dict(zip(job.physics.theta_names, row, strict=True))
        for name, row in zip(physical.names, physical.sensitivities, strict=True)
    }


def _analysed(fit: Estimate, one_step: Response, free_run: Response, warnings: list[Any]) -> dict[str, Any]:
    """What the residuals and the free run's sensitivity say; warnings are added."""
    from orthaug.analysis.diagnosis import diagnose
    from orthaug.analysis.free_run_stability import stability
    from orthaug.analysis.missing_lags import missing_lags

    problem = fit.problem

    def residuals() -> Any:
        diagnosis = diagnose(fit, one_step=one_step, free_run=free_run)
        if diagnosis is None:
            told = "the residual is not analysed: there are too few rows for that, or it is rounding only."
            warnings.append(Warning("residual_not_analysed", told))
        else:
            warnings.extend(diagnosis.warnings)
        return diagnosis

    def steady() -> Any:
        found = stability(fit.model, problem.record, response=free_run, x=problem.rows.x)
        warnings.extend(found.warnings)
        return found

    def hidden() -> Any:
        found = missing_lags(fit, one_step)
        warnings.extend(found.warnings if found else ())
        return found

    warnings += closed_loop(problem.record)
    return {
        "stability": attempt("the analysis of the free run's sensitivity", steady, warnings, None),
        "residuals": attempt("the analysis of the residual", residuals, warnings, None),
        "missing_lags": attempt("the search for missing lags", hidden, warnings, None),
    }
