"""A lagged model over rows in a source: its segments, and runs along whole experiments.

Segments are those of the same rows in memory, cut anew at every pass, or once where the rows are. A
segment belongs to the partition in which the first row that it needs is, and is read on from the
partitions after it. Where experiments begin and end is asked of all partitions first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from orthaug._base.checks import Vector
from orthaug._base.errors import InputError
from orthaug._base.jax import jax, jnp, padded_length
from orthaug.data.record import Experiment, Record
from orthaug.data.sources import Source, Span, follows
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.initial_states import InitialStates, Start
from orthaug.fitting.objective import FreeRunObjective
from orthaug.fitting.one_step import OneStepTask
from orthaug.fitting.rules import check_scored
from orthaug.fitting.segment_sums import SegmentSums
from orthaug.fitting.segmented_lagged import SegmentedLagged, declared_settings, lagged_dynamics
from orthaug.fitting.segmented_problem import COLOUR_ROWS, COLOURED_STEPS, TrialInMemory
from orthaug.fitting.segments import CHUNK, Segments, begins_of, build_segments, segment_of
from orthaug.fitting.solvers.minimize import Descent
from orthaug.models.dynamics import Dynamics, Numbers
from orthaug.models.rows import Engine
from orthaug.physics.streamed import StreamedProblem

_SETTLING = 4  # Gauss-Newton steps of a subsample's states


@dataclass(frozen=True, eq=False, kw_only=True)
class SegmentedStreamed(SegmentedLagged):
    """A source's rows cut into segments where an engine reads or keeps them.

    `record` is a subsample of them.
    """

    source: Source
    found: ExperimentStarts
    empty: Record

    @classmethod
    def of(cls, task: OneStepTask, criterion: Criterion) -> SegmentedStreamed:
        """Cut the problem's source as a criterion of several steps declares.

        Raises:
            InputError: nothing would be scored; whole experiments as segments, which would have to
                fit into memory.
        """
        problem, free_run, sums = task.problem, criterion.free_run, SegmentSums(task.engine)
        assert free_run is not None and isinstance(problem, StreamedProblem)
        if not free_run.steps:
            raise InputError(
                "`segment` is 0, whole experiments, which need their rows in memory; give a "
                "number of steps, such as 512, or a Record."
            )
        dynamics = lagged_dynamics(task)
        empty, source, washout = problem.basis.form.empty, problem.source, free_run.washout
        found = ExperimentStarts.of(task.engine.passes(look, source.partitions))
        longest = max(found.rows) - dynamics.first_row
        check_scored(criterion, longest)
        made = (task.engine, source, found, dynamics, empty)
        segments: Any = SourceSegments.cut(*made, free_run.steps, washout)
        whole: Any = segments
        colour: Any = None
        if criterion.simulates:
            count = sum(
                max(rows - dynamics.first_row - min(washout, longest - 1), 0) for rows in found.rows
            )
            whole = WholeRuns(
                task.engine, source.partitions, empty, min(washout, longest - 1), count
            )
            if segments.steps < COLOURED_STEPS <= longest:
                colour = SourceSegments.cut(*made, 0, washout, COLOUR_ROWS)
        layout: dict[str, Any] = {"segments": segments, "whole": whole, "colour": colour}
        cut = {"source": source, "found": found, "empty": empty}
        return cls(
            **layout, **cut, **declared_settings(task, criterion), dynamics=dynamics, sums=sums
        )

    @property
    def lengthens(self) -> bool:
        return False

    def _build_segments(self, segment: int, washout: int) -> Any:
        made = (self.task.engine, self.source, self.found, self.dynamics, self.empty)
        return SourceSegments.cut(*made, segment, washout)

    def _mean_square(self, c: Vector, w: Any, tilt: Any) -> float:
        if not isinstance(self.whole, WholeRuns):
            return super()._mean_square(c, w, tilt)
        squares = self.whole.squares(self.dynamics, self.numbers(c, w, tilt))
        return float(np.sum(squares / self.deviation**2)) / (self.whole.count * len(self.deviation))

    def end_in_memory(self, objective: FreeRunObjective, end: Descent) -> TrialInMemory:
        """Return the segments of the subsample.

        Where that is all rows, with the states that were trained.
        """
        free_run = self.free_run
        segments = build_segments(self.record, self.dynamics, free_run.steps, free_run.washout)
        initial = InitialStates(np.asarray(segments.start), objective.initial.free)
        p, start = end.point.p, Start(initial.measured)
        seen = replace(objective, segments=segments, initial=initial, sums=None, colour=None)
        if len(self.record) == sum(self.found.rows):
            trained: Any = self.segments
            own = np.moveaxis(end.point.states, 1, -1)[np.asarray(trained.there)]  # (segments, n0)
            place = np.zeros((initial.measured.shape[0] * initial.measured.shape[2], own.shape[1]))
            place[: len(own)] = own
            k, n0, m = initial.measured.shape
            start = Start(np.moveaxis(place.reshape(k, m, n0), -1, 1))
        else:
            for _ in range(_SETTLING if initial.free else 0):
                start = seen.linearise(seen.evaluate(p, start)).start
        there = seen.evaluate(p, start)
        linear = seen.linearise(there)
        return TrialInMemory(seen, there, linear.start.slope)


class RunState(NamedTuple):
    """A run at some row: its state, the squares of its errors (ny,), and its next row."""

    state: Any = None
    squares: Any = 0.0
    ended: tuple[str, int] = ("", -1)
    done: int = 0
    """Steps of this experiment."""


@dataclass(frozen=True, eq=False)
class PartitionRuns:
    """A partition's part of the runs, which start at measured values.

    Picklable if the physics is.
    """

    dynamics: Dynamics
    numbers: Numbers
    empty: Record
    washout: int
    """Leading steps of an experiment that are not scored."""

    def __call__(self, partition: Any, run: RunState) -> RunState:
        first = self.dynamics.first_row
        for piece in partition.pieces(first):
            if len(piece) <= first:
                continue
            if run.ended != (piece.source, piece.offset + first):
                run = RunState(self.dynamics.start(piece.outputs, [first])[0], run.squares)
            inputs, target = self.dynamics.inputs(piece, self.empty), piece.outputs[first:]
            rows = len(target)
            length = padded_length(rows)
            scored = (np.arange(length) < rows) & (run.done + np.arange(length) >= self.washout)
            padded = (
                np.concatenate([part, np.zeros((length - rows, part.shape[1]))])
                for part in (inputs, target)
            )
            given = (self.dynamics, self.numbers, run.state, *padded, scored, np.int64(rows))
            state, squares = map(np.asarray, _advance_rows(*given))
            run = RunState(
                state,
                run.squares + squares,
                (piece.source, piece.offset + len(piece)),
                run.done + rows,
            )
        return run


@partial(jax.jit, static_argnames="dynamics")
def _advance_rows(
    dynamics: Dynamics,
    numbers: Numbers,
    state: Any,
    inputs: Any,
    target: Any,
    scored: Any,
    rows: Any,
) -> tuple[Any, Any]:
    """Return the state after some rows, and the squares (ny,) of the scored errors."""
    numbers = dynamics.prepare(numbers)

    def step(carry: Any, row: Any) -> tuple[Any, None]:
        state, squares = carry
        inputs, target, scored, there = row
        following, parts = dynamics.step(numbers, state, inputs)
        squares = squares + jnp.where(scored, (target - parts.total) ** 2, 0.0)
        return (jnp.where(there, following, state), squares), None

    there = jnp.arange(len(inputs)) < rows
    return jax.lax.scan(step, (state, jnp.zeros(target.shape[1])), (inputs, target, scored, there))[
        0
    ]


@dataclass(frozen=True, eq=False)
class WholeRuns:
    """Whole experiments of a source, over which runs are compared.

    `count` of their steps are scored.
    """

    engine: Engine
    partitions: Any
    empty: Record
    washout: int
    count: int

    def squares(self, dynamics: Dynamics, numbers: Numbers) -> Vector:
        """Return Σ e² (ny,) of the errors, in the outputs' units."""
        running = PartitionRuns(dynamics, numbers, self.empty, self.washout)
        return np.asarray(self.engine.along(running, self.partitions, RunState()).squares)


