"""Rows of a fitted lagged model with its learner fixed: new ones, and those of training."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from orthaug._base.checks import Matrix, as_signal, check_type
from orthaug._base.errors import InputError
from orthaug._base.jax import Array, jax, jnp
from orthaug.data.record import Record
from orthaug.data.regressors import stack_rows
from orthaug.fitting.colour import correlation_length
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.recursion import Recursion, inflation_of, squares, start_recursion
from orthaug.fitting.residual_band import Reference
from orthaug.inference.covariance import newey_west, whitening_matrix
from orthaug.models.dynamics import Numbers
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.model import Model
from orthaug.physics.output_weights import times

_BATCH = 256
_RIM = 1e-9  # the largest of training is no extrapolation


@partial(jax.jit, static_argnames="form")
def _evaluate(
    form: LaggedDynamics, numbers: Numbers, x: Float[Array, "m nx"]
) -> Float[Array, "m ny ntp"]:
    """Return `[φ, known + f − φθ_aux]` of every row, and the largest of its scaled features.

    That is 1 at the limit of the training data.
    """

    def one(row: Array) -> Array:
        phi = form.phi(row)
        known = form.baseline.known(row, form.layout, form.outputs, jnp)
        added = known + form.at(numbers, row).learner
        reach = jnp.zeros_like(added)
        if form.differentiable:
            z = (form.features.evaluate(row, form.layout, jnp) - numbers.centre) / numbers.halfwidth
            reach = reach + jnp.max(jnp.abs(z), initial=0.0)
        return jnp.concatenate([phi, added[:, None], reach[:, None]], axis=1)

    return jax.vmap(one)(x)


class WhitenedRows(NamedTuple):
    """φ (n, ny, nθ) and `y − known − (f − φθ_aux)` (n, ny) in whitened outputs.

    θ is the least squares of these.

    `inside` (n,) is where the learner's features lie within those of training.
    """

    phi: Float[np.ndarray, "n ny nt"]
    target: Matrix
    inside: Bool[np.ndarray, "n"]


def whitened_rows(
    model: Model, x: Matrix, y: Matrix, numbers: Numbers | None = None
) -> WhitenedRows:
    """Return rows of measured regressors x (n, nx) and outputs y (n, ny), whitened.

    Args:
        numbers: the model's, where JAX has them already: a call with few rows is faster.

    Raises:
        InputError: physics or learner that is not finite on a row.
    """
    pieces, numbers = [], model.numbers if numbers is None else numbers
    size = 1 if len(x) == 1 else _BATCH
    for begin in range(0, len(x), size):
        rows = x[begin : begin + size]
        padded = (
            np.concatenate([rows, np.repeat(rows[-1:], size - len(rows), axis=0)])
            if len(rows) < size
            else rows
        )
        pieces.append(np.asarray(_evaluate(model.form, numbers, padded))[: len(rows)])
    values = np.concatenate(pieces) if len(pieces) > 1 else pieces[0]
    bad = ~np.isfinite(values).all(axis=(1, 2))
    if bad.any():
        row = x[int(np.argmax(bad))]
        at = ", ".join(
            f"{lag} = {value:.6g}" for lag, value in zip(model.form.layout, row, strict=True)
        )
        raise InputError(
            f"physics or learner has no finite value at {at}; give NaN for such a row, or "
            "correct the data."
        )
    inside = np.asarray(values[:, 0, -1] <= 1 + _RIM)
    return WhitenedRows(
        times(model.weight, values[..., :-2]), times(model.weight, y - values[..., -2]), inside
    )


@dataclass(frozen=True, eq=False)
class RegressorStream:
    """Regressors of rows that arrive a few at a time, from the rows before them."""

    model: Model

    @cached_property
    def nothing(self) -> Matrix:
        """The tail (largest lag, ny + nu) behind which there is a gap."""
        return np.full(
            (self.model.form.first_row, len(self.model.outputs) + len(self.model.inputs)), np.nan
        )

    @cached_property
    def _read(self) -> tuple[Int[np.ndarray, "nx"], Int[np.ndarray, "nx"]]:
        """Lag and column of every entry of the regressor."""
        names = [channel.name for channel in (*self.model.outputs, *self.model.inputs)]
        layout = self.model.form.layout
        return np.array([e.lag for e in layout], dtype=int), np.array(
            [names.index(e.channel) for e in layout], dtype=int
        )

    def regressors(
        self, tail: Matrix, rows: Matrix
    ) -> tuple[Matrix, Bool[np.ndarray, "n"], Matrix]:
        """Return x (n, nx) of new rows (n, ny + nu), which are complete, and the new tail."""
        whole = np.concatenate([tail, rows])
        lag, column = self._read
        x = whole[(len(tail) + np.arange(len(rows)))[:, None] - lag, column]
        needed = np.concatenate([x, rows[:, : len(self.model.outputs)]], axis=1)
        complete = np.asarray(np.isfinite(needed).all(axis=1))
        return x, complete, whole[len(whole) - len(tail) :]


def as_rows(values: Any, channels: int, name: str) -> Matrix:
    """Return one row or many (n, channels); NaN is a missing sample.

    Raises:
        InputError: no numbers, another number of channels, or an infinite one.
    """
    try:
        array = (
            as_signal(values, name) if np.iscomplexobj(values) else np.asarray(values, dtype=float)
        )
    except (TypeError, ValueError, OverflowError):
        array = as_signal(values, name)  # says what is wrong
    if array.ndim == 0 or (array.ndim == 1 and channels != 1):
        array = array.reshape(1, -1)
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2 or np.isinf(array).any():
        as_signal(np.where(np.isnan(array), 0.0, array), name)
    if array.shape[1] != channels:
        raise InputError(
            f"`{name}` has {array.shape[1]} columns; expected {channels}, one for each channel."
        )
    return array


def joined_rows(u: Any, y: Any, inputs: int, outputs: int) -> Matrix:
    """Return outputs and inputs side by side (n, ny + nu), as they were given.

    Raises:
        InputError: one of them missing, or of another length.
    """
    if y is None or (u is None and inputs):
        what = "`y`" if y is None else "`u`"
        raise InputError(
            f"{what} is missing; give the measured outputs "
            f"`y`{' and inputs `u`' if inputs else ''}."
        )
    right = as_rows(y, outputs, "y")
    left = as_rows(u, inputs, "u") if inputs else np.zeros((len(right), 0))
    if len(left) != len(right):
        raise InputError(
            f"`y` has {len(right)} rows but `u` has {len(left)}. Give both the same length."
        )
    return np.concatenate([right, left], axis=1)


_SOLVED = 1e-6  # of the residual's norm: how far Φθ may be from that of least squares
_LENGTHS, _ROWS_PER_LAG = 3, 20  # of the correlation of errors; of rows that determine it
_SMALLEST = 1e-10  # of an output's deviation: a residual is at least rounding
MOTION = (
    "recursive least squares cannot estimate equations of motion: their outputs are not linear "
    "in the parameters. Write the physics as terms of lagged signals and fit one step ahead, or "
    "fit the motion again on new data."
)


class TrainingRowsModel(NamedTuple):
    """A model with its training rows in whitened outputs, φ (N, ny, nθ) and target (N, ny)."""

    model: Model
    phi: Float[np.ndarray, "N ny nt"]
    target: Matrix
    lengths: tuple[int, ...]
    """Usable rows of every experiment."""
    covariance: Matrix | None
    used: float
    """Degrees of freedom that the learner has used up."""
    robust: bool
    """True if the covariance counts the colour of the errors."""


def training_rows(fit: Any, training: Record | None) -> TrainingRowsModel:
    """Return the rows of a fit.

    Raises:
        InputError: what cannot be followed, or a model without its training data.
    """
    check_type(
        fit,
        Estimate | Model,
        "fit",
        "what `estimate` returned, or a saved model",
    )
    saved = isinstance(fit, Model)
    model, covariance = fit if saved else fit.model, None
    if not model.form.separates:
        raise InputError(MOTION)
    if not saved:
        if fit.criterion.free_run is not None:
            raise InputError(
                "the fit minimises the free run's error, but recursive least squares that of "
                "one step ahead, so θ would move away. Fit with criterion = Prediction()."
            )
        if fit.at_bound:
            names = ", ".join(fit.at_bound)
            raise InputError(
                f"{names} at a bound: new rows would move them across it; fit without the bound."
            )
        covariance, record = fit.covariance, fit.problem.record
        freedom, robust = fit.freedom, fit.plain_covariance is not None
    else:
        if training is None:
            raise InputError(
                "a saved model does not contain its training data; give them, Recursive(model, "
                "training=…)."
            )
        record = model.fitting(training, need_outputs=True)
        freedom, robust = model.statistics.freedom, False
    if not len(model.theta):
        raise InputError("the physics has no parameter to estimate.")
    rows = stack_rows(record, model.form.layout)
    phi, target, _ = whitened_rows(model, rows.x, rows.y)
    lengths = tuple(len(experiment) - rows.start for experiment in record.experiments)
    used = (
        target.size - len(model.theta) - freedom * target.shape[1] if np.isfinite(freedom) else 0.0
    )
    began = TrainingRowsModel(model, phi, target, lengths, covariance, max(used, 0.0), robust)
    _check_solved(began)
    return began._replace(covariance=_saved_covariance(began)) if saved else began


def _check_solved(began: TrainingRowsModel) -> None:
    """Raise InputError where θ is not the least squares of the rows.

    New rows could not continue from it.
    """
    count, ny, nt = began.phi.shape
    stacked = began.phi.reshape(-1, nt)
    left = (began.target - began.phi @ began.model.theta).ravel()
    basis = np.linalg.qr(stacked)[0]
    rounding = 1e-10 * np.linalg.norm(began.target)
    if np.linalg.norm(basis.T @ left) > _SOLVED * np.linalg.norm(left) + rounding:
        raise InputError(
            f"θ of the {began.model.structure} model is not the least-squares estimate of these "
            f"{count} rows with its learner. Either they are not its training rows, or a "
            "penalty, a bound, the free run or the paper's pipeline changed θ. Give the "
            "training data, or fit with the orthogonal structure one step ahead."
        )


def _saved_covariance(began: TrainingRowsModel) -> Matrix | None:
    """Return Cov θ of a saved model under its training measure.

    `K Cov(c, w) Kᵀ`, K = [I, ∂θ_aux/∂w] from the Gram matrix.
    """
    model, nt = began.model, len(began.model.theta)
    joint = model.statistics.joint(nt)
    if joint is None or model.structure != "orthogonal":
        return None
    r = np.asarray(np.linalg.qr(began.phi.reshape(-1, nt), mode="r"))
    overlap = np.linalg.solve(r.T, joint.gram[:nt, nt:])  # QᵀJ
    along = np.eye(nt)
    if model.shared is not None:
        basis = np.linalg.qr(r @ model.shared)[0]
        along = basis @ basis.T
    return joint.of(np.column_stack([np.eye(nt), np.linalg.solve(r, along @ overlap)]))


def begin(
    began: TrainingRowsModel, forgetting: float, quiet: float, *, empty: bool
) -> tuple[Recursion, Reference, Matrix | None]:
    """Return the state before new rows, reference residuals, and the inflation.

    The inflation is the factor by which intervals are wider than `s²(ΦᵀΦ)⁻¹`.
    """
    phi, target, model = began.phi, began.target, began.model
    count, ny, nt = phi.shape
    residual = target - phi @ model.theta
    freedom = count * ny - nt - began.used
    if freedom < 1:
        raise InputError(
            f"{count} training rows leave no degrees of freedom to estimate the noise; use more "
            "data."
        )
    noise = residual.T @ residual * (ny / freedom)
    least = (_SMALLEST * model.deviation * np.diag(model.weight)) ** 2
    noise = noise + np.diag(least)
    white = whitening_matrix(noise, model.deviation)
    white = np.diag(1 / np.sqrt(np.diag(noise))) if white is None else white
    level = float(np.trace(noise)) / ny
    recursion = start_recursion(
        phi, target, model.theta, noise / level, level, freedom, forgetting, empty=empty
    )
    ends = np.cumsum(began.lengths)[:-1]
    stretches = np.split(residual, ends)
    share = (nt + began.used) / (count * ny)
    grown = [stretch * np.sqrt(count * ny / freedom) for stretch in stretches]
    reference = Reference.of(grown, white, share, quiet)
    squared = squares(phi, noise / level)
    r = np.asarray(np.linalg.qr(phi.reshape(-1, nt), mode="r"))
    inflation = inflation_of(r, squared, level, began.covariance)
    if inflation is not None and len(reference.colour) and not began.robust:
        scores = [
            np.einsum("kit,ki->kt", *pair) for pair in zip(np.split(phi, ends), grown, strict=True)
        ]
        widened = inflation_of(
            r, squared, level, _sandwich(r, newey_west(scores, _memory(grown, white)))
        )
        inflation = None if widened is None else _root(widened) @ inflation @ _root(widened)
    return recursion, reference, inflation


def _sandwich(r: Matrix, middle: Matrix) -> Matrix:
    """Return `(RᵀR)⁻¹ Ω (RᵀR)⁻¹`."""
    unit = np.linalg.norm(r, axis=0)
    inverse = np.linalg.inv(r / unit) / unit[:, None]
    return inverse @ (inverse.T @ middle @ inverse) @ inverse.T


def _root(matrix: Matrix) -> Matrix:
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


def _memory(stretches: list[Matrix], white: Matrix) -> int:
    """Return three times the correlation length of the errors, in lags."""
    longest, rows = max(map(len, stretches)), sum(map(len, stretches))
    padded = [
        np.pad(stretch @ white.T, ((0, longest - len(stretch)), (0, 0))) for stretch in stretches
    ]
    lasting = [correlation_length(np.stack([p[:, i] for p in padded])) for i in range(len(white))]
    most = rows // _ROWS_PER_LAG
    return max(
        1, min(most, _LENGTHS * max(most if length is None else length for length in lasting))
    )
