"""What the user must know about a result that stands all the same."""

from __future__ import annotations

from typing import NamedTuple


class Warning(NamedTuple):  # noqa: A001  (the field's word; Python's own is never meant here)
    """A `code` for programs, in words_with_underscores, and a sentence for people."""

    code: str
    text: str

    def __str__(self) -> str:
        return self.text
