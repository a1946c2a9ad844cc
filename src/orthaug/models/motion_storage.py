"""Saved models whose physics are equations of motion: the equations as text."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from orthaug._base.errors import InputError
from orthaug.data.expressions import parse_named
from orthaug.models.learners import Learner
from orthaug.models.model_arrays import (
    arrays_of,
    bound_of,
    declaration_of,
    fields_from,
    model_declaration,
)
from orthaug.models.motion_model import MotionModel, TrainedSegments
from orthaug.models.moving import MotionDynamics
from orthaug.physics.motion import Motion, Output, State
from orthaug.physics.parameters import PhysicalParameter

_LIMITS = {"min": -math.inf, "max": math.inf}
_SEGMENTATION = ("segment", "washout", "rows")  # of `Trained`


def declare(model: MotionModel) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the declaration of a model, and its arrays."""
    form, trained = model.form, model.trained
    declared = {
        "kind": "motion",
        **model_declaration(model),
        "motion": _declared_motion(form.motion),
        "features": [entry.text for entry in form.features],
        "learner": declaration_of(form.bound),
        "substeps": form.substeps,
        "window": model.window,
        "trained": None
        if trained is None
        else {key: getattr(trained, key) for key in _SEGMENTATION},
    }
    arrays = arrays_of(model) | {"loose": np.asarray(model.loose)}
    arrays |= {} if model.seen is None else {"seen": np.asarray(model.seen)}
    if trained is not None:
        arrays |= {
            "trained.states": np.asarray(trained.states),
            "trained.alone": np.asarray(trained.alone),
        }
        arrays |= {} if trained.slope is None else {"trained.slope": np.asarray(trained.slope)}
    return declared, arrays


def rebuild(
    declared: dict[str, Any],
    arrays: dict[str, np.ndarray],
    baseline: Any,
    learner: Learner | None,
    path: Path,
) -> MotionModel:
    """Return the model that a file declares.

    Raises:
        InputError: a callable is asked for.
    """
    motion = _rebuilt_motion(declared["motion"], baseline, path)
    form = MotionDynamics(
        motion=motion,
        features=tuple(
            parse_named(text, motion.known, "learner input") for text in declared["features"]
        ),
        bound=bound_of(
            declared["learner"], arrays.get("numbers.weights", np.zeros(0)), learner, 0, path
        ),
        sampling_time=float(declared["sampling_time"]),
        substeps=int(declared["substeps"]),
    )
    kept = declared["trained"]
    trained = None
    if kept is not None:
        layout = {key: int(kept[key]) for key in _SEGMENTATION}
        own = {key: arrays.get(f"trained.{key}") for key in ("states", "slope", "alone")}
        trained = TrainedSegments(**layout, **own)  # type: ignore[arg-type]
    return MotionModel(
        form=form,
        **fields_from(declared, arrays),
        deviation=arrays["deviation"],
        weight=arrays["output_weight"],
        loose=arrays["loose"],
        window=int(declared["window"]),
        trained=trained,
        seen=arrays.get("seen"),
    )


def _declared_motion(motion: Motion) -> dict[str, Any]:
    parameters = []
    for parameter in motion.parameters:
        given = asdict(parameter)
        parameters.append(given | {k: None for k, limit in _LIMITS.items() if given[k] == limit})
    return {
        "kind": "equations" if motion.functions is None else "callable",
        "states": [asdict(state) for state in motion.states],
        "outputs": [asdict(output) for output in motion.outputs],
        "inputs": list(motion.inputs),
        "parameters": parameters,
        "constants": dict(motion.constants),
        "define": {name: expression.text for name, expression in motion.definitions},
        "integrator": motion.integrator,
        "substeps": motion.substeps,
        "hold": motion.hold,
    }


def _rebuilt_motion(kept: dict[str, Any], given: Any, path: Path) -> Motion:
    """Return the motion that a file declares.

    For functions it is the given one, with the saved parameters.
    """
    parameters = [
        PhysicalParameter(**(p | {k: limit for k, limit in _LIMITS.items() if p[k] is None}))
        for p in kept["parameters"]
    ]
    states, outputs = [State(**s) for s in kept["states"]], [Output(**o) for o in kept["outputs"]]
    options = {name: kept[name] for name in ("integrator", "substeps", "hold")}
    if kept["kind"] == "equations":
        named = {"constants": kept["constants"], "define": kept["define"]}
        return Motion.from_equations(
            states, outputs, parameters, kept["inputs"], **named, **options
        )
    if not isinstance(given, Motion) or given.functions is None:
        raise InputError(
            f"{path}: the motion was two Python functions; give them again, load(…, "
            "baseline=Motion…)."
        )
    if given.names_of_states != tuple(s.name for s in states) or given.names != tuple(
        p.name for p in parameters
    ):
        raise InputError(
            f"{path}: the saved motion has the states {', '.join(s.name for s in states)} and "
            f"the parameters {', '.join(p.name for p in parameters)}; give the same one."
        )
    constants = tuple(kept["constants"].items())
    kept_parts = {
        "states": tuple(states),
        "outputs": tuple(outputs),
        "inputs": tuple(kept["inputs"]),
    }
    return replace(
        given, parameters=tuple(parameters), constants=constants, **kept_parts, **options
    )
