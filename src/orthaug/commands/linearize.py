"""A saved model as linear systems: what `orthaug linearize` does."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from orthaug._base.errors import InputError
from orthaug._base.folders import check_replaceable, whole_file, whole_folder
from orthaug.commands.folder import check_figure, check_file, check_kept, save_figure
from orthaug.commands.parts import load_parts
from orthaug.commands.run import ReadOptions, missing_notes, open_run, prepared_notes
from orthaug.commands.spec import load_spec
from orthaug.data.record import Record

if TYPE_CHECKING:
    from orthaug.analysis.linear_view import Linearization
    from orthaug.models.model import Model

_PREPARED = "Operating points are those of data after these steps."
_FIGURES = (".png", ".pdf", ".svg")


def check_place(out: Path | None, *read: Path, force: bool = False) -> None:
    """Raise InputError early where the output cannot be written, or would replace an input."""
    if out is None:
        return
    suffix = out.suffix.lower()
    for folder in read:
        if folder.is_dir() and out.resolve().is_relative_to(folder.resolve()):
            raise InputError(f"{out}: is inside of {folder}, which is read; give another name.")
    if suffix in _FIGURES:
        check_figure(out, *read, force=force)
    elif suffix == ".json":
        check_file(out, *read, force=force)
    elif suffix in (".txt", ".csv", ".toml", ".html"):
        raise InputError(
            f"{out}: found the ending '{out.suffix}'; give a folder, or .json, .png, .pdf or .svg."
        )
    else:
        check_replaceable(out, force=force)
        check_kept(out, *read)


def open_linear(model: Path, data: Path | None) -> tuple[Model, Record | None, tuple[str, ...]]:
    """Return the model, the record of a data file or of the training data of a spec, and notes.

    Raises:
        InputError: no model, no file, missing columns.
    """
    if data is None:
        from orthaug.models.storage import load

        loaded = load(model)
        return loaded, None, prepared_notes(loaded, what=_PREPARED)
    if data.suffix.lower() != ".toml":
        opened = open_run(model, data, need_outputs=True, reading=ReadOptions("auto", prepare=True))
        notes = missing_notes(opened.model, data, opened.record)
        return opened.model, opened.record, (*prepared_notes(opened.model, what=_PREPARED), *notes)
    from orthaug.models.storage import load

    loaded = load(model)
    record = load_parts(data, load_spec(data))[0].record
    try:
        record = loaded.fitting(record, need_outputs=True)
    except InputError as error:
        raise InputError(f"{data}: {error}") from None
    notes = prepared_notes(loaded, what=_PREPARED)
    return loaded, record, (*notes, *missing_notes(loaded, data, record))


def write(found: Linearization, out: Path, *, force: bool = False) -> None:
    """Write a folder with result.json, linear.txt and figures/.

    Or write one file, by its ending JSON or the frequency response.

    Whole or not at all.
    """
    from orthaug.reports.linear import LinearizeResult

    suffix, content = out.suffix.lower(), LinearizeResult.of(found).to_json() + "\n"
    if suffix == ".json":
        with whole_file(out, force=force) as partial:
            partial.write_text(content, encoding="utf-8")
        return
    from orthaug.reports.drawing import save
    from orthaug.reports.linear_plots import bode_figure, poles_figure
    from orthaug.reports.linear_text import linear_text

    if suffix in _FIGURES:
        if not found[0].inputs:
            raise InputError(
                "the model has no inputs, so that it has no frequency response to draw; give a "
                "folder."
            )
        save_figure(bode_figure(found), out, force=force)
        return
    with whole_folder(out, force=force) as partial:
        (partial / "result.json").write_text(content, encoding="utf-8")
        (partial / "linear.txt").write_text(linear_text(found) + "\n", encoding="utf-8")
        (partial / "figures").mkdir()
        if found[0].inputs:
            save(bode_figure(found), partial / "figures" / "bode.png")
        save(poles_figure(found), partial / "figures" / "poles.png")


def output_text(found: Linearization, *, as_json: bool) -> str:
    """Return the text that the command prints."""
    from orthaug.reports.linear import LinearizeResult
    from orthaug.reports.linear_text import linear_text

    return LinearizeResult.of(found).to_json() if as_json else linear_text(found)
