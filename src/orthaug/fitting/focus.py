"""One step ahead or the free run: what `Auto` chooses, by free runs over rows that were not fitted.

A fit one step ahead stays where its free run is finite, no worse than that of physics alone, and where its residual is
noise of the equation. Otherwise physics and learner are trained on the free run, too, and of all candidates, physics
alone among them, the one is handed over that predicts the held-out free runs best.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from orthaug._base.errors import InputError, Warning
from orthaug._base.progress import LOG
from orthaug.data.record import Record
from orthaug.fitting.criteria import Criterion, Prediction
from orthaug.fitting.held_out import ONE_STEP, Candidate, Focus, blocked, mean_square, squared_errors
from orthaug.fitting.training import FOLD_ITERATIONS

FREE_RUN = "simulation"
_SLACK = 1.02  # errors closer than this are the same: then the earlier candidate stays

Fit = Callable[..., Any]
"""Fits a problem: `fit(problem, learner=…, criterion=…, …)`."""
_LAGS = 20  # of the residual's autocorrelation
_COLOURED = 0.1  # autocorrelation from which a residual is no noise of the equation, where it is significant, too
_SIGNIFICANT = 4.0  # standard deviations of the autocorrelation of white noise: one lag in 16,000


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
    reason = _reason(problem, first, fit, options)
    if reason is None:
        text = (
            "trained one step ahead: its free run holds where nothing was fitted, and its residual asks for no other."
        )
        return replace(first, focus=Focus(ONE_STEP, text))
    LOG.info("auto: %s; the free run is trained, too", reason)
    return _best(problem, first, fit, options, criterion, reason)


def _simulation(criterion: Any, problem: Any) -> Any:
    """The free run that is trained, with a washout that leaves most of a short record to be scored."""
    declared = criterion.simulation
    usable = max(map(len, problem.record.experiments)) - problem.first_row
    return replace(declared, washout=min(declared.washout, usable // 4)).on(problem.record, problem.first_row)


def _reason(problem: Any, first: Any, fit: Fit, options: Mapping[str, Any]) -> str | None:
    """Why the free run is to be trained; None where the fit one step ahead stays."""
    if not first.model.form.states:
        return None  # nothing is fed back: a free run is the prediction
    physics = first.physics_alone if first.physics_alone is not None else first
    learns = first.model.form.bound is not None
    where, records = "over the training data", [(first, physics, problem.record)]
    own = _compared(records, problem.deviation)
    if own is None and learns:
        validation = options.get("validation")
        if validation is not None:
            where, records = "on the validation part", [(first, physics, validation)]
        else:
            where, records = "over rows held out", _held_out(problem, fit, options)
        own = _compared(records, problem.deviation)
    if own is not None:
        return f"{own} {where}"
    return "its residual remembers its past, which noise of the equation does not" if _coloured(first) else None


def _coloured(fit: Any) -> bool:
    """Whether the residual one step ahead is correlated with its own past, clearly and by more than a little."""
    for trajectory in fit.model.predict(fit.problem.record).trajectories:
        errors = (trajectory.measured - trajectory.model)[trajectory.start :]
        errors = errors - errors.mean(axis=0)
        squares, rows = np.sum(errors**2, axis=0), len(errors)
        limit = max(_COLOURED, _SIGNIFICANT / math.sqrt(max(rows, 1)))
        for lag in range(1, min(_LAGS, rows - 1) + 1):
            with np.errstate(all="ignore"):
                found = np.abs(np.sum(errors[lag:] * errors[:-lag], axis=0)) / squares
            if np.any(found > limit):
                return True
    return False


def _compared(runs: Sequence[tuple[Any, Any, Record]], unit: Any) -> str | None:
    """What is wrong with the free runs of fits beside those of physics alone; None for nothing."""
    own, alone = (mean_square([p for run in runs for p in _errors(run[i], run[2], unit)]) for i in (0, 1))
    if math.isinf(own):
        return "its free run diverges"
    return "its free run is worse than that of physics alone" if own > _SLACK**2 * alone else None


def _errors(fit: Any, record: Record, unit: Any) -> list[Any]:
    return squared_errors(fit.model.simulate(record), unit) if fit.status.ok else [None]


def _held_out(problem: Any, fit: Fit, options: Mapping[str, Any]) -> list[tuple[Any, Any, Record]]:
    """A fit to the first half, physics alone on it, and the other half to run over; nothing of few rows."""
    try:
        (training, held), *_ = reversed(blocked(problem.record, 2, problem.first_row))
        made = fit(problem.on(training), criterion=Prediction(), **_quick(options))
    except InputError:
        return []
    return [(made, made.physics_alone if made.physics_alone is not None else made, held)]


def _quick(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a fit to a part of the rows: one start, few iterations, nothing to choose."""
    given = options["regularization"]
    quick = {
        "restarts": 1,
        "solver": options["solver"].at_most(FOLD_ITERATIONS),
        "regularization": given[0] if isinstance(given, list | tuple) else given,
        "blocks": 0,
        "validation": None,
        "checkpoints": None,
    }
    quiet = {name: value for name, value in options.items() if name != "progress"}
    return quiet | {name: value for name, value in quick.items() if name in options}


