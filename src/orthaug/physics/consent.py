"""Consent to run the native code of an FMU that a saved model contains.

A spec or a Python program that names an FMU gives it, for that file by its sha256. The command
line keeps it for the user, so that models which were fitted here open without being asked about.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from orthaug._base.errors import InputError

_LENGTH = 64  # hexadecimal digits of a sha256


class Consents:
    """The files whose code may run: those given in this process, and those kept for the user."""

    def __init__(self) -> None:
        self._given: set[str] = set()
        self.to_all = False
        """True if code runs whatever file it is in."""
        self.kept = False
        """True if what is given is kept for later processes."""

    @property
    def file(self) -> Path:
        """File of the consents, one sha256 a line."""
        import platformdirs

        return platformdirs.user_state_path("orthaug") / "fmus"

    def give(self, sha256: str) -> None:
        """Let the code of a file run; nothing is kept where all code runs anyhow."""
        if self.to_all or sha256 in self._given:
            return
        self._given.add(sha256)
        if self.kept and sha256 not in self._read():
            with suppress(OSError):  # a place that cannot be written: asked about again
                self.file.parent.mkdir(parents=True, exist_ok=True)
                with self.file.open("a", encoding="ascii") as file:
                    file.write(f"{sha256}\n")

    @contextmanager
    def given_to_all(self, wanted: bool) -> Iterator[None]:
        """Let all code run within, where that is wanted."""
        before = self.to_all
        self.to_all = before or wanted
        try:
            yield
        finally:
            self.to_all = before

    def check(self, sha256: str, file: str) -> None:
        """Raise InputError unless the code of a file may run."""
        if self.to_all or sha256 in self._given or sha256 in self._read():
            return
        raise InputError(
            f"{file}: an FMU in a saved model, native code that runs with your rights. If you "
            "trust its origin, open the model by `load(…, run_fmu=True)` or `orthaug --run-fmu "
            "COMMAND …`."
        )

    def _read(self) -> set[str]:
        """Return the consents that are kept."""
        try:
            text = self.file.read_text(encoding="ascii")
        except (OSError, ValueError):
            return set()
        return set(re.findall(rf"^[0-9a-f]{{{_LENGTH}}}$", text, re.MULTILINE))


CONSENTS = Consents()
"""Of this process."""
