"""A step near a state: a small change of the state obeys `δx_{k+1} = A_k δx_k` in a free run, A_k = ∂x_{k+1}/∂x_k."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Vector
from orthaug._base.jax import Array, jax, jnp, padded_length
from orthaug.analysis.visited import Visited, positive
from orthaug.models.dynamics import Dynamics, Numbers
from orthaug.models.model import Model

_NO_DERIVATIVE = 1e100  # a derivative beyond is none
_BATCH = 1024  # rows per compiled call
_WIDTH = 1e-3  # of differences, in deviations: bears a learner in single precision


def linearised(model: Model, visited: Visited) -> tuple[Visited, Float[np.ndarray, "m n0 n0"], Vector]:
    """The points with finite derivatives, A_k there, and its spectral radii (m,)."""
    transition = transitions(model, visited.states, visited.inputs)
    finite = (np.abs(transition) < _NO_DERIVATIVE).all(axis=(1, 2))
    radius = np.abs(np.linalg.eigvals(transition[finite])).max(axis=1, initial=0.0)
    return visited.take(finite), transition[finite], radius


def transitions(
    model: Model, states: Float[np.ndarray, "m n0"], inputs: Float[np.ndarray, "m nu"]
) -> Float[np.ndarray, "m n0 n0"]:
    """A_k at m points; not finite where there is no derivative."""
    n0, size = states.shape[1], min(_BATCH, padded_length(len(states)))
    width = difference_width(states) if len(states) else np.ones(n0)
    batches = [np.zeros((0, n0, n0))]
    for begin in range(0, len(states), size):
        rows = np.minimum(np.arange(begin, begin + size), len(states) - 1)  # the last one again: one shape
        found = _transitions(model.form, model.numbers, states[rows], inputs[rows], width)
        batches.append(np.asarray(found)[: len(states) - begin])
    return np.concatenate(batches)


def difference_width(points: Float[np.ndarray, "m n"]) -> Vector:
    """How far differences reach to each side of a point, in each entry."""
    return _WIDTH * positive(points.std(axis=0))


def by_differences(function: Any, point: Any, width: Any) -> Any:
    """∂function/∂point (outputs, n) from differences of `width` (n,)."""
    aside, each = jnp.diag(width), jax.vmap(function)
    return ((each(point + aside) - each(point - aside)) / (2 * width[:, None])).T


@partial(jax.jit, static_argnames="form")
def _transitions(
    form: Dynamics, numbers: Numbers, states: Float[Array, "m n0"], inputs: Float[Array, "m nu"], width: Any
) -> Float[Array, "m n0 n0"]:
    """A_k at m points, by differences where a learner has no derivative."""

    def at(state: Any, row: Any) -> Any:
        def following(state: Any) -> Any:
            return form.step(numbers, state, row)[0]

        return jax.jacrev(following)(state) if form.differentiable else by_differences(following, state, width)

    return jax.vmap(at)(states, inputs)
