"""Models on disk: `model.json` for what a model is, `arrays.safetensors` for its numbers.

The files hold nothing executable.

The JSON carries checksums of itself and of the arrays. A file that was cut or altered is refused.
`pack` writes other content the same way.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays

from orthaug import __version__
from orthaug._base.checks import check_type, is_number
from orthaug._base.errors import InputError, show
from orthaug._base.folders import whole_folder
from orthaug._base.jax import jax
from orthaug.models import lagged_storage, motion_storage
from orthaug.models.learners import Learner
from orthaug.models.model import Model
from orthaug.models.motion_model import MotionModel
from orthaug.physics.baseline import Baseline
from orthaug.physics.motion import Motion

_LONGEST_LAG = 1_000_000  # rows: a state has an entry for each


def check_loaded(model: Any, path: Path) -> None:
    """Refuse a model whose numbers have other sizes than its form, or are not finite.

    Raises:
        InputError: the first part that does not fit.
    """
    if not is_number(model.sampling_time) or model.sampling_time <= 0:
        raise InputError(
            f"{path}: its sampling time is {show(model.sampling_time)}; expected a positive number."
        )
    for name in ("structure", "measure", "time_column"):
        if not isinstance(getattr(model, name), str | None):
            raise InputError(
                f"{path}: its {name} is {show(getattr(model, name))}; expected a word."
            )
    for name, value, shape in _expected_arrays(model):
        if value is None:
            raise InputError(f"{path}: the model has no {name}; it was not written by orthaug.")
        array = np.asarray(value)
        if shape is not None and array.shape != shape:
            raise InputError(
                f"{path}: {name} has the shape {array.shape}; the model's form needs {shape}."
            )
        if not np.isfinite(array).all():
            raise InputError(
                f"{path}: {name} holds a number that is not finite; fit again, or copy the "
                "model again."
            )
    for name, value in (("deviation", model.deviation), ("halfwidth", model.numbers.halfwidth)):
        if (np.asarray(value) < 0).any():
            raise InputError(f"{path}: {name} is negative; it was not written by orthaug.")
    for entry in getattr(model.form.features, "entries", model.form.features):
        if not isinstance(entry.text, str):
            raise InputError(
                f"{path}: a learner's input is {show(entry.text)}; expected an expression."
            )
    for lag in getattr(model.form, "layout", ()):
        if type(lag.lag) is not int or not 0 <= lag.lag <= _LONGEST_LAG:
            raise InputError(
                f"{path}: its layout has a lag of {show(lag.lag)}; expected 0 to "
                f"{_LONGEST_LAG} rows."
            )
    if model.form.differentiable:
        _check_step(model, path)


def _check_step(model: Any, path: Path) -> None:
    """Trace one step, which computes nothing, to check the shapes.

    Expressions, layout and learner must fit the channels and the state.
    """
    state, row = np.zeros(len(model.state_names)), np.zeros(len(model.step_inputs))
    following, outputs = jax.eval_shape(model.step, state, row)
    shapes = tuple(following.shape), tuple(outputs.shape)
    if shapes != (state.shape, (len(model.outputs),)):
        raise InputError(
            f"{path}: a step of the model makes {shapes}; its state and outputs need other shapes."
        )


def _expected_arrays(model: Any) -> Iterator[tuple[str, Any, tuple[int, ...] | None]]:
    """Return names, values and shapes of all arrays that a model computes with.

    The shape is None where something else has checked it.
    """
    form, numbers, kept = model.form, model.numbers, model.statistics
    outputs, parameters = len(model.outputs), len(model.estimated[0])
    yield "theta", numbers.theta, (parameters,)
    yield "theta_aux", numbers.theta_aux, (parameters,)
    yield "largest_output", model.largest_output, (outputs,)
    yield "deviation", model.deviation, (outputs,)
    yield "output_weight", model.weight, (outputs, outputs)
    yield "centre", numbers.centre, (form.bound.nz,)
    yield "halfwidth", numbers.halfwidth, (form.bound.nz,)
    yield "gain", numbers.gain, (form.bound.ny,)
    yield "weights", numbers.weights, None
    for name in ("tilt", "pull"):
        if getattr(numbers, name) is not None:
            yield name, getattr(numbers, name), None
    square = (outputs, outputs)
    for name, value, shape in (
        ("noise", kept.noise, square),
        ("gram", kept.gram, None),
        ("middle", kept.middle, None if kept.gram is None else np.shape(kept.gram)),
        ("disturbance", kept.disturbance, None),
        ("sensor", kept.sensor, square),
    ):
        if value is not None:
            yield name, value, shape


FORMAT = 2
_DECLARATION, _ARRAYS = "model.json", "arrays.safetensors"
_KINDS: dict[type, ModuleType] = {Model: lagged_storage, MotionModel: motion_storage}


def save(model: Model | MotionModel, folder: str | Path, *, force: bool = False) -> None:
    """Write a model to a folder of its own, whole or not at all.

    A model that `save` wrote there before is replaced.

    A baseline, motion or learner that is a Python callable cannot be written. Its numbers can;
    `load` asks for the callable.

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
        >>> physics = oa.Baseline.from_terms([oa.Term("gain", "u[k]")])
        >>> fit = oa.estimate(record, physics, learner=None)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save(fit.model, Path(folder, "model"))
        ...     load(Path(folder, "model"))
        Model(orthogonal, θ: gain, learner: none)
    """
    with whole_folder(Path(folder), force=force) as partial:
        write(model, partial)


def write(model: Model | MotionModel, folder: Path) -> None:
    """Write the two files into an existing folder."""
    write_packed(_pack(model), folder / _DECLARATION, folder / _ARRAYS)


def digest(model: Model | MotionModel) -> str:
    """Return the sha256 that identifies a model: `checksum` in the file of this version."""
    return _pack(model)[0]["checksum"]


def _pack(model: Model | MotionModel) -> tuple[dict[str, Any], bytes]:
    """Return the contents of the two files."""
    kind = _KINDS[type(model)]
    declared, arrays = kind.declare(model)
    return pack(FORMAT, declared, arrays)


def load(
    folder: str | Path, *, baseline: Baseline | Motion | None = None, learner: Learner | None = None
) -> Model | MotionModel:
    """Read a model that `save` or `orthaug fit` wrote.

    Args:
        folder: the model's folder, or the result folder that holds it as `model/`.
        baseline, learner: the Python callables again, where the saved model had such; a motion
            counts as a baseline.

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
        model = kind.rebuild(declared, arrays, baseline, learner, path)
        check_loaded(model, path)
        return model
    except InputError:
        raise
    except (
        Exception
    ) as error:  # the checksum holds, so someone made it: there is no list of what that can hold
        raise InputError(
            f"{path}: not a model of this version (missing or misplaced: {error})."
        ) from None


def pack(
    number: int, declared: Mapping[str, Any], arrays: Mapping[str, Any]
) -> tuple[dict[str, Any], bytes]:
    """Return the contents of the two files in the format of this `number`."""
    packed = save_arrays(
        {name: np.ascontiguousarray(value, dtype=np.float64) for name, value in arrays.items()}
    )
    declaration = {"format": number, "orthaug": __version__, **declared} | {
        "arrays_sha256": hashlib.sha256(packed).hexdigest()
    }
    return declaration | {"checksum": _checksum(declaration)}, packed


def write_packed(packed: tuple[dict[str, Any], bytes], path: Path, arrays: Path) -> None:
    """Write the declaration to `path`, the arrays beside it."""
    arrays.write_bytes(packed[1])
    path.write_text(json.dumps(packed[0], indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


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


def _checksum(declaration: Any) -> str:
    canonical = json.dumps(declaration, sort_keys=True, ensure_ascii=False, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()
