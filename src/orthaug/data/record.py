"""Measured records: one or more experiments of inputs and outputs at one sampling time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from orthaug._base.checks import (
    Matrix,
    Vector,
    as_signal,
    check_choice,
    check_type,
    is_number,
)
from orthaug._base.errors import InputError, show, visible
from orthaug._base.lines import plural
from orthaug._base.views import NotebookView
from orthaug.data.channels import Channel, as_channels, check_channels
from orthaug.data.prepared import Preparation, added_up

LONGEST_STEP = 1e12  # s; a longer one overflows somewhere in a time axis
UNEVEN = (
    "needs even instants, and those of this record are uneven. Resample it: "
    '`[[data.prepare]] step = "resample"`, from Python `oa.prepare(record, oa.Resample())`.'
)
_FEW = 20  # rows: of fewer with as many channels or more, the axes are exchanged


def same_step(step: float, other: float) -> bool:
    """Return whether two sampling times are the same to 0.1 %, as logged time columns are."""
    return bool(np.isclose(step, other, rtol=1e-3, atol=0.0))


def unbroken(values: Matrix) -> list[tuple[int, int]]:
    """Return half-open ranges of rows without a missing sample."""
    there = np.isfinite(values).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], there, [False]]).astype(int))).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def without_gaps(outputs: Matrix) -> Matrix:
    """Return outputs whose missing samples are interpolated linearly between the measured ones.

    Zero where there are none.
    """
    filled = outputs.copy()
    for column in filled.T:
        there = np.isfinite(column)
        column[~there] = (
            np.interp(np.flatnonzero(~there), np.flatnonzero(there), column[there])
            if there.any()
            else 0.0
        )
    return filled


def instants_of(count: int, sampling_time: float, steps: Vector | None) -> Vector:
    """Return the instants (count,) of rows in s, the first of them 0.

    Args:
        steps: from each row to the next, where they are uneven.
    """
    if steps is None:
        return sampling_time * np.arange(count)
    return np.concatenate([[0.0], np.cumsum(steps[:-1])])


def steps_between(instants: Vector) -> tuple[float, Vector]:
    """Return the mean step, and the step from each instant to the next, the last one repeated."""
    steps = np.diff(instants)
    return float(steps.mean()), np.append(steps, steps[-1])


def _counted(name: str, lost: Mapping[str, int]) -> str:
    """Return a channel's name, with the number of its samples that are missing."""
    return f"{name} ({lost[name]} missing)" if lost[name] else name


def check_step(value: Any) -> float:
    """Return `value` if it is a sampling time in seconds, otherwise raise InputError."""
    if not is_number(value) or not 0 < value <= LONGEST_STEP:
        raise InputError(
            "the sampling time must be a positive number of seconds, at most "
            f"{LONGEST_STEP:g}; got {show(value)}."
        )
    return float(value)


