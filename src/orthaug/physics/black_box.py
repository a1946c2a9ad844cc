"""A function that something else than JAX computes, with its slopes, as a function on JAX arrays.

Derivatives of first and second order go through: in either direction, batched, inside compiled
programs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Protocol, runtime_checkable

import numpy as np

from orthaug._base.checks import Matrix
from orthaug._base.host_calls import call_on_host
from orthaug._base.jax import Array, jax, jnp

Groups = tuple[bool, bool, bool]
"""True if x, u and p are each among the variables of slopes."""


@runtime_checkable
class BlackBox(Protocol):
    """A map from points z = (x, u, p) to `size` numbers; hashable, and equal where it is the same.

    Points are rows (m, nx + nu + np).
    """

    @property
    def size(self) -> int:
        """Number of values."""
        ...

    @property
    def widths(self) -> tuple[int, int, int]:
        """Numbers nx, nu and np of states, inputs and parameters."""
        ...

    def sampled(self, sampling_time: float) -> BlackBox:
        """Return the map of this time [s] between samples; itself where it is the same for all."""
        ...

    def values(self, z: Matrix) -> Matrix:
        """Return the values (m, size) at points; NaN where it fails."""
        ...

    def write_values(self, point: int, values: int) -> None:
        """Write the values at the point at an address to an address."""
        ...

    def slopes(self, z: Matrix, groups: Groups) -> Any:
        """Return the slopes (m, size, n) by those of x, u and p that are asked for."""
        ...

    def curvature(self, z: Matrix) -> Any:
        """Return the second derivatives (m, size, nz, nz), to a few digits."""
        ...


@dataclass(frozen=True)
class Points:
    """The values (size, …) of a black box at x (nx, …), u (nu, …) and p (np,) or (np, …).

    Equal where the boxes are, so that programs are used again. The arrays are NumPy's, or JAX's
    under any transformation.
    """

    box: BlackBox

    def sampled(self, sampling_time: float) -> Points:
        """Return the values of the box of this time [s] between samples."""
        return Points(self.box.sampled(sampling_time))

    def __call__(self, x: Any, u: Any, p: Any) -> Any:
        box = self.box
        parts = [part if hasattr(part, "shape") else np.asarray(part, float) for part in (x, u, p)]
        if any(isinstance(part, jax.Array) for part in parts):
            if parts[0].ndim == 1:
                return _point()(box, *(jnp.asarray(part, dtype=float) for part in parts))
            axes = (-1, -1, -1 if parts[2].ndim > 1 else None)
            return jax.vmap(self, axes, -1)(*parts)
        arrays = [np.asarray(part, dtype=float) for part in parts]
        lead = arrays[0].shape[1:]
        rows = [
            np.broadcast_to(a.reshape(len(a), *(a.shape[1:] or (1,) * len(lead))), (len(a), *lead))
            for a in arrays
        ]
        z = np.concatenate(rows).reshape(sum(map(len, arrays)), -1).T
        return box.values(np.ascontiguousarray(z)).T.reshape(box.size, *lead)


@dataclass(frozen=True)
class _Values:
    """The values of a black box at rows: a `HostFunction`."""

    box: BlackBox

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        return ((self.box.size,),)

    def __call__(self, rows: Matrix) -> tuple[Any, ...]:
        return (self.box.values(rows),)

    def write_one(self, row: int, results: Sequence[int]) -> bool:
        self.box.write_values(row, results[0])
        return True


@dataclass(frozen=True)
class _Slopes:
    """The values and slopes of a black box at rows: a `HostFunction`."""

    box: BlackBox
    groups: Groups

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        return (self.box.size,), (self.box.size, len(self.columns))

    @property
    def columns(self) -> Any:
        """The variables of the slopes, as entries of z."""
        return np.flatnonzero(np.repeat(self.groups, self.box.widths))

    def __call__(self, rows: Matrix) -> tuple[Matrix, np.ndarray]:
        return self.box.values(rows), self.box.slopes(rows, self.groups)

    def write_one(self, row: int, results: Sequence[int]) -> bool:
        return False


@dataclass(frozen=True)
class _Curvature:
    """The second derivatives of a black box at rows: a `HostFunction`."""

    box: BlackBox

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        nz = sum(self.box.widths)
        return ((self.box.size, nz, nz),)

    def __call__(self, rows: Matrix) -> tuple[np.ndarray]:
        return (self.box.curvature(rows),)

    def write_one(self, row: int, results: Sequence[int]) -> bool:
        return False


@cache  # JAX is imported when the first motion of a source is computed on its arrays
def _point() -> Any:
    """Return the function of a black box at one point on JAX arrays."""

    @partial(jax.custom_jvp, nondiff_argnums=(0,))
    def value(box: BlackBox, x: Any, u: Any, p: Any) -> Any:
        return call_on_host(_Values(box), jnp.concatenate([x, u, p]))[0]

    @partial(jax.custom_jvp, nondiff_argnums=(0,))
    def slopes(asked: _Slopes, z: Array) -> Any:
        return call_on_host(asked, z)

    def along(
        box: BlackBox, primals: tuple[Array, Array, Array], tangents: Any
    ) -> tuple[Array, Array]:
        still = [isinstance(t, jax.custom_derivatives.SymbolicZero) for t in tangents]
        asked = _Slopes(box, (not still[0], not still[1], not still[2]))
        found, to_z = slopes(asked, jnp.concatenate(primals))
        moved = [t for t, zero in zip(tangents, still, strict=True) if not zero]
        return found, to_z @ jnp.concatenate(moved) if moved else jnp.zeros_like(found)

    value.defjvp(along, symbolic_zeros=True)

    @slopes.defjvp
    def slopes_along(
        asked: _Slopes, primals: tuple[Array], tangents: tuple[Array]
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        found, to_z = slopes(asked, *primals)
        (moved,) = tangents
        bend = call_on_host(_Curvature(asked.box), *primals)[0]
        along_values = bend_free_slopes(asked, *primals) @ moved
        return (found, to_z), (along_values, bend[:, asked.columns] @ moved)

    def bend_free_slopes(asked: _Slopes, z: Array) -> Array:
        return slopes(_Slopes(asked.box, (True, True, True)), z)[1]

    return value
