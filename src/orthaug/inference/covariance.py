"""Covariances and intervals of θ, of θ and weights together, and of predictions.

Robust ones hold for coloured or uneven noise.

The calibrated form `(Σψᵀψ)⁻¹(ΣψᵀΣ_eψ)(Σψᵀψ)⁻¹` for the criterion `1/N Σ‖ε‖²` (Ljung 1999, ch. 9):
the factor 2 of the paper's eq:cov_approx cancels against the second derivative of the criterion;
for plain least squares that form gives twice `σ²(ΦᵀΦ)⁻¹`. Learner weights are over-parametrised, so
their block is singular. Only functions of the model have intervals.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import partial
from typing import Any

import numpy as np
import scipy.linalg
import scipy.special
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector, check_choice, check_count
from orthaug._base.errors import InputError
from orthaug._base.jax import Array, jax, jnp
from orthaug.data.record import Record
from orthaug.models.dynamics import Numbers
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.model import HoldsModel, Model, model_of
from orthaug.models.rows import (
    InMemory,
    chunk_shape,
    from_chunks,
    in_chunks,
    learner_rows,
    projected_gram,
)
from orthaug.models.statistics import column_units, half_inverse
from orthaug.physics.noise import NoiseModel, RowFilter
from orthaug.physics.problem import Problem
from orthaug.physics.projection import Projection

CONVENTIONS = ("calibrated", "paper")


def degrees_of_freedom(rows: int, physics: Vector, effective: float) -> Vector:
    """Return the degrees of freedom of each output (ny,): its rows less what the fit has used up.

    The physics uses `Σ_k ‖Q_ki‖²` of output i (its share of nθ), the learner its effective weights.
    """
    return rows - physics - effective / len(physics)


def noise_covariance(squares: Matrix, freedom: Vector) -> Matrix | None:
    """Return Σ_e (ny, ny) in the outputs' units from Σ e eᵀ.

    None where the fit leaves no degree of freedom.
    """
    if np.any(freedom < 0.5):
        return None
    return squares / np.sqrt(np.outer(freedom, freedom))


def whitening_matrix(noise: Matrix, deviation: Vector) -> Matrix | None:
    """Return W with `W Σ Wᵀ = I` (ny, ny).

    None for a covariance that is singular, as of outputs without errors: in the outputs' deviations
    (ny,), for a position in m and a pressure in Pa differ by units alone.
    """
    values = np.linalg.eigvalsh(noise / np.outer(deviation, deviation))
    return np.linalg.inv(np.linalg.cholesky(noise)) if values[0] > 1e-12 * values[-1] else None


def mixing_matrix(noise: Matrix) -> Matrix:
    """Return M with `MᵀM = Σ` (ny, ny), also of a singular covariance."""
    values, vectors = np.linalg.eigh(noise)
    return (vectors * np.sqrt(np.maximum(values, 0.0))).T


def theta_covariance(projection: Projection, middle: Matrix, fixed: Collection[int] = ()) -> Matrix:
    """Return Cov θ̂ (nθ, nθ) of θ̂ = Φ⁺Y.

    For one output this is the textbook s²(ΦᵀΦ)⁻¹.

    Args:
        projection: of Φ.
        middle: ΣqᵀΣ_eq (nθ, nθ) over the rows q of Q, in whitened outputs; for one output s² I.
        fixed: entries at a bound. They have NaN; the others' covariance holds with them fixed
            there.
    """
    nt = len(projection.scale)
    free = [i for i in range(nt) if i not in fixed]
    root = projection.covariance_factor(free)
    covariance = np.full((nt, nt), np.nan)
    covariance[np.ix_(free, free)] = root @ middle @ root.T
    return covariance


def theta_block(information: Matrix, ridge: float, nt: int, fixed: Collection[int] = ()) -> Matrix:
    """Return Cov θ̂ (nθ, nθ) per unit of noise variance.

    It comes from the information `[S_θ S_w]ᵀ[S_θ S_w]` of θ and weights.

    The weights are eliminated: `(H_θθ − H_θw (H_ww + αI)⁺ H_wθ)⁻¹`. Directions of the weights that
    the data do not see count as absent. Entries at a bound (`fixed`) are NaN. All are NaN where θ
    is not determined beside the weights.
    """
    free = [i for i in range(nt) if i not in fixed]
    covariance = np.full((nt, nt), np.nan)
    if not np.isfinite(information).all():
        return covariance
    unit = column_units(information, nt)
    scaled = information * np.outer(unit, unit)
    inner = scaled[nt:, nt:] + ridge * np.diag(unit[nt:] ** 2)
    values, vectors = np.linalg.eigh(inner)
    kept = values > len(information) * np.finfo(float).eps * values.max(initial=0.0)
    across = scaled[np.ix_(free, range(nt, len(information)))] @ vectors[:, kept]
    remaining = scaled[np.ix_(free, free)] - (across / values[kept]) @ across.T
    values, vectors = np.linalg.eigh(remaining)
    if free and values.min() > len(information) * np.finfo(float).eps:
        inverse = (vectors / values) @ vectors.T
        covariance[np.ix_(free, free)] = inverse * np.outer(unit[free], unit[free])
    return covariance


def reach(freedom: float, level: float = 0.95) -> float:
    """Return half the length of a Student-t interval, in standard errors."""
    return float(scipy.special.stdtrit(max(freedom, 1.0), 0.5 + level / 2))


def interval(
    value: np.ndarray | float, std: np.ndarray | float, freedom: float, level: float = 0.95
) -> Float[np.ndarray, "*n 2"]:
    """Return the Student-t interval of each entry, (…, 2)."""
    half = reach(freedom, level) * std
    return np.stack([value - half, value + half], axis=-1)


def joint_covariance(
    problem: Problem, model: Model, convention: str = "calibrated", *, own_units: bool = False
) -> Matrix:
    """Return Cov (nθ + nw)² of θ̂ and the learner's weights in the orthogonal structure.

    It is formed from the raw `[Φ J̃]`, J̃ = P⊥J.
    Under the training measure the blocks between θ and weights are zero (`thm:zero_cov`), if all
    outputs have the same noise or share no θ. One pass over the rows.

    Args:
        problem: rows and physics.
        model: the fitted model.
        convention: "paper" for eq:cov_approx divided by N, factor 2 and `Σ̂ = (1/N) Σ e eᵀ`
            included.
        own_units: invert the weights' block by a pseudo-inverse in the weights' own units, which
            leaves out directions whose eigenvalue is rounding beside the largest.

    Raises:
        InputError: an unknown convention, or a model without a learner's gradient.
    """
    check_choice(convention, CONVENTIONS, "`convention`")
    if model.numbers.tilt is not None:
        raise InputError("an ensemble has no gradient in its weights; use a single learner.")
    residual = model.predict(problem.record).errors
    noise: Any = (
        residual.T @ residual / len(residual) if convention == "paper" else model.statistics.noise
    )
    if noise is None:
        raise InputError("the fit has no noise covariance: there are no degrees of freedom left.")
    projection, nt, ny = problem.projection, len(problem.baseline.names), len(problem.outputs)
    engine = InMemory()
    rows = learner_rows(
        engine,
        model.form,
        model.numbers,
        problem.rows.x,
        problem.projection.q,
        problem.weight.matrix,
        problem.noise,
    )
    whitened = problem.weight.whitened(noise)
    bound, w = model.form.bound, np.asarray(model.numbers.weights)
    share = problem.count / len(problem.rows)  # of which the rows in memory are a subsample
    outer, middle = (
        share * projected_gram(engine, bound, w, rows, m)
        for m in (np.eye(ny), mixing_matrix(whitened))
    )
    change = np.eye(len(outer))
    change[:nt, :nt] = projection.r / projection.scale
    outer, middle = (change.T @ gram @ change for gram in (outer, middle))
    # block by block, as in the proof: one inverse of both mixes rounding of the weights' singular
    # block into θ's
    weights = half_inverse(outer[nt:, nt:], 0, own_units=own_units)
    half: Any = scipy.linalg.block_diag(half_inverse(outer[:nt, :nt], nt), weights)
    return (2.0 if convention == "paper" else 1.0) * half @ (half.T @ middle @ half) @ half.T


def prediction_std(model: Model | HoldsModel, record: Record) -> list[Matrix]:
    """Return the standard error (N, ny) of one-step predictions on every row of every experiment.

    NaN on the first lags.

    It is that of the fitted function, `√(ψ Cov(c, w) ψᵀ)`, ψ filtered by a noise model whose own
    coefficients count as known. A new measurement adds the noise, whose
    covariance (ny, ny) is `model.statistics.noise`: its standard deviation is `√(std² +
    diag(noise))`.

    Args:
        model: with statistics, as a fit has them; of a fit its model.
        record: inputs and outputs, measured.

    Raises:
        InputError: no model, or one without statistics; other channels.
    """
    model = model_of(model)
    if not isinstance(model.form, LaggedDynamics):
        raise InputError(
            "`prediction_std` is for physics in lagged values; of equations of motion an "
            "`Observer` gives states with their standard deviations."
        )
    joint = model.statistics.joint(len(model.theta))
    if joint is None or model.numbers.tilt is not None:
        raise InputError(
            "the model has no statistics for standard errors (an ensemble, or trained elsewhere)."
        )
    root = joint.root()
    record = model.fitting(record, need_outputs=True)
    deviations = []
    for experiment in record.experiments:
        x = model.form.regressors(experiment, record)
        shape = chunk_shape(len(x))
        chunks = in_chunks(x, shape, repeat=True)
        if model.coloured and isinstance(model.noise, NoiseModel):
            moved = from_chunks(
                np.asarray(changes(model.form, model.numbers, chunks, root)), len(x)
            )
            moved = np.swapaxes(moved.reshape(len(x), -1, len(model.outputs)), 1, 2)
            past = model.noise.past  # these rows have no forecast
            filtered = RowFilter(model.noise, (len(x),)).rows(moved)
            variance = np.sum(np.concatenate([moved[:past], filtered[past:]]) ** 2, axis=2)
        else:
            found = np.asarray(_variances(model.form, model.numbers, chunks, root))
            variance = from_chunks(found, len(x))
        values = np.full((len(experiment), len(model.outputs)), np.nan)
        values[model.form.first_row :] = np.sqrt(np.maximum(variance, 0.0))
        deviations.append(values)
    return deviations


@partial(jax.jit, static_argnames="form")
def _variances(
    form: LaggedDynamics, numbers: Numbers, x: Float[Array, "k nx m"], root: Float[Array, "n r"]
) -> Float[Array, "k ny m"]:
    return jax.lax.map(
        lambda rows: jnp.sum(_slopes_along(form, numbers, rows, root) ** 2, axis=0), x
    )


@partial(jax.jit, static_argnames="form")
def changes(
    form: LaggedDynamics, numbers: Numbers, x: Float[Array, "k nx m"], root: Float[Array, "n r"]
) -> Float[Array, "k ro m"]:
    """Return how far each prediction moves along the columns of `root`."""

    def one_chunk(rows: Array) -> Array:
        moved = _slopes_along(form, numbers, rows, root)
        return moved.reshape(-1, moved.shape[-1])

    return jax.lax.map(one_chunk, x)


def _slopes_along(
    form: LaggedDynamics, numbers: Numbers, rows: Array, root: Array
) -> Float[Array, "r ny m"]:
    """Return ∂ŷ/∂(c, w) of a chunk of rows along the columns of `root`."""
    phi = jax.vmap(lambda row: form.phi(row), -1, -1)(rows)
    columns = jnp.moveaxis(phi, 1, 0)  # (nt, ny, m)
    z = form.features.evaluate(rows.T, form.layout, jnp)
    z = ((z - numbers.centre) / numbers.halfwidth).T
    gain = jnp.broadcast_to(
        jnp.diag(numbers.gain)[..., None], (*2 * (len(form.outputs),), rows.shape[-1])
    )
    columns = jnp.concatenate([columns, form.bound.jacobian(numbers.weights, z, gain)[1]])
    return jnp.einsum("nom,nr->rom", columns, root)


def newey_west(scores: Sequence[Float[np.ndarray, "N nt"]], lags: int | None = None) -> Matrix:
    """Return Σ_k Σ_j w_{|k−j|} s_k s_jᵀ with Bartlett weights (Newey and West 1987).

    No lag reaches across two experiments.

    Args:
        scores: of every experiment, (N_i, nt).
        lags: how many; default `⌊4 (N/100)^(2/9)⌋`.
    """
    if lags is not None:
        check_count(lags, "lags", least=0)
    rows = sum(len(s) for s in scores)
    lags = int(4 * (rows / 100) ** (2 / 9)) if lags is None else lags
    total = sum(s.T @ s for s in scores)
    for lag in range(1, lags + 1):
        share = sum(s[lag:].T @ s[:-lag] for s in scores if len(s) > lag)
        total = total + (1 - lag / (lags + 1)) * (share + np.transpose(share))
    return np.asarray(total)


def robust_covariance(
    problem: Problem, residual: Matrix, used: float, lags: int | None = None
) -> Matrix:
    """Return Cov θ̂ (nθ, nθ) of `θ̂ = Φ⁺Y` for coloured or uneven noise (Newey-West).

    Args:
        residual: (N, ny) in the outputs' units, rows as in the problem.
        used: effective weights of the learner, by which the residual is too small.
    """
    projection = problem.projection
    whitened = problem.weight.rows(residual)
    scores = np.einsum("kit,ki->kt", projection.q, whitened)
    factor = projection.covariance_factor()
    return (
        _correction(problem, residual, used)
        * factor
        @ newey_west(by_experiment(problem, scores), lags)
        @ factor.T
    )


def robust_split_covariance(
    problem: Problem,
    model: Model,
    k: Matrix,
    residual: Matrix,
    used: float,
    lags: int | None = None,
) -> Matrix:
    """Return Cov θ̂ (nθ, nθ) of a split `θ = c + θ_aux(w)` for coloured or uneven noise.

    It is the sum over the influence `[I, ∂θ_aux/∂w] M⁻¹ ψ_k e_k` of every row.

    Args:
        k: [I, ∂θ_aux/∂w] (nθ, nθ + nw).
    """
    influence = row_influence(problem, model, k)
    matrix = problem.weight.matrix
    scores = np.einsum("kro,ko->kr", influence, residual @ (matrix.T @ matrix))
    return _correction(problem, residual, used) * newey_west(by_experiment(problem, scores), lags)


def row_influence(problem: Problem, model: Model, k: Matrix) -> Float[np.ndarray, "N nt ny"]:
    """Return `[I, ∂θ_aux/∂w] M⁻¹ ψ_k` of every row: what its errors move a split θ by.

    Args:
        k: [I, ∂θ_aux/∂w] (nθ, nθ + nw).

    Raises:
        InputError: a fit without statistics.
    """
    statistics, nt, ny = model.statistics, len(k), len(problem.outputs)
    if statistics.gram is None or model.numbers.tilt is not None:
        raise InputError(
            "the fit has no statistics for robust standard errors; fit the data again."
        )
    half = half_inverse(statistics.information(nt), nt)
    root = half @ (half.T @ k.T)
    rows = len(problem.rows)
    chunks = jnp.asarray(in_chunks(problem.rows.x, chunk_shape(rows), repeat=True))
    moved = np.asarray(changes(model.form, model.numbers, chunks, jnp.asarray(root)))
    found = from_chunks(moved, rows).reshape(rows, nt, ny)
    if problem.noise is None:
        return found
    return np.swapaxes(problem.noise.rows(np.swapaxes(found, 1, 2)), 1, 2)


def _correction(problem: Problem, residual: Matrix, used: float) -> float:
    """Return the factor that corrects for the degrees of freedom that the fit has used up."""
    share = problem.count / len(problem.rows)  # of which the residual is a subsample
    samples = residual.size * share
    return share * samples / max(samples - len(problem.baseline.names) - used, 1.0)


def by_experiment(problem: Problem, values: Matrix) -> list[Matrix]:
    """Return values of the usable rows (N, m) in one piece per experiment."""
    ends = np.cumsum(
        [len(experiment) - problem.rows.start for experiment in problem.record.experiments]
    )
    return np.split(values, ends[:-1])
