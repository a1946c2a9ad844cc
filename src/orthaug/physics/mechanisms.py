"""Mechanisms in MuJoCo's format (MJCF), or URDF as MuJoCo reads it: joints, masses, actuators.

Accelerations are those of MJX, MuJoCo on JAX, in double precision, with its derivatives.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, lru_cache
from importlib import import_module
from typing import Any, ClassVar

import numpy as np

from orthaug._base.errors import InputError
from orthaug._base.jax import jax, jnp
from orthaug.physics.mass_matrix import MassMatrix
from orthaug.physics.scalar_program import ScalarProgram, scalar_program
from orthaug.physics.sources import Description, FileSource, Functions, Quantity, Seen

_MOST = 1000  # operations on scalars; beyond, programs of MJX's arrays compile sooner
_SIGNIFICANT = 1e-12  # to which a written file gives the same numbers again


@dataclass(frozen=True)
class Place:
    """Place of a parameter: an entry of an array of MuJoCo's model."""

    array: str
    index: tuple[int, ...]
    unit: str
    low: float | None = None


@dataclass(frozen=True, kw_only=True)
class MuJoCo(FileSource):
    """A mechanism with hinges and slides; states are the joints' positions and velocities.

    Parameters are `body.mass`, `body.inertia.x`, `body.com.x`, `joint.damping`, `joint.stiffness`,
    `joint.armature`, `joint.frictionloss` and `actuator.gain`. Inputs are actuators. A position
    has the joint's name, a velocity is `joint.velocity`. The mass of a body is changed by itself:
    its inertia is a parameter of its own.

    Args:
        file, parameters, inputs, outputs, starts, learned: as of a `FileSource`. `joint.torque` in
            `learned`, or `joint.force` of a slide, is what the joint's actuator would add;
            `joint.velocity` its acceleration.
        integrator, substeps, hold: of the motion.

    Examples:
        `oa.MuJoCo(file="arm.xml", parameters=("lower.mass", "elbow.damping"))`
    """

    ending: ClassVar[str] = ".xml"
    target: ClassVar[str] = "mjcf"

    @cached_property
    def mechanism(self) -> Mechanism:
        """The compiled model."""
        return open_mechanism(self.file, self.content, self.sha256)

    def describe(self) -> Description:
        there = self.mechanism
        units = ["m" if slides else "rad" for slides in there.slides]
        names = there.names("joint")
        states = (
            *(Quantity(n, u, float(x)) for n, u, x in zip(names, units, there.rest, strict=True)),
            *(Quantity(f"{n}.velocity", f"{u}/s", 0.0) for n, u in zip(names, units, strict=True)),
        )
        parameters = tuple(
            Quantity(name, at.unit, float(getattr(there.compiled, at.array)[at.index]), at.low)
            for name, at in there.places.items()
        )
        inputs = tuple(Quantity(name) for name in there.names("actuator"))
        forces = zip(states[len(names) :], there.forces, strict=True)
        pushed = tuple((state.name, Quantity(*force)) for state, force in forces)
        return Description(states, parameters, inputs, states, pushed)

    def functions(
        self, parameters: Sequence[str], inputs: Sequence[str], outputs: Sequence[str]
    ) -> Functions:
        states = [state.name for state in self.describe().states]
        own = tuple(self.mechanism.places[name] for name in parameters)
        actuators = tuple(self.mechanism.names("actuator").index(name) for name in inputs)
        seen = tuple(states.index(name) for name in outputs)
        return Rates(self.mechanism, own, actuators), Seen(seen)

    def mass(self, parameters: Sequence[str]) -> MassMatrix:
        there = self.mechanism
        count = len(there.forces)
        own = Inertia(there, tuple(there.places[name] for name in parameters))
        forces = tuple((Quantity(name).identifier, unit) for name, unit in there.forces)
        return MassMatrix(own, tuple(range(count, 2 * count)), forces)

    def written(self, values: Mapping[str, float]) -> dict[str, str]:
        """Return the file with these values, `model.xml`."""
        return {"model.xml": self.mechanism.written(dict(values))}


