"""Saved models on data files: what `orthaug simulate` and `orthaug predict` do."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.errors import InputError
from orthaug._base.folders import whole_file
from orthaug._base.warning import Warning
from orthaug.data.readers import read_record
from orthaug.data.record import Record
from orthaug.data.tables import check_readable, has_column

if TYPE_CHECKING:
    from orthaug.models.model import Model
    from orthaug.models.motion_model import MotionModel
    from orthaug.models.response import Response


@dataclass(frozen=True, eq=False)
class ModelOnData:
    """A saved model with the record of a data file."""

    model: Model | MotionModel
    record: Record
    source: Path


def open_run(model: Path, data: Path, *, need_outputs: bool = False) -> ModelOnData:
    """Load a model and read its channels from a file; outputs only where the file has them, unless needed.

    Raises:
        InputError: no model, no file, missing columns.
    """
    check_readable(data)
    from orthaug.models.storage import load

    loaded = load(model)
    held = [c for c in loaded.outputs if has_column(data, c.file_column)]
    if need_outputs or not loaded.inputs or len(held) == len(loaded.outputs):
        held = list(loaded.outputs)
    elif held:
        missing = [c.name for c in loaded.outputs if c not in held]
        raise InputError(f"{data}: has some of the model's outputs but not {', '.join(missing)}; give all or none.")
    step = None if loaded.time_column else loaded.sampling_time
    record = read_record(data, inputs=loaded.inputs, outputs=held, sampling_time=step, time=loaded.time_column)
    return ModelOnData(loaded, record, data)


def read_initial(initial: str | None, opened: ModelOnData) -> str | Any:
    """The `initial` of `Model.simulate`: measured where the data have outputs, zero otherwise, or a CSV's rows."""
    if initial is None:
        return "measured" if opened.record.outputs else "zero"
    if initial in ("measured", "zero"):
        if initial == "measured" and not opened.record.outputs:
            raise InputError(f"{opened.source}: has no measured outputs to start from; use --initial zero or a CSV.")
        return initial
    if not Path(initial).suffix and "/" not in initial:
        raise InputError(f"--initial: found '{initial}'; expected measured, zero, or a CSV file of the first outputs.")
    record = read_record(initial, outputs=opened.model.outputs, sampling_time=opened.model.sampling_time)
    try:
        opened.model.check_initial(record.experiments[0].outputs)
    except InputError as error:
        raise InputError(f"{initial}: {error}") from None
    return record.experiments[0].outputs


def notes(opened: ModelOnData, initial: str | None) -> list[str]:
    """What a user may not expect of a free run: where it starts when nothing says so."""
    if initial is not None or opened.record.outputs or not opened.model.form.states:
        return []
    names = ", ".join(channel.name for channel in opened.model.outputs)
    return [f"note: {opened.source} has no {names}: the free run starts from 0; --initial CSV gives other outputs."]


def with_initial(opened: ModelOnData, initial: str | Any) -> Record:
    """The record with the outputs of its first rows replaced, for predictions that start from others."""
    if isinstance(initial, str) and initial == "measured":
        return opened.record
    start, experiment = opened.model.form.first_row, opened.record.experiments[0]
    if opened.model.form.states and not opened.model.form.memory:
        raise InputError(
            "--initial: found with a motion, whose predictions start from states that are estimated from the rows "
            "before them; leave it out."
        )
    outputs = experiment.outputs.copy()
    rows = np.zeros((start, outputs.shape[1])) if isinstance(initial, str) else initial[:start]
    outputs[start - len(rows) : start] = rows
    return replace(opened.record, experiments=(replace(experiment, outputs=outputs),))


def warnings(response: Response) -> list[Warning]:
    """Warnings about a response."""
    told = "the free run diverged in output '{}' at step {}; it has no values from there on."
    ends = (trajectory.diverged for trajectory in response.trajectories if trajectory.diverged)
    return [Warning("free_run_diverged", told.format(output, step)) for step, output in ends]


def write_csv(response: Response, out: Path | None, *, force: bool = False) -> None:
    """One row per data row, empty cells where there is no value; to a file (whole or not at all) or standard output."""
    frame = response.to_frame()
    if out is None:
        frame.to_csv(sys.stdout, index=False)
        return
    with whole_file(out, force=force) as partial:
        frame.to_csv(partial, index=False)
