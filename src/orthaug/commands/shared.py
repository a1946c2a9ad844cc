"""What a job's learner could imitate of the physics."""

from __future__ import annotations

from orthaug.analysis.imitation import Imitation, imitation
from orthaug.commands.lagged_job import LaggedJob, structure_of
from orthaug.physics.problem import Problem


def shared_of(job: LaggedJob, problem: Problem | None = None, *, others: bool = True) -> Imitation | None:
    """Before training already; None without a learner, or where the structure splits nothing along chosen directions.

    Args:
        problem: the job's, as it was fitted; None for as it was posed.
        others: tell what other learner inputs would make of it.
    """
    structure = structure_of(job.spec)
    if job.spec.declared_learner() is None or not structure.projects or structure.shared == "all":
        return None
    problem = job.problem if problem is None else problem
    return (
        imitation(problem, job.physics, others=others) if problem.baseline.names and problem.features.entries else None
    )
