"""The share of each direction of the physics that no function of the learner's features follows.

Names show that a term reads what the learner does not see. They do not show a column that was
computed from it, such as the sign of a speed. So the rows are asked: `L = Σ_k r_k r_kᵀ / N` with `r
= (I − M) φ`, the part of φ that is left after the mean M given the features, estimated on rows that
it does not predict. The share of a direction a is `aᵀLa / aᵀGa`, G the same Gram matrix less only
what is linear in the features: that part any learner follows exactly.

What M leaves of *known* functions of the features on the same rows (steps, kinks, products, waves)
is what such a share must exceed: below it, what is left of φa is what a learner leaves of any
function, and says nothing about a.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.parallel import one_blas_thread

_ROWS = 2000  # that are used, spread over the record
_FEWEST = 60  # rows; of fewer no mean given the features is known
# Rows of a block are predicted by those of other folds: neighbours in time are alike
_FOLDS, _BLOCKS = (5, 40)
_WAVES = 60
_STEPS = 15  # of each feature, at its quantiles
_STEEPEST = 30.0  # slope of a wave, in units of 1 / half of the range
_NEIGHBOURS = 3
_RIDGES = (1e-8, 1e-5, 1e-2)  # of the mean square of a function
_MARGIN = 1.5  # times what M leaves of known functions
_LEAST, _MOST = 1e-4, 0.1  # between which that limit is taken
_PROBES = 6  # of each kind
# Of a direction's size: entries below it are left out where the direction stays shared
_SMALL = 0.1
_SEED = 20_261_124


@dataclass(frozen=True, eq=False)
class UnexplainedPhysics:
    """The part of the physics that functions of the learner's features leave on the rows.

    `share` (nθ,) is that of each parameter's own slope, between 0 and 1, and `limit` the share
    below which a direction counts as one that the learner could imitate. `left` and `whole` are
    Gram matrices (nθ, nθ) of the slopes, a row's mean: less what such functions follow, and of all.
    """

    share: Vector
    limit: float
    left: Matrix
    linear: Matrix
    whole: Matrix

    def share_of(self, direction: Vector) -> float:
        """Return the share of a direction that functions of the features leave.

        1 where even a linear function of the features leaves nothing.
        """
        size = float(direction @ self.linear @ direction)
        least = 1e-12 * float(direction @ self.whole @ direction)
        return min(float(direction @ self.left @ direction) / size, 1.0) if size > least else 1.0

    def imitated_directions(self, basis: Matrix) -> Matrix:
        """Return the directions (nθ, s) beyond `basis` that functions of the features imitate.

        Single parameters first, then what remains of the others together.
        """
        nt = len(self.share)
        idle = [not row.any() for row in basis] if basis.size else [True] * nt
        alone = [j for j in range(nt) if idle[j] and self.share[j] <= self.limit]
        found = [np.eye(nt)[j] for j in alone]
        others = [j for j in range(nt) if j not in alone and np.diag(self.linear)[j] > 0]
        for _ in range(len(others)):
            direction = self._smallest(
                np.column_stack([basis, *found]) if found or basis.size else basis, others
            )
            if direction is None:
                break
            found.append(direction)
        return np.column_stack(found) if found else np.zeros((nt, 0))

    def _smallest(self, known: Matrix, others: Sequence[int]) -> Vector | None:
        """Return the direction of least share beside the known ones, if below the limit."""
        root, size = self._unit_coordinates(known)
        if not root.shape[1]:
            return None
        values, vectors = np.linalg.eigh(root.T @ self.left @ root)
        if values[0] > self.limit:
            return None
        direction = root @ vectors[:, 0]
        weight = np.abs(direction) * size
        direction = np.where(weight >= _SMALL * weight.max(), direction, 0.0)
        moved = np.flatnonzero(direction)
        if len(moved) < 2 or not set(moved) <= set(others) or self.share_of(direction) > self.limit:
            return None
        return direction

    def _unit_coordinates(self, known: Matrix) -> tuple[Matrix, Vector]:
        """Return coordinates in which slopes beside known directions have unit size, and sizes.

        And the sizes.
        """
        size = np.sqrt(np.maximum(np.diag(self.linear), 0.0))
        unit = np.where(
            size > 1e-9 * np.sqrt(np.maximum(np.diag(self.whole), 1e-300)),
            1 / np.maximum(size, 1e-300),
            0.0,
        )
        scaled = self.linear * np.outer(unit, unit)
        values, vectors = np.linalg.eigh(scaled)
        kept = values > 1e-8 * max(values.max(initial=0.0), 1e-300)
        white = unit[:, None] * vectors[:, kept] / np.sqrt(values[kept])
        if known.size:
            along = white.T @ self.linear @ known
            u, sigma, _ = np.linalg.svd(along, full_matrices=True)
            rank = int(np.sum(sigma > 1e-8 * max(sigma.max(initial=0.0), 1e-300)))
            white = white @ u[:, rank:]
        return white, size


@one_blas_thread()
def left_over(
    slopes: Float[np.ndarray, "N m nt"],
    features: Float[np.ndarray, "N nz"],
    learned: Bool[np.ndarray, "m"] | None = None,
) -> UnexplainedPhysics | None:
    """Measure what functions of the features leave of each direction.

    None where there are too few rows.

    Args:
        slopes: ∂(equation)/∂θ at the rows, in the order of time.
        features: what the learner sees there.
        learned: which equations have a learner; all of the others' slopes is left.
    """
    kept = np.isfinite(slopes).all(axis=(1, 2)) & np.isfinite(features).all(axis=1)
    every = max(1, -(-int(kept.sum()) // _ROWS))
    slopes, z = slopes[kept][::every], features[kept][::every]
    if len(z) < _FEWEST or not z.shape[1]:
        return None
    learned = np.ones(slopes.shape[1], dtype=bool) if learned is None else learned
    size = np.sqrt(np.mean(slopes**2, axis=(0, 2), keepdims=True))
    slopes = slopes / np.where(size > 0, size, 1.0)
    n, m, nt = slopes.shape
    smoother = _Smoother.of(z)
    flat = slopes[:, learned].reshape(n, -1)
    probes = smoother.beyond_linear(smoother.probes())
    linear = smoother.beyond_linear(flat)
    rest = smoother.left(np.concatenate([linear, probes], axis=1), probes.shape[1])
    fixed = slopes[:, ~learned].reshape(n, -1)

    def gram(learned_part: Matrix) -> Matrix:
        parts = [
            *np.moveaxis(learned_part.reshape(n, -1, nt), 1, 0),
            *np.moveaxis(fixed.reshape(n, -1, nt), 1, 0),
        ]
        return np.asarray(sum(part.T @ part for part in parts)) / n

    whole, among, left = gram(flat), gram(linear), gram(rest[:, : flat.shape[1]])
    own = np.diag(among)
    share = np.where(own > 1e-12 * np.diag(whole), np.diag(left) / np.maximum(own, 1e-300), 1.0)
    known = np.mean(rest[:, flat.shape[1] :] ** 2, axis=0) / np.maximum(
        np.mean(probes**2, axis=0), 1e-300
    )
    limit = float(np.clip(_MARGIN * np.quantile(known, 0.9), _LEAST, _MOST))
    return UnexplainedPhysics(np.clip(share, 0.0, 1.0), limit, left, among, whole)


@dataclass(frozen=True, eq=False)
class _Smoother:
    """The mean given features, estimated on other stretches of the record."""

    z: Matrix
    """Of range [-1, 1]."""
    functions: Matrix
    fold: Any

    @classmethod
    def of(cls, z: Matrix) -> _Smoother:
        low, high = np.quantile(z, [0.005, 0.995], axis=0)
        half = np.where(high > low, (high - low) / 2, 1.0)
        n, scaled = len(z), (z - (low + high) / 2) / half
        rng = np.random.default_rng(_SEED)
        slopes = rng.normal(size=(_WAVES, z.shape[1]))
        slopes *= (
            np.exp(rng.uniform(0, np.log(_STEEPEST), (_WAVES, 1)))
            / np.linalg.norm(slopes, axis=1)[:, None]
        )
        centres = scaled[rng.integers(n, size=_WAVES)]
        parts = [np.tanh(scaled @ slopes.T - np.sum(slopes * centres, axis=1))]
        nz = z.shape[1]
        for j in range(nz):
            at = np.quantile(z[:, j], np.linspace(0, 1, _STEPS + 2)[1:-1])
            # Most jumps of physics are at zero
            steps = (z[:, j, None] > np.append(at, 0.0)).astype(float)
            parts += [steps, scaled[:, j, None] ** np.arange(2, 5), np.abs(z[:, j, None])]
            parts += [scaled[:, [j]] * scaled[:, [i]] for i in range(j)]
        fold = (np.arange(n) * min(_BLOCKS, n) // n) % _FOLDS
        return cls(scaled, np.concatenate(parts, axis=1), fold)

    def beyond_linear(self, values: Matrix) -> Matrix:
        """Return the residuals of columns after a linear fit of the features and a constant."""
        plain = np.column_stack([np.ones(len(self.z)), self.z])
        q, sigma, _ = np.linalg.svd(plain, full_matrices=False)
        q = q[:, sigma > 1e-12 * sigma[0]]
        rest = values - q @ (q.T @ values)
        rest = rest - q @ (q.T @ rest)
        return np.where(
            np.linalg.norm(rest, axis=0) > 1e-9 * np.linalg.norm(values, axis=0), rest, 0.0
        )

    def probes(self) -> Matrix:
        """Return typical functions of the features: steps, kinks, waves.

        A learner follows these as well as any other function.
        """
        rng = np.random.default_rng(_SEED + 1)
        n, nz = self.z.shape
        found = []
        for _ in range(_PROBES):
            along = self.z[:, rng.integers(nz)]
            level = np.quantile(along, rng.uniform(0.25, 0.75))
            found += [np.sign(along - level), np.abs(along - level), np.sin(3 * (along - level))]
            other = self.z[:, rng.integers(nz)]
            found.append((along - level) * other)
        return np.column_stack(found)

    def left(self, values: Matrix, probes: int) -> Matrix:
        """Return the residuals of columns that are predicted from other stretches.

        The last ones are probes.
        """
        best, least = values, np.inf
        for ridge in _RIDGES:
            rest = self._by_functions(values, ridge)
            for tried in (rest, self._by_neighbours(rest)):
                known = np.mean(tried[:, -probes:] ** 2) / max(
                    np.mean(values[:, -probes:] ** 2), 1e-300
                )
                if known < least:
                    best, least = tried, known
        return best

    def _by_functions(self, values: Matrix, ridge: float) -> Matrix:
        """Return predictions by least squares on many functions of the features."""
        rest = np.empty_like(values)
        low, high = values.min(axis=0), values.max(axis=0)
        for fold, (there, own, gram) in enumerate(self._regressions):
            here = self.fold == fold
            damped = gram + ridge * len(there) * np.eye(len(gram))
            weights = np.linalg.solve(damped, there.T @ values[~here])
            rest[here] = values[here] - np.clip(own @ weights, low, high)
        return rest

    @cached_property
    def _regressions(self) -> list[tuple[Matrix, Matrix, Matrix]]:
        """Functions on other stretches and on that of each fold; Gram matrix of the former."""
        plain = np.column_stack([np.ones(len(self.z)), self.z, self.functions])
        plain = plain / np.maximum(np.sqrt(np.mean(plain**2, axis=0)), 1e-300)
        parts = [(plain[self.fold != fold], plain[self.fold == fold]) for fold in range(_FOLDS)]
        return [(there, own, there.T @ there) for there, own in parts]

    def _by_neighbours(self, rest: Matrix) -> Matrix:
        """Return predictions by the mean of the nearest rows of other stretches.

        The error of that mean itself is taken out.
        """
        found = np.empty_like(rest)
        for fold, nearest in enumerate(self._nearest):
            here = self.fold == fold
            found[here] = rest[here] - rest[~here][nearest].mean(axis=1)
        return found / np.sqrt(1 + 1 / _NEIGHBOURS)

    @cached_property
    def _nearest(self) -> list[Any]:
        """The nearest rows (r, n) of other stretches for those of each fold, among the former."""
        from scipy.spatial import KDTree  # slow to import, and few fits need it

        folds = [self.fold == fold for fold in range(_FOLDS)]
        return [KDTree(self.z[~here]).query(self.z[here], k=_NEIGHBOURS)[1] for here in folds]
