"""Saved models on data files: `orthaug simulate`, `orthaug predict` and `orthaug explain`."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.checks import check_choice, nearest
from orthaug._base.errors import InputError, MissingSampleError, Warning
from orthaug._base.folders import file_digest, whole_file
from orthaug._base.lines import percent, plural
from orthaug.commands.folder import results_beside
from orthaug.commands.parts import gaps_text, long_stretches
from orthaug.data.channels import Channel
from orthaug.data.preparation import MENDING, SAMPLING, Preparation, steps_again
from orthaug.data.readers import read_record
from orthaug.data.record import Record
from orthaug.data.tables import check_readable, has_column
from orthaug.reports.explanation import ExplainResult

_MISSING = ("error", "skip", "keep")
_WIDE, _NARROW = 0.985, 0.9  # share of the values in a band of 95 %, from which on it is wrong

if TYPE_CHECKING:
    from orthaug.analysis.observed import Consistency
    from orthaug.models.model import Model
    from orthaug.models.response import Response


@dataclass(frozen=True)
class ReadOptions:
    """The rows and columns of a data file to read, as a part of a spec declares them."""

    missing: str = "error"
    """"error", "skip" or "keep", or "auto": keep where the model runs through gaps, else skip."""
    rows: Any = None
    """A half-open range of rows, or several; None for all."""
    every: int = 1
    columns: Mapping[str, str] = field(default_factory=dict)
    prepare: bool | None = None
    """True if the rows go through the preparation of the training data; None where that is open.
    """

    @classmethod
    def of(
        cls,
        missing: str,
        rows: str | None,
        every: int,
        columns: Sequence[str],
        prepare: bool | None,
    ) -> ReadOptions:
        """Return the options of a command.

        Raises:
            InputError: an invalid value of an option.
        """
        check_choice(missing, _MISSING, "--missing")
        if every < 1:
            raise InputError(f"--every: found {every}; expected 1 or more.")
        named = {}
        for text in columns:
            name, equal, column = text.partition("=")
            if not (name and equal and column):
                raise InputError(
                    f"--column: found '{text}'; expected NAME=COLUMN, such as position=yVal."
                )
            named[name] = column
        return cls(missing, read_rows(rows), every, named, prepare)


@dataclass(frozen=True, eq=False)
class ModelOnData:
    """A saved model with the record of a data file, and the number of rows read."""

    model: Model
    record: Record
    source: Path
    rows: int = 0
    notes: tuple[str, ...] = ()
    warnings: tuple[Warning, ...] = ()
    withheld: bool = False
    """True if its fit gave no standard errors, for a reason that other parameters share."""
    first_row: int = 0
    """Row of the file that the rows that were read begin at."""


def read_rows(text: str | None) -> tuple[int, int] | None:
    """Return the range `A:B` as a half-open range of rows."""
    if text is None:
        return None
    start, _, stop = text.partition(":")
    if not (start.isdecimal() and stop.isdecimal() and text.isascii()):
        raise InputError(
            f"--rows: found '{text}'; expected a half-open range of rows such as 0:1000."
        )
    return int(start), int(stop)


def trained_reading(model: Path, data: Path) -> ReadOptions | None:
    """Return the options by which a model's training file was read, from the result beside it.

    None for a file that the model was not trained on.
    """
    from orthaug.commands.data_sections import column_sets

    digest = file_digest(data)
    for content in results_beside(model):
        with suppress(AttributeError, KeyError, TypeError, ValueError):
            if digest in [file["sha256"] for file in content["data"]["train"]]:
                part = content["spec"]["data"]["train"]
                rows = np.reshape(part.get("rows") or [], (-1, 2)).astype(int).tolist() or None
                kept = content["spec"]["data"].get("missing") == "keep"
                return ReadOptions(
                    "keep" if kept else "skip",
                    rows,
                    int(part.get("every") or 1),
                    column_sets(part.get("columns") or {})[0],
                    True,
                )
    return None


def open_explained(
    model: Path,
    data: Sequence[Path],
    rows: tuple[int, int] | None,
    missing: str | None = None,
) -> ModelOnData:
    """Return a model with the files to explain it over.

    Of files that it was trained on, those rows are read where no `rows` are given, and missing
    cells are treated as then where `missing` does not say how.

    Raises:
        InputError: as `open_run`.
    """
    if missing is not None:
        check_choice(missing, _MISSING, "--missing")
    opened, notes = [], []
    for path in data:
        check_readable(path)
        trained = trained_reading(model, path)
        reading = trained or ReadOptions("auto", prepare=True)
        reading = replace(reading, rows=rows or reading.rows, missing=missing or reading.missing)
        opened.append(open_run(model, path, reading=reading))
        if not opened[-1].model.learns:
            from orthaug.selection.learned_linearization import NO_LEARNER

            raise InputError(f"{model}: {NO_LEARNER}")
        taken = rows_taken(trained) if trained and not rows else ""
        notes += opened[-1].notes
        notes += (
            [f"note: {path.name}: {taken}, those of the training; --rows takes others."]
            if taken
            else []
        )
    whole = Record.join([one.record for one in opened]) if len(opened) > 1 else opened[0].record
    return replace(opened[0], record=whole, notes=tuple(dict.fromkeys(notes)))


def rows_taken(reading: ReadOptions) -> str:
    """Return a text on the rows of a file that were trained on; empty where these are all."""
    return (
        "rows " + " and ".join(f"{start}:{stop}" for start, stop in reading.rows)
        if reading.rows
        else ""
    )


def open_run(
    model: Path,
    data: Path,
    *,
    need_outputs: bool = False,
    reading: ReadOptions | None = None,
    ahead: int = 0,
) -> ModelOnData:
    """Load a model and read its channels from a file.

    Outputs are optional unless needed.

    Args:
        ahead: rows behind the first usable one before a stretch between missing samples has a
            value.

    Raises:
        InputError: no model, no file, missing columns, no stretch that is long enough.
    """
    check_readable(data)
    from orthaug.models.storage import load

    loaded, reading = load(model), reading or ReadOptions()
    names = [c.name for c in (*loaded.inputs, *loaded.outputs)]
    for name in reading.columns:
        if name not in names:
            raise InputError(
                f"--column: '{name}' is no channel of the model{nearest(name, names)}; it has "
                f"{', '.join(names)}."
            )
    if reading.prepare is None:
        check_instants(loaded, data)
    held = measured_outputs(loaded, data, reading)
    for name, column in reading.columns.items():
        if name in {c.name for c in loaded.outputs} - {c.name for c in held}:
            raise InputError(
                f"--column: found {name}={column}, but {data} has no column '{column}'; give a "
                "column of the file."
            )
    if need_outputs or not loaded.inputs or len(held) == len(loaded.outputs):
        held = list(loaded.outputs)
    elif held:
        missing = [c.name for c in loaded.outputs if c not in held]
        raise InputError(
            f"{data}: has some of the model's outputs but lacks {', '.join(missing)}; give all "
            "or none."
        )
    try:
        record = record_for(loaded, data, held, reading)
    except MissingSampleError as error:
        keep = ", --missing keep runs through them" if loaded.form.takes_gaps else ""
        raise InputError(f"{error} --missing skip leaves such rows out{keep}.") from None
    rows, notes = (
        len(record) + record.missing,
        prepared_notes(loaded, record if reading.prepare else None, _as_read(loaded, reading)),
    )
    if loaded.experiment_column and not experiment_column(loaded, data):
        notes += (
            f"note: {data} has no column '{loaded.experiment_column}', which numbers the "
            "experiments of the training data; its rows are taken as one experiment.",
        )
    if record.missing:
        # A state to predict from
        estimated = need_outputs and loaded.form.states and not loaded.form.memory
        first = loaded.form.first_row + ahead + bool(estimated)
        keep = "--missing keep runs through missing outputs" if loaded.form.takes_gaps else ""
        stretches = [0] * len(record.experiments)
        record, text = long_stretches(record, stretches, first, remedy=keep)
        notes += (f"note: {data}: {text}",)
    begin = 0 if reading.rows is None else int(np.ravel(reading.rows)[0])
    if begin and record.time_column is None and record.experiment_column is None:
        record = _later(record, begin * _steps_of(loaded, reading, loaded.outputs)[1])
    return ModelOnData(loaded, record, data, rows, notes, first_row=begin)


def missing_notes(model: Model, data: Path, record: Record) -> tuple[str, ...]:
    """Return a note on the rows of a file that are left out, or lack outputs; none without any."""
    first, notes = model.form.first_row, ()
    if record.missing:
        long = [one for one in record.experiments if len(one) > first]
        notes += (f"note: {data}: {gaps_text(record, long, first)}",)
    if not record.complete:
        lost = sum(int(np.isnan(one.outputs).any(axis=1).sum()) for one in record.experiments)
        notes += (
            f"note: {data}: {plural(lost, 'row')} lack outputs; what the data alone show is of "
            "the others.",
        )
    return notes


def record_for(
    model: Model, data: Path, outputs: Sequence[Channel], reading: ReadOptions
) -> Record:
    """Return a model's inputs, and some outputs, from a file.

    Raises:
        InputError: as `read_record`.
    """
    missing = reading.missing
    if missing == "auto":
        missing = "keep" if model.form.takes_gaps and not model.coloured else "skip"
    steps, step = _steps_of(model, reading, outputs)
    return read_record(
        data,
        inputs=model.inputs,
        outputs=outputs,
        sampling_time=None if model.time_column else step,
        time=model.time_column,
        rows=reading.rows,
        every=reading.every,
        columns=reading.columns,
        missing=missing,
        experiment=experiment_column(model, data),
        prepare=steps,
        uneven=model.form.steps_unevenly,
    )


def _steps_of(
    model: Model, reading: ReadOptions, outputs: Sequence[Channel]
) -> tuple[Sequence[Any], float]:
    """Return the steps of preparation, and the time from a row of the file to the next in s.

    When an input acts is a part of the model: without a choice its shift is done all the same.
    """
    steps, step = (), model.sampling_time
    done = (
        model.prepared if reading.prepare else shifts_of(model) if reading.prepare is None else ()
    )
    if done:
        steps, step = steps_again(done, [c.name for c in (*model.inputs, *outputs)], step)
    return steps, step / reading.every


def shifts_of(model: Model) -> tuple[Preparation, ...]:
    """Return the shifts of inputs in the preparation of a model's training data."""
    return tuple(done for done in model.prepared if done.step == "shift")


