"""Runs from every start, the choice between them, and the fallback to physics alone."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np

from orthaug._base.checks import Vector, finite_or_none
from orthaug._base.errors import InputError, Warning
from orthaug._base.jax import jax
from orthaug._base.lines import plural
from orthaug._base.parallel import Threads, one_blas_thread
from orthaug._base.progress import LOG, ProgressCallback, Stage, show_model, watch_run
from orthaug.data.record import Record
from orthaug.fitting.estimates import Estimate, Restart
from orthaug.fitting.held_out import (
    WORTH,
    HeldOutErrors,
    Pieces,
    covered_folds,
    mean_square,
    squared_errors,
)
from orthaug.fitting.kinds import Solver
from orthaug.fitting.learned import FinishedRun, PlannedRun, Task, TrainedLearner
from orthaug.fitting.one_step import OneStepTask
from orthaug.fitting.setup import FOLD_ITERATIONS
from orthaug.fitting.silence import (
    add_retries,
    fold_ridges,
    is_silenced,
    retry_warnings,
    stand_ins,
)
from orthaug.fitting.status import Ending
from orthaug.fitting.structures import Orthogonal, Structure
from orthaug.models.learners import Bound
from orthaug.models.model import Model
from orthaug.models.rows import Engine

# of the effective weights in cross-validation, against following the noise (Kim and Gu 2004)
_INFLATION = 1.4
# rows · parameters · iterations of free runs on one block: about 2 s on one core
_FOLD_WORK = 2.5e7
_CLEARLY = 0.5  # of a mean square: less than this is clearly lower


def fold_solver(
    solver: Solver, rows: int, parameters: int, *, free_run: bool, taken: int | None = None
) -> Solver:
    """Return the solver for the fit to a block of cross-validation.

    A free run begins at physics alone and may need more iterations than one step ahead until its
    learner is worth judging; small problems get them, up to the solver's own limit.

    Args:
        rows: training rows of the block.
        parameters: of physics and learner together.
        free_run: whether the fit is to the free run.
        taken: iterations of the runs on all rows: a fold gets no more. None where that is unknown.
    """
    affordable = int(_FOLD_WORK / max(rows * parameters, 1)) if free_run else 0
    affordable = affordable if taken is None else min(affordable, taken)
    return solver.at_most(max(FOLD_ITERATIONS, affordable))


def plan_runs(bound: Bound, seeds: range, choices: Sequence[str | float]) -> list[PlannedRun]:
    """Return a run from every seed with every regularization; one without a learner."""
    if not bound.learns:
        return [PlannedRun(seeds.start, np.zeros(0), "none")]
    keyed = {seed: bound.init(jax.random.key(seed)) for seed in seeds}
    return [PlannedRun(seed, w, choice) for choice in choices for seed, w in keyed.items()]


@dataclass(frozen=True, eq=False)
class Choice:
    """Choice between runs by held-out errors or by the lowest loss.

    Held-out rows are a `validation` record, or `blocks` of the training data.

    With `scored` and without `validation` it is the lowest generalised cross-validation instead,
    one step ahead.

    With `fallback` the result is physics alone where no free run is better there. An `ensemble`
    takes them all.
    """

    validation: Record | None = None
    blocks: int = 0
    fallback: bool = True
    ensemble: bool = False
    scored: bool = False
    retry: bool = False
    """True if runs that evidence silenced are made again with weaker regularizations, if held-out
    rows can choose.
    """
    briefly: bool = False
    """True if the chosen run only has to simulate."""

    def compares(self, task: Task, starts: Sequence[PlannedRun]) -> bool:
        """Return whether held-out errors choose between runs or regularizations.

        They can where runs are finite, or regularizations are several.
        """
        several = len({start.regularization for start in starts}) > 1
        return task.bound.learns and (
            task.criterion.free_run is not None or (several and not self.scored)
        )

    def ranking(
        self, task: Task, runs: Sequence[FinishedRun], errors: Sequence[float]
    ) -> np.ndarray:
        """Return the value that is lowest for the best run: held-out error, score, or loss.

        On blocks other runs of its kind were judged: one that ended higher on its own data than
        they did on what they had not seen failed to train, and its loss counts.
        """
        losses = np.array([task.loss(run) for run in runs])
        if np.isfinite(errors).any():
            return np.array(errors) if self.validation is not None else np.maximum(errors, losses)
        scores = np.array([_cross_validation(task, run) for run in runs] if self.scored else [])
        return scores if np.isfinite(scores).any() else losses


def train(
    task: Task,
    starts: Sequence[PlannedRun],
    structure: Structure,
    solver: Solver,
    choice: Choice,
    progress: ProgressCallback,
    runner: Engine | Threads = Threads(),  # noqa: B008  (it holds nothing)
) -> Estimate:
    """Run from every start and conclude with the best.

    Args:
        runner: makes the runs, and those on held-out blocks; an `Engine`, or `Threads()`.
    """
    with one_blas_thread():
        task = task.prepare(solver, structure, partial(progress, 0))
    alone = partial(_physics_to_compare, task, structure)
    show_model("physics alone", alone, task.problem.record)
    LOG.info("training: %d runs of %s, %s", len(starts), type(solver).__name__, structure.name)
    planned, (starts, runs) = (
        len(starts),
        _run_all(task, starts, structure, solver, choice, progress, runner),
    )
    losses = [task.loss(run) for run in runs]
    briefly = choice.briefly
    concluded = cache(lambda i: task.conclude(structure, task.learned(runs[i]), briefly=briefly))
    stopped = sum(run.ending is Ending.STOPPED for run in runs)
    untried = bool(
        stopped and choice.validation is None and choice.blocks and choice.compares(task, starts)
    )
    if untried:  # who asks to end does not wait for runs on held-out blocks
        choice = replace(choice, blocks=0)
    Stage.CHOICE.enter()
    held_out = _held_out(task, starts, runs, concluded, structure, solver, choice, runner)
    errors = (
        [math.nan] * len(runs) if held_out is None else [mean_square(run) for run in held_out.runs]
    )
    ranking = choice.ranking(task, runs, errors)
    usable = np.array([run.ending.usable for run in runs]) & np.isfinite(ranking)
    ranking_of_usable = np.where(usable, ranking, np.inf)
    best = int(np.argmin(ranking_of_usable))
    if np.isfinite(errors).any():
        best = _converged_beside(best, runs, ranking_of_usable)
    replacing = []
    if held_out is not None:
        held_out = replace(held_out, chosen=best)
        runs_freely = task.criterion.free_run is not None and task.start_loss is not None
        replaces = choice.fallback and task.bound.learns and runs_freely
        fails = choice.validation is None and _physics_fails(
            held_out, float(ranking[best]), task.start_loss
        )
        if replaces and not (held_out.ratio.value < 1 or fails):
            replacing, best = [_fell_back(held_out)], -1
            LOG.info(
                "no free run is better than physics alone on held-out rows: the result is "
                "physics alone"
            )
    LOG.info("run %d of %d is chosen; 0 is physics alone", best + 1, len(runs))
    same = [i for i, one in enumerate(starts) if one.regularization == starts[best].regularization]
    alike = _members(starts, ranking, best) if choice.scored else same
    shown = alike if choice.scored and held_out is None else list(range(len(starts)))
    members = [best]
    if best < 0:
        estimate = _conclude_physics(task, structure, briefly=briefly)
    elif choice.ensemble:
        members = alike
        estimate = task.conclude(structure, _median(task, runs, members, best))
    elif briefly:
        estimate = concluded(best)
    else:
        finer, run = task.refined(runs[best], solver, structure)
        kept = run is runs[best]
        estimate = concluded(best) if kept else finer.conclude(structure, finer.learned(run))
        runs[best], losses[best] = run, finer.loss(run)
    scored = choice.scored and held_out is None
    scores = [_cross_validation(task, run) if scored else math.nan for run in runs]
    results = list(zip(starts, runs, losses, errors, scores, strict=True))
    restarts = tuple(_restart(*results[i], chosen=i in members) for i in shown)
    seconds = task.seconds + sum(run.seconds for run in runs)
    status = replace(estimate.status, seconds=seconds, start_loss=task.start_loss)
    warnings = (
        *estimate.warnings,
        *task.warnings,
        *_replacement_warnings(starts, runs),
        *_stop_warnings(stopped, len(runs), untried),
        *replacing,
        *retry_warnings(planned, starts, runs, held_out, best),
    )
    beside = _physics_to_compare(task, structure) if best >= 0 and not briefly else None
    found = {"restarts": restarts, "status": status, "held_out": held_out, "physics_alone": beside}
    return replace(estimate, **found, warnings=warnings)


def _converged_beside(best: int, runs: Sequence[FinishedRun], errors: np.ndarray) -> int:
    """Return the best run by mean squares, or one that converged where it is hardly worse.

    A run that stopped at its limit has parameters without intervals.
    """
    if runs[best].ending is not Ending.RUNNING:
        return best
    ended = np.array([run.ending is not Ending.RUNNING for run in runs])
    others = np.where(ended, errors, np.inf)
    other = int(np.argmin(others))
    return other if others[other] <= (1 + WORTH) ** 2 * errors[best] else best


def _physics_fails(held_out: HeldOutErrors, own: float, alone: float | None) -> bool:
    """Return whether physics alone is far off its own data where blocks do not decide.

    The errors of an oscillation grow along a run, and a block is short. Where the learner's is
    clearly lower on rows that it was not fitted to, physics alone is no result to prefer.

    Args:
        own: loss of the chosen run, or its error on blocks where that is higher.
        alone: loss of physics alone.
    """
    return alone is not None and held_out.ratio.low < 1 and own < _CLEARLY * alone


def _physics_to_compare(task: Task, structure: Structure) -> Estimate | None:
    """Return the estimate of physics alone, to compare with that of a learner.

    It is least squares one step ahead, also where θ has a penalty. None without a learner, and
    where it costs a pass.
    """
    if not task.bound.learns or hasattr(task.problem, "source"):
        return None
    plain = task.criterion.one_step and not structure.projects
    return _conclude_physics(task, Orthogonal() if plain else structure)


def _restart(
    start: PlannedRun,
    run: FinishedRun,
    loss: float,
    error: float,
    score: float,
    *,
    chosen: bool,
) -> Restart:
    return Restart(
        seed=start.seed,
        loss=finite_or_none(loss),
        iterations=run.iterations,
        code=run.ending.code,
        chosen=chosen,
        regularization=start.regularization,
        validation=finite_or_none(error),
        score=finite_or_none(score),
    )


def _cross_validation(task: Task, run: FinishedRun) -> float:
    """Return the score `N RSS / (N − nθ − 1.4 γ)²` of a run one step ahead (generalised).

    Infinite where it uses up all rows.
    """
    samples = task.problem.samples
    left = samples - len(task.problem.names) - _INFLATION * run.effective
    return task.loss(run) * (samples / left) ** 2 if left > 0 else math.inf


def _members(starts: Sequence[PlannedRun], ranking: np.ndarray, best: int) -> list[int]:
    """Return the best run from every seed."""
    seeds = dict.fromkeys(start.seed for start in starts)
    ranking = np.where(np.isfinite(ranking), ranking, np.inf)
    own = {seed: [i for i, start in enumerate(starts) if start.seed == seed] for seed in seeds}
    return [best if best in runs else min(runs, key=lambda i: ranking[i]) for runs in own.values()]


def _run_all(
    task: Task,
    starts: Sequence[PlannedRun],
    structure: Structure,
    solver: Solver,
    choice: Choice,
    progress: ProgressCallback,
    runner: Engine | Threads,
) -> tuple[list[PlannedRun], list[FinishedRun]]:
    """Make every planned run, and weaker regularizations where evidence silenced the learner.

    The latter only where held-out rows can choose.
    """
    begun, runs = _run(task, starts, structure, solver, progress, runner)
    if not choice.retry or (choice.validation is None and not choice.blocks):
        return begun, runs

    def run_again(
        planned: list[PlannedRun], most: int | None
    ) -> tuple[list[PlannedRun], list[FinishedRun]]:
        allowed = solver if most is None else solver.at_most(most)
        return _run(
            task, planned, structure, allowed, lambda i, *at: progress(len(begun) + i, *at), runner
        )

    return add_retries(begun, runs, task, run_again)


def _run(
    task: Task,
    starts: Sequence[PlannedRun],
    structure: Structure,
    solver: Solver,
    progress: ProgressCallback,
    runner: Engine | Threads,
) -> tuple[list[PlannedRun], list[FinishedRun]]:
    """Return every planned run; one that fails is made again from the seeds that follow."""
    made, record = list(starts), task.problem.record
    given = (task, solver, structure, made[0])
    runs: list[Any] = []
    for run in runner.map(_one_run, given, made, progress):
        runs.append(run)
        if task.loss(run) <= min(map(task.loss, runs)) and not hasattr(task.problem, "source"):
            show_model(structure.name, partial(_conclude_briefly, task, structure, run), record)
    for i, (start, run) in enumerate(zip(made, runs, strict=True), 1):
        figures = (i, start.seed, run.ending.code, run.iterations, task.loss(run), run.seconds)
        LOG.info("run %d, seed %d: %s after %d iterations, loss %.4g, %.2f s", *figures)
    failed = [start for start, run in zip(made, runs, strict=True) if not run.ending.usable]
    if not failed or len(failed) == len(made):  # where all fail the data or the learner are bad
        return made, runs
    following = max(start.seed for start in made) + 1
    bound = task.bound
    LOG.debug(
        "%d runs failed and are made again from the seeds after %d", len(failed), following - 1
    )
    again = [
        start._replace(seed=seed, weights=bound.init(jax.random.key(seed)))
        for seed, start in enumerate(failed, following)
    ]
    more = runner.map(_one_run, given, again, lambda i, *at: progress(len(made) + i, *at))
    return made + again, runs + list(more)


def _conclude_briefly(task: Task, structure: Structure, run: object) -> Estimate:
    return task.conclude(structure, task.learned(run), briefly=True)


def _one_run(
    given: tuple[Task, Solver, Structure, PlannedRun],
    start: PlannedRun,
    report: Callable[..., None],
) -> FinishedRun:
    """Make a run; the first shows its model until it ends."""
    task, solver, structure, first = given
    show = watch_run(structure.name, task.problem.record) if start is first else None
    watched = show and (lambda run: show(lambda: _conclude_briefly(task, structure, run())))
    return task.run(solver, start.weights, structure, start.regularization, report, watched)


def _replacement_warnings(
    starts: Sequence[PlannedRun], runs: Sequence[FinishedRun]
) -> list[Warning]:
    failed = [
        str(start.seed) for start, run in zip(starts, runs, strict=True) if not run.ending.usable
    ]
    if not failed or len(failed) == len(runs):
        return []
    text = (
        f"training failed from seed {', '.join(failed)} and was made again from the seeds "
        "after the last one."
    )
    return [Warning("start_replaced", text)]


def _stop_warnings(count: int, runs: int, untried: bool) -> list[Warning]:
    if not count:
        return []
    text = f"training was stopped on request: {count} of {plural(runs, 'run')} had not ended"
    text += ", and none was tried on held-out blocks" if untried else ""
    return [
        Warning(
            "stopped", f"{text}; the best run so far is kept. Training to the end may improve it."
        )
    ]


def _held_out(
    task: Task,
    starts: Sequence[PlannedRun],
    runs: Sequence[FinishedRun],
    concluded: Callable[[int], Estimate],
    structure: Structure,
    solver: Solver,
    choice: Choice,
    runner: Engine | Threads,
) -> HeldOutErrors | None:
    """Return held-out errors: of runs on the validation record, or of runs on folds.

    `concluded` gives the estimate of a run by its number.
    """
    if not task.bound.learns and len(runs) == 1:  # nothing to choose, and no learner to judge
        return None
    if choice.validation is not None:
        record, unit = choice.validation, task.problem.deviation
        fits = [concluded(i) for i in range(len(starts))]
        alone = _errors(_conclude_physics(task, structure), record, unit)
        labels = ("the validation part",) * len(record.experiments)
        return HeldOutErrors(
            "the validation part", labels, alone, tuple(_errors(fit, record, unit) for fit in fits)
        )
    if not choice.blocks or not choice.compares(task, starts):
        return None
    try:
        model = _lowest(task, runs, structure)
        folds = covered_folds(task.problem.record, choice.blocks, task.problem.first_row, model)
    except InputError:  # too few rows to leave some out
        LOG.debug(
            "too few rows for %d blocks of cross-validation; the lowest loss chooses", choice.blocks
        )
        return None
    ridges = fold_ridges(starts, runs, task.bound.ny) if choice.retry else [None] * len(starts)
    like = stand_ins(starts, runs, [task.loss(run) for run in runs], task.bound.ny)
    made = list(dict.fromkeys(like))
    LOG.info("cross-validation: %d folds of %d runs", len(folds.pairs), len(made))
    taken, task = max(run.iterations for run in runs), task.after(runs)
    given = (task, [(starts[i], ridges[i]) for i in made], structure, solver, taken)
    begun, planned = itertools.count(1), len(folds.pairs) * len(made)
    found = runner.map(
        _on_fold,
        given,
        folds.pairs,
        lambda _: Stage.CHOICE.enter(f"run {next(begun)} of {planned} on held-out blocks"),
    )
    alone, *of_made = (
        [p for block in column for p in block] for column in zip(*found, strict=True)
    )
    pieces = tuple(of_made[made.index(i)] for i in like)
    labels = tuple(
        f"block {i + 1} of {choice.blocks}"
        for i, (_, held) in enumerate(folds.pairs)
        for _ in held.experiments
    )
    return HeldOutErrors(folds.where, labels, alone, pieces, note=folds.note)


def _lowest(task: Task, runs: Sequence[FinishedRun], structure: Structure) -> Model[Any] | None:
    """Return the model of the run of the lowest loss; None where none has ended well."""
    losses = [task.loss(run) if run.ending.usable else math.inf for run in runs]
    best = int(np.argmin(losses))
    fit = _conclude_briefly(task, structure, runs[best]) if math.isfinite(losses[best]) else None
    return fit.model if fit is not None and fit.status.ok else None


def _on_fold(given: Any, fold: tuple[Record, Record], report: Callable[..., None]) -> list[Pieces]:
    """Return errors on a block of physics alone, and of runs from every start on the rest."""
    task, starts, structure, solver, taken = given
    training, held = fold
    failed: Pieces = [None] * len(held.experiments)
    solver = fold_solver(
        solver,
        sum(map(len, training.experiments)),
        len(task.problem.names) + task.bound.size,
        free_run=not task.criterion.one_step,
        taken=taken,
    )
    try:
        own = task.on(training).prepare(solver, structure)
        fits = [_conclude_physics(own, structure, briefly=True)]
        for start, ridge in starts:
            report()
            run = own.run(solver, start.weights, structure, start.regularization)
            if ridge is not None and is_silenced(run.effective, task.bound.ny):
                run = own.run(solver, start.weights, structure, ridge)
            fits.append(own.conclude(structure, own.learned(run), briefly=True))
    except InputError:  # the block took away what the physics needs
        return [failed] * (1 + len(starts))
    return [_errors(fit, held, task.problem.deviation) for fit in fits]


def _errors(fit: Estimate, record: Record, unit: Vector) -> Pieces:
    """Return errors of the criterion's own response; None for a run without model or value."""
    if not fit.status.ok:
        return [None] * len(record.experiments)
    ahead = fit.model.coloured  # the criterion of a noise model is one step ahead
    response = fit.model.predict(record) if ahead else fit.criterion.response(fit.model, record)
    return squared_errors(response, unit)


