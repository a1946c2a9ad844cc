"""Orders of a first linear model, judged by the free run on held-out rows (`linear_runs`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, TypeAlias

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug.data.columns import quantum_of
from orthaug.data.record import Experiment, Record
from orthaug.data.sources import RecordSource, witness
from orthaug.selection.linear_runs import (
    FEW_ROWS,
    FITTED,
    MOST_LAGS,
    RANK,
    OutputRows,
    Poles,
    best_free_run,
    driven_rows_of,
    from_poles,
    in_turn,
    lag_rows,
    reduced_poles,
)
from orthaug.selection.orders import Orders, correlated_delay

LOOKED_AT = 40_000
"""Rows of a longer record that orders are found on, in windows spread over it."""
_AS_GOOD = 1.05  # free-run error over the best, up to which fewer lags are taken
# Free-run error over that from another first lag, up to which the lag that a test found is kept
_BETTER = 1.2
PERSISTENCE = 20  # the highest order of excitation that is looked for
_EXCITED = 1e-6  # singular value over the largest
_FINE = 0.01  # steps of an input over its deviation, below which they are those of the recording
_PLACES = 9  # decimals that a recording may have been rounded to
_ROUNDED = 3.0  # times the singular value that the rounding of a recording has by itself
_EXACT = 1e-4  # of the output's deviation: below, more lags follow the rounding
MOST_DELAY = 20
"""The largest delay that is looked for."""
_PER_DELAY = 6  # rows of the longest experiment at least
_SURE = 3.1  # standard errors: 5 % for 21 lags together
# Standard deviations of χ² that lags before the first significant one may explain beside it; fewer
# where the input excites less than the lags that are tested, which then replace each other
_EARLIER, _EARLIER_SMOOTH = 5.0, 2.0
_LEVEL = 0.1  # mean over standard deviation, from which on a constant is part of the physics
_TELLING = 0.7  # error over the output's deviation, from which on a free run ranks no orders
# Error over the output's deviation, below which a run may correct the test of the first lag: of a
# model that misses more, as a linear one beside friction, the best delay is not the plant's
_FOLLOWS = 0.3
_RESTARTED = (300, 100, 30, 10)  # rows after which a run is started again where longer ones do not
_DOUBTFUL = 0.1  # of the output's deviation: above, refinement begins at other poles, too
_DYNAMIC = 0.25  # of the error without past outputs, below which runs with them are believed

_COUPLED = 0.9  # of the error without it, below which the past of other outputs is believed
_ROUNDS = 3  # times that instruments refine a fit of all outputs

Pair: TypeAlias = tuple[int, int]
_Choice: TypeAlias = tuple[float, Orders, tuple[float, ...]]
"""The least error of all orders, the smallest orders near it, and their error of each output."""


@dataclass(frozen=True, eq=False)
class FirstModel:
    """A linear model with an own past of na lags for each output, and what its inputs are like."""

    orders: Orders
    offset: bool
    """True if the signals have a level, so that the physics needs a constant."""
    delays: tuple[int | None, ...]
    """First lag of each input that is significant beside the output's own past.

    None where none is, or where the data do not determine it."""
    undetermined: tuple[bool, ...]
    """Whether several lags of an input act, and the data do not determine the first of them."""
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
    the significant ones, unless from 1 or 0 on the best free run follows and is clearly better.
    Every model that is tried has a constant: without one, further lags make up for the level of the
    signals.

    Args:
        direct: whether an input may act in its own row. Under feedback the controller makes that
            connection: the input follows the output of the row.
    """
    record = _spread_windows(record)
    signals = np.concatenate([np.hstack([e.outputs, e.inputs]) for e in record.experiments])
    offset = bool((np.abs(signals.mean(axis=0)) > _LEVEL * signals.std(axis=0)).any())
    lags = [_first_lag(record, i) for i in range(len(record.inputs))]
    delays = tuple(lag for lag, _ in lags)
    undetermined = tuple(unsure for _, unsure in lags)
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
        few = witness(RecordSource(record, 0), FEW_ROWS) if len(record) > FEW_ROWS else record
        poles = [reduced_poles(few, j) for j in range(len(record.outputs))]
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
    return FirstModel(
        chosen[1], offset, delays, undetermined, excited, chosen[2], restarted, across
    )


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
    if len(record) > FEW_ROWS:
        record = witness(RecordSource(record, 0), FEW_ROWS)
    nk = chosen[1].nk
    tried: list[_Choice] = []
    for na, n in product(range(1, MOST_LAGS + 1), range(1, MOST_LAGS + 1)):
        orders = Orders(na, tuple(max(1, min(n, order)) for order in excited), nk)
        errors = _errors_together(record, orders, every, length)
        if errors is not None:
            tried.append((float(np.mean(errors)), orders, errors))
    best = _smallest_near_least(tried)
    if best is None or best[0] > _COUPLED * chosen[0]:
        return (), chosen
    least, orders, errors = best
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
    first, columns = orders.first_row, orders.na * len(record.outputs) + sum(orders.nb) + 1
    usable, cut = _fitted_rows(record, orders, length, columns)
    if not usable:
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
    first = orders.first_row
    y = np.concatenate([e.outputs[first:] for e in experiments])[:cut]
    which = range(y.shape[1])
    phi = np.concatenate([lag_rows(e.outputs, e.inputs, which, orders) for e in experiments])[:cut]
    kept = _columns_together(y.shape[1], orders, pairs)
    kept[-1] &= constant
    scale = np.maximum(np.linalg.norm(phi, axis=0), 1e-300)
    z, best, least = phi, None, np.inf
    for _ in range(1 + _ROUNDS * refine):
        theta = np.zeros(kept.shape)
        for j in range(y.shape[1]):
            own = kept[:, j]
            system = (z[:, own] / scale[own]).T @ (phi[:, own] / scale[own])
            if not np.isfinite(system).all() or np.linalg.cond(system) > 1 / RANK**2:
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
            modelled.append(lag_rows(outputs, e.inputs, which, orders))
        z = np.concatenate(modelled)[:cut]
    return best


