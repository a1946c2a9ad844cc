"""Name and unit in the header of a column, and whether it is the time.

Instants in s are made of numbers or dates.
"""

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

_UNITS = re.compile(
    r"A|mA|V|mV|kV|W|kW|N|kN|mN|Nm|m|mm|cm|km|um|s|ms|us|rad|mrad|deg|rpm|Hz|kHz|Pa|kPa|MPa|"
    r"bar|mbar|K|degC|degF|kg|J|kJ|ohm|percent|m_s2?|rad_s2?|l_min|kg_s"
)
_BRACKETS = re.compile(r"^(.*?)\s*[\[(]\s*([^\[\]()]+?)\s*[\])]$")
_INDEX, _RATIO = re.compile(r"[\d:,\s]+"), re.compile(r"\s\[1\]$")
_TIME = re.compile(
    r"^(t|times?|time[ _]?stamp|zeit|zeitstempel|uhrzeit|datum|date([ _/]?time)?|"
    r"elapsed([ _]?time)?|sec|seconds|msec|millis(econds)?|minutes|hours|days|"
    r"(time|zeit)[ _](in|within|since|im|in der|seit)([ _](the|of|dem|der))?[ _]"
    r"(batch|run|test|trial|cycle|experiment|session|start|begin|charge|lauf|versuch|beginn))$",
    re.IGNORECASE,
)
_STEP = re.compile(r"^(ts|dt|t_s|sampling_?time|sample_?time)$", re.IGNORECASE)
_RATE = re.compile(r"^(fs|sampling_?rate|sample_?rate|sampling_?frequency)$", re.IGNORECASE)
_PARTS = {"s": 1, "sec": 1, "ms": 1e3, "us": 1e6, "µs": 1e6, "μs": 1e6, "ns": 1e9}  # of a second
_MULTIPLES = {"min": 60.0, "h": 3600.0, "d": 86400.0}
# a column of that name; a letter, as in `h` or `s`, would often be a height or a path
_NAMED_BY_UNIT = {
    "ms": 1e-3,
    "msec": 1e-3,
    "millis": 1e-3,
    "milliseconds": 1e-3,
    "min": 60.0,
    "minute": 60.0,
    "minutes": 60.0,
    "hour": 3600.0,
    "hours": 3600.0,
    "day": 86400.0,
    "days": 86400.0,
}
_OF_TIME = re.compile(rf"(.+)_({'|'.join([*_PARTS, *_MULTIPLES])})")
_DATES = {
    ".": ("%d.%m.%Y", "%d.%m.%y"),
    "/": ("%d/%m/%Y", "%m/%d/%Y", "%Y/%m/%d"),
    "-": ("%d-%m-%Y", "%Y-%m-%d"),
    ":": ("",),
}
_TIMES = (
    *("%H:%M:%S.%f", "%H:%M:%S", "%H:%M"),
    *("%I:%M:%S %p", "%I:%M:%S.%f %p", "%I:%M %p"),
)
_MOST_OF = 0.9  # share of the cells that have to be dates
_COMMA = r"(:\d\d),(\d+)"


def split_header(header: str) -> tuple[str, str]:
    """Return name and unit of a header: `force [N]`, `force (N)`, `force_N`.

    An index, as in `U[2]`, is no unit; the 1 in `grade [1]` is that of a ratio.

    The number that follows columns of one name stays with the name: `force [N].1` is `force.1`
    in N.
    """
    numbered = re.fullmatch(r"(.*)(\.\d+)", header)
    if numbered:
        base, unit = split_header(numbered[1])
        return (base + numbered[2], unit) if unit else (header, "")
    found = _BRACKETS.match(header)
    if found and found[1] and (_RATIO.search(header) or not _INDEX.fullmatch(found[2])):
        return found[1].strip(), found[2].strip()
    for cut in (i for i, letter in enumerate(header) if letter == "_" and i):
        if _UNITS.fullmatch(header[cut + 1 :]):
            return header[:cut], header[cut + 1 :].replace("_s", "/s").replace(
                "_min", "/min"
            ).replace("s2", "s^2")
    return header, ""


def header_with_unit(header: str, unit: str) -> str:
    """Return a header with the unit that is elsewhere, as under it; one of its own stays.

    What is in parentheses need not be a unit, as in `force (drive)`: it stays a part of the name.
    """
    own = split_header(header)[1]
    remark = own != unit and header.rstrip().endswith(")")
    return f"{header} [{unit}]" if unit and (not own or remark) else header


