"""Which regularization should be the default? One-step test errors, on the paper's, measured and generated sets.

Measured sets are left out where their data are absent.
Run: python benchmarks/regularization.py
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from free_run_problems import MEASURED
from machine import data_folder, describe
from output_unit import noisy

import orthaug as oa

TRIED = ("none", "evidence", "ard", "auto")
ROWS, HELD_OUT = 600, 2000  # of a generated system


class Case(NamedTuple):
    """One fit: what is trained on, what is predicted, and the seed of the weights."""

    train: oa.Record
    test: oa.Record
    baseline: oa.Baseline
    seed: int = 0
    learner: oa.MLP = oa.MLP()
    lags: oa.Lags | None = None
    skip: int = 0


def of(example: oa.synthetic.Example, seed: int = 0, rows: slice = slice(None)) -> Case:
    """A fit of an example of the paper, on some of its rows."""
    first, last, _ = rows.indices(len(example.train))
    return Case(example.train.rows(first, last), example.test, example.baseline, seed)


def silverbox() -> list[Case] | None:
    """Linear physics and ten neurons, scored on the multisine; two starts."""
    path = data_folder() / "silverbox" / "SNLS80mV.csv"
    if not path.exists():
        return None
    train, test = (
        oa.read_record(path, inputs=["V1"], outputs=["V2"], sampling_time=1 / 610.35, rows=rows)
        for rows in ((40650, 105712), (105712, 127400))
    )
    texts = ("V2[k-1]", "V2[k-2]", "V1[k]", "V1[k-1]", "V1[k-2]", "1")
    baseline = oa.Baseline.from_terms([oa.Term(f"p{i}", text) for i, text in enumerate(texts)])
    return [Case(train, test, baseline, seed, oa.MLP((10,)), skip=50) for seed in range(2)]


def mr_damper() -> list[Case] | None:
    """The physics and the learner of the free-run problem, one step ahead; five starts."""
    if not (data_folder() / "mr_damper").is_dir():
        return None
    p = next(
        problem for problem in (make() for make in MEASURED[1:2]) if problem.name == "MR damper"
    )
    return [Case(p.train, p.held_out, p.baseline, seed, p.learner, p.lags) for seed in range(5)]


SYSTEMS: dict[str, Callable[[float, float, float], float]] = {
    "saturation": lambda y, u, v: 0.6 * y + np.tanh(2 * u) + 0.2 * v,
    "friction": lambda y, u, v: 0.8 * y + 0.5 * u - 0.3 * np.tanh(8 * y),
    "product": lambda y, u, v: 0.5 * y + 0.4 * u + 0.15 * y * u - 0.1 * u**2,
    "sine": lambda y, u, v: 0.7 * y + 0.5 * u + 0.3 * np.sin(2 * y),
}
"""y[k] of y[k-1], u[k-1] and u[k], to which the noise is added."""


def generated(name: str, noise: float, draw: int, rows: int = ROWS) -> Case:
    """White input, noise in the equation; the test record has none."""
    records = []
    for part, (length, size) in enumerate(((rows, noise), (HELD_OUT, 0.0))):
        rng = np.random.default_rng([draw, part, list(SYSTEMS).index(name)])
        u, y = rng.normal(size=length + 1), np.zeros(length + 1)
        for k in range(1, length + 1):
            y[k] = SYSTEMS[name](y[k - 1], u[k - 1], u[k]) + size * rng.normal()
        records.append(oa.Record.from_arrays(u, y))
    texts = ("y[k-1]", "u[k-1]", "u[k]")[: 3 if name == "saturation" else 2]
    return Case(
        *records, oa.Baseline.from_terms([oa.Term(f"p{i}", text) for i, text in enumerate(texts)])
    )


def problems() -> Iterator[tuple[str, Sequence[Case] | None]]:
    """Name and fits of each line of the table; None for what cannot be measured here."""
    for data_set in (1, 3):
        clean = oa.synthetic.static(data_set)
        yield f"static, set {data_set}, no noise, 5 starts", [of(clean, seed) for seed in range(5)]
    yield (
        "static, set 1, 30 dB, the paper's draw, 10 starts",
        [of(noisy(1, 0), seed) for seed in range(10)],
    )
    for data_set in (1, 3):
        yield (
            f"static, set {data_set}, 30 dB, 8 draws",
            [of(noisy(data_set, draw)) for draw in range(1, 9)],
        )
    machine = oa.synthetic.mass_spring_damper()
    yield "mass-spring-damper, 5 starts", [of(machine, seed) for seed in range(5)]
    yield (
        "the same, 5 pieces of 500 rows",
        [of(machine, 0, slice(a, a + 500)) for a in (0, 500, 1000, 2000, 6000)],
    )
    for noise in (0.003, 0.1):
        for name in SYSTEMS:
            yield (
                f"{name}, noise {noise}, 5 draws",
                [generated(name, noise, draw) for draw in range(5)],
            )
    for name in SYSTEMS:
        yield (
            f"{name}, noise 0.03, 5 draws of 150 rows",
            [generated(name, 0.03, draw, 150) for draw in range(5)],
        )
    yield "MR damper, 5 starts [N]", mr_damper()
    yield "Silverbox, 2 starts [V]", silverbox()


def test_rmse(case: Case, regularization: str) -> float:
    """One step ahead."""
    train, test, baseline, seed, learner, lags, skip = case
    options = {"learner": learner, "lags": lags, "seed": seed, "regularization": regularization}
    fit = oa.estimate(train, baseline, **options)  # type: ignore[arg-type]
    return float(fit.model.predict(test).scores(skip).rmse[0])


@cache
def rows() -> list[tuple[str, list[float | None]]]:
    """The lines of the table: medians of the test RMSE."""
    return [
        (
            name,
            [
                None
                if cases is None
                else float(np.median([test_rmse(case, one) for case in cases]))
                for one in TRIED
            ],
        )
        for name, cases in problems()
    ]


def table() -> list[list[float | None]]:
    """The numbers of docs/decisions/regularization.md."""
    return [found for _, found in rows()]


def default() -> float:
    """By how many per cent the median of auto is above that of the best single choice, at most."""
    measured = [[one for one in found if one is not None] for found in table() if None not in found]
    return max(100 * (found[-1] / min(found[:-1]) - 1) for found in measured)


def main() -> None:
    print(describe())
    print(f"| example | {' | '.join(TRIED)} |\n|---|---|---|---|---|")
    for name, found in rows():
        print(
            f"| {name} | "
            f"{' | '.join('absent' if one is None else f'{one:.3g}' for one in found)} |",
            flush=True,
        )
    print(f"\nauto is at most {default():.1f} % above the best single choice")


if __name__ == "__main__":
    main()
