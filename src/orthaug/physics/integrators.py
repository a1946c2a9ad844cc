"""One sample of a motion: from x(t) to x(t + Ts), with the input held as declared between samples.

`rk4` is the classical Runge-Kutta method. `exact` is exponential time differencing (Cox and
Matthews 2002, ETDRK4): the part of the motion that is linear at the origin goes by its matrix
exponential, so a linear motion has no error under a zero-order or first-order hold. Both take
several substeps in a sample.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from orthaug._base import plugins
from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug._base.jax import AnyArray, Array, jax, jnp
from orthaug._base.registry import Registry

_SQUARINGS, _TERMS = 12, 12  # of the matrix exponential

Field = Callable[[Any, Any], Any]
"""F(x (nx,), u (nu,)) → (nx,)."""
Step = Callable[[Any, Any, Any, Any], Any]
"""x one substep later, of x and the inputs at its begin, middle and end."""


def inputs_at_points(
    inputs: Matrix, hold: str, substeps: int, pace: Vector | None = None
) -> Matrix:
    """Return the inputs (N, nu) at the points of each sample that a step reads, (N, points nu).

    One point under a zero-order hold, both ends under a first-order hold, and under a spline hold
    the ends and middles of all substeps, on a cubic spline through the record.

    Args:
        pace: length (N,) of each step over that of the others, where they differ. A last column
            then has what it is longer by, `pace − 1`, which `split_pace` takes off again.
    """
    if pace is not None:
        points = _uneven_points(inputs, hold, substeps, pace)
        return np.concatenate([points, pace[:, None] - 1], axis=1)
    rows, nu = inputs.shape
    if hold == "zero-order" or not nu:
        return inputs
    if hold == "first-order" or rows < 4:
        return _interleave(inputs, np.concatenate([inputs[1:], inputs[-1:]]))
    from scipy.interpolate import CubicSpline  # slow to import, and few runs need it

    spline, k = CubicSpline(np.arange(rows), inputs), np.arange(rows)
    return _interleave(
        *(spline(np.minimum(k + i / (2 * substeps), rows - 1)) for i in range(2 * substeps + 1))
    )


def _uneven_points(inputs: Matrix, hold: str, substeps: int, pace: Vector) -> Matrix:
    rows, nu = inputs.shape
    if hold != "spline" or not nu:
        return inputs_at_points(inputs, hold, substeps)
    if rows < 4:
        raise InputError(
            f"a spline through uneven instants needs 4 rows; an experiment has {rows}. Give "
            '`hold = "first-order"`.'
        )
    from scipy.interpolate import CubicSpline  # slow to import, and few runs need it

    instants = np.concatenate([[0.0], np.cumsum(pace[:-1])])
    spline = CubicSpline(instants, inputs)
    ahead = [instants + i / (2 * substeps) * pace for i in range(2 * substeps + 1)]
    return _interleave(*(spline(np.minimum(t, instants[-1])) for t in ahead))


def split_pace(row: AnyArray, hold: str, substeps: int, nu: int) -> tuple[Any, Any]:
    """Return the inputs (…, points nu) that a step reads, and its length over that of an even one.

    A row of even samples has no pace; the length is then 1.
    """
    points = {"zero-order": 1, "first-order": 2}.get(hold, 2 * substeps + 1)
    if row.shape[-1] == points * nu + 1:
        return row[..., :-1], 1.0 + row[..., -1]
    return row, 1.0


def _interleave(*points: Matrix) -> Matrix:
    return np.stack(points, axis=1).reshape(len(points[0]), -1)


def input_at(row: Array, nu: int) -> Callable[[Any, int], Any]:
    """Return u (nu,) as a function of the half substep i of a sample and of their number."""
    points = row.reshape(-1, nu) if nu else row.reshape(1, 0)
    if len(points) == 1:
        return lambda i, halves: points[0]
    if len(points) == 2:
        return lambda i, halves: points[0] + (points[1] - points[0]) * (i / halves)
    return lambda i, halves: points[i]


class Exponentials(NamedTuple):
    """Exponentials of the linear part A of a motion over a substep h.

    They are e^{Ah}, φ₁ to φ₃ of Ah, and e^{Ah/2}, (h/2) φ₁ of Ah/2.
    """

    linear: Any
    whole: Any
    phi1: Any
    phi2: Any
    phi3: Any
    half: Any
    half1: Any

    @classmethod
    def of(cls, linear: Array, h: float) -> Exponentials:
        """Return the exponentials of A (nx, nx) over a step h."""
        # At once: less to compile
        both = jax.vmap(lambda a: _phi(a, 3))(jnp.stack([linear * h, linear * h / 2]))
        (whole, half), (phi1, half1), (phi2, _), (phi3, _) = both
        return cls(linear, whole, phi1, phi2, phi3, half, half1 * h / 2)


@dataclass(frozen=True)
class Integrator:
    """Rule by which a motion goes on by one substep; a new one is a subclass in `INTEGRATORS`.

    Arithmetic alone, so that the arrays may be JAX's or NumPy's. Derivatives are automatic.
    """

    discrete: ClassVar[bool] = False
    """True if the equations give the next state, and nothing is integrated."""
    widest_angle: ClassVar[float | None] = 0.1
    """|λ| h of the fastest mode λ in the substeps h that training begins with; None for any."""
    splits_linear_part: ClassVar[bool] = False
    """True if a step needs the `Exponentials` of the part that is linear at the origin."""
    has_adjoint: ClassVar[bool] = False
    """True if `models.moving` has hand-written slopes of its stages."""

    def step(self, field: Field, h: float, scheme: Any = None) -> Step:
        """Return a step of length h.

        Args:
            field: ẋ = F(x, u).
            h: the substep.
            scheme: the `Exponentials` of the linear part, where it splits that.
        """
        raise NotImplementedError

    def first_substeps(self, angle: float) -> int:
        """Return the substeps that training begins with, of the fastest mode's |λ| Ts."""
        return 1 if self.widest_angle is None else max(1, int(np.ceil(angle / self.widest_angle)))


