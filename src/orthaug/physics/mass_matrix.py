"""Equations of forces: what a learner adds to M ẋ acts on all rates through the inverse of M."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug._base.jax import jax, jnp

Function = Callable[[Any, Any], Any]
_WRITTEN_OUT = 6  # rows up to which a solution is arithmetic, and no call that stops fusion


@dataclass(frozen=True)
class MassMatrix:
    """M(x, p) of `M ẋ = M f(x, u, p) + g`, where g are forces: of a learner, or of a missing term.

    Without it g is added to ẋ itself. A friction in one joint of an arm moves all its joints; as a
    torque it is one function of one velocity, which few neurons follow.

    Args:
        function: M(x, p), (n, n) on JAX arrays, symmetric and positive, from states x (nx,) and
            parameters p (np,) at one point; others may follow behind them. It must be hashable, as
            functions are.
        rows: numbers of the n states that it multiplies the rates of.
        forces: name and unit of each of them.

    Raises:
        InputError: rows and forces of different number.
    """

    function: Function
    rows: tuple[int, ...]
    forces: tuple[tuple[str, str], ...]

    def __post_init__(self) -> None:
        if len(self.rows) != len(self.forces) or len(set(self.rows)) != len(self.rows):
            raise InputError(
                f"a mass matrix with {len(self.rows)} rows and {len(self.forces)} forces; give "
                "each row once, and a name and a unit for it."
            )

    def check(self, states: int, discrete: bool) -> None:
        """Raise InputError unless a motion with so many states can have this matrix."""
        if self.rows and discrete:
            raise InputError("a discrete motion has no forces; leave `mass` out.")
        if not set(self.rows) <= set(range(states)):
            raise InputError(
                f"the mass matrix has the rows {list(self.rows)}; the motion has {states} states, "
                "numbered from 0."
            )

    def label(self, state: int) -> tuple[str, str] | None:
        """Return name and unit of what is added to a state's equation; None for a rate."""
        return dict(zip(self.rows, self.forces, strict=True)).get(state)

    def rates(self, forces: Any, x: Any, p: Any) -> Any:
        """Return what rates (nx, …) grow by where forces (nx, …) are added: M⁻¹ forces."""
        return self._apply(_solve, forces, x, p)

    def balance(self, rates: Any, x: Any, p: Any) -> Any:
        """Return M rates (nx, …) at states (nx, …)."""
        return self._apply(jnp.matmul, rates, x, p)

    def entries(self, x: Matrix, p: Vector) -> Float[np.ndarray, "m nx nx"]:
        """Return ∂ẋ/∂(what is added to each equation) at states (m, nx)."""
        one = np.eye(x.shape[1])
        columns = [self.rates(np.tile(row[:, None], len(x)), x.T, p) for row in one]
        return np.moveaxis(np.asarray(columns), 2, 0).swapaxes(1, 2)

    def _apply(self, operation: Any, values: Any, x: Any, p: Any) -> Any:
        if not self.rows:
            return values
        values, x, p = (jnp.asarray(part, dtype=float) for part in (values, x, p))
        if x.ndim > 1:
            return jax.vmap(lambda v, x: self._apply(operation, v, x, p), -1, -1)(values, x)
        places = np.array(self.rows)
        return values.at[places].set(operation(self.function(x, p), values[places]))


def _no_forces(x: Any, p: Any) -> Any:
    return jnp.zeros((0, 0))


NO_MASS = MassMatrix(_no_forces, (), ())
"""Of a motion whose learner and missing terms are rates."""


def _solve(matrix: Any, right: Any) -> Any:
    """Return the solution (n,) of a symmetric, positive system, by elimination without pivots."""
    n = len(right)
    if n > _WRITTEN_OUT:
        return jnp.linalg.solve(matrix, right)
    rows = [jnp.append(matrix[i], right[i]) for i in range(n)]
    for i in range(n):
        rows[i] = rows[i] / rows[i][i]
        rows = [row if j == i else row - row[i] * rows[i] for j, row in enumerate(rows)]
    return jnp.stack([row[n] for row in rows])
