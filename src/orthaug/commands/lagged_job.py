"""Jobs whose physics is linear in θ on lagged signals: opened, and trained."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.errors import InputError, KeyedError, Warning
from orthaug._base.progress import SILENT, Progress
from orthaug.commands.data_sections import engine_of
from orthaug.commands.job import AS_DECLARED, PHYSICS_ONLY, Job, Variant
from orthaug.commands.parts import load_parts
from orthaug.commands.spec import Spec
from orthaug.commands.suspects import check_suspects
from orthaug.data.expressions import Lag
from orthaug.data.record import Record, check_channels
from orthaug.data.regressors import Layout, lag_rows, largest_lag
from orthaug.data.sources import RecordSource
from orthaug.fitting.independent_terms import independent_terms
from orthaug.fitting.kinds import STRUCTURES
from orthaug.fitting.rules import check_cost, check_scored
from orthaug.inference.kinds import MeasurePlace
from orthaug.inference.measures import Measure, WeighedPhysics, weigh_problem
from orthaug.physics.parameters import PhysicsMap, with_initial
from orthaug.physics.problem import Problem, check_defined, pose, regressor_of
from orthaug.physics.streamed import pose_streamed

if TYPE_CHECKING:
    from orthaug.fitting.estimates import Estimate
    from orthaug.models.model import Model
    from orthaug.models.rows import Engine


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class LaggedJob(Job):
    """A job with a baseline."""

    problem: Problem
    weighed: WeighedPhysics
    physics: PhysicsMap | None
    engine: Engine
    """The engine that sums over the rows."""
    left_out: tuple[Warning, ...] = ()
    """Warnings on terms of the learner that are left out, as they add nothing of their own."""

    @property
    def warnings(self) -> tuple[Warning, ...]:
        return (*super().warnings, *self.left_out)

    def without(self, samples: Any) -> str:
        from orthaug.analysis.wild_effect import fit_without

        return fit_without(self.problem, samples)

    @property
    def physics_in_words(self) -> str:
        return repr(self.problem.baseline)

    @property
    def first_row(self) -> int:
        return self.problem.rows.start

    @property
    def linear(self) -> bool:
        return self.problem.baseline.linear

    @property
    def compared(self) -> tuple[str, ...]:
        return (
            (PHYSICS_ONLY,) if self.spec.declared_learner() is None else (PHYSICS_ONLY, *STRUCTURES)
        )

    @property
    def used(self) -> tuple[Lag, ...]:
        """The raw lags that the model reads."""
        return self.problem.used

    @property
    def measure(self) -> Measure:
        """The measure that the spec declares."""
        return self.weighed.measure

    def refusal(self, variant: Variant) -> str | None:
        baseline = self.problem.baseline
        try:
            self.spec.declared_structure(variant.structure_kind).penalty(
                baseline.names, baseline.initial, 1.0
            )
        except InputError as error:
            return str(error)
        return None

    def reach(self, model: Model, record: Record) -> tuple[np.ndarray, Layout]:
        own = record is self.train.record
        return self.problem.rows.x if own else lag_rows(
            record, self.problem.layout
        ), self.problem.layout

    @property
    def runner(self) -> Engine:
        from orthaug.models.tasks import runs_on

        return runs_on(self.engine)

    def fold_fit(self, variant: Variant) -> Callable[[Record], Estimate]:
        """Return a function that trains a variant on a fold, and can be sent to another process.

        A fold is small: its rows are in memory.
        """
        spec, options = self.spec, self.training_options(variant.on(self.train.record))
        # Scored by predictions, on which the measure has no effect
        options["structure"] = spec.declared_structure(variant.structure_kind)
        weights, lags, learner_inputs = spec.training.output_weights, None, None
        if not variant.physics_only and spec.declared_learner() is not None:
            lags, learner_inputs = spec.lag_orders(), spec.learner_inputs()
        posed = (self.problem.baseline, lags, learner_inputs)
        return partial(_fitted_to, posed=posed, weights=weights, options=options)

    def with_spec(self, spec: Spec) -> LaggedJob:
        physics, baseline = (
            spec.physics_map(self.train.record.sampling_time),
            spec.declared_baseline(),
        )
        baseline = baseline if physics is None else with_initial(physics, baseline)
        lags = spec.lag_orders() if spec.declared_learner() is not None else None
        weights = spec.training.output_weights
        problem = pose(
            self.train.record, baseline, lags, spec.learner_inputs(), output_weights=weights
        )
        return replace(self, spec=spec, problem=problem, physics=physics, checkpoints=None)

    def run(self, variant: Variant = AS_DECLARED, progress: Progress = SILENT) -> Estimate:
        from orthaug.fitting.estimation import fit

        if variant.fold is not None:
            return self.fold_fit(variant)(variant.fold)
        structure = self.spec.declared_structure(
            variant.structure_kind, None if variant.physics_only else self.measure
        )
        options = self.training_options(variant) | {
            "engine": self.engine,
            "checkpoints": self.checkpoints,
        }
        options["ensemble"] = self.spec.training.ensemble and options["learner"] is not None
        problem = self.problem.physics_alone() if variant.physics_only else self.problem
        return fit(problem, structure=structure, progress=progress, **options)


def _fitted_to(fold: Record, posed: Any, weights: Any, options: dict[str, Any]) -> Estimate:
    from orthaug.fitting.estimation import fit

    return fit(pose(fold, *posed, output_weights=weights), **options)


def open_lagged(path: Path, spec: Spec, *, require_full_rank: bool = True) -> LaggedJob:
    """Read all data of a spec with a baseline, and pose the problem.

    Raises:
        InputError: anything wrong with spec, files or physics; one line that names it.
    """
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
        spec.declared_structure().penalty(baseline.names, baseline.initial, 1.0)
        baseline.check_channels(spec.data.outputs, spec.data.inputs)
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None
    train, validation, tests = parts or load_parts(path, spec)
    lags = spec.lag_orders() if spec.declared_learner() is not None else None
    try:
        layout, _ = regressor_of(
            baseline, lags, learner_inputs, tuple(spec.data.outputs), tuple(spec.data.inputs)
        )
        first = largest_lag(layout)
        train, tests = (
            train.without_short(first),
            tuple(part.without_short(first) for part in tests),
        )
        validation = validation.without_short(first) if validation else None
        options = {
            "output_weights": spec.training.output_weights,
            "require_full_rank": require_full_rank,
        }
        kind = spec.engine_kind([path.parent / entry.file for entry in train.files])
        engine = engine_of(spec.engine, kind)
        # On a cluster they are its tasks
        several = spec.runs(linear=baseline.linear) > 1 and train.source is None
        if kind in ("memory", "devices") or spec.brought or (kind == "dask" and several):
            problem = pose(train.record, baseline, lags, learner_inputs, **options)
        else:
            source = train.source or RecordSource(train.record, first, spec.engine.partition_rows)
            problem = pose_streamed(
                source, train.record, engine.passes, baseline, lags, learner_inputs, **options
            )
        learner, left_out = spec.declared_learner(), ()
        if learner is not None and problem.excitation.full_rank:
            problem, _, left_out = independent_terms(problem, learner)
        problem.feature_rows()
        _check_scored(spec, problem)
        _check_cost(spec, problem, engine)
        weighed = weigh_problem(measure_of(spec, problem, path.parent), problem)
        _check_measure(weighed, problem)
        named: dict[str, Any] = {
            "path": path,
            "spec": spec,
            "train": train,
            "validation": validation,
            "tests": tests,
        }
        named |= {"problem": problem, "weighed": weighed, "engine": engine}
        job = LaggedJob(**named, physics=physics, left_out=left_out)
        check_suspects(spec.suspects, problem, weighed)
        for part in job.parts:
            part.check_scorable(problem.rows.start, train.record.sampling_time)
            if part is not train:  # `pose` has looked at that
                check_defined(problem, part.record)
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None
    return job


def _check_scored(spec: Spec, problem: Problem) -> None:
    """Check that the parts can be scored, as `check_scored`; errors use the words of the spec."""
    longest = max(len(e) for e in problem.record.experiments) - problem.rows.start
    try:
        check_scored(spec.declared_criterion(), longest)
    except KeyedError as error:
        raise InputError(f"'training.{error.key}'{error.words}.") from None


def _check_cost(spec: Spec, problem: Problem, engine: Engine) -> None:
    """Check the cost of training, as `check_cost`, before JAX is loaded."""
    sizes = {
        "rows": problem.count,
        "features": len(problem.features.entries),
        "outputs": len(problem.outputs),
    }
    runs = spec.runs(linear=problem.baseline.linear)
    options: dict[str, Any] = {
        "held": len(problem.rows),
        "iterations": spec.declared_solver().iterations,
        "runs": runs,
    }
    check_cost(spec.declared_learner(), **sizes, **options, room=engine.room())


def measure_of(spec: Spec, problem: Problem, folder: Path) -> Measure:
    """Return the measure that a spec declares for its problem."""
    lags = [str(lag) for lag in problem.used]
    return spec.declared_measure(MeasurePlace(folder, lags, problem.record, problem.rows.start))


def _check_measure(weighed: WeighedPhysics, problem: Problem) -> None:
    """Raise InputError where physics is rank-deficient under the measure but not on the data."""
    if problem.excitation.full_rank and not weighed.excitation.full_rank:
        groups = "; ".join(", ".join(group) for group in weighed.excitation.collinear)
        name = weighed.measure.name
        raise InputError(
            f"under the {name} measure the physics cannot distinguish {groups}; widen or move it."
        )
