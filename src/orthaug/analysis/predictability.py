"""Share of a signal's variance that others predict, cross-validated from Gram sums.

Rows are cut into contiguous blocks. Each is predicted by least squares on the others, so that the
share is what a model with these columns would gain on rows that it has not seen; chance counts
against it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug.analysis.residuals import errors_of
from orthaug.data.regressors import Layout
from orthaug.fitting.whiteness import Pieces, pieces_of
from orthaug.inference.covariance import by_experiment
from orthaug.models.response import Response
from orthaug.physics.problem import Problem

_VARIABLES = 6  # that functions are made of, at most
_FARTHEST = 4.0  # deviations: farther values count as this far
BLOCKS = 8
_PAST = 5  # lags of an output's own error
_FURTHER = 10  # lags of inputs beyond the largest of the regressor
_ROWS = 20_000
_NEIGHBOURS = 4000  # rows whose neighbours are sought
_APART = 10  # rows: those closer in time are no neighbours, for noise makes them alike
_RIDGE = 1e-6  # of a column's sum of squares, so that columns that repeat each other do no harm


@dataclass(frozen=True, eq=False)
class SimpleFunctions:
    """Directions of the regressor: each channel's first lag and differences, with mean and size."""

    variables: tuple[tuple[Vector, float, float], ...]

    @classmethod
    def of(cls, layout: Layout, x: Matrix) -> SimpleFunctions:
        """Return the functions for regressors (N, n).

        First lags and differences of all channels come first.
        """
        each = np.eye(len(layout))
        places: dict[str, list[int]] = {}
        for j, lag in enumerate(layout):
            places.setdefault(lag.channel, []).append(j)
        directions = []
        for i in range(max(map(len, places.values()), default=0)):
            for own in places.values():
                if i < len(own):
                    directions.append(each[own[i]] if i == 0 else each[own[i - 1]] - each[own[i]])
        moved = [(d, float((x @ d).mean()), float((x @ d).std())) for d in directions[:_VARIABLES]]
        return cls(tuple(entry for entry in moved if entry[2] > 0))

    def __len__(self) -> int:
        n = len(self.variables)
        return 5 * n + 3 * n * (n - 1) // 2

    def __call__(self, x: Matrix) -> Matrix:
        """Return the functions on rows of the regressor, (N, functions)."""
        columns = []
        scaled = [
            np.clip((x @ d - mean) / size, -_FARTHEST, _FARTHEST)
            for d, mean, size in self.variables
        ]
        for v in scaled:
            columns += [v**2, v**3, np.abs(v), v * np.abs(v), np.tanh(3 * v)]
        for i, v in enumerate(scaled):
            for w in scaled[:i]:
                columns += [v * w, v**2 * w, v * w**2]
        return np.stack(columns, axis=-1) if columns else np.zeros((len(x), 0))


@dataclass(frozen=True)
class Share:
    """A share of variance, and its standard error over the blocks."""

    value: float
    error: float

    @classmethod
    def of(cls, without: Vector, together: Vector) -> Share:
        """Return the relative decrease of a sum of squares over blocks (blocks,)."""
        total, gained = float(without.sum()), without - together
        if not (total > 0 and np.isfinite(gained).all()):
            return cls(0.0, 0.0)
        value = float(gained.sum() / total)
        # Of a ratio of sums: loud blocks may gain more (Cochran 1977, sect. 2.11)
        off = gained - value * without
        return cls(value, float(np.sqrt(len(off)) * off.std(ddof=1) / total))

    @property
    def sure(self) -> float:
        """Two standard errors less, and not below 0."""
        return max(self.value - 2 * self.error, 0.0)


@dataclass(frozen=True, eq=False)
class BlockSums:
    """Gram matrices of (columns, target) over every block of rows, (blocks, m + 1, m + 1)."""

    grams: Float[np.ndarray, "b m+1 m+1"]
    _beside: dict[tuple[int, ...], Vector] = field(default_factory=dict, init=False, repr=False)
    """Squared errors by columns beside which shares were asked: many share the same."""

    @classmethod
    def of(cls, columns: Matrix, target: Vector, blocks: int = BLOCKS) -> BlockSums:
        """Return the sums of rows in their order."""
        both = np.column_stack([columns, target])
        edges = np.linspace(0, len(both), blocks + 1).astype(int)
        return cls(
            np.stack([both[a:b].T @ both[a:b] for a, b in zip(edges[:-1], edges[1:], strict=True)])
        )

    def share(self, columns: Sequence[int], beside: Sequence[int] = ()) -> Share:
        """Return the share of the target that `columns` explain beyond those in `beside`."""
        key = tuple(beside)
        if key not in self._beside:
            self._beside[key] = self._squared_errors(list(beside))
        return Share.of(self._beside[key], self._squared_errors([*beside, *columns]))

    def _squared_errors(self, columns: list[int]) -> Vector:
        """Return each block's sum of squared errors (blocks,), by regression on the others."""
        own = np.ix_(range(len(self.grams)), columns, columns)
        inner, moment, total = self.grams[own], self.grams[:, columns, -1], self.grams[:, -1, -1]
        if not columns:
            return total
        rest, right = inner.sum(axis=0) - inner, moment.sum(axis=0) - moment
        size = np.sqrt(np.maximum(np.einsum("bii->bi", rest), np.finfo(float).tiny))
        scaled = rest / (size[:, :, None] * size[:, None, :]) + _RIDGE * np.eye(len(columns))
        found = np.linalg.solve(scaled, (right / size)[..., None])[..., 0] / size
        return (
            total
            - 2 * np.sum(found * moment, axis=1)
            + np.einsum("bi,bij,bj->b", found, inner, found)
        )