@dataclass(frozen=True)
class Mechanism:
    """A compiled model of MuJoCo; equal where the files are."""

    sha256: str
    file: str = field(compare=False)
    content: bytes = field(compare=False, repr=False)
    compiled: Any = field(compare=False, repr=False)

    def __reduce__(self) -> tuple[Any, ...]:  # another process compiles it again
        return open_mechanism, (self.file, self.content, self.sha256)

    def names(self, what: str) -> list[str]:
        """Return the names of all joints, actuators or bodies; `joint0` where one has none."""
        count = {"joint": "njnt", "actuator": "nu", "body": "nbody"}[what]
        every = range(getattr(self.compiled, count))
        return [getattr(self.compiled, what)(i).name or f"{what}{i}" for i in every]

    @property
    def slides(self) -> list[bool]:
        """True if each joint slides; the others turn."""
        mujoco, _ = _modules(self.file)
        slide = int(mujoco.mjtJoint.mjJNT_SLIDE)
        return [int(kind) == slide for kind in self.compiled.jnt_type]

    @property
    def forces(self) -> list[tuple[str, str]]:
        """Name and unit of the force along each joint."""
        words = {True: ("force", "N"), False: ("torque", "N m")}
        kinds = (words[slides] for slides in self.slides)
        return [
            (f"{n}.{word}", unit)
            for n, (word, unit) in zip(self.names("joint"), kinds, strict=True)
        ]

    @property
    def rest(self) -> Any:
        """Positions of the joints in the file."""
        return self.compiled.qpos0

    @cached_property
    def places(self) -> dict[str, Place]:
        """Place of each parameter, by its name."""
        found: dict[str, Place] = {}
        for i, name in enumerate(self.names("body")):
            if i == 0 or not self.compiled.body_mass[i]:
                continue
            found[f"{name}.mass"] = Place("body_mass", (i,), "kg", 0.0)
            for j, axis in enumerate("xyz"):
                found[f"{name}.inertia.{axis}"] = Place("body_inertia", (i, j), "kg m²", 0.0)
                found[f"{name}.com.{axis}"] = Place("body_ipos", (i, j), "m")
        for i, (name, slides) in enumerate(zip(self.names("joint"), self.slides, strict=True)):
            force, way = ("N", "m") if slides else ("N m", "rad")
            dof = int(self.compiled.jnt_dofadr[i])
            mass = "kg" if slides else "kg m²"
            found[f"{name}.damping"] = Place("dof_damping", (dof,), f"{force} s/{way}", 0.0)
            found[f"{name}.stiffness"] = Place("jnt_stiffness", (i,), f"{force}/{way}", 0.0)
            found[f"{name}.armature"] = Place("dof_armature", (dof,), mass, 0.0)
            if self.compiled.dof_frictionloss[dof] > 0:  # without it there is no such constraint
                found[f"{name}.frictionloss"] = Place("dof_frictionloss", (dof,), force, 0.0)
        for i, name in enumerate(self.names("actuator")):
            found[f"{name}.gain"] = Place("actuator_gainprm", (i, 0), "")
        return found

    @property
    def constrained(self) -> bool:
        """True if a solver of constraints is needed: friction, limits, equalities."""
        own = self.compiled
        limited = bool(own.jnt_limited.any()) or bool(own.tendon_limited.any())
        return limited or own.neq > 0 or bool((own.dof_frictionloss > 0).any())

    def written(self, values: Mapping[str, float]) -> str:
        """Return the file with other values of parameters, as MJCF.

        Raises:
            InputError: MuJoCo does not read the same values back.
        """
        mujoco, _ = _modules(self.file)
        spec = mujoco.MjSpec.from_string(self.content.decode())
        changed = {name: np.array(getattr(self.compiled, name)) for name in _WRITTEN}
        for name, value in values.items():
            changed[self.places[name].array][self.places[name].index] = value
        for i, body in enumerate(spec.bodies):
            if i and self.compiled.body_mass[i]:
                body.explicitinertial = True
                body.mass = float(changed["body_mass"][i])
                body.inertia = changed["body_inertia"][i]
                body.ipos, body.iquat = changed["body_ipos"][i], self.compiled.body_iquat[i]
                body.fullinertia = np.full(6, np.nan)
        for i, joint in enumerate(spec.joints):
            dof = int(self.compiled.jnt_dofadr[i])
            for key, array, at in (
                ("damping", "dof_damping", dof),
                ("armature", "dof_armature", dof),
                ("frictionloss", "dof_frictionloss", dof),
                ("stiffness", "jnt_stiffness", i),
            ):
                given = getattr(joint, key)
                value = float(changed[array][at])
                if np.ndim(given):
                    given[0] = value
                else:
                    setattr(joint, key, value)
        for i, actuator in enumerate(spec.actuators):
            actuator.gainprm[0] = changed["actuator_gainprm"][i, 0]
        spec.compile()
        text = spec.to_xml()
        again = mujoco.MjModel.from_xml_string(text)
        for name, value in changed.items():
            if not np.allclose(getattr(again, name), value, rtol=1e-4, atol=_SIGNIFICANT):
                raise InputError(
                    f"{self.file}: MuJoCo does not write the changed {name}; take parameters.json."
                )
        return text


