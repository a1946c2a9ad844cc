"""Ranges and moments of columns, which parts of a record join."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from orthaug._base.checks import Matrix, Vector


class Extent(NamedTuple):
    """Smallest and largest value of some columns, (n,) each; `|` joins those of two parts."""

    low: Vector
    high: Vector

    @classmethod
    def of(cls, values: Matrix) -> Extent:
        return cls(values.min(axis=0, initial=np.inf), values.max(axis=0, initial=-np.inf))

    def __or__(self, other: Extent) -> Extent:
        return Extent(np.minimum(self.low, other.low), np.maximum(self.high, other.high))


class Moments(NamedTuple):
    """Count, mean and scatter `Σ (v − v̄)(v − v̄)ᵀ` of columns; `|` joins those of two parts."""

    count: int
    mean: Vector
    scatter: Matrix

    @classmethod
    def of(cls, values: Matrix) -> Moments:
        mean = values.mean(axis=0) if len(values) else np.zeros(values.shape[1])
        return cls(len(values), mean, (values - mean).T @ (values - mean))

    def __or__(self, other: Moments) -> Moments:
        """Return the moments of both together (Chan, Golub and LeVeque 1983)."""
        count = self.count + other.count
        if not count:
            return self
        apart = other.mean - self.mean
        scatter = (
            self.scatter
            + other.scatter
            + np.outer(apart, apart) * (self.count * other.count / count)
        )
        return Moments(count, self.mean + apart * (other.count / count), scatter)

    @property
    def covariance(self) -> Matrix:
        return self.scatter / max(self.count, 1)

    @property
    def square(self) -> float:
        """Sum of all squares."""
        return float(np.trace(self.scatter) + self.count * self.mean @ self.mean)
