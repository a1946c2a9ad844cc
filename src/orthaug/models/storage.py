"""Models on disk: `model.json` for what a model is, `arrays.safetensors` for its numbers; nothing executable.

The JSON carries checksums of itself and of the arrays. A file that was cut or altered is refused.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays

from orthaug import __version__
from orthaug._base.checks import check_type
from orthaug._base.errors import InputError
from orthaug._base.folders import whole_folder
from orthaug._base.registry import frozen
from orthaug.data.expressions import Expression, Lag
from orthaug.data.record import Channel
from orthaug.data.regressors import Features
from orthaug.models.dynamics import Numbers
from orthaug.models.kinds import LEARNERS
from orthaug.models.lagged import Lagged
from orthaug.models.learners import Bound, Learner
from orthaug.models.model import Model
from orthaug.models.statistics import Statistics
from orthaug.physics.baseline import Baseline, Parameter, Term

FORMAT = 2
_DECLARATION, _ARRAYS = "model.json", "arrays.safetensors"


def not_a_model(folder: Path, names: Sequence[str]) -> str | None:
    """A file in a folder without manifest that is no part of a model; None where an older version saved one."""
    return next((name for name in names if name not in (_DECLARATION, _ARRAYS)), None)


def save(model: Model, folder: str | Path, *, force: bool = False) -> None:
    """Write a model to a folder of its own, whole or not at all. A model that `save` wrote there before is replaced.

    A baseline or learner that is a Python callable cannot be written. Its numbers can; `load` asks for the callable.

    Args:
        model: what to write.
        folder: a new one, or one that holds a saved model.
        force: replace the folder whatever it holds.

    Raises:
        InputError: the folder cannot be written, or holds something else.
    """
    with whole_folder(Path(folder), not_a_model, force=force) as partial:
        write(model, partial)


def write(model: Model, folder: Path) -> None:
    """Write the two files into an existing folder."""
    numbers = {name: value for name, value in model.numbers._asdict().items() if value is not None}
    arrays = {f"numbers.{name}": np.asarray(value) for name, value in numbers.items()}
    kept = model.statistics
    arrays |= {
        "largest_output": model.largest_output,
        "deviation": model.deviation,
        "output_weight": model.weight,
        "scalars": np.array([0.0 if np.ndim(kept.ridge) else kept.ridge, kept.freedom]),
    }
    arrays |= {
        name: value
        for name, value in (
            ("gram", kept.gram),
            ("noise", kept.noise),
            ("middle", kept.middle),
            ("ridge", kept.ridge if np.ndim(kept.ridge) else None),
            ("shared", model.shared),
        )
        if value is not None
    }
    packed = save_arrays({name: np.ascontiguousarray(value, dtype=np.float64) for name, value in arrays.items()})
    declaration = _declare(model) | {"arrays_sha256": hashlib.sha256(packed).hexdigest()}
    declaration["checksum"] = _checksum(declaration)
    (folder / _ARRAYS).write_bytes(packed)
    (folder / _DECLARATION).write_text(json.dumps(declaration, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def load(folder: str | Path, *, baseline: Baseline | None = None, learner: Learner | None = None) -> Model:
    """Read a model that `save` or `orthaug fit` wrote.

    Args:
        folder: the model's folder, or the result folder that holds it as `model/`.
        baseline, learner: the Python callables again, where the saved model had such.

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
    path = folder / _DECLARATION
    try:
        declared, packed = json.loads(path.read_text(encoding="utf-8")), (folder / _ARRAYS).read_bytes()
        given = declared.pop("checksum", None) if isinstance(declared, dict) else None
        checksum = _checksum(declared)
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror}).") from None
    except (ValueError, RecursionError):
        raise InputError(f"{path}: the file is cut or altered (no JSON); fit again, or copy it again.") from None
    if not isinstance(declared, dict) or type(declared.get("format")) is not int or declared["format"] < 1:
        raise InputError(f"{path}: not a model of orthaug.")
    if declared["format"] > FORMAT:
        raise InputError(
            f"{path}: written by orthaug {declared.get('orthaug')} in format {declared['format']}; this version "
            f"({__version__}) reads up to {FORMAT}. Update orthaug."
        )
    if given != checksum:
        raise InputError(f"{path}: the file was altered (its checksum differs); fit again, or copy it again.")
    if hashlib.sha256(packed).hexdigest() != declared.get("arrays_sha256"):
        raise InputError(f"{folder / _ARRAYS}: the file is cut or altered (its checksum differs); copy it again.")
    try:
        arrays = load_arrays(packed)
    except SafetensorError as error:
        raise InputError(f"{folder / _ARRAYS}: cannot be read ({error}).") from None
    try:
        return _rebuild(declared, arrays, baseline, learner, path)
    except InputError:
        raise
    except Exception as error:  # the checksum holds, so someone made it: there is no list of what that can hold
        raise InputError(f"{path}: not a model of this version (missing or misplaced: {error}).") from None