def _as_read(model: Model, reading: ReadOptions) -> str:
    """Return what was done to the rows of a file for which no preparation was asked."""
    if reading.prepare is None and (shifts := shifts_of(model)):
        if len(shifts) == len(model.prepared):
            return "The same was done to these data; --no-prepare takes the rows as they are."
        return "The shift was done to these data; --prepare does all of it, --no-prepare nothing."
    return _RAW


def _later(record: Record, time: float) -> Record:
    """Return the record with its instants so much later: those of the file's own rows."""
    moved = (replace(one, start_time=one.start_time + time) for one in record.experiments)
    return replace(record, experiments=tuple(moved))


def experiment_column(model: Model, data: Path) -> str | None:
    """Return the column that labels a file's experiments as those of the training data.

    None where the file has no such column: its rows are one experiment.
    """
    named = model.experiment_column
    return named if named and has_column(data, named) else None


def check_instants(model: Model, data: Path) -> None:
    """Raise InputError where the file cannot give the instants that the model needs."""
    steps = [done.named for done in model.prepared if done.step in SAMPLING]
    if steps:
        raise InputError(
            f"{data}: the model was fitted to data after {', '.join(steps)}; give --prepare "
            "for a file as it was measured, or --no-prepare for one that has a row every "
            f"{model.sampling_time:g} s already."
        )


