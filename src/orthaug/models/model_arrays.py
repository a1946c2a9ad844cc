"""What every saved model has: its channels, its numbers, those of its outputs, and what training left of statistics."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from orthaug.data.record import Channel, Prepared
from orthaug.models.dynamics import Numbers
from orthaug.models.statistics import Statistics

_SAID = ("structure", "measure", "sampling_time", "time_column")


def said_of(model: Any) -> dict[str, Any]:
    """What a file says of every model, whatever its physics."""
    channels = {kind: [asdict(channel) for channel in getattr(model, kind)] for kind in ("outputs", "inputs")}
    kept = model.statistics
    said = {name: getattr(model, name) for name in _SAID} | channels | {"flown": kept.flown, "verdict": kept.verdict}
    return said | ({"prepared": [asdict(step) for step in model.prepared]} if model.prepared else {})


def fields_from(declared: dict[str, Any], arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """The fields that every model has, from its file."""
    channels = {kind: tuple(Channel(**c) for c in declared[kind]) for kind in ("outputs", "inputs")}
    numbers = {"numbers": numbers_from(arrays), "statistics": statistics_from(arrays, declared)}
    fields = {name: declared[name] for name in _SAID} | channels | numbers
    prepared = tuple(Prepared(**step) for step in declared.get("prepared", ()))
    return fields | {"largest_output": arrays["largest_output"], "prepared": prepared}


def arrays_of(model: Any) -> dict[str, np.ndarray]:
    """By the names that files give them; what is None is left out."""
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
    """The model's numbers."""
    return Numbers(**{name: arrays.get(f"numbers.{name}") for name in Numbers._fields})  # type: ignore[arg-type]


def statistics_from(arrays: dict[str, np.ndarray], declared: dict[str, Any]) -> Statistics:
    """What training left."""
    return Statistics(
        gram=arrays.get("gram"),
        middle=arrays.get("middle"),
        noise=arrays.get("noise"),
        ridge=arrays["ridge"] if "ridge" in arrays else float(arrays["scalars"][0]),
        freedom=float(arrays["scalars"][1]),
        flown=bool(declared.get("flown", declared.get("kind") == "motion")),
        verdict=str(declared.get("verdict", "")),
        disturbance=arrays.get("disturbance"),
        sensor=arrays.get("sensor"),
    )
