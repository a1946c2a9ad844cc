"""Models on disk: `model.json` for what a model is, `arrays.safetensors` for its numbers; nothing executable.

The JSON carries checksums of itself and of the arrays. A file that was cut or altered is refused.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from orthaug._base.checks import check_type
from orthaug._base.errors import InputError
from orthaug._base.folders import whole_folder
from orthaug.models import lagged_storage, motion_storage
from orthaug.models.learners import Learner
from orthaug.models.model import Model
from orthaug.models.motion_model import MotionModel
from orthaug.models.packing import pack, read_packed, write_packed
from orthaug.physics.baseline import Baseline
from orthaug.physics.motion import Motion

FORMAT = 2
_DECLARATION, _ARRAYS = "model.json", "arrays.safetensors"
_KINDS: dict[type, ModuleType] = {Model: lagged_storage, MotionModel: motion_storage}


def not_a_model(folder: Path, names: Sequence[str]) -> str | None:
    """A file in a folder without manifest that is no part of a model; None where an older version saved one."""
    return next((name for name in names if name not in (_DECLARATION, _ARRAYS)), None)


def save(model: Model | MotionModel, folder: str | Path, *, force: bool = False) -> None:
    """Write a model to a folder of its own, whole or not at all. A model that `save` wrote there before is replaced.

    A baseline, motion or learner that is a Python callable cannot be written. Its numbers can; `load` asks for the
    callable.

    Args:
        model: what to write.
        folder: a new one, or one that holds a saved model.
        force: replace the folder whatever it holds.

    Raises:
        InputError: the folder cannot be written, or holds something else.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> import orthaug as oa
        >>> record = oa.Record.from_arrays(u=np.sin(np.arange(50.0)), y=2 * np.sin(np.arange(50.0)))
        >>> fit = oa.estimate(record, oa.Baseline.from_terms([oa.Term("gain", "u[k]")]), learner=None)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save(fit.model, Path(folder, "model"))
        ...     load(Path(folder, "model"))
        Model(orthogonal, θ: gain, learner: none)
    """
    with whole_folder(Path(folder), not_a_model, force=force) as partial:
        write(model, partial)


def write(model: Model | MotionModel, folder: Path) -> None:
    """Write the two files into an existing folder."""
    write_packed(_packed(model), folder / _DECLARATION, folder / _ARRAYS)


def digest(model: Model | MotionModel) -> str:
    """The sha256 that tells a model from others: `checksum` in the file that this version writes of it."""
    return _packed(model)[0]["checksum"]


def _packed(model: Model | MotionModel) -> tuple[dict[str, Any], bytes]:
    """What the two files hold."""
    kind = _KINDS[type(model)]
    declared, arrays = kind.declare(model)
    return pack(FORMAT, declared, arrays)


def load(
    folder: str | Path, *, baseline: Baseline | Motion | None = None, learner: Learner | None = None
) -> Model | MotionModel:
    """Read a model that `save` or `orthaug fit` wrote.

    Args:
        folder: the model's folder, or the result folder that holds it as `model/`.
        baseline, learner: the Python callables again, where the saved model had such; a motion counts as a baseline.

    Raises:
        InputError: no model there; a file that is cut, altered, or from a newer version.
    """
    check_type(folder, str | os.PathLike, "folder", "a folder's name")
    folder = Path(folder)
    try:
        if not (folder / _DECLARATION).exists() and (folder / "model" / _DECLARATION).exists():
            folder = folder / "model"
        there = (folder / _DECLARATION).is_file() and (folder / _ARRAYS).is_file()
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror}).") from None
    except ValueError:  # a NUL byte in the name
        there = False
    if not there:
        raise InputError(f"{folder}: no saved model there; expected {_DECLARATION} and {_ARRAYS}.")
    declared, arrays = read_packed(
        folder / _DECLARATION, folder / _ARRAYS, FORMAT, "model", "fit again, or copy it again"
    )
    path = folder / _DECLARATION
    try:
        kind = motion_storage if declared.get("kind") == "motion" else lagged_storage
        return kind.rebuild(declared, arrays, baseline, learner, path)
    except InputError:
        raise
    except Exception as error:  # the checksum holds, so someone made it: there is no list of what that can hold
        raise InputError(f"{path}: not a model of this version (missing or misplaced: {error}).") from None
