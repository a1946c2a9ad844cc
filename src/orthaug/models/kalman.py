"""An extended Kalman filter over the rows of a record: the state of a model from measurements.

`x_{k+1} = f(x_k, u_k) + w_k`, `y_k = h(x_k, u_k) + v_k` with Cov w = Q and Cov v = R (Anderson and
Moore 1979). A lagged model has its disturbance in the equation of its newest output, a motion in
the rates of its states (`models.filters`). Outputs that are NaN are missing: they add nothing, and
the estimate runs free.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import AnyArray, Array, jax, jnp, padded_length
from orthaug.data.record import Experiment, Record
from orthaug.models.dynamics import Numbers, Parts

_SIDE_BY_SIDE = 1024  # starts of predictions


class Noise(NamedTuple):
    """Covariances Q and R of the noise of a filter.

    `state` Q disturbs the outputs of a lagged model (ny, ny), or the states of a motion over a
    sample (nx, nx).

    `output` R (ny, ny) is added by the sensors; both in squared units of what they disturb.
    """

    state: Matrix
    output: Matrix


class StateEstimate(NamedTuple):
    """The state (n,) before a row, and its covariance (n, n)."""

    state: Any
    covariance: Any


class FilterRow(NamedTuple):
    """Estimates of one row: predicted outputs, and outputs and state (n,) after the measurement."""

    predicted: Any
    """(ny,), from the rows before."""
    spread: Any
    """Covariance S (ny, ny) of measured less predicted outputs."""
    outputs: Any
    """(ny,), without the sensors' noise."""
    outputs_covariance: Any
    state: Any
    state_covariance: Any
    square: Any
    """`νᵀS⁻¹ν` of the innovation ν; 0 where nothing is measured."""
    log_likelihood: Any
    """`−(νᵀS⁻¹ν + log det S + count log 2π)/2` of what is measured."""


@runtime_checkable
class Filter(Protocol):
    """The dynamics of a filter without numbers; hashable, so that compiled programs are reused."""

    @property
    def first_row(self) -> int:
        """The first row of an experiment that is estimated."""
        ...

    @property
    def hidden(self) -> bool:
        """True if the state is more than past outputs, so that some rows must determine it."""
        ...

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def disturbances(self) -> int:
        """Rows of Q."""
        ...

    def inputs(self, experiment: Experiment, record: Record) -> Matrix:
        """Return the inputs of the steps (T, nu), from the first row on."""
        ...

    def start(
        self, experiment: Experiment, record: Record, row: int, noise: Noise, size: Vector
    ) -> StateEstimate:
        """Return the estimate before a row; what is unknown has the `size` of an unknown state."""
        ...

    def unit(self, noise: Matrix, size: Vector) -> Matrix:
        """Return a disturbance Q, up to its share, from the outputs' errors or the states' size."""
        ...

    def linearised(self, numbers: Numbers) -> tuple[Matrix, Matrix, Matrix, Matrix]:
        """Return A and C at the origin, and the gains of a disturbance on state and outputs."""
        ...

    def step(self, numbers: Numbers, state: Any, inputs: Any) -> tuple[Any, Parts]:
        """Return one step without noise."""
        ...

    def row(
        self, numbers: Numbers, noise: Noise, belief: StateEstimate, inputs: Array, measured: Array
    ) -> tuple[StateEstimate, FilterRow]:
        """Return the estimates of a row from its outputs (ny,), and of the next row's state."""
        ...


def slope(function: Any, at: Array) -> tuple[Any, Any]:
    """Return a function's value (m,) and derivative (m, n); a kink without one counts as flat."""
    value, derivative = function(at), jax.jacfwd(function)(at)
    return value, jnp.where(jnp.isfinite(derivative), derivative, 0.0)


