"""A job: a spec with its data read and checked, and how it is trained, as declared or as a variant of that."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthaug._base.errors import InputError, KeyedError
from orthaug._base.progress import SILENT, Progress
from orthaug._base.warning import Warning
from orthaug.commands.parts import Part, load_parts
from orthaug.commands.spec import Spec, load_spec
from orthaug.commands.suspects import check_suspects
from orthaug.data.expressions import Lag
from orthaug.data.record import Record, check_channels
from orthaug.data.regressors import largest_lag
from orthaug.fitting.cost import check_cost
from orthaug.fitting.rules import check_scored
from orthaug.fitting.structures import Structure
from orthaug.inference.measure_files import MeasurePlace
from orthaug.inference.measures import Measure
from orthaug.inference.weighed import Weighed, weigh_problem
from orthaug.physics.parameters import PhysicsMap, with_initial
from orthaug.physics.problem import Problem, check_defined, pose, regressor_of
from orthaug.reports.result import DataResult

if TYPE_CHECKING:
    from orthaug.fitting.estimates import Estimate

DEFAULT_BLOCKS = 4
ALONE = "physics alone"


@dataclass(frozen=True, eq=False)
class Variant:
    """A variant of a job: another structure or physics alone, perhaps on a fold of the training data.

    A fit on a fold has one start, few iterations, and nothing to choose from.
    """

    kind: str | None = None
    """Of the structure, or `ALONE`; None for the structure that the spec declares."""
    fold: Record | None = None

    @property
    def alone(self) -> bool:
        """Whether there is no learner."""
        return self.kind == ALONE

    @property
    def structure_kind(self) -> str | None:
        """Of the structure; "orthogonal" for physics alone."""
        return "orthogonal" if self.alone else self.kind

    def on(self, fold: Record) -> Variant:
        """The same on a fold."""
        return replace(self, fold=fold)


AS_DECLARED = Variant()


@dataclass(frozen=True, eq=False)
class Job:
    """A spec with its data read and checked: everything before training, without JAX."""

    path: Path
    spec: Spec
    train: Part
    validation: Part | None
    tests: tuple[Part, ...]
    problem: Problem
    weighed: Weighed
    physics: PhysicsMap | None
    warnings: tuple[Warning, ...]

    def __repr__(self) -> str:
        parts = ", ".join(f"{part.name} {len(part.record)} rows" for part in self.parts)
        return f"Job({self.path.name}: {parts}; {self.problem.baseline!r})"

    @property
    def run_count(self) -> int:
        """How many runs a fit makes: restarts times regularizations."""
        return _runs(self.spec, self.problem, self.validation is not None)

    @property
    def iterations(self) -> int:
        """Steps of a run at most."""
        flown = self.spec.declared_criterion().flown
        return self.spec.declared_solver().iterations + (flown.start_iterations if flown else 0)

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that the job reads."""
        return (self.path, *(self.path.parent / entry.file for part in self.parts for entry in part.files))

    @property
    def used(self) -> tuple[Lag, ...]:
        """The raw lags that the model reads."""
        return self.problem.used

    @property
    def measure(self) -> Measure:
        """The measure that the spec declares."""
        return self.weighed.measure

    def posed(self, variant: Variant) -> Problem:
        """The problem that a variant of the job solves: the job's own, unless its data or lags are others."""
        if variant.fold is None:
            return self.problem.physics_alone() if variant.alone else self.problem
        spec, baseline, weights = self.spec, self.problem.baseline, self.spec.training.output_weights
        if variant.alone or spec.declared_learner() is None:
            return pose(variant.fold, baseline, output_weights=weights)
        return pose(variant.fold, baseline, spec.lag_orders(), spec.learner_inputs(), output_weights=weights)

    @property
    def parts(self) -> tuple[Part, ...]:
        """Every part, the training data first."""
        return (self.train, *([self.validation] if self.validation else []), *self.tests)

    @property
    def declaration(self) -> dict[str, Any]:
        """The spec as it was given, without defaults."""
        return self.spec.model_dump(mode="json", exclude_unset=True)

    @property
    def data(self) -> DataResult:
        """The files of each part, as results list them."""
        return DataResult(
            train=list(self.train.files),
            validation=list(self.validation.files) if self.validation else None,
            tests={part.name.removeprefix("tests."): list(part.files) for part in self.tests} or None,
        )


