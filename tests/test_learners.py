"""Learners: shapes, initial weights, derivatives, and what is refused."""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from orthaug import MLP, EquinoxModule, External, Function, InputError
from orthaug.models.learners import ACTIVATIONS, Bound

KEY = jax.random.key(7)


def cubic(w, z):
    return w["a"] @ jnp.stack([z[0] ** 2, z[0] ** 3]) + w["b"]


CUBIC = Function(cubic, lambda key: {"a": jnp.ones((1, 2)), "b": 0.5})


class Wave(eqx.Module):
    """A module with weights, a whole-number buffer and something that is no array."""

    amplitude: jax.Array
    order: jax.Array
    function: object

    def __init__(self, key):
        self.amplitude = jax.random.normal(key, (2, 3))
        self.order = jnp.arange(1, 4)
        self.function = jnp.sin

    def __call__(self, z):
        return self.amplitude @ self.function(self.order * z[0])


def rows(learner_nz: int, ny: int, count: int = 11):
    """Features (nz, m) and gains (ny, ny, m) with the batch last."""
    rng = np.random.default_rng(2)
    return jnp.asarray(rng.uniform(-1, 1, (learner_nz, count))), jnp.asarray(
        rng.uniform(0.5, 2, (ny, ny, count))
    )


@pytest.mark.parametrize(
    ("hidden", "nz", "ny", "size"),
    [((), 3, 2, 8), ((5,), 2, 1, 21), ((4, 3), 2, 2, 12 + 15 + 8), ((16,), 1, 1, 49)],
)
def test_mlp_shapes(hidden, nz, ny, size):
    bound = Bound(MLP(hidden=hidden), nz, ny)
    w = bound.init(KEY)
    assert bound.size == size and w.shape == (size,) and w.dtype == float
    assert bound.values(w, jnp.ones(nz)).shape == (ny,)
    sizes = (nz, *hidden, ny)
    expected = [
        s for i in range(len(sizes) - 1) for s in ((sizes[i + 1], sizes[i]), (sizes[i + 1],))
    ]
    assert [leaf.shape for leaf in bound.leaves(w)] == expected
    np.testing.assert_array_equal(bound.ravel(bound.leaves(w)), w)


@pytest.mark.parametrize(
    ("activation", "gain"), [("tanh", 5 / 3), ("relu", math.sqrt(2)), ("gelu", 1.0)]
)
def test_xavier(activation, gain):
    weight1, bias1, weight2, bias2 = jax.tree.leaves(
        MLP(hidden=(200,), activation=activation).init(KEY, 10, 3)
    )
    for weight, fan, factor in ((weight1, 210, gain), (weight2, 203, 1.0)):
        a = factor * math.sqrt(6 / fan)
        assert 0.98 * a < np.abs(weight).max() <= a
        np.testing.assert_allclose(np.mean(weight**2), a**2 / 3, rtol=0.1)
    assert not bias1.any() and not bias2.any()


def test_initial_weights_follow_the_key():
    bound = Bound(MLP(), 2, 1)
    np.testing.assert_array_equal(bound.init(KEY), bound.init(jax.random.key(7)))
    assert not np.array_equal(bound.init(KEY), bound.init(jax.random.key(8)))


FORMULAS = {
    "tanh": np.tanh,
    "relu": lambda a: np.maximum(a, 0),
    "gelu": lambda a: a / 2 * (1 + np.tanh(math.sqrt(2 / math.pi) * (a + 0.044715 * a**3))),
    "sigmoid": lambda a: 1 / (1 + np.exp(-a)),
    "silu": lambda a: a / (1 + np.exp(-a)),
    "elu": lambda a: np.where(a > 0, a, np.exp(a) - 1),
    "softplus": lambda a: np.log(1 + np.exp(a)),
    "identity": lambda a: a,
}


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_mlp_is_its_formula(activation):
    bound = Bound(MLP(hidden=(4, 3), activation=activation), 2, 2)
    w1, b1, w2, b2, w3, b3 = leaves = [
        np.asarray(leaf) + 0.1 for leaf in bound.leaves(bound.init(KEY))
    ]
    z, f = np.array([0.3, -0.8]), FORMULAS[activation]
    expected = w3 @ f(w2 @ f(w1 @ z + b1) + b2) + b3
    np.testing.assert_allclose(bound.from_leaves(leaves, jnp.asarray(z)), expected, rtol=1e-13)


LEARNERS = [
    (MLP(hidden=(4,)), 3, 1),
    (MLP(hidden=(4, 3), activation="gelu"), 3, 2),
    (MLP(hidden=()), 2, 2),
    (CUBIC, 1, 1),
    (EquinoxModule(lambda key: eqx.nn.MLP(2, 2, 4, 1, key=key)), 2, 2),
]


