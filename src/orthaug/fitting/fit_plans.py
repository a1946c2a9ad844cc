"""Plans of a fit: the request, rules of each kind of physics, tasks to train.

`fit` goes the same way for every kind: it checks the request, has tasks and starts made, trains and
finishes. A kind of physics says in a `FitPlan` what of that is its own. A new kind is one of these
and an entry of `PLANS`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np

from orthaug._base.checks import Vector, check_choice, check_count, check_type, is_number
from orthaug._base.errors import InputError, Warning, show
from orthaug._base.lines import plural
from orthaug._base.progress import SILENT, ProgressCallback
from orthaug.data.record import Record
from orthaug.data.regressors import Lags
from orthaug.data.sources import Source, witness
from orthaug.fitting.checkpoints import Checkpoints
from orthaug.fitting.criteria import Criterion, Prediction, Simulation
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.focus import choose_focus
from orthaug.fitting.free_run import FreeRunTask
from orthaug.fitting.independent_terms import independent_terms
from orthaug.fitting.innovations import (
    InnovationsTask,
    choose_noise,
    predicted_problem,
    stable_or_white,
)
from orthaug.fitting.kinds import CRITERIA, Solver, declared_by_name
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.fitting.learned import Task
from orthaug.fitting.motion_task import (
    MotionTask,
    WarmMotionTask,
    check_initial_motion,
    with_its_memory,
)
from orthaug.fitting.noise import Noise, declared_noise, noise_of_motion
from orthaug.fitting.noise_estimation import check_noise, fit_coloured
from orthaug.fitting.one_step import OneStepTask
from orthaug.fitting.rules import check_motion_choices, check_no_memory
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.structures import Orthogonal, Structure
from orthaug.fitting.training import Choice
from orthaug.inference.covariance import whitening_matrix
from orthaug.inference.measures import Training
from orthaug.models.learners import MLP, Learner, declared, learns
from orthaug.models.model import Model
from orthaug.models.rows import Engine, InMemory
from orthaug.models.tasks import Tasks
from orthaug.models.terms import over_lags, over_states
from orthaug.physics.baseline import Baseline
from orthaug.physics.innovations import InnovationsForm
from orthaug.physics.learner_states import LearnerStates
from orthaug.physics.motion import Motion
from orthaug.physics.output_weights import by_covariance
from orthaug.physics.problem import MotionProblem, PosedProblem, Problem, pose, pose_motion
from orthaug.physics.streamed import pose_streamed

Regularization = str | float
Fit = Callable[..., Any]
"""`fit(problem, learner=…, criterion=…, …)`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Request:
    """The options of `fit`, as of `estimate`; `criterion` None for that of the kind of physics.

    A criterion may be a name.
    """

    learner: Learner | None = MLP()  # noqa: RUF009  (frozen)
    structure: Structure = Orthogonal()  # noqa: RUF009  (frozen)
    criterion: Criterion | str | None = None
    solver: Solver = LevenbergMarquardt()  # noqa: RUF009  (frozen)
    regularization: Regularization | Sequence[Regularization] = "auto"
    restarts: int = 1
    seed: int = 0
    ensemble: bool = False
    blocks: int = 4
    fallback: bool = True
    initial: Model[Any] | None = None
    validation: Record | None = None
    progress: ProgressCallback = SILENT
    engine: Engine = InMemory()  # noqa: RUF009  (frozen)
    checkpoints: Checkpoints | None = None
    noise: Noise = "white"
    briefly: bool = False
    """True if the model only has to simulate."""

    @property
    def warm(self) -> bool:
        """True where training goes on from an earlier model."""
        return self.initial is not None

    def options(self, **changed: Any) -> dict[str, Any]:
        """Return the options by name, some of them changed."""
        return {field.name: getattr(self, field.name) for field in fields(self)} | changed


class Prepared(NamedTuple):
    """A problem ready for training, with warnings on what was left out."""

    task: Task
    request: Request
    """With the learner that is trained."""
    warnings: tuple[Warning, ...] = ()


P = TypeVar("P", Problem, MotionProblem)


