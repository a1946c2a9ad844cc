"""A linear system with what its matrices move along the directions of a covariance: poles, gains and responses of both.

The covariance of `vec [[A, B], [C, D]]` is `Σ_j m_j m_jᵀ` with the r matrices m_j of `moved`. A function of the
matrices then has the variance `Σ_j δ_j²`, δ_j its derivative along m_j (delta method): sums of squares.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Complex, Float

from orthaug._base.checks import Matrix, Vector

_ZERO = 1e-12  # of a balanced matrix's norm: a direction that one step forgets
_DEFECTIVE = 1e-6  # |wᴴv| of eigenvectors below which a pole has no derivative
_UNIT = 1e-9  # distance from 1 at which a pole integrates


@dataclass(frozen=True, eq=False)
class System:
    """`x⁺ = A x + B u` of a sampling time `step` [s], or `ẋ = A x + B u` where that is None; `y = C x + D u`.

    `matrix` is [[A, B], [C, D]], (n + ny, n + nu); `moved` (r, n + ny, n + nu), None where nothing is known.
    """

    matrix: Matrix
    states: int
    step: float | None
    moved: Float[np.ndarray, "r m k"] | None = None

    @property
    def a(self) -> Matrix:
        """A (n, n)."""
        return self.matrix[: self.states, : self.states]

    @property
    def b(self) -> Matrix:
        """B (n, nu)."""
        return self.matrix[: self.states, self.states :]

    @property
    def c(self) -> Matrix:
        """C (ny, n)."""
        return self.matrix[self.states :, : self.states]

    @property
    def d(self) -> Matrix:
        """D (ny, nu)."""
        return self.matrix[self.states :, self.states :]

    @property
    def std(self) -> Matrix | None:
        """Standard errors of `matrix`; 0 where an entry is no estimate."""
        return None if self.moved is None else np.sqrt(np.sum(self.moved**2, axis=0))

    @cached_property
    def modes(self) -> Modes:
        """Poles with their derivatives."""
        return modes_of(self.a, None if self.moved is None else self.moved[:, : self.states, : self.states])

    def response(self, z: Complex[np.ndarray, "m"]) -> Response:
        """`C (zI − A)⁻¹ B + D` at m points of the plane."""
        n = self.states
        inverse = z[:, None, None] * np.eye(n) - self.a
        right = _solved(inverse, np.broadcast_to(self.b.astype(complex), (len(z), *self.b.shape)))
        value = self.c @ right + self.d
        if self.moved is None:
            return Response(value, None)
        outputs = np.broadcast_to(self.c.T.astype(complex), (len(z), *self.c.T.shape))
        left = np.swapaxes(_solved(np.swapaxes(inverse, 1, 2), outputs), 1, 2)
        ny, nu = self.d.shape
        left = np.concatenate([left, np.broadcast_to(np.eye(ny), (len(z), ny, ny))], axis=2)
        right = np.concatenate([right, np.broadcast_to(np.eye(nu), (len(z), nu, nu))], axis=1)
        return Response(value, np.einsum("mij,rjk,mkl->mril", left, self.moved, right, optimize=True))

    @property
    def integrates(self) -> bool:
        """Whether a pole stands where the static gain is asked for."""
        rest = 1.0 if self.step is not None else 0.0
        size = 1.0 if self.step is not None else max(np.abs(self.modes.values).max(initial=0.0), 1e-300)
        return bool(np.any(np.abs(self.modes.values - rest) < _UNIT * size)) or (
            self.step is None and self.modes.at_zero > 0
        )

    def at(self, frequency: Vector) -> Response:
        """The response to sines at frequencies [Hz]."""
        turn = 2j * np.pi * frequency
        return self.response(turn if self.step is None else np.exp(turn * self.step))

    def gain(self) -> Response | None:
        """The static gain (1, ny, nu); None for a system that integrates."""
        if self.integrates:
            return None
        found = self.response(np.array([1.0 + 0j if self.step is not None else 0j]))
        return Response(found.value.real, None if found.moved is None else found.moved.real)


class Response(NamedTuple):
    """Values (m, ny, nu), and how they move (m, r, ny, nu)."""

    value: Any
    moved: Any


class Modes(NamedTuple):
    """Eigenvalues other than 0, how each moves along the covariance (None where it has no derivative), how many are 0.

    In the order of decreasing magnitude, the upper one of a conjugate pair first.
    """

    values: Complex[np.ndarray, "k"]
    moved: tuple[Complex[np.ndarray, "r"] | None, ...]
    at_zero: int


def modes_of(a: Matrix, moved: Float[np.ndarray, "r n n"] | None) -> Modes:
    """Eigenvalues of A; `dλ = wᴴ dA v / wᴴv` with its eigenvectors.

    Those at 0, which shift registers have, are split off before: a chain of k of them is moved by rounding as far as
    `ε^(1/k)`.
    """
    if not len(a):
        return Modes(np.zeros(0, dtype=complex), (), 0)
    balanced, scale = scipy.linalg.matrix_balance(a, permute=False, separate=True)
    core, basis = _core(balanced)
    nothing = np.zeros(0, dtype=complex), core
    found: Any = scipy.linalg.eig(core, left=True, right=False) if len(core) else nothing
    values, left = found
    order = np.lexsort((-np.sign(values.imag), np.round(np.abs(np.angle(values)), 9), -np.round(np.abs(values), 12)))
    slopes: list[Any] = []
    for i in order:
        if moved is None:
            slopes.append(None)
            continue
        w = basis @ left[:, i]
        v = _right(balanced, values[i], w)
        inner = w.conj() @ v
        sure = abs(inner) > _DEFECTIVE * np.linalg.norm(w) * np.linalg.norm(v)
        slopes.append(np.einsum("i,rij,j->r", w.conj() / scale[0], moved, v * scale[0]) / inner if sure else None)
    return Modes(values[order], tuple(slopes), len(a) - len(core))


def _core(a: Matrix) -> tuple[Matrix, Matrix]:
    """A on what it never forgets: `Qᵀ A Q` with all eigenvalues but 0, and Q.

    Kernels are divided out one after the other, each by an orthogonal basis.
    """
    basis, core, limit = np.eye(len(a)), a, _ZERO * max(np.linalg.norm(a), 1e-300)
    while len(core):
        _, sizes, directions = np.linalg.svd(core)
        kept = int(np.sum(sizes > limit))
        if kept == len(core):
            break
        own = directions[:kept].T
        core, basis = own.T @ core @ own, basis @ own
    return core, basis


def _right(a: Matrix, value: complex, start: Any) -> Any:
    """The right eigenvector of a pole, by inverse iteration."""
    shifted = a - value * (1 + 1e-12) * np.eye(len(a))
    for _ in range(2):
        start = np.linalg.solve(shifted, start / np.linalg.norm(start))
    return start / np.linalg.norm(start)


def _solved(left: Any, right: Any) -> Any:
    """`left⁻¹ right`; NaN where a pole stands at the point."""
    if not left.shape[-1]:
        return np.zeros(right.shape, dtype=complex)
    try:
        return np.linalg.solve(left, right)
    except np.linalg.LinAlgError:
        single = np.array([np.linalg.cond(one) > 1e15 for one in left])
        safe = np.where(single[:, None, None], np.eye(left.shape[-1]), left)
        return np.where(single[:, None, None], np.nan, np.linalg.solve(safe, right))
