"""From a trained learner to an estimate: θ split from the learner, statistics, warnings.

The task's engine makes every sum over rows; no array of N rows is kept.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError, Warning
from orthaug._base.jax import jax, jnp
from orthaug.data.record import Record
from orthaug.fitting.criteria import Simulation
from orthaug.fitting.elimination import Fixed, ThetaSplit, directions, eliminate, split_theta
from orthaug.fitting.lagged_estimate import NOT_UNIQUE, LaggedEstimate
from orthaug.fitting.learned import ErrorStatistics, TrainedLearner
from orthaug.fitting.motion_estimate import MotionEstimate
from orthaug.fitting.segmented_motion import SegmentedMotion
from orthaug.fitting.silence import is_silenced, learner_silent
from orthaug.fitting.status import ALONE, Ending, Status
from orthaug.fitting.structures import Structure
from orthaug.fitting.training_rows import Share, TrainingRows
from orthaug.fitting.unfinished import (
    NOT_CONVERGED,
    ending_in_words,
    follows_training,
    is_unfinished,
    not_converged,
    withheld,
)
from orthaug.inference.covariance import degrees_of_freedom, noise_covariance, theta_covariance
from orthaug.inference.nearly_shared import enlarge_covariance
from orthaug.inference.splitting import MotionSplit
from orthaug.models.beyond import limits_of, pull_of
from orthaug.models.dynamics import Dynamics, Numbers
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.model import Model, TrainedSegments
from orthaug.models.moving import MotionDynamics
from orthaug.models.starts import EstimatedStates
from orthaug.models.statistics import JointCovariance, Statistics
from orthaug.physics import ill_conditioned
from orthaug.physics.innovations import InnovationsModel
from orthaug.physics.problem import MotionProblem, Problem, pose_motion

_UNDETERMINED = (
    "no standard errors: together with the learner's weights, the data do not determine θ to "
    "machine precision. Use more data, a smaller learner, or one with fewer inputs."
)


def conclude(task: TrainingRows, structure: Structure, learned: TrainedLearner) -> LaggedEstimate:
    """Solve θ, split it from the learner, and attach statistics.

    Args:
        task: the problem's rows, to sum over.
        learned: of these rows, or of a free run on the same problem.
    """
    problem, learns = task.problem, learned.bound.learns
    warnings: list[Warning] = []
    if is_unfinished(learned) and follows_training(structure, problem, learned):
        learned = withheld(learned)
        warnings += (
            [not_converged(learned)] if learned.tilt is None else []
        )  # longer training gives an ensemble none
    share = task.share(learned)
    finite = bool(np.isfinite(share.square) and np.isfinite(share.coordinates).all())
    ending = learned.ending if finite else Ending.NON_FINITE
    if learned.elsewhere:  # c = 0: all of the function is the learner's
        aux = problem.projection.from_coordinates(share.coordinates)
        theta, theta_aux, fixed = ThetaSplit(aux, aux, {})
    else:
        there = share.coordinates if ending.usable else 0.0 * problem.target_coordinates
        held = learned.errors.fixed if learned.errors else learned.fixed if ending.usable else None
        theta, theta_aux, fixed = split_theta(structure, problem, there, learned.coefficients, held)
    errors = learned.errors or _one_step_errors(task, structure, learned, theta - theta_aux, fixed)
    noise = errors.noise if ending.usable else None
    identified = structure.projects or (not learns and structure.identifies)
    known = noise is not None and identified and not learned.elsewhere
    warnings += [] if learned.elsewhere else learner_silent(learned)
    warnings += ill_conditioned.of_physics(
        problem, theta, errors.covariance if ending.usable else None
    )
    warnings += _warnings(problem, structure, learned, identified, noise, fixed)
    if any(warning.code == NOT_CONVERGED for warning in warnings):
        pass
    elif known and errors.covariance is None and learned.errors is None:
        text = "no standard errors: an ensemble has none where its learner sees only some features."
        warnings.append(Warning("no_standard_errors", text))
    elif (
        known
        and errors.covariance is not None
        and np.isnan(np.diag(errors.covariance)).sum() > len(fixed)
    ):
        warnings.append(Warning("no_standard_errors", _UNDETERMINED))
    model = _model(problem, structure, learned, ThetaSplit(theta, theta_aux, fixed), errors, noise)
    partly = learns and structure.projects and structure.shared != "all"
    shared = problem.shared if partly and problem.features.entries else None
    return LaggedEstimate(
        model=model,
        status=_status(learned, ending, errors, physics=not learns),
        restarts=(),
        covariance=enlarge_covariance(errors.covariance, model.statistics, shared)
        if known
        else None,
        freedom=errors.freedom,
        effective_weights=learned.effective,
        defect=_defect(task, structure, share, ThetaSplit(theta, theta_aux, fixed), learned),
        problem=problem,
        at_bound={problem.baseline.names[i]: value for i, value in fixed.items()},
        warnings=tuple(warnings),
        scores=learned.scores,
    )


def _model(
    problem: Problem,
    structure: Structure,
    learned: TrainedLearner,
    parameters: ThetaSplit,
    errors: ErrorStatistics,
    noise: Matrix | None,
) -> Model:
    scaling = learned.scaling
    numbers = (
        parameters.theta,
        parameters.theta_aux,
        learned.weights,
        scaling.centre,
        scaling.halfwidth,
        learned.unit,
    )
    middle = _middle(problem, learned, noise)
    decoupled = structure.projects and directions(structure, problem) is None
    held = {} if decoupled else parameters.fixed
    form = LaggedDynamics(
        problem.baseline, problem.features, problem.layout, problem.outputs, learned.bound
    )
    gram = None if learned.gram is None else _fix_entries(held, learned.gram)
    model = _model_of(
        problem,
        structure,
        replace(learned, gram=gram),
        errors._replace(noise=noise),
        form,
        Numbers(*numbers, learned.tilt),
        middle=None if middle is None else _fix_entries(held, middle),
    )
    return replace(
        _with_limits(model, problem.feature_range, problem.rows.x),
        shared=directions(structure, problem, parameters.fixed),
        noise=None if problem.noise is None else problem.noise.noise,
    )


def _status(
    learned: TrainedLearner, ending: Ending, errors: ErrorStatistics, *, physics: bool
) -> Status:
    """Return the status of a run; `physics` for one without a learner, or that needs one."""
    reason = ALONE.get(ending, "") if physics else ""
    reason = reason or ending_in_words(ending, learned.tail)
    spent = (learned.iterations, learned.seconds)
    return Status(ending, *spent, errors.mean_square, reason=reason)


def _model_of(
    problem: Problem | MotionProblem,
    structure: Structure,
    learned: TrainedLearner,
    errors: ErrorStatistics,
    form: Dynamics,
    numbers: Numbers,
    *,
    middle: Matrix | None,
) -> Model[Any]:
    """Return the model of a problem's record, with the statistics of its errors."""
    record = problem.record
    return Model(
        form=form,
        numbers=numbers,
        outputs=record.outputs,
        inputs=record.inputs,
        sampling_time=record.sampling_time,
        time_column=record.time_column,
        prepared=record.prepared,
        experiment_column=record.experiment_column,
        structure=structure.name,
        largest_output=problem.largest_output,
        deviation=problem.deviation,
        weight=problem.weight.matrix,
        statistics=Statistics(
            learned.gram,
            middle,
            errors.noise,
            learned.ridge,
            errors.freedom,
            simulated=learned.errors is not None,
        ),
    )


