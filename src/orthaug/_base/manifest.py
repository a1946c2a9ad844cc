"""The manifest of a folder: every file that orthaug wrote into it, with its checksum.

It tells what may be replaced: what orthaug wrote and nobody has changed.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from orthaug import __version__

MANIFEST = "manifest.json"
Foreign = Callable[[Path, Sequence[str]], str | None]
"""Of a folder without manifest, as older versions wrote them, and the names of all files in it: one that is not theirs,
None where all are."""

_OF_THE_SYSTEM = {".DS_Store", "Thumbs.db", "desktop.ini"}  # file managers write these into every folder


def write_manifest(folder: Path) -> None:
    """Write `manifest.json` about all files of a folder."""
    files = {name: file_digest(folder / name) for name in sorted(_names(folder))}
    content = {"orthaug": __version__, "files": files}
    (folder / MANIFEST).write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def not_ours(folder: Path, foreign: Foreign) -> str | None:
    """A file of a folder that orthaug did not write or that was changed, in words; None where all may be replaced."""
    listed = _read(folder / MANIFEST)
    if listed is None:
        names = list(_names(folder))
        name = foreign(folder, names) if names else None
        return None if name is None else f"{name} and is not an orthaug result"
    names = [name for name in _names(folder) if name != MANIFEST]
    for name in names:
        if name not in listed:
            return f"{name}, which orthaug did not write"
    for name in names:
        if (folder / name).is_symlink() or file_digest(folder / name) != listed[name]:
            return f"{name}, which was changed since orthaug wrote it"
    return None


def _names(folder: Path) -> Iterator[str]:
    """Relative names of all files below a folder, of links to folders too."""
    for place, folders, files in os.walk(folder):
        folders.sort()
        links = [name for name in folders if os.path.islink(os.path.join(place, name))]
        for name in sorted(files + links):
            if name not in _OF_THE_SYSTEM:
                yield Path(place, name).relative_to(folder).as_posix()


def file_digest(path: Path) -> str:
    """The sha256 of a file; empty where there is none."""
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _read(path: Path) -> dict[str, str] | None:
    """The checksums of a manifest; None where there is none of orthaug's."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(content, dict) or "orthaug" not in content or not isinstance(content.get("files"), dict):
        return None
    return content["files"]
