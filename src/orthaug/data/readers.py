"""Records from files: rows, ranges and sampling time of named channels.

Rows count from 0 behind the header; messages name the file's own line, column and what is
there.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from orthaug._base.checks import Vector, check_choice, check_count, check_type
from orthaug._base.errors import BadCellError, InputError, MissingSampleError, show
from orthaug._base.lines import plural
from orthaug.data.channels import Channel, as_channels
from orthaug.data.clock import DRIFT, JITTER, steps_accumulate, thinned_fault
from orthaug.data.layouts import MISSING, STATES, text_number
from orthaug.data.preparation import MENDING, STEPS, check_steps, prepared_experiments
from orthaug.data.record import Experiment, Record, check_step, same_step, steps_between, unbroken
from orthaug.data.steps import Resample, Run
from orthaug.data.tables import Table, check_readable, has_column, read_table
from orthaug.data.variables import ENDINGS

RowRange = tuple[int, int] | list[int]
_RESOLUTION = 1e-6  # what rounding of the instants may change the mean step by, relative
# Times the usual step: what the inputs did in a longer one is not known
GAP = 10.0
_NO_STEP = (
    "the rows of {} are taken to be 1 s apart. Give `sampling_time` in seconds, or in `time` the "
    "column that holds the instants; `sampling_time=1.0` keeps 1 s."
)
_LATEST = 1e11  # s; later than the year 5000
# How files write a sample that is not there


def read_record(
    path: str | Path,
    *,
    inputs: Sequence[str | Channel] = (),
    outputs: Sequence[str | Channel] = (),
    sampling_time: float | None = None,
    time: str | None = None,
    rows: RowRange | Sequence[RowRange] | None = None,
    every: int = 1,
    columns: Mapping[str, str] | None = None,
    missing: str = "error",
    experiment: str | None = None,
    prepare: Sequence[Any] = (),
    uneven: bool = False,
) -> Record:
    r"""Read one file; several row ranges are experiments of their own.

    Args:
        path: of a file that ends in .csv, .tsv, .txt, .dat, .parquet, .xlsx, .npz, .mat or .h5.
        inputs: channel names, or `Channel`s with column, unit, scale and offset.
        outputs: as `inputs`.
        sampling_time: seconds between rows; without it and `time` 1 s, with a warning.
        time: the column that holds the instants, instead of `sampling_time`: numbers in the unit of
            its header (`t [ms]`; s without one), or dates, which count from the first row of the
            file.
        rows: half-open range `(start, stop)` of data rows, or several; None for all.
        every: keep each n-th row (no filter); the sampling time is multiplied, so it is that of the
            file's rows.
        columns: this file's column for a channel, `{"position": "yVal"}`.
        missing: "error", or "skip" to leave out rows with empty or NaN cells. Each stretch between
            them is then an experiment of its own, so that no lag reaches across a gap. "keep" does
            so where inputs are missing, and keeps missing outputs as NaN: a motion and an
            `Observer` take them.
        experiment: the column, of numbers, that labels the experiments; each is in one piece.
        prepare: steps such as `Fill()` or `Lowpass(cutoff=10.0)`, in order, before missing samples
            are looked at; with `Resample()` the instants of `time` may be uneven.
        uneven: take instants of `time` that are uneven as they are. Equations of motion step from
            each to the next; all else needs even instants.

    Raises:
        InputError: no such file, wrong type, missing columns, cells that are empty or no finite
            numbers.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder, "run.csv")
        ...     _ = file.write_text("force,position\n0,0\n1,0.5\n2,1.5\n", encoding="utf-8")
        ...     read_record(file, inputs=["force"], outputs=["position"], sampling_time=0.01)
        Record(1 experiment, 3 samples, Ts = 0.01 s, inputs: force; outputs: position)
    """
    path = _path(path)
    channels = [as_channels(inputs, "inputs"), as_channels(outputs, "outputs")]
    column_of = _columns(channels, columns)
    _check_time(time, sampling_time, {c.name: column_of[c.name] for c in channels[1]})
    check_choice(missing, ("error", "skip", "keep"), "`missing`")
    check_count(every, "every")
    if sampling_time is None and time is None:
        warnings.warn(_NO_STEP.format(show(path.name)), UserWarning, stacklevel=2)
    wanted: list[str] = list(
        dict.fromkeys([*column_of.values(), *(name for name in (time, experiment) if name)])
    )
    if not column_of:
        raise InputError("no channels are asked for; name inputs, outputs or both.")
    if fault := thinned_fault(path, sampling_time, every, wanted):
        raise InputError(f"{path}: {fault}")
    table = _trim(read_table(path, wanted, time or None), gaps=missing != "error")
    needed = wanted
    if missing == "keep":
        needed = [*(column_of[c.name] for c in channels[0]), *([time] if time else [])]
    total = len(next(iter(table.columns.values())))
    experiments, steps, recorded, is_uneven = [], [], 0, False
    ranges = _ranges(rows, total, path)
    ranges = ranges if experiment is None else _split_by_label(table, experiment, ranges)
    if prepare:
        raw = _RawRanges(table, channels, column_of, time, sampling_time or 1.0, every, missing)
        return replace(raw.prepare(prepare, ranges), experiment_column=experiment)
    for begin, end in ranges:
        recorded += len(range(begin, end, every))
        for start, stop in _stretches(table, wanted, needed, begin, end, every, missing):
            pick = slice(start, stop, every)
            signals = [
                np.stack(
                    [c.scale * table.columns[column_of[c.name]][pick] + c.offset for c in group],
                    axis=-1,
                )
                if group
                else np.empty((len(range(start, stop, every)), 0))
                for group in channels
            ]
            offset = (start - begin) // every
            began = (
                float(table.columns[time][start])
                if time
                else offset * every * (sampling_time or 1.0)
            )
            place = (str(path), start, every, table.first_line, began, offset)
            experiments.append(Experiment(signals[0], signals[1], *place))
            if time and (stop - start > 1 or missing == "error"):
                try:
                    steps.append(_uniform_step(table, time, start, stop))
                except InputError:
                    if not uneven:
                        raise
                    _check_rising(table, time, start, stop)
                    is_uneven = True
                is_uneven |= uneven and steps_accumulate(table.columns[time][start:stop])
    if time and is_uneven:
        record = Record(
            tuple(channels[0]),
            tuple(channels[1]),
            1.0,
            tuple(experiments),
            time,
            experiment_column=experiment,
        )
        return _with_instants(record, table.columns[time], recorded)
    if time and not steps:
        steps = _steps_of(table, time, ranges)
    step = steps[0] if time else (1.0 if sampling_time is None else float(sampling_time))
    if others := [other for other in steps if not same_step(other, step)]:
        steps_text = f"steps by {step:g} s in one row range and by {others[0]:g} s in another"
        raise InputError(f"{path}: column '{time}' {steps_text}.")
    left_out = recorded - sum(len(experiment) for experiment in experiments)
    step *= min(every, 10**15)  # what is longer is refused
    return Record(
        tuple(channels[0]),
        tuple(channels[1]),
        step,
        tuple(experiments),
        time,
        left_out,
        experiment_column=experiment,
    )


@dataclass(frozen=True, eq=False)
class _RawRanges:
    """Ranges of a table with their missing samples, for steps that may mend them."""

    table: Table
    channels: list[tuple[Channel, ...]]
    column_of: Mapping[str, str]
    time: str | None
    step: float
    every: int
    missing: str

    def prepare(self, steps: Sequence[Any], ranges: Sequence[tuple[int, int]]) -> Record:
        """Return the record after the steps."""
        check_steps(steps)
        mending = tuple(STEPS[kind] for kind in MENDING)
        mends = self.missing != "error" or any(isinstance(step, mending) for step in steps)
        uneven = any(isinstance(step, Resample) for step in steps)
        runs = [self._run(begin, end, mends=mends, uneven=uneven) for begin, end in ranges]
        experiments, step, done, lost = prepared_experiments(
            runs, steps, keep=self.missing == "keep"
        )
        if lost and self.missing == "error":
            lacking = (
                f"{plural(lost, 'row')} {'lacks' if lost == 1 else 'lack'} a sample after "
                "preparation"
            )
            raise MissingSampleError(
                f"{self.table.path}: {lacking}. Let `fill` reach over longer gaps, or leave them "
                'out (missing = "skip").'
            )
        return Record(self.channels[0], self.channels[1], step, experiments, self.time, lost, done)

    def _run(self, begin: int, end: int, *, mends: bool, uneven: bool) -> tuple[Run, Experiment]:
        """Return the rows of a range, and their place in the file."""
        table, pick, both = (
            self.table,
            slice(begin, end, self.every),
            [*self.channels[0], *self.channels[1]],
        )
        names = [self.column_of[c.name] for c in both]
        _stretches(
            table, names, names, begin, end, self.every, "skip" if mends else "error"
        )  # text is refused
        values = np.column_stack(
            [c.scale * table.columns[self.column_of[c.name]][pick] + c.offset for c in both]
        )
        step = self.step * self.every
        instants = step * np.arange(len(values))
        if self.time:
            _check_cells(table, [self.time], begin, end)
            instants = table.columns[self.time][pick]
            if uneven and len(instants) > 1:
                step = float(np.median(np.diff(instants)))
            else:
                step = _uniform_step(table, self.time, begin, end) * self.every
        place = (str(table.path), begin, self.every, table.first_line, float(instants[0]))
        count = len(self.channels[0])
        run = Run(
            values,
            instants,
            tuple(c.name for c in both),
            count,
            step,
            even=not (self.time and uneven),
        )
        return run, Experiment(values[:, :count], values[:, count:], *place)


def read_samples(
    paths: Sequence[str | Path], lags: Sequence[str], *, rows: Any = None, every: int = 1
) -> tuple[dict[str, Vector], Vector | None]:
    """Read points from files: a column per raw lag, named as in expressions, and their `weight`.

    Files need no column `weight`.

    Raises:
        InputError: no such file, missing columns, cells that are no finite numbers.
    """
    pieces, weighted = [], None
    for path in map(_path, paths):
        check_readable(path)
        own = has_column(path, "weight")
        if weighted not in (None, own):
            raise InputError(
                f"{path}: some files of the samples have a column 'weight' and some have not."
            )
        weighted = own
        names = [*lags, *(["weight"] if own else [])]
        table = _trim(read_table(path, names))
        total = len(table.columns[names[0]])
        for start, stop in _ranges(rows, total, path):
            _check_cells(table, names, start, stop)
            pieces.append(
                np.stack([table.columns[name][start:stop:every] for name in names], axis=-1)
            )
    values = np.concatenate(pieces)
    weights = values[:, -1] if weighted else None
    return {lag: values[:, j] for j, lag in enumerate(lags)}, weights


def _trim(table: Table, *, gaps: bool = False) -> Table:
    """Return the table without its last rows where every used column is empty.

    Such are blank lines, and the ends of longer unused columns. Where `gaps` are refused, so are
    variables of unequal lengths; a table has empty cells there, which are looked at later.
    """
    longest = max(table.filled.values())
    if longest == 0:
        raise InputError(f"{table.path}: there are no data rows in {', '.join(table.columns)}.")
    gaps = gaps or table.path.suffix.lower() not in ENDINGS
    if len(set(table.filled.values())) > 1 and not gaps:
        listing = ", ".join(f"'{name}' {length}" for name, length in table.filled.items())
        raise InputError(
            f"{table.path}: the used columns have unequal lengths: {listing} rows. Give all "
            "the same length."
        )
    return replace(
        table, columns={name: values[:longest] for name, values in table.columns.items()}
    )


def _path(path: Any) -> Path:
    check_type(path, str | os.PathLike, "path", "a file's name")
    return Path(path)


def _columns(channels: Sequence[Sequence[Channel]], columns: Any) -> dict[str, str]:
    check_type(
        columns, Mapping | None, "columns", "this file's column by channel, such as {'y': 'yVal'}"
    )
    given = dict(columns or {})
    for name, column in given.items():
        if not isinstance(column, str):
            raise InputError(
                f"`columns`: the column of {show(name)} must be a name; got {show(column)}."
            )
    return {c.name: given.get(c.name, c.file_column) for group in channels for c in group}


def _check_time(time: Any, sampling_time: Any, outputs: Mapping[str, str]) -> None:
    """Raise InputError for instants that are no column, given twice, or also an output."""
    check_type(time, str | None, "time", "a column's name")
    if sampling_time is not None and time is not None:
        raise InputError("give `sampling_time` or `time`, not both.")
    if sampling_time is not None:
        check_step(sampling_time)
    for name, column in outputs.items():
        if column == time:
            raise InputError(
                f"the column '{time}' is both `time` and the output '{name}'; correct one of them."
            )


def _is_list(value: object) -> bool:
    return isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim > 0)


def _is_whole(value: object) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool | np.bool_)


def _ranges(
    rows: RowRange | Sequence[RowRange] | None, total: int, path: Path
) -> list[tuple[int, int]]:
    """Return half-open ranges of rows, each checked against the file."""
    if rows is None:
        return [(0, total)]
    pairs: list = list(rows) if _is_list(rows) else []
    if not any(map(_is_list, pairs)):
        pairs = [pairs]
    if not _is_list(rows) or not all(
        _is_list(pair) and all(map(_is_whole, pair)) for pair in pairs
    ):
        raise InputError(
            f"{path}: `rows` must be two whole numbers, [start, stop], or a list of such "
            f"pairs; got {show(rows)}."
        )
    for pair in pairs:
        if len(pair) != 2 or not 0 <= pair[0] < pair[1]:
            raise InputError(
                f"{path}: rows {list(pair)} is not a half-open range [start, stop] with 0 ≤ "
                "start < stop."
            )
        if pair[1] > total:
            raise InputError(
                f"{path}: rows {list(pair)} reaches past the end; the file has {total} data rows."
            )
    ordered = sorted((int(start), int(stop)) for start, stop in pairs)
    for before, after in zip(ordered, ordered[1:], strict=False):
        if after[0] < before[1]:
            raise InputError(
                f"{path}: the row ranges {list(before)} and {list(after)} overlap; samples "
                "would count twice."
            )
    return [(int(start), int(stop)) for start, stop in pairs]


def _split_by_label(
    table: Table, column: str, ranges: Sequence[tuple[int, int]]
) -> list[tuple[int, int]]:
    """Return the ranges cut where the label of the experiment changes."""
    found, seen, labels = [], set(), table.columns[column]
    for start, stop in ranges:
        _check_cells(table, [column], start, stop)
        borders = [start, *(start + 1 + np.flatnonzero(np.diff(labels[start:stop]))).tolist(), stop]
        for a, b in zip(borders, borders[1:], strict=False):
            if labels[a] in seen:
                raise InputError(
                    f"{table.path}: {table.where(a)}: experiment {labels[a]:g} goes on after "
                    f"another has begun; sort the rows by '{column}', then by time."
                )
            seen.add(labels[a])
            found.append((a, b))
    return found


def _stretches(
    table: Table,
    columns: Sequence[str],
    needed: Sequence[str],
    begin: int,
    end: int,
    every: int,
    missing: str,
) -> list[tuple[int, int]]:
    """Return half-open row ranges without missing cells in the needed columns.

    The whole range where they are errors.
    """
    if missing == "error":
        _check_cells(table, columns, begin, end)
        return [(begin, end)]
    kept = np.arange(begin, end, every)
    full = np.all([np.isfinite(table.columns[name][kept]) for name in columns], axis=0)
    for row in kept[~full]:
        for name in columns:
            if (
                not np.isfinite(table.columns[name][row])
                and table.cell(name, row).strip().lower() not in MISSING
            ):
                _check_cells(table, [name], row, row + 1)
    ranges = unbroken(
        np.column_stack([np.ones(len(kept)), *(table.columns[name][kept] for name in needed)])
    )
    if not ranges:
        raise InputError(
            f"{table.path}: every row from {begin} to {end - 1} has a missing cell; nothing is "
            "left."
        )
    return [(int(kept[a]), int(kept[b - 1]) + 1) for a, b in ranges]


def _check_cells(table: Table, columns: Sequence[str], start: int, stop: int) -> None:
    for name in columns:
        bad = np.flatnonzero(~np.isfinite(table.columns[name][start:stop]))
        if bad.size:
            row = start + int(bad[0])
            text = table.cell(name, row)
            what = f"found '{text}'" if text else f"the cell is empty{_end_of(table, name, row)}"
            word = text.strip().lower()
            error = (
                MissingSampleError
                if word in MISSING
                else InputError
                if word in STATES
                else BadCellError
            )
            dated, number = name == table.dated, np.isfinite(text_number(text))
            kind = "a date" if dated else "decimals with commas" if number else ""
            wanted = f"{kind}, as in other cells" if kind else "a finite number"
            raise error(
                f"{table.path}: {table.where(row)}, column '{name}': {what}; expected {wanted}."
                f"{'' if kind or error is MissingSampleError else _remedy(text)}"
            )


def _end_of(table: Table, name: str, row: int) -> str:
    """Return that all cells below an empty one are empty too, where other columns go on."""
    longest = max(table.filled, key=lambda one: table.filled[one])
    if row < table.filled[name] or table.filled[name] == table.filled[longest]:
        return ""
    return f", and so are all below it; '{longest}' goes on to row {table.filled[longest] - 1}"


def _remedy(text: str) -> str:
    """Return what to do about a cell that holds a word."""
    if text.strip().lower() in STATES:
        return " Write 0 and 1 for such words."
    return " Correct the cell, or empty it where its sample is missing."


def _check_rising(table: Table, time: str, start: int, stop: int) -> None:
    """Raise InputError for instants that do not rise, or with a gap between them."""
    steps = np.diff(table.columns[time][start:stop])
    usual = float(np.median(steps)) if len(steps) else 0.0
    for bad, what in (
        (steps <= 0, "expected rising instants."),
        (
            steps > GAP * usual,
            "what the inputs did meanwhile is not known. Give row ranges on either side of it.",
        ),
    ):
        if bad.any():
            row = int(np.argmax(bad))
            raise InputError(
                f"{table.path}: {table.where(start + row + 1)}, column '{time}': a step of "
                f"{steps[row]:g} s where {usual:g} s is usual; {what}"
            )


def _with_instants(record: Record, instants: Vector, recorded: int) -> Record:
    """Return the record with the steps between its rows; stretches of one row are left out."""
    found = []
    for one in record.experiments:
        rows = slice(one.first_row, one.first_row + one.stride * len(one), one.stride)
        if len(one) > 1:
            found.append(replace(one, steps=steps_between(instants[rows])[1]))
    mean = float(np.mean(np.concatenate([one.steps[:-1] for one in found])))
    missing = recorded - sum(map(len, found))
    return replace(record, experiments=tuple(found), sampling_time=mean, missing=missing)


def _steps_of(table: Table, time: str, ranges: Sequence[tuple[int, int]]) -> list[float]:
    """Return the step of each range by all of its instants, where every other row has gaps.

    Raises:
        InputError: instants that are missing or uneven.
    """
    complete = [
        (a, b) for a, b in ranges if np.isfinite(table.columns[time][a:b]).all() and b > a + 1
    ]
    if not complete:
        raise InputError(
            f"{table.path}: no two rows without missing cells follow each other, and column "
            f"'{time}' has missing cells, too; the sampling time is unknown."
        )
    return [_uniform_step(table, time, a, b) for a, b in complete]


def _uniform_step(table: Table, time: str, start: int, stop: int) -> float:
    """Return the mean step of the time column, checked to be even.

    No sample is missing, and the rate stays the same.
    """
    instants = table.columns[time][start:stop]
    if len(instants) < 2:
        raise InputError(
            f"{table.path}: one row is too few for a sampling time from column '{time}'."
        )
    steps = np.diff(instants)
    mean, usual = float(steps.mean()), float(np.sort(steps)[(len(steps) - 1) // 2])
    odd = np.flatnonzero(np.abs(steps - usual) > JITTER * usual) if usual > 0 else np.array([0])
    remedy = (
        'expected evenly sampled, rising time. Resample (`[[data.prepare]] step = "resample"`), '
        "or take row ranges without gaps."
    )
    if odd.size:
        row = start + int(odd[0]) + 1
        if steps[odd[0]] <= 0:  # `resample` needs rising instants, too
            remedy = (
                "expected rising time. Correct the row, take row ranges without it, or give "
                "`sampling_time` instead of `time`."
            )
        raise InputError(
            f"{table.path}: {table.where(row)}, column '{time}': a step of {steps[odd[0]]:g} s "
            f"where {usual:g} s is usual; {remedy}"
        )
    third = len(steps) // 3
    if third:
        rates = [
            float(piece.mean()) for piece in (steps[:third], steps[third:-third], steps[-third:])
        ]
        change = max(rates) - min(rates)
        if change > DRIFT * mean and change * third > 0.5 * mean:
            drifts = f"the step drifts between {min(rates):g} s and {max(rates):g} s"
            raise InputError(f"{table.path}: column '{time}': {drifts}; {remedy}")
    resolution = float(np.spacing(np.abs(instants).max())) / len(steps)
    if resolution > _RESOLUTION * mean:
        raise InputError(
            f"{table.path}: column '{time}': instants of {np.abs(instants).max():.3g} s are "
            f"too large for steps of {mean:g} s in double precision; subtract the first "
            "instant, and write seconds."
        )
    if np.abs(instants).max() > _LATEST:
        raise InputError(
            f"{table.path}: column '{time}': instants of {np.abs(instants).max():.3g} are not "
            "seconds; perhaps they are milli- or nanoseconds since 1970. Write seconds, or the "
            f"unit in the header, such as '{time} [ms]'."
        )
    return mean