_WRITTEN = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "dof_damping",
    "dof_armature",
    "dof_frictionloss",
    "jnt_stiffness",
    "actuator_gainprm",
)


@dataclass(frozen=True)
class Rates:
    """f(x, u, p) of a mechanism: velocities, and the accelerations of MJX."""

    mechanism: Mechanism
    parameters: tuple[Place, ...]
    actuators: tuple[int, ...]

    @property
    def operations(self) -> int:
        """Number of operations on scalars, `_MOST` at most."""
        nx = 2 * self.mechanism.compiled.njnt
        return min(
            len(_scalars(self, (nx,), (len(self.actuators),), (len(self.parameters),))), _MOST
        )

    def __call__(self, x: Any, u: Any, p: Any) -> Any:
        x, u, p = (jnp.asarray(part, dtype=float) for part in (x, u, p))
        if x.ndim == 1:
            return _rates()(self, x, u, p)
        axes = (-1, -1, -1 if p.ndim > 1 else None)
        return jax.vmap(self, axes, -1)(x, u, p)

    def at(self, x: Any, u: Any, p: Any) -> Any:
        """Return ẋ (nx,) at one point of JAX arrays."""
        return _evaluate(self, x, u, p)

    def by_mjx(self, x: Any, u: Any, p: Any) -> Any:
        """Return ẋ (nx,) at one point by the algorithms of MJX."""
        _, mjx = _modules(self.mechanism.file)
        model, data = _changed(self.mechanism, self.parameters, p)
        half = len(x) // 2
        ctrl = jnp.zeros(self.mechanism.compiled.nu).at[np.array(self.actuators, int)].set(u)
        data = data.replace(qpos=x[:half], qvel=x[half:], ctrl=ctrl)
        if self.mechanism.constrained:
            return jnp.concatenate([x[half:], mjx.forward(model, data).qacc])
        data = mjx.fwd_velocity(model, mjx.fwd_position(model, data))
        data = mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data))
        return jnp.concatenate([x[half:], data.qacc_smooth])


@dataclass(frozen=True)
class Inertia:
    """M(x, p) of a mechanism's joints, in the order of their velocities."""

    mechanism: Mechanism
    parameters: tuple[Place, ...]

    def __call__(self, x: Any, p: Any) -> Any:
        return _evaluate(self, x, p)

    def by_mjx(self, x: Any, p: Any) -> Any:
        """Return M (nq, nq) at one point by the algorithms of MJX."""
        _, mjx = _modules(self.mechanism.file)
        model, data = _changed(self.mechanism, self.parameters, p[: len(self.parameters)])
        data = data.replace(qpos=x[: self.mechanism.compiled.nq])
        data = mjx.com_pos(model, mjx.kinematics(model, data))
        return mjx.full_m(model, mjx.crb(model, data))


def _changed(mechanism: Mechanism, parameters: Sequence[Place], p: Any) -> tuple[Any, Any]:
    """Return the model of MJX with other values of parameters (np,), and its data."""
    model, data = _on_jax(mechanism)
    changes: dict[str, Any] = {}
    for place, value in zip(parameters, p, strict=True):
        array = changes.get(place.array, getattr(model, place.array))
        changes[place.array] = array.at[place.index].set(value)
    return model.replace(**changes), data