@pytest.mark.parametrize(
    ("learner", "nz", "ny"), LEARNERS, ids=["mlp", "deep", "linear", "function", "equinox"]
)
def test_jacobian_is_the_derivative_of_the_values(learner, nz, ny):
    bound = Bound(learner, nz, ny)
    w = bound.init(KEY) + 0.1
    z, gain = rows(nz, ny)
    values, jacobian = jax.jit(bound.jacobian)(w, z, gain)

    @jax.jit
    def scaled(w):
        values = jax.vmap(lambda row: bound.values(w, row), in_axes=1, out_axes=1)(z)
        return jnp.einsum("oim,im->om", gain, values)

    slope = jax.jit(jax.jacrev(scaled))(w)
    assert values.shape == (ny, 11) and jacobian.shape == (bound.size, ny, 11)
    np.testing.assert_allclose(values, scaled(w), rtol=1e-13)
    np.testing.assert_allclose(jacobian, np.moveaxis(slope, -1, 0), rtol=1e-12, atol=1e-14)


def test_function():
    bound = Bound(CUBIC, 1, 1)
    assert bound.size == 3
    np.testing.assert_array_equal(bound.init(KEY), [1.0, 1.0, 0.5])
    np.testing.assert_allclose(bound.values(bound.init(KEY), jnp.array([2.0])), [4.0 + 8.0 + 0.5])


def test_equinox_module():
    learner = EquinoxModule(lambda key: eqx.nn.MLP(2, 1, 4, 1, activation=jnp.tanh, key=key))
    bound = Bound(learner, 2, 1)
    assert bound.size == 2 * 4 + 4 + 4 + 1
    z = jnp.array([0.3, -0.4])
    np.testing.assert_allclose(bound.values(bound.init(KEY), z), learner.build(KEY)(z), rtol=1e-14)
    assert not np.array_equal(bound.init(KEY), bound.init(jax.random.key(8)))


def test_equinox_module_with_a_buffer():
    bound = Bound(EquinoxModule(Wave), 1, 2)
    w, z = bound.init(KEY), jnp.array([0.3])
    assert bound.size == 6
    np.testing.assert_allclose(bound.values(w, z), Wave(KEY)(z), rtol=1e-14)
    np.testing.assert_allclose(jax.jit(bound.values)(w, z), Wave(KEY)(z), rtol=1e-14)


def product(x):
    """A model from elsewhere: NumPy rows in, NumPy rows out."""
    assert isinstance(x, np.ndarray) and x.ndim == 2
    return np.stack([x[:, 0] * x[:, 1], x[:, 0] - x[:, 1]], axis=1)


def test_external_values():
    bound = Bound(External(product, ny=2), 2, 2)
    w = bound.init(KEY)
    assert bound.size == 0 and w.shape == (0,)
    z = jnp.asarray(np.random.default_rng(0).normal(size=(4, 5, 2)))
    expected = jnp.stack([z[..., 0] * z[..., 1], z[..., 0] - z[..., 1]], axis=-1)
    one = lambda row: bound.values(w, row)  # noqa: E731
    np.testing.assert_array_equal(one(z[0, 0]), expected[0, 0])
    np.testing.assert_array_equal(jax.jit(one)(z[0, 0]), expected[0, 0])
    np.testing.assert_array_equal(jax.vmap(one)(z[0]), expected[0])
    np.testing.assert_array_equal(jax.jit(jax.vmap(jax.vmap(one)))(z), expected)


def test_external_of_one_output_may_return_a_vector():
    bound = Bound(External(lambda x: x[:, 0] ** 2), 2, 1)
    found = jax.vmap(lambda row: bound.values(jnp.zeros(0), row))(
        jnp.array([[2.0, 0.0], [3.0, 0.0]])
    )
    np.testing.assert_array_equal(found, [[4.0], [9.0]])


def test_external_has_an_empty_jacobian():
    bound = Bound(External(product, ny=2), 2, 2)
    z, gain = rows(2, 2)
    values, jacobian = bound.jacobian(jnp.zeros(0), z, gain)
    np.testing.assert_allclose(
        values, np.einsum("oim,im->om", gain, product(np.asarray(z).T).T), rtol=1e-13
    )
    assert jacobian.shape == (0, 2, 11)


@pytest.mark.filterwarnings("ignore")
def test_external_of_the_wrong_shape():
    bound = Bound(External(product, ny=1), 2, 1)
    with pytest.raises(Exception, match=r"returned shape \(1, 2\).*expected \(1, 1\)"):
        jax.block_until_ready(bound.values(jnp.zeros(0), jnp.ones(2)))


