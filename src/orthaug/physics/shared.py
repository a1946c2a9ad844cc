"""The directions of θ that the learner could imitate.

Only along these the learner has to be made orthogonal to the physics.

A direction a of θ is shared if φ(x)a is a function of the learner's features z(x) alone. A change
of θ along it can be undone by the learner, so there θ is arbitrary until it is split off. Every
other direction is determined by the fit itself, as in a partially linear regression. A learner that
sees all lags shares everything: that is the paper.

Found by moves: pairs of regressors x, x′ with z(x) = z(x′) that differ otherwise. A direction is
shared where φ(x)a and φ(x′)a agree on all of them. Finite moves, not derivatives, so that a jump
such as sign(v) counts too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.columns import span
from orthaug.data.expressions import Lag
from orthaug.data.regressors import Features, Layout
from orthaug.physics.baseline import Baseline
from orthaug.physics.left_over import UnexplainedPhysics, left_over

_MOVES = 400
_FEWEST = 4  # moves that succeed, for each parameter
_TOLERANCE = 1e-6  # change of φa over a move, against the size of φa
_NEWTON = 30
_ROUNDING = 1e-12  # of the largest singular value of features of unit size
_SEED = 20_240_808
NEARLY = 0.5
"""Share of a regressor below which what the learner's features leave of it is reported."""
LITTLE = 0.01
"""Of all squares of a regressor: below it, what the learner does not see decides its value."""


@dataclass(frozen=True, eq=False)
class SharedDirections:
    """The shared directions of θ.

    `basis` (nθ, s) spans them, in reduced form: each column has an entry of one that is zero in all
    others.
    """

    names: tuple[str, ...]
    basis: Matrix
    on_data: tuple[str, ...] = ()
    """Parameters that only the rows show to be shared: their regressors read what the learner does
    not see.
    """
    rest: UnexplainedPhysics | None = None
    """What functions of the features leave of the physics on the rows; None where that was not
    asked.
    """

    @property
    def nearly(self) -> dict[str, float]:
        """Parameters that the learner could nearly imitate, with the share that is left.

        The features leave little of them on the rows, but more than nothing.
        """
        if self.rest is None:
            return {}
        shares = zip(self.names, self.basis, self.rest.share, strict=True)
        return {
            name: float(share) for name, row, share in shares if not row.any() and share < NEARLY
        }

    @property
    def little(self) -> dict[str, float]:
        """Parameters that rest on little of their regressors, with its share of the squares.

        What is linear in the features counts as followed by the learner here: exact as that is,
        the value then is the effect of the signals that only this remainder holds. A parameter of
        a controller alone, which no equation of the plant reads, has no such regressor.
        """
        if self.rest is None:
            return {}
        left, whole = np.diag(self.rest.left), np.diag(self.rest.whole)
        share = np.where(whole > 0, left / np.maximum(whole, 1e-300), 1.0)
        shares = zip(self.names, self.basis, share, strict=True)
        return {
            name: float(share)
            for name, row, share in shares
            if not row.any() and share < LITTLE and name not in self.nearly
        }

    def beside(self, rest: UnexplainedPhysics | None) -> SharedDirections:
        """Return these directions and those that the rows do not separate from the features."""
        if rest is None:
            return self
        more = rest.imitated_directions(self.basis)
        if not more.shape[1]:
            return replace(self, rest=rest)
        moved = [
            name
            for name, row, own in zip(self.names, more, self.basis, strict=True)
            if row.any() and not own.any()
        ]
        size = np.sqrt(np.maximum(np.diag(rest.whole), 1e-300))[:, None]
        basis = _reduce(np.column_stack([self.basis, more]) * size, 1 / size[:, 0]) / size
        return SharedDirections(self.names, basis, tuple(moved), rest)

    @property
    def all(self) -> bool:
        """True where the learner could imitate all of the physics."""
        return self.basis.shape[1] == len(self.names)

    @property
    def untouched(self) -> tuple[str, ...]:
        """Parameters that no shared direction moves: the fit determines them with any learner."""
        return tuple(
            name for name, row in zip(self.names, self.basis, strict=True) if not row.any()
        )

    @property
    def directions(self) -> tuple[dict[str, float], ...]:
        """Each direction as weights of the parameters that it moves, the first one being 1."""
        described = []
        for column in self.basis.T:
            first = column[np.flatnonzero(column)[0]]
            described.append(
                {
                    name: float(f"{a / first:.12g}")
                    for name, a in zip(self.names, column, strict=True)
                    if a
                }
            )
        return tuple(described)

    def without_entries(self, held: Iterable[int]) -> SharedDirections:
        """Return the shared directions that leave some entries of θ unchanged.

        In reduced form too.
        """
        basis = self.basis
        for i in held:
            if not basis[i].any():
                continue
            j = int(np.argmax(np.abs(basis[i])))
            moved = np.outer(basis[:, j], basis[i] / basis[i, j])
            left = basis - moved
            left[np.abs(left) <= _ROUNDING * np.maximum(np.abs(basis), np.abs(moved))] = 0.0
            basis = np.delete(left, j, axis=1)
        return replace(self, basis=basis)


