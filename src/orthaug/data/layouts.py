"""Layout of a table: encoding, line of the header and separator of a text.

The cells of a workbook are read here as well.
"""

from __future__ import annotations

import codecs
import csv
import functools
import re
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import chain, islice, pairwise
from pathlib import Path
from typing import Any, NamedTuple, TextIO
from xml.etree.ElementTree import iterparse

import numpy as np

from orthaug._base.errors import InputError, show
from orthaug._base.memory import check_memory
from orthaug.data.headers import is_unit

_REMARK = ("#", "%")  # lines above the header that begin so
_NUMBER = re.compile(r'[\s"]*[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?[\s"]*')
_COMMA = re.compile(r"(\d*),(\d+)")
_DATE = re.compile(r"\d[\d.:/+ T-]*[.:/-][\d.:/+ T-]*\d(?:Z| ?[AaPp][Mm])?")
MISSING = ("", "nan", "na", "n/a", "#n/a", "n.a.", "n.v.", "null", "none", "-", "--")
"""Words of a cell without a sample, in small letters."""
_NO_UNIT = ("", "-", "--")  # cells of a row of units without one
_LONGEST_UNIT = 12  # letters
_BELOW = 5  # rows under the units that show which columns hold numbers
STATES = frozenset(
    ("on", "off", "true", "false", "yes", "no", "open", "closed", "ein", "aus", "auf", "zu")
    + ("ja", "nein", "start", "stop", "high", "low")
)
"""Words of a state, in small letters, for which numbers can be written."""
_BLANK = " "  # the separator that means any run of spaces and tabs
_SEPARATORS = ("\t", ";", ",", _BLANK)
_WITH_UNIT = re.compile(r'"[^"]*"|[^\s"]+(?:\s+(?:\[[^\]]*\]|\([^)]*\)))?')
_DECIMAL_COMMA = {
    ";": re.compile(r'(?:^|;)[ \t]*"?[ \t]*[+-]?(?:\d[\d.]*)?,\d+', re.MULTILINE),
    "\t": re.compile(r'(?:^|\t) *"?[+-]?\d*,\d+(?:[eE][+-]?\d+)?"? *(?=[\t\r\n]|$)', re.MULTILINE),
    _BLANK: re.compile(r"(?:^|[ \t])[+-]?\d*,\d+(?:[eE][+-]?\d+)?(?=\s|$)", re.MULTILINE),
}
_AHEAD = 50  # lines in which the header is looked for
_MARKS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0e-\x19\x1b-\x1f]")  # what no text holds
_FALLBACK = "cp1252"  # of Windows, where a file is no UTF-8
_ROWS, _COLUMNS = 1_048_576, 16_384  # of a sheet at most
Place = Callable[[Sequence[str]], Sequence[int]]
_PROLOGUE = 4096  # bytes of a part in which a document type would be


class Layout(NamedTuple):
    """Layout of a text table: names, lines above the first row, separator, encoding.

    It also holds whether names were read, and the units in a row of their own under the names, one
    for each name; none where there is no such row, which counts as one above the first row.

    The separator `" "` means any run of spaces and tabs. Columns without names are `x1`, `x2`,
    …
    """

    names: list[str]
    header_line: int
    separator: str
    encoding: str
    headed: bool = True
    units: tuple[str, ...] = ()

    @property
    def note(self) -> str:
        """Note on the encoding and the names; mostly empty."""
        notes = ["not UTF-8, so read as Windows-1252"] if self.encoding == _FALLBACK else []
        if not self.headed:
            named = [name for name in self.names if name]
            called = (
                f"columns are called {named[0]} to {named[-1]}"
                if len(named) > 1
                else f"column is called {named[0]}"
            )
            notes.append(f"no header, so the {called}")
        return "; ".join(notes)

    @property
    def splits(self) -> str:
        """The separator as pandas takes it."""
        return r"\s+" if self.separator == _BLANK else self.separator

    def has_decimal_commas(self, path: Path) -> bool:
        """Return whether a cell of the file is a number with a decimal comma."""
        pattern = _DECIMAL_COMMA.get(self.separator)
        if pattern is None:
            return False
        with path.open(encoding=self.encoding, newline="") as file:
            return pattern.search("".join(islice(file, self.header_line, None))) is not None

    def count_cells(self, path: Path, line: int) -> int:
        """Return the number of cells in a line of the file, counted from 1."""
        with path.open(encoding=self.encoding, newline="") as file:
            text = next(islice(file, line - 1, None), "")
        return len(_row(text.rstrip("\r\n"), self.separator))


