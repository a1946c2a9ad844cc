"""Free runs along whole experiments of a source: the state is carried from piece to piece, wherever these are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.jax import jax, jnp, padded_length
from orthaug.data.record import Record
from orthaug.models.dynamics import Dynamics, Numbers
from orthaug.models.rows import Engine


class Carried(NamedTuple):
    """A run that ended somewhere: its state, the squares of its errors (ny,), and where it has to go on."""

    state: Any = None
    squares: Any = 0.0
    ended: tuple[str, int] = ("", -1)
    done: int = 0
    """Steps of this experiment."""


@dataclass(frozen=True, eq=False)
class Running:
    """A partition's part of the runs, which start from what was measured; picklable if the physics is."""

    dynamics: Dynamics
    numbers: Numbers
    empty: Record
    washout: int
    """Leading steps of an experiment that are not scored."""

    def __call__(self, partition: Any, run: Carried) -> Carried:
        first = self.dynamics.first_row
        for piece in partition.pieces(first):
            if len(piece) <= first:
                continue
            if run.ended != (piece.source, piece.offset + first):
                run = Carried(self.dynamics.start(piece.outputs, [first])[0], run.squares)
            inputs, target = self.dynamics.inputs(piece, self.empty), piece.outputs[first:]
            rows = len(target)
            length = padded_length(rows)
            scored = (np.arange(length) < rows) & (run.done + np.arange(length) >= self.washout)
            padded = (np.concatenate([part, np.zeros((length - rows, part.shape[1]))]) for part in (inputs, target))
            given = (self.dynamics, self.numbers, run.state, *padded, scored, np.int64(rows))
            state, squares = map(np.asarray, _along(*given))
            run = Carried(state, run.squares + squares, (piece.source, piece.offset + len(piece)), run.done + rows)
        return run


@partial(jax.jit, static_argnames="dynamics")
def _along(
    dynamics: Dynamics, numbers: Numbers, state: Any, inputs: Any, target: Any, scored: Any, rows: Any
) -> tuple[Any, Any]:
    """The state after so many rows, and the squares (ny,) of the errors on the scored ones."""
    numbers = dynamics.prepared(numbers)

    def step(carry: Any, row: Any) -> tuple[Any, None]:
        state, squares = carry
        inputs, target, scored, there = row
        following, parts = dynamics.step(numbers, state, inputs)
        squares = squares + jnp.where(scored, (target - parts.total) ** 2, 0.0)
        return (jnp.where(there, following, state), squares), None

    there = jnp.arange(len(inputs)) < rows
    return jax.lax.scan(step, (state, jnp.zeros(target.shape[1])), (inputs, target, scored, there))[0]


@dataclass(frozen=True, eq=False)
class WholeRuns:
    """Whole experiments of a source, over which runs are compared; `count` of their steps are scored."""

    engine: Engine
    partitions: Any
    empty: Record
    washout: int
    count: int

    def squares(self, dynamics: Dynamics, numbers: Numbers) -> Vector:
        """Σ e² (ny,) of the errors, in the outputs' units."""
        running = Running(dynamics, numbers, self.empty, self.washout)
        return np.asarray(self.engine.along(running, self.partitions, Carried()).squares)
