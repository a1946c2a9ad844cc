"""What physics and learner add to the learned equations and outputs of a fitted motion."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix
from orthaug._base.jax import Array, jax, jnp
from orthaug.models.dynamics import Numbers
from orthaug.models.moving import Moving


def parts_at(form: Moving, numbers: Numbers, x: Matrix, u: Matrix) -> tuple[Matrix, Matrix]:
    """Physics f(x, u; p̂) and what is learned beside it, each (M, nl): learned equations, then learned outputs.

    Args:
        x: states (M, nx); `u` inputs (M, nu) at the same instants.
    """
    physics, learner = _parts(form, numbers, x, u)
    return np.asarray(physics), np.asarray(learner)


def labels_of(form: Moving) -> tuple[tuple[str, str], ...]:
    """Name and unit of each learned equation and output: `v` in m/s has a rate in m/s²."""
    motion = form.motion
    states, outputs = motion.learned
    rates = []
    for i in states:
        state = motion.states[i]
        following = motion.integrator == "discrete"
        unit = state.unit if following else _rate(state.unit)
        rates.append((f"next {state.name}" if following else f"d{state.name}/dt", unit))
    return (*rates, *((motion.outputs[i].name, "") for i in outputs))


def _rate(unit: str) -> str:
    return unit and (f"{unit}²" if unit.endswith("/s") else f"{unit}/s")


@partial(jax.jit, static_argnames="form")
def _parts(
    form: Moving, numbers: Numbers, x: Float[Array, "m nx"], u: Float[Array, "m nu"]
) -> tuple[Float[Array, "m nl"], Float[Array, "m nl"]]:
    states, outputs = (np.array(learned, dtype=int) for learned in form.motion.learned)

    def physics(q: Any, x: Any, u: Any) -> Any:
        p = form.motion.coordinates.physical(q, jnp)
        rates, observed = form.motion.rates(x, u, p, jnp), form.motion.observed(x, u, p, jnp)
        return jnp.concatenate([rates[states], observed[outputs]])

    def at(x: Any, u: Any) -> tuple[Any, Any]:
        split = physics(numbers.theta, x, u)
        whole = physics(numbers.theta - numbers.theta_aux, x, u)
        return split, whole - split + (form.learned(numbers, x, u) if form.bound is not None else 0.0)

    return jax.vmap(at)(x, u)