def from_own_past(signal: Pieces, lags: int) -> Share:
    """Return the share of a signal less its mean that a short autoregression predicts."""
    return from_lags(signal, [signal], range(1, lags + 1))


def from_lags(signal: Pieces, others: Sequence[Pieces], lags: Sequence[int]) -> Share:
    """Return the share of a signal that lags of other signals predict, beside a constant."""
    if not others or not len(lags):
        return Share(0.0, 0.0)
    target, columns = [], []
    for one, *beside in zip(*map(pieces_of, (signal, *others)), strict=True):
        rows = range(max(lags), len(one))
        if len(rows):
            target.append(one[rows])
            columns.append(
                np.column_stack([x[np.array(rows) - lag] for x in beside for lag in lags])
            )
    count = 1 + len(lags) * len(others)
    if sum(map(len, target)) < 5 * count:
        return Share(0.0, 0.0)
    whole = np.concatenate(columns)
    size = whole.std(axis=0)
    whole = (whole - whole.mean(axis=0)) / np.where(size > 0, size, 1.0)
    sums = BlockSums.of(np.column_stack([np.ones(len(whole)), whole]), np.concatenate(target))
    return sums.share(range(1, count), [0])


def from_neighbours(x: Matrix, signal: Vector) -> Share:
    """Return the share of a signal (N,) that any smooth function of the rows x could explain.

    Where two rows lie close to each other, their values differ by the rest alone: half the mean
    square of that is the variance of the rest (Rice 1984), to be compared with the mean square of
    both. Where they lie far apart, as in many dimensions, it explains less than there is.
    """
    from scipy.spatial import KDTree

    size = x.std(axis=0)
    scaled = (x[:, size > 0] - x[:, size > 0].mean(axis=0)) / size[size > 0]
    if not scaled.size or len(x) < 4 * BLOCKS * _APART:
        return Share(0.0, 0.0)
    near = np.asarray(KDTree(scaled).query(scaled, 2 * _APART + 2)[1])
    nearest = near[
        np.arange(len(x)), np.argmax(np.abs(near - np.arange(len(x))[:, None]) > _APART, axis=1)
    ]
    # Two rows that are each other's nearest are one pair, not two that agree by chance
    pairs = np.unique(np.sort(np.column_stack([np.arange(len(x)), nearest]), axis=1), axis=0)
    a, b = (signal - signal.mean())[pairs].T
    # Of both neighbours' squares: of one's alone, errors of uneven size would seem to differ less
    both = np.stack([(a**2 + b**2) / 2, (a - b) ** 2 / 2])
    return Share.of(
        *np.stack([part.sum(axis=1) for part in np.array_split(both, BLOCKS, axis=1)], axis=1)
    )


@dataclass(frozen=True)
class Predictable:
    """RMS of an output's error, in the output's unit, and its predictable shares.

    It is predicted from its own past and from lagged inputs, both cross-validated, and from
    functions of the regressors: products and curves, cross-validated as well, or one step ahead
    whatever lets neighbours have like errors. Two standard errors are taken off; 0 where that is
    not surely more than nothing.
    """

    name: str
    rms: float
    own_past: float
    inputs: float
    functions: float

    def largest(self, own_past: bool = True) -> float:
        """Return the largest share.

        Without the own past where that is of no use, as in a free run.
        """
        return max(self.inputs, self.functions, self.own_past if own_past else 0.0)


def predictable(
    problem: Problem, response: Response, skip: int = 0, *, simulates: bool = False
) -> tuple[Predictable, ...]:
    """Return the predictable shares of a response's errors on training data, after `skip` rows.

    Args:
        simulates: a free run, whose errors are no function of the regressor.
    """
    errors, found = errors_of(response, skip), []
    functions = SimpleFunctions.of(problem.layout, problem.rows.x)
    starts = [run.start + skip for run in response.trajectories]
    inputs = [e.inputs[a:] for e, a in zip(problem.record.experiments, starts, strict=True)]
    x = np.concatenate([piece[skip:] for piece in by_experiment(problem, problem.rows.x)])
    every, few = (slice(None, None, -(-len(x) // most)) for most in (_ROWS, _NEIGHBOURS))
    read = [problem.layout.index(lag) for lag in problem.used]
    columns = np.column_stack([np.ones(len(x[every])), functions(x[every])])
    longest = max((lag.lag for lag in problem.layout), default=0) + _FURTHER
    for o, name in enumerate(problem.outputs):
        e = [piece[:, o] for piece in errors]
        whole, lags = np.concatenate(e), range(min(longest, min(map(len, e)) // 10) + 1)
        own = from_own_past(e, _PAST)
        driven = from_lags(
            e, [[u[:, j] for u in inputs] for j in range(len(problem.record.inputs))], lags
        )
        curved = Share(0.0, 0.0)
        if len(columns) > 5 * columns.shape[1] > 5:
            curved = BlockSums.of(columns, whole[every]).share(range(1, columns.shape[1]), [0])
        near = 0.0 if simulates else from_neighbours(x[few][:, read], whole[few]).sure
        rms = float(np.sqrt(np.mean(whole**2)))
        found.append(Predictable(name, rms, own.sure, driven.sure, max(curved.sure, near)))
    return tuple(found)
