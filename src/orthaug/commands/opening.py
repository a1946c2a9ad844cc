"""Specs become jobs."""

from __future__ import annotations

from pathlib import Path

from orthaug.commands.job import Job
from orthaug.commands.lagged_job import open_lagged
from orthaug.commands.motion_job import open_motion
from orthaug.commands.spec import load_spec


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
