"""What a target is: it makes files of a program and its test vectors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

from orthaug.export.program import Program
from orthaug.export.vectors import Vectors

VECTORS = "vectors.csv"


@runtime_checkable
class Target(Protocol):
    """A language or tool that a model is exported to. `summary` says in one line what is made."""

    summary: str

    def files(self, program: Program, vectors: Vectors) -> Mapping[str, str | bytes]:
        """Content by file name; README.md and the test vectors are added to them.

        Raises:
            InputError: a model that this target cannot hold.
        """
        ...

    def usage(self, program: Program) -> str:
        """How to run what was made, as Markdown."""
        ...
