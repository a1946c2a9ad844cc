"""What a solver declares."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable


@runtime_checkable
class Solver(Protocol):
    """What `estimate(solver=…)` takes: a frozen declaration."""

    @property
    def gauss_newton(self) -> bool:
        """Whether it works on normal equations over the weights, with θ eliminated.

        Evidence and the free run need them. Other solvers get the criterion of θ and the weights together
        (`PaperCriterion`).
        """
        ...

    @property
    def iterations(self) -> int:
        """Steps at most."""
        ...

    @property
    def minimise(self) -> Callable[..., Any]:
        """One run: as `LevenbergMarquardt.minimise` on normal equations, otherwise as `AdamLBFGS.minimise`."""
        ...

    def at_most(self, iterations: int) -> Solver:
        """The same with fewer iterations, where that is the same method."""
        ...
