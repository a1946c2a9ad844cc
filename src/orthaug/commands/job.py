"""A job: a spec with its data read and checked, trained as declared or as a variant."""

from __future__ import annotations

import hashlib
import json
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Self, TypeVar

from orthaug import __version__
from orthaug._base.errors import InputError, Warning, show
from orthaug._base.parallel import Threads
from orthaug._base.progress import SILENT, Plan, Progress
from orthaug.analysis.evidence import DEFAULT_BLOCKS, Evidence, sample_warnings
from orthaug.commands.parts import FilePart
from orthaug.commands.spec import Spec, load_spec
from orthaug.data.preparation import of_free_run
from orthaug.data.record import Record
from orthaug.reports.result import DataResult, PreparedResult

if TYPE_CHECKING:
    from orthaug.analysis.design import Design
    from orthaug.analysis.findings import LateInputResult, MemoryResult, SuspectResult
    from orthaug.fitting.checkpoints import Checkpoints
    from orthaug.fitting.criteria import Criterion
    from orthaug.fitting.estimates import Estimate
    from orthaug.fitting.structures import Structure
    from orthaug.inference.measures import Measure
    from orthaug.models.response import Response
    from orthaug.models.rows import Engine
    from orthaug.physics.parameters import PhysicsMap
    from orthaug.reports.drawing import Figure
    from orthaug.reports.page_fit import Origin
    from orthaug.reports.result import CheckResult
    from orthaug.studies.planted import System

PHYSICS_ONLY = "physics alone"
_TOLD = ("jax", "numpy", "scipy")  # packages whose versions move numbers


@dataclass(frozen=True, eq=False)
class Variant:
    """A variant of a job: another structure or physics alone, perhaps on a fold of the data.

    A fit on a fold has one start, few iterations, and nothing to choose from.
    """

    kind: str | None = None
    """The kind of structure, or `PHYSICS_ONLY`; None for the structure that the spec declares."""
    fold: Record | None = None
    criterion: Criterion | None = None
    """None for the criterion that the spec declares."""

    @property
    def physics_only(self) -> bool:
        """True if the variant has no learner."""
        return self.kind == PHYSICS_ONLY

    @property
    def structure_kind(self) -> str | None:
        """Kind of the structure; "orthogonal" for physics alone."""
        return "orthogonal" if self.physics_only else self.kind

    def on(self, fold: Record) -> Variant:
        """Return the variant on a fold."""
        return replace(self, fold=fold)


_LAGS_AS_MOTION = (
    "the learner has states of its own, so the lagged physics is fitted on its free run, as the "
    "discrete motion of its lags: y_1 is y[k-1]. `spec` in result.json has that motion; advised "
    "changes are changes of it."
)
MISSING_STATE = "the missing state"  # what a change that adds one begins with
AS_DECLARED = Variant()


P = TypeVar("P")
"""The problem of a kind of physics."""
F = TypeVar("F")
"""The fit of a kind of physics."""


