"""The verb `bias_budget`: the cause that explains the learner and the bias that follows from it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

from orthaug._base.checks import check_type
from orthaug._base.errors import InputError
from orthaug.analysis.budget import Budget, lagged_budget
from orthaug.analysis.free_run_bias import suspected_bias
from orthaug.analysis.motion_budget import MotionBudget, declared_budget
from orthaug.analysis.suspects import MotionSuspect, Suspect
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.motion_estimates import MotionEstimate
from orthaug.inference.measures import Measure
from orthaug.physics.parameters import PhysicsMap


def bias_budget(
    fit: Estimate | MotionEstimate,
    suspects: Sequence[Suspect | MotionSuspect] = (),
    *,
    physics: PhysicsMap | None = None,
    measure: Measure | None = None,
) -> Budget | MotionBudget | None:
    """Return the bias that what the learner found implies.

    None where no cause explains enough of it.

    Args:
        fit: with a learner and the orthogonal structure; of others there is no budget. Of lagged
            physics or a motion.
        suspects: terms that may be missing, looked at first; of a motion `MotionSuspect`.
        physics: the map from physical parameters to θ, for their biases; a motion has none.
        measure: what θ was split under, where that is not the training measure; a motion's fit
            knows its own.

    Returns:
        The `cause`, the `share` of the learner that it explains, and the bias of each of
        `parameters` and `physical`, estimate less truth, with an interval that covers bias and
        noise together: the hull over all causes that noise cannot separate. Where `determined` is
        False that is wider than the value itself, and there is none.

    Raises:
        InputError: arguments that the kind of physics does not take; another measure than that of
            the fit; a suspect on channels or lags that the data do not have.

    Examples:
        >>> import numpy as np
        >>> import orthaug as oa
        >>> u = np.random.default_rng(0).uniform(-1, 1, 300)
        >>> noise = 0.05 * np.random.default_rng(1).normal(size=300)
        >>> record = oa.Record.from_arrays(u, 2 * u + u**3 + noise)
        >>> gain = oa.Baseline.from_terms([oa.Term("gain", "u[k]")])
        >>> cubic, structure = oa.Terms(("u[k]**3",)), oa.Orthogonal(shared="all")
        >>> fit = oa.estimate(record, gain, learner=cubic, structure=structure)
        >>> budget = bias_budget(fit, [oa.Suspect("cubic", "u[k]**3")])
        >>> budget.cause.suspect.name, round(budget.of("gain").value, 1)  # θ took 0.6 of the cubic
        ('cubic', 0.6)
    """
    check_type(fit, Estimate | MotionEstimate, "fit", "what estimate returns")
    moves = isinstance(fit, MotionEstimate)
    wanted = MotionSuspect if moves else Suspect
    for suspect in suspects:
        check_type(
            suspect,
            wanted,
            "suspects",
            f"a sequence of {wanted.__name__}, as the fit's physics requires",
        )
    if not moves:
        return lagged_budget(fit, cast(Any, suspects), physics=physics, measure=measure)
    for name, given in (("physics", physics), ("measure", measure)):
        if given is not None:
            raise InputError(
                f"`{name}` does not apply to a fit of equations of motion; leave it out."
            )
    if not fit.status.ok:
        return None
    declared = cast("Sequence[MotionSuspect]", suspects)
    return declared_budget(fit, declared, suspected_bias(fit, declared) if declared else [])
