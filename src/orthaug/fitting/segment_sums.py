"""Sums over chunks of segments that an engine keeps, for training on free runs.

A trial is the sum of the errors' squares, a linearisation that of the normal equations from which
the states of each segment are eliminated where the segment is. How these states follow (c, w) stays
there too: n0 numbers a segment, its state, come back.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import AnyArray, Array, jnp
from orthaug.fitting.initial_states import InitialStates, Start, without_states
from orthaug.fitting.segments import Segments, chunk_response, chunk_sensitivity
from orthaug.models.dynamics import Dynamics, Numbers
from orthaug.models.rows import Engine

_KEPT = 4  # layouts of a record: its own, and lengths of the segments on the way there


class Best(NamedTuple):
    """States of a chunk's segments, and the derivative of the best ones by (c, w)."""

    values: Float[AnyArray, "n0 m"]
    offset: Float[AnyArray, "m n0"]
    slope: Float[AnyArray, "m n0 n"]

    def moved(self, step: Any) -> Float[Array, "n0 m"]:
        """Return the best states where (c, w) has moved by `step` (n,)."""
        return self.values + (self.offset - self.slope @ step).T


class Squares(NamedTuple):
    """Sums of a trial: `‖r‖²` of errors and states, and Σ e eᵀ (ny, ny) in outputs' units."""

    misfit: AnyArray
    errors: AnyArray


def _errors(
    dynamics: Dynamics, numbers: Numbers, segments: Segments, states: Any
) -> Float[Array, "T ny m"]:
    run = chunk_response(dynamics, dynamics.prepare(numbers), states, segments.inputs)
    there = segments.scored[:, None] & ~jnp.isnan(segments.target)
    return jnp.where(there, segments.target - run, 0.0)


@dataclass(frozen=True)
class TrialSquares:
    """`Squares` of one chunk, from its states or from those moved with (c, w)."""

    dynamics: Dynamics
    moves: bool

    def __call__(
        self, chunk: Any, numbers: Numbers, weight: AnyArray, rows: Any, step: AnyArray
    ) -> Squares:
        segments, start = chunk
        states = start.moved(step) if self.moves else start
        errors = _errors(self.dynamics, numbers, segments, states)
        misfit = jnp.sum(jnp.einsum("oi,tim->tom", weight, errors) ** 2)
        misfit = misfit + jnp.sum((rows @ (segments.start - states)) ** 2)
        return Squares(misfit, jnp.einsum("tim,tjm->ij", errors, errors))


@dataclass(frozen=True)
class SegmentEquations:
    """A chunk's share of the normal equations, and the derivative of its states.

    The derivative, by (c, w), stays with the chunk.
    """

    dynamics: Dynamics
    free: bool

    def __call__(
        self, chunk: tuple[Segments, AnyArray], numbers: Numbers, weight: AnyArray, rows: AnyArray
    ) -> tuple[Any, tuple[Any, Any]]:
        segments, states = chunk
        numbers = self.dynamics.prepare(numbers)
        there = (states, segments.inputs, segments.target, segments.scored)
        shared, own = chunk_sensitivity(self.dynamics, numbers, there, weight)
        if not self.free:
            return None, (shared[:-1, :-1], shared[:-1, -1])
        missed = (segments.start - states).T
        made = without_states(shared, jnp.moveaxis(own, -1, 0), missed, rows.T @ rows, jnp)
        return Best(states, made[2], made[3]), (made[0], made[1])


@dataclass(frozen=True)
class MovedStates:
    """The states of a chunk after a step of (c, w); this adds nothing to a sum."""

    def __call__(self, best: Best, step: AnyArray) -> tuple[Any, Any]:
        return best.moved(step), ()


@dataclass(frozen=True)
class Spectra:
    """Σ |DFT|² (ny, …) of the errors along a chunk's segments, and the number of nonzero errors."""

    dynamics: Dynamics
    size: int

    def __call__(self, chunk: Any, numbers: Numbers) -> tuple[Any, Any]:
        errors = _errors(self.dynamics, numbers, *chunk)
        return jnp.sum(jnp.abs(jnp.fft.rfft(errors, self.size, axis=0)) ** 2, axis=-1).T, jnp.sum(
            errors != 0, (0, 2)
        )


