"""What a job's learner could imitate of the physics."""

from __future__ import annotations

from orthaug.analysis.imitation import Imitation, imitation
from orthaug.commands.lagged_job import LaggedJob, structure_of


def shared_of(job: LaggedJob, *, others: bool = True) -> Imitation | None:
    """Before training already; None without a learner, or where the structure splits nothing along chosen directions.

    Args:
        others: tell what other learner inputs would make of it.
    """
    structure = structure_of(job.spec)
    if job.spec.declared_learner() is None or not structure.projects or structure.shared == "all":
        return None
    return imitation(job.problem, job.physics, others=others) if job.problem.baseline.names else None
