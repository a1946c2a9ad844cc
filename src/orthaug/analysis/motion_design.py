"""Experiment design for a motion: an input under which noise and suspects bias p least.

This is `design_input` with the sensitivities of the free run for Φ: `[∂y/∂p]` less what the unknown
start could do, so that `Cov p̂ = σ²(ΦᵀΦ)⁻¹` for white noise σ on the outputs. All inputs that are
tried run side by side.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector, check_choice, check_number
from orthaug._base.errors import InputError
from orthaug._base.jax import Array, jax
from orthaug.analysis.design import (
    Design,
    check_no_memory,
    check_samples,
    input_limits,
    search_input,
    set_known,
)
from orthaug.analysis.motion_suspects import MotionSuspect
from orthaug.analysis.plant import RUNS_AWAY
from orthaug.models.dynamics import Numbers
from orthaug.models.learners import nothing_learned
from orthaug.models.moving import MotionDynamics
from orthaug.physics.integrators import inputs_at_points
from orthaug.physics.motion import Motion
from orthaug.physics.suspected_motion import SuspectedMotion

_WIDTH = 64  # inputs that run side by side: every number of them by the same program


class MotionPlant:
    """A motion at p (np,) for a design: rows of sensitivities of its outputs, without the start.

    A run starts from the declared numbers, and from zero where none is declared.
    """

    start = 0

    def __init__(
        self,
        motion: Motion,
        suspects: Sequence[MotionSuspect],
        p: Vector,
        sampling_time: float,
        substeps: int,
        channel: str | None = None,
    ) -> None:
        if channel is None and len(motion.inputs) != 1:
            names = ", ".join(motion.inputs) or "none"
            raise InputError(
                f"`channel` is missing: the input to design, one of the inputs ({names})."
            )
        self.channel = (
            motion.inputs[0]
            if channel is None
            else check_choice(channel, motion.inputs, "`channel`")
        )
        for suspect in suspects:
            check_no_memory(suspect)
            if suspect.coefficient is None:
                raise InputError(
                    f"suspect '{suspect.name}' has no `coefficient`; a design needs a guess of "
                    "its size."
                )
        self.names, self.theta, self.motion = motion.names, np.asarray(p, dtype=float), motion
        self.outputs: Sequence[str] = tuple(output.name for output in motion.outputs)
        self.others = {name: np.zeros((1, 1)) for name in motion.inputs if name != self.channel}
        starts = [state.start for state in motion.states]
        self.before = np.array(
            [start if isinstance(start, float | int) else 0.0 for start in starts], dtype=float
        )
        suspected = SuspectedMotion.of(motion, [suspect.term(motion) for suspect in suspects])
        self._form = MotionDynamics(suspected, (), nothing_learned(), sampling_time, substeps)
        self._coefficients = np.array([suspect.coefficient for suspect in suspects], dtype=float)
        coordinates = motion.coordinates
        q = coordinates.of(self.theta)
        self._slopes = coordinates.slopes(q)
        c = np.concatenate([q, self._coefficients])
        self._numbers = Numbers(
            c, np.zeros_like(c), np.zeros(0), np.zeros(0), np.ones(0), np.ones(0)
        )

    def rows(
        self, u: Float[np.ndarray, "N M"]
    ) -> tuple[Float[np.ndarray, "M N ny np+1"], np.ndarray]:
        """Return rows `[∂y/∂p Δ]` without the start's effect; zero where the run runs away.

        The weights of the outputs (M, 1, ny, 1) come with them.
        """
        pieces = [
            self._piece(u[:, first : first + _WIDTH]) for first in range(0, u.shape[1], _WIDTH)
        ]
        rows, deviation = (np.concatenate(part) for part in zip(*pieces, strict=True))
        ny = rows.shape[2]
        return rows, 1 / np.where((deviation > 0) & (ny > 1), deviation, 1.0)[:, None, :, None]

    def _piece(
        self, u: Float[np.ndarray, "N m"]
    ) -> tuple[Float[np.ndarray, "m N ny np+1"], Float[np.ndarray, "m ny"]]:
        (length, count), motion = u.shape, self.motion
        padded = np.concatenate([u, np.repeat(u[:, -1:], _WIDTH - count, axis=1)], axis=1)
        signals = {
            name: np.broadcast_to(np.resize(v, (length, 1)), padded.shape)
            for name, v in self.others.items()
        }
        together = np.stack(
            [{self.channel: padded, **signals}[name] for name in motion.inputs], axis=1
        )
        read = np.stack(
            [
                inputs_at_points(one, motion.hold, self._form.substeps)
                for one in np.moveaxis(together, -1, 0)
            ],
            axis=-1,
        )
        start = np.repeat(self.before[:, None], _WIDTH, axis=1)
        values, slopes = (
            np.asarray(part)[..., :count] for part in _run(self._form, self._numbers, start, read)
        )
        with np.errstate(all="ignore"):
            size, half = np.abs(values), length // 2
            early, late = size[:half].max(axis=0), size[half:].max(axis=0)
            sound = (late <= RUNS_AWAY * np.where(early > 0, early, late)).all(axis=0)
        sound &= np.isfinite(slopes).all(axis=(0, 1, 2)) & np.isfinite(values).all(axis=(0, 1))
        slopes = np.moveaxis(np.where(sound, slopes, 0.0), -1, 0)  # (m, N, ny, nx + np + ns)
        nx, nt = self._form.states, len(self.theta)
        missing = slopes[..., nx + nt :] @ self._coefficients
        rows = np.concatenate(
            [slopes[..., nx : nx + nt] / self._slopes, missing[..., None]], axis=-1
        )
        deviation = np.where(sound, np.where(sound, values, 0.0).std(axis=0), 1.0).T
        return _remove_starts(slopes[..., :nx], rows), deviation


def _remove_starts(start: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return rows (m, N, ny, k) less the effect of unknown starts (m, N, ny, nx)."""
    shape, flat = rows.shape, start.reshape(len(start), -1, start.shape[-1])
    size = np.linalg.norm(flat, axis=1, keepdims=True)
    basis = np.linalg.svd(flat / np.where(size > 0, size, 1.0), full_matrices=False)
    kept = np.where(basis[1] > 1e-10, 1.0, 0.0)[:, None, :]
    q = basis[0] * kept
    own = rows.reshape(len(rows), -1, shape[-1])
    return (own - q @ (np.swapaxes(q, 1, 2) @ own)).reshape(shape)


@partial(jax.jit, static_argnames="form")
def _run(
    form: MotionDynamics,
    numbers: Numbers,
    start: Float[Array, "nx m"],
    inputs: Float[Array, "T nu m"],
) -> tuple[Float[Array, "T ny m"], Float[Array, "T ny n m"]]:
    """Return outputs of every run, and their sensitivities to start and coordinates."""
    numbers = form.prepare(numbers)

    def step(carry: Any, row: Any) -> Any:
        state, slopes = carry
        state, slopes, value, slope = form.tangents(numbers, state, slopes, row)
        return (state, slopes), (value, slope)

    return jax.lax.scan(step, (start, form.first_slopes(start.shape[1])), inputs)[1]


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
