"""A job: a spec with its data read and checked, and how it is trained, as declared or as a variant of that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.errors import InputError
from orthaug._base.progress import SILENT, Progress
from orthaug._base.warning import Warning
from orthaug.analysis.suspicion import check_suspects
from orthaug.commands.parts import Part, load_parts
from orthaug.commands.spec import MeasureSection, Spec, load_spec
from orthaug.data.expressions import Lag
from orthaug.data.readers import read_samples
from orthaug.data.record import Record, check_channels
from orthaug.data.regressors import largest_lag
from orthaug.fitting.structures import Additive, BaselinePenalty, Orthogonal, OrthogonalPenalty, Structure
from orthaug.inference.measures import Measure, Samples, Support, Symmetrized, Training, Uniform
from orthaug.physics.excitation import excitation
from orthaug.physics.parameters import PhysicsMap, with_initial
from orthaug.physics.problem import Problem, check_defined, pose, regressor_of, used_lags
from orthaug.physics.projection import Projection
from orthaug.reports.result import DataResult

if TYPE_CHECKING:
    from orthaug.fitting.estimates import Estimate

FOLD_ITERATIONS = 60  # enough to tell whether a learner helps, on every block of cross-validation
ALONE = "physics alone"


@dataclass(frozen=True, eq=False)
class Variant:
    """A variant of a job: another structure or physics alone, and a fold of the training data instead of all.

    On a fold of cross-validation there is one start, few iterations, and nothing to choose from.
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
        """Of the structure; physics alone is orthogonal to nothing."""
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
    measure: Measure
    physics: PhysicsMap | None
    warnings: tuple[Warning, ...]

    @property
    def run_count(self) -> int:
        """How many runs a fit makes: restarts times regularizations."""
        choices = self.spec.training.regularizations(self.validation is not None)
        return self.spec.training.restarts * (len(choices) if isinstance(choices, tuple) else 1)

    @property
    def iterations(self) -> int:
        """Steps of a run at most."""
        training = self.spec.training
        if training.solver == "adam-lbfgs":
            return training.adam_iterations + training.lbfgs_iterations
        free_run = training.focus == "simulation" or training.horizon > 1
        return training.iterations + (training.start_iterations if free_run else 0)

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that the job reads."""
        return (self.path, *(self.path.parent / entry.file for part in self.parts for entry in part.files))

    @property
    def used(self) -> tuple[Lag, ...]:
        """The raw lags that the model reads."""
        return used_lags(self.problem)

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
    try:
        baseline, learner_inputs, physics = spec.declared_baseline(), spec.learner_inputs(), spec.physics_map()
        if physics is not None:
            baseline = with_initial(physics, baseline)
        check_channels(spec.channels(spec.data.inputs), spec.channels(spec.data.outputs))
        structure_of(spec).penalty(baseline.names, baseline.initial, 1.0)
        baseline.check_channels(spec.data.outputs, spec.data.inputs)
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None
    train, validation, tests = load_parts(path, spec)
    lags = spec.lag_orders() if spec.learner.kind != "none" else None
    try:
        layout, _ = regressor_of(baseline, lags, learner_inputs, tuple(spec.data.outputs), tuple(spec.data.inputs))
        first = largest_lag(layout)
        train, tests = train.without_short(first), tuple(part.without_short(first) for part in tests)
        validation = validation.without_short(first) if validation else None
        problem = pose(train.record, baseline, lags, learner_inputs, require_full_rank=require_full_rank)
        problem.feature_rows()
        _check_segments(spec, problem)
        section = spec.structure.measure
        measure = measure_of(section.kind, [str(lag) for lag in used_lags(problem)], section, path.parent)
        _check_measure(measure, problem)
        job = Job(path, spec, train, validation, tests, problem, measure, physics, ())
        check_suspects(spec.suspects, problem)
        for part in job.parts:
            part.check_scorable(problem.rows.start, train.record.sampling_time)
            check_defined(problem, part.record)
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None
    return replace(job, warnings=tuple(warning for part in job.parts for warning in part.warnings))


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


def structure_of(spec: Spec, kind: str | None = None, measure: Measure | None = None) -> Structure:
    """The structure that a spec declares, or another kind with its weight."""
    weight = spec.structure.weight
    known = {
        "additive": Additive(),
        "orthogonal": Orthogonal(measure or Training()),
        "orthogonal-penalty": OrthogonalPenalty(weight),
        "baseline-penalty": BaselinePenalty(weight),
    }
    return known[kind or spec.structure.kind]


def measure_of(kind: str, lags: Sequence[str], section: MeasureSection, folder: Path) -> Measure:
    """The measure that a section declares; `lags` are the raw lags that the model reads."""
    rows = section.rows
    if kind == "samples":
        files = [folder / file for file in section.files]
        return Samples(*read_samples(files, lags, rows=rows, every=section.every))
    if kind == "uniform":
        return Uniform({lag: tuple(limits) for lag, limits in section.box.items()})
    return Symmetrized() if kind == "symmetrized" else Training()


def _check_measure(measure: Measure, problem: Problem) -> None:
    """Raise InputError for a measure that does not fit, or under which the physics is rank-deficient."""
    points = measure.points(Support(problem.record, problem.layout, used_lags(problem)))
    if isinstance(measure, Training) or not problem.excitation.full_rank or not problem.baseline.names:
        return
    with np.errstate(all="ignore"):
        phi = np.asarray(problem.baseline.phi(points.x, problem.layout, problem.outputs, np))
    weighted = phi * (np.sqrt(points.weight)[:, None] * problem.weight)[:, :, None]
    if not np.isfinite(weighted).all():
        raise InputError(f"the physics is not finite on all points of the {measure.name} measure; narrow it.")
    weighted_excitation = excitation(Projection.factor(weighted).r, problem.baseline.names)
    if not weighted_excitation.full_rank:
        groups = "; ".join(", ".join(group) for group in weighted_excitation.collinear)
        raise InputError(f"under the {measure.name} measure the physics cannot tell {groups} apart; widen or move it.")


def run_fit(job: Job, variant: Variant = AS_DECLARED, progress: Progress = SILENT) -> Estimate:
    """Train as the spec says, or a variant of that."""
    from orthaug.fitting.criteria import Prediction, Simulation
    from orthaug.fitting.estimation import estimate
    from orthaug.fitting.solvers.adam_lbfgs import AdamLBFGS
    from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
    from orthaug.models.learners import MLP

    kind, alone, fold = variant.kind, variant.alone, variant.fold
    spec, training = job.spec, job.spec.training
    learner = None
    if spec.learner.kind == "mlp" and not alone:
        learner = MLP(tuple(spec.learner.hidden), spec.learner.activation, spec.learner_inputs())
    criterion = Prediction(training.horizon)
    if training.focus == "simulation":
        criterion = Simulation(training.segment, training.washout, training.start_iterations)
    if training.solver == "adam-lbfgs":
        solver = AdamLBFGS(training.adam_iterations, training.lbfgs_iterations, training.learning_rate)
    else:
        solver = LevenbergMarquardt(training.iterations if fold is None else min(training.iterations, FOLD_ITERATIONS))
    validated = job.validation is not None and fold is None
    choices = training.regularizations(validated)
    return estimate(
        job.train.record if fold is None else fold,
        job.problem.baseline,
        lags=spec.lag_orders() if learner is not None else None,
        learner=learner,
        structure=Orthogonal() if alone else structure_of(spec, kind, job.measure),
        criterion=criterion,
        solver=solver,
        regularization=choices if fold is None or not isinstance(choices, tuple) else choices[0],
        restarts=training.restarts if fold is None else 1,
        seed=training.seed,
        ensemble=training.ensemble and fold is None and learner is not None,
        validation=job.validation.scored(job.problem.rows.start) if validated and job.validation else None,
        progress=progress,
    )
