"""A job: a spec with its data read and checked, trained as declared or as a variant."""

from __future__ import annotations

import hashlib
import json
import os
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug import __version__
from orthaug._base.errors import InputError, Warning, show
from orthaug._base.parallel import Threads
from orthaug._base.progress import SILENT, Plan, Progress
from orthaug.commands.parts import Part
from orthaug.commands.spec import Spec, load_spec
from orthaug.data.record import Record
from orthaug.data.regressors import Layout
from orthaug.reports.result import DataResult, PreparedResult

if TYPE_CHECKING:
    from orthaug.fitting.checkpoints import Checkpoints
    from orthaug.fitting.criteria import Criterion
    from orthaug.reports.page_fit import Origin

DEFAULT_BLOCKS = 4
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


AS_DECLARED = Variant()


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Job(ABC):
    """A spec with its data read and checked: everything before training, without JAX."""

    path: Path
    spec: Spec
    train: Part
    validation: Part | None
    tests: tuple[Part, ...]
    problem: Any
    checkpoints: Checkpoints | None = None
    """The folder in which the states of training are kept."""
    arguments: tuple[str, ...] = ()
    """The arguments of the command that made the job; none from Python."""

    def __repr__(self) -> str:
        parts = ", ".join(f"{part.name} {len(part.record)} rows" for part in self.parts)
        return f"Job({self.path.name}: {parts}; {self.physics_in_words})"

    @property
    @abstractmethod
    def physics_in_words(self) -> str:
        """The physics in a few words."""

    @property
    @abstractmethod
    def first_row(self) -> int:
        """The first row of a recording that has a prediction."""

    @property
    @abstractmethod
    def compared(self) -> tuple[str, ...]:
        """Kinds of variants that `orthaug compare` fits, physics alone first."""

    @abstractmethod
    def refusal(self, variant: Variant) -> str | None:
        """Return the reason why a variant cannot be fitted; None where it can."""

    @abstractmethod
    def run(self, variant: Variant = AS_DECLARED, progress: Progress = SILENT) -> Any:
        """Train as the spec says, or a variant of that."""

    def fold_fit(self, variant: Variant) -> Callable[[Record], Any]:
        """Return a function that trains a variant on a fold."""
        return lambda fold: self.run(variant.on(fold))

    @abstractmethod
    def with_spec(self, spec: Spec) -> Job:
        """Return the job of another spec on the same data, to be fitted to folds of them.

        Raises:
            InputError: what the spec declares cannot be fitted to the training data.
        """

    @property
    def runner(self) -> Any:
        """Runner of the independent runs of this job."""
        return Threads()

    @abstractmethod
    def reach(self, model: Any, record: Record) -> tuple[np.ndarray, Layout]:
        """Return the points (M, n) at which a model is evaluated on a record, and their names."""

    @property
    def warnings(self) -> tuple[Warning, ...]:
        """Warnings on what was done to the data, and which training samples are no measurements."""
        return (*(warning for part in self.parts for warning in part.warnings), *self._of_samples)

    @cached_property
    def _of_samples(self) -> tuple[Warning, ...]:
        from orthaug.data.wild import data_warnings

        return tuple(data_warnings(self.train.record, self.without))

    def without(self, samples: Any) -> str:
        """Return a sentence on the result of a fit without these samples of the training data.

        It is "" where such a fit is expensive.
        """
        return ""

    @property
    def run_count(self) -> int:
        """Number of runs in a fit: restarts times regularizations."""
        return self.spec.runs(linear=self.linear)

    @property
    def linear(self) -> bool:
        """True if the physics is linear in θ."""
        return False

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
        )

    @property
    def parts(self) -> tuple[Part, ...]:
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

    def training_options(self, variant: Variant) -> dict[str, Any]:
        """Return the options of training of a variant, for either kind of physics."""
        from orthaug.fitting.training import FOLD_ITERATIONS

        fold, spec, training = variant.fold, self.spec, self.spec.training
        solver, choices, blocks = (
            spec.declared_solver(),
            training.regularization,
            spec.validation.blocks,
        )
        validated = self.validation is not None and fold is None
        return {
            "learner": None if variant.physics_only else spec.declared_learner(),
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


def origin_of(job: Job, command: str) -> Origin:
    """Return the origin of a job's result. SOURCE_DATE_EPOCH, where it is set, is the date."""
    import importlib.metadata
    import platform
    import shlex

    from orthaug.reports.page_fit import Origin

    now = date_of_results()
    versions = {"orthaug": __version__, "Python": platform.python_version()}
    versions |= {name: importlib.metadata.version(name) for name in _TOLD}
    return Origin(
        name=job.path.stem,
        toml=_toml(job),
        command=shlex.join(("orthaug", *(job.arguments or (command, job.path.name)))),
        date=now.strftime("%Y-%m-%d %H:%M UTC"),
        machine=f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        versions=versions,
        seed=job.spec.training.seed,
    )


def _toml(job: Job) -> str:
    """Return the spec as it was written.

    Where its file has changed since, it is the content that was read.
    """
    import tomlkit

    try:
        text = job.path.read_text(encoding="utf-8-sig")
        if load_spec(job.path).model_dump(mode="json", exclude_unset=True) == job.declaration:
            return text
    except (InputError, OSError, UnicodeDecodeError):
        pass
    return tomlkit.dumps(_without_none(job.declaration))


def _without_none(content: Any) -> Any:
    """Return the content without keys that are None: TOML has no null."""
    if isinstance(content, dict):
        return {key: _without_none(value) for key, value in content.items() if value is not None}
    return [_without_none(value) for value in content] if isinstance(content, list) else content