def open_job(path: Path, *, require_full_rank: bool = True) -> Job:
    """Read the spec and all its data, and pose the problem.

    Raises:
        InputError: anything wrong with spec, files or physics; one line that names it.
    """
    spec = load_spec(path)
    parts, step = None, spec.data.step
    if step is None:
        parts = load_parts(path, spec)
        step = parts[0].record.sampling_time
    try:
        baseline, learner_inputs = spec.declared_baseline(), spec.learner_inputs()
        physics = spec.physics_map(step)
        if physics is not None:
            baseline = with_initial(physics, baseline)
        baseline.check_initial()
        check_channels(spec.channels(spec.data.inputs), spec.channels(spec.data.outputs))
        structure_of(spec).penalty(baseline.names, baseline.initial, 1.0)
        baseline.check_channels(spec.data.outputs, spec.data.inputs)
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None
    train, validation, tests = parts or load_parts(path, spec)
    lags = spec.lag_orders() if spec.declared_learner() is not None else None
    try:
        layout, _ = regressor_of(baseline, lags, learner_inputs, tuple(spec.data.outputs), tuple(spec.data.inputs))
        first = largest_lag(layout)
        train, tests = train.without_short(first), tuple(part.without_short(first) for part in tests)
        validation = validation.without_short(first) if validation else None
        options = {"output_weights": spec.training.output_weights, "require_full_rank": require_full_rank}
        problem = pose(train.record, baseline, lags, learner_inputs, **options)
        problem.feature_rows()
        _check_scored(spec, problem)
        _check_cost(spec, problem, validation is not None)
        weighed = weigh_problem(measure_of(spec, problem, path.parent), problem)
        _check_measure(weighed, problem)
        job = Job(path, spec, train, validation, tests, problem, weighed, physics, ())
        check_suspects(spec.suspects, problem)
        for part in job.parts:
            part.check_scorable(problem.rows.start, train.record.sampling_time)
            if part is not train:  # `pose` has looked at that
                check_defined(problem, part.record)
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None
    return replace(job, warnings=tuple(warning for part in job.parts for warning in part.warnings))


def _check_scored(spec: Spec, problem: Problem) -> None:
    """`check_scored` in the words of the spec."""
    longest = max(len(e) for e in problem.record.experiments) - problem.rows.start
    try:
        check_scored(spec.declared_criterion(), longest)
    except KeyedError as error:
        raise InputError(f"'training.{error.key}'{error.words}.") from None


def _check_cost(spec: Spec, problem: Problem, validated: bool) -> None:
    """`check_cost` before JAX is loaded."""
    sizes = {"rows": len(problem.rows), "features": len(problem.features.entries), "outputs": len(problem.outputs)}
    runs = _runs(spec, problem, validated)
    check_cost(spec.declared_learner(), **sizes, iterations=spec.declared_solver().iterations, runs=runs)


def _runs(spec: Spec, problem: Problem, validated: bool) -> int:
    return spec.training.restarts * len(spec.regularizations(linear=problem.baseline.linear, validated=validated))


def structure_of(spec: Spec, kind: str | None = None, measure: Measure | None = None) -> Structure:
    """The structure that a spec declares, or another kind with its keys."""
    return spec.declared_structure(kind, measure)


def measure_of(spec: Spec, problem: Problem, folder: Path) -> Measure:
    """The measure that a spec declares for its problem."""
    lags = [str(lag) for lag in problem.used]
    return spec.declared_measure(MeasurePlace(folder, lags, problem.record, problem.rows.start))


def _check_measure(weighed: Weighed, problem: Problem) -> None:
    """Raise InputError for a measure under which the physics is rank-deficient, where on the data it is not."""
    if problem.excitation.full_rank and not weighed.excitation.full_rank:
        groups = "; ".join(", ".join(group) for group in weighed.excitation.collinear)
        name = weighed.measure.name
        raise InputError(f"under the {name} measure the physics cannot tell {groups} apart; widen or move it.")


def _blocks(spec: Spec) -> int:
    """Blocks of the training data by which free runs are chosen."""
    asked = spec.validation.blocks
    return DEFAULT_BLOCKS if asked is None else asked


def run_fit(job: Job, variant: Variant = AS_DECLARED, progress: Progress = SILENT) -> Estimate:
    """Train as the spec says, or a variant of that."""
    from orthaug.fitting.estimation import fit
    from orthaug.fitting.training import FOLD_ITERATIONS

    fold, spec, training = variant.fold, job.spec, job.spec.training
    learner = None if variant.alone else spec.declared_learner()
    solver, structure = spec.declared_solver(), structure_of(spec, variant.structure_kind, job.measure)
    if variant.alone or fold is not None:  # a fold is scored by predictions, which no measure changes
        structure = structure_of(spec, variant.structure_kind)
    validated = job.validation is not None and fold is None
    choices = training.regularization
    return fit(
        job.posed(variant),
        learner=learner,
        structure=structure,
        criterion=spec.declared_criterion(),
        solver=solver if fold is None else solver.at_most(FOLD_ITERATIONS),
        regularization=choices[0] if fold is not None and isinstance(choices, list) else choices,
        restarts=training.restarts if fold is None else 1,
        seed=training.seed,
        blocks=0 if fold is not None else _blocks(spec),
        fallback=training.fallback,
        ensemble=training.ensemble and fold is None and learner is not None,
        validation=job.validation.scored(job.problem.rows.start) if validated and job.validation else None,
        progress=progress,
    )
