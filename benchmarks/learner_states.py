"""A static learner and one with states of its own, on the same physics and rows, in free run.

Measured sets in their official protocols: Bouc-Wen (Noël and Schoukens 2016, simulated, trained on
its multisine, tested on multisine and sine sweep without noise), a magneto-rheological damper, as a
lag with the learner in its equation and as linear damping and inertia with the learner beside the
force (`mr_damper_output`), and a simulated model car (every other run of its folder trains).
Prints RMSE and its share of the output's deviation on the tests, θ with intervals and processor
time; `python benchmarks/learner_states.py NAME [STATES ...]`, such as `f1tenth none 0 1`.

`maxwell` draws 40 records of a mass on a spring beside a Maxwell element that the physics lacks,
and counts how often the intervals of m and k contain the truth.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, field, replace
from typing import Any

import h5py
import numpy as np
from machine import data_folder
from scipy.io import loadmat

import orthaug as oa

DATA = data_folder()
ROWS = 8192  # of the multisine: one period


@dataclass(frozen=True)
class Case:
    """Records, physics and what its learner sees; `options` go to `oa.estimate`.

    `limits` are iterations by the learner's states, where the usual ones take many minutes.
    """

    train: oa.Record
    tests: dict[str, oa.Record]
    motion: oa.Motion
    inputs: tuple[str, ...]
    hidden: int = 12
    skip: int = 50
    options: dict[str, Any] = field(default_factory=dict)
    limits: dict[int, int] = field(default_factory=dict)


def bouc_wen() -> Case:
    """Return records and the linear oscillator of m = 2 kg, with c and k to estimate."""

    def read(part: str, name: str, rows: slice = slice(None)) -> oa.Record:
        with h5py.File(DATA / "bouc_wen" / f"{part}.h5") as file:
            u, y = (np.asarray(file[name][key]).ravel()[rows] for key in ("u", "y"))
            step = 1 / float(np.asarray(file[name]["fs"]).ravel()[0])
        channels = {"inputs": ["force"], "outputs": ["position"]}
        # in mm, so that states have sizes near those of the inputs
        return oa.Record.from_arrays(u, 1000 * y, sampling_time=step, **channels)

    train = read("train", "multisine", slice(0, ROWS))
    tests = {name: read("test", name) for name in ("multisine", "sinesweep")}
    motion = oa.Motion.from_equations(
        [
            oa.State("x", "v", "position"),
            oa.State("v", "(1000*force - c*v - k*x)/m", "derivative of position", learned=True),
        ],
        [oa.Output("position", "x")],
        [
            oa.PhysicalParameter("c", 10.0, "N s/m", min=0),
            oa.PhysicalParameter("k", 8e4, "N/m", min=0),
        ],
        ["force"],
        constants={"m": 2.0},
        hold="first-order",
    )
    return Case(train, tests, motion, ("v",))


def damper_rows(rows: slice) -> oa.Record:
    """Return rows of the damper's record."""
    table = loadmat(DATA / "mr_damper" / "damper.mat")
    u, y = (table[name].ravel()[rows] for name in ("X", "y"))
    channels = {"inputs": ["velocity"], "outputs": ["force"]}
    return oa.Record.from_arrays(u, y, sampling_time=0.005, **channels)


def mr_damper() -> Case:
    """Return records and a damper that is linear, with the inertia of its oil."""
    motion = oa.Motion.from_equations(
        [oa.State("f", "(viscous*velocity + offset - f)/lag", "force", learned=True)],
        [oa.Output("force", "f")],
        [
            oa.PhysicalParameter("viscous", -3.0, "N s/cm"),
            oa.PhysicalParameter("offset", 0.0, "N"),
            oa.PhysicalParameter("lag", 0.02, "s", min=0),
        ],
        ["velocity"],
        hold="first-order",
    )
    train, tests = damper_rows(slice(0, 2000)), {"rest": damper_rows(slice(2000, 3499))}
    return Case(train, tests, motion, ("f", "velocity"))


