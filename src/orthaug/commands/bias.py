"""The bias of a job's parameters by suspected terms, before a fit and after it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from orthaug.analysis.measure_bias import bias_under
from orthaug.commands.job import Job
from orthaug.commands.suspects import declared
from orthaug.inference.weighed import weigh_problem

if TYPE_CHECKING:
    from orthaug.fitting.estimates import Estimate


def bias_of(job: Job, fit: Estimate | None = None) -> list[dict[str, Any]]:
    """The table of suspects under the spec's measure; after a fit with its θ and what its learner explains.

    Whether a measure can remove a bias is asked before a fit: then it is answered for the usual suspects, too.
    """
    problem, weighed = job.problem, job.weighed
    if fit is not None and fit.problem.weight.kind != problem.weight.kind:  # weighed by the errors that the fit left
        problem, weighed = fit.problem, weigh_problem(job.measure, fit.problem)
    if not problem.baseline.names:
        return []
    suspects, theta = declared(job.spec.suspects, problem), None if fit is None else fit.theta
    learned = None
    if fit is not None and fit.model.form.bound is not None:
        learned = fit.model.learner_at(weighed.points.x)
    options: dict[str, Any] = {"physics": job.physics, "theta": theta, "learned": learned}
    return bias_under(weighed, problem, suspects, **options, certify_usual=fit is None)
