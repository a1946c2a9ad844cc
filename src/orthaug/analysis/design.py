"""Experiment design: an input within limits under which suspected terms and noise disturb θ least.

The physics at θ, with the suspected terms at their guessed coefficients, is simulated for each
candidate input without noise (`plant`), and the best is searched by the rows that this gives
(`input_search`). Of a motion these are the sensitivities of its free run, `[∂y/∂p]` less what the
unknown start could do, so that `Cov p̂ = σ²(ΦᵀΦ)⁻¹` for white noise σ on the outputs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector, check_choice, check_count, check_number, is_number
from orthaug._base.errors import InputError, show
from orthaug._base.memory import check_memory
from orthaug.analysis.input_search import Design, DesignPlant, as_numbers, search_input
from orthaug.analysis.plant import MotionPlant, Plant
from orthaug.analysis.suspects import MotionSuspect, Suspect
from orthaug.physics.baseline import Baseline
from orthaug.physics.motion import Motion

MOST_SAMPLES = 10_000_000  # of a design: its candidates take hours then
LARGEST = 1e100  # amplitude, and one over the smallest: squares are finite
_SIGNALS = 120  # of N samples that are held at once


def design_input(
    baseline: Baseline,
    *,
    outputs: Sequence[str],
    inputs: Sequence[str],
    sampling_time: float,
    samples: int,
    amplitude: float | None = None,
    minimum: float | None = None,
    maximum: float | None = None,
    rate: float | None = None,
    suspects: Sequence[Suspect] = (),
    noise: float | Sequence[float] = 0.0,
    theta: Vector | Sequence[float] | None = None,
    weights: Vector | Matrix | None = None,
    condition: float = 1e3,
    channel: str | None = None,
    seed: int = 0,
    known_inputs: Mapping[str, Any] | None = None,
    initial_outputs: Any = 0.0,
    iterations: int = 30,
) -> Design:
    """Return the input of least predicted error of θ within limits of amplitude and rate.

    The limits are minimum ≤ u ≤ maximum and |u_k − u_{k−1}| ≤ rate · Ts.

    Args:
        baseline: made of terms; of channels with the names `outputs` and `inputs`.
        sampling_time: Ts, s.
        samples: N.
        amplitude: the limits are ±amplitude, in the channel's unit; or `minimum` and `maximum`
            instead.
        rate: in the channel's unit per second, counted from 0, or from the limit next to it, before
            the first sample.
        suspects: with their coefficients; without any the design has least variance (A-optimal for
            W θ).
        noise: standard deviation of the equation noise in the output's unit, or one for each; 0
            counts the bias alone. Without suspects 0 means 1, and `std` is per unit of noise.
        theta: θ to simulate with (nt,); None for the baseline's initial values.
        weights: W, (nt,) for a diagonal, or (m, nt), such as dp/dθ / p for physical parameters p;
            None for 1/|θ|.
        condition: cap on the condition number of Φ with columns of unit norm.
        channel: the input that is designed; may be left out where there is one.
        known_inputs: samples (N,) of other inputs, by name; zero where absent.
        initial_outputs: before the first row, a number, (ny,) or (largest lag, ny).
        iterations: the most improvements of one pattern; `seed` is that of the random candidates.

    Raises:
        InputError: numbers out of range, unknown channels, a suspect without coefficient, θ of 0
            without `weights`, a simulated output that runs away, no candidate within the cap on the
            condition number.
    """
    sampling_time = check_number(sampling_time, "sampling_time", positive=True)
    limits = input_limits(amplitude, minimum, maximum), rate, condition
    suspects = tuple(suspects)
    if baseline.function is not None or not baseline.names:
        raise InputError(
            "a design needs physics that is made of terms, with one parameter or more."
        )
    theta = as_numbers(
        baseline.initial if theta is None else theta, (len(baseline.names),), "theta"
    )
    known = [suspect.sampled(sampling_time) for suspect in suspects]
    plant = Plant(
        baseline.sampled(sampling_time), (tuple(outputs), tuple(inputs)), known, theta, channel
    )
    samples = check_samples(samples, plant)
    set_known(plant, known_inputs, samples)
    plant.before = as_numbers(initial_outputs, (plant.start, len(outputs)), "initial_outputs")
    return search_input(
        plant, limits, sampling_time, samples, noise, bool(suspects), weights, (seed, iterations)
    )


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
    known_inputs: Mapping[str, Any] | None = None,
    seed: int = 0,
    iterations: int = 30,
) -> Design:
    """Return the input of least predicted error of p within limits of amplitude and rate.

    The limits are minimum ≤ u ≤ maximum and |u_k − u_{k−1}| ≤ rate · Ts.

    Args:
        sampling_time: Ts, s.
        samples: N.
        amplitude: the limits are ±amplitude, in the channel's unit; or `minimum` and `maximum`
            instead.
        rate: in the channel's unit per second.
        suspects: with their coefficients; without any the design has least variance.
        noise: standard deviation of the sensor's noise, or one of each output; 0 counts the bias
            alone. Without suspects 0 means 1.
        parameters: p to simulate with; None for the initial values.
        substeps: of the integrator in a sample; None for the motion's, 1 where that has none.
        weights: W, (np,) for a diagonal, or (m, np); None for 1/|p|.
        condition, channel, known_inputs, seed, iterations: as in `design_input`.

    Raises:
        InputError: numbers out of range, a suspect without coefficient, a motion that runs away, no
            candidate within the cap on the condition number.
    """
    sampling_time = check_number(sampling_time, "sampling_time", positive=True)
    limits = input_limits(amplitude, minimum, maximum), rate, condition
    motion = motion.sampled(sampling_time)
    p = motion.initial if parameters is None else np.asarray(parameters, dtype=float)
    if len(p) != len(motion.names):
        raise InputError(
            f"`parameters` are {len(p)}; expected {len(motion.names)}: {', '.join(motion.names)}."
        )
    for value, own in zip(p, motion.parameters, strict=True):
        if not own.min <= value <= own.max:
            raise InputError(
                f"`parameters`: {own.name} is {value:g}; its bounds are {own.min:g} and "
                f"{own.max:g}."
            )
    steps = substeps or motion.substeps or 1
    plant = MotionPlant(motion, suspects, p, sampling_time, steps, channel)
    samples = check_samples(samples, plant)
    set_known(plant, known_inputs, samples)
    return search_input(
        plant, limits, sampling_time, samples, noise, bool(suspects), weights, (seed, iterations)
    )


def set_known(plant: DesignPlant, known_inputs: Mapping[str, object] | None, samples: int) -> None:
    """Give a plant the samples (N,) of inputs beside the one that is designed, by name.

    InputError for wrong ones.
    """
    for name, values in (known_inputs or {}).items():
        check_choice(name, plant.others, "a channel of `known_inputs`")
        plant.others[name] = as_numbers(values, (samples,), f"known_inputs['{name}']")[:, None]


def check_samples(samples: Any, plant: DesignPlant) -> int:
    """Return the number of samples to design.

    Raises InputError for too few, too many, or more than fit into memory.
    """
    nt, ny = len(plant.theta), len(plant.outputs)
    samples = check_count(samples, "samples", plant.start + 4 * nt + 16)
    if samples > MOST_SAMPLES:
        raise InputError(f"`samples` is {show(samples)}; at most {MOST_SAMPLES} are simulated.")
    check_memory(8.0 * samples * (_SIGNALS + 4 * ny * (nt + 2)), f"a design of {samples} samples")
    return samples


def input_limits(amplitude: Any, minimum: Any, maximum: Any) -> tuple[float, float]:
    """Return the lower and upper limit of the input."""
    if (amplitude is None) == (minimum is None and maximum is None) or (minimum is None) != (
        maximum is None
    ):
        given = {"amplitude": amplitude, "minimum": minimum, "maximum": maximum}
        named = (
            " and ".join(name for name, value in given.items() if value is not None)
            or "none of them"
        )
        raise InputError(f"give `amplitude`, or `minimum` and `maximum`; got {named}.")
    if amplitude is not None:
        amplitude = check_number(amplitude, "amplitude", positive=True)
        if not 1 / LARGEST <= amplitude <= LARGEST:
            raise InputError(
                f"`amplitude` must lie between {1 / LARGEST:g} and {LARGEST:g}; got {amplitude:g}."
            )
        return -amplitude, amplitude
    low, high = (
        _limit(name, value) for name, value in (("minimum", minimum), ("maximum", maximum))
    )
    if not high - low >= max(1 / LARGEST, 1e-9 * max(abs(low), abs(high))):
        raise InputError(f"`minimum` must be less than `maximum`; got {low:g} and {high:g}.")
    return low, high


def _limit(name: str, value: Any) -> float:
    if not is_number(value) or abs(value) > LARGEST:
        raise InputError(
            f"`{name}` must be a number between {-LARGEST:g} and {LARGEST:g}; got {show(value)}."
        )
    return float(value)
