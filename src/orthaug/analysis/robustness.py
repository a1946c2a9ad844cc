"""Which standard errors a fit has by default: robust ones where its residual is coloured and the rows suffice."""

from __future__ import annotations

from typing import Any

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.errors import InputError
from orthaug.analysis.residuals import LAGS, PRACTICALLY_WHITE, ROUNDING, errors_of, rms_errors
from orthaug.analysis.whiteness import ROWS_PER_LAG, autocorrelation, ljung_box
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.motion_estimates import MotionEstimate
from orthaug.models.response import Response

_FEWEST_ROWS, _ROWS_PER_TERM = 100, 10  # rows that a sum of autocovariances needs, in all and for each of its lags
_FEWEST_BLOCKS = 20  # of which the variance of a sum can be told: its standard error is then a third of it
_MEMORIES = 3  # times as many lags as the residual's correlation lasts: Bartlett's weights fade
_LEVEL = 0.01  # of the test whether a residual is white


def robust_where_coloured(fit: Estimate, response: Response) -> Estimate:
    """The fit with robust standard errors, where it leaves a coloured residual: Newey and West, or batch means.

    `response` is the prediction of the training rows. Few rows, or ones that remember each other for long, leave the
    plain errors: their robust ones would be too small.
    """
    if not fit.status.ok or fit.covariance is None or fit.at_bound:
        return fit
    lags = _memory(fit, response) if fit.criterion.flown is None else block_of(fit)
    return _robust(fit, len(fit.problem.rows), lags)


def robust_motion(fit: MotionEstimate) -> MotionEstimate:
    """The fit with robust standard errors where its free run leaves coloured errors and the rows suffice."""
    if not fit.status.ok or fit.covariance is None:
        return fit
    return _robust(fit, len(fit.problem.record), block_of(fit))


def _robust(fit: Any, rows: int, lags: int | None) -> Any:
    """Where so many rows tell a sum of so many autocovariances."""
    if lags is None or rows < max(_FEWEST_ROWS, _ROWS_PER_TERM * lags):
        return fit
    try:
        return fit.robust(lags)
    except InputError:  # an ensemble, or a fit without statistics
        return fit


def _memory(fit: Estimate, response: Response) -> int | None:
    """Lags for the one-step residual; None where it is white, or rounding."""
    memory = 0
    if np.all(rms_errors(response) / fit.problem.deviation < ROUNDING):
        return None
    for i in range(len(fit.problem.outputs)):
        pieces = [errors[:, i] for errors in errors_of(response)]
        if _is_coloured(pieces):
            rows = sum(map(len, pieces))
            acf = np.asarray(autocorrelation(pieces, rows // ROWS_PER_LAG))
            quiet = np.abs(acf) < 2 / np.sqrt(rows)
            memory = max(memory, int(np.argmax(np.append(quiet, True))))
    return _MEMORIES * memory or None


def block_of(fit: Any) -> int | None:
    """Steps of a block for the errors of the free run; None where these are white, or leave too few blocks."""
    if fit.scores is None:
        return None
    errors = fit.scores.errors()  # (ny, segments, steps), 0 where a step is not scored
    size = np.sqrt(np.sum(errors**2, axis=(1, 2)) / max(fit.scores.segments.count, 1))
    if not np.isfinite(size).all() or np.all(size / fit.problem.deviation < ROUNDING):
        return None
    if not any(_is_coloured([one[one != 0] for one in output]) for output in errors):
        return None
    steps = fit.scores.block()
    if steps is None or fit.scores.segments.count < _FEWEST_BLOCKS * steps:
        return None
    return steps


def _is_coloured(pieces: list[Vector]) -> bool:
    """Whether Ljung-Box rejects a white residual and a correlation is large enough to matter."""
    box, acf = ljung_box(pieces, LAGS), autocorrelation(pieces, sum(map(len, pieces)) // ROWS_PER_LAG)
    return box is not None and acf is not None and box.p < _LEVEL and np.abs(acf[1:]).max() >= PRACTICALLY_WHITE
