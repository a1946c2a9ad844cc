"""Two files that belong together: a declaration as JSON, and its arrays, with checksums of both.

They hold nothing executable. A file that was cut or altered is refused.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays

from orthaug import __version__
from orthaug._base.errors import InputError


def pack(
    number: int, declared: Mapping[str, object], arrays: Mapping[str, np.ndarray]
) -> tuple[dict[str, Any], bytes]:
    """Return the contents of the two files in the format of this `number`."""
    packed = save_arrays(
        {name: np.ascontiguousarray(value, dtype=np.float64) for name, value in arrays.items()}
    )
    declaration = {"format": number, "orthaug": __version__, **declared} | {
        "arrays_sha256": hashlib.sha256(packed).hexdigest()
    }
    return declaration | {"checksum": _checksum(declaration)}, packed


def write_packed(packed: tuple[dict[str, object], bytes], path: Path, arrays: Path) -> None:
    """Write the declaration to `path`, the arrays beside it."""
    arrays.write_bytes(packed[1])
    path.write_text(json.dumps(packed[0], indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def has_files(folder: Path, *names: str) -> bool:
    """Return whether a folder has files of these names.

    Raises:
        InputError: a folder that cannot be read.
    """
    try:
        return all((folder / name).is_file() for name in names)
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror}).") from None
    except ValueError:  # a NUL byte in the name
        return False


def read_packed(
    path: Path, arrays: Path, number: int, what: str, again: str
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read the declaration and the arrays.

    Args:
        number: the newest format that is read.
        what: the name of the content, such as "model".
        again: what to do where a file is damaged, in words.

    Raises:
        InputError: files that are cut, altered, of a newer version, or something else.
    """
    try:
        declared, packed = json.loads(path.read_text(encoding="utf-8")), arrays.read_bytes()
        given = declared.pop("checksum", None) if isinstance(declared, dict) else None
        checksum = _checksum(declared)
    except OSError as error:
        raise InputError(f"{path.parent}: cannot be read ({error.strerror}).") from None
    except (ValueError, RecursionError):
        raise InputError(f"{path}: the file is cut or altered (no JSON); {again}.") from None
    if (
        not isinstance(declared, dict)
        or type(declared.get("format")) is not int
        or declared["format"] < 1
    ):
        raise InputError(f"{path}: not a {what} of orthaug.")
    if declared["format"] > number:
        raise InputError(
            f"{path}: written by orthaug {declared.get('orthaug')} in format "
            f"{declared['format']}; this version ({__version__}) reads up to {number}. Update "
            "orthaug."
        )
    if given != checksum:
        raise InputError(f"{path}: the file was altered (its checksum differs); {again}.")
    if hashlib.sha256(packed).hexdigest() != declared.get("arrays_sha256"):
        raise InputError(
            f"{arrays}: the file is cut or altered (its checksum differs); copy it again."
        )
    try:
        return declared, load_arrays(packed)
    except SafetensorError as error:
        raise InputError(f"{arrays}: cannot be read ({error}).") from None


def _checksum(declaration: object) -> str:
    canonical = json.dumps(declaration, sort_keys=True, ensure_ascii=False, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()