def is_unit(text: str) -> bool:
    """Return whether a cell is a unit: one that is common, or in square brackets."""
    bare = text.strip()
    return re.fullmatch(r"\[[^\[\]]*\]", bare) is not None or _UNITS.fullmatch(bare) is not None


def last_part(name: str) -> str:
    """Return the name of a variable without the struct or group that it is in: `u` of `data.u`."""
    return re.split(r"[./]", name)[-1]


def unit_of_time(header: str) -> tuple[str, float | None]:
    """Return the name of a column, and its unit in s.

    The unit is 1 where the header has none and is none, as `minutes` is; None where it is none of
    time.
    """
    base, unit = split_header(header)
    if not unit and last_part(base).lower() in _NAMED_BY_UNIT:
        return base, _NAMED_BY_UNIT[last_part(base).lower()]
    own = _OF_TIME.fullmatch(header)
    if not unit and own and _TIME.match(last_part(own[1])):
        base, unit = own[1], own[2]
    if unit.lower() in _PARTS:
        return base, 1.0 / _PARTS[unit.lower()]
    return base, _MULTIPLES.get(unit.lower(), None if unit else 1.0)


def is_time(header: str) -> bool:
    """Return whether the name says that the column holds instants."""
    base, unit = unit_of_time(header)
    return unit is not None and bool(_TIME.match(base) or _TIME.match(last_part(base)))


def step_of(header: str, value: float) -> float | None:
    """Return the sampling time in s where the name says that the value is one, or a rate in Hz.

    Otherwise None.
    """
    base, unit = unit_of_time(header)
    if unit is not None and value > 0 and _STEP.match(last_part(base)):
        return unit * value
    base, unit_name = split_header(header)
    if value > 0 and unit_name.lower() in ("", "hz", "khz") and _RATE.match(last_part(base)):
        return 1.0 / (value * (1e3 if unit_name.lower() == "khz" else 1.0))
    return None


def in_seconds(values: Vector, header: str) -> Vector:
    """Return the numbers of a time column in s, by the unit in its header.

    A unit that is none of time is no unit.
    """
    unit = unit_of_time(header)[1]
    if unit is None or unit == 1:
        return values
    return values / round(1 / unit) if unit < 1 else values * unit  # 20 ms are the double 0.02


def parse_dates(cells: Sequence[object] | np.ndarray, where: str) -> Vector | None:
    """Return dates as seconds since the first of them, NaN where a cell is none.

    None where they are no dates.

    Args:
        cells: texts, or what a library makes of a date, a time of the day or a duration; None or ""
            where empty.
        where: begins messages.

    Raises:
        InputError: dates that may begin with the day or with the month, where that makes a
            difference.
    """
    import pandas as pd

    found = pd.Series(cells).map(_plain) if np.asarray(cells).dtype == object else pd.Series(cells)
    kind = found.dtype.kind if isinstance(found.dtype, np.dtype) else ""
    if kind == "m" or (
        kind == "O" and found.map(lambda cell: isinstance(cell, datetime.timedelta)).any()
    ):
        spans = pd.to_timedelta(found, errors="coerce")
        return spans.dt.total_seconds().to_numpy(dtype=float)
    if kind == "M":
        return _since_first(found)
    filled = found.notna() & (found != "")
    parsed = _read_dates(found[filled], where) if filled.any() else None
    return None if parsed is None else _since_first(parsed.reindex(found.index))


def _plain(cell: object) -> Any:
    """Return a time of the day as a duration; anything else as it is."""
    if not isinstance(cell, datetime.time):
        return cell
    return datetime.timedelta(
        hours=cell.hour, minutes=cell.minute, seconds=cell.second, microseconds=cell.microsecond
    )


def _since_first(instants: Any) -> Vector:
    there = instants.dropna()
    return (instants - there.iloc[0]).dt.total_seconds().to_numpy(dtype=float)


def _read_dates(cells: Any, where: str) -> Any:
    """Read ISO 8601, then day, month and year as people write them.

    None where most cells are neither.
    """
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
            f"{where}: '{cells.iloc[0]}' may begin with the day or with the month; write dates "
            "as 2024-12-31."
        )
    return next(found for found in good if found.notna().sum() == most)
