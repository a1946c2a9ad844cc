"""The bias of a job's parameters by suspected terms, before a fit and after it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from orthaug._base.warning import Warning
from orthaug.analysis.measure_bias import Ground, bias_under
from orthaug.commands.lagged_job import LaggedJob, structure_of
from orthaug.commands.suspects import declared
from orthaug.fitting.elimination import directions
from orthaug.inference.measures import weigh_problem

if TYPE_CHECKING:
    from orthaug.analysis.budget import Budget
    from orthaug.analysis.imitation import Imitation
    from orthaug.fitting.estimates import Estimate
    from orthaug.reports.result import ParameterResult


def bias_of(job: LaggedJob, fit: Estimate | None = None) -> list[dict[str, Any]]:
    """The table of suspects under the spec's measure; after a fit with its θ and what its learner explains.

    Whether a measure can remove a bias is asked before a fit: then it is answered for the usual suspects, too.
    """
    if not job.problem.baseline.names:
        return []
    ground = _ground(job, fit)
    return bias_under(ground, declared(job.spec.suspects, ground.problem), certify_usual=fit is None)


def budget_of(job: LaggedJob, fit: Estimate) -> Budget | None:
    """The bias that what the learner found implies, under the spec's measure."""
    from orthaug.analysis.budget import budget_on

    if fit.model.structure != "orthogonal" or fit.model.form.bound is None:
        return None
    ground = _ground(job, fit)
    return budget_on(ground, fit, declared(job.spec.suspects, ground.problem))


def with_biases(
    fit: Estimate, shared: Imitation | None, content: Mapping[str, Any], budget: Budget | None
) -> tuple[dict[str, list[ParameterResult] | None], tuple[Warning, ...]]:
    """The rows of `parameters` and `physical_parameters` with what the learner shares and what biases them."""
    physical = content["physical_parameters"]
    if fit.model.structure != "orthogonal" or fit.model.form.bound is None:  # a variant of what the spec declares
        shared = None

    def told(rows: list[ParameterResult] | None, determined: Sequence[str] | None) -> list[ParameterResult] | None:
        if rows is None:
            return None
        return [
            row.told(
                None if determined is None else row.name not in determined, budget.of(row.name) if budget else None
            )
            for row in rows
        ]

    rows = {
        "parameters": told(content["parameters"], shared.determined if shared else None),
        "physical_parameters": told(physical, shared.physical if shared else None),
    }
    return rows, budget.warnings if budget else ()


def _ground(job: LaggedJob, fit: Estimate | None) -> Ground:
    problem, weighed, structure = job.problem, job.weighed, structure_of(job.spec)
    if fit is None:
        along = directions(structure, problem) if job.spec.declared_learner() is not None else None
        return Ground(weighed, problem, problem.least_squares, job.physics, None, along)
    if fit.problem.weight.kind != problem.weight.kind:  # weighed by the errors that the fit left
        problem = fit.problem
        weighed = weigh_problem(job.measure, problem)
    learned = None
    if fit.model.form.bound is not None:
        learned = fit.model.learner_at(weighed.points.x)
    return Ground(weighed, problem, fit.theta, job.physics, learned, fit.model.shared)