def _columns_together(ny: int, orders: Orders, pairs: Sequence[Pair]) -> Any:
    """Return which columns (columns, ny) of `lag_rows` of all outputs each output has."""
    other = orders.na * ny + sum(orders.nb) + 1
    kept = np.ones((other, ny), dtype=bool)
    for lag in range(orders.na):
        for i in range(ny):
            for j in range(ny):
                kept[lag * ny + j, i] = i == j or (i, j) in pairs
    return kept


def _run_together(e: Experiment, orders: Orders, theta: Matrix) -> Matrix:
    """Return the free run of all outputs from their first measured rows on."""
    first, ny = orders.first_row, e.outputs.shape[1]
    past = orders.na * ny
    driven = driven_rows_of(e.inputs, orders) @ theta[past:]
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
    poles: Sequence[Poles],
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
    poles: Sequence[Poles],
) -> _Choice | None:
    """Return the smallest orders near the best, from the first lags that are clearly better."""
    chosen: _Choice | None = None
    for nk in first_lags:  # a test may miss them
        found = _smallest(record, excited, nk, length, least, poles)
        if found is None:
            continue
        if chosen is None or (found[0] < _FOLLOWS and found[0] * _BETTER < chosen[0]):
            chosen = found
    return chosen


def _smallest(
    record: Record,
    excited: tuple[int, ...],
    nk: tuple[int, ...],
    length: int | None,
    least_na: int,
    poles: Sequence[Poles],
) -> _Choice | None:
    """Return the least error of all orders from these first lags on, and the smallest near it.

    The error of the smallest orders comes with them.
    """
    tried: list[_Choice] = []
    for na, n in product(
        range(least_na, MOST_LAGS + 1), range(1, MOST_LAGS + 1) if record.inputs else [0]
    ):
        orders = Orders(na, tuple(max(1, min(n, order)) for order in excited), nk)
        errors = _errors(record, orders, length, poles)
        if errors is not None and orders.size:
            tried.append((float(np.mean(errors)), orders, errors))
    return _smallest_near_least(tried)


def _smallest_near_least(tried: Sequence[_Choice]) -> _Choice | None:
    """Return the least error of all, with the smallest orders that come near it.

    None where nothing was tried.
    """
    if not tried:
        return None
    least = min(error for error, *_ in tried)
    near = [one for one in tried if one[0] <= max(_AS_GOOD * least, _EXACT)]
    _, orders, errors = min(near, key=lambda one: (one[1].size, one[0]))
    return least, orders, errors


def _spread_windows(record: Record) -> Record:
    """Return the record, or windows that are spread over it where it is long."""
    if len(record) <= LOOKED_AT:
        return record
    return witness(RecordSource(record, 0), LOOKED_AT)


