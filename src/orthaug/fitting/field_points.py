"""The points of a measure along the fitted motion, and how these move with its unknowns."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector, positive
from orthaug._base.errors import InputError, Warning
from orthaug._base.jax import AnyArray, Array, jax, jnp, quick_jit
from orthaug.fitting.segments import (
    Segments,
    cut_steps,
    flatten_steps,
    slopes_per_number,
    steps_at_once,
)
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
        p = motion.coordinates.physical(c)
        rates = np.asarray(motion.mass.balance(motion.rates(x.T, u.T, p, np), x.T, p), dtype=float)
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
        to_start, to_unknowns = _sum_over(form, numbers, start, inputs, scored, q, size)
        total += np.asarray(to_unknowns) - np.einsum("qim,min->qn", np.asarray(to_start), own)
    return total / segments.count


@partial(quick_jit, work=slopes_per_number, static_argnames="form")
def _sum_over(
    form: MotionDynamics,
    numbers: Numbers,
    state: Float[Array, "n0 m"],
    inputs: Float[Array, "T nu m"],
    scored: Array,
    q: Float[Array, "np"],
    size: Float[Array, "nl"],
) -> tuple[Float[Array, "np n0 m"], Float[Array, "np n"]]:
    """Return `Σ φ_qx dx/d(start)` of each segment, and `Σ φ_qx dx/d(c, w)` of all.

    The rows φ_qx go back through the steps, because they are fewer than the unknowns.
    """
    numbers = form.prepare(numbers)
    c, w, n0, width = numbers.c, numbers.weights, *state.shape

    def mixed_derivative(x: AnyArray, row: Any) -> Array:
        def half(q: Array, x: Array) -> Any:
            u = form.inputs_at(numbers, x, row)
            return jnp.sum(rest_of(form, numbers, q, c, w, x, u, size) ** 2) / 2

        return jax.jacfwd(jax.grad(half), 1)(q, x)

    def back(adjoint: Array, row: tuple[Array, ...]) -> tuple[Array, Array]:
        turned, to_state, own = row
        through = jnp.einsum("qim,ijm->qjm", adjoint, to_state)
        return turned + through, jnp.einsum("qim,inm->qn", adjoint, own)

    def block(carry: tuple[Array, Array], rows: tuple[Array, ...]) -> tuple[Any, None]:
        adjoint, total = carry
        states, inputs, there = rows
        x, u = flatten_steps(states), flatten_steps(inputs)
        turned = jax.vmap(mixed_derivative, -1, -1)(x, u)
        turned = jnp.where(jnp.isfinite(turned) & there.reshape(-1), turned, 0.0)
        _, to_state, own = form.local(numbers, x, u)
        by_step = tuple(
            jnp.moveaxis(part.reshape(*part.shape[:-1], len(states), width), -2, 0)
            for part in (turned, to_state[:n0], own[:n0])
        )
        adjoint, own = jax.lax.scan(back, adjoint, by_step, reverse=True)
        return (adjoint, total + own.sum(axis=0)), None

    step = jax.vmap(lambda state, row: form.step(numbers, state, row)[0], -1, -1)
    _, states = jax.lax.scan(lambda x, row: (step(x, row), x), state, inputs)
    nothing = (jnp.zeros((len(q), n0, width)), jnp.zeros((len(q), form.unknowns)))
    most = max(steps_at_once(form, width), 1)
    rows = (*cut_steps((states, inputs), most, "edge"), *cut_steps((scored,), most))
    return jax.lax.scan(block, nothing, rows, reverse=True)[0]
