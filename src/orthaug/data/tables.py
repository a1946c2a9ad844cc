"""Named columns of floats from files, by the file's ending.

Cells that are no numbers are kept, so that messages can name it.
"""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from orthaug._base.checks import Matrix, Vector, nearest
from orthaug._base.errors import (
    InputError,
    MissingColumnError,
    MissingFileError,
    SurplusCellsError,
)
from orthaug._base.memory import check_memory
from orthaug._base.plugins import READERS, discover
from orthaug._base.progress import LOG
from orthaug.data.headers import header_with_unit, in_seconds, parse_dates, split_header
from orthaug.data.layouts import (
    Layout,
    as_number,
    first_foreign_line,
    layout,
    numbers_only,
    read_sheet,
    text_number,
)
from orthaug.data.variables import ENDINGS, foreign, read_variables, short, variable_names

_SMALL = 4_000_000  # bytes of a text file that NumPy reads sooner than pandas is imported
PLAIN_TEXT = (".txt", ".dat")
"""Endings of text that need not be a table."""
_LONGER = re.compile(r"Expected \d+ fields in line (\d+), saw")  # of pandas
_NAMED = 30  # columns that a message lists


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of a file as floats, NaN where the cell is empty or no number.

    `where` and `cell` are for messages.

    `filled` counts the rows of each column up to its last cell that holds anything. In a text file
    `first_line` is the line of row 0; `dated` is the column of time where it held dates.
    """

    path: Path
    columns: Mapping[str, Vector]
    filled: Mapping[str, int]
    first_line: int | None = None
    cell: Callable[[str, int], str] = lambda column, row: "nan"
    dated: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    """Units of columns from a row under the header."""

    def where(self, row: int) -> str:
        """Return `line 17 (row 15)` of a text file, `row 15` of others."""
        return (
            f"row {row}" if self.first_line is None else f"line {self.first_line + row} (row {row})"
        )


def read_table(
    path: Path, columns: Sequence[str], time: str | None = None, *, most: int | None = None
) -> Table:
    """Return the named columns of a file.

    Args:
        time: the one of them that holds instants, numbers in the unit of its header, or of the row
            of units under it, or dates: it comes in s.
        most: rows that are enough, where a file can be read in part; None for all.

    Raises:
        InputError: no such file, an unknown ending, content that does not fit it, or missing
            columns.
    """
    check_readable(path)
    reader = _reader_of(path)
    with foreign(path):
        part = {"most": most} if reader is _read_text else {}
        table = reader(path, columns, time, **part)
    if time is None or table.dated:
        return table
    seconds = in_seconds(table.columns[time], header_with_unit(time, table.units.get(time, "")))
    return replace(table, columns={**table.columns, time: seconds})


def has_column(path: Path, name: str) -> bool:
    """Return whether the file has a column (or variable) of that name.

    Raises:
        InputError: a file that cannot be read, or holds the column twice.
    """
    try:
        read_table(path, (name,))
    except MissingColumnError:
        return False
    return True


class Titles(NamedTuple):
    """Names of the columns of a file, and the units that a row under the header gives them."""

    names: list[str]
    units: Mapping[str, str]


def read_titles(path: Path) -> Titles:
    """Return the columns (or variables) of a file that could be read, in order, and their units.

    Raises:
        InputError: no such file, an unknown ending, content that does not fit it.
    """
    check_readable(path)
    ending, reader = path.suffix.lower(), _reader_of(path)
    with foreign(path):
        if isinstance(reader, _PackageReader):
            return Titles(list(reader.read(path)), {})
        if ending in ENDINGS:
            return Titles(variable_names(path), {})
        if ending == ".parquet":
            with parquet_file(path) as file:
                return Titles(list(file.schema_arrow.names), {})
        found: list[str] = []
        if ending == ".xlsx":
            units = read_sheet(path, lambda header: found.extend(header) or [])[2]
        else:
            found, units = (own := layout(path)).names, own.units
    return Titles([name for name in number_names(found) if name], _units_of(found, units))


def _units_of(header: Sequence[str], units: Sequence[str]) -> dict[str, str]:
    """Return the units by column."""
    return {
        name: unit for name, unit in zip(number_names(header), units, strict=False) if name and unit
    }


def is_table(path: Path) -> bool:
    """Return whether a file has the ending of data files."""
    return path.suffix.lower() in _READERS


def reading_note(path: Path) -> str:
    """Return a note on how a file is read, such as a guessed encoding; mostly empty."""
    return layout(path).note if _READERS.get(path.suffix.lower()) is _read_text else ""


def guessed_encoding(path: Path) -> int | None:
    """Return the first line that is no UTF-8 of a text that is read all the same.

    None of any other file.
    """
    return first_foreign_line(path) if _READERS.get(path.suffix.lower()) is _read_text else None


def check_readable(path: Path) -> None:
    """Raise InputError unless `path` is a file with something in it."""
    try:
        if not path.exists():
            raise MissingFileError(f"{path}: no such file.")
        if not path.is_file():
            raise InputError(f"{path}: not a file.")
        with path.open("rb") as file:
            empty = not file.read(1)
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from None
    except ValueError:
        raise MissingFileError(f"{path}: no such file.") from None
    if empty:
        raise InputError(f"{path}: the file is empty (0 bytes).")


def _read_text(
    path: Path, columns: Sequence[str], time: str | None, most: int | None = None
) -> Table:
    """Read a text table as it occurs in practice.

    It may have a byte-order mark, trailing separators, units in headers, decimal commas or no
    header.
    """
    found = layout(path, columns)
    header, header_line = found.names, found.header_line
    if found.note:
        LOG.info("%s: %s", path, found.note)
    place = {
        name: str(index)
        for name, index in zip(
            columns, places(path, columns, header, headed=found.headed), strict=True
        )
    }
    commas = found.has_decimal_commas(path)
    beyond = str(len(header))  # a column that must stay empty: cells behind the last header
    apart = place[time] if time else None
    numbers, texts, held = _cells(path, found, [*place.values(), beyond], commas, apart, most)
    extra = np.flatnonzero(np.asarray(held[beyond]))
    if extra.size:
        raise SurplusCellsError(_surplus(path, found, extra, len(held[beyond])))
    values = {name: np.asarray(numbers[place[name]], dtype=float) for name in columns}

    dates = None
    if time and texts is not None and not np.isfinite(values[time]).any():
        dates = parse_dates(texts[apart].to_numpy(), f"{path}: column '{time}'")
    values |= {time: dates} if time and dates is not None else {}

    def cell(column: str, row: int) -> str:
        if texts is not None and place[column] in texts:
            return " ".join(str(texts.loc[row, place[column]]).split())
        value = values[column][row]
        return "" if np.isnan(value) else str(value)

    filled = {name: _up_to_last(np.asarray(held[place[name]])) for name in columns}
    dated = time if time and dates is not None else ""
    units = _units_of(header, found.units)
    return Table(path, values, filled, header_line + 1, cell, dated, units)


def _surplus(path: Path, found: Layout, rows: np.ndarray, total: int) -> str:
    """Return which rows have more cells than the header has names, and what may be wrong."""
    names, line = len(found.names), found.header_line + 1 + int(rows[0])
    count = max(found.count_cells(path, line), names + 1)
    if found.separator == "," and 2 * len(rows) > total and found.headed:
        return (
            f"{path}: line {line} has {count} cells under {names} names, and so have most lines. "
            "Perhaps the decimals have commas, too: export the table with ; as separator."
        )
    besides = f"; {len(rows)} lines have too many" if len(rows) > 1 else ""
    first = "the header" if found.headed else f"line {found.header_line + 1}"
    return (
        f"{path}: line {line} has {count} cells, {first} has {names}{besides}. "
        "Correct the line: is a separator or a decimal comma wrong?"
    )


def _cells(
    path: Path, found: Layout, used: list[str], commas: bool, apart: str | None, most: int | None
) -> tuple[Any, Any, Any]:
    """Return the used columns as numbers and as text, and which cells are not empty.

    The text is None where all cells are numbers or empty.

    The one `apart` may hold text, so that it is looked at by itself.
    """
    plain = None if commas or most else _plain_numbers(path, found)
    if plain is not None:
        numbers = {str(i): column for i, column in enumerate(plain)}
        return numbers, None, {name: np.full(plain.shape[1], name in numbers) for name in used}
    import pandas as pd

    def read(**options: Any) -> pd.DataFrame:
        frame = pd.read_csv(
            path,
            sep=found.splits,
            header=None,
            names=[str(i) for i in range(len(found.names) + 1)],
            index_col=False,
            skiprows=found.header_line,
            skip_blank_lines=False,
            keep_default_na=False,
            encoding=found.encoding,
            low_memory=False,
            nrows=most,
            **options,
        )[used]
        if np.isinf(frame.select_dtypes("number")).any(axis=None):
            raise ValueError("a number beyond double precision")
        return frame

    if not commas:
        with suppress(
            ValueError
        ):  # something is no number: read again as text, to be able to name it
            numbers = read(
                dtype=dict.fromkeys(used, np.float64), na_values=[""], float_precision="round_trip"
            )
            return numbers, None, numbers.notna()
    if not commas and apart is not None:
        kinds: dict[str, Any] = {**dict.fromkeys(used, np.float64), apart: str}
        with suppress(ValueError):
            numbers = read(dtype=kinds, na_values=[""], float_precision="round_trip")
            texts: Any = numbers[[apart]].fillna("").apply(lambda column: column.str.strip())
            held = numbers.notna().assign(**{apart: texts[apart] != ""})
            return numbers.assign(**{apart: texts[apart].map(text_number)}), texts, held
    try:
        texts = read(dtype=str).fillna("").apply(lambda column: column.str.strip())
    except ValueError as error:
        if "found 0" in str(error) or isinstance(error, pd.errors.EmptyDataError):
            raise InputError(f"{path}: there are no data rows below the header.") from None
        longer = _LONGER.search(str(error))
        if longer is not None:
            row = int(longer[1]) - found.header_line - 1
            raise SurplusCellsError(_surplus(path, found, np.array([row]), row + 1)) from None
        raise InputError(f"{path}: not a readable table ({short(error)}).") from None
    return (
        texts.apply(lambda column: column.map(_comma_number if commas else text_number)),
        texts,
        texts != "",
    )


def _plain_numbers(path: Path, found: Layout) -> Matrix | None:
    """Return the columns (count, rows) of a small file in which every cell is a finite number.

    The result is None for all other files.

    NumPy reads it before pandas would be imported.
    """
    skipped, count = found.header_line, len(found.names)
    if path.stat().st_size > _SMALL or found.encoding == "utf-16":
        return None
    text = path.read_bytes()
    lines = text.count(b"\n") + (not text.endswith(b"\n"))
    if b'"' in text or lines == skipped:
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # as where all lines are blank
            options: dict[str, Any] = {
                "delimiter": found.separator.strip(" ") or None,
                "skiprows": skipped,
                "comments": None,
            }
            numbers = np.loadtxt(path, **options, encoding=found.encoding, ndmin=2)
    except (ValueError, UserWarning):
        return None
    plain = numbers.shape == (lines - skipped, count) and np.isfinite(numbers).all()
    return np.ascontiguousarray(numbers.T) if plain else None


def _comma_number(text: str) -> float:
    """Return a number with a decimal comma.

    A point would be one of thousands, and is refused.
    """
    return np.nan if "." in text else text_number(text.replace(",", "."))


def _up_to_last(held: np.ndarray) -> int:
    return int(np.flatnonzero(held)[-1]) + 1 if held.any() else 0


def _read_parquet(path: Path, columns: Sequence[str], time: str | None) -> Table:
    with parquet_file(path) as file:
        check_present(path, columns, file.schema_arrow.names)
        check_memory(
            16 * file.metadata.num_rows * len(columns),
            f"{path}: reading {file.metadata.num_rows} rows",
        )
        table = file.read(columns=list(columns))
        table.validate(full=True)
    arrays = {name: table.column(name).to_numpy(zero_copy_only=False) for name in columns}
    dates = None
    if time and arrays[time].dtype.kind not in "fiub":
        dates = parse_dates(arrays.pop(time), f"{path}: column '{time}'")
        if dates is None:
            raise InputError(
                f"{path}: column '{time}' holds text; expected instants, numbers or dates."
            )
    values = {name: _as_floats(array, name, path) for name, array in arrays.items()}
    values |= {time: dates} if time and dates is not None else {}
    return replace(
        _full_table(path, {name: values[name] for name in columns}),
        dated=time if time and dates is not None else "",
    )


@contextmanager
def parquet_file(path: Path) -> Iterator[Any]:
    """Yield the file, opened by pyarrow.

    Raises:
        InputError: without pyarrow, and for a file that is none or breaks off.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise InputError(
            f"{path}: reading Parquet needs pyarrow; install orthaug[parquet]."
        ) from None
    try:
        with pq.ParquetFile(
            path, page_checksum_verification=True, pre_buffer=False, buffer_size=1 << 20
        ) as file:
            yield file
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{path}: not a readable Parquet file ({short(error)}).") from None


