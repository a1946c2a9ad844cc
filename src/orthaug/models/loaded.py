"""Whether the parts of a model that was read fit together: every command that loads one relies on it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from orthaug._base.checks import is_number
from orthaug._base.errors import InputError, shown
from orthaug._base.jax import jax

_LONGEST_LAG = 1_000_000  # rows: a state has an entry for each


def check_loaded(model: Any, path: Path) -> None:
    """Refuse a model whose numbers have other sizes than its form, or are not finite.

    Raises:
        InputError: the first part that does not fit.
    """
    if not is_number(model.sampling_time) or model.sampling_time <= 0:
        raise InputError(f"{path}: its sampling time is {shown(model.sampling_time)}; expected a positive number.")
    for name in ("structure", "measure", "time_column"):
        if not isinstance(getattr(model, name), str | None):
            raise InputError(f"{path}: its {name} is {shown(getattr(model, name))}; expected a word.")
    for name, value, shape in _expected(model):
        if value is None:
            raise InputError(f"{path}: the model has no {name}; it was not written by orthaug.")
        array = np.asarray(value)
        if shape is not None and array.shape != shape:
            raise InputError(f"{path}: {name} has the shape {array.shape}; the model's form needs {shape}.")
        if not np.isfinite(array).all():
            raise InputError(f"{path}: {name} holds a number that is not finite; fit again, or copy the model again.")
    for name, value in (("deviation", model.deviation), ("halfwidth", model.numbers.halfwidth)):
        if (np.asarray(value) < 0).any():
            raise InputError(f"{path}: {name} is negative; it was not written by orthaug.")
    for entry in getattr(model.form.features, "entries", model.form.features):
        if not isinstance(entry.text, str):
            raise InputError(f"{path}: a learner's input is {shown(entry.text)}; expected an expression.")
    for lag in getattr(model.form, "layout", ()):
        if type(lag.lag) is not int or not 0 <= lag.lag <= _LONGEST_LAG:
            raise InputError(f"{path}: its layout has a lag of {shown(lag.lag)}; expected 0 to {_LONGEST_LAG} rows.")
    if model.form.differentiable:
        _check_step(model, path)


def _check_step(model: Any, path: Path) -> None:
    """Trace one step, which computes nothing: expressions, layout and learner must fit the channels and the state."""
    state, row = np.zeros(len(model.state_names)), np.zeros(len(model.step_inputs))
    following, outputs = jax.eval_shape(model.step, state, row)
    shapes = tuple(following.shape), tuple(outputs.shape)
    if shapes != (state.shape, (len(model.outputs),)):
        raise InputError(f"{path}: a step of the model makes {shapes}; its state and outputs need other shapes.")


def _expected(model: Any) -> Iterator[tuple[str, Any, tuple[int, ...] | None]]:
    """Names, values and shapes of what a model computes with; None for a shape that something else has checked."""
    form, numbers, kept = model.form, model.numbers, model.statistics
    outputs, parameters = len(model.outputs), len(model.estimated[0])
    yield "theta", numbers.theta, (parameters,)
    yield "theta_aux", numbers.theta_aux, (parameters,)
    yield "largest_output", model.largest_output, (outputs,)
    yield "deviation", model.deviation, (outputs,)
    yield "output_weight", model.weight, (outputs, outputs)
    if form.bound is not None:
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