def _with_limits(model: Model[Any], seen: Matrix, points: Matrix) -> Model[Any]:
    """Return the model with the range of its features, and how points follow its limits.

    Beyond that range the correction stays constant or fades.

    Args:
        seen: features (N, nz) of training.
        points: of training, of `Model.reach`.
    """
    limits = None if model.form.beyond == "free" else limits_of(seen)
    if limits is None:
        return model
    pull = pull_of(model.form.features_of, points)
    return replace(model, numbers=model.numbers._replace(limits=limits, pull=pull))


def _one_step_errors(
    task: TrainingRows, structure: Structure, learned: TrainedLearner, c: Vector, fixed: Fixed
) -> ErrorStatistics:
    """Return the statistics of the one-step residual."""
    problem, ny = task.problem, len(task.problem.outputs)
    whitened = task.residual_gram(learned, c)
    freedom = (
        degrees_of_freedom(problem.counted, problem.freedom_used, learned.effective)
        + len(fixed) / ny
    )
    finite = bool(np.isfinite(whitened).all())
    mixed = noise_covariance(whitened, freedom) if finite else None
    noise = covariance = None
    if mixed is not None:
        noise = problem.weight.covariance(mixed)
        if not learned.bound.learns or (
            structure.projects and directions(structure, problem) is None
        ):
            middle = task.physics_middle(mixed) if ny > 1 else mixed[0, 0] * np.eye(len(c))
            covariance = theta_covariance(problem.projection, middle, fixed)
        elif structure.projects:
            covariance = _beside_the_learner(problem, structure, learned, mixed, fixed)
    mean_square = float(np.trace(whitened)) / problem.samples
    return ErrorStatistics(noise, covariance, float(freedom.min()), mean_square, fixed)


