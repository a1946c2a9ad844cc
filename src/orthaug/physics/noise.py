"""Models of the errors' colour `D(q) v_k = C(q) e_k`, and the filter `L = D/C` of rows.

`y_k = φ(x_k)θ + f(x_k) + v_k` with white innovations e. Every output has polynomials of its own,
monic, C with all roots inside the unit circle. `L = D/C` turns errors v into innovations, so the
prediction error is `L(Y − Φθ − F)`: a linear map of rows, under which least squares, projection and
split are those of filtered rows.

Conditions at the start of each stretch of rows without a gap: innovations before it are zero, and
its first p rows (p the order of D) serve as past only. So L is a lower triangular Toeplitz matrix
on each stretch, its first p rows zero. With `C = 1` the criterion is exactly that of least squares
with more lags.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import ArrayModule, jax, jnp

_BLOCK = 64  # rows that one matrix filters; 32 to 128 take as long
_SHARED = 4  # orders are filled up to a multiple of it, so that they share compiled programs
_INSIDE = 1 - 1e-9  # roots of C: what is nearer to the unit circle keeps its start for ever

Orders = tuple[tuple[int, int], ...]
"""Orders (of D, of C) of each output."""


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """`D(q) v_k = C(q) e_k` of every output, `D = 1 + Σ ar_i q⁻ⁱ`, `C = 1 + Σ ma_i q⁻ⁱ`.

    Examples:
        >>> noise = NoiseModel.of(((1, 0),), [-0.5])
        >>> noise.innovations(np.array([[1.0], [1.0], [0.5]])).T  # the first row is past only
        array([[0. , 0.5, 0. ]])
    """

    orders: Orders
    ar: Float[np.ndarray, "ny p"]
    """Coefficients of D after the leading 1; zeros beyond an output's own order."""
    ma: Float[np.ndarray, "ny q"]
    """Those of C."""
    covariance: Matrix | None = field(default=None, repr=False)
    """Cov of `values`; None where there is none."""

    @classmethod
    def of(cls, orders: Orders, values: Sequence[float] | Vector) -> NoiseModel:
        """Return the model of all coefficients, those of D before those of C, output by output."""
        p, q = (max((own[i] for own in orders), default=0) for i in (0, 1))
        ar, ma, rest = np.zeros((len(orders), p)), np.zeros((len(orders), q)), list(values)
        for o, (own_p, own_q) in enumerate(orders):
            ar[o, :own_p], rest = rest[:own_p], rest[own_p:]
            ma[o, :own_q], rest = rest[:own_q], rest[own_q:]
        return cls(tuple(orders), ar, ma)

    @property
    def values(self) -> Vector:
        """All coefficients, in the order of `of`."""
        parts = [
            part
            for o, (p, q) in enumerate(self.orders)
            for part in (self.ar[o, :p], self.ma[o, :q])
        ]
        return np.concatenate([np.zeros(0), *parts])

    def moved(self, values: Vector) -> NoiseModel:
        """Return the model with other coefficients."""
        return NoiseModel.of(self.orders, values)

    def names(self, outputs: Sequence[str]) -> list[tuple[str, str]]:
        """Return (output, coefficient) of all values: `("y", "ar1")`."""
        return [
            (output, f"{kind}{i + 1}")
            for output, (p, q) in zip(outputs, self.orders, strict=True)
            for kind, order in (("ar", p), ("ma", q))
            for i in range(order)
        ]

    @property
    def past(self) -> int:
        """Rows at the start of a stretch that serve as past only."""
        return self.ar.shape[1]

    @property
    def white(self) -> bool:
        """True if the errors are white: no coefficients."""
        return not any(map(sum, self.orders))

    @property
    def invertible(self) -> bool:
        """True if all roots of C are inside the unit circle."""
        return all(np.abs(np.roots([1.0, *c])).max(initial=0.0) < _INSIDE for c in self.ma)

    def reflected(self) -> NoiseModel:
        """Return the model of the same spectrum whose C has all roots inside the unit circle."""
        ma = np.zeros_like(self.ma)
        for o, (_, q) in enumerate(self.orders):
            roots = np.roots([1.0, *self.ma[o, :q]]).astype(complex)
            outside = np.abs(roots) > 1
            roots[outside] = 1 / np.conj(roots[outside])
            size = np.abs(roots)
            roots = np.where(size > 0.99, 0.99 * roots / np.maximum(size, 1e-300), roots)
            ma[o, :q] = np.r_[np.atleast_1d(np.real(np.poly(roots)))[1:], np.zeros(q)][:q]
        return replace(self, ma=ma)

    def innovations(self, errors: Float[np.ndarray, "T ny"]) -> Float[np.ndarray, "T ny"]:
        """Return e of errors v of one stretch; zero on the rows that are past only."""
        return RowFilter(self, (len(errors),)).rows(errors)

    def forecast_ahead(
        self, errors: Float[np.ndarray, "T ny"], horizon: int
    ) -> Float[np.ndarray, "m h ny"]:
        """Return forecasts of v at the rows i … i + h − 1 from the errors before row i, of all i.

        Rows i = 0 … T − h; zero where there are fewer errors than D needs.
        """
        (rows, ny), p, q = errors.shape, self.past, self.ma.shape[1]
        starts = np.arange(rows - horizon + 1)
        innovations = self.innovations(errors)

        def before(values: Any, count: int) -> Any:
            """Return the `count` values before each start, newest first, zeros before the rows."""
            padded = np.concatenate([np.zeros((count, ny)), values])
            return [padded[starts + count - 1 - i] for i in range(count)]

        v, e = before(errors, p), before(innovations, q)
        known = (starts >= p)[:, None]
        found = []
        for _ in range(horizon):
            new = sum((-self.ar[:, i] * v[i] for i in range(p)), np.zeros((len(starts), ny)))
            new = new + sum((self.ma[:, i] * e[i] for i in range(q)), 0.0)
            new = np.where(known, new, 0.0)
            found.append(new)
            v, e = [new, *v][:p], [np.zeros_like(new), *e][:q]
        return np.stack(found, axis=1)

    def word(self, o: int) -> str:
        """Return the model of one output in a word."""
        p, q = self.orders[o]
        if not p or not q:
            return f"AR({p})" if p else f"MA({q})" if q else "white"
        return f"ARMA({p}, {q})"

    def __str__(self) -> str:
        each = [self.word(o) for o in range(len(self.orders))]
        return each[0] if len(set(each)) == 1 else ", ".join(each)


