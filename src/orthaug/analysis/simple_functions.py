"""Simple functions of a regressor, in which a nonlinearity would show: powers, kinks and products of its variables."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug.physics.problem import Problem

_VARIABLES = 6  # that functions are made of, at most
_FARTHEST = 4.0  # deviations: farther values count as this far


@dataclass(frozen=True, eq=False)
class SimpleFunctions:
    """Directions of the regressor, of each channel its first lag and differences of lags, with mean and deviation."""

    variables: tuple[tuple[Vector, float, float], ...]

    @classmethod
    def of(cls, problem: Problem) -> SimpleFunctions:
        """Of what the physics and the learner read, the first lags and differences of all channels in front."""
        layout, x, each = problem.layout, problem.rows.x, np.eye(len(problem.layout))
        places: dict[str, list[int]] = {}
        for j, lag in enumerate(layout):
            places.setdefault(lag.channel, []).append(j)
        directions = []
        for i in range(max(map(len, places.values()), default=0)):
            for own in places.values():
                if i < len(own):
                    directions.append(each[own[i]] if i == 0 else each[own[i - 1]] - each[own[i]])
        moved = [(d, float((x @ d).mean()), float((x @ d).std())) for d in directions[:_VARIABLES]]
        return cls(tuple(entry for entry in moved if entry[2] > 0))

    def __len__(self) -> int:
        n = len(self.variables)
        return 5 * n + 3 * n * (n - 1) // 2

    def __call__(self, x: Matrix) -> Matrix:
        """On rows of the regressor, (N, functions)."""
        columns = []
        scaled = [np.clip((x @ d - mean) / size, -_FARTHEST, _FARTHEST) for d, mean, size in self.variables]
        for v in scaled:
            columns += [v**2, v**3, np.abs(v), v * np.abs(v), np.tanh(3 * v)]
        for i, v in enumerate(scaled):
            for w in scaled[:i]:
                columns += [v * w, v**2 * w, v * w**2]
        return np.stack(columns, axis=-1) if columns else np.zeros((len(x), 0))
