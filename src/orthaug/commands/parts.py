"""Parts of the data: their files read, checked, and cut to what can be scored."""

from __future__ import annotations

import glob
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from orthaug._base.errors import InputError, MissingSampleError, Warning
from orthaug._base.folders import file_digest
from orthaug._base.lines import plural
from orthaug._base.memory import few_arenas
from orthaug.commands.data_sections import PartSection
from orthaug.commands.spec import Spec
from orthaug.data.clock import DRIFT, read_clock, thinned_fault
from orthaug.data.parquet_source import open_parquet
from orthaug.data.part import Part
from orthaug.data.preparation import warnings_of
from orthaug.data.readers import read_record
from orthaug.data.record import Experiment, Record, same_step
from orthaug.data.sources import witness
from orthaug.data.tables import KNOWN, PLAIN_TEXT, guessed_encoding
from orthaug.data.units import UnitFault, unit_faults
from orthaug.reports.result import FileResult


@dataclass(frozen=True, eq=False)
class FilePart(Part):
    """A part of the data that was read from files."""

    files: tuple[FileResult, ...] = ()
    warnings: tuple[Warning, ...] = ()
    """Warnings on rows that were thinned out, or left out around missing samples."""

    def without_short(self, first: int, least: int = 0, *, keeps: bool = False) -> FilePart:
        """Return the part without stretches between missing samples that are too short.

        They have no row after the first `first`.

        Args:
            least: minimum rows of a useful stretch.
            keeps: true if the physics can run through missing outputs.
        """
        if not self.record.missing:
            return self
        record, gaps = long_stretches(
            self.record,
            self.skips,
            first,
            least,
            f"data.{self.name}: ",
            self.skip,
            '`missing = "keep"` in [data] runs through missing outputs' if keeps else "",
        )
        warning = Warning("missing_rows", f"{self.name}: {gaps}")
        return replace(self, record=record, warnings=(*self.warnings, warning))

    def scored(self, start: int) -> Record:
        """Return the record of the scored rows and their lags; the first usable row is `start`."""
        kept = tuple(
            e.rows(max(0, skip - start), None)
            for e, skip in zip(self.record.experiments, self.skips, strict=True)
        )
        return replace(self.record, experiments=kept)

    def check_scorable(self, start: int, sampling_time: float, least: int = 0) -> None:
        """Raise InputError for an experiment with too few rows, or another sampling time."""
        if self.record.even and not same_step(self.record.sampling_time, sampling_time):
            raise InputError(
                f"data.{self.name}: sampled every {self.record.sampling_time:g} s, the "
                f"training data every {sampling_time:g} s; one model has one sampling time."
            )
        for experiment, skip in zip(self.record.experiments, self.skips, strict=True):
            first = max(start, skip)
            if len(experiment) < least:
                raise InputError(
                    f"{experiment.source}: data.{self.name} has "
                    f"{plural(len(experiment), 'row')}, too few; at least {least} determine where "
                    "a run of this motion starts."
                )
            if len(experiment) <= first:
                raise InputError(
                    f"{experiment.source}: data.{self.name} has "
                    f"{plural(len(experiment), 'row')}, too few; {_unscored(first)}, so at least "
                    f"{first + 1} are needed."
                )


def _unscored(first: int) -> str:
    """Return which rows at the start have no score."""
    return (
        f"the first {first} are lags or skipped" if first > 1 else "the first is a lag or skipped"
    )


def long_stretches(
    record: Record,
    skips: Sequence[int],
    first: int,
    least: int = 0,
    what: str = "",
    skip: int = 0,
    remedy: str = "",
) -> tuple[Record, str]:
    """Return a record without stretches too short to predict a row, and a text on these.

    Args:
        skips: leading samples of each stretch that are not scored.
        least: rows of a stretch that has a use.
        what: prefix of the message; `skip` is the largest of the skips as given.
        remedy: sentence at the end of the message.

    Raises:
        InputError: no stretch is long enough.
    """
    pairs = zip(record.experiments, skips, strict=True)
    long = tuple(e for e, own in pairs if len(e) > max(first, own) and len(e) >= least)
    if not long:
        most = max(len(e) for e in record.experiments)
        needed = _unscored(max(first, skip))
        needed = f"at least {least} are needed" if most < least else needed
        raise InputError(
            f"{record.experiments[0].source}: {what}the longest stretch between missing "
            f"samples has {plural(most, 'row')}, too few: {needed}.{remedy and f' {remedy}.'}"
        )
    return replace(record, experiments=long), gaps_text(record, long, first)