def layout(path: Path, columns: Sequence[str] = ()) -> Layout:
    """Find the layout of a text table; remarks above its header are skipped.

    Args:
        columns: names that are asked for. A first line of numbers is a header only where it holds
            all of them. A column whose cell of the header is empty may be asked for by its place,
            as x3.

    Raises:
        InputError: what is no text, or only blank lines.
    """
    try:
        encoding = encoding_of(path)
        return _layout(path, encoding, columns)
    except (UnicodeError, csv.Error):
        raise InputError(
            f"{path}: not a text table; expected UTF-8 text with a header row."
        ) from None


def encoding_of(path: Path) -> str:
    """By the byte-order mark; otherwise UTF-8, or Windows-1252 where it is none.

    Raises:
        UnicodeError, csv.Error: bytes that are no text.
    """
    with path.open("rb") as file:
        begin = file.read(4)
    marked = next((encoding for mark, encoding in _MARKS.items() if begin.startswith(mark)), None)
    if marked == "utf-16":
        _check_text(path, marked)
        return marked
    try:
        _check_text(path, "utf-8-sig")
        return "utf-8-sig"
    except UnicodeDecodeError:
        if marked:
            raise
    _check_text(path, _FALLBACK, strict=True)
    return _FALLBACK


def first_foreign_line(path: Path) -> int | None:
    """Return the first line of a text that is no UTF-8, so that it is read as Windows-1252.

    None where none is.
    """
    if encoding_of(path) != _FALLBACK:
        return None
    with path.open("rb") as file:
        for number, line in enumerate(file, start=1):
            try:
                line.decode()
            except UnicodeDecodeError:
                return number
    return None


def _check_text(path: Path, encoding: str, *, strict: bool = False) -> None:
    """Decode all of a file, piece by piece; `strict` where any byte would have a letter."""
    decoder = codecs.getincrementaldecoder(encoding)()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            text = decoder.decode(block)
            if "\0" in text or (strict and _CONTROL.search(text)):
                raise csv.Error("control characters")
    decoder.decode(b"", final=True)


def _layout(path: Path, encoding: str, columns: Sequence[str]) -> Layout:
    with path.open(encoding=encoding, newline="") as file:
        line, number = _next_line(file, 0)
        if not line:
            raise InputError(f"{path}: the file holds only blank lines.")
        ahead = [(line, number)]
        while line.lstrip().startswith(_REMARK):
            after, further = _next_line(file, number)
            if not after or _has_numbers(
                after
            ):  # the names themselves follow the sign, right above the numbers
                ahead += [(after, further)] if after else []
                break
            line, number = after, further
            ahead = [(line, number)]
        number = ahead[-1][1]
        for text in islice(file, _AHEAD):
            number += 1
            if text.strip():
                ahead.append((text, number))
    separator = "\t" if path.suffix.lower() == ".tsv" else _separator([text for text, _ in ahead])
    rows = [(_cells(text, separator), number) for text, number in ahead]
    first = _first_unnamed(rows, separator, ahead[0][0])
    if first is not None and not (
        columns and set(columns) <= {cell.strip() for cell in rows[first][0]}
    ):
        return Layout(
            _default_names([cells for cells, _ in rows[first:]]),
            rows[first][1] - 1,
            separator,
            encoding,
            False,
        )
    cells, number = _below_remarks(rows, separator)
    names = _with_places([name.strip() for name in cells], columns)
    below = [(text, line) for text, line in ahead if line > number]
    units = _units(names, [_row(text, separator) for text, _ in below[: _BELOW + 1]], separator)
    return Layout(names, below[0][1] if units else number, separator, encoding, units=units)


def _row(line: str, separator: str) -> list[str]:
    """Return the cells of a line that is no header: a unit between spaces is a cell of its own."""
    return line.split() if separator == _BLANK else _cells(line, separator)


