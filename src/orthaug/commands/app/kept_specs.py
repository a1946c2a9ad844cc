"""Specs in the user's state folder: what is left of the work on the page when its server has ended."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import platformdirs

_MOST = 20  # that are kept
_MARK = 7  # letters behind the title in a file's name


def keep(title: str, key: str, spec: str) -> None:
    """Write the spec of a piece of work anew, whole or not at all; nothing where the folder cannot be written."""
    place = _folder() / f"{title}-{key[: _MARK - 1]}.toml"
    with suppress(OSError):
        place.parent.mkdir(parents=True, exist_ok=True)
        partial = place.with_suffix(".partial")
        partial.write_text(spec, encoding="utf-8")
        os.replace(partial, place)
        for old in earlier()[_MOST:]:
            old.unlink(missing_ok=True)


def earlier() -> list[Path]:
    """The specs that are kept, the latest first."""
    with suppress(OSError):
        return sorted(_folder().glob("*.toml"), key=lambda place: place.stat().st_mtime, reverse=True)
    return []


def title(place: Path) -> str:
    """What the work was called."""
    return place.stem[:-_MARK]


def _folder() -> Path:
    return platformdirs.user_state_path("orthaug") / "app"
