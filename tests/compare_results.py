"""Compares two results: `python tests/compare_results.py BEFORE AFTER`, folders with a result.json.

Numbers are equal to 1e-9 relative. Aside stay times, the number of the schema, whether a warning is text or has a code,
and paths. Rounding may differ: the orthogonality defect, of about 1e-16, by 1e-12, and a number beside larger ones (in
a list, or by name) by 1e-12 of the largest, a share by 1e-12, a mean by that of the RMS. The contraction metric is the end of a search that rounding of the model
turns elsewhere; it may differ by 1e-3.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

RELATIVE, ROUNDING, SEARCH = 1e-9, 1e-12, 1e-3
# Of the difference of two runs that agree in eight digits, and what rounding leaves of an exact integrator's
CANCELLED, CANCELLED_TO = 1e-6, 1e-12
SHARES = {"p", "share", "explained", "cosine"}  # at most one
ASIDE = {"seconds", "schema", "where"}
FOLDERS = re.compile(r"(?:[^\s:,;()]*/)+")  # of a path within a text


class Difference(NamedTuple):
    """Two entries at the same place that differ; `relative` is infinite where one is no number."""

    where: str
    before: Any
    after: Any
    relative: float = math.inf

    def __str__(self) -> str:
        size = "" if math.isinf(self.relative) else f" (relative {self.relative:.2g})"
        return f"{self.where}: {self.before!r}, then {self.after!r}{size}"


class Note(str):
    """What stands in the place of an entry, without quotes."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


ABSENT = Note("absent")


def differences(
    before: Any,
    after: Any,
    where: str = "",
    beside: float = 0.0,
    relative: float = RELATIVE,
    floor: float = ROUNDING,
) -> Iterator[Difference]:
    """What differs by more than `relative`, or `floor` of `beside`, the largest number next to it, with its place."""
    key = where.rpartition(".")[2]
    if key in ASIDE:
        return
    if key == "warnings" and isinstance(before, list) and isinstance(after, list):
        before, after = (
            [w.get("text", w) if isinstance(w, dict) else w for w in warnings]
            for warnings in (before, after)
        )
    if isinstance(before, dict) and isinstance(after, dict):
        for name in {**before, **after}:
            place, pair = (
                f"{where}.{name}" if where else name,
                [d.get(name, ABSENT) for d in (before, after)],
            )
            yield from differences(*pair, place, scale(before, name), relative, floor)
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for i, pair in enumerate(zip(before, after, strict=True)):
            yield from differences(*pair, f"{where}[{i}]", largest(before), relative, floor)
    elif isinstance(before, list) and isinstance(after, list):
        yield Difference(where, Note(f"{len(before)} entries"), Note(len(after)))
    else:
        allowed, level = relative, rounding(where, beside, floor)
        if "stability.contraction" in where:
            allowed = SEARCH
        elif "substep_bias" in where:
            allowed, level = CANCELLED, max(level, CANCELLED_TO)
        if not same(before, after, level, allowed):
            yield Difference(where, before, after, apart(before, after))


def is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def apart(before: Any, after: Any) -> float:
    """The relative difference of two numbers, infinite of anything else."""
    if not (is_number(before) and is_number(after)):
        return math.inf
    return abs(after - before) / max(abs(before), abs(after))


def largest(values: Any) -> float:
    """The largest number among the entries of a list or a mapping by parameter; fields of other meanings have none."""
    if isinstance(values, dict):
        values = (
            []
            if {"name", "value", "p", "rmse", "where", "kind", "code"} & values.keys()
            else values.values()
        )
    return max((abs(value) for value in values if is_number(value)), default=0.0)


def scale(entries: dict, name: str) -> float:
    """What an entry of a mapping is large or small beside: one for a share, the RMS for a mean."""
    return (
        1.0
        if name in SHARES
        else float(entries.get("rms") or 0.0)
        if name == "mean"
        else largest(entries)
    )


def rounding(where: str, beside: float, floor: float) -> float:
    """The absolute difference that is rounding."""
    return ROUNDING if where.endswith("orthogonality_defect") else floor * beside


def same(before: Any, after: Any, absolute: float, relative: float = RELATIVE) -> bool:
    """Whether two entries are equal, numbers to `relative` or `absolute`, texts without the folders of paths."""
    if isinstance(before, str) and isinstance(after, str):
        return FOLDERS.sub("", before) == FOLDERS.sub("", after)
    if is_number(before) and is_number(after):
        return math.isclose(before, after, rel_tol=relative, abs_tol=absolute)
    return type(before) is type(after) and before == after


def main(before: str, after: str) -> int:
    """Print the differences; 1 if there are any."""
    results = (
        json.loads((Path(folder) / "result.json").read_text(encoding="utf-8"))
        for folder in (before, after)
    )
    found = list(differences(*results))
    print("\n".join(map(str, found)) or "equal")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
