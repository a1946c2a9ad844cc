"""A static learner and one with states of its own, on the same physics and rows, in free run.

Measured sets in their official protocols: Bouc-Wen (Noël and Schoukens 2016, simulated, trained on
its multisine, tested on multisine and sine sweep without noise) and a magneto-rheological damper.
Prints RMSE on the tests and the time; `python benchmarks/learner_states.py [bouc_wen] [mr_damper]`.

`maxwell` draws 40 records of a mass on a spring beside a Maxwell element that the physics lacks,
and counts how often the intervals of m and k contain the truth.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import h5py
import numpy as np
from scipy.io import loadmat

import orthaug as oa

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
ROWS = 8192  # of the multisine: one period


def bouc_wen() -> tuple[oa.Record, dict[str, oa.Record], oa.Motion, tuple[str, ...]]:
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
    return train, tests, motion, ("v",)


def mr_damper() -> tuple[oa.Record, dict[str, oa.Record], oa.Motion, tuple[str, ...]]:
    """Return records and a damper that is linear, with the inertia of its oil."""
    table = loadmat(DATA / "mr_damper" / "damper.mat")
    u, y = (table[name].ravel() for name in ("X", "y"))

    def part(rows: slice) -> oa.Record:
        channels = {"inputs": ["velocity"], "outputs": ["force"]}
        return oa.Record.from_arrays(u[rows], y[rows], sampling_time=0.005, **channels)

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
    return part(slice(0, 2000)), {"rest": part(slice(2000, 3499))}, motion, ("f", "velocity")


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


SETS = {"bouc_wen": bouc_wen, "mr_damper": mr_damper}


def main(names: list[str]) -> None:
    """Print a line for physics alone, the static learner, and learners with states."""
    if not names or "maxwell" in names:
        cover()
    for name in [one for one in names or SETS if one in SETS]:
        train, tests, motion, inputs = SETS[name]()
        for states in (None, 0, 1, 2):
            learner = None if states is None else oa.MLP((12,), inputs=inputs, states=states)
            began = time.perf_counter()
            fit = oa.estimate(train, motion, learner=learner, blocks=0, fallback=False)
            spent = time.perf_counter() - began
            found = []
            for test, record in tests.items():
                (run,) = fit.model.simulate(record).trajectories
                rmse = float(np.sqrt(np.nanmean(run.errors[50:] ** 2)))
                percent = 100 * (1 - rmse / float(np.std(record.experiments[0].outputs[50:])))
                found.append(f"{test} {rmse:.4g} ({percent:.1f} %)")
            kind = "physics alone" if states is None else f"learner of {states} states"
            print(f"{name:10} {kind:20} {'  '.join(found):50} {fit.status.code} {spent:.0f} s")


if __name__ == "__main__":
    main(sys.argv[1:])
