"""Mechanisms of MuJoCo: accelerations by hand, parameters by name, estimates written back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import orthaug as oa
from orthaug import InputError, MuJoCo, Record

pytest.importorskip("mujoco", reason="no MuJoCo: pip install 'orthaug[mujoco]'")
pytest.importorskip("trimesh", reason="no MJX: pip install 'orthaug[mujoco]'")

G = 9.81
HEAD = '<mujoco><option gravity="0 0 -9.81"><flag contact="disable"/></option><worldbody>'
ARM = """
<body name="upper"><joint name="shoulder" type="hinge" axis="0 -1 0" damping="0.2"/>
<inertial pos="0 0 -0.3" mass="1.5" diaginertia="0.05 0.05 0.001"/>
<body name="lower" pos="0 0 -0.6">
<joint name="elbow" type="hinge" axis="0 -1 0" damping="0.1" armature="0.02" stiffness="0.4"/>
<inertial pos="0 0 -0.25" mass="0.8" diaginertia="0.02 0.02 0.001"/></body></body>
</worldbody><actuator><motor name="first" joint="shoulder"/>
<motor name="second" joint="elbow" gear="3"/></actuator></mujoco>
"""
CART = """
<body name="cart"><joint name="slider" type="slide" axis="1 0 0" damping="0.3"/>
<geom type="box" size=".1 .1 .1" mass="1"/>
<body name="pole"><joint name="hinge" type="hinge" axis="0 -1 0" damping="0.05" armature="0.01"/>
<inertial pos="0 0 -0.5" mass="0.4" diaginertia="0.03 0.03 0.001"/></body></body>
</worldbody><actuator><motor name="push" joint="slider" gear="2"/></actuator></mujoco>
"""


def write(folder: Path, body: str, head: str = HEAD) -> str:
    (folder / "mechanism.xml").write_text(head + body)
    return str(folder / "mechanism.xml")


def arm(x: Any, torques: Any, m2: float, d1: float, gain: float) -> Any:
    """Return the accelerations of `ARM` by Lagrange's equations."""
    a, b, da, db = x
    l1, c1, c2, m1, j1, j2 = 0.6, 0.3, 0.25, 1.5, 0.05, 0.02
    coupling = m2 * l1 * c2
    h11 = j1 + j2 + m1 * c1**2 + m2 * (l1**2 + c2**2) + 2 * coupling * np.cos(b)
    h12 = j2 + m2 * c2**2 + coupling * np.cos(b)
    mass = np.array([[h11, h12], [h12, j2 + m2 * c2**2 + 0.02]])
    bend = coupling * np.sin(b)
    own = np.array(
        [
            bend * (2 * da * db + db**2)
            - (m1 * c1 + m2 * l1) * G * np.sin(a)
            - m2 * c2 * G * np.sin(a + b)
            - d1 * da,
            -bend * da**2 - m2 * c2 * G * np.sin(a + b) - 0.1 * db - 0.4 * b,
        ]
    )
    return np.linalg.solve(mass, own + [torques[0], 3 * gain * torques[1]])


def cart(x: Any, push: float, mass: float, damping: float) -> Any:
    """Return the accelerations of `CART` by Lagrange's equations."""
    _, a, v, w = x
    matrix = np.array(
        [[1 + mass, 0.5 * mass * np.cos(a)], [0.5 * mass * np.cos(a), 0.25 * mass + 0.04]]
    )
    forces = [
        2 * push - 0.3 * v + 0.5 * mass * np.sin(a) * w**2,
        -0.5 * mass * G * np.sin(a) - damping * w,
    ]
    return np.linalg.solve(matrix, forces)


def test_a_two_link_arm_has_the_accelerations_of_lagrange(tmp_path: Path) -> None:
    names = ("lower.mass", "shoulder.damping", "second.gain")
    source = MuJoCo(file=write(tmp_path, ARM), parameters=names)
    motion = source.build(["first", "second"], ["shoulder", "elbow"])
    assert [(p.name, p.initial, p.unit, p.min) for p in motion.parameters] == [
        ("lower_mass", 0.8, "kg", 0.0),
        ("shoulder_damping", 0.2, "N m s/rad", 0.0),
        ("second_gain", 1.0, "", -np.inf),
    ]
    rng = np.random.default_rng(0)
    x, u, p = rng.normal(size=(4, 5)), rng.normal(size=(2, 5)), np.array([1.1, 0.35, 0.9])
    found = motion.rates(x, u, p, np)
    np.testing.assert_array_equal(found[:2], x[2:])
    by_hand = np.array([arm(*point, *p) for point in zip(x.T, u.T, strict=True)]).T
    np.testing.assert_allclose(found[2:], by_hand, rtol=1e-8)
    np.testing.assert_array_equal(motion.observed(x, u, p, np), x[:2])


