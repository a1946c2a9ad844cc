"""Compares two results: `python tests/compare_results.py BEFORE AFTER`, folders with a result.json.

Numbers are equal to 1e-9 relative. Aside stay times, the number of the schema, whether a warning is text or has a code,
and paths. The orthogonality defect, rounding of about 1e-16, may differ by 1e-12.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

RELATIVE, ROUNDING = 1e-9, 1e-12
ASIDE = {"seconds", "schema", "where"}
FOLDERS = re.compile(r"(?:[^\s:,;()]*/)+")  # of a path within a text


def differences(before: Any, after: Any, where: str = "") -> Iterator[str]:
    """What differs, each with its place."""
    key = where.rpartition(".")[2]
    if key in ASIDE:
        return
    if key == "warnings" and isinstance(before, list) and isinstance(after, list):
        before, after = ([w["text"] if isinstance(w, dict) else w for w in warnings] for warnings in (before, after))
    if isinstance(before, dict) and isinstance(after, dict):
        yield from (f"{where}.{name}: only in one of them" for name in before.keys() ^ after.keys())
        for name in (name for name in before if name in after):
            yield from differences(before[name], after[name], f"{where}.{name}" if where else name)
    elif isinstance(before, list) and isinstance(after, list):
        if len(before) != len(after):
            yield f"{where}: {len(before)} entries, then {len(after)}"
        for i, (one, other) in enumerate(zip(before, after, strict=False)):
            yield from differences(one, other, f"{where}[{i}]")
    elif not same(before, after, ROUNDING if key == "orthogonality_defect" else 0.0):
        yield f"{where}: {before!r}, then {after!r}"


def same(before: Any, after: Any, absolute: float) -> bool:
    """Whether two entries are equal, numbers to `RELATIVE` or `absolute`, texts without the folders of paths."""
    if isinstance(before, str) and isinstance(after, str):
        return FOLDERS.sub("", before) == FOLDERS.sub("", after)
    numbers = [isinstance(v, int | float) and not isinstance(v, bool) for v in (before, after)]
    if all(numbers):
        return math.isclose(before, after, rel_tol=RELATIVE, abs_tol=absolute)
    return type(before) is type(after) and before == after


def main(before: str, after: str) -> int:
    """Print the differences; 1 if there are any."""
    results = (json.loads((Path(folder) / "result.json").read_text(encoding="utf-8")) for folder in (before, after))
    told = list(differences(*results))
    print("\n".join(told) or "equal")
    return 1 if told else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
