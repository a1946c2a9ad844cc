"""Errors of the user's input, with the remedy in the text, on one line; and warnings.

A warning is what the user must know about a result that is valid all the same.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

LONGEST = 60  # characters of a name or value in a message
_FEW = 4  # entries of an array that is shown
# Characters of a message, and of its beginning where the middle is left out
_MOST, _HEAD = (1200, 900)
_SEARCHED = 6 * _MOST  # characters that are looked at for names and values
_QUOTED = re.compile(r"""(?<!\w)(['"`])(?!\1)(.*?)\1(?!\w)""")
_HINTED = re.compile(r"(did you mean '[^']*'\?)[;,] (\w)")  # behind a question a sentence begins
_LISTED = re.compile(r"\[[^][]+\]")
_WORD = re.compile(r"""[^\s/\\'"`]+""")


def visible(text: str) -> str:
    """Return the text with line breaks, terminal controls and invisible characters escaped."""
    return (
        text if text.isprintable() else "".join(c if c.isprintable() else _escape(c) for c in text)
    )


def show(value: Any) -> str:
    """Return a value as Python writes it, on one line, cut where it is long."""
    try:
        if math.prod(getattr(value, "shape", ())) > _FEW:
            return f"an array of shape {tuple(value.shape)}"
        return shorten(visible(" ".join(repr(value)[:_MOST].split())))
    except Exception:  # a foreign `__repr__` may do anything, and one of a huge whole number fails
        return f"a {type(value).__name__} that cannot be written"


def shorten(text: str) -> str:
    """Return at most `LONGEST` characters of a text."""
    return text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"


def message(text: str) -> str:
    """Return a message as users see it, on one line.

    Its names, values and paths are visible, and cut where they are long.
    """
    text = visible(
        _ends(_HINTED.sub(lambda found: f"{found[1]} {found[2].upper()}", text), _SEARCHED)
    )
    text = _QUOTED.sub(lambda found: f"{found[1]}{shorten(found[2])}{found[1]}", text)
    text = _LISTED.sub(lambda found: f"[{shorten(found[0][1:-1])}]", text)
    text = _WORD.sub(lambda found: shorten(found[0]), text)
    return _ends(text, _MOST)


def _ends(text: str, most: int) -> str:
    """Return the text without its middle where it is longer."""
    head = most * _HEAD // _MOST
    return text if len(text) <= most else f"{text[:head]} … {text[head - most :]}"


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


class InputError(ValueError):
    """Bad input.

    The text says what is there and what was expected. The command line exits with 2.
    """

    code: ClassVar[str] = "input_invalid"
    """For programs, in words_with_underscores; each kind of error has its own."""
    in_result = False
    """True if the result that was printed as JSON says it already."""

    def __init__(self, text: str = "") -> None:
        super().__init__(message(str(text)))


class KeyedError(InputError):
    """Bad input in one key of a declaration.

    Args:
        text: the whole sentence, for users of Python.
        key: the key at fault.
        words: what a spec's or an option's message says after the key, such as `: found 3; expected
            less than 2`.
    """

    code = "value_invalid"

    def __init__(self, text: str, key: str, words: str) -> None:
        super().__init__(text)
        self.key, self.words = key, words

    def __reduce__(self) -> Any:
        return type(self), (str(self), self.key, self.words)


class MissingFileError(InputError):
    """A file or folder that is to be read is not there."""

    code = "file_not_found"


class SpecError(InputError):
    """A spec file that is no TOML, or has unknown keys, missing keys or wrong values."""

    code = "spec_invalid"


class OutputError(InputError):
    """A file or folder that cannot be written, or that holds what is not orthaug's."""

    code = "output_refused"


class MissingColumnError(InputError):
    """A data file lacks a column or variable that is asked for."""

    code = "column_not_found"


class MissingSampleError(InputError):
    """A data file has a cell without a sample where every cell must have one."""

    code = "sample_missing"


class BadCellError(MissingSampleError):
    """A data file has a cell that is no finite number, where a sample may be missing."""

    code = "cell_invalid"


class SurplusCellsError(InputError):
    """A line of a text table has more cells than its header has names."""

    code = "surplus_cells"


class RankError(InputError):
    """The physics columns are linearly dependent on the data; names the parameters involved."""

    code = "rank_deficient"


class PrecisionError(InputError, ImportError):
    """The environment forbids double precision."""

    code = "no_double_precision"


class TrainingError(ArithmeticError):
    """Training produced no finite model. The command line exits with 1."""

    code: ClassVar[str] = "training_failed"
    in_result = False
    """True if the result that was printed as JSON says it already."""

    def __init__(self, text: str = "") -> None:
        super().__init__(message(str(text)))


@dataclass(frozen=True)
class Warning:  # noqa: A001  (the field's word; Python's own is never meant here)
    """A `code` for programs, in words_with_underscores, and a sentence for people."""

    code: str
    text: str

    def __iter__(self) -> Iterator[str]:
        """Return code and text in turn, so that `dict(fit.warnings)` has the texts by codes."""
        return iter((self.code, self.text))

    def __str__(self) -> str:
        return self.text