def _declare(model: Model) -> dict[str, Any]:
    form = model.form
    learner: dict[str, Any] | None = None
    if form.bound is not None:
        learner = _declare_learner(form.bound.learner) | {"nz": form.bound.nz, "ny": form.bound.ny}
    baseline = form.baseline
    return {
        "format": FORMAT,
        "orthaug": __version__,
        "structure": model.structure,
        "measure": model.measure,
        "sampling_time": model.sampling_time,
        "time_column": model.time_column,
        "outputs": [asdict(channel) for channel in model.outputs],
        "inputs": [asdict(channel) for channel in model.inputs],
        "layout": [list(lag) for lag in form.layout],
        "features": [{"text": e.text, "constants": dict(e.constants)} for e in form.features.entries],
        "baseline": {
            "kind": "terms" if baseline.function is None else "callable",
            "parameters": [asdict(parameter) for parameter in baseline.parameters],
            "terms": [asdict(term) for term in baseline.terms],
            "constants": dict(baseline.constants),
        },
        "learner": learner,
    }


def _declare_learner(learner: Learner) -> dict[str, Any]:
    """Kind and fields of a registered learner; of a Python callable a file can hold neither."""
    kind = LEARNERS.kind_of(learner)
    if kind is None:
        return {"kind": "callable"}
    return {"kind": kind} | {name: getattr(learner, name) for name in _field_names(type(learner))}


def _field_names(learner: type) -> list[str]:
    return [field.name for field in fields(learner) if field.init]


def _rebuilt_learner(kept: dict[str, Any], given: Learner | None, path: Path) -> Learner:
    """The learner that a file declares. For a callable it is the given one."""
    kind = kept["kind"]
    if kind in LEARNERS:
        learner = LEARNERS[kind]
        return learner(**{name: frozen(kept[name]) for name in _field_names(learner) if name in kept})
    if given is not None:
        return given
    if kind != "callable":
        raise InputError(
            f"{path}: its learner is of the kind '{kind}', which is not registered here; register it, or give the "
            "learner, load(…, learner=…)."
        )
    raise InputError(f"{path}: the learner was a Python callable; give it again, load(…, learner=…).")


def _rebuild(
    declared: dict[str, Any],
    arrays: dict[str, np.ndarray],
    baseline: Baseline | None,
    learner: Learner | None,
    path: Path,
) -> Model:
    physics = declared["baseline"]
    if physics["kind"] == "terms":
        baseline = Baseline.from_terms([Term(**term) for term in physics["terms"]], physics["constants"])
    elif baseline is None:
        raise InputError(f"{path}: the baseline was a Python function; give it again, load(…, baseline=…).")
    else:
        baseline = replace(baseline, parameters=tuple(Parameter(**p) for p in physics["parameters"]))
    bound, kept = None, declared["learner"]
    if kept is not None:
        bound = Bound(_rebuilt_learner(kept, learner, path), kept["nz"], kept["ny"])
        saved = arrays["numbers.weights"].shape[-1]
        if bound.size != saved:
            raise InputError(f"{path}: the learner has {bound.size} weights, the saved one {saved}; give the same one.")
    features = Features(tuple(Expression(e["text"], tuple(e["constants"].items())) for e in declared["features"]))
    outputs, inputs_ = (tuple(Channel(**c) for c in declared[kind]) for kind in ("outputs", "inputs"))
    form = Lagged(
        baseline, features, tuple(Lag(*lag) for lag in declared["layout"]), tuple(c.name for c in outputs), bound
    )
    return Model(
        form=form,
        numbers=Numbers(**{name: arrays.get(f"numbers.{name}") for name in Numbers._fields}),  # type: ignore[arg-type]
        outputs=outputs,
        inputs=inputs_,
        sampling_time=float(declared["sampling_time"]),
        time_column=declared["time_column"],
        structure=declared["structure"],
        measure=declared["measure"],
        largest_output=arrays["largest_output"],
        deviation=arrays["deviation"] if "deviation" in arrays else 1 / arrays["weight"],
        weight=arrays["output_weight"] if "output_weight" in arrays else np.diag(arrays["weight"]),
        shared=arrays.get("shared"),
        statistics=Statistics(
            gram=arrays.get("gram"),
            middle=arrays.get("middle"),
            noise=arrays.get("noise"),
            ridge=arrays["ridge"] if "ridge" in arrays else float(arrays["scalars"][0]),
            freedom=float(arrays["scalars"][1]),
        ),
    )


def _checksum(declaration: dict[str, Any]) -> str:
    canonical = json.dumps(declaration, sort_keys=True, ensure_ascii=False, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()
