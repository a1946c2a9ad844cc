"""The page of a result: what it tells beside result.json, such as free runs, and where and how it was made."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shlex
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Protocol

from orthaug import __version__
from orthaug._base.errors import InputError
from orthaug.commands.job import Job
from orthaug.commands.kinds import kind_of
from orthaug.commands.spec import load_spec
from orthaug.reports.page import compare_page, fit_page
from orthaug.reports.page_compare import ComparePage
from orthaug.reports.page_fit import FitPage, Origin

if TYPE_CHECKING:
    from orthaug.models.response import Response
    from orthaug.reports.result import CompareResult, FitResult

_TOLD = ("jax", "numpy", "scipy")  # packages whose versions move numbers


class HasFit(Protocol):
    """What a page is made of: `Fitted`."""

    @property
    def job(self) -> Job: ...
    @property
    def fit(self) -> Any: ...
    @property
    def result(self) -> FitResult: ...
    @property
    def responses(self) -> Mapping[str, tuple[Response, Response]]: ...


class HasFits(Protocol):
    """What a page of several is made of: `Comparison`."""

    @property
    def job(self) -> Job: ...
    @property
    def fitted(self) -> Mapping[str, HasFit]: ...
    @property
    def result(self) -> CompareResult: ...


def fit_report(fitted: HasFit, origin: Origin | None = None) -> str:
    """The page of a fit that has a model; `origin` is where it comes from, None for its spec."""
    job, fit, kind = fitted.job, fitted.fit, kind_of(fitted.job)
    alone = kind.physics_alone(job, fit, fitted.responses)
    page = FitPage(origin or origin_of(job, "fit"), fitted.result, fitted.responses, alone, kind.learned(job, fit))
    return fit_page(page)


def compare_report(comparison: HasFits) -> str:
    """The page of a comparison."""
    responses: dict[str, Mapping[str, Response]] = {
        name: {part: free for part, (_, free) in fitted.responses.items()}
        for name, fitted in comparison.fitted.items()
        if fitted.responses
    }
    return compare_page(ComparePage(origin_of(comparison.job, "compare"), comparison.result, responses))


def origin_of(job: Job, command: str) -> Origin:
    """Where a result of a job comes from. SOURCE_DATE_EPOCH, where it is set, is the date."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    now = datetime.fromtimestamp(int(epoch), UTC) if epoch.isdigit() else datetime.now(UTC)
    versions = {"orthaug": __version__, "Python": platform.python_version()}
    versions |= {name: importlib.metadata.version(name) for name in _TOLD}
    return Origin(
        name=job.path.stem,
        toml=_toml(job),
        command=shlex.join(("orthaug", *(job.arguments or (command, job.path.name)))),
        date=now.strftime("%Y-%m-%d %H:%M UTC"),
        machine=f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        versions=versions,
        seed=job.spec.training.seed,
    )


def _toml(job: Job) -> str:
    """The spec as it was written; where its file is another one by now, what was read of it."""
    import tomlkit

    try:
        text = job.path.read_text(encoding="utf-8-sig")
        if load_spec(job.path).model_dump(mode="json", exclude_unset=True) == job.declaration:
            return text
    except (InputError, OSError, UnicodeDecodeError):
        pass
    return tomlkit.dumps(_without_none(job.declaration))


def _without_none(content: Any) -> Any:
    """TOML has no null."""
    if isinstance(content, dict):
        return {key: _without_none(value) for key, value in content.items() if value is not None}
    return [_without_none(value) for value in content] if isinstance(content, list) else content