def measured_outputs(model: Model, data: Path, reading: ReadOptions) -> list[Channel]:
    """Return the outputs that a file has columns for."""
    return [
        c for c in model.outputs if has_column(data, reading.columns.get(c.name, c.file_column))
    ]


_RAW = "The rows of this file are taken as they are; --prepare does the same to them."
_DETRENDED = " Detrended signals are deviations from their trend in each file."


def prepared_notes(model: Model, record: Record | None = None, what: str = _RAW) -> tuple[str, ...]:
    """Return notes on a model whose training data were prepared.

    Args:
        record: other data after the same steps, whose effects there are reported.
        what: sentence after the steps where there are no such data.
    """
    if not model.prepared:
        return ()
    named = (
        "note: the model was fitted to prepared data: "
        f"{', '.join(done.named for done in model.prepared)}."
    )
    trends = _DETRENDED if any(done.step == "detrend" for done in model.prepared) else ""
    if record is None:
        return (f"{named} {what}",)
    found = [done.text for done in record.prepared if done.step in MENDING]
    here = f", here with {'; '.join(found)}" if found else ""
    return (f"{named} The same was done to these data{here}.{trends}",)


def read_initial(initial: str | None, opened: ModelOnData) -> str | object:
    """Return the `initial` of `Model.simulate`.

    It is "measured" where the data have outputs, "zero" otherwise, or the rows of a CSV.
    """
    gaps, measured = len(opened.record.experiments) > 1, bool(opened.record.outputs)
    if gaps and not (measured and initial in (None, "measured")):
        remedy = (
            "leave --initial out"
            if measured
            else "a free run without measured outputs cannot continue after them"
        )
        raise InputError(
            f"{opened.source}: has missing samples, and each stretch starts from its own "
            f"outputs; {remedy}."
        )
    if initial is None:
        return "measured" if measured else "zero"
    if initial in ("measured", "zero"):
        if initial == "measured" and not opened.record.outputs:
            raise InputError(
                f"{opened.source}: has no measured outputs to start from; use --initial zero "
                "or a CSV."
            )
        return initial
    if not Path(initial).suffix and "/" not in initial:
        raise InputError(
            f"--initial: found '{initial}'; expected measured, zero, or a CSV file of the "
            "first outputs."
        )
    record = read_record(
        initial, outputs=opened.model.outputs, sampling_time=opened.model.sampling_time
    )
    try:
        opened.model.check_initial(record.experiments[0].outputs)
    except InputError as error:
        raise InputError(f"{initial}: {error}") from None
    return record.experiments[0].outputs


