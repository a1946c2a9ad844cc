"""Validation of a learner: free runs of the model and of physics alone on unfitted data."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, check_count, check_type
from orthaug._base.errors import InputError, Warning
from orthaug._base.lines import percent
from orthaug._base.parallel import Threads
from orthaug.data.record import Record
from orthaug.data.regressors import Layout
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.held_out import (
    Folds,
    HeldOutErrors,
    Pieces,
    Ratio,
    mean_square,
    squared_errors,
)
from orthaug.models.model import Model
from orthaug.models.response import Response

# Of the training range: an excursion that is reported, and one that counts on any row
_BEYOND, _FAR = (0.01, 0.1)
_OFTEN = 0.01  # of the rows: a smaller excursion counts from there on
_MUCH = 0.1  # of a part's rows outside: what is wrong there may be that
# Ratio of errors below which an interval that holds 1 leaves undecided what is not shown, and lower
# end of such an interval from which on a gain that matters is not excluded
_LIKELY, _NOT_EXCLUDED = 0.9, 0.8


@dataclass(frozen=True)
class Trial:
    """Free-run errors on one piece of data that was not fitted, in standard deviations.

    Inf where a run diverges.

    `block` is true for a block of cross-validation, and false for a part of its own. `pieces` holds
    the squared errors along the runs, of physics alone and of the model, for the uncertainty of
    their ratio. `note` says of blocks that they leave the range of the other rows.
    """

    where: str
    alone: float
    model: float
    block: bool = False
    pieces: tuple[Pieces, Pieces] | None = field(default=None, compare=False, repr=False)
    note: str = field(default="", compare=False, repr=False)


@dataclass(frozen=True)
class Extrapolation:
    """Distance of a part beyond the training data in one entry of the regressor."""

    part: str
    lag: str
    training: tuple[float, float]
    reach: tuple[float, float]
    share: float
    """Of the part's rows that lie outside."""

    def __str__(self) -> str:
        low, high = self.training
        return (
            f"In {self.lag}, {self.part} leaves the training range of {low:.4g} to {high:.4g}: "
            f"it goes from {self.reach[0]:.4g} to {self.reach[1]:.4g}, outside on "
            f"{percent(self.share)} of its rows"
        )


@dataclass(frozen=True)
class Verdict:
    """`code` is helps, no_help or hurts; `summary` says why. `trials` are the errors it rests on.

    `ratio` is the error with the learner over that of physics alone where that decided; None
    without errors along runs.
    """

    code: str
    summary: str
    trials: tuple[Trial, ...]
    extrapolation: tuple[Extrapolation, ...] = ()
    ratio: Ratio | None = None

    @property
    def text(self) -> str:
        """Reason for the verdict, and channels outside the training range."""
        return " ".join([self.summary, *(f"{e}." for e in self.extrapolation)])

    @property
    def warnings(self) -> tuple[Warning, ...]:
        """One where the learner hurts."""
        return (Warning("learner_hurts", self.text),) if self.code == "hurts" else ()


def free_run_error(
    model: Model,
    record: Record,
    skip: int | tuple[int, ...] = 0,
    *,
    response: Response | None = None,
) -> float:
    """Return the RMS of the free run's error, each output in its deviation.

    Inf where it diverges.

    `response` is the model's free run of the record, if it is there already.
    """
    response = model.simulate(record) if response is None else response
    if any(trajectory.diverged for trajectory in response.trajectories):
        return math.inf
    scores = response.scores(skip)
    relative = np.where(np.isfinite(scores.nrmse), scores.nrmse, scores.rmse / model.deviation)
    return float(np.sqrt(np.mean(relative**2))) if np.isfinite(relative).all() else math.inf


def score_trial(
    where: str,
    record: Record,
    skip: tuple[int, ...],
    alone: Model,
    model: Model,
    *,
    alone_response: Response | None = None,
    response: Response | None = None,
) -> Trial:
    """Return both models' free runs on a record that was not fitted.

    Their responses, if they are there already.
    """
    alone_response = alone.simulate(record) if alone_response is None else alone_response
    response = model.simulate(record) if response is None else response
    error = free_run_error(alone, record, skip, response=alone_response)
    pieces = tuple(squared_errors(run, model.deviation, skip) for run in (alone_response, response))
    own = free_run_error(model, record, skip, response=response)
    return Trial(where, error, own, pieces=(pieces[0], pieces[1]))


def trials_of(held_out: HeldOutErrors) -> list[Trial]:
    """Return the errors by which a run was chosen, as trials."""
    chosen, trials = held_out.runs[held_out.chosen], []
    for label in dict.fromkeys(held_out.labels):
        own = [i for i, other in enumerate(held_out.labels) if other == label]
        pieces = [held_out.alone[i] for i in own], [chosen[i] for i in own]
        trials.append(_trial(label, *pieces, held_out.note))
    return trials


