"""The choice of `Auto` between one step ahead and the free run, by held-out free runs.

A fit one step ahead stays where its free run is finite, no worse than that of physics alone, where
its residual is noise of the equation, and where no coloured errors move its parameters. Otherwise
physics and learner are trained on the free run, too. Of all candidates, physics alone among them,
the one is handed over that predicts the held-out free runs best. `benchmarks/defaults.py` has the
records by which these rules were chosen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from orthaug._base.errors import InputError, Warning
from orthaug._base.parallel import one_blas_thread
from orthaug._base.progress import LOG
from orthaug.data.record import Record
from orthaug.fitting.colour import autocorrelation
from orthaug.fitting.criteria import Criterion, Prediction
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.held_out import (
    Candidate,
    Focus,
    Folds,
    Pieces,
    covered_folds,
    held_out_blocks,
    mean_square,
    squared_errors,
)
from orthaug.fitting.inconsistency import inconsistency
from orthaug.fitting.kinds import Solver
from orthaug.fitting.setup import quick_options
from orthaug.fitting.training import fold_solver
from orthaug.fitting.unfinished import NOT_CONVERGED
from orthaug.models.learners import learns
from orthaug.physics.problem import PosedProblem

ONE_STEP, FREE_RUN = "prediction", "simulation"
BLOCKS = 4  # blocks that are held out in turn where that is not said
HALVES = 2  # the later one is run over by a fit to the other
_SLACK = 1.02  # errors closer than this are the same: then the simpler candidate stays
# physics alone one step ahead has to be better by this to be preferred to that of the free run
_PREFERRED = 1.1
_LAGS = 20  # of the residual's autocorrelation
# autocorrelation from which a residual is no noise of the equation, where it is significant, too
_COLOURED = 0.1
_SIGNIFICANT = 4.0  # standard deviations of the autocorrelation of white noise: one lag in 16,000
# rows · parameters · iterations of the free run over all rows: half a minute on one core
_FREE_WORK = 3e8

_INCONSISTENT = (
    "coloured errors, correlated with the lagged outputs, move its parameters by more than half a "
    "standard error"
)

_CUT_SHORT = (
    "no intervals: training on the free run stopped at its limit to save time, while the loss was "
    "still falling. The parameters may still move by more than their standard errors. "
    '`focus = "simulation"` trains to the end.'
)

Fit = Callable[..., Any]
"""Fits a problem: `fit(problem, learner=…, criterion=…, …)`."""
Key = tuple[str, bool]
"""How a candidate was trained, and whether it has a learner."""


def choose_focus(
    problem: PosedProblem, fit: Fit, options: Mapping[str, object], criterion: Criterion
) -> Estimate:
    """Return the best of the estimates one step ahead and on the free run.

    Args:
        problem: posed, with its rows in memory.
        fit: makes an estimate of a problem with options.
        options: of the fit as it was asked for, without its criterion.
        criterion: the `Auto` that was asked for.
    """
    first = fit(problem, criterion=Prediction(), **options)
    if not first.status.ok or any(warning.code == "stopped" for warning in first.warnings):
        return first
    reason = _why_not(problem, first, fit, options)
    if reason is None:
        text = (
            "one step ahead suffices: the free run is good on held-out rows, and the residual "
            "is white."
        )
        return replace(first, focus=Focus(ONE_STEP, text))
    LOG.info("auto: %s; the free run is trained, too", reason)
    free_run = _free_run(criterion, problem)
    try:
        return _best_estimate(_FocusChoice(problem, first, fit, options, free_run), reason)
    except InputError as error:  # too few rows for a free run
        text = f"trained one step ahead; {reason}, but the free run cannot be trained: {error}"
        return replace(first, focus=Focus(ONE_STEP, text))


def _why_not(
    problem: PosedProblem, first: Estimate, fit: Fit, options: Mapping[str, Any]
) -> str | None:
    """Return the reason why one step ahead is not enough; None where it is."""
    if not first.model.form.states:
        return None  # nothing is fed back: a free run is the prediction
    wrong = _beside_physics(first, problem.record, problem)
    if wrong is not None:
        return f"{wrong} over the training data"
    if first.learns:
        validation = options["validation"]
        where = (
            "over the half of the rows that was held out"
            if validation is None
            else "on the validation part"
        )
        made, held = (
            (first, validation) if validation is not None else _on_half(problem, fit, options)
        )
        wrong = None if made is None else _beside_physics(made, held, problem)
        if wrong is not None:
            return f"{wrong} {where}"
    if _is_coloured(first):
        return "its residual is correlated with its past, as with sensor noise"
    return _INCONSISTENT if _is_inconsistent(first) else None


def _beside_physics(fit: Estimate, record: Record, problem: PosedProblem) -> str | None:
    """Return the fault of a fit's free runs compared to those of its physics alone.

    None for nothing.
    """
    physics = fit if fit.physics_alone is None else fit.physics_alone
    own, alone = (mean_square(_errors(one, record, problem)) for one in (fit, physics))
    if math.isinf(own):
        return "its free run diverges"
    return "its free run is worse than that of physics alone" if own > _SLACK**2 * alone else None


def _errors(fit: Estimate, record: Record, problem: PosedProblem) -> Pieces:
    """Return the squared errors along the free run of each experiment."""
    if fit is None or not fit.status.ok:
        return [None] * len(record.experiments)
    return squared_errors(fit.model.simulate(record), problem.deviation)


def _on_half(problem: PosedProblem, fit: Fit, options: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return a fit to the first half, and the other half; nothing for too few rows."""
    try:
        training, held = held_out_blocks(problem.record, HALVES, problem.first_row)[-1]
        solver = fold_solver(options["solver"], 0, 0, free_run=False)
        quick = _quick(options, solver)
        return fit(problem.on(training), criterion=Prediction(), **quick), held
    except InputError:
        return None, None


