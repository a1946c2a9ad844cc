"""Results of a spec side by side: kept when the server ends, each with its spec and its score."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from orthaug._base.errors import InputError
from orthaug.commands.app.spec_text import plain
from orthaug.commands.sections import values_by_key

_KEPT = 10  # results of one spec
_SHOWN = 3  # changes of a spec that are listed


@dataclass(frozen=True)
class KeptResult:
    """A result with the spec that it was trained by."""

    number: int
    kind: str
    """The command that made it, fit or compare."""
    folder: Path
    made: datetime
    spec: str
    change: str
    """How its spec differs from that of the result before."""
    score: str

    @property
    def name(self) -> str:
        """Its name on the page."""
        return f"result {self.number}"


def keep_result(place: Path, kind: str, made: Path, spec: str) -> None:
    """Copy the folder of a result to the others, whole or not at all; the oldest ones go.

    Raises:
        OSError: the folder cannot be written.
    """
    number = max((number for number, _ in _folders(place)), default=0) + 1
    partial = place / "partial"
    shutil.rmtree(partial, ignore_errors=True)
    shutil.copytree(made, partial)
    (partial / "spec.toml").write_text(spec, encoding="utf-8")
    partial.replace(place / f"{number:04d}-{kind}")
    for _, old in list(_folders(place))[:-_KEPT]:
        shutil.rmtree(old, ignore_errors=True)


def kept_results(place: Path) -> list[KeptResult]:
    """Return the results in a folder, the oldest first; damaged ones are left out."""
    found: list[KeptResult] = []
    for number, folder in _folders(place):
        with suppress(OSError, ValueError, KeyError, TypeError):
            spec = (folder / "spec.toml").read_text(encoding="utf-8")
            result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
            change = _change(found[-1].spec, spec) if found else "the first one kept"
            made = datetime.fromtimestamp((folder / "result.json").stat().st_mtime)
            kind = folder.name.partition("-")[2]
            found.append(KeptResult(number, kind, folder, made, spec, change, _score(result)))
    return found


def _folders(place: Path) -> Iterator[tuple[int, Path]]:
    for folder in sorted(place.glob("[0-9]*-*")):
        number = folder.name.partition("-")[0]
        if number.isdecimal():
            yield int(number), folder


def _score(result: Mapping[str, Any]) -> str:
    """Return the error of the free run: on a test, else on validation, else on training data."""
    rows = result.get("comparison")
    model = next((row for row in rows if row["name"] == result["chosen"]), rows[-1]) if rows else {}
    scores = model.get("scores") or result.get("scores") or {}
    part = next((part for part in scores if part.startswith("tests.")), None)
    part = part or ("validation" if "validation" in scores else "train")
    errors = scores.get(part, {}).get("simulation", {}).get("nrmse")
    if not errors or None in errors:
        return "no free run"
    of = f", {model['name']}" if model else ""
    return f"NRMSE {max(errors):.3g} on {part}{of}"


def _change(before: str, after: str) -> str:
    """Return in words what differs between two specs."""
    try:
        old, new = dict(values_by_key(plain(before))), dict(values_by_key(plain(after)))
    except InputError:
        return ""
    keys = [key for key in dict.fromkeys((*old, *new)) if old.get(key) != new.get(key)]
    listed = [f"{key}: {_shown(old.get(key))} → {_shown(new.get(key))}" for key in keys[:_SHOWN]]
    if len(keys) > _SHOWN:
        listed.append(f"{len(keys) - _SHOWN} more")
    return ", ".join(listed) or "the same spec again"


def _shown(value: object) -> str:
    return "none" if value is None else str(value)