def _trial(label: str, alone: Pieces, model: Pieces, note: str) -> Trial:
    """Return a trial of squared errors, in deviations of the training output."""
    block = label.startswith("block ")
    errors = math.sqrt(mean_square(alone)), math.sqrt(mean_square(model))
    return Trial(label, *errors, block, (alone, model), note)


def cross_validate(
    record: Record,
    fits: Sequence[Callable[[Record], Estimate]],
    *,
    folds: Folds,
    runner: Any = Threads(),  # noqa: B008  (it holds nothing)
) -> list[list[Pieces]]:
    """Return squared free-run errors of every fit on every held-out block, in training deviations.

    Args:
        fits: each fits a training record; a failed training counts as runs that diverge.
        folds: of the record.
        runner: makes the fits of each block; an `Engine`, or `Threads()`.

    Returns:
        For every block the errors of every fit.
    """
    return list(runner.map(_on_block, (tuple(fits), record.deviation), folds.pairs))


def _on_block(given: Any, pair: tuple[Record, Record], report: Callable[..., None]) -> list[Pieces]:
    """Return the errors on a block of every fit of the rest."""
    (fits, unit), (training, held), errors = given, pair, []
    for fit in fits:
        report()
        found: Pieces = [None] * len(held.experiments)
        with suppress(InputError):  # the block took away what the physics needs
            trained = fit(training)
            found = (
                squared_errors(trained.model.simulate(held), unit) if trained.status.ok else found
            )
        errors.append(found)
    return errors


def block_trials(errors: Sequence[Sequence[Pieces]], fit: int, note: str = "") -> list[Trial]:
    """Return the trials of one fit against the first one, from `cross_validate`.

    Args:
        note: on the folds.
    """
    return [
        _trial(f"block {i + 1} of {len(errors)}", block[0], block[fit], note)
        for i, block in enumerate(errors)
    ]


def judge(trials: Sequence[Trial], extrapolation: Sequence[Extrapolation] = ()) -> Verdict | None:
    """Return the verdict on trials of physics alone against the model; None without a trial.

    All blocks together, and every part of its own, are judged by one rule (`Ratio.code`). The
    learner helps where each of them says so; it hurts where one of them does, or where the model
    runs away and physics alone does not.
    """
    if not trials:
        return None
    blocks = [t for t in trials if t.block]
    groups = [("blocked cross-validation", blocks)] if blocks else []
    groups += [(t.where, [t]) for t in trials if not t.block]
    sentences, codes, ratios = [], [], []
    for where, group in groups:
        alone, model = (
            math.sqrt(sum(getattr(t, k) ** 2 for t in group) / len(group))
            for k in ("alone", "model")
        )
        ran_away = any(math.isinf(t.model) and not math.isinf(t.alone) for t in group)
        ratio = _ratio(group, alone, model)
        sure = f" ({ratio})" if str(ratio) and ratio.low < ratio.high else ""
        sentence = _comparison(alone, model) + sure
        if len(group) > 1:
            sentence = (
                f"In {where} ({len(group)} blocks, {sum(t.model < t.alone for t in group)} of "
                f"them better): {sentence}"
            )
        else:
            sentence = f"On {where}: {sentence}"
        sentences.append(sentence)
        codes.append("hurts" if ran_away else ratio.code)
        ratios.append(ratio)
    worst = next(code for code in ("hurts", "no_help", "helps") if code in codes)
    hurt = {where for (where, _), code in zip(groups, codes, strict=True) if code == "hurts"}
    beyond = [e for e in extrapolation if e.part in hurt and e.share > _MUCH]
    ratio = ratios[codes.index(worst)]
    opening = {
        "helps": "The learner helps",
        "no_help": _no_help(ratio),
        "hurts": "The learner hurts in extrapolation" if beyond else "The learner hurts",
    }[worst]
    reasons = (
        sentences
        if worst == "helps"
        else [s for s, c in zip(sentences, codes, strict=True) if c != "helps"]
    )
    notes = dict.fromkeys(t.note for t in trials if t.note)
    text = " ".join([". ".join([opening, *reasons]) + ".", *notes])
    return Verdict(worst, text, tuple(trials), tuple(extrapolation), ratio)


def _no_help(ratio: Ratio) -> str:
    """Return the opening of a verdict on a learner that does not help, or not by much."""
    if ratio.low < ratio.high < 1:
        return "The learner lowers the free run's error surely, but by little"
    if ratio.high > 1 and (ratio.value < _LIKELY or ratio.low < _NOT_EXCLUDED):
        return "It is undecided whether the learner helps"
    return "The learner does not help"


