"""What `orthaug recover` says before any θ is believed, and whether that comes true.

`gantry` is a pair of problems on one stage: m a + c v, with a force of the place that the physics leaves out and that the
learner, which sees the place, can express. In the first problem 95 % of that force lies in the span of the physics on these
rows, for the stage swings and a is nearly −ω²p; in the second none does. The error of θ in the rehearsal: additive, made
orthogonal to all of θ, and orthogonal along the directions that the learner can imitate (F8), the default; here there are
none. `calibration` compares the coverage that a rehearsal of the demo predicts with that over fresh draws of the system.
Run: python benchmarks/recover.py [gantry | demo | motion | calibration] [draws]
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from machine import describe

import orthaug as oa
from orthaug.commands.demo import SPEC as DEMO

ROWS, STEP = 400, 0.01
TRUE = {"m": 2.0, "c": 30.0}
NOISE = 0.03  # of the force's standard deviation
SHARE = 0.03  # of the physics: the missing force
# The missing force as an expression and as values of place and speed, and what the learner sees
MISSING: dict[str, tuple[str, Callable[[np.ndarray, np.ndarray], np.ndarray], str]] = {
    "inside": ("place[k]", lambda p, v: p, "place[k]"),
    "outside": ("place[k]**2", lambda p, v: p**2, "place[k]"),
}
STRUCTURES = {
    "additive": "additive",
    "orthogonal to all of θ": "all",
    "as the spec says": "shared directions",
}

SPEC = """\
[data]
sampling_time = 0.01
inputs = ["acceleration", "speed", "place"]
outputs = ["force"]
train = {{ files = ["stage.csv"] }}

[[baseline.terms]]
parameter = "m"
regressor = "acceleration[k]"
[[baseline.terms]]
parameter = "c"
regressor = "speed[k]"

[[suspects]]
name = "missing"
on = "{missing}"
coefficient = {coefficient}

[learner]
hidden = [8]
inputs = ["{sees}"]
[training]
focus = "prediction"
"""


class Row(NamedTuple):
    """A line of the table: median relative error of θ by structure in a rehearsal, in per cent."""

    problem: str
    spanned: float
    """Share of the missing force's squares within the span of the physics, in per cent."""
    draws: int
    additive: float
    all: float
    shared: float