def _best(problem: Any, first: Any, fit: Fit, options: Mapping[str, Any], criterion: Criterion, reason: str) -> Any:
    """Of what is trained one step ahead and on the free run the best, where nothing was fitted."""
    flown = fit(problem, criterion=_simulation(criterion, problem), **{**options, "fallback": False})
    learns = first.model.form.bound is not None
    fits = {(ONE_STEP, True): first, (FREE_RUN, True): flown} if learns else {}
    fits |= {(ONE_STEP, False): first.physics_alone if learns else first}
    fits |= {(FREE_RUN, False): flown.physics_alone if learns else flown}
    errors = _errors_of(problem, fits, flown, fit, options, criterion)
    order = sorted(fits, key=lambda key: (key[0] == FREE_RUN, key[1]))
    usable = [key for key in order if _sound(fits, key, problem)]
    if not usable:  # every free run is lost: what physics says one step ahead is left
        chosen, why = (ONE_STEP, False), "every free run diverges"
    else:
        chosen = min(usable, key=lambda key: errors[key])
        chosen = next(key for key in usable if errors[key] <= _SLACK * errors[chosen])
        why = reason
    compared = tuple(Candidate(*key, errors[key]) for key in order)
    return _handed_over(fits, chosen, compared, why, problem)


def _errors_of(
    problem: Any, fits: Mapping[Any, Any], flown: Any, fit: Fit, options: Mapping[str, Any], criterion: Criterion
) -> dict[Any, float]:
    """RMS errors of the free runs of every candidate, where nothing was fitted."""
    unit, validation = problem.deviation, options.get("validation")
    if validation is not None:
        return {key: math.sqrt(mean_square(_errors(one, validation, unit))) for key, one in fits.items()}
    pieces: dict[Any, list[Any]] = {key: [] for key in fits}
    try:
        folds = blocked(problem.record, 2, problem.first_row)
    except InputError:
        folds = []
    for training, held in folds:
        for focus, own in ((ONE_STEP, Prediction()), (FREE_RUN, _simulation(criterion, problem))):
            try:
                made = fit(problem.on(training), criterion=own, **_quick(options) | {"fallback": False})
            except InputError:
                made = None
            for key in fits:
                if key[0] == focus:
                    alone = made is not None and not key[1] and made.physics_alone is not None
                    one = made.physics_alone if alone and made is not None else made
                    pieces[key] += [None] if one is None else _errors(one, held, unit)
    if folds:
        return {key: math.sqrt(mean_square(found)) for key, found in pieces.items()}
    own = {key: math.sqrt(mean_square(_errors(one, problem.record, unit))) for key, one in fits.items()}
    return own  # too few rows to leave some out: the training data have to do


def _sound(fits: Mapping[Any, Any], key: Any, problem: Any) -> bool:
    """Whether a candidate runs over the whole training data, with a learner no worse than physics alone does."""
    focus, learns = key
    own = mean_square(_errors(fits[key], problem.record, problem.deviation))
    if not np.isfinite(own) or not learns:
        return bool(np.isfinite(own))
    return own <= _SLACK**2 * mean_square(_errors(fits[focus, False], problem.record, problem.deviation))


def _handed_over(fits: Mapping[Any, Any], chosen: Any, compared: tuple[Candidate, ...], why: str, problem: Any) -> Any:
    focus, learns = chosen
    best = fits[chosen]
    alone = min(
        (key for key in fits if not key[1]), key=lambda key: next(c.error or 0.0 for c in compared if _key(c) == key)
    )
    listed = "; ".join(candidate.told for candidate in compared)
    picked = next(c for c in compared if _key(c) == chosen)
    text = (
        f"the fit one step ahead was not enough ({why}), so the free run was trained as well. Handed over: {picked}. "
        f"Errors of the free run where nothing was fitted, in standard deviations of the output: {listed}."
    )
    warnings = list(best.warnings)
    if not learns and any(key[1] for key in fits):
        other = min((c for c in compared if c.learner), key=lambda c: c.error or 0.0)
        told = (
            f"the result is physics alone, whose free run predicts best where nothing was fitted ({picked.told}; "
            f"{other.told})."
        )
        warnings.append(Warning("physics_alone", told))
    return replace(
        best,
        focus=Focus(focus, text, compared),
        physics_alone=fits[alone] if learns else None,
        warnings=tuple(warnings),
    )


def _key(candidate: Candidate) -> tuple[str, bool]:
    return candidate.focus, candidate.learner