def gaps_text(record: Record, kept: Sequence[Experiment], first: int) -> str:
    """Return a text on the rows that a record lacks, and on those that remain.

    Args:
        kept: the stretches that are used.
        first: rows at the beginning of each that are history only.
    """
    usable = sum(max(len(experiment) - first, 0) for experiment in kept)
    lost = (
        "row has missing cells and is" if record.missing == 1 else "rows have missing cells and are"
    )
    return (
        f"{record.missing} {lost} left out with all windows that touch them; "
        f"{plural(usable, 'usable row')} remain, in {len(kept)} stretch{'es' * (len(kept) > 1)}."
    )


def load_parts(path: Path, spec: Spec) -> tuple[FilePart, FilePart | None, tuple[FilePart, ...]]:
    """Return training, validation and test parts of the spec at `path`, unprepared."""
    files = [path.parent / file for file in expand_files(path, spec.data.train.files, "train")]
    stays = spec.engine_kind(files) in ("stream", "dask") and not spec.brought
    train = _load(path, spec, spec.data.train, "train", stays=stays)
    validation = (
        _load(path, spec, spec.data.validation, "validation") if spec.data.validation else None
    )
    tests = [
        _load(path, spec, part, f"tests.{name}", stays=stays)
        for name, part in spec.data.tests.items()
    ]
    parts = [train, *([validation] if validation else []), *tests]
    if not all(part.record.even for part in parts):
        train, validation, *tests = (
            part and replace(part, record=part.record.with_steps())
            for part in (train, validation, *tests)
        )
    assert train is not None
    return train, validation, tuple(part for part in tests if part)


def expand_files(path: Path, entries: Sequence[str], name: str) -> list[str]:
    """Return the files that the spec names, sorted.

    A pattern such as `runs/*.parquet`, or a folder, gives all files in it.
    """
    found = []
    for entry in entries:
        if (path.parent / entry).is_dir():
            files = [f"{entry.rstrip('/')}/{file.name}" for file in (path.parent / entry).iterdir()]
            files = [file for file in files if Path(file).suffix.lower() in KNOWN]
            plain = [file for file in files if Path(file).suffix.lower() not in PLAIN_TEXT]
            files = plain or files  # beside tables, a .txt is a note
        elif any(mark in entry for mark in "*?[") and not (path.parent / entry).is_file():
            files = glob.glob(entry, root_dir=path.parent, recursive=True)
        else:
            found.append(entry)
            continue
        if not files:
            raise InputError(
                f"{path}: 'data.{name}.files': no file matches '{entry}'; expected one of "
                f"{', '.join(KNOWN)}."
            )
        found += sorted(file for file in files if Path(file).suffix)
    return found