def _read_excel(path: Path, columns: Sequence[str], time: str | None) -> Table:
    """Return the first worksheet."""
    names: list[str] = []

    def place(header: Sequence[str]) -> list[int]:
        names.extend(header)
        return places(path, columns, header)

    top, found, units = read_sheet(path, place)
    cells = dict(zip(columns, found, strict=True))
    values = {
        name: np.array([as_number(cell) for cell in column]) for name, column in cells.items()
    }
    filled = {
        name: _up_to_last(np.array([c is not None for c in column]))
        for name, column in cells.items()
    }

    def cell(column: str, row: int) -> str:
        return "" if cells[column][row] is None else str(cells[column][row])

    dates = None
    if time and not np.isfinite(values[time]).any():
        dates = parse_dates(np.array(cells[time], dtype=object), f"{path}: column '{time}'")
    values |= {time: dates} if time and dates is not None else {}
    dated = time if time and dates is not None else ""
    return Table(path, values, filled, top + 1, cell, dated, _units_of(names, units))


def _read_variables(path: Path, columns: Sequence[str], time: str | None) -> Table:
    return _full_table(path, read_variables(path, columns))


def _full_table(path: Path, columns: Mapping[str, Vector]) -> Table:
    """Return a table of a file type that has no empty cells."""
    filled = {name: len(values) for name, values in columns.items()}
    return Table(path, columns, filled, cell=lambda column, row: str(columns[column][row]))


