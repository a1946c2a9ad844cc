"""Registry of sources of physics: of the package, and of others by entry points."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from orthaug._base import plugins
from orthaug._base.errors import InputError
from orthaug._base.registry import Registry
from orthaug.physics.consent import CONSENTS
from orthaug.physics.fmu import FMU
from orthaug.physics.mechanisms import MuJoCo
from orthaug.physics.sources import FileSource, PhysicsSource
from orthaug.physics.states import Origin

SOURCES = Registry(
    "source", {"fmu": FMU, "mujoco": MuJoCo}, group=plugins.SOURCES, follows=PhysicsSource
)
"""Sources by kind."""


def declare(source: Origin) -> dict[str, Any]:
    """Return kind and keys of a source, as a saved model has them.

    Raises:
        InputError: a kind that is not registered, so that nobody could read the model.
    """
    kind = SOURCES.kind_of(source)
    if kind is None:
        raise InputError(
            f"the source {type(source).__name__} has no kind, so the model cannot be saved; add "
            "it to `SOURCES`, or by an entry point."
        )
    return {"kind": kind} | source.keys()


def write_kept(source: Origin | None, folder: Path) -> None:
    """Write the copy of a source's file that a saved model keeps."""
    if isinstance(source, FileSource):
        (folder / source.kept).write_bytes(source.content)


def rebuild(declared: Mapping[str, Any], folder: Path) -> PhysicsSource:
    """Return the source that a saved model in a folder declares.

    Raises:
        InputError: an unknown kind, a file that is missing or another one, or no consent to run it.
    """
    keys = {name: value for name, value in declared.items() if name not in ("kind", "sha256")}
    if declared["kind"] not in SOURCES:
        SOURCES.discover()
    if declared["kind"] not in SOURCES:
        raise InputError(
            f"{folder}: its physics are of the kind '{declared['kind']}', which is not known here; "
            "install the package that has it."
        )
    made = SOURCES[declared["kind"]]
    if "sha256" not in declared:
        return made(**_as_tuples(keys))
    source = made(**_as_tuples(keys | {"file": str(folder / keys["file"])}))
    if not Path(source.file).is_file():
        raise InputError(
            f"{folder}: {keys['file']} is missing, a copy of the file that the physics came from; "
            "copy it there from where the model was saved."
        )
    if source.sha256 != declared["sha256"]:
        raise InputError(f"{source.file}: not the file that the model was fitted with; copy it.")
    if source.native:
        CONSENTS.check(source.sha256, source.file)
    return source


def _as_tuples(keys: Mapping[str, object]) -> dict[str, object]:
    return {name: tuple(v) if isinstance(v, list) else v for name, v in keys.items()}
