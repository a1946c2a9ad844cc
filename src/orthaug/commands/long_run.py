"""Saved models on Parquet files of many rows: read, computed and written piece by piece."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.errors import Warning
from orthaug._base.folders import whole_file
from orthaug.commands.run import (
    ReadOptions,
    check_instants,
    experiment_column,
    measured_outputs,
    shifts_of,
)
from orthaug.data.parquet_source import open_parquet
from orthaug.data.sources import Source
from orthaug.data.tables import parquet_file

if TYPE_CHECKING:
    from orthaug.models.model import Model
    from orthaug.models.response import Scores

LONG = 1_000_000
"""Rows from which on a file is read piece by piece."""


@dataclass(frozen=True, eq=False)
class LongRun:
    """A model with a file that is not loaded; `free` for its free run, else one step ahead."""

    model: Model
    source: Source
    free: bool


def long_run(model: Path, data: Path, reading: ReadOptions, *, free: bool) -> LongRun | None:
    """Return the model on a long Parquet file with all its channels; None for a short file.

    Raises:
        InputError: no model, a file that cannot be read, a model of data that had other instants.
    """
    if (
        data.suffix.lower() != ".parquet"
        or reading != ReadOptions(columns=reading.columns)
        or not data.is_file()
    ):
        return None
    with parquet_file(data) as file:
        if file.metadata.num_rows <= LONG:
            return None
    from orthaug.models.storage import load

    loaded = load(model)
    check_instants(loaded, data)
    measured = measured_outputs(loaded, data, reading)
    if (
        not loaded.form.separates
        or experiment_column(loaded, data)
        or len(measured) < len(loaded.outputs)
        or shifts_of(loaded)
    ):
        return None
    source = open_parquet(
        [data],
        inputs=loaded.inputs,
        outputs=loaded.outputs,
        sampling_time=None if loaded.time_column else loaded.sampling_time,
        time=loaded.time_column,
        columns=reading.columns,
    )
    return LongRun(loaded, source, free)


def write(
    run: LongRun, out: Path | None, *, force: bool = False
) -> tuple[Scores | None, list[Warning]]:
    """Write the table of `run.write_csv`, to a file (whole or not at all) or standard output.

    Return the scores of all rows, None where nothing was measured, and warnings.

        There are no scores where the free run diverged.
    """
    from orthaug.models.long_runs import RunningScores, responses

    scored, warnings, first = RunningScores(), [], run.model.form.first_row
    with _open(out, force) as file:
        for piece, response in responses(run.model, run.source, free=run.free):
            (trajectory,) = response.trajectories
            frame = response.to_frame()
            if piece.offset:
                frame = frame.iloc[first:]
                frame["time"] += piece.offset * response.sampling_time
            frame.to_csv(file, index=False, header=not scored.rows)
            with np.errstate(all="ignore"):
                scored.add(piece.outputs[first:], trajectory.model[first:])
            if trajectory.diverged is not None:
                row, output = trajectory.diverged
                text = f"the free run diverged in output '{output}' at step {piece.offset + row}; "
                warnings.append(
                    Warning("free_run_diverged", text + "it has no values from there on.")
                )
    return (None if warnings or not scored.rows else scored.scores()), warnings


@contextmanager
def _open(out: Path | None, force: bool) -> Iterator[Any]:
    if out is None:
        yield sys.stdout
        return
    with (
        whole_file(out, force=force) as partial,
        partial.open("w", encoding="utf-8", newline="") as file,
    ):
        yield file
