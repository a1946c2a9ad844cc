"""States and inputs along a run, with their rows in the record, and the place of a maximum."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Int

from orthaug._base.checks import Matrix, Vector, positive
from orthaug.data.record import Record
from orthaug.models.dynamics import Dynamics
from orthaug.models.model import Model
from orthaug.models.response import Response

Describe = Callable[[Vector, Vector], dict[str, float]]

MOST_STEPS = 20_000  # rows that a check looks at, spread evenly


@dataclass(frozen=True)
class RunPoint:
    """A point by its entries and its place: experiment, row in it, and both in words.

    `experiment` and `row` are None for a point that no run has visited.
    """

    experiment: int | None
    row: int | None
    where: str
    regressor: dict[str, float]

    def __str__(self) -> str:
        return (
            f"{self.where} "
            f"({', '.join(f'{name} = {value:.4g}' for name, value in self.regressor.items())})"
        )


@dataclass(frozen=True, eq=False)
class RowIndex:
    """The experiment and the row (m,) of each of m points; -1 for those that no run has visited."""

    experiment: Int[np.ndarray, "m"]
    row: Int[np.ndarray, "m"]

    @classmethod
    def of(cls, lengths: Sequence[int], first: int) -> RowIndex:
        """Return `count` rows of each experiment, from the row `first` on."""
        experiment = [np.full(length, i) for i, length in enumerate(lengths)]
        return cls(
            np.concatenate(experiment),
            np.concatenate([np.arange(length) + first for length in lengths]),
        )

    def __len__(self) -> int:
        return len(self.row)

    def take(self, which: Any) -> RowIndex:
        """Return those at the indices `which`, or where a mask is true."""
        return RowIndex(self.experiment[which], self.row[which])

    def and_nowhere(self, count: int) -> RowIndex:
        """Return the rows with `count` further points that no run has visited."""
        return RowIndex(
            *(np.concatenate([known, np.full(count, -1)]) for known in (self.experiment, self.row))
        )

    def worst(
        self, record: Record, values: Vector, entries: Callable[[int], dict[str, float]]
    ) -> tuple[float | None, RunPoint | None]:
        """Return the largest of the values (m,) and its place, with the entries of that point.

        None where none is finite.
        """
        values = np.where(np.isfinite(values), values, -1.0)
        if values.max(initial=-1.0) < 0:
            return None, None
        i = int(np.argmax(values))
        experiment, row, size = int(self.experiment[i]), int(self.row[i]), float(values[i])
        if experiment < 0:
            return size, RunPoint(None, None, "a point off the trajectory", entries(i))
        where = f"experiment {experiment}, {record.experiments[experiment].where(row)}"
        return size, RunPoint(experiment, row, where, entries(i))


@dataclass(frozen=True, eq=False)
class RunPoints:
    """Points of a run: states (m, n0), inputs (m, nu) of a step from there, and their places."""

    states: Matrix
    inputs: Matrix
    where: RowIndex

    def __len__(self) -> int:
        return len(self.states)

    def take(self, which: Any) -> RunPoints:
        """Return those at the indices `which`, or where a mask is true."""
        return replace(
            self, states=self.states[which], inputs=self.inputs[which], where=self.where.take(which)
        )

    def with_box(self, of: RunPoints, count: int) -> RunPoints:
        """Return the points and `count` more, uniform in the box that other points span.

        The same ones on every call.
        """
        if not count:
            return self
        spanned = np.hstack([of.states, of.inputs])
        more = np.random.default_rng(0).uniform(
            spanned.min(axis=0), spanned.max(axis=0), (count, spanned.shape[1])
        )
        states, inputs = np.split(more, [self.states.shape[1]], axis=1)
        where = self.where.and_nowhere(count)
        return replace(
            self,
            states=np.concatenate([self.states, states]),
            inputs=np.concatenate([self.inputs, inputs]),
            where=where,
        )

    def worst(
        self, record: Record, values: Vector, describe: Describe
    ) -> tuple[float | None, RunPoint | None]:
        """Return the largest of the values (m,) and its place in words of the dynamics.

        None where no value is finite.
        """
        return self.where.worst(record, values, lambda i: describe(self.states[i], self.inputs[i]))


@dataclass(frozen=True, eq=False)
class RunSample:
    """At most so many `points` of a run of `steps` steps, and where it `diverged`.

    `unit` (n0,) is what counts as one in each entry of the state: the deviation of the measured
    output it is a lag of, or else its own over the points.
    """

    points: RunPoints
    steps: int
    unit: Vector
    diverged: tuple[str, ...]


def usable(model: Model, record: Record) -> Record:
    """Return the record's channels in the model's order.

    Raises:
        InputError: other channels, or too few rows in an experiment.
    """
    record = model.fitting(record, need_outputs=True)
    for experiment in record.experiments:
        model.check_rows(experiment, model.form.first_row)
    return record


def sample_free_run(model: Model, record: Record, free_run: Response, most: int) -> RunSample:
    """Return points of a free run from measured outputs, spread evenly up to where it diverged."""
    form: Dynamics = model.form
    record, start, runs = usable(model, record), form.first_row, free_run.trajectories
    ends = [t.diverged[0] + 1 if t.diverged else len(t.model) for t in runs]
    every = RowIndex.of([end - start for end in ends], start)
    some = every.take(even_indices(len(every), most))
    pieces = []
    for i, (experiment, run) in enumerate(zip(record.experiments, runs, strict=True)):
        rows = some.row[some.experiment == i]
        inputs = form.inputs(experiment, record)
        outputs = np.concatenate([experiment.outputs[:start], run.model[start:]])
        states = form.states_at(model.numbers, outputs, inputs, rows)
        pieces.append((states, inputs[rows - start]))
    visited, inputs = (np.concatenate(piece) for piece in zip(*pieces, strict=True))
    points = RunPoints(visited, inputs, some)
    unit = _units(form, points, record.deviation)
    diverged = tuple(
        f"{t.diverged[1]} at experiment {i}, {e.where(t.diverged[0])}"
        for i, (e, t) in enumerate(zip(record.experiments, runs, strict=True))
        if t.diverged
    )
    return RunSample(points, len(every), unit, diverged)


def _units(form: Dynamics, points: RunPoints, deviation: Vector) -> Vector:
    """Return one over what an entry costs in deviations of the outputs.

    Its own deviation where it is free.
    """
    if not len(points):
        return np.ones(form.states)  # of what may be too long for a matrix
    per_output = positive(deviation)
    cost = np.linalg.norm(form.start_rows(np.diag(1 / per_output)), axis=0)
    return np.where(cost > 0, 1 / positive(cost), positive(points.states.std(axis=0)))


def even_indices(count: int, most: int) -> Int[np.ndarray, "m"]:
    """Return at most `most` of `count` indices, spread evenly."""
    return (
        np.arange(count) if count <= most else np.linspace(0, count - 1, most).round().astype(int)
    )
