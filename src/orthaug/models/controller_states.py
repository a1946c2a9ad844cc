"""States of a controller along measured outputs: what it has read, not what the model reads.

In a free run of a loop the controller reads the model's outputs. A prediction starts from measured
rows, and until then the controller has read these, their noise included. So its states at a row
follow from the record, but for those at the first row, which the inputs it set determine where
they were measured. Dynamics of a motion in a loop alone.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import Array, jax, jnp
from orthaug.models.dynamics import Numbers
from orthaug.models.moving import MotionDynamics

_ITERATIONS = 5  # Gauss-Newton; a controller without limits ends after one
_PRIOR = 1e-9  # of a state at the first row that the inputs do not show, beside its own column


def along_measured(
    form: MotionDynamics, numbers: Numbers, run: Matrix, inputs: Matrix, outputs: Matrix
) -> Float[np.ndarray, "N nx"]:
    """Return states of a free run (N, nx) with the controller's along measured outputs (N, ny).

    Args:
        run: (N, nx) states of the free run, whose first row begins; where an output is missing,
            the controller has read the run's.
        inputs: (N, …) rows that steps read.
    """
    own = _positions(form)
    first = np.asarray(run[0])[own]
    held = [form.outputs.index(name) for name in form.motion.held if name in form.outputs]
    target = outputs[:, held]
    if held and np.isfinite(target).any():
        for _ in range(_ITERATIONS):
            _, found, slope = _follow(form, numbers, first, run, inputs, outputs)
            step = _least_squares(np.asarray(slope)[:, held], target - np.asarray(found)[:, held])
            first = first + step
            if np.all(np.abs(step) <= 1e-9 * (1 + np.abs(first))):
                break
    states = np.array(run)
    states[:, own] = np.asarray(_follow(form, numbers, first, run, inputs, outputs)[0])
    return states


def _positions(form: MotionDynamics) -> list[int]:
    names = form.motion.discrete_states
    return [i for i, name in enumerate(form.motion.names_of_states) if name in names]


def _least_squares(slope: Float[np.ndarray, "N m nd"], missed: Float[np.ndarray, "N m"]) -> Vector:
    """Return the step by which the inputs that were set follow, 0 along what they do not show."""
    rows, right = slope.reshape(-1, slope.shape[-1]), missed.ravel()
    sound = np.isfinite(rows).all(axis=1) & np.isfinite(right)
    rows, right = rows[sound], right[sound]
    matrix = rows.T @ rows
    weak = _PRIOR * np.trace(matrix) + np.finfo(float).tiny
    return np.linalg.solve(matrix + weak * np.eye(len(matrix)), rows.T @ right)


@partial(jax.jit, static_argnames="form")
def _follow(
    form: MotionDynamics,
    numbers: Numbers,
    first: Float[Array, "nd"],
    run: Float[Array, "N nx"],
    inputs: Float[Array, "N m"],
    outputs: Float[Array, "N ny"],
) -> tuple[Array, Array, Array]:
    """Return the states (N, nd), all outputs (N, ny) with the inputs set, and their slopes."""
    numbers, motion = form.prepare(numbers), form.motion
    own = np.array(_positions(form))
    p = form.parameters(numbers)

    def along(first: Array) -> tuple[Array, Array]:
        def step(state: Array, row: tuple[Array, Array, Array]) -> tuple[Any, Any]:
            x, given, measured = row
            x = x.at[own].set(state)
            now = form.inputs_at(numbers, x, given)
            model = form.observed(numbers, x, now)
            y = jnp.where(jnp.isfinite(measured), measured, model)
            u = form.now(given)
            control = motion.control(y, x, u, p, jnp)
            now = jnp.concatenate([control, u])
            following = motion.after_sample(x, y, x, now, p, jnp)
            return following[own], (state, form.observed(numbers, x, now))

        return jax.lax.scan(step, first, (run, inputs, outputs))[1]

    (states, set_inputs), slope = along(first), jax.jacfwd(lambda x: along(x)[1])(first)
    return states, set_inputs, slope