def _as_floats(array: np.ndarray, name: str, path: Path) -> Vector:
    try:
        if array.dtype.kind not in "fiub":
            raise TypeError
        return np.asarray(array, dtype=float)
    except (TypeError, ValueError):
        raise InputError(
            f"{path}: column '{name}' holds {array.dtype} values; expected numbers."
        ) from None


_READERS: dict[str, Callable[..., Table]] = {
    ".csv": _read_text,
    ".tsv": _read_text,
    **dict.fromkeys(PLAIN_TEXT, _read_text),
    ".parquet": _read_parquet,
    ".xlsx": _read_excel,
    **dict.fromkeys(ENDINGS, _read_variables),
}


@dataclass(frozen=True)
class _PackageReader:
    """A reader of another package: columns by name from a path."""

    read: Callable[[Path], Mapping[str, Any]]

    def __call__(self, path: Path, columns: Sequence[str], time: str | None) -> Table:
        found = self.read(path)
        check_present(path, columns, list(found))
        return _full_table(
            path, {name: _as_floats(np.asarray(found[name]), name, path) for name in columns}
        )


def _reader_of(path: Path) -> Callable[..., Table]:
    """Return the reader of a file's type, which an installed package may have.

    Raises:
        InputError: an unknown ending, or a package that cannot be loaded.
    """
    ending = path.suffix.lower()
    if ending not in _READERS:
        endings = [known.removeprefix(".") for known in _READERS]
        discover(READERS, "reader", endings, _add_reader)
    if ending not in _READERS:
        raise InputError(
            f"{path}: unknown file type '{path.suffix}'; known are {', '.join(_READERS)}."
        )
    return _READERS[ending]


