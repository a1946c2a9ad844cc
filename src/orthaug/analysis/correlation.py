"""Signals of one or several experiments, and their correlations: no product crosses the boundary of an experiment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from orthaug._base.checks import Vector

Pieces = Sequence[Vector] | Vector  # a signal in one piece per experiment; a plain vector is one experiment

CONSTANT = 64 * np.finfo(float).eps  # rounding of the mean: a smaller deviation, against the largest value, is none
LARGEST = 1e150  # squares of larger values overflow: a model that left all bounds has no statistics


def autocorrelation(signal: Pieces, lags: int = 25) -> Vector | None:
    """r_e(τ) = Σ e_k e_{k−τ} / Σ e_k², e less its mean, for τ = 0…lags, (lags + 1,).

    The mean is that of all experiments. Lags as long as the longest experiment are cut; None for a constant signal.
    """
    values = cross_correlation(signal, signal, lags)
    return None if values is None else values[len(values) // 2 :]


def cross_correlation(residual: Pieces, inputs: Pieces, lags: int = 25) -> Vector | None:
    """r_eu(τ) = Σ e_k u_{k−τ} / √(Σ e_k² Σ u_k²), means removed, for τ = −lags…lags, (2 lags + 1,).

    At τ ≥ 0 the residual follows the input. Lags are cut as in `autocorrelation`; None where one signal is constant.
    """
    e, u = standardised(residual), standardised(inputs)
    if e is None or u is None:
        return None
    reach = min(lags, max(map(len, e)) - 1)
    pairs = list(zip(e, u, strict=True))
    leads = [sum(y[lag:] @ x[: len(x) - lag] for x, y in pairs if len(x) > lag) for lag in range(reach, 0, -1)]
    follows = [sum(x[lag:] @ y[: len(y) - lag] for x, y in pairs if len(x) > lag) for lag in range(reach + 1)]
    return np.array(leads + follows)


def pieces_of(signal: Pieces) -> list[Vector]:
    """One array per experiment."""
    parts = [signal] if isinstance(signal, np.ndarray) and signal.ndim == 1 else signal
    return [np.asarray(one, dtype=float) for one in parts]


def standardised(signal: Pieces) -> list[Vector] | None:
    """Less the mean of all samples, with a sum of squares of 1; None for a signal that is constant or not finite."""
    parts = pieces_of(signal)
    whole = np.concatenate(parts) if len(parts) else np.zeros(0)
    size = np.abs(whole).max(initial=0.0)
    if not 0 < size < LARGEST:
        return None
    whole = whole / size - np.mean(whole / size)  # so that no square underflows
    norm = np.linalg.norm(whole)
    return None if norm <= CONSTANT * np.sqrt(len(whole)) else cut(whole / norm, parts)


def cut(whole: Any, like: Sequence[Vector]) -> list[Any]:
    """A signal in experiments as long as those of another."""
    return np.split(whole, np.cumsum([len(one) for one in like])[:-1])