def mr_damper_output() -> Case:
    """Return records and a linear damper with inertia, whose force the learner is added to.

    The acceleration is that of a velocity behind a lag of 20 ms.
    """
    motion = oa.Motion.from_equations(
        [oa.State("s", "(velocity - s)/0.02", 0.0)],
        [oa.Output("force", "viscous*velocity + inertia*(velocity - s) + offset", learned=True)],
        [
            oa.PhysicalParameter("viscous", -3.0, "N s/cm"),
            oa.PhysicalParameter("inertia", 0.0, "N s/cm"),
            oa.PhysicalParameter("offset", 0.0, "N"),
        ],
        ["velocity"],
        hold="first-order",
    )
    return replace(mr_damper(), motion=motion, inputs=("velocity",), hidden=8, skip=0)


def f1tenth() -> Case:
    """Return records and a single-track car of linear tyres and a linear drive train."""

    def read(part: str, every: int = 1) -> oa.Record:
        runs = []
        for path in sorted((DATA / "f1tenth" / part).glob("*.csv"))[::every]:
            table = np.genfromtxt(path, delimiter=",", names=True)
            u, y = (np.stack([table[name] for name in names], 1) for names in (inputs, outputs))
            channels = {"inputs": inputs, "outputs": outputs}
            runs.append(oa.Record.from_arrays(u, y, sampling_time=0.025, **channels))
        return replace(runs[0], experiments=tuple(run.experiments[0] for run in runs))

    inputs, outputs = ["delta", "d"], ["v_long", "v_lat", "yaw_rate"]
    initial = {"pull": 15.0, "drag": 2.0, "cf": 20.0, "cr": 20.0, "turn": 30.0}
    drive = "pull*d - drag*vx + w*vy - front*sin(delta)"
    motion = oa.Motion.from_equations(
        [
            oa.State("vx", drive, "v_long", learned=True),
            oa.State("vy", "front*cos(delta) + rear - w*vx", "v_lat", learned=True),
            oa.State("w", "turn*(lf*front*cos(delta) - lr*rear)", "yaw_rate", learned=True),
        ],
        [oa.Output("v_long", "vx"), oa.Output("v_lat", "vy"), oa.Output("yaw_rate", "w")],
        [oa.PhysicalParameter(name, at, min=0) for name, at in initial.items()],
        inputs,
        constants={"lf": 0.163, "lr": 0.168},
        define={
            "speed": "max(vx, 0.3)",
            "front": "cf*(delta - (vy + lf*w)/speed)",
            "rear": "cr*(lr*w - vy)/speed",
        },
        substeps=2,
    )
    seen, tests = ("vx", "vy", "w", *inputs), {"official": read("test")}
    options, limits = {"criterion": oa.Simulation(segment=100)}, {0: 60, 1: 40, 2: 40}
    return Case(read("train", 2), tests, motion, seen, skip=0, options=options, limits=limits)


def maxwell(seed: int) -> tuple[oa.Record, oa.Record, oa.Motion]:
    """Return 40 s and 20 s of a mass of 1 kg on 4 N/m, with a force that forgets within 0.25 s.

    The position of the first has noise of 1 % of its deviation.
    """
    rows, step, substeps = 3000, 0.02, 4
    rng = np.random.default_rng(seed)
    spectrum = np.fft.rfft(rng.standard_normal(rows))
    spectrum[np.fft.rfftfreq(rows, step) > 2.5] = 0
    force = np.fft.irfft(spectrum, rows)
    force *= 2 / force.std()

    def rates(s: np.ndarray, u: float) -> np.ndarray:
        return np.array([s[1], u - 0.6 * s[1] - 4 * s[0] - s[2], (1.5 * s[1] - s[2]) / 0.25])

    state, position, h = np.zeros(3), np.zeros(rows), step / substeps
    for i in range(rows):
        position[i] = state[0]
        for _ in range(substeps):
            a = rates(state, force[i])
            b = rates(state + h / 2 * a, force[i])
            c = rates(state + h / 2 * b, force[i])
            d = rates(state + h * c, force[i])
            state = state + h / 6 * (a + 2 * b + 2 * c + d)
    noisy = position + 0.01 * position.std() * rng.standard_normal(rows)
    channels = {"inputs": ["force"], "outputs": ["position"]}
    train = oa.Record.from_arrays(force[:2000], noisy[:2000], sampling_time=step, **channels)
    test = oa.Record.from_arrays(force[2000:], position[2000:], sampling_time=step, **channels)
    motion = oa.Motion.from_equations(
        [
            oa.State("x", "v", "position"),
            oa.State("v", "(force - c*v - k*x)/m", "derivative of position", learned=True),
        ],
        [oa.Output("position", "x")],
        [
            oa.PhysicalParameter("m", 1.2, "kg", min=0),
            oa.PhysicalParameter("c", 0.5, "N s/m", min=0),
            oa.PhysicalParameter("k", 3.5, "N/m", min=0),
        ],
        ["force"],
    )
    return train, test, motion


