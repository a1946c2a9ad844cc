"""Derivatives of a Runge-Kutta sample of a motion, by the adjoint of its stages.

A stage i gives `k_i = F(x_i)` with the slopes A_i = ∂F/∂x, B_i = ∂F/∂c and the learner's gradient G_i = ∂g/∂w. What a
change of k_i does to the state at the end of the substep is Ψ_i, found backwards (Hairer, Nørsett and Wanner 1993,
II.6): Ψ_4 = h/6, Ψ_3 = h/3 + h Ψ_4 A_4, Ψ_2 = h/3 + h/2 Ψ_3 A_3, Ψ_1 = h/6 + h/2 Ψ_2 A_2. Then ∂x⁺/∂x = 1 + Σ Ψ_i A_i
and ∂x⁺/∂w = Σ Ψ_i E G_i: the learner is differentiated once in a stage, however many states there are.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from orthaug._base.jax import jax, jnp
from orthaug.models.dynamics import Numbers
from orthaug.models.integrators import input_at
from orthaug.models.motion_field import MotionField

_FEW = 8  # states and parameters; programs of more are slow to compile


class Slopes(NamedTuple):
    """Of a map from (x, c, w): its value, and ∂/∂x, ∂/∂c, ∂/∂w."""

    value: Any
    to_x: Any
    to_c: Any
    to_w: Any


def sample_slopes(form: MotionField, numbers: Numbers, state: Any, row: Any) -> Slopes:
    """x one sample later, at one state (nx,) and the inputs of one row, under `rk4`."""
    at, halves = input_at(row, len(form.motion.inputs)), 2 * form.substeps
    h, identity = form.sampling_time / form.substeps, jnp.eye(form.states)
    through, x = [], state
    for j in range(form.substeps):
        u = [at(2 * j + i, halves) for i in range(3)]
        first = field_slopes(form, numbers, x, u[0])
        second = field_slopes(form, numbers, x + h / 2 * first.value, u[1])
        third = field_slopes(form, numbers, x + h / 2 * second.value, u[1])
        fourth = field_slopes(form, numbers, x + h * third.value, u[2])
        x = x + h / 6 * (first.value + 2 * (second.value + third.value) + fourth.value)
        psi4 = h / 6 * identity
        psi3 = h / 3 * identity + h * psi4 @ fourth.to_x
        psi2 = h / 3 * identity + h / 2 * psi3 @ third.to_x
        psi1 = h / 6 * identity + h / 2 * psi2 @ second.to_x
        through.append(list(zip((psi1, psi2, psi3, psi4), (first, second, third, fourth), strict=True)))
    to_x, to_c, to_w = identity, 0.0, 0.0
    learned = np.array(form.motion.learned[0], dtype=int)
    for stages in reversed(through):  # `to_x` is what follows this substep
        to_c = to_c + to_x @ sum(psi @ stage.to_c for psi, stage in stages)
        if form.bound is not None:
            to_w = to_w + sum((to_x @ psi)[:, learned] @ stage.to_w for psi, stage in stages)
        to_x = to_x @ (identity + sum(psi @ stage.to_x for psi, stage in stages))
    return Slopes(x, to_x, to_c, to_w)


@partial(jax.jit, static_argnames="form")  # for the stages of all substeps it is traced once
def field_slopes(form: MotionField, numbers: Numbers, x: Any, u: Any) -> Slopes:
    """F at one point; ∂/∂w is that of the learned equations only, (nl, nw)."""
    c = numbers.theta - numbers.theta_aux
    coordinates = form.motion.coordinates

    def physics(x: Any, c: Any) -> Any:
        return form.motion.rates(x, u, coordinates.physical(c, jnp), jnp)

    value, to_x, to_c = _differentiated(physics, x, c)
    to_x, to_c = _finite(to_x), _finite(to_c)
    states, _ = form.motion.learned
    if form.bound is None or not states:
        return Slopes(value, to_x, to_c, jnp.zeros((len(states), form.unknowns - len(c))))
    learner = learner_slopes(form, numbers, x, u)
    rows = np.array(states)
    count = len(states)
    value = value.at[rows].add(learner.value[:count])
    return Slopes(value, to_x.at[rows].add(learner.to_x[:count]), to_c, learner.to_w[:count])


def learner_slopes(form: MotionField, numbers: Numbers, x: Any, u: Any) -> Slopes:
    """g at one point: of learned equations first, then of learned outputs."""
    bound = form.bound
    assert bound is not None

    def features(x: Any) -> Any:
        return (form.seen(x, u) - numbers.centre) / numbers.halfwidth

    z, to_z = features(x), _finite(jax.jacfwd(features)(x))
    value, pull = jax.vjp(lambda leaves, z: bound.from_leaves(leaves, z), bound.leaves(numbers.weights), z)
    gain = jnp.broadcast_to(jnp.asarray(numbers.gain), (bound.ny,))
    pulled = [pull(row) for row in jnp.diag(gain)]
    to_w = jnp.stack([jnp.concatenate([jnp.ravel(leaf) for leaf in leaves]) for leaves, _ in pulled])
    to_x = jnp.stack([of_z @ to_z for _, of_z in pulled])
    return Slopes(gain * value, _finite(to_x), jnp.zeros((bound.ny, 0)), _finite(to_w))


def output_slopes(form: MotionField, numbers: Numbers, x: Any, u: Any) -> Slopes:
    """y at one point."""
    c = numbers.theta - numbers.theta_aux

    def physics(x: Any, c: Any) -> Any:
        return form.motion.observed(x, u, form.motion.coordinates.physical(c, jnp), jnp)

    value, to_x, to_c = _differentiated(physics, x, c)
    to_w = jnp.zeros((len(value), form.unknowns - len(c)))
    states, outputs = form.motion.learned
    if form.bound is not None and outputs:
        learner, rows, count = learner_slopes(form, numbers, x, u), np.array(outputs), len(states)
        value = value.at[rows].add(learner.value[count:])
        to_x = to_x.at[rows].add(learner.to_x[count:])
        to_w = to_w.at[rows].set(learner.to_w[count:])
    return Slopes(value, _finite(to_x), _finite(to_c), to_w)


def _differentiated(function: Any, x: Any, c: Any) -> tuple[Any, Any, Any]:
    """Value and slopes by x and c; of few entries one at a time, which leaves out what an entry does not touch."""
    entries, n0 = [*x, *c], len(x)
    if len(entries) > _FEW:
        return function(x, c), *jax.jacfwd(function, (0, 1))(x, c)

    def along(i: int) -> Any:
        def of(entry: Any) -> Any:
            moved = [*entries[:i], entry, *entries[i + 1 :]]
            return function(jnp.stack(moved[:n0]), jnp.stack(moved[n0:]))

        return jax.jvp(of, (entries[i],), (jnp.ones_like(entries[i]),))[1]

    slopes = [along(i) for i in range(len(entries))]
    return function(x, c), jnp.stack(slopes[:n0], axis=-1), jnp.stack(slopes[n0:], axis=-1)


def _finite(slope: Any) -> Any:
    """A kink without a derivative, such as sqrt(max(x, 0)) at 0, counts as flat."""
    return jnp.where(jnp.isfinite(slope), slope, 0.0)
