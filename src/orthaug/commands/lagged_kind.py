"""Results of jobs whose physics is linear in θ on lagged signals."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.errors import InputError, Warning
from orthaug.analysis.closed_loop import closed_loop
from orthaug.analysis.imitation import Imitation, imitation
from orthaug.analysis.measure_bias import MeasureLinearization, bias_under
from orthaug.commands.attempt import attempt, attempt_warned
from orthaug.commands.lagged_job import LaggedJob
from orthaug.commands.suspects import declare_suspects
from orthaug.fitting.elimination import directions
from orthaug.inference.measures import weigh_problem
from orthaug.inference.nearly_shared import shared_warnings
from orthaug.physics import ill_conditioned
from orthaug.physics.baseline import derived_units
from orthaug.physics.excitation import identifiability, require_rank
from orthaug.reports.result import (
    CheckResult,
    FitResult,
    ParameterResult,
    parameter_rows,
    physical_rows,
)

if TYPE_CHECKING:
    from orthaug.analysis.budget import Budget
    from orthaug.fitting.estimates import Estimate
    from orthaug.models.response import Response
    from orthaug.reports.drawing import Figure

_NOT_ANALYSED = Warning(
    "residual_not_analysed",
    "the residual is not analysed: there are too few rows, or it is rounding error only.",
)
_UNKNOWN = ("physical_parameters", "physical_consistency", "sensitivities", "bias")


def check(job: LaggedJob) -> CheckResult:
    """Return excitation of the data, identifiability of the physics, and bias by suspects."""
    problem = job.problem
    return CheckResult.model_validate(
        {
            "data": job.data,
            "parameters": problem.baseline.names,
            "regressor": [str(lag) for lag in problem.layout],
            "rows": problem.count,
            "excitation": problem.excitation,
            "identifiability": identifiability(
                problem.baseline, problem.layout, problem.outputs, problem.rows.x
            ),
            "shared": _shared_of(job),
            "bias": _bias_of(job) if problem.excitation.full_rank else None,
            "warnings": [
                *job.warnings,
                *ill_conditioned.of_physics(problem),
                *_shared_warnings(job),
                *closed_loop(job.train.record),
            ],
        }
    )


def refusal(job: LaggedJob, result: CheckResult) -> InputError | None:
    """Return the reason why the job cannot be fitted, after the report; None where it can."""
    try:
        require_rank(job.problem.excitation, job.problem.samples)
    except InputError as error:
        return error
    return None


def content(
    job: LaggedJob,
    fit: Estimate,
    responses: Mapping[str, tuple[Response, Response]],
    warnings: list[Any],
) -> tuple[Estimate, dict[str, Any]]:
    """Return the fit and the content of its result; warnings are added.

    The standard errors are the ones that its residual calls for.
    """
    from orthaug.analysis.robustness import robust_where_asked

    fields: dict[str, Any] = dict.fromkeys((*_UNKNOWN, "residuals", "missing_lags", "stability"))
    if fit.status.ok:
        one_step, free_run = responses[job.train.name]
        plain = fit
        fit = attempt(
            "the robust covariance", lambda: robust_where_asked(plain, one_step), warnings, plain
        )
        fields |= _physical_content(job, fit, warnings)
        fields["bias"] = attempt(
            "the bias by suspects", partial(_bias_of, job, fit), warnings, None
        )
        fields |= _analyse(fit, one_step, free_run, warnings)
    shared = _shared_of(job, fit, others=False)
    rows = parameter_rows(
        fit.problem.baseline.parameters,
        fit.theta if fit.status.ok else np.full(len(fit.theta), np.nan),
        fit.std,
        fit.interval,
        fit.one_step_theta,
        None if fit.plain_covariance is None else np.sqrt(np.diag(fit.plain_covariance)),
    )
    units = derived_units(
        fit.problem.baseline, fit.problem.record.outputs, fit.problem.record.inputs
    )
    rows = [
        row if row.unit else row.model_copy(update={"derived_unit": units.get(row.name)})
        for row in rows
    ]
    fields |= {
        "standard_errors": None
        if fit.std is None
        else "plain"
        if fit.plain_covariance is None
        else "robust",
        "standard_errors_by": None if fit.std_kind == "plain" else fit.std_kind,
        "measure_detail": fit.measure,
        "excitation": fit.excitation,
        "shared": shared,
    }
    warnings += _shared_warnings(job, fit) if fit.status.ok else ()
    budget = None
    if fit.status.ok:
        budget = attempt(
            "the bias that the learner implies", partial(_budget_of, job, fit), warnings, None
        )
    warnings += budget.warnings if budget else ()
    if fit.model.structure != "orthogonal":  # a variant, not the declared structure
        shared = None
    fields["parameters"] = _with_biases(
        rows, shared.determined if shared else None, budget, fit.at_bound
    )
    if fields["physical_parameters"] is not None:
        physical = shared.physical if shared else None
        fields["physical_parameters"] = _with_biases(
            fields["physical_parameters"], physical, budget
        )
    return fit, fields


def figures(
    job: LaggedJob,
    fit: Estimate,
    result: FitResult,
    responses: Mapping[str, tuple[Response, Response]],
) -> dict[str, Figure]:
    """Return the figures of a result by their names."""
    from orthaug.reports import finding_plots, plots

    last, structure = job.parts[-1].name, fit.model.structure
    one_step, free = responses[last]
    where = f"{last}, {structure}"
    drawn = {
        "prediction": plots.output_figure(one_step, f"one-step prediction, {where}"),
        "simulation": plots.output_figure(free, f"free run, {where}"),
        "residual": plots.residual_figure(one_step, f"one-step residual, {where}"),
    }
    if result.residuals is not None:
        units = {channel.name: channel.unit for channel in (*fit.model.inputs, *fit.model.outputs)}
        for kind, tests in (
            ("one-step", result.residuals.one_step),
            ("free-run", result.residuals.free_run),
        ):
            if tests is not None:
                title = f"{kind} residual on the training data, {structure}"
                figure = finding_plots.residual_analysis_figure(tests, title, units)
                drawn[f"residuals_{kind.replace('-', '_')}"] = figure
    if result.bias:
        drawn["bias"] = finding_plots.bias_figure(result.bias)
    if fit.learns:
        drawn["components"] = plots.components_figure(
            one_step, f"parts of the one-step prediction, {where}"
        )
    return drawn


def physics_alone(
    job: LaggedJob, fit: Estimate, responses: Mapping[str, tuple[Response, Response]]
) -> Mapping[str, Response]:
    """Return the free run of every part by the model's physics without its learner."""
    alone = fit.model.physics_only
    return {part.name: alone.simulate(part.record) for part in job.parts}


