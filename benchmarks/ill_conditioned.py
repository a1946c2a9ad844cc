"""How many physics are called ill-conditioned: ordinary ones of measured data, and pairs of inputs that are nearly one.

Run: python benchmarks/ill_conditioned.py
"""

from __future__ import annotations

import itertools

import numpy as np
import pandas as pd
from machine import data_folder, describe
from scipy.io import loadmat

import orthaug as oa
from orthaug._base.errors import InputError
from orthaug.physics import ill_conditioned
from orthaug.physics.problem import pose

APART = (1e-3, 1e-4, 1e-5, 1e-6, 1e-8)
NIST = {"norris": 1, "pontius": 2, "wampler1": 5, "wampler2": 5, "wampler3": 5}


def records() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Input and output of five measured sets."""
    silverbox = pd.read_csv(data_folder() / "silverbox/SNLS80mV.csv").to_numpy()[40650:60650]
    tanks = pd.read_csv(data_folder() / "cascaded_tanks/dataBenchmark.csv")
    damper = loadmat(data_folder() / "mr_damper/damper.mat")
    circuit = pd.read_csv(
        data_folder() / "wiener_hammerstein/WienerHammerBenchmark.csv"
    ).to_numpy()[5200:25200]
    wing = pd.read_csv(data_folder() / "f16/f-16.txt", header=None).to_numpy()[-20000:]
    return {
        "silverbox": (silverbox[:, 0], silverbox[:, 1]),
        "tanks": (tanks["uEst"].to_numpy(), tanks["yEst"].to_numpy()),
        "damper": (damper["X"].ravel(), damper["y"].ravel()),
        "Wiener-Hammerstein": (circuit[:, 0], circuit[:, 1]),
        "F-16": (wing[:, 0], wing[:, 2]),
    }


def powers(signals: list[str], degree: int) -> list[str]:
    """All products of the signals up to a degree, with a constant."""
    chosen = (itertools.combinations_with_replacement(signals, d) for d in range(1, degree + 1))
    return ["1", *("*".join(factors) for group in chosen for factors in group)]


PHYSICS = {
    "two lags": ["y[k-1]", "y[k-2]", "u[k]", "u[k-1]", "u[k-2]", "1"],
    "eight lags": [*(f"y[k-{i}]" for i in range(1, 9)), *(f"u[k-{i}]" for i in range(9)), "1"],
    "cubic in y1, y2, u1": powers(["y[k-1]", "y[k-2]", "u[k-1]"], 3),
    "degree 5 in y1, u1": powers(["y[k-1]", "u[k-1]"], 5),
    "degree 9 in u": powers(["u[k]"], 9),
}


def called(u: np.ndarray, y: np.ndarray, texts: list[str]) -> bool | None:
    """Return whether the physics is called ill-conditioned; None where it is refused."""
    baseline = oa.Baseline.from_terms([oa.Term(f"t{i}", text) for i, text in enumerate(texts)])
    try:
        problem = pose(oa.Record.from_arrays(u, y, sampling_time=1.0), baseline)
    except InputError:
        return None
    return bool(ill_conditioned.of_physics(problem))


def ordinary() -> tuple[int, int]:
    """Return how many ordinary physics are called ill-conditioned, of how many: as measured, short, and with noise."""
    rng, found = np.random.default_rng(0), []
    for u, y in records().values():
        noisy = y + 0.1 * y.std() * rng.normal(size=len(y))
        for texts in PHYSICS.values():
            found += [called(u, y, texts), called(u[:200], y[:200], texts), called(u, noisy, texts)]
    for name, degree in NIST.items():
        values = pd.read_csv(data_folder() / f"nist_linear/{name}.csv").to_numpy(dtype=float)
        found.append(called(values[:, 1], values[:, 0], powers(["u[k]"], degree)))
    known = [one for one in found if one is not None]
    return sum(known), len(known)


def nearly_one(apart: float, count: int = 10) -> int:
    """Return how many of some records are called ill-conditioned whose inputs differ by so much of their deviation."""
    found = 0
    for seed in range(count):
        rng = np.random.default_rng(seed)
        rows, noise = (200, 2000)[seed % 2], (0.002, 0.02, 0.2)[seed % 3]
        u, y = rng.normal(size=rows), np.zeros(rows)
        for k in range(1, rows):
            y[k] = 0.6 * y[k - 1] + u[k - 1] + noise * rng.normal()
        both = np.column_stack([u, u + apart * rng.normal(size=rows)])
        found += bool(called(both, y, ["y[k-1]", "u1[k-1]", "u2[k-1]"]))
    return found


def main() -> None:
    """Print both tables."""
    print(describe())
    print("ordinary physics called ill-conditioned: {} of {}".format(*ordinary()))
    for apart in APART:
        print(f"inputs apart by {apart:.0e} of their deviation: {nearly_one(apart)} of 10")


if __name__ == "__main__":
    main()
