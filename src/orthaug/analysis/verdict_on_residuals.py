"""What the residuals of an estimate say, of whichever kind its model is."""

from __future__ import annotations

from typing import cast

from orthaug._base.checks import check_type
from orthaug._base.errors import InputError
from orthaug.analysis import diagnosis
from orthaug.analysis.diagnosis import Diagnosis
from orthaug.analysis.motion_diagnosis import diagnose_motion
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.motion_estimates import MotionEstimate
from orthaug.models.response import Response


def diagnose(
    fit: Estimate | MotionEstimate, *, one_step: Response | None = None, free_run: Response | None = None
) -> Diagnosis | None:
    """Analyse the residuals of a fit on its training data; None where they cannot be tested.

    Of lagged physics those one step ahead and of the free run; of a motion those of the free run, for its states are
    not measured, with a test of the terms that its equations could lack (`missing`).

    Args:
        one_step: the prediction of the training data, if it is there already; likewise their `free_run`.

    Raises:
        InputError: an estimate that is not usable.

    Examples:
        >>> import numpy as np
        >>> import orthaug as oa
        >>> u = np.random.default_rng(0).uniform(-1, 1, 300)
        >>> record = oa.Record.from_arrays(u, 2 * u + u**3 + 0.05 * np.random.default_rng(1).normal(size=300))
        >>> gain = oa.Baseline.from_terms([oa.Term("gain", "u[k]")])
        >>> diagnose(oa.estimate(record, gain, learner=None)).verdict
        'unmodelled'
    """
    check_type(fit, Estimate | MotionEstimate, "fit", "an Estimate")
    if fit.lagged:
        return diagnosis.diagnose(cast(Estimate, fit), one_step=one_step, free_run=free_run)
    if not fit.status.ok:
        raise InputError(f"`fit` has no model: {fit.status.message}.")
    own = fit.model.simulate(fit.problem.record) if free_run is None else free_run
    return diagnose_motion(cast(MotionEstimate, fit), own)
