"""What the commands do: a spec in, a result out. Parsing of arguments and printing is the CLI's."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.errors import InputError
from orthaug.commands.spec import Part, Spec, load_spec
from orthaug.commands.suspects import check_suspects
from orthaug.data.expressions import Lag
from orthaug.data.readers import read_record
from orthaug.data.record import Record, check_channels, same_step
from orthaug.data.regressors import largest_lag
from orthaug.fitting.structures import Orthogonal, Structure
from orthaug.inference.measure_files import MeasurePlace
from orthaug.inference.measures import Measure, Support, Training
from orthaug.physics.excitation import excitation
from orthaug.physics.parameters import PhysicsMap, with_initial
from orthaug.physics.problem import Problem, check_defined, pose, regressor_of
from orthaug.physics.projection import Projection

if TYPE_CHECKING:
    from orthaug.fitting.estimates import Estimate

Progress = Callable[[int, int, float], None]
FOLD_ITERATIONS = 60  # enough to tell whether a learner helps, on every block of cross-validation


@dataclass(frozen=True, eq=False)
class LoadedPart:
    """A part of the data: its record, and how many leading samples of each recording are not scored."""

    name: str
    record: Record
    skip: int
    files: tuple[dict[str, Any], ...]
    gaps: str = ""
    """What was left out around missing samples, in words."""

    def without_short(self, first: int) -> LoadedPart:
        """Without stretches between missing samples that are too short for a row after the first `first`."""
        record = self.record
        if not record.missing:
            return self
        pairs = zip(record.experiments, self.skips, strict=True)
        long = tuple(e for e, skip in pairs if len(e) > max(first, skip))
        if not long:
            most = max(len(e) for e in record.experiments)
            raise InputError(
                f"{record.experiments[0].source}: data.{self.name}: the longest stretch between missing samples has "
                f"{_count(most, 'row')}, too few: the first "
                f"{max(first, self.skip)} are lags or skipped."
            )
        record = replace(record, experiments=long)
        usable = sum(len(experiment) - first for experiment in record.experiments)
        lost = "row has missing cells and is" if record.missing == 1 else "rows have missing cells and are"
        gaps = (
            f"{self.name}: {record.missing} {lost} left out with all windows that touch them; "
            f"{_count(usable, 'usable row')} remain, in {_count(len(record.experiments), 'stretch', 'stretches')}."
        )
        return replace(self, record=record, gaps=gaps)

    @property
    def skips(self) -> tuple[int, ...]:
        """How many leading samples of each experiment are not scored."""
        return tuple(max(0, self.skip - experiment.offset) for experiment in self.record.experiments)

    def scored(self, start: int) -> Record:
        """The record without rows that are neither scored nor lags of what is, for a first usable row `start`."""
        kept = tuple(
            e.rows(max(0, skip - start), None) for e, skip in zip(self.record.experiments, self.skips, strict=True)
        )
        return replace(self.record, experiments=kept)


@dataclass(frozen=True, eq=False)
class Job:
    """A spec with its data read and checked: everything before training, without JAX."""

    path: Path
    spec: Spec
    train: LoadedPart
    validation: LoadedPart | None
    tests: tuple[LoadedPart, ...]
    problem: Problem
    measure: Measure
    physics: PhysicsMap | None
    warnings: tuple[str, ...]

    @property
    def run_count(self) -> int:
        """How many runs a fit makes: restarts times regularizations."""
        choices = self.spec.training.regularizations(self.validation is not None)
        return self.spec.training.restarts * (len(choices) if isinstance(choices, tuple) else 1)

    @property
    def iterations(self) -> int:
        """Steps of a run at most."""
        flown = self.spec.declared_criterion().flown
        return self.spec.declared_solver().iterations + (flown.start_iterations if flown else 0)

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that the job reads."""
        return (self.path, *(self.path.parent / entry["file"] for part in self.parts for entry in part.files))

    @property
    def used(self) -> tuple[Lag, ...]:
        """The raw lags that the model reads."""
        return self.problem.used

    @property
    def parts(self) -> tuple[LoadedPart, ...]:
        return (self.train, *([self.validation] if self.validation else []), *self.tests)


def open_job(path: Path, *, require_full_rank: bool = True) -> Job:
    """Read the spec and all its data, and pose the problem.

    Raises:
        InputError: anything wrong with spec, files or physics; one line that names it.
    """
    spec = load_spec(path)
    try:
        baseline, learner_inputs, physics = spec.declared_baseline(), spec.learner_inputs(), spec.physics_map()
        if physics is not None:
            baseline = with_initial(physics, baseline)
        check_channels(spec.channels(spec.data.inputs), spec.channels(spec.data.outputs))
        structure_of(spec).penalty(baseline.names, baseline.initial, 1.0)
        baseline.check_channels(spec.data.outputs, spec.data.inputs)
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None
    train = _load(path, spec, spec.data.train, "train")
    validation = _load(path, spec, spec.data.validation, "validation") if spec.data.validation else None
    tests = tuple(_load(path, spec, part, f"tests.{name}") for name, part in spec.data.tests.items())
    lags = spec.lag_orders() if spec.declared_learner() is not None else None
    try:
        layout, _ = regressor_of(baseline, lags, learner_inputs, tuple(spec.data.outputs), tuple(spec.data.inputs))
        first = largest_lag(layout)
        train, tests = train.without_short(first), tuple(part.without_short(first) for part in tests)
        validation = validation.without_short(first) if validation else None
        problem = pose(train.record, baseline, lags, learner_inputs, require_full_rank=require_full_rank)
        problem.feature_rows()
        _check_segments(spec, problem)
        measure = measure_of(spec, problem, path.parent)
        _check_measure(measure, problem)
        job = Job(path, spec, train, validation, tests, problem, measure, physics, ())
        check_suspects(spec.suspects, problem)
        for part in job.parts:
            _check_scorable(part, problem.rows.start, train.record.sampling_time)
            check_defined(problem, part.record)
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None
    declared = {"train": spec.data.train, "validation": spec.data.validation}
    declared |= {f"tests.{name}": part for name, part in spec.data.tests.items()}
    warnings = [_thinned(name, part.every) for name, part in declared.items() if part and part.every > 1]
    warnings += [part.gaps for part in job.parts if part.gaps]
    return replace(job, warnings=tuple(warnings))