@pytest.mark.parametrize(
    ("learner", "message"),
    [
        (
            Function(lambda w, z: w @ z, lambda key: jnp.ones(2)),
            r"shape \(\) for one row; expected \(ny,\) = \(1,\)",
        ),
        (
            Function(lambda w, z: w * z, lambda key: jnp.ones(2)),
            r"shape \(2,\) for one row; expected",
        ),
        (
            Function(lambda w, z: [w[0]], lambda key: jnp.ones(2)),
            "shape list for one row; expected",
        ),
        (
            Function(lambda w, z: w[:1] * 1.0, lambda key: jnp.arange(2)),
            "must be float arrays; found int64",
        ),
        (
            Function(lambda w, z: w[:1], lambda key: jnp.ones(2) + 1j),
            "must be float arrays; found complex128",
        ),
    ],
)
def test_learner_refused(learner, message):
    with pytest.raises(InputError, match=message):
        Bound(learner, 2, 1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"hidden": (0,)}, r"`hidden` must be whole numbers of neurons, 1 or more; got \(0,\)"),
        ({"hidden": (4, 2.5)}, "`hidden` must be whole numbers"),
        ({"hidden": (True,)}, "`hidden` must be whole numbers"),
        ({"hidden": 16}, "`hidden` must be"),
        ({"activation": "swoosh"}, "`activation` must be one of tanh, relu, .*; got 'swoosh'"),
        ({"inputs": "v[k-1]"}, "`inputs` must be"),
    ],
)
def test_mlp_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        MLP(**arguments)


def test_bound_is_hashable_so_that_programs_are_reused():
    assert Bound(MLP(hidden=[4]), 2, 1) == Bound(MLP(hidden=(4,), inputs=None), 2, 1)
    assert hash(Bound(MLP(hidden=[4], inputs=["y[k-1]"]), 2, 1)) == hash(
        Bound(MLP((4,), inputs=("y[k-1]",)), 2, 1)
    )
    assert Bound(MLP(), 2, 1) != Bound(MLP(), 3, 1)


@pytest.mark.parametrize(
    ("hidden", "nz", "ny"), [((16,), 3, 1), ((40, 30), 50, 2), ((2000,), 3, 1)]
)
def test_weights_are_those_of_a_draw_at_their_own_size(hidden, nz, ny):
    sizes = (nz, *hidden, ny)
    keys = jax.random.split(KEY, len(sizes) - 1)
    for i, (weight, _) in enumerate(MLP(hidden, activation="relu").init(KEY, nz, ny)):
        a = math.sqrt(6 / (sizes[i] + sizes[i + 1])) * (math.sqrt(2) if i < len(hidden) else 1.0)
        shape = (sizes[i + 1], sizes[i])
        np.testing.assert_array_equal(
            weight, jax.random.uniform(keys[i], shape, minval=-a, maxval=a, dtype=float)
        )


GROUPS = [  # weights in the tree's order: into the neurons, their biases, out of the last layer, the output's bias
    (MLP((2,)), 3, 1, [0, 0, 0, 1, 1, 1, 0, 1, 0, 1, 2]),
    (MLP((2,)), 1, 2, [0, 1, 0, 1, 0, 1, 0, 1, 2, 2]),
    (MLP((2, 1)), 1, 1, [0, 1, 0, 1, 2, 2, 2, 2, 3]),
    (MLP(()), 2, 1, [0, 0, 1]),
    (CUBIC, 1, 1, [0, 0, 1]),
]


@pytest.mark.parametrize(("learner", "nz", "ny", "expected"), GROUPS)
def test_groups_are_neurons(learner, nz, ny, expected):
    assert _in_order(Bound(learner, nz, ny).groups().tolist()) == expected


def _in_order(labels):
    names = {}
    return [names.setdefault(label, len(names)) for label in labels]


@pytest.mark.parametrize("hidden", [(3,), (16, 16)])
def test_rows_of_many_have_the_values_of_one(hidden: tuple[int, ...]) -> None:
    """Small products are sums in the step of a run, and matrix products over thousands of rows."""

    class Doubled(MLP):
        def apply(self, tree, z):
            return 2 * super().apply(tree, z)

    for learner in (MLP(hidden), Doubled(hidden)):
        bound = Bound(learner, 2, 1)
        w, z = bound.init(jax.random.key(1)), np.array([0.3, -0.7])
        found, _ = bound.forward(w, z[:, None])
        np.testing.assert_allclose(found[:, 0], bound.values(w, z), rtol=1e-12)
