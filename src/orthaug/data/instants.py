"""Instants of a time column in seconds: numbers in the unit that the header names, or dates."""

from __future__ import annotations

import datetime
import re
import warnings
from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.errors import InputError
from orthaug.data.headers import unit_of_time

_DATES = {".": ("%d.%m.%Y", "%d.%m.%y"), "/": ("%d/%m/%Y", "%m/%d/%Y", "%Y/%m/%d"), "-": ("%d-%m-%Y",), ":": ("",)}
_TIMES = ("%H:%M:%S.%f", "%H:%M:%S", "%H:%M", "%I:%M:%S %p")
_MOST_OF = 0.9  # share of the cells that have to be dates
_COMMA = r"(:\d\d),(\d+)"


def in_seconds(values: Vector, header: str) -> Vector:
    """Numbers of a time column in s, by the unit in its header; a unit that is none of time is no unit."""
    unit = unit_of_time(header)[1]
    if unit is None or unit == 1:
        return values
    return values / round(1 / unit) if unit < 1 else values * unit  # 20 ms are the double 0.02


def dated(cells: Sequence[Any] | np.ndarray, where: str) -> Vector | None:
    """Dates as seconds since the first of them, NaN where a cell is none; None where they are no dates.

    Args:
        cells: texts, or what a library makes of a date, a time of the day or a duration; None or "" where empty.
        where: begins messages.

    Raises:
        InputError: dates that may begin with the day or with the month, where that makes a difference.
    """
    import pandas as pd

    found = pd.Series(cells).map(_plain) if np.asarray(cells).dtype == object else pd.Series(cells)
    kind = found.dtype.kind if isinstance(found.dtype, np.dtype) else ""
    if kind == "m" or (kind == "O" and found.map(lambda cell: isinstance(cell, datetime.timedelta)).any()):
        spans = pd.to_timedelta(found, errors="coerce")
        return spans.dt.total_seconds().to_numpy(dtype=float)
    if kind == "M":
        return _since_first(found)
    filled = found.notna() & (found != "")
    parsed = _parsed(found[filled], where) if filled.any() else None
    return None if parsed is None else _since_first(parsed.reindex(found.index))


def _plain(cell: Any) -> Any:
    """A time of the day as a duration; anything else as it is."""
    if not isinstance(cell, datetime.time):
        return cell
    return datetime.timedelta(hours=cell.hour, minutes=cell.minute, seconds=cell.second, microseconds=cell.microsecond)


def _since_first(instants: Any) -> Vector:
    there = instants.dropna()
    return (instants - there.iloc[0]).dt.total_seconds().to_numpy(dtype=float)


def _parsed(cells: Any, where: str) -> Any:
    """ISO 8601, then day, month and year as people write them; None where most cells are neither."""
    import pandas as pd

    def read(**options: Any) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return pd.to_datetime(cells, errors="coerce", utc=True, **options)

    if not isinstance(cells.iloc[0], str):
        found = read()
        return found if found.notna().mean() >= _MOST_OF else None
    cells = cells.astype(str).str.replace(_COMMA, r"\1.\2", regex=True)
    if not re.search(r"\d\D\d", cells.iloc[0]):
        return None
    found = read(format="ISO8601")
    if found.notna().mean() >= _MOST_OF:
        return found
    mark = re.search(r"\d([./:-])\d", cells.iloc[0])
    good = []
    for date in _DATES[mark[1]] if mark else ():
        found = None
        for gap, time in product((" ", "T") if date else ("",), _TIMES):
            one = read(format=f"{date}{gap}{time}")
            found = one if found is None else found.fillna(one)
            if found.notna().all():
                break
        if found is not None and found.notna().mean() >= _MOST_OF:
            good.append(found)
    if not good:
        return None
    most = max(found.notna().sum() for found in good)
    best = [_since_first(found) for found in good if found.notna().sum() == most]
    if any(not np.array_equal(best[0], other, equal_nan=True) for other in best[1:]):
        raise InputError(
            f"{where}: '{cells.iloc[0]}' may begin with the day or with the month; write dates as 2024-12-31."
        )
    return next(found for found in good if found.notna().sum() == most)
