"""Errors on held-out rows, and the one rule by which two models are compared there.

Starts, regularizations, the fallback to physics alone and every verdict rest on it. Blocked
cross-validation leaves out one contiguous block after another, with gaps of the lag length, so that
no sample is predicted from its own neighbours in the training data.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import Any

import numpy as np
from jaxtyping import Bool
from scipy import special

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug._base.lines import percent
from orthaug.data.record import Experiment, Record
from orthaug.models.model import Model
from orthaug.models.response import Response

WORTH = 0.02  # of the error: less than this is neither help nor harm
_FEWEST = 20  # usable rows of a block
# Of the rows of held-out blocks: more outside the range of the others compares extrapolations
_OUTSIDE = 0.25
_BARELY = 0.01  # of the range: less is not outside
_SPREAD, _FEWEST_SPREAD = 4, 40  # stretches of a block that is spread at most; rows of one at least
# Pieces of a free run that the bootstrap draws from: longer than its errors remember
_STRETCHES = 20
_DRAWS = 999

_Rows = tuple[int, int, int]  # an experiment, its rows from, and to
Pieces = Sequence[Vector | None]
"""Squared errors along each held-out run, mean over the outputs; None for a run that diverged."""


@dataclass(frozen=True)
class Ratio:
    """RMS error of a model over that of another on the same rows.

    The 95 % interval is by the block bootstrap.

    Where only one of them diverges it is 0 or infinite, and the interval with it; where both do
    there is none.
    """

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, model: Pieces, other: Pieces) -> Ratio:
        """Return the ratio of one model's errors to the other's.

        Runs that diverge count first; then those that both survive.
        """
        lost, other_lost = (sum(piece is None for piece in pieces) for pieces in (model, other))
        if lost != other_lost:
            certain = math.inf if lost > other_lost else 0.0
            return cls(certain, certain, certain)
        both = [
            (a, b)
            for a, b in zip(model, other, strict=True)
            if a is not None and b is not None and len(a)
        ]
        if not both:
            return cls(math.nan, math.nan, math.nan)
        sums = np.concatenate([_stretches(a, b, sum(len(a) for a, _ in both)) for a, b in both])
        drawn = np.random.default_rng(0).integers(len(sums), size=(_DRAWS, len(sums)))
        with np.errstate(all="ignore"):
            ratios = np.sqrt(sums[drawn, 0].sum(axis=1) / sums[drawn, 1].sum(axis=1))
            value = float(np.sqrt(sums[:, 0].sum() / sums[:, 1].sum()))
        if not np.isfinite(ratios).all():  # the other follows some rows exactly
            return cls(value, value, value)
        tail = _tail(len(sums))
        return cls(value, *(float(q) for q in np.quantile(ratios, (tail, 1 - tail))))

    @classmethod
    def exactly(cls, model: float, other: float) -> Ratio:
        """Return the ratio of two known errors, without an interval."""
        if math.isinf(model) and math.isinf(other):
            value = math.nan
        else:
            value = model / other if other > 0 else math.inf if model > 0 else math.nan
        return cls(value, value, value)

    @property
    def code(self) -> str:
        """helps, hurts, or no_help where the interval holds 1 or the difference is below 2 %."""
        if self.high < 1 and self.value < 1 - WORTH:
            return "helps"
        return "hurts" if self.low > 1 and self.value > 1 + WORTH else "no_help"

    def __str__(self) -> str:
        if not 0 < self.value < math.inf:
            return ""
        return f"ratio {self.value:.3g}, 95 % interval {self.low:.3g} to {self.high:.3g}"


def _tail(count: int) -> float:
    """Return the level of the percentiles of `count` stretches.

    2.5 %, expanded for few stretches (Hesterberg 2015, sect. 5).
    """
    if count < 2:
        return 0.0
    return float(special.ndtr(np.sqrt(count / (count - 1)) * special.stdtrit(count - 1, 0.025)))


def _stretches(model: Vector, other: Vector, rows: int) -> np.ndarray:
    """Return sums of both over stretches of one run, (stretches, 2).

    `rows` of all runs together make `_STRETCHES`.
    """
    count = max(1, min(round(_STRETCHES * len(model) / rows), len(model)))
    edges = np.linspace(0, len(model), count + 1).astype(int)[:-1]
    return np.stack([np.add.reduceat(errors, edges) for errors in (model, other)], axis=-1)


@dataclass(frozen=True)
class Candidate:
    """A compared model: its criterion `prediction` or `simulation`, its free run's error.

    `error` is the RMS error where nothing was fitted, in standard deviations of the training
    output; infinite where the run diverges, NaN where it was not tried.
    """

    focus: str
    learner: bool
    error: float

    def __str__(self) -> str:
        how = "one step ahead" if self.focus == "prediction" else "on the free run"
        return f"{'physics and learner' if self.learner else 'physics alone'} trained {how}"

    @property
    def described(self) -> str:
        """The candidate with its error."""
        return f"{self}: {f'{self.error:.3g}' if math.isfinite(self.error) else 'diverges'}"


@dataclass(frozen=True)
class Focus:
    """The choice of `Auto`, `prediction` or `simulation`, with reason and candidates."""

    chosen: str
    text: str
    candidates: tuple[Candidate, ...] = ()

    def tried(self, focus: str) -> bool:
        """Return whether training by a criterion was compared with others."""
        return any(c.focus == focus and not math.isnan(c.error) for c in self.candidates)


@dataclass(frozen=True, eq=False)
class HeldOutErrors:
    """Squared errors on held-out rows, of physics alone and of every run.

    Runs are in the order of `Estimate.restarts`.

    In deviations of the training output, of the criterion's own response; by pieces, None for one
    that diverged. `chosen` is the number of the run of the lowest error.
    """

    where: str
    labels: tuple[str, ...]
    """What each piece belongs to: a block, or a part."""
    alone: Pieces = field(repr=False)  # an error for every row: thousands of lines on a screen
    runs: tuple[Pieces, ...] = field(repr=False)
    chosen: int = 0
    note: str = ""
    """A sentence on blocks that leave the range of the other rows; "" where none do."""

    @property
    def ratio(self) -> Ratio:
        """Ratio of the chosen run's error to that of physics alone."""
        return Ratio.of(self.runs[self.chosen], self.alone)


