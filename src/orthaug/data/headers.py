"""What the header of a column says: name, unit, and whether it is the time."""

from __future__ import annotations

import re

_UNITS = re.compile(
    r"A|mA|V|mV|kV|W|kW|N|kN|mN|Nm|m|mm|cm|km|um|s|ms|us|rad|mrad|deg|rpm|Hz|kHz|Pa|kPa|MPa|bar|mbar|K|degC|degF|kg|J|"
    r"kJ|ohm|percent|m_s2?|rad_s2?|l_min|kg_s"
)
_BRACKETS = re.compile(r"^(.*?)\s*[\[(]\s*([^\[\]()]+?)\s*[\])]$")
_TIME = re.compile(
    r"^(t|times?|time[ _]?stamp|zeit|zeitstempel|uhrzeit|datum|date([ _/]?time)?|elapsed([ _]?time)?|sec|seconds)$",
    re.IGNORECASE,
)
_STEP = re.compile(r"^(ts|dt|t_s|sampling_?time|sample_?time)$", re.IGNORECASE)
_RATE = re.compile(r"^(fs|sampling_?rate|sample_?rate|sampling_?frequency)$", re.IGNORECASE)
_PARTS = {"s": 1, "sec": 1, "ms": 1e3, "us": 1e6, "µs": 1e6, "μs": 1e6, "ns": 1e9}  # of a second
_MULTIPLES = {"min": 60.0, "h": 3600.0, "d": 86400.0}
_OF_TIME = re.compile(rf"(.+)_({'|'.join([*_PARTS, *_MULTIPLES])})")


def split_header(header: str) -> tuple[str, str]:
    """Name and unit of a header: `force [N]`, `force (N)`, `force_N`; an index, as in `U[2]`, is no unit.

    The number that tells columns of one name apart stays with the name: `force [N].1` is `force.1` in N.
    """
    numbered = re.fullmatch(r"(.*)(\.\d+)", header)
    if numbered:
        base, unit = split_header(numbered[1])
        return (base + numbered[2], unit) if unit else (header, "")
    found = _BRACKETS.match(header)
    if found and found[1] and not re.fullmatch(r"[\d:,\s]+", found[2]):
        return found[1].strip(), found[2].strip()
    for cut in (i for i, letter in enumerate(header) if letter == "_" and i):
        if _UNITS.fullmatch(header[cut + 1 :]):
            return header[:cut], header[cut + 1 :].replace("_s", "/s").replace("_min", "/min").replace("s2", "s^2")
    return header, ""


def last_part(name: str) -> str:
    """The name of a variable without the struct or group that it is in: `u` of `data.u`."""
    return re.split(r"[./]", name)[-1]


def unit_of_time(header: str) -> tuple[str, float | None]:
    """Name of a column, and what its unit is in s: 1 without one, None for a unit that is none of time."""
    base, unit = split_header(header)
    own = _OF_TIME.fullmatch(header)
    if not unit and own and _TIME.match(last_part(own[1])):
        base, unit = own[1], own[2]
    if unit.lower() in _PARTS:
        return base, 1.0 / _PARTS[unit.lower()]
    return base, _MULTIPLES.get(unit.lower(), None if unit else 1.0)


def is_time(header: str) -> bool:
    """Whether the name says that the column holds instants."""
    base, unit = unit_of_time(header)
    return unit is not None and bool(_TIME.match(base) or _TIME.match(last_part(base)))


def step_of(header: str, value: float) -> float | None:
    """The sampling time in s where the name says that the value is one, or a rate in Hz; otherwise None."""
    base, unit = unit_of_time(header)
    if unit is not None and value > 0 and _STEP.match(last_part(base)):
        return unit * value
    base, unit_name = split_header(header)
    if value > 0 and unit_name.lower() in ("", "hz", "khz") and _RATE.match(last_part(base)):
        return 1.0 / (value * (1e3 if unit_name.lower() == "khz" else 1.0))
    return None