class FitPlan(ABC, Generic[P]):
    """A problem and what a fit of it was asked for: the part that depends on the physics."""

    physics: ClassVar[type]
    problem_type: ClassVar[type]
    criterion: ClassVar[Criterion]
    """The criterion where none is asked for."""
    by_evidence: ClassVar[bool] = False
    """True where "auto" regularizes by evidence."""

    def __init__(self, problem: P, request: Request) -> None:
        self.problem, self.request = problem, request

    def on(self, request: Request) -> FitPlan[P]:
        """Return the plan with another request."""
        return type(self)(self.problem, request)

    @property
    def learner(self) -> Learner:
        """The learner that is trained: that of an earlier model, or the one asked for."""
        initial = self.request.initial
        return declared(self.request.learner if initial is None else initial.form.bound.learner)

    @property
    def asked(self) -> Criterion:
        """The criterion that was asked for, or that of the kind of physics."""
        given = self.request.criterion
        own = given is None or given == CRITERIA.kind_of(self.criterion)
        return self.criterion if own else declared_by_name(CRITERIA, given)

    @classmethod
    @abstractmethod
    def pose(
        cls,
        record: Record | Source,
        physics: Any,
        *,
        lags: Lags | None,
        learner: Learner | None,
        output_weights: str | Sequence[float],
        initial: Model[Any] | None,
        engine: Engine | None,
    ) -> tuple[P, Learner | None, Engine]:
        """Return a problem with the learner for it, and the engine that sums over its rows.

        Arguments as of `estimate`.
        """

    @abstractmethod
    def check(self) -> None:
        """Raise InputError for a request that the physics cannot be trained with."""

    def by_other_fits(self, fit: Fit) -> Estimate | None:
        """Return the estimate where several fits make it; None where one does."""
        return None

    @abstractmethod
    def settled(self) -> Criterion:
        """Return the criterion with its open choices made for the record."""

    @property
    def solved(self) -> bool:
        """True where θ is solved for any weights, and physics alone needs no training."""
        return False

    @abstractmethod
    def prepare(self) -> Prepared:
        """Return the task, with the criterion settled and the engine that makes the runs."""

    def choice(self, *, auto: bool) -> Choice:
        """Return how the best run is chosen; `auto` for regularizations that "auto" declares."""
        request = self.request
        # A brief fit is judged on rows that it never sees
        blocks = 0 if request.warm or request.briefly else request.blocks
        return Choice(request.validation, blocks, request.fallback, briefly=request.briefly)

    def solve(self, task: Any) -> Estimate | None:
        """Return the estimate of a task that is solved; None where it is trained."""
        return None

    def finish(self, estimate: Estimate, prepared: Prepared, fit: Fit) -> Estimate:
        """Return the estimate as it is handed over."""
        return estimate

    @property
    def kept(self) -> Checkpoints | None:
        """The checkpoints; None for runs on workers, which have another disk."""
        return None if isinstance(self.request.engine, Tasks) else self.request.checkpoints