@dataclass(frozen=True, eq=False)
class SegmentSums:
    """Sums over segments by an engine. Each layout of them is placed once."""

    engine: Engine
    placed: dict[int, tuple[Any, Any]] = field(default_factory=dict)
    one_at_a_time: Any = field(default_factory=threading.Lock)

    @classmethod
    def of(cls, engine: Engine) -> SegmentSums | None:
        """Return the sums of an engine; None where its rows are in memory.

        Whole runs are compiled then.
        """
        return None if engine.resident else cls(engine)

    def rows(self, segments: Any) -> Any:
        """Return the segments as the engine keeps them."""
        with self.one_at_a_time:
            known = self.placed.get(id(segments))
            if known is None:
                while len(self.placed) >= _KEPT:
                    self.placed.pop(next(iter(self.placed)))
                there = (
                    self.engine.place(segments) if isinstance(segments, Segments) else segments.rows
                )
                known = self.placed[id(segments)] = (segments, there)
            return known[1]

    def with_states(self, segments: Any, states: AnyArray) -> Any:
        """Return the segments beside their states (k, n0, m)."""
        rows = self.rows(segments)
        return self.engine.beside(rows, self.engine.place(np.asarray(states), rows))

    def try_step(
        self,
        dynamics: Dynamics,
        numbers: Numbers,
        segments: Any,
        start: Start,
        step: Vector | None,
        *made: Matrix,
    ) -> tuple[float, Matrix]:
        """Return `‖r‖²` and Σ e eᵀ from the states of a start.

        With `step`, from the states to which they moved.

        Args:
            made: weight (ny, ny) and L (n0, n0), of errors and of states.
        """
        if step is None:
            rows, step = self.with_states(segments, start.values), np.zeros(0)
            trying = TrialSquares(dynamics, moves=False)
        else:
            rows, trying = (
                self.engine.beside(self.rows(segments), start.there),
                TrialSquares(dynamics, moves=True),
            )
        found = self.engine.sum(trying, rows, numbers, *made, step)
        return float(found.misfit), np.asarray(found.errors)

    def squares(self, dynamics: Dynamics, numbers: Numbers, segments: Any) -> Matrix:
        """Return Σ e eᵀ (ny, ny) from the measured states."""
        ny, n0 = len(dynamics.outputs), dynamics.states
        start = Start(np.asarray(segments.start))
        return self.try_step(dynamics, numbers, segments, start, None, np.eye(ny), np.eye(n0))[1]

    def moved(self, start: Start, step: Vector) -> Float[np.ndarray, "k n0 m"]:
        """Return the states after a step of (c, w)."""
        return np.asarray(self.engine.fetch(self.engine.keep(MovedStates(), start.there, step)[0]))

    def linearised(
        self,
        dynamics: Dynamics,
        numbers: Numbers,
        segments: Any,
        initial: InitialStates,
        states: AnyArray,
        *made: Matrix,
    ) -> tuple[Matrix, Vector, Any]:
        """Return the normal equations of (c, w) with the states at their best, and `Best`.

        `Best` stays where the segments are.
        """
        rows = self.with_states(segments, states)
        kept, (hessian, gradient) = self.engine.keep(
            SegmentEquations(dynamics, initial.free), rows, numbers, *made
        )
        return np.asarray(hessian), np.asarray(gradient), kept if initial.free else None

    def slope(self, there: Any) -> Float[np.ndarray, "k m n0 n"]:
        """Return the derivative of the best states by (c, w), fetched from the engine."""
        return np.asarray(self.engine.fetch(there).slope)

    def spectra(
        self, dynamics: Dynamics, numbers: Numbers, segments: Any, states: Any, size: int
    ) -> tuple[Matrix, Vector]:
        """Return `Spectra` over all segments."""
        found = self.engine.sum(
            Spectra(dynamics, size), self.with_states(segments, states), numbers
        )
        return np.asarray(found[0]), np.asarray(found[1])
