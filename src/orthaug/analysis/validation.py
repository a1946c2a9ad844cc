"""Does the learner earn its place? Free runs of the model and of physics alone on data that were not fitted.

Blocked cross-validation leaves out one contiguous block after another, with gaps of the lag length, so that no sample
is predicted from its own neighbours in the training data.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from orthaug._base.checks import Matrix
from orthaug._base.errors import InputError
from orthaug._base.parallel import spread
from orthaug._base.warning import Warning
from orthaug.data.record import Experiment, Record
from orthaug.data.regressors import Layout
from orthaug.fitting.estimates import Estimate
from orthaug.models.model import Model
from orthaug.models.response import Response

_WORTH = 0.02  # of the error: less than this is neither help nor harm
_FEWEST = 20  # usable rows of a block


class Trial(NamedTuple):
    """Free-run errors on one piece of data that was not fitted, in standard deviations; inf where a run diverges.

    `block` is true for a block of cross-validation, and false for a part of its own.
    """

    where: str
    alone: float
    model: float
    block: bool = False


@dataclass(frozen=True)
class Extrapolation:
    """How far a part leaves the training data in one entry of the regressor."""

    part: str
    lag: str
    training: tuple[float, float]
    reach: tuple[float, float]
    share: float
    """Of the part's rows that lie outside."""

    def __str__(self) -> str:
        low, high = self.training
        return (
            f"In {self.lag}, {self.part} leaves the training range of {low:.4g} to {high:.4g}: it goes from "
            f"{self.reach[0]:.4g} to {self.reach[1]:.4g}, outside on {100 * self.share:.2g} % of its rows"
        )


@dataclass(frozen=True)
class Verdict:
    """`code` is helps, no_help or hurts; `summary` says why. `trials` are the errors it rests on."""

    code: str
    summary: str
    trials: tuple[Trial, ...]
    extrapolation: tuple[Extrapolation, ...] = ()

    @property
    def text(self) -> str:
        """Why, and where the training range is left."""
        return " ".join([self.summary, *(f"{e}." for e in self.extrapolation)])

    @property
    def warnings(self) -> tuple[Warning, ...]:
        """One where the learner hurts."""
        return (Warning("learner_hurts", self.text),) if self.code == "hurts" else ()


def free_run_error(
    model: Model,
    record: Record,
    skip: int | tuple[int, ...] = 0,
    unit: Any = None,
    *,
    response: Response | None = None,
) -> float:
    """RMS of the free run's error, each output in its `unit`, by default its own deviation; inf where it diverges.

    `response` is the model's free run of the record, if it is there already.
    """
    response = model.simulate(record) if response is None else response
    if any(trajectory.diverged for trajectory in response.trajectories):
        return math.inf
    scores = response.scores(skip)
    relative = np.where(np.isfinite(scores.nrmse), scores.nrmse, scores.rmse / model.deviation)
    relative = relative if unit is None else scores.rmse / unit
    return float(np.sqrt(np.mean(relative**2))) if np.isfinite(relative).all() else math.inf


def trial_on(
    where: str,
    record: Record,
    skip: tuple[int, ...],
    alone: Model,
    model: Model,
    *,
    alone_response: Response | None = None,
    response: Response | None = None,
) -> Trial:
    """Both models' free runs on a record that was not fitted; their responses, if they are there already."""
    error = free_run_error(alone, record, skip, response=alone_response)
    return Trial(where, error, free_run_error(model, record, skip, response=response))


def blocked(record: Record, blocks: int, start: int) -> list[tuple[Record, Record]]:
    """(training, held out) for each of `blocks` contiguous blocks of about equal length, `start` rows of gap around.

    All training records have the same number of usable rows after the first `start` of each experiment.

    Raises:
        InputError: too few rows for so many blocks.
    """
    edges = np.linspace(0, len(record), blocks + 1).round().astype(int)
    folds = []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        held, kept, offset = [], [], 0
        for experiment in record.experiments:
            rows = len(experiment)
            a, b = (int(np.clip(edge - offset, 0, rows)) for edge in (low, high))
            inside = a < b
            held += [experiment.rows(a, b)] if inside else []
            before, after = (a - start, b + start) if inside else (rows, rows)
            kept += [experiment.rows(0, before)] if before > start else []
            kept += [experiment.rows(after, rows)] if rows - after > start else []
            offset += rows
        held = [e for e in held if len(e) > start]
        if sum(len(e) - start for e in held) < _FEWEST or sum(len(e) - start for e in kept) < _FEWEST:
            raise InputError(f"{len(record)} rows are too few for {blocks} blocks with gaps of {start} rows.")
        folds.append((kept, held))
    least = min(sum(len(e) - start for e in kept) for kept, _ in folds)
    return [
        (replace(record, experiments=_cut(kept, least, start)), replace(record, experiments=tuple(held)))
        for kept, held in folds
    ]


def _cut(experiments: list[Experiment], usable: int, start: int) -> tuple[Experiment, ...]:
    """The experiments without the last rows of the longest ones, so that `usable` rows remain."""
    cut = list(experiments)
    while (surplus := sum(len(e) - start for e in cut) - usable) > 0:
        longest = max(range(len(cut)), key=lambda i: len(cut[i]))
        length = len(cut[longest])
        shorter = max(length - surplus, max((len(e) for e in cut if len(e) < length), default=start + 1), start + 1)
        cut[longest] = cut[longest].rows(0, min(shorter, length - 1))
    return tuple(e for e in cut if len(e) > start)


