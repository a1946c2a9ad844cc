"""Kinds from packages that are installed beside this one, found by their entry points.

A package declares them in its `pyproject.toml`, for example

    [project.entry-points."orthaug.learners"]
    bumps = "my_package:Bumps"
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Container
from functools import cache
from importlib import metadata
from typing import Any

from orthaug._base.errors import InputError

LEARNERS = "orthaug.learners"
"""Group of learners: frozen dataclasses with `init` and `apply`."""
MEASURES = "orthaug.measures"
"""Group of measures: frozen dataclasses with `points`."""
INTEGRATORS = "orthaug.integrators"
"""Group of integrators: subclasses of `Integrator`."""
SOURCES = "orthaug.systems"
"""Group of sources of physics: subclasses of `PhysicsSource`."""
EXPORTERS = "orthaug.exporters"
"""Group of targets of `orthaug export`: frozen dataclasses with `summary`, `files`, `usage`."""
READERS = "orthaug.readers"
"""Group of readers: functions of a path that return columns by name, called as the ending."""


def entry_points(group: str) -> metadata.EntryPoints:
    """Return what installed packages declare in a group."""
    return _declared(group, tuple(map(str, sys.path)))


@cache
def _declared(group: str, path: tuple[str, ...]) -> metadata.EntryPoints:
    """Read a group from the metadata of all packages on a search path, once in a process."""
    return metadata.entry_points(group=group)


def discover(group: str, axis: str, known: Container[str], add: Callable[[str, Any], None]) -> None:
    """Load what installed packages declare in a group, and add what is not known yet.

    Args:
        group: of the entry points.
        axis: what the entries are, for messages.
        known: names that are taken, and stay.
        add: registers a loaded object; an InputError of it is raised with the place.

    Raises:
        InputError: a package that cannot be imported, or whose entry is of another kind.
    """
    for entry in entry_points(group=group):
        if entry.name in known:
            continue
        place = f"the {axis} '{entry.name}' of {entry.value}"
        try:
            declared = entry.load()
        except Exception as error:  # whatever a package does when it is imported
            raise InputError(
                f"{place} cannot be loaded ({error}); update or remove its package."
            ) from None
        try:
            add(entry.name, declared)
        except InputError as error:
            raise InputError(
                f"{place} cannot be used: {error} Update or remove its package."
            ) from None