def _add_reader(ending: str, read: Any) -> None:
    if not callable(read):
        raise InputError(f"the reader '{ending}' is no function of a path.")
    _READERS[f".{ending.lower()}"] = _PackageReader(cast(Any, read))


KNOWN = tuple(_READERS)
"""Endings of the files that can be read."""


def _with_unit(name: str, header: Sequence[str]) -> str:
    """Return how a spec takes the one column that has a name but for its unit; else nothing."""
    alike = [(h, unit) for h in header for base, unit in [split_header(h)] if unit and base == name]
    if len(alike) != 1 or not name.isidentifier() or '"' in alike[0][0]:
        return ""
    column, unit = alike[0]
    return (
        f" Write into `[data.channels]` of the spec: {name} = "
        f'{{ column = "{column}", unit = "{unit}" }}.'
    )


def check_present(
    path: Path,
    columns: Sequence[str],
    header: Sequence[str],
    *,
    named_apart: bool = False,
    headed: bool = True,
) -> None:
    """Raise InputError for a column that is missing, or is in the header twice."""
    for name in columns:
        if name not in header:
            if not headed:
                called = ", ".join(h for h in list(header)[:_NAMED] if h)
                raise MissingColumnError(
                    f"{path}: no column '{name}': the file has no header, so its columns are "
                    f"called {called}."
                )
            if numbers_only(list(header)):
                raise MissingColumnError(
                    f"{path}: no column '{name}': the first line holds numbers; a header with "
                    "names is expected."
                )
            known = ", ".join(f"'{h}'" for h in list(header)[:_NAMED] if h) or "no column names"
            known += f" and {len(header) - _NAMED} more" if len(header) > _NAMED else ""
            raise MissingColumnError(
                f"{path}: no column '{name}'{nearest(name, header)}; the file has {known}."
                f"{_with_unit(name, header)}"
            )
        if list(header).count(name) > 1:
            twice = (
                f"the header has the column '{name}' {list(header).count(name)} times; "
                "names must differ"
            )
            apart = (
                f", or be numbered from the left as '{name}.0', '{name}.1'" if named_apart else ""
            )
            raise InputError(f"{path}: {twice}{apart}.")


def places(
    path: Path, columns: Sequence[str], header: Sequence[str], *, headed: bool = True
) -> list[int]:
    """Return the places of columns in a header.

    Columns of one name are `name.0`, `name.1`, ... from the left.

    Raises:
        InputError: a column that is not there, or a name that is there twice.
    """
    apart = number_names(header)
    check_present(
        path,
        [name for name in columns if name not in apart],
        header,
        named_apart=True,
        headed=headed,
    )
    return [apart.index(name) for name in columns]


def number_names(header: Sequence[str]) -> list[str]:
    """Return names with a number behind those that occur more than once.

    They are counted as in pandas: `u.1` is the second `u`.
    """
    often, seen, apart = Counter(header), Counter[str](), []
    for name in header:
        number = seen[name]
        while often[name] > 1 and name and f"{name}.{number}" in often:  # a name of its own
            number += 1
        seen[name] = number + 1
        apart.append(f"{name}.{number}" if often[name] > 1 and name else name)
    return apart
