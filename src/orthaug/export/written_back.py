"""Estimates of a motion whose physics come from a file, as the program of that file takes them.

What a learner adds is not among them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from orthaug._base.errors import InputError
from orthaug._base.folders import whole_folder
from orthaug.models.model import Model
from orthaug.physics.source_kinds import SOURCES
from orthaug.physics.sources import FileSource


def targets() -> tuple[str, ...]:
    """Return the targets of all sources that can write estimates back."""
    found = (getattr(source, "target", "") for source in SOURCES.values())
    return tuple(target for target in found if target)


def write_back(model: Model, folder: Path, to: str, *, force: bool = False) -> None:
    """Write the estimates into a folder.

    Raises:
        InputError: a model whose physics are not of the kind that the target is for.
    """
    motion: Any = getattr(model.form, "motion", None)
    source: Any = getattr(motion, "source", None)
    if motion is None or not isinstance(source, FileSource) or source.target != to:
        own = f"; its own is {source.target}" if isinstance(source, FileSource) else ""
        raise InputError(f"the physics do not come from a file that {to} writes{own}.")
    values = np.asarray(motion.coordinates.physical(np.asarray(model.numbers.theta))).tolist()
    units = {parameter.name: parameter.unit for parameter in motion.parameters}
    files = source.write_back(dict(zip(motion.names, values, strict=True)), units)
    with whole_folder(folder, force=force) as partial:
        for name, content in files.items():
            (partial / name).write_text(content, encoding="utf-8")
