"""How often is the truth outside every interval that is shown, and nothing warns of it? One table of all such trials.

Five files have the systems: what a missing term moves (`coverage_causes`), columns that a learner could imitate
(`coverage_shared`), states that the physics lacks (`coverage_hidden`), noise that breaks an assumption
(`coverage_noise`), and terms that `select` chose (`coverage_choice`). A row is a system, its noise and what the learner
sees; held, silent misses and the median width relative to the value. Allowed: silent misses of 5 %, with the standard
error of so many draws.
Run: python benchmarks/silent_misses.py [lagged draws, default 100] [draws of motions, default 30]; with few draws it
tells of gross misses only.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from typing import NamedTuple

import coverage_causes
import coverage_choice
import coverage_hidden
import coverage_noise
import coverage_shared
import jax
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


def rows(lagged: int = 100, motions: int = 30) -> Iterator[Row]:
    """Yield every line as it is measured."""
    for one in coverage_noise.lagged_rows(lagged):
        yield Row(one.system, one.noise, one.learner, one.draws, one.held, one.silent, one.width)
    for one in coverage_noise.motion_rows(motions):
        yield Row(
            f"motion, {one.system}",
            one.noise,
            one.learner,
            one.draws,
            one.held,
            one.silent,
            one.width,
        )
    for one in coverage_choice.rows(lagged, motions):
        yield Row(
            f"chosen terms, {one.system}",
            one.noise,
            one.sees,
            one.draws,
            one.held,
            one.silent,
            one.width,
        )
    for one in coverage_causes.rows(lagged, motions):
        yield Row(
            one.system, f"{one.noise:g}", one.sees, one.draws, one.held, one.silent, 100 * one.width
        )
    for one in coverage_shared.rows(lagged):
        share = 100 / one.draws
        width = 100 * one.width
        yield Row(
            one.system, one.noise, one.sees, one.draws, share * one.held, share * one.silent, width
        )
    for words, draws in (("lagged", lagged), ("motion", motions)):
        for one in coverage_hidden.rows(draws, words):
            share, value = 100 / one.draws, coverage_hidden.SYSTEMS[one.system][4]
            width = 100 * one.width / value
            yield Row(
                one.system,
                one.noise,
                one.sees,
                one.draws,
                share * one.held,
                share * one.silent,
                width,
            )


def main(lagged: int, motions: int) -> int:
    print(describe())
    print(
        "\n| system | noise | learner sees | draws | held | silent misses | width |\n"
        + 7 * "|---"
        + "|"
    )
    began, missed = time.perf_counter(), []
    for row in rows(lagged, motions):
        figures = (f"{row.held:.0f} %", f"{row.silent:.0f} %", f"{row.width:.2g} %")
        shown = ["" if figure.startswith("nan") else figure for figure in figures]
        print(
            f"| {row.system} | {row.noise} | {row.sees} | {row.draws} | {' | '.join(shown)} |",
            flush=True,
        )
        missed += [row] if row.silent > row.most else []
        jax.clear_caches()  # a process may map memory 65,530 times, and each program takes some
    minutes = (time.perf_counter() - began) / 60
    print(f"\n{minutes:.0f} min; rows above {ALLOWED:g} % by two standard errors: {len(missed)}")
    for row in missed:
        print(
            f"- {row.system}, {row.noise}, learner sees {row.sees}: {row.silent:.0f} % of "
            f"{row.draws}"
        )
    return bool(missed)


if __name__ == "__main__":
    sys.exit(main(*(int(word) for word in (sys.argv + ["100", "30"][len(sys.argv) - 1 :])[1:3])))