def test_a_learner_of_torques_has_the_mass_matrix_of_lagrange(tmp_path: Path) -> None:
    keys = {"file": write(tmp_path, ARM), "parameters": ("lower.mass",)}
    motion = MuJoCo(**keys, learned=("shoulder.torque", "elbow_torque")).build(
        ["first", "second"], ["shoulder", "elbow"]
    )
    assert motion.learned == ((2, 3), ())
    assert motion.mass.forces == (("shoulder_torque", "N m"), ("elbow_torque", "N m"))
    x, p = np.array([0.4, 0.9, -0.3, 0.7]), np.array([1.1])
    first, second = (
        np.append(x[2:], arm(x, torque, 1.1, 0.2, 1.0)) for torque in ([1.0, 0.0], [0.0, 0.0])
    )
    force = motion.mass.balance(first - second, x, p)
    np.testing.assert_allclose(force, [0, 0, 1, 0], rtol=1e-8, atol=1e-10)
    rates = MuJoCo(**keys, learned=("shoulder.velocity",)).build(["first"], ["shoulder"])
    assert rates.learned == ((2,), ()) and not rates.mass.rows
    with pytest.raises(InputError, match="`learned` has elbow.torque, a force, and shoulder.vel"):
        MuJoCo(**keys, learned=("elbow.torque", "shoulder.velocity")).build(["first"], ["elbow"])


def test_a_slide_has_a_force(tmp_path: Path) -> None:
    source = MuJoCo(
        file=write(tmp_path, CART), parameters=("pole.mass",), learned=("slider.force",)
    )
    motion = source.build(["push"], ["slider"])
    assert motion.learned == ((2,), ())
    assert motion.mass.forces == (("slider_force", "N"), ("hinge_torque", "N m"))


@pytest.mark.proof
def test_a_cart_pole_is_fitted_saved_and_written_back(tmp_path: Path) -> None:
    names = ("pole.mass", "hinge.damping")
    source = MuJoCo(file=write(tmp_path, CART), parameters=names, substeps=2)
    rng, x, rows, h = np.random.default_rng(1), np.array([0.0, 0.5, 0.0, 0.0]), [], 0.0025
    push = np.repeat(rng.normal(size=20), 15)
    for u in push:
        rows.append(x[:2] + 1e-3 * rng.normal(size=2))
        for _ in range(8):  # Heun's method, of order 2
            first = np.concatenate([x[2:], cart(x, u, 0.6, 0.1)])
            ahead = x + h * first
            second = np.concatenate([ahead[2:], cart(ahead, u, 0.6, 0.1)])
            x = x + h / 2 * (first + second)
    data = Record.from_arrays(
        push, np.array(rows), sampling_time=0.02, inputs=["push"], outputs=["slider", "hinge"]
    )
    fit = oa.estimate(data, source, learner=None, blocks=0)
    assert (np.abs(fit.values - [0.6, 0.1]) < 4 * fit.parameters["std"] + 1e-3).all()
    oa.save(fit.model, tmp_path / "model")
    again = oa.load(tmp_path / "model")
    np.testing.assert_array_equal(again.simulate(data).model, fit.model.simulate(data).model)
    oa.export(fit.model, tmp_path / "written", "mjcf")
    step, x, u = oa.numpy_step(fit.model), np.array([0.1, 0.4, -0.3, 0.8]), np.array([0.7])
    for found, given in zip(step(x, u), fit.model.step(x, u), strict=True):
        np.testing.assert_allclose(found, given, rtol=1e-12)
    written = MuJoCo(file=str(tmp_path / "written" / "model.xml"), parameters=("pole.mass",))
    assert written.build(["push"], ["slider"]).initial == pytest.approx(fit.values[:1], rel=1e-5)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("<mujoco>", "<mujoco", "MuJoCo cannot read it"),
        ('<flag contact="disable"/>', "", "bodies may touch, and contacts have no equations"),
        ('type="slide" axis="1 0 0"', 'type="ball"', "the joint 'slider' is free or a ball"),
        ("<worldbody>", '<include file="a.xml"/><worldbody>', "includes other files"),
        ("<motor", '<general dyntype="integrator"', "actuators with states of their own"),
    ],
)
def test_mechanisms_without_equations_are_refused(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    grand = '<body name="tip" pos="0 0 -1"><geom size=".2"/><joint name="last"/></body>'
    text = (HEAD + CART.replace("</body></body>", f"{grand}</body></body>")).replace(old, new)
    with pytest.raises(InputError, match=words):
        MuJoCo(file=write(tmp_path, text, ""), parameters=("pole.mass",)).describe()


def test_unknown_names_are_refused_in_words(tmp_path: Path) -> None:
    file = write(tmp_path, CART)
    with pytest.raises(InputError, match="did you mean 'pole.mass'"):
        MuJoCo(file=file, parameters=("pole.mas",)).build(["push"], ["hinge"])
    with pytest.raises(InputError, match="no input 'force'; it has push."):
        MuJoCo(file=file, parameters=("pole.mass",)).build(["force"], ["hinge"])