def stage(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Acceleration, speed and place of a stage that swings at nearly one frequency."""
    t = STEP * np.arange(ROWS)
    a, v, p = np.zeros(ROWS), np.zeros(ROWS), np.zeros(ROWS)
    for omega in rng.uniform(5.5, 7.5, 8):
        size, phase = rng.uniform(0.3, 1), rng.uniform(0, 2 * np.pi)
        p += size * np.sin(omega * t + phase)
        v += size * omega * np.cos(omega * t + phase)
        a -= size * omega**2 * np.sin(omega * t + phase)
    return a, v, p


def write_problem(folder: Path, problem: str, seed: int = 0) -> tuple[Path, float]:
    """Write data and spec of a problem; return the spec and how much of the force the physics spans."""
    rng = np.random.default_rng(seed)
    a, v, p = stage(rng)
    text, values, sees = MISSING[problem]
    physics = TRUE["m"] * a + TRUE["c"] * v
    missing = values(p, v)
    coefficient = SHARE * physics.std() / missing.std()
    phi = np.linalg.qr(np.column_stack([a, v]))[0]
    spanned = float(np.sum((phi.T @ missing) ** 2) / np.sum(missing**2))
    force = physics + coefficient * missing
    force = force + NOISE * force.std() * rng.normal(size=ROWS)
    table = np.column_stack([a, v, p, force])
    np.savetxt(folder / "stage.csv", table, fmt="%.17g", delimiter=",",
               header="acceleration,speed,place,force", comments="")  # fmt: skip
    spec = folder / "stage.toml"
    own = {
        "missing": text,
        "coefficient": float(coefficient),
        "sees": sees,
        "more": __import__("os").environ.get("MORE", ""),
    }
    spec.write_text(SPEC.format(**own), encoding="utf-8")
    return spec, 100 * spanned


def gantry(draws: int = 12) -> list[Row]:
    """The two problems, rehearsed."""
    found = []
    for problem in MISSING:
        with tempfile.TemporaryDirectory() as folder:
            spec, spanned = write_problem(Path(folder), problem)
            made = oa.recover(spec, draws=draws, choices=draws, terms=["declared"])
        errors = {STRUCTURES.get(c.name, ""): 100 * (c.error or 0.0) for c in made.result.choices}
        own = (errors["additive"], errors["all"], errors["shared directions"])
        found.append(Row(problem, spanned, draws, *own))
    return found


def gantry_table() -> list[float]:
    """The errors of the table in docs/rehearsal.md, row by row."""
    return [error for row in gantry(16) for error in (row.additive, row.all, row.shared)]


class Coverage(NamedTuple):
    """Intervals of the demo that hold the truth, in per cent: for noise, and with the bias counted."""

    source: str
    draws: int
    held: float
    with_bias: float


FRICTION = """
[[suspects]]
name = "friction"
kind = "stribeck"
on = "position[k-1] - position[k-2]"
"""


def demo(folder: Path) -> Path:
    """Write data and spec of the demo, with one start, and return the spec."""
    example = oa.synthetic.mass_spring_damper()
    for name, record in (("train", example.train), ("test", example.test)):
        one = record.experiments[0]
        write_data(folder / f"{name}.csv", one.inputs[:, 0], one.outputs[:, 0])
    spec = folder / "demo.toml"
    spec.write_text(DEMO.replace("restarts = 3", "restarts = 1") + FRICTION, encoding="utf-8")
    return spec


def write_data(path: Path, force: np.ndarray, position: np.ndarray) -> None:
    table = np.column_stack([force, position])
    np.savetxt(path, table, fmt="%.17g", delimiter=",", header="force,position", comments="")


def predicted(draws: int, terms: list[str]) -> Coverage:
    """What the rehearsal of the demo says of its intervals."""
    with tempfile.TemporaryDirectory() as folder:
        made = oa.recover(demo(Path(folder)), draws=draws, choices=0, terms=terms)
    rows = made.result.parameters
    shown = sum(row.shown for row in rows)
    shares = (
        100 * sum(getattr(row, key) for row in rows) / shown for key in ("held", "held_with_bias")
    )
    return Coverage(f"rehearsal, terms {', '.join(terms)}", draws, *shares)


def fresh(draws: int) -> Coverage:
    """What happens: the same inputs, the true friction, new noise, and the same spec."""
    example, system = oa.synthetic.mass_spring_damper(), oa.synthetic.MassSpringDamper()
    force, held, wide, shown = example.train.experiments[0].inputs[:, 0], 0, 0, 0
    with tempfile.TemporaryDirectory() as folder:
        spec = demo(Path(folder))
        for draw in range(draws):
            noise = np.random.default_rng([draw, 3]).normal(scale=0.00018, size=len(force) - 2)
            position = system.simulate(force, example.theta, noise)
            write_data(spec.with_name("train.csv"), force, position)
            for row, true in zip(oa.fit_spec(spec).result.parameters, example.theta, strict=True):
                if row.ci95 is None:
                    continue
                limits = [row.ci95, *([row.ci95_with_bias] if row.ci95_with_bias else [])]
                inside = [low <= true <= high for low, high in limits]
                held, wide, shown = held + inside[0], wide + any(inside), shown + 1
    return Coverage("fresh draws of the system", draws, 100 * held / shown, 100 * wide / shown)


def calibration(draws: int = 100) -> Iterator[Coverage]:
    """Yield the coverage over fresh draws, and what rehearsals of 20 draws predict."""
    yield fresh(draws)
    yield predicted(20, ["declared"])
    yield predicted(20, ["usual"])


def main(what: str, draws: int | None) -> None:
    print(describe())
    began = time.perf_counter()
    if what == "gantry":
        print("\n| missing force | in the span | draws | additive | all of θ | shared directions |")
        print(6 * "|---" + "|")
        for row in gantry(draws or 16):
            own = (f"{v:.3g} %" for v in (row.additive, row.all, row.shared))
            print(f"| {row.problem} | {row.spanned:.0f} % | {row.draws} | {' | '.join(own)} |")
    elif what == "calibration":
        print("\n| intervals of the demo | draws | hold the truth | with the bias |")
        print(4 * "|---" + "|")
        for row in calibration(draws or 100):
            own = f"{row.held:.0f} % | {row.with_bias:.0f} %"
            print(f"| {row.source} | {row.draws} | {own} |", flush=True)
    else:
        with tempfile.TemporaryDirectory() as folder:
            motion = Path(__file__).parents[1] / "examples" / "motion_friction.toml"
            spec = demo(Path(folder)) if what == "demo" else motion
            print(oa.recover(spec, draws=draws or 20).summary())
    print(f"\n{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    words = sys.argv[1:]
    main(words[0] if words else "gantry", int(words[1]) if words[1:] else None)