def _beside_the_learner(
    problem: Problem, structure: Structure, learned: TrainedLearner, whitened: Matrix, fixed: Fixed
) -> Matrix | None:
    """Return Cov θ̂ where only some directions are split off (F8).

    It is `K Cov(c, w) Kᵀ` with `K = [I, ∂θ_aux/∂w]`.

    Entries at a bound are no unknowns: they have NaN.
    """
    gram = learned.gram
    middle = _middle(problem, learned, problem.weight.covariance(whitened))
    if gram is None or middle is None:
        return None
    factor, taken = problem.projection, eliminate(structure, problem).taken_with_fixed(fixed)
    nt = len(taken)
    overlap = np.linalg.solve(factor.to_coordinates.T, gram[:nt, nt:])  # QᵀJ
    k = np.column_stack([np.eye(nt), factor.from_coordinates(taken @ overlap)])
    covariance = JointCovariance(
        _fix_entries(fixed, gram), learned.ridge, _fix_entries(fixed, middle), nt
    ).of(k)
    held = list(fixed)
    covariance[held] = covariance[:, held] = np.nan
    return covariance


def _fix_entries(fixed: Fixed, gram: Matrix) -> Matrix:
    """Return a Gram matrix of (c, w) in which entries at a bound are no unknowns."""
    unknown = np.ones(len(gram))
    unknown[list(fixed)] = 0.0
    return gram * np.outer(unknown, unknown)


def _middle(problem: Problem, learned: TrainedLearner, noise: Matrix | None) -> Matrix | None:
    """Return ΣψᵀΣ_eψ in whitened outputs, for intervals of later splits and predictions."""
    if noise is None or learned.gram is None:
        return None
    whitened = problem.weight.whitened(noise)
    if len(whitened) == 1:
        return whitened[0, 0] * learned.gram
    return None if learned.middle is None else learned.middle(whitened)


def _defect(
    task: TrainingRows,
    structure: Structure,
    share: Share,
    parameters: ThetaSplit,
    learned: TrainedLearner,
) -> float | None:
    """Return ‖QᵀF̃‖ / ‖F‖ with F̃ = F − Φ θ_aux (eq:orth_property), along the shared directions.

    None for F = 0.
    """
    size = np.sqrt(share.square)
    if not 0 < size < np.inf:
        return None
    along = task.problem.projection.along(directions(structure, task.problem, parameters.fixed))
    return float(np.linalg.norm(along @ task.left_share(learned, parameters.theta_aux)) / size)


def without_loss(mean_square: float) -> list[Warning]:
    """Return the warning that a free run over whole experiments has no mean square."""
    if np.isfinite(mean_square):
        return []
    text = (
        "the free run diverges over whole experiments of the training data, so it has no loss; "
        "train with longer segments, or bound the parameters that make it diverge."
    )
    return [Warning("free_run_diverges", text)]


