"""Generated problems of the collection that decides about defaults, and a positioning axis with its grey box.

40 oscillators or drives of second order whose physics lacks one effect, or none, each recorded under one difficulty;
six of them as equations of motion. The axis has a mass, viscous and Coulomb friction and an offset, and moves in closed
loop for 24 s; SciPy fits the right equations to the whole record as a reference. Everything is drawn from keyed seeds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from collection import AXIS, GENERATED, Problem
from scipy.optimize import least_squares
from scipy.signal import butter, lfilter

EFFECTS = (
    "nothing",
    "coulomb",
    "stribeck",
    "cubic",
    "drag",
    "dead zone",
    "backlash",
    "saturation",
    "hidden",
)
DIFFICULTIES = (
    "equation noise",
    "sensor noise",
    "closed loop",
    "drift",
    "quantisation",
    "integrator",
    "few rows",
)
LAGGED_PROBLEMS = 34
MOTION_PAIRS = (
    ("coulomb", "sensor noise"),
    ("stribeck", "integrator"),
    ("cubic", "quantisation"),
    ("drag", "closed loop"),
    ("nothing", "equation noise"),
    ("hidden", "few rows"),
)
SHARE = 0.4  # of the unmodelled effect, in the RMS of the force
_TS, _SUBSTEPS, _TEST_ROWS, _FEW = 0.05, 5, 1000, 150

MOTION = """
[motion.states]
x = { derivative = "v", start = "y" }
v = { derivative = "(u - c*v - k*x)/m", start = "derivative of y", learned = true }
[motion.outputs]
y = "x"
[motion.parameters]
m = { initial = 1.3, min = 0 }
c = { initial = 1.5, min = 0 }
k = { initial = 20.0, min = 0 }
[learner]
hidden = [6]
inputs = ["x", "v"]
"""
DRIVE = (
    MOTION.replace(" - k*x", "")
    .replace("k = { initial = 20.0, min = 0 }\n", "")
    .replace('"x", "v"', '"v"')
)


def _signal(random: np.random.Generator, rows: int, kind: int) -> np.ndarray:
    """An input of RMS 1: filtered noise, steps of random height and length, or a multisine."""
    if kind == 0:
        raw = lfilter(*butter(2, 0.15), random.standard_normal(rows + 100))[100:]
    elif kind == 1:
        raw = np.repeat(random.uniform(-1, 1, rows), random.integers(8, 40, rows))[:rows]
    else:
        time = np.arange(rows) * _TS
        raw = sum(
            np.sin(2 * np.pi * f * time + random.uniform(0, 7))
            for f in random.uniform(0.05, 2.0, 25)
        )
    return (raw - raw.mean()) / raw.std()


class Plant:
    """m y'' + c y' + k y = u of unit mass, with one effect that a linear model lacks."""

    def __init__(self, random: np.random.Generator, effect: str, integrator: bool) -> None:
        natural, damping = random.uniform(3, 7), random.uniform(0.1, 0.4)
        self.k, self.c = (0.0 if integrator else natural**2), 2 * damping * natural
        self.effect, self.size = effect, (1.0, 1.0)

    def scaled_by(self, states: np.ndarray) -> Plant:
        """Make effects of position and speed as strong as SHARE at the sizes they have without them."""
        self.size = tuple(states[:, :2].std(axis=0))
        return self

    def _force(self, x: float, v: float) -> float:
        x, v = x / self.size[0], v / self.size[1]
        if self.effect == "coulomb":
            return SHARE * np.tanh(v / 0.05)
        if self.effect == "stribeck":
            return SHARE * (0.6 + 0.6 * np.exp(-((v / 0.3) ** 2))) * np.tanh(v / 0.05)
        if self.effect == "cubic":
            return SHARE * x**3 / 2
        return SHARE * v * abs(v) / 1.5 if self.effect == "drag" else 0.0

    def _actuate(self, u: float, play: float) -> float:
        """Return the force of an actuator; `play` is where a backlash was before."""
        if self.effect == "dead zone":
            return u - min(max(u, -SHARE), SHARE)
        if self.effect == "saturation":
            return float(np.tanh(u))
        return min(max(play, u - SHARE / 2), u + SHARE / 2) if self.effect == "backlash" else u

    def run(
        self, command: Callable[[int, float], float], noise: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return states and inputs; `command` gives the input of a row from the position there."""
        x = v = z = play = 0.0
        step = _TS / _SUBSTEPS
        states, inputs = np.zeros((len(noise), 3)), np.zeros(len(noise))

        def slope(x: float, v: float, z: float, u: float) -> np.ndarray:
            acting = z if self.effect == "hidden" else u
            return np.array(
                [v, acting - self.c * v - self.k * x - self._force(x, v), (u - z) / (3 * _TS)]
            )

        for row in range(len(noise)):
            states[row], inputs[row] = (x, v, z), command(row, x)
            play = self._actuate(inputs[row], play)
            now = states[row]
            for _ in range(_SUBSTEPS):
                first = slope(*now, play + noise[row])
                now = now + step * slope(*(now + step / 2 * first), play + noise[row])
            x, v, z = now
        return states, inputs


def _record(
    plant: Plant, random: np.random.Generator, difficulty: str, wanted: np.ndarray
) -> np.ndarray:
    """Record inputs and outputs: `wanted` is the input, or in closed loop the reference in units of the position."""
    rows, size = len(wanted), plant.size[0]
    level = {"sensor noise": 0.1, "closed loop": 0.03, "few rows": 0.03}.get(difficulty, 0.003)
    sensor = level * size * random.standard_normal(rows)
    equation = random.standard_normal(rows) * (0.3 if difficulty == "equation noise" else 0.0)
    gain, rate, before = max(plant.k, 9.0), 2.0, 0.0

    def command(row: int, x: float) -> float:
        nonlocal before
        if difficulty != "closed loop":
            return wanted[row]
        seen = x + sensor[row]
        slope, before = (seen - before) / _TS, seen
        return gain * (size * wanted[row] - seen) - rate * slope

    states, inputs = plant.run(command, equation)
    output = states[:, 0] + sensor
    if difficulty == "drift":
        turns = np.linspace(0, random.uniform(0.4, 1.2), rows) + random.uniform(0, 1)
        output += 0.15 * size * np.sin(2 * np.pi * turns)
    if difficulty == "quantisation":
        output = np.round(output / (size / 8)) * (size / 8)
    return np.column_stack([inputs, output])


def oscillator(name: str, seed: int, effect: str, difficulty: str, as_motion: bool) -> Problem:
    """One of the 40; one test is alike, with an input like that of training, the other has a larger or another one."""
    random = np.random.default_rng([36, seed])
    rows = _FEW if difficulty == "few rows" else int(random.integers(600, 1500))
    kind = int(random.integers(3))
    plant = Plant(random, effect, difficulty == "integrator")
    linear = Plant(random, "nothing", False)
    linear.k, linear.c = plant.k, plant.c
    training = _signal(random, rows, kind)
    plant.scaled_by(linear.run(lambda row, x: training[row], np.zeros(rows))[0])
    amplitude, other = ((1.6, 0), (1.0, 1), (1.3, 2))[seed % 3]
    tested = amplitude * _signal(random, _TEST_ROWS, (kind + other) % 3)
    train, test = (_record(plant, random, difficulty, one) for one in (training, tested))
    again = np.random.default_rng([36, seed, 1])
    alike = _record(plant, again, difficulty, _signal(again, _TEST_ROWS, kind))
    motion = (MOTION if plant.k else DRIVE) if as_motion else ""
    what = f"{effect}, {difficulty}"
    return Problem(
        name,
        GENERATED,
        ("u",),
        ("y",),
        _TS,
        [train],
        {"new": test, "alike": alike},
        motion=motion,
        what=what,
    )


def oscillators() -> dict[str, Callable[[], Problem]]:
    """The 40 problems by name, each made when it is called."""
    pairs = [
        (EFFECTS[i % len(EFFECTS)], DIFFICULTIES[i % len(DIFFICULTIES)])
        for i in range(LAGGED_PROBLEMS)
    ]
    found: dict[str, Callable[[], Problem]] = {}
    for i, (effect, difficulty) in enumerate((*pairs, *MOTION_PAIRS)):
        as_motion = i >= LAGGED_PROBLEMS
        name = f"g{i:02d}_{effect}_{difficulty}{'_motion' * as_motion}".replace(" ", "_")
        found[name] = partial(oscillator, name, i, effect, difficulty, as_motion)
    return found


MASS, VISCOUS, COULOMB, OFFSET, EDGE = 95.0, 200.0, 20.0, -3.0, 0.002  # kg, N s/m, N, N, m/s
_FAST, _THIN, _SECONDS = 0.001, 10, 24.0

AXIS_MOTION = """
[motion.states]
x = { derivative = "v", start = "position", unit = "m" }
v = { derivative = "(force - viscous*v - offset)/mass", start = "derivative of position", learned = true, unit = "m/s" }
[motion.outputs]
position = "x"
[motion.parameters]
mass = { initial = 80.0, unit = "kg", min = 0 }
viscous = { initial = 250.0, unit = "N s/m", min = 0 }
offset = { initial = 0.0, unit = "N" }
[learner]
hidden = [8]
inputs = ["v"]
"""


def _moves(random: np.random.Generator, smooth: bool) -> np.ndarray:
    """A trajectory there and back: bang-bang or trapezoids of random lengths and speeds, or sines."""
    rows = int(_SECONDS / _FAST)
    if smooth:
        time = np.arange(rows) * _FAST
        return 0.08 * np.sin(2 * np.pi * 0.17 * time) + 0.03 * np.sin(2 * np.pi * 0.6 * time + 1)
    place, pieces, rows_so_far = 0.0, [], 0
    while rows_so_far < rows:
        goal = random.uniform(-0.12, 0.12)
        top, push = random.uniform(0.05, 0.2), random.uniform(0.4, 1.2)
        distance = abs(goal - place)
        rise = min(top / push, np.sqrt(distance / push))
        flat = max(distance / (push * rise) - rise, 0.0) if random.random() < 0.6 else 0.0
        scale = distance / (push * rise * (rise + flat))
        time = np.arange(int((2 * rise + flat) / _FAST))
        speed = (
            np.minimum(np.minimum(time * _FAST, 2 * rise + flat - time * _FAST), rise)
            * push
            * scale
        )
        path = place + np.sign(goal - place) * np.cumsum(speed) * _FAST
        rest = np.full(int(random.uniform(0.05, 0.6) / _FAST), path[-1])
        pieces += [path, rest]
        place, rows_so_far = float(path[-1]), rows_so_far + len(path) + len(rest)
    return np.concatenate(pieces)[:rows]


def _axis_record(seed: int, smooth: bool) -> np.ndarray:
    """Force and position at 100 Hz of the axis under a PD controller, with the encoder's noise and steps."""
    random = np.random.default_rng([95, seed])
    wanted = _moves(random, smooth)
    x, v, before = wanted[0], 0.0, wanted[0]
    force, seen = np.zeros(len(wanted)), np.zeros(len(wanted))
    for row, goal in enumerate(wanted):
        seen[row] = np.round((x + 1e-5 * random.standard_normal()) / 5e-6) * 5e-6
        slope, before = 0.1 * (seen[row] - before) / _FAST + 0.9 * v, seen[row]
        force[row] = np.clip(3e4 * (goal - seen[row]) - 1.5e3 * slope, -150, 150)
        pull = (force[row] - VISCOUS * v - COULOMB * np.tanh(v / EDGE) - OFFSET) / MASS
        middle = v + _FAST / 2 * pull
        pull = (force[row] - VISCOUS * middle - COULOMB * np.tanh(middle / EDGE) - OFFSET) / MASS
        x, v = x + _FAST * middle, v + _FAST * pull
    steps = len(wanted) // _THIN
    return np.column_stack([force.reshape(steps, _THIN).mean(axis=1), seen[::_THIN]])


def axis(as_motion: bool = False) -> Problem:
    tests = {"sines": _axis_record(2, True), "moves": _axis_record(3, False)}
    found = Problem(
        "axis", AXIS, ("force",), ("position",), _FAST * _THIN, [_axis_record(1, False)], tests
    )
    return replace(found, name="axis_motion", motion=AXIS_MOTION) if as_motion else found


def _axis_runs(unknowns: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Positions over a record for each column of mass, viscous, Coulomb, offset, start and speed there (RK4)."""
    mass, viscous, coulomb, offset, x, v = unknowns
    step, runs = _FAST * _THIN / 4, np.zeros((len(force), unknowns.shape[1]))

    def pull(v: np.ndarray, u: float) -> np.ndarray:
        return (u - viscous * v - coulomb * np.tanh(v / EDGE) - offset) / mass

    for row, u in enumerate(force):
        runs[row] = x
        for _ in range(4):
            first = pull(v, u)
            second = pull(v + step / 2 * first, u)
            third = pull(v + step / 2 * second, u)
            fourth = pull(v + step * third, u)
            x = x + step * (v + step / 6 * (first + second + third))
            v = v + step / 6 * (first + 2 * second + 2 * third + fourth)
    return runs


def grey_box() -> float:
    """Mean test NRMSE of the right equations, fitted to the whole record by SciPy from the spec's initial values."""
    problem = axis()

    def fit(record: np.ndarray, start: np.ndarray, free: np.ndarray) -> np.ndarray:
        scale = np.where(start == 0, 1.0, np.abs(start))[free]

        def unpack(values: np.ndarray) -> np.ndarray:
            full = np.repeat(start[:, None], values.shape[1], axis=1)
            full[free] = values * scale[:, None]
            return full

        def residual(values: np.ndarray) -> np.ndarray:
            return _axis_runs(unpack(values[:, None]), record[:, 0])[:, 0] - record[:, 1]

        def jacobian(values: np.ndarray) -> np.ndarray:
            moved = values[:, None] + 1e-6 * np.eye(len(values))
            runs = _axis_runs(unpack(np.column_stack([values, moved])), record[:, 0])
            return (runs[:, 1:] - runs[:, :1]) / 1e-6

        found = least_squares(residual, start[free] / scale, jacobian, x_scale="jac")
        return unpack(found.x[:, None])[:, 0]

    train = problem.train[0]
    start = np.array([80.0, 250.0, 10.0, 0.0, train[0, 1], 0.0])
    fitted = fit(train, start, np.arange(6))
    errors = []
    for test in problem.tests.values():
        run = np.concatenate([fitted[:4], [test[0, 1], 0.0]])
        error = _axis_runs(run[:, None], test[:, 0])[:, 0] - test[:, 1]
        errors.append(np.sqrt(np.mean(error**2)) / test[:, 1].std())
    return float(np.mean(errors))
