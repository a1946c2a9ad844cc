"""Training rows that chose terms: recorded in a spec, and checked when it is fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthaug._base.errors import InputError, Warning
from orthaug.commands.parts import expand_files
from orthaug.inference.chosen_terms import Intervals
from orthaug.models.terms import Terms
from orthaug.physics.baseline import Baseline
from orthaug.selection.parts import CONDITIONAL, Parts, of_parts, split_record

if TYPE_CHECKING:
    from orthaug.commands.job import Job
    from orthaug.commands.spec import Spec
    from orthaug.fitting.estimates import Estimate

_CONDITIONAL = (
    "no standard errors and no intervals: the terms were chosen on some of these rows "
    "([selection.chosen_on]), where they look more certain than they are. Fit other rows for "
    "intervals; `orthaug select` keeps half of the rows for that where these suffice."
)
_MOVES_ROWS = {"decimate", "resample", "shift"}


@dataclass(frozen=True)
class Rows:
    """Files and row ranges of a part of a spec; no ranges are all rows."""

    files: tuple[str, ...]
    ranges: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, files: Sequence[str], rows: Any) -> Rows:
        """Return those that a section gives."""
        ranges = [] if rows is None else [rows] if isinstance(rows[0], int) else rows
        return cls(tuple(files), tuple((int(a), int(b)) for a, b in ranges))

    @property
    def declared(self) -> dict[str, Any]:
        """The keys of a section."""
        ranges = [list(one) for one in self.ranges]
        rows = {"rows": ranges[0] if len(ranges) == 1 else ranges} if ranges else {}
        return {"files": list(self.files), **rows}

    def meets(self, other: Rows, folder: Path) -> bool:
        """Return whether a row is in both."""
        paths = [{(folder / file).resolve() for file in one.files} for one in (self, other)]
        if not paths[0] & paths[1]:
            return False
        if not self.ranges or not other.ranges:
            return True
        return any(a < d and c < b for a, b in self.ranges for c, d in other.ranges)


def parts_of(
    job: Job, baseline: Baseline, lags: int, halves: bool | None, *, network: bool
) -> Parts:
    """Cut the training data of a job so that its spec can say how.

    Raises:
        InputError: halves that were asked for, of data that a spec cannot cut.
    """
    record, section, path = job.train.record, job.spec.data.train, job.path
    if network and not halves:
        return Parts(record, record, CONDITIONAL)
    if halves is False:
        return Parts(record, record, Intervals.empty("`selection.halves` is false"))
    files, ranges = expand_files(path, section.files, "train"), Rows.of((), section.rows).ranges
    fault = _not_cut(job, len(files) * max(len(ranges), 1))
    by = None
    if len(files) > 1:
        by = "rows" if len(ranges) > 1 else "experiments"
    try:
        if fault:
            raise InputError(fault)
        return split_record(record, baseline, lags, by=by, **({"least": 1} if halves else {}))
    except InputError as error:
        if halves:
            raise InputError(f"{path}: 'selection.halves': {error}.") from None
        return Parts(record, record, Intervals.empty(str(error)))


def _not_cut(job: Job, expected: int) -> str:
    """Return why a spec cannot say how the training data are cut; nothing where it can."""
    if any(step.step in _MOVES_ROWS for step in job.spec.data.prepare):
        return (
            "`data.prepare` changes the rows, so no range of rows in the files is a half of "
            "the data"
        )
    if len(job.train.record.experiments) != expected:
        return (
            "the files hold stretches of rows, so no range of rows in the files is a half of "
            "the data"
        )
    return ""


def split_rows(job: Job, parts: Parts) -> tuple[Rows, Rows]:
    """Return the rows that chose and those that are fitted, as a spec says them."""
    section, record = job.spec.data.train, job.train.record
    files = expand_files(job.path, section.files, "train")
    whole = Rows.of(files, section.rows)
    if parts.fitted is record:
        return whole, whole
    count = len(record.experiments) - len(parts.fitted.experiments)
    if count:
        if len(files) > 1:
            return Rows(whole.files[:count], whole.ranges), Rows(whole.files[count:], whole.ranges)
        return Rows(whole.files, whole.ranges[:count]), Rows(whole.files, whole.ranges[count:])
    ranges = whole.ranges or ((0, section.every * len(record)),)
    lengths = [len(one) for one in parts.chooses.experiments]
    places = [first + section.every * lengths[i] for i, (first, _) in enumerate(ranges)]
    first = tuple((a, place) for (a, _), place in zip(ranges, places, strict=True))
    second = tuple((place, b) for (_, b), place in zip(ranges, places, strict=True))
    return Rows(whole.files, first), Rows(whole.files, second)


def intervals_of(job: Job, fit: Estimate) -> Intervals | None:
    """Return where the intervals of a fit come from whose terms were chosen.

    None where the spec says no such.
    """
    spec: Spec = job.spec
    chosen, bound = spec.selection.chosen_on, fit.model.form.bound
    if chosen is None or not isinstance(bound.learner, Terms):
        return None
    train = Rows.of(expand_files(job.path, spec.data.train.files, "train"), spec.data.train.rows)
    if Rows.of(chosen.files, chosen.rows).meets(train, job.path.parent):
        return Intervals("none", _CONDITIONAL)
    return of_parts(job.problem.count)


def after_choice(job: Job, fit: Estimate) -> tuple[Any, Intervals | None]:
    """Return a fit and the source of its intervals; without them if its rows chose its terms."""
    found = intervals_of(job, fit) if fit.status.ok else None
    if found is None or found.source != "none":
        return fit, found
    return fit.withheld("chosen", Warning("conditional_on_selection", found.text)), found