class JobPhysics(ABC, Generic[P, F]):
    """The parts of a job that depend on its physics."""

    section: ClassVar[str]
    """The section of a spec that declares it."""
    runs_in_check: ClassVar[bool]
    """True if `check` computes free runs, for which JAX is needed."""
    most_trials: ClassVar[int]
    """Changes that advice tries: together they take about as long as the fit."""
    suspects: tuple[Any, ...] = ()
    """The terms that the physics may lack, as the spec declares them."""
    map: PhysicsMap | None = None
    """The map from physical parameters to θ, where the parameters are not physical themselves."""

    def slow_note(self, job: Job) -> str:
        """Return a note where `check` takes long, with the reason; "" otherwise."""
        return ""

    @classmethod
    @abstractmethod
    def declare(cls, spec: Spec, step: float | None) -> Self:
        """Return the physics of a spec, checked; `step` is the sampling time, where it is known.

        Raises:
            InputError: what the spec declares cannot be, or does not go together.
        """

    @abstractmethod
    def rows_needed(self, spec: Spec) -> tuple[int, int]:
        """Return the rows before the first one with a prediction, and the fewest of a stretch."""

    def runs_through_gaps(self, spec: Spec) -> bool:
        """Return whether a fit of the spec can run through missing outputs."""
        return False

    @abstractmethod
    def pose(self, spec: Spec, record: Record) -> P:
        """Return the problem on a record in memory."""

    def pose_part(
        self, spec: Spec, train: FilePart, kind: str, engine: Engine, *, require_full_rank: bool
    ) -> tuple[P, tuple[Warning, ...]]:
        """Return the problem on the training data, and warnings on terms that are left out.

        Rows that an engine of this kind does not hold in memory remain in their source.
        """
        return self.pose(spec, train.record), ()

    @abstractmethod
    def under(self, measure: Measure, spec: Spec, problem: P) -> Self:
        """Return the physics under a measure, with the suspects of the spec, both checked."""

    def check_record(self, problem: P, record: Record) -> None:
        """Raise InputError where the problem has no value on another record."""
        return None

    @abstractmethod
    def train(self, problem: P, **options: object) -> F:
        """Train a problem."""

    @property
    def structures(self) -> tuple[str, ...]:
        """Kinds of structure that can be trained."""
        return ("orthogonal",)

    @abstractmethod
    def fold_training(
        self, job: Job, variant: Variant
    ) -> tuple[Callable[[Record], P], Callable[..., F]]:
        """Return functions that pose a variant on a fold, and train it."""

    def runner(self, engine: Engine) -> Threads:
        """Return the runner of independent runs."""
        return Threads()

    @abstractmethod
    def check(self, job: Job) -> tuple[dict[str, Any], list[Warning]]:
        """Return the findings before training, and warnings on them."""

    @abstractmethod
    def refusal(self, job: Job, result: CheckResult) -> InputError | None:
        """Return the error of parameters that the data do not determine; None where they do."""

    @abstractmethod
    def figures(
        self, job: Job, fit: F, responses: Mapping[str, tuple[Response, Response]]
    ) -> dict[str, Figure]:
        """Return the figures that only this physics has."""

    @abstractmethod
    def run_alone(self, fit: F, record: Record, free_run: Response) -> Response:
        """Return the free run by the model's physics without its learner."""

    @abstractmethod
    def design(self, job: Job, asked: Mapping[str, object], noise: float | None) -> Design:
        """Return the input that a spec asks for."""

    @abstractmethod
    def system(self, fit: F) -> System:
        """Return the physics with the parameters of a fit, to simulate with them as the truth."""

    @property
    @abstractmethod
    def declared_units(self) -> dict[str, str]:
        """Units of the parameters and fixed terms, as declared, by their names."""

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that the physics are read from."""
        return ()

    @abstractmethod
    def names_taken(self, spec: Spec) -> set[str]:
        """Return the names that a new parameter cannot have."""

    @abstractmethod
    def with_term(
        self, job: Job, name: str, expression: str, place: str | None, initial: float
    ) -> tuple[dict[str, Any], str] | None:
        """Return the change of a spec that adds a term, and where that is, in words.

        None where the spec has the term already, or cannot have it.

        Args:
            name: of the new parameter, the term's coefficient.
            place: the output or equation that lacks the term; None where there is one only.
        """

    def with_lag(
        self, job: Job, late: LateInputResult, name: str
    ) -> tuple[dict[str, Any], str] | None:
        """Return the change of a spec by which an input acts through a lag, and what that is.

        None where the physics cannot have it.

        Args:
            name: of a new parameter, the time constant.
        """

    def with_state(
        self, job: Job, missing: MemoryResult, names: tuple[str, str, str]
    ) -> tuple[dict[str, Any], str] | None:
        """Return the change of a spec that adds a state which is missing, and what that is.

        None where the physics cannot have it.

        Args:
            missing: the term with memory that predicts the free run's error.
            names: of the state, of its time constant or width, and of its coefficient.
        """

    def other_holds(self, spec: Spec) -> tuple[str, ...]:
        """Return the holds of the inputs between samples that could be tried instead."""
        return ()

    def with_initials(self, job: Job, fit: F) -> dict[str, Any]:
        """Return the change of a spec by which its parameters begin at those of another fit.

        Empty where initial values do not decide what is found.
        """
        return {}

    def settled(self, fit: F) -> dict[str, object]:
        """Return the values of a spec that a fit has chosen, as a change of the spec."""
        return {}

    def with_delays(self, job: Job) -> Iterator[tuple[dict[str, Any], str]]:
        """Yield changes of a spec by which an input acts later, with words."""
        yield from ()

    def explained_residual(self, fit: F) -> Callable[[SuspectResult], tuple[float, float]] | None:
        """Return a function that gives the share of the residual that a suspect explains.

        With its coefficient. None where the table of suspects says so.
        """
        return None


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Job:
    """A spec with its data read and checked: everything before training, without JAX."""

    path: Path
    spec: Spec
    train: FilePart
    validation: FilePart | None
    tests: tuple[FilePart, ...]
    physics: JobPhysics[Any, Any]
    problem: Any
    measure: Measure
    """The measure that the spec declares."""
    engine: Engine
    """The engine that sums over the rows."""
    left_out: tuple[Warning, ...] = ()
    """Warnings on terms of the learner that are left out, as they add nothing of their own."""
    checkpoints: Checkpoints | None = None
    """The folder in which the states of training are kept."""
    arguments: tuple[str, ...] = ()
    """The arguments of the command that made the job; none from Python."""

    def __repr__(self) -> str:
        parts = ", ".join(f"{part.name} {len(part.record)} rows" for part in self.parts)
        return f"Job({self.path.name}: {parts}; {self.problem.physics_in_words})"

    @property
    def first_row(self) -> int:
        """The first row of a recording that has a prediction."""
        return self.problem.first_row

    @property
    def compared(self) -> tuple[str, ...]:
        """Kinds of variants that `orthaug compare` fits, physics alone first."""
        learns = self.spec.declared_learner() is not None
        return (PHYSICS_ONLY, *(self.physics.structures if learns else ()))

    @property
    def structure(self) -> Structure:
        """The structure that the spec declares, under its measure."""
        return self.spec.declared_structure(None, self.measure)

    def refusal(self, variant: Variant) -> str | None:
        """Return the reason why a variant cannot be fitted; None where it can."""
        structure = self.spec.declared_structure(variant.structure_kind)
        try:
            structure.penalty(self.problem.names, self.problem.physics.initial, 1.0)
        except InputError as error:
            return str(error)
        return None

    def run(self, variant: Variant = AS_DECLARED, progress: Progress = SILENT) -> Estimate:
        """Train as the spec says, or a variant of that."""
        if variant.fold is not None:
            return self.fold_fit(variant)(variant.fold)
        measure = None if variant.physics_only else self.measure
        return self.physics.train(
            self.problem.physics_alone() if variant.physics_only else self.problem,
            structure=self.spec.declared_structure(variant.structure_kind, measure),
            progress=progress,
            engine=self.engine,
            checkpoints=self.checkpoints,
            **self.training_options(variant),
        )

    def fold_fit(self, variant: Variant, *, briefly: bool = False) -> Callable[[Record], Any]:
        """Return a function that trains a variant on a fold.

        It is scored by predictions, on which the measure has no effect, or `briefly` by free runs
        only.
        """
        from orthaug.fitting.setup import fit_fold

        options = self.training_options(variant.on(self.train.record))
        options["structure"] = self.spec.declared_structure(variant.structure_kind)
        options["briefly"] = briefly
        pose, train = self.physics.fold_training(self, variant)
        return partial(fit_fold, pose=pose, train=train, options=options)

    @property
    def runner(self) -> Threads | Engine:
        """Runner of the independent runs of this job."""
        return self.physics.runner(self.engine)

    @property
    def warnings(self) -> tuple[Warning, ...]:
        """Warnings on the data, on training samples that are no measurements, on terms left out."""
        of_parts = [warning for part in self.parts for warning in part.warnings]
        if not self.spec.declared_criterion().one_step:
            record = self.train.record
            names = [channel.name for channel in record.channels]
            of_parts = of_free_run(of_parts, record.prepared, names)
        moved = (Warning("lags_as_motion", _LAGS_AS_MOTION),) if self.spec.moved_lags else ()
        return (*of_parts, *self._of_samples, *self.left_out, *moved)

    @cached_property
    def _of_samples(self) -> tuple[Warning, ...]:
        return tuple(sample_warnings(self.problem))

    @property
    def evidence(self) -> Evidence:
        """Evidence that a fit of this job is judged by."""
        spec = self.spec
        return Evidence(
            parts=self.parts,
            problem=self.problem,
            learner=spec.declared_learner(),
            structure=spec.declared_structure(),
            criterion=spec.declared_criterion(),
            measure=self.measure,
            noise=spec.noise.declared,
            suspects=self.physics.suspects,
            map=self.physics.map,
            profiles=spec.physics is not None and spec.physics.profile,
            blocks=spec.validation.blocks,
            runner=self.runner,
            warnings=self.warnings,
        )

    @property
    def run_count(self) -> int:
        """Number of runs in a fit: restarts times regularizations."""
        return self.spec.runs(linear=self.linear)

    @property
    def linear(self) -> bool:
        """True if the physics is linear in θ."""
        return self.problem.linear

    def plan_of(self, variant: Variant) -> Plan:
        """Return the known settings of each run of a variant.

        Empty where fits to new weights of the outputs follow.
        """
        spec = self.spec
        if spec.training.output_weights == "covariance":
            return ()
        if variant.physics_only or spec.declared_learner() is None:
            return ({"structure": PHYSICS_ONLY},)
        kind, validated = variant.kind or spec.structure.kind, spec.data.validation is not None
        choices = spec.regularizations(linear=self.linear, validated=validated, kind=kind)
        starts = range(1, spec.training.restarts + 1)
        return tuple(
            {"structure": kind, "start": i, "regularization": choice}
            for choice in choices
            for i in starts
        )

    @property
    def iterations(self) -> int:
        """Maximum number of steps in a run."""
        free_run = self.spec.declared_criterion().free_run
        return self.spec.declared_solver().iterations + (
            free_run.start_iterations if free_run else 0
        )

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that the job reads."""
        return (
            self.path,
            *(self.path.parent / entry.file for part in self.parts for entry in part.files),
            *self.physics.files,
        )

    @property
    def parts(self) -> tuple[FilePart, ...]:
        """Every part, the training data first."""
        return (self.train, *([self.validation] if self.validation else []), *self.tests)

    @property
    def declaration(self) -> dict[str, Any]:
        """The spec as it was given, without defaults."""
        return self.spec.model_dump(mode="json", exclude_unset=True)

    @property
    def fingerprint(self) -> str:
        """Fingerprint of everything that training depends on: the spec, its files, the program."""
        content = {"spec": self.declaration, "data": self.data.model_dump(), "orthaug": __version__}
        if self.physics.files:
            read = [hashlib.sha256(file.read_bytes()).hexdigest() for file in self.physics.files]
            content["physics"] = read
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    @property
    def data(self) -> DataResult:
        """The files of each part, as results list them."""
        return DataResult(
            train=list(self.train.files),
            validation=list(self.validation.files) if self.validation else None,
            tests={part.name.removeprefix("tests."): list(part.files) for part in self.tests}
            or None,
            prepare=[PreparedResult.model_validate(done) for done in self.train.record.prepared]
            or None,
        )

    def training_options(self, variant: Variant) -> dict[str, object]:
        """Return the options of training of a variant."""
        from orthaug.fitting.setup import FOLD_ITERATIONS

        fold, spec, training = variant.fold, self.spec, self.spec.training
        solver, choices, blocks = (
            spec.declared_solver(),
            training.regularization,
            spec.validation.blocks,
        )
        validated = self.validation is not None and fold is None
        learner = None if variant.physics_only else spec.declared_learner()
        options = {
            "learner": learner,
            "criterion": variant.criterion or spec.declared_criterion(),
            "solver": solver if fold is None else solver.at_most(FOLD_ITERATIONS),
            "regularization": choices[0]
            if fold is not None and isinstance(choices, list)
            else choices,
            "restarts": training.restarts if fold is None else 1,
            "seed": training.seed,
            "blocks": 0 if fold is not None else DEFAULT_BLOCKS if blocks is None else blocks,
            "fallback": training.fallback,
            "validation": self.validation.scored(self.first_row)
            if validated and self.validation
            else None,
        }
        if spec.noise.model != "white":
            options["noise"] = spec.noise.declared
        if training.ensemble and learner is not None and fold is None:
            options["ensemble"] = True
        return options


