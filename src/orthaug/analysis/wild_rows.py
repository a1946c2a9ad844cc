"""Wrong samples: distant rows of errors, the step that marks them, and a fit without them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from orthaug._base.errors import Warning
from orthaug._base.lines import first_words, percent, plural
from orthaug.analysis.residuals import errors_of
from orthaug.analysis.trained_start import from_trained_start
from orthaug.data.gaps import Mending
from orthaug.data.record import Record
from orthaug.data.regressors import stack_rows
from orthaug.data.steps import Outliers
from orthaug.data.wild import WildSample, marked_by
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.motion_estimate import MotionEstimate
from orthaug.models.response import Response
from orthaug.physics.problem import Problem

_HOLD = 0.5  # share of the squares in wild rows
# Share of the rows that these are at most, and the number that is always few
_FEW, _LEAST = (0.005, 6)
_MARKS_MORE = 1.5  # times what the present threshold marks, from which on another one is advised
_WILD = 20.0  # robust deviations; a normal residual reaches five
_WILD_IN_RUN, _FEW_IN_RUN = 10.0, 0.02  # the same of a free run, whose lags do not repeat a row
_MAD = 1.4826
_NAMED = 3
_FEWEST = 3  # rows for each parameter
_SHOWN = 4  # parameters
_MOVED = 0.01  # of a value: less is none


def wild_row_mendings(fit: Estimate) -> list[Mending]:
    """Return the warnings `wild_rows` of a fit that a step of preparation mends, with the step."""
    record, motion = fit.problem.record, isinstance(fit, MotionEstimate)
    found: list[Mending] = []
    if not motion or fit.model.coloured:
        found = wild_rows(fit.model.predict(record), record)
    if not found and not fit.model.coloured:
        run = fit.model.simulate(record)
        better = from_trained_start(fit, run)
        found = wild_rows(run if better is None else better[0].response, record, free_run=True)
    return [one for one in found if one.step]


def wild_rows(response: Response, record: Record, *, free_run: bool = False) -> list[Mending]:
    """Return a warning for each output whose error comes mostly from a few distant rows.

    With the step of preparation that marks them; without one where none does.

    A wrong sample is one row of a free run's error, and as many more of a one-step residual as the
    physics has lags: the former may be closer and more of them.
    """
    found = []
    errors = errors_of(response)
    starts = [t.start for t in response.trajectories]
    rows = [(i, starts[i] + k) for i, error in enumerate(errors) for k in range(len(error))]
    distance, few = (_WILD_IN_RUN, _FEW_IN_RUN) if free_run else (_WILD, _FEW)
    for j, output in enumerate(response.outputs):
        error = np.concatenate(errors)[:, j]
        error = np.where(np.isnan(error), np.nanmedian(error), error)
        size = np.abs(error - np.median(error))
        wild = np.flatnonzero(size > distance * _MAD * np.median(size))
        held = float(np.sum(size[wild] ** 2)) / max(float(np.sum(size**2)), 1e-300)
        if (
            not len(wild)
            or len(wild) > max(_LEAST, few * len(error))
            or held < _HOLD
            or not np.median(size)
        ):
            continue
        at = [rows[k] for k in wild]
        named = first_words([record.experiments[i].where(row) for i, row in at], _NAMED, "; ")
        what = "error of the free run" if free_run else "one-step residual"
        remedy, step = _marking(record, j, at)
        text = (
            f"{plural(len(wild), 'row')} of {len(error)} make up {percent(held, 3)} of the "
            f"squared {what} of {output.name}: {named}. Wrong "
            f"samples among them bias θ: {remedy}"
        )
        found.append(Mending(Warning("wild_rows", text), output.name, step))
    return found


def _marking(
    record: Record, output: int, rows: list[tuple[int, int]]
) -> tuple[str, dict[str, Any]]:
    """Return how to mark rows, with the threshold where the default or the spec's marks few.

    And the step that does, as a spec declares it: empty where none does.
    """
    name = record.outputs[output].name
    done = [
        one.options
        for one in record.prepared
        if one.step == "outliers" and name in one.options.get("channels", [name])
    ]
    step = Outliers(**{key: done[-1][key] for key in ("window", "threshold")} if done else {})
    now, best = marked_by(record, output, rows, step)
    better = best.gain > _MARKS_MORE * max(now.gain, 0)
    marks = f"marks {best.rows} of these rows"
    marks += f" and {plural(best.others, 'other')}" if best.others else ""
    by_hand = "empty their cells in the file (`missing` in [data])"
    adds: dict[str, Any] = {"step": "outliers", "channels": [name]}
    sharper = adds | {"window": step.window, "threshold": best.threshold}
    if done and better:
        text = (
            f'give the step "outliers" threshold = {best.threshold:g} instead of '
            f"{step.threshold:g}, which {marks}. For the rest, {by_hand}."
        )
        return text, sharper
    if done:
        return f'the step "outliers" does not separate them from the signal, so {by_hand}.', {}
    if better:
        text = (
            f'mark them by step = "outliers" of data.prepare with threshold = {best.threshold:g}, '
            f"which {marks}; the default of {step.threshold:g} marks {now.rows}. Or leave them out."
        )
        return text, sharper
    return 'mark them (step = "outliers" of data.prepare), or leave them out.', adds


def fit_without(problem: Problem, samples: Sequence[WildSample]) -> str:
    """Return a clause on the parameters that move where the rows of these samples are left out.

    They are those of physics without a learner.
    """
    record, names = problem.record, problem.baseline.names
    marked = []
    for i, experiment in enumerate(record.experiments):
        inputs, outputs = np.zeros_like(experiment.inputs), np.zeros_like(experiment.outputs)
        for sample in samples:
            if sample.experiment == i:
                target, column = (
                    (inputs, sample.column)
                    if sample.column < len(record.inputs)
                    else (outputs, sample.column - len(record.inputs))
                )
                target[sample.row, column] = 1.0
        marked.append(replace(experiment, inputs=inputs, outputs=outputs))
    rows = stack_rows(replace(record, experiments=tuple(marked)), problem.layout)
    kept = ~((rows.x != 0).any(axis=1) | (rows.y != 0).any(axis=1))
    if len(kept) != problem.count or kept.all() or kept.sum() < _FEWEST * len(names) or not names:
        return ""
    phi = problem.baseline.on(problem.rows.x, problem.layout, problem.outputs)[0][kept].reshape(
        -1, len(names)
    )
    size = np.linalg.norm(phi, axis=0)
    if not np.all(size > 0):
        return ""
    there = np.linalg.lstsq(phi / size, problem.target[kept].reshape(-1), rcond=None)[0] / size
    pairs = zip(names, problem.least_squares, there, strict=True)
    moved = [
        f"{n} = {b:.4g} instead of {a:.4g}"
        for n, a, b in pairs
        if abs(a - b) > _MOVED * max(abs(a), abs(b))
    ]
    if not moved:
        return "Physics alone gives the same without it."
    return f"Without it physics alone gives {', '.join(moved[:_SHOWN])}."
