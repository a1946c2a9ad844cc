"""Inputs of the data that nothing of a model reads are said, and tried where something is missing."""

import numpy as np

import orthaug as oa
from orthaug.physics.closed_loop import close_loop


def turbine(seed=0, rows=1500):
    """Power of a wind turbine: the angle lowers it by its square, and no equation has it."""
    rng = np.random.default_rng(seed)
    wind, angle = np.abs(rng.normal(1.0, 0.3, rows)), 0.3 * rng.normal(size=rows)
    power = np.zeros(rows)
    for k in range(1, rows):
        drive = wind[k - 1] ** 3 * (1 - 2 * angle[k - 1] ** 2)
        power[k] = 0.8 * power[k - 1] + 0.2 * drive + 0.002 * rng.normal()
    return oa.Record.from_arrays(
        u=np.stack([wind, angle], axis=1),
        y=power,
        sampling_time=1.0,
        inputs=["wind", "angle"],
        outputs=["power"],
    )


TERMS = [oa.Term("a", "power[k-1]"), oa.Term("b", "wind[k-1]**3")]


def unread(fit):
    return [one.text for one in fit.diagnose().warnings if one.code == "unread_input"]


def test_an_input_that_nothing_reads_is_said_and_would_help_a_learner():
    fit = oa.estimate(turbine(), oa.Baseline.from_terms(TERMS), learner=None)
    assert fit.problem.unread == ("angle",)
    (text,) = unread(fit)
    assert text.startswith("angle is an input of the data, but neither the physics nor the learner")
    (change,) = [one for one in fit.diagnose().residuals.changes if one.kind == "learner"]
    assert change.what == "a learner that also sees angle[k-1]"
    assert change.fall > 0.5


def test_an_input_that_the_learner_reads_is_not():
    fit = oa.estimate(
        turbine(),
        oa.Baseline.from_terms(TERMS),
        learner=oa.Terms(("wind[k-1]**3*angle[k-1]**2",)),
    )
    assert fit.problem.unread == ()
    assert unread(fit) == []


def test_a_reference_is_read_by_the_controller():
    motion = oa.Motion.from_equations(
        states=[oa.State("x", "u - a*x", start="y")],
        outputs=[oa.Output("y", "x")],
        inputs=["u"],
        parameters=[oa.PhysicalParameter("a", 1.0, min=0)],
    )
    assert motion.unread == ()
    controller = oa.Controller.pid("u", "r", "y", Kp=1.0)
    loop = close_loop(motion, controller, ["r", "other"], ["y"])
    assert loop.unread == ("other",)
