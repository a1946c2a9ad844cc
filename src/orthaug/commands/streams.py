"""Standard input, output and error that may be closed, full, or in a limited encoding."""

from __future__ import annotations

import codecs
import os
import sys
import unicodedata
from contextlib import suppress
from typing import Any, TextIO

from orthaug._base.lines import fit_screen

_PLAIN = {
    **{
        "‖": "||",
        "±": "+-",
        "…": "...",
        "–": "-",
        "−": "-",
        "×": "x",
        "·": "*",
        "⊥": "_|_",
        "ᵀ": "^T",
        "\u0303": "~",
    },
    **{
        "≤": "<=",
        "≥": ">=",
        "≠": "!=",
        "≈": "~",
        "→": "->",
        "½": "1/2",
        "\u2011": "-",
        "√": "sqrt",
        "∂": "d",
    },
    **{"✓": "", "\u0302": "^", "“": '"', "”": '"', "’": "'", "─": "-", "━": "-"},
}


def prepare() -> None:
    """Prepare the streams, so that no letter and no closed stream makes writing fail."""
    codecs.register_error("orthaug.plain", plain)
    for name, number in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "w", encoding="utf-8", closefd=False))  # noqa: SIM115
        stream = getattr(sys, name)
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="orthaug.plain")
    fit_screen(_columns())


def _columns() -> int:
    """Return the columns that lines may have: `COLUMNS`, else those of the terminal.

    0 where neither is known, as in pipes and files, where lines stay what tests and programs know.
    """
    given = os.environ.get("COLUMNS", "")
    if given.isdecimal() and int(given) > 0:
        return int(given)
    with suppress(OSError, ValueError, AttributeError):
        if sys.stdout.isatty():
            return os.get_terminal_size(sys.stdout.fileno()).columns
    return 0


def plain(error: UnicodeError) -> tuple[str, int]:
    """Return an ASCII replacement for letters that an encoding lacks.

    In JSON it is the equivalent escape.
    """
    if not isinstance(error, UnicodeEncodeError):
        raise error
    missing = error.object[error.start : error.end]
    is_json = error.object.startswith("{")
    return "".join(_escape(letter) if is_json else _plain(letter) for letter in missing), error.end


def _plain(letter: str) -> str:
    if letter in _PLAIN:
        return _PLAIN[letter]
    name = unicodedata.name(letter, "")
    if name.startswith("GREEK ") and "LETTER" in name:
        word = name.split()[-1].lower()
        return word.capitalize() if "CAPITAL" in name else word
    text = unicodedata.normalize("NFKD", letter).encode("ascii", "ignore").decode()
    return text or letter.encode("ascii", "backslashreplace").decode()


def _escape(letter: str) -> str:
    """Return a letter as JSON writes it: two escapes for one beyond 16 bits."""
    units = letter.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[i]:02x}{units[i + 1]:02x}" for i in range(0, len(units), 2))


def echo(text: str) -> None:
    """Print a result on standard output."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def say(line: str) -> None:
    """Print a line on standard error, if it can be written."""
    with suppress(OSError, ValueError):
        sys.stderr.write(line + "\n")
        sys.stderr.flush()


def silence(stream: TextIO | Any) -> None:
    """Discard what a stream still holds, so that the end of the program does not fail on it."""
    with suppress(OSError, ValueError, AttributeError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
