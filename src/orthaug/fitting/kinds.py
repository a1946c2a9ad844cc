"""The structures, criteria and solvers that a spec refers to by name, and `Solver`.

A new one is a file, and an entry here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

from orthaug._base.registry import Registry
from orthaug.fitting.criteria import Auto, Prediction, Simulation
from orthaug.fitting.solvers.adam_lbfgs import AdamLBFGS
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.structures import Additive, BaselinePenalty, Orthogonal, OrthogonalPenalty


@runtime_checkable
class Solver(Protocol):
    """A solver as `estimate(solver=…)` accepts it: a frozen declaration."""

    @property
    def gauss_newton(self) -> bool:
        """True for a solver of normal equations over the weights, with θ eliminated.

        Evidence and the free run need them. Other solvers get the criterion of θ and the weights
        together (`PaperCriterion`).
        """
        ...

    @property
    def iterations(self) -> int:
        """Steps at most."""
        ...

    @property
    def minimize(self) -> Callable[..., Any]:
        """`LevenbergMarquardt.minimize` on normal equations, else `AdamLBFGS.minimize`."""
        ...

    def at_most(self, iterations: int) -> Solver:
        """Return the solver with fewer iterations, where that is the same method."""
        ...


STRUCTURES = Registry(
    "structure",
    {
        "additive": Additive,
        "orthogonal": Orthogonal,
        "orthogonal-penalty": OrthogonalPenalty,
        "baseline-penalty": BaselinePenalty,
    },
    reserved=("kind", "measure"),
)
# The other keys of [training]
_BESIDE = ("solver", "focus", "restarts", "ensemble", "seed", "regularization")
CRITERIA = Registry(
    "criterion",
    {"auto": Auto, "prediction": Prediction, "simulation": Simulation},
    reserved=_BESIDE,
)
SOLVERS = Registry(
    "solver",
    {"levenberg-marquardt": LevenbergMarquardt, "adam-lbfgs": AdamLBFGS},
    reserved=_BESIDE,
    beside=CRITERIA,
)


def declared_by_name(registry: Registry, given: object) -> Any:
    """Return a declaration, of a name that of its kind with the defaults.

    Raises:
        InputError: an unknown name, or a kind that needs more than its name.
    """
    return registry.discover().declare(given, {}) if isinstance(given, str) else given
