"""Models by plain loops over time, to compare with: Python's own `eval` for terms, NumPy for the network."""

from __future__ import annotations

from functools import cache
from types import CodeType

import numpy as np

from orthaug import MLP, Experiment, Model, Record

FUNCTIONS = {name: getattr(np, name) for name in ("sin", "cos", "exp", "abs", "sign", "tanh")}


@cache
def code(text: str) -> CodeType:
    """Return an expression as Python compiles it, once for all rows."""
    return compile(text, text, "eval")


def row(
    model: Model, signals: dict[str, np.ndarray], k: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(φθ + fixed terms, f − φθ_aux, f) at time k, each (ny,), from the signals before k (inputs up to k)."""
    form, numbers = model.form, model.numbers
    names = {**FUNCTIONS, **dict(form.baseline.constants), **signals, "k": k}
    inside, share = names, 1.0  # where the correction is read, and how much of it is left
    baseline, moved, raw = np.zeros((3, len(form.outputs)))
    if form.learns:
        z = np.array(
            [float(eval(code(str(e)), {"__builtins__": {}}, names)) for e in form.features.entries]
        )
        if numbers.limits is not None:
            low, high = numbers.limits
            held = np.minimum(np.maximum(z, low), high)
            apart = (z - held) / ((high - low) / 2)
            share = (
                float(np.exp(-((np.linalg.norm(apart) / 0.25) ** 2)))
                if form.beyond == "fade"
                else 1.0
            )
            inside = names | {name: values.copy() for name, values in signals.items()}
            for lag, move in zip(form.layout, numbers.pull @ (held - z), strict=True):
                inside[lag.channel][k - lag.lag] += move
            z = held
        raw = np.asarray(numbers.gain) * network(model, (z - numbers.centre) / numbers.halfwidth)
    for term in form.baseline.terms:
        i = form.outputs.index(term.output or form.outputs[0])
        value, there = (
            eval(code(term.regressor), {"__builtins__": {}}, own) for own in (names, inside)
        )
        if term.fixed:
            baseline[i] += term.initial * value
        else:
            j = form.baseline.names.index(term.parameter)
            baseline[i] += numbers.theta[j] * value
            moved[i] += numbers.theta_aux[j] * there
    return baseline, share * (raw - moved), raw


def network(model: Model, z: np.ndarray) -> np.ndarray:
    """The tanh network of a model at scaled features (nz,)."""
    bound = model.form.bound
    assert isinstance(bound.learner, MLP) and bound.learner.activation == "tanh"
    leaves = [np.asarray(leaf) for leaf in bound.leaves(np.asarray(model.numbers.weights))]
    for weight, bias in zip(leaves[:-2:2], leaves[1:-2:2], strict=True):
        z = np.tanh(weight @ z + bias)
    return leaves[-2] @ z + leaves[-1]


def signals_of(experiment: Experiment, record: Record) -> dict[str, np.ndarray]:
    """Channel name → samples; copies, so that a loop may write to them."""
    found = {c.name: experiment.outputs[:, i].copy() for i, c in enumerate(record.outputs)}
    return found | {c.name: experiment.inputs[:, i].copy() for i, c in enumerate(record.inputs)}


def predicted(model: Model, record: Record, horizon: int = 1) -> np.ndarray:
    """Each output (N, ny) from outputs measured up to `horizon` samples before it; NaN where there are none."""
    (experiment,) = record.experiments
    start, outputs = model.form.first_row, model.form.outputs
    found = np.full((len(experiment), len(outputs)), np.nan)
    for k in range(start + horizon - 1, len(experiment)):
        signals = signals_of(experiment, record)
        for i in range(k - horizon + 1, k + 1):
            baseline, learner, _ = row(model, signals, i)
            for name, value in zip(outputs, baseline + learner, strict=True):
                signals[name][i] = value
            found[i] = baseline + learner if i == k else found[i]
    return found


def simulated(model: Model, record: Record, initial: np.ndarray) -> np.ndarray:
    """A free run (N, ny); `initial` (start, ny) are the outputs before the first usable row."""
    (experiment,) = record.experiments
    start, outputs = model.form.first_row, model.form.outputs
    signals = {c.name: experiment.inputs[:, i] for i, c in enumerate(record.inputs)}
    own = np.full((len(experiment), len(outputs)), np.nan)
    own[:start] = initial
    signals |= {name: own[:, i] for i, name in enumerate(outputs)}
    for k in range(start, len(experiment)):
        baseline, learner, _ = row(model, signals, k)
        own[k] = baseline + learner
    own[:start] = np.nan
    return own
