"""Runs over many rows that begin where runs over some of them ended, and runs from their own starts: docs/decisions/many_rows.md.

Run: python benchmarks/many_rows.py
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from machine import describe
from scipy.signal import lfilter

import orthaug as oa
from orthaug.fitting import one_step

ROWS, HELD, NOISE = 1_200_000, 20, 0.01
SYSTEMS = ("linear, noise on the sensor", "a tanh in the equation, noise in it")


class Compared(NamedTuple):
    """A fit both ways: the ratio of what it leaves, and what it took [s]."""

    loss: float
    """Ratio of the loss, begun on some of the rows by from the starts."""
    seconds: float
    direct: float


def record(system: str) -> oa.Record:
    rng = np.random.default_rng(1)
    u, e = np.repeat(rng.uniform(-1, 1, ROWS // HELD), HELD), NOISE * rng.normal(size=ROWS)
    if "linear" in system:
        return oa.Record.from_arrays(u, lfilter([0, 0.5], [1, -0.6, 0.2], u) + e)
    y = np.zeros(ROWS)
    first = second = 0.0
    for k in range(1, ROWS):
        second, first = (
            first,
            0.6 * first - 0.2 * second + 0.5 * u[k - 1] - 0.1 * np.tanh(5 * first) + e[k],
        )
        y[k] = first
    return oa.Record.from_arrays(u, y)


def compared(system: str) -> Compared:
    """One fit with the default regularization, both ways."""
    terms = [oa.Term("a1", "y[k-1]"), oa.Term("a2", "y[k-2]"), oa.Term("b1", "u[k-1]")]
    given, baseline = record(system), oa.Baseline.from_terms(terms)
    found = {}
    for many in (one_step.MANY_ROWS, np.inf):
        before, one_step.MANY_ROWS = one_step.MANY_ROWS, many
        fit = oa.estimate(given, baseline, learner=oa.MLP(hidden=(8,)), restarts=2)
        one_step.MANY_ROWS = before
        found[many] = fit.status
    begun, direct = found.values()
    return Compared(begun.loss / direct.loss, begun.seconds, direct.seconds)


def rows() -> Iterator[Compared]:
    for system in SYSTEMS:
        yield compared(system)


def losses() -> list[float]:
    """The ratios of docs/decisions/many_rows.md."""
    return [row.loss for row in rows()]


def main() -> None:
    print(describe())
    print(
        "| system | loss, begun on some by from the starts | time | from the starts |\n"
        + 4 * "|---"
        + "|"
    )
    for system, row in zip(SYSTEMS, rows(), strict=True):
        print(
            f"| {system} | {row.loss:.4f} | {row.seconds:.0f} s | {row.direct:.0f} s |", flush=True
        )


if __name__ == "__main__":
    main()
