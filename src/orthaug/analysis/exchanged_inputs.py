"""Two inputs that are read from each other's columns: physics alone with the columns exchanged."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from orthaug._base.errors import Warning
from orthaug.data.regressors import lag_rows
from orthaug.physics.problem import Problem

_CLEARLY = 0.5  # of the error one step ahead: exchanged columns leave less
_MOST_INPUTS = 5
_MOST_ROWS = 20_000


def exchanged_inputs(problem: Problem) -> tuple[Warning, ...]:
    """Return a warning where physics alone is far better with two inputs exchanged, or none.

    It is refitted one step ahead with every pair of inputs exchanged; the best pair is named.
    """
    record = problem.record
    count = len(record.inputs)
    if not 2 <= count <= _MOST_INPUTS or len(record) > _MOST_ROWS or not problem.baseline.names:
        return ()
    every = list(range(count))
    before, found = _left(problem, every), []
    for a, b in itertools.combinations(every, 2):
        order = [b if i == a else a if i == b else i for i in every]
        found.append((_left(problem, order), a, b))
    after, a, b = min(found)
    if not after < _CLEARLY * before:
        return ()
    first, second = record.inputs[a].name, record.inputs[b].name
    text = (
        f"{first} and {second} may be exchanged: with the columns of both exchanged, physics alone "
        f"has an error one step ahead of {after:.3g} instead of {before:.3g} standard deviations "
        "of the output. Check the columns that these inputs are read from."
    )
    return (Warning("exchanged_inputs", text),)


def _left(problem: Problem, order: list[int]) -> float:
    """Return the RMS error of physics alone one step ahead, its inputs in that order.

    In deviations of the outputs; infinite where there is none.
    """
    moved = tuple(replace(e, inputs=e.inputs[:, order]) for e in problem.record.experiments)
    x = lag_rows(replace(problem.record, experiments=moved), problem.layout)
    phi, known = problem.baseline.on(x, problem.layout, problem.outputs)
    if len(phi) != len(problem.rows.y):
        return float("inf")
    columns = (phi / problem.deviation[:, None]).reshape(-1, phi.shape[2])
    target = ((problem.rows.y - known) / problem.deviation).ravel()
    if not (np.isfinite(columns).all() and np.isfinite(target).all()):
        return float("inf")
    size = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(size > 0, size, 1.0)
    left = target - columns @ np.linalg.lstsq(columns, target, rcond=None)[0]
    return float(np.sqrt(np.mean(left**2)))