@dataclass(frozen=True)
class PieceShape:
    """A piece of a partition without its rows: the other fields of `Experiment`."""

    source: str
    first_row: int
    offset: int
    rows: int

    def __len__(self) -> int:
        return self.rows


def look(partition: Any) -> list[PieceShape]:
    """Return the pieces of a partition."""
    return [
        PieceShape(piece.source, piece.first_row, piece.offset, len(piece))
        for piece in partition.pieces(0)
    ]


@dataclass(frozen=True, eq=False)
class ExperimentStarts:
    """The first rows of a source's experiments, over all partitions, and their lengths."""

    begins: tuple[int, ...]
    rows: tuple[int, ...]
    ends: Int[np.ndarray, "partitions"]
    """Where the partitions end."""

    @classmethod
    def of(cls, seen: Sequence[Sequence[PieceShape]]) -> ExperimentStarts:
        """Return the starts from the pieces of all partitions."""
        begins, rows, total = [], [], 0
        last: PieceShape | None = None
        for piece in (piece for pieces in seen for piece in pieces):
            if last is not None and follows(last, piece):
                rows[-1] += piece.rows
            else:
                begins.append(total)
                rows.append(piece.rows)
            total, last = total + piece.rows, piece
        return cls(
            tuple(begins), tuple(rows), np.cumsum([sum(p.rows for p in pieces) for pieces in seen])
        )


