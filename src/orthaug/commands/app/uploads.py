"""Data files that a page sends, kept in the folder of its session."""

from __future__ import annotations

import os
import re
import secrets
from pathlib import Path

from orthaug._base.errors import InputError
from orthaug._base.folders import file_digest
from orthaug.data.tables import KNOWN


def as_name(text: str) -> str:
    """Return a name that any system accepts as the name of a file."""
    return re.sub(r"[^\w. -]", "_", text).strip(" .")[-60:]


def place_for(folder: Path, name: str) -> Path:
    """Return the path under which an uploaded file of that name is kept.

    Raises:
        InputError: an ending of no data file.
    """
    plain_name = as_name(re.split(r"[/\\]", name)[-1])
    ending = Path(plain_name).suffix.lower()
    if ending not in KNOWN or not Path(plain_name).stem:
        raise InputError(
            f"'{plain_name}': unknown type of data file; expected one of {', '.join(KNOWN)}."
        )
    return folder / plain_name


def begin_file(folder: Path, name: str) -> Path:
    """Return the path of a partial file for an upload of that name.

    `keep_file` moves it to its place.

    Raises:
        InputError: an ending of no data file.
    """
    place_for(folder, name)
    return folder / f"{secrets.token_hex(8)}.partial"


def keep_file(partial: Path, name: str) -> tuple[Path, str]:
    """Move an uploaded file to its place beside it; return that and a message for the page.

    No file is replaced: other content under the same name gets a number.
    """
    first = place_for(partial.parent, name)
    place, number, digest = first, 1, file_digest(partial)
    while place.exists() and file_digest(place) != digest:
        number += 1
        place = first.with_name(f"{first.stem}-{number}{first.suffix}")
    os.replace(partial, place)
    return (
        place,
        f"another file called {first.name} is here, so this one is {place.name}"
        if number > 1
        else "",
    )
