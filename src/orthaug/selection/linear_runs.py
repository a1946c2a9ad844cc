"""Linear models of one output, by least squares on the error of their free run.

Least squares one step ahead is biased by noise on the outputs, most where a system is slow beside
its sampling. Instruments mend it (Young and Jakeman 1979): the outputs of the free run in place of
the measured ones, with all rows filtered by 1/A of the model before. That begins at least squares,
and where light damping makes these useless, at the poles of a long model that is reduced (Kung
1978); steps of Gauss and Newton follow there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug.data.record import Experiment, Record
from orthaug.selection.orders import Orders

MOST_LAGS = 4
"""Lags of a channel in a first model at most."""
FITTED = 0.7
"""Share of the rows that a candidate is fitted to."""
RANK = 1e-9
"""Singular value over the largest, from which on a column counts."""
FEW_ROWS = 8_000
"""Rows that what takes long is looked at on."""
_LONG = 40  # lags of a long model, whose poles orders begin at
_RESPONSE = 200  # rows of its impulse response
_PER_COLUMN = 5  # rows that one of its coefficients needs
_REFINED = 5  # times that a fit is refined, at most

Poles: TypeAlias = dict[int, Vector]
"""Denominators by their degree."""


def reduced_poles(record: Record, j: int) -> Poles:
    """Return denominators of a long model of an output, reduced to few states, by their number.

    The model of many lags, which noise on the output hardly biases, has an impulse response. The
    states of its Hankel matrix that hold most of it have the poles (Kung 1978). None are returned
    for too few rows, or where the model is not stable.
    """
    nu = len(record.inputs)
    rows = int(FITTED * sum(max(len(e) - _LONG, 0) for e in record.experiments))
    rows = min(rows, FEW_ROWS)
    long = min(_LONG, rows // (_PER_COLUMN * (1 + nu)))
    if not nu or long < 2 * MOST_LAGS:
        return {}
    orders = Orders(long, (long,) * nu, (1,) * nu)
    usable = [e for e in record.experiments if len(e) > long + 1]
    phi = np.concatenate([lag_rows_of(e, j, orders, long) for e in usable])[:rows]
    y = np.concatenate([e.outputs[long:, j] for e in usable])[:rows]
    scale = np.maximum(np.linalg.norm(phi, axis=0), 1e-300)
    theta = np.linalg.lstsq(phi / scale, y, rcond=RANK)[0] / scale
    response = np.zeros((_RESPONSE, nu))
    past, driven = theta[:long], theta[long:-1].reshape(nu, long)
    for k in range(_RESPONSE):
        before = response[max(k - long, 0) : k][::-1]
        response[k] = past[: len(before)] @ before
        response[k] += driven[:, k] if k < long else 0.0
    if not np.isfinite(response).all() or np.abs(response).max() > 1 / RANK:
        return {}
    half = _RESPONSE // 2
    hankel = np.block([[response[i + k] for k in range(half)] for i in range(half)])
    u, s, _ = np.linalg.svd(hankel, full_matrices=False)
    found = {}
    for n in range(1, MOST_LAGS + 1):
        if s[n - 1] > RANK * s[0]:
            seen = u[:, :n] * np.sqrt(s[:n])
            forward = np.linalg.lstsq(seen[:-1], seen[1:], rcond=None)[0]
            taps = np.real(np.poly(np.linalg.eigvals(forward)))
            if np.all(np.abs(np.roots(taps)) < 1):
                found[n] = taps
    return found


def from_poles(
    experiments: list[Experiment], j: int, taps: Vector, orders: Orders, first: int, cut: int
) -> list[Vector]:
    """Return θ with these poles, whose free run from rest follows the output best; none without."""
    from scipy.signal import lfilter

    driven = np.concatenate(
        [
            lfilter([1.0], taps, lag_rows_of(e, j, orders, first)[:, orders.na :], axis=0)
            for e in experiments
        ]
    )[:cut]
    y = np.concatenate([e.outputs[first:, j] for e in experiments])[:cut]
    scale = np.maximum(np.linalg.norm(driven, axis=0), 1e-300)
    if not np.isfinite(driven).all():
        return []
    b = np.linalg.lstsq(driven / scale, y, rcond=RANK)[0] / scale
    return [np.concatenate([-taps[1:], b])]


def best_free_run(
    experiments: list[Experiment],
    j: int,
    starts: Sequence[Vector],
    orders: Orders,
    first: int,
    cut: int,
) -> Vector:
    """Return the free run that is best over the first `cut` rows, of some starts or refined.

    Of several starts the steps of Gauss and Newton follow, and the past that a run begins at is
    chosen, too.
    """
    thorough = len(starts) > 1
    y = np.concatenate([e.outputs[first:, j] for e in experiments])
    best, least = np.full(len(y), np.inf), np.inf
    for theta in starts:
        for refine in (_by_instruments, _by_descent) if thorough else (_by_instruments,):
            own = np.inf
            for _ in range(1 + _REFINED):
                runs = [free_run_of(e, j, theta, orders, first) for e in experiments]
                if thorough:
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
        rows.append(lfilter([1.0], taps, lag_rows_of(e, j, orders, first), axis=0))
        target.append(lfilter([1.0], taps, e.outputs[first:, j]))
    return np.concatenate(rows), np.concatenate(target)


def _solved(instruments: Matrix, rows: Matrix, target: Vector) -> Vector | None:
    """Return θ by instruments; None where they do not determine it."""
    scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    system = (instruments / scale).T @ (rows / scale)
    if not np.isfinite(system).all() or not np.linalg.cond(system) < 1 / RANK:
        return None
    return np.linalg.solve(system, (instruments / scale).T @ target) / scale


def first_row_of(orders: Orders) -> int:
    """Return the first row that has all its lags."""
    late = (nb + nk - 1 for nb, nk in zip(orders.nb, orders.nk, strict=True))
    return max([orders.na, *late])


def lag_rows_of(e: Experiment, j: int, orders: Orders, first: int) -> Matrix:
    """Return the rows of own past, inputs from their delays on, and 1."""
    count = len(e) - first
    columns = [e.outputs[first - i : first - i + count, j] for i in range(1, orders.na + 1)]
    for i, (nb, nk) in enumerate(zip(orders.nb, orders.nk, strict=True)):
        columns += [e.inputs[first - lag : first - lag + count, i] for lag in range(nk, nk + nb)]
    return np.stack([*columns, np.ones(count)], axis=1)


def free_run_of(e: Experiment, j: int, theta: np.ndarray, orders: Orders, first: int) -> np.ndarray:
    """Return the output from its first measured rows on."""
    from scipy.signal import lfilter, lfiltic

    driven = lag_rows_of(e, j, orders, first)[:, orders.na :] @ theta[orders.na :]
    taps = np.concatenate([[1.0], -theta[: orders.na]])
    with np.errstate(all="ignore"):
        start = lfiltic(
            [1.0], taps, e.outputs[first - 1 :: -1, j][: orders.na] if first else np.empty(0)
        )
        return lfilter([1.0], taps, driven, zi=start)[0]