_YEAR_10000 = 253_402_300_800  # s since 1970


def date_of_results() -> datetime:
    """Return the date of a result: SOURCE_DATE_EPOCH where it is set, now otherwise.

    Raises:
        InputError: seconds that are no date.
    """
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    if not epoch:
        return datetime.now(UTC)
    if not (
        epoch.isascii() and epoch.isdecimal() and len(epoch) <= 12 and int(epoch) < _YEAR_10000
    ):
        raise InputError(
            f"SOURCE_DATE_EPOCH: found {show(epoch)}; expected whole seconds since 1970 up to "
            "the year 9999. Unset it for the date of today."
        )
    return datetime.fromtimestamp(int(epoch), UTC)


def surroundings() -> tuple[str, str, dict[str, str]]:
    """Return the date of results, the machine in words, and versions by name."""
    import importlib.metadata
    import platform

    versions = {"orthaug": __version__, "Python": platform.python_version()}
    versions |= {name: importlib.metadata.version(name) for name in _TOLD}
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"
    return date_of_results().strftime("%Y-%m-%d %H:%M UTC"), machine, versions


def origin_of(job: Job, command: str) -> Origin:
    """Return the origin of a job's result. SOURCE_DATE_EPOCH, where it is set, is the date."""
    import shlex

    from orthaug.reports.page_fit import Origin

    date, machine, versions = surroundings()
    return Origin(
        name=job.path.stem,
        toml=_toml(job),
        command=shlex.join(("orthaug", *(job.arguments or (command, job.path.name)))),
        date=date,
        machine=machine,
        versions=versions,
        seed=job.spec.training.seed,
    )


def _toml(job: Job) -> str:
    """Return the spec as it was written.

    Where its file has changed since, it is the content that was read.
    """
    try:
        text = job.path.read_text(encoding="utf-8-sig")
        if load_spec(job.path).model_dump(mode="json", exclude_unset=True) == job.declaration:
            return text
    except (InputError, OSError, UnicodeDecodeError):
        pass
    return toml_of(job.declaration)


def selected_form(expression: str) -> dict[str, bool]:
    """Return the key of a term that data have proposed; a constant has no other form."""
    return {} if expression == "1" else {"selected": True}


def declared_output(job: Job, name: str) -> dict[str, Any]:
    """Return the section of a motion's output: its expression, and whether it is learned."""
    own = job.declaration["motion"]["outputs"][name]
    return {"expression": own} if isinstance(own, str) else dict(own)


def toml_of(declaration: Mapping[str, object]) -> str:
    """Return the text of a spec that was read."""
    import tomlkit

    return tomlkit.dumps(_without_none(declaration))


def _without_none(content: object) -> Any:
    """Return the content without keys that are None: TOML has no null."""
    if isinstance(content, dict):
        return {key: _without_none(value) for key, value in content.items() if value is not None}
    return [_without_none(value) for value in content] if isinstance(content, list) else content
