"""Test for inconsistent one-step θ by coloured errors, in standard errors of θ (Hausman 1978).

Coloured errors are in the lagged outputs of the next rows, which moves θ̂ by an amount that more
rows do not lessen. With a model of the colour, `e_k = Σ_j ρ_j e_{k−j} + ν_k` with ν white, they do
not. One Gauss-Newton step from ρ = 0 gives ρ̂ and what it moves θ̂ by (Durbin 1970, Breusch 1978,
Godfrey 1978): with the past errors E and `E⊥` what the model's derivatives ψ leave of them, `ρ̂ =
(EᵀE⊥)⁻¹Eᵀe` and `Δp̂ = −M⁻¹ψᵀE ρ̂`. The derivatives in the learner's weights are among ψ, with
their prior, so that what a learner takes is partialled out (Frisch and Waugh 1933, Lovell 1963).
The Wald test of ρ takes the errors as uneven (White 1980), and knows nothing of the standard errors
of the fit: robust ones cannot silence it. A short and a longer autoregression are tried: the first
finds weak colour, the second that of noise on a sensor or of a disturbance that swings.

What θ is with the colour modelled comes from iterating; instruments, the outputs of the free run in
place of the measured ones (Young 1970, Söderström and Stoica 1983), need no model of the colour and
judge it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.special

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import Warning
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.inference.covariance import by_experiment, newey_west
from orthaug.inference.influence import LARGEST, Influence, one_step_slopes
from orthaug.models.response import Response
from orthaug.models.statistics import prior_of
from orthaug.physics.streamed import StreamedProblem

UNDER_FEEDBACK = (
    "Training on the free run is no remedy here: the inputs follow the outputs, and disturbances "
    "that are fed back bias it."
)
LEVEL = 0.03  # of the test; benchmarks/coverage_noise.py has its false alarms
_WORTH = 0.5  # standard errors of θ: by less, coverage falls from 95 to 92 % at most
_LISTED = 3  # parameters in a warning, at most
_ORDERS = (1, 4)  # of the autoregressions that are tried
_FEWEST = 100  # rows
_STEPS, _CLOSE = 30, 1e-6  # of the iteration, and the relative fall of the squares at which it ends
_VAGUE = 10.0  # times the standard errors of the fit: less accurate instruments are not shown


@dataclass(frozen=True, eq=False)
class Inconsistency:
    """θ̂ one step ahead beside θ with a model of the errors' colour; vectors (nθ,).

    `p` is that of white errors against an autoregression of `order`, `apart` the difference in
    standard errors of white errors. `instruments` and `instruments_std` are those of the free run's
    outputs as instruments; None without any.
    """

    names: tuple[str, ...]
    p: float
    order: int
    theta: Vector
    modelled: Vector
    modelled_std: Vector
    apart: Vector
    instruments: Vector | None = None
    instruments_std: Vector | None = None
    compared: bool = False
    """True if training on the free run was tried, and was not better."""

    @property
    def found(self) -> bool:
        """True if the errors are surely coloured and θ is off by enough to spoil its intervals."""
        return bool(self.p < LEVEL and np.abs(self.apart).max(initial=0.0) > _WORTH)

    @property
    def moved(self) -> list[int]:
        """The parameters that are off, the most first."""
        order = np.argsort(-np.abs(self.apart), kind="stable")
        return [int(i) for i in order if abs(self.apart[i]) > _WORTH]

    def warning(self, *, looped: bool = False) -> Warning:
        """Return the warning on the inconsistency, with the values that the remedies give.

        Args:
            looped: whether the inputs follow the outputs, so that the free run is no remedy.
        """
        each = [
            f"{self.names[i]} is {self.modelled[i]:.6g} (std {self.modelled_std[i]:.2g}) "
            f"instead of {self.theta[i]:.6g}, {abs(self.apart[i]):.1f} standard errors away"
            for i in self.moved[:_LISTED]
        ]
        more = len(self.moved) - _LISTED
        others = f"; {more} more are off by less" if more > 0 else ""
        text = (
            "the one-step θ is inconsistent: its coloured errors are correlated with the "
            "lagged outputs, and more rows do not reduce the bias. With a noise model "
            f"(autoregression of order {self.order}) {'; '.join(each)}{others}."
        )
        instruments = None if looped else self.instruments  # in a loop u has the disturbance, too
        if instruments is not None and self.instruments_std is not None:
            given = [
                f"{self.names[i]} = {instruments[i]:.6g} (std {self.instruments_std[i]:.2g})"
                for i in self.moved[:_LISTED]
            ]
            text += (
                f" Instrumental variables (the outputs of the free run) give {', '.join(given)}."
            )
        remedy = (
            f'Train with a noise model ([noise] model = "auto"). {UNDER_FEEDBACK}'
            if looped
            else 'Train with a noise model ([noise] model = "auto"): training on the free run was '
            "tried, and is not better."
            if self.compared
            else 'Train on the free run (focus = "simulation"), which does not have it, or with a '
            'noise model ([noise] model = "auto").'
        )
        text += f" The intervals of the one-step θ do not include this bias. {remedy}"
        return Warning("inconsistent", text)


class _Rows(NamedTuple):
    """Whitened errors e (N, ny) by rows, their derivatives and the prior's pull, all of one fit."""

    fit: LaggedEstimate
    errors: Matrix
    influence: Influence
    pull: Vector
    """Of the prior on the coordinates (r,)."""
    stiff: Matrix
    """Its precisions there (r, r)."""

    @property
    def flat(self) -> Matrix:
        """Derivatives of all outputs one below the other (N ny, r)."""
        return self.influence.rows.reshape(-1, self.influence.rows.shape[2])

    @property
    def noise(self) -> float:
        """Variance of a whitened error."""
        used = np.sum(self.influence.rows**2)
        return float(np.sum(self.errors**2) / max(self.errors.size - used, 1.0))

    def past(self, errors: Matrix, order: int) -> Matrix:
        """Return the errors 1 … `order` rows before (N ny, ny order), zero before an experiment.

        Every output has coefficients of its own.
        """
        ny = errors.shape[1]
        columns = np.zeros((*errors.shape, ny, order))
        begin = 0
        for piece in by_experiment(self.fit.problem, errors):
            rows = slice(begin, begin + len(piece))
            for lag in range(1, min(order, len(piece) - 1) + 1):
                for o in range(ny):
                    columns[rows, o, o, lag - 1][lag:] = piece[:-lag, o]
            begin += len(piece)
        return columns.reshape(errors.size, ny * order)

    def filter_columns(self, columns: Matrix, rho: Matrix) -> Matrix:
        """Return `x_k − Σ_j ρ_j x_{k−j}` of columns (N ny, r), ρ (ny, order)."""
        ny = len(rho)
        x = columns.reshape(-1, ny, columns.shape[1])
        result = x.copy()
        begin = 0
        for piece in by_experiment(self.fit.problem, x):
            for lag in range(1, min(rho.shape[1], len(piece) - 1) + 1):
                result[begin + lag : begin + len(piece)] -= rho[:, lag - 1][:, None] * piece[:-lag]
            begin += len(piece)
        return result.reshape(columns.shape)