def _warnings(
    problem: Problem,
    structure: Structure,
    learned: TrainedLearner,
    identified: bool,
    noise: Matrix | None,
    fixed: Fixed,
) -> list[Warning]:
    warnings: list[Warning] = []
    if learned.ending is Ending.SPANNED:
        text = (
            "the learner lies in the span of the physics (P⊥J = 0) and can learn nothing that "
            "the physics does not express already. Give it another form or other inputs, or "
            "leave it out."
        )
        warnings.append(Warning("learner_spanned", text))
    if learned.errors is not None:
        warnings += without_loss(learned.errors.mean_square)
    if learned.elsewhere:
        warnings.append(
            Warning("no_standard_errors", "no standard errors: the function was trained elsewhere.")
        )
    elif not identified:
        text = (
            f"θ of the {structure.name} structure is not unique (it depends on the learner's "
            "start or on the penalty), so it has no standard error; use the orthogonal "
            "structure for parameters."
        )
        warnings.append(Warning(NOT_UNIQUE, text))
    elif noise is None:
        text = (
            f"no standard errors: {problem.count} rows leave no degrees of freedom for "
            f"{len(problem.baseline.names)} parameters and {learned.effective:.1f} effective "
            "weights; use more data or a smaller learner."
        )
        warnings.append(Warning("no_degrees_of_freedom", text))
    if fixed:
        names = ", ".join(f"{problem.baseline.names[i]} = {value:g}" for i, value in fixed.items())
        text = (
            f"at a bound: {names}. A parameter at a bound is a known term, as with `fixed = "
            "true`: it has no standard error, and the other estimates hold for this value of "
            "it; "
        )
        if (
            structure.projects
            and learned.bound.learns
            and directions(structure, problem) is not None
        ):
            text += "the learner is not made orthogonal to it; "
        text += "where the data contradict a bound, the bound or the physics is wrong."
        warnings.append(Warning("at_a_bound", text))
    return warnings


_WINDOWS = (4, 16)  # times (states + 1): rows of a window to predict from
_TRIED_ROWS = 256  # at most, on which windows are compared


def conclude_motion(
    plan: SegmentedMotion,
    structure: Structure,
    learned: TrainedLearner,
    alone: Vector | None,
    *,
    briefly: bool = False,
) -> MotionEstimate:
    """Split the fitted motion and attach statistics.

    Args:
        plan: the segments that were trained on.
        learned: of these segments.
        alone: coordinates of physics alone; None where no run of it is finite.
        briefly: leave out the choice of a window to predict from and the statistics, on which no
            free run depends and which take longer than a short training. The split stays: beyond
            the data the physics goes on as it is split, and the correction fades.
    """
    problem, begins = plan.problem, alone is not None
    assert learned.coefficients is not None and learned.errors is not None
    states = plan.segments.start if learned.scores is None else learned.scores.states
    slope = None if learned.scores is None else learned.scores.followed
    unsettled = (not_converged(learned),) if is_unfinished(learned) else ()
    learned = withheld(learned) if unsettled else learned
    errors = learned.errors
    assert errors is not None and learned.coefficients is not None
    alone = np.asarray(learned.coefficients if alone is None else alone)
    layout = (plan.free_run.steps, plan.free_run.washout, plan.segments.count)
    trained = TrainedSegments(*layout, np.asarray(states), slope, alone)
    model = replace(_motion_model(plan, structure, learned, briefly), trained=trained)
    status = _status(learned, learned.ending, errors, physics=not (learned.bound.learns and begins))
    if status.reason and not (learned.ending.usable or learned.bound.learns and begins):
        if where := problem.without_value(np.any):
            status = replace(status, reason=f"{where}; correct it, or bound its parameters")
        elif problem.grows:
            grows = f"physics alone has no finite free run: {problem.grows}"
            status = replace(status, reason=grows)
    silent = learner_silent(learned, _learner_values(plan, learned))
    fit = MotionEstimate(
        model=model,
        status=status,
        restarts=(),
        covariance=None,
        freedom=errors.freedom,
        effective_weights=learned.effective,
        defect=None,
        problem=problem,
        criterion=plan.criterion,
        split_by=MotionSplit.empty("training", plan.dynamics, learned.coefficients),
        segmented=plan,
        states=states,
        slope=slope,
        alone=alone,
        scores=learned.scores,
        warnings=(*without_loss(errors.mean_square), *unsettled, *silent),
    )
    if not learned.ending.usable:
        return fit
    shared = getattr(structure, "shared", "auto")
    return fit.split_by_measure(structure.measure, shared, statistics=not briefly)


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
        features = plan.scaling(plan.dynamics.features_at(x, u))
    values = np.asarray(jax.vmap(lambda z: bound.values(jnp.asarray(learned.weights), z))(features))
    return values if np.isfinite(values).all() else None


