"""Initial states by least squares on the measured outputs, of many windows side by side.

A damped Gauss-Newton iteration on every start by itself: each window has its own damping and end,
which the minimizer of training, with one for all unknowns, has not. Starts that a window does not
show stay near the guess.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import Array, jax, jnp
from orthaug.models.dynamics import Dynamics, Numbers

# Times the size of a state: the distance of a start from its guess that counts as one error
LOOSE = 1e3
_FIRST_DAMPING = 1e-3
_SHORTEST, _LANES = 128, 16  # steps, and windows side by side
# Windows side by side at most: a step of 128 takes two to three times as long for each of them
MOST_LANES = 64
# Steps of few windows: rows that are not gone through cost nothing, and a program one second
_USUAL = 1024
_FEWEST = 8  # steps where each padded row is a call of the host
_SETTLED = 1e-10  # relative decrease that is not worth a step


class Windows(NamedTuple):
    """Stretches of measured rows side by side; the last axis counts them.

    Only rows that are scored count, and only outputs that were measured: others are NaN.
    """

    inputs: Float[Any, "T nu m"]
    target: Float[Any, "T ny m"]
    scored: Any
    """Inputs of each window, (T, m)."""

    def pad(self, lanes: int, *, every_row: bool) -> tuple[Windows, int]:
        """Return longer and more windows on the device, their number `lanes`, and T.

        Few shapes have programs of their own, fewer where `every_row` is False: a run then goes
        through the first T rows alone.
        """
        steps, count = np.shape(self.scored)
        usual = _USUAL if lanes <= _LANES else _SHORTEST
        length = padded_steps(steps, _FEWEST if every_row else usual)
        more = length - steps, lanes - count

        def repeat_last(part: np.ndarray) -> np.ndarray:
            return np.pad(
                part, ((0, more[0]), *((0, 0),) * (part.ndim - 2), (0, more[1])), mode="edge"
            )

        return Windows(*(jax.device_put(repeat_last(np.asarray(part))) for part in self)), steps


def _padded_lanes(count: int, every_lane: bool) -> int:
    """Return the number that windows are padded to, fewer where each is a call of the host."""
    if every_lane and count < _LANES:
        return 1 << (count - 1).bit_length()
    return count + -count % _LANES


def padded_steps(steps: int, shortest: int = _SHORTEST) -> int:
    """Return the length that the steps of a window are padded to."""
    return max(shortest, 1 << (steps - 1).bit_length())


def settle(
    form: Dynamics,
    numbers: Numbers,
    states: Float[np.ndarray, "n0 m"],
    windows: Windows,
    weight: Matrix,
    loose: Vector,
    iterations: int = 12,
    enough: float = _SETTLED,
) -> tuple[Float[np.ndarray, "n0 m"], Vector]:
    """Return the states at the windows' first rows that minimise `‖weight e‖²`, and its value (m,).

    A window ends where a step promises to lower it by less than the part `enough`: of a 10⁻¹⁰th, a
    state is within a 10⁻⁵th of its own noise. Promises fall by a constant factor from step to step,
    so the last step is the one after which the next would promise less.

    Args:
        states: where to begin.
        loose: (n0,) how far a state may be from there before that counts as much as one error.
        enough: the relative decrease that is not worth a step.
    """
    count = np.shape(states)[1]
    groups = np.array_split(np.arange(count), max(1, -(-count // MOST_LANES)))
    lanes = _padded_lanes(len(groups[0]), form.calls_host)  # one program for all of them
    found = [
        _settle_together(
            form,
            numbers,
            np.asarray(states, dtype=float)[:, own],
            Windows(*(np.asarray(part)[..., own] for part in windows)).pad(
                lanes, every_row=form.calls_host
            ),
            weight,
            np.asarray(loose, dtype=float),
            (iterations, enough),
        )
        for own in groups
    ]
    best, misfit = zip(*found, strict=True)
    return np.concatenate(best, axis=1), np.concatenate(misfit)


def _settle_together(
    form: Dynamics,
    numbers: Numbers,
    states: Float[np.ndarray, "n0 m"],
    layout: tuple[Windows, int],
    weight: Matrix,
    loose: Vector,
    until: tuple[int, float],
) -> tuple[Float[np.ndarray, "n0 m"], Vector]:
    """Return the states of windows that one program runs side by side, and their misfits (m,).

    Args:
        layout: the windows, padded to its lanes, and their steps.
        until: iterations at most, and the relative decrease that is not worth a step.
    """
    (iterations, enough), count = until, states.shape[1]
    lanes = np.shape(layout[0].scored)[1]
    begun = np.pad(states, ((0, 0), (0, lanes - count)), mode="edge")
    with np.errstate(over="ignore"):  # a start beyond all others has no prior
        prior = 1 / loose**2
    best, damping = begun, np.full(begun.shape[1], _FIRST_DAMPING)
    before = np.zeros(lanes)  # what the last step that was taken had promised
    matrix, right, misfit = _linearise_windows(form, numbers, begun, layout, weight, begun, prior)
    for _ in range(iterations):
        step = _steps(matrix, right, damping)
        with np.errstate(all="ignore"):
            promise = (step * right.T).sum(axis=0)
            ended = promise <= enough * misfit
            last = ~ended & (promise**2 <= enough * misfit * before)
        if (ended | last).all():
            best, misfit = np.where(last, best + step, best), misfit - np.where(last, promise, 0.0)
            break
        trial = np.where(ended, best, best + step)
        there = _linearise_windows(form, numbers, trial, layout, weight, begun, prior)
        lower = there[2] < misfit
        best = np.where(lower, trial, best)
        matrix = np.where(lower[:, None, None], there[0], matrix)
        right, misfit = np.where(lower[:, None], there[1], right), np.where(lower, there[2], misfit)
        before = np.where(lower, promise, 0.0)
        damping = np.where(lower, damping / 8, damping * 8)
    return best[:, :count], misfit[:count]


def _steps(
    matrix: Float[np.ndarray, "m n0 n0"], right: Float[np.ndarray, "m n0"], damping: Vector
) -> Float[np.ndarray, "n0 m"]:
    size = np.diagonal(matrix, axis1=1, axis2=2)
    with np.errstate(all="ignore"):  # a window whose run leaves all bounds takes no step
        damped = matrix + (damping[:, None] * size)[:, :, None] * np.eye(matrix.shape[1])
    sound: Any = np.isfinite(damped).all(axis=(1, 2)) & np.isfinite(right).all(axis=1)
    damped = np.where(sound[:, None, None], damped, np.eye(matrix.shape[1]))
    right = np.where(sound[:, None], right, 0.0)
    try:
        return np.linalg.solve(damped, right[..., None])[..., 0].T
    except (
        np.linalg.LinAlgError
    ):  # the matrix is singular in double precision: there is no step to take
        return np.zeros_like(right).T


def _linearise_windows(
    form: Dynamics,
    numbers: Numbers,
    states: Matrix,
    layout: tuple[Windows, int],
    weight: Matrix,
    begun: Matrix,
    prior: Vector,
) -> tuple[np.ndarray, Matrix, Vector]:
    """Return normal matrix (m, n0, n0), right-hand side (m, n0) and misfit (m,).

    The misfit is infinite where a run is not finite.
    """
    gram, square = (np.asarray(part) for part in _gram(form, numbers, states, *layout, weight))
    n0, gone = len(states), begun - states
    matrix = np.moveaxis(gram[:, :n0], -1, 0) + np.diag(prior)
    right = np.moveaxis(gram[:, n0], -1, 0) + (prior[:, None] * gone).T
    with np.errstate(all="ignore"):
        misfit = square + prior @ gone**2
    return matrix, right, np.where(np.isfinite(misfit), misfit, np.inf)


@partial(jax.jit, static_argnames="form")
def _gram(
    form: Dynamics,
    numbers: Numbers,
    states: Float[Array, "n0 m"],
    windows: Windows,
    steps: Array,
    weight: Float[Array, "ny ny"],
) -> tuple[Float[Array, "n0 n0+1 m"], Float[Array, "m"]]:
    """Return the Gram matrix of the sensitivities to the start and of the error.

    The sums are over the first `steps` of the windows.
    """
    numbers = form.prepare(numbers)
    n0, m = states.shape
    directions = jnp.eye(n0)
    first = jnp.broadcast_to(jnp.eye(n0)[..., None], (n0, n0, m))
    sums = (first, jnp.zeros((n0, n0 + 1, m)), jnp.zeros(m))

    def step_and_output(state: Array, row: Array) -> Array:
        following, parts = form.step(numbers, state, row)
        return jnp.concatenate([following, parts.total])

    def step_with_slopes(state: Array, row: Array) -> tuple[Array, Array]:
        """Return a step and its slopes (n0 + ny, n0)."""
        along = jax.vmap(
            lambda moved: jax.jvp(lambda x: step_and_output(x, row), (state,), (moved,)),
            out_axes=(None, -1),
        )
        return along(directions)

    def add(i: Any, sums: tuple[Any, ...], value: Array, slope: Any) -> tuple[Any, ...]:
        """Return slopes and sums after step i, from its values and slopes."""
        slopes, gram, square = sums
        _, target, there = (part[i] for part in windows)
        slope = jnp.where(jnp.isfinite(slope), slope, 0.0)
        # Products of lanes are no matrix products
        slope = sum(slope[:, i, None] * slopes[None, i] for i in range(n0))
        columns = jnp.concatenate([slope[n0:], (target - value[n0:])[:, None]], axis=1)
        columns = jnp.where((there & ~jnp.isnan(target))[:, None], columns, 0.0)
        columns: Any = sum(weight[:, i, None, None] * columns[None, i] for i in range(len(weight)))
        gram = gram + sum(column[:n0, None] * column[None] for column in columns)
        square = square + sum(column[n0] ** 2 for column in columns)
        return slope[:n0], gram, square

    if form.calls_host:  # the slopes of all steps at once, at the states of the run
        step = jax.vmap(lambda state, row: form.step(numbers, state, row)[0], -1, -1)
        _, run = jax.lax.scan(lambda x, row: (step(x, row), x), states, windows.inputs)
        every = jax.vmap(jax.vmap(step_with_slopes, -1, -1))(run, windows.inputs)
        return jax.lax.fori_loop(
            0, steps, lambda i, sums: add(i, sums, *(part[i] for part in every)), sums
        )[1:]

    def advance(i: Array, carry: tuple[Array, ...]) -> tuple[Array, ...]:
        state, *sums = carry
        value, slope = jax.vmap(step_with_slopes, -1, -1)(state, windows.inputs[i])
        return value[:n0], *add(i, tuple(sums), value, slope)

    return jax.lax.fori_loop(0, steps, advance, (states, *sums))[2:]
