"""Noises of an observer, from the verdict on the residual or by the likelihood of a record.

Noise in the equations moves the state; noise on a sensor does not. The residual shows which
(`diagnose`): a white one one step ahead is the equation's, R = 0 and Q its covariance; a white one
of a free run is the sensors', R its covariance, and Q so small that it makes 3 % of the free run's
variance: that is for a model that is not exact. Otherwise both are there. Where a motion has the
gain of a predictor, they are those of which this is Kalman's gain.
"""

from __future__ import annotations

from typing import TypeGuard

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug.analysis.diagnosis import diagnose
from orthaug.data.record import Record
from orthaug.fitting.estimates import Estimate
from orthaug.models.kalman import Noise, log_likelihood
from orthaug.models.model import Model
from orthaug.physics.innovations import InnovationsModel

_LITTLE, _MOST = 0.03, 0.9  # shares of a free run's variance that disturbances make
BOTH = ("equation_noise", "unmodelled")  # verdicts on a free run that mean disturbances
_STEPS = 400  # that a disturbance is followed
_TUNED_ROWS = 4000
# A fit tunes on so many rows, unless the filter has more states
_KEPT_ROWS, _KEPT_STATES = (1000, 30)
_REACH = 14.0  # of the search, in e-folds
_STEP = -1.5  # of the search at first, in e-folds
_LARGE = 1e12
_LEAST = 1e-3  # share of the innovations that sensors make at least, beside a predictor


def by_verdict(model: Model, verdict: str | None = None) -> Noise:
    """Return the noises of a fitted model by a verdict, by default the noises that it carries.

    Those are noises by the likelihood of its training data, of its predictor, or of its verdict.

    Raises:
        InputError: a model without an estimate of its noise.
    """
    kept = model.statistics
    if verdict is None and kept.disturbance is not None and kept.sensor is not None:
        return Noise(kept.disturbance, kept.sensor)
    if not _is_known(kept.noise):
        raise InputError(
            "the model has no estimate of its noise (few rows, or trained elsewhere); give the "
            "observer `noise=`, such as oa.Noise(state, output) with two covariances."
        )
    found = _of_gain(model)
    if found is not None:
        return found
    verdict, nothing = kept.verdict if verdict is None else verdict, np.zeros_like(kept.noise)
    if not kept.simulated and verdict != "sensor_noise":
        return Noise(np.array(kept.noise), nothing)
    return with_share(model, kept.noise, _MOST if verdict in BOTH else _LITTLE)


def _of_gain(model: Model) -> Noise | None:
    """Return the uncorrelated noises whose steady Kalman gain is nearest to that of a predictor.

    For a gain K the covariance of the states, `P = (A−KC) P (A−KC)ᵀ + Q + K R Kᵀ`, is linear in the
    diagonals of Q and R. They are the least squares, not negative, of `A P Cᵀ = K S` and
    `C P Cᵀ + R = S` (Mehra 1970), S the covariance of the innovations.

    None without a predictor, and where it is unstable about the origin.
    """
    predictor = model.noise
    if not isinstance(predictor, InnovationsModel) or predictor.white:
        return None
    from scipy import linalg, optimize  # slow to import

    form, numbers, size = model.filtering
    gain, spread = np.asarray(predictor.gain), np.asarray(model.statistics.noise)
    a, c, enters, _ = form.linearised(numbers)
    left = a - gain @ c
    if not np.abs(np.linalg.eigvals(left)).max() < 1:
        return None
    unit = form.unit(spread, size)
    moves = [enters @ np.outer(q, q) @ enters.T for q in np.sqrt(np.diag(np.diag(unit)))]
    sensed = [np.outer(r, r) for r in np.sqrt(np.diag(np.diag(spread)))]

    def moments(states: Matrix, outputs: Matrix) -> Vector:
        p = linalg.solve_discrete_lyapunov(left, states)
        return weigh(a @ p @ c.T, c @ p @ c.T + outputs)

    def weigh(states: Matrix, outputs: Matrix) -> Vector:
        scale = np.sqrt(np.diag(spread))
        unit_of = np.maximum(np.abs(gain) @ scale, 1e-12 * np.maximum(size, 1e-300))
        parts = (states / np.outer(unit_of, scale), outputs / np.outer(scale, scale))
        return np.concatenate([part.ravel() for part in parts])

    columns = [moments(q, np.zeros_like(spread)) for q in moves]
    columns += [moments(gain @ r @ gain.T, r) for r in sensed]
    wanted = weigh(gain @ spread, spread)
    shares = optimize.nnls(np.stack(columns, axis=1), wanted)[0]
    q, r = np.split(shares, [len(moves)])
    r = np.maximum(r, _LEAST)  # a filter inverts it where a gap leaves nothing else
    return Noise(np.diag(q * np.diag(unit)), np.diag(r * np.diag(spread)))


