"""Outputs of a motion that are recorded in coarse steps: what that does to the parameters.

A sensor of step q records `Q(y)`: to the nearest multiple (`round`), the one below or above
(`floor`, `ceil`), or the one toward zero (`trunc`). Its error `Q(y) − y` is a function of the
signal, not noise. The model's own free run ŷ shows what it is: Q(ŷ) − ŷ, which moves (c, w) by
`(SᵀS)⁻¹Sᵀ(Q(ŷ) − ŷ)`. That is taken from the parameters, and ŷ made again, a few times: a
truncating sensor scales the outputs, which the fit follows. The way that leaves least is named.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import Warning
from orthaug._base.jax import AnyArray
from orthaug._base.lines import join_words, percent
from orthaug.analysis.free_run_equations import FreeRunPoint
from orthaug.analysis.residuals import errors_of, rms_errors
from orthaug.data.columns import quantum_of
from orthaug.data.record import Record
from orthaug.fitting.motion_estimate import MotionEstimate
from orthaug.models.response import Response

_WAYS: Mapping[str, tuple[str, Callable[[AnyArray], AnyArray]]] = {
    "round": ("rounded to the nearest", np.round),
    "trunc": ("cut off toward zero", np.trunc),
    "floor": ("rounded down", np.floor),
    "ceil": ("rounded up", np.ceil),
}
_REPEATS = 4
_MOST = 0.5  # of the error's mean square: less is not mainly the steps
_MATTERS = 0.25  # standard errors: by less no parameter is said to be moved


@dataclass(frozen=True, eq=False)
class QuantisedOutput:
    """The part of a free run's error that is the steps of its outputs.

    `steps` by output, in its unit; `share` of the error's mean square that they explain; `left`
    what of the error (N, ny) of each experiment they do not; `moved` (np,) by how much they move
    p̂; `whole` where they leave too little to test. No warning where they move no parameter.
    """

    steps: Mapping[str, float]
    way: str
    share: float
    left: list[Matrix]
    moved: Vector
    warning: Warning | None
    whole: bool = False


def coarse_steps(record: Record, rms: Vector) -> Vector:
    """Return the steps (ny,) of outputs that are recorded in steps as large as their RMS error.

    0 for the others, and where there is no error.
    """
    found = np.zeros(len(record.outputs))
    for i, error in enumerate(rms):
        step = quantum_of(np.concatenate([e.outputs[:, i] for e in record.experiments]))
        found[i] = step if step is not None and 0 < error <= step else 0.0
    return found


def quantised_output(fit: MotionEstimate, free_run: Response) -> QuantisedOutput | None:
    """Return what coarse steps of the outputs do to a motion's fit.

    None where no output is recorded in steps as large as the free run's error, where these do not
    explain most of it, or where the model's predictor has a gain.

    Args:
        free_run: of the model over the training data.
    """
    place = FreeRunPoint.of(fit)
    if fit.model.coloured or place is None or fit.split_by.slope is None:
        return None
    record = fit.problem.record
    if not record.complete:
        return None
    quanta, first = coarse_steps(record, rms_errors(free_run)), record.experiments[0].outputs[0]
    if not quanta.any():
        return None
    found = [
        tried
        for way in _WAYS
        if (tried := _explain_by(way, fit, place, free_run, quanta, first)) is not None
    ]
    best = max(found, key=lambda tried: tried.share, default=None)
    return best if best is not None and best.share > _MOST else None


def _explain_by(
    way: str,
    fit: MotionEstimate,
    place: FreeRunPoint,
    free_run: Response,
    quanta: Vector,
    levels: Vector,
) -> QuantisedOutput | None:
    """Return what a way of recording explains and moves; None where a free run fails."""
    segmented, weight = fit.segmented, fit.problem.deviation
    coarse = quanta > 0

    def error(y: AnyArray, axis: int) -> AnyArray:
        """Return Q(y) − y; y has outputs along an axis."""
        shape = [1] * y.ndim
        shape[axis] = -1
        q = np.where(coarse, quanta, 1.0).reshape(shape)
        # Steps count from zero where they are cut off
        zero = (levels if way != "trunc" else 0 * levels).reshape(shape)
        recorded = zero + q * _WAYS[way][1]((y - zero) / q)
        return np.where(coarse.reshape(shape), recorded - y, 0.0)

    c, w = place.c, place.w
    step = np.zeros(len(c) + len(w))
    at_fit = np.asarray(place.respond(c, w))
    low, high = fit.problem.motion.coordinates.bounds
    with np.errstate(all="ignore"):
        for _ in range(_REPEATS):
            here = np.clip(c - step[: len(c)], low, high), w - step[len(c) :]
            y = np.asarray(place.respond(*here))
            step = place.moved_by(at_fit + error(y, -2))
            if step is None or not np.isfinite(step).all():
                return None
        here = np.clip(c - step[: len(c)], low, high), w - step[len(c) :]
        run = replace(fit.model, numbers=segmented.numbers(*here)).simulate(fit.problem.record)
        left = [trajectory.errors - error(trajectory.model, -1) for trajectory in run.trajectories]
        squares = np.mean((np.concatenate(left) / weight)[:, coarse] ** 2)
        before = np.mean((np.concatenate(errors_of(free_run)) / weight)[:, coarse] ** 2)
    if not np.isfinite(squares):
        return None
    outputs = [channel.name for channel in fit.problem.record.outputs]
    steps = {outputs[i]: float(quanta[i]) for i in np.flatnonzero(coarse)}
    shift, share = fit.moved_by(step), float(1 - squares / before)
    warning = _warning(fit, steps, way, share, shift)
    return QuantisedOutput(steps, way, share, left, shift, warning)


def _warning(
    fit: MotionEstimate, steps: Mapping[str, float], way: str, share: float, shift: Vector
) -> Warning | None:
    """Return the warning with the parameters that the steps move; None where they move none."""
    units = {c.name: f" {c.unit}".rstrip() for c in fit.problem.record.outputs}
    recorded = [f"{name} in steps of {step:.3g}{units[name]}" for name, step in steps.items()]
    moved = []
    for name, by, std, value in zip(
        fit.problem.motion.names, shift, fit.known_std, fit.values, strict=True
    ):
        errors = abs(by) / std if std > 0 else np.nan
        if errors > _MATTERS:
            own = f", {percent(by / value, sign='+')}" if value else ""
            moved.append(f"{name} by {by:+.2g} ({errors:.1f} standard errors{own})")
    if not moved:
        return None
    text = (
        f"the record has {join_words(recorded)}, {_WAYS[way][0]}. That explains {percent(share)} "
        "of the mean square of the free run's error, and is a function of the signal rather than "
        f"noise. It moves {join_words(moved)}: subtract that; the intervals do not count it. "
        "Remedies: a finer measurement, or inputs that sweep each step faster."
    )
    return Warning("quantised_output", text)
