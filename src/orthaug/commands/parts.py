"""Parts of the data: their files read, checked, and cut to what can be scored."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from orthaug._base.errors import InputError
from orthaug._base.warning import Warning
from orthaug.commands.data_sections import PartSection
from orthaug.commands.spec import Spec
from orthaug.data.readers import read_record
from orthaug.data.record import Record, same_step
from orthaug.reports.result import FileResult


@dataclass(frozen=True, eq=False)
class Part:
    """A part of the data: its record, and how many leading samples of each recording are not scored."""

    name: str
    record: Record
    skip: int
    files: tuple[FileResult, ...]
    warnings: tuple[Warning, ...] = ()
    """Rows that were thinned out, or left out around missing samples."""

    def without_short(self, first: int, least: int = 0) -> Part:
        """Without stretches between missing samples that are too short for a row after the first `first`.

        Args:
            least: rows of a stretch that has a use.
        """
        if not self.record.missing:
            return self
        record, gaps = long_stretches(self.record, self.skips, first, least, f"data.{self.name}: ", self.skip)
        told = Warning("missing_rows", f"{self.name}: {gaps}")
        return replace(self, record=record, warnings=(*self.warnings, told))

    @property
    def skips(self) -> tuple[int, ...]:
        """How many leading samples of each experiment are not scored."""
        return tuple(max(0, self.skip - experiment.offset) for experiment in self.record.experiments)

    def scored(self, start: int) -> Record:
        """The record of the scored rows and their lags, where the first usable row is `start`."""
        kept = tuple(
            e.rows(max(0, skip - start), None) for e, skip in zip(self.record.experiments, self.skips, strict=True)
        )
        return replace(self.record, experiments=kept)

    def check_scorable(self, start: int, sampling_time: float, least: int = 0) -> None:
        """Raise InputError where an experiment has no row to score or fewer than `least`, or another sampling time."""
        if not same_step(self.record.sampling_time, sampling_time):
            raise InputError(
                f"data.{self.name}: sampled every {self.record.sampling_time:g} s, the training data every "
                f"{sampling_time:g} s; one model has one sampling time."
            )
        for experiment, skip in zip(self.record.experiments, self.skips, strict=True):
            first = max(start, skip)
            if len(experiment) < least:
                raise InputError(
                    f"{experiment.source}: data.{self.name} has {len(experiment)} rows, too few; at least {least} tell "
                    "where a run of this motion starts."
                )
            if len(experiment) <= first:
                raise InputError(
                    f"{experiment.source}: data.{self.name} has {len(experiment)} rows, too few; the first {first} are "
                    f"lags or skipped, so at least {first + 1} are needed."
                )


def long_stretches(
    record: Record, skips: Sequence[int], first: int, least: int = 0, what: str = "", skip: int = 0
) -> tuple[Record, str]:
    """A record without stretches that are too short for a row after the first ones, and what was left out, in words.

    Args:
        skips: leading samples of each stretch that are not scored.
        least: rows of a stretch that has a use.
        what: stands before what is wrong; `skip` is the largest of the skips as it was asked for.

    Raises:
        InputError: no stretch is long enough.
    """
    pairs = zip(record.experiments, skips, strict=True)
    long = tuple(e for e, own in pairs if len(e) > max(first, own) and len(e) >= least)
    if not long:
        most = max(len(e) for e in record.experiments)
        needed = f"the first {max(first, skip)} are lags or skipped"
        needed = f"at least {least} are needed" if most < least else needed
        raise InputError(
            f"{record.experiments[0].source}: {what}the longest stretch between missing samples has "
            f"{_count(most, 'row')}, too few: {needed}."
        )
    kept = replace(record, experiments=long)
    usable = sum(len(experiment) - first for experiment in long)
    lost = "row has missing cells and is" if record.missing == 1 else "rows have missing cells and are"
    return kept, (
        f"{record.missing} {lost} left out with all windows that touch them; "
        f"{_count(usable, 'usable row')} remain, in {_count(len(long), 'stretch', 'stretches')}."
    )


def load_parts(path: Path, spec: Spec) -> tuple[Part, Part | None, tuple[Part, ...]]:
    """Training, validation and test parts of the spec at `path`, as their files hold them."""
    train = _load(path, spec, spec.data.train, "train")
    validation = _load(path, spec, spec.data.validation, "validation") if spec.data.validation else None
    tests = tuple(_load(path, spec, part, f"tests.{name}") for name, part in spec.data.tests.items())
    return train, validation, tests


def _load(path: Path, spec: Spec, part: PartSection, name: str) -> Part:
    """Read a part's files. Messages begin with the file at fault; once it is read, with its name in the spec."""
    unknown = [channel for channel in part.columns if channel not in (*spec.data.inputs, *spec.data.outputs)]
    if unknown:
        raise InputError(f"{path}: 'data.{name}.columns': '{unknown[0]}' is neither an input nor an output.")
    records, files = [], []
    for file in part.files:
        record = read_record(
            path.parent / file,
            inputs=spec.channels(spec.data.inputs),
            outputs=spec.channels(spec.data.outputs),
            sampling_time=spec.data.sampling_time,
            time=spec.data.time,
            rows=part.rows,  # type: ignore[arg-type]  (lists of two, checked by the spec)
            every=part.every,
            columns=part.columns,
            missing=spec.data.missing,
        )
        digest = hashlib.sha256((path.parent / file).read_bytes()).hexdigest()
        files.append(FileResult(file=file, sha256=digest, rows=len(record)))
        records.append(record)
    record = Record.join(records)
    sources = (file for read, file in zip(records, part.files, strict=True) for _ in read.experiments)
    told = tuple(replace(e, source=file) for e, file in zip(record.experiments, sources, strict=True))
    record = replace(record, experiments=told)
    warnings = (_thinned(name, part.every),) if part.every > 1 else ()
    return Part(name, record, part.skip, tuple(files), warnings)


def _thinned(name: str, every: int) -> Warning:
    kept = f"one row in {every} is kept without a filter"
    return Warning("thinned", f"{name}: {kept}; content above the new Nyquist frequency folds back.")


def _count(number: int, thing: str, things: str = "") -> str:
    return f"{number} {thing if number == 1 else things or thing + 's'}"