@dataclass(frozen=True)
class RungeKutta4(Integrator):
    """The classical Runge-Kutta method of order 4."""

    widest_angle = 0.35  # rad: it errs by about 1e-3 of that in a period
    has_adjoint = True

    def step(self, field: Field, h: float, scheme: Any = None) -> Step:
        return _runge_kutta(field, h)


@dataclass(frozen=True)
class Automatic(RungeKutta4):
    """Runge-Kutta, until a record is there to choose: see `GuessedMotion.integrator`."""


@dataclass(frozen=True)
class Exponential(Integrator):
    """Exponential time differencing of order 4 (Cox and Matthews 2002)."""

    widest_angle = None
    splits_linear_part = True

    def step(self, field: Field, h: float, scheme: Any = None) -> Step:
        return _exponential(field, scheme, h)


@dataclass(frozen=True)
class Discrete(Integrator):
    """Equations that give the state one sample later."""

    discrete = True
    widest_angle = None


INTEGRATORS = Registry(
    "integrator",
    {"auto": Automatic, "rk4": RungeKutta4, "exact": Exponential, "discrete": Discrete},
    group=plugins.INTEGRATORS,
    follows=Integrator,
)


def advance(step: Step, x: Array, row: Array, nu: int, substeps: int) -> Array:
    """Return x one sample later.

    Args:
        step: of one substep.
        x: the state.
        row: the input as `inputs_at_points` arranges it.
        nu: number of inputs.
        substeps: of a sample.
    """
    at, halves = input_at(row, nu), 2 * substeps
    if substeps == 1:
        return step(x, at(0, 2), at(1, 2), at(2, 2))
    u = jnp.stack([at(i, halves) for i in range(halves + 1)])
    return jax.lax.scan(lambda x, u: (step(x, *u), None), x, (u[:-2:2], u[1:-1:2], u[2::2]))[0]


def _runge_kutta(field: Field, h: float) -> Step:
    """Return a step of length h under inputs at its begin, middle and end.

    With F_s = F(x + a_s h F_{s−1}), the state moves by h Σ b_s F_s. The stages are a loop of the
    program: the field is then written once, which compiles in half the time and runs as fast.
    """
    ahead, share = (0.0, 0.5, 0.5, 1.0), (1 / 6, 1 / 3, 1 / 3, 1 / 6)

    def one(x: Any, first: Any, middle: Any, last: Any) -> Any:
        def stage(sums: tuple[Any, Any], given: tuple[Any, Any, Any]) -> tuple[Any, None]:
            (rates, total), (a, b, u) = sums, given
            rates = field(x + a * h * rates, u)
            return (rates, total + b * rates), None

        inputs = first, middle, middle, last
        if isinstance(x, np.ndarray):
            sums = np.zeros_like(x), np.zeros_like(x)
            for given in zip(ahead, share, inputs, strict=True):
                sums = stage(sums, given)[0]
        else:
            stages = jnp.array(ahead), jnp.array(share), jnp.stack(inputs)
            sums = jax.lax.scan(stage, (jnp.zeros_like(x), jnp.zeros_like(x)), stages)[0]
        return x + h * sums[1]

    return one


def _exponential(field: Field, scheme: Exponentials, h: float) -> Step:
    linear, whole, phi1, phi2, phi3, half, half1 = scheme

    def rest(x: AnyArray, u: AnyArray) -> Any:
        return field(x, u) - linear @ x

    def one(x: Array, first: Array, middle: Array, last: AnyArray) -> Any:
        begin = rest(x, first)
        a = half @ x + half1 @ begin
        at_a = rest(a, middle)
        b = half @ x + half1 @ at_a
        at_b = rest(b, middle)
        c = half @ a + half1 @ (2 * at_b - begin)
        ends = (phi1 - 3 * phi2 + 4 * phi3) @ begin + (4 * phi3 - phi2) @ rest(c, last)
        return whole @ x + h * (ends + 2 * (phi2 - 2 * phi3) @ (at_a + at_b))

    return one


def _phi(a: Array, order: int) -> list[Array]:
    """Return e^A, φ₁(A) … φ_order(A), from one exponential of a block matrix (Sidje 1998)."""
    n = len(a)
    size = (order + 1) * n
    block = jnp.zeros((size, size)).at[:n, :n].set(a)
    block = block.at[jnp.arange(size - n), jnp.arange(n, size)].set(1.0)
    top = jnp.eye(n, size) + _exponential_less_one(block)[:n]
    return [top[:, i * n : (i + 1) * n] for i in range(order + 1)]


def _exponential_less_one(a: Array) -> Array:
    """Return e^A − I by scaling and squaring.

    `E ← 2E + E²` keeps the digits that squaring e^A would lose.

    The number of squarings is fixed, so that it compiles to a few products; it is right for ‖A‖ up
    to some thousand.
    """
    a = a / 2**_SQUARINGS

    def further(i: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
        term = sums[0] @ a / i
        return term, sums[1] + term

    _, total = jax.lax.fori_loop(2, _TERMS + 1, further, (a, a))
    return jax.lax.fori_loop(0, _SQUARINGS, lambda _, e: 2 * e + e @ e, total)
