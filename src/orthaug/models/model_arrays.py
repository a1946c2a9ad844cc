"""Contents of every saved model: channels, numbers, statistics of training, learner.

A file holds kind and fields of a registered learner, and neither of a Python callable.
"""

from __future__ import annotations

from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from orthaug._base.errors import InputError
from orthaug._base.registry import freeze
from orthaug.data.record import Channel, Preparation
from orthaug.models.dynamics import Numbers
from orthaug.models.kinds import LEARNERS
from orthaug.models.learners import Bound, Learner, nothing_learned
from orthaug.models.statistics import Statistics

_SAID = ("structure", "measure", "sampling_time", "time_column")


def model_declaration(model: Any) -> dict[str, Any]:
    """Return the declaration that every model has, whatever its physics."""
    channels = {
        kind: [asdict(channel) for channel in getattr(model, kind)]
        for kind in ("outputs", "inputs")
    }
    kept = model.statistics
    said = (
        {name: getattr(model, name) for name in _SAID}
        | channels
        | {"flown": kept.simulated, "verdict": kept.verdict}
    )
    return said | (
        {"prepared": [asdict(step) for step in model.prepared]} if model.prepared else {}
    )


def fields_from(declared: dict[str, Any], arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return the fields that every model has, from its file."""
    channels = {kind: tuple(Channel(**c) for c in declared[kind]) for kind in ("outputs", "inputs")}
    numbers = {"numbers": numbers_from(arrays), "statistics": statistics_from(arrays, declared)}
    fields = {name: declared[name] for name in _SAID} | channels | numbers
    prepared = tuple(Preparation(**step) for step in declared.get("prepared", ()))
    return fields | {"largest_output": arrays["largest_output"], "prepared": prepared}


def arrays_of(model: Any) -> dict[str, np.ndarray]:
    """Return the arrays by the names that files give them; None is left out."""
    kept = model.statistics
    arrays = {f"numbers.{name}": value for name, value in model.numbers._asdict().items()}
    arrays |= {
        "largest_output": model.largest_output,
        "deviation": model.deviation,
        "output_weight": model.weight,
        "scalars": np.array([0.0 if np.ndim(kept.ridge) else kept.ridge, kept.freedom]),
        "gram": kept.gram,
        "noise": kept.noise,
        "middle": kept.middle,
        "disturbance": kept.disturbance,
        "sensor": kept.sensor,
        "ridge": kept.ridge if np.ndim(kept.ridge) else None,
    }
    return {name: np.asarray(value) for name, value in arrays.items() if value is not None}


def numbers_from(arrays: dict[str, np.ndarray]) -> Numbers:
    """Return the model's numbers."""
    return Numbers(
        **{n: arrays.get(f"numbers.{n}") for n in Numbers._fields}  # type: ignore[arg-type]
    )


def statistics_from(arrays: dict[str, np.ndarray], declared: dict[str, Any]) -> Statistics:
    """Return the statistics of training."""
    return Statistics(
        gram=arrays.get("gram"),
        middle=arrays.get("middle"),
        noise=arrays.get("noise"),
        ridge=arrays["ridge"] if "ridge" in arrays else float(arrays["scalars"][0]),
        freedom=float(arrays["scalars"][1]),
        simulated=bool(declared.get("flown", declared.get("kind") == "motion")),
        verdict=str(declared.get("verdict", "")),
        disturbance=arrays.get("disturbance"),
        sensor=arrays.get("sensor"),
    )


def declaration_of(bound: Bound) -> dict[str, Any] | None:
    """Return the declaration of a learner; None without one."""
    if not bound.learns:
        return None
    return declare_learner(bound.learner) | {"nz": bound.nz, "ny": bound.ny}


def declare_learner(learner: Learner) -> dict[str, Any]:
    """Return kind and fields of a learner."""
    kind = LEARNERS.kind_of(learner)
    if kind is None:
        return {"kind": "callable"}
    return {"kind": kind} | {name: getattr(learner, name) for name in _field_names(type(learner))}


def rebuilt_learner(kept: dict[str, Any], given: Learner | None, path: Path) -> Learner:
    """Return the learner that a file declares.

    For a callable it is the given one.
    """
    kind = kept["kind"]
    if kind in LEARNERS:
        learner = LEARNERS[kind]
        return learner(
            **{name: freeze(kept[name]) for name in _field_names(learner) if name in kept}
        )
    if given is not None:
        return given
    if kind != "callable":
        raise InputError(
            f"{path}: its learner is of the kind '{kind}', which is not registered here; "
            "register it, or give the learner, load(…, learner=…)."
        )
    raise InputError(
        f"{path}: the learner was a Python callable; give it again, load(…, learner=…)."
    )


def _field_names(learner: type) -> list[str]:
    return [field.name for field in fields(learner) if field.init]


def bound_of(
    kept: dict[str, Any] | None,
    weights: np.ndarray,
    given: Learner | None,
    outputs: int,
    path: Path,
) -> Bound:
    """Return the learner that a file declares with its sizes.

    Args:
        outputs: to which nothing is added where the file declares no learner.

    Raises:
        InputError: a learner that is not known here, or has another number of weights.
    """
    if kept is None:
        return nothing_learned(outputs)
    bound = Bound(rebuilt_learner(kept, given, path), kept["nz"], kept["ny"])
    saved = weights.shape[-1]
    if bound.size != saved:
        raise InputError(
            f"{path}: the learner has {bound.size} weights, the saved one {saved}; give the "
            "same one."
        )
    return bound
