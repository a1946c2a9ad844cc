"""Regressors that a run visits, each with its row in the record, and the place where a quantity is largest."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Int

from orthaug._base.checks import Matrix, Vector
from orthaug.data.record import Record

MOST_STEPS = 20_000  # rows that a check looks at, spread evenly


@dataclass(frozen=True)
class Place:
    """A regressor by its entries, and where it stands: experiment, row in it, and both in words.

    `experiment` and `row` are None for a regressor that no run has visited.
    """

    experiment: int | None
    row: int | None
    where: str
    regressor: dict[str, float]

    def __str__(self) -> str:
        return f"{self.where} ({', '.join(f'{name} = {value:.4g}' for name, value in self.regressor.items())})"


@dataclass(frozen=True, eq=False)
class Visited:
    """Regressors `x` (m, nx) with the experiment and the row of each; -1 for those that no run has visited.

    `names` are those of the nx entries.
    """

    names: tuple[str, ...]
    x: Matrix
    experiment: Int[np.ndarray, "m"]
    row: Int[np.ndarray, "m"]

    def __len__(self) -> int:
        return len(self.x)

    def take(self, which: Any) -> Visited:
        """Those at the indices `which`, or where a mask is true."""
        return replace(self, x=self.x[which], experiment=self.experiment[which], row=self.row[which])

    def with_box(self, of: Visited, count: int) -> Visited:
        """With `count` regressors more, uniform in the box that others span; the same ones on every call."""
        if not count:
            return self
        more = np.random.default_rng(0).uniform(of.x.min(axis=0), of.x.max(axis=0), (count, of.x.shape[1]))
        nowhere = np.full(count, -1)
        experiment, row = np.concatenate([self.experiment, nowhere]), np.concatenate([self.row, nowhere])
        return Visited(self.names, np.concatenate([self.x, more]), experiment, row)

    def worst(self, record: Record, values: Vector) -> tuple[float | None, Place | None]:
        """The largest of the values (m,) and its place; None where no value is finite."""
        values = np.where(np.isfinite(values), values, -1.0)
        if values.max(initial=-1.0) < 0:
            return None, None
        i = int(np.argmax(values))
        experiment, row, size = int(self.experiment[i]), int(self.row[i]), float(values[i])
        regressor = {name: float(v) for name, v in zip(self.names, self.x[i], strict=True)}
        if experiment < 0:
            return size, Place(None, None, "a point off the trajectory", regressor)
        where = f"experiment {experiment}, {record.experiments[experiment].where(row)}"
        return size, Place(experiment, row, where, regressor)


def evenly(count: int, most: int) -> Int[np.ndarray, "m"]:
    """At most `most` of `count` indices, spread evenly."""
    return np.arange(count) if count <= most else np.linspace(0, count - 1, most).round().astype(int)


def positive(scale: Vector) -> Vector:
    """The scale, 1 where it is 0 or not finite."""
    return np.where(np.isfinite(scale) & (scale > 0), scale, 1.0)