def _load(path: Path, spec: Spec, part: PartSection, name: str, *, stays: bool = False) -> FilePart:
    """Return a part with its files read.

    Messages begin with the file at fault, after reading by its name in the spec.

    Args:
        stays: leave the rows of Parquet files where they are, and read a subsample of them.
    """
    unknown = [
        channel
        for channel in part.columns
        if channel not in (*spec.data.inputs, *spec.data.outputs)
    ]
    if unknown:
        raise InputError(
            f"{path}: 'data.{name}.columns': '{unknown[0]}' is neither an input nor an output."
        )
    files = expand_files(path, part.files, name)
    if stays and all(Path(file).suffix.lower() == ".parquet" for file in files):
        return _open_in_files(path, spec, part, name, files)
    records, results = [], []
    sets = part.column_sets
    used = _used_columns(spec, sets)
    for file in files:
        fault = thinned_fault(path.parent / file, spec.data.sampling_time, part.every, used)
        if fault:
            raise InputError(f"{path}: data.{name}: {fault}")
        try:
            beside = [
                read_record(
                    path.parent / file,
                    **_options(spec, columns),
                    rows=part.rows,  # type: ignore[arg-type]  (lists of two, checked by the spec)
                    every=part.every,
                    prepare=spec.data.steps,
                    uneven=spec.declared_physics.takes_uneven_rows,
                )
                for columns in sets
            ]
        except MissingSampleError as error:
            if spec.data.steps:  # whose message has the remedy
                raise
            keep = ', "keep" runs a motion through missing outputs' if spec.motion else ""
            remedy = f'`missing = "skip"` in [data] leaves such rows out{keep}.'
            raise MissingSampleError(f"{error} {remedy}") from None
        record = Record.join(beside)
        results.append(
            FileResult(file=file, sha256=file_digest(path.parent / file), rows=len(record))
        )
        records.append(record)
    record = Record.join(records)
    sources = (file for read, file in zip(records, files, strict=True) for _ in read.experiments)
    renamed = tuple(
        replace(e, source=file) for e, file in zip(record.experiments, sources, strict=True)
    )
    record = replace(record, experiments=renamed)
    warnings = ()
    if part.every > 1:
        given = spec.data.sampling_time
        apart = (
            f", so that rows are {part.every * given:g} s apart instead of {given:g} s"
            if given
            else ""
        )
        kept = f"{name}: one row in {part.every} is kept without a filter{apart}"
        warnings = (
            Warning("thinned", f"{kept}; content above the new Nyquist frequency is aliased."),
        )
    warnings += _guessed_encoding(path, files, name)
    warnings += _other_units(path, spec, files, name, part.column_sets)
    if spec.data.time is None:
        warnings += _other_step(path, spec, files, name, part.column_sets)
    if not record.even:
        warnings += (_uneven_steps(name, record),)
    if name == "train":
        warnings += warnings_of(record.prepared, [c.name for c in record.channels])
    return FilePart(name, record, part.skip, files=tuple(results), warnings=warnings)


def _uneven_steps(name: str, record: Record) -> Warning:
    """Return the warning that instants are uneven, and what that means for a motion."""
    steps = np.concatenate([e.steps[:-1] for e in record.experiments if e.steps is not None])
    text = (
        f"{name}: steps of time are uneven, {steps.min():.3g} to {steps.max():.3g} s, "
        f"{steps.mean():.3g} s on average. The motion steps from each instant to the next, with "
        "its inputs as `hold` says. Tests of the residual count samples, not seconds."
    )
    return Warning("uneven_steps", text)


def _open_in_files(
    path: Path, spec: Spec, part: PartSection, name: str, files: Sequence[str]
) -> FilePart:
    """Return a part whose rows remain in its Parquet files."""
    if spec.data.prepare:
        raise InputError(
            f"{path}: 'data.prepare' needs the rows in memory, and these stay in "
            'their files; prepare the files, or set engine.kind = "memory".'
        )
    if part.rows is not None or part.every > 1:
        raise InputError(
            f"{path}: 'data.{name}': `rows` and `every` need the rows in memory; "
            'write the files that way, or set engine.kind = "memory".'
        )
    if len(part.column_sets) > 1:
        raise InputError(
            f"{path}: 'data.{name}.columns': experiments beside each other need the rows in "
            'memory; give each channel one column, or set engine.kind = "memory".'
        )
    few_arenas()
    places = [path.parent / file for file in files]
    options = _options(spec, part.column_sets[0])
    source = open_parquet(places, **options, partition_rows=spec.engine.partition_rows)
    rows: dict[str, int] = {}
    for partition in source.partitions:
        rows[partition.path] = rows.get(partition.path, 0) + partition.rows
    results = [
        FileResult(
            file=file, sha256=file_digest(path.parent / file), rows=rows[str(path.parent / file)]
        )
        for file in files
    ]
    names = {str(path.parent / file): file for file in files}
    record = witness(source)
    record = replace(
        record, experiments=tuple(replace(e, source=names[e.source]) for e in record.experiments)
    )
    total, warnings = sum(rows.values()), _other_units(path, spec, files, name, part.column_sets)
    if spec.data.time is None:
        warnings += _other_step(path, spec, files, name, part.column_sets)
    if len(record) < total:
        text = (
            f"{name}: findings and figures use {len(record)} of {total} rows, in windows "
            "spread over them."
        )
        warnings += (Warning("witness", text),)
    return FilePart(name, record, part.skip, source, tuple(results), warnings)


