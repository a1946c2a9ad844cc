"""An alarm for residuals that leave their band, by cumulative sums at several scales.

The sums are likelihood ratios of a doubled variance.

Residuals are whitened by their covariance and colour over the training rows, then summed over
blocks of 1, 4, 16 and 64 rows, since what a changed system adds is slow beside noise. Of each
block's square `y²` the sum

    g ← max(0, g + ½ (y²/2 − ln 2))

is the log-likelihood ratio of twice the variance (CUSUM, Page 1954). For independent normal blocks
it exceeds h once in `e^h` blocks or less often (Lorden 1971). Where training residuals have heavier
tails, h is larger by the exponent κ for which `exp(κ x)` has mean one over their increments x.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from orthaug._base.checks import Matrix, Vector

SCALES = (1, 4, 16, 64)
_RATIO = 2.0  # of the variance that is looked for
# Deviations: what is beyond counts as that, so that no single outlier raises an alarm
_LARGEST = 4.0
_GROSS = 10.0
_HIGHEST = 1.2  # of the limit: so that an alarm ends soon after its cause
_ARMED = 0.5
_FEWEST_BLOCKS = 30
_MOST_LAGS = 10
_ROWS_PER_LAG = 20
_LEAST_EXPONENT = 0.1


@dataclass(frozen=True, eq=False)
class Reference:
    """The statistics of residuals in training.

    `white` (ny, ny) whitens whitened outputs' errors, `colour` (p, ny) are autoregressive
    coefficients of each, and `deviation` (ny,) is that of what they leave. Of each scale `variance`
    is that of block sums over √rows, and `limit` the threshold of g.
    """

    white: Matrix
    colour: Matrix
    deviation: Vector
    scales: tuple[int, ...]
    variance: Vector
    limit: Vector

    @classmethod
    def of(cls, stretches: Sequence[Matrix], white: Matrix, used: float, quiet: float) -> Reference:
        """Return the reference of training errors.

        Args:
            stretches: whitened outputs' errors of each experiment, (N, ny).
            white: their whitening.
            used: share of the rows' degrees of freedom that parameters and learner have used up: by
                as much their errors move new residuals, and slowly.
            quiet: rows between false alarms.
        """
        given = [stretch @ white.T for stretch in stretches]
        colour = _colour(given)
        left = [_innovations(stretch, colour) for stretch in given]
        rows = np.concatenate(left)
        deviation = np.sqrt(np.mean(rows**2, axis=0))
        deviation = np.where(deviation > 0, deviation, 1.0)
        scales = tuple(
            s for s in SCALES if s == 1 or sum(len(e) // s for e in left) >= _FEWEST_BLOCKS
        )
        variances, limits = [], []
        for scale in scales:
            blocks = np.concatenate([_blocks(stretch / deviation, scale) for stretch in left])
            variance = max(1.0, float(np.mean(blocks**2))) if blocks.size else 1.0
            steps = _steps(blocks / math.sqrt(variance))
            variances.append(variance * (1 + scale * used))
            limits.append(math.log(max(len(scales) * quiet / scale, 2.0)) / _exponent(steps))
        return cls(white, colour, deviation, scales, np.array(variances), np.array(limits))


@dataclass(eq=False)
class ResidualMonitor:
    """The sums so far; `step` changes them."""

    reference: Reference
    past: Matrix = field(init=False)
    sums: Matrix = field(init=False)
    counts: list[int] = field(init=False)
    totals: list[float] = field(init=False)
    level: float = 0.0
    """The largest g over its limit, above 1 for an alarm."""
    armed: bool = True
    """True if the next level above 1 is a new alarm: one that has come back below a half."""

    def __post_init__(self) -> None:
        reference = self.reference
        self.totals = [0.0] * len(reference.scales)
        self._root = [
            math.sqrt(v * s) for v, s in zip(reference.variance, reference.scales, strict=True)
        ]
        self._limits = [float(limit) for limit in reference.limit]
        self.gap()

    def gap(self) -> None:
        """Note that the next row does not follow on the last one."""
        ny = len(self.reference.white)
        self.past = np.full((len(self.reference.colour), ny), np.nan)
        self.sums = np.zeros((len(self.reference.scales), ny))
        self.counts = [0] * len(self.reference.scales)

    def skip(self) -> None:
        """Pass over a row whose residual carries no information about the band."""
        if len(self.past):
            self.past = np.concatenate([np.full_like(self.past[:1], np.nan), self.past[:-1]])

    def step(self, error: Vector, spread: float) -> bool:
        """Add a row's errors (ny,) in whitened outputs; return whether this is a new alarm.

        Their variance is `spread` times that of training.
        """
        reference = self.reference
        residual = reference.white @ error / math.sqrt(spread)
        expected = np.sum(reference.colour * self.past, axis=0)
        left = (residual - expected) / reference.deviation
        clipped = np.minimum(np.maximum(left, -_LARGEST), _LARGEST)
        known = not math.isnan(left[0])
        if len(
            reference.colour
        ):  # no innovation is that large: an outlier is not remembered, so that it counts once
            now = np.where(np.abs(left) > _GROSS, expected, residual) if known else residual
            self.past = np.concatenate([now[None], self.past[:-1]])
        if not known:  # the filter is not filled yet
            return False
        self.sums += clipped
        for i, scale in enumerate(reference.scales):
            self.counts[i] += 1
            if self.counts[i] == scale:
                step = float(_steps(self.sums[i][None] / self._root[i])[0])
                self.totals[i] = min(max(0.0, self.totals[i] + step), _HIGHEST * self._limits[i])
                self.counts[i] = 0
                self.sums[i] = 0.0
        self.level = max(
            total / limit for total, limit in zip(self.totals, self._limits, strict=True)
        )
        raised = self.armed and self.level > 1
        self.armed = not raised and (self.armed or self.level < _ARMED)
        return raised


def _steps(blocks: Matrix) -> Vector:
    """Return the increments of g, summed over outputs (n,)."""
    squares = np.minimum(blocks * blocks, _LARGEST**2)
    return (0.5 * ((1 - 1 / _RATIO) * squares - math.log(_RATIO))).sum(axis=1)


def _exponent(steps: Vector) -> float:
    """Return κ with mean `exp(κ x)` = 1, at most 1 as for normal blocks."""
    low, high = _LEAST_EXPONENT, 1.0
    if not len(steps) or np.mean(np.exp(steps)) <= 1:
        return high
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if np.mean(np.exp(middle * steps)) <= 1 else (low, middle)
    return low


def _blocks(stretch: Matrix, scale: int) -> Matrix:
    """Return sums over blocks of rows over √rows, of clipped residuals (n, ny)."""
    count = len(stretch) // scale
    clipped = np.clip(stretch[: count * scale], -_LARGEST, _LARGEST)
    return clipped.reshape(count, scale, -1).sum(axis=1) / math.sqrt(scale)


def _innovations(stretch: Matrix, colour: Matrix) -> Matrix:
    """Return the innovations of residuals under an autoregression."""
    lags = len(colour)
    left = stretch[lags:].copy()
    for i, row in enumerate(colour, start=1):
        left -= row * stretch[lags - i : len(stretch) - i]
    return left


def _colour(stretches: Sequence[Matrix]) -> Matrix:
    """Return autoregressive coefficients (p, ny).

    The order p by Schwarz's criterion, the same for all outputs.
    """
    rows = sum(max(len(stretch) - _MOST_LAGS, 0) for stretch in stretches)
    ny = stretches[0].shape[1]
    most = min(_MOST_LAGS, rows // _ROWS_PER_LAG)
    if not most:
        return np.zeros((0, ny))
    long = [stretch for stretch in stretches if len(stretch) > _MOST_LAGS]
    best, least = np.zeros((0, ny)), np.inf
    for order in range(most + 1):
        colour, cost = np.zeros((order, ny)), ny * order * math.log(rows)
        for i in range(ny):
            past = np.zeros((rows, order))
            for j in range(1, order + 1):
                past[:, j - 1] = np.concatenate([s[_MOST_LAGS - j : len(s) - j, i] for s in long])
            now = np.concatenate([s[_MOST_LAGS:, i] for s in long])
            colour[:, i] = np.linalg.lstsq(past, now, rcond=None)[0]
            cost += rows * math.log(max(float(np.mean((now - past @ colour[:, i]) ** 2)), 1e-300))
        if cost < least:
            best, least = colour, cost
    return best