def _units(names: list[str], rows: list[list[str]], separator: str) -> tuple[str, ...]:
    """Return the units of columns where the first row below the names holds them.

    It does where the rows below it show numbers, and it has short texts in at least half of these
    columns and a number or a missing sample in none. Empty where it does not.
    """
    if len(rows) < 2 or len(rows[0]) < 1:
        return ()
    count = len(names)
    first, *below = ([cell.strip() for cell in [*row, *[""] * count][:count]] for row in rows)

    def is_value(cell: str) -> bool:
        return _is_number(cell, separator) or _DATE.fullmatch(cell) is not None

    numbers = [
        j
        for j in range(count)
        if any(is_value(row[j]) for row in below)
        and all(is_value(row[j]) or row[j].lower() in MISSING for row in below)
    ]
    cells = [first[j] for j in numbers]
    texts = [cell for cell in cells if cell not in _NO_UNIT]
    if not texts or 2 * len(texts) < len(cells):
        return ()
    if any(is_value(one) or one.lower() in MISSING or len(one) > _LONGEST_UNIT for one in texts):
        return ()
    bare = [re.sub(r"^[\[(](.*)[\])]$", r"\1", cell).strip() for cell in first]
    return tuple(
        "" if cell in _NO_UNIT or j not in numbers else cell for j, cell in enumerate(bare)
    )


def _with_places(names: list[str], columns: Sequence[str]) -> list[str]:
    """Return names in which x3 is the third column, where that is asked for and the cell is empty.

    A name that the header has itself stays its own.
    """
    wanted = set(columns) - set(names)
    return [
        f"x{place}" if not name and f"x{place}" in wanted else name
        for place, name in enumerate(names, start=1)
    ]


def _has_numbers(line: str) -> bool:
    """Return whether a line is one of a table and no remark.

    One cell between separators is a number, or each cell between spaces.
    """
    if line.lstrip().startswith(_REMARK):
        return False
    return any(map(_NUMBER.fullmatch, re.split(r"[,;\t]", line))) or all(
        map(_NUMBER.fullmatch, line.split())
    )


def _first_unnamed(rows: list[tuple[list[str], int]], separator: str, line: str) -> int | None:
    """Return the index of the first row of a table without a header, None where it has one.

    Args:
        line: the first of the lines unchanged, which may be a remark.
    """
    cells = rows[0][0]
    if _is_row(cells, separator):
        return None if _counts_columns(rows, separator) else 0
    if not line.lstrip().startswith(_REMARK) or len(rows) < 2 or not _is_row(rows[1][0], separator):
        return None
    return None if len(cells) == len(rows[1][0]) else 1


def _is_row(cells: list[str], separator: str) -> bool:
    """Return whether cells hold numbers, dates or nothing, and at least one of the first two."""
    found = [
        _is_number(cell, separator) or _DATE.fullmatch(cell.strip()) is not None for cell in cells
    ]
    return any(found) and all(
        good or cell.strip().lower() in MISSING for good, cell in zip(found, cells, strict=True)
    )


def _counts_columns(rows: list[tuple[list[str], int]], separator: str) -> bool:
    """Return whether the first line, 0, 1, 2, …, counts columns without names, as pandas writes it.

    It does not where the table has one column, or where the first column goes on evenly from it, as
    time does.
    """
    names = [cell.strip() for cell in rows[0][0] if cell.strip()]
    if len(names) < 2 or names != [str(i) for i in range(len(names))]:
        return False
    begin = [
        text_number(cells[0].strip().replace(",", "." if separator != "," else ","))
        for cells, _ in rows[:4]
    ]
    steps = np.diff(begin)
    return not (len(steps) > 1 and steps[0] > 0 and np.allclose(steps, steps[0], rtol=1e-6))


def _default_names(rows: list[list[str]]) -> list[str]:
    """Return the names x1, x2, … for the columns of rows.

    None for those behind the last that holds anything.
    """
    count = len(rows[0])
    used = max(
        (i + 1 for cells in rows for i, cell in enumerate(cells[:count]) if cell.strip()),
        default=count,
    )
    return [f"x{i + 1}" if i < used else "" for i in range(count)]


def _below_remarks(rows: list[tuple[list[str], int]], separator: str) -> tuple[list[str], int]:
    """Return the first line with as many cells as the rows below, or else the first line.

    Lines above it that were padded to that number with empty cells, as Excel does, are no header.
    """
    padded = _below_padding([cells for cells, _ in rows], separator)
    if padded:
        return rows[padded]
    for at, (cells, _) in enumerate(rows[1:], start=1):
        if len(cells) > 1 and any(_is_number(cell, separator) for cell in cells):
            count = len(cells)
            above = [one for one in rows[1:at] if _count(one[0]) == count]
            return above[0] if above and len(rows[0][0]) != count else rows[0]
    return rows[0]


