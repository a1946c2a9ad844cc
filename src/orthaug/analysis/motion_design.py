"""Experiment design for a motion: an input under which sensor noise and suspected terms disturb its parameters least.

As `design_input`, with the sensitivities of the free run for Φ: `[∂y/∂p]` less what the unknown start could do, so that
`Cov p̂ = σ²(ΦᵀΦ)⁻¹` for white noise σ on the outputs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from orthaug._base.checks import Matrix, Vector, check_number
from orthaug._base.errors import InputError
from orthaug.analysis.design import Design, check_samples, input_limits, searched
from orthaug.analysis.motion_plant import MotionPlant
from orthaug.analysis.motion_suspects import MotionSuspect
from orthaug.physics.motion import Motion


def design_motion_input(
    motion: Motion,
    *,
    sampling_time: float,
    samples: int,
    amplitude: float | None = None,
    minimum: float | None = None,
    maximum: float | None = None,
    rate: float | None = None,
    suspects: Sequence[MotionSuspect] = (),
    noise: float | Sequence[float] = 0.0,
    parameters: Vector | Sequence[float] | None = None,
    substeps: int | None = None,
    weights: Vector | Matrix | None = None,
    condition: float = 1e3,
    channel: str | None = None,
    seed: int = 0,
    iterations: int = 30,
) -> Design:
    """The input of least predicted error of p within minimum ≤ u ≤ maximum and |u_k − u_{k−1}| ≤ rate · Ts.

    Args:
        sampling_time: Ts, s.
        samples: N.
        amplitude: the limits are ±amplitude, in the channel's unit; or `minimum` and `maximum` instead.
        rate: in the channel's unit per second.
        suspects: with their coefficients; without any the design has least variance.
        noise: standard deviation of the sensor's noise, or one of each output; 0 counts the bias alone. Without
            suspects 0 means 1.
        parameters: p to simulate with; None for the initial values.
        substeps: of the integrator in a sample; None for the motion's, 1 where that has none.
        weights: W, (np,) for a diagonal, or (m, np); None for 1/|p|.
        condition, channel, seed, iterations: as in `design_input`.

    Raises:
        InputError: numbers out of range, a suspect without coefficient, a motion that runs away, no candidate within
            the cap on the condition number.
    """
    sampling_time = check_number(sampling_time, "sampling_time", positive=True)
    limits = input_limits(amplitude, minimum, maximum), rate, condition
    motion = motion.sampled(sampling_time)
    p = motion.initial if parameters is None else np.asarray(parameters, dtype=float)
    if len(p) != len(motion.names):
        raise InputError(f"`parameters` are {len(p)}; expected {len(motion.names)}: {', '.join(motion.names)}.")
    for value, own in zip(p, motion.parameters, strict=True):
        if not own.min <= value <= own.max:
            raise InputError(f"`parameters`: {own.name} is {value:g}; its bounds are {own.min:g} and {own.max:g}.")
    steps = substeps or motion.substeps or 1
    plant = MotionPlant(motion, suspects, p, sampling_time, steps, channel)
    samples = check_samples(samples, plant)
    return searched(plant, limits, sampling_time, samples, noise, bool(suspects), weights, (seed, iterations))