def mean_square(pieces: Pieces) -> float:
    """Return the mean over all rows of all runs; infinite where one diverged."""
    if any(piece is None for piece in pieces):
        return math.inf
    return float(np.mean(np.concatenate([piece for piece in pieces if piece is not None])))


def squared_errors(
    response: Response, unit: Any, skip: int | tuple[int, ...] = 0
) -> list[Vector | None]:
    """Return the squared errors of a response along each experiment.

    Each output counts in its `unit`; the mean is over the outputs that were measured. Rows without
    any are left out.

    Args:
        skip: leading samples of each experiment that do not count, as in `Response.scores`.
    """
    skips = (skip,) * len(response.trajectories) if isinstance(skip, int | np.integer) else skip
    pieces: list[Vector | None] = []
    for trajectory, first in zip(response.trajectories, skips, strict=True):
        assert trajectory.measured is not None, "errors need measured outputs"
        rows = slice(max(trajectory.start, first), None)
        measured = trajectory.measured[rows]
        there = ~np.isnan(measured)
        some = there.any(axis=1)
        with np.errstate(all="ignore"):
            squares = np.mean(
                ((measured - trajectory.model[rows])[some] / unit) ** 2, axis=1, where=there[some]
            )
        pieces.append(
            squares if trajectory.diverged is None and np.isfinite(squares).all() else None
        )
    return pieces


@dataclass(frozen=True, eq=False)
class Folds:
    """Folds of blocked cross-validation: (training, held out) of each.

    A block is one stretch of rows. Where whole blocks leave the range of the learner's features
    over the other rows, which compares extrapolations, it is several stretches spread over the
    record, less those that leave that range still.
    """

    pairs: tuple[tuple[Record, Record], ...]
    stretches: int = 1
    feature: str = ""
    """The learner's input that whole blocks leave the range of; "" for none."""
    share: float = 0.0
    """Of the rows of whole blocks that lie outside it."""

    @property
    def where(self) -> str:
        """The name of the comparison."""
        return f"blocked cross-validation ({len(self.pairs)} blocks)"

    @property
    def note(self) -> str:
        """A sentence on blocks that leave the range of the other rows; "" where none do."""
        if not self.feature:
            return ""
        outside = f"in {self.feature}, on {percent(self.share)} of their rows"
        if self.stretches > 1:
            return (
                f"Whole blocks would leave the range of the other rows ({outside}). So each block "
                f"is {self.stretches} stretches spread over the record, and those outside that "
                "range do not count."
            )
        return (
            f"The blocks leave the range of the other rows ({outside}), so this compares "
            "extrapolations. A validation part within the range of the training data would judge "
            "the learner there."
        )


