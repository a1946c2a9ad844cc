"""Measures over the states and inputs of a motion: the points on which physics and learner are told apart."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.errors import InputError
from orthaug._base.warning import Warning
from orthaug.inference.measures import Measure, Support
from orthaug.inference.motion_split import Field
from orthaug.inference.splitting import SUPPORTED
from orthaug.models.dynamics import Numbers

if TYPE_CHECKING:
    from orthaug.fitting.motion_course import MotionCourse


def field_under(
    measure: Measure, course: MotionCourse, numbers: Numbers, states: Any
) -> tuple[Field, float, tuple[Warning, ...]]:
    """Points of a measure with the sizes of the learned equations, its support by the data, and what to tell.

    Raises:
        InputError: a measure that does not fit the motion, or points at which the motion has no value.
    """
    motion, form = course.problem.motion, course.dynamics
    c, w = np.asarray(numbers.theta - numbers.theta_aux), numbers.weights
    x, u = course.trajectory(c, w, states)
    finite = np.isfinite(x).all(axis=1)
    x, u = x[finite], u[finite]
    nx = x.shape[1]
    support = Support.of_motion(motion, x, u)
    points = measure.points(support)
    at, beside = points.x[:, :nx], points.x[:, nx:]
    size = sizes_learned(course, c, x, u)
    found = np.asarray(motion.rates(at.T, beside.T, motion.coordinates.physical(c), np), dtype=float)
    if not np.isfinite(found).any():
        raise InputError(f"the motion has no value on the {measure.name} measure; narrow it.")
    finite = np.isfinite(found).all(axis=0)
    weight = np.where(finite, points.weight, 0.0)
    share = support.share(points)
    told = ()
    if share < SUPPORTED and form.bound is not None:
        text = (
            f"only {100 * share:.0f} % of the {measure.name} measure lies within reach of the training data: elsewhere "
            "the parameters rest on how the learner extrapolates."
        )
        told = (Warning("measure_beyond_data", text),)
    return Field(at[finite], beside[finite], weight[finite] / weight.sum(), size), share, told


def sizes_learned(course: MotionCourse, c: Any, x: Any, u: Any) -> Any:
    """The size (nl,) of each learned equation and output over the runs."""
    motion = course.problem.motion
    with np.errstate(all="ignore"):
        rates = np.asarray(motion.rates(x.T, u.T, motion.coordinates.physical(c), np), dtype=float)
    if motion.integrator == "discrete":
        rates = rates - x.T
    states, outputs = motion.learned
    size = np.concatenate([np.nanstd(rates[list(states)], axis=1), course.deviation[list(outputs)]])
    return np.where(np.isfinite(size) & (size > 0), size, 1.0)
