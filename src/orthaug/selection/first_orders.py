"""Orders of a first linear model, judged by the free run on held-out rows.

Least squares one step ahead is biased by noise on the outputs, most where a system is slow beside
its sampling. Instruments mend it (Young and Jakeman 1979): the outputs of the free run in place of
the measured ones, with all rows filtered by 1/A of the model before. That begins at least squares,
and where light damping makes these useless, at the poles of a long model that is reduced (Kung
1978).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, TypeAlias

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug.data.record import Experiment, Record
from orthaug.data.sources import RecordSource, witness
from orthaug.selection.orders import Orders, correlated_delay

_MOST = 4  # lags of a channel
_LONG = 40  # lags of a long model, whose poles orders begin at
_RESPONSE = 200  # rows of its impulse response
_PER_COLUMN = 5  # rows that one of its coefficients needs
LOOKED_AT = 40_000
"""Rows of a longer record that orders are found on, in windows spread over it."""
FITTED = 0.7  # share of the rows that a candidate is fitted to
_REFINED = 5  # times that instruments refine a fit, at most
_AS_GOOD = 1.05  # free-run error over the best, up to which fewer lags are taken
# Free-run error over that from another first lag, up to which the lag that a test found is kept
_BETTER = 1.2
_RANK = 1e-9  # singular value over the largest
PERSISTENCE = 20  # the highest order of excitation that is looked for
_EXCITED = 1e-6  # singular value over the largest
_EXACT = 1e-4  # of the output's deviation: below, more lags follow the rounding
MOST_DELAY = 20
"""The largest delay that is looked for."""
_PER_DELAY = 6  # rows of the longest experiment at least
_SURE = 3.1  # standard errors: 5 % for 21 lags together
_LEVEL = 0.1  # mean over standard deviation, from which on a constant is part of the physics
_TELLING = 0.7  # error over the output's deviation, from which on a free run ranks no orders
_RESTARTED = (300, 100, 30, 10)  # rows after which a run is started again where longer ones do not
_DOUBTFUL = 0.1  # of the output's deviation: above, refinement begins at other poles, too
_DYNAMIC = 0.25  # of the error without past outputs, below which runs with them are believed

_TOGETHER = 8_000  # rows that outputs with each other's past are looked at on
_COUPLED = 0.9  # of the error without it, below which the past of other outputs is believed
_ROUNDS = 3  # times that instruments refine a fit of all outputs

Pair: TypeAlias = tuple[int, int]
_Poles: TypeAlias = dict[int, Vector]
_Choice: TypeAlias = tuple[float, Orders, tuple[float, ...]]
"""The least error of all orders, the smallest orders near it, and their error of each output."""


@dataclass(frozen=True, eq=False)
class FirstModel:
    """A linear model with an own past of na lags for each output, and what its inputs are like."""

    orders: Orders
    offset: bool
    """True if the signals have a level, so that the physics needs a constant."""
    delays: tuple[int | None, ...]
    """First lag of each input that is significant beside the output's own past; None where none is.
    """
    persistence: tuple[int, ...]
    """Up to which order each input excites; `PERSISTENCE` means that or more."""
    free_run: tuple[float, ...]
    """Error of the free run on rows held out over the output's standard deviation, for each output.
    """
    restarted: int | None = None
    """Rows after which those runs start again from measured lags; None for one long run."""
    across: tuple[Pair, ...] = ()
    """Pairs (i, j) of outputs: output i has the past of output j, too."""


def first_model(record: Record, *, direct: bool = True) -> FirstModel | None:
    """Return delays, excitation and orders for a record; None for too few rows.

    The orders are the smallest whose free run is within 5 % of the best of up to 4 lags a channel.
    Where all of them drift away, as those of an integrator or a light damping may, runs that start
    again from measured lags decide: the longest whose best follows the output. The first lags are
    the significant ones, unless from 1 or 0 on the best free run is clearly better. Every model
    that is tried has a constant: without one, further lags make up for the level of the signals.

    Args:
        direct: whether an input may act in its own row. Under feedback the controller makes that
            connection: the input follows the output of the row.
    """
    record = _spread_windows(record)
    signals = np.concatenate([np.hstack([e.outputs, e.inputs]) for e in record.experiments])
    offset = bool((np.abs(signals.mean(axis=0)) > _LEVEL * signals.std(axis=0)).any())
    delays = tuple(first_significant_lag(record, i) for i in range(len(record.inputs)))
    excited = tuple(_persistence(record, i) for i in range(len(record.inputs)))
    usual = [tuple(late if delay is None else delay for delay in delays) for late in (1, 0)]
    first_lags = [*usual, *((late,) * len(delays) for late in (1, 0))]
    if not direct:
        delays = tuple(None if delay is None else max(delay, 1) for delay in delays)
        first_lags = [tuple(max(lag, 1) for lag in lags) for lags in first_lags]
    first_lags = [*dict.fromkeys(first_lags)]
    least = 0 if direct else 1
    chosen, restarted = _telling(record, excited, first_lags, least, ())
    if chosen is None or chosen[0] > _DOUBTFUL or restarted is not None:
        few = witness(RecordSource(record, 0), _TOGETHER) if len(record) > _TOGETHER else record
        poles = [_reduced_poles(few, j) for j in range(len(record.outputs))]
        other, after = None, None
        if all(poles):
            other, after = _telling(few, excited, first_lags, least, poles)
        if other is not None and (
            chosen is None
            or (after is None and restarted is not None)
            or (after == restarted and other[0] * _BETTER < chosen[0])
        ):
            chosen, restarted = other, after
    if chosen is None:
        return None
    across, chosen = _coupled(record, excited, chosen, restarted)
    return FirstModel(chosen[1], offset, delays, excited, chosen[2], restarted, across)


def restarted_error(record: Record, model: FirstModel, length: int) -> float:
    """Return the mean error of a model's orders over runs that start again after `length` rows.

    Infinite where these are too few, or run away.
    """
    if model.across:
        errors = _errors_together(record, model.orders, model.across, length)
    else:
        errors = _errors(record, model.orders, length)
    return np.inf if errors is None else float(np.mean(errors))


def _coupled(
    record: Record, excited: tuple[int, ...], chosen: _Choice, length: int | None
) -> tuple[tuple[Pair, ...], _Choice]:
    """Return the pairs of outputs of which one follows the other's past, and their choice.

    None where that does not clearly lower the error of the free run. Pairs go one by one while the
    error hardly grows.
    """
    ny = len(record.outputs)
    every = tuple((i, j) for i in range(ny) for j in range(ny) if i != j)
    if not every or not record.inputs:
        return (), chosen
    if len(record) > _TOGETHER:
        record = witness(RecordSource(record, 0), _TOGETHER)
    nk, tried = chosen[1].nk, []
    for na, n in product(range(1, _MOST + 1), range(1, _MOST + 1)):
        orders = Orders(na, tuple(max(1, min(n, order)) for order in excited), nk)
        errors = _errors_together(record, orders, every, length)
        if errors is not None:
            tried.append((float(np.mean(errors)), orders.size, orders, errors))
    if not tried:
        return (), chosen
    least = min(error for error, *_ in tried)
    if least > _COUPLED * chosen[0]:
        return (), chosen
    near = [one for one in tried if one[0] <= max(_AS_GOOD * least, _EXACT)]
    _, _, orders, errors = min(near, key=lambda one: (one[1], one[0]))
    pairs = every
    for pair in every:
        fewer = tuple(one for one in pairs if one != pair)
        without = _errors_together(record, orders, fewer, length)
        if without is not None and np.mean(without) <= max(_AS_GOOD * least, _EXACT):
            pairs, errors = fewer, without
    return pairs, (least, orders, errors)


def _errors_together(
    record: Record, orders: Orders, pairs: Sequence[Pair], length: int | None
) -> tuple[float, ...] | None:
    """Return the error of the free run of all outputs on the last rows, as `_errors`."""
    first = _first_row(orders)
    usable = [e for e in record.experiments if len(e) > first + 1]
    if length is not None:
        usable = [piece for e in usable for piece in _cut(e, first, length)]
    rows = sum(len(e) - first for e in usable)
    cut = int(FITTED * rows)
    columns = orders.na * len(record.outputs) + sum(orders.nb) + 1
    if cut < 2 * columns or rows - cut < 2:
        return None
    theta = _fit_together(usable, orders, pairs, cut, constant=True)
    if theta is None:
        return None
    y = np.concatenate([e.outputs[first:] for e in usable])
    run = np.concatenate([_run_together(e, orders, theta) for e in usable])
    with np.errstate(all="ignore"):
        wrong = np.sqrt(np.mean((run[cut:] - y[cut:]) ** 2, axis=0))
    if not np.isfinite(wrong).all():
        return None
    return tuple((wrong / np.maximum(y.std(axis=0), 1e-300)).tolist())


def _fit_together(
    experiments: Sequence[Experiment],
    orders: Orders,
    pairs: Sequence[Pair],
    cut: int | None,
    *,
    constant: bool,
    refine: bool = True,
) -> Matrix | None:
    """Return θ (columns, ny) of all outputs by least squares on the first `cut` rows.

    Refined by instruments, the outputs of the free run, while that lowers its error there. None
    where the columns have not full rank.
    """
    first = _first_row(orders)
    y = np.concatenate([e.outputs[first:] for e in experiments])[:cut]
    phi = np.concatenate([_rows_together(e, orders) for e in experiments])[:cut]
    kept = _columns_together(y.shape[1], orders, pairs)
    kept[-1] &= constant
    scale = np.maximum(np.linalg.norm(phi, axis=0), 1e-300)
    z, best, least = phi, None, np.inf
    for _ in range(1 + _ROUNDS * refine):
        theta = np.zeros(kept.shape)
        for j in range(y.shape[1]):
            own = kept[:, j]
            system = (z[:, own] / scale[own]).T @ (phi[:, own] / scale[own])
            if not np.isfinite(system).all() or np.linalg.cond(system) > 1 / _RANK**2:
                return best
            right = (z[:, own] / scale[own]).T @ y[:, j]
            theta[own, j] = np.linalg.solve(system, right) / scale[own]
        runs = [_run_together(e, orders, theta) for e in experiments]
        with np.errstate(all="ignore"):
            square = float(np.mean(((np.concatenate(runs)[:cut] - y) / y.std(axis=0)) ** 2))
        if best is not None and not square < least:
            break
        best, least = theta, square
        if not np.isfinite(square):
            break
        modelled = []
        for e, run in zip(experiments, runs, strict=True):
            outputs = e.outputs.copy()
            outputs[first:] = run
            modelled.append(_rows_together(replace(e, outputs=outputs), orders))
        z = np.concatenate(modelled)[:cut]
    return best


def _columns_together(ny: int, orders: Orders, pairs: Sequence[Pair]) -> Any:
    """Return which columns (columns, ny) of `_rows_together` each output has."""
    other = orders.na * ny + sum(orders.nb) + 1
    kept = np.ones((other, ny), dtype=bool)
    for lag in range(orders.na):
        for i in range(ny):
            for j in range(ny):
                kept[lag * ny + j, i] = i == j or (i, j) in pairs
    return kept


def _rows_together(e: Experiment, orders: Orders) -> Matrix:
    """Return the rows of the past of all outputs, lag by lag, of the inputs, and 1."""
    first, ny = _first_row(orders), e.outputs.shape[1]
    count = len(e) - first
    past = [
        e.outputs[first - i : first - i + count, j]
        for i in range(1, orders.na + 1)
        for j in range(ny)
    ]
    driven = _rows(e, 0, replace(orders, na=0), first)
    return np.column_stack([*past, driven]) if past else driven


def _run_together(e: Experiment, orders: Orders, theta: Matrix) -> Matrix:
    """Return the free run of all outputs from their first measured rows on."""
    first, ny = _first_row(orders), e.outputs.shape[1]
    past = orders.na * ny
    driven = _rows(e, 0, replace(orders, na=0), first) @ theta[past:]
    along = theta[:past].T.copy()
    state = e.outputs[first - orders.na : first][::-1].reshape(-1).copy()
    run = np.empty((len(driven), ny))
    with np.errstate(all="ignore"):
        for k, push in enumerate(driven):
            row = along @ state + push
            run[k] = row
            state[ny:] = state[:-ny]
            state[:ny] = row
    return run


def _telling(
    record: Record,
    excited: tuple[int, ...],
    first_lags: Sequence[tuple[int, ...]],
    least: int,
    poles: Sequence[_Poles],
) -> tuple[_Choice | None, int | None]:
    """Return the choice of the longest runs that follow the output, and after what they restart.

    One without past outputs may win among runs that drift: it stays where runs of 100 rows confirm
    it.
    """
    whole = _best_choice(record, excited, first_lags, None, least, poles)
    if whole is None:  # under feedback none may be bounded
        for length in _RESTARTED if record.inputs else ():
            tried = _best_choice(record, excited, first_lags, length, least, poles)
            if tried is not None:
                return tried, length
    if whole is None or not record.inputs or (whole[0] < _TELLING and whole[1].na):
        return whole, None
    static = whole[0] < _TELLING
    best: tuple[_Choice, int | None] = (whole, None)
    for length in _RESTARTED[:2] if static else _RESTARTED:
        tried = _best_choice(record, excited, first_lags, length, least, poles)
        if tried is None:
            break
        if tried[0] < (_DYNAMIC * whole[0] if static else _TELLING):
            return tried, length
        if not static:
            best = tried, length
    return best


def _best_choice(
    record: Record,
    excited: tuple[int, ...],
    first_lags: Sequence[tuple[int, ...]],
    length: int | None,
    least: int,
    poles: Sequence[_Poles],
) -> _Choice | None:
    """Return the smallest orders near the best, from the first lags that are clearly better."""
    chosen: _Choice | None = None
    for nk in first_lags:  # a test may miss them
        found = _smallest(record, excited, nk, length, least, poles)
        if found is not None and (chosen is None or found[0] * _BETTER < chosen[0]):
            chosen = found
    return chosen


def _smallest(
    record: Record,
    excited: tuple[int, ...],
    nk: tuple[int, ...],
    length: int | None,
    least_na: int,
    poles: Sequence[_Poles],
) -> _Choice | None:
    """Return the least error of all orders from these first lags on, and the smallest near it.

    The error of the smallest orders comes with them.
    """
    tried: list[tuple[float, int, Orders, tuple[float, ...]]] = []
    for na, n in product(range(least_na, _MOST + 1), range(1, _MOST + 1) if record.inputs else [0]):
        orders = Orders(na, tuple(max(1, min(n, order)) for order in excited), nk)
        errors = _errors(record, orders, length, poles)
        if errors is not None and orders.size:
            tried.append((float(np.mean(errors)), orders.size, orders, errors))
    if not tried:
        return None
    least = min(error for error, *_ in tried)
    near = [one for one in tried if one[0] <= max(_AS_GOOD * least, _EXACT)]
    _, _, orders, errors = min(near, key=lambda one: (one[1], one[0]))
    return least, orders, errors


def _spread_windows(record: Record) -> Record:
    """Return the record, or windows that are spread over it where it is long."""
    if len(record) <= LOOKED_AT:
        return record
    return witness(RecordSource(record, 0), LOOKED_AT)


def first_significant_lag(record: Record, number: int) -> int | None:
    """Return the first lag of an input with an effect beside past outputs and all other lags.

    Where rows or excitation do not allow that, by the cross-correlation with the input made white;
    where none is significant, by that of the input's square.
    """
    record = _spread_windows(record)
    longest = max(map(len, record.experiments))
    found, most = [], max(_MOST, min(MOST_DELAY, longest // _PER_DELAY))
    long = tuple(e for e in record.experiments if len(e) > 2 * most)
    for j, output in enumerate(record.outputs if long else ()):
        one = tuple(replace(e, outputs=e.outputs[:, [j]]) for e in long)
        own = replace(record, outputs=(output,), experiments=one)
        tested = _tested_delay(own, number, most)
        found.append(correlated_delay(own, number, most) if tested is None else tested)
        if found[-1] is None:  # an even function of an input has no linear correlation with it
            found[-1] = correlated_delay(own, number, most, squared=True)
    seen = [lag for lag in found if lag is not None]
    return min(seen) if seen else None


def _tested_delay(record: Record, number: int, most: int) -> int | None:
    """Return the delay by t-tests, at 5 % for all lags together.

    None where none is significant or the lags cannot be separated.
    """
    orders = Orders(_MOST, (most + 1,) * len(record.inputs), (0,) * len(record.inputs))
    phi = np.concatenate([_rows(e, 0, orders, most) for e in record.experiments])
    y = np.concatenate([e.outputs[most:, 0] for e in record.experiments])
    q, r = np.linalg.qr(phi / np.maximum(np.linalg.norm(phi, axis=0), 1e-300))
    if len(y) < 2 * orders.size or np.linalg.cond(r) > 1 / _RANK:
        return None
    theta = np.linalg.solve(r, q.T @ y)
    noise = float(np.linalg.norm(y - q @ (r @ theta))) / np.sqrt(len(y) - len(theta))
    std = noise * np.linalg.norm(np.linalg.inv(r), axis=1)
    begin = _MOST + number * (most + 1)
    lags = slice(begin, begin + most + 1)
    over = np.flatnonzero(np.abs(theta[lags]) > _SURE * np.maximum(std[lags], 1e-300))
    return int(over[0]) if len(over) else None


def _persistence(record: Record, number: int) -> int:
    """Return the rank of the matrix of an input's lags, its mean removed."""
    longest = max(record.experiments, key=len).inputs[:, number]
    n = min(PERSISTENCE, len(longest) // 3)
    if n < 1:
        return 1
    lagged = np.lib.stride_tricks.sliding_window_view(longest - longest.mean(), n)
    values = np.linalg.svd(np.linalg.qr(lagged, mode="r"), compute_uv=False)
    return int((values > _EXCITED * values[0]).sum()) if values[0] > 0 else 0


def _reduced_poles(record: Record, j: int) -> _Poles:
    """Return denominators of a long model of an output, reduced to few states, by their number.

    The model of many lags, which noise on the output hardly biases, has an impulse response. The
    states of its Hankel matrix that hold most of it have the poles (Kung 1978). None are returned
    for too few rows, or where the model is not stable.
    """
    nu = len(record.inputs)
    rows = int(FITTED * sum(max(len(e) - _LONG, 0) for e in record.experiments))
    rows = min(rows, _TOGETHER)
    long = min(_LONG, rows // (_PER_COLUMN * (1 + nu)))
    if not nu or long < 2 * _MOST:
        return {}
    orders = Orders(long, (long,) * nu, (1,) * nu)
    usable = [e for e in record.experiments if len(e) > long + 1]
    phi = np.concatenate([_rows(e, j, orders, long) for e in usable])[:rows]
    y = np.concatenate([e.outputs[long:, j] for e in usable])[:rows]
    scale = np.maximum(np.linalg.norm(phi, axis=0), 1e-300)
    theta = np.linalg.lstsq(phi / scale, y, rcond=_RANK)[0] / scale
    response = np.zeros((_RESPONSE, nu))
    past, driven = theta[:long], theta[long:-1].reshape(nu, long)
    for k in range(_RESPONSE):
        before = response[max(k - long, 0) : k][::-1]
        response[k] = past[: len(before)] @ before
        response[k] += driven[:, k] if k < long else 0.0
    if not np.isfinite(response).all() or np.abs(response).max() > 1 / _RANK:
        return {}
    half = _RESPONSE // 2
    hankel = np.block([[response[i + k] for k in range(half)] for i in range(half)])
    u, s, _ = np.linalg.svd(hankel, full_matrices=False)
    found = {}
    for n in range(1, _MOST + 1):
        if s[n - 1] > _RANK * s[0]:
            seen = u[:, :n] * np.sqrt(s[:n])
            forward = np.linalg.lstsq(seen[:-1], seen[1:], rcond=None)[0]
            taps = np.real(np.poly(np.linalg.eigvals(forward)))
            if np.all(np.abs(np.roots(taps)) < 1):
                found[n] = taps
    return found


def _errors(
    record: Record, orders: Orders, length: int | None, poles: Sequence[_Poles] = ()
) -> tuple[float, ...] | None:
    """Return the error of the free run on the last rows for each output.

    It starts again from measured lags after `length` rows. None where it cannot be fitted, or runs
    away.

    Args:
        poles: of each output, denominators by their degree at which refinement begins, too.
    """
    first = _first_row(orders)
    usable = [e for e in record.experiments if len(e) > first + 1]
    if length is not None:
        usable = [piece for e in usable for piece in _cut(e, first, length)]
    rows = sum(len(e) - first for e in usable)
    cut, found = int(FITTED * rows), []
    for j in range(len(record.outputs)):
        columns = orders.size + 1
        if cut < 2 * columns or rows - cut < 2:
            return None
        phi = np.concatenate([_rows(e, j, orders, first) for e in usable])
        y = np.concatenate([e.outputs[first:, j] for e in usable])
        scale = np.maximum(np.linalg.norm(phi[:cut], axis=0), 1e-300)
        theta, _, rank, _ = np.linalg.lstsq(phi[:cut] / scale, y[:cut], rcond=_RANK)
        if rank < columns:
            return None
        simulated = phi / scale @ theta
        if record.inputs:
            starts = [theta / scale]
            if poles and orders.na in poles[j]:
                starts += _from_poles(usable, j, poles[j][orders.na], orders, first, cut)
            simulated = _best_free_run(usable, j, starts, orders, first, cut)
        with np.errstate(all="ignore"):  # one that is not stable overflows
            wrong = float(np.sqrt(np.mean((simulated[cut:] - y[cut:]) ** 2)))
        if not np.isfinite(wrong):
            return None
        found.append(wrong / max(float(y.std()), 1e-300))
    return tuple(found)


def _from_poles(
    experiments: list[Experiment], j: int, taps: Vector, orders: Orders, first: int, cut: int
) -> list[Vector]:
    """Return θ with these poles, whose free run from rest follows the output best; none without."""
    from scipy.signal import lfilter

    driven = np.concatenate(
        [
            lfilter([1.0], taps, _rows(e, j, orders, first)[:, orders.na :], axis=0)
            for e in experiments
        ]
    )[:cut]
    y = np.concatenate([e.outputs[first:, j] for e in experiments])[:cut]
    scale = np.maximum(np.linalg.norm(driven, axis=0), 1e-300)
    if not np.isfinite(driven).all():
        return []
    b = np.linalg.lstsq(driven / scale, y, rcond=_RANK)[0] / scale
    return [np.concatenate([-taps[1:], b])]


def _best_free_run(
    experiments: list[Experiment],
    j: int,
    starts: Sequence[Vector],
    orders: Orders,
    first: int,
    cut: int,
) -> Vector:
    """Return the free run that is best over the first `cut` rows, of some starts or refined."""
    y = np.concatenate([e.outputs[first:, j] for e in experiments])
    best, least = np.full(len(y), np.inf), np.inf
    for theta in starts:
        for refine in (_by_instruments, _by_descent)[: len(starts)]:
            own = np.inf
            for _ in range(1 + _REFINED):
                runs = [_free_run(e, j, theta, orders, first) for e in experiments]
                if len(starts) > 1:
                    runs = _from_best_starts(runs, experiments, j, theta, orders, first, cut)
                simulated = np.concatenate(runs)
                with np.errstate(all="ignore"):
                    square = float(np.mean((simulated[:cut] - y[:cut]) ** 2))
                if not square < own:
                    break
                own, reached = square, theta
                if own < least:
                    best, least = simulated, own
                refined = refine(experiments, runs, j, theta, orders, first, cut)
                if refined is None:
                    break
                theta = refined
            if not np.isfinite(own):
                break
            theta = reached
    return best


def _from_best_starts(
    runs: list[Vector],
    experiments: list[Experiment],
    j: int,
    theta: Vector,
    orders: Orders,
    first: int,
    cut: int,
) -> list[Vector]:
    """Return runs from the past by which they follow the first `cut` rows best.

    What light damping makes of the noise in a measured start lasts for long.
    """
    from scipy.signal import lfilter

    taps, begin, moved = np.concatenate([[1.0], -theta[: orders.na]]), 0, []
    for run, e in zip(runs, experiments, strict=True):
        rows, begin = min(len(run), max(cut - begin, 0)), begin + len(run)
        if rows > 2 * orders.na and np.isfinite(run).all():
            still = np.zeros(len(run))
            free = np.stack(
                [lfilter([1.0], taps, still, zi=zi)[0] for zi in np.eye(orders.na)], axis=1
            )
            left = e.outputs[first : first + rows, j] - run[:rows]
            if np.isfinite(free).all():
                run = run + free @ np.linalg.lstsq(free[:rows], left, rcond=None)[0]
        moved.append(run)
    return moved


def _by_instruments(
    experiments: list[Experiment],
    runs: list[Vector],
    j: int,
    theta: Vector,
    orders: Orders,
    first: int,
    cut: int,
) -> Vector | None:
    """Return θ with the outputs of free runs as instruments, rows filtered by 1/A.

    None where A is not stable or the instruments do not determine θ.
    """
    instruments = _filtered(experiments, j, theta, orders, first, runs)
    if instruments is None:
        return None
    measured = _filtered(experiments, j, theta, orders, first)
    assert measured is not None
    return _solved(*(part[:cut] for part in (instruments[0], *measured)))


def _by_descent(
    experiments: list[Experiment],
    runs: list[Vector],
    j: int,
    theta: Vector,
    orders: Orders,
    first: int,
    cut: int,
) -> Vector | None:
    """Return θ after a step of Gauss and Newton on the errors of the free runs.

    Their slopes are the rows of the run, filtered by 1/A. None as of `_by_instruments`.
    """
    slopes = _filtered(experiments, j, theta, orders, first, runs)
    if slopes is None:
        return None
    left = np.concatenate([e.outputs[first:, j] for e in experiments]) - np.concatenate(runs)
    step = _solved(slopes[0][:cut], slopes[0][:cut], left[:cut])
    return None if step is None else theta + step


def _filtered(
    experiments: list[Experiment],
    j: int,
    theta: Vector,
    orders: Orders,
    first: int,
    runs: list[Vector] | None = None,
) -> tuple[Matrix, Vector] | None:
    """Return rows and output filtered by 1/A, measured or of free runs.

    None where A is unstable.
    """
    from scipy.signal import lfilter

    taps = np.concatenate([[1.0], -theta[: orders.na]])
    if not orders.na or np.any(np.abs(np.roots(taps)) >= 1):
        return None
    rows, target = [], []
    for i, e in enumerate(experiments):
        if runs is not None:
            outputs = e.outputs.copy()
            outputs[first:, j] = runs[i]
            e = replace(e, outputs=outputs)
        rows.append(lfilter([1.0], taps, _rows(e, j, orders, first), axis=0))
        target.append(lfilter([1.0], taps, e.outputs[first:, j]))
    return np.concatenate(rows), np.concatenate(target)


def _solved(instruments: Matrix, rows: Matrix, target: Vector) -> Vector | None:
    """Return θ by instruments; None where they do not determine it."""
    scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    system = (instruments / scale).T @ (rows / scale)
    if not np.isfinite(system).all() or not np.linalg.cond(system) < 1 / _RANK:
        return None
    return np.linalg.solve(system, (instruments / scale).T @ target) / scale


def free_run_errors(train: Record, test: Record, model: FirstModel) -> tuple[float, ...] | None:
    """Return the NRMSE of the model's free run on test data, for each output.

    It is fitted to the training data one step ahead, as `fit` does for physics alone, with a
    constant where the physics has one. None where the test data are too few, or the run leaves all
    bounds.
    """
    orders, found = model.orders, []
    first = _first_row(orders)
    fitted, tested = ([e for e in r.experiments if len(e) > first] for r in (train, test))
    if not tested or not fitted:
        return None
    if model.across:
        constant = {"constant": model.offset, "refine": False}
        together = _fit_together(fitted, orders, model.across, None, **constant)
        if together is None:
            return None
        run = np.concatenate([_run_together(e, orders, together) for e in tested])
        measured = np.concatenate([e.outputs[first:] for e in tested])
        with np.errstate(all="ignore"):
            errors = np.sqrt(np.mean((run - measured) ** 2, axis=0)) / measured.std(axis=0)
        return tuple(errors.tolist()) if np.isfinite(errors).all() else None
    for j in range(len(train.outputs)):
        phi = np.concatenate([_rows(e, j, orders, first) for e in fitted])
        y = np.concatenate([e.outputs[first:, j] for e in fitted])
        phi = phi if model.offset else phi[:, :-1]
        scale = np.maximum(np.linalg.norm(phi, axis=0), 1e-300)
        theta = np.linalg.lstsq(phi / scale, y, rcond=_RANK)[0] / scale
        theta = theta if model.offset else np.append(theta, 0.0)
        runs = [_modelled(e, j, theta, orders, first, train) for e in tested]
        measured = np.concatenate([e.outputs[first:, j] for e in tested])
        with np.errstate(all="ignore"):
            error = np.sqrt(np.mean((np.concatenate(runs) - measured) ** 2)) / measured.std()
        if not np.isfinite(error):
            return None
        found.append(float(error))
    return tuple(found)


def _cut(e: Experiment, first: int, length: int) -> list[Experiment]:
    """Return pieces of so many rows, each with the lags before it."""
    begins = range(0, len(e) - first, length)
    return [e.rows(begin, begin + length + first) for begin in begins]


def _first_row(orders: Orders) -> int:
    """Return the first row that has all its lags."""
    late = (nb + nk - 1 for nb, nk in zip(orders.nb, orders.nk, strict=True))
    return max([orders.na, *late])


def _modelled(
    e: Experiment, j: int, theta: np.ndarray, orders: Orders, first: int, record: Record
) -> np.ndarray:
    """Return the free run, or one step ahead where there are no inputs."""
    if record.inputs:
        return _free_run(e, j, theta, orders, first)
    return _rows(e, j, orders, first) @ theta


def _rows(e: Experiment, j: int, orders: Orders, first: int) -> Matrix:
    """Return the rows of own past, inputs from their delays on, and 1."""
    count = len(e) - first
    columns = [e.outputs[first - i : first - i + count, j] for i in range(1, orders.na + 1)]
    for i, (nb, nk) in enumerate(zip(orders.nb, orders.nk, strict=True)):
        columns += [e.inputs[first - lag : first - lag + count, i] for lag in range(nk, nk + nb)]
    return np.stack([*columns, np.ones(count)], axis=1)


def _free_run(e: Experiment, j: int, theta: np.ndarray, orders: Orders, first: int) -> np.ndarray:
    """Return the output from its first measured rows on."""
    from scipy.signal import lfilter, lfiltic

    driven = _rows(e, j, orders, first)[:, orders.na :] @ theta[orders.na :]
    taps = np.concatenate([[1.0], -theta[: orders.na]])
    with np.errstate(all="ignore"):
        start = lfiltic(
            [1.0], taps, e.outputs[first - 1 :: -1, j][: orders.na] if first else np.empty(0)
        )
        return lfilter([1.0], taps, driven, zi=start)[0]