def _fell_back(held_out: HeldOutErrors) -> Warning:
    model, alone = (
        math.sqrt(mean_square(p)) for p in (held_out.runs[held_out.chosen], held_out.alone)
    )
    errors = (
        f"its error is {model:.4g} standard deviations of the output, that of physics "
        f"alone {alone:.4g}"
    )
    if math.isinf(model):
        errors = "every one of its runs diverges there"
    text = (
        f"in {held_out.where} the learner is not better than physics alone ({errors}). The "
        "result is physics alone; `fallback = false` keeps the learner."
    )
    return Warning("physics_alone", f"{text} {held_out.note}".strip())


def _conclude_physics(task: Task, structure: Structure, *, briefly: bool = False) -> Estimate:
    rows, learned = task.physics_alone()
    return replace(rows.conclude(structure, learned, briefly=briefly), criterion=task.criterion)


def _median(
    task: Task, runs: Sequence[FinishedRun], members: Sequence[int], best: int
) -> TrainedLearner:
    """Return the median of the members that have a value everywhere.

    The best one alone if it has none.
    """
    rows: OneStepTask = task.rows_task
    learned = {i: task.learned(runs[i]) for i in members}
    sound = [i for i, member in learned.items() if np.isfinite(rows.share(member).square)]
    return (
        task.median([learned[i] for i in sound], sound.index(best))
        if best in sound
        else learned[best]
    )
