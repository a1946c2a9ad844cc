"""Learners in saved models: the kind and fields of a registered one; of a Python callable a file holds neither."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from orthaug._base.errors import InputError
from orthaug._base.registry import frozen
from orthaug.models.kinds import LEARNERS
from orthaug.models.learners import Bound, Learner


def declaration_of(bound: Bound | None) -> dict[str, Any] | None:
    """What a file says of a learner; None without one."""
    if bound is None:
        return None
    return declare_learner(bound.learner) | {"nz": bound.nz, "ny": bound.ny}


def declare_learner(learner: Learner) -> dict[str, Any]:
    """Kind and fields of a registered learner; of a Python callable a file can hold neither."""
    kind = LEARNERS.kind_of(learner)
    if kind is None:
        return {"kind": "callable"}
    return {"kind": kind} | {name: getattr(learner, name) for name in _field_names(type(learner))}


def rebuilt_learner(kept: dict[str, Any], given: Learner | None, path: Path) -> Learner:
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


def _field_names(learner: type) -> list[str]:
    return [field.name for field in fields(learner) if field.init]


def bound_of(kept: dict[str, Any] | None, weights: np.ndarray, given: Learner | None, path: Path) -> Bound | None:
    """The learner that a file declares with its sizes; None for physics alone.

    Raises:
        InputError: a learner that is not known here, or has another number of weights.
    """
    if kept is None:
        return None
    bound = Bound(rebuilt_learner(kept, given, path), kept["nz"], kept["ny"])
    saved = weights.shape[-1]
    if bound.size != saved:
        raise InputError(f"{path}: the learner has {bound.size} weights, the saved one {saved}; give the same one.")
    return bound
