"""Do intervals of parameters in FMUs and mechanisms hold the truth where a learner is left what they lack?

Three FMUs for Model Exchange and two mechanisms of MuJoCo, each without a term that the simulated plant has: friction, or
a loss of heat, that a learner takes up. A row is a parameter: `held`: its interval, the one with the bias where there is
one, holds the truth; `open`: none is shown, or it is not determined; `silent`: the truth is outside of all that are shown,
and the fit does not warn that its learner is silent or its parameters are not identified. No test of the residual is
asked, which could only warn of more. Beside it the physics alone by
`scipy.optimize.least_squares` on the same rows, simulated by FMPy or MuJoCo itself from the true start.
Run: python benchmarks/coverage_sources.py [draws of FMUs, default 20] [of mechanisms, default 10] [words of a system];
with the word "equations" the same physics by equations is fitted instead, which is faster. A process for each system.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from draws import seeds
from fmus import THERMAL, Plant
from machine import describe
from scipy.optimize import least_squares
from scipy.stats import t as student
from test_mujoco import ARM, CART, HEAD, arm, cart

import orthaug as oa
from orthaug._base.jax import jnp

Field = Callable[[np.ndarray, np.ndarray], np.ndarray]
WARNED = {"learner_silent", "not_identified"}
OSCILLATOR = Plant(
    {"x": 1.0, "v": 0.0},
    {"osc.mu": 'start="0.5"', "osc.k": 'start="1.2" min="0"'},
    ("drive",),
    ("y",),
    "dx[0] = x[1]; dx[1] = p[0]*(1 - x[0]*x[0])*x[1] - p[1]*x[0] + u[0]; y[0] = x[0];",
)
PENDULUM = Plant(
    {"angle": 0.0, "speed": 0.0},
    {
        "J": 'start="0.06" min="0" unit="kg m2"',
        "mgl": 'start="1.2" min="0" unit="N m"',
        "d": 'start="0.05" min="0" unit="N m s/rad"',
    },
    ("torque",),
    ("phi",),
    "dx[0] = x[1]; dx[1] = (u[0] - p[2]*x[1] - p[1]*csin(x[0]))/p[0]; y[0] = x[0];",
    ("kg m2", "N m", "N m s/rad"),
)


class Case(NamedTuple):
    """A plant with all its terms, and the file that lacks one."""

    source: Callable[[Path], Any]
    """The physics to be fitted, from a file that it writes into a folder."""
    field: Field
    """ẋ of the plant itself."""
    start: tuple[float, ...]
    inputs: dict[str, tuple[float, float, int]]
    """Limits and rows of each input's steps."""
    outputs: dict[str, int]
    """The states that the channels measure."""
    truth: dict[str, float]
    sees: tuple[str, ...]
    step: float
    rows: int = 100
    noise: float = 0.01
    """Of the outputs, over their deviation."""
    neurons: int = 3


def fmu(plant: Plant, outputs: dict[str, str], learned: str) -> Callable[[Path], Any]:
    """Return what compiles an FMU and declares it."""

    def source(folder: Path) -> Any:
        keys = {"parameters": tuple(plant.parameters), "outputs": outputs, "learned": (learned,)}
        return oa.FMU(file=str(plant.build(folder / "plant.fmu")), substeps=1, **keys)

    return source


def mechanism(body: str, parameters: tuple[str, ...], *learned: str) -> Callable[[Path], Any]:
    """Return what writes a mechanism and declares it, with a learner of forces."""

    def source(folder: Path) -> Any:
        (folder / "mechanism.xml").write_text(HEAD + body)
        keys = {"parameters": parameters, "learned": learned, "substeps": 2}
        return oa.MuJoCo(file=str(folder / "mechanism.xml"), **keys)

    return source


