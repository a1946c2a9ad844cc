"""Effect of wild samples on θ: least squares of physics with and without their rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from orthaug.data.regressors import stack_rows
from orthaug.data.wild import WildSample
from orthaug.physics.problem import Problem

_FEWEST = 3  # rows for each parameter
_SHOWN = 4
_MOVED = 0.01  # of a value: less is none


def fit_without(problem: Problem, samples: Sequence[WildSample]) -> str:
    """Return a clause on the parameters that move where the rows of these samples are left out.

    They are those of physics without a learner.
    """
    record, names = problem.record, problem.baseline.names
    marked = []
    for i, experiment in enumerate(record.experiments):
        inputs, outputs = np.zeros_like(experiment.inputs), np.zeros_like(experiment.outputs)
        for sample in samples:
            if sample.experiment == i:
                target, column = (
                    (inputs, sample.column)
                    if sample.column < len(record.inputs)
                    else (outputs, sample.column - len(record.inputs))
                )
                target[sample.row, column] = 1.0
        marked.append(replace(experiment, inputs=inputs, outputs=outputs))
    rows = stack_rows(replace(record, experiments=tuple(marked)), problem.layout)
    kept = ~((rows.x != 0).any(axis=1) | (rows.y != 0).any(axis=1))
    if len(kept) != problem.count or kept.all() or kept.sum() < _FEWEST * len(names) or not names:
        return ""
    phi = problem.baseline.on(problem.rows.x, problem.layout, problem.outputs)[0][kept].reshape(
        -1, len(names)
    )
    size = np.linalg.norm(phi, axis=0)
    if not np.all(size > 0):
        return ""
    there = np.linalg.lstsq(phi / size, problem.target[kept].reshape(-1), rcond=None)[0] / size
    pairs = zip(names, problem.least_squares, there, strict=True)
    moved = [
        f"{n} = {b:.4g} instead of {a:.4g}"
        for n, a, b in pairs
        if abs(a - b) > _MOVED * max(abs(a), abs(b))
    ]
    if not moved:
        return "Physics alone gives the same without it."
    return f"Without it physics alone gives {', '.join(moved[:_SHOWN])}."