def inconsistency(
    fit: LaggedEstimate, one_step: Response, free_run: Response | None = None
) -> Inconsistency | None:
    """Compare one-step θ with that beside a model of the errors' colour.

    None where nothing feeds back, where there are no standard errors, or too few rows.

    Args:
        one_step: the prediction of the training rows.
        free_run: of the same rows, for instruments; None where it diverges.
    """
    rows = _rows(fit, one_step)
    if rows is None:
        return None
    tried = [
        (*_durbin(rows, order), order)
        for order in _ORDERS
        if rows.errors.size > 20 * (order + len(fit.theta))
    ]
    if not tried:
        return None
    p, step, order = min(tried, key=lambda one: one[0])
    apart = step / np.maximum(_plain_std(rows), 1e-300)
    found = Inconsistency(
        tuple(fit.problem.baseline.names),
        min(1.0, len(tried) * p),
        order,
        fit.theta,
        fit.theta + step,
        _plain_std(rows),
        apart,
        compared=fit.focus is not None and fit.focus.tried("simulation"),
    )
    if not found.found:
        return found
    modelled, std = _with_colour(rows, order)
    if modelled is not None:
        found = replace(
            found,
            modelled=fit.theta + modelled,
            modelled_std=std,
            apart=modelled / _plain_std(rows),
        )
    given = None if free_run is None else _by_instruments(rows, free_run)
    return (
        found
        if given is None
        else replace(found, instruments=fit.theta + given[0], instruments_std=given[1])
    )


def _rows(fit: LaggedEstimate, one_step: Response) -> _Rows | None:
    problem, model, statistics = fit.problem, fit.model, fit.model.statistics
    plain = fit.plain_statistics or statistics
    rows = len(problem.rows) if problem.rows is not None else 0
    if (
        not model.form.states
        or fit.criterion.free_run is not None
        or plain.gram is None
        or not len(fit.theta)
    ):
        return None
    if isinstance(problem, StreamedProblem) or fit.std is None or model.numbers.tilt is not None:
        return None
    if model.coloured:  # its own orders model the colour
        return None
    if rows < _FEWEST or rows * len(problem.outputs) * len(plain.gram) > LARGEST:
        return None
    errors = one_step.errors
    if len(errors) != rows:
        return None
    slopes = one_step_slopes(problem, model)
    prior = prior_of(plain.gram, plain.ridge, len(fit.theta))
    if not np.isfinite(slopes).all() or not np.isfinite(errors).all():
        return None
    influence = Influence.of(slopes, plain, fit.theta_slope, len(fit.theta))
    weights = np.concatenate([np.zeros(len(fit.theta)), np.asarray(model.numbers.weights).ravel()])
    if len(weights) != len(prior):
        weights = np.zeros(len(prior))
    pull = influence.root.T @ (prior * weights)
    stiff = influence.root.T @ (prior[:, None] * influence.root)
    return _Rows(fit, errors @ problem.weight.matrix.T, influence, pull, stiff)


