"""`estimate`: fit physics and learner to a record."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, TypedDict, Unpack, overload

import numpy as np

from orthaug._base.checks import Vector, check_choice, check_count, check_type, is_number
from orthaug._base.errors import InputError, Warning, show
from orthaug._base.progress import SILENT, ProgressCallback
from orthaug._base.views import with_progress
from orthaug.data.record import Record
from orthaug.data.regressors import Lags
from orthaug.data.sources import Source, witness
from orthaug.fitting.any_fit import AnyFit
from orthaug.fitting.checkpoints import Checkpoints
from orthaug.fitting.conclusion import conclude
from orthaug.fitting.criteria import Criterion, Prediction
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.focus import choose_focus
from orthaug.fitting.free_run import FreeRunTask
from orthaug.fitting.independent_terms import independent_terms
from orthaug.fitting.kinds import Solver
from orthaug.fitting.motion_estimates import MotionEstimate
from orthaug.fitting.motion_estimation import DEFAULT, fit_motion, pose_for
from orthaug.fitting.noise import Noise, declared_noise
from orthaug.fitting.noise_estimation import check_noise, fit_coloured
from orthaug.fitting.one_step import OneStepTask
from orthaug.fitting.rules import (
    check_no_memory,
    check_sizes,
    check_solver,
    checked_starts,
    choose_regularizations,
)
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.structures import Orthogonal, Structure
from orthaug.fitting.training import Choice, PlannedRun, plan_runs, train
from orthaug.inference.covariance import whitening_matrix
from orthaug.inference.measures import Training
from orthaug.models.learners import MLP, Learner, Scaling, declared, learns
from orthaug.models.model import Model
from orthaug.models.rows import Engine, InMemory
from orthaug.models.tasks import Tasks, runs_on
from orthaug.models.terms import over_lags, over_states
from orthaug.physics.baseline import Baseline
from orthaug.physics.motion import Motion
from orthaug.physics.output_weights import by_covariance
from orthaug.physics.problem import Problem, pose
from orthaug.physics.streamed import StreamedProblem, pose_streamed
from orthaug.physics.systems import System

_TURNS = 30
_SETTLED = 1e-6  # relative change of W


def reweight(first: Estimate, again: Callable[[Problem, Estimate], Estimate]) -> Estimate:
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
        white = None if noise is None else whitening_matrix(noise)
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


Regularization = str | float


class Options(TypedDict, total=False):
    """The options of `estimate`, for type checkers."""

    lags: Lags | None
    learner: Learner | None
    structure: Structure
    criterion: Criterion | None
    solver: Solver
    regularization: Regularization | Sequence[Regularization]
    restarts: int
    seed: int
    ensemble: bool
    blocks: int
    fallback: bool
    initial: Estimate | MotionEstimate | Model | None
    validation: Record | None
    output_weights: str | Sequence[float]
    progress: ProgressCallback | bool
    engine: Engine | None
    noise: Noise


@overload
def estimate(
    record: Record | Source, baseline: Baseline, **options: Unpack[Options]
) -> Estimate: ...
@overload
def estimate(
    record: Record, baseline: Motion | System, **options: Unpack[Options]
) -> MotionEstimate: ...
@with_progress
def estimate(
    record: Record | Source,
    baseline: Baseline | Motion | System,
    *,
    lags: Lags | None = None,
    learner: Learner | None = MLP(),  # noqa: B008  (frozen)
    structure: Structure = Orthogonal(),  # noqa: B008  (frozen)
    criterion: Criterion | None = None,
    solver: Solver = LevenbergMarquardt(),  # noqa: B008  (frozen)
    regularization: Regularization | Sequence[Regularization] = "auto",
    restarts: int = 1,
    seed: int = 0,
    ensemble: bool = False,
    blocks: int = 4,
    fallback: bool = True,
    initial: Estimate | MotionEstimate | Model | None = None,
    validation: Record | None = None,
    output_weights: str | Sequence[float] = "auto",
    progress: ProgressCallback = SILENT,
    engine: Engine | None = None,
    noise: Noise = "white",
) -> Estimate | MotionEstimate:
    """Fit `y_k = φ(x_k)θ + learner(x_k) + e_k` to a record.

    The criterion is the prediction error (eq:cost_fun), or the error of a free run.

    θ is solved, never iterated (F1): with the orthogonal structure it is `Φ⁺Y` whatever the learner
    does. Equations of motion (`Motion`) are fitted on their free run, and their parameters are the
    physics nearest to the fitted motion.

    Args:
        record: measured inputs and outputs; or `open_parquet(…)`, `open_frame(…)`, whose rows stay
            where they are.
        baseline: the physics; a `Motion` has no `lags` and no `ensemble`. A `System`, such as
            `HammersteinWiener(order=2)`, writes a motion for the record.
        lags: the learner's regressor; None for the raw lags that the baseline's expressions use.
        learner: a declaration such as `MLP(hidden=(16,))`; None for physics alone.
        structure: `Orthogonal()`, `Additive()`, `OrthogonalPenalty(λ)` or `BaselinePenalty(λ)`.
        criterion: `Prediction(horizon)`, 1 step by default, or `Simulation(segment, washout)`, the
            free run: then θ is trained with the weights and split off at the end (F2). A motion
            takes the latter, by default without washout.
        solver: `LevenbergMarquardt(…)`, or `AdamLBFGS(…)`, the paper's pipeline from θ⁰.
        regularization: "none"; "evidence" (MacKay; the weights' prior is estimated too); "ard"
            (automatic relevance determination: the prior of each neuron, one step ahead); or a
            number: the ridge α on the weights, against squared errors in units of the baseline's
            RMS residual. Several may be given with `validation` or `blocks`, which then choose.
            "auto" runs none and ard from every start, one step ahead with Levenberg-Marquardt, and
            keeps the lower generalised cross-validation; it is none otherwise, and none and
            evidence where `validation` chooses on the free run. For a motion it is evidence.
        restarts: runs from initial weights of seeds `seed … seed + restarts - 1`, spread over the
            cores. Kept is the one of the lowest error of the criterion on `validation`; without
            that, of free runs and of several regularizations, on `blocks` that are held out; else
            of the lowest generalised cross-validation under "auto", and of the lowest training loss
            otherwise.
        seed: of the initial weights.
        ensemble: the median of all restarts as one model, instead of the best one.
        blocks: parts into which the training data are cut for that, each held out once; 0 for none.
        fallback: whether physics alone is the result where no free run of the learner is better
            than its there.
        initial: warm start from an earlier estimate or model. Its learner, features, scaling and
            weights replace `learner`, `restarts` and `seed`.
        validation: a record that chooses between restarts and regularizations; it is never fitted.
        output_weights: how several outputs are weighed against each other, in criterion and measure
            alike: "none" for the plain sum of squares, as in the paper; "std" for each in its
            standard deviation; "covariance" by that of their errors, fit and weights in turn until
            they agree; numbers for the weights of the squared errors. "auto" is "std" one step
            ahead and "covariance" on the free run.
        progress: called about twice a second with (restart, iteration, loss); True for a bar.
        engine: who sums over the rows: `Stream()`, `Devices()`, `Dask(client)`; None for what suits
            the record.
        noise: model of the errors of lagged physics one step ahead, in memory: "white",
            `ARMA(ar, ma)` for `y = φθ + f + (C/D) e`, "arma" for `ARMA(1, 1)`, or "auto" to choose
            the orders, white among them. Its coefficients are estimated with θ and learner by
            prediction error. With the criterion `Auto()` one step ahead is trained.

    Raises:
        InputError: data and physics that do not fit together; RankError where θ is not determined.

    Examples:
        >>> import numpy as np
        >>> from orthaug.physics.baseline import Term
        >>> u = np.linspace(-1, 1, 200)
        >>> record = Record.from_arrays(u=u, y=2 * u + u**2)
        >>> physics = Baseline.from_terms([Term("gain", "u[k]")])
        >>> fit = estimate(record, physics, learner=MLP(hidden=(4,)))
        >>> f"{fit.theta[0]:.3f}"
        '2.000'
    """
    options: dict[str, Any] = {
        "structure": structure,
        "solver": solver,
        "regularization": regularization,
        "seed": seed,
    }
    options |= {
        "restarts": restarts,
        "fallback": fallback,
        "validation": validation,
        "progress": progress,
    }
    if isinstance(baseline, System):
        check_record(record, moves=True)
        assert isinstance(record, Record)
        baseline = baseline.motion(record)
    check_type(initial, AnyFit | Model | None, "initial", "an Estimate, a Model or None")
    model = initial.model if isinstance(initial, AnyFit) else initial
    if isinstance(baseline, Motion):
        if noise != "white":
            raise InputError(
                "a motion has white noise on its outputs; leave out `noise`, or fit the physics in "
                "its lagged form."
            )
        if lags is not None:
            raise InputError(
                "a motion has no `lags`: its learner sees states and inputs; leave them out."
            )
        if ensemble:
            raise InputError(
                "a motion has no `ensemble`: medians of outputs follow no equations of motion; "
                "leave it out."
            )
        check_record(record, moves=True)
        assert isinstance(record, Record)
        learner = over_states(learner, baseline)
        problem = pose_for(record, baseline, learner, output_weights, model)
        options |= {
            "initial": model,
            "criterion": criterion or DEFAULT,
            "blocks": _check_blocks(blocks),
            "engine": engine or InMemory(),
        }
        return fit_motion(problem, learner=learner, **options)
    check_record(record)
    _check_types(baseline=baseline, lags=lags, learner=learner)
    criterion = Prediction() if criterion is None else criterion
    if model is not None and not model.form.separates:
        raise InputError("`initial` is a motion, which has no regressor; fit anew.")
    channels = (
        tuple(channel.name for channel in group) for group in (record.outputs, record.inputs)
    )
    learner = over_lags(learner, baseline, lags, *channels)
    inputs = declared(learner).inputs
    if model is not None:
        inputs = tuple(str(entry) for entry in model.form.entries)
    _check_types(criterion=criterion)
    problem, engine = pose_source(
        record, engine, baseline, lags, inputs, output_weights=output_weights
    )
    options |= {
        "criterion": criterion,
        "ensemble": ensemble,
        "blocks": blocks,
        "initial": model,
        "engine": engine,
        "noise": noise,
    }
    return fit(problem, learner=learner, **options)


def fit(
    problem: Problem,
    *,
    learner: Learner | None = MLP(),  # noqa: B008  (frozen)
    structure: Structure = Orthogonal(),  # noqa: B008  (frozen)
    criterion: Criterion = Prediction(),  # noqa: B008  (frozen)
    solver: Solver = LevenbergMarquardt(),  # noqa: B008  (frozen)
    regularization: Regularization | Sequence[Regularization] = "auto",
    restarts: int = 1,
    seed: int = 0,
    ensemble: bool = False,
    blocks: int = 4,
    fallback: bool = True,
    initial: Model | None = None,
    validation: Record | None = None,
    progress: ProgressCallback = SILENT,
    engine: Engine = InMemory(),  # noqa: B008  (frozen)
    checkpoints: Checkpoints | None = None,
    noise: Noise = "white",
) -> Estimate:
    """Fit a problem that is posed already; arguments as of `estimate`.

    Args:
        problem: record, physics and learner inputs; the other arguments as of `estimate`.
        learner: None for physics alone, on the rows of the problem.
        engine: where the rows are, or segments of a free run, and who sums over them. On a cluster
            several runs over rows that are in memory are tasks, each whole on one worker, and so
            are their held-out blocks.
        checkpoints: where the states of its runs are kept, to go on from; None to keep none.

    Raises:
        InputError: as `estimate`.
    """
    _check_types(learner=learner, structure=structure, criterion=criterion, solver=solver)
    _check_types(initial=initial, validation=validation)
    options: dict[str, Any]
    learner = declared(learner)
    check_no_memory(learner)
    _check_splittable(structure, problem.baseline, learner)
    coloured = declared_noise(noise)
    if coloured is not None:
        check_noise(problem, solver, structure, criterion, engine, ensemble=ensemble)
        options = {
            "learner": learner,
            "structure": structure,
            "criterion": criterion,
            "solver": solver,
            "regularization": regularization,
            "restarts": restarts,
            "seed": seed,
            "blocks": blocks,
            "fallback": fallback,
            "initial": initial,
            "validation": validation,
            "progress": progress,
            "engine": engine,
        }
        return fit_coloured(problem, coloured, fit, options)
    if criterion.automatic and _may_decide(
        problem, solver, structure, warm=initial is not None, ensemble=ensemble
    ):
        options = {
            "learner": learner,
            "structure": structure,
            "solver": solver,
            "seed": seed,
        }
        options |= {
            "regularization": regularization,
            "restarts": restarts,
            "blocks": blocks,
            "fallback": fallback,
        }
        options |= {
            "validation": validation,
            "progress": progress,
            "engine": engine,
            "checkpoints": checkpoints,
        }
        return choose_focus(problem, fit, options, criterion)
    criterion = _settle(criterion, problem)
    blocks = _check_blocks(blocks)
    given = {
        "linear": problem.baseline.linear,
        "validated": validation is not None,
        "learner": learner,
    }
    choices = choose_regularizations(regularization, solver, criterion, structure, **given)
    auto = _check_regularizations(regularization, choices, validation is not None or blocks > 0)
    restarts, seed = checked_starts(restarts, seed, warm=initial is not None, ensemble=ensemble)
    check_solver(solver, criterion, choices if learns(learner) else ())
    engine = _for_runs(engine, problem, len(choices) * (restarts if initial is None else 1))
    warm, warnings = None, ()
    if initial is not None:
        task, weights, warm = _warm_start(problem, initial, engine)
        starts = [PlannedRun(0, weights, choice) for choice in choices]
    else:
        runs = restarts * len(choices)
        check_sizes(problem, learner, iterations=solver.iterations, runs=runs, room=engine.room())
        if problem.noise is None:  # a fit under a noise model has left them out already
            problem, learner, warnings = independent_terms(problem, learner)
        task = OneStepTask.of(problem, learner, engine=engine)
        starts = plan_runs(task.bound, range(seed, seed + restarts), choices)
    solved = criterion.one_step and problem.baseline.linear
    alone = not task.bound.learns
    ensemble = _check_ensemble(ensemble and not alone, problem)
    if alone and solved:
        estimate = _physics_alone(task, structure)
    else:
        # Not a worker's disk
        task = replace(task, checkpoints=None if isinstance(task.engine, Tasks) else checkpoints)
        trained = task if solved else FreeRunTask.of(task, criterion, warm)
        chosen = Choice(
            validation, blocks if initial is None else 0, fallback, ensemble, scored=auto and solved
        )
        estimate = train(trained, starts, structure, solver, chosen, progress, runner=engine)
        if _splits(structure) and estimate.status.ok and estimate.learns:
            estimate = estimate.split(structure.measure)
    estimate = replace(estimate, warnings=(*warnings, *estimate.warnings))
    if problem.weight.choice != "covariance" or problem.weight.kind == "covariance" or not solved:
        return estimate
    more = {
        "learner": learner,
        "structure": structure,
        "criterion": criterion,
        "solver": solver,
        "engine": engine,
    }
    return reweight(estimate, partial(_refit_weights, **more, progress=progress))


def _refit_weights(problem: Problem, last: Estimate, **options: Any) -> Estimate:
    """Return the fit to other weights of the outputs, from the end of the last fit."""
    chosen = next((r.regularization for r in last.restarts if r.chosen), "none")
    start = last.model if last.learns else None
    return fit(problem, initial=start, regularization=chosen, **options)


def _may_decide(
    problem: Problem, solver: Solver, structure: Structure, *, warm: bool, ensemble: bool
) -> bool:
    """Return whether the data may decide for the free run.

    They may not where only one step ahead can be trained.
    """
    able = (
        solver.gauss_newton and problem.baseline.linear and not isinstance(problem, StreamedProblem)
    )
    return able and not (warm or ensemble or structure.from_initial)


def _settle(criterion: Criterion, problem: Problem) -> Criterion:
    """Return the criterion with its open choices made for the record.

    One step ahead where nothing else can be trained.
    """
    criterion = Prediction() if criterion.automatic else criterion
    if isinstance(problem, StreamedProblem):
        return criterion.streamed
    return criterion.on(problem.record, problem.first_row)


def _for_runs(engine: Engine, problem: Problem, runs: int) -> Engine:
    """Return the engine by which several runs over rows in memory are tasks of a cluster."""
    return runs_on(engine) if runs > 1 and not isinstance(problem, StreamedProblem) else engine


def _physics_alone(task: OneStepTask, structure: Structure) -> Estimate:
    """Return physics alone, which is solved: it ends at the loss where it starts."""
    estimate = conclude(task, structure, task.physics_learned())
    return replace(estimate, status=replace(estimate.status, start_loss=estimate.status.loss))


def _check_blocks(blocks: int) -> int:
    """Return how many blocks are held out in turn.

    Raises:
        InputError: one, of which nothing would be left to train on.
    """
    blocks = check_count(blocks, "blocks", least=0)
    if blocks == 1:
        raise InputError("`blocks` must be 2 or more, or 0 for none; got 1.")
    return blocks


def _check_ensemble(ensemble: bool, problem: Problem) -> bool:
    """Return whether an ensemble is asked for, and check the request.

    Raise InputError for a median of outputs that are mixed with each other.
    """
    if ensemble and problem.weight.choice == "covariance":
        raise InputError(
            "an ensemble takes the median of each output; use `output_weights` std, none or "
            "numbers."
        )
    return ensemble


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


def _warm_start(
    problem: Problem, model: Model, engine: Engine
) -> tuple[OneStepTask, Vector, Vector]:
    """Return the task of training on from an earlier model's weights, in its scaling.

    And the model's c.
    """
    bound, numbers = model.form.bound, model.numbers
    if numbers.tilt is not None:
        raise InputError(
            "`initial` is an ensemble, which has no single weights to start from; fit anew."
        )
    if not bound.learns:
        raise InputError("`initial` is physics alone and has nothing to start from; leave it out.")
    if len(problem.outputs) != bound.ny:
        raise InputError(
            f"`initial` has {bound.ny} outputs, the record {len(problem.outputs)}; fit anew."
        )
    scaling = Scaling(np.asarray(numbers.centre), np.asarray(numbers.halfwidth))
    problem = problem.for_linear_learner() if model.form.features.linear else problem
    task = OneStepTask.of(problem, bound.learner, scaling, np.asarray(numbers.gain), engine)
    return task, np.asarray(numbers.weights), model.theta - model.theta_aux


_TYPES: dict[str, tuple[Any, str]] = {
    "baseline": (Baseline, "a Baseline or a Motion"),
    "lags": (Lags | None, "Lags(…) or None"),
    "learner": (Learner | None, "a learner such as MLP(), or None"),
    "structure": (Structure, "a structure such as Orthogonal()"),
    "criterion": (Criterion, "Prediction(…) or Simulation(…)"),
    "solver": (Solver, "a solver such as LevenbergMarquardt()"),
    "initial": (Model | None, "a Model or None"),
    "validation": (Record | None, "a Record or None"),
}


def _check_types(**given: Any) -> None:
    """Raise InputError for an argument of another type."""
    for name, value in given.items():
        kind, words = _TYPES[name]
        check_type(value, kind, name, words)


def _check_regularizations(given: Any, choices: Sequence[Any], chosen: bool) -> bool:
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


def check_record(record: Any, *, moves: bool = False) -> None:
    """Raise InputError for a record without rows, or with none in memory for a motion."""
    if not isinstance(record, Source):
        check_type(record, Record, "record", "a Record")
    elif moves and not isinstance(record, Record):
        raise InputError(
            "a motion needs its rows in memory: read them with read_record or Record.join, or "
            "fit the physics in its lagged form."
        )