def _count(number: int, one: str, more: str = "") -> str:
    return f"{number} {one if number == 1 else more or one + 's'}"


def _check_segments(spec: Spec, problem: Problem) -> None:
    """Raise InputError where a free run would score nothing."""
    training = spec.training
    longest = max(len(e) for e in problem.record.experiments) - problem.rows.start
    if training.focus == "simulation" and training.washout >= min(training.segment or longest, longest):
        raise InputError(
            f"'training.washout': found {training.washout}; expected less than the {longest} usable rows of the "
            "longest experiment, or nothing is scored."
        )
    if training.focus == "prediction" and training.horizon > longest:
        raise InputError(
            f"'training.horizon': found {training.horizon}; the longest experiment has {longest} usable rows."
        )


def _thinned(name: str, every: int) -> str:
    return f"{name}: one row in {every} is kept without a filter; content above the new Nyquist frequency folds back."


def structure_of(spec: Spec, kind: str | None = None, measure: Measure | None = None) -> Structure:
    """The structure that a spec declares, or another kind with its keys."""
    return spec.declared_structure(kind, measure)


def measure_of(spec: Spec, problem: Problem, folder: Path) -> Measure:
    """The measure that a spec declares for its problem."""
    lags = [str(lag) for lag in problem.used]
    return spec.declared_measure(MeasurePlace(folder, lags, problem.record, problem.rows.start))


def _check_measure(measure: Measure, problem: Problem) -> None:
    """Raise InputError for a measure that does not fit, or under which the physics is rank-deficient."""
    points = measure.points(Support(problem.record, problem.layout, problem.used))
    if measure == Training() or not problem.excitation.full_rank or not problem.baseline.names:
        return
    with np.errstate(all="ignore"):
        phi = np.asarray(problem.baseline.phi(points.x, problem.layout, problem.outputs, np))
    weighted = phi * (np.sqrt(points.weight)[:, None] * problem.weight)[:, :, None]
    if not np.isfinite(weighted).all():
        raise InputError(f"the physics is not finite on all points of the {measure.name} measure; narrow it.")
    found = excitation(Projection.factor(weighted).r, problem.baseline.names)
    if not found.full_rank:
        groups = "; ".join(", ".join(group) for group in found.collinear)
        raise InputError(f"under the {measure.name} measure the physics cannot tell {groups} apart; widen or move it.")


def _load(path: Path, spec: Spec, part: Part, name: str) -> LoadedPart:
    """Read a part's files; messages begin with the file that is at fault."""
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
        records.append(record)
        digest = hashlib.sha256((path.parent / file).read_bytes()).hexdigest()
        files.append({"file": file, "sha256": digest, "rows": len(record)})
    return LoadedPart(name, Record.join(records), part.skip, tuple(files))


def _check_scorable(part: LoadedPart, start: int, sampling_time: float) -> None:
    if not same_step(part.record.sampling_time, sampling_time):
        raise InputError(
            f"data.{part.name}: sampled every {part.record.sampling_time:g} s, the training data every "
            f"{sampling_time:g} s; one model has one sampling time."
        )
    for experiment, skip in zip(part.record.experiments, part.skips, strict=True):
        first = max(start, skip)
        if len(experiment) <= first:
            raise InputError(
                f"{experiment.source}: data.{part.name} has {len(experiment)} rows, too few; the first {first} are "
                f"lags or skipped, so at least {first + 1} are needed."
            )


def run_fit(
    job: Job,
    progress: Progress | None = None,
    *,
    kind: str | None = None,
    alone: bool = False,
    fold: Record | None = None,
) -> Estimate:
    """Train as the spec says; with another `kind` of structure, or the physics `alone`.

    On a `fold` of cross-validation: that record, one start, few iterations, and nothing to choose from.
    """
    from orthaug.fitting.estimation import estimate

    spec, training = job.spec, job.spec.training
    learner = None if alone else spec.declared_learner()
    solver = spec.declared_solver()
    measure = job.measure if fold is None else None  # a fold is scored by predictions, which no measure changes
    validated = job.validation is not None and fold is None
    choices = training.regularizations(validated)
    return estimate(
        job.train.record if fold is None else fold,
        job.problem.baseline,
        lags=spec.lag_orders() if learner is not None else None,
        learner=learner,
        structure=Orthogonal() if alone else structure_of(spec, kind, measure),
        criterion=spec.declared_criterion(),
        solver=solver if fold is None else solver.at_most(FOLD_ITERATIONS),
        regularization=choices if fold is None or not isinstance(choices, tuple) else choices[0],
        restarts=training.restarts if fold is None else 1,
        seed=training.seed,
        ensemble=training.ensemble and fold is None and learner is not None,
        validation=job.validation.scored(job.problem.rows.start) if validated and job.validation else None,
        progress=progress,
    )
