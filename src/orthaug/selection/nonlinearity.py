"""Is anything nonlinear missing, before a learner is trained? A test of what linear lags leave one step ahead.

Squares, cubes and sizes of each regressor, less what physics and linear lags express of them, are multiplied by what
these leave of the output. Their sums over blocks of rows change sign at random if nothing is missing, so the statistic
is compared with itself under random signs: its level does not rest on white or normal errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug.data.terms import TermLibrary
from orthaug.fitting.criteria import Prediction
from orthaug.physics.problem import Problem
from orthaug.selection.forward import DEPENDENT
from orthaug.selection.term_runs import TermRuns

LEVEL = 0.05
_BLOCKS = 40
_DRAWS = 1999
_SEED = 20_261_123


@dataclass(frozen=True)
class Nonlinearity:
    """Whether functions of the regressors explain what linear lags leave; `p` is the p-value.

    `regressors` are the p-values of the functions of each regressor alone, multiplied by their number (Bonferroni).
    """

    p: float
    regressors: dict[str, float]

    @property
    def found(self) -> bool:
        """Whether something nonlinear is missing, at the level of 5 %."""
        return self.p < LEVEL

    @property
    def matter(self) -> tuple[str, ...]:
        """The regressors whose functions matter by themselves."""
        return tuple(name for name, p in self.regressors.items() if p < LEVEL)

    def __str__(self) -> str:
        if not self.found:
            return f"nothing nonlinear is missing beside physics and linear lags, as far as is seen (p = {self.p:.2g})."
        named = ", ".join(self.matter)
        where = f" in {named}" if named else "; no single regressor shows it"
        return f"something nonlinear is missing (p = {self.p:.2g}){where}."


def nonlinearity(problem: Problem, lags: Sequence[str], draws: int = _DRAWS) -> Nonlinearity | None:
    """Test the physics with linear `lags` on its rows; None where the rows are too few.

    Args:
        draws: of random signs.
    """
    squares = [f"{lag}**{power}" for lag in lags for power in (2, 3)] + [f"abs({lag})" for lag in lags]
    library = TermLibrary.of((), 0, (), [*lags, *squares])
    runs = TermRuns.of(problem, library, Prediction())
    known, functions, target = _rows(runs, len(lags))
    q = _basis(np.column_stack([known, np.ones(len(known))]))
    error = target - q @ (q.T @ target)
    if len(error) < 4 * _BLOCKS:
        return None
    size = np.linalg.norm(functions, axis=0)
    functions = functions / np.where(size > 0, size, 1.0)
    functions = functions - q @ (q.T @ functions)
    own = np.flatnonzero(np.isfinite(functions).all(axis=0) & (np.sum(functions**2, axis=0) > DEPENDENT))
    blocks = np.linspace(0, len(error), _BLOCKS + 1).astype(int)[:-1]
    signs = np.random.default_rng(_SEED).choice([-1.0, 1.0], size=(draws, _BLOCKS))

    def p_value(columns: np.ndarray) -> float:
        basis = _basis(functions[:, columns])
        sums = np.add.reduceat(basis * error[:, None], blocks, axis=0)
        statistic = float(np.sum(sums.sum(axis=0) ** 2))
        return float((1 + np.sum(np.sum((signs @ sums) ** 2, axis=1) >= statistic)) / (1 + draws))

    if not len(own):
        return None
    names = {i: lags[i // 2] for i in range(2 * len(lags))} | {2 * len(lags) + i: lag for i, lag in enumerate(lags)}
    single = {lag: np.array([i for i in own if names[int(i)] == lag], dtype=int) for lag in lags}
    single = {lag: columns for lag, columns in single.items() if len(columns)}
    return Nonlinearity(p_value(own), {lag: min(1.0, p_value(c) * len(single)) for lag, c in single.items()})


def _rows(runs: TermRuns, linear: int) -> tuple[Matrix, Matrix, Vector]:
    """Physics and linear lags, their functions, and what the fixed terms leave of the output."""
    known, functions, targets = [], [], []
    for experiment in runs.problem.record.experiments:
        (phi, target), terms = runs.physics(*runs.rows(experiment)), runs.factors(experiment).T
        known.append(np.column_stack([phi, terms[:, :linear]]))
        functions.append(terms[:, linear:])
        targets.append(target)
    return np.concatenate(known), np.concatenate(functions), np.concatenate(targets)


def _basis(columns: Float[np.ndarray, "N k"]) -> Float[np.ndarray, "N r"]:
    size = np.linalg.norm(columns, axis=0)
    u, sigma, _ = np.linalg.svd(columns / np.where(size > 0, size, 1.0), full_matrices=False)
    return u[:, sigma > 1e-7 * sigma.max(initial=0.0)]
