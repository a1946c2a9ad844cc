"""Proof that the free run stays bounded for any bounded inputs, far beyond the training data.

It applies where the correction is constant far out, or fades.

Far beyond its training the model is `x_{k+1} = A x_k + b(x_k, u_k)`. Where the correction is held,
or gone, and the physics is linear in the state, A is one matrix and b is bounded: with all
eigenvalues of A inside the unit circle, bounded inputs give a bounded free run. A is read off as
the derivative of a step at states far away in many directions; physics that is not linear gives
another one in each, and nothing is said.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix
from orthaug.analysis.feedback import transitions
from orthaug.models.model import Model

_FAR = (1e4, 1e7)  # times the states of the run
_DIRECTIONS = 8
_SAME = 1e-9  # of the largest entry: more is another matrix
_LONGEST_STATE = 200
# From 1: a spectral radius that close belongs to an integrator, in a million samples at least
_INTEGRATES = 1e-6


def radius_beyond(model: Model, states: Matrix, inputs: Matrix) -> float | None:
    """Return the spectral radius of A.

    None without a bounded correction, or where A is not one matrix.

    Args:
        model: fitted, with a learner.
        states: (m, n0) that a run met.
        inputs: (m, nu) of a step, there.
    """
    bound: Any = getattr(model.form, "bound", None)
    does, size = getattr(model.form, "beyond", "free"), states.shape[1]
    finite = np.isfinite(states).all(axis=1)
    if (
        does == "free"
        or model.numbers.limits is None
        or not 0 < size <= _LONGEST_STATE
        or not finite.any()
    ):
        return None
    if does != "hold" and not hasattr(bound.learner, "beyond"):
        return None
    found = [
        _far_away(_going_on(model, kind), states[finite], inputs[finite])
        for kind in sorted({does, "hold"})
    ]
    every = np.concatenate(found)
    # A correction that fades must leave the same physics as a constant one: else its share of the
    # physics changes without bound.
    if not np.isfinite(every).all() or np.ptp(every, axis=0).max() > _SAME * max(
        np.abs(every).max(), 1.0
    ):
        return None
    return float(np.abs(np.linalg.eigvals(every[0])).max())


def describe_beyond(model: Model, radius: float | None) -> str:
    """Return a sentence on what the radius says of the free run; empty without a radius."""
    if radius is None:
        return ""
    does = "fades" if model.form.beyond == "fade" else "stays constant"
    opening = f"Beyond the training data the learned correction {does}, so it is bounded. "
    if abs(radius - 1) < _INTEGRATES:
        return (
            f"{opening}The physics alone integrates there: under an input that does not average to "
            "zero the free run grows without bound."
        )
    size = f"{radius:.4g}"
    near = f"just {'below' if radius < 1 else 'above'} 1" if float(size) == 1 else size
    text = f"{opening}The physics alone has a spectral radius of {near} there"
    if radius < 1:
        return f"{text}: bounded inputs give a bounded free run. This is a proof, not a sample."
    return f"{text}, so that proves no bound of the free run there."


def _going_on(model: Model, kind: str) -> Model:
    """Return the model whose correction does something else beyond its training."""
    if kind == getattr(model.form, "beyond", kind):
        return model
    bound: Any = model.form.bound
    learner = replace(bound.learner, beyond=kind)
    form: Any = replace(model.form, bound=replace(bound, learner=learner))
    return replace(model, form=form)


def _far_away(model: Model, states: Matrix, inputs: Matrix) -> Float[np.ndarray, "m n0 n0"]:
    """Return the derivative of a step at states far away, each at inputs that the run had."""
    random = np.random.default_rng(0)
    reach = np.abs(states).max(axis=0)
    directions = random.choice([-1.0, 1.0], (_DIRECTIONS, states.shape[1])) * random.uniform(
        0.5, 1.0, (_DIRECTIONS, states.shape[1])
    )
    points = np.concatenate(
        [scale * np.where(reach > 0, reach, 1.0) * directions for scale in _FAR]
    )
    rows = inputs[random.integers(len(inputs), size=len(points))]
    with np.errstate(all="ignore"):
        return transitions(model, points, rows)