def _plain_std(rows: _Rows) -> Vector:
    """Return standard errors of θ for white and even noise."""
    along, root = rows.influence.along, rows.flat
    return np.sqrt(rows.noise * np.sum((along @ (root.T @ root + rows.stiff)) * along, axis=1))


def _durbin(rows: _Rows, order: int) -> tuple[float, Vector]:
    """Return p of white errors, and the shift of θ by one Gauss-Newton step towards colour."""
    past, a, e = rows.past(rows.errors, order), rows.flat, rows.errors.ravel()
    across = a.T @ past
    beside = past - a @ across
    information = past.T @ beside
    if not np.linalg.cond(information) < 1e12:
        return 1.0, np.zeros(len(rows.influence.along))
    rho = np.linalg.solve(information, past.T @ e)
    left = e - beside @ rho
    scores = (beside * left[:, None]).reshape(len(rows.errors), -1, beside.shape[1]).sum(axis=1)
    inverse = np.linalg.inv(information)
    freedom = max(e.size - np.sum(a**2) - len(rho), 1.0)
    covariance = inverse @ (scores.T @ scores) @ inverse * e.size / freedom
    wald = float(rho @ np.linalg.solve(covariance, rho)) / len(rho)
    return float(scipy.special.fdtrc(len(rho), freedom, wald)), -rows.influence.along @ (
        across @ rho
    )


def _with_colour(rows: _Rows, order: int) -> tuple[Vector | None, Vector]:
    """Return the shift of θ beside an autoregression of the errors, and its standard errors.

    None where it diverges.
    """
    a, ny, r = rows.flat, rows.errors.shape[1], rows.flat.shape[1]
    moved, rho = np.zeros(r), np.zeros((ny, order))
    nothing = np.zeros(len(rows.influence.along))

    def parts(moved: Vector, rho: Matrix) -> tuple[Vector, Vector, float]:
        errors = rows.errors.ravel() - a @ moved
        white = rows.filter_columns(errors[:, None], rho)[:, 0]
        prior = 2 * rows.pull @ moved + moved @ rows.stiff @ moved
        return errors, white, float(white @ white + prior)

    errors, white, loss = parts(moved, rho)
    for _ in range(_STEPS):
        past = rows.past(errors.reshape(rows.errors.shape), order)
        jacobian = np.column_stack([rows.filter_columns(a, rho), past])
        normal = jacobian.T @ jacobian
        normal[:r, :r] += rows.stiff
        gradient = jacobian.T @ white
        gradient[:r] -= rows.pull + rows.stiff @ moved
        step = np.linalg.lstsq(normal, gradient, rcond=1e-12)[0]
        for share in (1.0, 0.5, 0.25, 0.1, 0.0):
            there = moved + share * step[:r], rho + share * step[r:].reshape(ny, order)
            trial = parts(*there)
            if np.isfinite(trial[2]) and trial[2] <= loss:
                break
        fall = loss - trial[2]
        (moved, rho), (errors, white, loss) = there, trial
        if fall <= _CLOSE * loss:
            break
    if not np.isfinite(loss):
        return None, nothing
    covariance = (
        np.linalg.pinv(normal)
        * float(white @ white)
        / max(white.size - np.sum(a**2) - rho.size, 1.0)
    )
    along = rows.influence.along
    return along @ moved, np.sqrt(
        np.maximum(np.sum((along @ covariance[:r, :r]) * along, axis=1), 0.0)
    )


def _by_instruments(rows: _Rows, free_run: Response) -> tuple[Vector, Vector] | None:
    """Return the shift of θ with the free run's outputs as instruments, and its standard errors."""
    fit = rows.fit
    form, record = fit.model.form, fit.problem.record
    pieces: Sequence[Matrix] = [
        form.regressors(
            replace(e, outputs=np.where(np.isfinite(t.model), t.model, e.outputs)), record
        )
        for e, t in zip(record.experiments, free_run.trajectories, strict=True)
    ]
    x = np.concatenate(pieces)
    if x.shape != fit.problem.rows.x.shape or not np.isfinite(x).all():
        return None
    slopes = one_step_slopes(fit.problem, fit.model, x) @ rows.influence.root
    z, a = slopes.reshape(rows.flat.shape), rows.flat
    system = z.T @ a + rows.stiff
    if not np.linalg.cond(system) < 1e10:
        return None
    moved = np.linalg.solve(system, z.T @ rows.errors.ravel() - rows.pull)
    left = (rows.errors.ravel() - a @ moved).reshape(rows.errors.shape)
    scores = np.einsum("kor,ko->kr", slopes, left)
    reach = rows.influence.along @ np.linalg.inv(system)
    lags = int(4 * (len(scores) / 100) ** (2 / 9)) + max(_ORDERS)
    covariance = reach @ newey_west(by_experiment(fit.problem, scores), lags) @ reach.T
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    if not np.isfinite(std).all() or np.any(std > _VAGUE * _plain_std(rows)):
        return None
    return rows.influence.along @ moved, std
