"""One step ahead or the free run: what `Auto` chooses, by free runs over rows that were not fitted.

A fit one step ahead stays where its free run is finite, no worse than that of physics alone, and where its residual is
noise of the equation. Otherwise physics and learner are trained on the free run, too. Of all candidates, physics alone
among them, the one is handed over that predicts the held-out free runs best. `benchmarks/defaults.py` has the records
by which these rules were chosen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from orthaug._base.errors import InputError, Warning
from orthaug._base.progress import LOG
from orthaug.data.record import Record
from orthaug.fitting.criteria import Prediction
from orthaug.fitting.held_out import Candidate, Focus, Pieces, blocked, mean_square, squared_errors
from orthaug.fitting.training import FOLD_ITERATIONS

ONE_STEP, FREE_RUN = "prediction", "simulation"
HALVES = 2  # blocks that are held out in turn: long runs show the drift that short ones hide
_SLACK = 1.02  # errors closer than this are the same: then the simpler candidate stays
_LAGS = 20  # of the residual's autocorrelation
_COLOURED = 0.1  # autocorrelation from which a residual is no noise of the equation, where it is significant, too
_SIGNIFICANT = 4.0  # standard deviations of the autocorrelation of white noise: one lag in 16,000

Fit = Callable[..., Any]
"""Fits a problem: `fit(problem, learner=…, criterion=…, …)`."""


@dataclass(frozen=True, eq=False)
class _Tried:
    """A candidate with its estimate, and the squared errors of its free runs where nothing was fitted."""

    focus: str
    learner: bool
    estimate: Any
    pieces: Pieces = ()

    @property
    def error(self) -> float:
        """RMS in standard deviations of the training output."""
        return math.sqrt(mean_square(self.pieces)) if self.pieces else math.nan

    @property
    def candidate(self) -> Candidate:
        """What is reported of it."""
        return Candidate(self.focus, self.learner, self.error)


def choose_focus(problem: Any, fit: Fit, options: Mapping[str, Any], criterion: Any) -> Any:
    """Return the estimate one step ahead, or the best of it and those trained on the free run.

    Args:
        problem: posed, with its rows in memory.
        fit: makes an estimate of a problem with options.
        options: of the fit as it was asked for, without its criterion.
        criterion: the `Auto` that was asked for.
    """
    first = fit(problem, criterion=Prediction(), **options)
    if not first.status.ok:
        return first
    reason = _why_not(problem, first, fit, options)
    if reason is None:
        text = "one step ahead is enough: the free run holds where nothing was fitted, and the residual is white."
        return replace(first, focus=Focus(ONE_STEP, text))
    LOG.info("auto: %s; the free run is trained, too", reason)
    try:
        tried = _candidates(problem, first, fit, options, criterion)
    except InputError as error:  # too few rows for a free run
        text = f"{reason}, but the free run cannot be trained: {error}"
        return replace(first, focus=Focus(ONE_STEP, text))
    return _best(problem, tried, reason, keeps_learner=not options["fallback"])


def _why_not(problem: Any, first: Any, fit: Fit, options: Mapping[str, Any]) -> str | None:
    """Return why one step ahead is not enough; None where it is."""
    if not first.model.form.states:
        return None  # nothing is fed back: a free run is the prediction
    wrong = _beside_physics(first, [problem.record], problem)
    if wrong is not None:
        return f"{wrong} over the training data"
    if first.model.form.bound is not None:
        validation = options["validation"]
        where = "over the half of the rows that was held out" if validation is None else "on the validation part"
        made, held = (first, validation) if validation is not None else _on_half(problem, fit, options)
        wrong = None if made is None else _beside_physics(made, [held], problem)
        if wrong is not None:
            return f"{wrong} {where}"
    return "its residual remembers its past, as noise on the sensor makes it" if _coloured(first) else None


def _beside_physics(fit: Any, records: Sequence[Record], problem: Any) -> str | None:
    """Return what is wrong with the free runs of a fit beside those of its physics alone; None for nothing."""
    physics = fit if fit.physics_alone is None else fit.physics_alone
    own, alone = (mean_square([p for r in records for p in _errors(one, r, problem)]) for one in (fit, physics))
    if math.isinf(own):
        return "its free run diverges"
    return "its free run is worse than that of physics alone" if own > _SLACK**2 * alone else None


def _errors(fit: Any, record: Record, problem: Any) -> Pieces:
    """Squared errors along the free run of each experiment."""
    if fit is None or not fit.status.ok:
        return [None] * len(record.experiments)
    return squared_errors(fit.model.simulate(record), problem.deviation)


def _on_half(problem: Any, fit: Fit, options: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return a fit to the first half, and the other half; nothing where the rows are too few."""
    try:
        training, held = blocked(problem.record, HALVES, problem.first_row)[-1]
        return fit(problem.on(training), criterion=Prediction(), **_quick(options)), held
    except InputError:
        return None, None


