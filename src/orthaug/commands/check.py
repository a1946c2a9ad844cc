"""What `orthaug check` does: excitation, identifiability and what may bias; nothing is kept."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from orthaug._base.errors import InputError
from orthaug._base.folders import whole_file
from orthaug.commands.job import Job
from orthaug.commands.kinds import kind_of
from orthaug.reports.findings import SuspectResult
from orthaug.reports.result import CheckResult


def check_job(job: Job) -> CheckResult:
    """Excitation on the data, identifiability of the physics, and what else its kind can tell before training."""
    return kind_of(job).checked(job)


def refusal(job: Job, result: CheckResult) -> InputError | None:
    """Why the job cannot be fitted as it is; None where it can."""
    return kind_of(job).refused(job, result)


def write_figure(bias: Sequence[SuspectResult], out: Path, *, force: bool = False) -> None:
    """The heat map of the biases, whole or not at all."""
    from orthaug.reports import plots

    with whole_file(out, force=force) as partial:
        plots.save(plots.bias_figure(bias), partial, kind=out.suffix[1:].lower())
