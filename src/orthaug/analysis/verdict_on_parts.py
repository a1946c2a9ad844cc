"""Whether the learner of an estimate helps, on records that were not fitted."""

from __future__ import annotations

from collections.abc import Mapping

from orthaug._base.checks import check_count, check_type
from orthaug._base.errors import InputError
from orthaug.analysis.validation import Verdict, extrapolation, judge, trial_on
from orthaug.data.record import Record
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.motion_estimates import MotionEstimate


def verdict(
    fit: Estimate | MotionEstimate,
    alone: Estimate | MotionEstimate,
    tests: Record | Mapping[str, Record],
    *,
    skip: int = 0,
) -> Verdict:
    """Whether the learner helps: free runs of a fit and of physics alone on records that neither was fitted to.

    Args:
        fit: with a learner.
        alone: the same physics without, `estimate(…, learner=None)`, trained on the same record.
        tests: a record, or several by name. A free run starts from the measured outputs before its first row, that
            of a motion from the state by which it follows its first rows.
        skip: leading samples of each experiment that are not scored.

    Returns:
        `code` is helps, no_help or hurts; `text` says why, with the errors of both and where the training range is
        left; `trials` are the errors.

    Raises:
        InputError: a record without outputs or with other channels; an estimate that is not usable.

    Examples:
        >>> import numpy as np
        >>> import orthaug as oa
        >>> u = np.random.default_rng(0).uniform(-1, 1, 300)
        >>> record = oa.Record.from_arrays(u, 2 * u + u**3 + 0.05 * np.random.default_rng(1).normal(size=300))
        >>> gain = oa.Baseline.from_terms([oa.Term("gain", "u[k]")])
        >>> train, test = record.split(0.7)
        >>> fit = oa.estimate(train, gain, learner=oa.Terms(("u[k]**3",)))
        >>> verdict(fit, oa.estimate(train, gain, learner=None), test).code
        'helps'
    """
    for name, estimate in (("fit", fit), ("alone", alone)):
        check_type(estimate, Estimate | MotionEstimate, name, "an Estimate")
        if not estimate.status.ok:
            raise InputError(f"`{name}` has no model: {estimate.status.message}.")
    check_type(tests, Record | Mapping, "tests", "a Record, or Records by name")
    records = {"the test record": tests} if isinstance(tests, Record) else dict(tests)
    if not records:
        raise InputError("`tests` is empty; give a record that was not fitted.")
    skip = check_count(skip, "skip", least=0)
    trials, beyond, trained = [], [], (fit.reach(fit.problem.record), fit.layout)
    for name, record in records.items():
        check_type(record, Record, f"tests[{name!r}]", "a Record")
        ordered = fit.model.fitting(record, need_outputs=True)
        skips = (skip,) * len(ordered.experiments)
        trials.append(trial_on(str(name), ordered, skips, alone.model, fit.model))
        beyond += extrapolation(str(name), fit.reach(ordered), *trained)
    found = judge(trials, beyond)
    assert found is not None
    return found
