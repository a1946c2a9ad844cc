"""The results of a job: what is found before training, the content and figures of a fit."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug.analysis.closed_loop import closed_loop
from orthaug.commands.attempt import attempt
from orthaug.commands.job import Job
from orthaug.reports.result import CheckResult, FitResult, ParameterResult, parameter_rows

if TYPE_CHECKING:
    from orthaug.models.response import Response
    from orthaug.reports.drawing import Figure

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


def check(job: Job) -> CheckResult:
    """Return the findings before training: excitation, identifiability, possible biases.

    Nothing is stored.
    """
    found, warnings = job.physics.check(job)
    return CheckResult.model_validate(
        {
            "data": job.data,
            "parameters": job.problem.names,
            "regressor": [str(entry) for entry in job.problem.layout],
            "rows": job.problem.count,
            **found,
            "warnings": [*job.warnings, *warnings, *closed_loop(job.train.record)],
        }
    )


def content(
    job: Job,
    fit: Any,
    responses: Mapping[str, tuple[Response, Response]],
    warnings: list[Any],
) -> tuple[Any, dict[str, Any]]:
    """Return the fit and the content of its result; warnings are added.

    The standard errors are the ones that its residual calls for.
    """
    fields: dict[str, Any] = dict.fromkeys(_FINDINGS) | job.physics.describe(fit)
    budget = None
    if fit.status.ok:
        plain, (one_step, free_run) = fit, responses[job.train.name]
        fit = attempt(
            "the robust covariance", lambda: job.physics.robust(plain, one_step), warnings, plain
        )
        warnings += closed_loop(job.train.record)
        fields |= job.physics.analyse(job, fit, one_step, free_run, warnings)
        budget = fields.pop("budget")
    shared, of_shared = job.physics.shared(job, fit)
    warnings += of_shared
    split = fit.model.structure == "orthogonal" and fit.learns
    imitable = shared if split else None  # of the others the split has no directions
    rows = _with_biases(
        _parameters(fit), imitable and imitable.determined, budget, held=fit.at_bound
    )
    physical = fields["physical_parameters"]
    if physical is not None:
        physical = _with_biases(physical, imitable and imitable.physical, budget)
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


def figures(
    job: Job,
    fit: Any,
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
    }
    found = result.residuals
    units = {channel.name: channel.unit for channel in (*fit.model.inputs, *fit.model.outputs)}
    for name, tests in (
        ("one-step", found and found.one_step),
        ("free-run", found and found.free_run),
    ):
        if tests:
            title = f"{name} residual on the training data, {structure}"
            drawn[f"residuals_{name.replace('-', '_')}"] = finding_plots.residual_analysis_figure(
                tests, title, units
            )
    if result.bias:
        drawn["bias"] = finding_plots.bias_figure(result.bias)
    return drawn | job.physics.figures(job, fit, responses)


def physics_alone(
    job: Job, fit: Any, responses: Mapping[str, tuple[Response, Response]]
) -> Mapping[str, Response]:
    """Return the free run of every part by the model's physics without its learner."""
    return {
        part.name: job.physics.run_alone(fit, part.record, responses[part.name][1])
        for part in job.parts
    }


def _parameters(fit: Any) -> list[ParameterResult]:
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
    budget: Any,
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
