"""Recursive weighted least squares: each row updates a triangular factor by QR.

Old rows are forgotten exponentially.

With weights `w_i = λ^(k−i)` and `e₀ = y − φθ₀` the factor has `[R z]ᵀ[R z] = Σ w [φ e₀]ᵀ[φ e₀]`, so
`θ = θ₀ + R⁻¹z`: `ΦᵀΦ` is never formed, and rounding adds up against the change of θ only. The
covariance needs the squared weights too: `Cov θ = s² I⁻¹ M I⁻¹`, `I = RᵀR`, `M = Σ w² φᵀφ`.
`EstimateHistory` keeps what it is made of, row by row, within bounds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg.lapack import dtpqrt, dtrtrs  # pyright: ignore[reportAttributeAccessIssue]  (made at build)

from orthaug._base.checks import Matrix, Vector
from orthaug.inference.covariance import interval

_DETERMINED = 1e-12  # smallest singular value of R with unit columns that determines all of θ
_KEPT = 0.1
"""Share of the information of a whole memory of training rows that forgetting leaves in every
direction of θ.
"""
MOST = 10_000
"""Rows that a history stores; of more every second one, every fourth, and so on."""


@dataclass(eq=False)
class Recursion:
    """The state of recursive least squares; `update` changes it.

    `factor` (nθ+1, nθ+1) is `[R z]` above a row that is not used; `squared` is M. `level` is s²,
    the mean square of whitened errors, `_errors / _freedom`. `rows` and `rows_squared` are Σw and
    Σw². Where `floor` is given, directions whose information has come down to `floorᵀ floor` are
    not forgotten further, so that rows without excitation do not wind the covariance up.
    """

    factor: Matrix
    squared: Matrix
    shape: Matrix
    """Covariance of whitened errors (ny, ny), with a mean of 1 on its diagonal."""
    start: Vector
    """θ₀ (nθ,), which stays where rows do not determine θ."""
    forgetting: float
    floor: Matrix | None
    errors: float
    freedom: float
    rows: float
    rows_squared: float
    oldest: float = 0.0
    """Weight of the training rows now."""
    until: int = 0
    """Rows until the floor has to be looked at again."""
    determined: bool = False

    def __post_init__(self) -> None:
        self.theta = np.asarray(self.start, dtype=float)
        self._root = math.sqrt(self.forgetting)
        self.factor = np.array(self.factor, dtype=float, order="F")
        self._own_noise = len(self.shape) > 1
        self.theta = self._solve()

    @property
    def level(self) -> float:
        """s²."""
        return self.errors / self.freedom if self.freedom > 0 else 0.0

    @property
    def factor_now(self) -> Matrix:
        """R (nθ, nθ)."""
        return self.factor[:-1, :-1]

    @property
    def effective_rows(self) -> float:
        """`(Σw)² / Σw²`: as many rows of equal weight say as much."""
        return self.rows**2 / self.rows_squared if self.rows_squared > 0 else 0.0

    def update(self, phi: Float[np.ndarray, "ny nt"], target: Vector) -> tuple[Vector, float]:
        """Add a row of whitened outputs.

        Errors (ny,) are those of θ before the row, `variance` theirs in units of s².
        """
        error = target - phi @ self.theta
        self._forget()
        spread = self._spread(phi)
        self.errors += float(error @ error) / spread
        self.freedom += len(error)
        self.rows += 1.0
        self.rows_squared += 1.0
        self.squared += phi.T @ (self.shape @ phi if self._own_noise else phi)
        rows = np.empty((len(error), len(self.theta) + 1), order="F")
        rows[:, :-1], rows[:, -1] = phi, target - phi @ self.start
        self.factor = dtpqrt(0, 1, self.factor, rows, overwrite_a=1, overwrite_b=1)[0]
        self.theta = self._solve()
        return error, spread

    def _spread(self, phi: Float[np.ndarray, "ny nt"]) -> float:
        """Return 1 + φ Cov(θ) φᵀ / s² of a row before it is added; 1 while θ is undetermined."""
        if not self.determined or not phi.size:
            return 1.0
        inner = dtrtrs(self.factor[:-1, :-1], phi.T, trans=1)[0]
        reach = dtrtrs(self.factor[:-1, :-1], inner)[0]
        return 1.0 + float(np.sum(reach * (self.squared @ reach))) / len(phi)

    def _solve(self) -> Vector:
        if not len(self.start):
            return self.start
        r, z = self.factor[:-1, :-1], self.factor[:-1, -1]
        if self.determined:
            return self.start + dtrtrs(r, z)[0]
        norms = np.linalg.norm(r, axis=0)
        scaled = r / np.where(norms > 0, norms, 1.0)
        size = np.linalg.svd(scaled, compute_uv=False)
        self.determined = bool(size[-1] > _DETERMINED * size[0])
        # The least that explains the rows
        change = np.linalg.lstsq(scaled, z, rcond=_DETERMINED)[0]
        return self.start + change / np.where(norms > 0, norms, 1.0)

    def _forget(self) -> None:
        if self.forgetting == 1.0:
            return
        self.errors *= self.forgetting
        self.freedom *= self.forgetting
        self.rows *= self.forgetting
        self.rows_squared *= self.forgetting**2
        self.oldest *= self.forgetting
        if self.until <= 0 and self.floor is not None and len(self.start) and self._keep():
            return
        self.until -= 1
        self.factor *= self._root
        self.squared *= self.forgetting**2

    def _keep(self) -> bool:
        """Forget only directions above the floor, once one has come down to it."""
        assert self.floor is not None
        r = self.factor[:-1, :-1]
        u, size, _ = np.linalg.svd(np.linalg.solve(self.floor.T, r.T).T)
        least = float(size[-1]) ** 2
        spare = math.floor(math.log(least) / -math.log(self.forgetting)) if least > 1 else 0
        if spare >= 1:
            self.until = spare
            return False
        left = np.where(size > 1, np.maximum(self.forgetting, 1 / np.maximum(size, 1.0) ** 2), 1.0)
        top = (u * np.sqrt(left)) @ u.T @ self.factor[:-1]
        self.factor[:-1] = np.linalg.qr(top, mode="r")
        if self.determined:
            turn = np.linalg.solve(r, (u * left) @ u.T @ r)
            self.squared = turn.T @ self.squared @ turn
        return True


def upright(r: Float[np.ndarray, "*k n n"]) -> Float[np.ndarray, "*k n n"]:
    """Return triangular factors with positive diagonals, which makes them unique."""
    sign = np.where(np.diagonal(r, axis1=-2, axis2=-1) < 0, -1.0, 1.0)
    return r * sign[..., None]


def start_recursion(
    phi: Float[np.ndarray, "N ny nt"],
    target: Matrix,
    theta: Vector,
    shape: Matrix,
    level: float,
    freedom: float,
    forgetting: float,
    *,
    empty: bool,
) -> Recursion:
    """Return the state after the training rows, which count as one memory at most.

    In whitened outputs.

    Args:
        level, freedom: s² and its degrees of freedom over these rows.
        empty: begin without them; they still say what the floor is.
    """
    count, ny, nt = phi.shape
    whole = np.linalg.qr(
        np.column_stack([phi.reshape(-1, nt), (target - phi @ theta).ravel()]), mode="r"
    )
    factor = np.zeros((nt + 1, nt + 1))
    factor[: len(whole)] = whole
    memory = 1 / (1 - forgetting) if forgetting < 1 else np.inf
    share = 0.0 if empty else min(1.0, memory / count)
    floor = np.sqrt(_KEPT * memory / count) * factor[:nt, :nt] if forgetting < 1 else None
    squared = squares(phi, shape)
    return Recursion(
        np.sqrt(share) * factor,
        share**2 * squared,
        shape,
        theta,
        forgetting,
        floor,
        errors=share * level * freedom,
        freedom=share * freedom,
        rows=share * count,
        rows_squared=share**2 * count,
        oldest=share,
    )


def squares(phi: Float[np.ndarray, "N ny nt"], shape: Matrix) -> Matrix:
    """Return M of rows of equal weight (nθ, nθ)."""
    return (
        phi[:, 0].T @ phi[:, 0] if len(shape) == 1 else np.einsum("kit,ij,kjs->ts", phi, shape, phi)
    )


@dataclass(eq=False)
class EstimateHistory:
    """A row of numbers for each row of data that was used.

    Columns: the row's number, the level of the alarm (above 1 it is raised), s², degrees of
    freedom, whether θ is determined, the residuals (ny), θ (nθ), R and M (nθ² each).
    """

    ny: int
    nt: int
    stride: int = 1
    _lines: list[Vector] = field(default_factory=list)

    @property
    def rows(self) -> Matrix:
        """All stored rows (k, columns)."""
        return np.reshape(self._lines, (-1, 5 + self.ny + self.nt + 2 * self.nt**2))

    def line(
        self, row: int, level: float, freedom: float, residual: Vector, recursion: Recursion
    ) -> Vector:
        """Return the stored numbers of a row."""
        line = np.empty(5 + self.ny + self.nt + 2 * self.nt**2)
        first, second = 5 + self.ny, 5 + self.ny + self.nt
        line[:5] = row, level, recursion.level, freedom, recursion.determined
        line[5:first] = residual
        line[first:second] = recursion.theta
        line[second : second + self.nt**2] = recursion.factor_now.ravel()
        line[second + self.nt**2 :] = recursion.squared.ravel()
        return line

    def add(self, line: Vector) -> None:
        """Store the numbers of one more row."""
        if int(line[0]) % self.stride:
            return
        self._lines.append(line)
        if len(self._lines) > MOST:
            self.stride *= 2
            self._lines = [line for line in self._lines if not int(line[0]) % self.stride]

    @property
    def theta(self) -> Float[np.ndarray, "k nt"]:
        return self.rows[:, 5 + self.ny : 5 + self.ny + self.nt]

    @property
    def residual(self) -> Float[np.ndarray, "k ny"]:
        return self.rows[:, 5 : 5 + self.ny]

    @property
    def alarm(self) -> Vector:
        """The level of the alarm (k,)."""
        return self.rows[:, 1]

    def covariances(self, inflation: Matrix | None) -> Float[np.ndarray, "k nt nt"]:
        """Return Cov θ of every row; NaN where there is none."""
        squares = self.rows[:, 5 + self.ny + self.nt :].reshape(-1, 2, self.nt, self.nt)
        return covariances(
            squares[:, 0], squares[:, 1], self.rows[:, 2], self.rows[:, 4] > 0, inflation
        )

    def intervals(self, inflation: Matrix | None) -> Float[np.ndarray, "k nt 2"]:
        """Return 95 % intervals of θ."""
        std = np.sqrt(np.diagonal(self.covariances(inflation), axis1=1, axis2=2))
        pairs = zip(self.theta, std, self.rows[:, 3], strict=True)
        return np.array([interval(*pair) for pair in pairs]).reshape(-1, self.nt, 2)


def covariances(
    r: Float[np.ndarray, "k nt nt"],
    squared: Float[np.ndarray, "k nt nt"],
    level: Vector,
    determined: Bool[np.ndarray, "k"],
    inflation: Matrix | None,
) -> Float[np.ndarray, "k nt nt"]:
    """Return `s² S G Sᵀ` with `S Sᵀ = I⁻¹ M I⁻¹`.

    G, the inflation, is the factor by which the fit's own covariance exceeds that.
    """
    result = np.full(r.shape, np.nan)
    if inflation is None or not determined.any():
        return result
    half = _half_factor(r[determined], squared[determined])
    result[determined] = level[determined, None, None] * (
        half @ inflation @ np.swapaxes(half, 1, 2)
    )
    return result


def inflation_of(
    r: Matrix, squared: Matrix, level: float, covariance: Matrix | None
) -> Matrix | None:
    """Return G of a fit: its covariance in units of `s² I⁻¹ M I⁻¹`; None without one.

    It holds what else makes θ uncertain: the learner beside it, or the colour of the errors
    (`fit.robust()`).
    """
    if covariance is None or not np.isfinite(covariance).all() or not level > 0:
        return None
    half = _half_factor(r[None], squared[None])[0]
    return np.linalg.solve(half, np.linalg.solve(half, covariance).T) / level


def _half_factor(
    r: Float[np.ndarray, "k nt nt"], squared: Float[np.ndarray, "k nt nt"]
) -> Float[np.ndarray, "k nt nt"]:
    """Return `S = R⁻¹ (R⁻ᵀ M R⁻¹)^½` of factors made unique by a positive diagonal."""
    r = upright(r)
    unit = np.linalg.norm(r, axis=1, keepdims=True)  # of the columns
    inverse = np.swapaxes(unit, 1, 2) ** -1 * np.linalg.inv(r / unit)
    values, vectors = np.linalg.eigh(np.swapaxes(inverse, 1, 2) @ squared @ inverse)
    return inverse @ (
        (vectors * np.sqrt(np.maximum(values, 0.0))[:, None]) @ np.swapaxes(vectors, 1, 2)
    )
