"""Chosen terms that are more than noise: control of the rate of false discoveries.

Of the t-values of m candidates the largest is large although none of them acts. So a term of a
model of i terms stays only where its p-value is at most `q i / (m + 1 − i (1 − q))`, the
multiple-stage rule of Benjamini and Gavrilov (2009) that keeps the expected share of spurious terms
among the chosen ones near q. Terms go one by one, the least sure first, and the others are fitted
anew. On rows that had no say in the choice the usual p-values hold, and the q-values of Benjamini
and Hochberg (1995) beside them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.special

from orthaug._base.checks import Vector
from orthaug.selection.kept_physics import standard_errors
from orthaug.selection.term_runs import Point, TermRuns

LEVEL = 0.05


@dataclass(frozen=True)
class Control:
    """The allowed rate of false discoveries, and the number of candidates of the choice."""

    level: float
    candidates: int

    def largest_p(self, size: int) -> float:
        """Return the largest p-value of a term of a model of so many terms."""
        return self.level * size / (self.candidates + 1 - size * (1 - self.level))

    def rates(self, p: Vector) -> Vector:
        """Return the least level at which the rule keeps each term of a model."""
        size = len(p)
        with np.errstate(divide="ignore"):
            return np.minimum(
                p * (self.candidates + 1 - size) / (size * np.maximum(1 - p, 0.0)), 1.0
            )


def p_values(runs: TermRuns, point: Point) -> Vector:
    """Return the p-value of each chosen term beside physics and the others.

    1 where the rows do not determine it.
    """
    nt = len(point.c)
    own = runs.equations(point, ()).of([*range(nt), *(nt + i for i in point.chosen)])
    stds, freedom = standard_errors(runs, point, own)
    std = np.array([np.nan if one is None else one for one in stds[nt:]], dtype=float)
    with np.errstate(all="ignore"):
        p = 2 * scipy.special.stdtr(freedom, -np.abs(point.w / std))
    return np.where(np.isfinite(p), p, 1.0)


def false_discovery_rates(p: Vector) -> Vector:
    """Return the q-values of Benjamini and Hochberg (1995)."""
    from scipy.stats import false_discovery_control  # slow to load

    return false_discovery_control(p) if len(p) else np.zeros(0)
