"""The one verb: fit physics and learner to a record."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from orthaug._base.checks import Vector, check_choice, check_count, check_type
from orthaug._base.errors import InputError
from orthaug._base.jax import jax, jnp
from orthaug._base.parallel import spread
from orthaug.data.record import Record
from orthaug.data.regressors import Lags
from orthaug.fitting.conclusion import conclude, nothing_learned
from orthaug.fitting.criteria import Criterion, Prediction
from orthaug.fitting.ensemble import combine
from orthaug.fitting.estimates import Estimate, Restart
from orthaug.fitting.free_run import FreeRun
from orthaug.fitting.learned import Learned
from orthaug.fitting.one_step import Task
from orthaug.fitting.rules import check_solver, check_starts
from orthaug.fitting.solvers.levenberg_marquardt import (
    CONVERGED,
    NO_DESCENT,
    NON_FINITE,
    RUNNING,
    SPANNED,
    LevenbergMarquardt,
)
from orthaug.fitting.solvers.solver import Solver
from orthaug.fitting.status import Status
from orthaug.fitting.structures import Orthogonal, Structure
from orthaug.inference.measures import Training
from orthaug.models.learners import MLP, Bound, External, Learner, Scaling
from orthaug.models.model import Model
from orthaug.physics.baseline import Baseline
from orthaug.physics.problem import pose

_CODES = {
    RUNNING: "iteration_limit",
    CONVERGED: "converged",
    SPANNED: "converged",
    NO_DESCENT: "no_descent",
    NON_FINITE: "non_finite",
}

Regularization = str | float
Progress = Callable[[int, int, float], None]
"""Called now and then with the number of the restart, the iteration and the loss."""


def estimate(
    record: Record,
    baseline: Baseline,
    *,
    lags: Lags | None = None,
    learner: Learner | None = MLP(),  # noqa: B008  (frozen)
    structure: Structure = Orthogonal(),  # noqa: B008  (frozen)
    criterion: Criterion = Prediction(),  # noqa: B008  (frozen)
    solver: Solver = LevenbergMarquardt(),  # noqa: B008  (frozen)
    regularization: Regularization | Sequence[Regularization] = "none",
    restarts: int = 1,
    seed: int = 0,
    ensemble: bool = False,
    initial: Estimate | Model | None = None,
    validation: Record | None = None,
    progress: Progress | None = None,
) -> Estimate:
    """Fit `y_k = φ(x_k)θ + learner(x_k) + e_k` by prediction error (eq:cost_fun) or by the error of a free run.

    θ is solved, never iterated (F1): with the orthogonal structure it is `Φ⁺Y` whatever the learner does.

    Args:
        record: measured inputs and outputs.
        baseline: the physics.
        lags: the learner's regressor; None for the raw lags that the baseline's expressions use.
        learner: a declaration such as `MLP(hidden=(16,))`; None for physics alone.
        structure: `Orthogonal()`, `Additive()`, `OrthogonalPenalty(λ)` or `BaselinePenalty(λ)`.
        criterion: `Prediction(horizon)`, 1 step by default, or `Simulation(segment, washout)`, the free run: then θ is
            trained with the weights and split off at the end (F2).
        solver: `LevenbergMarquardt(…)`, or `AdamLBFGS(…)`, the paper's pipeline from θ⁰.
        regularization: "none", "evidence" (MacKay; the weights' prior is estimated too), or a number: the
            ridge α on the weights, against squared errors in units of the baseline's RMS residual. Several, if
            `validation` is there to choose.
        restarts: runs from initial weights of seeds `seed … seed + restarts - 1`, spread over the cores; the lowest
            training loss is kept, or with `validation` the lowest error there, one-step or of the free run as trained.
        seed: of the initial weights.
        ensemble: the median of all restarts as one model, instead of the best one.
        initial: warm start from an earlier estimate or model: its learner, features, scaling and weights take
            the place of `learner`, `restarts` and `seed`.
        validation: a record that chooses between restarts and regularizations; it is never fitted.
        progress: called about twice a second with (restart, iteration, loss).

    Raises:
        InputError: data and physics that do not fit together; RankError where θ is not determined.

    Examples:
        >>> import numpy as np
        >>> from orthaug.baseline import Term
        >>> u = np.linspace(-1, 1, 200)
        >>> record = Record.from_arrays(u=u, y=2 * u + u**2)
        >>> fit = estimate(record, Baseline.from_terms([Term("gain", "u[k]")]), learner=MLP(hidden=(4,)))
        >>> f"{fit.theta[0]:.3f}"
        '2.000'
    """
    _check_arguments(record, baseline, lags, learner, structure, criterion, solver, initial, validation)
    _check_splittable(structure, baseline, learner)
    flown = criterion.flown is not None
    choices = _regularizations(regularization, validation)
    restarts, seed = check_count(restarts, "restarts"), check_count(seed, "seed", least=0)
    check_starts(restarts if initial is None else 1, seed, ensemble=ensemble)
    check_solver(solver, criterion, () if learner is None else choices)
    if initial is not None:
        task, w, start = _warm_start(record, baseline, lags, initial)
        starts = [_Start(0, w, choice) for choice in choices]
        place = FreeRun.of(task.problem, task, criterion, start) if flown else task
        return _train(place, starts, structure, solver, validation, progress)
    problem = pose(record, baseline, lags, None if learner is None else learner.inputs)
    if learner is None and not flown:
        return conclude(problem, structure, nothing_learned(problem), Status("exact", 0, 0.0, np.nan))
    if learner is None:
        place = FreeRun.of(problem, None, criterion)
        return _train(place, [_Start(seed, np.zeros(0), "none")], structure, solver, validation, progress)
    task = Task.of(problem, learner)
    weights = {s: task.bound.init(jax.random.key(s)) for s in range(seed, seed + restarts)}
    starts = [_Start(s, w, choice) for choice in choices for s, w in weights.items()]
    place = FreeRun.of(problem, task, criterion) if flown else task
    return _train(place, starts, structure, solver, validation, progress, ensemble)


def _check_splittable(structure: Structure, baseline: Baseline, learner: Learner | None) -> None:
    """Raise InputError for bounds on a θ that is split off after training."""
    if not _splits(structure) or learner is None:
        return
    bounded = [p.name for p in baseline.parameters if np.isfinite(p.min) or np.isfinite(p.max)]
    if bounded:
        raise InputError(
            f"{', '.join(bounded)} have bounds, which hold under the training measure only: under another one θ is "
            "split off after training. Drop the bounds or the measure."
        )


def _splits(structure: Structure) -> bool:
    """Whether θ is split off under another measure than that of training."""
    return structure.measure != Training()


def orthogonalize(
    record: Record, baseline: Baseline, function: Callable[[Any], Any], lags: Lags | None = None
) -> Estimate:
    """Split a model trained elsewhere into physics and an orthogonal rest (F2).

    Args:
        record: the rows over which the rest is made orthogonal, usually the training data.
        baseline: the physics.
        function: `g(x)` on NumPy regressors (N, nx) in `Lags` order, giving (N, ny); from any toolbox.
        lags: the regressor that `function` expects; None for the raw lags of the baseline.

    Returns:
        An estimate whose model predicts what `function` does, with `θ = Φ⁺G` and the learner `g − φθ`.
        There are no standard errors: they belong to how `function` was trained.
    """
    problem = pose(record, baseline, lags)
    ny, nz = len(problem.outputs), len(problem.features.entries)
    external = External(function, ny=ny)
    bound = Bound(external, nz, ny)
    values = external.values(problem.feature_rows())
    scaling = Scaling(np.zeros(nz), np.ones(nz))
    learned = Learned(bound, np.zeros(0), scaling, np.ones(ny), values, elsewhere=True)
    return conclude(problem, Orthogonal(), learned, Status("exact", 0, 0.0, np.nan))


def _warm_start(
    record: Record, baseline: Baseline, lags: Lags | None, initial: Estimate | Model
) -> tuple[Task, Float[Array, "nw"], Vector]:
    """The task of going on from an earlier model's weights, in its scaling; and the model's c."""
    model = initial.model if isinstance(initial, Estimate) else initial
    bound, numbers = model.form.bound, model.numbers
    if numbers.tilt is not None:
        raise InputError("`initial` is an ensemble, which has no single weights to start from; fit anew.")
    if bound is None:
        raise InputError("`initial` is physics alone and has nothing to start from; leave it out.")
    problem = pose(record, baseline, lags, tuple(str(entry) for entry in model.form.features.entries))
    if len(problem.outputs) != bound.ny:
        raise InputError(f"`initial` has {bound.ny} outputs, the record {len(problem.outputs)}; fit anew.")
    scaling = Scaling(np.asarray(numbers.centre), np.asarray(numbers.halfwidth))
    task = Task.of(problem, bound.learner, scaling, np.asarray(numbers.gain))
    return task, jnp.asarray(numbers.weights), model.theta - model.theta_aux


@dataclass(frozen=True, eq=False)
class _Start:
    """One run to be made: its seed, initial weights and regularization."""

    seed: int
    weights: Any
    regularization: Regularization


def _train(
    task: Task | FreeRun,
    starts: Sequence[_Start],
    structure: Structure,
    solver: Solver,
    validation: Record | None,
    progress: Progress | None,
    ensemble: bool = False,
) -> Estimate:
    """Run from every start and conclude with the best, by training loss or by the criterion's validation error."""

    def one(numbered: tuple[int, _Start], check: Callable[[], None]) -> Any:
        i, start = numbered

        def tell(iteration: int, loss: float) -> None:
            check()
            if progress is not None:
                progress(i, iteration, loss)

        return task.run(solver, start.weights, structure, start.regularization, tell)  # type: ignore[arg-type]

    criterion = task.declared if isinstance(task, FreeRun) else Prediction()
    runs = spread(one, list(enumerate(starts)))
    losses = [task.loss(run) for run in runs]
    concluded, errors = {}, [math.nan] * len(runs)
    if validation is not None:
        concluded = {i: _concluded(task, structure, run) for i, run in enumerate(runs)}
        errors = [_validation_error(fit, validation, criterion) for fit in concluded.values()]
    ranking = np.array(losses if validation is None else errors)
    best = int(np.nanargmin(ranking)) if np.isfinite(ranking).any() else 0
    if ensemble:
        members = [i for i, run in enumerate(runs) if starts[i].regularization == starts[best].regularization]
        fit = _concluded(task, structure, runs[best], [runs[i] for i in members])
    else:
        members = [best]
        fit = concluded[best] if validation is not None else _concluded(task, structure, runs[best])
    restarts = tuple(
        Restart(
            seed=start.seed,
            loss=_finite(losses[i]),
            iterations=run.iterations,
            code=_CODES[run.code],
            chosen=i in members,
            regularization=start.regularization,
            validation=_finite(errors[i]),
        )
        for i, (start, run) in enumerate(zip(starts, runs, strict=True))
    )
    seconds = sum(run.seconds for run in runs)
    fit = replace(fit, criterion=criterion, restarts=restarts, status=replace(fit.status, seconds=seconds))
    split_off = _splits(structure) and fit.status.ok and task.bound is not None
    return fit.split(structure.measure) if split_off else fit


def _concluded(task: Task | FreeRun, structure: Structure, run: Any, members: Sequence[Any] = ()) -> Estimate:
    """The estimate that a run leads to, or the median of several `members` with it as the best one."""
    learned = task.learned(run)
    if members:
        found = [learned if member is run else task.learned(member) for member in members]
        found = [one for one in found if np.isfinite(one.values).all()]
        learned = combine(task, found, found.index(learned)) if learned in found else learned
    code = _CODES[run.code] if np.isfinite(learned.values).all() else "non_finite"
    return conclude(task.problem, structure, learned, Status(code, run.iterations, run.seconds, np.nan))


def _validation_error(fit: Estimate, validation: Record, criterion: Criterion) -> float:
    """Mean squared error with each output in its training standard deviation; NaN without a model or a value."""
    if not fit.status.ok:
        return math.nan
    rmse = criterion.response(fit.model, validation).scores().rmse
    return float(np.mean((rmse * fit.problem.weight) ** 2))


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _check_arguments(
    record: Any,
    baseline: Any,
    lags: Any,
    learner: Any,
    structure: Any,
    criterion: Any,
    solver: Any,
    initial: Any,
    validation: Any,
) -> None:
    check_type(record, Record, "record", "a Record")
    check_type(baseline, Baseline, "baseline", "a Baseline")
    check_type(lags, Lags | None, "lags", "Lags(…) or None")
    check_type(learner, Learner | None, "learner", "a learner such as MLP(), or None")
    check_type(structure, Structure, "structure", "a structure such as Orthogonal()")
    check_type(criterion, Criterion, "criterion", "Prediction(…) or Simulation(…)")
    check_type(solver, Solver, "solver", "a solver such as LevenbergMarquardt()")
    check_type(initial, Estimate | Model | None, "initial", "an Estimate, a Model or None")
    check_type(validation, Record | None, "validation", "a Record or None")


def _regularizations(given: Any, validation: Record | None) -> tuple[Regularization, ...]:
    """The regularizations to try, each checked."""
    choices = tuple(given) if isinstance(given, list | tuple) else (given,)
    if len(choices) > 1 and validation is None:
        raise InputError("several regularizations need `validation` to choose between them.")
    for choice in choices:
        if isinstance(choice, str):
            check_choice(choice, ("none", "evidence"), "`regularization`")
        elif isinstance(choice, bool) or not isinstance(choice, int | float | np.number):
            raise InputError(f"`regularization` must be none, evidence or a number; got {choice!r}.")
        elif not (np.isfinite(choice) and choice >= 0):
            raise InputError(f"`regularization` must be 0 or more; got {choice}.")
    if not choices:
        raise InputError("`regularization` is empty; give none, evidence or a number.")
    return choices
