"""How a text table is laid out: its encoding, the line of its header, its separator."""

from __future__ import annotations

import codecs
import csv
import re
from itertools import islice
from pathlib import Path
from typing import NamedTuple, TextIO

from orthaug._base.errors import InputError

_REMARK = ("#", "%")  # lines above the header that begin so
_NUMBER = re.compile(r'[\s"]*[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?[\s"]*')
_AHEAD = 50  # lines in which the header is looked for
_MARKS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0e-\x19\x1b-\x1f]")  # what no text holds
_FALLBACK = "cp1252"  # of Windows, where a file is no UTF-8


class Layout(NamedTuple):
    """Column names, the number of lines up to and with the header, the separator, and the encoding."""

    names: list[str]
    header_line: int
    separator: str
    encoding: str

    @property
    def note(self) -> str:
        """What to know of the encoding; mostly nothing."""
        return "no UTF-8, so read as Windows-1252" if self.encoding == _FALLBACK else ""


def layout(path: Path) -> Layout:
    """Of a text table; remarks above its header are skipped.

    Raises:
        InputError: what is no text, or only blank lines.
    """
    try:
        encoding = _encoding(path)
        return _layout(path, encoding)
    except (UnicodeError, csv.Error):
        raise InputError(f"{path}: not a text table; expected UTF-8 text with a header row.") from None


def _encoding(path: Path) -> str:
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


def _check_text(path: Path, encoding: str, *, strict: bool = False) -> None:
    """Decode all of a file, piece by piece; `strict` where any byte would have a letter."""
    decoder = codecs.getincrementaldecoder(encoding)()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            text = decoder.decode(block)
            if "\0" in text or (strict and _CONTROL.search(text)):
                raise csv.Error("control characters")
    decoder.decode(b"", final=True)


def _layout(path: Path, encoding: str) -> Layout:
    with path.open(encoding=encoding, newline="") as file:
        line, number = _next_line(file, 0)
        if not line:
            raise InputError(f"{path}: the file holds only blank lines.")
        while line.lstrip().startswith(_REMARK):
            after, further = _next_line(file, number)
            if not after or any(map(_NUMBER.fullmatch, re.split(r"[,;\t]", after))):
                break  # the names themselves stand behind the sign, right above the numbers
            line, number = after, further
        ahead = [(line, number)]
        for text in islice(file, _AHEAD):
            number += 1
            if text.strip():
                ahead.append((text, number))
    tab = path.suffix.lower() == ".tsv"
    line, number = _below_remarks(ahead, tab=tab)
    separator = _separator(line, tab=tab)
    return Layout([name.strip() for name in _cells(line, separator)], number, separator, encoding)


def _below_remarks(lines: list[tuple[str, int]], *, tab: bool) -> tuple[str, int]:
    """The first line with as many cells as the rows below, or simply the first."""
    for at, (row, _) in enumerate(lines[1:], start=1):
        separator = ";" if ";" in row and not tab else _separator(row, tab=tab)  # decimals may be commas
        row_cells = _cells(row, separator)
        if len(row_cells) > 1 and any(_is_number(cell, separator) for cell in row_cells):
            count = len(row_cells)
            above = [one for one in lines[1:at] if _count(_cells(one[0], separator)) == count]
            return above[0] if above and len(_cells(lines[0][0], separator)) != count else lines[0]
    return lines[0]


def _is_number(cell: str, separator: str) -> bool:
    return _NUMBER.fullmatch(cell.replace(",", ".", 1) if separator == ";" else cell) is not None


def _count(cells: list[str]) -> int:
    """How many there are, empty ones at the end too; 0 where one of the others is a number or empty: no header."""
    named = [cell.strip() for cell in cells]
    while named and not named[-1]:
        named.pop()
    return len(cells) if all(named) and not any(map(_NUMBER.fullmatch, named)) else 0


def _separator(line: str, *, tab: bool) -> str:
    bare = re.sub(r'"[^"]*"', "", line)  # separators inside quotes do not count
    if tab:
        return "\t"
    return ";" if ";" in bare and "," not in bare else ","


def _cells(line: str, separator: str) -> list[str]:
    return next(csv.reader([line], delimiter=separator))


def _next_line(file: TextIO, number: int) -> tuple[str, int]:
    """The next line that is not blank, empty at the end of the file, and its number, after line `number`."""
    for line in iter(file.readline, ""):
        number += 1
        if line.strip():
            return line, number
    return "", number


def numbers_only(names: list[str]) -> bool:
    """Whether a header is a row of numbers; 0, 1, 2, … stand for columns without names."""
    found = [name for name in names if name]
    if not found or not all(map(_NUMBER.fullmatch, found)):
        return False
    return found != [str(i) for i in range(len(found))]
