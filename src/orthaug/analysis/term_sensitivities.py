"""Slopes of a motion's free run by its starts, its unknowns, and terms added to its equations.

A term that is added to an equation at weight 0 moves the run as a force there does: its effect is
propagated along the run by the slopes of the state, beside those of all that was estimated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import AnyArray, Array, padded_length, quick_jit
from orthaug.data.expressions import parse_named
from orthaug.fitting.motion_estimate import MotionEstimate
from orthaug.models.dynamics import Numbers
from orthaug.models.moving import MotionDynamics
from orthaug.physics.motion import Motion
from orthaug.physics.shared_forces import shared_forces, with_input

_ROWS = 20_000  # that are looked at, in segments spread over the record
_STEP = 1e-4  # of an input's largest value, for its slopes
_NUMBERS = 8_000_000  # that are in memory at most

Terms = Callable[[Float[np.ndarray, "n r"]], Float[np.ndarray, "t r"]]
"""Makes terms of states and inputs."""


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """Errors of m segments, and their slopes by starts, unknowns and added terms, in this order.

    `columns` (m, T, ny, n0 + n + q), `errors` (m, T, ny), `scored` (m, T); q counts equations times
    terms, those of the first equation in front. `points` (n, M) are the states and inputs that were
    scored.
    """

    columns: Float[np.ndarray, "m T ny K"]
    errors: Float[np.ndarray, "m T ny"]
    scored: Bool[np.ndarray, "m T"]
    points: Matrix
    starts: int
    nuisance: int
    """n0, and n0 + n."""

    def with_terms(self, kept: Bool[np.ndarray, "q"]) -> Sensitivities:
        """Return the same with some of the added terms."""
        every = np.concatenate([np.ones(self.nuisance, dtype=bool), kept])
        return replace(self, columns=self.columns[..., every])


@partial(quick_jit, static_argnames="form")
def _slopes(
    form: MotionDynamics,
    numbers: Numbers,
    states: Float[Array, "n0 m"],
    inputs: Float[Array, "nu m"],
) -> Any:
    """Return ∂x⁺/∂(x, c, w), the outputs, and ∂y/∂(x, c, w) at every point."""
    numbers = form.prepare(numbers)
    return form.tangents(numbers, states, form.first_slopes(states.shape[1]), inputs)[1:]


def sensitivities(
    fit: MotionEstimate, equations: Sequence[int], terms: Callable[[Matrix], Terms], count: int
) -> Sensitivities | None:
    """Return the sensitivities along the training segments; None where a value is not finite.

    Args:
        equations: what the terms are added to, counted as by `acting_slopes`.
        terms: makes the terms, given the points (n, M) of the runs.
        count: of terms.
    """
    segmented, numbers = fit.segmented, fit.model.numbers.unsplit
    form = segmented.dynamics
    # (k, m, T, n0)
    runs = np.moveaxis(segmented.runs(numbers.theta, numbers.weights, fit.states), -1, 1)
    measured = segmented.segments._replace(scored=segmented.segments.complete)
    segments = [np.moveaxis(np.asarray(part), -1, 1) for part in measured[1:]]
    k, m = runs.shape[:2]
    x, u, target, scored = (part.reshape(k * m, *part.shape[2:]) for part in (runs, *segments))
    n0, n, q = form.states, form.unknowns, count * len(equations)
    steps = min(x.shape[1], max(_NUMBERS // (target.shape[2] * (n0 + n + q)), 1))
    there = np.flatnonzero(scored[:, :steps].any(axis=1))
    most = max(min(_ROWS, _NUMBERS // (target.shape[2] * (n0 + n + q))) // steps, 1)
    taken = there[np.unique(np.linspace(0, len(there) - 1, min(most, len(there))).astype(int))]
    x, u, target, scored = (part[taken, :steps] for part in (x, u, target, scored))
    at = x.shape[0] * x.shape[1]
    read = form.at_samples(numbers, *(part.reshape(at, part.shape[2]) for part in (x, u)))
    rows = np.concatenate([x, read.reshape(*x.shape[:2], read.shape[1])], axis=2)
    points = rows[scored].T
    if not np.isfinite(points).all():
        return None
    to_next, value, to_output = _at_rows(form, numbers, x, u)
    with np.errstate(all="ignore"):
        of_rows = terms(points)
        ends = _ends(rows, n0, form.motion.hold)
        added, at_ends = (
            of_rows(one.reshape(-1, rows.shape[2]).T).reshape(count, *scored.shape)
            for one in (rows, ends)
        )
        p = form.motion.coordinates.physical(np.asarray(numbers.c))
        acting = [
            tuple(acting_slopes(form.motion, one, p, i) for one in (rows, ends)) for i in equations
        ]
        pace = 1.0 if segmented.record.even else form.split_pace(u)[1]
        halves = np.broadcast_to(form.sampling_time / 2 * pace, u.shape[:2])
        columns = _propagate(to_next, to_output, added, at_ends, acting, halves, form)
    kept = np.isfinite(columns).all(axis=(2, 3)) & np.isfinite(value).all(axis=2)
    if not kept[scored].all():
        return None
    return Sensitivities(columns, target - value, scored, points, n0, n0 + n)


def acting_slopes(motion: Motion, rows: Matrix, p: Vector, number: int) -> Matrix:
    """Return ∂(f, h) (…, nx + ny) by what is added somewhere, at states and inputs (…, nx + nu).

    Args:
        number: of the equation of a state, behind these of an output, then of an input, and last
            of a force that equations share.
    """
    nx, ny = len(motion.states), len(motion.outputs)
    flat = rows.reshape(-1, rows.shape[-1])
    if number < nx + ny:
        found = np.zeros((len(flat), nx + ny))
        if number < nx:
            found[:, :nx] = motion.mass.entries(flat[:, :nx], p)[..., number]
        else:
            found[:, number] = 1.0
        return found.reshape(*rows.shape[:-1], nx + ny)
    at = number - ny
    if at < flat.shape[1]:
        size = np.abs(flat[:, at])
    else:
        force = shared_forces(motion)[at - flat.shape[1]]
        known = parse_named(str(force), motion.known, str(force))
        size = np.abs(known.value(motion.values(flat[:, :nx].T, flat[:, nx:].T, p, np), np))
        motion, at = with_input(motion, force), flat.shape[1]
        flat = np.append(flat, np.zeros((len(flat), 1)), axis=1)
    step = _STEP * max(float(size.max(initial=0.0)), 1e-12)
    moved = np.zeros(flat.shape[1])
    moved[at] = step
    there, back = (
        np.concatenate(
            [
                np.asarray(motion.rates(one[:nx], one[nx:], p, np)),
                np.asarray(motion.observed(one[:nx], one[nx:], p, np)),
            ]
        )
        for one in ((flat + moved).T, (flat - moved).T)
    )
    return ((there - back) / (2 * step)).T.reshape(*rows.shape[:-1], nx + ny)


def _ends(rows: Matrix, n0: int, hold: str) -> Matrix:
    """Return states and inputs (m, T, n) at the end of every sample.

    An input that is held keeps its value until there, and jumps then.
    """
    ends = np.concatenate([rows[:, 1:], rows[:, -1:]], axis=1)
    if hold == "zero-order":
        ends = np.concatenate([ends[..., :n0], rows[..., n0:]], axis=2)
    return ends


def _at_rows(
    form: MotionDynamics, numbers: Numbers, x: AnyArray, u: AnyArray
) -> tuple[Any, Any, Any]:
    """Return slopes (m, T, n0, n0 + n), outputs (m, T, ny) and their slopes at every row.

    Slopes of outputs are (m, T, ny, n0 + n).
    """
    m, steps = x.shape[:2]
    flat = [part.reshape(m * steps, -1).T for part in (x, u)]
    length = padded_length(m * steps)
    padded = [
        np.concatenate([part, np.repeat(part[:, -1:], length - m * steps, axis=1)], axis=1)
        for part in flat
    ]
    found = [
        np.moveaxis(np.asarray(part)[..., : m * steps], -1, 0)
        for part in _slopes(form, numbers, *padded)
    ]
    return tuple(part.reshape(m, steps, *part.shape[1:]) for part in found)  # type: ignore[return-value]


def _propagate(
    to_next: np.ndarray,
    to_output: np.ndarray,
    added: np.ndarray,
    at_ends: np.ndarray,
    acting: Sequence[tuple[Matrix, ...]],
    halves: Matrix,
    form: MotionDynamics,
) -> Any:
    """Return the columns (m, T, ny, n0 + n + q) of the outputs, from one row to the next.

    The terms act by the trapezoidal rule: `added` at the begin of a sample, `at_ends` at its end.

    Args:
        acting: ∂(ẋ, y) (m, T, n0 + ny) by a term there, at begin and end of every sample.
        halves: of the seconds (m, T) that each step takes.
    """
    m, steps, n0, own = to_next.shape
    q = len(added)
    columns = np.zeros((m, steps, to_output.shape[2], own + q * len(acting)))
    slope = np.zeros((m, n0, columns.shape[3]))
    slope[:, :, :n0] = np.eye(n0)
    for k in range(steps):
        a, c = to_next[:, k, :, :n0], to_output[:, k, :, :n0]
        columns[:, k] = c @ slope
        columns[:, k, :, n0:own] += to_output[:, k, :, n0:]
        slope = a @ slope
        slope[:, :, n0:own] += to_next[:, k, :, n0:]
        now, then = added[:, :, k].T, at_ends[:, :, k].T  # (m, q)
        half = halves[:, k, None, None]
        for place, by in enumerate(acting):
            to = slice(own + place * q, own + (place + 1) * q)
            columns[:, k, :, to] += by[0][:, k, n0:, None] * now[:, None]
            begin, end = (one[:, k, :n0, None] for one in by)  # (m, n0, 1)
            if form.motion.scheme.discrete:
                slope[:, :, to] += begin * now[:, None]
                continue
            slope[:, :, to] += half * (a @ begin) * now[:, None]
            slope[:, :, to] += half * end * then[:, None]
    return columns