def first_significant_lag(record: Record, number: int) -> int | None:
    """Return the first lag of an input with an effect beside past outputs and all other lags.

    Where rows or excitation do not allow that, by the cross-correlation with the input made white;
    where none is significant, by that of the input's square. None where lags before it act, too, or
    only all of them together, none by itself, as those of a smooth input: then the data do not
    determine it.
    """
    return _first_lag(_spread_windows(record), number)[0]


def _first_lag(record: Record, number: int) -> tuple[int | None, bool]:
    """Return the first significant lag of an input, and whether the data do not determine it."""
    longest = max(map(len, record.experiments))
    found: list[int | None] = []
    undetermined = False
    most = max(MOST_LAGS, min(MOST_DELAY, longest // _PER_DELAY))
    long = tuple(e for e in record.experiments if len(e) > 2 * most)
    for j, output in enumerate(record.outputs if long else ()):
        one = tuple(replace(e, outputs=e.outputs[:, [j]]) for e in long)
        own = replace(record, outputs=(output,), experiments=one)
        tested = _tested_delay(own, number, most)
        found.append(correlated_delay(own, number, most) if tested is None else tested)
        if found[-1] is None:  # an even function of an input has no linear correlation with it
            found[-1] = correlated_delay(own, number, most, squared=True)
            undetermined |= found[-1] is None and _earlier_lags_act(own, number, most, most + 1)
        elif _earlier_lags_act(own, number, most, found[-1]):
            found[-1], undetermined = None, True
    seen = [lag for lag in found if lag is not None]
    if undetermined and min(seen, default=2) > 1:
        return None, True
    return (min(seen) if seen else None), False


def _earlier_lags_act(record: Record, number: int, most: int, lag: int) -> bool:
    """Return whether the lags before one together explain more beside it than by chance.

    The lag is then no dead time, though none of the others is significant by itself.
    """
    if lag < 2:
        return False
    regression = _regression(record, most)
    if regression is None:
        return False
    phi, y = regression
    begin = MOST_LAGS + number * (most + 1)
    earlier = np.arange(begin, begin + lag)
    q, _ = np.linalg.qr(np.hstack([np.delete(phi, earlier, axis=1), phi[:, earlier]]))
    parts = q.T @ y
    variance = (float(y @ y) - float(parts @ parts)) / (len(y) - len(parts))
    explained = float(parts[-lag:] @ parts[-lag:])
    smooth = _persistence(record, number) < min(PERSISTENCE, most + 1)
    surely = _EARLIER_SMOOTH if smooth else _EARLIER
    return explained > variance * (lag + surely * np.sqrt(2 * lag))


def _regression(record: Record, most: int) -> tuple[Matrix, Vector] | None:
    """Return the output's own lags and those of all inputs, of norm 1, and the output.

    None where rows or excitation do not separate the lags.
    """
    orders = Orders(MOST_LAGS, (most + 1,) * len(record.inputs), (0,) * len(record.inputs))
    rows = OutputRows(record.experiments, 0, orders)
    phi, y = rows.regressors, rows.target
    phi = phi / np.maximum(np.linalg.norm(phi, axis=0), 1e-300)
    if len(y) < 2 * orders.size or np.linalg.cond(np.linalg.qr(phi, mode="r")) > 1 / RANK:
        return None
    return phi, y


def _tested_delay(record: Record, number: int, most: int) -> int | None:
    """Return the delay by t-tests, at 5 % for all lags together.

    None where none is significant or the lags cannot be separated.
    """
    regression = _regression(record, most)
    if regression is None:
        return None
    phi, y = regression
    q, r = np.linalg.qr(phi)
    theta = np.linalg.solve(r, q.T @ y)
    noise = float(np.linalg.norm(y - q @ (r @ theta))) / np.sqrt(len(y) - len(theta))
    std = noise * np.linalg.norm(np.linalg.inv(r), axis=1)
    begin = MOST_LAGS + number * (most + 1)
    lags = slice(begin, begin + most + 1)
    over = np.flatnonzero(np.abs(theta[lags]) > _SURE * np.maximum(std[lags], 1e-300))
    return int(over[0]) if len(over) else None


def _persistence(record: Record, number: int) -> int:
    """Return the rank of the matrix of an input's lags, its mean removed.

    What the rounding of fine steps adds does not count: it excites no output.
    """
    longest = max(record.experiments, key=len).inputs[:, number]
    n = min(PERSISTENCE, len(longest) // 3)
    if n < 1:
        return 1
    lagged = np.lib.stride_tricks.sliding_window_view(longest - longest.mean(), n)
    values = np.linalg.svd(np.linalg.qr(lagged, mode="r"), compute_uv=False)
    step = quantum_of(longest) or _decimal_step(longest)
    fine = step < _FINE * float(longest.std())
    rounding = _ROUNDED * step * np.sqrt(len(lagged) / 12) if fine else 0.0
    return int((values > max(_EXCITED * values[0], rounding)).sum()) if values[0] > 0 else 0


def _decimal_step(values: Vector) -> float:
    """Return the power of ten that all values are multiples of; 0 where none is seen."""
    steps = (10.0**-places for places in range(_PLACES + 1))
    exact = 1e-12 * float(np.abs(values).max())
    return next(
        (one for one in steps if (np.abs(values - one * np.round(values / one)) <= exact).all()),
        0.0,
    )


def _errors(
    record: Record, orders: Orders, length: int | None, poles: Sequence[Poles] = ()
) -> tuple[float, ...] | None:
    """Return the error of the free run on the last rows for each output.

    It starts again from measured lags after `length` rows. None where it cannot be fitted, or runs
    away.

    Args:
        poles: of each output, denominators by their degree at which refinement begins, too.
    """
    columns, found = orders.size + 1, []
    usable, cut = _fitted_rows(record, orders, length, columns)
    if not usable:
        return None
    for j in range(len(record.outputs)):
        own = OutputRows(usable, j, orders, cut)
        phi, y = own.regressors, own.target
        scale = np.maximum(np.linalg.norm(phi[:cut], axis=0), 1e-300)
        theta, _, rank, _ = np.linalg.lstsq(phi[:cut] / scale, y[:cut], rcond=RANK)
        if rank < columns:
            return None
        simulated = phi / scale @ theta
        if record.inputs:
            starts = [theta / scale]
            if poles and orders.na in poles[j]:
                starts += from_poles(own, poles[j][orders.na])
            simulated = best_free_run(own, starts)
        with np.errstate(all="ignore"):  # one that is not stable overflows
            wrong = float(np.sqrt(np.mean((simulated[cut:] - y[cut:]) ** 2)))
        if not np.isfinite(wrong):
            return None
        found.append(wrong / max(float(y.std()), 1e-300))
    return tuple(found)


def free_run_errors(train: Record, test: Record, model: FirstModel) -> tuple[float, ...] | None:
    """Return the NRMSE of the model's free run on test data, for each output.

    It is fitted to the training data one step ahead, as `fit` does for physics alone, with a
    constant where the physics has one. None where the test data are too few, or the run leaves all
    bounds.
    """
    orders, found = model.orders, []
    first = orders.first_row
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
        own, other = OutputRows(fitted, j, orders), OutputRows(tested, j, orders)
        phi, y = own.regressors, own.target
        phi = phi if model.offset else phi[:, :-1]
        scale = np.maximum(np.linalg.norm(phi, axis=0), 1e-300)
        theta = np.linalg.lstsq(phi / scale, y, rcond=RANK)[0] / scale
        theta = theta if model.offset else np.append(theta, 0.0)
        run = in_turn(other.free_runs(theta)) if train.inputs else other.regressors @ theta
        with np.errstate(all="ignore"):
            missed = run - other.target
            error = np.sqrt(np.mean(missed**2)) / other.target.std()
        if not np.isfinite(error):
            return None
        found.append(float(error))
    return tuple(found)


def _fitted_rows(
    record: Record, orders: Orders, length: int | None, columns: int
) -> tuple[list[Experiment], int]:
    """Return the experiments that orders are tried on, and how many rows are fitted.

    No experiments where the rows are too few for so many columns.

    Args:
        length: rows of a piece, each with the lags before it, that the experiments are cut into.
    """
    first = orders.first_row
    usable = [e for e in record.experiments if len(e) > first + 1]
    if length is not None:
        usable = [
            e.rows(begin, begin + length + first)
            for e in usable
            for begin in range(0, len(e) - first, length)
        ]
    rows = sum(len(e) - first for e in usable)
    cut = int(FITTED * rows)
    return ([] if cut < 2 * columns or rows - cut < 2 else usable), cut
