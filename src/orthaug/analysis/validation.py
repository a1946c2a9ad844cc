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

from orthaug._base.errors import InputError
from orthaug._base.parallel import spread
from orthaug.data.record import Experiment, Record
from orthaug.data.regressors import Layout, stack_rows
from orthaug.fitting.estimates import Estimate
from orthaug.models.model import Model

_WORTH = 0.02  # of the error: less than this is neither help nor harm
_FEWEST = 20  # usable rows of a block


class Trial(NamedTuple):
    """Free-run errors on one piece of data that was not fitted, in standard deviations; inf where a run diverges."""

    where: str
    alone: float
    model: float


@dataclass(frozen=True)
class Extrapolation:
    """How far a part leaves the training data in one entry of the regressor."""

    part: str
    lag: str
    training: tuple[float, float]
    found: tuple[float, float]
    share: float
    """Of the part's rows that lie outside."""

    def __str__(self) -> str:
        low, high = self.training
        return (
            f"In {self.lag}, {self.part} leaves the training range of {low:.4g} to {high:.4g}: it goes from "
            f"{self.found[0]:.4g} to {self.found[1]:.4g}, outside on {100 * self.share:.2g} % of its rows"
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


def free_run_error(model: Model, record: Record, skip: int | tuple[int, ...] = 0, unit: Any = None) -> float:
    """RMS of the free run's error, each output in its `unit`, by default its own deviation; inf where it diverges."""
    response = model.simulate(record)
    if any(trajectory.diverged for trajectory in response.trajectories):
        return math.inf
    scores = response.scores(skip)
    relative = np.where(np.isfinite(scores.nrmse), scores.nrmse, scores.rmse * model.weight)
    relative = relative if unit is None else scores.rmse / unit
    return float(np.sqrt(np.mean(relative**2))) if np.isfinite(relative).all() else math.inf


def trial_on(where: str, record: Record, skip: tuple[int, ...], alone: Model, model: Model) -> Trial:
    """Both models' free runs on a record that was not fitted."""
    return Trial(where, free_run_error(alone, record, skip), free_run_error(model, record, skip))


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
                found = fit(training)
            except InputError:  # the block took away what the physics needs
                errors.append(math.inf)
                continue
            errors.append(free_run_error(found.model, held, unit=unit) if found.status.ok else math.inf)
        return tuple(errors)

    return spread(one, folds)


def judge(trials: Sequence[Trial], extrapolation: Sequence[Extrapolation] = ()) -> Verdict | None:
    """The verdict on trials of physics alone against the model; None without a trial.

    It helps where the error over all blocks, and on every part of its own, is lower; it hurts where one of them is
    higher by more than 2 %, or where the model runs away and physics alone does not.
    """
    if not trials:
        return None
    blocks = [t for t in trials if t.where.startswith("block")]
    groups = [("blocked cross-validation", blocks)] if blocks else []
    groups += [(t.where, [t]) for t in trials if not t.where.startswith("block")]
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


def extrapolation(part: str, record: Record, training: Record, layout: Layout) -> list[Extrapolation]:
    """Entries of the regressor in which a record leaves the range of the training data; one lag a channel."""
    inside, outside = stack_rows(training, layout).x, stack_rows(record, layout).x
    found: dict[str, Extrapolation] = {}
    for j, lag in enumerate(layout):
        low, high = float(inside[:, j].min()), float(inside[:, j].max())
        beyond = (outside[:, j] < low) | (outside[:, j] > high)
        if beyond.any() and lag.channel not in found:
            reach = (float(outside[:, j].min()), float(outside[:, j].max()))
            found[lag.channel] = Extrapolation(part, str(lag), (low, high), reach, float(beyond.mean()))
    return list(found.values())


def dominance(fit: Estimate) -> float | None:
    """‖F̃‖ / ‖Φθ̂‖ over the training rows, the learner's part against the physics'; None where the physics gives 0."""
    parts = fit.model.components(fit.problem.record).trajectories
    learner = math.sqrt(sum(float(np.nansum(t.learner**2)) for t in parts))
    physics = math.sqrt(sum(float(np.nansum(t.baseline**2)) for t in parts))
    return learner / physics if physics > 0 else None


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
