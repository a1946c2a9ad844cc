"""Errors of θ̂ as an estimate for experiments of a kind, and not for the applied inputs alone.

An interval of a fit holds for the inputs that were applied. Where the physics misses a term, θ̂ is
the truth and what the measure makes of the term (`Φ⁺Δ`), which other inputs change. Where there are
several experiments of one kind, their own differences show by how much. Leaving experiment e out
changes θ̂ by `d_e`, and the jackknife over experiments, `(E − 1)/E Σ_e d_e d_eᵀ`, estimates the
covariance of θ̂ over such experiments. To first order it is the cluster-robust covariance of Liang
and Zeger (Biometrika 1986) with an experiment as a cluster; as a jackknife it counts the leverage
of an experiment too (Bell and McCaffrey 2002). It has E − 1 degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.special
from jaxtyping import Float, Int

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import Warning
from orthaug._base.lines import first_words
from orthaug.inference.covariance import interval
from orthaug.physics.projection import Projection

FEWEST = 3  # experiments: with two, an interval is 12.7 standard errors long on either side
# Of the part of Φ that one experiment alone has: what the others determine must be more than this
_DETERMINED = 1e-8
_LEVEL = 0.01  # at which the experiments differ more than the intervals allow, of all θ together
_LISTED = 4  # parameters in a sentence
_CLEARLY = 1.5  # times as large: what is less is no news to anybody who reads the interval


@dataclass(frozen=True, eq=False)
class OverExperiments:
    """Standard errors and 95 % intervals of θ̂ for experiments like those that were fitted.

    `std` (nθ,) and `interval` (nθ, 2) are NaN where θ has none. `ratio` (nθ,) is the standard error
    over that of the fit, which holds for the applied inputs.
    """

    experiments: int
    covariance: Matrix
    """Cov θ̂ (nθ, nθ); of a motion that of the coordinates of p̂."""
    std: Vector
    interval: Matrix
    ratio: Vector
    fit_freedom: float
    """Degrees of freedom of the fit's own standard errors."""

    @property
    def freedom(self) -> float:
        """Degrees of freedom of the interval: experiments less one."""
        return self.experiments - 1.0

    @property
    def larger(self) -> tuple[int, ...]:
        """Entries of θ that differ between experiments by clearly more than the fit's interval.

        An F-test at 1 % for all entries together (Bonferroni), of 1.5 times at least.
        """
        level = _LEVEL / max(int(np.isfinite(self.ratio).sum()), 1)
        limit = scipy.special.fdtri(self.freedom, max(self.fit_freedom, 1.0), 1 - level)
        least = max(float(np.sqrt(limit)), _CLEARLY)
        return tuple(int(i) for i in np.flatnonzero(np.nan_to_num(self.ratio) > least))


def differing_warning(
    found: OverExperiments, names: Sequence[str], values: Vector
) -> Warning | None:
    """Return the warning that parameters differ between experiments; None where none does."""
    if not found.larger:
        return None
    worst = sorted(found.larger, key=lambda i: -found.ratio[i])
    listed = [f"{names[j]} by {found.ratio[j]:.2g} times its standard error" for j in worst]
    i = worst[0]
    low, high = found.interval[i]
    text = (
        f"parameters differ between the {found.experiments} experiments by more than `ci95` "
        f"allows: {first_words(listed, _LISTED)}. `ci95` holds for the inputs "
        "that were applied; other inputs move the bias by what the physics lacks. For experiments "
        f"like these {names[i]} is {values[i]:.6g}, and between {low:.6g} and {high:.6g}."
    )
    return Warning("differs_between_experiments", text)


def over_experiments(
    changes: Float[np.ndarray, "E nt"],
    covariance: Matrix,
    fit_freedom: float,
    theta: Vector,
    slopes: Vector | None = None,
) -> OverExperiments:
    """Return the errors over experiments from the changes of θ̂ without each of them.

    Args:
        covariance: Cov θ̂ of the fit (nθ, nθ), NaN where θ has none.
        fit_freedom: its degrees of freedom.
        theta: θ̂ (nθ,).
        slopes: dp/dθ of each entry (nθ,), where `std` is to be that of p; None for 1.
    """
    experiments = len(changes)
    found = (experiments - 1) / experiments * changes.T @ changes
    found = np.where(np.isfinite(covariance), found, np.nan)
    own = np.sqrt(np.diag(found))
    with np.errstate(all="ignore"):
        ratio = own / np.sqrt(np.diag(covariance))
    std = own if slopes is None else own * np.abs(slopes)
    limits = interval(theta, own, experiments - 1.0)
    return OverExperiments(experiments, found, std, limits, ratio, fit_freedom)


def split_without_each(
    projection: Projection,
    directions: Float[np.ndarray, "nt s"] | None,
    values: Float[np.ndarray, "N ny"],
    owner: Int[np.ndarray, "N"],
    experiments: int,
) -> Float[np.ndarray, "E nt"] | None:
    """Return the changes of `B(ΦB)⁺v` where the rows of each experiment are left out.

    None where the others do not determine it.

    Args:
        projection: of the weighted rows Φ.
        directions: B; None for all.
        values: v, weighted as Φ is; what B(ΦB)⁺v is already may be left out of them.
        owner: the number of the experiment of each row.
    """
    rows, ny, nt = projection.q.shape
    directions = np.eye(nt) if directions is None else projection.without_null(directions)
    if not directions.shape[1]:
        return np.zeros((experiments, nt))
    basis, r = np.linalg.qr(projection.to_coordinates @ directions)
    along = projection.q.reshape(rows * ny, nt) @ basis  # orthonormal columns
    rest = values - projection.phi @ projection.solve_along(values, directions)
    flat, of = rest.reshape(rows * ny), np.repeat(owner, ny)
    changes = np.zeros((experiments, nt))
    for e in range(experiments):
        own = along[of == e]
        left = np.eye(own.shape[1]) - own.T @ own
        if np.linalg.eigvalsh(left)[0] < _DETERMINED:
            return None
        moved = np.linalg.solve(left, own.T @ flat[of == e])
        changes[e] = -directions @ np.linalg.solve(r, moved)
    return changes
