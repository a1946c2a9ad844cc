"""Where and how a result was made, for its page."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shlex
from datetime import UTC, datetime
from typing import Any

from orthaug import __version__
from orthaug._base.errors import InputError
from orthaug.commands.job import Job
from orthaug.commands.spec import load_spec
from orthaug.reports.page_fit import Origin

_TOLD = ("jax", "numpy", "scipy")  # packages whose versions move numbers


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