@dataclass(frozen=True, eq=False)
class Experiment:
    """One uninterrupted run: `inputs` (N, nu) and `outputs` (N, ny).

    Row k of both was taken at the same instant.

    Messages say where a row came from: `source`, `first_row`, `stride` and `first_line`, the file's
    line of its row 0. `start_time` [s] is the instant of the first row. A stretch between missing
    samples is a part of a recording, and begins `offset` rows into it. `steps` (N,) are the seconds
    from each row to the next where the instants are uneven, the last of them repeated; None where
    they are `sampling_time` apart.
    """

    inputs: Matrix
    outputs: Matrix
    source: str = ""
    first_row: int = 0
    stride: int = 1
    first_line: int | None = None
    start_time: float = 0.0
    offset: int = 0
    steps: Vector | None = None

    def __len__(self) -> int:
        return len(self.inputs)

    def __repr__(self) -> str:
        shapes = f"inputs {np.shape(self.inputs)}, outputs {np.shape(self.outputs)}"
        return f"Experiment({visible(self.source) + ': ' if self.source else ''}{shapes})"

    @property
    def recording_row(self) -> int:
        """The first row of the recording that this is a stretch of."""
        return self.first_row - self.offset * self.stride

    def check(self, inputs: int, outputs: int) -> None:
        """Raise InputError unless the columns fit the channels, and both have as many rows."""
        wanted = (len(self), inputs), (len(self), outputs)
        found = np.shape(self.inputs), np.shape(self.outputs)
        if found != wanted:
            raise InputError(
                f"{self.source or 'an experiment'}: `inputs` and `outputs` have the shapes "
                f"{found[0]} and {found[1]}; expected (rows, {inputs}) and (rows, {outputs}), "
                "one column for each channel."
            )
        steps = self.steps
        if steps is not None and not (np.shape(steps) == (len(self),) and np.all(steps > 0)):
            raise InputError(
                f"{self.source or 'an experiment'}: `steps` must be positive seconds to the next "
                f"row, one for each of the {len(self)} rows."
            )

    def instants(self, sampling_time: float) -> Vector:
        """Return the instants (N,) of the rows in s, from `start_time` on."""
        return self.start_time + instants_of(len(self), sampling_time, self.steps)

    def where(self, row: int) -> str:
        """Return the place of a row: `run.csv: line 17 (row 15)`, as much of it as is known."""
        row = self.first_row + self.stride * row
        place = (
            f"row {row}" if self.first_line is None else f"line {self.first_line + row} (row {row})"
        )
        return f"{visible(self.source)}: {place}" if self.source else place

    def rows(self, start: int | None, stop: int | None) -> Experiment:
        """Return the half-open range of rows `[start, stop)` as an experiment of its own."""
        first = self.first_row + self.stride * range(len(self))[start:stop].start
        steps = None if self.steps is None else self.steps[start:stop]
        inputs, outputs = self.inputs[start:stop], self.outputs[start:stop]
        return replace(self, inputs=inputs, outputs=outputs, first_row=first, steps=steps)


