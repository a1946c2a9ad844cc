"""How the points of a motion's own measure follow its unknowns: they are where the fitted run goes.

A split under the training measure depends on the unknowns twice, through the fitted field and through these points.
Intervals that leave the second out cover too little.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import Array, jax, jnp
from orthaug.fitting.segments import Segments
from orthaug.inference.motion_split import rest_of
from orthaug.models.dynamics import Numbers
from orthaug.models.moving import Moving


def wobble(
    form: Moving,
    numbers: Numbers,
    segments: Segments,
    states: Float[np.ndarray, "k n0 m"],
    slope: Float[np.ndarray, "k m n0 n"],
    size: Vector,
    q: Vector,
) -> Matrix:
    """`Σ φ_qx dx/d(c, w)` (np, n) over the scored steps with equal weights that add up to 1.

    Args:
        slope: how the segments' starts follow the unknowns, less its sign.
        size: of each learned equation and output (nl,).
        q: coordinates of the split.
    """
    total = np.zeros((len(q), form.unknowns))
    for start, inputs, _, scored, own in zip(states, *map(np.asarray, segments[1:]), slope, strict=True):
        n0 = start.shape[0]
        found = np.asarray(_summed(form, numbers, start, inputs, scored, q, size))
        of_start = np.moveaxis(found[:, :n0], -1, 0)  # (m, np, n0)
        total += found[:, n0:].sum(axis=-1) - np.einsum("mqi,min->qn", of_start, own)
    return total / segments.count


@partial(jax.jit, static_argnames="form")
def _summed(
    form: Moving,
    numbers: Numbers,
    state: Float[Array, "n0 m"],
    inputs: Float[Array, "T nu m"],
    scored: Any,
    q: Float[Array, "np"],
    size: Float[Array, "nl"],
) -> Float[Array, "np n0+n m"]:
    numbers = form.prepared(numbers)
    c, w = numbers.theta - numbers.theta_aux, numbers.weights

    def mixed(x: Any, row: Any) -> Any:
        def half(q: Any, x: Any) -> Any:
            return jnp.sum(rest_of(form, numbers, q, c, w, x, form.now(row), size) ** 2) / 2

        return jax.jacfwd(jax.grad(half), 1)(q, x)

    def step(carry: Any, row: Any) -> Any:
        state, slopes, total = carry
        inputs, there = row
        turned = jax.vmap(mixed, -1, -1)(state, inputs)
        turned = jnp.where(jnp.isfinite(turned) & there, turned, 0.0)
        total = total + jnp.einsum("qim,inm->qnm", turned, slopes)
        state, slopes, _, _ = form.tangents(numbers, state, slopes, inputs)
        return (state, slopes, total), None

    width, n = state.shape[1], form.states + form.unknowns
    carry = (state, form.first_slopes(width), jnp.zeros((len(q), n, width)))
    return jax.lax.scan(step, carry, (inputs, scored))[0][2]