class LaggedPlan(FitPlan[Problem]):
    """Physics that is linear in θ over rows of lags."""

    physics = Baseline
    problem_type = Problem
    criterion = Prediction()

    @classmethod
    def pose(
        cls,
        record: Record | Source,
        physics: Baseline,
        *,
        lags: Lags | None,
        learner: Learner | None,
        output_weights: str | Sequence[float],
        initial: Model[Any] | None,
        engine: Engine | None,
    ) -> tuple[Problem, Learner | None, Engine]:
        if not isinstance(record, Source):
            check_type(record, Record, "record", "a Record")
        check_types(lags=lags, learner=learner)
        if initial is not None and not initial.form.separates:
            raise InputError("`initial` is a motion, which has no regressor; fit anew.")
        if initial is not None and not initial.form.bound.learns:
            raise InputError(
                "`initial` is physics alone and has nothing to start from; leave it out."
            )
        channels = (
            tuple(channel.name for channel in group) for group in (record.outputs, record.inputs)
        )
        learner = over_lags(learner, physics, lags, *channels)
        inputs = declared(learner).inputs
        if initial is not None:
            inputs = tuple(str(entry) for entry in initial.form.entries)
        problem, engine = pose_source(
            record, engine, physics, lags, inputs, output_weights=output_weights
        )
        return problem, learner, engine

    def check(self) -> None:
        check_no_memory(self.learner)
        _check_splittable(self.request.structure, self.problem.baseline, self.learner)

    def by_other_fits(self, fit: Fit) -> Estimate | None:
        problem, request, criterion = self.problem, self.request, self.asked
        coloured = declared_noise(request.noise)
        if coloured is not None:
            asked = (request.solver, request.structure, criterion, request.engine)
            check_noise(problem, coloured, *asked, ensemble=request.ensemble)
            return fit_coloured(
                problem, coloured, fit, request.options(criterion=criterion, noise="white")
            )
        if not (criterion.automatic and self._may_decide):
            return None
        options = request.options()
        return choose_focus(problem, fit, options, options.pop("criterion"))

    @property
    def _may_decide(self) -> bool:
        """True where the data may decide for the free run.

        They may not where only one step ahead can be trained.
        """
        request = self.request
        able = request.solver.gauss_newton and self.problem.linear and not self.problem.streamed
        return able and not (request.warm or request.ensemble or request.structure.from_initial)

    def settled(self) -> Criterion:
        """Return the criterion with its open choices made for the record.

        One step ahead where nothing else can be trained.
        """
        criterion = self.criterion if self.asked.automatic else self.asked
        if self.problem.streamed:
            return criterion.streamed
        return criterion.on(self.problem.record, self.problem.first_row)

    @property
    def solved(self) -> bool:
        return self.asked.one_step and self.problem.linear

    def prepare(self) -> Prepared:
        problem, request, warm, warnings = self.problem, self.request, None, ()
        if request.initial is not None:
            task, warm = _warm_start(problem, request.initial, request.engine)
        else:
            learner = self.learner
            if problem.noise is None:  # a fit under a noise model has left them out already
                problem, learner, warnings = independent_terms(problem, learner)
                request = replace(request, learner=learner)
            task = OneStepTask.of(problem, learner, engine=request.engine)
        alone = not task.bound.learns
        self._check_ensemble(alone=alone)
        if alone and self.solved:
            return Prepared(task, request, warnings)
        task = replace(task, checkpoints=self.kept)
        trained = task if self.solved else FreeRunTask.of(task, self.asked, warm)
        return Prepared(trained, request, warnings)

    def _check_ensemble(self, *, alone: bool) -> None:
        """Raise InputError for a median of outputs that are mixed with each other."""
        if self.request.ensemble and not alone and self.problem.weight.choice == "covariance":
            raise InputError(
                "an ensemble takes the median of each output; use `output_weights` std, none or "
                "numbers."
            )

    def choice(self, *, auto: bool) -> Choice:
        return replace(
            super().choice(auto=auto),
            ensemble=self.request.ensemble,
            scored=auto and self.solved,
        )

    def solve(self, task: Any) -> LaggedEstimate | None:
        """Return physics alone where it is solved: it ends at the loss where it starts."""
        if task.bound.learns or not self.solved:
            return None
        estimate = task.conclude(self.request.structure, task.physics_learned())
        return replace(estimate, status=replace(estimate.status, start_loss=estimate.status.loss))

    def finish(self, estimate: LaggedEstimate, prepared: Prepared, fit: Fit) -> LaggedEstimate:
        structure, weight = self.request.structure, self.problem.weight
        if _splits(structure) and estimate.status.ok and estimate.learns:
            estimate = estimate.split(structure.measure)
        estimate = replace(estimate, warnings=(*prepared.warnings, *estimate.warnings))
        if weight.choice != "covariance" or weight.kind == "covariance" or not self.solved:
            return estimate
        same = ("learner", "structure", "criterion", "solver", "engine", "progress")
        given = {name: getattr(prepared.request, name) for name in same}
        return reweight(estimate, partial(_refit_weights, fit=fit, **given))


