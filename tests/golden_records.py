"""Records of the golden specs: small, drawn from keyed generators and written with nine digits.

What the physics lacks is one neuron, which a network of one neuron finds: training then converges to rounding, and its
numbers are those of every machine.
"""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pandas as pd

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
MASS, DAMPING, STIFFNESS, FRICTION = 1.0, 2.0, 100.0, 1.5  # kg, N s/m, N/m, N


def steps(random: np.random.Generator, rows: int, held: int) -> np.ndarray:
    """Return an input that steps every `held` rows."""
    return np.repeat(random.uniform(-1, 1, -(-rows // held)), held)[:rows]


def spring(rows: int, seed: int) -> pd.DataFrame:
    """Return a damped mass on a spring that gives way, noise in the equation."""
    random = np.random.default_rng(seed)
    u, e, y = steps(random, rows, 3), 2e-3 * random.normal(size=rows), np.zeros(rows)
    for k in range(2, rows):
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + 0.3 * u[k - 1] + e[k]
        y[k] -= 0.25 * np.tanh(2 * y[k - 1] - y[k - 2] - 0.5 * u[k - 1] + 0.3)
    return pd.DataFrame({"u": u, "y": y})


def two_outputs(rows: int, seed: int) -> pd.DataFrame:
    """Return two tanks that exchange water, two inputs, noise in the equations."""
    random = np.random.default_rng(seed)
    u, v = steps(random, rows, 4), steps(random, rows, 7)
    e, h, g = 2e-3 * random.normal(size=(rows, 2)), np.zeros(rows), np.zeros(rows)
    for k in range(1, rows):
        flow = 0.2 * np.tanh(2 * h[k - 1] + 0.5 * u[k - 1] - 0.4)
        h[k] = 0.8 * h[k - 1] + 0.5 * u[k - 1] - flow + e[k, 0]
        g[k] = 0.7 * g[k - 1] + 2.0 * v[k - 1] + 0.3 * h[k - 1] + flow + 3 * e[k, 1]
    return pd.DataFrame({"u": u, "v": v, "h": h, "g": g})


def mass(rows: int, seed: int, sampling_time: float = 0.01) -> pd.DataFrame:
    """Return a mass on a spring and a damper with dry friction, noise on the measured position."""
    random = np.random.default_rng(seed)
    force, noise = 20 * steps(random, rows, 25), 2e-3 * random.normal(size=rows)
    fine, (x, v), positions = 20, (0.0, 0.0), np.zeros(rows)
    for k in range(rows):
        positions[k] = x
        for _ in range(fine):
            a = (force[k] - DAMPING * v - STIFFNESS * x - FRICTION * np.tanh(v / 0.5)) / MASS
            v += a * sampling_time / fine
            x += v * sampling_time / fine
    time = sampling_time * np.arange(rows)
    return pd.DataFrame({"t": time, "force": force, "position": positions + noise})


def held_pendulum(rows: int, seed: int, sampling_time: float = 0.02) -> pd.DataFrame:
    """Return a pendulum on its end with dry friction, held by a PD controller that acts on the noisy angle."""
    random = np.random.default_rng(seed)
    reference, noise = 0.3 * steps(random, rows, 30), 1e-3 * random.normal(size=rows)
    fine, (x, v), before, found = 20, (0.0, 0.0), 0.0, np.zeros((rows, 2))
    for k in range(rows):
        error = reference[k] - x - noise[k]
        torque = 20 * error + 4 * (error - before) / (0.02 + sampling_time)
        before += sampling_time * (error - before) / (0.02 + sampling_time)
        found[k] = x + noise[k], torque
        for _ in range(fine):
            v += (9 * np.sin(x) + 2 * torque - 0.8 * np.tanh(v / 0.5)) * sampling_time / fine
            x += v * sampling_time / fine
    return pd.DataFrame({"reference": reference, "angle": found[:, 0], "torque": found[:, 1]})


def oscillator(rows: int, seed: int) -> pd.DataFrame:
    """Return a Duffing oscillator in the place of Silverbox, its columns and sampling time."""
    random, h = np.random.default_rng(seed), 0.001638468 / 20
    u, (x, v), found = 0.15 * steps(random, rows, 4), (0.0, 0.0), np.zeros(rows)
    for k in range(rows):
        found[k] = x
        for _ in range(20):
            v += h * (9e4 * u[k] - 25 * v - 1.8e5 * x - 7e5 * x**3)
            x += h * v
    return pd.DataFrame({"V1": u, "V2": found + 2e-4 * random.normal(size=rows)})


def cascaded_tanks(rows: int, seed: int) -> pd.DataFrame:
    """Return two tanks in the place of the measured ones, the upper one at times full, their columns."""
    random, table = np.random.default_rng(seed), {}
    for part in ("Est", "Val"):
        u, x, found = 4 + 3 * steps(random, rows, 12), np.array([5.0, 5.0]), np.zeros(rows)
        for k in range(rows):
            found[k] = x[1]
            for _ in range(8):
                out = 0.05 * np.sqrt(np.maximum(x, 0.01))
                fill = 0.05 * u[k] - out[0]
                spill = max(fill, 0.0) if x[0] > 10 else 0.0
                x = x + 0.5 * np.array([fill - spill, out[0] - out[1] + 0.3 * spill])
        table |= {
            f"u{part}": u,
            f"y{part}": np.minimum(found, 10) + 0.02 * random.normal(size=rows),
        }
    return pd.DataFrame(table)


def damper(rows: int, seed: int) -> pd.DataFrame:
    """Return a damper with hysteresis in the place of the measured one: velocity X in cm/s, force y in N."""
    random, z, found = np.random.default_rng(seed), 0.0, np.zeros(rows)
    velocity = 10 * np.sin(0.15 * np.arange(rows)) * steps(random, rows, 40)
    for k, v in enumerate(velocity):
        z += 0.2 * (np.tanh(v / 2) - z)
        found[k] = 1 - 2 * v - 50 * z - 0.1 * v * abs(v)
    return pd.DataFrame({"X": velocity, "y": found + 0.5 * random.normal(size=rows)})


def of_examples() -> dict[str, pd.DataFrame]:
    """Return short records of the examples; generated ones by the equations of their own script."""
    systems = runpy.run_path(str(EXAMPLES / "generate.py"))["SYSTEMS"]
    drawn = {
        f"{name}_{part}": pd.DataFrame(system.record(rows, seed)[0], columns=system.names)
        for name, system in systems.items()
        for part, rows, seed in (("train", 250, 1), ("test", 120, 2))
    }
    measured = {"silverbox": oscillator, "cascaded_tanks": cascaded_tanks, "mr_damper": damper}
    long = {"silverbox_long": oscillator(1000, 21)}  # for a learner of hundreds of terms
    return drawn | long | {name: system(400, 20) for name, system in measured.items()}


def flawed(table: pd.DataFrame, seed: int) -> pd.DataFrame:
    """Return a record with cells that are empty, two outliers and instants that jitter."""
    random, flawed = np.random.default_rng(seed), table.copy()
    output = flawed.columns[-1]
    flawed["t"] = 0.1 * (np.arange(len(table)) + random.uniform(-0.2, 0.2, len(table)))
    flawed.loc[[31, 32, 90, *range(150, 158)], output] = np.nan
    flawed.loc[[60, 200], output] += 5.0
    return flawed


def experiments(rows: int, count: int) -> pd.DataFrame:
    """Return several experiments in one table, told apart by a column; the output in mm above 10 mm."""
    tables = [spring(rows, 10 + i).assign(run=i) for i in range(count)]
    return pd.concat(tables, ignore_index=True).assign(y=lambda table: 1e3 * table["y"] + 10)


def points(names: dict[str, float], count: int, seed: int) -> pd.DataFrame:
    """Return weighted points of a measure, uniform within ± the given limits."""
    random = np.random.default_rng(seed)
    drawn = {name: limit * random.uniform(-1, 1, count) for name, limit in names.items()}
    return pd.DataFrame(drawn | {"weight": random.uniform(0.5, 2, count)})


def write_data(folder: Path) -> None:
    """Write every record that a golden spec reads."""
    tables = {
        "run": spring(240, 1),
        "steps": spring(120, 2),
        "held": spring(120, 3),
        "tanks": two_outputs(240, 4),
        "mass": mass(300, 5),
        "mass_steps": mass(150, 6),
        "pendulum": held_pendulum(300, 13),
        "pendulum_steps": held_pendulum(150, 14),
        "flawed": flawed(spring(240, 7), 7),
        "flawed_mass": flawed(mass(300, 8), 8).drop(columns="t"),
        "experiments": experiments(80, 3),
        "grid": points({"y[k-1]": 3.0, "y[k-2]": 3.0, "u[k-1]": 1.0}, 60, 9),
        "states": points({"x": 0.3, "v": 2.0, "force": 20.0}, 60, 10),
        "weights": points({}, 240, 11),
        "mass_weights": points({}, 300, 12),
    }
    for name, table in (tables | of_examples()).items():
        table.to_csv(folder / f"{name}.csv", index=False, float_format="%.9g")
    (folder / "runs").mkdir(exist_ok=True)
    for i, run in enumerate(pd.read_csv(folder / "experiments.csv").groupby("run")):
        run[1].to_parquet(folder / "runs" / f"{i}.parquet", row_group_size=33)
