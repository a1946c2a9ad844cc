"""Tests of a residual from running sums: for records whose rows come piece by piece and are not kept.

Products of samples up to M apart add up over the pieces of an experiment, and over experiments. So the correlations are
those that `residuals.analyse` makes of all rows at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.special

from orthaug._base.checks import Matrix, Vector
from orthaug.analysis.correlation import LARGEST
from orthaug.analysis.independence import CrossTest
from orthaug.analysis.residuals import LAGS
from orthaug.analysis.whiteness import LjungBox, ljung_box_of
from orthaug.data.record import Experiment


@dataclass(frozen=True, eq=False)
class RunningTest:
    """Whiteness and independence of one output's residual over all rows; None for what does not exist.

    The band of a cross-correlation takes `Var r_eu(τ) = P/N` with `P = Σ_m r_e(m) r_u(m)` over |m| ≤ M. There is no
    joint test: it needs the rows.
    """

    name: str
    n: int
    mean: float
    rms: float
    acf: Vector
    acf_band: float
    ljung_box: LjungBox
    cross: Mapping[str, CrossTest | None]


class RunningResidual:
    """Sums over residuals and inputs that come piece by piece."""

    def __init__(self, outputs: Sequence[str], inputs: Sequence[str], lags: int = LAGS) -> None:
        n = len(outputs) + len(inputs)
        self.outputs, self.inputs, self.lags = tuple(outputs), tuple(inputs), lags
        self._origin: Any = None  # near the means, so that little cancels
        self._before = np.zeros((0, n))
        self._products = np.zeros((lags + 1, n, n))
        self._later, self._earlier = np.zeros((lags + 1, n)), np.zeros((lags + 1, n))
        self._pairs = np.zeros(lags + 1)
        self._ended = ("", -1)

    def add(self, residual: Matrix, inputs: Matrix, *, begins: bool) -> None:
        """Rows (m, ny) and (m, nu) that follow those before, unless an experiment `begins`."""
        values = np.concatenate([residual, inputs], axis=1)
        if not len(values):
            return
        if self._origin is None:
            self._origin = values.mean(axis=0)
        held = self._before[:0] if begins else self._before
        joined = np.concatenate([held, values - self._origin])
        with np.errstate(all="ignore"):
            for lag in range(min(self.lags, len(joined) - 1) + 1):
                first = max(len(held), lag)
                later, earlier = joined[first:], joined[first - lag : len(joined) - lag]
                self._products[lag] += later.T @ earlier
                self._later[lag] += later.sum(axis=0)
                self._earlier[lag] += earlier.sum(axis=0)
                self._pairs[lag] += len(later)
        self._before = joined[max(len(joined) - self.lags, 0) :]

    def watch(self, piece: Experiment, first: int, residual: Matrix) -> None:
        """The residual of a piece from its row `first` on."""
        follows = self._ended == (piece.source, piece.offset + first)
        self.add(residual, piece.inputs[first:], begins=not follows)
        self._ended = piece.source, piece.offset + len(piece)

    def tests(self, level: float = 0.01) -> tuple[RunningTest, ...]:
        """Of every output whose residual is finite and moves."""
        n = int(self._pairs[0])
        if n <= self.lags or not np.abs(self._products[0]).max() < LARGEST:
            return ()
        mean = self._later[0] / n
        crossed = self._later[:, :, None] * mean + mean[:, None] * self._earlier[:, None, :]
        covariance = self._products - crossed + self._pairs[:, None, None] * np.outer(mean, mean)
        size = np.sqrt(np.maximum(np.diag(covariance[0]), 0.0))
        moves = size > np.sqrt(np.finfo(float).eps) * np.sqrt(np.diag(self._products[0]))
        r = covariance / np.where(moves[:, None] & moves, np.outer(size, size), 1.0)
        quantile = float(-scipy.special.ndtri(level / 2))
        found = []
        for i, name in enumerate(self.outputs):
            if not moves[i]:
                continue
            acf, centre = r[:, i, i], float(self._origin[i] + mean[i])
            cross = {
                other: self._cross(r, i, len(self.outputs) + j, n, quantile) if moves[len(self.outputs) + j] else None
                for j, other in enumerate(self.inputs)
            }
            box = ljung_box_of(acf, self._pairs[1:], n)
            rms = float(np.hypot(size[i] / np.sqrt(n), centre))
            found.append(RunningTest(name, n, centre, rms, acf, quantile / np.sqrt(n), box, cross))
        return tuple(found)

    def _cross(self, r: Any, e: int, u: int, n: int, quantile: float) -> CrossTest:
        follows = r[:, e, u]
        values = np.concatenate([r[:0:-1, u, e], follows])
        product = 2 * float(r[:, e, e] @ r[:, u, u]) - 1
        lag = int(np.abs(follows).argmax())
        band = quantile * float(np.sqrt(max(product, 0.0) / n))
        return CrossTest(values, band, None, lag, float(np.abs(follows[lag])))
