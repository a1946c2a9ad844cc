"""Linear system with uncertain matrices: poles, gains and responses, each with its covariance.

The covariance of `vec [[A, B], [C, D]]` is `Σ_j m_j m_jᵀ` with the r matrices m_j of `moved`. A
function of the matrices then has the variance `Σ_j δ_j²`, δ_j its derivative along m_j (delta
method): sums of squares.

For continuous time a lagged model is written first with as many states as its transfer function
needs (observer form), less dead time that belongs to an input alone. Then `zoh`: `[[A, B], [0, 0]]
= ln [[A_d, B_d], [0, I]] / Ts`, exact for inputs that are held between samples; or `tustin`: `z =
(1 + s Ts/2) / (1 − s Ts/2)`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Complex, Float

from orthaug._base.checks import Matrix, Vector
from orthaug.models.stepping import Memory

_ZERO = 1e-12  # of a balanced matrix's norm: a direction that one step forgets
_DEFECTIVE = 1e-6  # |wᴴv| of eigenvectors below which a pole has no derivative
_UNIT = 1e-9  # distance from 1 at which a pole integrates
_NOTHING = 1e-14  # of the terms that a static gain adds up: rounding
METHODS = ("zoh", "tustin")
_ROUNDING = 1e-8  # of a matrix: what the logarithm must give back


@dataclass(frozen=True, eq=False)
class System:
    """`x⁺ = A x + B u` of a sampling time `step` [s], or `ẋ = A x + B u` where that is None.

    `y = C x + D u`.

    `matrix` is [[A, B], [C, D]], (n + ny, n + nu); `moved` (r, n + ny, n + nu), None where nothing
    is known.
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
        return modes_of(
            self.a, None if self.moved is None else self.moved[:, : self.states, : self.states]
        )

    def response(self, z: Complex[np.ndarray, "m"]) -> Response:
        """Return `C (zI − A)⁻¹ B + D` at m points of the plane."""
        n = self.states
        inverse = z[:, None, None] * np.eye(n) - self.a
        right = _solve(inverse, np.broadcast_to(self.b.astype(complex), (len(z), *self.b.shape)))
        value = self.c @ right + self.d
        if self.moved is None:
            return Response(value, None)
        outputs = np.broadcast_to(self.c.T.astype(complex), (len(z), *self.c.T.shape))
        left = np.swapaxes(_solve(np.swapaxes(inverse, 1, 2), outputs), 1, 2)
        ny, nu = self.d.shape
        left = np.concatenate([left, np.broadcast_to(np.eye(ny), (len(z), ny, ny))], axis=2)
        right = np.concatenate([right, np.broadcast_to(np.eye(nu), (len(z), nu, nu))], axis=1)
        return Response(
            value, np.einsum("mij,rjk,mkl->mril", left, self.moved, right, optimize=True)
        )

    @property
    def integrates(self) -> bool:
        """True if there is a pole where the static gain is evaluated."""
        rest = 1.0 if self.step is not None else 0.0
        size = (
            1.0
            if self.step is not None
            else max(np.abs(self.modes.values).max(initial=0.0), 1e-300)
        )
        return bool(np.any(np.abs(self.modes.values - rest) < _UNIT * size)) or (
            self.step is None and self.modes.at_zero > 0
        )

    def at(self, frequency: Vector) -> Response:
        """Return the response to sines at frequencies [Hz]."""
        turn = 2j * np.pi * frequency
        return self.response(turn if self.step is None else np.exp(turn * self.step))

    def gain(self) -> Response | None:
        """Return the static gain (1, ny, nu); None for a system that integrates.

        What is rounding beside the terms that add up to it is 0.
        """
        if self.integrates:
            return None
        rest = 1.0 if self.step is not None else 0.0
        found = self.response(np.array([rest + 0j]))
        matrix = rest * np.eye(self.states) - self.a
        inside = np.abs(np.linalg.solve(matrix, self.b))
        # Both terms of each entry are rounded, though they may cancel (Skeel 1979).
        terms = rest * np.eye(self.states) + np.abs(self.a)
        error = np.abs(np.linalg.inv(matrix)) @ (terms @ inside)
        least = _NOTHING * (np.abs(self.c) @ error + np.abs(self.d))
        value, moved = (
            None if part is None else np.where(np.abs(part.real) < least, 0.0, part.real)
            for part in found
        )
        return Response(value, moved)


