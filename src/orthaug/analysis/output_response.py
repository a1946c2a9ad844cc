"""First-order response of a free run's outputs to a signal added to an equation.

With `x⁺, y = step(x)` and a signal c in an equation: `s⁺ = A s + b c`, `Δy = C s + d c`, A and C
the slopes of the step along the run. The signal acts on the newest output of lagged physics, and on
a state's derivative of a motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import Array, jax, jnp, padded_length, quick_jit
from orthaug.data.record import Experiment, Record
from orthaug.fitting.whiteness import LARGEST
from orthaug.models.dynamics import Dynamics, Numbers
from orthaug.models.model import Model
from orthaug.models.response import Response

_MOST_ROWS = 20_000  # of a record whose free run is made again from other lags
_LEAST = 1e-10  # singular value over the largest


@dataclass(frozen=True, eq=False)
class LinearRun:
    """Linearised free run of one experiment of T rows, with states, slopes and errors.

    `states` are (T, n0), `error` (T, ny) is measured less run.
    """

    states: Matrix
    inputs: Matrix
    """The experiment's inputs (T, nu) at the same rows."""
    rows: Matrix
    """What the learner's features read beside the states, (T, nr)."""
    steps: Vector
    """Seconds (T,) from each row to the next."""
    error: Matrix
    to_state: Float[np.ndarray, "T n0 n0"]
    to_output: Float[np.ndarray, "T ny n0"]
    theta_to_state: Float[np.ndarray, "T n0 nt"]
    theta_to_output: Float[np.ndarray, "T ny nt"]

    def respond(
        self,
        into_state: Float[np.ndarray, "T n0 k"],
        into_output: Float[np.ndarray, "T ny k"],
        start: Matrix,
    ) -> Float[np.ndarray, "T ny k"]:
        """Return Δy of k columns added to state and output of each step, from s (n0, k) = start."""
        (t, n0), k = self.states.shape, start.shape[1]
        if not n0 or not k:
            return np.array(into_output, dtype=float)
        # The steps of √T blocks side by side: a first time for how each block's end follows its
        # beginning, from rest and from unit states, and a second time from where blocks begin
        blocks = math.isqrt(t)
        length = -(-t // blocks)
        a, b, c, found = (
            np.pad(part, ((0, blocks * length - t), (0, 0), (0, 0))).reshape(
                blocks, length, *part.shape[1:]
            )
            for part in (self.to_state, into_state, self.to_output, into_output)
        )
        ends = np.broadcast_to(np.eye(n0, n0 + k), (blocks, n0, n0 + k))
        for step in range(length):
            ends = a[:, step] @ ends
            ends[..., n0:] += b[:, step]
        state = np.empty((blocks, n0, k))
        state[0] = start
        for block in range(1, blocks):
            before = ends[block - 1]
            state[block] = before[:, :n0] @ state[block - 1] + before[:, n0:]
        for step in range(length):
            found[:, step] += c[:, step] @ state
            state = a[:, step] @ state + b[:, step]
        return found.reshape(-1, *into_output.shape[1:])[:t]

    def starts(self) -> Float[np.ndarray, "T ny n0"]:
        """Compute how the outputs follow the state at the first row."""
        n0 = self.states.shape[1]
        t, ny = self.error.shape
        return self.respond(np.zeros((t, n0, n0)), np.zeros((t, ny, n0)), np.eye(n0))

    def parameters(self) -> Float[np.ndarray, "T ny nt"]:
        """Compute how the outputs follow the parameters of the physics."""
        return self.changes(np.ones((len(self.error), 1)))[..., 0]

    def changes(self, over_time: Matrix) -> Float[np.ndarray, "T ny nt k"]:
        """Compute how the outputs follow parameters that change by k signals (T, k) over time."""
        n0, nt = self.theta_to_state.shape[1:]
        k = over_time.shape[1]
        into_state, into_output = (
            (one[..., None] * over_time[:, None, None]).reshape(*one.shape[:2], nt * k)
            for one in (self.theta_to_state, self.theta_to_output)
        )
        found = self.respond(into_state, into_output, np.zeros((n0, nt * k)))
        return found.reshape(*found.shape[:2], nt, k)


def linear_runs(model: Model, record: Record, most: int, theta: Vector) -> list[LinearRun] | None:
    """Linearise the free run over a record; None where it leaves all bounds or has no slopes.

    Args:
        most: rows of all experiments together, of which the first of each are taken.
        theta: parameters of the physics, coordinates of a motion's, instead of those of the fit.
    """
    form: Any = model.form
    if not form.differentiable:
        return None
    numbers = model.numbers._replace(theta=theta)
    runs, share = [], min(1.0, most / max(len(record), 1))
    for experiment in record.experiments:
        count = int(share * len(experiment))
        first = form.first_row
        if count - first < 2:
            continue
        part = experiment.rows(0, count)
        start = model.first_state(part, record)
        rows = np.asarray(form.inputs(part, record))
        run = _linearize(form, numbers, start, rows, part.rows(first, None), record.sampling_time)
        if run is None:
            return None
        runs.append(run)
    return runs or None


def from_fitted_start(model: Model, record: Record, free_run: Response) -> Response | None:
    """Return a free run from the lags that follow the outputs best, to first order.

    None where the record is long, an experiment short, or the run has no slopes.

    Args:
        free_run: over the record, from the measured lags.
    """
    if len(record) > _MOST_ROWS or len(record.experiments) != len(free_run.trajectories):
        return None
    runs = linear_runs(model, record, _MOST_ROWS, np.asarray(model.numbers.theta, dtype=float))
    if runs is None or len(runs) != len(record.experiments):
        return None
    found = []
    for run, trajectory in zip(runs, free_run.trajectories, strict=True):
        followed = run.starts()
        t, ny, n0 = followed.shape
        if t <= 2 * n0 or len(trajectory.errors) != t or not np.isfinite(followed).all():
            return None
        columns, error = followed.reshape(t * ny, n0), trajectory.errors.reshape(-1)
        step = np.linalg.lstsq(columns, error, rcond=_LEAST)[0]
        baseline = trajectory.baseline.copy()
        baseline[trajectory.start :] += (columns @ step).reshape(t, ny)
        whole = trajectory.whole
        if whole is not None:
            whole = whole.copy()
            whole[trajectory.start :] += (columns @ step).reshape(t, ny)
        found.append(replace(trajectory, baseline=baseline, whole=whole))
    return replace(free_run, trajectories=tuple(found))


def _linearize(
    form: Dynamics,
    numbers: Numbers,
    start: Vector,
    rows: Matrix,
    part: Experiment,
    sampling_time: float,
) -> LinearRun | None:
    count = len(rows)
    padded = np.pad(rows, ((0, padded_length(count) - count), (0, 0)), mode="edge")
    found = [np.asarray(part)[:count] for part in _linearise_run(form, numbers, start, padded)]
    states, run, a, c, b, d = found
    if not all(
        np.isfinite(part).all() and np.abs(part).max(initial=0.0) < LARGEST
        for part in (states, run)
    ):
        return None
    a, c, b, d = (np.where(np.isfinite(part), part, 0.0) for part in (a, c, b, d))
    read = form.at_samples(numbers, states, rows)
    steps = np.full(count, sampling_time) if part.steps is None else np.asarray(part.steps)
    return LinearRun(states, part.inputs, read, steps, part.outputs - run, a, c, b, d)


@partial(quick_jit, static_argnames="form")
def _linearise_run(form: Dynamics, numbers: Numbers, start: Array, rows: Array) -> Any:
    """Return states, outputs, and the slopes of both, at every row of a free run.

    The slopes are those by state and parameters.
    """

    def step(state: Array, theta: Array, row: Array) -> tuple[Any, Any]:
        own = form.prepare(numbers._replace(theta=theta))
        following, parts = form.step(own, state, row)
        return following, parts.total

    def advance(state: Array, row: Array) -> tuple[Array, tuple[Array, Array]]:
        following, output = step(state, theta, row)
        return following, (state, output)

    theta = jnp.asarray(numbers.theta)
    states, outputs = jax.lax.scan(advance, jnp.asarray(start), rows)[1]
    by_state, by_theta = (jax.vmap(jax.jacfwd(step, place), (0, None, 0)) for place in (0, 1))
    a, c = by_state(states, theta, rows)
    b, d = by_theta(states, theta, rows)
    return states, outputs, a, c, b, d
