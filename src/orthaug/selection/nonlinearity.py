"""Test for a missing nonlinearity before a learner is trained, on the residual of linear lags.

Squares, cubes and sizes of each regressor, less what physics and linear lags express of them, are
multiplied by what these leave of the output. Their sums over blocks of rows change sign at random
if nothing is missing, so the statistic is compared with itself under random signs, a wild bootstrap
by blocks (Liu 1988, Shao 2010): its level does not rest on white or normal errors. A block is three
times as long as the products remember each other, and a twentieth of the rows at least. What
physics and linear lags leave of a block is too small, for the block has helped to fit them: it is
divided by what it did not use, `(I − H_bb)⁻¹e_b` with H their projector (Bell and McCaffrey 2002),
as HC3 does for a row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.columns import span
from orthaug.data.terms import TermLibrary
from orthaug.fitting.colour import correlation_length
from orthaug.fitting.criteria import Prediction
from orthaug.physics.problem import Problem
from orthaug.selection.forward import DEPENDENT
from orthaug.selection.term_runs import TermRuns

LEVEL = 0.05
# At most: 40 blocks of 1000 rows reject 7 to 13 % under a held input,
# `benchmarks/coverage_noise.py`
_BLOCKS = 20
_FEWEST_BLOCKS = 8  # whose signs can make 256 sums
_MEMORIES = 3  # times as long a block as the products remember each other
_FEWEST_ROWS = 160
_DRAWS = 1999
_RANK = 1e-7  # of the largest singular value of columns of size 1
_SEED = 20_261_123


@dataclass(frozen=True)
class Nonlinearity:
    """Test that functions of regressors explain the residual of linear lags; `p` is its p-value.

    `regressors` are the p-values of the functions of each regressor alone, multiplied by their
    number (Bonferroni).
    """

    p: float
    regressors: dict[str, float]

    @property
    def found(self) -> bool:
        """True if a nonlinear term is missing, at the level of 5 %."""
        return self.p < LEVEL

    @property
    def matter(self) -> tuple[str, ...]:
        """The regressors whose functions matter by themselves."""
        return tuple(name for name, p in self.regressors.items() if p < LEVEL)

    def __str__(self) -> str:
        if not self.found:
            return (
                "the data show nothing nonlinear beside physics and linear lags (p = "
                f"{self.p:.2g})."
            )
        named = ", ".join(self.matter)
        where = f" in {named}" if named else "; no single regressor shows it"
        return f"something nonlinear is missing (p = {self.p:.2g}){where}."


def nonlinearity(problem: Problem, lags: Sequence[str], draws: int = _DRAWS) -> Nonlinearity | None:
    """Test the physics with linear `lags` on its rows; None where the rows are too few.

    Args:
        draws: of random signs.
    """
    squares = [f"{lag}**{power}" for lag in lags for power in (2, 3)] + [
        f"abs({lag})" for lag in lags
    ]
    library = TermLibrary.of((), 0, (), [*lags, *squares])
    runs = TermRuns.of(problem, library, Prediction())
    known, functions, target = _rows(runs, len(lags))
    q = span(np.column_stack([known, np.ones(len(known))]), _RANK)
    error = target - q @ (q.T @ target)
    if len(error) < _FEWEST_ROWS:
        return None
    size = np.linalg.norm(functions, axis=0)
    functions = functions / np.where(size > 0, size, 1.0)
    functions = functions - q @ (q.T @ functions)
    own = np.flatnonzero(
        np.isfinite(functions).all(axis=0) & (np.sum(functions**2, axis=0) > DEPENDENT)
    )
    if not len(own):
        return None
    count = _blocks(span(functions[:, own], _RANK) * error[:, None])
    if count < _FEWEST_BLOCKS:
        return None
    blocks = np.linspace(0, len(error), count + 1).astype(int)[:-1]
    signs = np.random.default_rng(_SEED).choice([-1.0, 1.0], size=(draws, count))
    unused = _without_own_block(error, q, blocks)

    def p_value(columns: np.ndarray) -> float:
        basis = span(functions[:, columns], _RANK)
        sums = np.add.reduceat(basis * unused[:, None], blocks, axis=0)
        statistic = float(np.sum((basis.T @ error) ** 2))
        return float((1 + np.sum(np.sum((signs @ sums) ** 2, axis=1) >= statistic)) / (1 + draws))

    names = {i: lags[i // 2] for i in range(2 * len(lags))} | {
        2 * len(lags) + i: lag for i, lag in enumerate(lags)
    }
    single = {lag: np.array([i for i in own if names[int(i)] == lag], dtype=int) for lag in lags}
    single = {lag: columns for lag, columns in single.items() if len(columns)}
    return Nonlinearity(
        p_value(own), {lag: min(1.0, p_value(c) * len(single)) for lag, c in single.items()}
    )


def _blocks(products: Matrix) -> int:
    """Return the number of blocks that hardly depend on each other; 0 where memory is too long."""
    lengths = [correlation_length(column[None]) for column in products.T]
    if any(length is None for length in lengths):
        return 0
    longest = max((length for length in lengths if length is not None), default=1)
    return min(_BLOCKS, len(products) // (_MEMORIES * longest))


def _without_own_block(error: Vector, q: Matrix, blocks: Vector) -> Vector:
    """Return each block's residual for a fit without it, `(I − q_b q_bᵀ)⁻¹e_b` (Woodbury)."""
    parts = []
    for e, own in zip(np.split(error, blocks[1:]), np.split(q, blocks[1:]), strict=True):
        values, vectors = np.linalg.eigh(np.eye(q.shape[1]) - own.T @ own)
        along = own @ vectors
        parts.append(e + along @ (along.T @ e / np.maximum(values, np.sqrt(np.finfo(float).eps))))
    return np.concatenate(parts)


def _rows(runs: TermRuns, linear: int) -> tuple[Matrix, Matrix, Vector]:
    """Return physics and linear lags, their functions, and the output less the fixed terms."""
    known, functions, targets = [], [], []
    for experiment in runs.problem.record.experiments:
        (phi, target), terms = runs.physics(*runs.rows(experiment)), runs.factors(experiment).T
        known.append(np.column_stack([phi, terms[:, :linear]]))
        functions.append(terms[:, linear:])
        targets.append(target)
    return np.concatenate(known), np.concatenate(functions), np.concatenate(targets)
