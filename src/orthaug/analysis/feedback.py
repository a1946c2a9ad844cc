"""Dependence of a step on the one before: A_k = ∂x_{k+1}/∂x_k along a run, and spectral radius.

A small change of the state obeys `δx_{k+1} = A_k δx_k` in a free run. The state of the lagged form
is `x_k = (y_{k−1}, …, y_{k−na})`: its A_k is a companion matrix, with ∂g/∂y_{k−i} in the first ny
rows and shifts below.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Vector, positive
from orthaug._base.jax import Array, jax, jnp, quick_jit
from orthaug.analysis.visited import (
    MOST_STEPS,
    RunPoint,
    RunPoints,
    sample_free_run,
)
from orthaug.data.record import Record
from orthaug.models.dynamics import Dynamics, Numbers
from orthaug.models.model import Model
from orthaug.models.response import Response

_NO_DERIVATIVE = 1e100  # a derivative beyond is none
_BATCH = 1024  # rows per compiled call
_WIDTH = 1e-3  # of differences, in deviations: bears a learner in single precision
MOST_WORK = 4e7  # rows times n0³
_LONGEST_STATE = 200  # n0 with eigenvalues at all
_FEW_POINTS = 50  # of a run, at which its modes are looked at
_FORGOTTEN = 0.1  # share of a start that an integrator loses over the record, at most


def linearise_points(
    model: Model, visited: RunPoints
) -> tuple[RunPoints, Float[np.ndarray, "m n0 n0"], Vector]:
    """Return the points with finite derivatives, A_k there, and its spectral radii (m,)."""
    transition = transitions(model, visited.states, visited.inputs)
    finite = (np.abs(transition) < _NO_DERIVATIVE).all(axis=(1, 2))
    radius = np.abs(np.linalg.eigvals(transition[finite])).max(axis=1, initial=0.0)
    return visited.take(finite), transition[finite], radius


def integrates(model: Model, record: Record) -> bool:
    """Return whether a mode of the free run forgets hardly anything over the record."""
    if not 0 < model.form.states <= _LONGEST_STATE:
        return False
    run = sample_free_run(model, record, model.simulate(record), _FEW_POINTS)
    points, transition, _ = linearise_points(model, run.points)
    if not len(points):
        return False
    nearest = np.abs(np.linalg.eigvals(transition) - 1).min(axis=1)
    return bool((nearest * len(record) < _FORGOTTEN).all())


def transitions(
    model: Model, states: Float[np.ndarray, "m n0"], inputs: Float[np.ndarray, "m nu"]
) -> Float[np.ndarray, "m n0 n0"]:
    """Return A_k at m points; not finite where there is no derivative."""
    n0 = states.shape[1]
    width = difference_width(states) if len(states) else np.ones(n0)
    batches = [np.zeros((0, n0, n0))]
    for begin in range(0, len(states), _BATCH):
        # The last one again: one shape
        rows = np.minimum(np.arange(begin, begin + _BATCH), len(states) - 1)
        found = _transitions(model.form, model.numbers, states[rows], inputs[rows], width)
        batches.append(np.asarray(found)[: len(states) - begin])
    return np.concatenate(batches)


def difference_width(points: Float[np.ndarray, "m n"]) -> Vector:
    """Return the reach of differences to each side of a point, in each entry."""
    return _WIDTH * positive(points.std(axis=0))


def by_differences(function: Any, point: Array, width: Array) -> Array:
    """Return ∂function/∂point (outputs, n) from differences of `width` (n,)."""
    aside, each = jnp.diag(width), jax.vmap(function)
    return ((each(point + aside) - each(point - aside)) / (2 * width[:, None])).T


@partial(quick_jit, static_argnames="form")
def _transitions(
    form: Dynamics,
    numbers: Numbers,
    states: Float[Array, "m n0"],
    inputs: Float[Array, "m nu"],
    width: Array,
) -> Float[Array, "m n0 n0"]:
    """Return A_k at m points, by differences where a learner has no derivative."""

    def at(state: Array, row: Array) -> Array:
        def next_state(state: Array) -> Array:
            return form.step(numbers, state, row)[0]

        return (
            jax.jacrev(next_state)(state)
            if form.differentiable
            else by_differences(next_state, state, width)
        )

    return jax.vmap(at)(states, inputs)


@dataclass(frozen=True, eq=False)
class Feedback:
    """Dependence on the state before of m of the `steps` of a run, spread evenly.

    `transition` are the A_k in the units of the state, `radius` (m,) their spectral radii, and
    their summary is None where there are none. `skipped` points are left out because the model has
    no finite derivative there; `diverged` says in which output and where a free run left all
    bounds; `unit` (n0,) is the deviation of each entry of the state.
    """

    points: RunPoints
    transition: Float[np.ndarray, "m n0 n0"]
    radius: Vector
    unit: Vector
    largest: float | None
    median: float | None
    share_above_one: float | None
    worst: RunPoint | None
    steps: int
    skipped: int
    diverged: tuple[str, ...]


def feedback(model: Model, record: Record, *, response: Response | None = None) -> Feedback | None:
    """Return A_k = ∂x_{k+1}/∂x_k and its spectral radius along the free run.

    None without a state. At most 20000 steps up to where it diverges, spread evenly: fewer where
    the state is large, none where n0 is above 200.
    Radii below 1 do not make a nonlinear run stable, nor do some above 1 make it unstable. They say
    where to look.

    Args:
        response: the model's free run of the record, if it is there already.

    Raises:
        InputError: a record that does not fit the model.
    """
    if not (size := model.form.states):
        return None
    most = 0 if size > _LONGEST_STATE else min(MOST_STEPS, int(MOST_WORK / size**3))
    response = model.simulate(record) if response is None else response
    run = sample_free_run(model, record, response, most)
    points, transition, radius = linearise_points(model, run.points)
    largest, worst = points.worst(record, radius, model.form.describe)
    median, share = (
        (float(np.median(radius)), float(np.mean(radius > 1 + 1e-6))) if worst else (None, None)
    )
    skipped = len(run.points) - len(points)
    return Feedback(
        points,
        transition,
        radius,
        run.unit,
        largest,
        median,
        share,
        worst,
        run.steps,
        skipped,
        run.diverged,
    )
