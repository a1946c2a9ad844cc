"""Modes of the linearised motion along a run, in 1/s: growth or decay of small changes.

They are those of ∂ẋ/∂x with the learner in it; of a discrete motion `ln(λ)/Ts` with those of
∂x⁺/∂x. They are local: a run may be bounded where some grow, and need not be where none does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix
from orthaug._base.errors import Warning
from orthaug._base.jax import Array, jax, jnp, quick_jit
from orthaug._base.lines import percent
from orthaug.analysis.beyond_training import describe_beyond, radius_beyond
from orthaug.analysis.boundedness import describe_divergence, find_divergence
from orthaug.data.record import Record
from orthaug.models.dynamics import Numbers
from orthaug.models.model import Model
from orthaug.models.moving import MotionDynamics
from orthaug.physics.parameters import time_unit

_LARGEST = 1024.0  # factor on the inputs that is tried
_POINTS = 2000  # at most
_OFTEN = 0.01  # of the points: growing modes on more are a warning
_STILL = 1e-9  # of the fastest mode: an integrator's eigenvalue is rounding of zero


@dataclass(frozen=True)
class Modes:
    """Local eigenvalues over `points` of a run [1/s].

    `integrators` counts those that are zero everywhere; they are in nothing else here. `rightmost`
    is the largest real part and `worst` the state and input where it is, `median` that of the
    largest real part; `growing` is the share of points where it is positive. `slowest` and
    `fastest` are the least and largest magnitude.
    """

    points: int
    rightmost: float
    median: float
    growing: float
    slowest: float
    fastest: float
    worst: dict[str, float]
    integrators: int = 0


@dataclass(frozen=True)
class MotionStability:
    """The modes of a motion, in the place that other models have more evidence in."""

    modes: Modes | None
    warnings: tuple[Warning, ...]
    text: str
    diverges_at: float | None = None
    """Factor on the inputs from which the free run leaves all bounds, searched up to `searched`;
    None: nowhere.
    """
    searched: float | None = None
    radius_beyond: float | None = None
    """Spectral radius of a sample's step far beyond the training (`beyond_training`)."""

    feedback = contraction = lipschitz = None


def motion_stability(
    model: Model[MotionDynamics], x: Matrix, u: Matrix, record: Record | None = None
) -> MotionStability:
    """Return the stability over states (N, nx) and inputs (N, nu) of a run, where these are finite.

    With a `record` the free run is also tried on larger and larger inputs.
    """
    checks = _of_modes(model, x, u)
    if record is None or not record.inputs:
        return checks
    divergence = find_divergence(model, record, _LARGEST)
    sentence, code = describe_divergence(divergence, driven=True)
    inputs = [model.form.inputs(experiment, record) for experiment in record.experiments]
    radius = radius_beyond(model, x, np.concatenate(inputs))
    text = "\n".join(
        part for part in (checks.text, sentence, describe_beyond(model, radius)) if part
    )
    warnings = (*checks.warnings, *((Warning(code, sentence),) if code else ()))
    return replace(
        checks,
        text=text,
        warnings=warnings,
        diverges_at=divergence.factor,
        searched=divergence.searched,
        radius_beyond=radius,
    )


def _of_modes(model: Model[MotionDynamics], x: Matrix, u: Matrix) -> MotionStability:
    found = modes(model, x, u)
    if found is None:
        return MotionStability(None, (), "The motion has no finite derivative along its run.")
    held = model.form.motion.held
    subject = "the closed loop" if held else "the motion"
    linear = "linearised closed loop" if held else "linearised motion"
    units = [parameter.unit for parameter in model.form.motion.parameters]
    rate = f"1/{time_unit(units, model.time_column)}"
    text = f"The {linear} has {_sizes(found, rate)} along the free run. "
    if not found.growing:
        return MotionStability(found, (), text + _without_growth(found, rate))
    where = ", ".join(f"{name} = {value:.4g}" for name, value in found.worst.items())
    text += (
        f"At {percent(found.growing, 3)} of its points a mode grows, by up to "
        f"{found.rightmost:.4g} {rate} ({where}); median of the largest real part "
        f"{found.median:.4g} {rate}."
    )
    if found.growing <= _OFTEN:
        return MotionStability(found, (), text)
    warning = (
        f"a mode of {subject} grows at {percent(found.growing, 3)} of the points of the free run, "
        f"by up to {found.rightmost:.4g} {rate}: small errors grow there."
    )
    driven = bool(model.form.motion.inputs)
    if driven and not held and found.median > 0:  # the plant is unstable where it mostly is
        warning += " If a controller held the plant, give `controller` and the reference as input."
    return MotionStability(found, (Warning("growing_mode", warning),), text)


