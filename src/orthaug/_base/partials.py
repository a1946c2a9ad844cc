"""What is written before it stands in its place: named after the process, and removed when that ends early."""

from __future__ import annotations

import hashlib
import os
import platform
import secrets
import shutil
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

_PARTIAL, _OLD = ".orthaug-partial-", ".orthaug-old-"
_HOST = hashlib.sha256(platform.node().encode()).hexdigest()[:8]  # of a folder that several machines share


class Partials:
    """The partial folders and files of this process. `lock` is held while one is put in its place."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.placed: list[Path] = []
        self._open: dict[Path, Sequence[Path]] = {}
        self._swept: set[Path] = set()

    def folder(self, parent: Path, made: Sequence[Path] = ()) -> Path:
        """A new folder in `parent`; `made` are the parents that vanish with it."""
        with self.lock:
            partial = self._named(parent, made)
            partial.mkdir()
            return partial

    def file(self, parent: Path) -> Path:
        """A new empty file in `parent`."""
        with self.lock:
            partial = self._named(parent, ())
            partial.touch(exist_ok=False)
            return partial

    def shelter(self, parent: Path) -> Path:
        """A new folder for what stood there before, until the new one stands."""
        shelter = parent / _name(_OLD)
        shelter.mkdir()
        return shelter

    def stands(self, partial: Path, place: Path) -> None:
        """Note that a partial one is in its place."""
        self._open.pop(partial, None)
        self.placed.append(place)

    def discard(self, partial: Path) -> None:
        """Remove a partial one, and the parents that were made for it."""
        made = self._open.pop(partial, ())
        for _ in range(20):  # whoever writes into it may not have stopped yet
            if partial.is_dir():
                shutil.rmtree(partial, ignore_errors=True)
            else:
                with suppress(OSError):
                    partial.unlink(missing_ok=True)
            if not os.path.lexists(partial):
                break
            time.sleep(0.01)
        for parent in made:
            with suppress(OSError):  # somebody else's files are in it by now
                parent.rmdir()

    def discard_all(self) -> None:
        """Remove all of them, and let no other be made or put in its place: the process ends."""
        self.lock.acquire()
        for partial in list(self._open):
            self.discard(partial)

    def _named(self, parent: Path, made: Sequence[Path]) -> Path:
        if parent not in self._swept:
            remove_stale(parent, self._open)
            self._swept.add(parent)
        partial = parent / _name(_PARTIAL)
        self._open[partial] = made
        return partial


PARTIALS = Partials()  # of the process, as its signals are


def remove_stale(parent: Path, alive: Sequence[Path] | dict[Path, Sequence[Path]] = ()) -> None:
    """Remove what processes of this machine left in `parent` when they were killed; what stood there comes back."""
    if os.name != "posix":  # elsewhere asking for a process may end it
        return
    with suppress(OSError):
        for path in parent.iterdir():
            if path in alive or not path.name.startswith((_PARTIAL, _OLD)) or _lives(path.name):
                continue
            if path.name.startswith(_OLD):
                for old in path.iterdir():
                    if not os.path.lexists(parent / old.name):
                        old.rename(parent / old.name)
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


def _name(kind: str) -> str:
    return f"{kind}{_HOST}-{os.getpid()}-{secrets.token_hex(4)}"


def _lives(name: str) -> bool:
    """Whether the process in a name may be alive; one of another machine may be."""
    parts = name.split("-")
    if len(parts) != 5 or parts[2] != _HOST or not parts[3].isdecimal():
        return True
    process = int(parts[3])
    if process == os.getpid():  # an earlier process had the same number
        return name.startswith(_OLD)
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True
    return True
