"""How often is the truth outside every interval that is shown, and nothing warns of it? One table of all such trials.

Six files have the systems: what a missing term moves (`coverage_causes`), columns that a learner could imitate
(`coverage_shared`), states that the physics lacks (`coverage_hidden`), noise that breaks an assumption
(`coverage_noise`), terms that `select` chose (`coverage_choice`), and records that mislead (`coverage_records`). A row
is a system, its noise and what the learner sees; held, silent misses and the median width relative to the value.
Allowed: silent misses of 5 %, with the standard error of so many draws.
Run: python benchmarks/silent_misses.py [lagged draws, default 100] [draws of motions, default 30] [parts, default all];
with few draws it tells of gross misses only. Parts run in as many processes as there are cores.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import NamedTuple

import coverage_causes
import coverage_choice
import coverage_hidden
import coverage_noise
import coverage_records
import coverage_shared
import numpy as np
from machine import describe

ALLOWED = 5.0  # % of silent misses


class Row(NamedTuple):
    """A line of the table; shares in per cent, the width in per cent of the value."""

    system: str
    noise: str
    sees: str
    draws: int
    held: float
    silent: float
    width: float

    @property
    def most(self) -> float:
        """Silent misses that so many draws of the allowed share may show, twice the standard error above it."""
        return ALLOWED + 200 * float(np.sqrt(ALLOWED / 100 * (1 - ALLOWED / 100) / self.draws))


def _noise(lagged: int, _: int) -> Iterator[Row]:
    for one in coverage_noise.lagged_rows(lagged):
        yield Row(one.system, one.noise, one.learner, one.draws, one.held, one.silent, one.width)


def _motion_noise(_: int, motions: int) -> Iterator[Row]:
    for one in coverage_noise.motion_rows(motions):
        system = f"motion, {one.system}"
        yield Row(system, one.noise, one.learner, one.draws, one.held, one.silent, one.width)


def _choice(lagged: int, motions: int) -> Iterator[Row]:
    for one in coverage_choice.rows(lagged, motions):
        system = f"chosen terms, {one.system}"
        yield Row(system, one.noise, one.sees, one.draws, one.held, one.silent, one.width)


def _causes(lagged: int, motions: int) -> Iterator[Row]:
    for one in coverage_causes.rows(lagged, motions):
        noise, width = f"{one.noise:g}", 100 * one.width
        yield Row(one.system, noise, one.sees, one.draws, one.held, one.silent, width)


def _shared(lagged: int, _: int) -> Iterator[Row]:
    for one in coverage_shared.rows(lagged):
        share = 100 / one.draws
        held, silent, width = share * one.held, share * one.silent, 100 * one.width
        yield Row(one.system, one.noise, one.sees, one.draws, held, silent, width)


def _hidden(lagged: int, motions: int, words: str) -> Iterator[Row]:
    for one in coverage_hidden.rows(lagged if words == "lagged" else motions, words):
        share, value = 100 / one.draws, coverage_hidden.SYSTEMS[one.system][4]
        held, silent, width = share * one.held, share * one.silent, 100 * one.width / value
        yield Row(one.system, one.noise, one.sees, one.draws, held, silent, width)


def _records(_: int, motions: int) -> Iterator[Row]:
    for one in coverage_records.rows(motions):
        yield Row(one.system, one.noise, one.sees, one.draws, one.held, one.silent, one.width)


PARTS: dict[str, Callable[[int, int], Iterator[Row]]] = {
    "causes": _causes,
    "motions with a hidden state": partial(_hidden, words="motion"),
    "choice": _choice,
    "noise of motions": _motion_noise,
    "records": _records,
    "shared columns": _shared,
    "hidden states": partial(_hidden, words="lagged"),
    "noise": _noise,
}


def measure(part: str, lagged: int, motions: int) -> list[Row]:
    """Return the lines of a part, and print each as it is measured."""
    found = []
    for row in PARTS[part](lagged, motions):
        figures = (f"{row.held:.0f} %", f"{row.silent:.0f} %", f"{row.width:.2g} %")
        shown = ["" if figure.startswith("nan") else figure for figure in figures]
        print(
            f"| {row.system} | {row.noise} | {row.sees} | {row.draws} | {' | '.join(shown)} |",
            flush=True,
        )
        found.append(row)
    return found


def main(lagged: int = 100, motions: int = 30, *names: str) -> int:
    print(describe())
    print(
        "\n| system | noise | learner sees | draws | held | silent misses | width |\n"
        + 7 * "|---"
        + "|"
    )
    began = time.perf_counter()
    spawned = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(os.cpu_count(), spawned, max_tasks_per_child=1) as processes:
        parts = [processes.submit(measure, part, lagged, motions) for part in names or PARTS]
        missed = [row for part in parts for row in part.result() if row.silent > row.most]
    minutes = (time.perf_counter() - began) / 60
    print(f"\n{minutes:.0f} min; rows above {ALLOWED:g} % by two standard errors: {len(missed)}")
    for row in missed:
        print(
            f"- {row.system}, {row.noise}, learner sees {row.sees}: {row.silent:.0f} % of "
            f"{row.draws}"
        )
    return bool(missed)


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:3]), *sys.argv[3:]))
