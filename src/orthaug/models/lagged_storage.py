"""Saved models whose physics is linear in θ on lagged signals."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from orthaug._base.errors import InputError
from orthaug.data.expressions import Expression, Lag
from orthaug.data.regressors import Features
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.learners import Learner
from orthaug.models.model import Model
from orthaug.models.model_arrays import (
    arrays_of,
    bound_of,
    declaration_of,
    fields_from,
    model_declaration,
)
from orthaug.physics.baseline import Baseline, Parameter, Term


def declare(model: Model) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the declaration of a model, and its arrays."""
    form = model.form
    baseline = form.baseline
    declared = {
        **model_declaration(model),
        "layout": [list(lag) for lag in form.layout],
        "features": [
            {"text": e.text, "constants": dict(e.constants)} for e in form.features.entries
        ],
        "baseline": {
            "kind": "terms" if baseline.function is None else "callable",
            "parameters": [asdict(parameter) for parameter in baseline.parameters],
            "terms": [asdict(term) for term in baseline.terms],
            "constants": dict(baseline.constants),
        },
        "learner": declaration_of(form.bound),
    }
    shared = {} if model.shared is None else {"shared": model.shared}
    return declared, arrays_of(model) | shared


def rebuild(
    declared: dict[str, Any],
    arrays: dict[str, np.ndarray],
    baseline: Any,
    learner: Learner | None,
    path: Path,
) -> Model:
    """Return the model that a file declares.

    Raises:
        InputError: a callable is asked for.
    """
    physics = declared["baseline"]
    if physics["kind"] == "terms":
        baseline = Baseline.from_terms(
            [Term(**term) for term in physics["terms"]], physics["constants"]
        )
    elif baseline is None:
        raise InputError(
            f"{path}: the baseline was a Python function; give it again, load(…, baseline=…)."
        )
    else:
        baseline = replace(
            baseline, parameters=tuple(Parameter(**p) for p in physics["parameters"])
        )
    names = tuple(channel["name"] for channel in declared["outputs"])
    weights = arrays.get("numbers.weights", np.zeros(0))
    bound = bound_of(declared["learner"], weights, learner, len(names), path)
    entries = tuple(
        Expression(e["text"], tuple(e["constants"].items()))
        for e in declared["features"][: bound.nz]
    )
    features = Features(entries, bound.linear)
    form = LaggedDynamics(
        baseline, features, tuple(Lag(*lag) for lag in declared["layout"]), names, bound
    )
    return Model(
        form=form,
        **fields_from(declared, arrays),
        deviation=arrays["deviation"] if "deviation" in arrays else 1 / arrays["weight"],
        weight=arrays["output_weight"] if "output_weight" in arrays else np.diag(arrays["weight"]),
        shared=arrays.get("shared"),
    )