@dataclass(frozen=True, eq=False)
class Record(NotebookView):
    """Experiments that share channels and sampling time; lags never reach across experiments.

    `sampling_time` is in seconds. `outputs` is empty for a record that only carries inputs
    (something to simulate), and `inputs` is empty for an autonomous system.

    Examples:
        >>> import numpy as np
        >>> u, y = np.arange(5.0), np.ones(5)
        >>> record = Record.from_arrays(u=u, y=y, sampling_time=0.1, inputs=["force"])
        >>> record
        Record(1 experiment, 5 samples, Ts = 0.1 s, inputs: force; outputs: y)
        >>> [len(part) for part in record.split(0.6)]
        [3, 2]
        >>> record[-2:]
        Record(1 experiment, 2 samples, Ts = 0.1 s, inputs: force; outputs: y)
    """

    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    sampling_time: float
    experiments: tuple[Experiment, ...]
    time_column: str | None = None
    """The column of the file that holds the instants, where there is one."""
    missing: int = 0
    """Rows that were left out because a sample was missing: 0 unless it was read with
    `missing="skip"` or prepared.
    """
    prepared: tuple[Preparation, ...] = ()
    """Preparation of the samples, in order."""
    experiment_column: str | None = None
    """The column of the file that labels the experiments, where there is one."""

    def __post_init__(self) -> None:
        for name in ("inputs", "outputs"):
            object.__setattr__(self, name, as_channels(getattr(self, name), name))
        check_channels(self.inputs, self.outputs)
        object.__setattr__(self, "sampling_time", check_step(self.sampling_time))
        if isinstance(self.experiments, list):
            object.__setattr__(self, "experiments", tuple(self.experiments))
        check_type(self.experiments, tuple, "experiments", "a tuple of Experiments")
        if not self.experiments:
            raise InputError("a record needs at least one experiment; got none.")
        for experiment in self.experiments:
            check_type(experiment, Experiment, "experiments", "a tuple of Experiments")
            experiment.check(len(self.inputs), len(self.outputs))

    @classmethod
    def from_arrays(
        cls,
        u: Any = None,
        y: Any = None,
        *,
        sampling_time: float = 1.0,
        inputs: Sequence[str | Channel] | None = None,
        outputs: Sequence[str | Channel] | None = None,
        source: str = "",
        missing: str = "error",
        time: object = None,
    ) -> Record:
        """Return one experiment from arrays.

        Args:
            u: inputs, (N,) or (N, nu); None for none.
            y: outputs, (N,) or (N, ny); None for a record to simulate.
            sampling_time: seconds between rows.
            inputs, outputs: names (or `Channel`s with units); default `u`, `y`, or `u1, u2, …`.
            source: where it came from, for messages.
            missing: "error", or "keep" where outputs may be NaN: a motion and an `Observer` run
                through such rows.
            time: instants (N,) in s that rise unevenly, instead of `sampling_time`, which is then
                their mean step. Equations of motion step from each to the next.

        Raises:
            InputError: lengths that differ, cells that are not finite, names that do not fit.

        Examples:
            >>> outputs = [Channel("angle", "rad"), "speed"]
            >>> Record.from_arrays([0.0, 1.0], [[0, 1], [2, 3]], outputs=outputs)
            Record(1 experiment, 2 samples, Ts = 1 s, inputs: u; outputs: angle, speed)
        """
        if u is None and y is None:
            raise InputError("a record needs `u`, `y` or both; got neither.")
        check_choice(missing, ("error", "keep"), "`missing`")
        y_signal = None if y is None else as_signal(y, "y", gaps=missing == "keep")
        u_signal = None if u is None else as_signal(u, "u")
        for name, signal in (("u", u_signal), ("y", y_signal)):
            if signal is not None and len(signal) < _FEW <= signal.shape[1]:
                raise InputError(
                    f"`{name}` has {plural(len(signal), 'row')} and {signal.shape[1]} columns; "
                    f"rows are samples, and columns are channels. Give {name}.T."
                )
        rows = len(u_signal) if u_signal is not None else len(y_signal)  # type: ignore[arg-type]
        u_signal = np.empty((rows, 0)) if u_signal is None else u_signal
        y_signal = np.empty((rows, 0)) if y_signal is None else y_signal
        if len(u_signal) != len(y_signal):
            raise InputError(
                f"`y` has {len(y_signal)} rows but `u` has {len(u_signal)}. "
                "Give both the same length, or drop the last rows."
            )
        one = Experiment(u_signal, y_signal, source)
        if time is not None:
            if sampling_time != 1.0:
                raise InputError("give `sampling_time` or `time`, not both.")
            instants = as_signal(time, "time")[:, 0]
            if len(instants) != rows or rows < 2 or not (np.diff(instants) > 0).all():
                raise InputError(
                    f"`time` must be {max(rows, 2)} rising instants in s, one for each row."
                )
            sampling_time, steps = steps_between(instants)
            one = replace(one, start_time=float(instants[0]), steps=steps)
        return cls(
            _channels(inputs, "u", u_signal.shape[1]),
            _channels(outputs, "y", y_signal.shape[1]),
            sampling_time,
            (one,),
        )

    @classmethod
    def join(cls, records: Iterable[Record]) -> Record:
        """Return one record with the experiments of several, each kept as it is."""
        records = tuple(records)
        for record in records:
            check_type(record, Record, "records", "several Records")
        if not records:
            raise InputError("a record needs at least one experiment; got none.")
        first = records[0]
        for other in records[1:]:
            if (other.inputs, other.outputs) != (first.inputs, first.outputs):
                raise InputError(
                    f"records with other channels cannot be joined: {first!r} and {other!r}."
                )
            even = other.even and first.even
            if even and not same_step(other.sampling_time, first.sampling_time):
                raise InputError(
                    f"{other.experiments[0].source or 'a record'}: sampled every "
                    f"{other.sampling_time:g} s, {first.experiments[0].source or 'another'} "
                    f"every {first.sampling_time:g} s; resample one of them."
                )
        if not all(record.even for record in records):
            records = tuple(record.with_steps() for record in records)
            steps = [e.steps for record in records for e in record.experiments]
            first = replace(first, sampling_time=float(np.mean(np.concatenate(steps))))  # type: ignore[arg-type]
        experiments = tuple(e for record in records for e in record.experiments)
        missing = sum(record.missing for record in records)
        return replace(
            first,
            experiments=experiments,
            missing=missing,
            prepared=added_up([r.prepared for r in records]),
        )

    def __len__(self) -> int:
        return sum(len(experiment) for experiment in self.experiments)

    __iter__ = None  # rows of several experiments would follow each other without a sign

    def __getitem__(self, rows: slice) -> Record:
        """Return the half-open range of rows `record[start:stop]`.

        Negative ones count from the end.

        Rows count over all experiments, one behind the other, as `len(record)` does. Experiments
        stay apart: the range cuts the first and the last of them, and those outside are left out.

        Raises:
            InputError: a row, a step, places that are no whole numbers, or a range without rows.
        """
        start, stop = _range_of(rows, len(self))
        kept, before = [], 0
        for experiment in self.experiments:
            first, last = max(start - before, 0), min(stop - before, len(experiment))
            if first < last:
                kept.append(self._piece(experiment, first, last))
            before += len(experiment)
        return replace(self, experiments=tuple(kept))

    def __repr__(self) -> str:
        count = len(self.experiments)
        lost = dict.fromkeys((channel.name for channel in self.channels), 0)
        for channel, samples in zip(self.outputs, self.measured, strict=True):
            lost[channel.name] = len(self) - len(samples)
        names = "; ".join(
            f"{kind}: {', '.join(_counted(channel.name, lost) for channel in channels) or 'none'}"
            for kind, channels in (("inputs", self.inputs), ("outputs", self.outputs))
        )
        uneven = "" if self.even else " on average, uneven"
        return (
            f"Record({plural(count, 'experiment')}, {len(self)} samples, Ts = "
            f"{self.sampling_time:g} s{uneven}, {names})"
        )

    @property
    def even(self) -> bool:
        """True if the rows of all experiments are `sampling_time` apart."""
        return all(experiment.steps is None for experiment in self.experiments)

    @property
    def longest_step(self) -> float:
        """The longest time between two rows in s."""
        steps = [e.steps[:-1].max() for e in self.experiments if e.steps is not None and len(e) > 1]
        return max(map(float, steps), default=self.sampling_time)

    def with_steps(self) -> Record:
        """Return the record with the step of every row, of even instants too."""
        step = self.sampling_time
        filled = (
            e if e.steps is not None else replace(e, steps=np.full(len(e), step))
            for e in self.experiments
        )
        return replace(self, experiments=tuple(filled))

    def check_even(self, what: str) -> None:
        """Raise InputError where the instants are uneven, which `what` cannot take."""
        if not self.even:
            raise InputError(f"{what} {UNEVEN}")

    @property
    def recordings(self) -> tuple[int, ...]:
        """Number of the recording that each experiment is a stretch of, from 0.

        Missing samples cut a recording into several experiments.
        """
        found: list[int] = []
        for i, one in enumerate(self.experiments):
            before = self.experiments[i - 1] if i else None
            goes_on = (
                before is not None
                and before.source == one.source
                and 0 <= before.offset < one.offset
                and before.recording_row == one.recording_row
            )
            found.append((found[-1] if goes_on else found[-1] + 1) if found else 0)
        return tuple(found)

    @property
    def lost_rows(self) -> list[int]:
        """Rows with missing samples that were left out of the recording before each experiment."""
        found: list[int] = []
        recordings = self.recordings
        for i, one in enumerate(self.experiments):
            before = self.experiments[i - 1]
            lost = one.offset
            if i and recordings[i] == recordings[i - 1]:
                lost = (one.first_row - before.first_row) // one.stride - len(before)
            found.append(max(lost, 0))
        return found

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Outputs first, then inputs: the order of the regressor."""
        return self.outputs + self.inputs

    @property
    def complete(self) -> bool:
        """True if every output was measured on every row."""
        return not any(np.isnan(experiment.outputs).any() for experiment in self.experiments)

    @property
    def measured(self) -> tuple[Vector, ...]:
        """The samples of each output that were measured, experiments one after another."""
        columns = np.concatenate([experiment.outputs for experiment in self.experiments]).T
        return tuple(column[~np.isnan(column)] for column in columns)

    @property
    def deviation(self) -> Vector:
        """The standard deviation of each output (ny,), of what was measured."""
        values = np.concatenate([experiment.outputs for experiment in self.experiments])
        return values.std(axis=0, where=True if self.complete else ~np.isnan(values))

    def check_measured(self) -> None:
        """Raise InputError where an output is missing.

        A record for an `Observer` or a motion may miss outputs.
        """
        for experiment in self.experiments:
            bad = np.flatnonzero(np.isnan(experiment.outputs).any(axis=1))
            if bad.size:
                raise InputError(
                    f"{experiment.where(int(bad[0]))}: an output is missing, which is accepted "
                    "only by a motion in memory whose errors are white, and by an Observer; leave "
                    'such rows out (`missing = "skip"`).'
                )

    def rows(self, start: int | None = None, stop: int | None = None) -> Record:
        """Return the half-open range of rows `[start, stop)` of a single experiment.

        Negative ones count from its end.
        """
        for name, value in (("start", start), ("stop", stop)):
            check_type(value, int | np.integer | None, name, "a whole number or None")
        if len(self.experiments) != 1:
            raise InputError(
                f"`rows` needs a record of one experiment; this one has {len(self.experiments)}."
            )
        return replace(self, experiments=(self._piece(self.experiments[0], start, stop),))

    def split(self, fraction: float, by: str = "rows") -> tuple[Record, Record]:
        """Return two records: the first `fraction` and the rest.

        Args:
            fraction: between 0 and 1, rounded to whole rows or experiments.
            by: "rows" cuts every experiment, the first `fraction` of its rows into the first
                record; "experiments" leaves each whole, and puts the first `fraction` of them into
                the first record.

        Raises:
            InputError: a part that would be empty.

        Examples:
            >>> import numpy as np
            >>> both = Record.join([Record.from_arrays(y=np.ones(n)) for n in (10, 20)])
            >>> both.split(0.8)[1]
            Record(2 experiments, 6 samples, Ts = 1 s, inputs: none; outputs: y)
            >>> both.split(0.5, by="experiments")[1]
            Record(1 experiment, 20 samples, Ts = 1 s, inputs: none; outputs: y)
        """
        if not is_number(fraction) or not 0 < fraction < 1:
            raise InputError(f"`fraction` must lie between 0 and 1; got {show(fraction)}.")
        check_choice(by, ("rows", "experiments"), "`by`")
        pieces = self.experiments if by == "rows" else (self.experiments,)
        cuts = [round(fraction * len(piece)) for piece in pieces]
        for piece, cut in zip(pieces, cuts, strict=True):
            if not 0 < cut < len(piece):
                held = (
                    f"an experiment has {len(piece)} rows"
                    if by == "rows"
                    else f"there are {len(piece)} experiments"
                )
                raise InputError(
                    f"a part of the split at {fraction:g} would be empty: {held}. Take another "
                    "`fraction`."
                )
        if by == "experiments":
            first, second = self.experiments[: cuts[0]], self.experiments[cuts[0] :]
        else:
            places = tuple(zip(self.experiments, cuts, strict=True))
            first = tuple(self._piece(experiment, None, place) for experiment, place in places)
            second = tuple(self._piece(experiment, place, None) for experiment, place in places)
        return replace(self, experiments=first), replace(self, experiments=second)

    def _piece(self, experiment: Experiment, start: int | None, stop: int | None) -> Experiment:
        """Return rows of an experiment, with the instant of their first."""
        first = range(len(experiment))[start:stop].start
        return replace(
            experiment.rows(start, stop),
            start_time=float(experiment.instants(self.sampling_time)[first])
            if first < len(experiment)
            else experiment.start_time,
        )


def _range_of(rows: Any, count: int) -> tuple[int, int]:
    """Return start and stop of a slice of `count` rows."""
    if not isinstance(rows, slice):
        raise InputError(
            "a record is cut by a range of rows, such as record[100:500]; got "
            f"record[{show(rows)}]."
        )
    for place in (rows.start, rows.stop, rows.step):
        check_type(
            place,
            int | np.integer | None,
            "the range of rows",
            "record[start:stop] with whole numbers",
        )
    if rows.step not in (None, 1):
        raise InputError(
            f"record[start:stop:{rows.step}]: a step would leave out rows without a filter, "
            "and change the sampling time. Read the file with `every`, or take "
            "`prepare(record, Decimate(factor))`."
        )
    start, stop, _ = rows.indices(count)
    if start >= stop:
        ends = [":".join("" if place is None else str(place) for place in (rows.start, rows.stop))]
        raise InputError(f"record[{ends[0]}] holds no row; the record has {count}.")
    return start, stop


def _channels(
    given: Sequence[str | Channel] | None, default: str, count: int
) -> tuple[Channel, ...]:
    if given is None:
        given = [default] if count == 1 else [f"{default}{i + 1}" for i in range(count)]
    given = as_channels(given, "inputs" if default == "u" else "outputs")
    if len(given) != count:
        raise InputError(
            f"{len(given)} names for {count} channels of `{default}`; give one name for each "
            "column."
        )
    return given
