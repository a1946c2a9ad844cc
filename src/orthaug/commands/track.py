"""Tracking of a saved model's parameters over new data: `orthaug track`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthaug._base.errors import InputError, Warning
from orthaug._base.folders import file_digest, whole_folder
from orthaug.analysis.fit_findings import parameter_rows, physical_rows
from orthaug.commands.folder import results_beside, save_json
from orthaug.commands.run import ReadOptions, missing_notes, prepared_notes, record_for
from orthaug.commands.split import open_training
from orthaug.data.record import Record
from orthaug.data.tables import check_readable
from orthaug.physics.parameters import PhysicsMap
from orthaug.reports.result import FileResult
from orthaug.reports.tracking import TrackResult

if TYPE_CHECKING:
    from orthaug.fitting.recursive import Recursive
    from orthaug.models.model import Model

STATE = "state"
"""The folder in a result that a later run continues from."""


@dataclass(frozen=True, eq=False)
class TrackingInput:
    """A model with new data, its training data, and the physical parameters of its result."""

    model: Model
    records: tuple[Record, ...]
    """Of each file."""
    training: Record | None
    files: tuple[FileResult, ...]
    physics: PhysicsMap | None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class TrackingReport:
    """The result of tracking."""

    online: Recursive
    result: TrackResult
    physics: PhysicsMap | None


def open_track(
    model: Path,
    data: Sequence[Path],
    training: Sequence[Path],
    rows: tuple[int, int] | None,
    state: Path | None,
) -> TrackingInput:
    """Load a model, new data, and the files that it was trained on.

    Raises:
        InputError: no model, no data, a motion, training files missing where no state is given, or
            given beside one.
    """
    from orthaug.models.storage import load

    if not data:
        raise InputError("--data: is missing; give at least one file of new data.")
    if state is None and not training:
        raise InputError(
            "--training: is missing; give the files that the model was trained on, or --state "
            "of a run."
        )
    if state is not None and training:
        raise InputError(
            "--training: found beside --state, which holds the statistics of training; leave "
            "one of them out."
        )
    for path in data:
        check_readable(path)
    loaded = load(model)
    if not loaded.form.separates:
        from orthaug.fitting.recursive_rows import MOTION

        raise InputError(f"{model}: {MOTION}")
    records, files, notes = [], [], []
    for path in data:
        records.append(record_for(loaded, path, loaded.outputs, ReadOptions("skip", prepare=True)))
        files.append(FileResult(file=str(path), sha256=file_digest(path), rows=len(records[-1])))
        notes += missing_notes(loaded, path, records[-1])
    given = open_training(model, training, rows) if training else None
    if given is not None:
        prepared = prepared_notes(loaded, given.record)
        notes += [note for note in given.notes if note not in prepared]
    physics = _physics_of(model, loaded.sampling_time)
    notes = (*prepared_notes(loaded, Record.join(records)), *notes)
    return TrackingInput(
        loaded, tuple(records), given and given.record, tuple(files), physics, notes
    )


def _physics_of(model: Path, sampling_time: float) -> PhysicsMap | None:
    """Return the map to physical parameters, from the result beside a model; None without one."""
    from orthaug.commands.spec import spec_model

    for content in results_beside(model):
        with suppress(ValueError, KeyError, TypeError):
            return spec_model().model_validate(content["spec"]).physics_map(sampling_time)
    return None


def track(
    opened: TrackingInput,
    *,
    forgetting: float | None,
    memory: float | None,
    state: Path | None,
    follows: bool,
) -> TrackingReport:
    """Track the parameters over the new rows.

    Raises:
        InputError: forgetting beside a state, a state of another model, other than the training
            data.
    """
    from orthaug.fitting.recursive import Recursive
    from orthaug.models.storage import digest

    if state is None:
        online = Recursive(
            opened.model, training=opened.training, forgetting=forgetting, memory=memory
        )
    else:
        if forgetting is not None or memory is not None:
            raise InputError(
                "--forgetting, --memory: found beside --state, which holds them; leave them out."
            )
        place = state / STATE if (state / STATE).is_dir() else state
        online = Recursive.load(place)
        if digest(online.fitted) != digest(opened.model):
            raise InputError(f"{state}: is the state of another model; give a state of this model.")
    for i, record in enumerate(opened.records):
        online.update(record, gap=i > 0 or not follows)
    return TrackingReport(online, _result(opened, online), opened.physics)


def _result(opened: TrackingInput, online: Recursive) -> TrackResult:
    from orthaug.fitting.recursive import outside_text
    from orthaug.models.storage import digest

    step, factor = opened.model.sampling_time, online.forgetting
    baseline = opened.model.form.baseline
    warnings = []
    if online.std is None:
        text = "no standard errors: the fit has none, or the rows do not determine θ."
        warnings.append(Warning("no_standard_errors", text))
    if online.outside:
        text = outside_text(online.outside, online.rows)
        warnings.append(Warning("learner_extrapolates", f"{text[0].upper()}{text[1:]}."))
    physical: Any = None
    if opened.physics is not None:
        estimate = online.physical(opened.physics)
        physical = physical_rows(estimate)
        warnings += estimate.warnings
    return TrackResult.model_validate(
        {
            "files": opened.files,
            "model": digest(opened.model),
            "rows": online.rows,
            "outside": online.outside,
            "time": online.rows * step,
            "forgetting": factor,
            "memory": None if factor == 1 else -step / math.log(factor),
            "effective_rows": online.effective_rows,
            "parameters": parameter_rows(
                baseline.parameters, online.theta, online.std, online.interval
            ),
            "physical_parameters": physical,
            "alarms": list(online.alarms),
            "alarmed": online.alarmed,
            "alarm_level": online.alarm_level,
            "warnings": warnings,
        }
    )


def write_tracked(tracked: TrackingReport, folder: Path, text: str, *, force: bool = False) -> None:
    """Write result.json, report.txt, table.csv, figures/ and the state, whole or not at all."""
    from orthaug.reports.drawing import save
    from orthaug.reports.plots import tracking_figure

    online, result = tracked.online, tracked.result
    history = online.history
    physical = None if tracked.physics is None else online.physical_history(tracked.physics)
    alarms = [alarm.time for alarm in online.alarms]
    with whole_folder(folder, force=force) as partial:
        save_json(result, partial)
        (partial / "report.txt").write_text(text + "\n", encoding="utf-8")
        history.to_csv(partial / "table.csv")
        if physical is not None:
            physical.to_csv(partial / "physical.csv")
        (partial / "figures").mkdir()
        figure = tracking_figure(
            history, result.parameters, alarms, None, physical, result.physical_parameters or ()
        )
        save(figure, partial / "figures" / "parameters.png")
        (partial / STATE).mkdir()
        online.fill(partial / STATE)