@lru_cache(maxsize=32)
def _scalars(function: Rates | Inertia, *shapes: tuple[int, ...]) -> ScalarProgram:
    """Return the algorithms of MJX with the constants of the mechanism folded away."""
    return scalar_program(function.by_mjx, *shapes)


def _evaluate(function: Rates | Inertia, *arguments: Any) -> Any:
    """Return the result of MJX, by operations on scalars where these are few."""
    program = _scalars(function, *(each.shape for each in arguments))
    return program(*arguments) if len(program) <= _MOST else function.by_mjx(*arguments)


@cache
def _rates() -> Any:
    return jax.jit(lambda box, x, u, p: box.at(x, u, p), static_argnums=0)


@lru_cache(maxsize=8)
def _on_jax(mechanism: Mechanism) -> tuple[Any, Any]:
    """Return the model and data of MJX; constants, made outside of any program."""
    mjx = _modules(mechanism.file)[1]
    with jax.ensure_compile_time_eval():
        return mjx.put_model(mechanism.compiled, impl="jax"), mjx.make_data(
            mechanism.compiled, impl="jax"
        )


def _modules(file: str) -> tuple[Any, Any]:
    jnp.zeros(())  # double precision before MJX makes arrays
    quiet = io.StringIO()  # MJX writes which optional modules it does not find
    try:
        with contextlib.redirect_stdout(quiet), contextlib.redirect_stderr(quiet):
            return import_module("mujoco"), import_module("mujoco.mjx")
    except ImportError as error:
        raise InputError(
            f"{file}: a mechanism needs MuJoCo and MJX ({error}): pip install 'orthaug[mujoco]'."
        ) from None


@lru_cache(maxsize=8)
def open_mechanism(file: str, content: bytes, sha256: str) -> Mechanism:
    """Compile a file of MJCF or URDF.

    Raises:
        InputError: MuJoCo is not installed, a file that it does not read, or what has no equations
            as states and accelerations: contacts, joints of several degrees, activations.
    """
    mujoco, _ = _modules(file)
    if b"<include" in content:
        raise InputError(
            f"{file}: includes other files, which a saved model cannot keep; join them."
        )
    try:
        compiled = mujoco.MjModel.from_xml_string(content.decode("utf-8"))
    except (ValueError, UnicodeDecodeError) as error:
        words = " ".join(str(error).split())
        raise InputError(f"{file}: MuJoCo cannot read it ({words}).") from None
    plain = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))
    if not compiled.njnt:
        raise InputError(f"{file}: no joints, so nothing moves; expected at least one.")
    for i in range(compiled.njnt):
        if int(compiled.jnt_type[i]) not in plain:
            name = compiled.joint(i).name
            raise InputError(
                f"{file}: the joint '{name}' is free or a ball; use slides and hinges instead."
            )
    if compiled.na:
        raise InputError(
            f"{file}: actuators with states of their own; give motors, whose force follows at once."
        )
    if _may_touch(mujoco, compiled):
        raise InputError(
            f"{file}: bodies may touch, and contacts have no equations here. Leave them out by "
            '<option><flag contact="disable"/></option>.'
        )
    return Mechanism(sha256, file, content, compiled)


def _may_touch(mujoco: Any, compiled: Any) -> bool:
    """Return whether two geoms may collide, as MuJoCo filters them."""
    if compiled.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT):
        return False
    if compiled.npair:
        return True
    kind, affinity, body = compiled.geom_contype, compiled.geom_conaffinity, compiled.geom_bodyid
    weld, parent = compiled.body_weldid, compiled.body_parentid
    for i in range(compiled.ngeom):
        for j in range(i):
            a, b = int(weld[body[i]]), int(weld[body[j]])
            related = (a and weld[parent[a]] == b and b) or (b and weld[parent[b]] == a and a)
            seen = (kind[i] & affinity[j]) or (kind[j] & affinity[i])
            if seen and a != b and not related:
                return True
    return False
