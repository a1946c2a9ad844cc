"""Motions with process noise: innovations beside the free run, in coverage, bias and time.

A mass, spring and damper of one measured position: white force noise, held over a sample, and white
sensor noise; alone, and with friction that a learner of the velocity takes up. Its damping is then
that of the physics nearest to the true system over the true states.
Run: python benchmarks/innovations.py [draws, default 60] [draws with a learner, default 20]
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from machine import describe
from scipy.linalg import expm
from scipy.optimize import least_squares

import orthaug as oa
from orthaug.fitting.initial_states import Start
from orthaug.fitting.innovations import InnovationsTask
from orthaug.fitting.motion_task import MotionTask
from orthaug.models.learners import declared
from orthaug.models.rows import InMemory
from orthaug.physics.innovations import innovations_form
from orthaug.physics.learner_states import LearnerStates
from orthaug.physics.problem import pose_motion

ROWS, TS, FINER = 3000, 0.05, 5
TRUE = {"m": 1.0, "c": 0.8, "k": 10.0}
PROCESS, SENSOR, FRICTION, SHARP = 1.0, 0.02, 0.6, 4.0
LEARNER = oa.MLP(hidden=(8,), inputs=("v",))
WHOLE = oa.Simulation(segment=0, washout=0)


class Draw(NamedTuple):
    """A record, and the parameters that its fit should find."""

    record: oa.Record
    truth: np.ndarray


def motion_of(*, learned: bool) -> oa.Motion:
    """Return the physics, with or without a learner in the equation of the velocity."""
    return oa.Motion.from_equations(
        states=[
            oa.State("x", "v", start="position"),
            oa.State("v", "(force - c*v - k*x)/m", start="derivative of position", learned=learned),
        ],
        outputs=[oa.Output("position", "x")],
        inputs=["force"],
        parameters=[
            oa.PhysicalParameter("m", 1.3, "kg", min=0),
            oa.PhysicalParameter("c", 1.0, "N s/m", min=0),
            oa.PhysicalParameter("k", 8.0, "N/m", min=0),
        ],
    )


def linear_step() -> tuple[np.ndarray, np.ndarray]:
    """Return the state's and the force's share of the state one sample later."""
    m, c, k = TRUE.values()
    whole = np.array([[0, 1, 0], [-k / m, -c / m, 1 / m], [0, 0, 0]])
    step = expm(whole * TS)
    return step[:2, :2], step[:2, 2]


def friction(v: Any) -> Any:
    """Return the force of the friction."""
    return FRICTION * np.tanh(SHARP * v)


def step(field: Any, x: np.ndarray, force: float, h: float) -> np.ndarray:
    """Return the state after a step of Runge and Kutta."""
    k1 = field(x, force)
    k2 = field(x + h / 2 * k1, force)
    k3 = field(x + h / 2 * k2, force)
    k4 = field(x + h * k3, force)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def draw(seed: int, *, rubs: bool) -> Draw:
    """Return a record of the true system with noise of a seed."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-10, 10, ROWS // 10), 10)
    pushed, noise = u + PROCESS * rng.normal(size=ROWS), SENSOR * rng.normal(size=ROWS)
    states, x, (a, b) = np.zeros((ROWS, 2)), np.zeros(2), linear_step()
    m, c, k = TRUE.values()

    def field(z: np.ndarray, force: float) -> np.ndarray:
        return np.array([z[1], (force - c * z[1] - k * z[0] - friction(z[1])) / m])

    for t in range(ROWS):
        states[t] = x
        if rubs:
            for _ in range(FINER):
                x = step(field, x, pushed[t], TS / FINER)
        else:
            x = a @ x + b * pushed[t]
    v = states[:, 1]
    truth = np.array([m, c + (friction(v) @ v / (v @ v) if rubs else 0.0), k])
    record = oa.Record.from_arrays(
        u, states[:, 0] + noise, inputs=["force"], outputs=["position"], sampling_time=TS
    )
    return Draw(record, truth)


