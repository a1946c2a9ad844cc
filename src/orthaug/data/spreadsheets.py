"""Excel workbooks: the first worksheet as columns of cells."""

from __future__ import annotations

import functools
import re
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import iterparse

import numpy as np

from orthaug._base.errors import InputError, shown
from orthaug._base.memory import check_memory

_ROWS, _COLUMNS = 1_048_576, 16_384  # of a sheet at most
Place = Callable[[Sequence[str]], Sequence[int]]
_PROLOGUE = 4096  # bytes of a part in which a document type would stand


def read_sheet(path: Path, place: Place) -> tuple[int, list[list[Any]]]:
    """The row of the header, counted from 1, and the cells below it in the columns that `place` finds in the header.

    The first row that holds anything is the header. A cell that is not there is None.

    Raises:
        InputError: no openpyxl, an encrypted file, no worksheet, an empty one, entities, more than fits into memory.
    """
    try:
        import openpyxl
    except ImportError:
        raise InputError(f"{path}: reading Excel needs openpyxl; install orthaug[excel].") from None
    with path.open("rb") as file:
        _check_parts(path, file)
        book = openpyxl.load_workbook(file, read_only=True, data_only=True)
        try:
            if not book.worksheets:
                raise InputError(f"{path}: the workbook has no worksheet with cells.")
            sheet = book.worksheets[0]
            _check_order(path, sheet)
            _check_strings(path, sheet)
            return _pick(path, sheet, place)
        finally:
            book.close()


def _check_parts(path: Path, file: Any) -> None:
    """Raise InputError for a workbook that is encrypted, too large, or declares entities."""
    if file.read(8) == b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1":
        raise InputError(
            f"{path}: an encrypted workbook, or one of Excel 97 (.xls); save it as .xlsx without password."
        )
    with zipfile.ZipFile(file) as archive:
        check_memory(4 * sum(info.file_size for info in archive.infolist()), f"{path}: reading the workbook")
        for info in archive.infolist():
            with archive.open(info) as part:
                if b"<!DOCTYPE" in part.read(_PROLOGUE):
                    raise InputError(f"{path}: '{info.filename}' declares a document type, which no workbook has.")
    file.seek(0)


def _check_order(path: Path, sheet: Any) -> None:
    """Raise InputError unless rows and cells follow each other: openpyxl would leave out what does not."""
    row, column = 0, 0
    with sheet._get_source() as source:
        for event, element in iterparse(source, ("start", "end")):
            kind = element.tag.rpartition("}")[2]
            if event == "start" and kind == "row":
                before, row, column = row, int(element.get("r", row + 1)), 0
                if not before < row <= _ROWS:
                    raise InputError(f"{path}: the rows of the sheet are out of order at row {shown(row)}.")
            elif event == "start" and kind == "c":
                place = element.get("r")
                there = (row, column + 1) if place is None else _place(place)
                if there[0] != row or not column < there[1] <= _COLUMNS:
                    raise InputError(f"{path}: the cells of the sheet are out of order at '{place}'.")
                column = there[1]
            elif event == "end" and kind == "row":
                element.clear()


def _place(name: str) -> tuple[int, int]:
    """Row and column, counted from 1, of a cell such as `B7`; of no cell (0, 0)."""
    found = re.fullmatch(r"([A-Z]{1,3})([1-9][0-9]{0,6})", name)
    if found is None:
        return 0, 0
    return int(found[2]), functools.reduce(lambda total, letter: 26 * total + ord(letter) - 64, found[1], 0)


class _Strings(tuple[str, ...]):
    """The shared texts, of which a negative index names none."""

    def __getitem__(self, index: Any) -> Any:
        if index < 0:
            raise IndexError(f"there is no shared text {index}")
        return super().__getitem__(index)


def _check_strings(path: Path, sheet: Any) -> None:
    if hasattr(sheet, "_shared_strings"):
        sheet._shared_strings = _Strings(sheet._shared_strings or ())


def _pick(path: Path, sheet: Any, place: Place) -> tuple[int, list[list[Any]]]:
    header, cells = 0, []
    places: Sequence[int] = ()
    for number, row in enumerate(sheet.iter_rows(values_only=True), start=1):
        if header:
            for column, index in zip(cells, places, strict=True):
                column.append(row[index] if index < len(row) else None)
        elif any(cell is not None for cell in row):
            names = ["" if cell is None else str(cell).strip() for cell in row]
            header, places = number, place(names)
            cells = [[] for _ in places]
    if not header:
        raise InputError(f"{path}: the first worksheet is empty.")
    return header, cells


def as_number(value: Any) -> float:
    """A cell as a float, NaN where it holds none; dates are none."""
    if isinstance(value, str):
        return text_number(value)
    if not isinstance(value, int | float | np.number):
        return np.nan
    try:
        return float(value)
    except OverflowError:
        return np.inf


def text_number(text: str) -> float:
    """The number that a text is in ASCII digits with a decimal point, to the last digit; NaN where it is none."""
    try:
        return float(text) if text.isascii() and "_" not in text else np.nan
    except ValueError:
        return np.nan
