"""Checksums of the programs that JAX keeps on disk: one that was cut, altered or exchanged is compiled again.

JAX runs whatever it finds under a program's name. Two that are exchanged give an error, or other numbers.
"""

from __future__ import annotations

import functools
import hashlib
from contextlib import suppress
from pathlib import Path
from typing import Any

_LENGTH = hashlib.sha256().digest_size


class Checked:
    """A cache of JAX whose entries end with a checksum of their key and content; a cache without writing is silent."""

    def __init__(self, cache: Any, folder: str) -> None:
        self._cache, self._folder = cache, Path(folder)
        self._path = getattr(cache, "_path", folder)

    def get(self, key: str) -> bytes | None:
        """The content of an entry; None where there is none, or not that one."""
        try:
            entry = self._cache.get(key)
        except Exception:  # JAX words each failure in a warning of many lines
            return None
        if entry is None or entry[-_LENGTH:] == _digest(key, entry[:-_LENGTH]):
            return entry and entry[:-_LENGTH]
        with suppress(OSError):  # or what is compiled now would not be kept
            (self._folder / f"{key}-cache").unlink(missing_ok=True)
        return None

    def put(self, key: str, value: bytes) -> None:
        """Keep an entry, if it can be written."""
        with suppress(Exception):
            self._cache.put(key, value + _digest(key, value))


def _digest(key: str, content: bytes) -> bytes:
    return hashlib.sha256(key.encode() + b"\0" + content).digest()


def check_cached_programs() -> None:
    """From now on JAX's cache is a checked one. Where JAX is built otherwise than known, nothing is kept."""
    import jax

    try:
        from jax._src import compilation_cache

        make = compilation_cache.get_file_cache
    except (ImportError, AttributeError):
        jax.config.update("jax_enable_compilation_cache", False)
        return
    if hasattr(make, "__wrapped__"):
        return

    @functools.wraps(make)
    def checked(path: str) -> Any:
        try:
            made = make(path)
        except Exception:  # a place that cannot be written
            return None
        return made and (Checked(made[0], path), made[1])

    compilation_cache.get_file_cache = checked
