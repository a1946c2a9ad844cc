"""New rows of a fitted lagged model: regressors across calls, φ, and what else the model adds, learner fixed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from orthaug._base.checks import Matrix, as_signal
from orthaug._base.errors import InputError
from orthaug._base.jax import Array, jax, jnp, padded_length
from orthaug.models.dynamics import Numbers
from orthaug.models.lagged import Lagged
from orthaug.models.model import Model
from orthaug.physics.output_weights import times

_BATCH = 1024
_RIM = 1e-9  # the largest of training is no extrapolation


@partial(jax.jit, static_argnames="form")
def _evaluated(form: Lagged, numbers: Numbers, x: Float[Array, "m nx"]) -> Float[Array, "m ny ntp"]:
    """`[φ, known + f − φθ_aux]` of every row, and the largest of its scaled features: 1 at the rim of training."""

    def one(row: Any) -> Any:
        phi = form.baseline.phi(row, form.layout, form.outputs, jnp)
        known = form.baseline.known(row, form.layout, form.outputs, jnp)
        added = known + form.at(numbers, row).learner
        reach = jnp.zeros_like(added)
        if form.bound is not None and form.differentiable:
            z = (form.features.evaluate(row, form.layout, jnp) - numbers.centre) / numbers.halfwidth
            reach = reach + jnp.max(jnp.abs(z), initial=0.0)
        return jnp.concatenate([phi, added[:, None], reach[:, None]], axis=1)

    return jax.vmap(one)(x)


class Whitened(NamedTuple):
    """φ (n, ny, nθ) and `y − known − (f − φθ_aux)` (n, ny) in whitened outputs: what θ is least squares of.

    `inside` (n,) is where the learner's features lie within those of training.
    """

    phi: Float[np.ndarray, "n ny nt"]
    target: Matrix
    inside: Bool[np.ndarray, "n"]


def whitened_rows(model: Model, x: Matrix, y: Matrix, numbers: Numbers | None = None) -> Whitened:
    """Rows of measured regressors x (n, nx) and outputs y (n, ny).

    Args:
        numbers: the model's, where JAX has them already: a call with few rows is faster.

    Raises:
        InputError: physics or learner that is not finite on a row.
    """
    pieces, numbers = [], model.numbers if numbers is None else numbers
    size = 1 if len(x) == 1 else min(_BATCH, padded_length(len(x)))
    for begin in range(0, len(x), size):
        rows = x[begin : begin + size]
        padded = np.concatenate([rows, np.repeat(rows[-1:], size - len(rows), axis=0)]) if len(rows) < size else rows
        pieces.append(np.asarray(_evaluated(model.form, numbers, padded))[: len(rows)])
    values = np.concatenate(pieces) if len(pieces) > 1 else pieces[0]
    bad = ~np.isfinite(values).all(axis=(1, 2))
    if bad.any():
        row = x[int(np.argmax(bad))]
        at = ", ".join(f"{lag} = {value:.6g}" for lag, value in zip(model.form.layout, row, strict=True))
        raise InputError(f"physics or learner has no finite value at {at}; give NaN for such a row, or mend the data.")
    inside = np.asarray(values[:, 0, -1] <= 1 + _RIM)
    return Whitened(times(model.weight, values[..., :-2]), times(model.weight, y - values[..., -2]), inside)


@dataclass(frozen=True, eq=False)
class Lagging:
    """Regressors of rows that are handed in a few at a time, from the rows before them."""

    model: Model

    @cached_property
    def nothing(self) -> Matrix:
        """The tail (largest lag, ny + nu) behind which there is a gap."""
        return np.full((self.model.form.first_row, len(self.model.outputs) + len(self.model.inputs)), np.nan)

    @cached_property
    def _read(self) -> tuple[Int[np.ndarray, "nx"], Int[np.ndarray, "nx"]]:
        """Lag and column of every entry of the regressor."""
        names = [channel.name for channel in (*self.model.outputs, *self.model.inputs)]
        layout = self.model.form.layout
        return np.array([e.lag for e in layout], dtype=int), np.array(
            [names.index(e.channel) for e in layout], dtype=int
        )

    def regressors(self, tail: Matrix, rows: Matrix) -> tuple[Matrix, Bool[np.ndarray, "n"], Matrix]:
        """x (n, nx) of new rows (n, ny + nu), which of them are complete, and the tail after them."""
        whole = np.concatenate([tail, rows])
        lag, column = self._read
        x = whole[(len(tail) + np.arange(len(rows)))[:, None] - lag, column]
        needed = np.concatenate([x, rows[:, : len(self.model.outputs)]], axis=1)
        complete = np.asarray(np.isfinite(needed).all(axis=1))
        return x, complete, whole[len(whole) - len(tail) :]


def as_rows(values: Any, channels: int, name: str) -> Matrix:
    """One row or many (n, channels); NaN is a missing sample.

    Raises:
        InputError: no numbers, another number of channels, or an infinite one.
    """
    try:
        array = as_signal(values, name) if np.iscomplexobj(values) else np.asarray(values, dtype=float)
    except (TypeError, ValueError, OverflowError):
        array = as_signal(values, name)  # says what is wrong
    if array.ndim == 0 or (array.ndim == 1 and channels != 1):
        array = array.reshape(1, -1)
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2 or np.isinf(array).any():
        as_signal(np.where(np.isnan(array), 0.0, array), name)
    if array.shape[1] != channels:
        raise InputError(f"`{name}` has {array.shape[1]} columns; expected {channels}, one for each channel.")
    return array


def joined_rows(u: Any, y: Any, inputs: int, outputs: int) -> Matrix:
    """Outputs and inputs side by side (n, ny + nu), as they are handed in.

    Raises:
        InputError: one of them missing, or of another length.
    """
    if y is None or (u is None and inputs):
        what = "`y`" if y is None else "`u`"
        raise InputError(f"{what} is missing; give the measured outputs `y`{' and inputs `u`' if inputs else ''}.")
    right = as_rows(y, outputs, "y")
    left = as_rows(u, inputs, "u") if inputs else np.zeros((len(right), 0))
    if len(left) != len(right):
        raise InputError(f"`y` has {len(right)} rows but `u` has {len(left)}. Give both the same length.")
    return np.concatenate([right, left], axis=1)
