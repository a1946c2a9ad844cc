"""From a trained learner to an estimate: θ split from the learner, statistics, warnings.

The task's engine makes every sum over rows; no array of N rows is kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import Warning
from orthaug.data.record import Record
from orthaug.data.regressors import Features, Lags
from orthaug.fitting.elimination import Fixed, ThetaSplit, directions, eliminate, split_theta
from orthaug.fitting.estimates import NOT_UNIQUE, Estimate
from orthaug.fitting.learned import ErrorStatistics, TrainedLearner
from orthaug.fitting.one_step import OneStepTask
from orthaug.fitting.silence import learner_silent
from orthaug.fitting.status import ALONE, Ending, Status
from orthaug.fitting.structures import Orthogonal, Structure
from orthaug.fitting.training_rows import Share
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
from orthaug.models.beyond import limits_of, pull_of
from orthaug.models.dynamics import Numbers
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.learners import Bound, External, Function, Scaling
from orthaug.models.model import Model
from orthaug.models.statistics import JointCovariance, Statistics
from orthaug.physics import ill_conditioned
from orthaug.physics.baseline import Baseline
from orthaug.physics.problem import Problem, pose

_UNDETERMINED = (
    "no standard errors: together with the learner's weights, the data do not determine θ to "
    "machine precision. Use more data, a smaller learner, or one with fewer inputs."
)


def conclude(task: OneStepTask, structure: Structure, learned: TrainedLearner) -> Estimate:
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
    reason = ALONE.get(ending, "") if not learns else ""
    reason = reason or ending_in_words(ending, learned.tail)
    model = _model(problem, structure, learned, ThetaSplit(theta, theta_aux, fixed), errors, noise)
    partly = learns and structure.projects and structure.shared != "all"
    shared = problem.shared if partly and problem.features.entries else None
    return Estimate(
        model=model,
        status=Status(
            ending, learned.iterations, learned.seconds, errors.mean_square, reason=reason
        ),
        restarts=(),
        excitation=problem.excitation,
        covariance=enlarge_covariance(errors.covariance, model.statistics, shared)
        if known
        else None,
        freedom=errors.freedom,
        effective_weights=learned.effective,
        defect=_defect(task, structure, share, ThetaSplit(theta, theta_aux, fixed), learned),
        problem=problem,
        criterion=task.criterion,
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
    record, scaling = problem.record, learned.scaling
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
    limits, pull = _limits(problem, form)
    return Model(
        form=form,
        numbers=Numbers(*numbers, learned.tilt, limits=limits, pull=pull),
        outputs=record.outputs,
        inputs=record.inputs,
        sampling_time=record.sampling_time,
        time_column=record.time_column,
        prepared=record.prepared,
        structure=structure.name,
        largest_output=problem.largest_output,
        deviation=problem.deviation,
        weight=problem.weight.matrix,
        shared=directions(structure, problem, parameters.fixed),
        noise=None if problem.noise is None else problem.noise.noise,
        statistics=Statistics(
            None if learned.gram is None else _fix_entries(held, learned.gram),
            None if middle is None else _fix_entries(held, middle),
            noise,
            learned.ridge,
            errors.freedom,
            learned.errors is not None,
        ),
    )


def _limits(problem: Problem, form: LaggedDynamics) -> tuple[Matrix | None, Matrix | None]:
    """Return the range of the features, and how x follows its limits.

    Beyond the range the correction stays constant or fades.
    """
    limits = None if form.beyond == "free" else limits_of(problem.feature_range)
    if limits is None:
        return None, None
    return limits, pull_of(
        lambda x: np.asarray(form.features.evaluate(x, form.layout, np)), problem.rows.x
    )


def _one_step_errors(
    task: OneStepTask, structure: Structure, learned: TrainedLearner, c: Vector, fixed: Fixed
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
    task: OneStepTask,
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
        warnings.append(Warning("no_standard_errors", text))
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


def orthogonalize(
    record: Record, baseline: Baseline, function: Callable[[Any], Any], lags: Lags | None = None
) -> Estimate:
    """Split a model trained elsewhere into physics and an orthogonal rest (F2).

    Args:
        record: the rows over which the rest is made orthogonal, usually the training data.
        baseline: the physics.
        function: `g(x)` on NumPy regressors (N, nx) in `Lags` order, giving (N, ny); from any
            toolbox.
        lags: the regressor that `function` expects; None for the raw lags of the baseline.

    Returns:
        An estimate whose model predicts what `function` does, with `θ = Φ⁺G` and the learner `g −
        φθ`. There are no standard errors: they belong to how `function` was trained.
    """
    problem = pose(record, baseline, lags)
    ny, nz = len(problem.outputs), len(problem.features.entries)
    external = External(function, ny=ny)
    values = external.values(problem.feature_rows())  # once; the sums below read what it gave
    scaling, unit = Scaling(np.zeros(nz), np.ones(nz)), np.ones(ny)
    task = OneStepTask.of(replace(problem, features=Features(())), None)
    gain = np.broadcast_to(problem.weight.matrix / task.rms, (*values.shape, ny))
    rows = task.engine.build_rows(
        values, problem.projection.q, problem.unexplained / task.rms, gain
    )
    task = replace(task, problem=problem, rows=rows, unit=unit, bound=Bound(_GIVEN, ny, ny))
    concluded = conclude(
        task, Orthogonal(), TrainedLearner(task.bound, np.zeros(0), scaling, unit, elsewhere=True)
    )
    form = replace(concluded.model.form, bound=Bound(external, nz, ny))
    return replace(concluded, model=replace(concluded.model, form=form))


_GIVEN = Function(lambda w, z: z, lambda key: (), beyond="free")
"""The learner whose values are its features."""
