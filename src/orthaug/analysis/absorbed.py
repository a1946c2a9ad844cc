"""What a fit makes of a term that the physics lacks: how far it moves c, and what the learner holds of it (F8).

With `Y = Φθ* + Δ` a learner that can be any function of its features z takes the mean of `Δ − Φd` given z, with
`d = c − θ*` from the partially linear regression `d = ((I − M)Φ)⁺(I − M)Δ`, M the mean given z. A Δ that is a function
of z has `(I − M)Δ = 0`: it moves nothing that the learner could not imitate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug.physics.output_weights import times
from orthaug.physics.problem import Problem

_WAVES = 100  # tanh functions of z that stand for any function of it
_ROWS_PER_WAVE = 20
_STEEPEST = 30.0  # of their slopes, in units of 1 / range of z
_ROWS = 20_000
_ROUNDING = 1e-10
_SEED = 20_241_122


@dataclass(frozen=True, eq=False)
class Absorbed:
    """A term of coefficient 1 after the fit.

    `moved` (nθ,) is what it adds to c. `held` (M, ny) is what the learner holds of it on a measure's points. `seen`
    tells whether it is a function of what the learner sees; None where the learner could imitate all of the physics.
    """

    moved: Vector
    held: Matrix
    seen: bool | None = None


@dataclass(frozen=True, eq=False)
class Smoother:
    """The mean given the learner's features, over the training rows: least squares on many functions of these.

    The functions are tanh waves with centres on the data, and the shared part of the physics.
    """

    problem: Problem

    @cached_property
    def every(self) -> slice:
        """The training rows that are used."""
        return slice(None, None, -(-len(self.problem.rows) // _ROWS))

    @cached_property
    def _waves(self) -> tuple[Vector, Vector, Matrix, Vector]:
        """Centre and half of the range of z, and the waves' directions and offsets."""
        z = self.problem.feature_rows()[self.every]
        rng = np.random.default_rng(_SEED)
        centre = (z.max(axis=0) + z.min(axis=0)) / 2
        half = np.where(np.ptp(z, axis=0) > 0, np.ptp(z, axis=0) / 2, 1.0)
        count = min(_WAVES, len(z) // _ROWS_PER_WAVE)
        directions = rng.normal(size=(count, z.shape[1]))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        directions *= np.exp(rng.uniform(0.0, np.log(_STEEPEST), size=(count, 1)))
        places = ((z - centre) / half)[rng.integers(len(z), size=count)]
        return centre, half, directions, -np.sum(directions * places, axis=1)

    def _functions(self, x: Matrix) -> Matrix:
        """The functions of z on rows of the regressor, (M, h)."""
        problem, (centre, half, directions, offsets) = self.problem, self._waves
        with np.errstate(all="ignore"):
            z = (np.asarray(problem.features.evaluate(x, problem.layout, np)) - centre) / half
            phi = np.asarray(problem.baseline.phi(x, problem.layout, problem.outputs, np))
        shared = (phi @ problem.shared.basis).reshape(len(x), -1)
        return np.column_stack([np.ones(len(x)), z, shared, np.tanh(z @ directions.T + offsets)])

    @cached_property
    def _factored(self) -> tuple[Matrix, Matrix]:
        """An orthonormal basis of the functions on the training rows, and the matrix that makes it of them."""
        raw = self._functions(self.problem.rows.x[self.every])
        scale = np.sqrt(np.mean(raw**2, axis=0))
        scale = np.where(scale > 0, scale, 1.0)
        u, sigma, vt = scipy.linalg.svd(raw / scale, full_matrices=False)
        kept = sigma > _ROUNDING * sigma[0]
        return u[:, kept], (vt[kept].T / sigma[kept]) / scale[:, None]

    def left(self, values: Float[np.ndarray, "n *m"]) -> Float[np.ndarray, "n *m"]:
        """(I − M)v of values on the training rows that are used."""
        basis = self._factored[0]
        flat = values.reshape(len(values), -1)
        return (flat - basis @ (basis.T @ flat)).reshape(values.shape)

    def mean(self, values: Float[np.ndarray, "n ny"], x: Matrix) -> Matrix:
        """Mv at rows of the regressor, of values on the training rows that are used."""
        basis, change = self._factored
        return self._functions(x) @ (change @ (basis.T @ values))


def absorbed(
    problem: Problem,
    terms: Iterable[Callable[[Matrix], Matrix]],
    seen: Iterable[bool],
    x: Matrix,
) -> list[Absorbed]:
    """What a fit makes of each term, to first order.

    Args:
        terms: the value (M, ny) of each on rows of the regressor.
        seen: whether it is a function of what the learner sees.
        x: the measure's points.
    """
    smoother, nt = Smoother(problem), len(problem.baseline.names)
    found = []
    for term, visible in zip(terms, seen, strict=True):
        if visible:
            found.append(Absorbed(np.zeros(nt), term(x), True))
        else:
            found.append(_unseen(smoother, term, x))
    return found


def _unseen(smoother: Smoother, term: Callable[[Matrix], Matrix], x: Matrix) -> Absorbed:
    problem = smoother.problem
    rows = problem.rows.x[smoother.every]
    phi = np.asarray(problem.baseline.phi(rows, problem.layout, problem.outputs, np))
    delta, gain = term(rows), problem.weight.matrix
    left, target = smoother.left(times(gain, phi)), smoother.left(times(gain, delta))
    others = _others(problem.shared.basis)
    moved = np.zeros(len(problem.baseline.names))
    if others:
        columns = left[..., others].reshape(-1, len(others))
        size = np.sqrt(np.sum(times(gain, phi)[..., others] ** 2, axis=(0, 1)))
        size = np.where(size > 0, size, 1.0)
        moved[others] = np.linalg.lstsq(columns / size, target.reshape(-1), rcond=1e-8)[0] / size
    return Absorbed(moved, smoother.mean(delta - phi @ moved, x), False)


def _others(basis: Matrix) -> list[int]:
    """Parameters whose directions complete the shared ones."""
    if not basis.shape[1]:
        return list(range(len(basis)))
    order = scipy.linalg.qr(basis.T, mode="r", pivoting=True)[-1]
    return sorted(int(i) for i in order[basis.shape[1] :])
