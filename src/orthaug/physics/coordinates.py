"""What is estimated of physical parameters: p itself, or log p where p is positive.

A logarithm keeps its parameter positive without a bound, and steps of it are relative.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool

from orthaug._base.checks import Vector
from orthaug.physics.parameters import PhysicalParameter

_SMALLEST = math.exp(-30.0)  # of p⁰: a positive parameter that is smaller is zero


@dataclass(frozen=True)
class Coordinates:
    """The map between parameters p (np,) and what is estimated q (np,)."""

    parameters: tuple[PhysicalParameter, ...]

    @property
    def positive(self) -> Bool[np.ndarray, "np"]:
        """Which are estimated as logarithms: those that cannot be negative and start above zero."""
        return np.array([p.min >= 0 and p.initial > 0 for p in self.parameters], dtype=bool)

    @property
    def initial(self) -> Vector:
        """q⁰ (np,)."""
        return self.of(np.array([p.initial for p in self.parameters], dtype=float))

    def of(self, p: Any) -> Vector:
        """q of p; logarithms end at the smallest value that counts."""
        least = np.array([_SMALLEST * abs(parameter.initial) for parameter in self.parameters])
        p = np.asarray(p, dtype=float)
        return np.where(self.positive, np.log(np.maximum(np.where(self.positive, p, 1.0), least + 1e-300)), p)

    def physical(self, q: Any, xp: Any = np) -> Any:
        """p of q, by `xp` (numpy or jax.numpy)."""
        return xp.where(self.positive, xp.exp(xp.where(self.positive, q, 0.0)), q)

    def slopes(self, q: Vector) -> Vector:
        """∂p/∂q (np,)."""
        return np.where(self.positive, self.physical(q), 1.0)

    @property
    def bounds(self) -> tuple[Vector, Vector]:
        """Lower and upper bounds of q, each (np,)."""
        return self.of([p.min for p in self.parameters]), self.of([p.max for p in self.parameters])
