"""Structures: how the fitted function `g = φc + f` is split between physics and learner (F2).

Every structure spans the same functions. It decides two things only: how training holds the learner's
share in the span of the physics, and which part of `c = θ − θ_aux` is called θ afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from orthaug._arrays import Vector


@runtime_checkable
class Structure(Protocol):
    """What `estimate(structure=…)` takes."""

    @property
    def name(self) -> str: ...

    def split(self, least_squares: Vector, aux: Vector) -> tuple[Vector, Vector]:
        """(θ, θ_aux) from `Φ⁺Y` and `Φ⁺F`, both (nθ,); always `θ − θ_aux = Φ⁺(Y − F)`."""
        ...


@dataclass(frozen=True)
class Orthogonal:
    """ŷ = φ(θ − θ_aux) + f with θ_aux = Φ⁺F (eq:orth_param): θ̂ = Φ⁺Y for every learner (F1)."""

    name: str = "orthogonal"

    def split(self, least_squares: Vector, aux: Vector) -> tuple[Vector, Vector]:
        return least_squares, aux


@dataclass(frozen=True)
class Additive:
    """ŷ = φθ + f (eqs:additive_struct): θ takes what this learner happens to leave, so it is not unique."""

    name: str = "additive"

    def split(self, least_squares: Vector, aux: Vector) -> tuple[Vector, Vector]:
        return least_squares - aux, 0.0 * aux
