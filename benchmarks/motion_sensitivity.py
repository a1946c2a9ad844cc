"""One linearisation of a motion (sensitivities and normal equations) against one plain free run of the same segments.

A spring with a hidden velocity and a learner of it, at Silverbox's size and at a small one, with every integrator, and a
cart and pole of MuJoCo; in one process and in turn.
Run: python benchmarks/motion_sensitivity.py [MuJoCo, for its row alone]
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from machine import alternate, describe

import orthaug as oa
from orthaug._base.jax import jax
from orthaug._base.parallel import one_blas_thread
from orthaug.fitting.motion_task import MotionTask
from orthaug.fitting.segments import respond, sensitivity
from orthaug.physics.problem import pose_motion

REPEATS = 15
CASES = (
    (65_000, 9, "rk4", 1),
    (65_000, 9, "rk4", 3),
    (65_000, 9, "exact", 1),
    (1_000, 9, "rk4", 1),
    (1_000, 0, "rk4", 3),
    (1_000, 0, "exact", 1),
    (100, 0, "rk4", 1),
    (1_000, 0, "rk4", 1),
    (10_000, 0, "rk4", 1),
    (65_000, 0, "rk4", 1),
    (10_000, 9, "rk4, MuJoCo", 1),
)
"""Rows, neurons, integrator, substeps."""
CART = """<mujoco><compiler angle="radian"/><option><flag contact="disable"/></option><worldbody>
<body name="cart"><joint name="y" type="slide" axis="1 0 0" damping="0.3"/>
<geom type="box" size=".1 .1 .1" mass="1"/>
<body name="pole"><joint name="hinge" type="hinge" axis="0 -1 0" damping="0.05"/>
<inertial pos="0 0 -0.5" mass="0.4" diaginertia="0.03 0.03 0.001"/></body></body>
</worldbody><actuator><motor name="u" joint="y"/></actuator></mujoco>"""


def motion(integrator: str, substeps: int, learned: bool) -> oa.Motion:
    """A mass on a spring and a damper."""
    names = (("m", 1.0), ("c", 2.0), ("k", 100.0))
    return oa.Motion.from_equations(
        states=[
            oa.State("x", "v", start="y"),
            oa.State("v", "(u - c*v - k*x)/m", start="derivative of y", learned=learned),
        ],
        outputs=[oa.Output("y", "x")],
        inputs=["u"],
        parameters=[oa.PhysicalParameter(name, value, min=0) for name, value in names],
        integrator=integrator,
        substeps=substeps,
    )


def cart(substeps: int) -> Any:
    """A cart and pole of MuJoCo, with a learner of the cart's speed."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "cart.xml"
        file.write_text(CART)
        source = oa.MuJoCo(
            file=str(file),
            parameters=("pole.mass", "hinge.damping"),
            learned=("y.velocity",),
            substeps=substeps,
        )
        return source.build(["u"], ["y"])


def ratio(rows: int, neurons: int, integrator: str, substeps: int) -> tuple[int, float, float]:
    """Unknowns, seconds of a free run and of a linearisation."""
    rng = np.random.default_rng(0)
    record = oa.Record.from_arrays(
        u=rng.normal(size=rows), y=0.01 * rng.normal(size=rows), sampling_time=0.01
    )
    if integrator.endswith("MuJoCo"):
        problem = pose_motion(record, cart(substeps), ["y_velocity"])
    else:
        problem = pose_motion(record, motion(integrator, substeps, neurons > 0), ["v"])
    task = MotionTask.of(problem, oa.MLP((neurons,)) if neurons else None, oa.Simulation(512, 0))
    weights = np.asarray(task.bound.init(jax.random.key(0)))
    plan = task.plan
    numbers = plan.numbers(problem.motion.coordinates.initial, weights)
    made = (plan.dynamics, numbers, plan.segments, plan.segments.start)
    with one_blas_thread():
        plain, whole = alternate(
            lambda: jax.block_until_ready(respond(*made)),
            lambda: jax.block_until_ready(sensitivity(*made, plan.weight)),
            REPEATS,
        )
    return plan.dynamics.unknowns, plain, whole


def main(words: str = "") -> None:
    print(describe())
    print(
        "| rows | unknowns | integrator | substeps | free run | linearisation | ratio |\n"
        + 7 * "|---"
        + "|"
    )
    for rows, neurons, integrator, substeps in CASES:
        if words not in integrator:
            continue
        unknowns, plain, whole = ratio(rows, neurons, integrator, substeps)
        times = f"{1e3 * plain:.2f} ms | {1e3 * whole:.2f} ms | {whole / plain:.1f}"
        print(f"| {rows} | {unknowns} | {integrator} | {substeps} | {times} |")


if __name__ == "__main__":
    main(*sys.argv[1:])
