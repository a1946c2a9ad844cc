"""Training of a motion, with a learner in some of its equations, and its estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from orthaug._base.checks import Matrix, check_type
from orthaug._base.errors import InputError
from orthaug._base.jax import jax, jnp
from orthaug._base.progress import SILENT, ProgressCallback
from orthaug.data.record import Record
from orthaug.fitting.checkpoints import Checkpoints
from orthaug.fitting.conclusion import without_loss
from orthaug.fitting.criteria import Criterion, Simulation
from orthaug.fitting.kinds import Solver
from orthaug.fitting.learned import TrainedLearner
from orthaug.fitting.motion_estimates import MotionEstimate
from orthaug.fitting.motion_task import MotionTask
from orthaug.fitting.rules import (
    check_motion_choices,
    check_sizes,
    check_solver,
    checked_starts,
    choose_regularizations,
)
from orthaug.fitting.segmented_motion import SegmentedMotion
from orthaug.fitting.silence import is_silenced, learner_silent
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.status import ALONE, Ending, Status
from orthaug.fitting.structures import Orthogonal, Structure
from orthaug.fitting.training import Choice, PlannedRun, plan_runs, train
from orthaug.fitting.unfinished import ending_in_words, is_unfinished, not_converged, withheld
from orthaug.fitting.warm_motion import WarmMotionTask, check_initial_motion, with_its_memory
from orthaug.inference.motion_split import MotionSplit
from orthaug.models.beyond import limits_of, pull_of
from orthaug.models.learners import Learner, Scaling, declared, learns
from orthaug.models.model import Model, TrainedSegments
from orthaug.models.moving import MotionDynamics
from orthaug.models.rows import Engine, InMemory
from orthaug.models.starts import EstimatedStates
from orthaug.models.statistics import Statistics
from orthaug.models.tasks import Tasks, runs_on
from orthaug.physics.learner_states import LearnerStates
from orthaug.physics.motion import Motion
from orthaug.physics.motion_problem import MotionProblem, pose_motion

DEFAULT = Simulation(washout=0)
"""The criterion of a motion: its segments start at estimated states, so that none of their steps is
left out.
"""


def pose_for(
    record: Record,
    motion: Motion,
    learner: Learner | None,
    output_weights: str | Sequence[float],
    initial: Model[MotionDynamics] | None = None,
) -> MotionProblem:
    """Return the problem of a motion with the inputs of a learner, or of an earlier model's.

    Raises:
        InputError: as `pose_motion`; a model that is not of this motion.
    """
    check_type(record, Record, "record", "a Record")
    check_type(learner, Learner | None, "learner", "a learner such as MLP(), or None")
    if initial is None:
        return pose_motion(
            record, motion, declared(learner).inputs, output_weights, LearnerStates.of(learner)
        )
    motion = with_its_memory(initial, motion)
    check_initial_motion(initial, motion)
    return pose_motion(record, motion, [e.text for e in initial.form.entries], output_weights)


def fit_motion(
    problem: MotionProblem,
    *,
    learner: Learner | None,
    structure: Structure = Orthogonal(),  # noqa: B008  (frozen)
    criterion: Criterion = DEFAULT,
    solver: Solver = LevenbergMarquardt(),  # noqa: B008  (frozen)
    regularization: str | float | Sequence[str | float] = "auto",
    restarts: int = 1,
    seed: int = 0,
    blocks: int = 4,
    fallback: bool = True,
    initial: Model[MotionDynamics] | None = None,
    validation: Record | None = None,
    progress: ProgressCallback = SILENT,
    engine: Engine = InMemory(),  # noqa: B008  (frozen)
    checkpoints: Checkpoints | None = None,
) -> MotionEstimate:
    """Fit a motion that is posed already; arguments as of `estimate`.

    Raises:
        InputError: what a motion cannot be trained with.
    """
    learner = declared(learner if initial is None else initial.form.bound.learner)
    criterion = DEFAULT if criterion.automatic else criterion
    criterion = criterion.on(problem.record)
    check_motion_choices(problem.motion, learner, structure, criterion, solver)
    validated = validation is not None
    conditions = {"linear": False, "validated": validated, "motion": True}
    choices = choose_regularizations(
        regularization, solver, criterion, structure, learner=learner, **conditions
    )
    restarts, seed = checked_starts(restarts, seed, warm=initial is not None, ensemble=False)
    check_solver(solver, criterion, choices if learns(learner) else ())
    runs = len(choices) * (restarts if initial is None else 1)
    check_sizes(problem, learner, iterations=solver.iterations, runs=runs, room=engine.room())
    engine = runs_on(engine) if runs > 1 else engine
    kept = None if isinstance(engine, Tasks) else checkpoints
    if initial is None:
        task = MotionTask.of(problem, learner, criterion, engine)
        starts = plan_runs(task.bound, range(seed, seed + restarts), choices)
    else:
        check_initial_motion(initial, problem.motion)
        task = WarmMotionTask.from_model(problem, initial, criterion, engine)
        starts = [PlannedRun(0, np.asarray(initial.numbers.weights), c) for c in choices]
    task = task.with_checkpoints(kept)
    retry = initial is None and isinstance(regularization, str) and regularization == "auto"
    chosen = Choice(validation, blocks if initial is None else 0, fallback, retry=retry)
    return train(task, starts, structure, solver, chosen, progress, conclude_motion, runner=engine)


_WINDOWS = (4, 16)  # times (states + 1): rows of a window to predict from
_TRIED_ROWS = 1000  # on which windows are compared


def conclude_motion(
    task: MotionTask, structure: Structure, learned: TrainedLearner
) -> MotionEstimate:
    """Split the fitted motion and attach statistics."""
    plan = task.plan
    assert learned.coefficients is not None and learned.errors is not None
    states = plan.segments.start if learned.scores is None else learned.scores.states
    slope = None if learned.scores is None else learned.scores.slope
    unsettled = (not_converged(learned),) if is_unfinished(learned) else ()
    learned = withheld(learned) if unsettled else learned
    errors = learned.errors
    assert errors is not None and learned.coefficients is not None
    alone = np.asarray(
        learned.coefficients if task.physics is None else task.physics.end.point.theta
    )
    layout = (plan.free_run.steps, plan.free_run.washout, plan.segments.count)
    trained = TrainedSegments(*layout, np.asarray(states), slope, alone)
    model = replace(_model(plan, structure, learned), trained=trained)
    reason = (
        ALONE.get(learned.ending, "") if not learned.bound.learns or task.physics is None else ""
    )
    if reason and not learned.ending.usable and (where := task.problem.without_value(np.any)):
        reason = f"{where}; correct it, or bound its parameters"
    silent = learner_silent(learned, _learner_values(plan, learned))
    reason = reason or ending_in_words(learned.ending, learned.tail)
    fit = MotionEstimate(
        model=model,
        status=Status(
            learned.ending, learned.iterations, learned.seconds, errors.mean_square, reason=reason
        ),
        restarts=(),
        covariance=None,
        freedom=errors.freedom,
        effective_weights=learned.effective,
        defect=None,
        problem=task.problem,
        criterion=task.criterion,
        split_by=MotionSplit.empty("training", plan.dynamics, learned.coefficients),
        segmented=plan,
        states=states,
        slope=slope,
        alone=alone,
        scores=learned.scores,
        warnings=(*without_loss(errors.mean_square), *unsettled, *silent),
    )
    return (
        fit.split(structure.measure, getattr(structure, "shared", "auto"))
        if learned.ending.usable
        else fit
    )


def _learner_values(plan: SegmentedMotion, learned: TrainedLearner) -> Matrix | None:
    """Return the values (N, nl) of a nearly silent learner along the training runs.

    None of others.
    """
    bound = plan.bound
    if learned.scores is None or not is_silenced(learned.effective, bound.ny):
        return None
    assert learned.coefficients is not None
    x, u = plan.trajectory(learned.coefficients, learned.weights, learned.scores.states)
    with np.errstate(all="ignore"):
        features = plan.scaling(np.asarray(plan.dynamics.seen(x.T, u.T, np)).T)
    values = np.asarray(jax.vmap(lambda z: bound.values(jnp.asarray(learned.weights), z))(features))
    return values if np.isfinite(values).all() else None


def _model(
    plan: SegmentedMotion, structure: Structure, learned: TrainedLearner
) -> Model[MotionDynamics]:
    record = plan.record
    assert learned.coefficients is not None and learned.errors is not None
    noise = learned.errors.noise
    middle = None
    if noise is not None and learned.gram is not None and learned.middle is not None:
        middle = learned.middle(plan.problem.weight.whitened(noise))
    model = Model(
        form=plan.dynamics,
        numbers=plan.numbers(learned.coefficients, learned.weights),
        outputs=record.outputs,
        inputs=record.inputs,
        sampling_time=record.sampling_time,
        structure=structure.name,
        largest_output=np.max([np.abs(e.outputs).max(axis=0) for e in record.experiments], axis=0),
        deviation=plan.deviation,
        weight=plan.weight,
        starts=EstimatedStates(_WINDOWS[0] * (plan.dynamics.states + 1), plan.loose),
        time_column=record.time_column,
        prepared=record.prepared,
        statistics=Statistics(
            learned.gram, middle, noise, learned.ridge, learned.errors.freedom, simulated=True
        ),
    )
    if not learned.ending.usable:
        return model
    model = _with_window(model, _best_window(model, record))
    return (
        model
        if not model.learns
        else _with_limits(replace(model, seen=_feature_range(model, record)), record)
    )


def _with_limits(model: Model[MotionDynamics], record: Record) -> Model[MotionDynamics]:
    """Return the model with the range of its features over the fitted run.

    Beyond that range the correction stays constant or fades.
    """
    limits = None if model.form.beyond == "free" or model.seen is None else limits_of(model.seen)
    if limits is None:
        return model
    nx = model.form.states

    def features(points: Matrix) -> Matrix:
        return model.form.features_at(points[:, :nx], points[:, nx:])

    pull = pull_of(features, model.reach(record))
    return replace(model, numbers=model.numbers._replace(limits=limits, pull=pull))


def _feature_range(model: Model[MotionDynamics], record: Record) -> Matrix | None:
    """Return the least and largest (2, nz) of the learner's features over the free run.

    None where it has no finite ones.
    """
    states, inputs = np.split(model.reach(record), [model.form.states], axis=1)
    with np.errstate(all="ignore"):
        features = model.form.features_at(states, inputs)
    finite = features[np.isfinite(features).all(axis=1)]
    return np.stack([finite.min(axis=0), finite.max(axis=0)]) if finite.size else None


def _with_window(model: Model[MotionDynamics], window: int) -> Model[MotionDynamics]:
    """Return the model with another number of rows that give a state to predict from."""
    assert isinstance(model.starts, EstimatedStates)
    return replace(model, starts=replace(model.starts, window=window))


def _best_window(model: Model[MotionDynamics], record: Record) -> int:
    """Return the window of rows that predicts one step ahead best.

    On some of the training data.
    """
    longest = max(record.experiments, key=len).rows(0, _TRIED_ROWS)
    tried = [n * (model.form.states + 1) for n in _WINDOWS]
    best, least = tried[0], np.inf
    for window in tried:
        if best != window and 4 * window > len(longest):
            break
        part = replace(record, experiments=(longest,))
        try:
            response = _with_window(model, window).predict(part)
        except InputError:  # not even one window fits
            break
        (trajectory,) = response.trajectories
        assert trajectory.measured is not None
        with np.errstate(all="ignore"):
            errors = (trajectory.model - trajectory.measured)[
                tried[-1] if len(longest) > 4 * tried[-1] else window :
            ]
            square = float(np.mean(np.sum((errors @ model.weight.T) ** 2, axis=1)))
        if square < 0.98 * least:  # a longer one only where it is clearly better
            best, least = window, square
    return best


def reopen_estimate(model: Model[MotionDynamics], record: Record) -> MotionEstimate:
    """Return the estimate of a saved model with its training data, to split again.

    It lacks the results of its training.

    Raises:
        InputError: other data than the model was trained on.
    """
    kept, form, numbers = model.trained, model.form, model.numbers
    if kept is None:
        raise InputError(
            "the model was saved without the statistics that a split needs; fit it again."
        )
    record = model.fitting(record, need_outputs=True)
    problem = pose_motion(record, form.motion, [entry.text for entry in form.features] or None)
    problem = replace(problem, weight=replace(problem.weight, matrix=model.weight))
    criterion = Simulation(kept.segment, kept.washout)
    segmented = SegmentedMotion.of(problem, form.bound, criterion).with_substeps(form.substeps)
    segmented = replace(
        segmented,
        scaling=Scaling(np.asarray(numbers.centre), np.asarray(numbers.halfwidth)),
        unit=np.asarray(numbers.gain),
    )
    if segmented.segments.count != kept.rows or np.shape(segmented.segments.start) != np.shape(
        kept.states
    ):
        raise InputError(
            f"the model was trained on other rows: {kept.rows} instead of "
            f"{segmented.segments.count}, or other experiments. Give the files and --rows of "
            "its training."
        )
    c = np.asarray(numbers.theta - numbers.theta_aux)
    return MotionEstimate(
        model=model,
        status=Status(Ending.EXACT, 0, 0.0, np.nan),
        restarts=(),
        covariance=None,
        freedom=model.statistics.freedom,
        effective_weights=np.nan,
        defect=None,
        problem=problem,
        criterion=criterion,
        split_by=MotionSplit.empty(model.measure, form, c),
        segmented=segmented,
        states=kept.states,
        slope=kept.slope,
        alone=np.asarray(kept.alone),
    )