class FilterRows(NamedTuple):
    """The filter as arrays; in memory of an engine with a leading axis of one chunk.

    `matrix` weighs the outputs afterwards.
    """

    ar: Float[Any, "*k ny p"]
    response: Float[Any, "*k ny B B"]
    """Of a block to its own values, by 1/C."""
    memory: Float[Any, "*k ny B q"]
    """Of a block to the last q values of the block before."""
    live: Float[Any, "*k m"]
    """0 on rows that do not count."""
    follows: Float[Any, "*k b"]
    """1 for blocks that follow the one before without a gap."""
    matrix: Float[Any, "*k ny ny"]
    place: Any = None
    """Rows of all blocks (b B); None where they are the rows in their order."""
    back: Any = None
    """Where each row is in the blocks."""

    def apply(self, values: Float[Any, "*n ny m"], xp: Any = jnp) -> Float[Any, "*n ny m"]:
        """Return `W L v` of values (…, ny, m), time last."""
        shape = values.shape
        x = values.reshape(-1, *shape[-2:])
        total = x
        for i in range(self.ar.shape[-1]):
            moved = xp.concatenate([xp.zeros_like(x[..., : i + 1]), x[..., : -(i + 1)]], axis=-1)
            total = total + self.ar[:, i, None] * moved
        total = total * self.live
        if self.memory.shape[-1]:
            total = self._recurse(total, xp) * self.live
        if self.matrix.shape[-1] == 1:
            return (self.matrix[0, 0] * total).reshape(shape)
        return xp.einsum("oi,nim->nom", self.matrix, total).reshape(shape)

    def _recurse(self, x: Any, xp: ArrayModule) -> Any:
        """Return `x / C(q)`, a block at a time."""
        (n, ny, m), size, q = x.shape, self.response.shape[-1], self.memory.shape[-1]
        blocks = len(self.follows)
        if self.place is None:
            padded = xp.concatenate([x, xp.zeros((n, ny, blocks * size - m))], axis=-1)
        else:
            padded = xp.concatenate([x, xp.zeros((n, ny, 1))], axis=-1)[..., self.place]
        cut = padded.reshape(n, ny, blocks, size)
        own = xp.matmul(cut, xp.swapaxes(self.response, -1, -2))
        last = xp.moveaxis(own[..., -q:], 2, 0)  # (b, n, ny, q)
        on = self.memory[:, -q:, :]

        def step(state: Any, block: Any) -> tuple[Any, Any]:
            ends, follows = block
            state = state * follows
            return ends + xp.einsum("nos,ors->nor", state, on), state

        state = xp.zeros((n, ny, q))
        if xp is np:
            entered = np.empty((blocks, n, ny, q))
            for b in range(blocks):
                state, entered[b] = step(state, (last[b], self.follows[b]))
        else:
            entered = jax.lax.scan(step, state, (last, self.follows))[1]
        own = own + xp.matmul(xp.moveaxis(entered, 0, 2), xp.swapaxes(self.memory, -1, -2))
        found = own.reshape(n, ny, blocks * size)
        return found[..., :m] if self.back is None else found[..., self.back]


