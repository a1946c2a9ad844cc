"""Content of an error as JSON: a code for programs, the text for people, and the place."""

from __future__ import annotations

import re
from pathlib import Path

from orthaug._base.content import Content

_KEY = re.compile(r"""(?:^|\b(?:key|column) )['"`]([\w.\[\]-]+)['"`]|^(data\.\w+):""")

_OF_FILES = ("file_not_found", "output_refused", "spec_invalid")


class PlaceResult(Content):
    """The file and the key of a spec, an option or a column at fault; null where not known."""

    file: str | None
    key: str | None


class ErrorResult(Content):
    """An error: its code is that of `orthaug._base.errors`, or of the program."""

    code: str
    text: str
    where: PlaceResult | None


class FailureResult(Content):
    """Error that a command prints instead of its result where `--json` is given."""

    error: ErrorResult

    @classmethod
    def of(cls, code: str, text: str) -> FailureResult:
        """Return the content of an error; its place is read from its text."""
        return cls(error=ErrorResult(code=code, text=text, where=place_of(text, code)))


def place_of(text: str, code: str = "") -> PlaceResult | None:
    """Return the place that a message begins with; None where it names none.

    Messages of some codes begin with a file, whatever that is called.

    Examples:
        >>> place_of("spec.toml: unknown key 'learner.hiden', did you mean 'hidden'?")
        PlaceResult(file='spec.toml', key='learner.hiden')
        >>> place_of("there is not enough memory.") is None
        True
    """
    head, colon, rest = text.partition(": ")
    file = head if colon and (code in _OF_FILES or _is_file(head)) else None
    found = _KEY.search(text if file is None else rest)
    key = None if found is None else found[1] or found[2]
    return None if file is None and key is None else PlaceResult(file=file, key=key)


def _is_file(text: str) -> bool:
    """Return whether a text is a path: with the ending of a file, or of what exists."""
    try:
        return bool(re.search(r"[^.\s/\\]\.\w{1,8}$", text)) or Path(text).exists()
    except (OSError, ValueError):
        return False
