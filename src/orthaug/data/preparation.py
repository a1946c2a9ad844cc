"""Data prepared step by step within each experiment, with an account of what was done."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Gt

from orthaug._base.checks import Matrix, check_choice, check_type
from orthaug._base.errors import InputError, Warning, show
from orthaug._base.registry import OneOf, Registry, check_fields
from orthaug.data.prepared import FILTERS, Preparation
from orthaug.data.record import Experiment, Record, same_step, unbroken
from orthaug.data.steps import (
    Channels,
    Detrend,
    Fill,
    Limits,
    Outliers,
    Repeats,
    Resample,
    Run,
    Shift,
    Step,
    Unwrap,
)

# Chebyshev filter of decimation: order, dB, share of the new Nyquist
_ANTI_ALIAS, _RIPPLE, _CORNER = (8, 0.05, 0.8)

Phase = Annotated[str, OneOf(("zero", "causal"))]


def _filter_stretches(values: Matrix, sections: Matrix, phase: str, what: str) -> Matrix:
    """Filter every stretch without a gap; samples of stretches that are too short are missing."""
    from scipy.signal import sosfilt, sosfilt_zi, sosfiltfilt

    result, pad = np.full_like(values, np.nan), 3 * (2 * len(sections) + 1)
    for a, b in unbroken(values):
        piece, part = values[a:b], slice(a, b)
        if phase == "causal":
            start = sosfilt_zi(sections)[:, :, None] * piece[0]
            result[part] = sosfilt(sections, piece, axis=0, zi=start)[0]
        elif len(piece) > pad:
            result[part] = sosfiltfilt(sections, piece, axis=0, padtype="odd", padlen=pad)
    if not np.isfinite(result).all(axis=1).any():
        longest = max((b - a for a, b in unbroken(values)), default=0)
        raise InputError(
            f"{what}: the longest stretch without a gap has {longest} rows, but a filter of "
            f"zero phase needs {pad + 1}. Fill gaps before it, take a lower order, or "
            'phase = "causal".'
        )
    return result


@dataclass(frozen=True)
class _Butterworth:
    """A Butterworth filter.

    With zero phase it runs forward and backward, which squares its gain: −6 dB at the cutoff.
    """

    cutoff: Annotated[float, Gt(0)]
    """Hz"""
    order: Annotated[int, Ge(1)] = 4
    phase: Phase = "zero"
    channels: Channels = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.order > 10:
            raise InputError(f"`order` must be at most 10; got {show(self.order)}.")

    def _filter_run(self, run: Run, kind: str) -> Run:
        from scipy.signal import butter

        run.check_even(f"`{kind}`")
        nyquist = 0.5 / run.step
        if self.cutoff >= nyquist:
            raise InputError(
                f"`cutoff`: {self.cutoff:g} Hz is not below {nyquist:g} Hz, half the sampling "
                f"frequency at steps of {run.step:g} s; take a lower one."
            )
        columns = run.columns(self.channels)
        sections = np.asarray(butter(self.order, self.cutoff / nyquist, kind, output="sos"))
        return run.with_values(
            columns, _filter_stretches(run.values[:, columns], sections, self.phase, f"`{kind}`")
        )


@dataclass(frozen=True)
class Lowpass(_Butterworth):
    """A Butterworth low-pass over all channels alike; `cutoff` in Hz.

    Args:
        cutoff: Hz, below half the sampling frequency.
        order: 1 to 10.
        phase: "zero" goes forth and back: nothing is delayed, the gain is squared (−6 dB at the
            cutoff), and a sample depends on later ones, which a loop does not have. "causal" goes
            forth once and delays what it filters.
        channels: names; None for all. Inputs and outputs that are filtered alike keep the linear
            relation between them; filter some alone, and the filter becomes part of the model.

    Examples:
        >>> Lowpass(cutoff=10.0, phase="causal")
        Lowpass(cutoff=10.0, order=4, phase='causal', channels=None)
    """

    def apply(self, run: Run) -> Run:
        return self._filter_run(run, "lowpass")


@dataclass(frozen=True)
class Highpass(_Butterworth):
    """A Butterworth high-pass over all channels alike; `cutoff` in Hz.

    Args:
        cutoff: Hz, below half the sampling frequency.
        order: 1 to 10.
        phase: "zero" goes forth and back: nothing is delayed, the gain is squared (−6 dB at the
            cutoff), and a sample depends on later ones, which a loop does not have. "causal" goes
            forth once and delays what it filters.
        channels: names; None for all. Inputs and outputs that are filtered alike keep the linear
            relation between them; filter some alone, and the filter becomes part of the model.
    """

    def apply(self, run: Run) -> Run:
        return self._filter_run(run, "highpass")


@dataclass(frozen=True)
class Decimate:
    """Step that keeps each `factor`-th row behind a low-pass.

    The low-pass is a Chebyshev filter of order 8 at 0.8 of the new Nyquist frequency.

    Args:
        factor: 2 or more; the sampling time is multiplied by it.
        phase: of the low-pass, over all channels: "zero" (forth and back, no delay, looks at later
            samples) or "causal" (delays all channels alike).

    Examples:
        >>> import numpy as np
        >>> from orthaug.data import Record, prepare
        >>> record = Record.from_arrays(u=np.ones(400), y=np.ones(400), sampling_time=0.01)
        >>> prepare(record, Decimate(4))
        Record(1 experiment, 100 samples, Ts = 0.04 s, inputs: u; outputs: y)
    """

    factor: Annotated[int, Ge(2)]
    phase: Phase = "zero"

    def __post_init__(self) -> None:
        check_fields(self)

    def apply(self, run: Run) -> Run:
        from scipy.signal import cheby1

        run.check_even("`decimate`")
        sections = np.asarray(cheby1(_ANTI_ALIAS, _RIPPLE, _CORNER / self.factor, output="sos"))
        values = _filter_stretches(run.values, sections, self.phase, "`decimate`")[:: self.factor]
        kept = replace(
            run, values=values, instants=run.instants[:: self.factor], step=run.step * self.factor
        )
        return replace(kept, stride=run.stride * self.factor)


STEPS = Registry(
    "step",
    {
        "detrend": Detrend,
        "lowpass": Lowpass,
        "highpass": Highpass,
        "decimate": Decimate,
        "resample": Resample,
        "outliers": Outliers,
        "repeats": Repeats,
        "limits": Limits,
        "unwrap": Unwrap,
        "fill": Fill,
        "shift": Shift,
    },
    reserved=("step",),
)
MENDING = ("outliers", "repeats", "limits", "unwrap", "fill")
"""Steps that leave good samples as they are."""
SAMPLING = ("decimate", "resample")
"""Steps after which there are other instants."""


def prepare(record: Record, *steps: Any, missing: str = "skip") -> Record:
    """Return a record after steps such as `Detrend()` and `Lowpass(cutoff=10.0)`, in this order.

    `.prepared` lists them.

    Every step acts within an experiment, never across. Samples that are missing afterwards split
    experiments. Gaps that were left out when the record was read are not seen: to fill them give
    the steps to `read_record(prepare=…)`.

    Args:
        missing: "skip", or "keep" where outputs may be missing: a motion runs through these rows.

    Raises:
        InputError: no step, or one that cannot be done with these samples.

    Examples:
        >>> import numpy as np
        >>> record = Record.from_arrays(u=np.ones(40), y=np.arange(40.0), sampling_time=0.1)
        >>> from orthaug.data.steps import Detrend
        >>> prepare(record, Detrend(degree=1)).prepared[0].text
        'detrend (degree 1)'
    """
    check_type(record, Record, "record", "a Record")
    check_steps(steps)
    check_choice(missing, ("skip", "keep"), "`missing`")
    runs = []
    if not record.even and not (steps and isinstance(steps[0], Resample)):
        record.check_even("preparation whose first step is not Resample()")
    for e in record.experiments:
        instants = e.instants(record.sampling_time)
        names = tuple(c.name for c in (*record.inputs, *record.outputs))
        values = np.hstack([e.inputs, e.outputs])
        step, even = record.sampling_time, e.steps is None
        run = Run(values, instants, names, len(record.inputs), step, even=even)
        runs.append((run, e))
    experiments, step, done, lost = prepared_experiments(runs, steps, keep=missing == "keep")
    changed = replace(
        record, experiments=experiments, sampling_time=step, missing=record.missing + lost
    )
    return replace(changed, prepared=(*record.prepared, *done))


def check_steps(steps: Any) -> None:
    """Raise InputError for an argument that is no list of steps."""
    if not isinstance(steps, list | tuple) or not all(
        type(step) in STEPS.values() for step in steps
    ):
        known = ", ".join(kind.__name__ for kind in STEPS.values())
        raise InputError(
            f"preparation takes a list of steps with their arguments: {known}; got {steps!r:.80}."
        )


def prepared_experiments(
    runs: Iterable[tuple[Run, Experiment]], steps: Sequence[Step], *, keep: bool = False
) -> tuple[tuple[Experiment, ...], float, tuple[Preparation, ...], int]:
    """Return the experiments after the steps, with their sampling time and an account.

    The account is what was done, and how many rows are left out as missing.

    Args:
        runs: with the experiment that each was, for its place in the file.
        keep: keep outputs that are missing.
    """
    found: list[Experiment] = []
    kinds = {STEPS[kind]: kind for kind in STEPS}
    done = [_Account(kinds[type(step)], step) for step in steps]
    sampling, lost, where = [], 0, ""
    for run, place in runs:
        for account in done:
            try:
                after = account.step.apply(run)
            except InputError as error:
                source = f"{place.source}: " if place.source else ""
                raise InputError(f"{source}{error}") from None
            account.count(run, after)
            run = after
        pieces = _pieces(run, place, keep)
        lost += len(run.values) - sum(map(len, pieces))
        found += pieces
        sampling.append(run.step)
        where = place.source
    if not found:
        raise InputError(
            f"{where + ': ' if where else ''}after preparation every row has a missing sample."
        )
    if not all(same_step(step, sampling[0]) for step in sampling):
        apart = f"{min(sampling):g} to {max(sampling):g} s"
        raise InputError(
            f"after preparation samples are {apart} apart; give one `sampling_time` in `resample`."
        )
    return tuple(found), sampling[0], tuple(account.prepare() for account in done), lost


@dataclass(eq=False)
class _Account:
    """Number of samples that a step marked as missing or filled."""

    kind: str
    step: Any
    marked: int = 0
    filled: int = 0

    def count(self, before: Run, after: Run) -> None:
        if self.kind in MENDING:
            old, new = np.isfinite(before.values), np.isfinite(after.values)
            self.marked += int((old & ~new).sum())
            self.filled += int((new & ~old).sum())

    def prepare(self) -> Preparation:
        return Preparation(self.kind, _options_of(self.step), self.marked + self.filled)


def _options_of(step: Any) -> dict[str, object]:
    """Return the fields of a step that have values."""
    found = {name: getattr(step, name) for name in type(step).__dataclass_fields__}
    plain = {
        name: list(value) if isinstance(value, tuple) else value for name, value in found.items()
    }
    return {name: value for name, value in plain.items() if value is not None}


def _pieces(run: Run, place: Experiment, keep: bool) -> list[Experiment]:
    """Return the stretches of rows without a missing sample."""
    stride = place.stride * run.stride
    line = None if run.moved else place.first_line
    pieces = []
    for a, b in unbroken(run.values[:, : run.inputs] if keep else run.values):
        first = a if run.moved else place.first_row + place.stride * run.first + stride * a
        values = run.values[a:b]
        where = (
            place.source,
            first,
            1 if run.moved else stride,
            line,
            float(run.instants[a]),
            place.offset + a,
        )
        pieces.append(Experiment(values[:, : run.inputs], values[:, run.inputs :], *where))
    return pieces


def steps_again(
    prepared: Sequence[Preparation], names: Sequence[str], sampling_time: float
) -> tuple[tuple[Step, ...], float]:
    """Return the steps that prepare a new record as another one was.

    The second result is its sampling time [s] before the steps.

    Args:
        names: channels that the new record has; the steps leave out others.
        sampling_time: of the prepared record [s], also where a step took the usual one.
    """
    steps: list[Step] = []
    for done in reversed(prepared):
        options = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in done.options.items()
        }
        if done.step == "resample":
            options["sampling_time"] = sampling_time
        if done.step == "decimate":
            sampling_time /= done.options["factor"]
        if "channels" in options:
            options["channels"] = tuple(name for name in options["channels"] if name in names)
        if options.get("channels") != () and options.get("channel") in (None, *names):
            steps.insert(0, STEPS[done.step](**options))
    return tuple(steps), sampling_time


def warnings_of(
    prepared: Sequence[Preparation], names: Sequence[str], *, free_run: bool = False
) -> tuple[Warning, ...]:
    """Return warnings about a fit to data that were prepared so.

    `free_run` says that it is trained on the free run, as is advised otherwise.
    """
    biased, other = ", which biases θ one step ahead", ', and with training.focus = "simulation"'
    biased, other = ("", "") if free_run else (biased, other)
    found = []
    for done in prepared:
        channels = done.options.get("channels")
        if done.step in FILTERS and channels is not None and set(channels) != set(names):
            found.append(
                Warning(
                    "filtered_alone",
                    f"{done.step} acts on {', '.join(channels)} only: the model then explains "
                    "the filter too, and θ is biased. Leave `channels` out, so that inputs and "
                    "outputs are filtered alike.",
                )
            )
        if done.step not in FILTERS:
            continue
        late = ", and delays its channels" if done.options.get("phase") == "causal" else ""
        found.append(
            Warning(
                "filtered_noise",
                f"{done.step} colours the noise{late}: residuals are correlated{biased}. A "
                "nonlinear term of filtered signals differs from the filtered term. Compare with "
                f"a fit to the data as they are{other}.",
            )
        )
    return tuple(found)


def of_free_run(
    warnings: Sequence[Warning], prepared: Sequence[Preparation], names: Sequence[str]
) -> tuple[Warning, ...]:
    """Return warnings of which those on preparation advise no free run, since it is trained on."""
    before, after = (warnings_of(prepared, names, free_run=free_run) for free_run in (False, True))
    instead = dict(zip(before, after, strict=True))
    return tuple(instead.get(warning, warning) for warning in warnings)
