"""What can go wrong because of what was asked, always with the remedy in the text."""

from __future__ import annotations


class InputError(ValueError):
    """Bad input. The text says what is there and what was expected. The command line exits with 2."""


class KeyedError(InputError):
    """Bad input in one key of a declaration.

    Args:
        text: the whole sentence, for users of Python.
        key: the key at fault.
        words: what a spec's or an option's message says after the key, such as `: found 3; expected less than 2`.
    """

    def __init__(self, text: str, key: str, words: str) -> None:
        super().__init__(text)
        self.key, self.words = key, words


class MissingColumnError(InputError):
    """A data file lacks a column or variable that is asked for."""


class RankError(InputError):
    """The physics columns are linearly dependent on the data; names the parameters involved."""


class PrecisionError(InputError, ImportError):
    """The environment forbids double precision."""


class TrainingError(ArithmeticError):
    """Training produced no finite model. The command line exits with 1."""