def _sizes(found: Modes, rate: str) -> str:
    """Return a clause on the number of integrators and the rates of the other modes."""
    count = found.integrators
    whole = f"{count} integrators" if count > 1 else "an integrator" if count else ""
    if not found.fastest:
        return f"{whole} and no other modes"
    sizes = dict.fromkeys(f"{size:.4g}" for size in (found.slowest, found.fastest))
    return f"{whole}{' and ' if count else ''}modes of {' to '.join(sizes)} {rate}"


def _without_growth(found: Modes, rate: str) -> str:
    count, sentences = found.integrators, []
    if found.fastest and found.rightmost < 0:
        others = "All others decay" if count else "All decay"
        sentences.append(
            f"{others} everywhere: the largest real part is {found.rightmost:.4g} {rate}."
        )
    elif found.fastest:
        sentences.append("No mode grows, but not all decay: the largest real part is 0.")
    if count:
        sentences.append(
            f"The integrating mode{'s' if count > 1 else ''} neither "
            f"decay{'' if count > 1 else 's'} nor grow{'' if count > 1 else 's'}: errors in "
            f"{'them' if count > 1 else 'it'} stay."
        )
    return " ".join(sentences)


def modes(model: Model[MotionDynamics], x: Matrix, u: Matrix) -> Modes | None:
    """Return the eigenvalues over at most 2000 points, spread evenly.

    None where no derivative is finite.
    """
    finite = np.isfinite(x).all(axis=1)
    x, u = x[finite], u[finite]
    rows = (
        np.linspace(0, len(x) - 1, min(len(x), _POINTS)).astype(int)
        if len(x)
        else np.zeros(0, dtype=int)
    )
    slopes = (
        np.asarray(_slopes(model.form, model.numbers, x[rows], u[rows]))
        if len(rows)
        else np.zeros((0, 1, 1))
    )
    kept = np.isfinite(slopes).all(axis=(1, 2))
    if not kept.any():
        return None
    values = np.linalg.eigvals(slopes[kept])
    if model.form.motion.scheme.discrete or model.form.motion.held:
        small = np.abs(values) < 1e-300  # gone in one sample
        values = np.log(np.where(small, 1e-300, values).astype(complex)) / model.sampling_time
    size = np.abs(values)
    fastest = float(size.max())
    integrators = int((size <= _STILL * fastest).sum(axis=1).min())
    others = np.take_along_axis(values, np.argsort(size, axis=1), axis=1)[:, integrators:]
    largest = others.real.max(axis=1) if others.shape[1] else np.zeros(len(others))
    largest = np.where(np.abs(largest) <= _STILL * fastest, 0.0, largest)
    place = rows[kept][int(np.argmax(largest))]
    return Modes(
        points=int(kept.sum()),
        rightmost=float(largest.max()),
        median=float(np.median(largest)),
        growing=float((largest > 0).mean()),
        slowest=float(np.abs(others).min(initial=fastest)),
        fastest=fastest,
        worst=model.form.describe(x[place], model.form.external(u[place])),
        integrators=integrators,
    )


@partial(quick_jit, static_argnames="form")
def _slopes(
    form: MotionDynamics, numbers: Numbers, x: Float[Array, "m nx"], u: Float[Array, "m nu"]
) -> Float[Array, "m nx nx"]:
    def rate(x: Array, u: Array) -> Any:
        if form.motion.held:  # of a loop: the step from a sample to the next
            ends = 2 if form.motion.hold == "first-order" else 1
            return form.step(numbers, x, jnp.concatenate([form.external(u)] * ends))[0]
        return sum(form.rates(numbers, x, u))

    return jax.vmap(jax.jacfwd(rate))(x, u)
