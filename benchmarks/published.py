"""What README.md says of the paper's examples: test errors beside the authors' published scripts, and coverage.

Run: python benchmarks/published.py
"""

from __future__ import annotations

import sys

import numpy as np
from machine import ROOT, describe

import orthaug as oa
from orthaug.studies import coverage as coverage_study
from orthaug.studies.study import run

sys.path.append(str(ROOT / "examples"))
import static_example

SCRIPTS = {
    "no noise": 1.47e-4,
    "30 dB": 7.04e-4,
    "mass-spring-damper": 9.7e-5,
}  # mean test RMSE of their starts


def picture() -> float:
    """The largest test RMSE of either structure over the ten starts of examples/static_example.py."""
    example = oa.synthetic.static(1)
    return max(
        static_example.largest_rmse(example, fits)
        for fits in static_example.estimates(example).values()
    )


def rmse(name: str, **options: object) -> float:
    """Mean one-step test RMSE over as many starts as the scripts had."""
    machine = name == "mass-spring-damper"
    example = (
        oa.synthetic.mass_spring_damper()
        if machine
        else oa.synthetic.static(1, noise=name == "30 dB")
    )
    fits = [
        oa.estimate(example.train, example.baseline, seed=s, **options)
        for s in range(5 if machine else 10)
    ]  # type: ignore[arg-type]
    return float(np.mean([fit.model.predict(example.test).scores().rmse[0] for fit in fits]))


def accuracy() -> list[list[float]]:
    """Per example our test RMSE and how many times the scripts' is larger, or smaller."""
    found = []
    for name, scripts in SCRIPTS.items():
        ours = rmse(name)
        found.append([ours, max(scripts / ours, ours / scripts)])
    return found


def coverage() -> list[float]:
    """Per cent of noise draws whose interval of θ1 holds the truth: set 1, set 3, set 3 under the uniform measure."""
    table = run(coverage_study.study("ours", False))

    def share(data_set: int, kind: str) -> float:
        holds = table[table.data_set == data_set][f"{kind}_holds"]
        return 100 * float(np.mean([one[0] for one in holds]))

    return [share(1, "training"), share(3, "training"), share(3, "uniform")]


def main() -> None:
    print(describe())
    print(f"Largest test RMSE of the picture's twenty fits: {picture():.2g}")
    for name, row in zip(SCRIPTS, accuracy(), strict=True):
        print(f"{name}: {', '.join(f'{value:.3g}' for value in row)} (scripts {SCRIPTS[name]:.3g})")
    print(
        "Coverage, set 1, set 3, set 3 uniform:",
        ", ".join(f"{value:.1f} %" for value in coverage()),
    )


if __name__ == "__main__":
    main()