def _below_padding(rows: list[list[str]], separator: str) -> int:
    """Return the first row with a name over each column of numbers, 0 where that is the first.

    It is also 0 where there is none, or where that row may hold the units of a header above it.
    """

    def numbers(row: list[str]) -> set[int]:
        return {j for j, cell in enumerate(row) if _is_number(cell, separator)}

    held = [numbers(row) for row in rows]
    start = next((i for i, (a, b) in enumerate(pairwise(held)) if a & b), 0)
    used = max((max(columns, default=-1) for columns in held[start : start + _BELOW]), default=-1)

    def names_all(row: list[str]) -> bool:
        return len(row) > used and all(cell.strip() for cell in row[: used + 1])

    if start == 0 or used < 1 or names_all(rows[0]):
        return 0
    found = next((i for i in range(1, start) if names_all(rows[i]) and not held[i]), 0)
    return 0 if sum(map(is_unit, rows[found])) > 0.5 * len(rows[found]) else found


def _is_number(cell: str, separator: str) -> bool:
    return (
        _NUMBER.fullmatch(_COMMA.sub(r"\1.\2", cell, count=1) if separator != "," else cell)
        is not None
    )


def _count(cells: list[str]) -> int:
    """Return the number of cells, with empty ones at the end.

    0 where one of the others is a number or empty: no header.
    """
    named = [cell.strip() for cell in cells]
    while named and not named[-1]:
        named.pop()
    return len(cells) if all(named) and not any(map(_NUMBER.fullmatch, named)) else 0


def _separator(lines: list[str]) -> str:
    """Return the separator of the cells.

    Of those that split most rows alike, it fits the header and leaves most numbers.
    """
    best, found = (False, 0.0), ""
    for separator in _SEPARATORS:
        split = [_cells(line, separator) for line in lines]
        rows = [cells for cells in split if any(_is_number(cell, separator) for cell in cells)]
        count = Counter(map(len, rows)).most_common(1)[0][0] if rows else 0
        if count < 2:
            continue
        begin = split.index(next(row for row in rows if len(row) == count))
        alike = [row for row in split[begin:] if len(row) == count]
        cells = [cell for row in alike for cell in row if cell.strip()]
        fits = len(split[0]) == count or any(_count(one) == count for one in split[:begin])
        numbers = sum(_is_number(cell, separator) for cell in cells) / max(len(cells), 1)
        rank = (fits, numbers * len(alike) / len(split[begin:]))
        if rank > best:
            best, found = rank, separator
    bare = re.sub(r'"[^"]*"', "", lines[0])  # separators inside quotes do not count
    return found or next((mark for mark in ("\t", ";") if mark in bare and "," not in bare), ",")


def _cells(line: str, separator: str) -> list[str]:
    if separator != _BLANK:
        return next(csv.reader([line], delimiter=separator))
    bare = line.strip()
    found = [cell.strip('"') for cell in _WITH_UNIT.findall(bare.lstrip("".join(_REMARK)))]
    return found or [""]


def _next_line(file: TextIO, number: int) -> tuple[str, int]:
    """Return the next line that is not blank, and its number, after line `number`.

    The line is empty at the end of the file.
    """
    for line in iter(file.readline, ""):
        number += 1
        if line.strip():
            return line, number
    return "", number


def numbers_only(names: list[str]) -> bool:
    """Return whether a header is a row of numbers; 0, 1, 2, … count columns without names."""
    found = [name for name in names if name]
    if not found or not all(map(_NUMBER.fullmatch, found)):
        return False
    return found != [str(i) for i in range(len(found))]


