"""Jobs whose physics are equations of motion: opened, and trained."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.errors import InputError, KeyedError
from orthaug._base.progress import SILENT, Progress
from orthaug.analysis.suspects import MotionSuspect
from orthaug.commands.data_sections import engine_of
from orthaug.commands.job import AS_DECLARED, PHYSICS_ONLY, Job, Variant
from orthaug.commands.parts import Part, load_parts
from orthaug.commands.spec import Spec
from orthaug.commands.suspects import declared_terms
from orthaug.data.record import Record, check_channels
from orthaug.data.regressors import Layout
from orthaug.fitting.rules import (
    check_cost,
    check_motion_choices,
    check_scored,
    check_solver,
    choose_regularizations,
)
from orthaug.fitting.structures import Structure
from orthaug.inference.kinds import MeasurePlace
from orthaug.inference.measures import Measure, Support
from orthaug.physics.motion import Motion
from orthaug.physics.motion_problem import MotionProblem, layout_of, pose_motion

if TYPE_CHECKING:
    from orthaug.fitting.motion_estimates import MotionEstimate
    from orthaug.models.motion_model import MotionModel
    from orthaug.models.rows import Engine

_SECTIONS = {"learner": "learner", "kind": "structure.kind"}  # of keys that are not in [training]
WITH_LEARNER = "orthogonal"


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class MotionJob(Job):
    """A job with a motion."""

    problem: MotionProblem
    measure: Measure
    engine: Engine
    """The engine that sums over the segments."""
    suspects: tuple[MotionSuspect, ...] = ()

    @property
    def physics_in_words(self) -> str:
        return f"motion of {', '.join(self.problem.motion.names_of_states)}"

    @property
    def first_row(self) -> int:
        return self.problem.first_row

    @property
    def compared(self) -> tuple[str, ...]:
        return (
            (PHYSICS_ONLY,)
            if self.spec.declared_learner() is None
            else (PHYSICS_ONLY, WITH_LEARNER)
        )

    def refusal(self, variant: Variant) -> str | None:
        return None

    def reach(self, model: MotionModel, record: Record) -> tuple[np.ndarray, Layout]:
        return model.reach(record), layout_of(self.problem.motion)

    @property
    def structure(self) -> Structure:
        """The structure that the spec declares, under its measure."""
        return self.spec.declared_structure(None, self.measure)

    def with_spec(self, spec: Spec) -> MotionJob:
        assert spec.motion is not None
        motion = spec.motion.motion_of(spec.data.inputs, spec.data.outputs)
        inputs = spec.learner_inputs() if spec.declared_learner() is not None else None
        problem = pose_motion(self.train.record, motion, inputs, spec.training.output_weights)
        return replace(self, spec=spec, problem=problem, checkpoints=None)

    def run(self, variant: Variant = AS_DECLARED, progress: Progress = SILENT) -> MotionEstimate:
        from orthaug.fitting.motion_estimation import fit_motion

        problem = self.problem if variant.fold is None else self.problem.on(variant.fold)
        structure = self.structure if variant.fold is None else self.spec.declared_structure()
        options = self.training_options(variant)
        if variant.fold is None:  # a fold is small
            options |= {"engine": self.engine, "checkpoints": self.checkpoints}
        return fit_motion(problem, structure=structure, progress=progress, **options)


def open_motion(path: Path, spec: Spec) -> MotionJob:
    """Read all data of a spec with a motion, and pose the problem.

    Raises:
        InputError: anything wrong with spec, files or equations; one line that names it.
    """
    assert spec.motion is not None
    try:
        check_channels(spec.channels(spec.data.inputs), spec.channels(spec.data.outputs))
        motion = spec.motion.motion_of(spec.data.inputs, spec.data.outputs)
        motion.check_channels(spec.data.inputs, spec.data.outputs)
    except InputError as error:
        raise InputError(f"{path}: motion: {str(error).removeprefix('motion.')}") from None
    try:
        _check_choices(spec, motion)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    least = len(motion.states) + 1  # rows that determine the initial state of a run
    train, validation, *tests = (
        p and p.without_short(0, least) for p in _parts(load_parts(path, spec))
    )
    assert train is not None
    try:
        inputs = spec.learner_inputs() if spec.declared_learner() is not None else None
        problem = pose_motion(train.record, motion, inputs, spec.training.output_weights)
        named = {
            "path": path,
            "spec": spec,
            "train": train,
            "validation": validation,
            "tests": tuple(tests),
        }
        own = {
            "measure": _measure_of(spec, problem, path.parent),
            "suspects": declared_terms(spec.suspects, problem),
        }
        kind = spec.engine_kind([path.parent / entry.file for entry in train.files])
        job = MotionJob(**named, problem=problem, engine=engine_of(spec.engine, kind), **own)
        for part in job.parts:
            part.check_scorable(problem.first_row, train.record.sampling_time, least)
        _check_sizes(spec, problem)
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None
    return job


def _parts(loaded: tuple[Part, Part | None, tuple[Part, ...]]) -> list[Part | None]:
    train, validation, tests = loaded
    return [train, validation, *tests]


def _check_choices(spec: Spec, motion: Motion) -> None:
    """Check that motion, learner, structure, criterion and solver go together."""
    try:
        learner, structure = spec.declared_learner(), spec.declared_structure()
        solver, criterion = spec.declared_solver(), spec.declared_criterion()
        check_motion_choices(motion, learner, structure, criterion, solver)
        given, validated = spec.training.regularization, spec.data.validation is not None
        conditions = {"linear": False, "validated": validated, "learner": learner}
        choices = choose_regularizations(given, solver, criterion, structure, **conditions)
        check_solver(solver, criterion, choices)
    except KeyedError as error:
        raise InputError(f"'{_place(error)}'{error.words}.") from None


def _place(error: KeyedError) -> str:
    """Return the key of the spec that an error is about."""
    return _SECTIONS.get(error.key, f"training.{error.key}")


def _check_sizes(spec: Spec, problem: MotionProblem) -> None:
    """Raise InputError where no row would be scored, or training would not end."""
    criterion = spec.declared_criterion()
    try:
        check_scored(criterion, max(len(e) for e in problem.record.experiments))
    except KeyedError as error:
        raise InputError(f"'{_place(error)}'{error.words}.") from None
    states, outputs = problem.motion.learned
    sizes: dict[str, Any] = {
        "rows": len(problem.record),
        "features": len(problem.features),
        "outputs": max(len(states) + len(outputs), 1),
    }
    runs = spec.runs(linear=False)
    check_cost(
        spec.declared_learner(), **sizes, iterations=spec.declared_solver().iterations, runs=runs
    )


def _measure_of(spec: Spec, problem: MotionProblem, folder: Path) -> Measure:
    """Return the measure that a spec declares, tried on the guessed states.

    So wrong names and limits are found before training.
    """
    names = [str(lag) for lag in layout_of(problem.motion)]
    measure = spec.declared_measure(MeasurePlace(folder, names, problem.record, problem.first_row))
    rows = len(problem.record)  # a measure may weigh each of them
    x, u = (np.resize(part.T, (rows, len(part))) for part in problem.guessed_points)
    measure.points(Support.of_motion(problem.motion, x, u))
    return measure