def shared_directions(
    baseline: Baseline,
    features: Features,
    layout: Layout,
    outputs: Sequence[str],
    x: Float[np.ndarray, "N nx"],
) -> SharedDirections:
    """Return the directions of θ that a learner on these features could imitate.

    Args:
        x: measured regressors, where the moves begin.
    """
    names, everything = (
        baseline.names,
        SharedDirections(baseline.names, np.eye(len(baseline.names))),
    )
    if features.linear and names:
        with np.errstate(all="ignore"):
            phi = np.asarray(baseline.phi(x, layout, tuple(outputs), np))
            z = np.asarray(features.evaluate(x, layout, np))
        return spanned_directions(names, np.moveaxis(phi, 1, 0), z)
    read = set(baseline.lags) if baseline.function is None else set(layout)
    if not names or not features.entries or _sees(features, read):
        return everything
    start, end = moves(_values(features, layout), x)
    with np.errstate(all="ignore"):
        phi = [np.asarray(baseline.phi(rows, layout, tuple(outputs), np)) for rows in (start, end)]
    kept = np.isfinite(phi[0]).all(axis=(1, 2)) & np.isfinite(phi[1]).all(axis=(1, 2))
    if np.sum(kept) < _FEWEST * len(
        names
    ):  # nothing is known: the paper's projection is right for any learner
        return everything
    before, after = (part[kept].reshape(-1, len(names)) for part in phi)
    with np.errstate(all="ignore"):
        own = np.asarray(baseline.phi(x, layout, tuple(outputs), np))
        return SharedDirections(names, agreeing_directions(before, after)).beside(
            left_over(own, _values(features, layout)(x))
        )


def spanned_directions(
    names: tuple[str, ...],
    slopes: Float[np.ndarray, "k N nt"],
    features: Float[np.ndarray, "N nz"],
    learned: Any = True,
) -> SharedDirections:
    """Return the directions along which all slopes are linear combinations of features.

    Args:
        learned: which slopes have a learner; the others must not move at all.
    """
    kept = np.isfinite(slopes).all(axis=(0, 2)) & np.isfinite(features).all(axis=1)
    slopes, q = slopes[:, kept], span(features[kept], _ROUNDING)
    left = slopes - np.where(np.reshape(learned, (-1, 1, 1)), q @ (q.T @ slopes), 0.0)
    size = np.sqrt(np.mean(slopes**2, axis=(1, 2), keepdims=True))
    slopes, left = (part / np.where(size > 0, size, 1.0) for part in (slopes, left))
    flat, changed = (part.reshape(-1, len(names)) for part in (slopes, slopes + left))
    return SharedDirections(names, agreeing_directions(flat, changed))


def seen_columns(
    features: Features,
    layout: Layout,
    x: Float[np.ndarray, "N nx"],
    values: Callable[[Float[np.ndarray, "M nx"]], Float[np.ndarray, "M k"]],
) -> Bool[np.ndarray, "k"]:
    """Return a mask of the columns of `values` that are functions of the learner's inputs.

    A change that the learner does not see leaves such a column unchanged.

    Args:
        x: measured regressors, where the moves begin.
        values: of rows of the regressor, a column for each function in question.
    """
    if features.linear:
        return _are_combinations(values(x), _values(features, layout)(x))
    if _sees(features, layout):
        return np.ones(values(x[:1]).shape[1], dtype=bool)
    start, end = moves(_values(features, layout), x)
    with np.errstate(all="ignore"):
        pairs = np.stack([values(start), values(end)])
        there = np.isfinite(pairs).all(axis=0)
        pairs = np.where(there, pairs, 0.0)
        size = np.sqrt(np.mean(pairs**2, axis=(0, 1)))
    still = np.abs(pairs[1] - pairs[0]).max(axis=0, initial=0.0) <= _TOLERANCE * size
    return still & (np.sum(there, axis=0) >= _FEWEST)


def _are_combinations(
    values: Float[np.ndarray, "N k"], features: Float[np.ndarray, "N nz"]
) -> Bool[np.ndarray, "k"]:
    """Return a mask of the columns that are linear combinations of features at the same points."""
    kept = np.isfinite(values).all(axis=1) & np.isfinite(features).all(axis=1)
    values, q = values[kept], span(features[kept], _ROUNDING)
    left = np.linalg.norm(values - q @ (q.T @ values), axis=0)
    return left <= _TOLERANCE * np.linalg.norm(values, axis=0)


