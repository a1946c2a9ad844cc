"""The kinds of jobs: lagged physics and motions, a module for each, and which one a spec opens."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from orthaug._base.errors import InputError
from orthaug.commands import lagged_kind, motion_kind
from orthaug.commands.job import Job
from orthaug.commands.lagged_job import LaggedJob, open_lagged
from orthaug.commands.motion_job import MotionJob, open_motion
from orthaug.commands.spec import load_spec
from orthaug.reports.result import CheckResult, FitResult

if TYPE_CHECKING:
    from orthaug.models.response import Response
    from orthaug.reports.drawing import Figure


@runtime_checkable
class Kind(Protocol):
    """Interface of the module of a kind of job."""

    def check(self, job: Any) -> CheckResult:
        """Return the findings before training: excitation, identifiability, possible biases.

        Nothing is stored.
        """
        ...

    def refusal(self, job: Any, result: CheckResult) -> InputError | None:
        """Return the reason why the job cannot be fitted, after the report; None where it can."""
        ...

    def content(
        self,
        job: Any,
        fit: Any,
        responses: Mapping[str, tuple[Response, Response]],
        warnings: list[Any],
    ) -> tuple[Any, dict[str, Any]]:
        """Return the fit as it is handed over, and the content of its result; warnings are added.

        The content has the keys that differ between the kinds.
        """
        ...

    def figures(
        self,
        job: Any,
        fit: Any,
        result: FitResult,
        responses: Mapping[str, tuple[Response, Response]],
    ) -> dict[str, Figure]:
        """Return the figures of a result by their names."""
        ...

    def physics_alone(
        self, job: Any, fit: Any, responses: Mapping[str, tuple[Response, Response]]
    ) -> Mapping[str, Response]:
        """Return the free run of every part by the model's physics without its learner."""
        ...


_KINDS: dict[type[Job], Kind] = {LaggedJob: lagged_kind, MotionJob: motion_kind}


def kind_of(job: Job) -> Kind:
    """Return the module for the kind of a job."""
    return _KINDS[type(job)]


def open_job(path: Path, *, require_full_rank: bool = True) -> Job:
    """Read the spec and all its data, and pose the problem.

    Args:
        require_full_rank: refuse physics that is linear in θ and rank-deficient on the data.

    Raises:
        InputError: anything wrong with spec, files or physics; one line that names it.
    """
    spec = load_spec(path)
    if spec.motion is not None:
        return open_motion(path, spec)
    return open_lagged(path, spec, require_full_rank=require_full_rank)
