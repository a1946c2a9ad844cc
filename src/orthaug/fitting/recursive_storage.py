"""Storage of recursive estimates: the model in a folder, JSON and safetensors beside it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from orthaug._base.checks import Matrix, Vector, check_type
from orthaug._base.errors import InputError
from orthaug._base.folders import whole_folder
from orthaug.fitting.recursion import EstimateHistory, Recursion
from orthaug.fitting.residual_band import Reference, ResidualMonitor
from orthaug.models import storage
from orthaug.models.learners import Learner
from orthaug.models.model import Model
from orthaug.models.packed_files import has_files, pack, read_packed, write_packed
from orthaug.physics.baseline import Baseline

FORMAT = 1
_DECLARATION, _ARRAYS, _MODEL = "recursive.json", "recursive.safetensors", "model"
_SUMS = ("forgetting", "errors", "freedom", "rows", "rows_squared", "oldest", "until", "determined")
_REFERENCE = ("white", "colour", "deviation", "variance", "limit")


class RecursiveState(NamedTuple):
    """The complete state of a recursive estimate."""

    model: Model
    recursion: Recursion
    watch: ResidualMonitor
    inflation: Matrix | None
    used: float
    tail: Matrix
    kept_rows: EstimateHistory
    rows: int
    outside: int
    alarms: Vector


def save(kept: RecursiveState, folder: str | Path, *, force: bool = False) -> None:
    """Write a folder of its own, whole or not at all."""
    check_type(folder, str | os.PathLike, "folder", "a folder's name")
    with whole_folder(Path(folder), force=force) as partial:
        write(kept, partial)


def write(kept: RecursiveState, folder: Path) -> None:
    """Write the files into an existing folder."""
    (folder / _MODEL).mkdir()
    storage.write(kept.model, folder / _MODEL)
    declared = {"kind": "recursive", "model": storage.digest(kept.model)}
    write_packed(pack(FORMAT, declared, _arrays(kept)), folder / _DECLARATION, folder / _ARRAYS)


def _arrays(kept: RecursiveState) -> dict[str, Any]:
    recursion, watch, kept_rows = kept.recursion, kept.watch, kept.kept_rows
    optional = {"inflation": kept.inflation, "floor": recursion.floor}
    return {
        "sums": np.array([float(getattr(recursion, name)) for name in _SUMS]),
        **{name: getattr(recursion, name) for name in ("factor", "squared", "shape", "start")},
        **{name: getattr(watch.reference, name) for name in _REFERENCE},
        "scales": np.array(watch.reference.scales),
        "past": watch.past,
        "blocks": watch.sums,
        "counts": np.array(watch.counts),
        "totals": np.array(watch.totals),
        "tail": kept.tail,
        "course": kept_rows.rows,
        "counted": np.array(
            [kept.used, kept.rows, kept.outside, kept_rows.stride, watch.level, watch.armed]
        ),
        "alarms": kept.alarms,
        **{name: value for name, value in optional.items() if value is not None},
    }


def load(folder: Any, baseline: Baseline | None, learner: Learner | None) -> RecursiveState:
    """Return the estimate that `save` wrote.

    Raises:
        InputError: no saved state there; a file that is cut, altered, or from a newer version.
    """
    check_type(folder, str | os.PathLike, "folder", "a folder's name")
    folder = Path(folder)
    if not has_files(folder, _DECLARATION, _ARRAYS):
        raise InputError(
            f"{folder}: no saved recursive estimate there; expected {_DECLARATION} and {_ARRAYS}."
        )
    path = folder / _DECLARATION
    declared, arrays = read_packed(
        path, folder / _ARRAYS, FORMAT, "recursive estimate", "copy it again"
    )
    model = storage.load(folder / _MODEL, baseline=baseline, learner=learner)
    if not model.form.separates or declared.get("model") != storage.digest(model):
        raise InputError(
            f"{folder}: its model is not that of the recursive estimate; copy the folder again."
        )
    try:
        return _rebuilt(model, arrays)
    except (KeyError, ValueError, IndexError) as error:
        raise InputError(f"{path}: not a recursive estimate of this version ({error}).") from None


def _rebuilt(model: Model, arrays: dict[str, np.ndarray]) -> RecursiveState:
    sums = dict(zip(_SUMS, arrays["sums"].tolist(), strict=True))
    sums |= {"until": int(sums["until"]), "determined": bool(sums["determined"])}
    given = {name: arrays[name] for name in ("factor", "squared", "shape", "start")}
    recursion = Recursion(**given, **sums, floor=arrays.get("floor"))
    scales = tuple(int(scale) for scale in arrays["scales"])
    watch = ResidualMonitor(Reference(**{name: arrays[name] for name in _REFERENCE}, scales=scales))
    watch.past, watch.sums = arrays["past"].copy(), arrays["blocks"].copy()
    watch.counts, watch.totals = [int(n) for n in arrays["counts"]], arrays["totals"].tolist()
    used, rows, outside, stride, watch.level, armed = arrays["counted"].tolist()
    watch.armed = bool(armed)
    kept_rows = EstimateHistory(
        len(model.outputs), len(model.theta), int(stride), list(arrays["course"])
    )
    tail, alarms = arrays["tail"].copy(), arrays["alarms"]
    return RecursiveState(
        model,
        recursion,
        watch,
        arrays.get("inflation"),
        used,
        tail,
        kept_rows,
        int(rows),
        int(outside),
        alarms,
    )
