"""Do fits of systems with a hidden state say so, and fits of right physics not? Lagged physics and motions.

A hidden first-order state, a backlash and a Bouc-Wen spring beside a mass and spring; a hidden first-order state beside
lagged physics; the same without them. A silent miss is a fit none of whose intervals of the parameter holds the truth
and that warns neither of what is unexplained nor of a hidden state. Every fit is that of `orthaug fit`.
Run: python benchmarks/coverage_hidden.py [draws, default 10] [words that a system's row must hold]
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from draws import seeds
from machine import describe

import orthaug as oa

TS, ROWS = 0.05, 1200
WARNED = {"unexplained", "hidden_state"}
MOTION = """
[motion]
substeps = 1
[motion.states]
x = { derivative = "v", start = "y" }
v = { derivative = "(u - c*v - k*x)/m", start = "derivative of y", learned = LEARNED }
[motion.outputs]
y = "x"
[motion.parameters]
m = { initial = 1.2, min = 0 }
c = { initial = 0.8, min = 0 }
k = { initial = 5.0, min = 0 }
"""
LAGGED = """
[[baseline.terms]]
parameter = "a1"
regressor = "y[k-1]"
[[baseline.terms]]
parameter = "a2"
regressor = "y[k-2]"
[[baseline.terms]]
parameter = "b"
regressor = "u[k-1]"
"""
LEARNERS = {
    "none": "",
    "v": '[learner]\nhidden = [4]\ninputs = ["{v}"]\n',
    "v, kept": '[learner]\nhidden = [4]\ninputs = ["{v}"]\n[training]\nfallback = false\n',
}


class Row(NamedTuple):
    """A row of the coverage table; of `draws` the number that held, were missed in silence, and warned."""

    system: str
    noise: str
    sees: str
    draws: int
    held: int
    silent: int
    width: float
    warned: int
    hidden: int


def steps(seed: int) -> np.ndarray:
    """A force of steps."""
    return np.repeat(np.random.default_rng([seed, 1]).uniform(-3, 3, ROWS // 12 + 1), 12)[:ROWS]


def spring(seed: int, noise: str, hidden: str) -> tuple[np.ndarray, np.ndarray]:
    """m x'' = u − c x' − k x − h with m, c, k = 1, 0.6, 4, by Runge-Kutta steps of a fifth of a sample."""
    random, u = np.random.default_rng([seed, 2]), steps(seed)
    if hidden == "heat":  # bursts of unequal size, each of about the time constant of what heats up
        u = u * np.repeat(random.uniform(0.3, 2, ROWS // 100 + 1), 100)[:ROWS]
    size = 0.3 if noise == "equation" else 0.0
    force = u + size * random.normal(size=ROWS)
    state, y, h = np.zeros(3), [], TS / 5

    def rates(s: np.ndarray, f: float) -> np.ndarray:
        x, v, z = s
        pull, follows = 0.0, 0.0
        if hidden == "lag":
            pull, follows = z, (x - z) / 0.5
        elif hidden == "bouc_wen":
            pull, follows = 2 * z, v - (abs(v) * abs(z) * z + v * z * z) / (2 * 0.4**2)
        elif hidden == "backlash":  # a stiff, damped contact whose play is z
            gap = x - z
            pull = 2 * z
            follows = v if (gap >= 0.3 and v > 0) or (gap <= -0.3 and v < 0) else 0.0
        elif hidden == "heat":  # a rubber spring that softens with the power of its force
            pull, follows = -2 * z / (1 + z) * x, (f**2 / 4 - z) / (100 * TS)
        return np.array([v, f - 0.6 * v - 4 * x - pull, follows])

    for f in force:
        y.append(state[0])
        for _ in range(5):
            a = rates(state, f)
            b = rates(state + h / 2 * a, f)
            c = rates(state + h / 2 * b, f)
            state = state + h / 6 * (a + 2 * b + 2 * c + rates(state + h * c, f))
    y = np.array(y)
    return u, y + (0.01 * y.std() * random.normal(size=ROWS) if noise == "sensor" else 0.0)


def lagged(seed: int, noise: str, hidden: str) -> tuple[np.ndarray, np.ndarray]:
    """y = 1.35 y₁ − 0.48 y₂ + 0.5 u₁ − 0.1 z + e with z a first-order lag of y, of ten samples."""
    random, u, y, z, e = np.random.default_rng([seed, 3]), steps(seed), np.zeros(ROWS), 0.0, 0.0
    for k in range(2, ROWS):
        white = random.normal()
        e = {"equation": 0.05 * white, "coloured": 0.5 * e + 0.05 * white}.get(noise, 0.0)
        z += 0.1 * (y[k - 2] - z)
        y[k] = 1.35 * y[k - 1] - 0.48 * y[k - 2] + 0.5 * u[k - 1] - 0.1 * z * (hidden == "lag") + e
    return u, y + (0.01 * y.std() * random.normal(size=ROWS) if noise == "sensor" else 0.0)


SYSTEMS: dict[
    str, tuple[Callable[..., tuple[np.ndarray, np.ndarray]], str, str, str, float, str]
] = {
    "motion, hidden lag": (spring, "lag", MOTION, "k", 4.0, "v"),
    "motion, right physics": (spring, "", MOTION, "k", 4.0, "v"),
    "motion, backlash": (spring, "backlash", MOTION, "k", 4.0, "v"),
    "motion, Bouc-Wen": (spring, "bouc_wen", MOTION, "k", 4.0, "v"),
    "motion, a spring that heats up": (spring, "heat", MOTION, "k", 4.0, "v"),
    "lagged, hidden lag": (lagged, "lag", LAGGED, "a1", 1.35, "y[k-1] - y[k-2]"),
    "lagged, right physics": (lagged, "", LAGGED, "a1", 1.35, "y[k-1] - y[k-2]"),
}
NOISES = {"motion": ("equation", "sensor"), "lagged": ("equation", "sensor", "coloured")}


def row(system: str, noise: str, sees: str, draws: int) -> Row:
    """Fit every draw as `orthaug fit` does."""
    make, hidden, physics, name, truth, v = SYSTEMS[system]
    held = silent = warned = named = 0
    widths = []
    for seed in seeds(draws, system, noise, sees):
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder)
            table = np.column_stack(make(seed, noise, hidden))
            np.savetxt(place / "run.csv", table, delimiter=",", header="u,y", comments="")
            spec = f'[data]\ninputs = ["u"]\noutputs = ["y"]\nsampling_time = {TS}\ntrain = {{ files = ["run.csv"] }}\n'
            spec += physics.replace("LEARNED", "false" if sees == "none" else "true") + LEARNERS[
                sees
            ].replace("{v}", v)
            (place / "spec.toml").write_text(spec)
            result = oa.fit_spec(place / "spec.toml").result
        found = next(one for one in result.parameters if one.name == name)
        codes = {warning.code for warning in result.warnings}
        ends = [
            one for one in (found.ci95, found.ci95_with_bias) if one is not None and None not in one
        ]
        inside = any(low <= truth <= high for low, high in ends)
        held += inside
        silent += bool(ends) and not inside and not WARNED & codes
        warned += bool(WARNED & codes)
        named += "hidden_state" in codes
        widths += [ends[0][1] - ends[0][0]] if ends else []
    return Row(
        system,
        noise,
        sees,
        draws,
        held,
        silent,
        float(np.median(widths or [np.nan])),
        warned,
        named,
    )


def rows(draws: int = 10, words: str = "") -> Iterator[Row]:
    """Yield the rows of the table, or those whose system, noise and learner hold some words."""
    for system in SYSTEMS:
        for noise in NOISES[system.split(",", 1)[0]]:
            for sees in LEARNERS:
                if all(word in f"{system} {noise} {sees}" for word in words.split()):
                    yield row(system, noise, sees, draws)


if __name__ == "__main__":
    print(describe())
    print(
        "system | noise | learner sees | draws | held | silent misses | median width | warned "
        "| hidden_state"
    )
    for one in rows(int(sys.argv[1]) if len(sys.argv) > 1 else 10, " ".join(sys.argv[2:])):
        print(*one, sep=" | ", flush=True)
