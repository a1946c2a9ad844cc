"""The designed input of the mass-spring-damper against usual inputs: relative error of θ by least squares.

Simulation and regression are those of tests/test_design.py. Run: python benchmarks/design.py
"""

from __future__ import annotations

import sys

import numpy as np
from machine import ROOT, describe

from orthaug.analysis import signals

sys.path.append(str(ROOT / "tests"))
from test_design import AMPLITUDE, SAMPLES, errors, machine

USUAL = {
    "white Gaussian": np.clip(
        np.random.default_rng(0).normal(0.0, 33, SAMPLES), -AMPLITUDE, AMPLITUDE
    ),
    "uniform": AMPLITUDE * signals.white_uniform(SAMPLES, 0),
    "binary": AMPLITUDE * signals.white_binary(SAMPLES, 0),
    "square of period 6": AMPLITUDE * signals.square(SAMPLES, 6),
}


def usual() -> list[float]:
    """Median errors over 20 draws of the usual inputs."""
    return [float(np.median(errors(wave))) for wave in USUAL.values()]


def designed() -> list[float]:
    """Median errors over 20 and over 200 draws of the designed input, and its condition."""
    design = machine()
    found = errors(design.signal, 200)
    return [float(np.median(found[:20])), float(np.median(found)), design.condition]


def main() -> None:
    print(describe())
    names = (*USUAL, "designed", "designed, 200 draws", "condition of Φ")
    for name, value in zip(names, (*usual(), *designed()), strict=True):
        print(f"{name}: {value:.4g}")


if __name__ == "__main__":
    main()
