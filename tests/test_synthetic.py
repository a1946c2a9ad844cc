"""The paper's two records against a plain re-implementation of how its scripts draw them."""

from __future__ import annotations

import numpy as np
import pytest

from orthaug import InputError, Record, synthetic


def signals(record: Record) -> tuple[np.ndarray, np.ndarray]:
    """The only input and the only output of a record."""
    (experiment,) = record.experiments
    return experiment.inputs[:, 0], experiment.outputs[:, 0]


def polynomial(u: float) -> float:
    return 0.01 + u - 0.5 * u**2 + 0.1 * u**3


@pytest.fixture(scope="module")
def example():
    return synthetic.mass_spring_damper()


@pytest.mark.parametrize("noise", [False, True])
@pytest.mark.parametrize("data_set", [1, 2, 3])
def test_static_example(data_set, noise):
    rng = np.random.RandomState(10)
    u = [0.3 * rng.randn() for _ in range(512 if data_set == 1 else 1024)]
    if data_set == 1:
        u = u + [-v for v in u]
    if data_set == 3:
        u = [v - 0.01 for v in u]
    u_test = [0.3 * rng.randn() for _ in range(1024)]
    e = [rng.normal(0.0, 0.009) if noise else 0.0 for _ in u]
    example = synthetic.static(data_set, noise=noise)
    np.testing.assert_array_equal(signals(example.train)[0], u)
    np.testing.assert_allclose(
        signals(example.train)[1], [polynomial(a) + b for a, b in zip(u, e, strict=True)]
    )
    np.testing.assert_array_equal(signals(example.test)[0], u_test)
    np.testing.assert_allclose(signals(example.test)[1], [polynomial(a) for a in u_test])


def test_static_example_baseline():
    example = synthetic.static()
    assert example.baseline.names == ("theta1", "theta3")
    assert [term.regressor for term in example.baseline.terms] == ["u[k]", "u[k]**3"]
    np.testing.assert_array_equal(example.baseline.initial, [0.8, 0.03])
    np.testing.assert_array_equal(example.theta, [1.0, 0.1])


@pytest.mark.parametrize("data_set", [1, 2, 3])
def test_static_example_of_another_length(data_set):
    example = synthetic.static(data_set, samples=100)
    assert (len(example.train), len(example.test)) == (100, 1024)


def test_static_example_has_three_sets():
    with pytest.raises(InputError, match="`data_set` must be 1, 2 or 3; got 4"):
        synthetic.static(4)


def step(theta, y1, y2, force):
    """One step of the mass-spring-damper with Stribeck friction, as the paper prints it."""
    velocity = (y1 - y2) / 0.01
    friction = 0.8 * np.sign(velocity) + (1.2 - 0.8) * np.exp(-abs(velocity) / 0.02) * np.sign(
        velocity
    )
    return theta[0] * y1 + theta[1] * y2 + theta[2] * (force - friction)


def test_mass_spring_damper(example):
    m, c, k, ts = 1.0, 100.0, 1000.0, 0.01
    gamma = m + c * ts + k * ts**2
    theta = ((2 * m - c * ts) / gamma, -m / gamma, ts**2 / gamma)
    rng = np.random.RandomState(12345)
    half = [rng.normal(0.0, 100.0) for _ in range(5000)]
    u = half + [-v for v in half]
    y = [0.0, 0.0]
    for k in range(len(u) - 2):
        y.append(step(theta, y[k + 1], y[k], u[k + 1]) + rng.normal(scale=0.00018))
    u_test = [rng.uniform(-100.0, 100.0) for _ in range(1000)]
    y_test = [0.0, 0.0]
    for k in range(len(u_test) - 2):
        y_test.append(step(theta, y_test[k + 1], y_test[k], u_test[k + 1]))
    np.testing.assert_allclose(example.theta, theta, rtol=1e-15)
    for record, forces, positions in ((example.train, u, y), (example.test, u_test, y_test)):
        np.testing.assert_array_equal(signals(record)[0], forces)
        np.testing.assert_allclose(signals(record)[1], positions, rtol=1e-10, atol=1e-15)


def test_mass_spring_damper_channels_and_baseline(example):
    assert [channel.label for channel in example.train.channels] == ["position [m]", "force [N]"]
    assert example.train.sampling_time == 0.01
    assert (len(example.train), len(example.test)) == (10_000, 1000)
    assert [term.regressor for term in example.baseline.terms] == [
        "position[k-1]",
        "position[k-2]",
        "force[k-1]",
    ]
    np.testing.assert_array_equal(example.baseline.initial, [0.61, -0.52, 4.7e-5])


def test_least_squares_on_the_mass_spring_damper(example):
    u, y = signals(example.train)
    phi = np.stack([y[1:-1], y[:-2], 1e-4 * u[1:-1]], axis=1)
    found = np.linalg.lstsq(phi, y[2:], rcond=None)[0] * [1.0, 1.0, 1e-4]
    np.testing.assert_allclose(found, [0.471697779, -0.471758489, 4.76104182e-5], rtol=2e-9)
    assert np.linalg.norm(found / example.theta - 1) == pytest.approx(0.013254, abs=5e-7)


def test_friction_is_odd_and_decays_from_static_to_coulomb():
    friction = synthetic.MassSpringDamper().friction
    assert friction(0.0) == 0.0
    np.testing.assert_allclose(
        friction(np.array([1e-9, -1e-9, 10.0, -10.0])), [1.2, -1.2, 0.8, -0.8], rtol=1e-6
    )
