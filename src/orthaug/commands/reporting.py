"""The page of a result: what it tells beside result.json, such as free runs, and where and how it was made."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from orthaug import __version__
from orthaug.commands.job import Job
from orthaug.commands.kinds import kind_of
from orthaug.reports.page import compare_page, fit_page
from orthaug.reports.page_compare import ComparePage
from orthaug.reports.page_fit import FitPage, Origin

if TYPE_CHECKING:
    from orthaug.commands.compare import Comparison
    from orthaug.commands.fit import Fitted
    from orthaug.models.response import Response

_TOLD = ("jax", "numpy", "scipy")  # packages whose versions move numbers


def fit_report(fitted: Fitted) -> str:
    """The page of a fit that has a model."""
    job, fit, kind = fitted.job, fitted.fit, kind_of(fitted.job)
    alone = kind.physics_alone(job, fit, fitted.responses)
    page = FitPage(origin_of(job, "fit"), fitted.result, fitted.responses, alone, kind.learned(job, fit))
    return fit_page(page)


def compare_report(comparison: Comparison) -> str:
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
        toml=job.path.read_text(encoding="utf-8-sig"),
        command=f"orthaug {command} {job.path.name}",
        date=now.strftime("%Y-%m-%d %H:%M UTC"),
        machine=f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        versions=versions,
        seed=job.spec.training.seed,
    )
