"""Checks of the places where commands write, made before anything is computed."""

from __future__ import annotations

import json
from pathlib import Path

from orthaug._base.errors import InputError
from orthaug._base.folders import check_replaceable
from orthaug.commands.job import Job


def is_result(folder: Path) -> bool:
    """Whether a folder holds a result that orthaug wrote."""
    try:
        content = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and "schema" in content and "orthaug" in content


def check_folder(folder: Path) -> None:
    """Raise InputError early where the result could not be written."""
    check_replaceable(folder, is_result)


def check_inputs_kept(job: Job, folder: Path) -> None:
    """Raise InputError where the result would take the place of a file that the job reads."""
    for file in job.files:
        if file.resolve().is_relative_to(folder.resolve()):
            raise InputError(f"{folder}: holds {file.name}, which this fit reads; give another folder.")


def check_file(out: Path | None, *read: Path) -> None:
    """Raise InputError early where a file could not be written, or is one of those that are read."""
    if out is None:
        return
    try:
        if any(file.exists() and out.exists() and out.samefile(file) for file in read):
            raise InputError(f"{out}: is read by this run; give another name.")
        if out.is_dir() or not out.name:
            raise InputError(f"{out}: is a folder; expected the name of a CSV file.")
        if not out.absolute().parent.is_dir():
            raise InputError(f"{out}: cannot be written; there is no folder {out.parent}.")
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}).") from None
