"""The points of a measure along the fitted motion, and how these move with its unknowns."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector, positive
from orthaug._base.errors import InputError, Warning
from orthaug._base.jax import AnyArray, Array, jax, jnp, quick_jit
from orthaug.fitting.segments import Segments
from orthaug.inference.measures import Measure, Support
from orthaug.inference.splitting import Field, beyond_data, rest_of
from orthaug.models.dynamics import Numbers
from orthaug.models.moving import MotionDynamics

if TYPE_CHECKING:
    from orthaug.fitting.segmented_motion import SegmentedMotion


def field_under(
    measure: Measure, segmented: SegmentedMotion, numbers: Numbers, states: np.ndarray
) -> tuple[Field, float, tuple[Warning, ...]]:
    """Return the points of a measure, its support by the data, and warnings.

    With the sizes of the learned equations.

    Raises:
        InputError: a measure that does not fit the motion, or points at which the motion has no
            value.
    """
    motion, form = segmented.problem.motion, segmented.dynamics
    c, w = np.asarray(numbers.c), numbers.weights
    x, u = segmented.trajectory(c, w, states)
    finite = np.isfinite(x).all(axis=1)
    x, u = x[finite], u[finite]
    nx = x.shape[1]
    support = Support.of_motion(motion, x, u)
    points = measure.points(support)
    at, beside = points.x[:, :nx], points.x[:, nx:]
    size = sizes_learned(segmented, c, x, u)
    found = np.asarray(
        motion.rates(at.T, beside.T, motion.coordinates.physical(c), np), dtype=float
    )
    if not np.isfinite(found).any():
        raise InputError(f"the motion has no value on the {measure.name} measure; narrow it.")
    finite = np.isfinite(found).all(axis=0)
    weight = np.where(finite, points.weight, 0.0)
    share = support.share(points)
    warnings = beyond_data(measure, share) if form.learns else ()
    return Field(at[finite], beside[finite], weight[finite] / weight.sum(), size), share, warnings


def sizes_learned(segmented: SegmentedMotion, c: Vector, x: Matrix, u: Matrix) -> Vector:
    """Return the size (nl,) of each learned equation and output over the runs."""
    motion = segmented.problem.motion
    with np.errstate(all="ignore"):
        rates = np.asarray(motion.rates(x.T, u.T, motion.coordinates.physical(c), np), dtype=float)
    if motion.scheme.discrete:
        rates = rates - x.T
    states, outputs = motion.learned
    size = np.concatenate(
        [np.nanstd(rates[list(states)], axis=1), segmented.deviation[list(outputs)]]
    )
    return positive(size)


def wobble(
    form: MotionDynamics,
    numbers: Numbers,
    segments: Segments,
    states: Float[np.ndarray, "k n0 m"],
    slope: Float[np.ndarray, "k m n0 n"],
    size: Vector,
    q: Vector,
) -> Matrix:
    """Return the derivative of the points of a motion's own measure by its unknowns.

    These points are states of the fitted run.

    A split under the training measure depends on the unknowns twice, through the fitted field and
    through these points. Intervals that leave the second out cover too little. `Σ φ_qx dx/d(c, w)`
    (np, n) is over the scored steps with equal weights that add up to 1.

    Args:
        slope: how the segments' starts follow the unknowns, less its sign.
        size: of each learned equation and output (nl,).
        q: coordinates of the split.
    """
    total = np.zeros((len(q), form.unknowns))
    for start, inputs, _, scored, own in zip(
        states, *map(np.asarray, segments[1:]), slope, strict=True
    ):
        n0 = start.shape[0]
        found = np.asarray(_sum_over(form, numbers, start, inputs, scored, q, size))
        of_start = np.moveaxis(found[:, :n0], -1, 0)  # (m, np, n0)
        total += found[:, n0:].sum(axis=-1) - np.einsum("mqi,min->qn", of_start, own)
    return total / segments.count


@partial(quick_jit, static_argnames="form")
def _sum_over(
    form: MotionDynamics,
    numbers: Numbers,
    state: Float[Array, "n0 m"],
    inputs: Float[Array, "T nu m"],
    scored: Array,
    q: Float[Array, "np"],
    size: Float[Array, "nl"],
) -> Float[Array, "np n0+n m"]:
    numbers = form.prepare(numbers)
    c, w = numbers.c, numbers.weights

    def mixed_derivative(x: AnyArray, row: Any) -> Array:
        def half(q: Array, x: Array) -> Any:
            u = form.inputs_at(numbers, x, row)
            return jnp.sum(rest_of(form, numbers, q, c, w, x, u, size) ** 2) / 2

        return jax.jacfwd(jax.grad(half), 1)(q, x)

    def step(carry: Any, row: Any) -> Any:
        state, slopes, total = carry
        inputs, there = row
        turned = jax.vmap(mixed_derivative, -1, -1)(state, inputs)
        turned = jnp.where(jnp.isfinite(turned) & there, turned, 0.0)
        total = total + jnp.einsum("qim,inm->qnm", turned, slopes)
        state, slopes, _, _ = form.tangents(numbers, state, slopes, inputs)
        return (state, slopes, total), None

    width, n = state.shape[1], form.states + form.unknowns
    carry = (state, form.first_slopes(width), jnp.zeros((len(q), n, width)))
    return jax.lax.scan(step, carry, (inputs, scored))[0][2]
