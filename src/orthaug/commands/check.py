"""What `orthaug check` does: excitation, identifiability and suspected biases; nothing is trained."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from orthaug._base.folders import whole_file
from orthaug.commands.bias import bias_of
from orthaug.commands.job import Job
from orthaug.commands.shared import shared_of
from orthaug.physics.excitation import identifiability
from orthaug.reports.findings import SuspectResult
from orthaug.reports.result import CheckResult


def check_job(job: Job) -> CheckResult:
    """Excitation on the data, identifiability of the physics, and what each suspect would do to θ."""
    problem = job.problem
    return CheckResult.model_validate(
        {
            "data": job.data,
            "parameters": problem.baseline.names,
            "regressor": [str(lag) for lag in problem.layout],
            "rows": len(problem.rows),
            "excitation": problem.excitation,
            "identifiability": identifiability(problem.baseline, problem.layout, problem.outputs, problem.rows.x),
            "shared": shared_of(job),
            "bias": bias_of(job) if problem.excitation.full_rank else None,
            "warnings": job.warnings,
        }
    )


def write_figure(bias: Sequence[SuspectResult], out: Path, *, force: bool = False) -> None:
    """The heat map of the biases, whole or not at all."""
    from orthaug.reports import plots

    with whole_file(out, force=force) as partial:
        plots.save(plots.bias_figure(bias), partial, kind=out.suffix[1:].lower())