def _ratio(group: Sequence[Trial], alone: float, model: float) -> Ratio:
    """Return the ratio of a group's errors, with its interval where errors along runs are known."""
    pieces = [t.pieces for t in group]
    if any(piece is None for piece in pieces):
        return Ratio.exactly(model, alone)
    both = [piece for piece in pieces if piece is not None]
    return Ratio.of(
        [run for _, model in both for run in model], [run for alone, _ in both for run in alone]
    )


def _comparison(alone: float, model: float) -> str:
    """Return both errors in words."""
    errors = {"with the learner": model, "with physics alone": alone}
    if not any(map(math.isinf, errors.values())):
        return f"free-run NRMSE {model:.4g} with the learner, {alone:.4g} with physics alone"
    clauses = (
        f"diverges {who}" if math.isinf(e) else f"has an NRMSE of {e:.4g} {who}"
        for who, e in errors.items()
    )
    return f"the free run {' and '.join(clauses)}"


def extrapolation(part: str, x: Matrix, training: Matrix, layout: Layout) -> list[Extrapolation]:
    """Return entries of the regressor in which a part leaves the range of the training data.

    There is one lag for each channel.

    Effects of noise on extreme values are not reported: excursions by less than a hundredth of the
    range, or on few rows.

    Args:
        part: its name.
        x: its regressors (N, nx), in the order of the layout; `training` those of the training
            data.
    """
    leaving: dict[str, Extrapolation] = {}
    for j, lag in enumerate(layout):
        low, high = float(training[:, j].min()), float(training[:, j].max())
        beyond = (x[:, j] < low) | (x[:, j] > high)
        reach = (float(x[:, j].min()), float(x[:, j].max())) if len(x) else (low, high)
        excess = max(low - reach[0], reach[1] - high)
        often = excess > _BEYOND * (high - low) and beyond.mean() >= _OFTEN
        if (often or excess > _FAR * (high - low)) and lag.channel not in leaving:
            leaving[lag.channel] = Extrapolation(
                part, str(lag), (low, high), reach, float(beyond.mean())
            )
    return list(leaving.values())


def dominance(fit: Estimate) -> float | None:
    """Return ‖F̃‖ / ‖Φθ̂‖ over the training rows, the learner's part against the physics'.

    None where the physics gives 0.
    """
    parts = fit.model.components(fit.problem.record).trajectories
    learner = math.sqrt(sum(float(np.nansum(t.learner**2)) for t in parts))
    physics = math.sqrt(sum(float(np.nansum(t.baseline**2)) for t in parts))
    return learner / physics if physics > 0 else None


def verdict(
    fit: Estimate,
    alone: Estimate,
    tests: Record | Mapping[str, Record],
    *,
    skip: int = 0,
) -> Verdict:
    """Return whether the learner helps, by free runs of a fit and of physics alone on new records.

    Args:
        fit: with a learner.
        alone: the same physics without, `estimate(…, learner=None)`, trained on the same record.
        tests: a record, or several by name. A free run starts from the measured outputs before its
            first row, that of a motion from the state by which it follows its first rows.
        skip: leading samples of each experiment that are not scored.

    Returns:
        `code` is helps, no_help or hurts; `text` says why, with the errors of both and where the
        training range is left; `trials` are the errors.

    Raises:
        InputError: a record without outputs or with other channels; an estimate that is not usable.

    Examples:
        >>> import numpy as np
        >>> import orthaug as oa
        >>> u = np.random.default_rng(0).uniform(-1, 1, 300)
        >>> noise = 0.05 * np.random.default_rng(1).normal(size=300)
        >>> record = oa.Record.from_arrays(u, 2 * u + u**3 + noise)
        >>> gain = oa.Baseline.from_terms([oa.Term("gain", "u[k]")])
        >>> train, test = record.split(0.7)
        >>> fit = oa.estimate(train, gain, learner=oa.Terms(("u[k]**3",)))
        >>> verdict(fit, oa.estimate(train, gain, learner=None), test).code
        'helps'
    """
    for name, estimate in (("fit", fit), ("alone", alone)):
        check_type(estimate, Estimate, name, "an Estimate")
        if not estimate.status.ok:
            raise InputError(f"`{name}` has no model: {estimate.status.message}.")
    check_type(tests, Record | Mapping, "tests", "a Record, or Records by name")
    records = {"the test record": tests} if isinstance(tests, Record) else dict(tests)
    if not records:
        raise InputError("`tests` is empty; give a record that was not fitted.")
    skip = check_count(skip, "skip", least=0)
    trials, beyond, trained = [], [], (fit.reach(fit.problem.record), fit.layout)
    for name, record in records.items():
        check_type(record, Record, f"tests[{name!r}]", "a Record")
        ordered = fit.model.fitting(record, need_outputs=True)
        skips = (skip,) * len(ordered.experiments)
        trials.append(score_trial(str(name), ordered, skips, alone.model, fit.model))
        beyond += extrapolation(str(name), fit.reach(ordered), *trained)
    found = judge(trials, beyond)
    assert found is not None
    return found
