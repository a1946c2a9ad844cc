"""A function of JAX as a program of scalars: the same numbers, the same slopes, fewer operations."""

from __future__ import annotations

import numpy as np
import pytest

import orthaug as oa
from orthaug._base.jax import jax, jnp
from orthaug.physics.mechanisms import Inertia, Rates
from orthaug.physics.scalar_program import scalar_program

A = np.array([[4.0, 1.0, 0.5], [1.0, 3.0, 0.2], [0.5, 0.2, 2.0]])


def loop(x):
    return jax.lax.while_loop(
        lambda pair: pair[0] < 3, lambda pair: (pair[0] + 1, pair[1] * x), (0, x)
    )[1]


@jax.custom_jvp
def own_slope(x):
    return x * x


own_slope.defjvp(lambda x, dx: (own_slope(x[0]), 7.0 * dx[0]))

FUNCTIONS = {
    "arithmetic": lambda x: (x * 2 - 3) / (1 + x**2) + jnp.maximum(x, 0.3) - jnp.minimum(x, -0.2),
    "functions": lambda x: jnp.sin(x) * jnp.exp(-x) + jnp.sqrt(jnp.abs(x) + 1) + jnp.arctan2(x, 2.0),
    "powers": lambda x: x**3 + (x + 3) ** -2 + jax.lax.rsqrt(x + 3) + jnp.abs(x) ** 1.5,
    "conditions": lambda x: jnp.where((x > 0.1) & ~(x > 0.6), x, -2 * x) + (x > 0).astype(float),
    "numbers of conditions": lambda x: jnp.where(x.astype(bool), x, 5.0),
    "pieces": lambda x: jnp.concatenate([x[::2], x[::-1], jnp.tile(x[:1], 2), jnp.stack([x, x])[1]]),
    "gather": lambda x: jnp.outer(x, x)[jnp.array([2, 0]), jnp.array([1, 1])],
    "gather of rows": lambda x: jnp.outer(x, x)[jnp.array([2, 0, -1])],
    "a place outside": lambda x: x.at[jnp.array([7])].get(mode="fill", fill_value=2.5) + x[:1],
    "scatter": lambda x: jnp.zeros((3, 2)).at[jnp.array([2, 0]), 1].set(x[:2]).at[1].set(x[1:]),
    "scatter that adds": lambda x: jnp.zeros(4).at[jnp.array([1, 1, 3])].add(x),
    "scatter outside": lambda x: x.at[jnp.array([1, 9])].set(x[:2] * 4),
    "moving pieces": lambda x: jax.lax.dynamic_update_slice(x, jax.lax.dynamic_slice(x, (1,), (2,)), (0,)),
    "sums": lambda x: jnp.outer(x, x).sum(0) + jnp.cumsum(x) + jnp.cumsum(x[::-1], 0)[::-1],
    "products": lambda x: jnp.einsum("bij,bjk->bik", jnp.stack([A * x, A]), jnp.stack([A, A + x])),
    "solving": lambda x: jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(A + jnp.diag(x)), x),
    "solving from the right": lambda x: jax.lax.linalg.triangular_solve(
        jnp.linalg.cholesky(A + jnp.diag(x)), jnp.outer(x, x), lower=True, transpose_a=True
    ),
    "a linear system": lambda x: jnp.linalg.solve(A * (1 + x), jnp.sin(x)),
    "two linear systems": lambda x: jnp.linalg.solve(A, jnp.outer(x, x)),
    "a known branch": lambda x: jax.lax.cond(jnp.array(True), jnp.sin, jnp.cos, x),
    "a branch by the input": lambda x: jax.lax.cond(x[0] > 0, jnp.sin, jnp.cos, x),
    "a loop": loop,
    "slopes of one's own": own_slope,
    "no slope": lambda x: x * jax.lax.stop_gradient(x),
    "whole numbers": lambda x: x[jnp.argsort(x)],
    "a constant": lambda x: jnp.arange(3.0),
    "several": lambda x: (x, x.sum()),
}  # fmt: skip


