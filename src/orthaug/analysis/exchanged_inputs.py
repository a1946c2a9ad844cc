"""Inputs that are read wrongly: two from each other's columns, or one with the other sign.

Physics alone is refitted with the inputs exchanged or reversed. The coefficients of lagged physics
take a sign; parameters of a motion that are positive by their bounds do not.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.checks import Matrix
from orthaug._base.errors import InputError, Warning
from orthaug.analysis.input_timing import refit_physics, residual_of
from orthaug.data.record import Record
from orthaug.data.regressors import lag_rows
from orthaug.fitting.motion_task import MotionTask
from orthaug.physics.problem import Problem

if TYPE_CHECKING:
    from orthaug.fitting.kinds import Solver


_CLEARLY = 0.5  # of the error one step ahead: exchanged columns leave less
_MOST_INPUTS = 5
_MOST_ROWS = 20_000
# Of the outputs' deviation: physics alone that leaves less has its inputs right. It may be little
# where starts, or another output, make up most of the deviation.
_FAR = 0.1
_NEAR = 0.3  # of it, which a correction must reach
_MISTAKES = {
    "reversed_input": (
        "may have the other sign",
        "Check its sign convention; `scale` of its channel takes the other sign.",
    ),
    "exchanged_inputs": (
        "may be exchanged",
        "Check the columns that these inputs are read from.",
    ),
}
_ITERATIONS = 40  # from the initial values: where the wrong inputs led is no place to begin


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
    x = lag_rows(_read_by(problem.record, np.eye(len(order))[order]), problem.layout)
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


def _read_by(record: Record, read: Matrix) -> Record:
    """Return a record whose inputs are rows (nu, nu) of products with those of another one."""
    moved = tuple(replace(e, inputs=e.inputs @ read.T) for e in record.experiments)
    return replace(record, experiments=moved)


def misread_inputs(task: MotionTask, solver: Solver) -> tuple[Warning, ...]:
    """Return a warning where a motion is far better with an input reversed, or two exchanged.

    Args:
        task: with physics alone trained; what it leaves is set against.
    """
    record, free_fit = task.problem.record, task.physics
    count = len(record.inputs)
    before = residual_of(task.plan, free_fit)
    if free_fit is None or not 1 <= count <= _MOST_INPUTS or before < _FAR:
        return ()
    found: list[tuple[float, str, str]] = []
    names = [channel.name for channel in record.inputs]
    for i, name in enumerate(names):
        read = np.diag(np.where(np.arange(count) == i, -1.0, 1.0))
        found.append((_run_with(task, read, solver), "reversed_input", name))
    for a, b in itertools.combinations(range(count), 2):
        read = np.eye(count)
        read[[a, b]] = read[[b, a]]
        both = f"{names[a]} and {names[b]}"
        found.append((_run_with(task, read, solver), "exchanged_inputs", both))
    after, code, which = min(found)
    if not after < min(_NEAR, _CLEARLY * before):
        return ()
    mistake, remedy = _MISTAKES[code]
    text = (
        f"{which} {mistake}: so read, physics alone has a free-run error of {after:.3g} instead of "
        f"{before:.3g} standard deviations of the output. {remedy}"
    )
    return (Warning(code, text),)


def _run_with(task: MotionTask, read: Matrix, solver: Any) -> float:
    """Return what physics alone leaves of the free run with inputs read otherwise; inf if none."""
    motion, record = task.problem.motion, _read_by(task.problem.record, read)
    assert task.physics is not None
    begin = (motion.coordinates.initial, _ITERATIONS)
    try:
        return residual_of(*refit_physics(task, task.physics, motion, record, solver, *begin))
    except InputError:
        return float("inf")
