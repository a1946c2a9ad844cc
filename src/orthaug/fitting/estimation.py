"""`estimate`: fit physics and learner to a record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypedDict, Unpack, overload

import numpy as np

from orthaug._base.checks import check_choice, check_type
from orthaug._base.errors import InputError
from orthaug._base.jax import release_programs
from orthaug._base.progress import SILENT, ProgressCallback
from orthaug._base.views import MAKERS, with_progress
from orthaug.data.record import Record
from orthaug.data.regressors import Lags
from orthaug.data.sources import Source
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.fit_plans import (
    FitPlan,
    Regularization,
    Request,
    check_blocks,
    check_regularizations,
    check_types,
    plan_for,
    plan_of,
    rows_in_memory,
)
from orthaug.fitting.kinds import CRITERIA, SOLVERS, STRUCTURES, Solver, declared_by_name
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.fitting.learned import PlannedRun
from orthaug.fitting.motion_estimate import MotionEstimate
from orthaug.fitting.noise import Noise
from orthaug.fitting.rules import (
    check_sizes,
    check_solver,
    checked_starts,
    choose_regularizations,
)
from orthaug.fitting.setup import TrainingSetup
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.structures import Orthogonal, Structure
from orthaug.fitting.training import plan_runs, train
from orthaug.models.learners import MLP, Learner, declared, learns, remembers
from orthaug.models.model import Model
from orthaug.models.rows import Engine
from orthaug.models.tasks import runs_on
from orthaug.physics.baseline import Baseline
from orthaug.physics.closed_loop import in_loop
from orthaug.physics.controller import Controller
from orthaug.physics.lags_as_states import motion_of_lags
from orthaug.physics.motion import Motion
from orthaug.physics.problem import MotionProblem, Problem
from orthaug.physics.systems import System


class Options(TypedDict, total=False):
    """The options of `estimate`, for type checkers."""

    lags: Lags | None
    learner: Learner | None
    structure: Structure | str
    criterion: Criterion | str | None
    solver: Solver | str
    regularization: Regularization | Sequence[Regularization]
    restarts: int
    seed: int
    ensemble: bool
    blocks: int
    fallback: bool
    initial: Estimate | Model | None
    validation: Record | None
    output_weights: str | Sequence[float]
    progress: ProgressCallback | bool
    engine: Engine | None
    noise: Noise
    controller: Controller | None
    standard_errors: str


@overload
def estimate(
    record: Record | Source, baseline: Baseline, **options: Unpack[Options]
) -> LaggedEstimate: ...
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
    structure: Structure | str = Orthogonal(),  # noqa: B008  (frozen)
    criterion: Criterion | str | None = None,
    solver: Solver | str = LevenbergMarquardt(),  # noqa: B008  (frozen)
    regularization: Regularization | Sequence[Regularization] = "auto",
    restarts: int = 1,
    seed: int = 0,
    ensemble: bool = False,
    blocks: int = 4,
    fallback: bool = True,
    initial: Estimate | Model | None = None,
    validation: Record | None = None,
    output_weights: str | Sequence[float] = "auto",
    progress: ProgressCallback = SILENT,
    engine: Engine | None = None,
    noise: Noise = "white",
    controller: Controller | None = None,
    standard_errors: str = "auto",
) -> Estimate:
    """Fit `y_k = φ(x_k)θ + learner(x_k) + e_k` to a record.

    The criterion is the mean square of the prediction error, or of the error of a free run.

    θ is solved, never iterated: with the orthogonal structure it is the least-squares fit of
    physics alone, whatever the learner does. Equations of motion (`Motion`) are fitted on their
    free run, and their parameters are the physics nearest to the fitted motion.

    Standard errors suit the errors of a record in memory: those for white noise, robust ones where
    errors are coloured or of uneven size, none where they are correlated over too much of the
    record. `std_kind` names them, and `plain_std` has those for white noise beside robust ones.

    Args:
        record: measured inputs and outputs; or `open_parquet(…)`, `open_frame(…)`, whose rows stay
            where they are.
        baseline: the physics; a `Motion` has no `lags` and no `ensemble`. A `System`, such as
            `HammersteinWiener(order=2)`, writes a motion for the record. Beside a learner with
            `states` a `Baseline` is fitted as the discrete motion of its lags.
        lags: the learner's regressor; None for the raw lags that the baseline's expressions use.
        learner: a declaration such as `MLP(hidden=(16,))`; None for physics alone.
        structure: `Orthogonal()`, `Additive()`, `OrthogonalPenalty(λ)` or `BaselinePenalty(λ)`.
            Structure, criterion and solver may be names as in a spec, such as "orthogonal",
            "simulation" and "adam-lbfgs", each with its defaults.
        criterion: `Prediction(horizon)`, 1 step by default, or `Simulation(segment, washout)`, the
            free run: then θ is trained with the weights, and at the end the fitted function is
            split. A motion takes the latter, by default without washout.
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
        noise: model of the errors, in memory. Of lagged physics one step ahead: "white",
            `ARMA(ar, ma)` for `y = φθ + f + (C/D) e`, "arma" for `ARMA(1, 1)`, or "auto" to choose
            the orders, white among them. Its coefficients are estimated with θ and learner by
            prediction error. With the criterion `Auto()` one step ahead is trained. Of a motion:
            "white", "innovations" or `Innovations()` for process noise and sensor noise, or "auto".
        controller: of a `Motion` that was recorded in a loop, such as `Controller.pid(…)`: its free
            run is the loop's, from the references. The record's inputs are these and what else
            drives the plant; an input that the controller sets may be one of its outputs.
        standard_errors: "auto" for those that suit the errors; "unordered" does not ask for their
            colour, for rows whose order means nothing; "plain" for those of white noise, which
            `diagnose()` replaces by those that suit.

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
    release_programs()
    check_choice(standard_errors, ("auto", "plain", "unordered"), "standard_errors")
    if isinstance(baseline, System):
        baseline = baseline.motion(rows_in_memory(record))
    if isinstance(baseline, Baseline) and remembers(learner):
        baseline, lags, learner = _as_motion(baseline, lags, learner, record)
    check_type(initial, Estimate | Model | None, "initial", "an Estimate, a Model or None")
    physics = in_loop(baseline, controller, record)
    model = initial.model if isinstance(initial, Estimate) else initial
    problem, learner, engine = plan_for(physics).pose(
        record,
        physics,
        lags=lags,
        learner=learner,
        output_weights=output_weights,
        initial=model,
        engine=engine,
    )
    made = fit(
        problem,
        learner=learner,
        structure=structure,
        criterion=criterion,
        solver=solver,
        regularization=regularization,
        restarts=restarts,
        seed=seed,
        ensemble=ensemble,
        blocks=blocks,
        fallback=fallback,
        initial=model,
        validation=validation,
        progress=progress,
        engine=engine,
        noise=noise,
    )
    if made.setup is not None:
        made = replace(made, setup=replace(made.setup, standard_errors=standard_errors))
    if standard_errors == "plain":
        return made
    return MAKERS["intervals"](made, ordered=standard_errors == "auto")


