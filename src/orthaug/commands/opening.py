"""Open a job: read a spec and its data, pose the problem, check all of it before training."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from orthaug._base.errors import InputError, KeyedError
from orthaug.commands.data_sections import engine_of
from orthaug.commands.job import Job, JobPhysics
from orthaug.commands.lagged import LaggedPhysics
from orthaug.commands.motion import MotionPhysics
from orthaug.commands.parts import FilePart, load_parts
from orthaug.commands.spec import Spec, load_spec, spec_error
from orthaug.data.channels import check_channels
from orthaug.fitting.rules import check_scored, check_sizes
from orthaug.inference.kinds import MeasurePlace
from orthaug.physics.baseline import Baseline
from orthaug.physics.motion import Motion

PHYSICS: Mapping[type, Any] = {Baseline: LaggedPhysics, Motion: MotionPhysics}
"""What a job asks its physics, by the kind of these."""


def job_physics(physics: Baseline | Motion) -> Any:
    """Return the part of a job that depends on its physics, without what a spec adds."""
    return PHYSICS[type(physics)](physics)


def declare_physics(spec: Spec, step: float | None) -> Any:
    """Return the part of a job that depends on its physics, as a spec declares these.

    Raises:
        InputError: what the spec declares cannot be, or does not go together.
    """
    kind = next(one for one in PHYSICS.values() if getattr(spec, one.section) is not None)
    return kind.declare(spec, step)


def open_job(path: Path, *, require_full_rank: bool = True) -> Job:
    """Read the spec and all its data, and pose the problem.

    Args:
        require_full_rank: refuse physics that is linear in θ and rank-deficient on the data.

    Raises:
        InputError: anything wrong with spec, files or physics; one line that names it.
    """
    return open_spec(path, load_spec(path), require_full_rank=require_full_rank)


def open_spec(path: Path, spec: Spec, *, require_full_rank: bool = True) -> Job:
    """Return the job of a spec that is read already.

    Raises:
        InputError: as `open_job`.
    """
    parts, step = None, spec.data.step
    if step is None and spec.physics is not None:  # whose map may contain the sampling time
        parts = load_parts(path, spec)
        step = parts[0].record.sampling_time
    with _named(path):
        check_channels(spec.channels(spec.data.inputs), spec.channels(spec.data.outputs))
        physics = declare_physics(spec, step)
    train, validation, tests = parts or load_parts(path, spec)
    with _named(path):
        first, least = physics.rows_needed(spec)
        keeps = physics.runs_through_gaps(spec)
        train = train.without_short(first, least, keeps=keeps)
        validation = validation and validation.without_short(first, least, keeps=keeps)
        tests = tuple(part.without_short(first, least, keeps=keeps) for part in tests)
        return pose_job(
            path, spec, physics, (train, validation, tests), require_full_rank=require_full_rank
        )


def job_of_change(job: Job, spec: Spec) -> Job:
    """Return the job of another spec on the same data, to be fitted to folds of them.

    Raises:
        InputError: what the spec declares cannot be fitted to the training data.
    """
    physics = declare_physics(spec, job.train.record.sampling_time)
    problem = physics.pose(spec, job.train.record)
    return replace(job, spec=spec, physics=physics, problem=problem, checkpoints=None)


def pose_job(
    path: Path,
    spec: Spec,
    physics: JobPhysics,
    parts: tuple[FilePart, FilePart | None, tuple[FilePart, ...]],
    *,
    require_full_rank: bool = True,
) -> Job:
    """Return the job of a spec on parts of data that are read already.

    Args:
        physics: as the spec declares it.
        parts: training, validation and test parts.

    Raises:
        InputError: data that do not go with the physics, or too few rows.
    """
    train, validation, tests = parts
    _, least = physics.rows_needed(spec)
    kind = spec.engine_kind([path.parent / entry.file for entry in train.files])
    engine = engine_of(spec.engine, kind)
    problem, left_out = physics.pose_part(
        spec, train, kind, engine, require_full_rank=require_full_rank
    )
    _check_sizes(spec, problem, engine)
    entries = [str(entry) for entry in problem.used]
    place = MeasurePlace(path.parent, entries, problem.record, problem.first_row)
    measure = spec.declared_measure(place)
    job = Job(
        path=path,
        spec=spec,
        train=train,
        validation=validation,
        tests=tests,
        physics=physics.under(measure, spec, problem),
        problem=problem,
        measure=measure,
        engine=engine,
        left_out=left_out,
    )
    for part in job.parts:
        part.check_scorable(problem.first_row, train.record.sampling_time, least)
        if part is not train:  # `pose` has looked at that
            physics.check_record(problem, part.record)
    return job


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Put the name of a spec before an error in it."""
    try:
        yield
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None


def _check_sizes(spec: Spec, problem: Any, engine: Any) -> None:
    """Raise InputError where no row would be scored, or training would not end.

    JAX is not loaded for that.
    """
    longest = max(len(e) for e in problem.record.experiments) - problem.first_row
    try:
        check_scored(spec.declared_criterion(), longest)
    except KeyedError as error:
        raise spec_error(error) from None
    runs, iterations = spec.runs(linear=problem.linear), spec.declared_solver().iterations
    learner = spec.declared_learner()
    check_sizes(problem, learner, iterations=iterations, runs=runs, room=engine.room())