def correct(
    mean: Array, covariance: Array, noise: AnyArray, measured: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Return mean (n + ny,) and covariance of (state, outputs) after a measurement.

    `noise` (ny, ny) is the covariance of the measured outputs' noise.

    By Joseph's form, which stays positive where R is zero. Also S, `νᵀS⁻¹ν` and the log likelihood.
    """
    ny = len(measured)
    there = jnp.isfinite(measured)
    both = there[:, None] & there[None, :]
    innovation = jnp.where(there, measured - mean[-ny:], 0.0)
    spread = covariance[-ny:, -ny:] + noise
    own = jnp.where(both, spread, jnp.eye(ny))
    gain = jnp.linalg.solve(own, jnp.where(there, covariance[:, -ny:], 0.0).T).T
    left = jnp.eye(len(mean)).at[:, -ny:].add(-gain)
    after = left @ covariance @ left.T + gain @ jnp.where(both, noise, 0.0) @ gain.T
    square = innovation @ jnp.linalg.solve(own, innovation)
    count = jnp.sum(there)
    likelihood = -0.5 * (square + jnp.linalg.slogdet(own)[1] + count * jnp.log(2 * jnp.pi))
    return mean + gain @ innovation, (after + after.T) / 2, spread, square, likelihood


@partial(jax.jit, static_argnames="form")
def one_row(
    form: Filter,
    numbers: Numbers,
    noise: Noise,
    belief: StateEstimate,
    inputs: Array,
    measured: Array,
) -> tuple[StateEstimate, FilterRow]:
    """Compute one row of a filter."""
    return form.row(numbers, noise, belief, inputs, measured)


@partial(jax.jit, static_argnames="form")
def _all_rows(
    form: Filter,
    numbers: Numbers,
    noise: Noise,
    belief: StateEstimate,
    inputs: Array,
    measured: Array,
) -> tuple[StateEstimate, FilterRow]:
    """Return the estimates before the rows, and those of the rows."""

    def row(
        belief: StateEstimate, given: tuple[Any, Any]
    ) -> tuple[StateEstimate, tuple[StateEstimate, FilterRow]]:
        following, estimated = form.row(numbers, noise, belief, *given)
        return following, (belief, estimated)

    return jax.lax.scan(row, belief, (inputs, measured))[1]


@partial(jax.jit, static_argnames="form")
def _likelihood(
    form: Filter,
    numbers: Numbers,
    noise: Noise,
    belief: StateEstimate,
    inputs: Array,
    measured: Array,
) -> Array:
    def row(
        carry: tuple[StateEstimate, Array], given: tuple[Array, Array]
    ) -> tuple[tuple[StateEstimate, Any], None]:
        following, estimated = form.row(numbers, noise, carry[0], *given)
        return (following, carry[1] + estimated.log_likelihood), None

    return jax.lax.scan(row, (belief, jnp.zeros(())), (inputs, measured))[0][1]


def run_filter(
    form: Filter,
    numbers: Numbers,
    noise: Noise,
    belief: StateEstimate,
    inputs: Matrix,
    measured: Matrix,
) -> tuple[StateEstimate, FilterRow]:
    """Run a filter over all rows (T).

    Return the estimates before the rows, and those of the rows.
    """
    rows = len(inputs)
    found = _all_rows(form, numbers, noise, belief, *_pad_rows(inputs, measured))
    before, rows_of = ([np.asarray(part)[:rows] for part in one] for one in found)
    return StateEstimate(*before), FilterRow(*rows_of)


def log_likelihood(
    form: Filter,
    numbers: Numbers,
    noise: Noise,
    belief: StateEstimate,
    inputs: Matrix,
    measured: Matrix,
) -> float:
    """Return the log-likelihood of the innovations (Schweppe 1965)."""
    return float(_likelihood(form, numbers, noise, belief, *_pad_rows(inputs, measured)))


def _pad_rows(inputs: Matrix, measured: Matrix) -> tuple[Matrix, Matrix]:
    """Pad the rows with copies of the last one in which nothing is measured: they add nothing."""
    more = padded_length(len(inputs)) - len(inputs)
    behind = np.full((more, measured.shape[1]), np.nan)
    return np.concatenate([inputs, np.repeat(inputs[-1:], more, axis=0)]), np.concatenate(
        [measured, behind]
    )


@partial(jax.jit, static_argnames="form")
def _predict_outputs(
    form: Filter,
    numbers: Numbers,
    noise: Noise,
    beliefs: StateEstimate,
    inputs: Array,
    horizon: Array,
) -> tuple[Parts, Any]:
    """Return the outputs after `horizon` steps from each of m estimates, and their covariances S.

    The inputs are (m, h, nu).
    """
    unknown = jnp.full(len(noise.output), jnp.nan)

    def one(belief: StateEstimate, rows: Array) -> tuple[Parts, Any]:
        def step(i: Array, belief: StateEstimate) -> StateEstimate:
            return form.row(numbers, noise, belief, rows[i], unknown)[0]

        belief = jax.lax.fori_loop(0, horizon - 1, step, belief)
        spread = form.row(numbers, noise, belief, rows[horizon - 1], unknown)[1].spread
        return form.step(numbers, belief.state, rows[horizon - 1])[1], spread

    return jax.vmap(one)(beliefs, inputs)


def predict_outputs(
    form: Filter,
    numbers: Numbers,
    noise: Noise,
    beliefs: StateEstimate,
    inputs: Matrix,
    horizon: int,
) -> tuple[Parts, Matrix]:
    """Return the outputs `horizon` steps after each row's estimate (T), and their deviations.

    Both have the shape (T − h + 1, ny).

    The deviations are those of what would be measured.
    """
    windows = np.lib.stride_tricks.sliding_window_view(inputs, horizon, axis=0).swapaxes(1, 2)
    pieces, deviations = [], []
    for begin in range(0, len(windows), _SIDE_BY_SIDE):
        rows = slice(begin, min(begin + _SIDE_BY_SIDE, len(windows)))
        count = len(windows[rows])
        more = _SIDE_BY_SIDE - count
        chosen = [
            np.concatenate([a[rows], np.repeat(a[rows][-1:], more, axis=0)])
            for a in (*beliefs, windows)
        ]
        parts, spread = _predict_outputs(
            form, numbers, noise, StateEstimate(*chosen[:2]), chosen[2], horizon
        )
        pieces.append([np.asarray(part)[:count] for part in parts])
        deviations.append(spread_of(np.asarray(spread)[:count]))
    return Parts(*(np.concatenate(piece) for piece in zip(*pieces, strict=True))), np.concatenate(
        deviations
    )


def spread_of(covariance: np.ndarray) -> Vector:
    """Return standard deviations, of one covariance or of many."""
    return np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0.0))
