"""The results of a job: what is found before training, the content and figures of a fit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from orthaug.analysis.closed_loop import closed_loop, without_exchanged
from orthaug.analysis.equation_units import equation_units
from orthaug.analysis.informative_data import few_frequencies
from orthaug.commands.job import Job
from orthaug.reports.result import CheckResult, FitResult

if TYPE_CHECKING:
    from orthaug.fitting.estimates import Estimate
    from orthaug.models.response import Response
    from orthaug.reports.drawing import Figure


def check(job: Job) -> CheckResult:
    """Return the findings before training: excitation, identifiability, possible biases.

    Nothing is stored.
    """
    found, warnings = job.physics.check(job)
    looped = closed_loop(job.train.record, job.evidence.method())
    return CheckResult.model_validate(
        {
            "data": job.data,
            "parameters": job.problem.names,
            "regressor": [str(entry) for entry in job.problem.layout],
            "rows": job.problem.count,
            **found,
            "warnings": [
                *without_exchanged([*job.warnings, *warnings], looped),
                *looped,
                *equation_units(job.train.record, job.problem.physics),
                *few_frequencies(job.train.record, len(job.problem.names)),
            ],
        }
    )


def figures(
    job: Job,
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
    }
    found = result.residuals
    units = fit.model.units
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
    job: Job, fit: Estimate, responses: Mapping[str, tuple[Response, Response]]
) -> Mapping[str, Response]:
    """Return the free run of every part by the model's physics without its learner."""
    return {
        part.name: job.physics.run_alone(fit, part.record, responses[part.name][1])
        for part in job.parts
    }