def notes(opened: ModelOnData, initial: str | None) -> list[str]:
    """Return notes on a free run: where it starts when no initial state is given."""
    if initial is not None or opened.record.outputs or not opened.model.form.states:
        return [*opened.notes]
    names = ", ".join(channel.name for channel in opened.model.outputs)
    return [
        *opened.notes,
        f"note: {opened.source} has no {names}: the free run starts from 0; --initial CSV "
        "gives other outputs.",
    ]


def with_initial(opened: ModelOnData, initial: str | Any) -> Record:
    """Return the record with the outputs of its first rows replaced, as another initial state."""
    if isinstance(initial, str) and initial == "measured":
        return opened.record
    start = opened.model.form.first_row
    if opened.model.form.states and not opened.model.form.memory:
        raise InputError(
            "--initial: found with a motion, whose predictions start from states that are "
            "estimated from the rows before them; leave it out."
        )
    (experiment,) = opened.record.experiments
    outputs = experiment.outputs.copy()
    rows = np.zeros((start, outputs.shape[1])) if isinstance(initial, str) else initial[:start]
    outputs[start - len(rows) : start] = rows
    return replace(opened.record, experiments=(replace(experiment, outputs=outputs),))


def open_ahead(
    model: Path,
    data: Path,
    reading: ReadOptions,
    horizon: int,
    initial: str | None,
    *,
    observer: bool = False,
) -> ModelOnData:
    """Load a model and read its channels as `open_run`, for predictions `horizon` steps ahead.

    An observer's record keeps missing outputs.

    Raises:
        InputError: as there; other first outputs for an observer.
    """
    if observer and initial is not None:
        raise InputError(
            "--initial: found with --observer, which estimates where it starts; leave one of "
            "them out."
        )
    reading = replace(reading, missing="keep") if observer else reading
    opened = open_run(model, data, need_outputs=True, reading=reading, ahead=max(horizon, 1) - 1)
    return (
        opened
        if observer
        else replace(opened, record=with_initial(opened, read_initial(initial, opened)))
    )


def observe_outputs(opened: ModelOnData, horizon: int) -> tuple[Response, list[str]]:
    """Return the prediction `horizon` steps ahead from an observer's state, and notes."""
    from orthaug.analysis.observer import Observer

    observer = Observer(opened.model)
    response = observer.predict(opened.record, horizon=horizon)
    consistency = observer.run(opened.record).consistency()
    # Of a motion the observer has the noises that its gain stands for
    coloured = opened.model.coloured and not opened.model.statistics.simulated
    return response, _of_band(consistency, response, horizon, coloured=coloured)


def _of_band(
    found: Consistency, response: Response, horizon: int, *, coloured: bool = False
) -> list[str]:
    """Return the NIS with its interval where outputs were measured.

    It is a warning outside of that interval, since the band is then wrong. The NIS is that of one
    step, the band that of the horizon.
    """
    from orthaug.models.response import BAND

    apart = [
        (t.measured - t.model) / t.std for t in response.trajectories if t.measured is not None
    ]
    apart = (
        np.concatenate([errors[np.isfinite(errors)] for errors in apart]) if apart else np.zeros(0)
    )
    if not np.isfinite(found.nis) or not len(apart):
        return []
    held, (low, high) = float(np.mean(np.abs(apart) <= BAND)), found.expected
    several = horizon > 1
    text = (
        f"{'one step ahead, ' if several else ''}the squared innovations are {found.nis:.3g} times "
        f"as large as the observer expects (NIS; {low:.3g} to {high:.3g} with the right noises). "
        f"Its 95 % band{f' {horizon} steps ahead' if several else ''} contains {percent(held, 3)} "
        "of the measured values."
    )
    width = "too wide" if held > _WIDE else "too narrow" if held < _NARROW else ""
    if found.consistent:
        ahead = f" For {horizon} steps, the band is {width}." if several and width else ""
        return [f"note: {text}{ahead}"]
    why = (
        "its noises are too small, or the model is wrong here"
        if found.nis > high
        else "its noises are too large"
    )
    remedy = "oa.Observer(oa.load(MODEL)).tuned(record) finds noises by the likelihood of a record."
    if coloured:
        why = "the observer takes errors for white that the fitted noise model says are coloured"
        remedy = "Predictions without --observer use the noise model."
    if not several:
        return [f"warning: {text} Do not use the band as one of 95 %: {why}. {remedy}"]
    width = width or "about right"
    return [
        f"warning: {text} For one step, {why}. For {horizon} steps, the band is {width}. {remedy}"
    ]