def measure(draws: int, *, rubs: bool, noise: Any) -> str:
    """Return a line of the table."""
    off, held, widths, gone, began = [], [], [], 0, time.perf_counter()
    for seed in range(draws):
        record, truth = draw(2000 + seed, rubs=rubs)
        learner = LEARNER if rubs else None
        fit = oa.estimate(record, motion_of(learned=rubs), learner=learner, noise=noise)
        if fit.std is None or not np.isfinite(fit.std).all() or (rubs and not fit.learns):
            gone += 1
            continue
        off.append((fit.values - truth) / fit.std)
        low, high = np.asarray(fit.interval).T
        held.append((low <= truth) & (truth <= high))
        widths.append(fit.std)
    bias, covered = np.mean(off, axis=0), 100 * np.mean(held, axis=0)
    spread = np.std(off, axis=0)
    each = " | ".join(
        f"{bias[i]:+.2f}, {spread[i]:.2f}, {covered[i]:.0f} %" for i in range(len(TRUE))
    )
    seconds = (time.perf_counter() - began) / draws
    return (
        f"| {'friction, learner(v)' if rubs else 'none'} | {noise} | {len(off)} | {each} "
        f"| {covered.mean():.1f} | {np.median(widths, axis=0)[2]:.3g} | {gone} | {seconds:.1f} |"
    )


def innovations(p: np.ndarray, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the innovations of p = (m, c, k, K, start), by Runge and Kutta in NumPy."""
    (m, c, k), gain, x = p[:3], p[3:5], p[5:]
    found = np.zeros(len(y))

    def field(z: np.ndarray, force: float) -> np.ndarray:
        return np.array([z[1], (force - c * z[1] - k * z[0]) / m])

    for t, force in enumerate(u):
        found[t] = y[t] - x[0]
        x = step(field, x, force, TS) + gain * found[t]
    return found


def compare_with_scipy() -> str:
    """Return how far θ is from the minimum that SciPy finds of the same criterion in NumPy."""
    record = draw(2000, rubs=False).record
    u, y = record.experiments[0].inputs[:, 0], record.experiments[0].outputs[:, 0]
    solver = oa.LevenbergMarquardt(tolerance=1e-12)
    fit: Any = oa.estimate(
        record, motion_of(learned=False), learner=None, noise="innovations", criterion=WHOLE,
        solver=solver,
    )  # fmt: skip
    first = np.concatenate([fit.values, fit.model.noise.gain[:, 0], [y[0], 0.0]]) * 1.01
    tight: dict[str, Any] = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    there = least_squares(innovations, first, jac="3-point", x_scale="jac", args=(u, y), **tight)
    apart = np.abs(fit.values / there.x[:3] - 1).max()
    variance = 2 * there.cost / (len(y) - 5)
    std = np.sqrt(np.diag(np.linalg.inv(there.jac.T @ there.jac)) * variance)[:3]
    return (
        f"θ beside SciPy's minimum: {apart:.1e} relative; standard errors: "
        f"{np.abs(fit.std / std - 1).max():.1e}"
    )


def time_of_iteration(*, learned: bool) -> str:
    """Return the time of an iteration, trial and linearisation, with and without innovations."""
    record, motion = draw(2000, rubs=False).record, motion_of(learned=learned)
    learner = LEARNER if learned else None
    inputs, states = declared(learner).inputs, LearnerStates.of(learner)
    problem = pose_motion(record, motion, inputs, "auto", states)
    seconds, made = {}, []
    for name, kind, own in (("free run", MotionTask, motion), ("innovations", InnovationsTask, innovations_form(motion))):  # fmt: skip
        posed = replace(problem, motion=own.sampled(TS))
        task = kind.of(posed, learner, oa.Simulation(washout=0).on(record), InMemory())
        objective = task.plan.objective()
        w = 0.1 * np.random.default_rng(0).normal(size=task.bound.size)
        p = np.concatenate([own.coordinates.initial, w])
        states = task.plan.settle(own.coordinates.initial, w, iterations=30)
        made.append((name, objective, p, states))
        seconds[name] = np.inf
    for turn in range(12):  # the first one compiles
        for name, objective, p, states in made:
            began = time.perf_counter()
            objective.linearise(objective.evaluate(p, Start(states)))
            if turn:
                seconds[name] = min(seconds[name], time.perf_counter() - began)
    free, predicted = seconds["free run"], seconds["innovations"]
    return (
        f"an iteration {'with' if learned else 'without'} a learner: free run "
        f"{1e3 * free:.1f} ms, innovations {1e3 * predicted:.1f} ms, {predicted / free:.2f} times"
    )


def main() -> None:
    given = [int(one) for one in sys.argv[1:]]
    alone, beside = (*given, *(60, 20)[len(given) :])
    print(describe())
    print(compare_with_scipy(), flush=True)
    for learned in (False, True):
        print(time_of_iteration(learned=learned), flush=True)
    print(
        "| physics lacks | noise | draws | m: bias, spread, covered | c | k | covered (%) "
        "| standard error of k | without interval | s a fit |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for rubs, draws in ((False, alone), (True, beside)):
        for noise in ("white", "innovations"):
            if draws:
                print(measure(draws, rubs=rubs, noise=noise), flush=True)


if __name__ == "__main__":
    main()
