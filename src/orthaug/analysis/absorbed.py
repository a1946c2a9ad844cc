"""Effect of a missing term on a fit: how far it moves c, and how much of it the learner holds (F8).

With `Y = Φθ* + Δ` a learner that can be any function of its features z takes the mean of `Δ − Φd`
given z, with `d = c − θ*` from the partially linear regression `d = ((I − M)Φ)⁺(I − M)Δ`, M the
mean given z. A Δ that is a function of z has `(I − M)Δ = 0`: it moves nothing that the learner
could not imitate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import scipy.linalg
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import jnp
from orthaug._base.parallel import one_blas_thread
from orthaug.physics.output_weights import times
from orthaug.physics.problem import Problem

_MOST_WAVES = 100  # tanh functions of z, for any function of it
_ROWS_PER_WAVE = 20
WAVES = 24  # the same, before there is a fit
_STEEPEST = 30.0  # of their slopes, in units of 1 / range of z
_ROWS = 20_000
_ROUNDING = 1e-10
_SEED = 20_241_122


@dataclass(frozen=True, eq=False)
class TermAfterFit:
    """A term of coefficient 1 after the fit.

    `moved` (nθ,) is what it adds to c. `held` (M, ny) is what the learner holds of it on a
    measure's points. `seen` is whether it is a function of what the learner sees; None where the
    learner could imitate all of the physics.
    """

    moved: Vector
    held: Matrix
    seen: bool | None = None


@dataclass(frozen=True, eq=False)
class Smoother:
    """Mean given the learner's features over the training rows, by least squares.

    Squares are taken on many functions of the features.

    The functions are tanh waves with centres on the data, and the shared part of the physics. Of a
    learner that is linear in its features they are these.
    """

    problem: Problem

    @cached_property
    def every(self) -> slice:
        """The training rows that are used."""
        return slice(None, None, -(-len(self.problem.rows) // _ROWS))

    @cached_property
    def _unit(self) -> tuple[Vector, Vector]:
        """Centre and half of the range of z."""
        z = self.problem.feature_rows()
        if self.problem.features.linear:
            return np.zeros(z.shape[1]), np.maximum(np.abs(z).max(axis=0), 1e-300)
        low, high = z.min(axis=0), z.max(axis=0)
        return (low + high) / 2, np.where(high > low, (high - low) / 2, 1.0)

    def _z(self, x: Matrix) -> Matrix:
        """Return z on rows of the regressor, over its range in the data.

        Kept, for the same rows are asked for again.
        """
        known = self._evaluated.get(id(x))
        if known is None or known[0] is not x:
            centre, half = self._unit
            with np.errstate(all="ignore"):
                z = (
                    np.asarray(self.problem.features.evaluate(x, self.problem.layout, np)) - centre
                ) / half
            known = self._evaluated[id(x)] = (x, np.nan_to_num(z))
        return known[1]

    @cached_property
    def _evaluated(self) -> dict[int, tuple[Matrix, Matrix]]:
        """Rows and z on them."""
        return {}

    @cached_property
    def _inverse(self) -> Matrix:
        """z⁺ on the training rows that are used."""
        return np.linalg.pinv(self.inputs, rcond=1e-10)

    @cached_property
    def _basis(self) -> Matrix:
        """An orthonormal basis of the functions on the training rows that are used."""
        problem, rng = self.problem, np.random.default_rng(_SEED)
        x = problem.rows.x[self.every]
        z = self._z(x)
        functions = z
        if not problem.features.linear:
            count = min(_MOST_WAVES, len(z) // _ROWS_PER_WAVE)
            slopes = _slopes(rng, count, z.shape[1])
            centres = z[rng.integers(len(z), size=count)]
            waves = np.tanh(z @ slopes.T - np.sum(slopes * centres, axis=1))
            phi = problem.phi(x)
            shared = (phi @ problem.shared.basis).reshape(len(x), -1)
            functions = np.column_stack([np.ones(len(x)), z, shared, waves])
        scale = np.sqrt(np.mean(functions**2, axis=0))
        functions = functions / np.where(scale > 0, scale, 1.0)
        with one_blas_thread():
            factors: Any = scipy.linalg.qr(functions, mode="economic", pivoting=True)
        sizes = np.abs(np.diag(factors[1]))
        return factors[0][:, sizes > _ROUNDING * sizes[0]]

    @cached_property
    def inputs(self) -> Matrix:
        """z on the training rows that are used, over its range."""
        return self._z(self.problem.rows.x[self.every])

    def left(self, values: Float[np.ndarray, "n *m"]) -> Float[np.ndarray, "n *m"]:
        """Return (I − M)v of values on the training rows that are used."""
        flat = values.reshape(len(values), -1)
        return (flat - self._basis @ (self._basis.T @ flat)).reshape(values.shape)

    def mean(self, values: Float[np.ndarray, "n ny"], x: Matrix) -> Matrix:
        """Return Mv at rows of the regressor, from values on the training rows that are used.

        A row takes the value of the training row with the nearest z.

        A linear combination of the features is returned as it is.
        """
        if self.problem.features.linear:
            return self._z(x) @ (self._inverse @ values)
        known = self._basis @ (self._basis.T @ values)
        if x is self.problem.rows.x and len(known) == len(x):
            return known
        from scipy.spatial import KDTree  # slow to import, and few fits need it

        return known[KDTree(self.inputs).query(self._z(x))[1]]


def term_effects(
    problem: Problem,
    terms: Iterable[Callable[[Matrix], Matrix]],
    seen: Iterable[bool],
    x: Matrix,
) -> list[TermAfterFit]:
    """Return the effect of each term on a fit, to first order.

    Args:
        terms: the value (M, ny) of each on rows of the regressor.
        seen: whether it is a function of what the learner sees.
        x: the measure's points.
    """
    smoother, nt = Smoother(problem), len(problem.baseline.names)
    found = []
    for term, visible in zip(terms, seen, strict=True):
        if visible:
            found.append(TermAfterFit(np.zeros(nt), term(x), True))
        else:
            found.append(_unseen(smoother, term, x))
    return found


def _unseen(smoother: Smoother, term: Callable[[Matrix], Matrix], x: Matrix) -> TermAfterFit:
    problem = smoother.problem
    rows = problem.rows.x[smoother.every]
    phi = problem.phi(rows)
    delta, gain = term(rows), problem.weight.matrix
    left, target = smoother.left(times(gain, phi)), smoother.left(times(gain, delta))
    others = complementary_parameters(problem.shared.basis)
    moved = np.zeros(len(problem.baseline.names))
    if others:
        columns = left[..., others].reshape(-1, len(others))
        size = np.sqrt(np.sum(times(gain, phi)[..., others] ** 2, axis=(0, 1)))
        size = np.where(size > 0, size, 1.0)
        moved[others] = np.linalg.lstsq(columns / size, target.reshape(-1), rcond=1e-8)[0] / size
    return TermAfterFit(moved, smoother.mean(delta - phi @ moved, x), False)


def complementary_parameters(basis: Matrix) -> list[int]:
    """Return the parameters whose directions complete the shared ones."""
    if not basis.shape[1]:
        return list(range(len(basis)))
    order = scipy.linalg.qr(basis.T, mode="r", pivoting=True)[-1]
    return sorted(int(i) for i in order[basis.shape[1] :])


@dataclass(frozen=True)
class Waves:
    """A constant, the features z in [-1, 1] and tanh waves of them, each with a weight."""

    inputs: tuple[str, ...] | None = None

    def init(self, key: object, nz: int, ny: int) -> Any:
        return jnp.zeros((ny, 1 + nz + WAVES))

    def apply(self, tree: Any, z: Any) -> Any:
        slopes, offsets = _draw_waves(len(z))
        waves = jnp.tanh(jnp.tensordot(slopes, z, 1) - offsets.reshape(-1, *(1,) * (z.ndim - 1)))
        return tree @ jnp.concatenate([jnp.ones((1, *z.shape[1:])), z, waves])


@lru_cache(maxsize=16)
def _draw_waves(nz: int) -> tuple[Matrix, Vector]:
    """Return slopes (WAVES, nz) and offsets; every wave has its centre among the features."""
    rng = np.random.default_rng(_SEED)
    slopes, centres = _slopes(rng, WAVES, nz), rng.uniform(-1, 1, size=(WAVES, nz))
    return slopes, np.sum(slopes * centres, axis=1)


def _slopes(rng: np.random.Generator, count: int, nz: int) -> Matrix:
    """Return slopes (count, nz) of waves in random directions, gentle and steep ones alike."""
    slopes = rng.normal(size=(count, nz))
    steep = np.exp(rng.uniform(0.0, np.log(_STEEPEST), size=(count, 1)))
    return slopes * (steep / np.linalg.norm(slopes, axis=1)[:, None])