def cover(draws: int = 40) -> None:
    """Print how often the intervals of m and k hold, and the median error of the free run."""
    true, held, errors = {"m": 1.0, "k": 4.0}, {"m": 0, "k": 0}, []
    for seed in range(draws):
        train, test, motion = maxwell(seed)
        fit = oa.estimate(train, motion, learner=oa.MLP((8,), inputs=("v",), states=1), seed=seed)
        for name, value in true.items():
            row = fit.parameters.loc[name]
            held[name] += bool(row["ci95_low"] <= value <= row["ci95_high"])
        (run,) = fit.model.simulate(test).trajectories
        errors.append(float(np.sqrt(np.mean(run.errors**2)) / test.experiments[0].outputs.std()))
    print(f"maxwell    of {draws} draws held: m {held['m']}, k {held['k']}; ", end="")
    print(f"free run {100 * np.median(errors):.2f} % of the output's deviation (median)")


SETS = {
    "bouc_wen": bouc_wen,
    "mr_damper": mr_damper,
    "mr_damper_output": mr_damper_output,
    "f1tenth": f1tenth,
}


def score(fit: Any, record: oa.Record, skip: int) -> str:
    """Return the RMSE of the free run on all experiments, and its share of the deviation."""
    errors = np.concatenate([run.errors[skip:] for run in fit.model.simulate(record).trajectories])
    size = np.concatenate([one.outputs[skip:] for one in record.experiments]).std(axis=0)
    rmse = np.sqrt(np.nanmean(errors**2, axis=0))
    return ", ".join(f"{e:.4g} ({100 * e / s:.1f} %)" for e, s in zip(rmse, size, strict=True))


def compare(name: str, learners: list[int | None]) -> None:
    """Print what each learner of a set reaches; None is physics alone."""
    case = SETS[name]()
    for states in learners:
        learner = None
        if states is not None:
            learner = oa.MLP((case.hidden,), inputs=case.inputs, states=states)
        fixed = {"learner": learner, "blocks": 0, "fallback": False}
        if states in case.limits:
            fixed["solver"] = oa.LevenbergMarquardt(iterations=case.limits[states])
        began = time.process_time()
        fit = oa.estimate(case.train, case.motion, **fixed, **case.options)
        spent = time.process_time() - began
        kind = "physics alone" if states is None else f"learner of {states} states"
        print(f"{name} {kind}: {fit.status.code}, {spent:.0f} s")
        for test, record in case.tests.items():
            print(f"    {test}: {score(fit, record, case.skip)}")
        print(fit.parameters[["value", "ci95_low", "ci95_high"]].to_string(), flush=True)


def main(arguments: list[str]) -> None:
    """Print a block for physics alone, the static learner, and learners with states."""
    names = [one for one in arguments if one in SETS]
    chosen = [one for one in arguments if one == "none" or one.isdigit()]
    if not arguments or "maxwell" in arguments:
        cover()
    learners = [None if one == "none" else int(one) for one in chosen] or [None, 0, 1, 2]
    for name in names if arguments else SETS:
        compare(name, learners)


if __name__ == "__main__":
    main(sys.argv[1:])