class MotionPlan(FitPlan[MotionProblem]):
    """Equations of motion, trained on their free run."""

    physics = Motion
    problem_type = MotionProblem
    by_evidence = True
    criterion = Simulation(washout=0)
    """Segments start at estimated states, so that none of their steps is left out."""

    @classmethod
    def pose(
        cls,
        record: Record | Source,
        physics: Motion,
        *,
        lags: Lags | None,
        learner: Learner | None,
        output_weights: str | Sequence[float],
        initial: Model[Any] | None,
        engine: Engine | None,
    ) -> tuple[MotionProblem, Learner | None, Engine]:
        if lags is not None:
            raise InputError(
                "a motion has no `lags`: its learner sees states and inputs; leave them out."
            )
        record = rows_in_memory(record)
        engine = InMemory() if engine is None else engine
        learner = over_states(learner, physics)
        check_types(learner=learner)
        if initial is None:
            states = LearnerStates.of(learner)
            inputs = declared(learner).inputs
            return pose_motion(record, physics, inputs, output_weights, states), learner, engine
        physics = with_its_memory(initial, physics)
        check_initial_motion(initial, physics)
        inputs = [entry.text for entry in initial.form.entries]
        return pose_motion(record, physics, inputs, output_weights), learner, engine

    def check(self) -> None:
        request = self.request
        if request.ensemble:
            raise InputError(
                "a motion has no `ensemble`: medians of outputs follow no equations of motion; "
                "leave it out."
            )
        chosen = (self.learner, request.structure, self.settled(), request.solver)
        check_motion_choices(self.problem.motion, *chosen)

    def by_other_fits(self, fit: Fit) -> Estimate | None:
        """Return the fit of the motion's predictor under a noise model; None under white noise."""
        request = self.request
        asked = noise_of_motion(request.noise)
        if asked == "white":
            return None
        predicted = predicted_problem(self.problem, request.engine, warm=request.warm)
        options = request.options(noise="white", checkpoints=None)
        if asked == "innovations":
            coloured = fit(predicted, **request.options(noise="white"))
            return stable_or_white(coloured, lambda: fit(self.problem, **options))
        return choose_noise(fit(self.problem, **options), fit(predicted, **options))

    def settled(self) -> Criterion:
        criterion = self.criterion if self.asked.automatic else self.asked
        return criterion.on(self.problem.record, most=self.problem.steps_to_leave())

    def prepare(self) -> Prepared:
        request = replace(self.request, learner=self.learner)
        made = (self.asked, request.engine)
        if request.initial is None:
            predicted = isinstance(self.problem.motion, InnovationsForm)
            kind = InnovationsTask if predicted else MotionTask
            task = kind.of(self.problem, self.learner, *made)
        else:
            check_initial_motion(request.initial, self.problem.motion)
            task = WarmMotionTask.from_model(self.problem, request.initial, *made)
        return Prepared(task.with_checkpoints(self.kept), request)

    def choice(self, *, auto: bool) -> Choice:
        return replace(super().choice(auto=auto), retry=auto and not self.request.warm)


PLANS: tuple[type[FitPlan[Any]], ...] = (LaggedPlan, MotionPlan)
"""The kinds of physics that can be fitted."""


def plan_of(problem: PosedProblem, request: Request) -> FitPlan[Any]:
    """Return the plan by which a problem is fitted."""
    return next(plan for plan in PLANS if isinstance(problem, plan.problem_type))(problem, request)


def plan_for(physics: Any) -> type[FitPlan[Any]]:
    """Return the kind of plan by which physics are fitted.

    Raises:
        InputError: what is no physics.
    """
    check_types(baseline=physics)
    return next(plan for plan in PLANS if isinstance(physics, plan.physics))


_TURNS = 30
_SETTLED = 1e-6  # relative change of W


def reweight(
    first: LaggedEstimate, again: Callable[[Problem, LaggedEstimate], LaggedEstimate]
) -> LaggedEstimate:
    """Return the fit whose outputs are weighted by the covariance of its own errors.

    Args:
        first: a fit with any output weights.
        again: the fit of a problem with other weights, begun from an earlier estimate.

    Returns:
        The last fit, with the restarts of the first one. It keeps its weights where the errors'
        covariance is singular; a warning says that the turns did not settle.
    """
    estimate, problem = first, first.problem
    covariance = problem.target_covariance
    for _ in range(_TURNS):
        noise = estimate.model.statistics.noise if estimate.status.ok else None
        white = None if noise is None else whitening_matrix(noise, problem.deviation)
        if white is None:
            return replace(estimate, restarts=first.restarts)
        weight = by_covariance(white, covariance)
        change = np.linalg.norm(weight.matrix - problem.weight.matrix) / np.linalg.norm(
            weight.matrix
        )
        if change <= _SETTLED:
            return replace(estimate, restarts=first.restarts)
        problem = problem.weigh(weight)
        estimate = again(problem, estimate)
    text = (
        f"the weights of the outputs still change by {change:.1g} after {_TURNS} fits, so θ "
        "depends on where the iteration stopped."
    )
    warnings = (*estimate.warnings, Warning("output_weights_unsettled", text))
    return replace(estimate, restarts=first.restarts, warnings=warnings)


def _refit_weights(
    problem: Problem, last: LaggedEstimate, *, fit: Fit, **options: Any
) -> LaggedEstimate:
    """Return the fit to other weights of the outputs, from the end of the last fit."""
    chosen = next((r.regularization for r in last.restarts if r.chosen), "none")
    start = last.model if last.learns else None
    return fit(problem, initial=start, regularization=chosen, **options)


def check_blocks(blocks: int) -> int:
    """Return how many blocks are held out in turn.

    Raises:
        InputError: one, of which nothing would be left to train on.
    """
    blocks = check_count(blocks, "blocks", least=0)
    if blocks == 1:
        raise InputError("`blocks` must be 2 or more, or 0 for none; got 1.")
    return blocks