def _motion_model(
    plan: SegmentedMotion, structure: Structure, learned: TrainedLearner, briefly: bool
) -> Model[MotionDynamics]:
    assert learned.coefficients is not None and learned.errors is not None
    noise = learned.errors.noise
    middle = None
    if noise is not None and learned.gram is not None and learned.middle is not None:
        middle = learned.middle(plan.problem.weight.whitened(noise))
    made = (plan.dynamics.plain, plan.numbers(learned.coefficients, learned.weights))
    model = replace(
        _model_of(plan.problem, structure, learned, learned.errors, *made, middle=middle),
        weight=plan.weight,
        noise=plan.predictor,
        starts=EstimatedStates(_WINDOWS[0] * (plan.dynamics.states + 1), plan.loose),
    )
    if not learned.ending.usable:
        return model
    if model.learns:
        model = _with_feature_range(model, model.reach(plan.record))
    if plan.predictor is None and not briefly:  # a predictor forgets where it began
        model = replace(model, starts=_best_starts(model, plan.record))
    return model


def _with_feature_range(model: Model[MotionDynamics], points: Matrix) -> Model[MotionDynamics]:
    """Return the model with the range of its features over the fitted run, and its limits.

    Unchanged where the features have no finite values.
    """
    with np.errstate(all="ignore"):
        features = model.form.features_of(points)
    finite = features[np.isfinite(features).all(axis=1)]
    if not finite.size:
        return model
    seen = np.stack([finite.min(axis=0), finite.max(axis=0)])
    return _with_limits(replace(model, seen=seen), seen, points)


def _best_starts(model: Model[MotionDynamics], record: Record) -> EstimatedStates:
    """Return the starts whose window predicts one step ahead best, at some rows of the data."""
    assert isinstance(model.starts, EstimatedStates)
    longest = max(record.experiments, key=len)
    tried = [n * (model.form.states + 1) for n in _WINDOWS]
    tried = [window for window in tried if window == tried[0] or 4 * window <= len(longest)]
    best, least = replace(model.starts, window=tried[0]), np.inf
    if len(longest) <= tried[-1]:
        return best
    count = min(_TRIED_ROWS, len(longest) - tried[-1])
    rows = np.linspace(tried[-1], len(longest) - 1, count).astype(int)
    for window in tried:
        starts = replace(best, window=window)
        with np.errstate(all="ignore"):
            errors = starts.errors(model, longest, record, rows) @ model.weight.T
            squares = np.sum(errors[~np.isnan(errors).any(axis=1)] ** 2, axis=1)
        if len(squares) and squares.mean() < 0.98 * least:  # longer only where clearly better
            best, least = starts, squares.mean()
    return best


def _kept_gain(model: Model[MotionDynamics]) -> InnovationsModel | None:
    """Return the noise model of a model that was trained as a predictor; None of others."""
    noise = model.noise
    return noise if isinstance(noise, InnovationsModel) and not noise.white else None


def _pad_segments(part: np.ndarray, segmented: SegmentedMotion) -> np.ndarray:
    """Return an array (…, m) of an earlier version, which padded a single segment with none."""
    width = np.shape(segmented.segments.start)[-1]
    if part is None or np.shape(part)[-1] >= width:
        return part
    room = ((0, 0),) * (np.ndim(part) - 1) + ((0, width - np.shape(part)[-1]),)
    return np.pad(part, room)


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
    segmented = SegmentedMotion.of(problem, form.bound, criterion, predictor=_kept_gain(model))
    segmented = segmented.with_substeps(form.substeps)
    segmented = replace(
        segmented,
        scaling=model.scaling,
        unit=np.asarray(numbers.gain),
    )
    states, slope = (_pad_segments(part, segmented) for part in (kept.states, kept.slope))
    if segmented.segments.count != kept.rows or np.shape(segmented.segments.start) != np.shape(
        states
    ):
        raise InputError(
            f"the model was trained on other rows: {kept.rows} instead of "
            f"{segmented.segments.count}, or other experiments. Give the files and --rows of "
            "its training."
        )
    c = np.asarray(numbers.c)
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
        states=states,
        slope=slope,
        alone=np.asarray(kept.alone),
    )