def _as_motion(
    baseline: Baseline, lags: Lags | None, learner: Any, record: Record | Source
) -> tuple[Motion, None, Learner]:
    """Return lagged physics as a motion, and a learner with states that sees the same in it."""
    outputs, inputs = ([channel.name for channel in of] for of in (record.outputs, record.inputs))
    found = motion_of_lags(baseline, lags, learner.inputs, outputs, inputs)
    for name in found.advanced:
        raise InputError(
            f"beside a learner with `states` the next sample follows from earlier ones, and "
            f"{name}[k] is a present one. Advance the input by "
            f'prepare(record, Shift("{name}", -1)), and write {name}[k-1] for {name}[k] and so on.'
        )
    return found.motion, None, replace(learner, inputs=found.learner_inputs)


@overload
def fit(problem: Problem, **options: Any) -> LaggedEstimate: ...
@overload
def fit(problem: MotionProblem, **options: Any) -> MotionEstimate: ...
def fit(problem: Problem | MotionProblem, **options: Any) -> Estimate:
    """Fit a problem that is posed already.

    Args:
        problem: record, physics and learner inputs.
        options: the fields of `Request`: the arguments of `estimate` and `checkpoints`, where the
            states of its runs are kept, to go on from. `learner` None is physics alone, on the rows
            of the problem. `engine` says where the rows are, or segments of a free run, and who
            sums over them. On a cluster several runs over rows that are in memory are tasks, each
            whole on one worker, and so are their held-out blocks.

    Raises:
        InputError: as `estimate`.
    """
    plan = plan_of(problem, _checked(Request(**options)))
    if isinstance(plan.request.criterion, str):
        plan = plan.on(replace(plan.request, criterion=plan.asked))
    plan.check()
    made = plan.by_other_fits(fit)
    made = _fit_once(plan) if made is None else made
    asked = plan.request.options(learner=plan.learner, criterion=plan.asked)
    return replace(made, setup=TrainingSetup.of(fit, problem, asked))


def _checked(request: Request) -> Request:
    """Return a request whose values are of the right types."""
    structure = declared_by_name(STRUCTURES, request.structure)
    solver = declared_by_name(SOLVERS, request.solver)
    request = replace(request, structure=structure, solver=solver)
    check_types(learner=request.learner, structure=request.structure, solver=request.solver)
    check_types(initial=request.initial, validation=request.validation)
    if request.criterion is not None:
        check_types(criterion=declared_by_name(CRITERIA, request.criterion))
    return replace(request, learner=declared(request.learner))


def _fit_once(plan: FitPlan[Any]) -> Estimate:
    """Return the estimate of one problem with one criterion."""
    problem, request, criterion = plan.problem, plan.request, plan.settled()
    blocks, validated = check_blocks(request.blocks), request.validation is not None
    learner, given = plan.learner, request.regularization
    choices = choose_regularizations(
        given,
        request.solver,
        criterion,
        request.structure,
        linear=problem.linear,
        validated=validated,
        by_evidence=plan.by_evidence,
        learner=learner,
    )
    auto = check_regularizations(given, choices, validated or blocks > 0)
    asked = {"warm": request.warm, "ensemble": request.ensemble}
    restarts, seed = checked_starts(request.restarts, request.seed, **asked)
    check_solver(request.solver, criterion, choices if learns(learner) else ())
    runs = len(choices) * (1 if request.warm else restarts)
    engine = request.engine if problem.streamed or runs == 1 else runs_on(request.engine)
    iterations, room = request.solver.iterations, engine.room()
    check_sizes(problem, learner, iterations=iterations, runs=runs, room=room)
    plan = plan.on(replace(request, criterion=criterion, blocks=blocks, engine=engine))
    prepared = plan.prepare()
    task, structure, solver = prepared.task, request.structure, request.solver
    estimate = plan.solve(task)
    if estimate is None:
        if request.initial is None:
            starts = plan_runs(task.bound, range(seed, seed + restarts), choices)
        else:
            weights = np.asarray(request.initial.numbers.weights)
            starts = [PlannedRun(0, weights, choice) for choice in choices]
        chosen = plan.choice(auto=auto)
        estimate = train(task, starts, structure, solver, chosen, request.progress, runner=engine)
    return plan.finish(estimate, prepared, fit)