def oscillator(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Van der Pol's oscillator with friction."""
    rub = 0.4 * np.tanh(x[1] / 0.2)
    return np.array([x[1], 0.8 * (1 - x[0] ** 2) * x[1] - x[0] + u[0] - rub])


def network(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """A room and its wall, which also loses heat by the square of its temperature above 15."""
    between = 1.4 * (x[1] - x[0])
    lost = 0.7 * (x[0] - u[1]) + 0.02 * max(x[0] - 15, 0.0) ** 2
    return np.array([(between - lost) / 4, (u[0] - between) / 2.5])


def pendulum(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """A pendulum with friction."""
    rub = 0.1 * np.tanh(x[1] / 0.5)
    return np.array([x[1], (u[0] - 0.03 * x[1] - np.sin(x[0]) - rub) / 0.05])


def two_links(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The arm with friction in its shoulder."""
    rub = 0.5 * np.tanh(x[2] / 0.3)
    return np.concatenate([x[2:], arm(x, [u[0] - rub, u[1]], 0.9, 0.3, 1.0)])


def cart_pole(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The cart and pole with friction of the cart, which its actuator has a gear of 2 against."""
    return np.concatenate([x[2:], cart(x, u[0] - 0.2 * np.tanh(x[2] / 0.1), 0.5, 0.08)])


CASES = {
    "FMU, van der Pol": Case(
        fmu(OSCILLATOR, {"y": "x"}, "v"),
        oscillator,
        (1.0, 0.0),
        {"drive": (-1.5, 1.5, 10)},
        {"y": 0},
        {"osc.mu": 0.8, "osc.k": 1.0},
        ("v",),
        0.1,
        200,
    ),
    "FMU, thermal network": Case(
        fmu(THERMAL, {"room": "room.T", "wall": "wall.T"}, "wall.T"),
        network,
        (20.0, 21.0),
        {"heat": (0, 20, 10), "outside": (-5, 15, 15)},
        {"room": 1, "wall": 0},
        {"wall.C": 4.0, "room.C": 2.5, "loss.G": 0.7, "contact.G": 1.4},
        ("wall_T",),
        0.2,
    ),
    "FMU, pendulum": Case(
        fmu(PENDULUM, {"phi": "angle"}, "speed"),
        pendulum,
        (0.0, 0.0),
        {"torque": (-0.8, 0.8, 7)},
        {"phi": 0},
        {"J": 0.05, "mgl": 1.0, "d": 0.03},
        ("speed",),
        0.03,
        200,
    ),
    "MuJoCo, two-link arm": Case(
        mechanism(ARM, ("lower.mass", "shoulder.damping"), "shoulder.torque", "elbow.torque"),
        two_links,
        (0.3, -0.2, 0.0, 0.0),
        {"first": (-4, 4, 15), "second": (-0.5, 0.5, 10)},
        {"shoulder": 0, "elbow": 1},
        {"lower.mass": 0.9, "shoulder.damping": 0.3},
        ("shoulder_velocity", "elbow_velocity"),
        0.02,
        200,
        neurons=8,
    ),
    "MuJoCo, cart and pole": Case(
        mechanism(CART, ("pole.mass", "hinge.damping"), "slider.force", "hinge.torque"),
        cart_pole,
        (0.0, 0.5, 0.0, 0.0),
        {"push": (-2, 2, 15)},
        {"slider": 0, "hinge": 1},
        {"pole.mass": 0.5, "hinge.damping": 0.08},
        ("slider_velocity", "hinge_velocity"),
        0.02,
        200,
        neurons=8,
    ),
}


def motion(rates: dict[str, tuple[str, Any]], outputs: dict[str, str], initial: dict[str, float],
           inputs: tuple[str, ...], *learned: str) -> oa.Motion:  # fmt: skip
    """Return the equations of a file as a motion; `rates` has the derivative and start of each state."""
    return oa.Motion.from_equations(
        [oa.State(name, rate, start, name in learned) for name, (rate, start) in rates.items()],
        [oa.Output(name, state) for name, state in outputs.items()],
        [
            oa.PhysicalParameter(name, value, min=-np.inf if name == "mu" else 0.0)
            for name, value in initial.items()
        ],
        inputs,
        substeps=1,
    )


def arm_inertia(x: Any, p: Any) -> tuple[Any, Any, Any]:
    """Return the entries h11, h12, h22 of the arm's mass matrix."""
    mass, bend = p[0], 0.15 * p[0] * jnp.cos(x[1])
    h22 = 0.04 + 0.0625 * mass
    return 0.205 + 0.4225 * mass + 2 * bend, 0.02 + 0.0625 * mass + bend, h22


def arm_forces(x: Any, u: Any, p: Any) -> tuple[Any, Any]:
    """Return all torques of the arm but those of inertia."""
    (a, b, da, db), (mass, damping) = x, p
    bend, falls = 0.15 * mass * jnp.sin(b), 0.25 * 9.81 * mass * jnp.sin(a + b)
    first = u[0] + bend * (2 * da * db + db**2) - falls - damping * da
    first = first - (0.45 + 0.6 * mass) * 9.81 * jnp.sin(a)
    return first, 3 * u[1] - bend * da**2 - falls - 0.1 * db - 0.4 * b


def cart_inertia(x: Any, p: Any) -> tuple[Any, Any, Any]:
    """Return the entries h11, h12, h22 of the mass matrix of cart and pole."""
    return 1 + p[0], 0.5 * p[0] * jnp.cos(x[1]), 0.25 * p[0] + 0.04


def cart_forces(x: Any, u: Any, p: Any) -> tuple[Any, Any]:
    """Return the force on the cart and the torque on the pole, but those of inertia."""
    (_, a, v, w), (mass, damping) = x, p
    push = 2 * u[0] - 0.3 * v + 0.5 * mass * jnp.sin(a) * w**2
    return push, -0.5 * 9.81 * mass * jnp.sin(a) - damping * w


def mechanism_by_hand(
    inertia: Callable[..., Any],
    forces: Callable[..., Any],
    learned: tuple[str, str],
    initial: tuple[float, float],
    *inputs: str,
) -> oa.Motion:
    """Return a mechanism of two joints whose mass and damping are sought."""

    def rates(x: Any, u: Any, p: Any) -> Any:
        (h11, h12, h22), (first, second) = inertia(x, p), forces(x, u, p)
        across = h11 * h22 - h12 * h12
        turned = (h22 * first - h12 * second) / across, (h11 * second - h12 * first) / across
        return jnp.stack([x[2], x[3], *turned])

    def matrix(x: Any, p: Any) -> Any:
        h11, h12, h22 = inertia(x, p)
        return jnp.array([[h11, h12], [h12, h22]])

    joints = [name.split(".")[0] for name in learned]
    named = tuple((name.replace(".", "_"), "N" if "force" in name else "N m") for name in learned)
    return oa.Motion.from_functions(
        rates,
        lambda x, u, p: x[:2],
        [
            *(oa.State(joint, None, joint) for joint in joints),
            *(oa.State(f"{joint}_velocity", None, 0.0, learned=True) for joint in joints),
        ],
        joints,
        [
            oa.PhysicalParameter(name, value, min=0.0)
            for name, value in zip(("mass", "damping"), initial, strict=True)
        ],
        inputs,
        substeps=2,
        mass=oa.MassMatrix(matrix, (2, 3), named),
    )


EQUATIONS: dict[str, Callable[[], oa.Motion]] = {
    "FMU, van der Pol": lambda: motion(
        {"x": ("v", "y"), "v": ("mu*(1 - x*x)*v - k*x + drive", 0.0)},
        {"y": "x"},
        {"mu": 0.5, "k": 1.2},
        ("drive",),
        "v",
    ),
    "FMU, thermal network": lambda: motion(
        {
            "wall_T": ("(Gc*(room_T - wall_T) - Gl*(wall_T - outside))/Cw", "wall"),
            "room_T": ("(heat - Gc*(room_T - wall_T))/Cr", "room"),
        },
        {"room": "room_T", "wall": "wall_T"},
        {"Cw": 5.0, "Cr": 2.0, "Gl": 0.5, "Gc": 1.0},
        ("heat", "outside"),
        "wall_T",
    ),
    "FMU, pendulum": lambda: motion(
        {"angle": ("speed", "phi"), "speed": ("(torque - d*speed - mgl*sin(angle))/J", 0.0)},
        {"phi": "angle"},
        {"J": 0.06, "mgl": 1.2, "d": 0.05},
        ("torque",),
        "speed",
    ),
    "MuJoCo, two-link arm": lambda: mechanism_by_hand(
        arm_inertia, arm_forces, ("shoulder.torque", "elbow.torque"), (0.8, 0.2), "first", "second"
    ),
    "MuJoCo, cart and pole": lambda: mechanism_by_hand(
        cart_inertia, cart_forces, ("slider.force", "hinge.torque"), (0.4, 0.05), "push"
    ),
}
"""The same physics by equations: fits are equal to seven digits, and faster."""


class Row(NamedTuple):
    """A line of the table; shares of draws, median width and mean error of physics alone in per cent."""

    system: str
    parameter: str
    draws: int
    held: float
    open: float
    silent: float
    width: float
    alone: float
    covered: float
    """How often the interval of least squares holds the truth."""


def drawn(case: Case, seed: int) -> oa.Record:
    """Return a draw of inputs and noise, by Runge-Kutta in 10 steps a sample."""
    rng, h = np.random.default_rng(seed), case.step / 10
    u = np.stack(
        [
            np.repeat(rng.uniform(low, high, -(-case.rows // hold)), hold)[: case.rows]
            for low, high, hold in case.inputs.values()
        ],
        axis=1,
    )
    x, found = np.array(case.start), []
    for now in u:
        found.append(x)
        for _ in range(10):
            a = case.field(x, now)
            b = case.field(x + h / 2 * a, now)
            c = case.field(x + h / 2 * b, now)
            x = x + h / 6 * (a + 2 * b + 2 * c + case.field(x + h * c, now))
    y = np.array(found)[:, [*case.outputs.values()]]
    y = y + case.noise * y.std(axis=0) * rng.normal(size=y.shape)
    names = {"inputs": [*case.inputs], "outputs": [*case.outputs]}
    return oa.Record.from_arrays(u, y, sampling_time=case.step, **names)


def by_fmpy(case: Case, source: Any, record: oa.Record) -> Callable[[np.ndarray], np.ndarray]:
    """Return the outputs of the FMU by its parameters, as FMPy simulates it with CVode."""
    from fmpy import simulate_fmu

    u = record.experiments[0].inputs
    step, samples = case.step, case.step * np.arange(len(u))
    # twice at each instant, so that inputs jump there
    instants = step * np.repeat(np.arange(len(u) + 1), 2)[1:-1]
    fields = [("time", float), *((name, float) for name in case.inputs)]
    signals = np.array([*zip(instants, *np.repeat(u, 2, axis=0).T, strict=True)], dtype=fields)
    folder, described = source.unit.folder, source.unit.description
    keys = {"output": [*case.outputs], "output_interval": step, "stop_time": samples[-1]}

    def outputs(p: np.ndarray) -> np.ndarray:
        found = simulate_fmu(
            str(folder),
            model_description=described,
            start_values=dict(zip(case.truth, p, strict=True)),
            input=signals,
            relative_tolerance=1e-8,
            **keys,
        )
        # with rows of its own where inputs jump
        seen = [np.interp(samples, found["time"], found[name]) for name in case.outputs]
        return np.stack(seen, axis=1)

    return outputs


def by_mujoco(case: Case, source: Any, record: oa.Record) -> Callable[[np.ndarray], np.ndarray]:
    """Return the positions of the joints by parameters, as MuJoCo itself integrates them."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(source.file)
    model.opt.integrator, model.opt.timestep = mujoco.mjtIntegrator.mjINT_RK4, case.step / 4
    places = [source.mechanism.places[name] for name in case.truth]
    half = len(case.start) // 2

    def outputs(p: np.ndarray) -> np.ndarray:
        for place, value in zip(places, p, strict=True):
            getattr(model, place.array)[place.index] = value
        data, found = mujoco.MjData(model), []
        data.qpos[:], data.qvel[:] = case.start[:half], case.start[half:]
        for u in record.experiments[0].inputs:
            found.append(data.qpos.copy())
            data.ctrl[:] = u
            mujoco.mj_step(model, data, 4)
        return np.array(found)

    return outputs


def physics_only(case: Case, source: Any, record: oa.Record) -> tuple[np.ndarray, np.ndarray]:
    """Return the estimates of least squares on the physics alone, and half their 95 % intervals."""
    outputs = (by_fmpy if isinstance(source, oa.FMU) else by_mujoco)(case, source, record)
    y = record.experiments[0].outputs
    initial = source.build([*case.inputs], [*case.outputs]).initial
    found = least_squares(
        lambda p: ((outputs(p) - y) / y.std(axis=0)).ravel(),
        initial,
        x_scale=np.abs(initial),
        diff_step=1e-4,
        bounds=(1e-3 * initial, 1e3 * initial),
    )
    freedom = y.size - len(initial)
    spread = np.linalg.inv(found.jac.T @ found.jac) * (2 * found.cost / freedom)
    return found.x, student.ppf(0.975, freedom) * np.sqrt(np.diag(spread))


def judged(fit: Any, index: int, true: float) -> tuple[bool, bool, bool, float]:
    """Return whether a parameter is held, open, silently missed, and its interval's width."""
    shown = None if fit.interval is None else fit.interval[index]
    budget = None if shown is None else oa.bias_budget(fit)
    counted = None if budget is None else budget.of(fit.parameters.index[index])
    limits = shown if counted is None else counted.ci95
    if limits is None or not np.isfinite(limits).all():
        return False, True, False, np.nan
    inside = bool(limits[0] <= true <= limits[1])
    warned = bool({warning.code for warning in fit.warnings} & WARNED)
    silent = not inside and not warned and not shown[0] <= true <= shown[1]
    return inside, False, silent, 100 * float(limits[1] - limits[0]) / abs(true)


def one_draw(case: Case, source: Any, seed: int, physics: Any = None) -> list[tuple[float, ...]]:
    """Return what is found of each parameter: `judged`, and the error of physics alone.

    `physics` is fitted instead of the source.
    """
    record = drawn(case, seed)
    alone, half = physics_only(case, source, record)
    learner = oa.MLP((case.neurons,), inputs=case.sees)
    fit = oa.estimate(record, physics or source, learner=learner, seed=seed, blocks=0)
    return [
        (*judged(fit, i, true), 100 * (alone[i] / true - 1), abs(alone[i] - true) <= half[i])
        for i, true in enumerate(case.truth.values())
    ]


def summed(system: str, found: list[list[tuple[float, ...]]]) -> list[Row]:
    """Return the lines of a system from its draws."""
    lines = []
    for name, draws in zip(CASES[system].truth, zip(*found, strict=True), strict=True):
        held, opened, silent, width, alone, covered = np.array(draws, dtype=float).T
        middle = float(np.nanmedian(width)) if np.isfinite(width).any() else np.nan
        shares = [100 * float(part.mean()) for part in (held, opened, silent)]
        figures = (*shares, middle, float(alone.mean()), 100 * float(covered.mean()))
        lines.append(Row(system, name, len(draws), *figures))
    return lines


def measure(system: str, draws: int, equations: bool) -> list[Row]:
    """Return the lines of a system."""
    case = CASES[system]
    physics = EQUATIONS[system]() if equations and system in EQUATIONS else None
    with tempfile.TemporaryDirectory() as folder:
        source = case.source(Path(folder))
        found = [one_draw(case, source, seed, physics) for seed in seeds(draws, system)]
        return summed(system, found)


def main(fmus: int = 20, mechanisms: int = 10, *words: str) -> None:
    """Print the table."""
    print(describe())
    began = time.perf_counter()
    print("\n| system | parameter | draws | held | not determined | silent | width | physics alone: "
          "error | covers |\n" + 9 * "|---" + "|")  # fmt: skip
    equations = "equations" in words
    asked = [name for name in CASES if all(w in name for w in words if w != "equations")]
    spawned = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(os.cpu_count(), spawned, max_tasks_per_child=1) as processes:
        made = [
            processes.submit(
                measure, name, fmus if name.startswith("FMU") else mechanisms, equations
            )
            for name in asked
        ]
        for row in (row for one in made for row in one.result()):
            share = " | ".join(f"{value:.0f} %" for value in (row.held, row.open, row.silent))
            width = "" if np.isnan(row.width) else f"{row.width:.2g} %"
            alone = f"{row.alone:+.1f} % | {row.covered:.0f} %"
            line = f"{row.system} | {row.parameter} | {row.draws} | {share} | {width} | {alone}"
            print(f"| {line} |", flush=True)
    print(f"\n{(time.perf_counter() - began) / 60:.1f} min")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:3]), *sys.argv[3:])