@dataclass(frozen=True, eq=False)
class RowFilter:
    """L over the rows of a record's stretches, of `lengths`, one after the other.

    Args:
        skip: leading rows of a stretch that do not count; None for as many as D needs.
    """

    noise: NoiseModel
    lengths: tuple[int, ...]
    skip: int | None = None
    fixed: bool = False
    """True if the coefficients are known, not estimated from these rows."""

    @property
    def skipped(self) -> int:
        """Leading rows of a stretch that do not count."""
        return self.noise.past if self.skip is None else self.skip

    @cached_property
    def counted(self) -> int:
        """Number of rows that count."""
        return sum(max(length - self.skipped, 0) for length in self.lengths)

    @property
    def used(self) -> Vector:
        """Degrees of freedom (ny,) that the coefficients of each output use up."""
        return np.array([0.0 if self.fixed else p + q for p, q in self.noise.orders])

    def rows(self, values: Float[np.ndarray, "N ny ..."]) -> Float[np.ndarray, "N ny ..."]:
        """Return L of rows (N, ny, …), in NumPy."""
        count, ny = values.shape[:2]
        moved = np.ascontiguousarray(np.moveaxis(values.reshape(count, ny, -1), 0, -1))
        found = self._arrays.apply(np.swapaxes(moved, 0, 1), np)
        return np.moveaxis(np.swapaxes(found, 0, 1), -1, 0).reshape(values.shape)

    def slopes(self, errors: Float[np.ndarray, "N ny"]) -> Float[np.ndarray, "N ny n"]:
        """Return the derivative of `L v` by all coefficients, (N, ny, nη), for errors v."""
        noise, ny = self.noise, errors.shape[1]
        innovations = self.rows(errors)
        through = replace(self, noise=replace(noise, ar=noise.ar[:, :0]), skip=self.skipped)
        found, column = np.zeros((*errors.shape, len(noise.values))), 0
        for o, orders in enumerate(noise.orders):
            for signal, sign, order in zip((errors, innovations), (1, -1), orders, strict=True):
                for lag in range(1, order + 1):
                    found[:, o, column] = sign * self._delayed(signal[:, o], lag)
                    column += 1
        return through.rows(found) if ny and column else found

    def _delayed(self, signal: Vector, lag: int) -> Vector:
        """Return the signal some rows later, zero at the start of every stretch."""
        pieces = np.split(signal, np.cumsum(self.lengths)[:-1])
        return np.concatenate([np.r_[np.zeros(min(lag, len(p))), p[:-lag]] for p in pieces])

    def for_engine(self, rows: int, matrix: Matrix) -> FilterRows:
        """Return the arrays for one chunk of `rows` rows, those beyond the record's are padding."""
        arrays = self._arrays
        short = rows - sum(self.lengths)
        back = arrays.back
        if back is not None:
            back = np.concatenate([back, np.zeros(short, dtype=int)])
        wide = -(-rows // _block(self.noise)) if arrays.place is None else len(arrays.follows)
        follows = np.concatenate([arrays.follows, np.ones(wide - len(arrays.follows))])
        past, recent = (-n % _SHARED for n in (arrays.ar.shape[1], arrays.memory.shape[2]))
        one = arrays._replace(
            ar=np.pad(arrays.ar, ((0, 0), (0, past))),
            memory=np.pad(arrays.memory, ((0, 0), (0, 0), (recent, 0))),
            live=np.concatenate([arrays.live, np.zeros(short)]),
            follows=follows,
            matrix=np.asarray(matrix),
            back=back,
        )
        return FilterRows(*(None if part is None else part[None] for part in one))

    @cached_property
    def _arrays(self) -> FilterRows:
        noise, size = self.noise, _block(self.noise)
        total, ny = sum(self.lengths), len(noise.orders)
        live = np.concatenate([np.arange(n) >= self.skipped for n in self.lengths]).astype(float)
        blocks = [max(-(-n // size), 1) for n in self.lengths]
        follows = np.concatenate([np.r_[0.0, np.ones(n - 1)] for n in blocks])
        place = back = None
        if len(self.lengths) > 1:
            starts = np.cumsum([0, *self.lengths[:-1]])
            offsets = size * np.cumsum([0, *blocks[:-1]])
            place = np.full(size * sum(blocks), total)
            back = np.concatenate(
                [o + np.arange(n) for o, n in zip(offsets, self.lengths, strict=True)]
            )
            place[back] = np.concatenate(
                [s + np.arange(n) for s, n in zip(starts, self.lengths, strict=True)]
            )
        response, memory = _recursion(noise.ma, size)
        return FilterRows(
            noise.ar, response, memory, live, follows, np.eye(ny)[:1, :1], place, back
        )


def _block(noise: NoiseModel) -> int:
    return max(_BLOCK, noise.ma.shape[1])


def _recursion(ma: Matrix, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return how the values of a block by 1/C follow its own input, and the q values before it."""
    ny, q = ma.shape
    state = np.zeros((ny, q + size, 1 + q))  # rows: time, columns: an impulse, and past values
    state[:, np.arange(q), 1 + np.arange(q)] = 1.0
    state[:, q, 0] = 1.0
    for k in range(q, q + size):
        for i in range(q):
            state[:, k] -= ma[:, i, None] * state[:, k - 1 - i]
    impulse = np.concatenate([state[:, q:, 0], np.zeros((ny, size))], axis=1)
    return impulse[:, np.arange(size)[:, None] - np.arange(size)], state[:, q:, 1:]