def warnings(response: Response) -> list[Warning]:
    """Return warnings about a response."""
    text = "the free run diverged in output '{}' at step {}; it has no values from there on."
    ends = (trajectory.diverged for trajectory in response.trajectories if trajectory.diverged)
    return [Warning("free_run_diverged", text.format(output, step)) for step, output in ends]


def write_csv(
    response: Response, opened: ModelOnData, out: Path | None, *, force: bool = False
) -> None:
    """Write one row per data row, with empty cells where there is no value.

    It goes to a file (whole or not at all) or standard output.
    """
    frame = _table(response, opened)
    if out is None:
        frame.to_csv(sys.stdout, index=False)
        return
    with whole_file(out, force=force) as partial:
        frame.to_csv(partial, index=False)


def _table(response: Response, opened: ModelOnData) -> Any:
    """Return the tables of all stretches in the order of the file's rows.

    Rows that were left out have their time only.
    """
    stretches = opened.record.experiments
    frames = [response.to_frame(i) for i in range(len(stretches))]
    if len(stretches[0]) == opened.rows:
        return frames[0]
    import pandas as pd

    begins = _first_rows(opened.record, opened.first_row)
    placed = [
        frame.set_axis(range(begin, begin + len(frame)))
        for frame, begin in zip(frames, begins, strict=True)
    ]
    whole = pd.concat(placed).reindex(range(opened.rows))
    if not opened.record.even:
        return whole  # the instants of rows that were left out are not known here
    instants = pd.Series(np.nan, index=whole.index)
    for begin, one in zip(begins, stretches, strict=True):
        first = begin - one.offset  # of its recording
        ahead = np.arange(first, opened.rows) - begin
        instants[first:] = one.start_time + ahead * response.sampling_time
    return whole.assign(time=whole["time"].fillna(instants))


def _first_rows(record: Record, first: int) -> list[int]:
    """Return the row of a table at which each experiment begins: recording by recording.

    Args:
        first: the row of the file that the table begins at.
    """
    found: list[int] = []
    base = end = 0
    before = -1
    for one, recording in zip(record.experiments, record.recordings, strict=True):
        if recording != before:
            rows = 0 if record.prepared else -(-(one.recording_row - first) // one.stride)
            base, first, before = max(end, base + rows), one.recording_row, recording
        found.append(base + one.offset)
        end = found[-1] + len(one)
    return found


def explain_notes(model: Path) -> list[str]:
    """Return notes beside proposed terms, where the result has a map to physical parameters."""
    for content in results_beside(model):
        with suppress(AttributeError, KeyError, TypeError):
            if content["spec"].get("physics"):
                return [
                    "note: the spec has [physics]. For a term from here add a line to "
                    '[physics.theta], such as drag = "drag". Declare its parameter in '
                    "[physics.parameters] with that `initial`, not in the term."
                ]
    return []


def explain_model(
    opened: ModelOnData, *, degree: int, functions: Sequence[str], most: int
) -> ExplainResult:
    """Return the content of the explanation of a model over its data.

    Raises:
        InputError: physics alone, data without what the learner is evaluated at, too many
            candidates.
    """
    from orthaug.analysis.attempt import attempt
    from orthaug.analysis.doubts import memory_result
    from orthaug.analysis.hidden_state import structure_test
    from orthaug.selection.explanation import explain

    try:
        explained = explain(
            opened.model, opened.record, degree=degree, functions=functions, most=most
        )
    except InputError as error:
        raise type(error)(f"{opened.source}: {error}") from None
    result = ExplainResult.model_validate(explained)
    if not opened.record.outputs:
        return result
    failed: list[Any] = []
    test = attempt(
        "the search for memory", lambda: structure_test(opened.model, opened.record), failed, None
    )
    memory = [memory_result(one) for one in test.families if one.sure] if test is not None else []
    warnings = [*result.warnings, *failed]
    return result.model_copy(update={"memory": memory, "warnings": warnings})
