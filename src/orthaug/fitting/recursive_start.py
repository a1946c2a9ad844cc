"""What recursive least squares starts from: the training rows of a fit, their factor, and what residuals were there."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, check_type
from orthaug._base.errors import InputError
from orthaug.data.record import Record
from orthaug.data.regressors import stack_rows
from orthaug.fitting.colour import correlation_length
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.motion_estimates import MotionEstimate
from orthaug.fitting.recursion import Recursion, inflation_of, squares, started
from orthaug.fitting.recursive_rows import whitened_rows
from orthaug.fitting.residual_band import Reference
from orthaug.inference.covariance import whitening
from orthaug.inference.intervals import newey_west
from orthaug.models.model import Model
from orthaug.models.motion_model import MotionModel

_SOLVED = 1e-6  # of the residual's norm: how far Φθ may be from that of least squares
_LENGTHS, _ROWS_PER_LAG = 3, 20  # of the correlation of errors; of what tells it
_SMALLEST = 1e-10  # of an output's deviation: a residual is at least rounding
MOTION = (
    "equations of motion cannot be followed by least squares: their outputs are not linear in the parameters. Write "
    "the physics as terms of lagged signals and fit one step ahead, or fit the motion again on new data."
)


class Trained(NamedTuple):
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
    """Whether the covariance counts the colour of the errors."""


def trained(fit: Any, training: Record | None) -> Trained:
    """The rows of a fit.

    Raises:
        InputError: what cannot be followed, or a model without its training data.
    """
    check_type(
        fit, Estimate | Model | MotionEstimate | MotionModel, "fit", "what `estimate` returned, or a saved model"
    )
    if isinstance(fit, MotionEstimate | MotionModel):
        raise InputError(MOTION)
    covariance = None
    if isinstance(fit, Estimate):
        if fit.criterion.flown is not None:
            raise InputError(
                "the fit is one of the free run, and recursive least squares looks one step ahead: its θ would leave "
                "this one. Fit with criterion = Prediction()."
            )
        if fit.at_bound:
            names = ", ".join(fit.at_bound)
            raise InputError(f"{names} stand at a bound, which new rows would leave; fit without the bound.")
        model, covariance, record = fit.model, fit.covariance, fit.problem.record
    else:
        model = fit
        if training is None:
            raise InputError("a saved model does not hold its training data; give them, Recursive(model, training=…).")
        record = model.fitting(training, need_outputs=True)
    if not len(model.theta):
        raise InputError("the physics has no parameter to follow.")
    rows = stack_rows(record, model.form.layout)
    phi, target, _ = whitened_rows(model, rows.x, rows.y)
    lengths = tuple(len(experiment) - rows.start for experiment in record.experiments)
    freedom = fit.freedom if isinstance(fit, Estimate) else model.statistics.freedom
    used = target.size - len(model.theta) - freedom * target.shape[1] if np.isfinite(freedom) else 0.0
    robust = isinstance(fit, Estimate) and fit.plain_covariance is not None
    began = Trained(model, phi, target, lengths, covariance, max(used, 0.0), robust)
    _check_solved(began)
    return began if isinstance(fit, Estimate) else began._replace(covariance=_saved_covariance(began))


def _check_solved(began: Trained) -> None:
    """Raise InputError where θ is not the least squares of the rows: then new rows would not go on from it."""
    count, ny, nt = began.phi.shape
    stacked = began.phi.reshape(-1, nt)
    left = (began.target - began.phi @ began.model.theta).ravel()
    basis = np.linalg.qr(stacked)[0]
    rounding = 1e-10 * np.linalg.norm(began.target)
    if np.linalg.norm(basis.T @ left) > _SOLVED * np.linalg.norm(left) + rounding:
        raise InputError(
            f"θ of the {began.model.structure} model is not the least-squares estimate of these {count} rows beside "
            "its learner: they are not those of its training, or a penalty, a bound, the free run or the paper's "
            "pipeline has moved it. Give the training data, or fit with the orthogonal structure one step ahead."
        )


def _saved_covariance(began: Trained) -> Matrix | None:
    """Cov θ of a saved model under its training measure: `K Cov(c, w) Kᵀ`, K = [I, ∂θ_aux/∂w] from the Gram matrix."""
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
    began: Trained, forgetting: float, quiet: float, *, empty: bool
) -> tuple[Recursion, Reference, Matrix | None]:
    """The state before new rows, what residuals were like, and by what intervals are wider than `s²(ΦᵀΦ)⁻¹`."""
    phi, target, model = began.phi, began.target, began.model
    count, ny, nt = phi.shape
    residual = target - phi @ model.theta
    freedom = count * ny - nt - began.used
    if freedom < 1:
        raise InputError(f"{count} training rows leave no degrees of freedom to tell noise from; use more data.")
    noise = residual.T @ residual * (ny / freedom)
    least = (_SMALLEST * model.deviation * np.diag(model.weight)) ** 2
    noise = noise + np.diag(least)
    white = whitening(noise)
    white = np.diag(1 / np.sqrt(np.diag(noise))) if white is None else white
    level = float(np.trace(noise)) / ny
    recursion = started(phi, target, model.theta, noise / level, level, freedom, forgetting, empty=empty)
    ends = np.cumsum(began.lengths)[:-1]
    stretches = np.split(residual, ends)
    share = (nt + began.used) / (count * ny)
    grown = [stretch * np.sqrt(count * ny / freedom) for stretch in stretches]
    reference = Reference.of(grown, white, share, quiet)
    squared = squares(phi, noise / level)
    r = np.asarray(np.linalg.qr(phi.reshape(-1, nt), mode="r"))
    inflation = inflation_of(r, squared, level, began.covariance)
    if inflation is not None and len(reference.colour) and not began.robust:
        scores = [np.einsum("kit,ki->kt", *pair) for pair in zip(np.split(phi, ends), grown, strict=True)]
        widened = inflation_of(r, squared, level, _sandwich(r, newey_west(scores, _memory(grown, white))))
        inflation = None if widened is None else _root(widened) @ inflation @ _root(widened)
    return recursion, reference, inflation


def _sandwich(r: Matrix, middle: Matrix) -> Matrix:
    """`(RᵀR)⁻¹ Ω (RᵀR)⁻¹`."""
    unit = np.linalg.norm(r, axis=0)
    inverse = np.linalg.inv(r / unit) / unit[:, None]
    return inverse @ (inverse.T @ middle @ inverse) @ inverse.T


def _root(matrix: Matrix) -> Matrix:
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


def _memory(stretches: list[Matrix], white: Matrix) -> int:
    """How many lags the colour of the errors takes: three times as many as their correlation lasts."""
    longest, rows = max(map(len, stretches)), sum(map(len, stretches))
    padded = [np.pad(stretch @ white.T, ((0, longest - len(stretch)), (0, 0))) for stretch in stretches]
    lasting = [correlation_length(np.stack([p[:, i] for p in padded])) for i in range(len(white))]
    most = rows // _ROWS_PER_LAG
    return max(1, min(most, _LENGTHS * max(most if length is None else length for length in lasting)))
