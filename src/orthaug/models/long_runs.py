"""A lagged model along a source: scores from running sums, a free run from piece to piece."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug.data.record import Experiment
from orthaug.data.sources import Source, as_record
from orthaug.models.dynamics import Run
from orthaug.models.model import Model
from orthaug.models.on_records import RUNAWAY
from orthaug.models.response import Response, Scores, scores_of
from orthaug.physics.moments import Moments


class RunPiece(NamedTuple):
    """A piece, the inputs of its steps, and the free run over its rows behind the history."""

    piece: Experiment
    inputs: Matrix
    run: Run


def pieces_of(model: Model, source: Source) -> Iterator[Experiment]:
    """Return the pieces of a source that have rows behind the history that the model needs."""
    first = model.form.first_row
    return (
        piece
        for partition in source.partitions
        for piece in partition.pieces(first)
        if len(piece) > first
    )


def run_pieces(model: Model, source: Source) -> Iterator[RunPiece]:
    """Yield the free run along every experiment of a source, from the measured outputs of each."""
    record, first = as_record(source, (_empty_experiment(source),)), model.form.first_row
    state: Any = None
    ended: tuple[str, int] = ("", -1)
    for piece in pieces_of(model, source):
        if ended != (piece.source, piece.offset + first):
            state = model.form.start(piece.outputs[:first], [first])[0]
        inputs = model.form.inputs(piece, record)
        run = model.form.run(model.numbers, state, inputs)
        yield RunPiece(piece, inputs, run)
        state = _state_after(model, state, np.asarray(run.parts.total))
        ended = piece.source, piece.offset + len(piece)


def responses(model: Model, source: Source, *, free: bool) -> Iterator[tuple[Experiment, Response]]:
    """Yield one-step predictions or free runs of a source, piece by piece.

    A run that left all bounds has no more values.
    """
    record = as_record(source, (_empty_experiment(source),))
    if not free:
        for piece in pieces_of(model, source):
            yield piece, model.predict(replace(record, experiments=(piece,)))
        return
    lost: tuple[str, int] | None = None
    for piece, inputs, run in run_pieces(model, source):
        run_piece = model.as_trajectory(run, inputs, piece, record)
        before = lost == (piece.source, piece.offset + model.form.first_row)
        if before:
            run_piece = replace(
                run_piece,
                baseline=run_piece.baseline * np.nan,
                learner=run_piece.learner * np.nan,
                diverged=None,
            )
        lost = (piece.source, piece.offset + len(piece)) if before or run_piece.diverged else None
        yield piece, Response((run_piece,), None, model.outputs, source.sampling_time)


def _state_after(model: Model, state: Vector, outputs: Matrix) -> Vector:
    """Return the state after outputs (m, ny) of a run that began in a state."""
    before = state.reshape(model.form.memory, len(model.outputs))[::-1]
    past = np.concatenate([before, outputs])
    return model.form.start(past, [len(past)])[0]


def _empty_experiment(source: Source) -> Experiment:
    return Experiment(np.zeros((0, len(source.inputs))), np.zeros((0, len(source.outputs))))


@dataclass
class RunningScores:
    """`Scores` of rows that come one after another."""

    squares: Any = 0.0
    moments: Moments | None = None
    rows: int = 0

    def add(self, measured: Matrix, model: Matrix) -> None:
        """Add more rows (m, ny)."""
        with np.errstate(all="ignore"):
            self.squares = self.squares + np.sum((measured - model) ** 2, axis=0)
        seen = Moments.of(measured)
        self.moments = seen if self.moments is None else self.moments | seen
        self.rows += len(measured)

    def scores(self) -> Scores:
        """Return RMSE, NRMSE and FIT of all rows."""
        assert self.moments is not None and self.rows, "no row was scored"
        with np.errstate(all="ignore"):
            rmse = np.sqrt(self.squares / self.rows)
        return scores_of(rmse, np.sqrt(np.diag(self.moments.covariance)), self.rows)


Watch = Callable[[Experiment, int, Matrix], None]
"""Called with a piece, its first row with a prediction, and the one-step residual from there on
(m, ny).
"""


class LongScores(NamedTuple):
    """Scores over a whole source, and where its free run left all bounds: file, row and output."""

    prediction: Scores
    simulation: Scores
    diverged: tuple[str, int, str] | None


def scores_along(
    model: Model, source: Source, skip: int = 0, watch: Watch | None = None
) -> LongScores:
    """Return scores of the one-step prediction and the free run over a source.

    The first `skip` rows of each recording are left out.
    """
    record, first = as_record(source, (_empty_experiment(source),)), model.form.first_row
    one_step, free, diverged = RunningScores(), RunningScores(), None
    for piece, _, run in run_pieces(model, source):
        kept = slice(max(skip - piece.offset - first, 0), None)
        measured, free_run = piece.outputs[first:], np.asarray(run.parts.total)
        ahead = np.asarray(model.parts_at(model.form.regressors(piece, record)).total)
        if watch is not None:
            watch(piece, first, measured - ahead)
        one_step.add(measured[kept], ahead[kept])
        free.add(measured[kept], free_run[kept])
        diverged = diverged or _runaway(model, piece, first, free_run)
    return LongScores(one_step.scores(), free.scores(), diverged)


def _runaway(
    model: Model, piece: Experiment, first: int, run: Matrix
) -> tuple[str, int, str] | None:
    with np.errstate(all="ignore"):
        wild = ~(np.abs(run) <= RUNAWAY * model.largest_output)
    if not wild.any():
        return None
    row = int(np.argmax(wild.any(axis=1)))
    return piece.source, piece.offset + first + row, model.outputs[int(np.argmax(wild[row]))].name