def _physical_content(job: LaggedJob, fit: Estimate, warnings: list[Any]) -> dict[str, Any]:
    """Return the physical parameters of θ̂ and their findings, where the spec has a map.

    Warnings are added.
    """
    if job.physics is None:
        return {}
    physical, profiles, slopes = fit.physical(job.physics), None, None
    warnings += physical.warnings
    if (
        job.spec.physics is not None
        and job.spec.physics.profile
        and physical.covariance is not None
    ):
        profiles = {name: fit.physical_profile(job.physics, name) for name in physical.names}
    if physical.sensitivities is not None:  # ∂ln p / ∂ln θ by name
        slopes = {
            name: dict(zip(job.physics.theta_names, row, strict=True))
            for name, row in zip(physical.names, physical.sensitivities, strict=True)
        }
    return {
        "physical_parameters": physical_rows(physical, profiles),
        "physical_consistency": physical.consistency,
        "sensitivities": slopes,
    }


def _analyse(
    fit: Estimate, one_step: Response, free_run: Response, warnings: list[Any]
) -> dict[str, Any]:
    """Return the findings on the residuals and the free run's sensitivity; warnings are added."""
    from orthaug.analysis.diagnosis import diagnose
    from orthaug.analysis.free_run_stability import stability
    from orthaug.analysis.missing_lags import missing_lags

    problem = fit.problem
    warnings += closed_loop(problem.record)
    return {
        "stability": attempt_warned(
            "the analysis of the free run's sensitivity",
            lambda: stability(fit.model, problem.record, response=free_run, x=problem.rows.x),
            warnings,
        ),
        "residuals": attempt_warned(
            "the analysis of the residual",
            lambda: diagnose(fit, one_step=one_step, free_run=free_run),
            warnings,
            _NOT_ANALYSED,
        ),
        "missing_lags": attempt_warned(
            "the search for missing lags", lambda: missing_lags(fit, one_step), warnings
        ),
    }


def _bias_of(job: LaggedJob, fit: Estimate | None = None) -> list[dict[str, Any]]:
    """Return the table of suspects under the spec's measure.

    After a fit it uses θ and what the learner explains.

    Before a fit it includes the usual suspects, since it shows which measure removes a bias.
    """
    if not job.problem.baseline.names:
        return []
    linearization = _linearization(job, fit)
    return bias_under(
        linearization,
        declare_suspects(job.spec.suspects, linearization.problem),
        certify_usual=fit is None,
    )


def _budget_of(job: LaggedJob, fit: Estimate) -> Budget | None:
    """Return the bias that what the learner found implies, under the spec's measure."""
    from orthaug.analysis.budget import budget_on

    if fit.model.structure != "orthogonal":
        return None
    linearization = _linearization(job, fit)
    return budget_on(linearization, fit, declare_suspects(job.spec.suspects, linearization.problem))


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


def _linearization(job: LaggedJob, fit: Estimate | None) -> MeasureLinearization:
    problem, weighed, structure = job.problem, job.weighed, job.spec.declared_structure()
    if fit is None:
        along = directions(structure, problem) if job.spec.declared_learner() is not None else None
        return MeasureLinearization(
            weighed, problem, problem.least_squares, job.physics, None, along
        )
    if fit.problem.weight.kind != problem.weight.kind:  # weighed by the errors that the fit left
        problem = fit.problem
        weighed = weigh_problem(job.measure, problem)
    learned = fit.model.learner_at(weighed.points.x) if fit.learns else None
    return MeasureLinearization(weighed, problem, fit.theta, job.physics, learned, fit.model.shared)


def _shared_warnings(job: LaggedJob, fit: Estimate | None = None) -> list[Warning]:
    """Return warnings on directions that are determined in name, but not beside the learner."""
    structure, problem = job.spec.declared_structure(), fit.problem if fit else job.problem
    if job.spec.declared_learner() is None or not structure.projects or structure.shared == "all":
        return []
    if not problem.baseline.names or not problem.features.entries:
        return []
    return shared_warnings(problem.shared, [str(entry) for entry in problem.features.entries])


def _shared_of(
    job: LaggedJob, fit: Estimate | None = None, *, others: bool = True
) -> Imitation | None:
    """Return what the learner could imitate, before training.

    None without a learner, or where the structure splits nothing along chosen directions.

    Args:
        fit: of the job's problem; None for the problem as it was posed.
        others: compute the effect of other learner inputs too.
    """
    structure = job.spec.declared_structure()
    if job.spec.declared_learner() is None or not structure.projects or structure.shared == "all":
        return None
    problem = fit.problem if fit else job.problem
    if not problem.baseline.names or not problem.features.entries:
        return None
    return imitation(problem, job.physics, others=others, held=tuple(fit.at_bound) if fit else ())
