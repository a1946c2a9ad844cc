"""The places where commands write: checked before anything is computed."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthaug._base.checks import check_choice
from orthaug._base.errors import InputError
from orthaug._base.folders import check_new_file, check_replaceable, remember, whole_file
from orthaug.commands.job import Job, date_of_results

if TYPE_CHECKING:
    from orthaug.reports.drawing import Figure

PHYSICS = "model-physics"
"""The folder of physics alone in a result folder."""


def chosen_model(model: Path, which: str) -> Path:
    """Return the folder of the model that a command runs.

    It is the fitted one, or `physics`: the one without a learner.

    Raises:
        InputError: neither of these, or a fit that has no physics alone beside its model.
    """
    check_choice(which, ("fitted", "physics"), "--model")
    if which == "fitted":
        return model
    whole = model.parent if model.name == "model" else model
    if not (whole / PHYSICS).is_dir():
        raise InputError(
            f"{whole}: holds no {PHYSICS}; expected a result of `orthaug fit` with a learner, "
            "or no --model physics."
        )
    return whole / PHYSICS


def results_beside(model: Path) -> Iterator[Any]:
    """Yield what is read from result.json in the folder of a model, or the one above.

    The caller has to check its content.
    """
    for folder in (model, model.parent):
        with suppress(OSError, ValueError, RecursionError):
            yield json.loads((folder / "result.json").read_text(encoding="utf-8"))


def save_json(result: Any, folder: Path) -> None:
    """Write the result of a command as the result.json of its folder."""
    (folder / "result.json").write_text(result.to_json() + "\n", encoding="utf-8")


def check_folder(folder: Path, *, force: bool = False) -> None:
    """Raise InputError early where the result could not be written."""
    date_of_results()
    check_replaceable(folder, force=force)
    remember(folder)


def check_inputs_kept(job: Job, folder: Path, models: Iterable[Path] = ()) -> None:
    """Raise InputError where the result would replace a file or model that the job reads."""
    for file in (*job.files, *models):
        if file.resolve().is_relative_to(folder.resolve()):
            what = file.name if file in job.files else f"the model {file}"
            raise InputError(f"{folder}: holds {what}, which this fit reads; give another folder.")


def check_kept(folder: Path, *read: Path) -> None:
    """Raise InputError where a result folder would replace what is read."""
    for path in read:
        try:
            inside = path.exists() and path.resolve().is_relative_to(folder.resolve())
        except (OSError, ValueError):  # reading it will say what is wrong
            continue
        if inside:
            raise InputError(f"{folder}: holds {path}, which is read; give another folder.")


def check_file(out: Path | None, *read: Path, force: bool = False) -> None:
    """Raise InputError early where a file cannot be written, exists, or is one of those read."""
    if out is None:
        return
    try:
        for file in read:
            inside = file.is_dir() and out.exists() and out.resolve().is_relative_to(file.resolve())
            if inside or (file.exists() and out.exists() and out.samefile(file)):
                raise InputError(f"{out}: is read by this run; give another name.")
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}).") from None
    check_new_file(out, force=force)


def check_figure(out: Path | None, *read: Path, force: bool = False) -> None:
    """Check the file of a figure as `check_file` does, and that its ending is a known format."""
    if out is not None and out.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise InputError(f"{out}: found the ending '{out.suffix}'; expected .png, .pdf or .svg.")
    check_file(out, *read, force=force)


def save_figure(figure: Figure, out: Path, *, force: bool = False) -> None:
    """Write the figure in the format of its ending, whole or not at all."""
    from orthaug.reports.drawing import save

    with whole_file(out, force=force) as partial:
        save(figure, partial, out.suffix[1:].lower())


def relative(file: Path, folder: Path) -> str:
    """Return a file as a spec in the folder names it."""
    try:
        return Path(os.path.relpath(file.resolve(), folder.resolve())).as_posix()
    except ValueError:  # on another drive
        return file.resolve().as_posix()
