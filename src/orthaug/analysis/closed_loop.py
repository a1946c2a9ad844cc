"""Detection of feedback in the record: past outputs that predict an input beside its own past.

In open loop only its own past predicts an input. Under feedback, past outputs carry the
reference and the disturbances into it (Granger 1969; Söderström and Stoica 1989, ch. 10).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.special

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import Warning
from orthaug._base.lines import join_words, percent
from orthaug._base.parallel import one_blas_thread
from orthaug.analysis.predictability import BlockSums, Share
from orthaug.data.gaps import complete_record
from orthaug.data.record import Record

_LEVEL = 0.001  # of the test, divided by the number of inputs
_SHARE = 0.02  # of what its own past leaves of an input: the share by outputs counts from there on
_SURE = 3.0  # standard errors over blocks by which it is significant
_INPUT_LAGS, _OUTPUT_LAGS = 40, 4
_BESIDE = 10  # lags of the other inputs
_LEVELS = 6  # of an input that is held: those before the last change that count as its past
_HELD = 0.2  # share of rows that repeat the row before: from there on only changes are looked at
_ROWS_PER_COLUMN = 5
_MOST = 20_000
_NOTHING = 1e-3  # of an input's deviation: what its own past leaves is then no surprise
_RANK = 1e-10
_EXCHANGED = 0.1  # of an input, by past outputs: less is rather weak feedback
# Of an output, by past inputs: what speaks against an effect of an input
_NO_EFFECT, _ABSENT = 0.01, 0.1  # level, and the share that there is at most
_JUMP = 8.0  # times the median size of what its own past leaves of an input
_ROUNDS = 4
_FEW = 3  # rows from which level, slope and curvature of what follows are read
_EXACT = 1e-4  # of an input's deviation: what they leave of one that follows no output
_SMOOTH_ROWS = 0.2  # of all
_SWITCHES = 8  # of an input of two levels, up and down each
_UNEVEN = 0.1  # deviation over mean of the lengths between them
# Of the distance of the values at which it switches up and down: their scatter, and how far the
# output moves in the second half of a stretch
_ALIKE, _MOVING = 0.15, 0.25
_PERIODIC = 0.9  # autocorrelation at a period, beyond what short lags explain


@dataclass(frozen=True)
class Feedback:
    """Feedback found on an input: past outputs predict a `share` of what its own past leaves.

    `name` is the input, `p` the level of the test. `switched_by` is an output at whose thresholds
    the input switches between two levels; its share is then 1.
    """

    name: str
    share: float
    p: float
    switched_by: str = ""


def feedback_in(record: Record) -> tuple[Feedback, ...]:
    """Return the inputs that surely follow past outputs.

    Nothing can be said of an input that its own past predicts.
    """
    found, complete = [], complete_record(record)
    if complete is None:
        return ()
    record = complete
    with one_blas_thread():
        for j, channel in enumerate(record.inputs):
            tested = _input_share(record, j)
            switched = _switched_by(record, j)
            if switched:
                found.append(Feedback(channel.name, 1.0, 0.0, switched))
            elif tested is not None and tested[1] < _LEVEL / len(record.inputs):
                found.append(Feedback(channel.name, *tested))
    return tuple(found)


def exchanged_with_output(record: Record) -> str:
    """Return the input that may be exchanged with the only output; "" for none.

    Past outputs predict it, as under feedback; but then its own past would predict the output.
    """
    complete = complete_record(record)
    if complete is None or len(record.outputs) != 1:
        return ""
    for one in feedback_in(complete):
        j = [channel.name for channel in complete.inputs].index(one.name)
        follows = one.share > _EXCHANGED and not one.switched_by
        if follows and _moves_nothing(complete, j):
            return one.name
    return ""


def _moves_nothing(record: Record, j: int) -> bool:
    """Return whether the past of input j surely predicts nothing of the only output."""
    every = (
        _rows(e.outputs[:, 0], np.delete(e.inputs, j, axis=1), e.inputs[:, [j]])
        for e in record.experiments
    )
    with one_blas_thread():
        tested = _shares(every)
    if tested is None:
        return False
    share, level = tested
    return level > _NO_EFFECT and share.value + 2 * share.error < _ABSENT


_PAIR = "`controller` and the reference as input"
_FREE_RUN = (
    "A free run on the measured input is then consistent only with complete physics and white "
    "noise on the sensor: "
)
_TWO_STAGE = (
    "in two stages: record the reference, fit the input on it, then the plant on that simulated "
    "input"
)
_REMEDIES = {
    "direct": "One step ahead is then consistent only with complete physics and noise that is "
    'white in the equation: else its bias remains. Give `noise.model = "arma"` (direct), or '
    f"estimate {_TWO_STAGE}.",
    "noise": "One step ahead with a noise model is consistent here, with complete physics and "
    "enough orders of the noise (direct).",
    "free run": f"{_FREE_RUN}disturbances that are fed back bias it. Estimate one step ahead with "
    f'`noise.model = "arma"` (direct), or {_TWO_STAGE}.',
    "motion": f"{_FREE_RUN}disturbances that are fed back bias it. Give {_PAIR}, which simulates "
    f"the loop. If the controller is unknown, estimate {_TWO_STAGE}.",
    "loop": "It is then no reference but the output of another controller: join that to "
    "`controller`, with its own reference as the input.",
}
"""What feedback does to an estimate, and what is consistent, by the method of estimation."""


def closed_loop(record: Record, method: str = "direct") -> tuple[Warning, ...]:
    """Return a warning where inputs follow outputs: what that does to estimates, and what to do.

    Args:
        record: whose inputs are tested.
        method: of estimation: "direct" (one step ahead), "noise" (with a noise model), "free run"
            of lagged physics, "motion", or "loop" for a motion with its controller.
    """
    found = feedback_in(record)
    if not found:
        return ()
    exchanged = exchanged_with_output(record)
    if exchanged:
        share = next(one.share for one in found if one.name == exchanged)
        return (_exchanged(exchanged, record.outputs[0].name, share),)
    named = ", ".join(
        f"{one.name} ({percent(one.share)} of what its own past leaves)"
        if not one.switched_by
        else f"{one.name}, which switches where {one.switched_by} has nearly the same values"
        for one in found
    )
    outputs = ", ".join(channel.name for channel in record.outputs)
    ahead = [done.step for done in record.prepared if done.looks_ahead]
    remedy = (
        f"{join_words(ahead)} filter{'s' if len(ahead) == 1 else ''} with zero phase: inputs then "
        "answer disturbances before these occur, which biases θ with any noise model. Fit the "
        "data as they are."
        if ahead
        else _REMEDIES[method]
    )
    text = (
        f"past {outputs} predict{'s' if len(record.outputs) == 1 else ''} {named}: "
        f"{_source(found, record)} {remedy}"
    )
    return (Warning("closed_loop", text),)


def _exchanged(name: str, output: str, share: float) -> Warning:
    text = (
        f"past {output} predicts {name} ({percent(share)} of what its own past leaves), but past "
        f"{name} does not predict {output}: the columns of both may be exchanged. Check `column` "
        f"of their channels. If they are right, {name} follows {output} without an effect on it."
    )
    return Warning("exchanged_columns", text)


def without_exchanged(warnings: Sequence[Warning], looped: Sequence[Warning]) -> list[Warning]:
    """Return warnings on a record less those that exchanged columns explain: inputs are held."""
    if all(one.code != "exchanged_columns" for one in looped):
        return list(warnings)
    return [one for one in warnings if one.code != "held_output"]


def _source(found: tuple[Feedback, ...], record: Record) -> str:
    """Return a sentence on where feedback comes from.

    Of several inputs, one that follows the outputs may be another quantity of the plant: a motor's
    speed follows its current.
    """
    names = " and ".join(one.name for one in found)
    if len(found) == len(record.inputs):
        return "the data were probably recorded under feedback."
    moved = "it" if len(found) == 1 else "them"
    return (
        f"a controller sets {names}, or the plant itself moves {moved} (as "
        "a motor's current moves its speed). If it is the plant, there is no reference to "
        "record: make it an output with an equation of its own."
    )


def _switched_by(record: Record, j: int) -> str:
    """Return an output at whose thresholds an input switches between two levels; "" for none.

    Its stretches are of unequal length, and end at nearly equal values of the output, which still
    moves there: switched by a clock these values would scatter, unless the output had settled.
    """
    levels = np.unique(np.concatenate([e.inputs[:, j] for e in record.experiments]))
    if len(levels) != 2:
        return ""
    for i, output in enumerate(record.outputs):
        ends: dict[bool, list[Vector]] = {True: [], False: []}
        lengths: dict[bool, list[Vector]] = {True: [], False: []}
        half: dict[bool, list[Vector]] = {True: [], False: []}
        for e in record.experiments:
            at = np.flatnonzero(np.diff(e.inputs[:, j])) + 1
            up = e.inputs[at, j] == levels[1]
            for rises in (True, False):
                ends[rises].append(e.outputs[at[up == rises], i])
                lengths[rises].append(np.diff(at)[up[1:] == rises])
                begin, end = at[:-1][up[1:] == rises], at[1:][up[1:] == rises]
                middle = e.outputs[(begin + end) // 2, i]
                half[rises].append(np.abs(e.outputs[end, i] - middle))
        high, low = (np.concatenate(ends[rises]) for rises in (False, True))
        uneven = [np.concatenate(lengths[rises]) for rises in (True, False)]
        if min(len(high), len(low)) < _SWITCHES or all(
            one.std() < _UNEVEN * one.mean() for one in uneven
        ):
            continue
        between = abs(float(np.median(high) - np.median(low)))
        scatter = max(float(np.median(np.abs(np.diff(one)))) for one in (high, low))
        moved = min(float(np.median(np.concatenate(half[rises]))) for rises in (True, False))
        if scatter < _ALIKE * between and moved > _MOVING * between:
            return output.name
    return ""


def _input_share(record: Record, j: int) -> tuple[float, float] | None:
    """Return share and level of the prediction of input j by past outputs.

    None where that is not enough, or cannot be tested.
    """
    every = (
        _rows(e.inputs[:, j], np.delete(e.inputs, j, axis=1), e.outputs) for e in record.experiments
    )
    return _enough(_shares(every))


def _shares(every: Iterable[tuple[Matrix, Matrix, Vector] | None]) -> tuple[Share, float] | None:
    """Return share and level of a prediction over all experiments; None where it has no test."""
    pieces = [piece for piece in every if piece is not None and len(piece[2])]
    if not pieces:
        return None
    widths = {(own.shape[1], others.shape[1]) for own, others, _ in pieces}
    if len(widths) > 1:  # some are held and some are not: those of which there are more
        best = max(
            widths,
            key=lambda width: sum(
                len(p[2]) for p in pieces if (p[0].shape[1], p[1].shape[1]) == width
            ),
        )
        pieces = [p for p in pieces if (p[0].shape[1], p[1].shape[1]) == best]
    own, others, target = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    return _tested_share(own, others, target)


def _enough(tested: tuple[Share, float] | None) -> tuple[float, float] | None:
    """Return share and level of a test where the share is surely large enough."""
    if tested is None:
        return None
    share, level = tested
    if share.value < _SHARE or share.value < _SURE * share.error:
        return None
    return share.value, level


def _tested_share(own: Matrix, others: Matrix, target: Vector) -> tuple[Share, float] | None:
    """Return the share of a target that `others` predict beside `own`, and the test's level.

    None where there are too few rows, or `own` leaves nothing.
    """
    usual = _usual(own, target)
    own, others, target = _scale(own[usual]), _scale(others[usual]), target[usual]
    if len(target) < _ROWS_PER_COLUMN * (own.shape[1] + others.shape[1] + 1) or not np.ptp(target):
        return None
    base = np.column_stack([np.ones(len(target)), own])
    orthonormal, size, _ = np.linalg.svd(base, full_matrices=False)
    q = orthonormal[:, size > _RANK * size[0]]
    left = target - q @ (q.T @ target)
    if left.std() < _NOTHING * target.std():
        return None
    beside = others - q @ (q.T @ others)
    sums = BlockSums.of(np.column_stack([base, others]), target)
    share: Share = sums.share(
        range(base.shape[1], base.shape[1] + others.shape[1]), range(base.shape[1])
    )
    return share, _wald(beside, left)


def _usual(own: Matrix, target: Vector) -> np.ndarray:
    """Return the rows on which an input does not jump.

    Jumps of a reference would hide everything between them.

    The lags of the rows behind a jump straddle it. Where an input moves smoothly between its jumps,
    as a generator makes it, those rows are left out too: outputs, which have a longer memory, would
    seem to predict them. An input that follows a measured output is never that smooth.
    """
    smooth = _smooth(own, target)
    if smooth.mean() > _SMOOTH_ROWS:
        return smooth
    base = np.column_stack([np.ones(len(target)), _scale(own)])
    kept = np.ones(len(target), dtype=bool)
    for _ in range(_ROUNDS):
        if kept.sum() < _ROWS_PER_COLUMN * base.shape[1]:
            break
        left = np.abs(target - base @ np.linalg.lstsq(base[kept], target[kept], rcond=1e-10)[0])
        kept = left <= _JUMP * max(float(np.median(left)), _NOTHING * float(target.std()))
    return kept


def _smooth(own: Matrix, target: Vector) -> np.ndarray:
    """Return the rows without a jump among their last few, if these predict them all but exactly.

    None of the rows where they do not.
    """
    few = np.column_stack([target, own[:, : _FEW + 1]])
    moves = np.abs(np.diff(few, axis=1))
    calm = (moves <= _JUMP * np.median(moves)).all(axis=1)
    base = np.column_stack([np.ones(len(target)), own[:, :_FEW]])
    left = np.full(len(target), np.inf)
    for _ in range(_ROUNDS):  # what is left are jumps no larger than its usual moves
        if calm.sum() < _ROWS_PER_COLUMN * base.shape[1]:
            break
        left = np.abs(target - base @ np.linalg.lstsq(base[calm], target[calm], rcond=1e-12)[0])
        calm &= left <= _JUMP * max(float(np.median(left[calm])), _EXACT * float(target.std()))
    return calm & bool(np.all(left[calm] < _JUMP * _EXACT * target.std()))


def _wald(columns: Matrix, target: Vector) -> float:
    """Return the level at which all coefficients are 0, robust to unequal errors (White 1980)."""
    u, size, _ = np.linalg.svd(columns, full_matrices=False)
    u = u[:, size > 1e-9 * size.max(initial=0.0)]
    moments = u.T @ target
    scores = u * (target - u @ moments)[:, None]
    spread = scores.T @ scores * len(target) / max(len(target) - u.shape[1], 1)
    statistic = float(moments @ np.linalg.lstsq(spread, moments, rcond=None)[0])
    return float(scipy.special.chdtrc(max(u.shape[1], 1), statistic))


def _rows(u: Vector, beside: Matrix, y: Matrix) -> tuple[Matrix, Matrix, Vector] | None:
    """Return an input's past and that of those `beside` it, past outputs, and the input."""
    u, beside, y = u[-_MOST:], beside[-_MOST:], y[-_MOST:]
    changes = np.flatnonzero(np.diff(u)) + 1
    if len(changes) < (1 - _HELD) * (len(u) - 1):
        levels = np.concatenate([u[:1], u[changes]])
        period = _period(levels, _LEVELS)
        past = _LEVELS if period is None else max(period + 1, _LEVELS)
        rows, own = changes[past - 1 :], _own_past(levels, _LEVELS, period, past)
        own = (
            np.column_stack([own, levels[past - 1 : -1] ** 2, levels[past - 1 : -1] ** 3])
            if len(own)
            else own
        )
        enough = rows >= _BESIDE
        own = np.column_stack([own[enough], _past(beside, rows[enough], _BESIDE)])
        return own, _past(y, rows[enough], _OUTPUT_LAGS), u[rows[enough]]
    lags = min(_INPUT_LAGS, len(u) // (2 * _ROWS_PER_COLUMN))
    period = _period(u, lags)
    past = max(lags, _BESIDE) if period is None else max(period + 1, _BESIDE)
    if len(u) <= past:
        return None
    own = _own_past(u, lags, period, past)
    rows = np.arange(past, len(u))
    return (
        np.column_stack([own, _past(beside, rows, _BESIDE)]),
        _past(y, rows, _OUTPUT_LAGS),
        u[past:],
    )


def _own_past(x: Vector, count: int, period: int | None, first: int) -> Matrix:
    """Return the first `count` lags, and those about a period."""
    lags = [*range(1, count + 1), *(() if period is None else range(period - 1, period + 2))]
    rows = np.arange(first, len(x))
    return (
        np.column_stack([x[rows - lag] for lag in lags]) if len(rows) else np.zeros((0, len(lags)))
    )


def _past(y: Matrix, rows: np.ndarray, lags: int) -> Matrix:
    return np.column_stack([y[rows - lag] for lag in range(1, lags + 1)])


def _period(x: Vector, beyond: int) -> int | None:
    """Return the lag, larger than `beyond`, at which a signal repeats itself.

    None where it does not within its half.
    """
    n = len(x)
    centred = x - x.mean()
    power = np.abs(np.fft.rfft(centred, 2 * n)) ** 2
    acf = np.fft.irfft(power)[:n]
    lags = np.arange(n)
    head = np.concatenate([[0.0], np.cumsum(centred**2)])
    norm = np.sqrt(np.maximum(head[n - lags] * (head[n] - head[lags]), np.finfo(float).tiny))
    r = (acf / norm)[: n // 2 + 1]
    later = np.arange(beyond + 1, len(r) - 1)
    peaks = (
        later[(r[later] > _PERIODIC) & (r[later] >= r[later - 1]) & (r[later] >= r[later + 1])]
        if len(later)
        else []
    )
    return int(peaks[np.argmax(r[peaks])]) if len(peaks) else None


def _scale(x: Matrix) -> Matrix:
    size = x.std(axis=0)
    return (x - x.mean(axis=0)) / np.where(size > 0, size, 1.0)
