"""Which regularization should be the default? Test errors on the paper's examples and on Silverbox.

Silverbox is read from ORTHAUG_DATA (default ../shared/data); left out where it is absent.
Run: python benchmarks/regularization.py
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from machine import describe

import orthaug as oa

SEEDS = range(5)


def silverbox() -> tuple[oa.Record, oa.Record, oa.Baseline] | None:
    """Training record, multisine test and linear physics."""
    path = Path(os.environ.get("ORTHAUG_DATA", "../shared/data")) / "silverbox" / "SNLS80mV.csv"
    if not path.exists():
        return None
    train, test = (
        oa.read_record(path, inputs=["V1"], outputs=["V2"], sampling_time=1 / 610.35, rows=rows)
        for rows in ((40650, 105712), (105712, 127400))
    )
    texts = ("V2[k-1]", "V2[k-2]", "V1[k]", "V1[k-1]", "V1[k-2]", "1")
    return train, test, oa.Baseline.from_terms([oa.Term(f"p{i}", text) for i, text in enumerate(texts)])


def row(name: str, train: oa.Record, test: oa.Record, baseline: oa.Baseline, skip: int = 0, **options: object) -> None:
    """One line of the table: medians over seeds of the test RMSE, one step and free run."""
    cells = []
    for regularization in ("none", "evidence"):
        one, free, weights = [], [], []
        for seed in options.get("seeds", SEEDS):  # type: ignore[attr-defined]
            fit = oa.estimate(
                train,
                baseline,
                learner=oa.MLP((options.get("neurons", 16),)),  # type: ignore[arg-type]
                regularization=regularization,
                seed=seed,
            )
            one.append(fit.model.predict(test).scores(skip).rmse[0])
            free.append(fit.model.simulate(test).scores(skip).rmse[0])
            weights.append(fit.effective_weights)
        cells.append(f"{np.median(one):.3g} / {np.median(free):.3g} ({np.median(weights):.0f})")
    print(f"| {name} | {' | '.join(cells)} |", flush=True)


def main() -> None:
    print(describe())
    print("| example | none: one step / free run (effective weights) | evidence |\n|---|---|---|")
    for noise in (False, True):
        for data_set in (1, 3):
            example = oa.synthetic.static(data_set, noise=noise)
            name = f"static, set {data_set}, {'30 dB' if noise else 'no noise'}"
            row(name, example.train, example.test, example.baseline)
    example = oa.synthetic.mass_spring_damper()
    row("mass-spring-damper", example.train, example.test, example.baseline)
    short = example.train.rows(0, 500)
    row("mass-spring-damper, 500 rows", short, example.test, example.baseline)
    measured = silverbox()
    if measured is not None:
        row("Silverbox, 10 neurons [V]", *measured, skip=50, neurons=10, seeds=range(2))


if __name__ == "__main__":
    main()
