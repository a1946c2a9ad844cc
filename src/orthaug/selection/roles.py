"""Inputs and outputs of a file whose column names do not show them: what predicts what.

An output follows from the past of other columns beside its own past (Granger 1969); an input does
not. Where a controller closes the loop, both do, and nothing is guessed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy.special
from scipy.sparse.csgraph import connected_components

from orthaug._base.checks import Matrix, Vector
from orthaug.data.columns import Column

_ROWS = 20_000  # looked at, from the first on
_OWN, _OTHERS = 20, 6  # lags of a column itself, and of each other one
_FEWEST = 10  # rows for each coefficient
_MOST = 8  # columns
_MOST_OUTPUTS = 4
_SURE, _UNSURE = 1e-6, 1e-3  # levels of the F-test for and against an effect
_FOLLOWS = 0.05  # of the one-step error's square that the others take away from an output's
_NOTHING = 0.1  # of that of the least certain output, from which on a column is no input


@dataclass(frozen=True, eq=False)
class Guess:
    """Columns that predict others and are not predicted, and those that are."""

    inputs: tuple[Column, ...]
    outputs: tuple[Column, ...]

    def __str__(self) -> str:
        """Return the reason, as a clause."""
        causes = " and ".join(f"'{c.header}'" for c in self.inputs)
        effects = " and ".join(f"'{c.header}'" for c in self.outputs)
        return f"past values of {causes} help to predict {effects}, but not the reverse"


def guess_roles(columns: Sequence[Column]) -> Guess | None:
    """Return inputs and outputs by what predicts what; None where that is not clear.

    Nothing is guessed where a name contradicts the past, or where the columns fall into groups
    without a relation, such as two runs side by side.
    """
    if not 2 <= len(columns) <= _MOST or len({c.filled for c in columns}) > 1:
        return None
    lags = _lagged(columns)
    if lags is None:
        return None
    tests = [lags.test(i) for i in range(len(columns))]
    follow = [i for i, (gain, p) in enumerate(tests) if p < _SURE and gain > _FOLLOWS]
    if not 0 < len(follow) <= _MOST_OUTPUTS:
        return None
    least = min(tests[i][0] for i in follow)
    lead = [i for i in range(len(columns)) if i not in follow]
    if any(p <= _UNSURE and gain >= _NOTHING * least for gain, p in (tests[i] for i in lead)):
        return None
    drives = np.zeros((len(columns), len(columns)), dtype=bool)
    for i, j in product(range(len(columns)), follow):
        drives[i, j] = i != j and lags.drives(i, j)
    driving = [i for i in lead if drives[i].any()]
    if not driving or any(columns[i].kind == "output" for i in driving):
        return None
    if any(columns[i].kind == "input" for i in follow):
        return None
    related = np.ix_([*driving, *follow], [*driving, *follow])
    if connected_components(drives[related], directed=False, return_labels=False) > 1:
        return None
    return Guess(tuple(columns[i] for i in driving), tuple(columns[i] for i in follow))


@dataclass(frozen=True, eq=False)
class _Lags:
    """Past of every column, own (n, _OWN) and as the others see it, (n, _OTHERS); and its rows."""

    now: Matrix
    own: list[Matrix]
    seen: list[Matrix]

    def test(self, i: int) -> tuple[float, float]:
        """Return what the past of the others takes of a column's squared error, and F's p."""
        others = [x for j, x in enumerate(self.seen) if j != i]
        return self._gain(self.now[:, i], [self.own[i]], others)

    def drives(self, i: int, j: int) -> bool:
        """Return whether the past of column i helps to predict column j beside all others."""
        rest = [x for k, x in enumerate(self.seen) if k not in (i, j)]
        return self._gain(self.now[:, j], [self.own[j], *rest], [self.seen[i]])[1] < _UNSURE

    @staticmethod
    def _gain(target: Vector, base: list[Matrix], added: list[Matrix]) -> tuple[float, float]:
        q = _basis(np.hstack([np.ones((len(target), 1)), *base]))
        rest = target - q @ (q.T @ target)
        more = np.hstack(added)
        more = _basis(more - q @ (q.T @ more))
        gained, total = float(np.sum((more.T @ rest) ** 2)), float(rest @ rest)
        freedom = len(target) - q.shape[1] - more.shape[1]
        if not total > 1e-20 * float(target @ target) or not more.shape[1]:
            return 0.0, 1.0
        ratio = gained / more.shape[1] / (max(total - gained, 1e-300) / freedom)
        return gained / total, float(scipy.special.fdtrc(more.shape[1], freedom, ratio))


def _basis(columns: Matrix) -> Matrix:
    """Return an orthonormal basis of columns; those that are nearly sums of others count less."""
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    return u[:, s > 1e-9 * s[0]] if s.size and s[0] > 0 else u[:, :0]


def _lagged(columns: Sequence[Column]) -> _Lags | None:
    """Return the lags of all columns on rows where each is there; None for too few rows."""
    x = np.stack([c.values[:_ROWS] for c in columns], axis=1)
    x = (x - np.nanmean(x, axis=0)) / np.maximum(np.nanstd(x, axis=0), 1e-300)
    count = len(x) - _OWN
    if count < 1:
        return None
    past = [
        np.stack([x[_OWN - lag : len(x) - lag, i] for lag in range(1, _OWN + 1)], axis=1)
        for i in range(x.shape[1])
    ]
    whole = np.isfinite(x[_OWN:]).all(axis=1) & np.isfinite(np.hstack(past)).all(axis=1)
    if whole.sum() < _FEWEST * (_OWN + _OTHERS * len(columns)):
        return None
    own = [one[whole] for one in past]
    return _Lags(x[_OWN:][whole], own, [one[:, :_OTHERS] for one in own])