def _quick(options: Mapping[str, object], solver: Solver) -> dict[str, object]:
    """Return options for a quick fit to a part of the rows, by another solver."""
    own = {name: value for name, value in options.items() if name != "progress"}
    return {**quick_options(own), "solver": solver, "fallback": False, "checkpoints": None}


def _is_coloured(fit: Estimate) -> bool:
    """Return whether the one-step residual is clearly correlated with its past.

    And by more than a little.
    """
    for trajectory in fit.model.predict(fit.problem.record).trajectories:
        errors = trajectory.errors
        limit = max(_COLOURED, _SIGNIFICANT / math.sqrt(len(errors)))
        for own in (errors - errors.mean(axis=0)).T:
            found = autocorrelation(own[None])
            if found is not None and np.any(np.abs(found[:_LAGS]) > limit):
                return True
    return False


def _is_inconsistent(fit: Any) -> bool:
    """Return whether coloured errors, however small, move the one-step θ."""
    with one_blas_thread():
        found = inconsistency(fit, fit.model.predict(fit.problem.record))
    return found is not None and found.found


def _rows(record: Record) -> int:
    return sum(map(len, record.experiments))


def _free_run(criterion: Any, problem: Any) -> Criterion:
    """Return the free run to train, with a washout that leaves most of a record."""
    usable = max(map(len, problem.record.experiments)) - problem.first_row
    declared = criterion.simulation
    return replace(declared, washout=min(declared.washout, usable // 4)).on(
        problem.record, problem.first_row
    )


@dataclass(frozen=True, eq=False)
class _FocusChoice:
    """A problem with its fit one step ahead, from which the other candidates are made."""

    problem: PosedProblem
    first: Estimate
    fit: Fit
    options: Mapping[str, Any]
    free_run: Criterion

    @property
    def learns(self) -> bool:
        """True where there is a learner to compare with physics alone."""
        return learns(self.options["learner"])

    @property
    def size(self) -> int:
        """Number of parameters of physics and learner."""
        return len(self.first.theta) + self.first.model.form.bound.size

    @cached_property
    def free(self) -> Estimate:
        """The fit on the free run, from one start, for all begin at physics alone.

        Small problems are trained to the end, large ones within the limit, to save time.
        """
        solver = self.options["solver"]
        if solver.limit().longest * self.size * _rows(self.problem.record) > _FREE_WORK:
            solver = solver.within_limit
        chosen = {**self.options, "fallback": False, "blocks": 0, "restarts": 1, "solver": solver}
        return self.fit(self.problem, criterion=self.free_run, **chosen)

    @cached_property
    def free_physics(self) -> Estimate:
        """Physics alone on the free run."""
        if "free" in vars(self) and self.free.physics_alone is not None:
            return self.free.physics_alone
        chosen = {**self.options, "learner": None, "fallback": False, "blocks": 0, "restarts": 1}
        return self.fit(self.problem, criterion=self.free_run, **chosen)

    def estimate(self, key: Key) -> Estimate:
        """Return the estimate of a candidate from all rows."""
        focus, learner = key
        if focus == ONE_STEP:
            return _drop_learner(self.first, learner)
        return self.free if learner else self.free_physics

    @cached_property
    def errors(self) -> dict[Key, float]:
        """RMS errors of the held-out free runs of all candidates, the simplest first."""
        keys = [
            (focus, own)
            for focus in (ONE_STEP, FREE_RUN)
            for own in ((False, True) if self.learns else (False,))
        ]
        validation = self.options["validation"]
        records = (
            [(self.problem.record, validation)] if validation is not None else self.folds.pairs
        )
        pieces: dict[Key, list[Any]] = {key: [] for key in keys}
        for training, held in records:
            whole = training is self.problem.record
            criteria = {} if whole else {ONE_STEP: Prediction(), FREE_RUN: self.free_run}
            made = {key: self._quick_fit(training, one) for key, one in criteria.items()}
            for key, found in pieces.items():
                one = self.estimate(key) if whole else _drop_learner(made[key[0]], key[1])
                found += _errors(one, held, self.problem)
        return {key: math.sqrt(mean_square(found)) for key, found in pieces.items()}

    @cached_property
    def folds(self) -> Folds:
        """Folds of training rows and held-out blocks.

        Of few rows the training data themselves.
        """
        record, first = self.problem.record, self.problem.first_row
        blocks = self.options["blocks"] or BLOCKS
        try:
            return covered_folds(record, blocks, first, self.first.model)
        except InputError:
            return Folds(((record, record),))

    def _quick_fit(self, training: Record, criterion: Criterion) -> Any:
        solver = fold_solver(
            self.options["solver"], _rows(training), self.size, free_run=criterion is self.free_run
        )
        quick = _quick(self.options, solver)
        try:
            return self.fit(self.problem.on(training), criterion=criterion, **quick)
        except InputError:  # the block took away what the physics needs
            return None


def _drop_learner(estimate: Estimate, learner: bool) -> Estimate:
    """Return an estimate, or that of its physics alone."""
    if learner or estimate is None or estimate.physics_alone is None:
        return estimate
    return estimate.physics_alone


def _best_estimate(choosing: _FocusChoice, reason: str) -> Estimate:
    """Return the estimate of the candidate with the least error.

    Only candidates whose free run over all rows is sound count.
    """
    errors = choosing.errors
    ranked = _rank(
        errors,
        with_learner=choosing.learns and not choosing.options["fallback"],
        consistent=reason == _INCONSISTENT,
    )
    chosen = next((key for key in ranked if _sound(choosing, key)), None)
    lost = chosen is None
    key = (ONE_STEP, False) if chosen is None else chosen
    best, compared = (
        choosing.estimate(key),
        tuple(Candidate(*one, error) for one, error in errors.items()),
    )
    named = {(one.focus, one.learner): one for one in compared}
    text = (
        f"trained one step ahead and, because {reason}, on the free run as well. Errors of free "
        "runs on held-out rows, in standard deviations of the output: "
        f"{'; '.join(one.described for one in compared)}. The result is {named[key]}."
    )
    if key == (FREE_RUN, False) and errors[key] > errors.get((ONE_STEP, False), math.inf):
        text += (
            " Of physics alone, that trained on the free run is taken unless its error there is "
            "clearly larger."
        )
    if choosing.options["validation"] is None and choosing.folds.note:
        text += f" {choosing.folds.note}"
    warnings = list(best.warnings)
    if key[0] == FREE_RUN and any(warning.code == NOT_CONVERGED for warning in warnings):
        warnings = [w for w in warnings if w.code != NOT_CONVERGED]
        warnings.append(Warning(NOT_CONVERGED, _CUT_SHORT))
    if choosing.learns and not key[1]:
        rival = min((one for one in compared if one.learner), key=lambda one: one.error)
        beginning = f"no learner is better in the free run on held-out rows ({rival.described})"
        if rival.error < named[key].error:
            beginning = (
                "the gain of a learner in the free run on held-out rows is not sure "
                f"({rival.described})"
            )
        text_of_result = f"{beginning}, so the result is {named[key].described}."
        warnings.append(Warning("physics_alone", text_of_result))
    if lost:
        text_of_runs = (
            "every free run diverges, over training or held-out rows: the model is for "
            "one-step prediction only."
        )
        warnings.append(Warning("one_step_only", text_of_runs))
    physics = min((one for one in errors if not one[1]), key=lambda one: errors[one])
    kept = choosing.estimate(physics) if key[1] else None
    return replace(
        best, focus=Focus(key[0], text, compared), physics_alone=kept, warnings=tuple(warnings)
    )


def _rank(errors: Mapping[Key, float], *, with_learner: bool, consistent: bool) -> list[Key]:
    """Return the candidates by error, of similar ones the simplest first.

    Wanted learners before physics, and where θ is to be `consistent`, the free run before one step
    ahead.

    Physics alone that was fitted to the free run comes before that of one step ahead where the
    errors of a few blocks do not clearly speak against it: it minimises what is compared.
    """
    among = [key for key in errors if key[1] or not with_learner]
    least = min(errors[key] for key in among)
    alike = [key for key in among if errors[key] <= _SLACK * least]
    if consistent:
        alike.sort(key=lambda key: key[0] != FREE_RUN)
    one_step, free_run = (ONE_STEP, False), (FREE_RUN, False)
    if (
        alike[:1] == [one_step]
        and free_run in among
        and errors[free_run] <= _PREFERRED * errors[one_step]
    ):
        alike = [free_run, *(key for key in alike if key != free_run)]
    return alike + sorted(
        (key for key in errors if key not in alike), key=lambda key: (key not in among, errors[key])
    )


def _sound(choosing: _FocusChoice, key: Key) -> bool:
    """Return whether a candidate runs over all training data.

    Its learner may be no worse than physics, where `physics` is a candidate.
    """
    if not math.isfinite(choosing.errors[key]):
        return False
    problem = choosing.problem
    own = mean_square(_errors(choosing.estimate(key), problem.record, problem))
    if not key[1] or not math.isfinite(own) or not choosing.options["fallback"]:
        return math.isfinite(own)
    return own <= _SLACK**2 * mean_square(
        _errors(choosing.estimate((key[0], False)), problem.record, problem)
    )