class Response(NamedTuple):
    """Values (m, ny, nu), and how they move (m, r, ny, nu)."""

    value: Any
    moved: Any


class Modes(NamedTuple):
    """Eigenvalues other than 0, their derivatives along the covariance, and the number of zeros.

    A derivative is None where it does not exist.

    They are in the order of decreasing magnitude, the upper one of a conjugate pair first.
    """

    values: Complex[np.ndarray, "k"]
    moved: tuple[Complex[np.ndarray, "r"] | None, ...]
    at_zero: int


def modes_of(a: Matrix, moved: Float[np.ndarray, "r n n"] | None) -> Modes:
    """Return the eigenvalues of A; `dλ = wᴴ dA v / wᴴv` with its eigenvectors.

    Those at 0, which shift registers have, are split off before: a chain of k of them is moved by
    rounding as far as `ε^(1/k)`.
    """
    if not len(a):
        return Modes(np.zeros(0, dtype=complex), (), 0)
    balanced, scale = scipy.linalg.matrix_balance(a, permute=False, separate=True)
    core, basis = _core(balanced)
    nothing = np.zeros(0, dtype=complex), core
    found: Any = scipy.linalg.eig(core, left=True, right=False) if len(core) else nothing
    values, left = found
    order = np.lexsort(
        (
            -np.sign(values.imag),
            np.round(np.abs(np.angle(values)), 9),
            -np.round(np.abs(values), 12),
        )
    )
    slopes: list[Any] = []
    for i in order:
        if moved is None:
            slopes.append(None)
            continue
        w = basis @ left[:, i]
        v = _right(balanced, values[i], w)
        inner = w.conj() @ v
        sure = abs(inner) > _DEFECTIVE * np.linalg.norm(w) * np.linalg.norm(v)
        slopes.append(
            np.einsum("i,rij,j->r", w.conj() / scale[0], moved, v * scale[0]) / inner
            if sure
            else None
        )
    return Modes(values[order], tuple(slopes), len(a) - len(core))


def _core(a: Matrix) -> tuple[Matrix, Matrix]:
    """Return a on what it never forgets: `Qᵀ A Q` with all eigenvalues but 0, and Q.

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


def _right(a: Matrix, value: complex, start: np.ndarray) -> np.ndarray:
    """Return the right eigenvector of a pole, by inverse iteration."""
    shifted = a - value * (1 + 1e-12) * np.eye(len(a))
    for _ in range(2):
        start = np.linalg.solve(shifted, start / np.linalg.norm(start))
    return start / np.linalg.norm(start)


def _solve(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return `left⁻¹ right`; NaN at a pole."""
    if not left.shape[-1]:
        return np.zeros(right.shape, dtype=complex)
    try:
        return np.linalg.solve(left, right)
    except np.linalg.LinAlgError:
        single = np.array([np.linalg.cond(one) > 1e15 for one in left])
        safe = np.where(single[:, None, None], np.eye(left.shape[-1]), left)
        return np.where(single[:, None, None], np.nan, np.linalg.solve(safe, right))


@dataclass(frozen=True, eq=False)
class Continuous:
    """The system in continuous time; `dead_time` [s] (nu,) delays its inputs.

    `method` is that of the conversion.

    "equations" are a motion's own. `states` are their names.
    """

    system: System
    dead_time: Vector
    method: str
    states: tuple[str, ...]


def convert_to_continuous(
    system: System, method: str, memory: Memory | None, names: tuple[str, ...]
) -> Continuous | str:
    """Return the system in continuous time, or why there is none."""
    step = system.step
    assert step is not None
    dead = np.zeros(system.d.shape[1], dtype=int)
    if memory is not None:
        system, dead = observer_form(system, memory)
        names = tuple(f"x{i + 1}" for i in range(system.states))
    poles = system.modes
    if method == "tustin":
        if np.any(np.abs(poles.values + 1) < 1e-9):
            return "a pole at -1 has no counterpart under Tustin's rule."
        return Continuous(
            System(_tustin(system, step), system.states, None), dead * step, method, names
        )
    if poles.at_zero:
        count = "a pole at 0 has" if poles.at_zero == 1 else f"{poles.at_zero} poles at 0 have"
        return (
            f"{count} no counterpart under a hold (what is forgotten within a sample); tustin "
            "gives one."
        )
    values: Any = poles.values
    negative = values[(values.real < 0) & (np.abs(values.imag) < 1e-9 * np.abs(values))]
    if len(negative):
        listed = ", ".join(f"{value.real:.4g}" for value in negative)
        return (
            f"a real pole below 0 ({listed}) alternates from sample to sample, which no real "
            "system does under a hold; tustin gives one."
        )
    found = _logarithm(system, step)
    if found is None:
        return (
            "the matrix logarithm cannot be computed to the digits that are needed; tustin "
            "gives a system."
        )
    return Continuous(System(found, system.states, None), dead * step, method, names)


