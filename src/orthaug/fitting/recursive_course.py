"""θ over time as recursive least squares has left it, kept within bounds: what covariances are made of, row by row."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from orthaug._base.checks import Matrix, Vector
from orthaug.fitting.recursion import Recursion, upright
from orthaug.inference.covariance import interval

MOST = 10_000
"""Rows that are kept; of more every second one, every fourth, and so on."""


@dataclass(eq=False)
class Course:
    """A row of numbers for each row of data that was used.

    Columns: the row's number, the level of the alarm (above 1 it stands), s², degrees of freedom, whether θ is told,
    the residuals (ny), θ (nθ), R and M (nθ² each).
    """

    ny: int
    nt: int
    stride: int = 1
    _lines: list[Vector] = field(default_factory=list)

    @property
    def rows(self) -> Matrix:
        """All that is kept (k, columns)."""
        return np.reshape(self._lines, (-1, 5 + self.ny + self.nt + 2 * self.nt**2))

    def line(self, row: int, level: float, freedom: float, residual: Vector, recursion: Recursion) -> Vector:
        """What is kept of a row."""
        line = np.empty(5 + self.ny + self.nt + 2 * self.nt**2)
        first, second = 5 + self.ny, 5 + self.ny + self.nt
        line[:5] = row, level, recursion.level, freedom, recursion.determined
        line[5:first] = residual
        line[first:second] = recursion.theta
        line[second : second + self.nt**2] = recursion.factor_now.ravel()
        line[second + self.nt**2 :] = recursion.squared.ravel()
        return line

    def add(self, line: Vector) -> None:
        """Keep one more."""
        if int(line[0]) % self.stride:
            return
        self._lines.append(line)
        if len(self._lines) > MOST:
            self.stride *= 2
            self._lines = [line for line in self._lines if not int(line[0]) % self.stride]

    @property
    def theta(self) -> Float[np.ndarray, "k nt"]:
        return self.rows[:, 5 + self.ny : 5 + self.ny + self.nt]

    @property
    def residual(self) -> Float[np.ndarray, "k ny"]:
        return self.rows[:, 5 : 5 + self.ny]

    @property
    def alarm(self) -> Vector:
        """The level of the alarm (k,)."""
        return self.rows[:, 1]

    def covariances(self, inflation: Matrix | None) -> Float[np.ndarray, "k nt nt"]:
        """Cov θ of every row; NaN where there is none."""
        squares = self.rows[:, 5 + self.ny + self.nt :].reshape(-1, 2, self.nt, self.nt)
        return covariances(squares[:, 0], squares[:, 1], self.rows[:, 2], self.rows[:, 4] > 0, inflation)

    def intervals(self, inflation: Matrix | None) -> Float[np.ndarray, "k nt 2"]:
        """95 % intervals of θ."""
        std = np.sqrt(np.diagonal(self.covariances(inflation), axis1=1, axis2=2))
        pairs = zip(self.theta, std, self.rows[:, 3], strict=True)
        return np.array([interval(*pair) for pair in pairs]).reshape(-1, self.nt, 2)


def covariances(
    r: Float[np.ndarray, "k nt nt"],
    squared: Float[np.ndarray, "k nt nt"],
    level: Vector,
    told: Bool[np.ndarray, "k"],
    inflation: Matrix | None,
) -> Float[np.ndarray, "k nt nt"]:
    """`s² S G Sᵀ` with `S Sᵀ = I⁻¹ M I⁻¹`: G, the inflation, is by how much the fit's own covariance exceeds that."""
    result = np.full(r.shape, np.nan)
    if inflation is None or not told.any():
        return result
    half = _half(r[told], squared[told])
    result[told] = level[told, None, None] * (half @ inflation @ np.swapaxes(half, 1, 2))
    return result


def inflation_of(r: Matrix, squared: Matrix, level: float, covariance: Matrix | None) -> Matrix | None:
    """G of a fit: its covariance in units of `s² I⁻¹ M I⁻¹`; None where it has none.

    It holds what else makes θ uncertain: the learner beside it, or the colour of the errors (`fit.robust()`).
    """
    if covariance is None or not np.isfinite(covariance).all() or not level > 0:
        return None
    half = _half(r[None], squared[None])[0]
    return np.linalg.solve(half, np.linalg.solve(half, covariance).T) / level


def _half(r: Float[np.ndarray, "k nt nt"], squared: Float[np.ndarray, "k nt nt"]) -> Float[np.ndarray, "k nt nt"]:
    """`S = R⁻¹ (R⁻ᵀ M R⁻¹)^½` of factors that are made unique by a positive diagonal."""
    r = upright(r)
    unit = np.linalg.norm(r, axis=1, keepdims=True)  # of the columns
    inverse = np.swapaxes(unit, 1, 2) ** -1 * np.linalg.inv(r / unit)
    values, vectors = np.linalg.eigh(np.swapaxes(inverse, 1, 2) @ squared @ inverse)
    return inverse @ ((vectors * np.sqrt(np.maximum(values, 0.0))[:, None]) @ np.swapaxes(vectors, 1, 2))
