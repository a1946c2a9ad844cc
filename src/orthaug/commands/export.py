"""Saved models as code: what `orthaug export` does."""

from __future__ import annotations

from pathlib import Path

from orthaug._base.errors import InputError
from orthaug.commands.run import prepared_notes
from orthaug.data.preparation import MENDING
from orthaug.export import exporting


def check(model: Path, to: str, out: Path, name: str, *, force: bool = False) -> None:
    """Raise InputError for an unknown target or place, or one that would replace the model."""
    exporting.check_export(to, out, name, force=force)
    try:
        inside = model.exists() and model.resolve().is_relative_to(out.resolve())
    except OSError as error:
        raise InputError(f"{model}: cannot be read ({error.strerror}).") from None
    if inside:
        raise InputError(f"{out}: holds the model {model}, which is exported; give another folder.")


def run(model: Path, to: str, out: Path, name: str, *, force: bool = False) -> tuple[str, ...]:
    """Load the model and write the folder; return notes on the code.

    Raises:
        InputError: no model there, or one that has no code.
    """
    from orthaug.models.storage import load

    loaded = load(model)
    try:
        exporting.export(loaded, out, to, name=name, force=force)
    except InputError as error:
        own = str(error).startswith(str(out))
        raise InputError(str(error) if own else f"{model}: {error}") from None
    what = (
        "The code expects data after these steps: it does not contain a delay by `shift`, for "
        "example."
    )
    return (
        prepared_notes(loaded, what=what)
        if any(done.step not in MENDING for done in loaded.prepared)
        else ()
    )