@pytest.mark.parametrize("name", FUNCTIONS)
def test_numbers_and_slopes_are_those_of_the_function(name):
    function = FUNCTIONS[name]
    program = scalar_program(function, (3,))
    for seed in range(3):
        x = jnp.asarray(np.random.default_rng(seed).normal(size=3))
        for one, other in zip(
            jax.tree.leaves((program(x), jax.jacfwd(program)(x))),
            jax.tree.leaves((function(x), jax.jacfwd(function)(x))),
            strict=True,
        ):
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


def test_a_batch_of_points_goes_through_at_once():
    program = scalar_program(lambda x, p: p[0] * loop(x) + p[1], (3,), (2,))
    x = jnp.asarray(np.random.default_rng(0).normal(size=(5, 3)))
    p = jnp.array([2.0, 0.5])
    together = jax.vmap(program, (0, None))(x, p)
    np.testing.assert_allclose(together, [program(row, p) for row in x], rtol=1e-14)


def test_what_is_constant_or_zero_or_made_twice_is_gone():
    turn = np.eye(3)
    program = scalar_program(
        lambda x: turn @ (turn @ x) + 0 * jnp.sin(x) + (jnp.cos(x) - jnp.cos(x)), (3,)
    )
    assert len(program) == 0
    twice = scalar_program(lambda x: jnp.sin(x[0]) * jnp.sin(x[0]) + 1 * jnp.sin(x[0]), (3,))
    assert [each.name for each in twice.operations] == ["input", "sin", "mul", "add"]


def test_without_slopes_more_is_taken_apart():
    def function(x):
        return own_slope(x) + jax.lax.stop_gradient(x) + jnp.linalg.solve(A, x)

    program = scalar_program(function, (3,), slopes=False)
    x = jnp.array([0.2, -1.0, 0.7])
    np.testing.assert_allclose(program(x), function(x), rtol=1e-13)
    assert "call" not in {each.name for each in program.operations}
    assert "call" in {each.name for each in scalar_program(function, (3,)).operations}


CART = """<mujoco><option><flag contact="disable"/></option><worldbody>
<body name="cart"><joint name="slider" type="slide" axis="1 0 0" damping="0.3" {friction}/>
<geom type="box" size=".1 .1 .1" mass="1"/>
<body name="pole"><joint name="hinge" type="hinge" axis="0 -1 0" armature="0.01"/>
<inertial pos="0 0 -0.5" mass="0.4" diaginertia="0.03 0.03 0.001"/></body></body>
</worldbody><actuator><motor name="push" joint="slider" gear="2"/></actuator></mujoco>"""


@pytest.mark.parametrize("friction", ["", 'frictionloss="0.2"'])
def test_a_mechanism_has_the_numbers_of_mjx(tmp_path, friction):
    file = tmp_path / "cart.xml"
    file.write_text(CART.format(friction=friction))
    mechanism = oa.MuJoCo(file=str(file), parameters=("pole.mass",)).mechanism
    places = (mechanism.places["pole.mass"], mechanism.places["slider.damping"])
    rates, mass = Rates(mechanism, places, (0,)), Inertia(mechanism, places)
    x, u, p = jnp.array([0.3, 0.7, -0.4, 1.1]), jnp.array([0.6]), jnp.array([0.5, 0.2])
    given, asked = jax.jacfwd(rates.by_mjx, (0, 1, 2)), jax.jacfwd(rates.at, (0, 1, 2))
    np.testing.assert_allclose(rates.at(x, u, p), rates.by_mjx(x, u, p), rtol=1e-9)
    for one, other in zip(asked(x, u, p), given(x, u, p), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(mass(x, p), mass.by_mjx(x, p), rtol=1e-12)
    if not friction:
        assert 50 < rates.operations < 200  # of 4,062 on arrays
