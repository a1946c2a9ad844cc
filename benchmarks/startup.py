"""`orthaug fit` with all its files, its programs compiled before, against a bare import of what it is made of.

The bare import is `import jax, matplotlib.pyplot, pandas`. All run in turn, each a process of its own, timed by the
clock and by the processor time of all threads; the ratio of the latter holds beside other work, too.

Run: python benchmarks/startup.py [REPEATS]
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np
from machine import describe

from orthaug import Record
from orthaug.commands.demo import SPEC as DAMPER
from orthaug.studies import synthetic

IMPORTS = ("jax", "matplotlib.pyplot", "pandas")
COMMAND = "from orthaug.commands.entry import main; main()"
STATIC = """
[data]
inputs = {inputs}
outputs = ["y"]
train = {{ files = ["train.csv"] }}
[data.tests.test]
files = ["test.csv"]
{terms}
[learner]
hidden = [16]
"""
TERM = '[[baseline.terms]]\nparameter = "{name}"\nregressor = "{regressor}"\ninitial = {initial}\n'


def main(repeats: int = 7) -> None:
    print(describe())
    with tempfile.TemporaryDirectory() as folder:
        commands = {f"import {name}": [f"import {name}"] for name in IMPORTS}
        commands |= {
            "import all three": [f"import {', '.join(IMPORTS)}"],
            "help": [COMMAND, "--help"],
        }
        for name, spec in write_cases(Path(folder)).items():
            commands[f"fit, {name}"] = [
                COMMAND,
                "fit",
                str(spec),
                "--out",
                str(spec.parent / "out"),
            ]
        times = in_turn(commands, repeats, environment(folder))
    wall, processor = times["import all three"]
    print("| process | wall | ratio | processor | ratio |\n|---|---|---|---|---|")
    for name, (seconds, busy) in times.items():
        print(
            f"| {name} | {seconds:.2f} s | {seconds / wall:.2f} | {busy:.2f} s | "
            f"{busy / processor:.2f} |"
        )


def write_cases(folder: Path) -> dict[str, Path]:
    """Folders with a spec and its data; the specs by name."""
    static = synthetic.static(1, noise=True)
    terms = "".join(
        TERM.format(name=p.name, regressor=r, initial=p.initial)
        for p, r in zip(static.baseline.parameters, ("u[k]", "u[k]**3"), strict=True)
    )
    damper = synthetic.mass_spring_damper()
    spec, train, test = many_terms()
    return {
        "static": write_case(
            folder / "static", STATIC.format(inputs='["u"]', terms=terms), static.train, static.test
        ),
        "mass-spring-damper": write_case(folder / "damper", DAMPER, damper.train, damper.test),
        "56 terms": write_case(folder / "many", spec, train, test),
    }


def write_case(folder: Path, spec: str, train: Record, test: Record) -> Path:
    folder.mkdir(parents=True)
    for name, record in (("train", train), ("test", test)):
        header = ",".join(channel.name for channel in (*record.inputs, *record.outputs))
        rows = np.column_stack([record.experiments[0].inputs, record.experiments[0].outputs])
        np.savetxt(
            folder / f"{name}.csv", rows, fmt="%.17g", delimiter=",", header=header, comments=""
        )
    (folder / "spec.toml").write_text(spec, encoding="utf-8")
    return folder / "spec.toml"


def many_terms() -> tuple[str, Record, Record]:
    """A static map of five inputs, with physics of all 56 monomials up to the third degree; 4000 rows."""
    rng = np.random.default_rng(56)
    names = [f"u{i}" for i in range(1, 6)]
    monomials = [
        product
        for degree in range(4)
        for product in combinations_with_replacement(range(5), degree)
    ]
    theta = rng.normal(size=len(monomials))

    def record(rows: int, noise: float) -> Record:
        u = rng.uniform(-1.0, 1.0, (rows, 5))
        phi = np.column_stack([u[:, list(product)].prod(axis=1) for product in monomials])
        y = phi @ theta + 0.3 * np.sin(4 * u[:, 0]) * u[:, 1] + noise * rng.normal(size=rows)
        return Record.from_arrays(u, y, inputs=names, outputs=["y"])

    terms = "".join(
        TERM.format(
            name=f"c{i}",
            regressor=" * ".join(f"{names[j]}[k]" for j in product) or "1",
            initial=0.0,
        )
        for i, product in enumerate(monomials)
    )
    inputs = str(names).replace("'", '"')
    return STATIC.format(inputs=inputs, terms=terms), record(4000, 0.01), record(1000, 0.0)


def environment(folder: str) -> dict[str, str]:
    """That of this process, with caches of bytecode and programs that only these processes fill."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return kept | {
        "PYTHONPYCACHEPREFIX": f"{folder}/bytecode",
        "JAX_COMPILATION_CACHE_DIR": f"{folder}/programs",
    }


def in_turn(
    commands: dict[str, list[str]], repeats: int, environment: dict[str, str]
) -> dict[str, np.ndarray]:
    """Median seconds of each process, by the clock and of processor time; the first round compiles and is left out."""
    rounds = [
        [measured(code, environment) for code in commands.values()] for _ in range(repeats + 1)
    ]
    return dict(zip(commands, np.median(rounds[1:], axis=0), strict=True))


def measured(code: list[str], environment: dict[str, str]) -> tuple[float, float]:
    """Seconds of a Python process by the clock, and of its processor time."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([sys.executable, "-c", *code], check=True, capture_output=True, env=environment)
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