def _quick(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a fit to a part of the rows: one start, few iterations, nothing to choose."""
    given = options["regularization"]
    return {
        **{name: value for name, value in options.items() if name != "progress"},
        "restarts": 1,
        "solver": options["solver"].at_most(FOLD_ITERATIONS),
        "regularization": given[0] if isinstance(given, list | tuple) else given,
        "blocks": 0,
        "validation": None,
        "fallback": False,
        "checkpoints": None,
    }


def _coloured(fit: Any) -> bool:
    """Return whether the residual one step ahead is correlated with its own past, clearly and by more than a little."""
    for trajectory in fit.model.predict(fit.problem.record).trajectories:
        errors = (trajectory.measured - trajectory.model)[trajectory.start :]
        errors = errors - errors.mean(axis=0)
        squares, rows = np.sum(errors**2, axis=0), len(errors)
        limit = max(_COLOURED, _SIGNIFICANT / math.sqrt(max(rows, 1)))
        for lag in range(1, min(_LAGS, rows - 1) + 1):
            if np.any(np.abs(np.sum(errors[lag:] * errors[:-lag], axis=0)) > limit * squares):
                return True
    return False


def _candidates(problem: Any, first: Any, fit: Fit, options: Mapping[str, Any], criterion: Any) -> list[_Tried]:
    """Return what is compared, the simplest first, with errors where nothing was fitted."""
    flown = _free_run(criterion, problem)
    other = fit(problem, criterion=flown, **{**options, "fallback": False, "blocks": 0})
    fits = _kinds({ONE_STEP: first, FREE_RUN: other})
    validation = options["validation"]
    if validation is not None:
        return [replace(tried, pieces=_errors(tried.estimate, validation, problem)) for tried in fits]
    try:
        folds = blocked(problem.record, HALVES, problem.first_row)
    except InputError:  # too few rows to leave some out: the training data have to do
        return [replace(tried, pieces=_errors(tried.estimate, problem.record, problem)) for tried in fits]
    pieces: list[list[Any]] = [[] for _ in fits]
    for training, held in folds:
        own = _kinds({ONE_STEP: _made(problem, training, fit, Prediction(), options),
                      FREE_RUN: _made(problem, training, fit, flown, options)}, fits)  # fmt: skip
        for found, tried in zip(pieces, own, strict=True):
            found += _errors(tried.estimate, held, problem)
    return [replace(tried, pieces=found) for tried, found in zip(fits, pieces, strict=True)]


def _free_run(criterion: Any, problem: Any) -> Any:
    """Return the free run that is trained, with a washout that leaves most of a short record to be scored."""
    usable = max(map(len, problem.record.experiments)) - problem.first_row
    declared = criterion.simulation
    return replace(declared, washout=min(declared.washout, usable // 4)).on(problem.record, problem.first_row)


def _made(problem: Any, training: Record, fit: Fit, criterion: Any, options: Mapping[str, Any]) -> Any:
    try:
        return fit(problem.on(training), criterion=criterion, **_quick(options))
    except InputError:  # the block took away what the physics needs
        return None


def _kinds(fits: Mapping[str, Any], like: Sequence[_Tried] | None = None) -> list[_Tried]:
    """Return every estimate with and without its learner; of fits that failed in the places of others."""
    if like is not None:
        return [replace(tried, estimate=_without(fits[tried.focus], tried.learner)) for tried in like]
    learns = fits[ONE_STEP].model.form.bound is not None
    kinds = (False, True) if learns else (False,)
    return [_Tried(focus, own, _without(one, own)) for focus, one in fits.items() for own in kinds]


def _without(estimate: Any, learner: bool) -> Any:
    """Return an estimate, or that of physics alone beside it."""
    if learner or estimate is None or estimate.physics_alone is None:
        return estimate
    return estimate.physics_alone


def _best(problem: Any, tried: Sequence[_Tried], reason: str, *, keeps_learner: bool) -> Any:
    """Return the estimate of the candidate with the least error, of those whose free run over all rows is sound."""
    own = {id(one): mean_square(_errors(one.estimate, problem.record, problem)) for one in tried}
    alone = {one.focus: own[id(one)] for one in tried if not one.learner}
    usable = [one for one in tried if math.isfinite(own[id(one)]) and math.isfinite(one.error)]
    usable = [one for one in usable if not one.learner or own[id(one)] <= _SLACK**2 * alone[one.focus]] or usable
    if keeps_learner:
        usable = [one for one in usable if one.learner] or usable
    least = min((one.error for one in usable), default=math.inf)
    chosen = next((one for one in usable if one.error <= _SLACK * least), tried[0])
    compared = tuple(one.candidate for one in tried)
    text = (
        f"one step ahead is not enough: {reason}. So the free run was trained, too. Errors of free runs where nothing "
        f"was fitted, in standard deviations of the output: {'; '.join(one.described for one in compared)}. "
        f"The result is {chosen.candidate}."
    )
    best, learns = chosen.estimate, any(one.learner for one in tried)
    warnings = list(best.warnings)
    if learns and not chosen.learner:
        rival = min((one for one in tried if one.learner), key=lambda one: one.error)
        told = f"no learner is better in free run where nothing was fitted ({rival.candidate.described}), so the result"
        warnings.append(Warning("physics_alone", f"{told} is {chosen.candidate.described}."))
    if not usable:
        text_lost = "every free run diverges over the training data, so the result is for one-step prediction only."
        warnings.append(Warning("one_step_only", text_lost))
    physics = min((one for one in tried if not one.learner), key=lambda one: one.error)
    return replace(
        best,
        focus=Focus(chosen.focus, text, compared),
        physics_alone=physics.estimate if chosen.learner else None,
        warnings=tuple(warnings),
    )