def _sees(features: Features, lags: Iterable[Lag]) -> bool:
    """Return whether all of these lags are themselves features."""
    return {str(lag) for lag in lags} <= {str(entry) for entry in features.entries}


def agreeing_directions(before: Matrix, after: Matrix) -> Matrix:
    """Return the directions a with `before a = after a`, relative to `before a`, reduced."""
    if not before.size:  # of no points at all, as of a run that diverged
        return np.zeros((before.shape[1], 0))
    scale = np.sqrt(np.mean(before**2 + after**2, axis=0))
    unit = 1 / np.where(scale > 0, scale, 1.0)
    r = np.linalg.qr(np.concatenate([before, after]) * unit, mode="r")
    _, sigma, vt = np.linalg.svd(r)
    seen = sigma > 1e-13 * sigma[0]  # what Φ does not see has no size to compare with
    root = vt[seen].T / sigma[seen]
    _, change, directions = np.linalg.svd((after - before) * unit @ root, full_matrices=False)
    agreeing = root @ directions[change <= _TOLERANCE].T
    return unit[:, None] * _reduce(agreeing, unit)


def _reduce(basis: Matrix, unit: Vector) -> Matrix:
    """Return a basis of the same span in reduced column echelon form.

    In θ's own units times `1/unit`.
    """
    if not basis.size:
        return basis
    q = np.linalg.qr(basis)[0]
    order = scipy.linalg.qr(q.T, mode="r", pivoting=True)[-1]
    pivots = np.sort(order[: q.shape[1]])
    reduced = np.linalg.solve(q[pivots].T, q.T).T
    reduced[np.abs(reduced) < 1e-9] = 0.0
    reduced[pivots] = np.eye(len(pivots))
    return reduced / unit[pivots]


def _values(features: Features, layout: Layout) -> Callable[[Matrix], Matrix]:
    return lambda rows: np.asarray(features.evaluate(rows, layout, np))


def moves(
    seen: Callable[[Matrix], Matrix], x: Float[np.ndarray, "N nx"]
) -> tuple[Float[np.ndarray, "M nx"], Float[np.ndarray, "M nx"]]:
    """Return pairs of points with equal features, as far apart as the data spread.

    A step towards another row, or in any direction, is led back to the features' values by Newton's
    method; every other one along the null space of ∂z/∂x first. The free ones find other branches:
    −u beside u where the learner sees u².

    Args:
        seen: the features (M, nz) of points (M, nx).
        x: where the moves begin.
    """
    rng = np.random.default_rng(_SEED)
    spread = np.where(x.std(axis=0) > 0, x.std(axis=0), np.maximum(np.abs(x).max(axis=0), 1.0))
    start = x[rng.integers(len(x), size=_MOVES)]
    other = x[rng.integers(len(x), size=_MOVES)]
    drawn = rng.normal(size=start.shape) * spread
    step = np.where(rng.uniform(size=(_MOVES, 1)) < 0.5, other - start, drawn)

    def values(rows: Matrix) -> Matrix:
        with np.errstate(all="ignore"):
            return seen(rows)

    def slopes(rows: Matrix) -> Float[np.ndarray, "M nz nx"]:
        columns = []
        for j in range(rows.shape[1]):
            small = np.zeros(rows.shape[1])
            small[j] = 1e-6 * spread[j]
            columns.append(
                (values(rows + small) - values(rows - small)) / 2e-6
            )  # in units of the spread
        return np.nan_to_num(np.stack(columns, axis=-1))

    target, size = values(start), np.maximum(np.nanstd(values(x), axis=0), 1e-300)
    slope = slopes(start) / size[:, None]
    inverse = np.linalg.pinv(slope, rcond=1e-7)
    along = np.einsum("kij,kj->ki", inverse @ slope, step / spread)
    end = start + step - np.where(rng.uniform(size=(_MOVES, 1)) < 0.5, along, 0.0) * spread
    for _ in range(_NEWTON):
        miss = np.nan_to_num((values(end) - target) / size)
        if np.abs(miss).max(initial=0.0) < 1e-13:
            break
        back = np.linalg.pinv(slopes(end) / size[:, None], rcond=1e-7)
        end = end - np.einsum("kij,kj->ki", back, miss) * spread
    with np.errstate(all="ignore"):
        met = np.abs((values(end) - target) / size).max(axis=1) < 1e-9
        moved = np.abs((end - start) / spread).max(axis=1) > 1e-3
    return start[met & moved], end[met & moved]
