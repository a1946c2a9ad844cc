"""The kinds of jobs, and what is told of each: one module for lagged physics, one for motions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from orthaug._base.errors import InputError
from orthaug.commands import lagged_kind, motion_kind
from orthaug.commands.job import Job
from orthaug.commands.lagged_job import LaggedJob
from orthaug.commands.motion_job import MotionJob
from orthaug.reports.result import CheckResult, FitResult

if TYPE_CHECKING:
    from orthaug.models.response import Response
    from orthaug.reports.drawing import Figure
    from orthaug.reports.learned_part import LearnedPart


@runtime_checkable
class Kind(Protocol):
    """What a module of a kind has."""

    def checked(self, job: Any) -> CheckResult:
        """What can be said before training."""
        ...

    def refused(self, job: Any, result: CheckResult) -> InputError | None:
        """Why the job cannot be fitted, after the report; None where it can."""
        ...

    def content(
        self, job: Any, fit: Any, responses: Mapping[str, tuple[Response, Response]], warnings: list[Any]
    ) -> tuple[Any, dict[str, Any]]:
        """The fit as it is handed over, and what results tell of it beside what all kinds do; warnings are added."""
        ...

    def figures(
        self, job: Any, fit: Any, result: FitResult, responses: Mapping[str, tuple[Response, Response]]
    ) -> dict[str, Figure]:
        """The figures of a result by their names."""
        ...

    def physics_alone(
        self, job: Any, fit: Any, responses: Mapping[str, tuple[Response, Response]]
    ) -> Mapping[str, Response]:
        """The free run of every part by the physics without the learner; empty where nothing was learned."""
        ...

    def learned(self, job: Any, fit: Any) -> LearnedPart | None:
        """What was learned, as a function; None where nothing was."""
        ...


_KINDS: dict[type[Job], Kind] = {LaggedJob: lagged_kind, MotionJob: motion_kind}


def kind_of(job: Job) -> Kind:
    """What tells of a job."""
    return _KINDS[type(job)]
