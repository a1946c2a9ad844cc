"""Which regularization should be the default? Test errors on the paper's examples and on Silverbox.

Silverbox is left out where its data are absent.
Run: python benchmarks/regularization.py
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from machine import data_folder, describe

import orthaug as oa

SEEDS = range(5)
Cell = tuple[float | None, float | None, float | None]
NOT_HERE: Cell = (None, None, None)


def silverbox() -> tuple[oa.Record, oa.Record, oa.Baseline] | None:
    """Training record, multisine test and linear physics."""
    path = data_folder() / "silverbox" / "SNLS80mV.csv"
    if not path.exists():
        return None
    train, test = (
        oa.read_record(path, inputs=["V1"], outputs=["V2"], sampling_time=1 / 610.35, rows=rows)
        for rows in ((40650, 105712), (105712, 127400))
    )
    texts = ("V2[k-1]", "V2[k-2]", "V1[k]", "V1[k-1]", "V1[k-2]", "1")
    return train, test, oa.Baseline.from_terms([oa.Term(f"p{i}", text) for i, text in enumerate(texts)])


def cells(
    train: oa.Record, test: oa.Record, baseline: oa.Baseline, skip: int = 0, neurons: int = 16, seeds: range = SEEDS
) -> list[Cell]:
    """None and evidence: medians over seeds of the test RMSE, one step and free run, and of the effective weights."""
    found = []
    for regularization in ("none", "evidence"):
        runs = []
        for seed in seeds:
            learner = oa.MLP((neurons,))
            fit = oa.estimate(train, baseline, learner=learner, regularization=regularization, seed=seed)
            one, free = fit.model.predict(test), fit.model.simulate(test)
            runs.append((one.scores(skip).rmse[0], free.scores(skip).rmse[0], fit.effective_weights))
        one, free, weights = np.median(runs, axis=0)
        found.append((float(one), float(free), float(weights)))
    return found


def rows() -> Iterator[tuple[str, list[Cell]]]:
    """The lines of the table; None for what cannot be measured here."""
    for noise in (False, True):
        for data_set in (1, 3):
            example = oa.synthetic.static(data_set, noise=noise)
            name = f"static, set {data_set}, {'30 dB' if noise else 'no noise'}"
            yield name, cells(example.train, example.test, example.baseline)
    example = oa.synthetic.mass_spring_damper()
    yield "mass-spring-damper", cells(example.train, example.test, example.baseline)
    short = example.train.rows(0, 500)
    yield "mass-spring-damper, 500 rows", cells(short, example.test, example.baseline)
    measured = silverbox()
    yield "Silverbox, 10 neurons [V]", cells(*measured, 50, 10, range(2)) if measured else [NOT_HERE, NOT_HERE]


def table() -> list[list[Cell]]:
    """The numbers of docs/design.md."""
    return [found for _, found in rows()]


def main() -> None:
    print(describe())
    print("| example | none: one step / free run (effective weights) | evidence |\n|---|---|---|")
    for name, found in rows():
        if NOT_HERE not in found:
            told = (f"{one:.3g} / {free:.3g} ({weights:.0f})" for one, free, weights in found)
            print(f"| {name} | {' | '.join(told)} |", flush=True)


if __name__ == "__main__":
    main()