@dataclass(frozen=True, eq=False)
class Part:
    """The segments that begin in a partition: rows `[first, last)` of its span, (n, 2)."""

    span: Span
    rows: Int[np.ndarray, "n 2"]
    held: tuple[Any, ...] = ()

    @classmethod
    def of(cls, span: Span, rows: Any) -> Part:
        return cls(span, np.asarray(rows), span.held)

    def on(self, *held: object) -> Part:
        """Return the part where the rows are."""
        return Part(self.span.on(*held), self.rows)


@dataclass(frozen=True, eq=False)
class SegmentCutter:
    """Rules by which rows become segments, in chunks of `width`; picklable if the physics is."""

    dynamics: Dynamics
    empty: Record
    """Channels and sampling time."""
    steps: int
    washout: int
    width: int

    def __call__(self, part: Part) -> Iterator[Segments]:
        waiting: list[Segments] = []
        for experiment in _slices(part):
            inputs = self.dynamics.inputs(experiment, self.empty)
            waiting.append(
                segment_of(experiment, inputs, 0, self.steps, self.washout, self.dynamics)
            )
            if len(waiting) == self.width:
                yield self._chunk(waiting)
                waiting = []
        if waiting:
            yield self._chunk(waiting)

    def _chunk(self, segments: list[Segments]) -> Segments:
        nothing = Segments(*(np.zeros_like(part) for part in segments[0]))
        filled = segments + [nothing] * (self.width - len(segments))
        return Segments(*(np.stack(part, axis=-1) for part in zip(*filled, strict=True)))


def _slices(part: Part) -> Iterator[Experiment]:
    """Yield the rows of each segment; those before the next one are let go."""
    pieces, begin = part.span.pieces(0), 0
    inputs, outputs = [], []
    for first, last in part.rows.tolist():
        while begin + sum(map(len, inputs)) < last:
            piece = next(pieces)
            inputs.append(piece.inputs)
            outputs.append(piece.outputs)
        while begin + len(inputs[0]) <= first:
            begin += len(inputs.pop(0))
            outputs.pop(0)
        inputs, outputs = (
            [np.concatenate(group)] if len(group) > 1 else group for group in (inputs, outputs)
        )
        yield Experiment(
            inputs[0][first - begin : last - begin], outputs[0][first - begin : last - begin]
        )


@dataclass(frozen=True)
class SegmentStarts:
    """The measured states of a chunk, a mask of its segments, and the number of scored steps."""

    def __call__(self, segments: Segments) -> tuple[Any, Any]:
        return (segments.start, jnp.any(segments.scored, axis=0)), jnp.sum(segments.scored)


@dataclass(frozen=True, eq=False)
class SourceSegments:
    """The segments of a source where an engine reads or keeps them.

    Elsewhere they count as `Segments` do.
    """

    rows: Any
    """Of the engine, chunks of `Segments`."""
    steps: int
    count: int
    """Scored steps."""
    start: Float[np.ndarray, "k n0 m"]
    there: Any
    """(k, m), which are scored anywhere."""
    outputs: int

    @property
    def observations(self) -> Int[np.ndarray, "ny"]:
        """Number of scored steps of each output: none is missing."""
        return np.full(self.outputs, self.count)

    @classmethod
    def cut(
        cls,
        engine: Engine,
        source: Any,
        found: ExperimentStarts,
        dynamics: Dynamics,
        empty: Record,
        segment: int,
        washout: int,
        most: int | None = None,
    ) -> SourceSegments:
        """Return segments of `segment` steps, the first `most` rows of each in use.

        0 for whole experiments.
        """
        lag = dynamics.first_row
        usable = [(rows if most is None else min(rows, most)) - lag for rows in found.rows]
        steps = min(segment, max(usable)) if segment else max(usable)
        washout = min(washout, steps - 1)
        places = [
            (begin + own, begin + own + lag + min(steps, rows - own))
            for begin, rows in zip(found.begins, usable, strict=True)
            for own in begins_of(rows, steps, washout)
        ]
        rows = np.array(places).reshape(-1, 2)
        owner = np.searchsorted(found.ends, rows[:, 0], side="right")
        reach = np.searchsorted(found.ends, rows[:, 1] - 1, side="right")
        parts, counts = [], []
        for i in np.unique(owner).tolist():
            own, last = rows[owner == i], int(reach[owner == i].max())
            before = int(found.ends[i - 1]) if i else 0
            into = int(rows[owner == i, 1].max() - (found.ends[last - 1] if last > i else 0))
            parts.append(Part.of(Span.of(source.partitions[i : last + 1], into), own - before))
            counts.append(len(own))
        width = max(-(-n // -(-n // CHUNK)) for n in counts)
        cutting = SegmentCutter(dynamics, empty, steps, washout, width)
        read = engine.read(cutting, parts, [-(-n // width) for n in counts])
        kept, count = engine.keep(SegmentStarts(), read)
        start, there = engine.fetch(kept)
        return cls(
            read, steps, int(count), np.asarray(start), np.asarray(there), len(dynamics.outputs)
        )