def observer_form(system: System, memory: Memory) -> tuple[System, Any]:
    """Return a lagged system with `Σ n_i` states, n_i the largest lag in the equation of output i.

    The dead samples (nu,) come with it.

    `s_i,l⁺ = s_i,l+1 + Σ_j a_ij,l y_j + Σ_j b_ij,l u_j`, `y_i = s_i,1 + Σ_j d_ij u_j`.
    """
    c, d = system.c, system.d
    ny, nu = d.shape
    inputs = list(memory.inputs)
    outputs = [name for name, _ in memory.depths[:ny]]
    longest = max((lag.lag for lag in memory.lags), default=0)
    of_y, of_u = np.zeros((longest, ny, ny)), np.zeros((longest + 1, ny, nu))
    of_u[0] = d
    for column, lag in zip(c.T, memory.lags, strict=True):
        if lag.channel in inputs:
            of_u[lag.lag, :, inputs.index(lag.channel)] = column
        else:
            of_y[lag.lag - 1, :, outputs.index(lag.channel)] = column
    dead = np.zeros(nu, dtype=int)
    for j in range(nu):
        acts = np.flatnonzero(np.any(of_u[:, :, j] != 0, axis=1))
        dead[j] = max(acts[0] - 1, 0) if len(acts) else 0
        of_u[:, :, j] = np.roll(of_u[:, :, j], -dead[j], axis=0)
    used = [np.any(of_y[:, i] != 0, axis=1) | np.any(of_u[1:, i] != 0, axis=1) for i in range(ny)]
    orders = [int(np.max(np.flatnonzero(u), initial=-1)) + 1 for u in used]
    n, first = sum(orders), np.concatenate([[0], np.cumsum(orders)]).astype(int)
    matrix = np.zeros((n + ny, n + nu))
    read = np.zeros((ny, n + nu))  # y of state and inputs
    read[:, n:] = of_u[0]
    for i in range(ny):
        if orders[i]:
            read[i, first[i]] = 1.0
    for i in range(ny):
        for lag in range(orders[i]):
            row = matrix[first[i] + lag]
            row += of_y[lag, i] @ read
            row[n:] += of_u[lag + 1, i]
            if lag + 1 < orders[i]:
                row[first[i] + lag + 1] += 1.0
    matrix[n:] = read
    return System(matrix, n, system.step), dead


def _logarithm(system: System, step: float) -> Matrix | None:
    n, nu = system.states, system.d.shape[1]
    whole = np.eye(n + nu)
    whole[:n] = system.matrix[:n]
    with np.errstate(all="ignore"):
        found: Any = np.asarray(scipy.linalg.logm(whole)) if n else np.zeros((nu, nu))
    if not np.isfinite(found).all() or np.abs(found.imag).max(initial=0.0) > _ROUNDING * np.abs(
        found
    ).max(initial=0.0):
        return None
    back = scipy.linalg.expm(found.real)
    if np.abs(back - whole).max(initial=0.0) > _ROUNDING * np.abs(whole).max(initial=1.0):
        return None
    matrix = system.matrix.copy()
    matrix[:n] = found.real[:n] / step
    return matrix


def _tustin(system: System, step: float) -> Matrix:
    n = system.states
    inverse = np.linalg.inv(system.a + np.eye(n))
    a = 2 / step * (system.a - np.eye(n)) @ inverse
    b = 2 / np.sqrt(step) * inverse @ system.b
    c = 2 / np.sqrt(step) * system.c @ inverse
    return np.block([[a, b], [c, system.d - system.c @ inverse @ system.b]])
