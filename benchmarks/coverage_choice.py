"""Do the intervals of weak terms hold that `select` chose itself, and how many of the chosen terms are spurious?

Beside physics of three terms there is one strong term, or none, and a weak one of so many standard errors of a fit to
all rows, out of 31 candidates. `select` chooses, its fit has the intervals. A miss is the true coefficient outside its
interval, 0 of a spurious term; it is silent where no warning speaks of the choice. For comparison the intervals of a
fit to the rows that chose, as they would be without a word, with and without control of false discoveries.
Run: python benchmarks/coverage_choice.py [draws, default 100]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from coverage_noise import noise_of
from draws import seeds
from machine import describe

import orthaug as oa
from orthaug.analysis.robustness import robust_where_asked

PHYSICS = oa.Baseline.from_terms(
    [oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]"), oa.Term("c", "1")]
)
THETA = np.array([0.7, 0.5, 0.1])
LAGS, WEAK, STRONG, SIZE = oa.Lags(2, 2, 1), "u[k-1]*u[k-2]", "u[k-1]**2", 0.1
WARNED = {
    "conditional_on_selection", "terms_not_confirmed", "terms_have_rivals", "unexplained", "inconsistent",
    "sensor_noise",
}  # fmt: skip
NAIVE = {"halves": False, "level": 1.0}


class Row(NamedTuple):
    """A line of the table; shares in per cent of all intervals of terms, of physics too in `theta`."""

    system: str
    noise: str
    sees: str
    draws: int
    held: float
    silent: float
    width: float
    """Median, in per cent of the coefficient, of true terms."""
    weak_held: float
    """Of the intervals of the weak term."""
    weak: int
    """How often it was chosen."""
    spurious: int
    theta: float
    """Share of the intervals of the physics that hold."""
    shown: float
    """Share of the chosen terms that have an interval."""
    false_share: float
    """The mean over the draws of the share of spurious terms among the chosen ones, 0 where none is chosen."""


def record(
    seed: int, rows: int, weak: float, strong: float, noise: str = "white", sensor: float = 0.0
) -> Any:
    """A record, and its true coefficients by term; `weak` in standard errors of a fit to all rows."""
    rng = np.random.default_rng([seed, 55])
    u = rng.uniform(-1, 1, rows + 100)
    e, y = SIZE * noise_of(noise, rng, u), np.zeros(rows + 100)
    c = weak * SIZE / np.sqrt(rows) * 3  # the weak term has a deviation of a third
    for k in range(2, len(y)):
        own = c * u[k - 1] * u[k - 2] + strong * u[k - 1] ** 2
        y[k] = THETA @ [y[k - 1], u[k - 1], 1.0] + own + e[k] * (not sensor)
    y += sensor * rng.normal(size=len(y))
    return oa.Record.from_arrays(u=u[100:], y=y[100:]), {WEAK: c, STRONG: strong}


def row(
    name: str, noise: str, draws: int, criterion: Any, select: dict[str, Any], **system: Any
) -> Row:
    """One line of the table; `select` are options of the choice, `NAIVE` for intervals as if nothing was chosen."""
    held, silent, width, weak, spurious, theta, shown, false = [], [], [], [], 0, [], [], []
    for seed in seeds(draws, name, noise):
        data, truth = record(seed, noise=noise, **system)
        chosen = oa.select(data, PHYSICS, lags=LAGS, criterion=criterion, **select)
        made = (
            oa.estimate(data, PHYSICS, **chosen.options) if select == NAIVE else chosen.estimate()
        )
        made = robust_where_asked(made, made.model.predict(made.problem.record))  # as `orthaug fit`
        if made.interval is not None:
            theta += ((made.interval[:, 0] <= THETA) & (made.interval[:, 1] >= THETA)).tolist()
        warned = (
            {note.code for note in (*chosen.notes, *made.warnings)} & WARNED
            if select != NAIVE
            else set()
        )
        wrong = [term not in truth or not truth[term] for term in made.terms.index]
        spurious += sum(wrong)
        false.append(float(np.mean(wrong)) if wrong else 0.0)
        for term, line in made.terms.iterrows():
            true = truth.get(str(term), 0.0)
            shown.append(bool(np.isfinite(line["ci95_low"])))
            inside = bool(line["ci95_low"] <= true <= line["ci95_high"])
            weak += [inside] if term == WEAK else []
            held += [inside] if shown[-1] else []
            silent.append(shown[-1] and not inside and not warned)
            width += (
                [100 * (line["ci95_high"] - line["ci95_low"]) / abs(true)]
                if true and shown[-1]
                else []
            )
    share = lambda values: 100 * float(np.mean(values)) if values else float("nan")  # noqa: E731
    middle, count = float(np.median(width)) if width else float("nan"), len(weak)
    own = share(weak) if any(shown) else float("nan")
    tail = (own, count, spurious, share(theta), share(shown), share(false))
    return Row(name, noise, "terms that it chose", draws, share(held), share(silent), middle, *tail)


STEP = oa.Prediction()
RUN = oa.Simulation(128, 20)
CASES: list[tuple[str, str, Any, dict[str, Any]]] = [
    ("200 rows, weak 3", "white", STEP, {"rows": 200, "weak": 3, "strong": 0}),
    ("200 rows, strong, weak 4", "white", STEP, {"rows": 200, "weak": 4, "strong": 0.4}),
    ("500 rows, weak 6", "white", STEP, {"rows": 500, "weak": 6, "strong": 0}),
    ("500 rows, strong, weak 4", "white", STEP, {"rows": 500, "weak": 4, "strong": 0.4}),
    ("500 rows, strong, weak 7", "white", STEP, {"rows": 500, "weak": 7, "strong": 0.4}),
    ("1000 rows, strong, weak 9", "white", STEP, {"rows": 1000, "weak": 9, "strong": 0.4}),
    ("500 rows, strong, weak 7", "uneven", STEP, {"rows": 500, "weak": 7, "strong": 0.4}),
]
FLOWN = (
    "500 rows, free run, strong, weak 5",
    "sensor",
    RUN,
    {"rows": 500, "weak": 5, "strong": 0.4, "sensor": SIZE},
)


def rows(draws: int = 100, motions: int = 30) -> Iterator[Row]:
    """Yield the lines of the table, as `select` is by default; the free run is slower."""
    for name, noise, criterion, system in CASES:
        yield row(name, noise, draws, criterion, {}, **system)
    name, noise, criterion, system = FLOWN
    yield row(name, noise, motions, criterion, {}, **system)


def naive(draws: int = 100) -> Iterator[Row]:
    """Yield the same lines for intervals as if the terms had not been chosen on the rows that are fitted."""
    for name, noise, criterion, system in CASES:
        yield row(name, noise, draws, criterion, NAIVE, **system)


def table(draws: int = 100) -> list[list[float]]:
    """Of the rows with intervals: silent misses, held of all terms and of the weak one, how often that was chosen.

    And spurious terms; then held of all terms, how often the weak one was chosen, and spurious terms, naively.
    """
    found = []
    for (name, noise, criterion, system), plain in zip(CASES, naive(draws), strict=True):
        ours = row(name, noise, draws, criterion, {}, **system)
        if ours.shown:
            ours_shown = [ours.silent, ours.held, ours.weak_held, ours.weak, ours.spurious]
            found.append([*ours_shown, plain.held, plain.weak, plain.spurious])
    return found


def short(draws: int = 100) -> list[list[float]]:
    """Of the rows without: how often the weak term was chosen, and spurious terms; then the same naively, and held."""
    found = []
    for name, noise, criterion, system in CASES[:2]:
        ours, plain = (row(name, noise, draws, criterion, how, **system) for how in ({}, NAIVE))
        found.append([ours.weak, ours.spurious, plain.weak, plain.spurious, plain.held])
    return found


def main(draws: int) -> None:
    print(describe())
    print(
        "\n| system | noise | draws | held | silent misses | width | weak held | weak chosen | "
        "spurious | θ held "
    )
    for title, found in (
        ("by default", rows(draws, draws)),
        ("all rows choose and are fitted", naive(draws)),
    ):
        print(title)
        began = time.perf_counter()
        for one in found:
            shares = (
                f"{one.held:.0f} % | {one.silent:.0f} % | {one.width:.2g} % | "
                f"{one.weak_held:.0f} % | {one.weak}"
            )
            last = (
                f"{one.spurious} | {one.theta:.0f} % | shown {one.shown:.0f} % | false "
                f"{one.false_share:.1f} %"
            )
            took = f"{(time.perf_counter() - began) / draws:.1f} s a draw"
            print(
                f"| {one.system} | {one.noise} | {one.draws} | {shares} | {last} | {took}",
                flush=True,
            )
            began = time.perf_counter()


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
