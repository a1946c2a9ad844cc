"""Which unit of the learner's output to choose (docs/decisions/output_unit.md): test RMSE for 1 to 100 residual deviations.

The unit is the prior under evidence regularisation, and the size of a Xavier start without. Medians over
12 noise draws (the first is the paper's) or over initialisations. Run: python benchmarks/output_unit.py
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import cache

import numpy as np
from machine import describe

import orthaug as oa
from orthaug._base.jax import jax
from orthaug.fitting.one_step import OUTPUT_UNIT, OneStepTask
from orthaug.physics.problem import pose
from orthaug.studies import synthetic

UNITS, NOISELESS = (1, 3, 10, 30, 100), 3


def test_rmse(
    example: synthetic.Example, unit: float, seed: int, regularization: str, iterations: int
) -> float:
    """RMSE of the one-step prediction on the test record."""
    problem = pose(example.train, example.baseline)
    usual = OneStepTask.of(problem, oa.MLP())
    task = OneStepTask.of(problem, oa.MLP(), usual.scaling, usual.unit * unit / OUTPUT_UNIT)
    solver = oa.LevenbergMarquardt(iterations, longest=iterations)
    run = task.run(solver, task.bound.init(jax.random.key(seed)), regularization=regularization)
    c = problem.projection.solve((problem.target - task.values(run.w)) / problem.deviation)
    test = pose(example.test, example.baseline)
    z = task.scaling(test.feature_rows())
    values = np.asarray(jax.vmap(lambda row: task.bound.values(run.w, row))(z)) * task.unit
    model = test.projection.phi @ c * test.deviation + values
    return float(np.sqrt(np.mean((test.target - model) ** 2)))


def noisy(data_set: int, draw: int) -> synthetic.Example:
    """The paper's own draw of 30 dB noise, or another one."""
    if draw == 0:
        return synthetic.static(data_set, noise=True)
    example = synthetic.static(data_set)
    experiment = example.train.experiments[0]
    noise = np.random.default_rng(draw).normal(0.0, synthetic.NOISE_30_DB, experiment.outputs.shape)
    return dataclasses.replace(
        example, train=oa.Record.from_arrays(experiment.inputs, experiment.outputs + noise)
    )


def rows() -> Iterator[tuple[int, list[tuple[float, float]]]]:
    """Each unit with the median and the largest test RMSE of every column."""
    msd, clean = synthetic.mass_spring_damper(), synthetic.static(1)
    for unit in UNITS:
        columns = (
            [test_rmse(noisy(1, draw), unit, 0, "evidence", 300) for draw in range(12)],
            [test_rmse(noisy(3, draw), unit, 0, "evidence", 300) for draw in range(12)],
            [test_rmse(noisy(1, 0), unit, seed, "evidence", 300) for seed in range(10)],
            [test_rmse(clean, unit, seed, "none", 300) for seed in range(10)],
            [test_rmse(msd, unit, seed, "none", 100) for seed in range(5)],
            [test_rmse(msd, unit, seed, "evidence", 100) for seed in range(5)],
        )
        yield unit, [(float(np.median(column)), max(column)) for column in columns]


@cache
def measured() -> dict[int, list[tuple[float, float]]]:
    return dict(rows())


def table() -> list[list[tuple[float, float]]]:
    """The numbers of docs/decisions/output_unit.md, without the noiseless column."""
    return [columns[:NOISELESS] + columns[NOISELESS + 1 :] for columns in measured().values()]


def noiseless() -> list[tuple[float, float]]:
    """Those of the noiseless column: where 300 iterations end there depends on rounding."""
    return [columns[NOISELESS] for columns in measured().values()]


def default() -> list[float]:
    """By how many per cent the median of the default is above the best unit's: largest of the others, last column."""
    medians = {
        unit: np.array([median for median, _ in columns]) for unit, columns in measured().items()
    }
    above = 100 * (medians[OUTPUT_UNIT] / np.min(list(medians.values()), axis=0) - 1)
    return [float(above[:-1].max()), float(above[-1])]


def main() -> None:
    print(describe())
    print(
        "| unit | set 1, noise | set 3, noise | set 1, 10 starts, paper's draw | set 1, no "
        "noise | MSD, no reg. | MSD |"
    )
    print("|---|---|---|---|---|---|---|")
    for unit, columns in rows():
        cells = " | ".join(f"{median:.2e} (≤ {largest:.1e})" for median, largest in columns)
        print(f"| {unit} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
