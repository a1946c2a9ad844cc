"""What suspected terms would do to the parameters of a job, before a fit and after it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from orthaug.analysis.suspicion import suspected
from orthaug.commands.job import Job
from orthaug.inference.measures import Support

if TYPE_CHECKING:
    from orthaug.fitting.estimates import Estimate


def bias_of(job: Job, fit: Estimate | None = None) -> list[dict[str, Any]]:
    """The table of suspects under the spec's measure; after a fit with its θ and what its learner explains."""
    if fit is None:
        return suspected(job)
    if fit.model.form.bound is None:
        return suspected(job, fit.theta)
    points = job.measure.points(Support(job.train.record, job.problem.layout, job.used))
    return suspected(job, fit.theta, fit.model.learner_at(points.x))