def read_sheet(path: Path, place: Place) -> tuple[int, list[list[Any]], tuple[str, ...]]:
    """Return the last row above the cells, counted from 1, the cells, and the units.

    The cells are those of the columns that `place` finds in the header.

    The first row that holds anything is the header, or the first with a name over each column of
    numbers. A row of units may be under it; otherwise there are none. A cell that is not there is
    None.

    Raises:
        InputError: no openpyxl, an encrypted file, no worksheet, an empty one, entities, more than
            fits into memory.
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
            _check_strings(sheet)
            return _pick(path, sheet, place)
        finally:
            book.close()


def _check_parts(path: Path, file: Any) -> None:
    """Raise InputError for a workbook that is encrypted, too large, or declares entities."""
    if file.read(8) == b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1":
        raise InputError(
            f"{path}: an encrypted workbook, or one of Excel 97 (.xls); save it as .xlsx "
            "without password."
        )
    with zipfile.ZipFile(file) as archive:
        check_memory(
            4 * sum(info.file_size for info in archive.infolist()), f"{path}: reading the workbook"
        )
        for info in archive.infolist():
            with archive.open(info) as part:
                if b"<!DOCTYPE" in part.read(_PROLOGUE):
                    raise InputError(
                        f"{path}: '{info.filename}' declares a document type, which a workbook "
                        "must not have."
                    )
    file.seek(0)


def _check_order(path: Path, sheet: Any) -> None:
    """Raise InputError unless rows and cells are in order.

    openpyxl would leave out the others.
    """
    row, column = 0, 0
    with sheet._get_source() as source:
        for event, element in iterparse(source, ("start", "end")):
            kind = element.tag.rpartition("}")[2]
            if event == "start" and kind == "row":
                before, row, column = row, int(element.get("r", row + 1)), 0
                if not before < row <= _ROWS:
                    raise InputError(
                        f"{path}: the rows of the sheet are out of order at row {show(row)}."
                    )
            elif event == "start" and kind == "c":
                place = element.get("r")
                there = (row, column + 1) if place is None else _place(place)
                if there[0] != row or not column < there[1] <= _COLUMNS:
                    raise InputError(
                        f"{path}: the cells of the sheet are out of order at '{place}'."
                    )
                column = there[1]
            elif event == "end" and kind == "row":
                element.clear()


def _place(name: str) -> tuple[int, int]:
    """Return row and column, counted from 1, of a cell such as `B7`; (0, 0) of no cell."""
    found = re.fullmatch(r"([A-Z]{1,3})([1-9][0-9]{0,6})", name)
    if found is None:
        return 0, 0
    return int(found[2]), functools.reduce(
        lambda total, letter: 26 * total + ord(letter) - 64, found[1], 0
    )


class _Strings(tuple[str, ...]):
    """The shared texts; a negative index names none."""

    def __getitem__(self, index: Any) -> Any:
        if index < 0:
            raise IndexError(f"there is no shared text {index}")
        return super().__getitem__(index)


def _check_strings(sheet: Any) -> None:
    if hasattr(sheet, "_shared_strings"):
        sheet._shared_strings = _Strings(sheet._shared_strings or ())


def _pick(path: Path, sheet: Any, place: Place) -> tuple[int, list[list[Any]], tuple[str, ...]]:
    rows = enumerate(sheet.iter_rows(values_only=True), start=1)
    filled = ((number, row) for number, row in rows if any(cell is not None for cell in row))
    first = next(filled, None)
    if first is None:
        raise InputError(f"{path}: the first worksheet is empty.")
    ahead = [first, *islice(rows, _AHEAD)]
    texts = [
        ["" if c is None else c if isinstance(c, str) else "0" for c in row] for _, row in ahead
    ]
    at = _below_padding(texts, ",")
    header, titles = ahead[at]
    names = ["" if cell is None else str(cell).strip() for cell in titles]
    places = place(names)
    cells: list[list[object]] = [[] for _ in places]
    for _, row in chain(ahead[at + 1 :], rows):
        for column, index in zip(cells, places, strict=True):
            column.append(row[index] if index < len(row) else None)
    units = _units(names, texts[at + 1 : at + 2 + _BELOW], ",")
    return (header + 1, [column[1:] for column in cells], units) if units else (header, cells, ())


def as_number(value: object) -> float:
    """Return a cell as a float, NaN where it holds none; dates are none."""
    if isinstance(value, str):
        return text_number(value)
    if not isinstance(value, int | float | np.number):
        return np.nan
    try:
        return float(value)
    except OverflowError:
        return np.inf


def text_number(text: str) -> float:
    """Return the number that a text is in ASCII digits with a decimal point, to the last digit.

    NaN where it is none.
    """
    try:
        return float(text) if text.isascii() and "_" not in text else np.nan
    except ValueError:
        return np.nan
