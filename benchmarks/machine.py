"""What the numbers were measured on, where the measured data are, and how a ratio is taken."""

from __future__ import annotations

import datetime
import os
import platform
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]


def data_folder() -> Path:
    """Where the measured data sets are: ORTHAUG_DATA, or ../shared/data beside the project."""
    return Path(os.environ.get("ORTHAUG_DATA", ROOT.parent / "shared" / "data"))


def describe() -> str:
    """Processor, cores, versions and date in one line."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip()
            for line in info.read_text().splitlines()
            if line.startswith("model name")
        ]
        model = names[0] if names else model
    versions = ", ".join(f"{name} {version(name)}" for name in ("jax", "numpy", "scipy"))
    return (
        f"{model}, {os.cpu_count()} cores, Python {platform.python_version()}, {versions}, "
        f"{datetime.date.today()}"
    )


def median_seconds(call: Callable[[], object], repeats: int) -> float:
    """Median seconds of a call, after one warm call."""
    call()
    return float(np.median([_seconds(call) for _ in range(repeats)]))


def alternate(
    first: Callable[[], object], second: Callable[[], object], repeats: int
) -> tuple[float, float]:
    """Median seconds of two calls taken in turn, so that both see the same machine; one warm call before."""
    first(), second()
    pairs = [(_seconds(first), _seconds(second)) for _ in range(repeats)]
    one, two = np.median(pairs, axis=0)
    return float(one), float(two)


def _seconds(call: Callable[[], object]) -> float:
    began = time.perf_counter()
    call()
    return time.perf_counter() - began
