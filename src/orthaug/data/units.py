"""Units of channels against those in the headers of their columns."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from orthaug._base.errors import Warning
from orthaug.data.channels import Channel
from orthaug.data.headers import header_with_unit, split_header, unit_of_time
from orthaug.data.tables import read_titles

# What engineers write, as the library of units reads it
_WRITTEN = {
    "Nm": "N*m",
    "kNm": "kN*m",
    "Ohm": "ohm",
    "U/min": "rpm",
    "1/min": "rpm",
    "min-1": "rpm",
    "min^-1": "rpm",
    "C": "degC",  # no channel is in coulombs
    "F": "degF",
    "m3/h": "m^3/h",
    "m3/s": "m^3/s",
}
_FORM = re.compile(r"[A-Za-z1µμΩ°%][\w°%*/^²³·() -]*")  # no remark, such as `a.u.`
_RATE = re.compile(r"(?!1/|U/|rev/).*[^\W\d].*/(min|h|d)")
_NEAR = 0.01  # relative error of a scale that was rounded


def time_of_rate(unit: str) -> float | None:
    """Return the time in s of a rate per minute, hour or day; None of other units.

    A number of turns, 1/min, is a speed in a unit of its own.

    Examples:
        >>> time_of_rate("mg/h"), time_of_rate("m3/s"), time_of_rate("1/min")
        (3600.0, None, None)
    """
    found = _RATE.fullmatch(unit.replace(" ", ""))
    return None if found is None else unit_of_time(f"x [{found[1]}]")[1]


class Conversion(NamedTuple):
    """A value in another unit is `scale * value + offset`."""

    scale: float
    offset: float


def conversion(given: str, wanted: str) -> Conversion | None:
    """Return how values in a unit are converted to another; None where either is unknown.

    Raises:
        ValueError: units of different kinds, such as m and s.
    """
    if not (_FORM.fullmatch(given) and _FORM.fullmatch(wanted)):
        return None
    units = _registry()
    try:
        one, other = (units.Unit(_WRITTEN.get(text, text)) for text in (given, wanted))
    except Exception:  # whatever the library makes of text that is no unit
        return None
    if one.dimensionality != other.dimensionality:
        raise ValueError(f"{given} and {wanted} are units of different kinds")
    zero, unity = (float(units.Quantity(value, one).to(other).magnitude) for value in (0.0, 1.0))
    return Conversion(unity - zero, zero)


@lru_cache(maxsize=1)
def _registry() -> Any:
    """Return the library's registry of units, which takes a second."""
    import pint  # slow to import, and only units that differ need it

    return pint.UnitRegistry(cache_folder=None)


class UnitFault(NamedTuple):
    """A channel whose unit is not that of its column, and the conversion that it lacks.

    None where the units are of different kinds.
    """

    channel: str
    warning: Warning
    right: Conversion | None


def unit_faults(path: Path, channels: dict[str, Channel]) -> list[UnitFault]:
    """Return every column whose header has another unit than its channel, with a warning.

    A scale or an offset is taken for a deliberate conversion, or a sensor's calibration, unless it
    is the inverse of the right one.

    Args:
        path: a file of data.
        channels: by the column of the file that each reads.
    """
    if not any(channel.unit for channel in channels.values()):
        return []
    titles = read_titles(path)
    found = []
    for header in titles.names:
        base, unit = split_header(header_with_unit(header, titles.units.get(header, "")))
        channel = channels.get(header) or channels.get(base)
        if channel is None or not unit or not channel.unit or _plain(unit) == _plain(channel.unit):
            continue
        text, right = _fault(header, unit, channel)
        if text:
            warning = Warning("unit_mismatch", f"{path.name}: {text}")
            found.append(UnitFault(channel.name, warning, right))
    return found


def _plain(unit: str) -> str:
    return re.sub(r"[\s*·^]", "", unit).replace("²", "2").replace("³", "3")


def _fault(header: str, unit: str, channel: Channel) -> tuple[str, Conversion | None]:
    """Return what is wrong with a channel's scale and offset, and the right ones.

    An empty text for nothing.
    """
    place, untouched = f"data.channels.{channel.name}", (channel.scale, channel.offset) == (1, 0)
    says = (
        f"the header of column '{header}' has the unit {unit}, and `{place}` has the unit "
        f"{channel.unit}"
    )
    try:
        right = conversion(unit, channel.unit)
    except ValueError:
        text = f"{says}, of another kind, without a `scale`. Check the column, the unit and the "
        return (f"{text}conversion." if untouched else "", None)
    if right is None or (_near(right.scale, 1.0) and right.offset == 0):
        return "", None
    inverse = channel.offset == 0 and _near(abs(channel.scale), 1 / right.scale)
    if not untouched and (not inverse or _near(abs(channel.scale), right.scale)):
        return "", None
    offset = f" and `offset = {right.offset:.6g}`" if right.offset else ""
    given = "no `scale`" if untouched else f"`scale = {channel.scale:.6g}`, the inverse of it"
    text = (
        f"{says}, with {given}. The parameters absorb such a factor, and no residual shows it. "
        f"Give `scale = {right.scale:.6g}`{offset}, or correct the unit."
    )
    return text, right


def _near(value: float, other: float) -> bool:
    return abs(value - other) <= _NEAR * abs(other)