def _is_known(noise: Matrix | None) -> TypeGuard[Matrix]:
    return noise is not None and bool(np.all(np.diag(noise) > 0))


def with_share(model: Model, noise: Matrix, share: float) -> Noise:
    """Return disturbances that make up a share of a free run's variance `noise`, about the origin.

    The sensors make the rest.
    """
    form, numbers, size = model.filtering
    unit = form.unit(noise, size)
    a, c, enters, direct = form.linearised(numbers)
    made, moved = direct @ unit @ direct.T, enters @ unit @ enters.T
    for _ in range(_STEPS):
        made = made + c @ moved @ c.T
        moved = a @ moved @ a.T
        if not np.trace(made) < _LARGE * np.trace(noise):
            break
    ratio = float(np.mean(np.diag(made) / np.diag(noise)))
    factor = share / ratio if 0 < ratio < np.inf else share / _LARGE
    return Noise(factor * unit, (1 - share) * np.array(noise))


def of_fit(fit: Estimate) -> Noise:
    """Return the noises of a fit by the verdict on its residual.

    Where both are there, by the likelihood of its data.

    Raises:
        InputError: a fit that failed, or without an estimate of its noise.
    """
    if not fit.status.ok:
        raise InputError(f"`fit` has no model: {fit.status.message}.")
    diagnosis = diagnose(fit)
    verdict = "" if diagnosis is None else diagnosis.verdict
    begun = by_verdict(fit.model, verdict)
    if begun.output.any() and verdict in BOTH:
        return most_likely(fit.model, begun, fit.problem.record)
    return begun


def to_keep(fit: Estimate, verdict: str) -> Noise | None:
    """Return the noises that a fit keeps with its model, by likelihood, if both kinds are present.

    None where the verdict's rule is as good, without an estimate of the noise, and where a filter
    takes long.
    """
    model, kept = fit.model, fit.model.statistics
    if (
        not _is_known(kept.noise)
        or not kept.simulated
        or verdict not in BOTH
        or not model.form.differentiable
    ):
        return None
    if len(model.filtering[0].names) > _KEPT_STATES:
        return None
    return most_likely(model, by_verdict(model, verdict), fit.problem.record, _KEPT_ROWS)


def most_likely(model: Model, begun: Noise, record: Record, rows: int = _TUNED_ROWS) -> Noise:
    """Return the noises of most likelihood for a record among `(q Q, r R)`, over its first rows.

    Where an R or Q that is zero begins, it stays zero.
    """
    form, numbers, size = model.filtering
    record = model.fitting(record, need_outputs=True, gaps=True)
    stretches = []
    for experiment in record.experiments:
        piece = experiment.rows(0, rows)
        if len(piece) > form.first_row:
            belief = form.start(piece, record, form.first_row, begun, size)
            stretches.append((belief, form.inputs(piece, record), piece.outputs[form.first_row :]))
            rows -= len(piece)
        if rows <= 0:
            break
    free = [bool(part.any()) for part in begun]

    def noise(exponents: Vector) -> Noise:
        factor = np.ones(2)
        factor[free] = np.exp(np.clip(exponents, -_REACH, _REACH))
        return Noise(factor[0] * begun.state, factor[1] * begun.output)

    def cost(exponents: Vector) -> float:
        tried = noise(exponents)
        value = -sum(log_likelihood(form, numbers, tried, *stretch) for stretch in stretches)
        return value if np.isfinite(value) else _LARGE

    if not any(free) or not stretches:
        return begun
    from scipy import optimize  # slow to import

    begin = np.concatenate([np.zeros((1, sum(free))), _STEP * np.eye(sum(free))])
    options = {"xatol": 0.02, "fatol": 0.02, "maxiter": 80, "initial_simplex": begin}
    return noise(optimize.minimize(cost, begin[0], method="Nelder-Mead", options=options).x)