def covered_folds(
    record: Record, blocks: int, start: int, model: Model[Any] | None = None
) -> Folds:
    """Return folds whose held-out rows lie in the range of the others, as far as the rows allow.

    Args:
        record: to cut.
        blocks: number of folds.
        start: rows at the beginning of an experiment without a prediction.
        model: of the whole record, whose free run has what the learner sees; None for unknown.

    Raises:
        InputError: too few rows for so many blocks.
    """
    whole = Folds(tuple(held_out_blocks(record, blocks, start)))
    features = None if model is None else _features(model, record)
    if model is None or features is None:
        return whole
    names = [entry.text for entry in model.form.entries]
    lengths = [len(experiment) for experiment in record.experiments]

    def outside(stretches: int) -> list[list[Bool[np.ndarray, "n nz"]]]:
        rows = block_rows(lengths, blocks, start, stretches)
        return [_outside(features, kept, held) for kept, held in rows]

    shares = np.concatenate([piece for fold in outside(1) for piece in fold]).mean(axis=0)
    if not shares.max() > _OUTSIDE:
        return whole
    found = {"feature": names[int(shares.argmax())], "share": float(shares.max())}
    stretches = min(_SPREAD, len(record) // (blocks * _FEWEST_SPREAD))
    if stretches > 1:
        covered = [
            [piece.any(axis=1).mean() < 0.5 for piece in fold] for fold in outside(stretches)
        ]
        if all(map(any, covered)):
            pairs = tuple(
                (training, replace(held, experiments=tuple(compress(held.experiments, inside))))
                for (training, held), inside in zip(
                    held_out_blocks(record, blocks, start, stretches), covered, strict=True
                )
            )
            return Folds(pairs, stretches, **found)
    return replace(whole, **found)


def _features(model: Model[Any], record: Record) -> list[Matrix] | None:
    """Return what the learner sees (N, nz) along the free run of each experiment.

    None where it sees nothing, or the run leaves all bounds. Rows before the run's first are NaN.
    """
    if not (model.learns and model.form.has_range and model.form.entries):
        return None
    found = []
    for experiment in record.experiments:
        seen = model.features_along(*model.free_run(experiment, record))
        if not np.isfinite(seen).all() or seen.shape[1] != len(model.form.entries):
            return None
        before = len(experiment) - len(seen)
        found.append(np.concatenate([np.full((before, seen.shape[1]), np.nan), seen]))
    return found


def _outside(
    features: Sequence[Matrix], kept: Sequence[_Rows], held: Sequence[_Rows]
) -> list[Bool[np.ndarray, "n nz"]]:
    """Return where held-out rows leave the range of the features over the kept ones."""
    training = np.concatenate([features[i][a:b] for i, a, b in kept])
    low, high = np.nanmin(training, axis=0), np.nanmax(training, axis=0)
    slack = _BARELY * (high - low)
    with np.errstate(invalid="ignore"):
        return [
            (features[i][a:b] < low - slack) | (features[i][a:b] > high + slack) for i, a, b in held
        ]


def block_rows(
    lengths: Sequence[int], blocks: int, start: int, stretches: int = 1
) -> list[tuple[list[_Rows], list[_Rows]]]:
    """Return the rows (training, held out) of each block, as (experiment, from, to).

    Args:
        lengths: rows of each experiment.
        blocks: of similar length.
        start: rows around a stretch that are left out; an experiment needs more.
        stretches: that make a block, spread over the record.
    """
    edges = np.linspace(0, sum(lengths), blocks * stretches + 1).round().astype(int)
    found = []
    for block in range(blocks):
        held, kept, offset = [], [], 0
        for i, rows in enumerate(lengths):
            last = 0
            for low, high in zip(edges[block:-1:blocks], edges[block + 1 :: blocks], strict=True):
                a, b = (int(np.clip(edge - offset, 0, rows)) for edge in (low, high))
                if a < b:
                    held.append((i, a, b))
                    kept.append((i, last, a - start))
                    last = b + start
            kept.append((i, last, rows))
            offset += rows
        found.append(
            tuple([(i, a, b) for i, a, b in rows if b - a > start] for rows in (kept, held))
        )
    return found


def held_out_blocks(
    record: Record, blocks: int, start: int, stretches: int = 1
) -> list[tuple[Record, Record]]:
    """Return (training, held out) for each of `blocks` blocks of similar length.

    A block is contiguous, or so many stretches spread over the record. `start` rows around them
    are left out.

    All training records have the same number of usable rows after the first `start` of each
    experiment.

    Raises:
        InputError: too few rows for so many blocks.
    """
    folds = []
    lengths = [len(experiment) for experiment in record.experiments]
    for rows in block_rows(lengths, blocks, start, stretches):
        kept, held = ([record.experiments[i].rows(a, b) for i, a, b in pieces] for pieces in rows)
        if (
            sum(len(e) - start for e in held) < _FEWEST
            or sum(len(e) - start for e in kept) < _FEWEST
        ):
            raise InputError(
                f"{len(record)} rows are too few for {blocks} blocks with gaps of {start} rows; "
                "give more rows, or fewer blocks."
            )
        folds.append((kept, held))
    least = min(sum(len(e) - start for e in kept) for kept, _ in folds)
    return [
        (
            replace(record, experiments=_trim_experiments(kept, least, start)),
            replace(record, experiments=tuple(held)),
        )
        for kept, held in folds
    ]


def _trim_experiments(
    experiments: list[Experiment], usable: int, start: int
) -> tuple[Experiment, ...]:
    """Return the experiments less the last rows of the longest, so that `usable` remain."""
    cut = list(experiments)
    while (surplus := sum(len(e) - start for e in cut) - usable) > 0:
        longest = max(range(len(cut)), key=lambda i: len(cut[i]))
        length = len(cut[longest])
        shorter = max(
            length - surplus,
            max((len(e) for e in cut if len(e) < length), default=start + 1),
            start + 1,
        )
        cut[longest] = cut[longest].rows(0, min(shorter, length - 1))
    return tuple(e for e in cut if len(e) > start)
