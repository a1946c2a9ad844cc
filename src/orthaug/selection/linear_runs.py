"""Linear models of one output, by least squares on the error of their free run.

Least squares one step ahead is biased by noise on the outputs, most where a system is slow beside
its sampling. Instruments mend it (Young and Jakeman 1979): the outputs of the free run in place of
the measured ones, with all rows filtered by 1/A of the model before. That begins at least squares,
and where light damping makes these useless, at the poles of a long model that is reduced (Kung
1978); steps of Gauss and Newton follow there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

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

Stack: TypeAlias = Float[np.ndarray, "... _ _"]
"""Rows and columns of an experiment, or of several with an axis in front."""
Poles: TypeAlias = dict[int, Vector]
"""Denominators by their degree."""


@dataclass(frozen=True, eq=False)
class OutputRows:
    """The rows of an output in some experiments that have all lags of the `orders`."""

    experiments: Sequence[Experiment]
    output: int
    orders: Orders
    fitted: int | None = None
    """Rows that models are fitted to, the first of all experiments together; None for all."""

    @cached_property
    def pieces(self) -> list[tuple[Stack, Stack]]:
        """Outputs and inputs of neighbouring experiments of one length, which run side by side."""
        alike = groupby(self.experiments, key=len)
        groups = [list(group) for _, group in alike]
        return [
            (np.stack([e.outputs[:, [self.output]] for e in g]), np.stack([e.inputs for e in g]))
            for g in groups
        ]

    @cached_property
    def lags(self) -> list[Stack]:
        """Own past, inputs from their delays on, and 1, of each group of experiments."""
        return [lag_rows(*piece, [0], self.orders) for piece in self.pieces]

    @cached_property
    def measured(self) -> list[Matrix]:
        """The output of each group of experiments."""
        return [outputs[:, self.orders.first_row :, 0] for outputs, _ in self.pieces]

    @cached_property
    def regressors(self) -> Matrix:
        """The lags of all experiments."""
        return np.concatenate([_below_each_other(lags) for lags in self.lags])

    @cached_property
    def target(self) -> Vector:
        """The output of all experiments."""
        return in_turn(self.measured)

    def denominator(self, theta: Vector) -> Vector:
        """Return the coefficients of A, 1 in front."""
        return np.concatenate([[1.0], -theta[: self.orders.na]])

    def free_runs(self, theta: Vector) -> list[Matrix]:
        """Return the outputs of each group, simulated from the first measured rows on."""
        from scipy.linalg import hankel
        from scipy.signal import lfilter

        na, first, runs = self.orders.na, self.orders.first_row, []
        taps = self.denominator(theta)
        for (outputs, _), lags in zip(self.pieces, self.lags, strict=True):
            driven = lags[..., na:] @ theta[na:]
            past = outputs[:, first - na : first, 0][:, ::-1]
            begun = past @ hankel(-taps[1:]) if na else past
            with np.errstate(all="ignore"):
                runs.append(lfilter([1.0], taps, driven, axis=1, zi=begun)[0])
        return runs

    def filtered(
        self, theta: Vector, runs: Sequence[Matrix] | None = None
    ) -> tuple[Matrix, Vector] | None:
        """Return regressors and output filtered by 1/A, measured or of free runs.

        None where A is unstable.
        """
        taps = self.denominator(theta)
        if not self.orders.na or np.any(np.abs(np.roots(taps)) >= 1):
            return None
        lags = self.lags if runs is None else self._lags_of(runs)
        outputs = self.measured if runs is None else runs
        rows = np.concatenate([_below_each_other(_follow(taps, one)) for one in lags])
        return rows, in_turn([_follow(taps, one) for one in outputs])

    def _lags_of(self, runs: Sequence[Matrix]) -> list[Stack]:
        """Return the lags with the outputs of runs in place of the measured ones."""
        first, found = self.orders.first_row, []
        for (outputs, inputs), run in zip(self.pieces, runs, strict=True):
            outputs = np.concatenate([outputs[:, :first], run[..., None]], axis=1)
            found.append(lag_rows(outputs, inputs, [0], self.orders))
        return found


def in_turn(runs: Sequence[Matrix]) -> Vector:
    """Return the rows of groups of experiments, one experiment after the other."""
    return np.concatenate([run.reshape(-1) for run in runs])


def _below_each_other(lags: Stack) -> Matrix:
    """Return the rows of a group of experiments, one experiment after the other."""
    return lags.reshape(-1, lags.shape[-1])


def _follow(taps: Vector, signals: Any) -> Any:
    """Return signals of experiments (n, rows, …) filtered by 1/A, each from rest."""
    from scipy.signal import lfilter

    return lfilter([1.0], taps, signals, axis=1)


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
    own = OutputRows(usable, j, orders)
    phi, y = own.regressors[:rows], own.target[:rows]
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


def from_poles(rows: OutputRows, taps: Vector) -> list[Vector]:
    """Return θ with these poles, whose free run from rest follows the output best; none without."""
    na, cut = rows.orders.na, rows.fitted
    driven = np.concatenate(
        [_below_each_other(_follow(taps, lags[..., na:])) for lags in rows.lags]
    )[:cut]
    scale = np.maximum(np.linalg.norm(driven, axis=0), 1e-300)
    if not np.isfinite(driven).all():
        return []
    b = np.linalg.lstsq(driven / scale, rows.target[:cut], rcond=RANK)[0] / scale
    return [np.concatenate([-taps[1:], b])]


def best_free_run(rows: OutputRows, starts: Sequence[Vector]) -> Vector:
    """Return the free run that is best over the rows that are fitted, of some starts or refined.

    Of several starts the steps of Gauss and Newton follow, and the past that a run begins at is
    chosen, too.
    """
    thorough, cut, y = len(starts) > 1, rows.fitted, rows.target
    best, least = np.full(len(y), np.inf), np.inf
    for theta in starts:
        for refine in (_by_instruments, _by_descent) if thorough else (_by_instruments,):
            own = np.inf
            for _ in range(1 + _REFINED):
                runs = rows.free_runs(theta)
                if thorough:
                    runs = _from_best_starts(rows, runs, theta)
                simulated = in_turn(runs)
                with np.errstate(all="ignore"):
                    square = float(np.mean((simulated[:cut] - y[:cut]) ** 2))
                if not square < own:
                    break
                own, reached = square, theta
                if own < least:
                    best, least = simulated, own
                refined = refine(rows, runs, theta)
                if refined is None:
                    break
                theta = refined
            if not np.isfinite(own):
                break
            theta = reached
    return best


def _from_best_starts(rows: OutputRows, runs: list[Matrix], theta: Vector) -> list[Matrix]:
    """Return runs from the past by which they follow the rows that are fitted best.

    What light damping makes of the noise in a measured start lasts for long.
    """
    from scipy.signal import lfilter

    na, taps, moved = rows.orders.na, rows.denominator(theta), []
    left = len(rows.target) if rows.fitted is None else rows.fitted
    for run, measured in zip(runs, rows.measured, strict=True):
        length = run.shape[1]
        still = np.zeros(length)
        free = np.stack([lfilter([1.0], taps, still, zi=zi)[0] for zi in np.eye(na)], axis=1)
        whole, rest = divmod(min(left, run.size), length)
        left, run = left - whole * length - rest, run.copy()
        for fitted, count in ((slice(whole), length), (slice(whole, whole + 1), rest)):
            if count > 2 * na and np.isfinite(free).all():
                missed = measured[fitted, :count] - run[fitted, :count]
                missed[~np.isfinite(run[fitted]).all(axis=1)] = 0.0
                run[fitted] += (free @ np.linalg.lstsq(free[:count], missed.T, rcond=None)[0]).T
        moved.append(run)
    return moved


def _by_instruments(rows: OutputRows, runs: list[Matrix], theta: Vector) -> Vector | None:
    """Return θ with the outputs of free runs as instruments, rows filtered by 1/A.

    None where A is not stable or the instruments do not determine θ.
    """
    instruments, measured = rows.filtered(theta, runs), rows.filtered(theta)
    if instruments is None or measured is None:
        return None
    return _solved(*(part[: rows.fitted] for part in (instruments[0], *measured)))


def _by_descent(rows: OutputRows, runs: list[Matrix], theta: Vector) -> Vector | None:
    """Return θ after a step of Gauss and Newton on the errors of the free runs.

    Their slopes are the rows of the run, filtered by 1/A. None as of `_by_instruments`.
    """
    filtered = rows.filtered(theta, runs)
    if filtered is None:
        return None
    slopes = filtered[0][: rows.fitted]
    left = (rows.target - in_turn(runs))[: rows.fitted]
    step = _solved(slopes, slopes, left)
    return None if step is None else theta + step


def _solved(instruments: Matrix, rows: Matrix, target: Vector) -> Vector | None:
    """Return θ by instruments; None where they do not determine it."""
    scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    system = (instruments / scale).T @ (rows / scale)
    if not np.isfinite(system).all() or not np.linalg.cond(system) < 1 / RANK:
        return None
    return np.linalg.solve(system, (instruments / scale).T @ target) / scale


def lag_rows(outputs: Stack, inputs: Stack, which: Sequence[int], orders: Orders) -> Stack:
    """Return the rows of some outputs' past, lag by lag, of inputs from their delays on, and 1.

    Args:
        which: the channels of these outputs.
    """
    first, count = orders.first_row, outputs.shape[-2] - orders.first_row
    own = [
        outputs[..., first - i : first - i + count, j]
        for i in range(1, orders.na + 1)
        for j in which
    ]
    driven = driven_rows_of(inputs, orders)
    return np.concatenate([*(one[..., None] for one in own), driven], axis=-1)


def driven_rows_of(inputs: Stack, orders: Orders) -> Stack:
    """Return the rows of inputs from their delays on, and 1; axes as of `lag_rows`."""
    first, count, columns = orders.first_row, inputs.shape[-2] - orders.first_row, []
    for i, (nb, nk) in enumerate(zip(orders.nb, orders.nk, strict=True)):
        columns += [inputs[..., first - lag : first - lag + count, i] for lag in range(nk, nk + nb)]
    return np.stack([*columns, np.ones((*inputs.shape[:-2], count))], axis=-1)