def _options(spec: Spec, columns: Mapping[str, str]) -> dict[str, Any]:
    """Return the options for reading an experiment of these columns, in memory or not."""
    data = spec.data
    named = {key: getattr(data, key) for key in ("sampling_time", "time", "experiment", "missing")}
    channels = {"inputs": spec.channels(data.inputs), "outputs": spec.channels(data.outputs)}
    return named | channels | {"columns": columns}


def _used_columns(spec: Spec, sets: Sequence[Mapping[str, str]]) -> set[str]:
    """Return the columns of a part's files that are channels, or that separate experiments."""
    channels = [*spec.channels(spec.data.inputs), *spec.channels(spec.data.outputs)]
    named = {columns.get(c.name, c.file_column) for columns in sets for c in channels}
    return named | {spec.data.experiment or ""}


def _guessed_encoding(path: Path, files: Sequence[str], name: str) -> tuple[Warning, ...]:
    """Return a warning for the first file that is not UTF-8.

    Apparent text in an old encoding may be damaged.
    """
    for file in files:
        line = guessed_encoding(path.parent / file)
        if line is not None:
            text = (
                f"{name}: line {line} of {file} is no UTF-8, so the file is read as "
                "Windows-1252; save it as UTF-8."
            )
            return (Warning("encoding_guessed", text),)
    return ()


def _other_units(
    path: Path, spec: Spec, files: Sequence[str], name: str, sets: Sequence[Mapping[str, str]]
) -> tuple[Warning, ...]:
    """Return the warnings of the first file whose headers have other units than the channels.

    A test in a file of the training data repeats none.
    """
    known = expand_files(path, spec.data.train.files, "train") if name != "train" else ()
    found = _unit_faults(path, spec, [file for file in files if file not in known], sets)
    return tuple(fault.warning for fault in found)


def training_unit_faults(path: Path, spec: Spec) -> list[UnitFault]:
    """Return the channels of the training data whose columns have another unit."""
    files = expand_files(path, spec.data.train.files, "train")
    return _unit_faults(path, spec, files, spec.data.train.column_sets)


def _unit_faults(
    path: Path, spec: Spec, files: Sequence[str], sets: Sequence[Mapping[str, str]]
) -> list[UnitFault]:
    """Return what the first file with other units in its headers shows."""
    channels = {
        columns.get(channel.name, channel.file_column): channel
        for columns in sets
        for channel in (*spec.channels(spec.data.inputs), *spec.channels(spec.data.outputs))
    }
    every = (unit_faults(path.parent / file, channels) for file in files)
    return next((faults for faults in every if faults), [])


def _other_step(
    path: Path, spec: Spec, files: Sequence[str], name: str, sets: Sequence[Mapping[str, str]]
) -> tuple[Warning, ...]:
    """Return a warning where the instants of a file are not those of the spec's sampling time."""
    used = _used_columns(spec, sets)
    step, given = spec.data.sampling_time or 1.0, spec.data.sampling_time is not None
    for file in files:
        clock = read_clock(path.parent / file, used)
        if clock.column is None or clock.step is None:
            continue
        header = clock.column.header
        remedy = f'time = "{header}"' if clock.instants else f"sampling_time = {clock.step:g}"
        if (uneven := clock.uneven) is not None:
            shortest, longest = uneven
            found = (
                f"the steps of column '{header}' of {file} are {shortest:.3g} to {longest:.3g} s. "
                "Its rows are taken as evenly spaced"
            )
        elif abs(clock.step - step) > DRIFT * step:
            found = f"column '{header}' of {file} gives {clock.step:g} s"
        else:
            continue
        said = (
            f"`sampling_time` is {step:g} s"
            if given
            else "the spec gives no sampling time, so 1 s is used"
        )
        text = f"{name}: {said}, but {found}; perhaps {remedy} is meant."
        return (Warning("other_sampling_time", text),)
    return ()
