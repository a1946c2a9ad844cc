"""Steepness of the one-step predictor: gradients over measured regressors (`cond:pred_stab`)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from orthaug._base.checks import Matrix, Vector, positive
from orthaug._base.errors import InputError
from orthaug._base.jax import Array, jax, jnp, quick_jit
from orthaug.analysis.feedback import by_differences, difference_width
from orthaug.analysis.visited import MOST_STEPS, RowIndex, RunPoint, even_indices, usable
from orthaug.data.record import Record
from orthaug.models.dynamics import Numbers
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.model import Model

_BATCH = 1024  # rows per compiled call
_BATCH_CELLS = 4_000_000  # entries of ∂g/∂w in a batch
_MOST_CELLS = 40_000_000  # entries of ∂²g/∂w∂x of all rows that are looked at
_FEWEST = 16  # rows, however many weights


@dataclass(frozen=True)
class Lipschitz:
    """Largest ‖∂g/∂x‖, ‖∂φ/∂x‖ and ‖∂²g/∂w∂x‖ (Frobenius, no less than ‖·‖₂) over rows.

    None where none is finite.

    ∂g/∂x is (ny, nx) in output units per regressor unit, ∂φ/∂x is (ny nθ, nx), ∂²g/∂w∂x is (ny nw,
    nx) at `weights_rows` of the rows. The scaled ones, and the places, are for regressors and
    outputs in their standard deviations and columns of φ in their RMS. Of a learner without weights
    or derivative `weights` is None.
    """

    gradient: float | None
    gradient_scaled: float | None
    worst: RunPoint | None
    phi: float | None
    phi_scaled: float | None
    phi_worst: RunPoint | None
    weights: float | None
    weights_scaled: float | None
    weights_worst: RunPoint | None
    rows: int
    weights_rows: int


def lipschitz(model: Model, record: Record, *, x: Matrix | None = None) -> Lipschitz | None:
    """Return gradients of the one-step predictor g, of ∂g/∂θ = φ and of ∂g/∂w, over the regressors.

    The regressors are measured ones (`cond:pred_stab`).

    The predictor γ_k = g(x_k) reads the last n samples only. With ‖∂g/∂x‖ ≤ L on a convex set of
    all regressors, `|γ − γ̃| ≤ L Σ_{i≥k−n} (|u_i − ũ_i| + |y_i − ỹ_i|) ≤ L λ⁻ⁿ Γ_k` for every λ in
    (0, 1), because λ^{k−i} ≥ λⁿ there: the condition holds with `C = max(L λ⁻ⁿ, |g(0)|)`, and
    likewise for ∂γ/∂θ and ∂γ/∂w. Bounded gradients are all that it asks of a finite memory. Here
    θ_aux is a number. Where it follows w, as in the paper, ∂γ/∂w is `∂g/∂w − φK` with the constant
    K = ∂θ_aux/∂w, and bounded when these two are.

    The bounds are those of at most 20000 measured rows, fewer for many weights, and of these θ and
    w, where the condition asks for all; they may be larger elsewhere. A kink, as of relu, makes
    ∂g/∂w jump between rows and is not seen. None of it is about the free run: y_k = 2 y_{k−1}
    fulfils the condition. A model whose state is not made of measured signals has no such
    predictor: None.

    Args:
        x: the record's usable regressors (N, nx) in the model's layout, if they are stacked
            already.

    Raises:
        InputError: a record that does not fit the model, or has no outputs.
    """
    if not (form := model.form).separates:
        return None
    stacked, every, y_scale = _measured_regressors(model, record, x)
    some = even_indices(len(every), MOST_STEPS)
    x, where, x_scale = stacked[some], every.take(some), stacked.std(axis=0)

    def entries(i: int) -> dict[str, float]:
        return {str(lag): float(value) for lag, value in zip(form.layout, x[i], strict=True)}

    size = partial(np.linalg.norm, axis=(1, 2))
    largest = []
    with np.errstate(all="ignore"):
        phi = np.asarray(form.phi(x, np))
        rms = np.sqrt(np.mean(np.sum((phi / y_scale[:, None]) ** 2, axis=1), axis=0))
        scales = (y_scale, np.outer(y_scale, positive(rms)).ravel())
        sizes = []
        for batch in _gradients(form, model.numbers, x):
            slopes = [
                g.reshape(len(g), len(scale), x.shape[1])
                for g, scale in zip(batch, scales, strict=True)
            ]
            scaled = [g * x_scale / scale[:, None] for g, scale in zip(slopes, scales, strict=True)]
            sizes.append([*map(size, slopes), *map(size, scaled)])
        of_g, of_phi, scaled_g, scaled_phi = (
            np.concatenate(column) for column in zip(*sizes, strict=True)
        )
        for plain, scaled in ((of_g, scaled_g), (of_phi, scaled_phi)):
            largest += [
                where.worst(record, plain, entries)[0],
                *where.worst(record, scaled, entries),
            ]
    fewer, plain, scaled = _weight_sizes(form, model.numbers, x, x_scale, y_scale)
    of_weights, there = where.take(fewer), lambda i: entries(int(fewer[i]))
    largest += [of_weights.worst(record, plain, there)[0], *of_weights.worst(record, scaled, there)]
    return Lipschitz(*largest, rows=len(x), weights_rows=len(fewer))


def _measured_regressors(
    model: Model, record: Record, x: Matrix | None
) -> tuple[Matrix, RowIndex, Vector]:
    """Return measured regressors, the row of each, and deviations of the outputs (ny,)."""
    form, record = model.form, usable(model, record)
    lengths = [len(e) - form.first_row for e in record.experiments]
    if x is None:
        x = np.concatenate([form.regressors(e, record) for e in record.experiments])
    elif np.shape(x) != (wanted := (sum(lengths), len(form.layout))):
        raise InputError(
            f"`x` has shape {np.shape(x)}; the usable regressors of the record have {wanted}."
        )
    return x, RowIndex.of(lengths, form.first_row), positive(record.deviation)


def _gradients(form: LaggedDynamics, numbers: Numbers, x: Matrix) -> Iterator[list[Any]]:
    """Yield ∂g/∂x and ∂φ/∂x at regressors (m, nx), in batches of one shape."""
    width = difference_width(x)
    for begin in range(0, len(x), _BATCH):
        rows = np.minimum(np.arange(begin, begin + _BATCH), len(x) - 1)  # the last one again
        yield [
            np.asarray(g)[: len(x) - begin] for g in _gradient_rows(form, numbers, x[rows], width)
        ]


@partial(quick_jit, static_argnames="form")
def _gradient_rows(
    form: LaggedDynamics, numbers: Numbers, x: Float[Array, "m nx"], width: Array
) -> tuple[Array, Array]:
    """Return ∂g/∂x (m, ny, nx) and ∂φ/∂x, by differences of `width` (nx,) without a derivative."""

    def g(row: Array) -> Array:
        return form.at(numbers, row).total

    def phi(row: Array) -> Any:
        return form.phi(row)

    slope = jax.jacrev(g) if form.differentiable else partial(by_differences, g, width=width)
    return jax.vmap(slope)(x), jax.vmap(jax.jacfwd(phi))(x)


def _weight_sizes(
    form: LaggedDynamics, numbers: Numbers, x: Matrix, x_scale: Vector, y_scale: Vector
) -> tuple[Int[np.ndarray, "r"], Vector, Vector]:
    """Return the affordable rows of x (m, nx), and ‖∂²g/∂w∂x‖ there: plain (r,), scaled."""
    cells, directions = len(form.outputs) * np.size(numbers.weights), np.eye(x.shape[1])
    if not form.differentiable or not cells * len(directions):
        return np.arange(0), np.zeros(0), np.zeros(0)
    some = even_indices(len(x), max(_FEWEST, _MOST_CELLS // (cells * len(directions))))
    size = min(_BATCH, max(1, _BATCH_CELLS // cells))
    squares = []
    for begin in range(0, len(some), size):
        # The last one again: one shape
        rows = some[np.minimum(np.arange(begin, begin + size), len(some) - 1)]
        columns = [_weight_squares(form, numbers, x[rows], direction) for direction in directions]
        squares.append(
            np.stack([np.asarray(column) for column in columns], axis=-1)[: len(some) - begin]
        )
    every = np.concatenate(squares)
    scaled = every * (x_scale / y_scale[:, None]) ** 2
    return some, np.sqrt(every.sum(axis=(1, 2))), np.sqrt(scaled.sum(axis=(1, 2)))


@partial(quick_jit, static_argnames="form")
def _weight_squares(
    form: LaggedDynamics, numbers: Numbers, x: Float[Array, "m nx"], direction: Float[Array, "nx"]
) -> Float[Array, "m ny"]:
    """Return Σ_w (∂²g/∂w∂x)² along one direction of x."""

    def slopes(row: Array) -> Array:
        return jax.jacrev(lambda w: form.at(numbers._replace(weights=w), row).total)(
            numbers.weights
        )

    change = jax.vmap(lambda row: jax.jvp(slopes, (row,), (direction,))[1])(x)
    return jnp.sum(change.reshape(*change.shape[:2], -1) ** 2, axis=2)