def cross_validate(
    record: Record, fits: Sequence[Callable[[Record], Estimate]], *, blocks: int, start: int
) -> list[tuple[float, ...]]:
    """Free-run errors of every way of fitting on every held-out block, (blocks, fits), in training deviations.

    Args:
        fits: each fits a training record; a failed training counts as a run that diverges.
        start: rows at the beginning of an experiment without a prediction.

    Raises:
        InputError: too few rows for so many blocks.
    """
    folds = blocked(record, blocks, start)
    unit = np.std(np.concatenate([e.outputs for e in record.experiments]), axis=0)

    def one(pair: tuple[Record, Record], check: Callable[[], None]) -> tuple[float, ...]:
        training, held = pair
        errors = []
        for fit in fits:
            check()
            try:
                trained = fit(training)
            except InputError:  # the block took away what the physics needs
                errors.append(math.inf)
                continue
            errors.append(free_run_error(trained.model, held, unit=unit) if trained.status.ok else math.inf)
        return tuple(errors)

    return spread(one, folds)


def judge(trials: Sequence[Trial], extrapolation: Sequence[Extrapolation] = ()) -> Verdict | None:
    """The verdict on trials of physics alone against the model; None without a trial.

    It helps where the error over all blocks, and on every part of its own, is lower; it hurts where one of them is
    higher by more than 2 %, or where the model runs away and physics alone does not.
    """
    if not trials:
        return None
    blocks = [t for t in trials if t.block]
    groups = [("blocked cross-validation", blocks)] if blocks else []
    groups += [(t.where, [t]) for t in trials if not t.block]
    sentences, codes = [], []
    for where, group in groups:
        alone, model = (math.sqrt(sum(getattr(t, k) ** 2 for t in group) / len(group)) for k in ("alone", "model"))
        ran_away = any(math.isinf(t.model) and not math.isinf(t.alone) for t in group)
        code = "hurts" if ran_away else _compare(alone, model)
        told = _told(alone, model)
        if len(group) > 1:
            told = f"In {where} ({len(group)} blocks, {sum(t.model < t.alone for t in group)} of them better): {told}"
        else:
            told = f"On {where}: {told}"
        sentences.append(told)
        codes.append(code)
    worst = next(code for code in ("hurts", "no_help", "helps") if code in codes)
    hurt = {where for (where, _), code in zip(groups, codes, strict=True) if code == "hurts"}
    beyond = [e for e in extrapolation if e.part in hurt]
    opening = {
        "helps": "The learner helps",
        "no_help": "The learner does not help",
        "hurts": "The learner hurts in extrapolation" if beyond else "The learner hurts",
    }[worst]
    reasons = sentences if worst == "helps" else [s for s, c in zip(sentences, codes, strict=True) if c != "helps"]
    text = ". ".join([opening, *reasons]) + "."
    return Verdict(worst, text, tuple(trials), tuple(extrapolation))


def _told(alone: float, model: float) -> str:
    """Both errors in words."""
    errors = {"with the learner": model, "with physics alone": alone}
    if not any(map(math.isinf, errors.values())):
        return f"free-run NRMSE {model:.4g} with the learner, {alone:.4g} with physics alone"
    told = (f"diverges {who}" if math.isinf(e) else f"has an NRMSE of {e:.4g} {who}" for who, e in errors.items())
    return f"the free run {' and '.join(told)}"


def _compare(alone: float, model: float) -> str:
    if math.isinf(model):
        return "no_help" if math.isinf(alone) else "hurts"
    if model > (1 + _WORTH) * alone:
        return "hurts"
    return "helps" if model < (1 - _WORTH) * alone else "no_help"


def extrapolation(part: str, x: Matrix, training: Matrix, layout: Layout) -> list[Extrapolation]:
    """Entries of the regressor in which a part leaves the range of the training data; one lag a channel.

    Args:
        part: its name.
        x: its regressors (N, nx), in the order of the layout; `training` those of the training data.
    """
    leaving: dict[str, Extrapolation] = {}
    for j, lag in enumerate(layout):
        low, high = float(training[:, j].min()), float(training[:, j].max())
        beyond = (x[:, j] < low) | (x[:, j] > high)
        if beyond.any() and lag.channel not in leaving:
            reach = (float(x[:, j].min()), float(x[:, j].max()))
            leaving[lag.channel] = Extrapolation(part, str(lag), (low, high), reach, float(beyond.mean()))
    return list(leaving.values())


def dominance(fit: Estimate, *, one_step: Response | None = None) -> float | None:
    """‖F̃‖ / ‖Φθ̂‖ over the training rows, the learner's part against the physics'; None where the physics gives 0.

    `one_step` is the prediction of these rows, if it is there already.
    """
    parts = (fit.model.components(fit.problem.record) if one_step is None else one_step).trajectories
    learner = math.sqrt(sum(float(np.nansum(t.learner**2)) for t in parts))
    physics = math.sqrt(sum(float(np.nansum(t.baseline**2)) for t in parts))
    return learner / physics if physics > 0 else None