def _check_splittable(structure: Structure, baseline: Baseline, learner: Learner) -> None:
    """Raise InputError for bounds on a θ that is split off after training."""
    if not (_splits(structure) and learns(learner)):
        return
    bounded = [p.name for p in baseline.parameters if np.isfinite(p.min) or np.isfinite(p.max)]
    if bounded:
        raise InputError(
            f"{', '.join(bounded)} have bounds, which hold under the training measure only. "
            "Under another measure θ is computed after training, without bounds. Drop the "
            "bounds or the measure."
        )


def _splits(structure: Structure) -> bool:
    """Return whether θ is split off under another measure than that of training."""
    return structure.measure != Training()


def _warm_start(problem: Problem, model: Model, engine: Engine) -> tuple[OneStepTask, Vector]:
    """Return the task of training on in an earlier model's scaling, and the model's c."""
    bound, numbers = model.form.bound, model.numbers
    if numbers.tilt is not None:
        raise InputError(
            "`initial` is an ensemble, which has no single weights to start from; fit anew."
        )
    if len(problem.outputs) != bound.ny:
        raise InputError(
            f"`initial` has {plural(bound.ny, 'output')}, the record {len(problem.outputs)}; fit "
            "anew."
        )
    problem = problem.for_linear_learner() if model.form.features.linear else problem
    task = OneStepTask.of(problem, bound.learner, model.scaling, np.asarray(numbers.gain), engine)
    return task, model.theta - model.theta_aux


_TYPES: dict[str, tuple[Any, str]] = {
    "baseline": (Baseline | Motion, "a Baseline or a Motion"),
    "lags": (Lags | None, "Lags(…) or None"),
    "learner": (Learner | None, "a learner such as MLP(), or None"),
    "structure": (Structure, "a structure such as Orthogonal()"),
    "criterion": (Criterion, "Prediction(…), Simulation(…) or Auto(…)"),
    "solver": (Solver, "a solver such as LevenbergMarquardt()"),
    "initial": (Model | None, "a Model or None"),
    "validation": (Record | None, "a Record or None"),
}


def check_types(**given: Any) -> None:
    """Raise InputError for an argument of another type."""
    for name, value in given.items():
        kind, words = _TYPES[name]
        check_type(value, kind, name, words)


def check_regularizations(given: object, choices: Sequence[object], chosen: bool) -> bool:
    """Return whether "auto" was given, and check the regularizations.

    Raise InputError for what is none, or for several that nothing chooses between.
    """
    auto = isinstance(given, str) and given == "auto"
    if len(choices) > 1 and not (auto or chosen):
        raise InputError(
            "several regularizations need `validation` or `blocks` to choose between them."
        )
    for choice in choices:
        if isinstance(choice, str):
            check_choice(choice, ("none", "evidence", "ard"), "`regularization`")
        elif isinstance(choice, bool) or not isinstance(choice, int | float | np.number):
            raise InputError(
                "`regularization` must be auto, none, evidence, ard or a number; got "
                f"{show(choice)}."
            )
        elif not (is_number(choice) and choice >= 0):
            raise InputError(f"`regularization` must be 0 or more; got {show(choice)}.")
    if not choices:
        raise InputError("`regularization` is empty; give auto, none, evidence, ard or a number.")
    return auto


def rows_in_memory(record: Any) -> Record:
    """Return a record whose rows are in memory, as a motion needs them.

    Raises:
        InputError: a source, or no record.
    """
    if isinstance(record, Source) and not isinstance(record, Record):
        raise InputError(
            "a motion needs its rows in memory: read them with read_record or Record.join, or "
            "fit the physics in its lagged form."
        )
    check_type(record, Record, "record", "a Record")
    return record


def pose_source(
    record: Record | Source, engine: Engine | None, baseline: Baseline, *args: Any, **options: Any
) -> tuple[Problem, Engine]:
    """Return the problem with the engine that sums over its rows; further arguments as of `pose`.

    Args:
        engine: None for what suits the record: memory, a stream of its files, the cluster that
            holds it.

    Raises:
        InputError: as `pose`.
    """
    if isinstance(record, Record):
        return pose(record, baseline, *args, **options), InMemory() if engine is None else engine
    engine = _engine_of(record) if engine is None else engine
    return pose_streamed(record, witness(record), engine.passes, baseline, *args, **options), engine


def _engine_of(source: Source) -> Engine:
    client = getattr(source, "client", None)
    if client is not None:
        from orthaug.models.cluster import Dask

        return Dask(client)
    from orthaug.models.streaming import Stream

    return Stream()
